"""C code of CasADi functions on vectors: each operation acts on several points at once, its lanes.

The instruction list of a function is a straight line, so each instruction becomes one operation on
a vector of ``lanes`` doubles, by the vector extensions of GCC and Clang.  Lanes never meet: what is
in one, NaN included, does not change another.

Every operation is the one that CasADi's own C has, in the same order, and without fused
multiply-add.  Exponentials and the like are those of :mod:`apu_casadi.core.lanes.vectormath`; for
other functions the C library is called once for each lane.  So results are those of the scalar
code to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import casadi as ca

from apu_casadi.core.errors import BackendError
from apu_casadi.core.lanes.vectormath import VECTOR, vector_math

# {p} is the width's prefix, {a} and {b} are the operands
_UNARY = """
ASSIGN {a}|LIFT {a}|NEG -{a}|SQ {a}*{a}|TWICE 2.0*{a}|INV 1.0/{a}|NOT {p}num({a}==0.0)
SIGN {p}sel({a}<0.0,{p}all(-1.0),{p}sel({a}>0.0,{p}all(1.0),{a}))
"""
_BINARY = """
ADD {a}+{b}|SUB {a}-{b}|MUL {a}*{b}|DIV {a}/{b}|POW {p}pow({a},{b})|CONSTPOW {p}pow({a},{b})
LT {p}num({a}<{b})|LE {p}num({a}<={b})|EQ {p}num({a}=={b})|NE {p}num({a}!={b})
AND {p}num(({a}!=0.0)&({b}!=0.0))|OR {p}num(({a}!=0.0)|({b}!=0.0))
IF_ELSE_ZERO {p}sel({a}!=0.0,{b},{p}all(0.0))
"""
#: Functions of one and of two arguments that the C library is asked for in each lane.
_LIBM = """exp log sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh erf log1p expm1
pow fmod atan2 hypot remainder copysign"""
_CALLS_1, _CALLS_2 = (line.split() for line in _LIBM.split("\n"))
_OWN_1, _OWN_2 = ["sqrt", "fabs", "floor", "ceil"], ["fmin", "fmax"]  # of the prelude


def _table(text: str) -> dict[int, str]:
    rows = (row.strip().split(" ", 1) for line in text.split("\n") for row in _parts(line))
    return {getattr(ca, f"OP_{name}"): code for name, code in rows}


def _parts(line: str) -> list[str]:
    """Split a line of a table at bars that stand outside brackets."""
    found, depth = [""], 0
    for c in line:
        depth += (c == "(") - (c == ")")
        if c == "|" and not depth:
            found.append("")
        else:
            found[-1] += c
    return [f for f in found if f.strip()]


UNARY = _table(_UNARY) | {
    getattr(ca, f"OP_{n.upper()}"): f"{{p}}{n}({{a}})" for n in (*_CALLS_1, *_OWN_1)
}
BINARY = _table(_BINARY) | {
    getattr(ca, f"OP_{n.upper()}"): f"{{p}}{n}({{a}},{{b}})" for n in (*_CALLS_2[1:], *_OWN_2)
}
NAMES = {getattr(ca, n): n for n in dir(ca) if n.startswith("OP_")}

_PRELUDE = """
#include <math.h>
#include <stdint.h>
#include <string.h>
#if defined(__SSE2__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif
#define L LANES
/* goes before scalar code of other libraries, which has no AVX: while the upper parts of registers
   hold something, each of its instructions waits for them.  Compilers put it by themselves only
   from -O2 on. */
#if defined(__AVX__)
#define TO_SCALAR _mm256_zeroupper();
#else
#define TO_SCALAR
#endif
typedef double V __attribute__((vector_size(8*L)));
typedef int64_t M __attribute__((vector_size(8*L)));
#define IN static inline __attribute__((always_inline,unused))
/* written out: a loop over lanes is compiled to one insertion for each */
IN V v_all(double a){return (V){ALL_LANES};}
IN V v_num(M m){return (V)(m&(M)v_all(1.0));}
/* a mask as bits, one for each lane; choice by a mask */
#if L==8 && defined(__AVX512DQ__)
IN unsigned v_bits(M m){return _mm512_movepi64_mask((__m512i)m);}
IN V v_sel(M m,V a,V b){
return (V)_mm512_mask_blend_pd(_mm512_movepi64_mask((__m512i)m),(__m512d)b,(__m512d)a);}
#elif L==4 && defined(__AVX__)
IN unsigned v_bits(M m){return _mm256_movemask_pd((__m256d)m);}
IN V v_sel(M m,V a,V b){return (V)_mm256_blendv_pd((__m256d)b,(__m256d)a,(__m256d)m);}
#else
IN unsigned v_bits(M m){unsigned r=0;for(int l=0;l<L;l++)r|=(unsigned)(m[l]&1)<<l;return r;}
IN V v_sel(M m,V a,V b){return (V)((m&(M)a)|(~m&(M)b));}
#endif
IN int v_any(M m){return v_bits(m)!=0;}
#if defined(__clang__)
/* it has code of its own for these, which tells one zero from the other in its own way */
IN V v_fmin(V a,V b){V r;for(int l=0;l<L;l++)r[l]=fmin(a[l],b[l]);return r;}
IN V v_fmax(V a,V b){V r;for(int l=0;l<L;l++)r[l]=fmax(a[l],b[l]);return r;}
#else
/* as the C library says of numbers that are missing: the other one */
IN V v_fmin(V a,V b){return v_sel((a<b)|(b!=b),a,b);}
IN V v_fmax(V a,V b){return v_sel((a>b)|(b!=b),a,b);}
#endif
IN V v_fabs(V a){return (V)((M)a&~(M)v_all(-0.0));}
/* n numbers that begin at another place of a table in each lane: rows are read, and turned */
#if L==8 && defined(__AVX512F__)
#define TURNED 8
#define LO(a,b) _mm512_unpacklo_pd(a,b)
#define HI(a,b) _mm512_unpackhi_pd(a,b)
#define EVEN(a,b) _mm512_shuffle_f64x2(a,b,0x88)
#define ODD(a,b) _mm512_shuffle_f64x2(a,b,0xdd)
#define HALF(to,f,r,a,b,c,d) {\
const __m512d p=f(r[0],r[1]),q=f(r[2],r[3]),s=f(r[4],r[5]),t=f(r[6],r[7]);\
to[a]=(V)EVEN(EVEN(p,q),EVEN(s,t));to[b]=(V)EVEN(ODD(p,q),ODD(s,t));\
to[c]=(V)ODD(EVEN(p,q),EVEN(s,t));to[d]=(V)ODD(ODD(p,q),ODD(s,t));}
IN void v_turned(const double*t,const int*i,V*to){
__m512d r[8];for(int l=0;l<8;l++)r[l]=_mm512_loadu_pd(t+i[l]);
HALF(to,LO,r,0,2,4,6) HALF(to,HI,r,1,3,5,7)}
#elif L==4 && defined(__AVX__)
#define TURNED 4
IN void v_turned(const double*t,const int*i,V*to){
__m256d r[4];for(int l=0;l<4;l++)r[l]=_mm256_loadu_pd(t+i[l]);
const __m256d a=_mm256_unpacklo_pd(r[0],r[1]),b=_mm256_unpackhi_pd(r[0],r[1]);
const __m256d c=_mm256_unpacklo_pd(r[2],r[3]),d=_mm256_unpackhi_pd(r[2],r[3]);
to[0]=(V)_mm256_permute2f128_pd(a,c,0x20);to[1]=(V)_mm256_permute2f128_pd(b,d,0x20);
to[2]=(V)_mm256_permute2f128_pd(a,c,0x31);to[3]=(V)_mm256_permute2f128_pd(b,d,0x31);}
#endif
IN void v_rows(const double*t,V q,int n,V*to){
int i[L],k=0;for(int l=0;l<L;l++)i[l]=(int)q[l];
#ifdef TURNED
for(;k+TURNED<=n;k+=TURNED)v_turned(t+k,i,to+k);
#endif
for(int l=0;l<L;l++)for(int j=k;j<n;j++)((double*)to)[j*L+l]=t[i[l]+j];}
/* n numbers of some lanes, those of a lane side by side */
IN void v_back(const V*r,int n,int some,double*to){
int k=0;
#ifdef TURNED
int i[L];for(int l=0;l<L;l++)i[l]=l*L;
for(;k+L<=n;k+=L){
V t[L];v_turned((const double*)(r+k),i,t);
for(int l=0;l<some;l++)memcpy(to+l*n+k,t+l,sizeof(V));}
#endif
for(int l=0;l<some;l++)for(int j=k;j<n;j++)to[l*n+j]=((const double*)r)[j*L+l];}
#define EACH(f) static V v_##f(V a){V r;TO_SCALAR for(int l=0;l<L;l++)r[l]=f(a[l]);return r;}
#if L==8 && defined(__AVX512F__)
IN V v_sqrt(V a){return (V)_mm512_sqrt_pd((__m512d)a);}
IN V v_floor(V a){return (V)_mm512_roundscale_pd((__m512d)a,_MM_FROUND_TO_NEG_INF|8);}
IN V v_ceil(V a){return (V)_mm512_roundscale_pd((__m512d)a,_MM_FROUND_TO_POS_INF|8);}
#elif L==4 && defined(__AVX__)
IN V v_sqrt(V a){return (V)_mm256_sqrt_pd((__m256d)a);}
IN V v_floor(V a){return (V)_mm256_floor_pd((__m256d)a);}
IN V v_ceil(V a){return (V)_mm256_ceil_pd((__m256d)a);}
#elif L==2 && defined(__SSE2__)
IN V v_sqrt(V a){return (V)_mm_sqrt_pd((__m128d)a);}
__attribute__((unused)) EACH(floor)
__attribute__((unused)) EACH(ceil)
#elif L==2 && defined(__aarch64__)
IN V v_sqrt(V a){return (V)vsqrtq_f64((float64x2_t)a);}
IN V v_floor(V a){return (V)vrndmq_f64((float64x2_t)a);}
IN V v_ceil(V a){return (V)vrndpq_f64((float64x2_t)a);}
#else
__attribute__((unused)) EACH(sqrt)
__attribute__((unused)) EACH(floor)
__attribute__((unused)) EACH(ceil)
#endif
"""


Fixed: TypeAlias = tuple[int, ...]
Maker: TypeAlias = "Callable[[Writer, ca.Function, str, Fixed], int]"


class NoForm(BackendError):  # noqa: N818 - reads as what it tells
    """Something in a function has no form in lanes."""


class Written(NamedTuple):
    """A C function ``name(arg, res, w)``: pointers to inputs and outputs, and work.

    Args:
        name: of the C function.
        work: vectors (or numbers) of work that it needs.
    """

    name: str
    work: int


class Writer:
    """Writes functions and what they call, each once.

    Args:
        lanes: points at once.
    """

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        self._text: list[str] = []
        self._known: dict[tuple[int, Fixed], Written] = {}
        self._held: list[ca.Function] = []  # hashes are of objects that live
        self._tables: dict[str, str] = {}
        self._makers: dict[str, Maker] = {}
        self.add("SXFunction", _straight_line)

    def add(self, kind: str, make: Maker) -> None:
        """Say who writes functions of a kind: (writer, function, name, fixed) -> work."""
        self._makers[kind] = make

    def function(self, fun: ca.Function, fixed: Fixed = ()) -> Written:
        """Write a function, or find it written.

        Args:
            fun: the function.
            fixed: inputs of a map that are the same for all its columns, and come once.

        Raises:
            NoForm: it holds something that has no form in lanes; the message names it.
        """
        key = (hash(fun), fixed)
        if key not in self._known:
            make = self._makers.get(fun.class_name())
            if make is None:
                raise NoForm(
                    f"{fun.name()} is of the kind {fun.class_name()}, which has no form in lanes; "
                    "SX and MX functions, their maps and fast_newton have (expand() makes a "
                    "function of scalar operations where that is possible)"
                )
            self._held.append(fun)
            name = f"f{len(self._known)}_{len(self._held)}"
            self._known[key] = Written(name, make(self, fun, name, fixed))
        return self._known[key]

    def put(self, text: str) -> None:
        """Append a C function."""
        self._text.append(text)

    def table(self, kind: str, values: list[str]) -> str:
        """Return the name of a constant array, one for equal contents."""
        body = f"[{max(1, len(values))}]={{{','.join(values) or '0'}}};"
        key = f"{kind} {body}"
        if key not in self._tables:
            self._tables[key] = f"t{len(self._tables)}"
        return self._tables[key]

    def source(self) -> str:
        """Return all that was written."""
        prelude = _PRELUDE.replace("ALL_LANES", ",".join("a" * self.lanes))
        prelude = prelude.replace("LANES", str(self.lanes))
        calls = [f"EACH({n})" for n in _CALLS_1 if n not in VECTOR]
        two = "static V v_{0}(V a,V b){{V r;TO_SCALAR "
        two += "for(int l=0;l<L;l++)r[l]={0}(a[l],b[l]);return r;}}"
        calls += [two.format(n) for n in _CALLS_2 if n not in VECTOR]
        tables = []
        for key, name in self._tables.items():
            kind, body = key.split(" ", 1)
            tables.append(f"static const {kind} {name}{body}")
        unused = [f"__attribute__((unused)) {c}" for c in calls]
        return "\n".join([prelude, vector_math(self.lanes), *unused, *tables, *self._text, ""])


def number(value: float) -> str:
    """Return a double as C reads it back, to the last bit."""
    if math.isfinite(value):
        return repr(float(value))
    return "NAN" if math.isnan(value) else f"{'-' if value < 0 else ''}INFINITY"


def refused(fun: ca.Function, op: int) -> NoForm:
    """Return the error for an operation that has no form in lanes."""
    name = NAMES.get(op, str(op)).removeprefix("OP_")
    return NoForm(
        f"{fun.name()}: the operation {name} has no form in lanes; write it by others, or evaluate "
        "this function by map"
    )


def _straight_line(writer: Writer, fun: ca.Function, name: str, _: Fixed) -> int:
    """Write an SX function; it needs no work: compilers choose what stays in registers."""
    p, T = "v_", "V"
    body = []
    for k in range(fun.n_instructions()):
        op, o, i = fun.instruction_id(k), fun.instruction_output(k), fun.instruction_input(k)
        if op == ca.OP_CONST:
            body.append(f"w{o[0]}={p}all({number(fun.instruction_constant(k))});")
        elif op == ca.OP_INPUT:
            body.append(f"w{o[0]}=a[{i[0]}][{i[1]}];")
        elif op == ca.OP_OUTPUT:
            body.append(f"r[{o[0]}][{o[1]}]=w{i[0]};")
        elif op in UNARY:
            body.append(f"w{o[0]}={UNARY[op].format(p=p, a=f'w{i[0]}')};")
        elif op in BINARY:
            body.append(f"w{o[0]}={BINARY[op].format(p=p, a=f'w{i[0]}', b=f'w{i[1]}')};")
        else:
            raise refused(fun, op)
    names = ",".join(f"w{k}" for k in range(max(1, fun.sz_w())))
    head = f"static void {name}(const {T}*const*a,{T}*const*r,{T}*w){{\n{T} {names};"
    writer.put("\n".join([head, *body, "}"]))
    return 0
