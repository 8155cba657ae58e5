"""What is to be told apart, and from what: classes of faults, the protocol of a window."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from apu_casadi.core.errors import ParameterError
from apu_casadi.core.sharing import once
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.unit.apu import Apu
from estimators.apu.sensors import GAS_PATH, SensorSet

__all__ = ["CLASSES", "DEFAULT", "FAULTS", "SNAPSHOT", "Hypothesis", "Protocol", "severity_of_loss"]

DT = 0.02  # s
GAINS = (*GAS_PATH.uncertain, "PW")
OUTPUTS = (*GAS_PATH.outputs, "h")
READ = tuple(n for n in GAS_PATH.outputs if n in GAINS)  # sensors of which a fault is told
FAULTS = (*HEALTH, *(f"gain_{n}" for n in READ), "loss")
"""Directions in which something may jump; ``loss`` is shaft power lost in the generators, over the
design power."""

P_RATED = 500e3  # W; shaft power to which a TTSC's loss is referred
LOSS, EITHER = (-0.04, -0.01), ((-0.04, -0.01), (0.01, 0.04))
GAIN = (0.01, 0.04)


@dataclass(frozen=True)
class Hypothesis:
    """One class.

    Args:
        name: in words.
        faults: what jumps, of :data:`FAULTS`; none for the healthy class.
        ranges: for each of them the intervals over which its size is uniform.
    """

    name: str
    faults: tuple[str, ...] = ()
    ranges: tuple[tuple[tuple[float, float], ...], ...] = ()

    @property
    def boxes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Lower and upper corners of all combinations of intervals."""
        boxes: list[tuple[tuple[float, ...], tuple[float, ...]]] = [((), ())]
        for intervals in self.ranges:
            boxes = [((*lo, a), (*hi, b)) for lo, hi in boxes for a, b in intervals]
        return [(np.array(lo), np.array(hi)) for lo, hi in boxes]

    def normal(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance of a normal distribution of sizes that covers the ranges."""
        mean = [float(np.mean(r)) for r in self.ranges]
        # sqrt(3) wider than the uniform one: the filter's start, divided out again afterwards
        var = [
            3 * float(np.mean([(a * a + a * b + b * b) / 3 for a, b in r])) - 3 * m * m
            for r, m in zip(self.ranges, mean, strict=True)
        ]
        return np.array(mean), np.array(var)

    def draw(self, rng: np.random.Generator) -> dict[str, float]:
        """Draw sizes by fault name; each interval is equally likely."""
        sizes = {}
        for name, intervals in zip(self.faults, self.ranges, strict=True):
            a, b = intervals[int(rng.integers(len(intervals)))]
            sizes[name] = float(rng.uniform(a, b))
        return sizes


CLASSES = (
    Hypothesis("healthy"),
    Hypothesis("compressor efficiency", ("f_eta_c",), ((LOSS,),)),
    Hypothesis("compressor flow", ("f_W_c",), ((LOSS,),)),
    Hypothesis("turbine efficiency", ("f_eta_t",), ((LOSS,),)),
    Hypothesis("turbine flow", ("f_W_t",), (EITHER,)),
    Hypothesis("compressor pair", ("f_eta_c", "f_W_c"), ((LOSS,), (LOSS,))),
    Hypothesis("turbine pair", ("f_eta_t", "f_W_t"), ((LOSS,), EITHER)),
    Hypothesis("TTSC", ("loss",), ((GAIN,),)),
    *(Hypothesis(f"{n} sensor", (f"gain_{n}",), (EITHER,)) for n in READ),
)
"""The classes, equally likely a priori.  Efficiencies and compressor flow fall; turbine flow moves
either way (fouling, erosion); a sensor errs either way."""


@dataclass(frozen=True)
class Protocol:
    """What a window holds, and what is known beforehand.

    Args:
        before: time before the earliest onset, s: from it the healthy unit is learnt.  0 (then with
            ``spread`` 0): the fault is there from the beginning.
        after: time after the latest onset, s.
        spread: what a detector leaves open of the onset, s; uniform.
        every: samples between the onsets that are tried.
        sensors: noise and gain errors.
        noise: all white noise is multiplied by this.
        wear: standard deviation of each health factor before the fault.
        baseline: factor on what is uncertain of the healthy unit: wear, gain errors, offset of h.
            Matters most without a time before the fault: it is then all that is known of the unit.
        h_noise, h_offset: standard deviations of the severity's white error in 20 ms, and of its
            constant offset from sensor gains and load unbalance.
        electrical: whether the severity is measured at all.
        N_walk: process noise of the speed in the classifiers, rad/s/sqrt(s).
    """

    before: float = 4.0
    after: float = 4.0
    spread: float = 1.0
    every: int = 5
    sensors: SensorSet = GAS_PATH
    noise: float = 1.0
    wear: float = 0.01
    baseline: float = 1.0
    h_noise: float = 1e-5
    h_offset: float = 3e-4
    electrical: bool = True
    N_walk: float = 1.0

    def __post_init__(self) -> None:
        for name in ("after", "noise", "baseline", "h_noise"):
            if not getattr(self, name) > 0:
                raise ParameterError(f"Protocol.{name} must be > 0, got {getattr(self, name)!r}")
        for name in ("before", "spread"):
            if not getattr(self, name) >= 0:
                raise ParameterError(f"Protocol.{name} must be >= 0, got {getattr(self, name)!r}")
        if self.every < 1:
            raise ParameterError(f"Protocol.every must be >= 1 sample, got {self.every!r}")

    @property
    def first(self) -> int:
        """Earliest sample of an onset."""
        return round(self.before / DT)

    @property
    def last(self) -> int:
        """Latest sample of an onset."""
        return self.first + round(self.spread / DT)

    @property
    def size(self) -> int:
        """Samples in a window."""
        return self.last + round(self.after / DT)

    @property
    def onsets(self) -> np.ndarray:
        """Samples at which the classifiers suppose an onset."""
        return np.arange(self.first, self.last + 1, self.every)

    def describe(self) -> dict[str, Any]:
        """Return the numbers, for JSON."""
        return {
            f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "sensors"
        } | {"noise_table": {s.name: s.noise * self.noise for s in self.sensors.sensors}}


DEFAULT = Protocol()
"""A fault that begins while the unit is watched.  Chosen on seeds 1 to 99, before any result on
later ones was seen."""

SNAPSHOT = Protocol(before=0.0, spread=0.0)
"""A fault that is there from the beginning: a unit of which no history is known."""


@once
def severity_of_loss() -> float:
    """Severity h of a TTSC whose loss, in both generators over their efficiency, is ``P_RATED``.

    The fault is a shunt r_s/h from terminal to neutral (kappa = mu), so it takes h V^2/r_s; eq. (8)
    counts it twice, over the efficiency.
    """
    apu = Apu()
    machine = apu.generator.machine
    eta = machine.eta_sg * apu.coupling.eta_gtSg
    return float(P_RATED * eta / (2 * machine.V_rated_rms**2 / machine.r_s))
