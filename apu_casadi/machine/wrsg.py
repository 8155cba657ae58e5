"""The wound-rotor synchronous generator on the rotor's axes: flux, voltage, torque (5)-(7).

Stator currents leave the machine (generator convention), rotor currents enter it (motor
convention).  All stator currents here are *effective* ones, ibar = i - T(:,k) mu i_fault: written
with them the faulty machine has the healthy machine's equations (see :mod:`.ttsc`), and without a
fault ibar is the terminal current.
"""

from __future__ import annotations

from dataclasses import fields
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.machine.machinedata import MachineParameters, SaturatedMachine
from apu_casadi.machine.park import Qd0, speed_voltage


class Windings(NamedTuple):
    """One quantity (flux linkage Wb, current A, or its rate) of all windings, in (7)'s order."""

    sq: Any
    sd: Any
    s0: Any
    fd: Any
    kd: Any
    kq: Any

    @property
    def stator(self) -> Qd0:
        """The stator's three entries."""
        return Qd0(self.sq, self.sd, self.s0)


def inductance(p: MachineParameters) -> np.ndarray:
    """Return L of (7), unsaturated, H, shape (6, 6), rows and columns q, d, 0, fd, kd, kq.

    The last entry is L_mq + L_lkq; the paper prints L_md + L_lkq, with which the q axis would not
    be the derivative of an energy.  L_s of the zero sequence is the leakage L_ls.
    """
    L = np.zeros((6, 6))
    L[0, 0], L[0, 5] = -(p.L_mq + p.L_ls), p.L_mq
    L[1, 1], L[1, 3], L[1, 4] = -(p.L_md + p.L_ls), p.L_md, p.L_md
    L[2, 2] = -p.L_ls
    L[3, 1], L[3, 3], L[3, 4] = -p.L_md, p.L_md + p.L_lfd, p.L_md
    L[4, 1], L[4, 3], L[4, 4] = -p.L_md, p.L_md, p.L_md + p.L_lkd
    L[5, 0], L[5, 5] = -p.L_mq, p.L_mq + p.L_lkq
    return L


def flux_linkages(p: MachineParameters, i: Windings) -> Windings:
    """Return lambda = L ibar, (7), in Wb, from effective stator and rotor currents in A."""
    L = inductance(p)
    lam = Windings(*(_combine(row, i) for row in L))
    if not isinstance(p, SaturatedMachine):
        return lam
    i_md = i.fd + i.kd - i.sd
    less = saturated_flux(p, i_md, 0.0) - p.L_md * i_md  # in all windings of the axis
    return lam._replace(sd=lam.sd + less, fd=lam.fd + less, kd=lam.kd + less)


def saturation(p: SaturatedMachine, lam_md: Any) -> tuple[Any, Any]:
    """Return S of a magnetising flux linkage, Wb, and lambda dS/dlambda; see the parameters."""
    log = ca.log if isinstance(p.S_10, ca.SX | ca.MX) else np.log
    X = log(p.S_12 / p.S_10) / np.log(1.2)
    square = (lam_md / p.lam_rated) ** 2
    S = p.S_10 * (square + _TINY) ** (X / 2.0)
    return S, X * S * square / (square + _TINY)


_TINY = 1e-18  # keeps derivatives finite without flux
#: Newton's steps: each takes a share X/(X+1) off while far too high, and squares the error nearby.
_STEPS = 16


def saturated_flux(p: SaturatedMachine, J: Any, s: Any) -> Any:
    """Return lambda_md, Wb, that solves lambda_md ((1 + S)/L_md + s) = J.

    By Newton's method from the linear solution, which is never below it: the left side is convex,
    so that the iterates fall to the root.  The steps are written out, for numbers and symbols.

    Args:
        J: current, A, that all windings of the axis would make together.
        s: sum of 1/L of their leakages, 1/H; 0 where J is the magnetising current itself.
    """
    lam = J / (1.0 / p.L_md + s)
    for _ in range(_STEPS):
        S, slope = saturation(p, lam)
        excess = lam * ((1.0 + S) / p.L_md + s) - J
        lam = lam - excess / ((1.0 + S + slope) / p.L_md + s)
    return lam


def current_rates(p: MachineParameters, lam: Windings, rates: Windings) -> Windings:
    """Return d ibar/dt, A/s, from the flux linkages and their rates."""
    if not isinstance(p, SaturatedMachine):
        return currents(p, rates)
    S, slope = saturation(p, _d_axis_flux(p, lam))
    return currents(_linear(p).symbolic(L_md=p.L_md / (1.0 + S + slope)), rates)


def _linear(p: SaturatedMachine) -> MachineParameters:
    return MachineParameters().symbolic(
        **{f.name: getattr(p, f.name) for f in fields(MachineParameters)}
    )


def _d_axis_flux(p: SaturatedMachine, lam: Windings) -> Any:
    leakages = ((lam.sd, p.L_ls), (lam.fd, p.L_lfd), (lam.kd, p.L_lkd))
    return saturated_flux(p, sum(x / L for x, L in leakages), sum(1.0 / L for _, L in leakages))


def currents(p: MachineParameters, lam: Windings) -> Windings:
    """Return ibar = L^-1 lambda, (7) inverted, in A; rates follow by :func:`current_rates`.

    By the mutual flux linkages (Krause): lambda_md = L_MD (lambda_sd/L_ls + lambda_fd/L_lfd +
    lambda_kd/L_lkd) with 1/L_MD = 1/L_md + 1/L_ls + 1/L_lfd + 1/L_lkd, and so in the q axis.
    """
    s, fd, kd, kq = (1.0 / L for L in (p.L_ls, p.L_lfd, p.L_lkd, p.L_lkq))
    L_MD, L_MQ = 1.0 / (1.0 / p.L_md + s + fd + kd), 1.0 / (1.0 / p.L_mq + s + kq)
    md = (L_MD * s) * lam.sd + (L_MD * fd) * lam.fd + (L_MD * kd) * lam.kd
    if isinstance(p, SaturatedMachine):
        md = _d_axis_flux(p, lam)
    mq = (L_MQ * s) * lam.sq + (L_MQ * kq) * lam.kq
    return Windings(
        sq=s * (mq - lam.sq),
        sd=s * (md - lam.sd),
        s0=-s * lam.s0,
        fd=fd * (lam.fd - md),
        kd=kd * (lam.kd - md),
        kq=kq * (lam.kq - mq),
    )


def _combine(row: np.ndarray, x: Windings) -> Any:
    return sum(float(a) * v for a, v in zip(row, x, strict=True) if a != 0.0)


def flux_rates(
    p: MachineParameters,
    *,
    lam: Windings,
    i: Windings,
    v: Qd0,
    V_fd: Any,
    w_r: Any,
    w1: Qd0,
    w2: tuple[Any, Any, Any],
) -> Windings:
    """Return d lambda/dt in V, from (5) and (6) solved for the rates.

    Args:
        lam, i: flux linkages (Wb) and effective currents (A).
        v: winding voltages, terminal to machine neutral, V.
        V_fd: field voltage referred to the stator, V; the dampers are short-circuited.
        w_r: electrical speed, rad/s.
        w1, w2: process noise of (5) and (6), V; w2 in the order fd, kd, kq.
    """
    e = speed_voltage(w_r, lam.stator)
    return Windings(
        sq=v.q - e.q + p.r_s * i.sq - w1.q,
        sd=v.d - e.d + p.r_s * i.sd - w1.d,
        s0=v.zero + p.r_s * i.s0 - w1.zero,
        fd=V_fd - p.r_fd * i.fd - w2[0],
        kd=-p.r_kd * i.kd - w2[1],
        kq=-p.r_kq * i.kq - w2[2],
    )


def torque(p: MachineParameters, *, lam: Windings, i: Windings) -> Any:
    """Return the electromagnetic torque on the shaft of one machine, N m, positive when braking.

    T_e = 3/2 n_pp (lambda_d ibar_q - lambda_q ibar_d), with the effective currents.
    """
    return 1.5 * p.n_pp * (lam.sd * i.sq - lam.sq * i.sd)
