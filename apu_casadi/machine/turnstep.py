"""Means over an exchange step whose coefficients depend on the rotor angle.

The samples are a fixed *angle* apart, so that after half a turn the same few transition matrices
come again (:class:`~apu_casadi.machine.transition.Parity`).  The step ends between two samples;
state and means there come from polynomials through the ten around it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.means import Term, harmonic, window
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.propagation import exciter_step, hoisted, leap
from apu_casadi.machine.settling import settled
from apu_casadi.machine.transition import SPEED_RANGE, parity
from apu_casadi.machine.weights import rippling, through

STRIDES = 28  # strides in a turn, where coefficients are periodic: 14 in a period of what ripples
PACE = 2  # of them in a step of the exciter; with 4, its high gain sees the sampling of the ripple
#: Longest time, strides, in which the stator may settle behind the load and not be sampled.
LAYER = 0.35
_BACK = 8  # samples whose polynomial leads back to the start
_AROUND = 10  # samples around the end of the step that its polynomial goes through
#: Samples before and after an end of the step that its share of the means is made of, and degrees
#: in time of the harmonics of half a turn in them.  The power of a severe fault has ten in a turn:
#: with polynomials through ten samples means err by 4e-4, so by 2e-5 and less.
_RIPPLE = (30, 5)
_DEGREES = {0: 3, 1: 2, 2: 2, 3: 1, 4: 1, 5: 1, 6: 0}


def _powers(polynomials: np.ndarray, s: Any) -> list[Any]:
    """Values at s, by Horner's rule."""
    values = []
    for row in polynomials:
        v: Any = float(row[-1])
        for c in row[-2::-1]:
            v = v * s + float(c)
        values.append(v)
    return values


def _sums(cosines: dict[int, Any], sines: dict[int, Any], n: int) -> tuple[list[Any], list[Any]]:
    """Sums of c_q cos x and of s_q sin x, x = q pi m/n, at m = 0, ..., n.

    Those at m and n - m differ in the signs of terms only: each is added up once.
    """
    parts = []
    for series, function in ((cosines, math.cos), (sines, math.sin)):
        rows = []
        for m in range(n // 2 + 1):
            even, odd = ca.SX(0), ca.SX(0)
            for q, c in series.items():
                by = function(math.pi * q * m / n)
                term = c * by if abs(by) > 1e-15 else 0  # exactly zero but for rounding
                even, odd = (even, odd + term) if q % 2 else (even + term, odd)
            rows.append((even, odd))
        mirror = 1 if function is math.cos else -1
        mirrored = [mirror * (even - odd) for even, odd in rows[(n - 1) // 2 :: -1]]
        parts.append([even + odd for even, odd in rows] + mirrored)
    return parts[0], parts[1]


def _matrices(pairs: int, *, odd: bool) -> ca.Function:
    """Function (coefficients of an entry, relative speed, cos q theta, sin q theta in turn) -> it.

    One entry of a :class:`Table`, shape (2 pairs, 4), at the ``STRIDES / 2`` angles from theta on
    that lie a stride apart.  There, q and ``STRIDES`` - q are the same harmonic, which leaves a
    discrete Fourier transform whose sums mirror each other.
    """
    n = STRIDES // 2
    c, s, trig = ca.SX.sym("c", 2 * pairs, 4), ca.SX.sym("s"), ca.SX.sym("trig", 2 * pairs)
    now = ca.vertsplit(((c[:, 3] * s + c[:, 2]) * s + c[:, 1]) * s + c[:, 0])
    cosines, sines = dict[int, Any](), dict[int, Any]()
    for k in range(pairs):
        (a, b), (cos, sin) = now[2 * k : 2 * k + 2], ca.vertsplit(trig[2 * k : 2 * k + 2])
        q, sign = (2 * k + odd) % STRIDES, 1
        if q > n:
            q, sign = STRIDES - q, -1
        cosines[q] = cosines.get(q, 0) + (a * cos + b * sin)
        sines[q] = sines.get(q, 0) + sign * (b * cos - a * sin)
    if odd:
        even_part, odd_part = (part[: n // 2 + 1] for part in _sums(cosines, sines, n))
    else:  # harmonics of half a turn
        halved = [{q // 2: v for q, v in part.items()} for part in (cosines, sines)]
        even_part, odd_part = _sums(halved[0], halved[1], n // 2)
    mirror = -1 if odd else 1
    values = [a + b for a, b in zip(even_part, odd_part, strict=True)]
    values += [mirror * (even_part[m] - odd_part[m]) for m in range((n - 1) // 2, 0, -1)]
    return ca.Function(f"entry_{odd}", [ca.vec(c), s, trig], [ca.vertcat(*values)], {"cse": True})


def _trig(pairs: int, *, odd: bool) -> ca.Function:
    """Function theta -> cos q theta, sin q theta in turn, q = 0, 2, ... or 1, 3, ..."""
    theta, column = ca.SX.sym("theta"), []
    cos, sin = ca.cos(theta), ca.sin(theta)
    cos2, sin2 = cos * cos - sin * sin, 2 * cos * sin
    p, q = (cos, sin) if odd else (ca.SX(1), ca.SX(0))
    for _ in range(pairs):
        column += [p, q]
        p, q = p * cos2 - q * sin2, q * cos2 + p * sin2
    return ca.Function("trig", [theta], [ca.vertcat(*column)], {"cse": True})


class Turn(NamedTuple):
    """Half turns in a step, and the samples between which it may end."""

    halves: int
    first: int

    @property
    def samples(self) -> int:
        """Samples of a step, the start included."""
        return 1 + self.halves * STRIDES // 2


def turn_of(dt: float, w_rated: float) -> Turn:
    """How many strides are needed for the fastest speed, and where the slowest ends.

    Half of the samples that its polynomial goes through lie beyond the end.
    """
    strides = dt * w_rated * STRIDES / (2 * math.pi)
    halves = math.ceil(((1 + SPEED_RANGE) * strides + _AROUND // 2) / (STRIDES // 2))
    return Turn(halves, math.floor((1 - SPEED_RANGE) * strides) - _AROUND)


def _delayed(values: list[Any], by: Any, most: int) -> list[Any]:
    """Return values that begin ``by`` places later, a symbol up to ``most``, with zeros before."""
    for n in (1 << k for k in reversed(range(most.bit_length()))):
        so = ca.ge(by, n)
        by = by - n * so
        later = [*[ca.SX(0)] * n, *values[:-n]]
        values = [ca.if_else(so, b, a) for a, b in zip(values, later, strict=True)]
    return values


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
    first, partial = rippling(*_RIPPLE, STRIDES // 2, _DEGREES)
    count, whole = first.size, np.array([np.polyval(row[::-1], 0.5) for row in partial])
    start = first + np.cumsum(whole)  # of a step that goes on
    # less what the intervals from J on would give to a sample near it, and what the last one does
    last = [v - 1 for v in _powers(partial, s - 0.5)]
    last = [v + float(whole[i + 1 :].sum()) for i, v in enumerate(last)]
    mean = [ca.SX(float(start[j])) if j < count else ca.SX(1) for j in range(n)]
    earliest = turn.first + _AROUND
    begin = earliest + 1 - _RIPPLE[0]
    beyond = n - begin - count
    ends = _delayed([*last, *[ca.SX(-1)] * beyond], J - earliest, beyond)
    mean[begin:] = [a + b for a, b in zip(mean[begin:], ends, strict=True)]
    full, fewer, middle, pick = ([ca.SX(0)] * n for _ in range(4))
    at_full = _powers(poly, s)
    at_fewer = _powers(through(2 - near, _AROUND - 2), s)
    from_ = PACE * ca.floor(r / PACE)
    r_middle = (from_ + r) / 2
    at_middle = _powers(poly, r_middle - ca.floor(r_middle))
    for j in range(turn.first, n):
        here = [ca.eq(J, j - 1 + near - i) for i in range(_AROUND)]
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


class _Pair:
    """Two strides and what is averaged over them: one step of the exciter.

    All pairs of a step are one small function: seven unrolled to half a turn would not stay in the
    processor's cache of instructions, and compile longer.  The angles of the samples are the same
    in every half turn: what follows from them is computed once for each, and harmonics are taken
    out of the sums over the half turns.
    """

    def __init__(self, ss: GeneratorModel, quad: Sequence[str]) -> None:
        nx, nu, nt, kinds = len(ss.x), len(ss.u), len(ss.theta), parity(ss, 1)
        self._asked = [Term.of(q) for q in quad]
        #: values and whether they are weighted; harmonics apart
        self._own = list(dict.fromkeys((q.base, q.power, q.weighted) for q in self._asked))
        step, V_of = leap(ss, PACE, False, chained=True)
        x, V, u, th = (ca.SX.sym(k, n) for k, n in zip("xVut", (nx, 3, nu, nt), strict=True))
        P = [ca.SX.sym("P", part.size, PACE) for part in (kinds.even, kinds.odd)]
        h, angle, weights = ca.SX.sym("h"), ca.SX.sym("angle"), ca.SX.sym("weights", 2, PACE)
        #: (x, u, theta, length of a stride, weight of a first sample in it) -> (x as it settles,
        #: what is averaged, terminal voltage), both with what passes by before
        weight = ca.SX.sym("weight")
        after, area = settled(ss, False)(x, u, th, LAYER * h)
        first, _ = self._values(ss, after + area / (weight * h), u, th)
        seen = V_of(after + area * (6 / (PACE * h)), u, th)[0]
        given, made = [x, u, th, h, weight], [after, first, seen]
        self.start = ca.Function("start", given, made, {"cse": True})
        x_now = ca.SX(x)
        x_now[ss.x.index("theta_e")] = angle
        X, V_end = step(x_now, V, ca.vertcat(*map(ca.vec, P)), u, th, h)
        values = [self._values(ss, x_j, u, th) for x_j in ca.horzsplit(X)]
        terms = [self.weighted(v, weights[:, j]) for j, (v, _) in enumerate(values)]
        outputs = [X, V_end, ca.horzcat(*terms), ca.horzcat(*(v for _, v in values))]
        #: (x, V, even and odd entries, weights plain and of weighted means (2, PACE), d) ->
        #: (x at the strides, V, terms by their weights, terminal voltages); and (u, theta, length
        #: of a stride, angle at the start) -> d, the same in every half turn
        fixed = ca.vertcat(u, th, h, angle)
        self.over, self.before = hoisted("pair", [x, V, *P, weights], fixed, outputs)

    def _values(self, ss: GeneratorModel, x: Any, u: Any, th: Any) -> tuple[Any, Any]:
        """Return what is averaged, and the terminal voltage, at a sample."""
        y = ss.g(x, u, th)
        terms = [Term(b, n, "", 0, w).value(ss, x, y) for b, n, w in self._own]
        return ca.vertcat(*terms), y[ss.y.index("V_t")]

    def weighted(self, terms: Any, weights: Any) -> Any:
        """Return terms of a sample by their weights, plain and of weighted means, (2,)."""
        return terms * ca.vertcat(*(weights[int(w)] for *_, w in self._own))

    def means(self, sums: Any, angles: Any) -> Any:
        """Return the means asked for from sums over the half turns at angles, (terms, angles)."""
        given = ca.SX.sym("sums", sums.shape), ca.SX.sym("angles", angles.shape)
        found = []
        for q in self._asked:
            row = given[0][self._own.index((q.base, q.power, q.weighted)), :]
            if q.trig:
                row = row * harmonic(q.k, given[1])[q.trig == "sin"]
            found.append(ca.sum2(row))
        return ca.Function("means", given, [ca.vertcat(*found)], {"cse": True})(sums, angles)


def _seen_of_a_jump(V_now: Any, voltages: list[Any], pairs: int, length: Any) -> Any:
    """Relative error of the mean voltage that a jump at the start makes the regulator see.

    It takes the voltage of the first instant for true over a sixth of its first step; a jump of the
    load or the fault moves it for microseconds.  What it would be without is told by the samples
    after it, but for their ripple, and by those half a turn apart, which ripple alike, but for what
    settles within a turn: it is off by no more than either says.

    Args:
        V_now: at the first instant.
        voltages: those at its start, and of the pairs that follow.
        pairs: in half a turn.
        length: of the step, in strides.
    """
    near = ca.mtimes(ca.horzcat(*voltages[1 : 1 + _BACK // PACE]), ca.DM(through(1, _BACK)[:, 0]))
    a, b, c = (voltages[pairs * k][-1] for k in (1, 2, 3))
    off = (ca.fabs(1 - V / V_now) for V in (near, 3 * a - 3 * b + c))
    return ca.fmin(*off) * PACE / (6 * length)


def periodic_step(
    ss: GeneratorModel, quad: tuple[str, ...], turn: Turn, harmonics: int
) -> ca.Function:
    """Function (x0, series, u, theta, dt) -> (x, mean, miss) for periodic coefficients."""
    nx, nu, nt, kinds = len(ss.x), len(ss.u), len(ss.theta), parity(ss, 1)
    n_even, n_odd = kinds.even.size, kinds.odd.size
    trigs = harmonics // 2 + 1, harmonics // 2  # of cosine and sine, even and odd
    sizes = 4 * 2 * trigs[0] * n_even, 4 * 2 * trigs[1] * n_odd
    X0, U, TH = ca.MX.sym("x0", nx), ca.MX.sym("u", nu), ca.MX.sym("th", nt)
    parameters, DT = ca.MX.sym("series", sum(sizes) + 2), ca.MX.sym("dt")
    w, at = U[ss.u.index("w_r")], ss.x.index("theta_e")
    s = (w - parameters[-2]) / parameters[-1]
    theta0, stride = X0[at], 2 * math.pi / STRIDES
    # transition matrices of the strides in half a turn, the same for every half turn
    half_turn = STRIDES // 2
    P = []
    for i, (first, rows) in enumerate(((0, n_even), (sizes[0], n_odd))):
        series = ca.reshape(parameters[first : first + sizes[i]], -1, rows)
        entry = _matrices(trigs[i], odd=bool(i)).map("all", "serial", rows, [1, 2], [])
        trig = _trig(trigs[i], odd=bool(i))(theta0)
        P.append(entry(series, s, trig).T)
    pair, h_now = _Pair(ss, quad), stride / w
    length = DT / h_now
    weights = _end_weights(turn)(length)
    # beyond the end of the step the weight goes on as the polynomial that it is
    shares = ca.DM(np.arange(turn.samples)).T / length
    plain = weights[0, :] / length
    both = ca.vertcat(plain, plain * window(shares))
    angles = theta0 + stride * ca.DM(np.arange(half_turn + 1)).T
    x_k, terms, V_now = pair.start(X0, U, TH, h_now, weights[0, 0])
    V_k, samples, voltages = ca.vertcat(V_now, 0, 0), [x_k], [V_now]
    first, *rest = ca.horzsplit(both, [0, *range(1, turn.samples + 1, PACE)])
    pairs = half_turn // PACE
    fixed = ca.vertcat(ca.repmat(ca.vertcat(U, TH, h_now), 1, pairs), angles[:-1:PACE])
    held = list(zip(*(ca.horzsplit(p, PACE) for p in P), strict=True))
    d = ca.horzsplit(pair.before.map(pairs)(fixed))
    sums = [ca.MX(0)] * pairs
    for k, own in enumerate(rest):
        at_pair = k % pairs
        X, V_k, its, V = pair.over(x_k, V_k, *held[at_pair], own, d[at_pair])
        x_k = X[:, -1]
        if at_pair == pairs - 1:
            x_k = x_k * _signs(ss)
        sums[at_pair] = sums[at_pair] + its
        samples.append(X)
        voltages.append(V)
    jump = _seen_of_a_jump(V_now, voltages, pairs, length)
    mean = pair.means(ca.horzcat(pair.weighted(terms, first), *sums), angles)
    V_all = ca.horzcat(*voltages)
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
        [x_end, mean, ca.vertcat(V_k[2], doubt, jump)],
        ["x0", "series", "u", "theta", "dt"],
        ["x", "mean", "miss"],
    )
