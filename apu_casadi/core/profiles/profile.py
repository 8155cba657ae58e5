"""What changes in time: a profile stands where else a number stands.

A kind of profile is one class, derived from :class:`Profile` and entered in ``PROFILES``.  In a
scenario file it is a table in place of a number, as in ``{ from = 1.0, to = 0.97, over = 60.0 }``;
``kind`` may be left out where the keys tell it.  Its time, s, counts from the instant at which it
is given: the start of its phase or event, or of the run.

A run holds a profile over each exchange step at its value in the middle of the step, as eqs.
(1)-(3) hold speed, power and fuel.  Where it jumps (:meth:`Profile.instants`) a new step begins, so
that every integrator sees the same piecewise constant inputs.  The error of holding is of second
order in the step h: the mean of a course p over a step is its value in the middle plus
h^2 p'' / 24, and what it drives sees no lag.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Self, TypeVar, overload

import numpy as np

from apu_casadi.core.errors import ScenarioError, nearest
from apu_casadi.core.register import Key, Register, read_table
from apu_casadi.core.signals import Signals

T = TypeVar("T")

MOST_JUMPS = 100_000
"""Jumps of one profile in a run; each begins an exchange step."""


class Profile(ABC):
    """A number that changes in time; a subclass is a frozen dataclass that checks itself.

    Its fields are those of ``keys``, in their order.
    """

    #: Word for it in a scenario file, and the keys that it takes.
    word: ClassVar[str] = ""
    keys: ClassVar[tuple[Key, ...]] = ()
    #: Whether it has many bends, so that what depends on it is better told by its value than by
    #: the time.
    by_value: ClassVar[bool] = False
    #: Whether a table may name a file; ``from_table`` then takes the unit that is wanted.
    from_files: ClassVar[bool] = False

    @overload
    def __call__(self, t: float) -> float: ...
    @overload
    def __call__(self, t: np.ndarray) -> np.ndarray: ...
    def __call__(self, t: Any) -> Any:
        """Return the value at an instant, s, or at several; at a jump the one after it."""
        made = self.values(np.asarray(t, dtype=float))
        return float(made) if made.ndim == 0 else made

    @abstractmethod
    def values(self, t: np.ndarray) -> np.ndarray:
        """Return the values at instants, s, of any shape."""

    @property
    @abstractmethod
    def bounds(self) -> tuple[float, float]:
        """Lowest and highest value that it takes."""

    def instants(self, duration: float) -> tuple[float, ...]:
        """Return where it jumps in (0, ``duration``), s, in order."""
        return ()

    def corners(self, duration: float) -> tuple[float, ...]:
        """Return where it jumps or bends in (0, ``duration``), s, in order."""
        return self.instants(duration)

    @property
    @abstractmethod
    def label(self) -> str:
        """The course in a few words."""

    # -- scenario files -------------------------------------------------------------------------

    @classmethod
    def from_table(cls, table: Mapping[str, Any], name: str, folder: str = "") -> Self:
        """Make it from a table without ``kind``.

        Args:
            table: with the ``keys``.
            name: what the profile stands for: the column of a file that names none.
            folder: from which file names are seen.

        Raises:
            ScenarioError: a wrong key or value; the text starts with the key.
        """
        return cls(*read_table(f"a {cls.word!r} profile", cls.keys, table).values())

    def to_table(self) -> dict[str, Any]:
        """Return the table that :func:`profile_from_table` reads, without what is by default."""
        given = (getattr(self, f.name) for f in dataclasses.fields(self))  # type: ignore[arg-type]
        pairs = zip(self.keys, given, strict=True)
        return {"kind": self.word, **{k.name: v for k, v in pairs if v != k.default}}

    @classmethod
    def told_by(cls, table: Mapping[str, Any]) -> bool:
        """Whether a table without ``kind`` is one of this kind: it has all keys that are needed."""
        needed = {k.name for k in cls.keys if k.default is ...}
        return bool(needed) and needed <= set(table)


PROFILES: Register[type[Profile]] = Register("profile", "apu_casadi.core.profiles")


def profile_from_table(
    table: Mapping[str, Any], name: str, folder: str | os.PathLike[str] = "", unit: str = ""
) -> Profile:
    """Return the profile that a table of a scenario file describes.

    Args:
        name: what it stands for, such as ``"altitude"``: the column of a file that names none.
        folder: from which the files that it names are seen; the current one if empty.
        unit: of the values, into which those of a file are brought.

    Raises:
        ScenarioError: no kind has such keys, or a wrong key or value; the text starts with the key.
        DataError: a file that cannot be read; the text has its row and column.
    """
    rest = {k: v for k, v in table.items() if k != "kind"}
    if "kind" in table:
        if table["kind"] not in PROFILES:
            hint = nearest(str(table["kind"]), PROFILES)
            raise ScenarioError(f"kind: unknown profile {table['kind']!r} {hint}")
        return _made(PROFILES[table["kind"]], rest, name, os.fspath(folder), unit)
    found = next((cls for cls in PROFILES.classes if cls.told_by(table)), None)
    if found is None:
        known = dict.fromkeys(k.name for cls in PROFILES.classes for k in cls.keys) | {"file": None}
        wrong = next((str(k) for k in table if k not in known), None)
        if wrong is not None:
            raise ScenarioError(f"{wrong}: unknown key of a profile {nearest(wrong, known)}")
        words = "; ".join(
            f"{c.word}: {', '.join(k.name for k in c.keys)}" for c in PROFILES.classes
        )
        raise ScenarioError(f"kind: missing, and the keys tell no profile (known are {words})")
    return _made(found, rest, name, os.fspath(folder), unit)


def _made(cls: Any, table: Mapping[str, Any], name: str, folder: str, unit: str) -> Profile:
    own = {"unit": unit} if cls.from_files else {}
    made: Profile = cls.from_table(table, name, folder, **own)
    return made


def in_run(times: Iterable[float], duration: float) -> tuple[float, ...]:
    """Return the times inside (0, ``duration``), each once, in order.

    Raises:
        ScenarioError: there are more than ``MOST_JUMPS``.
    """
    found = sorted({float(t) for t in times if 0.0 < t < duration})
    if len(found) > MOST_JUMPS:
        raise ScenarioError(
            f"a profile jumps {len(found)} times in {duration:g} s, {MOST_JUMPS} at most"
        )
    return tuple(found)


# ------------------------------------------------------------------------------ varying objects


@dataclass(frozen=True)
class Varying(Generic[T]):
    """An object some of whose numbers are profiles: a load, a fault, a day; see :func:`varying`.

    Args:
        make: makes the object of the values by name.
        values: names and what is given for each, numbers and profiles.
    """

    make: Callable[..., T]
    values: tuple[tuple[str, Any], ...]

    def at(self, t: float) -> T:
        """Return the object at an instant, s."""
        return self.with_values({n: p(t) for n, p in self.profiles.items()})

    def with_values(self, values: Mapping[str, float]) -> T:
        """Return the object with numbers in place of the profiles."""
        return self.make(**{**dict(self.values), **values})

    @property
    def profiles(self) -> dict[str, Profile]:
        """The profiles by name."""
        return {n: v for n, v in self.values if isinstance(v, Profile)}

    def instants(self, duration: float) -> tuple[float, ...]:
        """Return where one of them jumps in (0, ``duration``), s."""
        each = (p.instants(duration) for p in self.profiles.values())
        return in_run((t for ts in each for t in ts), duration)

    def corners(self, duration: float) -> tuple[float, ...]:
        """Return where one of them jumps or bends in (0, ``duration``), s."""
        each = (p.corners(duration) for p in self.profiles.values())
        return in_run((t for ts in each for t in ts), duration)

    def check(self) -> Self:
        """Make the object at the lowest and the highest value of each profile.

        Raises:
            ApuError: what the object says of a value that is out of range.
        """
        usual = {n: p(0.0) for n, p in self.profiles.items()}
        for n, p in self.profiles.items():
            for value in p.bounds:
                self.with_values({**usual, n: value})
        return self

    def later(self, by: float) -> Varying[T]:
        """Return the same with its time beginning at ``by``, s."""
        moved = ((n, later(v, by)) for n, v in self.values)
        return Varying(self.make, tuple(moved))

    def example(self) -> Any:
        """Return the object at its beginning, or later where there is none at first."""
        corners = (0.0, *self.corners(math.inf))
        each = (
            (a + b) / 2 for a, b in zip(corners, (*corners[1:], corners[-1] + 2.0), strict=True)
        )
        return next((x for x in map(self.at, each) if x is not None), None)

    def to_table(self) -> dict[str, Any]:
        """Return the table of a scenario file, where the object was made of one."""
        shown = {n: v.to_table() if isinstance(v, Profile) else v for n, v in self.values}
        return {n: list(v) if isinstance(v, tuple) else v for n, v in shown.items()}

    @property
    def label(self) -> str:
        """The profiles in a few words."""
        return "; ".join(f"{n} {p.label}" for n, p in self.profiles.items())


def varying(make: Callable[..., T], *args: Any, **values: Any) -> Varying[T]:
    """Return an object that changes in time: ``make`` with profiles among its arguments.

    >>> from apu_casadi.core.profiles.shapes import Ramp
    >>> from apu_casadi.machine.loads.series import SeriesLoad
    >>> varying(SeriesLoad.from_power, Ramp(100e3, 200e3, over=60.0), 0.85).at(30.0).label
    '150 kW, power factor 0.85'

    Args:
        make: a class of loads, faults or conditions, or a function that makes one.
        args, values: its arguments; each may be a profile.

    Raises:
        ApuError: what the object says of a value that is out of range.
    """
    named = inspect.signature(make).bind(*args, **values).arguments
    # a fault is none while its severity is that of a healthy machine
    own = getattr(make, "or_none", make)
    return Varying(own, tuple(named.items())).check()


@dataclass(frozen=True)
class Moved(Profile):
    """A profile whose time begins at ``by``, s, times a factor, as for another unit."""

    profile: Profile
    by: float = 0.0
    factor: float = 1.0

    def values(self, t: np.ndarray) -> np.ndarray:
        """Those of the profile."""
        return self.factor * self.profile.values(t - self.by)

    @property
    def bounds(self) -> tuple[float, float]:
        """Those of the profile."""
        low, high = sorted(self.factor * v for v in self.profile.bounds)
        return low, high

    @property
    def by_value(self) -> bool:  # type: ignore[override]
        """As of the profile."""
        return self.profile.by_value

    def instants(self, duration: float) -> tuple[float, ...]:
        """Those of the profile."""
        own = (t + self.by for t in self.profile.instants(duration - self.by))
        return in_run(own, duration)

    def corners(self, duration: float) -> tuple[float, ...]:
        """Those of the profile, and its beginning."""
        own = (t + self.by for t in self.profile.corners(duration - self.by))
        return in_run((self.by, *own), duration)

    @property
    def label(self) -> str:
        """That of the profile."""
        return self.profile.label

    def to_table(self) -> dict[str, Any]:
        """Return that of the profile: time and unit are those of the place where it stands."""
        return self.profile.to_table()


def later(value: Any, by: float) -> Any:
    """Return a profile or varying object with its time beginning at ``by``, s; others as is."""
    if by == 0.0:
        return value
    if isinstance(value, Varying):
        return value.later(by)
    return Moved(value, by) if isinstance(value, Profile) else value


def at(value: Any, t: Any) -> Any:
    """Return what a value is at an instant, s: of a profile or varying object, or itself."""
    if isinstance(value, Varying):
        return value.at(t)
    return value(t) if isinstance(value, Profile) else value


def fixed(value: Any, what: str, use: str) -> Any:
    """Return a value that does not change in time, for a use that is of one instant.

    Args:
        what, use: for the message, as ``"load"`` and ``"a steady state"``.

    Raises:
        ScenarioError: it changes; the text says what it is at its beginning and at its last corner.
    """
    if not isinstance(value, Varying | Profile):
        return value
    corners = value.corners(_LONG)
    times = (0.0, *corners[-1:])
    ends = ", ".join(f"{_words(at(value, t))} at t = {t:g} s" for t in times)
    raise ScenarioError(
        f"{what}: {value.label} changes in time, and {use} is of one instant: give what it is "
        f"then, {ends}"
    )


_LONG = 3600.0  # s; the longest run


def _words(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float | int) else getattr(value, "label", str(value))


def held(
    signals: Signals, values: Mapping[str, Any], start: np.ndarray, middles: np.ndarray
) -> np.ndarray:
    """Return a vector over steps with profiles at their middles, shape (n, steps).

    Args:
        signals, start: of the vector, and its values where ``values`` has none.
        values: numbers and profiles by name.
        middles: of the steps, s.

    Raises:
        SignalError: an unknown name; the nearest is named.
    """
    made = np.repeat(np.asarray(start, dtype=float)[:, None], middles.size, axis=1)
    for name, value in values.items():
        made[signals.index(name)] = at(value, middles)
    return made
