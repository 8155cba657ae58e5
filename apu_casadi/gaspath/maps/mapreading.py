"""What the readers of map files share: lines, numbers, tables with errors that name the place."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from pathlib import Path

from apu_casadi.core.errors import DataError, MapError
from apu_casadi.gaspath.maps.mapcheck import Finding
from apu_casadi.gaspath.maps.maptable import MapTable, found_text


def file_lines(path: str | Path) -> list[str]:
    """Return the lines of a map file in UTF-8 or Latin-1.

    Raises:
        DataError: it cannot be read, or is empty.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as e:
        raise DataError(f"{path}: cannot read the map file: {e.strerror}") from None
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    if not text.strip():
        raise DataError(f"{path}: the map file is empty")
    return text.splitlines()


def number(text: str, where: str) -> float:
    """Return a cell as a finite number.

    Raises:
        DataError: it is none; ``where`` begins the message.
    """
    try:
        if "_" in text or not text.isascii():  # float() takes 1_0 and digits of other scripts
            raise ValueError
        value = float(text)
    except ValueError:
        hint = " (write decimal points, not commas)" if re.fullmatch(r"-?\d+,\d+", text) else ""
        raise DataError(f"{where}: a number expected, got {text!r}{hint}") from None
    if not math.isfinite(value):
        raise DataError(
            f"{where}: {text!r} is not finite; maps may have no holes: fill the cell "
            f"or remove the whole speed or beta line"
        )
    return value


def table_of(
    path: str | Path, check: bool, where: Callable[[Finding], str], **fields: object
) -> MapTable:
    """Construct the table; its errors name the file, and ``where`` the line of a finding."""
    try:
        table = MapTable(**fields, check=False)  # type: ignore[arg-type]
    except MapError as e:
        raise MapError(f"{path}: {e}") from None
    found = table.implausible()
    if not found:
        return dataclasses.replace(table, check=True)
    if check:
        f = found[0]
        raise MapError(f"{path}{where(f)}, {table.place(f)}: {found_text(table, f)}")
    note = f"accepted with check=False: {len(found)} implausible values or lines, the worst at "
    note += table.place(found[0])
    source = "; ".join(t for t in (table.source, note) if t)
    return dataclasses.replace(table, source=source)


def one_line(text: str) -> str:
    """Return a text without line breaks and repeated blanks."""
    return " ".join(text.split())
