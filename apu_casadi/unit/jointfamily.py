"""The numbers of the whole unit as parameters of its continuous models.

Behind health factors and severities, theta of a family has the numbers of the gas generator, of
machine and exciter, of the governor and of the gearbox, each under its dotted name.  Those of the
gas generator are held, without derivatives, unless some of them are asked for: then they are its
parameters alone, and the design point is solved inside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import casadi as ca

from apu_casadi.core.sharing import keep
from apu_casadi.core.signals import Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.cyclefunctions import CycleFunctions
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.unitnumbers import GIVEN
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.control import Governor
from apu_casadi.unit.exchange import Link, Machine

T = TypeVar("T")
_HEALTH = GasGenerator.THETA


class JointFamily(NamedTuple):
    """What the models of all units of a structure are written of.

    Args:
        engines: the cycle's functions.
        gen: the model of all generators.
        severity: its parameters beside numbers.
        governor, coupling: of one of the units; their numbers do not matter.
        pairs: number of generators over two.
        structure: what of these does matter.
        free: whether there are derivatives by the numbers.
    """

    engines: CycleFunctions
    gen: StateSpace
    severity: Signals
    governor: Governor
    coupling: Signals
    pairs: float
    structure: tuple[Any, ...]
    free: bool

    @classmethod
    def of(cls, apu: Apu, gen: StateSpace, free: Sequence[str] = ()) -> JointFamily:
        """Return that of a unit and its generator's model; ``free`` are to have derivatives."""
        gg, coupling, link = apu.gas_generator, apu.coupling.signals("coupling"), apu.link
        engines = gg.by_parameters if any(n in GIVEN for n in free) else gg.family
        law, structure = apu.governor, (*link.structure, link.pairs, bool(free))
        assert gen.family is not None
        own = gen.family, gen.theta, law, coupling
        return cls(engines, *own, link.pairs, structure, bool(free))

    def keep(self, what: tuple[Any, ...], make: Callable[[], T]) -> T:
        """Return what ``make`` makes of it, made once for all units of the structure."""
        return keep(self.engines, JointFamily, (self.gen, self.structure, *what), make)

    @property
    def z(self) -> Signals:
        """The algebraic unknowns, with the default engine's design values as magnitudes."""
        return GasGenerator().z

    @property
    def theta(self) -> Signals:
        """Health factors, severities and numbers."""
        engine, machine = self.engines.theta[len(_HEALTH) :], self.gen.theta[len(self.severity) :]
        law = self.governor.signals("governor")
        return Signals([*_HEALTH, *self.severity, *engine, *machine, *law, *self.coupling])

    def parts(self, theta: Any, N_ref: Any = None) -> tuple[Any, Any, Link]:
        """Return theta of the cycle and of the generator, and gearbox and governor, of symbols.

        Args:
            theta: in the order of :attr:`theta`.
            N_ref: governed speed, rad/s; None: that of the engine's numbers.
        """
        at = dict(zip(self.theta.names, ca.vertsplit(theta), strict=True))
        law = self.governor.symbolic(**{n: at[f"governor.{n}"] for n in self.governor.numbers})
        N_ref = at["gas_generator.N"] if N_ref is None else N_ref
        gear = at["coupling.gear"], at["coupling.eta_gtSg"], at["machine.n_pp"]
        engine, gen = (
            theta[self.theta.indices(s.theta.names), :] for s in (self.engines, self.gen)
        )
        return engine, gen, Link(law, N_ref, *gear, self.pairs)

    @property
    def machine(self) -> Machine:
        """The generators' model for use in others; no derivatives by numbers that are not free."""
        gen, n = self.gen, len(self.severity)
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
        self, apu: Apu, gen: StateSpace, family: StateSpace, free: Sequence[str] = ()
    ) -> StateSpace:
        """Return the model of a unit of a family that was written of this.

        Args:
            free: parameters that are put behind theta, with their values as defaults.
        """
        held = apu.gas_generator.held | gen.held
        held |= apu.governor.held("governor") | apu.coupling.held("coupling")
        own = len(_HEALTH) + len(self.severity)
        numbers = [held[n] for n in family.theta.names[own:]]
        made = StateSpace.member(family.name, family, Signals(family.theta[:own]), numbers)
        return made.with_free(*free) if free else made
