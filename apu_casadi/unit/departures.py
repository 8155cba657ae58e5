"""Where a run left the range in which the model holds: each as data, with its words and remedy.

A departure says what was beyond which limit, from when to when, and of which generators.  Its kinds
are the keys of :data:`REMEDIES`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import ApuWarning
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import Limits
from apu_casadi.unit.runsummary import phases

if TYPE_CHECKING:
    from apu_casadi.unit.stepmeans import Excess

_WORDS = {
    **dict.fromkeys(("T4", "T5"), "hot"),
    **{"SM": "beyond surge", "Mach8": "exhaust exit choked", "Wf": "no flame"},
    **{"off_c": "off the compressor map", "off_t": "off the turbine map"},
}
_LESS = "less load, another day or better health keep it inside"
REMEDIES = {
    "temperature": f"{_LESS}; T4_max and T5_max under [limits] of the engine's file are the limits",
    "surge": f"{_LESS}; SM_min under [limits] of the engine's file is the limit",
    "off_map": f"{_LESS}; off_map under [limits] of the engine's file is the limit, in table spans",
    "choked": "less flow keeps the exit subsonic; the fixed exit is modelled so",
    "fuel": "more load keeps the flame; Wf_min under [limits] of the engine's file is the limit",
    "efficiency": "a health factor that high makes a component better than a reversible one",
    "fuel_limit": "less load, or a higher Wf_max of the governor",
    "unserved": "less load for this generator; its voltage has collapsed",
    "torque": 'power = "torque" of the generator loads the shaft with all that the torque takes',
    "spike": "switch to a load that takes the current, or switch the power down by a profile",
    "exchange": "exchange = 'predicted' or 'corrected', or a shorter step dt",
}
"""What to do, by the kind of a departure."""
ON = "without strict the run goes on, with a warning"


@dataclass(frozen=True)
class Departure:
    """One quantity that was beyond its limit during a run.

    Args:
        quantity, unit: output of the gas generator, or another one, by its kind.
        limit, worst: of the trim, and the value farthest beyond it.
        first, at: instants, s, of the first value beyond and of the worst one.
        duration: sum of the exchange steps, s, that ended beyond.
        kind: one of :data:`REMEDIES`.
        generators: which they are; None: the unit, or all alike.
        said: words, where they are not those of the numbers.
    """

    quantity: str
    unit: str
    limit: float
    worst: float
    first: float
    at: float
    duration: float
    kind: str = ""
    generators: tuple[int, ...] | None = None
    said: str = ""

    def text(self) -> str:
        """Return it in words."""
        if self.said:
            return self.said
        when = f" at t = {self.at:.6g} s"
        return (
            f"{beyond_words(self.quantity, self.worst, self.unit, self.limit, when)}, first beyond "
            f"it at t = {self.first:.6g} s, for {self.duration:.4g} s in all"
        )

    def row(self) -> dict[str, Any]:
        """Return it as a table for JSON."""
        own = {k: v for k, v in asdict(self).items() if k != "said"}
        own |= {k: None for k in ("first", "at", "duration") if math.isnan(own[k])}
        return own | {"remedy": REMEDIES.get(self.kind, "")}

    def warning(self, category: type[ApuWarning] = ApuWarning) -> ApuWarning:
        """Return the warning that tells it, with itself as its data."""
        made = category(self.text())
        made.data = self
        return made


def excess_of(e: Excess, numbers: tuple[int, ...] | None) -> Departure:
    """Return the step of some generators in which the torque takes more than eq. (8) gives."""
    return Departure("P_torque", "W", e.limit, e.P, e.t, e.t, 0.0, "torque", numbers, e.words)


def stopped(words: str, kind: str) -> str:
    """Return the words for a strict run that stops, with what to do."""
    return f"{words}; {REMEDIES[kind]}; {ON}" if kind in REMEDIES else f"{words}; {ON}"


def beyond_words(quantity: str, value: float, unit: str, limit: float, when: str = "") -> str:
    """Return in words that a quantity is beyond its limit."""
    spans = {"1": "", "off_c": " table spans", "off_t": " table spans"}
    unit = spans.get(quantity if quantity.startswith("off_") else unit, f" {unit}")
    words = _WORDS.get(quantity, "beyond a limit")
    return f"{words}: {quantity} = {value:.5g}{unit}{when} (limit {limit:.5g})"


def departures(
    gg: GasGenerator,
    t: np.ndarray,
    outputs: Mapping[str, np.ndarray],
    limits: Limits | None = None,
) -> list[Departure]:
    """Return what left the limits of a trim during a run, each quantity once.

    Args:
        t: exchange instants, s, shape (K,).
        outputs: outputs of the gas generator by name, shape (K,), each at the end of its step.
        limits: those of the trim by default.
    """
    steps = np.diff(t, prepend=t[0])
    found = []
    for status, name, sign, limit in (limits or Limits()).rows(gg):
        if name not in outputs or math.isinf(limit):
            continue
        values = np.asarray(outputs[name])  # of a long run they lie in a file
        beyond = sign * (values - limit)
        out = beyond > 0
        if not out.any():
            continue
        k, first = int(np.argmax(beyond)), int(np.argmax(out))
        instants = float(t[first]), float(t[k]), float(steps[out].sum())
        kind, unit = status.name.lower(), gg.Y[name].unit
        found.append(Departure(name, unit, float(limit), float(values[k]), *instants, kind))
    return found


def rows_of(ds: Any) -> list[dict[str, Any]]:
    """Return the departures of a run, as its attribute has them; [] where it has none."""
    try:
        rows = json.loads(ds.attrs.get("validity", "[]"))
    except (TypeError, ValueError):
        return []
    return [r for r in rows if isinstance(r, dict)] if isinstance(rows, list) else []


def by_phase(ds: Any) -> list[list[dict[str, Any]]]:
    """Return for each phase of a run what was beyond its limit in it: a table for each quantity.

    A table has kind, quantity, limit, worst and its instant ``at``, ``first`` instant and duration,
    s, and the numbers of the generators; None: the unit, or all of them.
    """
    t = ds["time"].values
    steps = np.diff(t, prepend=t[0])
    found = []
    for k, p in enumerate(phases(ds)):
        inside = ((t > p["start"] + 1e-9) | (k == 0)) & (t <= p["end"] + 1e-9)
        each = (_within(ds, d, p, inside, steps) for d in rows_of(ds))
        found.append([row for row in each if row is not None])
    return found


_NAMES = ("kind", "quantity", "unit", "limit", "generators")
_BY_SPAN = ("fuel_limit", "unserved", "torque", "spike", "exchange")
"""Kinds that are told by their instants alone; an exchange error is of the whole run."""


def _within(
    ds: Any, d: Mapping[str, Any], p: Mapping[str, Any], inside: np.ndarray, steps: np.ndarray
) -> dict[str, Any] | None:
    """Return a departure as it was in a phase; None where it was not."""
    kind, t = d.get("kind", ""), ds["time"].values
    own = {n: d.get(n) for n in _NAMES}
    if kind in _BY_SPAN:
        first, last = d["first"], d["at"]
        if kind == "spike":  # it belongs to what begins there
            there = p["start"] - 1e-9 <= last < p["end"] - 1e-9
        else:
            there = last is not None and last > p["start"] + 1e-9 and first <= p["end"] + 1e-9
        if not there:
            return None
        lasted = min(last, p["end"]) - max(last - d["duration"], p["start"])
        at = {n: d[n] for n in ("worst", "at")}
        return own | at | {"first": max(first, p["start"]), "duration": max(lasted, 0.0)}
    sign = 1.0 if d["worst"] > d["limit"] else -1.0
    values = ds[d["quantity"]].values
    out = np.flatnonzero(inside & (sign * (values - d["limit"]) > 0))
    if not out.size:
        return None
    worst = out[int(np.argmax(sign * values[out]))]
    return own | {
        "worst": float(values[worst]), "at": float(t[worst]),
        "first": float(t[out[0]]), "duration": float(steps[out].sum()),
    }  # fmt: skip


def name_phases(ds: Any) -> None:
    """Enter into the departures of a run the names of the phases in which they were."""
    rows, each = rows_of(ds), list(zip(phases(ds), by_phase(ds), strict=True))
    for d in rows:
        same = {n: d.get(n) for n in ("kind", "quantity", "generators", "limit")}
        d["phases"] = [
            p["name"] for p, own in each if any(same == {n: r[n] for n in same} for r in own)
        ]
    ds.attrs["validity"] = json.dumps(rows, ensure_ascii=False)


def of_generators(numbers: Sequence[int] | None) -> str:
    """Return the generators of a departure in words, after a blank; "" for the unit or all."""
    if not numbers:
        return ""
    return f" of generator{'s' if len(numbers) > 1 else ''} {' and '.join(map(str, numbers))}"
