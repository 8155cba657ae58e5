"""Functions that differ in constants alone, as one function of these constants.

Models of a bank are often built alike, with another noise, another time constant or another bound
in each.  Their SX functions are then one list of instructions with other numbers in it, and can be
evaluated together (:mod:`apu_casadi.core.lanes`), or compiled once for all.  What CasADi
simplifies, a factor 0 or 1, makes another list: such a function stays apart.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.instructions import rewritten
from apu_casadi.core.reciprocals import as_written
from apu_casadi.core.sharing import BUILDING, keep

__all__ = ["Form", "differing", "form_of", "with_constants"]


class Form(NamedTuple):
    """An SX function taken apart.

    Args:
        key: digest of all but its constants; equal for functions that differ in these alone.
        constants: in the order in which they are used, one for each use.
    """

    key: str
    constants: tuple[float, ...]


def form_of(fun: ca.Function) -> Form:
    """Take an SX function apart, once."""
    return keep(fun, "form", None, lambda: _form(fun))


def _form(fun: ca.Function) -> Form:
    patterns = [fun.sparsity_in(i) for i in range(fun.n_in())]
    patterns += [fun.sparsity_out(j) for j in range(fun.n_out())]
    shape = tuple(tuple(s.compress()) for s in patterns)
    holds = dict[int, int | float]()  # what work holds: the number of a step, or a constant
    steps, constants = [], list[float]()
    for k in range(fun.n_instructions()):
        op, i, o = fun.instruction_id(k), fun.instruction_input(k), fun.instruction_output(k)
        if op == ca.OP_CONST:
            holds[o[0]] = fun.instruction_constant(k)
            continue
        given = tuple(i) if op == ca.OP_INPUT else tuple(holds[n] for n in i)
        constants += [v for v in given if isinstance(v, float)]
        given = tuple(-1 if isinstance(v, float) else v for v in given)
        steps.append((op, given, tuple(o) if op == ca.OP_OUTPUT else ()))
        if op != ca.OP_OUTPUT:
            holds[o[0]] = len(steps) - 1
    key = hashlib.sha256(repr((fun.n_in(), shape, steps)).encode()).hexdigest()
    return Form(key, tuple(constants))


def differing(forms: Sequence[Form]) -> tuple[np.ndarray, np.ndarray]:
    """Return what differs between functions of one form.

    Returns:
        Values that differ, (functions, n); and for each use of a constant which of them it is, -1
        for one that all have in common.
    """
    values = np.array([f.constants for f in forms])
    varies = np.flatnonzero((values != values[0]).any(0))
    # one value in several places is one parameter
    columns, which = np.unique(values[:, varies], axis=1, return_inverse=True)
    place = np.full(values.shape[1], -1)
    place[varies] = np.ravel(which)
    return columns, place


def with_constants(fun: ca.Function, place: np.ndarray, at: int) -> ca.Function:
    """Return an SX function in which some constants are further entries of an input.

    Args:
        fun: the function.
        place: for each use of a constant its place among those entries, or -1, see
            :func:`differing`.
        at: the input, a column; the entries follow its own.

    Returns:
        The function, with the operations of ``fun`` in the same order.
    """
    n = int(place.max(initial=-1)) + 1
    with BUILDING, as_written():
        given = [ca.SX.sym(fun.name_in(i), fun.sparsity_in(i)) for i in range(fun.n_in())]
        more = ca.SX.sym("constants", n)
        uses = iter(place.tolist())

        def use(value: ca.SX, constant: bool) -> ca.SX:
            which = next(uses) if constant else -1
            return value if which < 0 else more[which]

        out = rewritten(fun, given, use=use)
        given[at] = ca.vertcat(given[at], more)
        how = {"is_diff_in": fun.is_diff_in()}
        return ca.Function(fun.name(), given, out, fun.name_in(), fun.name_out(), how)
