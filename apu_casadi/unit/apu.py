"""The whole unit: one gas generator, its starter/generators, governor and gearbox.

The paper's unit has two equal generators; here one to four, equal or not, each with its own gear.
What is equal is computed once (:mod:`apu_casadi.unit.machines`).
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from apu_casadi.core.checked import number
from apu_casadi.core.errors import (
    OperatingPointError,
    ParameterError,
    ScenarioError,
    SignalError,
    nearest,
)
from apu_casadi.core.parameters import Parameters, par
from apu_casadi.core.profiles.profile import fixed
from apu_casadi.core.sharing import Parametric, derived
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import Limits, OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.machine.generator import CHOICES, Generator, GeneratorPoint
from apu_casadi.machine.machinedata import magnetics
from apu_casadi.unit.control import GOVERNORS, Governor, GovernorParameters, word_of
from apu_casadi.unit.events import MOST, Ambient
from apu_casadi.unit.exchange import Link

if TYPE_CHECKING:
    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load

    #: Fault of all generators, a list of one for each, or a mapping by number from 1.
    Faults = Fault | Sequence[Fault | None] | Mapping[int, Fault | None] | None

T = TypeVar("T")
_NUMBERED = re.compile(r"generator(\d+)\.(.+)")


@dataclass(frozen=True)
class CouplingParameters(Parameters):
    """Gearbox between gas generator and generators (paper, eqs. 1 and 2)."""

    gear: float = par(
        36050.0 / 12000.0,
        unit="1",
        source="Table 3 speed over 400 Hz with two pole pairs",
        doc="speed ratio Omega_gtSg",
        lo=0.01,
    )
    eta_gtSg: float = par(
        1.0,
        unit="1",
        source="assumed: only eta_sg eta_gtSg = 0.90 follows from the tables",
        doc="power transfer efficiency of the gearbox",
        lo=0.01,
        hi=1.0,
    )


class OnShaft(NamedTuple):
    """A generator with its gear."""

    generator: Generator
    coupling: CouplingParameters


@dataclass(frozen=True)
class JointPoint:
    """A steady point of the whole unit.

    Args:
        gas: operating point of the gas generator.
        generator: operating point of the first generator.
        others: those of the others; () where all are equal.
    """

    gas: OperatingPoint
    generator: GeneratorPoint
    others: tuple[GeneratorPoint, ...] = ()

    def of(self, number: int) -> GeneratorPoint:
        """Operating point of one generator, counted from 1."""
        return (self.generator, *self.others)[number - 1] if self.others else self.generator


@dataclass(frozen=True)
class Apu(Parametric):
    """An all-electric APU; the default is the paper's APS5000-like unit with two equal generators.

    Args:
        gas_generator, generator: the two models.
        governor, coupling: speed control and gearbox.
        others: the generators beside the first, with their gears; None: one more that is equal to
            it.  See :meth:`with_generators`.

    Raises:
        ParameterError: more than ``MOST`` generators, or something else among them.
    """

    gas_generator: GasGenerator = field(default_factory=GasGenerator)
    generator: Generator = field(default_factory=Generator)
    governor: Governor = field(default_factory=GovernorParameters)
    coupling: CouplingParameters = field(default_factory=CouplingParameters)
    others: tuple[OnShaft, ...] | None = None

    def __post_init__(self) -> None:
        """Check the generators, and give equal units the same fields."""
        if self.others is None:
            return
        others = tuple(self.others)
        for k, other in enumerate(others, 2):
            if not (isinstance(other, tuple) and len(other) == 2) or not (
                isinstance(other[0], Generator) and isinstance(other[1], CouplingParameters)
            ):
                raise ParameterError(f"generator {k}: OnShaft(generator, coupling), got {other!r}")
        if len(others) >= MOST:
            raise ParameterError(f"a unit has 1 to {MOST} generators, got {len(others) + 1}")
        others = tuple(OnShaft(*other) for other in others)
        alike = others == ((self.generator, self.coupling),)
        object.__setattr__(self, "others", None if alike else others)

    # -- generators ---------------------------------------------------------------------------

    @property
    def machines(self) -> tuple[OnShaft, ...]:
        """The generators with their gears, in the order of their numbers from 1."""
        first = OnShaft(self.generator, self.coupling)
        return (first, first) if self.others is None else (first, *self.others)

    @property
    def generators(self) -> tuple[Generator, ...]:
        """The generators in the order of their numbers from 1."""
        return tuple(m.generator for m in self.machines)

    @property
    def alike(self) -> bool:
        """Whether all generators and their gears are equal."""
        return self.others is None or set(self.others) <= {(self.generator, self.coupling)}

    def with_generators(
        self, *generators: Generator, couplings: Sequence[CouplingParameters] | None = None
    ) -> Apu:
        """Return the unit with these generators.

        >>> unit = Apu()
        >>> unit.with_generators(unit.generator, Generator(neutral="isolated")).alike
        False

        Args:
            generators: one to ``MOST``.
            couplings: gear of each; default that of the first for all.

        Raises:
            ParameterError: too many, none, or not as many gears.
        """
        gears = [self.coupling] * len(generators) if couplings is None else [*couplings]
        if not generators or len(gears) != len(generators):
            raise ParameterError(
                f"a unit has 1 to {MOST} generators with a gear each, got {len(generators)} and "
                f"{len(gears)} gears"
            )
        others = tuple(map(OnShaft, generators[1:], gears[1:]))
        return dataclasses.replace(self, generator=generators[0], coupling=gears[0], others=others)

    def refuse_different(self, what: str) -> None:
        """Refuse a unit whose generators differ, by the name of what needs them equal.

        Raises:
            ParameterError: they differ; the text says in what.
        """
        if not self.alike:
            differ = [k for k in self.parameters() if _NUMBERED.fullmatch(k)]
            raise ParameterError(f"{what} needs equal generators; these differ: {differ}")

    # -- exchange -----------------------------------------------------------------------------

    @property
    def N_ref(self) -> float:
        """Governed rotor speed, rad/s."""
        return self.gas_generator.parameters.N

    def link_of(self, numbers: Sequence[int]) -> Link:
        """Eqs. (1) and (2) for equal generators of these numbers, and the governor."""
        gen, gearbox = self.machines[numbers[0] - 1]
        own = gearbox.gear, gearbox.eta_gtSg, gen.machine.n_pp
        return Link(self.governor, self.N_ref, *own, len(numbers) / 2)

    @derived
    def link(self) -> Link:
        """What couples the models: eqs. (1) and (2), and the governor.

        Raises:
            ParameterError: the generators differ; each has its own (:meth:`link_of`).
        """
        self.refuse_different("one generator for all")
        return self.link_of(range(1, len(self.machines) + 1))

    @derived
    def shaft(self) -> Link:
        """The governor alone, for a shaft power that is summed over the generators."""
        return Link(self.governor, self.N_ref)

    def w_r(self, N: Any) -> Any:
        """Electrical speed of the generators, rad/s, at rotor speed N (eq. 2).

        That of the first where they differ.
        """
        return self.link_of((1,)).w_r(N)

    def PW(self, P_total: Any) -> Any:
        """Shaft power, W, that equal generators ask for (eq. 1).

        Args:
            P_total: mean power of two of them, as the generator's model has it (eq. 8).
        """
        return self.link.PW(P_total)

    # -- parameters ---------------------------------------------------------------------------

    def parameter_sets(self) -> dict[str, Parameters]:
        """Return the parameter sets by the words that stand before the dot."""
        gg, gen = self.gas_generator, self.generator
        return {
            "gas_generator": gg.parameters,
            "compressor_map": gg.compressor_map.calibration,
            "turbine_map": gg.turbine_map.calibration,
            "machine": gen.machine,
            "exciter": gen.exciter,
            "governor": self.governor,
            "coupling": self.coupling,
        }

    def parameters(self) -> dict[str, float | str]:
        """Return every parameter as ``{"set.name": value}``; the keys :meth:`change` takes.

        Those of machine, exciter, neutral and coupling are the first generator's; what another one
        has different follows as ``"generator2.machine.r_s"``.
        """
        table: dict[str, float | str] = {}
        for s, p in self.parameter_sets().items():
            table |= _values(s, p)
        table |= {f"generator.{n}": v for n, v in _words(self.generator).items()}
        table["generator.count"] = len(self.machines)
        table["governor.kind"] = word_of(self.governor)
        first = _of_each(self.machines[0])
        for k, machine in enumerate(self.machines[1:], 2):
            own = _of_each(machine)
            table |= {f"generator{k}.{n}": v for n, v in own.items() if v != first.get(n)}
        return table

    def change(self, values: Mapping[str, Any]) -> Apu:
        """Return a unit with some parameters changed.

        ``machine.r_s`` is that of all generators, ``generator2.machine.r_s`` that of one, which
        goes before; so also ``exciter``, ``coupling`` and ``generator2.neutral``.

        >>> Apu().change({"governor.Kp": 0.5, "machine.r_s": 0.005}).governor.Kp
        0.5

        ``governor.kind`` puts another governor of ``GOVERNORS`` in its place, with its defaults;
        ``generator.count`` takes generators away, or adds some that are equal to the first.

        Raises:
            ParameterError: unknown name (the nearest valid one is named) or value out of range.
        """
        kind = values.get("governor.kind")
        if kind is not None and kind != word_of(self.governor):
            other = dataclasses.replace(self, governor=GOVERNORS[kind]())
            return other.change(values)
        machines = self._counted(values.get("generator.count"))
        by_set: dict[str, dict[str, Any]] = {}
        own: dict[int, dict[str, Any]] = {k: {} for k in range(1, len(machines) + 1)}
        known = {**_UNSATURATED, **self.parameters()}
        for key, value in values.items():
            if numbered := _NUMBERED.fullmatch(key):
                k, name = _which(numbered, machines)
                own[k][name] = value
                continue
            if key not in known:
                raise ParameterError(f"unknown parameter {key!r} {nearest(key, known)}")
            s, _, name = key.partition(".")
            if key not in ("governor.kind", "generator.count"):
                by_set.setdefault(s, {})[name] = value
        new: dict[str, Any] = {
            s: p.change(**by_set.get(s, {}))
            for s, p in self.parameter_sets().items()
            if s not in _EACH
        }
        gg = self.gas_generator
        touched = {"gas_generator", "compressor_map", "turbine_map"} & set(by_set)
        if touched:
            gg = dataclasses.replace(
                gg,
                parameters=new["gas_generator"],
                compressor_map=dataclasses.replace(
                    gg.compressor_map, calibration=new["compressor_map"]
                ),
                turbine_map=dataclasses.replace(gg.turbine_map, calibration=new["turbine_map"]),
            )
        common = {f"{s}.{n}": v for s in _EACH for n, v in by_set.get(s, {}).items()}
        common |= by_set.get("generator", {})
        first, *others = (_changed(m, common | own[k]) for k, m in enumerate(machines, 1))
        return Apu(gg, first.generator, new["governor"], first.coupling, tuple(others))

    def _counted(self, count: Any) -> tuple[OnShaft, ...]:
        """Return so many generators; None: those that there are."""
        if count is None:
            return self.machines
        n = number("generator.count", count, error=ParameterError)
        if n not in range(1, MOST + 1):
            raise ParameterError(f"generator.count = {count!r} is not one of 1 to {MOST}")
        return (*self.machines, *[self.machines[0]] * MOST)[: int(n)]

    def each(self, what: str, given: Any) -> tuple[Any, ...]:
        """Return what each generator has: a list or tuple has one entry each, all else is for all.

        Args:
            what: that is given, for the message.

        Raises:
            ScenarioError: another number of entries.
        """
        n = len(self.machines)
        if not isinstance(given, list | tuple):
            return (given,) * n
        if len(given) != n:
            raise ScenarioError(f"{what}: {n} entries expected, one a generator, got {len(given)}")
        return tuple(given)

    def each_fault(self, given: Any) -> tuple[Any, ...]:
        """Return the fault of each generator; as :meth:`each`, or a mapping by number from 1."""
        if not isinstance(given, Mapping):
            return self.each("fault", given)
        n = len(self.machines)
        for k in given:
            if k not in range(1, n + 1):
                raise ScenarioError(f"fault: generator {k!r}, but the unit has 1 to {n}")
        return tuple(given.get(k) for k in range(1, n + 1))

    # -- steady state -------------------------------------------------------------------------

    def steady_state(
        self,
        load: Load | Sequence[Load],
        fault: Faults = None,
        *,
        ambient: Ambient | None = None,
        health: Mapping[str, float] | None = None,
        V_ref: float | None = None,
        limits: Limits | None = None,
        N_ref: float | None = None,
    ) -> JointPoint:
        """Solve the steady unit at governed speed.

        ``load`` and ``fault`` are those of each generator, or a list with one for each; for the
        fault also a mapping by number of the generator, from 1.  With a fault or an unbalanced load
        the generator's state is periodic, and the shaft carries the mean of its power over a turn.
        ``ambient`` is the default day if not given, ``N_ref`` another governed speed than the
        unit's, rad/s.  ``limits`` are those of the trim; by default without one of temperature,
        which is no reason not to simulate.

        Raises:
            ScenarioError: another number of loads or faults than there are generators, or something
                that changes in time.
            OperatingPointError: no such point, or it needs fuel beyond the governor's limits.
        """
        amb = dataclasses.asdict(Ambient() if ambient is None else _still("ambient", ambient))
        N_ref = self.N_ref if N_ref is None else _still("N_ref", N_ref)
        loads = tuple(_still("load", x) for x in self.each("load", load))
        faults = tuple(_still("fault", x) for x in self.each_fault(fault))
        health = {n: _still(n, f) for n, f in (health or {}).items()} or None
        alike = groups(zip(self.machines, loads, faults, strict=True))
        points: dict[int, GeneratorPoint] = {}
        PW = 0.0
        for numbers, ((gen, _), own, broken) in alike.items():
            link = self.link_of(numbers)
            point = gen.steady_state(own, broken, w_r=link.w_r(N_ref), V_ref=V_ref)
            PW += link.PW(point.mean("P_total"))
            points |= dict.fromkeys(numbers, point)
        limits = Limits(T4_max=math.inf) if limits is None else limits
        gas = trim_gas_generator(
            self.gas_generator, {"N": N_ref, "PW": PW}, theta=health, limits=limits, **amb
        )
        Wf, g = gas["Wf"], self.governor
        if not g.Wf_min <= Wf <= g.Wf_max:
            raise OperatingPointError(
                f"steady state needs Wf = {Wf:.5f} kg/s for PW = {PW / 1e3:.1f} kW, outside the "
                f"governor's limits [{g.Wf_min:g}, {g.Wf_max:g}]"
            )
        first, *others = (points[k] for k in sorted(points))
        return JointPoint(gas, first, tuple(others) if len(alike) > 1 else ())


def _still(what: str, value: Any) -> Any:
    return fixed(value, what, "a steady state")


def groups(of_each: Iterable[T]) -> dict[tuple[int, ...], T]:
    """Return what is equal once, by the numbers, from 1, of those that have it."""
    found: list[tuple[list[int], T]] = []
    for k, each in enumerate(of_each, 1):
        numbers = next((n for n, other in found if other == each), None)
        if numbers is None:
            found.append(([k], each))
        else:
            numbers.append(k)
    return {tuple(numbers): each for numbers, each in found}


_EACH = ("machine", "exciter", "coupling")
#: What :meth:`Apu.change` takes of a linear machine, which has none.
_UNSATURATED = {"machine.S_10": 0.0, "machine.S_12": 0.0}


def _words(gen: Generator) -> dict[str, str]:
    """Return what is chosen by a word."""
    return {n: getattr(gen, n) for n in CHOICES}


def _values(prefix: str, p: Parameters) -> dict[str, Any]:
    return {f"{prefix}.{f.name}": getattr(p, f.name) for f in dataclasses.fields(p)}


def _of_each(machine: OnShaft) -> dict[str, Any]:
    """Return the parameters of a generator and its gear by name."""
    gen, gear = machine
    parts = zip(_EACH, (gen.machine, gen.exciter, gear), strict=True)
    own = {n: v for s, p in parts for n, v in _values(s, p).items()}
    return _UNSATURATED | own | _words(gen)


def _which(key: re.Match[str], machines: Sequence[OnShaft]) -> tuple[int, str]:
    """Return number and parameter of a key such as ``generator2.machine.r_s``."""
    names = [*_of_each(machines[0])]
    k, name = int(key[1]), key[2]
    if k not in range(1, len(machines) + 1):
        raise ParameterError(f"{key[0]!r}: the unit has generators 1 to {len(machines)}")
    if name not in names:
        valid = [f"generator{k}.{n}" for n in names]
        raise ParameterError(f"unknown parameter {key[0]!r} {nearest(key[0], valid)}")
    return k, name


def _changed(on_shaft: OnShaft, values: Mapping[str, Any]) -> OnShaft:
    """Return a generator and its gear with other values, by the names of :func:`_of_each`."""
    if not values:
        return on_shaft
    gen, gear = on_shaft
    rest = {n: v for n, v in values.items() if n not in _UNSATURATED}
    magnetic = magnetics(gen.machine, *map(values.get, _UNSATURATED))
    sets: list[Any] = [
        p.change(**{n.partition(".")[2]: v for n, v in rest.items() if n.startswith(f"{s}.")})
        for s, p in zip(_EACH, (magnetic, gen.exciter, gear), strict=True)
    ]
    m, e, c = sets
    words = {n: values.get(n, v) for n, v in _words(gen).items()}
    return OnShaft(dataclasses.replace(gen, machine=m, exciter=e, **words), c)


def trim(
    model: GasGenerator | Generator | Apu,
    fixed: Mapping[str, Any] | None = None,
    *,
    load: Load | Sequence[Load] | None = None,
    **conditions: Any,
) -> OperatingPoint | GeneratorPoint | JointPoint:
    """Solve a steady operating point of any of the models; no guess is asked for.

    Args:
        model: what is to be trimmed.
        fixed: of a gas generator, two outputs by name with their values, SI; see
            :func:`apu_casadi.gaspath.steady.trimming.trim_gas_generator`.
        load: of a generator, or of each generator of a unit; for a unit also a list with one for
            each generator.
        conditions: of a gas generator ``theta``, ``limits``, altitude (m), Mach, dT_isa (K), war;
            of a generator ``fault``, ``w_r`` (rad/s, electrical), ``theta_e`` (rad) and ``V_t`` (V
            rms), ``V_ref`` or ``V_fd`` (V); of a unit ``fault``, ``ambient``, ``health``,
            ``V_ref``, ``limits``.

    Raises:
        SignalError: arguments that this model does not take, or too few.
        OperatingPointError: no such point; says why, and the best point reached.

    Examples:
        >>> from apu_casadi.machine.loads.series import SeriesLoad
        >>> round(trim(Apu(), load=SeriesLoad.from_power(100e3)).gas["Wf"], 4)
        0.0297
    """
    if isinstance(model, GasGenerator):
        if fixed is None or load is not None:
            raise SignalError("a gas generator is trimmed by two fixed outputs, not by a load")
        return trim_gas_generator(model, fixed, **conditions)
    if not isinstance(model, Generator | Apu):
        raise SignalError(
            f"a GasGenerator, Generator or Apu can be trimmed, got {type(model).__name__}"
        )
    if load is None or fixed is not None:
        raise SignalError(f"{type(model).__name__} is trimmed by its load: give load=...")
    if isinstance(model, Apu):
        return model.steady_state(load, **conditions)
    return model.steady_state(_one(load), **conditions)


def _one(load: Load | Sequence[Load]) -> Load:
    if isinstance(load, Sequence):
        raise SignalError("a generator is trimmed by one load; a unit by one for each generator")
    return load
