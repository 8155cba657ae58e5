"""What commas, points, blanks and units in the cells of a text file mean, by the whole file."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

from apu_casadi.core.errors import DataError
from apu_casadi.core.tables.columns import (
    COMMA,
    EITHER,
    GROUPS,
    GROUPS_COMMA,
    ODD,
    POINT,
    Tell,
    comma,
    is_gap,
    is_word,
    point,
)
from apu_casadi.core.tables.tablelayout import TableLayout
from apu_casadi.core.units import gauge_of, unit_of

__all__ = ["numbers_as", "ungrouped", "without_unit"]

_BLANK = " \u00a0\u2009\u202f'’"
_SPACED = re.compile(rf"[+-]?\d{{1,3}}(?:[{_BLANK}]\d{{3}})+(?:[.,]\d*)?", re.ASCII)
_TWO_POINTS = re.compile(r"\.[^\n.]*\.")
_WITH_UNIT = re.compile(r"([+-]?[\d.,]*\d[.,]?(?:[eE][+-]?\d+)?)\s*([^\d\s.,+\-:].*)", re.ASCII)


def ungrouped(cells: list[str], what: str, tell: Tell) -> list[str]:
    """Return cells without blanks and apostrophes between thousands: ``36 050.5``, ``36'050.5``."""
    found = next((c for c in cells if ODD.search(c) and _SPACED.fullmatch(c)), None)
    if found is None:
        return cells
    tell(f"{what}: blanks or apostrophes separate thousands, such as {found!r}")
    return [re.sub(f"[{_BLANK}]", "", c) if _SPACED.fullmatch(c) else c for c in cells]


def without_unit(
    cells: list[str], unit: str | None, what: str, tell: Tell
) -> tuple[list[str], str | None]:
    """Return cells without the unit that each of them ends with, and that unit.

    Raises:
        DataError: another unit than the header's.
    """
    first = next((c for c in cells if not (is_gap(c) or is_word(c))), "")
    found = _WITH_UNIT.fullmatch(first)
    if found is None or (unit_of(found[2]) is None and gauge_of(found[2]) is None):
        return cells, unit
    own, out = found[2], []
    for c in cells:
        found = _WITH_UNIT.fullmatch(c)
        if found is not None and found[2] == own:
            out.append(found[1])
        elif is_gap(c) or is_word(c):
            out.append(c)
        else:
            return cells, unit
    if unit is not None and unit_of(unit) != unit_of(own):
        raise DataError(f"{what}: the header says {unit}, the cells {own}: correct one of them")
    tell(f"{what}: the unit stands in the cells: {own}")
    return out, own


def numbers_as(
    path: Path,
    cells: list[list[str]],
    names: Sequence[str],
    layout: TableLayout,
    tell: Tell,
) -> Callable[[str], float | None]:
    """Decide by the whole file what commas and points in numbers are."""
    decimal, remedy = layout.decimal, layout.remedies["decimal"]
    commas = open_ = groups = groups_comma = points = None
    for i, column in enumerate(cells):
        text = "\n".join(column)
        if not (ODD.search(text) or _TWO_POINTS.search(text)):
            points = points or next(((i, c) for c in column if "." in c), None)
            continue
        for c in column:
            if "," in c or c.count(".") > 1:
                if GROUPS.fullmatch(c):
                    groups = groups or (i, c)
                elif GROUPS_COMMA.fullmatch(c):
                    groups_comma = groups_comma or (i, c)
                elif EITHER.fullmatch(c):
                    open_ = open_ or (i, c)
                elif COMMA.fullmatch(c):
                    commas = commas or (i, c)
            elif "." in c and POINT.fullmatch(c):
                points = points or (i, c)

    def said(found: tuple[int, str]) -> str:
        return f"{found[1]!r} in column {names[found[0]]}"

    if decimal is None:
        by_comma, by_point = commas or groups_comma, groups or points
        if by_comma and by_point:
            raise DataError(
                f"{path}: {said(by_comma)} has a decimal comma, {said(by_point)} a decimal point: "
                f"{remedy}"
            )
        if open_ and not by_comma and not groups:
            raise DataError(
                f"{path}: {said(open_)} may have a decimal comma or a separator of thousands: "
                f"{remedy}"
            )
        if by_comma:
            tell(f"{path}: decimal commas, such as {said(by_comma)}")
        elif groups:
            tell(f"{path}: commas separate thousands, such as {said(groups)}")
        decimal = "comma" if by_comma else "point"
    return point if decimal == "point" else comma
