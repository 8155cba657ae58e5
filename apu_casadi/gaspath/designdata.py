"""Design data of the gas generator: every number with its unit, origin and range."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from apu_casadi.core.parameters import Parameters, par
from apu_casadi.gaspath.conditions import CONDITIONS

RPM = math.pi / 30.0  # rad/s per r/min

_W2 = "Table 4; Table 3's corrected flow contradicts it"
_POWER = "Table 4, power closure"
_AREA_3 = "Table 4, fixes the area at 3"
_J = "assumed: 356 kJ at design speed, 0.7 s of design power; generators included"


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
    W2: float = par(3.1442, unit="kg/s", source=_W2, doc="design compressor inlet flow", lo=1e-3)
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
        1.0, unit="1", source=_POWER, doc="power transfer to the compressor", lo=0.5, hi=1
    )
    P_acc: float = par(30e3, unit="W", source="Table 3", doc="accessory power", lo=0)
    gas_data: str = "nasa7"  # the data behind the paper's tables; "nasa9" for newer physics
    Ps3_P3: float = par(
        0.95742, unit="1", source=_AREA_3, doc="static over total pressure", lo=0.6, hi=0.999
    )
    J: float = par(0.05, unit="kg m^2", source=_J, doc="inertia at the rotor", lo=1e-5)
