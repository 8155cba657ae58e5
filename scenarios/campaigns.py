"""Campaigns: many joint runs over processes, every one of them accounted for.

>>> from scenarios.campaigns import random_faults, run_campaign
>>> ds = run_campaign(random_faults(1000, seed=1), out="results/campaign")  # doctest: +SKIP
>>> ds["T4"].sel(phase=3).where(ds["status"] == 0).plot.hist()  # doctest: +SKIP

A run that is refused, fails, or takes its process down leaves its status and its reason; none is
missing from the result.  Finished runs are kept in ``runs.jsonl`` of the folder, one checked line
each, as soon as they are there: a campaign that was interrupted goes on where it stopped.

The processes are started afresh (spawn) and import this module, not the calling script.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi import interrupts
from apu_casadi.errors import ApuError, DataError, ScenarioError, SimulationError, nearest
from scenarios import registry
from scenarios.schema import FaultSpec, Scenario

if TYPE_CHECKING:
    import xarray as xr


RUNS = "runs.jsonl"
DATASET = "campaign.nc"
STATUS = ("done", "refused", "failed", "invalid", "crashed")
"""What became of a run: refused, no steady start; failed, the simulation stopped; invalid, a wrong
scenario or parameter; crashed, an unforeseen error or the loss of the process."""

THREADS = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS",
    "NUMEXPR_NUM_THREADS",
)  # fmt: skip

Progress = Callable[[int, int], None]
"""Called with the number of finished runs and of all."""

# Ranges of random_faults: health factors; shorted fraction; fault over shorted-turn resistance
# (severity h = mu/(k_rf + 1 - mu) from 5e-5 to 9e-3, the latter some 200 kW of shaft power)
HEALTH_RANGES: Mapping[str, tuple[float, float]] = {
    "f_eta_c": (0.97, 1.0),
    "f_W_c": (0.95, 1.0),
    "f_eta_t": (0.97, 1.0),
    "f_W_t": (0.96, 1.04),
}
MU_RANGE, K_RF_RANGE = (0.01, 0.10), (10.0, 200.0)
SHIFT = 1.0  # s; a fault begins up to this much before or after its time in the base scenario


# ------------------------------------------------------------------------------ what to run


def random_faults(n: int, seed: int = 0, *, base: str | Scenario = "joint") -> list[Scenario]:
    """Draw ``n`` scenarios with random health factors, stator faults, and fault times.

    Run i depends on the seed and i alone, so a longer campaign begins with the same runs.  Health
    factors are uniform, mu uniform, k_rf log-uniform; kappa is mu (the paper's full coupling) in
    one half of the runs and uniform in [mu, 1] in the other; each phase is equally likely.

    Parameters
    ----------
    n : number of runs.
    seed : of the random numbers; each run's own seed, for its noise, follows from it.
    base : scenario with a phase that changes health and one with a fault; these two are changed.

    Raises
    ------
    ScenarioError : ``base`` has no such phases, or ``n`` or ``seed`` is negative.
    """
    s = registry.get(base) if isinstance(base, str) else base
    if n < 1 or seed < 0:
        raise ScenarioError(f"a campaign needs n >= 1 runs and a seed >= 0, got {n} and {seed}")
    sick = next((i for i, p in enumerate(s.phases) if isinstance(p.health, Mapping)), None)
    short = next((i for i, p in enumerate(s.phases) if isinstance(p.fault, FaultSpec)), None)
    if sick is None or short is None:
        what = "a phase with health factors" if sick is None else "a phase with a fault"
        raise ScenarioError(f"scenario {s.name!r} lacks {what} to draw at random")
    return [_drawn(s, sick, short, seed, i) for i in range(n)]


def _drawn(s: Scenario, sick: int, short: int, seed: int, i: int) -> Scenario:
    rng = np.random.default_rng([seed, i])
    table = s.to_dict()
    phases = table["phase"]
    phases[sick]["health"] = {n: _digits(rng.uniform(*r)) for n, r in HEALTH_RANGES.items()}
    mu = _digits(rng.uniform(*MU_RANGE))
    k_rf = _digits(math.exp(rng.uniform(*np.log(K_RF_RANGE))))
    kappa = mu if rng.random() < 0.5 else max(mu, _digits(rng.uniform(mu, 1.0)))
    phase = "abc"[int(rng.integers(3))]
    phases[short]["fault"] = {"mu": mu, "k_rf": k_rf, "kappa": kappa, "phase": phase}
    if short > 0:
        before = phases[short - 1]["start"]
        after = phases[short + 1]["start"] if short + 1 < len(phases) else s.duration
        t = phases[short]["start"]
        room = min(SHIFT, 0.5 * (t - before), 0.5 * (after - t))
        phases[short]["start"] = round(t + rng.uniform(-room, room), 4)
    table["name"] = f"{s.name}-{seed}-{i:05d}"
    table["title"] = f"{s.name} with random faults: seed {seed}, run {i}"
    table["doc"] = ""
    table["seed"] = int(rng.integers(2**31))
    return Scenario.from_dict(table)


def _digits(x: float) -> float:
    """Five significant digits: what is printed is what ran."""
    return float(f"{x:.5g}")


# ------------------------------------------------------------------------------ one run


@dataclass(frozen=True)
class _Task:
    """What a worker is given: a key that tells it from others, tables and options."""

    key: str
    table: dict[str, Any]
    solver: str
    keep: str | None  # folder for the run's own netCDF file


def _run_one(task: _Task) -> dict[str, Any]:
    """Run one scenario; return its record, whatever happens."""
    from apu_casadi.errors import OperatingPointError
    from apu_casadi.results import phase_summary, save

    t = time.perf_counter()
    record: dict[str, Any] = {"key": task.key, "name": task.table["name"], "reason": ""}
    try:
        s = Scenario.from_dict(task.table)
        ds = registry.run(s, solver=task.solver)
        record["phases"] = phase_summary(ds)
        solver = json.loads(ds.attrs["solver"])
        record["residual"] = float(solver["residual_max"])
        if task.keep is not None:
            save(ds, Path(task.keep) / f"{s.name}.nc")
        record["status"] = "done"
    except DataError:
        raise  # nothing wrong with the run: its file cannot be written, nor could the next
    except ApuError as e:
        kinds = {OperatingPointError: "refused", SimulationError: "failed"}
        record["status"] = next((v for k, v in kinds.items() if isinstance(e, k)), "invalid")
        record["reason"] = " ".join(str(e).split())
    except Exception as e:
        record["status"], record["reason"] = "crashed", f"{type(e).__name__}: {e}"
    record["seconds"] = time.perf_counter() - t
    return record


# ------------------------------------------------------------------------------ many runs


def run_campaign(
    scenarios: Sequence[Scenario],
    *,
    workers: int | None = None,
    out: str | os.PathLike[str] | None = None,
    summary_only: bool = True,
    progress: Progress | None = None,
    resume: bool = True,
    solver: str = "propagator",
) -> xr.Dataset:
    """Run scenarios over processes; return one row of summary quantities for each.

    Parameters
    ----------
    scenarios : the runs; names must differ.
    workers : processes, by default one for each core that may be used; 1 runs them here.
    out : folder for ``runs.jsonl`` and ``campaign.nc``; None writes nothing.
    summary_only : run without waveforms and keep the summaries; False writes the dataset of each
        run, with the waveforms its scenario asks for, to the folder ``runs`` in ``out``.
    progress : called with the number of finished runs and of all.
    resume : take runs from ``runs.jsonl`` that the same scenario gave with the same program
        before, crashed ones excepted; False begins anew.
    solver : as for :func:`scenarios.registry.run`.

    Returns
    -------
    xarray.Dataset on ``run`` and ``phase``: the quantities of
    :func:`apu_casadi.results.phase_summary` (NaN where there is none), ``status`` with ``reason``,
    ``seed``, ``fault_phase``, ``seconds``, ``residual``.

    Raises
    ------
    ScenarioError : no runs, two of one name, workers < 1, or an unknown solver.
    DataError : ``out`` cannot be read or written.
    """
    from apu_casadi.multirate import SOLVERS

    scenarios = list(scenarios)
    if not scenarios:
        raise ScenarioError("a campaign needs at least one scenario")
    names = [s.name for s in scenarios]
    if len(set(names)) < len(names):
        twice = next(n for n in names if names.count(n) > 1)
        raise ScenarioError(f"two scenarios of one name in a campaign: {twice!r}")
    if workers is not None and workers < 1:
        raise ScenarioError(f"workers must be >= 1, got {workers}")
    if solver not in SOLVERS:
        raise ScenarioError(f"solver {solver!r} {nearest(solver, SOLVERS)}")
    if out is None and not summary_only:
        raise ScenarioError("the datasets of all runs need a folder: give out")
    folder = None if out is None else registry.prepare(out)
    keep = None
    if folder is not None and not summary_only:
        keep = str(registry.prepare(folder / "runs"))
    if summary_only:
        scenarios = [s if s.waveform_dt is None else s.change(waveform_dt=None) for s in scenarios]
    tasks = [_task(s, solver, keep) for s in scenarios]
    done = _finished(folder, tasks, keep) if folder is not None and resume else {}
    open_ = [t for t in tasks if t.key not in done]
    if progress is not None:
        progress(len(done), len(tasks))
    with _log(folder, fresh=not resume) as write:
        for record in _records(open_, workers):
            write(record)
            done[record["key"]] = record
            if progress is not None:
                progress(len(done), len(tasks))
    ds = _dataset(scenarios, [done[t.key] for t in tasks], solver)
    if folder is not None:
        from apu_casadi.results import save

        save(ds, folder / DATASET)
    return ds


def _task(s: Scenario, solver: str, keep: str | None) -> _Task:
    from apu_casadi.backend import package_digest

    table = s.to_dict()
    # the same numbers from the same program: a changed model runs its campaign again
    content = json.dumps([table, solver, package_digest()], sort_keys=True)
    return _Task(hashlib.sha256(content.encode()).hexdigest()[:32], table, solver, keep)


def _records(tasks: Sequence[_Task], workers: int | None) -> Iterator[dict[str, Any]]:
    """Yield the records of all tasks, in the order in which they end."""
    from apu_casadi.backend import available_threads

    n = min(available_threads() if workers is None else workers, len(tasks))
    if n <= 1:
        for t in tasks:
            yield _run_one(t)
        return
    suspects: list[_Task] = []
    yield from _pooled(list(tasks), n, suspects)
    # one of these took its process down: each gets a process of its own, which tells the culprit
    for t in suspects:
        again: list[_Task] = []
        yield from _pooled([t], 1, again)
        if again:
            yield {
                "key": t.key, "name": t.table["name"], "status": "crashed", "seconds": math.nan,
                "reason": "the process ended without an answer (killed, out of memory?)",
            }  # fmt: skip


def _pooled(
    tasks: list[_Task], workers: int, suspects: list[_Task]
) -> Iterator[dict[str, Any]]:  # fmt: skip
    """Yield records of tasks run by a pool; those under way when a process died go to suspects."""
    waiting = tasks[::-1]
    fruitless = 0
    while waiting:
        with _plain_children(), _pool(workers) as pool:
            under_way: dict[Future[dict[str, Any]], _Task] = {}
            broken = False
            fruitless += 1
            if fruitless > 3:
                raise SimulationError("the processes of the campaign end before they have run")
            while (waiting or under_way) and not broken:
                # few under way, so that an interrupt is answered within a run or two
                while waiting and len(under_way) < 2 * workers and not broken:
                    try:
                        with interrupts.kept_from_children():  # submitting starts processes
                            future = pool.submit(_run_one, waiting[-1])
                        under_way[future] = waiting.pop()
                    except BrokenProcessPool:
                        broken = True
                for f in wait(under_way, return_when=FIRST_COMPLETED).done:
                    task = under_way.pop(f)
                    try:
                        record = f.result()
                    except BrokenProcessPool:
                        suspects.append(task)
                        broken = True
                    else:
                        fruitless = 0
                        yield record
            suspects.extend(under_way.values())


@contextlib.contextmanager
def _pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """A pool that an exception ends as soon as the runs under way have ended."""
    pool = ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=_ignore_interrupt
    )
    try:
        yield pool
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _ignore_interrupt() -> None:
    """Ctrl-C reaches all processes of a terminal; the first one decides."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def _plain_children() -> Iterator[None]:
    """Let processes started inside the block use one thread each, and not run our main script.

    The latter is what spawning does, for functions that the script may define; ours are here.
    """
    before = {k: os.environ.get(k) for k in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    main = sys.modules["__main__"]
    held: dict[str, Any] = {
        k: vars(main).pop(k) for k in ("__file__", "__spec__") if k in vars(main)
    }
    main.__spec__ = None
    try:
        yield
    finally:
        vars(main).update(held)
        for k, v in before.items():
            if v is None:
                os.environ.pop(k, None)
            else:
                os.environ[k] = v


# ------------------------------------------------------------------------------ kept on disk


def _line(record: Mapping[str, Any]) -> str:
    text = json.dumps(record, sort_keys=True)
    return f"{hashlib.sha256(text.encode()).hexdigest()[:16]} {text}\n"


def _finished(folder: Path, tasks: Sequence[_Task], keep: str | None) -> dict[str, dict[str, Any]]:
    """Return the records of these tasks that stand whole in the folder; crashed ones do not count.

    A line that was cut short or changed fails its sum, and its run is done again.
    """
    try:
        text = (folder / RUNS).read_text(encoding="utf-8", errors="replace")
    except FileNotFoundError:
        return {}
    except OSError as e:
        raise DataError(f"{folder / RUNS}: cannot be read: {e.strerror or e}") from None
    asked = {t.key for t in tasks}
    found = {}
    for line in text.splitlines():
        total, _, body = line.partition(" ")
        if hashlib.sha256(body.encode()).hexdigest()[:16] != total:
            continue
        record = json.loads(body)
        here = record["key"] in asked and record["status"] != "crashed"
        if here and keep is not None and record["status"] == "done":
            here = (Path(keep) / f"{record['name']}.nc").exists()
        if here:
            found[record["key"]] = record
    return found


@contextlib.contextmanager
def _log(folder: Path | None, *, fresh: bool) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Yield a function that appends a record to the folder's file, or does nothing."""
    if folder is None:
        yield lambda record: None
        return
    path = folder / RUNS
    try:
        f = path.open("w" if fresh else "a+", encoding="utf-8", newline="\n")
    except OSError as e:
        raise DataError(f"{path}: cannot be written: {e.strerror or e}") from None

    def write(record: Mapping[str, Any]) -> None:
        try:
            f.write(_line(record))
            f.flush()
        except OSError as e:
            raise DataError(f"{path}: cannot be written: {e.strerror or e}") from None

    with f:
        if not fresh and path.stat().st_size and not path.read_bytes().endswith(b"\n"):
            f.write("\n")  # the rest of a line that was cut short stays alone
        yield write


# ------------------------------------------------------------------------------ result

_UNITS: Mapping[str, tuple[str, str]] = {
    "start": ("s", "start of the phase"),
    "end": ("s", "end of the phase"),
    "window": ("s", "length of the window at its end over which means are taken"),
    "N_rpm": ("r/min", "shaft speed"),
    "N_rpm_min": ("r/min", "lowest shaft speed of the phase"),
    "N_rpm_max": ("r/min", "highest shaft speed of the phase"),
    "PW_kW": ("kW", "shaft power"),
    "P3_kPa": ("kPa", "compressor outlet total pressure"),
    "SM_percent": ("%", "compressor surge margin"),
    "SM_percent_min": ("%", "lowest surge margin of the phase"),
    "T4_max": ("K", "highest combustor outlet temperature of the phase"),
    "h": ("1", "severity mu/(k_rf + 1 - mu)"),
}


def _dataset(
    scenarios: Sequence[Scenario], records: Sequence[Mapping[str, Any]], solver: str
) -> xr.Dataset:  # fmt: skip
    import xarray as xr

    from apu_casadi.results import CHANNELS

    n, m = len(records), max(len(s.phases) for s in scenarios)
    rows = [r.get("phases", ()) for r in records]
    keys = dict.fromkeys(k for r in rows for row in r for k in row if k != "name")
    data: dict[str, Any] = {}
    for k in keys:
        a = np.full((n, m), np.nan)
        for i, r in enumerate(rows):
            for j, row in enumerate(r):
                a[i, j] = np.nan if row[k] is None else row[k]
        unit, doc = _UNITS.get(k) or CHANNELS[k]
        data[k] = (("run", "phase"), a, {"units": unit, "long_name": doc})
    label = np.full((n, m), "-", dtype="U64")
    fault = np.full((n, m), "-", dtype="U1")
    for i, s in enumerate(scenarios):
        now = "-"
        for j, p in enumerate(s.phases):
            if p.fault is not None:
                now = p.fault.phase if isinstance(p.fault, FaultSpec) else "-"
            label[i, j], fault[i, j] = p.name[:64], now
    data["phase_name"] = (("run", "phase"), label, {"long_name": "name of the phase"})
    data["fault_phase"] = (
        ("run", "phase"), fault, {"long_name": "phase a, b or c with the short circuit; - healthy"}
    )  # fmt: skip
    status = np.array([STATUS.index(r["status"]) for r in records], dtype=np.int8)
    data["status"] = (
        "run",
        status,
        {
            "long_name": "what became of the run",
            "flag_values": list(range(len(STATUS))),
            "flag_meanings": " ".join(STATUS),
        },
    )
    data["reason"] = (
        "run", np.array([r["reason"] or "-" for r in records]), {"long_name": "of no result"}
    )  # fmt: skip
    seeds = [-1 if s.seed is None else s.seed for s in scenarios]
    data["seed"] = ("run", np.array(seeds, dtype=np.int32), {"long_name": "of the noise; -1 none"})
    for k, unit, doc in (
        ("seconds", "s", "wall time of the run"),
        ("residual", "1", "largest scaled residual of the gas path equations in the run"),
    ):
        a = np.array([r.get(k, np.nan) for r in records], dtype=float)
        data[k] = ("run", a, {"units": unit, "long_name": doc})
    coords = {"run": [s.name for s in scenarios], "phase": np.arange(m, dtype=np.int32)}
    return xr.Dataset(data, coords=coords, attrs={"solver": solver, "runs": n})


def counts(ds: xr.Dataset) -> dict[str, int]:
    """Return the number of runs of a campaign by what became of them."""
    status = ds["status"].values
    return {name: int((status == k).sum()) for k, name in enumerate(STATUS)}
