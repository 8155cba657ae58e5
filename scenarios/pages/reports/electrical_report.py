"""What the studies of the electrical filter show: efficiency, consistency, mu and k_rf apart."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from scenarios.pages.reports.claims import Claim, Pictures, Report
from scenarios.pages.reports.words import SHARE, between, percent, seeds_of, series, table
from scenarios.studies.catalogue import Results

__all__ = ["REPORT"]


_CASES = {
    "matched": ("matched", "matched model"),
    "fault": ("fault, unbalance", "fault and unbalance"),
    "constant": ("the same, h told to be constant", "fault and unbalance, h told to be constant"),
    "gains": ("gain errors estimated", "fault, unbalance and gain errors"),
    "gains, two passes": (
        "gain errors estimated, two passes",
        "fault, unbalance and gain errors, two passes",
    ),
    "gains considered": ("gain errors considered", "fault, unbalance and gain errors considered"),
    "gains ignored": ("gain errors ignored", "the same, filter without gains"),
}

_NO_GOAL = "gains ignored"  # it shows what a filter loses that does not know of gain errors
_NO_NIS = "gains considered"  # the NIS holds constant offsets, and is no test

#: In the figure, which holds four.
_DRAWN = ("matched", "fault", "gains", "gains, two passes")

#: Why a mean is off, by case; elsewhere the seeds themselves.
_WHY = {
    "fault": "the filter allows for severities and fluxes that walk, and here they do not",
    "constant": "the filter takes the start for worse known than it is, for the sake of unbalance "
    "and transients, and without a walk it is long in forgetting that",
    "gains": "the angle's error turns the derivatives and is in the innovations as well, so that "
    "what is seen weakly, gains and h together, gathers a bias; a second pass, linearised about "
    "the smoothed estimates, halves it",
    "gains considered": "the filter allows for severities, an angle and fluxes that walk, and here "
    "they do not",
}


def _off(case: str, v: Mapping[str, Any]) -> str:
    """Say by how much a mean is off what is expected, what its band asks for, and why."""
    dof, mean = v["dof"], v["mean"]
    known = f" +- {v['mean_error']:.2f}" if "mean_error" in v else ""
    low, high = ((x / dof) ** 0.5 - 1 for x in v["range"])
    said = f"the mean over all is {mean:.2f}{known} instead of {dof:g}: at some checkpoint the "
    if mean > dof:
        asked = percent((v["band"][1] / dof) ** 0.5 - 1)
        said += f"errors are {percent(high)} larger than claimed, where the band of so many seeds "
        said += f"allows {asked}"
    else:
        said += f"errors are {percent(-low)} smaller than claimed"
    why = _WHY.get(case)
    return f"{said}. {why[0].upper()}{why[1:]}" if why else said


def claims(r: Results) -> list[Claim]:
    """Return what is claimed, goal by goal."""
    out = []
    for case, (_, words) in _CASES.items():
        if case not in r or case == _NO_GOAL:
            continue
        c = r[case]
        seeds = seeds_of(c["seeds"])
        out.append(Claim(
            2, f"h, {words}: worst RMSE over bound", f"<= {c['goal']:g}",
            f"{c['ratio_worst']:.2f}", f"at the end {between(c['ratio_end_interval'], '.2f')}",
            seeds, c["ratio_worst"] <= c["goal"], "see the section",
        ))  # fmt: skip
        checks = {"NEES of h": c["nees_h"], "NIS": c["nis"]}
        if "nees" in c:
            checks = {"NEES of all states": c["nees"], **checks}
        if case == _NO_NIS:
            del checks["NIS"]
        for name, v in checks.items():
            wide = "" if v["share"] >= SHARE else _off(case, v)
            out.append(Claim(
                3, f"h, {words}: {name} in its band", f">= {percent(SHARE, 0)} of checkpoints",
                percent(v["share"], 0), f"mean {v['mean']:.2f}, expected {v['dof']:g}", seeds,
                v["share"] >= SHARE, wide,
            ))  # fmt: skip
    return out


def section(r: Results) -> list[str]:
    """Return the blocks of text and tables."""
    rows = []
    for case, (words, _) in _CASES.items():
        if case in r:
            c = r[case]
            end = float(np.sqrt(np.mean([c["rmse_h"][k][-1] ** 2 for k in "abc"])))
            rows.append([
                words, f"{end:.1e}",
                f"{c['ratio_end']:.2f} ({between(c['ratio_end_interval'], '.2f')})",
                f"{c['ratio_worst']:.2f}", f"{c['nees_h']['mean']:.2f} of 3",
                percent(c["nees_h"]["share"], 0),
                *(("no test", "-") if case == _NO_NIS else
                  (f"{c['nis']['mean']:.2f} of 4", percent(c["nis"]["share"], 0))),
            ])  # fmt: skip
    out = []
    if rows:
        out.append(table(
            ["case", "RMSE of h after 0.3 s", "over bound, at the end", "worst", "mean NEES of h",
             "in band", "mean NIS", "in band"], rows,
        ))  # fmt: skip
    if _NO_GOAL in r:
        c = r[_NO_GOAL]
        out.append(
            "Nothing is asked of the last case; it shows what gain errors of 0.5 % do to a filter "
            f"that does not know of them: it errs by {c['ratio_end']:.0f} times what it believes, "
            "and NIS tells so. Gain errors of three voltages and three currents look like the "
            "current of a short circuit; a filter must carry them, at the price of a larger error."
        )
    if "leaky" in r:
        out += _leaky(r["leaky"])
    if "ridge" in r:
        out += _ridge(r["ridge"])
    return out


def _leaky(c: Mapping[str, Any]) -> list[str]:
    rows = []
    off = 0.0
    for x in c["known"]:
        z = max(r / s for r, s in zip(x["rmse"], x["claimed"], strict=True))
        off = max(off, z)
        rows.append([
            f"{x['mu']:g}, {x['k_rf']:g}, {x['kappa']:g}", f"{x['h']:.1e}",
            f"{x['mean'][0]:.4g}", f"{x['claimed'][0]:.1g}", f"{x['mean'][1]:.3g}",
            f"{x['claimed'][1]:.2g}", f"{z:.1f}", f"{x['nis']:.2f}",
        ])  # fmt: skip
    wrong = [
        [f"{x['mu']:g}, {x['k_rf']:g}", f"{v['estimate'][0]:.4g}, {v['estimate'][1]:.3g}",
         f"{v['expected'][0]:.4g}, {round(v['expected'][1], 9) + 0.0:.3g}",
         f"{v['put_right'][0]:.4g}, {v['put_right'][1]:.3g}", f"{v['nis']:.2f}",
         f"{f['nis']:.2f}"]
        for x in c["wrong"]
        for v, f in ((x["kappa 0.5 assumed"], x["full coupling assumed"]),)
    ]  # fmt: skip
    out = [
        "With kappa > mu the fault branch has an inductance of its own, and mu and k_rf can be "
        f"told apart if it shows. A filter that knows kappa and the phase, {c['n_seeds']} seeds "
        "(last but one: the larger RMS error over its 1 sigma, 1 is right; NIS: 4 is expected):",
        table(["true mu, k_rf, kappa", "h", "mu found", "1 sigma", "k_rf found", "1 sigma",
                "error over sigma", "NIS"], rows),
    ]  # fmt: skip
    out.append(
        f"The largest error is {off:.1f} claimed sigmas; below 1 since the filter allows for a "
        "branch that changes slowly. It estimates the branch's conductance and susceptance at "
        "rated frequency, of which the currents are nearly linear, and tells mu and k_rf from "
        "them; written in mu and k_rf it would be sure before it has arrived. The "
        "current of a branch decays within 80 us (the last row) to 2 ms, so it has an exact step "
        "of its own. A branch whose susceptance is not above three sigmas shows no inductance, "
        "and the filter refuses to tell mu from k_rf."
    )
    return [
        *out,
        "What a wrong kappa does (truth: kappa = 1, the filter assumes 0.5): another pair (mu, "
        "k_rf) of the same shunt, put right by the kappa that is known later; NIS does not tell. A "
        "filter with full coupling has no inductance at all, and its NIS does:",
        table(["true mu, k_rf", "found with kappa 0.5", "expected then", "put right with kappa 1",
                "NIS", "NIS, full coupling"], wrong),
    ]  # fmt: skip


def _ridge(c: Mapping[str, Any]) -> list[str]:
    def of(x: float | None) -> str:
        return "ridge" if x is None else percent(x, 2)

    rows = [
        [f"{x['fault']['mu']:g}, {x['fault']['k_rf']:g}, {x['fault']['kappa']:g}", f"{x['h']:.1e}",
         of(x["sigma_h"]), of(x["sigma_mu"]), of(x["sigma_k_rf"])]
        for x in c["rows"]
    ]  # fmt: skip
    return [
        "Bounds on what 8 electrical periods can tell of the severity (relative, current sensor "
        "with gain error). *Ridge*: for kappa = mu, the paper's model, mu and k_rf act through "
        "h = mu/(k_rf + 1 - mu) alone, and no measurement at the terminals separates them:",
        table(["mu, k_rf, kappa", "h", "1 sigma of h", "of mu", "of k_rf"], rows),
    ]


def figures(r: Results) -> Pictures:
    """Return the figures, not drawn yet."""
    from scenarios.figures.studyplot import plot_consistency

    panels: list[Any] = []
    for case in _DRAWN:
        if case not in r:
            continue
        words, _ = _CASES[case]
        c = r[case]
        ratios = {f"h_{k}": series(c["rmse_h"][k]) / series(c["bound_h"][k]) for k in "abc"}
        checks = {}
        if "course" in c["nees_h"]:
            for name, key in (("NEES of h", "nees_h"), ("NIS", "nis")):
                v = c[key]
                checks[name] = (series(v["course"]) / v["dof"],
                                tuple(b / v["dof"] for b in v["band"]))  # fmt: skip
        panels.append((words, c["t"], ratios, c["goal"], checks))
    if not panels:
        return {}
    fig = partial(
        plot_consistency,
        panels, "Above: RMSE of the three severities over the posterior Cramer-Rao bound. Below: "
        "means over the seeds, over what is expected; shaded: their 95 % bands.",
    )  # fmt: skip
    return {"Error of h over its bound": ("estimation_electrical.png", fig)}


REPORT = Report(
    "Fluxes, rotor angle and the severity h of a short circuit in each phase from voltages, "
    "currents, field voltage and current and speed at 10 kHz, for 0.3 s at 225 kW. The truth "
    "is the generator with load and exciter, integrated by CVODES at 1e-9. *Matched*: "
    "severities, fluxes and their random walks are drawn as the filter believes. The other "
    "cases simulate a short circuit of h = 3e-4 in phase b and a load unbalanced by 5 %.",
    claims, section, figures,
)  # fmt: skip
