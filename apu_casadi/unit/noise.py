"""Uncertainty of a joint run: state noise, voltage noise, and what sensors add."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from apu_casadi.core.checked import number
from apu_casadi.core.errors import SignalError, nearest
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.machine.measurement import MeasurementNoise


@dataclass(frozen=True)
class Noise:
    """Uncertainty added to a run; everything zero by default.

    Args:
        N: standard deviation of the state noise added to rotor speed at each exchange step, rad/s.
        w1, w2: standard deviations, V, of the voltage noise in (5) and (6), drawn for each exchange
            step and held over it.
        gas: standard deviation of the measurement noise by output name, SI (``{"T3": 1.0}``); a
            measured copy ``T3_meas`` appears for each.
        terminal: measurement noise of (10) on phase currents, voltages and field voltage; adds
            ``v_a_meas`` and so on to the waveforms.
    """

    N: float = 0.0
    w1: float = 0.0
    w2: float = 0.0
    gas: Mapping[str, float] = field(default_factory=dict)
    terminal: MeasurementNoise | None = None

    def __post_init__(self) -> None:
        """Check that every standard deviation is a finite number >= 0 of a known signal."""
        for name in self.gas:
            if name not in GasGenerator.Y:
                known = GasGenerator.Y.names
                raise SignalError(f"Noise.gas: unknown {name!r} {nearest(name, known)}")
        for name, s in {"N": self.N, "w1": self.w1, "w2": self.w2, **self.gas}.items():
            if not 0 <= number(f"Noise.{name}", s) < math.inf:
                raise SignalError(f"Noise.{name} must be a standard deviation >= 0, got {s!r}")
