"""The cycle's equations of all gas generators of one structure, with their exact Jacobians.

Structure are gas data and map tables; the numbers of an engine are an argument c of every function
(:mod:`apu_casadi.gaspath.unitnumbers`).

Thermodynamics and maps are written once, as SX expressions.  Only finding the cell of a map that a
point lies in needs an MX graph, so every function made here has the same two parts
(:meth:`Cycle.function`): look up the cells, then evaluate one SX function, which holds all the rest
down to the solution of linear systems, with common subexpressions computed once.  Jacobians of the
whole are assembled from those of maps and stations by the chain rule, which gives shorter code than
differentiating through.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.reciprocals import by_reciprocals
from apu_casadi.core.rootfinding import solve_bordered
from apu_casadi.core.sharing import Parametric, derived
from apu_casadi.gaspath.atmosphere import Ambient, ambient
from apu_casadi.gaspath.components.inlet import inlet
from apu_casadi.gaspath.components.shaft import power_balance, rotor_acceleration
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gas import Gas
from apu_casadi.gaspath.maps.maptable import MapTable
from apu_casadi.gaspath.maps.scaledmaps import N_CELL, N_SURGE_CELL, surface_cell, surge_cell
from apu_casadi.gaspath.stations import (
    AMBIENT_STATE,
    EQUATIONS,
    TEMPERATURES,
    THETA,
    UNKNOWNS,
    U,
    X,
    Y,
    Z,
    reynolds_index,
    stations,
)
from apu_casadi.gaspath.unitnumbers import NUMBERS, UnitParts, derivation, parts

_NZ, _NX, _NU, _NT = map(len, (Z, X, U, THETA))
_NA, _NC = len(AMBIENT_STATE), len(NUMBERS)
N_ORDERED = len(TEMPERATURES)  # unknowns that equations determine one after the other
STEP_TOL = 1e-7  # of Newton's last step, relative: it converges quadratically, some 1e-13 is left


class Columns(NamedTuple):
    """Which columns of the assembled Jacobians belong to what: v = (z, x, u, a, theta, c)."""

    z: slice
    x: slice
    u: slice
    a: slice
    theta: slice
    c: slice


def _columns() -> Columns:
    ends = np.cumsum([0, _NZ, _NX, _NU, _NA, _NT, _NC]).tolist()
    return Columns(*(slice(i, j) for i, j in pairwise(ends)))


COLUMNS = _columns()


class Assembled(NamedTuple):
    """The cycle at one point, as SX: residuals, power before the load, outputs, derivatives.

    ``dq`` are the derivatives of (residuals, power before the load) and ``dy`` those of y with
    respect to v = (z, x, u, a, theta), and c unless the numbers are held; rows off_c, off_t and
    residual of ``dy`` are zero.
    """

    alg: Any
    P_free: Any
    y: Any
    dq: Any
    dy: Any


class Point(NamedTuple):
    """Where the cycle is evaluated: state, unknowns, inputs, ``ambient(u)``, health, numbers."""

    x: Any
    z: Any
    u: Any
    a: Any
    theta: Any
    c: Any


def similar_z(unit: UnitParts, *, T3: Any, T4: Any) -> list[Any]:
    """First guess of the cycle's unknowns: all temperatures in the ratio of T3 or T4 to design."""
    z = unit.design.z
    ratio = {3: T3 / z["T3"], 4: T4 / unit.p.T4}
    betas = [unit.cmap.beta_des, unit.tmap.beta_des]
    return [ratio[k.follows] * z[k.name] for k in UNKNOWNS if k.follows] + betas


@dataclass(frozen=True)
class Cycle(Parametric):
    """The cycle equations of one structure as CasADi functions.

    Args:
        gas_data: name of the gas data.
        compressor, turbine: map tables.
        held: the numbers c are held: functions have no derivatives by them, and are shorter.
    """

    gas_data: str
    compressor: MapTable
    turbine: MapTable
    held: bool = True

    # -- expressions --------------------------------------------------------------------------

    @derived
    def derivation(self) -> ca.Function:
        """Function given -> (derived numbers, residual): see :mod:`.unitnumbers`."""
        return derivation(self.gas_data, self.compressor, self.turbine)

    def parts(self, c: ca.SX) -> UnitParts:
        """Return what the numbers stand for."""
        return parts(c, self.gas_data, self.compressor, self.turbine)

    def scale(self, c: Any) -> Any:
        """Magnitudes of z: design temperatures, and the spans of the maps' betas."""
        first = NUMBERS.index(f"design.{TEMPERATURES[0]}")
        spans = [float(np.ptp(t.beta)) for t in (self.compressor, self.turbine)]
        return ca.vertcat(c[first : first + len(TEMPERATURES)], *spans)

    @derived
    def ambient(self) -> ca.Function:
        """Function u -> (T0, P0, T1, P1)."""
        us = ca.SX.sym("u", _NU)
        v = U.unpack(us)
        air = {n: v[n] for n in AMBIENT}
        amb = ambient(**air, gas=Gas(data=self.gas_data))  # no fuel in it
        return ca.Function("ambient", [us], [ca.vertcat(amb.T0, amb.P0, amb.T1, amb.P1)])

    def _map_arguments(self, at: Point, unit: UnitParts, PR_c: Any) -> dict[str, Any]:
        """Corrected speeds over design and Reynolds number indices of the two maps."""
        p, d, ref, T41, N = unit.p, unit.design.values, unit.ref, at.z[Z.index("T41")], at.x
        _, _, T1, P1 = ca.vertsplit(at.a)
        T2, P2 = inlet(T1=T1, P1=P1, dp_inlet=p.dp_inlet)
        P4 = P2 * PR_c * (1 - p.dp_burner)
        return {
            "n_c": N / ca.sqrt(T2 * ref["per_T2"]) * ref["per_N"],
            "n_t": N / ca.sqrt(T41 * ref["per_T41"]) * ref["per_N"],
            "RNI_c": reynolds_index(P=P2, T=T2, T_ref=d["T2"], per_ref=ref["per_Re_c"]),
            "RNI_t": reynolds_index(P=P4, T=T41, T_ref=d["T41"], per_ref=ref["per_Re_t"]),
        }

    @staticmethod
    def _pass(at: Point, unit: UnitParts, mc: Any, mt: Any) -> tuple[Any, Any, dict[str, Any]]:
        """One pass through the stations, given what the maps say.

        Args:
            at, unit: the point, and what its numbers stand for.
            mc, mt: W, PR, eta, SM of the compressor; W, PR, eta of the turbine.

        Returns:
            Residuals in the order of ``EQUATIONS``, power before the load, outputs by name; without
            those that only the maps know.
        """
        p, ref = unit.p, unit.ref
        z, v, H = Z.unpack(at.z), U.unpack(at.u), THETA.unpack(at.theta)
        W_c, PR_c, eta_c, SM = ca.vertsplit(mc)
        W_t, PR_t, eta_t = ca.vertsplit(mt)
        eta_c, eta_t = eta_c * H["f_eta_c"], eta_t * H["f_eta_t"]
        T0, P0, T1, P1 = ca.vertsplit(at.a)
        amb = Ambient(T0=T0, P0=P0, V0=ca.SX(0), T1=T1, P1=P1)
        T2, P2 = inlet(T1=T1, P1=P1, dp_inlet=p.dp_inlet)
        W2 = W_c * H["f_W_c"] * (P2 * ref["per_P2"]) / ca.sqrt(T2 * ref["per_T2"])
        # losses grow with the square of the corrected flow at the inlet of their duct (Table 5)
        corrected_31 = W2 * ca.sqrt(z["T3"]) / (P2 * PR_c) * ref["per_flow_31"]
        dp_burner = p.dp_burner * corrected_31**2
        P4 = P2 * PR_c * (1 - dp_burner)
        W5 = W2 * (1 - p.bleed_overboard) + v["Wf"]
        corrected_5 = W5 * ca.sqrt(z["T5"]) / (P4 / PR_t) * ref["per_flow_5"]
        loss = {"dp_burner": dp_burner, "dp_exhaust": p.dp_exhaust * corrected_5**2}
        maps = {"W2": W2, "PR_c": PR_c, "eta_c": eta_c, "PR_t": PR_t, "eta_t": eta_t}
        areas = {"A3": unit.design.A3, "A8": unit.design.A8}
        given = {"gas": unit.gas, "amb": amb, "war": v["war"], "Wf": v["Wf"]}
        y, res = stations(p=p, z=z, **given, **maps, **loss, **areas)
        capacity = W_t * H["f_W_t"]
        res["turbine flow"] = y["W41"] * ca.sqrt(z["T41"]) / y["P4"] / capacity - 1
        power = {"P_turb": y["P_turb"], "P_cpr": y["P_cpr"], "eta_cpr": p.eta_cpr}
        P_free = power_balance(**power, P_acc=p.P_acc, PW=0.0)
        y |= {"N": at.x, "PW": v["PW"], "Wf": v["Wf"], "SM": SM, "eta_c": eta_c, "eta_t": eta_t}
        y |= {"SFC": v["Wf"] / (v["PW"] + p.P_acc), "P_acceleration": P_free - v["PW"]}
        return ca.vertcat(*(res[n] for n in EQUATIONS)), P_free, y

    @derived
    def _core(self) -> tuple[ca.Function, ca.Function, ca.Function]:
        """SX functions of a point and the map cells that it lies in.

        - where: (x, z, u, a, theta, c) -> N and beta on the compressor's and the turbine's table.
        - flow: (x, z, u, a, theta, c, cell_c) -> flow at which the surge line is read.
        - cycle: (x, z, u, a, theta, c, cell_c, cell_t, cell_s) -> as :class:`Assembled`.
        """
        sizes = {"x": _NX, "z": _NZ, "u": _NU, "a": _NA, "theta": _NT, "c": _NC}
        point = Point(**{k: ca.SX.sym(k, n) for k, n in sizes.items()})
        unit = self.parts(point.c)
        cells = {"cell_c": N_CELL, "cell_t": N_CELL, "cell_s": N_SURGE_CELL}
        cell_c, cell_t, cell_s = (ca.SX.sym(k, n) for k, n in cells.items())
        mc, mt = ca.SX.sym("mc", 4), ca.SX.sym("mt", 3)
        beta_c, beta_t = point.z[_NZ - 2], point.z[_NZ - 1]
        k = self._map_arguments(point, unit, mc[1])
        at_c, flow = unit.cmap.at(k["n_c"], beta_c, k["RNI_c"], cell_c, cell_s)
        at_t, _ = unit.tmap.at(k["n_t"], beta_t, k["RNI_t"], cell_t)
        values_c = ca.vertcat(at_c.W, at_c.PR, at_c.eta, at_c.SM)
        values_t = ca.vertcat(at_t.W, at_t.PR, at_t.eta)
        alg, P_free, y = self._pass(point, unit, mc, mt)
        y |= {"n_c": k["n_c"], "n_t": k["n_t"]}
        y |= {"off_c": ca.SX(0), "off_t": ca.SX(0), "residual": ca.SX(0)}  # no derivatives of these
        q, yv = ca.vertcat(alg, P_free), Y.stack({n: y[n] for n in Y.names})
        # derivatives of the whole by the chain rule
        by = [point.z, point.x, point.u, point.a, point.theta, *([] if self.held else [point.c])]
        v = ca.vertcat(*by)
        dmc = ca.jacobian(values_c, v)
        dmt = ca.jacobian(values_t, v) + ca.mtimes(ca.jacobian(values_t, mc), dmc)
        dq, dy = (
            ca.jacobian(e, v)
            + ca.mtimes(ca.jacobian(e, mc), dmc)
            + ca.mtimes(ca.jacobian(e, mt), dmt)
            for e in (q, yv)
        )
        yv[Y.index("off_c")], yv[Y.index("off_t")] = at_c.off, at_t.off
        # 1-norm: fmax inside the max-norm would swallow NaN
        yv[Y.index("residual")] = ca.norm_1(alg)
        # what the maps say takes the place of its symbols, the turbine's first: it needs PR_c
        out = [alg, P_free, yv, dq, dy]
        for symbol, value in ((mt, values_t), (mc, values_c)):
            out = ca.substitute(out, [symbol], [value])
        table = [unit.cmap.N_map_des * k["n_c"], beta_c, unit.tmap.N_map_des * k["n_t"], beta_t]
        return (
            ca.Function("where", [*point], [ca.vertcat(*table)]),
            ca.Function("flow", [*point, cell_c], [flow]),
            ca.Function("cycle", [*point, cell_c, cell_t, cell_s], out),
        )

    def function(
        self,
        name: str,
        args: Mapping[str, ca.SX],
        point: Point,
        outputs: Callable[[Assembled], Mapping[str, Any]],
        *,
        reciprocals: bool = False,
    ) -> ca.Function:
        """Make a function that evaluates the cycle at a point given by its arguments.

        Args:
            name: of the function.
            args: its arguments by name, symbols.
            point: where to evaluate the cycle, SX expressions of the arguments.
            outputs: what to return, by name, made from the cycle at the point; what of it is not
                used costs nothing.
            reciprocals: divide once by each number; for a Newton step, whose last bits do not
                matter (:mod:`apu_casadi.core.reciprocals`).

        Returns:
            MX function args -> outputs, dense.  It finds the map cells and calls one SX function.
        """
        where, flow, cycle = self._core
        given = list(args.values())
        cells = [ca.SX.sym("c", N_CELL), ca.SX.sym("t", N_CELL), ca.SX.sym("s", N_SURGE_CELL)]
        made = outputs(Assembled(*cycle.call([*point, *cells])))
        values = ca.cse([ca.densify(ca.SX(e)) for e in made.values()])
        # nothing is differentiated by the cells: they change by jumps only, between which the
        # coefficients are those of the same smooth surface
        free = [k != "c" or not self.held for k in args]
        smooth = {"is_diff_in": [*free, *[False] * len(cells)]}
        inner = ca.Function(f"{name}_sx", [*given, *cells], values, smooth)
        if reciprocals:
            inner = by_reciprocals(inner)
        find = ca.Function("find", given, ca.cse(where.call([*point])))
        read = ca.Function("read", [*given, cells[0]], ca.cse(flow.call([*point, cells[0]])))
        q = [ca.MX.sym(k, *s.shape) for k, s in args.items()]
        at = find(*q)
        cell_c = surface_cell(self.compressor)(at[0], at[1])
        cell_t = surface_cell(self.turbine)(at[2], at[3])
        cell_s = ca.MX(N_SURGE_CELL, 1)
        if any(ca.depends_on(e, cells[2]) for e in values):
            cell_s = surge_cell(self.compressor)(read(*q, cell_c))
        out = inner.call([*q, cell_c, cell_t, cell_s])
        return ca.Function(name, q, out, list(args), list(made), {"is_diff_in": free})

    def _point(self) -> tuple[dict[str, ca.SX], Point]:
        """Arguments x, z, u, theta, c, and the point that they give."""
        n = {"x": _NX, "z": _NZ, "u": _NU, "theta": _NT, "c": _NC}
        args = {k: ca.SX.sym(k, m) for k, m in n.items()}
        return args, Point(a=self.ambient(args["u"]), **args)

    # -- functions of (x, z, u, theta, c) -----------------------------------------------------

    @derived
    def equations(self) -> ca.Function:
        """The model: (x, z, u, theta, c) -> (ode, alg, y), from which all else is made."""
        args, point = self._point()
        return self.function(
            "gas_generator",
            args,
            point,
            lambda e: {"ode": self._ode(e, point), "alg": e.alg, "y": e.y},
        )

    @staticmethod
    def _J(point: Point) -> Any:
        return point.c[NUMBERS.index("gas_generator.J")]

    def _ode(self, e: Assembled, point: Point) -> Any:
        """dN/dt, rad/s2."""
        P_acceleration = e.P_free - point.u[1]
        return rotor_acceleration(P_acceleration=P_acceleration, N=point.x, J=self._J(point))

    @derived
    def root(self) -> ca.Function:
        """Newton's method: (z0, x, u, theta, c) -> z; its derivatives are :attr:`slopes`."""
        args, point = self._point()
        # the unknown first, as the root finder wants it; a once, not in every iteration
        args = {"z": args["z"]} | args | {"a": ca.SX.sym("a", _NA)}
        scale = self.scale(args["c"])
        point = point._replace(z=scale * args["z"], a=args["a"])
        step = self.function(
            "newton", args, point, lambda e: {"step": -self._along(e, e.alg) / scale}
        )
        q = step.mx_in()
        # fast_newton serves as the loop alone: it is given the identity for a Jacobian and Newton's
        # step, over the magnitudes of z, for a residual
        options = {
            "abstol": 0.0,
            "abstolStep": STEP_TOL,
            "max_iter": 20,
            "error_on_fail": False,
            "jacobian_function": ca.Function("loop", q, [ca.DM.eye(_NZ), step(*q)]),
        }
        root = ca.rootfinder("gas_generator_z", "fast_newton", step, options)
        z0, x, u, theta, c = (ca.MX.sym("q", n) for n in (_NZ, _NX, _NU, _NT, _NC))
        scale = self.scale(c)
        z = scale * root(z0 / scale, x, u, theta, c, self.ambient(u))
        return ca.Function("root", [z0, x, u, theta, c], [z])

    @derived
    def slopes(self) -> ca.Function:
        """Derivatives of the root: (x, z, u, theta, c) -> dz by x, u, theta, and c if free."""
        args, point = self._point()
        ends = np.cumsum([0, _NX, _NU, _NT, *([] if self.held else [_NC])]).tolist()

        def outputs(e: Assembled) -> dict[str, Any]:
            z_w = self._along(e, self._by_inputs(e.dq[:_NZ, :], point))
            names = ("x", "u", "theta", "c")
            return {f"z_{k}": z_w[:, i:j] for k, (i, j) in zip(names, pairwise(ends), strict=False)}

        return self.function("z_w", args, point, outputs)

    def _by_inputs(self, d: Any, point: Point) -> Any:
        """Derivatives by w = (x, u, theta), and c if free, at fixed z from those by v.

        ``a`` follows from u.
        """
        k, a_u = COLUMNS, ca.jacobian(point.a, point.u)
        by = [d[:, k.x], d[:, k.u] + ca.mtimes(d[:, k.a], a_u), d[:, k.theta]]
        return ca.horzcat(*by, *([] if self.held else [d[:, k.c]]))

    @staticmethod
    def _along(e: Assembled, by: Any) -> Any:
        """Derivatives of z along 0 = alg, given those of alg at fixed z, by columns."""
        return -solve_bordered(e.dq[:_NZ, COLUMNS.z], by, N_ORDERED)

    @derived
    def sensitivities(self) -> ca.Function:
        """Exact total derivatives at a solved point.

        Function (x, z, u, theta, c) -> (xdot, y, xdot_w, y_w, z_w) with w = (x, u, theta), and c
        if free, by the implicit function theorem.  Rows off_c, off_t and residual of y_w are zero.
        """
        args, point = self._point()
        k = COLUMNS

        def outputs(e: Assembled) -> dict[str, Any]:
            q_w, y_w = (self._by_inputs(d, point) for d in (e.dq, e.dy))
            z_w = self._along(e, q_w[:_NZ, :])
            P_w = q_w[_NZ, :] + ca.mtimes(e.dq[_NZ, k.z], z_w)
            P_w[_NX + 1] -= 1  # the load
            N, J, xdot = point.x, self._J(point), self._ode(e, point)
            xdot_w = P_w / (J * N)
            xdot_w[0] -= xdot / N
            if not self.held:
                xdot_w[_NX + _NU + _NT + NUMBERS.index("gas_generator.J")] -= xdot / J
            y_w = y_w + ca.mtimes(e.dy[:, k.z], z_w)
            return {"xdot": xdot, "y": e.y, "xdot_w": xdot_w, "y_w": y_w, "z_w": z_w}

        return self.function("sensitivities", args, point, outputs)

    @derived
    def dfdx(self) -> ca.Function:
        """(x, z, u, theta, c) -> (ode, d ode/dx along 0 = alg, 1-norm of alg, dz/dx)."""
        args, point = self._point()
        k = COLUMNS

        def outputs(e: Assembled) -> dict[str, Any]:
            z_x = self._along(e, e.dq[:_NZ, k.x])
            P_x = e.dq[_NZ, k.x] + ca.mtimes(e.dq[_NZ, k.z], z_x)
            ode = self._ode(e, point)
            ode_x = P_x / (self._J(point) * point.x) - ode / point.x
            return {"ode": ode, "ode_x": ode_x, "residual": ca.norm_1(e.alg), "z_x": z_x}

        return self.function("dfdx", args, point, outputs)

    @derived
    def similar(self) -> ca.Function:
        """First guess of z by similarity with the design point: Function (x, u, c) -> z.

        Corrected quantities are kept, temperature rises scaled with corrected speed and with the
        fuel-air ratio; close enough for Newton's method over the flight envelope.
        """
        xs, us, c = ca.SX.sym("x", _NX), ca.SX.sym("u", _NU), ca.SX.sym("c", _NC)
        unit, v = self.parts(c), U.unpack(us)
        p, d = unit.p, unit.design.values
        _, _, T1, P1 = ca.vertsplit(self.ambient(us))
        T2, P2 = inlet(T1=T1, P1=P1, dp_inlet=p.dp_inlet)
        t = T2 / d["T2"]
        n = xs / p.N / ca.sqrt(t)
        T3 = T2 * (1 + (d["T3"] / d["T2"] - 1) * n**2)
        W = p.W2 * (P2 / d["P2"]) / ca.sqrt(t) * n
        T4 = T3 + (p.T4 - d["T3"]) * (v["Wf"] / W) / (d["Wf"] / p.W2)
        return ca.Function("similar", [xs, us, c], [ca.vertcat(*similar_z(unit, T3=T3, T4=T4))])
