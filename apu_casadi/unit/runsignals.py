"""Signals of a joint run: unit and meaning of every variable that its datasets may hold."""

from __future__ import annotations

from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.stations import THETA, Y
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generatormodel import OUTPUTS
from apu_casadi.machine.park import PHASES

__all__ = ["RUN"]

_WAVEFORMS = ("v_a", "v_b", "v_c", "i_a", "i_b", "i_c", "i_fault", "V_fd", "i_fd", "T_e")
_RMS = "settled rms over one exchange"

RUN = Signals(
    [
        *Y,
        *THETA,
        *Ttsc.severities,
        Signal("P_total", "W", "mean mechanical power of both generators over one exchange (eq 8)"),
        Signal("P_e", "W", "mean electrical output of one generator over one exchange"),
        Signal(
            "P_loss_fault", "W", "mean extra loss of the fault in one generator over one exchange"
        ),
        *(Signal(f"V_{p}_rms", "V", f"phase {p} voltage, {_RMS}") for p in PHASES),
        *(Signal(f"I_{p}_rms", "A", f"phase {p} current, {_RMS}") for p in PHASES),
        *(OUTPUTS[name] for name in _WAVEFORMS),
        Signal("P_inst", "W", "instantaneous power of eq 8, both generators"),
    ]
)
"""Those of the gas path, then what each generator has, then what is sampled."""
