"""A scenario: a small description of phases and events that is checked before anything runs.

A TOML file reads like this::

    name = "my_run"
    title = "Load drop, then a short circuit"
    duration = 6.0                      # s
    [[phase]]
    name = "full load"
    start = 0.0                         # s
    load = { kind = "R", power_kW = 225.0 }   # of each of the two generators
    [[phase]]
    name = "TTSC"
    start = 3.0
    fault = { mu = 0.05, k_rf = 20.0, phase = "a" }
    [[event]]                           # a change inside a phase
    time = 4.0
    load = { kind = "RL", power_kW = 100.0, power_factor = 0.85 }

A phase keeps what it does not change; ``health = "none"`` and ``fault = "none"`` restore the
healthy state.  Optional tables: ``[ambient]`` (altitude [m], Mach, dT_isa [K], war),
``[parameters]`` (dotted names of the unit, as ``machine.r_s``) and ``[noise]`` (N, w1, w2, and the
tables gas and terminal: see :class:`NoiseSpec`).  Errors count phases and events from 1.

The attributes of the classes here are the keys of the file, so that both are one description.
"""

from __future__ import annotations

import dataclasses
import json
import math
import numbers
import os
import re
import reprlib
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, Self

from apu_casadi.core import files
from apu_casadi.core.checked import bounded as number
from apu_casadi.core.errors import DataError, ScenarioError, nearest
from apu_casadi.unit.events import HEALTH_FACTORS, Ambient, health_factors

if TYPE_CHECKING:
    from apu_casadi.machine.faults.ttsc import Ttsc
    from apu_casadi.unit.events import Event

LOAD_KEYS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "R": ("power_kW", "unbalance"),
        "RL": ("power_kW", "power_factor", "unbalance"),
        "series": ("R_ohm", "L_mH"),
        "constant_power": ("power_kW", "lag_ms"),
        "open": (),
    }
)
"""The kinds of load, each with the keys that it takes besides ``kind``."""

LARGEST_FILE = 1 << 24
"""Largest scenario file, bytes."""
EXCHANGES = ("paper", "predicted", "corrected")
"""Exchanges of speed and fuel that a scenario may ask for."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
_PHASES = ("a", "b", "c")


class _PlacedError(ScenarioError):
    """A scenario error that knows its place, so that the callers can prefix theirs."""

    def __init__(self, place: str, message: str, note: str = "") -> None:
        super().__init__(f"{place}: {message}{note}")
        self.place, self.message, self.note = place, message, note


@contextmanager
def _inside(part: str, note: str = "") -> Iterator[None]:
    """Prefix the place of a scenario error raised inside the block."""
    try:
        yield
    except _PlacedError as e:
        raise _PlacedError(f"{part}.{e.place}", e.message, e.note or note) from None
    except ScenarioError as e:  # "place: message", from the checks shared with the events
        place, _, message = str(e).partition(": ")
        raise _PlacedError(f"{part}.{place}", message, note) from None


def _require(ok: bool, place: str, message: str) -> None:
    if not ok:
        raise _PlacedError(place, message)


def _text(value: Any, place: str, *, empty: bool = False) -> str:
    _require(isinstance(value, str), place, f"a text is expected, got {value!r}")
    _require(empty or bool(value.strip()), place, "must not be empty")
    return str(value)


def _table(value: Any, place: str, keys: tuple[str, ...]) -> dict[str, Any]:
    """Return a table whose keys are all in ``keys``."""
    _require(isinstance(value, Mapping), place, f"a table is expected, got {value!r}")
    for k in value:
        if k not in keys:
            raise _PlacedError(
                f"{place}.{k}", f"unknown key {nearest(str(k), keys) if keys else ''}"
            )
    return dict(value)


def _triple(value: Any, place: str, **limits: Any) -> tuple[float, float, float]:
    """Return three checked numbers; a single number stands for three equal ones."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        value = (value, value, value)
    _require(
        isinstance(value, list | tuple) and len(value) == 3,
        place,
        f"three numbers (phases a, b, c) are expected, got {value!r}",
    )
    a, b, c = (number(v, f"{place}[{i}]", **limits) for i, v in enumerate(value, 1))
    return a, b, c


@dataclass(frozen=True)
class LoadSpec:
    """The electrical load of each of the two generators.

    Args:
        kind: ``R``, ``RL``, ``series``, ``constant_power`` or ``open``.
        power_kW: power at rated voltage [kW], for R, RL and constant_power; 0.1 to 500.
        power_factor: 0.1 to 1, lagging, for RL (default 0.85).
        unbalance: power of the phases a, b, c relative to the balanced load [1], for R and RL.
        R_ohm, L_mH: explicit values per phase [ohm, mH], for series.
        lag_ms: time constant [ms] with which a constant-power load follows the voltage (default 2).

    Raises:
        ScenarioError: an unknown kind, a key that the kind does not take or lacks, a wrong value.
    """

    kind: str
    power_kW: float | None = None
    power_factor: float | None = None
    unbalance: tuple[float, float, float] | None = None
    R_ohm: tuple[float, float, float] | None = None
    L_mH: tuple[float, float, float] | None = None
    lag_ms: float | None = None

    def __post_init__(self) -> None:
        """Check the kind, the keys it takes, and every value."""
        _text(self.kind, "kind")
        if self.kind not in LOAD_KEYS:
            raise _PlacedError("kind", f"unknown {self.kind!r} {nearest(self.kind, LOAD_KEYS)}")
        takes = LOAD_KEYS[self.kind]
        for f in dataclasses.fields(self)[1:]:
            given = getattr(self, f.name) is not None
            if given and f.name not in takes:
                which = f"it takes {', '.join(takes)}" if takes else "it takes no other key"
                raise _PlacedError(f.name, f"not a key of a {self.kind!r} load; {which}")
        for required in ("power_kW", "R_ohm", "L_mH"):
            if required in takes and getattr(self, required) is None:
                raise _PlacedError(required, f"missing: a {self.kind!r} load needs it")
        put: Callable[[str, Any], None] = lambda n, v: object.__setattr__(self, n, v)  # noqa: E731
        if self.power_kW is not None:
            put("power_kW", number(self.power_kW, "power_kW", lo=0.1, hi=500.0, unit="kW"))
        if self.kind == "RL":
            pf = 0.85 if self.power_factor is None else self.power_factor
            put("power_factor", number(pf, "power_factor", lo=0.1, hi=1.0))
        if self.kind == "constant_power":
            lag = 2.0 if self.lag_ms is None else self.lag_ms
            put("lag_ms", number(lag, "lag_ms", lo=0.1, hi=1000.0, unit="ms"))
        if self.unbalance is not None:
            put("unbalance", _triple(self.unbalance, "unbalance", lo=0.05, hi=3.0))
        if self.kind == "series":
            put("R_ohm", _triple(self.R_ohm, "R_ohm", lo=0.0, open_lo=True, unit="ohm"))
            put("L_mH", _triple(self.L_mH, "L_mH", lo=0.0, unit="mH"))

    @classmethod
    def from_dict(cls, data: Any) -> Self:
        """Make a load from a table; :class:`ScenarioError` for a wrong key or value."""
        keys = tuple(f.name for f in dataclasses.fields(cls))
        with _inside("load"):
            _require(isinstance(data, Mapping), "kind", f"missing: a table is expected: {data!r}")
            kind = data.get("kind")
            _require("kind" in data, "kind", f"missing: one of {', '.join(LOAD_KEYS)}")
            takes = LOAD_KEYS.get(kind, ()) if isinstance(kind, str) else ()
            for k in data:
                if k not in keys:
                    raise _PlacedError(str(k), f"unknown key {nearest(str(k), ('kind', *takes))}")
            return cls(**data)

    def to_dict(self) -> dict[str, Any]:
        """Return the table that :meth:`from_dict` reads."""
        return {
            f.name: list(v) if isinstance(v, tuple) else v
            for f in dataclasses.fields(self)
            if (v := getattr(self, f.name)) is not None
        }

    def build(self) -> Any:
        """Return the load of ``apu_casadi.machine.loads.load``, in SI units."""
        from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
        from apu_casadi.machine.loads.open import OpenLoad
        from apu_casadi.machine.loads.series import SeriesLoad

        if self.kind == "open":
            return OpenLoad()
        if self.kind == "series":
            assert self.R_ohm is not None and self.L_mH is not None
            a, b, c = self.L_mH
            return SeriesLoad(R=self.R_ohm, L=(a / 1e3, b / 1e3, c / 1e3))
        assert self.power_kW is not None
        P = self.power_kW * 1e3
        if self.kind == "constant_power":
            assert self.lag_ms is not None
            return ConstantPowerLoad(P, tau=self.lag_ms / 1e3)
        pf = 1.0 if self.power_factor is None else self.power_factor
        return SeriesLoad.from_power(P, pf, unbalance=self.unbalance or (1.0, 1.0, 1.0))

    @property
    def label(self) -> str:
        """A few words for summaries and figures."""
        if self.kind == "open":
            return "open circuit"
        if self.kind == "series":
            return "2 × series R-L"
        words = f"2 × {self.power_kW:g} kW"
        if self.kind == "RL":
            words += f", pf {self.power_factor:g}"
        if self.kind == "constant_power":
            words += ", constant power"
        if self.unbalance and len(set(self.unbalance)) > 1:
            words += ", unbalanced"
        return words


@dataclass(frozen=True)
class FaultSpec:
    """A stator turn-to-turn short circuit; its severity is mu, k_rf and kappa together.

    Args:
        mu: shorted fraction of the turns of the phase, 0 < mu < 1.
        k_rf: fault resistance over the resistance of the shorted turns, >= 0.
        kappa: leakage partition, mu (full coupling, the default) to 1 (no mutual leakage).
        phase: ``a``, ``b`` or ``c``.

    Raises:
        ScenarioError: a value outside its range.
    """

    mu: float
    k_rf: float
    kappa: float | None = None
    phase: str = "a"

    def __post_init__(self) -> None:
        number(self.mu, "mu", lo=0.0, hi=0.99, open_lo=True)
        number(self.k_rf, "k_rf", lo=0.0)
        if self.kappa is not None:
            number(self.kappa, "kappa", lo=float(self.mu), hi=1.0)
        if self.phase not in _PHASES:
            raise _PlacedError(
                "phase", f"unknown {self.phase!r} {nearest(str(self.phase), _PHASES)}"
            )

    @classmethod
    def from_dict(cls, data: Any) -> Self:
        """Make a fault from a table; :class:`ScenarioError` for a wrong key or value."""
        keys = tuple(f.name for f in dataclasses.fields(cls))
        if not isinstance(data, Mapping):
            raise _PlacedError(
                "fault", f'a table with {", ".join(keys)}, or "none", is expected, got {data!r}'
            )
        table = _table(data, "fault", keys)
        with _inside("fault"):
            for k in ("mu", "k_rf"):
                _require(k in table, k, "missing: mu and k_rf are both needed for a severity")
            return cls(**table)

    def to_dict(self) -> dict[str, Any]:
        """Return the table that :meth:`from_dict` reads."""
        return {k: v for k, v in dataclasses.asdict(self).items() if v is not None}

    def build(self) -> Ttsc:
        """Return the fault of ``apu_casadi.machine.faults.ttsc``."""
        from apu_casadi.machine.faults.ttsc import Ttsc

        return Ttsc(mu=self.mu, k_rf=self.k_rf, kappa=self.kappa, phase=self.phase)


@dataclass(frozen=True)
class NoiseSpec:
    """Uncertainty added to a run, as standard deviations in SI units; zero where not given.

    Args:
        N: state noise of the shaft speed per exchange step [rad/s].
        w1, w2: voltage noise of stator and rotor equations [V].
        gas: measurement noise of gas-path outputs by name (``{"T3": 1.0}``).
        terminal: measurement noise sigma_i [A], sigma_v and sigma_V_fd [V].

    Raises:
        ScenarioError: an unknown name under ``terminal``, or a negative or non-finite value.
    """

    N: float = 0.0
    w1: float = 0.0
    w2: float = 0.0
    gas: Mapping[str, float] = field(default_factory=dict, hash=False)
    terminal: Mapping[str, float] | None = field(default=None, hash=False)

    def __post_init__(self) -> None:
        """Check every value; the names under ``gas`` are checked by the simulation."""
        for k in ("N", "w1", "w2"):
            number(getattr(self, k), k, lo=0.0)
        for k in ("gas", "terminal"):
            table = getattr(self, k)
            if k == "terminal" and table is None:
                continue
            names = _TERMINAL_NOISE if k == "terminal" else tuple(table)
            checked = {n: number(v, f"{k}.{n}", lo=0.0) for n, v in _table(table, k, names).items()}
            object.__setattr__(self, k, checked)

    @classmethod
    def from_dict(cls, data: Any) -> Self:
        """Make the noise from a table; :class:`ScenarioError` for a wrong key or value."""
        table = _table(data, "noise", tuple(f.name for f in dataclasses.fields(cls)))
        with _inside("noise"):
            return cls(**table)

    def to_dict(self) -> dict[str, Any]:
        """Return the table that :meth:`from_dict` reads."""
        return {k: v for k, v in dataclasses.asdict(self).items() if v is not None}

    def build(self) -> Any:
        """Return the noise of ``apu_casadi.unit.multirate``."""
        from apu_casadi.machine.measurement import MeasurementNoise
        from apu_casadi.unit.multirate import Noise

        terminal = None if self.terminal is None else MeasurementNoise(**self.terminal)
        return Noise(N=self.N, w1=self.w1, w2=self.w2, gas=self.gas, terminal=terminal)


_TERMINAL_NOISE = ("sigma_i", "sigma_v", "sigma_V_fd")

Health = Mapping[str, float] | Literal["none"]
Fault = FaultSpec | Literal["none"]


@dataclass(frozen=True)
class _Change:
    """What a phase or an event changes; None leaves as it is, ``"none"`` restores health."""

    load: LoadSpec | None = field(default=None, kw_only=True)
    health: Health | None = field(default=None, kw_only=True, hash=False)
    fault: Fault | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        if self.load is not None and not isinstance(self.load, LoadSpec):
            raise _PlacedError("load", f"a LoadSpec is expected, got {self.load!r}")
        if isinstance(self.health, Mapping):
            checked = health_factors(self.health)
            object.__setattr__(self, "health", MappingProxyType(checked))
        elif self.health not in (None, "none"):
            raise _PlacedError(
                "health", f'a table of factors, or "none", expected: {self.health!r}'
            )
        if not isinstance(self.fault, FaultSpec) and self.fault not in (None, "none"):
            raise _PlacedError("fault", f'a FaultSpec, or "none", is expected, got {self.fault!r}')

    def _changes(self) -> dict[str, Any]:
        table: dict[str, Any] = {}
        if self.load is not None:
            table["load"] = self.load.to_dict()
        if self.health is not None:
            table["health"] = self.health if self.health == "none" else dict(self.health)
        if self.fault is not None:
            table["fault"] = (
                self.fault.to_dict() if isinstance(self.fault, FaultSpec) else self.fault
            )
        return table


def _read_changes(table: dict[str, Any]) -> dict[str, Any]:
    made = dict(table)
    if "load" in table:
        made["load"] = LoadSpec.from_dict(table["load"])
    if "fault" in table and table["fault"] != "none":
        made["fault"] = FaultSpec.from_dict(table["fault"])
    return made


@dataclass(frozen=True)
class Phase(_Change):
    """A named part of the run, from ``start`` [s] to the start of the next phase.

    Args:
        name: a few words, for summaries and figures.
        start: instant [s] at which it begins and its changes take effect.
        load, health, fault: what changes then; None keeps what was.

    Raises:
        ScenarioError: an empty name, a negative start or a wrong change.
    """

    name: str
    start: float

    def __post_init__(self) -> None:
        _text(self.name, "name")
        object.__setattr__(self, "start", number(self.start, "start", lo=0.0, unit="s"))
        super().__post_init__()

    @classmethod
    def from_dict(cls, data: Any, place: str = "phase") -> Self:
        """Make a phase from a table; :class:`ScenarioError` for a wrong key or value."""
        table = _table(data, place, ("name", "start", "load", "health", "fault"))
        label = table.get("name")
        with _inside(place, f" (phase {label!r})" if isinstance(label, str) and label else ""):
            for k in ("name", "start"):
                _require(k in table, k, "missing")
            return cls(**_read_changes(table))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle through the tables, for process pools."""
        return type(self).from_dict, (self.to_dict(),)

    def to_dict(self) -> dict[str, Any]:
        """Return the table that :meth:`from_dict` reads."""
        return {"name": self.name, "start": self.start, **self._changes()}


@dataclass(frozen=True)
class Change(_Change):
    """A change at ``time`` [s] inside a phase (``[[event]]`` in a file).

    Raises:
        ScenarioError: a time that is not positive, no change at all, or a wrong change.
    """

    time: float

    def __post_init__(self) -> None:
        t = number(self.time, "time", lo=0.0, open_lo=True, unit="s")
        object.__setattr__(self, "time", t)
        super().__post_init__()
        if self.load is None and self.health is None and self.fault is None:
            raise _PlacedError("time", "nothing changes then: give load, health or fault")

    @classmethod
    def from_dict(cls, data: Any, place: str = "event") -> Self:
        """Make a change from a table; :class:`ScenarioError` for a wrong key or value."""
        table = _table(data, place, ("time", "load", "health", "fault"))
        with _inside(place):
            _require("time" in table, "time", "missing")
            return cls(**_read_changes(table))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle through the tables, for process pools."""
        return type(self).from_dict, (self.to_dict(),)

    def to_dict(self) -> dict[str, Any]:
        """Return the table that :meth:`from_dict` reads."""
        return {"time": self.time, **self._changes()}


@dataclass(frozen=True)
class Scenario:
    """A complete, checked description of one run.

    Args:
        name: short name, also that of the result files (letters, digits, ``_`` and ``-``).
        duration: end of the run [s], at most 3600.
        phases: at least one; the first starts at 0 and has a load.
        title, doc: one line, and more.
        ambient: ambient and flight conditions.
        changes: further changes inside the phases (``[[event]]`` in a file).
        dt: exchange step of the two parts [s]; a step before a change between two is shortened.
        waveform_dt: sampling step of the waveforms [s]; None for no waveforms (0 in a file).
        exchange: how speed and fuel pass between the two parts: ``paper``, ``predicted`` or
            ``corrected``, see :func:`apu_casadi.unit.multirate.simulate_joint`.
        noise: process and measurement noise; None for none.
        seed: seed of the noise.
        parameters: changed parameters of the unit, by dotted name (``machine.r_s``).

    Raises:
        ScenarioError: a wrong value; phases out of order or beyond the end.
    """

    name: str
    duration: float
    phases: tuple[Phase, ...]
    title: str = ""
    doc: str = ""
    ambient: Ambient = field(default_factory=Ambient)
    changes: tuple[Change, ...] = ()
    dt: float = 0.02
    waveform_dt: float | None = 50e-6
    exchange: str = "paper"
    noise: NoiseSpec | None = None
    seed: int | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        """Check every value and the order of what happens."""
        _text(self.name, "name")
        _require(
            _NAME.fullmatch(self.name) is not None,
            "name",
            f"only letters, digits, '_' and '-', beginning with a letter or digit: {self.name!r}",
        )
        _require(len(self.name) <= 100, "name", f"{len(self.name)} characters, 100 at most")
        put: Callable[[str, Any], None] = lambda n, v: object.__setattr__(self, n, v)  # noqa: E731
        _text(self.title, "title", empty=True)
        _text(self.doc, "doc", empty=True)
        _require(isinstance(self.ambient, Ambient), "ambient", f"got {self.ambient!r}")
        put("dt", number(self.dt, "dt", lo=1e-4, hi=0.2, unit="s"))
        end = number(self.duration, "duration", lo=0.0, hi=3600.0, open_lo=True, unit="s")
        put("duration", end)
        if self.waveform_dt is not None:
            step = number(self.waveform_dt, "waveform_dt", lo=1e-6, hi=self.dt, unit="s")
            put("waveform_dt", step)
            if abs(self.dt / step - round(self.dt / step)) > 1e-6:
                raise _PlacedError("waveform_dt", f"{step:g} s does not divide dt = {self.dt:g} s")
        _text(self.exchange, "exchange")
        if self.exchange not in EXCHANGES:
            raise _PlacedError(
                "exchange", f"unknown {self.exchange!r} {nearest(self.exchange, EXCHANGES)}"
            )
        if self.seed is not None:
            whole = isinstance(self.seed, int) and not isinstance(self.seed, bool)
            _require(whole and self.seed >= 0, "seed", f"a whole number >= 0, got {self.seed!r}")
        if self.noise is not None:
            _require(isinstance(self.noise, NoiseSpec), "noise", f"got {self.noise!r}")
        _require(
            isinstance(self.parameters, Mapping), "parameters", f"a table, got {self.parameters!r}"
        )
        checked = {k: _parameter(k, v) for k, v in self.parameters.items()}
        put("parameters", MappingProxyType(checked))
        self._check_order()

    def _check_order(self) -> None:
        for attribute, cls in (("phases", Phase), ("changes", Change)):
            items = getattr(self, attribute)
            ok = isinstance(items, list | tuple) and all(isinstance(p, cls) for p in items)
            _require(ok, attribute, f"a tuple of {cls.__name__} is expected, got {items!r}")
            object.__setattr__(self, attribute, tuple(items))
        _require(bool(self.phases), "phase", "at least one [[phase]] is needed")
        first = self.phases[0]
        if first.start != 0.0:
            raise _PlacedError(
                "phase[1].start",
                f"the first phase starts at 0 s, not at {first.start:g} s",
                f" (phase {first.name!r})",
            )
        if first.load is None:
            raise _PlacedError(
                "phase[1].load", "missing: the first phase needs a load", f" (phase {first.name!r})"
            )
        for i, p in enumerate(self.phases, 1):
            place, note = f"phase[{i}].start", f" (phase {p.name!r})"
            if i > 1 and p.start <= self.phases[i - 2].start:
                before = self.phases[i - 2]
                raise _PlacedError(
                    place,
                    f"{p.start:g} s is not after phase {before.name!r} at {before.start:g} s",
                    note,
                )
            if p.start >= self.duration:
                raise _PlacedError(
                    place,
                    f"{p.start:g} s is not before the end of the run at {self.duration:g} s",
                    note,
                )
            if any(q.name == p.name for q in self.phases[: i - 1]):
                raise _PlacedError(
                    f"phase[{i}].name", f"{p.name!r} is the name of an earlier phase"
                )
        taken = {(p.start, k) for p in self.phases for k in p._changes()}
        for i, c in enumerate(self.changes, 1):
            place = f"event[{i}].time"
            if c.time >= self.duration:
                raise _PlacedError(
                    place, f"{c.time:g} s is not before the end of the run at {self.duration:g} s"
                )
            for k in c._changes():
                if (c.time, k) in taken:
                    raise _PlacedError(
                        f"event[{i}].{k}", f"a second change of {k} at {c.time:g} s; keep one"
                    )
                taken.add((c.time, k))

    @classmethod
    def from_dict(cls, data: Any, source: str = "") -> Self:
        """Make a scenario from nested tables, as a TOML file gives them.

        Args:
            data: the tables; ``source`` : name of the file, for messages.

        Raises:
            ScenarioError: with the file, the place in it, and the nearest valid name.
        """
        try:
            return cls._from_dict(data)
        except ScenarioError as e:
            raise ScenarioError(f"{source}: {e}" if source else str(e)) from None

    @classmethod
    def _from_dict(cls, data: Any) -> Self:
        keys = (
            "name", "title", "doc", "duration", "phase", "event", "ambient", "dt", "waveform_dt",
            "exchange", "noise", "seed", "parameters",
        )  # fmt: skip
        if not isinstance(data, Mapping):
            raise ScenarioError(f"a table is expected, got {data!r}")
        for k in data:
            if k not in keys:
                raise ScenarioError(f"{k}: unknown key {nearest(str(k), keys)}")
        made = {k: v for k, v in data.items() if k not in ("phase", "event")}
        for k in ("name", "duration", "phase"):
            _require(k in data, k, "missing")
        for key, attribute, kind in (("phase", "phases", Phase), ("event", "changes", Change)):
            rows = data.get(key, ())
            _require(isinstance(rows, list | tuple), key, f"[[{key}]] tables expected: {rows!r}")
            made[attribute] = tuple(
                kind.from_dict(row, f"{key}[{i}]") for i, row in enumerate(rows, 1)
            )
        if "ambient" in data:
            names = tuple(f.name for f in dataclasses.fields(Ambient))
            table = _table(data["ambient"], "ambient", names)
            with _inside("ambient"):
                made["ambient"] = Ambient(**table)
        if "noise" in data:
            made["noise"] = NoiseSpec.from_dict(data["noise"])
        if data.get("waveform_dt") == 0 and not isinstance(data["waveform_dt"], bool):
            made["waveform_dt"] = None
        if "parameters" in data:
            _require(isinstance(data["parameters"], Mapping), "parameters", "a table is expected")
            made["parameters"] = dict(_flat(data["parameters"]))
        return cls(**made)

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Self:
        """Read a TOML file.

        Raises:
            ScenarioError: no such file, no TOML (with line and column), or a wrong key or value.
        """
        try:
            text = files.read_text(path, "scenario file", LARGEST_FILE)
        except DataError as e:
            raise ScenarioError(str(e)) from None
        return cls.from_toml_text(text, os.fspath(path))

    @classmethod
    def from_toml_text(cls, text: str, source: str = "") -> Self:
        """Read TOML text; ``source`` names it in messages.  Errors as :meth:`from_toml`."""
        try:
            data = tomllib.loads(text)
            return cls.from_dict(data, source)
        except tomllib.TOMLDecodeError as e:
            raise ScenarioError(f"{source or 'TOML'}: not valid TOML: {e}") from None
        except RecursionError:
            raise ScenarioError(f"{source or 'TOML'}: nested too deeply to be a scenario") from None
        except ScenarioError:
            raise
        except ValueError as e:  # a whole number of more digits than Python reads
            raise ScenarioError(f"{source or 'TOML'}: not valid TOML: {e}") from None

    @classmethod
    def from_python(cls, path: str | os.PathLike[str]) -> Scenario:
        """Run a Python file that defines ``scenario``, a :class:`Scenario` or its tables.

        The file is executed with your rights, like any program: run only what you trust.

        Raises:
            ScenarioError: no such file, an error inside it (with its line), or no ``scenario``.
        """
        path = Path(path)
        try:
            code = files.read_bytes(path, "scenario file", LARGEST_FILE)
        except DataError as e:
            raise ScenarioError(str(e)) from None
        scope: dict[str, Any] = {"__name__": "__scenario__", "__file__": str(path)}
        try:
            exec(compile(code, str(path), "exec"), scope)
        except KeyboardInterrupt:
            raise
        except ScenarioError as e:
            raise ScenarioError(f"{path}: {e}{_at_line(e, path)}") from e
        except BaseException as e:  # SystemExit too: it would pass for the end of the command
            said = str(e)
            if isinstance(e, SystemExit):
                said = f"the file ends the program, with status {e.code!r}; remove that"
            raise ScenarioError(f"{path}: {type(e).__name__}{_at_line(e, path)}: {said}") from e
        found = scope.get("scenario")
        if isinstance(found, Scenario):
            return found
        if isinstance(found, Mapping):
            return cls.from_dict(found, str(path))
        what = "defines no 'scenario'" if found is None else f"'scenario' is {found!r}"
        raise ScenarioError(f"{path}: {what}; a Scenario or a dictionary is expected")

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle through the tables, for process pools."""
        return type(self).from_dict, (self.to_dict(),)

    def to_dict(self) -> dict[str, Any]:
        """Return the tables that :meth:`from_dict` reads; only JSON and TOML types."""
        table: dict[str, Any] = {
            "name": self.name,
            "title": self.title,
            "doc": self.doc,
            "duration": self.duration,
            "dt": self.dt,
            "waveform_dt": 0 if self.waveform_dt is None else self.waveform_dt,
            "ambient": dataclasses.asdict(self.ambient),
            "phase": [p.to_dict() for p in self.phases],
        }
        if self.exchange != "paper":
            table["exchange"] = self.exchange
        if self.changes:
            table["event"] = [c.to_dict() for c in self.changes]
        if self.noise is not None:
            table["noise"] = self.noise.to_dict()
        if self.seed is not None:
            table["seed"] = self.seed
        if self.parameters:
            table["parameters"] = dict(self.parameters)
        return table

    def change(self, **values: Any) -> Self:
        """Return a copy with some attributes changed; ``parameters`` are added to the present ones.

        Raises:
            ScenarioError: unknown name (the nearest is named) or a wrong value.
        """
        names = [f.name for f in dataclasses.fields(self)]
        for n in values:
            if n not in names:
                raise ScenarioError(f"a scenario has no {n!r} {nearest(n, names)}")
        if isinstance(values.get("parameters"), Mapping):
            values["parameters"] = {**self.parameters, **values["parameters"]}
        return dataclasses.replace(self, **values)

    def phase_table(self) -> list[dict[str, Any]]:
        """Return the phases as name, start [s], end [s]: the ``phases`` of a dataset."""
        ends = [p.start for p in self.phases[1:]] + [self.duration]
        return [
            {"name": p.name, "start": p.start, "end": end}
            for p, end in zip(self.phases, ends, strict=True)
        ]

    def start(self) -> dict[str, Any]:
        """Return ``load``, ``health`` and ``fault`` at t = 0, as ``simulate_joint`` takes them."""
        first = self.phases[0]
        assert first.load is not None
        health = dict(first.health) if isinstance(first.health, Mapping) else None
        fault = first.fault.build() if isinstance(first.fault, FaultSpec) else None
        return {"load": first.load.build(), "health": health, "fault": fault}

    def events(self) -> tuple[Event, ...]:
        """Return the changes after t = 0 in order of time, as ``simulate_joint`` takes them.

        A health event holds all four factors, those of earlier phases included.
        """
        from apu_casadi.unit.events import FaultChange, HealthChange, LoadChange

        steps: list[tuple[float, _Change]] = [(p.start, p) for p in self.phases]
        steps += [(c.time, c) for c in self.changes]
        health = dict.fromkeys(HEALTH_FACTORS, 1.0)
        events: list[Event] = []
        for t, c in sorted(steps, key=lambda s: s[0]):
            if c.health is not None:
                new = dict.fromkeys(HEALTH_FACTORS, 1.0) if c.health == "none" else dict(c.health)
                health = {**health, **new}
            if t == 0.0:
                continue
            if c.load is not None:
                events.append(LoadChange(t, c.load.build()))
            if c.health is not None:
                events.append(HealthChange(t, dict(health)))
            if c.fault is not None:
                fault = c.fault.build() if isinstance(c.fault, FaultSpec) else None
                events.append(FaultChange(t, fault))
        return tuple(events)

    def to_json(self) -> str:
        """Return :meth:`to_dict` as JSON: the ``scenario`` attribute of a dataset."""
        return json.dumps(self.to_dict(), ensure_ascii=False)


def _at_line(e: BaseException, path: Path) -> str:
    """Return the innermost line of a file in a traceback, or of a syntax error, as words."""
    line = getattr(e, "lineno", None)
    tb = e.__traceback__
    while tb is not None:
        if tb.tb_frame.f_code.co_filename == str(path):
            line = tb.tb_lineno
        tb = tb.tb_next
    return f" at line {line}" if line else ""


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted names and values of nested tables: TOML reads ``a.b = 1`` as a nested table."""
    for k, v in table.items():
        name = f"{prefix}{k}"
        if isinstance(v, Mapping):
            _require(name.count(".") < 5, f"parameters.{name[:80]}", "nested too deeply")
            yield from _flat(v, f"{name}.")
        else:
            yield name, v


def _parameter(name: str, value: Any) -> float | str:
    """Return a parameter's value if it is a finite number or a word."""
    place = f"parameters.{name}"
    if isinstance(value, str):
        return value
    ok = isinstance(value, numbers.Real) and not isinstance(value, bool)
    _require(ok, place, f"a number is expected, got {reprlib.repr(value)}")
    plain: float = value.item() if hasattr(value, "item") else value
    _require(math.isfinite(plain), place, f"must be finite, got {value!r}")
    return plain
