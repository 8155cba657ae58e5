"""Blocks of a covariance filter over a recording, with as little between them as can be.

What needs a closer look, a covariance that loses digits or a belief that is lost, ends it: such a
recording is left to the loop of :func:`estimators.filters.filtering.run`, which goes on in
square-root form or tells what is wrong.  Up to there the results are the same, bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.calling import Caller
from estimators.filters.belief import Belief
from estimators.filters.filterblock import (
    BLOCK,
    PADDED,
    WIDE,
    block_length,
    narrow,
    packed_diagonal,
    unpacked,
)
from estimators.models.filtermodel import CHECK_TOL, FilterModel
from estimators.models.recording import Recording

__all__ = ["Piece", "Sweep"]

_STATS = 4


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


class Sweep:
    """A filter over parts of one recording.

    Args:
        model: the step's.
        block: of a step that carries halves of covariances, compiled, see
            :func:`~.filterblock.block_function`; a short one without ``cov_at``.
        data: the recording.
        p: parameters as the step takes them.
        wide: whether there is a form with roots to go on in.
        cov_at: samples whose covariances are wanted, ascending; None: none.
    """

    def __init__(
        self,
        model: FilterModel,
        block: ca.Function,
        data: Recording,
        p: np.ndarray,
        *,
        wide: bool,
        cov_at: np.ndarray | None = None,
    ) -> None:
        self.model, self.data, self.wide, self._short = model, data, wide, cov_at is None
        self._wanted = np.array([] if cov_at is None else cov_at, dtype=int)
        self._call = Caller(block, copy=False)
        self._length = block_length(model)
        self._call.inputs[-1].ravel(order="K")[:] = np.ravel(p)
        missing = np.isnan(data.y)
        self._y = np.where(missing, 0.0, data.y)
        self._R, self._dt = np.where(missing, -1.0, data.variance), data.dt
        self._last: tuple[Belief, int, list[tuple[np.ndarray, ...]], Piece] | None = None

    def piece(
        self,
        start: int,
        stop: int,
        belief: Belief,
        progress: Callable[[int, int], None] | None = None,
    ) -> Piece | None:
        """Filter samples from start up to stop; None where that needs a closer look.

        What the last call has done from the same start is not done again.

        Args:
            start, stop: numbers of samples.
            belief: at the first of them, before it.
            progress: called with what is done and all after each block.
        """
        K, n, length = self.data.size, stop - start, self._length
        nx, ny = belief.mean.size, self._y.shape[0]
        # one sample more, of which nothing is told, for the belief about it
        more = int(stop < K and n % length > 0)
        mean, var = np.empty((nx, n)), np.empty((nx, n))
        nu, S, stats = np.empty((ny, n)), np.empty((ny, n)), np.empty((_STATS, n))
        here = self._wanted[(self._wanted >= start) & (self._wanted < stop)] - start
        some, ends = np.empty((here.size, nx, nx)), []
        call, first = self._call, 3 if self._short else 2
        rows = packed_diagonal(nx)
        call.inputs[0][:], call.inputs[1][:] = belief.mean, belief.cov
        starts: list[tuple[np.ndarray, ...]] = []
        done = 0
        if self._last is not None and self._last[0] is belief and self._last[1] == start:
            # the same beginning: at the last block that is the same
            _, _, before, known = self._last
            block = min((n - 1) // length, len(before) - 1)
            done, starts = block * length, before[:block]
            for target, source in zip((mean, var, nu, S, stats), known[:5], strict=True):
                target[:, :done] = source[:, :done]
            some[here < done] = known.some[: int((here < done).sum())]
            for given, own in zip(call.inputs[:first], before[block], strict=True):
                given[:] = own
        for at in range(done, n, length):
            r = slice(at, min(at + length, n))
            self._fill(start + r.start, start + r.stop, more if r.stop == n else 0)
            starts.append(tuple(a.copy() for a in call.inputs[:first]))
            call.evaluate()
            m_f, P_f, *rest = call.outputs[first : first + 5]
            k = r.stop - r.start
            mean[:, r] = m_f[:, :k]
            var[:, r] = (P_f if self._short else P_f[rows])[:, :k]
            for target, source in zip((nu, S, stats), rest, strict=True):
                target[:, r] = source[:, :k]
            inside = (here >= r.start) & (here < r.stop)
            if inside.any():
                some[inside] = unpacked(P_f[:, here[inside] - r.start], nx)
            if at // length % (4 * BLOCK // length) == 0:
                ends.append(call.outputs[1].copy())
            if r.stop < n:
                for given, made in zip(call.inputs[:first], call.outputs, strict=False):
                    given[:] = made
            if progress is not None:
                progress(r.stop, n)
        if not self._good(slice(start, stop), mean, var, S, stats, ends):
            return None
        at_last = k - 1
        last = call.outputs[2] if self._short else unpacked(P_f[:, [at_last]], nx)[0]
        ahead = None
        if more:
            there = call.outputs[2] if self._short else unpacked(P_f[:, [k]], nx)[0]
            ahead = Belief(self.model.x, m_f[:, k].copy(), there.copy())
        elif stop < K:
            ahead = Belief(self.model.x, call.outputs[0].ravel().copy(), call.outputs[1].copy())
        piece = Piece(mean, var, nu, S, stats, some, last.copy(), ahead)
        self._last = belief, start, starts, piece
        return piece

    def _fill(self, start: int, stop: int, more: int) -> None:
        """Put samples into the buffers, and what fills the block up."""
        u, y, R, dt = self._call.inputs[-5:-1]
        n, all_of = stop - start, slice(start, stop)
        for given, own in ((u, self.data.u), (y, self._y), (R, self._R), (dt, self._dt[None])):
            given[:, :n] = own[:, all_of]
        if n < u.shape[1]:
            u[:, n:], y[:, n:], R[:, n:], dt[:, n:] = self.data.u[:, [stop - 1]], 0.0, PADDED, 0.0
        if more:
            u[:, n], R[:, n], dt[:, n] = self.data.u[:, stop], -1.0, self._dt[stop]

    def _good(
        self,
        part: slice,
        mean: np.ndarray,
        var: np.ndarray,
        S: np.ndarray,
        stats: np.ndarray,
        ends: list[np.ndarray],
    ) -> bool:
        if not ((stats[0] <= CHECK_TOL).all() and (var >= 0).all() and np.isfinite(mean).all()):
            return False
        if not self.wide:
            return True
        if not (WIDE * np.abs(self._R[:, part]) >= S).all():
            return False
        return not any(narrow(P) for P in ends)
