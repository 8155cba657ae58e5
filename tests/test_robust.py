"""A filter step that wild readings cannot poison: the filter itself where nothing is wild, and a
filter without the reading where it is far out."""

import dataclasses

import numpy as np
import pytest
from estimation_models import gappy, linear, pendulum, pendulum_data, random_belief, random_linear
from numpy.testing import assert_allclose, assert_array_equal

from apu_casadi.core.errors import ParameterError
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import run
from estimators.filters.robust import limit_of, robust_ekf_step, robustly
from estimators.filters.ukf import ukf_step


def both(model, prior, data, of=ekf_step, **options):
    step = of(model)
    steps = step, robustly(step, **options)
    return (run(s, prior, data, full=True, backend="vm") for s in steps)


def with_wild(data, at, **outputs):
    y = data.y.copy()
    for name, v in outputs.items():
        y[int(name[1:]), at] = v
    return dataclasses.replace(data, y=y)


@pytest.mark.parametrize("of", [ekf_step, ukf_step])
def test_the_filter_itself_where_nothing_is_wild(of):
    model = pendulum()
    prior, chance = random_belief(3, model), 1e-300
    plain, robust = both(model, prior, pendulum_data(model), of, chance=chance)
    z = plain.innovation / np.sqrt(plain.innovation_variance)
    assert np.nanmax(np.abs(z)) < limit_of(chance)
    for n in ("mean", "cov", "nis", "innovation"):
        assert_allclose(getattr(robust, n), getattr(plain, n), rtol=1e-12, atol=1e-13)


def test_a_reading_far_out_counts_as_none_and_takes_no_other_with_it():
    """Output 1 is 1e8 off at one instant: as if it had not been measured there; 0 and 2 count."""
    _, parts = random_linear(5)
    model = linear(*parts, [0.1, 0.2, 0.3])
    prior, data = random_belief(5, model), gappy(5, model, 30, missing=0.0)
    wild, gone = (with_wild(data, 12, y1=v) for v in (1e8, np.nan))
    _, robust = both(model, prior, wild, chance=1e-300)
    without, _ = both(model, prior, gone)
    assert_allclose(robust.mean, without.mean, rtol=1e-4, atol=1e-4)
    assert_allclose(robust.cov, without.cov, rtol=1e-6, atol=1e-9)
    assert robust.nis[12] > 1e6  # tests of the innovations see it


def test_by_hand_on_one_state():
    """The update of a scalar random walk, R' = R + S (z^2/c^2 - 1): written out."""
    one = np.ones((1, 1))
    model = linear(one, 0 * one, 0 * one, one, 0 * one, [0.1])
    prior, data = random_belief(0, model), gappy(0, model, 1, missing=0.0)
    m, P, R, c = prior.mean[0], prior.cov[0, 0], data.variance[0, 0], limit_of(1e-4)
    S = P + R
    for z in (0.5 * c, c, 1.5 * c, 10 * c):
        y = m + z * np.sqrt(S)
        step = robust_ekf_step(model, chance=1e-4)
        r = run(step, prior, with_wild(data, 0, y0=y), full=True, backend="vm")
        more = R + S * max(z**2 / c**2 - 1, 0)
        K = P / (P + more)
        assert_allclose(r.mean[0, 0], m + K * (y - m), rtol=1e-12)
        assert_allclose(r.cov[0, 0, 0], (1 - K) * P, rtol=1e-12)


def test_influence_is_bounded_and_falls():
    """The change of the mean over its size at the limit is c/z beyond it, and never larger."""
    one = np.ones((1, 1))
    model = linear(one, 0 * one, 0 * one, one, 0 * one, [0.1])
    prior, data = random_belief(0, model), gappy(0, model, 1, missing=0.0)
    s, c = np.sqrt(prior.cov[0, 0] + data.variance[0, 0]), limit_of()
    step = robust_ekf_step(model)

    def moved(z):
        wild = with_wild(data, 0, y0=prior.mean[0] + z * s)
        return run(step, prior, wild, backend="vm").mean[0, 0] - prior.mean[0]

    at = moved(c)
    assert_allclose([moved(k * c) / at for k in (2, 10)], [1 / 2, 1 / 10], rtol=1e-9)
    assert_allclose(moved(c / 2) / at, 0.5, rtol=1e-9)


def test_in_square_root_form_too():
    model = pendulum()
    prior, data = random_belief(3, model), with_wild(pendulum_data(model), 20, y0=50.0)
    step = robust_ekf_step(model)
    a, b = (run(s, prior, data, full=True, backend="vm") for s in (step, step.wide()))
    assert step.wide() is step.wide()
    assert_allclose(a.mean, b.mean, rtol=1e-7, atol=1e-9)
    assert_array_equal(a.measured, b.measured)


@pytest.mark.parametrize("chance", [0.0, -1.0, 0.5, np.nan])
def test_a_chance_that_is_none_is_refused(chance):
    with pytest.raises(ParameterError, match="chance"):
        limit_of(chance)
