"""Columns of recorded data out of text files: encodings, separators, decimal commas, headers.

The tokens are those of the standard ``csv`` module.  What a file leaves open is settled by the
whole file, never cell by cell, and told; what it leaves open for good is refused.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError
from apu_casadi.core.units import unit_of
from estimators.apu.recordings.timestamps import is_time_name, looks_like_time

__all__ = ["Column", "cut", "header", "parsed", "text_columns"]

Tell = Callable[[str], None]

#: Cells that are gaps in any file.
GAPS = frozenset({"", "nan", "na", "n/a", "null", "none", "-"})
#: What programs and data historians write for a reading that they do not have.
WORDS = frozenset(
    [
        "#n/a",
        "#na",
        "#value!",
        "#ref!",
        "#div/0!",
        "#num!",
        "#null!",
        "#name?",
        "<na>",
        "nat",
        "bad",
        "badinput",
        "nodata",
        "notavailable",
        "i/otimeout",
        "iotimeout",
        "timeout",
        "error",
        "err",
        "invalid",
        "missing",
        "disconnected",
        "ptcreated",
        "scanoff",
        "overrange",
        "underrange",
        "overflow",
        "underflow",
        "overload",
        "open",
        "notconnected",
        "fault",
        "failed",
        "--",
        "---",
        "----",
        "1.#ind",
        "1.#qnan",
        "-1.#ind",
        "n.a.",
        "n.d.",
        "nd",
        "void",
    ]
)
_HEADER = re.compile(r"^\s*(?P<name>.*?)\s*(?:\[(?P<a>[^\]]*)\]|\((?P<b>[^)]*)\))?\s*$")
_POINT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?", re.ASCII)
_EITHER = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}", re.ASCII)  # 1,234: a thousand, or one and a bit
_GROUPS = re.compile(r"[+-]?\d{1,3}(,\d{3})+\.\d*|[+-]?\d{1,3}(,\d{3}){2,}", re.ASCII)
_GROUPS_COMMA = re.compile(r"[+-]?\d{1,3}(\.\d{3})+,\d*|[+-]?\d{1,3}(\.\d{3}){2,}", re.ASCII)
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(\.\d{3})+(,\d*)?", re.ASCII)
_WORD = re.compile(r"[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?")
_PLAIN = frozenset("0123456789+-.eE")
DECIMALS = ("point", "comma")


@dataclass(frozen=True, eq=False)
class Column:
    """One column as it stands in the file.

    Args:
        name: without the unit. unit : as written, None where there is none.
        values: shape (K,), NaN where there is a gap.
        raw: the same as the file holds it: numbers, text, dates; for time columns.
        problem: why these are no numbers, for a column that nobody may need; else None.
    """

    name: str
    unit: Any
    values: np.ndarray
    raw: Any = None
    problem: str | None = None


def header(text: str) -> tuple[str, str | None]:
    """Split ``T3 [K]`` or ``T3 (K)`` into name and unit."""
    found = _HEADER.match(text)
    if found is None or not found["name"]:
        return text.strip(), None
    unit = found["a"] if found["a"] is not None else found["b"]
    return found["name"], unit.strip() if unit is not None and unit.strip() else None


def cut(cell: Any) -> str:
    """Return a cell for a message: repr, and not more than 40 characters of it."""
    text = str(cell)
    return repr(text if len(text) <= 40 else text[:37] + "...")


# ------------------------------------------------------------------------------ text


def text_columns(
    path: Path, tell: Tell, *, encoding: str | None = None, decimal: str | None = None
) -> tuple[list[Column], list[int]]:
    """Read a text file; return its columns and the line of each row.

    Raises:
        DataError: says line, column and cell.
    """
    if decimal is not None and decimal not in DECIMALS:
        raise DataError(f"decimal {decimal!r}: point or comma is expected")
    text = _decoded(path, tell, encoding)
    lines = text.splitlines()
    first = re.fullmatch(r"\s*sep=(.)\s*", lines[0], re.IGNORECASE) if lines else None
    comments = [(i + 1, x) for i, x in enumerate(lines) if x.startswith("#")]
    kept = [
        (i + 1, x)
        for i, x in enumerate(lines)
        if x.strip() and not x.startswith("#") and not (first and i == 0)
    ]
    if not kept:
        raise DataError(f"{path}: empty")
    delimiter = first[1] if first else _delimiter([x for _, x in kept[:200]])
    rows = _rows(path, kept, delimiter)
    top, names, units, body = _head(path, rows, comments, delimiter, tell)
    width = len(names)
    # each row ends with a separator, the header does not
    if body and all(len(r) == width + 1 and not r[-1].strip() for _, r in body):
        body = [(k, r[:-1]) for k, r in body]
    for line, row in body:
        if len(row) != width:
            raise DataError(
                f"{path}, line {line}: {len(row)} cells, but {width} columns are named; is "
                "the file cut off?"
            )
    cells = [[c.strip() for c in column] for column in zip(*(r for _, r in body), strict=True)]
    cells = cells or [[] for _ in range(width)]
    number = _numbers_as(path, cells, names, delimiter, decimal, tell)
    out = []
    at = [k for k, _ in body]
    for i, name in enumerate(names):
        if not name and i == 0 and looks_like_time(cells[0]):
            name = "time"  # as pandas writes an index of dates
        elif not name and i == 0 and _counts(cells[0]):
            tell(f"{path}, line {top}: the first column, without a name, numbers the rows")
            continue
        if not name:
            if any(cells[i]):
                raise DataError(f"{path}, line {top}: column {i + 1} has no name")
            continue
        place = lambda k, n=name: f"{path}, line {at[k]}, column {n}"  # noqa: E731
        out.append(parsed(name, units[i], cells[i], place, tell, number))
    return out, at


def _counts(cells: Sequence[str]) -> bool:
    """Whether cells are 0, 1, 2, ... or 1, 2, 3, ..."""
    return any(cells == [str(k + n) for k in range(len(cells))] for n in (0, 1))


def _decoded(path: Path, tell: Tell, encoding: str | None) -> str:
    try:
        raw = path.read_bytes()
    except OSError as e:
        raise DataError(f"{path}: cannot be read: {e.strerror or e}") from None
    if encoding is not None:
        try:
            return raw.decode(encoding).removeprefix("\ufeff")
        except (UnicodeError, LookupError) as e:
            raise DataError(f"{path}: not a text file in {encoding} ({e})") from None
    marks = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    if raw.startswith(marks) and len(raw) > 4:
        try:
            text = raw.decode("utf-16")
        except UnicodeDecodeError as e:
            raise DataError(f"{path}: damaged UTF-16 text (byte {e.start})") from None
        tell(f"{path}: not a text file in UTF-8 (byte 0); read as UTF-16")
    else:
        try:
            text = raw.decode("utf-8-sig")
        except UnicodeDecodeError as e:
            what = f"{path}: not a text file in UTF-8 (byte {e.start})"
            if b"\0" in raw:
                raise DataError(f"{what}; give --encoding if it is text") from None
            tell(f"{what}; read as Windows-1252")
            text = raw.decode("cp1252", errors="replace")
    if "\0" in text:
        raise DataError(f"{path}: holds binary data, not CSV")
    return text


def _delimiter(lines: Sequence[str]) -> str:
    """Return the separator that cuts most lines into one number of cells; a blank if none does."""
    best: tuple[tuple[int, int, int], str] = ((0, 0, 0), ",")
    for order, d in enumerate(",;\t|"):
        counts = Counter(x.count(d) for x in lines if d in x)
        if counts:
            n = max(counts.items(), key=lambda c: (c[1], c[0]))[1]
            # ties go to the header's separator, and then to the more usual one
            score = n, lines[0].count(d), -order
            best = max(best, (score, d))
    if best[0][0] == 0 and len(lines) > 1 and len(lines[-1].split()) > 1:
        return " "
    return best[1]


def _rows(path: Path, kept: list[tuple[int, str]], delimiter: str) -> list[tuple[int, list[str]]]:
    if delimiter == " ":
        out = []
        for k, x in kept:
            out.append((k, x.split() if _POINT.match(x.split()[0]) else _WORD.findall(x)))
        return out
    reader = csv.reader((x for _, x in kept), delimiter=delimiter)
    try:
        rows = list(reader)
    except csv.Error as e:
        line = kept[min(reader.line_num, len(kept)) - 1][0]
        raise DataError(f"{path}, line {line}: no CSV file: {e}") from None
    if len(rows) != len(kept):
        raise DataError(f"{path}: a quoted cell runs over several lines; is a quote missing?")
    return [(k, r) for (k, _), r in zip(kept, rows, strict=True)]


def _is_data(row: Sequence[str]) -> bool:
    """Whether half of the cells that hold anything are numbers, dates or gaps' words."""
    full = [c.strip() for c in row if c.strip()]
    hits = sum(_like_number(c) or looks_like_time([c]) for c in full)
    return bool(full) and 2 * hits >= len(full)


def _like_number(cell: str) -> bool:
    return any(p.fullmatch(cell) for p in (_POINT, _COMMA, _GROUPS, _GROUPS_COMMA))


def _head(
    path: Path,
    rows: list[tuple[int, list[str]]],
    comments: list[tuple[int, str]],
    delimiter: str,
    tell: Tell,
) -> tuple[int, list[str], list[str | None], list[tuple[int, list[str]]]]:
    """Line of the names, names, units and the rows below them."""
    start = next((k for k, (_, r) in enumerate(rows) if _is_data(r)), None)
    if start is None:
        start = 1
    elif start == 0:
        said = [(k, x[1:]) for k, x in comments if k < rows[0][0]]
        said_rows = _rows(path, said[-1:], delimiter) if said and said[-1][1].strip() else []
        line, cells = rows[0]
        if not said_rows or len(said_rows[0][1]) != len(cells) or _is_data(said_rows[0][1]):
            raise DataError(f"{path}, line {line}: a line of column names is expected first")
        tell(f"{path}, line {said[-1][0]}: the comment above the numbers is taken as column names")
        rows, start = [said_rows[0], *rows], 1
    above, body = rows[:start], rows[start:]
    units: list[str] = []
    if len(above) > 1 and len(above[-1][1]) == len(above[-2][1]) and _is_units(above[-1][1]):
        units = [c.strip().strip("[]()").strip() for c in above[-1][1]]
        tell(f"{path}, line {above[-1][0]}: taken as a row of units")
        above = above[:-1]
    line, names = above[-1]
    for k, r in above[:-1]:
        if len(r) == len(names) and not (len(r) == 1 or all(not c.strip() for c in r[2:])):
            odd = next((c for c in names if unit_of(c.strip("[]() ")) is None), names[0])
            raise DataError(
                f"{path}, line {line}: neither numbers nor units below the column names of line "
                f"{k}: {cut(odd)}"
            )
    if len(above) > 1:
        tell(f"{path}: lines {above[0][0]} to {above[-2][0]}, above the column names, are left out")
    pairs = [header(h) for h in names]
    named = [
        (n, u or (units[i] or None if i < len(units) else None)) for i, (n, u) in enumerate(pairs)
    ]
    return line, [n for n, _ in named], [u for _, u in named], body


def _is_units(row: Sequence[str]) -> bool:
    full = [c.strip().strip("[]()").strip() for c in row]
    known = [unit_of(c) is not None for c in full]
    spare = [c.lower() in ("", "text", "iso", "none") or is_time_name(c) for c in full]
    return any(known) and all(a or b for a, b in zip(known, spare, strict=True))


def _numbers_as(
    path: Path,
    cells: list[list[str]],
    names: Sequence[str],
    delimiter: str,
    decimal: str | None,
    tell: Tell,
) -> Callable[[str], float | None]:
    """Decide by the whole file what commas and points in numbers are."""
    comma = open_ = groups = groups_comma = point = None
    for i, column in enumerate(cells):
        if _PLAIN.issuperset("".join(column)):  # nothing but points
            if point is None and not any(c.count(".") > 1 for c in column):
                point = next(((i, c) for c in column if "." in c), None)
                continue
            if not any(c.count(".") > 1 for c in column):
                continue
        for c in column:
            if "," in c or c.count(".") > 1:
                if _GROUPS.fullmatch(c):
                    groups = groups or (i, c)
                elif _GROUPS_COMMA.fullmatch(c):
                    groups_comma = groups_comma or (i, c)
                elif _EITHER.fullmatch(c):
                    open_ = open_ or (i, c)
                elif _COMMA.fullmatch(c):
                    comma = comma or (i, c)
            elif "." in c and _POINT.fullmatch(c):
                point = point or (i, c)

    def said(found: tuple[int, str]) -> str:
        return f"{found[1]!r} in column {names[found[0]]}"

    if decimal is None:
        by_comma, by_point = comma or groups_comma, groups or point
        if by_comma and by_point:
            raise DataError(
                f"{path}: {said(by_comma)} has a decimal comma, {said(by_point)} a decimal point: "
                "give --decimal comma or point"
            )
        if open_ and not by_comma and not groups:
            raise DataError(
                f"{path}: {said(open_)} may have a decimal comma or a separator of thousands: "
                "give --decimal comma or point"
            )
        if by_comma:
            tell(f"{path}: decimal commas, such as {said(by_comma)}")
        elif groups:
            tell(f"{path}: commas separate thousands, such as {said(groups)}")
        decimal = "comma" if by_comma else "point"
    if decimal == "point":
        return _point
    return _comma


def _point(cell: str) -> float | None:
    if _POINT.fullmatch(cell):
        return float(cell)
    if _GROUPS.fullmatch(cell) or _EITHER.fullmatch(cell):
        return float(cell.replace(",", ""))
    return None


def _comma(cell: str) -> float | None:
    if "." in cell and not _THOUSANDS.fullmatch(cell):
        return None
    cell = cell.replace(".", "").replace(",", ".")
    return float(cell) if _POINT.fullmatch(cell) else None


# ------------------------------------------------------------------------------ cells


def parsed(
    name: str,
    unit: Any,
    cells: Sequence[Any],
    place: Callable[[int], str],
    tell: Tell,
    number: Callable[[str], float | None] = _point,
) -> Column:
    """Turn cells of text, or of mixed kinds, into a column.

    A column in which numbers prevail must hold nothing else; one without is text, and is refused
    only by who needs it.
    """
    fast = _fast(cells) if number is _point else None
    if fast is not None:
        return Column(name, unit, fast, fast)
    values = np.full(len(cells), np.nan)
    wrong: list[int] = []
    words: list[int] = []
    good = 0
    for k, c in enumerate(cells):
        v = _value(c, number)
        if v is not None and np.isinf(v):
            raise DataError(f"{place(k)}: {cut(c)} is no number (an empty cell is a gap)")
        if v is None:
            is_word = isinstance(c, str) and c.replace(" ", "").lower() in WORDS
            (words if is_word else wrong).append(k)
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
        raise DataError(
            f"{place(wrong[0])}: {cut(cells[wrong[0]])} is no number (an empty cell is a gap)"
        )
    if wrong or not good:
        k = (wrong or words)[0]
        problem = f"{place(k)}: {cut(cells[k])} is no number"
        return Column(name, unit, values * np.nan, raw, problem)
    tell(
        f"{place(words[0])}: {cut(cells[words[0]])} is taken as a gap, as are {len(words)} cells "
        "of this column in all"
    )
    return Column(name, unit, values, values)


def _fast(cells: Sequence[Any]) -> np.ndarray | None:
    """Plain numbers and empty cells, all at once; None where any cell is anything else."""
    try:
        if not _PLAIN.issuperset("".join(cells)):
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
