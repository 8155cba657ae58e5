"""What a change in the gas path's readings is: of the gas path, of one sensor, of the shaft power.

The innovations of a filter that knows no change hold the signature of one
(:mod:`estimators.detection.signatures`); a jump of the four health factors, of one sensor's gain,
of the speed's sensor, of the shaft power's error, each with a prior of its size, is the more
probable the better its signature fits, its size and instant unknown: marginal likelihoods of
:meth:`~estimators.detection.glr.Glr.log_marginal`, averaged over the instants, times prior weights.
"""

from __future__ import annotations

import math
from dataclasses import replace

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
from estimators.models.recording import Recording

__all__ = ["PRIOR", "causes_of_alarms", "jumps_of"]

BACK, ON = 40, 50  # samples before and after an alarm that are looked at
SIZE = 0.05  # standard deviation of a jump of a sensor's gain, of the reading
WIDE = 1e8  # factor on the variance of a reading that says nothing
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
    blind = data.variance.copy()
    blind[row, late] *= WIDE
    r = filt.run(replace(data, variance=blind), prior=tracked.prior, backend=backend)
    own = np.sqrt(data.variance[row, late])
    found = failure(data.t[late], data.y[row, late], r.innovation[row, late], own)
    return {what: found} if found else {}


def _part(data: Recording, stop: int) -> Recording:
    return data.part(0, stop) if stop < data.size else data


def _weighed(
    filt: GasPathFilter, data: Recording, k: int, prior: Belief | None, backend: str | None
) -> dict[str, float]:
    jumps, of = jumps_of(filt)
    r = filt.run(data, prior=prior, backend=backend)
    f = linearised(filt.model, r, data, jumps, backend=backend)
    g = glr(f, np.arange(max(k - BACK, 1), k + 1))
    found = {"none": 0.0}
    for name, (parts, size) in of.items():
        v = g.log_marginal(parts, np.zeros(len(parts)), np.diag(np.square(size)))
        found[name] = float(v.max() + math.log(np.mean(np.exp(v - v.max()))))
    return probabilities(found, PRIOR)
