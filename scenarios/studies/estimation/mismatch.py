"""The mismatch study: never silently wrong, whatever the world does that the filters do not know.

Every imperfection of :mod:`scenarios.studies.mismatch.imperfections` is three parts, one for each
size, so that ``--only "T5 stuck"`` or ``--only realistic`` runs some of them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import casadi as ca

from apu_casadi.unit.apu import Apu
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.apu.gaspath import gas_path_filter
from estimators.filters.ekf import ekf_step
from estimators.information.consistency import count_limit
from scenarios.studies.mismatch.imperfections import IMPERFECTIONS, SIZES, Imperfection
from scenarios.studies.mismatch.pipeline import mismatch
from scenarios.studies.registration import Claim, Results, Study, Tell

__all__ = ["STUDY", "filters"]

GOAL = {"realistic": 0.01, "large": 0.05}
"""Largest share of runs that may be silently wrong, by size."""
START, EACH = 10.0, 1.2  # expected seconds of a part: once (truths), and for each seed
HOUR = 3600.0


def filters() -> list[ca.Function]:
    """Return the functions of the filters that a recording is given to."""
    models = gas_path_filter().model, electrical_filter(Apu().generator.machine, power=True).model
    return [ekf_step(m).function for m in models]


STUDY = Study(
    "mismatch",
    order=55,
    title="In a world that is not as believed",
    goal="Silently wrong in at most 1 % of the runs with imperfections of realistic size, 5 % with "
    "large ones; no false alarm that is believed, but one an hour.",
    seeds=50,
    seed0=60_000,
    tuned="tests and thresholds were looked at on seeds below 1000",
    modules={"mismatch": ("estimators.apu.believable", "scenarios.studies.mismatch")},
    filters=filters,
    text="""
@intro
A unit runs for 1 s: a load step, then nothing, a short circuit or a change of gas-path health, in
turn. One thing is not as the filters believe. The run is measured and estimated as a user does it
(`apu measure`, `apu estimate data`). *Wrong* is an estimate at the end that is farther from the
truth than 4 of its claimed sigmas; *silently* wrong, where nothing is said against it; *flagged*,
where something is, or the recording is refused.

@claim wrong
joint | silently wrong, imperfections of {size} size | <= {goal:.0%} of runs
| {share:.1%} ({bad} of {kinds} imperfections miss it) | {silent} of {runs} runs | {seeds}
| {which}

@claim alarms
joint | false alarms that are believed, healthy units with imperfections of {size} size
| <= 1 an hour, or flagged | {alarms} in {hours:.2f} h | at most {limit:.3g} an hour | {seeds}
| {which}

@table
imperfection | size | runs | flagged | wrong | silently wrong | false alarms | believed
| largest error, sigma | most frequent doubt
---
{name} | {size} | {runs} | {flagged} | {wrong} | {silent} | {false_alarms} | {silent_false_alarms}
| {worst} | {doubt}
""",
)


def _run(entry: Imperfection, size: float, n: int, seed0: int, tell: Tell) -> Any:
    return mismatch(entry.name, size, n, seed0, tell)


def part_name(entry: Imperfection, k: int) -> str:
    """Return the name of a part: imperfection and size."""
    return f"{entry.name}, {SIZES[k]}"


for _entry in IMPERFECTIONS.values():
    for _k, _size in enumerate(_entry.sizes):
        STUDY.part(part_name(_entry, _k), start=START, each=EACH)(partial(_run, _entry, _size))


def _of_size(r: Results, k: int) -> dict[str, Any]:
    """Results of one size by imperfection."""
    named = {e.name: part_name(e, k) for e in IMPERFECTIONS.values()}
    return {n: r[p] for n, p in named.items() if p in r}


@STUDY.claims
def claims(r: Results) -> list[Claim]:
    """Claim the shares of runs that are silently wrong, and the false alarms that are believed."""
    out = []
    for size, goal in GOAL.items():
        found = _of_size(r, SIZES.index(size))
        if not found:
            continue
        seeds = r.seeds_from(part_name(IMPERFECTIONS[next(iter(found))], SIZES.index(size)))
        runs, silent = (sum(x[k] for x in found.values()) for k in ("runs", "silent"))
        bad = {n: x for n, x in found.items() if x["silent"] > goal * x["runs"]}
        told = ", ".join(f"{n} ({x['silent']} of {x['runs']})" for n, x in bad.items())
        values: dict[str, Any] = {"size": size, "goal": goal, "seeds": seeds, "which": told}
        values |= {"share": silent / runs, "silent": silent, "runs": runs}
        values |= {"bad": len(bad), "kinds": len(found)}
        out.append(STUDY.claim("claim wrong", not bad, **values))
        well = {n: x for n, x in found.items() if IMPERFECTIONS[n].healthy}
        if not well:
            continue
        alarms = sum(x["silent_false_alarms"] for x in well.values())
        hours = sum(x["seconds"] for x in well.values()) / HOUR
        told = ", ".join(n for n, x in well.items() if x["silent_false_alarms"])
        values |= {"alarms": alarms, "hours": hours, "limit": count_limit(alarms) / hours}
        out.append(STUDY.claim("claim alarms", alarms <= hours, **values | {"which": told}))
    return out


@STUDY.section
def section(r: Results) -> list[str]:
    """Show every imperfection and size."""
    rows = []
    for k in range(len(SIZES)):
        for name, x in _of_size(r, k).items():
            known = {q: v for q, v in x["z"].items() if v is not None}
            q = max(known, key=lambda q: known[q], default="-")
            worst = f"{q} {known[q]:.1f}" if known else "-"
            about = {"worst": worst, "doubt": next(iter(x["doubts"]), "-")}
            about |= {"size": f"{x['size']:g} {x['unit']}", "flagged": x["flagged"] + x["refused"]}
            rows.append((name, k, x | about | {"name": name}))
    if not rows:
        return []
    order = list(IMPERFECTIONS)
    rows.sort(key=lambda row: (order.index(row[0]), row[1]))
    t = STUDY.template
    return [t.table("table", [row for *_, row in rows])]
