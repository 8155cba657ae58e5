"""The square-root unscented filter against the transform by hand, and against the extended one.

Julier (2002), scaled unscented transform; Arasaratnam and Haykin (2009), cubature; Schmidt's
considered parameters.  1e-9 on linear models: rounding only.  What it shares with other filters is
in ``test_filters.py``.
"""

import dataclasses

import casadi as ca
import numpy as np
import pytest
from estimation_models import (
    cv_model,
    gappy,
    linear,
    pendulum,
    pendulum_data,
    random_belief,
    random_linear,
    signals,
)
from numpy.testing import assert_allclose

from apu_casadi.core.errors import EstimationError, ParameterError
from apu_casadi.core.signals import Signals
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.filtering import STEP_IN, STEP_OUT
from estimators.filters.ukf import PointSet, ukf_step, unscented_kalman_filter
from estimators.models.filtermodel import FilterModel, Unknown

EXACT = dict(rtol=1e-9, atol=1e-9)
SETS = {
    "cubature": {"points": "cubature"},
    "scaled": {"points": "scaled"},
    "close": {"points": "scaled", "alpha": 0.05},
    "negative centre": {"points": "scaled", "alpha": 0.5, "beta": 0.1, "kappa": -0.5},
    "beta < alpha^2": {"points": "scaled", "beta": 0.3},
}
every_set = pytest.mark.parametrize("points", SETS.values(), ids=SETS.keys())


def ukf(model, prior, data, **options):
    return unscented_kalman_filter(
        model, prior, data, **({"full": True, "backend": "vm"} | options)
    )


def transform(f, m, P, *, alpha=1.0, beta=0.0, kappa=0.0):
    """The scaled transform with its weights, as in Julier (2002): mean, cov, cross-covariance."""
    n = m.size
    c = alpha**2 * (n + kappa)
    L = np.linalg.cholesky(P)
    X = np.array([m, *(m + np.sqrt(c) * L.T), *(m - np.sqrt(c) * L.T)])
    W = np.full(2 * n + 1, 0.5 / c)
    W[0] = 1 - n / c
    Wc = W.copy()
    Wc[0] += 1 - alpha**2 + beta
    Y = np.array([f(x) for x in X])
    y = W @ Y
    return y, (Y - y).T @ (Wc[:, None] * (Y - y)), (X - m).T @ (Wc[:, None] * (Y - y))


@every_set
def test_nonlinear_step_against_the_transform_by_hand(points):
    """One sample and one transition of the pendulum, joint in state and input error, in covariance
    form with explicit weights: 1e-9 but for the digits that alpha = 0.05 costs."""
    model = pendulum()
    data = pendulum_data(model, K=2)
    P0 = np.array([[0.09, 0.05, 0], [0.05, 1, 0.1], [0, 0.1, 0.25]])
    prior = Belief(model.x, np.array([0.8, -0.5, 5]), P0)
    u, p, dt = data.u[:, 0], data.p, data.dt[0]
    weights = {k: v for k, v in points.items() if k != "points"}
    if points["points"] == "scaled":
        weights = {"beta": 2.0} | weights
    g = lambda s: np.array(model.output(s[:3], u, p, s[3:])[0]).ravel()  # noqa: E731
    f = lambda s: np.array(model.transition(s[:3], u, p, s[3:], dt)[0]).ravel()  # noqa: E731
    s, P = np.append(prior.mean, 0), np.zeros((4, 4))
    P[:3, :3], P[3, 3] = P0, 1
    y, S, C = transform(g, s, P, **weights)
    S = S + np.diag(data.variance[:, 0])
    s = s + C @ np.linalg.solve(S, data.y[:, 0] - y)
    P = P - C @ np.linalg.solve(S, C.T)
    x1, P1, cross = transform(f, s, P, **weights)
    P1 = P1 + np.diag(model.walk**2) * dt
    r = ukf(model, prior, data, **points)
    tol = dict(rtol=1e-9, atol=1e-9)
    assert_allclose(r.innovation[:, 0], data.y[:, 0] - y, **tol)
    assert_allclose(r.innovation_cov[0], S, **tol)
    assert_allclose(r.mean[:, 0], s[:3], **tol)
    assert_allclose(r.cov[0], P[:3, :3], **tol)
    assert_allclose(r.mean_pred[:, 1], x1, **tol)
    assert_allclose(r.cov_pred[1], P1, **tol)
    assert_allclose(r.cross[0], cross[:3], **tol)


@every_set
def test_points_left_out_change_nothing(points):
    """A noise that the output does not see, and a last state that it does not see: their points are
    not evaluated; the weights still count them (transform by hand, 1e-9)."""
    x, u, p, w, dt = (ca.SX.sym(n, k) for n, k in zip("xupwd", (2, 0, 0, 2, 1), strict=True))
    model = FilterModel(
        "hidden",
        signals("a b"), Signals(), Signals(), signals("w v"), signals("y z"),
        transition=ca.Function("f", [x, u, p, w, dt], [
            ca.vertcat(x[0] + dt * ca.sin(x[1]) + 0.1 * w[0] ** 2, x[1] + 0.2 * w[1] * x[0]), 0]),
        output=ca.Function("g", [x, u, p, w], [ca.vertcat(ca.exp(x[0]), x[0]), 0]),
        walk=np.array([0.1, 0.2]), lower=np.full(2, -np.inf), upper=np.full(2, np.inf),
    )  # fmt: skip
    maps = [f for f in ukf_step(model, **points).function.find_functions()
            if "points" in f.name()]  # fmt: skip
    widths = sorted(f.size2_out(0) for f in maps)
    assert widths[0] == 3, "one state seen by the output: two points and the mean"
    prior, data = random_belief(0, model), gappy(0, model, 2, missing=0.0)
    weights = {k: v for k, v in points.items() if k != "points"}
    if points["points"] == "scaled":
        weights = {"beta": 2.0} | weights
    P = np.eye(4)
    P[:2, :2] = prior.cov
    s = np.append(prior.mean, [0, 0])
    y, S, C = transform(lambda s: np.array([np.exp(s[0]), s[0]]), s, P, **weights)
    S = S + np.diag(data.variance[:, 0])
    s, P = s + C @ np.linalg.solve(S, data.y[:, 0] - y), P - C @ np.linalg.solve(S, C.T)
    d = data.dt[0]
    f = lambda s: np.array([s[0] + d * np.sin(s[1]) + 0.1 * s[2] ** 2, s[1] + 0.2 * s[3] * s[0]])  # noqa: E731
    x1, P1, _ = transform(f, s, P, **weights)
    r = ukf(model, prior, data, **points)
    assert_allclose(r.mean[:, 0], s[:2], **EXACT)
    assert_allclose(r.mean_pred[:, 1], x1, **EXACT)
    assert_allclose(r.cov_pred[1], P1 + np.diag([0.01, 0.04]) * d, **EXACT)


@every_set
def test_a_bend_by_cases_is_not_taken_for_a_straight_line(points):
    """if_else and fabs look linear piece by piece; what curvature adds must not be left out."""
    x, u, p, w, dt = (ca.SX.sym(n, k) for n, k in zip("xupwd", (2, 0, 0, 0, 1), strict=True))
    model = FilterModel(
        "bent",
        signals("a b"), Signals(), Signals(), Signals(), signals("y"),
        transition=ca.Function("f", [x, u, p, w, dt], [
            ca.vertcat(ca.if_else(x[0] > 0, 2 * x[0], x[0]), ca.fabs(x[1])), 0]),
        output=ca.Function("g", [x, u, p, w], [x[0], 0]),
        walk=np.zeros(2), lower=np.full(2, -np.inf), upper=np.full(2, np.inf),
    )  # fmt: skip
    prior = Belief(model.x, np.array([0.1, 0.1]), np.eye(2))
    data = gappy(0, model, 2, missing=2.0)
    weights = {k: v for k, v in points.items() if k != "points"}
    if points["points"] == "scaled":
        weights = {"beta": 2.0} | weights
    f = lambda s: np.array([2 * s[0] if s[0] > 0 else s[0], abs(s[1])])  # noqa: E731
    x1, P1, _ = transform(f, prior.mean, prior.cov, **weights)
    r = ukf(model, prior, data, **points)
    assert_allclose(r.mean_pred[:, 1], x1, **EXACT)
    assert_allclose(r.cov_pred[1], P1, **EXACT)


def test_better_than_linearisation_where_it_must_be():
    """y = x^2 at x ~ N(0, 1): mean 1, variance 2.  Scaled points with kappa = 2 (n + kappa = 3)
    know both exactly, the extended filter expects 0 and learns nothing."""
    x, u, p, w, dt = (ca.SX.sym(n, k) for n, k in zip("xupwd", (1, 0, 0, 0, 1), strict=True))
    model = FilterModel(
        "square",
        signals("a"), Signals(), Signals(), Signals(), signals("y"),
        transition=ca.Function("f", [x, u, p, w, dt], [x, 0]),
        output=ca.Function("g", [x, u, p, w], [x**2, 0]),
        walk=np.zeros(1), lower=np.full(1, -np.inf), upper=np.full(1, np.inf),
    )  # fmt: skip
    prior, data = Belief(model.x, np.zeros(1), np.eye(1)), gappy(0, model, 1, missing=0.0)
    r = ukf(model, prior, data, points="scaled", beta=0.0, kappa=2.0)
    assert_allclose(data.y[0, 0] - r.innovation[0, 0], 1.0, rtol=1e-12)
    assert_allclose(r.innovation_variance[0, 0] - data.variance[0, 0], 2.0, rtol=1e-12)
    e = extended_kalman_filter(model, prior, data, backend="vm")
    assert e.innovation[0, 0] == data.y[0, 0]


@every_set
def test_considered_states_as_in_the_extended_filter(points):
    """On a linear model both Schmidt filters are the same, and mean and variance stay."""
    base, (A, B, G, C, D) = random_linear(7, nx=4)
    A[1], B[1], G[1] = [0, 1, 0, 0], 0, 0
    walk = base.walk * [1, 0, 1, 1]
    model = dataclasses.replace(linear(A, B, G, C, D, walk), consider=("x1",))
    prior, data = random_belief(7, model), gappy(7, model, 40)
    a = extended_kalman_filter(model, prior, data, full=True, backend="vm")
    b = ukf(model, prior, data, **points)
    for name in ("mean", "cov", "cov_pred", "cross", "nis", "loglik"):
        assert_allclose(getattr(a, name), getattr(b, name), **EXACT, err_msg=name)
    assert_allclose(b.variance[1], prior.cov[1, 1], rtol=1e-9)


def test_bounds_as_in_the_extended_filter():
    """Projection of the mean along the covariance."""
    model = dataclasses.replace(cv_model(), lower=np.array([-np.inf, -0.1, -0.2]))
    prior, data = random_belief(10, model), gappy(10, model, 60)
    a = extended_kalman_filter(model, prior, data, backend="vm")
    b = ukf(model, prior, data)
    assert_allclose(a.mean, b.mean, **EXACT)
    assert (np.isclose(b.mean[1], -0.1)).any()
    assert (b.mean[1:] >= np.array([[-0.1], [-0.2]])).all()


def test_square_roots_keep_what_covariances_lose():
    """A direction known 1e10 times better than another, correlated: the squares are 1e20 apart,
    beyond double precision, and the filter still has the variance right to 1e-6."""
    model = linear(np.eye(2), [[0], [0]], [[0], [0]], [[1.0, 1.0]], [[0.0]], [0, 0])
    data = gappy(0, model, 2, missing=0.0)
    s = 1e-10
    data = dataclasses.replace(data, variance=np.full((1, 2), s**2), y=np.zeros((1, 2)))
    f = ukf_step(model).function
    got = dict(zip(STEP_OUT, f(*[np.zeros(2), np.eye(2), np.zeros(1), np.zeros(0), np.zeros(1),
                                 np.full(1, s**2), 0.0]), strict=True))  # fmt: skip
    L = np.array(got["P1"])
    # variance of the measured sum: 1/(1/2 + 1/s^2) = s^2; rows of L added
    assert_allclose(np.linalg.norm(L[0] + L[1]), s, rtol=1e-6)


def test_what_the_step_carries():
    """Inputs and outputs as every filter's; P1 is a lower triangular root, not negative."""
    model = pendulum()
    step = ukf_step(model)
    assert step.root and step.function.name_in() == STEP_IN
    assert step.function.name_out() == STEP_OUT
    data = pendulum_data(model, K=2)
    rng = np.random.default_rng(0)
    L = np.tril(rng.standard_normal((3, 3)))
    out = step.function(np.array([0.5, 0, 5]), L, data.u[:, 0], data.p, data.y[:, 0],
                        data.variance[:, 0], 0.05)  # fmt: skip
    L1 = np.array(out[1])
    assert (np.triu(L1, 1) == 0).all() and (np.diag(L1) >= 0).all()


def test_bounded_severity_of_a_nonlinear_model_stays_inside():
    """A parameter as a bounded state of the pendulum."""
    model = pendulum(d=Unknown(walk=0.05, lower=0.0))
    # d is a state here, and no parameter any more
    data = dataclasses.replace(pendulum_data(pendulum()), p=np.zeros(0))
    prior = Belief.of(model.x, {"q": 0.8, "r": 0, "k": 5, "d": 0.05},
                      {"q": 0.3, "r": 1, "k": 0.5, "d": 0.1})  # fmt: skip
    for points in ("cubature", "scaled"):
        r = ukf(model, prior, data, points=points)
        assert (r.mean[3] >= -1e-15).all() and (r.mean[3] < 1e-12).any()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"points": "cubatur"}, "did you mean 'cubature'"),
        ({"points": "scaled", "alpha": 0.0}, "alpha > 0"),
        ({"points": "scaled", "alpha": float("nan")}, "finite numbers"),
        ({"points": "scaled", "kappa": -4.0}, "kappa = -4.0 must be > -4"),
        ({"points": "scaled", "beta": -1.0}, "raise beta"),
    ],
)
def test_impossible_points_are_refused(options, words):
    """Every message says which number."""
    with pytest.raises(ParameterError, match=words):
        ukf_step(cv_model(), **options)


def test_not_a_number_at_a_single_point_is_an_error():
    """log of a point that is negative, though the mean is not."""
    x, u, p, w, dt = (ca.SX.sym(n, k) for n, k in zip("xupwd", (1, 0, 0, 0, 1), strict=True))
    model = FilterModel(
        "log",
        signals("a"), Signals(), Signals(), Signals(), signals("y"),
        transition=ca.Function("f", [x, u, p, w, dt], [x, 0]),
        output=ca.Function("g", [x, u, p, w], [ca.log(x), 0]),
        walk=np.zeros(1), lower=np.full(1, -np.inf), upper=np.full(1, np.inf),
    )  # fmt: skip
    prior = Belief(model.x, np.ones(1), np.full((1, 1), 4.0))
    with pytest.raises(EstimationError, match="the belief of a is lost"):
        ukf(model, prior, gappy(0, model, 3, missing=0.0))


def test_cubature_is_a_case_of_the_scaled_points():
    """alpha = 1, beta = kappa = 0."""
    a, b = PointSet.of(5, "cubature", 9, 9, 9), PointSet.of(5, "scaled", 1.0, 0.0, 0.0)
    assert (a.c, a.eta) == (b.c, b.eta) == (5.0, -0.2)
