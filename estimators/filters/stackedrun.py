"""Filters of one step and length as arrays: nothing is done for each filter and block in Python.

What needs more than its block, a covariance that loses digits or a belief that is lost, is left
to :func:`estimators.filters.filtering.run`, which goes on in square-root form or tells what is
wrong.  Results are those of ``run``, bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from apu_casadi.core.backend import backend_in_use
from apu_casadi.core.calling import Caller, available_threads
from apu_casadi.core.errors import DataError
from apu_casadi.core.lanes.lanelibrary import in_lanes, lanes_in_use
from estimators.filters.belief import Belief
from estimators.filters.filterblock import BLOCK, WIDE, block_function, block_length, padded
from estimators.filters.filtering import STATS, FilterResult, FilterStep, narrow
from estimators.models.filtermodel import CHECK_TOL, FilterModel
from estimators.models.recording import Recording

__all__ = ["run_stacked", "stackable"]

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
        K = filters[0][2].size
        pad = -K % block_length(filters[0][0].shared.model)
        ready = [padded(data, pad) for _, _, data in filters]
        y, R, u, dt = (np.stack([r[i].T for r in ready]) for i in range(4))
        n = len(filters)
        return cls(
            np.stack([b.mean for _, b, _ in filters]),
            np.stack([b.cov.T for _, b, _ in filters]),
            np.zeros((n, nx, nx)),
            (u, y, R, dt),
            np.stack([np.asarray(s.full(d.p), float).ravel() for s, _, d in filters]),
            tuple(np.empty((n, K + pad, k)) for k in (nx, nx, ny, ny, len(STATS))),
            np.ones(n, dtype=bool),
        )


def run_stacked(
    filters: Sequence[One], n_threads: int | None
) -> tuple[list[FilterResult | None], int]:
    """Run filters of one step and length in packs of lanes.

    Args:
        filters: steps of one family, priors, recordings, all :func:`stackable`.
        n_threads: threads that run packs; None takes all cores.

    Returns:
        Results, None for filters that need more than this, and the number of results.
    """
    step = filters[0][0]
    block = block_function(step.shared, False, True, None, backend_in_use())[1]
    call = Caller(in_lanes(block), copy=False)
    lanes = lanes_in_use()
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
            stack.good[pack] &= _not_narrow(out[1][:n].reshape(n, *stack.P.shape[1:]))
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


def _not_narrow(P: np.ndarray) -> np.ndarray:
    return np.array([not narrow(one) for one in P])


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
    final = Belief(model.x, mean[:, -1].copy(), last, None)
    told = stats[1], stats[3], float(stats[2].sum()), final
    return FilterResult(model.x, model.y, data.t, mean, var, nu, S, *told)
