"""The cycle's signals, its unknowns with their equations, and one pass through the stations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import casadi as ca

from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.atmosphere import Ambient
from apu_casadi.gaspath.components.combustor import combustor, snox
from apu_casadi.gaspath.components.compressor import bleeds, compressor
from apu_casadi.gaspath.components.exhaust import exhaust, static_state
from apu_casadi.gaspath.components.inlet import inlet
from apu_casadi.gaspath.components.turbine import mix_cooling, turbine
from apu_casadi.gaspath.conditions import CONDITIONS
from apu_casadi.gaspath.designdata import GasGeneratorParameters
from apu_casadi.gaspath.gas import Gas
from apu_casadi.gaspath.health import HEALTH_FACTORS

# ------------------------------------------------------------------------------ signals

X = Signals([Signal("N", "rad/s", "rotor speed", nominal=3775.0)])
U = Signals(
    [
        Signal("Wf", "kg/s", "fuel flow", nominal=0.05),
        Signal("PW", "W", "shaft power to the load", nominal=5e5),
        *(
            Signal(n, c.unit, c.doc, default=c.default, nominal=c.nominal)
            for n, c in CONDITIONS.items()
        ),
    ]
)
THETA = Signals([Signal(n, "1", f.doc, default=1.0) for n, f in HEALTH_FACTORS.items()])

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

AMBIENT_STATE = ("T0", "P0", "T1", "P1")  # ambient quantities, computed once per set of inputs


# ------------------------------------------------------------------------------ unknowns


class Unknown(NamedTuple):
    """An algebraic unknown of the cycle.

    Equation k determines temperature k from those before it and from the map coordinates; the last
    two equations are left for the coordinates.

    Args:
        name, doc: symbol and meaning.
        equation: the residual that it is sought with.
        follows: station whose temperature a first guess is proportional to, 3 or 4; 0 for a
            coordinate, which stays where the design point has it.
        share: of that temperature, from which the design point's search starts.
        nominal: typical magnitude.
    """

    name: str
    doc: str
    equation: str
    follows: int
    share: float
    nominal: float

    @property
    def signal(self) -> Signal:
        """The unknown as a signal."""
        return Signal(self.name, "K" if self.follows else "1", self.doc, nominal=self.nominal)


UNKNOWNS = (
    Unknown(
        "T3s", "isentropic compressor outlet temperature", "compressor isentrope", 3, 1.0, 500.0
    ),
    Unknown("T3", "compressor outlet temperature", "compressor efficiency", 3, 1.0, 500.0),
    Unknown("T4", "combustor outlet temperature", "burner energy", 4, 1.0, 1000.0),
    Unknown("T41", "rotor inlet temperature", "vane cooling energy", 4, 1.0, 1000.0),
    Unknown("T5s", "isentropic rotor exit temperature", "turbine isentrope", 4, 0.65, 700.0),
    Unknown("T50", "rotor exit temperature", "turbine efficiency", 4, 0.65, 700.0),
    Unknown("T5", "turbine outlet temperature", "rotor cooling energy", 4, 0.65, 700.0),
    Unknown("Ts8", "exhaust exit static temperature", "exhaust isentrope", 4, 0.637, 700.0),
    Unknown("Ts3", "compressor outlet static temperature", "static state 3", 3, 0.985, 500.0),
    Unknown("beta_c", "compressor map coordinate", "exit flow", 0, 1.0, 1.0),
    Unknown("beta_t", "turbine map coordinate", "turbine flow", 0, 1.0, 1.0),
)
Z = Signals([k.signal for k in UNKNOWNS])
TEMPERATURES = tuple(k.name for k in UNKNOWNS if k.follows)
EQUATIONS = tuple(k.equation for k in UNKNOWNS)


def viscosity(T: Any) -> Any:
    """Viscosity of air over a constant, T in K.

    Sutherland's law with 110.4 K (U.S. Standard Atmosphere 1976).
    """
    return T**1.5 / (T + 110.4)


def reynolds_index(*, P: Any, T: Any, T_ref: Any, per_ref: Any) -> Any:
    """Reynolds number index P/(sqrt(T) viscosity(T)) over its reference; 1 at the reference.

    ``per_ref`` is viscosity(T_ref)/P_ref.
    """
    return P * per_ref * ca.sqrt(T_ref / T) / viscosity(T)


class Pass(NamedTuple):
    """Station values and residuals of one pass, by name, before the maps close the system."""

    y: dict[str, Any]
    res: dict[str, Any]


def stations(
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
) -> Pass:
    """Pass through the components from 1 to 8; used by design and off-design alike.

    ``PR_t=None`` is the design calculation: the turbine expands to the exit pressure ratio NPR.
    """
    wet: dict[str, Any] = {"war": war, "gas": gas}
    T2, P2 = inlet(T1=amb.T1, P1=amb.P1, dp_inlet=p.dp_inlet)
    T3, T4, T41, T50, T5 = (z[n] for n in ("T3", "T4", "T41", "T50", "T5"))
    c = compressor(T2=T2, P2=P2, W2=W2, PR=PR_c, eta=eta_c, T3s=z["T3s"], T3=T3, **wet)
    b = bleeds(W3=W2, overboard=p.bleed_overboard, ngv=p.cool_ngv, rotor=p.cool_rotor)
    s3 = static_state(T=T3, P=c.P3, W=W2, Ts=z["Ts3"], A=A3, FAR=0.0, **wet)
    loss = {"dp_burner": dp_burner, "eta_burner": p.eta_burner, "LHV": p.LHV}
    burner = combustor(T31=T3, P31=c.P3, W31=b.W31, Wf=Wf, T4=T4, **loss, **wet)
    main = {"T": T4, "W": burner.W4, "FAR": burner.FAR4}
    vane = mix_cooling(**main, T_cool=T3, W_cool=b.W_ngv, T_mix=T41, **wet)
    if PR_t is None:
        PR_t = burner.P4 * (1 - dp_exhaust) / (p.NPR * amb.P0)
    inflow = {"T41": T41, "P4": burner.P4, "W41": vane.W, "FAR41": vane.FAR}
    t = turbine(**inflow, PR=PR_t, eta=eta_t, T5s=z["T5s"], T50=T50, **wet)
    main = {"T": T50, "W": vane.W, "FAR": vane.FAR}
    rotor = mix_cooling(**main, T_cool=T3, W_cool=b.W_rotor, T_mix=T5, **wet)
    outflow = {"T5": T5, "P5": t.P5, "W5": rotor.W, "FAR": rotor.FAR}
    e = exhaust(**outflow, P0=amb.P0, Ts8=z["Ts8"], A8=A8, dp_exhaust=dp_exhaust, **wet)
    y = {"T0": amb.T0, "P0": amb.P0, "T1": amb.T1, "P1": amb.P1, "T2": T2, "P2": P2, "W2": W2}
    y |= {"T3": T3, "P3": c.P3, "Ps3": s3.Ps, "W3": W2, "W31": b.W31, "P_cpr": c.P_cpr}
    y |= {"T4": T4, "P4": burner.P4, "W4": burner.W4, "FAR4": burner.FAR4}
    y |= {"T41": T41, "W41": vane.W, "T50": T50, "P_turb": t.P_turb}
    y |= {"T5": T5, "P5": t.P5, "W5": rotor.W, "T8": T5, "P8": e.P8, "W8": rotor.W}
    y |= {"Mach8": e.Mach8, "V8": e.V8, "PR_c": PR_c, "PR_t": PR_t}
    y["SNOx"] = snox(T3=T3, P3=c.P3, war=war)
    res = {
        "compressor isentrope": c.res_isentropic,
        "compressor efficiency": c.res_efficiency,
        "burner energy": burner.res_energy,
        "vane cooling energy": vane.res_energy,
        "turbine isentrope": t.res_isentropic,
        "turbine efficiency": t.res_efficiency,
        "rotor cooling energy": rotor.res_energy,
        "exhaust isentrope": e.res_isentropic,
        "static state 3": s3.res_flow,
        "exit flow": e.res_flow,
    }
    return Pass(y, res)
