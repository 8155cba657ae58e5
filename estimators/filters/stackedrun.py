"""Filters of one step and number of blocks as arrays: no Python for each filter and block.

What needs more than its block, a covariance that loses digits or a belief that is lost, is left
to :func:`estimators.filters.filtering.run`, which goes on in square-root form or tells what is
wrong.  Results are those of ``run``, bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import casadi as ca
import numpy as np

from apu_casadi.core.backend import READY, backend_in_use
from apu_casadi.core.calling import Caller, available_threads
from apu_casadi.core.errors import DataError
from apu_casadi.core.lanes.lanelibrary import in_lanes, lanes_for
from apu_casadi.core.sharing import kept
from estimators.filters.belief import Belief
from estimators.filters.filterblock import (
    BLOCK,
    WIDE,
    block_length,
    narrow_ones,
    padded,
    plain_block,
)
from estimators.filters.filtering import STATS, FilterResult, FilterStep, narrow
from estimators.models.filtermodel import CHECK_TOL, FilterModel
from estimators.models.recording import Recording

__all__ = ["blocks_of", "lanes_of", "run_stacked", "stackable"]

One = tuple[FilterStep, Belief, Recording]


def stackable(step: FilterStep, prior: Belief, data: Recording) -> bool:
    """Whether a filter carries covariances from the beginning, and its arguments fit."""
    model = step.model
    if step.root or step.gives_roots or not model.y.names or prior.root is not None:
        return False
    if prior.x.names != model.x.names or (step.wide is not None and narrow(prior.cov)):
        return False
    try:
        data.check(model)
    except DataError:
        return False  # told where it runs alone
    return True


def blocks_of(one: One) -> int:
    """Return how many blocks a filter takes for its recording."""
    return -(-one[2].size // block_length(one[0].shared.model))


def lanes_of(step: FilterStep, n: int, *, build: bool) -> ca.Function | None:
    """Return a block of a step for n filters at once, or as many as go; None if not compiled."""
    lanes = lanes_for(n)
    there = _there(step, lanes, backend_in_use())
    if there is None and build:
        made = in_lanes(plain_block(step, False, True), lanes=lanes)
        there = made if made.class_name() == "External" else None
    return there


@kept
def _there(step: FilterStep, lanes: int, _in_use: str) -> ca.Function | None:
    """Return the same from the cache folder, in which it is looked for once."""
    made = in_lanes(plain_block(step, False, True), lanes=lanes, build=False)
    return made if made.class_name() == "External" else None


@dataclass
class _Stack:
    """Arguments and results of filters: (filter, sample, signal), as a block's columns stand."""

    m: np.ndarray
    P: np.ndarray
    P_last: np.ndarray
    given: tuple[np.ndarray, ...]  # u, y, R, dt
    p: np.ndarray
    kept: tuple[np.ndarray, ...]  # mean, variance, nu, diag S, stats
    good: np.ndarray

    @classmethod
    def of(cls, filters: Sequence[One]) -> _Stack:
        nx, _, _, _, ny = filters[0][0].model.sizes
        K = blocks_of(filters[0]) * block_length(filters[0][0].shared.model)
        ready = [padded(data, K - data.size) for _, _, data in filters]
        y, R, u, dt = (np.stack([r[i].T for r in ready]) for i in range(4))
        n = len(filters)
        return cls(
            np.stack([b.mean for _, b, _ in filters]),
            np.stack([b.cov.T for _, b, _ in filters]),
            np.zeros((n, nx, nx)),
            (u, y, R, dt),
            np.stack([np.asarray(s.full(d.p), float).ravel() for s, _, d in filters]),
            tuple(np.empty((n, K, k)) for k in (nx, nx, ny, ny, len(STATS))),
            np.ones(n, dtype=bool),
        )


def run_stacked(
    filters: Sequence[One], n_threads: int | None, backend: str | None = None
) -> tuple[list[FilterResult | None], int]:
    """Run filters of one step and number of blocks in packs of lanes.

    Args:
        filters: steps of one family, priors, recordings, all :func:`stackable`.
        n_threads: threads that run packs; None takes all cores.
        backend: ``"ready"`` compiles nothing.

    Returns:
        Results, None for filters that need more than this, and the number of results.
    """
    step = filters[0][0]
    lanes = lanes_for(len(filters))
    wide = lanes_of(step.shared, len(filters), build=backend != READY)
    if wide is None:
        return [None] * len(filters), 0
    call = Caller(wide, copy=False)
    stack = _Stack.of(filters)
    packs = [slice(i, min(i + lanes, len(filters))) for i in range(0, len(filters), lanes)]
    threads = min(available_threads() if n_threads is None else n_threads, len(packs))
    how = (call, stack, step.shared.model, step.wide is not None)
    if threads > 1:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda pack: _run_pack(pack, lanes, *how), packs))
    else:
        for pack in packs:
            _run_pack(pack, lanes, *how)
    made = [_result(stack, k, *one) if stack.good[k] else None for k, one in enumerate(filters)]
    return made, int(stack.good.sum())


def _run_pack(
    pack: slice, lanes: int, call: Caller, stack: _Stack, model: FilterModel, wide: bool
) -> None:
    """Run the blocks of some filters, one in each lane."""
    # a lane more than there are filters does what the last one does
    rows = np.minimum(np.arange(pack.start, pack.start + lanes), pack.stop - 1)
    n = pack.stop - pack.start
    views = [a.ravel(order="K").reshape(lanes, -1) for a in call.inputs]
    out = [a.ravel(order="K").reshape(lanes, -1) for a in call.outputs]
    for view, a in zip(views, (stack.m, stack.P, stack.P_last), strict=False):
        view[:] = a[rows].reshape(lanes, -1)
    views[-1][:] = stack.p[rows]
    length = block_length(model)
    for b, start in enumerate(range(0, stack.kept[0].shape[1], length)):
        s = slice(start, start + length)
        for view, a in zip(views[3:-1], stack.given, strict=True):
            view.reshape(lanes, length, a.shape[2])[:] = a[rows, s]
        call.evaluate()
        parts = [o[:n].reshape(n, length, -1) for o in out[3:]]
        for target, part in zip(stack.kept, parts, strict=True):
            target[pack, s] = part
        stack.good[pack] &= _good(parts, stack.given[2][pack, s], model, wide)
        if wide and b % (4 * BLOCK // length) == 0:
            stack.good[pack] &= ~narrow_ones(out[1][:n].reshape(n, *stack.P.shape[1:]))
        if not stack.good[pack].any():
            return
        for view, o in zip(views[:3], out[:3], strict=True):
            view[:] = o
    stack.P_last[pack] = out[2][:n].reshape(n, *stack.P.shape[1:])


def _good(parts: Sequence[np.ndarray], R: np.ndarray, model: FilterModel, wide: bool) -> np.ndarray:
    """Whether a block of each filter is to be believed as it is."""
    mean, var, _, S, stats = parts
    size = np.where(np.isfinite(mean), mean, 0.0)
    floor = -1e-12 * (np.square(model.x.nominals) + np.square(size).max(1))
    good = (stats[:, :, 0] <= CHECK_TOL).all(1) & np.isfinite(mean).all((1, 2))
    good &= (var >= floor[:, None]).all((1, 2))
    if wide:
        good &= (WIDE * np.abs(R) >= S).all((1, 2))
    made: np.ndarray = good
    return made


def _result(
    stack: _Stack, k: int, step: FilterStep, prior: Belief, data: Recording
) -> FilterResult:
    """Return one filter's result."""
    model, K = step.model, data.size
    mean, var, nu, S, stats = (np.ascontiguousarray(a[k, :K].T) for a in stack.kept)
    np.maximum(var, 0.0, out=var)  # rounding, judged above
    missing = np.isnan(data.y)
    nu[missing], S[missing] = np.nan, np.nan
    last = (stack.P_last[k] + stack.P_last[k].T) / 2
    np.fill_diagonal(last, np.maximum(np.diag(last), 0.0))
    final = Belief.found(model.x, mean[:, -1].copy(), last)
    told = stats[1], stats[3], float(stats[2].sum()), final
    return FilterResult(model.x, model.y, data.t, mean, var, nu, S, *told)
