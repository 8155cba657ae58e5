"""Component maps in the GasTurb/GSP text layout.

A title line that begins with ``99``, a line ``Reynolds: ...``, then sections
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

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from apu_casadi.core.errors import DataError, MapError
from apu_casadi.gaspath.maps.mapcheck import Finding
from apu_casadi.gaspath.maps.mapreading import (
    file_lines,
    number,
    one_line,
    table_of,
    trimmed,
)
from apu_casadi.gaspath.maps.maptable import MapTable, fault

_SECTIONS = (
    "Mass Flow",
    "Efficiency",
    "Pressure Ratio",
    "Surge Line",
    "Min Pressure Ratio",
    "Max Pressure Ratio",
)


def section_of(word: str) -> str | None:
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
        made: int = self.lines[i * self.array.shape[1] + j]
        return made


_NEEDED = {
    "turbine": ("Mass Flow", "Efficiency", "Min Pressure Ratio", "Max Pressure Ratio"),
    "compressor": ("Mass Flow", "Efficiency", "Pressure Ratio", "Surge Line"),
}


def read_map_gasturb(path: str | Path, *, trim: bool | None = None, check: bool = True) -> MapTable:
    """Read a map from the GasTurb/GSP text layout that the module's text describes.

    The file with a surge line and a pressure ratio table is a compressor, the one with minimum and
    maximum pressure ratios a turbine.  A first surge point at zero flow or at PR = 1 (the origin)
    is left out: the surge line is continued as a power law there.

    Args:
        path: the file.
        trim: as in :func:`~apu_casadi.gaspath.maps.mapfiles.read_map`.
        check: as in :func:`~apu_casadi.gaspath.maps.mapfiles.read_map`.

    Raises:
        DataError: missing, doubled, truncated or overlong section, or a cell that is no number.
        MapError: values outside their range, fewer than 4 lines, order not rising.
    """
    head, blocks = _blocks(path)
    kind = _kind(path, blocks)
    for title in _NEEDED[kind]:
        _shape(path, blocks[title])
    flow, eta = blocks["Mass Flow"], blocks["Efficiency"]
    N, beta = flow.array[1:, 0], flow.array[0, 1:]
    _same_grid(path, flow, eta)
    _check_values(path, flow, "W")
    _check_values(path, eta, "eta")
    surge_W: np.ndarray | None = None
    surge_PR: np.ndarray | None = None
    if kind == "turbine":
        PR = _turbine_ratio(path, blocks, N, beta)
    else:
        ratio, surge = blocks["Pressure Ratio"], blocks["Surge Line"]
        _same_grid(path, flow, ratio)
        PR = ratio.array[1:, 1:]
        _check_pair(path, surge)
        surge_W, surge_PR = surge.array[0, 1:], surge.array[1, 1:]
        if surge_W.size and (surge_W[0] <= 0 or surge_PR[0] <= 1):
            surge_W, surge_PR = surge_W[1:], surge_PR[1:]
    rows, columns, note = trimmed(path, N, beta, PR, trim)
    if not note:
        for section in ("Pressure Ratio", "Min Pressure Ratio", "Max Pressure Ratio"):
            if section in _NEEDED[kind]:
                _check_values(path, blocks[section], "PR")
    title = re.sub(r"^99\s*", "", head[0]) if head else ""
    n_surge = 0 if surge_W is None else surge_W.size
    told = [f"GasTurb/GSP text file {Path(path).name}", *head[1:], *([note] if note else [])]
    return table_of(
        path,
        check,
        lambda f: _place(f, blocks, (rows.start or 0, columns.start or 0), n_surge),
        kind=kind,
        N=N[rows],
        beta=beta[columns],
        W=flow.array[1:, 1:][rows, columns],
        PR=PR[rows, columns],
        eta=eta.array[1:, 1:][rows, columns],
        surge_W=surge_W,
        surge_PR=surge_PR,
        name=title or Path(path).stem,
        source="; ".join(told),
    )


def _blocks(path: str | Path) -> tuple[list[str], dict[str, _Block]]:
    """Return the lines before the first section, and the sections by title."""
    head: list[str] = []
    blocks: dict[str, _Block] = {}
    block: _Block | None = None
    for k, text in enumerate(file_lines(path), 1):
        title = section_of(text)
        if title:
            if title in blocks:
                raise DataError(f"{path}, line {k}: second section {title!r}, remove one")
            block = blocks[title] = _Block(title, k)
        elif block is None:
            if text.strip():
                head.append(one_line(text))
        else:
            _take(path, block, k, text)
    if not blocks:
        raise DataError(f"{path}: no section {', '.join(_SECTIONS[:4])} found")
    return head, blocks


def _take(path: str | Path, block: _Block, k: int, text: str) -> None:
    """Add the numbers of line k to a section."""
    where = f"{path}, line {k}, section {block.title!r}"
    for cell in text.split():
        if not block.values or len(block.values) < _size(path, block):
            block.values.append(number(cell, where))
            block.lines.append(k)
        elif re.match(r"[-+.\d]", cell):
            raise DataError(
                f"{where}: more than the {_size(path, block)} numbers that its first "
                f"number {block.values[0]:.3f} (rows.columns) announces"
            )
        else:
            return  # text after a complete section


def _kind(path: str | Path, blocks: dict[str, _Block]) -> str:
    """Tell a turbine from a compressor; all its sections must be there."""
    turbine = "Min Pressure Ratio" in blocks or "Max Pressure Ratio" in blocks
    kind = "turbine" if turbine else "compressor"
    missing = [s for s in _NEEDED[kind] if s not in blocks]
    if missing:
        raise DataError(
            f"{path}: section {', '.join(missing)} missing; a {kind} needs "
            f"{', '.join(_NEEDED[kind])}"
        )
    return kind


def _turbine_ratio(
    path: str | Path, blocks: dict[str, _Block], N: np.ndarray, beta: np.ndarray
) -> np.ndarray:
    """Return PR = min + beta (max - min) on the grid."""
    lo, hi = blocks["Min Pressure Ratio"], blocks["Max Pressure Ratio"]
    for b in (lo, hi):
        _check_pair(path, b)
        _same_axis(path, b, "speeds", b.array[0, 1:], N)
    PR: np.ndarray = lo.array[1, 1:, None] + beta * (hi.array[1, 1:] - lo.array[1, 1:])[:, None]
    return PR


def _place(f: Finding, blocks: dict[str, _Block], first: tuple[int, int], n_surge: int) -> str:
    """Name line and section of a finding in a table whose corner was at ``first`` of the file's."""
    ratio = "Max Pressure Ratio" if "Max Pressure Ratio" in blocks else "Pressure Ratio"
    titles = {"W": "Mass Flow", "eta": "Efficiency", "PR_surge": "Surge Line"}
    title = titles.get(f.name, ratio)
    b = blocks[title]
    if f.name == "PR_surge":
        row, column = 1, b.array.shape[1] - n_surge + f.i
    elif title == "Max Pressure Ratio":
        row, column = 1, 1 + first[0] + max(f.i, 0)
    else:
        row, column = 1 + first[0] + max(f.i, 0), 1 + first[1] + max(f.j, 0)
    return f", line {b.where(row, column)}, section {title!r}"


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
