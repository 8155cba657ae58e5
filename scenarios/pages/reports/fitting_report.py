"""What the study of the batch fit shows: how often its intervals hold the truth."""

from __future__ import annotations

from functools import partial

from scenarios.pages.reports.claims import Claim, Pictures, Report
from scenarios.pages.reports.words import between, percent, table
from scenarios.studies.catalogue import Results

__all__ = ["REPORT"]

COVERED = (0.93, 0.97)

_KINDS = ("steady", "transient", "steady, gains considered", "steady, gains ignored")


def claims(r: Results) -> list[Claim]:
    """Return what is claimed, goal by goal."""
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


def section(r: Results) -> list[str]:
    """Return the blocks of text and tables."""
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
        out.append(table(
            ["data, factor", "covered", "95 % interval", "RMS error", "claimed 1 sigma",
             "bias over its error", "failed fits"], rows,
        ))  # fmt: skip
    if "steady, gains ignored" in r:
        out.append("Nothing is asked of *gains ignored*: it shows that a fit which takes sensors "
                   "with gain errors for exact ones claims far too much.")  # fmt: skip
    return out


def figures(r: Results) -> Pictures:
    """Return the figures, not drawn yet."""
    from scenarios.figures.studyplot import plot_coverage

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


REPORT = Report(
    "Health factors fitted to recorded data by least squares over all samples at once, with "
    "noise of fuel and power among the unknowns: five steady loads of 25 readings each, or 2 s "
    "of a governed load step. *Gains considered*: the sensors have gain errors, which the fit "
    "considers; *ignored*: it does not.",
    claims, section, figures,
)  # fmt: skip
