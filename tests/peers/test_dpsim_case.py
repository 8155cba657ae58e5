"""What is handed to dpsim, and the constant field voltage of our side; needs no dpsim."""

import numpy as np
import pytest

from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.machinedata import MachineParameters
from scenarios.validation.peers import machine

P = MachineParameters()


def test_per_unit_values_are_the_reactances_over_the_base_impedance():
    """Table 1 at 400 Hz: X_d = 0.605 ohm, r_s = 4.4 mohm; base 3 V^2 / S = 0.7053 ohm."""
    pu = machine.theirs(machine.CASES[0], P)["machine_pu"]
    Z = 3 * 230.0**2 / 225e3
    assert (pu["L_md"] + pu["L_ls"]) * Z == pytest.approx(0.605, abs=5e-4)
    assert pu["r_s"] * Z == pytest.approx(0.0044, rel=1e-12)


@pytest.mark.parametrize("case", machine.CASES, ids=lambda c: c.label)
def test_switch_and_load_in_parallel_are_the_load_after(case):
    """The switch carries the difference of the loads, or the shunt of the fault."""
    given = machine.theirs(case, P)
    load, branch = np.array(given["R_load"]), np.array(given["R_switch"])
    parallel = 1 / (1 / load + 1 / branch)
    if case.fault is None:
        closed, opened = (case.before, case.after) if given["closed"] else (case.after, case.before)
        assert parallel == pytest.approx(closed.R, rel=1e-12)
        assert load == pytest.approx(opened.R, rel=1e-12)
    else:
        k = "abc".index(case.fault.phase)
        assert branch[k] == pytest.approx(case.fault.R_shunt(P), rel=1e-12)


def test_field_voltage_stays_constant():
    """Short circuit with the frozen exciter: E_fd moves by less than 1e-10 per unit."""
    gen = machine.frozen_exciter()
    ds = gen.simulate(machine.KW225, machine.T_END, switches=[(machine.T_SWITCH, machine.SHORT)])
    assert float(abs(ds.E_fd - ds.E_fd[0]).max()) < 1e-10


def test_fault_enters_as_the_current_of_the_healthy_machine():
    """kappa = mu: what is compared is the current of the healthy machine with the shunt."""
    fault = Ttsc(0.05, 1.0)
    R, R_shunt = machine.KW225.R[0], fault.R_shunt(P)
    shunted = SeriesLoad(R=(R * R_shunt / (R + R_shunt), R, R))
    a = machine.ours(machine.Case("fault", machine.KW225, machine.KW225, fault))
    b = machine.ours(machine.Case("shunt", machine.KW225, shunted))
    assert machine.peak_error(a, b) < 1e-8
