"""Single wild samples of a waveform: told by their two neighbours, and taken for missing.

Everything of one frequency w fulfils x(k-1) - 2 cos(w dt) x(k) + x(k+1) = 0, so that

    e(k) = x(k) - (x(k-1) + x(k+1)) / (2 cos(w dt))

holds noise alone, of 1.25 standard deviations of a sample at 400 Hz and 10 kHz.  One sample that is
off by A gives e = A there and -A / (2 cos(w dt)) at both neighbours.  A step, a harmonic does not;
what happens in the machine is in several channels at once, and no wild sample either.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy.special import chdtri

__all__ = ["wild_samples"]

CHANCE = 1e-9  # with which a good sample is taken for wild: one in a day at 10 kHz
FEWEST_SAMPLES = 5


def wild_samples(
    t: np.ndarray,
    x: Mapping[str, np.ndarray],
    w: float,
    sigma: Mapping[str, float],
    chance: float = CHANCE,
) -> dict[str, np.ndarray]:
    """Return which samples are wild by channel, shapes (K,).

    Args:
        t, x: instants, s, and samples by channel, NaN where there is none, shape (K,).
        w: frequency of the waveforms, rad/s.
        sigma: standard deviation of a sample's noise, by channel.
        chance: with which a good sample is taken for a wild one.
    """
    K = t.size
    none = {n: np.zeros(K, bool) for n in x}
    step = np.diff(t)
    if K < FEWEST_SAMPLES or not 2 * math.cos(w * float(np.median(step))) > 0.5:
        return none  # with four samples a period and fewer, neighbours say nothing
    turn = 2 * math.cos(w * float(np.median(step)))
    even = np.abs(step[1:] - step[:-1]) < 0.1 * step[:-1]
    level = math.sqrt(float(chdtri(1, chance)) * (1 + 2 / turn**2))
    far, alone = {}, {}
    for n, v in x.items():
        e = np.full(K, np.nan)
        e[1:-1] = np.where(even, v[1:-1] - (v[:-2] + v[2:]) / turn, np.nan)
        limit = level * sigma[n]
        if np.isfinite(e).any():  # what harmonics leave is not wild
            limit = max(limit, 3 * float(np.nanquantile(np.abs(e), 0.9)))
        with np.errstate(invalid="ignore"):
            far[n] = np.abs(e) > limit
            rest = np.maximum(np.abs(e[:-2] + e[1:-1] / turn), np.abs(e[2:] + e[1:-1] / turn))
            alone[n] = none[n].copy()
            alone[n][1:-1] = far[n][1:-1] & (rest < limit)
    near = {n: np.convolve(f, np.ones(5), "same") > 0 for n, f in far.items()}
    return {
        n: a & ~np.any([f for m, f in near.items() if m != n], axis=0) for n, a in alone.items()
    }
