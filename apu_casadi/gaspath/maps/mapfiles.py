"""Component maps as tables, and their files: plain CSV, and the GasTurb/GSP text layout.

A compressor and a turbine have one form here: relative corrected speed N and an auxiliary
coordinate beta give corrected flow W, pressure ratio PR (above 1: outlet/inlet in a compressor,
inlet/outlet in a turbine) and isentropic efficiency eta.  The units of N and W are those of the
file, since only ratios to a design point are used (:mod:`apu_casadi.gaspath.maps.scaledmaps`).

**CSV.**  Comment lines ``# key: value`` carry ``kind`` (``compressor`` or ``turbine``, required),
``name``, ``source``, ``N_ref`` and ``beta_ref`` (the design point on the map); other comments are
free text.  Then a header and one row per grid point, speed line by speed line, N and beta rising,
the same beta values on every line; for a compressor a second header with the surge line, W
rising::

    # kind: compressor
    N,beta,W,PR,eta
    0.8,0,14.2,2.9,0.77
    ...
    W_surge,PR_surge
    4.8,1.28
    ...

Columns may stand in any order; empty lines and empty cells at the end of a line, as spreadsheets
write them, are ignored.

**GasTurb/GSP.**  A title line that begins with ``99``, a line ``Reynolds: ...``, then sections
``Mass Flow``, ``Efficiency``, ``Pressure Ratio`` and ``Surge Line``.  Each section is a table
whose first number codes its size, ``rows.columns`` with three digits for the columns: ``11.016``
is 11 rows of 16 numbers, 10 speed lines by 15 beta values.  Numbers follow row by row, wrapped at
will: first the code and the beta values, then each speed and its values.  ``Surge Line`` has two
rows: code and flows, any number and pressure ratios.  Turbines have ``Min Pressure Ratio`` and
``Max Pressure Ratio`` instead (two rows: code and speeds, any number and values), and
PR = min + beta (max - min).  The Reynolds line is kept in the table's ``source`` and not applied:
:class:`apu_casadi.gaspath.maps.scaledmaps.MapCalibration` has its own Reynolds term.
"""

from __future__ import annotations

import csv
import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib import resources
from itertools import pairwise
from pathlib import Path

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import DataError, MapError, nearest
from apu_casadi.core.sharing import once
from apu_casadi.gaspath.maps.mapcheck import Finding
from apu_casadi.gaspath.maps.maptable import (
    GRID_COLUMNS,
    SURGE_COLUMNS,
    MapTable,
    fault,
    found_text,
)

SHIPPED = ("axi5", "lpt2269")


def read_map(path: str | Path, *, trim: bool = False, check: bool = True) -> MapTable:
    """Read a map file; the layout (CSV or GasTurb/GSP) is told from the content.

    Args:
        path: the file.
        trim: leave out the edge lines of a GasTurb/GSP map that reach PR <= 1, as in
            :func:`read_map_gasturb`; without effect on CSV files, whose rows are easily removed.
        check: False accepts numbers that do not go with their neighbours
            (:mod:`apu_casadi.gaspath.maps.mapcheck`); the table's ``source`` says so.

    Raises:
        DataError: the file is missing, damaged, or in no layout known here.
        MapError: the numbers are readable but make no map.
    """
    lines = _lines(path)
    words = [text.strip().lower() for text in lines]
    first = next((w for w in words if w and not w.startswith("#")), "")
    if re.match(r"99(\s|$)", first) or any(_section(w) for w in words):
        return read_map_gasturb(path, trim=trim, check=check)
    if "," in first or ";" in first:
        return read_map_csv(path, check=check)
    raise DataError(
        f"{path}: neither a CSV map (header {','.join(GRID_COLUMNS)}) nor the GasTurb/GSP layout "
        f"(title '99 ...', sections such as 'Mass Flow'); see "
        "apu_casadi.gaspath.maps.mapfiles for both"
    )


def _lines(path: str | Path) -> list[str]:
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


def _number(text: str, where: str) -> float:
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


def _table(
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


# ---------------------------------------------------------------------------------------------
# CSV


def read_map_csv(path: str | Path, *, check: bool = True) -> MapTable:
    """Read a map from the plain CSV layout that the module's text describes.

    ``check`` as in :func:`read_map`.

    Raises:
        DataError: missing key or column, cell that is no number, ragged grid (file, line, column).
        MapError: values outside their range, fewer than 4 lines, order not rising.
    """
    meta: dict[str, tuple[str, int]] = {}
    grid: list[tuple[int, list[float]]] = []
    surge: list[tuple[int, list[float]]] = []
    columns: list[str] = []  # of the block being read; empty before the first header
    rows = grid
    for k, cells in _csv_rows(path):
        row = [c.strip() for c in cells]
        while row and not row[-1]:
            row.pop()
        if not row:
            continue
        if row[0].startswith("#"):
            key, colon, value = ", ".join(row).lstrip("# ").partition(":")
            if colon:
                meta.setdefault(key.strip().lower(), (value.strip(), k))
            continue
        if not columns:
            columns, rows = _csv_header(path, k, row, GRID_COLUMNS), grid
            continue
        if "W_surge" in row or "PR_surge" in row:
            columns, rows = _csv_header(path, k, row, SURGE_COLUMNS), surge
            continue
        if len(row) != len(columns):
            raise DataError(
                f"{path}, line {k}: {len(columns)} values expected ({','.join(columns)}), "
                f"got {len(row)}"
            )
        values = {}
        for name, cell in zip(columns, row, strict=True):
            values[name] = _number(cell, f"{path}, line {k}, column {name}")
            if wrong := fault(name, values[name]):
                raise MapError(f"{path}, line {k}, column {name}: {cell}; {wrong}")
        wanted = GRID_COLUMNS if rows is grid else SURGE_COLUMNS
        rows.append((k, [values[name] for name in wanted]))
    if not grid:
        raise DataError(f"{path}: no map rows; a header {','.join(GRID_COLUMNS)} and rows expected")
    if "kind" not in meta:
        raise DataError(f"{path}: no line '# kind: compressor' or '# kind: turbine'; add one")
    N, beta = _csv_axes(path, grid)
    W, PR, eta = (np.array([r[c] for _, r in grid]).reshape(N.size, -1) for c in (2, 3, 4))
    for (ka, a), (kb, b) in pairwise(surge):
        if b[0] <= a[0]:
            raise MapError(
                f"{path}, line {kb}, column W_surge: {b[0]:g} does not rise above {a[0]:g} of "
                f"line {ka}; sort the surge line by flow"
            )
    ref = {}
    for key in ("N_ref", "beta_ref"):
        text, k = meta.get(key.lower(), ("", 0))
        ref[key] = _number(text, f"{path}, line {k}, {key}") if text else None

    def where(f: Finding) -> str:
        if f.name == "PR_surge":
            return f", line {surge[f.i][0]}"
        first, last = max(f.i, 0) * beta.size + max(f.j, 0), -1
        if f.j < 0:
            last = first + beta.size - 1
        elif f.i < 0:
            last = first + (N.size - 1) * beta.size
        lines = (
            f"line {grid[first][0]}" if last < 0 else f"lines {grid[first][0]} to {grid[last][0]}"
        )
        return f", {lines}, column {f.name}"

    return _table(
        path,
        check,
        where,
        kind=meta["kind"][0].lower(),
        N=N,
        beta=beta,
        W=W,
        PR=PR,
        eta=eta,
        surge_W=np.array([r[0] for _, r in surge]) if surge else None,
        surge_PR=np.array([r[1] for _, r in surge]) if surge else None,
        **ref,
        name=meta.get("name", (Path(path).stem, 0))[0],
        source=meta.get("source", ("", 0))[0],
    )


def _csv_rows(path: str | Path) -> Iterator[tuple[int, list[str]]]:
    """Return the cells of each line with its number.

    Raises:
        DataError: a cell that is longer than any number, such as one behind an open quotation mark.
    """
    reader, k = csv.reader(_lines(path)), 0
    while True:
        k += 1
        try:
            row = next(reader, None)
        except csv.Error as e:
            raise DataError(f"{path}, line {k}: no row of numbers; {e}") from None
        if row is None:
            return
        yield k, row


def _csv_header(path: str | Path, k: int, row: list[str], wanted: Sequence[str]) -> list[str]:
    if len(row) == 1 and ";" in row[0]:
        raise DataError(f"{path}, line {k}: cells must be separated by commas, not semicolons")
    missing = [c for c in wanted if c not in row]
    unknown = [c for c in row if c not in wanted]
    if missing:
        near = "; ".join(f"unknown {c!r} {nearest(c, wanted)}" for c in unknown)
        raise DataError(
            f"{path}, line {k}: column {', '.join(missing)} missing in the header "
            f"{','.join(row)!r}" + (f"; {near}" if near else "")
        )
    if unknown or len(set(row)) < len(row):
        raise DataError(
            f"{path}, line {k}: the header must hold {','.join(wanted)}, each once, got "
            f"{','.join(row)!r}"
        )
    return row


def _csv_axes(
    path: str | Path, grid: list[tuple[int, list[float]]]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the speeds and the betas of a regular grid; name the line that breaks it."""
    lines: list[tuple[float, list[tuple[int, float]]]] = []
    for k, r in grid:
        if not lines or lines[-1][0] != r[0]:
            if lines and r[0] < lines[-1][0]:
                raise MapError(
                    f"{path}, line {k}, column N: {r[0]:g} follows {lines[-1][0]:g}; speeds must "
                    f"rise: sort the rows by N, then by beta"
                )
            lines.append((r[0], []))
        elif r[1] <= lines[-1][1][-1][1]:
            raise MapError(
                f"{path}, line {k}, column beta: {r[1]:g} follows {lines[-1][1][-1][1]:g}; beta "
                f"must rise along a speed line: sort the rows by N, then by beta"
            )
        lines[-1][1].append((k, r[1]))
    first = [b for _, b in lines[0][1]]
    for N, points in lines:
        if len(points) != len(first):
            raise DataError(
                f"{path}, line {points[-1][0]}: speed line N = {N:g} has {len(points)} points, the "
                f"first line has {len(first)}; every speed line needs the same beta values"
            )
        for (k, b), b0 in zip(points, first, strict=True):
            if b != b0:
                raise DataError(
                    f"{path}, line {k}, column beta: {b:g}, but {b0:g} on the first speed line; "
                    f"every speed line needs the same beta values"
                )
    return np.array([N for N, _ in lines]), np.array(first)


def write_map_csv(table: MapTable, path: str | Path) -> None:
    """Write a table in the CSV layout; :func:`read_map_csv` returns the same numbers.

    Raises:
        DataError: the file cannot be written.
    """
    out = [f"# kind: {table.kind}", f"# name: {_one_line(table.name)}"]
    if table.source:
        out.append(f"# source: {_one_line(table.source)}")
    for key in ("N_ref", "beta_ref"):
        ref = getattr(table, key)
        if ref is not None:
            out.append(f"# {key}: {float(ref)!r}")
    out.append(",".join(GRID_COLUMNS))
    for i, j in np.ndindex(table.W.shape):
        row = (table.N[i], table.beta[j], table.W[i, j], table.PR[i, j], table.eta[i, j])
        out.append(",".join(repr(float(v)) for v in row))
    if table.surge_W is not None and table.surge_PR is not None:
        out.append(",".join(SURGE_COLUMNS))
        for W, PR in zip(table.surge_W, table.surge_PR, strict=True):
            out.append(f"{float(W)!r},{float(PR)!r}")
    refusal = "cannot write the map file"
    files.write_text(path, "\n".join(out) + "\n", refusal=refusal, make_folder=False)


def _one_line(text: str) -> str:
    return " ".join(text.split())


# ---------------------------------------------------------------------------------------------
# GasTurb/GSP text layout

_SECTIONS = (
    "Mass Flow",
    "Efficiency",
    "Pressure Ratio",
    "Surge Line",
    "Min Pressure Ratio",
    "Max Pressure Ratio",
)


def _section(word: str) -> str | None:
    """Return the section that a line opens, or None; a section line is the bare name."""
    plain = " ".join(word.strip().rstrip(":").split()).lower()
    return next((s for s in _SECTIONS if s.lower() == plain), None)


@dataclass
class _Block:
    """One section of a GasTurb file: its numbers, and the file line of each."""

    title: str
    line: int
    values: list[float] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    array: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    def where(self, i: int, j: int) -> int:
        """Return the file line of the number in row i, column j."""
        return self.lines[i * self.array.shape[1] + j]


def read_map_gasturb(path: str | Path, *, trim: bool = False, check: bool = True) -> MapTable:
    """Read a map from the GasTurb/GSP text layout that the module's text describes.

    The file with a surge line and a pressure ratio table is a compressor, the one with minimum and
    maximum pressure ratios a turbine.  A first surge point at zero flow or at PR = 1 (the origin)
    is left out: the surge line is continued as a power law there.

    Args:
        path: the file.
        trim: many compressor maps of this layout reach PR <= 1 at low speed or near choke, which no
            operating point of an engine needs and the surface cannot hold.  True leaves out the
            outermost speed or beta lines, each time the one with the largest share of such points,
            until none is left, and says so in the table's ``source``; False raises.
        check: as in :func:`read_map`.

    Raises:
        DataError: missing, doubled, truncated or overlong section, or a cell that is no number.
        MapError: values outside their range, fewer than 4 lines, order not rising.
    """
    head: list[str] = []
    blocks: dict[str, _Block] = {}
    block: _Block | None = None
    for k, text in enumerate(_lines(path), 1):
        title = _section(text)
        if title:
            if title in blocks:
                raise DataError(f"{path}, line {k}: second section {title!r}, remove one")
            block = blocks[title] = _Block(title, k)
        elif block is None:
            if text.strip():
                head.append(_one_line(text))
        else:
            for cell in text.split():
                where = f"{path}, line {k}, section {block.title!r}"
                if not block.values or len(block.values) < _size(path, block):
                    block.values.append(_number(cell, where))
                    block.lines.append(k)
                elif re.match(r"[-+.\d]", cell):
                    raise DataError(
                        f"{where}: more than the {_size(path, block)} numbers that its first "
                        f"number {block.values[0]:.3f} (rows.columns) announces"
                    )
                else:
                    break  # text after a complete section
    if not blocks:
        raise DataError(f"{path}: no section {', '.join(_SECTIONS[:4])} found")
    turbine = "Min Pressure Ratio" in blocks or "Max Pressure Ratio" in blocks
    needed = (
        ("Mass Flow", "Efficiency", "Min Pressure Ratio", "Max Pressure Ratio")
        if turbine
        else ("Mass Flow", "Efficiency", "Pressure Ratio", "Surge Line")
    )
    missing = [s for s in needed if s not in blocks]
    if missing:
        kind = "turbine" if turbine else "compressor"
        raise DataError(
            f"{path}: section {', '.join(missing)} missing; a {kind} needs {', '.join(needed)}"
        )
    for title in needed:
        _shape(path, blocks[title])
    flow, eta = blocks["Mass Flow"], blocks["Efficiency"]
    N, beta = flow.array[1:, 0], flow.array[0, 1:]
    _same_grid(path, flow, eta)
    _check_values(path, flow, "W")
    _check_values(path, eta, "eta")
    surge_W: np.ndarray | None = None
    surge_PR: np.ndarray | None = None
    if turbine:
        lo, hi = blocks["Min Pressure Ratio"], blocks["Max Pressure Ratio"]
        for b in (lo, hi):
            _check_pair(path, b)
            _same_axis(path, b, "speeds", b.array[0, 1:], N)
            if not trim:
                _check_values(path, b, "PR")
        PR = lo.array[1, 1:, None] + beta * (hi.array[1, 1:] - lo.array[1, 1:])[:, None]
    else:
        ratio, surge = blocks["Pressure Ratio"], blocks["Surge Line"]
        _same_grid(path, flow, ratio)
        if not trim:
            _check_values(path, ratio, "PR")
        PR = ratio.array[1:, 1:]
        _check_pair(path, surge)
        surge_W, surge_PR = surge.array[0, 1:], surge.array[1, 1:]
        if surge_W.size and (surge_W[0] <= 0 or surge_PR[0] <= 1):
            surge_W, surge_PR = surge_W[1:], surge_PR[1:]
    rows, columns, note = _trimmed(N, beta, PR) if trim else (slice(None), slice(None), "")
    title = re.sub(r"^99\s*", "", head[0]) if head else ""

    def place(f: Finding) -> str:
        title = {"W": "Mass Flow", "eta": "Efficiency", "PR_surge": "Surge Line"}.get(
            f.name, "Max Pressure Ratio" if turbine else "Pressure Ratio"
        )
        b = blocks[title]
        if f.name == "PR_surge":
            row, column = 1, b.array.shape[1] - surge_W.size + f.i if surge_W is not None else 1
        elif title == "Max Pressure Ratio":
            row, column = 1, 1 + (rows.start or 0) + max(f.i, 0)
        else:
            row = 1 + (rows.start or 0) + max(f.i, 0)
            column = 1 + (columns.start or 0) + max(f.j, 0)
        return f", line {b.where(row, column)}, section {title!r}"

    return _table(
        path,
        check,
        place,
        kind="turbine" if turbine else "compressor",
        N=N[rows],
        beta=beta[columns],
        W=flow.array[1:, 1:][rows, columns],
        PR=PR[rows, columns],
        eta=eta.array[1:, 1:][rows, columns],
        surge_W=surge_W,
        surge_PR=surge_PR,
        name=title or Path(path).stem,
        source="; ".join(
            [f"GasTurb/GSP text file {Path(path).name}", *head[1:], *([note] if note else [])]
        ),
    )


def _trimmed(N: np.ndarray, beta: np.ndarray, PR: np.ndarray) -> tuple[slice, slice, str]:
    """Return the rows and columns to keep so that PR > 1, and a remark on what is left out."""
    r0, r1, c0, c1 = 0, N.size, 0, beta.size
    bad = ~(PR > 1)
    while r0 < r1 and c0 < c1 and bad[r0:r1, c0:c1].any():
        part = bad[r0:r1, c0:c1]
        share = [part[0].mean(), part[-1].mean(), part[:, 0].mean(), part[:, -1].mean()]
        step = np.eye(4, dtype=int)[int(np.argmax(share))]
        r0, r1, c0, c1 = r0 + step[0], r1 - step[1], c0 + step[2], c1 - step[3]
    out = [f"N = {v:g}" for v in (*N[:r0], *N[r1:])]
    out += [f"beta = {v:g}" for v in (*beta[:c0], *beta[c1:])]
    note = f"left out, since PR <= 1 there: {', '.join(out)}" if out else ""
    return slice(r0, r1), slice(c0, c1), note


def _size(path: str | Path, block: _Block) -> int:
    """Return the count of numbers that the code ``rows.columns`` announces."""
    code = block.values[0]
    rows = int(code)
    columns = round((code - rows) * 1000)
    if rows < 2 or columns < 2:
        raise DataError(
            f"{path}, line {block.lines[0]}, section {block.title!r}: the first number must code "
            f"the table's size as rows.columns (11.016 is 11 rows of 16), got {code:g}"
        )
    return rows * columns


def _shape(path: str | Path, block: _Block) -> None:
    """Arrange the numbers of a section in rows and columns; refuse a truncated one."""
    where = f"{path}, section {block.title!r} at line {block.line}"
    if not block.values:
        raise DataError(f"{where} is empty")
    size = _size(path, block)
    if len(block.values) != size:
        raise DataError(
            f"{where}: {size} numbers announced by its first number {block.values[0]:.3f} "
            f"(rows.columns), {len(block.values)} found up to line {block.lines[-1]}; "
            f"is the section truncated or a row short?"
        )
    block.array = np.array(block.values).reshape(int(block.values[0]), -1)


def _check_pair(path: str | Path, block: _Block) -> None:
    if block.array.shape[0] != 2:
        raise DataError(
            f"{path}, section {block.title!r} at line {block.line}: two rows expected "
            f"(code 2.0xx), got {block.array.shape[0]}"
        )


def _same_grid(path: str | Path, flow: _Block, other: _Block) -> None:
    _same_axis(path, other, "beta values", other.array[0, 1:], flow.array[0, 1:])
    _same_axis(path, other, "speeds", other.array[1:, 0], flow.array[1:, 0])


def _same_axis(
    path: str | Path, block: _Block, what: str, got: np.ndarray, wanted: np.ndarray
) -> None:
    where = f"{path}, section {block.title!r} at line {block.line}"
    if got.size != wanted.size:
        raise DataError(f"{where}: {got.size} {what}, but {wanted.size} in 'Mass Flow'")
    # the layout is written with six or more digits: what differs more is another grid
    off = np.abs(got - wanted) > 1e-5 * max(1.0, float(np.max(np.abs(wanted))))
    if np.any(off):
        k = int(np.argmax(off))
        raise DataError(
            f"{where}: {what} differ from 'Mass Flow', {got[k]:g} against {wanted[k]:g}"
        )


def _check_values(path: str | Path, block: _Block, name: str) -> None:
    for i, j in np.ndindex(block.array.shape):
        if i and j and (wrong := fault(name, float(block.array[i, j]))):
            raise MapError(
                f"{path}, line {block.where(i, j)}, section {block.title!r}, row {i + 1}, column "
                f"{j + 1}: {block.array[i, j]:g}; {wrong}"
            )


# ---------------------------------------------------------------------------------------------
# Maps that come with the package


def shipped(name: str) -> MapTable:
    """Return a map that comes with the package: ``"axi5"`` or ``"lpt2269"``.

    AXI5 is a five-stage axial compressor of pressure ratio 5.2, LPT2269 a turbine of 6.0; both are
    carried over from pyCycle (Apache-2.0), as the headers of the data files say.

    Raises:
        DataError: no map of that name comes with the package.
    """
    return _shipped(name.lower())


@once
def _shipped(name: str) -> MapTable:
    folder = resources.files("apu_casadi.gaspath.data")
    if name not in SHIPPED:
        raise DataError(f"no map {name!r} comes with the package {nearest(name, SHIPPED)}")
    with resources.as_file(folder / f"{name}.csv") as path:
        return read_map_csv(path)
