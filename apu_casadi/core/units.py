"""Units, and their way into SI: of recorded quantities, and of the numbers of a unit's file."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping

import numpy as np

from apu_casadi.core.errors import DataError, nearest

__all__ = ["ALL_UNITS", "GAUGE", "RPM", "UNITS", "convert", "gauge_of", "header", "split_unit"]
__all__ += ["unit_of"]

RPM = 30.0 / np.pi
"""Revolutions per minute in one rad/s."""
_PSI, _LB, _INCH = 6894.757293168, 0.45359237, 0.0254  # Pa, kg, m
_MERCURY, _WATER = 133322.387415, 9806.65  # Pa for a metre of mercury (0 degC), of water (4 degC)
#: By SI unit: what one of each unit is in it.
_SCALES: dict[str, dict[str, float]] = {
    "K": {"K": 1.0, "degR": 5 / 9},
    "Pa": {"Pa": 1.0, "hPa": 1e2, "mbar": 1e2, "kPa": 1e3, "MPa": 1e6, "bar": 1e5, "psi": _PSI}
    | {"inHg": _INCH * _MERCURY, "mmHg": 1e-3 * _MERCURY, "inH2O": _INCH * _WATER}
    | {"mmH2O": 1e-3 * _WATER, "atm": 101325.0, "kgf/cm2": 98066.5},
    "rad/s": {"rad/s": 1.0, "krpm": np.pi / 0.03, "rev/s": 2 * np.pi}
    | dict.fromkeys(("rpm", "r/min", "1/min"), np.pi / 30),
    "V": {"V": 1.0, "mV": 1e-3, "kV": 1e3},
    "A": {"A": 1.0, "mA": 1e-3, "kA": 1e3},
    "W": {"W": 1.0, "kW": 1e3, "MW": 1e6, "hp": 745.6998715823},
    "kg/s": {"kg/s": 1.0, "g/s": 1e-3, "kg/min": 1 / 60, "kg/h": 1 / 3600}
    | {"lb/h": _LB / 3600, "lb/s": _LB},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0},
    "1/s": {"1/s": 1.0, "Hz": 1.0, "kHz": 1e3},
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
degC: degc celsius degreecelsius degreescelsius degreesc ºc ℃ °c gradc degcelsius
degF: degf fahrenheit degreesfahrenheit ºf °f
degR: degr rankine °r
K: kelvin degk
Pa: pascal
psi: psi psia psi(a) psiabs lbf/in2
bar: bar bara bar(a) barabs
kPa: kpaa kpa(a) kpaabs
MPa: mpaa mpa(a)
mbar: mbar mbara mbar(a)
hPa: hpaa hpa(a)
Pa: paa pa(a)
inHg: inhg "hg
mmHg: mmhg torr
inH2O: inh2o inwc "h2o
mmH2O: mmh2o mmwc
kgf/cm2: kg/cm2 kgf/cm² kg/cm² kp/cm2 kp/cm²
rpm: rev/min min-1 min^-1 min⁻¹ 1/min r/min rpm u/min revs/min umdr/min rot/min tr/min
krpm: krpm 1000rpm
rev/s: rps r/s u/s
Hz: hertz cps
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
%: percent pct %rpm %n %ngg %design %ofdesign %nominal %rated percentrpm pctrpm %speed
V: volt volts v(peak) vpk
kV: kilovolt
mV: millivolt
A: amp amps ampere amperes
kA: kiloampere
mA: milliampere
m: metre meter metres meters
ft: feet
"""
_SPELLINGS = {
    word: unit
    for unit, _, words in (line.partition(": ") for line in _SPELLED.strip().splitlines())
    for word in words.split()
}
#: Name and unit: the last pair of brackets, with others inside it.
_HEADER = re.compile(
    r"\s*(?P<name>.*?\S)\s*(?P<unit>\[[^\[\]]*\]|\{[^{}]*\}|<[^<>]*>|\((?:[^()]|\([^()]*\))*\))\s*"
)
#: What a gauge pressure needs.
GAUGE = "give --barometer PRESSURE, such as 101.325kPa, or a column P0 [Pa] of it"


def unit_of(text: str) -> str | None:
    """Return the unit that a spelling means (``RPM``, ``deg C``, ``lbm/hr``); None if none."""
    text = text.strip()
    if text in UNITS:
        return text
    return _SPELLINGS.get(re.sub(r"[\s_.]", "", text).lower())


def gauge_of(text: str) -> str | None:
    """Return the unit of a pressure above the air's (``psig``, ``bar(g)``, ``barü``)."""
    found = re.fullmatch(r"(.*?)[\s_(]*(g|gauge|ga|ü|rel)\)?", text.strip(), re.IGNORECASE)
    unit = unit_of(found[1]) if found and found[1] else None
    return unit if unit is not None and UNITS[unit][0] == "Pa" and unit != "kgf/cm2" else None


def header(text: str) -> tuple[str, str | None]:
    """Split ``T3 [K]``, ``T3 (K)``, ``T3 {K}`` or ``T3 <K>`` into name and unit."""
    found = _HEADER.fullmatch(text)
    if found is None:
        return text.strip(), None
    unit = found["unit"][1:-1].strip()
    return found["name"].rstrip("_ ") or text.strip(), unit or None


def split_unit(name: str, known: Callable[[str], bool]) -> tuple[str, str] | None:
    """Split ``T3_degC`` into a known name and its unit; None where it is not of that form."""
    if known(name):
        return None
    for k in (i for i, c in enumerate(name) if c in "_/ ,;-:"):
        head, tail = name[:k].strip(), name[k + 1 :].strip(" ,;-_:").removeprefix("in ")
        # no slash in many exports: kg_h, lb_hr, rad_s
        unit = unit_of(tail) or unit_of(tail.replace("_", "/")) or (gauge_of(tail) and tail)
        if known(head) and unit not in (None, "1", "-"):
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
        if other is None and gauge_of(unit) is not None:
            raise DataError(
                f"{what}: unknown unit {unit!r} without the pressure of the air around: {GAUGE}"
            )
        if other is None:
            raise DataError(f"{what}: unknown unit {unit!r} {nearest(unit, known)}")
        unit = other
    base, factor, offset = known[unit]
    if {base, si} == {"1", "kg/kg"}:
        base = si
    if base != si:
        raise DataError(f"{what}: a unit of {si} is expected, {unit!r} measures {base}")
    return np.asarray(values, float) * factor + (0.0 if difference else offset)
