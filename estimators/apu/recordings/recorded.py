"""Recorded data files: CSV, Parquet or netCDF, columns by name, with units, into SI.

A column's unit stands in its header, ``T3 [K]`` or ``P3 (kPa)``, in a row below it, or in the
netCDF attribute ``units``; a bare name is taken as SI.  Empty cells and NaN are gaps.

Nothing is understood in silence.  Decimal commas, a row of units, dates, another encoding and the
like are common, and mean one thing; they are read where somebody is told, which takes a list
``notes``, and refused where nobody is.  What may mean two things is refused with the option that
decides.  A reading that its quantity cannot have (:mod:`estimators.apu.recordings.plausible`) is
refused, or left out on request.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError, nearest
from apu_casadi.core.tables.binaryfiles import netcdf_columns, parquet_columns
from apu_casadi.core.tables.columns import Column
from apu_casadi.core.tables.memory import memory_columns
from apu_casadi.core.tables.textfiles import text_columns
from apu_casadi.core.tables.timestamps import (
    TIMES,
    Start,
    date_and_clock,
    is_time_name,
    looks_like_time,
    may_be_time,
    to_seconds,
    unit_in_name,
)
from apu_casadi.core.units import GAUGE, UNITS, convert, gauge_of, split_unit, unit_of
from apu_casadi.gaspath.gasgenerator import GasGenerator
from estimators.apu.recordings.layout import Reading, parse_mapping
from estimators.apu.recordings.plausible import PLAUSIBLE, WAVES, clipped, plain, si_of, stuck
from estimators.apu.sensors import KNOWN

__all__ = ["TIMES", "UNITS", "Column", "Reading", "Table", "convert", "parse_mapping"]
__all__ += ["read_data", "read_table"]


def _known(name: str) -> bool:
    known = plain(name) in PLAUSIBLE or name in KNOWN or name in GasGenerator.Y.names
    return known or is_time_name(name)


@dataclass(frozen=True, eq=False)
class Table:
    """The columns of a file.

    Args:
        source: file name, for messages.
        columns: by name, in the file's order, all of one length.
        mapping: names of the model -> (column of the file, unit or None), which go before.
        reading: how questions are decided.
        notes: what was understood is put here; None where nobody reads it, see the module.
        lines: line of each row in a text file.
        others: variables that are no columns, and why.
    """

    source: str
    columns: Mapping[str, Column]
    mapping: Mapping[str, tuple[str, str | None]] = field(default_factory=dict)
    reading: Reading = field(default_factory=Reading)
    notes: list[str] | None = None
    lines: Sequence[int] | None = None
    others: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, (column, _) in self.mapping.items():
            if self._spelt(column) not in self.columns:
                raise DataError(
                    f"{self.source}: no column {column!r} for {name} "
                    f"{nearest(column, self.columns)}{self._other(column)}"
                )

    @property
    def size(self) -> int:
        """Number of rows."""
        return next((int(c.values.size) for c in self.columns.values()), 0)

    def __contains__(self, name: str) -> bool:
        """Tell whether there is a column for this name of the model."""
        return name in self.mapping or name in self.columns

    def _spelt(self, column: str) -> str:
        """The name of a column as it is kept: without the unit that it may end with."""
        own = None if column in self.columns else split_unit(column, _known)
        return column if own is None else own[0]

    def _other(self, name: str) -> str:
        return f"; {name} {self.others[name]}" if name in self.others else ""

    def _tell(self, what: str) -> None:
        _told(self.notes, what)

    def _find(self, name: str) -> tuple[Column, Any]:
        """Return the column for a name of the model, and its unit."""
        given, unit = self.mapping.get(name, (name, None))
        column = self._spelt(given)
        if column not in self.columns:
            raise DataError(
                f"{self.source}: no column {name!r} {nearest(name, self.columns)}"
                f"{self._other(column)}"
            )
        c = self.columns[column]
        if unit is None and c.unit is None and column != given:
            unit = (split_unit(given, _known) or (None, None))[1]
        return c, c.unit if unit is None else unit

    def place(self, column: str, k: int) -> str:
        """Say where row k of a column stands."""
        line = f", line {self.lines[k]}" if self.lines is not None else ""
        return f"{self.source}, column {column}, data row {k + 1}{line}"

    def get(self, name: str, si: str, *, difference: bool = False) -> np.ndarray:
        """Return the values of a name of the model, in its SI unit, shape (K,).

        ``difference``: of temperatures, see :func:`convert`.

        Raises:
            DataError: no such column, with the nearest one; an unknown or unfitting unit; a column
                that holds no numbers; an impossible reading.
        """
        c, unit = self._find(name)
        what = f"{self.source}, column {c.name}"
        if c.problem is not None:
            raise DataError(f"{what} holds no numbers: {c.problem}")
        raw = c.values
        gap = np.isin(raw, self.reading.gaps)
        if gap.any():
            raw = np.where(gap, np.nan, raw)
        values = self._in_si(c, raw, unit, name, si, difference)
        where, mixed = (lambda k: self.place(c.name, k)), self._units_elsewhere(c.name)
        limits = self.reading.limits
        values = limits.apply(name, si, values, raw, unit, where, self._tell, mixed=mixed)
        self._suspicious(name, c.name, values)
        return values

    def _in_si(
        self, c: Column, raw: np.ndarray, unit: Any, name: str, si: str, difference: bool
    ) -> np.ndarray:
        """Return readings in SI: percent of the design speed and gauge pressures among them."""
        what = f"{self.source}, column {c.name}"
        known = unit_of(unit) if isinstance(unit, str) else None
        if known == "%" and si == "rad/s":
            design = self.reading.engine.parameters.N
            self._tell(
                f"{what}: 100 % is taken as the design speed, {design * 30 / np.pi:.0f} r/min"
            )
            return np.asarray(raw / 100 * design)
        if known in ("Hz", "kHz") and plain(name) == "w_r":
            return convert(raw, known, "1/s", what) * (2 * np.pi)
        gauge = gauge_of(unit) if isinstance(unit, str) and known is None else None
        if gauge is None or si != "Pa":
            return convert(raw, unit, si, what, difference=difference)
        air: Any = self.reading.barometer
        if air is None and name != "P0" and "P0" in self:
            air = self.get("P0", "Pa")
        if air is None:
            raise DataError(
                f"{what}: unknown unit {unit!r} without the pressure of the air around: {GAUGE}"
            )
        told = f"{air:.6g} Pa" if np.ndim(air) == 0 else "that of column P0"
        self._tell(f"{what}: gauge pressure, to which the air's is added: {told}")
        return np.asarray(convert(raw, gauge, si, what) + air)

    def _suspicious(self, name: str, column: str, values: np.ndarray) -> None:
        """Tell where a channel stands still while others change, or is cut off at its ends."""
        if self.notes is None or not np.isfinite(values).any():
            return
        if plain(name) in WAVES:
            n = clipped(values)
            if n:
                top = float(np.nanmax(np.abs(values)))
                self._tell(
                    f"{self.source}, column {column}: {n} samples stand at the ends of its range, "
                    f"{top:.6g}: clipped?"
                )
            return
        others = [
            c.values
            for n, c in self.columns.items()
            if n != column and (n in PLAUSIBLE or n in self.mapped) and c.problem is None
        ]
        found = stuck(values, others) if others else None
        if found is not None:
            a, b = found
            self._tell(
                f"{self.place(column, a)} to {b + 1}: {values[a]:.6g} in {b - a + 1} rows while "
                f"all others change: stuck? give --missing if that stands for a gap"
            )

    def _units_elsewhere(self, name: str) -> bool:
        """Whether most of the other columns with numbers name a unit."""
        others = [
            c
            for n, c in self.columns.items()
            if n != name and c.problem is None and not is_time_name(n)
        ]
        named = sum(isinstance(c.unit, str) for c in others)
        return 2 * named > len(others)

    @property
    def mapped(self) -> set[str]:
        """Columns of the file that the mapping uses."""
        return {self._spelt(c) for c, _ in self.mapping.values()}

    def time_column(self) -> str | None:
        """Return the column that is the time by its name or its kind; None if there is none.

        Two columns of dates and of times of day are ``"A + B"``.

        Raises:
            DataError: several that may be.
        """
        if self.reading.time is not None or "time" in self.mapping:
            return self.reading.time or "time"
        named = [n for n in self.columns if is_time_name(n)]
        kind = [n for n, c in self.columns.items() if looks_like_time(c.raw)]
        dates = [n for n in dict.fromkeys([*named, *kind]) if self.columns[n].problem is not None]
        for a in dates:
            for b in dates:
                if a != b and self._joined(a, b) is not None:
                    return f"{a} + {b}"
        found = next((n for n in TIMES if n in self), None)
        if found is not None:
            return found
        both = [n for n in named if n in kind]
        for names in (both, named, kind, self._may_be()):
            if len(names) == 1:
                if names[0] not in (*named, *kind):
                    self._tell(f"{self.source}: column {names[0]} is taken as the time")
                return names[0]
            if names:
                raise DataError(
                    f"{self.source}: {' and '.join(names)} may be the time: give --time COLUMN, or "
                    "--steady (apu fit) if the rows are steady points"
                )
        return None

    def _may_be(self) -> list[str]:
        """Columns whose names have a word for the time and that rise."""
        return [
            n
            for n, c in self.columns.items()
            if may_be_time(n) and n not in self.mapped and c.problem is None and c.values.size > 1
            if (np.diff(c.values) > 0).all()
        ]

    def _joined(self, a: str, b: str) -> np.ndarray | None:
        raws = (self.columns[n].raw for n in (a, b))
        return date_and_clock(*raws)

    def steady_hint(self) -> str | None:
        """Return a column that rises like a time, in a table without one; None if none does."""
        for n, c in self.columns.items():
            if n in self.mapped or _known(n) or c.values.size < 4 or c.problem is not None:
                continue
            if (np.diff(c.values) > 0).all():
                return n
        return None

    def flags(self) -> list[str]:
        """Return columns of truth values that are false in some rows, which nobody heeds."""
        out = []
        for n, c in self.columns.items():
            marks = re.search(r"(?i)valid|quality|status|flag", n) and c.problem is None
            if marks and np.unique(c.values[np.isfinite(c.values)]).size > 1:
                out.append(f"{self.source}, column {n} is not heeded, although it changes")
            cells = [str(x).strip().lower() for x in (c.raw if c.problem else ())]
            if cells and set(cells) <= {"true", "false", "good", "bad", "ok", "valid", "invalid"}:
                bad = sum(x in ("false", "bad", "invalid") for x in cells)
                if bad:
                    out.append(
                        f"{self.source}, column {n} is not heeded: {bad} of {len(cells)} "
                        "rows that it calls bad are used"
                    )
        return out

    def time(
        self, name: str | None = None, *, start: list[Start] | None = None
    ) -> np.ndarray | None:
        """Return the time column, s; None if there is none and none was asked for.

        Args:
            name: of the column; else one of a usual name (``time``, ``t``, ``Timestamp``, ...), or
                the only one that holds dates.
            start: takes the first instant where there are dates, and whether it is in UTC.

        Raises:
            DataError: not found, gaps, or times that do not increase; names the row.
        """
        if self.reading.rate is not None:
            left = [n for n in self.columns if is_time_name(n)]
            if left:
                self._tell(f"{self.source}: --rate goes before column {left[0]}, which is not used")
            return np.arange(self.size) / self.reading.rate
        found = name or self.time_column()
        t = None if found is None else self._seconds(found, start)
        if t is None:
            return None
        if not np.isfinite(t).all():
            k = int(np.argmax(~np.isfinite(t)))
            raise DataError(
                f"{self.source}: column {found} has a gap in data row {k + 1}: complete the "
                "row, or delete it"
            )
        back = np.flatnonzero(np.diff(t) <= 0)
        if back.size:
            k = int(back[0])
            same = bool((np.diff(t)[back] == 0).all())
            coarse = ", or give --rate HZ if the stamps are too coarse" if same else ""
            raise DataError(
                f"{self.source}: time must increase, but data row {k + 2} has {t[k + 1]:.9g} s "
                f"after {t[k]:.9g} s ({back.size} such rows): sort the rows (--sort), or fit "
                f"pieces{coarse}"
            )
        return t

    def _seconds(self, found: str, start: list[Start] | None = None) -> np.ndarray:
        """Return the time column as it stands, s, from the first instant of dates on."""
        a, plus, b = found.partition(" + ")
        if plus and found not in self.columns:
            joined = self._joined(a, b)
            raw: Any = np.array([], dtype=object) if joined is None else joined
            unit: Any = None
        else:
            c, unit = self._find(found)
            raw = c.values if c.raw is None else c.raw
            own = unit_in_name(c.name) if unit is None and c.problem is None else None
            if own not in (None, "s"):
                self._tell(f"{self.source}: column {c.name} is taken in {own}, as its name says")
                unit = own
        utc = not plus and self._find(found)[0].utc
        form, zone = self.reading.time_format, self.reading.time_zone
        what = f"{self.source}, column {found}"
        how: dict[str, Any] = {"form": form, "zone": zone, "start": start, "utc": utc}
        return to_seconds(raw, unit, what, self._tell, **how)

    def ordered(self) -> Table:
        """Return the table with its rows in the order of time; rows of one stamp are joined.

        Raises:
            DataError: rows of one stamp that contradict each other.
        """
        found = self.time_column()
        if found is None:
            raise DataError(f"{self.source}: --sort needs a time column: give --time COLUMN")
        t = self._seconds(found)
        order = np.argsort(t, kind="stable")
        rows = [order[k] for k in np.flatnonzero(np.append(True, np.diff(t[order]) > 0))]
        group = np.cumsum(np.append(True, np.diff(t[order]) > 0)) - 1
        columns = {n: self._picked(c, order, rows, group) for n, c in self.columns.items()}
        moved, lost = int((np.diff(t) < 0).sum()), t.size - len(rows)
        if moved or lost:
            self._tell(f"{self.source}: rows are put in the order of time ({moved} fell back, "
                       f"{lost} joined with another of their stamp)")  # fmt: skip
        lines = None if self.lines is None else [self.lines[k] for k in rows]
        return dataclasses.replace(self, columns=columns, lines=lines)

    def _picked(self, c: Column, order: Any, rows: Any, group: Any) -> Column:
        """One column with rows of one stamp joined: the reading that is there."""
        raw = None if c.raw is None else np.asarray(c.raw)[rows]
        values = c.values[rows]
        if len(rows) < order.size:
            for k, v in zip(group, c.values[order], strict=True):
                if np.isnan(values[k]):
                    values[k] = v
                elif not np.isnan(v) and v != values[k]:
                    raise DataError(
                        f"{self.place(c.name, int(rows[k]))}: {values[k]:.9g}, and {v:.9g} in "
                        "another row of the same stamp: delete one, or give --rate HZ if the "
                        "stamps are too coarse"
                    )
        return dataclasses.replace(c, values=values, raw=raw)


def _told(notes: list[str] | None, what: str) -> None:
    if notes is None:
        raise DataError(
            f"{what}: refused, since nobody would be told; read_table(..., notes=[]) "
            "reads it, and `apu fit` does"
        )
    if what not in notes:
        notes.append(what)


def read_table(
    path: str | Path,
    mapping: Mapping[str, tuple[str, str | None]] | None = None,
    *,
    reading: Reading | None = None,
    notes: list[str] | None = None,
    dim: str | None = None,
) -> Table:
    """Read a file; the ending tells the kind: .csv, .txt, .tsv, .parquet, .nc, .mat.

    Args:
        path, mapping: the file; names of the model -> (column, unit or None).
        reading: how questions that the file leaves are decided.
        notes: a list to which one sentence is added for each thing that was understood; without it
            such a file is refused.
        dim: dimension of a netCDF file along which the columns are; default ``time``, or the
            longest.

    Raises:
        DataError: missing, damaged, of unknown kind, or not readable without a package, which is
            named.
    """
    path = Path(path)
    reading = Reading() if reading is None else reading
    kind = path.suffix.lower()
    if not path.is_file():
        raise DataError(f"{path}: no such file")
    if kind not in _KINDS:
        raise DataError(
            f"{path}: unknown kind of file {kind!r} {nearest(kind, _KINDS)}; CSV, Parquet, "
            "netCDF and MAT are read"
        )

    def tell(what: str) -> None:
        _told(notes, what)

    lines: list[int] | None = None
    others: dict[str, str] = {}
    try:
        if _KINDS[kind] == "text":
            columns, lines = text_columns(path, tell, reading, _known)
        elif _KINDS[kind] == "parquet":
            columns = _named(path, parquet_columns(path, tell), reading)
        else:
            columns, others = netcdf_columns(path, tell, dim)
    except OSError as e:
        raise DataError(f"{path}: cannot be read: {e.strerror or e}") from None
    return _table(path, path.name, columns, mapping, reading, notes, lines, others)


def read_data(
    data: Any,
    mapping: Mapping[str, tuple[str, str | None]] | None = None,
    *,
    source: str = "data",
    reading: Reading | None = None,
    notes: list[str] | None = None,
    dim: str | None = None,
) -> Table:
    """Take a table from memory: arrays by name, a pandas.DataFrame, an xarray.Dataset.

    Args:
        data, source: the columns, and what they are called in messages.
        mapping, reading, notes, dim: see :func:`read_table`.

    Raises:
        DataError: of another kind or shape, and as for files.
    """

    def tell(what: str) -> None:
        _told(notes, what)

    columns, others = memory_columns(source, data, tell, dim)
    reading = Reading() if reading is None else reading
    columns = _named(source, columns, reading)
    return _table(source, source, columns, mapping, reading, notes, None, others)


def _named(path: Any, columns: list[Column], reading: Reading) -> list[Column]:
    """Return columns with the names and units that were given, if any."""
    if not reading.names:
        return columns
    if len(columns) != len(reading.names):
        raise DataError(
            f"{path}: {len(columns)} columns, but {len(reading.names)} names are given: give one "
            "for each column in order, '' for one to leave out"
        )
    each = zip(columns, reading.names, reading.units or [""] * len(columns), strict=True)
    return [dataclasses.replace(c, name=n, unit=u or None) for c, n, u in each if n]


def _table(
    path: Any,
    source: str,
    columns: list[Column],
    mapping: Mapping[str, tuple[str, str | None]] | None,
    reading: Reading,
    notes: list[str] | None,
    lines: list[int] | None,
    others: dict[str, str],
) -> Table:
    """Put columns together by name, units out of names."""
    if not columns or not columns[0].values.size:
        raise DataError(f"{path}: no data rows")
    table: dict[str, Column] = {}
    taken, mapping = [c.name for c in columns], dict(mapping or {})
    for c in columns:
        own = split_unit(c.name, _known) if c.unit is None else None
        if own is not None and notes is not None and _fits(own, taken, mapping):
            _told(notes, f"{path}: column {c.name} is taken as {own[0]} in {own[1]}")
            c = dataclasses.replace(c, name=own[0], unit=own[1])
        if c.name in table and (_known(c.name) or c.name in (n for n, _ in mapping.values())):
            raise DataError(f"{path}: two columns are named {c.name!r}: rename or delete one")
        if c.name in table:
            problem = f"two columns are named {c.name!r}"
            c = dataclasses.replace(c, values=c.values * np.nan, problem=problem)
        table[c.name] = c
    made = Table(source, table, mapping, reading, notes, lines, others)
    return made.ordered() if reading.sort else made


def _fits(own: tuple[str, str], taken: Sequence[str], mapping: Mapping[str, Any]) -> bool:
    """Whether a name with a unit at its end is that of a quantity in that unit."""
    name, unit = own
    si = "s" if is_time_name(name) else si_of(name)
    base = UNITS[unit][0] if unit in UNITS else "Pa"
    fit = si in (None, base) or (si == "rad/s" and (unit == "%" or base == "1/s"))
    return fit and name not in taken and name not in mapping


_KINDS = {
    **dict.fromkeys((".csv", ".txt", ".tsv", ".dat", ".asc"), "text"),
    **dict.fromkeys((".parquet", ".pq"), "parquet"),
    **dict.fromkeys((".nc", ".nc4", ".cdf", ".mat"), "netcdf"),
}
