"""The one shape in which models meet solvers and estimators.

A :class:`StateSpace` holds named signals and CasADi functions made from one set of expressions:
the semi-explicit DAE for IDAS, and the explicit right-hand side and output for everything else.
Solvers and estimators see only this; they know nothing of turbines or windings.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import casadi as ca

from apu_casadi.core.errors import SignalError
from apu_casadi.core.sharing import Parametric
from apu_casadi.core.signals import Signals


@dataclass(frozen=True)
class StateSpace(Parametric):
    """A model as named signals and functions.

    Args:
        name: short identifier, used in file names and messages.
        x, z, u, theta, y: states, algebraic unknowns, inputs, health and fault parameters, outputs.
        residual: Function (x, z, u, theta) -> (ode, alg), the semi-explicit DAE ``dx/dt = ode, 0 =
            alg``.
        f: Function (x, u, theta) -> xdot, with z eliminated.
        g: Function (x, u, theta) -> y, with z eliminated.
        z_of: Function (x, u, theta) -> z, the elimination itself (explicit, or a root finder).

    Raises:
        SignalError: a function's shapes do not match the declared signals.
    """

    name: str
    x: Signals
    z: Signals
    u: Signals
    theta: Signals
    y: Signals
    residual: ca.Function = field(repr=False)
    f: ca.Function = field(repr=False)
    g: ca.Function = field(repr=False)
    z_of: ca.Function = field(repr=False)

    def __post_init__(self) -> None:
        """Check every function's shapes against the signals."""
        nx, nz, nu, nt, ny = (len(s) for s in (self.x, self.z, self.u, self.theta, self.y))
        shapes = {
            "residual": (self.residual, [nx, nz, nu, nt], [nx, nz]),
            "f": (self.f, [nx, nu, nt], [nx]),
            "g": (self.g, [nx, nu, nt], [ny]),
            "z_of": (self.z_of, [nx, nu, nt], [nz]),
        }
        for label, (fun, n_in, n_out) in shapes.items():
            got_in = [fun.size1_in(i) for i in range(fun.n_in())]
            got_out = [fun.size1_out(i) for i in range(fun.n_out())]
            if got_in != n_in or got_out != n_out:
                raise SignalError(
                    f"{self.name}.{label}: expected sizes {n_in} -> {n_out}, "
                    f"got {got_in} -> {got_out}"
                )

    @classmethod
    def of(
        cls,
        name: str,
        signals: tuple[Signals, Signals, Signals, Signals, Signals],
        symbols: tuple[Any, Any, Any, Any],
        *,
        dae: tuple[Any, Any],
        f: Any,
        g: Any,
        z: Any,
        cse: bool = False,
    ) -> StateSpace:
        """Make the functions from one set of expressions.

        Args:
            name: of the model; its functions are named after it.
            signals, symbols: (x, z, u, theta, y), and the symbols (x, z, u, theta).
            dae: (ode, alg) in the symbols.
            f, g, z: rate, outputs and algebraic unknowns, with z eliminated.
            cse: share common subexpressions (SX).
        """
        x, _, u, theta = symbols
        args, names, options = [x, u, theta], ["x", "u", "theta"], {"cse": True} if cse else {}
        return cls(
            name,
            *signals,
            residual=ca.Function(
                f"{name}_residual", [*symbols], [*dae], ["x", "z", "u", "theta"], ["ode", "alg"]
            ),
            f=ca.Function(f"{name}_f", args, [f], names, ["xdot"], options),
            g=ca.Function(f"{name}_g", args, [g], names, ["y"], options),
            z_of=ca.Function(f"{name}_z", args, [z], names, ["z"], options),
        )
