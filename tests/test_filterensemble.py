"""Many filters together: each is the single run, in lanes and without."""

import dataclasses

import numpy as np
import pytest
from estimation_models import cv_model, gappy, pendulum, random_belief, random_linear

from apu_casadi.core.backend import find_compiler
from apu_casadi.core.errors import DataError, EstimationError
from estimators.filters.alike import of_one_form
from estimators.filters.ekf import ekf_step
from estimators.filters.filterensemble import run_many
from estimators.filters.filtering import BLOCK, run
from estimators.filters.imm import interacting_multiple_models, multiple_models
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


def bank(n=5):
    """Models that differ in the noise of their states, and one of another structure."""
    model = random_linear(2, nx=4)[0]
    walks = [model.walk * (1 + 0.3 * k) for k in range(n)]
    of = {f"m{k}": dataclasses.replace(model, walk=w) for k, w in enumerate(walks)}
    return of | {
        "still": dataclasses.replace(model, walk=np.where(np.arange(4) == 1, 0.0, walks[0]))
    }


def test_filters_that_differ_in_constants_share_a_step():
    """The step of each with its constants as parameters gives the bits of its own."""
    steps = [ekf_step(m) for m in bank().values()]
    made = of_one_form([*steps, ekf_step(pendulum())])
    assert len({id(s.shared) for s in made[:5]}) == 1
    assert made[5] is steps[5]  # a walk of 0 is another list of instructions
    assert made[6].shared.model.name == pendulum().name
    assert of_one_form(steps)[0] is made[0]  # made once
    rng, model = np.random.default_rng(0), steps[0].model
    P = random_belief(0, model).cov
    given = [rng.normal(size=n) for n in (4, 1, 3, 3)]
    for own, other in zip(steps[:5], made[:5], strict=True):
        m, u, y, R = given
        p = own.full(np.zeros(0)), other.full(np.zeros(0))
        both = zip((own.shared, other.shared), p, strict=True)
        out = [f.function(m, P, u, numbers, y, R**2, 0.1) for f, numbers in both]
        for a, b in zip(*out, strict=True):
            assert np.array_equal(np.asarray(a), np.asarray(b))


@pytest.mark.ci
@pytest.mark.compiled
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler found")
def test_banks_in_lanes_are_their_members_one_by_one():
    """Quotients by a constant and by a parameter round alike here; 1e-13 is for other compilers."""
    models = bank()
    data = gappy(1, models["m0"], BLOCK + 20)
    prior = random_belief(2, models["m0"])
    some = {n: data if n != "m3" else data.part(0, BLOCK + 5) for n in models}
    made = multiple_models(models, prior, some)
    for (n, model), r in zip(models.items(), made.results, strict=True):
        alone = run(ekf_step(model), prior, some[n])
        for field in ("mean", "variance", "innovation", "nis", "loglik"):
            both = getattr(r, field), getattr(alone, field)
            np.testing.assert_allclose(*both, rtol=1e-13, atol=1e-13, err_msg=f"{n} {field}")
    T = np.full((6, 6), 0.02) + 0.88 * np.eye(6)
    wide, vm = (
        interacting_multiple_models(models, prior, data, transition=T, backend=b)
        for b in (None, "vm")
    )
    np.testing.assert_allclose(wide.mean, vm.mean, rtol=1e-12, atol=1e-12)
    # rounding of a likelihood goes on from sample to sample
    np.testing.assert_allclose(wide.log_probability, vm.log_probability, rtol=1e-11, atol=1e-11)
