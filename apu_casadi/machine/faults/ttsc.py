"""Turn-to-turn short circuit of a stator phase: (4), (7), (9).

A fraction mu of phase k's turns is bridged by r_fault = k_rf mu r_s (4), which carries i_fault.
With the effective current ibar = i - T(:,k) mu i_fault the machine stays as it was, (7); what is
new is one scalar loop.

The paper leaves lambda_sa-f in (9) undefined.  Every partition of the phase leakage that leaves
the healthy machine unchanged and agrees with (7) is

    lambda_sa-f = mu lambda_k + mu (kappa - mu) L_ls i_fault,      mu <= kappa <= 1,

and then (5) and (9) give

    (kappa - mu) L_ls d(i_fault)/dt = -(v_k - w1_k) - (1 - mu + k_rf) r_s i_fault,

with v_k the winding voltage (terminal to machine neutral) and w1_k the noise of (5) in phase k.

* kappa = mu (default, the paper's own model): full coupling; i_fault is algebraic and only
  h = mu / (k_rf + 1 - mu) enters voltages, currents and loss.
* kappa = 1: leakage in proportion to the turns; i_fault is a state.

A severity is defined only by all three numbers.  Seen from outside, the faulty machine is the
healthy one with R_shunt and L_shunt in series from terminal k to the machine neutral.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError
from apu_casadi.machine.machinedata import MachineParameters
from apu_casadi.machine.park import PHASE_ANGLE


@dataclass(frozen=True)
class Ttsc:
    """A turn-to-turn short circuit.

    Args:
        mu: fraction of the phase's turns that is shorted, 0 < mu < 1.
        k_rf: fault resistance over the resistance of the shorted turns (4), >= 0.
        kappa: leakage partition, mu <= kappa <= 1; None means mu, the paper's model.
        phase: "a" (the paper's), "b" or "c".

    Raises:
        ParameterError: a value outside its range.  A healthy machine is ``None``, not ``mu = 0``.
    """

    mu: float
    k_rf: float
    kappa: float | None = None
    phase: str = "a"

    def __post_init__(self) -> None:
        """Check the ranges; put mu for an absent kappa."""
        if self.kappa is None:
            object.__setattr__(self, "kappa", self.mu)
        for name in ("mu", "k_rf", "kappa"):
            value = number(f"Ttsc.{name}", getattr(self, name), error=ParameterError)
            object.__setattr__(self, name, value)
            if not math.isfinite(value):
                raise ParameterError(f"Ttsc.{name} must be a finite number, got {value!r}")
        if not 0 < self.mu < 1:
            raise ParameterError(
                f"Ttsc.mu = {self.mu:g} is outside (0, 1); a healthy machine has no fault (None)"
            )
        if self.k_rf < 0:
            raise ParameterError(f"Ttsc.k_rf = {self.k_rf:g} must be >= 0")
        if not self.mu <= self._kappa <= 1:
            raise ParameterError(
                f"Ttsc.kappa = {self.kappa:g} is outside [mu, 1] = [{self.mu:g}, 1]"
            )
        if self.phase not in PHASE_ANGLE:
            raise ParameterError(f"Ttsc.phase must be 'a', 'b' or 'c', got {self.phase!r}")

    @property
    def _kappa(self) -> float:
        assert self.kappa is not None
        return self.kappa

    @property
    def h(self) -> float:
        """mu / (k_rf + 1 - mu): the one severity that shows at the terminals if kappa = mu."""
        return self.mu / (self.k_rf + 1.0 - self.mu)

    @property
    def phase_angle(self) -> float:
        """Electrical angle of the faulty phase's axis, rad."""
        return PHASE_ANGLE[self.phase]

    def r_fault(self, p: MachineParameters) -> float:
        """Resistance of the fault branch (4), ohm."""
        return self.k_rf * self.mu * p.r_s

    def R_shunt(self, p: MachineParameters) -> float:
        """Resistance of the equivalent shunt from terminal k to the machine neutral, ohm."""
        return p.r_s / self.h

    def L_shunt(self, p: MachineParameters) -> float:
        """Inductance of the equivalent shunt, H; zero for kappa = mu."""
        return (self._kappa - self.mu) * p.L_ls / self.mu


def loop_residual(
    p: MachineParameters,
    *,
    mu: Any,
    k_rf: Any,
    kappa: Any,
    v_k: Any,
    i_fault: Any,
    di_fault: Any,
) -> Any:
    """Return the left minus the right side of the fault loop, V, with v_k - w1_k as ``v_k``.

    0 = (kappa - mu) L_ls d(i_fault)/dt + v_k + (1 - mu + k_rf) r_s i_fault, from (5) and (9).
    """
    return (kappa - mu) * p.L_ls * di_fault + v_k + (1.0 - mu + k_rf) * p.r_s * i_fault


def fault_loss(p: MachineParameters, *, mu: Any, k_rf: Any, i_k: Any, i_fault: Any) -> Any:
    """Return the extra loss of the fault in (8), W, from the phase's terminal current ``i_k``.

    i_fault^2 r_fault + ((i_k - i_fault)^2 - i_k^2) r_sa-f, with r_sa-f = mu r_s.
    """
    r_short = mu * p.r_s
    return i_fault**2 * k_rf * r_short + ((i_k - i_fault) ** 2 - i_k**2) * r_short
