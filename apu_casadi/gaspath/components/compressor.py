"""Compressor from station 2 to 3, and the bleeds taken from its exit."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

from apu_casadi.gaspath.gas import Gas


class CompressorOut(NamedTuple):
    """Exit pressure (Pa), absorbed power (W) and the two residuals that define T3s and T3."""

    P3: Any
    P_cpr: Any
    res_isentropic: Any
    res_efficiency: Any


class BleedOut(NamedTuple):
    """Mass flows behind the bleeds, kg/s."""

    W31: Any
    W_ngv: Any
    W_rotor: Any
    W_overboard: Any


def compressor(
    *, T2: Any, P2: Any, W2: Any, PR: Any, eta: Any, T3s: Any, T3: Any, war: Any, gas: Gas
) -> CompressorOut:
    """Compress W2 from P2 to PR*P2 with isentropic efficiency eta; the bleeds leave at station 3.

    0 = (s0(T3s) - s0(T2)) - R ln PR             (over R)
    0 = eta (h3 - h2) - (h3s - h2)               (over cp2 T2)
    """
    h2, h3, h3s = gas.h(T2, 0.0, war), gas.h(T3, 0.0, war), gas.h(T3s, 0.0, war)
    R = gas.R(0.0, war)
    return CompressorOut(
        P3=P2 * PR,
        P_cpr=W2 * (h3 - h2),
        res_isentropic=(gas.s0(T3s, 0.0, war) - gas.s0(T2, 0.0, war)) / R - ca.log(PR),
        res_efficiency=(eta * (h3 - h2) - (h3s - h2)) / (gas.cp(T2, 0.0, war) * T2),
    )


def bleeds(*, W3: Any, overboard: Any, ngv: Any, rotor: Any) -> BleedOut:
    """Split the compressor exit flow by fixed fractions of W3.

    0 = W31 + W_ngv + W_rotor + W_overboard - W3.
    """
    return BleedOut(
        W31=W3 * (1 - overboard - ngv - rotor),
        W_ngv=W3 * ngv,
        W_rotor=W3 * rotor,
        W_overboard=W3 * overboard,
    )
