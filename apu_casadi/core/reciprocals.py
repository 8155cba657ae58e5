"""One division for all quotients by the same number, where their last bits do not matter.

A division takes as long as four to sixteen multiplications.  Derivatives and elimination divide by
the same few numbers again and again.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

import casadi as ca

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
    steps = [
        (fun.instruction_id(k), fun.instruction_input(k), fun.instruction_output(k))
        for k in range(fun.n_instructions())
    ]
    holds, divides = dict[int, int](), Counter[int]()  # which instruction made what work holds
    divisor = dict[int, int]()
    for k, (op, i, o) in enumerate(steps):
        if op == ca.OP_DIV:
            divisor[k] = holds[i[1]]
            divides[holds[i[1]]] += 1
        if op != ca.OP_OUTPUT:
            holds[o[0]] = k
    given = fun.sx_in()
    divisor = {k: b for k, b in divisor.items() if divides[b] >= least}
    with as_written():  # CasADi would make a (1/b) a/b again
        made = _rebuilt(fun, given, steps, divisor)
    how = {"is_diff_in": fun.is_diff_in()}
    return ca.Function(fun.name(), given, made, fun.name_in(), fun.name_out(), how)


def _rebuilt(
    fun: ca.Function,
    given: list[ca.SX],
    steps: list[tuple[int, list[int], list[int]]],
    divisor: dict[int, int],
) -> list[ca.SX]:
    """Return the outputs of a function made anew; divisors by number of their quotients."""
    parts = [x.nonzeros() for x in given]
    results = [[ca.SX(0)] * fun.nnz_out(j) for j in range(fun.n_out())]
    work, inverse = dict[int, ca.SX](), dict[int, ca.SX]()
    for k, (op, i, o) in enumerate(steps):
        if op == ca.OP_CONST:
            work[o[0]] = ca.SX(fun.instruction_constant(k))
        elif op == ca.OP_INPUT:
            work[o[0]] = ca.SX(parts[i[0]][i[1]])
        elif op == ca.OP_OUTPUT:
            results[o[0]][o[1]] = work[i[0]]
        elif k in divisor:
            b = divisor[k]
            if b not in inverse:
                inverse[b] = ca.SX.binary(ca.OP_DIV, 1.0, work[i[1]])
            work[o[0]] = work[i[0]] * inverse[b]
        elif len(i) == 1:
            work[o[0]] = ca.SX.unary(op, work[i[0]])
        else:
            work[o[0]] = ca.SX.binary(op, work[i[0]], work[i[1]])
    return [
        ca.SX(fun.sparsity_out(j), ca.vertcat(*r)) if r else ca.SX(fun.sparsity_out(j))
        for j, r in enumerate(results)
    ]
