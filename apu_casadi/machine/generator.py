"""The starter/generator: machine, turn-to-turn short circuit, exciter and load in one model.

Written in the effective current ibar = i - T(:,k) mu i_fault, in which the machine is healthy.
Flux linkages are the states and terminal voltages the algebraic unknowns; the latter enter
linearly, so that the explicit right-hand side follows from the DAE by elimination.  The healthy
model has no fault state at all: a fault brings its loop in, and takes it out again when cleared.

A *variant* of the model is a load kind (``"resistive"``, ``"inductive"``, ``"constant_power"``)
with a fault kind:

* ``None`` : healthy;
* ``"coupled"`` : kappa = mu with i_fault algebraic; grounded neutral, no load inductance in the
  faulty phase; theta = (mu, k_rf, phase_angle);
* ``"leaky"`` : i_fault is a state; kappa > mu, or kappa = mu with an isolated neutral or an
  inductance in the faulty phase's load; theta = (mu, k_rf, kappa, phase_angle).

At a switch the machine's flux linkages, the rotor angle and the exciter are continuous, and so
are the effective currents.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core import simulation
from apu_casadi.core.checked import number
from apu_casadi.core.errors import OperatingPointError, ParameterError, SignalError, nearest
from apu_casadi.core.sharing import Parametric, derived, kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.machine import exciter as ac5a
from apu_casadi.machine import wrsg
from apu_casadi.machine.faults import ttsc
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.load import (
    KINDS,
    V_MIN,
    ConstantPowerLoad,
    Load,
    OpenLoad,
    SeriesLoad,
    fineness,
)
from apu_casadi.machine.machinedata import ExciterParameters, MachineParameters
from apu_casadi.machine.park import (
    Abc,
    Qd0,
    abc_to_qd0,
    phase_selector,
    qd0_to_abc,
    speed_voltage,
)
from apu_casadi.machine.wrsg import Windings

FAULTS = (None, "coupled", "leaky")
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

    ss: StateSpace
    x: np.ndarray
    u: np.ndarray
    V_ref: float
    V_t: float
    y: dict[str, float]
    residual: float


@dataclass(frozen=True)
class MeasurementNoise:
    """The measurement equation (10): white Gaussian noise on terminal quantities.

    Args:
        sigma_i: standard deviation of v_i, phase currents, A.
        sigma_v: standard deviation of v_v, phase voltages, V.
        sigma_V_fd: standard deviation of v_v, field voltage, V.
    """

    sigma_i: float = 0.0
    sigma_v: float = 0.0
    sigma_V_fd: float = 0.0

    def __post_init__(self) -> None:
        """Refuse standard deviations that are negative or not finite."""
        for name in ("sigma_i", "sigma_v", "sigma_V_fd"):
            value = number(f"MeasurementNoise.{name}", getattr(self, name), error=ParameterError)
            if not (math.isfinite(value) and value >= 0):
                raise ParameterError(f"MeasurementNoise.{name} must be >= 0, got {value!r}")

    def measure(self, y: Mapping[str, Any], rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Return noisy i_a, i_b, i_c, v_a, v_b, v_c, V_fd, each of the shape it has in ``y``.

        Args:
            y: true values by name; a Dataset, or ``ss.y.unpack(step.y)``.
            rng: the caller's generator; nothing is seeded here.
        """
        return dict(self.each(y, rng))

    def each(
        self, y: Mapping[str, Any], rng: np.random.Generator
    ) -> Iterator[tuple[str, np.ndarray]]:
        """Yield name and noisy values of :meth:`measure` one after the other."""
        sigmas = dict.fromkeys(("i_a", "i_b", "i_c"), self.sigma_i)
        sigmas |= dict.fromkeys(("v_a", "v_b", "v_c"), self.sigma_v)
        sigmas["V_fd"] = self.sigma_V_fd
        missing = [n for n in sigmas if n not in y]
        if missing:
            raise SignalError(f"to be measured but absent: {', '.join(missing)}")
        for n, sigma in sigmas.items():
            v = np.asarray(y[n], dtype=float)
            yield n, v + sigma * rng.standard_normal(v.shape)


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

    def state_space(self, load_kind: str = "resistive", faulted: str | None = None) -> StateSpace:
        """Return the model variant, built once.

        Args:
            load_kind: ``"resistive"``, ``"inductive"`` or ``"constant_power"`` (``load.kind``).
            faulted: None, ``"coupled"`` or ``"leaky"``; see the module's text.

        Raises:
            ParameterError: unknown kinds, or ``"coupled"`` with an isolated neutral.
        """
        if load_kind not in KINDS:
            raise ParameterError(f"load kind {load_kind!r} {nearest(str(load_kind), KINDS)}")
        if faulted not in FAULTS:
            raise ParameterError(
                f"fault kind {faulted!r} {nearest(str(faulted), ('coupled', 'leaky'))}, or None"
            )
        if faulted == "coupled" and self.neutral == "isolated":
            raise ParameterError(
                "with an isolated neutral i_fault is a state for every kappa: use 'leaky'"
            )
        return _build(self, load_kind, faulted)

    def fault_kind(self, load: Load, fault: Ttsc | None) -> str | None:
        """Return which variant a fault needs beside this load: None, "coupled" or "leaky"."""
        if fault is None:
            return None
        inductive = isinstance(load, SeriesLoad) and load.L["abc".index(fault.phase)] > 0
        if fault.kappa == fault.mu and self.neutral == "grounded" and not inductive:
            return "coupled"
        return "leaky"

    def variant(self, load: Load, fault: Ttsc | None = None) -> StateSpace:
        """Return the model variant for a load and a fault."""
        return self.state_space(load.kind, self.fault_kind(load, fault))

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
        return _inputs(load.kind).pack({**values, **load.inputs, **noise})

    def fault_vector(self, load: Load, fault: Ttsc | None) -> np.ndarray:
        """Return the parameters theta of :meth:`variant` for this load and fault."""
        kind = self.fault_kind(load, fault)
        if fault is None:
            return np.zeros(0)
        values = {"mu": fault.mu, "k_rf": fault.k_rf, "phase_angle": fault.phase_angle}
        if kind == "leaky":
            values["kappa"] = fault._kappa
        return _fault_signals(kind).pack(values)

    def transfer(
        self,
        x: Any,
        source: StateSpace,
        target: StateSpace,
        *,
        u: Any,
        theta: Any,
        u_target: Any,
        theta_target: Any = (),
    ) -> np.ndarray:
        """Return the state of ``target`` just after a switch, from that of ``source`` before it.

        States carry over by name: flux linkages, rotor angle, exciter.  A new i_fault starts from
        the algebraic i_fault of the source if it had a fault in that phase, else from zero; a new
        load conductance starts where it draws its power from the source's terminal voltage.

        Args:
            x, u, theta: state, inputs and parameters of the source at the switch.
            u_target, theta_target: inputs and parameters of the target; a fault without
                ``theta_target`` is taken to be in the phase it was in.
        """
        values = source.x.unpack(np.asarray(x, dtype=float))
        angles = [
            s.theta.unpack(np.asarray(t, dtype=float))["phase_angle"]
            for s, t in ((source, theta), (target, theta_target))
            if len(s.theta) and np.size(t)
        ]
        moved = len(angles) == 2 and angles[0] != angles[1]
        if moved:  # another branch: the one that was there is gone, with its current
            values.pop("i_fault", None)
        new = [n for n in target.x.names if n not in values]
        if new:
            z = source.z.unpack(source.z_of(x, u, theta).full().ravel())
            y = source.y.unpack(source.g(x, u, theta).full().ravel())
            start = {"i_fault": 0.0 if moved else z.get("i_fault", 0.0)}
            if "G_load" in new:
                V_2 = max(3.0 * y["V_t"] ** 2, 3.0 * (V_MIN * self.machine.V_rated_rms) ** 2)
                start["G_load"] = target.u.unpack(np.asarray(u_target))["P_load"] / V_2
            values |= {n: start[n] for n in new}
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
        E_fd = self._field(V_t, R, 0.0, p.w_rated)[0] / p.V_fd_base
        V_ref = ac5a.exciter_steady(self.exciter, E_fd=E_fd, V_t=V_t / p.V_rated_rms)[1]
        return float(V_ref)

    def _field(self, V_t: float, R: float, L: float, w_r: float) -> tuple[float, Windings]:
        """Return V_fd (V) and the steady currents for a terminal voltage (V rms) and R-L load.

        (5)-(7) at rest are linear in i_fd:
            (R + r_s) i_q + w_r (L + L_d) i_d = w_r L_md i_fd,   (R + r_s) i_d = w_r (L + L_q) i_q.
        """
        p = self.machine
        X_d, X_q = w_r * (L + p.L_md + p.L_ls), w_r * (L + p.L_mq + p.L_ls)
        R_t = R + p.r_s
        i_q = R_t / (R_t**2 + X_d * X_q)  # for w_r L_md i_fd = 1 V
        i_d = X_q * i_q / R_t
        V_unit = math.hypot(R, w_r * L) * math.hypot(i_q, i_d)
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

        def at(V: float) -> tuple[float, Windings, ac5a.ExciterState, float]:
            V_fd, i = self._field(V, *_star(load, V), w_r)
            E_fd = V_fd / p.V_fd_base
            states, ref = ac5a.exciter_steady(e, E_fd=E_fd, V_t=V / p.V_rated_rms)
            return V_fd, i, states, ref

        if V_t is None:
            wanted = self.V_ref_default if V_ref is None else V_ref
            # V_t = V_ref - V_R / K_A with 0 <= V_R <= V_R_max at rest, so the root is bracketed
            low = max((wanted - e.V_R_max / e.K_A) * p.V_rated_rms, 1e-6 * p.V_rated_rms)
            high = wanted * p.V_rated_rms
            excess = [at(low)[3] - wanted, at(high)[3] - wanted] if high > low else [0.0, 0.0]
            if not excess[0] <= 0 <= excess[1]:
                raise OperatingPointError(
                    f"no regulated steady state for {load!r} at V_ref = {wanted:.5g}, "
                    f"w_r = {w_r:.5g} rad/s: even at {low:.4g} V the regulator would need "
                    f"V_R = {at(low)[2].V_R:.4g}, ceiling {e.V_R_max:g}"
                )
            import scipy.optimize

            V_t = float(
                scipy.optimize.brentq(
                    lambda V: at(V)[3] - wanted, low, high, xtol=1e-12, rtol=1e-15
                )
            )
        if not V_t > 0:
            raise OperatingPointError(f"terminal voltage must be > 0, got {V_t!r} V")
        _, i, states, ref = at(V_t)
        if not e.V_R_min <= states.V_R <= e.V_R_max:
            raise OperatingPointError(
                f"holding {V_t:.5g} V with {load!r} at w_r = {w_r:.5g} rad/s needs "
                f"V_R = {states.V_R:.4g}, outside [{e.V_R_min:g}, {e.V_R_max:g}]"
            )
        ss = self.state_space(load.kind)
        lam = wrsg.flux_linkages(p, i)
        values: dict[str, Any] = {f"lam_{n}": v for n, v in lam._asdict().items()}
        values |= {n: v for n, v in states._asdict().items() if v is not None}
        values["theta_e"] = theta_e
        if isinstance(load, ConstantPowerLoad):
            values["G_load"] = 1.0 / _star(load, V_t)[0]
        x = ss.x.pack({n: values[n] for n in ss.x.names})
        u = self.inputs(load, w_r=w_r, V_ref=ref)
        rate = ss.f(x, u, []).full().ravel() / ss.x.nominals
        rate[ss.x.index("theta_e")] = 0.0
        worst = int(np.argmax(np.abs(rate)))
        if not abs(rate[worst]) < 1e-6:
            raise OperatingPointError(
                f"steady state of {ss.name} with {load!r}: {ss.x.names[worst]} changes by "
                f"{rate[worst]:.2e} of its nominal value per second, 1e-6 allowed; a constant-"
                f"power load is a conductance below {V_MIN:g} of rated voltage"
            )
        y = ss.y.unpack(ss.g(x, u, []).full().ravel())
        return GeneratorPoint(ss, x, u, ref, V_t, y, float(abs(rate[worst])))

    # -- standalone studies -----------------------------------------------------------------

    def simulate(
        self,
        load: Load,
        t_end: float,
        *,
        switches: Sequence[tuple[float, Load | Ttsc | Mapping[str, float] | None]] = (),
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
            switches: pairs (instant in s, what comes): a load replaces the load, a :class:`Ttsc`
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
        fault: Ttsc | None = None
        other: dict[str, float] = {"w_r": point.u[0], "V_ref": point.V_ref}
        plan, ss, u, theta = [], point.ss, point.u, np.zeros(0)
        loads, told = [load], list[str]()
        for t, changes in _instants(switches):
            fault = changes.get("fault", fault)
            load = changes.get("load", load)
            other = {**other, **changes.get("inputs", {})}
            loads.append(load)
            new = self.variant(load, fault)
            u_new = self.inputs(load, **other)
            theta_new = self.fault_vector(load, fault)
            transfer = _Transfer(self, ss, new, u, theta, u_new, theta_new, t, load, told)
            plan.append(simulation.Switch(t, u_new, theta_new, new, transfer))
            ss, u, theta = new, u_new, theta_new
        fine = min(fineness(each) for each in loads)
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
    source: StateSpace
    target: StateSpace
    u: np.ndarray
    theta: np.ndarray
    u_target: np.ndarray
    theta_target: np.ndarray
    t: float
    load: Load
    told: list[str]

    def __call__(self, x: np.ndarray) -> np.ndarray:
        after = self.generator.transfer(
            x, self.source, self.target, u=self.u, theta=self.theta, u_target=self.u_target,
            theta_target=self.theta_target,
        )  # fmt: skip
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
        if change is None or isinstance(change, Ttsc):
            kind, twice = "fault", "fault" in now
        elif isinstance(change, SeriesLoad | ConstantPowerLoad | OpenLoad):
            kind, twice = "load", "load" in now
        elif isinstance(change, Mapping):
            kind, before = "inputs", now.get("inputs", {})
            twice = any(before.get(k, v) != v for k, v in change.items())
            change = {**before, **change}
        else:
            raise ParameterError(
                f"switch at t = {t:g} s: a load, a Ttsc, None or a mapping of inputs is "
                f"needed, got {change!r}"
            )
        if twice and now[kind] != change:
            raise ParameterError(
                f"two different changes of the {kind} at t = {t:g} s: {now[kind]!r} and {change!r}"
            )
        now[kind] = change
    return grouped


def _star(load: Load, V: float) -> tuple[float, float]:
    """Return a balanced load's R (ohm) and L (H) per phase at a voltage (V rms)."""
    if isinstance(load, ConstantPowerLoad):
        return 3.0 * V**2 / load.P, 0.0
    if isinstance(load, SeriesLoad):
        return load.R[0], load.L[0]
    return load.R, 0.0


def _inputs(load_kind: str) -> Signals:
    signals = [
        Signal("w_r", "rad/s", "electrical rotor speed", nominal=2500.0),
        Signal("V_ref", "1", "voltage reference, per unit"),
    ]
    if load_kind == "constant_power":
        signals += [
            Signal("P_load", "W", "power of the constant-power load", nominal=2e5),
            Signal("tau_load", "s", "lag of the constant-power load", nominal=2e-3),
        ]
    else:
        signals += [Signal(f"R_{k}", "ohm", f"load resistance, phase {k}") for k in "abc"]
    if load_kind == "inductive":
        signals += [
            Signal(f"L_{k}", "H", f"load inductance, phase {k}", nominal=1e-4) for k in "abc"
        ]
    signals += [
        Signal(f"w1_{a}", "V", f"process noise w1 of (5), {a} axis", default=0.0) for a in "qd0"
    ]
    signals += [
        Signal(f"w2_{a}", "V", f"process noise w2 of (6), {a} winding", default=0.0)
        for a in ("fd", "kd", "kq")
    ]
    return Signals(signals)


def _fault_signals(kind: str | None) -> Signals:
    if kind is None:
        return Signals()
    signals = [
        Signal("mu", "1", "fraction of the phase's turns that is shorted", nominal=0.05),
        Signal("k_rf", "1", "fault over shorted-turn resistance (4)"),
        Signal("phase_angle", "rad", "axis of the faulty phase; 0 for phase a"),
    ]
    if kind == "leaky":
        signals.insert(2, Signal("kappa", "1", "leakage partition, mu <= kappa <= 1"))
    return Signals(signals)


def _states(e: ExciterParameters, *, grounded: bool, load_kind: str, leaky: bool) -> Signals:
    signals = [
        Signal("lam_sq", "Wb", "stator flux linkage, q axis", nominal=0.1),
        Signal("lam_sd", "Wb", "stator flux linkage, d axis", nominal=0.1),
        Signal("lam_s0", "Wb", "stator flux linkage, zero sequence", nominal=0.1),
        Signal("lam_fd", "Wb", "field flux linkage", nominal=0.1),
        Signal("lam_kd", "Wb", "d damper flux linkage", nominal=0.1),
        Signal("lam_kq", "Wb", "q damper flux linkage", nominal=0.1),
    ]
    if not grounded:
        del signals[2]
    if leaky:
        signals.append(Signal("i_fault", "A", "current of the fault branch", nominal=1e3))
    signals.append(Signal("theta_e", "rad", "rotor angle, phase-a axis to q axis, unwrapped"))
    signals += list(ac5a.exciter_signals(e))
    if load_kind == "constant_power":
        signals.append(Signal("G_load", "S", "conductance of the constant-power load"))
    return Signals(signals)


_OUTPUTS = Signals(
    [
        *(Signal(f"v_{k}", "V", f"terminal voltage of phase {k} to the machine's neutral",
                 nominal=300.0) for k in "abc"),
        *(Signal(f"i_{k}", "A", f"terminal current of phase {k}", nominal=300.0) for k in "abc"),
        Signal("V_fd", "V", "field voltage, referred to the stator", nominal=50.0),
        Signal("i_fd", "A", "field current, referred to the stator", nominal=1e3),
        Signal("i_kd", "A", "d damper current", nominal=100.0),
        Signal("i_kq", "A", "q damper current", nominal=100.0),
        Signal("i_fault", "A", "current of the fault branch", nominal=1e3),
        Signal("E_fd", "1", "exciter output, per unit"),
        Signal("V_t", "V", "terminal voltage: rms of the space vector", nominal=200.0),
        Signal("v_n", "V", "load star point to machine neutral", nominal=100.0),
        Signal("T_e", "N m", "electromagnetic torque of one machine", nominal=200.0),
        Signal("P_e", "W", "electrical output of one machine", nominal=2e5),
        Signal("P_loss_fault", "W", "extra loss of the fault in (8), one machine", nominal=1e4),
        Signal("P_total", "W", "mechanical power of both machines (8)", nominal=4e5),
    ]
)  # fmt: skip


def solve_linear(M: ca.SX, b: ca.SX) -> ca.SX:
    """Return M^-1 b by elimination in the given order, spending nothing on structural zeros.

    No pivoting: the caller orders the unknowns so that the pivots cannot vanish.
    """
    n = M.shape[0]
    A = [[M[i, j] for j in range(n)] for i in range(n)]
    r = [b[i] for i in range(n)]
    for k in range(n):
        for i in range(k + 1, n):
            if A[i][k].is_zero():
                continue
            factor = A[i][k] / A[k][k]
            A[i][k] = ca.SX(0)
            for j in range(k + 1, n):
                if not A[k][j].is_zero():
                    A[i][j] = A[i][j] - factor * A[k][j]
            r[i] = r[i] - factor * r[k]
    x: list[Any] = [None] * n
    for i in reversed(range(n)):
        total = r[i]
        for j in range(i + 1, n):
            if not A[i][j].is_zero():
                total = total - A[i][j] * x[j]
        x[i] = total / A[i][i]
    return ca.vertcat(*x)


@kept
def _build(gen: Generator, load_kind: str, faulted: str | None) -> StateSpace:
    """Write the semi-explicit DAE once, and eliminate its algebraic unknowns."""
    p, e = gen.machine, gen.exciter
    grounded, leaky = gen.neutral == "grounded", faulted == "leaky"
    X = _states(e, grounded=grounded, load_kind=load_kind, leaky=leaky)
    U, TH = _inputs(load_kind), _fault_signals(faulted)
    algebraic = [
        Signal(f"v_{k}", "V", f"terminal voltage of phase {k}", nominal=300.0) for k in "abc"
    ]
    if not grounded:
        # a difference of phase voltages: megavolts when a switch opens, so the nominal is large
        algebraic.append(Signal("v_n", "V", "load star point to machine neutral", nominal=1e4))
    if faulted == "coupled":
        algebraic.append(Signal("i_fault", "A", "current of the fault branch", nominal=1e3))
    if leaky:
        algebraic.append(Signal("di_fault", "A/s", "rate of i_fault", nominal=1e8))
    Z = Signals(algebraic)
    (xv, x), (zv, z), (uv, u), (tv, th) = X.sx(), Z.sx(), U.sx(), TH.sx()

    # fault
    zero = ca.SX(0)
    mu, k_rf = th.get("mu", zero), th.get("k_rf", zero)
    kappa = th.get("kappa", mu)
    i_fault = x["i_fault"] if leaky else z.get("i_fault", zero)
    di_fault = z.get("di_fault", zero)
    theta_e, w_r = x["theta_e"], u["w_r"]
    select = phase_selector(th["phase_angle"]) if faulted else Abc(zero, zero, zero)

    # machine
    lam = Windings(
        x["lam_sq"],
        x["lam_sd"],
        x["lam_s0"] if grounded else p.L_ls * mu * i_fault / 3.0,  # i_0 = 0
        x["lam_fd"],
        x["lam_kd"],
        x["lam_kq"],
    )
    ibar = wrsg.currents(p, lam)
    v = Abc(z["v_a"], z["v_b"], z["v_c"])
    v_qd0 = abc_to_qd0(theta_e, v)
    w1 = Qd0(u["w1_q"], u["w1_d"], u["w1_0"])
    V_fd = p.V_fd_base * x["E_fd"]
    dlam = wrsg.flux_rates(
        p,
        lam=lam,
        i=ibar,
        v=v_qd0,
        V_fd=V_fd,
        w_r=w_r,
        w1=w1,
        w2=(u["w2_fd"], u["w2_kd"], u["w2_kq"]),
    )
    i = Abc(*(
        ib + s * mu * i_fault
        for ib, s in zip(qd0_to_abc(theta_e, ibar.stator), select, strict=True)
    ))  # fmt: skip

    # load
    v_n = z.get("v_n", zero)
    v_load = Abc(*(vk - v_n for vk in v))
    if load_kind == "constant_power":
        drop = [ik / x["G_load"] for ik in i]
    else:
        drop = [u[f"R_{k}"] * ik for k, ik in zip("abc", i, strict=True)]
    if load_kind == "inductive":
        rates = dlam if grounded else dlam._replace(s0=p.L_ls * mu * di_fault / 3.0)
        dibar = wrsg.currents(p, rates).stator
        turn = speed_voltage(w_r, ibar.stator)
        dbar = qd0_to_abc(theta_e, Qd0(*(a + b for a, b in zip(dibar, turn, strict=True))))
        drop = [
            d + u[f"L_{k}"] * (di + s * mu * di_fault)
            for k, d, di, s in zip("abc", drop, dbar, select, strict=True)
        ]
    alg = [vk - d for vk, d in zip(v_load, drop, strict=True)]
    if not grounded:  # (5), zero sequence: what v_0 must be for i_0 to stay zero
        v_0 = p.L_ls * mu * di_fault / 3.0 - p.r_s * ibar.s0 + w1.zero
        alg.append(v_qd0.zero - v_0)
    w1_abc = qd0_to_abc(theta_e, w1)
    if faulted:
        v_k = sum((s * (vk - wk) for s, vk, wk in zip(select, v, w1_abc, strict=True)), zero)
        alg.append(
            ttsc.loop_residual(
                p, mu=mu, k_rf=k_rf, kappa=kappa, v_k=v_k, i_fault=i_fault, di_fault=di_fault
            )
        )

    # exciter
    V_space = ca.sqrt(v_qd0.q**2 + v_qd0.d**2 + (1e-6 * p.V_rated_rms) ** 2)
    V_t = V_space / math.sqrt(2.0)
    ex = ac5a.ExciterState(*(x.get(n) for n in ac5a.ExciterState._fields))
    dex = ac5a.exciter_rates(e, ex, V_t=V_t / p.V_rated_rms, V_ref=u["V_ref"])

    ode = {f"lam_{n}": d for n, d in dlam._asdict().items() if f"lam_{n}" in X}
    ode |= {n: d for n, d in dex._asdict().items() if n in X}
    ode["theta_e"] = w_r
    if leaky:
        ode["i_fault"] = di_fault
    if load_kind == "constant_power":
        V_2 = sum((vk**2 for vk in v_load), zero)
        floor = 3.0 * (V_MIN * p.V_rated_rms) ** 2
        ode["G_load"] = (u["P_load"] / ca.fmax(V_2, floor) - x["G_load"]) / u["tau_load"]

    P_e = sum((vk * ik for vk, ik in zip(v, i, strict=True)), zero)
    i_k = sum((s * ik for s, ik in zip(select, i, strict=True)), zero)
    P_loss = ttsc.fault_loss(p, mu=mu, k_rf=k_rf, i_k=i_k, i_fault=i_fault) if faulted else zero
    y = {
        **{f"v_{k}": vk for k, vk in zip("abc", v, strict=True)},
        **{f"i_{k}": ik for k, ik in zip("abc", i, strict=True)},
        "V_fd": V_fd,
        "i_fd": ibar.fd,
        "i_kd": ibar.kd,
        "i_kq": ibar.kq,
        "i_fault": i_fault,
        "E_fd": x["E_fd"],
        "V_t": V_t,
        "v_n": v_n,
        "T_e": wrsg.torque(p, lam=lam, i=ibar),
        "P_e": P_e,
        "P_loss_fault": P_loss,
        "P_total": 2.0 * (P_e + P_loss) / p.eta_sg,
    }

    ode_v, alg_v, y_v = X.stack(ode), ca.vertcat(*alg), _OUTPUTS.stack(y)
    z_expr = solve_linear(ca.jacobian(alg_v, zv), -ca.substitute(alg_v, zv, ca.SX.zeros(len(Z))))
    f_v, g_v = ca.substitute([ode_v, y_v], [zv], [z_expr])
    name = "_".join(["generator", load_kind, faulted or "healthy"])
    name += "" if grounded else "_isolated"
    return StateSpace.of(
        name,
        (X, Z, U, TH, _OUTPUTS),
        (xv, zv, uv, tv),
        dae=(ode_v, alg_v),
        f=f_v,
        g=g_v,
        z=z_expr,
        cse=True,
    )
