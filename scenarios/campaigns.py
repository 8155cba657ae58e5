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
import dataclasses
import hashlib
import json
import logging
import math
import os
import time
import warnings
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.checked import bounded
from apu_casadi.core.errors import ApuError, DataError, ScenarioError, SimulationError, nearest
from apu_casadi.core.profiles.profile import Profile, Varying
from apu_casadi.core.version import installed
from apu_casadi.machine.faults.ttsc import Ttsc
from scenarios import campaign_records, registry
from scenarios.campaign_records import COLUMNS, OF_EACH, RUNS, STATUS, each
from scenarios.extensions import digest
from scenarios.phases import Phase
from scenarios.schema import Scenario
from scenarios.shell.locking import locked
from scenarios.shell.workers import LOST, each_task, stoppable

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.core.lanes.together import Course


DATASET = "campaign.nc"
LOCK = "campaign.lock"
_log = logging.getLogger("apu_casadi")

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
H_FIRST = 1e-5  # severity from which a short circuit grows
# runs that are one ensemble in a process: at least, and at most (they are lost with the process)
FEW, TOGETHER = 8, 128
GROWTH = (0.2, 0.9)  # time over which a fault grows, of what is left of the run


# ------------------------------------------------------------------------------ what to run


def random_faults(
    n: int, seed: int = 0, *, base: str | Scenario = "joint", growing: float = 0.0
) -> list[Scenario]:
    """Draw ``n`` scenarios with random health factors, stator faults, and fault times.

    Run i depends on the seed and i alone, so a longer campaign begins with the same runs.  Health
    factors are uniform, mu uniform, k_rf log-uniform; kappa is mu (the paper's full coupling) in
    one half of the runs and uniform in [mu, 1] in the other; each phase is equally likely.

    Args:
        n: number of runs.
        seed: of the random numbers; each run's own seed, for its noise, follows from it.
        base: scenario with a phase that changes health and one with a fault; these two are changed.
        growing: share of the faults that grow into what is drawn, health factors along ramps from
            one, a short circuit exponentially from the severity ``H_FIRST``, each over ``GROWTH``
            of the time that is left; the others are steps.  What is drawn is the same.

    Raises:
        ScenarioError: ``base`` has no such phases, ``n`` or ``seed`` is negative, or ``growing``
            does not lie in [0, 1].
    """
    s = registry.get(base) if isinstance(base, str) else base
    growing = bounded(growing, "growing", lo=0.0, hi=1.0)
    if n < 1 or seed < 0:
        raise ScenarioError(f"a campaign needs n >= 1 runs and a seed >= 0, got {n} and {seed}")
    sick = next((i for i, p in enumerate(s.phases) if isinstance(p.health, Mapping)), None)
    short = next((i for i, p in enumerate(s.phases) if _short(p) is not None), None)
    if sick is None or short is None:
        what = "a phase with health factors" if sick is None else "a phase with a fault"
        raise ScenarioError(f"scenario {s.name!r} lacks {what} to draw at random")
    return [_drawn(s, sick, short, seed, i, growing) for i in range(n)]


def _short(p: Phase) -> tuple[Ttsc, int | None] | None:
    """Return the short circuit that a phase begins with, and the generator that has it or None.

    Of one that changes in time, what it is once it is there.
    """
    faults = p.fault if isinstance(p.fault, tuple) else [(None, p.fault)]
    found = ((f.example() if isinstance(f, Varying) else f, k) for k, f in faults)
    return next(((f, k) for f, k in found if isinstance(f, Ttsc)), None)


def _phase_of(fault: Any) -> str:
    """Return the phase of a fault, also of one that changes in time; "-" where it has none."""
    fault = fault.example() if isinstance(fault, Varying) else fault
    return str(getattr(fault, "phase", "-"))


def _drawn(s: Scenario, sick: int, short: int, seed: int, i: int, growing: float = 0.0) -> Scenario:
    rng = np.random.default_rng([seed, i])
    table = s.to_dict()
    phases = table["phase"]
    phases[sick]["health"] = {n: _digits(rng.uniform(*r)) for n, r in HEALTH_RANGES.items()}
    mu = _digits(rng.uniform(*MU_RANGE))
    k_rf = _digits(math.exp(rng.uniform(*np.log(K_RF_RANGE))))
    kappa = mu if rng.random() < 0.5 else max(mu, _digits(rng.uniform(mu, 1.0)))
    phase = "abc"[int(rng.integers(3))]
    _, number = _short(s.phases[short]) or (None, None)
    of = {} if number is None else {"generator": number}
    phases[short]["fault"] = {**of, "mu": mu, "k_rf": k_rf, "kappa": kappa, "phase": phase}
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
    if growing:
        _grow(table, sick, short, growing, rng)
    return Scenario.from_dict(table)


def _grow(
    table: dict[str, Any], sick: int, short: int, share: float, rng: np.random.Generator
) -> None:
    """Let a share of the faults of a drawn scenario grow into what they are."""
    grows = rng.random(2) < share
    parts = zip((sick, short), rng.uniform(*GROWTH, 2), strict=True)
    over = [_digits(part * (table["duration"] - table["phase"][k]["start"])) for k, part in parts]
    if grows[0]:
        health, ramp = table["phase"][sick]["health"], {"from": 1.0, "over": over[0]}
        table["phase"][sick]["health"] = {n: {**ramp, "to": f} for n, f in health.items()}
    if grows[1]:
        fault = table["phase"][short]["fault"]
        h = _digits(fault["mu"] / (fault.pop("k_rf") + 1.0 - fault["mu"]))
        fault["h"] = {"kind": "exponential", "from": H_FIRST, "to": h, "over": over[1]}


def _profiles(s: Scenario) -> str:
    """Return in words what grows in a scenario; "-" where nothing does."""
    found = []
    for p in s.phases:
        health = p.health if isinstance(p.health, Mapping) else {}
        found += [f"{n} {f.label}" for n, f in health.items() if isinstance(f, Profile)]
        faults = [of.fault for of in p.fault] if isinstance(p.fault, tuple) else [p.fault]
        found += [f.label for f in faults if isinstance(f, Varying)]
    return "; ".join(found) or "-"


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
    from apu_casadi.core.errors import ApuWarning

    t = time.perf_counter()
    try:
        s = Scenario.from_dict(task.table)
        with warnings.catch_warnings():  # they are kept in the record, one list for each run
            warnings.simplefilter("ignore", ApuWarning)
            ds = registry.run(s, solver=task.solver)
        told = _result(ds)
    except Exception as e:
        told, ds = _failure(e), None
    return _record(task, told, ds) | {"seconds": time.perf_counter() - t}


def _run_together(tasks: Sequence[_Task]) -> Generator[dict[str, Any]]:
    """Run scenarios as one ensemble; yield their records as of :func:`_run_one`.

    The wall time of a run is the mean of those that have ended.
    """
    from apu_casadi.core.errors import ApuWarning
    from apu_casadi.core.lanes.together import ensemble

    def course(task: _Task) -> Course[dict[str, Any]]:
        try:
            ds = yield from registry.course(Scenario.from_dict(task.table), solver=task.solver)
            told = _result(ds)
        except Exception as e:
            told, ds = _failure(e), None
        return _record(task, told, ds)

    t = time.perf_counter()
    under_way = FEW if any(task.keep is not None for task in tasks) else TOGETHER
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ApuWarning)
        members = ensemble(map(course, tasks), chunk=under_way)
        for done, (_, made) in enumerate(members, 1):
            if isinstance(made, Exception):  # a file that cannot be written
                raise made
            yield made | {"seconds": (time.perf_counter() - t) / done}


def _run_some(tasks: Sequence[_Task]) -> list[dict[str, Any]]:
    return [*_run_together(tasks)]


def _result(ds: xr.Dataset) -> dict[str, Any]:
    """Return what the record of a run that was done says."""
    from apu_casadi.unit.runsummary import phase_summary
    from apu_casadi.unit.validity import found_in

    return {
        "reason": "",
        "phases": [campaign_records.kept(row) for row in phase_summary(ds)],
        "residual": float(json.loads(ds.attrs["solver"])["residual_max"]),
        "warnings": found_in(ds),
        "exchange_error": float(ds.attrs["exchange_error"]),
        "status": "done",
    }


def _failure(e: Exception) -> dict[str, Any]:
    """Return what the record of a run says that an error ended."""
    from apu_casadi.core.errors import OperatingPointError

    if not isinstance(e, ApuError):
        return {"reason": f"{type(e).__name__}: {e}", "status": "crashed"}
    kinds = {OperatingPointError: "refused", SimulationError: "failed"}
    status = next((v for k, v in kinds.items() if isinstance(e, k)), "invalid")
    return {"reason": " ".join(str(e).split()), "status": status}


def _record(task: _Task, told: Mapping[str, Any], ds: xr.Dataset | None) -> dict[str, Any]:
    """Return the record of a run; its dataset is written where that is asked for."""
    from apu_casadi.core.results import save

    if ds is not None and task.keep is not None:
        # a file that cannot be written is no fault of the run, nor could the next: DataError
        save(ds, Path(task.keep) / f"{task.table['name']}.nc")
    return {"key": task.key, "name": task.table["name"], **told}


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
    wait: bool = True,
    say: Callable[[str], None] | None = None,
) -> xr.Dataset:
    """Run scenarios over processes; return one row of summary quantities for each.

    Ctrl-C and SIGTERM end it with KeyboardInterrupt, and its processes with it; so does its own
    end by any other cause.  Two campaigns in one folder run one after the other.

    Args:
        scenarios: the runs; names must differ.
        workers: processes, by default one for each core that may be used; 1 runs them here.
        out: folder for ``runs.jsonl`` and ``campaign.nc``; None writes nothing.
        summary_only: run without waveforms and keep the summaries; False writes the dataset of each
            run, with the waveforms its scenario asks for, to the folder ``runs`` in ``out``.
        progress: called with the number of finished runs and of all.
        resume: take runs from ``runs.jsonl`` that the same scenario gave with the same program
            before, crashed ones excepted; False begins anew.
        solver: as for :func:`scenarios.registry.run`.
        wait: wait while another campaign works in the folder; what it has done is not done again.
            False refuses instead.
        say: called with a sentence that names the process waited for; by default the log is.

    Returns:
        xarray.Dataset on ``run`` and ``phase``: the quantities of
        :func:`apu_casadi.core.runsummary.phase_summary` (NaN where there is none), ``status`` with
        ``reason``, ``seed``, ``fault_phase``, ``seconds``, ``residual``, ``exchange_error``,
        ``warnings``.

    Raises:
        ScenarioError: no runs, two of one name, workers < 1, or an unknown solver.
        DataError: ``out`` cannot be read or written, or another campaign works there.
    """
    scenarios = list(scenarios)
    _check(scenarios, workers, solver)
    if out is None and not summary_only:
        raise ScenarioError("the datasets of all runs need a folder: give out")
    if summary_only:
        scenarios = [s if s.waveform_dt is None else s.change(waveform_dt=None) for s in scenarios]
    if out is None:
        tasks = [_task(s, solver, None) for s in scenarios]
        with stoppable() as check:
            done = _run_all(tasks, {}, workers, progress, lambda record: check())
        return _dataset(scenarios, [done[t.key] for t in tasks], solver)
    folder = registry.prepare(out)
    with stoppable() as check, locked(folder, LOCK, wait=wait, say=say):
        keep = None if summary_only else str(registry.prepare(folder / "runs"))
        tasks = [_task(s, solver, keep) for s in scenarios]
        _sweep(folder, folder / "runs")
        done = _finished(folder, tasks, keep) if resume else {}
        with campaign_records.appending(folder / RUNS, fresh=not resume) as write:

            def keep_it(record: Mapping[str, Any]) -> None:
                check()  # what an interrupted run says of itself is not true
                write(record)

            done = _run_all(tasks, done, workers, progress, keep_it)
        _sweep(folder / "runs")  # of processes that were killed meanwhile
        ds = _dataset(scenarios, [done[t.key] for t in tasks], solver)
        from apu_casadi.core.cf import described
        from apu_casadi.core.results import save

        save(described(ds, f"campaign of {ds.sizes['run']} runs"), folder / DATASET)
    return ds


def _check(scenarios: Sequence[Scenario], workers: int | None, solver: str) -> None:
    from apu_casadi.unit.integrators import SOLVERS

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


def _run_all(
    tasks: Sequence[_Task],
    done: dict[str, dict[str, Any]],
    workers: int | None,
    progress: Progress | None,
    write: Callable[[Mapping[str, Any]], None],
) -> dict[str, dict[str, Any]]:
    """Run the tasks that are not done; return the records of all by key."""
    open_ = [t for t in tasks if t.key not in done]
    if progress is not None:
        progress(len(done), len(tasks))
    with contextlib.closing(_records(open_, workers)) as records:
        for record in records:
            write(record)
            done[record["key"]] = record
            if progress is not None:
                progress(len(done), len(tasks))
    return done


def _sweep(*folders: Path) -> None:
    """Remove what killed processes left half written; nobody else works here now."""
    for folder in folders:
        for path in folder.glob(".*.part"):
            with contextlib.suppress(OSError):
                path.unlink()


def _task(s: Scenario, solver: str, keep: str | None) -> _Task:
    from apu_casadi.core.backend import package_digest

    table = s.to_dict()
    # the same numbers from the same program: a changed model runs its campaign again
    files = [digest(path) for path in s.extensions]
    files += [registry.engine_digest(s.engine)] if s.engine else []
    content = json.dumps([table, solver, package_digest(), *files], sort_keys=True)
    return _Task(hashlib.sha256(content.encode()).hexdigest()[:32], table, solver, keep)


def _records(tasks: Sequence[_Task], workers: int | None) -> Generator[dict[str, Any]]:
    """Yield the records of all tasks, in the order in which they end.

    Where there are enough of them, ensembles run in vector lanes in each process.
    """
    from apu_casadi.core.calling import available_threads

    n = max(1, available_threads() if workers is None else workers)
    size = min(TOGETHER, -(-len(tasks) // n))
    if size < FEW:
        yield from _one_by_one(tasks, workers)
    elif n == 1:
        yield from _run_together(tasks)
    else:
        groups = [tasks[i : i + size] for i in range(0, len(tasks), size)]
        for group, records in each_task(_run_some, groups, workers):
            # None: one of them takes its process down
            yield from _one_by_one(group, workers) if records is None else records


def _one_by_one(tasks: Sequence[_Task], workers: int | None) -> Generator[dict[str, Any]]:
    for t, record in each_task(_run_one, tasks, workers):
        lost = {"key": t.key, "name": t.table["name"], "status": "crashed", "reason": LOST}
        yield lost | {"seconds": math.nan} if record is None else record


# ------------------------------------------------------------------------------ kept on disk


def _finished(folder: Path, tasks: Sequence[_Task], keep: str | None) -> dict[str, dict[str, Any]]:
    """Return the records of these tasks that stand whole in the folder; crashed ones do not count.

    A damaged record is told, and its run is done again.
    """
    asked = {t.key: (t.table["name"], len(t.table["phase"])) for t in tasks}
    found = {}
    for key, record in campaign_records.read(folder / RUNS, asked).items():
        here = record["status"] != "crashed"
        if here and keep is not None and record["status"] == "done":
            here = _whole(Path(keep) / f"{record['name']}.nc")
        if here:
            found[key] = record
    return found


def _whole(path: Path) -> bool:
    """Whether a run's own file is there, with all its bytes; one that is damaged is told."""
    from apu_casadi.core.results import load

    if not path.exists():
        return False
    try:
        load(path, lazy=True)
    except DataError as e:
        _log.warning("%s", e)
        return False
    return True


# ------------------------------------------------------------------------------ result

_UNITS: Mapping[str, tuple[str, str]] = {
    "start": ("s", "start of the phase"),
    "end": ("s", "end of the phase"),
    "window": ("s", "length of the window at its end over which means are taken"),
    "N_rpm": ("rpm", "shaft speed"),
    "N_rpm_min": ("rpm", "lowest shaft speed of the phase"),
    "N_rpm_max": ("rpm", "highest shaft speed of the phase"),
    "PW_kW": ("kW", "shaft power"),
    "P3_kPa": ("kPa", "compressor outlet total pressure"),
    "SM_percent": ("%", "compressor surge margin"),
    "SM_percent_min": ("%", "lowest surge margin of the phase"),
    "T4_max": ("K", "highest combustor outlet temperature of the phase"),
    "h": ("1", "severity mu/(k_rf + 1 - mu)"),
}


_OF_RUNS: Mapping[str, tuple[str, str]] = {
    "seconds": ("s", "wall time of the run"),
    "residual": ("1", "largest scaled residual of the gas path equations in the run"),
    "exchange_error": ("1", "estimated exchange error, of the speed's excursion"),
}

Runs = Sequence[Mapping[str, Any]]


def _dataset(scenarios: Sequence[Scenario], records: Runs, solver: str) -> xr.Dataset:
    import xarray as xr

    from apu_casadi.unit.runsignals import RUN

    n, m = len(records), max(len(s.phases) for s in scenarios)
    rows = [r.get("phases", ()) for r in records]
    numbers = max((len(each(row)) for r in rows for row in r), default=1)
    keys = [c for c in COLUMNS if any(r for r in rows)]
    data: dict[str, Any] = {}
    phases, runs = ("run", "phase"), "run"
    of_each = (*phases, "generator") if numbers > 1 else phases
    for k in keys:
        a = np.full((n, m, numbers), np.nan)
        for i, r in enumerate(rows):
            for j, row in enumerate(r):
                # what all generators have is that of each of them
                values = [own[k] for own in (each(row) if k in OF_EACH else [row])]
                a[i, j, : len(values) if len(values) > 1 else None] = [
                    np.nan if v is None else v for v in values
                ]
        unit, doc = _UNITS.get(k) or (RUN[k].unit, RUN[k].doc)
        told = {"units": unit, "long_name": doc}
        own = k in OF_EACH and numbers > 1
        data[k] = (of_each, a, told) if own else (phases, a[:, :, 0], told)
    label = np.full((n, m), "-", dtype="U64")
    fault = np.full((n, m, numbers), "-", dtype="U1")
    for i, s in enumerate(scenarios):
        for j, p in enumerate(s.phases):
            label[i, j] = p.name[:64]
            fault[i, j] = fault[i, j - 1] if j else "-"
            if isinstance(p.fault, tuple):
                for of in p.fault:
                    if of.generator <= numbers:
                        fault[i, j, of.generator - 1] = _phase_of(of.fault)
            elif p.fault is not None:
                fault[i, j] = _phase_of(p.fault)
    words = "phase a, b or c with the short circuit; - healthy"
    data["phase_name"] = (phases, label, {"long_name": "name of the phase"})
    faulty = fault if numbers > 1 else fault[:, :, 0]
    data["fault_phase"] = (of_each, faulty, {"long_name": words})
    status = np.array([STATUS.index(r["status"]) for r in records], dtype=np.int8)
    flags = {"flag_values": list(range(len(STATUS))), "flag_meanings": " ".join(STATUS)}
    data["status"] = (runs, status, {"long_name": "what became of the run", **flags})
    reasons = [r["reason"] or "-" for r in records]
    data["reason"] = (runs, np.array(reasons), {"long_name": "of no result"})
    said = ["; ".join(r.get("warnings", ())) or "-" for r in records]
    words = "what must be known of the run; - nothing"
    data["warnings"] = (runs, np.array(said), {"long_name": words})
    grown = [_profiles(s) for s in scenarios]
    if set(grown) != {"-"}:
        words = "how the faults of the run grow; - not"
        data["profiles"] = (runs, np.array(grown), {"long_name": words})
    seeds = [-1 if s.seed is None else s.seed for s in scenarios]
    data["seed"] = (runs, np.array(seeds, dtype=np.int32), {"long_name": "of the noise; -1 none"})
    for k, (unit, doc) in _OF_RUNS.items():
        a = np.array([r.get(k, np.nan) for r in records], dtype=float)
        data[k] = (runs, a, {"units": unit, "long_name": doc})
    days = {json.dumps(dataclasses.asdict(s.ambient)) for s in scenarios}
    made = {"solver": solver, "runs": n, "apu_casadi_version": installed()}
    made["ambient"] = days.pop() if len(days) == 1 else "differs from run to run"
    coords = {"run": [s.name for s in scenarios], "phase": np.arange(m, dtype=np.int32)}
    if numbers > 1:
        coords["generator"] = np.arange(1, numbers + 1, dtype=np.int32)
    return xr.Dataset(data, coords=coords, attrs=made)


def counts(ds: xr.Dataset) -> dict[str, int]:
    """Return the number of runs of a campaign by what became of them."""
    status = ds["status"].values
    return {name: int((status == k).sum()) for k, name in enumerate(STATUS)}
