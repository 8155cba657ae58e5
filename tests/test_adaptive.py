"""Adapted measurement noise against the recursion written out, and against noise that is known."""

import dataclasses

import numpy as np
import pytest
from estimation_models import cv_model, cv_parts, gappy, random_belief, with_root_finder
from numpy.testing import assert_allclose

from apu_casadi.core.errors import ParameterError, SignalError
from estimators.filters.adaptive import adaptive_filter, adaptive_noise, adaptive_step, at_bounds
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.ukf import ukf_step
from estimators.models.recording import Recording


def by_hand(model, prior, data, memory, sigma, iterations=2):
    """The same in NumPy: a Kalman filter with R of the last factors, gamma beliefs beside it."""
    m, P = prior.mean, prior.cov
    a, r = np.full(2, 1 / sigma**2), np.ones(2)
    means, factors = [], []
    for k in range(data.size):
        A, B, G, C, _ = cv_parts(data.dt[k])
        there = ~np.isnan(data.y[:, k])
        H, R0 = C[there], data.variance[there, k]
        e = data.y[there, k] - H @ m
        b, a1, now = (a * r)[there], (a + there / 2)[there], r[there]
        for _ in range(iterations):
            R = np.diag(R0 * now)
            S = H @ P @ H.T + R
            v = R @ np.linalg.solve(S, e)
            left = np.diag(R - R @ np.linalg.solve(S, R))
            gain = np.linalg.solve(S, H @ P).T
            now = (b + (v**2 + left) / R0 / 2) / a1
        m, P = m + gain @ e, P - gain @ S @ gain.T
        a = a + there / 2
        r = r.copy()
        r[there] = now
        means.append(m)
        factors.append(r)
        a = a * np.exp(-data.dt[k] / memory)
        m = A @ m + B @ data.u[:, k]
        P = A @ P @ A.T + G @ G.T + np.diag(model.walk**2) * data.dt[k]
    return np.array(means).T, np.array(factors).T


@pytest.mark.parametrize("change", [lambda m: m, with_root_finder], ids=["scalar", "root finder"])
def test_is_the_recursion_by_hand(change):
    """Irregular instants, gaps, more samples than one block."""
    model = cv_model()
    prior, data = random_belief(5, model), gappy(5, model, 110)
    made = change(model)
    r = adaptive_filter(made, prior, data, memory=3.0, sigma=0.5, bounds=(1e-3, 1e3), backend="vm")
    if made is model:
        mean, factor = by_hand(model, prior, data, 3.0, 0.5)
        assert_allclose(r.mean[:3], mean, rtol=1e-9, atol=1e-10)
        assert_allclose(r.mean[3:], factor, rtol=1e-9)
    assert r.x.names[3:] == ("noise_place", "noise_speed") and np.isfinite(r.loglik)


def stepped(seed, K=700):
    """Readings whose noise is four times as large from the middle on, in standard deviations."""
    rng = np.random.default_rng(seed)
    model, dt = cv_model(), 0.1
    A, B, G, C, _ = cv_parts(dt)
    x, u, y = np.zeros(3), rng.normal(size=(1, K)), np.empty((2, K))
    sigma = np.where(np.arange(K) < K // 2, 0.3, 1.2)
    for k in range(K):
        y[:, k] = C @ x + [0.2, sigma[k]] * rng.standard_normal(2)
        x = A @ x + B @ u[:, k] + G @ rng.standard_normal(1)
        x = x + np.sqrt(dt) * model.walk * rng.standard_normal(3)
    variance = np.repeat([[0.2**2], [0.3**2]], K, axis=1)
    data = Recording(dt * np.arange(K), u, y, variance, np.zeros(0))
    return model, Belief.of(model.x, dict.fromkeys("svc", 0.0), dict.fromkeys("svc", 0.1)), data


@pytest.mark.parametrize("step", [None, ukf_step])
def test_a_noise_that_grows_is_followed_within_what_is_claimed(step):
    """Factor 1, then 16, to a few of its standard deviations; that of the other output stays 1; the
    likelihood is near that of a filter that knows (the first samples after the change cost most of
    the rest), far above that of one that does not."""
    model, prior, data = stepped(1)
    how = {} if step is None else {"step": step}
    r = adaptive_filter(model, prior, data, memory=10.0, backend="vm", **how)
    for name, k, true in (("speed", 340, 1), ("speed", 699, 16), ("place", 699, 1)):
        mean, sigma = (v[k] for v in r[f"noise_{name}"])
        assert abs(mean - true) < 3.5 * sigma
    # 100 samples in the memory
    assert sigma / mean == pytest.approx(np.sqrt(2 / 100), rel=0.02)
    ignorant = extended_kalman_filter(model, prior, data, backend="vm")
    known = dataclasses.replace(data, variance=data.variance.copy())
    known.variance[1, 350:] *= 16
    knowing = extended_kalman_filter(model, prior, known, backend="vm")
    assert ignorant.loglik + 500 < r.loglik < knowing.loglik < r.loglik + 120
    assert 0.9 < r.nis[400:].sum() / r.measured[400:].sum() < 1.15


def test_bounds_hold_and_are_told():
    model, prior, data = stepped(2)
    bounds = (0.5, 4.0)
    r = adaptive_filter(model, prior, data, ["speed"], memory=10.0, bounds=bounds, backend="vm")
    share = at_bounds(adaptive_noise(model, ["speed"], bounds), r)
    assert set(share) == {"speed"} and 0.2 < share["speed"] < 0.5
    assert r["noise_speed"][0].max() == pytest.approx(4.0)
    wide = adaptive_filter(model, prior, data, memory=10.0, backend="vm")
    assert at_bounds(adaptive_noise(model, ["place", "speed"]), wide) == {}


@pytest.mark.parametrize(
    ("how", "error", "words"),
    [
        ({"memory": 0.0}, ParameterError, "memory must be finite and > 0 s"),
        ({"bounds": (2.0, 9.0)}, ParameterError, "0 < lowest <= 1 <= highest"),
        ({"sigma": -1.0}, ParameterError, "sigma of the factors"),
        ({"outputs": ["plase"]}, SignalError, "did you mean 'place'"),
    ],
)
def test_refusals(how, error, words):
    model = cv_model()
    with pytest.raises(error, match=words):
        adaptive_filter(model, random_belief(5, model), gappy(5, model, 5), **{"memory": 1.0} | how)


def test_a_model_without_factors_is_refused():
    with pytest.raises(ParameterError, match="no factors of noise; adaptive_noise"):
        adaptive_step(cv_model(), 1.0)
