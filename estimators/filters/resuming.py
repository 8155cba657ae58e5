"""Runs over recordings that begin alike: each goes on from where the recordings differ.

A filter that goes back to an onset, or over a part of which more is known, need not begin anew: up
to there it says what it has said, bit for bit.
"""

from __future__ import annotations

import dataclasses
import math
from functools import partial
from typing import Any

import numpy as np

from estimators.filters.belief import Belief
from estimators.filters.filtering import FilterResult, FilterStep, rooted, run
from estimators.models.recording import Recording

__all__ = ["Runs", "joined"]

_COLUMNS = ("mean", "variance", "innovation", "innovation_variance", "nis", "measured", "mean_pred")
_ROWS = ("cov", "cov_pred", "cross", "innovation_cov")


class Runs:
    """A filter and what it was run over, all with ``full``; see the module's text.

    Args:
        step, prior, backend: as of :func:`estimators.filters.filtering.run`.
        deciding: those of the filter by whose innovations is judged what happened, where this
            one's are not white; None: its own.
    """

    step: FilterStep
    prior: Belief
    backend: str | None
    deciding: Runs | None

    def __init__(
        self,
        step: FilterStep,
        prior: Belief,
        backend: str | None = None,
        deciding: Runs | None = None,
    ) -> None:
        self.step, self.prior, self.backend = step, prior, backend
        self.deciding = deciding
        self._done: list[tuple[Recording, FilterResult]] = []

    def __call__(self, data: Recording) -> FilterResult:
        """Run the filter over a recording, from where it differs from the most similar before."""
        alike = [_alike(data, other) for other, _ in self._done]
        k = max(alike, default=0)
        made = self._from(data, self._done[alike.index(k)][1], k) if k else self._whole(data)
        self._done.append((data, made))
        return made

    def _whole(self, data: Recording) -> FilterResult:
        return run(self.step, self.prior, data, full=True, backend=self.backend)

    def _from(self, data: Recording, before: FilterResult, k: int) -> FilterResult:
        if before.roots is not None:
            return self._whole(data)
        if k == data.size:
            return before
        assert before.mean_pred is not None and before.cov_pred is not None
        belief = Belief(before.x, before.mean_pred[:, k], before.cov_pred[k])
        part = data.part(k, data.size)
        after = run(self.step, belief, part, full=True, backend=self.backend)
        if after.roots is not None:
            return self._whole(data)
        parts = joined(before, after, k, start=k)
        parts["loglik"] = after.loglik + _likelihood(before, k)
        if after.again is not None:
            parts["again"] = partial(rooted, self.step, self.prior, data, self.backend)
        return dataclasses.replace(after, t=data.t, **parts)


def joined(before: FilterResult, after: FilterResult, k: int, *, start: int = 0) -> dict[str, Any]:
    """Return the arrays of ``before`` up to sample k, and from there on those of ``after``.

    Args:
        before, after: of :func:`estimators.filters.filtering.run` with ``full``.
        k: a sample of the whole recording.
        start: first sample of ``after``.
    """
    parts: dict[str, Any] = {}
    for names, axis in ((_COLUMNS, -1), (_ROWS, 0)):
        for n in names:
            first = np.split(getattr(before, n), [k], axis)[0]
            rest = np.split(getattr(after, n), [k - start], axis)[1]
            parts[n] = np.concatenate([first, rest], axis)
    return parts


def _likelihood(r: FilterResult, k: int) -> float:
    """Logarithm of the likelihood of the first k samples."""
    assert r.innovation_cov is not None
    # of what was not measured the variance is 1
    size = np.linalg.slogdet(r.innovation_cov[:k])[1] + r.measured[:k] * math.log(2 * math.pi)
    return -0.5 * float((r.nis[:k] + size).sum())


def _alike(a: Recording, b: Recording) -> int:
    """Samples at the beginning in which two recordings of one length do not differ."""
    if a.size != b.size or not (np.array_equal(a.p, b.p) and np.array_equal(a.t, b.t)):
        return 0
    there = np.isfinite(a.y)
    read = (a.y == b.y) & (a.variance == b.variance)
    same = (a.u == b.u).all(0) & (read | ~there).all(0) & (there == np.isfinite(b.y)).all(0)
    return a.size if same.all() else int(same.argmin())
