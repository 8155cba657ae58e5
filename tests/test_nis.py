"""The windowed NIS: its stated rate by simulation and by direct integration, gaps, delays."""

import json
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from apu_casadi.core.errors import ParameterError, SignalError
from estimators.detection.alarms import HOUR
from estimators.detection.nis import nis_test, nis_threshold, upcrossing_rate, windowed_nis


@pytest.mark.long
@pytest.mark.parametrize(("dof", "window"), [(1, 1), (1, 6), (4, 10), (3, 80)])
def test_upcrossings_of_the_moving_sum_come_at_the_stated_rate(dof, window):
    """2e6 samples at a rate of 1e-3: 2000 crossings, so 5 standard deviations are 11 %."""
    K, rate = 2_000_000, 50.0
    nis = np.random.default_rng(dof).chisquare(dof, K)
    asked = 1e-3 * rate * HOUR
    got = nis_test(
        nis, np.full(K, dof), window=window, false_alarms_per_hour=asked, rate=rate
    ).index.size
    assert got == pytest.approx(1e-3 * K, rel=0.12)


def test_a_window_of_one_is_the_chi_squared_test():
    """F (1 - F) is the rate of 'not above, then above' of independent samples."""
    c, p = nis_threshold(3, 1, 1.0, 50.0)
    assert p == pytest.approx(stats.chi2.sf(c, 3), rel=1e-9)
    assert p * (1 - p) * 50 * HOUR == pytest.approx(1.0, rel=1e-6)


def test_the_rate_of_crossings_against_direct_integration():
    """One term of two degrees of freedom is exponential: the integral by a fine sum."""
    c, dof, n = 31.0, 2, 8
    a = np.linspace(0, c, 400_001)
    one = 1 - np.exp(-(c - a) / 2)
    direct = np.trapezoid(stats.chi2.pdf(a, dof * (n - 1)) * one * (1 - one), a)
    assert upcrossing_rate(c, dof, n) == pytest.approx(direct, rel=1e-7)


def test_windowed_sums_with_gaps():
    nis = np.array([1.0, 2.0, 0.0, 4.0])
    total, dof = windowed_nis(nis, np.array([1, 2, 0, 2]), 2)
    assert_allclose(total, [1, 3, 2, 4])
    assert_allclose(dof, [1, 3, 2, 2])


def test_a_shift_is_found_and_its_delay_told():
    rng = np.random.default_rng(4)
    z = rng.standard_normal((2000, 3))
    z[1200:] += 1.2
    found = nis_test(
        (z**2).sum(1), np.full(2000, 3), window=25, false_alarms_per_hour=1, rate=50, start=10.0
    )
    assert found.before(10 + 24.0) == 0
    assert 0 < found.delay(10 + 24.0) < 1.0
    assert found.delay(1e6) == math.inf
    told = json.loads(json.dumps(found.to_dict()))
    assert told["alarms"] == found.index.size and told["false_alarms_per_hour"] == 1


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: nis_threshold(3, 100_000, 100.0, 1.0), ParameterError, "shorten the window"),
        (lambda: windowed_nis(np.ones(3), np.ones(2), 1), SignalError, "one length"),
        (lambda: windowed_nis(np.array([np.nan]), np.ones(1), 1), SignalError, "not finite"),
        (lambda: windowed_nis(np.ones(3), np.ones(3), 0), ParameterError, "window"),
    ],
)
def test_refusals(call, error, words):
    with pytest.raises(error, match=words):
        call()
