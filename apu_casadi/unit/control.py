"""PI speed governor on fuel flow, with limits and anti-windup.

The paper calls its controller "a simple PI controller that uses speed feedback to control fuel"
and gives no numbers; those here are assumed, with the reason beside them.  It holds speed and
limits fuel; no temperature is limited, and a run that gets too hot says so
(:mod:`apu_casadi.unit.validity`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca

from apu_casadi.core.errors import ParameterError
from apu_casadi.core.parameters import Parameters, par


@dataclass(frozen=True)
class GovernorParameters(Parameters):
    """Gains and limits of the governor."""

    Kp: float = par(
        0.38, unit="kg/s",
        source="assumed: crossover at 8 rad/s with J = 0.05 kg m2, far below the 20 ms sampling",
        doc="fuel flow per relative speed error", lo=0.0,
    )  # fmt: skip
    Ki: float = par(
        0.76, unit="kg/s^2", source="assumed: Kp times a quarter of the crossover",
        doc="fuel flow rate per relative speed error", lo=0.0,
    )  # fmt: skip
    Wf_min: float = par(
        0.010, unit="kg/s", source="assumed: a fifth of design fuel, against flame-out",
        doc="lower fuel limit", lo=1e-5,
    )  # fmt: skip
    Wf_max: float = par(
        0.060, unit="kg/s",
        source="assumed: 1.24 x design fuel; steady T4 there 1345 K at governed speed on the "
        "default day, more on a hot day, at altitude, with a fault or at a lower speed",
        doc="upper fuel limit; it limits the fuel, not T4", lo=1e-5,
    )  # fmt: skip
    T_aw: float = par(
        0.1,
        unit="s",
        source="assumed: a quarter of Kp/Ki",
        doc="anti-windup tracking time",
        lo=1e-4,
    )

    def __post_init__(self) -> None:
        """Check the ranges, and that the limits are in order."""
        super().__post_init__()
        if not self.Wf_min < self.Wf_max:
            raise ParameterError(
                f"GovernorParameters: Wf_min = {self.Wf_min:g} must be below "
                f"Wf_max = {self.Wf_max:g} kg/s"
            )


class GovernorOut(NamedTuple):
    """Fuel flow, kg/s, and the rate of the integrator, kg/s2."""

    Wf: Any
    Wf_I_dot: Any


def governor(*, N: Any, N_ref: Any, Wf_I: Any, par: GovernorParameters) -> GovernorOut:
    """PI law with saturation and back-calculation.

    e = (N_ref - N)/N_ref,  Wf = limit(Kp e + Wf_I),
    dWf_I/dt = Ki e + (Wf - (Kp e + Wf_I))/T_aw
    """
    e = (N_ref - N) / N_ref
    demand = par.Kp * e + Wf_I
    if isinstance(demand, float):
        Wf: Any = max(par.Wf_min, min(par.Wf_max, demand))
    else:
        Wf = ca.fmax(par.Wf_min, ca.fmin(par.Wf_max, demand))
    return GovernorOut(Wf, par.Ki * e + (Wf - demand) / par.T_aw)
