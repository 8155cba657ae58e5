"""The shaft power that the electrical sides of all machines make together, eq. (1).

Each machine contributes its own mean power of each window with its own variance, by its own gear
and number of pairs.  Where all machines are alike, some of them may stand for the others.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import who
from estimators.apu.electrical.electricalside import SETTLED, Beliefs, ElectricalSide, View

__all__ = ["Course", "fusable", "on_common_windows", "shaft_courses"]

Course = tuple[int, np.ndarray, np.ndarray, np.ndarray]


def shaft_courses(apu: Apu, sides: Sequence[ElectricalSide]) -> list[Course]:
    """Return the shaft power as the gas path is told: mean, noise, coherent error, W.

    Args:
        apu: the unit.
        sides: of all machines in their order; or of some, which stand for all where these are
            alike; on the same instants.

    Returns:
        For each window from which on more is known: that window, and mean, standard deviation of
        what is new in each window and of what is the same in all, (K - 1,).

    Raises:
        DataError: machines that differ, and not one side for each.
    """
    n = len(sides)
    if apu.alike:
        each = [apu.PW(1.0) / n] * n
    elif n == len(apu.machines):
        each = [apu.link_of((k,)).PW(1.0) for k in range(1, n + 1)]
    else:
        raise DataError(f"the generators differ: powers of {n} of {len(apu.machines)} are no sum")
    out = []
    for first in sorted({v.start for s in sides for v in s.views}):
        views = [[v for v in s.views if v.start <= first][-1] for s in sides]
        common = [_common(v.loss) for v in views]
        mean, new, same = (np.zeros_like(views[0].P) for _ in range(3))
        for k, v, c in zip(each, views, common, strict=True):
            mean += k * v.P
            new += k**2 * (v.noise + np.maximum(v.loss - c, 0.0))
            same += k**2 * c
        out.append((first, mean, np.sqrt(new), np.sqrt(same)))
    return out


def _common(loss: np.ndarray) -> np.ndarray:
    """What of the variance is the same error in all windows: what it is once it has settled."""
    k = min(SETTLED, loss.size - 1)
    later: np.ndarray = np.maximum.accumulate(loss[k:])
    return np.append(np.full(k, later[0]), later)


def on_common_windows(sides: Sequence[ElectricalSide]) -> list[ElectricalSide] | None:
    """Return the sides on the windows of the first, as far as all of them reach.

    Those of other instants keep their energy: power of a window is the mean of the windows that it
    overlaps.  None: there is no common window.
    """
    t = sides[0].t
    if all(s.t.shape == t.shape and np.abs(s.t - t).max() <= 1e-9 for s in sides):
        return list(sides)
    begin, end = max(s.t[0] for s in sides), min(s.t[-1] for s in sides)
    t = t[(t >= begin - 1e-9) & (t <= end + 1e-9)]
    return None if t.size < 2 else [_at(s, t) for s in sides]


def _at(side: ElectricalSide, t: np.ndarray) -> ElectricalSide:
    """Return a side on other windows, which it covers."""
    amid, there = (t[1:] + t[:-1]) / 2, (side.t[1:] + side.t[:-1]) / 2
    views = []
    for v in side.views:
        energy = np.append(0.0, np.cumsum(v.P * np.diff(side.t)))
        # known when the windows that it came from were
        start = int(np.searchsorted(t, side.t[v.start] - 1e-9)) if v.start else 0
        P = np.diff(np.interp(t, side.t, energy)) / np.diff(t)
        spread = (np.interp(amid, there, x) for x in (v.variance, v.noise, v.loss))
        views.append(View(min(start, t.size - 2), P, *spread))
    rows = np.searchsorted(side.t, t + 1e-9, side="right") - 1
    own: dict[str, Any] = {"t": t, "views": tuple(views)}
    for n in ("severities", "probability", "phase", "misfit"):
        own[n] = getattr(side, n)[..., rows]
    if side.beliefs is not None:
        names, mean, cov = side.beliefs
        ended = np.maximum(rows[1:] - 1, 0)
        own["beliefs"] = Beliefs(names, mean[ended], cov[ended])
    return dataclasses.replace(side, **own)


def fusable(
    apu: Apu, sides: Mapping[int, ElectricalSide], fuel: np.ndarray, notes: list[str]
) -> dict[int, ElectricalSide]:
    """Return the machines whose powers make the shaft power, on common windows.

    Args:
        apu: the unit.
        sides: by number of the machine.
        fuel: instants of the gas path, s.
        notes: which take why there are none.
    """
    if not sides:
        return {}
    others = [k for k in range(1, len(apu.machines) + 1) if k not in sides]
    if others and not apu.alike:
        notes.append(
            f"the generators differ, and {who(others)} {'is' if len(others) == 1 else 'are'} not "
            "estimated: the gas path has no shaft power from the waveforms"
        )
        return {}
    common = on_common_windows([*sides.values()])
    if common is None:
        notes.append(
            "the generators were sampled at different times: the gas path has no shaft power from "
            "the waveforms"
        )
        return {}
    t = common[0].t
    if min(t[-1], fuel[-1]) - max(t[0], fuel[0]) < 0.5 * (fuel[-1] - fuel[0]):
        notes.append(
            f"the waveforms, {t[0]:g} to {t[-1]:g} s, cover less than half of the gas path's time: "
            "the two are estimated apart; give that part of the gas path alone to have both"
        )
        return {}
    return dict(zip(sides, common, strict=True))
