"""Profiles by points: a table of times and values, from a list or a file, in lines or in steps.

A file has a line with the names of its columns, one of them ``time``, s::

    time,altitude,Mach
    0,0,0.2
    600,6000,0.45
    1800,11000,0.55

Empty lines, and lines that begin with ``#``, count for nothing.  Two rows of one time are a jump.
Cells may be separated by semicolons, tabs or bars, numbers have decimal commas, names a unit,
``altitude [ft]``, or a row of units below; Parquet and netCDF are read by their endings.  A number
that stands for no value, such as -999 or 9999, is refused until ``missing`` tells what it is.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from apu_casadi.core.checked import bounded
from apu_casadi.core.errors import DataError, ScenarioError, nearest
from apu_casadi.core.profiles.profile import PROFILES, Profile, in_run
from apu_casadi.core.register import Key
from apu_casadi.core.sharing import Parametric, derived
from apu_casadi.core.tables.numbertable import read_numbers
from apu_casadi.core.tables.tablelayout import DECIMALS, TableLayout
from apu_casadi.core.units import header

FILE_KEYS = ("file", "column", "time", "decimal", "missing")
"""Keys of a profile that is read from a file; all but the first have defaults."""
LARGEST_FILE = 1 << 26
"""Largest file of a profile, bytes."""
_BEFORE = "is before the profile begins; its time counts from 0 s, where its phase or event starts"
_THRICE = "stands there three times; two make a jump, from the value before to that after"


@dataclass(frozen=True)
class OfPoints(Parametric, Profile):
    """Values at times; a base of kinds that say what holds in between.

    Args:
        times: s, from 0, never decreasing, at least one.
        points: a value for each.
        source: file and column that they are from.
    """

    times: tuple[float, ...]
    points: tuple[float, ...]
    source: str = field(default="", compare=False)

    by_value = True
    from_files = True
    keys: ClassVar[tuple[Key, ...]] = (
        Key("times", "s", "times, never decreasing"),
        Key("values", "", "a value for each time"),
    )

    def __post_init__(self) -> None:
        """Check the lists."""
        for name, key in (("times", "times"), ("points", "values")):
            given = getattr(self, name)
            if not isinstance(given, Sequence) or isinstance(given, str) or not len(given):
                raise ScenarioError(f"{key}: a list of numbers is expected, got {given!r}")
            made = tuple(bounded(v, f"{key}[{i}]") for i, v in enumerate(given, 1))
            object.__setattr__(self, name, made)
        if len(self.times) != len(self.points):
            raise ScenarioError(
                f"values: {len(self.points)} for {len(self.times)} times; one for each is expected"
            )
        if self.times[0] < 0:
            raise ScenarioError(f"times[1]: {self.times[0]:g} s {_BEFORE}")
        for i, (a, b) in enumerate(itertools.pairwise(self.times), 2):
            if b < a:
                raise ScenarioError(f"times[{i}]: {b:g} s is before {a:g} s; times go on")
        for i, (a, b) in enumerate(zip(self.times, self.times[2:], strict=False), 3):
            if a == b:
                raise ScenarioError(f"times[{i}]: {b:g} s {_THRICE}")

    @derived
    def arrays(self) -> tuple[np.ndarray, np.ndarray, bool]:
        """Times and points, and whether two times are equal."""
        times = np.array(self.times)
        return times, np.array(self.points), bool((np.diff(times) == 0).any())

    @property
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest point."""
        return min(self.points), max(self.points)

    def corners(self, duration: float) -> tuple[float, ...]:
        """The times of all points."""
        return in_run(self.times, duration)

    @property
    def label(self) -> str:
        """As in ``'table of 12 points, from 0 to 11000'``."""
        where = f" from {self.source}" if self.source else ""
        low, high = self.bounds
        return f"{self.word} of {len(self.times)} points{where}, {low:g} to {high:g}"

    @classmethod
    def told_by(cls, table: Mapping[str, Any]) -> bool:
        """Whether there are points, or a file of them."""
        return "file" in table or ("times" in table and "values" in table)

    @classmethod
    def from_table(
        cls, table: Mapping[str, Any], name: str, folder: str = "", unit: str = ""
    ) -> Self:
        """Make it from times and values, or from file and column; ``unit`` is the wanted one."""
        known = {"file": FILE_KEYS, "times": ("times", "values")}
        keys = known["file" if "file" in table else "times"]
        for k in table:
            if k not in keys:
                raise ScenarioError(f"{k}: unknown key {nearest(str(k), keys)}")
        if "file" not in table:
            for k in keys:
                if k not in table:
                    raise ScenarioError(f"{k}: missing: a {cls.word!r} profile needs it")
            return cls(table["times"], table["values"])
        missing = table.get("missing")
        if missing is not None and not _cells(missing):
            raise ScenarioError(
                f"missing: a list of numbers and texts is expected, got {missing!r}"
            )
        texts = {"column": name, "time": "time", **table}
        for k, v in texts.items():
            if k != "missing" and (not isinstance(v, str) or not v):
                raise ScenarioError(f"{k}: a text is expected, got {v!r}")
        if texts.get("decimal", "point") not in DECIMALS:
            raise ScenarioError(f"decimal: point or comma is expected, got {texts['decimal']!r}")
        path, column = Path(folder) / texts["file"], texts["column"]
        how: dict[str, Any] = {"decimal": texts.get("decimal"), "missing": missing}
        return cls.from_csv(path, column, time=texts["time"], unit=unit, **how)

    def to_table(self) -> dict[str, Any]:
        """Return times and values: what is written down is complete without the file."""
        return {"kind": self.word, "times": list(self.times), "values": list(self.points)}

    @classmethod
    def from_csv(
        cls,
        path: str | os.PathLike[str],
        column: str,
        *,
        time: str = "time",
        unit: str = "",
        decimal: str | None = None,
        missing: Sequence[float | str] | None = None,
    ) -> Self:
        """Read a column of a file.

        Args:
            path: see the module's text.
            column, time: names of the columns of the values and of the times, s.
            unit: of the values wanted; "" where a unit in the file is refused.
            decimal: ``"point"`` or ``"comma"``, where the file leaves it open.
            missing: numbers and words that stand for no value: such rows are left out, as are
                empty ones.  None refuses them.

        Raises:
            DataError: the file cannot be read, lacks a column, or has a cell that is no finite
                number, a number that stands for none, or a time before the last one; with row and
                column.
        """
        (time, _), (column, own) = header(time), header(column)
        unit = unit or own or ""  # who names the unit of the column in column = "..." means it
        layout = _Layout(decimal=decimal, missing=tuple(missing or ()))
        table = read_numbers(
            path, (time, column).__contains__, what="profile", layout=layout, limit=LARGEST_FILE
        )
        gaps = {"gaps": missing is not None, "codes": missing is not None}
        times, values = table.numbers(time, "s"), table.numbers(column, unit, **gaps)
        there = np.flatnonzero(np.isfinite(values)).tolist()
        if not there:
            raise DataError(f"{path}: no rows: names {time} and {column}, then numbers")
        t = {k: float(times[k]) for k in there}
        if t[there[0]] < 0:
            raise DataError(f"{table.place(there[0], time)}: {t[there[0]]:g} s {_BEFORE}")
        for i, k in itertools.pairwise(there):
            if t[k] < t[i]:
                raise DataError(
                    f"{table.place(k, time)}: {t[k]:g} s is before {t[i]:g} s in the row before; "
                    "sort the rows by time"
                )
        for i, k in zip(there, there[2:], strict=False):
            if t[k] == t[i]:
                raise DataError(f"{table.place(k, time)}: {t[k]:g} s {_THRICE}")
        points = tuple(float(values[k]) for k in there)
        return cls(tuple(t.values()), points, f"{Path(path).name}, {column}")


def _cells(missing: Any) -> bool:
    kinds = isinstance(missing, list) and all(isinstance(m, int | float | str) for m in missing)
    return kinds and not any(isinstance(m, bool) for m in missing)


@dataclass(frozen=True)
class _Layout(TableLayout):
    """What the keys of a profile say of its file."""

    remedies = {
        **TableLayout.remedies,
        "decimal": 'give decimal = "comma" or "point" beside file',
        "gap": ": correct it, or give missing = [{}] beside file to leave such rows out",
        "empty": "complete the row, delete it, or give missing = [] beside file to leave it out",
        "sentinel": "give missing = [{0}] beside file to leave such rows out, or missing = [] if "
        "{0} is right",
        "unit": "profiles are in the unit of the scenario's key: convert the values, and delete it",
    }


@PROFILES.add("table")
@dataclass(frozen=True)
class Points(OfPoints):
    """Straight lines between points; constant before the first and after the last.

    Args:
        times: s, from 0, never decreasing; two equal ones are a jump.
        points: a value for each.
        source: file and column that they are from.

    Raises:
        ScenarioError: no numbers, times that go back, or lists of different lengths.
    """

    word = "table"

    def values(self, t: np.ndarray) -> np.ndarray:
        """Linear in between; at a jump the later value."""
        times, points, jumps = self.arrays
        if not jumps:
            return np.asarray(np.interp(t, times, points))
        k = np.searchsorted(times, t, side="right")  # of the next point
        a, b = np.clip(k - 1, 0, None), np.clip(k, None, times.size - 1)
        span = np.where(times[b] > times[a], times[b] - times[a], 1.0)
        share = np.clip((t - times[a]) / span, 0.0, 1.0)
        return np.asarray(points[a] + share * (points[b] - points[a]))

    def instants(self, duration: float) -> tuple[float, ...]:
        """Where two points have one time."""
        pairs = itertools.pairwise(zip(self.times, self.points, strict=True))
        return in_run((t for (s, v), (t, w) in pairs if s == t and v != w), duration)


@PROFILES.add("steps")
@dataclass(frozen=True)
class Steps(OfPoints):
    """Each value holds from its time on until the next one; the first also before.

    Args:
        times: s, from 0, never decreasing; of two equal ones the later counts.
        points: a value for each.
        source: file and column that they are from.

    Raises:
        ScenarioError: no numbers, times that go back, or lists of different lengths.
    """

    word = "steps"

    def values(self, t: np.ndarray) -> np.ndarray:
        """The last point that is not later."""
        times, points, _ = self.arrays
        k = np.searchsorted(times, t + 1e-12, side="right") - 1
        return np.asarray(points[np.clip(k, 0, None)])

    def instants(self, duration: float) -> tuple[float, ...]:
        """The times at which the value changes."""
        pairs = itertools.pairwise(zip(self.times, self.points, strict=True))
        return in_run((t for (_, v), (t, w) in pairs if v != w), duration)

    @classmethod
    def told_by(cls, table: Mapping[str, Any]) -> bool:
        """Never: steps are asked for by their kind."""
        return False
