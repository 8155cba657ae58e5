"""Sensors that drift against all others along a recording, and what that does to the estimates.

A drift of one sensor leaves its own signature in the innovations of all, and an error in each
state: both are known to first order (:meth:`estimators.detection.signatures.LinearFilter.ramps`).
One that is significant is a doubt (:mod:`.believable`); one that is not may still move an estimate
by several of its standard deviations, in a second of recording by 3 where the shaft power gains
10 %.  So the band holds it as far as it is probable: with a prior probability ``DRIFTS`` for each
sensor and a size d of standard deviation ``SIZE``,

    variance + sum_i p_i (d_i^2 + s_i^2) (dx/dd_i)^2,

where d_i, s_i are the drift's posterior mean and standard deviation and p_i its probability.  Where
nothing drifts p_i is some 0.005, and the band as it was to a few per cent at most.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from apu_casadi.gaspath.health import HEALTH
from estimators.apu.gascauses import SIZE, jumps_of
from estimators.apu.gaspath import MODEL_ERROR, GasPathFilter
from estimators.apu.healthjumps import Tracked
from estimators.apu.trust import GAS
from estimators.detection.signatures import linearised
from estimators.filters.filtering import FilterResult
from estimators.information.posterior import posterior

__all__ = ["Creep", "creep", "quiet_of"]

DRIFTS = 0.01  # probability that a sensor drifts along a recording
SETTLED = 0.1  # s after a report, in which its innovations are explained
FEWEST = 8  # samples in which a drift is looked for


@dataclass(frozen=True, eq=False)
class Creep:
    """The drifts that may be, by sensor.

    Args:
        names: of the sensors, ``"shaft power"`` among them; n of them.
        size, sigma: likeliest drift to the end of the recording, relative, and its standard
            deviation, (n,).
        error: of the states by a drift of 1, (K, nx, n).
    """

    names: tuple[str, ...]
    size: np.ndarray
    sigma: np.ndarray
    error: np.ndarray

    @property
    def probability(self) -> np.ndarray:
        """That each is the one that drifts, (n,)."""
        v, t2 = self.sigma**2, SIZE**2
        # v is infinite of a sensor that is not there
        odds = -0.5 * np.log1p(t2 / v) + self.size**2 / v * t2 / (v + t2) / 2
        p: np.ndarray = posterior(np.append(0.0, math.log(DRIFTS) + odds)[:, None])[1:, 0]
        return p

    def widened(self, r: FilterResult) -> FilterResult:
        """Return the result with what drifts may have moved in its variances."""
        v, t2 = self.sigma**2, SIZE**2
        share = t2 / (v + t2)
        weight = self.probability * ((share * self.size) ** 2 + 1 / (1 / v + 1 / t2))
        return dataclasses.replace(r, variance=r.variance + (self.error**2 @ weight).T)


def quiet_of(tracked: Tracked) -> np.ndarray:
    """Samples that no report of a change explains, (K,)."""
    t = tracked.result.t
    quiet = np.ones(t.size, bool)
    for i, k in zip(tracked.onsets, tracked.alarms, strict=True):
        quiet &= (t <= t[i] + 1e-9) | (t > t[k] + SETTLED)
    return quiet


def creep(filt: GasPathFilter, tracked: Tracked) -> Creep | None:
    """Look for drifts along a recording; None in one of too few samples."""
    r, quiet = tracked.result, quiet_of(tracked)
    if quiet.sum() < FEWEST:
        return None
    jumps, of = jumps_of(filt)
    own = {n: names for n, (names, _) in of.items() if n != GAS}
    f = linearised(filt.model, r, tracked.data, [j for j in jumps if j.name not in HEALTH])
    ramps = f.ramps(r.t)
    columns = [k for names in own.values() for k in f.columns(names)]
    size, sigma = ramps.evidence(quiet)
    # in ten minutes a drift by what the model is off is significant, and says nothing
    sigma = np.hypot(sigma, MODEL_ERROR)
    names = tuple(n.removeprefix("sensor ") for n in own)
    return Creep(names, size[columns], sigma[columns], ramps.errors()[:, :, columns])
