"""Component maps as tables, and their files: plain CSV, and the text layouts of others.

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
write them, are ignored.  Semicolons, tabs or bars may separate the cells, with decimal commas in
the numbers (``# decimal: comma`` where that is open); units may stand in names or a row below.

**GasTurb/GSP.**  See :mod:`apu_casadi.gaspath.maps.gasturbmaps`.

**NPSS.**  See :mod:`apu_casadi.gaspath.maps.npssmaps`.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from itertools import pairwise
from pathlib import Path

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import DataError, MapError, nearest
from apu_casadi.core.sharing import once
from apu_casadi.core.tables.numbertable import numbers_of
from apu_casadi.core.tables.tablelayout import TableLayout
from apu_casadi.core.units import header
from apu_casadi.gaspath.maps.gasturbmaps import read_map_gasturb, section_of
from apu_casadi.gaspath.maps.mapcheck import Finding
from apu_casadi.gaspath.maps.mapreading import file_lines, number, one_line, table_of
from apu_casadi.gaspath.maps.maptable import (
    GRID_COLUMNS,
    SURGE_COLUMNS,
    MapTable,
    fault,
)
from apu_casadi.gaspath.maps.npssmaps import is_npss, read_map_npss

__all__ = [
    "SHIPPED",
    "read_map",
    "read_map_csv",
    "read_map_gasturb",
    "read_map_npss",
    "shipped",
    "write_map_csv",
]

SHIPPED = ("axi5", "lpt2269")


def read_map(path: str | Path, *, trim: bool | None = None, check: bool = True) -> MapTable:
    """Read a map file; the layout (CSV, GasTurb/GSP or NPSS) is told from the content.

    Args:
        path: the file.
        trim: many maps of the text layouts reach PR <= 1 at low speed or near choke.  True leaves
            out the outermost speed or beta lines, each time the one with the largest share of such
            points, until none is left, and says so in the table's ``source``; None does so with a
            warning; False refuses.  Without effect on CSV files, whose rows are easily removed.
        check: False accepts numbers that do not go with their neighbours
            (:mod:`apu_casadi.gaspath.maps.mapcheck`); the table's ``source`` says so.

    Raises:
        DataError: the file is missing, damaged, or in no layout known here.
        MapError: the numbers are readable but make no map.
    """
    lines = file_lines(path)
    if is_npss(lines):
        return read_map_npss(path, trim=trim, check=check)
    if any("MapData(" in text or "np.array(" in text for text in lines):
        raise DataError(
            f"{path}: a Python module; maps as Python arrays, as pyCycle has them, are not read: "
            "write them as CSV (write_map_csv of a MapTable)"
        )
    words = [text.strip().lower() for text in lines]
    first = next((w for w in words if w and not w.startswith("#")), "")
    if re.match(r"99(\s|$)", first) or any(section_of(w) for w in words):
        return read_map_gasturb(path, trim=trim, check=check)
    if any(sign in first for sign in ",;\t|") or first.startswith("sep="):
        return read_map_csv(path, check=check)
    raise DataError(
        f"{path}: neither a CSV map (header {','.join(GRID_COLUMNS)}) nor the GasTurb/GSP layout "
        f"(title '99 ...', sections such as 'Mass Flow') nor the NPSS layout ('Table TB_Wc(...) "
        "{'); see apu_casadi.gaspath.maps.mapfiles for them"
    )


# ---------------------------------------------------------------------------------------------
# CSV


def read_map_csv(path: str | Path, *, check: bool = True) -> MapTable:
    """Read a map from the plain CSV layout that the module's text describes.

    ``check`` as in :func:`read_map`.

    Raises:
        DataError: missing key or column, cell that is no number, ragged grid (file, line, column).
        MapError: values outside their range, fewer than 4 lines, order not rising.
    """
    meta, grid, surge = _csv_blocks(path)
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
        ref[key] = number(text, f"{path}, line {k}, {key}") if text else None

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

    line = np.array([r for _, r in surge]).T if surge else (None, None)
    grid_values = {"N": N, "beta": beta, "W": W, "PR": PR, "eta": eta}
    surge_values = {"surge_W": line[0], "surge_PR": line[1]}
    name = meta.get("name", (Path(path).stem, 0))[0]
    told = {"kind": meta["kind"][0].lower(), "name": name, "source": meta.get("source", ("",))[0]}
    return table_of(path, check, where, **grid_values, **surge_values, **ref, **told)


_Rows = list[tuple[int, list[float]]]


@dataclass(frozen=True)
class _Layout(TableLayout):
    """What to do about questions that a map file leaves."""

    remedies = {
        **TableLayout.remedies,
        "decimal": "write decimal points, or a line '# decimal: comma' (or point) at the top",
        "empty": "maps may have no holes: fill the cell or remove the whole speed or beta line",
        "sentinel": "maps may have no holes: remove the whole speed or beta line; if {0} is right, "
        "write it with one digit more",
    }


def _csv_blocks(path: str | Path) -> tuple[dict[str, tuple[str, int]], _Rows, _Rows]:
    """Return the keys of comments, the rows of grid and surge line, each with its line."""
    lines = file_lines(path)
    body = [(k, x) for k, x in enumerate(lines, 1) if x.strip()]
    at, free = next(((k, x) for k, x in body if not x.lstrip(' "').startswith("#")), (0, ""))
    first = re.fullmatch(r'\s*"?sep=(.)"?\s*', free, re.IGNORECASE)
    sep = first[1] if first else next((d for d in ";\t|" if d in free), ",")
    body = [(k, x) for k, x in body if not (first and k == at)]
    body = [(k, x.rstrip(f"{sep} ")) for k, x in body if x.strip(f"{sep} ")]
    meta: dict[str, tuple[str, int]] = {}
    heads: list[int] = []  # lines of the headers: of the grid, and of each surge line
    for k, x in body:
        if x.lstrip(' "').startswith("#"):
            key, colon, value = ", ".join(_cells(path, k, x, sep)).lstrip("# ").partition(":")
            if colon:
                meta.setdefault(key.strip().lower(), (value.strip(), k))
        elif not heads or "W_surge" in x or "PR_surge" in x:
            heads.append(k)
    kept = {k: x for k, x in body if not x.lstrip(' "').startswith("#")}
    blocks: list[_Rows] = [[], []]
    decimal = meta["decimal"][0].lower() if "decimal" in meta else None
    for i, (k, end) in enumerate(pairwise([*heads, len(lines) + 1])):
        wanted = GRID_COLUMNS if i == 0 else SURGE_COLUMNS
        _csv_header(path, k, [header(c)[0] for c in _cells(path, k, kept[k], sep)], wanted)
        text = "\n".join(kept.get(n, "") if n >= k else "" for n in range(1, end))
        if i and decimal is None and sep != "," and "," in kept.get(k - 1, "") + kept[heads[0] + 1]:
            decimal = "comma"  # as in the grid, which has been read
        blocks[min(i, 1)] += _csv_block(path, text, wanted, _Layout(delimiter=sep, decimal=decimal))
    return meta, blocks[0], blocks[1]


def _csv_block(path: str | Path, text: str, wanted: Sequence[str], layout: TableLayout) -> _Rows:
    """Return the rows below a header, each with its line; a percent is a hundredth."""
    table = numbers_of(path, text, wanted.__contains__, layout)
    columns = []
    for name in wanted:
        own = table.column(name).unit if name in ("N", "W", "W_surge") else "1"
        columns.append(table.numbers(name, own or "", codes=False).tolist())
        for k, value in enumerate(columns[-1]):
            if wrong := fault(name, value):
                raise MapError(f"{table.place(k, name)}: {value:.9g}; {wrong}")
    rows = zip(*columns, strict=True)
    return [(line, list(row)) for line, row in zip(table.lines or (), rows, strict=True)]


def _cells(path: str | Path, k: int, line: str, sep: str) -> list[str]:
    try:
        return [c.strip() for c in next(csv.reader([line], delimiter=sep))]
    except csv.Error as e:
        raise DataError(f"{path}, line {k}: no row of numbers; {e}") from None


def _csv_header(path: str | Path, k: int, row: list[str], wanted: Sequence[str]) -> None:
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
            f"{','.join(row)!r}: delete the other columns"
        )


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
    out = [f"# kind: {table.kind}", f"# name: {one_line(table.name)}"]
    if table.source:
        out.append(f"# source: {one_line(table.source)}")
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
