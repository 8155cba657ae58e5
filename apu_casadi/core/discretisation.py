"""From a continuous model to the explicit difference equation x(k+1) = f(x(k), u, theta)."""

from __future__ import annotations

from typing import Any

import casadi as ca


def linearly_implicit_midpoint(x: Any, xdot: Any, A: Any, dt: Any) -> Any:
    """One step of x1 = x + (I - dt/2 A)^-1 dt xdot, with A = d xdot / dx.

    Second order and A-stable for inputs that are constant over the step (Rosenbrock's method
    with one stage and gamma = 1/2; Hairer and Wanner, Solving ODEs II, section IV.7), at the
    price of a single evaluation of the model.  Explicit: the new state is a formula in the old.
    """
    n = x.shape[0]
    if n == 1:
        return x + dt * xdot / (1 - dt / 2 * A)
    return x + ca.solve(ca.DM.eye(n) - dt / 2 * A, dt * xdot)
