"""What a trim is asked for and what it answers: fixed quantities, limits, points, reasons.

Everything here speaks of one engine and of named quantities; how points are solved is in
:mod:`apu_casadi.gaspath.steady.trimsolver`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from apu_casadi.core.checked import number
from apu_casadi.core.errors import OperatingPointError, SignalError
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.health import HEALTH_RANGE
from apu_casadi.gaspath.steady.trimkernel import LAW, N_FIRST, NZ

GIVEN = ("T0", "P0", "T1", "P1", "T2", "P2", "off_c", "off_t", "residual", "P_acceleration")
"""Outputs that cannot be fixed: the ambient gives them, or the equations."""


# ------------------------------------------------------------------------------ what goes in


@dataclass(frozen=True)
class LoadLaw:
    """Shaft power as a power of speed: PW = PW_ref (N/N_ref)^exponent.

    Args:
        PW_ref: shaft power at N_ref, W.
        N_ref: speed, rad/s, > 0.
        exponent: 3 for a propeller or fan, 0 for constant power.
    """

    PW_ref: float
    N_ref: float
    exponent: float = 3.0

    def __post_init__(self) -> None:
        for name in ("PW_ref", "N_ref", "exponent"):
            object.__setattr__(self, name, number(f"load law: {name}", getattr(self, name)))
        if not all(map(math.isfinite, (self.PW_ref, self.N_ref, self.exponent))) or self.N_ref <= 0:
            raise SignalError(f"load law needs finite numbers and N_ref > 0, got {self!r}")


_LIMITS = {
    "off_map": ("1", 0.0, math.inf), "SM_min": ("1", -math.inf, 1.0),
    "T4_max": ("K", 250.0, math.inf), "T5_max": ("K", 250.0, math.inf),
    "Mach8_max": ("1", 0.0, 2.0), "Wf_min": ("kg/s", 0.0, 100.0), "eta_max": ("1", 0.1, math.inf),
}  # fmt: skip
LIMIT_UNITS = {name: unit for name, (unit, *_) in _LIMITS.items()}
"""Units of the limits by name."""
LIMIT_RANGES = {name: (lo, hi) for name, (_, lo, hi) in _LIMITS.items()}
"""Lowest and highest value that each may have."""


@dataclass(frozen=True)
class Limits:
    """Beyond these a solved point is refused.

    Args:
        off_map: largest distance outside a component map, in table spans.  0 allows nothing
            outside; a quarter of a span (corrected speed 1.275 where the table ends at 1.1) is
            where the maps' straight continuation is thought to mean something; *assumed*.
        SM_min: smallest compressor stability margin; 0 is the surge line.
        T4_max: highest combustor outlet temperature, K; None is 1.1 times the design value,
            *assumed* (the paper gives none).
        T5_max: highest turbine outlet temperature, K; none by default.
        Mach8_max: the fixed exit is modelled subsonic only.
        Wf_min: smallest fuel flow, kg/s; None is 0.5 % of the design value, where no flame burns
            any more: such a point is driven, not fired; *assumed*.
        eta_max: highest efficiency of compressor and turbine, health factors included; above 1 a
            component would be better than a reversible one.
    """

    off_map: float = 0.25
    SM_min: float = 0.0
    T4_max: float | None = None
    T5_max: float = math.inf
    Mach8_max: float = 1.0
    Wf_min: float | None = None
    eta_max: float = 1.0

    def __post_init__(self) -> None:
        """Refuse what is no number, and NaN, which no point would break."""
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            if value is None and f.default is None:
                continue
            x = number(f"limit {f.name}", value)
            if math.isnan(x):
                raise SignalError(f"limit {f.name} must be a number, got nan")
            lo, hi = LIMIT_RANGES[f.name]
            if not lo <= x <= hi:
                raise SignalError(f"limit {f.name} must lie in [{lo:g}, {hi:g}], got {x:g}")
            object.__setattr__(self, f.name, x)

    @classmethod
    def none(cls) -> Limits:
        """No limits but the model's own: a subsonic exit, fuel to burn, efficiencies up to 1."""
        return cls(off_map=math.inf, SM_min=-math.inf, T4_max=math.inf, Wf_min=0.0)

    def rows(self, gg: GasGenerator) -> list[tuple[Status, str, float, float]]:
        """Return (status, output, sign, limit): refused where sign * (value - limit) > 0."""
        T4 = 1.1 * gg.parameters.T4 if self.T4_max is None else self.T4_max
        Wf = 5e-3 * gg.design.values["Wf"] if self.Wf_min is None else self.Wf_min
        return [
            (Status.CHOKED, "Mach8", 1.0, self.Mach8_max),
            (Status.OFF_MAP, "off_c", 1.0, self.off_map),
            (Status.OFF_MAP, "off_t", 1.0, self.off_map),
            (Status.SURGE, "SM", -1.0, self.SM_min),
            (Status.TEMPERATURE, "T4", 1.0, T4),
            (Status.TEMPERATURE, "T5", 1.0, self.T5_max),
            (Status.EFFICIENCY, "eta_c", 1.0, self.eta_max),
            (Status.EFFICIENCY, "eta_t", 1.0, self.eta_max),
            (Status.FUEL, "Wf", -1.0, Wf),
        ]


def specify(
    gg: GasGenerator, fixed: Mapping[str, Any]
) -> tuple[tuple[str, str], list[Any], tuple[str, ...]]:
    """Check the fixed quantities; return the kernel's spec, its values, and the names."""
    names = tuple(sorted(fixed))
    if len(names) != 2:
        raise SignalError(f"a steady point needs two fixed quantities, got {len(names)}: {names}")
    spec, values = [], []
    for n in names:
        gg.Y.index(n)
        if n in GIVEN:
            raise SignalError(
                f"{n} cannot be fixed: the ambient or the equations give it; choose two of the "
                f"others, such as N, PW, Wf, T4, T5, P3"
            )
        v = fixed[n]
        if isinstance(v, LoadLaw):
            if n != "PW":
                raise SignalError(f"a load law fixes PW, not {n}")
            spec.append(LAW)
            values += [v.PW_ref, v.N_ref, v.exponent]
        else:
            spec.append(n)
            values.append(v)
    return (spec[0], spec[1]), values, names


# ------------------------------------------------------------------------------ what comes out


class Status(IntEnum):
    """What became of a point."""

    SOLVED = 0
    OFF_MAP = 1
    SURGE = 2
    TEMPERATURE = 3
    CHOKED = 4
    FUEL = 5
    NO_BALANCE = 6
    UNEXPLAINED = 7
    INPUT = 8
    EFFICIENCY = 9


MEANING = {
    Status.SOLVED: "solved",
    Status.OFF_MAP: "off a component map",
    Status.SURGE: "beyond surge",
    Status.TEMPERATURE: "temperature limit",
    Status.CHOKED: "exhaust exit choked",
    Status.FUEL: "needs no fuel",
    Status.NO_BALANCE: "no power balance",
    Status.UNEXPLAINED: "not converged",
    Status.INPUT: "input out of range",
    Status.EFFICIENCY: "efficiency above 1",
}


@dataclass(frozen=True)
class OperatingPoint:
    """A solved steady point.

    Args:
        x, z, u, theta, y: packed vectors of the gas generator.
        values: outputs by name (SI).
        residual: re-evaluated max-norm of all equations, specifications included.
        iterations: Newton steps, over all continuation steps.
        second: another steady point with the same two quantities within the limits, if one was
            found; only for pairs that leave the speed open (see
            :mod:`apu_casadi.gaspath.steady.trimbranch`).
    """

    x: np.ndarray
    z: np.ndarray
    u: np.ndarray
    theta: np.ndarray
    y: np.ndarray
    values: dict[str, float]
    residual: float
    iterations: int
    second: OperatingPoint | None = None

    def __getitem__(self, name: str) -> float:
        return self.values[name]


class Refusal(OperatingPointError):  # noqa: N818 - reads as what it is
    """A steady point was refused.

    Attributes:
        status: the reason as a :class:`Status`.
        point: the refused point if it was solved, else the best point reached on the way; it solves
            the equations for other fixed values.  None if there is none.
        reached: share of the way from the design point, 1 if the point was solved.
    """

    status: Status = Status.UNEXPLAINED
    point: OperatingPoint | None = None
    reached: float = 0.0


def named(gg: GasGenerator, y: np.ndarray, w: np.ndarray) -> dict[str, float]:
    """Outputs and map coordinates by name."""
    return gg.Y.unpack(y) | {"beta_c": float(w[NZ - 2]), "beta_t": float(w[NZ - 1])}


# ------------------------------------------------------------------------------ reasons


def limit_status(gg: GasGenerator, limits: Limits, y: np.ndarray) -> np.ndarray:
    """Return the first limit that each column of y breaks, SOLVED if none."""
    status = np.full(y.shape[1], Status.SOLVED, dtype=np.int8)
    for s, name, sign, limit in reversed(limits.rows(gg)):
        status[sign * (y[gg.Y.index(name)] - limit) > 0] = s
    return status


def limit_text(gg: GasGenerator, limits: Limits, y: Mapping[str, float]) -> str:
    """Return the limits that a point breaks, with numbers."""
    out = []
    for s, name, sign, limit in limits.rows(gg):
        if name in y and sign * (y[name] - limit) > 0:
            out.append(_words(gg, s, name, y, limit))
    return "; ".join(out)


def _words(
    gg: GasGenerator, s: Status, name: str, y: Mapping[str, float], limit: float | None
) -> str:
    unit = gg.Y[name].unit
    unit = "" if unit == "1" else f" {unit}"
    bound = "" if limit is None else f", limit {limit:.5g}{unit}"
    if s == Status.OFF_MAP:
        which, n, beta = (
            ("compressor", "n_c", "beta_c") if name == "off_c" else ("turbine", "n_t", "beta_t")
        )
        choice = gg.compressor_map if name == "off_c" else gg.turbine_map
        speeds, betas = choice.table.N / choice.N_map_des, choice.table.beta
        return (
            f"off the {which} map by {y[name]:.3f} table spans{bound} "
            f"(relative corrected speed {y[n]:.4f}, table {speeds[0]:.3f} to {speeds[-1]:.3f}"
            + (
                f"; beta {y[beta]:.3f}, table {betas[0]:g} to {betas[-1]:g})"
                if math.isfinite(y.get(beta, math.nan))
                else ")"
            )
        )
    if s == Status.SURGE:
        return f"beyond surge: SM = {y[name]:.4f}{bound}"
    if s == Status.TEMPERATURE:
        return f"temperature limit: {name} = {y[name]:.1f}{unit}{bound}"
    if s == Status.EFFICIENCY:
        factor = "f_" + name
        return (
            f"{name} = {y[name]:.4f}{bound}: no component is better than a reversible one; lower "
            f"{factor}, or calibrate the map to a lower efficiency there"
        )
    if s == Status.CHOKED:
        return f"exhaust exit choked: Mach {y[name]:.3f} at station 8"
    return f"needs no fuel: Wf = {y[name]:.3g}{unit}{bound}"


def off_speed(gg: GasGenerator, spec: tuple[str, str], y: np.ndarray) -> np.ndarray | float:
    """Distance of the corrected speed off the compressor table, in spans; it is known if N is."""
    if "N" not in spec:
        return 0.0 if y.ndim == 1 else np.zeros(y.shape[1])
    t = gg.compressor_map.table
    n = y[gg.Y.index("n_c")] * gg.compressor_map.N_map_des
    span = float(t.N[-1] - t.N[0])
    made: np.ndarray | float = np.maximum(0.0, np.maximum(n - t.N[-1], t.N[0] - n) / span)
    return made


def speed_text(gg: GasGenerator, y: np.ndarray, off: float, limits: Limits) -> str:
    """Return that the given speed is off the compressor's table, by ``off`` spans."""
    values = {**gg.Y.unpack(y), "off_c": off}
    return _words(gg, Status.OFF_MAP, "off_c", values, limits.off_map)


def stop_text(
    gg: GasGenerator, limits: Limits, s: Status, y: Mapping[str, float], reached: float
) -> str:
    """Return why the way from the design point ended where it did."""
    way = f"stopped at {100 * reached:.1f} % of the way from the design point"
    if s == Status.OFF_MAP and reached == 0.0:  # the given speed is off the table
        where = _words(gg, s, "off_c", y, limits.off_map)
        return f"{where}; no solution was found on the continued map"
    broken = limit_text(gg, limits, y)
    if broken:
        return f"{broken}; {way}"
    if s == Status.OFF_MAP:
        name = "off_c" if y["off_c"] >= y["off_t"] else "off_t"
        return f"{_words(gg, s, name, y, None)}, where the continued map has no solution; {way}"
    if s == Status.NO_BALANCE:
        return (
            f"no power balance: the fixed quantities have an extreme value near the best point and "
            f"cannot be moved further; {way}"
        )
    return f"not converged, and no limit is near; {way}"


def input_ranges(gg: GasGenerator) -> dict[str, tuple[float, float]]:
    """Lowest and highest value of ambient inputs and health factors, by name."""
    return gg.input_ranges | dict.fromkeys(gg.THETA.names, HEALTH_RANGE)


def range_text(gg: GasGenerator, p: np.ndarray) -> str:
    """Return which ambient input or health factor is out of range; "" if none."""
    names = (*AMBIENT, *gg.THETA.names)
    out = []
    for name, value in zip(names, p[:N_FIRST], strict=True):
        lo, hi = input_ranges(gg)[name]
        if not lo <= value <= hi:
            unit = (gg.U if name in gg.U else gg.THETA)[name].unit
            out.append(f"{name} = {value:g} {unit} is outside [{lo:g}, {hi:g}]")
    if not out and not np.all(np.isfinite(p)):
        out.append("a fixed value is not finite")
    return "; ".join(out)
