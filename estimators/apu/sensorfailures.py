"""How a sensor fails: stuck, a step of its bias, drift, noise, spikes, dropout.

What one sensor reads beyond what all others predict of it, r with the variance s^2 from sample to
sample, after a change:

========= ======================================================================================
stuck     the reading itself stands still; its digits apart
bias      r = b
drift     r = c (t - t0)
noise     r is white, of another size
spikes    a few r are far out, the others are noise of the stated size
dropout   there are hardly any readings
========= ======================================================================================

Each is a likelihood at the parameters that fit best; half the logarithm of the number of readings
is taken off for each parameter (Schwarz 1978, Annals of Statistics 6, 461).  They tell how the
sensor failed, once it is known to have.
"""

from __future__ import annotations

import math

import numpy as np

from estimators.information.posterior import named_posterior

__all__ = ["FAILURES", "failure"]

FAILURES = ("stuck", "bias", "drift", "noise", "spikes", "dropout")
FEWEST = 4
FAR = 5.0  # standard deviations of a spike
MISSING = 0.5  # share of missing readings of a dropout
SPIKES = 0.2  # largest share of readings that are spikes


def failure(
    t: np.ndarray, reading: np.ndarray, off: np.ndarray, sigma: np.ndarray
) -> dict[str, float]:
    """Return probabilities of how a sensor failed; empty where too few readings tell.

    Args:
        t: instants after the change, s, (K,).
        reading: NaN where there is none.
        off: reading minus what the others predict.
        sigma: standard deviation of that for a sensor that is well.
    """
    there = np.isfinite(off) & np.isfinite(reading)
    if there.size and (~np.isfinite(reading)).mean() > MISSING:
        return dict.fromkeys(FAILURES, 0.0) | {"dropout": 1.0}
    t, v, r, s = (x[there] for x in (t, reading, off, sigma))
    n = r.size
    if n < FEWEST:
        return {}
    if not np.ptp(v):
        return dict.fromkeys(FAILURES, 0.0) | {"stuck": 1.0}
    z, one = r / s, 1 / s
    ramp = (t - t[0]) / s
    chi2 = {"bias": _left(z, one), "drift": _left(z, ramp)}
    score = {k: -0.5 * (q + math.log(n)) for k, q in chi2.items()}
    score["noise"] = -0.5 * n * (1 + math.log(max(float(np.mean(z**2)), 1e-12))) - 0.5 * math.log(n)
    far = np.abs(z) > FAR
    if 0 < far.mean() <= SPIKES:
        score["spikes"] = -0.5 * float((z[~far] ** 2).sum()) - 1.5 * far.sum() * math.log(n)
    return dict.fromkeys(FAILURES, 0.0) | named_posterior(score)


def _left(z: np.ndarray, basis: np.ndarray) -> float:
    """Sum of squares that the best multiple of a course leaves."""
    rest = z - basis * float(basis @ z) / float(basis @ basis)
    return float(rest @ rest)
