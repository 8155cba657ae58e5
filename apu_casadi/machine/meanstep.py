"""Exchange steps of which only means are wanted: exact propagation with few samples.

Waveforms need a sample every 50 us; rms values, powers and phasors do not, if the quadrature
knows what ripples.

* Constant coefficients (healthy, balanced): in the rotor's frame nothing ripples.  A phase
  quantity is c0 + c1 cos theta + s1 sin theta + c2 cos 2 theta + s2 sin 2 theta with smooth
  coefficients, sampled at a few instants that lie denser at the start of the step, where the
  speed has just changed.  Polynomials through them times the harmonics are integrated in closed
  form (Filon's method).
* Periodic coefficients (fault, unbalanced load): the samples are a fixed *angle* apart, so that
  after half a turn the same few transition matrices come again (:class:`Parity`).  The step ends
  between two samples; state and means there come from polynomials through the ten around it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.backend import Gradual, backend_in_use
from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.means import Term, harmonic, window
from apu_casadi.core.sharing import Rebuilt, kept
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.propagation import exciter_step, hoisted, leap
from apu_casadi.machine.transition import (
    NODES,
    SPEED_RANGE,
    cached_table,
    nominal_entries,
    parity,
    symmetry,
)
from apu_casadi.machine.weights import end_weights, through

#: Panels of a step with constant coefficients: number of panels and share of the step of each.
#: Four intervals in a panel.  The first resolve what follows the jump of the speed, 20 us and more.
PANELS = ((1, 1 / 160), (1, 1 / 40), (8, (1 - 1 / 160 - 1 / 40) / 8))
STRIDES = 28  # strides in a turn, where coefficients are periodic: 14 in a period of what ripples
PACE = 2  # of them in a step of the exciter; with 4, its high gain sees the sampling of the ripple
HARMONICS = (12, 20, 30)  # of the rotor angle that a function takes; the first that fits
#: Largest error of E_fd, per unit, that the windings may see at the end of an exciter's step; where
#: coefficients are periodic it changes its sign with the ripple, and next to nothing of it acts.
DRIVE_TOL = {"constant": 1e-5, "periodic": 4e-5}
#: Largest change of transition matrices from step to step, nominal units, of loads and faults that
#: change in time: what follows such a jump falls between the samples, and means err by 1e-6 of it.
SMOOTH = {"constant": 3e-4, "periodic": 2e-3}
END_TOL = 1e-5  # nominal units: doubt about the state at the end, whose error is much smaller
_AROUND = 10  # samples around the end of the step that its polynomial goes through
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


def _constant_weights(dt: Any, w: Any, theta0: Any, highest: int) -> Any:
    """Weights of c0, c1, s1, ... in the mean over a step, the start included.

    Shape (2 highest + 1, samples).
    """
    intervals = [n * 4 for n, _ in PANELS]
    weights = [[ca.SX(0)] * (1 + sum(intervals)) for _ in range(2 * highest + 1)]
    t, first = 0.0, 0
    for number, share in PANELS:
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


def _shares() -> np.ndarray:
    """Share of the step that has passed at each sample of a step with constant coefficients."""
    ends = np.cumsum([0.0, *(share for n, share in PANELS for _ in range(n))])
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


def _constant_step(ss: GeneratorModel, quad: tuple[str, ...]) -> ca.Function:
    nx, nu, nt, n_P = len(ss.x), len(ss.u), len(ss.theta), parity(ss, 1).even.size
    X0, U, TH = ca.MX.sym("x0", nx), ca.MX.sym("u", nu), ca.MX.sym("th", nt)
    dt = ca.MX.sym("dt")
    series = ca.MX.sym("series", len(PANELS) * 4 * n_P)
    ranges = ca.MX.sym("range", 4)  # of the speed; and where the step lies in a longer one
    w, at = U[ss.u.index("w_r")], ss.x.index("theta_e")
    s = (w - ranges[0]) / ranges[1]
    powers = ca.vertcat(1, s, s**2, s**3)
    step, V_of = leap(ss, 1, True)
    sizes = zip("xVPut", (nx, 3, n_P, nu, nt), strict=True)
    x, V, P, u, th = (ca.SX.sym(k, n) for k, n in sizes)
    h = ca.SX.sym("h")
    xk, Vk, states = x, V, []
    for _ in range(4):
        xk, Vk = step(xk, Vk, P, u, th, h)
        states.append(xk)
    outputs = [ca.horzcat(*states), Vk]
    panel, before = hoisted("panel", [x, V, P], ca.vertcat(u, th, h), outputs)
    x_k, V_k = X0, ca.vertcat(*V_of(X0, U, TH), 0)
    samples = [X0]
    for k, (number, share) in enumerate(PANELS):
        P_k = ca.mtimes(ca.reshape(series[k * 4 * n_P : (k + 1) * 4 * n_P], n_P, 4), powers)
        d = before(ca.vertcat(U, TH, dt * share / 4))
        for _ in range(number):
            four, V_k = panel(x_k, V_k, P_k, d)
            x_k = four[:, 3]
            samples.append(four)
    X = ca.horzcat(*samples)
    w_, d_, t_ = ca.SX.sym("w"), ca.SX.sym("dt"), ca.SX.sym("theta0")
    share = ca.SX.sym("share")
    terms, W = _harmonics(ss, (x, u, th), quad, share)
    rows = _constant_weights(d_, w_, t_, W.numel() // 2)
    weights = ca.Function("weights", [d_, w_, t_], [rows], {"cse": True})
    means, before = hoisted("harmonics", [x, W, share], ca.vertcat(u, th), [terms])
    shares = ranges[2] + ranges[3] * ca.DM(_shares()).T
    each = means.map("each", "serial", X.shape[1], [3], [])
    sampled = each(X, weights(dt, w, X0[at]), shares, before(ca.vertcat(U, TH)))
    return ca.Function(
        f"means_{ss.name}",
        [X0, ca.vertcat(series, ranges), U, TH, dt],
        [x_k, ca.sum2(sampled), V_k[2]],
        ["x0", "series", "u", "theta", "dt"],
        ["x", "mean", "miss"],
    )


# ------------------------------------------------------------------------------ periodic


def _powers(polynomials: np.ndarray, s: Any) -> list[Any]:
    """Values at s, by Horner's rule."""
    values = []
    for row in polynomials:
        v: Any = float(row[-1])
        for c in row[-2::-1]:
            v = v * s + float(c)
        values.append(v)
    return values


def _matrices(pairs: int, angles: int, *, odd: bool) -> ca.Function:
    """Function (coefficients of an entry, relative speed, first angle) -> it at some angles.

    One entry of a :class:`Table`: shape (2 pairs, 4) -> (angles,); the angles are a stride apart.
    """
    c, s, a = ca.SX.sym("c", 2 * pairs, 4), ca.SX.sym("s"), ca.SX.sym("trig", 2 * pairs, angles)
    now = ((c[:, 3] * s + c[:, 2]) * s + c[:, 1]) * s + c[:, 0]
    return ca.Function(f"entry_{odd}", [ca.vec(c), s, ca.vec(a)], [ca.mtimes(a.T, now)])


def _trig(pairs: int, angles: int, *, odd: bool) -> ca.Function:
    """Function (first angle) -> cos k theta, sin k theta in turn, k = 0, 2, ... or 1, 3, ..."""
    first, columns = ca.SX.sym("theta"), []
    for k in range(angles):
        theta = first + 2 * math.pi / STRIDES * k
        cos, sin = ca.cos(theta), ca.sin(theta)
        cos2, sin2 = cos * cos - sin * sin, 2 * cos * sin
        p, q = (cos, sin) if odd else (ca.SX(1), ca.SX(0))
        for _ in range(pairs):
            columns += [p, q]
            p, q = p * cos2 - q * sin2, q * cos2 + p * sin2
    return ca.Function("trig", [first], [ca.vertcat(*columns)], {"cse": True})


class Turn(NamedTuple):
    """Half turns in a step, and the samples between which it may end."""

    halves: int
    first: int

    @property
    def samples(self) -> int:
        """Samples of a step, the start included."""
        return 1 + self.halves * STRIDES // 2


def _turn(dt: float, w_rated: float) -> Turn:
    """How many strides are needed for the fastest speed, and where the slowest ends.

    Half of the samples that its polynomial goes through lie beyond the end.
    """
    strides = dt * w_rated * STRIDES / (2 * math.pi)
    halves = math.ceil(((1 + SPEED_RANGE) * strides + _AROUND // 2) / (STRIDES // 2))
    return Turn(halves, math.floor((1 - SPEED_RANGE) * strides) - _AROUND)


def _end_weights(turn: Turn) -> ca.Function:
    """Function (length in strides) -> weights of the samples, shape (5, samples).

    Rows: the mean, relative to a stride; the polynomial at the end of the step, through the
    ``_AROUND`` samples around it; one through two fewer; the polynomial in the middle of the
    exciter's last, shorter step; and what picks the sample where that step starts.
    """
    r = ca.SX.sym("r")
    n = turn.samples
    J = ca.floor(r)
    s = r - J
    near = _AROUND // 2
    poly = through(1 - near, _AROUND)
    k = np.arange(_AROUND)
    integrals = np.hstack([np.zeros((_AROUND, 1)), poly / (k + 1)])
    whole = integrals.sum(axis=1)  # of one interval between the middle two samples
    # the intervals before J give to a sample near it what lies on its right
    tail = [whole[i + 1 :].sum() for i in range(_AROUND)]
    last = [t + v for t, v in zip(tail, _powers(integrals, s), strict=True)]
    start = end_weights(_AROUND)
    mean = [ca.SX(float(start[j])) if j < _AROUND else ca.SX(1) for j in range(n)]
    full, fewer, middle, pick = ([ca.SX(0)] * n for _ in range(4))
    at_full = _powers(poly, s)
    at_fewer = _powers(through(2 - near, _AROUND - 2), s)
    from_ = PACE * ca.floor(r / PACE)
    r_middle = (from_ + r) / 2
    at_middle = _powers(poly, r_middle - ca.floor(r_middle))
    for j in range(turn.first, n):
        here = [ca.eq(J, j - 1 + near - i) for i in range(_AROUND)]
        mean[j] = ca.le(j, J - near) + sum(a * b for a, b in zip(here, last, strict=True))
        full[j] = sum(a * b for a, b in zip(here, at_full, strict=True))
        fewer[j] = sum(a * b for a, b in zip(here[1:-1], at_fewer, strict=True))
        there = [ca.eq(ca.floor(r_middle), j - 1 + near - i) for i in range(_AROUND)]
        middle[j] = sum(a * b for a, b in zip(there, at_middle, strict=True))
        pick[j] = ca.eq(from_, j) if j % PACE == 0 else ca.SX(0)
    rows = [ca.horzcat(*row) for row in (mean, full, fewer, middle, pick)]
    return ca.Function("end_weights", [r], [ca.densify(ca.vertcat(*rows))], {"cse": True})


def _signs(ss: GeneratorModel) -> np.ndarray:
    """-1 for the states that half a turn reverses, 1 for the others, shape (nx, 1)."""
    sign = np.ones((len(ss.x), 1))
    sign[ss.x.indices(ss.reversing), 0] = -1.0
    return sign


def _half_turn(ss: GeneratorModel) -> tuple[ca.Function, ca.Function]:
    """Half a turn, after which the phases are reversed instead of the angle going on.

    First: (x, V, even and odd entries, d) -> (x, V, x at the strides).  Second: (u, theta, length
    of a stride, angle at the start) -> d, the same for every half turn.
    """
    nx, nu, nt, kinds = len(ss.x), len(ss.u), len(ss.theta), parity(ss, 1)
    step, _ = leap(ss, PACE, False, chained=True)
    x, V, u, th = (ca.SX.sym(k, n) for k, n in zip("xVut", (nx, 3, nu, nt), strict=True))
    P = [ca.SX.sym("P", part.size, STRIDES // 2) for part in (kinds.even, kinds.odd)]
    h, theta0, at = ca.SX.sym("h"), ca.SX.sym("theta0"), ss.x.index("theta_e")
    xk, Vk, states = ca.SX(x), V, []
    xk[at] = theta0
    for k in range(0, STRIDES // 2, PACE):
        these = [ca.vec(p[:, k : k + PACE]) for p in P]
        X, Vk = step(xk, Vk, ca.vertcat(*these), u, th, h)
        xk = X[:, -1]
        states.append(X)
    xk = xk * _signs(ss)
    xk[at] = theta0
    outputs = [xk, Vk, ca.horzcat(*states)]
    return hoisted("half", [x, V, *P], ca.vertcat(u, th, h, theta0), outputs)


class _Sampled:
    """What is averaged, at the samples of a step, and their means.

    The angles of the samples are the same in every half turn: what follows from them is computed
    once for each, and harmonics are taken out of the sums over the half turns.
    """

    def __init__(self, ss: GeneratorModel, quad: Sequence[str]) -> None:
        nx, nu, nt = len(ss.x), len(ss.u), len(ss.theta)
        x, u, th = (ca.SX.sym(k, n) for k, n in zip("xut", (nx, nu, nt), strict=True))
        angle, weight = ca.SX.sym("angle"), ca.SX.sym("weight", 2)
        x_now = ca.SX(x)
        x_now[ss.x.index("theta_e")] = angle
        y = ss.g(x_now, u, th)
        self._asked = [Term.of(q) for q in quad]
        #: values and whether they are weighted; harmonics apart
        self._own = list(dict.fromkeys((q.base, q.power, q.weighted) for q in self._asked))
        terms = [Term(b, n, "", 0, w).value(ss, x_now, y) * weight[int(w)] for b, n, w in self._own]
        outputs = [ca.vertcat(*terms), y[ss.y.index("V_t")]]
        fixed = ca.vertcat(u, th, angle)
        self._values, self._fixed = hoisted("y", [x, weight], fixed, outputs)

    def __call__(self, X: Sequence[Any], weights: Any, fixed: Any, angles: Any) -> tuple[Any, Any]:
        """Return the means and the terminal voltages of all samples.

        Args:
            X: states at the start, and at the samples of each half turn.
            weights: plain ones and those of weighted means, shape (2, samples).
            fixed: inputs and theta.
            angles: at the start, and at the samples of a half turn.
        """
        n, values = angles.numel(), self._values
        d = self._fixed.map(n)(ca.vertcat(ca.repmat(fixed, 1, n), angles))
        first, V = values(X[0], weights[:, 0], d[:, 0])
        half, total, Vs = values.map(n - 1), ca.MX(0), [V]
        for k, states in enumerate(X[1:]):
            at = 1 + k * (n - 1)
            of_half, V = half(states, weights[:, at : at + n - 1], d[:, 1:])
            total = total + of_half
            Vs.append(V)
        sums = ca.horzcat(first, total)
        return self._means(n)(sums, angles), ca.horzcat(*Vs)

    def _means(self, n: int) -> ca.Function:
        """Function (sums over the half turns, angles) -> the means asked for."""
        sums, angles = ca.SX.sym("sums", len(self._own), n), ca.SX.sym("angles", 1, n)
        found = []
        for q in self._asked:
            row = sums[self._own.index((q.base, q.power, q.weighted)), :]
            if q.trig:
                row = row * harmonic(q.k, angles)[q.trig == "sin"]
            found.append(ca.sum2(row))
        return ca.Function("means", [sums, angles], [ca.vertcat(*found)], {"cse": True})


def _periodic_step(
    ss: GeneratorModel, quad: tuple[str, ...], turn: Turn, harmonics: int
) -> ca.Function:
    nx, nu, nt, kinds = len(ss.x), len(ss.u), len(ss.theta), parity(ss, 1)
    n_even, n_odd = kinds.even.size, kinds.odd.size
    pairs = harmonics // 2 + 1, harmonics // 2  # of cosine and sine, even and odd
    sizes = 4 * 2 * pairs[0] * n_even, 4 * 2 * pairs[1] * n_odd
    X0, U, TH = ca.MX.sym("x0", nx), ca.MX.sym("u", nu), ca.MX.sym("th", nt)
    parameters, DT = ca.MX.sym("series", sum(sizes) + 4), ca.MX.sym("dt")
    w, at = U[ss.u.index("w_r")], ss.x.index("theta_e")
    s = (w - parameters[-4]) / parameters[-3]
    theta0, stride = X0[at], 2 * math.pi / STRIDES
    # transition matrices of the strides in half a turn, the same for every half turn
    half_turn = STRIDES // 2
    P = []
    for i, (first, rows) in enumerate(((0, n_even), (sizes[0], n_odd))):
        series = ca.reshape(parameters[first : first + sizes[i]], -1, rows)
        entry = _matrices(pairs[i], half_turn, odd=bool(i)).map("all", "serial", rows, [1, 2], [])
        trig = _trig(pairs[i], half_turn, odd=bool(i))(theta0)
        P.append(entry(series, s, trig).T)
    half, before = _half_turn(ss)
    _, V_of = leap(ss, PACE, False, chained=True)
    h_now = stride / w
    x_k, V_k, samples = X0, ca.vertcat(V_of(X0, U, TH)[0], 0, 0), [X0]
    d = before(ca.vertcat(U, TH, h_now, theta0))
    for _ in range(turn.halves):
        x_k, V_k, X = half(x_k, V_k, *P, d)
        samples.append(X)
    length = DT / h_now
    weights = _end_weights(turn)(length)
    # beyond the end of the step the weight goes on as the polynomial that it is
    shares = parameters[-2] + parameters[-1] * ca.DM(np.arange(turn.samples)).T / length
    plain = weights[0, :] / length
    angles = theta0 + stride * ca.DM(np.arange(half_turn + 1)).T
    both = ca.vertcat(plain, plain * window(shares))
    mean, V_all = _Sampled(ss, quad)(samples, both, ca.vertcat(U, TH), angles)
    # the end of the step, with the phases as they are after so many half turns
    tail = np.arange(turn.first, turn.samples)
    turned = np.maximum(0, (tail - 1) // (STRIDES // 2)) % 2 == 1
    reversed_ = np.where(turned, _signs(ss), 1.0)
    X_tail = ca.horzcat(*samples)[:, turn.first :] * reversed_
    ends = ca.mtimes(X_tail, weights[1:, turn.first :].T)
    linear = np.zeros((nx, 1))
    linear[ss.x.indices(ss.linear), 0] = 1
    # the exciter's last step is as long as it must be
    V_tail = V_all[turn.first :]
    V_end, V_middle, V_start = (ca.mtimes(V_tail, weights[k, turn.first :].T) for k in (1, 3, 4))
    rest = DT - h_now * PACE * ca.floor(length / PACE)
    _, exciter = exciter_step(ss)
    slow = [i for i in range(nx) if i != at and not linear[i, 0]]
    x_end = ca.MX(ends[:, 0])
    V_ref = U[ss.u.index("V_ref")]
    drives = ca.vertcat(V_start, V_middle, V_end)
    x_end[slow] = exciter(ends[:, 3][slow], drives, V_ref, TH, rest)
    x_end[at] = theta0 + w * DT
    doubt = ca.mmax(ca.fabs(ends[:, 0] - ends[:, 1]) * linear / ss.x.nominals)
    return ca.Function(
        f"means_{ss.name}",
        [X0, parameters, U, TH, DT],
        [x_end, mean, ca.vertcat(V_k[2], doubt)],
        ["x0", "series", "u", "theta", "dt"],
        ["x", "mean", "miss"],
    )


# ------------------------------------------------------------------------------ both


@kept
def _function(
    ss: GeneratorModel, quad: tuple[str, ...], turn: Turn | None, harmonics: int
) -> ca.Function:
    """Function (x0, series, u, theta, dt) -> (x, mean, miss); without a turn for constant ones."""
    if turn is None:
        return _constant_step(ss, quad)
    return _periodic_step(ss, quad, turn, harmonics)


@kept
def _caller(
    ss: GeneratorModel, quad: tuple[str, ...], turn: Turn | None, harmonics: int, _in_use: str
) -> Gradual:
    """The same in the backend in use, one for each layout."""
    return Gradual(_function(ss, quad, turn, harmonics), level=3)


class MeanStep(Rebuilt):
    """Exchange steps without waveforms of one model variant with one load and fault.

    Args:
        gen, ss: generator and its model variant (:meth:`Generator.variant`).
        u, theta: inputs and fault parameters; only w_r and V_ref may change afterwards.
        dt: length of every step, s.
        quad: what is averaged over the step, see :mod:`apu_casadi.core.means`.
        within: where this step begins in a longer one, and which share of it it is; for weights.
        harmonics: of the rotor angle, at least so many; what has equal ones has equal layouts.

    Raises:
        NotApplicable: the model is not linear in its windings, a series does not converge or has
            more than ``HARMONICS``, or the step is so short that samples cannot be spared.
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
        within: tuple[float, float] = (0.0, 1.0),
        harmonics: int = 0,
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
        if self.constant:
            tables = [cached_table(ss, u, given, w_rated, h=dt * share / 4) for _, share in PANELS]
            series, self.harmonics = [t.even.ravel() for t in tables], 0
        else:
            angle = 2 * math.pi / STRIDES
            tables = [cached_table(ss, u, given, w_rated, angle=angle)]
            least = max(harmonics, tables[0].harmonics)
            self.harmonics = next((k for k in HARMONICS if k >= least), 0)
            if not self.harmonics:
                raise NotApplicable(
                    f"{ss.name}: {tables[0].harmonics} harmonics of the rotor angle, "
                    f"{HARMONICS[-1]} fit"
                )
            table = tables[0].filled(self.harmonics)
            # terms, then powers, then entries
            series = [part.transpose(2, 0, 1).ravel() for part in (table.even, table.odd)]
        self._range = tables[0].centre, tables[0].half
        self.parameters = np.concatenate([*series, self._range, within])
        turn = None if self.constant else _turn(dt, w_rated)  # panels are shares of the step
        self.layout = (ss.shared, self.quad, turn, self.harmonics)
        self.advance = _function(*self.layout)
        drive = DRIVE_TOL["constant" if self.constant else "periodic"]
        self.limits = np.array([drive] if self.constant else [drive, END_TOL])
        self._iw = ss.u.index("w_r")
        self._compiled: Gradual | None = None

    # -- other numbers of the same structure (:mod:`apu_casadi.machine.course`) -----------------

    @property
    def smooth(self) -> float:
        """Largest change of transition matrices from step to step, nominal units."""
        return SMOOTH["constant" if self.constant else "periodic"]

    @property
    def vector(self) -> np.ndarray:
        """What the compiled function knows of the load and the fault, beside theta."""
        return self.parameters

    @property
    def units(self) -> np.ndarray:
        """Factors that turn it to nominal units; zero for what is no transition matrix."""
        even, odd = nominal_entries(self.ss, 1)
        if self.constant:
            parts = [np.tile(even, len(PANELS) * NODES)]
        else:
            terms = self.harmonics + 2, self.harmonics
            parts = [np.repeat(e, NODES * n) for e, n in zip((even, odd), terms, strict=True)]
        return np.concatenate([*parts, np.zeros(4)])

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
                f"{self.ss.name}: step from {t0:.6g} s: errors of E_fd and of the state at the end "
                f"{miss.tolist()} > {self.limits.tolist()}, or values that are not finite"
            )
        return x, mean
