"""The machine, healthy and faulted, against dpsim's (EMT, C++), at constant field voltage.

dpsim has no turn-to-turn short circuit: its healthy machine gets the equivalent shunt R-L from
the faulty phase's terminal to the neutral (:mod:`apu_casadi.machine.faults.ttsc`), which is exact.

dpsim's machine sees the voltage of one step before, an error of first order in the step.  Each
case is therefore run with two steps, and the value for a step of zero extrapolated; what the
shorter step itself gives is shown beside it.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np

from apu_casadi.core import simulation
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.machinedata import ExciterParameters, MachineParameters
from scenarios.validation.comparison import Row, SkippedError, check, section, timing
from scenarios.validation.peers.process import run_script

STEPS = (0.25e-6, 0.125e-6)  # s
T_SWITCH, T_END, SKIP = 1e-3, 6e-3, 0.5e-3  # s; two periods after the switch, less 0.5 ms
N_OUT = 500
OPEN = 1e9  # ohm
V_T = 229.677  # V rms, as in Table 7
KW225, KW100 = SeriesLoad.from_power(225e3), SeriesLoad.from_power(100e3)
SHORT = SeriesLoad(R=(1e-3, 1e-3, 1e-3))  # 1 mohm: 0.14 % of the base impedance


@dataclass(frozen=True)
class Case:
    """What happens at the switch: another load, or a fault."""

    label: str
    before: SeriesLoad
    after: SeriesLoad
    fault: Ttsc | None = None


CASES = (
    Case("load step 225 to 100 kW", KW225, KW100),
    Case("load step 100 to 225 kW", KW100, KW225),
    Case("three-phase short circuit, 1 mohm", KW225, SHORT),
    Case("fault in a, mu = 5 %, k_rf = 1, kappa = mu", KW225, KW225, Ttsc(0.05, 1.0)),
    Case("fault in b, mu = 5 %, k_rf = 1, kappa = 1", KW225, KW225, Ttsc(0.05, 1.0, 1.0, "b")),
)
SHOWN = (
    (
        "extrapolated to step 0",
        1e-6,
        "goal 1e-4; second-order rest of the extrapolation, and rounding",
    ),
    (
        "0.125 us steps",
        2e-4,
        "dpsim sees the voltage of the step before; 3e-4 rad in a step at 400 Hz",
    ),
)
"""What is shown of each case: how, tolerance, reason."""
ORDER = "one step of delay is of first order; anything else would be a modelling error"


def frozen_exciter() -> Generator:
    """Return the generator at constant field voltage.

    With T_E = 1e9 s and V_R within its limits of 7.3, E_fd moves by less than 1e-10 per unit in
    6 ms: it stays at its steady value, as in dpsim.
    """
    return Generator(exciter=ExciterParameters(T_E=1e9))


def instants() -> np.ndarray:
    """Return the output instants after the switch, s, on the grid of both steps."""
    return T_SWITCH + np.arange(1, N_OUT + 1) * (T_END - T_SWITCH) / N_OUT


def ours(case: Case) -> np.ndarray:
    """Return v_a, v_b, v_c and the winding currents i_a, i_b, i_c, shape (6, N_OUT).

    The effective current of the faulty phase, i - mu i_fault, is what the healthy machine with
    the shunt carries.
    """
    gen = frozen_exciter()
    # dpsim starts with the voltage of phase a at its crest: turn the rotor accordingly
    y = gen.steady_state(case.before, V_t=V_T).y
    axes = 2 * math.pi / 3 * np.arange(3)
    v_d = -2 / 3 * float(np.sin(axes) @ [y[f"v_{k}"] for k in "abc"])
    point = gen.steady_state(case.before, V_t=V_T, theta_e=math.atan2(v_d, y["v_a"]))
    x = simulation.stepper(point.ss, 1, rtol=1e-11, atol=1e-13)(
        point.x, point.u, [], T_SWITCH
    ).x_end
    ss = gen.variant(case.after, case.fault)
    u = gen.inputs(case.after, V_ref=point.V_ref)
    theta = gen.fault_vector(case.after, case.fault)
    x = gen.transfer(x, point.ss, ss, u=point.u, theta=[], u_target=u)
    run = simulation.stepper(ss, N_OUT, rtol=1e-11, atol=1e-13)
    out = ss.y.unpack(run(x, u, theta, T_END - T_SWITCH).y)
    values = np.array([out[f"{q}_{k}"] for q in "vi" for k in "abc"])
    if case.fault is not None:
        values[3 + "abc".index(case.fault.phase)] -= case.fault.mu * out["i_fault"]
    return values


def theirs(case: Case, p: MachineParameters) -> dict[str, Any]:
    """Return the case as the script wants it: per unit, and the switch as a parallel branch."""
    Z = 3 * p.V_rated_rms**2 / p.P_rated
    L = Z / p.w_rated
    per_unit = {n: getattr(p, n) / Z for n in ("r_s", "r_fd", "r_kd", "r_kq")}
    per_unit |= {n: getattr(p, n) / L for n in ("L_ls", "L_md", "L_mq", "L_lfd", "L_lkd", "L_lkq")}
    before, after = case.before.R[0], case.after.R[0]
    L_switch = None
    closed = False
    if case.fault is not None:
        k = "abc".index(case.fault.phase)
        R_switch = [OPEN] * 3
        R_switch[k] = case.fault.R_shunt(p)
        if case.fault.L_shunt(p) > 0:
            L_switch = [1e-3] * 3  # carries nothing in the other phases: their switch has OPEN
            L_switch[k] = case.fault.L_shunt(p)
    else:
        closed = after > before
        R_switch = [1 / abs(1 / before - 1 / after)] * 3
    rated = {"S": p.P_rated, "V_line": math.sqrt(3) * p.V_rated_rms, "f": p.f_rated}
    rated |= {"poles": 2 * p.n_pp, "P": 3 * V_T**2 / before, "V_peak": math.sqrt(2) * V_T}
    switch: dict[str, Any] = {"R_load": [max(before, after)] * 3, "R_switch": R_switch}
    switch |= {"L_switch": L_switch, "closed": closed, "t_switch": T_SWITCH, "t_end": T_END}
    return {"machine_pu": per_unit, **rated, **switch, "instants": instants().tolist()}


def peak_error(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest difference over each row's peak in ``b``, after the first 0.5 ms."""
    keep = instants() >= T_SWITCH + SKIP
    return float((np.abs(a - b)[:, keep].max(axis=1) / np.abs(b).max(axis=1)).max())


@section(
    "dpsim",
    "Machine against dpsim: load steps, short circuit, fault as its equivalent shunt",
    order=50,
)
def dpsim() -> list[Row]:
    """Compare voltages and winding currents of all phases after the first 0.5 ms.

    Raises:
        SkippedError: dpsim is not installed.
    """
    if find_spec("dpsimpy") is None:
        raise SkippedError("dpsim is not installed: pip install 'apu-casadi[peers]'")
    cases = [theirs(c, MachineParameters()) for c in CASES]
    answer = run_script(sys.executable, "dpsim_run.py", {"cases": cases, "steps": STEPS})
    rows = []
    seconds = 0.0
    for case, runs in zip(CASES, answer["runs"], strict=True):
        reference = ours(case)
        coarse, fine = (np.array(r["rows"]).T for r in runs)
        errors = [peak_error(x, reference) for x in (2 * fine - coarse, fine, coarse)]
        for (how, tolerance, reason), error in zip(SHOWN, errors, strict=False):
            rows.append(check(f"{case.label}, {how}", error, tolerance, reason))
        what, order = f"{case.label}, order of dpsim's error", math.log2(errors[2] / errors[1])
        rows.append(Row(what, "1", 1.0, order, order - 1, 0.05, ORDER, "check"))
        seconds += sum(r["seconds"] for r in runs)
    simulated = len(CASES) * len(STEPS) * T_END
    what = f"dpsim {answer['version']}, wall time for {simulated:.2f} s"
    return [*rows, timing(what, "s", seconds)]
