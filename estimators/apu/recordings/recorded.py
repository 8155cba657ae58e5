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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError, nearest
from apu_casadi.core.units import UNITS, convert, split_unit, unit_of
from apu_casadi.gaspath.gasgenerator import GasGenerator
from estimators.apu.recordings.binaryfiles import netcdf_columns, parquet_columns
from estimators.apu.recordings.columns import Column, text_columns
from estimators.apu.recordings.plausible import PLAUSIBLE, Limits, plausible_for
from estimators.apu.recordings.timestamps import TIMES, is_time_name, looks_like_time, to_seconds
from estimators.apu.sensors import KNOWN

__all__ = ["TIMES", "UNITS", "Column", "Reading", "Table", "convert", "parse_mapping", "read_table"]


def _known(name: str) -> bool:
    known = name in PLAUSIBLE or name in KNOWN or name in GasGenerator.Y.names
    return known or is_time_name(name)


@dataclass(frozen=True)
class Reading:
    """How a file is to be read, where it leaves a question.

    Args:
        encoding: of a text file, such as ``"utf-16"``; default UTF-8.
        decimal: ``"point"`` or ``"comma"``.
        missing: numbers that stand for a gap, in the unit of the file.
        exclude: leave impossible readings out instead of refusing them.
        ranges: quantity -> (lowest, highest), SI; go before the table's.
        engine: the engine that the readings are of; 100 % speed is its design speed, and the ranges
            of flows, powers and speeds are those of its size.
        time_format, time_zone: see :func:`~estimators.apu.recordings.timestamps.to_seconds`.
    """

    encoding: str | None = None
    decimal: str | None = None
    missing: tuple[float, ...] = ()
    exclude: bool = False
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    time_format: str | None = None
    time_zone: str | None = None
    engine: GasGenerator = field(default_factory=GasGenerator)

    @property
    def limits(self) -> Limits:
        """The table of ranges with those given."""
        return Limits({**plausible_for(self.engine), **self.ranges}, self.exclude)


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
        column, unit = self.mapping.get(name, (name, None))
        column = self._spelt(column)
        if column not in self.columns:
            raise DataError(
                f"{self.source}: no column {name!r} {nearest(name, self.columns)}"
                f"{self._other(column)}"
            )
        c = self.columns[column]
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
        gap = np.isin(raw, self.reading.missing)
        if gap.any():
            raw = np.where(gap, np.nan, raw)
        if isinstance(unit, str) and unit == "%" and si == "rad/s":
            design = self.reading.engine.parameters.N
            self._tell(
                f"{what}: 100 % is taken as the design speed, {design * 30 / np.pi:.0f} r/min"
            )
            values = raw / 100 * design
        else:
            values = convert(raw, unit, si, what, difference=difference)
        where, mixed = (lambda k: self.place(c.name, k)), self._units_elsewhere(c.name)
        limits = self.reading.limits
        return limits.apply(name, si, values, raw, unit, where, self._tell, mixed=mixed)

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

        Raises:
            DataError: several that may be.
        """
        found = next((n for n in TIMES if n in self), None)
        if found is not None:
            return found
        named = [n for n in self.columns if is_time_name(n)]
        kind = [n for n, c in self.columns.items() if looks_like_time(c.raw)]
        both = [n for n in named if n in kind]
        for names in (both, named, kind):
            if len(names) == 1:
                return names[0]
            if names:
                raise DataError(
                    f"{self.source}: {' and '.join(names)} may be the time: give --time COLUMN, or "
                    "--steady if the rows are steady points"
                )
        return None

    def steady_hint(self) -> str | None:
        """Return a column that rises like a time, in a table without one; None if none does."""
        for n, c in self.columns.items():
            if n in self.mapped or _known(n) or c.values.size < 10 or c.problem is not None:
                continue
            step = np.diff(c.values)
            if (step > 0).all() and np.ptp(step) < 1e-3 * step.mean():
                return n
        return None

    def flags(self) -> list[str]:
        """Return columns of truth values that are false in some rows, which nobody heeds."""
        out = []
        for n, c in self.columns.items():
            cells = [str(x).strip().lower() for x in (c.raw if c.problem else ())]
            if cells and set(cells) <= {"true", "false", "good", "bad", "ok", "valid", "invalid"}:
                bad = sum(x in ("false", "bad", "invalid") for x in cells)
                if bad:
                    out.append(
                        f"{self.source}, column {n} is not heeded: {bad} of {len(cells)} "
                        "rows that it calls bad are used"
                    )
        return out

    def time(self, name: str | None = None) -> np.ndarray | None:
        """Return the time column, s; None if there is none and none was asked for.

        Args:
            name: of the column; else one of a usual name (``time``, ``t``, ``Timestamp``, ...), or
                the only one that holds dates.

        Raises:
            DataError: not found, gaps, or times that do not increase; names the row.
        """
        found = name or self.time_column()
        if found is None:
            return None
        c, unit = self._find(found)
        what = f"{self.source}, column {c.name}"
        t = to_seconds(
            c.values if c.raw is None else c.raw,
            unit,
            what,
            self._tell,
            form=self.reading.time_format,
            zone=self.reading.time_zone,
        )
        if not np.isfinite(t).all():
            k = int(np.argmax(~np.isfinite(t)))
            raise DataError(f"{self.source}: column {found} has a gap in data row {k + 1}")
        back = np.flatnonzero(np.diff(t) <= 0)
        if back.size:
            k = int(back[0])
            raise DataError(
                f"{self.source}: time must increase, but data row {k + 2} has {t[k + 1]:.9g} s "
                f"after {t[k]:.9g} s ({back.size} such rows): sort the rows, or fit pieces"
            )
        return t


def _told(notes: list[str] | None, what: str) -> None:
    if notes is None:
        raise DataError(
            f"{what}: refused, since nobody would be told; read_table(..., notes=[]) "
            "reads it, and `apu fit` does"
        )
    if what not in notes:
        notes.append(what)


def parse_mapping(items: list[str]) -> dict[str, tuple[str, str | None]]:
    """Read options like ``T3=EGT_in:degC`` or ``T3=EGT_in``: name, column, unit.

    Raises:
        DataError: not of that form, an unknown unit, or a name given twice.
    """
    out: dict[str, tuple[str, str | None]] = {}
    for item in items:
        name, sep, rest = item.partition("=")
        column, colon, unit = rest.rpartition(":")
        if not colon:
            column, unit = rest, ""
        name, column, unit = name.strip(), column.strip(), unit.strip()
        if not (sep and name and column) or (colon and not unit):
            raise DataError(f"column {item!r}: NAME=COLUMN or NAME=COLUMN:UNIT is expected")
        if unit and unit_of(unit) is None:
            raise DataError(f"column {item!r}: unknown unit {unit!r} {nearest(unit, UNITS)}")
        if name in out:
            raise DataError(f"column of {name} given twice")
        out[name] = column, unit or None
    return out


def read_table(
    path: str | Path,
    mapping: Mapping[str, tuple[str, str | None]] | None = None,
    *,
    reading: Reading | None = None,
    notes: list[str] | None = None,
) -> Table:
    """Read a file; the ending tells the kind: .csv, .txt, .tsv, .parquet, .nc.

    Args:
        path, mapping: the file; names of the model -> (column, unit or None).
        reading: how questions that the file leaves are decided.
        notes: a list to which one sentence is added for each thing that was understood; without it
            such a file is refused.

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
            f"{path}: unknown kind of file {kind!r} {nearest(kind, _KINDS)}; CSV, Parquet and "
            "netCDF are read"
        )

    def tell(what: str) -> None:
        _told(notes, what)

    lines: list[int] | None = None
    others: dict[str, str] = {}
    try:
        if _KINDS[kind] == "text":
            columns, lines = text_columns(
                path, tell, encoding=reading.encoding, decimal=reading.decimal
            )
        elif _KINDS[kind] == "parquet":
            columns = parquet_columns(path, tell)
        else:
            columns, others = netcdf_columns(path, tell)
    except OSError as e:
        raise DataError(f"{path}: cannot be read: {e.strerror or e}") from None
    if not columns or not columns[0].values.size:
        raise DataError(f"{path}: no data rows")
    table: dict[str, Column] = {}
    for c in columns:
        own = split_unit(c.name, _known) if c.unit is None else None
        if own is not None and notes is not None and (mapping or {}).get(own[0]) is None:
            tell(f"{path}: column {c.name} is taken as {own[0]} in {own[1]}")
            c = Column(own[0], own[1], c.values, c.raw, c.problem)
        if c.name in table:
            raise DataError(f"{path}: two columns are named {c.name!r}")
        table[c.name] = c
    return Table(path.name, table, dict(mapping or {}), reading, notes, lines, others)


_KINDS = {
    **dict.fromkeys((".csv", ".txt", ".tsv", ".dat", ".asc"), "text"),
    **dict.fromkeys((".parquet", ".pq"), "parquet"),
    **dict.fromkeys((".nc", ".cdf"), "netcdf"),
}
