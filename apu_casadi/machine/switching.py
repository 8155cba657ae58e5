"""Load, fault and inputs of a generator alone over time: switches, and profiles between them.

A profile is held over steps at its value in their middles, as a joint run holds it over exchange
steps; where it jumps, a step begins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError
from apu_casadi.core.profiles.profile import Profile, Varying, at, later
from apu_casadi.core.runloop import SAME_INSTANT
from apu_casadi.machine.faults.fault import Fault
from apu_casadi.machine.loads.load import Load


class Held(NamedTuple):
    """What holds from an instant on.

    Args:
        t: the instant, s.
        load, fault, inputs: then; inputs by name.
        switched: whether one of them was switched, or jumped; else they go on.
    """

    t: float
    load: Load
    fault: Fault | None
    inputs: dict[str, float]
    switched: bool


class _Asked(NamedTuple):
    """What is asked for from an instant on, profiles in the time of the run."""

    t: float
    load: Any
    fault: Any
    inputs: dict[str, Any]

    @property
    def changing(self) -> list[Any]:
        """What changes in time."""
        given = (self.load, self.fault, *self.inputs.values())
        return [x for x in given if isinstance(x, Varying | Profile)]


def timeline(
    load: Any,
    fault: Any,
    inputs: Mapping[str, Any],
    switches: Sequence[tuple[float, Any]],
    end: float,
    hold: float,
) -> list[Held]:
    """Return what holds over a run, from each instant at which it changes.

    Args:
        load, fault, inputs: from the start; each may be, or be made of, a profile.
        switches: as of :meth:`Generator.simulate`.
        end, hold: of the run, and longest time over which a profile is held, s.

    Raises:
        ParameterError: something that is no change, two of a kind at one instant, or no time.
    """
    hold = number("hold", hold, error=ParameterError)
    if not hold > 0:
        raise ParameterError(f"hold must be > 0 s, got {hold:g}")
    now = _Asked(0.0, load, fault, dict(inputs))
    course = [now]
    for t, changes in _instants(switches):
        moved = {n: later(v, t) for n, v in changes.get("inputs", {}).items()}
        own = {n: later(changes[n], t) for n in ("load", "fault") if n in changes}
        now = now._replace(t=t, inputs={**now.inputs, **moved}, **own)
        course.append(now)
    made = []
    for k, now in enumerate(course):
        last = course[k + 1].t if k + 1 < len(course) else end
        begins, jumps = [now.t], {now.t}
        if parts := now.changing:
            jumps |= {t for x in parts for t in x.instants(end)}
            grid = [*jumps, *np.arange(now.t, last, hold)]
            begins = [t for t in sorted(grid) if now.t <= t < last]
            begins = [t for t, u in zip(begins, [-1.0, *begins], strict=False) if t > u + 1e-9]
        for t, until in zip(begins, [*begins[1:], last], strict=False):
            middle = (t + until) / 2
            held = {n: at(v, middle) for n, v in now.inputs.items()}
            jumped = (k > 0 or t > 0) and any(abs(t - u) < SAME_INSTANT for u in jumps)
            made.append(Held(t, at(now.load, middle), at(now.fault, middle), held, jumped))
    return made if course[0].changing else made[1:]


def _instants(switches: Sequence[tuple[float, Any]]) -> list[tuple[float, dict[str, Any]]]:
    """Return the switches instant by instant, each with its load, fault and inputs.

    Raises:
        ParameterError: something that is no change, or two of a kind at one instant, whose order
            would decide.
    """
    grouped: list[tuple[float, dict[str, Any]]] = []
    for t, change in sorted(switches, key=lambda s: s[0]):
        if not grouped or t - grouped[-1][0] > SAME_INSTANT:
            grouped.append((float(t), {}))
        now, made = grouped[-1][1], change.example() if isinstance(change, Varying) else change
        if made is None or isinstance(made, Fault):
            kind, twice = "fault", "fault" in now
        elif isinstance(made, Load):
            kind, twice = "load", "load" in now
        elif isinstance(made, Mapping):
            kind, before = "inputs", now.get("inputs", {})
            twice = any(before.get(k, v) != v for k, v in made.items())
            change = {**before, **made}
        else:
            raise ParameterError(
                f"switch at t = {t:g} s: a load, a fault, None or a mapping of inputs is "
                f"needed, got {change!r}"
            )
        if twice and now[kind] != change:
            raise ParameterError(
                f"two different changes of the {kind} at t = {t:g} s: {now[kind]!r} and {change!r}"
            )
        now[kind] = change
    return grouped
