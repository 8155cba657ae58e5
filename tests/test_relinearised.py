"""A filter linearised about a smoothed trajectory: Bell's iterated Kalman smoother (1994).

On linear models a second pass changes nothing; on a pendulum, passes repeated lead to the path that
least squares of all samples at once finds.
"""

import numpy as np
import pytest
from estimation_models import (
    gappy,
    most_probable_path,
    pendulum,
    pendulum_data,
    random_belief,
    random_linear,
)
from numpy.testing import assert_allclose

from apu_casadi.core.errors import ParameterError
from estimators.batch.relinearised import linearised, relinearised_filter
from estimators.batch.smoother import rts_smoother
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter


def swinging(K):
    """Pendulum, its recording and a prior whose length is known badly."""
    model = pendulum()
    prior = Belief.of(model.x, {"q": 1, "r": 0, "k": 3}, {"q": 0.3, "r": 1, "k": 1.5})
    return model, prior, pendulum_data(model, K=K)


@pytest.mark.parametrize("seed", [0, 1])
def test_on_linear_models_it_is_the_filter(seed):
    """Wherever it is linearised; 1e-9 is rounding."""
    model, _ = random_linear(seed)
    prior, data = random_belief(seed, model), gappy(seed, model, 30)
    a = extended_kalman_filter(model, prior, data, backend="vm")
    b = relinearised_filter(model, prior, data, passes=3, backend="vm")
    assert_allclose(b.mean, a.mean, rtol=1e-9, atol=1e-9)
    assert_allclose(b.variance, a.variance, rtol=1e-9, atol=1e-9)
    assert b.loglik == pytest.approx(a.loglik, rel=1e-9)


def test_one_pass_is_the_extended_filter():
    """The same numbers, and nothing kept that was not asked for."""
    model, prior, data = swinging(20)
    a = extended_kalman_filter(model, prior, data, backend="vm")
    b = relinearised_filter(model, prior, data, passes=1, backend="vm")
    assert (b.mean == a.mean).all()
    assert b.cov is None


def test_about_its_own_point_the_linear_model_is_the_model():
    """Values of both functions at the point, and the slope beside it by differences."""
    model, _, data = swinging(5)
    lin = linearised(model)
    x, e = np.array([0.7, -0.4, 5.0]), 1e-6
    at = np.concatenate([data.u[:, 1], x])
    w = np.zeros(len(model.w))
    for move in (np.zeros(3), np.array([0.0, 0.0, e]), np.array([e, 0.0, 0.0])):
        want = model.output(x + move, data.u[:, 1], data.p, w)[0]
        got = lin.output(x + move, at, data.p, w)[0]
        # what is left is of the second order
        assert_allclose(np.array(got), np.array(want), rtol=0, atol=1e-11)
        want = model.transition(x + move, data.u[:, 1], data.p, w, 0.05)[0]
        got = lin.transition(x + move, at, data.p, w, 0.05)[0]
        assert_allclose(np.array(got), np.array(want), rtol=0, atol=1e-11)
    assert lin.u.names[-3:] == ("at_q", "at_r", "at_k")


@pytest.mark.long
def test_passes_lead_to_the_most_probable_path():
    """Twelve samples, against SciPy's least squares, in sigmas: 0.03 off, then 2e-4, then not.

    The last 4e-7 are what the torque's noise leaves, which is linearised at zero.
    """
    model, prior, data = swinging(12)
    best = most_probable_path(model, prior, data, xtol=1e-12)
    off = []
    for passes in (1, 2, 8):
        r = relinearised_filter(model, prior, data, passes=passes, full=True, backend="vm")
        s = rts_smoother(r)
        off.append((np.abs(s.mean - best) / np.sqrt(s.variance)).max())
    assert off[0] > 0.02
    assert off[1] < 1e-3
    assert off[2] < 1e-5


@pytest.mark.parametrize("passes", [0, 2.0, 21])
def test_passes_are_checked(passes):
    """A whole number, and not so many that it must be a mistake."""
    model, prior, data = swinging(3)
    with pytest.raises(ParameterError, match="passes must be a whole number from 1 to 20"):
        relinearised_filter(model, prior, data, passes=passes)
