"""What changes from outside during a run: ambient conditions, and load, health and fault events.

An event takes effect at its instant ``t`` [s] and holds until the next one of its kind.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from apu_casadi.core.checked import bounded as number
from apu_casadi.core.errors import ScenarioError, nearest
from apu_casadi.core.profiles.profile import Profile, Varying, at, later
from apu_casadi.core.runloop import SAME_INSTANT
from apu_casadi.gaspath import health
from apu_casadi.gaspath.conditions import CONDITIONS, DEFAULT_DAY

if TYPE_CHECKING:
    from apu_casadi.machine.faults.fault import Fault

HEALTH_FACTORS: Mapping[str, str] = MappingProxyType(
    {n: f.doc for n, f in health.HEALTH_FACTORS.items()}
)
"""The health factors of the gas path, one when healthy, with their meaning."""

STARTS = ("balanced", "settled")
"""What a run may start from: the healthy unit with balanced loads, or what is there from the start.
"""
MOST = 4
"""Generators that a unit may have; it has at least one."""

HEALTH_LO, HEALTH_HI = health.RUN_RANGE
"""A health factor lies in (HEALTH_LO, HEALTH_HI]."""


def health_factors(factors: Any, what: str = "health") -> dict[str, Any]:
    """Return the checked factors as a new dictionary of floats and profiles.

    Raises:
        ScenarioError: not a mapping, unknown name (the nearest is named), or outside (0.5, 1.5].
    """
    if not isinstance(factors, Mapping):
        raise ScenarioError(f"{what}: a table of factors is expected, got {factors!r}")
    checked = {}
    for name, value in factors.items():
        if name not in HEALTH_FACTORS:
            raise ScenarioError(f"{what}: unknown {name!r} {nearest(str(name), HEALTH_FACTORS)}")
        limits: dict[str, Any] = {"lo": HEALTH_LO, "hi": HEALTH_HI, "open_lo": True}
        checked[name] = number_or_profile(value, f"{what}.{name}", **limits)
    return checked


def number_or_profile(value: Any, what: str, **limits: Any) -> Any:
    """Return a number within limits, or a profile whose values are.

    Raises:
        ScenarioError: it is neither, or beyond the limits.
    """
    if not isinstance(value, Profile):
        return number(value, what, **limits)
    for bound in value.bounds:
        number(bound, what, **limits)
    return value


def all_factors(factors: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return every health factor by name: the checked ones that are given, one for the others."""
    return {**dict.fromkeys(HEALTH_FACTORS, 1.0), **health_factors(factors or {})}


@dataclass(frozen=True)
class Ambient:
    """Ambient and flight conditions.

    Args:
        altitude: pressure altitude [m].
        Mach: flight Mach number [1].
        dT_isa: deviation from the standard day [K].
        war: water to dry air mass ratio [1].

    Defaults and ranges are those of :data:`apu_casadi.gaspath.conditions.CONDITIONS`, as
    everywhere.

    Raises:
        ScenarioError: a value outside its range.
    """

    altitude: float = DEFAULT_DAY["altitude"]
    Mach: float = DEFAULT_DAY["Mach"]
    dT_isa: float = DEFAULT_DAY["dT_isa"]
    war: float = DEFAULT_DAY["war"]

    def __post_init__(self) -> None:
        for name, c in CONDITIONS.items():
            unit = "" if c.unit == "1" else c.unit
            value = number(getattr(self, name), name, lo=c.lo, hi=c.hi, unit=unit)
            object.__setattr__(self, name, value)


def _time(t: Any, what: str) -> None:
    number(t, f"{what}.t", lo=0.0, unit="s")


def _generator(k: Any, what: str) -> None:
    """Check the number of a generator; None means all of them."""
    if k is not None and (isinstance(k, bool) or not isinstance(k, int) or k < 1):
        raise ScenarioError(f"{what}.generator: a number from 1 is expected, got {k!r}")


@dataclass(frozen=True)
class LoadChange:
    """From ``t`` [s] on, ``generator`` feeds ``load``; None: each of them does.

    Args:
        load: an object of ``machine.loads``.
        generator: its number, from 1.

    Raises:
        ScenarioError: ``t`` negative or not finite, a load that is a bare number or text, or no
            number of a generator.
    """

    t: float
    load: Any
    generator: int | None = None

    def __post_init__(self) -> None:
        _time(self.t, "LoadChange")
        _generator(self.generator, "LoadChange")
        if self.load is None or isinstance(self.load, bool | int | float | str | Mapping):
            raise ScenarioError(
                f"LoadChange.load: a load object (SeriesLoad, ConstantPowerLoad, OpenLoad) is "
                f"expected, got {self.load!r}"
            )


@dataclass(frozen=True)
class HealthChange:
    """From ``t`` [s] on, the named health factors hold; the others keep their values.

    A factor may be a profile, whose time counts from ``t``.

    Raises:
        ScenarioError: ``t`` negative or not finite, an unknown factor, or one outside (0.5, 1.5].
    """

    t: float
    factors: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check time and factors, and keep a read-only copy of the factors."""
        _time(self.t, "HealthChange")
        checked = health_factors(self.factors, "HealthChange.factors")
        object.__setattr__(self, "factors", MappingProxyType(checked))

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle through a plain dictionary, for process pools."""
        return type(self), (self.t, dict(self.factors))

    def __hash__(self) -> int:
        return hash((self.t, tuple(sorted(self.factors.items()))))


@dataclass(frozen=True)
class FaultChange:
    """From ``t`` [s] on, ``generator`` has ``fault``, such as a ``Ttsc``; None: it is healthy.

    Args:
        generator: its number, from 1; None: all of them.

    Raises:
        ScenarioError: ``t`` negative or not finite, a fault that is a bare number or text, or no
            number of a generator.
    """

    t: float
    fault: Fault | None
    generator: int | None = None

    def __post_init__(self) -> None:
        _time(self.t, "FaultChange")
        _generator(self.generator, "FaultChange")
        if isinstance(self.fault, bool | int | float | str | Mapping):
            raise ScenarioError(
                f"FaultChange.fault: a Ttsc or None is expected, got {self.fault!r}"
            )


@dataclass(frozen=True)
class SpeedChange:
    """From ``t`` [s] on, the governor holds the rotor speed ``N_ref`` [rad/s], also a profile.

    Raises:
        ScenarioError: ``t`` negative or not finite, or no positive speed.
    """

    t: float
    N_ref: Any

    def __post_init__(self) -> None:
        _time(self.t, "SpeedChange")
        what, unit = "SpeedChange.N_ref", "rad/s"
        N_ref = number_or_profile(self.N_ref, what, lo=0.0, open_lo=True, unit=unit)
        object.__setattr__(self, "N_ref", N_ref)


Event = LoadChange | HealthChange | FaultChange | SpeedChange


def who(numbers: Sequence[int]) -> str:
    """Return generators in words.

    >>> who((1,)), who((1, 3))
    ('generator 1', 'generators 1 and 3')
    """
    if len(numbers) == 1:
        return f"generator {numbers[0]}"
    *first, last = map(str, numbers)
    return f"generators {', '.join(first)} and {last}"


class Jump(NamedTuple):
    """An instant, s, at which a profile jumps."""

    t: float


class Holding(NamedTuple):
    """What holds from an instant on: numbers, profiles, and what is made of profiles.

    The time of all profiles is that of the run.

    Args:
        loads, faults: of each generator.
        factors: all health factors by name.
        ambient: the day.
        N_ref: governed speed, rad/s; None: that of the unit.
    """

    loads: tuple[Any, ...]
    faults: tuple[Any, ...]
    factors: Mapping[str, Any]
    ambient: Any = None
    N_ref: Any = None

    def after(self, events: Iterable[Event | Jump]) -> Holding:
        """Return what holds after events."""
        now = self
        for e in events:
            if isinstance(e, HealthChange):
                new = {n: later(v, e.t) for n, v in e.factors.items()}
                now = now._replace(factors={**now.factors, **new})
            elif isinstance(e, LoadChange):
                now = now._replace(loads=_put(now.loads, e.generator, later(e.load, e.t)))
            elif isinstance(e, FaultChange):
                now = now._replace(faults=_put(now.faults, e.generator, later(e.fault, e.t)))
            elif isinstance(e, SpeedChange):
                now = now._replace(N_ref=later(e.N_ref, e.t))
        return now

    @property
    def parts(self) -> tuple[Any, ...]:
        """All that may be a profile or made of profiles."""
        return (*self.loads, *self.faults, *self.factors.values(), self.ambient, self.N_ref)

    @property
    def changing(self) -> bool:
        """Whether anything changes without an event."""
        return any(isinstance(x, Profile | Varying) for x in self.parts)

    def at(self, t: float) -> Holding:
        """Return the numbers of an instant, s."""
        return Holding(
            tuple(at(x, t) for x in self.loads),
            tuple(at(x, t) for x in self.faults),
            {n: at(v, t) for n, v in self.factors.items()},
            at(self.ambient, t),
            at(self.N_ref, t),
        )


def jumps(start: Holding, events: Sequence[Event], duration: float) -> list[Jump]:
    """Return where profiles jump in a run, while they hold; ``events`` are in order."""
    found, now, begin = set[float](), start, 0.0
    for e in (*events, None):
        end = duration if e is None else e.t
        changing = {x for x in now.parts if isinstance(x, Profile | Varying) and end > begin}
        found |= {t for x in changing for t in x.instants(duration) if begin < t < end}
        if e is not None:
            now, begin = now.after([e]), e.t
    return [Jump(t) for t in sorted(found)]


def _put(each: tuple[Any, ...], k: int | None, new: Any) -> tuple[Any, ...]:
    return tuple(new if k in (None, j) else old for j, old in enumerate(each, 1))


def _refuse_second(i: int, e: Event, other: Event) -> None:
    """Refuse what contradicts an event of its kind at its instant: the order would decide."""
    if not isinstance(e, HealthChange) or not isinstance(other, HealthChange):
        numbers = getattr(e, "generator", None), getattr(other, "generator", None)
        if None not in numbers and numbers[0] != numbers[1]:
            return
        of = "" if numbers == (None, None) else f" of generator {numbers[0] or numbers[1]}"
        raise ScenarioError(f"events[{i}]: second {type(e).__name__}{of} at t = {e.t:g} s")
    for name, value in e.factors.items():
        if other.factors.get(name, value) != value:
            raise ScenarioError(
                f"events[{i}]: at t = {e.t:g} s {name} = {_shown(value)}, but "
                f"{_shown(other.factors[name])} by another event at that instant"
            )


def _shown(value: Any) -> str:
    return value.label if isinstance(value, Profile) else f"{value:g}"


def in_order(events: Iterable[Event], duration: float, *, generators: int = 2) -> tuple[Event, ...]:
    """Return the events sorted by time, equal times in the order given.

    Args:
        generators: of the unit.

    Raises:
        ScenarioError: something that is no event, an event at or beyond ``duration`` [s], one of a
            generator that is not there, two load or two fault changes of one generator at one
            instant, or two values of one health factor.
    """
    events = tuple(events)
    for i, e in enumerate(events):
        if not isinstance(e, Event):
            raise ScenarioError(
                f"events[{i}]: LoadChange, HealthChange, FaultChange or SpeedChange expected, "
                f"got {e!r}"
            )
        if e.t >= duration:
            raise ScenarioError(
                f"events[{i}]: t = {e.t:g} s is not before the end of the run at {duration:g} s"
            )
        k = getattr(e, "generator", None)
        if k is not None and k > generators:
            raise ScenarioError(f"events[{i}]: generator {k}, but the unit has 1 to {generators}")
    order = sorted(range(len(events)), key=lambda i: events[i].t)
    for k, i in enumerate(order):
        for m in range(k - 1, -1, -1):
            j = order[m]
            if events[i].t - events[j].t > SAME_INSTANT:
                break
            if type(events[i]) is type(events[j]):
                _refuse_second(i, events[i], events[j])
    return tuple(events[i] for i in order)
