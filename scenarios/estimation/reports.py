"""What the results of the estimation studies show: claims with numbers, text, figures.

Everything here is made from the kept numbers alone, so that a page can be written again without
running anything.  A part that has not been run is left out, and said to be missing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from scenarios.estimation import jointrun
from scenarios.estimation.correctness import GOAL as EXACT
from scenarios.estimation.studies import GAS_PATH_SEED0
from scenarios.pages import markdown_table

__all__ = ["REPORTS", "Claim", "Report"]

Results = Mapping[str, Any]
Pictures = dict[str, tuple[str, Callable[[], Any]]]
"""By caption: name of the file, and what makes the figure."""
JOINT = "joint"
HEALTH = ("f_eta_c", "f_W_c", "f_eta_t", "f_W_t")
SHARE = 0.9  # of the checkpoints that should lie in their band
COVERED = (0.93, 0.97)
KAPPA = 0.8
LOST = 0.02  # of a claimed variance, which is linearised at the estimate instead of at the truth


@dataclass(frozen=True)
class Claim:
    """One line of the table of goals.

    Parameters
    ----------
    goal : number of the goal, or "joint".
    what, target, achieved, interval, seeds : texts.
    met : None where nothing was asked.
    why : the reason, where it was missed.
    """

    goal: int | str
    what: str
    target: str
    achieved: str
    interval: str
    seeds: str
    met: bool | None
    why: str = ""


@dataclass(frozen=True)
class Report:
    """How the results of one study are shown.

    Parameters
    ----------
    intro : what was done, in plain words.
    claims, section : from the results by part.
    figures : results -> :data:`Pictures`.
    """

    intro: str
    claims: Callable[[Results], list[Claim]]
    section: Callable[[Results], list[str]]
    figures: Callable[[Results], Pictures]


# ------------------------------------------------------------------------------ small words


def percent(x: float | None, digits: int = 1) -> str:
    """A share as per cent."""
    return "-" if x is None else f"{100 * x:.{digits}f} %"


def between(pair: Sequence[float], form: str = ".3f", scale: float = 1.0, unit: str = "") -> str:
    """An interval."""
    return f"{scale * pair[0]:{form}} to {scale * pair[1]:{form}}{unit}"


def seeds_of(pair: Sequence[int]) -> str:
    """First and last seed."""
    return f"{pair[0]} to {pair[1]}"


def _series(x: Sequence[float | None]) -> np.ndarray:
    return np.array([np.nan if v is None else v for v in x], float)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    return markdown_table(head, rows, right=range(1, len(head)))


def _binomial(k: int, n: int) -> tuple[float, float]:
    """95 % interval of a share, Clopper and Pearson (1934)."""
    from scipy.stats import beta

    low = float(beta.ppf(0.025, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
    return low, high


def _outside(values: Sequence[float], band: Sequence[float]) -> str:
    """Tell on which side of its band a mean lies."""
    v = np.asarray(values)
    above, below = float((v > band[1]).mean()), float((v < band[0]).mean())
    side = "above its band, the filter is too sure" if above > below else (
        "below its band, the filter is more careful than it need be"
    )  # fmt: skip
    return f"at {percent(max(above, below), 0)} of the checkpoints the mean lies {side}"


# ------------------------------------------------------------------------------ correctness


def _correctness_claims(r: Results) -> list[Claim]:
    if "linear" not in r:
        return []
    c = r["linear"]
    ours = [x for x in c["rows"] if "filterpy" not in x["name"]]
    peers = [x for x in c["rows"] if "filterpy" in x["name"]]
    out = []
    for what, rows in (
        ("EKF, iterated EKF, UKF, moving horizon and smoother against Kalman filter and batch "
         "least squares", ours),
        ("EKF and UKF against filterpy's", peers),
    ):  # fmt: skip
        if rows:
            worst = max(x["largest"] for x in rows)
            out.append(Claim(1, what, f"<= {EXACT:.0e}", f"{worst:.0e}", "largest difference",
                             seeds_of(c["seeds"]), worst <= EXACT))  # fmt: skip
    return out


def _correctness_section(r: Results) -> list[str]:
    if "linear" not in r:
        return []
    rows = [[x["name"], str(x["seeds"]), f"{x['largest']:.1e}"] for x in r["linear"]["rows"]]
    return [
        "Largest difference of any mean or covariance over 1 + its size:",
        _table(["compared", "systems", "largest difference"], rows),
        "The tests say more: `tests/test_ekf.py`, `test_ukf.py`, `test_mhe.py`, "
        "`test_smoother.py`, `test_filterpy_adapter.py` compare predictions, likelihoods and "
        "innovations as well, with silent sensors, irregular instants, singular priors and "
        "considered states.",
    ]


# ------------------------------------------------------------------------------ electrical

_CASES = {
    "matched": ("matched", "matched model"),
    "fault": ("fault, unbalance", "fault and unbalance"),
    "gains": ("gain errors estimated", "fault, unbalance and gain errors"),
    "gains ignored": ("gain errors ignored", "the same, filter without gains"),
}


def _ignored(case: str) -> bool:
    return case == "gains ignored"


def _off(v: Mapping[str, Any]) -> str:
    """Say by how much a mean is off what is expected, and what its band asks for."""
    dof, mean = v["dof"], v["mean"]
    asked = percent((v["band"][1] / dof) ** 0.5 - 1)
    low, high = ((x / dof) ** 0.5 - 1 for x in v["range"])
    said = f"the mean over all is {mean:.2f} instead of {dof:g}"
    if mean > dof:
        return (
            f"{said}; at some checkpoint the errors are {percent(high)} larger than claimed, where "
            f"the band of so many seeds allows {asked}"
        )
    return (
        f"{said}: the errors are up to {percent(-low)} smaller than claimed, since the filter "
        "allows for severities and fluxes that walk, and here they do not"
    )


def _electrical_claims(r: Results) -> list[Claim]:
    out = []
    for case, (_, words) in _CASES.items():
        if case not in r or _ignored(case):
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
        for name, v in checks.items():
            wide = "" if v["share"] >= SHARE else _off(v)
            out.append(Claim(
                3, f"h, {words}: {name} in its band", f">= {percent(SHARE, 0)} of checkpoints",
                percent(v["share"], 0), f"mean {v['mean']:.2f}, expected {v['dof']:g}", seeds,
                v["share"] >= SHARE, wide,
            ))  # fmt: skip
    return out


def _electrical_section(r: Results) -> list[str]:
    rows = []
    for case, (words, _) in _CASES.items():
        if case in r:
            c = r[case]
            end = float(np.sqrt(np.mean([c["rmse_h"][k][-1] ** 2 for k in "abc"])))
            rows.append([
                words, f"{end:.1e}",
                f"{c['ratio_end']:.2f} ({between(c['ratio_end_interval'], '.2f')})",
                f"{c['ratio_worst']:.2f}", f"{c['nees_h']['mean']:.2f} of 3",
                percent(c["nees_h"]["share"], 0), f"{c['nis']['mean']:.2f} of 4",
                percent(c["nis"]["share"], 0),
            ])  # fmt: skip
    out = []
    if rows:
        out.append(_table(
            ["case", "RMSE of h after 0.3 s", "over bound, at the end", "worst", "mean NEES of h",
             "in band", "mean NIS", "in band"], rows,
        ))  # fmt: skip
    if "gains ignored" in r:
        c = r["gains ignored"]
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
        _table(["true mu, k_rf, kappa", "h", "mu found", "1 sigma", "k_rf found", "1 sigma",
                "error over sigma", "NIS"], rows),
    ]  # fmt: skip
    if off > 3:
        out.append(
            f"The errors reach {off:.0f} claimed sigmas, and NIS shows it: started far away "
            "(k_rf = 10 is three sigmas from the prior's mean), the extended filter is sure before "
            "it has arrived, and creeps on along a curved valley. That is linearisation: three "
            "iterations of each update about halve the error."
        )
    return [
        *out,
        "What a wrong kappa does (truth: kappa = 1, the filter assumes 0.5): another pair (mu, "
        "k_rf) of the same shunt, put right by the kappa that is known later; NIS does not tell. A "
        "filter with full coupling has no inductance at all, and its NIS does:",
        _table(["true mu, k_rf", "found with kappa 0.5", "expected then", "put right with kappa 1",
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
        _table(["mu, k_rf, kappa", "h", "1 sigma of h", "of mu", "of k_rf"], rows),
    ]


def _electrical_figures(r: Results) -> Pictures:
    from apu_casadi.studyplot import plot_consistency

    panels: list[Any] = []
    for case, (words, _) in _CASES.items():
        if case not in r:
            continue
        c = r[case]
        ratios = {f"h_{k}": _series(c["rmse_h"][k]) / _series(c["bound_h"][k]) for k in "abc"}
        checks = {}
        if "course" in c["nees_h"]:
            for name, key in (("NEES of h", "nees_h"), ("NIS", "nis")):
                v = c[key]
                checks[name] = (_series(v["course"]) / v["dof"],
                                tuple(b / v["dof"] for b in v["band"]))  # fmt: skip
        panels.append((words, c["t"], ratios, None if _ignored(case) else c["goal"], checks))
    if not panels:
        return {}
    fig = partial(
        plot_consistency,
        panels, "Above: RMSE of the three severities over the posterior Cramer-Rao bound. Below: "
        "means over the seeds, over what is expected; shaded: their 95 % bands.",
    )  # fmt: skip
    return {"Error of h over its bound": ("estimation_electrical.png", fig)}


# ------------------------------------------------------------------------------ detection


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


def _detection_claims(r: Results) -> list[Claim]:
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
            f"{n} runs: at most {percent(_binomial(min(alarms, n), n)[1], 2)} (95 %)",
            f"{rows[0]['n_seeds']} each", alarms == 0, _raised(r["quiet"]),
        ))  # fmt: skip
    return out


def _detection_section(r: Results) -> list[str]:
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
        out.append(_table(
            ["h", "found in time", "delay, periods: median", "95 %", "longest", "right phase",
             "alarms before", "1 sigma of h"], rows,
        ))  # fmt: skip
    if "quiet" in r:
        out.append("Operation without an electrical fault:")
        out.append(_table(
            ["case", "seeds", "alarms, exact sensors", "alarms, gain errors",
             "largest h over sigma", "with gain errors", "resets"],
            [[name, str(c["n_seeds"]), str(c["exact sensors"]["alarms"]),
              str(c["gain errors"]["alarms"]), f"{c['exact sensors']['largest_h_over_sigma']:.1f}",
              f"{c['gain errors']['largest_h_over_sigma']:.1f}", str(c["exact sensors"]["resets"])]
             for name, c in r["quiet"].items()],
        ))  # fmt: skip
        out.append(
            "A *reset* is what the tracking filter takes for a step of h; it opens its belief, "
            "finds h = 0 again and raises no alarm."
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


def _detection_figures(r: Results) -> Pictures:
    if "false alarms" not in r:
        return {}
    from apu_casadi.studyplot import plot_rate

    c = r["false alarms"]
    fig = partial(
        plot_rate,
        c["tail"]["z"], c["tail"]["counts"], c["tail"]["expected"], c["hours"], c["z_of_level"], 1,
        f"{c['hours']:.2f} hours of healthy operation at 225 kW. Bars: one standard deviation of "
        "the count.",
    )  # fmt: skip
    return {"False alarms of a healthy machine": ("estimation_false_alarms.png", fig)}


# ------------------------------------------------------------------------------ gas path


def _growing(values: Sequence[float], band: Sequence[float]) -> str:
    """Say that errors are more and more underrated along the run, where they are."""
    first, last = values[0], values[-1]
    if not (last > values[len(values) // 2] > first and last > band[1]):
        return ""
    return (
        f"; it grows from {first:.2f} to {last:.2f} along the run, as it does where the errors of "
        "the readings of fuel and power also sit in the derivatives; a second iteration of each "
        "update removes a part of it, and is used"
    )


def _gaspath_claims(r: Results) -> list[Claim]:
    out = []
    for key, goal in (("matched", 1.2), ("mismatched", 1.5)):
        if key not in r:
            continue
        c = r[key]
        n = c["seeds"]
        seeds = f"{GAS_PATH_SEED0} to {GAS_PATH_SEED0 + n - 1}"
        e = 1.96 * c["ratio_stderr"]
        worst = c["ratio_max"]
        out.append(Claim(
            2, f"four health factors, {key} model: worst RMSE over bound", f"<= {goal}",
            f"{worst:.2f}", f"each known to {percent(e)}; median {c['ratio_median']:.2f}", seeds,
            worst <= goal, "see the section",
        ))  # fmt: skip
        for name, share, values, band in (
            ("NEES", c["nees_inside"], c["nees"], c["nees_band"]),
            ("NIS", c["nis_inside"], c["nis"], c["nis_band"]),
            ("NEES along the null direction", c["null"]["inside"], c["null"]["nees"],
             c["null"]["band"]),
        ):  # fmt: skip
            out.append(Claim(
                3, f"health, {key} model: {name} in its band",
                f">= {percent(SHARE, 0)} of checkpoints", percent(share, 0),
                f"mean {np.mean(values):.2f}, band {between(band, '.2f')}", seeds, share >= SHARE,
                _outside(values, band) + _growing(values, band),
            ))  # fmt: skip
        least = c["null"]["least_claimed_over_limit"]
        out.append(Claim(
            3, f"health, {key} model: least claimed variance over its bound, null direction",
            f">= 1 within {percent(LOST, 0)}", f"{least:.3f}", "least over seeds and checkpoints",
            seeds, least >= 1 - LOST,
            "the filter linearises at its estimate, the bound at the truth",
        ))  # fmt: skip
    return out


def _gaspath_section(r: Results) -> list[str]:
    out = []
    rows = []
    for key in ("matched", "mismatched"):
        if key in r:
            c = r[key]
            for n in HEALTH:
                ratio = _series(c["ratio"][n])
                rows.append([
                    f"{n}, {key}", percent(c["bound"][n][-1], 2), percent(c["rmse"][n][-1], 2),
                    f"{ratio[-1]:.2f}", f"{ratio.max():.2f}",
                ])  # fmt: skip
    if rows:
        out.append(
            _table(["factor, model", "bound at 14 s", "RMSE at 14 s", "ratio", "worst ratio"], rows)
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
            + ", ".join(f"{n} {np.mean(v):.2f}" for n, v in c["nees_of"].items()) + "."
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
        rows = [
            [x["filter"], f"{x['over_bound']:.3f}", f"{x['nees']:.2f}", str(x["lost"]),
             f"{x['us_per_sample']:.0f}"]
            for x in r["filters"]["rows"]
        ]  # fmt: skip
        out += [
            f"The methods on the same matched data, {r['filters']['rows'][0]['seeds']} seeds (a "
            "smoother knows later samples, and may be below the filters' bound):",
            _table(["method", "RMSE over bound", "mean NEES, 4 expected", "runs lost",
                    "us per sample"], rows),
        ]  # fmt: skip
    return out


def _gaspath_figures(r: Results) -> Pictures:
    from apu_casadi.studyplot import plot_consistency, plot_null

    panels: list[Any] = []
    nulls: list[Any] = []
    for key, goal in (("matched", 1.2), ("mismatched", 1.5)):
        if key not in r:
            continue
        c = r[key]
        checks = {
            "NEES": (_series(c["nees"]) / 4, [b / 4 for b in c["nees_band"]]),
            "NIS": (_series(c["nis"]) / 4, [b / 4 for b in c["nis_band"]]),
            "null direction": (_series(c["null"]["nees"]), c["null"]["band"]),
        }
        head = f"{key} model, {c['seeds']} seeds"
        panels.append((head, c["checkpoints"], {n: _series(c["ratio"][n]) for n in HEALTH}, goal,
                       checks))  # fmt: skip
        nulls.append((head, c["checkpoints"], {
            "error made": 100 * _series(c["null"]["rmse"]),
            "claimed": 100 * _series(c["null"]["claimed"]),
            "bound": 100 * _series(c["null"]["limit"]),
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


# ------------------------------------------------------------------------------ shaft power

_AIMS = {"exact efficiency": 0.5, "efficiency bias": 0.3}
_FILTERS = {
    "filter": ("filter, exact sensors", 0.5),
    "filter, bias": ("filter, efficiency bias", 0.3),
    "filter, gain errors": ("filter, gain errors", 0.5),
    "filter, bias and gain errors": ("filter, efficiency bias and gain errors", 0.3),
}


def _power_claims(r: Results) -> list[Claim]:
    out = []
    needed = r.get("snapshot", {}).get("needed_samples", {})
    for label, aim in _AIMS.items():
        if "trials" in r:
            c = r["trials"][label]
            out.append(Claim(
                4, f"reduction of the error, snapshot of 1 s, {label}", f">= {percent(aim, 0)}",
                percent(c["reduction"]), between(c["interval"], ".1f", 100, " %"),
                f"{c['seeds']} from {GAS_PATH_SEED0}", c["reduction"] >= aim,
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
                    f"{c['seeds']} from {GAS_PATH_SEED0}", v["reduction"] >= aim,
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


def _power_section(r: Results) -> list[str]:
    out = []
    if "trials" in r:
        out.append("Most probable health from snapshots of 1 s of the nonlinear engine:")
        out.append(_table(
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
        out.append(_table(
            ["case, instant", "reduction", "95 % interval", "null direction without: error",
             "claimed", "with: error", "claimed"], rows,
        ))  # fmt: skip
    if "sweep" in r:
        table = [x for x in r["sweep"]["table"] if x["noise"] == 0.01]
        out.append("How the reduction depends on the prior (covariances, 1 % power noise):")
        out.append(_table(
            ["prior", "efficiency bias", "gain errors", "before the load drop", "after it",
             "null direction without, after", "with"],
            [[percent(x["prior"]), percent(x["eta"], 0), "yes" if x["gains"] else "no",
              percent(x["snapshot"]["reduction"], 0), percent(x["transient"]["reduction"], 0),
              percent(x["transient"]["null_without"], 2), percent(x["transient"]["null_with"], 2)]
             for x in table],
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


def _power_figures(r: Results) -> Pictures:
    from apu_casadi.estimationplot import plot_gain_of_a_sensor

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
        table = [x for x in r["sweep"]["table"] if x["noise"] == 0.01]
        kinds = {(False, 0.0): "exact sensors", (False, 0.02): "efficiency bias",
                 (True, 0.0): "gain errors", (True, 0.02): "both"}  # fmt: skip
        priors = sorted({x["prior"] for x in table})
        curves = {}
        for (gains, eta), label in kinds.items():
            rows = [x["transient"] for x in table if x["gains"] == gains and x["eta"] == eta]
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


# ------------------------------------------------------------------------------ isolation

_ISOLATION = ("watched", "watched, another engine", "no history",
              "no history, baseline known to 0.3")  # fmt: skip


def _isolation_claims(r: Results) -> list[Claim]:
    out = []
    for name in _ISOLATION:
        if name not in r:
            continue
        c = r[name]
        for method in ("glr", "bank"):
            s = c[method]
            limit = c["limit"]["kappa"]
            out.append(Claim(
                6, f"kappa, {name}, {method}", f">= {KAPPA}", f"{s['kappa']:.3f}",
                f"{between(s['kappa_95'])}; limit {limit:.3f}",
                f"{s['n']} windows, {seeds_of(c['seeds'])}", s["kappa"] >= KAPPA,
                f"information limit: Bayes' rule itself reaches {limit:.2f}; wear and gain errors "
                "of a unit without history look like faults",
            ))  # fmt: skip
    return out


def _isolation_section(r: Results) -> list[str]:
    out = []
    rows = []
    for name in _ISOLATION:
        if name in r:
            c = r[name]
            rows.append([
                name, *(f"{c[m]['kappa']:.3f} ({between(c[m]['kappa_95'])})"
                        for m in ("glr", "bank", "limit", "limit_onset_known")),
                f"{c['nis']:.3f}", "-" if c["onset_rms"] is None else f"{1e3 * c['onset_rms']:.0f}",
                "-" if c["size_rms"] is None else percent(c["size_rms"], 2),
            ])  # fmt: skip
    if rows:
        out.append(_table(
            ["study", "kappa, GLR", "filter bank", "information limit", "limit, onset known",
             "NIS over expected", "onset, RMS ms", "size, RMS"], rows,
        ))  # fmt: skip
    swept = [(n, x) for n, rows in r.get("sweeps", {}).items() for x in rows]
    if swept:
        out.append("How the limit depends on what is measured (`electrical`: whether the severity "
                   "from the electrical filter is there):")  # fmt: skip
        out.append(_table(
            ["study", "changed", "value", "kappa", "95 % interval"],
            [[n, x["change"], str(x["value"]), f"{x['kappa']:.3f}", between(x["kappa_95"])]
             for n, x in swept],
        ))  # fmt: skip
    return out


def _isolation_figures(r: Results) -> Pictures:
    from apu_casadi.isolationplot import plot_confusion, plot_kappa

    made: Pictures = {}
    panels = [(f"{n}, filter bank", r[n]["bank"]) for n in ("watched", "no history") if n in r]
    if "no history" in r:
        panels.append(("no history, limit", r["no history"]["limit"]))
    if panels:
        fig = partial(
            plot_confusion,
            panels, "Per cent of the windows of each true class; the classifier's answer by "
            "column. The limit is Bayes' rule in the linear problem.",
        )  # fmt: skip
        made["Confusion matrices"] = ("estimation_confusion.png", fig)
    labels = {
        "after": "seconds after the onset", "before": "seconds before it",
        "noise": "noise, times the table", "baseline": "uncertainty of the unit, times",
    }  # fmt: skip
    curves = []
    for name, rows in r.get("sweeps", {}).items():
        for change, label in labels.items():
            some = [x for x in rows if x["change"] == change]
            if len(some) > 1 and (name, change) != ("no history", "after"):
                curves.append((f"{name}: {change}", label, some))
    if curves:
        fig = partial(
            plot_kappa,
            curves[:4], "Information limit of Cohen's kappa; shaded: 95 % interval; dashed: what "
            "is asked for.",
        )  # fmt: skip
        made["Information limit of the isolation"] = ("estimation_limit.png", fig)
    return made


# ------------------------------------------------------------------------------ fitting

_KINDS = ("steady", "transient", "steady, gains considered", "steady, gains ignored")


def _fitting_claims(r: Results) -> list[Claim]:
    out = []
    for kind in _KINDS:
        if kind not in r or "ignored" in kind:
            continue
        c = r[kind]
        low, high = (f(x["covered"] for x in c["rows"]) for f in (min, max))
        ok = low >= COVERED[0] and high <= COVERED[1]
        bad = [x for x in c["rows"] if not COVERED[0] <= x["covered"] <= COVERED[1]]
        out.append(Claim(
            7, f"95 % intervals that hold the truth, {kind}", "93 to 97 % for each factor",
            f"{percent(low)} to {percent(high)}",
            "binomial " + between((min(x["low"] for x in c["rows"]),
                                   max(x["high"] for x in c["rows"])), ".1f", 100, " %"),
            f"{c['n']} fits from {c['seed0']}", ok,
            "; ".join(f"{x['name']} {percent(x['covered'])} (by chance alone "
                      f"{percent(x['low'])} to {percent(x['high'])})" for x in bad),
        ))  # fmt: skip
    return out


def _fitting_section(r: Results) -> list[str]:
    rows = []
    for kind in _KINDS:
        if kind in r:
            c = r[kind]
            for x in c["rows"]:
                rows.append([
                    f"{kind}: {x['name']}", percent(x["covered"]),
                    between((x["low"], x["high"]), ".1f", 100, " %"), percent(x["rms_error"], 3),
                    percent(x["mean_sigma"], 3), f"{x['bias_over_its_error']:+.1f}",
                    str(c["failed"]),
                ])  # fmt: skip
    out = []
    if rows:
        out.append(_table(
            ["data, factor", "covered", "95 % interval", "RMS error", "claimed 1 sigma",
             "bias over its error", "failed fits"], rows,
        ))  # fmt: skip
    if "steady, gains ignored" in r:
        out.append("Nothing is asked of *gains ignored*: it shows that a fit which takes sensors "
                   "with gain errors for exact ones claims far too much.")  # fmt: skip
    return out


def _fitting_figures(r: Results) -> Pictures:
    from apu_casadi.studyplot import plot_coverage

    groups = {
        k: {x["name"]: (x["covered"], x["low"], x["high"]) for x in r[k]["rows"]}
        for k in _KINDS if k in r and "ignored" not in k
    }  # fmt: skip
    if not groups:
        return {}
    fig = partial(
        plot_coverage,
        groups, "Shaded: what is asked for. Bars: 95 % interval of the share, Clopper and Pearson.",
        goal=COVERED, level=0.95,
    )  # fmt: skip
    return {"Coverage of the intervals": ("estimation_coverage.png", fig)}


# ------------------------------------------------------------------------------ joint


def _joint_claims(r: Results) -> list[Claim]:
    out = []
    if "monolithic" in r:
        m = r["monolithic"]
        worst = max(m["compared"][n]["difference_max"] for n in HEALTH)
        least = min(m["compared"][n]["sigma_ratio"] for n in HEALTH)
        out.append(
            Claim(
                JOINT,
                "health factors of the coupled pair against one filter of the whole unit",
                "<= 0.5 of their sigma",
                f"{worst:.2f}",
                f"the one filter's sigma is {least:.3f} times the pair's",
                f"{m['seed']}, {m['duration']:g} s",
                worst <= 0.5,
                "see the section",
            )
        )
    if "cross-talk" not in r:
        return out
    c = r["cross-talk"]
    n = c["seeds"]
    v, blind = c["coupled"], c["healthy machine"]
    alarms, reports = v["health_alarms_after_short_circuit"], v["short_circuits_reported_before"]
    moved = max(abs(x) for x in v["change_mean"].values())
    moved_blind = max(abs(x) for x in blind["change_mean"].values())
    return [
        *out,
        Claim(JOINT, "short circuit reported as a change of gas-path health within 3 s", "0 runs",
              f"{alarms} alarms", f"{n} runs", f"{n} from 1000", alarms == 0,
              "see the section"),
        Claim(JOINT, "largest mean change of a health factor by the short circuit",
              "<= 0.2 %", percent(moved, 2),
              f"{percent(moved_blind, 2)} if the electrical filter knows no short circuit",
              f"{n} from 1000", moved <= 0.002, "see the section"),
        Claim(JOINT, "gas-path fault reported as a short circuit", "0 runs", f"{reports} runs",
              f"h moved by {v['h_change_at_gas_fault']:.1e} at most", f"{n} from 1000",
              reports == 0, "see the section"),
    ]  # fmt: skip


def _joint_section(r: Results) -> list[str]:
    out = []
    if "example" in r:
        e = r["example"]["report"]
        out.append(f"One run (seed {e['seed']}), at the end of each phase:")
        out.append("```text\n" + jointrun.table(e) + "\n```")
        out.append("\n".join(jointrun.words(e)))
    if "monolithic" in r:
        c = r["monolithic"]["compared"]
        out.append(
            f"The coupled pair against one filter of the whole unit at 10 kHz, in which nothing is "
            f"handed over, on {r['monolithic']['duration']:g} s with a load drop in the middle "
            "(gains, inertia and efficiency known): largest difference of the means over the "
            "coupled pair's sigma, and the one filter's sigma over the pair's at the end."
        )
        names = [n for n in c if n != "correlation"]
        out.append(_table(
            ["", *names],
            [["largest difference, sigma", *(f"{c[n]['difference_max']:.2f}" for n in names)],
             ["sigma, one filter over pair", *(f"{c[n]['sigma_ratio']:.3f}" for n in names)]],
        ))  # fmt: skip
        out.append(
            f"The pair does not carry correlations between electrical and gas-path states; in the "
            f"one filter the largest is {c['correlation']:.3f} at the end."
        )
    if "cross-talk" in r:
        c = r["cross-talk"]
        rows = []
        for name in ("coupled", "healthy machine", "no power"):
            v = c[name]
            rows.append([
                name, *(f"{100 * v['change_mean'][n]:+.2f}, {100 * v['change_rms'][n]:.2f} %"
                        for n in HEALTH),
                str(v["health_alarms_after_short_circuit"]),
                str(v["short_circuits_reported_before"]), f"{v['h_change_at_gas_fault']:.0e}",
            ])  # fmt: skip
        out.append(
            f"What a short circuit does to the estimated health, and a gas-path fault to h; "
            f"{c['seeds']} seeds of noise and gain errors. *Coupled*: the estimators as they are; "
            "*healthy machine*: an electrical filter that knows no short circuits, so that the "
            "lost power has to come from somewhere; *no power*: the gas path gets no shaft power. "
            "Changes of the factors from just before the short circuit to 3 s after, mean and RMS:"
        )
        out.append(_table(
            ["estimator", *HEALTH, "health alarms", "runs with false short circuits",
             "largest change of h"], rows,
        ))  # fmt: skip
        v = c["coupled"]
        ends = ("design point", "load drop", "gas-path fault", "TTSC fault")
        out.append("RMSE of the factors at the end of each phase, and RMS of error over claimed "
                   "sigma (1 is right) in brackets:")  # fmt: skip
        out.append(_table(
            ["factor", *ends],
            [[n, *(f"{percent(v['rmse_at_ends'][i][k], 2)} ({v['z_rms_at_ends'][i][k]:.2f})"
                   for k in range(len(ends)))] for i, n in enumerate(HEALTH)],
        ))  # fmt: skip
    return out


def _joint_figures(r: Results) -> Pictures:
    if "example" not in r:
        return {}
    fig = partial(jointrun.figure, r["example"])
    return {"Truth, estimate and 95 % band along the joint scenario": ("estimation_joint.png", fig)}


# ------------------------------------------------------------------------------ speed


def _speed_claims(r: Results) -> list[Claim]:
    out = []
    if "steps" in r:
        c = r["steps"]
        name, row = next(iter(c["rows"].items()))
        peer = c.get("filterpy_ukf_us")
        for kind in ("ekf", "ukf"):
            v, goal = row[f"{kind}_us"], c["goal_us"][kind]
            beside = "" if kind == "ekf" or not peer else (
                f"filterpy's UKF {peer:.0f} us, {peer / v:.0f} times"
            )  # fmt: skip
            out.append(Claim(8, f"step of the electrical {kind.upper()}, {name}",
                             f"<= {goal:g} us", f"{v:.1f} us", beside, "fastest of 7", v <= goal,
                             "on a slower or a busy processor"))  # fmt: skip
    if "joint" in r:
        c = r["joint"]
        out.append(Claim(8, f"joint estimation of {c['simulated']:g} s on one core", "<= 5 s",
                         f"{c['seconds']:.1f} s", "noise and measuring included", "fastest of 3",
                         c["seconds"] <= 5, "see the section"))  # fmt: skip
    return out


def _speed_section(r: Results) -> list[str]:
    if "steps" not in r:
        return []
    c = r["steps"]
    out = [_table(
        ["electrical filter", "EKF step, us", "UKF step, us"],
        [[n, f"{x['ekf_us']:.2f}", f"{x['ukf_us']:.2f}"] for n, x in c["rows"].items()],
    )]  # fmt: skip
    if "machine" in c:
        m = c["machine"]
        out.append(
            f"{m['processor']}, {m['cores']} cores, {m['system']}; other load before the timing: "
            f"{m['load_before']:g}."
        )
    if c.get("filterpy_ukf_us"):
        out.append(f"filterpy's UKF on the same model (our functions in generated C behind its "
                   f"interface): {c['filterpy_ukf_us']:.0f} us a step.")  # fmt: skip
    return out


def _no_figures(r: Results) -> Pictures:
    return {}


REPORTS: dict[str, Report] = {
    "correctness": Report(
        "On linear models everything is exact. Random stable systems of three states with noise "
        "that output and transition share, irregular instants and 30 % of the samples missing go "
        "through every estimator, and through a Kalman filter and a least-squares problem of all "
        "states and noises that are written out beside them.",
        _correctness_claims, _correctness_section, _no_figures,
    ),
    "electrical": Report(
        "Fluxes, rotor angle and the severity h of a short circuit in each phase from voltages, "
        "currents, field voltage and current and speed at 10 kHz, for 0.3 s at 225 kW. The truth "
        "is the generator with load and exciter, integrated by CVODES at 1e-9. *Matched*: "
        "severities, fluxes and their random walks are drawn as the filter believes. The other "
        "cases simulate a short circuit of h = 3e-4 in phase b and a load unbalanced by 5 %.",
        _electrical_claims, _electrical_section, _electrical_figures,
    ),
    "detection": Report(
        "An alarm is a severity h of one phase above a fixed multiple of its standard deviation "
        "(below). Phase and onset are random. In the mismatched runs the load is unbalanced by 5 % "
        "and all eight sensors have gain errors of 0.5 %, of which the filter knows the standard "
        "deviation only. The filter has no healthy baseline: it meets the machine 0.1 s before the "
        "fault.",
        _detection_claims, _detection_section, _detection_figures,
    ),
    "gaspath": Report(
        "Speed and four health factors from N, P3, T3, T5, Wf and the shaft power at 20 ms, for 14 "
        "s with a load drop at 2 s and a fault at 6 s. *Matched*: the truth is the filter's model, "
        "noise and all, and the filter is told when the health jumps. *Mismatched*: another "
        "integrator in steps of 5 ms, a governor in between, and in turn the same engine, 10 % "
        "more inertia, other gas data and other component maps; faults of 1 to 4 % in one to four "
        "factors that the filter has to find; gain errors and an efficiency that is off.",
        _gaspath_claims, _gaspath_section, _gaspath_figures,
    ),
    "shaft-power": Report(
        "With speed held, N, P3, T3, T5 and Wf give as many equations as there are health factors "
        "and fuel flow, but one combination of the factors does not show in them. Shaft power "
        "shows it. How much that helps depends on the prior, on gain errors, and on how well the "
        "generators' efficiency is known; so all three are swept, and the null direction stands "
        "beside the error of the factors.",
        _power_claims, _power_section, _power_figures,
    ),
    "isolation": Report(
        "Eleven classes, faults of 1 to 4 %, on a unit with wear and unknown constant gain errors, "
        "at any load and day, the load wandering and stepping. *Watched*: the unit is seen for 4 s "
        "before the fault; *another engine*: the truth is not the classifier's model; *no "
        "history*: the fault is there from the beginning, and wear, gain errors and the offset of "
        "h are known by their priors alone; the last study has these priors at 0.3 of that, as "
        "after an earlier inspection. The limit is Bayes' rule in the linear problem: no "
        "classifier is better.",
        _isolation_claims, _isolation_section, _isolation_figures,
    ),
    "fitting": Report(
        "Health factors fitted to recorded data by least squares over all samples at once, with "
        "noise of fuel and power among the unknowns: five steady loads of 25 readings each, or 2 s "
        "of a governed load step. *Gains considered*: the sensors have gain errors, which the fit "
        "considers; *ignored*: it does not.",
        _fitting_claims, _fitting_section, _fitting_figures,
    ),
    "joint": Report(
        "The paper's joint scenario: load drop at 2 s, gas-path fault at 6 s, short circuit of 5 % "
        "of the turns with k_rf = 20 at 10 s. The truth is simulated by CVODES with an exchange of "
        "5 ms; the electrical filter hands its mean power of each 20 ms with its variance to the "
        "gas-path filter, and the speed goes both ways. All sensors have gain errors.",
        _joint_claims, _joint_section, _joint_figures,
    ),
    "speed": Report(
        "One step of prediction and update of the electrical filter in generated C, a hundred "
        "steps to a call; and the whole joint estimation, noise and measuring included, after "
        "compilation.",
        _speed_claims, _speed_section, _no_figures,
    ),
}  # fmt: skip
"""How each study is shown, by its name."""
