"""Small tables every cell of which counts: profiles, points of a test bench, predictions.

They are read as recordings are (:mod:`apu_casadi.core.tables.textfiles`, ``binaryfiles``); but a
gap, or a number that stands for one, is refused unless the reader has a use for it.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import ApuWarning, DataError, nearest
from apu_casadi.core.tables.columns import Column, cut
from apu_casadi.core.tables.sentinels import sentinel
from apu_casadi.core.tables.tablelayout import TableLayout
from apu_casadi.core.tables.textfiles import columns_of, decoded
from apu_casadi.core.units import UNITS, convert, unit_of

__all__ = ["NumberTable", "numbers_of", "read_numbers", "table_text"]


@dataclass(frozen=True, eq=False)
class NumberTable:
    """The columns of a file.

    Args:
        path: for messages.
        columns: in the file's order.
        lines: of each row in a text file.
        layout: what was given, and what to do about questions.
        words: cells of a text file by column.
    """

    path: str
    columns: Sequence[Column]
    lines: Sequence[int] | None
    layout: TableLayout
    words: Mapping[str, list[str]] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Names of the columns."""
        return [c.name for c in self.columns]

    @property
    def size(self) -> int:
        """Number of rows."""
        return int(self.columns[0].values.size) if self.columns else 0

    def place(self, k: int, name: str = "") -> str:
        """Say where row k stands."""
        row = f"data row {k + 1}" if self.lines is None else f"line {self.lines[k]}"
        return f"{self.path}, {row}" + (f", column {name}" if name else "")

    def column(self, name: str) -> Column:
        """Return a column.

        Raises:
            DataError: none or two of that name.
        """
        found = [c for c in self.columns if c.name == name]
        if len(found) > 1:
            raise DataError(f"{self.path}: column {name!r} stands {len(found)} times: delete one")
        if not found:
            raise DataError(f"{self.path}: no column {name!r} {nearest(name, self.names)}")
        return found[0]

    def texts(self, name: str) -> list[str]:
        """Return the cells of a column as text, "" for a gap."""
        c = self.column(name)
        if name in self.words:
            return self.words[name]
        raw = c.values if c.raw is None else c.raw
        cells = (x.decode("utf-8", "replace") if isinstance(x, bytes) else x for x in raw)
        return ["" if x is None or x != x else str(x).strip() for x in cells]

    def numbers(
        self,
        name: str,
        unit: str = "",
        *,
        gaps: bool = False,
        codes: bool = False,
        ordered: bool = True,
    ) -> np.ndarray:
        """Return the numbers of a column, shape (K,), in a unit where the file names one.

        Args:
            name: of the column.
            unit: the wanted one; "" where that is not known, and a unit of the file is refused.
            gaps: rows without a number are NaN, not refused.
            codes: 9999 and the like are numbers as others are.
            ordered: see :func:`~apu_casadi.core.tables.sentinels.sentinel`.

        Raises:
            DataError: no such column; a cell that is no number, a gap, or a number that stands for
                one; a unit of another quantity; with line, column and remedy.
        """
        c, remedies = self.column(name), self.layout.remedies
        if unit == "s" and getattr(c.raw, "dtype", np.dtype(float)).kind == "m":
            return np.asarray(c.raw / np.timedelta64(1, "s"))
        if c.problem is not None:
            words = self.texts(name)
            if not any(words) and gaps:
                return np.full(self.size, np.nan)
            k = next((i for i, w in enumerate(words) if w and not _is_number(w)), 0)
            what = f"{cut(words[k])} is no number" if words and words[k] else "no number"
            cell = words[k] if words else ""
            remedy = _remedy(cell) or remedies["gap"].format(cut(cell))
            raise DataError(f"{self.place(k, name)}: {what}{remedy}")
        given = np.isin(c.values, self.layout.gaps)
        values = np.where(given, np.nan, c.values)
        empty = np.flatnonzero(~np.isfinite(values) & ~given)
        if empty.size and not gaps:
            raise DataError(
                f"{self.place(int(empty[0]), name)}: no number stands there: {remedies['empty']}"
            )
        code = None if codes else sentinel(values, ordered=ordered)
        if code is not None:
            shown = f"{values[code]:.9g}"
            remedy = remedies["sentinel"].format(shown)
            raise DataError(
                f"{self.place(code, name)}: {shown} stands for no reading in many files: {remedy}"
            )
        return self._in_unit(c, values, unit)

    def _in_unit(self, c: Column, values: np.ndarray, unit: str) -> np.ndarray:
        if c.unit in (None, "", "-", "1", unit):
            return values
        what = f"{self.path}, column {c.name}"
        if not unit or unit_of(unit) is None:
            raise DataError(f"{what} has a unit, {c.unit}; {self.layout.remedies['unit']}")
        si, factor, offset = UNITS[unit_of(unit) or unit]
        difference = c.name.startswith("dT")
        made = convert(values, c.unit, si, what, difference=difference)
        return np.asarray((made - (0.0 if difference else offset)) / factor)


def read_numbers(
    path: str | os.PathLike[str],
    known: Callable[[str], bool],
    *,
    what: str = "",
    layout: TableLayout | None = None,
    limit: int = 1 << 28,
) -> NumberTable:
    """Read a file of columns: Parquet and netCDF by their endings, all others as text.

    Args:
        path: the file.
        known: tells whether a name is one that is looked for, to find the line of names.
        what: what the file should be, for messages.
        layout: what is given about it.
        limit: largest size, bytes.

    Raises:
        DataError: it cannot be read, or holds no rows; what is left open is refused.
    """
    layout = TableLayout() if layout is None else layout
    raw, file, kind = files.read_bytes(path, what, limit), Path(path), Path(path).suffix.lower()
    if kind in (".parquet", ".pq"):
        columns = import_module("apu_casadi.core.tables.binaryfiles").parquet_columns(file, _tell)
    elif kind in (".nc", ".nc4", ".cdf", ".mat"):
        columns, _ = import_module("apu_casadi.core.tables.binaryfiles").netcdf_columns(file, _tell)
    else:
        return numbers_of(path, table_text(raw, path), known, layout)
    return NumberTable(str(path), columns, None, layout)


def numbers_of(
    path: str | os.PathLike[str], text: str, known: Callable[[str], bool], layout: TableLayout
) -> NumberTable:
    """Read a table out of the text of a file; as :func:`read_numbers`."""
    words: dict[str, list[str]] = {}
    columns, lines = columns_of(Path(path), text, _tell, layout, known, words)
    return NumberTable(str(path), columns, lines, layout, words)


def table_text(raw: bytes, path: str | os.PathLike[str]) -> str:
    """Return the text of a table of numbers, which its encoding does not change.

    Raises:
        DataError: damaged, or no text.
    """
    return decoded(path, raw, lambda what: None, TableLayout())


def _tell(what: str) -> None:
    """Nothing that could have been meant otherwise is understood in silence."""
    if not _PLAIN.search(what):
        warnings.warn(ApuWarning(what), stacklevel=5)


_PLAIN = re.compile(
    r"taken as a row of units$|: decimal commas, such as|numbers the rows$|taken as a gap, as are"
)
_DATE = re.compile(r"\d{1,4}[-/.]\d\d?[-/.]\d")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _remedy(cell: str) -> str:
    """Return what to do about a cell that is no number, where that can be told."""
    if _DATE.match(cell) or cell.count(":") > 1:
        return ": numbers are expected, not dates; times are seconds from the start"
    if re.fullmatch(r"[-+\u2212]?[\d,. ']+", cell):
        return ": write numbers with a point and without signs between thousands"
    return ""
