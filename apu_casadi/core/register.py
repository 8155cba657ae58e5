"""Registers: which class a name stands for, and what a table of a file must hold for it.

A kind of load, fault, sensor or governor is one class in one file, with ``@LOADS.add("RC")`` above
it; nothing else lists it.  What files say of it is declared by :class:`Key`, once, for reading,
for messages and for a schema.
"""

from __future__ import annotations

import pkgutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Generic, TypeVar

from apu_casadi.core.checked import bounded
from apu_casadi.core.errors import ParameterError, ScenarioError, nearest

T = TypeVar("T")
C = TypeVar("C")


class Register(Mapping[str, T], Generic[T]):
    """Names and what they stand for, in the order in which they were added.

    Args:
        what: noun for messages.
        package: folder whose modules all enter what they have; imported when first asked.
    """

    def __init__(self, what: str, package: str = "") -> None:
        self.what = what
        self._package = package
        self._added: dict[str, T] = {}

    @property
    def _entries(self) -> dict[str, T]:
        if self._package:
            package, self._package = self._package, ""
            for module in pkgutil.iter_modules(import_module(package).__path__):
                import_module(f"{package}.{module.name}")
        return self._added

    def add(self, *names: str) -> Callable[[C], C]:
        """Return a decorator that enters a class or function under the names.

        Raises:
            ParameterError: a name that stands for something else.  What is defined again in the
                same place, as in a notebook's cell, replaces what it was.
        """

        def enter(entry: C) -> C:
            for name in names:
                old: Any = self._added.get(name)
                if old is not None and _place(old) != _place(entry):
                    raise ParameterError(f"{self.what} {name!r} is taken by {old.__qualname__}")
                self._added[name] = entry  # type: ignore[assignment]
            return entry

        return enter

    def __getitem__(self, name: str) -> T:
        try:
            return self._entries[name]
        except KeyError:
            text = f"unknown {self.what} {name!r} {nearest(str(name), self._entries)}"
            raise ParameterError(text) from None

    def of_kind(self, kind: str) -> T:
        """Return what the ``kind`` of a file's table stands for.

        Raises:
            ScenarioError: an unknown one; the text starts with the key.
        """
        try:
            return self[kind]
        except ParameterError as error:
            raise ScenarioError(f"kind: {error}") from None

    def __contains__(self, name: object) -> bool:
        return name in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def classes(self) -> tuple[T, ...]:
        """What is registered, each once."""
        return tuple(dict.fromkeys(self._entries.values()))


def _place(entry: Any) -> tuple[str, str]:
    return entry.__module__, entry.__qualname__


@dataclass(frozen=True)
class Key:
    """One key of a table in a scenario file.

    Args:
        name, unit, doc: with the unit at the end of the name, as in ``power_kW``.
        lo, hi, open_lo: range, in that unit; ``open_lo`` leaves ``lo`` itself out.
        default: value if absent; None for a key that may be absent, ``...`` for one that is needed.
        phases: three numbers, for the phases a, b, c; one stands for three equal ones.
        choices: texts, instead of a number.
    """

    name: str
    unit: str
    doc: str
    lo: float = -float("inf")
    hi: float = float("inf")
    open_lo: bool = False
    default: Any = ...
    phases: bool = False
    choices: tuple[str, ...] = ()

    def read(self, value: Any) -> Any:
        """Return the checked value.

        Raises:
            ScenarioError: another type, or out of range; the text starts with the key's name.
        """
        limits: dict[str, Any] = {"lo": self.lo, "hi": self.hi, "open_lo": self.open_lo}
        limits["unit"] = "" if self.unit == "1" else self.unit
        if self.choices:
            if value not in self.choices:
                hint = nearest(str(value), self.choices)
                raise ScenarioError(f"{self.name}: unknown {value!r} {hint}")
            return value
        if not self.phases:
            return bounded(value, self.name, **limits)
        if isinstance(value, int | float) and not isinstance(value, bool):
            value = (value, value, value)
        if not (isinstance(value, list | tuple) and len(value) == 3):
            raise ScenarioError(
                f"{self.name}: three numbers (phases a, b, c) are expected, got {value!r}"
            )
        return tuple(bounded(v, f"{self.name}[{i}]", **limits) for i, v in enumerate(value, 1))


def read_table(what: str, keys: Sequence[Key], table: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of a table by key, absent ones by their default.

    Args:
        what: what takes these keys, for messages, as in ``"a 'RL' load"``.
        keys: all that the table may hold.

    Raises:
        ScenarioError: a key that is unknown, missing or out of range; the text starts with it.
    """
    names = [k.name for k in keys]
    for name in table:
        if name not in names:
            takes = f"it takes {', '.join(names)}" if names else "it takes no other key"
            raise ScenarioError(f"{name}: not a key of {what}; {takes}")
    values = {}
    for key in keys:
        value = table.get(key.name)
        if value is None and key.default is ...:
            raise ScenarioError(f"{key.name}: missing: {what} needs it")
        values[key.name] = key.default if value is None else key.read(value)
    return values
