"""Turns of the field winding shorted: a fraction mu_f of them is out of the circuit.

The turns that are left, 1 - mu_f of N, have (Krause, Wasynczuk, Sudhoff, "Analysis of Electric
Machinery", on referring windings: resistance goes with the turns, mutual inductance with the
turns, self inductance with their square)

    r = (1 - mu_f) r_fd,    L_m = (1 - mu_f) L_md,    L = (1 - mu_f)^2 (L_md + L_lfd),

the mutual inductance that to the d axis and to the d damper.  The leakage goes with the square as
well: all turns link one flux.  Referred to the stator by the turns that are left, the inductances
of (7) are the healthy ones again, and what is left of the change is

    r_fd' = r_fd / (1 - mu_f),    V_fd' = V_fd / (1 - mu_f),    i_fd = i_fd' / (1 - mu_f).

The state lam_fd is the flux linkage so referred: N times the flux of a turn.  It is what stays at
the switch, as every turn's flux does; the flux linkage of the turns that are left is
(1 - mu_f) lam_fd, and the ampere-turns stay, so that i_fd alone jumps.

Left out is the current in the shorted turns themselves: they act as one more damper in the moment
of the fault.  At rest they carry nothing, and all of the above is exact.  The loss of the field
winding is not in (8) and so nothing of this fault is; the paper's field base stays V_fd_base.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError
from apu_casadi.core.register import Key
from apu_casadi.core.signals import Signal
from apu_casadi.machine.faults.fault import FAULTS, AtFault, Fault, Own
from apu_casadi.machine.loads.load import Load
from apu_casadi.machine.machinedata import MachineParameters

_MU_F = Signal("mu_f", "1", "fraction of the field's turns that is shorted", nominal=0.1)


@FAULTS.add("field")
@dataclass(frozen=True)
class FieldShort(Fault):
    """Shorted turns of the field winding.

    Args:
        mu_f: fraction of the turns, 0 < mu_f < 1.

    Raises:
        ParameterError: a value outside its range.
    """

    mu_f: float

    word = "field"
    keys: ClassVar[tuple[Key, ...]] = (
        Key("mu_f", "1", "shorted fraction of the field's turns", 0.0, 0.9, open_lo=True),
    )
    severities: ClassVar[tuple[Signal, ...]] = (
        Signal("mu_f", "1", "shorted fraction of the field's turns (0: healthy)", default=0.0),
    )

    def __post_init__(self) -> None:
        value = number("FieldShort.mu_f", self.mu_f, error=ParameterError)
        object.__setattr__(self, "mu_f", value)
        if not (math.isfinite(value) and 0 < value < 1):
            raise ParameterError(
                f"FieldShort.mu_f = {value:g} is outside (0, 1); a healthy machine has no fault "
                "(None)"
            )

    def kind(self, load: Load, neutral: str) -> str:
        """Return ``"field"``."""
        return "field"

    def own(self, kind: str, neutral: str) -> Own:
        """Return mu_f."""
        return Own((_MU_F,))

    @classmethod
    def examples(cls) -> dict[str, Fault]:
        """Return 10 % of the turns."""
        return {"field": cls(0.1)}

    def machine(self, p: MachineParameters, theta: dict[str, Any]) -> MachineParameters:
        """Return the machine with r_fd / (1 - mu_f); V_fd_base, and with it V_fd, follows."""
        return p.symbolic(r_fd=p.r_fd / (1.0 - theta["mu_f"]))

    def outputs(self, at: AtFault, y: dict[str, Any]) -> dict[str, Any]:
        """Return V_fd at the slip rings and i_fd in the turns that are left."""
        left = 1.0 - at.theta["mu_f"]
        return {"V_fd": left * y["V_fd"], "i_fd": y["i_fd"] / left}

    def parameters(self, kind: str) -> dict[str, float]:
        """Return mu_f."""
        return {"mu_f": self.mu_f}
