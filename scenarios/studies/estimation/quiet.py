"""Ten minutes in which nothing fails: how often the pipeline reports something that is not there.

Load steps come every 20 s.  A part is a load, and what is recorded: the gas path with its measured
shaft power, or the generators as well, of which 40 s at a time are estimated.
"""

from __future__ import annotations

import json
from collections import Counter
from functools import partial
from typing import Any

import xarray as xr

from apu_casadi.core.sharing import last
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import LoadChange
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu.measuring import measure_run
from estimators.apu.recorded_estimate import RecordedEstimate, estimate
from estimators.apu.recordings.measured import read_recording
from estimators.information.consistency import count_limit
from scenarios.studies.estimation.mismatch import filters
from scenarios.studies.registration import Claim, Results, Study, Tell

__all__ = ["STUDY", "reported"]

HOUR, STEP = 3600.0, 20.0  # s; of a load
LOADS = (225, 100, 25)  # kW, of each generator; four fifths of it every other step
#: Recorded -> (duration, s; expected seconds of its truth and of an estimate; share of the seeds).
RECORDED = {"gas path": (600.0, 4.0, 20.0, 1.0), "unit": (40.0, 10.0, 40.0, 1.0)}


STUDY = Study(
    "quiet",
    order=56,
    title="Ten minutes in which nothing fails",
    goal="At most one false report an hour that is believed.",
    seeds=7,
    seed0=75_000,
    tuned="thresholds were set before; that filters drift in long recordings was found on seed "
    "75000",
    modules={"quiet": ("estimators.apu.believable",)},
    filters=filters,
    text="""
@intro
A healthy unit, with gain errors and noise, whose load steps by a fifth every 20 s. The gas path is
recorded for ten minutes, with the shaft power measured; gas path and waveforms for 40 s, two load
steps. Counted are reports of a change of health or of a short circuit, and
recordings that are not believed.

@claim alarms
joint | false reports, healthy units, {recorded} | <= 1 an hour | {alarms} in {hours:.2f} h
| at most {limit:.3g} an hour | {seeds} | {doubted} of {runs} recordings were doubted

@table
recorded | load [kW] | hours | reports | of parts believed | doubted recordings | doubts
---
{recorded} | {load} | {hours:.2f} | {alarms} | {believed} | {doubted} of {runs} | {doubts}
""",
)


@last(2)
def _truth(kW: float, recorded: str) -> Any:
    """Return a run of two load steps, over and over: each time it ends as it began, settled."""
    duration = RECORDED[recorded][0]
    full, part = (SeriesLoad.from_power(1e3 * kW * share) for share in (1.0, 0.8))
    events = [LoadChange(STEP / 2, part), LoadChange(3 * STEP / 2, full)]
    waves = 1e-4 if recorded == "unit" else None
    run: dict[str, Any] = {"duration": 2 * STEP, "load": full, "events": events}
    fine: dict[str, Any] = {"dt": 0.01, "exchange": "corrected", "waveform_dt": waves}
    ds = simulate_joint(Apu(), **run, **fine, warn_exchange=False)
    later = ds.isel({d: slice(1, None) for d in ("time", "time_w") if d in ds.dims})
    n = round(duration / (2 * STEP))
    parts = [ds, *(_shifted(later, 2 * STEP * k) for k in range(1, n))]
    # only what has a time of its own: each waveform at each instant would fill any memory
    return xr.concat(parts, "time", data_vars="minimal", coords="minimal", compat="override")


def _shifted(ds: Any, by: float) -> Any:
    return ds.assign_coords({t: ds[t] + by for t in ("time", "time_w") if t in ds.coords})


def reported(e: RecordedEstimate) -> Counter[str]:
    """Count reports of changes by part of the estimate."""
    out = Counter[str]()
    if e.gaspath is not None:
        out["gas path"] = len(json.loads(e.gaspath.attrs["alarms"]))
    for k, m in e.machines.items():
        said = m["faulty_phase"].values.astype(int)
        out[f"machine {k}"] = int(((said[1:] > 0) & (said[1:] != said[:-1])).sum())
    return out


def _run(kW: float, recorded: str, n: int, seed0: int, tell: Tell) -> dict[str, Any]:
    ds, apu = _truth(kW, recorded), Apu()
    count, doubts = Counter[str](), Counter[str]()
    for k, seed in enumerate(range(seed0, seed0 + n)):
        e = estimate(read_recording(*measure_run(ds, apu, seed).values()), apu)
        found = reported(e)
        count["alarms"] += found.total()
        count["believed"] += sum(v for part, v in found.items() if not e.belief[part])
        count["doubted"] += not e.believable
        doubts.update({str(getattr(d, "kind", "other")) for d in e.doubts})
        tell(k + 1, n)
    out: dict[str, Any] = {n: count[n] for n in ("alarms", "believed", "doubted")}
    seconds = n * RECORDED[recorded][0]
    return out | {"runs": n, "load": kW, "seconds": seconds, "doubts": dict(doubts.most_common())}


for _name, (_, _start, _each, _share) in RECORDED.items():
    for _kW in LOADS:
        STUDY.part(f"{_name} {_kW} kW", start=_start, each=_each, share=_share)(
            partial(_run, _kW, _name)
        )


def _of(r: Results, recorded: str) -> dict[int, dict[str, Any]]:
    """Results of what is recorded, by load."""
    return {kW: r[p] for kW in LOADS if (p := f"{recorded} {kW} kW") in r}


@STUDY.claims
def claims(r: Results) -> list[Claim]:
    """Claim the rates of false reports."""
    out = []
    for recorded in RECORDED:
        found = _of(r, recorded)
        if not found:
            continue
        hours = sum(x["seconds"] for x in found.values()) / HOUR
        alarms = sum(x["believed"] for x in found.values())
        seeds = r.seeds_from(f"{recorded} {next(iter(found))} kW")
        values: dict[str, Any] = {"recorded": recorded, "alarms": alarms, "hours": hours}
        values |= {n: sum(x[n] for x in found.values()) for n in ("doubted", "runs")}
        values |= {"limit": count_limit(alarms) / hours, "seeds": seeds}
        out.append(STUDY.claim("claim alarms", alarms <= hours, **values))
    return out


@STUDY.section
def section(r: Results) -> list[str]:
    """Show every part."""
    rows = []
    for recorded in RECORDED:
        for x in _of(r, recorded).values():
            told = ", ".join(f"{n} {k}" for n, k in x["doubts"].items()) or "-"
            about = {"recorded": recorded, "hours": x["seconds"] / HOUR, "doubts": told}
            rows.append(x | about)
    return [STUDY.template.table("table", rows)] if rows else []
