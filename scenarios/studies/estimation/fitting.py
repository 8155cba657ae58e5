"""Fitting health factors to recorded data: how often its intervals hold the truth."""

from __future__ import annotations

from functools import partial
from typing import Any

import casadi as ca

from apu_casadi.gaspath.gasgenerator import GasGenerator
from estimators.apu.fitting import OUTPUTS, coverage, engine_model
from scenarios.figures.studyplot import plot_coverage
from scenarios.studies.registration import Claim, Pictures, Results, Study, Tell

__all__ = ["STUDY"]

COVERED = (0.93, 0.97)
KINDS = {
    "steady": (2, 0.02),
    "transient": (8, 0.1),
    "steady, gains considered": (2, 0.02),
    "steady, gains ignored": (2, 0.02),
}
"""What is fitted to, with the expected seconds: once, and for each seed."""


def _filters() -> list[ca.Function]:
    return [engine_model(GasGenerator(), OUTPUTS, steady=s).stage for s in (True, False)]


STUDY = Study(
    "fitting",
    order=70,
    title="Fitting health factors to recorded data",
    goal="95 % intervals hold the truth in 93 to 97 % of 500 fits.",
    seed0=20_000,
    modules={"fitting": ("estimators.apu.fitting",)},
    filters=_filters,
    text="""
@intro
Health factors fitted to recorded data by least squares over all samples at once, with noise of fuel
and power among the unknowns: five steady loads of 25 readings each, or 2 s of a governed load step.
*Gains considered*: the sensors have gain errors, which the fit considers; *ignored*: it does not.

@covered
7 | 95 % intervals that hold the truth, {kind} | 93 to 97 % for each factor
| {low:.1%} to {high:.1%} | binomial {binomial:.1%} | {n} fits from {seed0} | {bad}

@bad
{name} {covered:.1%} (by chance alone {low:.1%} to {high:.1%})

@table
data, factor | covered | 95 % interval | RMS error | claimed 1 sigma | bias over its error
| failed fits
---
{kind}: {name} | {covered:.1%} | {interval:.1%} | {rms_error:.3%} | {mean_sigma:.3%}
| {bias_over_its_error:+.1f} | {failed}

@ignored
Nothing is asked of *gains ignored*: it shows that a fit which takes sensors with gain errors for
exact ones claims far too much.

@caption
Shaded: what is asked for. Bars: 95 % interval of the share, Clopper and Pearson.
""",
)


def _coverage(kind: str, n: int, seed0: int, tell: Tell) -> Any:
    return coverage(n, seed0=seed0, kind=kind, progress=tell)


for _kind, (_start, _each) in KINDS.items():
    STUDY.part(_kind, start=_start, each=_each)(partial(_coverage, _kind))


@STUDY.claims
def claims(r: Results) -> list[Claim]:
    """Claim the coverage of each kind of data but where gains are ignored."""
    out = []
    for kind in KINDS:
        if kind in r and "ignored" not in kind:
            rows = r[kind]["rows"]
            bad = [x for x in rows if not COVERED[0] <= x["covered"] <= COVERED[1]]
            values = {
                "low": min(x["covered"] for x in rows),
                "high": max(x["covered"] for x in rows),
                "binomial": (min(x["low"] for x in rows), max(x["high"] for x in rows)),
                "bad": "; ".join(STUDY.template.text("bad", **x) for x in bad),
            }
            about = {"kind": kind, "n": r[kind]["n"], "seed0": r[kind]["seed0"]}
            out.append(STUDY.claim("covered", not bad, **about, **values))
    return out


@STUDY.section
def section(r: Results) -> list[str]:
    """Show coverage, error and bias of each factor."""
    out, t = [], STUDY.template
    rows = [
        {"kind": k, "failed": r[k]["failed"], "interval": (x["low"], x["high"]), **x}
        for k in KINDS
        if k in r
        for x in r[k]["rows"]
    ]
    if rows:
        out.append(t.table("table", rows))
    if "steady, gains ignored" in r:
        out.append(t.text("ignored"))
    return out


@STUDY.figures
def figures(r: Results) -> Pictures:
    """Draw the coverage with its intervals."""
    groups = {
        k: {x["name"]: (x["covered"], x["low"], x["high"]) for x in r[k]["rows"]}
        for k in KINDS
        if k in r and "ignored" not in k
    }
    if not groups:
        return {}
    note = STUDY.template.text("caption")
    fig = partial(plot_coverage, groups, note, goal=COVERED, level=0.95)
    return {"Coverage of the intervals": ("estimation_coverage.png", fig)}
