"""Recorded data files: CSV, Parquet or netCDF, columns by name, with units, into SI.

A column's unit stands in its header, ``T3 [K]`` or ``P3 (kPa)``, or in the netCDF attribute
``units``; a bare name is taken as SI.  Empty cells and NaN are gaps.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.errors import DataError, nearest

__all__ = ["UNITS", "Column", "Table", "convert", "parse_mapping", "read_table"]

#: By SI unit: what one of each unit is in it.
_SCALES: dict[str, dict[str, float]] = {
    "K": {"K": 1.0, "degR": 5 / 9},
    "Pa": {"Pa": 1.0, "hPa": 1e2, "mbar": 1e2, "kPa": 1e3, "MPa": 1e6, "bar": 1e5,
           "psi": 6894.757293168},
    "rad/s": {"rad/s": 1.0, "rpm": np.pi / 30, "r/min": np.pi / 30, "1/min": np.pi / 30},
    "W": {"W": 1.0, "kW": 1e3, "MW": 1e6, "hp": 745.6998715823},
    "kg/s": {"kg/s": 1.0, "g/s": 1e-3, "kg/min": 1 / 60, "kg/h": 1 / 3600,
             "lb/h": 0.45359237 / 3600, "lb/s": 0.45359237},
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0},
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

_GAPS = {"", "nan", "na", "n/a", "null", "none", "-"}
_HEADER = re.compile(r"^\s*(?P<name>.*?)\s*(?:\[(?P<a>[^\]]*)\]|\((?P<b>[^)]*)\))?\s*$")


@dataclass(frozen=True, eq=False)
class Column:
    """One column as it stands in the file.

    Parameters
    ----------
    name : without the unit. unit : as written, None where there is none.
    values : shape (K,), NaN where there is a gap.
    """

    name: str
    unit: str | None
    values: np.ndarray


def convert(
    values: np.ndarray, unit: str | None, si: str, what: str, *, difference: bool = False
) -> np.ndarray:
    """Return values in the SI unit ``si``; no unit means that they are in it already.

    A ``difference`` of temperatures has no offset.

    Raises
    ------
    DataError : unknown unit, with the nearest one, or a unit of another quantity.
    """
    if unit is None:
        return np.asarray(values, float)
    if unit not in UNITS:
        raise DataError(f"{what}: unknown unit {unit!r} {nearest(unit, UNITS)}")
    base, factor, offset = UNITS[unit]
    if {base, si} == {"1", "kg/kg"}:
        base = si
    if base != si:
        raise DataError(f"{what}: a unit of {si} is expected, {unit!r} measures {base}")
    return np.asarray(values, float) * factor + (0.0 if difference else offset)


@dataclass(frozen=True, eq=False)
class Table:
    """The columns of a file.

    Parameters
    ----------
    source : file name, for messages.
    columns : by name, in the file's order, all of one length.
    mapping : names of the model -> (column of the file, unit or None), which go before.
    """

    source: str
    columns: Mapping[str, Column]
    mapping: Mapping[str, tuple[str, str | None]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that mapped columns are there."""
        for name, (column, _) in self.mapping.items():
            if column not in self.columns:
                raise DataError(
                    f"{self.source}: no column {column!r} for {name} "
                    f"{nearest(column, self.columns)}"
                )

    @property
    def size(self) -> int:
        """Number of rows."""
        return next((int(c.values.size) for c in self.columns.values()), 0)

    def __contains__(self, name: str) -> bool:
        """Tell whether there is a column for this name of the model."""
        return name in self.mapping or name in self.columns

    def get(self, name: str, si: str, *, difference: bool = False) -> np.ndarray:
        """Return the values of a name of the model, in its SI unit, shape (K,).

        ``difference``: of temperatures, see :func:`convert`.

        Raises
        ------
        DataError : no such column, with the nearest one; an unknown or unfitting unit.
        """
        column, unit = self.mapping.get(name, (name, None))
        if column not in self.columns:
            raise DataError(f"{self.source}: no column {name!r} {nearest(name, self.columns)}")
        c = self.columns[column]
        what = f"{self.source}, column {column}"
        return convert(c.values, unit or c.unit, si, what, difference=difference)

    @property
    def mapped(self) -> set[str]:
        """Columns of the file that the mapping uses."""
        return {c for c, _ in self.mapping.values()}

    def time(self, name: str | None = None) -> np.ndarray | None:
        """Return the time column, s; None if there is none and none was asked for.

        Parameters
        ----------
        name : of the column; else ``time``, ``Time``, ``t`` or ``timestamp``.

        Raises
        ------
        DataError : not found, gaps, or times that do not increase; names the row.
        """
        found = name or next((n for n in TIMES if n in self), None)
        if found is None:
            return None
        t = self.get(found, "s")
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


TIMES = ("time", "Time", "t", "timestamp")


def parse_mapping(items: list[str]) -> dict[str, tuple[str, str | None]]:
    """Read options like ``T3=EGT_in:degC`` or ``T3=EGT_in``: name, column, unit.

    Raises
    ------
    DataError : not of that form, an unknown unit, or a name given twice.
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
        if unit and unit not in UNITS:
            raise DataError(f"column {item!r}: unknown unit {unit!r} {nearest(unit, UNITS)}")
        if name in out:
            raise DataError(f"column of {name} given twice")
        out[name] = column, unit or None
    return out


def read_table(
    path: str | Path, mapping: Mapping[str, tuple[str, str | None]] | None = None
) -> Table:
    """Read a file; the ending tells the kind: .csv, .txt, .tsv, .parquet, .nc.

    Raises
    ------
    DataError : missing, damaged, of unknown kind, or not readable without a package, which is
        named.
    """
    path = Path(path)
    kind = path.suffix.lower()
    readers: dict[str, Any] = {
        ".csv": _csv, ".txt": _csv, ".tsv": _csv,
        ".parquet": _parquet, ".pq": _parquet,
        ".nc": _netcdf, ".cdf": _netcdf,
    }  # fmt: skip
    if not path.is_file():
        raise DataError(f"{path}: no such file")
    if kind not in readers:
        raise DataError(
            f"{path}: unknown kind of file {kind!r} {nearest(kind, readers)}; CSV, Parquet and "
            "netCDF are read"
        )
    columns = readers[kind](path)
    if not columns or not columns[0].values.size:
        raise DataError(f"{path}: no data rows")
    table: dict[str, Column] = {}
    for c in columns:
        if c.name in table:
            raise DataError(f"{path}: two columns are named {c.name!r}")
        table[c.name] = c
    return Table(str(path.name), table, dict(mapping or {}))


def _header(text: str) -> tuple[str, str | None]:
    found = _HEADER.match(text)
    if found is None or not found["name"]:
        return text.strip(), None
    unit = found["a"] if found["a"] is not None else found["b"]
    return found["name"], unit.strip() if unit is not None and unit.strip() else None


def _csv(path: Path) -> list[Column]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as e:
        raise DataError(f"{path}: not a text file in UTF-8 (byte {e.start})") from None
    except OSError as e:
        raise DataError(f"{path}: cannot be read: {e.strerror or e}") from None
    if "\0" in text:
        raise DataError(f"{path}: holds binary data, not CSV")
    lines = text.splitlines()
    kept = [(i + 1, x) for i, x in enumerate(lines) if x.strip() and not x.startswith("#")]
    if not kept:
        raise DataError(f"{path}: empty")
    head = kept[0][1]
    delimiter = max(",;\t", key=head.count)
    rows = list(csv.reader((x for _, x in kept), delimiter=delimiter))
    if len(rows) != len(kept):
        raise DataError(f"{path}: a quoted cell runs over several lines; is a quote missing?")
    names = [_header(h) for h in rows[0]]
    for i, (name, _) in enumerate(names):
        if not name:
            raise DataError(f"{path}, line {kept[0][0]}: column {i + 1} has no name")
    if all(_number(name) is not None for name, _ in names):
        raise DataError(f"{path}, line {kept[0][0]}: a line of column names is expected first")
    values = np.full((len(names), len(rows) - 1), np.nan)
    for k, ((line, _), row) in enumerate(zip(kept[1:], rows[1:], strict=True)):
        if len(row) != len(names):
            raise DataError(
                f"{path}, line {line}: {len(row)} cells, but {len(names)} columns are named; is "
                "the file cut off?"
            )
        for i, cell in enumerate(row):
            value = _number(cell)
            if value is None:
                raise DataError(
                    f"{path}, line {line}, column {names[i][0]}: {cell!r} is no number (an empty "
                    "cell is a gap)"
                )
            values[i, k] = value
    return [Column(n, u, v) for (n, u), v in zip(names, values, strict=True)]


def _number(cell: str) -> float | None:
    """A number, NaN for a gap, None for anything else."""
    cell = cell.strip()
    if cell.lower() in _GAPS:
        return float("nan")
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if np.isfinite(value) else None


def _parquet(path: Path) -> list[Column]:
    engines = ("pyarrow", "fastparquet")
    engine = next((e for e in engines if find_spec(e)), None)
    if engine is None or find_spec("pandas") is None:
        raise DataError(
            f"{path}: reading Parquet needs pandas and pyarrow: pip install pandas pyarrow; or "
            "export the data as CSV"
        )
    pd: Any = import_module("pandas")

    try:
        frame = pd.read_parquet(path, engine=engine)
    except Exception as e:  # damaged files fail with any type
        raise DataError(f"{path}: damaged Parquet file ({type(e).__name__}: {e})") from None
    return [_typed(path, *_header(str(n)), frame[n].to_numpy()) for n in frame.columns]


def _typed(path: Path, name: str, unit: str | None, raw: Any) -> Column:
    try:
        values = np.asarray(raw, dtype=float)
    except (TypeError, ValueError):
        # text, such as a comment column: nothing that can be fitted to
        return Column(name, unit, np.full(len(raw), np.nan))
    if np.isinf(values).any():
        raise DataError(f"{path}, column {name}: infinite values")
    return Column(name, unit, values)


def _netcdf(path: Path) -> list[Column]:
    import xarray as xr

    from apu_casadi.results import load

    with path.open("rb") as f:
        start = f.read(4)
    if start == b"\x89HDF":
        try:
            with xr.open_dataset(path, decode_times=False) as ds:
                data = ds.load()
        except ValueError:
            raise DataError(
                f"{path}: a netCDF 4 file; reading it needs h5netcdf: pip install h5netcdf"
            ) from None
        except Exception as e:  # damaged files fail with any type
            raise DataError(f"{path}: damaged netCDF file ({type(e).__name__}: {e})") from None
    else:
        data = load(path)
    lines = {d: int(n) for d, n in data.sizes.items()}
    if not lines:
        raise DataError(f"{path}: no data rows")
    dim = "time" if "time" in lines else max(lines, key=lambda d: lines[d])
    out = []
    for name in [*data.coords, *data.data_vars]:
        v = data[name]
        if v.dims == (dim,):
            out.append(_typed(path, str(name), v.attrs.get("units"), v.values))
    return out
