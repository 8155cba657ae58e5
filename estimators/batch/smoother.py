"""The Rauch-Tung-Striebel smoother, for every filter that keeps its cross-covariances.

Rauch, Tung and Striebel (1965); in the form of Särkkä (2013), Bayesian Filtering and Smoothing,
algorithm 8.2 and 9.1: only the covariance of the filtered state with the next predicted state is
needed, so one recursion serves the extended and the unscented filter, and noise that is correlated
with the sample.

Over the whole recording it is the fixed-interval smoother (:func:`rts_smoother`).  Begun anew a
fixed lag after each instant it is the fixed-lag smoother (:func:`fixed_lag_smoother`): what is
known of an instant that much later, while samples still come in.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from apu_casadi.core.errors import EstimationError, ParameterError
from estimators.filters.belief import Belief
from estimators.filters.filterblock import NARROW
from estimators.filters.filtering import FilterResult
from estimators.models.recording import SAME_TIME

__all__ = ["fixed_lag_smoother", "rts_smoother", "smoothing_gain"]


LOST = 1e8  # filtered over smoothed variance from which their difference has lost eight digits


def rts_smoother(filtered: FilterResult) -> FilterResult:
    """Return p(x(k) | all samples): the filter's result with mean, variance and cov smoothed.

    Where a difference of covariances loses its digits (a prior 1e4 times wider than what the
    samples tell, states known far better together than alone), the filter is run again in
    square-root form, and smoothed so.

    Args:
        filtered: from a filter run with ``full=True``.

    Raises:
        EstimationError: the filter did not keep what is needed; digits are lost, and the filter has
            no square-root form.
    """
    r = _whole(filtered)
    if r.roots is not None:
        return _by_roots(r)
    mean, cov = r.mean.copy(), r.cov.copy()
    for k in range(r.t.size - 2, -1, -1):
        gain, narrow = smoothing_gain(r.cov_pred[k + 1], r.cross[k])
        mean[:, k] += gain @ (mean[:, k + 1] - r.mean_pred[:, k + 1])
        new = r.cov[k] + gain @ (cov[k + 1] - r.cov_pred[k + 1]) @ gain.T
        cov[k] = (new + new.T) / 2
        before, after = np.diag(r.cov[k]), np.diag(new)
        if narrow or (before > LOST * np.maximum(after, 0.0)).any():
            if filtered.again is not None:
                return _by_roots(_whole(filtered.again()))
            _refuse(filtered, k, before, after)
    return _smoothed(filtered, mean, cov)


def fixed_lag_smoother(
    filtered: FilterResult, lag: int | None = None, *, delay: float | None = None
) -> FilterResult:
    """Return p(x(k) | samples up to a lag after k): what a delayed output of the filter knows.

    Each instant is the start of a smoother over the instants that follow it within the lag; near
    the end there are fewer of them.  Anderson and Moore (1979), Optimal Filtering, chapter 7, have
    the same by a state that is augmented with its past.

    Args:
        filtered: from a filter run with ``full=True``.
        lag: number of later instants, >= 0; 0 is the filter itself.
        delay: instead, s: the instants up to this much later, whatever their number.

    Raises:
        ParameterError: both or none of lag and delay, or one that is negative.
        EstimationError: as :func:`rts_smoother`.
    """
    r = _whole(filtered)
    ends = _ends(r.t, lag, delay)
    if r.roots is not None:
        return _lagged_by_roots(r, ends)
    K, n = r.t.size, len(filtered.x)
    gains, narrow = np.zeros((K, n, n)), False
    for k in range(K - 1):
        gains[k], bad = smoothing_gain(r.cov_pred[k + 1], r.cross[k])
        narrow |= bad
    mean, cov = r.mean.T[ends].copy(), r.cov[ends].copy()
    back = ends - np.arange(K)
    for d in range(int(back.max()), 0, -1):
        on = np.flatnonzero(back >= d)
        i = on + d - 1  # from i + 1 back to i
        G = gains[i]
        mean[on] = r.mean.T[i] + _times(G, mean[on] - r.mean_pred.T[i + 1])
        new = r.cov[i] + G @ (cov[on] - r.cov_pred[i + 1]) @ G.transpose(0, 2, 1)
        cov[on] = (new + new.transpose(0, 2, 1)) / 2
        before, after = (np.diagonal(a, axis1=1, axis2=2) for a in (r.cov[i], new))
        lost = (before > LOST * np.maximum(after, 0.0)).any(1)
        if narrow or lost.any():
            if filtered.again is not None:
                return _lagged_by_roots(_whole(filtered.again()), ends)
            worst = int(np.argmax(lost))
            _refuse(filtered, int(i[worst]), before[worst], after[worst])
    return _smoothed(filtered, mean.T.copy(), cov)


class _Whole(NamedTuple):
    """What a smoother takes of a filter's result."""

    of: FilterResult
    t: np.ndarray
    mean: np.ndarray
    cov: np.ndarray
    mean_pred: np.ndarray
    cov_pred: np.ndarray
    cross: np.ndarray
    roots: tuple[np.ndarray, ...] | None


def _whole(r: FilterResult) -> _Whole:
    """Refuse a result without covariances."""
    if r.cov is None or r.cross is None or r.cov_pred is None or r.mean_pred is None:
        raise EstimationError("the smoother needs a filter run with full=True")
    return _Whole(r, r.t, r.mean, r.cov, r.mean_pred, r.cov_pred, r.cross, r.roots)


def smoothing_gain(P: np.ndarray, cross: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return cross P^-1, and whether P has lost the digits for it.

    Args:
        P: covariance of the next predicted state, (m, m); what is known exactly has no gain.
        cross: covariance of the filtered state with it, (n, m).
    """
    # scaled to unit predicted variances, so that units do not spoil the pseudo-inverse
    s = np.sqrt(np.maximum(np.diag(P), np.finfo(float).tiny))
    known = np.diag(P) <= 0
    s[known] = 1.0
    corr = P / np.outer(s, s)
    gain, _, _, single = np.linalg.lstsq(corr, (cross / s).T, rcond=1e-14)
    near = single[: single.size - known.sum()]
    return gain.T / s, bool((near < NARROW * near[:1]).any())


def _ends(t: np.ndarray, lag: int | None, delay: float | None) -> np.ndarray:
    """The last instant whose sample each instant's smoother knows, (K,)."""
    if (lag is None) == (delay is None):
        raise ParameterError("give either lag (instants) or delay (seconds)")
    last = t.size - 1
    if lag is not None:
        if not (isinstance(lag, int) and not isinstance(lag, bool) and lag >= 0):
            raise ParameterError(f"lag must be a whole number >= 0, got {lag!r}")
        return np.minimum(np.arange(t.size) + lag, last)
    assert delay is not None
    if not 0 <= delay < math.inf:
        raise ParameterError(f"delay must be finite and >= 0 s, got {delay!r}")
    return np.searchsorted(t, t + delay + SAME_TIME, side="right") - 1


def _times(G: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Products of matrices (m, n, k) and vectors (m, k)."""
    return np.asarray((G @ v[:, :, None])[:, :, 0])


def _refuse(r: FilterResult, k: int, before: np.ndarray, after: np.ndarray) -> None:
    """Refuse a step in which more digits are lost than are left, of a filter without roots."""
    lost = before * 1e-12 > np.maximum(after, 0.0)
    if lost.any():
        i = int(np.argmax(lost))
        raise EstimationError(
            f"t = {r.t[k]:.9g} s (sample {k}): the smoothed variance of {r.x.names[i]} is "
            f"{before[i]:.3g} less nearly the same, of which no digit is left: take a prior that "
            "is less wide, or the extended filter, which can be smoothed in square-root form"
        )


def _by_roots(r: _Whole) -> FilterResult:
    """Smooth with Y and Z of :mod:`estimators.filters.rootfilter`: sums of squares only."""
    assert r.roots is not None
    own = r.roots[-1]
    mean, cov = r.mean.copy(), np.empty_like(own)
    L = own[-1]
    cov[-1] = L @ L.T
    for k in range(r.t.size - 2, -1, -1):
        mean[:, k], L = _root_back(r, k, mean[:, k + 1], L)
        cov[k] = L @ L.T
    return _smoothed(r.of, mean, cov)


def _lagged_by_roots(r: _Whole, ends: np.ndarray) -> FilterResult:
    assert r.roots is not None
    mean, cov = np.empty_like(r.mean), np.empty_like(r.cov)
    for k, end in enumerate(ends.tolist()):
        m, L = r.mean[:, end], r.roots[-1][end]
        for i in range(end - 1, k - 1, -1):
            m, L = _root_back(r, i, m, L)
        mean[:, k], cov[k] = m, L @ L.T
    return _smoothed(r.of, mean, cov)


def _root_back(r: _Whole, k: int, mean: np.ndarray, L: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed mean and root at k from those at k+1.

    x(k) given x(k+1) has the gain Y L1^-1 and the covariance Z Z', so that a root of the smoothed
    covariance is [Y L1^-1 Ls(k+1), Z].
    """
    assert r.roots is not None
    before, Y, Z, _ = r.roots
    L1 = before[k + 1]
    moved = r.mean[:, k] + Y[k] @ _solve(L1, mean - r.mean_pred[:, k + 1])
    A = np.hstack([Y[k] @ _solve(L1, L), Z[k]])
    # rows scaled to one length, so that units do not spoil the orthogonalisation
    size = np.sqrt((A**2).sum(1))
    per = np.where(size > 0, size, 1.0)
    return moved, per[:, None] * np.asarray(np.linalg.qr((A / per[:, None]).T, mode="r")).T


def _solve(L: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return L^-1 b for lower triangular L; where its diagonal is zero, zero."""
    out = np.zeros_like(b)
    for i in range(L.shape[0]):
        if L[i, i] > 0:
            out[i] = (b[i] - L[i, :i] @ out[:i]) / L[i, i]
    return out


def _smoothed(r: FilterResult, mean: np.ndarray, cov: np.ndarray) -> FilterResult:
    variance = np.maximum(np.diagonal(cov, axis1=1, axis2=2).T, 0.0)
    return dataclasses.replace(
        r, mean=mean, variance=variance, cov=cov, final=Belief(r.x, mean[:, -1], cov[-1])
    )
