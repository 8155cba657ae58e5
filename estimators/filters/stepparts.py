"""What the steps of several filters are made of: their symbols, and states kept in bounds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from estimators.filters.filtering import STEP_IN
from estimators.models.filtermodel import FilterModel, inlined

__all__ = [
    "iterated_update",
    "kind_of",
    "linearisation",
    "projected",
    "step_symbols",
    "suffix",
]

T = TypeVar("T", bound=tuple[Any, ...])


def projected(
    m: Any, P: Any, lower: np.ndarray, upper: np.ndarray, fixed: tuple[int, ...] = ()
) -> Any:
    """Return the mean moved into its bounds along the covariance.

    One bound after the other, each to the nearest point in the metric of P; where one move pushes
    an earlier state out again, that state is then set on its bound.  The covariance is left as it
    is, which is on the safe side.  What is known exactly does not move.

    Args:
        m, P: mean and covariance; only the columns of bounded states are used.
        lower, upper: bounds.
        fixed: considered states, which stay.
    """
    bound = [int(i) for i in np.flatnonzero(np.isfinite(lower) | np.isfinite(upper))]
    bound = [i for i in bound if i not in fixed]
    free = np.ones(m.shape[0])
    free[list(fixed)] = 0
    for i in bound:
        move = ca.fmin(ca.fmax(m[i], lower[i]), upper[i]) - m[i]
        v = P[i, i]
        m = m + ca.DM(free) * P[:, i] * ca.if_else(v > 0, move / v, 0)
    if len(bound) > 1:
        parts = ca.vertsplit(m)
        for i in bound:
            inside = ca.fmin(ca.fmax(parts[i], lower[i]), upper[i])
            parts[i] = ca.if_else(P[i, i] > 0, inside, parts[i])
        m = ca.vertcat(*parts)
    return m


def kind_of(model: FilterModel) -> Any:
    """SX if both functions are in scalar operations, else MX."""
    scalar = all(f.is_a("SXFunction") for f in (model.transition, model.output))
    return ca.SX if scalar else ca.MX


def step_symbols(model: FilterModel, kind: Any) -> list[Any]:
    """Fresh symbols for ``STEP_IN``."""
    nx, nu, np_, _, ny = model.sizes
    shapes = [(nx, 1), (nx, nx), (nu, 1), (np_, 1), (ny, 1), (ny, 1), (1, 1)]
    return [kind.sym(n, *s) for n, s in zip(STEP_IN, shapes, strict=True)]


def linearisation(
    model: FilterModel, kind: Any, u: Any, p: Any, dt: Any
) -> tuple[ca.Function, ca.Function]:
    """Return the functions (s, u, p) -> (y, dy/ds, check) and (s, u, p, dt) -> (x1, dx1/ds, check).

    s is the state with the noise w below it; u, p, dt are symbols.
    """
    nx, _, _, nw, _ = model.sizes
    s = kind.sym("s", nx + nw)
    y, check_y = inlined(model.output, s[:nx], u, p, s[nx:])
    x1, check_x = inlined(model.transition, s[:nx], u, p, s[nx:], dt)
    return (
        ca.Function("outputs", [s, u, p], [y, ca.jacobian(y, s), check_y]),
        ca.Function("forecast", [s, u, p, dt], [x1, ca.jacobian(x1, s), check_x]),
    )


def iterated_update(
    model: FilterModel,
    outputs: ca.Function,
    update: Callable[[Any, Any], T],
    prior: Any,
    given: tuple[Any, Any, Any],
    iterations: int,
    iterated: str,
) -> tuple[Any, Any, Any, T, T]:
    """Correct a mean by Gauss-Newton: linearised at the iterate, but always an update of the prior.

    Args:
        model: whose outputs these are.
        outputs: of :func:`linearisation`.
        update: (H, innovation) -> the update, whose first part is the change of the mean.
        prior: state and noise before the sample.
        given: u, p, y.
        iterations, iterated: see :func:`~estimators.filters.ekf.ekf_step`.

    Returns:
        The corrected mean, the sum of the checks, the innovation, the first and the last update.
    """
    u, p, y = given
    nx = len(model.x)
    at, check, nu, done = prior, type(prior)(0), None, []
    for _ in range(iterations):
        h, H, c = outputs(at, u, p)
        e = model.innovation(y, h)
        done.append(update(H, e + H @ (at - prior)))
        nu = e if nu is None else nu
        moved, check = prior + done[-1][0], check + c
        at = moved if iterated == "all" else ca.vertcat(prior[:nx], moved[nx:])
    return moved, check, nu, done[0], done[-1]


def suffix(iterations: int, iterated: str) -> str:
    """Return what the name of an iterated filter's function ends with."""
    return "" if iterations == 1 else f"{iterations}{'w' if iterated == 'noise' else ''}"
