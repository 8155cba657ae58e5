"""The pipeline that users run, with one imperfection in it: simulate, measure, estimate, count."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from apu_casadi.core.errors import ApuError
from apu_casadi.core.sharing import last
from apu_casadi.gaspath.conditions import DEFAULT_DAY
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.park import PHASES
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.multirate import simulate_joint
from apu_casadi.unit.runsummary import severity_h
from estimators.apu.gaspath import window_means
from estimators.apu.measuring import measure_run
from estimators.apu.recorded_estimate import RecordedEstimate, estimate
from estimators.apu.recordings.measured import read_recording
from estimators.apu.trust import GAS, machine
from scenarios.studies.mismatch.imperfections import (
    DURATION,
    FAULTS,
    IMPERFECTIONS,
    ONSET,
    Imperfection,
    Readings,
    scenario,
)

__all__ = ["WRONG", "judged", "mismatch", "recorded"]

WRONG = 4.0  # sigmas from which an estimate is wrong
FINE, WAVEFORM = 0.005, 1e-4  # s; exchange step of the truth, sampling of the waveforms
SETTLED = 0.02  # s; an alarm so long before a fault is false
QUANTITIES = ("N", *HEALTH, *(f"h_{p}" for p in PHASES), "P_total")


@last(6)
def _truth(name: str | None, size: float, fault: str, phase: str) -> Any:
    """Simulate a run with an imperfection of unit or scenario; None: with none."""
    apu, run = Apu(), scenario(fault, phase)
    if name is not None:
        entry = IMPERFECTIONS[name]
        if entry.what == "unit":
            apu = entry.change(apu, size)
        else:
            run = entry.change(run, size)
    fine: dict[str, Any] = {"dt": FINE, "exchange": "corrected", "waveform_dt": WAVEFORM}
    return simulate_joint(apu, **run, **fine, warn_exchange=False)


def _plain(measured: Any) -> dict[str, dict[str, np.ndarray]]:
    """Return recordings as users have them: arrays by name, ``t`` among them."""
    return {
        k: {"t": d["time"].values.copy()} | {n: d[n].values.copy() for n in map(str, d)}
        for k, d in measured.items()
    }


def recorded(entry: Imperfection, size: float, seed: int, fault: str) -> tuple[Any, Readings]:
    """Return a truth and its recording with an imperfection.

    The draws are those of ``apu measure``; what an imperfection itself draws is of ``(seed, 3)``.
    """
    apu, rng = Apu(), np.random.default_rng([seed, 3])
    own = entry.what in ("unit", "scenario")
    ds = _truth(entry.name if own else None, size if own else 0.0, fault, PHASES[seed % 3])
    r = Readings(**_plain(measure_run(ds, apu, seed)), rng=rng)
    r.gaspath |= {n: np.full(r.gaspath["t"].size, v) for n, v in DEFAULT_DAY.items()}  # as believed
    if entry.what == "recording":
        entry.change(r, size)
    elif entry.what == "sensors":
        true, seen = (Readings(**_plain(measure_run(ds, apu, None)), rng=rng) for _ in range(2))
        entry.change(seen, size)
        for kind in ("gaspath", "electrical"):
            now, was, out = (getattr(x, kind) for x in (seen, true, r))
            for n in out:
                out[n] = out[n] + (now[n] - was[n])
    return ds, r


def judged(ds: Any, e: RecordedEstimate, fault: str, phase: str) -> dict[str, Any]:
    """Return errors over sigmas at the end, by quantity, and false alarms, all and by part.

    A report of what did happen, not before it did, is no false one.
    """
    z: dict[str, float] = {}

    def put(name: str, d: Any, true: float) -> None:
        x, s = (float(d[f"{name}{end}"].values[-1]) for end in ("", "_sigma"))
        z[name] = (x - true) / s

    t, false = ds["time"].values, Counter[str]()
    if e.gaspath is not None:
        # a recording whose fuel flow ends has no estimate beyond
        end = int(np.searchsorted(t, e.gaspath["time"].values[-1] + 1e-7)) - 1
        for n in ("N", *HEALTH):
            put(n, e.gaspath, float(ds[n].values[end]))
        changed = any(ds[n].values[-1] != ds[n].values[0] for n in HEALTH)
        found = json.loads(e.gaspath.attrs["alarms"])
        false[GAS] += sum(not (changed and a > ONSET - SETTLED) for a in found)
    for k, m in e.machines.items():
        h_true = float(severity_h(ds["mu"].values[-1], ds["k_rf"].values[-1]))
        for p in PHASES:
            there = fault == "short circuit" and p == phase
            put(f"h_{p}", m, h_true if there else 0.0)
        ends = m["time"].values[-2:]
        put("P_total", m, float(window_means(t, ds["P_total"].values, ends)[0]))
        said = m["faulty_phase"].values.astype(int)
        rising = np.flatnonzero((said[1:] > 0) & (said[1:] != said[:-1])) + 1
        right = [
            fault == "short circuit"
            and PHASES[said[i] - 1] == phase
            and m["time"].values[i] > ONSET - SETTLED
            for i in rising
        ]
        false[machine(k)] += len(right) - sum(right)
    return {"z": z, "false": false.total(), "false_of": dict(false)}


def part_of(quantity: str) -> str:
    """Return the part of an estimate that a quantity is of; there is one machine."""
    if quantity in ("N", *HEALTH):
        return GAS
    return machine(1) if quantity == "P_total" else f"{machine(1)}: {quantity}"


def mismatch(
    name: str,
    size: float,
    n: int,
    seed0: int,
    tell: Callable[[int, int], None] = lambda *_: None,
) -> dict[str, Any]:
    """Run the pipeline over seeds with one imperfection and count.

    Returns:
        ``runs``; ``refused``: no estimate, but a message; ``flagged``: with doubts; ``wrong``: an
        error beyond ``WRONG`` sigmas; ``silent``: of a part that is believed; ``false_alarms`` and
        ``silent_false_alarms``: runs with false alarms, and those of a part that is believed;
        ``z``: largest error over sigma of each quantity; ``seconds`` of data; ``doubts``: in how
        many runs by kind; ``missed``: seed and what was wrong of silent runs.
    """
    entry, count = IMPERFECTIONS[name], Counter[str]()
    worst: dict[str, float] = dict.fromkeys(QUANTITIES, 0.0)
    doubts, missed = Counter[str](), []
    for k, seed in enumerate(range(seed0, seed0 + n)):
        fault = entry.fault or FAULTS[seed % 3]
        ds, r = recorded(entry, size, seed, fault)
        count["runs"] += 1
        tell(k + 1, n)
        try:
            given = (r.gaspath,) if entry.only == "gaspath" else (r.gaspath, r.electrical)
            e = estimate(read_recording(*given), Apu())
        except ApuError:
            count["refused"] += 1
            continue
        j = judged(ds, e, fault, PHASES[seed % 3])
        bad = {q: v for q, v in j["z"].items() if not abs(v) <= WRONG}
        wrong = bool(bad)
        for q, v in j["z"].items():
            worst[q] = max(worst[q], abs(v)) if math.isfinite(v) else math.inf
        bad = {q: v for q, v in bad.items() if not e.belief[part_of(q)]}
        false = sum(n for part, n in j["false_of"].items() if not e.belief[part])
        doubts.update({kind_of(d) for d in e.doubts})
        count["flagged"] += not e.believable
        count["wrong"] += wrong
        count["silent"] += bool(bad)
        count["false_alarms"] += bool(j["false"])
        count["silent_false_alarms"] += bool(false)
        if bad or false:
            missed.append({"seed": seed, "fault": fault, "z": bad, "false": false})
    keys = ["runs", "refused", "flagged", "wrong", "silent", "false_alarms", "silent_false_alarms"]
    out: dict[str, Any] = {k: count[k] for k in keys}
    out |= {"size": size, "unit": entry.unit, "seconds": DURATION * n, "z": worst}
    return out | {"doubts": dict(doubts.most_common()), "missed": missed}


def kind_of(doubt: str) -> str:
    """Return the kind of a doubt: its sensor or part, before the colon."""
    return str(getattr(doubt, "kind", doubt.partition(":")[0][:30]))
