"""The numbers of the whole unit as parameters of its continuous models.

Generators of equal model, gear, load and fault are one group, computed once.  Where there is one
group, its signals have the names of the generator's model; where there are several, those of each
stand behind the number of its first generator: ``generator2.lam_fd``, ``generator2.h``.

Behind health factors and severities, theta of a family has the numbers of the gas generator, of
machines and exciters, of the governor and of the gearboxes, each under its dotted name.  Those of
the gas generator are held, without derivatives, unless some of them are asked for: then they are
its parameters alone, and the design point is solved inside.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

import casadi as ca

from apu_casadi.core.errors import SignalError
from apu_casadi.core.sharing import keep
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.cyclefunctions import CycleFunctions
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.unitnumbers import GIVEN
from apu_casadi.unit.apu import Apu, CouplingParameters
from apu_casadi.unit.control import Governor
from apu_casadi.unit.events import who
from apu_casadi.unit.exchange import Driven, Link, Machine

T = TypeVar("T")
_HEALTH = GasGenerator.THETA


N_REF = Signal("N_ref", "rad/s", "governed rotor speed", nominal=3775.0)
"""The governor's input of models that have it."""


def of_group(signals: Iterable[Signal], prefix: str, numbers: tuple[int, ...]) -> Iterable[Signal]:
    """Return signals of one generator as a unit has them; without a prefix there is one group."""
    if not prefix:
        return signals
    of = who(numbers)
    return [dataclasses.replace(s, name=prefix + s.name, doc=f"{of}: {s.doc}") for s in signals]


class Group(NamedTuple):
    """Equal generators.

    Args:
        numbers: which, from 1.
        gen: the model of one of them.
        coupling: their gear.
        alone: whether there is no other group.
    """

    numbers: tuple[int, ...]
    gen: StateSpace
    coupling: CouplingParameters
    alone: bool

    @property
    def prefix(self) -> str:
        """What stands before the names of its signals."""
        return "" if self.alone else f"generator{self.numbers[0]}."

    def own(self, signals: Iterable[Signal]) -> Signals:
        """Return signals of one generator under the names that they have in the unit."""
        return Signals(of_group(signals, self.prefix, self.numbers))

    def named(self, values: Mapping[str, T]) -> dict[str, T]:
        """Return values of one generator by the names that they have in the unit."""
        return {self.prefix + n: v for n, v in values.items()}

    def of(self, values: Mapping[str, T]) -> dict[str, T]:
        """Return what is its own of values of the unit, by the names of one generator."""
        n = len(self.prefix)
        return {k[n:]: v for k, v in values.items() if k.startswith(self.prefix)}

    @property
    def severity(self) -> Signals:
        """Parameters of its model beside the numbers."""
        return self.own(self.gen.theta)

    @property
    def numbered(self) -> Signals:
        """Numbers of machine and exciter."""
        assert self.gen.family is not None
        return self.own(self.gen.family.theta[len(self.gen.theta) :])

    @property
    def gear(self) -> Signals:
        """Numbers of the gearbox."""
        return self.own(self.coupling.signals("coupling"))

    @property
    def held(self) -> dict[str, float]:
        """Its numbers by name."""
        return self.named(self.gen.held | self.coupling.held("coupling"))


def grouped(
    apu: Apu, of: Sequence[tuple[int, ...]], gens: Mapping[tuple[int, ...], StateSpace]
) -> tuple[Group, ...]:
    """Return the groups of these numbers, whose first generators have these models.

    Raises:
        SignalError: a generator in no group or in two, or a group whose generators differ.
    """
    n = len(apu.machines)
    if sorted(k for group in of for k in group) != [*range(1, n + 1)]:
        raise SignalError(f"groups {of}: each of the generators 1 to {n} must be in one of them")
    for group in of:
        if any(apu.machines[k - 1] != apu.machines[group[0] - 1] for k in group):
            raise SignalError(f"groups {of}: {who(group)} differ, and are no group")
    return tuple(Group(k, gens[k], apu.machines[k[0] - 1].coupling, len(of) == 1) for k in of)


class JointFamily(NamedTuple):
    """What the models of all units of a structure are written of.

    Args:
        engines: the cycle's functions.
        groups: of equal generators; the numbers of their models do not matter.
        governor: of one of the units, whose numbers do not matter either.
        structure: what of these does matter.
        free: whether there are derivatives by the numbers.
    """

    engines: CycleFunctions
    groups: tuple[Group, ...]
    governor: Governor
    structure: tuple[Any, ...]
    free: bool

    @classmethod
    def of(cls, apu: Apu, groups: Sequence[Group], free: Sequence[str] = ()) -> JointFamily:
        """Return that of a unit and its generators; ``free`` are to have derivatives."""
        gg, numbers = apu.gas_generator, tuple(g.numbers for g in groups)
        engines = gg.by_parameters if any(n in GIVEN for n in free) else gg.family
        structure = (*apu.shaft.structure, numbers, bool(free))
        return cls(engines, tuple(groups), apu.governor, structure, bool(free))

    def keep(self, what: tuple[Any, ...], make: Callable[[], T]) -> T:
        """Return what ``make`` makes of it, made once for all units of the structure."""
        families = tuple(g.gen.family for g in self.groups)
        return keep(self.engines, JointFamily, (families, self.structure, *what), make)

    @property
    def z(self) -> Signals:
        """The algebraic unknowns, with the default engine's design values as magnitudes."""
        return GasGenerator().z

    @property
    def theta(self) -> Signals:
        """Health factors, severities and numbers."""
        engine, law = self.engines.theta[len(_HEALTH) :], self.governor.signals("governor")
        severities = [s for g in self.groups for s in g.severity]
        machines = [s for g in self.groups for s in g.numbered]
        gears = [s for g in self.groups for s in g.gear]
        return Signals([*_HEALTH, *severities, *engine, *machines, *law, *gears])

    @property
    def own(self) -> int:
        """How many of theta are no numbers: health factors and severities."""
        return len(_HEALTH) + sum(len(g.gen.theta) for g in self.groups)

    def shaft(self, theta: Any, N_ref: Any = None) -> Link:
        """Return the governor, of symbols.

        Args:
            theta: in the order of :attr:`theta`.
            N_ref: governed speed, rad/s; None: that of the engine's numbers.
        """
        at = dict(zip(self.theta.names, ca.vertsplit(theta), strict=True))
        law = self.governor.symbolic(**{n: at[f"governor.{n}"] for n in self.governor.numbers})
        return Link(law, at["gas_generator.N"] if N_ref is None else N_ref)

    def engine(self, theta: Any) -> Any:
        """Return theta of the cycle."""
        return theta[self.theta.indices(self.engines.theta.names), :]

    def driven(
        self, shaft: Link, theta: Any, x: Sequence[Any], inputs: Mapping[str, Any]
    ) -> list[Driven]:
        """Return the generators on the shaft.

        Args:
            shaft, theta: as of :meth:`shaft`.
            x: states of each group.
            inputs: of the unit by name.
        """
        at, made = dict(zip(self.theta.names, ca.vertsplit(theta), strict=True)), []
        for g, x_gen in zip(self.groups, x, strict=True):
            own = g.of(at)
            link = dataclasses.replace(
                shaft,
                gear=own["coupling.gear"],
                eta_gtSg=own["coupling.eta_gtSg"],
                n_pp=own["machine.n_pp"],
                pairs=len(g.numbers) / 2,
            )
            names = [*g.severity.names, *g.numbered.names]
            mine = theta[self.theta.indices(names), :]
            made.append(Driven(link, self._machine(g), x_gen, mine, g.of(inputs)))
        return made

    def _machine(self, group: Group) -> StateSpace | Machine:
        """A generators' model for use in others; no derivatives by numbers that are not free."""
        gen, n = group.gen.family, len(group.gen.theta)
        assert gen is not None
        if self.free:
            return Machine(gen.u, gen.y, gen.f, gen.g)
        sizes = {"x": len(gen.x), "u": len(gen.u), "h": n, "c": len(gen.theta) - n}
        x, u, h, c = args = [ca.SX.sym(k, m) for k, m in sizes.items()]
        held = {"is_diff_in": [True, True, True, False], "cse": True}
        f, g = (
            ca.Function(name, args, [fun(x, u, ca.vertcat(h, c))], held)
            for name, fun in (("rates", gen.f), ("outputs", gen.g))
        )
        return Machine(
            gen.u,
            gen.y,
            lambda x, u, theta: f(x, u, theta[:n], theta[n:]),
            lambda x, u, theta: g(x, u, theta[:n], theta[n:]),
        )

    def member(
        self, apu: Apu, groups: Sequence[Group], family: StateSpace, free: Sequence[str] = ()
    ) -> StateSpace:
        """Return the model of a unit of a family that was written of this.

        Args:
            groups: of the unit, with its numbers.
            free: parameters that are put behind theta, with their values as defaults.
        """
        held = apu.gas_generator.held | apu.governor.held("governor")
        for g in groups:
            held |= g.held
        own = self.own
        numbers = [held[n] for n in family.theta.names[own:]]
        made = StateSpace.member(family.name, family, Signals(family.theta[:own]), numbers)
        return made.with_free(*free) if free else made
