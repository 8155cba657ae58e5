"""The gas generator's cycle: signals, parameters, design point, residual equations, Jacobians.

Thermodynamics and maps are written once, as SX expressions.  Only finding the cell of a map that a
point lies in needs an MX graph, so every function made here has the same two parts
(:meth:`Cycle.function`): look up the cells, then evaluate one SX function, which holds all the rest
down to the solution of linear systems, with common subexpressions computed once.  Jacobians of the
whole are assembled from those of maps and stations by the chain rule, which gives shorter code than
differentiating through.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import OperatingPointError
from apu_casadi.core.parameters import Parameters, par
from apu_casadi.core.rootfinding import Newton, solve_bordered
from apu_casadi.core.sharing import Parametric, derived
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.atmosphere import Ambient, ambient
from apu_casadi.gaspath.components.combustor import combustor, snox
from apu_casadi.gaspath.components.compressor import bleeds, compressor
from apu_casadi.gaspath.components.exhaust import exhaust, static_state
from apu_casadi.gaspath.components.inlet import inlet
from apu_casadi.gaspath.components.shaft import power_balance, rotor_acceleration
from apu_casadi.gaspath.components.turbine import mix_cooling, turbine
from apu_casadi.gaspath.conditions import CONDITIONS
from apu_casadi.gaspath.gas import Gas
from apu_casadi.gaspath.maps.scaledmaps import (
    N_CELL,
    N_SURGE_CELL,
    ScaledMap,
    surface_cell,
    surge_cell,
)

RPM = math.pi / 30.0  # rad/s per r/min


def _design(name: str, doc: str, source: str) -> Any:
    """Declare an ambient condition of the design point: the default day, and its range."""
    c = CONDITIONS[name]
    return par(c.default, unit=c.unit, source=source, doc=doc, lo=c.lo, hi=c.hi)


@dataclass(frozen=True)
class GasGeneratorParameters(Parameters):
    """Design data of the gas generator (paper, Tables 3 and 4)."""

    altitude: float = _design("altitude", "design altitude", "Table 3")
    Mach: float = _design("Mach", "design flight Mach number", "Table 3")
    dT_isa: float = _design("dT_isa", "design ISA deviation", "Table 3")
    war: float = _design("war", "design humidity", "Table 4 (SNOx)")
    N: float = par(36050.0 * RPM, unit="rad/s", source="Table 3", doc="design rotor speed", lo=1)
    W2: float = par(
        3.1442, unit="kg/s", source="Table 4; Table 3's corrected flow contradicts it",
        doc="design compressor inlet flow", lo=1e-3,
    )  # fmt: skip
    PR_c: float = par(
        8.0, unit="1", source="Table 3", doc="compressor pressure ratio", lo=1.5, hi=60
    )
    eta_c: float = par(0.85, unit="1", source="Table 3", doc="compressor efficiency", lo=0.3, hi=1)
    T4: float = par(
        1200.114, unit="K", source="Table 4", doc="burner exit temperature", lo=600, hi=2200
    )
    eta_t: float = par(0.89, unit="1", source="Table 3", doc="turbine efficiency", lo=0.3, hi=1)
    dp_inlet: float = par(
        0.01, unit="1", source="Table 4, 1 - P2/P1", doc="inlet loss", lo=0, hi=0.5
    )
    dp_burner: float = par(
        0.03, unit="1", source="Table 4, 1 - P4/P3", doc="burner loss", lo=0, hi=0.5
    )
    dp_exhaust: float = par(
        0.02, unit="1", source="Table 4, 1 - P8/P5", doc="exhaust duct loss", lo=0, hi=0.5
    )
    NPR: float = par(
        1.03, unit="1", source="Table 4, P8/P0", doc="exit pressure ratio", lo=1.001, hi=1.8
    )
    bleed_overboard: float = par(
        0.01, unit="1", source="Table 4 flows", doc="of W2, lost", lo=0, hi=0.3
    )
    cool_ngv: float = par(
        0.05, unit="1", source="Table 4 flows", doc="of W2, vane cooling", lo=0, hi=0.3
    )
    cool_rotor: float = par(
        0.05, unit="1", source="Table 4 flows", doc="of W2, rotor cooling", lo=0, hi=0.3
    )
    eta_burner: float = par(
        1.0, unit="1", source="Table 4, T4", doc="burner efficiency", lo=0.5, hi=1
    )
    LHV: float = par(43.124e6, unit="J/kg", source="Table 3", doc="lower heating value", lo=1e6)
    x_HC: float = par(
        1.9185, unit="1", source="kerosene; fits Table 4", doc="hydrogen per carbon", lo=0, hi=4
    )
    eta_cpr: float = par(
        1.0, unit="1", source="Table 4, power closure", doc="power transfer to the compressor",
        lo=0.5, hi=1,
    )  # fmt: skip
    P_acc: float = par(30e3, unit="W", source="Table 3", doc="accessory power", lo=0)
    gas_data: str = "nasa7"  # the data behind the paper's tables; "nasa9" for newer physics
    Ps3_P3: float = par(
        0.95742, unit="1", source="Table 4, fixes the area at 3", doc="static over total pressure",
        lo=0.6, hi=0.999,
    )  # fmt: skip
    J: float = par(
        0.05, unit="kg m^2",
        source="assumed: 356 kJ at design speed, 0.7 s of design power; generators included",
        doc="inertia at the rotor", lo=1e-5,
    )  # fmt: skip


class _Unknown(NamedTuple):
    """The algebraic unknowns z, by name."""

    T3s: Any
    T3: Any
    T4: Any
    T41: Any
    T5s: Any
    T50: Any
    T5: Any
    Ts8: Any
    Ts3: Any
    beta_c: Any
    beta_t: Any


class _Stations(NamedTuple):
    """Station values and residuals of one pass, before the maps close the system."""

    y: dict[str, Any]
    res: dict[str, Any]


_NOMINAL = {"altitude": 1e4, "Mach": 1.0, "dT_isa": 30.0, "war": 0.01}
X = Signals([Signal("N", "rad/s", "rotor speed", nominal=3775.0)])
U = Signals(
    [
        Signal("Wf", "kg/s", "fuel flow", nominal=0.05),
        Signal("PW", "W", "shaft power to the load", nominal=5e5),
        *(
            Signal(n, c.unit, c.doc, default=c.default, nominal=_NOMINAL[n])
            for n, c in CONDITIONS.items()
        ),
    ]
)
THETA = Signals(
    [
        Signal("f_eta_c", "1", "compressor efficiency factor", default=1.0),
        Signal("f_W_c", "1", "compressor flow factor", default=1.0),
        Signal("f_eta_t", "1", "turbine efficiency factor", default=1.0),
        Signal("f_W_t", "1", "turbine flow factor", default=1.0),
    ]
)
HEALTH = THETA.names

Y = Signals(
    [
        Signal("N", "rad/s", "rotor speed (XNHPC)", nominal=3775.0),
        Signal("PW", "W", "output shaft power (PWSD), without accessories", nominal=5e5),
        Signal("SFC", "kg/J", "fuel flow over shaft and accessory power", nominal=1e-7),
        Signal("SNOx", "1", "NOx severity factor"),
        Signal("SM", "1", "compressor stability margin at constant corrected flow (HPCSM)"),
        Signal("Wf", "kg/s", "fuel flow", nominal=0.05),
        Signal("T0", "K", "ambient static temperature", nominal=300.0),
        Signal("P0", "Pa", "ambient static pressure", nominal=1e5),
        Signal("T1", "K", "intake entrance total temperature", nominal=300.0),
        Signal("P1", "Pa", "intake entrance total pressure", nominal=1e5),
        Signal("T2", "K", "compressor inlet total temperature", nominal=300.0),
        Signal("P2", "Pa", "compressor inlet total pressure", nominal=1e5),
        Signal("W2", "kg/s", "compressor inlet flow", nominal=3.0),
        Signal("T3", "K", "compressor outlet total temperature", nominal=600.0),
        Signal("P3", "Pa", "compressor outlet total pressure", nominal=8e5),
        Signal("Ps3", "Pa", "compressor outlet static pressure", nominal=8e5),
        Signal("W3", "kg/s", "compressor outlet flow", nominal=3.0),
        Signal("W31", "kg/s", "combustor inlet flow", nominal=3.0),
        Signal("T4", "K", "combustor outlet total temperature", nominal=1200.0),
        Signal("P4", "Pa", "combustor outlet total pressure", nominal=8e5),
        Signal("W4", "kg/s", "combustor outlet flow", nominal=3.0),
        Signal("FAR4", "kg/kg", "burnt fuel per dry air at 4", nominal=0.02),
        Signal("T41", "K", "turbine rotor inlet total temperature", nominal=1200.0),
        Signal("W41", "kg/s", "turbine rotor inlet flow", nominal=3.0),
        Signal(
            "T50", "K", "rotor exit total temperature, before rotor cooling mixes", nominal=750.0
        ),
        Signal("T5", "K", "turbine outlet total temperature", nominal=750.0),
        Signal("P5", "Pa", "turbine outlet total pressure", nominal=1e5),
        Signal("W5", "kg/s", "turbine outlet flow", nominal=3.0),
        Signal("T8", "K", "exhaust exit total temperature", nominal=750.0),
        Signal("P8", "Pa", "exhaust exit total pressure", nominal=1e5),
        Signal("W8", "kg/s", "exhaust exit flow", nominal=3.0),
        Signal("Mach8", "1", "exhaust exit Mach number"),
        Signal("V8", "m/s", "exhaust exit speed", nominal=100.0),
        Signal("P_turb", "W", "turbine power", nominal=1e6),
        Signal("P_cpr", "W", "compressor power", nominal=1e6),
        Signal("P_acceleration", "W", "power left to accelerate the rotor", nominal=1e5),
        Signal("n_c", "1", "corrected compressor speed over design"),
        Signal("PR_c", "1", "compressor pressure ratio"),
        Signal("eta_c", "1", "compressor efficiency, health factor included"),
        Signal("n_t", "1", "corrected turbine speed over design"),
        Signal("PR_t", "1", "turbine pressure ratio"),
        Signal("eta_t", "1", "turbine efficiency, health factor included"),
        Signal("off_c", "1", "distance off the compressor map, in table spans"),
        Signal("off_t", "1", "distance off the turbine map, in table spans"),
        Signal("residual", "1", "largest cycle residual at this point"),
    ]
)


def reynolds_index(*, P: Any, T: Any, P_ref: Any, T_ref: Any) -> Any:
    """Reynolds number index P/(sqrt(T) viscosity(T)) over its reference; 1 at the reference.

    Viscosity of air by Sutherland's law with 110.4 K (U.S. Standard Atmosphere 1976).
    """

    def viscosity(t: Any) -> Any:
        return t**1.5 / (t + 110.4)

    return (P / P_ref) * ca.sqrt(T_ref / T) * viscosity(T_ref) / viscosity(T)


def _stations(
    *,
    p: GasGeneratorParameters,
    gas: Gas,
    amb: Ambient,
    war: Any,
    Wf: Any,
    W2: Any,
    PR_c: Any,
    eta_c: Any,
    dp_burner: Any,
    PR_t: Any,
    eta_t: Any,
    dp_exhaust: Any,
    A3: Any,
    A8: Any,
    z: Mapping[str, Any],
) -> _Stations:
    """Pass through the components from 1 to 8; used by design and off-design alike.

    ``PR_t=None`` is the design calculation: the turbine expands to the exit pressure ratio NPR.
    """
    T2, P2 = inlet(T1=amb.T1, P1=amb.P1, dp_inlet=p.dp_inlet)
    c = compressor(
        T2=T2, P2=P2, W2=W2, PR=PR_c, eta=eta_c, T3s=z["T3s"], T3=z["T3"], war=war, gas=gas
    )
    b = bleeds(W3=W2, overboard=p.bleed_overboard, ngv=p.cool_ngv, rotor=p.cool_rotor)
    s3 = static_state(T=z["T3"], P=c.P3, W=W2, Ts=z["Ts3"], A=A3, FAR=0.0, war=war, gas=gas)
    burner = combustor(
        T31=z["T3"], P31=c.P3, W31=b.W31, Wf=Wf, T4=z["T4"], war=war, dp_burner=dp_burner,
        eta_burner=p.eta_burner, LHV=p.LHV, gas=gas,
    )  # fmt: skip
    vane = mix_cooling(
        T=z["T4"], W=burner.W4, FAR=burner.FAR4, T_cool=z["T3"], W_cool=b.W_ngv, T_mix=z["T41"],
        war=war, gas=gas,
    )  # fmt: skip
    if PR_t is None:
        PR_t = burner.P4 * (1 - dp_exhaust) / (p.NPR * amb.P0)
    t = turbine(
        T41=z["T41"], P4=burner.P4, W41=vane.W, FAR41=vane.FAR, PR=PR_t, eta=eta_t, T5s=z["T5s"],
        T50=z["T50"], war=war, gas=gas,
    )  # fmt: skip
    rotor = mix_cooling(
        T=z["T50"], W=vane.W, FAR=vane.FAR, T_cool=z["T3"], W_cool=b.W_rotor, T_mix=z["T5"],
        war=war, gas=gas,
    )  # fmt: skip
    e = exhaust(
        T5=z["T5"], P5=t.P5, W5=rotor.W, FAR=rotor.FAR, P0=amb.P0, Ts8=z["Ts8"], A8=A8,
        dp_exhaust=dp_exhaust, war=war, gas=gas,
    )  # fmt: skip
    y = {
        "SNOx": snox(T3=z["T3"], P3=c.P3, war=war),
        "T0": amb.T0,
        "P0": amb.P0,
        "T1": amb.T1,
        "P1": amb.P1,
        "T2": T2,
        "P2": P2,
        "W2": W2,
        "T3": z["T3"],
        "P3": c.P3,
        "Ps3": s3.Ps,
        "W3": W2,
        "W31": b.W31,
        "T4": z["T4"],
        "P4": burner.P4,
        "W4": burner.W4,
        "FAR4": burner.FAR4,
        "T41": z["T41"],
        "W41": vane.W,
        "FAR41": vane.FAR,
        "T50": z["T50"],
        "T5": z["T5"],
        "P5": t.P5,
        "W5": rotor.W,
        "T8": z["T5"],
        "P8": e.P8,
        "W8": rotor.W,
        "Mach8": e.Mach8,
        "V8": e.V8,
        "P_turb": t.P_turb,
        "P_cpr": c.P_cpr,
        "PR_c": PR_c,
        "PR_t": PR_t,
    }
    res = {
        "compressor isentrope": c.res_isentropic,
        "compressor efficiency": c.res_efficiency,
        "burner energy": burner.res_energy,
        "vane cooling energy": vane.res_energy,
        "turbine isentrope": t.res_isentropic,
        "turbine efficiency": t.res_efficiency,
        "rotor cooling energy": rotor.res_energy,
        "exhaust isentrope": e.res_isentropic,
        "exit flow": e.res_flow,
        "static state 3": s3.res_flow,
    }
    return _Stations(y, res)


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

    A3: float
    A8: float
    W_t: float
    PR_t: float
    z: dict[str, float]
    values: dict[str, float]
    residual: float


def solve_design(p: GasGeneratorParameters, gas: Gas) -> DesignPoint:
    """Solve the design point from the parameters alone; no map enters.

    Raises:
        OperatingPointError: the design data admit no solution; names the worst equation.
    """
    names = ("T3s", "T3", "Wf", "T41", "T5s", "T50", "T5", "Ts8", "Ts3")
    w = ca.SX.sym("w", len(names))
    v = dict(zip(names, ca.vertsplit(w), strict=True))
    amb = ambient(altitude=p.altitude, Mach=p.Mach, dT_isa=p.dT_isa, war=p.war, gas=gas)
    st = _stations(
        p=p, gas=gas, amb=amb, war=p.war, Wf=v["Wf"], W2=p.W2, PR_c=p.PR_c, eta_c=p.eta_c,
        dp_burner=p.dp_burner, PR_t=None, eta_t=p.eta_t, dp_exhaust=p.dp_exhaust, A3=1.0,
        A8=1.0, z={**v, "T4": p.T4},
    )  # fmt: skip
    # at the design point the areas follow from the static states, not the other way round
    res = {k: r for k, r in st.res.items() if k not in ("exit flow", "static state 3")}
    res["static pressure 3"] = st.y["Ps3"] / st.y["P3"] - p.Ps3_P3
    A3, A8 = 1 / (st.res["static state 3"] + 1), 1 / (st.res["exit flow"] + 1)
    r = ca.vertcat(*res.values())
    T2 = float(amb.T1)
    T3 = T2 * p.PR_c**0.2857 / p.eta_c**0.5
    T5 = 0.65 * p.T4
    start = [T3, T3, p.W2 * 1150 * (p.T4 - T3) / p.LHV, p.T4, T5, T5, T5, T5 * 0.98, T3 * 0.985]
    solver = Newton(
        ca.Function("design", [w, ca.SX.sym("p", 0)], [r]),
        scale=np.array([500, 500, 0.05, 1000, 700, 700, 700, 700, 500.0]),
        lower=np.array([150, 150, 1e-5] + [150] * 6, float),
        max_step=1.0,
    )
    root = solver(start, np.zeros(0))
    if not root.success:
        raise OperatingPointError(
            f"design point not solved: equation {list(res)[root.worst]!r} left a residual of "
            f"{root.residual:.1e} (largest allowed {solver.tol:.0e}); check that T4, PR_c and "
            f"the efficiencies are possible together"
        )
    y_names = list(st.y)
    out = ca.Function("out", [w], [ca.vertcat(A3, A8, *(st.y[k] for k in y_names))])(root.x)
    vals = np.asarray(out).ravel()
    values = dict(zip(y_names, vals[2:].tolist(), strict=True))
    z = dict(zip(names, root.x.tolist(), strict=True))
    values["Wf"] = z["Wf"]
    W_t = values["W41"] * math.sqrt(values["T41"]) / values["P4"]
    z_all = {k: z[k] for k in z if k != "Wf"} | {"T4": p.T4}
    return DesignPoint(
        float(vals[0]), float(vals[1]), W_t, values["PR_t"], z_all, values, root.residual
    )


Z_NAMES = ("T3s", "T3", "T4", "T41", "T5s", "T50", "T5", "Ts8", "Ts3", "beta_c", "beta_t")
_Z_DOCS = {
    "T3s": "isentropic compressor outlet temperature",
    "T3": "compressor outlet temperature",
    "T4": "combustor outlet temperature",
    "T41": "rotor inlet temperature",
    "T5s": "isentropic rotor exit temperature",
    "T50": "rotor exit temperature",
    "T5": "turbine outlet temperature",
    "Ts8": "exhaust exit static temperature",
    "Ts3": "compressor outlet static temperature",
}
EQUATIONS = (
    "compressor isentrope",
    "compressor efficiency",
    "burner energy",
    "vane cooling energy",
    "turbine isentrope",
    "turbine efficiency",
    "rotor cooling energy",
    "exhaust isentrope",
    "exit flow",
    "static state 3",
    "turbine flow",
)
AMBIENT_STATE = ("T0", "P0", "T1", "P1")  # ambient quantities, computed once per set of inputs
_NZ, _NX, _NU, _NA, _NT = len(Z_NAMES), len(X), len(U), len(AMBIENT_STATE), len(THETA)
# In this order, equation k determines temperature k of z from those before it and from the map
# coordinates; the last two equations are left for the coordinates.
_LAST = ("static state 3", "exit flow", "turbine flow")
ORDER = (*range(_NZ - len(_LAST)), *(EQUATIONS.index(n) for n in _LAST))
N_ORDERED = _NZ - 2
STEP_TOL = 1e-7  # of Newton's last step, relative: it converges quadratically, some 1e-13 is left


class Columns(NamedTuple):
    """Which columns of the assembled Jacobians belong to what: v = (z, x, u, a, theta)."""

    z: slice
    x: slice
    u: slice
    a: slice
    theta: slice


def _columns() -> Columns:
    ends = np.cumsum([0, _NZ, _NX, _NU, _NA, _NT]).tolist()
    return Columns(*(slice(i, j) for i, j in pairwise(ends)))


COLUMNS = _columns()


class Assembled(NamedTuple):
    """The cycle at one point, as SX: residuals, power before the load, outputs, derivatives.

    ``dq`` are the derivatives of (residuals, power before the load) and ``dy`` those of y with
    respect to v = (z, x, u, a, theta); rows off_c, off_t and residual of ``dy`` are zero.
    """

    alg: Any
    P_free: Any
    y: Any
    dq: Any
    dy: Any


class Point(NamedTuple):
    """Where the cycle is evaluated: state, unknowns, inputs, ``ambient(u)``, health; all SX."""

    x: Any
    z: Any
    u: Any
    a: Any
    theta: Any


@dataclass(frozen=True, eq=False)
class Cycle(Parametric):
    """The cycle equations of one engine as CasADi functions.

    Args:
        p, gas, design: parameters, working gas and solved design point.
        cmap, tmap: maps scaled to the design point; the compressor's flow is that at the design
            inlet state, kg/s, the turbine's is W41 sqrt(T41)/P4.
    """

    p: GasGeneratorParameters
    gas: Gas
    design: DesignPoint
    cmap: ScaledMap
    tmap: ScaledMap

    @derived
    def z(self) -> Signals:
        """The algebraic unknowns, with design values as magnitudes."""
        d = self.design
        temperatures = [Signal(n, "K", doc, nominal=d.z[n]) for n, doc in _Z_DOCS.items()]
        span_c, span_t = (float(np.ptp(m.table.beta)) for m in (self.cmap, self.tmap))
        return Signals(
            [
                *temperatures,
                Signal("beta_c", "1", "compressor map coordinate", nominal=span_c),
                Signal("beta_t", "1", "turbine map coordinate", nominal=span_t),
            ]
        )

    @derived
    def ambient(self) -> ca.Function:
        """Function u -> (T0, P0, T1, P1)."""
        us = ca.SX.sym("u", _NU)
        v = U.unpack(us)
        amb = ambient(
            altitude=v["altitude"], Mach=v["Mach"], dT_isa=v["dT_isa"], war=v["war"], gas=self.gas
        )
        return ca.Function("ambient", [us], [ca.vertcat(amb.T0, amb.P0, amb.T1, amb.P1)])

    # -- expressions --------------------------------------------------------------------------

    def _map_arguments(self, at: Point, PR_c: Any) -> dict[str, Any]:
        """Corrected speeds over design and Reynolds number indices of the two maps."""
        p, d, Z, N = self.p, self.design.values, _Unknown(*ca.vertsplit(at.z)), at.x
        _, _, T1, P1 = ca.vertsplit(at.a)
        T2, P2 = inlet(T1=T1, P1=P1, dp_inlet=p.dp_inlet)
        P4 = P2 * PR_c * (1 - p.dp_burner)
        return {
            "n_c": N / ca.sqrt(T2 / d["T2"]) / p.N,
            "n_t": N / ca.sqrt(Z.T41 / d["T41"]) / p.N,
            "RNI_c": reynolds_index(P=P2, T=T2, P_ref=d["P2"], T_ref=d["T2"]),
            "RNI_t": reynolds_index(P=P4, T=Z.T41, P_ref=d["P4"], T_ref=d["T41"]),
        }

    def _pass(self, at: Point, mc: Any, mt: Any) -> tuple[Any, Any, dict[str, Any]]:
        """One pass through the stations, given what the maps say.

        Args:
            mc, mt: W, PR, eta, SM of the compressor; W, PR, eta of the turbine.

        Returns:
            Residuals in the order of ``EQUATIONS``, power before the load, outputs by name; without
            those that only the maps know.
        """
        p, d = self.p, self.design
        Z, Uv, H = _Unknown(*ca.vertsplit(at.z)), U.unpack(at.u), THETA.unpack(at.theta)
        W_c, PR_c, eta_c, SM = ca.vertsplit(mc)
        W_t, PR_t, eta_t = ca.vertsplit(mt)
        T0, P0, T1, P1 = ca.vertsplit(at.a)
        amb = Ambient(T0=T0, P0=P0, V0=ca.SX(0), T1=T1, P1=P1)
        T2, P2 = inlet(T1=T1, P1=P1, dp_inlet=p.dp_inlet)
        T2d, P2d = d.values["T2"], d.values["P2"]
        W2 = W_c * H["f_W_c"] * (P2 / P2d) / ca.sqrt(T2 / T2d)
        # losses grow with the square of the corrected flow at the inlet of their duct (Table 5)
        corrected_31 = (W2 * ca.sqrt(Z.T3) / (P2 * PR_c)) / (
            p.W2 * math.sqrt(d.z["T3"]) / (P2d * p.PR_c)
        )
        P4 = P2 * PR_c * (1 - p.dp_burner * corrected_31**2)
        W5d, T5d, P5d = d.values["W5"], d.values["T5"], d.values["P5"]
        W5 = W2 * (1 - p.bleed_overboard) + Uv["Wf"]
        corrected_5 = (W5 * ca.sqrt(Z.T5) / (P4 / PR_t)) / (W5d * math.sqrt(T5d) / P5d)
        st = _stations(
            p=p, gas=self.gas, amb=amb, war=Uv["war"], Wf=Uv["Wf"], W2=W2, PR_c=PR_c,
            eta_c=eta_c * H["f_eta_c"], dp_burner=p.dp_burner * corrected_31**2, PR_t=PR_t,
            eta_t=eta_t * H["f_eta_t"], dp_exhaust=p.dp_exhaust * corrected_5**2, A3=d.A3, A8=d.A8,
            z=Z._asdict(),
        )  # fmt: skip
        capacity = W_t * H["f_W_t"]
        res = dict(st.res)
        res["turbine flow"] = st.y["W41"] * ca.sqrt(Z.T41) / st.y["P4"] / capacity - 1
        if tuple(res) != EQUATIONS:
            raise AssertionError(f"equations out of order: {tuple(res)}")
        P_free = power_balance(
            P_turb=st.y["P_turb"], P_cpr=st.y["P_cpr"], eta_cpr=p.eta_cpr, P_acc=p.P_acc, PW=0.0
        )
        y = st.y | {"N": at.x, "PW": Uv["PW"], "Wf": Uv["Wf"], "SM": SM}
        y |= {"eta_c": eta_c * H["f_eta_c"], "eta_t": eta_t * H["f_eta_t"]}
        y |= {"SFC": Uv["Wf"] / (Uv["PW"] + p.P_acc), "P_acceleration": P_free - Uv["PW"]}
        return ca.vertcat(*res.values()), P_free, y

    @derived
    def _core(self) -> tuple[ca.Function, ca.Function, ca.Function]:
        """SX functions of a point and the map cells that it lies in.

        where : (x, z, u, a, theta) -> N and beta on the compressor's and the turbine's table.
        flow : (x, z, u, a, theta, cell_c) -> flow at which the surge line is read.
        cycle : (x, z, u, a, theta, cell_c, cell_t, cell_s) -> as :class:`Assembled`.
        """
        sizes = {"x": _NX, "z": _NZ, "u": _NU, "a": _NA, "theta": _NT}
        point = Point(**{k: ca.SX.sym(k, n) for k, n in sizes.items()})
        cells = {"cell_c": N_CELL, "cell_t": N_CELL, "cell_s": N_SURGE_CELL}
        cell_c, cell_t, cell_s = (ca.SX.sym(k, n) for k, n in cells.items())
        mc, mt = ca.SX.sym("mc", 4), ca.SX.sym("mt", 3)
        beta_c, beta_t = point.z[_NZ - 2], point.z[_NZ - 1]
        k = self._map_arguments(point, mc[1])
        at_c, flow = self.cmap.at(k["n_c"], beta_c, k["RNI_c"], cell_c, cell_s)
        at_t, _ = self.tmap.at(k["n_t"], beta_t, k["RNI_t"], cell_t)
        values_c = ca.vertcat(at_c.W, at_c.PR, at_c.eta, at_c.SM)
        values_t = ca.vertcat(at_t.W, at_t.PR, at_t.eta)
        alg, P_free, y = self._pass(point, mc, mt)
        y |= {"n_c": k["n_c"], "n_t": k["n_t"]}
        y |= {"off_c": ca.SX(0), "off_t": ca.SX(0), "residual": ca.SX(0)}  # no derivatives of these
        q, yv = ca.vertcat(alg, P_free), Y.stack({n: y[n] for n in Y.names})
        # derivatives of the whole by the chain rule
        v = ca.vertcat(point.z, point.x, point.u, point.a, point.theta)
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
        table = [self.cmap.N_map_des * k["n_c"], beta_c, self.tmap.N_map_des * k["n_t"], beta_t]
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
    ) -> ca.Function:
        """Make a function that evaluates the cycle at a point given by its arguments.

        Args:
            name: of the function.
            args: its arguments by name, symbols.
            point: where to evaluate the cycle, SX expressions of the arguments.
            outputs: what to return, by name, made from the cycle at the point; what of it is not
                used costs nothing.

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
        smooth = {"is_diff_in": [True] * len(given) + [False] * len(cells)}
        inner = ca.Function(f"{name}_sx", [*given, *cells], values, smooth)
        find = ca.Function("find", given, ca.cse(where.call([*point])))
        read = ca.Function("read", [*given, cells[0]], ca.cse(flow.call([*point, cells[0]])))
        q = [ca.MX.sym(k, *s.shape) for k, s in args.items()]
        at = find(*q)
        cell_c = surface_cell(self.cmap.table)(at[0], at[1])
        cell_t = surface_cell(self.tmap.table)(at[2], at[3])
        cell_s = ca.MX(N_SURGE_CELL, 1)
        if any(ca.depends_on(e, cells[2]) for e in values):
            cell_s = surge_cell(self.cmap.table)(read(*q, cell_c))
        out = inner.call([*q, cell_c, cell_t, cell_s])
        return ca.Function(name, q, out, list(args), list(made))

    def _point(self) -> tuple[dict[str, ca.SX], Point]:
        """Arguments x, z, u, theta, and the point that they give."""
        n = {"x": _NX, "z": _NZ, "u": _NU, "theta": _NT}
        args = {k: ca.SX.sym(k, m) for k, m in n.items()}
        return args, Point(a=self.ambient(args["u"]), **args)

    # -- functions ----------------------------------------------------------------------------

    def symbols(self) -> tuple[ca.MX, ca.MX, ca.MX, ca.MX]:
        """Fresh MX symbols (x, z, u, theta)."""
        return (
            ca.MX.sym("x", _NX),
            ca.MX.sym("z", _NZ),
            ca.MX.sym("u", _NU),
            ca.MX.sym("theta", _NT),
        )

    @derived
    def equations(self) -> ca.Function:
        """The model: Function (x, z, u, theta) -> (ode, alg, y), from which all else is made."""
        args, point = self._point()
        return self.function(
            "gas_generator",
            args,
            point,
            lambda c: {"ode": self._ode(c, point), "alg": c.alg, "y": c.y},
        )

    def _ode(self, c: Assembled, point: Point) -> Any:
        """dN/dt, rad/s2."""
        return rotor_acceleration(P_acceleration=c.P_free - point.u[1], N=point.x, J=self.p.J)

    @derived
    def solve(self) -> ca.Function:
        """Solve 0 = alg for z by Newton's method, as a differentiable CasADi function.

        Function (z0, x, u, theta) -> z.  Derivatives of any order are those of the root, by the
        implicit function theorem; there are none by z0.  Success is *not* reported inside larger
        expressions: every user re-evaluates the residual, which is why it is an output of the
        model.
        """
        scale = ca.DM(self.z.nominals)
        args, point = self._point()
        # the unknown first, as the root finder wants it; a once, not in every iteration
        args = {"z": args["z"]} | args | {"a": ca.SX.sym("a", _NA)}
        point = point._replace(z=scale * args["z"], a=args["a"])
        step = self.function(
            "newton", args, point, lambda c: {"step": -self._along(c, c.alg) / scale}
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
        x, _, u, theta = self.symbols()
        z0 = ca.MX.sym("z0", _NZ)
        z1 = scale * root(z0 / scale, x, u, theta, self.ambient(u))
        names = ["z0", "x", "u", "theta"], ["z"]
        options = {"custom_jacobian": self._solve_jacobian, "jac_penalty": 0}
        return ca.Function("solve_z", [z0, x, u, theta], [z1], *names, options)

    @derived
    def _solve_jacobian(self) -> ca.Function:
        """Function (z0, x, u, theta, z) -> derivatives of z by z0, which are none, x, u, theta."""
        args, point = self._point()
        own = {"x": slice(0, _NX), "u": slice(_NX, _NX + _NU), "theta": slice(_NX + _NU, None)}

        def outputs(c: Assembled) -> dict[str, Any]:
            z_w = self._along(c, self._by_inputs(c.dq[:_NZ, :], point))
            return {f"z_{k}": z_w[:, at] for k, at in own.items()}

        x, z, u, theta = self.symbols()
        by = self.function("z_w", args, point, outputs)(x, z, u, theta)
        z0 = ca.MX.sym("z0", _NZ)
        names = ["z0", *own]
        return ca.Function(
            "jac_solve_z",
            [z0, x, u, theta, z],
            [ca.MX(_NZ, _NZ), *by],
            [*names, "out_z"],
            [f"jac_z_{k}" for k in names],
        )

    @staticmethod
    def _by_inputs(d: Any, point: Point) -> Any:
        """Derivatives by w = (x, u, theta) at fixed z from those by v; ``a`` follows from u."""
        k, a_u = COLUMNS, ca.jacobian(point.a, point.u)
        return ca.horzcat(d[:, k.x], d[:, k.u] + ca.mtimes(d[:, k.a], a_u), d[:, k.theta])

    @staticmethod
    def _along(c: Assembled, by: Any) -> Any:
        """Derivatives of z along 0 = alg, given those of alg at fixed z, by columns."""
        rows = list(ORDER)
        return -solve_bordered(c.dq[rows, COLUMNS.z], by[rows, :], N_ORDERED)

    @derived
    def sensitivities(self) -> ca.Function:
        """Exact total derivatives at a solved point.

        Function (x, z, u, theta) -> (xdot, y, xdot_w, y_w, z_w) with w = (x, u, theta), by the
        implicit function theorem.  Rows off_c, off_t and residual of y_w are zero.
        """
        args, point = self._point()
        k = COLUMNS

        def outputs(c: Assembled) -> dict[str, Any]:
            q_w, y_w = (self._by_inputs(d, point) for d in (c.dq, c.dy))
            z_w = self._along(c, q_w[:_NZ, :])
            P_w = q_w[_NZ, :] + ca.mtimes(c.dq[_NZ, k.z], z_w)
            P_w[_NX + 1] -= 1  # the load
            N, J, xdot = point.x, self.p.J, self._ode(c, point)
            xdot_w = P_w / (J * N)
            xdot_w[0] -= xdot / N
            y_w = y_w + ca.mtimes(c.dy[:, k.z], z_w)
            return {"xdot": xdot, "y": c.y, "xdot_w": xdot_w, "y_w": y_w, "z_w": z_w}

        return self.function("sensitivities", args, point, outputs)

    @derived
    def dfdx(self) -> ca.Function:
        """Function (x, z, u, theta) -> (ode, d ode/dx along 0 = alg, 1-norm of alg, dz/dx)."""
        args, point = self._point()
        k = COLUMNS

        def outputs(c: Assembled) -> dict[str, Any]:
            z_x = self._along(c, c.dq[:_NZ, k.x])
            P_x = c.dq[_NZ, k.x] + ca.mtimes(c.dq[_NZ, k.z], z_x)
            ode = self._ode(c, point)
            ode_x = P_x / (self.p.J * point.x) - ode / point.x
            return {"ode": ode, "ode_x": ode_x, "residual": ca.norm_1(c.alg), "z_x": z_x}

        return self.function("dfdx", args, point, outputs)

    @derived
    def similar(self) -> ca.Function:
        """First guess of z by similarity with the design point: Function (x, u) -> z.

        Corrected quantities are kept, temperature rises scaled with corrected speed and with the
        fuel-air ratio; close enough for Newton's method over the flight envelope.
        """
        d, p = self.design, self.p
        xs, us = ca.SX.sym("x", _NX), ca.SX.sym("u", _NU)
        v = U.unpack(us)
        amb = ambient(
            altitude=v["altitude"], Mach=v["Mach"], dT_isa=v["dT_isa"], war=v["war"], gas=self.gas
        )
        T2, P2 = inlet(T1=amb.T1, P1=amb.P1, dp_inlet=p.dp_inlet)
        t = T2 / d.values["T2"]
        n = xs / p.N / ca.sqrt(t)
        T3 = T2 * (1 + (d.z["T3"] / d.values["T2"] - 1) * n**2)
        W = p.W2 * (P2 / d.values["P2"]) / ca.sqrt(t) * n
        T4 = T3 + (p.T4 - d.z["T3"]) * (v["Wf"] / W) / (d.values["Wf"] / p.W2)
        hot = T4 / p.T4
        z = _Unknown(
            T3s=T3 * d.z["T3s"] / d.z["T3"],
            T3=T3,
            T4=T4,
            **{n: hot * d.z[n] for n in ("T41", "T5s", "T50", "T5", "Ts8")},
            Ts3=T3 * d.z["Ts3"] / d.z["T3"],
            beta_c=self.cmap.beta_des,
            beta_t=self.tmap.beta_des,
        )
        return ca.Function("similar", [xs, us], [ca.vertcat(*z)])
