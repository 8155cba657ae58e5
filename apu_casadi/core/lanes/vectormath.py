"""Exponential, logarithm, power, sine and cosine of all lanes at once, with the C library's bits.

Each is evaluated as a sum hi + lo of two doubles to some 2^-62 of itself: argument reduction with
a table, a short series, fused multiply-adds for the errors of products (Muller et al., Handbook of
Floating-Point Arithmetic, 2nd ed., chapters 4, 5, 10).  The C library of GNU (2.28 and later) tells
how far its own results are from the true ones at most: 0.511 units in the last place for ``exp``,
0.519 for ``log``, 0.53 for ``pow``, 0.55 for ``sin`` and ``cos``.  Where lo is so small that no
other double is that near, its result must be hi, whatever its algorithm is (Ziv's rounding test);
elsewhere, three lanes in a hundred of ``exp`` and eleven of ``sin``, and for arguments that are out
of range or not numbers, the C library is asked for that lane.

Other C libraries are asked for every lane, and so is this one where there are fewer than eight
lanes: without instructions that look up a table in registers that is as fast.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal, localcontext

__all__ = ["VECTOR", "vector_math"]

VECTOR = ("exp", "log", "sin", "cos", "pow")
EXP_STEPS, TURN = 16, 64  # entries of the tables of 2^(j/16) and of sin(2 pi j/64)
# where the intervals of the logarithm begin: 1 is where both halves of its own are equally wide
LOG_STEPS, LOG_FIRST = 16, 0x3FE6555555555555
PI = "3.14159265358979323846264338327950288419716939937510582097494459230781640628620899"

_CODE = r"""
#if defined(__GLIBC__) && defined(__GLIBC_MINOR__)
#if __GLIBC__>2 || __GLIBC_MINOR__>=28
#if L==8 && defined(__AVX512F__) && defined(__AVX512DQ__)
#define VECTOR_MATH
#define FMA(a,b,c) ((V)_mm512_fmadd_pd((__m512d)(a),(__m512d)(b),(__m512d)(c)))
#define OF16(t,i) ((V)_mm512_permutex2var_pd(_mm512_loadu_pd(t),(__m512i)(i),_mm512_loadu_pd(t+8)))
#define OF64(t,i) ((V)_mm512_i64gather_pd((__m512i)(i),t,8))
#define SHIFT_52(i) ((M)_mm512_srai_epi64((__m512i)(i),52))
#define NUMBER(i) ((V)_mm512_cvtepi64_pd((__m512i)(i)))
#endif
#endif
#endif
#ifdef VECTOR_MATH
#define C(x) v_all(x)
#define ROUND C(0x1.8p52)
#define NI static __attribute__((noinline,unused))
/* asks the C library for the lanes whose bits are set */
#define SLOW_1(f) NI V slow_##f(V y,V a,unsigned bits){\
for(;bits;bits&=bits-1){const int l=__builtin_ctz(bits);\
((double*)&y)[l]=f(((double*)&a)[l]);}return y;}
#define SLOW_2(f) NI V slow_##f(V y,V a,V b,unsigned bits){\
for(;bits;bits&=bits-1){const int l=__builtin_ctz(bits);\
((double*)&y)[l]=f(((double*)&a)[l],((double*)&b)[l]);}return y;}
SLOW_1(exp) SLOW_1(log) SLOW_1(sin) SLOW_1(cos) SLOW_2(pow)
/* hi + lo, to be rounded; ok: the C library, off by e at most, has no choice (share = 1/(2-2e)) */
IN V rounded(V hi,V lo,double share,M*ok){
const V y=hi+lo,rest=(hi-y)+lo;*ok=y==y+rest*C(share);return y;}
/* 2^m T (1 + t + ...) of x + tail, |x| < 708; tail far smaller */
IN V exp_of(V x,V tail,double share,M*ok){
const V z=FMA(x,C(EXP_INV),ROUND),k=z-ROUND;const M i=(M)z;
const V a=FMA(k,C(-EXP_L1),x),t=FMA(k,C(-EXP_L2),a),rest=FMA(k,C(-EXP_L2),a-t)+tail;
const M j=i&(M){EXP_MASK};const V T=OF16(exp_hi,j),Tl=OF16(exp_lo,j);
V s=C(1.0/40320);s=FMA(s,t,C(1.0/5040));s=FMA(s,t,C(1.0/720));s=FMA(s,t,C(1.0/120));
s=FMA(s,t,C(1.0/24));s=FMA(s,t,C(1.0/6));s=FMA(s,t,C(0.5));
s=FMA(s,t*t,rest);s=FMA(rest,t,s);
const V u=T*t,ul=FMA(T,t,-u),hi=T+u,lo=((T-hi)+u)+(ul+FMA(T,s,FMA(Tl,t,Tl)));
const V y=rounded(hi,lo,share,ok);
return (V)((M)y+((i-j)<<(52-4)));}
/* log x = *hi + *lo of normal positive numbers */
IN void log_of(V x,V*hi,V*lo){
const M from=(M)x-(M){LOG_FROM},e=SHIFT_52(from),j=(from>>(52-4))&(M){EXP_MASK};
const V m=(V)((M)x-(e<<52)),q=OF16(log_inv,j),k=NUMBER(e);
const V p=m*q,pl=FMA(m,q,-p),r=p-C(1.0);
const V A=FMA(k,C(LOG_L1),OF16(log_hi,j)),B=FMA(k,C(LOG_L2),OF16(log_lo,j));
V s=C(-1.0/12);LOG_SERIES
const V h=A+r,e1=(A-h)+r,rr=r*r,rl=FMA(r,r,-rr),g=FMA(rr,C(-0.5),h),e2=FMA(rr,C(-0.5),h-g);
const V f=FMA(FMA(r,r,-r),pl,pl);
const V l=FMA(s,rr*r,(e1+e2)+(FMA(rl,C(-0.5),f)+B));
*hi=g+l;*lo=(g-*hi)+l;}
NI V v_exp(V x){M ok;const M in=(x>C(-708.0))&(x<C(709.0));
const V y=exp_of(v_sel(in,x,C(0.0)),C(0.0),1.025,&ok);ok&=in;
const unsigned no=v_bits(~ok);return no?slow_exp(y,x,no):y;}
NI V v_log(V x){V h,l;M ok;const M in=(x>=C(0x1p-1022))&(x<C(INFINITY));
log_of(v_sel(in,x,C(1.0)),&h,&l);
const V y=rounded(h,l,1.045,&ok);ok&=in;
const unsigned no=v_bits(~ok);return no?slow_log(y,x,no):y;}
NI V v_pow(V x,V b){V h,l;M ok;M in=(x>=C(0x1p-1022))&(x<C(INFINITY))&(v_fabs(b)<C(1e6));
log_of(v_sel(in,x,C(1.0)),&h,&l);
const V c=v_sel(in,b,C(0.0)),p=c*h,t=FMA(c,l,FMA(c,h,-p));in&=v_fabs(p)<C(8.0);
const V y=exp_of(v_sel(in,p,C(0.0)),v_sel(in,t,C(0.0)),1.08,&ok);ok&=in;
const unsigned no=v_bits(~ok);return no?slow_pow(y,x,b,no):y;}
/* S cos r + C sin r, where x = j 2 pi/64 + r */
IN V sin_of(V x,int more,M*ok){
const M in=v_fabs(x)<C(4e5);
const V d=v_sel(in,x,C(1.0)),z=FMA(d,C(SIN_INV),ROUND),n=z-ROUND;
const M j=((M)z+more)&(M){TURN_MASK};
const V a=FMA(n,C(-SIN_L1),d),b=n*C(-SIN_L2),th=a+b,bb=th-a,tl=(a-(th-bb))+(b-bb);
const V w=FMA(n,C(-SIN_L3),tl),r=th+w,rl=(th-r)+w;
const V S=OF64(sin_hi,j),Sl=OF64(sin_lo,j),K=OF64(cos_hi,j),Kl=OF64(cos_lo,j),q=r*r;
V s=C(1.0/362880),c=C(-1.0/3628800);
s=FMA(s,q,C(-1.0/5040));s=FMA(s,q,C(1.0/120));s=FMA(s,q,C(-1.0/6));
c=FMA(c,q,C(1.0/40320));c=FMA(c,q,C(-1.0/720));c=FMA(c,q,C(1.0/24));c=FMA(c,q,C(-0.5));
s=FMA(s*q,r,rl);c=FMA(c,q,-r*rl); /* sin r - r, cos r - 1 */
const V u=K*r,ul=FMA(K,r,-u),h=S+u,back=h-S,e=(S-(h-back))+(u-back);
const V l=e+(ul+(FMA(Kl,r,Sl)+FMA(K,s,S*c)));
const V y=rounded(h,l,1.125,ok);
*ok&=in&((n==C(0.0))|(v_fabs(r)>C(0x1p-20)));
return y;}
NI V v_sin(V x){M ok;V y=sin_of(x,0,&ok);ok&=x!=C(0.0);
const unsigned no=v_bits(~ok);return no?slow_sin(y,x,no):y;}
NI V v_cos(V x){M ok;V y=sin_of(x,TURN/4,&ok);
const unsigned no=v_bits(~ok);return no?slow_cos(y,x,no):y;}
#undef C
#else
#define EACH_1(f) __attribute__((unused)) EACH(f)
EACH_1(exp) EACH_1(log) EACH_1(sin) EACH_1(cos)
__attribute__((unused)) static V v_pow(V a,V b){
V r;for(int l=0;l<L;l++)r[l]=pow(a[l],b[l]);return r;}
#endif
"""


def vector_math(lanes: int) -> str:
    """Return the C code of ``v_exp``, ``v_log``, ``v_pow``, ``v_sin``, ``v_cos``."""
    with localcontext() as context:
        context.prec = 60
        words = _tables() | {
            "EXP_MASK": _all(EXP_STEPS - 1, lanes),
            "TURN_MASK": _all(TURN - 1, lanes),
            "LOG_FROM": _all(LOG_FIRST, lanes),
            "LOG_SERIES": "".join(
                f"s=FMA(s,r,C({(-1) ** (n + 1)}.0/{n}));" for n in range(11, 2, -1)
            ),
            "TURN/4": str(TURN // 4),
        }
    tables = words.pop("TABLES")
    text = _CODE
    for key in sorted(words, key=len, reverse=True):
        text = text.replace(key, words[key])
    return text.replace("#ifdef VECTOR_MATH\n", f"#ifdef VECTOR_MATH\n{tables}\n", 1)


def _all(value: int, lanes: int) -> str:
    return ",".join([hex(value)] * lanes)


def _tables() -> dict[str, str]:
    """Constants as C writes them, each the nearest double to what remains of it."""
    ln2, pi = Decimal(2).ln(), Decimal(PI)
    step, sector = ln2 / EXP_STEPS, 2 * pi / TURN
    powers = [Decimal(2) ** (Decimal(j) / EXP_STEPS) for j in range(EXP_STEPS)]
    inverse = [_inverse(j) for j in range(LOG_STEPS)]
    logs = [-Decimal(q).ln() for q in inverse]
    coarse = [_cut(v, 42) for v in logs]  # multiples of 2^-42, as e ln 2 is: their sum is exact
    sines = [_sine(sector * j) for j in range(TURN)]
    cosines = [*sines[TURN // 4 :], *sines[: TURN // 4]]
    L1, S1 = _cut(step, 40), _cut(sector, 32)
    S2 = _cut(sector - Decimal(S1), 64)
    N1 = _cut(ln2, 42)
    rows = {
        "exp_hi": [*map(float, powers)],
        "exp_lo": [float(v - Decimal(float(v))) for v in powers],
        "log_inv": inverse,
        "log_hi": coarse,
        "log_lo": [float(v - Decimal(c)) for v, c in zip(logs, coarse, strict=True)],
        "sin_hi": [*map(float, sines)],
        "sin_lo": [float(v - Decimal(float(v))) for v in sines],
        "cos_hi": [*map(float, cosines)],
        "cos_lo": [float(v - Decimal(float(v))) for v in cosines],
    }
    single = {
        "EXP_INV": float(1 / step),
        "EXP_L1": L1,
        "EXP_L2": float(step - Decimal(L1)),
        "LOG_L1": N1,
        "LOG_L2": float(ln2 - Decimal(N1)),
        "SIN_INV": float(1 / sector),
        "SIN_L1": S1,
        "SIN_L2": S2,
        "SIN_L3": float(sector - Decimal(S1) - Decimal(S2)),
    }
    return {"TABLES": "\n".join(_array(*row) for row in rows.items())} | {
        k: f"({v.hex()})" for k, v in single.items()
    }


def _array(name: str, values: Sequence[float]) -> str:
    return f"static const double {name}[]={{{','.join(v.hex() for v in values)}}};"


def _cut(value: Decimal, bits: int) -> float:
    """Return the value rounded to a multiple of 2^-bits."""
    return math.ldexp(round(value * 2**bits), -bits)


def _inverse(j: int) -> float:
    """Return 1/c, in few bits, of the middle c of an interval of the logarithm; 1 where 1 is."""
    first, last = (_double(LOG_FIRST + ((j + k) << 48)) for k in (0, 1))
    return 1.0 if first < 1 < last else round(512 / (first + last)) / 256


def _double(bits: int) -> float:
    """Return the double of a pattern of bits."""
    exponent, mantissa = (bits >> 52) - 1023, bits & ((1 << 52) - 1)
    return math.ldexp(1 + mantissa / 2**52, exponent)


def _sine(x: Decimal) -> Decimal:
    """Return sin x, 0 <= x < 2 pi; exact where it is 0."""
    pi = Decimal(PI)
    x = min(x, pi - x) if x <= pi else max(pi - x, x - 2 * pi)
    term = total = x
    for n in range(2, 80, 2):
        term *= -x * x / (n * (n + 1))
        total += term
    return total if abs(total) > Decimal("1e-40") else Decimal(0)
