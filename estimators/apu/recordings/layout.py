"""How a file is to be read where it leaves a question: options, or a TOML file of them.

A file of columns, for recordings that name nothing themselves::

    names = ["i_a", "i_b", "i_c"]     # "" leaves a column out
    units = ["A", "A", "A"]
    rate = 1000                       # Hz, where there is no time column

or for one whose names are others::

    time = "Timestamp"
    time_format = "%d.%m.%Y %H:%M:%S"
    [columns]
    T5 = "EGT_in:degC"
    N = {column = "NGG", unit = "rpm"}
    [ranges]                          # SI
    T5 = [250, 1300]
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from apu_casadi.core.errors import DataError, nearest
from apu_casadi.core.tables.columns import cut
from apu_casadi.core.tables.tablelayout import TableLayout
from apu_casadi.core.units import UNITS, gauge_of, unit_of
from apu_casadi.gaspath.gasgenerator import GasGenerator
from estimators.apu.recordings.plausible import PLAUSIBLE, Limits, plausible_for

__all__ = ["Reading", "merged", "parse_mapping", "pressure", "read_layout"]

Columns = dict[str, tuple[str, str | None]]


@dataclass(frozen=True)
class Reading(TableLayout):
    """How a recording is to be read, where it leaves a question.

    Args:
        exclude: leave impossible readings out instead of refusing them.
        ranges: quantity -> (lowest, highest), SI; go before the table's.
        time_format, time_zone: see :func:`~apu_casadi.core.tables.timestamps.to_seconds`.
        rate: of the rows, Hz, where no column is the time.
        time: name of the time column.
        barometer: pressure of the surrounding air, Pa, for gauge pressures.
        sort: put the rows in the order of time.
        engine: the engine that the readings are of; 100 % speed is its design speed, and the ranges
            of flows, powers and speeds are those of its size.
    """

    exclude: bool = False
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    time_format: str | None = None
    time_zone: str | None = None
    rate: float | None = None
    time: str | None = None
    barometer: float | None = None
    sort: bool = False
    engine: GasGenerator = field(default_factory=GasGenerator)

    known_head: ClassVar[bool] = False
    skips_unnamed: ClassVar[bool] = False
    remedies: ClassVar[Mapping[str, str]] = {
        **TableLayout.remedies,
        "decimal": "give --decimal comma or point",
        "gap": " (an empty cell is a gap): correct it, or give --missing={} if it stands for a gap",
        "name": "write one into that line, or give --names",
        "head": "give --names A,B,... (and --units) if the file has none",
        "encoding": "give --encoding{}",
        "above": "delete one of the lines, or give names_line, units_line and data_line by "
        "--columns FILE",
        "between": "if it holds units, give them by --units or units_line (--columns FILE), else "
        "delete it",
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rate is not None and not (math.isfinite(self.rate) and self.rate > 0):
            raise DataError(f"rate = {self.rate!r} Hz must be > 0")
        if self.delimiter is not None and len(self.delimiter) != 1:
            raise DataError(f"delimiter {self.delimiter!r}: one character is expected")
        named = [n for n in self.names if n]
        twice = next((n for n in named if named.count(n) > 1), None)
        if twice is not None:
            raise DataError(f"names: {twice!r} is given twice")
        if self.units and len(self.units) != len(self.names):
            raise DataError(
                f"units: {len(self.units)} for {len(self.names)} names: one for each, '' for SI"
            )
        for u in self.units:
            if u and unit_of(u) is None and gauge_of(u) is None:
                raise DataError(f"units: unknown unit {u!r} {nearest(u, UNITS)}")

    @property
    def limits(self) -> Limits:
        """The table of ranges with those given."""
        return Limits(
            {**plausible_for(self.engine), **self.ranges}, self.exclude, tuple(self.ranges)
        )


def pressure(text: str) -> float:
    """Read ``101.325kPa`` or ``14.7 psi``, Pa.

    Raises:
        DataError: no number, or no unit of pressure.
    """
    unit = max((u for u in UNITS if text.endswith(u)), key=len, default="")
    try:
        value = float(text.removesuffix(unit)) * UNITS[unit][1]
    except (KeyError, ValueError):
        raise DataError(f"barometer {text!r}: a pressure with unit is expected") from None
    low, high = PLAUSIBLE["P0"]
    if UNITS[unit][0] != "Pa" or not low <= value <= high:
        raise DataError(f"barometer {text!r}: a pressure of {low:g} to {high:g} Pa is expected")
    return value


def parse_mapping(items: Sequence[str]) -> Columns:
    """Read options like ``T3=EGT_in:degC`` or ``T3=EGT_in``: name, column, unit.

    Raises:
        DataError: not of that form, an unknown unit, or a name given twice.
    """
    out: Columns = {}
    for item in items:
        name, sep, rest = item.partition("=")
        column, colon, unit = rest.rpartition(":")
        if not colon:
            column, unit = rest, ""
        name, column, unit = name.strip(), column.strip(), unit.strip()
        if not (sep and name and column) or (colon and not unit):
            raise DataError(f"column {item!r}: NAME=COLUMN or NAME=COLUMN:UNIT is expected")
        if unit and unit_of(unit) is None and gauge_of(unit) is None:
            raise DataError(f"column {item!r}: unknown unit {unit!r} {nearest(unit, UNITS)}")
        if name in out:
            raise DataError(f"column of {name} given twice")
        out[name] = column, unit or None
    return out


# ------------------------------------------------------------------------------ TOML

_TEXTS = ["encoding", "decimal", "time_format", "time_zone", "time", "delimiter"]
_LINES = ["names_line", "units_line", "data_line"]
_LISTS = ["names", "units"]
_FLAGS = ["exclude", "sort"]
_KEYS = (*_TEXTS, *_LINES, *_LISTS, *_FLAGS, "missing", "rate", "barometer", "ranges", "columns")


def read_layout(path: str | Path) -> tuple[Reading, Columns]:
    """Read a TOML file: how recordings are to be read, and their columns by name of the model.

    Raises:
        DataError: no such file, no TOML, an unknown key, or a value of another kind.
    """
    path = Path(path)
    try:
        with path.open("rb") as f:
            table = tomllib.load(f)
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as e:
        raise DataError(f"{path}: no TOML: {e}") from None
    except OSError as e:
        raise DataError(f"{path}: cannot be read: {e.strerror or e}") from None
    for key in table:
        if key not in _KEYS:
            raise DataError(f"{path}: unknown key {key!r} {nearest(key, _KEYS)}")
    try:
        columns = parse_mapping([_item(n, c) for n, c in _table(table, "columns").items()])
        how = {k: _value(k, v) for k, v in table.items() if k not in ("columns", "ranges")}
        ranges = {n: _range(n, v) for n, v in _table(table, "ranges").items()}
        return Reading(**how, ranges=ranges), columns
    except DataError as e:
        raise DataError(f"{path}: {e}") from None


def _table(table: Mapping[str, Any], key: str) -> dict[str, Any]:
    found = table.get(key, {})
    if not isinstance(found, dict):
        raise DataError(f"{key}: a table is expected, got {cut(found)}")
    return found


def _item(name: str, column: Any) -> str:
    if isinstance(column, str):
        return f"{name}={column}"
    if isinstance(column, dict) and {"column"} <= set(column) <= {"column", "unit"}:
        return f"{name}={column['column']}" + (f":{column['unit']}" if "unit" in column else "")
    raise DataError(f'columns.{name}: "COLUMN:UNIT" or {{column = ..., unit = ...}} is expected')


def _value(key: str, value: Any) -> Any:
    """Return a value of the file as :class:`Reading` takes it."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    texts = isinstance(value, list) and all(isinstance(v, str) for v in value)
    if key == "barometer":
        return pressure(str(value))
    cells = isinstance(value, list) and not any(isinstance(v, bool) for v in value)
    if key == "missing" and cells and all(isinstance(v, int | float | str) for v in value):
        return tuple(value)
    for keys, good, what in (
        (_TEXTS, isinstance(value, str), "a text"),
        (_LINES, isinstance(value, int) and number and value > 0, "a number of a line, from 1,"),
        (_LISTS, texts, "a list of texts"),
        (_FLAGS, isinstance(value, bool), "true or false"),
        (("rate",), number, "a number of Hz"),
        (("missing",), False, "a list of numbers and texts"),
    ):
        if key in keys and not good:
            raise DataError(f"{key}: {what} is expected, got {cut(value)}")
    return tuple(value) if key in _LISTS else float(value) if key == "rate" else value


def _range(name: str, value: Any) -> tuple[float, float]:
    numbers = isinstance(value, list) and len(value) == 2
    if not numbers or not all(isinstance(v, int | float) for v in value) or value[0] >= value[1]:
        raise DataError(f"ranges.{name}: [LOW, HIGH] in SI is expected, got {cut(value)}")
    if name not in PLAUSIBLE:
        raise DataError(f"ranges.{name}: unknown quantity {nearest(name, PLAUSIBLE)}")
    return float(value[0]), float(value[1])


def merged(first: Reading, second: Reading) -> Reading:
    """Return what the second says, and the first where the second says nothing."""
    plain = Reading()
    own = {
        f.name: getattr(second, f.name)
        for f in dataclasses.fields(Reading)
        if f.name == "engine" or getattr(second, f.name) != getattr(plain, f.name)
    }
    return dataclasses.replace(first, **own)
