"""Exponential, logarithm, power, sine and cosine of all lanes at once, with the C library's bits.

Each is evaluated as a sum hi + lo of two doubles to some 2^-62 of itself: argument reduction with
a table, a short series, fused multiply-adds for the errors of products (Muller et al., Handbook of
Floating-Point Arithmetic, 2nd ed., chapters 4, 5, 10).  The C library of GNU (2.28 and later) tells
how far its own results are from the true ones at most: 0.511 units in the last place for ``exp``,
0.519 for ``log``, 0.55 for ``sin`` and ``cos``, and for ``pow`` 0.512 where the result is between
e^-8 and e^8 (0.511 of its exponential, and 8 times the 1.5 2^-68 of its logarithm).  Where lo is so
small that no other double is that near, its result must be hi, whatever its algorithm is (Ziv's
rounding test); elsewhere, three lanes in a hundred of ``exp`` and ``pow`` and eleven of ``sin``,
and for arguments that are out of range or not numbers, the C library is asked for that lane.

Other C libraries are asked for every lane, and so is this one where there are fewer than eight
lanes: without instructions that look up a table in registers that is as fast.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from decimal import Decimal, localcontext
from importlib.resources import files

__all__ = ["VECTOR", "vector_math"]

VECTOR = ("exp", "log", "sin", "cos", "pow")
EXP_STEPS, TURN = 16, 64  # entries of the tables of 2^(j/16) and of sin(2 pi j/64)
# where the intervals of the logarithm begin: 1 is where both halves of its own are equally wide
LOG_STEPS, LOG_FIRST = 16, 0x3FE6555555555555
PI = "3.14159265358979323846264338327950288419716939937510582097494459230781640628620899"


def vector_math(lanes: int) -> str:
    """Return the C code of ``v_exp``, ``v_log``, ``v_pow``, ``v_sin``, ``v_cos``."""
    with localcontext() as context:
        context.prec = 60
        tables, constants = _tables()
    constants |= {
        "EXP_MASK": _all(EXP_STEPS - 1, lanes),
        "TURN_MASK": _all(TURN - 1, lanes),
        "LOG_FROM": _all(LOG_FIRST, lanes),
        "TURN": str(TURN),
    }
    defined = [f"#define {name} {value}" for name, value in constants.items()]
    source = files(__package__).joinpath("vectormath.c").read_text(encoding="utf-8")
    return "\n".join([*defined, *tables, source])


def _all(value: int, lanes: int) -> str:
    return ",".join([hex(value)] * lanes)


def _tables() -> tuple[list[str], dict[str, str]]:
    """Return tables and constants as C writes them, each the nearest double to what is left."""
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
    tables = [_array(*row) for row in rows.items()]
    return tables, {name: f"({v.hex()})" for name, v in single.items()}


def _array(name: str, values: Sequence[float]) -> str:
    numbers = ",".join(v.hex() for v in values)
    return f"__attribute__((unused)) static const double {name}[]={{{numbers}}};"


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
