"""Parameters of the starter/generator: the paper's Table 1 in SI, and the AC5A exciter.

Names follow the package's nomenclature where the paper's clash: ``r_fd`` is the field resistance
(the paper's R_f, which (9) uses again for the fault branch), ``n_pp`` the pole pairs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from apu_casadi.core.errors import ParameterError
from apu_casadi.core.parameters import Parameters, par

_T1 = "paper, Table 1"
_AC5A = "IEEE 421.5 AC5A; value assumed, tuned for this machine"


@dataclass(frozen=True)
class MachineParameters(Parameters):
    """The wound-rotor synchronous generator (Table 1), rotor quantities referred to the stator."""

    r_s: float = par(0.0044, unit="ohm", source=_T1, doc="stator resistance, one phase", lo=0)
    L_ls: float = par(
        19.8e-6, unit="H", source=_T1, doc="stator leakage inductance; also L_s of (7)", lo=1e-9
    )
    L_md: float = par(0.221e-3, unit="H", source=_T1, doc="d magnetising inductance", lo=1e-9)
    L_mq: float = par(0.162e-3, unit="H", source=_T1, doc="q magnetising inductance", lo=1e-9)
    r_fd: float = par(
        0.0689, unit="ohm", source=_T1 + " (its R_f)", doc="field resistance", lo=1e-9
    )
    L_lfd: float = par(32.8e-6, unit="H", source=_T1, doc="field leakage inductance", lo=1e-9)
    r_kd: float = par(0.0142, unit="ohm", source=_T1, doc="d damper resistance", lo=1e-9)
    L_lkd: float = par(34.1e-6, unit="H", source=_T1, doc="d damper leakage inductance", lo=1e-9)
    r_kq: float = par(0.0031, unit="ohm", source=_T1, doc="q damper resistance", lo=1e-9)
    L_lkq: float = par(
        0.144e-3,
        unit="H",
        source=_T1 + ' (printed "R_lkq", in mH)',
        doc="q damper leakage inductance",
        lo=1e-9,
    )
    n_pp: int = par(2, unit="1", source=_T1, doc="pole pairs", lo=1)
    V_rated_rms: float = par(
        230.0,
        unit="V",
        source=_T1 + ' (printed "line voltage"; Table 7 shows it is the phase value)',
        doc="rated phase voltage, rms",
        lo=1e-3,
    )
    P_rated: float = par(225e3, unit="W", source=_T1, doc="rated power of one machine", lo=1.0)
    f_rated: float = par(400.0, unit="Hz", source=_T1, doc="rated frequency", lo=1.0)
    eta_sg: float = par(
        0.90,
        unit="1",
        source="assumed: Tables 4, 5 and 7 fix only eta_sg * eta_gtSg = 0.90; gearbox taken as 1",
        doc="generator efficiency in (8)",
        lo=0.01,
        hi=1.0,
    )

    @property
    def w_rated(self) -> float:
        """Rated electrical speed, rad/s."""
        return 2.0 * math.pi * self.f_rated

    @property
    def V_fd_base(self) -> float:
        """Field voltage for rated voltage at no load and rated speed, V: base of E_fd."""
        V_peak = math.sqrt(2.0) * self.V_rated_rms
        return self.r_fd * V_peak / (self.w_rated * self.L_md)


MACHINE = MachineParameters().signals("machine")
"""The machine's parameters by dotted name, as ``machine.r_s``."""
_SAT = "assumed, of the size usual for salient poles; Table 1 tells a linear machine"


@dataclass(frozen=True)
class SaturatedMachine(MachineParameters):
    """A machine whose d-axis magnetising path saturates; the q axis, mostly air, stays linear.

    With lambda_md the flux linkage of the path and i_md = i_fd + i_kd - i_d its current,

        L_md i_md = lambda_md (1 + S),    S = S_10 abs(lambda_md / lambda_rated)^X,

    X = ln(S_12/S_10)/ln 1.2: the exponential form of the salient-pole machine in IEEE Std 1110,
    section 5.3.2 (GENSAE), smooth and without a threshold.  Machines without it are
    :class:`MachineParameters`.
    """

    S_10: float = par(0.1, unit="1", source=_SAT, doc="saturation S at rated flux linkage", lo=1e-9)
    S_12: float = par(0.3, unit="1", source=_SAT, doc="saturation S at 1.2 times it", lo=1e-9)

    def __post_init__(self) -> None:
        """Check the ranges, and that S rises faster than the flux linkage."""
        super().__post_init__()
        if not self.S_12 > 1.2 * self.S_10:
            raise ParameterError(
                f"SaturatedMachine: S_12 = {self.S_12:g} must be > 1.2 S_10 = {1.2 * self.S_10:g}: "
                "S rises faster than the flux linkage"
            )

    @property
    def lam_rated(self) -> float:
        """Flux linkage for rated voltage at no load and rated speed, Wb, peak."""
        return math.sqrt(2.0) * self.V_rated_rms / self.w_rated


def magnetics(p: MachineParameters, S_10: float | None, S_12: float | None) -> MachineParameters:
    """Return the machine with saturation as asked for: None leaves it, S_10 = 0 is without.

    Raises:
        ParameterError: a value out of range, or S_12 alone for a linear machine.
    """
    if S_10 is None:
        if S_12 and not isinstance(p, SaturatedMachine):
            raise ParameterError(f"machine.S_12 = {S_12:g} needs machine.S_10 > 0 beside it")
        return p if not S_12 else p.change(S_12=S_12)
    own = {f.name: getattr(p, f.name) for f in fields(MachineParameters)}
    if S_10 == 0:
        return MachineParameters(**own)
    given = {"S_10": S_10, "S_12": S_12}
    if isinstance(p, SaturatedMachine):
        own |= {"S_10": p.S_10, "S_12": p.S_12}
    return SaturatedMachine(**own | {n: v for n, v in given.items() if v is not None})


def require_linear(p: MachineParameters, what: str) -> None:
    """Refuse a machine that saturates.

    Raises:
        ParameterError: it does; ``what`` needs the linear one.
    """
    if isinstance(p, SaturatedMachine):
        raise ParameterError(
            f"{what} needs the linear machine: this one saturates (machine.S_10 = {p.S_10:g}); "
            "set machine.S_10 = 0"
        )


@dataclass(frozen=True)
class ExciterParameters(Parameters):
    """IEEE AC5A, per unit of rated terminal voltage and of ``MachineParameters.V_fd_base``.

    Published 60 Hz sample sets are unstable or far too slow on this 400 Hz machine; this set is
    stable from 5 to 225 kW.
    """

    T_R: float = par(0.005, unit="s", source=_AC5A, doc="voltage transducer lag", lo=1e-5)
    T_A: float = par(0.005, unit="s", source=_AC5A, doc="regulator lag", lo=1e-5)
    K_A: float = par(
        250.0,
        unit="1",
        source="assumed within 215-264, the droop between Tables 7 and 8",
        doc="regulator gain",
        lo=1e-3,
    )
    K_E: float = par(1.0, unit="1", source="IEEE 421.5 AC5A", doc="exciter self-excitation", lo=0)
    T_E: float = par(0.1, unit="s", source=_AC5A, doc="exciter lag", lo=1e-4)
    K_F: float = par(0.03, unit="s", source=_AC5A, doc="rate feedback gain", lo=0)
    T_F1: float = par(0.1, unit="s", source=_AC5A, doc="rate feedback lag", lo=1e-4)
    T_F2: float = par(
        0.0, unit="s", source="IEEE 421.5 AC5A", doc="second feedback lag; 0 leaves it out", lo=0
    )
    T_F3: float = par(0.0, unit="s", source="IEEE 421.5 AC5A", doc="second feedback lead", lo=0)
    V_R_max: float = par(7.3, unit="1", source="IEEE 421.5 AC5A sample", doc="regulator ceiling")
    V_R_min: float = par(-7.3, unit="1", source="IEEE 421.5 AC5A sample", doc="regulator floor")
    E_1: float = par(5.6, unit="1", source="IEEE 421.5 AC5A sample", doc="saturation point 1", lo=0)
    S_E1: float = par(0.86, unit="1", source="IEEE 421.5 AC5A sample", doc="S_E at E_1", lo=0)
    E_2: float = par(4.2, unit="1", source="IEEE 421.5 AC5A sample", doc="saturation point 2", lo=0)
    S_E2: float = par(0.5, unit="1", source="IEEE 421.5 AC5A sample", doc="S_E at E_2", lo=0)
    T_lim: float = par(
        1e-3,
        unit="s",
        source="assumed: a fifth of T_A",
        doc="time constant with which the regulator limits hold V_R (non-windup)",
        lo=1e-6,
    )

    @property
    def absent(self) -> tuple[str, ...]:
        """Names of the values that do not count, since what they belong to is left out."""
        return (
            *(("T_F2", "T_F3") if _is_zero(self.T_F2) else ()),
            *(("E_1", "S_E1", "E_2", "S_E2") if _is_zero(self.S_E1) else ()),
        )

    def __post_init__(self) -> None:
        """Check the ranges, and what two values must satisfy together."""
        super().__post_init__()
        if not self.V_R_min < self.V_R_max:
            raise ParameterError(
                f"ExciterParameters: V_R_min = {self.V_R_min:g} must be below "
                f"V_R_max = {self.V_R_max:g}"
            )
        if (self.S_E1 == 0) != (self.S_E2 == 0) or self.E_1 == self.E_2:
            raise ParameterError(
                "ExciterParameters: the saturation curve needs two different points with "
                f"S_E > 0, or S_E = 0 at both; got S_E({self.E_1:g}) = {self.S_E1:g}, "
                f"S_E({self.E_2:g}) = {self.S_E2:g}"
            )
        if self.T_F2 == 0 and self.T_F3 > 0:
            raise ParameterError("ExciterParameters: T_F3 > 0 needs T_F2 > 0 (a proper lead-lag)")


def _is_zero(value: Any) -> bool:
    """Whether it is the number zero; a symbol is not."""
    return isinstance(value, int | float) and value == 0
