"""The healthy machine at rest under a balanced load, and what is known of a steady point.

(5)-(7) at rest with Z = R + j X, in peak values on the rotor's axes:

    (R + r_s) i_q + (X + w_r L_d) i_d = w_r L_md i_fd,  (R + r_s) i_d = (X + w_r L_q) i_q.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from apu_casadi.core.errors import OperatingPointError
from apu_casadi.core.means import PHASORS, RMS, SEQUENCES, sequences
from apu_casadi.core.sharing import Parametric, derived
from apu_casadi.machine import exciter as ac5a
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.loads.load import Load
from apu_casadi.machine.machinedata import (
    ExciterParameters,
    MachineParameters,
    SaturatedMachine,
)
from apu_casadi.machine.periodic import Turn
from apu_casadi.machine.wrsg import Windings, saturation

SETTLING = 20  # rounds in which a regulated voltage settles, if it does


@dataclass(frozen=True, eq=False)
class GeneratorPoint(Parametric):
    """A steady state of the generator.

    Args:
        ss: the variant it belongs to.
        x, u: state (nx,) and inputs (nu,).
        V_ref: voltage reference that holds it, per unit.
        V_t: terminal voltage, V rms per phase; with a fault or an unbalanced load its mean.
        y: outputs by name at the starting rotor angle.
        residual: largest state rate over nominal value (rotor angle apart), 1/s; of a periodic
            state the largest defect of the rates halfway between the angles that it is solved at.
        theta: parameters of the fault.
        states: of a periodic one, those at equally spaced rotor angles, shape (nx, n).
        note: what should be known of it.
    """

    ss: GeneratorModel
    x: np.ndarray
    u: np.ndarray
    V_ref: float
    V_t: float
    y: dict[str, float]
    residual: float
    theta: np.ndarray = field(default_factory=lambda: np.zeros(0))
    states: np.ndarray | None = None
    note: str = ""

    @property
    def balanced(self) -> bool:
        """Whether the phases differ by rotation only, and nothing moves on the rotor's axes."""
        return self.states is None

    @derived
    def turn(self) -> Turn:
        """States and outputs over one turn from here."""
        return Turn.of(self.ss, self.x if self.states is None else self.states, self.u, self.theta)

    @property
    def summary(self) -> dict[str, float]:
        """Outputs by name; of a periodic state means and, of what alternates, rms values.

        Symmetrical components of its fundamentals, V, A and ratios, are among them.
        """
        if self.balanced:
            return {n: float(v) for n, v in self.y.items()}
        phasors = [self.turn.phasor(n) for n in PHASORS.values()]
        parts = np.array([x for V in phasors for x in (V.real, V.imag)])
        found = {n: self.turn.rms(n.removesuffix("_rms").lower()) for n in RMS}
        found |= dict(zip(SEQUENCES, sequences(parts).tolist(), strict=True))
        found["i_fault_rms"] = self.turn.rms("i_fault")
        names = ["V_fd", "i_fd", "E_fd", "T_e", "P_e", "P_loss_fault", "P_total"]
        return found | {n: self.turn.mean(n) for n in names}

    def mean(self, name: str) -> float:
        """Return the mean of an output over a turn."""
        constant = self.balanced and name[:2] not in ("v_", "i_")
        return self.y[name] if constant and name in self.y else self.turn.mean(name)


@dataclass(frozen=True)
class AtRest:
    """Steady states of a healthy machine with its exciter, balanced."""

    machine: MachineParameters
    exciter: ExciterParameters

    def field(self, V_t: float, Z: complex, w_r: float) -> tuple[float, Windings]:
        """Return V_fd (V) and the steady currents for a terminal voltage (V rms) and impedance."""
        p = self.machine
        if isinstance(p, SaturatedMachine):
            return _saturated_field(p, V_t, Z, w_r)
        X_d, X_q = Z.imag + w_r * (p.L_md + p.L_ls), Z.imag + w_r * (p.L_mq + p.L_ls)
        R_t = Z.real + p.r_s
        if not R_t**2 + X_d * X_q > 0:
            raise OperatingPointError(
                f"a load of {Z:.4g} ohm excites the generator by itself at w_r = {w_r:.5g} rad/s: "
                "(R + r_s)^2 + (X + X_d)(X + X_q) must be > 0 for a steady state with a field"
            )
        i_q = R_t / (R_t**2 + X_d * X_q)  # for w_r L_md i_fd = 1 V
        i_d = X_q * i_q / R_t
        V_unit = abs(Z) * math.hypot(i_q, i_d)
        scale = math.sqrt(2.0) * V_t / V_unit
        i_fd = scale / (w_r * p.L_md)
        return p.r_fd * i_fd, Windings(scale * i_q, scale * i_d, 0.0, i_fd, 0.0, 0.0)

    def at(self, load: Load, w_r: float, V_t: float) -> tuple[Windings, ac5a.ExciterState, float]:
        """Return currents, exciter and V_ref at rest with a terminal voltage, V rms."""
        p = self.machine
        V_fd, i = self.field(V_t, load.impedance(w_r, V_t), w_r)
        E_fd = V_fd / p.V_fd_base
        return i, *ac5a.exciter_steady(self.exciter, E_fd=E_fd, V_t=V_t / p.V_rated_rms)

    def regulated(self, load: Load, w_r: float, V_ref: float) -> float:
        """Return the terminal voltage, V rms, that the regulator holds with ``V_ref``.

        V_t = V_ref - V_R / K_A with 0 <= V_R <= V_R_max at rest, so the root is bracketed.
        """
        rated, e = self.machine.V_rated_rms, self.exciter

        def excess(V: float) -> float:
            return self.at(load, w_r, V)[2] - V_ref

        low, high = max((V_ref - e.V_R_max / e.K_A) * rated, 1e-6 * rated), V_ref * rated
        if high > low and not excess(low) <= 0 <= excess(high):
            raise OperatingPointError(
                f"no regulated steady state for {load!r} at V_ref = {V_ref:.5g}, "
                f"w_r = {w_r:.5g} rad/s: even at {low:.4g} V the regulator would need "
                f"V_R = {self.at(load, w_r, low)[1].V_R:.4g}, ceiling {e.V_R_max:g}"
            )
        V = high
        for _ in range(SETTLING):  # with so high a gain it settles, by a hundred times a round
            off = excess(V) * rated
            if abs(off) <= 1e-15 * rated:
                return V
            V = min(max(V - off, low), high)
        return _root(excess, low, high)

    def excited(self, load: Load, w_r: float, V_fd: float) -> float:
        """Return the terminal voltage, V rms, that a field voltage gives, V: the highest one."""
        p = self.machine

        def excess(V: float) -> float:
            return self.field(V, load.impedance(w_r, V), w_r)[0] - V_fd

        high = V_fd / p.r_fd * w_r * p.L_md / math.sqrt(2.0)  # without a load
        while excess(high) < 0:  # a load that leads
            high *= 1.25
            if high > 100.0 * p.V_rated_rms:
                raise OperatingPointError(
                    f"no terminal voltage below {high:.4g} V belongs to V_fd = {V_fd:.5g} V with "
                    f"{load!r} at w_r = {w_r:.5g} rad/s"
                )
        low = high
        while excess(low) > 0:
            low *= 0.99
            if low < 1e-4 * p.V_rated_rms:
                raise OperatingPointError(
                    f"V_fd = {V_fd:.5g} V does not carry {load!r} at w_r = {w_r:.5g} rad/s"
                    + (f"; {load.caveat}" if load.caveat else "")
                )
        return _root(excess, low, low / 0.99)


def _saturated_field(
    p: SaturatedMachine, V_t: float, Z: complex, w_r: float
) -> tuple[float, Windings]:
    """Do :meth:`AtRest.field` where the d axis saturates.

    The q axis does not, so that V + (r_s + j w_r L_q) I lies along it: that gives i_q and i_d, and
    v_q + r_s i_q = w_r lambda_d the flux linkage that the field has to drive.
    """
    V = complex(math.sqrt(2.0) * V_t)
    I = V / Z
    along = V + complex(p.r_s, w_r * (p.L_mq + p.L_ls)) * I
    turn = abs(along) / along
    V, I = V * turn, I * turn
    i_q, i_d = I.real, -I.imag
    lam_md = (V.real + p.r_s * i_q) / w_r + p.L_ls * i_d
    i_fd = lam_md * (1.0 + saturation(p, lam_md)[0]) / p.L_md + i_d
    if not i_fd > 0:
        raise OperatingPointError(
            f"a load of {Z:.4g} ohm excites the generator by itself at w_r = {w_r:.5g} rad/s: "
            f"{V_t:.5g} V would need a field current of {i_fd:.4g} A"
        )
    return p.r_fd * i_fd, Windings(i_q, i_d, 0.0, i_fd, 0.0, 0.0)


def _root(excess: Callable[[float], float], low: float, high: float) -> float:
    import scipy.optimize

    return float(scipy.optimize.brentq(excess, low, high, xtol=1e-12, rtol=1e-15))
