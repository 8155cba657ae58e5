"""Make a data set: every unit in a process or on a cluster, resumable, the same bits everywhere.

Layout, in the manner of N-CMAPSS::

    runs.parquet                 one row a run: Y (labels) and A (unit, run, split, status, reason)
    gaspath/unit_00012.parquet   W (conditions), X_s (measured), X_v (truth), T (health, faults)
    electrical/unit_00012.nc     voltages and currents around the onset, as measured, netCDF-4
    recipe.json, CARD.md, croissant.json, checksums.sha256

Columns of the gas path are named ``W.altitude``, ``X_s.T3``, ...; units are in CARD.md.  A unit is
kept as soon as it is made: one that was interrupted goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.backend import package_digest
from apu_casadi.core.cf import now
from apu_casadi.core.errors import ApuError, ApuWarning, DataError, SimulationError
from apu_casadi.gaspath.conditions import CONDITIONS
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.unit.multirate import simulate_joint
from apu_casadi.unit.runsignals import RUN
from apu_casadi.unit.runsummary import severity_h
from estimators.apu.measuring import measure_run
from estimators.apu.sensors import GAS_PATH
from scenarios import registry
from scenarios.datasets import waveforms
from scenarios.datasets.card import croissant, data_card
from scenarios.datasets.recipe import Drawn, Recipe, draw
from scenarios.schema import Scenario
from scenarios.shell import jsontext
from scenarios.shell.locking import locked
from scenarios.shell.workers import LOST, each_task, stoppable

RUNS, LOCK, SUMS = "runs.parquet", "dataset.lock", "checksums.sha256"
VARIED = tuple(n for n in CONDITIONS if n != "war")  # what a recipe draws of the day
VIRTUAL = ("T2", "T3", "P3", "T4", "T41", "T5", "P5", "W2", "SM", "PW", "Wf", "N")
Progress = Callable[[int, int], None]


def gas_path_columns() -> dict[str, tuple[str, str]]:
    """Return unit and meaning of each column of the gas-path tables, by name."""

    found = {"run": ("1", "number of the run"), "time": ("s", "since the start of the run")}
    found |= {f"W.{n}": (CONDITIONS[n].unit, CONDITIONS[n].doc) for n in VARIED}
    found["W.P_e"] = ("W", "electrical output, both generators")
    found |= {f"X_s.{s.name}": (s.unit, "as measured") for s in GAS_PATH.sensors}
    found |= {f"X_v.{n}": (RUN[n].unit, RUN[n].doc) for n in VIRTUAL}
    found |= {f"T.{n}": (RUN[n].unit, RUN[n].doc) for n in HEALTH}
    return found | {"T.h": ("1", "mu/(k_rf + 1 - mu) of the short circuit")}


def make_run(r: Recipe, unit: int, run: int) -> tuple[dict[str, Any], dict[str, Any], Any]:
    """Simulate and measure one run.

    Returns:
        Labels with ``status`` and ``reason``; columns of the gas path; columns of the waveforms
        around the onset.  The latter two are empty where the run was refused or failed.
    """
    d = draw(r, unit, run)
    try:
        scenario = Scenario.from_dict(d.scenario)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ApuWarning)
            ds = simulate_joint(**registry.joint_arguments(scenario), **solver_of(d))
            read = measure_run(ds, registry.unit_for(scenario), d.seed)
    except ApuError as e:
        why = " ".join(str(e).split())
        return {**d.labels, "status": "refused", "reason": why}, {}, {}
    gas = _gas_path(d, ds, read["gaspath"])
    return {**d.labels, "status": "done", "reason": ""}, gas, _waves(r, d, read.get("electrical"))


def solver_of(d: Drawn) -> dict[str, Any]:
    """Return how a run is integrated: an electrical fault that grows, by CVODES.

    Exact propagation needs tables all along its way, for which CVODES takes a fourth of the time;
    at this tolerance waveforms are right to 1e-4 of their peaks.
    """
    grows = d.labels["over"] > 0 and (d.labels["h"] > 0 or d.labels["mu_f"] > 0)
    return {"solver": "cvodes", "rtol": 1e-6, "atol": 1e-8} if grows else {}


def _gas_path(d: Drawn, ds: Any, read: Any) -> dict[str, np.ndarray]:
    t = read["time"].values
    k = np.clip(np.searchsorted(ds["time"].values, t + 1e-9) - 1, 0, None)

    def truth(name: str) -> np.ndarray:
        v = ds[name]
        both = v.sum("generator") if name == "P_e" and "generator" in v.dims else v
        a = both.values[k] * (2 if name == "P_e" and "generator" not in v.dims else 1)
        return np.asarray(a, dtype=np.float32)

    n = t.size
    out: dict[str, np.ndarray] = {"run": np.full(n, d.labels["run"], dtype=np.int32), "time": t}
    day = d.scenario["ambient"]
    out |= {f"W.{c}": np.full(n, day[c], dtype=np.float32) for c in VARIED}
    out["W.P_e"] = truth("P_e")
    for s in GAS_PATH.sensors:
        out[f"X_s.{s.name}"] = np.asarray(_faulty(d, s.name, t, read[s.name].values), np.float32)
    out |= {f"X_v.{v}": truth(v) for v in VIRTUAL}
    out |= {f"T.{f}": truth(f) for f in HEALTH}
    out["T.h"] = _severity(ds, k).astype(np.float32)
    return out


def _severity(ds: Any, k: np.ndarray) -> np.ndarray:
    both = (ds[n].max("generator") if "generator" in ds[n].dims else ds[n] for n in ("mu", "k_rf"))
    return severity_h(*(v.values[k] for v in both))


def _faulty(d: Drawn, name: str, t: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return a reading with the fault of its sensor, if it is the faulty one."""
    if d.sensor is None or d.sensor[0] != name:
        return y
    _, kind, size = d.sensor
    on, over = d.labels["onset"], d.labels["over"]
    since = np.clip(t - on, 0.0, None)
    if kind == "stuck":
        return np.where(t >= on, y[np.searchsorted(t, on) - 1], y)
    step = kind == "bias" and not over
    grown = np.where(t >= on, 1.0, 0.0) if step else since / (over or t[-1] - on)
    return y * (1.0 + size * np.clip(grown, 0.0, 1.0))


def _waves(r: Recipe, d: Drawn, read: Any) -> dict[str, np.ndarray]:
    """Return what was measured of the generators around the onset, or mid-run if healthy."""
    if read is None:
        return {}
    onset = d.labels["onset"]
    at = r.duration / 2 if math.isnan(onset) else onset
    t = read["time"].values
    inside = (t >= at - r.waveforms["before"]) & (t < at + r.waveforms["after"])
    n = int(inside.sum())
    out: dict[str, np.ndarray] = {"run": np.full(n, d.labels["run"], dtype=np.int32)}
    out["time"] = t[inside]
    for name in waveforms.WAVES:
        plain = name if name in read else name.rpartition("_")[0]  # generators that are alike
        out[name] = read[plain].values[inside].astype(np.float32)
    return out


# ------------------------------------------------------------------------------ units


def make_unit(recipe: Mapping[str, Any], unit: int) -> dict[str, Any]:
    """Make all runs of a unit: ``{"rows": labels, "files": {path: bytes}}``; nothing is written."""
    r = Recipe.of(recipe)
    rows, gas, waves = [], [], []
    for run in range(r.runs_per_unit):
        labels, g, w = make_run(r, unit, run)
        rows.append(labels)
        gas += [g] if g else []
        waves += [w] if w else []
    made = {f"gaspath/unit_{unit:05d}.parquet": _parquet(gas)} if gas else {}
    if waves:
        made[f"electrical/unit_{unit:05d}{waveforms.ENDING}"] = waveforms.packed(waves, r.title)
    return {"rows": rows, "files": made}


def _parquet(parts: list[dict[str, np.ndarray]]) -> bytes:
    frame = import_module("pandas").DataFrame(
        {n: np.concatenate([p[n] for p in parts]) for n in parts[0]}
    )
    f = io.BytesIO()
    frame.to_parquet(f, index=False)
    return f.getvalue()


def _packages(r: Recipe) -> None:
    """Refuse to begin without what the files are written by."""
    needed = {"pyarrow": "parquet"} | ({"h5netcdf": "netcdf4"} if r.waveforms.get("rate") else {})
    if missing := [n for n in needed if find_spec(n) is None]:
        extras = ",".join(needed.values())
        raise DataError(
            f"a data set needs {' and '.join(missing)}: pip install 'apu-casadi[{extras}]'"
        )


def make_dataset(
    r: Recipe,
    out: str | Path,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> dict[str, int]:
    """Make a data set in a folder, or go on with one that was interrupted.

    Args:
        r: the recipe.
        out: the folder; it holds nothing else.
        workers: processes; default: all cores.  1 makes everything in this one.
        cluster: address of a Dask scheduler whose workers have this package; they need no common
            file system.
        progress: called with the number of finished units and of all.

    Returns:
        Number of runs by status.

    Raises:
        DataError: the folder belongs to another recipe or version, or cannot be written, or
            a package for its files is missing.
    """
    _packages(r)
    folder = files.folder(out)
    table = json.loads(json.dumps(asdict(r)))
    told = {"recipe": table, "program": package_digest()}
    with locked(folder, LOCK), stoppable() as stop:
        begun = _claim(folder, told)
        left = [u for u in range(r.units) if not _whole(folder, u)]
        done = r.units - len(left)
        for unit, made in _all(table, left, workers, cluster):
            _keep(folder, unit, made)
            done += 1
            if progress is not None:
                progress(done, r.units)
            stop()
        return _finish(folder, r, {**told, "begun": begun})


def _all(
    table: dict[str, Any], left: list[int], workers: int | None, cluster: str | None
) -> Iterator[tuple[int, dict[str, Any]]]:
    if cluster is not None:
        yield from _on_cluster(table, left, cluster)
        return
    for unit, made in each_task(partial(make_unit, table), left, workers):
        if made is None:
            raise SimulationError(f"unit {unit}: {LOST}; units that are finished are kept")
        yield unit, made


def _on_cluster(
    table: dict[str, Any], left: list[int], address: str
) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield units as they end; one whose worker was lost is made again by another."""
    try:
        distributed = import_module("distributed")
    except ImportError:
        raise DataError("--cluster needs: pip install distributed") from None
    try:
        client = distributed.Client(address, timeout=10)
    except (OSError, ValueError) as e:
        raise DataError(f"no Dask scheduler at {address!r}: {e}") from None
    with client:
        futures = {client.submit(make_unit, table, u, pure=False): u for u in left}
        for f in distributed.as_completed(futures):
            yield futures[f], f.result()
            f.release()


# ------------------------------------------------------------------------------ on disk


def _claim(folder: Path, told: Mapping[str, Any]) -> str:
    """Make sure that the folder is this recipe's, by this program; return the day it was begun.

    The day stays where a set is gone on with; ``SOURCE_DATE_EPOCH`` fixes it.
    """
    path = folder / "recipe.json"
    for part in (
        p for p in folder.rglob(".[0-9]*-[0-9]*.part") if path.exists() or p.parent == folder
    ):
        part.unlink(missing_ok=True)  # a kill left it half written; the lock is ours
    if not path.exists():
        if any(p.name != LOCK for p in folder.iterdir()):
            raise DataError(f"{folder} holds other files: give a folder of its own")
        begun = now()[:10]
        files.write_text(path, jsontext.dumps({**told, "begun": begun}) + "\n")
        return begun
    try:
        before = json.loads(files.read_text(path))
    except ValueError as e:
        raise DataError(f"{path}: damaged: {e}") from None
    for key, what in (("recipe", "another recipe"), ("program", "another version of the program")):
        if before.get(key) != told[key]:
            raise DataError(f"{folder} was begun with {what}: give another folder, or remove it")
    return str(before.get("begun", now()[:10]))


def _record(folder: Path, unit: int) -> Path:
    return folder / "units" / f"unit_{unit:05d}.json"


def _sum(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _whole(folder: Path, unit: int) -> bool:
    """Whether a unit stands whole in the folder, every file as it was written."""
    try:
        kept = json.loads(_record(folder, unit).read_text(encoding="utf-8"))
        sums = {p: _sum((folder / p).read_bytes()) for p in kept["files"]}
    except (OSError, ValueError, KeyError, TypeError):
        return False
    return bool(sums == kept["files"])


def _keep(folder: Path, unit: int, made: Mapping[str, Any]) -> None:
    """Write a unit's files, and last its record."""
    for name, data in made["files"].items():
        files.folder((folder / name).parent)
        with files.whole(folder / name) as part:
            part.write_bytes(data)
    sums = {n: _sum(d) for n, d in made["files"].items()}
    files.folder(folder / "units")
    record = {"files": sums, "rows": made["rows"]}
    files.write_text(_record(folder, unit), json.dumps(record) + "\n")


def _finish(folder: Path, r: Recipe, told: Mapping[str, Any]) -> dict[str, int]:
    """Write labels, card, metadata and checksums of a data set whose units are all there."""
    records = [json.loads(files.read_text(_record(folder, u))) for u in range(r.units)]
    rows = [row for record in records for row in record["rows"]]
    labels = {n: np.array([row[n] for row in rows]) for n in rows[0]}
    table = _parquet([labels])
    with files.whole(folder / RUNS) as part:
        part.write_bytes(table)
    sums = {n: s for record in records for n, s in record["files"].items()}
    sums[RUNS] = _sum(table)
    columns = gas_path_columns()
    files.write_text(folder / "CARD.md", data_card(r, rows, columns, told))
    meta = croissant(r, sums, rows[0], columns, told["begun"])
    files.write_text(folder / "croissant.json", jsontext.dumps(meta) + "\n")
    lines = [f"{s}  {n}\n" for n, s in sorted(sums.items())]
    files.write_text(folder / SUMS, "".join(lines))
    status = [row["status"] for row in rows]
    return {s: status.count(s) for s in sorted(set(status))}
