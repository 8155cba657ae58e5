"""Joint fault models of all-electric auxiliary power units.

The names below are the public surface; each is loaded from its module at first use, so that
``import apu_casadi`` itself costs next to nothing.  Everything else is reached by its module, as
in ``from apu_casadi.gaspath.maps.mapfiles import read_map``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from apu_casadi.core.errors import ApuError
    from apu_casadi.core.profiles.points import Points, Steps
    from apu_casadi.core.profiles.profile import varying
    from apu_casadi.core.profiles.shapes import Growth, OnOff, Ramp
    from apu_casadi.core.signals import Signal, Signals
    from apu_casadi.core.statespace import StateSpace
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
    from apu_casadi.gaspath.steady.trimbatch import trim_batch
    from apu_casadi.machine.faults.ttsc import Ttsc
    from apu_casadi.machine.generator import Generator
    from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
    from apu_casadi.machine.loads.open import OpenLoad
    from apu_casadi.machine.loads.series import SeriesLoad
    from apu_casadi.unit.apu import Apu, trim
    from apu_casadi.unit.ensemble import simulate_ensemble
    from apu_casadi.unit.events import Ambient, FaultChange, HealthChange, LoadChange, SpeedChange
    from apu_casadi.unit.multirate import simulate_joint
    from apu_casadi.unit.noise import Noise

    __version__: str

__all__ = [
    "Ambient",
    "Apu",
    "ApuError",
    "ConstantPowerLoad",
    "FaultChange",
    "GasGenerator",
    "Generator",
    "Growth",
    "HealthChange",
    "LoadChange",
    "Noise",
    "OnOff",
    "OpenLoad",
    "OperatingPoint",
    "Points",
    "Ramp",
    "SeriesLoad",
    "Signal",
    "Signals",
    "SpeedChange",
    "StateSpace",
    "Steps",
    "Ttsc",
    "__version__",
    "simulate_ensemble",
    "simulate_joint",
    "trim",
    "trim_batch",
    "varying",
]

_HOME = {
    "Ambient": "apu_casadi.unit.events",
    "Apu": "apu_casadi.unit.apu",
    "ApuError": "apu_casadi.core.errors",
    "ConstantPowerLoad": "apu_casadi.machine.loads.constantpower",
    "FaultChange": "apu_casadi.unit.events",
    "GasGenerator": "apu_casadi.gaspath.gasgenerator",
    "Generator": "apu_casadi.machine.generator",
    "Growth": "apu_casadi.core.profiles.shapes",
    "HealthChange": "apu_casadi.unit.events",
    "LoadChange": "apu_casadi.unit.events",
    "Noise": "apu_casadi.unit.noise",
    "OnOff": "apu_casadi.core.profiles.shapes",
    "OpenLoad": "apu_casadi.machine.loads.open",
    "OperatingPoint": "apu_casadi.gaspath.steady.steadypoint",
    "Points": "apu_casadi.core.profiles.points",
    "Ramp": "apu_casadi.core.profiles.shapes",
    "SeriesLoad": "apu_casadi.machine.loads.series",
    "Signal": "apu_casadi.core.signals",
    "Signals": "apu_casadi.core.signals",
    "SpeedChange": "apu_casadi.unit.events",
    "StateSpace": "apu_casadi.core.statespace",
    "Steps": "apu_casadi.core.profiles.points",
    "Ttsc": "apu_casadi.machine.faults.ttsc",
    "simulate_ensemble": "apu_casadi.unit.ensemble",
    "simulate_joint": "apu_casadi.unit.multirate",
    "trim": "apu_casadi.unit.apu",
    "trim_batch": "apu_casadi.gaspath.steady.trimbatch",
    "varying": "apu_casadi.core.profiles.profile",
}


def __getattr__(name: str) -> Any:
    """Load a public name from its module, once."""
    if name == "__version__":
        value: Any = import_module("apu_casadi.core.version").installed()
    elif name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
