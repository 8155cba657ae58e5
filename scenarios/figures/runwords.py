"""What a run was made with, in words for the caption of a figure; read from its attributes.

:mod:`apu_casadi.unit.runrecord` writes them.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xr


def _rows(ds: xr.Dataset, name: str) -> list[dict[str, Any]]:
    """Return an attribute that is a JSON list of tables; [] where it is absent."""
    try:
        found = json.loads(ds.attrs[name])
    except (KeyError, TypeError, ValueError):
        return []
    return [r for r in found if isinstance(r, dict)] if isinstance(found, list) else []


def fault_phase(ds: xr.Dataset, t: float) -> str:
    """Tell the phase of the stator fault that holds at ``t`` [s]; "" where it is not recorded."""
    held = [r.get("phase") for r in _rows(ds, "faults") if float(r.get("t", 0.0)) < t - 1e-9]
    return f" of phase {held[-1]}" if held and held[-1] else ""


def made_with(ds: xr.Dataset) -> str:
    """Tell loads, ambient conditions, solver, exchange, seed and version of a run, if recorded."""
    words = []
    loads = list(dict.fromkeys(str(r.get("load")) for r in _rows(ds, "loads")))
    if len(loads) > 3:
        loads[2:] = [f"{len(loads) - 2} more"]
    if loads:
        words.append(f"Load of each generator {', then '.join(loads)}")
    try:
        day, solver = json.loads(ds.attrs["ambient"]), json.loads(ds.attrs["solver"])
        words.append(
            f"{day['altitude']:g} m, Mach {day['Mach']:g}, ISA {day['dT_isa']:+g} K, "
            f"war {day['war']:g}"
        )
        words.append(f"{solver['solver']}, exchange {solver['exchange']}, seed {ds.attrs['seed']}")
        words.append(f"apu-casadi {ds.attrs['apu_casadi_version']}")
    except (KeyError, TypeError, ValueError):
        pass
    return "; ".join(words) + "." if words else ""
