"""The Rauch-Tung-Striebel smoother against least squares of all samples at once.

Rauch, Tung and Striebel (1965).  On linear models both are exact: 1e-9 is rounding.
"""

import dataclasses

import numpy as np
import pytest
from estimation_models import (
    batch_by_hand,
    cv_model,
    cv_parts,
    gappy,
    linear,
    most_probable_path,
    pendulum,
    pendulum_data,
    random_belief,
    random_linear,
)
from numpy.testing import assert_allclose

from apu_casadi.core.errors import EstimationError, ParameterError
from estimators.batch.smoother import fixed_lag_smoother, rts_smoother
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.ukf import unscented_kalman_filter
from estimators.models.filtermodel import Unknown, augment
from estimators.models.sensorerrors import gains

EXACT = dict(rtol=1e-9, atol=1e-9)
FILTERS = {
    "ekf": extended_kalman_filter,
    "iekf": lambda *a, **k: extended_kalman_filter(*a, iterations=2, **k),
    "cubature": unscented_kalman_filter,
    "scaled": lambda *a, **k: unscented_kalman_filter(*a, points="scaled", **k),
}
every_filter = pytest.mark.parametrize("name", FILTERS)


def smoothed(name, model, prior, data):
    return rts_smoother(FILTERS[name](model, prior, data, full=True, backend="vm"))


@every_filter
@pytest.mark.parametrize("seed", [0, 1])
def test_is_the_batch_fit_on_linear_models(name, seed):
    """All instants; noise w shared by output and transition, gaps, one silent sensor."""
    model, parts = random_linear(seed)
    prior = random_belief(seed, model)
    data = gappy(seed, model, 30, silent=[2] if seed else [])
    mean, cov = batch_by_hand(parts, model.walk, prior, data)
    s = smoothed(name, model, prior, data)
    assert_allclose(s.mean, mean, **EXACT)
    assert_allclose(s.cov, cov, **EXACT)
    assert_allclose(s.variance, np.diagonal(cov, axis1=1, axis2=2).T, **EXACT)


@every_filter
def test_irregular_instants_noisy_input_and_a_constant(name):
    """A parameter that does not walk: its smoothed value is the same at all instants."""
    model = cv_model(walk=0.0)
    prior, data = random_belief(5, model), gappy(5, model, 40)
    mean, cov = batch_by_hand(cv_parts, model.walk, prior, data)
    s = smoothed(name, model, prior, data)
    assert_allclose(s.mean, mean, **EXACT)
    assert_allclose(s.cov, cov, **EXACT)
    assert np.ptp(s.mean[2]) < 1e-9


def test_an_unstable_model_known_exactly_in_one_state():
    """A zero row in every covariance; the pseudo-inverse leaves it alone."""
    A = [[1.05, 1, 0.3], [0, 1, 0], [0, 0, 1]]
    parts = [np.array(M, float) for M in
             (A, [[0], [1], [0]], [[0.1], [0.2], [0]], [[1, 0, 0]], [[0.3]])]  # fmt: skip
    model = linear(*parts, [0.1, 0.1, 0])
    prior = Belief.of(model.x, {"x0": 0, "x1": 0, "x2": 2}, {"x0": 1, "x1": 1, "x2": 0})
    data = gappy(3, model, 25)
    # by hand the known state needs some variance: 1e-7 of it moves the others by 1e-13
    near = Belief(model.x, prior.mean, prior.cov + np.diag([0, 0, 1e-14]))
    mean, cov = batch_by_hand(parts, model.walk, near, data)
    s = smoothed("ekf", model, prior, data)
    assert_allclose(s.mean, mean, rtol=1e-7, atol=1e-7)
    assert_allclose(s.cov[:, :2, :2], cov[:, :2, :2], rtol=1e-7, atol=1e-7)
    assert (s.mean[2] == 2).all() and (s.variance[2] == 0).all()


def test_units_do_not_matter():
    """States in units 1e6 apart: the same in one unit, to 1e-9."""
    model, (A, B, G, C, D) = random_linear(4)
    T = np.diag([1e6, 1.0, 1e-6])
    TI = np.diag(1 / np.diag(T))
    scaled = linear(T @ A @ TI, T @ B, T @ G, C @ TI, D, T @ model.walk)
    prior, data = random_belief(4, model), gappy(4, model, 30)
    other = Belief(scaled.x, T @ prior.mean, T @ prior.cov @ T)
    a, b = smoothed("ekf", model, prior, data), smoothed("ekf", scaled, other, data)
    assert_allclose(TI @ b.mean, a.mean, **EXACT)
    assert_allclose(TI @ b.cov @ TI, a.cov, **EXACT)


def test_last_instant_is_the_filters():
    """Nothing comes after it; filtered innovations and likelihood stay as they were."""
    model = pendulum()
    prior = Belief.of(model.x, {"q": 1, "r": 0, "k": 5}, {"q": 0.3, "r": 1, "k": 0.5})
    f = extended_kalman_filter(model, prior, pendulum_data(model), full=True, backend="vm")
    s = rts_smoother(f)
    assert_allclose(s.mean[:, -1], f.mean[:, -1])
    assert s.loglik == f.loglik and s.nis is f.nis
    assert (s.variance <= f.variance * (1 + 1e-9)).all()
    assert_allclose(s.final.mean, f.final.mean)


def test_nonlinear_smoothers_are_near_the_most_probable_path():
    """Pendulum, well measured: the path that SciPy's least_squares finds from all samples at once,
    within a fifth of the claimed standard deviation."""
    model = pendulum()
    data = pendulum_data(model, K=10)
    prior = Belief.of(model.x, {"q": 1, "r": 0, "k": 5}, {"q": 0.3, "r": 1, "k": 0.5})
    best = most_probable_path(model, prior, data, max_nfev=15)
    for name in ("iekf", "scaled"):
        s = smoothed(name, model, prior, data)
        assert (np.abs(s.mean - best) / np.sqrt(s.variance)).max() < 0.2


def test_considered_states_stay_considered():
    """What later samples say does not reach them."""
    model = augment(gains(cv_model(), ["place"]), {"gain_place": Unknown(consider=True)})
    P = np.eye(4) * 0.5
    P[3, 3] = 0.1**2
    s = smoothed("ekf", model, Belief(model.x, np.array([0.3, 0, 0, 0.01]), P),
                 dataclasses.replace(gappy(8, model, 30)))  # fmt: skip
    assert_allclose(s.mean[3], 0.01, rtol=1e-9)
    assert_allclose(s.variance[3], 0.01, rtol=1e-9)


def test_one_sample():
    """Nothing to do."""
    model = cv_model()
    prior, data = random_belief(1, model), gappy(1, model, 1)
    s = smoothed("cubature", model, prior, data)
    f = unscented_kalman_filter(model, prior, data, backend="vm")
    assert_allclose(s.mean, f.mean)


def test_a_filter_that_kept_too_little_is_refused():
    """The covariances are needed; the message says how to keep them."""
    model = cv_model()
    r = extended_kalman_filter(model, random_belief(1, model), gappy(1, model, 5), backend="vm")
    with pytest.raises(EstimationError, match="full=True"):
        rts_smoother(r)


# ------------------------------------------------------------------------------ fixed lag


@every_filter
def test_fixed_lag_is_the_batch_fit_of_what_has_come_so_far(name):
    """Each instant against least squares of the samples up to three later ones; the lag of the
    whole recording is the fixed-interval smoother."""
    model, parts = random_linear(2)
    prior, data = random_belief(2, model), gappy(2, model, 14)
    f = FILTERS[name](model, prior, data, full=True, backend="vm")
    s = fixed_lag_smoother(f, 3)
    for k in range(data.size):
        mean, cov = batch_by_hand(parts, model.walk, prior, data.part(0, min(k + 4, data.size)))
        assert_allclose(s.mean[:, k], mean[:, k], rtol=1e-10, atol=1e-10)
        assert_allclose(s.cov[k], cov[k], rtol=1e-10, atol=1e-10)
    assert_allclose(fixed_lag_smoother(f, 99).mean, rts_smoother(f).mean, rtol=1e-12)
    assert (fixed_lag_smoother(f, 0).cov == f.cov).all()


def test_a_lag_in_seconds_counts_instants_by_their_stamps():
    """Irregular instants: as many later ones as lie within the delay."""
    model, _ = random_linear(3)
    prior, data = random_belief(3, model), gappy(3, model, 20)
    f = extended_kalman_filter(model, prior, data, full=True, backend="vm")
    delay = 0.7
    s = fixed_lag_smoother(f, delay=delay)
    for k in range(data.size):
        until = int((data.t <= data.t[k] + delay).sum())
        cut = extended_kalman_filter(model, prior, data.part(0, until), full=True, backend="vm")
        assert_allclose(s.mean[:, k], rts_smoother(cut).mean[:, k], rtol=1e-10, atol=1e-12)


def test_fixed_lag_with_a_prior_that_is_far_too_wide():
    """Digits run out: in square-root form it is the smoother of what has come so far again."""
    model, _ = random_linear(1)
    prior, data = Belief(model.x, np.zeros(3), 1e18 * np.eye(3)), gappy(1, model, 12, missing=0.0)
    f = extended_kalman_filter(model, prior, data, full=True, backend="vm")
    s = fixed_lag_smoother(f, 2)
    for k in (0, 1, 5, 11):
        part = data.part(0, min(k + 3, data.size))
        cut = rts_smoother(extended_kalman_filter(model, prior, part, full=True, backend="vm"))
        assert_allclose(s.mean[:, k], cut.mean[:, k], rtol=1e-7, atol=1e-9)
        assert_allclose(s.variance[:, k], cut.variance[:, k], rtol=1e-7)


@pytest.mark.parametrize(
    ("how", "words"),
    [({}, "either lag"), ({"lag": 1, "delay": 1.0}, "either lag"), ({"lag": -1}, ">= 0, got -1"),
     ({"lag": 2.0}, "whole number"), ({"delay": -0.1}, "finite and >= 0 s")],
)  # fmt: skip
def test_impossible_lags_are_refused(how, words):
    model = cv_model()
    f = extended_kalman_filter(
        model, random_belief(1, model), gappy(1, model, 5), full=True, backend="vm"
    )
    with pytest.raises(ParameterError, match=words):
        fixed_lag_smoother(f, **how)
