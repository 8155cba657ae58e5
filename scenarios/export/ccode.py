"""C99 of a CasADi function: code, header, arrays of names and numbers, and an example.

What is written needs ``math.h`` alone and compiles without a warning under ``-std=c99 -Wall
-Wextra -Wpedantic``.  Compiled by ISO rules (no contraction of products and sums: ``-std=c99``, or
``-ffp-contract=off``) it gives the very digits that Python gives.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core import files
from apu_casadi.core.backend import find_compiler
from apu_casadi.core.calling import Caller
from apu_casadi.core.errors import BackendError, SignalError
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.version import installed

FLAGS = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
STEPS = 1000
SAW = 2e-5, 100  # slope and length, in steps, of the saw tooth of the example's first input
_TIMEOUT = 900.0  # s

_DEFINITION = re.compile(r"^(?:CASADI_SYMBOL_EXPORT |static )?[\w ]+?[ *]\w+\((.*)\) ?\{$", re.M)
_WORK = ("arg", "res", "iw", "w")


class Vector(NamedTuple):
    """An argument or a result of an exported function.

    Args:
        name: of the argument.
        signals: its entries; of a matrix those of its rows.
        start: values to begin with, column by column; empty for a result.
        constant: the values are the unit's own numbers.
        square: a matrix, rows and columns by ``signals``.
    """

    name: str
    signals: Signals
    start: tuple[float, ...] = ()
    constant: bool = False
    square: bool = False

    @property
    def size(self) -> int:
        """Number of entries."""
        return len(self.signals) ** 2 if self.square else len(self.signals)


@dataclass(frozen=True)
class Exported:
    """A function with names, and how the example runs it.

    Args:
        name: of the function and of the files, a C identifier.
        doc: what it computes.
        function: dense; inputs and outputs as ``inputs`` and ``outputs``.
        hand: pairs of a result and the argument that it is in the next step.
        rate: a result that is the rate of an argument, that argument, and the step, s.
        shown: results that the example prints.
    """

    name: str
    doc: str
    function: ca.Function
    inputs: tuple[Vector, ...]
    outputs: tuple[Vector, ...]
    hand: tuple[tuple[str, str], ...] = ()
    rate: tuple[str, str, float] | None = None
    shown: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        f = self.function
        got = [f.numel_in(i) for i in range(f.n_in())], [f.numel_out(i) for i in range(f.n_out())]
        want = [v.size for v in self.inputs], [v.size for v in self.outputs]
        if got != want:
            raise SignalError(f"{self.name}: sizes {want[0]} -> {want[1]} expected, got {got}")

    @property
    def printed(self) -> tuple[str, ...]:
        """The results that the example prints, by default all."""
        return self.shown or tuple(v.name for v in self.outputs)


def generated(name: str, functions: Sequence[ca.Function]) -> str:
    """Return the C text of functions, with internal names of their own, without a warning."""
    generator = ca.CodeGenerator(f"{name}.c", {"with_header": False})
    for f in functions:
        generator.add(f)

    def used(found: re.Match[str]) -> str:
        names = [p.split()[-1].lstrip("*") for p in found[1].split(",") if p not in ("", "void")]
        return "\n".join([found[0], *(f"  (void) {n};" for n in names)])

    return _DEFINITION.sub(used, str(generator.dump()))


def work(f: ca.Function) -> list[int]:
    """Return how many pointers, integers and numbers a function works with, none of them zero."""
    return [max(1, n) for n in (f.sz_arg(), f.sz_res(), f.sz_iw(), f.sz_w())]


# ------------------------------------------------------------------------------ text


def array(kind: str, name: str, entries: Sequence[str]) -> str:
    """Return the definition of a constant array, which C wants not to be empty."""
    values = list(entries) or ["0"]
    lines = (", ".join(values[i : i + 4]) for i in range(0, len(values), 4))
    body = ",\n  ".join(lines)
    return f"{kind}{name}[{len(values)}] = {{\n  {body}\n}};\n"


def number(value: float) -> str:
    """Return a double as C reads the same one."""
    return repr(float(value)) if np.isfinite(value) else "NAN" if np.isnan(value) else "HUGE_VAL"


def text(value: str) -> str:
    """Return a string literal."""
    plain = value.encode("ascii", "replace").decode()
    return '"' + plain.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _argument(v: Vector, *, out: bool) -> str:
    return f"{'' if out else 'const '}double {v.name}[{max(1, v.size)}]"


def _prototype(e: Exported) -> str:
    given = [_argument(v, out=False) for v in e.inputs]
    made = [_argument(v, out=True) for v in e.outputs]
    body = ",\n    ".join([*given, *made])
    return f"int {e.name}_call(\n    {body})"


def _indices(e: Exported, v: Vector) -> Iterator[str]:
    """Lines that name the entries of a vector."""
    yield "enum {"
    for i, s in enumerate(v.signals):
        name = f"{e.name}_{v.name}_{s.name.replace('.', '_')}"
        yield f"  {name} = {i}, /* {s.unit}: {s.doc.replace('*/', '* /')} */"
    yield f"  {e.name}_{v.name}_size = {v.size}"
    yield "};"


def header(e: Exported) -> str:
    """Return the header: sizes, names, units, prototypes."""
    guard = f"{e.name.upper()}_H"
    lines = [f"/* {e.name}: {e.doc}", "", "   Made by apu-casadi " + installed() + "."]
    lines += ["   All values are in SI units; matrices are stored column by column.", "*/"]
    lines += [f"#ifndef {guard}", f"#define {guard}", ""]
    for v in (*e.inputs, *e.outputs):
        if len(v.signals):
            lines += [f"/* {v.name}{', square' if v.square else ''} */", *_indices(e, v)]
            lines.append(f"extern const char *const {e.name}_{v.name}_names[{len(v.signals)}];")
            lines.append(f"extern const char *const {e.name}_{v.name}_units[{len(v.signals)}];")
        if v.start:
            what = "the unit's own" if v.constant else "to start with"
            suffix = "" if v.constant else "_start"
            lines.append(f"extern const double {e.name}_{v.name}{suffix}[{v.size}]; /* {what} */")
        lines.append("")
    lines += [f"/* Returns 0, or not: then something could not be evaluated.  {e.doc} */"]
    lines += [_prototype(e) + ";", ""]
    lines += [f"enum {{ {e.name}_{n} = {k} }};" for n, k in _sizes(e)]
    lines += ["", "/* The same with work space of one's own. */"]
    lines += [f"int {e.name}(const double **arg, double **res, long long int *iw, double *w,"]
    return "\n".join([*lines, "    int mem);", "", "#endif", ""])


def _sizes(e: Exported) -> list[tuple[str, int]]:
    return [(f"sz_{n}", k) for n, k in zip(_WORK, work(e.function), strict=True)]


def source(e: Exported) -> str:
    """Return the code: CasADi's, the arrays of the header, and the call by name."""
    parts = [generated(e.name, [e.function]), f'\n#include "{e.name}.h"\n']
    for v in (*e.inputs, *e.outputs):
        if len(v.signals):
            for what in ("name", "unit"):
                entries = [text(getattr(s, what)) for s in v.signals]
                parts.append(array("const char *const ", f"{e.name}_{v.name}_{what}s", entries))
        if v.start:
            suffix = "" if v.constant else "_start"
            values = [number(x) for x in v.start]
            parts.append(array("const double ", f"{e.name}_{v.name}{suffix}", values))
    kinds = ("const double *", "double *", "long long int ", "double ")
    spaces = (f"  {k}{n}[{e.name}_sz_{n}];" for k, n in zip(kinds, _WORK, strict=True))
    lines = [_prototype(e), "{", *spaces]
    lines += [f"  arg[{i}] = {v.name};" for i, v in enumerate(e.inputs)]
    lines += [f"  res[{i}] = {v.name};" for i, v in enumerate(e.outputs)]
    lines += [f"  return {e.name}(arg, res, iw, w, 0);", "}", ""]
    return "\n".join([*parts, *lines])


def example(e: Exported) -> str:
    """Return a program that takes ``STEPS`` steps and prints every one of them."""
    slope, length = SAW
    first = _sawn(e)
    lines = ["#include <stdio.h>", "#include <string.h>", "", f'#include "{e.name}.h"', ""]
    lines += ["int main(void)", "{"]
    variables = [v for v in e.inputs if not v.constant]
    for v in (*variables, *e.outputs):
        lines.append(f"  double {v.name}[{max(1, v.size)}];")
    lines += ["  int i, k;", ""]
    for v in variables:
        if v.size:
            lines.append(f"  memcpy({v.name}, {e.name}_{v.name}_start, sizeof {v.name});")
        else:
            lines.append(f"  {v.name}[0] = 0.0;")
    given = [v.name if not v.constant else f"{e.name}_{v.name}" for v in e.inputs]
    call = ", ".join([*given, *(v.name for v in e.outputs)])
    lines += [f"  for (k = 0; k < {STEPS}; k++) {{"]
    if first:
        saw = f"(1.0 + {number(slope)} * (double)(k % {length}))"
        lines.append(f"    {first}[0] = {e.name}_{first}_start[0] * {saw};")
    lines += [f"    if ({e.name}_call({call}))", "      return 1;"]
    for v in e.outputs:
        if v.name in e.printed:
            lines.append(f"    for (i = 0; i < {v.size}; i++)")
            lines.append(f'      printf("%.17g ", {v.name}[i]);')
    lines.append('    printf("\\n");')
    lines += [f"    memcpy({b}, {a}, sizeof {b});" for a, b in e.hand]
    if e.rate:
        rate, x, h = e.rate
        lines.append(f"    for (i = 0; i < {e.name}_{x}_size; i++)")
        lines.append(f"      {x}[i] = {x}[i] + {number(h)} * {rate}[i];")
    return "\n".join([*lines, "  }", "  return 0;", "}", ""])


def _sawn(e: Exported) -> str:
    return next((v.name for v in e.inputs if v.name == "u" and v.size), "")


def expected(e: Exported) -> str:
    """Return what the example prints, by Python."""
    call, now = Caller(e.function), {v.name: np.array(v.start) for v in e.inputs}
    (slope, length), first, lines = SAW, _sawn(e), []
    names, shapes = [v.name for v in e.outputs], [e.function.size_in(i) for i in range(len(now))]
    for k in range(STEPS):
        if first:
            now[first][0] = next(v.start[0] for v in e.inputs if v.name == first) * (
                1.0 + slope * float(k % length)
            )
        shaped = (
            a.reshape(s, order="F") if s[1] > 1 else a
            for a, s in zip(now.values(), shapes, strict=True)
        )
        made = dict(zip(names, (r.ravel(order="F") for r in call(*shaped)), strict=True))
        row = np.concatenate([made[n] for n in names if n in e.printed])
        lines.append("".join(f"{v:.17g} " for v in row))
        now |= {b: made[a].copy() for a, b in e.hand}
        if e.rate:
            rate, x, h = e.rate
            now[x] = now[x] + h * made[rate]
    return "\n".join([*lines, ""])


# ------------------------------------------------------------------------------ files


def write(e: Exported, folder: Path) -> list[Path]:
    """Write code, header, example and what it prints into a folder; return the paths.

    Raises:
        DataError: a file cannot be written.
    """
    run = " ".join(["cc", *FLAGS, f"{e.name}.c", f"{e.name}_example.c -o {e.name}_example -lm"])
    first = f"/* {run}\n   ./{e.name}_example | cmp - {e.name}_expected.txt */\n"
    texts = {
        f"{e.name}.c": source(e),
        f"{e.name}.h": header(e),
        f"{e.name}_example.c": first + example(e),
        f"{e.name}_expected.txt": expected(e),
    }
    return [files.write_text(folder / n, t) for n, t in texts.items()]


def check(e: Exported, folder: Path) -> int:
    """Compile and run the example of a folder; return how many steps were equal to Python's.

    Raises:
        BackendError: there is no compiler, it had something to say, or a step differs.
    """
    compiler = find_compiler()
    if compiler is None:
        raise BackendError(f"{e.name}: no C compiler found to check it with; install one or set CC")
    with tempfile.TemporaryDirectory() as work_in:
        program = str(Path(work_in) / "example")
        sources = [str(folder / f"{e.name}{n}.c") for n in ("", "_example")]
        printed = ""
        for command in ([*compiler, *FLAGS, *sources, "-o", program, "-lm"], [program]):
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=_TIMEOUT, check=False
            )
            if done.returncode:
                said = " ".join(done.stderr.split())[:300] or f"status {done.returncode}"
                raise BackendError(f"{e.name}: {command[0]}: {said}")
            printed = done.stdout
    ours = (folder / f"{e.name}_expected.txt").read_text(encoding="utf-8").splitlines()
    theirs = printed.splitlines()
    for k, (a, b) in enumerate(zip(ours, theirs, strict=True)):
        if a != b:
            raise BackendError(f"{e.name}: step {k + 1} of {len(ours)} differs from Python's")
    return len(ours)


def scalar(name: str, unit: str, doc: str) -> Signals:
    """Return the signals of an argument that is one number."""
    return Signals([Signal(name, unit, doc)])
