"""A missing reading in every filter: as if that sensor were a million times noisier at the instant.

With noise 1e6 larger (variance 1e12) a reading moves an estimate by 1e-12 of what it else would, so
that 1e-9 is exact.
"""

import numpy as np
import pytest
from estimation_models import random_belief, random_linear
from numpy.testing import assert_allclose

from estimators.batch.mhe import moving_horizon
from estimators.batch.relinearised import relinearised_filter
from estimators.batch.smoother import rts_smoother
from estimators.detection.cusum import cusum_test
from estimators.detection.nis import windowed_nis
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.imm import interacting_multiple_models
from estimators.filters.ukf import unscented_kalman_filter
from estimators.models.recording import Recording

MODEL, _ = random_linear(3)
PRIOR = random_belief(3, MODEL)
K = 14


def smoothed(*a, **k):
    return rts_smoother(extended_kalman_filter(*a, full=True, **k))


def switching(model, *a, **k):
    return interacting_multiple_models({"a": model, "b": model}, *a, rates=[[-1, 1], [1, -1]], **k)


FILTERS = {
    "ekf": extended_kalman_filter,
    "iterated": lambda *a, **k: extended_kalman_filter(*a, iterations=3, **k),
    "noise": lambda *a, **k: extended_kalman_filter(*a, iterations=2, iterated="noise", **k),
    "cubature": unscented_kalman_filter,
    "scaled": lambda *a, **k: unscented_kalman_filter(*a, points="scaled", **k),
    "smoother": smoothed,
    "two passes": relinearised_filter,
    "modes": switching,
    "horizon": lambda *a, **k: moving_horizon(*a, horizon=3, **k),
}
#: Rows and instants without a reading: one, the first, a sensor for long, everything for a while.
HOLES = {
    "one": ([1], [6]),
    "first": ([0, 1, 2], [0]),
    "sensor": ([0], range(K)),
    "all": ([0, 1, 2], range(4, 9)),
}


def recordings(hole):
    """The same readings with NaN, and with a noise that makes them worthless."""
    rows, at = HOLES[hole]
    rng = np.random.default_rng(8)
    t = np.cumsum(rng.uniform(0.1, 0.3, K))
    u, y = rng.standard_normal((1, K)), rng.standard_normal((3, K))
    R = rng.uniform(0.1, 0.3, (3, K))
    there = np.ones((3, K), bool)
    there[np.ix_(rows, list(at))] = False
    missing = Recording(t, u, np.where(there, y, np.nan), R, np.zeros(0))
    noisy = Recording(t, u, y, np.where(there, R, 1e12), np.zeros(0))
    return missing, noisy


@pytest.mark.long
@pytest.mark.parametrize("hole", HOLES)
@pytest.mark.parametrize("name", FILTERS)
def test_is_skipped_and_the_rest_kept(name, hole):
    """Means and variances of all states at all instants."""
    missing, noisy = recordings(hole)
    got, want = (FILTERS[name](MODEL, PRIOR, data, backend="vm") for data in (missing, noisy))
    # IPOPT ends at 1e-8 of its scaled unknowns
    tol = 1e-7 if name == "horizon" else 1e-9
    assert_allclose(got.mean, want.mean, rtol=tol, atol=tol)
    assert_allclose(got.variance, want.variance, rtol=1e-9)


def test_tests_of_innovations_take_no_evidence_from_gaps():
    """NIS and its degrees of freedom are 0 there; a CUSUM stays where it is."""
    missing, _ = recordings("all")
    r = extended_kalman_filter(MODEL, PRIOR, missing, backend="vm")
    gap = slice(4, 9)
    assert (r.nis[gap] == 0).all() and (r.measured[gap] == 0).all()
    assert np.isnan(r.innovation[:, gap]).all()
    total, dof = windowed_nis(r.nis, r.measured, 3)
    assert total[7] == 0 and dof[7] == 0
    z = np.where(np.arange(K) % 2, np.nan, 2.0)
    S = cusum_test(z, drift=0.5, false_alarms_per_hour=1.0, rate=1.0, threshold=100.0).statistic
    assert_allclose(S, 1.5 * (np.arange(K) // 2 + 1))
