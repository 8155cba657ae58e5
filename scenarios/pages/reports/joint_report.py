"""What the joint scenario shows: one run, cross-talk, the pair against one filter of the whole."""

from __future__ import annotations

from functools import partial

from scenarios.pages.reports.claims import JOINT, Claim, Pictures, Report
from scenarios.pages.reports.words import HEALTH, percent, table
from scenarios.studies import jointrun
from scenarios.studies.catalogue import Results

__all__ = ["REPORT"]


def claims(r: Results) -> list[Claim]:
    """Return what is claimed, goal by goal."""
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
    n, seeds = c["seeds"], r.seeds_from("cross-talk")
    v, blind = c["coupled"], c["healthy machine"]
    alarms, reports = v["health_alarms_after_short_circuit"], v["short_circuits_reported_before"]
    moved = max(abs(x) for x in v["change_mean"].values())
    moved_blind = max(abs(x) for x in blind["change_mean"].values())
    return [
        *out,
        Claim(JOINT, "short circuit reported as a change of gas-path health within 3 s", "0 runs",
              f"{alarms} alarms", f"{n} runs", seeds, alarms == 0,
              "see the section"),
        Claim(JOINT, "largest mean change of a health factor by the short circuit",
              "<= 0.2 %", percent(moved, 2),
              f"{percent(moved_blind, 2)} if the electrical filter knows no short circuit",
              seeds, moved <= 0.002, "see the section"),
        Claim(JOINT, "gas-path fault reported as a short circuit", "0 runs", f"{reports} runs",
              f"h moved by {v['h_change_at_gas_fault']:.1e} at most", seeds,
              reports == 0, "see the section"),
    ]  # fmt: skip


def section(r: Results) -> list[str]:
    """Return the blocks of text and tables."""
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
        out.append(table(
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
        out.append(table(
            ["estimator", *HEALTH, "health alarms", "runs with false short circuits",
             "largest change of h"], rows,
        ))  # fmt: skip
        v = c["coupled"]
        ends = ("design point", "load drop", "gas-path fault", "TTSC fault")
        out.append("RMSE of the factors at the end of each phase, and RMS of error over claimed "
                   "sigma (1 is right) in brackets:")  # fmt: skip
        out.append(table(
            ["factor", *ends],
            [[n, *(f"{percent(v['rmse_at_ends'][i][k], 2)} ({v['z_rms_at_ends'][i][k]:.2f})"
                   for k in range(len(ends)))] for i, n in enumerate(HEALTH)],
        ))  # fmt: skip
    return out


def figures(r: Results) -> Pictures:
    """Return the figures, not drawn yet."""
    if "example" not in r:
        return {}
    fig = partial(jointrun.figure, r["example"])
    return {"Truth, estimate and 95 % band along the joint scenario": ("estimation_joint.png", fig)}


REPORT = Report(
    "The paper's joint scenario: load drop at 2 s, gas-path fault at 6 s, short circuit of 5 % "
    "of the turns with k_rf = 20 at 10 s. The truth is simulated by CVODES with an exchange of "
    "5 ms; the electrical filter hands its mean power of each 20 ms with its variance to the "
    "gas-path filter, and the speed goes both ways. All sensors have gain errors.",
    claims, section, figures,
)  # fmt: skip
