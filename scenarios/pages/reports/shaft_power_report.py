"""What the study of the shaft power shows: by how much it reduces the errors of health."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from scenarios.pages.reports.claims import Claim, Pictures, Report
from scenarios.pages.reports.words import between, percent, table
from scenarios.studies.catalogue import Results

__all__ = ["REPORT"]


_AIMS = {"exact efficiency": 0.5, "efficiency bias": 0.3}
_FILTERS = {
    "filter": ("filter, exact sensors", 0.5),
    "filter, bias": ("filter, efficiency bias", 0.3),
    "filter, gain errors": ("filter, gain errors", 0.5),
    "filter, bias and gain errors": ("filter, efficiency bias and gain errors", 0.3),
}


def claims(r: Results) -> list[Claim]:
    """Return what is claimed, goal by goal."""
    out = []
    needed = r.get("snapshot", {}).get("needed_samples", {})
    for label, aim in _AIMS.items():
        if "trials" in r:
            c = r["trials"][label]
            out.append(Claim(
                4, f"reduction of the error, snapshot of 1 s, {label}", f">= {percent(aim, 0)}",
                percent(c["reduction"]), between(c["interval"], ".1f", 100, " %"),
                r.seeds_from("trials"), c["reduction"] >= aim,
                f"averaging {needed.get(label)} samples would do",
            ))  # fmt: skip
    for key, (words, aim) in _FILTERS.items():
        if key in r:
            c = r[key]
            for when in ("snapshot", "transient"):
                v = c[when]
                place = "before" if when == "snapshot" else "4 s after"
                out.append(Claim(
                    4, f"reduction, {words}, {place} the load drop", f">= {percent(aim, 0)}",
                    percent(v["reduction"]), between(v["interval"], ".1f", 100, " %"),
                    r.seeds_from(key), v["reduction"] >= aim,
                    _power_why(key, when, v),
                ))  # fmt: skip
    return out


def _power_why(key: str, when: str, v: Mapping[str, Any]) -> str:
    null = f"null direction {percent(v['null_rmse'][1], 2)} -> {percent(v['null_rmse'][0], 2)}"
    reasons = []
    if "gain" in key:
        reasons.append("information limit: constant gain errors, which no averaging removes, leave "
                       "errors in directions that shaft power does not show")  # fmt: skip
    if when == "transient":
        reasons.append("the load drop alone, with measured fuel and speed, already tells much of "
                       "what the shaft power would")  # fmt: skip
    if "bias" in key:
        reasons.append("an efficiency uncertain by 2 % is taken for power")
    return "; ".join([*reasons, null])


def section(r: Results) -> list[str]:
    """Return the blocks of text and tables."""
    out = []
    if "trials" in r:
        out.append("Most probable health from snapshots of 1 s of the nonlinear engine:")
        out.append(table(
            ["case", "seeds", "RMS error without", "with", "bound without", "with", "reduction",
             "95 % interval", "NEES over 4"],
            [[label, str(c["seeds"]), percent(c["rms_before"], 2), percent(c["rms_after"], 2),
              percent(c["bound_before"], 2), percent(c["bound_after"], 2), percent(c["reduction"]),
              between(c["interval"], ".1f", 100, " %"), f"{c['nees']:.2f}"]
             for label, c in r["trials"].items()],
        ))  # fmt: skip
    rows = []
    for key, (words, _) in _FILTERS.items():
        if key in r:
            for when, v in r[key].items():
                if when not in ("snapshot", "transient"):
                    continue
                rows.append([
                    f"{words}, {'2 s' if when == 'snapshot' else '6 s'}", percent(v["reduction"]),
                    between(v["interval"], ".1f", 100, " %"), percent(v["null_rmse"][1], 2),
                    percent(v["null_claimed"][1], 2), percent(v["null_rmse"][0], 2),
                    percent(v["null_claimed"][0], 2),
                ])  # fmt: skip
    if rows:
        out.append("The gas-path filter with and without shaft power, on the same noise; load drop "
                   "at 2 s:")  # fmt: skip
        out.append(table(
            ["case, instant", "reduction", "95 % interval", "null direction without: error",
             "claimed", "with: error", "claimed"], rows,
        ))  # fmt: skip
    if "sweep" in r:
        swept = [x for x in r["sweep"]["table"] if x["noise"] == 0.01]
        out.append("How the reduction depends on the prior (covariances, 1 % power noise):")
        out.append(table(
            ["prior", "efficiency bias", "gain errors", "before the load drop", "after it",
             "null direction without, after", "with"],
            [[percent(x["prior"]), percent(x["eta"], 0), "yes" if x["gains"] else "no",
              percent(x["snapshot"]["reduction"], 0), percent(x["transient"]["reduction"], 0),
              percent(x["transient"]["null_without"], 2), percent(x["transient"]["null_with"], 2)]
             for x in swept],
        ))  # fmt: skip
    if "snapshot" in r:
        c = r["snapshot"]
        out.append(
            "If one sensor alone has its gain error (efficiency bias included), the reduction in a "
            "snapshot is: "
            + ", ".join(f"{n} {percent(v, 0)}" for n, v in c["limiting_gains"].items()) + ". "
            "Samples of 20 ms that have to be averaged to reach the aim: "
            + ", ".join(f"{k} {v}" for k, v in c["needed_samples"].items()) + "."
        )  # fmt: skip
    return out


def figures(r: Results) -> Pictures:
    """Return the figures, not drawn yet."""
    from scenarios.figures.estimationplot import plot_gain_of_a_sensor

    made: Pictures = {}
    if "snapshot" in r:
        c = r["snapshot"]
        curves = {}
        for label in dict.fromkeys(x["variant"] for x in c["rows"]):
            rows = [x for x in c["rows"] if x["variant"] == label]
            curves[label] = {
                k: np.array([x[k] for x in rows])
                for k in ("reduction", "null_before", "null_after")
            }
        fig = partial(
            plot_gain_of_a_sensor,
            c["priors"], curves, aims={k: (0.02, v) for k, v in _AIMS.items()},
            note="Bounds of a snapshot of 1 s at the design point, power noise 1 %. Gain errors "
            "are those of the sensor table, the efficiency is uncertain by 2 %.",
        )  # fmt: skip
        made["Shaft power in a snapshot"] = ("estimation_shaft_power.png", fig)
    if "sweep" in r:
        swept = [x for x in r["sweep"]["table"] if x["noise"] == 0.01]
        kinds = {(False, 0.0): "exact sensors", (False, 0.02): "efficiency bias",
                 (True, 0.0): "gain errors", (True, 0.02): "both"}  # fmt: skip
        priors = sorted({x["prior"] for x in swept})
        curves = {}
        for (gains, eta), label in kinds.items():
            rows = [x["transient"] for x in swept if x["gains"] == gains and x["eta"] == eta]
            curves[label] = {
                "reduction": np.array([x["reduction"] for x in rows]),
                "null_before": np.array([x["null_without"] for x in rows]),
                "null_after": np.array([x["null_with"] for x in rows]),
            }
        fig = partial(
            plot_gain_of_a_sensor,
            priors, curves, aims={"exact sensors": (0.02, 0.5), "efficiency bias": (0.02, 0.3)},
            note="The gas-path filter 4 s after a load drop from 2 x 225 to 2 x 100 kW, power "
            "noise 1 %; covariances of the filter. Without shaft power: the largest of the cases.",
        )  # fmt: skip
        made["Shaft power in the filter"] = ("estimation_shaft_power_filter.png", fig)
    return made


REPORT = Report(
    "With speed held, N, P3, T3, T5 and Wf give as many equations as there are health factors "
    "and fuel flow, but one combination of the factors does not show in them. Shaft power "
    "shows it. How much that helps depends on the prior, on gain errors, and on how well the "
    "generators' efficiency is known; so all three are swept, and the null direction stands "
    "beside the error of the factors.",
    claims, section, figures,
)  # fmt: skip
