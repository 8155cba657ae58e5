"""What a run was asked for, as attributes of its dataset: day, loads, stator faults, seed, version.

``ambient`` is a JSON table of the conditions, ``loads`` and ``faults`` are JSON lists of what holds
from an instant ``t`` on, ``seed`` is that of the random numbers ("none": none was given).
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable
from typing import Any

from apu_casadi.core.version import installed
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.load import ConstantPowerLoad, Load, OpenLoad
from apu_casadi.unit.events import Ambient, Event, FaultChange, LoadChange

__all__ = ["asked", "load_words"]

_V, _W = 230.0, 2 * math.pi * 400.0  # V rms and rad/s at which the power of a load is told


def load_words(load: Load) -> str:
    """Return a load in words; the power of a series load is that at 230 V and 400 Hz.

    >>> load_words(SeriesLoad.from_power(225e3))
    '225 kW'
    """
    if isinstance(load, OpenLoad):
        return "open"
    if isinstance(load, ConstantPowerLoad):
        return f"{load.P / 1e3:g} kW, constant power"
    Z = [complex(R, _W * L) for R, L in zip(load.R, load.L, strict=True)]
    S = [_V**2 / z.conjugate() for z in Z]
    P, pf = sum(s.real for s in S), sum(s.real for s in S) / abs(sum(S))
    words = f"{P / 1e3:.5g} kW" + ("" if pf > 1 - 1e-9 else f", power factor {pf:.3g}")
    if load.balanced:
        return words
    return f"{words}, unbalanced ({', '.join(f'{s.real / 1e3:.4g}' for s in S)} kW)"


def asked(
    *,
    load: Load,
    fault: Ttsc | None,
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
    faults: list[tuple[float, Ttsc | None]] = [(0.0, fault)]
    faults += [(e.t, e.fault) for e in events if isinstance(e, FaultChange)]
    return {
        "ambient": json.dumps(dataclasses.asdict(ambient)),
        "loads": json.dumps(
            [{"t": t, "load": load_words(x), **dataclasses.asdict(x)} for t, x in loads]
        ),
        "faults": json.dumps(
            [{"t": t, **({"phase": None} if f is None else dataclasses.asdict(f))}
             for t, f in faults]
        ),
        "seed": "none" if seed is None else seed,
        "apu_casadi_version": installed(),
    }  # fmt: skip
