"""Runs of the pipeline for rates of alarms: statistics over time, and what the answer is.

A unit runs at a steady load; at ``ONSET`` something fails.  The run is measured and estimated as a
user does it.  Two statistics are followed: that of the test for jumps of the gas path's health
(:class:`~estimators.apu.healthjumps.JumpTest`) and that of the severities, the largest (h/sigma)^2
of the three phases, or that of a rise (:mod:`~estimators.apu.electrical.smallchanges`).  Their
thresholds are set afterwards, for any rate of false alarms.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from apu_casadi.core.sharing import last
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.park import PHASES
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import FaultChange, HealthChange
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu.electrical.smallchanges import PAIRS, change_statistic
from estimators.apu.measuring import measure_run
from estimators.apu.recorded_estimate import JUMPS, ROBUST, RecordedEstimate, estimate
from estimators.apu.recordings.measured import read_recording
from estimators.apu.sensors import ELECTRICAL, GAS_PATH

__all__ = ["CLASSES", "KINDS", "Tail", "flown", "statistics"]

DURATION, ONSET, SETTLED = 1.8, 0.8, 0.6  # s; of a run, of its fault, from which it is judged
LOAD = 100e3  # W, of each generator
MU = 0.05
SHARES = (0.005, 0.01, 0.02, 0.04)
#: Faults by kind, with sizes: shares of health and readings, severities, A.
KINDS: dict[str, tuple[float, ...]] = {n: SHARES[1:] for n in HEALTH}
KINDS |= {"short circuit": (1e-4, 3e-4, 1e-3)}
KINDS |= {"sensor T5": SHARES[1:], "sensor P3": SHARES[1:], "sensor i_a": (3.0, 10.0, 30.0)}
CLASSES = ("nothing", "gas path", "short circuit", "sensor", "another")


@last(4)
def _truth(kind: str, size: float, phase: str) -> Any:
    events: list[Any] = []
    if kind in HEALTH:
        events = [HealthChange(ONSET, {kind: 1 - size})]
    elif kind == "short circuit":
        events = [FaultChange(ONSET, Ttsc(MU, MU / size - 1 + MU, phase=phase))]
    fine: dict[str, Any] = {"dt": 0.005, "exchange": "corrected", "waveform_dt": 1e-4}
    load = SeriesLoad.from_power(LOAD)
    return simulate_joint(
        Apu(), duration=DURATION, load=load, events=events, warn_exchange=False, **fine
    )


def statistics(e: RecordedEstimate) -> tuple[np.ndarray, np.ndarray]:
    """Return the two statistics on the instants of an estimate, (2, K), 0 where there is none."""
    assert e.path is not None
    filt, tracked = e.path
    u = tracked.data.u.copy()
    u[filt.model.u.index("jump")] = 0.0
    r = filt.run(replace(tracked.data, u=u), prior=tracked.prior, step=ROBUST)
    gas = JUMPS.statistic(r, JUMPS.hold)
    electrical = np.zeros(gas.size)
    for side in e.sides.values():
        h, s = side.severities
        z = np.max(np.maximum(h, 0.0) / s, axis=0) ** 2
        at = np.clip(np.searchsorted(side.t, r.t + 1e-9) - 1, 0, side.t.size - 1)
        electrical = np.maximum(electrical, z[at])
        if side.beliefs is not None:
            rises = [change_statistic(side.beliefs, *pair).max(0) for pair in PAIRS]
            rose = np.append(0.0, np.maximum(np.max(rises, axis=0), 0.0)) ** 2
            electrical = np.maximum(electrical, rose[at])
    return r.t, np.array([gas, electrical])


def flown(kind: str, size: float, seed: int) -> dict[str, Any]:
    """Simulate, measure, estimate one run; ``kind`` ``""``: nothing fails.

    Returns:
        ``t`` from the onset on and ``gas``, ``electrical``: the largest statistics up to then, of a
        healthy run the largest alone; ``said``: the class of the answer; ``exact``: whether sensor
        and phase are right, too; ``lost``: s after the onset at which the electrical filter gave
        up, None where it did not.
    """
    phase = PHASES[seed % 3]
    true = kind if kind in HEALTH or kind == "short circuit" else ""
    ds = _truth(true, size if true else 0.0, phase if true == "short circuit" else "a")
    made = measure_run(ds, Apu(), seed)
    sensor = kind.removeprefix("sensor ")
    if sensor != kind:
        of = made["gaspath" if sensor in GAS_PATH else "electrical"]
        late = of["time"].values >= ONSET - 1e-9
        v = of[sensor].values
        of[sensor].values[:] = v + late * (size if sensor in ELECTRICAL else size * v)
    e = estimate(read_recording(*(d.drop_vars("PW", errors="ignore") for d in made.values())))
    t, z = statistics(e)
    answer = next((d for d in e.diagnoses if kind == "" or d.t >= ONSET - 0.05), None)
    best = "nothing" if answer is None else answer.best
    out: dict[str, Any] = {"said": _class(best)}
    wanted = {"": "nothing", "short circuit": f"short circuit {phase}"}
    right = wanted.get(kind, "gas path" if kind in HEALTH else kind)
    out["exact"] = best.rpartition(": ")[2] == right
    lost = not e.sides and answer is not None
    out["lost"] = answer.t - ONSET if lost and answer is not None else None
    on = t >= (SETTLED if not kind else ONSET) - 1e-9
    most = np.maximum.accumulate(z[:, on], axis=1)
    if not kind:
        return out | {"gas": float(most[0, -1]), "electrical": float(most[1, -1])}
    out |= {"t": (t[on] - ONSET).tolist()}
    return out | {"gas": most[0].tolist(), "electrical": most[1].tolist()}


def _class(name: str) -> str:
    """Return the class of an answer."""
    what = name.rpartition(": ")[2]
    known = {"shaft power": "another", "voltage sensors": "sensor"}
    return known.get(what, next((c for c in CLASSES if what.startswith(c)), "another"))


@dataclass(frozen=True)
class Tail:
    """An exponential tail of a statistic's maxima in healthy runs (peaks over a threshold).

    The excess over a high level is taken for exponential: for chi-squared statistics it is in the
    limit, with a mean of 2 (Pickands 1975, Annals of Statistics 3, 119, with shape zero).

    Args:
        level: the upper quartile of the maxima.
        mean: excess over it, in the mean; two at least.
        rate: of its exceedances, 1/h.
        seen: the largest maximum.
        hours: that were seen.
    """

    level: float
    mean: float
    rate: float
    seen: float
    hours: float

    @classmethod
    def of(cls, maxima: Sequence[float], seconds: float) -> Tail:
        """Fit to the maxima of runs of so many seconds each."""
        x = np.asarray(maxima, float)
        level, hours = float(np.quantile(x, 0.75)), x.size * seconds / 3600
        over = x[x > level] - level
        mean = max(float(over.mean()) if over.size else 2.0, 2.0)
        return cls(level, mean, max(over.size, 1) / hours, float(x.max()), hours)

    def threshold(self, rate: float) -> float:
        """Threshold that is passed so often in an hour."""
        return self.level + self.mean * math.log(self.rate / rate)

    def decades(self, rate: float) -> float:
        """Return how far beyond what was seen a rate is, in powers of ten."""
        return math.log10(1 / self.hours / rate)
