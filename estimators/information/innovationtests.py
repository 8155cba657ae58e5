"""Whether innovations are what a filter claims: white, normal, of the stated size.

Each test takes normalised innovations z of one sensor, (K,), NaN where nothing was measured, and
says with which probability a right filter gives as much or more; a verdict over several tests
compares the least of them with its level over their number (Bonferroni's bound), so that the stated
level is kept whatever their correlation.

========== ========================================================================
size       their sum of squares is larger than chi-squared
window     so in one of the windows of a few lengths
mean       they have a mean
colour     neighbours are correlated (a lag, a wrong rate)
drift      they grow along the recording
wild       single ones are far out
========== ========================================================================

Mehra and Peschon (1971), Automatica 7, 637-640; Bar-Shalom, Li and Kirubarajan (2001), section 5.4.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from estimators.information.consistency import above

__all__ = ["Finding", "findings", "least"]

WINDOWS = (5, 20, 80)
FEWEST = 8  # innovations that a test takes


@dataclass(frozen=True)
class Finding:
    """What a test says of one sensor.

    Args:
        sensor: its name.
        test: of the table of the module.
        chance: probability that a right filter gives as much, times the tests it is one of.
        value: what was found: a ratio of standard deviations for ``size`` and ``window``, sigmas
            for ``mean`` and ``wild``, a correlation, sigmas from beginning to end for ``drift``.
        at: position of the window's last innovation, or of the wild one; -1 for all.
    """

    sensor: str
    test: str
    chance: float
    value: float
    at: int = -1


def _two_sided(z: float) -> float:
    return float(2 * ndtr(-abs(z)))


def _moving(q: np.ndarray, n: int) -> np.ndarray:
    c = np.concatenate([[0.0], np.cumsum(q)])
    return np.asarray(c[n:] - c[:-n])


def findings(
    z: Mapping[str, np.ndarray],
    *,
    margin: float = 1.0,
    offset: float = 0.0,
    windows: Sequence[int] = WINDOWS,
) -> list[Finding]:
    """Test every sensor's normalised innovations; sensors with fewer than ``FEWEST`` are left out.

    Args:
        z: by sensor, (K,), NaN where nothing was measured.
        margin: factor on the variance for what a model does not hold.
        offset: constant offset that is allowed for, sigmas.
        windows: lengths, samples.
    """
    out = []
    for name, all_ in z.items():
        there = np.flatnonzero(np.isfinite(all_))
        v = all_[there] / math.sqrt(margin + offset**2)
        n = v.size
        if n < FEWEST:
            continue
        q, mean = v**2, float(all_[there].mean())
        out.append(Finding(name, "size", float(above(q.sum(), n)), math.sqrt(q.mean())))
        for w in (w for w in windows if w < n):
            s = _moving(q, w)
            k = int(s.argmax())
            found = float(above(s[k], w)) * n
            out.append(Finding(name, "window", found, math.sqrt(s[k] / w), int(there[k + w - 1])))
        k = int(q.argmax())
        out.append(Finding(name, "wild", float(above(q[k], 1)) * n, float(v[k]), int(there[k])))
        over = max(abs(mean) - offset, 0.0) * math.sqrt(n)
        out.append(Finding(name, "mean", _two_sided(over), mean))
        # of what is left of the mean and a straight line, each normal with variance 1/n
        tau = there - there.mean()
        tau = tau / math.sqrt(tau @ tau)
        rest = v - v.mean()
        slope = float(tau @ rest)
        out.append(Finding(name, "drift", _two_sided(slope), slope * float(np.ptp(tau))))
        rest = rest - slope * tau
        near = np.diff(there) == 1
        r = float((rest[1:] * rest[:-1])[near].sum() / max(rest @ rest, 1e-300))
        spread = math.sqrt(max(int(near.sum()), 1)) / n
        out.append(Finding(name, "colour", _two_sided((r + 1 / n) / max(spread, 1e-9)), r))
    return out


def least(found: Sequence[Finding], level: float) -> list[Finding]:
    """Return what has less chance than the level over the number of tests, one for each sensor."""
    limit = level / max(len(found), 1)
    out: dict[str, Finding] = {}
    for f in sorted(found, key=lambda f: f.chance):
        if f.chance < limit:
            out.setdefault(f.sensor, f)
    return list(out.values())
