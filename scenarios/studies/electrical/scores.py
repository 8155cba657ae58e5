"""What is judged: normalised errors, their bands, one-phase statistics along a run, alarms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy.stats

from estimators.apu.electrical.terminalsignals import PHASES
from estimators.filters.filtering import FilterResult

__all__ = ["alarm_times", "h_covariance", "in_band", "nees", "rmse_interval", "statistics_of"]


def _band(n: int, dof: float, level: float = 0.95) -> tuple[float, float]:
    """Two-sided band of the mean of n chi-squared values with ``dof`` degrees of freedom."""
    a = (1 - level) / 2
    return (
        float(scipy.stats.chi2.ppf(a, n * dof) / n),
        float(scipy.stats.chi2.ppf(1 - a, n * dof) / n),
    )


def in_band(values: np.ndarray, n: int, dof: float) -> dict[str, Any]:
    """Return the share of checkpoints whose mean over n seeds lies in its band, and the extremes.

    Args:
        values: means over the seeds, one for each checkpoint.
        n: seeds.
        dof: degrees of freedom of one value.
    """
    low, high = _band(n, dof)
    v = np.asarray(values)
    return {
        "dof": dof,
        "band": [low, high],
        "mean": float(v.mean()),
        "range": [float(v.min()), float(v.max())],
        "share": float(((v >= low) & (v <= high)).mean()),
        "course": v.tolist(),
    }


def nees(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Return the normalised estimation errors squared, (c,); error (c, n), cov (c, n, n)."""
    s = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    scaled = cov / (s[:, :, None] * s[:, None, :])
    e = error / s
    return np.einsum("ci,ci->c", e, np.linalg.solve(scaled, e[..., None])[..., 0])


def rmse_interval(ratio: float, n: int) -> list[float]:
    """Return the 95 % interval of a root mean square of n Gaussian values, found as ``ratio``."""
    a, b = scipy.stats.chi2.ppf([0.025, 0.975], n)
    return [ratio * math.sqrt(n / b), ratio * math.sqrt(n / a)]


def h_covariance(result: FilterResult) -> np.ndarray:
    """Return the covariances of the three h along a run with ``full=True``, shape (K, 3, 3)."""
    i = result.x.indices([f"h_{k}" for k in PHASES])
    assert result.cov is not None
    return result.cov[:, i][:, :, i]


def statistics_of(h: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Return the one-phase statistics along a run, signed.

    Their squares are what :func:`~estimators.apu.electrical.faults.faulty_phase` judges.

    Args:
        h: estimates, shape (3, K). cov : their covariances, shape (K, 3, 3).

    Returns:
        Shape (3, K): h_k with the other two zero, over its standard deviation; standard normal
        where there is no fault.
    """
    info = np.linalg.inv(cov)
    score = np.einsum("kij,jk->ik", info, h)
    return np.asarray(score / np.sqrt(np.diagonal(info, axis1=1, axis2=2).T))


def alarm_times(z: np.ndarray, level: float) -> np.ndarray:
    """Return the samples at which the largest statistic rises past the level.

    Args:
        z: as of :func:`statistics_of`, shape (3, K).
        level: of its square.
    """
    above = (z.max(axis=0) > math.sqrt(level)).astype(int)
    return np.flatnonzero(np.diff(above, prepend=0) > 0)
