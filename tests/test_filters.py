"""What holds for every recursive filter: on linear models each is the Kalman filter, by hand.

Anderson and Moore (1979), section 5.5 (correlated noises).  On linear models linearisation and all
sets of points are exact, negative weights included, so that 1e-9 only leaves room for rounding in
systems of a few hundred unknowns.  What is particular to one filter stands in ``test_ekf.py`` and
``test_ukf.py``.
"""

import dataclasses
from functools import cache

import numpy as np
import pytest
from estimation_models import (
    batch_by_hand,
    cv_model,
    cv_parts,
    gappy,
    kalman_by_hand,
    random_belief,
    random_linear,
    stateless,
    with_root_finder,
)
from numpy.testing import assert_allclose

from apu_casadi.core.errors import ParameterError
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import run
from estimators.filters.ukf import ukf_step

EXACT = dict(rtol=1e-9, atol=1e-9)
FILTERS = {
    "ekf": (ekf_step, {}),
    "ekf, two iterations": (ekf_step, {"iterations": 2}),
    "ekf, three iterations": (ekf_step, {"iterations": 3}),
    "ekf, noise iterated": (ekf_step, {"iterations": 2, "iterated": "noise"}),
    "cubature": (ukf_step, {"points": "cubature"}),
    "scaled": (ukf_step, {"points": "scaled"}),
    "close": (ukf_step, {"points": "scaled", "alpha": 0.05}),
    "negative centre": (ukf_step, {"points": "scaled", "alpha": 0.5, "beta": 0.1, "kappa": -0.5}),
    "beta < alpha^2": (ukf_step, {"points": "scaled", "beta": 0.3}),
}
every = pytest.mark.parametrize("name", FILTERS)


@cache
def varying():
    """The discretised model at varying dt, a parameter as a state; by hand, and all at once."""
    model = cv_model()
    prior, data = random_belief(5, model), gappy(5, model, 30)
    exact = kalman_by_hand(cv_parts, model.walk, prior, data)
    return model, prior, data, exact, batch_by_hand(cv_parts, model.walk, prior, data)


@cache
def sharing():
    """Noise that output and transition share; all samples at once."""
    model, parts = random_linear(2)
    prior, data = random_belief(2, model), gappy(2, model, 30)
    return model, prior, data, batch_by_hand(parts, model.walk, prior, data)


def filtered(name, model, prior, data):
    make, options = FILTERS[name]
    return run(make(model, **options), prior, data, full=True, backend="vm")


@pytest.mark.long
@every
@pytest.mark.parametrize("seed", [0, 1])
def test_is_the_kalman_filter_on_linear_models(seed, name):
    """Noise shared by output and transition, gaps, one silent sensor; iterating changes nothing:
    a filter that took its posterior for the prior would count each sample again."""
    model, parts = random_linear(seed)
    prior = random_belief(seed, model)
    data = gappy(seed, model, 50, silent=[1] if seed else [])
    exact = kalman_by_hand(parts, model.walk, prior, data)
    r = filtered(name, model, prior, data)
    for what in ("mean", "cov", "mean_pred", "cov_pred", "nis", "loglik"):
        assert_allclose(getattr(r, what), getattr(exact, what), **EXACT, err_msg=what)
    assert_allclose(r.final.cov, exact.cov[-1], **EXACT)
    assert_allclose(r.measured, (~np.isnan(data.y)).sum(0))
    assert np.isnan(r.innovation[np.isnan(data.y)]).all()


@every
def test_irregular_instants_and_a_held_noisy_input(name):
    """The discretised model at varying dt, a parameter as a state, against its matrices by hand; at
    the last instant the filter knows all samples, like least squares of everything."""
    model, prior, data, exact, (mean, cov) = varying()
    r = filtered(name, model, prior, data)
    for what in ("mean", "cov", "loglik"):
        assert_allclose(getattr(r, what), getattr(exact, what), **EXACT, err_msg=what)
    assert_allclose(r.mean[:, -1], mean[:, -1], **EXACT)
    assert_allclose(r.cov[-1], cov[-1], **EXACT)


@every
def test_last_instant_is_the_batch_fit(name):
    """The same where output and transition share noise."""
    model, prior, data, (mean, cov) = sharing()
    r = filtered(name, model, prior, data)
    assert_allclose(r.mean[:, -1], mean[:, -1], **EXACT)
    assert_allclose(r.cov[-1], cov[-1], **EXACT)


@every
def test_nothing_measured_is_prediction_only(name):
    """All samples missing: mean and covariance follow the model, the likelihood is 1."""
    model, (A, B, G, _, _) = random_linear(6)
    data = gappy(6, model, 3, missing=2.0)
    prior = random_belief(6, model)
    r = filtered(name, model, prior, data)
    m, P = prior.mean, prior.cov
    for k in range(2):
        m = A @ m + B @ data.u[:, k]
        P = A @ P @ A.T + G @ G.T + np.diag(model.walk**2) * data.dt[k]
    assert_allclose(r.mean[:, 2], m, **EXACT)
    assert_allclose(r.cov[2], P, **EXACT)
    assert r.loglik == 0 and not r.nis.any() and not r.measured.any()


@pytest.mark.long
@every
def test_singular_priors_give_no_nan(name):
    """A state known exactly, a considered one of no variance, two that are one: as by hand."""
    model = cv_model(walk=0.0)
    data = gappy(9, model, 25)
    known = Belief.of(model.x, {"s": 0, "v": 0, "c": 0.7}, {"s": 1, "v": 1, "c": 0})
    alike = Belief(model.x, np.array([0, 0.5, 0.5]), np.array([[1.0, 0, 0], [0, 2, 2], [0, 2, 2]]))
    nothing = Belief.of(model.x, {"s": 0, "v": 0, "c": 0.7}, {"s": 0, "v": 0, "c": 0})
    for prior in (known, alike, nothing):
        exact = kalman_by_hand(cv_parts, model.walk, prior, data)
        r = filtered(name, model, prior, data)
        assert_allclose(r.mean, exact.mean, **EXACT)
        assert_allclose(r.cov, exact.cov, **EXACT)
    fixed = dataclasses.replace(model, consider=("c",))
    r = filtered(name, fixed, known, data)
    assert_allclose(r.mean, kalman_by_hand(cv_parts, model.walk, known, data).mean, **EXACT)


@pytest.mark.parametrize("name", ["ekf", "ekf, two iterations", "cubature"])
def test_models_in_matrix_operations_give_the_same(name):
    """z + z^3 = a + a^3 has the root a: the same model, up to the root finder's tolerance."""
    model = with_root_finder(cv_model())
    assert model.expanded().output.is_a("MXFunction")
    prior, data = random_belief(12, model), gappy(12, model, 20)
    a, b = (filtered(name, m, prior, data) for m in (cv_model(), model))
    for what in ("mean", "cov", "cross", "innovation_cov", "loglik"):
        assert_allclose(getattr(a, what), getattr(b, what), rtol=1e-8, atol=1e-8, err_msg=what)


@pytest.mark.parametrize("make", [ekf_step, ukf_step])
def test_a_model_without_states_is_refused(make):
    """There is nothing to estimate."""
    with pytest.raises(ParameterError, match="empty has no states"):
        make(stateless())
