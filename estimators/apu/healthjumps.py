"""Jumps of the health: found by the innovations, and followed by a filter that goes back to them.

A health factor walks slowly.  A fault is a jump, which no slow walk follows: so the belief is
opened for it where the innovations say so (:func:`track_jumps`).
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from apu_casadi.core.errors import EstimationError
from estimators.apu.gaspath import JUMP, GasPathFilter
from estimators.apu.gaspathmodel import DT
from estimators.filters.belief import Belief
from estimators.filters.filtering import FilterResult, StepMaker
from estimators.filters.resuming import Runs, joined
from estimators.information.consistency import exceeded
from estimators.models.filtermodel import FilterModel
from estimators.models.recording import Recording

__all__ = ["JumpTest", "Tracked", "judged", "spliced", "track_jumps", "whitened"]

SAME_JUMP = 25  # samples between onsets of one jump, as two courses of the power show it


class Jumping(Protocol):
    """A filter whose model has the input ``jump``: how much may change at once."""

    @property
    def model(self) -> FilterModel:
        """Its model."""

    def runs(
        self,
        *,
        prior: Belief | None = None,
        step: StepMaker | None = None,
        backend: str | None = None,
    ) -> Runs:
        """Return the filter for recordings that begin alike, with all covariances."""


@dataclass(frozen=True)
class JumpTest:
    """When the innovations say that the health has jumped.

    Whitened innovations are summed over windows of several lengths; the squared norm of each sum
    over its length is chi-squared as long as the model holds, and grows with the window's length
    under a lasting shift.

    Args:
        windows: lengths in samples.
        rate: accepted false alarms in an hour; the threshold follows by Bonferroni's bound over all
            samples and windows, so that the true rate is lower.
        margin: factor on the threshold for what the model does not hold.
        hold: samples after a jump, or after the start, in which no new alarm is raised.
        limit: an innovation counts no more than this many standard deviations, so that a single
            wild reading is no jump.
    """

    windows: tuple[int, ...] = (1, 3, 10, 30, 100, 200)
    rate: float = 1.0
    margin: float = 1.25
    hold: int = 25
    limit: float = math.inf

    def threshold(self, ny: int, dt: float = DT) -> float:
        """Threshold of the statistic for ``ny`` outputs."""
        tests = 3600.0 / dt * len(self.windows)
        return float(self.margin * exceeded(self.rate / tests, ny))

    def statistic(self, result: FilterResult, start: int) -> np.ndarray:
        """Return the largest of the windows that end at each sample, from ``start`` on, (K,)."""
        e = whitened(result, self.limit)
        total = np.concatenate([np.zeros((1, e.shape[1])), np.cumsum(e, axis=0)])
        K = e.shape[0]
        best = np.zeros(K)
        for n in self.windows:
            at = np.arange(max(start, 0) + n - 1, K)
            stat = np.sum((total[at + 1] - total[at + 1 - n]) ** 2, axis=1) / n
            best[at] = np.maximum(best[at], stat)
        return best

    def evidence(self, result: FilterResult) -> float:
        """Return the largest statistic of a recording over the threshold; 1 is an alarm."""
        most = float(self.statistic(result, self.hold).max(initial=0.0))
        return most / self.threshold(len(result.y))

    def first(self, result: FilterResult, start: int) -> tuple[int, int] | None:
        """Return the first alarm at or after sample ``start``: (alarm, onset), or None."""
        e = whitened(result, self.limit)
        total = np.concatenate([np.zeros((1, e.shape[1])), np.cumsum(e, axis=0)])
        best = self.statistic(result, start)
        over = np.flatnonzero(best > self.threshold(e.shape[1]))
        if not over.size:
            return None
        k = int(over[0])
        # the onset: the start of the best window of any length that ends at the alarm
        lengths = np.arange(1, min(max(self.windows), k + 1 - max(start, 0)) + 1)
        stat = np.sum((total[k + 1] - total[k + 1 - lengths]) ** 2, axis=1) / lengths
        return k, k + 1 - int(lengths[int(stat.argmax())])


def whitened(result: FilterResult, limit: float = math.inf) -> np.ndarray:
    """Innovations made uncorrelated and of unit variance, shape (K, ny); 0 where not measured.

    Each counts no more than ``limit`` of its own standard deviations.

    Raises:
        EstimationError: the filter did not keep the innovations' covariances.
    """
    if result.innovation_cov is None:
        raise EstimationError("whitened innovations need a filter run with full=True")
    most = limit * np.sqrt(np.nan_to_num(result.innovation_variance, nan=1.0).T)
    nu = np.clip(np.nan_to_num(result.innovation.T), -most, most)
    L = np.linalg.cholesky(result.innovation_cov)
    return np.asarray(np.linalg.solve(L, nu[..., None])[..., 0])


@dataclass(frozen=True, eq=False)
class Tracked:
    """A filter's result with jumps found on the way.

    Args:
        result: every sample's belief is what was known then: before an alarm from the run without
            that jump.
        alarms, onsets: samples of the alarms, and the last samples before the jumps they report.
        data, prior: what the filter was run on, with the jumps, and began with; None: its own.
        deciding: the same result of :attr:`GasPathFilter.deciding`, where that is another filter.
    """

    result: FilterResult
    alarms: tuple[int, ...]
    onsets: tuple[int, ...]
    data: Recording
    prior: Belief | None = None
    deciding: FilterResult | None = None


def judged(filt: GasPathFilter, tracked: Tracked) -> tuple[GasPathFilter, Tracked]:
    """Return the filter by whose innovations is judged what a recording holds, and its result."""
    if tracked.deciding is None:
        return filt, tracked
    return filt.deciding, dataclasses.replace(tracked, result=tracked.deciding, deciding=None)


def track_jumps(
    filt: Jumping,
    data: Recording,
    *,
    test: JumpTest | None = None,
    prior: Belief | None = None,
    step: StepMaker | None = None,
    backend: str | None = None,
    most: int = 8,
    runs: Runs | None = None,
) -> Tracked:
    """Filter a recording; where the innovations demand it, go back and let the health jump.

    Causal: an alarm at sample k changes beliefs from k on only, although the filter is run again
    from the onset, as it could be at the time.

    Args:
        filt, data: filter and recording.
        test: the test; :class:`JumpTest`'s defaults.
        prior, step, backend: as for :meth:`GasPathFilter.run`.
        most: largest number of jumps; further alarms are not acted on.
        runs: the filter with what it was run over before, see :meth:`GasPathFilter.runs`.
    """
    test = JumpTest() if test is None else test
    again = filt.runs(prior=prior, step=step, backend=backend) if runs is None else runs
    judge = again.deciding
    result, seen = again(data), None if judge is None else judge(data)
    alarms: list[int] = []
    onsets: list[int] = []
    row = filt.model.u.index("jump")
    start = test.hold
    while len(alarms) < most:
        found = test.first(result if seen is None else seen, start)
        if found is None:
            break
        k, onset = found
        alarms.append(k)
        onsets.append(onset - 1)
        u = data.u.copy()
        u[row, onset - 1] = JUMP  # acts in the step that ends at the onset
        data = Recording(data.t, u, data.y, data.variance, data.p)
        late = again(data)
        result = dataclasses.replace(late, **joined(result, late, k))
        if judge is not None and seen is not None:
            late = judge(data)
            seen = dataclasses.replace(late, **joined(seen, late, k))
        start = k + test.hold
    return Tracked(result, tuple(alarms), tuple(onsets), data, prior, seen)


def spliced(before: Tracked, after: Tracked, k: int) -> Tracked:
    """Take ``before`` up to sample k, ``after`` from there on: what is known anew at k.

    Alarms that were raised before k stay; of ``after`` count those of jumps that no alarm has
    reported, at k at the earliest.
    """
    result, seen = after.result, after.deciding
    result = dataclasses.replace(result, **joined(before.result, result, k))
    if before.deciding is not None and seen is not None:
        seen = dataclasses.replace(seen, **joined(before.deciding, seen, k))
    pairs = [(a, o) for a, o in zip(before.alarms, before.onsets, strict=True) if a < k]
    for a, o in zip(after.alarms, after.onsets, strict=True):
        if a >= k or not any(abs(o - old) <= SAME_JUMP for _, old in pairs):
            pairs.append((max(a, k), o))
    alarms, onsets = (tuple(p[i] for p in pairs) for i in (0, 1))
    return Tracked(result, alarms, onsets, after.data, after.prior, seen)
