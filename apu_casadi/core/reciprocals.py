"""One division for all quotients by the same number, where their last bits do not matter.

A division takes as long as four to sixteen multiplications.  Derivatives and elimination divide by
the same few numbers again and again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import casadi as ca

from apu_casadi.core.instructions import applied, rewritten

__all__ = ["as_written", "by_reciprocals"]

LEAST = 2  # quotients by a number from which its reciprocal pays


@contextmanager
def as_written() -> Iterator[None]:
    """Let operations on symbols stay as they are written."""
    before = ca.GlobalOptions.getSimplificationOnTheFly()
    ca.GlobalOptions.setSimplificationOnTheFly(False)
    try:
        yield
    finally:
        ca.GlobalOptions.setSimplificationOnTheFly(before)


def by_reciprocals(fun: ca.Function, *, least: int = LEAST) -> ca.Function:
    """Return an SX function in which a/b and c/b are a (1/b) and c (1/b).

    Its results differ from those of ``fun`` by some roundings.

    Args:
        fun: the function.
        least: quotients by one number from which it is done.
    """
    holds, divides = dict[int, int](), Counter[int]()  # which instruction made what work holds
    divisor = dict[int, int]()
    for k in range(fun.n_instructions()):
        op, i, o = fun.instruction_id(k), fun.instruction_input(k), fun.instruction_output(k)
        if op == ca.OP_DIV:
            divisor[k] = holds[i[1]]
            divides[holds[i[1]]] += 1
        if op != ca.OP_OUTPUT:
            holds[o[0]] = k
    given = fun.sx_in()
    divisor = {k: b for k, b in divisor.items() if divides[b] >= least}
    inverse = dict[int, ca.SX]()

    def operation(k: int, op: int, parts: list[ca.SX], _: list[bool]) -> ca.SX:
        if k not in divisor:
            return applied(op, parts)
        b = divisor[k]
        if b not in inverse:
            inverse[b] = ca.SX.binary(ca.OP_DIV, 1.0, parts[1])
        return parts[0] * inverse[b]

    with as_written():  # CasADi would make a (1/b) a/b again
        made = rewritten(fun, given, operation)
    how = {"is_diff_in": fun.is_diff_in()}
    return ca.Function(fun.name(), given, made, fun.name_in(), fun.name_out(), how)
