"""Score predictions about a data set: detection, latency, classes, severities, coverage.

Predictions are a file, CSV or Parquet, with one row a run: ``run`` and ``class`` are needed;
``score`` (higher is more faulty), ``alarm_time`` (s, empty for none), ``phase``, ``generator``,
severities (``h``, ``f_eta_c``, ...) and their standard deviations (``h_sigma``, ...) are scored
where they are given.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import DataError, nearest
from apu_casadi.core.tables.numbertable import NumberTable, numbers_of, read_numbers
from apu_casadi.core.tables.tablelayout import TableLayout
from apu_casadi.gaspath.health import HEALTH
from scenarios.datasets.making import RUNS
from scenarios.datasets.recipe import CLASSES, SPLITS

SEVERITIES = ("h", *HEALTH)
COLUMNS = ("run", "class", "score", "alarm_time", "phase", "generator", *SEVERITIES,
           *(f"{n}_sigma" for n in SEVERITIES))  # fmt: skip
FALSE_ALARMS = 0.05
"""Share of healthy runs that may be called faulty where a detection rate is stated."""
LEVEL = 1.959963984540054  # of a 95 % band


def parquet(path: Path) -> Any:
    """Return a table of a data set as a pandas.DataFrame.

    Raises:
        DataError: a damaged file, or no package that reads it.
    """
    raw = io.BytesIO(files.read_bytes(path))
    try:
        return import_module("pandas").read_parquet(raw)
    except ImportError as e:
        raise DataError(f"{path} needs: pip install 'apu-casadi[parquet]' ({e})") from None
    except Exception as e:  # damaged files fail with any type
        raise DataError(f"{path}: damaged ({type(e).__name__}: {e})") from None


def read_labels(folder: str | Path) -> dict[str, np.ndarray]:
    """Return the labels of a data set's runs that were done, by column.

    Raises:
        DataError: no data set there, or its labels cannot be read.
    """
    path = Path(folder) / RUNS
    if not path.is_file():
        raise DataError(f"{path} is not there: the folder of apu dataset make is expected")
    frame = parquet(path)
    frame[frame["status"] == "done"]
    return {str(n): frame[n].to_numpy() for n in frame}


@dataclass(frozen=True)
class Predictions:
    """What was predicted of each run, in the order of the labels.

    Args:
        values: by column; text for ``class`` and ``phase``, NaN where nothing was said.
    """

    values: Mapping[str, np.ndarray]


def read_predictions(path: str | Path, labels: Mapping[str, np.ndarray]) -> Predictions:
    """Read predictions of all runs given by their labels.

    Raises:
        DataError: an unknown column or class, a run that is missing, doubled or not there, no
            number; with line and value.
    """
    return _predictions(read_numbers(path, COLUMNS.__contains__, layout=_Layout()), labels)


def parsed(path: str | Path, text: str, labels: Mapping[str, np.ndarray]) -> Predictions:
    """Read predictions out of the text of a file; see :func:`read_predictions`."""
    return _predictions(numbers_of(path, text, COLUMNS.__contains__, _Layout()), labels)


class _Layout(TableLayout):
    remedies = {
        **TableLayout.remedies,
        "gap": ": leave the cell empty where nothing is said",
        "sentinel": "leave the cell empty where nothing is said",
        "unit": "this column has none: delete it",
    }


def _predictions(table: NumberTable, labels: Mapping[str, np.ndarray]) -> Predictions:
    path, head = table.path, table.names
    for h in head:
        if h not in COLUMNS:
            raise DataError(f"{path}: column {h!r} {nearest(h, COLUMNS)}: rename or delete it")
    if twice := [h for k, h in enumerate(head) if h in head[:k]]:
        raise DataError(f"{path}: column {twice[0]} is there twice")
    if missing := [n for n in ("run", "class") if n not in head]:
        raise DataError(f"{path}: column {missing[0]} is missing")
    if alone := [n for n in SEVERITIES if f"{n}_sigma" in head and n not in head]:
        raise DataError(f"{path}: column {alone[0]} is missing for {alone[0]}_sigma")
    columns = {n: _column(table, n) for n in head}
    runs, at = [int(n) for n in labels["run"]], dict[int, int]()
    for k, run in enumerate(columns["run"]):
        if run in at:
            raise DataError(f"{table.place(k)}: run {run} is there twice")
        at[run] = k
    _compare(path, at, runs)
    return Predictions({n: np.array([columns[n][at[r]] for r in runs]) for n in head})


def _column(table: NumberTable, name: str) -> Sequence[Any]:
    """Return the cells of a column as they are scored."""
    words = table.texts(name)
    for k, word in enumerate(words):
        where = table.place(k)
        if name == "class" and not word:
            raise DataError(f"{where}: class {word!r} of a run is missing")
        if name == "class" and word not in CLASSES:
            raise DataError(f"{where}: class {word!r} {nearest(word, CLASSES)}")
        if name == "phase" and word not in ("", "a", "b", "c"):
            raise DataError(f"{where}: phase {word!r}: a, b, c or nothing is expected")
        if name == "run" or (name == "generator" and word):
            whole = r"\d+" if name == "run" and name in table.words else r"\d+(\.0)?"
            if not re.fullmatch(whole, word):
                raise DataError(f"{where}: {name} {word!r} is no whole number")
    if name in ("class", "phase"):
        return words
    if name in ("run", "generator"):
        return [int(float(w)) if w else math.nan for w in words]
    unit = "s" if name == "alarm_time" else "1" if name != "score" else ""
    values = table.numbers(name, unit, gaps=True, ordered=name == "score")
    for k, word in enumerate(words):
        if word and not math.isfinite(values[k]):
            raise DataError(
                f"{table.place(k)}: {name} = {word!r} is no finite number: leave the cell empty "
                "where nothing is said"
            )
        if name.endswith("_sigma") and values[k] <= 0:
            raise DataError(f"{table.place(k)}: {name} = {word!r} must be > 0")
    return list(values)


def _compare(path: str | Path, found: Mapping[int, Any], runs: Sequence[int]) -> None:
    for what, odd in (
        ("are missing", sorted(set(runs) - set(found))),
        ("are not in the data set", sorted(set(found) - set(runs))),
    ):
        if odd:
            some = ", ".join(map(str, odd[:5])) + (", ..." if len(odd) > 5 else "")
            raise DataError(f"{path}: {len(odd)} runs {what}: {some}")


# ------------------------------------------------------------------------------ scores


def score(p: Predictions, labels: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return all scores, by split, ready for JSON."""
    split = labels["split"]
    parts = {"all": np.ones(split.size, dtype=bool)}
    parts |= {s: split == s for s in SPLITS if (split == s).any()}
    return {
        name: score_of(
            {n: v[mask] for n, v in p.values.items()}, {n: v[mask] for n, v in labels.items()}
        )
        for name, mask in parts.items()
    }


def score_of(p: Mapping[str, np.ndarray], y: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the scores of some runs, predictions and labels by column."""
    true, said = y["class"], p["class"]
    ill = true != "healthy"
    out: dict[str, Any] = {
        "runs": int(true.size),
        "accuracy": float(np.mean(true == said)),
        "kappa": cohen_kappa(true, said),
        "detected": _share(said[ill] != "healthy"),
        "false_alarms": _share(said[~ill] != "healthy"),
        "confusion": confusion(true, said),
        "by_class": {
            c: {
                "runs": int((true == c).sum()),
                "right": _share(said[true == c] == c),
                "detected": _share(said[true == c] != "healthy"),
            }
            for c in CLASSES
            if (true == c).any()
        },
    }
    if "score" in p:
        out["detected_at_false_alarms"] = {
            "false_alarms": FALSE_ALARMS, "detected": at_false_alarms(p["score"], ill),
        }  # fmt: skip
    if "alarm_time" in p:
        out["latency"] = _latency(p["alarm_time"], y)
    short = np.isin(true, ["ttsc", "combined"]) & np.isin(said, ["ttsc", "combined"])
    for name in ("phase", "generator"):
        if name in p and short.any():
            out[f"{name}_right"] = _share(p[name][short] == y[name][short])
    out["severities"] = {n: _severity(n, p, y) for n in SEVERITIES if n in p}
    return out


def _share(hit: np.ndarray) -> float | None:
    return float(hit.mean()) if hit.size else None


def cohen_kappa(true: np.ndarray, said: np.ndarray) -> float | None:
    """Return Cohen's kappa: agreement beyond chance, over what is possible beyond it."""
    names = np.unique(np.concatenate([true, said]))
    a = np.array([(true == n).mean() for n in names])
    b = np.array([(said == n).mean() for n in names])
    chance = float(a @ b)
    return None if chance >= 1.0 else (float((true == said).mean()) - chance) / (1.0 - chance)


def confusion(true: np.ndarray, said: np.ndarray) -> dict[str, dict[str, int]]:
    """Return how often each class was called what."""
    return {
        t: {s: int(n) for s in CLASSES if (n := ((true == t) & (said == s)).sum())}
        for t in CLASSES
        if (true == t).any()
    }


def at_false_alarms(value: np.ndarray, ill: np.ndarray) -> Any:
    """Return the share of faulty runs above what :data:`FALSE_ALARMS` of healthy ones exceed."""
    if not (~ill).any() or not ill.any() or not np.isfinite(value).all():
        return None
    healthy = np.sort(value[~ill])
    k = math.floor(FALSE_ALARMS * healthy.size)  # so many healthy runs may lie above
    return float((value[ill] > healthy[healthy.size - 1 - k]).mean())


def _latency(alarm: np.ndarray, y: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Time from onset to alarm; an alarm before the onset is a false one."""
    ill = y["class"] != "healthy"
    late = alarm[ill] - y["onset"][ill]
    right = late[late >= 0]
    return {
        "median": float(np.median(right)) if right.size else None,
        "p90": float(np.quantile(right, 0.9)) if right.size else None,
        "found": _share(late >= 0),
        "early": _share(late < 0),
        "false_alarms": _share(np.isfinite(alarm[~ill])),
    }


def _severity(name: str, p: Mapping[str, np.ndarray], y: Mapping[str, np.ndarray]) -> Any:
    said, true = p[name], y[name]
    there = np.isfinite(said)
    out: dict[str, Any] = {"runs": int(there.sum())}
    if not there.any():
        return out
    e = (said - true)[there]
    out["rmse"] = float(np.sqrt(np.mean(e**2)))
    present = there & (true != (0.0 if name == "h" else 1.0))
    if present.any():
        size = np.abs(true - (0.0 if name == "h" else 1.0))[present]
        miss = (said - true)[present]
        out["relative_rmse_if_faulty"] = float(np.sqrt(np.mean((miss / size) ** 2)))
        halves = size <= np.median(size)
        out["rmse_small"], out["rmse_large"] = (
            float(np.sqrt(np.mean(miss[m] ** 2))) if m.any() else None for m in (halves, ~halves)
        )
    sigma = p.get(f"{name}_sigma")
    if sigma is not None and (ok := there & (sigma > 0)).any():
        out["coverage_95"] = float((np.abs(said - true)[ok] <= LEVEL * sigma[ok]).mean())
    return out
