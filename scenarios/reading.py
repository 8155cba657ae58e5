"""How the tables of a scenario file are read: checks that know their place, and the model's parts.

What a load or a fault may say in a file is told by its class (``tables``, ``keys``); nothing here
knows one by name.  An error begins with the place, as in ``phase[2].load.power_kW``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from apu_casadi.core.checked import bounded
from apu_casadi.core.errors import ApuError, ScenarioError, nearest
from apu_casadi.core.profiles.profile import Profile, Varying, profile_from_table
from apu_casadi.core.units import split_unit, unit_of
from apu_casadi.gaspath.conditions import CONDITIONS
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.faults.fault import FAULTS, Fault, fault_from_table, fault_of
from apu_casadi.machine.loads.load import LOADS, Load, load_from_table, load_of
from apu_casadi.unit.events import MOST
from scenarios import extensions

if TYPE_CHECKING:
    from apu_casadi.unit.noise import Noise

_ONE_LOAD = "(give a list with a load for each generator, or an [[event]] with generator)"
STEADY = (
    "a number that does not change in time is expected, got a table with {}; profiles are for the "
    "numbers of load, fault, health and ambient, and for N_ref_rpm"
)
"""Words for a table, with its keys, where a number is wanted."""
DEFAULT_FAULT = "ttsc"
"""Kind of a fault whose table names none."""


class PlacedError(ScenarioError):
    """A scenario error that knows its place, so that the callers can prefix theirs."""

    place: str
    message: str
    note: str

    def __init__(self, place: str, message: str, note: str = "") -> None:
        super().__init__(f"{place}: {message}{note}")
        self.place, self.message, self.note = place, message, note


@contextmanager
def inside(part: str, note: str = "") -> Iterator[None]:
    """Prefix the place of an error raised inside the block."""
    try:
        yield
    except PlacedError as e:
        raise PlacedError(f"{part}.{e.place}", e.message, e.note or note) from None
    except ScenarioError as e:  # "place: message", from the model's own checks
        place, _, message = str(e).partition(": ")
        raise PlacedError(f"{part}.{place}", message, note) from None
    except ApuError as e:
        raise PlacedError(part, str(e), note) from None


def require(ok: bool, place: str, message: str, note: str = "") -> None:
    """Raise :class:`PlacedError` unless ``ok``."""
    if not ok:
        raise PlacedError(place, message, note)


def text_of(value: Any, place: str, *, empty: bool = False) -> str:
    """Return a text that is not empty, unless it may be."""
    require(isinstance(value, str), place, f"a text is expected, got {value!r}")
    require(empty or bool(value.strip()), place, "must not be empty")
    return str(value)


def table_of(value: Any, place: str, keys: Sequence[str]) -> dict[str, Any]:
    """Return a table whose keys are all in ``keys``."""
    require(isinstance(value, Mapping), place, f"a table is expected, got {value!r}")
    for k in value:
        if k not in keys:
            hint = nearest(str(k), keys) if keys else ""
            raise PlacedError(f"{place}.{k}" if place else str(k), f"unknown key {hint}")
    return dict(value)


def limits(**how: Any) -> dict[str, Any]:
    """Return the metadata of a field that is a number, from the limits of :func:`bounded`."""
    return {"unit": "", **how}


def check_numbers(checked: Any) -> None:
    """Check the fields that have :func:`limits`; one whose type says so may be None."""
    for f in dataclasses.fields(checked):
        value = getattr(checked, f.name)
        if isinstance(value, Mapping) and "unit" in f.metadata:
            raise PlacedError(f.name, STEADY.format(", ".join(map(str, value)) or "no key"))
        if "unit" in f.metadata and not (value is None and "None" in f.type):
            object.__setattr__(checked, f.name, bounded(value, f.name, **f.metadata))


def names_of(cls: Any) -> tuple[str, ...]:
    """Return the fields of a dataclass by name."""
    return tuple(f.name for f in dataclasses.fields(cls))


def load_parts(paths: Collection[str]) -> None:
    """Run the Python files of a user, after the shipped parts: whose name is taken is told there.

    Raises:
        ScenarioError: no such file, or an error inside it, with its line.
    """
    if paths:
        assert len(LOADS) and len(FAULTS)  # asking imports them
        extensions.load(paths)


def read_profile(value: Any, place: str) -> Any:
    """Return the profile that a table describes; what is no table is returned as it is.

    Raises:
        ScenarioError: no profile, or a wrong key or value of one; or a file that is wrong.
    """
    if not isinstance(value, Mapping):
        return value
    with inside(place):
        return profile_from_table(value, place, unit=_unit(place))


def _unit(key: str) -> str:
    """Return the unit of a key of a scenario file: of the day, of loads and faults; "" if none."""
    own = split_unit(key, lambda name: name != key)
    if own is not None:  # power_kW, N_ref_rpm
        return own[1]
    if key in CONDITIONS:
        return CONDITIONS[key].unit
    if key in HEALTH:
        return "1"
    loads = (k for c in LOADS.classes for keys in c.tables.values() for k in keys)
    every = (*loads, *(k for c in FAULTS.classes for k in c.keys))
    return next((k.unit for k in every if k.name == key and unit_of(k.unit)), "")


def files_seen_from(folder: Path, value: Any) -> Any:
    """Return tables with the files of their profiles seen from a folder."""
    if isinstance(value, list):
        return [files_seen_from(folder, v) for v in value]
    if not isinstance(value, Mapping):
        return value
    table = {k: files_seen_from(folder, v) for k, v in value.items()}
    if isinstance(table.get("file"), str) and table["file"]:
        table["file"] = str(folder / table["file"])
    return table


def of_profiles(made_of: Any, table: Mapping[str, Any]) -> Any:
    """Return what changes in time if there are profiles among the values, else None.

    Its values are checked at the bounds of each profile.
    """
    table = {k: read_profile(v, k) for k, v in table.items()}
    changing = {k for k, v in table.items() if isinstance(v, Profile)}
    if not changing:
        return None
    plain = {k: tuple(v) if isinstance(v, list) else v for k, v in table.items()}
    return Varying(made_of, tuple(plain.items())).check()


def read_load(data: Any, place: str = "load") -> Load | Varying[Load]:
    """Return the load that a table describes by ``kind`` and the keys of that kind.

    A value that is a table itself is a profile, and the load one that changes in time.

    Raises:
        ScenarioError: an unknown kind, a key that it does not take or lacks, a wrong value.
    """
    if isinstance(data, Load | Varying):
        return data
    with inside(place):
        require(isinstance(data, Mapping), "kind", f"missing: a table is expected: {data!r}")
        kind = _kind(data, LOADS)
        every = {k.name for c in LOADS.classes for keys in c.tables.values() for k in keys}
        takes = ("kind", *(k.name for k in LOADS[kind].tables[kind]))
        for k in data:
            hint = nearest(str(k), takes) if k != "generator" else _ONE_LOAD
            require(k in every or k in takes, str(k), f"unknown key {hint}")
        return of_profiles(load_of, data) or load_from_table(data)


def read_fault(data: Any, place: str = "fault") -> Fault | Varying[Fault | None]:
    """Return the fault that a table describes; without ``kind`` it is a turn-to-turn short circuit.

    A value that is a table itself is a profile, and the fault one that changes in time.

    Raises:
        ScenarioError: an unknown kind, a key that it does not take or lacks, a wrong value.
    """
    if isinstance(data, Fault | Varying):
        return data
    if not isinstance(data, Mapping):
        names = ", ".join(k.name for k in FAULTS[DEFAULT_FAULT].keys)
        text = f'a table with {names}, or "none", is expected, got {data!r}'
        raise PlacedError(place, text)
    with inside(place):
        healed = 'healthy again is fault = "none", of one generator with its number beside kind'
        require(data.get("kind") != "none", "kind", healed)
        kind = FAULTS[_kind(data, FAULTS, DEFAULT_FAULT)]
        other = {n: k.name for n, k in kind.instead.items()}
        for k in data:
            takes = ("kind", *(key.name for key in kind.keys), *other.values())
            hint = nearest(str(k), (*takes, "generator"))
            hint = "(no single generator is meant here: leave it out)" if k == "generator" else hint
            require(k in takes, str(k), f"unknown key {hint}")
        needed = [k.name for k in kind.keys if k.default is ...]
        for n in needed:
            both = f"{' and '.join(needed)} are both needed for a severity"
            there = n in data or other.get(n) in data
            require(there, n, f"missing: {both if len(needed) == 2 else 'needed'}")
        return of_profiles(fault_of, data) or fault_from_table(data, DEFAULT_FAULT)


def _kind(data: Mapping[str, Any], known: Mapping[str, Any], default: str | None = None) -> str:
    if default is None:
        require("kind" in data, "kind", f"missing: one of {', '.join(known)}")
    kind = text_of(data.get("kind", default), "kind")
    require(kind in known, "kind", f"unknown {kind!r} {nearest(kind, known)}")
    return kind


class FaultOf(NamedTuple):
    """The fault of one generator, or None: it is healthy."""

    generator: int
    fault: Fault | Varying[Fault | None] | None

    def to_table(self) -> dict[str, Any]:
        """Return the table that :func:`read_faults` reads."""
        own = {"kind": "none"} if self.fault is None else self.fault.to_table()
        return {"generator": self.generator, **own}


def number_of(value: Any, place: str) -> int:
    """Return the number of a generator."""
    whole = isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= MOST
    require(whole, place, f"the number of a generator, 1 to {MOST}, is expected, got {value!r}")
    return int(value)


def read_loads(data: Any) -> Any:
    """Return the load of all generators, or a tuple with one for each where a list is given.

    Raises:
        ScenarioError: as :func:`read_load`, or an empty list or one that is too long.
    """
    if not isinstance(data, list | tuple):
        return read_load(data)
    n = len(data)
    require(1 <= n <= MOST, "load", f"1 to {MOST} loads, one for each generator, got {n}")
    return tuple(read_load(each, f"load[{i}]") for i, each in enumerate(data, 1))


def read_faults(data: Any) -> Any:
    """Return the fault of all generators, or those of single ones, each a :class:`FaultOf`.

    Args:
        data: a fault or its table; one with ``generator``, or a list of such; in Python also a
            mapping by number of the generator.

    Raises:
        ScenarioError: as :func:`read_fault`, or two faults of one generator.
    """
    if isinstance(data, Mapping) and data and all(isinstance(k, int) for k in data):
        rows: list[Any] = [FaultOf(k, v) for k, v in data.items()]
    elif isinstance(data, list | tuple):
        rows = list(data)
    elif isinstance(data, Mapping) and "generator" in data:
        rows = [data]
    else:
        return read_fault(data)
    require(bool(rows), "fault", "an empty list")
    one = len(rows) == 1 and isinstance(data, Mapping)
    found: dict[int, FaultOf] = {}
    for i, row in enumerate(rows, 1):
        place = "fault" if one else f"fault[{i}]"
        made = _fault_of(row, place)
        twice = f"generator {made.generator} has a fault already; a machine has one at a time"
        require(made.generator not in found, f"{place}.generator", twice)
        found[made.generator] = made
    return tuple(found[k] for k in sorted(found))


def _fault_of(row: Any, place: str) -> FaultOf:
    if isinstance(row, FaultOf):
        k, fault = number_of(row.generator, f"{place}.generator"), row.fault
        healthy = fault is None or isinstance(fault, str)
        return FaultOf(k, None if healthy else read_fault(fault, place))
    if isinstance(row, Mapping) and "generator" not in row:
        read_fault(row, place)  # it may be misspelt, which this tells
    missing = "missing: which generator has it? Without a list, a fault is of all"
    require(isinstance(row, Mapping) and "generator" in row, f"{place}.generator", missing)
    own = {k: v for k, v in row.items() if k != "generator"}
    number = number_of(row["generator"], f"{place}.generator")
    if own.get("kind") == "none":
        rest = [str(k) for k in own if k != "kind"]
        kinds = (
            f"a generator without fault takes no more keys; kinds with some: {', '.join(FAULTS)}"
        )
        require(not rest, f"{place}.{'.'.join(rest[:1])}", kinds)
        return FaultOf(number, None)
    return FaultOf(number, read_fault(own, place))


def read_noise(data: Any) -> Noise:
    """Return the noise that a table describes, standard deviations in SI units.

    Raises:
        ScenarioError: an unknown name, or a value that is negative or not finite.
    """
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from apu_casadi.machine.measurement import MeasurementNoise
    from apu_casadi.unit.noise import Noise

    if isinstance(data, Noise):
        return data
    table = table_of(data, "noise", names_of(Noise))
    with inside("noise"):
        parts = {k: table.pop(k) for k in ("gas", "terminal") if table.get(k) is not None}
        made: dict[str, Any] = {k: bounded(v, k, lo=0.0) for k, v in table.items() if v is not None}
        for k, part in parts.items():
            if isinstance(part, MeasurementNoise):
                part = dataclasses.asdict(part)
            known = names_of(MeasurementNoise) if k == "terminal" else GasGenerator.Y.names
            checked = table_of(part, k, known).items()
            made[k] = {n: bounded(v, f"{k}.{n}", lo=0.0) for n, v in checked}
        if "terminal" in made:
            made["terminal"] = MeasurementNoise(**made["terminal"])
        return Noise(**made)
