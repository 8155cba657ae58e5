"""Baselines: what simple methods, a classifier of scikit-learn and our own filters say.

They are there to be beaten.  The waveforms of a run are kept around its onset, so that every method
that reads them is told roughly when to look; those of the gas path are not cut.
"""

from __future__ import annotations

import csv
import io
import json
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import ApuError, ApuWarning, DataError, nearest
from apu_casadi.gaspath.health import HEALTH
from estimators.apu.sensors import GAS_PATH
from estimators.apu.trust import GAS
from scenarios.datasets import waveforms
from scenarios.datasets.making import VARIED
from scenarios.datasets.recipe import CLASSES
from scenarios.datasets.scoring import parquet, read_labels

Progress = Callable[[float, float], None]
Rows = list[dict[str, Any]]
_RATIOS = tuple(f"X_s.{n}" for n in GAS_PATH.names)
FEATURES = len(_RATIOS) + 2 * 5
"""Number of what :func:`features` returns: five of each generator."""
_ALARM = 4.0  # robust standard deviations of healthy training runs: a reading that is told


def runs_of(folder: str | Path, labels: Mapping[str, np.ndarray]) -> Iterator[tuple[int, Any, Any]]:
    """Yield number, gas path and waveforms (or None) of each run, as pandas.DataFrames."""
    where = dict(zip(labels["run"].tolist(), labels["unit"].tolist(), strict=True))
    unit: int | None = None
    tables: dict[str, Any] = {}
    for run in labels["run"].tolist():
        if where[run] != unit:
            unit, tables = where[run], {}
            for part in ("gaspath", "electrical"):
                path = Path(folder) / part / f"unit_{unit:05d}.parquet"
                if (packed := path.with_suffix(waveforms.ENDING)).is_file():
                    tables[part] = waveforms.frame(packed)
                elif path.is_file():  # also waveforms of a set made before they were netCDF
                    tables[part] = parquet(path)
        gas, waves = (t[t["run"] == run] if (t := tables.get(p)) is not None else None
                      for p in ("gaspath", "electrical"))  # fmt: skip
        if gas is None:
            raise DataError(f"{folder}: the gas path of run {run} is missing")
        yield run, gas, waves


def features(gas: Any, waves: Any) -> np.ndarray:
    """Return numbers that tell of a change: end over beginning, of readings and of unbalances.

    Log ratios of the gas path's readings, last half second over the first second; of each
    generator the changes of phase currents, and of what turns backwards in currents and voltages.
    """
    t = gas["time"].to_numpy()
    late, early = t >= t[-1] - 0.5, t < t[0] + 1.0
    y = gas[list(_RATIOS)].to_numpy(dtype=float)
    out = [np.log(np.abs(y[late].mean(axis=0) / y[early].mean(axis=0)))]
    for k in (1, 2):
        parts: list[np.ndarray] = []
        if waves is not None:
            half = len(waves) // 3
            parts = [_phases(part, k) for part in (waves.iloc[:half], waves.iloc[-half:])]
        out.append(parts[1] - parts[0] if parts else np.zeros(5))
    return np.concatenate(out)


def _phases(part: Any, k: int) -> np.ndarray:
    """Relative rms currents of the phases, and V2/V1 and I2/I1 by the rotating vector."""
    turn = np.exp(2j * np.pi / 3 * np.arange(3))
    out = []
    for q in "iv":
        x = part[[f"{q}_{p}_{k}" for p in "abc"]].to_numpy(dtype=float)
        rms = np.sqrt((x**2).mean(axis=0))
        out += [*(rms / rms.mean())] if q == "i" else []
        vector = np.fft.fft(x @ turn)
        forward = int(np.argmax(np.abs(vector)))
        out.append(np.abs(vector[-forward]) / np.abs(vector[forward]))
    return np.array(out)


# ------------------------------------------------------------------------------ methods


def _chance(X: np.ndarray, y: np.ndarray, train: np.ndarray, rng: np.random.Generator) -> Rows:
    """Classes as frequent as in training, at random."""
    names, counts = np.unique(y[train], return_counts=True)
    said = rng.choice(names, size=y.size, p=counts / counts.sum())
    return [
        {"class": str(c), "score": float(v)} for c, v in zip(said, rng.random(y.size), strict=True)
    ]


def _thresholds(X: np.ndarray, y: np.ndarray, train: np.ndarray, rng: np.random.Generator) -> Rows:
    """The largest deviation from healthy training runs, then the nearest direction of a class."""
    healthy = X[train & (y == "healthy")]
    if len(healthy) < 5:
        raise DataError("thresholds need at least five healthy runs in the split train")
    centre = np.median(healthy, axis=0)
    spread = 1.4826 * np.median(np.abs(healthy - centre), axis=0) + 1e-9
    Z = (X - centre) / spread
    size = np.abs(Z).max(axis=1)
    means = {c: Z[train & (y == c)].mean(axis=0) for c in np.unique(y[train]) if c != "healthy"}
    rows = []
    for z, s in zip(Z, size, strict=True):
        near = max(means, key=lambda c: float(z @ means[c]) / float(np.linalg.norm(means[c])))
        rows.append({"class": near if s > _ALARM else "healthy", "score": float(s)})
    return rows


def _forest(X: np.ndarray, y: np.ndarray, train: np.ndarray, rng: np.random.Generator) -> Rows:
    """A random forest on the same features."""
    try:
        ensemble = import_module("sklearn.ensemble")
    except ImportError:
        raise DataError("forest needs: pip install 'apu-casadi[learn]'") from None
    seed = int(rng.integers(2**31))
    model = ensemble.RandomForestClassifier(300, random_state=seed, class_weight="balanced")
    model.fit(X[train], y[train])
    share = model.predict_proba(X)
    healthy = list(model.classes_).index("healthy") if "healthy" in model.classes_ else None
    score = 1.0 - share[:, healthy] if healthy is not None else share.max(axis=1)
    said = model.classes_[share.argmax(axis=1)]
    return [{"class": str(c), "score": float(v)} for c, v in zip(said, score, strict=True)]


LEARNT = {"chance": _chance, "thresholds": _thresholds, "forest": _forest}
"""Methods that learn from the split ``train`` of the features."""
METHODS = (*LEARNT, "estimators")


def predict(
    name: str, folder: str | Path, *, seed: int = 1, progress: Progress | None = None
) -> Rows:
    """Predict all runs of a data set by one of ``METHODS``.

    Raises:
        DataError: an unknown method, a damaged data set, or nothing to learn from.
    """
    if name not in METHODS:
        raise DataError(f"unknown baseline {name!r} {nearest(name, METHODS)}")
    labels = read_labels(folder)
    runs, n = runs_of(folder, labels), len(labels["run"])
    found: list[Any] = []
    for k, (run, gas, waves) in enumerate(runs, 1):
        found.append(features(gas, waves) if name in LEARNT else estimated(run, gas, waves))
        if progress is not None:
            progress(k / n, 1.0)
    if name in LEARNT:
        train, y = labels["split"] == "train", labels["class"]
        if not train.any():
            raise DataError(f"{folder}: no unit is in the split train")
        rows = LEARNT[name](np.array(found), y, train, np.random.default_rng([seed]))
        return [{"run": int(r), **row} for r, row in zip(labels["run"], rows, strict=True)]
    return found


def estimated(run: int, gas: Any, waves: Any) -> dict[str, Any]:
    """Return what the filters of this project say of a run, gas path and generators apart.

    A severity is told where it is four standard deviations from none, in the waveforms or, by
    what the shaft gives more than the loads take, after them.  Of the gas path the change since
    its onset counts, where the filter's test has found one: what all sensors' gain errors leave
    uncertain of a factor is in both, and cancels.  Which factor it is the largest change says,
    unless a sensor explains it better.  Scores are squares over those from which something is told,
    and one more where it is.
    """
    out: dict[str, Any] = {"run": run, "class": "healthy"}
    health, kind, alarm, lost, evidence = _of_gas_path(gas)
    machines = {k: _of_machine(waves, k) for k in (1, 2)} if waves is not None else {}
    for n, (v, s, _) in health.items():
        out |= {n: v, f"{n}_sigma": s}
    place: dict[str, Any] = {}
    h, s = 0.0, math.inf
    for k, (phase, *severity, _) in machines.items():
        if severity[0] / severity[1] > h / s:
            (h, s), place = severity, {"phase": phase, "generator": k}
    if lost is not None and h <= _ALARM * s and lost[0] / lost[1] > max(h / s, _ALARM):
        (h, s), place = lost, {}
    out |= {"h": h, "h_sigma": s} if math.isfinite(s) else {}
    wound = [k for k, m in machines.items() if m[-1] == "field winding"]
    if h > _ALARM * s:
        out |= {"class": "combined" if kind in HEALTH else "ttsc", **place}
    elif wound:
        out |= {"class": "field", "generator": wound[0]}
    elif kind:
        out |= {"class": kind}
    out |= {"alarm_time": alarm} if math.isfinite(alarm) else {}
    said = 1.0 if out["class"] != "healthy" else 0.0
    return out | {"score": max(said + evidence, (max(h, 0.0) / s / _ALARM) ** 2)}


Severity = tuple[float, float]


def _of_gas_path(
    gas: Any,
) -> tuple[dict[str, tuple[float, float, float]], str, float, Severity | None, float]:
    """Factors, their sigmas and changes since the onset; class of the change or "", its alarm.

    And the severity that a loss of the generators tells, with its sigma, None if there is none; and
    how much there is for any change, 1 at an alarm.
    """
    from estimators.apu.powerbalance import OUTPUT
    from estimators.apu.recorded_estimate import JUMPS, estimate
    from estimators.apu.recordings.measured import read_recording

    data = {"t": gas["time"].to_numpy()}
    data |= {n: gas[f"X_s.{n}"].to_numpy(dtype=float) for n in GAS_PATH.names}
    data |= {n: gas[f"W.{n}"].to_numpy(dtype=float) for n in VARIED}
    data[OUTPUT] = gas["W.P_e"].to_numpy(dtype=float)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ApuWarning)
            found = estimate(read_recording(data), only="gaspath")
    except ApuError:
        return {}, "", math.nan, None, 0.0
    assert found.path is not None and found.balance is not None
    evidence = max(JUMPS.evidence(found.path[1].result), float(found.balance.attrs["evidence"]))
    e, b, best = found.gaspath, found.balance, [d.best for d in found.diagnoses]
    assert e is not None and b is not None
    onsets = json.loads(e.attrs["onsets"])
    lost = None
    if any(n.endswith("short circuit") for n in best):
        lost = float(b["h"].values[-1]), float(b["h_sigma"].values[-1])
    alarm = min((d.t for d in found.diagnoses), default=math.nan)
    # beliefs before the alarm do not know of the change
    at = int(np.searchsorted(e["time"].values, onsets[0] - 1e-9)) if onsets else -1
    health = {
        n: (float(v[-1]), float(e[f"{n}_sigma"].values[-1]), float(v[-1] - v[at]))
        for n, v in ((n, e[n].values) for n in HEALTH)
    }
    if any(n.startswith("sensor") for n in best):
        return health, "sensor", alarm, lost, evidence
    kind = max(HEALTH, key=lambda n: abs(health[n][2])) if onsets else ""
    factors = next((d.failure for d in found.diagnoses if d.best == GAS), {})
    told = max(factors, key=lambda n: factors[n], default="")
    kind = told if told in HEALTH else kind
    return health, kind, alarm, lost, evidence


def _of_machine(waves: Any, k: int) -> tuple[str, float, float, str]:
    """Likeliest phase, its severity and sigma, and what the first change of the machine is."""
    from estimators.apu.recorded_estimate import estimate
    from estimators.apu.recordings.measured import read_recording

    ending = f"_{k}"
    data = {"t": waves["time"].to_numpy()}
    data |= {
        c.removesuffix(ending): waves[c].to_numpy(dtype=float)
        for c in waves
        if str(c).endswith(ending)
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ApuWarning)
            found = estimate(read_recording(data), only="electrical")
        e = found.machines[1]
    except (ApuError, KeyError):
        return "", 0.0, math.inf, ""
    h = {p: (float(e[f"h_{p}"].values[-1]), float(e[f"h_{p}_sigma"].values[-1])) for p in "abc"}
    phase = max(h, key=lambda p: h[p][0] / h[p][1])
    changes = found.causes.get("machine 1", ())
    return phase, *h[phase], changes[0].best if changes else ""


def predictions_text(rows: Rows) -> str:
    """Return predictions as the text of a file that the scorer reads."""
    names = list(dict.fromkeys(n for row in rows for n in row))
    assert all(row["class"] in CLASSES for row in rows)
    f = io.StringIO()
    writer = csv.DictWriter(f, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return f.getvalue()


def write_predictions(rows: Rows, path: str | Path) -> Path:
    """Write predictions as the scorer reads them."""
    return files.write_text(path, predictions_text(rows))
