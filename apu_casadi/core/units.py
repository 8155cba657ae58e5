"""Units, and their way into SI: of recorded quantities, and of the numbers of a unit's file."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from apu_casadi.core.errors import DataError, nearest

__all__ = ["ALL_UNITS", "UNITS", "convert", "split_unit", "unit_of"]

_PSI, _LB = 6894.757293168, 0.45359237  # Pa, kg
#: By SI unit: what one of each unit is in it.
_SCALES: dict[str, dict[str, float]] = {
    "K": {"K": 1.0, "degR": 5 / 9},
    "Pa": {"Pa": 1.0, "hPa": 1e2, "mbar": 1e2, "kPa": 1e3, "MPa": 1e6, "bar": 1e5, "psi": _PSI},
    "rad/s": {"rad/s": 1.0} | dict.fromkeys(("rpm", "r/min", "1/min"), np.pi / 30),
    "W": {"W": 1.0, "kW": 1e3, "MW": 1e6, "hp": 745.6998715823},
    "kg/s": {"kg/s": 1.0, "g/s": 1e-3, "kg/min": 1 / 60, "kg/h": 1 / 3600}
    | {"lb/h": _LB / 3600, "lb/s": _LB},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0},
    "m": {"m": 1.0, "km": 1e3, "ft": 0.3048},
    "m/s": {"m/s": 1.0},
    "kg/J": {"kg/J": 1.0},
    "kg/kg": {"kg/kg": 1.0, "g/kg": 1e-3},
    "1": {"1": 1.0, "-": 1.0, "%": 1e-2},
}
#: Of machines and fuels, which no recording has: there ``H`` are hours.
_MORE: dict[str, dict[str, float]] = {
    "ohm": {"ohm": 1.0, "mohm": 1e-3},
    "H": {"H": 1.0, "mH": 1e-3, "uH": 1e-6},
    "V": {"V": 1.0, "kV": 1e3},
    "Hz": {"Hz": 1.0, "kHz": 1e3},
    "J/kg": {"J/kg": 1.0, "kJ/kg": 1e3, "MJ/kg": 1e6},
    "kg m^2": {"kg m^2": 1.0},
    "kg/s^2": {"kg/s^2": 1.0},
}
Scales = Mapping[str, tuple[str, float, float]]


def _by_unit(scales: Mapping[str, Mapping[str, float]]) -> dict[str, tuple[str, float, float]]:
    return {unit: (si, x, 0.0) for si, all_of in scales.items() for unit, x in all_of.items()}


#: Unit -> (SI unit, factor, offset): SI value = factor * value + offset.
UNITS: dict[str, tuple[str, float, float]] = {
    **_by_unit(_SCALES),
    **dict.fromkeys(("degC", "°C", "C"), ("K", 1.0, 273.15)),
    **dict.fromkeys(("degF", "°F"), ("K", 5 / 9, 459.67 * 5 / 9)),
}
#: Those of an engine's file.
ALL_UNITS = UNITS | _by_unit(_MORE)
#: Other spellings, in lower case and without blanks, dots and underscores, that mean one thing.
_SPELLED = """
degC: degc celsius degreecelsius degreescelsius degreesc ºc ℃ °c
degF: degf fahrenheit degreesfahrenheit ºf °f
degR: degr rankine °r
K: kelvin degk
Pa: pascal
psi: psia psi(a)
bar: bara bar(a)
kPa: kpaa
rpm: rev/min min-1 min^-1 1/min r/min rpm
rad/s: rads-1 rad/sec rads^-1
kg/s: kgs-1 kg/sec kgs^-1
kg/h: kgh-1 kg/hr kgph kg/hour kgh^-1
lb/h: lbm/h lbm/hr lb/hr pph lbs/h lbs/hr
lb/s: lbm/s
W: watt watts
kW: kilowatt kw
hp: bhp shp
s: sec secs second seconds
ms: msec millisecond milliseconds
us: usec µs μs microseconds
ns: nsec nanoseconds
min: minute minutes
h: hour hours hr hrs
d: day days
%: percent pct
m: metre meter metres meters
ft: feet
"""
_SPELLINGS = {
    word: unit
    for unit, _, words in (line.partition(": ") for line in _SPELLED.strip().splitlines())
    for word in words.split()
}


def unit_of(text: str) -> str | None:
    """Return the unit that a spelling means (``RPM``, ``deg C``, ``lbm/hr``); None if none."""
    text = text.strip()
    if text in UNITS:
        return text
    return _SPELLINGS.get(text.replace(" ", "").replace("_", "").replace(".", "").lower())


def split_unit(name: str, known: Callable[[str], bool]) -> tuple[str, str] | None:
    """Split ``T3_degC`` into a known name and its unit; None where it is not of that form."""
    if known(name):
        return None
    for k in (i for i, c in enumerate(name) if c in "_/ ,;"):
        head, tail = name[:k].strip(), name[k + 1 :].strip(" ,;")
        # no slash in many exports: kg_h, lb_hr, rad_s
        unit = unit_of(tail) or unit_of(tail.replace("_", "/"))
        if known(head) and unit is not None:
            return head, unit
    return None


def convert(
    values: np.ndarray,
    unit: str | None,
    si: str,
    what: str,
    *,
    difference: bool = False,
    known: Scales = UNITS,
) -> np.ndarray:
    """Return values in the SI unit ``si``; no unit means that they are in it already.

    A ``difference`` of temperatures has no offset.

    Raises:
        DataError: unknown unit, with the nearest one, or a unit of another quantity.
    """
    if unit is None:
        return np.asarray(values, float)
    if not isinstance(unit, str):
        raise DataError(f"{what}: the unit must be text, got {unit!r:.40}")
    if unit not in known:
        other = unit_of(unit)
        if other is None:
            raise DataError(f"{what}: unknown unit {unit!r} {nearest(unit, known)}")
        unit = other
    base, factor, offset = known[unit]
    if {base, si} == {"1", "kg/kg"}:
        base = si
    if base != si:
        raise DataError(f"{what}: a unit of {si} is expected, {unit!r} measures {base}")
    return np.asarray(values, float) * factor + (0.0 if difference else offset)
