"""Phases and events of a scenario: what changes, and when.

:mod:`scenarios.schema` has the scenario that they make up.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Literal, Self

from apu_casadi.core.profiles.profile import Profile, Varying
from apu_casadi.machine.faults.fault import Fault
from apu_casadi.machine.loads.load import Load
from apu_casadi.unit.events import health_factors, number_or_profile
from scenarios.reading import (
    FaultOf,
    PlacedError,
    check_numbers,
    inside,
    limits,
    names_of,
    number_of,
    read_faults,
    read_loads,
    read_profile,
    require,
    table_of,
    text_of,
)

Health = Mapping[str, Any] | Literal["none"]
OneLoad = Load | Varying[Load]


class Plain:
    """What goes to files as a table and to other processes by its fields."""

    def __reduce__(self) -> tuple[Any, ...]:
        values = {n: getattr(self, n) for n in names_of(self)}
        plain = {n: dict(v) if isinstance(v, MappingProxyType) else v for n, v in values.items()}
        return _made, (type(self), plain)


def _made(cls: Any, values: dict[str, Any]) -> Any:
    return cls(**values)


@dataclass(frozen=True)
class Changing(Plain):
    """What a phase or an event changes; None leaves as it is, ``"none"`` restores health.

    Args:
        load: electrical load of each generator, or a list with one for each.
        health: health factors of the gas path, 1 when healthy.
        fault: fault of all generators, or those of single ones (:func:`read_faults`).
        N_ref_rpm: speed of the rotor that the governor holds.
    """

    load: OneLoad | tuple[OneLoad, ...] | None = field(default=None, kw_only=True)
    health: Health | None = field(default=None, kw_only=True, hash=False)
    fault: Fault | Varying[Fault | None] | tuple[FaultOf, ...] | Literal["none"] | None = field(
        default=None, kw_only=True
    )
    N_ref_rpm: float | Profile | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        """Check the numbers; make load and fault of their tables."""
        check_numbers(self)
        if self.load is not None:
            ok = isinstance(self.load, Load | Varying | Mapping | list | tuple)
            require(ok, "load", f"a Load, or a table with kind, is expected, got {self.load!r}")
            object.__setattr__(self, "load", read_loads(self.load))
        if isinstance(self.health, Mapping):
            with inside("health"):
                given = {k: read_profile(v, str(k)) for k, v in self.health.items()}
            object.__setattr__(self, "health", MappingProxyType(health_factors(given)))
        elif self.health not in (None, "none"):
            text = f'a table of factors, or "none", expected: {self.health!r}'
            raise PlacedError("health", text)
        if self.fault is not None and self.fault != "none":
            object.__setattr__(self, "fault", read_faults(self.fault))
        if self.N_ref_rpm is not None:
            speed = read_profile(self.N_ref_rpm, "N_ref_rpm")
            speed = number_or_profile(speed, "N_ref_rpm", lo=0.0, open_lo=True, unit="r/min")
            object.__setattr__(self, "N_ref_rpm", speed)

    @classmethod
    def from_dict(cls, data: Any, place: str) -> Self:
        """Make it from a table; :class:`ScenarioError` for a wrong key or value."""
        own = [f.name for f in dataclasses.fields(cls) if not f.kw_only]
        table = table_of(data, place, names_of(cls))
        label = table.get("name")
        with inside(place, f" (phase {label!r})" if isinstance(label, str) and label else ""):
            for k in own:
                require(k in table, k, "missing")
            return cls(**table)

    def changes(self) -> dict[str, Any]:
        """Return what changes, as the table that files have."""
        table: dict[str, Any] = {}
        for name in CHANGES:
            value = getattr(self, name)
            if value is not None:
                table[name] = plain(value)
        return table

    def to_dict(self) -> dict[str, Any]:
        """Return the table that :meth:`from_dict` reads."""
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self) if not f.kw_only}
        return {**own, **self.changes()}

    def touched(self) -> Iterator[tuple[str, int | None]]:
        """Yield what changes, each with the number of a generator; None: of all, or the unit's."""
        for name in self.changes():
            value, k = getattr(self, name), getattr(self, "generator", None)
            single = name == "fault" and isinstance(value, tuple)
            yield from ((name, v.generator) for v in value) if single else [(name, k)]


CHANGES = tuple(f.name for f in dataclasses.fields(Changing))
"""What a phase or an event may change."""


def plain(value: Any) -> Any:
    """Return a value as files have it."""
    if isinstance(value, Mapping):
        return {k: plain(v) for k, v in value.items()}
    if type(value) is tuple:
        return [plain(v) for v in value]
    return value.to_table() if hasattr(value, "to_table") else value


@dataclass(frozen=True)
class Phase(Changing):
    """A named part of the run, from ``start`` to the start of the next phase.

    Args:
        name: a few words, for summaries and figures.
        start: instant at which it begins and its changes take effect.
        load, health, fault, N_ref_rpm: what changes then; None keeps what was.

    Raises:
        ScenarioError: an empty name, a negative start or a wrong change.
    """

    name: str
    start: float = field(metadata=limits(lo=0.0, unit="s"))

    def __post_init__(self) -> None:
        text_of(self.name, "name")
        super().__post_init__()


@dataclass(frozen=True)
class Change(Changing):
    """A change inside a phase (``[[event]]`` in a file).

    Args:
        time: instant at which it takes effect.
        load, health, fault, N_ref_rpm: what changes then.
        generator: number of the generator whose load and fault change; None: of all.

    Raises:
        ScenarioError: a time that is not positive, no change at all, or a wrong change.
    """

    time: float = field(metadata=limits(lo=0.0, open_lo=True, unit="s"))
    generator: int | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.generator is not None:
            number_of(self.generator, "generator")
            for name in ("load", "fault"):
                ok = not isinstance(getattr(self, name), tuple)
                require(ok, name, f"of several generators, in an event of {self.generator}")
            rest = set(self.changes()) - {"load", "fault"}
            text = f"no generator has {' and '.join(sorted(rest))}: give an event of its own"
            require(not rest, "generator", text)
        text = "nothing changes then: give load, health, fault or N_ref_rpm"
        require(bool(self.changes()), "time", text)

    def to_dict(self) -> dict[str, Any]:
        """Return the table that :meth:`from_dict` reads."""
        own = {} if self.generator is None else {"generator": self.generator}
        return super().to_dict() | own
