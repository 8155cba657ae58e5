"""Posterior Cramer-Rao bounds: Tichavsky, Muravchik and Nehorai (1998), IEEE TSP 46, 1386.

On linear models the bound is the Kalman filter's covariance; it is compared with one written out
by hand, with one stacked least-squares problem, and on nonlinear models with the recursion of the
source in informations.
"""

import dataclasses

import casadi as ca
import numpy as np
import pytest
from estimation_models import gappy, kalman_by_hand, random_belief, random_linear, signals
from numpy.testing import assert_allclose

from apu_casadi.core.errors import EstimationError, SignalError
from estimators.filters.belief import Belief
from estimators.information.bounds import (
    expected_bound,
    linearisations,
    posterior_bound,
    snapshot_bound,
)
from estimators.models.filtermodel import FilterModel
from estimators.models.recording import Recording


def stacked_covariance(parts, model, prior, data):
    """Covariance of each x(k) given samples 0..k, from one stacked Gaussian vector.

    Unknowns are x(0), all w and all xi, prior covariance I after scaling; every x and every sample
    is a linear function of them.
    """
    A, _, G, C, D = parts
    nx, nw, K = A.shape[0], G.shape[1], data.size
    n = nx + K * (nw + nx)
    x = np.zeros((nx, n))
    x[:, :nx] = np.linalg.cholesky(prior.cov)
    rows, out = [], []
    for k in range(K):
        at = nx + k * (nw + nx)
        w, xi = np.zeros((nw, n)), np.zeros((nx, n))
        w[:, at : at + nw] = np.eye(nw)
        xi[:, at + nw : at + nw + nx] = np.eye(nx)
        there = ~np.isnan(data.y[:, k])
        rows.append((C @ x + D @ w)[there] / np.sqrt(data.variance[there, k])[:, None])
        M = np.vstack([np.eye(n), *rows])
        half = np.linalg.lstsq(M.T @ M, x.T, rcond=None)[0]
        out.append(x @ half)
        x = A @ x + G @ w + np.sqrt(data.dt[k]) * model.walk[:, None] * xi
    return np.array(out)


@pytest.mark.parametrize("seed", [1, 2])
def test_on_linear_models_it_is_stacked_least_squares_and_the_kalman_filter(seed):
    """Exact in both: noise shared by output and transition, gaps, irregular instants.

    1e-9: three ways of inverting matrices of condition 1e4 or less.
    """
    model, parts = random_linear(seed)
    prior, data = random_belief(seed, model), gappy(seed, model, 25)
    truth = np.random.default_rng(seed).standard_normal((3, 25))
    bound = posterior_bound(model, prior, data, truth, backend="vm")
    assert_allclose(bound, stacked_covariance(parts, model, prior, data), rtol=1e-9, atol=1e-12)
    kalman = kalman_by_hand(parts, model.walk, prior, data)
    assert_allclose(bound, kalman.cov, rtol=1e-9, atol=1e-12)


def test_the_expectation_over_equal_trajectories_is_the_bound():
    """On a linear model all trajectories have the same Jacobians."""
    model, _ = random_linear(3)
    prior, data = random_belief(3, model), gappy(3, model, 12)
    truths = np.random.default_rng(0).standard_normal((4, 3, 12))
    one = posterior_bound(model, prior, data, truths[0], backend="vm")
    assert_allclose(expected_bound(model, prior, [data] * 4, truths), one, rtol=1e-9, atol=1e-12)


def curved():
    """Two states, both with noise, whose transition and output bend."""
    x, u, p, w, dt = (
        ca.SX.sym(n, k) for n, k in (("x", 2), ("u", 0), ("p", 0), ("w", 1), ("d", 1))
    )
    f = ca.vertcat(x[0] + 0.3 * ca.sin(x[1]) + 0.1 * w, 0.9 * x[1] + 0.2 * x[0] ** 2)
    g = ca.vertcat(x[0] + 0.2 * x[1] ** 2 + 0.3 * w)
    return FilterModel(
        "curved",
        *(signals(n) for n in ("a b", "", "", "w", "y")),
        transition=ca.Function("f", [x, u, p, w, dt], [f, 0]),
        output=ca.Function("g", [x, u, p, w], [g, 0]),
        walk=np.array([0.3, 0.2]),
        lower=np.full(2, -np.inf),
        upper=np.full(2, np.inf),
    )


def drawn(model, K, M, seed=5):
    """M random trajectories of a model with one noise, and what is measured."""
    rng = np.random.default_rng(seed)
    x = np.empty((M, 2, K))
    for m in range(M):
        x[m, :, 0] = rng.standard_normal(2)
        for k in range(K - 1):
            step = model.transition(x[m, :, k], [], [], [0.0], 1.0)[0].full().ravel()
            x[m, :, k + 1] = step + model.walk * rng.standard_normal(2)
    y = np.zeros((1, K))
    y[0, 2] = np.nan
    data = Recording(np.arange(float(K)), np.zeros((0, K)), y, np.full((1, K), 0.04), np.zeros(0))
    return x, data


def test_the_expectation_is_the_source_s_recursion():
    """Eqs. 34-36 in informations, here with w as two more states' noise eliminated last.

    1e-9: covariances against informations of condition 1e3.
    """
    model = curved()
    prior = Belief(model.x, np.zeros(2), np.array([[0.5, 0.1], [0.1, 0.3]]))
    x, data = drawn(model, 8, 6)
    found = expected_bound(model, prior, [data] * 6, x)
    HF = [linearisations(model, data, one) for one in x]
    J = np.zeros((3, 3))
    J[:2, :2], J[2, 2] = np.linalg.inv(prior.cov), 1.0
    Qi = np.diag(1 / model.walk**2)
    for k in range(8):
        if not np.isnan(data.y[0, k]):
            J = J + np.mean([H[k].T @ H[k] / 0.04 for H, _ in HF], axis=0)
        assert_allclose(found[k], np.linalg.inv(J)[:2, :2], rtol=1e-9)
        D11 = np.mean([F[k].T @ Qi @ F[k] for _, F in HF], axis=0)
        D12 = -np.mean([F[k].T @ Qi for _, F in HF], axis=0)
        new = Qi - D12.T @ np.linalg.inv(J + D11) @ D12
        J = np.zeros((3, 3))
        J[:2, :2], J[2, 2] = new, 1.0


def test_the_expectation_lies_below_the_single_bounds():
    """Concavity of the Schur complement: below the harmonic mean, that below the mean."""
    model = curved()
    prior = Belief(model.x, np.zeros(2), 0.3 * np.eye(2))
    x, data = drawn(model, 6, 10)
    found = expected_bound(model, prior, [data] * 10, x)
    single = np.array([posterior_bound(model, prior, data, one, backend="vm") for one in x])
    harmonic = np.linalg.inv(np.linalg.inv(single).mean(0))
    assert np.linalg.eigvalsh(harmonic - found).min() > -1e-12
    assert np.linalg.eigvalsh(single.mean(0) - harmonic).min() > -1e-12


def test_a_considered_state_keeps_its_variance():
    """Schmidt's filter: the bound is one for estimators that leave that state alone."""
    model, _ = random_linear(4)
    model = dataclasses.replace(model, walk=np.array([0.2, 0.2, 0.0]), consider=("x2",))
    A = model.transition
    x, u, p, w, dt = model.symbols(ca.SX)
    f = A(x, u, p, w, dt)[0]
    f[2] = x[2]
    model = dataclasses.replace(model, transition=ca.Function("f", [x, u, p, w, dt], [f, 0]))
    prior, data = random_belief(4, model), gappy(4, model, 10)
    bound = posterior_bound(model, prior, data, np.zeros((3, 10)), backend="vm")
    assert_allclose(bound[:, 2, 2], prior.cov[2, 2], rtol=1e-12)
    free = dataclasses.replace(model, consider=())
    less = posterior_bound(free, prior, data, np.zeros((3, 10)), backend="vm")
    assert np.all(
        np.diagonal(less, axis1=1, axis2=2) <= np.diagonal(bound, axis1=1, axis2=2) + 1e-12
    )


def test_a_snapshot_s_bound_is_the_inverse_information():
    """With and without a prior; a prior that knows one number exactly."""
    rng = np.random.default_rng(6)
    H, M = rng.standard_normal((5, 3)), rng.standard_normal((5, 5))
    R, P = M @ M.T + np.eye(5), np.diag([1.0, 4.0, 0.5])
    info = H.T @ np.linalg.inv(R) @ H
    assert_allclose(snapshot_bound(H, R), np.linalg.inv(info), rtol=1e-10)
    both = np.linalg.inv(info + np.linalg.inv(P))
    assert_allclose(snapshot_bound(H, R, P), both, rtol=1e-10)
    assert_allclose(snapshot_bound(H, np.diag(R)), snapshot_bound(H, np.diag(np.diag(R))))
    P[1, 1] = 0.0
    exact = snapshot_bound(H, R, P)
    part = np.linalg.inv(info[np.ix_([0, 2], [0, 2])] + np.diag([1.0, 2.0]))
    assert_allclose(exact[np.ix_([0, 2], [0, 2])], part, rtol=1e-10)
    assert np.all(exact[1] == 0)


def test_messages():
    """What is wrong, where, and what to do."""
    with pytest.raises(EstimationError, match="2 of 3 directions do not show in these 1 outputs"):
        snapshot_bound([[1.0, 2.0, 3.0]], [1.0])
    with pytest.raises(SignalError, match="not positive definite"):
        snapshot_bound([[1.0]], [0.0])
    with pytest.raises(SignalError, match=r"shape \(2,\) or \(2, 2\) expected"):
        snapshot_bound(np.eye(2), [1.0, 1.0, 1.0])
    with pytest.raises(SignalError, match=r"prior_cov: shape \(2, 2\) expected"):
        snapshot_bound(np.eye(2), [1.0, 1.0], np.eye(3))
    model = curved()
    prior = Belief(model.x, np.zeros(2), np.eye(2))
    x, data = drawn(model, 4, 2)
    with pytest.raises(SignalError, match=r"shape \(2, 4\) expected, got \(2, 3\)"):
        posterior_bound(model, prior, data, x[0][:, :3])
    bad = x[0].copy()
    bad[1, 2] = np.nan
    with pytest.raises(SignalError, match="b not finite at sample 2"):
        posterior_bound(model, prior, data, bad)
    other = Belief(signals("a c"), np.zeros(2), np.eye(2))
    with pytest.raises(SignalError, match="prior of a, c; curved has a, b"):
        posterior_bound(model, other, data, x[0])
    with pytest.raises(SignalError, match="1 recordings for 2 truths"):
        expected_bound(model, prior, [data], x)
    with pytest.raises(SignalError, match="must share instants"):
        expected_bound(model, prior, [data, dataclasses.replace(data, t=2 * data.t)], x)
    considered = dataclasses.replace(model.with_walk({"a": 0.0}), consider=("a",))
    with pytest.raises(EstimationError, match="considers a; make them ordinary"):
        expected_bound(considered, prior, [data] * 2, x)
    still = model.with_walk({"b": 0.0})
    with pytest.raises(EstimationError, match="curved: b has no process noise, but its Jacobian"):
        expected_bound(still, prior, [data] * 2, x)


def test_a_truth_that_the_model_cannot_take_is_refused():
    """The check of an eliminated unknown counts here as in the filters."""
    model = curved()
    x, u, p, w = model.symbols(ca.SX)[:4]
    y = model.output(x, u, p, w)[0]
    broken = dataclasses.replace(
        model, output=ca.Function("g", [x, u, p, w], [y, ca.fmax(x[0] - 5, 0)])
    )
    truth, data = drawn(model, 4, 1)
    truth[0, 0, 3] = 7.0
    with pytest.raises(EstimationError, match=r"t = 3 s \(sample 3\): its check is 2.0e\+00"):
        linearisations(broken, data, truth[0])
