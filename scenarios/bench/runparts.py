"""Joint runs: one, many, a long one; and the first result from the shell."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.calling import available_threads
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.unit.multirate import simulate_joint
from apu_casadi.unit.runsummary import phase_summary
from scenarios import registry
from scenarios.bench.measuring import Row, Size, apu, child, part, python, timed
from scenarios.campaigns import TOGETHER, counts, random_faults, run_campaign
from scenarios.schema import Scenario

if TYPE_CHECKING:
    import xarray as xr

SKIP = 0.5e-3  # s after an event that comparisons of waveforms leave out
TIGHT = 1e-10  # tolerance of the reference


def simulate(s: Scenario, **how: Any) -> xr.Dataset:
    """Run a scenario with the paper's unit."""
    how = {"waveform_dt": s.waveform_dt, "dt": s.dt, "ambient": s.ambient, **how}
    return simulate_joint(apu(), duration=s.duration, **s.start(), events=s.events(), **how)


SLOW = tuple(["N", "PW", "T4", "V_a_rms", "V_b_rms", "V_c_rms", "I_a_rms", "I_b_rms", "I_c_rms"])
FAST = tuple(["v_a", "v_b", "v_c", "i_a", "i_b", "i_c", "V_fd", "i_fd", "T_e", "P_inst"])


def errors(
    ds: Mapping[str, np.ndarray], ref: Mapping[str, np.ndarray], events: Sequence[float]
) -> dict[str, float]:
    """Return largest differences over the peak: of waveforms (0.5 ms after events left out), N, V.

    The arrays are by name, with ``time`` and ``time_w``; waveforms may be absent.
    """
    out = {}
    for n in SLOW:
        out[n] = float(np.abs(ds[n] - ref[n]).max() / np.abs(ref[n]).max())
    if "time_w" in ds:
        t = ref["time_w"]
        keep = np.ones(t.size, bool)
        for e in events:
            keep &= ~((t > e - 1e-9) & (t < e + SKIP))
        for n in FAST:
            out[n] = float(np.abs(ds[n] - ref[n])[keep].max() / np.abs(ref[n]).max())
    return out


def _arrays(ds: xr.Dataset) -> dict[str, np.ndarray]:
    names = [n for n in ("time", "time_w", *SLOW, *FAST) if n in ds.variables]
    return {n: ds[n].values for n in names}


def _worst(e: Mapping[str, float], names: Sequence[str]) -> float:
    return max((e[n] for n in names if n in e), default=0.0)


@part("joint", order=30)
def joint(size: Size) -> list[Row]:
    """The joint run with waveforms, with summaries only, and in the virtual machine."""
    s = size.joint
    instants = [0.0, *(e.t for e in s.events())]
    kept = _arrays(simulate(s, solver="cvodes", rtol=TIGHT, atol=1e-2 * TIGHT))
    rows = []
    measure = "largest over the peak, CVODES at 1e-10: "
    for label, target, how in (
        ("50 us waveforms", 100.0, {}),
        ("summary outputs only", 300.0, {"waveform_dt": None}),
    ):
        for _ in range(2):  # the first compiles and loads, the second still faults memory in
            simulate(s, solver="propagator", **how)
        wall, ds = timed(partial(simulate, s, solver="propagator", **how), size.repeats)
        e = errors(_arrays(ds), kept, instants)
        what = f"joint {s.duration:g} s scenario, {label}"
        text = f"N {e['N']:.0e}, V rms {_worst(e, SLOW[3:6]):.0e}"
        error = _worst(e, SLOW)
        if not how:
            error = max(error, _worst(e, FAST))
            text = f"waveforms {_worst(e, FAST):.1e}, {text}"
        rate, text = s.duration / wall, measure + text
        rows.append(Row(what, rate, "x real time", target, error, 1e-5, text, more=True))
        if not how:
            rows += _virtual_machine(s, kept, instants, size.repeats)
    wall, _ = timed(lambda: simulate(s, solver="cvodes"), 1)
    first = rows[0]
    rows[0] = dataclasses.replace(
        first, peer="CVODES at 1e-8, same run", ratio=wall * first.value / s.duration
    )
    return rows


def _virtual_machine(
    s: Scenario, kept: Mapping[str, np.ndarray], instants: Sequence[float], repeats: int
) -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ref.npz"
        arrays: dict[str, Any] = dict(kept)
        np.savez(path, **arrays)
        case: dict[str, Any] = {"scenario": s.to_dict(), "ref": str(path), "events": list(instants)}
        case["repeats"] = min(repeats, 3)
        answer = child(run_without_compiler, case, APU_BACKEND="vm")
    what = f"joint {s.duration:g} s scenario, 50 us, virtual machine, no compiler"
    rate, text = s.duration / answer["seconds"], "largest over the peak, as above"
    return [Row(what, rate, "x real time", 15.0, answer["error"], 1e-5, text, more=True)]


def run_without_compiler(case: dict[str, Any]) -> dict[str, Any]:
    """Time the joint run in a process whose functions are not compiled."""
    s = Scenario.from_dict(case["scenario"])
    simulate(s.change(duration=s.duration), solver="propagator")
    wall, ds = timed(lambda: simulate(s, solver="propagator"), case["repeats"])
    with np.load(case["ref"]) as ref:
        e = errors(_arrays(ds), {n: ref[n] for n in ref.files}, case["events"])
    return {"seconds": wall, "error": max(e.values())}


@part("campaign", order=32)
def campaign(size: Size) -> list[Row]:
    """Many joint runs with random faults on two cores."""
    workers = min(2, available_threads())
    scenarios = random_faults(size.runs, seed=1, base=size.joint)
    # compiles all variants in lanes too, which each process would otherwise do while it is timed
    run_campaign(scenarios[: min(2 * TOGETHER, size.runs)], workers=workers)
    t = time.perf_counter()
    ds = run_campaign(scenarios, workers=workers)
    wall = time.perf_counter() - t
    n = counts(ds)
    error = 0.0
    for i in range(min(size.checked, size.runs)):
        s = scenarios[i].change(waveform_dt=None)
        reference = phase_summary(registry.run(s, solver="cvodes"))
        for j, row in enumerate(reference):
            for k in ("N_rpm", "PW_kW", "T4", "V_a_rms", "I_a_rms", "N_rpm_min", "N_rpm_max"):
                error = max(error, abs(float(ds[k][i, j]) / row[k] - 1))
    if n["done"] + n["refused"] + n["failed"] != len(scenarios) or n["crashed"]:
        error = math.inf
    said = f"{n['done']} done, {n['refused'] + n['failed']} refused with a reason"
    what = f"{size.runs} joint runs with random faults, {workers} cores"
    text = f"phase summaries of {min(size.checked, size.runs)} against CVODES; {said}"
    target = 0.15 * size.runs if size.runs >= 100 else None
    return [Row(what, wall, "s", target, error, 1e-4, text)]


@part("memory", order=31)
def memory(size: Size) -> list[Row]:
    """Peak memory of a long run that keeps no waveforms, in a process of its own."""
    s = size.joint.change(duration=size.hour, waveform_dt=None)
    answer = child(run_long, {"scenario": s.to_dict()})
    hours, text = size.hour / 3600, "speed at the end against governed speed"
    what = f"memory, {hours:.2g} h run without waveforms ({answer['seconds']:.0f} s)"
    return [Row(what, answer["MB"], "MB", 500.0, answer["error"], 1e-8, text)]


def run_long(case: dict[str, Any]) -> dict[str, Any]:
    """Run a scenario; return the time, the largest memory, and how far the speed is off."""
    s = Scenario.from_dict(case["scenario"])
    wall, ds = timed(lambda: simulate(s, solver="propagator"), 1)
    N = ds["N"].values
    return {"seconds": wall, "MB": peak_memory(), "error": abs(float(N[-1] / apu().N_ref) - 1)}


def peak_memory() -> float:
    """Largest resident memory of this process so far, MB.

    ``ru_maxrss`` would also count what the process that started this one held.
    """
    try:
        for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
            if line.startswith("VmHWM:"):
                return float(line.split()[1]) / 1024
    except OSError:
        pass
    import resource

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most / 2**20 if sys.platform == "darwin" else most / 1024


@part("shell", order=20)
def shell(size: Size) -> list[Row]:
    """Import, and the first result from the shell, each in a new process."""
    import_s, _ = timed(lambda: python("import apu_casadi"), size.repeats)
    whole = "from apu_casadi import Apu, simulate_joint, trim"
    whole_s, _ = timed(lambda: python(whole), size.repeats)
    given = {"altitude": 8000, "mach": 0.7, "disa": 5, "power": 221821.5}
    argv = ["trim", *(f"--{k}={v}" for k, v in given.items()), "--json"]
    code = f"import sys; from scenarios.cli import main; sys.exit(main({argv!r}))"
    trim_s, text = timed(lambda: python(code), size.repeats)

    gg = apu().gas_generator
    point = trim_gas_generator(
        gg, {"N": gg.parameters.N, "PW": 221821.5}, altitude=8e3, Mach=0.7, dT_isa=5.0
    )
    error = abs(json.loads(text)["outputs"]["T4"] / point["T4"] - 1)
    nothing, first = "nothing is computed", "first result of `apu trim` from the shell"
    return [
        Row("import of apu_casadi, interpreter included", import_s, "s", 0.6, 0.0, 0.0, nothing),
        Row("import of Apu, simulate_joint, trim", whole_s, "s", None, 0.0, 0.0, nothing),
        Row(first, trim_s, "s", 1.5, error, 1e-10, "T4 against a trim here"),
    ]
