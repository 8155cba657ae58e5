"""Exchange steps of which only means are wanted: exact propagation with few samples.

Waveforms need a sample every 50 us; rms values, powers and phasors do not, if the quadrature
knows what ripples.

* Constant coefficients (healthy, balanced): in the rotor's frame nothing ripples.  A phase
  quantity is c0 + c1 cos theta + s1 sin theta + c2 cos 2 theta + s2 sin 2 theta with smooth
  coefficients, sampled at a few instants that lie denser at the start of the step, where the
  speed has just changed.  Polynomials through them times the harmonics are integrated in closed
  form (Filon's method).
* Periodic coefficients (fault, unbalanced load): :mod:`apu_casadi.machine.turnstep`, with strides
  as long as the severity of the fault allows (``LEVELS``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from apu_casadi.core.backend import Gradual, backend_in_use
from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.hoisting import hoisted
from apu_casadi.core.lanes.pointlanes import points_in_lanes
from apu_casadi.core.means import Term, window
from apu_casadi.core.sharing import Rebuilt, kept
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.propagation import leap, seen_at_start
from apu_casadi.machine.settling import settled
from apu_casadi.machine.transition import (
    NODES,
    Table,
    cached_table,
    nominal_entries,
    parity,
    ripple,
    symmetry,
)
from apu_casadi.machine.turnstep import Turn, periodic_step, turn_of

Panels: TypeAlias = tuple[tuple[int, float], ...]
#: Panels of a step with constant coefficients: number of panels and share of the step of each.
#: Four intervals in a panel.  The first resolve what follows the jump of the speed, 20 us and more;
#: with eight of the others powers err by 3e-6 while the exciter follows a large drop of the load.
PANELS: Panels = ((1, 1 / 160), (1, 1 / 40), (12, (1 - 1 / 160 - 1 / 40) / 12))
#: The same of long courses, in which next to nothing jumps.
FEW_PANELS: Panels = ((5, 1 / 5),)
#: Longest time, first intervals, in which the stator may settle behind the load and not be sampled.
LAYER = 0.5


class Level(NamedTuple):
    """What suffices beside faults and unbalanced loads whose power has so many harmonics.

    Args:
        strides: in a turn.
        harmonics: of the rotor angle that a function takes; the first that fits.
        ripple: largest harmonics of a transition matrix from the fourth on, nominal units.
        depth: the same of all of them, which a fault makes large whose loop has little resistance;
            then where the fault's current is a state of its own, and not among them.
    """

    strides: int
    harmonics: tuple[int, ...]
    ripple: float
    depth: tuple[float, float]


#: No number of harmonics is of two levels.  Beside resistive loads of 100 and 10 kW the first
#: reaches to h = 0.0007 and 0.0003, the second to 0.0016 and 0.0005, the third to 0.002 and 0.001,
#: the fourth to 0.02 and 0.005.  Means of single steps err by some 7e-7 where one of them changes
#: the speed by 0.3 %, those of the first two where it does by 0.02 %.
LEVELS = (
    Level(16, (10,), 3.5e-4, (0.042, 0.025)),
    Level(20, (12,), 1e-3, (0.2, 0.1)),
    Level(28, (14, 20, 30), 4e-3, (0.29, 0.145)),
    Level(56, (32,), 3.5e-2, (math.inf, math.inf)),
    Level(112, (34,), math.inf, (math.inf, math.inf)),
)
MILD = LEVELS[:2]  # which gain nothing in a short run
#: Harmonics of what takes the next level at least.
USUAL = LEVELS[len(MILD)].harmonics[0]
#: Largest error of E_fd, per unit, that the windings may see at the end of an exciter's step; where
#: coefficients are periodic it changes its sign with the ripple, and next to nothing of it acts.
DRIVE_TOL = {"constant": 1e-5, "few": 3e-7, "periodic": 4e-5}
#: Largest change of transition matrices from step to step, nominal units, of loads and faults that
#: change in time: what follows such a jump falls between the samples, and means err by 1e-6 of it.
SMOOTH = {"constant": 3e-4, "periodic": 2e-3}
#: Largest error of the mean voltage, relative, that a jump of the load or the fault at the start of
#: a step makes the regulator see; loads and faults that change in time have one in every step.
JUMP_TOL = 3e-7
NO_JUMP = 1e-6  # change of transition matrices that is none: tables err by 1e-8
END_TOL = 3e-5  # nominal units: doubt about the state at the end, whose error is much smaller
_PHASE = ("_a", "_b", "_c")
_PHASES = 5  # rotor angles that tell the harmonics 0, 1, 2 apart


# ------------------------------------------------------------------------------ constant


def _filon(w: Any, h: float, k: int) -> tuple[list[Any], list[Any]]:
    """Weights of the integrals of f cos(k w t) and f sin(k w t) over a panel around t = 0.

    f is the polynomial through its values at t = -2 h, -h, 0, h, 2 h.  With moments
    M_p = int x^p exp(j l x) dx over [-2, 2], l = k w h: by parts,
    M_p = [x^p exp(j l x) / (j l)] - p / (j l) M_(p-1).
    """
    x = np.arange(-2.0, 3.0)
    lagrange = np.linalg.inv(np.vander(x, increasing=True))  # column i: powers of polynomial i
    a = 2.0
    even, odd = [], []  # real parts of M_0, M_2, M_4; imaginary parts of M_1, M_3
    if k == 0:
        even, odd = [2 * a ** (p + 1) / (p + 1) for p in (0, 2, 4)], [0.0, 0.0]
    else:
        l = k * w * h
        sin, cos = ca.sin(a * l), ca.cos(a * l)
        for p in range(5):
            if p % 2 == 0:
                even.append((2 * a**p * sin - p * (odd[-1] if p else 0.0)) / l)
            else:
                odd.append((-2 * a**p * cos + p * even[-1]) / l)
    c = [h * sum(lagrange[2 * p, i] * even[p] for p in range(3)) for i in range(5)]
    s = [h * sum(lagrange[2 * p + 1, i] * odd[p] for p in range(2)) for i in range(5)]
    return c, s


def _constant_weights(panels: Panels, dt: Any, w: Any, theta0: Any, highest: int) -> Any:
    """Weights of c0, c1, s1, ... in the mean over a step, the start included.

    Shape (2 highest + 1, samples).
    """
    intervals = [n * 4 for n, _ in panels]
    weights = [[ca.SX(0)] * (1 + sum(intervals)) for _ in range(2 * highest + 1)]
    t, first = 0.0, 0
    for number, share in panels:
        h = share / 4
        local = [_filon(w * dt, h, k) for k in range(highest + 1)]
        for _ in range(number):
            middle = theta0 + w * dt * (t + 2 * h)
            for k in range(highest + 1):
                c, s = ca.cos(k * middle), ca.sin(k * middle)
                for i, (a, b) in enumerate(zip(*local[k], strict=True)):
                    # exp(j k (middle + w t)): real part with c_k, imaginary part with s_k
                    row = weights[max(0, 2 * k - 1)]
                    row[first + i] += c * a - s * b
                    if k:
                        row = weights[2 * k]
                        row[first + i] += s * a + c * b
            t, first = t + share, first + 4
    return ca.vertcat(*(ca.horzcat(*row) for row in weights))


def _shares(panels: Panels) -> np.ndarray:
    """Share of the step that has passed at each sample of a step with constant coefficients."""
    ends = np.cumsum([0.0, *(share for n, share in panels for _ in range(n))])
    inside = ends[:-1, None] + np.diff(ends)[:, None] * np.arange(1, 5) / 4
    return np.append(0.0, inside.ravel())


def _shifted(weights: Any, term: Term, highest: int) -> list[Any]:
    """Weights of c0, c1, s1, ... in the mean of a term's value times its harmonic.

    By the addition theorems, from those of all harmonics; ``highest`` is that of the value itself.
    """
    m = term.k

    def C(k: int) -> Any:
        return weights[max(0, 2 * abs(k) - 1)]

    def S(k: int) -> Any:
        return (1 if k > 0 else -1) * weights[2 * abs(k)] if k else ca.SX(0)

    if not term.trig:
        return [weights[i] for i in range(2 * highest + 1)]
    out = []
    for k in range(highest + 1):
        cos = C(k - m) + C(k + m) if term.trig == "cos" else S(m + k) + S(m - k)
        sin = S(k + m) + S(k - m) if term.trig == "cos" else C(k - m) - C(k + m)
        out += [cos / 2, sin / 2] if k else [cos / 2]
    return out


def _harmonics(
    ss: GeneratorModel, at_sample: tuple[Any, Any, Any], quad: Sequence[str], share: Any
) -> tuple[Any, Any]:
    """What each mean of ``quad`` gets from one sample (x, u, theta), and the weights for it.

    Returns:
        The means, shape (means,), and symbols of the weights of c0, c1, s1, ..., of as many as are
        needed.
    """
    x, u, th = at_sample
    asked = [Term.of(q) for q in quad]
    own = list(dict.fromkeys((q.base, q.power) for q in asked))
    y = ss.g(x, u, th)
    values = ca.vertcat(*(Term(b, n, "", 0, False).value(ss, x, y) for b, n in own))
    parts = _parts(ss, x, u, th, ca.Function("terms", [x, u, th], [values]))
    parts_of = [parts[own.index((q.base, q.power))] for q in asked]
    highest = max(q.k + len(p) // 2 for q, p in zip(asked, parts_of, strict=True))
    weights = ca.SX.sym("W", 2 * highest + 1)
    light = weights * window(share)
    total = []
    for q, own_parts in zip(asked, parts_of, strict=True):
        factors = _shifted(light if q.weighted else weights, q, len(own_parts) // 2)
        total.append(sum(f * p for f, p in zip(factors, own_parts, strict=True)))
    return ca.vertcat(*total), weights


def _parts(ss: GeneratorModel, x: Any, u: Any, th: Any, terms: ca.Function) -> list[list[Any]]:
    """Coefficients c0, c1, s1, c2, s2 of each term, at one sample; c0 alone where that is all."""
    at = ss.x.index("theta_e")
    phi = 2 * math.pi * np.arange(_PHASES) / _PHASES
    values = []
    for angle in phi:
        x_phi = ca.SX(x)
        x_phi[at] = float(angle)
        values.append(ca.vertsplit(terms(x_phi, u, th)))
    # what does not depend on the angle needs no more than its first value; the coefficients are
    # constant where the load is balanced
    draws = np.random.default_rng(0)
    xd = ss.x.nominals * draws.normal(size=len(ss.x))
    of_phase = {n: n[:-2] if n[-2:] in _PHASE else n for n in ss.u.names}
    value = {n: abs(draws.normal()) for n in dict.fromkeys(of_phase.values())}
    ud = np.array([value[n] for n in of_phase.values()])
    seen = []
    for angle in phi:
        xd[at] = angle
        seen.append(np.asarray(terms(xd, ud, np.ones(len(ss.theta)))).ravel())
    plain = np.ptp(seen, axis=0) <= 1e-9 * np.abs(seen).max(axis=0)
    found = []
    for i, flat in enumerate(plain):
        if flat:
            found.append([values[0][i]])
            continue
        f = [v[i] for v in values]
        parts = [sum(f) / _PHASES]
        for k in (1, 2):
            for trig in (np.cos, np.sin):
                weights = (2 / _PHASES * float(trig(k * p)) for p in phi)
                parts.append(sum(a * v for a, v in zip(weights, f, strict=True)))
        found.append(parts)
    return found


def _constant_step(ss: GeneratorModel, quad: tuple[str, ...], panels: Panels) -> ca.Function:
    nx, nu, nt, n_P = len(ss.x), len(ss.u), len(ss.theta), parity(ss, 1).even.size
    X0, U, TH = ca.MX.sym("x0", nx), ca.MX.sym("u", nu), ca.MX.sym("th", nt)
    dt = ca.MX.sym("dt")
    series = ca.MX.sym("series", len(panels) * NODES * n_P)
    ranges = ca.MX.sym("range", 2)  # of the speed
    w, at = U[ss.u.index("w_r")], ss.x.index("theta_e")
    s = (w - ranges[0]) / ranges[1]
    powers = ca.vertcat(1, *(s**k for k in range(1, NODES)))
    step, V_of = leap(ss, 1, True)
    # the first samples lie so far apart; so much of it is the first one's weight
    h_first, weight = dt * panels[0][1] / 4, 14 / 45
    x_k, area = settled(ss, True)(X0, U, TH, LAYER * h_first)
    seen = V_of(x_k + area * (2 / h_first), U, TH)[0]
    V_k = seen_at_start(ss, (seen, V_of(x_k, U, TH)[1]), x_k, U, TH)
    samples = [x_k + area / (weight * h_first)]
    sizes = zip("xVPut", (nx, V_k.numel(), n_P, nu, nt), strict=True)
    x, V, P, u, th = (ca.SX.sym(k, n) for k, n in sizes)
    h = ca.SX.sym("h")
    xk, Vk, states = x, V, []
    for _ in range(4):
        xk, Vk = step(xk, Vk, P, u, th, h)
        states.append(xk)
    outputs = [ca.horzcat(*states), Vk]
    panel, before = hoisted("panel", [x, V, P], ca.vertcat(u, th, h), outputs)
    for k, (number, share) in enumerate(panels):
        own = series[k * NODES * n_P : (k + 1) * NODES * n_P]
        P_k = ca.mtimes(ca.reshape(own, n_P, NODES), powers)
        d = before(ca.vertcat(U, TH, dt * share / 4))
        for _ in range(number):
            four, V_k = panel(x_k, V_k, P_k, d)
            x_k = four[:, 3]
            samples.append(four)
    X = ca.horzcat(*samples)
    w_, d_, t_ = ca.SX.sym("w"), ca.SX.sym("dt"), ca.SX.sym("theta0")
    share = ca.SX.sym("share")
    terms, W = _harmonics(ss, (x, u, th), quad, share)
    rows = _constant_weights(panels, d_, w_, t_, W.numel() // 2)
    weights = ca.Function("weights", [d_, w_, t_], [rows], {"cse": True})
    means, before = hoisted("harmonics", [x, W, share], ca.vertcat(u, th), [terms])
    each = means.map(f"each_{ss.name}_{len(panels)}", "serial", X.shape[1], [3], [])
    sampled = each(X, weights(dt, w, X0[at]), ca.DM(_shares(panels)).T, before(ca.vertcat(U, TH)))
    return ca.Function(
        f"means_{ss.name}",
        [X0, ca.vertcat(series, ranges), U, TH, dt],
        [x_k, ca.sum2(sampled), V_k[2]],
        ["x0", "series", "u", "theta", "dt"],
        ["x", "mean", "miss"],
    )


# ------------------------------------------------------------------------------ both


@kept
def _function(
    ss: GeneratorModel, quad: tuple[str, ...], division: Turn | Panels, harmonics: int
) -> ca.Function:
    """Function (x0, series, u, theta, dt) -> (x, mean, miss); by panels for constant ones."""
    if isinstance(division, Turn):
        return periodic_step(ss, quad, division, harmonics)
    return _constant_step(ss, quad, division)


@kept
def _caller(
    ss: GeneratorModel,
    quad: tuple[str, ...],
    division: Turn | Panels,
    harmonics: int,
    _in_use: str,
) -> Gradual:
    """The same in the backend in use, one for each layout."""
    return Gradual(_function(ss, quad, division, harmonics), level=3, by=points_in_lanes)


class MeanStep(Rebuilt):
    """Exchange steps without waveforms of one model variant with one load and fault.

    Args:
        gen, ss: generator and its model variant (:meth:`Generator.variant`).
        u, theta: inputs and fault parameters; only w_r and V_ref may change afterwards.
        dt: length of every step, s.
        quad: what is averaged over the step, see :mod:`apu_casadi.core.means`.
        harmonics: of the rotor angle, at least so many; what has equal ones has equal layouts.
            Fewer than ``USUAL`` are for long courses, also where the angle does not matter.

    Raises:
        NotApplicable: the model is not linear in its windings, a series does not converge or has
            more than fit, or the step is so short that samples cannot be spared.
    """

    ss: GeneratorModel
    dt: float
    quad: tuple[str, ...]
    theta: np.ndarray
    constant: bool
    parameters: np.ndarray
    harmonics: int
    layout: tuple[Any, ...]
    advance: Any
    limits: np.ndarray
    _own: Level
    _few: bool

    outputs: tuple[str, ...] = ()
    n_out = 0

    def __init__(
        self,
        gen: Generator,
        ss: GeneratorModel,
        u: np.ndarray,
        theta: np.ndarray,
        *,
        dt: float,
        quad: Sequence[str],
        harmonics: int = USUAL,
    ) -> None:
        """Compute or fetch the tables, build or fetch the function."""
        if not ss.linear:
            raise NotApplicable(f"{ss.name}: {ss.nonlinear}")
        self.ss, self.dt, self.quad = ss, dt, tuple(quad)
        given = np.array(theta, dtype=float)
        self.theta = ss.full(given)
        w_rated = gen.machine.w_rated
        if dt * w_rated < 4 * math.pi:
            raise NotApplicable(f"{ss.name}: a step of {dt:g} s has less than two turns")
        self.constant = symmetry(ss, u, given, w_rated)
        division: Turn | Panels
        if self.constant:
            self._few = harmonics < USUAL
            division = FEW_PANELS if self._few else PANELS
            tables = [cached_table(ss, u, given, w_rated, h=dt * k / 4) for _, k in division]
            series, self.harmonics = [t.even.ravel() for t in tables], 0
        else:
            table, self._own, self.harmonics = self._level(gen, u, given, harmonics)
            self._few = self._own in MILD
            division = turn_of(dt, w_rated, self._own.strides)
            tables, table = [table], table.filled(self.harmonics)
            # entries, then terms, then powers
            series = [part.ravel() for part in (table.even, table.odd)]
        self._range = tables[0].centre, tables[0].half
        self.parameters = np.concatenate([*series, self._range])
        self.layout = (ss.shared, self.quad, division, self.harmonics)
        self.advance = _function(*self.layout)
        kind = "few" if self._few and self.constant else "constant" if self.constant else "periodic"
        drive = DRIVE_TOL[kind]
        self.limits = np.array([drive] if self.constant else [drive, END_TOL, math.inf])
        self._iw = ss.u.index("w_r")
        self._compiled: Gradual | None = None

    def _level(
        self, gen: Generator, u: np.ndarray, theta: np.ndarray, harmonics: int
    ) -> tuple[Table, Level, int]:
        """Return table and harmonics of the first level that suffices."""
        ss, w, found = self.ss, gen.machine.w_rated, 0
        for level in LEVELS:
            if harmonics > level.harmonics[-1]:
                continue
            table = cached_table(ss, u, theta, w, angle=2 * math.pi / level.strides)
            found = max(harmonics, table.harmonics)
            fit = next((k for k in level.harmonics if k >= found), 0)
            deep = level.depth["i_fault" in ss.linear]
            fit *= ripple(ss, table, 4) <= level.ripple and ripple(ss, table, 1) <= deep
            if fit:
                return table, level, fit
        raise NotApplicable(
            f"{ss.name}: {found} harmonics of the rotor angle, {LEVELS[-1].harmonics[-1]} fit"
        )

    # -- other numbers of the same structure (:mod:`apu_casadi.machine.course`) -----------------

    @property
    def smooth(self) -> float:
        """Largest change of transition matrices from step to step, nominal units."""
        return SMOOTH["constant" if self.constant else "periodic"]

    @property
    def finer(self) -> int:
        """Harmonics with which steps that were refused may be taken; 0 where there are none."""
        return USUAL if self._few else 0

    @property
    def vector(self) -> np.ndarray:
        """What the compiled function knows of the load and the fault, beside theta."""
        return self.parameters

    @property
    def units(self) -> np.ndarray:
        """Factors that turn it to nominal units; zero for what is no transition matrix."""
        even, odd = nominal_entries(self.ss, 1)
        if self.constant:
            parts = [np.tile(even, len(self.layout[2]) * NODES)]
        else:
            terms = self.harmonics + 2, self.harmonics
            parts = [np.tile(e, NODES * n) for e, n in zip((even, odd), terms, strict=True)]
        return np.concatenate([*parts, np.zeros(2)])

    def expect(self, jump: float) -> None:
        """Expect transition matrices that change by so much from step to step, nominal units."""
        if not self.constant:
            self.limits[2] = JUMP_TOL if jump > NO_JUMP else math.inf

    def put(self, vector: np.ndarray, theta: np.ndarray) -> None:
        """Go on with other numbers: those of :attr:`vector`, and theta in full."""
        self.parameters, self.theta = vector, theta

    def valid(self, w_r: float) -> bool:
        """Whether the speed, rad/s electrical, lies in the range of the tables."""
        return abs(w_r - self._range[0]) <= self._range[1]

    def __call__(
        self, x0: np.ndarray, u: np.ndarray, *, t0: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Advance one step; return the state at its end and the means.

        Raises:
            NotApplicable: the exciter moves too fast, the samples do not resolve the windings, a
                result is not finite, or the speed is outside the table.
        """
        w = float(u[self._iw])
        if not self.valid(w):
            raise NotApplicable(f"{self.ss.name}: w_r = {w:.6g} rad/s is outside the table")
        call = self._compiled
        if call is None:
            call = self._compiled = _caller(*self.layout, backend_in_use())
        x, mean, miss = call(x0, self.parameters, u, self.theta, self.dt)
        if not (np.all(miss <= self.limits) and math.isfinite(float(x.sum() + mean.sum()))):
            raise NotApplicable(
                f"{self.ss.name}: step from {t0:.6g} s: errors of E_fd, of the state at the end "
                f"and of the voltage seen, {miss.tolist()} > {self.limits.tolist()}, or values "
                "that are not finite"
            )
        return x, mean
