"""Profiles by points: a table of times and values, from a list or a file, in lines or in steps.

A file has commas between its cells and a header with the names of its columns, one of them
``time``, s::

    time,altitude,Mach
    0,0,0.2
    600,6000,0.45
    1800,11000,0.55

Empty lines, and lines that begin with ``#``, count for nothing.  Two rows of one time are a jump.
"""

from __future__ import annotations

import csv
import itertools
import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.checked import bounded
from apu_casadi.core.errors import DataError, ScenarioError, nearest
from apu_casadi.core.profiles.profile import PROFILES, Profile, in_run
from apu_casadi.core.register import Key
from apu_casadi.core.sharing import Parametric, derived
from apu_casadi.core.units import unit_of

FILE_KEYS = ("file", "column", "time")
"""Keys of a profile that is read from a file; the last two have defaults."""
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
    def from_table(cls, table: Mapping[str, Any], name: str, folder: str = "") -> Self:
        """Make it from times and values, or from file and column."""
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
        texts = {"column": name, "time": "time", **table}
        for k, v in texts.items():
            if not isinstance(v, str) or not v:
                raise ScenarioError(f"{k}: a text is expected, got {v!r}")
        return cls.from_csv(Path(folder) / texts["file"], texts["column"], time=texts["time"])

    def to_table(self) -> dict[str, Any]:
        """Return times and values: what is written down is complete without the file."""
        return {"kind": self.word, "times": list(self.times), "values": list(self.points)}

    @classmethod
    def from_csv(cls, path: str | os.PathLike[str], column: str, *, time: str = "time") -> Self:
        """Read a column of a file.

        Args:
            path: see the module's text.
            column, time: names of the columns of the values and of the times, s.

        Raises:
            DataError: the file cannot be read, lacks a column, or has a cell that is no finite
                number or a time before the last one; with row and column.
        """
        rows = _read(path, (time, column))
        row, (t, _) = rows[0]
        if t < 0:
            raise DataError(f"{path}: row {row}, column {time!r}: {t:g} s {_BEFORE}")
        for (_, (before, _)), (row, (t, _)) in itertools.pairwise(rows):
            if t < before:
                raise DataError(
                    f"{path}: row {row}, column {time!r}: {t:g} s is before {before:g} s in the "
                    "row before; sort the rows by time"
                )
        times, points = zip(*(cells for _, cells in rows), strict=True)
        for (_, (first, _)), (row, (t, _)) in zip(rows, rows[2:], strict=False):
            if t == first:
                raise DataError(f"{path}: row {row}, column {time!r}: {t:g} s {_THRICE}")
        return cls(times, points, f"{Path(path).name}, {column}")


def _read(path: str | os.PathLike[str], wanted: tuple[str, str]) -> list[tuple[int, list[float]]]:
    """Return two columns of a file, each row with its number in the file."""
    text = files.table_text(files.read_bytes(path, "profile", LARGEST_FILE), path)
    header, rows = None, []
    for row, cells in _cells(path, text):
        cells = [c.strip() for c in cells]
        if not any(cells) or cells[0].startswith("#"):
            continue
        if header is None:
            header = cells
            at = [_column(path, row, header, name) for name in wanted]
            continue
        if len(cells) != len(header):
            raise DataError(
                f"{path}: row {row}: {len(cells)} cells, the header has {len(header)} columns"
            )
        rows.append(
            (row, [_number(path, row, n, cells[k]) for n, k in zip(wanted, at, strict=True)])
        )
    if not rows:
        raise DataError(f"{path}: no rows: a header with {' and '.join(wanted)}, then numbers")
    return rows


def _cells(path: Any, text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield number and cells of each row."""
    row = 0
    try:
        for row, cells in enumerate(csv.reader(text.split("\n")), 1):
            yield row, cells
    except csv.Error as e:
        raise DataError(f"{path}: row {row + 1}: no cells with commas between: {e}") from None


def _column(path: Any, row: int, header: list[str], name: str) -> int:
    if header.count(name) == 1:
        return header.index(name)
    if name in header:
        raise DataError(f"{path}: row {row}: column {name!r} stands {header.count(name)} times")
    if wrong := files.no_commas(header):
        raise DataError(f"{path}: row {row}: {wrong}")
    if own := next((h for h in header if re.fullmatch(rf"{re.escape(name)}\s*[\[({{].*", h)), ""):
        raise DataError(
            f"{path}: row {row}: column {own!r} has a unit; profiles are in the unit of the "
            f"scenario's key: convert the values and name it {name!r}, or give column = {own!r} if "
            "it is that unit"
        )
    raise DataError(f"{path}: row {row}: no column {name!r} {nearest(name, header)}")


def _number(path: Any, row: int, column: str, text: str) -> float:
    where = f"{path}: row {row}, column {column!r}"
    try:
        value = float(text)
    except ValueError:
        raise DataError(f"{where}: a number is expected, got {text!r}{_remedy(text)}") from None
    if not math.isfinite(value):
        raise DataError(f"{where}: must be finite, got {text!r}")
    return value


def _remedy(cell: str) -> str:
    """Return what to do about a cell that is no number, where that can be told."""
    if unit_of(cell.strip("[]() ")) is not None:
        return ": delete the row of units; a profile is in the unit of the scenario's key"
    if re.match(r"\d{1,4}[-/.]\d\d?[-/.]\d", cell) or cell.count(":") > 1:
        return ": times are seconds from the start of the phase, not dates"
    if re.fullmatch(r"[-+\u2212]?[\d,. ']+", cell):
        return ": write numbers with a point and without signs between thousands"
    return ": complete the row, or delete it" if not cell else ""


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
