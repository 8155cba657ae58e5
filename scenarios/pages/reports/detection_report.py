"""What the study of detection shows: delays of a short circuit, false alarms."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from estimators.information.consistency import share_interval
from scenarios.pages.reports.claims import Claim, Pictures, Report
from scenarios.pages.reports.words import between, percent, seeds_of, table
from scenarios.studies.catalogue import Results

__all__ = ["REPORT"]


def _raised(quiet: Mapping[str, Any]) -> str:
    """Say what raised alarms, and how far they were over the level."""
    said = [
        f"{v[k]['alarms']} of {v['n_seeds']} runs of '{name}' with {k}, at most "
        f"{v[k]['largest_h_over_sigma']:.2f} sigma of h"
        for name, v in quiet.items()
        for k in ("exact sensors", "gain errors")
        if v[k]["alarms"]
    ]
    return "; ".join(said) + ", where 5 is the level; all other kinds raised none"


def claims(r: Results) -> list[Claim]:
    """Return what is claimed, goal by goal."""
    out = []
    for case, words in (("matched", "h = 1e-4, balanced load, exact sensors"),
                        ("mismatched", "h = 3e-4, unbalanced load, gain errors")):  # fmt: skip
        if case in r:
            c = r[case]
            low, high = c["found_interval"]
            p95 = c["delay_periods"]["p95"]
            out.append(Claim(
                5, f"{words}: found within {c['within_periods']} electrical periods",
                f">= {percent(0.95, 0)} of the runs", percent(c["found"]),
                between((low, high), ".1f", 100, " %"), seeds_of(c["seeds"]), c["found"] >= 0.95,
                f"median delay {c['delay_periods']['median']:.1f} periods, 95 % after "
                + ("more than was simulated" if p95 is None else f"{p95:.1f}"),
            ))  # fmt: skip
    if "false alarms" in r:
        c = r["false alarms"]
        out.append(Claim(
            5, "false alarms in healthy operation, per hour", "<= 1", f"{c['rate_per_hour']:.1e}",
            f"{c['alarms']} counted in {c['hours']:.2f} h: at most "
            f"{c['upper_95_per_hour_from_count']:.1f} an hour (95 %)", "one for every 10 s",
            c["rate_per_hour"] <= 1 and c["alarms"] <= max(1.0, c["hours"]),
            f"the level for one an hour would be {c['level_for_one_per_hour']:.0f}",
        ))  # fmt: skip
    if "quiet" in r:
        rows = list(r["quiet"].values())
        alarms = sum(v[k]["alarms"] for v in rows for k in ("exact sensors", "gain errors"))
        n = sum(2 * v["n_seeds"] for v in rows)
        out.append(Claim(
            5, "load steps and gas faults that raise an alarm", "0 runs", f"{alarms} alarms",
            f"{n} runs: at most {percent(share_interval(min(alarms, n), n)[1], 2)} (95 %)",
            f"{rows[0]['n_seeds']} each", alarms == 0, _raised(r["quiet"]),
        ))  # fmt: skip
    return out


def section(r: Results) -> list[str]:
    """Return the blocks of text and tables."""
    out = []
    rows = []
    for case in ("matched", "mismatched"):
        if case in r:
            c = r[case]
            d = c["delay_periods"]
            rows.append([
                f"{c['h']:g}, {case}", percent(c["found"]), f"{d['median']:.1f}",
                "-" if d["p95"] is None else f"{d['p95']:.1f}",
                "-" if d["max"] is None else f"{d['max']:.1f}", percent(c["right_phase"]),
                str(c["false_alarms_before"]), f"{c['sigma_h']:.1e}",
            ])  # fmt: skip
    if rows:
        level = next(r[k] for k in ("matched", "mismatched") if k in r)["level"]
        out.append(f"Alarm at {level**0.5:g} standard deviations:")
        out.append(table(
            ["h", "found in time", "delay, periods: median", "95 %", "longest", "right phase",
             "alarms before", "1 sigma of h"], rows,
        ))  # fmt: skip
    if "quiet" in r:
        out.append("Operation without an electrical fault:")
        out.append(table(
            ["case", "seeds", "alarms, exact sensors", "alarms, gain errors",
             "largest h over sigma", "with gain errors", "resets",
             "chance of an alarm in a run, with gain errors"],
            [[name, str(c["n_seeds"]), str(c["exact sensors"]["alarms"]),
              str(c["gain errors"]["alarms"]), f"{c['exact sensors']['largest_h_over_sigma']:.1f}",
              f"{c['gain errors']['largest_h_over_sigma']:.1f}", str(c["exact sensors"]["resets"]),
              f"{c['gain errors']['tail']['chance_per_run']:.0e}"]
             for name, c in r["quiet"].items()],
        ))  # fmt: skip
        out.append(
            "A *reset* is what the tracking filter takes for a step of h; it opens its belief, "
            "finds h = 0 again and raises no alarm. The chance of an alarm is that of the tail of "
            "the runs' largest statistics, continued as a Gaussian's. Load steps of the whole unit "
            "are simulated with an exchange of 2 ms, each step twice, so that the speed that is "
            "measured is the one the machine turns with: a filter that considers gain errors "
            "hardly corrects its rotor angle, and would take a speed that is off for a fault."
        )
    if "false alarms" in r:
        c = r["false alarms"]
        slope = c["slope_of_log_rate"]
        out.append(
            f"The rate of false alarms was established so: in {c['hours']:.2f} hours of simulated "
            f"healthy operation the largest statistic rose past {c['z_of_level']:g} standard "
            f"deviations {c['alarms']} times and reached {c['largest_z']:.2f} at most. Rises past "
            "lower levels are frequent enough to be counted; their rate is continued to the "
            "threshold by Rice's formula for Gaussian processes, rate(z) = rate_0 exp(-z^2/2), "
            "whose one constant is fitted"
            + ("" if slope is None else
               f" (slope of the logarithm {slope:.2f} where -1 is expected)")
            + f": {c['rate_per_hour']:.1e} an hour. By the count alone it is at most "
            f"{c['upper_95_per_hour_from_count']:.1f} an hour with 95 % confidence."
        )  # fmt: skip
    return out


def figures(r: Results) -> Pictures:
    """Return the figures, not drawn yet."""
    if "false alarms" not in r:
        return {}
    from scenarios.figures.studyplot import plot_rate

    c = r["false alarms"]
    fig = partial(
        plot_rate,
        c["tail"]["z"], c["tail"]["counts"], c["tail"]["expected"], c["hours"], c["z_of_level"], 1,
        f"{c['hours']:.2f} hours of healthy operation at 225 kW. Bars: one standard deviation of "
        "the count.",
    )  # fmt: skip
    return {"False alarms of a healthy machine": ("estimation_false_alarms.png", fig)}


REPORT = Report(
    "An alarm is a severity h of one phase above a fixed multiple of its standard deviation "
    "(below). Phase and onset are random. In the mismatched runs the load is unbalanced by 5 % "
    "and all eight sensors have gain errors of 0.5 %, of which the filter knows the standard "
    "deviation only. The filter has no healthy baseline: it meets the machine 0.1 s before the "
    "fault.",
    claims, section, figures,
)  # fmt: skip
