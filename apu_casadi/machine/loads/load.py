"""Electrical loads of one generator: series R-L per phase, constant power, open.

A load knows its *kind*, which decides the equations, and the *inputs* that go with it, which are
numbers and can change without a new model.  All are in star; the generator decides whether the
star point is joined to the machine's neutral.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Self

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError

KINDS = ("resistive", "inductive", "constant_power")

#: Largest resistance, ohm, of a phase.  Its voltage is R i, with a current that is a difference of
#: flux linkages: the larger R, the more of the voltage is the integrator's error.
R_MAX = 1e6
#: Resistance, ohm, beyond which the tolerances of an integrator are tightened in proportion.
R_FINE = 1e3


def _check(where: str, value: object, *, above: float | None = None) -> None:
    value = number(where, value, error=ParameterError)
    if not math.isfinite(value):
        raise ParameterError(f"{where} must be a finite number, got {value!r}")
    if above is None and value < 0:
        raise ParameterError(f"{where} = {value:g} must be >= 0")
    if above is not None and not value > above:
        raise ParameterError(f"{where} = {value:g} must be > {above:g}")


def _check_R(where: str, value: object) -> None:
    _check(where, value, above=0.0)
    if float(value) > R_MAX:  # type: ignore[arg-type]
        raise ParameterError(
            f"{where} = {value:g} is beyond {R_MAX:g} ohm, where the voltage of an open phase "
            f"would be rounding times resistance; give an open phase {R_MAX:g} ohm or less: at "
            "230 V that draws 0.23 mA, which moves no voltage by 1e-5"
        )


def _three(where: str, values: object) -> None:
    if not isinstance(values, tuple) or len(values) != 3:
        raise ParameterError(f"{where} needs a tuple of three values (a, b, c), got {values!r}")


@dataclass(frozen=True)
class SeriesLoad:
    """A resistance and an inductance in series in each phase.

    Args:
        R: ohm by phase, > 0, at most ``R_MAX``: an open phase is 1e5 or 1e6 ohm.
        L: H by phase, >= 0.

    Raises:
        ParameterError: a value that is not finite or out of range.
    """

    R: tuple[float, float, float]
    L: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        _three("SeriesLoad.R [ohm]", self.R)
        _three("SeriesLoad.L [H]", self.L)
        for k, r, l in zip("abc", self.R, self.L, strict=True):
            _check_R(f"SeriesLoad.R_{k} [ohm]", r)
            _check(f"SeriesLoad.L_{k} [H]", l)

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
        _check("SeriesLoad.from_power: P [W] (an open generator is OpenLoad)", P, above=0.0)
        _check("SeriesLoad.from_power: V_rms [V]", V_rms, above=0.0)
        _check("SeriesLoad.from_power: f [Hz]", f, above=0.0)
        _check("SeriesLoad.from_power: power_factor", power_factor, above=0.0)
        if power_factor > 1:
            raise ParameterError(
                f"SeriesLoad.from_power: power_factor = {power_factor:g} is outside (0, 1]"
            )
        _three("SeriesLoad.from_power: unbalance", unbalance)
        R, L = [], []
        for k, share in zip("abc", unbalance, strict=True):
            _check(f"SeriesLoad.from_power: unbalance of phase {k}", share, above=0.0)
            Z = V_rms**2 * power_factor / (P * share / sum(unbalance))
            R.append(Z * power_factor)
            L.append(Z * math.sqrt(1.0 - power_factor**2) / (2.0 * math.pi * f))
        return cls(R=(R[0], R[1], R[2]), L=(L[0], L[1], L[2]))

    @property
    def kind(self) -> str:
        """``"inductive"`` if any phase has an inductance, else ``"resistive"``."""
        return "inductive" if any(self.L) else "resistive"

    @property
    def inputs(self) -> dict[str, float]:
        """The model inputs of this load, by name."""
        values = dict(zip(("R_a", "R_b", "R_c"), self.R, strict=True))
        if self.kind == "inductive":
            values |= dict(zip(("L_a", "L_b", "L_c"), self.L, strict=True))
        return values

    @property
    def balanced(self) -> bool:
        """Whether the three phases are equal to rounding."""
        return all(
            math.isclose(x, v[0], rel_tol=1e-12, abs_tol=0.0) for v in (self.R, self.L) for x in v
        )


@dataclass(frozen=True)
class ConstantPowerLoad:
    """Three equal conductances G that follow the voltage so as to draw a constant power.

        tau dG/dt = P / (v_a^2 + v_b^2 + v_c^2) - G

    An ideal constant-power load has no consistent start beside flux states; the lag gives it one.
    Below ``V_MIN`` of the rated voltage the conductance is held, as undervoltage does.

    Args:
        P: power of all three phases, W, > 0.
        tau: lag, s, > 0.
    """

    P: float
    tau: float = 2e-3
    kind: str = field(default="constant_power", init=False)

    def __post_init__(self) -> None:
        _check("ConstantPowerLoad.P [W] (an open generator is OpenLoad)", self.P, above=0.0)
        _check("ConstantPowerLoad.tau [s]", self.tau, above=0.0)

    @property
    def inputs(self) -> dict[str, float]:
        """The model inputs of this load, by name."""
        return {"P_load": self.P, "tau_load": self.tau}

    @property
    def balanced(self) -> bool:
        """Always true."""
        return True


#: Fraction of the rated voltage below which a constant-power load is a constant conductance.
V_MIN = 0.3


@dataclass(frozen=True)
class OpenLoad:
    """No load: a bleed resistance per phase stands for the voltmeter.

    Terminal voltage is then a small current times a large resistance, and an integrator sees the
    current only: :func:`fineness` tightens its tolerances.

    Args:
        R: ohm per phase, > 0, at most ``R_MAX``; 1e4 ohm draws 16 W in all at rated voltage, 7e-5
            of the rating.
    """

    R: float = 1e4
    kind: str = field(default="resistive", init=False)

    def __post_init__(self) -> None:
        _check_R("OpenLoad.R [ohm]", self.R)

    @property
    def inputs(self) -> dict[str, float]:
        """The model inputs of this load, by name."""
        return {"R_a": self.R, "R_b": self.R, "R_c": self.R}

    @property
    def balanced(self) -> bool:
        """Always true."""
        return True


Load = SeriesLoad | ConstantPowerLoad | OpenLoad


def fineness(load: Load) -> float:
    """Return the factor, at most 1, on an integrator's tolerances that this load asks for.

    ``R_FINE`` over the largest resistance, but not below 1e-2, where rounding begins: 1e-10 and
    1e-12 beside the defaults.  An open phase's voltage is then right to 1e-5 up to ``R_MAX``.
    """
    if isinstance(load, ConstantPowerLoad):
        return 1.0
    R = max(load.R) if isinstance(load, SeriesLoad) else load.R
    return min(1.0, max(1e-2, R_FINE / R))
