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
from apu_casadi.machine.transition import SPEED_RANGE, parity
from apu_casadi.machine.weights import end_weights, through

STRIDES = 28  # strides in a turn, where coefficients are periodic: 14 in a period of what ripples
PACE = 2  # of them in a step of the exciter; with 4, its high gain sees the sampling of the ripple
_AROUND = 10  # samples around the end of the step that its polynomial goes through


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


def turn_of(dt: float, w_rated: float) -> Turn:
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


def periodic_step(
    ss: GeneratorModel, quad: tuple[str, ...], turn: Turn, harmonics: int
) -> ca.Function:
    """Function (x0, series, u, theta, dt) -> (x, mean, miss) for periodic coefficients."""
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
