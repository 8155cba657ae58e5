"""The page about data sets, docs/DATASET.md: scores of all baselines, and two figures."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import DataError
from apu_casadi.core.version import installed
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu.sensors import GAS_PATH
from scenarios import registry
from scenarios.datasets import baselines, scoring
from scenarios.datasets.making import solver_of
from scenarios.datasets.recipe import CLASSES, FIRST_H, Recipe, draw
from scenarios.figures import datasetplot
from scenarios.schema import Scenario
from scenarios.shell.markdown import markdown_table
from scenarios.shell.template import Template

COMPARED = 4
"""Runs with a fault of which both exchanges are compared."""


def scored(
    folder: str | Path, seed: int = 1, progress: Callable[[str, float], None] | None = None
) -> dict[str, dict[str, Any]]:
    """Return scores of every baseline: in validation and test (``held``), and in ``range``.

    Raises:
        DataError: a damaged data set, or one without units in these splits.
    """
    labels = scoring.read_labels(folder)
    split = labels["split"]
    masks = {"held": np.isin(split, ["validation", "test"]), "range": split == "range"}
    if lacking := [n for n, mask in masks.items() if not mask.any()]:
        raise DataError(f"{folder}: no run to score ({lacking[0]}): make more units")
    out = {}
    for name in baselines.METHODS:
        told = None if progress is None else (lambda done, n, m=name: progress(m, done / n))
        rows = baselines.predict(name, folder, seed=seed, progress=told)
        text = baselines.predictions_text(rows)
        p = scoring.parsed(name, text, labels)
        out[name] = {
            part: scoring.score_of(
                {n: v[mask] for n, v in p.values.items()}, {n: v[mask] for n, v in labels.items()}
            )
            for part, mask in masks.items()
        }
        out[name]["missed"] = _missed(p.values, labels, masks["held"])
    return out


def _missed(
    said: Mapping[str, np.ndarray], labels: Mapping[str, np.ndarray], held: np.ndarray
) -> dict[str, Any]:
    """Return losses of one factor, those that were called healthy, and what is known of h."""
    one = held & np.isin(labels["class"], list(HEALTH))
    loss = np.max([1 - labels[n] for n in HEALTH], axis=0)
    none = labels["class"] == "healthy"
    return {
        "changes": int(one.sum()),
        "losses": loss[one & (said["class"] == "healthy")],
        "sigma": said["h_sigma"][none] if "h_sigma" in said else np.array([np.nan]),
    }


def limits_of(r: Recipe, labels: Mapping[str, np.ndarray], found: Mapping[str, Any]) -> Any:
    """Return what the page says of runs that nothing tells.

    Args:
        r, labels: recipe and labels of the set.
        found: what an estimator missed, of :func:`scored`.
    """
    h, over = labels["h"], labels["over"]
    short, grows = h > 0, (h > 0) & (over > 0)
    begin = np.minimum(FIRST_H, h[grows] / 2)
    end = begin * (h[grows] / begin) ** np.minimum(r.waveforms["after"] / over[grows], 1.0)
    least, losses = 5 * float(np.nanmedian(found["sigma"])), found["losses"]
    counts = {"shorts": short, "grown": grows, "hidden": end < least}
    out: dict[str, Any] = {n: int(v.sum()) for n, v in counts.items()}
    out |= {"least": least, "median": float(np.median(end)) if end.size else 0.0}
    out |= {"lo": float(np.nanmin(found["sigma"])), "hi": float(np.nanmax(found["sigma"]))}
    out |= {"missed": int(losses.size), "changes": found["changes"], "after": r.waveforms["after"]}
    some = losses if losses.size else np.zeros(1)
    return out | {"small": float(some.min()), "large": float(some.max())}


def exchange_error(r: Recipe) -> tuple[float, str]:
    """Return how far the recipe's exchange is from the predicted one, in the noise of sensors.

    Returns:
        Largest difference of a true reading over the standard deviation of its noise, its sensor.
    """
    drawn = (draw(r, u, 0) for u in range(r.units))
    ill = [d for d in drawn if d.labels["class"] not in ("healthy", "sensor")][:COMPARED]
    found = {s.name: 0.0 for s in GAS_PATH.sensors}
    for d in ill:
        asked = registry.joint_arguments(Scenario.from_dict({**d.scenario, "waveform_dt": 0}))
        asked |= solver_of(d)
        two = [simulate_joint(**{**asked, "exchange": e}) for e in (r.exchange, "predicted")]
        for s in (s for s in GAS_PATH.sensors if s.name in two[0]):
            a, b = (ds[s.name].values for ds in two)
            off = np.abs(a - b) / s.sigma(float(np.mean(b)))
            found[s.name] = max(found[s.name], float(off.max()))
    worst = max(found, key=lambda n: found[n])
    return found[worst], worst


def write_page(
    folder: str | Path,
    page: str | Path,
    *,
    seed: int = 1,
    progress: Callable[[str, float], None] | None = None,
) -> list[Path]:
    """Write the page and its figures in ``images`` beside it; return the paths."""
    told = json.loads(files.read_text(Path(folder) / "recipe.json"))
    r, page = Recipe.of(told["recipe"]), Path(page)
    labels, scores = scoring.read_labels(folder), scored(folder, seed, progress)
    images = files.folder(page.parent / "images")
    made = [files.save_figure(_example(folder, labels), images / "dataset_run.png", dpi=120)]
    shown = ("thresholds", "forest", "estimators")
    panels = [(f"{n}, κ = {scores[n]['held']['kappa']:.2f}", _counts(scores[n])) for n in shown]
    figure = datasetplot.plot_confusions(panels, CLASSES)
    made.append(files.save_figure(figure, images / "dataset_confusion.png", dpi=120))
    made.append(files.write_text(page, _text(r, labels, scores)))
    return made


def _counts(s: Mapping[str, Any]) -> np.ndarray:
    table = s["held"]["confusion"]
    return np.array([[table.get(a, {}).get(b, 0) for b in CLASSES] for a in CLASSES])


def _example(folder: str | Path, labels: Mapping[str, np.ndarray]) -> Any:
    """Draw the largest short circuit that was there at once."""
    size = np.where((labels["class"] == "ttsc") & (labels["over"] == 0), labels["h"], -1.0)
    k = int(np.argmax(size))
    if size[k] <= 0:
        raise DataError(f"{folder}: no run with a short circuit to be drawn: make more units")
    of = {n: v[k : k + 1] for n, v in labels.items()}
    _, gas, waves = next(baselines.runs_of(folder, of))
    return datasetplot.plot_example(gas, waves, {n: v[0] for n, v in of.items()})


def _text(r: Recipe, labels: Mapping[str, np.ndarray], scores: Mapping[str, Any]) -> str:
    text, split = Template.of("dataset.md"), labels["split"]
    error, worst = exchange_error(r)
    values = {n: getattr(r, n) for n in ("title", "duration", "growing", "units", "seed")}
    values |= {n: r.waveforms[n] for n in ("before", "after")}
    values |= {"block": len(r.order), "period": 1e3 / r.waveforms["rate"]}
    values |= {"exchange": error, "worst": worst, "compared": COMPARED, "version": installed()}
    values |= {"n": int(np.isin(split, ["validation", "test"]).sum())}
    values |= {"n_train": int((split == "train").sum()), "n_range": int((split == "range").sum())}
    values |= {"alarms": scoring.FALSE_ALARMS, "features": baselines.FEATURES}
    of_classes = [c for c in CLASSES if c in scores["chance"]["held"]["by_class"]]
    head, *cells = text.rows("method", [_row(n, s) for n, s in scores.items()])
    runs = {c: scores["chance"]["held"]["by_class"][c]["runs"] for c in of_classes}
    right = {c: [_share(s["held"]["by_class"][c]["right"]) for s in scores.values()] for c in runs}
    table = markdown_table(
        ["class", "runs", *(f"`{n}`" for n in scores)],
        [[f"`{c}`", str(n), *right[c]] for c, n in runs.items()],
        right=range(1, len(scores) + 2),
    )
    parts = [text.filled("page", **values), markdown_table(head, cells, right=range(1, len(head)))]
    limits = limits_of(r, labels, scores["estimators"]["missed"])
    parts += [text.raw("class"), table, text.raw("figure"), text.filled("limits", **limits)]
    return "\n\n".join(parts) + "\n"


def _share(x: float | None) -> str:
    return "-" if x is None else f"{100 * x:.0f} %"


def _row(name: str, s: Mapping[str, Any]) -> dict[str, Any]:
    """Return what stands in a method's row of the table."""
    held, h = s["held"], s["held"]["severities"].get("h", {}).get("rmse")
    at = held.get("detected_at_false_alarms", {}).get("detected")
    rmse = "-" if h is None else f"{h:.1e}"
    return {"name": name, **held, "at": _share(at), "h": rmse, "beyond": s["range"]["kappa"]}
