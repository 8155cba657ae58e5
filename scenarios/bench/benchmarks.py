"""Measure what the package promises to be fast at, with the accuracy of every measured answer.

Times are medians, each part's ratios taken in one run; compiling and loading happen before.  An
answer that is fast and wrong counts as missed: every row has the error of the very results that
were timed, against something slower that shares as little as possible with them.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import ScenarioError, SimulationError, nearest
from apu_casadi.core.sharing import once
from scenarios import registry
from scenarios.schema import Scenario
from scenarios.shell import markdown
from scenarios.shell.computer import machine

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from apu_casadi.unit.apu import Apu

SKIP = 0.5e-3  # s after an event that comparisons of waveforms leave out
TIGHT = 1e-10  # tolerance of the reference


@dataclass(frozen=True)
class Size:
    """How much is measured; the default is what the targets ask for.

    Args:
        trims, batch: single trims, points of a batch.
        deck: points along altitude, Mach, ISA deviation, power.
        calls: calls of f and g with Jacobians, and of the linearisation a tenth of them.
        joint: the joint scenario that is timed.
        repeats: timings of each, of which the median counts.
        runs, checked: runs of the campaign, and how many of them CVODES runs again.
        hour: duration of the long run, s.
        durations, counts, rates: of the linearity plot: s, runs (each has faults of its own, which
            cost more or less; many even that out), samples per second.  Waveforms below 20 kHz are
            computed at 20 kHz and thinned, so lower rates cost what that costs.
    """

    trims: int = 300
    batch: int = 10_000
    deck: tuple[int, int, int, int] = (10, 10, 10, 100)
    calls: int = 3000
    joint: Scenario = dataclasses.field(default_factory=lambda: registry.get("joint"))
    repeats: int = 5
    runs: int = 1000
    checked: int = 2
    hour: float = 3600.0
    durations: tuple[float, ...] = (14.0, 28.0, 56.0, 84.0, 112.0)
    counts: tuple[int, ...] = (8, 16, 32, 64, 96)
    rates: tuple[float, ...] = (0.0, 20e3, 40e3, 60e3, 80e3)


@dataclass(frozen=True)
class Row:
    """One measured quantity.

    Args:
        what: in words.
        value, unit: the figure; a time, a multiple of real time, or a size.
        target: what it should be at most, or at least where ``more``; None without one.
        error, error_target: accuracy of the answers that were timed, and what it may be.
        measure: what the error is, in words.
        peer, ratio: what it was compared with, and how many times faster than that.
    """

    what: str
    value: float
    unit: str
    target: float | None
    error: float
    error_target: float
    measure: str
    more: bool = False
    peer: str = ""
    ratio: float | None = None

    @property
    def accurate(self) -> bool:
        """Whether the error is what it may be; NaN is not."""
        return self.error <= self.error_target

    @property
    def met(self) -> bool:
        """Whether figure and accuracy are both as they should be."""
        if self.target is None:
            return self.accurate
        fast = self.value >= self.target if self.more else self.value <= self.target
        return fast and self.accurate


def timed(call: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Return the median time of some calls, s, and the last result."""
    times = []
    result = None
    for _ in range(repeats):
        t = time.perf_counter()
        result = call()
        times.append(time.perf_counter() - t)
    return median(times), result


@once
def _apu() -> Apu:
    from apu_casadi.unit.apu import Apu

    return Apu()


# ------------------------------------------------------------------------------ gas generator


def trim(size: Size) -> list[Row]:
    """Single trims one by one, cold, and a batch on one core."""
    from apu_casadi.gaspath.steady.steadypoint import Status
    from apu_casadi.gaspath.steady.trimbatch import trim_batch
    from apu_casadi.gaspath.steady.trimming import trim_gas_generator
    from scenarios.studies import trim_study

    gg = _apu().gas_generator
    asked = trim_study.sample(gg, max(size.batch, size.trims), seed=2)
    fixed, theta = asked.pop("fixed"), asked.pop("theta")
    trim_study.run(400, gg=gg, n_threads=1)  # compile, load
    wall, batch = timed(
        lambda: trim_batch(gg, fixed, theta=theta, n_threads=1, **asked), min(size.repeats, 3)
    )  # fmt: skip
    solved = np.flatnonzero(batch.status == Status.SOLVED)
    residual = float(trim_study.recheck(gg, batch)[solved].max())
    times, differences, newton = [], [], []
    root = _plain_newton(gg)
    for k, i in enumerate(solved[: size.trims]):
        ambient = {n: float(v[i]) for n, v in asked.items()}
        health = {n: float(v[i]) for n, v in theta.items()}
        N, PW = float(fixed["N"]), float(fixed["PW"][i])
        t = time.perf_counter()
        point = trim_gas_generator(gg, {"N": N, "PW": PW}, theta=health, **ambient)
        times.append(time.perf_counter() - t)
        if k % 10 == 0:  # the slow one only for a tenth
            t = time.perf_counter()
            z, Wf, ok = root(N, PW, ambient, health)
            if ok:
                newton.append(time.perf_counter() - t)
                differences.append(
                    max(float(np.abs(z / point.z - 1).max()), abs(Wf / point["Wf"] - 1))
                )
    one = median(times)
    return [
        Row("trim, one call from Python, cold", 1e3 * one, "ms", 1.0, max(differences), 1e-8,
            f"relative, against a plain Newton method in Python ({len(differences)} points)",
            peer="that Newton method", ratio=median(newton) / one),
        Row(f"trim, batch of {size.batch} points, a point", 1e6 * wall / len(batch), "us", 50.0,
            residual, 1e-9, "largest residual of the plain equations"),
    ]  # fmt: skip


def _plain_newton(gg: GasGenerator) -> Callable[..., tuple[np.ndarray, float, bool]]:
    """Newton's method in Python around the plain equations with CasADi's own derivatives."""
    import casadi as ca

    from apu_casadi.core.rootfinding import Newton
    from apu_casadi.gaspath.conditions import DEFAULT_DAY

    n = len(gg.z)
    scale = np.append(gg.z.nominals, gg.design.values["Wf"])
    q, p = ca.MX.sym("q", n + 1), ca.MX.sym("p", 10)
    x, PW = p[0], p[1]
    z, Wf = q[:n], q[n]
    _, alg, y = gg.equations(x, z, ca.vertcat(Wf, PW, p[2:6]), p[6:])
    balance = y[gg.Y.index("P_acceleration")] / 5e5
    F = ca.Function("plain", [q, p], [ca.vertcat(alg, balance)])
    newton = Newton(F, scale=scale, lower=1e-3 * np.minimum(scale, 1.0), tol=1e-10)
    names = tuple(DEFAULT_DAY)

    def solve(
        N: float, PW: float, ambient: Mapping[str, float], health: Mapping[str, float]
    ) -> tuple[np.ndarray, float, bool]:
        air = [ambient.get(k, DEFAULT_DAY[k]) for k in names]
        given = np.array([N, PW, *air, *(health[k] for k in gg.THETA.names)])
        guess = gg.design.values["Wf"] * max(0.2, PW / 5e5)
        z0 = np.asarray(gg.similar(N, [guess, PW, *air])).ravel()
        r = newton(np.append(z0, guess), given)
        return r.x[:n], float(r.x[n]), r.success

    return solve


def deck(size: Size) -> list[Row]:
    """A performance deck on all cores, two at most."""
    from apu_casadi.core.calling import available_threads
    from apu_casadi.gaspath.steady.steadypoint import Status
    from apu_casadi.gaspath.steady.trimbatch import performance_deck, trim_batch
    from scenarios.studies import trim_study

    gg = _apu().gas_generator
    threads = min(2, available_threads())
    ends = ((0.0, 12e3), (0.0, 0.8), (-30.0, 35.0), (0.0, 5e5))
    names = ("altitude", "Mach", "dT_isa", "PW")
    axes: dict[str, Any] = {
        n: np.linspace(*e, k) for n, e, k in zip(names, ends, size.deck, strict=True)
    }
    performance_deck(gg, altitude=[0.0], PW=np.linspace(0, 1e9, 400), n_threads=threads)
    wall, made = timed(lambda: performance_deck(gg, **axes, n_threads=threads), 1)
    points = math.prod(size.deck)
    rng = np.random.default_rng(0)
    at = tuple(rng.integers(0, k, min(2000, points)) for k in size.deck)
    given: dict[str, Any] = {n: axes[n][i] for n, i in zip(names, at, strict=True)}
    PW = given.pop("PW")
    again = trim_batch(gg, {"N": gg.parameters.N, "PW": PW}, n_threads=threads, **given)
    ok = again.status == Status.SOLVED
    same = np.array_equal(ok, made["status"].values[at] == Status.SOLVED)
    off = float(np.abs(made["T4"].values[at][ok] / again["T4"][ok] - 1).max(initial=0.0))
    residual = float(trim_study.recheck(gg, again)[ok].max(initial=0.0))
    unexplained = int((made["status"].values == Status.UNEXPLAINED).sum())
    share = 100 * float((made["status"].values == Status.SOLVED).mean())
    error = max(residual, off) if same and not unexplained else math.inf
    return [
        Row(f"performance deck of {points} points ({share:.0f} % exist) on {threads} cores", wall,
            "s", 10.0, error, 1e-9,
            f"residual of the plain equations at {at[0].size} of them; none unexplained")
    ]  # fmt: skip


def derivatives(size: Size) -> list[Row]:
    """F and g of the gas generator with Jacobians by state, inputs and health, compiled."""
    import casadi as ca

    from apu_casadi.core.backend import compiled
    from apu_casadi.core.calling import Caller
    from apu_casadi.gaspath.steady.trimming import trim_gas_generator

    gg = _apu().gas_generator
    cycle = gg.cycle
    x, z0, u, theta = cycle.symbols()
    z = cycle.solve(z0, x, u, theta)
    outs = cycle.sensitivities(x, z, u, theta)
    dense = [ca.densify(o) for o in (*outs, z)]
    F = ca.Function("f_g_jacobians", [x, z0, u, theta], dense)
    call = Caller(compiled(F), copy=False)
    point = trim_gas_generator(gg, {"N": gg.parameters.N, "PW": 4e5})
    rng = np.random.default_rng(0)
    w0 = np.concatenate([point.x, point.u, point.theta])
    spread = 1e-3 * np.concatenate([gg.X.nominals, gg.U.nominals, gg.THETA.nominals])
    spread[len(point.x) + 2] = 50.0  # m of altitude
    W = w0 + spread * np.abs(rng.standard_normal((200, w0.size)))
    W[:, len(point.x) + 5] = 0.0  # dry air
    nx, nu = len(point.x), len(point.u)
    parts = [(w[:nx], w[nx : nx + nu], w[nx + nu :]) for w in W]
    for a, b, c in parts[:20]:
        call(a, point.z, b, c)
    times = []
    for k in range(size.calls):
        a, b, c = parts[k % len(parts)]
        t = time.perf_counter()
        call(a, point.z, b, c)
        times.append(time.perf_counter() - t)
    error = 0.0
    smooth = [i for i, n in enumerate(gg.Y.names) if n not in ("off_c", "off_t", "residual")]
    for a, b, c in parts[:3]:
        xdot, _, xdot_w, y_w, _, _ = (np.array(v) for v in call(a, point.z, b, c))
        J = np.vstack([xdot_w.reshape(1, -1), y_w[smooth]])
        fd = _central(gg, a, b, c, point.z, smooth)
        scale = np.abs(J * spread).max(axis=1, keepdims=True) + 1e-300
        error = max(error, float((np.abs(J - fd) * spread / scale).max()))
        del xdot
    return [
        Row("f and g with Jacobians by state, inputs, health", 1e6 * median(times), "us", 30.0,
            error, 1e-6, "against central differences of the plain equations, relative to the "
            "largest entry of the row in nominal units")
    ]  # fmt: skip


def _central(
    gg: GasGenerator, x: np.ndarray, u: np.ndarray, theta: np.ndarray, z0: np.ndarray,
    rows: Sequence[int],
) -> np.ndarray:  # fmt: skip
    """Jacobian of (xdot, y) by (x, u, theta) by central differences of order four."""
    w = np.concatenate([x, u, theta])
    h = 2e-4 * np.concatenate([gg.X.nominals, gg.U.nominals, gg.THETA.nominals])
    nx, nu = x.size, u.size
    # the standard atmosphere, at sea level, has no kink within these steps
    h[nx + 2], h[nx + 3], h[nx + 4], h[nx + 5] = 2.0, 1e-3, 0.05, 1e-4

    def value(v: np.ndarray) -> np.ndarray:
        a, b, c = v[:nx], v[nx : nx + nu], v[nx + nu :]
        z = gg.solve(z0, a, b, c)
        ode, _, y = gg.equations(a, z, b, c)
        return np.concatenate([np.asarray(ode).ravel(), np.asarray(y).ravel()[list(rows)]])

    J = np.empty((1 + len(rows), w.size))
    for k in range(w.size):
        e = np.zeros(w.size)
        e[k] = h[k]
        near, far = value(w + e) - value(w - e), value(w + 2 * e) - value(w - 2 * e)
        J[:, k] = (8 * near - far) / (12 * h[k])
    return J


def linearisation(size: Size) -> list[Row]:
    """The joint model's linearisation at a trim."""
    from apu_casadi.machine.loads.series import SeriesLoad
    from apu_casadi.unit.averaged import joint_vectors
    from apu_casadi.unit.linearisation import linearise_joint

    apu = _apu()
    point = apu.steady_state(SeriesLoad.from_power(100e3))
    linearise_joint(apu, point)
    wall, model = timed(lambda: linearise_joint(apu, point), max(3, size.calls // 30))
    ss, x, u, theta = joint_vectors(apu, point)
    nominal = ss.x.nominals
    A = np.empty_like(model.A)
    for k in range(x.size):
        h = np.zeros(x.size)
        h[k] = 1e-4 * nominal[k]
        d = [np.asarray(ss.f(x + s * h, u, theta)).ravel() for s in (1, -1, 2, -2)]
        A[:, k] = (8 * (d[0] - d[1]) - (d[2] - d[3])) / (12 * h[k])
    scale = np.abs(model.A * nominal).max(axis=1, keepdims=True)
    error = float((np.abs(A - model.A) * nominal / scale).max())
    return [
        Row("linearisation of the joint model at a trim", 1e3 * wall, "ms", 2.0, error, 1e-6,
            "state matrix against central differences, relative to the largest entry of the row "
            "in nominal units")
    ]  # fmt: skip


# ------------------------------------------------------------------------------ joint run


def _simulate(s: Scenario, **how: Any) -> xr.Dataset:
    from apu_casadi.unit.multirate import simulate_joint

    how = {"waveform_dt": s.waveform_dt, **how}
    return simulate_joint(
        _apu(), duration=s.duration, **s.start(), ambient=s.ambient, events=s.events(), dt=s.dt,
        **how,
    )  # fmt: skip


SLOW = ("N", "PW", "T4", "V_a_rms", "V_b_rms", "V_c_rms", "I_a_rms", "I_b_rms", "I_c_rms")
FAST = ("v_a", "v_b", "v_c", "i_a", "i_b", "i_c", "V_fd", "i_fd", "T_e", "P_inst")


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


def joint(size: Size) -> list[Row]:
    """The joint run with waveforms, with summaries only, and in the virtual machine."""
    s = size.joint
    instants = [0.0, *(e.t for e in s.events())]
    kept = _arrays(_simulate(s, solver="cvodes", rtol=TIGHT, atol=1e-2 * TIGHT))
    rows = []
    measure = "largest over the peak, CVODES at 1e-10: "
    for label, target, how in (
        ("50 us waveforms", 100.0, {}),
        ("summary outputs only", 300.0, {"waveform_dt": None}),
    ):
        for _ in range(2):  # the first compiles and loads, the second still faults memory in
            _simulate(s, solver="propagator", **how)
        wall, ds = timed(partial(_simulate, s, solver="propagator", **how), size.repeats)
        e = errors(_arrays(ds), kept, instants)
        what = f"joint {s.duration:g} s scenario, {label}"
        text = f"N {e['N']:.0e}, V rms {_worst(e, SLOW[3:6]):.0e}"
        error = _worst(e, SLOW)
        if not how:
            error = max(error, _worst(e, FAST))
            text = f"waveforms {_worst(e, FAST):.1e}, {text}"
        rows.append(
            Row(what, s.duration / wall, "x real time", target, error, 1e-5, measure + text,
                more=True)
        )  # fmt: skip
        if not how:
            rows += _virtual_machine(s, kept, instants, size.repeats)
    wall, _ = timed(lambda: _simulate(s, solver="cvodes"), 1)
    first = rows[0]
    rows[0] = dataclasses.replace(
        first, peer="CVODES at 1e-8, same run", ratio=wall * first.value / s.duration
    )
    return rows


def _virtual_machine(
    s: Scenario, kept: Mapping[str, np.ndarray], instants: Sequence[float], repeats: int
) -> list[Row]:  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ref.npz"
        arrays: dict[str, Any] = dict(kept)
        np.savez(path, **arrays)
        case = {"scenario": s.to_dict(), "ref": str(path), "events": list(instants)}
        answer = _child("virtual_machine", {**case, "repeats": min(repeats, 3)}, APU_BACKEND="vm")
    return [
        Row(f"joint {s.duration:g} s scenario, 50 us, virtual machine, no compiler",
            s.duration / answer["seconds"], "x real time", 15.0, answer["error"], 1e-5,
            "largest over the peak, as above", more=True)
    ]  # fmt: skip


def _child_virtual_machine(case: dict[str, Any]) -> dict[str, Any]:
    s = Scenario.from_dict(case["scenario"])
    _simulate(s.change(duration=s.duration), solver="propagator")
    wall, ds = timed(lambda: _simulate(s, solver="propagator"), case["repeats"])
    with np.load(case["ref"]) as ref:
        e = errors(_arrays(ds), {n: ref[n] for n in ref.files}, case["events"])
    return {"seconds": wall, "error": max(e.values())}


def campaign(size: Size) -> list[Row]:
    """Many joint runs with random faults on two cores."""
    from apu_casadi.core.calling import available_threads
    from apu_casadi.core.results import phase_summary
    from scenarios.campaigns import counts, random_faults, run_campaign

    workers = min(2, available_threads())
    scenarios = random_faults(size.runs, seed=1, base=size.joint)
    run_campaign(scenarios[: min(12, size.runs)], workers=workers)  # compile all variants
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
    return [
        Row(f"{size.runs} joint runs with random faults, {workers} cores", wall, "s",
            0.15 * size.runs if size.runs >= 100 else None, error, 1e-4,
            f"phase summaries of {min(size.checked, size.runs)} against CVODES; {said}")
    ]  # fmt: skip


def memory(size: Size) -> list[Row]:
    """Peak memory of a long run that keeps no waveforms, in a process of its own."""
    s = size.joint.change(duration=size.hour, waveform_dt=None)
    answer = _child("memory", {"scenario": s.to_dict()})
    return [
        Row(f"memory, {size.hour / 3600:.2g} h run without waveforms ({answer['seconds']:.0f} s)",
            answer["MB"], "MB", 500.0, answer["error"], 1e-8,
            "speed at the end against governed speed")
    ]  # fmt: skip


def _child_memory(case: dict[str, Any]) -> dict[str, Any]:
    s = Scenario.from_dict(case["scenario"])
    wall, ds = timed(lambda: _simulate(s, solver="propagator"), 1)
    N = ds["N"].values
    return {"seconds": wall, "MB": peak_memory(), "error": abs(float(N[-1] / _apu().N_ref) - 1)}


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


# ------------------------------------------------------------------------------ shell


def shell(size: Size) -> list[Row]:
    """Import, and the first result from the shell, each in a new process."""
    import_s, _ = timed(lambda: _python("import apu_casadi"), size.repeats)
    whole_s, _ = timed(
        lambda: _python("from apu_casadi import Apu, simulate_joint, trim"),
        size.repeats,
    )
    argv = ["trim", "--altitude", "8000", "--mach", "0.7", "--disa", "5", "--power", "221821.5",
            "--json"]  # fmt: skip
    code = f"import sys; from scenarios.cli import main; sys.exit(main({argv!r}))"
    trim_s, text = timed(lambda: _python(code), size.repeats)
    from apu_casadi.gaspath.steady.trimming import trim_gas_generator

    gg = _apu().gas_generator
    point = trim_gas_generator(
        gg, {"N": gg.parameters.N, "PW": 221821.5}, altitude=8e3, Mach=0.7, dT_isa=5.0
    )
    error = abs(json.loads(text)["outputs"]["T4"] / point["T4"] - 1)
    nothing = "nothing is computed"
    return [
        Row("import of apu_casadi, interpreter included", import_s, "s", 0.6, 0.0, 0.0, nothing),
        Row("import of Apu, simulate_joint, trim", whole_s, "s", None, 0.0, 0.0,
            nothing),
        Row("first result of `apu trim` from the shell", trim_s, "s", 1.5, error, 1e-10,
            "T4 against a trim here"),
    ]  # fmt: skip


def _python(code: str, stdin: str | None = None, **env: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], input=stdin, capture_output=True, text=True, check=False,
        env={**os.environ, **env}, timeout=1800,
    )  # fmt: skip
    if done.returncode:
        raise SimulationError(f"a process of the benchmark failed: {done.stderr.strip()[-500:]}")
    return done.stdout


def _child(name: str, case: dict[str, Any], **env: str) -> dict[str, Any]:
    """Run ``_child_<name>`` with ``case`` in a new process; return its answer."""
    code = (
        "import json, sys; from scenarios.bench import benchmarks\n"
        f"print(json.dumps(bench._child_{name}(json.load(sys.stdin))))"
    )
    answer: dict[str, Any] = json.loads(_python(code, json.dumps(case), **env).splitlines()[-1])
    return answer


# ------------------------------------------------------------------------------ linearity

Curves = dict[str, tuple[np.ndarray, np.ndarray]]


def linear(size: Size) -> Curves:
    """Cost against simulated time, number of runs and output rate: x and seconds of each."""
    from scenarios.campaigns import random_faults, run_campaign

    s = size.joint
    repeats = min(3, size.repeats)
    made: Curves = {}

    def cost(scenario: Scenario) -> float:
        return timed(lambda: _simulate(scenario, solver="propagator"), repeats)[0]

    quiet = s.change(waveform_dt=None)
    _simulate(quiet, solver="propagator")
    t = np.array([max(d, s.duration) for d in size.durations])
    made["duration"] = t, np.array([cost(quiet.change(duration=float(d))) for d in t])
    run_campaign(random_faults(max(size.counts), seed=2, base=s), workers=1)
    seconds = []
    for n in size.counts:  # faults not met before: nothing of them is kept in memory
        runs = random_faults(n, seed=100 + n, base=s)
        seconds.append(timed(partial(run_campaign, runs, workers=1), 1)[0])
    made["runs"] = np.array(size.counts, float), np.array(seconds)
    rates = np.array(size.rates)
    took = []
    for r in rates:
        case = s.change(waveform_dt=None if r == 0 else 1 / float(r))
        _simulate(case, solver="propagator")
        took.append(cost(case))
    made["rate"] = rates / 1e3, np.array(took)
    return made


def linear_rows(curves: Curves) -> list[Row]:
    """Return how far from a straight line the costs are."""
    from scenarios.figures.benchplot import fit

    names = {"duration": "simulated time", "runs": "number of runs", "rate": "output rate"}
    rows = []
    for key, (x, y) in curves.items():
        *_, off = fit(x, y)
        rows.append(
            Row(f"cost against {names[key]}: distance from a line", 100 * off, "%", 15.0, 0.0, 0.0,
                "a timing")
        )  # fmt: skip
    return rows


def write_plot(curves: Curves, size: Size, path: str | os.PathLike[str]) -> Path:
    """Draw the linearity plot and return its path."""
    from scenarios.figures.benchplot import plot_costs

    labels = {
        "duration": ("Simulated time", "Simulated time [s]"),
        "runs": ("Number of runs", "Joint runs with random faults"),
        "rate": ("Output rate", "Waveform samples per ms"),
    }
    panels = [
        (labels[k][0], labels[k][1], "Wall time [s]", *curve) for k, curve in curves.items()
    ]  # fmt: skip
    fig = plot_costs(
        panels,
        f"Cost of joint runs on one core. Left: the {size.joint.name} scenario with its last phase "
        f"prolonged, no waveforms. Middle: {size.joint.duration:g} s each. Right: "
        f"{size.joint.duration:g} s; 0 stores no waveforms. Lines: least squares.",
    )
    return files.save_figure(fig, path, dpi=120)


# ------------------------------------------------------------------------------ peers


def dpsim(size: Size) -> list[Row]:
    """The machine's load step against dpsim, at the accuracy that dpsim reaches."""
    from apu_casadi.core import simulation
    from apu_casadi.machine.machinedata import MachineParameters
    from scenarios.validation.peers import machine as peer
    from scenarios.validation.peers.process import run_script

    case, n = peer.CASES[0], peer.N_OUT
    given = {"cases": [peer.theirs(case, MachineParameters())], "steps": peer.STEPS[1:]}
    answer = run_script(sys.executable, "dpsim_run.py", given)
    result = answer["runs"][0][0]
    exact = peer.ours(case)
    error = peer.peak_error(np.array(result["rows"]).T, exact)
    gen = peer.frozen_exciter()
    # the same start as in ours(): the crest of phase a
    y = gen.steady_state(case.before, V_t=peer.V_T).y
    axes = 2 * math.pi / 3 * np.arange(3)
    v_d = -2 / 3 * float(np.sin(axes) @ [y[f"v_{k}"] for k in "abc"])
    p = gen.steady_state(case.before, V_t=peer.V_T, theta_e=math.atan2(v_d, y["v_a"]))
    ss = gen.variant(case.after, case.fault)
    u = gen.inputs(case.after, V_ref=p.V_ref)

    def run(rtol: float) -> np.ndarray:
        first = simulation.stepper(p.ss, 1, rtol=rtol, atol=1e-2 * rtol)
        then = simulation.stepper(ss, n, rtol=rtol, atol=1e-2 * rtol)
        x = first(p.x, p.u, [], peer.T_SWITCH).x_end
        x = gen.transfer(x, p.ss, ss, u=p.u, theta=[], u_target=u)
        out = ss.y.unpack(then(x, u, [], peer.T_END - peer.T_SWITCH).y)
        return np.array([out[f"{q}_{k}"] for q in "vi" for k in "abc"])

    rows = []
    for rtol in (1e-5, 1e-6, 1e-7, 1e-8):
        run(rtol)
        wall, mine = timed(partial(run, rtol), max(size.repeats, 20))
        ours = peer.peak_error(mine, exact)
        if ours <= error:
            break
    rows.append(
        Row("machine: load step of 225 to 100 kW, 6 ms", 1e3 * wall, "ms", None, ours, error,
            f"largest over the peak, CVODES at 1e-11; dpsim's, with 0.125 us: {error:.1e}",
            peer=f"dpsim {answer['version']}, {1e3 * result['seconds']:.0f} ms",
            ratio=result["seconds"] / wall)
    )  # fmt: skip
    return rows


def pycycle(size: Size) -> list[Row]:
    """One trim against pyCycle, off design, by the engine that the validation uses."""
    from apu_casadi.gaspath.steady.trimming import trim_gas_generator
    from scenarios.validation.peers import cycle as peer

    gg = peer.engine()
    (answer,) = peer.run_pycycle(gg, peer.SMOOTH)
    peer.trimmed(gg)
    N, (_, PW, at) = gg.parameters.N, peer.POINTS[1]
    ambient: dict[str, Any] = dict(at)
    wall, _ = timed(
        lambda: trim_gas_generator(gg, {"N": N, "PW": PW}, **ambient), max(size.repeats, 20)
    )
    error = 0.0
    for mine, theirs in zip(peer.trimmed(gg), answer["points"], strict=True):
        keys = [k for k in peer.COMPARED if k in theirs]
        error = max(error, *(abs(mine[k] / theirs[k] - 1) for k in keys))
    s = answer["seconds"]
    each = (s["all"] - s["first"]) / (len(answer["points"]) - 1)
    tolerance, reason = peer.LINE_TOLERANCE
    return [
        Row("trim of the engine with plain maps and NASA-9 gas", 1e3 * wall, "ms", None, error,
            tolerance, f"relative, pyCycle's answers; {reason}",
            peer=f"pyCycle {answer['versions']['om-pycycle']}, {each:.1f} s a further point "
            f"({s['first']:.1f} s with the first)",
            ratio=each / wall)
    ]  # fmt: skip


# ------------------------------------------------------------------------------ estimation


def estimation(size: Size) -> list[Row]:
    """A step of the electrical EKF and UKF in generated C, filterpy's UKF, and the joint estimate.

    Fastest of some: a filter step is micro-seconds, and anything else that runs only adds to it.
    """
    from estimators.apu.electrical.electricalfilter import electrical_filter
    from estimators.filters.ekf import extended_kalman_filter
    from estimators.filters.ukf import unscented_kalman_filter
    from scenarios.studies import jointrun
    from scenarios.studies.electrical.protocol import FULL
    from scenarios.studies.electrical.steptime import filterpy_step_us, speed
    from scenarios.studies.electrical.truth import generator_truth, samples_of

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
        other = kind == "ukf" and peer is not None
        rows.append(
            Row(f"step of the electrical {kind.upper()}, {name}", fastest[f"{kind}_us"], "us",
                steps["goal_us"][kind], error, 1e-6,
                "means against the virtual machine's, in standard deviations",
                peer="filterpy's UKF, same functions" if other else "",
                ratio=peer / fastest["ukf_us"] if other and peer is not None else None)
        )  # fmt: skip
    joint = jointrun.joint_seconds(repeat=max(1, size.repeats // 2))
    ends = jointrun.report(jointrun.estimate(jointrun.truth("joint"), 1))["phases"]
    error = max(
        abs(v["estimate"] - v["true"]) / (v["half_width"] / jointrun.Z95)
        for p in ends
        for v in p["values"].values()
    )
    rows.append(
        Row(f"joint estimation of {joint['simulated']:g} s, electrical and gas path",
            joint["seconds"], "s", 5.0, error, 4.0,
            "largest error at the ends of the phases, in claimed standard deviations")
    )  # fmt: skip
    return rows


# ------------------------------------------------------------------------------ all of it

Part = Callable[[Size], list[Row]]
PARTS: Mapping[str, Part] = {
    "trim": trim,
    "deck": deck,
    "derivatives": derivatives,
    "linearisation": linearisation,
    "shell": shell,
    "joint": joint,
    "memory": memory,
    "campaign": campaign,
    "estimation": estimation,
}
PEERS: Mapping[str, Part] = {"dpsim": dpsim, "pycycle": pycycle}
LINEAR = "linear"


def known() -> list[str]:
    """Return the names of all parts."""
    return [*PARTS, LINEAR, *PEERS]


@dataclass(frozen=True)
class Report:
    """Rows by part, the linearity curves, what was skipped and why, and where it ran."""

    rows: dict[str, list[Row]]
    curves: Curves
    skipped: dict[str, str]
    machine: dict[str, Any]
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Return the report for JSON."""
        table = {
            name: [
                {k: _plain(v) for k, v in dataclasses.asdict(r).items()} | {"met": r.met}
                for r in rows
            ]
            for name, rows in self.rows.items()
        }
        curves = {k: {"x": x.tolist(), "seconds": y.tolist()} for k, (x, y) in self.curves.items()}
        return {
            "rows": table, "curves": curves, "skipped": self.skipped, "machine": self.machine,
            "seconds": self.seconds,
        }  # fmt: skip


def _plain(v: Any) -> Any:
    return None if isinstance(v, float) and not math.isfinite(v) else v


def run(
    names: Sequence[str] | None = None,
    *,
    size: Size | None = None,
    peers: bool = False,
    say: Callable[[str], None] | None = None,
) -> Report:
    """Measure parts, all of them by default; a peer that is not installed is skipped.

    Raises:
        ScenarioError: unknown name of a part.
    """
    from scenarios.validation.comparison import SkippedError

    size = Size() if size is None else size
    wanted = [*PARTS, LINEAR, *(PEERS if peers else ())] if names is None else list(names)
    for n in wanted:
        if n not in known():
            raise ScenarioError(f"unknown part {n!r} {nearest(n, known())}")
    start = time.perf_counter()
    where = machine()
    rows: dict[str, list[Row]] = {}
    curves: Curves = {}
    skipped = {}
    for n in wanted:
        if say is not None:
            say(n)
        try:
            if n == LINEAR:
                curves = linear(size)
                rows[n] = linear_rows(curves)
            else:
                if n == "dpsim":
                    from importlib.util import find_spec

                    if find_spec("dpsimpy") is None:
                        raise SkippedError("dpsim is not installed")
                rows[n] = {**PARTS, **PEERS}[n](size)
        except SkippedError as reason:
            skipped[n] = str(reason)
    return Report(rows, curves, skipped, where, time.perf_counter() - start)


HEAD = ("what", "target", "figure", "error", "may be", "", "peer", "times faster")


def cells(r: Row) -> tuple[str, ...]:
    """Return a row as texts."""
    unit = r.unit
    sign = ">=" if r.more else "<="
    target = "-" if r.target is None else f"{sign} {r.target:g} {unit}"
    return (
        r.what,
        target,
        f"{r.value:.3g} {unit}",
        "-" if r.error_target == 0 else f"{r.error:.1e}",
        "-" if r.error_target == 0 else f"{r.error_target:.0e}",
        "met" if r.met else "inaccurate" if not r.accurate else "missed",
        r.peer or "-",
        "-" if r.ratio is None else f"{r.ratio:.3g}",
    )


def table(report: Report) -> str:
    """Return the report as a text table."""
    body = [cells(r) for rows in report.rows.values() for r in rows]
    widths = [max(len(row[k]) for row in (HEAD, *body)) for k in range(len(HEAD))]
    lines = [
        "  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip()
        for row in (HEAD, *body)
    ]
    return "\n".join([*lines, "", _where(report.machine), *_left_out(report)])


def _where(m: Mapping[str, Any]) -> str:
    versions = ", ".join(f"{k} {v}" for k, v in m["versions"].items())
    busy = f"; load before the start {m['load_before']}" if m["load_before"] > 0.3 else ""
    return f"{m['processor']}, {m['cores']} cores, {m['system']}; {versions}{busy}"


def _left_out(report: Report) -> list[str]:
    return [f"skipped: {n}: {why}" for n, why in report.skipped.items()]


def page(report: Report, image: str | None) -> str:
    """Return the page BENCHMARKS.md."""
    m = report.machine
    busy = ""
    if m["load_before"] > 0.3:
        busy = (
            f" **Other programs were running: the load average was {m['load_before']} before the "
            "start, so times are too long.**"
        )
    everything = [r for rows in report.rows.values() for r in rows]
    body = [(*cells(r), r.measure) for r in everything]
    parts = [
        "# Benchmarks",
        "Made by `apu bench --page BENCHMARKS.md`; `--peers` adds the rows against other programs. "
        f"It took {report.seconds:.0f} s.",
        f"{_where({**m, 'load_before': 0.0})}; generated C where there is a compiler "
        f"(backend `{m['backend']}`).{busy}",
        "Times are medians on one core unless a row says otherwise, after compiling and loading; "
        "ratios come from one run. The error is that of the very answers that were timed; a row "
        "is met when figure and error both are.",
        markdown.markdown_table((*HEAD, "the error is"), body, right=(2, 3)),
    ]
    if image is not None:
        parts += ["## Cost is linear", f"![Cost against simulated time, runs and rate]({image})"]
    if report.skipped:
        parts += ["## Skipped", "\n".join(f"- {n}: {why}" for n, why in report.skipped.items())]
    return "\n\n".join(parts) + "\n"
