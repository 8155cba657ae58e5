"""Exact propagation of the generator over steps of constant speed.

Inside an exchange step the speed is constant.  With a linear load the windings then obey

    dx/dt = A(theta) x + b(theta) E_fd + c(theta),    theta = theta_0 + w_r t,

in the qd0 frame: constant coefficients for a healthy machine with a balanced load, 2 pi-periodic
ones otherwise.  Only the exciter is not linear, and it is slow.  So the windings need no small
steps: their transition matrix over a sample h,

    x(t + h) = P(theta(t)) [x; E; E'; E''; E'''; 1],     E(t + s) = E + s E' + ... + s^3/6 E''',

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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.backend import backend_in_use, compiled
from apu_casadi.core.calling import Caller
from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.means import Term
from apu_casadi.core.sharing import Rebuilt, keep, kept
from apu_casadi.core.simulation import StepResult
from apu_casadi.machine import exciter as ac5a
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.generatormodel import GeneratorModel

SETTLING = 1e-3  # s, in which the windings follow a step of speed
TAIL = 1e-9  # Fourier coefficients below this share of the largest are left out
STAGES = 8  # of the Radau method that P is made by; even where stiff its error falls as steps^-8
STEP_TOL = 5e-7  # largest change of P, nominal units, when its steps are halved; then used: 2e-9
HARMONICS = (16, 32, 64)  # harmonics resolved, in turn; a series that still goes on is refused
#: Largest error of E_fd, per unit, that the windings may see at the end of an exciter's step; a
#: quarter acts on average.  Where coefficients are constant a larger one tells of a limit met.
DRIVE_TOL = {"constant": 1e-5, "periodic": 1e-5, "fine": 2e-5}
#: Slope of the terminal voltage at the start of a step, over its change in it and its slope at the
#: end, from which on the voltage has moved within far less than the step; 1.3 at rated load.
LAYER = 4.0
EXTRA = 5  # columns of P beside the windings': E, its first three derivatives, and what is constant
SPEED_RANGE = 0.06  # half width, relative to rated, over which P is interpolated in speed
_NODES = 4  # Chebyshev nodes in speed


@dataclass(frozen=True)
class _Split:
    """Positions of the parts of a generator's state."""

    linear: list[int]
    slow: list[int]
    angle: int
    drive: int  # E_fd among all states


def _split(ss: GeneratorModel) -> _Split:
    linear = ss.x.indices(ss.linear)
    angle, drive = ss.x.index("theta_e"), ss.x.index("E_fd")
    slow = [i for i in range(len(ss.x)) if i not in (*linear, angle)]
    return _Split(linear, slow, angle, drive)


@kept
def _coefficients(ss: GeneratorModel) -> ca.Function:
    """Function (theta_e, u, theta) -> augmented matrix M of d/dt [x; E; E'; E''; E'''; 1].

    Checks that the model is linear in x and E where it is taken to be.
    """
    s = _split(ss)
    x, u, th = ca.SX.sym("x", len(ss.x)), ca.SX.sym("u", len(ss.u)), ca.SX.sym("t", len(ss.theta))
    rate = ss.f(x, u, th)[s.linear]
    own = ca.vertcat(x[s.linear], x[s.drive])
    J = ca.jacobian(rate, own)
    if any(ca.which_depends(ca.vec(ca.densify(J)), own, 1, True)):
        raise NotApplicable(f"{ss.name} is not linear in its windings: use another integrator")
    n = len(s.linear)
    rest = ca.substitute(rate, own, ca.SX.zeros(n + 1))
    M = ca.SX.zeros(n + EXTRA, n + EXTRA)
    M[:n, : n + 1] = J
    M[:n, -1] = rest
    for k in range(n, n + EXTRA - 2):
        M[k, k + 1] = 1
    return ca.Function("M", [x[s.angle], u, th], [ca.densify(M)], {"cse": True})


def _radau(stages: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes in (0, 1], the last one 1, and Butcher matrix of a Radau IIA method."""
    c = np.array(ca.collocation_points(stages, "radau"))
    k = np.arange(stages)
    return c, (c[:, None] ** (k + 1) / (k + 1)) @ np.linalg.inv(c[:, None] ** k)


def _transition(
    M_of: Any, theta0: np.ndarray, w: np.ndarray, h: np.ndarray, steps: int, leaps: int = 1
) -> list[np.ndarray]:
    """Transition matrices over h, 2 h, ... from angles theta0 at speeds w, by Radau collocation.

    All three arrays have the shape (angles,).  There are ``steps`` of the method in h, of order 15
    (Hairer, Wanner, Solving ODEs II, section IV.5).  It is L-stable: a fault branch that settles
    within nanoseconds, or an open generator, needs no smaller steps.

    Returns:
        One array for each leap, shape (angles, n, n + EXTRA): the rows of the windings.
    """
    c, a = _radau(STAGES)
    hs, out = h / steps, []
    X = np.empty(0)
    for k in range(leaps * steps):
        t = hs[:, None] * (k + c)
        angles = theta0[:, None] + w[:, None] * t
        M = M_of(angles.ravel(), np.repeat(w, STAGES))
        n = M.shape[1] - EXTRA
        M = M.reshape(theta0.size, STAGES, n + EXTRA, n + EXTRA)[:, :, :n]
        drive = np.zeros((*t.shape, EXTRA, EXTRA))  # E at the nodes from its derivatives; and one
        drive[..., 0, :-1] = np.stack([t**i / math.factorial(i) for i in range(EXTRA - 1)], axis=2)
        drive[..., -1, -1] = 1.0
        if k == 0:
            X = np.broadcast_to(np.eye(n, n + EXTRA), (theta0.size, n, n + EXTRA))
        by_h = hs[:, None, None]
        G = -a[None, :, None, :, None] * M[:, None, :, :, :n].transpose(0, 1, 3, 2, 4)
        G = G.reshape(theta0.size, STAGES, n, STAGES, n).reshape(theta0.size, STAGES * n, -1)
        G = by_h * G + np.eye(STAGES * n)
        rhs = np.repeat(X[:, None], STAGES, axis=1)
        forced = M[..., n:] @ drive
        forced = by_h * (a @ forced.reshape(theta0.size, STAGES, -1))
        rhs[..., n:] += forced.reshape(*t.shape, n, EXTRA)
        X = np.linalg.solve(G, rhs.reshape(theta0.size, STAGES * n, n + EXTRA))[:, -n:]
        if (k + 1) % steps == 0:
            out.append(X)
    return out


@kept
def _coefficients_at(ss: GeneratorModel, count: int) -> Caller:
    """:func:`_coefficients` at ``count`` angles at once."""
    return Caller(compiled(_coefficients(ss).map(count), build=False))


class Parity(NamedTuple):
    """Which entries of a transition matrix repeat after half a turn, and which change their sign.

    Half a turn reverses all phases.  The windings in the rotor's frame do not see that; the zero
    sequence and the fault current, which belong to phases, change their sign.  So entries between
    the two kinds have odd harmonics of the rotor angle only, all others even ones.

    Args:
        sign: 1 or -1 for each linear state, E and its derivatives, 1; shape (n + EXTRA,).
        even, odd: positions of the entries, column by column, one leap after the other.
    """

    sign: np.ndarray
    even: np.ndarray
    odd: np.ndarray


def parity(ss: GeneratorModel, leaps: int) -> Parity:
    """Return the parity of the entries of ``leaps`` transition matrices (:class:`Strides`)."""
    names = ss.linear
    sign = np.array([-1.0 if k in ss.reversing else 1.0 for k in names] + [1.0] * EXTRA)
    one = np.outer(sign, sign[: len(names)]).ravel()  # column by column
    entries = np.tile(one, leaps)
    return Parity(sign, np.flatnonzero(entries > 0), np.flatnonzero(entries < 0))


_PROBE = np.array([0.1, 0.9, 2.3])  # rotor angles, rad, without any symmetry


def _scale(ss: GeneratorModel) -> np.ndarray:
    """Factors that make coefficients of all states comparable, shape (n + EXTRA, n + EXTRA)."""
    nominal = np.append(ss.x.nominals[_split(ss).linear], np.ones(EXTRA))
    return np.asarray(nominal / nominal[:, None])


def _scaled(ss: GeneratorModel, u: np.ndarray, theta: np.ndarray) -> Any:
    """Function (angles, speeds) -> matrices M of :func:`_coefficients` in nominal units."""
    n, iw, scale = len(ss.linear), ss.u.index("w_r"), _scale(ss)

    def M_of(angle: np.ndarray, w: np.ndarray) -> np.ndarray:
        U = np.repeat(u[:, None], angle.size, axis=1)
        U[iw] = w
        TH = np.repeat(theta.reshape(-1, 1), angle.size, axis=1)
        out = _coefficients_at(ss, angle.size)(angle.reshape(1, -1), U, TH)[0]
        return np.asarray(out.reshape(-1, angle.size, n + EXTRA).transpose(1, 0, 2)) * scale

    return M_of


def symmetry(ss: GeneratorModel, u: np.ndarray, theta: np.ndarray, w_rated: float) -> bool:
    """Return whether the coefficients are constant; check that half a turn reverses the phases.

    Raises:
        NotApplicable: it does not, and :class:`Parity` would not hold.
    """
    M = _scaled(ss, u, theta)(np.append(_PROBE, _PROBE + np.pi), np.full(6, w_rated))
    sign = parity(ss, 1).sign
    turned = M[3:] * np.outer(sign, sign) - M[:3]
    largest = np.abs(M).max()
    if np.abs(turned).max() > 1e-9 * largest:
        raise NotApplicable(
            f"{ss.name}: half a turn does not reverse the phases; process noise in the zero "
            "sequence? Use another integrator"
        )
    return bool(np.abs(M - M[0]).max() <= 1e-12 * largest)


@dataclass(frozen=True)
class Table:
    """Transition matrices of one load, fault and sample, as Fourier series in the rotor angle.

    Args:
        centre, half: middle and half width of the speed range, rad/s.
        even, odd: coefficients, for entries of either :class:`Parity`, of cos k theta and sin k
            theta in turn, k = 0, 2, 4, ... and 1, 3, 5, ...; each a polynomial in the relative
            speed (w - centre)/half.  Shape (powers, terms, entries).
        harmonics: number of the highest one; 0 where the angle does not matter, and ``odd`` is
            empty.
        error: largest change, in nominal units, when the steps were halved that it is made by.
    """

    centre: float
    half: float
    even: np.ndarray
    odd: np.ndarray
    harmonics: int
    error: float

    def at(self, w: float) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients at speed w, rad/s: even and odd, shape (terms, entries)."""
        s = (w - self.centre) / self.half
        powers = np.array([1.0, s, s * s, s * s * s])
        even, odd = (
            (powers @ part.reshape(_NODES, -1)).reshape(part.shape[1:])
            for part in (self.even, self.odd)
        )
        return even, odd


def transition_table(
    ss: GeneratorModel,
    u: np.ndarray,
    theta: np.ndarray,
    w_rated: float,
    *,
    h: float | None = None,
    angle: float | None = None,
    leaps: int = 1,
) -> Table:
    """Compute the transition matrices for all rotor angles and nearby speeds.

    Args:
        ss, u, theta: model, inputs and fault parameters; ``w_r`` among the inputs does not matter.
        w_rated: speed in the middle of the table, rad/s.
        h, angle: length of a leap, in s or, at any speed, in rad of the rotor's turn.
        leaps: the matrices are those over one leap, two leaps, and so on, one below the other.

    Raises:
        NotApplicable: the Fourier series or the steps do not converge, or a noise in the zero
            sequence does not change its sign with the phases.
    """
    n = len(ss.linear)
    centre, half = w_rated, SPEED_RANGE * w_rated
    k = np.arange(_NODES)
    nodes = centre + half * np.cos(np.pi * (2 * k + 1) / (2 * _NODES))
    to_powers = np.linalg.inv(np.vander((nodes - centre) / half, _NODES, increasing=True))
    M_of = _scaled(ss, u, theta)
    constant, kinds = symmetry(ss, u, theta, w_rated), parity(ss, leaps)

    def length(w: np.ndarray) -> np.ndarray:
        return angle / w if angle is not None else np.full(w.shape, h)

    # the number of steps is doubled until the probes agree, then used for all angles
    steps, error = 1, math.inf
    probe = _PROBE[:1] if constant else _PROBE
    slowest = np.full(probe.size, nodes.min())
    last = _transition(M_of, probe, slowest, length(slowest), steps)[0]
    while error > STEP_TOL:
        if steps >= 64:
            raise NotApplicable(
                f"{ss.name}: transition matrices over {length(slowest)[0]:.3g} s do not converge "
                f"(error {error:.1e} with {steps} steps)"
            )
        new = _transition(M_of, probe, slowest, length(slowest), 2 * steps)[0]
        error = float(np.abs(new - last).max())
        steps, last = 2 * steps, new

    def sampled(angles: np.ndarray) -> np.ndarray:
        """Entries in nominal units, column by column, leap after leap: (nodes, angles, entries)."""
        a, w = np.tile(angles, _NODES), np.repeat(nodes, angles.size)
        P = np.stack(_transition(M_of, a, w, length(w), steps, leaps), axis=1)
        return P.transpose(0, 1, 3, 2).reshape(_NODES, angles.size, -1)

    units = np.tile((1 / _scale(ss)[:n]).T.ravel(), leaps)

    def powers(series: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Polynomials in speed from values at the nodes, shape (nodes, terms, entries); in SI."""
        return np.tensordot(to_powers, series, 1) * units[which]

    if constant:
        P = sampled(np.zeros(1))
        none = np.zeros((_NODES, 0, kinds.odd.size))
        return Table(centre, half, powers(P[:, :, kinds.even], kinds.even), none, 0, error)
    turn = np.ones(kinds.even.size + kinds.odd.size)
    turn[kinds.odd] = -1.0
    for resolved in HARMONICS:
        P = sampled(np.pi * np.arange(resolved) / resolved)
        F = np.fft.rfft(np.concatenate([P, P * turn], axis=1), axis=1) / (2 * resolved)
        size = np.abs(F).max(axis=(0, 2))
        highest = int(np.nonzero(size > TAIL * size.max())[0][-1])
        if highest < resolved - 1:
            break
    else:
        raise NotApplicable(
            f"{ss.name}: the transition matrix over {length(nodes)[0]:.3g} s has over {highest} "
            f"harmonics of the rotor angle above {TAIL:g}: the load is too light for this step"
        )

    def series(first: int, which: np.ndarray) -> np.ndarray:
        part = F[:, first : highest + 1 : 2, which]
        pairs = np.stack([2 * part.real, -2 * part.imag], axis=2)
        if first == 0:
            pairs[:, 0] /= 2
        return powers(pairs.reshape(_NODES, -1, which.size), which)

    even, odd = series(0, kinds.even), series(1, kinds.odd)
    return Table(centre, half, even, odd, highest, error)


def through(first: int, count: int) -> np.ndarray:
    """Polynomials that are one at one of ``count`` integers from ``first``, zero at the others.

    Row i has the coefficients of 1, x, x^2, ... of the i-th; shape (count, count).
    """
    x = np.arange(first, first + count, dtype=float)
    return np.asarray(np.linalg.inv(np.vander(x, increasing=True)).T)


def end_weights(count: int) -> np.ndarray:
    """Weights of the first samples in an integral that goes on evenly; one afterwards.

    Each interval is integrated by the polynomial through the ``count`` samples around it, the
    first few by that through the first ``count`` samples.
    """
    k, near = np.arange(count), count // 2
    polynomials = through(1 - near, count)
    middle = polynomials @ (1 / (k + 1))
    weights = -polynomials @ ((1.0 - near) ** (k + 1) / (k + 1))
    for i in range(count):
        weights[i:] += middle[: count - i]
    return np.asarray(weights)


def gregory(n: int) -> np.ndarray:
    """Weights, shape (n + 1,), of a mean over n equal intervals: trapezoids, ends corrected.

    The ends are of order ten, or six where there are fewer than 19 intervals.  For what ripples
    periodically the trapezoidal rule inside is spectrally accurate, which Simpson's is not.
    """
    w = np.ones(n + 1)
    if n >= 19:
        ends = end_weights(10)
    else:
        ends = np.array([95 / 288, 317 / 240, 23 / 30, 793 / 720, 157 / 160])
    w[: ends.size], w[-ends.size :] = ends, ends[::-1]
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


@kept
def exciter_step(gen: Generator, ss: GeneratorModel) -> tuple[ca.Function, ca.Function]:
    """The exciter's drive and its step, of the states that are neither windings nor angle.

    First: (slow, V_t, V_ref) -> (E, E', E'', E''').  Second, by the classical Runge-Kutta method:
    (slow, V_t at start, middle and end, V_ref, length in s) -> slow at the end.
    """
    p, e = gen.machine, gen.exciter
    names = [ss.x.names[i] for i in _split(ss).slow]
    slow, V = ca.SX.sym("slow", len(names)), ca.SX.sym("V", 3)
    V_ref, H = ca.SX.sym("V_ref"), ca.SX.sym("H")

    def rates(slow: Any, V_t: Any) -> Any:
        state = ac5a.ExciterState(**dict(zip(names, ca.vertsplit(slow), strict=True)))
        d = ac5a.exciter_rates(e, state, V_t=V_t / p.V_rated_rms, V_ref=V_ref)
        return ca.vertcat(*(getattr(d, k) for k in names))

    k1 = rates(slow, V[0])
    E = names.index("E_fd")
    derivatives = [slow[E]]
    for _ in range(EXTRA - 2):
        derivatives.append(ca.jtimes(derivatives[-1], slow, k1))
    drive = ca.Function("drive", [slow, V[0], V_ref], [ca.vertcat(*derivatives)])
    k2 = rates(slow + H / 2 * k1, V[1])
    k3 = rates(slow + H / 2 * k2, V[1])
    k4 = rates(slow + H * k3, V[2])
    end = slow + H / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return drive, ca.Function("exciter", [slow, V, V_ref, H], [end])


@kept
def leap(
    gen: Generator, ss: GeneratorModel, m: int, constant: bool, chained: bool = False
) -> tuple[ca.Function, ca.Function]:
    """One step of the exciter over m samples, and the terminal voltage with its rate.

    First: (x, V, P, u, theta, h) -> (x at the m samples, V at the end); V holds the terminal
    voltage, its rate, and the largest error of the drive so far; P the even and then the odd
    entries of the transition matrices (:class:`Parity`), the even ones only where ``constant``.
    These are matrices over one sample, two samples and so on, or, ``chained``, from each sample to
    the next.  Second: (x, u, theta) -> (V_t, dV_t/dt).
    """
    p, s, n = gen.machine, _split(ss), len(ss.linear)
    nx, nu, nt = len(ss.x), len(ss.u), len(ss.theta)
    x, u, th = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("t", nt)
    V_t = ss.g(x, u, th)[ss.y.index("V_t")]
    V_dot = ca.jtimes(V_t, x, ss.f(x, u, th))
    if constant:  # nothing depends on the rotor angle; spare its cosines
        V_t, V_dot = ca.substitute([V_t, V_dot], [x[s.angle]], [ca.SX(0)])
    V_of = ca.Function("V_of", [x, u, th], [V_t, V_dot])

    drive, exciter = exciter_step(gen, ss)
    kinds = parity(ss, m)
    h, V = ca.SX.sym("h"), ca.SX.sym("V", 3)
    P = ca.SX.sym("P", kinds.even.size + (0 if constant else kinds.odd.size))
    size = n * (n + EXTRA)
    entries = ca.SX(m * size, 1)  # without harmonics the odd ones are zero
    entries[kinds.even] = P[: kinds.even.size]
    if not constant:
        entries[kinds.odd] = P[kinds.even.size :]
    u_d = ss.u.unpack(u)
    slow = x[s.slow]
    E = ca.vertsplit(drive(slow, V[0], u_d["V_ref"]))

    def E_at(t: Any, derivative: int = 0) -> Any:
        return sum(e * t**i / math.factorial(i) for i, e in enumerate(E[derivative:]))

    start = ca.vertcat(x[s.linear], *E, 1)
    samples = []
    for j in range(m):
        t = (j + 1) * h
        block = ca.reshape(entries[j * size : (j + 1) * size], n, n + EXTRA)
        x_j = ca.SX(nx, 1)
        x_j[s.slow] = slow  # only the drive enters outputs between the exciter's steps
        x_j[s.linear], x_j[s.angle] = ca.mtimes(block, start), x[s.angle] + t * u_d["w_r"]
        x_j[s.drive] = E_at(t)
        samples.append(x_j)
        if chained:
            start = ca.vertcat(x_j[s.linear], *(E_at(t, i) for i in range(len(E))), 1)
    end, H = samples[-1], m * h
    # Under a fault the terminal voltage ripples with twice the frequency: a straight line would cut
    # that by 1 %.  In the middle it is that of a sample, or, where there is none, of the cubic
    # through values and rates at both ends.
    if m % 2:
        V1, V1_dot = V_of(end, u, th)
        Vm = (V[0] + V1) / 2 + H / 8 * (V[1] - V1_dot)
        V0 = V[0]
        if constant:
            # Under a light load a new speed moves the voltage within L''/R, far less than H: the
            # slope at the start then says nothing of what follows, a straight line to the end.
            change = ca.fabs(V1 - V[0]) + H * ca.fabs(V1_dot) + 1e-9 * p.V_rated_rms
            layer = H * ca.fabs(V[1]) > LAYER * change
            V0 = ca.if_else(layer, V1 - H * V1_dot, V0)
            Vm = ca.if_else(layer, V1 - H / 2 * V1_dot, Vm)
    else:
        V1, V1_dot = V_of(end, u, th)[0], ca.SX.nan()  # the rate is not needed
        V0, Vm = V[0], V_of(samples[m // 2 - 1], u, th)[0]
    E_taken = end[s.drive]
    end[s.slow] = exciter(slow, ca.vertcat(V0, Vm, V1), u_d["V_ref"], H)
    miss = ca.fmax(V[2], ca.fabs(end[s.drive] - E_taken))
    one = ca.Function(
        "leap",
        [x, V, P, u, th, h],
        [ca.horzcat(*samples[:-1], end), ca.vertcat(V1, V1_dot, miss)],
        {"cse": True},
    )
    return one, V_of


def _fold(step: ca.Function, steps: int, n_P: Sequence[int], constant: bool,
          sizes: tuple[int, int, int]) -> ca.Function:  # fmt: skip
    """``steps`` steps of the exciter: (start, P) -> (start of the next, x at all samples).

    ``start`` holds x, V and what stays; ``P`` is one matrix of even entries where ``constant``,
    else one of even and one of odd ones, with ``n_P`` rows.  A few steps are unrolled, which
    spares copies.
    """
    nx, nu, nt = sizes
    size = next(k for k in (5, 4, 2, 1) if steps % k == 0)
    x, u, th = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("t", nt)
    h, V = ca.SX.sym("h"), ca.SX.sym("V", 3)
    P = [ca.SX.sym("P", n, 1 if constant else size) for n in n_P]
    xk, Vk, states = x, V, []
    for k in range(size):
        X, Vk = step(xk, Vk, ca.vertcat(*(p if constant else p[:, k] for p in P)), u, th, h)
        xk = X[:, -1]
        states.append(X)
    fixed = [u, th, h, *(P if constant else [])]
    group = ca.Function(
        "group",
        [ca.vertcat(x, V, *fixed), *([] if constant else P)],
        [ca.vertcat(xk, Vk, *fixed), ca.horzcat(*states)],
        {"cse": True},
    )
    run = group.mapaccum("run", steps // size, 1)
    S = ca.MX.sym("S", nx + 3 + nu + nt + 1)
    PP = [ca.MX.sym("P", n, 1 if constant else steps) for n in n_P]
    last, X_all = run(ca.vertcat(S, *PP)) if constant else run(S, *PP)
    return ca.Function("fold", [S, *PP], [last[: S.numel(), steps // size - 1], X_all])


@kept
def _advance(
    gen: Generator,
    ss: GeneratorModel,
    n_out: int,
    plan: Strides,
    outputs: tuple[str, ...],
    quad: tuple[str, ...],
    constant: bool,
) -> ca.Function:
    """n_out samples at once: (x0, P, u, theta, h) -> (x, y, mean, miss).

    Where ``constant``, ``P`` is one column of even transition matrix entries for the whole step;
    else there are P and Q, the even and the odd ones, with one column for each step of the
    exciter.  Means by :func:`gregory`.
    """
    nx, nu, nt = len(ss.x), len(ss.u), len(ss.theta)
    X0, U, TH, H = ca.MX.sym("x0", nx), ca.MX.sym("u", nu), ca.MX.sym("th", nt), ca.MX.sym("h")
    one, all_ = parity(ss, 1), parity(ss, plan.m)
    kinds = ("even",) if constant else ("even", "odd")
    rows = {m: [getattr(p, k).size for k in kinds] for m, p in ((1, one), (plan.m, all_))}
    columns = 1 if constant else plan.head + plan.many
    PP = [ca.MX.sym(k, n, columns) for k, n in zip("PQ", rows[plan.m], strict=False)]
    single, V_of = leap(gen, ss, 1, constant)
    S = ca.vertcat(X0, *V_of(X0, U, TH), 0, U, TH, H)
    parts = []
    if plan.head:
        fold = _fold(single, plan.head, rows[1], constant, (nx, nu, nt))
        first = [p[:n, : (1 if constant else plan.head)] for p, n in zip(PP, rows[1], strict=True)]
        S, X = fold(S, *first)
        parts.append(X)
    if plan.many:
        long, _ = leap(gen, ss, plan.m, constant)
        fold = _fold(long, plan.many, rows[plan.m], constant, (nx, nu, nt))
        S, X = fold(S, *(p if constant else p[:, plan.head :] for p in PP))
        parts.append(X)
    X_all, miss = ca.horzcat(*parts), S[nx + 2]
    # outputs and means
    xo, uo, to = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("t", nt)
    y, share = ss.g(xo, uo, to), ca.SX.sym("share")
    terms = [Term.of(q).expression(ss, xo, y, share) for q in quad]
    wanted = ca.vertcat(*(y[ss.y.index(k)] for k in outputs), *terms)
    # an empty input mapped over samples makes C code that newer compilers refuse
    held, HELD = ([uo, to], [U, TH]) if nt else ([uo], [U])
    out = ca.Function("out", [xo, share, *held], [wanted], {"cse": True})
    w, shares = gregory(n_out), ca.DM(np.arange(1, n_out + 1) / n_out).T
    y0 = out(X0, 0.0, *HELD)
    Y = out.map("outs", "serial", n_out, list(range(2, 2 + len(held))), [])(X_all, shares, *HELD)
    k = len(outputs)
    means = y0[k:] * w[0] + ca.mtimes(Y[k:, :], ca.DM(w[1:]))
    return ca.Function(
        f"advance_{ss.name}_{n_out}" + ("" if plan.many else "_fine"),
        [X0, *PP, U, TH, H],
        [X_all[:, n_out - 1], Y[:k, :], means, miss],
        ["x0", *(p.name() for p in PP), "u", "theta", "h"],
        ["x", "y", "mean", "miss"],
    )


@kept
def _at_any_speed(function: ca.Function, at: int, n_out: int, entries: int) -> ca.Function:
    """A function of :func:`_advance` for constant coefficients that takes the table itself.

    (x0, series with middle and half width of the speed range, u, dt) -> (x, y, mean, miss); the
    speed is input ``at``.
    """
    X0, U = ca.MX.sym("x0", function.numel_in("x0")), ca.MX.sym("u", function.numel_in("u"))
    series, dt = ca.MX.sym("series", _NODES * entries + 2), ca.MX.sym("dt")
    w = U[at]
    s = (w - series[-2]) / series[-1]
    powers = ca.vertcat(1, s, s**2, s**3)
    P = ca.mtimes(ca.reshape(series[:-2], entries, _NODES), powers)
    out = function(X0, P, U, ca.DM(0, 1), dt / n_out)
    return ca.Function(f"{function.name()}_series", [X0, series, U, dt], list(out))


class Propagator(Rebuilt):
    """Steps of one model variant with one load and fault; a fast stand-in for a ``Stepper``.

    Args:
        gen, ss: generator and its model variant (:meth:`Generator.variant`).
        u, theta: inputs and fault parameters; only w_r, V_ref and noise may change afterwards.
        n_out: samples in a step, at least 10.
        dt: length of every step, s.
        outputs: outputs to be returned at the samples.
        quad: what is averaged over the step, see :mod:`apu_casadi.core.means`.
        fine: the exciter steps at every sample; for the steps that the usual strides refuse.

    Raises:
        NotApplicable: the model is not linear in its windings, or the series does not converge;
            use :func:`apu_casadi.core.simulation.stepper` there.
    """

    def __init__(
        self,
        gen: Generator,
        ss: GeneratorModel,
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
        if not ss.linear:
            raise NotApplicable(f"{ss.name}: its load is not linear")
        if n_out < 10:
            raise NotApplicable(f"{ss.name}: at least 10 samples are needed, got {n_out}")
        self.ss, self.n_out, self.dt = ss, n_out, dt
        self.outputs, self.quad = tuple(outputs), tuple(quad)
        self.h = dt / n_out
        self.theta = np.array(theta, dtype=float)
        w_rated = gen.machine.w_rated
        self.constant = constant = symmetry(ss, u, self.theta, w_rated)
        plan = strides(n_out, self.h, constant, fine)
        self.table = cached_table(ss, u, self.theta, w_rated, h=self.h, leaps=plan.m)
        self.function = _advance(gen, ss, n_out, plan, self.outputs, self.quad, constant)
        self.tol = DRIVE_TOL["fine" if fine else "constant" if constant else "periodic"]
        self.limits = np.array([self.tol])
        self.layout = (gen, ss, plan, self.outputs, self.quad)  # what ``function`` depends on
        self._compiled: Caller | None = None
        self._call_key = (gen, ss, n_out, plan, self.outputs, self.quad, constant)
        self._t = dt * (np.arange(1, n_out + 1) / n_out)  # rounded as a Stepper does
        self._angle = ss.x.index("theta_e")
        self._iw = ss.u.index("w_r")
        self._w_ok = (1 - SPEED_RANGE) * w_rated, (1 + SPEED_RANGE) * w_rated
        self._starts = self.h * plan.starts()
        # powers of exp(j theta), columns as in Table: 0, 2, 4, ... and 1, 3, 5, ...
        self._powers = tuple(s.shape[1] // 2 for s in (self.table.even, self.table.odd))

    @property
    def advance(self) -> ca.Function:
        """Function (x0, series, u, dt) -> (x, y, mean, miss), for constant coefficients."""
        return _at_any_speed(self.function, self._iw, self.n_out, self.table.even[0].size)

    @property
    def parameters(self) -> np.ndarray:
        """What :attr:`advance` takes as ``series``."""
        return np.append(self.table.even.ravel(), [self.table.centre, self.table.half])

    def valid(self, w_r: float) -> bool:
        """Whether the speed, rad/s electrical, lies in the range of the table."""
        return self._w_ok[0] <= w_r <= self._w_ok[1]

    def __call__(
        self, x0: np.ndarray, u: np.ndarray, *, t0: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance one step.

        Returns:
            State at the end, outputs at the samples of shape (outputs, n_out), and means.  The
            arrays are overwritten by the thread's next call.

        Raises:
            NotApplicable: the exciter moves too fast for the samples, a result is not finite, or
                the speed is outside the table; use a ``Stepper`` for this step.
        """
        w = float(u[self._iw])
        if not self.valid(w):
            raise NotApplicable(
                f"{self.ss.name}: w_r = {w:.6g} rad/s is outside the table's "
                f"[{self._w_ok[0]:.6g}, {self._w_ok[1]:.6g}]"
            )
        even, odd = self.table.at(w)
        call = self._compiled
        if call is None:  # a run in blocks may never need it
            call = self._compiled = _caller(*self._call_key, backend_in_use())
        if self.constant:
            x, y, mean, miss = call(x0, even, u, self.theta, self.h)
        else:
            z = np.exp(1j * (float(x0[self._angle]) + w * self._starts))
            # this call's own, since threads may share the object
            E, O = (np.ones((z.size, n), complex) for n in self._powers)
            E[:, 1] = z * z
            known = 2
            while known < E.shape[1]:  # powers by doubling: fewer, longer operations
                more = E[:, known : 2 * known]
                top = E[:, known - 1, None] * E[:, 1, None]
                np.multiply(E[:, : more.shape[1]], top, out=more)
                known *= 2
            np.multiply(E[:, : O.shape[1]], z[:, None], out=O)
            # one row for each step of the exciter is one column of the compiled function's input
            _, P, Q, *_ = call.inputs
            np.matmul(E.view(float), even, out=P.T)
            np.matmul(O.view(float), odd, out=Q.T)
            x, y, mean, miss = call(x0, P, Q, u, self.theta, self.h)
        if not (float(miss[0]) <= self.tol and math.isfinite(float(x.sum()))):
            raise NotApplicable(
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


@kept
def _caller(gen: Generator, ss: GeneratorModel, n_out: int, plan: Strides, outputs: tuple[str, ...],
            quad: tuple[str, ...], constant: bool, _in_use: str) -> Caller:  # fmt: skip
    """Function of :func:`_advance` in the backend in use, one for each layout."""
    fun = _advance(gen, ss, n_out, plan, outputs, quad, constant)
    return Caller(compiled(fun, level=3), copy=False)


def cached_table(
    ss: GeneratorModel,
    u: np.ndarray,
    theta: np.ndarray,
    w_rated: float,
    *,
    h: float | None = None,
    angle: float | None = None,
    leaps: int = 1,
) -> Table:
    """Return a table of :func:`transition_table`, kept by all that it depends on."""
    key_u = np.array(u, dtype=float)
    key_u[ss.u.indices(["w_r", "V_ref"])] = 0.0
    length = (None if h is None else round(h, 15), angle)
    key = (key_u.tobytes(), theta.tobytes(), *length, w_rated, leaps)
    return keep(
        ss, Table, key,
        lambda: transition_table(ss, key_u, theta, w_rated, h=h, angle=angle, leaps=leaps),
        locked=False,
    )  # fmt: skip
