"""The standard atmosphere and the ram state in front of the inlet.

ICAO Doc 7488 (ISA): troposphere to 11 km, then isothermal; altitudes are geopotential, as the
paper's Table 5 has them (8000 m: 35.5998 kPa).  A temperature deviation shifts the static
temperature at unchanged pressure.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

from apu_casadi.gaspath.gas import Gas

G0 = 9.80665  # m/s2
R_ISA = 287.05287  # J/(kg K), the constant of the ISA definition
T_SL, P_SL = 288.15, 101325.0  # K, Pa at sea level
LAPSE = -0.0065  # K/m in the troposphere
H_TROPOPAUSE = 11000.0  # m


class Ambient(NamedTuple):
    """Static state, free-stream speed and total state at the intake entrance (stations 0 and 1)."""

    T0: Any
    P0: Any
    V0: Any
    T1: Any
    P1: Any


def isa(altitude: Any, dT_isa: Any = 0.0) -> tuple[Any, Any]:
    """Return the static temperature, K, and pressure, Pa, at a geopotential altitude in m."""
    T_tropo = T_SL + LAPSE * H_TROPOPAUSE
    P_tropo = P_SL * (T_tropo / T_SL) ** (-G0 / (LAPSE * R_ISA))
    T_low = T_SL + LAPSE * ca.fmin(altitude, H_TROPOPAUSE)
    P_low = P_SL * (T_low / T_SL) ** (-G0 / (LAPSE * R_ISA))
    P_high = P_tropo * ca.exp(-G0 * (altitude - H_TROPOPAUSE) / (R_ISA * T_tropo))
    return T_low + dT_isa, ca.if_else(altitude < H_TROPOPAUSE, P_low, P_high)


def ambient(*, altitude: Any, Mach: Any, dT_isa: Any, war: Any, gas: Gas) -> Ambient:
    """Return stations 0 and 1.

    0 = h(T1) - h(T0) - V0^2/2  and  0 = s0(T1) - s0(T0) - R ln(P1/P0), with the same gas model as
    everything downstream.
    """
    T0, P0 = isa(altitude, dT_isa)
    V0 = Mach * ca.sqrt(gas.gamma(T0, 0.0, war) * gas.R(0.0, war) * T0)
    T1 = gas.T_of_h(gas.h(T0, 0.0, war) + V0**2 / 2, T0 * (1 + 0.2 * Mach**2), 0.0, war, n=3)
    P1 = P0 * ca.exp((gas.s0(T1, 0.0, war) - gas.s0(T0, 0.0, war)) / gas.R(0.0, war))
    return Ambient(T0, P0, V0, T1, P1)
