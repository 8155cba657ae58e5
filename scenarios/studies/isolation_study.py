"""Fresh windows of every class, classified; beside them the information limit, and its course."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.gaspath.gasgenerator import GasGenerator
from estimators.apu.isolation.classifiers import METHODS, isolate, recording_of
from estimators.apu.isolation.limit import information_limit
from estimators.apu.isolation.problem import CLASSES, DEFAULT, DT, SNAPSHOT, Protocol
from estimators.apu.isolation.scores import scores
from estimators.apu.isolation.truth import windows_of_engines
from estimators.apu.isolation.windowmodel import model_of
from scenarios.studies.gaspath_study import VARIANTS, variant

__all__ = ["STUDIES", "SWEEPS", "figures", "isolation_study", "run", "sweep"]


def isolation_study(
    n: int = 50,
    seed0: int = 1000,
    protocol: Protocol = DEFAULT,
    *,
    methods: Sequence[str] = METHODS,
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
        methods: see :func:`isolate`.
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
    confusion = {m: np.zeros((len(CLASSES), len(CLASSES)), int) for m in methods}
    nis, onset_error, size_error, wrong = [], [], [], []
    last = methods[-1]
    for i in range(labels.size):
        v = isolate(recording_of(model, windows, i, protocol), protocol, gg, methods=methods)
        for m in methods:
            confusion[m][labels[i], int(np.argmax(v.log_probability[m]))] += 1
        nis.append(v.nis)
        given = int(np.argmax(v.log_probability[last]))
        if given != labels[i]:
            wrong.append({
                "seed": int(seeds[i]), "true": CLASSES[labels[i]].name,
                "given": CLASSES[given].name, "sizes": windows.sizes[i],
                "log_odds": float(v.log_probability[last][given]
                                  - v.log_probability[last][labels[i]]),
            })  # fmt: skip
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
    changes: Mapping[str, Sequence[Any]],
    draws: int = 100,
    seed: int = 0,
    protocol: Protocol = DEFAULT,
    gg: GasGenerator | None = None,
    *,
    points: int = 4,
) -> list[dict[str, Any]]:
    """Return the information limit as one thing of the protocol is changed at a time.

    Args:
        changes: values by field of :class:`Protocol`, such as ``{"after": [0.5, 1, 2, 4]}``.
        draws, seed, points, gg: see :func:`information_limit`.
    """
    rows = []
    for name, values in changes.items():
        for value in values:
            p = dataclasses.replace(protocol, **{name: value})
            r = information_limit(draws, seed, p, gg, points=points)
            rows.append({"change": name, "value": value, "kappa": r["kappa"],
                         "kappa_95": r["kappa_95"], "n": r["n"]})  # fmt: skip
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


def run(
    n: int = 50,
    seed0: int = 1000,
    *,
    studies: Sequence[str] = tuple(STUDIES),
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Run the studies, and how the information limit depends on what is measured.

    Args:
        n, seed0: see :func:`isolation_study`.
        studies: of :data:`STUDIES`.
        progress: called with (done, total) windows of each study.

    Returns:
        ``studies`` and ``sweeps``, by name.

    Raises:
        ParameterError: unknown study.
    """
    gg = GasGenerator()
    others = [variant(gg, change) for change in VARIANTS.values() if change]
    done: dict[str, Any] = {}
    for name in studies:
        if name not in STUDIES:
            raise ParameterError(f"unknown study {name!r} {nearest(name, STUDIES)}")
        protocol, other = STUDIES[name]
        done[name] = isolation_study(
            n, seed0, protocol, gg=gg, truth=others if other else (), progress=progress
        )
    swept = {
        name: sweep(changes, seed=seed0, protocol=protocol, gg=gg)
        for name, protocol, changes in SWEEPS
    }
    return {"studies": done, "sweeps": swept}


def figures(result: Mapping[str, Any]) -> dict[str, Any]:
    """Draw what :func:`run` returned: confusion matrices, and kappa over what is measured.

    Returns:
        Figures by name: ``isolation_confusion``, ``isolation_limit``.
    """
    from scenarios.figures.isolationplot import plot_confusion, plot_kappa

    studies, sweeps = result["studies"], result["sweeps"]
    best, hard = studies["watched"], studies["no history, baseline known to 0.3"]
    panels = [
        ("fault begins under watch: bank", best["bank"]),
        ("no history, baseline to 0.3: bank", hard["bank"]),
        ("the same: information limit", hard["limit"]),
    ]
    n = best["bank"]["n"]
    note = (
        f"True class by row, given class by column, per cent of the true class; κ with 95 % "
        f"interval, {n} fresh windows for each classifier. The information limit is Bayes' rule "
        "where it is exact: linear, Gaussian, all priors known."
    )
    labels = {
        ("watched", "after"): ("after the latest onset", "s"),
        ("watched", "before"): ("before the earliest onset", "s"),
        ("watched", "noise"): ("sensor noise", "factor on the table"),
        ("no history", "baseline"): ("no history: baseline", "factor on wear and gain errors"),
    }
    curves = [
        (head, unit, [r for r in sweeps[study] if r["change"] == change])
        for (study, change), (head, unit) in labels.items()
    ]
    return {
        "isolation_confusion": plot_confusion(panels, note),
        "isolation_limit": plot_kappa(
            curves,
            "Information limit of eleven classes: kappa of Bayes' rule in the linear problem with "
            "95 % interval; all else as in the protocol. Dashed: 0.8.",
        ),
    }


def main() -> None:
    """Run the studies from the shell; results as JSON, figures beside them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--n", type=int, default=50, help="windows of each class (50)")
    parser.add_argument("--seed0", type=int, default=1000, help="first seed (1000)")
    parser.add_argument("--study", action="append", choices=list(STUDIES), help="only this one")
    parser.add_argument("--out", type=Path, help="write the results here, as JSON")
    args = parser.parse_args()

    def tell(done: int, total: int) -> None:
        if done % 50 == 0 or done == total:
            print(f"{done} of {total} windows", file=sys.stderr, flush=True)

    result = run(args.n, args.seed0, studies=args.study or tuple(STUDIES), progress=tell)
    for name, r in result["studies"].items():
        kappas = ", ".join(f"{m} {r[m]['kappa']:.3f}" for m in (*METHODS, "limit"))
        print(f"{name}: kappa {kappas}")
    if args.out is not None:
        files.write_text(args.out, json.dumps(result, indent=1))
        if not args.study:
            for name, fig in figures(result).items():
                files.save_figure(fig, args.out.with_name(f"{name}.png"))


if __name__ == "__main__":
    main()
