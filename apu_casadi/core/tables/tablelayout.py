"""How a table is laid out where it does not tell, and what its reader can offer as a remedy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from apu_casadi.core.errors import DataError

DECIMALS = ("point", "comma")


@dataclass(frozen=True)
class TableLayout:
    """What is given about a file of columns.

    Args:
        encoding: of a text file, such as ``"utf-16"``; default UTF-8.
        decimal: ``"point"`` or ``"comma"``.
        missing: numbers, in the unit of the file, and words that stand for a gap.
        names, units: of the columns in order; "" leaves a column out.
        delimiter: between cells of a text file.
        names_line, units_line, data_line: of a text file, from 1; data_line is the first of it.
    """

    encoding: str | None = None
    decimal: str | None = None
    missing: tuple[float | str, ...] = ()
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    delimiter: str | None = None
    names_line: int | None = None
    units_line: int | None = None
    data_line: int | None = None

    #: Whether columns without a name are left out in silence, rather than refused.
    skips_unnamed: ClassVar[bool] = True
    #: Whether the first line with a known name is that of the names, whatever stands below.
    known_head: ClassVar[bool] = True
    #: Whether cells may be missing at the end of a row.
    pads_rows: ClassVar[bool] = False
    #: What to do about a question that the file leaves, by its kind.
    remedies: ClassVar[Mapping[str, str]] = {
        "decimal": "write numbers with a point and without signs between thousands",
        "gap": ": correct it",
        "name": "write one into that line",
        "head": "write the names of the columns into the first line",
        "encoding": "save it as UTF-8",
        "above": "delete one of the lines",
        "between": "delete it",
        "empty": "complete the row, or delete it",
        "sentinel": "delete the row if so; if it is right, write it with one digit more",
        "unit": "convert the values, and delete it",
    }

    def __post_init__(self) -> None:
        if self.decimal is not None and self.decimal not in DECIMALS:
            raise DataError(f"decimal {self.decimal!r}: point or comma is expected")

    @property
    def gaps(self) -> tuple[float, ...]:
        """Numbers that stand for a gap."""
        return tuple(m for m in self.missing if not isinstance(m, str))

    def means_gap(self, cell: str) -> bool:
        """Tell whether a cell is one of the words that were given for a gap."""
        words = [m.strip().lower() for m in self.missing if isinstance(m, str)]
        return bool(words) and cell.strip().lower() in words
