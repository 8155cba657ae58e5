"""No load: a bleed resistance in each phase stands for the voltmeter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar

from apu_casadi.core.register import Key
from apu_casadi.machine.loads.load import LOADS, Load, stiffness
from apu_casadi.machine.loads.series import Impedance, check_R


@LOADS.add("open")
@dataclass(frozen=True)
class OpenLoad(Impedance):
    """No load: a bleed resistance per phase stands for the voltmeter.

    Terminal voltage is then a small current times a large resistance, and an integrator sees the
    current only: ``fineness`` tightens its tolerances.

    Args:
        R: ohm per phase, > 0, at most ``R_MAX``; 1e4 ohm draws 16 W in all at rated voltage, 7e-5
            of the rating.
    """

    R: float = 1e4
    kind: str = field(default="resistive", init=False)

    tables: ClassVar[Mapping[str, tuple[Key, ...]]] = MappingProxyType({"open": ()})

    def __post_init__(self) -> None:
        check_R("OpenLoad.R [ohm]", self.R)

    @classmethod
    def examples(cls) -> dict[str, Load]:
        """Return none: it has the equations of a resistance."""
        return {}

    @property
    def inputs(self) -> dict[str, float]:
        """R_a, R_b, R_c, ohm."""
        return {"R_a": self.R, "R_b": self.R, "R_c": self.R}

    @property
    def balanced(self) -> bool:
        """Always true."""
        return True

    def impedance(self, w_r: float, V_t: float) -> complex:
        """Return R."""
        return complex(self.R, 0.0)

    @property
    def fineness(self) -> float:
        """By the resistance."""
        return stiffness(self.R)

    @property
    def label(self) -> str:
        """``"open"``."""
        return "open"

    def to_table(self) -> dict[str, Any]:
        """Return the table of an open generator; its resistance is the default one in files."""
        return {"kind": "open"}
