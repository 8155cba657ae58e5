"""Run the synchronous machine in dpsim: JSON on standard input, JSON on standard output.

A script, not a module of the package: dpsim prints from C++ and leaves a folder of logs, so
:mod:`scenarios.validation.peers.machine` gives it a process of its own.  It imports nothing of the
project.

``emt.ph3.SynchronGeneratorDQODE`` is the seven-winding machine with fundamental parameters in per
unit.  Its second damper of the q axis is put out of action by a leakage of 1e6 per unit, its rotor
held at speed by an inertia of 1e12 s; the field voltage stays what the start needs, since there is
no exciter.  It is coupled to the network by a current source that sees the voltage of the step
before: an error of first order in the step, which is why two steps are run.
"""

from __future__ import annotations

import json
import os
import sys
import time
from importlib.metadata import version
from typing import Any

import dpsimpy
import numpy as np

OPEN = 1e9  # ohm, an open switch
NO_WINDING = 1e6  # per unit, leakage of the second q damper
CONSTANT_SPEED = 1e12  # s, inertia constant
WINDINGS = {"Rs": "r_s", "Rfd": "r_fd", "Rkd": "r_kd", "Rkq1": "r_kq", "Ll": "L_ls", "Lmd": "L_md"}
WINDINGS |= {"Lmq": "L_mq", "Llfd": "L_lfd", "Llkd": "L_lkd", "Llkq1": "L_lkq"}
"""Resistances and inductances by dpsim's names."""


def network(case: dict[str, Any]) -> tuple[Any, Any, Any, Any]:
    """Return the system, the generator, its node, and the switch."""
    emt = dpsimpy.emt
    p = case["machine_pu"]
    generator = emt.ph3.SynchronGeneratorDQODE("generator", dpsimpy.LogLevel.off)
    rated = {"nom_power": case["S"], "nom_volt": case["V_line"], "nom_freq": case["f"]}
    rated |= {"pole_number": case["poles"], "nom_field_cur": 1.0, "inertia": CONSTANT_SPEED}
    windings = {theirs: p[ours] for theirs, ours in WINDINGS.items()}
    windings |= {"Rkq2": 1.0, "Llkq2": NO_WINDING}
    start = {"init_active_power": case["P"], "init_mech_power": case["P"]}
    start |= {"init_reactive_power": 0.0, "init_terminal_volt": case["V_peak"]}
    generator.set_parameters_fundamental_per_unit(**rated, **windings, **start, init_volt_angle=0.0)
    ground, terminal = emt.SimNode.gnd, emt.SimNode("terminal", dpsimpy.PhaseType.ABC)
    load = emt.ph3.Resistor("load")
    load.set_parameters(np.diag(case["R_load"]))
    switch = emt.ph3.Switch("switch")
    switch.set_parameters(np.eye(3) * OPEN, np.diag(case["R_switch"]), case["closed"])
    generator.connect([terminal])
    load.connect([ground, terminal])
    nodes, components = [terminal], [generator, load, switch]
    if case["L_switch"] is None:
        switch.connect([ground, terminal])
    else:
        behind = emt.SimNode("behind", dpsimpy.PhaseType.ABC)
        coil = emt.ph3.Inductor("coil")
        coil.set_parameters(np.diag(case["L_switch"]))
        switch.connect([behind, terminal])
        coil.connect([ground, behind])
        nodes.append(behind)
        components.append(coil)
    return dpsimpy.SystemTopology(case["f"], nodes, components), generator, terminal, switch


def run(case: dict[str, Any], dt: float) -> dict[str, Any]:
    """Simulate with one step; return terminal voltages and generator currents at the instants."""
    system, generator, terminal, switch = network(case)
    simulation = dpsimpy.Simulation("peer", dpsimpy.LogLevel.off)
    simulation.set_system(system)
    simulation.set_time_step(dt)
    simulation.set_final_time(case["t_end"] + 5 * dt)
    simulation.set_domain(dpsimpy.Domain.EMT)
    simulation.do_init_from_nodes_and_terminals(False)
    simulation.add_event(dpsimpy.event.SwitchEvent3Ph(case["t_switch"], switch, not case["closed"]))
    start = time.perf_counter()
    simulation.start()
    v, i = terminal.attr("v"), generator.attr("i_intf")
    # next() returns the time of the step to come: the values belong to one step before
    wanted = {round(t / dt) + 1 for t in case["instants"]}
    last, rows = max(wanted), []
    while True:
        k = round(simulation.next() / dt)
        if k in wanted:
            rows.append(np.concatenate([np.ravel(v.get()), -np.ravel(i.get())]).tolist())
        if k >= last:
            break
    simulation.stop()
    return {"dt": dt, "rows": rows, "seconds": time.perf_counter() - start}


if __name__ == "__main__":
    given: dict[str, Any] = json.load(sys.stdin)
    keep: int = os.dup(1)
    os.dup2(2, 1)  # dpsim prints to the C++ standard output, which is for the JSON alone
    answer = [[run(case, dt) for dt in given["steps"]] for case in given["cases"]]
    sys.stdout.flush()
    os.dup2(keep, 1)
    json.dump({"version": version("dpsim"), "runs": answer}, sys.stdout)
