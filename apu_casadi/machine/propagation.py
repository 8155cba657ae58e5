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
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.backend import Gradual, backend_in_use
from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.hoisting import hoisted
from apu_casadi.core.means import Term, window
from apu_casadi.core.sharing import Rebuilt, kept
from apu_casadi.core.simulation import StepResult
from apu_casadi.machine.exciterstep import exciter_of, kick
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.loads.load import V_RATED
from apu_casadi.machine.settling import UNEVEN, Begun
from apu_casadi.machine.transition import (
    EXTRA,
    NODES,
    SPEED_RANGE,
    Table,
    cached_table,
    fastest,
    nominal_entries,
    parity,
    ripple,
    split,
    symmetry,
)
from apu_casadi.machine.weights import gregory

SETTLING = 1e-3  # s, in which the windings follow a step of speed
#: Largest error of E_fd, per unit, that the windings may see at the end of an exciter's step; a
#: quarter acts on average.  Where coefficients are constant a larger one tells of a limit met.
DRIVE_TOL = {"constant": 1e-5, "periodic": 1e-5, "fine": 2e-5}
#: Slope of the terminal voltage at the start of a step, over its change in it and its slope at the
#: end, from which on the voltage has moved within far less than the step; 1.3 at rated load.
LAYER = 4.0
#: Rate of the fastest winding times a sample, from which on the slope of the terminal voltage has
#: no digits left: beside an open phase it is 9000, and a table right to 2e-9 errs in it by 2e-5
#: of the voltage in each sample.
LOST = 1e3
#: Harmonics of the transition matrices over a sample from the third on, nominal units, from which
#: on two of half the length are needed: with one, what means, and what the exciter sees, errs by
#: 5e-7.
RIPPLE = 2.2e-2
#: Rate of the fastest winding times a sample, from which on two, or four, are needed where a load
#: or a fault changes in every step.
LIGHT = {2: 4.0, 4: 12.0}


class Strides(NamedTuple):
    """How the exciter steps through the samples: ``head`` single ones, then ``many`` of ``m``.

    A new speed at the start of a step lets the terminal voltage jump and settle within a
    millisecond, which single samples resolve.  After that, where nothing ripples, the exciter can
    take five samples at once; under a fault its drive follows the ripple of the terminal voltage
    and two are right, from the start, by Simpson's rule.  ``fine`` is single samples throughout:
    while a regulator limit is met or left, say (``DRIVE_TOL`` tells).
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
    m, head = (5, min(n_out, math.ceil(SETTLING / h))) if constant else (2, 0)
    head += (n_out - head) % m
    return Strides(head, m, (n_out - head) // m)


def seen_at_start(ss: GeneratorModel, V: tuple[Any, Any], x: Any, u: Any, theta: Any) -> Any:
    """What the first of :func:`leap` takes as ``V``, of the terminal voltage and its rate."""
    slow, V_ref = x[split(ss).slow], u[ss.u.index("V_ref")]
    return ca.vertcat(*V, 0, exciter_of(ss).exponentials(slow, V_ref, theta))


@kept
def leap(
    ss: GeneratorModel, m: int, constant: bool, chained: bool = False
) -> tuple[ca.Function, ca.Function]:
    """One step of the exciter over m samples, and the terminal voltage with its rate.

    First: (x, V, P, u, theta, h) -> (x at the m samples, V at the end); V holds the terminal
    voltage, its rate, the largest error of the drive so far, and the exponentials of
    :class:`Exciter`; P the even and then the odd
    entries of the transition matrices (:class:`Parity`), the even ones only where ``constant``.
    These are matrices over one sample, two samples and so on, or, ``chained``, from each sample to
    the next.  Second: (x, u, theta) -> (V_t, dV_t/dt).
    """
    s, n = split(ss), len(ss.linear)
    nx, nu, nt = len(ss.x), len(ss.u), len(ss.theta)
    x, u, th = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("t", nt)
    V_t = ss.g(x, u, th)[ss.y.index("V_t")]
    V_dot = ca.jtimes(V_t, x, ss.f(x, u, th))
    if constant:  # nothing depends on the rotor angle; spare its cosines
        V_t, V_dot = ca.substitute([V_t, V_dot], [x[s.angle]], [ca.SX(0)])
    V_of = ca.Function("V_of", [x, u, th], [V_t, V_dot])

    exciter, kinds = exciter_of(ss), parity(ss, m)
    h, V = ca.SX.sym("h"), ca.SX.sym("V", 3 + exciter.exps)
    P = ca.SX.sym("P", kinds.even.size + (0 if constant else kinds.odd.size))
    size = n * (n + EXTRA)
    entries = ca.SX(m * size, 1)  # without harmonics the odd ones are zero
    entries[kinds.even] = P[: kinds.even.size]
    if not constant:
        entries[kinds.odd] = P[kinds.even.size :]
    u_d = ss.u.unpack(u)
    slow, e, held = x[s.slow], V[3:], (u_d["V_ref"], th)
    E = ca.vertsplit(exciter.at((slow, V[0], *held), e)[1])

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
            change = ca.fabs(V1 - V[0]) + H * ca.fabs(V1_dot) + 1e-9 * V_RATED
            layer = H * ca.fabs(V[1]) > LAYER * change
            V0 = ca.if_else(layer, V1 - H * V1_dot, V0)
            Vm = ca.if_else(layer, V1 - H / 2 * V1_dot, Vm)
    else:
        V1, V1_dot = V_of(end, u, th)[0], ca.SX.nan()  # the rate is not needed
        V0, Vm = V[0], V_of(samples[m // 2 - 1], u, th)[0]
    E_taken = end[s.drive]
    k1, _ = exciter.at((slow, V0, *held), e)
    end[s.slow], e, far = exciter.step((slow, k1, e), (Vm, V1), held, H)
    miss = ca.fmax(V[2], ca.fabs(end[s.drive] - E_taken)) + far
    one = ca.Function(
        "leap",
        [x, V, P, u, th, h],
        [ca.horzcat(*samples[:-1], end), ca.vertcat(V1, V1_dot, miss, e)],
        {"cse": True},
    )
    return one, V_of


def _fold(
    step: ca.Function,
    steps: int,
    n_P: Sequence[int],
    constant: bool,
    sizes: tuple[int, int, int, int],
) -> ca.Function:
    """``steps`` steps of the exciter: (start, P) -> (start of the next, x at all samples).

    ``start`` holds x, V and what stays; ``P`` is one matrix of even entries where ``constant``,
    else one of even and one of odd ones, with ``n_P`` rows; ``sizes`` are those of x, V, u and
    theta.  A few steps are unrolled, which
    spares copies.
    """
    nx, nV, nu, nt = sizes
    size = next(k for k in (5, 4, 2, 1) if steps % k == 0)
    x, u, th = ca.SX.sym("x", nx), ca.SX.sym("u", nu), ca.SX.sym("t", nt)
    h, V = ca.SX.sym("h"), ca.SX.sym("V", nV)
    P = [ca.SX.sym("P", n, 1 if constant else size) for n in n_P]
    xk, Vk, states = x, V, []
    for k in range(size):
        X, Vk = step(xk, Vk, ca.vertcat(*(p if constant else p[:, k] for p in P)), u, th, h)
        xk = X[:, -1]
        states.append(X)
    outputs = [xk, Vk, ca.horzcat(*states)]
    inner, before = hoisted("group", [x, V, *P], ca.vertcat(u, th, h), outputs)
    d = ca.SX.sym("d", before.numel_out(0))
    fixed = [d, *(P if constant else [])]
    xk, Vk, X = inner(x, V, *P, d)
    group = ca.Function(
        "group",
        [ca.vertcat(x, V, *fixed), *([] if constant else P)],
        [ca.vertcat(xk, Vk, *fixed), X],
        {"cse": True},
    )
    run = group.mapaccum("run", steps // size, 1)
    own = nx + nV
    S = ca.MX.sym("S", own + nu + nt + 1)
    PP = [ca.MX.sym("P", n, 1 if constant else steps) for n in n_P]
    start = ca.vertcat(S[:own], before(S[own:]))
    last, X_all = run(ca.vertcat(start, *PP)) if constant else run(start, *PP)
    end = ca.vertcat(last[:own, steps // size - 1], S[own:])
    return ca.Function("fold", [S, *PP], [end, X_all])


@kept
def _advance(
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
    single, V_of = leap(ss, 1, constant)
    first_x, seen, held = X0, V_of(X0, U, TH), (U, TH)
    enough = n_out > UNEVEN.size
    if enough:
        first_x, seen = Begun(ss, constant, bool(plan.head)).start(V_of, X0, held, H)
    V0 = seen_at_start(ss, seen, X0, U, TH)
    S, sizes = ca.vertcat(X0, V0, U, TH, H), (nx, V0.numel(), nu, nt)
    parts = []
    if plan.head:
        fold = _fold(single, plan.head, rows[1], constant, sizes)
        first = [p[:n, : (1 if constant else plan.head)] for p, n in zip(PP, rows[1], strict=True)]
        S, X = fold(S, *first)
        parts.append(X)
    if plan.many:
        long, _ = leap(ss, plan.m, constant)
        fold = _fold(long, plan.many, rows[plan.m], constant, sizes)
        S, X = fold(S, *(p if constant else p[:, plan.head :] for p in PP))
        parts.append(X)
    X_all, miss = ca.horzcat(*parts), S[nx + 2]
    end, beyond = X_all[:, n_out - 1], []
    if enough and not constant:
        last, impulse = Begun(ss, constant, not plan.many).end(V_of, end, held, H)
        beyond, at = [end, last], split(ss).slow
        moved = kick(ss)(end[at], S[nx], U[ss.u.index("V_ref")], TH) * impulse
        end = ca.MX(end)
        end[at] += moved
    Y, means = _observed(ss, outputs, quad, (first_x, X_all, beyond), ca.vertcat(U, TH))
    return ca.Function(
        f"advance_{ss.name}_{n_out}" + ("" if plan.many else "_fine"),
        [X0, *PP, U, TH, H],
        [end, Y, means, miss],
        ["x0", *"PQ"[: len(PP)], "u", "theta", "h"],
        ["x", "y", "mean", "miss"],
    )


_TOGETHER = 20  # samples that are summed at once


def _observed(
    ss: GeneratorModel,
    outputs: Sequence[str],
    quad: Sequence[str],
    states: tuple[Any, Any, Sequence[Any]],
    fixed: Any,
) -> tuple[Any, Any]:
    """Return outputs at the samples, and means over the step by :func:`gregory`.

    Args:
        states: at the start, at the samples, and two of which the means get the difference.
    """
    start, samples, beyond = states
    x, u, th = (ca.SX.sym(k, len(s)) for k, s in zip("xut", (ss.x, ss.u, ss.theta), strict=True))
    y, weight = ss.g(x, u, th), ca.SX.sym("weight", 2)  # of plain means, and of weighted ones
    terms = [
        q._replace(weighted=False).expression(ss, x, y, None) * weight[int(q.weighted)]
        for q in map(Term.of, quad)
    ]
    waves = ca.vertcat(ca.SX(0, 1), *(y[ss.y.index(k)] for k in outputs))
    each = [waves, ca.vertcat(ca.SX(0, 1), *terms)]
    out, before = hoisted("out", [x, weight], ca.vertcat(u, th), each)
    n, d = samples.shape[1], before(fixed)
    w, light = gregory(n), window(np.arange(n + 1) / n)
    weights = ca.DM(np.array([w, w * light]))
    means, Y = out(start, weights[:, 0], d)[1], []
    if beyond:
        of_end, of_more = (out(state, weights[:, n], d)[1] for state in beyond)
        means = means + of_end - of_more
    sums = dict[int, Any]()
    for k in range(0, n, _TOGETHER):
        size = min(_TOGETHER, n - k)
        at = weights[:, k + 1 : k + 1 + size]
        of_some, some = out.map(f"outs_{ss.name}_{n}_{size}", "serial", size, [2], [])(
            samples[:, k : k + size], at, d
        )
        sums[size] = sums[size] + some if size in sums else some
        Y.append(of_some)
    for some in sums.values():
        means = means + ca.sum2(some)
    return ca.horzcat(*Y), means


@kept
def _at_any_speed(function: ca.Function, at: int, n_out: int, entries: int) -> ca.Function:
    """A function of :func:`_advance` for constant coefficients that takes the table itself.

    (x0, series with middle and half width of the speed range, u, theta, dt) -> (x, y, mean, miss);
    the speed is input ``at``.
    """
    X0, U, TH = (ca.MX.sym(k, function.numel_in(k)) for k in ("x0", "u", "theta"))
    series, dt = ca.MX.sym("series", NODES * entries + 2), ca.MX.sym("dt")
    w = U[at]
    s = (w - series[-2]) / series[-1]
    powers = ca.vertcat(1, *(s**k for k in range(1, NODES)))
    P = ca.mtimes(ca.reshape(series[:-2], entries, NODES), powers)
    out = function(X0, P, U, TH, dt / n_out)
    return ca.Function(f"{function.name()}_series", [X0, series, U, TH, dt], list(out))


def parts(
    gen: Generator, ss: GeneratorModel, given: tuple[np.ndarray, np.ndarray], h: float, moves: bool
) -> int:
    """Return in how many samples one of the length h, s, is to be parted.

    Args:
        gen, ss: generator and its model variant.
        given: u and theta.
        moves: whether load or fault change from step to step.
    """
    u, theta, w = *given, gen.machine.w_rated
    if not ss.linear:
        return 1
    fast = h * fastest(ss, u, theta, w) if moves else 0.0
    most = max((n for n, limit in LIGHT.items() if fast > limit), default=1)
    if symmetry(ss, u, theta, w):
        return most
    table = cached_table(ss, u, theta, w, h=h, leaps=strides(0, h, False, False).m)
    return max(most, 2) if ripple(ss, table, 3) > RIPPLE else most


class Propagator(Rebuilt):
    """Steps of one model variant with one load and fault; a fast stand-in for a ``Stepper``.

    Args:
        gen, ss: generator and its model variant (:meth:`Generator.variant`); units that differ in
            numbers alone share all that is compiled.
        u, theta: inputs and fault parameters; only w_r, V_ref and noise may change afterwards.
        n_out: samples in a step, at least 10.
        dt: length of every step, s.
        outputs: outputs to be returned at the samples.
        quad: what is averaged over the step, see :mod:`apu_casadi.core.means`.
        fine: the exciter steps at every sample; for the steps that the usual strides refuse.
        harmonics: of the rotor angle, at least so many.

    Raises:
        NotApplicable: the model is not linear in its windings, the series does not converge, or
            ``fine`` where a phase is open or a branch as stiff; use
            :func:`apu_casadi.core.simulation.stepper` there.
    """

    ss: GeneratorModel
    n_out: int
    dt: float
    outputs: tuple[str, ...]
    quad: tuple[str, ...]
    h: float
    theta: np.ndarray
    constant: bool
    table: Table
    layout: tuple[Any, ...]
    function: Any
    tol: float
    limits: np.ndarray

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
        harmonics: int = 0,
    ) -> None:
        """Compute or fetch the table, build or fetch the functions."""
        if not ss.linear:
            raise NotApplicable(f"{ss.name}: {ss.nonlinear}")
        if n_out < 10:
            raise NotApplicable(f"{ss.name}: at least 10 samples are needed, got {n_out}")
        self.ss, self.n_out, self.dt = ss, n_out, dt
        self.outputs, self.quad = tuple(outputs), tuple(quad)
        self.h = dt / n_out
        given, w_rated = np.array(theta, dtype=float), gen.machine.w_rated
        self.theta = ss.full(given)
        self.constant = constant = symmetry(ss, u, given, w_rated)
        if fine and not constant and self.h * fastest(ss, u, given, w_rated) > LOST:
            text = "single samples take the slope of a voltage whose digits an open phase takes"
            raise NotApplicable(f"{ss.name}: {text}")
        plan = strides(n_out, self.h, constant, fine)
        table = cached_table(ss, u, given, w_rated, h=self.h, leaps=plan.m)
        self.table = table.filled(max(harmonics, table.harmonics))
        # what ``function`` depends on
        self.layout = (ss.shared, n_out, plan, self.outputs, self.quad, constant)
        self.function = _advance(*self.layout)
        self.tol = DRIVE_TOL["fine" if fine else "constant" if constant else "periodic"]
        self.limits = np.array([self.tol])
        self._compiled: Gradual | None = None
        self._t = dt * (np.arange(1, n_out + 1) / n_out)  # rounded as a Stepper does
        self._angle = ss.x.index("theta_e")
        self._iw = ss.u.index("w_r")
        self._w_ok = (1 - SPEED_RANGE) * w_rated, (1 + SPEED_RANGE) * w_rated
        self._starts = self.h * plan.starts()
        # powers of exp(j theta), columns as in Table: 0, 2, 4, ... and 1, 3, 5, ...
        self._powers = tuple(s.shape[1] // 2 for s in (self.table.even, self.table.odd))

    @property
    def advance(self) -> ca.Function:
        """Function (x0, series, u, theta, dt) -> (x, y, mean, miss), for constant coefficients."""
        return _at_any_speed(self.function, self._iw, self.n_out, self.table.even[0].size)

    @property
    def parameters(self) -> np.ndarray:
        """What :attr:`advance` takes as ``series``."""
        return np.append(self.table.even.ravel(), [self.table.centre, self.table.half])

    # -- other numbers of the same structure (:mod:`apu_casadi.machine.course`) -----------------

    #: Largest change of transition matrices from step to step, nominal units; samples resolve it.
    smooth: ClassVar[float] = 1e-2
    finer: ClassVar[int] = 0  # harmonics with which steps that were refused may be taken

    @property
    def harmonics(self) -> int:
        """Harmonics of the rotor angle that the table has; 0 where the angle does not matter."""
        return self.table.harmonics

    @property
    def vector(self) -> np.ndarray:
        """The table as one vector."""
        parts = (self.table.even, self.table.odd)
        return self.parameters if self.constant else np.concatenate([p.ravel() for p in parts])

    @property
    def units(self) -> np.ndarray:
        """Factors that turn it to nominal units; zero for what is no transition matrix."""
        each = nominal_entries(self.ss, self.layout[2].m)
        parts = zip((self.table.even, self.table.odd), each, strict=True)
        rows = [np.broadcast_to(scale, part.shape).ravel() for part, scale in parts]
        return np.append(rows[0], [0.0, 0.0]) if self.constant else np.concatenate(rows)

    def expect(self, jump: float) -> None:
        """Expect transition matrices that change so from step to step; nothing depends on it."""

    def put(self, vector: np.ndarray, theta: np.ndarray) -> None:
        """Go on with other numbers: those of :attr:`vector`, and theta in full."""
        shapes, n = (self.table.even.shape, self.table.odd.shape), self.table.even.size
        parts = vector[:n], vector[n : n + self.table.odd.size]
        even, odd = (p.reshape(s) for p, s in zip(parts, shapes, strict=True))
        self.table, self.theta = replace(self.table, even=even, odd=odd), theta

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
            call = self._compiled = _caller(*self.layout, backend_in_use())
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
def _caller(
    ss: GeneratorModel,
    n_out: int,
    plan: Strides,
    outputs: tuple[str, ...],
    quad: tuple[str, ...],
    constant: bool,
    _in_use: str,
) -> Gradual:
    """Function of :func:`_advance` in the backend in use, one for each layout."""
    return Gradual(_advance(ss, n_out, plan, outputs, quad, constant), level=3, copy=False)
