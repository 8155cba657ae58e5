"""Intervals of what is counted."""

from __future__ import annotations

from scipy.special import betaincinv  # scipy.stats takes a third of a second to load

__all__ = ["share_interval"]


def share_interval(k: float, n: float) -> tuple[float, float]:
    """Return the 95 % interval of a share, k of n; without a trial everything is possible.

    Clopper and Pearson (1934), Biometrika 26, 404-413: never too narrow, also near 0 and 1.
    """
    low = float(betaincinv(k, n - k + 1, 0.025)) if k else 0.0
    high = float(betaincinv(k + 1, n - k, 0.975)) if k < n else 1.0
    return low, high
