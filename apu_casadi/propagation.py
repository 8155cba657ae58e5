"""Exact propagation of the generator over steps of constant speed.

Inside an exchange step the speed is constant.  With a linear load the windings then obey

    dx/dt = A(theta) x + b(theta) E_fd + c(theta),    theta = theta_0 + w_r t,

in the qd0 frame: constant coefficients for a healthy machine with a balanced load, 2 pi-periodic
ones otherwise.  Only the exciter is not linear, and it is slow.  So the windings need no small
steps: their transition matrix over a sample h,

    x(t + h) = P(theta(t)) [x; E; E'; E''; 1],        E(t + s) = E + s E' + s^2/2 E'',

is computed once for a load, a fault and h.  P is an analytic function of the rotor angle: its
Fourier series is cut where it has converged to ``TAIL``, and interpolated in speed.  The exciter
advances by the classical Runge-Kutta method between the samples, with the terminal voltage
linear in between.

A and b are derivatives of the model's own right-hand side: no equation is written again.  Not for
constant-power loads, which are not linear; right after a switch, where the windings settle within
microseconds, an adaptive integrator samples the mean power better.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.backend import Caller, compiled
from apu_casadi.errors import SimulationError
from apu_casadi.generator import Generator
from apu_casadi.machine import exciter as ac5a
from apu_casadi.simulation import StepResult
from apu_casadi.statespace import StateSpace

SETTLING = 1e-3  # s, in which the windings follow a step of speed
TAIL = 1e-9  # Fourier coefficients below this share of the largest are left out
MAGNUS_TOL = 1e-8  # largest change of P, relative, when the steps it is made of are halved
HARMONICS = (24, 48)  # harmonics resolved, in turn; a series that still goes on is refused
#: Largest error of E_fd, per unit, that the windings may see at the end of an exciter's step; a
#: quarter acts on average.  Where coefficients are constant a larger one tells of a limit met.
DRIVE_TOL = {"constant": 1e-5, "periodic": 1e-5, "fine": 2e-5}
SPEED_RANGE = 0.06  # half width, relative to rated, over which P is interpolated in speed
_NODES = 4  # Chebyshev nodes in speed
_GAUSS = math.sqrt(3.0) / 6.0


def linear_states(ss: StateSpace) -> list[str]:
    """Names of the states that obey the linear equations: flux linkages and fault current."""
    return [n for n in ss.x.names if n.startswith("lam_") or n == "i_fault"]


def applicable(ss: StateSpace) -> bool:
    """Whether the model is linear in its winding states at constant speed."""
    return "G_load" not in ss.x


@dataclass(frozen=True)
class _Split:
    """Positions of the parts of a generator's state."""

    linear: list[int]
    slow: list[int]
    angle: int
    drive: int  # E_fd among all states


def _split(ss: StateSpace) -> _Split:
    linear = ss.x.indices(linear_states(ss))
    angle, drive = ss.x.index("theta_e"), ss.x.index("E_fd")
    slow = [i for i in range(len(ss.x)) if i not in (*linear, angle)]
    return _Split(linear, slow, angle, drive)


@lru_cache(maxsize=64)
def _coefficients(ss: StateSpace) -> ca.Function:
    """Function (theta_e, u, theta) -> augmented matrix M of d/dt [x; E; E'; E''; 1].

    Checks that the model is linear in x and E where it is taken to be.
    """
    s = _split(ss)
    x, u, th = ca.SX.sym("x", len(ss.x)), ca.SX.sym("u", len(ss.u)), ca.SX.sym("t", len(ss.theta))
    rate = ss.f(x, u, th)[s.linear]
    own = ca.vertcat(x[s.linear], x[s.drive])
    J = ca.jacobian(rate, own)
    if any(ca.which_depends(ca.vec(ca.densify(J)), own, 1, True)):
        raise SimulationError(f"{ss.name} is not linear in its windings: use another integrator")
    n = len(s.linear)
    rest = ca.substitute(rate, own, ca.SX.zeros(n + 1))
    M = ca.SX.zeros(n + 4, n + 4)
    M[:n, : n + 1] = J
    M[:n, n + 3] = rest
    M[n, n + 1] = 1
    M[n + 1, n + 2] = 1
    return ca.Function("M", [x[s.angle], u, th], [ca.densify(M)], {"cse": True})


def _expm(M: np.ndarray) -> np.ndarray:
    """Exponentials of a stack of matrices (k, n, n): Taylor series with scaling and squaring."""
    norm = np.abs(M).sum(axis=-1).max() if M.size else 0.0
    squarings = max(0, math.ceil(math.log2(max(norm, 1e-300) / 0.25)))
    A = M / 2.0**squarings
    n = M.shape[-1]
    E = np.broadcast_to(np.eye(n), M.shape) + A
    term = A
    for k in range(2, 10):  # 0.25^10/10! = 3e-13
        term = term @ A / k
        E = E + term
    for _ in range(squarings):
        E = E @ E
    return E


def _transition(
    M_of: Any, theta0: np.ndarray, w: np.ndarray, h: float, steps: int, leaps: int = 1
) -> list[np.ndarray]:
    """Transition matrices over h, 2 h, ... from angles theta0 at speeds w, by Magnus steps.

    Order 4, ``steps`` of them in h (Blanes, Casas, Oteo, Ros, Physics Reports 470, 2009: two Gauss
    points and one commutator).
    """
    hs = h / steps
    P, out = None, []
    for k in range(leaps * steps):
        M1 = M_of(theta0 + w * hs * (k + 0.5 - _GAUSS), w)
        M2 = M_of(theta0 + w * hs * (k + 0.5 + _GAUSS), w)
        Omega = hs / 2 * (M1 + M2) + math.sqrt(3.0) / 12 * hs * hs * (M2 @ M1 - M1 @ M2)
        E = _expm(Omega)
        P = E if P is None else E @ P
        if (k + 1) % steps == 0:
            out.append(P)
    return out


@lru_cache(maxsize=128)
def _coefficients_at(ss: StateSpace, count: int) -> Caller:
    """:func:`_coefficients` at ``count`` angles at once."""
    return Caller(compiled(_coefficients(ss).map(count), build=False))


@dataclass(frozen=True)
class Table:
    """Transition matrices of one load, fault and sample, as Fourier series in the rotor angle.

    Parameters
    ----------
    centre, half : middle and half width of the speed range, rad/s.
    series : coefficients of 1, cos k theta, sin k theta, each a polynomial in the relative speed
        (w - centre)/half, shape (powers, m n (n + 4) (1 + 2 H)), with m leaps (:class:`Strides`).
    harmonics : H.
    error : largest relative change when the Magnus steps were halved.
    """

    centre: float
    half: float
    series: np.ndarray
    harmonics: int
    error: float

    def at(self, w: float) -> np.ndarray:
        """Series at speed w, rad/s, shape (m n (n + 4), 1 + 2 H)."""
        s = (w - self.centre) / self.half
        powers = np.array([1.0, s, s * s, s * s * s])
        return np.asarray((powers @ self.series).reshape(-1, 1 + 2 * self.harmonics))


def transition_table(
    ss: StateSpace,
    u: np.ndarray,
    theta: np.ndarray,
    h: float,
    w_rated: float,
    n_out: int,
    fine: bool = False,
) -> Table:
    """Compute the transition matrices for all rotor angles and nearby speeds.

    Over h, 2 h, ... up to the exciter's step, one below the other (:class:`Strides`).

    Raises
    ------
    SimulationError : the Fourier series or the Magnus steps do not converge (a load so light
        that the windings settle within a small part of h while the coefficients turn).
    """
    n = len(linear_states(ss))
    iw = ss.u.index("w_r")
    centre, half = w_rated, SPEED_RANGE * w_rated
    k = np.arange(_NODES)
    nodes = centre + half * np.cos(np.pi * (2 * k + 1) / (2 * _NODES))
    to_powers = np.linalg.inv(np.vander((nodes - centre) / half, _NODES, increasing=True))

    def M_of(angle: np.ndarray, w: np.ndarray) -> np.ndarray:
        U = np.repeat(u[:, None], angle.size, axis=1)
        U[iw] = w
        TH = np.repeat(theta.reshape(-1, 1), angle.size, axis=1)
        out = _coefficients_at(ss, angle.size)(angle.reshape(1, -1), U, TH)[0]
        return np.asarray(out.reshape(n + 4, angle.size, n + 4).transpose(1, 0, 2))

    probe = np.array([0.1, 0.9, 2.3])
    Mp = M_of(probe, np.full(3, centre))
    constant = np.abs(Mp - Mp[0]).max() <= 1e-12 * np.abs(Mp[0]).max()
    m = strides(n_out, h, bool(constant), fine).m
    # the number of Magnus steps is doubled until a few angles agree, then used for all
    steps, error = 1, 0.0
    if not constant:
        pw = np.full(3, nodes[0])
        last = _transition(M_of, probe, pw, h, steps)[0]
        while True:
            new = _transition(M_of, probe, pw, h, 2 * steps)[0]
            error = float(np.abs(new - last).max() / np.abs(new[:, :n, :n]).max()) / 15
            steps *= 2
            if error <= MAGNUS_TOL:
                break
            if steps >= 256:
                raise SimulationError(
                    f"{ss.name}: transition matrices over {h:.3g} s do not converge "
                    f"(error {error:.1e} with {steps} steps)"
                )
            last = new

    def sampled(angles: np.ndarray) -> np.ndarray:
        """Entries for every node and angle: column-major, one leap after the other."""
        a, w = np.tile(angles, _NODES), np.repeat(nodes, angles.size)
        leaps = _transition(M_of, a, w, h, steps, m)
        entries = [L[:, :n, :].transpose(0, 2, 1).reshape(a.size, -1) for L in leaps]
        P = np.concatenate(entries, axis=1)
        return P.reshape(_NODES, angles.size, -1)

    if constant:
        return Table(centre, half, to_powers @ sampled(np.zeros(1))[:, 0, :], 0, error)
    for resolved in HARMONICS:
        P = sampled(np.pi * np.arange(2 * resolved) / resolved)
        F = np.fft.rfft(P, axis=1) / (2 * resolved)
        size = np.abs(F).max(axis=(0, 2))
        highest = int(np.nonzero(size > TAIL * size[0])[0][-1])
        if highest < resolved - 1:
            break
    else:
        raise SimulationError(
            f"{ss.name}: the transition matrix over {h:.3g} s has over {highest} harmonics of the "
            f"rotor angle above {TAIL:g}: the load is too light for this step"
        )
    H = highest
    series = np.empty((_NODES, P.shape[2], 1 + 2 * H))
    series[:, :, 0] = F[:, 0].real
    series[:, :, 1::2] = 2 * F[:, 1 : H + 1].real.transpose(0, 2, 1)
    series[:, :, 2::2] = -2 * F[:, 1 : H + 1].imag.transpose(0, 2, 1)
    return Table(centre, half, to_powers @ series.reshape(_NODES, -1), H, error)


def gregory(n: int) -> np.ndarray:
    """Weights, shape (n + 1,), of a mean over n equal intervals: trapezoids, ends corrected.

    Gregory's formula of order six.  For what ripples periodically the trapezoidal rule inside is
    spectrally accurate, which Simpson's is not.
    """
    w = np.ones(n + 1)
    ends = np.array([95 / 288, 317 / 240, 23 / 30, 793 / 720, 157 / 160])
    w[:5], w[-5:] = ends, ends[::-1]
    return w / n


class Strides(NamedTuple):
    """How the exciter steps through the samples: ``head`` single ones, then ``many`` of ``m``.

    A new speed at the start of a step lets the terminal voltage jump and settle within a
    millisecond, which single samples resolve.  After that, where nothing ripples, the exciter can
    take five samples at once; under a fault its drive follows the ripple of the terminal voltage
    and two are right.  ``fine`` is single samples throughout: while a regulator limit is met or
    left, say (``DRIVE_TOL`` tells).
    """

    head: int
    m: int
    many: int

    def starts(self) -> np.ndarray:
        """Index of the sample from which each step of the exciter leaves."""
        return np.concatenate([np.arange(self.head), self.head + self.m * np.arange(self.many)])


def strides(n_out: int, h: float, constant: bool, fine: bool) -> Strides:
    """Choose the strides for n_out samples of length h, s."""
    if fine:
        return Strides(n_out, 1, 0)
    m = 5 if constant else 2
    head = min(n_out, math.ceil(SETTLING / h))
    head += (n_out - head) % m
    return Strides(head, m, (n_out - head) // m)


@lru_cache(maxsize=64)
def _leap(
    gen: Generator, ss: StateSpace, m: int, constant: bool
) -> tuple[ca.Function, ca.Function]:
    """One step of the exciter over m samples, and the terminal voltage with its rate.

    First: (x, V, P, u, theta, h) -> (x at the m samples, V at the end); V holds the terminal
    voltage, its rate, and the largest error of the drive so far.  Second: (x, u, theta) -> (V_t,
    dV_t/dt).
    """
    s, n = _split(ss), len(linear_states(ss))
    nx, nu, nt = len(ss.x), len(ss.u), len(ss.theta)
    p, e = gen.machine, gen.exciter
    names = [ss.x.names[i] for i in s.slow]
    i_E = names.index("E_fd")
    x, u, th = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("t", nt)
    V_t = ss.g(x, u, th)[ss.y.index("V_t")]
    V_dot = ca.jtimes(V_t, x, ss.f(x, u, th))
    if constant:  # nothing depends on the rotor angle; spare its cosines
        V_t, V_dot = ca.substitute([V_t, V_dot], [x[s.angle]], [ca.SX(0)])
    V_of = ca.Function("V_of", [x, u, th], [V_t, V_dot])

    h, V, P = ca.SX.sym("h"), ca.SX.sym("V", 3), ca.SX.sym("P", m * n * (n + 4))
    u_d = ss.u.unpack(u)

    def rates(slow: Any, V_t: Any) -> Any:
        state = ac5a.ExciterState(**dict(zip(names, ca.vertsplit(slow), strict=True)))
        d = ac5a.exciter_rates(e, state, V_t=V_t / p.V_rated_rms, V_ref=u_d["V_ref"])
        return ca.vertcat(*(getattr(d, k) for k in names))

    slow = x[s.slow]
    k1 = rates(slow, V[0])
    E, E1 = slow[i_E], k1[i_E]
    E2 = ca.jtimes(E1, slow, k1)
    start = ca.vertcat(x[s.linear], E, E1, E2, 1)
    samples = []
    for j in range(m):
        t = (j + 1) * h
        block = ca.reshape(P[j * n * (n + 4) : (j + 1) * n * (n + 4)], n, n + 4)
        x_j = ca.SX(nx, 1)
        x_j[s.slow] = slow  # only the drive enters outputs between the exciter's steps
        x_j[s.linear], x_j[s.angle] = ca.mtimes(block, start), x[s.angle] + t * u_d["w_r"]
        x_j[s.drive] = E + t * E1 + t**2 / 2 * E2
        samples.append(x_j)
    end, H = samples[-1], m * h
    # terminal voltage in between: cubic through values and rates at both ends (Hermite); under a
    # fault it ripples with twice the frequency, which a straight line would cut by 1 %
    V1, V1_dot = V_of(end, u, th)
    Vm = (V[0] + V1) / 2 + H / 8 * (V[1] - V1_dot)
    k2 = rates(slow + H / 2 * k1, Vm)
    k3 = rates(slow + H / 2 * k2, Vm)
    k4 = rates(slow + H * k3, V1)
    E_taken = end[s.drive]
    end[s.slow] = slow + H / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    miss = ca.fmax(V[2], ca.fabs(end[s.drive] - E_taken))
    leap = ca.Function(
        "leap",
        [x, V, P, u, th, h],
        [ca.horzcat(*samples[:-1], end), ca.vertcat(V1, V1_dot, miss)],
        {"cse": True},
    )
    return leap, V_of


def _fold(leap: ca.Function, m: int, steps: int, n_P: int, constant: bool,
          sizes: tuple[int, int, int]) -> ca.Function:  # fmt: skip
    """``steps`` steps of the exciter: (start, P) -> (start of the next, x at all samples).

    ``start`` holds x, V and what stays; a few steps are unrolled, which spares copies.
    """
    nx, nu, nt = sizes
    size = next(k for k in (5, 4, 2, 1) if steps % k == 0)
    x, u, th = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("t", nt)
    h, V = ca.SX.sym("h"), ca.SX.sym("V", 3)
    P = ca.SX.sym("P", n_P, 1 if constant else size)
    xk, Vk, states = x, V, []
    for k in range(size):
        X, Vk = leap(xk, Vk, P if constant else P[:, k], u, th, h)
        xk = X[:, m - 1]
        states.append(X)
    fixed = [u, th, h, *([P] if constant else [])]
    group = ca.Function(
        "group",
        [ca.vertcat(x, V, *fixed), *([] if constant else [P])],
        [ca.vertcat(xk, Vk, *fixed), ca.horzcat(*states)],
        {"cse": True},
    )
    run = group.mapaccum("run", steps // size, 1)
    S = ca.MX.sym("S", nx + 3 + nu + nt + 1)
    PP = ca.MX.sym("P", n_P, 1 if constant else steps)
    last, X_all = run(ca.vertcat(S, PP)) if constant else run(S, PP)
    return ca.Function("fold", [S, PP], [last[: S.numel(), steps // size - 1], X_all])


@lru_cache(maxsize=64)
def _advance(gen: Generator, ss: StateSpace, n_out: int, plan: Strides, outputs: tuple[str, ...],
             quad: tuple[str, ...], constant: bool) -> ca.Function:  # fmt: skip
    """n_out samples at once: (x0, P, u, theta, h) -> (x, y, mean, miss).

    ``P`` holds one column of transition matrix entries for the whole step (``constant``) or one
    for each step of the exciter; means by :func:`gregory`.
    """
    n = len(linear_states(ss))
    nx, nu, nt = len(ss.x), len(ss.u), len(ss.theta)
    n_P = n * (n + 4)
    X0, U, TH, H = ca.MX.sym("x0", nx), ca.MX.sym("u", nu), ca.MX.sym("th", nt), ca.MX.sym("h")
    PP = ca.MX.sym("P", plan.m * n_P, 1 if constant else plan.head + plan.many)
    single, V_of = _leap(gen, ss, 1, constant)
    S = ca.vertcat(X0, *V_of(X0, U, TH), 0, U, TH, H)
    parts = []
    if plan.head:
        fold = _fold(single, 1, plan.head, n_P, constant, (nx, nu, nt))
        S, X = fold(S, PP[:n_P, :] if constant else PP[:n_P, : plan.head])
        parts.append(X)
    if plan.many:
        leap, _ = _leap(gen, ss, plan.m, constant)
        fold = _fold(leap, plan.m, plan.many, plan.m * n_P, constant, (nx, nu, nt))
        S, X = fold(S, PP if constant else PP[:, plan.head :])
        parts.append(X)
    X_all, miss = ca.horzcat(*parts), S[nx + 2]
    # outputs and means
    xo, uo, to = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("t", nt)
    y = ss.g(xo, uo, to)
    terms = []
    for q in quad:
        base, _, power = q.partition("^")
        v = y[ss.y.index(base)]
        terms.append(v**2 if power else v)
    wanted = ca.vertcat(*(y[ss.y.index(k)] for k in outputs), *terms)
    # an empty input mapped over samples makes C code that newer compilers refuse
    held, HELD = ([uo, to], [U, TH]) if nt else ([uo], [U])
    out = ca.Function("out", [xo, *held], [wanted], {"cse": True})
    w = gregory(n_out)
    y0 = out(X0, *HELD)
    Y = out.map("outs", "serial", n_out, list(range(1, 1 + len(held))), [])(X_all, *HELD)
    k = len(outputs)
    means = y0[k:] * w[0] + ca.mtimes(Y[k:, :], ca.DM(w[1:]))
    return ca.Function(
        f"advance_{ss.name}_{n_out}" + ("" if plan.many else "_fine"),
        [X0, PP, U, TH, H],
        [X_all[:, n_out - 1], Y[:k, :], means, miss],
        ["x0", "P", "u", "theta", "h"],
        ["x", "y", "mean", "miss"],
    )


class Propagator:
    """Steps of one model variant with one load and fault; a fast stand-in for a ``Stepper``.

    Parameters
    ----------
    gen, ss : generator and its model variant (:meth:`Generator.variant`).
    u, theta : inputs and fault parameters; only w_r, V_ref and noise may change afterwards.
    n_out : samples in a step, at least 10.
    dt : length of every step, s.
    outputs : outputs to be returned at the samples.
    quad : outputs (or squares, ``"v_a^2"``) whose mean over the step is returned.
    fine : the exciter steps at every sample; for the steps that the usual strides refuse.

    Raises
    ------
    SimulationError : the model is not linear in its windings, or the series does not converge;
        use :func:`apu_casadi.simulation.stepper` there.
    """

    def __init__(
        self,
        gen: Generator,
        ss: StateSpace,
        u: np.ndarray,
        theta: np.ndarray,
        *,
        n_out: int,
        dt: float,
        outputs: Sequence[str] = (),
        quad: Sequence[str] = (),
        fine: bool = False,
    ) -> None:
        """Compute or fetch the table, build or fetch the functions."""
        if not applicable(ss):
            raise SimulationError(f"{ss.name}: a constant-power load is not linear")
        if n_out < 10:
            raise SimulationError(f"{ss.name}: at least 10 samples are needed, got {n_out}")
        self.ss, self.n_out, self.dt = ss, n_out, dt
        self.outputs, self.quad = tuple(outputs), tuple(quad)
        self.h = dt / n_out
        self.theta = np.array(theta, dtype=float)
        w_rated = gen.machine.w_rated
        self.table = _cached_table(ss, u, self.theta, self.h, w_rated, n_out, fine)
        constant = self.table.harmonics == 0
        self.constant = constant
        plan = strides(n_out, self.h, constant, fine)
        self.function = _advance(gen, ss, n_out, plan, self.outputs, self.quad, constant)
        self.tol = DRIVE_TOL["fine" if fine else "constant" if constant else "periodic"]
        self.layout = (gen, ss, plan, self.outputs, self.quad)  # what ``function`` depends on
        self._compiled: Caller | None = None
        self._t = dt * (np.arange(1, n_out + 1) / n_out)  # rounded as a Stepper does
        self._angle = ss.x.index("theta_e")
        self._iw = ss.u.index("w_r")
        self._w_ok = (1 - SPEED_RANGE) * w_rated, (1 + SPEED_RANGE) * w_rated
        self._starts = self.h * plan.starts()
        self._trig = np.ones((1 + 2 * self.table.harmonics, self._starts.size))

    def valid(self, w_r: float) -> bool:
        """Whether the speed, rad/s electrical, lies in the range of the table."""
        return self._w_ok[0] <= w_r <= self._w_ok[1]

    def __call__(
        self, x0: np.ndarray, u: np.ndarray, *, t0: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance one step.

        Returns
        -------
        State at the end, outputs at the samples of shape (outputs, n_out), and means.  The arrays
        are overwritten by the next call.

        Raises
        ------
        SimulationError : the exciter moves too fast for the samples, a result is not finite, or the
            speed is outside the table; use a ``Stepper`` for this step.
        """
        w = float(u[self._iw])
        if not self.valid(w):
            raise SimulationError(
                f"{self.ss.name}: w_r = {w:.6g} rad/s is outside the table's "
                f"[{self._w_ok[0]:.6g}, {self._w_ok[1]:.6g}]"
            )
        P = self.table.at(w)
        if not self.constant:
            phase = float(x0[self._angle]) + w * self._starts
            c1, s1 = np.cos(phase), np.sin(phase)
            T = self._trig
            T[1], T[2] = c1, s1
            for k in range(2, self.table.harmonics + 1):
                T[2 * k - 1] = T[2 * k - 3] * c1 - T[2 * k - 2] * s1
                T[2 * k] = T[2 * k - 2] * c1 + T[2 * k - 3] * s1
            P = P @ T
        if self._compiled is None:  # a run in blocks may never need it
            self._compiled = _caller(self.function)
        x, y, mean, miss = self._compiled(x0, P, u, self.theta, self.h)
        if not (float(miss[0]) <= self.tol and math.isfinite(float(x.sum()))):
            raise SimulationError(
                f"{self.ss.name}: step from {t0:.6g} s: E_fd moves so fast that a sample of "
                f"{self.h:.3g} s misses it by {float(miss[0]):.1e} > {self.tol:.0e}"
            )
        return x, y, mean

    def times(self, t0: float) -> np.ndarray:
        """Instants of the samples of a step from t0, s."""
        return t0 + self._t

    def result(self, x0: np.ndarray, u: np.ndarray, *, t0: float = 0.0) -> StepResult:
        """Advance one step, returned in the form of a ``Stepper``; ``y`` has the outputs only."""
        x, y, mean = self(x0, u, t0=t0)
        t = self.times(t0)
        means = dict(zip(self.quad, mean.ravel().tolist(), strict=True))
        return StepResult(t, x.reshape(-1, 1).copy(), y.copy(), means, {"nsteps": self.n_out})


_CALLERS: dict[int, tuple[ca.Function, Any]] = {}


def _caller(fun: ca.Function) -> Any:
    """One compiled caller per function; the function is kept, so that its id stays valid."""
    if id(fun) not in _CALLERS:
        _CALLERS[id(fun)] = (fun, Caller(compiled(fun)))
    return _CALLERS[id(fun)][1]


_TABLES: OrderedDict[tuple[Any, ...], tuple[StateSpace, Table]] = OrderedDict()


def _cached_table(
    ss: StateSpace,
    u: np.ndarray,
    theta: np.ndarray,
    h: float,
    w_rated: float,
    n_out: int,
    fine: bool,
) -> Table:
    """Tables are kept by what they depend on: load, noise, fault, sample; not speed, not V_ref."""
    key_u = np.array(u, dtype=float)
    key_u[ss.u.indices(["w_r", "V_ref"])] = 0.0
    key = (id(ss), key_u.tobytes(), theta.tobytes(), round(h, 15), w_rated, n_out, fine)
    if key not in _TABLES:
        _TABLES[key] = (
            ss,
            transition_table(ss, np.array(u, float), theta, h, w_rated, n_out, fine),
        )
        if len(_TABLES) > 256:
            _TABLES.popitem(last=False)
    _TABLES.move_to_end(key)
    return _TABLES[key][1]
