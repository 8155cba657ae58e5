"""IEEE AC5A excitation system with a voltage regulator on the measured terminal voltage.

    T_R dV_c/dt = V_t - V_c
    T_A dV_R/dt = K_A (V_ref - V_c - V_F) - V_R,     V_R_min <= V_R <= V_R_max, non-windup
    T_E dE_fd/dt = V_R - (K_E + S_E(E_fd)) E_fd
    V_F = s K_F (1 + s T_F3) / ((1 + s T_F1) (1 + s T_F2)) E_fd

per unit of the rated terminal voltage and of the field voltage for it at no load.  S_E is
exponential through two points.  The paper replaces the permanent-magnet machine and the main
exciter by this model (section 4.1).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import casadi as ca

from apu_casadi.core.signals import Signal, Signals
from apu_casadi.machine.machinedata import ExciterParameters


class ExciterState(NamedTuple):
    """States of the exciter, per unit."""

    V_c: Any
    V_R: Any
    E_fd: Any
    x_F1: Any
    x_F2: Any = None


def exciter_signals(p: ExciterParameters) -> Signals:
    """Return the exciter's states; the second feedback lag only where there is one."""
    signals = [
        Signal("V_c", "1", "measured terminal voltage after the transducer, per unit"),
        Signal("V_R", "1", "voltage regulator output, per unit"),
        Signal("E_fd", "1", "exciter output, per unit of the no-load field voltage"),
        Signal("x_F1", "1", "rate feedback, first lag, per unit"),
    ]
    if "T_F2" not in p.absent:
        signals.append(Signal("x_F2", "1", "rate feedback, second lag, per unit"))
    return Signals(signals)


def saturation(p: ExciterParameters, E_fd: Any) -> Any:
    """Return S_E(E_fd), exponential through (E_1, S_E1) and (E_2, S_E2)."""
    if "S_E1" in p.absent:
        return 0.0 * E_fd
    log, exp = (ca.log, ca.exp) if isinstance(p.S_E1, ca.SX) else (math.log, math.exp)
    B = log(p.S_E1 / p.S_E2) / (p.E_1 - p.E_2)
    A = p.S_E2 * exp(-B * p.E_2)
    if isinstance(E_fd, ca.SX | ca.MX | ca.DM):
        return A * ca.exp(B * E_fd)
    return A * math.exp(min(B * E_fd, 500.0))  # a root search may try any field


def exciter_rates(p: ExciterParameters, s: ExciterState, *, V_t: Any, V_ref: Any) -> ExciterState:
    """Return d/dt of the states, 1/s, from terminal and reference voltage, per unit.

    The limits act on the rate of V_R: beyond a limit it returns with T_lim, and below it the rate
    is bounded so that the limit is approached, never crossed, and left without delay.
    """
    V_F1 = p.K_F / p.T_F1 * (s.E_fd - s.x_F1)
    if "T_F2" not in p.absent:
        V_F = s.x_F2 + p.T_F3 / p.T_F2 * (V_F1 - s.x_F2)
        x_F2 = (V_F1 - s.x_F2) / p.T_F2
    else:
        V_F, x_F2 = V_F1, None
    free = (p.K_A * (V_ref - s.V_c - V_F) - s.V_R) / p.T_A
    up, down = (p.V_R_max - s.V_R) / p.T_lim, (p.V_R_min - s.V_R) / p.T_lim
    return ExciterState(
        V_c=(V_t - s.V_c) / p.T_R,
        V_R=ca.fmax(ca.fmin(free, up), down),
        E_fd=(s.V_R - (p.K_E + saturation(p, s.E_fd)) * s.E_fd) / p.T_E,
        x_F1=(s.E_fd - s.x_F1) / p.T_F1,
        x_F2=x_F2,
    )


def exciter_steady(p: ExciterParameters, *, E_fd: float, V_t: float) -> tuple[ExciterState, float]:
    """Return the states at rest and the V_ref that holds them, per unit; limits not checked."""
    V_R = (p.K_E + saturation(p, E_fd)) * E_fd
    x_F2 = None if "T_F2" in p.absent else 0.0
    return ExciterState(V_c=V_t, V_R=V_R, E_fd=E_fd, x_F1=E_fd, x_F2=x_F2), V_t + V_R / p.K_A
