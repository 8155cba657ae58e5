"""Component maps in the text layout of NPSS, as public T-MATS and NPSS repositories have them.

::

    Subelement CompressorRlineMap S_map {
        NcMapDes = 1.000;  RlineMapDes = 2.00;  RlineStall = 1.00;
        Table TB_Wc(real alphaMap, real NcMap, real RlineMap) {
            alphaMap = 0.0 {
                NcMap = 0.500 {
                    RlineMap = { 1.00, 1.25, 1.50 }
                    WcMap    = { 10.2, 11.4, 12.1 }
                }
                NcMap = 0.600 {
                    RlineMap = *;
                    WcMap    = { 12.3, 13.2, 13.9 }
                }
            }
            NcMap.interp = "lagrange3";
        }
        Table TB_PR(...) {...}   Table TB_eff(...) {...}
    }

A compressor has the tables TB_Wc, TB_PR and TB_eff over speed and R-line, a turbine TB_Wp and
TB_eff over speed and pressure ratio; the axis alpha before them may be absent. The last argument of
a table names the array of coordinates, the other array holds the values; ``*`` repeats the array of
this name before it. Of several alphas the design one is read (``alphaMapDes``), else the first.
Beta is the R-line, or how far a turbine's pressure ratio has gone along its line, 0 to 1; the surge
line is the R-line ``RlineStall``, else the first. Comments begin with ``//`` or ``#`` or stand in
``/* */``; what else a file may hold (interpolation, Reynolds effects) is passed over. Maps as
Python arrays (pyCycle) are not read.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from apu_casadi.core.errors import DataError, MapError
from apu_casadi.gaspath.maps.mapcheck import Finding
from apu_casadi.gaspath.maps.mapreading import file_lines, number, table_of, trimmed
from apu_casadi.gaspath.maps.maptable import MapTable, fault

_KINDS = {
    "compressor": {"W": "TB_Wc", "PR": "TB_PR", "eta": "TB_eff"},
    "turbine": {"W": "TB_Wp", "eta": "TB_eff"},
}
_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*|#[^\n]*", re.DOTALL)
_TOKEN = re.compile(r'"[^"\n]*"|[{}()=,;]|[^\s{}()=,;"]+|"')
_DEEPEST = 20


class _Token(NamedTuple):
    text: str
    line: int


@dataclass
class _Body:
    """What stands between two braces of a table: arrays with their lines, and deeper blocks."""

    line: int
    arrays: dict[str, list[_Token]] = field(default_factory=dict)
    blocks: list[tuple[str, _Token, _Body]] = field(default_factory=list)


@dataclass
class _Table:
    name: str
    line: int
    axes: list[str]
    body: _Body


class _Grid(NamedTuple):
    """A table as arrays: speeds, coordinates of each line, values, and the lines of the file."""

    name: str
    N: np.ndarray
    x: list[np.ndarray]
    values: np.ndarray
    lines: np.ndarray
    starts: list[int]


def is_npss(lines: list[str]) -> bool:
    """Whether a file is in this layout."""
    return any(re.match(r"\s*(Table|Subelement)\s+\w+[^,]*[({]?", text) for text in lines)


def read_map_npss(path: str | Path, *, trim: bool | None = None, check: bool = True) -> MapTable:
    """Read a map from the NPSS text layout that the module's text describes.

    Args:
        path: the file.
        trim, check: as in :func:`~apu_casadi.gaspath.maps.mapfiles.read_map`.

    Raises:
        DataError: damaged text, missing tables, tables of different grids; with the line.
        MapError: values outside their range, fewer than 4 lines, order not rising.
    """
    found = _Parser(path, "\n".join(file_lines(path))).read()
    kind = _kind(path, found)
    grids = {q: _grid(path, found.tables[t.lower()], found) for q, t in _KINDS[kind].items()}
    flow = grids["W"]
    for other in grids.values():
        _same(path, flow, other)
    N, x = flow.N, flow.x
    beta, PR = (x[0], grids["PR"].values) if kind == "compressor" else _pressures(path, flow)
    if kind == "compressor":
        _one_line(path, flow)
    _rising(path, flow)
    rows, columns, note = trimmed(path, N, beta, PR, trim)
    line_of = {q: g.lines[rows, columns] for q, g in grids.items()} | {
        "PR": (grids["PR"] if kind == "compressor" else flow).lines[rows, columns]
    }
    fields = {"W": flow.values, "PR": PR, "eta": grids["eta"].values}
    fields = {q: a[rows, columns] for q, a in fields.items()}
    for q, a in fields.items():
        for i, j in np.ndindex(a.shape):
            if wrong := fault(q, float(a[i, j])):
                raise MapError(f"{path}, line {line_of[q][i, j]}, {q} = {a[i, j]:g}; {wrong}")
    surge, told = {}, [f"NPSS text file {Path(path).name}", *found.notes, *([note] if note else [])]
    if kind == "compressor":
        stall, words = _stall(found, beta[columns])
        told += [words] if words else []
        good = fields["PR"][:, stall] > 1
        surge = {"surge_W": fields["W"][good, stall], "surge_PR": fields["PR"][good, stall]}

    def where(f: Finding) -> str:
        at = line_of["PR" if f.name == "PR_surge" else f.name]
        return f", line {at[max(f.i, 0), 0 if f.name == 'PR_surge' else max(f.j, 0)]}"

    grid = {"N": N[rows], "beta": beta[columns], **fields, **surge}
    ref = _reference(kind, found, grid["N"], x[0])
    head = {"kind": kind, "name": Path(path).stem, "source": "; ".join(told)}
    return table_of(path, check, where, **grid, **ref, **head)


# ------------------------------------------------------------------------------ text


class _Parser:
    """Reads tables and single numbers of a file."""

    def __init__(self, path: str | Path, text: str) -> None:
        self.path = path
        plain = _COMMENT.sub(lambda m: "\n" * m.group().count("\n"), text)
        self.tokens = list(_tokens(plain))
        self.end = plain.count("\n") + 1
        self.k = 0
        self.tables: dict[str, _Table] = {}
        self.scalars: dict[str, float] = {}
        self.notes: list[str] = []
        self._before: dict[str, list[_Token]] = {}  # arrays of the table that "*" repeats

    def read(self) -> _Parser:
        while self.k < len(self.tokens):
            self._item(0)
        return self

    def _error(self, token: _Token | None, what: str) -> DataError:
        line = self.end if token is None else token.line
        got = "the file ends" if token is None else f"got {token.text[:40]!r}"
        return DataError(f"{self.path}, line {line}: {what}, {got}")

    def _next(self, what: str) -> _Token:
        if self.k >= len(self.tokens):
            raise self._error(None, f"{what} expected")
        self.k += 1
        return self.tokens[self.k - 1]

    def _peek(self) -> str:
        return self.tokens[self.k].text if self.k < len(self.tokens) else ""

    def _take(self, text: str, what: str = "") -> _Token:
        token = self._next(what or repr(text))
        if token.text != text:
            raise self._error(token, f"{what or repr(text)} expected")
        return token

    def _item(self, depth: int) -> None:
        """Read one entry outside tables: a table, a subelement, a number, or something else."""
        token = self._next("an entry")
        if token.text == "Table":
            self._table()
        elif token.text == "Subelement":
            self._next("a type")
            if self._peek() != "{":
                self._next("a name")
            self._block("Subelement", token, depth)
        elif self._peek() == "=":
            self._take("=")
            value = self._next("a value")
            if value.text == "{":
                self._skip(value)
            else:
                with contextlib.suppress(ValueError):  # a text or an option
                    self.scalars.setdefault(token.text, float(value.text))
        elif token.text == "{":
            self._skip(token)
        elif token.text in "})":
            raise self._error(token, "a table or a number expected")

    def _block(self, what: str, opened: _Token, depth: int) -> None:
        if depth > _DEEPEST:
            raise self._error(opened, f"nested more than {_DEEPEST} deep")
        self._take("{", f"'{{' of the {what.lower()}")
        while self._peek() != "}":
            if self.k >= len(self.tokens):
                raise self._error(None, f"'}}' of {what} at line {opened.line} expected")
            self._item(depth + 1)
        self.k += 1

    def _skip(self, opened: _Token) -> None:
        """Pass over what stands between braces."""
        depth = 1
        while depth:
            if self.k >= len(self.tokens):
                raise self._error(None, f"'}}' of line {opened.line} expected")
            depth += {"{": 1, "}": -1}.get(self.tokens[self.k].text, 0)
            self.k += 1

    def _table(self) -> None:
        name = self._next("the name of a table")
        self._take("(", f"'(' after Table {name.text}")
        axes: list[str] = []
        while (token := self._next("')'")).text != ")":
            if token.text == "{":
                raise self._error(token, f"')' of Table {name.text} expected")
            if token.text not in ("real", "int", ","):
                axes.append(token.text)
        self._take("{", f"'{{' of Table {name.text}")
        self._before = {}
        body = self._body(f"Table {name.text}", name, 0)
        known = self.tables.get(name.text.lower())
        wanted = {t.lower() for names in _KINDS.values() for t in names.values()}
        if known and name.text.lower() in wanted:
            where = f"{self.path}, line {name.line}"
            raise DataError(f"{where}: second Table {name.text}, the first is at line {known.line}")
        self.tables[name.text.lower()] = _Table(name.text, name.line, axes, body)

    def _body(self, what: str, opened: _Token, depth: int) -> _Body:
        if depth > _DEEPEST:
            raise self._error(opened, f"nested more than {_DEEPEST} deep")
        body = _Body(opened.line)
        while True:
            if self.k >= len(self.tokens):
                raise self._error(None, f"'}}' of {what} at line {opened.line} expected")
            token = self._next("'}'")
            if token.text == "}":
                return body
            if token.text in ",;":
                continue
            self._take("=", f"'=' after {token.text!r}")
            value = self._next(f"a value of {token.text!r}")
            if value.text in "{*":
                if token.text in body.arrays:
                    raise self._error(token, f"one array {token.text!r} expected, a second")
                body.arrays[token.text] = self._array(token, value)
            elif self._peek() == "{":
                self.k += 1
                inner = self._body(f"{token.text} = {value.text}", token, depth + 1)
                body.blocks.append((token.text, value, inner))
            elif "." not in token.text and self._peek() != ";":
                after = self.tokens[self.k] if self.k < len(self.tokens) else None
                raise self._error(after, f"'{{' after {token.text} = {value.text} expected")

    def _array(self, opened: _Token, begins: _Token) -> list[_Token]:
        """Return the values of an array after its brace, or those that a star repeats."""
        if begins.text == "*":
            if opened.text not in self._before:
                raise self._error(begins, f"values of {opened.text}, none of it before, expected")
            return self._before[opened.text]
        values = self._before[opened.text] = []
        while (token := self._next(f"'}}' of {opened.text} at line {opened.line}")).text != "}":
            if token.text == "=" or token.text == "{":
                raise self._error(token, f"'}}' of {opened.text} at line {opened.line} expected")
            if token.text != ",":
                values.append(token)
        return values


def _tokens(text: str) -> Iterator[_Token]:
    for line, row in enumerate(text.split("\n"), 1):
        for m in _TOKEN.finditer(row):
            yield _Token(m.group(), line)


# ------------------------------------------------------------------------------ tables


def _kind(path: str | Path, found: _Parser) -> str:
    kind = "turbine" if "tb_wp" in found.tables else "compressor"
    missing = [t for t in _KINDS[kind].values() if t.lower() not in found.tables]
    if missing:
        needs = " or ".join(f"{', '.join(t.values())} of a {k}" for k, t in _KINDS.items())
        raise DataError(f"{path}: no Table {', '.join(missing)}; needed are {needs}")
    return kind


def _grid(path: str | Path, table: _Table, found: _Parser) -> _Grid:
    """Return a table as arrays, of one alpha."""
    where = f"{path}, line {table.line}, Table {table.name}"
    if len(table.axes) not in (2, 3):
        told = ", ".join(table.axes) or "none"
        raise DataError(f"{where}: speed and coordinate expected, alpha before them, got {told}")
    body, (speed, along) = table.body, table.axes[-2:]
    if len(table.axes) == 3:
        body = _alpha(path, table, found)
    starts: list[int] = []
    N: list[float] = []
    x: list[np.ndarray] = []
    values: list[list[float]] = []
    lines: list[list[int]] = []
    for name, token, line in body.blocks:
        at = f"{path}, line {token.line}"
        if name != speed:
            raise DataError(f"{at}: {speed} = ... expected in Table {table.name}, got {name!r}")
        N.append(number(token.text, f"{at}, {speed}"))
        starts.append(token.line)
        arrays = dict(line.arrays)
        if along not in arrays or len(arrays) != 2:
            got = ", ".join(arrays) or "none"
            raise DataError(f"{at}: two arrays, {along} and the values, expected, got {got}")
        coordinate, (value_name, value) = arrays.pop(along), next(iter(arrays.items()))
        if len(coordinate) != len(value):
            raise DataError(
                f"{at}, {speed} = {N[-1]:g}: {len(coordinate)} values of {along}, but "
                f"{len(value)} of {value_name}"
            )
        if x and len(coordinate) != len(x[0]):
            raise DataError(
                f"{at}, {speed} = {N[-1]:g}: {len(coordinate)} values of {along}, but "
                f"{len(x[0])} on the first line; every line needs as many"
            )
        x.append(np.array(_numbers(path, coordinate, along)))
        values.append(_numbers(path, value, value_name))
        lines.append([t.line for t in value])
    if not N:
        raise DataError(f"{where}: no {speed} = ... {{ }} in it")
    return _Grid(table.name, np.array(N), x, np.array(values), np.array(lines), starts)


def _numbers(path: str | Path, tokens: list[_Token], name: str) -> list[float]:
    return [number(t.text, f"{path}, line {t.line}, {name}") for t in tokens]


def _alpha(path: str | Path, table: _Table, found: _Parser) -> _Body:
    """Return the design alpha's part of a table, else the first's."""
    name = table.axes[0]
    blocks = [(token, body) for n, token, body in table.body.blocks if n == name]
    if not blocks:
        got = ", ".join(dict.fromkeys(n for n, *_ in table.body.blocks)) or "nothing"
        where = f"{path}, line {table.line}"
        raise DataError(f"{where}: {name} = ... expected in Table {table.name}, got {got}")
    values = [number(t.text, f"{path}, line {t.line}, {name}") for t, _ in blocks]
    wanted = found.scalars.get(f"{name}Des", values[0])
    k = int(np.argmin(np.abs(np.array(values) - wanted)))
    if len(values) > 1:
        note = f"{name} = {values[k]:g} of {', '.join(f'{v:g}' for v in values)}"
        if note not in found.notes:
            found.notes.append(note)
    return blocks[k][1]


def _same(path: str | Path, flow: _Grid, other: _Grid) -> None:
    """Check that two tables stand on one grid."""
    for k, start in enumerate(other.starts):
        where = f"{path}, line {start}, Table {other.name}"
        if k >= flow.N.size or not math.isclose(other.N[k], flow.N[k], rel_tol=1e-9):
            got = f"{flow.N[k]:g}" if k < flow.N.size else "none"
            raise DataError(f"{where}: speed {other.N[k]:g}, but {got} in Table {flow.name}")
        if other.x[k].size != flow.x[k].size or np.abs(other.x[k] - flow.x[k]).max() > 1e-9:
            raise DataError(
                f"{where}: the coordinates at speed {other.N[k]:g} differ from those in Table "
                f"{flow.name}; both tables need one grid"
            )
    if other.N.size < flow.N.size:
        where = f"{path}, line {other.starts[-1]}, Table {other.name}"
        raise DataError(f"{where}: {other.N.size} speeds, but {flow.N.size} in Table {flow.name}")


def _one_line(path: str | Path, flow: _Grid) -> None:
    for start, x in zip(flow.starts, flow.x, strict=True):
        if np.abs(x - flow.x[0]).max() > 1e-9:
            raise DataError(f"{path}, line {start}: R-lines differ from those of the first speed")


def _rising(path: str | Path, flow: _Grid) -> None:
    for k in range(1, flow.N.size):
        if flow.N[k] <= flow.N[k - 1]:
            raise MapError(
                f"{path}, line {flow.starts[k]}: speed {flow.N[k]:g} follows {flow.N[k - 1]:g}; "
                "speeds must rise"
            )
    for start, x in zip(flow.starts, flow.x, strict=True):
        if (np.diff(x) <= 0).any():
            raise MapError(f"{path}, line {start}: the coordinates must rise along the line")


def _pressures(path: str | Path, flow: _Grid) -> tuple[np.ndarray, np.ndarray]:
    """Return beta and PR of a turbine: how far PR has gone on its line, the same on all."""
    _rising(path, flow)
    PR = np.array(flow.x)
    if PR.shape[1] < 2:
        return np.zeros(PR.shape[1]), PR
    beta = (PR - PR[:, :1]) / (PR[:, -1:] - PR[:, :1])
    for start, own in zip(flow.starts, beta, strict=True):
        if np.abs(own - beta[0]).max() > 1e-6:
            raise DataError(
                f"{path}, line {start}: pressure ratios must be spaced as on the first line"
            )
    return beta[0], PR


def _stall(found: _Parser, beta: np.ndarray) -> tuple[int, str]:
    """Return the column of the surge line, and a note where the file's own is no R-line."""
    wanted = found.scalars.get("RlineStall", float(beta[0]))
    k = int(np.argmin(np.abs(beta - wanted)))
    if abs(beta[k] - wanted) <= 1e-9:
        return k, ""
    return k, f"RlineStall = {wanted:g} is no R-line; the surge line is R-line {beta[k]:g}"


def _reference(kind: str, found: _Parser, N: np.ndarray, x: np.ndarray) -> dict[str, float | None]:
    """Return the design point of the file where it has one within the table."""
    speed, along = ("NcMapDes", "RlineMapDes") if kind == "compressor" else ("NpMapDes", "PRmapDes")
    at, on = found.scalars.get(speed), found.scalars.get(along)
    if on is not None and kind == "turbine":
        on = (on - float(x[0])) / float(x[-1] - x[0])
        x = np.array([0.0, 1.0])
    inside = {"N_ref": (at, N), "beta_ref": (on, x)}
    return {
        name: v if v is not None and axis[0] <= v <= axis[-1] else None
        for name, (v, axis) in inside.items()
    }
