"""What differs from what the filters believe: every imperfection is one entry.

    @imperfection("current sensor lag", "sensors", "s", (5e-6, 2e-5, 6e-5))
    def _(c: Readings, size: float) -> None: ...

A function changes one thing, by what is named second:

* ``"unit"``: (unit, size) -> the true unit; filters know the one that was given;
* ``"scenario"``: (arguments of ``simulate_joint``, size) -> others;
* ``"sensors"``: what sensors are given to read, in place, before gain errors and noise;
* ``"recording"``: what they read, in place.

The three sizes are small, realistic and large.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from apu_casadi.core.errors import ParameterError
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.machine.machinedata import magnetics
from apu_casadi.machine.park import PHASES
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import Ambient, FaultChange, HealthChange, LoadChange
from estimators.apu.sensors import respond
from scenarios.studies.gaspath.course import VARIANTS, variant

__all__ = [
    "DROP",
    "DURATION",
    "FAULTS",
    "IMPERFECTIONS",
    "ONSET",
    "SIZES",
    "Imperfection",
    "Readings",
    "imperfection",
    "scenario",
]

SIZES = ("small", "realistic", "large")
DURATION, DROP, ONSET = 1.0, 0.3, 0.6  # s; of a run, of its load step, of its fault
FULL_KW, PART_KW = 225.0, 150.0
MU, K_RF = 0.05, 20.0  # h = 2.4e-3
HEALTH = {"f_eta_c": 0.97, "f_W_c": 0.98}
FAULTS = ("none", "short circuit", "gas path")
WHAT = ("unit", "scenario", "sensors", "recording")

Arrays = dict[str, np.ndarray]


@dataclass
class Readings:
    """Arrays by name, ``t`` among them; ``rng`` draws where an imperfection is random."""

    gaspath: Arrays
    electrical: Arrays
    rng: np.random.Generator


@dataclass(frozen=True)
class Imperfection:
    """One entry.

    Args:
        name: of it.
        what: of a run it changes, one of ``WHAT``.
        unit: of the sizes.
        sizes: small, realistic, large.
        change: see the module.
        fault: which of ``FAULTS`` is in all runs; None: they take turns.
        healthy: a filter may be asked to hold: no fault, and nothing that is broken.
        only: what is measured, ``"gaspath"`` alone; None: all.
    """

    name: str
    what: str
    unit: str
    sizes: tuple[float, float, float]
    change: Callable[[Any, float], Any]
    fault: str | None = None
    healthy: bool = False
    only: str | None = None


IMPERFECTIONS: dict[str, Imperfection] = {}


def imperfection(
    name: str, what: str, unit: str, sizes: tuple[float, float, float], **more: Any
) -> Callable[[Callable[[Any, float], Any]], Callable[[Any, float], Any]]:
    """Register an entry; see :class:`Imperfection`.

    Raises:
        ParameterError: a name that is taken, or something else that it changes.
    """
    if name in IMPERFECTIONS or what not in WHAT:
        raise ParameterError(f"imperfection {name!r}: taken, or {what!r} is none of {WHAT}")

    def register(change: Callable[[Any, float], Any]) -> Callable[[Any, float], Any]:
        IMPERFECTIONS[name] = Imperfection(name, what, unit, sizes, change, **more)
        return change

    return register


def scenario(fault: str, phase: str) -> dict[str, Any]:
    """Return the run that is estimated: a load step, then a fault."""
    full, part = (SeriesLoad.from_power(1e3 * kW) for kW in (FULL_KW, PART_KW))
    events: dict[str, Any] = {
        "none": (),
        "short circuit": (FaultChange(ONSET, Ttsc(MU, K_RF, phase=phase)),),
        "gas path": (HealthChange(ONSET, HEALTH),),
    }
    return {"duration": DURATION, "load": full, "events": (LoadChange(DROP, part), *events[fault])}


# ------------------------------------------------------------------------------ loads, faults


def _loads(s: dict[str, Any], make: Callable[[float], SeriesLoad]) -> dict[str, Any]:
    """Return a scenario with other loads of the same power."""
    events = tuple(
        LoadChange(e.t, make(PART_KW)) if isinstance(e, LoadChange) else e for e in s["events"]
    )
    return s | {"load": make(FULL_KW), "events": events}


def _changed(s: dict[str, Any], **values: Any) -> dict[str, Any]:
    """Return a scenario with other numbers of its short circuit."""
    return s | {
        "events": tuple(
            dataclasses.replace(e, fault=dataclasses.replace(e.fault, **values))
            if isinstance(e, FaultChange) and isinstance(e.fault, Ttsc)
            else e
            for e in s["events"]
        )
    }


@imperfection("part load", "scenario", "kW", (100.0, 50.0, 10.0), healthy=True)
def _(s: dict[str, Any], size: float) -> dict[str, Any]:
    return _loads(s, lambda kW: SeriesLoad.from_power(1e3 * size * (1.0 if kW == FULL_KW else 0.8)))


@imperfection("load power factor", "scenario", "1", (0.95, 0.85, 0.6), healthy=True)
def _(s: dict[str, Any], size: float) -> dict[str, Any]:
    return _loads(s, lambda kW: SeriesLoad.from_power(1e3 * kW, power_factor=size))


@imperfection("unbalanced load", "scenario", "1", (0.02, 0.05, 0.15), healthy=True)
def _(s: dict[str, Any], size: float) -> dict[str, Any]:
    shares = (1.0 + size, 1.0, 1.0 - size)
    return _loads(s, lambda kW: SeriesLoad.from_power(1e3 * kW, unbalance=shares))


@imperfection("two faults at once", "scenario", "1", (0.01, 0.03, 0.06), fault="short circuit")
def _(s: dict[str, Any], size: float) -> dict[str, Any]:
    return s | {"events": (*s["events"], HealthChange(ONSET, {"f_eta_c": 1 - size}))}


@imperfection("another kappa", "scenario", "1", (0.06, 0.2, 1.0), fault="short circuit")
def _(s: dict[str, Any], size: float) -> dict[str, Any]:
    return _changed(s, kappa=size)


@imperfection("small short circuit", "scenario", "h", (1e-4, 3e-4, 8e-4), fault="short circuit")
def _(s: dict[str, Any], size: float) -> dict[str, Any]:
    return _changed(s, k_rf=MU / size - 1 + MU)


@imperfection("humidity", "scenario", "war", (0.003, 0.01, 0.02), healthy=True)
def _(s: dict[str, Any], size: float) -> dict[str, Any]:
    return s | {"ambient": Ambient(war=size)}


# ------------------------------------------------------------------------------ the unit


def _scaled(*names: str) -> Callable[[Apu, float], Apu]:
    def change(apu: Apu, size: float) -> Apu:
        known = apu.parameters()
        return apu.change({n: float(known[n]) * (1 + size) for n in names})

    return change


for _name, _sizes, _of in (
    ("hot field winding", (0.05, 0.2, 0.4), ("machine.r_fd",)),
    ("hot stator", (0.1, 0.3, 0.6), ("machine.r_s",)),
    ("leakage", (0.05, 0.1, 0.2), ("machine.L_ls",)),
    ("d magnetising inductance", (0.02, 0.05, 0.1), ("machine.L_md",)),
    ("generator efficiency", (-0.01, -0.02, -0.05), ("machine.eta_sg",)),
    ("inertia", (0.1, 0.5, 1.0), ("gas_generator.J",)),
):
    imperfection(_name, "unit", "relative", _sizes, healthy=True)(_scaled(*_of))


@imperfection("saturation", "unit", "S_10", (0.02, 0.1, 0.2), healthy=True)
def _(apu: Apu, size: float) -> Apu:
    g = apu.generator
    return dataclasses.replace(
        apu, generator=dataclasses.replace(g, machine=magnetics(g.machine, size, 3 * size))
    )


def _between(a: float, b: float, share: float) -> float:
    return a + share * (b - a)


@imperfection("other maps", "unit", "of another calibration", (0.3, 1.0, 2.0), healthy=True)
def _(apu: Apu, size: float) -> Apu:
    gg, other = apu.gas_generator, VARIANTS["other map calibration"]
    part = {
        m: {k: _between(getattr(getattr(gg, m).calibration, k), v, size) for k, v in c.items()}
        for m, c in other.items()
    }
    return dataclasses.replace(apu, gas_generator=variant(gg, part))


# ------------------------------------------------------------------------------ sensors

CURRENTS, VOLTAGES = (tuple(f"{q}_{p}" for p in PHASES) for q in "iv")


def _later(t: np.ndarray, v: np.ndarray, late: Any) -> np.ndarray:
    """Values at instants between the samples, by a cubic spline."""
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(t, v)(t + late))


@imperfection("current sensor lag", "sensors", "s", (5e-6, 2e-5, 6e-5), healthy=True)
def _(c: Readings, size: float) -> None:
    for n in CURRENTS:
        c.electrical[n] = _later(c.electrical["t"], c.electrical[n], -size)


@imperfection("sampling jitter", "sensors", "s", (1e-6, 5e-6, 2e-5), healthy=True)
def _(c: Readings, size: float) -> None:
    e = c.electrical
    late = size * c.rng.standard_normal(e["t"].size)
    for n in (*CURRENTS, *VOLTAGES):
        e[n] = _later(e["t"], e[n], late)


@imperfection("5th and 7th harmonic current", "sensors", "of the rated", (0.01, 0.05, 0.1))
def _(c: Readings, size: float) -> None:
    e = c.electrical
    angle = np.concatenate([[0.0], np.cumsum(e["w_r"][:-1] * np.diff(e["t"]))])
    for n, shift in zip(CURRENTS, (0.0, 2 * math.pi / 3, 4 * math.pi / 3), strict=True):
        wave = np.cos(5 * (angle - shift)) + 0.6 * np.cos(7 * (angle - shift))
        e[n] = e[n] + size * 461.0 * wave


@imperfection("speed ripple", "sensors", "relative", (1e-4, 5e-4, 2e-3), healthy=True)
def _(c: Readings, size: float) -> None:
    e = c.electrical
    e["w_r"] = e["w_r"] * (1 + size * np.sin(2 * math.pi * 200.0 * e["t"]))


@imperfection("T5 lag", "sensors", "s", (0.1, 1.0, 3.0), healthy=True)
def _(c: Readings, size: float) -> None:
    c.gaspath["T5"] = respond(c.gaspath["t"], c.gaspath["T5"], size)


def _gained(name: str) -> Callable[[Readings, float], None]:
    def change(c: Readings, size: float) -> None:
        c.gaspath[name] = c.gaspath[name] * (1 + size)

    return change


imperfection("T5 bias", "sensors", "relative", (0.005, 0.02, 0.05))(_gained("T5"))
imperfection("fuel flow bias", "sensors", "relative", (0.01, 0.03, 0.06))(_gained("Wf"))


@imperfection("P3 drift", "sensors", "relative, to the end", (0.005, 0.02, 0.05))
def _(c: Readings, size: float) -> None:
    c.gaspath["P3"] = c.gaspath["P3"] * (1 + size * c.gaspath["t"] / DURATION)


@imperfection("shaft power drift", "sensors", "to the end", (0.02, 0.05, 0.1), only="gaspath")
def _(c: Readings, size: float) -> None:
    c.gaspath["PW"] = c.gaspath["PW"] * (1 + size * c.gaspath["t"] / DURATION)


@imperfection("ambient temperature", "recording", "K", (1.0, 5.0, 10.0), healthy=True)
def _(c: Readings, size: float) -> None:
    c.gaspath["dT_isa"] = c.gaspath["dT_isa"] + size


# ------------------------------------------------------------------------------ readings


def _offset(name: str, *, start: float) -> Callable[[Readings, float], None]:
    def change(c: Readings, size: float) -> None:
        e = c.electrical
        e[name] = e[name] + size * (e["t"] >= start)

    return change


imperfection("v_a offset", "recording", "V", (0.3, 1.0, 5.0))(_offset("v_a", start=0.0))
imperfection("i_a offset", "recording", "A", (1.0, 3.0, 10.0))(_offset("i_a", start=0.0))
imperfection("v_a step", "recording", "V", (1.0, 3.0, 10.0))(_offset("v_a", start=0.5))
imperfection("i_a step", "recording", "A", (2.0, 5.0, 20.0))(_offset("i_a", start=0.5))


def _stuck(name: str) -> Callable[[Readings, float], None]:
    def change(c: Readings, size: float) -> None:
        a = c.electrical if name in c.electrical else c.gaspath
        at = a["t"] >= a["t"][-1] - size - 1e-9
        a[name][at] = a[name][int(np.argmax(at))]

    return change


imperfection("stuck current", "recording", "s", (2e-3, 0.05, 0.3))(_stuck("i_b"))
imperfection("stuck voltage", "recording", "s", (2e-3, 0.05, 0.3))(_stuck("v_b"))
imperfection("T5 stuck", "recording", "s", (0.1, 0.4, 0.8))(_stuck("T5"))


@imperfection("currents jump every 25 ms", "recording", "relative", (0.01, 0.04, 0.1))
def _(c: Readings, size: float) -> None:
    for n in CURRENTS:
        c.electrical[n] = c.electrical[n] * (1 + size * (c.electrical["t"] % 0.05 >= 0.025))


@imperfection("quantisation", "recording", "A, V", (0.25, 1.0, 5.0), healthy=True)
def _(c: Readings, size: float) -> None:
    for n in (*CURRENTS, *VOLTAGES):
        c.electrical[n] = size * np.round(c.electrical[n] / size)


@imperfection("clipping", "recording", "of the amplitude", (0.99, 0.95, 0.8))
def _(c: Readings, size: float) -> None:
    for n in CURRENTS:
        top = size * float(np.abs(c.electrical[n]).max())
        c.electrical[n] = np.clip(c.electrical[n], -top, top)


@imperfection("spikes", "recording", "per 10 000 samples", (1.0, 10.0, 100.0))
def _(c: Readings, size: float) -> None:
    for n in CURRENTS:
        at = c.rng.random(c.electrical["t"].size) < size * 1e-4
        c.electrical[n] = c.electrical[n] + at * 300.0 * c.rng.choice([-1.0, 1.0], at.size)


@imperfection("T5 spikes", "recording", "readings", (1.0, 3.0, 10.0))
def _(c: Readings, size: float) -> None:
    at = c.rng.choice(np.arange(2, c.gaspath["t"].size), int(size), replace=False)
    c.gaspath["T5"][at] *= 1 + 0.15 * c.rng.choice([-1.0, 1.0], at.size)


@imperfection("dropouts", "recording", "share of samples", (1e-3, 0.01, 0.1), healthy=True)
def _(c: Readings, size: float) -> None:
    for n in (*CURRENTS, *VOLTAGES):
        c.electrical[n][c.rng.random(c.electrical["t"].size) < size] = np.nan


@imperfection("clock", "recording", "relative", (2e-5, 1e-4, 1e-3), healthy=True)
def _(c: Readings, size: float) -> None:
    c.electrical["t"] = c.electrical["t"] * (1 + size)


@imperfection("wrong rate", "recording", "relative", (2e-3, 0.01, 0.05))
def _(c: Readings, size: float) -> None:
    c.electrical["t"] = c.electrical["t"] * (1 + size)


@imperfection("samples out of order", "recording", "pairs", (1.0, 10.0, 100.0))
def _(c: Readings, size: float) -> None:
    e = c.electrical
    for k in c.rng.choice(np.arange(10, e["t"].size - 10, 3), int(size), replace=False):
        for n in (*CURRENTS, *VOLTAGES):
            e[n][[k, k + 1]] = e[n][[k + 1, k]]


@imperfection("phases exchanged", "recording", "currents", (1.0, 1.0, 1.0))
def _(c: Readings, size: float) -> None:
    e = c.electrical
    e["i_b"], e["i_c"] = e["i_c"], e["i_b"]
