"""What the study of the gas-path filter shows: efficiency, consistency, the null direction."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from scenarios.pages.reports.claims import Claim, Pictures, Report
from scenarios.pages.reports.words import HEALTH, SHARE, between, percent, series, table
from scenarios.studies.catalogue import Results

__all__ = ["REPORT"]

LOST = 0.02  # of a claimed variance, which is linearised at the estimate instead of at the truth


def _outside(values: Sequence[float], band: Sequence[float]) -> str:
    """Tell on which side of its band a mean lies."""
    v = np.asarray(values)
    above, below = float((v > band[1]).mean()), float((v < band[0]).mean())
    side = "above its band, the filter is too sure" if above > below else (
        "below its band, the filter is more careful than it need be"
    )  # fmt: skip
    return f"at {percent(max(above, below), 0)} of the checkpoints the mean lies {side}"


def _chance(mean: float, exact: Sequence[float] | None) -> str:
    """Say what of a mean is the chance of its seeds: the exact filter given the same draws."""
    if exact is None:
        return ""
    return f"; of the {mean:.2f}, {np.mean(exact):.2f} is the chance of these seeds"


def claims(r: Results) -> list[Claim]:
    """Return what is claimed, goal by goal."""
    out = []
    for key, goal in (("matched", 1.2), ("mismatched", 1.5)):
        if key not in r:
            continue
        c = r[key]
        seeds = r.seeds_to(key)
        e = 1.96 * c["ratio_stderr"]
        worst = c["ratio_max"]
        out.append(Claim(
            2, f"four health factors, {key} model: worst RMSE over bound", f"<= {goal}",
            f"{worst:.2f}", f"each known to {percent(e)}; median {c['ratio_median']:.2f}", seeds,
            worst <= goal, "see the section",
        ))  # fmt: skip
        null = c["null"]
        for name, share, values, band, exact in (
            ("NEES", c["nees_inside"], c["nees"], c["nees_band"], c.get("nees_exact")),
            ("NIS", c["nis_inside"], c["nis"], c["nis_band"], None),
            ("NEES along the null direction", null["inside"], null["nees"], null["band"],
             null.get("nees_exact")),
        ):  # fmt: skip
            mean = float(np.mean(values))
            out.append(Claim(
                3, f"health, {key} model: {name} in its band",
                f">= {percent(SHARE, 0)} of checkpoints", percent(share, 0),
                f"mean {mean:.2f}, band {between(band, '.2f')}"
                + (f"; exact filter {np.mean(exact):.2f}" if exact else ""),
                seeds, share >= SHARE, _outside(values, band) + _chance(mean, exact),
            ))  # fmt: skip
        ratio = null["claimed_over_limit"]
        least = min(ratio["of_means"])
        what = f"health, {key} model: claimed variance over its bound, null direction"
        out.append(Claim(
            3, f"{what}, means of the runs", f">= 1 within {percent(LOST, 0)}", f"{least:.3f}",
            "least over checkpoints", seeds, least >= 1 - LOST,
            "the filter linearises at its estimate, the bound at the truth",
        ))  # fmt: skip
        least = null["least_claimed_over_limit"]
        out.append(Claim(
            3, f"{what}, each run", f">= 1 within {percent(LOST, 0)}", f"{least:.3f}",
            "least over seeds and checkpoints", seeds, least >= 1 - LOST,
            "the bound is taken at the truth, the claim at the estimate: run by run their ratio "
            f"scatters by {percent(ratio['sd'])} about {ratio['mean']:.3f}, which no filter that "
            "linearises can avoid",
        ))  # fmt: skip
    return out


def section(r: Results) -> list[str]:
    """Return the blocks of text and tables."""
    out = []
    rows = []
    for key in ("matched", "mismatched"):
        if key in r:
            c = r[key]
            for n in HEALTH:
                ratio = series(c["ratio"][n])
                rows.append([
                    f"{n}, {key}", percent(c["bound"][n][-1], 2), percent(c["rmse"][n][-1], 2),
                    f"{ratio[-1]:.2f}", f"{ratio.max():.2f}",
                ])  # fmt: skip
    if rows:
        out.append(
            table(["factor, model", "bound at 14 s", "RMSE at 14 s", "ratio", "worst ratio"], rows)
        )
    if "nees_exact" in r.get("matched", {}):
        c = r["matched"]
        out.append(
            "What of the NEES is chance is told by the exact Kalman filter of the model linearised "
            "along a healthy run, given the very numbers that were drawn: its NEES is chi-squared, "
            f"and on these seeds {np.mean(c['nees_exact']):.2f} in the mean. The filter's is "
            f"{c['nees_excess']:.2f} above it (standard error {c['nees_excess_stderr']:.2f}): that "
            "is what linearising costs, at a prior of 2 % and a jump of 3 %. All checkpoints of a "
            f"run are worth {c['nees_independent']:.1f} independent numbers, so the share of them "
            "in the band is nearly all or nothing, whatever the filter."
        )
    if "mismatched" in r:
        c = r["mismatched"]
        d = c["delay_samples"]
        out.append(
            f"The mismatched filter has to find the jump of health itself: {c['missed']} of "
            f"{c['seeds']} were missed, {c['false_alarms']} false ones were reported in "
            f"{c['hours']:.1f} hours; delay {20 * (d['median'] or 0):.0f} ms in the median, "
            f"{20 * (d['95 %'] or 0):.0f} ms at 95 %. Mean NEES (4 is expected) of each engine, "
            "over all checkpoints: "
            + ", ".join(f"{n} {np.mean(v):.2f}" for n, v in c["nees_of"].items())
            + ". It is low where gain errors are allowed for other maps and gas data that the "
            "engine does not have."
        )  # fmt: skip
    if "matched" in r:
        null = r["matched"]["null"]
        out.append(
            "The *null direction* is the combination of factors that N, P3, T3, T5 and Wf do not "
            "show: ("
            + ", ".join(f"{v:.2f} {n}" for v, n in zip(null["direction"], HEALTH, strict=True)
                        if abs(v) > 0.005)
            + "). What is claimed of it must not fall below what the prior and the shaft power "
            "leave, whatever the other sensors say."
        )  # fmt: skip
    if "filters" in r:
        exact = r["filters"]["rows"][0].get("nees_exact")
        rows = [
            [x["filter"], f"{x['over_bound']:.3f}", f"{x['nees']:.2f}", str(x["lost"]),
             f"{x['us_per_sample']:.0f}"]
            for x in r["filters"]["rows"]
        ]  # fmt: skip
        out += [
            f"The methods on the same matched data, {r['filters']['rows'][0]['seeds']} seeds (a "
            "smoother knows later samples, and may be below the filters' bound"
            + (f"; the exact linear filter has a NEES of {exact:.2f} on them" if exact else "")
            + "):",
            table(["method", "RMSE over bound", "mean NEES, 4 expected", "runs lost",
                    "us per sample"], rows),
        ]  # fmt: skip
    return out


def figures(r: Results) -> Pictures:
    """Return the figures, not drawn yet."""
    from scenarios.figures.studyplot import plot_consistency, plot_null

    panels: list[Any] = []
    nulls: list[Any] = []
    for key, goal in (("matched", 1.2), ("mismatched", 1.5)):
        if key not in r:
            continue
        c = r[key]
        checks = {
            "NEES": (series(c["nees"]) / 4, [b / 4 for b in c["nees_band"]]),
            "NIS": (series(c["nis"]) / 4, [b / 4 for b in c["nis_band"]]),
            "null direction": (series(c["null"]["nees"]), c["null"]["band"]),
        }
        head = f"{key} model, {c['seeds']} seeds"
        panels.append((head, c["checkpoints"], {n: series(c["ratio"][n]) for n in HEALTH}, goal,
                       checks))  # fmt: skip
        nulls.append((head, c["checkpoints"], {
            "error made": 100 * series(c["null"]["rmse"]),
            "claimed": 100 * series(c["null"]["claimed"]),
            "bound": 100 * series(c["null"]["limit"]),
        }))  # fmt: skip
    if not panels:
        return {}
    fig = partial(
        plot_consistency,
        panels, "Above: RMSE of the health factors over the posterior Cramer-Rao bound; load drop "
        "at 2 s, faults at 6 s. Below: means over the seeds, over what is expected; shaded: their "
        "95 % bands.",
    )  # fmt: skip
    made: Pictures = {
        "Errors of the health factors over their bound": ("estimation_gaspath.png", fig)
    }
    fig = partial(
        plot_null,
        nulls, "RMS error, claimed standard deviation and bound along the combination of factors "
        "that the sensors do not show but for the shaft power.",
        ylabel="null direction, 1 sigma [%]",
    )  # fmt: skip
    made["The null direction"] = ("estimation_null.png", fig)
    return made


REPORT = Report(
    "Speed and four health factors from N, P3, T3, T5, Wf and the shaft power at 20 ms, for 14 "
    "s with a load drop at 2 s and a fault at 6 s. *Matched*: the truth is the filter's model, "
    "noise and all, and the filter is told when the health jumps. *Mismatched*: another "
    "integrator in steps of 5 ms, a governor in between, and in turn the same engine, 10 % "
    "more inertia, other gas data and other component maps; faults of 1 to 4 % in one to four "
    "factors that the filter has to find; gain errors and an efficiency that is off.",
    claims, section, figures,
)  # fmt: skip
