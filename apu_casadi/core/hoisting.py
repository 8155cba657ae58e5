"""What follows from the fixed inputs of a loop's body is computed before the loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from apu_casadi.core.instructions import applied, rewritten

__all__ = ["hoisted"]


def hoisted(
    name: str, varying: Sequence[Any], fixed: Any, outputs: Sequence[Any]
) -> tuple[ca.Function, ca.Function]:
    """Take out of a loop what follows from its fixed inputs alone.

    Returns:
        ``Function(*varying, d)`` -> outputs, and Function fixed -> d.
    """
    outputs, factors, divisors = _multiplied(varying, fixed, outputs)
    given = ca.vertcat(fixed, *factors)
    new, d, by = ca.extract_parametric(ca.cse(outputs), given, {"extract_trivial": True})
    inner = ca.Function(name, [*varying, ca.vertcat(*d)], new, {"cse": True})
    made = ca.vertcat(*by)
    if factors:
        made = ca.substitute(made, ca.vertcat(*factors), 1.0 / ca.vertcat(*divisors))
    return inner, ca.Function(f"{name}_fixed", [fixed], [made], {"cse": True})


def _multiplied(
    varying: Sequence[Any], fixed: Any, outputs: Sequence[Any]
) -> tuple[list[Any], list[Any], list[Any]]:
    """Write divisions by what is fixed as products: a chain of steps waits for each of them.

    Returns:
        Outputs with new symbols for the factors, these symbols, and what they are reciprocals of.
    """
    f = ca.Function("f", [fixed, *varying], list(outputs), {"cse": True})
    factors = dict[int, tuple[Any, Any]]()

    def operation(_: int, op: int, parts: list[Any], vary: list[bool]) -> Any:
        if op == ca.OP_DIV and vary[0] and not vary[1]:
            # a product with 1/b itself would be written as a division again
            key = parts[1].element_hash()
            op, parts[1] = ca.OP_MUL, factors.setdefault(key, (ca.SX.sym("r"), parts[1]))[0]
        return applied(op, parts)

    all_but_fixed = range(1, 1 + len(varying))
    results = rewritten(f, [fixed, *varying], operation, varying=all_but_fixed)
    return results, [r for r, _ in factors.values()], [b for _, b in factors.values()]
