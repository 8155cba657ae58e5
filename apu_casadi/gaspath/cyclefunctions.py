"""A cycle as functions of (x, u, theta): of one engine, of all engines, or by its parameters.

One set of expressions in three forms, which differ in what theta holds besides the health factors:

- *of one engine*: nothing, its numbers are held.  The functions of
  :class:`~apu_casadi.gaspath.gasgenerator.GasGenerator`.
- *the family*: all numbers of an engine, given and derived, so that functions compiled once serve
  every engine.  Derivatives by state, inputs and health only: those by the numbers are zero.
- *by parameters*: the parameters alone, or some of one engine.  The design point is solved inside,
  so derivatives by every parameter are exact, its shift included; that takes longer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca

from apu_casadi.core.discretisation import linearly_implicit_midpoint
from apu_casadi.core.sharing import Parametric, derived
from apu_casadi.core.signals import Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.cycle import Cycle
from apu_casadi.gaspath.stations import THETA, U, X, Y, Z
from apu_casadi.gaspath.unitnumbers import GIVEN, NUMBERS

_NT = len(THETA)


@dataclass(frozen=True)
class CycleFunctions(Parametric):
    """Functions of a cycle with the numbers held, in theta, or computed from parameters in theta.

    Args:
        cycle: the equations; with free numbers for the form by parameters.
        numbers: of one engine; None for the two other forms.
        free: parameters of that engine that theta holds.
    """

    cycle: Cycle
    numbers: tuple[float, ...] | None = None
    free: tuple[str, ...] = ()

    # ------------------------------------------------------------------ signals

    @derived
    def theta(self) -> Signals:
        """The health factors, and what else theta holds."""
        if self.numbers is None:
            return THETA + (NUMBERS if self.cycle.held else GIVEN)
        own = {n: self.numbers[GIVEN.index(n)] for n in self.free}
        return THETA + Signals([replace(GIVEN[n], default=v) for n, v in own.items()])

    @derived
    def z(self) -> Signals:
        """The algebraic unknowns; of one engine, with design values as magnitudes."""
        if self.numbers is None:
            return Z
        scale = self.cycle.scale(ca.DM(self.numbers)).full().ravel().tolist()
        return Signals([replace(s, nominal=n) for s, n in zip(Z, scale, strict=True)])

    def symbols(self) -> tuple[ca.MX, ca.MX, ca.MX, ca.MX]:
        """Fresh MX symbols (x, z, u, theta)."""
        sizes = {"x": X, "z": Z, "u": U, "theta": self.theta}
        x, z, u, theta = (ca.MX.sym(k, len(s)) for k, s in sizes.items())
        return x, z, u, theta

    def _split(self, theta: Any) -> tuple[Any, Any, Any]:
        """Return of theta health factors, numbers, and the residual of a design point solved."""
        if self._closed:
            return theta, ca.MX(ca.DM(self.numbers)), None
        health, rest = theta[:_NT], theta[_NT:]
        if self.numbers is not None:
            own = ca.vertsplit(ca.MX(ca.DM(self.numbers[: len(GIVEN)])))
            for n, value in zip(self.free, ca.vertsplit(rest), strict=True):
                own[GIVEN.index(n)] = value
            rest = ca.vertcat(*own)
        if self.cycle.held:
            return health, rest, None
        more, residual = self.cycle.derivation(rest)
        return health, ca.vertcat(rest, more), residual

    # ------------------------------------------------------------------ continuous

    @property
    def ambient(self) -> ca.Function:
        """Function u -> (T0, P0, T1, P1)."""
        return self.cycle.ambient

    def _of(self, fun: ca.Function) -> ca.Function:
        """Make a function of (x, z, u, theta) from one of (x, z, u, theta, c)."""
        x, z, u, theta = self.symbols()
        health, c, design = self._split(theta)
        out = dict(zip(fun.name_out(), fun.call([x, z, u, health, c], True, False), strict=True))
        if design is not None:  # the verdict on the design point goes with that on the cycle
            if "y" in out:
                out["y"][Y.index("residual")] += design
            elif "residual" in out:
                out["residual"] += design
        names = ["x", "z", "u", "theta"], list(out)
        return ca.Function(fun.name(), [x, z, u, theta], [*out.values()], *names)

    @derived
    def equations(self) -> ca.Function:
        """The model: Function (x, z, u, theta) -> (ode, alg, y), from which all else is made."""
        return self._of(self.cycle.equations)

    @derived
    def dfdx(self) -> ca.Function:
        """Function (x, z, u, theta) -> (ode, d ode/dx along 0 = alg, 1-norm of alg, dz/dx)."""
        return self._of(self.cycle.dfdx)

    @derived
    def sensitivities(self) -> ca.Function:
        """Exact total derivatives at a solved point.

        Function (x, z, u, theta) -> (xdot, y, xdot_w, y_w, z_w) with w = (x, u, health), by the
        implicit function theorem; by parameters w = (x, u, theta).  Rows off_c, off_t and residual
        of y_w are zero.
        """
        if self.cycle.held:
            return self._of(self.cycle.sensitivities)
        x, z, u, theta = self.symbols()
        health, c, _ = self._split(theta)
        xdot, y, *by = self.cycle.sensitivities(x, z, u, health, c)
        n = len(X) + len(U)
        by_theta = ca.jacobian(ca.vertcat(health, c), theta)
        by = [ca.horzcat(d[:, :n], ca.mtimes(d[:, n:], by_theta)) for d in by]
        names = ["x", "z", "u", "theta"], self.cycle.sensitivities.name_out()
        return ca.Function("sensitivities", [x, z, u, theta], [xdot, y, *by], *names)

    @derived
    def solve(self) -> ca.Function:
        """Solve 0 = alg for z by Newton's method, as a differentiable CasADi function.

        Function (z0, x, u, theta) -> z.  Derivatives of any order are those of the root, by the
        implicit function theorem; there are none by z0.  Success is *not* reported inside larger
        expressions: every user re-evaluates the residual, which is why it is an output of the
        model.
        """
        x, z, u, theta = self.symbols()
        z0 = ca.MX.sym("z0", len(Z))
        health, c, _ = self._split(theta)
        z_x, z_u, *z_theta = self.cycle.slopes(x, z, u, health, c)
        whole = ca.vertcat(health, *([] if self.cycle.held else [c]))
        by_theta = ca.mtimes(ca.horzcat(*z_theta), ca.jacobian(whole, theta))
        names = ["z0", "x", "u", "theta"]
        jacobian = ca.Function(
            "jac_solve_z",
            [z0, x, u, theta, z],
            [ca.MX(len(Z), len(Z)), z_x, z_u, by_theta],
            [*names, "out_z"],
            [f"jac_z_{k}" for k in names],
        )
        options = {"custom_jacobian": jacobian, "jac_penalty": 0}
        root = self.cycle.root.call([z0, x, u, health, c], True, False)
        return ca.Function("solve_z", [z0, x, u, theta], root, names, ["z"], options)

    @derived
    def similar(self) -> ca.Function:
        """First guess of z by similarity with the design point.

        Function (x, u) -> z of one engine, (x, u, theta) -> z otherwise.
        """
        x, _, u, theta = self.symbols()
        _, c, _ = self._split(theta)
        args = [x, u] if self._closed else [x, u, theta]
        return ca.Function("similar", args, [self.cycle.similar(x, u, c)])

    def start(self, x: Any, u: Any, theta: Any) -> Any:
        """First guess of z; ``theta`` counts where it holds numbers."""
        return self.similar(x, u) if self._closed else self.similar(x, u, theta)

    @property
    def _closed(self) -> bool:
        """Whether theta are the health factors alone."""
        return self.numbers is not None and not self.free

    @derived
    def state_space(self) -> StateSpace:
        """The continuous model as :class:`StateSpace`; z is started by similarity."""
        x, z, u, theta = self.symbols()
        ode, alg, _ = self.equations(x, z, u, theta)
        z_sol = self.solve(self.start(x, u, theta), x, u, theta)
        f, _, g = self.equations(x, z_sol, u, theta)
        signals, symbols = (X, self.z, U, self.theta, Y), (x, z, u, theta)
        return StateSpace.of("gas_generator", signals, symbols, dae=(ode, alg), f=f, g=g, z=z_sol)

    # ------------------------------------------------------------------ discrete model (eq. 12)

    @derived
    def f(self) -> ca.Function:
        """State update of eq. (12): (x, u, theta, dt, z0) -> (x1, z, residual).

        ``x1 = f(x(k-1), u(k), theta(k), Pe(k))`` with Pe = ``u.PW``, by the linearly implicit
        midpoint rule.  ``z0`` starts the root finder; z and its re-evaluated residual come back.
        """
        x, z0, u, theta = self.symbols()
        dt = ca.MX.sym("dt")
        z = self.solve(z0, x, u, theta)
        ode, A, residual, _ = self.dfdx(x, z, u, theta)
        x1 = linearly_implicit_midpoint(x, ode, A, dt)
        names = ["x", "u", "theta", "dt", "z0"], ["x1", "z", "residual"]
        return ca.Function("gas_generator_f", [x, u, theta, dt, z0], [x1, z, residual], *names)

    @derived
    def step(self) -> ca.Function:
        """State update and output in one: (x, u, theta, dt, z0) -> (x1, y, z, residual).

        Eq. (12) as a hot loop needs it; ``residual`` is the sum of update and output.
        """
        x, z0, u, theta = self.symbols()
        dt = ca.MX.sym("dt")
        z = self.solve(z0, x, u, theta)
        ode, A, r, z_x = self.dfdx(x, z, u, theta)
        x1 = linearly_implicit_midpoint(x, ode, A, dt)
        y, z1 = self.g(x1, u, theta, z + ca.mtimes(z_x, x1 - x))  # started along the tangent
        # a sum, not fmax, which would swallow NaN
        r = r + y[Y.index("residual")]
        names = ["x", "u", "theta", "dt", "z0"], ["x1", "y", "z", "residual"]
        return ca.Function("gas_generator_step", [x, u, theta, dt, z0], [x1, y, z1, r], *names)

    @derived
    def g(self) -> ca.Function:
        """Output of eq. (12): (x, u, theta, z0) -> (y, z); y holds the residual."""
        x, z0, u, theta = self.symbols()
        z = self.solve(z0, x, u, theta)
        _, _, y = self.equations(x, z, u, theta)
        names = ["x", "u", "theta", "z0"], ["y", "z"]
        return ca.Function("gas_generator_g", [x, u, theta, z0], [y, z], *names)
