"""The gas generator: a single-shaft turboshaft engine, stations 0-1-2-3-31-4-41-5-6-8.

Paper, section 5, Fig. 8 and Tables 2-5.  Written once as residual equations; the design point
fixes areas and map scales, off design everything follows from the residuals.

Rotor speed is the one state.  The improved method of the paper (IGDM, Algorithm 2, eq. 12) is
:meth:`GasGenerator.initialise`, :meth:`~GasGenerator.state_update` and
:meth:`~GasGenerator.output`, with a hook between the last two in :meth:`~GasGenerator.run`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.atmosphere import ALTITUDE_RANGE, Ambient, ambient
from apu_casadi.components.combustor import combustor, snox
from apu_casadi.components.compressor import bleeds, compressor
from apu_casadi.components.exhaust import exhaust, static_state
from apu_casadi.components.inlet import inlet
from apu_casadi.components.shaft import power_balance, rotor_acceleration
from apu_casadi.components.turbine import mix_cooling, turbine
from apu_casadi.discretisation import linearly_implicit_midpoint
from apu_casadi.errors import OperatingPointError, SimulationError
from apu_casadi.gas import Gas
from apu_casadi.mapfiles import MapTable, shipped
from apu_casadi.maps import MapCalibration, ScaledMap
from apu_casadi.parameters import Parameters, par
from apu_casadi.rootfinding import Newton
from apu_casadi.signals import Signal, Signals
from apu_casadi.statespace import StateSpace

RPM = math.pi / 30.0  # rad/s per r/min
RESIDUAL_TOL = 1e-9  # largest residual (dimensionless) with which any result is used


@dataclass(frozen=True)
class GasGeneratorParameters(Parameters):
    """Design data of the gas generator (paper, Tables 3 and 4)."""

    altitude: float = par(0.0, unit="m", source="Table 3", doc="design altitude", lo=-1e3, hi=15e3)
    Mach: float = par(0.0, unit="1", source="Table 3", doc="design flight Mach number", lo=0, hi=1)
    dT_isa: float = par(5.0, unit="K", source="Table 3", doc="design ISA deviation", lo=-80, hi=80)
    war: float = par(0.0, unit="kg/kg", source="Table 4 (SNOx)", doc="design humidity", lo=0, hi=0.1)
    N: float = par(36050.0 * RPM, unit="rad/s", source="Table 3", doc="design rotor speed", lo=1)
    W2: float = par(
        3.1442, unit="kg/s", source="Table 4; Table 3's corrected flow contradicts it",
        doc="design compressor inlet flow", lo=1e-3,
    )  # fmt: skip
    PR_c: float = par(8.0, unit="1", source="Table 3", doc="compressor pressure ratio", lo=1.5, hi=60)
    eta_c: float = par(0.85, unit="1", source="Table 3", doc="compressor efficiency", lo=0.3, hi=1)
    T4: float = par(1200.114, unit="K", source="Table 4", doc="burner exit temperature", lo=600, hi=2200)
    eta_t: float = par(0.89, unit="1", source="Table 3", doc="turbine efficiency", lo=0.3, hi=1)
    dp_inlet: float = par(0.01, unit="1", source="Table 4, 1 - P2/P1", doc="inlet loss", lo=0, hi=0.5)
    dp_burner: float = par(0.03, unit="1", source="Table 4, 1 - P4/P3", doc="burner loss", lo=0, hi=0.5)
    dp_exhaust: float = par(
        0.02, unit="1", source="Table 4, 1 - P8/P5", doc="exhaust duct loss", lo=0, hi=0.5
    )
    NPR: float = par(1.03, unit="1", source="Table 4, P8/P0", doc="exit pressure ratio", lo=1.001, hi=1.8)
    bleed_overboard: float = par(0.01, unit="1", source="Table 4 flows", doc="of W2, lost", lo=0, hi=0.3)
    cool_ngv: float = par(0.05, unit="1", source="Table 4 flows", doc="of W2, vane cooling", lo=0, hi=0.3)
    cool_rotor: float = par(0.05, unit="1", source="Table 4 flows", doc="of W2, rotor cooling", lo=0, hi=0.3)
    eta_burner: float = par(1.0, unit="1", source="Table 4, T4", doc="burner efficiency", lo=0.5, hi=1)
    LHV: float = par(43.124e6, unit="J/kg", source="Table 3", doc="lower heating value", lo=1e6)
    x_HC: float = par(1.9185, unit="1", source="kerosene; FACTS 1", doc="hydrogen per carbon", lo=0, hi=4)
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
        source="assumed: 0.4 s from rest to design power per unit speed, with both generators",
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


class _Cycle(NamedTuple):
    """Everything that one pass through the stations yields."""

    y: dict[str, Any]
    res: dict[str, Any]
    P_acceleration: Any


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
    s3 = static_state(
        T=z["T3"], P=c.P3, W=W2, Ts=z["Ts3"], A=A3, FAR=0.0, war=war, gas=gas
    )
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


_X = Signals([Signal("N", "rad/s", "rotor speed", nominal=3775.0)])
_U = Signals(
    [
        Signal("Wf", "kg/s", "fuel flow", nominal=0.05),
        Signal("PW", "W", "shaft power to the load", nominal=5e5),
        Signal("altitude", "m", "geopotential altitude", default=0.0, nominal=1e4),
        Signal("Mach", "1", "flight Mach number", default=0.0),
        Signal("dT_isa", "K", "deviation from ISA", default=0.0, nominal=30.0),
        Signal("war", "kg/kg", "water per dry air", default=0.0, nominal=0.01),
    ]
)
_THETA = Signals(
    [
        Signal("f_eta_c", "1", "compressor efficiency factor", default=1.0),
        Signal("f_W_c", "1", "compressor flow factor", default=1.0),
        Signal("f_eta_t", "1", "turbine efficiency factor", default=1.0),
        Signal("f_W_t", "1", "turbine flow factor", default=1.0),
    ]
)
HEALTH = _THETA.names

_Y = Signals(
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
        Signal("T50", "K", "rotor exit total temperature, before rotor cooling mixes", nominal=750.0),
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


@dataclass(frozen=True)
class MapChoice:
    """A map shape and where on it the design point lies.

    Parameters
    ----------
    table : the map (:func:`apu_casadi.mapfiles.read_map` reads CSV, GasTurb and GSP layouts).
    N_map_des, beta_des : speed and beta of the table at which the design point is put.
    calibration : the few calibrated numbers; identity by default.
    """

    table: MapTable
    N_map_des: float
    beta_des: float
    calibration: MapCalibration = field(default_factory=MapCalibration)

    def scaled(self, *, W: float, PR: float, eta: float) -> ScaledMap:
        """Return the map scaled so that its design location has these values."""
        return ScaledMap(
            table=self.table,
            N_map_des=self.N_map_des,
            beta_des=self.beta_des,
            W_des=W,
            PR_des=PR,
            eta_des=eta,
            cal=self.calibration,
        )


# CALIBRATED, not predicted: four numbers for the compressor, two for the turbine, fitted to the
# rows W2, T3, P3, T5 and HPCSM of Table 5 and HPCSM of Table 4; all other rows of Table 5 are left
# for checking.  The Reynolds exponent 0.18 lies in the range 0.1-0.2 known for small compressors.
COMPRESSOR_CALIBRATION = MapCalibration(
    a_W=0.03985831, n_Re=0.17623167, k_SM=1.02900434, a_SM=1.0746332
)
TURBINE_CALIBRATION = MapCalibration(a_W=0.07937522, c_PR=0.31182386)


def default_compressor() -> MapChoice:
    """AXI5 shape; calibrated to the paper's Tables 4 and 5 (see ``COMPRESSOR_CALIBRATION``)."""
    return MapChoice(shipped("axi5"), 1.0, 2.0, COMPRESSOR_CALIBRATION)


def default_turbine() -> MapChoice:
    """LPT2269 shape; calibrated to the paper's Table 5 (see ``TURBINE_CALIBRATION``).

    Its design point is put at the table's pressure ratio 5.5 rather than 6.0, so that Table 5,
    1.38 times the design pressure ratio, lies inside the table.
    """
    return MapChoice(shipped("lpt2269"), 100.0, 0.5, TURBINE_CALIBRATION)


@dataclass(frozen=True)
class GasGeneratorState:
    """State, algebraic unknowns, inputs and health at one instant, as packed vectors."""

    x: np.ndarray
    z: np.ndarray
    u: np.ndarray
    theta: np.ndarray


@dataclass(frozen=True)
class GasGenerator:
    """A gas generator: parameters and two maps; everything else is derived.

    Parameters
    ----------
    parameters : design data.
    compressor_map, turbine_map : map shapes, scaled to the design point here.
    dt : default step of the discrete model, s (paper, section 3.3: 20 ms).
    """

    parameters: GasGeneratorParameters = field(default_factory=GasGeneratorParameters)
    compressor_map: MapChoice = field(default_factory=default_compressor)
    turbine_map: MapChoice = field(default_factory=default_turbine)
    dt: float = 0.02

    X: ClassVar[Signals] = _X
    U: ClassVar[Signals] = _U
    THETA: ClassVar[Signals] = _THETA
    Y: ClassVar[Signals] = _Y

    # ------------------------------------------------------------------ design point

    @cached_property
    def gas(self) -> Gas:
        """The working gas."""
        return Gas(self.parameters.x_HC, self.parameters.gas_data)

    @cached_property
    def design(self) -> DesignPoint:
        """Solve the design point from the parameters alone (no map enters).

        Raises
        ------
        OperatingPointError : the design data admit no solution; names the worst equation.
        """
        p, gas = self.parameters, self.gas
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

    @cached_property
    def maps(self) -> tuple[ScaledMap, ScaledMap]:
        """The compressor and turbine maps scaled to the design point.

        The compressor's flow is that at the design inlet state, kg/s; the turbine's is
        W41 sqrt(T41)/P4.
        """
        p, d = self.parameters, self.design
        return (
            self.compressor_map.scaled(W=p.W2, PR=p.PR_c, eta=p.eta_c),
            self.turbine_map.scaled(W=d.W_t, PR=d.PR_t, eta=p.eta_t),
        )

    # ------------------------------------------------------------------ equations

    def _cycle(self, x: Any, z: Any, u: Any, theta: Any) -> _Cycle:
        """Write the off-design equations with MX symbols; thermodynamics as one SX function."""
        p, d, gas = self.parameters, self.design, self.gas
        cmap, tmap = self.maps
        xs, zs, us, ts = (ca.SX.sym(n, m) for n, m in (("x", 1), ("z", 11), ("u", 6), ("t", 4)))
        X, Z = _X.unpack(xs), _Unknown(*ca.vertsplit(zs))
        U, H = _U.unpack(us), _THETA.unpack(ts)
        N, war = X["N"], U["war"]
        amb = ambient(
            altitude=U["altitude"], Mach=U["Mach"], dT_isa=U["dT_isa"], war=war, gas=gas
        )
        T2, P2 = inlet(T1=amb.T1, P1=amb.P1, dp_inlet=p.dp_inlet)
        T2d, P2d = d.values["T2"], d.values["P2"]
        T41d, P4d, FAR41d = d.values["T41"], d.values["P4"], d.values["FAR41"]
        P3_over_P2 = ca.SX.sym("PR_c")
        # map arguments: corrected speeds, map coordinates, Reynolds number indices
        n_c = N / ca.sqrt(T2 / T2d) / p.N
        n_t = N / ca.sqrt(Z.T41 / T41d) / p.N
        RNI_c = reynolds_index(P=P2, T=T2, P_ref=P2d, T_ref=T2d)
        P4_guess = P2 * P3_over_P2 * (1 - p.dp_burner)
        RNI_t = reynolds_index(P=P4_guess, T=Z.T41, P_ref=P4d, T_ref=T41d)
        arg_c = ca.Function("arg_c", [xs, us], [n_c, RNI_c])
        arg_t = ca.Function("arg_t", [xs, zs, us, P3_over_P2], [n_t, RNI_t])
        # one pass through the stations, given the map values
        mc, mt = ca.SX.sym("mc", 3), ca.SX.sym("mt", 3)
        W_c, PR_c, eta_c = ca.vertsplit(mc)
        W_t, PR_t, eta_t = ca.vertsplit(mt)
        W2 = W_c * H["f_W_c"] * (P2 / P2d) / ca.sqrt(T2 / T2d)
        corrected_31 = (W2 * ca.sqrt(Z.T3) / (P2 * PR_c)) / (
            p.W2 * math.sqrt(d.z["T3"]) / (P2d * p.PR_c)
        )
        W5d, T5d, P5d = d.values["W5"], d.values["T5"], d.values["P5"]
        P4 = P2 * PR_c * (1 - p.dp_burner * corrected_31**2)
        W5 = W2 * (1 - p.bleed_overboard) + U["Wf"]
        corrected_5 = (W5 * ca.sqrt(Z.T5) / (P4 / PR_t)) / (W5d * math.sqrt(T5d) / P5d)
        st = _stations(
            p=p, gas=gas, amb=amb, war=war, Wf=U["Wf"], W2=W2, PR_c=PR_c,
            eta_c=eta_c * H["f_eta_c"], dp_burner=p.dp_burner * corrected_31**2, PR_t=PR_t,
            eta_t=eta_t * H["f_eta_t"], dp_exhaust=p.dp_exhaust * corrected_5**2, A3=d.A3, A8=d.A8,
            z=Z._asdict(),
        )  # fmt: skip
        res = dict(st.res)
        capacity = W_t * H["f_W_t"]
        res["turbine flow"] = st.y["W41"] * ca.sqrt(Z.T41) / st.y["P4"] / capacity - 1
        P_acceleration = power_balance(
            P_turb=st.y["P_turb"], P_cpr=st.y["P_cpr"], eta_cpr=p.eta_cpr, P_acc=p.P_acc,
            PW=U["PW"],
        )  # fmt: skip
        y = dict(st.y)
        y["eta_c"], y["eta_t"] = eta_c * H["f_eta_c"], eta_t * H["f_eta_t"]
        y["SFC"] = U["Wf"] / (U["PW"] + p.P_acc)
        y["P_acceleration"] = P_acceleration
        y["n_c"], y["n_t"] = n_c, n_t
        keys = list(y)
        thermo = ca.Function(
            "thermo",
            [xs, zs, us, ts, mc, mt],
            [ca.vertcat(*res.values()), P_acceleration, ca.vertcat(*(y[k] for k in keys))],
        )
        # maps enter as splines, hence MX
        Zm = _Unknown(*ca.vertsplit(z))
        n_c_, RNI_c_ = arg_c(x, u)
        pc = cmap.lookup(n_c_, Zm.beta_c, RNI_c_)
        n_t_, RNI_t_ = arg_t(x, z, u, pc.PR)
        pt = tmap.lookup(n_t_, Zm.beta_t, RNI_t_)
        r, Pa, yv = thermo(
            x, z, u, theta, ca.vertcat(pc.W, pc.PR, pc.eta), ca.vertcat(pt.W, pt.PR, pt.eta)
        )
        values = dict(zip(keys, ca.vertsplit(yv), strict=True))
        values |= {"N": x, "PW": u[1], "Wf": u[0], "SM": pc.SM, "off_c": pc.off, "off_t": pt.off}
        # 1-norm: fmax inside the max-norm would swallow NaN
        values["residual"] = ca.norm_1(r)
        names = list(res)
        return _Cycle(values, {n: r[i] for i, n in enumerate(names)}, Pa)

    @cached_property
    def equations(self) -> ca.Function:
        """The model: Function (x, z, u, theta) -> (ode, alg, y), from which all else is made."""
        x, z = ca.MX.sym("x", len(_X)), ca.MX.sym("z", len(self.z))
        u, theta = ca.MX.sym("u", len(_U)), ca.MX.sym("theta", len(_THETA))
        c = self._cycle(x, z, u, theta)
        ode = rotor_acceleration(P_acceleration=c.P_acceleration, N=x, J=self.parameters.J)
        y = _Y.stack({k: c.y[k] for k in _Y.names})
        return ca.Function(
            "gas_generator",
            [x, z, u, theta],
            [ode, ca.vertcat(*c.res.values()), y],
            ["x", "z", "u", "theta"],
            ["ode", "alg", "y"],
        )

    @cached_property
    def equation_names(self) -> tuple[str, ...]:
        """What each row of the algebraic residual states."""
        x, z = ca.MX.sym("x", len(_X)), ca.MX.sym("z", len(self.z))
        u, theta = ca.MX.sym("u", len(_U)), ca.MX.sym("theta", len(_THETA))
        return tuple(self._cycle(x, z, u, theta).res)

    @cached_property
    def z(self) -> Signals:
        """The algebraic unknowns, with design values as magnitudes."""
        d = self.design
        cmap, tmap = self.compressor_map, self.turbine_map
        span_c = float(np.ptp(cmap.table.beta))
        span_t = float(np.ptp(tmap.table.beta))
        docs = {
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
        temperatures = [Signal(n, "K", doc, nominal=d.z[n]) for n, doc in docs.items()]
        return Signals(
            [
                *temperatures,
                Signal("beta_c", "1", "compressor map coordinate", nominal=span_c),
                Signal("beta_t", "1", "turbine map coordinate", nominal=span_t),
            ]
        )

    def similar(self, x: Any, u: Any) -> Any:
        """First guess of z from the design point by similarity; an expression in x and u.

        Corrected quantities are kept, pressure ratio and fuel scaled with corrected speed and
        fuel-air ratio; close enough for Newton's method over the flight envelope.
        """
        d, p = self.design, self.parameters
        xs, us = ca.SX.sym("x", 1), ca.SX.sym("u", 6)
        U = _U.unpack(us)
        amb = ambient(
            altitude=U["altitude"], Mach=U["Mach"], dT_isa=U["dT_isa"], war=U["war"], gas=self.gas
        )
        T2, P2 = inlet(T1=amb.T1, P1=amb.P1, dp_inlet=p.dp_inlet)
        t = T2 / d.values["T2"]
        n = xs / p.N / ca.sqrt(t)
        T3 = T2 * (1 + (d.z["T3"] / d.values["T2"] - 1) * n**2)
        W = p.W2 * (P2 / d.values["P2"]) / ca.sqrt(t) * n
        T4 = T3 + (p.T4 - d.z["T3"]) * (U["Wf"] / W) / (d.values["Wf"] / p.W2)
        hot = T4 / p.T4
        z = _Unknown(
            T3s=T3 * d.z["T3s"] / d.z["T3"],
            T3=T3,
            T4=T4,
            T41=hot * d.z["T41"],
            T5s=hot * d.z["T5s"],
            T50=hot * d.z["T50"],
            T5=hot * d.z["T5"],
            Ts8=hot * d.z["Ts8"],
            Ts3=T3 * d.z["Ts3"] / d.z["T3"],
            beta_c=self.compressor_map.beta_des,
            beta_t=self.turbine_map.beta_des,
        )
        return ca.Function("similar", [xs, us], [ca.vertcat(*z)])(x, u)

    @cached_property
    def solve(self) -> ca.Function:
        """Solve 0 = alg for z by Newton's method, as a differentiable CasADi function.

        Function (z0, x, u, theta) -> z.  Success is *not* reported inside larger expressions:
        every user re-evaluates the residual, which is why it is an output of the model.
        """
        x, z = ca.MX.sym("x", len(_X)), ca.MX.sym("z", len(self.z))
        u, theta = ca.MX.sym("u", len(_U)), ca.MX.sym("theta", len(_THETA))
        _, alg, _ = self.equations(x, z, u, theta)
        alg_fun = ca.Function("alg", [z, x, u, theta], [alg])
        options = {"abstol": 1e-12, "abstolStep": 1e-12, "max_iter": 20, "error_on_fail": False}
        return ca.rootfinder("gas_generator_z", "fast_newton", alg_fun, options)

    @cached_property
    def state_space(self) -> StateSpace:
        """The continuous model as :class:`StateSpace`; z is started by similarity."""
        x, z = ca.MX.sym("x", len(_X)), ca.MX.sym("z", len(self.z))
        u, theta = ca.MX.sym("u", len(_U)), ca.MX.sym("theta", len(_THETA))
        args, names = [x, u, theta], ["x", "u", "theta"]
        ode, alg, _ = self.equations(x, z, u, theta)
        z_sol = self.solve(self.similar(x, u), x, u, theta)
        f, _, g = self.equations(x, z_sol, u, theta)
        return StateSpace(
            name="gas_generator",
            x=_X,
            z=self.z,
            u=_U,
            theta=_THETA,
            y=_Y,
            residual=ca.Function(
                "residual", [x, z, u, theta], [ode, alg], ["x", "z", "u", "theta"], ["ode", "alg"]
            ),
            f=ca.Function("f", args, [f], names, ["xdot"]),
            g=ca.Function("g", args, [g], names, ["y"]),
            z_of=ca.Function("z_of", args, [z_sol], names, ["z"]),
        )

    # ------------------------------------------------------------------ discrete model (eq. 12)

    @cached_property
    def f(self) -> ca.Function:
        """State update of eq. (12): (x, u, theta, dt, z0) -> (x1, z, residual).

        ``x1 = f(x(k-1), u(k), theta(k), Pe(k))`` with Pe = ``u.PW``, by the linearly implicit
        midpoint rule.  ``z0`` starts the root finder; z and its re-evaluated residual come back.
        """
        x, z0 = ca.MX.sym("x", len(_X)), ca.MX.sym("z0", len(self.z))
        u, theta = ca.MX.sym("u", len(_U)), ca.MX.sym("theta", len(_THETA))
        dt = ca.MX.sym("dt")
        z = self.solve(z0, x, u, theta)
        ode, alg, _ = self.equations(x, z, u, theta)
        A = self._dfdx(x, z, u, theta)
        x1 = linearly_implicit_midpoint(x, ode, A, dt)
        return ca.Function(
            "gas_generator_f",
            [x, u, theta, dt, z0],
            [x1, z, ca.norm_1(alg)],
            ["x", "u", "theta", "dt", "z0"],
            ["x1", "z", "residual"],
        )

    @cached_property
    def _dfdx(self) -> ca.Function:
        """Total derivative d ode/dx along 0 = alg, at a solved point."""
        x, z = ca.MX.sym("x", len(_X)), ca.MX.sym("z", len(self.z))
        u, theta = ca.MX.sym("u", len(_U)), ca.MX.sym("theta", len(_THETA))
        ode, alg, _ = self.equations(x, z, u, theta)
        dz = -ca.solve(ca.jacobian(alg, z), ca.jacobian(alg, x))
        A = ca.jacobian(ode, x) + ca.mtimes(ca.jacobian(ode, z), dz)
        return ca.Function("dfdx", [x, z, u, theta], [A])

    @cached_property
    def g(self) -> ca.Function:
        """Output of eq. (12): (x, u, theta, z0) -> (y, z); y holds the residual."""
        x, z0 = ca.MX.sym("x", len(_X)), ca.MX.sym("z0", len(self.z))
        u, theta = ca.MX.sym("u", len(_U)), ca.MX.sym("theta", len(_THETA))
        z = self.solve(z0, x, u, theta)
        _, _, y = self.equations(x, z, u, theta)
        return ca.Function(
            "gas_generator_g", [x, u, theta, z0], [y, z], ["x", "u", "theta", "z0"], ["y", "z"]
        )

    # ------------------------------------------------------------------ IGDM (Algorithm 2)

    def check_inputs(self, u: np.ndarray) -> None:
        """Refuse inputs outside what the model is meant for, naming each with its range.

        Raises
        ------
        OperatingPointError : fuel flow not positive or beyond stoichiometric, altitude, Mach
            number, ISA deviation or humidity out of range.
        """
        v = _U.unpack(np.asarray(u, float))
        ranges = {
            "Wf": (1e-6, self.gas.FAR_stoichiometric * 0.89 * self.parameters.W2 * 3),
            "altitude": ALTITUDE_RANGE,
            "Mach": (0.0, 0.95),
            "dT_isa": (-60.0, 60.0),
            "war": (0.0, 0.1),
        }
        for name, (lo, hi) in ranges.items():
            if not np.all((v[name] >= lo) & (v[name] <= hi)):
                worst = np.ravel(v[name])[np.argmax(np.abs(np.ravel(v[name]) - (lo + hi) / 2))]
                raise OperatingPointError(
                    f"{name} = {worst:g} {_U[name].unit} is outside [{lo:g}, {hi:g}]"
                )

    def initialise(
        self, *, N: float, PW: float, theta: Mapping[str, float] | None = None, **ambient: float
    ) -> GasGeneratorState:
        """Solve the steady start (TransitionInitialize_I): which fuel flow holds N against PW?

        Raises
        ------
        OperatingPointError : no such steady point.
        """
        from apu_casadi.trimming import trim_gas_generator

        point = trim_gas_generator(self, {"N": N, "PW": PW}, theta=theta, **ambient)
        return GasGeneratorState(point.x, point.z, point.u, point.theta)

    def state_update(
        self,
        x: np.ndarray,
        u: np.ndarray,
        theta: np.ndarray,
        *,
        z0: np.ndarray | None = None,
        dt: float | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """x(k) = f(x(k-1), u(k), theta(k), Pe(k)) (TransitionStateUpdate_I); returns (x, z).

        Raises
        ------
        SimulationError : the cycle could not be solved; names the residual.
        """
        start = self.similar(ca.DM(x), ca.DM(u)) if z0 is None else z0
        x1, z, r = self.f(x, u, theta, self.dt if dt is None else dt, start)
        self._check(float(r), x, u, theta, "state update")
        return np.asarray(x1).ravel(), np.asarray(z).ravel()

    def output(
        self, x: np.ndarray, u: np.ndarray, theta: np.ndarray, *, z0: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """y(k) = g(x(k), u(k), theta(k), Pe(k)) (TransitionOutput_I); returns (y, z).

        Raises
        ------
        SimulationError : the cycle could not be solved, or the exhaust is choked.
        """
        start = self.similar(ca.DM(x), ca.DM(u)) if z0 is None else z0
        y, z = self.g(x, u, theta, start)
        y = np.asarray(y).ravel()
        self._check(float(y[_Y.index("residual")]), x, u, theta, "output")
        if y[_Y.index("Mach8")] > 1.0:
            raise SimulationError(
                f"exhaust exit choked (Mach {y[_Y.index('Mach8')]:.3f}); the fixed exit is "
                f"modelled subsonic only"
            )
        return y, np.asarray(z).ravel()

    def _check(
        self, r: float, x: np.ndarray, u: np.ndarray, theta: np.ndarray, where: str
    ) -> None:
        if r <= RESIDUAL_TOL:
            return
        at = ", ".join(
            f"{k} = {v:.6g}"
            for k, v in {**_X.unpack(x), **_U.unpack(u), **_THETA.unpack(theta)}.items()
        )
        raise SimulationError(
            f"gas generator {where}: residual {r:.1e} > {RESIDUAL_TOL:.0e} at {at}; the point is "
            f"probably beyond surge or off the maps, or the step is too large"
        )

    def run(
        self,
        start: GasGeneratorState,
        inputs: np.ndarray,
        theta: np.ndarray | None = None,
        *,
        hook: Callable[[int, np.ndarray], np.ndarray] | None = None,
        output_noise: Callable[[int], np.ndarray] | None = None,
        dt: float | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Run Algorithm 2: update the state, let ``hook`` process it, compute the output.

        Parameters
        ----------
        start : from :meth:`initialise`.
        inputs : u at t_1 ... t_K, shape (6, K), columns packed by ``U``.
        theta : health factors, shape (4,) or (4, K); those of ``start`` by default.
        hook : ``StateProcess``: (k, x(k)) -> x(k); state noise, Monte Carlo, an estimator.
        output_noise : k -> v(k), shape (ny,), added to y.
        dt : step, s.

        Returns
        -------
        x of shape (1, K+1) and y of shape (ny, K+1), the start included.
        """
        inputs = np.asarray(inputs, float)
        if inputs.ndim != 2 or inputs.shape[0] != len(_U):
            raise SimulationError(f"inputs: shape ({len(_U)}, K) expected, got {inputs.shape}")
        K = inputs.shape[1]
        th = start.theta if theta is None else np.asarray(theta, float)
        th = np.broadcast_to(th.reshape(len(_THETA), -1), (len(_THETA), K))
        x, z = start.x, start.z
        y, z = self.output(x, start.u, start.theta, z0=z)
        X, Y = [x], [y]
        for k in range(1, K + 1):
            u, t = inputs[:, k - 1], th[:, k - 1]
            x, z = self.state_update(x, u, t, z0=z, dt=dt)
            if hook is not None:
                x = np.asarray(hook(k, x), float).reshape(len(_X))
            y, z = self.output(x, u, t, z0=z)
            if output_noise is not None:
                y = y + output_noise(k)
            X.append(x)
            Y.append(y)
        return np.array(X).T, np.array(Y).T

