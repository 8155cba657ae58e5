"""Units of recorded quantities, and their way into SI."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from apu_casadi.core.errors import DataError, nearest

__all__ = ["UNITS", "convert", "split_unit", "unit_of"]

#: By SI unit: what one of each unit is in it.
_SCALES: dict[str, dict[str, float]] = {
    "K": {"K": 1.0, "degR": 5 / 9},
    "Pa": {"Pa": 1.0, "hPa": 1e2, "mbar": 1e2, "kPa": 1e3, "MPa": 1e6, "bar": 1e5,
           "psi": 6894.757293168},
    "rad/s": {"rad/s": 1.0, "rpm": np.pi / 30, "r/min": np.pi / 30, "1/min": np.pi / 30},
    "W": {"W": 1.0, "kW": 1e3, "MW": 1e6, "hp": 745.6998715823},
    "kg/s": {"kg/s": 1.0, "g/s": 1e-3, "kg/min": 1 / 60, "kg/h": 1 / 3600,
             "lb/h": 0.45359237 / 3600, "lb/s": 0.45359237},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0,
          "d": 86400.0},
    "m": {"m": 1.0, "km": 1e3, "ft": 0.3048},
    "m/s": {"m/s": 1.0},
    "kg/J": {"kg/J": 1.0},
    "kg/kg": {"kg/kg": 1.0, "g/kg": 1e-3},
    "1": {"1": 1.0, "-": 1.0, "%": 1e-2},
}  # fmt: skip
#: Unit -> (SI unit, factor, offset): SI value = factor * value + offset.
UNITS: dict[str, tuple[str, float, float]] = {
    **{unit: (si, scale, 0.0) for si, all_of in _SCALES.items() for unit, scale in all_of.items()},
    **dict.fromkeys(("degC", "°C", "C"), ("K", 1.0, 273.15)),
    **dict.fromkeys(("degF", "°F"), ("K", 5 / 9, 459.67 * 5 / 9)),
}
#: Other spellings, in lower case and without blanks, dots and underscores, that mean one thing.
_SPELLINGS = {
    "degc": "degC", "celsius": "degC", "degreecelsius": "degC", "degreescelsius": "degC",
    "degreesc": "degC", "ºc": "degC", "℃": "degC", "°c": "degC",
    "degf": "degF", "fahrenheit": "degF", "degreesfahrenheit": "degF", "ºf": "degF", "°f": "degF",
    "degr": "degR", "rankine": "degR", "°r": "degR",
    "kelvin": "K", "degk": "K", "pascal": "Pa",
    "psia": "psi", "bara": "bar", "kpaa": "kPa", "bar(a)": "bar", "psi(a)": "psi",
    "rev/min": "rpm", "min-1": "rpm", "min^-1": "rpm", "1/min": "rpm", "r/min": "rpm",
    "rpm": "rpm", "rads-1": "rad/s", "rad/sec": "rad/s", "rads^-1": "rad/s",
    "kgs-1": "kg/s", "kg/sec": "kg/s", "kgh-1": "kg/h", "kg/hr": "kg/h", "kgph": "kg/h",
    "kg/hour": "kg/h", "kgs^-1": "kg/s", "kgh^-1": "kg/h",
    "lbm/h": "lb/h", "lbm/hr": "lb/h", "lb/hr": "lb/h", "pph": "lb/h", "lbs/h": "lb/h",
    "lbs/hr": "lb/h", "lbm/s": "lb/s",
    "watt": "W", "watts": "W", "kilowatt": "kW", "kw": "kW", "bhp": "hp", "shp": "hp",
    "sec": "s", "secs": "s", "second": "s", "seconds": "s", "msec": "ms", "millisecond": "ms",
    "milliseconds": "ms", "usec": "us", "µs": "us", "μs": "us", "microseconds": "us",
    "nsec": "ns", "nanoseconds": "ns", "minute": "min", "minutes": "min", "hour": "h",
    "hours": "h", "hr": "h", "hrs": "h", "day": "d", "days": "d",
    "percent": "%", "pct": "%", "metre": "m", "meter": "m",
    "metres": "m", "meters": "m", "feet": "ft",
}  # fmt: skip


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
    values: np.ndarray, unit: str | None, si: str, what: str, *, difference: bool = False
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
    if unit not in UNITS:
        other = unit_of(unit)
        if other is None:
            raise DataError(f"{what}: unknown unit {unit!r} {nearest(unit, UNITS)}")
        unit = other
    base, factor, offset = UNITS[unit]
    if {base, si} == {"1", "kg/kg"}:
        base = si
    if base != si:
        raise DataError(f"{what}: a unit of {si} is expected, {unit!r} measures {base}")
    return np.asarray(values, float) * factor + (0.0 if difference else offset)
