"""The design point: what the design data alone fix, by Newton's method; no map enters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import OperatingPointError
from apu_casadi.core.parameters import of_symbols
from apu_casadi.core.rootfinding import Newton
from apu_casadi.core.sharing import once
from apu_casadi.gaspath.atmosphere import ambient
from apu_casadi.gaspath.components.shaft import power_balance
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.designdata import GasGeneratorParameters
from apu_casadi.gaspath.gas import Gas
from apu_casadi.gaspath.stations import TEMPERATURES, UNKNOWNS, stations


@dataclass(frozen=True)
class DesignPoint:
    """What the design calculation fixes: areas, map design values, station values.

    Args:
        A3, A8: flow areas, m2.
        W_t, PR_t: turbine flow W41 sqrt(T41)/P4 (kg/s sqrt(K)/Pa) and pressure ratio.
        z: algebraic unknowns (except map coordinates) by name.
        values: every station value by name (SI), and Wf, PW.
        residual: re-evaluated max-norm of the design residuals.
    """

    A3: Any
    A8: Any
    W_t: Any
    PR_t: Any
    z: dict[str, Any]
    values: dict[str, Any]
    residual: float


class DesignEquations:
    """The design point's equations for one set of gas data, as functions of the parameters p.

    Args:
        data: name of the gas data.

    Attributes:
        names, equations: of unknowns and residuals.
        residual: Function (w, p) -> r.
        start: Function p -> w, where the search starts.
        point: Function (w, p) -> A3, A8, W_t, PR_t, temperatures z, and ``values`` by name.
    """

    names: tuple[str, ...]
    equations: tuple[str, ...]
    residual: Any
    start: Any
    values: tuple[str, ...]
    point: Any
    newton: Newton

    def __init__(self, data: str) -> None:
        n_p = len(GasGeneratorParameters().signals("p"))
        self.names = tuple("Wf" if n == "T4" else n for n in TEMPERATURES)  # T4 is given
        w, ps = ca.SX.sym("w", len(self.names)), ca.SX.sym("p", n_p)
        v = dict(zip(self.names, ca.vertsplit(w), strict=True))
        p = of_symbols(GasGeneratorParameters, ps, gas_data=data)
        gas = Gas.of_symbols(p.x_HC, data)
        amb = ambient(**{n: getattr(p, n) for n in AMBIENT}, gas=gas)
        z = {**v, "T4": p.T4}
        loss: dict[str, Any] = {"dp_burner": p.dp_burner, "dp_exhaust": p.dp_exhaust}
        maps = {n: getattr(p, n) for n in ("W2", "PR_c", "eta_c", "eta_t")}
        given = {"gas": gas, "amb": amb, "war": p.war, "Wf": v["Wf"]}
        y, res = stations(p=p, z=z, **given, **maps, **loss, PR_t=None, A3=1.0, A8=1.0)
        # at the design point the areas follow from the static states, not the other way round
        A3, A8 = (1 / (res.pop(n) + 1) for n in ("static state 3", "exit flow"))
        res["static pressure 3"] = y["Ps3"] / y["P3"] - p.Ps3_P3
        self.equations = tuple(res)
        self.residual = ca.Function("design", [w, ps], [ca.vertcat(*res.values())])
        T3 = amb.T1 * p.PR_c**0.2857 / p.eta_c**0.5
        start = {k.name: k.share * {3: T3, 4: p.T4}[k.follows] for k in UNKNOWNS if k.follows}
        start["Wf"] = p.W2 * 1150 * (p.T4 - T3) / p.LHV
        self.start = ca.Function(
            "design_start", [ps], [ca.vertcat(*(start[n] for n in self.names))]
        )
        power = {"P_turb": y["P_turb"], "P_cpr": y["P_cpr"], "eta_cpr": p.eta_cpr}
        y |= {"Wf": v["Wf"], "PW": power_balance(**power, P_acc=p.P_acc, PW=0.0)}
        W_t = y["W41"] * ca.sqrt(y["T41"]) / y["P4"]
        self.values = tuple(y)
        areas = [A3, A8, W_t, y["PR_t"], *(z[n] for n in TEMPERATURES)]
        self.point = ca.Function("design_point", [w, ps], [ca.vertcat(*areas, *y.values())])
        nominal = {k.name: k.nominal for k in UNKNOWNS} | {"Wf": 0.05}
        self.newton = Newton(
            self.residual,
            scale=np.array([nominal[n] for n in self.names]),
            lower=np.array([1e-5 if n == "Wf" else 150.0 for n in self.names]),
            max_step=1.0,
        )


@once
def design_equations(data: str) -> DesignEquations:
    """Return the design point's equations, made once for each set of gas data."""
    return DesignEquations(data)


def solve_design(p: GasGeneratorParameters) -> DesignPoint:
    """Solve the design point from the parameters alone; no map enters.

    Raises:
        OperatingPointError: the design data admit no solution; names the worst equation.
    """
    eq = design_equations(p.gas_data)
    ps = np.array([value for _, value, *_ in p.table()])
    root = eq.newton(np.asarray(eq.start(ps)).ravel(), ps)
    if not root.success:
        raise OperatingPointError(
            f"design point not solved: equation {eq.equations[root.worst]!r} left a residual of "
            f"{root.residual:.1e} (largest allowed {eq.newton.tol:.0e}); check that T4, PR_c and "
            f"the efficiencies are possible together"
        )
    vals = np.asarray(eq.point(root.x, ps)).ravel().tolist()
    z = dict(zip(TEMPERATURES, vals[4:], strict=False))
    values = dict(zip(eq.values, vals[4 + len(z) :], strict=True))
    A3, A8, W_t, PR_t, *_ = vals
    return DesignPoint(A3, A8, W_t, PR_t, z, values, root.residual)
