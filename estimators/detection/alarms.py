"""What a test says along a sequence: statistic, threshold, alarms, and the rate it promises."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError

__all__ = ["HOUR", "Alarms", "allowed_per_sample", "rising"]

HOUR = 3600.0  # s


@dataclass(frozen=True, eq=False)
class Alarms:
    """What a test said along a sequence of K samples.

    Args:
        test: its name.
        statistic: shape (K,); NaN where it could not be formed.
        threshold: an alarm is raised where the statistic passes it; a number, or one per sample.
        index: samples at which an alarm was raised, increasing.
        rate: samples per second.
        false_alarms_per_hour: the stated rate, with which the threshold was found.
        start: time of the first sample, s.
    """

    test: str
    statistic: np.ndarray
    threshold: Any
    index: np.ndarray
    rate: float
    false_alarms_per_hour: float
    start: float = 0.0

    @property
    def times(self) -> np.ndarray:
        """Times of the alarms, s."""
        return self.start + self.index / self.rate

    def delay(self, onset: float) -> float:
        """Return the time from an onset (s) to the first alarm at or after it, s; inf if none."""
        late = self.times[self.times >= onset - 0.5 / self.rate]
        return float(max(late[0] - onset, 0.0)) if late.size else math.inf

    def before(self, onset: float) -> int:
        """Return the number of alarms before an onset: false ones."""
        return int((self.times < onset - 0.5 / self.rate).sum())

    def to_dict(self, limit: int = 1000) -> dict[str, Any]:
        """Return numbers that JSON can hold: what was asked, number and first ``limit`` alarms."""
        peak = float(np.nanmax(self.statistic)) if np.isfinite(self.statistic).any() else None
        threshold = np.asarray(self.threshold, float)
        finite = threshold[np.isfinite(threshold)]
        return {
            "test": self.test,
            "samples": int(self.statistic.size),
            "rate_Hz": self.rate,
            "false_alarms_per_hour": self.false_alarms_per_hour,
            "threshold": float(np.median(finite)) if finite.size else None,
            "peak": peak,
            "alarms": int(self.index.size),
            "times_s": self.times[:limit].tolist(),
        }


def rising(above: np.ndarray) -> np.ndarray:
    """Return the indices at which a condition, shape (K,), begins to hold."""
    return np.flatnonzero(above & ~np.concatenate([[False], above[:-1]]))


def allowed_per_sample(false_alarms_per_hour: float, rate: float) -> float:
    """Return the false alarms for each sample that are allowed.

    Args:
        false_alarms_per_hour: stated rate.
        rate: samples per second.

    Raises:
        ParameterError: not finite and positive, or 0.1 for each sample and more.
    """
    for name, value in (("false_alarms_per_hour", false_alarms_per_hour), ("rate", rate)):
        if not 0 < number(name, value, error=ParameterError) < math.inf:
            raise ParameterError(f"{name} must be finite and > 0, got {value!r}")
    per_sample = false_alarms_per_hour / (HOUR * rate)
    if per_sample >= 0.1:
        raise ParameterError(
            f"{false_alarms_per_hour:g} false alarms an hour at {rate:g} samples a second are "
            f"{per_sample:.2g} for each sample: that is no test; ask for fewer than 0.1"
        )
    return per_sample
