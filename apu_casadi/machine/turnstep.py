"""Means over an exchange step whose coefficients depend on the rotor angle.

The samples are a fixed *angle* apart, so that after half a turn the same few transition matrices
come again (:class:`~apu_casadi.machine.transition.Parity`).  The step ends between two samples;
state and means there come from polynomials through the ten around it.

Only the exciter makes one sample wait for another.  So what must follow in turn is short: two
products of a matrix and a vector, two terminal voltages, a step of the exciter.  All else is made
for many samples at once, and the matrices of a half turn before it.  Products of matrices, and
what is made of each sample, have forms in vector lanes (:mod:`apu_casadi.core.lanes.pointlanes`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.hoisting import hoisted
from apu_casadi.core.means import Term, harmonic, window
from apu_casadi.core.sharing import once
from apu_casadi.machine.exciterstep import Exciter, exciter_of, exciter_step, kick
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.settling import SIMPSON, missed, settled
from apu_casadi.machine.transition import EXTRA, NODES, SPEED_RANGE, Parity, parity, split
from apu_casadi.machine.weights import rippling, through, unresolved

PACE = 2  # strides in a step of the exciter; with 4, its high gain sees the sampling of the ripple
#: Longest time, in strides and in turns, in which the stator may settle behind the load and not be
#: sampled: longer strides do not make slower what a new speed leaves behind.
LAYER = 0.35, 1 / 80
_BACK = 8  # samples whose polynomial leads back to the start


class Rule(NamedTuple):
    """How the end of a step is made of the samples around it.

    Its share of the means is made of some samples before and after it, exactly for harmonics of
    half a turn that change with time as polynomials of the given degrees.  The state comes from a
    polynomial through so many samples around it.  With polynomials through ten
    samples means beside a severe fault err by 4e-4; with 28 strides by 2e-4, with 56 by 3e-6.  More
    samples do not help: over more than a turn amplitudes are no polynomials of such degrees.
    """

    before: int
    after: int
    degrees: Mapping[int, int]
    around: int


_MANY = {0: 3, 1: 3, 2: 2, 3: 2} | dict.fromkeys(range(4, 8), 1) | dict.fromkeys(range(8, 14), 0)
#: By the number of strides.
_RULES = {
    16: Rule(17, 3, {0: 3, 1: 2, 2: 2, 3: 0}, 14),
    20: Rule(21, 4, {0: 3, 1: 2, 2: 2, 3: 1, 4: 0}, 16),
    28: Rule(30, 5, {0: 3, 1: 2, 2: 2, 3: 1, 4: 1, 5: 1, 6: 0}, 10),
    56: Rule(60, 10, _MANY, 10),
    112: Rule(120, 20, _MANY, 10),
}


def _powers(s: Any, count: int) -> Any:
    """Return 1, s, s^2, ..."""
    return ca.vertcat(1, *(s**k for k in range(1, count)))


def _turned(pairs: int, half: int, *, odd: bool) -> ca.Function:
    """Function theta -> cos and sin, in turn, of q times each of the angles of half a turn.

    q = 0, 2, ... or 1, 3, ...; shape (2 pairs, half), angles a stride apart from theta on.
    """
    theta, rows = ca.SX.sym("theta"), []
    cos, sin = ca.cos(theta), ca.sin(theta)
    cos2, sin2 = cos * cos - sin * sin, 2 * cos * sin
    p, q = (cos, sin) if odd else (ca.SX(1), ca.SX(0))
    for k in range(pairs):
        by = math.pi * (2 * k + odd) / half * np.arange(half)
        C, S = ca.DM(np.cos(by)).T, ca.DM(np.sin(by)).T
        rows += [p * C - q * S, q * C + p * S]
        p, q = p * cos2 - q * sin2, q * cos2 + p * sin2
    return ca.Function("turned", [theta], [ca.densify(ca.vertcat(*rows))], {"cse": True})


def _matrices(
    kinds: Parity, series: Any, s: Any, theta0: Any, harmonics: int, half: int
) -> list[ca.MX]:
    """Transition matrices over the strides of half a turn, each of shape (n, n + EXTRA).

    Args:
        kinds: which entries have even harmonics, and which odd ones.
        series: a :class:`Table` with its numbers in their order.
        s: relative speed.
        theta0: rotor angle at the start.
        harmonics: that the table has.
        half: strides in half a turn.
    """
    values, first, n = [], 0, kinds.sign.size - EXTRA
    for odd, entries in enumerate((kinds.even.size, kinds.odd.size)):
        terms = 2 * (harmonics // 2 + (not odd))
        size = terms * entries
        own = ca.reshape(series[first : first + NODES * size], size, NODES)
        now = ca.mtimes(own, _powers(s, NODES))
        turned = _turned(terms // 2, half, odd=bool(odd))(theta0)
        values.append(ca.mtimes(ca.reshape(now, entries, terms), turned))
        first += NODES * size
    order = np.argsort(np.append(kinds.even, kinds.odd)).tolist()
    made = []
    for even, odd in zip(*(ca.horzsplit(v) for v in values), strict=True):
        made.append(ca.reshape(ca.vertcat(even, odd)[order], n, n + EXTRA))
    return made


def _later(h: Any) -> ca.Function:
    """Matrix that leads E and its derivatives, and one, on by h."""
    shift = ca.SX.eye(EXTRA)
    for i in range(EXTRA - 1):
        for j in range(i + 1, EXTRA - 1):
            shift[i, j] = h ** (j - i) / math.factorial(j - i)
    return ca.densify(shift)


class Turn(NamedTuple):
    """Half turns in a step, the samples between which it may end, and strides in a turn."""

    halves: int
    first: int
    strides: int

    @property
    def half(self) -> int:
        """Strides in half a turn."""
        return self.strides // 2

    @property
    def around(self) -> int:
        """Samples around the end of the step that its polynomial goes through."""
        return _RULES[self.strides].around

    @property
    def near(self) -> int:
        """Half of them."""
        return self.around // 2

    @property
    def mean_leaves(self) -> tuple[float, float, float, float]:
        """What means leave of something that passes by, as :func:`unresolved` tells it."""
        first, _, whole = _end_of(self.strides)
        return unresolved(np.append(first + np.cumsum(whole), [1.0, 1.0]))

    @property
    def pairs(self) -> int:
        """Steps of the exciter in half a turn."""
        return self.half // PACE

    @property
    def samples(self) -> int:
        """Samples of a step, the start included."""
        return 1 + self.halves * self.half


def turn_of(dt: float, w_rated: float, each: int) -> Turn:
    """How many strides are needed for the fastest speed, and where the slowest ends.

    Half of the samples that its polynomial goes through lie beyond the end.

    Args:
        each: strides in a turn.
    """
    strides = dt * w_rated * each / (2 * math.pi)
    around = _RULES[each].around
    halves = math.ceil(((1 + SPEED_RANGE) * strides + around // 2) / (each // 2))
    return Turn(halves, math.floor((1 - SPEED_RANGE) * strides) - around, each)


@once
def _end_of(strides: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what :func:`rippling` says by the rule of so many strides, and of whole intervals."""
    rule = _RULES[strides]
    first, partial = rippling(rule.before, rule.after, strides // 2, rule.degrees)
    return first, partial, np.array([np.polyval(row[::-1], 0.5) for row in partial])


def _slice(values: Any, count: int, at: Any) -> ca.MX:
    """Return two or more of a vector's numbers from a place on that is computed."""
    return values.get_nz(False, ca.Slice(0, count), at)


class _End:
    """Weights of the samples where a step of some length ends.

    Args:
        turn: the samples.
        r: length of the step in strides.

    Attributes:
        J: last sample before the end; ``turn.around`` samples go from ``J + 1 - turn.near`` on.
        full, fewer: polynomial through these at the end, and through two fewer.
        start: where the exciter's last, shorter step starts.
        middle: polynomial in its middle, of the samples around ``J_middle``.
    """

    def __init__(self, turn: Turn, r: Any) -> None:
        self.turn = turn
        self.J, s = self._placed(r)
        near, around = turn.near, turn.around
        poly = through(1 - near, around)
        self.full = ca.mtimes(ca.DM(poly), _powers(s, around))
        fewer = np.pad(through(2 - near, around - 2), ((1, 1), (0, 0)))
        self.fewer = ca.mtimes(ca.DM(fewer), _powers(s, around - 2))
        self.start = PACE * ca.floor(self.J / PACE)
        self.J_middle, s_middle = self._placed((self.start + r) / 2)
        self.middle = ca.mtimes(ca.DM(poly), _powers(s_middle, around))
        self._s = s

    def _placed(self, r: Any) -> tuple[Any, Any]:
        """Sample before an instant, one that there is also at speeds without a table; the rest."""
        near = self.turn.near
        J = ca.fmin(ca.fmax(ca.floor(r), self.turn.first + near), self.turn.samples - 1 - near)
        return J, r - J

    def means(self) -> Any:
        """Weights of the samples in a mean, relative to a stride, (samples,)."""
        first, partial, whole = _end_of(self.turn.strides)
        count, before = first.size, _RULES[self.turn.strides].before
        # less what the intervals from J on would give to a sample near it, and what the last does
        after = np.append(np.cumsum(whole[:0:-1])[::-1], 0.0) - 1.0
        last = ca.mtimes(ca.DM(partial), _powers(self._s - 0.5, partial.shape[1])) + ca.DM(after)
        n, earliest = self.turn.samples, self.turn.first + self.turn.around
        begin = earliest + 1 - before
        beyond = n - begin - count
        ends = ca.vertcat(ca.DM.zeros(beyond), last, -ca.DM.ones(beyond))
        later = ca.fmin(ca.fmax(self.J - earliest, 0), beyond)
        mean = np.ones(n)
        mean[:count] = first + np.cumsum(whole)  # of a step that goes on
        more = _slice(ends, n - begin, beyond - later)
        return ca.vertcat(ca.DM(mean[:begin]), ca.DM(mean[begin:]) + more)


class _Seen:
    """What is averaged, at each sample.

    The angles of the samples are the same in every half turn: what follows from them is computed
    once for each, and harmonics are taken out of the sums over the half turns.
    """

    def __init__(self, ss: GeneratorModel, quad: Sequence[str], turn: Turn) -> None:
        halves, self._half = turn.halves, turn.half
        tag = f"{ss.name}_{turn.strides}"  # what a block maps must have a name of its own
        self._asked = [Term.of(q) for q in quad]
        #: values and whether they are weighted; harmonics apart
        self._own = list(dict.fromkeys((q.base, q.power, q.weighted) for q in self._asked))
        at, n = split(ss), len(ss.linear)
        x, u, th = (
            ca.SX.sym(k, len(s)) for k, s in zip("xut", (ss.x, ss.u, ss.theta), strict=True)
        )
        y, weights = ss.g(x, u, th), ca.SX.sym("weights", 2)
        terms = [Term(b, k, "", 0, w).value(ss, x, y) for b, k, w in self._own]
        values = ca.vertcat(
            *(v * weights[int(w)] for v, (*_, w) in zip(terms, self._own, strict=True))
        )
        others = [i for i in at.slow if i != at.drive]
        if others and any(ca.which_depends(values, x[others], 1, True)):
            raise NotApplicable(f"{ss.name}: a mean of what the exciter's inner states decide")
        at_sample = ca.Function("terms", [x, u, th, weights], [values, y[ss.y.index("V_t")]])
        #: (x, u, theta, length of a stride, weight of a first sample in it, weights as of others)
        #: -> (x as it settles, terms, terminal voltage), both with what passes by, and what of it
        #: the samples will miss
        h, weight = ca.SX.sym("h"), ca.SX.sym("weight")
        layer = min(LAYER[0], LAYER[1] * turn.strides)
        after, area = settled(ss, False)(x, u, th, layer * h)
        leaves = turn.mean_leaves, SIMPSON
        late = [missed(ss, False, left)(x, after, u, th, h) for left in leaves]
        by = 1 / (weight * h), 6 / (PACE * h)

        def seen(x: Any, areas: Sequence[Any]) -> tuple[Any, Any]:
            first, second = (x + k * area for k, area in zip(by, areas, strict=True))
            return at_sample(first, u, th, weights)[0], at_sample(second, u, th, weights)[1]

        given = [x, u, th, h, weight, weights]
        made = [after, *seen(after, [area + own for own in late])]
        self.start = ca.Function("start", given, made, {"cse": True})
        #: the same -> what a ripple, of which nothing passes by, added to terms and voltage
        ripples = missed(ss, False, SIMPSON)(x, x, u, th, h)  # nothing is so fast as to settle
        more = [a - b for a, b in zip(seen(x, [ripples] * 2), seen(x, (0, 0)), strict=True)]
        self.rippled = ca.Function("rippled", given, more, {"cse": True})
        sample, angle = ca.SX.sym("sample", n + 2), ca.SX.sym("angle")
        full = ca.SX(len(ss.x), 1)
        full[at.linear], full[at.drive], full[at.angle] = sample[:n], sample[n], angle
        own = at_sample(full, u, th, weights)[0]
        one, self.before = hoisted(
            f"seen_{tag}", [sample, weights], ca.vertcat(u, th, angle), [own]
        )
        d = ca.SX.sym("d", self.before.numel_out(0))
        samples = [ca.SX.sym("sample", n + 2) for _ in range(halves)]
        plain, light = ca.SX.sym("plain", halves), ca.SX.sym("light", halves)
        each = zip(samples, ca.vertsplit(plain), ca.vertsplit(light), strict=True)
        total = sum(one(v, ca.vertcat(*w), d) for v, *w in each)
        #: (sample of each half turn, weights plain and of weighted means in each, d) -> sums of
        #: terms by their weights, at one angle; and (u, theta, angle) -> d
        self.over = ca.Function(f"over_{tag}", [*samples, plain, light, d], [total], {"cse": True})

    def sums(self, samples: Sequence[Any], weights: tuple[Any, Any], fixed: Any) -> Any:
        """Sums over the half turns at each angle of one, (terms, half).

        Args:
            samples: of each half turn, (n + 2, half).
            weights: plain and of weighted means, (half, halves).
            fixed: u, theta and angle, (..., half).
        """
        d = self.before.map(self._half)(fixed)
        return self.over.map(self._half)(*samples, *(w.T for w in weights), d)

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


class _Voltage:
    """The terminal voltage as the rms of a space vector that is linear in x and E.

    Raises:
        NotApplicable: it is not.
    """

    def __init__(self, ss: GeneratorModel) -> None:
        at, n = split(ss), len(ss.linear)
        w, angle = ca.SX.sym("w", n + 1), ca.SX.sym("angle")
        u, th = ca.SX.sym("u", len(ss.u)), ca.SX.sym("t", len(ss.theta))
        full = ca.SX(len(ss.x), 1)
        full[at.linear], full[at.drive], full[at.angle] = w[:n], w[n], angle
        y = ss.g(full, u, th)
        a, b, c = (y[ss.y.index(f"v_{k}")] for k in "abc")
        vector = ca.vertcat((2.0 * a - b - c) / 3.0, (b - c) / math.sqrt(3.0)) / math.sqrt(2.0)
        rows = ca.jacobian(vector, w)
        offset, V0 = ca.substitute([vector, y[ss.y.index("V_t")]], [w], [ca.SX.zeros(n + 1)])
        given = [u, th, angle]
        if any(ca.which_depends(ca.vec(ca.densify(rows)), w, 1, True)):
            raise NotApplicable(f"{ss.name}: the terminal voltage is not linear in the windings")
        whole = ca.vertcat(ca.horzcat(ca.SX.eye(n), ca.SX.zeros(n, 2)), ca.horzcat(rows, offset))
        #: (u, theta, angle) -> matrix that makes (x, vector) of (x, E, 1)
        self.rows = ca.Function(f"rows_{ss.name}", given, [ca.densify(whole)], {"cse": True})
        #: (u, theta, angle) -> square of the voltage without that of the vector
        self.rest = ca.Function("rest", given, [V0**2 - ca.sumsqr(offset)], {"cse": True})


def _between(
    ss: GeneratorModel, exciter: Exciter, voltage: _Voltage
) -> tuple[ca.Function, ca.Function]:
    """What stands between the products of two steps of the exciter.

    First: (x and space vector at the strides of a pair, one each; z, S, d) -> (z, S, samples), with
    z = (x, E, E', E'', E''', 1) and S = (exciter's states, their rates, exponentials, largest error
    of the drive so far) where a pair starts, and x, E and terminal voltage at its samples.  Second:
    (u, theta, length of a stride, angle at the start) -> d.
    """
    at, n = split(ss), len(ss.linear)
    slow, k1 = (ca.SX.sym(k, len(at.slow)) for k in ("slow", "k1"))
    e, miss = ca.SX.sym("e", exciter.exps), ca.SX.sym("miss")
    u, th = ca.SX.sym("u", len(ss.u)), ca.SX.sym("t", len(ss.theta))
    z, h, angle = ca.SX.sym("z", n + EXTRA), ca.SX.sym("h"), ca.SX.sym("angle")
    rows = [ca.SX.sym("x", n + 2) for _ in range(PACE)]
    x, V_ref, rest = [r[:n] for r in rows], u[ss.u.index("V_ref")], voltage.rest(u, th, angle)
    # only the drive enters outputs between the exciter's steps
    E = [(_later(ca.SX((j + 1) * h)) @ z[n:])[0] for j in range(PACE)]
    V = [ca.sqrt(ca.sumsqr(r[n:]) + rest) for r in rows]

    # Under a fault the terminal voltage ripples with twice the frequency: in the middle a straight
    # line would cut that by 1 %
    held = V_ref, th
    V_two = V[PACE // 2 - 1], V[-1]
    after, e_after, far = exciter.step((slow, k1, e), V_two, held, PACE * h)
    k_after, drive = exciter.at((after, V[-1], *held), e_after)
    end = exciter.drive(after)
    miss_after = ca.fmax(miss, ca.fabs(end - E[-1])) + far
    samples = [ca.vertcat(*own) for own in zip(x, [*E[:-1], end], V, strict=True)]
    outputs = [
        ca.vertcat(x[-1], drive, 1),
        ca.vertcat(after, k_after, e_after, miss_after),
        ca.vertcat(*samples),
    ]
    given = [*rows, z, ca.vertcat(slow, k1, e, miss)]
    return hoisted(f"between_{ss.name}", given, ca.vertcat(u, th, h, angle), outputs)


def _half_turn(ss: GeneratorModel, between: ca.Function, n_d: int, pairs: int) -> ca.Function:
    """Function (z, S, matrices of each pair, d of each) -> (z, S, samples, S of each pair).

    It is called again and again: unrolled to a step, it would not stay in the processor's cache of
    instructions.
    """
    n = len(ss.linear)
    z, S = z_k, S_k = ca.MX.sym("z", n + EXTRA), ca.MX.sym("S", between.numel_in(PACE + 1))
    P = [ca.MX.sym("P", n + 2, n + EXTRA) for _ in range(PACE * pairs)]
    d = [ca.MX.sym("d", n_d) for _ in range(pairs)]
    samples, starts = [], []
    for k in range(pairs):
        starts.append(S_k)
        x = [ca.mtimes(own, z_k) for own in P[PACE * k : PACE * (k + 1)]]
        z_k, S_k, its = between(*x, z_k, S_k, d[k])
        samples.append(its)
    z_k = z_k * parity(ss, 1).sign
    outputs = [z_k, S_k, ca.vertcat(*samples), ca.vertcat(*starts)]
    return ca.Function("half_turn", [z, S, *P, *d], outputs)


def _kicked(
    ss: GeneratorModel, exciter: Exciter, z: Any, S: Any, by: tuple[Any, Any, Any, Any]
) -> tuple[Any, Any]:
    """Return z and S, as :func:`_between` has them, after an impulse of the terminal voltage.

    Args:
        by: the impulse, V s; terminal voltage, V_ref and theta.
    """
    n, slow = len(ss.linear), S[: len(split(ss).slow)]
    impulse, *now = by
    after = slow + kick(ss)(slow, *now) * impulse
    rates, drive, e = exciter.started(after, *now)
    return ca.vertcat(z[:n], drive, 1), ca.vertcat(after, rates, e, S[-1])


def _from_start(P: Sequence[Any], rows: Sequence[Any], h: Any) -> list[Any]:
    """Return matrices that lead from the start of each pair to (x, space vector) at its samples.

    Args:
        P: transition matrices of the strides.
        rows: what makes (x, space vector) of (x, E, 1) at the end of each.
        h: length of a stride, s.
    """
    n, made, by = P[0].shape[0], [], ca.SX.sym("h")
    later = ca.Function("later", [by], [_later(by), _later(2 * by)])(h)
    for k in range(0, len(P), PACE):
        first, second = P[k : k + PACE]
        of_drive = ca.horzcat(ca.MX.zeros(n, n), ca.mtimes(second[:, n:], later[0]))
        for own, leads, shift in zip(
            rows[k : k + PACE], (first, ca.mac(second[:, :n], first, of_drive)), later, strict=True
        ):
            E_and_one = ca.horzcat(ca.MX.zeros(2, n), shift[[0, -1], :])
            made.append(ca.mac(own[:, :n], leads, ca.mtimes(own[:, n:], E_and_one)))
    return made


def _seen_of_a_jump(V_now: Any, V: Sequence[Any], length: Any) -> Any:
    """Relative error of the mean voltage that a jump at the start makes the regulator see.

    It takes the voltage of the first instant for true over a sixth of its first step; a jump of the
    load or the fault moves it for microseconds.  What it would be without is told by the samples
    after it less those half a turn later, which ripple alike, and by samples half a turn apart, but
    for what settles within a turn: it is off by no more than either says.

    Args:
        V_now: at the first instant.
        V: those at the samples of the first half turns, (1, half) each.
        length: of the step, in strides.
    """
    moved = V[0][:_BACK] - V[1][:_BACK]
    near = V[0][-1] + ca.mtimes(moved, ca.DM(through(1, _BACK)[:, 0]))
    a, b, c = (v[-1] for v in V[:3])
    off = (ca.fabs(1 - v / V_now) for v in (near, 3 * a - 3 * b + c))
    return ca.fmin(*off) * PACE / (6 * length)


class _Chain(NamedTuple):
    """What followed in turn: samples of each half turn, (n + 2, half), and S of each pair."""

    samples: list[Any]
    starts: list[Any]
    miss: Any


def _at_end(ss: GeneratorModel, chain: _Chain, end: _End) -> tuple[Any, Any, list[Any]]:
    """Return the windings at the end, by all samples around it and by fewer, and the exciter there.

    The latter by its states where its last step starts, and the terminal voltages there, in the
    middle and at the end.
    """
    half, pairs = end.turn.half, end.turn.pairs
    n, first = len(ss.linear), (end.turn.first - 1) // half
    rows, n_S = n + 2, chain.starts[0].numel() // pairs
    tail = ca.vertcat(*(ca.vec(v) for v in chain.samples[first:]))
    begin = 1 + half * first  # number of the first sample of the tail
    near, count_around = end.turn.near, end.turn.around

    def around(J: Any) -> Any:
        place = (J + 1 - near - begin) * rows
        return ca.reshape(_slice(tail, rows * count_around, place), rows, count_around)

    # the phases as they are after so many half turns
    count = half * (end.turn.halves - first)
    signs = ca.DM((-1.0) ** (first + np.arange(count) // half))
    turned = _slice(ca.MX(signs), count_around, end.J + 1 - near - begin)
    weights = ca.horzcat(end.full, end.fewer)
    keep = np.append(parity(ss, 1).sign[:n], [1.0, 1.0]) > 0
    samples = around(end.J)
    found = ca.mtimes(samples, weights) * keep[:, None]
    if not keep.all():
        found += ca.mtimes(samples, weights * ca.repmat(turned, 1, 2)) * ~keep[:, None]
    V_middle = ca.mtimes(around(end.J_middle)[n + 1, :], end.middle)
    starts = ca.vertcat(*chain.starts[first:])
    slow = _slice(starts, len(split(ss).slow), (end.start / PACE - pairs * first) * n_S)
    V_start = _slice(tail, 2, (end.start - begin) * rows + n)[1]  # of E and V_t
    return found[:n, 0], found[:n, 1], [slow, ca.vertcat(V_start, V_middle, found[n + 1, 0])]


def periodic_step(
    ss: GeneratorModel, quad: tuple[str, ...], turn: Turn, harmonics: int
) -> ca.Function:
    """Function (x0, series, u, theta, dt) -> (x, mean, miss) for periodic coefficients."""
    at, kinds = split(ss), parity(ss, 1)
    n = len(at.linear)
    trigs = harmonics // 2 + 1, harmonics // 2  # of cosine and sine, even and odd
    size = NODES * 2 * (trigs[0] * kinds.even.size + trigs[1] * kinds.odd.size)
    X0, U, TH = (ca.MX.sym(k, len(s)) for k, s in zip("xut", (ss.x, ss.u, ss.theta), strict=True))
    parameters, DT = ca.MX.sym("series", size + 2), ca.MX.sym("dt")
    w, V_ref = U[ss.u.index("w_r")], U[ss.u.index("V_ref")]
    half, pairs = turn.half, turn.pairs
    theta0, stride = X0[at.angle], math.pi / half
    h, s = stride / w, (w - parameters[-2]) / parameters[-1]
    length, angles = DT / h, theta0 + stride * ca.DM(np.arange(half + 1)).T
    end, seen = _End(turn, length), _Seen(ss, quad, turn)
    relative = end.means()
    plain = relative / length
    # beyond the end of the step the weight goes on as the polynomial that it is
    light = plain * window(ca.DM(np.arange(turn.samples)) / length)
    how = U, TH, h, relative[0], ca.vertcat(plain[0], light[0])
    x_now, terms, V_now = seen.start(X0, *how)

    exciter, voltage = exciter_of(ss), _Voltage(ss)
    between, before = _between(ss, exciter, voltage)
    held = ca.repmat(ca.vertcat(U, TH), 1, half)
    fixed = ca.vertcat(held[:, :pairs], ca.repmat(h, 1, pairs), angles[:-1:PACE])
    rows = voltage.rows.map(half)(held[: len(ss.u), :], held[len(ss.u) :, :], angles[1:])
    P = _matrices(kinds, parameters, s, theta0, harmonics, half)
    P = _from_start(P, ca.horzsplit(rows, n + 2), h)
    given = [*P, *ca.horzsplit(before.map(pairs)(fixed))]
    half_turn = _half_turn(ss, between, before.numel_out(0), pairs)
    rates, drive, e = exciter.started(x_now[at.slow], V_now, V_ref, TH)
    z, S = ca.vertcat(x_now[at.linear], drive, 1), ca.vertcat(x_now[at.slow], rates, e, 0)
    samples, starts = [], []
    for k in range(turn.halves):
        z, S, of_samples, of_starts = half_turn(z, S, *given)
        samples.append(ca.reshape(of_samples, n + 2, half))
        starts.append(of_starts)
        if not k:  # what has passed by is no more; what ripples is as it was at the start
            x_then = ca.MX(X0)
            x_then[at.linear], x_then[at.slow] = z[:n], S[: len(at.slow)]
            of_terms, of_V = seen.rippled(x_then, *how)
            terms -= of_terms
            of_start = -PACE / 6 * h * of_V, samples[0][n + 1, -1], V_ref, TH
            z, S = _kicked(ss, exciter, z, S, of_start)
    chain = _Chain(samples, starts, S[-1])
    weights = tuple(ca.reshape(v[1:], half, turn.halves) for v in (plain, light))
    sums = seen.sums(samples, (weights[0], weights[1]), ca.vertcat(held, angles[1:]))
    mean = seen.means(ca.horzcat(terms, sums), angles)

    windings, by_fewer, (slow, voltages) = _at_end(ss, chain, end)
    # the exciter's last step is as long as it must be
    x_end = ca.MX(len(ss.x), 1)
    x_end[at.slow] = exciter_step(ss)[1](slow, voltages, V_ref, TH, DT - h * end.start)
    x_end[at.linear], x_end[at.angle] = windings, theta0 + w * DT
    doubt = ca.mmax(ca.fabs(windings - by_fewer) / ss.x.nominals[at.linear])
    jump = _seen_of_a_jump(V_now, [v[n + 1, :] for v in samples[:3]], length)
    return ca.Function(
        f"means_{ss.name}_{turn.strides}",
        [X0, parameters, U, TH, DT],
        [ca.densify(x_end), mean, ca.vertcat(chain.miss, doubt, jump)],
        ["x0", "series", "u", "theta", "dt"],
        ["x", "mean", "miss"],
    )
