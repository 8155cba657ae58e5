"""Likelihood ratio of jumps, and their signatures: against filters run twice and whole batches.

The test is that of Willsky and Jones (1976), IEEE Trans. Automatic Control 21, 108-112.
"""

import dataclasses
import json
import math

import casadi as ca
import numpy as np
import pytest
from estimation_models import constant_velocity, oscillator
from numpy.testing import assert_allclose
from scipy import stats

from apu_casadi.core.errors import ParameterError, SignalError
from estimators.detection.alarms import HOUR
from estimators.detection.glr import glr, glr_stationary, glr_statistic, glr_test, glr_threshold
from estimators.detection.signatures import Jump, linear_filter, linearised, project
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.models.filtermodel import Unknown, augment, discretise, noisy_inputs
from estimators.models.recording import Recording

A = np.array([[0.95, 0.1], [0.0, 0.9]])
H = np.array([[1.0, 0.0], [0.3, 1.0]])
Q = np.array([[0.02, 0.005], [0.005, 0.05]])
R = np.array([[0.2, 0.02], [0.02, 0.3]])
M = np.array([[0.01, 0.0], [0.0, 0.02]])
JUMPS = {
    "names": ("kick", "push", "bias"),
    "state": np.array([[1.0, 0, 0], [0.5, 0, 0]]),
    "drift": np.array([[0, 0.2, 0], [0, 0.1, 0]]),
    "output": np.array([[0, 0, 1.0], [0, 0.3, 0]]),
}


def _data(K=60, seed=0):
    y = np.random.default_rng(seed).standard_normal((K, 2))
    y[10, 0] = y[20] = np.nan
    return y


def _filter(y):
    return linear_filter(y, A=A, H=H, Q=Q, R=R, P0=np.eye(2), cross=M, **JUMPS)


def test_ramps_and_the_size_that_innovations_tell():
    """Against filters run with and without the ramp; the size of one is found, to the noise."""
    y, size = _data(), 1.7
    f, t = _filter(y), np.arange(60.0)
    ramp = f.ramps(t)
    for c in range(3):
        a, extra = np.zeros(2), np.zeros_like(y)
        for k in range(60):
            share = t[k] / t[-1]
            extra[k] = H @ a + size * share * JUMPS["output"][:, c]
            step = (k < 59) / t[-1]
            a = A @ a + size * (step * JUMPS["state"][:, c] + share * JUMPS["drift"][:, c])
        moved = _filter(y + extra).innovation - f.innovation
        assert_allclose(moved, size * ramp.signature(0)[:, :, c], atol=1e-12)
        told = dataclasses.replace(ramp, innovation=moved).evidence()
        assert told[0][c] == pytest.approx(size)
    drawn = np.array([ramp_of(k).evidence() for k in range(200)])
    assert_allclose(np.std(drawn[:, 0] / drawn[:, 1], axis=0), 1.0, atol=0.15)
    none = ramp.evidence(np.zeros(60, bool))
    assert not none[0].any() and np.isinf(none[1]).all()


def ramp_of(seed):
    """Ramps in a filter whose innovations are as it claims."""
    f = _filter(np.ones((60, 2)))
    L = np.linalg.cholesky(f.S)
    white = np.random.default_rng(seed).standard_normal((60, 2, 1))
    return dataclasses.replace(f, innovation=(L @ white)[:, :, 0]).ramps(np.arange(60.0))


def test_signatures_are_what_a_jump_adds_to_the_innovations():
    """The filter is linear: run it with and without the jump in the data, and subtract."""
    y, onset, size = _data(), 25, 1.7
    f = _filter(y)
    for c in range(3):
        a, extra = np.zeros(2), np.zeros_like(y)
        for k in range(onset, y.shape[0]):
            if k == onset:
                a = a + size * JUMPS["state"][:, c]
            extra[k] = H @ a + size * JUMPS["output"][:, c]
            a = A @ a + size * JUMPS["drift"][:, c]
        moved = _filter(y + extra).innovation - f.innovation
        assert_allclose(moved[onset:], size * f.signature(onset)[:, :, c], atol=1e-12)


def test_evidence_is_the_likelihood_of_the_whole_batch():
    """Log-likelihood ratio of all samples as one Gaussian vector, sizes given or marginal."""
    y = _data()
    K, ny = y.shape
    f = _filter(y)
    onset = 30
    # covariance of all outputs, from the model alone
    cov = np.zeros((K, K, ny, ny))
    P = np.eye(2)
    for i in range(K):
        cov[i, i] = H @ P @ H.T + R
        cross = A @ P @ H.T + M  # of x(i+1) with y(i)
        for j in range(i + 1, K):
            cov[j, i] = H @ cross
            cov[i, j] = cov[j, i].T
            cross = A @ cross
        P = A @ P @ A.T + Q
    full = cov.transpose(0, 2, 1, 3).reshape(K * ny, K * ny)
    mean = np.zeros((K, ny, 3))
    for c in range(3):
        a = JUMPS["state"][:, c].copy()
        for k in range(onset, K):
            mean[k, :, c] = H @ a + JUMPS["output"][:, c]
            a = A @ a + JUMPS["drift"][:, c]
    there = ~np.isnan(y).ravel()
    V, G, d = full[np.ix_(there, there)], mean.reshape(-1, 3)[there], y.ravel()[there]
    e = glr(f, [20, onset])
    assert_allclose(e.C[1], G.T @ np.linalg.solve(V, G), rtol=1e-9, atol=1e-11)
    assert_allclose(e.b[1], G.T @ np.linalg.solve(V, d), rtol=1e-9, atol=1e-11)
    mu, prior = np.array([0.3, -0.2]), np.diag([0.5, 0.2])
    i = [0, 2]
    marginal = stats.multivariate_normal(G[:, i] @ mu, V + G[:, i] @ prior @ G[:, i].T).logpdf(d)
    none = stats.multivariate_normal(np.zeros(d.size), V).logpdf(d)
    assert e.log_marginal(["kick", "bias"], mu, prior)[1] == pytest.approx(
        marginal - none, abs=1e-8
    )
    best, cov_s = e.size(["kick", "bias"])
    assert e.statistic(["kick", "bias"])[1] == pytest.approx(
        best[1] @ np.linalg.solve(cov_s[1], best[1]) / 2
    )


def test_the_running_statistic_agrees_with_the_batch():
    """At the last sample the largest ratio over the last onsets, and its onset."""
    f = _filter(_data())
    best, onset = glr_statistic(f, "bias", 20)
    e = glr(f, np.arange(40, 60))
    ratio = e.statistic(["bias"])
    assert best[-1] == pytest.approx(ratio.max(), rel=1e-10)
    assert onset[-1] == 40 + np.argmax(ratio)


def test_a_settled_filter_is_a_matched_filter():
    """Signatures no longer depend on the onset: both forms of the statistic must agree."""
    K, M_ = 400, 30
    y = np.random.default_rng(5).standard_normal((K, 2))
    f = _filter(y)
    L = np.linalg.inv(np.linalg.cholesky(f.S))
    white = np.einsum("kij,kj->ki", L, f.innovation)
    signature = (L[200:230] @ f.signature(200, 230))[:, :, 2]
    fast, age = glr_stationary(white, signature, range(1, M_ + 1))
    slow, onset = glr_statistic(f, "bias", M_)
    assert_allclose(fast[250:], slow[250:], rtol=1e-6)
    assert_allclose(np.arange(250, K) - age[250:] + 1, onset[250:])


def test_the_threshold_of_the_ratio_keeps_its_rate():
    """1e6 other samples, 400 crossings expected; noise of threshold and count: 25 %."""
    lengths = [1, 3, 10, 30, 100]
    signature = np.ones((100, 1))
    asked = 4e-4 * 50 * HOUR
    t = glr_threshold(signature, lengths, asked, 50, samples=800_000, seed=1)
    x = np.random.default_rng(9).standard_normal((1_000_000, 1))
    r, _ = glr_stationary(x, signature, lengths)
    got = np.sum((r[1:] > t["threshold"]) & (r[:-1] <= t["threshold"]))
    assert got == pytest.approx(400, rel=0.25)
    assert 0 < t["sigma"] < 0.5


def test_a_jump_is_found_with_its_onset():
    """A bias of five standard deviations of its reading, into which the state settles."""
    rng = np.random.default_rng(8)
    K, onset = 900, 600
    x, y = np.zeros(2), np.empty((K, 2))
    chol_Q, chol_R = np.linalg.cholesky(Q), np.linalg.cholesky(R)
    for k in range(K):
        y[k] = H @ x + chol_R @ rng.standard_normal(2)
        x = A @ x + chol_Q @ rng.standard_normal(2)
    y[onset:, 0] += 5 * math.sqrt(R[0, 0])
    f = linear_filter(y, A=A, H=H, Q=Q, R=R, P0=np.eye(2), **JUMPS)
    found = glr_test(
        f, "bias", window=40, every=4, false_alarms_per_hour=1, rate=50, samples=100_000
    )
    assert found.before(onset / 50) == 0
    assert found.delay(onset / 50) < 2.0
    assert json.loads(json.dumps(found.to_dict()))["test"] == "GLR of bias"
    with pytest.raises(ParameterError, match="give threshold"):
        glr_test(f, "bias", window=1000, false_alarms_per_hour=1, rate=50)


def test_a_filter_linearised_is_the_filter():
    """Exact derivatives along an EKF's estimates: its innovation variances, and, on a linear
    model with noisy inputs, the change of its innovations when a jump is put into the data."""
    model = noisy_inputs(discretise(constant_velocity(), walk={"v": 0.1}), {"a": 0.3})
    model = augment(model, {"c": Unknown(walk=0.05)})
    K, dt, onset, size = 80, 0.1, 30, 0.8
    rng = np.random.default_rng(1)
    y = rng.standard_normal((3, K))
    y[1, 5] = np.nan
    t = dt * np.arange(K)
    data = Recording(t, np.zeros((1, K)), y, np.full((3, K), 0.04), np.zeros(0))
    prior = Belief.of(model.x, {"s": 0, "v": 0, "c": 0}, {"s": 1, "v": 1, "c": 1})

    def run(d):
        return extended_kalman_filter(model, prior, d, full=True, backend="vm")

    result = run(data)
    f = linearised(
        model, result, data, (Jump("state", "c"), Jump("sensor", "speed", 2.0)), backend="vm"
    )
    there = ~np.isnan(y)
    S = np.diagonal(f.S, axis1=1, axis2=2).T
    assert_allclose(S[there], result.innovation_variance[there], rtol=1e-9)
    # a bias of the sensor, then a jump of the state, put into the data
    extra = np.zeros((3, K))
    extra[1, onset:] = 2.0 * size
    moved = run(Recording(t, data.u, y + extra, data.variance, data.p)).innovation
    assert_allclose(
        (moved - result.innovation)[:, onset:].T, size * f.signature(onset)[:, :, 1], atol=1e-9
    )
    x, extra = np.zeros(2), np.zeros((3, K))
    ss = constant_velocity()
    base = np.array(ss.g(np.zeros(2), 0.0, 0.0)).ravel()
    step = discretise(ss).transition
    for k in range(onset, K):
        extra[:, k] = np.array(ss.g(x, 0.0, size)).ravel() - base
        x = np.array(step(x, 0.0, size, ca.DM(0, 1), dt)[0]).ravel()
    moved = run(Recording(t, data.u, y + extra, data.variance, data.p)).innovation
    assert_allclose(
        (moved - result.innovation)[:, onset:].T, size * f.signature(onset)[:, :, 0], atol=1e-9
    )


def test_small_jumps_of_a_nonlinear_model():
    """A parameter's jump in a pendulum: signature against the filter run on both data, to first
    order in the jump."""
    ss = oscillator()
    model = discretise(ss, walk={"r": 0.05})
    p0, size, onset, K, dt = np.array([4.0, 0.3]), 1e-4, 40, 120, 0.05
    t = dt * np.arange(K)
    step = model.transition

    def simulate(jump):
        x, y = np.array([0.5, 0.0]), np.empty((2, K))
        for k in range(K):
            p = p0 + np.array([jump * (k >= onset), 0.0])
            y[:, k] = np.array(ss.g(x, 0.1, p)).ravel()
            x = np.array(step(x, 0.1, p, ca.DM(0, 1), dt)[0]).ravel()
        return y

    noise = 0.01 * np.random.default_rng(0).standard_normal((2, K))
    prior = Belief.of(model.x, {"q": 0.5, "r": 0}, {"q": 0.1, "r": 0.1})

    def run(jump):
        d = Recording(t, np.full((1, K), 0.1), simulate(jump) + noise, np.full((2, K), 1e-4), p0)
        return d, extended_kalman_filter(model, prior, d, full=True, backend="vm")

    data, result = run(0.0)
    moved = run(size)[1].innovation - result.innovation
    f = linearised(model, result, data, [Jump("parameter", "k")], backend="vm")
    g = f.signature(onset)[:, :, 0]
    assert_allclose(moved[:, onset:].T / size, g, atol=0.02 * np.abs(g).max())


def test_projection_is_white_and_shifts_as_said():
    rng = np.random.default_rng(6)
    S = np.array([[2.0, 0.7], [0.7, 1.0]])
    d = np.array([1.0, -0.5])
    nu = rng.standard_normal((200_000, 2)) @ np.linalg.cholesky(S).T
    z = project(nu, S, d)
    assert z.std() == pytest.approx(1, rel=0.01)
    gain = math.sqrt(d @ np.linalg.solve(S, d))
    assert_allclose(project(nu + 0.3 * d, S, d) - z, 0.3 * gain, rtol=1e-9)
    gaps = nu[:3].copy()
    gaps[0, 0] = gaps[1] = np.nan
    z = project(gaps, np.diag([2.0, 1.0]), d)
    assert_allclose(z[0], -nu[0, 1])
    assert np.isnan(z[1])


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: Jump("stat", "x"), ParameterError, "did you mean 'state'"),
        (lambda: glr(_filter(_data()), [70]), ParameterError, "within the samples"),
        (lambda: glr(_filter(_data()), [7]).part(["bia"]), SignalError, "did you mean 'bias'"),
        (lambda: glr_statistic(_filter(_data()), "kik", 5), SignalError, "did you mean 'kick'"),
        (lambda: glr_stationary(np.ones((9, 1)), np.ones((3, 1)), [4]), ParameterError, "1 to 3"),
        (lambda: glr_threshold(np.ones((3, 1)), [1], 1, 1, samples=9), ParameterError, "1e5"),
        (lambda: project(np.ones((3, 1)), np.eye(1), np.zeros(1)), SignalError, "zero at sample 0"),
    ],
)
def test_refusals(call, error, words):
    with pytest.raises(error, match=words):
        call()
