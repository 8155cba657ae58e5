"""Single shaft: power balance of turbine, compressor, accessories and load (paper, eq. 3)."""

from __future__ import annotations

from typing import Any


def power_balance(*, P_turb: Any, P_cpr: Any, eta_cpr: Any, P_acc: Any, PW: Any) -> Any:
    """Power left to accelerate the rotor, W.  P_turb - P_cpr/eta_cpr - P_acc - PW."""
    return P_turb - P_cpr / eta_cpr - P_acc - PW


def rotor_acceleration(*, P_acceleration: Any, N: Any, J: Any) -> Any:
    """dN/dt in rad/s2.  0 = J N dN/dt - P_acceleration."""
    return P_acceleration / (J * N)
