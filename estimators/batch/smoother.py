"""The Rauch-Tung-Striebel smoother, for every filter that keeps its cross-covariances.

Rauch, Tung and Striebel (1965); in the form of Särkkä (2013), Bayesian Filtering and Smoothing,
algorithm 8.2 and 9.1: only the covariance of the filtered state with the next predicted state is
needed, so one recursion serves the extended and the unscented filter, and noise that is correlated
with the sample.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from apu_casadi.core.errors import EstimationError
from estimators.filters.belief import Belief
from estimators.filters.filtering import NARROW, FilterResult

__all__ = ["rts_smoother"]


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
    r = filtered
    if r.cov is None or r.cross is None or r.cov_pred is None or r.mean_pred is None:
        raise EstimationError("the smoother needs a filter run with full=True")
    if r.roots is not None:
        return _by_roots(r)
    mean, cov = r.mean.copy(), r.cov.copy()
    # scaled to unit predicted variances, so that units do not spoil the pseudo-inverse
    for k in range(r.t.size - 2, -1, -1):
        Pp = r.cov_pred[k + 1]
        s = np.sqrt(np.maximum(np.diag(Pp), np.finfo(float).tiny))
        known = np.diag(Pp) <= 0
        s[known] = 1.0
        corr = Pp / np.outer(s, s)
        gain, _, _, single = np.linalg.lstsq(corr, (r.cross[k] / s).T, rcond=1e-14)
        gain = gain.T / s
        mean[:, k] += gain @ (mean[:, k + 1] - r.mean_pred[:, k + 1])
        new = r.cov[k] + gain @ (cov[k + 1] - Pp) @ gain.T
        cov[k] = (new + new.T) / 2
        before, after = np.diag(r.cov[k]), np.diag(new)
        near = single[: single.size - known.sum()]
        if (before > LOST * np.maximum(after, 0.0)).any() or (near < NARROW * near[:1]).any():
            if r.again is not None:
                return _by_roots(r.again())
            _refuse(r, k, before, after)
    return _smoothed(r, mean, cov)


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


def _by_roots(r: FilterResult) -> FilterResult:
    """Smooth with Y and Z of :mod:`estimators.filters.rootfilter`: sums of squares only.

    x(k) given x(k+1) has the gain Y L1^-1 and the covariance Z Z', so that a root of the smoothed
    covariance is [Y L1^-1 Ls(k+1), Z].
    """
    assert r.roots is not None and r.mean_pred is not None
    before, Y, Z, own = r.roots
    mean, cov = r.mean.copy(), np.empty_like(own)
    L = own[-1]
    cov[-1] = L @ L.T
    for k in range(r.t.size - 2, -1, -1):
        L1 = before[k + 1]
        mean[:, k] += Y[k] @ _solve(L1, mean[:, k + 1] - r.mean_pred[:, k + 1])
        A = np.hstack([Y[k] @ _solve(L1, L), Z[k]])
        # rows scaled to one length, so that units do not spoil the orthogonalisation
        size = np.sqrt((A**2).sum(1))
        per = np.where(size > 0, size, 1.0)
        L = per[:, None] * np.asarray(np.linalg.qr((A / per[:, None]).T, mode="r")).T
        cov[k] = L @ L.T
    return _smoothed(r, mean, cov)


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
