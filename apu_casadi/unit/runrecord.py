"""What a run was asked for, as attributes of its dataset: day, loads, stator faults, seed, version.

``ambient`` is a JSON table of the conditions, ``loads`` and ``faults`` are JSON lists of what holds
from an instant ``t`` on, ``seed`` is that of the random numbers ("none": none was given).
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
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
    load: Load,
    fault: Fault | None,
    ambient: Ambient,
    events: Iterable[Event] = (),
    seed: int | None = None,
) -> dict[str, Any]:
    """Return the attributes that tell what a run was asked for.

    Args:
        load, fault: from the start of the run; ``events`` change them.
    """
    events = tuple(events)
    loads: list[tuple[float, Load]] = [(0.0, load)]
    loads += [(e.t, e.load) for e in events if isinstance(e, LoadChange)]
    faults: list[tuple[float, Fault | None]] = [(0.0, fault)]
    faults += [(e.t, e.fault) for e in events if isinstance(e, FaultChange)]
    return {
        "ambient": json.dumps(dataclasses.asdict(ambient)),
        "loads": json.dumps([{"t": t, "load": load_words(x), **_fields(x)} for t, x in loads]),
        "faults": json.dumps([{"t": t, **_fields(f)} for t, f in faults]),
        "seed": "none" if seed is None else seed,
        "apu_casadi_version": installed(),
    }


def _fields(part: Any) -> dict[str, Any]:
    """Return the fields of a load or fault, both dataclasses; "phase" alone without a fault."""
    return {"phase": None} if part is None else dataclasses.asdict(part)
