"""What a run was asked for, as attributes of its dataset: day, loads, stator faults, seed, version.

``ambient`` is a JSON table of the conditions, ``generators`` their number; ``loads`` and ``faults``
are JSON lists of what holds from an instant ``t`` on, for one ``generator`` or, without it, for
all; ``seed`` is that of the random numbers ("none": none was given).
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Sequence
from typing import Any

from apu_casadi.core.version import installed
from apu_casadi.machine.faults.fault import Fault
from apu_casadi.machine.loads.load import Load
from apu_casadi.unit.events import Ambient, Event, FaultChange, LoadChange

__all__ = ["asked", "load_words"]


def load_words(load: Load) -> str:
    """Return a load in words; the power of a series load is that at 230 V and 400 Hz.

    >>> load_words(SeriesLoad.from_power(225e3))
    '225 kW'
    """
    return load.label


def asked(
    *,
    loads: Sequence[Load],
    faults: Sequence[Fault | None],
    ambient: Ambient,
    events: Iterable[Event] = (),
    seed: int | None = None,
) -> dict[str, Any]:
    """Return the attributes that tell what a run was asked for.

    Args:
        loads, faults: of each generator from the start of the run; ``events`` change them.
    """
    events = tuple(events)
    fed = [(0.0, load, k) for k, load in _each(loads)]
    fed += [(e.t, e.load, e.generator) for e in events if isinstance(e, LoadChange)]
    ill = [(0.0, fault, k) for k, fault in _each(faults)]
    ill += [(e.t, e.fault, e.generator) for e in events if isinstance(e, FaultChange)]
    return {
        "ambient": json.dumps(dataclasses.asdict(ambient)),
        "generators": len(loads),
        "loads": json.dumps(
            [{**_at(t, k), "load": load_words(x), **_fields(x)} for t, x, k in fed]
        ),
        "faults": json.dumps([{**_at(t, k), **_fields(f)} for t, f, k in ill]),
        "seed": "none" if seed is None else seed,
        "apu_casadi_version": installed(),
    }


def _each(parts: Sequence[Any]) -> list[tuple[int | None, Any]]:
    """Return number and part of each generator; None and the part that all have."""
    alike = all(p == parts[0] for p in parts)
    return [(None, parts[0])] if alike else [*enumerate(parts, 1)]


def _at(t: float, generator: int | None) -> dict[str, Any]:
    return {"t": t} if generator is None else {"t": t, "generator": generator}


def _fields(part: Any) -> dict[str, Any]:
    """Return the fields of a load or fault, both dataclasses; "phase" alone without a fault."""
    return {"phase": None} if part is None else dataclasses.asdict(part)
