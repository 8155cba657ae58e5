"""Compiled C of a function for one point, in which maps have their own points in lanes.

A filter with sigma points evaluates its model at dozens of points in each step; the rest of the
step, a root here and a reflection there, is one straight line.  So the C that CasADi writes stays,
but for its loops over the points of a map: these take as many at once as there are lanes.  Each
point has the bits that it has in the loop.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import casadi as ca

from apu_casadi.core.backend import READY, Code, backend_in_use, compiled, library
from apu_casadi.core.lanes.lanecode import NoForm, Writer
from apu_casadi.core.lanes.lanegraph import map_of
from apu_casadi.core.lanes.lanelibrary import digest, flags_of, lanes_for
from apu_casadi.core.sharing import BUILDING

__all__ = ["points_in_lanes"]

_POINTS = """
static int POINTS(const double**arg,double**res){
ROOM
V*const r[]={MADE};const V*const a[]={TAKEN};
for(int c=0;c<COUNT;c+=L){
V q;for(int l=0;l<L;l++)q[l]=c+l<COUNT?c+l:LAST;
const int n=COUNT-c<L?COUNT-c:L;
GIVEN
CALL(a,r,0);
BACK}
DONE return 0;}
"""


def points_in_lanes(
    fun: ca.Function, *, backend: str | None = None, build: bool = True
) -> ca.Function:
    """Return ``fun`` compiled, its maps of functions in scalar operations with points in lanes.

    Arguments and errors as of :func:`apu_casadi.core.backend.compiled`, which this is where there
    are no such maps, or no lanes.
    """
    maps = {f.name(): f for f in _maps(fun)}
    lanes = lanes_for(max((_count(f) for f in maps.values()), default=1))
    usual = backend not in (None, READY)
    if usual or backend_in_use() != "c" or lanes == 1 or not maps:
        return compiled(fun, backend=backend, build=build)
    content = f"{fun.name()} points {lanes} {digest()}\n{fun.serialize()}"
    code = Code(fun.name(), content, lambda: _source(fun, maps, lanes), flags_of(lanes))
    with BUILDING:
        made = library(code, build=build and backend != READY)
    return compiled(fun, backend=backend, build=build) if made is None else made


def _maps(fun: ca.Function) -> Iterator[ca.Function]:
    """Maps of SX functions that a function calls, at any depth, with what is common to points."""
    if fun.is_a("SXFunction"):
        return
    for name in fun.get_function():
        inner = fun.get_function(name)
        if _mapped(inner) is not None:
            yield inner
        else:
            yield from _maps(inner)


def _mapped(fun: ca.Function) -> tuple[ca.Function, int] | None:
    """What a map of an SX function evaluates, and for how many points; None for another function.

    Where inputs are common to all points, the map stands in a function that repeats them.
    """
    if fun.class_name() == "Map":
        found = map_of(fun)
        return found if found[0].is_a("SXFunction") else None
    if not fun.is_a("MXFunction"):
        return None
    only = {ca.OP_INPUT, ca.OP_HORZREPMAT, ca.OP_CALL, ca.OP_OUTPUT}
    ops = [fun.instruction_id(k) for k in range(fun.n_instructions())]
    called = [fun.get_function(n) for n in fun.get_function()]
    if not set(ops) <= only or ops.count(ca.OP_CALL) != 1 or len(called) != 1:
        return None
    made = _mapped(called[0]) if called[0].class_name() == "Map" else None
    if made is None or fun.name_in() != called[0].name_in() or fun.n_out() != called[0].n_out():
        return None
    return made


def _count(mapped: ca.Function) -> int:
    found = _mapped(mapped)
    return 1 if found is None else found[1]


def _source(fun: ca.Function, maps: dict[str, ca.Function], lanes: int) -> str:
    """Return CasADi's C with the bodies of maps replaced."""
    generator = ca.CodeGenerator("code.c", {"with_header": False, "verbose": True})
    generator.add(fun)
    text: str = generator.dump()
    writer, own = Writer(lanes), []
    for k, (name, mapped) in enumerate(maps.items()):
        own.append(_points(writer, mapped, f"points_{k}"))
        body = rf"(/\* {re.escape(name)}:.*?\*/\nstatic int \w+\([^)]*\) \{{\n).*?\n\}}\n"
        call = rf"\g<1>  (void)iw;(void)w;(void)mem;return points_{k}(arg,res);\n}}\n"
        text, n = re.subn(body, call, text, count=1, flags=re.S)
        if n != 1:
            raise NoForm(f"{fun.name()}: CasADi's code for the map {name} is not what is expected")
    at = text.index("/* ", text.rindex("#define casadi_"))
    return "\n".join([text[:at], writer.source(), *own, text[at:]])


def _points(writer: Writer, mapped: ca.Function, name: str) -> str:
    """Return the C of a map's points, packs of lanes one after the other."""
    found = _mapped(mapped)
    assert found is not None
    inner, count = found
    done = writer.function(inner)
    room, given, back = [], [], []
    for i in range(inner.n_in()):
        n = inner.nnz_in(i)
        room.append(f"V a{i}[{max(1, n)}];for(int k=0;k<{n};k++)a{i}[k]=v_all(0.0);")
        if mapped.nnz_in(i) == n:
            room.append(f"if(arg[{i}])for(int k=0;k<{n};k++)a{i}[k]=v_all(arg[{i}][k]);")
        else:
            given.append(f"if(arg[{i}])v_rows(arg[{i}],q*v_all({n}.0),{n},a{i});")
    for j in range(inner.n_out()):
        n = inner.nnz_out(j)
        room.append(f"V r{j}[{max(1, n)}];")
        loop = f"for(int l=0;l<n;l++)for(int k=0;k<{n};k++)"
        back.append(f"if(res[{j}]){loop}res[{j}][(c+l)*{n}+k]=((double*)r{j})[k*L+l];")
    words = {"POINTS": name, "COUNT": str(count), "LAST": str(count - 1), "CALL": done.name}
    words |= {"MADE": ",".join(f"r{j}" for j in range(inner.n_out())), "ROOM": "\n".join(room)}
    words |= {"TAKEN": ",".join(f"a{i}" for i in range(inner.n_in())), "BACK": "\n".join(back)}
    text = _POINTS.replace("GIVEN", "\n".join(given))
    for key, value in words.items():
        text = text.replace(key, value)
    return text
