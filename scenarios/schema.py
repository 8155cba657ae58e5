"""A scenario: a small description of phases and events that is checked before anything runs.

A TOML file reads like this::

    name = "my_run"
    title = "Load drop, then a short circuit"
    duration = 6.0                      # s
    [[phase]]
    name = "full load"
    start = 0.0                         # s
    load = { kind = "R", power_kW = 225.0 }   # of each generator
    [[phase]]
    name = "TTSC"
    start = 3.0
    fault = { mu = 0.05, k_rf = 20.0, phase = "a" }
    [[event]]                           # a change inside a phase
    time = 4.0
    load = { kind = "RL", power_kW = 100.0, power_factor = 0.85 }

Generators may differ: ``load = [ {...}, {...} ]`` has one load for each, ``fault = { generator = 2,
... }`` or a list of such has faults of single ones, and an event with ``generator = 2`` is of that
one.  How many there are, and what they have different, ``[parameters]`` says: ``generator.count``,
``generator2.machine.r_s``.

A number of a load, a fault, the health, the day, and ``N_ref_rpm`` (r/min, of the governor) may be
a table: a profile of time (:mod:`apu_casadi.core.profiles.profile`), which begins with its phase or
event, as in ``health = { f_eta_c = { from = 1.0, to = 0.97, over = 60.0 } }`` or ``altitude =
{ file = "climb.csv" }``.

A phase keeps what it does not change; ``health = "none"`` and ``fault = "none"`` restore the
healthy state.  Optional tables: ``[ambient]`` (altitude [m], Mach, dT_isa [K], war),
``[parameters]`` (dotted names of the unit, as ``machine.r_s``) and ``[noise]`` (N, w1, w2, and the
tables gas and terminal).  Errors count phases and events from 1.

The values are the model's own objects; :mod:`scenarios.reading` makes them of their tables.
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
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self

from apu_casadi.core import files
from apu_casadi.core.checked import bounded
from apu_casadi.core.errors import DataError, ScenarioError, nearest
from apu_casadi.core.profiles.profile import Moved, Profile, Varying
from apu_casadi.core.units import RPM
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.unit.control import GOVERNORS
from apu_casadi.unit.events import (
    STARTS,
    Ambient,
    Event,
    FaultChange,
    HealthChange,
    LoadChange,
    SpeedChange,
)
from apu_casadi.unit.exchange import OFFERED
from apu_casadi.unit.shippedunits import is_name
from scenarios import extensions, units
from scenarios.phases import Change, Changing, Phase, Plain, plain
from scenarios.reading import (
    check_numbers,
    files_seen_from,
    inside,
    limits,
    load_parts,
    names_of,
    of_profiles,
    read_noise,
    require,
    table_of,
    text_of,
)

if TYPE_CHECKING:
    from apu_casadi.unit.apu import Apu
    from apu_casadi.unit.noise import Noise

LARGEST_FILE = 1 << 24
"""Largest scenario file, bytes."""
EXCHANGES = OFFERED
"""Exchanges of speed and fuel that a scenario may ask for."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")


# ------------------------------------------------------------------------------ scenario


@dataclass(frozen=True)
class Scenario(Plain):
    """A complete, checked description of one run.

    Args:
        name: short name, also that of the result files (letters, digits, ``_`` and ``-``).
        duration: end of the run.
        phases: at least one; the first starts at 0 and has a load.
        title: one line on what happens.
        doc: more on it.
        ambient: ambient and flight conditions.
        changes: further changes inside the phases (``[[event]]`` in a file).
        dt: exchange step of the two parts; a step before a change between two is shortened.
        waveform_dt: sampling step of the waveforms; None for no waveforms (0 in a file).
        exchange: how speed and fuel pass between the two parts: ``paper``, ``predicted`` or
            ``corrected``, see :func:`apu_casadi.unit.multirate.simulate_joint`.
        start_from: ``balanced``, where a fault or an unbalanced load of the start acts from t = 0
            on a healthy unit, or ``settled``, where it has been there for long.
        noise: process and measurement noise; None for none.
        seed: seed of the noise.
        parameters: changed parameters of the unit, by dotted name (``machine.r_s``).
        engine: file of another unit than the paper's, seen from the scenario's file, or the name of
            one that comes with the package.
        governor: name of another law than the PI law, short for the parameter ``governor.kind``;
            its numbers are parameters ``governor.*``.
        extensions: Python files that register parts which the scenario names, seen from its file.

    Raises:
        ScenarioError: a wrong value; phases out of order or beyond the end.
    """

    name: str
    duration: float = field(metadata=limits(lo=0.0, hi=3600.0, open_lo=True, unit="s"))
    phases: tuple[Phase, ...]
    title: str = ""
    doc: str = ""
    ambient: Ambient | Varying[Ambient] = field(default_factory=Ambient)
    changes: tuple[Change, ...] = ()
    dt: float = field(default=0.02, metadata=limits(lo=1e-4, hi=0.2, unit="s"))
    waveform_dt: float | None = field(default=50e-6, metadata=limits(lo=1e-6, unit="s"))
    exchange: str = "paper"
    start_from: str = "balanced"
    noise: Noise | None = field(default=None, hash=False)
    seed: int | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict, hash=False)
    engine: str | None = None
    governor: str | None = None
    extensions: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check every value and the order of what happens."""
        put = object.__setattr__
        put(self, "extensions", _paths(self.extensions))
        load_parts(self.extensions)  # before what follows may name their parts
        text_of(self.name, "name")
        only = "only letters, digits, '_' and '-', beginning with a letter or digit"
        require(_NAME.fullmatch(self.name) is not None, "name", f"{only}: {self.name!r}")
        require(len(self.name) <= 100, "name", f"{len(self.name)} characters, 100 at most")
        text_of(self.title, "title", empty=True)
        text_of(self.doc, "doc", empty=True)
        check_numbers(self)
        if self.waveform_dt is not None:
            bounded(self.waveform_dt, "waveform_dt", lo=1e-6, hi=self.dt, unit="s")
            steps = self.dt / self.waveform_dt
            text = f"{self.waveform_dt:g} s does not divide dt = {self.dt:g} s"
            require(abs(steps - round(steps)) <= 1e-6, "waveform_dt", text)
        text_of(self.exchange, "exchange")
        hint = f"unknown {self.exchange!r} {nearest(self.exchange, EXCHANGES)}"
        require(self.exchange in EXCHANGES, "exchange", hint)
        hint = f"unknown {self.start_from!r} {nearest(str(self.start_from), STARTS)}"
        require(self.start_from in STARTS, "start_from", hint)
        if self.seed is not None:
            whole = isinstance(self.seed, int) and not isinstance(self.seed, bool)
            require(whole and self.seed >= 0, "seed", f"a whole number >= 0, got {self.seed!r}")
        if not isinstance(self.ambient, Ambient | Varying):
            table = table_of(self.ambient, "ambient", names_of(Ambient))
            with inside("ambient"):
                put(self, "ambient", of_profiles(Ambient, table) or Ambient(**table))
        if self.noise is not None:
            put(self, "noise", read_noise(self.noise))
        is_table = isinstance(self.parameters, Mapping)
        require(is_table, "parameters", f"a table is expected, got {self.parameters!r}")
        checked = {k: _parameter(k, v) for k, v in _flat(self.parameters)}
        put(self, "parameters", MappingProxyType(checked))
        if self.engine is not None:
            engine = text_of(self.engine, "engine")
            put(self, "engine", engine if is_name(engine) else os.path.abspath(engine))
        if self.governor is not None:
            hint = f"unknown {self.governor!r} {nearest(str(self.governor), GOVERNORS)}"
            require(self.governor in GOVERNORS, "governor", hint)
            kind = checked.get("governor.kind", self.governor)
            hint = f"{self.governor!r}, but parameters.governor.kind is {kind!r}; keep one"
            require(kind == self.governor, "governor", hint)
        put(self, "phases", _each("phase", Phase, self.phases))
        put(self, "changes", _each("event", Change, self.changes))
        self._check_phases()
        self._check_changes()

    def _check_phases(self) -> None:
        require(bool(self.phases), "phase", "at least one [[phase]] is needed")
        first = self.phases[0]
        note = f" (phase {first.name!r})"
        late = f"the first phase starts at 0 s, not at {first.start:g} s"
        require(first.start == 0.0, "phase[1].start", late, note)
        has = first.load is not None
        require(has, "phase[1].load", "missing: the first phase needs a load", note)
        names: list[str] = []
        for i, p in enumerate(self.phases, 1):
            place, note = f"phase[{i}].start", f" (phase {p.name!r})"
            if i > 1:
                before = self.phases[i - 2]
                text = f"{p.start:g} s is not after phase {before.name!r} at {before.start:g} s"
                require(p.start > before.start, place, text, note)
            require(p.start < self.duration, place, self._beyond(p.start), note)
            text = f"{p.name!r} is the name of an earlier phase"
            require(p.name not in names, f"phase[{i}].name", text)
            names.append(p.name)

    def _check_changes(self) -> None:
        taken = [(p.start, *of) for p in self.phases for of in p.touched()]
        for i, c in enumerate(self.changes, 1):
            require(c.time < self.duration, f"event[{i}].time", self._beyond(c.time))
            for name, k in c.touched():
                of = "" if k is None else f" of generator {k}"
                text = f"a second change of {name}{of} at {c.time:g} s; keep one"
                same = [j for t, n, j in taken if (t, n) == (c.time, name)]
                ok = all(None not in (j, k) and j != k for j in same)
                require(ok, f"event[{i}].{name}", text)
            taken += [(c.time, *of) for of in c.touched()]
        self._check_generators(len(self._unit().machines) if self._own else 2)

    @property
    def _own(self) -> bool:
        """Whether its unit is another one than the default."""
        return bool(self.engine or self.governor or self.parameters)

    def _unit(self) -> Apu:
        return units.checked(self.engine, self.governor, self.parameters)

    def _check_generators(self, n: int) -> None:
        """Refuse loads and faults of generators that a unit of ``n`` has not."""
        parts: list[tuple[str, Phase | Change]] = [
            *((f"phase[{i}]", p) for i, p in enumerate(self.phases, 1)),
            *((f"event[{i}]", c) for i, c in enumerate(self.changes, 1)),
        ]
        for place, c in parts:
            note = f" (phase {c.name!r})" if isinstance(c, Phase) else ""
            if isinstance(c.load, tuple):
                text = f"{len(c.load)} loads, but the unit has {n} generators"
                require(len(c.load) == n, f"{place}.load", text, note)
            for name, k in c.touched():
                text = f"generator {k}, but the unit has 1 to {n}"
                require(k is None or k <= n, f"{place}.{name}", text, note)

    def _beyond(self, t: float) -> str:
        return f"{t:g} s is not before the end of the run at {self.duration:g} s"

    # -- reading ---------------------------------------------------------------------------------

    @classmethod
    def from_dict(
        cls,
        data: Any,
        source: str = "",
        *,
        folder: str | os.PathLike[str] | None = None,
        instead: Mapping[str, Any] = MappingProxyType({}),
    ) -> Self:
        """Make a scenario from nested tables, as a TOML file gives them.

        Args:
            data: the tables.
            source: name of the file, for messages.
            folder: from which the files that it names are seen; the current one if not given.
            instead: attributes that go before the tables': another engine, another governor.

        Raises:
            ScenarioError: with the file, the place in it, and the nearest valid name.
        """
        try:
            if not isinstance(data, Mapping):
                raise ScenarioError(f"a table is expected, got {data!r}")
            made = table_of(data, "", FILE_KEYS)
            for k in ("name", "duration", "phase"):
                require(k in data, k, "missing")
            made |= {v: made.pop(k) for k, v in _FILE_NAMES.items() if k in made}
            if made.get("waveform_dt") == 0 and not isinstance(made["waveform_dt"], bool):
                made["waveform_dt"] = None
            if folder is not None:
                _seen_from(Path(folder), made)
            return cls(**made | dict(instead))
        except ScenarioError as e:
            raise ScenarioError(f"{source}: {e}" if source else str(e)) from None

    @classmethod
    def from_toml(
        cls, path: str | os.PathLike[str], instead: Mapping[str, Any] = MappingProxyType({})
    ) -> Self:
        """Read a TOML file; ``instead`` as in :meth:`from_dict`.

        Raises:
            ScenarioError: no such file, no TOML (with line and column), or a wrong key or value.
        """
        try:
            text = files.read_text(path, "scenario file", LARGEST_FILE)
        except DataError as e:
            raise ScenarioError(str(e)) from None
        folder = Path(path).parent
        return cls.from_toml_text(text, os.fspath(path), folder=folder, instead=instead)

    @classmethod
    def from_toml_text(
        cls,
        text: str,
        source: str = "",
        *,
        folder: str | os.PathLike[str] | None = None,
        instead: Mapping[str, Any] = MappingProxyType({}),
    ) -> Self:
        """Read TOML text; arguments as :meth:`from_dict`, errors as :meth:`from_toml`."""
        try:
            data = tomllib.loads(text)
            return cls.from_dict(data, source, folder=folder, instead=instead)
        except RecursionError:
            raise ScenarioError(f"{source or 'TOML'}: nested too deeply to be a scenario") from None
        except ScenarioError:
            raise
        except ValueError as e:  # also a whole number of more digits than Python reads
            raise ScenarioError(f"{source or 'TOML'}: not valid TOML: {e}") from None

    @classmethod
    def from_python(
        cls, path: str | os.PathLike[str], instead: Mapping[str, Any] = MappingProxyType({})
    ) -> Scenario:
        """Run a Python file that defines ``scenario``, a :class:`Scenario` or its tables.

        The file is executed with your rights, like any program: run only what you trust.

        Raises:
            ScenarioError: no such file, an error inside it (with its line), or no ``scenario``.
        """
        found = extensions.execute(path, "__scenario__", "scenario file").get("scenario")
        if isinstance(found, Scenario):
            return found.change(**instead)
        if isinstance(found, Mapping):
            return cls.from_dict(found, str(path), folder=Path(path).parent, instead=instead)
        what = "defines no 'scenario'" if found is None else f"'scenario' is {found!r}"
        raise ScenarioError(f"{path}: {what}; a Scenario or a dictionary is expected")

    # -- writing ---------------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Return the tables that :meth:`from_dict` reads; only JSON and TOML types."""
        table: dict[str, Any] = {n: getattr(self, n) for n in ("name", "title", "doc", "duration")}
        table |= {"dt": self.dt, "waveform_dt": self.waveform_dt or 0}
        still = isinstance(self.ambient, Ambient)
        table |= {"ambient": dataclasses.asdict(self.ambient) if still else plain(self.ambient)}
        table |= {"phase": [p.to_dict() for p in self.phases]}
        if self.exchange != "paper":
            table["exchange"] = self.exchange
        if self.start_from != "balanced":
            table["start_from"] = self.start_from
        noise = {} if self.noise is None else dataclasses.asdict(self.noise)
        more = {
            "event": [c.to_dict() for c in self.changes],
            "noise": {k: v for k, v in noise.items() if v is not None},
            "seed": self.seed,
            "parameters": dict(self.parameters),
            "engine": self.engine,
            "governor": self.governor,
            "extensions": list(self.extensions),
        }
        return table | {k: v for k, v in more.items() if v not in (None, [], {})}

    def to_json(self) -> str:
        """Return :meth:`to_dict` as JSON: the ``scenario`` attribute of a dataset."""
        return json.dumps(self.to_dict(), ensure_ascii=False)

    def change(self, **values: Any) -> Self:
        """Return a copy with some attributes changed; ``parameters`` are added to the present ones.

        Raises:
            ScenarioError: unknown name (the nearest is named) or a wrong value.
        """
        names = names_of(self)
        for n in values:
            if n not in names:
                raise ScenarioError(f"a scenario has no {n!r} {nearest(n, names)}")
        if isinstance(values.get("parameters"), Mapping):
            values["parameters"] = {**self.parameters, **values["parameters"]}
        return dataclasses.replace(self, **values)

    # -- what a run takes --------------------------------------------------------------------------

    def phase_table(self) -> list[dict[str, Any]]:
        """Return the phases as name, start [s], end [s]: the ``phases`` of a dataset."""
        ends = [p.start for p in self.phases[1:]] + [self.duration]
        return [
            {"name": p.name, "start": p.start, "end": end}
            for p, end in zip(self.phases, ends, strict=True)
        ]

    def start(self) -> dict[str, Any]:
        """Return what holds at t = 0, as ``simulate_joint`` takes it."""
        first = self.phases[0]
        health = dict(first.health) if isinstance(first.health, Mapping) else None
        N_ref = None if first.N_ref_rpm is None else _rad_s(first.N_ref_rpm)
        fault = _there(first.fault)
        if isinstance(fault, tuple):
            fault = {f.generator: f.fault for f in fault}
        start = {"load": first.load, "health": health, "fault": fault}
        start |= {} if self.start_from == "balanced" else {"start_from": self.start_from}
        return start if N_ref is None else {**start, "N_ref": N_ref}

    def events(self) -> tuple[Event, ...]:
        """Return the changes after t = 0 in order of time, as ``simulate_joint`` takes them.

        A health event holds all four factors, those of earlier phases included.
        """
        steps: list[tuple[float, Changing]] = [(p.start, p) for p in self.phases]
        steps += [(c.time, c) for c in self.changes]
        health = healthy = dict.fromkeys(HEALTH, 1.0)
        events: list[Event] = []
        for t, c in sorted(steps, key=lambda s: s[0]):
            if c.health is not None:
                health = {**health, **(healthy if c.health == "none" else c.health)}
            if t == 0.0:
                continue
            if isinstance(c.load, tuple):
                events += [LoadChange(t, x, k) for k, x in enumerate(c.load, 1)]
            elif c.load is not None:
                events.append(LoadChange(t, c.load, getattr(c, "generator", None)))
            if c.health is not None:
                events.append(HealthChange(t, dict(health)))
            if isinstance(c.fault, tuple):
                events += [FaultChange(t, _there(f.fault), f.generator) for f in c.fault]
            elif c.fault is not None:
                events.append(FaultChange(t, _there(c.fault), getattr(c, "generator", None)))
            if c.N_ref_rpm is not None:
                events.append(SpeedChange(t, _rad_s(c.N_ref_rpm)))
        return tuple(events)


_FILE_NAMES = {"phase": "phases", "event": "changes"}
FILE_KEYS = tuple(
    {v: k for k, v in _FILE_NAMES.items()}.get(name, name) for name in names_of(Scenario)
)
"""Keys of a scenario file; the attributes of :class:`Scenario`, but for phase and event."""


def _there(fault: Any) -> Any:
    return None if isinstance(fault, str) else fault


def _rad_s(rpm: float | Profile) -> float | Profile:
    return Moved(rpm, factor=1.0 / RPM) if isinstance(rpm, Profile) else rpm / RPM


def _each(key: str, cls: type[Changing], rows: Any) -> tuple[Any, ...]:
    """Return phases or events, made of their tables where they are such."""
    ok = isinstance(rows, list | tuple)
    require(ok, key, f"[[{key}]] tables expected: {rows!r}")
    return tuple(
        row if isinstance(row, cls) else cls.from_dict(row, f"{key}[{i}]")
        for i, row in enumerate(rows, 1)
    )


def _paths(value: Any) -> tuple[str, ...]:
    """Return the files of ``extensions`` as absolute paths, which other processes understand."""
    place = "extensions"
    ok = isinstance(value, list | tuple) and all(isinstance(v, str) and v for v in value)
    require(ok, place, f"a list of file names is expected, got {value!r}")
    return tuple(dict.fromkeys(os.path.abspath(v) for v in value))


def _seen_from(folder: Path, made: dict[str, Any]) -> None:
    """Turn the names of files in a scenario's tables, which are seen from its folder, to paths."""
    if isinstance(made.get("extensions"), list | tuple):
        made["extensions"] = [
            str(folder / v) if isinstance(v, str) and v else v for v in made["extensions"]
        ]
    engine = made.get("engine")
    if isinstance(engine, str) and engine and ((folder / engine).exists() or not is_name(engine)):
        made["engine"] = str(folder / engine)
    for part in ("ambient", "phases", "changes"):
        if part in made:
            made[part] = files_seen_from(folder, made[part])


def _flat(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted names and values of nested tables: TOML reads ``a.b = 1`` as a nested table."""
    for k, v in table.items():
        name = f"{prefix}{k}"
        if isinstance(v, Mapping):
            require(name.count(".") < 5, f"parameters.{name[:80]}", "nested too deeply")
            yield from _flat(v, f"{name}.")
        else:
            yield name, v


def _parameter(name: str, value: Any) -> float | str:
    """Return a parameter's value if it is a finite number or a word."""
    place = f"parameters.{name}"
    if isinstance(value, str):
        return value
    ok = isinstance(value, numbers.Real) and not isinstance(value, bool)
    require(ok, place, f"a number is expected, got {reprlib.repr(value)}")
    plain: float = value.item() if hasattr(value, "item") else value
    require(math.isfinite(plain), place, f"must be finite, got {value!r}")
    return plain
