"""Functions for several points at once, compiled in lanes: the door for any function by name.

:func:`in_lanes` returns a CasADi function of ``width`` columns at once, as ``fun.map(width)`` is,
from compiled vector code, and exactly that map where there is no compiler.  :func:`batch` evaluates
for any number of columns, on several threads, and is what users' own models take:

>>> import casadi as ca, numpy as np
>>> from apu_casadi.core.lanes.lanelibrary import batch
>>> x = ca.SX.sym("x", 2)
>>> f = ca.Function("f", [x], [ca.exp(x[0]) * x[1]])
>>> batch(f)(np.ones((2, 3)))[0].round(3)
array([[2.718, 2.718, 2.718]])

SX functions have a form in lanes whatever they hold, but ``erfinv``, which no C library has.  MX
functions have one where they move numbers, look up tables, multiply matrices, and call such
functions, maps of them, or ``fast_newton`` as a loop around a step.  Others are refused by the name
of what cannot be written (:func:`unsupported`), among them linear solvers, other root finders,
integrators and external functions: ``expand()`` helps where all is made of scalar operations, else
the function is evaluated by map.

Environment, beside that of :mod:`apu_casadi.core.backend`: ``APU_LANES`` (1, 2, 4, 8) is the
highest number of lanes; 1 evaluates everything by map.
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import casadi as ca

from apu_casadi.core.backend import Code, backend_in_use, compiled, library, load_library
from apu_casadi.core.cachefolder import say
from apu_casadi.core.calling import Mapped
from apu_casadi.core.errors import BackendError
from apu_casadi.core.lanes.lanecode import NoForm
from apu_casadi.core.lanes.lanegraph import graph_writer
from apu_casadi.core.sharing import BUILDING, keep, once

__all__ = ["batch", "digest", "flags_of", "framed", "in_lanes", "lanes_for", "lanes_in_use"]
__all__ += ["recalled", "source", "unsupported"]

WIDTHS = (1, 2, 4, 8)
#: Of the compiler by number of lanes on x86-64; elsewhere two lanes are what every processor has.
FLAGS: dict[int, tuple[str, ...]] = {
    2: (),
    4: ("-mavx2",),
    8: ("-mavx512f", "-mavx512dq", "-mavx512vl"),
}
_NEEDS = {4: {"avx2"}, 8: {"avx512f", "avx512dq", "avx512vl"}}
COMMON_FLAGS = ("-ffp-contract=off", "-Wno-psabi")
_X86 = ("x86_64", "AMD64")


def lanes_in_use() -> int:
    """Return how many points are evaluated at once here: 8, 4 or 2 by processor, 1 if none are.

    Raises:
        BackendError: ``$APU_LANES`` is none of the known numbers.
    """
    text = os.environ.get("APU_LANES", str(WIDTHS[-1]))
    if text not in map(str, WIDTHS):
        raise BackendError(f"$APU_LANES = {text!r}: one of {WIDTHS} is expected")
    return min(int(text), _widest()) if backend_in_use() == "c" else 1


def lanes_for(points: int) -> int:
    """Return how many lanes so many points take: no more than hold them all."""
    most = lanes_in_use()
    return min(most, next((n for n in WIDTHS if n >= points), most))


@once
def _widest() -> int:
    if platform.machine() not in _X86:
        return 2
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return 2
    flags = next((line.split() for line in text.splitlines() if line.startswith("flags")), [])
    return max((n for n, needs in _NEEDS.items() if needs <= set(flags)), default=2)


@once
def digest() -> str:
    """Tell one writer of code from another."""
    h = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.[cp]*")):
        h.update(path.read_bytes())
    return h.hexdigest()


# ------------------------------------------------------------------------------ one function


def in_lanes(
    fun: ca.Function,
    *,
    common: Sequence[int] = (),
    lanes: int | None = None,
    build: bool = True,
    level: int = 1,
) -> ca.Function:
    """Return ``fun`` for several points at once; inputs and outputs stand side by side.

    Args:
        fun: the function.
        common: positions of inputs that are the same for all points: they come once.
        lanes: how many points; by default what the processor takes at once.
        build, level: as in :func:`apu_casadi.core.backend.compiled`.

    Returns:
        A function of ``lanes`` columns for each column of ``fun``, of the bits of scalar C.  Where
        there is no compiler, or no library yet and ``build`` is False, or nothing that can be
        written in lanes, it is a map of ``fun``.

    Raises:
        BackendError: backend ``"c"`` was demanded and the compiler failed.
    """
    n = lanes_in_use() if lanes is None else lanes
    fixed = tuple(sorted(common))
    if n == 1 and not fixed and lanes is None:
        return compiled(fun, build=build, level=level)

    def make() -> ca.Function:
        made = None
        if backend_in_use() == "c" and n > 1:
            made = library(_code(fun, n, fixed), build=False, level=level)
            if made is None and build:
                with suppress(NoForm):
                    made = library(_written(fun, n, fixed), level=level)
        return _by_map(compiled(fun, build=build, level=level), n, fixed) if made is None else made

    if not build:
        with BUILDING:
            return make()
    return keep(fun, "lanes", (n, fixed, level, backend_in_use()), make)


def recalled(
    recipe: str,
    build: Callable[[], ca.Function],
    *,
    common: Sequence[int] = (),
    compile_missing: bool = True,
) -> ca.Function | None:
    """Return the function of a recipe for several points at once; None where there is none.

    As :func:`apu_casadi.core.backend.load_or_build`, whose arguments these are, and
    :func:`in_lanes`.
    """
    n = lanes_in_use()
    if n == 1:
        return None
    fixed = tuple(sorted(common))

    own = f"{recipe} {n} lanes {fixed} {digest()}"
    with suppress(NoForm):
        return load_library(
            own, build, lambda fun: _written(fun, n, fixed), compile_missing=compile_missing
        )
    return None


def _by_map(fun: ca.Function, n: int, common: tuple[int, ...]) -> ca.Function:
    if not common:
        return fun.map(n)
    return fun.map(f"{fun.name()}_x{n}", "serial", n, [*common], [])


def unsupported(fun: ca.Function) -> str:
    """Return what keeps a function from being written in lanes, in words; "" if nothing does."""

    def look() -> str:
        try:
            source(fun, 2)
        except NoForm as error:
            return str(error)
        return ""

    return keep(fun, "unsupported in lanes", None, look)


def _code(fun: ca.Function, n: int, common: tuple[int, ...]) -> Code:
    content = f"{fun.name()} {n} {common} {digest()}\n{fun.serialize()}"
    return Code(_name(fun, n), content, lambda: source(fun, n, common), flags_of(n))


def flags_of(lanes: int) -> tuple[str, ...]:
    """Return what the compiler is told for so many lanes."""
    return (*(FLAGS[lanes] if platform.machine() in _X86 else ()), *COMMON_FLAGS)


def _written(fun: ca.Function, n: int, common: tuple[int, ...]) -> Code:
    """Return the code, written now: what has no form is no failure of the compiler."""
    text = source(fun, n, common)
    return _code(fun, n, common)._replace(write=lambda: text)


def _name(fun: ca.Function, n: int) -> str:
    return f"{fun.name()}_x{n}"


# ------------------------------------------------------------------------------ its code

_FRAME = """
typedef long long I;
#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
EXPORT I NAME_n_in(void){return N_IN;}
EXPORT I NAME_n_out(void){return N_OUT;}
EXPORT const char*NAME_name_in(I i){static const char*const n[]={NAMES_IN};return n[i];}
EXPORT const char*NAME_name_out(I i){static const char*const n[]={NAMES_OUT};return n[i];}
EXPORT const I*NAME_sparsity_in(I i){PATTERNS_IN}
EXPORT const I*NAME_sparsity_out(I i){PATTERNS_OUT}
EXPORT int NAME_work(I*sz_arg,I*sz_res,I*sz_iw,I*sz_w){
*sz_arg=N_IN;*sz_res=N_OUT;*sz_iw=0;*sz_w=WORK;return 0;}
EXPORT int NAME(const double**arg,double**res,I*iw,double*w,int mem){
(void)iw;(void)mem;
"""


def framed(
    name: str,
    names_in: Sequence[str],
    names_out: Sequence[str],
    inputs: Sequence[ca.Sparsity],
    outputs: Sequence[ca.Sparsity],
    work: int,
) -> str:
    """Return what CasADi asks a library for, up to the body of ``name(arg, res, iw, w, mem)``."""
    words = {
        "NAME": name,
        "N_IN": str(len(names_in)),
        "N_OUT": str(len(names_out)),
        "NAMES_IN": ",".join(f'"{n}"' for n in names_in) or '""',
        "NAMES_OUT": ",".join(f'"{n}"' for n in names_out) or '""',
        "PATTERNS_IN": _patterns(inputs),
        "PATTERNS_OUT": _patterns(outputs),
        "WORK": str(work),
    }
    text = _FRAME
    for key in sorted(words, key=len, reverse=True):  # NAMES_IN before NAME
        text = text.replace(key, words[key])
    return text


def source(fun: ca.Function, lanes: int, common: Sequence[int] = ()) -> str:
    """Return the C code of a function for ``lanes`` points at once.

    Raises:
        NoForm: something in it has no form in lanes; the message names it.
    """
    writer = graph_writer(lanes)
    try:
        done = writer.function(fun)
    except NoForm as error:
        say(logging.INFO, f"by map: {error}")
        raise
    n_in, n_out = fun.n_in(), fun.n_out()
    wide = [1 if i in common else lanes for i in range(n_in)]
    inputs = [ca.repmat(fun.sparsity_in(i), 1, wide[i]) for i in range(n_in)]
    outputs = [ca.repmat(fun.sparsity_out(j), 1, lanes) for j in range(n_out)]
    sizes_in, sizes_out = [*map(fun.nnz_in, range(n_in))], [*map(fun.nnz_out, range(n_out))]
    total = sum(sizes_in) + sum(sizes_out) + done.work
    names = _name(fun, lanes), fun.name_in(), fun.name_out()
    text = framed(*names, inputs, outputs, (total + 1) * lanes)
    before, after = _wide_call(sizes_in, sizes_out, wide)
    call = f"{done.name}(a,r,v);"
    return "\n".join([writer.source(), text, *before, call, *after, "TO_SCALAR return 0;}", ""])


def _patterns(patterns: Sequence[ca.Sparsity]) -> str:
    rows = [
        f"static const I s{k}[]={{{','.join(map(str, s.compress()))}}};"
        for k, s in enumerate(patterns)
    ]
    listed = ",".join(f"s{k}" for k in range(len(patterns))) or "0"
    return f"{' '.join(rows)} const I*const s[]={{{listed}}};return s[i];"


def _pointers(T: str, where: str, n_in: int, n_out: int) -> str:
    a = ",".join(f"{where.format(k)}" for k in range(n_in)) or "0"
    r = ",".join(f"{where.format(n_in + k)}" for k in range(n_out)) or "0"
    return f"const {T}*const a[]={{{a}}};{T}*const r[]={{{r}}};"


def _wide_call(
    n_in: Sequence[int], n_out: Sequence[int], wide: Sequence[int]
) -> tuple[list[str], list[str]]:
    """Code that puts columns into lanes before the call, and back after it."""
    before = ["V*v=(V*)(((uintptr_t)w+8*L-1)&~(uintptr_t)(8*L-1));"]
    before.append("V at;for(int l=0;l<L;l++)at[l]=l;")
    for k, n in enumerate([*n_in, *n_out]):
        before.append(f"V*const b{k}=v;v+={n};")
    for k, n in enumerate(n_in):
        zero = f"else for(int k=0;k<{n};k++)b{k}[k]=v_all(0.0);"
        copy = f"for(int k=0;k<{n};k++)b{k}[k]=v_all(arg[{k}][k]);"
        if wide[k] > 1:
            copy = f"v_rows(arg[{k}],at*v_all({n}.0),{n},b{k});"
        before.append(f"if(arg[{k}]){copy}{zero}")
    after = [f"if(res[{k}])v_back(b{k + len(n_in)},{n},L,res[{k}]);" for k, n in enumerate(n_out)]
    before.append(_pointers("V", "b{}", len(n_in), len(n_out)))
    return before, after


# ------------------------------------------------------------------------------ many points


def batch(
    fun: ca.Function,
    n_threads: int | None = None,
    *,
    common: Sequence[int] = (),
    chunk: int = 1024,
    build: bool = True,
    level: int = 1,
) -> Mapped:
    """Return ``fun`` over any number of columns, in lanes and on several threads.

    Args:
        fun: function whose inputs and outputs are columns.
        n_threads: default all cores that the process may use.
        common: positions of inputs that are the same for all columns.
        chunk: columns per evaluation, which bound the memory.
        build, level: as in :func:`in_lanes`.

    Raises:
        BackendError: an input or output is not a column.
    """
    n = lanes_in_use()
    wide = in_lanes(fun, common=common, lanes=n, build=build, level=level)
    own = {"width": n, "common": tuple(common), "name": fun.name()}
    return Mapped(wide, n_threads, chunk=chunk, **own)
