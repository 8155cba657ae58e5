"""Severities, loads, phases, machines: what the joint estimate makes of any short circuit.

The pipeline is that of users: simulated, measured with gain errors, estimated.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from apu_casadi.core.sharing import last
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.park import PHASES
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import FaultChange, HealthChange
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu.joint import estimate_joint
from estimators.apu.jointcases import joint_case
from estimators.information.consistency import share_interval
from scenarios.studies.estimation.speed import both
from scenarios.studies.registration import Claim, Results, Study, Tell, numbers

__all__ = ["CELLS", "STUDY", "Cell", "estimated"]

ONSET, GAS_FAULT, DURATION = 0.6, 1.0, 1.6  # s
K_RF = 20.0
FAULT = {"f_eta_c": 0.98}
SOON = 0.5  # s, within which a short circuit that appears is to be found
SURE = 3.0  # sigmas from which a factor is reported as changed


class Cell(NamedTuple):
    """One row of the table: loads, and faults with their onsets.

    Args:
        load: of each generator, kW.
        h: severity; 0 is a healthy machine.
        when: ``"start"`` or ``"mid"``, the onset of the short circuit.
        phase: that has it.
        machine: 0: all, alike; otherwise its number.
        gas: whether the compressor's efficiency drops by 2 % at 1 s.
    """

    load: float
    h: float
    when: str
    phase: str
    machine: int
    gas: bool

    @property
    def words(self) -> str:
        """The row in words."""
        if not self.h:
            return f"{self.load:g} kW, healthy{', gas' if self.gas else ''}"
        of = f"machine {self.machine}" if self.machine else "both"
        text = f"{self.load:g} kW, h = {self.h:g} in {self.phase} of {of}, {self.when}"
        return f"{text}{', gas' if self.gas else ''}"


TABLE = """
 10 0      mid   a 0 -
 25 0      mid   a 0 gas
 50 0      mid   a 0 -
100 0      mid   a 0 gas
225 0      mid   a 0 -
 10 1e-4   mid   a 0 -
 25 3e-4   mid   b 0 gas
 50 1e-4   start c 0 -
 50 6e-4   mid   c 2 -
100 1e-4   mid   b 0 gas
100 3e-4   mid   c 0 -
100 3e-4   start a 0 -
100 6e-4   start b 0 gas
100 8e-4   mid   a 0 -
225 1e-4   start b 0 -
225 3e-4   mid   a 0 gas
225 6e-4   mid   b 0 -
 10 2.4e-3 mid   b 0 gas
100 2.4e-3 mid   c 1 -
100 2.4e-3 start a 0 gas
225 2.4e-3 mid   c 2 -
 25 5e-3   mid   a 0 -
100 5e-3   mid   b 0 -
 25 1e-2   mid   c 0 gas
100 1e-2   mid   a 0 -
 10 2e-2   mid   a 0 -
"""


def _cell(line: str) -> Cell:
    load, h, when, phase, machine, gas = line.split()
    return Cell(float(load), float(h), when, phase, int(machine), gas == "gas")


CELLS = tuple(_cell(line) for line in TABLE.split("\n") if line)

STUDY = Study(
    "severities",
    order=85,
    seed0=10_000,
    title="Short circuits of any size, at any load",
    goal="Health is wrongly reported in at most 2 % of the runs; error over sigma is at most 1.5 "
    "for severity, health and power; a short circuit of 3e-4 that appears is found in 0.5 s.",
    tuned="looked at with seeds 0 to 2504",
    modules={
        "electrical": ("estimators.apu.electrical",),
        "gaspath": ("estimators.apu.gaspath",),
        "joint": ("estimators.apu.joint", "estimators.apu.unknowns"),
    },
    filters=both,
    text="""
@intro
Runs of 1.6 s at loads from 10 to 225 kW, healthy or with a short circuit of h = 1e-4 to 2e-2 from
the start or from 0.6 s on, in any phase of both machines or of one, half of them with a compressor
2 % less efficient from 1 s on. They are measured with gain errors of all sensors and late currents,
and estimated by the joint estimate of a unit whose efficiency and stator resistance are others: all
drawn as the filters believe. Scored at the end.

@claim wrong
joint | health wrongly reported | <= 2 % | {wrong} of {runs} | {low:.1%} to {high:.1%} | {when}
| {worst} most

@claim found
joint | short circuit of h >= 3e-4 that appears, found within 0.5 s | >= 95 % | {found} of {of}
| {low:.1%} to {high:.1%} | {when} | {worst} least

@claim ratio
joint | error over sigma of {what}, worst row | <= 1.5 | {ratio:.2f} | RMS over a row's seeds
| {when} | {worst}

@claim power
joint | claimed sigma of the power over its RMS error, all rows | 0.8 to 1.2 | {ratio:.2f}
| rows {least:.2f} to {most:.2f} | {when} | {worst}

@table
RMS of error over claimed sigma at the end of each row's runs (1 is right), and claimed sigma over
RMS error of the power; *false*: runs with a change of health reported that is not there; *found*:
short circuits found within 0.5 s, and the median delay. Efficiency makes nine tenths of the power's
sigma, so that with few seeds its columns scatter as few draws of one number do.
""",
)


@last(1)
def _truth(cell: Cell) -> Any:
    fault = Ttsc(cell.h * (1 + K_RF) / (1 + cell.h), K_RF, phase=cell.phase) if cell.h else None
    number = cell.machine or None
    events: list[Any] = [HealthChange(GAS_FAULT, FAULT)] if cell.gas else []
    if fault is not None and cell.when == "mid":
        events.append(FaultChange(ONSET, fault, generator=number))
    start: Any = None
    if fault is not None and cell.when == "start":
        start = fault if number is None else {number: fault}
    load = SeriesLoad.from_power(1e3 * cell.load)
    fine: dict[str, Any] = {"dt": 0.005, "exchange": "corrected", "waveform_dt": 1e-4}
    return simulate_joint(
        Apu(), duration=DURATION, load=load, fault=start, events=sorted(events, key=lambda e: e.t),
        **fine,
    )  # fmt: skip


def estimated(cell: Cell, seed: int, **options: Any) -> dict[str, Any]:
    """Estimate one run of a cell; return its scores.

    Returns:
        ``health``, ``h`` and ``power``: errors over sigmas at the end; ``error``, ``sigma``: of the
        power, W; ``wrong``: whether a change of health is reported that is not there; ``found``:
        the delay of the report of the short circuit, s, or None; ``false``: reports of one in a
        healthy machine, or in another phase.
    """
    ds, case = _truth(cell), joint_case(seed, machines=2 if cell.machine else 1)
    e = estimate_joint(ds, seed, **{"apu": case.unit(Apu()), **case.errors(), **options})
    t = e["time"].values

    def score(n: str) -> float:
        x, s, true = (float(e[f"{n}{end}"].values[-1]) for end in ("", "_sigma", "_true"))
        return (x - true) / s

    ends = [f"_{k}" for k in (1, 2)] if cell.machine else [""]
    own = f"_{cell.machine}" if cell.machine else ""
    onset = ONSET if cell.when == "mid" else 0.0
    said = {end: e[f"faulty_phase{end}"].values.astype(int) for end in ends}
    right = PHASES.index(cell.phase) + 1 if cell.h else -1
    found = t[(said[own] == right) & (t > onset)]
    false = sum(int((said[end] > 0).any()) for end in ends if end != own)
    false += int(((said[own] > 0) & ((said[own] != right) | (t <= onset))).any())
    alarms = [a for a in json.loads(e.attrs["alarms"]) if not (cell.gas and a > GAS_FAULT)]
    health = {n: score(n) for n in HEALTH}
    # of an engine that is healthy the estimate of a factor is its error
    off = not cell.gas and max(map(abs, health.values())) > SURE
    power = e["P_total"].values[-1] - e["P_total_true"].values[-1]
    return {
        "health": list(health.values()),
        "h": score(f"h_{cell.phase}{own}"),
        "power": score("P_total"),
        "error": float(power),
        "sigma": float(e["P_total_sigma"].values[-1]),
        "wrong": bool(alarms) or off,
        "found": float(found[0] - onset) if found.size else None,
        "false": bool(false),
    }


def _row(cell: Cell, n: int, seed0: int, tell: Tell) -> Any:
    runs = []
    for k in range(n):  # of each row its own: the efficiency that is drawn makes most of an error
        runs.append(estimated(cell, seed0 + CELLS.index(cell) + len(CELLS) * k))
        tell(k + 1, n)
    return {"cell": list(cell), "runs": runs}


for _c in CELLS:
    STUDY.part(_c.words, start=3.0, each=0.7 / len(CELLS), share=1 / len(CELLS))(partial(_row, _c))


def _rows(r: Results) -> list[dict[str, Any]]:
    """Scores of the rows that were run."""
    return [_scores(r[c.words]) for c in CELLS if c.words in r]


def _rms(x: Any) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(x, float)))))


def _scores(row: Mapping[str, Any]) -> dict[str, Any]:
    """RMS of error over sigma and counts of one row."""
    runs = row["runs"]
    out: dict[str, Any] = {k: _rms([r[k] for r in runs]) for k in ("h", "power", "error", "sigma")}
    out["health"] = float(
        max(_rms(column) for column in zip(*(r["health"] for r in runs), strict=True))
    )
    out |= {k: sum(r[k] for r in runs) for k in ("wrong", "false")}
    delays = [r["found"] for r in runs if r["found"] is not None]
    soon = sum(d <= SOON + 1e-9 for d in delays)
    delay = float(np.median(delays)) if delays else np.nan
    return {**out, "cell": Cell(*row["cell"]), "n": len(runs), "soon": soon, "delay": delay}


@STUDY.claims
def claims(r: Results) -> list[Claim]:
    """Claim what was asked of every row together, and of the worst."""
    rows = _rows(r)
    if not rows:
        return []
    when = f"{r.seeds_from(rows[0]['cell'].words)} in the first row, and so on"

    def share(block: str, key: str, of: list[dict[str, Any]], met: Any, least: bool) -> Claim:
        k, n = sum(v[key] for v in of), sum(v["n"] for v in of)
        low, high = share_interval(k, n)
        worst = sorted(of, key=lambda v: v[key] / v["n"], reverse=not least)[0]["cell"].words
        values = {"low": low, "high": high, "worst": worst, "when": when}
        values |= {"wrong": k, "runs": n, "found": k, "of": n}
        return STUDY.claim(block, met(k / n), **values)

    out = [share("claim wrong", "wrong", rows, lambda p: p <= 0.02, least=False)]
    appear = [v for v in rows if v["cell"].h >= 3e-4 and v["cell"].when == "mid"]
    if appear:
        out.append(share("claim found", "soon", appear, lambda p: p >= 0.95, least=True))
    for key, what in (("h", "severity"), ("health", "health"), ("power", "power")):
        worst = max(rows, key=lambda v: v[key])
        values = {"what": what, "ratio": worst[key], "worst": worst["cell"].words, "when": when}
        out.append(STUDY.claim("claim ratio", worst[key] <= 1.5, **values))
    ratio = _rms([v["sigma"] for v in rows]) / _rms([v["error"] for v in rows])
    each = {v["cell"].words: v["sigma"] / v["error"] for v in rows}
    worst_of = max(each, key=lambda n: abs(np.log(each[n])))
    values = {"ratio": ratio, "when": when, "worst": worst_of}
    values |= {"least": min(each.values()), "most": max(each.values())}
    return [*out, STUDY.claim("claim power", 0.8 <= ratio <= 1.2, **values)]


@STUDY.section
def section(r: Results) -> list[str]:
    """Show every row."""
    rows = _rows(r)
    if not rows:
        return []
    head = ["row", "seeds", "severity", "health", "power", "sigma/error", "false", "found", "delay"]
    lines = []
    for v in rows:
        found = f"{v['soon']}" if v["cell"].h else "-"
        delay = f"{1e3 * v['delay']:.0f} ms" if v["cell"].h and np.isfinite(v["delay"]) else "-"
        ratios = [f"{v[k]:.2f}" for k in ("h", "health", "power")]
        ratios.append(f"{v['sigma'] / v['error']:.2f}")
        lines.append([v["cell"].words, f"{v['n']}", *ratios, f"{v['wrong']}", found, delay])
    return [STUDY.template.text("table"), numbers(head, lines)]
