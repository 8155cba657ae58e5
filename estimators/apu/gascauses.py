"""What a change in the gas path's readings is: of the gas path, of one sensor, of the shaft power.

The innovations of a filter that knows no change hold the signature of one
(:mod:`estimators.detection.signatures`); a jump of the four health factors, of one sensor's gain,
of the speed's sensor, of the shaft power's error, each with a prior of its size, is the more
probable the better its signature fits, its size and instant unknown: marginal likelihoods of
:meth:`~estimators.detection.glr.Glr.log_marginal`, averaged over the instants, times prior weights.
At the likeliest instant the filter runs again with what may have jumped, since a signature is
linear and large changes are not; and a sensor may as well be noise, of a size that is found, about
what the others predict: stuck, drifting, or worse.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from apu_casadi.core.backend import rarely
from apu_casadi.gaspath.health import HEALTH
from estimators.apu.electrical.causes import Causes, probabilities
from estimators.apu.gaspath import JUMP, GasPathFilter
from estimators.apu.gaspathmodel import LAGGING
from estimators.apu.healthjumps import Tracked
from estimators.apu.sensorfailures import failure
from estimators.detection.glr import glr
from estimators.detection.signatures import Jump, linearised
from estimators.filters.belief import Belief
from estimators.filters.filtering import FilterResult
from estimators.models.recording import Recording

__all__ = ["PRIOR", "causes_of_alarms", "jumps_of"]

BACK, ON = 40, 50  # samples before and after an alarm that are looked at
SIZE = 0.05  # standard deviation of a jump of a sensor's gain, of the reading
WIDE = 1e8  # factor on the variance of a reading that says nothing
FEWEST = 4  # readings from which a sensor's noise is told
N_SIZE = 0.02  # the same of the speed's sensor
#: Prior weights by kind; sensors share theirs.
PRIOR = {"none": 1.0, "gas path": 1.0, "sensor": 0.3, "shaft power": 0.3}


def jumps_of(filt: GasPathFilter) -> tuple[list[Jump], dict[str, tuple[list[str], list[float]]]]:
    """Return jumps that may be, and by hypothesis the names and standard deviations of its own."""
    jumps = [Jump("state", n) for n in HEALTH]
    of = {"gas path": (list(HEALTH), [JUMP] * len(HEALTH))}
    for n in (n for n in filt.model.y.names if n not in LAGGING):
        if f"gain_{n}" in filt.model.x:
            jumps.append(Jump("state", f"gain_{n}"))
            of[f"sensor {n}"] = ([f"gain_{n}"], [SIZE])
        else:
            jumps.append(Jump("gain", n))
            of[f"sensor {n}"] = ([f"gain {n}"], [N_SIZE if n == "N" else SIZE])
    for n, name in (("gain_Wf", "sensor Wf"), ("gain_PW", "shaft power")):
        if n in filt.model.x:
            jumps.append(Jump("state", n))
            of[name] = ([n], [SIZE])
    return jumps, of


def causes_of_alarms(
    filt: GasPathFilter, tracked: Tracked, *, backend: str | None = None
) -> list[Causes]:
    """Tell of each reported change of health what it is.

    Args:
        filt, tracked: the filter and what it said.
        backend: see :func:`apu_casadi.core.backend.compiled`; by default as for what is done
            :func:`~apu_casadi.core.backend.rarely`.
    """
    out = []
    row = filt.model.u.index("jump")
    for k, onset in zip(tracked.alarms, tracked.onsets, strict=True):
        # as it was known without this change and later ones
        u = tracked.data.u.copy()
        u[row, onset:] = 0.0
        stop = min(k + ON, tracked.data.size)
        data = _part(replace(tracked.data, u=u), stop)
        how = backend or rarely("causes of an alarm")
        weighed = _weighed(filt, data, k, tracked.prior, how)
        failed = _failed(filt, data, onset, max(weighed, key=lambda n: weighed[n]), tracked, how)
        out.append(Causes(float(data.t[k]), weighed, failed))
    return out


def _failed(
    filt: GasPathFilter,
    data: Recording,
    onset: int,
    what: str,
    tracked: Tracked,
    backend: str | None,
) -> dict[str, dict[str, float]]:
    """How the sensor failed that is the most probable cause: by a filter that it tells nothing."""
    name = what.removeprefix("sensor ")
    if name == what or name not in filt.model.y:
        return {}
    row, late = filt.model.y.index(name), slice(onset + 1, data.size)
    blind = _blinded(data, row, onset + 1)
    r = filt.run(blind, prior=tracked.prior, backend=backend)
    own = np.sqrt(data.variance[row, late])
    found = failure(data.t[late], data.y[row, late], r.innovation[row, late], own)
    return {what: found} if found else {}


def _blinded(data: Recording, row: int, first: int) -> Recording:
    """Return the recording with an output that says nothing from a sample on."""
    variance = data.variance.copy()
    variance[row, first:] *= WIDE
    return replace(data, variance=variance)


def _part(data: Recording, stop: int) -> Recording:
    return data.part(0, stop) if stop < data.size else data


def _weighed(
    filt: GasPathFilter, data: Recording, k: int, prior: Belief | None, backend: str | None
) -> dict[str, float]:
    """Return the probabilities of what a change at about sample k is."""
    jumps, of = jumps_of(filt)
    r = filt.run(data, prior=prior, backend=backend)
    g = glr(linearised(filt.model, r, data, jumps, backend=backend), onsets := _onsets(k))
    after = _After(filt, data, r, backend)
    found = {"none": 0.0}
    for name, (parts, size) in of.items():
        v = g.log_marginal(parts, np.zeros(len(parts)), np.diag(np.square(size)))
        top = int(v.argmax())
        best, onset = float(v[top]), int(onsets[top])
        if set(parts) <= set(filt.model.x.names) and not set(parts) & set(filt.model.consider):
            best = after.opened(onset, parts, size)
        if (sensor := name.removeprefix("sensor ")) in filt.model.y:
            best = float(np.logaddexp(best, after.blind(onset, sensor))) - math.log(2.0)
        found[name] = best + math.log(np.mean(np.exp(v - v[top])))
    return probabilities(found, PRIOR)


def _onsets(k: int) -> np.ndarray:
    return np.arange(max(k - BACK, 1), k + 1)


@dataclass(frozen=True, eq=False)
class _After:
    """The filter from an onset on, as it would run if a change were known to have come then.

    A signature is linear about estimates that a change has spoilt: one of P3 by 4 % is 20 of its
    standard deviations, and what the linear terms lack would be told as a change of health.
    """

    filt: GasPathFilter
    data: Recording
    r: FilterResult
    backend: str | None
    unchanged: dict[int, float] = field(default_factory=dict)  # log-likelihoods by onset

    def opened(self, onset: int, names: Sequence[str], size: Sequence[float]) -> float:
        """Log-likelihood gained if states may have jumped by so much."""
        return self._loglik(onset, names, size) - self._without(onset)

    def blind(self, onset: int, sensor: str) -> float:
        """The same if a sensor is noise of any size about what the others predict."""
        row = self.filt.model.y.index(sensor)
        data = _blinded(self.data, row, onset)
        r = self._run(data, onset, self._before(onset))
        there = np.isfinite(r.innovation[row])
        nu, S = r.innovation[row, there], r.innovation_variance[row, there]
        if nu.size < FEWEST:
            return -math.inf
        own = -0.5 * float((nu**2 / S + np.log(2 * math.pi * S)).sum())
        # its noise is found: half the logarithm of the number of readings for that
        white = max(float(np.mean(nu**2)), float(np.min(self.data.variance[row, onset:])))
        instead = -0.5 * nu.size * (1 + math.log(2 * math.pi * white)) - 0.5 * math.log(nu.size)
        return float(r.loglik - own + instead) - self._without(onset)

    def _without(self, onset: int) -> float:
        if onset not in self.unchanged:
            self.unchanged[onset] = self._loglik(onset, (), ())
        return self.unchanged[onset]

    def _before(self, onset: int) -> Belief:
        assert self.r.mean_pred is not None and self.r.cov_pred is not None
        return Belief(self.r.x, self.r.mean_pred[:, onset], self.r.cov_pred[onset])

    def _run(self, data: Recording, onset: int, belief: Belief) -> FilterResult:
        part = data.part(onset, data.size)
        return self.filt.run(part, prior=belief, backend=self.backend)

    def _loglik(self, onset: int, names: Sequence[str], size: Sequence[float]) -> float:
        b = self._before(onset)
        cov, at = b.cov.copy(), b.x.indices(names)
        cov[at, at] += np.square(size)
        return float(self._run(self.data, onset, Belief(b.x, b.mean, cov)).loglik)
