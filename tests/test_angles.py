"""Outputs that are read modulo a turn: filters, smoothers and fits of a wrapped angle.

The same data with their turns counted are the independent truth: a filter that treats the wrapped
angle right gives the same beliefs to rounding.
"""

import math

import casadi as ca
import numpy as np
import pytest
from estimation_models import model_of
from numpy.testing import assert_allclose

from apu_casadi.core.errors import ParameterError, SignalError
from apu_casadi.core.signals import Signal, Signals
from estimators.batch.fit import fit
from estimators.batch.mhe import moving_horizon
from estimators.batch.smoother import rts_smoother
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.filterpy_adapter import filterpy_ekf, filterpy_ukf, run_filterpy
from estimators.filters.imm import interacting_multiple_models
from estimators.filters.ukf import unscented_kalman_filter
from estimators.models.angles import angular
from estimators.models.filtermodel import (
    FilterModel,
    Unknown,
    augment,
    measure,
    noisy_inputs,
)
from estimators.models.recording import Recording
from estimators.models.sensorerrors import biases

RATE = 24.5  # rad/s
DT, K, SIGMA = 0.05, 80, 0.05
FILTERS = {
    "ekf": extended_kalman_filter,
    "iekf": lambda *a, **k: extended_kalman_filter(*a, iterations=3, **k),
    "cubature": unscented_kalman_filter,
    "scaled": lambda *a, **k: unscented_kalman_filter(*a, points="scaled", **k),
}


def spinning(unit="rad", turn=2 * math.pi, *, wrapped=False):
    """A shaft whose angle is read; ``wrapped``: the model itself gives it by atan2."""
    sizes = zip("xupwd", (2, 0, 0, 0, 1), strict=True)
    x, u, p, w, dt = (ca.SX.sym(n, k) for n, k in sizes)
    angle = ca.atan2(ca.sin(x[0]), ca.cos(x[0])) if wrapped else x[0]
    s = Signals([Signal("turned", "rad", "angle"), Signal("rate", "rad/s", "speed", None, 10.0)])
    y = Signals([Signal("place", unit, "angle as read"), Signal("speed", "rad/s", "as read")])
    seen = ca.vertcat(angle * turn / (2 * math.pi), x[1])
    return FilterModel.of(
        "spinning",
        (s, Signals(), Signals(), Signals(), y),
        (x, u, p, w, dt),
        (ca.vertcat(x[0] + dt * x[1], x[1]), 0),
        (seen, 0),
    ).with_walk({"turned": 0.02, "rate": 0.1})


def readings(turn=2 * math.pi, *, wrap=True, speed=False):
    """Samples of a shaft of 24.5 rad/s, with gaps, its angle within half a turn of zero."""
    rng = np.random.default_rng(2)
    t = DT * np.arange(K)
    y = (RATE * t + SIGMA * rng.standard_normal(K)) * turn / (2 * math.pi)
    y = y - turn * np.floor(y / turn + 0.5) if wrap else y
    y[5:9] = np.nan
    other = RATE + 3 * rng.standard_normal(K) if speed else np.full(K, np.nan)
    variance = np.stack([np.full(K, (SIGMA * turn / (2 * math.pi)) ** 2), np.full(K, 9.0)])
    return Recording(t, np.zeros((0, K)), np.stack([y, other]), variance, np.zeros(0))


def prior(model):
    """A rate known to 5 rad/s: a quarter of a radian in a step, far below half a turn."""
    return Belief.of(model.x, {"turned": 0.0, "rate": 20.0}, {"turned": 0.1, "rate": 5.0})


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize(("unit", "turn"), [("rad", 2 * math.pi), ("deg", 360.0)])
def test_a_wrapped_angle_is_as_good_as_one_with_its_turns(name, unit, turn):
    """Means, likelihood and smoothed means to rounding; without the declaration the rate is lost,
    and NIS tells so."""
    plain = spinning(unit, turn)
    model = angular(plain, ["place"])
    run, how = FILTERS[name], {"full": True, "backend": "vm"}
    true = run(plain, prior(plain), readings(turn, wrap=False), **how)
    found = run(model, prior(model), readings(turn), **how)
    assert found["rate"][0][-1] == pytest.approx(RATE, abs=0.2)
    assert_allclose(found.mean, true.mean, rtol=1e-10, atol=1e-9)
    assert_allclose(found.innovation, true.innovation, atol=1e-9 * turn)
    assert found.loglik == pytest.approx(true.loglik, rel=1e-10)
    assert_allclose(rts_smoother(found).mean, rts_smoother(true).mean, rtol=1e-9, atol=1e-8)
    wrong = run(plain, prior(plain), readings(turn), **how)
    assert abs(wrong["rate"][0][-1] - RATE) > 10 and wrong.nis.mean() > 100


@pytest.mark.parametrize("name", FILTERS)
def test_a_model_that_wraps_itself(name):
    """g by atan2 jumps between two sigma points; their circular mean does not."""
    model = angular(spinning(wrapped=True), ["place"])
    data = readings(speed=True)
    found = FILTERS[name](model, prior(model), data, backend="vm")
    plain = spinning()
    true = FILTERS[name](plain, prior(plain), readings(wrap=False, speed=True), backend="vm")
    assert_allclose(found.mean, true.mean, rtol=1e-8)
    assert_allclose(found.variance, true.variance, rtol=1e-8)


def test_against_filterpy_with_its_own_residuals():
    """filterpy's filters take means and residuals as functions."""
    model = measure(angular(spinning(wrapped=True), ["place"]), ["place"])
    data = readings()
    data = Recording(data.t, data.u, data.y[:1], data.variance[:1], data.p)
    for make, run in ((filterpy_ekf, "ekf"), (filterpy_ukf, "cubature")):
        kf = make(model, prior(model), {"place": SIGMA}, backend="vm")
        means, _ = run_filterpy(kf, data)
        ours = FILTERS[run](model, prior(model), data, backend="vm")
        assert_allclose(ours.mean, means, rtol=1e-9)


def test_interacting_models_and_moving_horizon():
    """Both hand the innovation to the same update; one mode is the filter."""
    model = angular(spinning(), ["place"])
    data = readings()
    true = extended_kalman_filter(model, prior(model), data, backend="vm")
    both = interacting_multiple_models(
        {"a": model}, prior(model), data, transition=np.eye(1), backend="vm"
    )
    assert_allclose(both.mean, true.mean, rtol=1e-10)
    part = data.part(0, 12)
    ahead = moving_horizon(model, prior(model), part, horizon=3, backend="vm")
    assert_allclose(ahead.mean, true.mean[:, :12], rtol=1e-6)


def test_a_fit_finds_the_rate_of_a_wrapped_angle():
    """The same estimate, interval and residuals as with the turns counted."""
    plain = model_of(
        lambda x, u, p, w, dt: x + dt * p[0], lambda x, u, p, w: x, p=("rate",), walk=[0.02]
    )
    model = angular(plain, {"y0": 2 * math.pi})
    ends = []
    for m, wrap in ((plain, False), (model, True)):
        d = readings(wrap=wrap)
        data = Recording(d.t, d.u, d.y[:1], d.variance[:1], np.array([20.0]))
        path = [{"x0": RATE * d.t}]  # a fit starts within half a turn of what was read
        ends.append(fit(m, data, ["rate"], states=path, backend="vm"))
    a, b = ends
    assert b.estimate[0] == pytest.approx(RATE, abs=4 * b.sigma[0])
    assert_allclose(b.estimate, a.estimate, rtol=1e-9)
    assert_allclose(b.sigma, a.sigma, rtol=1e-7)
    assert_allclose(b.recordings[0].residual, a.recordings[0].residual, atol=1e-6)


def test_an_angle_stays_one_through_all_changes():
    """Changed models know it by name; one that is not measured is forgotten."""
    plain = model_of(
        lambda x, u, p, w, dt: x + u + p[0],
        lambda x, u, p, w: ca.vertcat(x, 2 * x),
        p=("a",),
        nu=1,
        ny=2,
    )
    model = angular(plain, {"y1": 4.0})
    changed = augment(noisy_inputs(biases(model, ["y0"]), {"u0": 0.1}), {"a": Unknown()})
    assert changed.expanded().angles == (("y1", 4.0),)
    assert measure(changed, ["y1"]).angles == (("y1", 4.0),)
    assert measure(changed, ["y0"]).angles == ()
    e = changed.innovation(np.array([0.0, 3.5]), np.array([9.0, 0.2]))
    assert_allclose(e, [-9.0, -0.7])


def test_differences_below_half_a_turn_keep_their_bits():
    model = angular(spinning(), ["place"])
    a, b = np.array([[3.1, 0.1, 1e3], [0, 0, 0]]), np.array([[0.2, 0.3, 1e3 - 1], [1, 2, 3]])
    assert (model.innovation(a, b) == a - b).all()


def test_refusals():
    with pytest.raises(SignalError, match="did you mean 'place'"):
        angular(spinning(), ["plase"])
    with pytest.raises(ParameterError, match="speed in 'rad/s': give the period"):
        angular(spinning(), ["speed"])
    with pytest.raises(ParameterError, match="finite and > 0, got -1"):
        angular(spinning(), {"place": -1.0})
