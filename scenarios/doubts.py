"""Numbers of a scenario that are possible and most often a slip, such as rad/s given as r/min.

Each is told with its place and the range that the unit of the scenario was built for.  What is
impossible is refused where it is read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.profiles.profile import Profile, Varying
from apu_casadi.core.units import RPM
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.load import Branches
from apu_casadi.unit.usual import LOAD_SHARE, beyond, unusual
from scenarios.phases import Changing
from scenarios.reading import inside

if TYPE_CHECKING:
    from apu_casadi.unit.apu import Apu
    from scenarios.schema import Scenario

_HEALTH = (0.8, 1.1)
_FACTOR = 30.0
"""Most that a parameter usually differs from the unit's own."""
_SEVERITY = 1e-7
"""Severity h of a short circuit below which nothing can be read of it."""
_NOISE = 0.2
"""Most that noise is, of the design value."""
_SAMPLES = 10
"""Samples of a period, at least."""


def doubts(s: Scenario, unit: Apu, base: Apu) -> list[str]:
    """Return the doubts about a scenario's numbers, each with its place.

    Args:
        unit: of the scenario.
        base: the same without the scenario's parameters.
    """
    found = [*_of_parameters(s.parameters, unit, base), *_of_run(s, unit)]
    parts: list[tuple[str, Changing, float]] = [
        *((f"phase[{i}]", p, p.start) for i, p in enumerate(s.phases, 1)),
        *((f"event[{i}]", c, c.time) for i, c in enumerate(s.changes, 1)),
    ]
    for place, c, start in parts:
        own = [*_of_changes(c, unit), *_idle(c, s.duration - start)]
        found += [(f"{place}.{p}", words) for p, words in own]
    return [f"{place}: {words}" for place, words in found]


def _of_parameters(given: Mapping[str, Any], unit: Apu, base: Apu) -> Iterator[tuple[str, str]]:
    strange: dict[str, str] = {}
    for name, words in unusual(unit, given):
        strange[name] = f"{strange[name]}; {words}" if name in strange else words
    own = base.parameters()
    for name, value in given.items():
        before = own.get(name, own.get(name.partition(".")[2]))
        if name in strange:
            yield f"parameters.{name}", strange[name]
        elif isinstance(value, str) or isinstance(before, str) or not (before and value):
            continue
        elif not 1 / _FACTOR <= value / before <= _FACTOR:
            ratio = f"{value / before:.3g} times the unit's own {before:g}"
            yield f"parameters.{name}", f"{value:g} is {ratio}; is the unit of the number right?"


def _of_run(s: Scenario, unit: Apu) -> Iterator[tuple[str, str]]:
    m = unit.generator.machine
    if s.waveform_dt is not None and s.waveform_dt * m.f_rated * _SAMPLES > 1:
        period = f"{1e3 / m.f_rated:g} ms, the period at {m.f_rated:g} Hz"
        yield (
            "waveform_dt",
            f"{1e3 * s.waveform_dt:g} ms is more than a {_SAMPLES}th of {period}: the waveforms "
            "will not show one; 0 keeps none",
        )
    if s.noise is None:
        return
    terminal = s.noise.terminal
    I = m.P_rated / (3 * m.V_rated_rms)
    rows = [("N", s.noise.N, unit.N_ref, "rad/s")]
    rows += [(n, getattr(s.noise, n), m.V_rated_rms, "V") for n in ("w1", "w2")]
    if terminal is not None:
        rows += [("terminal.sigma_i", terminal.sigma_i, I, "A")]
        rows += [("terminal.sigma_v", terminal.sigma_v, m.V_rated_rms, "V")]
    gg = unit.gas_generator
    design = gg.design.values if s.noise.gas else {}
    rows += [
        (f"gas.{n}", v, abs(design[n]), gg.Y[n].unit)
        for n, v in s.noise.gas.items()
        if design.get(n)
    ]
    for name, sigma, rated, u in rows:
        words = beyond(name, sigma, 0.0, _NOISE * rated, u, f": a fifth of {rated:.4g} {u} at most")
        if words:
            yield f"noise.{name}", words


def _of_changes(c: Changing, unit: Apu) -> Iterator[tuple[str, str]]:
    if c.N_ref_rpm is not None:
        yield from _of_speed(c.N_ref_rpm, unit)
    if isinstance(c.health, Mapping):
        why = ", for which the model was built; one is healthy, 0.98 two per cent less"
        for name, value in c.health.items():
            yield from _worst(f"health.{name}", name, _bounds(value), _HEALTH, "", why)
    loads = c.load if isinstance(c.load, tuple) else (c.load,)
    for k, load in enumerate(loads, 1):
        at = f"load[{k}]" if isinstance(c.load, tuple) else "load"
        yield from _of_load(at, load, unit)
    faults = c.fault if isinstance(c.fault, tuple) else (c.fault,)
    for of in faults:
        fault = getattr(of, "fault", of)
        worst = _course(fault) if isinstance(fault, Varying) else [fault]
        h = [f.h for f in worst if isinstance(f, Ttsc)]
        if h and max(h) < _SEVERITY:
            yield (
                "fault.k_rf",
                f"the severity h = mu/(k_rf + 1 - mu) is {max(h):.2g}: nothing can be read of it "
                f"below {_SEVERITY:g}; k_rf is a ratio to the shorted turns' own resistance",
            )


def _of_speed(speed: Any, unit: Apu) -> Iterator[tuple[str, str]]:
    own, lines = unit.N_ref * RPM, unit.gas_generator.compressor_map
    span = [float(n) / lines.N_map_des * own for n in (lines.table.N[0], lines.table.N[-1])]
    why = f", the speeds of the compressor map; the unit's own is {own:.0f} r/min"
    low, high = _bounds(speed)
    if span[0] <= low * RPM and high * RPM <= span[1]:
        why += f". Was rad/s meant? {low:g} rad/s are {low * RPM:.0f} r/min"
    yield from _worst("N_ref_rpm", "N_ref_rpm", (low, high), tuple(span), "r/min", why)


def _of_load(at: str, load: Any, unit: Apu) -> Iterator[tuple[str, str]]:
    m = unit.generator.machine
    rated = m.P_rated / 1e3
    span = LOAD_SHARE[0] * rated, LOAD_SHARE[1] * rated
    why = f"; a generator is rated {rated:g} kW"
    if isinstance(load, Varying):
        table = dict(load.values)
        powers = _bounds(table["power_kW"]) if "power_kW" in table else ()
    elif load is None:
        return
    else:
        table = load.to_table() if load.tables else {}
        powers = (table["power_kW"],) * 2 if "power_kW" in table else ()
    if powers:
        low = max(powers[0], span[0]) if isinstance(load, Varying) else powers[0]
        yield from _worst(f"{at}.power_kW", "power_kW", (low, powers[1]), span, "kW", why)
    elif isinstance(load, Branches):
        S = 3e-3 * m.V_rated_rms**2 / abs(load.Z_mean)
        words = beyond("apparent power", S, *span, "kVA", f"{why}; are ohm, mH and uF right?")
        if words:
            yield at, words


def _bounds(value: Any) -> tuple[float, float]:
    return value.bounds if isinstance(value, Profile) else (value, value)


def _worst(
    place: str,
    name: str,
    values: tuple[float, float],
    span: tuple[float, ...],
    unit: str,
    why: str,
) -> Iterator[tuple[str, str]]:
    """Yield the words for one of two values outside a span."""
    found = (beyond(name, v, span[0], span[1], unit, why) for v in values)
    words = next((w for w in found if w), None)
    if words:
        yield place, words


def _course(varying: Varying[Any]) -> list[Any]:
    """Return an object at some of the bends of its profiles."""
    t = [0.0, *varying.corners(math.inf)]
    return [varying.at(x) for x in (*t[:: 1 + len(t) // 100], t[-1])]


def _idle(c: Changing, left: float) -> Iterator[tuple[str, str]]:
    """Yield the profiles that do not change before the run ends, ``left`` s later."""
    own: list[tuple[str, Any]] = [("N_ref_rpm", c.N_ref_rpm)]
    if isinstance(c.health, Mapping):
        own += [(f"health.{n}", v) for n, v in c.health.items()]
    for name in ("load", "fault"):
        value = getattr(c, name)
        for of in value if isinstance(value, tuple) else (value,):
            part = getattr(of, "fault", of)
            if isinstance(part, Varying):
                own += [(f"{name}.{n}", p) for n, p in part.profiles.items()]
    t = np.linspace(0.0, left, 2001)
    for place, p in own:
        if not isinstance(p, Profile) or p.bounds[0] == p.bounds[1]:
            continue
        with inside(place):
            bends = p.corners(left)
        if np.ptp(p(t)) == 0.0 and not bends:
            first = next(iter(p.corners(math.inf)), math.inf)
            yield (
                place,
                f"{p.label}: nothing of it happens in the {left:g} s before the run ends (it "
                f"changes from {first:g} s on); times are in s",
            )
