"""Which phases of a run its figures enlarge: those in which a fault or wear begins come first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.gaspath.health import HEALTH
from scenarios.figures.runwords import SEVERITY

if TYPE_CHECKING:
    import xarray as xr

Rows = Sequence[Mapping[str, Any]]


def within(t: np.ndarray, p: Mapping[str, Any]) -> np.ndarray:
    """Return which samples belong to a phase: those at its end do, those at its start do not."""
    return np.asarray((t > p["start"] + 1e-9) & (t <= p["end"] + 1e-9))


def worn(ds: xr.Dataset, rows: Rows) -> list[int]:
    """Return the later phases, by number from 0, in which health or a fault's severity changes."""
    t = ds["time"].values
    held = [np.atleast_2d(ds[n].values) for n in (*HEALTH, *SEVERITY) if n in ds]
    found = []
    for k, p in enumerate(rows[1:], 1):
        inside = within(t, p)
        before = int(np.searchsorted(t, p["start"] + 1e-9)) - 1
        if any(not _equal(v[:, inside], v[:, [before]]) for v in held):
            found.append(k)
    return found


def _equal(values: np.ndarray, before: np.ndarray) -> bool:
    same = (values == before) | (np.isnan(values) & np.isnan(before))
    return bool(same.all())


def quietest(ds: xr.Dataset, rows: Rows, y: np.ndarray) -> int | None:
    """Return the phase whose beginning moves ``y`` least, but visibly: it wants an enlargement.

    Of those in which a fault or wear begins or changes, if there are such.
    """
    t, whole = ds["time"].values, float(np.ptp(y))
    visible = max(1e-3 * whole, 1e-5 * float(np.abs(y).max()))
    moves = {}
    for k, p in enumerate(rows[1:], 1):
        inside = y[(t >= p["start"] - 0.1) & (t <= min(p["end"], p["start"] + 2.5))]
        moves[k] = float(np.ptp(inside)) if inside.size else 0.0
    seen = [k for k, m in moves.items() if m > visible]
    return min(
        [k for k in worn(ds, rows) if k in seen] or seen, key=moves.__getitem__, default=None
    )


def largest(ds: xr.Dataset, rows: Rows, names: Sequence[str], most: int) -> list[int]:
    """Return so many later phases, in order of time, whose change shows best in some quantities.

    Those in which a fault or wear begins or changes go before all others.
    """
    t, ill = ds["time"].values, set(worn(ds, rows))
    scale = max(float(np.nanmax(np.abs(ds[n].values))) for n in names) or 1.0
    moves = {}
    for k, p in enumerate(rows[1:], 1):
        inside = within(t, p)
        before = int(np.searchsorted(t, p["start"] + 1e-9)) - 1
        each = (ds[n].values for n in names)
        moved = max(float(np.abs(v[inside] - v[before]).max(initial=0.0)) for v in each)
        moves[k] = (k in ill) + moved / (2 * scale)
    return sorted(sorted(moves, key=moves.__getitem__, reverse=True)[:most])
