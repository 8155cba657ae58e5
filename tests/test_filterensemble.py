"""Many filters together: each is the single run, in lanes and without."""

import numpy as np
import pytest
from estimation_models import cv_model, gappy, random_belief

from apu_casadi.core.backend import find_compiler
from apu_casadi.core.errors import DataError, EstimationError
from estimators.filters.ekf import ekf_step
from estimators.filters.filterensemble import run_many
from estimators.filters.filtering import BLOCK, run
from estimators.filters.ukf import ukf_step

FIELDS = ["mean", "variance", "innovation", "innovation_variance", "nis", "measured", "loglik", "t"]


def assert_same(a, b, full=False):
    for name in [*FIELDS, *(["cov", "cov_pred", "cross"] if full else [])]:
        assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True), name
    assert np.array_equal(a.final.cov, b.final.cov)


@pytest.mark.long
@pytest.mark.parametrize("step_of", [ekf_step, ukf_step])
@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=pytest.mark.compiled)])
def test_each_filter_is_the_single_run(step_of, compiled):
    """Recordings of different lengths and gaps, priors of their own, more than there are lanes."""
    if compiled and find_compiler() is None:
        pytest.skip("no C compiler found")
    model = cv_model()
    step = step_of(model)
    data = [gappy(k, model, K) for k, K in enumerate((1, 40, BLOCK, BLOCK + 1, 2 * BLOCK + 3) * 2)]
    priors = [random_belief(k, model) for k in range(len(data))]
    seen = []
    made = run_many(step, priors, data, full=True, chunk=7, progress=lambda *a: seen.append(a))
    for r, prior, d in zip(made, priors, data, strict=True):
        assert_same(r, run(step, prior, d, full=True), full=True)
    assert seen[-1] == (10, 10)


def test_one_prior_or_recording_serves_all():
    model = cv_model()
    step, prior, data = ekf_step(model), random_belief(0, model), gappy(0, model, 30)
    both = run_many(step, prior, [data, data])
    assert_same(both[0], both[1])
    assert_same(run_many([step, step], prior, data)[1], both[0])
    with pytest.raises(DataError, match=r"\[2, 3\] in number"):
        run_many(step, [prior] * 3, [data] * 2)


def test_a_filter_that_fails_is_named():
    model = cv_model()
    data = gappy(0, model, 30)
    bad = random_belief(0, model)
    bad.mean[:] = np.nan
    with pytest.raises(EstimationError) as told:
        run_many(ekf_step(model), [random_belief(1, model), bad], [data, data])
    assert told.value.__notes__ == ["filter 1 of the ensemble"]
