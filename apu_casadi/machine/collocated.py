"""Exchange steps of any length, also right after a switch, as one function without tables.

After a switch the windings settle within microseconds, and a step that an event cuts has a length
that no table of transition matrices is made for.  Here the strides of such a step double from less
than a nanosecond on, up to so many in a turn; in each the windings obey

    X_i = x + h sum_j a_ij (A(theta_j) X_j + b(theta_j) E(t_j) + c(theta_j)),    i = 1, ..., s,

the Radau IIA method of s = ``STAGES`` stages (Hairer, Wanner, Solving ODEs II, section IV.5), which
is L-stable, and linear: the stages are eliminated one after the other.  The exciter takes one
Runge-Kutta step in a stride, of a voltage with the moments of the stages; means are made by the
method's own weights.

A, b and c are derivatives of the model's own right-hand side: no equation is written again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.backend import Gradual, backend_in_use
from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.hoisting import hoisted
from apu_casadi.core.means import Term
from apu_casadi.core.sharing import Rebuilt, kept
from apu_casadi.machine.exciterstep import exciter_step
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.transition import SPEED_RANGE, coefficients, inverse, radau, split

STAGES = 4
#: Strides in a turn of the rotor, by "is symmetric": what ripples under a fault needs more.
STRIDES = {True: 16, False: 20}
REFINED = 1  # times that the stages are corrected by the residual that they leave
DOUBLED = 20  # strides at the start, each as long as all before it: from 0.2 ns on
MOST = 500  # strides; in longer steps an adaptive integrator is as fast
#: Largest error of E_fd, per unit, that the windings see at the end of a stride: a limit of the
#: regulator that is met or left makes it larger.
DRIVE_TOL = 2e-6
#: Largest mean of what the stages' polynomials leave out, nominal units; means err by a thousandth.
STAGE_TOL = 2e-3


def shares(strides: int) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and lengths of strides, as shares of a step."""
    ends = np.append(2.0 ** np.arange(-DOUBLED, 1), np.arange(2, strides + 1)) / strides
    starts = np.append(0.0, ends[:-1])
    return starts, ends - starts


def _node(ss: GeneratorModel) -> tuple[ca.Function, ca.Function]:
    """A, b and c at a rotor angle, and what of them follows from (u, theta) alone."""
    n = len(ss.linear)
    sizes = {"angle": 1, "u": len(ss.u), "theta": len(ss.theta)}
    angle, u, th = (ca.SX.sym(k, m) for k, m in sizes.items())
    M = coefficients(ss)(angle, u, th)
    parts = [M[:n, :n], ca.densify(ca.horzcat(M[:n, n], M[:n, -1]))]
    return hoisted("node", [angle], ca.vertcat(u, th), [ca.densify(p) for p in parts])


def _seen(ss: GeneratorModel, quad: tuple[str, ...]) -> tuple[ca.Function, ca.Function]:
    """Terms of the means and terminal voltage at a state, and what follows from (u, theta)."""
    x, u, th = (ca.SX.sym(k, len(s)) for k, s in zip("xut", (ss.x, ss.u, ss.theta), strict=True))
    tau, y = ca.SX.sym("tau"), ss.g(x, u, th)
    terms = ca.vertcat(*(Term.of(q).expression(ss, x, y, tau) for q in quad))
    return hoisted("seen", [x, tau], ca.vertcat(u, th), [terms, y[ss.y.index("V_t")]])


def _quadratic(c: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Values at start, middle and end of the quadratic that has the first moments of the stages."""
    k = np.arange(3)
    powers = np.linalg.inv(1 / (k[:, None] + k + 1)) @ (b * c ** k[:, None])
    return np.asarray((k[:, None] / 2) ** k @ powers)


def _stages(x: Any, h: Any, A: list[Any], F: Any) -> list[Any]:
    """Solve for the stages; A and F of each, the latter side by side.

    A short circuit's loop makes entries of A so large that elimination without pivots loses half
    of the digits: the residual that is left, solved for once more, gives them back.
    """
    s, n, (_, a) = len(A), x.numel(), radau(len(A))
    ha = [[h * float(a[i, j]) for j in range(s)] for i in range(s)]
    D = [[ca.DM(np.eye(n) * (i == j)) - ha[i][j] * A[j] for j in range(s)] for i in range(s)]
    inverted = []
    for k in range(s):
        inverted.append(inverse(n)(D[k][k]))
        for j in range(k + 1, s):
            D[k][j] = ca.mtimes(inverted[k], D[k][j])
            for i in range(k + 1, s):
                D[i][j] = D[i][j] - ca.mtimes(D[i][k], D[k][j])

    def solved(rhs: list[Any]) -> list[Any]:
        X: list[Any] = []
        for k in range(s):
            left = sum((ca.mtimes(D[k][j], X[j]) for j in range(k)), start=ca.MX(n, 1))
            X.append(ca.mtimes(inverted[k], rhs[k] - left))
        for k in range(s - 2, -1, -1):
            X[k] = X[k] - sum(ca.mtimes(D[k][j], X[j]) for j in range(k + 1, s))
        return X

    def over(rates: list[Any]) -> list[Any]:
        return [sum(ha[i][j] * rates[j] for j in range(s)) for i in range(s)]

    F = ca.horzsplit(F)
    by = solved(over([ca.mtimes(A_j, x) + F_j for A_j, F_j in zip(A, F, strict=True)]))
    for _ in range(REFINED):
        X = [x + Z for Z in by]
        left = over([ca.mtimes(A_j, X_j) + F_j for A_j, X_j, F_j in zip(A, X, F, strict=True)])
        more = solved([own - Z for own, Z in zip(left, by, strict=True)])
        by = [Z + d for Z, d in zip(by, more, strict=True)]
    return [x + Z for Z in by]


class _Parts(NamedTuple):
    """What a stride is made of; each with what of it follows from (u, theta) alone."""

    node: tuple[ca.Function, ca.Function]
    seen: tuple[ca.Function, ca.Function]


def _stride(ss: GeneratorModel, parts: _Parts, n_means: int) -> ca.Function:
    """Function (state, [start, length] as shares, d, e, u, theta, dt) -> state.

    The state holds that of the model, sums of the means, terminal voltage, and both errors so far.
    """
    nx, at, (c, a) = len(ss.x), split(ss), radau(STAGES)
    (node, fixed), (seen, seen_fixed) = parts
    drive, exciter = exciter_step(ss)
    sizes = {"S": nx + n_means + 3, "f": 2, "d": fixed.numel_out(0), "e": seen_fixed.numel_out(0)}
    sizes |= {"u": len(ss.u), "th": len(ss.theta), "dt": 1}
    S, f, d, e, u, th, dt = given = [ca.MX.sym(k, m) for k, m in sizes.items()]
    x, sums, (V0, miss, doubt) = S[:nx], S[nx:-3], ca.vertsplit(S[-3:])
    h, V_ref, slow = f[1] * dt, u[ss.u.index("V_ref")], x[at.slow]
    E = ca.vertsplit(drive(slow, V0, V_ref, th))
    angles, drives, A, F = [], [], [], []
    for t in (h * float(c_i) for c_i in c):
        angles.append(x[at.angle] + u[ss.u.index("w_r")] * t)
        drives.append(sum(v * t**i / math.factorial(i) for i, v in enumerate(E)))
        A_i, b_i = node(angles[-1], d)
        A.append(A_i)
        F.append(b_i[:, 0] * drives[-1] + b_i[:, 1])
    X = _stages(x[at.linear], h, A, ca.horzcat(*F))
    V, terms = [], []
    for X_i, angle, E_i, c_i in zip(X, angles, drives, c, strict=True):
        x_i = ca.MX(x)
        x_i[at.linear], x_i[at.angle], x_i[at.drive] = X_i, angle, E_i
        its, V_i = seen(x_i, f[0] + f[1] * float(c_i), e)
        V.append(V_i)
        terms.append(its)
    voltages = ca.mtimes(ca.DM(_quadratic(c, a[-1])), ca.vertcat(*V))
    x_i[at.slow] = exciter(slow, voltages, V_ref, th, h)
    miss = ca.fmax(miss, ca.fabs(x_i[at.drive] - drives[-1]))
    # the polynomial through start and stages: its highest coefficient
    highest = np.linalg.inv(np.vander(np.append(0.0, c), increasing=True))[-1]
    off = ca.mtimes(ca.horzcat(x[at.linear], *X), ca.DM(highest)) / ss.x.nominals[at.linear]
    doubt = doubt + f[1] * ca.mmax(ca.fabs(off))
    sums = sums + f[1] * ca.mtimes(ca.horzcat(*terms), ca.DM(a[-1]))
    return ca.Function("stride", given, [ca.vertcat(x_i, sums, V[-1], miss, doubt)])


@kept
def _collocated(ss: GeneratorModel, quad: tuple[str, ...], strides: int) -> ca.Function:
    """Function (x0, nothing, u, theta, dt) -> (x, mean, miss)."""
    sizes = {"x0": len(ss.x), "series": 1, "u": len(ss.u), "theta": len(ss.theta), "dt": 1}
    x0, _, u, th, dt = given = [ca.MX.sym(k, n) for k, n in sizes.items()]
    parts, nx = _Parts(_node(ss), _seen(ss, quad)), len(ss.x)
    before = [fixed(ca.vertcat(u, th)) for _, fixed in parts]
    _, V_start = parts.seen[0](x0, 0, before[1])
    now = ca.vertcat(x0, ca.DM.zeros(len(quad)), V_start, 0, 0)
    when = ca.DM(shares(strides))
    run = _stride(ss, parts, len(quad)).mapaccum("strides", when.shape[1], 1)
    end = run(now, when, *(ca.repmat(v, 1, when.shape[1]) for v in (*before, u, th, dt)))[:, -1]
    made = [end[:nx], end[nx:-3], end[-2:]]
    name = f"collocated_{ss.name}_{strides}"
    return ca.Function(name, given, made, [*sizes], ["x", "mean", "miss"])


class Collocated(Rebuilt):
    """A step of one model variant with one load and fault, of any length and at any time.

    Args:
        ss: model variant, linear in its windings.
        theta: fault parameters.
        dt: length of the step, s.
        longest: length that there may be, s, and rated speed, rad/s electrical.
        quad: what is averaged over the step, see :mod:`apu_casadi.core.means`.
        symmetric: whether the phases differ by rotation only.

    Raises:
        NotApplicable: the model is not linear in its windings, or the step is too long.
    """

    ss: GeneratorModel
    dt: float
    quad: tuple[str, ...]
    theta: np.ndarray
    layout: tuple[Any, ...]

    outputs: tuple[str, ...] = ()
    n_out = 0
    limits = np.array([DRIVE_TOL, STAGE_TOL])
    parameters = np.zeros(1)

    def __init__(
        self,
        ss: GeneratorModel,
        theta: np.ndarray,
        dt: float,
        *,
        longest: tuple[float, float],
        quad: Sequence[str],
        symmetric: bool,
    ) -> None:
        if not ss.linear:
            raise NotApplicable(f"{ss.name}: {ss.nonlinear}")
        turns = (1 + SPEED_RANGE) * math.prod(longest) / (2 * math.pi)
        self.strides = math.ceil(STRIDES[symmetric] * turns)
        if self.strides > MOST:
            raise NotApplicable(f"{ss.name}: {self.strides} strides in a step, {MOST} at most")
        self.ss, self.dt, self.quad, self.theta = ss, dt, tuple(quad), ss.full(theta)
        self.layout = (ss.shared, self.quad, self.strides)

    @property
    def advance(self) -> ca.Function:
        """Function (x, nothing, u, theta, dt) -> (x, mean, miss)."""
        return _collocated(*self.layout)

    def valid(self, _w_r: float) -> bool:
        """Whether the speed, rad/s electrical, is one that it is made for: every one is."""
        return True

    def __call__(self, x0: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Advance by the step; return the state at its end and the means.

        Raises:
            NotApplicable: the strides do not resolve windings or exciter.
        """
        call = _caller(*self.layout, backend_in_use())
        x, mean, miss = call(x0, self.parameters, u, self.theta, self.dt)
        if not (np.all(miss <= self.limits) and math.isfinite(float(x.sum() + mean.sum()))):
            raise NotApplicable(
                f"{self.ss.name}: step of {self.dt:.6g} s: errors of E_fd and of the stages "
                f"{miss.tolist()} > {self.limits.tolist()}, or values that are not finite"
            )
        return x, mean


@kept
def _caller(ss: GeneratorModel, quad: tuple[str, ...], strides: int, _in_use: str) -> Gradual:
    """The function in the backend in use, one for each layout."""
    return Gradual(_collocated(ss, quad, strides), level=3)
