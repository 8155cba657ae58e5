"""What a run was asked for, as attributes of its dataset: day, loads, stator faults, seed, version.

``ambient`` is a JSON table of the conditions, ``generators`` their number; ``loads`` and ``faults``
are JSON lists of what holds from an instant ``t`` on, for one ``generator`` or, without it, for
all, with the numbers of their beginning; ``profiles`` is a JSON list of what changes in time
beside; ``seed`` is that of the random numbers ("none": none was given).
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from apu_casadi.core.cf import origin
from apu_casadi.core.profiles.profile import Profile, Varying, at, later
from apu_casadi.core.signals import Signal
from apu_casadi.gaspath.conditions import CONDITIONS
from apu_casadi.machine.loads.load import Load
from apu_casadi.unit.events import (
    Event,
    FaultChange,
    HealthChange,
    Holding,
    LoadChange,
    SpeedChange,
)

__all__ = ["asked", "load_words"]


def load_words(load: Load | Varying[Load]) -> str:
    """Return a load in words; the power of a series load is that at 230 V and 400 Hz.

    >>> load_words(SeriesLoad.from_power(225e3))
    '225 kW'
    """
    if isinstance(load, Varying):
        return f"{load.at(0.0).label} at first; {load.label}"
    return load.label


def asked(
    *,
    start: Holding,
    events: Iterable[Event] = (),
    seed: int | None = None,
) -> dict[str, Any]:
    """Return the attributes that tell what a run was asked for.

    Args:
        start: what holds from the start of the run; ``events`` change it.
    """
    events = tuple(events)
    fed = [(0.0, load, k) for k, load in _each(start.loads)]
    fed += [(e.t, e.load, e.generator) for e in events if isinstance(e, LoadChange)]
    ill = [(0.0, fault, k) for k, fault in _each(start.faults)]
    ill += [(e.t, e.fault, e.generator) for e in events if isinstance(e, FaultChange)]
    return {
        "ambient": json.dumps(dataclasses.asdict(at(start.ambient, 0.0))),
        "generators": len(start.loads),
        "loads": json.dumps(
            [{**_at(t, k), "load": load_words(x), **_fields(x)} for t, x, k in fed]
        ),
        "faults": json.dumps([{**_at(t, k), **_fields(f)} for t, f, k in ill]),
        "profiles": json.dumps([g.told() for g in given_profiles(start, events)]),
        "seed": "none" if seed is None else seed,
        **origin("simulated"),
    }


def _each(parts: Sequence[Any]) -> list[tuple[int | None, Any]]:
    """Return number and part of each generator; None and the part that all have."""
    alike = all(p == parts[0] for p in parts)
    return [(None, parts[0])] if alike else [*enumerate(parts, 1)]


def _at(t: float, generator: int | None) -> dict[str, Any]:
    return {"t": t} if generator is None else {"t": t, "generator": generator}


def _fields(part: Any) -> dict[str, Any]:
    """Return the fields of a load or fault, both dataclasses; "phase" alone without a fault."""
    if isinstance(part, Varying):
        part = part.example()
    return {"phase": None} if part is None else dataclasses.asdict(part)


# ------------------------------------------------------------------------------ profiles


class Given(NamedTuple):
    """A profile of a run.

    Args:
        part, name: what it is of (``"load"``, ``"fault"``, ``"health"``, ``"ambient"`` or
            ``"speed"``), and its name there.
        profile: in the time of the run.
        begin: instant, s, from which it holds.
        generator: whose load or fault it is of; None: of all, or of the unit.
    """

    part: str
    name: str
    profile: Profile
    begin: float
    generator: int | None = None

    def told(self) -> dict[str, Any]:
        """Return it in words, as a JSON table."""
        words = {"part": self.part, "name": self.name, "profile": self.profile.label}
        return {**_at(self.begin, self.generator), **words}


def given_profiles(start: Holding, events: Iterable[Event]) -> list[Given]:
    """Return all profiles of a run, in the order in which they begin."""
    found = [Given("ambient", n, p, 0.0) for n, p in _profiles(start.ambient).items()]
    health = [(0.0, start.factors)] + [(e.t, e.factors) for e in events if type(e) is HealthChange]
    for t, factors in health:
        moved = ((n, later(v, t)) for n, v in factors.items())
        found += [Given("health", n, v, t) for n, v in moved if isinstance(v, Profile)]
    speeds = [(0.0, start.N_ref)] + [(e.t, e.N_ref) for e in events if type(e) is SpeedChange]
    for t, v in speeds:
        if isinstance(v, Profile):
            found.append(Given("speed", "N_ref", later(v, t), t))
    parts = [("load", 0.0, x, k) for k, x in _each(start.loads)]
    parts += [("fault", 0.0, x, k) for k, x in _each(start.faults)]
    parts += [("load", e.t, e.load, e.generator) for e in events if type(e) is LoadChange]
    parts += [("fault", e.t, e.fault, e.generator) for e in events if type(e) is FaultChange]
    for part, t, x, k in parts:
        found += [Given(part, n, p, t, k) for n, p in _profiles(later(x, t)).items()]
    return sorted(found, key=lambda g: g.begin)


def _profiles(part: Any) -> dict[str, Profile]:
    return part.profiles if isinstance(part, Varying) else {}


def followed(
    start: Holding, events: Sequence[Event], grid: np.ndarray
) -> tuple[dict[str, np.ndarray], list[Signal]]:
    """Return day, governed speed and loads as they were held, where they follow profiles.

    Health and severities a run keeps anyway.  Values at the start, then those of the step that ends
    at each instant; NaN where the number is no profile's.

    Args:
        grid: exchange instants, s, shape (K,).
    """
    middles = np.append(grid[0], (grid[1:] + grid[:-1]) / 2)
    values, signals = dict[str, np.ndarray](), dict[str, Signal]()
    for g in given_profiles(start, events):
        if g.part in ("health", "fault"):
            continue
        name = g.name if g.part != "load" else f"load_{g.name}"
        if g.generator is not None:
            name = f"{name}_{g.generator}"
        if g.part == "ambient":
            unit, doc = CONDITIONS[g.name].unit, CONDITIONS[g.name].doc
        else:
            unit = {"speed": "rad/s"}.get(g.part, g.name.rpartition("_")[2])
            doc = {"speed": "governed rotor speed"}.get(g.part, f"{g.name} of the load")
        row = values.setdefault(name, np.full(grid.size, np.nan))
        same = (e.t for e in events if _replaces(e, g) and e.t > g.begin)
        end = min(same, default=np.inf)
        inside = (middles >= g.begin) & (middles < end)
        row[inside] = g.profile(middles[inside])
        signals[name] = Signal(name, unit, f"{doc}, as held over the step")
    return values, [*signals.values()]


def _replaces(e: Event, g: Given) -> bool:
    if isinstance(e, LoadChange):
        return g.part == "load" and (e.generator is None or g.generator in (None, e.generator))
    return isinstance(e, SpeedChange) and g.part == "speed"
