"""The extended Kalman filter: its linearisation, iterations, considered states, bounds, refusals.

Bell and Cathey (1993): the iterated update is Gauss-Newton; Schmidt (1966), considered parameters.
On linear models everything is exact, so that 1e-9 only leaves room for rounding.  What it shares
with other filters is in ``test_filters.py``.
"""

import dataclasses

import casadi as ca
import numpy as np
import pytest
from estimation_models import (
    constant_velocity,
    cv_model,
    cv_parts,
    gappy,
    kalman_by_hand,
    linear,
    pendulum,
    pendulum_data,
    random_belief,
    random_linear,
    signals,
)
from filterpy.kalman import KalmanFilter
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from apu_casadi.core.errors import EstimationError, ParameterError
from apu_casadi.core.signals import Signals
from estimators.filters.belief import Belief
from estimators.filters.ekf import correct, ekf_step, extended_kalman_filter
from estimators.filters.stepparts import projected
from estimators.models.filtermodel import FilterModel, Unknown, augment
from estimators.models.recording import Recording
from estimators.models.sensorerrors import gains

EXACT = dict(rtol=1e-9, atol=1e-9)


def ekf(model, prior, data, **options):
    return extended_kalman_filter(model, prior, data, **({"full": True, "backend": "vm"} | options))


def test_agrees_with_filterpy_on_a_linear_model():
    """filterpy's KalmanFilter, which knows no correlated noise: D = 0."""
    _, (A, B, G, C, D) = random_linear(4)
    model = linear(A, B, G, C, 0 * D, [0.1, 0.2, 0.3])
    prior, data = random_belief(4, model), gappy(4, model, 40, missing=0.0)
    kf = KalmanFilter(3, 3, 1)
    kf.x, kf.P, kf.F, kf.B, kf.H = prior.mean.copy(), prior.cov.copy(), A, B, C
    r = ekf(model, prior, data)
    for k in range(data.size):
        kf.update(data.y[:, k], R=np.diag(data.variance[:, k]))
        assert_allclose(r.mean[:, k], kf.x, **EXACT)
        assert_allclose(r.cov[k], kf.P, **EXACT)
        kf.predict(data.u[:, k], Q=G @ G.T + np.diag(model.walk**2) * data.dt[k])


def test_nonlinear_step_against_finite_differences():
    """One sample and one transition of the pendulum, Jacobians by central differences (h = 1e-6:
    errors of 1e-9 or so)."""
    model = pendulum()
    data = pendulum_data(model, K=2)
    prior = Belief.of(model.x, {"q": 0.8, "r": -0.5, "k": 5}, {"q": 0.3, "r": 1, "k": 0.5})
    r = ekf(model, prior, data)

    def difference(f, s):
        J = [(f(s + h) - f(s - h)) / 2e-6 for h in 1e-6 * np.eye(s.size)]
        return np.array(J).T

    u, p, dt = data.u[:, 0], data.p, data.dt[0]
    g = lambda s: np.array(model.output(s[:3], u, p, s[3:])[0]).ravel()  # noqa: E731
    f = lambda s: np.array(model.transition(s[:3], u, p, s[3:], dt)[0]).ravel()  # noqa: E731
    s, P = np.append(prior.mean, 0), np.diag([0.09, 1, 0.25, 1])
    H = difference(g, s)
    S = H @ P @ H.T + np.diag(data.variance[:, 0])
    s = s + P @ H.T @ np.linalg.solve(S, data.y[:, 0] - g(s))
    P = P - P @ H.T @ np.linalg.solve(S, H @ P)
    F = difference(f, s)
    assert_allclose(r.mean[:, 0], s[:3], atol=1e-8)
    assert_allclose(r.cov[0], P[:3, :3], atol=1e-8)
    assert_allclose(r.mean_pred[:, 1], f(s), atol=1e-8)
    assert_allclose(r.cross[0], (P @ F.T)[:3], atol=1e-8)
    P1 = F @ P @ F.T + np.diag(model.walk**2) * dt
    assert_allclose(r.cov_pred[1], P1, atol=1e-8)


def test_iterated_update_is_the_nonlinear_least_squares_solution():
    """Bell and Cathey (1993): at convergence the mean is the most probable state, noise w included;
    SciPy's least_squares finds the same to its tolerance."""
    model = pendulum()
    data = pendulum_data(model, K=1)
    prior = Belief.of(model.x, {"q": 0.2, "r": 0, "k": 4}, {"q": 0.8, "r": 1, "k": 2})

    def residual(s):
        y = np.array(model.output(s[:3], data.u[:, 0], data.p, s[3:])[0]).ravel()
        return np.concatenate([(s[:3] - prior.mean) / prior.sigma, s[3:],
                               (data.y[:, 0] - y) / np.sqrt(data.variance[:, 0])])  # fmt: skip

    best = least_squares(residual, np.append(prior.mean, 0), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    r = ekf(model, prior, data, iterations=10)
    assert_allclose(r.mean[:, 0], best.x[:3], atol=1e-6)
    assert np.abs(ekf(model, prior, data).mean[:, 0] - best.x[:3]).max() > 1e-3


def test_considered_states_against_the_exact_joint_gaussian():
    """Schmidt: the joint Gaussian with the gain of considered states zeroed, written out; their
    mean and variance stay, their correlation is carried."""
    base, (A, B, G, C, D) = random_linear(7, nx=4)
    A[3], B[3], G[3] = [0, 0, 0, 1], 0, 0
    walk = np.append(base.walk[:3], 0)
    model = dataclasses.replace(linear(A, B, G, C, D, walk), consider=("x3",))
    prior, data = random_belief(7, model), gappy(7, model, 40)
    r = ekf(model, prior, data)
    m, P = np.append(prior.mean, np.zeros(2)), np.zeros((6, 6))
    P[:4, :4], P[4:, 4:] = prior.cov, np.eye(2)
    H, F = np.hstack([C, D]), np.hstack([A, G])
    for k in range(data.size):
        i = np.flatnonzero(~np.isnan(data.y[:, k]))
        Hk, R = H[i], np.diag(data.variance[i, k])
        S = Hk @ P @ Hk.T + R
        gain = P @ Hk.T @ np.linalg.inv(S)
        gain[3] = 0
        m = m + gain @ (data.y[i, k] - Hk @ m)
        Z = np.eye(6) - gain @ Hk
        P = Z @ P @ Z.T + gain @ R @ gain.T
        assert_allclose(r.mean[:, k], m[:4], **EXACT)
        assert_allclose(r.cov[k], P[:4, :4], **EXACT)
        m = np.append(F @ m + B @ data.u[:, k], np.zeros(2))
        new = np.zeros((6, 6))
        new[:4, :4] = F @ P @ F.T + np.diag(walk**2) * data.dt[k]
        new[4:, 4:] = np.eye(2)
        P = new
    assert_allclose(r.variance[3], prior.cov[3, 3], rtol=1e-12)
    assert_allclose(r.mean[3], prior.mean[3], rtol=1e-12)


def test_a_considered_gain_widens_the_band():
    """A gain error that is considered must leave more doubt than one that is ignored."""
    model = gains(cv_model(), ["place"])
    data = gappy(8, model, 40, p=[0.0])
    sure = ekf(model, random_belief(8, model), data)
    unsure_model = augment(model, {"gain_place": Unknown(consider=True)})
    P = np.zeros((4, 4))
    P[:3, :3], P[3, 3] = random_belief(8, model).cov, 0.2**2
    prior = Belief(unsure_model.x, np.append(random_belief(8, model).mean, 0), P)
    unsure = ekf(unsure_model, prior, dataclasses.replace(data, p=np.zeros(0)))
    assert (unsure.variance[:3] >= sure.variance - 1e-12).all()
    assert unsure.variance[0, -1] > 1.01 * sure.variance[0, -1]


def test_what_is_known_exactly_stays_known():
    """A singular prior: same as the model without that state (EKF and hand filter, 1e-9)."""
    model = cv_model(walk=0.0)
    prior = Belief.of(model.x, {"s": 0, "v": 0, "c": 0.7}, {"s": 1, "v": 1, "c": 0})
    data = gappy(9, model, 30)
    exact = kalman_by_hand(cv_parts, model.walk, prior, data)
    r = ekf(model, prior, data)
    assert_allclose(r.mean, exact.mean, **EXACT)
    assert_allclose(r.mean[2], 0.7, rtol=1e-12)
    assert (r.variance[2] == 0).all()


def test_bounds_move_the_mean_along_the_covariance():
    """One bound: the nearest point in the metric of P, m + P e (b - m_e)/P_ee; P stays."""
    model = augment(dataclasses.replace(cv_model(), lower=np.array([-np.inf, -0.1, -np.inf])), {})
    free, prior, data = cv_model(), random_belief(10, model), gappy(10, model, 1, missing=0.0)
    data = dataclasses.replace(data, y=np.array([[0.0], [-3.0]]))
    a, b = ekf(free, prior, data), ekf(model, prior, data)
    m, P = a.mean[:, 0], a.cov[0]
    assert m[1] < -0.1
    assert_allclose(b.mean[:, 0], m + P[:, 1] * (-0.1 - m[1]) / P[1, 1], **EXACT)
    assert_allclose(b.cov, a.cov, **EXACT)
    long = ekf(model, prior, gappy(11, model, 60))
    assert (long.mean[1] >= -0.1 - 1e-12).all()


def test_several_bounds_hold_at_once_and_considered_states_stay():
    """Correlations that push an earlier state out again; a considered state is not moved."""
    P = np.array([[1, -0.9, 0.5], [-0.9, 1, 0.2], [0.5, 0.2, 1]])
    m = ca.DM([-0.5, -2.0, 0.3])
    lower, upper = np.array([0, 0, -np.inf]), np.full(3, np.inf)
    inside = np.array(projected(m, ca.DM(P), lower, upper)).ravel()
    assert (inside[:2] >= 0).all() and inside[2] != 0.3
    held = np.array(projected(m, ca.DM(P), lower, upper, fixed=(2,))).ravel()
    assert held[2] == 0.3 and (held[:2] >= 0).all()
    held = np.array(projected(m, ca.DM(P), lower, upper, fixed=(0,))).ravel()
    assert held[0] == -0.5 and held[1] == 0


def test_projection_of_a_state_known_exactly_does_not_divide_by_zero():
    """No variance: nothing else moves, and nothing is NaN."""
    m = projected(ca.DM([1.0, 5.0]), ca.DM([[1.0, 0], [0, 0]]), np.array([2.0, 6.0]),
                  np.full(2, np.inf))  # fmt: skip
    assert_allclose(np.array(m).ravel(), [2.0, 5.0])


def test_update_of_matrices_as_expressions_of_either_kind():
    """SX written out and MX through one function: the same numbers, sparse H included."""
    rng = np.random.default_rng(0)
    M = rng.standard_normal((3, 3))
    values = [M @ M.T + np.eye(3), np.array([[1.0, 0, 2], [0, 0, 1]]), rng.standard_normal(2),
              np.array([0.5, -1.0])]  # fmt: skip
    pattern = ca.sparsify(ca.DM(values[1])).sparsity()
    got = []
    for kind in (ca.SX, ca.MX):
        s = [kind.sym("P", 3, 3), kind.sym("H", pattern), kind.sym("nu", 2), kind.sym("R", 2)]
        f = ca.Function("f", s, list(correct(*s, fixed=(1,))))
        got.append([np.array(o) for o in f(values[0], ca.sparsify(ca.DM(values[1])), *values[2:])])
    for a, b in zip(*got, strict=True):
        assert_allclose(a, b, rtol=1e-12)
    assert got[0][2][1, 1] == 1 and got[0][5] == 1


def test_long_runs_keep_covariances_symmetric_and_positive():
    """2000 samples with noise ratios of 1e12: Joseph's form; eigenvalues of the correlations."""
    model = linear([[1, 1], [0, 1]], [[0], [0]], [[0], [0]], [[1, 0]], [[0]], [0, 1e-6])
    K = 2000
    data = Recording(np.arange(K) * 1.0, np.zeros((1, K)), np.zeros((1, K)),
                     np.full((1, K), 1e-6), np.zeros(0))  # fmt: skip
    r = ekf(model, Belief(model.x, np.zeros(2), np.diag([1e6, 1e6])), data)
    for P in (r.cov, r.cov_pred):
        assert (P.transpose(0, 2, 1) == P).all()
        s = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        assert np.linalg.eigvalsh(P / s[:, :, None] / s[:, None, :]).min() > 0


def test_iterating_the_error_of_an_input_removes_its_attenuation():
    """y = k (u - 0.2 w) + v with readings u of the constant 1: errors in variables.

    Fuller (1987), Measurement Error Models, section 1.1: least squares on the readings shrinks k by
    1/(1 + 0.2^2) = 0.962; orthogonal regression, which takes from each reading its most probable
    error, does not.  Ten runs of 500 samples give the mean to 0.28/sqrt(5000) = 0.004.
    """
    x, u, p, w, dt = (ca.SX.sym(n, k) for n, k in zip("xupwd", (1, 1, 0, 1, 1), strict=True))
    spread, K = 0.2, 500
    model = FilterModel(
        "reading", signals("k"), signals("u"), Signals(), signals("w"), signals("y"),
        ca.Function("f", [x, u, p, w, dt], [x, ca.SX(0)]),
        ca.Function("g", [x, u, p, w], [x * (u - spread * w), ca.SX(0)]),
        np.zeros(1), np.full(1, -np.inf), np.full(1, np.inf),
    )  # fmt: skip
    rng, prior = np.random.default_rng(2), Belief(model.x, np.ones(1), np.eye(1))
    found = {n: [] for n in (1, 2)}
    for _ in range(10):
        e, v = spread * rng.standard_normal((2, K))
        data = Recording(
            np.arange(float(K)), 1 + e[None], 1 + v[None], np.full((1, K), spread**2), np.zeros(0)
        )
        for n in found:
            found[n].append(ekf(model, prior, data, iterations=n, iterated="noise").mean[0, -1])
    assert_allclose(np.mean(found[1]), 1 / (1 + spread**2), atol=3 * 0.004)
    assert_allclose(np.mean(found[2]), 1.0, atol=3 * 0.004)


def test_iterating_the_noise_alone_keeps_the_state_where_it_was_predicted():
    """The pendulum's noise adds to its output, whose derivatives do not hang on it: the plain
    filter again, to rounding, where iterating the state is another."""
    model = pendulum()
    data = pendulum_data(model, K=3)
    prior = Belief.of(model.x, {"q": 0.2, "r": 0, "k": 4}, {"q": 0.8, "r": 1, "k": 2})
    plain, every = (ekf(model, prior, data, iterations=n).mean for n in (1, 2))
    noise = ekf(model, prior, data, iterations=2, iterated="noise").mean
    assert_allclose(noise, plain, rtol=1e-12)
    assert np.abs(every - plain).max() > 1e-3


def test_unknown_iterated_is_refused():
    with pytest.raises(ParameterError, match="did you mean 'noise'"):
        ekf_step(cv_model(), 2, "noises")


@pytest.mark.parametrize("iterations", [0, 11, 1.0, "2"])
def test_impossible_numbers_of_iterations_are_refused(iterations):
    """Whole numbers from 1 to 10."""
    with pytest.raises(ParameterError, match="whole number from 1 to 10"):
        ekf_step(cv_model(), iterations)


def _root_model():
    """x1 = x, y = sqrt(x): not a number for x < 0."""
    x, u, p, w, dt = (ca.SX.sym(n, k) for n, k in zip("xupwd", (2, 0, 0, 0, 1), strict=True))
    return FilterModel(
        "root",
        signals("a b"), Signals(), Signals(), Signals(), signals("y"),
        transition=ca.Function("f", [x, u, p, w, dt], [ca.vertcat(x[0], x[1] - 1), 0]),
        output=ca.Function("g", [x, u, p, w], [ca.sqrt(x[1]), 0]),
        walk=np.zeros(2), lower=np.full(2, -np.inf), upper=np.full(2, np.inf),
    )  # fmt: skip


def test_not_a_number_is_an_error_that_names_instant_and_state():
    """sqrt of a negative state at the fifth sample: nothing goes on with NaN."""
    model = _root_model()
    t = np.arange(150) * 0.5
    data = Recording(t, np.zeros((0, 150)), np.full((1, 150), 1.0), np.full((1, 150), 1e9),
                     np.zeros(0))  # fmt: skip
    prior = Belief.of(model.x, {"a": 0, "b": 3.5}, {"a": 1, "b": 1})
    with pytest.raises(EstimationError, match=r"root at t = 2 s \(sample 4\): the belief of . is"):
        ekf(model, prior, data)


def test_a_model_that_was_not_solved_is_an_error():
    """The check of an eliminated unknown above the tolerance."""
    model = cv_model()
    s = model.symbols()
    x1, check = model.transition(*s)
    bad = ca.Function("f", [*s], [x1, check + ca.if_else(s[0][0] > -1e9, 2e-9, 0)])
    model = dataclasses.replace(model, transition=bad)
    with pytest.raises(EstimationError, match=r"check is 2\.0e-09 > 1e-09"):
        ekf(model, random_belief(1, model), gappy(1, model, 5))


def test_state_space_is_only_read():
    """The continuous model serves several filters."""
    ss = constant_velocity()
    assert ss.f.n_in() == 3 and len(ss.x) == 2
