"""Compiled C of a function for one point, in which maps and products of matrices use lanes.

A filter with sigma points evaluates its model at dozens of points in each step; the rest of the
step, a root here and a reflection there, is one straight line.  So the C that CasADi writes stays,
but for its loops over the points of a map and over the rows of a dense product: these take as many
at once as there are lanes.  Each point, and each entry, has the bits that it has in the loop.
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
TO_SCALAR return 0;}
"""

#: z + x y of dense matrices, rows in lanes and columns of y side by side: a sum waits for each of
#: its additions.  Every entry is summed in CasADi's order.
_PRODUCT = """
#if L==8 && defined(__AVX512F__)
#define REST __mmask8
#define V_REST(r) (__mmask8)((1u<<(r))-1)
#define V_FROM(m,p) (V)_mm512_maskz_loadu_pd(m,p)
#define V_TO(m,p,v) _mm512_mask_storeu_pd(p,m,(__m512d)(v))
#elif L==4 && defined(__AVX__)
#define REST __m256i
#define V_REST(r) _mm256_cmpgt_epi64(_mm256_set1_epi64x(r),_mm256_setr_epi64x(0,1,2,3))
#define V_FROM(m,p) (V)_mm256_maskload_pd(p,m)
#define V_TO(m,p,v) _mm256_maskstore_pd(p,m,(__m256d)(v))
#else
#define REST int
#define V_REST(r) (r)
IN V V_FROM(int m,const double*p){V v=v_all(0.0);for(int l=0;l<m;l++)v[l]=p[l];return v;}
IN void V_TO(int m,double*p,V v){for(int l=0;l<m;l++)p[l]=v[l];}
#endif
#define COLUMNS(C) for(;i+C<=q;i+=C)for(casadi_int j=0;j<n;j+=L){\
const REST m=V_REST(n-j<L?n-j:L);V s[C];for(int c=0;c<C;c++)s[c]=V_FROM(m,z+j+(i+c)*n);\
for(casadi_int k=0;k<p;k++){const V b=V_FROM(m,x+j+k*n);\
for(int c=0;c<C;c++)s[c]=s[c]+b*v_all(y[k+(i+c)*p]);}\
for(int c=0;c<C;c++)V_TO(m,z+j+(i+c)*n,s[c]);}
static void product(const double*x,casadi_int n,casadi_int p,const double*y,casadi_int q,double*z){
casadi_int i=0;COLUMNS(4)COLUMNS(1)TO_SCALAR}
"""
_BY_ROWS = "  if (!tr) { product(x, nrow_x, ncol_x, y, ncol_y, z); return; }\n"


def points_in_lanes(
    fun: ca.Function, *, backend: str | None = None, build: bool = True, level: int = 1
) -> ca.Function:
    """Return ``fun`` compiled, its maps of functions in scalar operations with points in lanes.

    So are the rows of its products of matrices.  Arguments and errors as of
    :func:`apu_casadi.core.backend.compiled`, which this is where there are no such maps, or no
    lanes.
    """
    maps = {f.name(): f for f in _maps(fun)}
    lanes = lanes_for(max((_count(f) for f in maps.values()), default=1))
    usual = backend not in (None, READY)
    if usual or backend_in_use() != "c" or lanes == 1 or not maps:
        return compiled(fun, backend=backend, build=build, level=level)
    content = f"{fun.name()} points {lanes} {digest()}\n{fun.serialize()}"
    code = Code(fun.name(), content, lambda: _source(fun, maps, lanes), flags_of(lanes))
    with BUILDING:
        made = library(code, build=build and backend != READY, level=level)
    return made or compiled(fun, backend=backend, build=build, level=level)


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
        body = rf"(/\* {re.escape(name)}:.*?\*/\nstatic int \w+\([^)]*\) \{{\n).*?\n\}}\n"
        call = rf"\g<1>  (void)iw;(void)w;(void)mem;return points_{k}(arg,res);\n}}\n"
        replaced, n = re.subn(body, call, text, flags=re.S)
        if not n:
            raise NoForm(f"{fun.name()}: CasADi's code for the map {name} is not what is expected")
        if n == 1:  # of several with one name nothing tells which is which: they stay as they are
            own.append(_points(writer, mapped, f"points_{k}"))
            text = replaced
    text = re.sub(r"(\nvoid casadi_mtimes_dense\([^{]*\{\n)", rf"\g<1>{_BY_ROWS}", text, count=1)
    # as the C library has them; a call of it would empty all registers
    for name, sign in (("fmin", "<"), ("fmax", ">")):
        text = re.sub(rf"return {name}\(x, y\);", f"return y!=y||x{sign}y?x:y;", text)
    # not to be found from outside, so that the compiler may put them where they are called
    text = re.sub(r"\n(void|casadi_real|casadi_int) casadi_", r"\nstatic \1 casadi_", text)
    at = text.index("/* ", text.index("/* Add prefix to internal symbols") + 1)
    return "\n".join([text[:at], writer.source(), _PRODUCT, *own, text[at:]])


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
        back.append(f"if(res[{j}])v_back(r{j},{n},n,res[{j}]+c*{n});")
    words = {"POINTS": name, "COUNT": str(count), "LAST": str(count - 1), "CALL": done.name}
    words |= {"MADE": ",".join(f"r{j}" for j in range(inner.n_out())), "ROOM": "\n".join(room)}
    words |= {"TAKEN": ",".join(f"a{i}" for i in range(inner.n_in())), "BACK": "\n".join(back)}
    text = _POINTS.replace("GIVEN", "\n".join(given))
    for key, value in words.items():
        text = text.replace(key, value)
    return text
