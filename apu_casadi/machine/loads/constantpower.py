"""Three equal conductances G that follow the voltage so as to draw a constant power.

    tau dG/dt = P / (v_a^2 + v_b^2 + v_c^2) - G

An ideal constant-power load has no consistent start beside flux states; the lag gives it one.
Below ``V_MIN`` of the rated voltage the conductance is held, as undervoltage does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, Self

import casadi as ca

from apu_casadi.core.register import Key
from apu_casadi.core.signals import Signal
from apu_casadi.machine.loads.load import LOADS, AtLoad, Load, Own, in_range
from apu_casadi.machine.loads.series import POWER
from apu_casadi.machine.park import Abc, Qd0

#: Fraction of the rated voltage below which a constant-power load is a constant conductance.
V_MIN = 0.3


@LOADS.add("constant_power")
@dataclass(frozen=True)
class ConstantPowerLoad(Load):
    """Three equal conductances that follow the voltage so as to draw a constant power.

    Args:
        P: power of all three phases, W, > 0.
        tau: lag, s, > 0.
    """

    P: float
    tau: float = 2e-3
    kind: str = field(default="constant_power", init=False)

    tables: ClassVar[Mapping[str, tuple[Key, ...]]] = MappingProxyType(
        {"constant_power": (POWER, Key("lag_ms", "ms", "lag", 0.1, 1000.0, default=2.0))}
    )
    linear = False
    caveat: ClassVar[str] = (
        f"a constant-power load is a conductance below {V_MIN:g} of rated voltage"
    )

    def __post_init__(self) -> None:
        in_range("ConstantPowerLoad.P [W] (an open generator is OpenLoad)", self.P, above=0.0)
        in_range("ConstantPowerLoad.tau [s]", self.tau, above=0.0)

    @property
    def own(self) -> Own:
        """P_load, tau_load and the conductance G_load."""
        return Own(
            (
                Signal("P_load", "W", "power of the constant-power load", nominal=2e5),
                Signal("tau_load", "s", "lag of the constant-power load", nominal=2e-3),
            ),
            (Signal("G_load", "S", "conductance of the constant-power load"),),
        )

    def drop(self, at: AtLoad) -> Abc:
        """Return i / G."""
        return Abc(*(i / at.x["G_load"] for i in at.i))

    def rates(self, at: AtLoad) -> dict[str, Any]:
        """Return dG/dt."""
        V_2 = sum((v**2 for v in at.v), ca.SX(0))
        G = at.u["P_load"] / ca.fmax(V_2, 3.0 * (V_MIN * at.V_rated) ** 2)
        return {"G_load": (G - at.x["G_load"]) / at.u["tau_load"]}

    @classmethod
    def examples(cls) -> dict[str, Load]:
        """Return 100 kW."""
        return {"constant_power": cls(100e3)}

    @property
    def inputs(self) -> dict[str, float]:
        """P_load, W, and tau_load, s."""
        return {"P_load": self.P, "tau_load": self.tau}

    @property
    def balanced(self) -> bool:
        """Always true."""
        return True

    def impedance(self, w_r: float, V_t: float) -> complex:
        """Return 1/G where the power is drawn."""
        return complex(3.0 * V_t**2 / self.P, 0.0)

    def steady(self, w_r: float, V_t: float, i: Qd0) -> dict[str, float]:
        """Return G."""
        return {"G_load": 1.0 / self.impedance(w_r, V_t).real}

    def start(
        self, before: Mapping[str, float], u: Mapping[str, float], V_rated: float
    ) -> dict[str, float]:
        """Return the G that was there, or the one that draws the power at once."""
        if "G_load" in before:
            return {"G_load": before["G_load"]}
        V_2 = max(3.0 * before["V_t"] ** 2, 3.0 * (V_MIN * V_rated) ** 2)
        return {"G_load": u["P_load"] / V_2}

    @property
    def demand(self) -> float:
        """The power, W."""
        return self.P

    @property
    def label(self) -> str:
        """The power, as in ``'90 kW, constant power'``."""
        return f"{self.P / 1e3:g} kW, constant power"

    @classmethod
    def from_keys(cls, word: str, values: dict[str, Any]) -> Self:
        """Make the load from power_kW and lag_ms."""
        return cls(1e3 * values["power_kW"], tau=values["lag_ms"] / 1e3)

    def to_table(self) -> dict[str, Any]:
        """Return power and lag."""
        keys = {"power_kW": round(self.P / 1e3, 12), "lag_ms": round(1e3 * self.tau, 12)}
        return {"kind": "constant_power", **keys}
