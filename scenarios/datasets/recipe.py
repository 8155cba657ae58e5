"""What a data set is made of: a recipe, read from TOML and checked, and what it draws for a run.

Run i of unit u depends on the recipe's seed, u and i alone: a longer data set begins with the same
runs, and any run can be made again by itself.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.core.errors import ScenarioError, nearest
from apu_casadi.core.sharing import once
from apu_casadi.core.tomlnumbers import read_toml
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.exchange import EXCHANGES
from estimators.apu.sensors import GAS_PATH

CLASSES = ("healthy", *HEALTH, "ttsc", "field", "sensor", "combined")
SPLITS = ("train", "validation", "test", "range")
SENSOR_FAULTS = ("bias", "drift", "stuck")
_RANGES = ("altitude", "Mach", "dT_isa", "power_kW", "power_factor")
_TABLES = {
    "classes": CLASSES,
    "size": ("health", "h", "field", "sensor"),
    "range": _RANGES,
    "outside": (*_RANGES, "load"),
    "split": SPLITS,
    "waveforms": ("rate", "before", "after"),
}
_GROW_LEAST = 0.5  # s over which a fault grows at least
FIRST_H = 1e-5  # severity from which a short circuit grows


@dataclass(frozen=True)
class Recipe:
    """A recipe; the reference one, ``scenarios/datasets/data/reference.toml``, tells each key.

    Raises:
        ScenarioError: an unknown key, class or parameter, or a number out of range.
    """

    name: str
    title: str
    seed: int
    units: int
    runs_per_unit: int
    duration: float
    onset: tuple[float, float]
    growing: float
    classes: Mapping[str, float]
    size: Mapping[str, tuple[float, float]]
    spread: Mapping[str, float]
    range: Mapping[str, tuple[float, float]]
    outside: Mapping[str, Any]
    split: Mapping[str, float]
    waveforms: Mapping[str, float]
    exchange: str = "predicted"

    def __post_init__(self) -> None:
        for table, known in _TABLES.items():
            for key in getattr(self, table):
                if key not in known:
                    raise ScenarioError(f"recipe: [{table}] {key!r} {nearest(key, known)}")
        _known(self.spread, _default(), "spread")
        for key in ("units", "runs_per_unit"):
            _whole(key, getattr(self, key), 1)
        _whole("seed", self.seed, 0)
        if not 0 < self.duration <= 3600:
            raise ScenarioError(f"recipe: duration = {self.duration:g} s is outside (0, 3600]")
        lo, hi = self.onset
        if not 0 < lo <= hi < self.duration:
            raise ScenarioError(f"recipe: onset = [{lo:g}, {hi:g}] s is not inside the run")
        if self.exchange not in EXCHANGES:
            said = f"{self.exchange!r} {nearest(str(self.exchange), EXCHANGES)}"
            raise ScenarioError(f"recipe: exchange = {said}")
        if not 0 <= self.growing <= 1:
            raise ScenarioError(f"recipe: growing = {self.growing:g} is outside [0, 1]")
        for table in ("size", "range"):
            for key in _TABLES[table]:
                _ends(f"[{table}] {key}", getattr(self, table).get(key), positive=table == "size")
        for table in ("classes", "split"):
            shares = list(getattr(self, table).values())
            if not shares or min(shares) < 0 or not sum(shares) > 0:
                raise ScenarioError(f"recipe: [{table}] needs shares >= 0, some of them > 0")

    @classmethod
    def of(cls, table: Mapping[str, Any], where: str = "recipe") -> Recipe:
        """Make a recipe of a table as a TOML file has it."""
        names = [f.name for f in fields(cls)]
        for key in table:
            if key not in names:
                raise ScenarioError(f"{where}: unknown key {key!r} {nearest(key, names)}")
        if missing := [n for n in names if n not in (*table, "exchange")]:
            raise ScenarioError(f"{where}: {', '.join(missing)} must be given")
        wrong = [n for n in (*_TABLES, "spread") if not isinstance(table[n], Mapping)]
        if wrong:
            raise ScenarioError(f"{where}: {wrong[0]} must be a table")
        try:
            return cls(**table)
        except (TypeError, ValueError) as e:
            raise ScenarioError(f"{where}: {e}") from None

    @property
    def order(self) -> tuple[str, ...]:
        """Classes by weight, each as often as it is in every stretch of so many runs."""
        least = min(w for w in self.classes.values() if w > 0)
        return tuple(c for c in CLASSES for _ in range(round(self.classes.get(c, 0) / least)))

    def split_of(self, unit: int) -> str:
        """Return the split that a unit belongs to; shares are met by every stretch of units."""
        total, place = sum(self.split.values()), (unit * 0.6180339887498949 + 0.5) % 1.0
        for name in SPLITS:
            place -= self.split.get(name, 0.0) / total
            if place < 0:
                return name
        return next(n for n in reversed(SPLITS) if self.split.get(n, 0.0) > 0)


@once
def _default() -> Mapping[str, Any]:
    return Apu().parameters()


def _known(table: Mapping[str, float], known: Any, what: str) -> None:
    names = list(known)
    for key, value in table.items():
        if key not in names:
            raise ScenarioError(f"recipe: [{what}] {key!r} {nearest(key, names)}")
        if not 0 <= value < 0.3:
            raise ScenarioError(f"recipe: [{what}] {key} = {value:g} is outside [0, 0.3)")


def _whole(key: str, value: Any, least: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ScenarioError(f"recipe: {key} = {value!r} must be a whole number >= {least}")


def _ends(key: str, value: Any, *, positive: bool) -> None:
    try:
        lo, hi = (float(v) for v in value)
    except (TypeError, ValueError):
        raise ScenarioError(f"recipe: {key} must be [lowest, highest], got {value!r}") from None
    if not (math.isfinite(lo) and lo <= hi < math.inf and (lo > 0 or not positive)):
        raise ScenarioError(f"recipe: {key} = [{lo:g}, {hi:g}] is no range")


def read_recipe(path: str | Path | None = None) -> Recipe:
    """Read a recipe; without a file, the reference one.

    Raises:
        ScenarioError: as of :class:`Recipe`.
        DataError: the file cannot be read, or is no TOML.
    """
    if path is None:
        return Recipe.of(tomllib.loads(reference()), "reference recipe")
    return Recipe.of(read_toml(path, ""), str(path))


def reference() -> str:
    """Return the text of the reference recipe."""
    return (resources.files("scenarios.datasets") / "data/reference.toml").read_text("utf-8")


@dataclass(frozen=True)
class Drawn:
    """One run of a data set: its scenario, as a table of a scenario file, and its labels.

    Args:
        scenario: as :class:`scenarios.schema.Scenario` reads it.
        labels: class, onset, what is faulty and how much.
        seed: of what sensors add.
        sensor: (name, kind, relative size) of a faulty sensor, else None.
    """

    scenario: dict[str, Any]
    labels: dict[str, Any]
    seed: int
    sensor: tuple[str, str, float] | None


def draw(r: Recipe, unit: int, run: int) -> Drawn:
    """Draw run ``run`` of unit ``unit``."""
    number = unit * r.runs_per_unit + run
    rng = np.random.default_rng([r.seed, unit, run])
    block, place = divmod(number, len(r.order))
    shuffled = np.random.default_rng([r.seed, 1 << 20, block]).permutation(len(r.order))
    kind, split = r.order[shuffled[place]], r.split_of(unit)
    around = {**r.range, **({k: v for k, v in r.outside.items() if k in _RANGES}
                            if split == "range" else {})}  # fmt: skip
    at = {k: _digits(rng.uniform(*around[k])) for k in _RANGES}
    power_factor = at.pop("power_factor")
    load: dict[str, Any] = {"kind": "RL", "power_kW": at.pop("power_kW")}
    load["kind"] = r.outside.get("load", "RL") if split == "range" else "RL"
    load["power_factor"] = min(power_factor, 0.999)
    onset = _digits(rng.uniform(*r.onset))
    over = _digits(rng.uniform(_GROW_LEAST, max(_GROW_LEAST, r.duration - onset)))
    grows = kind != "healthy" and bool(rng.random() < r.growing)
    later, labels, sensor = _fault(r, kind, rng, over if grows else None)
    units = np.random.default_rng([r.seed, 1 << 21, unit])
    base = _default()
    factors = {n: 1 + s * units.standard_normal() for n, s in r.spread.items()}
    own = {n: _digits(float(base[n]) * f) for n, f in factors.items()}
    phases: list[dict[str, Any]] = [{"name": "healthy", "start": 0.0, "load": load}]
    if later:
        phases.append({"name": kind, "start": onset, **later})
    scenario = {
        "name": f"{r.name}_{unit:05d}_{run:03d}",
        "duration": r.duration,
        "waveform_dt": 1.0 / r.waveforms["rate"] if r.waveforms.get("rate") else 0,
        "exchange": r.exchange,
        "ambient": at,
        "parameters": own,
        "phase": phases,
    }
    labels = {
        "run": number,
        "unit": unit,
        "split": split,
        "class": kind,
        "onset": onset if kind != "healthy" else math.nan,
        "over": over if grows else 0.0,
        **labels,
    }
    return Drawn(scenario, labels, number + 1, sensor)


_NONE = {"phase": "", "generator": 0, "h": 0.0, "mu": 0.0, "kappa": math.nan, "mu_f": 0.0}
_NONE |= {"sensor": "", "sensor_kind": "", "sensor_size": 0.0, **dict.fromkeys(HEALTH, 1.0)}


def _fault(
    r: Recipe, kind: str, rng: np.random.Generator, over: float | None
) -> tuple[dict[str, Any], dict[str, Any], tuple[str, str, float] | None]:
    """Return what a phase of the scenario gets, the labels, and the faulty sensor."""
    labels: dict[str, Any] = dict(_NONE)
    later: dict[str, Any] = {}
    sensor = None
    wanted = {kind}
    if kind == "combined":
        wanted = {"ttsc", str(rng.choice(HEALTH))}
    for name in HEALTH:
        if name in wanted:
            to = _digits(1.0 - _log(rng, r.size["health"]))
            labels[name] = to
            later["health"] = {name: to if over is None else {"from": 1.0, "to": to, "over": over}}
    if "ttsc" in wanted:
        h, mu = _log(rng, r.size["h"]), _digits(rng.uniform(0.02, 0.1))
        phase, generator = "abc"[int(rng.integers(3))], int(rng.integers(1, 3))
        labels |= {"h": h, "mu": mu, "kappa": mu, "phase": phase, "generator": generator}
        grown = {"kind": "exponential", "from": min(FIRST_H, h / 2), "to": h, "over": over}
        severity = h if over is None else grown
        later["fault"] = {"generator": generator, "mu": mu, "h": severity, "phase": phase}
    if kind == "field":
        mu_f, generator = _log(rng, r.size["field"]), int(rng.integers(1, 3))
        labels |= {"mu_f": mu_f, "generator": generator}
        severity = mu_f if over is None else {"from": 1e-3, "to": mu_f, "over": over}
        later["fault"] = {"kind": "field", "generator": generator, "mu_f": severity}
    if kind == "sensor":
        names = [n for n in GAS_PATH.names if n != "PW"]
        sign = 1 if rng.random() < 0.5 else -1
        size = sign * _log(rng, r.size["sensor"])
        sensor = str(rng.choice(names)), str(rng.choice(SENSOR_FAULTS)), size
        labels |= dict(zip(("sensor", "sensor_kind", "sensor_size"), sensor, strict=True))
    return later, labels, sensor


def _log(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    return _digits(math.exp(rng.uniform(*np.log(ends))))


def _digits(x: float) -> float:
    """Five significant digits: what is written is what ran."""
    return float(f"{x:.5g}")
