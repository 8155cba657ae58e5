"""Cooled turbine: vane cooling 4 -> 41, rotor 41 -> 50, rotor cooling 50 -> 5.

The vane cooling air mixes before the rotor and does work; the rotor cooling air mixes behind it
and does none (decoded from the flows of Tables 4 and 5).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

from apu_casadi.gaspath.gas import Gas


class MixOut(NamedTuple):
    """Mixed flow (kg/s), its burnt fuel per dry air, and the energy residual."""

    W: Any
    FAR: Any
    res_energy: Any


class TurbineOut(NamedTuple):
    """Rotor exit pressure (Pa), power (W), and the residuals that define T5s and T50."""

    P5: Any
    P_turb: Any
    res_isentropic: Any
    res_efficiency: Any


def mix_cooling(
    *, T: Any, W: Any, FAR: Any, T_cool: Any, W_cool: Any, T_mix: Any, war: Any, gas: Gas
) -> MixOut:
    """Mix cooling air into the main stream at constant pressure.

    0 = W h + W_cool h_cool - (W + W_cool) h_mix      (over W cp T)
    """
    fuel = W * FAR / (1 + war + FAR)
    W_mix = W + W_cool
    FAR_mix = fuel / ((W_mix - fuel) / (1 + war))
    enthalpy = W * gas.h(T, FAR, war) + W_cool * gas.h(T_cool, 0.0, war)
    scale = W * gas.cp(T, FAR, war) * T
    res = (enthalpy - W_mix * gas.h(T_mix, FAR_mix, war)) / scale
    return MixOut(W_mix, FAR_mix, res)


def turbine(
    *,
    T41: Any,
    P4: Any,
    W41: Any,
    FAR41: Any,
    PR: Any,
    eta: Any,
    T5s: Any,
    T50: Any,
    war: Any,
    gas: Gas,
) -> TurbineOut:
    """Expand W41 from P4 to P4/PR with isentropic efficiency eta.

    0 = (s0(T5s) - s0(T41)) + R ln PR            (over R)
    0 = (h41 - h50) - eta (h41 - h5s)            (over cp41 T41)
    """
    h41, h50, h5s = (gas.h(T, FAR41, war) for T in (T41, T50, T5s))
    R = gas.R(FAR41, war)
    return TurbineOut(
        P5=P4 / PR,
        P_turb=W41 * (h41 - h50),
        res_isentropic=(gas.s0(T5s, FAR41, war) - gas.s0(T41, FAR41, war)) / R + ca.log(PR),
        res_efficiency=((h41 - h50) - eta * (h41 - h5s)) / (gas.cp(T41, FAR41, war) * T41),
    )
