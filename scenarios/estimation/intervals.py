"""Intervals of what is counted."""

from __future__ import annotations

from scipy.stats import beta

__all__ = ["share_interval"]


def share_interval(k: float, n: float) -> tuple[float, float]:
    """Return the 95 % interval of a share, k of n; without a trial everything is possible.

    Clopper and Pearson (1934), Biometrika 26, 404-413: never too narrow, also near 0 and 1.
    """
    low = float(beta.ppf(0.025, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
    return low, high
