"""What a reading of each quantity can be: one table, and what to do with one that cannot.

The ranges hold for a running engine of this class in the whole flight envelope, shut-down and
start excluded: trims over 0 to 15 km, Mach 0 to 0.9, ISA -55 to +40 K, 75 to 105 % speed and all
powers, widened by a fifth or so for faults and sensors.  They are there to find what is no reading
at all (a sentinel, a missing unit, a zero of a dead channel), not to judge an engine.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from apu_casadi.core.errors import DataError, nearest
from apu_casadi.core.tables.sentinels import SENTINELS
from apu_casadi.core.units import UNITS
from apu_casadi.gaspath.conditions import RANGES as CONDITIONS
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.machine.park import PHASES
from estimators.apu.sensors import ELECTRICAL, KNOWN, RANGES, plain

if TYPE_CHECKING:
    from collections.abc import Callable

__all__ = [
    "PLAUSIBLE",
    "WAVES",
    "Limits",
    "clipped",
    "parse_limits",
    "plain",
    "plausible_for",
    "si_of",
    "stuck",
]

_COLD, _HOT, _BURNT = (150.0, 420.0), (300.0, 1200.0), (400.0, 1900.0)
_AMBIENT_P, _HIGH_P = (5e3, 2.5e5), (4e4, 2e6)
_FLOW, _RATIO, _EFFICIENCY = (0.1, 10.0), (1.0, 20.0), (0.2, 1.0)
_OF = (
    ("T0 T1 T2", _COLD),
    ("T4", _BURNT),
    ("T50 T8", _HOT),
    ("P0", (5e3, 1.15e5)),
    ("P1 P2 P8", _AMBIENT_P),
    ("Ps3 P4", _HIGH_P),
    ("W3 W31 W4 W41 W5 W8", _FLOW),
    ("PR_c PR_t", _RATIO),
    ("eta_c eta_t", _EFFICIENCY),
    ("SM", (-0.5, 2.0)),
    ("Mach8", (0.0, 1.0)),
    ("V8", (0.0, 700.0)),
    ("P_e_total", (-2e4, 9e5)),
    ("w_r", (1e3, 6e3)),
    ("V_fd", (-600.0, 600.0)),
    ("i_fd", (-500.0, 2500.0)),  # 1.4 kA at 225 kW and a power factor of 0.6
    *((f"v_{p}", (-2500.0, 2500.0)) for p in PHASES),
    *((f"i_{p}", (-15e3, 15e3)) for p in PHASES),
)
#: Quantities that are sampled as waveforms, of both signs.
WAVES = tuple(f"{q}_{p}" for q in "vi" for p in PHASES)
#: Quantity -> (lowest, highest), SI: what sensors read, the other outputs, and the ambient
#: conditions, of which the engine takes what is here.
PLAUSIBLE: Mapping[str, tuple[float, float]] = ChainMap(
    RANGES, {n: span for names, span in _OF for n in names.split()}, dict(CONDITIONS)
)
#: Quantities whose range holds zero: without a unit, a largest reading below this is not in SI.
_SMALL = {"PW": 2e3, "P_e_total": 2e3}
#: What a quantity is read in, beside SI.
_USUAL = {
    "K": ("degC", "degF", "degR"),
    "Pa": ("kPa", "bar", "psi", "hPa", "MPa"),
    "rad/s": ("rpm", "krpm", "rev/s", "%"),
    "kg/s": ("kg/h", "lb/h", "g/s", "kg/min"),
    "W": ("kW", "hp", "MW"),
    "V": ("kV", "mV"),
    "A": ("mA", "kA"),
    "m": ("ft", "km"),
}
#: Full scales and codes that count only where they stand apart from all other readings.
_CODES = (*SENTINELS, -40.0, -1.0, 255.0, 850.0, 888.0, 1023.0, 4095.0, 8888.0, 32767.0, 65535.0)
_NINES = (99.0, 99.9, 99.99, 999.0, 999.9, 999.99, 9999.0, 9999.9, 99999.0)
_RUN = 8  # equal readings in a row, while others change, that look stuck


def si_of(name: str) -> str | None:
    """Return the SI unit in which the model has a quantity; None for an unknown one."""
    name = plain(name)
    if name in ELECTRICAL:
        return ELECTRICAL[name].unit
    if name in KNOWN:
        return KNOWN[name].unit
    if name == "P_e_total":  # electrical output of all generators
        return "W"
    signals = next((s for s in (GasGenerator.Y, GasGenerator.U) if name in s.names), None)
    return None if signals is None else signals[name].unit


def plausible_for(gg: GasGenerator) -> dict[str, tuple[float, float]]:
    """Return the ranges for an engine of another size than the default one.

    Flows, powers and speeds go with their design values; the default engine's are the table's.
    """
    own, default = (
        {"kg/s": e.parameters.W2, "W": e.design.values["PW"], "rad/s": e.parameters.N}
        for e in (gg, GasGenerator())
    )
    factor = {unit: own[unit] / default[unit] for unit in own}
    units = {s.name: s.unit for s in (*gg.Y, *gg.U)}
    found = {}
    for name, (low, high) in PLAUSIBLE.items():
        size = factor.get(units.get(name, ""), 1.0)
        found[name] = (low * size, high * size)
    return found


@dataclass(frozen=True)
class Limits:
    """The ranges of a file's readings, and whether what lies outside is left out.

    Args:
        ranges: quantity -> (lowest, highest), SI; what is not named is not judged.
        exclude: make a gap of an impossible reading instead of refusing the file.
        given: quantities whose range the user gave: what is in it is believed.
    """

    ranges: Mapping[str, tuple[float, float]]
    exclude: bool = False
    given: Collection[str] = ()

    def apply(
        self,
        name: str,
        si: str,
        values: np.ndarray,
        raw: np.ndarray,
        unit: str | None,
        where: Callable[[int], str],
        tell: Callable[[str], None],
        *,
        mixed: bool = False,
    ) -> np.ndarray:
        """Return the values with what is excluded as NaN.

        Args:
            name, si: quantity and its unit.
            values, raw, unit: readings in SI, as they stand in the file, and the file's unit.
            where: says where reading k stands: file, column, row.
            tell: takes one sentence on what was excluded.
            mixed: other columns of the file have units, so that a bare name leaves a question.

        Raises:
            DataError: an impossible reading, with file, column, row and value.
        """
        kind = name if name in self.ranges else plain(name)
        if kind not in self.ranges:
            return values
        low, high = self.ranges[kind]
        there = np.isfinite(values)
        out = there & ((values < low) | (values > high) | np.isin(raw, SENTINELS))
        if kind in WAVES:
            out &= (values < low) | (values > high)
        apart = np.zeros_like(out) if name in self.given else _apart(raw, there & ~out)
        odd, out = bool(apart.any() and not out.any()), out | apart
        if not out.any():
            if unit is None and there.any():
                self._bare(name, si, values[there], where(int(np.argmax(there))), mixed)
            return values
        k = int(np.argmax(out))
        shown = f"{raw[k]:.9g} {unit or si}"
        if unit not in (None, si):
            shown += f" = {values[k]:.6g} {si}"
        count = f"{int(out.sum())} of {int(there.sum())} readings"
        limits = f"{low:g} to {high:g}" + ("" if si == "1" else f" {si}")
        rest = raw[there & ~out]
        no = (
            f"a code or {name}? it stands apart from all other readings, {rest.min():.6g} to "
            f"{rest.max():.6g} ({count}"
            if odd
            else f"no possible {name} ({limits}; {count}"
        )
        others = _fits(si, raw[there], low, high)
        others = others if unit is None or not _inside(raw[there], low, high) else [si, *others][:2]
        if others and out.sum() * 2 >= there.sum() and self._many(values[there], low, high):
            meant = " or ".join(others)
            raise DataError(
                f"{where(k)}: {'unit missing' if unit is None else 'wrong unit'}? {raw[k]:.9g} is "
                f"plausible as {meant}, not as {unit or si} ({name} lies within {limits}): write "
                f"the unit into the header, such as {name} [{others[0]}], or give --column "
                f"{name}={name}:{others[0]}"
            )
        if not self.exclude:
            raise DataError(
                f"{where(k)}: {shown} is {no}): give --missing {raw[k]:.9g} if that stands for a "
                "gap, --exclude-implausible to leave such readings out, or --range "
                f"{name}=LOW:HIGH in {si} if they are right"
            )
        if out.sum() == there.sum():
            raise DataError(
                f"{where(k)}: {shown} is no possible {name} ({limits}), nor is any other reading "
                "of this column: nothing is left of it"
            )
        no = no if odd else f"no possible {name} ({limits}); {count}"
        tell(f"{where(k)}: {shown} is {no}{')' * odd} left out")
        return np.where(out, np.nan, values)

    @staticmethod
    def _many(values: np.ndarray, low: float, high: float) -> bool:
        """Whether the column as a whole is off, and not one reading of several."""
        off = (values < low) | (values > high)
        return not low <= float(np.median(values)) <= high or bool(off.mean() > 0.9)

    def _bare(self, name: str, si: str, values: np.ndarray, where: str, mixed: bool) -> None:
        """Refuse a column without unit whose readings may be in another one as well."""
        low, high = self.ranges[plain(name)]
        top = float(np.abs(values).max())
        if 0 < top < _SMALL.get(name, 0.0):
            raise DataError(
                f"{where}: unit missing? the largest {name} is {top:.6g}, plausible as kW, hardly "
                f"as {si}: give --column {name}={name}:kW, or --column {name}={name}:{si}"
            )
        if mixed and si == "K" and name != "dT_isa":
            # a hot section in degC looks like a cool one in K
            others = [u for u in ("degC",) if u in _fits(si, values, low, min(high, 950.0))]
            if others:
                raise DataError(
                    f"{where}: unit missing? other columns of this file have one, and "
                    f"{values[0]:.6g} is plausible as {others[0]} and as K: give --column "
                    f"{name}={name}:{others[0]} or --column {name}={name}:K"
                )


def _apart(raw: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Readings that are a code or a zero, and farther from all others than those are apart."""
    out = np.zeros(raw.shape, bool)
    values = np.unique(raw[there])
    if values.size < 3 or values.size * 20 < there.sum():  # few levels: coarse, or steps
        return out
    for end, rest in ((values[0], values[1:]), (values[-1], values[:-1])):
        code = end == 0.0 or float(end) in _CODES or abs(float(end)) in _NINES
        far = 1.0 if values.size < 50 else 0.5 if end == 0.0 else 0.2
        few = (raw == end).sum() * 2 < there.sum()
        if code and few and np.abs(rest - end).min() > far * np.ptp(rest):
            out |= there & (raw == end)
    return out


def stuck(values: np.ndarray, others: Sequence[np.ndarray]) -> tuple[int, int] | None:
    """Return first and last row of a long run of one reading while all others change; else None."""
    there = np.isfinite(values)
    same = np.append(False, values[1:] == values[:-1])
    if not there.any() or same.mean() > 0.5:
        return None
    edges = np.flatnonzero(np.diff(np.concatenate([[0], same.astype(int), [0]])))
    runs = sorted(((b - a, a) for a, b in edges.reshape(-1, 2)), reverse=True)
    if not runs or runs[0][0] + 1 < _RUN or (len(runs) > 1 and runs[0][0] < 3 * runs[1][0]):
        return None
    n, a = runs[0]
    part = slice(a - 1, a + n)
    moving = [np.nanstd(o[part]) > 0 for o in others if np.isfinite(o[part]).sum() > 2]
    return (a - 1, a + n - 1) if moving and all(moving) else None


#: Samples at the end of the range over those at the next value, of a transducer that clips; and
#: where digits are in runs. Of the highest two digits of a sinusoid the upper one has 2.4 times as
#: many, 1/(sqrt(2) - 1).
PILED, DIGITS = 8, 3


def clipped(values: np.ndarray) -> int:
    """Return how many samples stand at the largest or lowest one, as a transducer clips.

    They stand there so often that digits do not explain it.
    """
    count, same = 0, 1e-9 * float(np.nanmax(values) - np.nanmin(values))
    steps = np.diff(np.unique(values[np.isfinite(values)]))
    steps = steps[steps > same]
    # in digits all steps are whole ones
    whole = steps / steps.min() if steps.size else steps
    digits = bool(steps.size) and bool((abs(whole - np.round(whole)) < 1e-3).all())
    for end, sign in ((np.nanmax(values), 1), (np.nanmin(values), -1)):
        at = sign * (end - values) <= same
        rest = sign * values[~at & np.isfinite(values)]
        beside = int((rest >= rest.max() - same).sum()) if rest.size else 0
        runs = int((at[1:] & at[:-1]).sum())
        most = PILED if 4 * runs <= at.sum() else DIGITS if digits else 0
        count += int(at.sum()) if beside and at.sum() > most * beside else 0
    return count if count >= 4 and count > 0.002 * values.size else 0


def _inside(values: np.ndarray, low: float, high: float) -> bool:
    return bool(((values >= low) & (values <= high)).all())


def _fits(si: str, raw: np.ndarray, low: float, high: float) -> list[str]:
    """Return the units in which all the readings would be plausible."""
    found = []
    for unit in _USUAL.get(si, ()):
        _, factor, offset = UNITS[unit]
        if unit == "%":  # of the design speed
            factor = low / 40
        if _inside(raw * factor + offset, low, high):
            found.append(unit)
    return found[:4]


def parse_limits(items: list[str]) -> dict[str, tuple[float, float]]:
    """Read options like ``T5=250:1300``: ranges in SI that replace those of the table.

    Raises:
        DataError: not of that form, an unknown quantity, or no range.
    """
    out = {}
    for item in items:
        name, _, span = item.partition("=")
        low, _, high = span.partition(":")
        name = name.strip()
        if name not in PLAUSIBLE:
            raise DataError(f"range {item!r}: unknown quantity {nearest(name, PLAUSIBLE)}")
        try:
            pair = float(low), float(high)
        except ValueError:
            raise DataError(f"range {item!r}: NAME=LOW:HIGH is expected, in SI") from None
        if not pair[0] < pair[1]:
            raise DataError(f"range {item!r}: the first number must be below the second")
        out[name] = pair
    return out
