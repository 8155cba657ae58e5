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
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from apu_casadi.core import simulation
from apu_casadi.core.checked import number
from apu_casadi.core.errors import OperatingPointError, ParameterError, nearest
from apu_casadi.core.profiles.profile import Profile, Varying, at, fixed
from apu_casadi.core.sharing import Parametric, derived, kept
from apu_casadi.core.signals import Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.machine import exciter as ac5a
from apu_casadi.machine import wrsg
from apu_casadi.machine.atrest import AtRest, GeneratorPoint
from apu_casadi.machine.faults.fault import FAULTS, Fault, FaultStructure
from apu_casadi.machine.generatormodel import GeneratorModel, Shaft, Structure, variant
from apu_casadi.machine.loads.load import LOADS, Load, LoadStructure
from apu_casadi.machine.machinedata import ExciterParameters, MachineParameters
from apu_casadi.machine.periodic import Closing, Turn, solve_periodic
from apu_casadi.machine.switching import timeline
from apu_casadi.machine.wrsg import Windings

__all__ = ["Generator", "GeneratorPoint", "fault_of_kind", "load_of_kind"]

NEUTRALS = ("grounded", "isolated")
EXCITATIONS = ("regulated", "constant")
POWERS = ("paper", "torque")
CHOICES: dict[str, tuple[str, ...]] = {
    "neutral": NEUTRALS,
    "excitation": EXCITATIONS,
    "power": POWERS,
}
"""What is chosen by a word, and its words."""

#: Voltage just after a switch, over the rated peak, that is warned of: a drop from rated load to
#: less than half of it makes 2.3.
SPIKE = 3.0


class Spike(NamedTuple):
    """A voltage spike just after a switch.

    Args:
        words: what is told of it.
        t: instant, s.
        name: of the voltage.
        V, limit: its height, and what is warned of, V.
    """

    words: str
    t: float
    name: str
    V: float
    limit: float


#: Mean phase voltage of Table 7's reference column at 225 kW, V rms: sets the default V_ref.
V_TABLE_7 = (229.6704 + 229.6903 + 229.6704) / 3.0


@dataclass(frozen=True)
class Generator(Parametric):
    """One starter/generator with its exciter; the load comes with each study.

    Args:
        machine, exciter: parameter sets.
        neutral: ``"grounded"`` (four wires, as in aircraft) joins the star points of machine and
            load; ``"isolated"`` leaves the load's star point free.
        excitation: ``"regulated"`` by the AC5A, or ``"constant"``: the field voltage stays what it
            is at the start, as in an open-loop test.
        power: what loads the shaft, ``P_total``: ``"paper"`` is eq. (8), output and extra loss of
            the fault over eta_sg; ``"torque"`` the torque's power and :attr:`P_fixed`.

    Raises:
        ParameterError: unknown neutral, excitation or power.
    """

    machine: MachineParameters = field(default_factory=MachineParameters)
    exciter: ExciterParameters = field(default_factory=ExciterParameters)
    neutral: str = "grounded"
    excitation: str = "regulated"
    power: str = "paper"

    def __post_init__(self) -> None:
        for what, known in CHOICES.items():
            value = getattr(self, what)
            if value not in known:
                raise ParameterError(f"{what} {value!r} {nearest(str(value), known)}")

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
        load = fixed(load, "load", "a model or its input")
        how = (self.neutral, self.exciter.absent, self.excitation, type(self.machine), self.power)
        return Structure(LoadStructure.of(load), fault, *how)

    def fault_kind(self, load: Load, fault: Fault | None) -> str | None:
        """Return which equations a fault needs beside this load."""
        fault = fixed(fault, "fault", "a model or its parameter")
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
        kind = self.fault_kind(load, fault)
        assert kind is not None
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
    ) -> Spike | None:
        """Return what must be known of a voltage spike just after a switch; None without one.

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
        words = (
            f"at t = {t:.6g} s a switch to {load!r} drives the {abs(y[f'i_{k}']):.4g} A of phase "
            f"{k} through it: the model's voltage jumps to {v:.3g} V there, {v / rated:.3g} times "
            "the rated peak, until that current has died away; a real switch arcs instead. Rms "
            "values and phasors leave the spike out, single samples may not"
        )
        return Spike(words, t, f"v_{k}", v, SPIKE * rated)

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
        E_fd = self._rest.field(V_t, complex(R), p.w_rated)[0] / p.V_fd_base
        V_ref = ac5a.exciter_steady(self.exciter, E_fd=E_fd, V_t=V_t / p.V_rated_rms)[1]
        return float(V_ref)

    @derived
    def P_fixed(self) -> float:
        """Iron and friction loss, W, at rated speed, with which the healthy efficiency is eta_sg.

        Output over eta_sg, less the torque's power, at the rated load of :attr:`V_ref_default`.
        Assumed in proportion to speed, and the same at any load: Table 1 tells none of its parts.
        """
        p, R = self.machine, complex(3.0 * self.machine.V_rated_rms**2 / self.machine.P_rated)
        i = self._rest.field(V_TABLE_7 * p.V_rated_rms / 230.0, R, p.w_rated)[1]
        P_e = 1.5 * R.real * (i.sq**2 + i.sd**2)
        torque = wrsg.torque(p, lam=wrsg.flux_linkages(p, i), i=i)
        return float(P_e / p.eta_sg - torque * p.w_rated / p.n_pp)

    @property
    def _rest(self) -> AtRest:
        return AtRest(self.machine, self.exciter)

    def steady_state(
        self,
        load: Load,
        fault: Fault | None = None,
        *,
        w_r: float | None = None,
        V_t: float | None = None,
        V_ref: float | None = None,
        V_fd: float | None = None,
        theta_e: float = 0.0,
    ) -> GeneratorPoint:
        """Return the generator's steady state; a periodic one if anything is unbalanced.

        A healthy machine with a balanced load rests on the rotor's axes.  With a fault or an
        unbalanced load states and outputs repeat with the turn (:mod:`.periodic`).

        Args:
            load, fault: what holds.
            w_r: electrical speed, rad/s; default rated.
            V_t: terminal voltage, V rms per phase (its mean, where it ripples); V_ref follows.  Or
            V_ref: voltage reference, per unit; V_t follows.  Default :attr:`V_ref_default`.  Or
            V_fd: field voltage, V, referred to the stator (its mean, where it ripples).
            theta_e: rotor angle to start from, rad.

        Raises:
            OperatingPointError: two voltages given, a regulator limit with a balanced load, a load
                that the field cannot carry, or a residual above 1e-6 1/s (of a periodic state
                1e-7 per rad).
            ScenarioError: a load or fault that changes in time.
        """
        p = self.machine
        load, fault = (fixed(x, n, "a steady state") for n, x in (("load", load), ("fault", fault)))
        w_r = p.w_rated if w_r is None else number("w_r", w_r, error=OperatingPointError)
        theta_e = number("theta_e", theta_e, error=OperatingPointError)
        voltages = {"V_t": V_t, "V_ref": V_ref, "V_fd": V_fd}
        given = {
            n: number(n, v, error=OperatingPointError) for n, v in voltages.items() if v is not None
        }
        if not (math.isfinite(w_r) and w_r > 0):
            raise OperatingPointError(f"w_r must be > 0 rad/s (electrical), got {w_r!r}")
        if len(given) > 1:
            names = " or ".join(given)
            raise OperatingPointError(f"give {names}, not both: each determines the other")
        ((name, value),) = given.items() or [("V_ref", self.V_ref_default)]
        if not value > 0:
            what = {"V_t": "terminal voltage", "V_fd": "field voltage"}.get(name, name)
            unit = "" if name == "V_ref" else " V"
            raise OperatingPointError(f"{what} must be > 0, got {value!r}{unit}")
        if fault is None and load.balanced:
            return self._balanced(load, w_r, name, value, theta_e)
        return self._periodic(load, fault, w_r, name, value, theta_e)

    def _balanced(
        self, load: Load, w_r: float, name: str, value: float, theta_e: float
    ) -> GeneratorPoint:
        e, rest = self.exciter, self._rest
        V_t = value
        if name != "V_t":
            V_t = (rest.regulated if name == "V_ref" else rest.excited)(load, w_r, value)
        if not V_t > 0:
            raise OperatingPointError(f"terminal voltage must be > 0, got {V_t!r} V")
        i, states, ref = rest.at(load, w_r, V_t)
        if self.excitation == "regulated" and not e.V_R_min <= states.V_R <= e.V_R_max:
            raise OperatingPointError(
                f"holding {V_t:.5g} V with {load!r} at w_r = {w_r:.5g} rad/s needs "
                f"V_R = {states.V_R:.4g}, outside [{e.V_R_min:g}, {e.V_R_max:g}]"
            )
        ss = self.state_space(load)
        x = self._packed(ss, load, i, states, theta_e, w_r, V_t)
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

    def _packed(
        self,
        ss: GeneratorModel,
        load: Load,
        i: Windings,
        states: ac5a.ExciterState,
        theta_e: float,
        w_r: float,
        V_t: float,
    ) -> np.ndarray:
        """Return the state of a variant from currents and exciter at rest, zero where not told."""
        lam = wrsg.flux_linkages(self.machine, i)
        values: dict[str, Any] = {f"lam_{n}": v for n, v in lam._asdict().items()}
        values |= {n: v for n, v in states._asdict().items() if v is not None}
        values |= {"theta_e": theta_e, **load.steady(w_r, V_t, i.stator)}
        return ss.x.pack({n: values.get(n, 0.0) for n in ss.x.names})

    def _periodic(
        self,
        load: Load,
        fault: Fault | None,
        w_r: float,
        name: str,
        value: float,
        theta_e: float,
    ) -> GeneratorPoint:
        """Solve for the periodic state, from the one at rest of the load's balanced part."""
        p, e, rest = self.machine, self.exciter, self._rest
        ss, vector = self.variant(load, fault), self.fault_vector(load, fault)
        near, V = load.balanced_part, p.V_rated_rms if name != "V_t" else value
        i, states, ref = rest.at(near, w_r, V)
        x = self._packed(ss, near, i, states, theta_e, w_r, V)

        def miss(V_t: float, E: float) -> tuple[float, float, float]:
            if name == "V_t":
                return (V_t - value) / p.V_rated_rms, 1.0 / p.V_rated_rms, 0.0
            if name == "V_fd":
                return E - value / p.V_fd_base, 0.0, 1.0
            _, now = ac5a.exciter_steady(e, E_fd=E, V_t=V_t / p.V_rated_rms)
            _, then = ac5a.exciter_steady(e, E_fd=E + (h := 1e-6), V_t=V_t / p.V_rated_rms)
            return now - value, 1.0 / p.V_rated_rms, (then - now) / h

        def at_rest(V_t: float, E: float) -> tuple[dict[str, float], float]:
            states, ref = ac5a.exciter_steady(e, E_fd=E, V_t=V_t / p.V_rated_rms)
            return {n: v for n, v in states._asdict().items() if v is not None}, ref

        held = self.excitation == "constant"
        E = value / p.V_fd_base if name == "V_fd" else states.E_fd
        ref = value if name == "V_ref" else ref
        u = self.inputs(load, w_r=w_r, V_ref=ref)
        exact = name == ("V_fd" if held else "V_ref")
        closing = Closing(held, E, ref, exact, miss, at_rest)
        reversing = ("lam_s0", *(fault.reversing if fault else ()), *load.reversing)
        found = solve_periodic(ss, x, u, vector, closing, reversing)
        states_ = found.x
        V_t = Turn.of(ss, states_, u, vector).mean("V_t")
        if held:  # the regulator is not there; its states are those of a field at rest
            at, ref = at_rest(V_t, found.value)
            for n, v in at.items():
                states_[ss.x.index(n)] = v
        else:
            ref = found.value
        u = self.inputs(load, w_r=w_r, V_ref=ref)
        y = ss.y.unpack(ss.g(states_[:, 0], u, vector).full().ravel())
        V_R = states_[ss.x.index("V_R")]
        note = ""
        if not held and not (e.V_R_min < V_R.min() and V_R.max() < e.V_R_max * (1 - 1e-9)):
            note = f"the voltage regulator is at its limit: V_R = {V_R.mean():.4g}"
        return GeneratorPoint(
            ss, states_[:, 0], u, ref, V_t, y, found.defect, vector, states_, note
        )

    # -- standalone studies -----------------------------------------------------------------

    def simulate(
        self,
        load: Load | Varying[Load],
        t_end: float,
        *,
        fault: Fault | Varying[Fault | None] | None = None,
        switches: Sequence[tuple[float, Any]] = (),
        w_r: float | Profile | None = None,
        V_ref: float | Profile | None = None,
        V_t: float | None = None,
        V_fd: float | None = None,
        theta_e: float = 0.0,
        dt_out: float = 50e-6,
        hold: float = 0.02,
        solver: str = "auto",
        rtol: float = simulation.RTOL,
        atol: float = simulation.ATOL,
    ) -> Any:
        """Simulate from the steady state with ``load`` through load and fault switches.

        Args:
            load, fault: at the start, in their steady state.
            t_end: end, s.
            switches: pairs (instant in s, what comes): a load replaces the load, a fault
                replaces the fault, None clears it, a mapping changes inputs (``w_r``, ``V_ref``,
                process noise).  Several that share an instant are one switch, whatever their order.
            w_r, V_ref, V_t, V_fd, theta_e: as for :meth:`steady_state`.
            dt_out: output interval, s.
            hold: load, fault, ``w_r`` and ``V_ref`` may follow profiles, also those of switches,
                whose time counts from there; they are held over steps of this length, s, at their
                value in the middle.
            solver, rtol, atol: as for :func:`apu_casadi.core.simulation.simulate`.

        Returns:
            xarray.Dataset: see :func:`apu_casadi.core.simulation.simulate`; attributes hold V_ref,
            the switches and, as a JSON list, ``warnings`` (:meth:`spike`).
        """
        given = {"w_r": w_r, "V_ref": V_ref}
        how = {n: at(v, 0.0) for n, v in given.items()} | {"V_t": V_t, "V_fd": V_fd}
        point = self.steady_state(at(load, 0.0), at(fault, 0.0), **how, theta_e=theta_e)
        n = round(t_end / dt_out)
        if n < 1:
            raise ParameterError(f"t_end = {t_end:g} s is shorter than dt_out = {dt_out:g} s")
        grid = np.arange(n + 1) * dt_out
        if t_end - grid[-1] > 1e-9 * dt_out:
            grid = np.append(grid, t_end)
        profiles = {n: v for n, v in given.items() if isinstance(v, Profile)}
        other = {"w_r": point.u[0], "V_ref": point.V_ref, **profiles}
        plan, ss, u, theta = [], point.ss, point.u, point.theta
        fed, told = [at(load, 0.0)], list[str]()
        for now in timeline(load, fault, other, switches, t_end, hold):
            fed.append(now.load)
            new = self.variant(now.load, now.fault)
            u_new = self.inputs(now.load, **now.inputs)
            theta_new = self.fault_vector(now.load, now.fault)
            transfer = None
            if now.switched or new != ss:
                of_both = u, theta, u_new, theta_new
                transfer = _Transfer(self, ss, new, *of_both, now.t, now.load, told)
            plan.append(simulation.Switch(now.t, u_new, theta_new, new, transfer))
            ss, u, theta = new, u_new, theta_new
        fine = min(each.fineness for each in fed)
        rtol, atol = fine * rtol, fine * atol
        numbers: dict[str, Any] = {"solver": solver, "rtol": rtol, "atol": atol}
        data = simulation.simulate(
            point.ss, point.x, grid, point.u, point.theta, switches=plan, **numbers
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
        spike = self.generator.spike(
            self.target, after, self.u_target, self.theta_target, t=self.t, load=self.load
        )
        if spike is not None:
            self.told.append(spike.words)
        return after


@kept
def _variant(gen: Generator, structure: Structure) -> GeneratorModel:
    shaft = Shaft(gen.P_fixed if gen.power == "torque" else 0.0)
    return variant(structure, gen.machine, gen.exciter, shaft)


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
