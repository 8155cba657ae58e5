"""Joint fault models of all-electric auxiliary power units.

The names below are the public surface; each is loaded from its module at first use, so that
``import apu_casadi`` itself costs next to nothing.  Everything else is reached by its module, as
in ``from apu_casadi.mapfiles import read_map``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from apu_casadi.apu import Apu, trim
    from apu_casadi.errors import ApuError
    from apu_casadi.events import Ambient, FaultChange, HealthChange, LoadChange
    from apu_casadi.gasgenerator import GasGenerator
    from apu_casadi.generator import Generator
    from apu_casadi.machine.load import ConstantPowerLoad, OpenLoad, SeriesLoad
    from apu_casadi.machine.ttsc import Ttsc
    from apu_casadi.multirate import Noise, simulate_joint
    from apu_casadi.signals import Signal, Signals
    from apu_casadi.statespace import StateSpace
    from apu_casadi.steadypoint import OperatingPoint
    from apu_casadi.trimbatch import trim_batch

    __version__: str

__all__ = [
    "Ambient",
    "Apu",
    "ApuError",
    "ConstantPowerLoad",
    "FaultChange",
    "GasGenerator",
    "Generator",
    "HealthChange",
    "LoadChange",
    "Noise",
    "OpenLoad",
    "OperatingPoint",
    "SeriesLoad",
    "Signal",
    "Signals",
    "StateSpace",
    "Ttsc",
    "__version__",
    "simulate_joint",
    "trim",
    "trim_batch",
]

_HOME = {
    "Ambient": "apu_casadi.events",
    "Apu": "apu_casadi.apu",
    "ApuError": "apu_casadi.errors",
    "ConstantPowerLoad": "apu_casadi.machine.load",
    "FaultChange": "apu_casadi.events",
    "GasGenerator": "apu_casadi.gasgenerator",
    "Generator": "apu_casadi.generator",
    "HealthChange": "apu_casadi.events",
    "LoadChange": "apu_casadi.events",
    "Noise": "apu_casadi.multirate",
    "OpenLoad": "apu_casadi.machine.load",
    "OperatingPoint": "apu_casadi.steadypoint",
    "SeriesLoad": "apu_casadi.machine.load",
    "Signal": "apu_casadi.signals",
    "Signals": "apu_casadi.signals",
    "StateSpace": "apu_casadi.statespace",
    "Ttsc": "apu_casadi.machine.ttsc",
    "simulate_joint": "apu_casadi.multirate",
    "trim": "apu_casadi.apu",
    "trim_batch": "apu_casadi.trimbatch",
}


def _version() -> str:
    """Return the installed version; "unknown" in a checkout that is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("apu-casadi")
    except PackageNotFoundError:
        return "unknown"


def __getattr__(name: str) -> Any:
    """Load a public name from its module, once."""
    if name == "__version__":
        value: Any = _version()
    elif name in _HOME:
        value = getattr(import_module(_HOME[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return sorted({*globals(), *__all__})
