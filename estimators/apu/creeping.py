"""Sensors that drift along a recording, or are off all along by more than was stated of them.

Each leaves its own signature in the innovations of all sensors, and an error in each state: both
are known to first order (:meth:`estimators.detection.signatures.LinearFilter.ramps`).  A drift that
is significant is a doubt (:mod:`.believable`), and so is an error that is more probable than none;
one that is not may still move an estimate by several of its standard deviations: in a second of
recording by 3 where the shaft power gains 10 %, and by 4 where T5 reads 5 % too much, which no
innovation shows, as four health factors follow any such reading.  That they would have to go 2
standard deviations of their own prior for it is the evidence.  A day that is warmer than was given
is such an error as well.  So the band holds each as far as it is probable: with a prior probability
and a size d of zero mean,

    variance + sum_i p_i (d_i^2 + s_i^2) (dx/dd_i)^2,

where d_i, s_i are its posterior mean and standard deviation and p_i its probability.  Where nothing
is off p_i is some 0.005, and the band as it was to a few per cent at most.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

from apu_casadi.core.errors import EstimationError
from apu_casadi.gaspath.health import HEALTH
from estimators.apu.gascauses import SIZE, jumps_of
from estimators.apu.gaspath import MODEL_ERROR, GasPathFilter
from estimators.apu.healthjumps import Tracked, judged
from estimators.apu.trust import GAS
from estimators.detection.signatures import LinearFilter, linearised
from estimators.filters.filtering import FilterResult, StepMaker
from estimators.information.posterior import posterior

__all__ = ["Creep", "creep", "quiet_of"]

#: Probability that a sensor drifts along a recording, and that it is off from the first sample on.
PRIOR = 0.01
#: The same of the day's temperature, K, and the standard deviation of what it is off by then.
TEMPERATURE, KELVIN = "dT_isa", 5.0
SETTLED = 0.1  # s after a report, in which its innovations are explained
FEWEST = 8  # samples in which one is looked for
_JUMPS = ("state", "drift", "output")


@dataclass(frozen=True, eq=False)
class Creep:
    """The n errors that may be.

    Args:
        names: of their sensors, ``"shaft power"`` among them.
        lasting: whether it is there all along; the others are drifts, (n,).
        size, sigma: likeliest one, of a drift to the end of the recording, relative, and its
            standard deviation, (n,).
        scale: prior standard deviation of the size, (n,).
        error: of the states by one of 1, (K, nx, n).
    """

    names: tuple[str, ...]
    lasting: np.ndarray
    size: np.ndarray
    sigma: np.ndarray
    scale: np.ndarray
    error: np.ndarray

    @property
    def probability(self) -> np.ndarray:
        """That each is the one that is there, (n,)."""
        v, t2 = self.sigma**2, self.scale**2
        # v is infinite of a sensor that is not there
        odds = -0.5 * np.log1p(t2 / v) + self.size**2 / v * t2 / (v + t2) / 2
        p: np.ndarray = posterior(np.append(0.0, math.log(PRIOR) + odds)[:, None])[1:, 0]
        return p

    def widened(self, r: FilterResult, *, drifts: bool = True) -> FilterResult:
        """Return the result with what such errors may have moved in its variances.

        Args:
            r: that they are of.
            drifts: whether these count as well.  Two sensors tell the speed where generators were
                measured, and one that drifts then would take the speed along.
        """
        v, t2 = self.sigma**2, self.scale**2
        share = t2 / (v + t2)
        weight = (
            (self.lasting | drifts)
            * self.probability
            * ((share * self.size) ** 2 + 1 / (1 / v + 1 / t2))
        )
        return dataclasses.replace(r, variance=r.variance + (self.error**2 @ weight).T)


def quiet_of(tracked: Tracked) -> np.ndarray:
    """Samples that no report of a change explains, (K,)."""
    t = tracked.result.t
    quiet = np.ones(t.size, bool)
    for i, k in zip(tracked.onsets, tracked.alarms, strict=True):
        quiet &= (t <= t[i] + 1e-9) | (t > t[k] + SETTLED)
    return quiet


def creep(
    filt: GasPathFilter,
    tracked: Tracked,
    *,
    step: StepMaker | None = None,
    backend: str | None = None,
) -> Creep | None:
    """Look for such errors along a recording; None in one of too few samples.

    Args:
        filt, tracked: the filter and what it said.
        step: with which it did, as in :meth:`GasPathFilter.run`.
        backend: see :func:`apu_casadi.core.backend.compiled`.
    """
    r, quiet = tracked.result, quiet_of(tracked)
    if quiet.sum() < FEWEST:
        return None
    jumps, of = jumps_of(filt)
    own = {n: how for n, how in of.items() if n != GAS}
    # of one without a stated error, which counts pulses, there is nothing to be beyond
    off = {n: how for n, how in own.items() if how[0][0] in filt.model.x}
    jumps = [j for j in jumps if j.name not in HEALTH]
    judge, seen = judged(filt, tracked)
    f = linearised(judge.model, seen.result, tracked.data, jumps)
    at, at_off = (f.columns([of[0] for of, _ in some.values()]) for some in (own, off))
    both, columns = _beside(f.ramps(r.t), f), [*at, *(len(f.names) + c for c in at_off)]
    nu, moved = _warmer(judge, seen, step, backend)
    g = np.concatenate([both.signature(0)[:, :, columns], nu], axis=2)
    size, sigma = both.evidence(quiet, g)
    if judge is not filt:  # the states are those of the filter itself
        f = linearised(filt.model, r, tracked.data, jumps)
        both, (_, moved) = _beside(f.ramps(r.t), f), _warmer(filt, tracked, step, backend)
    error = np.concatenate([both.errors()[:, :, columns], moved], axis=2)
    names = (*(n.removeprefix("sensor ") for n in (*own, *off)), TEMPERATURE)
    scale = np.array([s[0] for some in (own, off) for _, s in some.values()] + [KELVIN])
    # in ten minutes one by what the model is off is significant, and says nothing
    sigma = np.hypot(sigma, MODEL_ERROR / SIZE * scale)
    lasting = np.arange(len(names)) >= len(own)
    return Creep(names, lasting, size, sigma, scale, error)


def _warmer(
    filt: GasPathFilter, tracked: Tracked, step: StepMaker | None, backend: str | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return what a day that is 1 K warmer than given adds to innovations and states.

    By the filter itself on such a day; shapes (K, ny, 1) and (K, nx, 1), 0 where it is lost.
    """
    r, data = tracked.result, tracked.data
    u = data.u.copy()
    u[filt.model.u.index(TEMPERATURE)] += 1.0
    day = dataclasses.replace(data, u=u)
    try:
        other = filt.run(day, prior=tracked.prior, step=step, backend=backend)
    except EstimationError:  # data that are too odd for it: they tell nothing of the day
        other = r
    nu = np.nan_to_num(r.innovation - other.innovation)
    return nu.T[:, :, None], (other.mean - r.mean).T[:, :, None]


def _beside(a: LinearFilter, b: LinearFilter) -> LinearFilter:
    """Return a filter with the jumps of two, which is the same one besides."""
    both = (np.concatenate([getattr(a, n), getattr(b, n)], axis=-1) for n in _JUMPS)
    names = (*(f"{n} to the end" for n in a.names), *b.names)
    return dataclasses.replace(b, names=names, **dict(zip(_JUMPS, both, strict=True)))
