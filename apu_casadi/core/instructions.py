"""An SX function written anew, instruction by instruction, some of them as others want them."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence

import casadi as ca

__all__ = ["applied", "rewritten"]

#: (number of the instruction, operation, arguments, whether each varies) -> value.
Operation = Callable[[int, int, list[ca.SX], list[bool]], ca.SX]
#: (value of an argument, whether it is a constant) -> value that is taken for it.
Use = Callable[[ca.SX, bool], ca.SX]


def applied(op: int, parts: Sequence[ca.SX]) -> ca.SX:
    """Return an operation on one or two scalars."""
    return (ca.SX.unary if len(parts) == 1 else ca.SX.binary)(op, *parts)


def rewritten(
    fun: ca.Function,
    given: Sequence[ca.SX],
    operation: Operation = lambda _k, op, parts, _vary: applied(op, parts),
    *,
    varying: Container[int] = (),
    use: Use | None = None,
) -> list[ca.SX]:
    """Return the outputs of an SX function, its instructions in their order.

    Args:
        fun: the function.
        given: symbols for its inputs, of their patterns.
        operation: makes what is neither an input, a constant nor an output.
        varying: inputs that vary; what follows from them does, all else does not.
        use: of arguments and outputs in the order in which they are read.
    """
    entries = [x.nonzeros() for x in given]
    results = [[ca.SX(0)] * fun.nnz_out(j) for j in range(fun.n_out())]
    work = dict[int, tuple[ca.SX, bool, bool]]()  # value, whether it is a constant, and varies

    def read(place: int) -> ca.SX:
        value, constant, _ = work[place]
        return value if use is None else use(value, constant)

    for k in range(fun.n_instructions()):
        op, at, to = fun.instruction_id(k), fun.instruction_input(k), fun.instruction_output(k)
        if op == ca.OP_OUTPUT:
            results[to[0]][to[1]] = read(at[0])
        elif op == ca.OP_CONST:
            work[to[0]] = ca.SX(fun.instruction_constant(k)), True, False
        elif op == ca.OP_INPUT:
            work[to[0]] = ca.SX(entries[at[0]][at[1]]), False, at[0] in varying
        else:
            vary = [work[i][2] for i in at]
            work[to[0]] = operation(k, op, [read(i) for i in at], vary), False, any(vary)
    return [
        ca.SX(fun.sparsity_out(j), ca.vertcat(*r)) if r else ca.SX(fun.sparsity_out(j))
        for j, r in enumerate(results)
    ]
