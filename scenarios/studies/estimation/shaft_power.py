"""What the shaft power is worth: by how much it reduces the errors of health."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import numpy as np

from estimators.apu import identify, trials
from scenarios.figures.estimationplot import plot_gain_of_a_sensor
from scenarios.studies.gaspath.course import ETA_SIGMA, filters, fresh, modules
from scenarios.studies.gaspath.powerworth import shaft_power, shaft_power_seeds
from scenarios.studies.registration import Claim, Pictures, Results, Study, Tell

__all__ = ["STUDY"]

STUDY = Study(
    "shaft-power",
    order=50,
    title="What the shaft power is worth",
    goal="With a 2 % prior and 1 % power noise, shaft power takes 50 % off the error of the four "
    "health factors, 30 % with the efficiency bias of the generators.",
    modules={**modules, "identify": ("estimators.apu.identify",)},
    filters=filters,
    **fresh,
    text="""
@intro
With speed held, N, P3, T3, T5 and Wf give as many equations as there are health factors and fuel
flow, but one combination of the factors does not show in them. Shaft power shows it. How much that
helps depends on the prior, on gain errors, and on how well the generators' efficiency is known; so
all three are swept, and the null direction stands beside the error of the factors.

@claim snapshot
4 | reduction of the error, snapshot of 1 s, {label} | >= {aim:.0%} | {reduction:.1%}
| {interval:.1%} | {when} | averaging {needed} samples would do

@claim filter
4 | reduction, {words}, {place} the load drop | >= {aim:.0%} | {reduction:.1%} | {interval:.1%}
| {when} | {why}null direction {null_rmse[1]:.2%} -> {null_rmse[0]:.2%}

@why gain
information limit: constant gain errors, which no averaging removes, leave errors in directions that
shaft power does not show

@why transient
the load drop alone, with measured fuel and speed, already tells much of what the shaft power would

@why bias
an efficiency uncertain by 2 % is taken for power

@trials
Most probable health from snapshots of 1 s of the nonlinear engine:

@trials table
case | seeds | RMS error without | with | bound without | with | reduction | 95 % interval
| NEES over 4
---
{label} | {seeds} | {rms_before:.2%} | {rms_after:.2%} | {bound_before:.2%} | {bound_after:.2%}
| {reduction:.1%} | {interval:.1%} | {nees:.2f}

@filter
The gas-path filter with and without shaft power, on the same noise; load drop at 2 s:

@filter table
case, instant | reduction | 95 % interval | null direction without: error | claimed | with: error
| claimed
---
{words}, {instant} | {reduction:.1%} | {interval:.1%} | {null_rmse[1]:.2%} | {null_claimed[1]:.2%}
| {null_rmse[0]:.2%} | {null_claimed[0]:.2%}

@sweep
How the reduction depends on the prior (covariances, 1 % power noise):

@sweep table
prior | efficiency bias | gain errors | before the load drop | after it
| null direction without, after | with
---
{prior:.1%} | {eta:.0%} | {known} | {snapshot[reduction]:.0%} | {transient[reduction]:.0%}
| {transient[null_without]:.2%} | {transient[null_with]:.2%}

@snapshot
If one sensor alone has its gain error (efficiency bias included), the reduction in a snapshot is:
{alone}. Samples of 20 ms that have to be averaged to reach the aim: {needed}.

@caption snapshot
Bounds of a snapshot of 1 s at the design point, power noise 1 %. Gain errors are those of the
sensor table, the efficiency is uncertain by 2 %.

@caption filter
The gas-path filter 4 s after a load drop from 2 x 225 to 2 x 100 kW, power noise 1 %; covariances
of the filter. Without shaft power: the largest of the cases.
""",
)

AIMS = {"exact efficiency": 0.5, "efficiency bias": 0.3}
FILTERS = {
    "filter": ("filter, exact sensors", 0.5),
    "filter, bias": ("filter, efficiency bias", 0.3),
    "filter, gain errors": ("filter, gain errors", 0.5),
    "filter, bias and gain errors": ("filter, efficiency bias and gain errors", 0.3),
}
INSTANTS = {"snapshot": ("before", "2 s"), "transient": ("4 s after", "6 s")}


@STUDY.part("snapshot", start=10, share=None)
def _snapshot(n: int, seed0: int, tell: Tell) -> Any:
    prior = identify.PRIOR
    return {
        "priors": list(identify.PRIORS),
        "rows": identify.snapshot_sweep(power_noises=(0.01,)),
        "limiting_gains": identify.limiting_gains(eta_bias=identify.ETA_BIAS),
        "limiting_noises": identify.limiting_noises(prior=prior),
        "needed_samples": {
            label: identify.needed_samples(aim, prior=prior, **identify.VARIANTS[label])
            for label, aim in identify.AIMS.items()
        },
    }


@STUDY.part("trials", start=1, each=0.012)
def _trials(n: int, seed0: int, tell: Tell) -> Any:
    seeds, variants = range(seed0, seed0 + n), identify.VARIANTS
    made = {k: trials.snapshot_trials(seeds=seeds, **variants[k]) for k in identify.AIMS}
    return {label: dataclasses.asdict(t) for label, t in made.items()}


@STUDY.part("sweep", start=25, share=None)
def _sweep(n: int, seed0: int, tell: Tell) -> Any:
    return shaft_power()


def _filter(key: str, n: int, seed0: int, tell: Tell) -> Any:
    eta = ETA_SIGMA if "bias" in key else None
    return shaft_power_seeds(range(seed0, seed0 + n), gains="gain" in key, eta=eta)


for _key in FILTERS:
    STUDY.part(_key, start=5, each=0.09)(partial(_filter, _key))


@STUDY.claims
def claims(r: Results) -> list[Claim]:
    """Claim what the shaft power takes off the error."""
    out = []
    needed = r.get("snapshot", {}).get("needed_samples", {})
    for label, aim in AIMS.items():
        if "trials" in r:
            c = r["trials"][label]
            about = {"label": label, "aim": aim, "when": r.seeds_from("trials")}
            more = {"needed": str(needed.get(label))}
            out.append(STUDY.claim("claim snapshot", c["reduction"] >= aim, **about, **more, **c))
    for key, (words, aim) in FILTERS.items():
        if key in r:
            for when, (place, _) in INSTANTS.items():
                v = r[key][when]
                about = {"words": words, "aim": aim, "place": place, "when": r.seeds_from(key)}
                met, why = v["reduction"] >= aim, _why(key, when)
                out.append(STUDY.claim("claim filter", met, why=why, **about, **v))
    return out


def _why(key: str, when: str) -> str:
    """Say why an aim may be missed."""
    told = {"gain": "gain" in key, "transient": when == "transient", "bias": "bias" in key}
    return "".join(STUDY.template.text(f"why {n}") + "; " for n, holds in told.items() if holds)


@STUDY.section
def section(r: Results) -> list[str]:
    """Show snapshots, filters, the sweep, and which gain error limits."""
    out, t = [], STUDY.template
    if "trials" in r:
        rows = [{"label": label, **c} for label, c in r["trials"].items()]
        out += [t.text("trials"), t.table("trials table", rows)]
    filters_ = [
        {"words": words, "instant": INSTANTS[when][1], **v}
        for key, (words, _) in FILTERS.items()
        if key in r
        for when, v in r[key].items()
        if when in INSTANTS
    ]
    if filters_:
        out += [t.text("filter"), t.table("filter table", filters_)]
    if "sweep" in r:
        rows = [x | {"known": "yes" if x["gains"] else "no"} for x in _swept(r)]
        out += [t.text("sweep"), t.table("sweep table", rows)]
    if "snapshot" in r:
        c = r["snapshot"]
        alone = ", ".join(f"{n} {100 * v:.0f} %" for n, v in c["limiting_gains"].items())
        needed = ", ".join(f"{k} {v}" for k, v in c["needed_samples"].items())
        out.append(t.text("snapshot", alone=alone, needed=needed))
    return out


def _swept(r: Results) -> list[dict[str, Any]]:
    """Return the rows of the sweep at 1 % power noise."""
    return [x for x in r["sweep"]["table"] if x["noise"] == 0.01]


def _curve(rows: list[Any], **names: str) -> dict[str, np.ndarray]:
    keys = {k: names.get(k, k) for k in ("reduction", "null_before", "null_after")}
    return {k: np.array([x[name] for x in rows]) for k, name in keys.items()}


@STUDY.figures
def figures(r: Results) -> Pictures:
    """Draw the reduction over the prior, in a snapshot and in the filter."""
    made: Pictures = {}
    draw, text = plot_gain_of_a_sensor, STUDY.template.text
    if "snapshot" in r:
        c = r["snapshot"]
        curves = {
            label: _curve([x for x in c["rows"] if x["variant"] == label])
            for label in dict.fromkeys(x["variant"] for x in c["rows"])
        }
        aims, note = {k: (0.02, v) for k, v in AIMS.items()}, text("caption snapshot")
        fig = partial(draw, c["priors"], curves, aims=aims, note=note)
        made["Shaft power in a snapshot"] = ("estimation_shaft_power.png", fig)
    if "sweep" in r:
        kinds = {
            "exact sensors": (False, 0.0),
            "efficiency bias": (False, 0.02),
            "gain errors": (True, 0.0),
            "both": (True, 0.02),
        }
        swept, names = _swept(r), {"null_before": "null_without", "null_after": "null_with"}
        curves = {
            label: _curve([x["transient"] for x in swept if (x["gains"], x["eta"]) == k], **names)
            for label, k in kinds.items()
        }
        aims = {"exact sensors": (0.02, 0.5), "efficiency bias": (0.02, 0.3)}
        priors = sorted({x["prior"] for x in swept})
        fig = partial(draw, priors, curves, aims=aims, note=text("caption filter"))
        made["Shaft power in the filter"] = ("estimation_shaft_power_filter.png", fig)
    return made
