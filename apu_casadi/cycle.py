"""The gas generator's cycle: signals, parameters, design point, residual equations, Jacobians.

Thermodynamics is written once, as SX expressions of the components; maps are splines, which exist
in MX graphs only.  :class:`Cycle` joins the two, and assembles exact Jacobians of the whole from
those of the parts by the chain rule: differentiating through the joined graph gives the same
numbers but code ten times as long (see ``tests/test_cycle.py``, which holds one against the
other).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.atmosphere import Ambient, ambient
from apu_casadi.components.combustor import combustor, snox
from apu_casadi.components.compressor import bleeds, compressor
from apu_casadi.components.exhaust import exhaust, static_state
from apu_casadi.components.inlet import inlet
from apu_casadi.components.shaft import power_balance, rotor_acceleration
from apu_casadi.components.turbine import mix_cooling, turbine
from apu_casadi.errors import OperatingPointError
from apu_casadi.gas import Gas
from apu_casadi.maps import ScaledMap
from apu_casadi.parameters import Parameters, par
from apu_casadi.rootfinding import Newton
from apu_casadi.signals import Signal, Signals

RPM = math.pi / 30.0  # rad/s per r/min


@dataclass(frozen=True)
class GasGeneratorParameters(Parameters):
    """Design data of the gas generator (paper, Tables 3 and 4)."""

    altitude: float = par(0.0, unit="m", source="Table 3", doc="design altitude", lo=-1e3, hi=15e3)
    Mach: float = par(0.0, unit="1", source="Table 3", doc="design flight Mach number", lo=0, hi=1)
    dT_isa: float = par(5.0, unit="K", source="Table 3", doc="design ISA deviation", lo=-80, hi=80)
    war: float = par(
        0.0, unit="kg/kg", source="Table 4 (SNOx)", doc="design humidity", lo=0, hi=0.1
    )
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


X = Signals([Signal("N", "rad/s", "rotor speed", nominal=3775.0)])
U = Signals(
    [
        Signal("Wf", "kg/s", "fuel flow", nominal=0.05),
        Signal("PW", "W", "shaft power to the load", nominal=5e5),
        Signal("altitude", "m", "geopotential altitude", default=0.0, nominal=1e4),
        Signal("Mach", "1", "flight Mach number", default=0.0),
        Signal("dT_isa", "K", "deviation from ISA", default=0.0, nominal=30.0),
        Signal("war", "kg/kg", "water per dry air", default=0.0, nominal=0.01),
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

    Parameters
    ----------
    A3, A8 : flow areas, m2.
    W_t, PR_t : turbine flow W41 sqrt(T41)/P4 (kg/s sqrt(K)/Pa) and pressure ratio.
    z : algebraic unknowns (except map coordinates) by name.
    values : every station value by name (SI), and Wf, PW.
    residual : re-evaluated max-norm of the design residuals.
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

    Raises
    ------
    OperatingPointError : the design data admit no solution; names the worst equation.
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
_A = ("T0", "P0", "T1", "P1")  # ambient quantities, computed once per set of inputs
_NZ, _NX, _NU, _NA, _NT = len(Z_NAMES), len(X), len(U), len(_A), len(THETA)
_BETA_C, _BETA_T = Z_NAMES.index("beta_c"), Z_NAMES.index("beta_t")


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
    """The cycle at one point, as MX: residuals, power before the load, outputs, derivatives.

    ``dq`` are the derivatives of (residuals, power before the load) and ``dy`` those of y with
    respect to v = (z, x, u, a, theta); None where they were not asked for.
    """

    alg: Any
    P_free: Any
    y: Any
    dq: Any
    dy: Any


@dataclass(frozen=True, eq=False)
class Cycle:
    """The cycle equations of one engine as CasADi functions.

    Parameters
    ----------
    p, gas, design : parameters, working gas and solved design point.
    cmap, tmap : maps scaled to the design point; the compressor's flow is that at the design
        inlet state, kg/s, the turbine's is W41 sqrt(T41)/P4.
    """

    p: GasGeneratorParameters
    gas: Gas
    design: DesignPoint
    cmap: ScaledMap
    tmap: ScaledMap

    @cached_property
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

    @cached_property
    def ambient(self) -> ca.Function:
        """Function u -> (T0, P0, T1, P1)."""
        us = ca.SX.sym("u", _NU)
        v = U.unpack(us)
        amb = ambient(
            altitude=v["altitude"], Mach=v["Mach"], dT_isa=v["dT_isa"], war=v["war"], gas=self.gas
        )
        return ca.Function("ambient", [us], [ca.vertcat(amb.T0, amb.P0, amb.T1, amb.P1)])

    @cached_property
    def _parts(self) -> dict[str, ca.Function]:
        """SX functions: map arguments, thermodynamics, and their Jacobians."""
        p, d, gas = self.p, self.design, self.gas
        xs, zs, us, aa, ts = (
            ca.SX.sym(n, m) for n, m in (("x", _NX), ("z", _NZ), ("u", _NU), ("a", _NA), ("t", _NT))
        )
        Xv, Z = X.unpack(xs), _Unknown(*ca.vertsplit(zs))
        Uv, H = U.unpack(us), THETA.unpack(ts)
        N, war = Xv["N"], Uv["war"]
        T0, P0, T1, P1 = ca.vertsplit(aa)
        amb = Ambient(T0=T0, P0=P0, V0=ca.SX(0), T1=T1, P1=P1)
        T2, P2 = inlet(T1=T1, P1=P1, dp_inlet=p.dp_inlet)
        T2d, P2d = d.values["T2"], d.values["P2"]
        # map arguments: corrected speeds and Reynolds number indices
        PR = ca.SX.sym("PR_c")
        n_c = N / ca.sqrt(T2 / T2d) / p.N
        n_t = N / ca.sqrt(Z.T41 / d.values["T41"]) / p.N
        RNI_c = reynolds_index(P=P2, T=T2, P_ref=P2d, T_ref=T2d)
        RNI_t = reynolds_index(
            P=P2 * PR * (1 - p.dp_burner), T=Z.T41, P_ref=d.values["P4"], T_ref=d.values["T41"]
        )
        # one pass through the stations, given the map values
        mc, mt = ca.SX.sym("mc", 4), ca.SX.sym("mt", 3)
        W_c, PR_c, eta_c, SM = ca.vertsplit(mc)
        W_t, PR_t, eta_t = ca.vertsplit(mt)
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
            p=p, gas=gas, amb=amb, war=war, Wf=Uv["Wf"], W2=W2, PR_c=PR_c,
            eta_c=eta_c * H["f_eta_c"], dp_burner=p.dp_burner * corrected_31**2, PR_t=PR_t,
            eta_t=eta_t * H["f_eta_t"], dp_exhaust=p.dp_exhaust * corrected_5**2, A3=d.A3, A8=d.A8,
            z=Z._asdict(),
        )  # fmt: skip
        capacity = W_t * H["f_W_t"]
        res = dict(st.res)
        res["turbine flow"] = st.y["W41"] * ca.sqrt(Z.T41) / st.y["P4"] / capacity - 1
        P_free = power_balance(
            P_turb=st.y["P_turb"], P_cpr=st.y["P_cpr"], eta_cpr=p.eta_cpr, P_acc=p.P_acc, PW=0.0
        )
        y = dict(st.y)
        y |= {"eta_c": eta_c * H["f_eta_c"], "eta_t": eta_t * H["f_eta_t"], "SM": SM}
        y |= {"SFC": Uv["Wf"] / (Uv["PW"] + p.P_acc), "P_acceleration": P_free - Uv["PW"]}
        y |= {"n_c": n_c, "n_t": n_t, "N": N, "PW": Uv["PW"], "Wf": Uv["Wf"]}
        # filled in where the spline is at hand
        y |= {"off_c": ca.SX(0), "off_t": ca.SX(0), "residual": ca.SX(0)}
        if tuple(res) != EQUATIONS:
            raise AssertionError(f"equations out of order: {tuple(res)}")
        inputs = [xs, zs, us, aa, ts, mc, mt]
        v = ca.vertcat(zs, xs, us, aa, ts)
        q = ca.vertcat(*res.values(), P_free)
        yv = Y.stack({k: y[k] for k in Y.names})

        def function(name: str, args: list[Any], out: list[Any]) -> ca.Function:
            return ca.Function(name, args, ca.cse(out))

        v_t = ca.vertcat(zs, xs, us, aa, ts)
        k_t = ca.vertcat(n_t, RNI_t)
        k_c = ca.vertcat(n_c, RNI_c)
        return {
            "k_c": function("k_c", [xs, aa], [k_c]),
            "dk_c": function("dk_c", [xs, zs, us, aa, ts], [ca.jacobian(k_c, v)]),
            "k_t": function("k_t", [xs, zs, aa, PR], [k_t]),
            "dk_t": function(
                "dk_t", [xs, zs, us, aa, ts, PR], [ca.jacobian(k_t, v_t), ca.jacobian(k_t, PR)]
            ),
            "q": function("q", inputs, [q]),
            "y": function("y", inputs, [yv]),
            "dq": function(
                "dq", inputs, [q, ca.jacobian(q, v), ca.jacobian(q, mc), ca.jacobian(q, mt)]
            ),
            "dy": function(
                "dy", inputs, [yv, ca.jacobian(yv, v), ca.jacobian(yv, mc), ca.jacobian(yv, mt)]
            ),
        }

    @cached_property
    def _map_functions(self) -> tuple[ca.Function, ca.Function]:
        """(n, beta, RNI) -> values (W, PR, eta[, SM]), their Jacobian, distance off the map."""
        out = []
        for m, name in ((self.cmap, "map_c"), (self.tmap, "map_t")):
            k = ca.MX.sym("k", 3)
            pt = m.lookup(k[0], k[1], k[2])
            values = [pt.W, pt.PR, pt.eta] + ([pt.SM] if pt.SM is not None else [])
            val = ca.vertcat(*values)
            out.append(ca.Function(name, [k], [val, ca.jacobian(val, k), pt.off]))
        return out[0], out[1]

    def assemble(
        self,
        x: Any,
        z: Any,
        u: Any,
        a: Any,
        theta: Any,
        *,
        outputs: bool = False,
        derivatives: bool = False,
    ) -> Assembled:
        """Write the cycle at a point in MX; ``a`` is ``ambient(u)``, held as separate input."""
        f = self._parts
        map_c, map_t = self._map_functions
        k_c = f["k_c"](x, a)
        mc, Jc, off_c = map_c(ca.vertcat(k_c[0], z[_BETA_C], k_c[1]))
        k_t = f["k_t"](x, z, a, mc[1])
        mt, Jt, off_t = map_t(ca.vertcat(k_t[0], z[_BETA_T], k_t[1]))
        point = (x, z, u, a, theta, mc, mt)
        dq = dy = None
        if derivatives:
            n_v = _NZ + _NX + _NU + _NA + _NT
            e_c, e_t = ca.DM(1, n_v), ca.DM(1, n_v)
            e_c[0, _BETA_C], e_t[0, _BETA_T] = 1, 1
            dk_c = f["dk_c"](x, z, u, a, theta)
            dmc = ca.mtimes(Jc, ca.vertcat(dk_c[0, :], ca.MX(e_c), dk_c[1, :]))
            dk_t, dk_t_PR = f["dk_t"](x, z, u, a, theta, mc[1])
            dk_t = dk_t + ca.mtimes(dk_t_PR, dmc[1, :])
            dmt = ca.mtimes(Jt, ca.vertcat(dk_t[0, :], ca.MX(e_t), dk_t[1, :]))
            q, q_v, q_mc, q_mt = f["dq"](*point)
            dq = q_v + ca.mtimes(q_mc, dmc) + ca.mtimes(q_mt, dmt)
        else:
            q = f["q"](*point)
        alg = q[:_NZ]
        y = None
        if outputs:
            if derivatives:
                y, y_v, y_mc, y_mt = f["dy"](*point)
                dy = y_v + ca.mtimes(y_mc, dmc) + ca.mtimes(y_mt, dmt)
            else:
                y = f["y"](*point)
            rows = ca.vertsplit(y)
            rows[Y.index("off_c")], rows[Y.index("off_t")] = off_c, off_t
            # 1-norm: fmax inside the max-norm would swallow NaN
            rows[Y.index("residual")] = ca.norm_1(alg)
            y = ca.vertcat(*rows)
        return Assembled(alg, q[_NZ], y, dq, dy)

    def symbols(self) -> tuple[ca.MX, ca.MX, ca.MX, ca.MX]:
        """Fresh MX symbols (x, z, u, theta)."""
        return (
            ca.MX.sym("x", _NX),
            ca.MX.sym("z", _NZ),
            ca.MX.sym("u", _NU),
            ca.MX.sym("theta", _NT),
        )

    @cached_property
    def equations(self) -> ca.Function:
        """The model: Function (x, z, u, theta) -> (ode, alg, y), from which all else is made."""
        x, z, u, theta = self.symbols()
        c = self.assemble(x, z, u, self.ambient(u), theta, outputs=True)
        ode = rotor_acceleration(P_acceleration=c.P_free - u[1], N=x, J=self.p.J)
        names = ["x", "z", "u", "theta"], ["ode", "alg", "y"]
        return ca.Function("gas_generator", [x, z, u, theta], [ode, c.alg, c.y], *names)

    @cached_property
    def solve(self) -> ca.Function:
        """Solve 0 = alg for z by Newton's method, as a differentiable CasADi function.

        Function (z0, x, u, theta) -> z.  Success is *not* reported inside larger expressions:
        every user re-evaluates the residual, which is why it is an output of the model.
        """
        x, z, u, theta = self.symbols()
        a = ca.MX.sym("a", _NA)
        plain = self.assemble(x, z, u, a, theta)
        exact = self.assemble(x, z, u, a, theta, derivatives=True)
        args = [z, x, u, a, theta]
        alg = ca.Function("alg", args, [plain.alg])
        J = ca.Function("alg_z", args, [exact.dq[:_NZ, COLUMNS.z], exact.alg])
        options = {
            # a hundredth of what is checked: Newton converges quadratically, so it ends far below
            "abstol": 1e-11,
            "abstolStep": 0.0,
            "max_iter": 20,
            "error_on_fail": False,
            "jacobian_function": J,
        }
        root = ca.rootfinder("gas_generator_z", "fast_newton", alg, options)
        z0 = ca.MX.sym("z0", _NZ)
        z1 = root(z0, x, u, self.ambient(u), theta)
        return ca.Function("solve_z", [z0, x, u, theta], [z1], ["z0", "x", "u", "theta"], ["z"])

    @cached_property
    def sensitivities(self) -> ca.Function:
        """Exact total derivatives at a solved point.

        Function (x, z, u, theta) -> (xdot, y, xdot_w, y_w, z_w) with w = (x, u, theta), by the
        implicit function theorem.  Rows off_c, off_t and residual of y_w are zero.
        """
        x, z, u, theta = self.symbols()
        us = ca.MX.sym("u", _NU)
        a_u = ca.Function("a_u", [us], [ca.jacobian(self.ambient(us), us)])(u)
        c = self.assemble(x, z, u, self.ambient(u), theta, outputs=True, derivatives=True)
        k = COLUMNS

        def columns(d: Any) -> Any:
            d_u = d[:, k.u] + ca.mtimes(d[:, k.a], a_u)
            return ca.horzcat(d[:, k.x], d_u, d[:, k.theta])

        alg_z = c.dq[:_NZ, k.z]
        z_w = -ca.solve(alg_z, columns(c.dq[:_NZ, :]))
        P_w = columns(c.dq[_NZ, :]) + ca.mtimes(c.dq[_NZ, k.z], z_w)
        load = ca.DM(1, _NX + _NU + _NT)
        load[0, _NX + 1] = 1
        P = c.P_free - u[1]
        N, J = x, self.p.J
        xdot = rotor_acceleration(P_acceleration=P, N=N, J=J)
        own = ca.DM(1, _NX + _NU + _NT)
        own[0, 0] = 1
        xdot_w = (P_w - load) / (J * N) - (xdot / N) * own
        y_w = columns(c.dy) + ca.mtimes(c.dy[:, k.z], z_w)
        return ca.Function(
            "sensitivities",
            [x, z, u, theta],
            [xdot, c.y, xdot_w, y_w, z_w],
            ["x", "z", "u", "theta"],
            ["xdot", "y", "xdot_w", "y_w", "z_w"],
        )

    @cached_property
    def dfdx(self) -> ca.Function:
        """Function (x, z, u, theta) -> (ode, d ode/dx along 0 = alg, 1-norm of alg, dz/dx)."""
        x, z, u, theta = self.symbols()
        c = self.assemble(x, z, u, self.ambient(u), theta, derivatives=True)
        alg, k = c.dq[:_NZ, :], COLUMNS
        z_x = -ca.solve(alg[:, k.z], alg[:, k.x])
        P_x = c.dq[_NZ, k.x] + ca.mtimes(c.dq[_NZ, k.z], z_x)
        J = self.p.J
        ode = rotor_acceleration(P_acceleration=c.P_free - u[1], N=x, J=J)
        return ca.Function(
            "dfdx", [x, z, u, theta], [ode, P_x / (J * x) - ode / x, ca.norm_1(c.alg), z_x]
        )

    @cached_property
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
