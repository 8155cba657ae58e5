"""What the readers of map files share: lines, numbers, tables with errors that name the place.

Many maps reach PR <= 1 at low speed or near choke, which no operating point of an engine needs and
the surface cannot hold: :func:`trimmed` leaves out the outermost lines.
"""

from __future__ import annotations

import dataclasses
import math
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from apu_casadi.core.errors import ApuWarning, DataError, MapError
from apu_casadi.core.tables.numbertable import table_text
from apu_casadi.gaspath.maps.mapcheck import Finding
from apu_casadi.gaspath.maps.maptable import MapTable, found_text


def file_lines(path: str | Path) -> list[str]:
    """Return the lines of a map file in UTF-8, UTF-16 or Windows-1252.

    Raises:
        DataError: it cannot be read, or is empty.
    """
    try:
        raw = Path(path).read_bytes()
    except OSError as e:
        raise DataError(f"{path}: cannot read the map file: {e.strerror}") from None
    if raw.startswith((b"PAR1", b"CDF", b"\x89HDF")):
        raise DataError(f"{path}: Parquet and netCDF are no map files: export the map as CSV")
    text = table_text(raw, path)
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
        return table.found_plausible()
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


def trimmed(
    path: str | Path, N: np.ndarray, beta: np.ndarray, PR: np.ndarray, trim: bool | None
) -> tuple[slice, slice, str]:
    """Return the rows and columns to keep so that PR > 1, and a remark on what is left out.

    With ``trim`` None a warning tells what is left out; nothing is where that would be more than
    half of the table, since then a cell is wrong and not the map's end.  False keeps all.
    """
    r0, r1, c0, c1 = 0, N.size, 0, beta.size
    everything = slice(r0, r1), slice(c0, c1), ""
    if trim is False:
        return everything
    bad = ~(PR > 1)
    while r0 < r1 and c0 < c1 and bad[r0:r1, c0:c1].any():
        part = bad[r0:r1, c0:c1]
        share = [part[0].mean(), part[-1].mean(), part[:, 0].mean(), part[:, -1].mean()]
        step = np.eye(4, dtype=int)[int(np.argmax(share))]
        r0, r1, c0, c1 = r0 + step[0], r1 - step[1], c0 + step[2], c1 - step[3]
    out = [f"N = {v:g}" for v in (*N[:r0], *N[r1:])]
    out += [f"beta = {v:g}" for v in (*beta[:c0], *beta[c1:])]
    if not out or (trim is None and 2 * (r1 - r0) * (c1 - c0) < PR.size):
        return everything
    note = f"left out, since PR <= 1 there: {', '.join(out)}"
    if trim is None:
        warnings.warn(ApuWarning(f"{path}: {note}"), stacklevel=4)
    return slice(r0, r1), slice(c0, c1), note
