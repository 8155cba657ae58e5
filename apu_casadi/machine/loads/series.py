"""A resistance and an inductance in series in each phase:  v = R i + L di/dt."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Self

from apu_casadi.core.errors import ParameterError
from apu_casadi.core.register import Key
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
from apu_casadi.machine.park import Abc

#: Largest resistance, ohm, of a phase.  Its voltage is R i, with a current that is a difference of
#: flux linkages: the larger R, the more of the voltage is the integrator's error.
R_MAX = 1e6

POWER = Key("power_kW", "kW", "power at rated voltage", 0.1, 500.0)
_SHARES = "power of the phases relative to the balanced load"
UNBALANCE = Key("unbalance", "1", _SHARES, 0.05, 3.0, default=None, phases=True)
FACTOR = Key("power_factor", "1", "power factor", 0.1, 1.0, default=0.85)
RESISTANCE = Key("R_ohm", "ohm", "resistance by phase", 0.0, open_lo=True, phases=True)
INDUCTANCE = Key("L_mH", "mH", "inductance by phase", 0.0, phases=True)
#: Inputs of every load that is a resistance, with or without anything in series.
R_INPUTS = by_phase("R", "ohm", "load resistance, phase {}")


def check_R(where: str, value: object) -> None:
    """Refuse a resistance that is not in (0, ``R_MAX``]."""
    in_range(where, value, above=0.0)
    if float(value) > R_MAX:  # type: ignore[arg-type]
        raise ParameterError(
            f"{where} = {value:g} is beyond {R_MAX:g} ohm, where the voltage of an open phase "
            f"would be rounding times resistance; give an open phase {R_MAX:g} ohm or less: at "
            "230 V that draws 0.23 mA, which moves no voltage by 1e-5"
        )


class Impedance(Load):
    """The equations v = R i + L di/dt, for every load that is such an impedance.

    Kinds are ``"resistive"`` and ``"inductive"``.
    """

    @property
    def own(self) -> Own:
        """R_a, R_b, R_c, and L_a, L_b, L_c where there are inductances."""
        if self.kind == "resistive":
            return Own(R_INPUTS)
        return Own((*R_INPUTS, *by_phase("L", "H", "load inductance, phase {}", nominal=1e-4)))

    def drop(self, at: AtLoad) -> Abc:
        """Return R i, or R i + L di/dt."""
        drop = [at.u[f"R_{k}"] * i for k, i in zip("abc", at.i, strict=True)]
        if self.kind == "inductive":
            drop = [d + at.u[f"L_{k}"] * di for k, d, di in zip("abc", drop, at.di, strict=True)]
        return Abc(*drop)


@LOADS.add("R", "RL", "series")
@dataclass(frozen=True)
class SeriesLoad(Branches, Impedance):
    """A resistance and an inductance in series in each phase.

    Args:
        R: ohm by phase, > 0, at most ``R_MAX``: an open phase is 1e5 or 1e6 ohm.
        L: H by phase, >= 0.

    Raises:
        ParameterError: a value that is not finite or out of range.
    """

    R: tuple[float, float, float]
    L: tuple[float, float, float] = (0.0, 0.0, 0.0)

    tables: ClassVar[Mapping[str, tuple[Key, ...]]] = MappingProxyType(
        {
            "R": (POWER, UNBALANCE),
            "RL": (POWER, FACTOR, UNBALANCE),
            "series": (RESISTANCE, INDUCTANCE),
        }
    )

    def __post_init__(self) -> None:
        three("SeriesLoad.R [ohm]", self.R)
        three("SeriesLoad.L [H]", self.L)
        for k, r, l in zip("abc", self.R, self.L, strict=True):
            check_R(f"SeriesLoad.R_{k} [ohm]", r)
            in_range(f"SeriesLoad.L_{k} [H]", l)

    @classmethod
    def from_power(
        cls,
        P: float,
        power_factor: float = 1.0,
        *,
        V_rms: float = 230.0,
        f: float = 400.0,
        unbalance: tuple[float, float, float] = (1.0, 1.0, 1.0),
    ) -> Self:
        """Make the load that draws ``P`` from a balanced rated voltage.

        Args:
            P: power of all three phases at ``V_rms`` and ``f``, W, > 0.  The paper's 225 kW is
                meant so: R = 3 * 230^2 / 225e3 draws Table 7's 325.66 A at its 229.68 V.
            power_factor: 0 < power_factor <= 1, lagging.
            V_rms, f: rated phase voltage (V) and frequency (Hz).
            unbalance: shares of the phases in ``P``, > 0; only their ratios count.
        """
        Z = split_power("SeriesLoad.from_power", P, power_factor, V_rms, f, unbalance)
        L = [z.imag / (2.0 * math.pi * f) for z in Z]
        return cls(R=(Z[0].real, Z[1].real, Z[2].real), L=(L[0], L[1], L[2]))

    @property
    def kind(self) -> str:
        """``"inductive"`` if any phase has an inductance, else ``"resistive"``."""
        return "inductive" if any(self.L) else "resistive"

    def inductive(self, phase: str) -> bool:
        """Whether the phase has an inductance."""
        return self.L["abc".index(phase)] > 0

    @classmethod
    def examples(cls) -> dict[str, Load]:
        """Return 100 kW, without and with inductance."""
        return {"resistive": cls.from_power(100e3), "inductive": cls.from_power(100e3, 0.85)}

    @property
    def inputs(self) -> dict[str, float]:
        """R_a, R_b, R_c, ohm, and L_a, L_b, L_c, H."""
        values = dict(zip(("R_a", "R_b", "R_c"), self.R, strict=True))
        if self.kind == "inductive":
            values |= dict(zip(("L_a", "L_b", "L_c"), self.L, strict=True))
        return values

    @property
    def balanced(self) -> bool:
        """Whether the three phases are equal to rounding."""
        return all_equal(self.R, self.L)

    @property
    def balanced_part(self) -> SeriesLoad:
        """The balanced load of equal mean admittance at 400 Hz."""
        if self.balanced:
            return self
        Z = self.Z_mean
        return SeriesLoad(R=(Z.real,) * 3, L=(max(Z.imag, 0.0) / W_RATED,) * 3)

    @property
    def Z_rated(self) -> list[complex]:
        """Impedance of each phase at 400 Hz, ohm."""
        return [complex(R, W_RATED * L) for R, L in zip(self.R, self.L, strict=True)]

    def impedance(self, w_r: float, V_t: float) -> complex:
        """Return R + j w_r L."""
        return complex(self.R[0], w_r * self.L[0])

    @classmethod
    def from_keys(cls, word: str, values: dict[str, Any]) -> Self:
        """Make the load from the keys of ``"R"``, ``"RL"`` or ``"series"``."""
        if word == "series":
            a, b, c = values["L_mH"]
            return cls(R=values["R_ohm"], L=(a / 1e3, b / 1e3, c / 1e3))
        shares = values["unbalance"] or (1.0, 1.0, 1.0)
        return cls.from_power(
            1e3 * values["power_kW"], values.get("power_factor", 1.0), unbalance=shares
        )

    def to_table(self) -> dict[str, Any]:
        """Return the power where it says the same, else R and L."""
        keys = power_keys(self.Z_rated)
        if self.kind == "resistive":
            del keys["power_factor"]
        table = {"kind": "R" if self.kind == "resistive" else "RL", **keys}
        if self.is_told_by(table):
            return table
        return {"kind": "series", "R_ohm": list(self.R), "L_mH": [1e3 * l for l in self.L]}
