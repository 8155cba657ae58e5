"""Faults that grow, come and go, or drift: when they are found, how far estimates lag."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from apu_casadi.core.profiles.points import Points
from apu_casadi.core.profiles.profile import Profile, varying
from apu_casadi.core.profiles.shapes import OnOff, Ramp
from apu_casadi.core.sharing import last, once
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.park import PHASES
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import FaultChange, HealthChange
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.apu.electrical.smallchanges import severity_changes
from estimators.apu.electrical.tracking import track
from estimators.apu.electrical.tuning import FAULT_LEVEL
from estimators.apu.gaspathmodel import DT
from estimators.apu.measuring import measure_run
from estimators.apu.recorded_estimate import estimate, gas_path_data
from estimators.apu.recordings.measured import read_recording
from estimators.detection.signatures import Jump, linearised
from estimators.filters.ekf import extended_kalman_filter
from estimators.information.consistency import share_interval
from scenarios.studies.electrical.truth import generator_truth, samples_of, unit_truth
from scenarios.studies.estimation.mismatch import filters
from scenarios.studies.registration import Claim, Results, Study, Tell

__all__ = ["COURSES", "STUDY", "Course", "bound_instant"]

ONSET, AFTER, SHORT = 0.8, 1.2, 0.3  # s; of the change; recorded after it, and with exact sensors
GAS_ONSET, GAS_AFTER = 2.0, 4.0
SAMPLE = 1e-4  # s
LOAD = 100e3  # W, of each generator
MU, SMALL, H, H_ON = 0.05, 1e-7, 2.4e-3, 3e-4
SURE, FACTOR = 5.0, 2.0  # sigmas of the bound, and by how much later an alarm may be
IN_TIME, WORST = 0.95, 1.5


@dataclass(frozen=True)
class Course:
    """A fault that changes.

    Args:
        words: of it.
        share: its size over time from the onset on, s, as a share of ``size``.
        size: a severity, or a change of a factor or of a sensor's gain.
        of: ``"h"``, a health factor or a sensor.
        exact: whether the sensors have no gain error, and the electrical filter runs alone.
    """

    words: str
    share: Callable[[np.ndarray], np.ndarray]
    size: float
    of: str = "h"
    exact: bool = False

    def at(self, t: np.ndarray) -> np.ndarray:
        """Size at instants from the onset, s; 0 before."""
        return np.where(t >= 0, self.size * self.share(np.maximum(t, 0.0)), 0.0)


def _grown(t: np.ndarray) -> np.ndarray:
    return 1 - np.exp(-t / 0.15)


def _on(t: np.ndarray) -> np.ndarray:
    return (t * 5.0 % 1.0 < 0.5).astype(float)


def _drifted(t: np.ndarray) -> np.ndarray:
    return np.minimum(t / GAS_AFTER, 1.0)


COURSES = {
    "growing": Course("h grows to 2.4e-3, time constant 0.15 s", _grown, H),
    "growing exact": Course("the same, exact sensors, filter alone", _grown, H, exact=True),
    "slow": Course("h grows by 4e-4 a second", lambda t: t, 4e-4),
    "intermittent": Course("h = 3e-4 comes and goes at 5 Hz", _on, H_ON),
    "f_eta_c": Course("f_eta_c drifts by -1 % a second", _drifted, -0.01 * GAS_AFTER, "f_eta_c"),
    "f_W_c": Course("f_W_c drifts by -1 % a second", _drifted, -0.01 * GAS_AFTER, "f_W_c"),
    "P3": Course("P3 drifts by 1 % a second", _drifted, 0.01 * GAS_AFTER, "P3"),
}


STUDY = Study(
    "changing",
    order=58,
    title="Faults that grow, come and go, or drift",
    goal="Alarm no later than twice the instant at which the bound reaches 5 sigma; error over "
    "sigma at most 1.5 while the fault changes.",
    seeds=20,
    seed0=80_000,
    tuned="looked at with seeds below 100",
    modules={
        "changing": (
            "estimators.apu.believable",
            "estimators.apu.electrical.smallchanges",
            "estimators.apu.electrical.tuning",
        )
    },
    filters=filters,
    text="""
@intro
A unit runs at 100 kW of each generator, and something begins to change: a short circuit grows or
comes and goes, a factor of the gas path or a sensor drifts. Short circuits are recorded with all
waveforms, the others as the gas path with its shaft power; gain errors as in the tables below, but
for the row that says otherwise. The bound is that of an estimator which is told onset, place and
course, and asked for the size alone: the information of all readings up to an instant, with fluxes,
angle, health and gain errors unknown as the filters have them. No alarm can be surer before. The
pipeline knows nothing beforehand, and says what it knows every 20 ms.

@claim alarm
joint | {words}: alarm no later than twice the bound's instant, or the next of the estimate
| >= {goal:.0%} of runs | {share:.0%} | {low:.0%} to {high:.0%}; median {late}, bound {bound} ms
| {seeds} | {why}

@late
the filters have no model of a {what} that changes: they see it when it has left what they claim to
know, and with the windows that are tested

@claim error
joint | {words}: error over sigma while it changes, RMS | <= {goal:g} | {z:.2f} | largest {most:.1f}
| {seeds} | its estimate is {lag} behind; the filter takes it for constant but for a slow walk

@table
what changes | runs | bound, 5 sigma, ms | alarm, median ms | longest | in time | before it
| answered | rightly | lag, ms | error over sigma, RMS | largest
---
{words} | {runs} | {bound} | {late} | {longest} | {in_time} | {before} | {answered} | {right}
| {lag} | {z:.2f} | {most:.1f}

@lag
*Lag* is the error over the rate of change, by least squares over the time of change.
""",
)


# ------------------------------------------------------------------------------ truths


def _severity(c: Course) -> Any:
    """Profile of a short circuit, from its onset on."""
    if c.share is _on:
        return lambda phase: varying(
            Ttsc, OnOff(MU, 0.0, 5.0, 0.5), MU / c.size - 1 + MU, phase=phase
        )
    t = np.linspace(0.0, AFTER, 241)
    h: Profile = Points(tuple(t.tolist()), tuple((SMALL + c.at(t)).tolist()))
    return lambda phase: varying(Ttsc.of_h, MU, h, phase=phase)


@last(6)
def _truth(name: str, phase: str) -> Any:
    c = COURSES[name]
    load = SeriesLoad.from_power(LOAD)
    more: dict[str, Any] = {"exchange": "corrected", "warn_exchange": False}
    if c.of == "h":
        events: list[Any] = [FaultChange(ONSET, _severity(c)(phase))]
        run: dict[str, Any] = {"duration": ONSET + AFTER, "dt": 0.005, "waveform_dt": SAMPLE}
    else:
        ramp = Ramp(1.0, 1.0 + c.size, GAS_AFTER)
        events = [HealthChange(GAS_ONSET, {c.of: ramp})] if c.of in HEALTH else []
        run = {"duration": GAS_ONSET + GAS_AFTER, "dt": 0.01}
    return simulate_joint(Apu(), load=load, events=events, **run, **more)


# ------------------------------------------------------------------------------ the bound


@once
def bound_instant(name: str) -> float:
    """Return when the information on the size of a course reaches ``SURE`` sigmas, s from onset."""
    c = COURSES[name]
    if c.of == "h":
        truth = generator_truth(SeriesLoad.from_power(LOAD), 2 * SHORT)
        filt = electrical_filter(gains="none" if c.exact else "estimate", phases=("b",), h_walk=0.0)
        clean, onset = samples_of(truth, None), SHORT
        data, prior = filt.recording(clean), filt.prior(clean, sigma={"h_b": SMALL})
        model, jump = filt.model, Jump("state", "h_b")
        r = extended_kalman_filter(model, prior, data, full=True)
    else:
        gas = measure_run(_truth("P3", "a"), Apu(), None)["gaspath"]
        of, data, start, _ = gas_path_data(read_recording(gas))
        model, onset = of.model, GAS_ONSET
        jump = Jump("state", c.of if c.of in HEALTH else f"gain_{c.of}")
        r = of.run(data, prior=start)
    f = linearised(model, r, data, [jump])
    s = c.at(data.t - onset)
    drift = np.append(np.diff(s), 0.0)[:, None, None] * f.state
    g = replace(f, state=s[0] * f.state, drift=drift).signature(0)[:, :, 0]
    known = np.cumsum(np.einsum("ki,ki->k", g, np.linalg.solve(f.S, g[:, :, None])[:, :, 0]))
    k = int(np.searchsorted(known, SURE**2))
    return float(data.t[k] - onset) if k < data.size else math.inf


# ------------------------------------------------------------------------------ runs


def _scored(t: np.ndarray, x: np.ndarray, s: np.ndarray, c: Course) -> dict[str, Any]:
    """Lag and error over sigma after the onset; an instant is the end of what was seen by then."""
    on = t > SAMPLE / 2
    t, true = t[on], c.at(t[on] - SAMPLE / 2)
    off = x[on] - true
    rate = np.gradient(true, t)
    lag = -float(off @ rate) / float(rate @ rate) if c.share is not _on and rate.any() else None
    z = off / s[on]
    return {"lag": lag, "z": float(np.sqrt(np.mean(z**2))), "most": float(np.abs(z).max())}


def _short(name: str, seed: int) -> dict[str, Any]:
    """One run with a short circuit, by the pipeline."""
    c, phase = COURSES[name], PHASES[seed % 3]
    made = measure_run(_truth(name, phase), Apu(), seed)
    e = estimate(read_recording(*(d.drop_vars("PW", errors="ignore") for d in made.values())))
    side, m = e.sides[1], e.machines[1]
    said = m["faulty_phase"].values.astype(int)
    alarms = [float(m["time"].values[k]) for k in 1 + np.flatnonzero(said[1:] > said[:-1])]
    alarms += [float(side.t[k]) for k, _, _ in severity_changes(side.beliefs)]
    h, s = (m[f"h_{phase}{end}"].values for end in ("", "_sigma"))
    right = f"machine 1: short circuit {phase}"
    return _told(e, alarms, ONSET, right) | _scored(m["time"].values - ONSET, h, s, c)


def _told(e: Any, alarms: list[float], onset: float, right: str) -> dict[str, Any]:
    """First alarm after the onset, those before it, and the answer."""
    late = [t - onset for t in alarms if t > onset + 1e-9]
    out: dict[str, Any] = {"late": min(late, default=None)}
    out["before"] = len(alarms) - len(late)
    answer = next((d for d in e.diagnoses if d.t >= onset - 0.05), None)
    out |= {"answered": answer is not None, "right": answer is not None and answer.best == right}
    return out


def _alone(name: str, seed: int) -> dict[str, Any]:
    """One run of the electrical filter with exact sensors."""
    c, phase = COURSES[name], PHASES[seed % 3]
    event = FaultChange(SHORT, _severity(c)(phase))
    truth = unit_truth(2 * SHORT, (event,), load=SeriesLoad.from_power(LOAD))
    samples = samples_of(truth, np.random.default_rng(seed))
    filt = electrical_filter()
    r, _ = track(filt, filt.prior(samples), filt.recording(samples))
    h, s = r[f"h_{phase}"]
    over = np.flatnonzero((h / s > math.sqrt(FAULT_LEVEL)) & (r.t > SHORT))
    most = max(
        float((r[f"h_{p}"][0] / r[f"h_{p}"][1])[500 : round(SHORT * 1e4)].max()) for p in PHASES
    )
    out: dict[str, Any] = {"late": float(r.t[over[0]]) - SHORT if over.size else None}
    out |= {"before": int(most > math.sqrt(FAULT_LEVEL)), "answered": False, "right": False}
    return out | _scored(r.t - SHORT, h, s, c)


def _gas(name: str, seed: int) -> dict[str, Any]:
    """One run of the gas path."""
    c = COURSES[name]
    of = measure_run(_truth(name, "a"), Apu(), seed)["gaspath"]
    if c.of not in HEALTH:
        of[c.of].values[:] *= 1 + c.at(of["time"].values - GAS_ONSET)
    e = estimate(read_recording(of), only="gaspath")
    assert e.gaspath is not None
    alarms = json.loads(e.gaspath.attrs["alarms"])
    right = "gas path" if c.of in HEALTH else f"sensor {c.of}"
    out = _told(e, alarms, GAS_ONSET, right)
    t = e.gaspath["time"].values - GAS_ONSET
    if c.of in HEALTH:
        x, s = (e.gaspath[f"{c.of}{end}"].values for end in ("", "_sigma"))
        return out | _scored(t, x - 1, s, c)
    z = np.array([(e.gaspath[n] - 1) / e.gaspath[f"{n}_sigma"] for n in HEALTH])[:, t > 0]
    return out | {"lag": None, "z": float(np.sqrt(np.mean(z**2))), "most": float(np.abs(z).max())}


def _run(name: str, n: int, seed0: int, tell: Tell) -> Any:
    c, runs = COURSES[name], []
    of = _alone if c.exact else _short if c.of == "h" else _gas
    for k in range(n):
        runs.append(of(name, seed0 + k))
        tell(k + 1, n)
    return {"bound": bound_instant(name), "runs": runs}


for _name, _course in COURSES.items():
    STUDY.part(_name, start=8, each=2.0 if _course.of == "h" else 0.8)(partial(_run, _name))


# ------------------------------------------------------------------------------ report


def _row(name: str, r: Results) -> dict[str, Any]:
    c, bound, runs = COURSES[name], r[name]["bound"], r[name]["runs"]
    late = np.array([math.inf if x["late"] is None else x["late"] for x in runs])
    step = 0.0 if c.exact else DT
    limit = FACTOR * (math.inf if bound is None else bound)
    # the first instant of the estimate at or after it
    if step and math.isfinite(limit):
        limit = step * max(math.ceil(limit / step - 1e-6), 1)
    good = int((late <= limit + 1e-6).sum())
    low, high = share_interval(good, len(runs))
    row: dict[str, Any] = {"words": c.words, "runs": len(runs), "bound": _ms(bound)}
    row |= {"late": _ms(float(np.median(late))), "longest": _ms(float(late.max()))}
    row |= {"share": good / len(runs), "low": low, "high": high, "in_time": good}
    row |= {k: sum(x[k] for x in runs) for k in ("before", "answered", "right")}
    lags = [x["lag"] for x in runs if x["lag"] is not None]
    row["lag"] = _ms(float(np.mean(lags))) if lags else "-"
    row["z"] = math.sqrt(float(np.mean([x["z"] ** 2 for x in runs])))
    return row | {"most": max(x["most"] for x in runs)}


def _ms(t: float | None) -> str:
    return f"{1e3 * t:.0f}" if t is not None and math.isfinite(t) else "-"


@STUDY.claims
def claims(r: Results) -> list[Claim]:
    """Claim alarms in time, and errors within what is said of them."""
    out = []
    for name in (n for n in COURSES if n in r):
        row, c = _row(name, r), COURSES[name]
        what = {"h": "severity"}.get(c.of, "factor" if c.of in HEALTH else "sensor")
        more: dict[str, Any] = {"seeds": r.seeds_from(name)}
        more["why"] = STUDY.template.text("late", what=what)
        good = row["share"] >= IN_TIME
        out.append(STUDY.claim("claim alarm", good, **row | more | {"goal": IN_TIME}))
        lag = "not" if row["lag"] == "-" else f"{row['lag']} ms"
        more |= {"goal": WORST, "lag": lag}
        out.append(STUDY.claim("claim error", row["z"] <= WORST, **row | more))
    return out


@STUDY.section
def section(r: Results) -> list[str]:
    """Show every course."""
    rows = [_row(name, r) for name in COURSES if name in r]
    return [STUDY.template.table("table", rows), STUDY.template.text("lag")] if rows else []
