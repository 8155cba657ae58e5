"""The Rauch-Tung-Striebel smoother, for every filter that keeps its cross-covariances.

Rauch, Tung and Striebel (1965); in the form of Särkkä (2013), Bayesian Filtering and Smoothing,
algorithm 8.2 and 9.1: only the covariance of the filtered state with the next predicted state is
needed, so one recursion serves the extended and the unscented filter, and noise that is correlated
with the sample.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from apu_casadi.errors import EstimationError
from estimators.belief import Belief
from estimators.filtering import FilterResult

__all__ = ["rts_smoother"]


def rts_smoother(filtered: FilterResult) -> FilterResult:
    """Return p(x(k) | all samples): the filter's result with mean, variance and cov smoothed.

    Parameters
    ----------
    filtered : from a filter run with ``full=True``.

    Raises
    ------
    EstimationError : the filter did not keep what is needed.
    """
    r = filtered
    if r.cov is None or r.cross is None or r.cov_pred is None or r.mean_pred is None:
        raise EstimationError("the smoother needs a filter run with full=True")
    mean, cov = r.mean.copy(), r.cov.copy()
    # scaled to unit predicted variances, so that units do not spoil the pseudo-inverse
    for k in range(r.t.size - 2, -1, -1):
        Pp = r.cov_pred[k + 1]
        s = np.sqrt(np.maximum(np.diag(Pp), np.finfo(float).tiny))
        known = np.diag(Pp) <= 0
        s[known] = 1.0
        corr = Pp / np.outer(s, s)
        gain = np.linalg.lstsq(corr, (r.cross[k] / s).T, rcond=1e-14)[0].T / s
        mean[:, k] += gain @ (mean[:, k + 1] - r.mean_pred[:, k + 1])
        new = r.cov[k] + gain @ (cov[k + 1] - Pp) @ gain.T
        cov[k] = (new + new.T) / 2
    variance = np.maximum(np.diagonal(cov, axis1=1, axis2=2).T, 0.0)
    return dataclasses.replace(
        r, mean=mean, variance=variance, cov=cov, final=Belief(r.x, mean[:, -1], cov[-1])
    )
