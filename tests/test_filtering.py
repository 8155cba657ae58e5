"""Running a filter's step over a recording: blocks, results, errors.

Two routes to every number: the step called sample by sample against the blocks.
"""

import dataclasses

import numpy as np
import pytest
from estimation_models import cv_model, gappy, pendulum, pendulum_data, random_belief
from numpy.testing import assert_allclose

from apu_casadi.core.backend import find_compiler, use_backend
from apu_casadi.core.errors import DataError, EstimationError, SignalError
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import BLOCK, STEP_OUT, run
from estimators.filters.resuming import Runs
from estimators.filters.ukf import ukf_step

STEPS = {"ekf": ekf_step, "ukf": ukf_step}
every_step = pytest.mark.parametrize("name", STEPS)


@pytest.mark.long
@every_step
@pytest.mark.parametrize("K", [1, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK + 30])
def test_blocks_are_the_step_sample_by_sample(name, K):
    """At and around the block's length; full results or not."""
    model = cv_model()
    step = STEPS[name](model)
    prior, data = random_belief(0, model), gappy(0, model, K)
    r = run(step, prior, data, full=True, backend="vm")
    m, P = prior.mean, np.linalg.cholesky(prior.cov) if step.root else prior.cov
    missing, loglik = np.isnan(data.y), 0.0
    for k in range(K):
        y, R = np.where(missing, 0, data.y)[:, k], np.where(missing, -1, data.variance)[:, k]
        out = step.function(m, P, data.u[:, k], data.p, y, R, data.dt[k])
        o = dict(zip(STEP_OUT, (np.array(v) for v in out), strict=True))
        if k in (0, K // 2, K - 1):
            assert_allclose(r.mean[:, k], o["m_f"][:, 0], rtol=1e-12)
            assert_allclose(r.cov[k], o["P_f"], rtol=1e-12)
            assert_allclose(r.cross[k], o["C"], rtol=1e-12)
            assert_allclose(r.innovation_cov[k], o["S"], rtol=1e-12)
            assert_allclose(r.mean_pred[:, k], np.ravel(m), rtol=1e-12)
            assert_allclose(r.cov_pred[k], P @ P.T if step.root else P, rtol=1e-12, atol=1e-14)
        loglik += o["stats"][2, 0]
        m, P = o["m1"], o["P1"]
    assert_allclose(r.loglik, loglik, rtol=1e-12)
    assert_allclose(r.final.cov, r.cov[-1])
    short = run(step, prior, data, backend="vm")
    for field in ("mean", "variance", "innovation", "innovation_variance", "nis", "measured"):
        assert_allclose(getattr(short, field), getattr(r, field), rtol=1e-13, err_msg=field)
    assert_allclose(short.final.cov, r.final.cov, rtol=1e-13)
    assert short.cov is None and short.cross is None and short.innovation_cov is None


@pytest.mark.parametrize("at", [0, 7, 30])
def test_recordings_that_begin_alike_are_run_from_where_they_differ(at, monkeypatch):
    """Bit for bit what a run from the beginning says; the common part is not run again."""
    model = cv_model()
    prior, data = random_belief(1, model), gappy(1, model, 31)
    data.y[0, at], data.variance[0, at] = 0.3, 0.1
    y = data.y.copy()
    y[0, at] += 1.0
    other = dataclasses.replace(data, y=y)
    step, sizes = ekf_step(model), []

    def counted(step, prior, data, **how):
        sizes.append(data.size)
        return run(step, prior, data, **how)

    monkeypatch.setattr("estimators.filters.resuming.run", counted)
    runs = Runs(step, prior, "vm")
    runs(data)
    made, whole = runs(other), run(step, prior, other, full=True, backend="vm")
    assert runs(data) is not made and sizes == [31, 31 - at]
    for f in dataclasses.fields(made):
        got, want = getattr(made, f.name), getattr(whole, f.name)
        if isinstance(want, np.ndarray):
            np.testing.assert_array_equal(got, want, f.name)
    assert_allclose(made.loglik, whole.loglik, rtol=1e-12)
    np.testing.assert_array_equal(made.final.cov, whole.final.cov)
    np.testing.assert_array_equal(made.again().mean, whole.again().mean)


@every_step
def test_going_on_from_the_final_belief(name):
    """Two halves with the prediction between them are the whole: `final` is after the sample."""
    model = cv_model()
    step = STEPS[name](model)
    prior, data = random_belief(1, model), gappy(1, model, 40)
    whole = run(step, prior, data, full=True, backend="vm")
    first = run(step, prior, data.part(0, 21), backend="vm")
    # the sample at the seam was taken; it must not be taken again
    y = data.y[:, 20:].copy()
    y[:, 0] = np.nan
    rest = data.part(20, 40)
    second = run(step, first.final, dataclasses.replace(rest, y=y), backend="vm")
    # w of the seam's sample is known a little from it, which the belief of x alone does not say;
    # without noise in the output nothing is lost
    assert_allclose(second.mean[:, -1], whole.mean[:, -1], rtol=1e-9, atol=1e-9)


@pytest.mark.long
@every_step
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_generated_c_gives_the_same(name):
    """Compiled and virtual machine, both filters, on a nonlinear model (rounding: 1e-10)."""
    model = pendulum()
    prior = Belief.of(model.x, {"q": 1, "r": 0, "k": 5}, {"q": 0.3, "r": 1, "k": 0.5})
    step, data = STEPS[name](model), pendulum_data(model, K=150)
    a, b = (run(step, prior, data, full=True, backend=s) for s in ("vm", "c"))
    for field in ("mean", "cov", "cross", "nis", "innovation_cov"):
        assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("singular", [False, True])
def test_plain_steps_take_covariances(singular):
    """The unscented filter for use inside others: the same numbers, singular priors included."""
    model = cv_model(walk=0.0)
    prior, data = random_belief(0, model), gappy(0, model, 30)
    if singular:
        prior = prior.change(sigma={"c": 0.0})
    step = ukf_step(model)
    assert step.plain is step.plain and not step.plain.root and ekf_step(model).plain.root is False
    a, b = (run(s, prior, data, full=True, backend="vm") for s in (step, step.plain))
    for field in ("mean", "cov", "cov_pred", "cross", "loglik"):
        assert_allclose(getattr(a, field), getattr(b, field), rtol=1e-9, atol=1e-9)


def test_the_backend_in_use_is_asked_each_time(monkeypatch):
    """A block made under one backend is not taken for another's."""
    import estimators.filters.filterblock as filterblock
    import estimators.filters.filtering as filtering

    asked = []
    real = filterblock.compiled
    monkeypatch.setattr(
        filterblock, "compiled", lambda f, backend: asked.append(backend) or real(f, backend="vm")
    )
    model = cv_model()
    step, prior, data = ekf_step(model), random_belief(0, model), gappy(0, model, 3)
    with use_backend("vm"):
        run(step, prior, data)
        run(step, prior, data)
    assert len(asked) == 1
    monkeypatch.setattr(filtering, "backend_in_use", lambda: "c")
    run(step, prior, data)
    assert len(asked) == 2


def test_runs_may_be_nested():
    """A run inside another's progress does not disturb it."""
    model = cv_model()
    step, prior, data = ekf_step(model), random_belief(0, model), gappy(0, model, 250)
    other = gappy(7, model, 120)
    calm = run(step, prior, data, backend="vm")
    seen = []

    def inside(done, total):
        seen.append((done, total))
        run(step, prior, other, backend="vm")

    assert (run(step, prior, data, backend="vm", progress=inside).mean == calm.mean).all()
    assert seen == [(100, 250), (200, 250), (250, 250)]


def test_labelled_results():
    """Names, units, and the standard deviations beside; NaN where nothing was measured."""
    model = pendulum()
    prior = Belief.of(model.x, {"q": 1, "r": 0, "k": 5}, {"q": 0.3, "r": 1, "k": 0.5})
    r = run(ekf_step(model), prior, pendulum_data(model), backend="vm")
    ds = r.to_dataset()
    mean, sigma = r["k"]
    assert_allclose(ds["k"], mean)
    assert_allclose(ds["k_sigma"], sigma)
    assert_allclose(sigma**2, r.variance[2])
    assert np.isnan(ds["innovation_accel"].values[1]) and ds.attrs["loglik"] == r.loglik
    assert ds["innovation_angle"].attrs["units"] == "1"
    with pytest.raises(SignalError, match="unknown signal 'kk'"):
        r["kk"]


def test_what_does_not_fit_is_refused():
    """Another recording, another prior."""
    model, other = cv_model(), pendulum()
    step = ekf_step(model)
    with pytest.raises(SignalError, match="prior of q, r, k; cv has s, v, c"):
        run(step, random_belief(0, other), gappy(0, model, 3), backend="vm")
    with pytest.raises(DataError, match="cv has 1 inputs, 0 parameters and 2 outputs"):
        run(step, random_belief(0, model), pendulum_data(other), backend="vm")


@every_step
def test_the_instant_at_which_the_belief_is_lost_is_named(name):
    """An input held so long that the state overflows: the sample after it, in the second block, is
    blamed and no earlier one."""
    model = cv_model()
    data = gappy(3, model, 150, missing=0.0)
    t, u = data.t.copy(), data.u.copy()
    u[0, 130] = np.finfo(float).max
    t[131:] += 1e3
    data = dataclasses.replace(data, t=t, u=u)
    with pytest.raises(EstimationError, match=rf"cv at t = {t[131]:.9g} s \(sample 131\): the be"):
        run(STEPS[name](model), random_belief(0, model), data, backend="vm")
