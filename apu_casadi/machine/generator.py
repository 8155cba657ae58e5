"""The starter/generator: machine, turn-to-turn short circuit, exciter and load in one model.

What the equations are, :mod:`apu_casadi.machine.generatormodel` says.  A *variant* of the model
belongs to a kind of load (:mod:`apu_casadi.machine.loads`) and a kind of fault
(:mod:`apu_casadi.machine.faults`), or none: a fault brings its loop in, and takes it out again
when cleared.

At a switch the machine's flux linkages, the rotor angle and the exciter are continuous, and so
are the effective currents.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from apu_casadi.core import simulation
from apu_casadi.core.checked import number
from apu_casadi.core.errors import OperatingPointError, ParameterError, nearest
from apu_casadi.core.sharing import Parametric, derived, kept
from apu_casadi.core.signals import Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.machine import exciter as ac5a
from apu_casadi.machine import wrsg
from apu_casadi.machine.faults.fault import FAULTS, Fault, FaultStructure
from apu_casadi.machine.generatormodel import GeneratorModel, Structure, variant
from apu_casadi.machine.loads.load import LOADS, Load, LoadStructure
from apu_casadi.machine.machinedata import ExciterParameters, MachineParameters
from apu_casadi.machine.wrsg import Windings

NEUTRALS = ("grounded", "isolated")

SAME_INSTANT = 1e-9  # s; switches closer than this are one
#: Voltage just after a switch, over the rated peak, that is warned of: a drop from rated load to
#: less than half of it makes 2.3.
SPIKE = 3.0

#: Mean phase voltage of Table 7's reference column at 225 kW, V rms: sets the default V_ref.
V_TABLE_7 = (229.6704 + 229.6903 + 229.6704) / 3.0


@dataclass(frozen=True, eq=False)
class GeneratorPoint:
    """A balanced steady state of the healthy generator.

    Args:
        ss: the variant it belongs to.
        x, u: state (nx,) and inputs (nu,).
        V_ref: voltage reference that holds it, per unit.
        V_t: terminal voltage, V rms per phase.
        y: outputs by name at the starting rotor angle.
        residual: largest state rate over nominal value (rotor angle apart), 1/s.
    """

    ss: GeneratorModel
    x: np.ndarray
    u: np.ndarray
    V_ref: float
    V_t: float
    y: dict[str, float]
    residual: float


@dataclass(frozen=True)
class Generator(Parametric):
    """One starter/generator with its exciter; the load comes with each study.

    Args:
        machine, exciter: parameter sets.
        neutral: ``"grounded"`` (four wires, as in aircraft) joins the star points of machine and
            load; ``"isolated"`` leaves the load's star point free.

    Raises:
        ParameterError: unknown neutral.
    """

    machine: MachineParameters = field(default_factory=MachineParameters)
    exciter: ExciterParameters = field(default_factory=ExciterParameters)
    neutral: str = "grounded"

    def __post_init__(self) -> None:
        if self.neutral not in NEUTRALS:
            raise ParameterError(f"neutral {self.neutral!r} {nearest(self.neutral, NEUTRALS)}")

    # -- variants ---------------------------------------------------------------------------

    def state_space(
        self, load: Load | str = "resistive", fault: Fault | str | None = None
    ) -> GeneratorModel:
        """Return the model variant, built once.

        Args:
            load: a load, or its kind.
            fault: a fault, or its kind, or None.

        Raises:
            ParameterError: unknown kinds, or a kind of fault that this neutral does not allow.
        """
        beside = load_of_kind(load) if isinstance(load, str) else load
        if isinstance(fault, str):
            example = _of_kind("fault", FAULTS.classes, fault, ", or None")
            found: FaultStructure | None = FaultStructure.of(example, fault)
        else:
            kind = self.fault_kind(beside, fault)
            found = FaultStructure.of(fault, kind) if fault and kind else None
        return _variant(self, self._structure(beside, found))

    def _structure(self, load: Load, fault: FaultStructure | None = None) -> Structure:
        return Structure(LoadStructure.of(load), fault, self.neutral, self.exciter.absent)

    def fault_kind(self, load: Load, fault: Fault | None) -> str | None:
        """Return which equations a fault needs beside this load."""
        return None if fault is None else fault.kind(load, self.neutral)

    def variant(self, load: Load, fault: Fault | None = None) -> GeneratorModel:
        """Return the model variant for a load and a fault."""
        return self.state_space(load, fault)

    def inputs(
        self,
        load: Load,
        *,
        w_r: float | None = None,
        V_ref: float | None = None,
        **noise: float,
    ) -> np.ndarray:
        """Return the inputs u of the variants with this load, shape (nu,).

        Args:
            w_r: electrical speed, rad/s; default rated.
            V_ref: voltage reference, per unit; default :attr:`V_ref_default`.
            noise: w1_q, w1_d, w1_0, w2_fd, w2_kd, w2_kq, V; default 0.
        """
        values = {
            "w_r": self.machine.w_rated if w_r is None else w_r,
            "V_ref": self.V_ref_default if V_ref is None else V_ref,
        }
        return self._structure(load).inputs.pack({**values, **load.inputs, **noise})

    def fault_vector(self, load: Load, fault: Fault | None) -> np.ndarray:
        """Return the parameters theta of :meth:`variant` for this load and fault."""
        if fault is None:
            return np.zeros(0)
        kind = fault.kind(load, self.neutral)
        return Signals(fault.own(kind, self.neutral).theta).pack(fault.parameters(kind))

    def transfer(
        self,
        x: Any,
        source: GeneratorModel,
        target: GeneratorModel,
        *,
        u: Any,
        theta: Any,
        u_target: Any,
        theta_target: Any = (),
    ) -> np.ndarray:
        """Return the state of ``target`` just after a switch, from that of ``source`` before it.

        States carry over by name: flux linkages, rotor angle, exciter.  Load and fault say where
        their own states start (:meth:`Load.start`, :meth:`Fault.start`).

        Args:
            x, u, theta: state, inputs and parameters of the source at the switch.
            u_target, theta_target: inputs and parameters of the target; a fault without
                ``theta_target`` is taken to be in the phase it was in.
        """
        values = source.x.unpack(np.asarray(x, dtype=float))
        assert target.load is not None
        load, fault = target.load.load, target.fault
        own = fault.fault.own(fault.kind, self.neutral).states if fault else ()
        if own or load.own.states:
            y = source.y.unpack(source.g(x, u, theta).full().ravel())
            before = {**y, **values}
            V_rated = self.machine.V_rated_rms
            values |= load.start(before, target.u.unpack(np.asarray(u_target, float)), V_rated)
            if fault:
                was, now = (
                    s.theta.unpack(np.asarray(t, dtype=float)) if np.size(t) else {}
                    for s, t in ((source, theta), (target, theta_target))
                )
                values |= fault.fault.start(before, was, now, tuple(s.name for s in own))
        return target.x.pack({n: values[n] for n in target.x.names})

    def spike(
        self, ss: StateSpace, x: Any, u: Any, theta: Any, *, t: float, load: Load
    ) -> str | None:
        """Return a warning of a voltage spike just after a switch; None without one.

        The flux linkages stay at a switch, hence also the currents, and a load of large resistance
        gets R times the current that flowed before.  The model lets that current die away within
        the subtransient inductance over R, nanoseconds for an open generator: so does the energy of
        the magnetic field become heat in it.  What the spike's area does, to flux linkages and
        voltage regulator, is right; its height is the model's alone, for an arc limits a real one.
        No rms value and no phasor has it (:mod:`apu_casadi.core.means`).

        Args:
            ss, x, u, theta: variant, state, inputs and parameters just after the switch.
            t, load: its instant, s, and the load from then on; for the text.
        """
        y = ss.y.unpack(ss.g(x, u, theta).full().ravel())
        k = max("abc", key=lambda p: abs(y[f"v_{p}"]))
        v, rated = abs(y[f"v_{k}"]), math.sqrt(2.0) * self.machine.V_rated_rms
        if v <= SPIKE * rated:
            return None
        return (
            f"at t = {t:.6g} s a switch to {load!r} drives the {abs(y[f'i_{k}']):.4g} A of phase "
            f"{k} through it: the model's voltage jumps to {v:.3g} V there, {v / rated:.3g} times "
            "the rated peak, until that current has died away; a real switch arcs instead. Rms "
            "values and phasors leave the spike out, single samples may not"
        )

    # -- steady state -----------------------------------------------------------------------

    @derived
    def V_ref_default(self) -> float:
        """Voltage reference, per unit, that gives Table 7's mean 229.677 V at 225 kW (calibrated).

        The load is the paper's R = 3 V_rated^2 / P_rated.  What another load then gives (100 kW in
        Table 8) is a prediction.
        """
        p = self.machine
        R = 3.0 * p.V_rated_rms**2 / p.P_rated
        V_t = V_TABLE_7 * p.V_rated_rms / 230.0
        E_fd = self._field(V_t, complex(R), p.w_rated)[0] / p.V_fd_base
        V_ref = ac5a.exciter_steady(self.exciter, E_fd=E_fd, V_t=V_t / p.V_rated_rms)[1]
        return float(V_ref)

    def _field(self, V_t: float, Z: complex, w_r: float) -> tuple[float, Windings]:
        """Return V_fd (V) and the steady currents for a terminal voltage (V rms) and impedance.

        (5)-(7) at rest with Z = R + j X are linear in i_fd:
            (R + r_s) i_q + (X + w_r L_d) i_d = w_r L_md i_fd,  (R + r_s) i_d = (X + w_r L_q) i_q.
        """
        p = self.machine
        X_d, X_q = Z.imag + w_r * (p.L_md + p.L_ls), Z.imag + w_r * (p.L_mq + p.L_ls)
        R_t = Z.real + p.r_s
        i_q = R_t / (R_t**2 + X_d * X_q)  # for w_r L_md i_fd = 1 V
        i_d = X_q * i_q / R_t
        V_unit = abs(Z) * math.hypot(i_q, i_d)
        scale = math.sqrt(2.0) * V_t / V_unit
        i_fd = scale / (w_r * p.L_md)
        return p.r_fd * i_fd, Windings(scale * i_q, scale * i_d, 0.0, i_fd, 0.0, 0.0)

    def steady_state(
        self,
        load: Load,
        *,
        w_r: float | None = None,
        V_t: float | None = None,
        V_ref: float | None = None,
        theta_e: float = 0.0,
    ) -> GeneratorPoint:
        """Return the healthy generator's steady state with a balanced load.

        Args:
            load: a balanced load; from an unbalanced one or a fault, simulate long enough instead.
            w_r: electrical speed, rad/s; default rated.
            V_t: terminal voltage, V rms per phase; V_ref follows.  Or
            V_ref: voltage reference, per unit; V_t follows.  Default :attr:`V_ref_default`.
            theta_e: rotor angle to start from, rad.

        Raises:
            OperatingPointError: an unbalanced load, both voltages given, a regulator limit, or a
                residual above 1e-6 1/s.
        """
        p, e = self.machine, self.exciter
        w_r = p.w_rated if w_r is None else number("w_r", w_r, error=OperatingPointError)
        V_t, V_ref = (
            None if v is None else number(n, v, error=OperatingPointError)
            for n, v in (("V_t", V_t), ("V_ref", V_ref))
        )
        if not (math.isfinite(w_r) and w_r > 0):
            raise OperatingPointError(f"w_r must be > 0 rad/s (electrical), got {w_r!r}")
        if V_t is not None and V_ref is not None:
            raise OperatingPointError("give V_t or V_ref, not both: each determines the other")
        if not load.balanced:
            raise OperatingPointError(
                f"no closed steady state with the unbalanced {load!r}: start from a balanced load "
                "and switch"
            )

        if V_t is None:
            V_t = self._regulated(load, w_r, self.V_ref_default if V_ref is None else V_ref)
        if not V_t > 0:
            raise OperatingPointError(f"terminal voltage must be > 0, got {V_t!r} V")
        i, states, ref = self._at_rest(load, w_r, V_t)
        if not e.V_R_min <= states.V_R <= e.V_R_max:
            raise OperatingPointError(
                f"holding {V_t:.5g} V with {load!r} at w_r = {w_r:.5g} rad/s needs "
                f"V_R = {states.V_R:.4g}, outside [{e.V_R_min:g}, {e.V_R_max:g}]"
            )
        ss = self.state_space(load)
        lam = wrsg.flux_linkages(p, i)
        values: dict[str, Any] = {f"lam_{n}": v for n, v in lam._asdict().items()}
        values |= {n: v for n, v in states._asdict().items() if v is not None}
        values["theta_e"] = theta_e
        values |= load.steady(w_r, V_t, i.stator)
        x = ss.x.pack({n: values[n] for n in ss.x.names})
        u = self.inputs(load, w_r=w_r, V_ref=ref)
        rate = ss.f(x, u, []).full().ravel() / ss.x.nominals
        rate[ss.x.index("theta_e")] = 0.0
        worst = int(np.argmax(np.abs(rate)))
        if not abs(rate[worst]) < 1e-6:
            raise OperatingPointError(
                f"steady state of {ss.name} with {load!r}: {ss.x.names[worst]} changes by "
                f"{rate[worst]:.2e} of its nominal value per second, 1e-6 allowed"
                + (f"; {load.caveat}" if load.caveat else "")
            )
        y = ss.y.unpack(ss.g(x, u, []).full().ravel())
        return GeneratorPoint(ss, x, u, ref, V_t, y, float(abs(rate[worst])))

    def _at_rest(
        self, load: Load, w_r: float, V_t: float
    ) -> tuple[Windings, ac5a.ExciterState, float]:
        """Return currents, exciter and V_ref at rest with a terminal voltage, V rms."""
        p = self.machine
        V_fd, i = self._field(V_t, load.impedance(w_r, V_t), w_r)
        E_fd = V_fd / p.V_fd_base
        return i, *ac5a.exciter_steady(self.exciter, E_fd=E_fd, V_t=V_t / p.V_rated_rms)

    def _regulated(self, load: Load, w_r: float, V_ref: float) -> float:
        """Return the terminal voltage, V rms, that the regulator holds with ``V_ref``.

        V_t = V_ref - V_R / K_A with 0 <= V_R <= V_R_max at rest, so the root is bracketed.
        """
        import scipy.optimize

        rated, e = self.machine.V_rated_rms, self.exciter

        def excess(V: float) -> float:
            return self._at_rest(load, w_r, V)[2] - V_ref

        low, high = max((V_ref - e.V_R_max / e.K_A) * rated, 1e-6 * rated), V_ref * rated
        if high > low and not excess(low) <= 0 <= excess(high):
            raise OperatingPointError(
                f"no regulated steady state for {load!r} at V_ref = {V_ref:.5g}, "
                f"w_r = {w_r:.5g} rad/s: even at {low:.4g} V the regulator would need "
                f"V_R = {self._at_rest(load, w_r, low)[1].V_R:.4g}, ceiling {e.V_R_max:g}"
            )
        return float(scipy.optimize.brentq(excess, low, high, xtol=1e-12, rtol=1e-15))

    # -- standalone studies -----------------------------------------------------------------

    def simulate(
        self,
        load: Load,
        t_end: float,
        *,
        switches: Sequence[tuple[float, Load | Fault | Mapping[str, float] | None]] = (),
        w_r: float | None = None,
        V_ref: float | None = None,
        dt_out: float = 50e-6,
        solver: str = "auto",
        rtol: float = simulation.RTOL,
        atol: float = simulation.ATOL,
    ) -> Any:
        """Simulate from the steady state with ``load`` through load and fault switches.

        Args:
            load: balanced load at the start.
            t_end: end, s.
            switches: pairs (instant in s, what comes): a load replaces the load, a fault
                replaces the fault, None clears it, a mapping changes inputs (``w_r``, ``V_ref``,
                process noise).  Several that share an instant are one switch, whatever their order.
            w_r, V_ref: as for :meth:`steady_state`.
            dt_out: output interval, s.
            solver, rtol, atol: as for :func:`apu_casadi.core.simulation.simulate`.

        Returns:
            xarray.Dataset: see :func:`apu_casadi.core.simulation.simulate`; attributes hold V_ref,
            the switches and, as a JSON list, ``warnings`` (:meth:`spike`).
        """
        point = self.steady_state(load, w_r=w_r, V_ref=V_ref)
        n = round(t_end / dt_out)
        if n < 1:
            raise ParameterError(f"t_end = {t_end:g} s is shorter than dt_out = {dt_out:g} s")
        grid = np.arange(n + 1) * dt_out
        if t_end - grid[-1] > 1e-9 * dt_out:
            grid = np.append(grid, t_end)
        fault: Fault | None = None
        other: dict[str, float] = {"w_r": point.u[0], "V_ref": point.V_ref}
        plan, ss, u, theta = [], point.ss, point.u, np.zeros(0)
        fed, told = [load], list[str]()
        for t, changes in _instants(switches):
            fault = changes.get("fault", fault)
            load = changes.get("load", load)
            other = {**other, **changes.get("inputs", {})}
            fed.append(load)
            new = self.variant(load, fault)
            u_new = self.inputs(load, **other)
            theta_new = self.fault_vector(load, fault)
            transfer = _Transfer(self, ss, new, u, theta, u_new, theta_new, t, load, told)
            plan.append(simulation.Switch(t, u_new, theta_new, new, transfer))
            ss, u, theta = new, u_new, theta_new
        fine = min(each.fineness for each in fed)
        rtol, atol = fine * rtol, fine * atol
        data = simulation.simulate(
            point.ss, point.x, grid, point.u, switches=plan, solver=solver, rtol=rtol, atol=atol
        )
        data.attrs |= {
            "V_ref": point.V_ref,
            "neutral": self.neutral,
            "warnings": json.dumps(told),
            "switches": "; ".join(f"{t:g} s: {c!r}" for t, c in switches),
        }
        return data


@dataclass(frozen=True, eq=False)
class _Transfer:
    """The state map of one switch, as a function of the state before it."""

    generator: Generator
    source: GeneratorModel
    target: GeneratorModel
    u: np.ndarray
    theta: np.ndarray
    u_target: np.ndarray
    theta_target: np.ndarray
    t: float
    load: Load
    told: list[str]

    def __call__(self, x: np.ndarray) -> np.ndarray:
        now = {"u_target": self.u_target, "theta_target": self.theta_target}
        after = self.generator.transfer(
            x, self.source, self.target, u=self.u, theta=self.theta, **now
        )
        text = self.generator.spike(
            self.target, after, self.u_target, self.theta_target, t=self.t, load=self.load
        )
        if text is not None:
            self.told.append(text)
        return after


def _instants(switches: Sequence[tuple[float, Any]]) -> list[tuple[float, dict[str, Any]]]:
    """Return the switches instant by instant, each with its load, fault and inputs.

    Raises:
        ParameterError: something that is no change, or two of a kind at one instant, whose order
            would decide.
    """
    grouped: list[tuple[float, dict[str, Any]]] = []
    for t, change in sorted(switches, key=lambda s: s[0]):
        if not grouped or t - grouped[-1][0] > SAME_INSTANT:
            grouped.append((float(t), {}))
        now = grouped[-1][1]
        if change is None or isinstance(change, Fault):
            kind, twice = "fault", "fault" in now
        elif isinstance(change, Load):
            kind, twice = "load", "load" in now
        elif isinstance(change, Mapping):
            kind, before = "inputs", now.get("inputs", {})
            twice = any(before.get(k, v) != v for k, v in change.items())
            change = {**before, **change}
        else:
            raise ParameterError(
                f"switch at t = {t:g} s: a load, a fault, None or a mapping of inputs is "
                f"needed, got {change!r}"
            )
        if twice and now[kind] != change:
            raise ParameterError(
                f"two different changes of the {kind} at t = {t:g} s: {now[kind]!r} and {change!r}"
            )
        now[kind] = change
    return grouped


@kept
def _variant(gen: Generator, structure: Structure) -> GeneratorModel:
    return variant(structure, gen.machine, gen.exciter)


def load_of_kind(kind: str) -> Load:
    """Return a typical load of a kind."""
    made: Load = _of_kind("load", LOADS.classes, kind)
    return made


def fault_of_kind(kind: str) -> Fault:
    """Return a typical fault of a kind."""
    made: Fault = _of_kind("fault", FAULTS.classes, kind)
    return made


def _of_kind(what: str, classes: Sequence[Any], kind: str, more: str = "") -> Any:
    examples = {k: v for cls in classes for k, v in cls.examples().items()}
    if kind not in examples:
        raise ParameterError(f"{what} kind {kind!r} {nearest(str(kind), examples)}{more}")
    return examples[kind]
