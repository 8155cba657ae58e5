"""Exhaust duct 5 (= 6) to 8 with a fixed convergent exit, and static states of given area."""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca

from apu_casadi.gaspath.gas import Gas


class ExhaustOut(NamedTuple):
    """Total pressure at 8 (Pa), exit speed (m/s), exit Mach number and the two residuals."""

    P8: Any
    V8: Any
    Mach8: Any
    res_isentropic: Any
    res_flow: Any


class StaticOut(NamedTuple):
    """Static pressure (Pa), speed (m/s) and the residual that defines the static temperature."""

    Ps: Any
    V: Any
    res_flow: Any


def exhaust(
    *,
    T5: Any,
    P5: Any,
    W5: Any,
    FAR: Any,
    P0: Any,
    Ts8: Any,
    A8: Any,
    dp_exhaust: Any,
    war: Any,
    gas: Gas,
) -> ExhaustOut:
    """Expand to ambient pressure through the exit area A8 (m2), subsonic.

    0 = (s0(T8) - s0(Ts8)) - R ln(P8/P0)         (over R)
    0 = A8 rho8 V8 / W8 - 1,  V8^2/2 = h8 - hs8

    A subsonic jet has ambient static pressure.  Beyond Mach 1 the equations no longer hold:
    the operating point is refused (see :mod:`apu_casadi.gaspath.gasgenerator`).
    """
    P8 = P5 * (1 - dp_exhaust)
    R = gas.R(FAR, war)

    dh = gas.h(T5, FAR, war) - gas.h(Ts8, FAR, war)
    V8 = _signed_root(2 * dh)
    rho8 = P0 / (R * Ts8)
    return ExhaustOut(
        P8=P8,
        V8=V8,
        Mach8=V8 / ca.sqrt(gas.gamma(Ts8, FAR, war) * R * Ts8),
        res_isentropic=(gas.s0(T5, FAR, war) - gas.s0(Ts8, FAR, war)) / R - ca.log(P8 / P0),
        res_flow=A8 * rho8 * V8 / W5 - 1,
    )


def static_state(
    *, T: Any, P: Any, W: Any, Ts: Any, A: Any, FAR: Any, war: Any, gas: Gas
) -> StaticOut:
    """Static state of a flow through area A (m2).

    0 = A rho V / W - 1,  V^2/2 = h - hs,  Ps = P exp((s0(Ts) - s0(T))/R)
    """
    R = gas.R(FAR, war)
    V = _signed_root(2 * (gas.h(T, FAR, war) - gas.h(Ts, FAR, war)))
    Ps = P * ca.exp((gas.s0(Ts, FAR, war) - gas.s0(T, FAR, war)) / R)
    return StaticOut(Ps, V, A * Ps / (R * Ts) * V / W - 1)


def _signed_root(y: Any) -> Any:
    """sqrt(y) to 1e-10 for y > 50 m2/s2; odd and smooth through zero: iterates may cross it."""
    return y / ca.sqrt(ca.sqrt(y**2 + 1e-6))
