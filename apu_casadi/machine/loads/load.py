"""What an electrical load is to the generator.

A load is one class in one file, derived from :class:`Load` and entered in ``LOADS``; the generator
assembles what it contributes and knows no kind by name.  All loads are in star; the generator
decides whether the star point is joined to the machine's neutral.

Equations and signals of a load depend on its ``kind`` alone: loads of equal kind share them and
the code compiled of them.  Its numbers are ``inputs``, which may change without a new model.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Self

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError, ScenarioError
from apu_casadi.core.register import Key, Register, read_table
from apu_casadi.core.signals import Signal
from apu_casadi.machine.park import Abc, Qd0

#: Resistance, ohm, beyond which the tolerances of an integrator are tightened in proportion.
R_FINE = 1e3
#: V rms and rad/s at which powers are meant: the rated phase voltage and frequency.
V_RATED, W_RATED = 230.0, 2.0 * math.pi * 400.0


class Own(NamedTuple):
    """The signals that a load or a fault brings into the model: inputs, states, unknowns."""

    inputs: tuple[Signal, ...] = ()
    states: tuple[Signal, ...] = ()
    unknowns: tuple[Signal, ...] = ()


class AtLoad(NamedTuple):
    """What the generator's equations offer a load: symbols, in SI units.

    Args:
        x, z, u: states, algebraic unknowns and inputs of the model by name.
        v: voltages across the load, phase terminal to star point, V.
        i, di: phase currents into the load, A, and their rates, A/s.
        theta_e, w_r: rotor angle, rad, and electrical speed, rad/s.
        V_rated: rated phase voltage, V rms.
    """

    x: dict[str, Any]
    z: dict[str, Any]
    u: dict[str, Any]
    v: Abc
    i: Abc
    di: Abc
    theta_e: Any
    w_r: Any
    V_rated: Any


class Load(ABC):
    """Base of all loads; a subclass is a frozen dataclass of SI values that checks itself.

    Needed: ``kind``, ``inputs``, ``own``, ``drop``, ``balanced``, ``impedance``, ``label`` and
    ``examples``.  The rest has defaults: no states, linear, nothing to start, no stiffness.
    """

    #: Words for it in a scenario file, each with the keys that it takes.
    tables: ClassVar[Mapping[str, tuple[Key, ...]]] = {}
    #: Whether drop and rates are linear in states and currents at constant speed (propagator).
    linear: ClassVar[bool] = True
    #: Own states that change their sign when the rotor has turned by half a turn: what belongs to
    #: phases or to the zero sequence, as opposed to the rotor's axes.
    reversing: ClassVar[tuple[str, ...]] = ()

    #: Where the load is not what its name says, for messages.
    caveat: ClassVar[str] = ""

    # -- structure: depends on ``kind`` alone ---------------------------------------------------

    @property
    @abstractmethod
    def kind(self) -> str:
        """Names the equations; a Python identifier."""

    @property
    @abstractmethod
    def own(self) -> Own:
        """Inputs, states and algebraic unknowns."""

    @abstractmethod
    def drop(self, at: AtLoad) -> Abc:
        """Return the voltage across each phase, V, from currents, their rates and own states."""

    def rates(self, at: AtLoad) -> dict[str, Any]:
        """Return d/dt of the own states by name."""
        return {}

    def residuals(self, at: AtLoad) -> list[Any]:
        """Return what must vanish for the own unknowns, linear in all unknowns, in their order."""
        return []

    def inductive(self, phase: str) -> bool:
        """Whether ``drop`` of the phase takes the rate of its current, which then cannot jump."""
        return False

    @classmethod
    @abstractmethod
    def examples(cls) -> dict[str, Load]:
        """Return a typical load of each kind that the class brings, by kind."""

    # -- numbers --------------------------------------------------------------------------------

    @property
    @abstractmethod
    def inputs(self) -> dict[str, float]:
        """Values of the own inputs by name."""

    @property
    @abstractmethod
    def balanced(self) -> bool:
        """Whether the three phases are equal."""

    @property
    def balanced_part(self) -> Load:
        """A balanced load to start from; the load itself if it is balanced."""
        if self.balanced:
            return self
        raise ParameterError(f"{self!r} is not balanced and names no balanced load to start from")

    @abstractmethod
    def impedance(self, w_r: float, V_t: float) -> complex:
        """Return the impedance of each phase of a balanced load at rest, ohm.

        Args:
            w_r: electrical speed, rad/s.
            V_t: terminal voltage, V rms.
        """

    def steady(self, w_r: float, V_t: float, i: Qd0) -> dict[str, float]:
        """Return the own states of a balanced load at rest, with its current ``i``, A."""
        return {}

    def start(
        self, before: Mapping[str, float], u: Mapping[str, float], V_rated: float
    ) -> dict[str, float]:
        """Return the own states just after a switch; equal names are continued, others zero.

        Args:
            before: outputs and states just before it, by name.
            u: inputs from then on, by name.
            V_rated: rated phase voltage, V rms.
        """
        return {s.name: before.get(s.name, 0.0) for s in self.own.states}

    @property
    def fineness(self) -> float:
        """Factor, at most 1, on an integrator's tolerances."""
        return 1.0

    @property
    def demand(self) -> float:
        """Power that the load sees to get, W; 0 where it takes what the voltage gives."""
        return 0.0

    @property
    @abstractmethod
    def label(self) -> str:
        """The load in a few words."""

    # -- scenario files -------------------------------------------------------------------------

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Load:
        """Make the load from a scenario's table with ``kind`` and the keys of ``tables``.

        Raises:
            ScenarioError: a key or value that is wrong; the text starts with the key.
        """
        word = table["kind"]
        rest = {k: v for k, v in table.items() if k != "kind"}
        return cls.from_keys(word, read_table(f"a {word!r} load", cls.tables[word], rest))

    @classmethod
    def from_keys(cls, word: str, values: dict[str, Any]) -> Self:
        """Make the load from the checked keys of one of its words."""
        return cls(**values)

    def to_table(self) -> dict[str, Any]:
        """Return the table that :meth:`from_table` reads; of one word whose keys are the fields."""
        word, *more = self.tables or ("",)
        keys = [k.name for k in self.tables.get(word, ())]
        if more or not word or not all(hasattr(self, k) for k in keys):
            raise ScenarioError(f"a {type(self).__name__} has no words in a scenario file")
        return {"kind": word, **{k: getattr(self, k) for k in keys}}

    def is_told_by(self, table: Mapping[str, Any]) -> bool:
        """Whether the table, read, gives this very load."""
        try:
            return self.from_table(table) == self
        except ScenarioError:
            return False


class Branches(Load):
    """An impedance in each phase, of resistances ``R``, ohm, and something in series with them."""

    R: tuple[float, float, float]

    @property
    @abstractmethod
    def Z_rated(self) -> list[complex]:
        """Impedance of each phase at 400 Hz, ohm."""

    @property
    def Z_mean(self) -> complex:
        """Impedance of the mean admittance at 400 Hz, ohm."""
        return 3 / sum(1 / z for z in self.Z_rated)

    @property
    def fineness(self) -> float:
        """By the largest resistance."""
        return stiffness(max(self.R))

    @property
    def label(self) -> str:
        """Power, power factor and unbalance at 230 V and 400 Hz, as in ``'225 kW'``."""
        return power_words(self.Z_rated, self.balanced)


LOADS: Register[type[Load]] = Register("load", "apu_casadi.machine.loads")


def load_from_table(table: Mapping[str, Any]) -> Load:
    """Return the load that a scenario's table describes.

    Raises:
        ScenarioError: no kind or an unknown one, or a wrong key or value; starts with the key.
    """
    if "kind" not in table:
        raise ScenarioError(f"kind: missing: one of {', '.join(LOADS)}")
    return LOADS.of_kind(table["kind"]).from_table(table)


def load_of(**table: Any) -> Load:
    """Return the load of a table's keys; as :func:`load_from_table`."""
    return load_from_table(table)


@dataclass(frozen=True)
class LoadStructure:
    """What a model is built of: equal for all loads of one kind of one class.

    Args:
        kind: of the load.
        owner: the class that writes the equations.
        load: any load of that kind.
    """

    kind: str
    owner: type
    load: Load = field(compare=False, repr=False)

    @classmethod
    def of(cls, load: Load) -> LoadStructure:
        """Return the structure of a load."""
        names = ("own", "drop", "rates", "residuals", "linear", "reversing")
        return cls(load.kind, writer(type(load), names), load)


def writer(cls: type, names: tuple[str, ...]) -> type:
    """Return the class that writes one of the names anew, the last to do so: itself or a base."""
    return next(c for c in cls.__mro__ if any(n in vars(c) for n in names))


def by_phase(name: str, unit: str, doc: str, nominal: float = 1.0) -> tuple[Signal, ...]:
    """Return the signals ``name_a``, ``name_b``, ``name_c``; ``{}`` in ``doc`` is the letter."""
    return tuple(Signal(f"{name}_{k}", unit, doc.format(k), nominal=nominal) for k in "abc")


def in_range(where: str, value: object, *, above: float | None = None) -> None:
    """Refuse what is no finite number, or not >= 0 or > ``above``."""
    value = number(where, value, error=ParameterError)
    if not math.isfinite(value):
        raise ParameterError(f"{where} must be a finite number, got {value!r}")
    if above is None and value < 0:
        raise ParameterError(f"{where} = {value:g} must be >= 0")
    if above is not None and not value > above:
        raise ParameterError(f"{where} = {value:g} must be > {above:g}")


def three(where: str, values: object) -> None:
    """Refuse what is no tuple of three values."""
    if not isinstance(values, tuple) or len(values) != 3:
        raise ParameterError(f"{where} needs a tuple of three values (a, b, c), got {values!r}")


def all_equal(*values: tuple[float, float, float]) -> bool:
    """Whether the phases are equal to rounding."""
    return all(math.isclose(x, v[0], rel_tol=1e-12, abs_tol=0.0) for v in values for x in v)


def stiffness(R: float) -> float:
    """Return the factor on tolerances that a largest resistance of a phase, ohm, asks for.

    ``R_FINE`` over it, but not below 1e-2, where rounding begins: 1e-10 and 1e-12 beside the
    defaults.  An open phase's voltage is then right to 1e-5 up to the largest resistance allowed.
    """
    return min(1.0, max(1e-2, R_FINE / R))


def split_power(
    where: str,
    P: float,
    power_factor: float,
    V_rms: float,
    f: float,
    unbalance: tuple[float, float, float],
) -> list[complex]:
    """Return abs(R + jX) per phase, ohm, X >= 0, that draw a power from a balanced rated voltage.

    Raises:
        ParameterError: a value out of range; ``where`` begins the text.
    """
    in_range(f"{where}: P [W] (an open generator is OpenLoad)", P, above=0.0)
    in_range(f"{where}: V_rms [V]", V_rms, above=0.0)
    in_range(f"{where}: f [Hz]", f, above=0.0)
    in_range(f"{where}: power_factor", power_factor, above=0.0)
    if power_factor > 1:
        raise ParameterError(f"{where}: power_factor = {power_factor:g} is outside (0, 1]")
    three(f"{where}: unbalance", unbalance)
    Z = []
    for k, share in zip("abc", unbalance, strict=True):
        in_range(f"{where}: unbalance of phase {k}", share, above=0.0)
        size = V_rms**2 * power_factor / (P * share / sum(unbalance))
        Z.append(complex(size * power_factor, size * math.sqrt(1.0 - power_factor**2)))
    return Z


def power_words(Z: list[complex], balanced: bool) -> str:
    """Return in words what impedances, ohm, draw at rated voltage: power, power factor, phases."""
    S = [V_RATED**2 / z.conjugate() for z in Z]
    total = sum(S)
    P, pf = total.real, total.real / abs(total)
    words = f"{P / 1e3:.5g} kW"
    if pf <= 1 - 1e-9:
        words += f", power factor {pf:.3g}" + ("" if total.imag > 0 else " leading")
    if balanced:
        return words
    return f"{words}, unbalanced ({', '.join(f'{s.real / 1e3:.4g}' for s in S)} kW)"


def power_keys(Z: list[complex]) -> dict[str, Any]:
    """Return power_kW, power_factor and unbalance that describe impedances, ohm, near rounding."""
    S = [V_RATED**2 / z.conjugate() for z in Z]
    P = sum(s.real for s in S)
    keys: dict[str, Any] = {"power_kW": round(P / 1e3, 9)}
    keys["power_factor"] = round(P / abs(sum(S)), 12)
    shares = [round(3.0 * s.real / P, 12) for s in S]
    if any(s != 1.0 for s in shares):
        keys["unbalance"] = shares
    return keys
