"""Other programs on the same cases: dpsim's machine, pyCycle's cycle, filterpy's filter."""

from __future__ import annotations

import math
import sys
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from apu_casadi.core import simulation
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.machine.machinedata import MachineParameters
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.ukf import unscented_kalman_filter
from scenarios.bench.measuring import Row, Size, part, timed
from scenarios.studies import jointrun
from scenarios.studies.electrical.protocol import FULL
from scenarios.studies.electrical.steptime import filterpy_step_us, speed
from scenarios.studies.electrical.truth import generator_truth, samples_of
from scenarios.validation.comparison import SkippedError
from scenarios.validation.peers import cycle, machine
from scenarios.validation.peers.process import run_script


@part("dpsim", order=50, peer=True)
def dpsim(size: Size) -> list[Row]:
    """The machine's load step against dpsim, at the accuracy that dpsim reaches."""
    if find_spec("dpsimpy") is None:
        raise SkippedError("dpsim is not installed")
    case, n = machine.CASES[0], machine.N_OUT
    given = {"cases": [machine.theirs(case, MachineParameters())], "steps": machine.STEPS[1:]}
    answer = run_script(sys.executable, "dpsim_run.py", given)
    result = answer["runs"][0][0]
    exact = machine.ours(case)
    error = machine.peak_error(np.array(result["rows"]).T, exact)
    gen = machine.frozen_exciter()
    # the same start as in ours(): the crest of phase a
    y = gen.steady_state(case.before, V_t=machine.V_T).y
    axes = 2 * math.pi / 3 * np.arange(3)
    v_d = -2 / 3 * float(np.sin(axes) @ [y[f"v_{k}"] for k in "abc"])
    p = gen.steady_state(case.before, V_t=machine.V_T, theta_e=math.atan2(v_d, y["v_a"]))
    ss = gen.variant(case.after, case.fault)
    u = gen.inputs(case.after, V_ref=p.V_ref)

    def run(rtol: float) -> np.ndarray:
        first = simulation.stepper(p.ss, 1, rtol=rtol, atol=1e-2 * rtol)
        then = simulation.stepper(ss, n, rtol=rtol, atol=1e-2 * rtol)
        x = first(p.x, p.u, [], machine.T_SWITCH).x_end
        x = gen.transfer(x, p.ss, ss, u=p.u, theta=[], u_target=u)
        out = ss.y.unpack(then(x, u, [], machine.T_END - machine.T_SWITCH).y)
        return np.array([out[f"{q}_{k}"] for q in "vi" for k in "abc"])

    for rtol in (1e-5, 1e-6, 1e-7, 1e-8):
        run(rtol)
        wall, mine = timed(partial(run, rtol), max(size.repeats, 20))
        ours = machine.peak_error(mine, exact)
        if ours <= error:
            break
    what, ms = "machine: load step of 225 to 100 kW, 6 ms", 1e3 * wall
    text = f"largest over the peak, CVODES at 1e-11; dpsim's, with 0.125 us: {error:.1e}"
    them = f"dpsim {answer['version']}, {1e3 * result['seconds']:.0f} ms"
    ratio = result["seconds"] / wall
    return [Row(what, ms, "ms", None, ours, error, text, peer=them, ratio=ratio)]


@part("pycycle", order=51, peer=True)
def pycycle(size: Size) -> list[Row]:
    """One trim against pyCycle, off design, by the engine that the validation uses."""
    gg = cycle.engine()
    (answer,) = cycle.run_pycycle(gg, cycle.SMOOTH)
    cycle.trimmed(gg)
    N, (_, PW, at) = gg.parameters.N, cycle.POINTS[1]
    ambient: dict[str, Any] = dict(at)
    wall, _ = timed(
        lambda: trim_gas_generator(gg, {"N": N, "PW": PW}, **ambient), max(size.repeats, 20)
    )
    error = 0.0
    for mine, theirs in zip(cycle.trimmed(gg), answer["points"], strict=True):
        keys = [k for k in cycle.COMPARED if k in theirs]
        error = max(error, *(abs(mine[k] / theirs[k] - 1) for k in keys))
    s = answer["seconds"]
    each = (s["all"] - s["first"]) / (len(answer["points"]) - 1)
    tolerance, reason = cycle.LINE_TOLERANCE
    version = answer["versions"]["om-pycycle"]
    them = f"pyCycle {version}, {each:.1f} s a further point ({s['first']:.1f} s with the first)"
    what, text = "trim of the engine with plain maps and NASA-9 gas", "relative, pyCycle's answers"
    more: dict[str, Any] = {"peer": them, "ratio": each / wall}
    return [Row(what, 1e3 * wall, "ms", None, error, tolerance, f"{text}; {reason}", **more)]


@part("estimation", order=40)
def estimation(size: Size) -> list[Row]:
    """A step of the electrical EKF and UKF in generated C, filterpy's UKF, and the joint estimate.

    Fastest of some: a filter step is micro-seconds, and anything else that runs only adds to it.
    """
    steps = speed(repeat=size.repeats)
    name, fastest = next(iter(steps["rows"].items()))
    peer = filterpy_step_us(repeat=max(1, size.repeats // 2))
    samples = samples_of(generator_truth(FULL, 0.05), np.random.default_rng(0))
    filt = electrical_filter()
    data, prior = filt.recording(samples), filt.prior(samples)
    rows = []
    for kind, run_filter in (("ekf", extended_kalman_filter), ("ukf", unscented_kalman_filter)):
        c, vm = (run_filter(filt.model, prior, data, backend=b) for b in ("auto", "vm"))
        error = float((np.abs(c.mean - vm.mean) / np.sqrt(vm.variance)).max())
        us, goal = fastest[f"{kind}_us"], steps["goal_us"][kind]
        more: dict[str, Any] = {}
        if kind == "ukf" and peer is not None:
            more = {"peer": "filterpy's UKF, same functions", "ratio": peer / us}
        what = f"step of the electrical {kind.upper()}, {name}"
        text = "means against the virtual machine's, in standard deviations"
        rows.append(Row(what, us, "us", goal, error, 1e-6, text, **more))
    joint = jointrun.joint_seconds(repeat=max(1, size.repeats // 2))
    ends = jointrun.report(jointrun.estimate(jointrun.truth("joint"), 1))["phases"]
    error = max(
        abs(v["estimate"] - v["true"]) / (v["half_width"] / jointrun.Z95)
        for p in ends
        for v in p["values"].values()
    )
    what = f"joint estimation of {joint['simulated']:g} s, electrical and gas path"
    text = "largest error at the ends of the phases, in claimed standard deviations"
    return [*rows, Row(what, joint["seconds"], "s", 5.0, error, 4.0, text)]
