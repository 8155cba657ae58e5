"""What a change in the gas path's readings is: of the gas path, of one sensor, of the shaft power.

The innovations of a filter that knows no change hold the signature of one
(:mod:`estimators.detection.signatures`); a jump of the four health factors, of one sensor's gain,
of the speed's sensor, of the shaft power's error, each with a prior of its size, is the more
probable the better its signature fits, its size and instant unknown: marginal likelihoods of
:meth:`~estimators.detection.glr.Glr.log_marginal`, averaged over the instants, times prior weights.
At the likeliest instant the filter runs again with what may have jumped, since a signature is
linear and large changes are not; and a sensor may as well be noise, of a size that is found, about
what the others predict, or off it by a line: stuck, drifting, or worse.  A change of health is as
often of a single factor as of all four.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from apu_casadi.core.backend import rarely
from apu_casadi.gaspath.health import HEALTH
from estimators.apu.electrical.causes import Causes, probabilities
from estimators.apu.gaspath import JUMP, GasPathFilter
from estimators.apu.gaspathmodel import LAGGING
from estimators.apu.healthjumps import Tracked
from estimators.apu.sensorfailures import failure
from estimators.apu.trust import GAS
from estimators.detection.glr import glr
from estimators.detection.signatures import Jump, linearised
from estimators.filters.belief import Belief
from estimators.filters.filtering import FilterResult
from estimators.information.posterior import named_posterior
from estimators.models.recording import Recording

__all__ = ["PRIOR", "SEVERAL", "causes_of_alarms", "jumps_of"]

BACK, ON = 40, 50  # samples before and after an alarm that are looked at
BEFORE = 10  # samples before the onset that the alarm found, which may be long before it
SIZE = 0.05  # standard deviation of a jump of a sensor's gain, of the reading
WIDE = 1e8  # factor on the variance of a reading that says nothing
FEWEST = 4  # readings from which a sensor's noise is told
N_SIZE = 0.02  # the same of the speed's sensor
ALL = 0.5  # probability that a change of health is one of all factors, not of a single one
SEVERAL = "several factors"
#: Prior weights by kind; sensors share theirs.
PRIOR = {"none": 1.0, "gas path": 1.0, "sensor": 0.3, "shaft power": 0.3}


def jumps_of(filt: GasPathFilter) -> tuple[list[Jump], dict[str, tuple[list[str], list[float]]]]:
    """Return jumps that may be, and by hypothesis the names and standard deviations of its own."""
    jumps = [Jump("state", n) for n in HEALTH]
    of = {GAS: (list(HEALTH), [JUMP] * len(HEALTH))}
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
        weighed, factors = _weighed(filt, data, (onset, k), tracked.prior, how)
        best = max(weighed, key=lambda n: weighed[n])
        failed = _failed(filt, data, onset, best, tracked, how)
        out.append(Causes(float(data.t[k]), weighed, {GAS: factors} | failed))
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
    filt: GasPathFilter,
    data: Recording,
    about: tuple[int, int],
    prior: Belief | None,
    backend: str | None,
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the probabilities of what a change of some onset and some alarm is.

    And those of which factor it is, if it is one of the gas path: one of the four, or several.
    """
    jumps, of = jumps_of(filt)
    r = filt.run(data, prior=prior, backend=backend)
    g = glr(linearised(filt.model, r, data, jumps, backend=backend), onsets := _onsets(*about))
    by_signature: list[tuple[str, _Supposed, float, float]] = []
    for name, (parts, size) in [*of.items(), *((n, ([n], [JUMP])) for n in HEALTH)]:
        v = g.log_marginal(parts, np.zeros(len(parts)), np.diag(np.square(size)))
        top = int(v.argmax())
        states = set(parts) <= set(filt.model.x.names) and not set(parts) & set(filt.model.consider)
        opened = (tuple(parts), tuple(size)) if states else None
        sensor = name.removeprefix("sensor ")
        at = _Supposed(int(onsets[top]), opened, sensor if sensor in filt.model.y else "")
        by_signature.append((name, at, float(v[top]), math.log(np.mean(np.exp(v - v[top])))))
    after = _After.of(filt, data, r, [at for _, at, _, _ in by_signature], backend)
    likely = {n: after.likely(at, best) + spread for n, at, best, spread in by_signature}
    each = {n: likely.pop(n) + math.log((1 - ALL) / len(HEALTH)) for n in HEALTH}
    found = {"none": 0.0} | likely
    each |= {SEVERAL: found[GAS] + math.log(ALL)}
    found[GAS] = float(np.logaddexp.reduce([*each.values()]))
    return probabilities(found, PRIOR), named_posterior(each)


def _onsets(onset: int, k: int) -> np.ndarray:
    return np.arange(max(min(k - BACK, onset - BEFORE), 1), k + 1)


class _Supposed(NamedTuple):
    """A hypothesis as the filter takes it.

    Args:
        onset: the sample from which on it holds.
        opened: states that may have jumped, and by how much; None where they are none.
        sensor: which may be off what the others predict; "" for none.
    """

    onset: int
    opened: tuple[tuple[str, ...], tuple[float, ...]] | None
    sensor: str

    @property
    def runs(self) -> Iterator[_Supposed]:
        """What the filter is run with: nothing, opened states, the sensor."""
        if self.opened or self.sensor:
            yield _Supposed(self.onset, None, "")
        if self.opened:
            yield _Supposed(self.onset, self.opened, "")
        if self.sensor:
            yield _Supposed(self.onset, None, self.sensor)


@dataclass(frozen=True, eq=False)
class _After:
    """The filter from onsets on, as it would run if a change were known to have come then.

    A signature is linear about estimates that a change has spoilt: one of P3 by 4 % is 20 of its
    standard deviations, and what the linear terms lack would be told as a change of health.
    """

    filt: GasPathFilter
    data: Recording
    results: Mapping[_Supposed, FilterResult]

    @classmethod
    def of(
        cls,
        filt: GasPathFilter,
        data: Recording,
        r: FilterResult,
        supposed: Sequence[_Supposed],
        backend: str | None,
    ) -> _After:
        """Run the filter for all hypotheses together, from what ``r`` knew before their onsets."""
        assert r.mean_pred is not None and r.cov_pred is not None
        runs = [*dict.fromkeys(run for at in supposed for run in at.runs)]
        priors, parts = [], []
        for onset, opened, sensor in runs:
            cov = r.cov_pred[onset].copy()
            if opened:
                at = r.x.indices(opened[0])
                cov[at, at] += np.square(opened[1])
            priors.append(Belief(r.x, r.mean_pred[:, onset], cov))
            of = _blinded(data, filt.model.y.index(sensor), onset) if sensor else data
            parts.append(of.part(onset, data.size))
        results = filt.run_each(priors, parts, backend=backend)
        return cls(filt, data, dict(zip(runs, results, strict=True)))

    def likely(self, at: _Supposed, best: float) -> float:
        """Log-likelihood gained by a hypothesis; ``best``: the same by its signature alone."""
        if at.opened:
            best = self._gained(self.results[_Supposed(at.onset, at.opened, "")].loglik, at.onset)
        if at.sensor:
            best = float(np.logaddexp(best, self._blind(at.onset, at.sensor))) - math.log(2.0)
        return best

    def _gained(self, loglik: float, onset: int) -> float:
        return float(loglik - self.results[_Supposed(onset, None, "")].loglik)

    def _blind(self, onset: int, sensor: str) -> float:
        """The same if a sensor is off what the others predict: noise of any size, bias, drift."""
        row = self.filt.model.y.index(sensor)
        variance = self.data.variance[row, onset:]
        r = self.results[_Supposed(onset, None, sensor)]
        there = np.isfinite(r.innovation[row])
        nu, S = r.innovation[row, there], r.innovation_variance[row, there]
        if nu.size < FEWEST:
            return -math.inf
        own = -0.5 * float((nu**2 / S + np.log(2 * math.pi * S)).sum())
        # its noise is found: half the logarithm of the number of readings for that
        white = max(float(np.mean(nu**2)), float(np.min(variance)))
        instead = -0.5 * nu.size * (1 + math.log(2 * math.pi * white)) - 0.5 * math.log(nu.size)
        # its own noise again, and a line through what it is off
        s = np.sqrt(S - (variance * WIDE - variance)[there])
        line = np.column_stack([np.ones(nu.size), np.arange(nu.size)]) / s[:, None]
        rest = nu / s - line @ np.linalg.lstsq(line, nu / s, rcond=None)[0]
        drift = -0.5 * float(rest @ rest + np.log(2 * math.pi * s**2).sum()) - math.log(nu.size)
        instead = float(np.logaddexp(instead, drift)) - math.log(2.0)
        return self._gained(float(r.loglik - own + instead), onset)
