"""A phase of a load is open: a fuse has blown, a contact or a wire is broken.

What is left draws what it drew; the open phase keeps a bleed resistance, the voltmeter's, since a
current that is forced to zero would tie flux linkages together.  Its voltage is a small current
times a large resistance, as at an open generator.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Self

from apu_casadi.core.errors import ParameterError, ScenarioError
from apu_casadi.core.register import Key
from apu_casadi.machine.loads.load import LOADS, Load, stiffness
from apu_casadi.machine.loads.series import FACTOR, POWER, Impedance, SeriesLoad, check_R
from apu_casadi.machine.park import PHASES

_BEFORE = Key("power_kW", "kW", "power of the three phases before", POWER.lo, POWER.hi)
_FACTOR = Key("power_factor", "1", FACTOR.doc, FACTOR.lo, FACTOR.hi, default=1.0)


@LOADS.add("open_phase")
@dataclass(frozen=True)
class OpenPhase(Impedance):
    """A load with one phase open.

    Args:
        rest: the load with all three phases; that of the open one does not count.
        phase: "a", "b" or "c".
        R_open: what is left in the open phase, ohm, > 0, at most ``R_MAX``; as of an open load.

    Raises:
        ParameterError: no such phase, or a value out of range.
    """

    rest: SeriesLoad
    phase: str = "a"
    R_open: float = 1e4

    tables: ClassVar[Mapping[str, tuple[Key, ...]]] = MappingProxyType(
        {"open_phase": (_BEFORE, _FACTOR, Key("phase", "1", "open phase", choices=PHASES))}
    )

    def __post_init__(self) -> None:
        if not isinstance(self.rest, SeriesLoad):
            raise ParameterError(f"OpenPhase.rest must be a SeriesLoad, got {self.rest!r}")
        if self.phase not in PHASES:
            raise ParameterError(f"OpenPhase.phase must be 'a', 'b' or 'c', got {self.phase!r}")
        check_R("OpenPhase.R_open [ohm]", self.R_open)

    @property
    def kind(self) -> str:
        """That of the rest."""
        return self.rest.kind

    def inductive(self, phase: str) -> bool:
        """Whether the phase is closed and has an inductance."""
        return phase != self.phase and self.rest.inductive(phase)

    @classmethod
    def examples(cls) -> dict[str, Load]:
        """Return none: it has the equations of an impedance."""
        return {}

    @property
    def inputs(self) -> dict[str, float]:
        """Those of the rest, with the bleed resistance in the open phase."""
        own = {f"R_{self.phase}": float(self.R_open), f"L_{self.phase}": 0.0}
        return {n: own.get(n, v) for n, v in self.rest.inputs.items()}

    @property
    def balanced(self) -> bool:
        """Never."""
        return False

    @property
    def balanced_part(self) -> Load:
        """The load before the phase opened."""
        return self.rest.balanced_part

    def impedance(self, w_r: float, V_t: float) -> complex:
        """Return that of the rest."""
        return self.rest.impedance(w_r, V_t)

    @property
    def fineness(self) -> float:
        """By the bleed resistance."""
        return stiffness(self.R_open)

    @property
    def label(self) -> str:
        """The load before, and which phase is open."""
        return f"{self.rest.label}, phase {self.phase} open"

    @classmethod
    def from_keys(cls, word: str, values: dict[str, Any]) -> Self:
        """Make the load from power, power factor and phase."""
        rest = SeriesLoad.from_power(1e3 * values["power_kW"], values["power_factor"])
        return cls(rest, values["phase"])

    def to_table(self) -> dict[str, Any]:
        """Return the table; it has no words for another rest than from_power makes."""
        table = {**self.rest.to_table(), "kind": "open_phase", "phase": self.phase}
        if self.is_told_by(table):
            return table
        raise ScenarioError(f"{self!r} has no words in a scenario file: give R and L by 'series'")
