"""Which fault is it?  Fresh windows of every class, classified, and the information limit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.gaspath.gasgenerator import GasGenerator
from estimators.apu.isolation.classifiers import METHODS, isolate, recording_of
from estimators.apu.isolation.limit import information_limit
from estimators.apu.isolation.problem import CLASSES, DEFAULT, DT, SNAPSHOT, Protocol
from estimators.apu.isolation.scores import scores
from estimators.apu.isolation.truth import windows_of_engines
from estimators.apu.isolation.windowmodel import jump_model, model_of
from estimators.filters.ekf import ekf_step
from scenarios.figures.isolationplot import plot_confusion, plot_kappa
from scenarios.studies.gaspath.course import VARIANTS, variant
from scenarios.studies.registration import Claim, Pictures, Results, Study, Tell

__all__ = ["STUDIES", "STUDY", "SWEEPS", "isolation_study", "sweep", "watched"]

_WRONG_KEPT = 20  # wrong answers that are kept
_KAPPA = 0.8  # that is asked for


def _filters() -> list[ca.Function]:
    return [ekf_step(jump_model(GasGenerator())).function]


STUDY = Study(
    "isolation",
    order=60,
    title="Which fault is it?",
    goal="Healthy, four single gas faults, two pairs, a short circuit and three sensor faults of 1 "
    "to 4 %: Cohen's kappa of 0.8 or more, the information limit beside it.",
    tuned="chosen on seeds 1 to 99",
    modules={"isolation": ("estimators.apu.isolation", "scenarios.studies.estimation.isolation")},
    filters=_filters,
    text="""
@intro
Eleven classes, faults of 1 to 4 %, on a unit with wear and unknown constant gain errors, at any
load and day, the load wandering and stepping. *Watched*: the unit is seen for 4 s before the fault;
*another engine*: the truth is not the classifier's model; *no history*: the fault is there from the
beginning, and wear, gain errors and the offset of h are known by their priors alone; the last study
has these priors at 0.3 of that, as after an earlier inspection. The limit is Bayes' rule in the
linear problem: no classifier is better.

@kappa
6 | kappa, {study}, {method} | >= {goal} | {kappa:.3f} | {kappa_95:.3f}; limit {limit:.3f}
| {n} windows, {seeds}
| information limit: Bayes' rule itself reaches {limit:.2f}; wear and gain errors of a unit without
history look like faults

@studies
study | kappa, GLR | filter bank | information limit | limit, onset known | NIS over expected
| onset, RMS ms | size, RMS
---
{study} | {glr[kappa]:.3f} ({glr[kappa_95]:.3f}) | {bank[kappa]:.3f} ({bank[kappa_95]:.3f})
| {limit[kappa]:.3f} ({limit[kappa_95]:.3f})
| {limit_onset_known[kappa]:.3f} ({limit_onset_known[kappa_95]:.3f}) | {nis:.3f} | {onset_ms:.0f}
| {size_rms:.2%}

@sweeps
How the limit depends on what is measured (`electrical`: whether the severity from the electrical
filter is there):

@sweeps table
study | changed | value | kappa | 95 % interval
---
{study} | {change} | {value!s} | {kappa:.3f} | {kappa_95:.3f}

@caption confusion
Per cent of the windows of each true class; the classifier's answer by column. The limit is Bayes'
rule in the linear problem.

@caption limit
Information limit of Cohen's kappa; shaded: 95 % interval; dashed: what is asked for.
""",
)


def isolation_study(
    n: int = 50,
    seed0: int = 1000,
    protocol: Protocol = DEFAULT,
    *,
    limit_draws: int = 200,
    limit_points: int = 8,
    gg: GasGenerator | None = None,
    truth: Sequence[GasGenerator] = (),
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Classify n fresh windows of each class; the information limit beside it.

    Args:
        n: windows of each class, with seeds ``seed0`` to ``seed0 + n - 1``.
        seed0: first seed; seeds below 100 were used for tuning.
        protocol, gg: what is measured, and of what.
        truth: engines that are simulated instead of ``gg``, by turns of the seeds: the classifiers'
            model is then wrong.
        limit_draws, limit_points: of :func:`information_limit`.
        progress: called with (done, total) windows.

    Returns:
        Numbers that JSON can hold: ``protocol``; by method, and for ``limit`` and
        ``limit_onset_known``, confusion matrix, kappa with interval, share right, recall; ``nis``
        (mean over its expectation, before any onset); ``onset_rms`` in s and relative ``size_rms``
        of right answers; ``wrong``: every wrong answer of the last method with its sizes.
    """
    gg = GasGenerator() if gg is None else gg
    labels = np.repeat(np.arange(len(CLASSES)), n)
    seeds = seed0 + np.tile(np.arange(n), len(CLASSES))
    windows = windows_of_engines(labels, seeds, protocol, truth or [gg])
    model = model_of(gg, protocol.N_walk)
    confusion = {m: np.zeros((len(CLASSES), len(CLASSES)), int) for m in METHODS}
    nis, onset_error, size_error, wrong = [], [], [], []
    last = METHODS[-1]
    for i in range(labels.size):
        v = isolate(recording_of(model, windows, i, protocol), protocol, gg)
        for m in METHODS:
            confusion[m][labels[i], int(np.argmax(v.log_probability[m]))] += 1
        nis.append(v.nis)
        given = int(np.argmax(v.log_probability[last]))
        if given != labels[i]:
            odds = v.log_probability[last][given] - v.log_probability[last][labels[i]]
            row = {"seed": int(seeds[i]), "true": CLASSES[labels[i]].name}
            row |= {"given": CLASSES[given].name, "sizes": windows.sizes[i]}
            wrong.append(row | {"log_odds": float(odds)})
        elif labels[i]:
            onset_error.append(DT * (v.onset - int(windows.onset[i])))
            size_error += [v.sizes[f] - s for f, s in windows.sizes[i].items() if f in v.sizes]
        if progress is not None:
            progress(i + 1, labels.size)
    out: dict[str, Any] = {"protocol": protocol.describe(), "seeds": [seed0, seed0 + n - 1]}
    out |= {m: scores(c) for m, c in confusion.items()}
    out["limit"] = information_limit(limit_draws, seed0, protocol, gg, points=limit_points)
    out["limit_onset_known"] = information_limit(
        limit_draws, seed0, protocol, gg, points=limit_points, onset_known=True
    )

    def rms(v: list[float]) -> float | None:
        return float(np.sqrt(np.mean(np.square(v)))) if v else None

    out["nis"] = float(np.mean(nis))
    out |= {"onset_rms": rms(onset_error), "size_rms": rms(size_error), "wrong": wrong}
    return out


def sweep(
    changes: Mapping[str, Sequence[Any]], seed: int, protocol: Protocol
) -> list[dict[str, Any]]:
    """Return the information limit as one thing of the protocol is changed at a time.

    Args:
        changes: values by field of :class:`Protocol`, such as ``{"after": [0.5, 1, 2, 4]}``.
        seed: see :func:`information_limit`.
        protocol: what is changed.
    """
    rows = []
    for name, values in changes.items():
        for value in values:
            p = dataclasses.replace(protocol, **{name: value})
            r = information_limit(100, seed, p, points=4)
            scored = {k: r[k] for k in ("kappa", "kappa_95", "n")}
            rows.append({"change": name, "value": value, **scored})
    return rows


STUDIES: dict[str, tuple[Protocol, bool]] = {
    "watched": (DEFAULT, False),
    "watched, another engine": (DEFAULT, True),
    "no history": (SNAPSHOT, False),
    "no history, baseline known to 0.3": (dataclasses.replace(SNAPSHOT, baseline=0.3), False),
}
"""By name: the protocol, and whether the simulated engines differ from the classifiers'."""
SWEEPS: tuple[tuple[str, Protocol, dict[str, Sequence[Any]]], ...] = (
    (
        "watched",
        DEFAULT,
        {
            "after": [0.1, 0.2, 0.5, 1.0, 2.0, 4.0],
            "before": [0.2, 0.5, 1.0, 2.0, 4.0],
            "noise": [1.0, 2.0, 4.0, 8.0, 16.0],
            "electrical": [True, False],
        },
    ),
    (
        "no history",
        SNAPSHOT,
        {
            "baseline": [0.05, 0.1, 0.2, 0.3, 0.5, 1.0],
            "after": [0.5, 2.0, 8.0],
            "electrical": [True, False],
        },
    ),
)
"""What the information limit is computed over."""


def watched(name: str, gg: GasGenerator) -> tuple[Protocol, list[GasGenerator]]:
    """Return the protocol of one of :data:`STUDIES`, and the engines that are simulated.

    Raises:
        ParameterError: unknown name; the nearest is named.
    """
    if name not in STUDIES:
        raise ParameterError(f"unknown study {name!r} {nearest(name, STUDIES)}")
    protocol, other = STUDIES[name]
    return protocol, [variant(gg, c) for c in VARIANTS.values() if c] if other else []


def _isolation(name: str, n: int, seed0: int, tell: Tell) -> Any:
    gg = GasGenerator()
    protocol, engines = watched(name, gg)
    out = isolation_study(n, seed0, protocol, gg=gg, truth=engines, progress=tell)
    out["n_wrong"], out["wrong"] = len(out["wrong"]), out["wrong"][:_WRONG_KEPT]
    return out


for _name in STUDIES:
    STUDY.part(_name, start=35, each=0.42, share=0.1)(partial(_isolation, _name))


@STUDY.part("sweeps", start=120, share=None)
def _sweeps(n: int, seed0: int, tell: Tell) -> Any:
    return {name: sweep(changes, seed0, protocol) for name, protocol, changes in SWEEPS}


@STUDY.claims
def claims(r: Results) -> list[Claim]:
    """Claim kappa of both classifiers."""
    out = []
    for name in STUDIES:
        if name in r:
            c = r[name]
            about = {"study": name, "goal": _KAPPA, "limit": c["limit"]["kappa"]}
            for method in METHODS:
                met, values = c[method]["kappa"] >= _KAPPA, c[method] | {"seeds": c["seeds"]}
                out.append(STUDY.claim("kappa", met, method=method, **about, **values))
    return out


@STUDY.section
def section(r: Results) -> list[str]:
    """Show kappa and limits, and how the limit depends on what is measured."""
    out, t, rows = [], STUDY.template, []
    for name in STUDIES:
        if name in r:
            onset = r[name]["onset_rms"]
            ms = None if onset is None else 1e3 * onset
            rows.append({"study": name, "onset_ms": ms, **r[name]})
    if rows:
        out.append(t.table("studies", rows))
    swept = [{"study": n, **x} for n, some in r.get("sweeps", {}).items() for x in some]
    if swept:
        out += [t.text("sweeps"), t.table("sweeps table", swept)]
    return out


@STUDY.figures
def figures(r: Results) -> Pictures:
    """Draw confusion matrices, and kappa over what is measured."""
    made: Pictures = {}
    text = STUDY.template.text
    panels = [(f"{n}, filter bank", r[n]["bank"]) for n in ("watched", "no history") if n in r]
    if "no history" in r:
        panels.append(("no history, limit", r["no history"]["limit"]))
    if panels:
        fig = partial(plot_confusion, panels, text("caption confusion"))
        made["Confusion matrices"] = ("estimation_confusion.png", fig)
    labels = {
        "after": "seconds after the onset",
        "before": "seconds before it",
        "noise": "noise, times the table",
        "baseline": "uncertainty of the unit, times",
    }
    curves = []
    for name, rows in r.get("sweeps", {}).items():
        for change, label in labels.items():
            some = [x for x in rows if x["change"] == change]
            if len(some) > 1 and (name, change) != ("no history", "after"):
                curves.append((f"{name}: {change}", label, some))
    if curves:
        fig = partial(plot_kappa, curves[:4], text("caption limit"))
        made["Information limit of the isolation"] = ("estimation_limit.png", fig)
    return made
