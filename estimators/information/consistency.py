"""Whether errors are as large as was claimed: NEES, NIS, their bands, and intervals of counts.

The normalised estimation error squared e' P^-1 e, and the normalised innovation squared, are
chi-squared if a filter is right (Bar-Shalom, Li and Kirubarajan 2001, section 5.4); the mean of n
of them, independent and with d degrees of freedom each, is chi2(n d)/n.

The chi-squared functions are those of ``scipy.stats``, which takes a third of a second to load.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.special import betaincinv, chdtr, chdtrc, chdtri, gammaincinv, gammaln, ndtri, xlogy

from apu_casadi.core.errors import ParameterError

__all__ = [
    "above",
    "band",
    "below",
    "count_limit",
    "coverage",
    "density",
    "exceeded",
    "in_band",
    "independent",
    "nees",
    "quantile",
    "rms_interval",
    "share_interval",
    "sigmas",
]

# ------------------------------------------------------------------------------ chi-squared


def quantile(p: Any, dof: Any) -> Any:
    """Return what a chi-squared number lies below with probability p."""
    return 2 * gammaincinv(np.asarray(dof) / 2, p)


def exceeded(p: Any, dof: Any) -> Any:
    """Return what a chi-squared number exceeds with probability p, small ones too."""
    return chdtri(dof, p)


def below(x: Any, dof: Any) -> Any:
    """Return the probability that a chi-squared number lies below x."""
    return chdtr(dof, x)


def above(x: Any, dof: Any) -> Any:
    """Return the probability that a chi-squared number lies above x."""
    return chdtrc(dof, x)


def density(x: Any, dof: float) -> Any:
    """Return the density of a chi-squared number at x."""
    return np.exp(xlogy(dof / 2 - 1, x) - x / 2 - gammaln(dof / 2) - math.log(2) * dof / 2)


# ------------------------------------------------------------------------------ errors


def nees(error: np.ndarray, cov: np.ndarray) -> np.ndarray:
    """Return e' P^-1 e over the last axes, (...); error (..., n), cov (..., n, n)."""
    s = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    e = error / s
    scaled = cov / (s[..., :, None] * s[..., None, :])
    return np.asarray(np.einsum("...i,...i->...", e, np.linalg.solve(scaled, e[..., None])[..., 0]))


def band(n: int, dof: float, level: float = 0.95) -> tuple[float, float]:
    """Return the two-sided band of the mean of n chi-squared numbers with ``dof`` each."""
    low, high = (float(quantile(p, n * dof)) / n for p in ((1 - level) / 2, (1 + level) / 2))
    return low, high


def in_band(values: np.ndarray, n: int, dof: float) -> dict[str, Any]:
    """Return the share of checkpoints whose mean over n seeds lies in its band, and the extremes.

    Args:
        values: means over the seeds, one for each checkpoint.
        n: seeds.
        dof: degrees of freedom of one value.
    """
    low, high = band(n, dof)
    v = np.asarray(values)
    return {
        "dof": dof,
        "band": [low, high],
        "mean": float(v.mean()),
        "range": [float(v.min()), float(v.max())],
        "share": float(((v >= low) & (v <= high)).mean()),
        "course": v.tolist(),
    }


def independent(values: np.ndarray) -> float:
    """Return how many independent numbers the columns of (seeds, n) amount to: n^2/sum of corr."""
    return float(values.shape[1] ** 2 / np.corrcoef(values.T).sum())


def rms_interval(rms: float, n: int) -> list[float]:
    """Return the 95 % interval of a root mean square of n Gaussian values, found as ``rms``."""
    a, b = quantile(np.array([0.025, 0.975]), n)
    return [rms * math.sqrt(n / b), rms * math.sqrt(n / a)]


# ------------------------------------------------------------------------------ counts


def share_interval(k: float, n: float) -> tuple[float, float]:
    """Return the 95 % interval of a share, k of n; without a trial everything is possible.

    Clopper and Pearson (1934), Biometrika 26, 404-413: never too narrow, also near 0 and 1.
    """
    low = float(betaincinv(k, n - k + 1, 0.025)) if k else 0.0
    high = float(betaincinv(k + 1, n - k, 0.975)) if k < n else 1.0
    return low, high


def count_limit(k: int, level: float = 0.95) -> float:
    """Return the upper limit of the expectation of a Poisson count, found as k."""
    return float(quantile(level, 2 * (k + 1))) / 2


def sigmas(level: float) -> float:
    """Return how many standard deviations on either side hold a share ``level`` of a Gaussian.

    Raises:
        ParameterError: a level outside (0, 1).
    """
    if not 0 < level < 1:
        raise ParameterError(f"level = {level!r} must lie between 0 and 1")
    return float(ndtri(0.5 + level / 2))


def coverage(error: np.ndarray, sigma: np.ndarray, level: float = 0.95) -> dict[str, float]:
    """Return how often intervals hold the truth, with its own interval, and what the errors are.

    Args:
        error: estimate minus truth, (n,); NaN where there is no estimate, which covers nothing.
        sigma: claimed standard errors, (n,).
        level: of the intervals.
    """
    n, there = error.size, int(np.isfinite(error).sum())
    k = int((np.abs(error) <= sigmas(level) * sigma).sum())
    low, high = share_interval(k, n)
    return {
        "covered": k / n,
        "low": low,
        "high": high,
        "rms_error": float(np.sqrt(np.nanmean(error**2))),
        "mean_sigma": float(np.nanmean(sigma)),
        "bias_over_its_error": float(np.nanmean(error) / (np.nanstd(error) / np.sqrt(there))),
    }
