"""Our models in filterpy's filters: same numbers, and its limits said aloud.

filterpy (R. Labbe) is an independent implementation; on additive noise both do the same arithmetic,
and 1e-9 is rounding.
"""

import dataclasses
import re

import numpy as np
import pytest
from estimation_models import (
    constant_velocity,
    cv_model,
    gappy,
    oscillator,
    pendulum,
    random_belief,
    signals,
)
from numpy.testing import assert_allclose

from apu_casadi.core.errors import DataError, EstimationError, ParameterError, SignalError
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.filterpy_adapter import filterpy_ekf, filterpy_ukf, run_filterpy
from estimators.filters.ukf import unscented_kalman_filter
from estimators.models.filtermodel import FilterModel, Unknown, augment, discretise, measure

EXACT = dict(rtol=1e-9, atol=1e-9)
POINTS = [
    {"points": "cubature"},
    {"points": "scaled"},
    {"points": "scaled", "alpha": 0.3, "kappa": 1.0},
    {"points": "scaled", "alpha": 0.8, "beta": 0.5, "kappa": -0.5},
]


def swinging():
    """The pendulum without input noise, k estimated: nonlinear in output and transition."""
    m = discretise(oscillator(), method="rk4", walk={"q": 0.01, "r": 0.1})
    return augment(m, {"k": Unknown(walk=0.1)})


def swinging_data(model, K=40):
    """All or nothing measured; irregular steps."""
    data = gappy(1, model, K, missing=0.0, p=[0.1])
    y = np.array([np.cos(data.t) + np.sin(np.cos(data.t)), -5 * np.sin(np.cos(data.t))])
    y[:, 5:9] = np.nan
    return dataclasses.replace(data, y=y + 0.05 * data.y)


PRIOR = dict(mean={"q": 0.9, "r": 0, "k": 1.0}, sigma={"q": 0.3, "r": 0.5, "k": 0.3})
SIGMA = {"angle": 0.1, "accel": 0.1}


def test_extended_filter_agrees():
    """Nonlinear, gaps of whole samples, irregular dt, Q of each step."""
    model = swinging()
    prior, data = Belief.of(model.x, **PRIOR), swinging_data(model)
    kf = filterpy_ekf(model, prior, SIGMA, p={"d": 0.1}, backend="vm")
    mean, cov = run_filterpy(kf, data)
    r = extended_kalman_filter(model, prior, data, full=True, backend="vm")
    assert_allclose(mean, r.mean, **EXACT)
    assert_allclose(cov, r.cov, **EXACT)


@pytest.mark.parametrize("points", POINTS, ids=str)
def test_unscented_filter_agrees(points):
    """Both redraw their points from the lower Cholesky root, so even nonlinear results agree."""
    model = swinging()
    prior, data = Belief.of(model.x, **PRIOR), swinging_data(model)
    kf = filterpy_ukf(model, prior, SIGMA, p={"d": 0.1}, backend="vm", **points)
    mean, cov = run_filterpy(kf, data)
    r = unscented_kalman_filter(model, prior, data, full=True, backend="vm", **points)
    assert_allclose(mean, r.mean, **EXACT)
    assert_allclose(cov, r.cov, **EXACT)


def test_noise_of_the_transition_alone_enters_q():
    """A noisy input that no sensor sees directly; linear, so that all filters agree."""
    model = cv_model()
    prior, data = random_belief(2, model), gappy(2, model, 30, missing=0.0)
    r = extended_kalman_filter(model, prior, data, full=True, backend="vm")
    for make in (filterpy_ekf, filterpy_ukf):
        kf = make(model, prior, {"place": 1, "speed": 1}, backend="vm")
        mean, cov = run_filterpy(kf, data)
        assert_allclose(mean, r.mean, **EXACT)
        assert_allclose(cov, r.cov, **EXACT)


def test_updates_may_come_first_and_twice():
    """Plain filterpy would use points of zero, then those of the prior; exact by hand."""
    model = measure(discretise(constant_velocity(), walk={"v": 0.1}), ["place"])
    prior = Belief.of(model.x, {"s": 1, "v": 2}, {"s": 1, "v": 1})
    for make in (filterpy_ekf, filterpy_ukf):
        kf = make(model, prior, {"place": 1.0}, p={"c": 0}, backend="vm")
        kf.update([2.0], u={"a": 0})
        kf.update([3.0], u=np.array([0.0]))
        kf.update(None)
        # prior 1, samples 2 and 3, all of variance 1
        assert_allclose(kf.x, [2, 2], **EXACT)
        assert_allclose(np.diag(kf.P), [1 / 3, 1], **EXACT)
        kf.predict(dt=0.5, u={"a": 1.0})
        assert_allclose(kf.P[1, 1], (1 - 0.3 * 0.5 + 0.045 / 4) ** 2 + 0.1**2 * 0.5, rtol=1e-9)


MAKERS = pytest.mark.parametrize("make", [filterpy_ekf, filterpy_ukf])


@MAKERS
def test_what_filterpy_cannot_do_is_refused(make):
    """Shared noise, considered states, bounds: named, with the way out."""
    model = pendulum()
    prior = Belief.of(model.x, {"q": 0, "r": 0, "k": 1}, {"q": 1, "r": 1, "k": 1})
    with pytest.raises(EstimationError, match="w_tau enter the output"):
        make(model, prior, SIGMA, p={"d": 0.1})
    base = swinging()
    prior = Belief.of(base.x, **PRIOR)
    with pytest.raises(EstimationError, match=re.escape("no considered states (r)")):
        make(dataclasses.replace(base, consider=("r",), walk=np.zeros(3)), prior, SIGMA)
    with pytest.raises(EstimationError, match=re.escape("no bounds (k)")):
        make(dataclasses.replace(base, lower=np.array([-np.inf, -np.inf, 0])), prior, SIGMA)


@MAKERS
def test_single_missing_sensors_are_refused(make):
    """By update, and by a run; a sample that is missing altogether is fine."""
    model = swinging()
    prior, data = Belief.of(model.x, **PRIOR), swinging_data(model)
    kf = make(model, prior, SIGMA, p={"d": 0.1}, backend="vm")
    with pytest.raises(DataError, match="accel not measured"):
        kf.update([0.1, np.nan], u=[0.0])
    y = data.y.copy()
    y[0, 3] = np.nan
    with pytest.raises(DataError, match="angle not measured"):
        run_filterpy(kf, dataclasses.replace(data, y=y))


@MAKERS
def test_wrong_arguments_are_refused(make):
    """Other states, sensors, inputs."""
    model = swinging()
    prior = Belief.of(model.x, **PRIOR)
    with pytest.raises(SignalError, match="prior of s, v, c; pendulum has q, r, k"):
        make(model, random_belief(0, cv_model()), SIGMA)
    with pytest.raises(SignalError, match="unknown: angel; missing: angle"):
        make(model, prior, {"angel": 1, "accel": 1}, p={"d": 0.1})
    kf = make(model, prior, SIGMA, p={"d": 0.1}, backend="vm")
    with pytest.raises(SignalError, match="missing tau"):
        kf.predict(dt=0.1)
    with pytest.raises(SignalError, match=r"shape \(1,\) or by name"):
        kf.predict(dt=0.1, u=[1.0, 2.0])


def test_impossible_points_are_refused():
    """As by our own filter."""
    model = swinging()
    with pytest.raises(ParameterError, match="did you mean 'scaled'"):
        filterpy_ukf(model, Belief.of(model.x, **PRIOR), SIGMA, points="scald")


def test_a_model_that_cannot_be_evaluated_is_an_error():
    """The check of the model, and values that are no numbers, as everywhere."""
    import casadi as ca

    none = signals("")
    x, u, p, w, dt = (ca.SX.sym(n, k) for n, k in zip("xupwd", (1, 0, 0, 0, 1), strict=True))
    model = FilterModel(
        "log", signals("a"), none, none, none, signals("y"),
        transition=ca.Function("f", [x, u, p, w, dt], [x - 1, 0]),
        output=ca.Function("g", [x, u, p, w], [ca.log(x), ca.if_else(x > 3, 1e-3, 0)]),
        walk=np.zeros(1), lower=np.full(1, -np.inf), upper=np.full(1, np.inf),
    )  # fmt: skip
    kf = filterpy_ekf(model, Belief(model.x, np.array([-1.0]), np.eye(1)), {"y": 1}, backend="vm")
    with pytest.raises(EstimationError, match="log: the output cannot be evaluated there"):
        kf.update([0.0])
    kf = filterpy_ekf(model, Belief(model.x, np.array([4.0]), np.eye(1)), {"y": 1}, backend="vm")
    with pytest.raises(EstimationError, match=r"check 1\.0e-03"):
        kf.update([0.0])
