"""What the steps of several filters are made of: their symbols, and states kept in bounds."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from estimators.filters.filtering import STEP_IN
from estimators.models.filtermodel import FilterModel

__all__ = ["kind_of", "projected", "step_symbols"]


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
