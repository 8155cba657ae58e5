"""A resistance and a capacitor in series in each phase:  v = R i + v_C,  C dv_C/dt = i.

The capacitors' voltages are states on the rotor's axes, where they rest under a balanced load:

    d v_C,qd0/dt = T (i_k / C_k) - W_r v_C,qd0.

A load that leads the voltage feeds the machine's excitation: the field current falls, and beyond
the reactance of the q axis the generator excites itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Self

from apu_casadi.core.register import Key
from apu_casadi.core.signals import Signal
from apu_casadi.machine.loads.load import (
    LOADS,
    W_RATED,
    AtLoad,
    Branches,
    Load,
    Own,
    all_equal,
    by_phase,
    in_range,
    power_keys,
    split_power,
    three,
)
from apu_casadi.machine.loads.series import POWER, R_INPUTS, RESISTANCE, UNBALANCE, check_R
from apu_casadi.machine.park import Abc, Qd0, abc_to_qd0, qd0_to_abc, speed_voltage

STATES = ("v_Cq", "v_Cd", "v_C0")
_LEADING = Key("power_factor", "1", "power factor, leading", 0.1, 0.999, default=0.95)
_CAPACITY = Key("C_uF", "uF", "capacitance by phase", 0.0, open_lo=True, phases=True)


@LOADS.add("RC", "series_RC")
@dataclass(frozen=True)
class CapacitorLoad(Branches):
    """A resistance and a capacitor in series in each phase.

    Switched to, the capacitors are uncharged, unless the load before had such capacitors.

    Args:
        R: ohm by phase, > 0, at most 1e6.
        C: F by phase, > 0.

    Raises:
        ParameterError: a value that is not finite or out of range.
    """

    R: tuple[float, float, float]
    C: tuple[float, float, float]

    tables: ClassVar[Mapping[str, tuple[Key, ...]]] = MappingProxyType(
        {"RC": (POWER, _LEADING, UNBALANCE), "series_RC": (RESISTANCE, _CAPACITY)}
    )
    reversing: ClassVar[tuple[str, ...]] = ("v_C0",)

    def __post_init__(self) -> None:
        three("CapacitorLoad.R [ohm]", self.R)
        three("CapacitorLoad.C [F]", self.C)
        for k, R, C in zip("abc", self.R, self.C, strict=True):
            check_R(f"CapacitorLoad.R_{k} [ohm]", R)
            in_range(f"CapacitorLoad.C_{k} [F]", C, above=0.0)

    @classmethod
    def from_power(
        cls,
        P: float,
        power_factor: float,
        *,
        V_rms: float = 230.0,
        f: float = 400.0,
        unbalance: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> Self:
        """Make the load that draws ``P``, W, from a balanced rated voltage.

        Args:
            P, V_rms, f, unbalance: as for :meth:`SeriesLoad.from_power`.
            power_factor: 0 < power_factor < 1, leading.
        """
        Z = split_power("CapacitorLoad.from_power", P, power_factor, V_rms, f, unbalance)
        in_range("CapacitorLoad.from_power: 1 - power_factor", 1.0 - power_factor, above=0.0)
        C = [1.0 / (2.0 * math.pi * f * z.imag) for z in Z]
        return cls(R=(Z[0].real, Z[1].real, Z[2].real), C=(C[0], C[1], C[2]))

    @property
    def kind(self) -> str:
        """``"capacitive"``."""
        return "capacitive"

    @property
    def own(self) -> Own:
        """R_a, R_b, R_c, C_a, C_b, C_c, and the capacitors' voltages on the rotor's axes."""
        doc = "voltage of the load's capacitors"
        return Own(
            (*R_INPUTS, *by_phase("C", "F", "load capacitance, phase {}", nominal=1e-3)),
            tuple(
                Signal(n, "V", f"{doc}, {axis}", nominal=300.0)
                for n, axis in zip(STATES, ("q axis", "d axis", "zero sequence"), strict=True)
            ),
        )

    def drop(self, at: AtLoad) -> Abc:
        """Return R i + v_C."""
        v_C = qd0_to_abc(at.theta_e, Qd0(*(at.x[n] for n in STATES)))
        return Abc(*(at.u[f"R_{k}"] * i + v for k, i, v in zip("abc", at.i, v_C, strict=True)))

    def rates(self, at: AtLoad) -> dict[str, Any]:
        """Return i/C on the rotor's axes, less what their turning adds."""
        charging = Abc(*(i / at.u[f"C_{k}"] for k, i in zip("abc", at.i, strict=True)))
        rate = abc_to_qd0(at.theta_e, charging)
        turn = speed_voltage(at.w_r, Qd0(*(at.x[n] for n in STATES)))
        return {n: a - b for n, a, b in zip(STATES, rate, turn, strict=True)}

    @classmethod
    def examples(cls) -> dict[str, Load]:
        """Return 100 kW at a leading power factor of 0.95."""
        return {"capacitive": cls.from_power(100e3, 0.95)}

    @property
    def inputs(self) -> dict[str, float]:
        """R_a, R_b, R_c, ohm, and C_a, C_b, C_c, F."""
        R = dict(zip(("R_a", "R_b", "R_c"), self.R, strict=True))
        return R | dict(zip(("C_a", "C_b", "C_c"), self.C, strict=True))

    @property
    def balanced(self) -> bool:
        """Whether the three phases are equal to rounding."""
        return all_equal(self.R, self.C)

    @property
    def balanced_part(self) -> CapacitorLoad:
        """The balanced load of equal mean admittance at 400 Hz."""
        if self.balanced:
            return self
        Z = self.Z_mean
        return CapacitorLoad(R=(Z.real,) * 3, C=(-1.0 / (W_RATED * Z.imag),) * 3)

    @property
    def Z_rated(self) -> list[complex]:
        """Impedance of each phase at 400 Hz, ohm."""
        return [complex(R, -1.0 / (W_RATED * C)) for R, C in zip(self.R, self.C, strict=True)]

    def impedance(self, w_r: float, V_t: float) -> complex:
        """Return R - j/(w_r C)."""
        return complex(self.R[0], -1.0 / (w_r * self.C[0]))

    def steady(self, w_r: float, V_t: float, i: Qd0) -> dict[str, float]:
        """Return the voltages V_C = I/(j w_r C), with phasors q - j d."""
        X_C = 1.0 / (w_r * self.C[0])
        return {"v_Cq": -X_C * i.d, "v_Cd": X_C * i.q, "v_C0": 0.0}

    @classmethod
    def from_keys(cls, word: str, values: dict[str, Any]) -> Self:
        """Make the load from the keys of ``"RC"`` or ``"series_RC"``."""
        if word == "series_RC":
            a, b, c = values["C_uF"]
            return cls(R=values["R_ohm"], C=(a / 1e6, b / 1e6, c / 1e6))
        shares = values["unbalance"] or (1.0, 1.0, 1.0)
        return cls.from_power(1e3 * values["power_kW"], values["power_factor"], unbalance=shares)

    def to_table(self) -> dict[str, Any]:
        """Return the power where it says the same, else R and C."""
        table: Mapping[str, Any] = {"kind": "RC", **power_keys(self.Z_rated)}
        if self.is_told_by(table):
            return dict(table)
        C = [1e6 * c for c in self.C]
        return {"kind": "series_RC", "R_ohm": list(self.R), "C_uF": C}
