"""The one shape in which models meet solvers and estimators.

A :class:`StateSpace` holds named signals and CasADi functions made from one set of expressions:
the semi-explicit DAE for IDAS, and the explicit right-hand side and output for everything else.
Solvers and estimators see only this; they know nothing of turbines or windings.

Units that differ in their numbers alone share one *family*: the same model, with the parameters
of the unit as further entries of theta, behind those that are theta anyway.  Whatever takes time
to make, compiled code above all, is made of the family, once, and takes the numbers as arguments.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import casadi as ca
import numpy as np

from apu_casadi.core.errors import SignalError
from apu_casadi.core.sharing import Parametric, keep
from apu_casadi.core.signals import Signals


def moves(function: ca.Function, argument: int, entry: int) -> bool:
    """Whether an entry of an argument has derivatives of the first output."""
    ends = function.jac_sparsity(0, argument).colind()
    return bool(ends[entry + 1] > ends[entry])


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
        family: the model that takes its parameters as theta, too; None if it has none.
        numbers: what the family's theta has beyond this one's, in its order.

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
    family: StateSpace | None = field(default=None, repr=False)
    numbers: tuple[float, ...] = field(default=(), repr=False)

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
        more = 0 if self.family is None else len(self.family.theta) - nt
        if more != len(self.numbers):
            raise SignalError(
                f"{self.name}: {len(self.numbers)} numbers for the {more} parameters of its family"
            )

    @property
    def shared(self) -> StateSpace:
        """The family, or the model itself if it has none: what to make functions of."""
        return self if self.family is None else self.family

    def full(self, theta: Any) -> np.ndarray:
        """Return theta of :attr:`shared`: this model's, shape (ntheta,), and its numbers."""
        return np.append(np.asarray(theta, dtype=float), self.numbers)

    @property
    def held(self) -> dict[str, float]:
        """Its numbers by name."""
        names = () if self.family is None else self.family.theta.names[len(self.theta) :]
        return dict(zip(names, self.numbers, strict=True))

    @classmethod
    def member(
        cls, name: str, family: StateSpace, theta: Signals, numbers: Sequence[float]
    ) -> Self:
        """Make the model of one unit: the family's with its last parameters held.

        Args:
            name: of the model; its functions are named after it.
            family: takes ``numbers`` as the last entries of its theta.
            theta: the entries before them.
            numbers: values of the others.
        """
        # calls of the family's functions: written out again they would take longer to make
        tail = ca.DM(list(numbers))
        made = cls._called(name, family, theta, ca.MX, lambda th: ca.vertcat(th, tail))
        return replace(made, family=family, numbers=tuple(float(n) for n in numbers))

    def with_free(self, *names: str) -> StateSpace:
        """Return the model with some of its numbers as parameters, behind theta.

        Raises:
            SignalError: unknown names, with the nearest; names given twice; a number on which
                nothing depends, or whose derivatives are left out.
        """
        held, family = self.held, self.shared
        rest = Signals([s for s in family.theta if s.name in held])
        rest.indices(names)  # refuses what is unknown
        for n in names:
            if not any(moves(f, 2, family.theta.index(n)) for f in (family.f, family.g)):
                raise SignalError(f"{self.name}: no derivatives by {n}: nothing depends on it")
        made = keep(family, StateSpace.with_free, (len(self.theta), names), lambda: self._by(names))
        theta = self.theta + Signals([replace(family.theta[n], default=held[n]) for n in names])
        numbers = [held[n] for n in rest.names if n not in names]
        return StateSpace.member(self.name, made, theta, numbers)

    def _by(self, names: tuple[str, ...]) -> StateSpace:
        """Return the family with these of its parameters right behind this model's."""
        family = self.shared
        last = [n for n in family.theta.names if n in self.held and n not in names]
        theta = Signals([family.theta[n] for n in (*self.theta.names, *names, *last)])
        kind = ca.SX if family.f.is_a("SXFunction") else ca.MX
        order = theta.indices(family.theta.names)
        return StateSpace._called(family.name, family, theta, kind, lambda th: th[order])

    @classmethod
    def _called(
        cls, name: str, family: StateSpace, theta: Signals, kind: Any, full: Callable[[Any], Any]
    ) -> Self:
        """Return the family's functions called with its whole theta made of another one."""
        sizes = [len(s) for s in (family.x, family.z, family.u, theta)]
        x, z, u, th = (kind.sym(n, k) for n, k in zip("xzut", sizes, strict=True))
        whole = full(th)
        return cls.of(
            name,
            (family.x, family.z, family.u, theta, family.y),
            (x, z, u, th),
            dae=family.residual(x, z, u, whole),
            f=family.f(x, u, whole),
            g=family.g(x, u, whole),
            z=family.z_of(x, u, whole),
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
    ) -> Self:
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
