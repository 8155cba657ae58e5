"""Page's cumulative sum: run lengths by three routes and by simulation.

Run lengths are those of Lucas and Crosier (1982), Technometrics 24, 199-205, table 1 (two-sided,
k = 0.5).
"""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core.errors import EstimationError, ParameterError
from estimators.detection.alarms import HOUR
from estimators.detection.cusum import (
    cusum,
    cusum_arl,
    cusum_arl_markov,
    cusum_arl_siegmund,
    cusum_test,
    cusum_threshold,
)


@pytest.mark.parametrize(
    ("shift", "h", "run"), [(0, 4, 168), (0.5, 4, 26.6), (1, 4, 8.38), (2, 4, 3.34), (0, 5, 465)]
)
def test_run_lengths_of_the_literature(shift, h, run):
    """Lucas and Crosier (1982), three digits as printed."""
    assert cusum_arl(0.5, h, shift) == pytest.approx(run, rel=2e-3)


@pytest.mark.parametrize(("k", "h", "shift"), [(0.5, 4, 0), (0.25, 8, 0), (0.5, 4, 1), (1, 2, 0.3)])
def test_run_lengths_by_three_routes(k, h, shift):
    """Integral equation, Markov chain (error with the square of the cells), Siegmund (some %)."""
    exact = cusum_arl(k, h, shift, two_sided=False)
    assert cusum_arl_markov(k, h, shift, two_sided=False) == pytest.approx(exact, rel=2e-4)
    assert cusum_arl(k, h, shift, two_sided=False, nodes=200) == pytest.approx(exact, rel=1e-8)
    assert cusum_arl_siegmund(k, h, shift, two_sided=False) == pytest.approx(exact, rel=0.04)


def test_siegmund_without_drift():
    """The limit of his formula: (h + 1.166)^2."""
    near = cusum_arl_siegmund(1e-5, 3.0, two_sided=False)
    assert cusum_arl_siegmund(0.0, 3.0, two_sided=False) == pytest.approx(near, rel=1e-3)


def test_one_false_alarm_an_hour_at_ten_kilohertz():
    h = cusum_threshold(0.25, 1.0, 1e4)
    assert cusum_arl(0.25, h) == pytest.approx(3.6e7, rel=1e-6)
    assert cusum_arl_siegmund(0.25, h) == pytest.approx(3.6e7, rel=0.01)


def test_alarms_come_at_the_stated_rate():
    """2e6 samples, 1000 alarms expected: 4 standard deviations are 13 %."""
    z = np.random.default_rng(2).standard_normal(2_000_000)
    asked = HOUR * 50 / 2000
    found = cusum_test(z, drift=0.4, false_alarms_per_hour=asked, rate=50)
    assert found.index.size == pytest.approx(1000, rel=0.13)


def test_the_sum_is_the_recursion():
    """Page (1954); with restarts, against a plain loop."""
    z = np.random.default_rng(3).standard_normal(5000) + 0.3
    S, expected, alarms = 0.0, [], []
    for k, v in enumerate(z):
        S = max(0.0, S + v - 0.5)
        expected.append(S)
        if S > 4:
            alarms.append(k)
            S = 0.0
    got = cusum_test(z, drift=0.5, false_alarms_per_hour=1, rate=1, two_sided=False, threshold=4.0)
    assert_allclose(got.statistic, expected, atol=1e-11)
    assert got.index.tolist() == alarms and len(alarms) > 20
    free, S = [], 0.7
    for v in z[:200]:
        S = max(0.0, S + v - 0.5)
        free.append(S)
    assert_allclose(cusum(z[:200], 0.5, 0.7), free, atol=1e-12)


def test_a_gap_is_no_evidence():
    z = np.array([2.0, np.nan, 2.0])
    got = cusum_test(z, drift=0.5, false_alarms_per_hour=1, rate=1, threshold=9.0, two_sided=False)
    assert_allclose(got.statistic, [1.5, 1.5, 3.0])


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda: cusum_threshold(0.5, 0, 50), ParameterError, "must be finite and > 0"),
        (lambda: cusum_threshold(0.5, 1e6, 50), ParameterError, "that is no test"),
        (lambda: cusum_threshold(4.0, 50.0, 1.0), ParameterError, "take a smaller drift"),
        (lambda: cusum_arl(-1, 4), ParameterError, "drift must be finite"),
        (lambda: cusum_arl(0.5, 0), ParameterError, "threshold must be finite"),
        (lambda: cusum_arl(1.0, 40.0), EstimationError, "too long"),
    ],
)
def test_refusals(call, error, words):
    with pytest.raises(error, match=words):
        call()
