"""What is measured, and how well: the 1-sigma tables of the estimation studies.

A table is data: take another one, or change single sensors, with :meth:`SensorSet.change`.

>>> round(GAS_PATH.sigma("P3", 800e3))
4000
>>> GAS_PATH.change(T5=0.004).sigma("T5", 1000.0)
4.0
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError, nearest

__all__ = ["ELECTRICAL", "GAS_PATH", "Sensor", "SensorSet"]


@dataclass(frozen=True)
class Sensor:
    """One sensor.

    Args:
        name: the signal that it measures.
        noise: standard deviation of its white noise, over the reading if ``relative``.
        relative: whether noise is a fraction of the reading.
        gain: standard deviation of its constant relative gain error, used where a study has one.
        unit: of the reading, SI.
        source: where the numbers come from.
    """

    name: str
    noise: float
    relative: bool
    gain: float
    unit: str
    source: str

    def __post_init__(self) -> None:
        """Refuse numbers that are no standard deviations."""
        for label in ("noise", "gain"):
            value = getattr(self, label)
            value = number(f"sensor {self.name}: {label}", value, error=ParameterError)
            if not (math.isfinite(value) and value >= 0):
                raise ParameterError(f"sensor {self.name}: {label} must be >= 0, got {value!r}")


@dataclass(frozen=True)
class SensorSet:
    """Sensors by name, in order."""

    sensors: tuple[Sensor, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The measured signals in order."""
        return tuple(s.name for s in self.sensors)

    def __getitem__(self, name: str) -> Sensor:
        """Return a sensor; ParameterError with the nearest name if there is none."""
        for s in self.sensors:
            if s.name == name:
                return s
        raise ParameterError(f"unknown sensor {name!r} {nearest(name, self.names)}")

    def sigma(self, name: str, reading: float) -> float:
        """Return the standard deviation of the noise at a reading, unit of the signal."""
        s = self[name]
        return s.noise * abs(reading) if s.relative else s.noise

    def change(self, **noise: float) -> SensorSet:
        """Return the set with other noise of some sensors.

        Raises:
            ParameterError: unknown sensor, or no standard deviation.
        """
        for name in noise:
            self[name]
        return SensorSet(
            tuple(
                dataclasses.replace(s, noise=noise[s.name], source="changed by the user")
                if s.name in noise
                else s
                for s in self.sensors
            )
        )

    def table(self) -> list[dict[str, Any]]:
        """Return one row for each sensor, for printing."""
        return [dataclasses.asdict(s) for s in self.sensors]


_SIMON = (
    "per cent of the reading as in Simon and Garg (2010), J. Eng. Gas Turbines Power 132, 031601"
)
_CLASS = "assumed: transducer of accuracy class 0.5, noise of a 12-bit converter"

#: Gas-path sensors, sampled every 20 ms.  PW is the shaft power that the electrical side delivers.
GAS_PATH = SensorSet(
    (
        Sensor("N", 0.0025, True, 0.0, "rad/s", _SIMON + "; a counted speed has no gain error"),
        Sensor("P3", 0.005, True, 0.005, "Pa", _SIMON),
        Sensor("T3", 0.0075, True, 0.005, "K", _SIMON),
        Sensor("T5", 0.0075, True, 0.005, "K", _SIMON),
        Sensor("Wf", 0.01, True, 0.01, "kg/s", "assumed: turbine flow meter, 1 %"),
        Sensor("PW", 0.01, True, 0.02, "W", "assumed where no electrical filter delivers it"),
    )
)

#: Electrical sensors, sampled at 10 kHz.
ELECTRICAL = SensorSet(
    (
        *(Sensor(f"v_{k}", 0.5, False, 0.005, "V", _CLASS) for k in "abc"),
        *(Sensor(f"i_{k}", 1.0, False, 0.005, "A", _CLASS) for k in "abc"),
        Sensor("V_fd", 0.2, False, 0.005, "V", _CLASS),
        Sensor("i_fd", 0.5, False, 0.005, "A", _CLASS),
        Sensor("w_r", 5e-4, True, 0.0, "rad/s", "assumed: speed pick-up, 0.05 %"),
    )
)
