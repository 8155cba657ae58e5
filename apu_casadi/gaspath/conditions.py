"""Ambient conditions: their names, the default day and the range of each, in one table.

Everything that takes ambient conditions reads them here: runs and scenarios
(:class:`apu_casadi.unit.events.Ambient`), the engine's inputs and design data
(:mod:`apu_casadi.gaspath.cycle`), hence trims, decks, filters and fits, and the options of the
commands.

The default day is the ground day of the paper's Tables 3 and 4, ISA + 5 K at sea level: the engine
is designed for it, and the paper's joint runs start from it.  One day for all: a healthy engine
that is simulated on one day and fitted on another looks ill (5 K are 4 % of compressor efficiency).
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Condition(NamedTuple):
    """One ambient condition.

    Args:
        default: its value on the default day.
        lo, hi: lowest and highest value that the model is meant for.
        unit, doc, source: of the value; ``source`` tells where default and range are from.
        nominal: typical magnitude.
    """

    default: float
    lo: float
    hi: float
    unit: str
    doc: str
    source: str
    nominal: float


_ISA = "Table 3; the atmosphere's two lowest layers, below the lowest stratosphere"
_INTAKE = "Table 3; subsonic intake, assumed"
_DAYS = "Table 3; extreme days, assumed"
_WET = "Table 4 (SNOx); beyond any wet day"
_ROWS = {
    "altitude": (0.0, -1000.0, 15000.0, "m", "geopotential altitude", _ISA, 1e4),
    "Mach": (0.0, 0.0, 0.95, "1", "flight Mach number", _INTAKE, 1.0),
    "dT_isa": (5.0, -60.0, 60.0, "K", "deviation from ISA", _DAYS, 30.0),
    "war": (0.0, 0.0, 0.1, "kg/kg", "water per dry air", _WET, 0.01),
}
CONDITIONS: Mapping[str, Condition] = MappingProxyType(
    {name: Condition(*row) for name, row in _ROWS.items()}
)
"""The ambient conditions by name, in the order of the engine's inputs."""

AMBIENT = tuple(CONDITIONS)
"""Their names."""

DEFAULT_DAY: Mapping[str, float] = MappingProxyType({n: c.default for n, c in CONDITIONS.items()})
"""Their values where nobody gives any."""

RANGES: Mapping[str, tuple[float, float]] = MappingProxyType(
    {n: (c.lo, c.hi) for n, c in CONDITIONS.items()}
)
"""Lowest and highest value of each."""


def day_words(values: Mapping[str, float] | None = None) -> str:
    """Return conditions in words; those not in ``values`` are of the default day.

    >>> day_words({"altitude": 8000.0, "Mach": 0.7})
    '8000 m, Mach 0.7, ISA + 5 K, dry air'
    """
    v = {**DEFAULT_DAY, **(values or {})}
    sign = "-" if v["dT_isa"] < 0 else "+"
    water = f"{v['war']:g} kg/kg of water" if v["war"] else "dry air"
    return f"{v['altitude']:g} m, Mach {v['Mach']:g}, ISA {sign} {abs(v['dT_isa']):g} K, {water}"


def assumed_words(given: Mapping[str, object]) -> str:
    """Return the conditions that nobody gave, with the values taken; "" where all were given."""
    left = [(n, v) for n, v in DEFAULT_DAY.items() if given.get(n) is None]
    return ", ".join(f"{n} = {v:g} {CONDITIONS[n].unit}".removesuffix(" 1") for n, v in left)
