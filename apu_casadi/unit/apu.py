"""The whole unit: one gas generator, two identical starter/generators, governor and gearbox."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from apu_casadi.core.errors import OperatingPointError, ParameterError, SignalError, nearest
from apu_casadi.core.parameters import Parameters, par
from apu_casadi.core.sharing import Parametric, derived
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import Limits, OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.machine.generator import Generator, GeneratorPoint
from apu_casadi.unit.control import GOVERNORS, Governor, GovernorParameters, word_of
from apu_casadi.unit.events import Ambient
from apu_casadi.unit.exchange import Link

if TYPE_CHECKING:
    from apu_casadi.machine.loads.load import Load

RESIDUAL_JOINT = 1e-9


@dataclass(frozen=True)
class CouplingParameters(Parameters):
    """Gearbox between gas generator and the two generators (paper, eqs. 1 and 2)."""

    gear: float = par(
        36050.0 / 12000.0,
        unit="1",
        source="Table 3 speed over 400 Hz with two pole pairs",
        doc="speed ratio Omega_gtSg",
        lo=0.01,
    )
    eta_gtSg: float = par(
        1.0,
        unit="1",
        source="assumed: only eta_sg eta_gtSg = 0.90 follows from the tables",
        doc="power transfer efficiency of the gearbox",
        lo=0.01,
        hi=1.0,
    )


@dataclass(frozen=True)
class JointPoint:
    """A steady point of the whole unit.

    Args:
        gas: operating point of the gas generator.
        generator: operating point of one generator.
    """

    gas: OperatingPoint
    generator: GeneratorPoint


@dataclass(frozen=True)
class Apu(Parametric):
    """An all-electric APU; the default is the paper's APS5000-like unit.

    Args:
        gas_generator, generator: the two models.
        governor, coupling: speed control and gearbox.
    """

    gas_generator: GasGenerator = field(default_factory=GasGenerator)
    generator: Generator = field(default_factory=Generator)
    governor: Governor = field(default_factory=GovernorParameters)
    coupling: CouplingParameters = field(default_factory=CouplingParameters)

    @property
    def N_ref(self) -> float:
        """Governed rotor speed, rad/s."""
        return self.gas_generator.parameters.N

    @derived
    def link(self) -> Link:
        """What couples the models: eqs. (1) and (2), and the governor."""
        gearbox = self.coupling
        return Link(
            self.governor, self.N_ref, gearbox.gear, gearbox.eta_gtSg, self.generator.machine.n_pp
        )

    def w_r(self, N: Any) -> Any:
        """Electrical speed of the generators, rad/s, at rotor speed N (eq. 2)."""
        return self.link.w_r(N)

    def PW(self, P_total: Any) -> Any:
        """Shaft power, W, that the two generators' mean power P_total asks for (eq. 1)."""
        return self.link.PW(P_total)

    def parameter_sets(self) -> dict[str, Parameters]:
        """Return the parameter sets by the words that stand before the dot."""
        gg, gen = self.gas_generator, self.generator
        return {
            "gas_generator": gg.parameters,
            "compressor_map": gg.compressor_map.calibration,
            "turbine_map": gg.turbine_map.calibration,
            "machine": gen.machine,
            "exciter": gen.exciter,
            "governor": self.governor,
            "coupling": self.coupling,
        }

    def parameters(self) -> dict[str, float | str]:
        """Return every parameter as ``{"set.name": value}``; the keys :meth:`change` takes."""
        table: dict[str, float | str] = {}
        for s, p in self.parameter_sets().items():
            for f in dataclasses.fields(p):
                table[f"{s}.{f.name}"] = getattr(p, f.name)
        table["generator.neutral"] = self.generator.neutral
        table["governor.kind"] = word_of(self.governor)
        return table

    def change(self, values: Mapping[str, Any]) -> Apu:
        """Return a unit with some parameters changed.

        >>> Apu().change({"governor.Kp": 0.5, "machine.r_s": 0.005}).governor.Kp
        0.5

        ``governor.kind`` puts another governor of ``GOVERNORS`` in its place, with its defaults.

        Raises:
            ParameterError: unknown name (the nearest valid one is named) or value out of range.
        """
        kind = values.get("governor.kind")
        if kind is not None and kind != word_of(self.governor):
            other = dataclasses.replace(self, governor=GOVERNORS[kind]())
            return other.change(values)
        groups: dict[str, dict[str, Any]] = {}
        known = self.parameters()
        for key, value in values.items():
            if key not in known:
                raise ParameterError(f"unknown parameter {key!r} {nearest(key, known)}")
            s, _, name = key.partition(".")
            if key != "governor.kind":
                groups.setdefault(s, {})[name] = value
        new: dict[str, Any] = {
            s: p.change(**groups.get(s, {})) for s, p in self.parameter_sets().items()
        }
        gg, gen = self.gas_generator, self.generator
        touched = {"gas_generator", "compressor_map", "turbine_map"} & set(groups)
        if touched:
            gg = dataclasses.replace(
                gg,
                parameters=new["gas_generator"],
                compressor_map=dataclasses.replace(
                    gg.compressor_map, calibration=new["compressor_map"]
                ),
                turbine_map=dataclasses.replace(gg.turbine_map, calibration=new["turbine_map"]),
            )
        if {"machine", "exciter", "generator"} & set(groups):
            neutral = groups.get("generator", {}).get("neutral", gen.neutral)
            gen = dataclasses.replace(
                gen, machine=new["machine"], exciter=new["exciter"], neutral=neutral
            )
        return Apu(gg, gen, new["governor"], new["coupling"])

    def steady_state(
        self,
        load: Load,
        *,
        ambient: Ambient | None = None,
        health: Mapping[str, float] | None = None,
        V_ref: float | None = None,
        limits: Limits | None = None,
    ) -> JointPoint:
        """Solve the steady unit at governed speed: healthy generators under a balanced load.

        ``ambient`` is the default day if not given.  ``limits`` are those of the
        trim; by default without one of temperature, which is no reason not to simulate.

        Raises:
            OperatingPointError: no such point, or it needs fuel beyond the governor's limits.
        """
        amb = dataclasses.asdict(Ambient() if ambient is None else ambient)
        gen = self.generator.steady_state(load, w_r=self.w_r(self.N_ref), V_ref=V_ref)
        PW = self.PW(gen.y["P_total"])
        limits = Limits(T4_max=math.inf) if limits is None else limits
        gas = trim_gas_generator(
            self.gas_generator, {"N": self.N_ref, "PW": PW}, theta=health, limits=limits, **amb
        )
        Wf, g = gas["Wf"], self.governor
        if not g.Wf_min <= Wf <= g.Wf_max:
            raise OperatingPointError(
                f"steady state needs Wf = {Wf:.5f} kg/s for PW = {PW / 1e3:.1f} kW, outside the "
                f"governor's limits [{g.Wf_min:g}, {g.Wf_max:g}]"
            )
        return JointPoint(gas, gen)


def trim(
    model: GasGenerator | Generator | Apu,
    fixed: Mapping[str, Any] | None = None,
    *,
    load: Load | None = None,
    **conditions: Any,
) -> OperatingPoint | GeneratorPoint | JointPoint:
    """Solve a steady operating point of any of the models; no guess is asked for.

    Args:
        model: what is to be trimmed.
        fixed: of a gas generator, two outputs by name with their values, SI; see
            :func:`apu_casadi.gaspath.steady.trimming.trim_gas_generator`.
        load: of a generator, or of each generator of a unit: a balanced load.
        conditions: of a gas generator ``theta``, ``limits``, altitude (m), Mach, dT_isa (K), war;
            of a generator ``w_r`` (rad/s, electrical) and ``V_t`` (V rms) or ``V_ref``; of a unit
            ``ambient``, ``health``, ``V_ref``, ``limits``.

    Raises:
        SignalError: arguments that this model does not take, or too few.
        OperatingPointError: no such point; says why, and the best point reached.

    Examples:
        >>> from apu_casadi.machine.loads.series import SeriesLoad
        >>> round(trim(Apu(), load=SeriesLoad.from_power(100e3)).gas["Wf"], 4)
        0.0297
    """
    if isinstance(model, GasGenerator):
        if fixed is None or load is not None:
            raise SignalError("a gas generator is trimmed by two fixed outputs, not by a load")
        return trim_gas_generator(model, fixed, **conditions)
    if not isinstance(model, Generator | Apu):
        raise SignalError(
            f"a GasGenerator, Generator or Apu can be trimmed, got {type(model).__name__}"
        )
    if load is None or fixed is not None:
        raise SignalError(f"{type(model).__name__} is trimmed by its load: give load=...")
    return model.steady_state(load, **conditions)
