"""Samples out of sequence: a filter that runs along against the same samples in order."""

import numpy as np
import pytest
from estimation_models import (
    batch_by_hand,
    gappy,
    linear,
    pendulum,
    pendulum_data,
    random_belief,
    random_linear,
)
from numpy.testing import assert_allclose

from apu_casadi.core.errors import DataError, EstimationError, SignalError
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step, extended_kalman_filter
from estimators.filters.filtering import run
from estimators.filters.late import RunningFilter
from estimators.filters.ukf import ukf_step


def samples(model, data):
    """(t, name, value, sigma) of each reading."""
    return [
        (float(data.t[k]), n, float(data.y[i, k]), float(np.sqrt(data.variance[i, k])))
        for k in range(data.size)
        for i, n in enumerate(model.y.names)
        if not np.isnan(data.y[i, k])
    ]


def told(model, prior, data, *, delay=None, shuffle=None, step=None, **how):
    """Give all readings to a running filter, some of them late or all in disorder."""
    u = [dict(zip(model.u.names, column, strict=True)) for column in data.u.T]
    p = dict(zip(model.p.names, data.p, strict=True))
    first = {"start": data.t[0], "inputs": u[0], "p": p, "backend": "vm"}
    f = RunningFilter(model if step is None else step, prior, **first, **how)
    events = [(t, t, {"inputs": now}) for t, now in zip(data.t, u, strict=True)]
    for t, n, v, s in samples(model, data):
        events.append((t + (delay or {}).get(n, 0.0), t, {"readings": {n: v}, "sigma": {n: s}}))
    events.sort(key=lambda e: e[0])
    if shuffle is not None:
        np.random.default_rng(shuffle).shuffle(events)
    for _, t, e in events:
        f.take(t, **e)
    return f


STEPS = {"ekf": ekf_step, "iekf": lambda m: ekf_step(m, 2), "ukf": ukf_step}


@pytest.mark.parametrize("name", STEPS)
@pytest.mark.parametrize("how", [{"delay": {"y0": 0.6, "y2": 0.25}}, {"shuffle": 4}])
def test_late_samples_are_as_good_as_samples_in_time(name, how):
    """Linear, with noise that output and transition share: the filter in order, to rounding, and
    least squares of all samples at once."""
    model, parts = random_linear(3)
    prior, data = random_belief(3, model), gappy(3, model, 25)
    step = STEPS[name](model)
    f = told(model, prior, data, step=step, **how)
    true = run(step, prior, data, backend="vm")
    assert_allclose(f.belief.mean, true.mean[:, -1], rtol=1e-12, atol=1e-13)
    assert_allclose(f.belief.cov, true.final.cov, rtol=1e-11, atol=1e-14)
    assert f.loglik == pytest.approx(true.loglik, rel=1e-12)
    mean, cov = batch_by_hand(parts, model.walk, prior, data)
    assert_allclose(f.belief.mean, mean[:, -1], rtol=1e-10, atol=1e-10)
    assert_allclose(f.belief.cov, cov[-1], rtol=1e-10, atol=1e-10)


def test_a_nonlinear_model_too():
    """The pendulum: filtered again from the late sample on, so the same to rounding."""
    model = pendulum()
    data = pendulum_data(model, K=25)
    prior = Belief.of(model.x, {"q": 1, "r": 0, "k": 5}, {"q": 0.3, "r": 1, "k": 0.5})
    f = told(model, prior, data, delay={"accel": 0.2})
    true = extended_kalman_filter(model, prior, data, backend="vm")
    assert_allclose(f.belief.mean, true.mean[:, -1], rtol=1e-12)


def test_against_the_direct_update_of_one_late_sample():
    """Bar-Shalom (2002): the state is carried back to the stamp, and its covariance with the
    present state makes the gain; exact for one sample in the last step of a linear model."""
    rng = np.random.default_rng(1)
    A = np.array([[1.0, 0.4], [0.0, 0.9]])
    none = np.zeros((2, 0))
    model = linear(A, none, none, np.eye(2), none, [0.3, 0.2])
    prior, H, R = random_belief(1, model), np.array([[1.0, 0.0]]), 0.2**2
    f = RunningFilter(model, prior, backend="vm")
    y = rng.standard_normal(3)
    now = f.take(1.0, {"y1": y[1]}, {"y1": 0.3})
    found = f.take(0.0, {"y0": y[0]}, {"y0": 0.2})
    # by hand: retrodiction of x(0) given the sample at 1
    Q, H1 = np.diag(model.walk**2), np.array([[0.0, 1.0]])
    P1 = A @ prior.cov @ A.T + Q
    S1 = H1 @ P1 @ H1.T + 0.3**2
    C0 = prior.cov @ A.T @ H1.T
    x0 = prior.mean + (C0 / S1).ravel() * (y[1] - H1 @ A @ prior.mean)
    P0 = prior.cov - C0 @ C0.T / S1
    cross = prior.cov @ A.T - C0 @ (H1 @ P1) / S1  # of x(0) and x(1), given y(1)
    S = float((H @ P0 @ H.T).item()) + R
    gain = cross.T @ H.T / S
    assert_allclose(found.mean, now.mean + gain.ravel() * (y[0] - H @ x0), rtol=1e-10)
    assert_allclose(found.cov, now.cov - gain @ gain.T * S, rtol=1e-10)


def test_inputs_hold_until_the_next_stamp_at_which_they_were_given():
    """A late input changes what follows up to the next one."""
    A, B = np.eye(1), np.ones((1, 1))
    model = linear(A, B, np.zeros((1, 0)), np.eye(1), np.zeros((1, 0)), [0.0])
    f = RunningFilter(model, Belief.of(model.x, {"x0": 0.0}, {"x0": 1.0}), inputs={"u0": 1.0})
    for t in (1.0, 2.0, 3.0, 4.0):
        f.take(t)
    assert f.belief.mean[0] == 4.0
    f.take(3.0, inputs={"u0": 5.0})
    assert f.belief.mean[0] == 8.0
    f.take(1.0, inputs={"u0": 2.0})
    assert f.belief.mean[0] == 1 + 2 + 2 + 5


def test_what_is_forgotten_counts_in_the_likelihood_and_is_refused_by_its_age():
    model, _ = random_linear(3)
    prior, data = random_belief(3, model), gappy(3, model, 25)
    f = told(model, prior, data, delay={"y0": 0.6}, keep=1.0)
    assert f.loglik == pytest.approx(told(model, prior, data).loglik, rel=1e-12)
    old = f.t - 3.0
    with pytest.raises(DataError, match=r"older than what is kept, .*keep = 1 s"):
        f.take(old, {"y0": 0.0}, {"y0": 1.0})


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (({"y9": 0.0}, {"y9": 1.0}), "unknown output 'y9'"),
        (({"y0": 0.0}, {}), "y0: a finite reading with a sigma > 0 expected, got 0.0 and None"),
        (({"y0": np.nan}, {"y0": 1.0}), "y0: a finite reading"),
        (({"y1": 0.0}, {"y1": 1.0}), "y1 at t = 1 s was given already"),
    ],
)
def test_what_cannot_be_taken_is_refused_and_changes_nothing(given, words):
    model, _ = random_linear(3)
    f = RunningFilter(model, random_belief(3, model), inputs={"u0": 0.0}, backend="vm")
    before = f.take(1.0, {"y1": 0.3}, {"y1": 1.0})
    with pytest.raises(DataError, match=words):
        f.take(1.0, *given)
    with pytest.raises(DataError, match="unknown input 'u7'"):
        f.take(1.0, inputs={"u7": 0.0})
    assert_allclose(f.take(1.0).mean, before.mean, rtol=1e-15)


def test_a_lost_belief_takes_the_sample_back():
    """An overflow in the step to a sample: refused, and the filter goes on as before."""
    none = np.zeros((1, 0))
    model = linear([[1e200]], none, none, [[1.0]], none, [0.0])
    f = RunningFilter(model, Belief.of(model.x, {"x0": 1.0}, {"x0": 1.0}), backend="vm")
    f.take(0.0, {"y0": 1.0}, {"y0": 0.5})
    with pytest.raises(EstimationError, match="the belief is lost"):
        f.take(1.0, {"y0": 1.0}, {"y0": 0.5})
    assert f.t == 0.0 and f.belief.mean[0] == pytest.approx(1.0)


def test_a_prior_of_other_states_is_refused():
    model, other = random_linear(3)[0], pendulum()
    with pytest.raises(SignalError, match="prior of x0, x1, x2; pendulum has q, r, k"):
        RunningFilter(other, random_belief(3, model))
