"""What a fault is to the generator.

A fault is one class in one file, derived from :class:`Fault` and entered in ``FAULTS``; the
generator assembles what it contributes and knows none by name.  One holds at a time.

Its ``kind`` names the equations, which may depend on the load and the neutral beside it.  Its
numbers are parameters theta, which may change without a new model.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

from apu_casadi.core.register import Key, Register, read_table
from apu_casadi.core.signals import Signal
from apu_casadi.machine.loads.load import Load, writer
from apu_casadi.machine.machinedata import MachineParameters
from apu_casadi.machine.park import Abc


class Own(NamedTuple):
    """The signals that a fault brings into the model: parameters theta, states, unknowns."""

    theta: tuple[Signal, ...] = ()
    states: tuple[Signal, ...] = ()
    unknowns: tuple[Signal, ...] = ()


class Branch(NamedTuple):
    """What flows in the phases beside the effective currents, in i = ibar + branch; A and A/s.

    Args:
        current, rate: by phase.
        zero, zero_rate: their mean over the phases, the zero sequence.
    """

    current: Abc
    rate: Abc
    zero: Any
    zero_rate: Any


class AtFault(NamedTuple):
    """What the generator's equations offer a fault: symbols, in SI units.

    Args:
        kind: which equations are wanted.
        p: machine parameters, of the healthy machine.
        x, z, theta: states, algebraic unknowns and parameters of the model by name.
        v, w1: winding voltages and process noise of (5) by phase, V.
        i: terminal currents by phase, A; absent where they are not known yet.
    """

    kind: str
    p: MachineParameters
    x: dict[str, Any]
    z: dict[str, Any]
    theta: dict[str, Any]
    v: Abc
    w1: Abc
    i: Abc | None = None


class Fault(ABC):
    """Base of all faults; a subclass is a frozen dataclass of numbers that checks itself.

    Needed: ``kind``, ``own``, ``parameters`` and ``examples``.  The rest has defaults: nothing of
    the machine changes.
    """

    #: Word for it in a scenario file, and the keys that it takes.
    word: ClassVar[str] = ""
    keys: ClassVar[tuple[Key, ...]] = ()
    #: Keys that may stand in place of others, by these; ``resolved`` puts the others.
    instead: ClassVar[Mapping[str, Key]] = {}
    #: Own states that change their sign when the rotor has turned by half a turn.
    reversing: ClassVar[tuple[str, ...]] = ()
    #: What a run stores of its severity; the defaults are those of a healthy machine.
    severities: ClassVar[tuple[Signal, ...]] = ()

    # -- structure ------------------------------------------------------------------------------

    @abstractmethod
    def kind(self, load: Load, neutral: str) -> str:
        """Return the name of the equations that are needed beside a load."""

    @abstractmethod
    def own(self, kind: str, neutral: str) -> Own:
        """Return parameters, states and unknowns of one kind.

        Raises:
            ParameterError: this kind does not exist with this neutral.
        """

    @classmethod
    @abstractmethod
    def examples(cls) -> dict[str, Fault]:
        """Return a typical fault of each kind that the class brings, by kind."""

    def machine(self, p: MachineParameters, theta: dict[str, Any]) -> MachineParameters:
        """Return the parameters of the faulty machine; ``theta`` may be symbols."""
        return p

    def branch(self, at: AtFault) -> Branch | None:
        """Return the currents beside the effective ones."""
        return None

    def residuals(self, at: AtFault) -> list[Any]:
        """Return what must vanish for the own unknowns, linear in all unknowns, in their order."""
        return []

    def rates(self, at: AtFault) -> dict[str, Any]:
        """Return d/dt of the own states by name."""
        return {}

    def loss(self, at: AtFault) -> Any:
        """Return the extra loss of the fault in (8), W."""
        return 0.0

    def outputs(self, at: AtFault, y: dict[str, Any]) -> dict[str, Any]:
        """Return outputs by name that differ from those of the healthy equations, ``y``."""
        return {}

    # -- numbers --------------------------------------------------------------------------------

    @abstractmethod
    def parameters(self, kind: str) -> dict[str, float]:
        """Return the values of theta by name."""

    def start(
        self,
        before: Mapping[str, float],
        theta_before: Mapping[str, float],
        theta: Mapping[str, float],
        states: tuple[str, ...],
    ) -> dict[str, float]:
        """Return the own states just after a switch; equal names are continued, others zero.

        Args:
            before: outputs and states just before it, by name.
            theta_before, theta: parameters before and from then on; empty where not known.
            states: the own states of the kind from then on.
        """
        return {n: before.get(n, 0.0) for n in states}

    @property
    def severity(self) -> dict[str, float]:
        """What a run stores, by the names of ``severities``."""
        return {s.name: float(getattr(self, s.name)) for s in self.severities}

    @property
    def label(self) -> str:
        """The fault in a few words."""
        return repr(self)

    # -- profiles -------------------------------------------------------------------------------

    @classmethod
    def or_none(cls, *args: Any, **values: Any) -> Fault | None:
        """Return the fault; None where a severity among its values is that of a healthy machine.

        So a severity may follow a profile that begins at zero, or goes off and on.
        """
        return None if cls.absent(values) else cls(*args, **values)

    @classmethod
    def absent(cls, values: Mapping[str, Any]) -> bool:
        """Whether a severity among values by name is that of a healthy machine."""
        return any(values.get(s.name) == s.default for s in cls.severities if s.default == 0.0)

    # -- scenario files -------------------------------------------------------------------------

    @classmethod
    def resolved(cls, table: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the table with ``keys`` alone, those of ``instead`` turned into them.

        Raises:
            ScenarioError: both are given, or a wrong value; the text starts with the key.
        """
        return table

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Fault:
        """Make the fault from a scenario's table with the ``keys``.

        Raises:
            ScenarioError: a key or value that is wrong; the text starts with the key.
        """
        return cls(**read_table(f"a {cls.word!r} fault", cls.keys, cls.resolved(table)))

    def to_table(self) -> dict[str, Any]:
        """Return the table that :func:`fault_from_table` reads."""
        values = {k.name: getattr(self, k.name) for k in self.keys}
        return {"kind": self.word, **{n: v for n, v in values.items() if v is not None}}


FAULTS: Register[type[Fault]] = Register("fault", "apu_casadi.machine.faults")


def fault_from_table(table: Mapping[str, Any], default: str = "ttsc") -> Fault:
    """Return the fault that a scenario's table describes; without a ``kind`` it is ``default``.

    Raises:
        ScenarioError: an unknown kind, or a wrong key or value; the text starts with the key.
    """
    rest = {k: v for k, v in table.items() if k != "kind"}
    return FAULTS.of_kind(table.get("kind", default)).from_table(rest)


def fault_of(**table: Any) -> Fault | None:
    """Return the fault of a table's keys; None where a severity is that of a healthy machine.

    Raises:
        ScenarioError: as :func:`fault_from_table`.
    """
    kind = FAULTS.of_kind(table.get("kind", "ttsc"))
    return None if kind.absent(table) else fault_from_table(table)


@dataclass(frozen=True)
class FaultStructure:
    """What a model is built of: equal for all faults of one kind of one class.

    Args:
        kind: of the equations.
        owner: the class that writes the equations.
        fault: any fault of that class.
    """

    kind: str
    owner: type
    fault: Fault = field(compare=False, repr=False)

    @classmethod
    def of(cls, fault: Fault, kind: str) -> FaultStructure:
        """Return the structure of a fault in the equations of a kind."""
        names = ["own", "machine", "branch", "residuals", "rates", "loss", "outputs", "reversing"]
        return cls(kind, writer(type(fault), tuple(names)), fault)
