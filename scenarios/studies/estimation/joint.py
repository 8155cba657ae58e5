"""Both filters along the joint scenario: one run, cross-talk, one filter of the whole unit."""

from __future__ import annotations

from functools import partial
from typing import Any

from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import LoadChange
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu.jointcases import cross_talk
from estimators.apu.monolithic_filter import compare_monolithic
from scenarios.studies import jointrun
from scenarios.studies.estimation.speed import both
from scenarios.studies.registration import Claim, Pictures, Results, Study, Tell, numbers

__all__ = ["STUDY"]

MONOLITHIC = 0.4  # s
ENDS = ("design point", "load drop", "gas-path fault", "TTSC fault")

STUDY = Study(
    "joint",
    order=80,
    title="Both together along the paper's joint scenario",
    goal="The loss of a short circuit is not taken for a gas-path fault, nor the other way round.",
    tuned="tuned as the two filters are",
    modules={
        "electrical": ("estimators.apu.electrical",),
        "gaspath": ("estimators.apu.gaspath",),
        "joint": ("estimators.apu.joint",),
    },
    filters=both,
    text="""
@intro
The paper's joint scenario: load drop at 2 s, gas-path fault at 6 s, short circuit of 5 % of the
turns with k_rf = 20 at 10 s. The truth is simulated by CVODES with an exchange of 5 ms; the
electrical filter hands its mean power of each 20 ms with its variance to the gas-path filter, and
the speed goes both ways. All sensors have gain errors.

@claim whole
joint | health factors of the coupled pair against one filter of the whole unit
| <= 0.5 of their sigma | {worst:.2f} | the one filter's sigma is {least:.3f} times the pair's
| {seed}, {duration:g} s | see the section

@claim alarms
joint | short circuit reported as a change of gas-path health within 3 s | 0 runs | {alarms} alarms
| {n} runs | {when} | see the section

@claim moved
joint | largest mean change of a health factor by the short circuit | <= 0.2 % | {moved:.2%}
| {blind:.2%} if the electrical filter knows no short circuit | {when} | see the section

@claim reports
joint | gas-path fault reported as a short circuit | 0 runs | {reports} runs
| h moved by {h:.1e} at most | {when} | see the section

@example
One run (seed {seed}), at the end of each phase:

@whole
The coupled pair against one filter of the whole unit at 10 kHz, in which nothing is handed over, on
{duration:g} s with a load drop in the middle (gains, inertia and efficiency known): largest
difference of the means over the coupled pair's sigma, and the one filter's sigma over the pair's at
the end.

@correlation
The pair does not carry correlations between electrical and gas-path states; in the one filter the
largest is {correlation:.3f} at the end.

@cross-talk
What a short circuit does to the estimated health, and a gas-path fault to h; {seeds} seeds of noise
and gain errors. *Coupled*: the estimators as they are; *healthy machine*: an electrical filter that
knows no short circuits, so that the lost power has to come from somewhere; *no power*: the gas path
gets no shaft power. Changes of the factors from just before the short circuit to 3 s after, mean
and RMS:

@ends
RMSE of the factors at the end of each phase, and RMS of error over claimed sigma (1 is right) in
brackets:
""",
)


@STUDY.part("example", start=30, share=None)
def _example(n: int, seed0: int, tell: Tell) -> Any:
    def progress(done: float, total: float) -> None:
        tell(int(1e3 * done), int(1e3 * total))

    return jointrun.saved(jointrun.estimate(jointrun.truth("joint", progress=progress), seed0))


@STUDY.part("monolithic", start=60, share=None)
def _monolithic(n: int, seed0: int, tell: Tell) -> Any:
    full, part = (SeriesLoad.from_power(P) for P in (225e3, 100e3))
    events = [LoadChange(MONOLITHIC / 2, part)]
    fine: dict[str, Any] = {"dt": 0.005, "exchange": "corrected", "waveform_dt": 1e-4}
    fine["solver"] = "cvodes"
    ds = simulate_joint(Apu(), duration=MONOLITHIC, load=full, events=events, **fine)
    return {"duration": MONOLITHIC, "seed": seed0, "compared": compare_monolithic(ds, seed0)}


@STUDY.part("cross-talk", start=20, each=1.5, share=0.1)
def _cross_talk(n: int, seed0: int, tell: Tell) -> Any:
    return cross_talk(jointrun.truth("joint"), range(seed0, seed0 + n))


@STUDY.claims
def claims(r: Results) -> list[Claim]:
    """Claim that the pair loses nothing, and that no fault is taken for the other kind."""
    out = []
    if "monolithic" in r:
        m = r["monolithic"]
        worst = max(m["compared"][n]["difference_max"] for n in HEALTH)
        least = min(m["compared"][n]["sigma_ratio"] for n in HEALTH)
        out.append(STUDY.claim("claim whole", worst <= 0.5, worst=worst, least=least, **m))
    if "cross-talk" not in r:
        return out
    c = r["cross-talk"]
    v = c["coupled"]
    moved, blind = (max(map(abs, x["change_mean"].values())) for x in (v, c["healthy machine"]))
    alarms, reports = v["health_alarms_after_short_circuit"], v["short_circuits_reported_before"]
    values = {"n": c["seeds"], "when": r.seeds_from("cross-talk"), "alarms": alarms}
    values |= {"moved": moved, "blind": blind, "reports": reports, "h": v["h_change_at_gas_fault"]}
    met = {"alarms": alarms == 0, "moved": moved <= 0.002, "reports": reports == 0}
    return out + [STUDY.claim(f"claim {k}", good, **values) for k, good in met.items()]


@STUDY.section
def section(r: Results) -> list[str]:
    """Show one run, the pair against one filter, and the cross-talk."""
    out, t = [], STUDY.template
    if "example" in r:
        e = r["example"]["report"]
        out += [t.text("example", **e), f"```text\n{jointrun.table(e)}\n```"]
        out.append("\n".join(jointrun.words(e)))
    if "monolithic" in r:
        c = r["monolithic"]["compared"]
        names = [n for n in c if n != "correlation"]
        rows = [
            ["largest difference, sigma", *(f"{c[n]['difference_max']:.2f}" for n in names)],
            ["sigma, one filter over pair", *(f"{c[n]['sigma_ratio']:.3f}" for n in names)],
        ]
        out += [t.text("whole", **r["monolithic"]), numbers(["", *names], rows)]
        out.append(t.text("correlation", **c))
    if "cross-talk" in r:
        c = r["cross-talk"]
        out += [t.text("cross-talk", **c), *_tables(c)]
    return out


def _tables(c: dict[str, Any]) -> list[str]:
    """Show what each estimator makes of the other kind of fault, and the errors of each phase."""
    rows = []
    for name in ("coupled", "healthy machine", "no power"):
        v = c[name]
        mean, rms = v["change_mean"], v["change_rms"]
        changes = [f"{100 * mean[n]:+.2f}, {100 * rms[n]:.2f} %" for n in HEALTH]
        alarms = f"{v['health_alarms_after_short_circuit']}"
        reports, h = f"{v['short_circuits_reported_before']}", f"{v['h_change_at_gas_fault']:.0e}"
        rows.append([name, *changes, alarms, reports, h])
    head = ["health alarms", "runs with false short circuits", "largest change of h"]
    rmse, z = c["coupled"]["rmse_at_ends"], c["coupled"]["z_rms_at_ends"]
    ends = [
        [n, *(f"{100 * rmse[i][k]:.2f} % ({z[i][k]:.2f})" for k in range(len(ENDS)))]
        for i, n in enumerate(HEALTH)
    ]
    return [
        numbers(["estimator", *HEALTH, *head], rows),
        STUDY.template.text("ends"),
        numbers(["factor", *ENDS], ends),
    ]


@STUDY.figures
def figures(r: Results) -> Pictures:
    """Draw the run."""
    if "example" not in r:
        return {}
    fig = partial(jointrun.figure, r["example"])
    return {"Truth, estimate and 95 % band along the joint scenario": ("estimation_joint.png", fig)}
