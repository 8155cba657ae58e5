"""What the study of isolation shows: kappa of both classifiers beside the information limit."""

from __future__ import annotations

from functools import partial

from scenarios.pages.reports.claims import Claim, Pictures, Report
from scenarios.pages.reports.words import between, percent, seeds_of, table
from scenarios.studies.catalogue import Results

__all__ = ["REPORT"]

KAPPA = 0.8

_ISOLATION = ("watched", "watched, another engine", "no history",
              "no history, baseline known to 0.3")  # fmt: skip


def claims(r: Results) -> list[Claim]:
    """Return what is claimed, goal by goal."""
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


def section(r: Results) -> list[str]:
    """Return the blocks of text and tables."""
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
        out.append(table(
            ["study", "kappa, GLR", "filter bank", "information limit", "limit, onset known",
             "NIS over expected", "onset, RMS ms", "size, RMS"], rows,
        ))  # fmt: skip
    swept = [(n, x) for n, rows in r.get("sweeps", {}).items() for x in rows]
    if swept:
        out.append("How the limit depends on what is measured (`electrical`: whether the severity "
                   "from the electrical filter is there):")  # fmt: skip
        out.append(table(
            ["study", "changed", "value", "kappa", "95 % interval"],
            [[n, x["change"], str(x["value"]), f"{x['kappa']:.3f}", between(x["kappa_95"])]
             for n, x in swept],
        ))  # fmt: skip
    return out


def figures(r: Results) -> Pictures:
    """Return the figures, not drawn yet."""
    from scenarios.figures.isolationplot import plot_confusion, plot_kappa

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


REPORT = Report(
    "Eleven classes, faults of 1 to 4 %, on a unit with wear and unknown constant gain errors, "
    "at any load and day, the load wandering and stepping. *Watched*: the unit is seen for 4 s "
    "before the fault; *another engine*: the truth is not the classifier's model; *no "
    "history*: the fault is there from the beginning, and wear, gain errors and the offset of "
    "h are known by their priors alone; the last study has these priors at 0.3 of that, as "
    "after an earlier inspection. The limit is Bayes' rule in the linear problem: no "
    "classifier is better.",
    claims, section, figures,
)  # fmt: skip
