"""Blocks of a covariance filter over a recording, with as little between them as can be.

What needs a closer look, a covariance that loses digits or a belief that is lost, ends it: such a
recording is left to the loop of :func:`estimators.filters.filtering.run`, which goes on in
square-root form or tells what is wrong.  Up to there the results are the same, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.calling import Caller
from estimators.filters.belief import Belief
from estimators.filters.filterblock import (
    BLOCK,
    PADDED,
    ROWS,
    WIDE,
    block_length,
    narrow_ones,
    packed_diagonal,
    unpacked,
)
from estimators.filters.rowblock import SOME
from estimators.models.filtermodel import CHECK_TOL, FilterModel
from estimators.models.recording import Recording

__all__ = ["Piece", "Sweep"]

_STATS = 4
_LOOK = 32  # blocks between looks at what has been done


class Piece(NamedTuple):
    """What a filter says of n samples.

    Args:
        mean, var, nu, S, stats: by signal and sample.
        some: covariances of the samples asked for.
        last: covariance of the last sample.
        ahead: belief about the next sample, before it; None at the end of the recording.
    """

    mean: np.ndarray
    var: np.ndarray
    nu: np.ndarray
    S: np.ndarray
    stats: np.ndarray
    some: np.ndarray
    last: np.ndarray
    ahead: Belief | None


def _copy(of: Sequence[np.ndarray], to: Sequence[np.ndarray]) -> None:
    """Copy the first arrays, as many as there are to take them."""
    for a, b in zip(to, of, strict=False):
        a[:] = b


class Sweep:
    """A filter over parts of one recording.

    Attributes:
        courses: mean, variance, innovation, its variance and ``STATS`` of all samples, as far as
            they were filtered last: pieces are views of them, so that nobody has to join any.

    Args:
        model: the step's.
        block: of a step that carries halves of covariances, compiled, see
            :func:`~.filterblock.block_function`; a short one without ``cov_at``.
        data: the recording.
        p: parameters as the step takes them.
        wide: whether there is a form with roots to go on in.
        rows: the block is one of :func:`~.filterblock.row_function`.
        cov_at: samples whose covariances are wanted, ascending; None: none.
        remember: what a piece has done is kept for another one from the same start.
    """

    model: FilterModel
    data: Recording
    wide: bool
    courses: tuple[np.ndarray, ...]

    def __init__(
        self,
        model: FilterModel,
        block: ca.Function,
        data: Recording,
        p: np.ndarray,
        *,
        wide: bool,
        rows: bool = False,
        cov_at: np.ndarray | None = None,
        remember: bool = False,
    ) -> None:
        self.model, self.data, self.wide, self._rows = model, data, wide, rows
        self._short = rows or cov_at is None  # variances only, and the last sample's covariance
        self._wanted = np.array([] if cov_at is None else cov_at, dtype=int)
        self._call = Caller(block, copy=False)
        self._length, self._remember = ROWS if rows else block_length(model), remember
        self._call.inputs[-1].ravel(order="K")[:] = np.ravel(p)
        missing = np.isnan(data.y)
        self._y = np.where(missing, 0.0, data.y)
        self._R, self._dt = np.where(missing, -1.0, data.variance), data.dt
        (ny, K), nx = data.y.shape, len(model.x)
        self.courses = tuple(np.empty((n, K)) for n in (nx, nx, ny, ny, _STATS))
        self._last: tuple[Belief, int, list[tuple[np.ndarray, ...]], Piece] | None = None

    def piece(
        self,
        start: int,
        stop: int,
        belief: Belief,
        progress: Callable[[int, int], None] | None = None,
    ) -> Piece | None:
        """Filter samples from start up to stop; None where that needs a closer look.

        What the last call has done from the same start is not done again, if it is remembered.

        Args:
            start, stop: numbers of samples.
            belief: at the first of them, before it.
            progress: called with what is done and all after each block.
        """
        K, n, nx = self.data.size, stop - start, belief.mean.size
        mean, var, nu, S, stats = (a[:, start:stop] for a in self.courses)
        here = self._wanted[(self._wanted >= start) & (self._wanted < stop)] - start
        some, ends = np.empty((here.size, nx, nx)), []
        edges = self._edges(n, here)
        # one sample more, of which nothing is told, for the belief about it
        more = int(stop < K and n - edges[-2] < self._length and not self._rows)
        call, first = self._call, 3 if self._short else 2
        given, made = call.inputs[:first], call.outputs
        m_f, P_f, *rest = made[first : first + 5]
        diagonal = slice(None) if self._short else packed_diagonal(nx)
        given[0][:], given[1][:] = belief.mean, belief.cov
        starts: list[tuple[np.ndarray, ...]] = []
        block = judged = 0
        if self._last is not None and self._last[0] is belief and self._last[1] == start:
            # the same beginning: at the last block that is the same
            _, _, before, known = self._last  # of whose samples the courses are
            block = min(len(edges) - 2, len(before) - 1)
            judged = edges[block]
            starts = before[:block]
            some[here < judged] = known.some[: int((here < judged).sum())]
            _copy(before[block], given)
        every = 1 if self._rows else 4 * BLOCK // self._length
        for b in range(block, len(edges) - 1):
            r = slice(edges[b], edges[b + 1])
            inside = slice(*np.searchsorted(here, (r.start, r.stop)))
            ours = here[inside] - r.start
            self._fill(start + r.start, start + r.stop, more if r.stop == n else 0, ours)
            if self._remember:
                starts.append(tuple(a.copy() for a in given))
            call.evaluate()
            k = r.stop - r.start
            mean[:, r], var[:, r] = m_f[:, :k], P_f[diagonal, :k]
            for target, source in zip((nu, S, stats), rest, strict=True):
                target[:, r] = source[:, :k]
            if ours.size:
                some[inside] = unpacked(made[8][:, : ours.size] if self._rows else P_f[:, ours], nx)
            if b % every == 0:
                ends.append(made[1].reshape(nx, nx).copy())
            if b % (_LOOK * BLOCK // self._length) == 0 or r.stop == n:
                if not self._good(start, slice(judged, r.stop), (mean, var, S, stats), ends):
                    return None
                judged, ends = r.stop, []
            if r.stop < n:
                _copy(made, given)
            if progress is not None:
                progress(r.stop, n)
        # of a short block the covariance of the last sample, which may be the one more
        last = made[2].reshape(nx, nx).copy() if self._short else unpacked(P_f[:, [k - 1]], nx)[0]
        ahead = None
        if more:
            there = last if self._short else unpacked(P_f[:, [k]], nx)[0]
            ahead = Belief.found(self.model.x, m_f[:, k].copy(), there)
        elif stop < K:
            ahead = Belief.found(self.model.x, made[0].copy(), made[1].reshape(nx, nx).copy())
        piece = Piece(mean, var, nu, S, stats, some, last, ahead)
        if self._remember:
            self._last = belief, start, starts, piece
        return piece

    def _edges(self, n: int, wanted: np.ndarray) -> list[int]:
        """Return where blocks begin, and where the last one of n samples ends."""
        if not self._rows:
            return [*range(0, n, self._length), n]
        # the covariance is looked at after the first ``BLOCK``, and after each ``ROWS`` from there
        return sorted({0, *range(BLOCK, n, ROWS), *wanted[SOME::SOME].tolist(), n})

    def _fill(self, start: int, stop: int, more: int, wanted: np.ndarray) -> None:
        """Put samples into the buffers, and what fills the block up."""
        first = 3 if self._short else 2
        u, y, R, dt = self._call.inputs[first : first + 4]
        if self._rows:
            keep = self._call.inputs[-2]
            keep[:] = 0.0
            keep.ravel()[wanted] = 1.0
        n, all_of = stop - start, slice(start, stop)
        for given, own in ((u, self.data.u), (y, self._y), (R, self._R), (dt, self._dt[None])):
            given[:, :n] = own[:, all_of]
        if n < u.shape[1]:
            u[:, n:], y[:, n:], R[:, n:], dt[:, n:] = self.data.u[:, [stop - 1]], 0.0, PADDED, 0.0
        if more:
            u[:, n], R[:, n], dt[:, n] = self.data.u[:, stop], -1.0, self._dt[stop]

    def _good(
        self, start: int, part: slice, made: Sequence[np.ndarray], ends: list[np.ndarray]
    ) -> bool:
        """Whether some samples, counted from a start, are to be believed as they are."""
        mean, var, S, stats = (a[:, part] for a in made)
        if not ((stats[0] <= CHECK_TOL).all() and (var >= 0).all() and np.isfinite(mean).all()):
            return False
        if not self.wide:
            return True
        R = self._R[:, start + part.start : start + part.stop]
        if not (WIDE * np.abs(R) >= S).all():
            return False
        return not ends or not narrow_ones(np.array(ends)).any()
