"""Combustor from station 31 to 4."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

from apu_casadi.gaspath.gas import Gas


class CombustorOut(NamedTuple):
    """Exit flow (kg/s), burnt fuel per dry air, exit pressure (Pa) and the energy residual."""

    W4: Any
    FAR4: Any
    P4: Any
    res_energy: Any


def combustor(
    *,
    T31: Any,
    P31: Any,
    W31: Any,
    Wf: Any,
    T4: Any,
    war: Any,
    dp_burner: Any,
    eta_burner: Any,
    LHV: Any,
    gas: Gas,
) -> CombustorOut:
    """Burn Wf completely; a share 1 - eta_burner of the heating value is lost.

    0 = W31 h31 + Wf eta_burner LHV - W4 h4      (over W31 cp31 T31)

    The fuel enters at 298.15 K, where its sensible enthalpy is zero.
    """
    FAR4 = Wf / (W31 / (1 + war))
    W4 = W31 + Wf
    heat = W31 * gas.h(T31, 0.0, war) + Wf * eta_burner * LHV
    scale = W31 * gas.cp(T31, 0.0, war) * T31
    return CombustorOut(
        W4=W4,
        FAR4=FAR4,
        P4=P31 * (1 - dp_burner),
        res_energy=(heat - W4 * gas.h(T4, FAR4, war)) / scale,
    )


def snox(*, T3: Any, P3: Any, war: Any) -> Any:
    """NOx severity factor of T3 in K and P3 in Pa, 1 at 2964.5 kPa, 826.26 K and war = 0.0629.

    The correlation of the GasTurb manual; reproduces the paper's Tables 4 and 5.
    """
    return (P3 / 2964.5e3) ** 0.4 * ca.exp((T3 - 826.26) / 194.39 + (6.29 - 100 * war) / 53.2)
