"""Detection of a short circuit: its delay, the right phase, false alarms."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from estimators.information.consistency import share_interval
from scenarios.figures.studyplot import plot_rate
from scenarios.studies.electrical.alarms import false_alarms, quiet
from scenarios.studies.electrical.delays import detection
from scenarios.studies.electrical.protocol import filters
from scenarios.studies.registration import Claim, Pictures, Results, Study, Tell

__all__ = ["STUDY"]

HOURS_PER_SEED = 0.002  # an hour for 500
FOUND = 0.95  # of the runs, in time
KINDS = ("exact sensors", "gain errors")

STUDY = Study(
    "detection",
    order=30,
    title="Detection of a short circuit",
    goal="h = 1e-4 found within 20 electrical periods, h = 3e-4 within 50 with gain errors and "
    "unbalance; at most one false alarm an hour; load steps and gas faults raise none.",
    seed0=12_000,
    tuned="tuned on seeds below 10000; 10000 to 10499 were looked at before",
    modules={
        "electrical": ("estimators.apu.electrical",),
        "electrical_study": ("scenarios.studies.electrical",),
    },
    filters=filters,
    text="""
@intro
An alarm is a severity h of one phase above a fixed multiple of its standard deviation (below).
Phase and onset are random. In the mismatched runs the load is unbalanced by 5 % and all eight
sensors have gain errors of 0.5 %, of which the filter knows the standard deviation only. The filter
has no healthy baseline: it meets the machine 0.1 s before the fault.

@matched
h = 1e-4, balanced load, exact sensors

@mismatched
h = 3e-4, unbalanced load, gain errors

@found
5 | {words}: found within {within_periods} electrical periods | >= {goal:.0%} of the runs
| {found:.1%} | {found_interval:.1%} | {seeds}
| median delay {delay_periods[median]:.1f} periods, 95 % after {late}

@later
more than was simulated

@rate
5 | false alarms in healthy operation, per hour | <= 1 | {rate_per_hour:.1e}
| {alarms} counted in {hours:.2f} h: at most {upper_95_per_hour_from_count:.1f} an hour (95 %)
| one for every 10 s | the level for one an hour would be {level_for_one_per_hour:.0f}

@quiet
5 | load steps and gas faults that raise an alarm | 0 runs | {alarms} alarms
| {n} runs: at most {most:.2%} (95 %) | {each} each
| {raised}, where 5 is the level; all other kinds raised none

@raised
{alarms} of {n_seeds} runs of '{name}' with {kind}, at most {largest_h_over_sigma:.2f} sigma of h

@level
Alarm at {z:g} standard deviations:

@delays
h | found in time | delay, periods: median | 95 % | longest | right phase | alarms before
| 1 sigma of h
---
{h:g}, {case} | {found:.1%} | {delay_periods[median]:.1f} | {delay_periods[p95]:.1f}
| {delay_periods[max]:.1f} | {right_phase:.1%} | {false_alarms_before} | {sigma_h:.1e}

@operation
Operation without an electrical fault:

@kinds
case | seeds | alarms, exact sensors | alarms, gain errors | largest h over sigma | with gain errors
| resets | chance of an alarm in a run, with gain errors
---
{name} | {n_seeds} | {exact sensors[alarms]} | {gain errors[alarms]}
| {exact sensors[largest_h_over_sigma]:.1f} | {gain errors[largest_h_over_sigma]:.1f}
| {exact sensors[resets]} | {gain errors[tail][chance_per_run]:.0e}

@resets
A *reset* is what the tracking filter takes for a step of h; it opens its belief, finds h = 0 again
and raises no alarm. The chance of an alarm is that of the tail of the runs' largest statistics,
continued as a Gaussian's. Load steps of the whole unit are simulated with an exchange of 2 ms, each
step twice, so that the speed that is measured is the one the machine turns with: a filter that
considers gain errors hardly corrects its rotor angle, and would take a speed that is off for a
fault.

@false alarms
The rate of false alarms was established so: in {hours:.2f} hours of simulated healthy operation the
largest statistic rose past {z_of_level:g} standard deviations {alarms} times and reached
{largest_z:.2f} at most. Rises past lower levels are frequent enough to be counted; their rate is
continued to the threshold by Rice's formula for Gaussian processes, rate(z) = rate_0 exp(-z^2/2),
whose one constant is fitted{slope}: {rate_per_hour:.1e} an hour. By the count alone it is at most
{upper_95_per_hour_from_count:.1f} an hour with 95 % confidence.

@slope
(slope of the logarithm {slope_of_log_rate:.2f} where -1 is expected)

@caption
{hours:.2f} hours of healthy operation at 225 kW. Bars: one standard deviation of the count.
""",
)


def _detection(case: str, n: int, seed0: int, tell: Tell) -> Any:
    return detection(n, seed0, cases=[case])[case]


STUDY.part("matched", start=5, each=0.02)(partial(_detection, "matched"))
STUDY.part("mismatched", start=15, each=0.075)(partial(_detection, "mismatched"))


@STUDY.part("quiet", start=15, each=2.4)
def _quiet(n: int, seed0: int, tell: Tell) -> Any:
    return quiet(n, seed0)


@STUDY.part("false alarms", start=2, each=0.6)
def _false_alarms(n: int, seed0: int, tell: Tell) -> Any:
    return false_alarms(HOURS_PER_SEED * n, seed0)


@STUDY.claims
def claims(r: Results) -> list[Claim]:
    """Claim that faults are found in time, and that nothing else raises an alarm."""
    out, t = [], STUDY.template
    for case in ("matched", "mismatched"):
        if case in r:
            c = r[case]
            p95 = c["delay_periods"]["p95"]
            late = t.text("later") if p95 is None else f"{p95:.1f}"
            values = {"goal": FOUND, "words": t.text(case), "late": late}
            out.append(STUDY.claim("found", c["found"] >= FOUND, **values, **c))
    if "false alarms" in r:
        c = r["false alarms"]
        met = c["rate_per_hour"] <= 1 and c["alarms"] <= max(1.0, c["hours"])
        out.append(STUDY.claim("rate", met, **c))
    if "quiet" in r:
        out.append(_quiet_claim(r["quiet"]))
    return out


def _quiet_claim(kinds: Mapping[str, Any]) -> Claim:
    """Claim that load steps and gas faults raise no alarm; else say what did, and how far."""
    rows = list(kinds.values())
    alarms = sum(v[k]["alarms"] for v in rows for k in KINDS)
    n = sum(2 * v["n_seeds"] for v in rows)
    raised = "; ".join(
        STUDY.template.text("raised", name=name, kind=k, n_seeds=v["n_seeds"], **v[k])
        for name, v in kinds.items()
        for k in KINDS
        if v[k]["alarms"]
    )
    values = {"alarms": alarms, "n": n, "most": share_interval(min(alarms, n), n)[1]}
    return STUDY.claim("quiet", alarms == 0, each=rows[0]["n_seeds"], raised=raised, **values)


@STUDY.section
def section(r: Results) -> list[str]:
    """Show delays, kinds of operation without a fault, and how the rate was established."""
    out, t = [], STUDY.template
    rows = [{"case": case, **r[case]} for case in ("matched", "mismatched") if case in r]
    if rows:
        out += [t.text("level", z=rows[0]["level"] ** 0.5), t.table("delays", rows)]
    if "quiet" in r:
        kinds = [{"name": name, **c} for name, c in r["quiet"].items()]
        out += [t.text("operation"), t.table("kinds", kinds), t.text("resets")]
    if "false alarms" in r:
        c = r["false alarms"]
        slope = "" if c["slope_of_log_rate"] is None else " " + t.text("slope", **c)
        out.append(t.text("false alarms", slope=slope, **c))
    return out


@STUDY.figures
def figures(r: Results) -> Pictures:
    """Draw the rate of false alarms over the level."""
    if "false alarms" not in r:
        return {}
    c = r["false alarms"]
    tail, note = c["tail"], STUDY.template.text("caption", **c)
    curves = {k: tail[k] for k in ("z", "counts", "expected")}
    fig = partial(
        plot_rate, **curves, hours=c["hours"], threshold=c["z_of_level"], goal=1, note=note
    )
    return {"False alarms of a healthy machine": ("estimation_false_alarms.png", fig)}
