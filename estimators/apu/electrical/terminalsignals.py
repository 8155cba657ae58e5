"""What is measured, by name, and what the filter's model has beside the machine's signals."""

from __future__ import annotations

import dataclasses

from apu_casadi.core.signals import Signal, Signals
from apu_casadi.machine.park import PHASES
from apu_casadi.machine.terminals import INPUTS, OUTPUTS

__all__ = [
    "ADMITTANCE",
    "DELAY",
    "DT_LAST",
    "ENERGY",
    "GAIN_SENSORS",
    "I_SHUNT",
    "JUMP_SIZES",
    "KEEP",
    "LATER",
    "MEASURED",
    "PHASES",
    "PHASES_I",
    "PHASES_V",
    "PREDICTED",
    "VOLTAGES",
]

PHASES_V = tuple(f"v_{k}" for k in PHASES)
PHASES_I = tuple(f"i_{k}" for k in PHASES)
VOLTAGES = (*PHASES_V, "V_fd")
MEASURED = (*PHASES_I, "i_fd")
GAIN_SENSORS = (*VOLTAGES, *MEASURED)

LATER = Signals(
    [
        dataclasses.replace(INPUTS[n], name=f"{n}_{when}", doc=f"{n} {text}")
        for when, text in (("mid", "midway to the next sample"), ("next", "at the next sample"))
        for n in VOLTAGES
    ]
)
_JUMPS = "by how much the voltage jumps before the next sample, {}"
JUMP_SIZES = Signals(
    [
        Signal("jump_qd", "V", _JUMPS.format("space vector"), default=0.0),
        Signal("jump_0", "V", _JUMPS.format("zero sequence"), default=0.0),
    ]
)
PREDICTED = Signals(
    [
        Signal(f"{n}_smooth", s.unit, f"{n} as samples before predict it", nominal=s.nominal)
        for n, s in ((n, INPUTS[n] if n in INPUTS.names else OUTPUTS[n]) for n in GAIN_SENSORS)
    ]
    + [
        Signal(f"{n}_{when}_smooth", "V", f"the same, {text}", nominal=300.0)
        for when, text in (("mid", "midway to the next sample"), ("next", "of the next sample"))
        for n in VOLTAGES
    ]
    + [Signal("theta_smooth", "rad", "rotor angle of a machine at rest with those phasors")]
)
#: A leaky fault as the terminals see it, R and L in series from the phase to the neutral: what of
#: their currents goes with it is nearly linear in the admittance, and far from it in mu and k_rf.
_OF_BRANCH = "{} of the fault's branch at rated frequency, times r_s"
ADMITTANCE = Signals(
    [
        Signal("g_shunt", "1", _OF_BRANCH.format("conductance"), 0.0, 1e-3),
        Signal("b_shunt", "1", _OF_BRANCH.format("susceptance, inductive"), 0.0, 1e-3),
    ]
)
I_SHUNT = Signal("i_shunt", "A", "current of the fault's branch, mu i_fault", nominal=10.0)
DELAY = Signal("delay_i", "s", "by which currents are read later than voltages", 0.0, 1e-5)
DT_LAST = Signal("dt_last", "s", "step before this sample; 0 at the first", nominal=1e-4)
KEEP = Signal("keep", "1", "0 at the start of a window of the mean power, else 1", default=1.0)
ENERGY = Signal(
    "energy", "J", "both generators' mechanical energy since the window's start", nominal=1e4
)
