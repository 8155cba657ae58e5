"""The unscented Kalman filter in square-root form, with cubature and scaled points.

Points (Julier and Uhlmann 1997; scaled: Julier 2002, Wan and van der Merwe 2001; cubature:
Arasaratnam and Haykin 2009) are drawn from the joint of state and noise w, since w acts on output
and transition alike; what the filter carries is a lower triangular root of the covariance (van der
Merwe and Wan 2001), which is never squared on the way.

Weights of either sign do no harm here.  With c = alpha^2 (n + kappa) and the points
m +- sqrt(c) L_i in pairs, let, for a function h,

    d_i = (h_i+ - h_i-) / (2 sqrt(c)),   s_i = (h_i+ + h_i- - 2 h_0) / (2 c),   delta = sum s_i.

Then the scaled transform is, exactly::

    mean = h_0 + delta,
    cov = sum d_i d_i' + c sum s_i s_i' + (beta - alpha^2) delta delta'
        = sum d_i d_i' + sum q_i q_i',   q_i = sqrt(c) (s_i + eta delta),

with eta = (sqrt(1 + n (beta - alpha^2) / c) - 1) / n, and its cross-covariance with the argument is
sum L_i d_i'.  The d_i stand for the Jacobian times L, the q_i for what curvature adds: a sum of
squares, so that nothing is ever downdated.  alpha = 1, beta = 0, kappa = 0 are the cubature points,
where q_i does not depend on h_0.

Rows and columns that are zero by structure (a noise that no output sees, a parameter that walks)
are found when the filter is built, and cost nothing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import casadi as ca

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.core.sharing import kept, of_family
from estimators.filters.algebra import forward, graded_lower, qr_lower, root_update, without_gain
from estimators.filters.belief import Belief
from estimators.filters.filtering import ROOT_OUT, STEP_IN, STEP_OUT, FilterResult, FilterStep, run
from estimators.filters.stepparts import projected, step_symbols
from estimators.models.filtermodel import FilterModel
from estimators.models.recording import Recording

__all__ = ["POINTS", "PointSet", "ukf_step", "unscented_kalman_filter"]

POINTS = ("cubature", "scaled")


@dataclass(frozen=True)
class PointSet:
    """Where a filter evaluates the model, for a Gaussian of n dimensions.

    Args:
        n: dimension.
        c: squared distance of the points from the mean, in standard deviations.
        central: the mean itself is a point.
        eta: see the module's text.
    """

    n: int
    c: float
    central: bool
    eta: float

    @classmethod
    def of(cls, n: int, points: str, alpha: float, beta: float, kappa: float) -> PointSet:
        """Make the set from the usual numbers.

        Raises:
            ParameterError: unknown name; alpha or alpha^2 (n + kappa) not positive; beta so low
                that the covariance could become negative, n beta + alpha^2 kappa < 0.
        """
        if points not in POINTS:
            raise ParameterError(f"points {points!r} {nearest(points, POINTS)}")
        if points == "cubature":
            return cls(n, float(n), False, -1 / n)
        alpha, beta, kappa = (
            number(label, v, error=ParameterError)
            for label, v in (("alpha", alpha), ("beta", beta), ("kappa", kappa))
        )
        if not all(math.isfinite(v) for v in (alpha, beta, kappa)) or alpha <= 0:
            raise ParameterError(
                f"alpha = {alpha!r}, beta = {beta!r}, kappa = {kappa!r}: finite numbers with "
                "alpha > 0 expected"
            )
        c = alpha**2 * (n + kappa)
        if c <= 0:
            raise ParameterError(f"kappa = {kappa!r} must be > -{n}, the joint dimension")
        room = n * beta + alpha**2 * kappa
        if room < 0:
            raise ParameterError(
                f"alpha = {alpha!r}, beta = {beta!r}, kappa = {kappa!r} with {n} dimensions: "
                f"n beta + alpha^2 kappa = {room:.3g} < 0, covariances could become negative; "
                "raise beta"
            )
        # 1 + n (beta - alpha^2) / c, without cancellation
        return cls(n, c, True, (math.sqrt(room / c) - 1) / n)


class _Mapped:
    """One function of the joint (x, w) at all points that can tell, and the transform of it."""

    def __init__(
        self, fun: ca.Function, model: FilterModel, points: PointSet, root: ca.Sparsity
    ) -> None:
        """Find the structure; ``root`` is the pattern of the root that the points come from."""
        nx, _, _, nw, _ = model.sizes
        self.points, self.nx = points, nx
        J = ca.horzcat(fun.sparsity_jac(0, 0), fun.sparsity_jac(3, 0))
        pattern = ca.DM(J, 1) @ ca.DM(root, 1)
        # columns that move the function at all
        self.columns = [i for i in range(nx + nw) if pattern[:, i].nnz()]
        self.pattern = pattern.sparsity()
        self.straight = _straight(fun, nx)
        k = len(self.columns)
        # instead of the points that change nothing, the mean once
        self.central = points.central or k < points.n
        self.count = 2 * k + self.central
        # u, p (and dt) are common to all points
        common = [i for i in range(fun.n_in()) if i not in (0, 3)]
        self.fun = fun.map(f"{fun.name()}_points", "serial", self.count, common, [])

    def at(self, mean: ca.SX, L: ca.SX) -> ca.SX:
        """Points of (x, w) as columns: plus, minus, then the mean itself if it is one of them."""
        step = math.sqrt(self.points.c) * L[:, self.columns]
        k = len(self.columns)
        cols = [ca.repmat(mean, 1, k) + step, ca.repmat(mean, 1, k) - step]
        return ca.densify(ca.horzcat(*cols, *([mean] if self.central else [])))

    def __call__(self, at: Any, *common: Any) -> Any:
        """Values (and checks below them) at the points, as columns; ``common`` is u, p (, dt)."""
        args = [at[: self.nx, :], *common[:2], at[self.nx :, :], *common[2:]]
        return ca.vertcat(*self.fun(*args))

    def transform(self, values: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """(mean, D, Q, check) of the values at the points; cov = D D' + Q Q'."""
        check = ca.sum2(values[-1, :])
        values = values[:-1, :]
        k, c, n = len(self.columns), self.points.c, self.points.n
        plus, minus = values[:, :k], values[:, k : 2 * k]
        D = ca.SX(values.shape[0], n)
        D[:, self.columns] = (plus - minus) / (2 * math.sqrt(c))
        D = ca.project(D, self.pattern)
        # without a central point (cubature) any middle gives the same; the mean makes delta vanish
        middle = values[:, -1] if self.central else ca.sum2(plus + minus) / (2 * k)
        s = (plus + minus - 2 * ca.repmat(middle, 1, k)) / (2 * c)
        for i in self.straight:
            s[i, :] = 0
        s = ca.sparsify(s)
        if not self.central:
            return middle, D, math.sqrt(c) * s, check
        delta = ca.sum2(s)
        eta = self.points.eta
        Q = math.sqrt(c) * (s + ca.repmat(eta * delta, 1, k))
        if eta and k < n:
            # n - k columns have s = 0 and are all alike
            Q = ca.horzcat(Q, math.sqrt(c * (n - k)) * eta * delta)
        return middle + delta, D, Q, check


def _straight(fun: ca.Function, nx: int) -> list[int]:
    """Rows of the first output that are linear in x and w; found for scalar operations only."""
    if not fun.is_a("SXFunction"):
        return []
    args = [ca.SX.sym(fun.name_in(i), fun.size1_in(i)) for i in range(fun.n_in())]
    value, s = fun(*args)[0], ca.vertcat(args[0], args[3])
    if not s.shape[0]:
        return []
    bent = ca.which_depends(value, s, 2, True)
    return [i for i, b in enumerate(bent) if not b]


@kept
@of_family
def ukf_step(
    model: FilterModel,
    points: str = "cubature",
    alpha: float = 1.0,
    beta: float = 2.0,
    kappa: float = 0.0,
) -> FilterStep:
    """Build the filter's step for a model; it carries square roots.

    Args:
        model: the model.
        points: ``"cubature"`` (2n points) or ``"scaled"`` (2n + 1); n counts states and noises.
        alpha, beta, kappa: of the scaled points.  alpha far below 1 keeps the points close to the
            mean and loses digits: differences of the model are divided by alpha and alpha^2.

    Raises:
        ParameterError: see :meth:`PointSet.of`; a model without states.
    """
    step = _built(model, points, alpha, beta, kappa, False)
    wide = partial(_built, model, points, alpha, beta, kappa, True)
    return dataclasses.replace(step, wide=wide)


@kept
def _built(
    model: FilterModel, points: str, alpha: float, beta: float, kappa: float, roots: bool
) -> FilterStep:
    """The step, with ``ROOT_OUT`` for the smoother if ``roots``."""
    nx, _, _, nw, ny = model.sizes
    n = nx + nw
    if not nx:
        raise ParameterError(f"{model.name} has no states to estimate")
    which = PointSet.of(n, points, alpha, beta, kappa)
    model = model.expanded()
    fixed = tuple(model.x.indices(model.consider))
    lower = ca.Sparsity.lower(nx)
    before = ca.diagcat(ca.DM(lower, 1), ca.DM.eye(nw)).sparsity()
    g = _Mapped(model.output, model, which, before)
    f = _Mapped(model.transition, model, which, ca.Sparsity.lower(n))

    m, P = ca.SX.sym("m", nx), ca.SX.sym("L", lower)
    start = ca.vertcat(m, ca.SX.zeros(nw))
    La = ca.diagcat(P, ca.SX.eye(nw))
    first = ca.Function("first", [m, P], [g.at(start, La)])

    values, y, R = ca.SX.sym("g", ny + 1, g.count), ca.SX.sym("y", ny), ca.SX.sym("R", ny)
    mean, La, nu_, S, stats = _updated(model, g, start, La, values, y, R, fixed)
    P_f = ca.tril(La[:nx, :nx] @ La[:nx, :nx].T)
    P_f = P_f + ca.tril(P_f, False).T
    mean = projected(mean, La @ La[:nx, :].T, model.lower, model.upper, fixed)
    out = [f.at(mean, La), mean[:nx], P_f, ca.project(La, ca.Sparsity.lower(n)), nu_, S, stats]
    update = ca.Function("update", [m, P, values, y, R], ca.cse(out))

    values, dt = ca.SX.sym("f", nx + 1, f.count), ca.SX.sym("dt")
    La = ca.SX.sym("L", ca.Sparsity.lower(n))
    x1, D, Q, check = f.transform(values)
    walk = ca.sparsify(ca.diag(ca.DM(model.walk))) * ca.sqrt(dt)
    out, names = [x1], STEP_OUT
    if roots:
        width = Q.shape[1] + walk.shape[1]
        own = ca.horzcat(La[:nx, :], ca.SX(nx, width))
        G = graded_lower(ca.sparsify(ca.vertcat(ca.horzcat(D, Q, walk), own)))
        names = STEP_OUT + ROOT_OUT
        out += [G[:nx, :nx], La[:nx, :] @ D.T, check, G[nx:, :nx], G[nx:, nx:], La[:nx, :nx]]
        out = [ca.densify(o) for o in out]
    else:
        L1 = qr_lower(ca.sparsify(ca.horzcat(D, Q, walk)))
        out += [ca.densify(L1), ca.densify(La[:nx, :] @ D.T), check]
    predict = ca.Function("predict", [values, La, dt], ca.cse(out))

    s = step_symbols(model, ca.MX)
    m, P, u, p, y, R, dt = s
    P = ca.project(P, lower)
    at, m_f, P_f, La, nu_, S, stats = update(m, P, g(first(m, P), u, p), y, R)
    x1, L1, C, check, *more = predict(f(at, u, p, dt), La, dt)
    stats = ca.vertcat(stats[0] + check, stats[1:])
    name = f"ukf_{points}_{'roots_' if roots else ''}{model.name}"
    out = [ca.densify(o) for o in (x1, L1, m_f, P_f, C, nu_, S, stats, *more)]
    return FilterStep(model, ca.Function(name, s, out, STEP_IN, names), root=True)


def _unwrapped(model: FilterModel, g: _Mapped, values: ca.SX) -> ca.SX:
    """Outputs at the points with angles within half a turn of their circular mean.

    Mardia and Jupp (2000), Directional Statistics, section 2.2.1: the direction of the sum of unit
    vectors.  All points are moved by the same number of turns where they lie on one side, so that
    nothing is rounded; an output that is linear counts turns and needs none of this.
    """
    for name, period in model.angles:
        i = model.y.index(name)
        if i in g.straight:
            continue
        v, turn = values[i, :], 2 * math.pi / period
        mean = ca.atan2(ca.sum2(ca.sin(turn * v)), ca.sum2(ca.cos(turn * v))) / turn
        turns = ca.floor((v - mean) / period + 0.5)
        values[i, :] = v - period * (turns - turns[0])
    return values


def _updated(
    model: FilterModel,
    g: _Mapped,
    mean: ca.SX,
    L: ca.SX,
    values: ca.SX,
    y: ca.SX,
    R: ca.SX,
    fixed: tuple[int, ...],
) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
    """(mean, root, innovation, its covariance, stats) after a sample."""
    ny = y.shape[0]
    there = R >= 0
    expected, D, Q, check = g.transform(_unwrapped(model, g, ca.SX(values)))
    # what is not measured: no innovation, no sensitivity, unit noise
    nu = ca.if_else(there, model.innovation(y, expected), 0)
    D, Q = (ca.sparsify(ca.diag(there) @ M) for M in (D, Q))
    noise = ca.diag(ca.sqrt(ca.if_else(there, R, 1)))
    W = qr_lower(ca.horzcat(noise, Q)) if Q.nnz() else noise
    done = root_update(L, ca.sparsify(forward(W, D)), forward(W, nu))
    gain, L1 = without_gain(done.gain, done.L, fixed)
    S = D @ D.T + W @ W.T
    nis = ca.dot(done.e, done.e)
    measured = ca.sum1(there)
    logdet = done.logdet + 2 * sum((ca.log(W[i, i]) for i in range(ny)), ca.SX(0))
    loglik = -0.5 * (nis + logdet + measured * math.log(2 * math.pi))
    return mean + gain @ done.e, L1, nu, S, ca.vertcat(check, nis, loglik, measured)


def unscented_kalman_filter(
    model: FilterModel,
    prior: Belief,
    data: Recording,
    *,
    points: str = "cubature",
    alpha: float = 1.0,
    beta: float = 2.0,
    kappa: float = 0.0,
    full: bool = False,
    backend: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FilterResult:
    """Filter a recording: p(x(k) | y(0..k)) as Gaussians.

    Args:
        model: the model.
        prior: belief at the first instant, before its sample.
        data: the recording.
        points, alpha, beta, kappa: see :func:`ukf_step`.
        full, backend, progress: see :func:`estimators.filters.filtering.run`.

    Raises:
        ParameterError: see :func:`ukf_step`.
        DataError, SignalError, EstimationError: see :func:`estimators.filters.filtering.run`.
    """
    step = ukf_step(model, points, alpha, beta, kappa)
    return run(step, prior, data, full=full, backend=backend, progress=progress)
