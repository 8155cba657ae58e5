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

from apu_casadi.core.errors import DataError
from apu_casadi.core.tables.columns import (
    Column,
    Tell,
    cut,
    is_gap,
    is_word,
    like_number,
    parsed,
)
from apu_casadi.core.tables.numbertext import numbers_as, ungrouped, without_unit
from apu_casadi.core.tables.tablelayout import TableLayout
from apu_casadi.core.tables.timestamps import is_time_name, looks_like_time
from apu_casadi.core.units import gauge_of, header, unit_of

__all__ = ["columns_of", "decoded", "text_columns"]

Row = tuple[int, list[str]]
#: Anything but numbers with a point or a comma.
_ODD = re.compile(r"[^0-9+\-.,eE\n]")
_MINUS = re.compile(r"\u2212(?=[\d.,])")
_COMMENT = re.compile(r"^\s*(#|%|//|;|!|')+\s*")


def text_columns(
    path: Path, tell: Tell, layout: TableLayout, known: Callable[[str], bool]
) -> tuple[list[Column], list[int]]:
    """Read a text file; return its columns and the line of each row.

    Args:
        path, tell, layout: the file, who is told, and what is given.
        known: tells whether the model knows a name, to find the line of names.

    Raises:
        DataError: says line, column and cell.
    """
    try:
        raw = path.read_bytes()
    except OSError as e:
        raise DataError(f"{path}: cannot be read: {e.strerror or e}") from None
    return columns_of(path, decoded(path, raw, tell, layout), tell, layout, known)


def columns_of(
    path: Path,
    text: str,
    tell: Tell,
    layout: TableLayout,
    known: Callable[[str], bool],
    words: dict[str, list[str]] | None = None,
) -> tuple[list[Column], list[int]]:
    """Read the text of a file; as :func:`text_columns`; ``words`` takes the cells by column."""
    if _MINUS.search(text):
        tell(f"{path}: the typographic minus sign (U+2212) is read as a minus")
        text = _MINUS.sub("-", text)
    lines = re.split(r"\r\n|\r|\n", text)
    first = re.fullmatch(r'\s*"?sep=(.)"?\s*', lines[0], re.IGNORECASE) if lines else None
    comments = [(i + 1, x) for i, x in enumerate(lines) if x.startswith("#")]
    kept = [
        (i + 1, x)
        for i, x in enumerate(lines)
        if x.strip() and not x.startswith("#") and not (first and i == 0)
    ]
    if not kept:
        raise DataError(f"{path}: empty")
    delimiter = layout.delimiter or (first[1] if first else _delimiter([x for _, x in kept]))
    rows = _rows(path, kept, delimiter)
    head = _given_head(path, rows, layout) or _found_head(
        _Head(path, rows, comments, delimiter, tell, layout, known)
    )
    top, names, units, body = head
    if layout.pads_rows:
        body = [(k, [*r, *[""] * (len(names) - len(r))]) for k, r in body]
    body = _whole(path, body, names, tell)
    cells = [[c.strip() for c in column] for column in zip(*(r for _, r in body), strict=True)]
    cells = cells or [[] for _ in names]
    for i, column in enumerate(cells):
        if _ODD.search("\n".join(column)):
            what = f"{path}, column {names[i] or i + 1}"
            column = ["" if layout.means_gap(c) else c for c in column]
            column = ungrouped(column, what, tell) if delimiter != " " else column
            cells[i], units[i] = without_unit(column, units[i], what, tell)
    number = numbers_as(path, cells, names, layout, tell)
    out = []
    at = [k for k, _ in body]
    for i, name in enumerate(names):
        if not name and layout.names:
            continue
        if not name and i == 0 and looks_like_time(cells[0]):
            name = "time"  # as pandas writes an index of dates
        elif not name and i == 0 and _counts(cells[0]):
            tell(f"{path}, line {top}: the first column, without a name, numbers the rows")
            continue
        if not name:
            if any(cells[i]) and not layout.skips_unnamed:
                raise DataError(
                    f"{path}, line {top}: column {i + 1} has no name: {layout.remedies['name']}"
                )
            continue
        if words is not None:
            words[name] = cells[i]
        place = lambda k, n=name: f"{path}, line {at[k]}, column {n}"  # noqa: E731
        out.append(parsed(name, units[i], cells[i], place, tell, number, layout.remedies["gap"]))
    return out, at


def _counts(cells: Sequence[str]) -> bool:
    """Whether cells are 0, 1, 2, ... or 1, 2, 3, ..."""
    return any(cells == [str(k + n) for k in range(len(cells))] for n in (0, 1))


# ------------------------------------------------------------------------------ text and rows


#: First bytes of files that people rename, and what they are.
OTHERS = {
    b"PAR1": "a Parquet file does: let its name end in .parquet",
    b"\x89HDF": "a netCDF file does: let its name end in .nc",
    b"CDF": "a netCDF file does: let its name end in .nc",
    b"PK\x03\x04": "a workbook or an archive does: export its table as CSV",
    b"\x1f\x8b": "a compressed file does: unpack it",
}


def decoded(path: Any, raw: bytes, tell: Tell, layout: TableLayout) -> str:
    """Return the text of a file: UTF-8, UTF-16 and UTF-32 with a mark, else Windows-1252.

    Raises:
        DataError: damaged, or no text.
    """
    for begin, what in OTHERS.items():
        if raw.startswith(begin):
            raise DataError(f"{path}: it begins as {what}")
    encoding, remedy = layout.encoding, layout.remedies["encoding"]
    if encoding is not None:
        try:
            return raw.decode(encoding).removeprefix("\ufeff")
        except (UnicodeError, LookupError) as e:
            raise DataError(f"{path}: not a text file in {encoding} ({e})") from None
    marks = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    wide = raw.startswith(codecs.BOM_UTF32_LE) or raw.startswith(codecs.BOM_UTF32_BE)
    if wide or (raw.startswith(marks) and len(raw) > 4):
        name = "utf-32" if wide else "utf-16"
        try:
            text = raw.decode(name)
        except UnicodeDecodeError as e:
            raise DataError(f"{path}: damaged {name.upper()} text (byte {e.start})") from None
        tell(f"{path}: not a text file in UTF-8 (byte 0); read as {name.upper()}")
    else:
        try:
            text = raw.decode("utf-8-sig")
        except UnicodeDecodeError as e:
            what = f"{path}: not a text file in UTF-8 (byte {e.start})"
            if b"\0" in raw:
                raise DataError(f"{what}; {remedy.format('')} if it is text") from None
            tell(f"{what}; read as Windows-1252")
            text = raw.decode("cp1252", errors="replace")
    if "\0" in text:
        half = next((n for n, k in (("le", 1), ("be", 0)) if not any(raw[k:200:2])), None)
        hint = remedy.format(f" utf-16-{half}")
        hint = f"; if it is UTF-16 without a mark, {hint}" if half else ""
        raise DataError(f"{path}: holds binary data, not CSV{hint}")
    return text


def _delimiter(lines: Sequence[str]) -> str:
    """Return the separator that cuts most lines into one number of cells; a blank if none does."""
    lines = [*lines[:200], *lines[-20:]] if len(lines) > 220 else lines
    best: tuple[tuple[int, int, int], str] = ((0, 0, 0), ",")
    for order, d in enumerate(",;\t|"):
        counts = Counter(x.count(d) for x in lines if d in x)
        if counts:
            n = max(counts.items(), key=lambda c: (c[1], c[0]))[1]
            # ties go to the header's separator, and then to the more usual one
            score = n, lines[0].count(d), -order
            best = max(best, (score, d))
    blanks = Counter(len(x.split()) for x in lines)
    (width, n), *_ = blanks.most_common(1) or [(0, 0)]
    # numbers with decimal commas between blanks; the line of names has no commas
    commas = best[1] == "," and best[0][1] == 0 and n == len(lines) > 1 and width > 1
    if commas or (best[0][0] == 0 and len(lines) > 1 and len(lines[-1].split()) > 1):
        return " "
    return best[1]


_NAME = re.compile(r"[^\s\[(]+(?:\s*[\[(][^\])]*[\])])?")


def _rows(path: Path, kept: list[tuple[int, str]], delimiter: str) -> list[Row]:
    if delimiter == " ":
        width = Counter(len(x.split()) for _, x in kept).most_common(1)[0][0]

        def cut_at_blanks(x: str) -> list[str]:
            cells = x.split()
            return cells if like_number(cells[0]) or len(cells) == width else _NAME.findall(x)

        return [(k, cut_at_blanks(x)) for k, x in kept]
    reader = csv.reader((x for _, x in kept), delimiter=delimiter)
    try:
        rows = list(reader)
    except csv.Error as e:
        line = kept[min(reader.line_num, len(kept)) - 1][0]
        raise DataError(f"{path}, line {line}: no CSV file: {e}") from None
    if len(rows) != len(kept):
        raise DataError(f"{path}: a quoted cell runs over several lines; is a quote missing?")
    return [(k, r) for (k, _), r in zip(kept, rows, strict=True)]


def _whole(path: Path, body: list[Row], names: Sequence[str], tell: Tell) -> list[Row]:
    """Return the rows of data, all of one width, without what stands below them."""
    width = len(names)
    # each row ends with a separator, the header does not
    if body and all(len(r) == width + 1 and not r[-1].strip() for _, r in body):
        body = [(k, r[:-1]) for k, r in body]
    end = len(body)
    while end and len(body[end - 1][1]) != width and not any(map(_of_data, body[end - 1][1])):
        end -= 1
    if end < len(body) and any(c.strip() for _, r in body[end:] for c in r):
        tell(f"{path}: {_span(body[end][0], body[-1][0])} below the data left out")
        body = body[:end]
    empty = [k for k, r in body if not "".join(r).strip()] if width > 1 else []
    if empty:
        tell(f"{path}, line {empty[0]}: an empty row is left out, of {len(empty)} in all")
        body = [(k, r) for k, r in body if any(c.strip() for c in r)]
    for line, row in body:
        if len(row) != width:
            twice = width < len(row) <= 2 * width and all(len(r) > width for _, r in body)
            why = (
                "are commas decimal commas as well as separators? export with ';' between cells"
                if twice
                else "is the file cut off? complete the line, or delete it"
                if len(row) < width
                else "a cell too many: correct the line, or delete it"
            )
            raise DataError(
                f"{path}, line {line}: {len(row)} cells, but {width} columns are named; {why}"
            )
    return body


# ------------------------------------------------------------------------------ head


def _of_data(cell: str) -> bool:
    return like_number(cell.strip()) or looks_like_time([cell])


@dataclass(frozen=True)
class _Head:
    """What the search for the lines above the data goes by."""

    path: Path
    rows: list[Row]
    comments: list[tuple[int, str]]
    delimiter: str
    tell: Tell
    layout: TableLayout
    known: Callable[[str], bool]

    def start(self) -> int | None:
        """Index of the first row of data, None if there is none.

        A row of data has numbers, dates or words for gaps where the last rows have them.
        """
        rows = [r for _, r in self.rows]
        some = rows if len(rows) < 200 else [*rows[:100], *rows[-100:]]
        width = Counter(map(len, some)).most_common(1)[0][0]
        last = [r for r in some if len(r) == width]
        last = last[len(last) // 2 :] if len(last) > 1 else last
        for some in (last, last[-1:]):  # the latter where names and units are most of the rows
            numeric = [i for i in range(width) if _prevails([r[i] for r in some])]
            if numeric:
                break
        for k, r in enumerate(rows[: max(len(rows) - 1, 1) if len(rows) > 1 else 1]):
            if len(r) == width and _prevails([r[i] for i in numeric]):
                return k
        k = len(rows) - 1
        return (
            k if k and len(rows[k]) == width and _prevails([rows[k][i] for i in numeric]) else None
        )


def _prevails(cells: Sequence[str]) -> bool:
    """Whether more cells are numbers or times than are not, gaps left out."""
    full = [c for c in cells if not (is_gap(c) or is_word(c))]
    return bool(full) and 2 * sum(map(_of_data, full)) > len(full)


def _given_head(
    path: Path, rows: list[Row], layout: TableLayout
) -> tuple[int, list[str], list[str | None], list[Row]] | None:
    """Names and units by the lines that were given; None if none was."""
    if layout.names_line is None and layout.data_line is None:
        return None
    by_line = dict(rows)
    for what in ("names_line", "units_line"):
        line = getattr(layout, what)
        if line is not None and line not in by_line:
            raise DataError(f"{path}: {what} = {line}: that line is empty, a comment or not there")
    head = [n for n in (layout.names_line, layout.units_line) if n is not None]
    start = layout.data_line or max(head) + 1
    body = [(k, r) for k, r in rows if k >= start]
    if head and max(head) >= start:
        raise DataError(f"{path}: the data begin in line {start}, above the line of names or units")
    if layout.names_line is None:
        names, units = _by_option(path, body[0] if body else (start, []), layout)
        return start, names, units, body
    pairs = [header(h) for h in by_line[layout.names_line]]
    units = [u for _, u in pairs]
    if layout.units_line is not None:
        below = [_bare(c) for c in by_line[layout.units_line]]
        units = [
            u or (b or None) for u, b in zip(units, [*below, *[""] * len(units)], strict=False)
        ]
    return layout.names_line, [n for n, _ in pairs], units, body


def _by_option(path: Path, row: Row, layout: TableLayout) -> tuple[list[str], list[str | None]]:
    names = list(layout.names)
    if len(names) != len(row[1]) - (len(row[1]) == len(names) + 1 and not row[1][-1].strip()):
        raise DataError(
            f"{path}, line {row[0]}: {len(row[1])} cells, but {len(names)} names are given: give "
            "one for each column in order, '' for one to leave out"
        )
    units = layout.units or [""] * len(names)
    return names, [u or None for u in units]


def _found_head(h: _Head) -> tuple[int, list[str], list[str | None], list[Row]]:
    """Line of the names, names, units and the rows below them."""
    path, rows, tell = h.path, h.rows, h.tell
    at = next((k for k, (_, r) in enumerate(rows) if any(_known(c, h.known) for c in r)), None)
    if h.layout.known_head and at is not None and not h.layout.names:
        below = rows[at + 1] if at + 1 < len(rows) else None
        if below and (all(map(_of_data, filter(None, below[1]))) or not _is_units(below[1])):
            below = None  # 1 is a number first, then a unit
        _tell_left_out(h, rows[:at], [rows[at]])
        return *_named(h, rows[at], below), rows[at + 1 + (below is not None) :]
    start = h.start()
    if h.layout.names:
        start = start or 0
        if start:
            tell(f"{path}: {_span(rows[0][0], rows[start - 1][0])} above the data left out")
        names, units = _by_option(path, rows[start], h.layout)
        return rows[start][0], names, units, rows[start:]
    if start is None:
        start = 1
    elif start == 0:
        said = [(k, x[1:]) for k, x in h.comments if k < rows[0][0]]
        said_rows = _rows(path, said[-1:], h.delimiter) if said and said[-1][1].strip() else []
        line, cells = rows[0]
        if (
            not said_rows
            or len(said_rows[0][1]) != len(cells)
            or any(map(_of_data, said_rows[0][1]))
        ):
            raise DataError(
                f"{path}, line {line}: a line of column names is expected first: "
                f"{h.layout.remedies['head']}"
            )
        tell(f"{path}, line {said[-1][0]}: the comment above the numbers is taken as column names")
        rows, start = [said_rows[0], *rows], 1
    above, body = rows[:start], rows[start:]
    width = max(len(r) for _, r in (body or above)[:50])
    fit = [r for r in above if width - 1 <= len(r[1]) <= width and (width > 1 or len(above) == 1)]
    fit = fit or above[-1:]
    if not any(_is_units(r) for _, r in fit) or len(fit) == 1:
        named, below = _names_without_units(h, fit)
    else:
        below = next(r for r in reversed(fit) if _is_units(r[1]))
        others = [r for r in fit if r is not below]
        named = max(reversed(others), key=lambda r: sum(_known(c, h.known) for c in r[1]))
        tell(f"{path}, line {below[0]}: taken as a row of units")
    _tell_left_out(h, above, [named, below])
    return *_named(h, named, below), body


def _named(h: _Head, named: Row, below: Row | None) -> tuple[int, list[str], list[str | None]]:
    """Line of the names, names and units."""
    cells = named[1]
    stripped = _COMMENT.sub("", cells[0])
    if stripped and (h.known(header(stripped)[0]) or is_time_name(header(stripped)[0])):
        cells = [stripped, *cells[1:]]
    pairs = [header(c) for c in cells]
    row = ["" if _bare(c) == "-" else _bare(c) for c in below[1]] if below else []
    units = [u or ((row[i] or None) if i < len(row) else None) for i, (_, u) in enumerate(pairs)]
    return named[0], [n for n, _ in pairs], units


def _names_without_units(h: _Head, fit: list[Row]) -> tuple[Row, None]:
    """The line of names where no line holds units: the lowest, if those above are no names."""
    line, names = fit[-1]
    for k, r in fit[:-1]:
        if len(r) == len(names) and not (len(r) == 1 or all(not c.strip() for c in r[2:])):
            odd = next((c for c in names if unit_of(_bare(c)) is None), names[0])
            raise DataError(
                f"{h.path}, line {line}: neither numbers nor units below the column names of line "
                f"{k}: {cut(odd)}: {h.layout.remedies['above']}"
            )
    return fit[-1], None


def _tell_left_out(h: _Head, above: list[Row], taken: list[Row | None]) -> None:
    left = [k for k, r in above if not any(t is not None and k == t[0] for t in taken)]
    names = taken[0]
    if left and names is not None and left[-1] < names[0]:
        one = f"line {left[0]}, above the column names, is"
        several = f"lines {left[0]} to {left[-1]}, above the column names, are"
        h.tell(f"{h.path}: {one if len(left) == 1 else several} left out")
    elif left and taken[1] is None:
        raise DataError(
            f"{h.path}, line {left[-1]}: what stands between the column names of line "
            f"{names[0] if names else 0} and the data is not understood; "
            f"{h.layout.remedies['between']}"
        )
    elif left:
        h.tell(f"{h.path}: left out above the data: line {', '.join(map(str, left[:6]))}")


def _span(first: int, last: int) -> str:
    return f"line {first}" if first == last else f"lines {first} to {last}"


def _known(cell: str, known: Callable[[str], bool]) -> bool:
    name = header(_COMMENT.sub("", cell))[0]
    return known(name) or is_time_name(name)


def _bare(cell: str) -> str:
    """A unit without brackets around it."""
    text = cell.strip()
    paired = text[:1] + text[-1:] in ("[]", "()", "{}", "<>")
    return text[1:-1].strip() if paired else text


def _is_units(row: Sequence[str]) -> bool:
    full = [_bare(c) for c in row]
    known = [unit_of(c) is not None or gauge_of(c) is not None for c in full]
    spare = [
        c.lower() in ("", "text", "iso", "none") or is_time_name(c) or _is_form(c) for c in full
    ]
    return any(known) and all(a or b for a, b in zip(known, spare, strict=True))


def _is_form(cell: str) -> bool:
    """Whether a cell tells how times are written: ``hh:mm:ss.fff``, ``YYYY-MM-DD``."""
    return bool(re.fullmatch(r"[yYMmDdHhSsfF:./\- T]{4,}", cell)) and "m" in cell.lower()
