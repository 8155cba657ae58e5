"""What is judged: one-phase statistics along a run, alarms."""

from __future__ import annotations

import math

import numpy as np

from apu_casadi.machine.park import PHASES
from estimators.filters.filtering import FilterResult

__all__ = ["alarm_times", "h_covariance", "statistics_of"]


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
