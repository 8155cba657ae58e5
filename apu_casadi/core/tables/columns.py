"""A column of recorded data, and how cells of text become numbers.

What is no number is a gap where loggers write that for one; else the column is text, or the file is
refused.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError

__all__ = ["Column", "Tell", "cut", "is_gap", "is_word", "like_number", "parsed"]
__all__ += ["COMMA", "EITHER", "GROUPS", "GROUPS_COMMA", "ODD", "POINT", "comma", "point"]

Tell = Callable[[str], None]

#: Cells that are gaps in any file.
GAPS = frozenset(["nan", "na", "n/a", "null", "none", "-"]) | {""}
_WORDS = """
#n/a #na #value! #ref! #div/0! #num! #null! #name? <na> nat bad baddata badinput nodata nogooddata
notavailable unavailable i/otimeout iotimeout timeout error err invalid missing disconnected
ptcreated scanoff overrange underrange outofrange overflow underflow overload overld over ol open
notconnected fault failed stale 1.#ind 1.#qnan 1.#inf nan(ind) nan(snan) nan* <nan>
n.a. n.a n.d. n/v nd void
"""
#: What programs and data historians write for a reading that they do not have.
WORDS = frozenset(_WORDS.split())
_MARKS = re.compile(r"[-–—*#?_]+")  # ---, ****, ####
_CODE = re.compile(r"^\[-?\d+\]")  # [-11059] No Good Data
POINT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d+)?", re.ASCII)
COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eEdD][+-]?\d+)?", re.ASCII)
EITHER = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}", re.ASCII)  # 1,234: a thousand, or one and a bit
GROUPS = re.compile(r"[+-]?\d{1,3}(,\d{3})+\.\d*|[+-]?\d{1,3}(,\d{3}){2,}", re.ASCII)
GROUPS_COMMA = re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d*|[+-]?\d{1,3}(\.\d{3}){2,}", re.ASCII)
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(\.\d{3})+(,\d*)?", re.ASCII)
#: Anything but plain numbers with a decimal point, between the lines of a column.
ODD = re.compile(r"[^0-9+\-.eE\n]")


@dataclass(frozen=True, eq=False)
class Column:
    """One column as it stands in the file.

    Args:
        name: without the unit. unit : as written, None where there is none.
        values: shape (K,), NaN where there is a gap.
        raw: the same as the file holds it: numbers, text, dates; for time columns.
        problem: why these are no numbers, for a column that nobody may need; else None.
        utc: whether dates are in UTC.
    """

    name: str
    unit: Any
    values: np.ndarray
    raw: Any = None
    problem: str | None = None
    utc: bool = False


def cut(cell: Any) -> str:
    """Return a cell for a message: repr, and not more than 40 characters of it."""
    text = str(cell)
    return repr(text if len(text) <= 40 else text[:37] + "...")


def is_gap(cell: str) -> bool:
    """Tell whether a cell says in any file that there is no reading."""
    return cell.strip().lower() in GAPS


def is_word(cell: str) -> bool:
    """Tell whether a cell holds what some programs write where there is no reading."""
    text = re.sub(r"\s", "", cell).lower()
    known = text in WORDS or (text[:1] in "+-" and text[1:] in WORDS)
    return known or bool(_MARKS.fullmatch(text)) or _CODE.sub("", text) in WORDS


def like_number(cell: str) -> bool:
    """Tell whether a cell is a number in some way of writing."""
    return any(p.fullmatch(cell) for p in (POINT, COMMA, GROUPS, GROUPS_COMMA))


def point(cell: str) -> float | None:
    """Return the number with a decimal point; None if the cell holds none."""
    if POINT.fullmatch(cell):
        return float(cell.replace("D", "e").replace("d", "e"))
    if GROUPS.fullmatch(cell) or EITHER.fullmatch(cell):
        return float(cell.replace(",", ""))
    return None


def comma(cell: str) -> float | None:
    """Return the number with a decimal comma; None if the cell holds none."""
    if "." in cell and not _THOUSANDS.fullmatch(cell):
        return None
    return point(cell.replace(".", "").replace(",", "."))


def parsed(
    name: str,
    unit: Any,
    cells: Sequence[Any],
    place: Callable[[int], str],
    tell: Tell,
    number: Callable[[str], float | None] = point,
    remedy: str = " (an empty cell is a gap): correct it",
) -> Column:
    """Turn cells of text, or of mixed kinds, into a column.

    A column in which numbers prevail must hold nothing else; one without is text, and is refused
    only by who needs it.
    """
    fast = _fast(cells, number)
    if fast is not None:
        return Column(name, unit, fast, fast)
    values = np.full(len(cells), np.nan)
    wrong: list[int] = []
    words: list[int] = []
    good = 0
    for k, c in enumerate(cells):
        v = _value(c, number)
        if v is not None and np.isinf(v):
            raise DataError(f"{place(k)}: {cut(c)} is no number{remedy.format(cut(c))}")
        if v is None:
            (words if isinstance(c, str) and is_word(c) else wrong).append(k)
        else:
            values[k] = v
            good += not np.isnan(v)
    raw = np.array(list(cells), dtype=object)
    if not wrong and not words:
        whole = np.abs(values).max(initial=0.0, where=~np.isnan(values)) > 2**53
        if whole and all(isinstance(c, int) or str(c).lstrip("+-").isdigit() for c in cells):
            return Column(name, unit, values, _whole(cells, values))
        return Column(name, unit, values, values)
    if wrong and (good > len(wrong) or (good and good == len(wrong))):
        cell = cut(cells[wrong[0]])
        raise DataError(f"{place(wrong[0])}: {cell} is no number{remedy.format(cell)}")
    if wrong or not good:
        k = (wrong or words)[0]
        problem = f"{place(k)}: {cut(cells[k])} is no number"
        return Column(name, unit, values * np.nan, raw, problem)
    tell(
        f"{place(words[0])}: {cut(cells[words[0]])} is taken as a gap, as are {len(words)} cells "
        "of this column in all"
    )
    return Column(name, unit, values, values)


def _fast(cells: Sequence[Any], number: Callable[[str], float | None]) -> np.ndarray | None:
    """Plain numbers and empty cells, all at once; None where any cell is anything else."""
    try:
        text = "\n".join(cells)
        if number is comma and "." not in text:
            text = text.replace(",", ".")
            cells = text.split("\n") if cells else cells
        elif number is not point:
            return None
        if ODD.search(text):
            return None
        values = np.array([c or "nan" for c in cells], dtype=float)
    except (TypeError, ValueError):
        return None
    top = np.abs(values).max(initial=0.0, where=~np.isnan(values))
    return values if top < 2**53 else None


def _whole(cells: Sequence[Any], values: np.ndarray) -> np.ndarray:
    numbers = [int(c) for c in cells]
    return np.array(numbers, dtype=np.int64) if max(map(abs, numbers)) < 2**63 else values


def _value(cell: Any, number: Callable[[str], float | None]) -> float | None:
    """A number, finite or not, NaN for a gap, None for anything else."""
    from decimal import Decimal

    if isinstance(cell, str):
        text = cell.strip()
        if text.lower() in GAPS:
            return float("nan")
        if text.lower().lstrip("+-") in ("inf", "infinity"):
            return float("inf")
        return number(text)
    if cell is None or type(cell).__name__ in ("NAType", "NaTType"):
        return float("nan")
    if isinstance(cell, bool | np.bool_):
        return None
    if isinstance(cell, int | float | np.integer | np.floating | Decimal):
        return float(cell)
    return None
