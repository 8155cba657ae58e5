"""Noise by maximum likelihood: likelihoods written out, an optimiser of SciPy, known truths."""

import dataclasses

import numpy as np
import pytest
from estimation_models import (
    cv_model,
    cv_parts,
    gappy,
    kalman_by_hand,
    pendulum,
    pendulum_data,
    random_belief,
)
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from apu_casadi.core.errors import EstimationError, ParameterError
from estimators.batch.noisefit import _Likelihood, fit_noise, scaled_noise
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step, extended_kalman_filter
from estimators.models.recording import Recording

WALK = np.array([0.05, 0.3, 0.05])  # of s, v, c


def simulated(seed, K=180, dt=0.1, sigma=(0.2, 0.4)):
    """The linear model with known noise; its readings, given with sigmas that are wrong."""
    rng = np.random.default_rng(seed)
    model = cv_model().with_walk(dict(zip("svc", WALK, strict=True)))
    A, B, G, C, _ = cv_parts(dt)
    x, y, u = (
        np.array([0.3, -0.2, 0.1]) + rng.standard_normal(3),
        np.empty((2, K)),
        rng.normal(size=(1, K)),
    )
    for k in range(K):
        y[:, k] = C @ x + sigma * rng.standard_normal(2)
        w = G @ rng.standard_normal(1)
        x = A @ x + B @ u[:, k] + w + np.sqrt(dt) * WALK * rng.standard_normal(3)
    stated = np.repeat([[0.3**2], [0.3**2]], K, axis=1)
    prior = Belief.of(model.x, {"s": 0.3, "v": -0.2, "c": 0.1}, dict.fromkeys("svc", 1.0))
    return model, prior, Recording(dt * np.arange(K), u, y, stated, np.zeros(0))


def loglik_by_hand(theta, prior, data):
    """Logarithms of factors of walk of v, of noise of place and speed; a Kalman filter in NumPy."""
    walk = WALK * np.exp([0, theta[0], 0])
    scaled = dataclasses.replace(data, variance=data.variance * np.exp(2 * theta[1:])[:, None])
    return kalman_by_hand(cv_parts, walk, prior, scaled).loglik


def test_scaled_noise_is_the_same_model():
    """Walks as noises w of the transition, factors of one: the filter to rounding."""
    model = cv_model()
    prior, data = random_belief(5, model), gappy(5, model, 40)
    wide = scaled_noise(model, ["s", "c"], ["w_a"])
    more = dataclasses.replace(data, p=np.zeros(3))
    a = extended_kalman_filter(model, prior, data, backend="vm")
    b = extended_kalman_filter(wide, prior, more, backend="vm")
    assert_allclose(b.mean, a.mean, rtol=1e-11, atol=1e-12)
    assert b.loglik == pytest.approx(a.loglik, rel=1e-12)


def test_scores_are_the_derivatives_of_the_likelihood():
    """A pendulum, nonlinear, with gaps: the score by central differences of the filter's own
    likelihood; the information of a linear model is the mean curvature."""
    model = pendulum()
    data = pendulum_data(model, K=30)
    prior = Belief.of(model.x, {"q": 1, "r": 0, "k": 5}, {"q": 0.3, "r": 1, "k": 0.5})
    wide = scaled_noise(model, ["r", "k"], ["w_tau"])
    logs = ["log_walk_r", "log_walk_k", "log_w_tau"]
    of = _Likelihood(ekf_step(wide), logs, [0, 1], [prior], [data], "vm")
    theta = np.array([0.2, -0.3, 0.4, 0.1, -0.2])
    at = of(theta)
    for i in range(5):
        h = 1e-5 * np.eye(5)[i]
        slope = (of(theta + h).loglik - of(theta - h).loglik) / 2e-5
        assert at.score[i] == pytest.approx(slope, rel=1e-6, abs=1e-6)
    assert_allclose(at.scores.sum(0), at.score)
    # the likelihood itself, of a model and a recording that have these numbers
    other = model.with_walk({"r": 0.1 * np.exp(0.2), "k": 0.1 * np.exp(-0.3)})
    R = data.variance * np.exp(2 * theta[3:])[:, None]
    plain = scaled_noise(other, (), ["w_tau"])
    same = dataclasses.replace(data, variance=R, p=np.append(data.p, 0.4))
    assert at.loglik == pytest.approx(
        extended_kalman_filter(plain, prior, same, backend="vm").loglik, rel=1e-11
    )


def test_against_scipy_on_a_likelihood_by_hand():
    """The same maximum, and the same curvature within the scatter of one recording."""
    model, prior, data = simulated(1, K=60)
    found = fit_noise(model, prior, data, noise=["place", "speed"], walk=["v"], backend="vm")
    best = minimize(
        lambda t: -loglik_by_hand(t, prior, data),
        np.log(found.estimate / found.start) + 0.1,
        method="BFGS",
        options={"gtol": 1e-3},
    )
    assert_allclose(np.log(found.estimate / found.start), best.x, atol=1e-3)
    assert found.loglik == pytest.approx(-best.fun, rel=1e-9)
    assert found.loglik > found.loglik_start
    assert_allclose(found.log_sigma, np.sqrt(np.diag(best.hess_inv)), rtol=0.5)
    assert found.units == ("1/sqrt(s)", "1", "1") and found.kinds == ("walk", "noise", "noise")


@pytest.mark.long
def test_known_noise_is_found_within_its_intervals():
    """Six recordings: 18 errors over their standard errors, mean square about 1 (chi-squared with
    18 degrees of freedom: 0.27 to 2.4 at 99.9 %); two recordings together know more."""
    z, truth = [], np.log([0.3, 0.2, 0.4])
    for seed in range(6):
        model, prior, data = simulated(seed)
        f = fit_noise(model, prior, data, noise=["place", "speed"], walk=["v"], backend="vm")
        z.append((np.log(f.estimate) - truth) / f.log_sigma)
        assert f.nis == pytest.approx(1.0, abs=0.07) and not f.doubts
    assert 0.27 < np.mean(np.square(z)) < 2.4
    model, prior, other = simulated(11)
    both = fit_noise(
        model, prior, [data, other], noise=["place", "speed"], walk=["v"], backend="vm"
    )
    assert (both.log_sigma < 0.85 * f.log_sigma).all()


def test_a_walk_that_is_not_there_has_an_upper_limit():
    """c does not move: zero is likely, an interval about a logarithm would be nonsense."""
    model, prior, _ = simulated(3, K=2)
    model = model.with_walk({"c": 1e-2})
    still = simulated_still(4, K=100)
    f = fit_noise(model, prior, still, noise=["place"], walk=["c"], backend="vm")
    assert np.isnan(f.upper).tolist() == [False, True]
    low, high = f.interval()[0]
    assert low == 0 and 0 < high < 1
    # the limit itself: twice the loss of likelihood, the others fitted again
    at = fit_noise(model.with_walk({"c": high}), prior, still, noise=["place"], backend="vm")
    assert 2 * (f.loglik - at.loglik) == pytest.approx(2.706, abs=0.02)


def simulated_still(seed, **more):
    """As :func:`simulated`, c constant."""
    WALK[2], kept = 0.0, WALK[2]
    try:
        return simulated(seed, **more)[2]
    finally:
        WALK[2] = kept


def test_a_model_that_is_wrong_is_doubted():
    """A sine that no state follows: innovations stay correlated, and the estimate says so."""
    model, prior, data = simulated(2)
    wrong = dataclasses.replace(data, y=data.y + [[0], [3.0]] * np.sin(1.5 * data.t))
    f = fit_noise(
        model.with_walk({"v": 0.01}), prior, wrong, noise=["place", "speed"], backend="vm"
    )
    assert any(d.startswith("speed: innovations are correlated") for d in f.doubts)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({}, "nothing to find"),
        ({"noise": ["plaice"]}, "noise of output 'plaice'.*did you mean 'place'"),
        ({"walk": ["place"]}, "walk of state 'place'"),
        ({"inputs": ["a"]}, "noise of input 'a' .*w_a"),
        ({"noise": ["place", "place"]}, "named twice: place"),
        ({"noise": ["speed"]}, "speed is measured in no recording"),
    ],
)
def test_what_cannot_be_found_is_refused(how, words):
    model = cv_model()
    data = gappy(5, model, 20, silent=[1])
    with pytest.raises(ParameterError, match=words):
        fit_noise(model, random_belief(5, model), data, **how)


def test_other_refusals():
    model = cv_model(walk=0.0)
    data, prior = gappy(5, model, 20), random_belief(5, model)
    with pytest.raises(ParameterError, match="c does not walk"):
        fit_noise(model, prior, data, walk=["c"])
    with pytest.raises(ParameterError, match="2 priors for 1"):
        fit_noise(model, [prior, prior], data, noise=["place"])
    with pytest.raises(EstimationError, match=r"not reached in 1 iterations, .* standard errors"):
        fit_noise(model, prior, data, noise=["place"], max_iterations=1, backend="vm")
