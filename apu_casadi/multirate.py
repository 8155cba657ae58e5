"""The multi-rate joint simulation (paper, section 3, eqs. 1-3).

Over each exchange step, 20 ms by default, the generators run with variable step at constant
speed; their mean mechanical power then loads the gas generator's discrete step, and its new speed
goes back through the gearbox.  Event instants are put on the exchange grid: the step before is
shortened, so that load, health and fault change exactly when they are meant to.

At an instant shared by two steps the values stored are those at the end of the earlier one.

The paper's exchange holds the speed that the machine sees, and the fuel, at their values at the
beginning of the step: half a step late on average, hence an error of first order in the step
(docs/MULTIRATE.md).  ``exchange="predicted"`` lets the machine's speed go on with its last slope,
and holds the fuel that the governor would give at mid-step; the error is then of second order at
about the same price, and no staircase of speed excites the voltage regulator.  ``"corrected"``
computes each step a second time with the slope that the first gave; it errs less, at twice the
machine's price.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.apu import Apu
from apu_casadi.control import governor
from apu_casadi.errors import ScenarioError, SignalError, SimulationError, nearest
from apu_casadi.events import (
    Ambient,
    Event,
    FaultChange,
    HealthChange,
    LoadChange,
    health_factors,
    in_order,
)
from apu_casadi.gasgenerator import GasGenerator
from apu_casadi.generator import MeasurementNoise
from apu_casadi.machine.load import SeriesLoad
from apu_casadi.results import dataset
from apu_casadi.signals import Signal, Signals
from apu_casadi.simulation import stepper
from apu_casadi.statespace import StateSpace

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.machine.load import Load
    from apu_casadi.machine.ttsc import Ttsc

WAVEFORMS = ("v_a", "v_b", "v_c", "i_a", "i_b", "i_c", "i_fault", "V_fd", "i_fd", "T_e", "P_total")
RMS = {"V_a_rms": "v_a^2", "V_b_rms": "v_b^2", "V_c_rms": "v_c^2",
        "I_a_rms": "i_a^2", "I_b_rms": "i_b^2", "I_c_rms": "i_c^2"}  # fmt: skip
MEANS = ("P_total", "P_e", "P_loss_fault")


class Exchange(NamedTuple):
    """How speed and fuel pass between the models over a step.

    Parameters
    ----------
    ramp : the machine's speed goes on with the step's predicted slope, instead of being held.
    mid_fuel : the fuel is that of the predicted mid-step, instead of that of the beginning.
    passes : times that each step is computed, the slope of the one before serving the next.
    """

    ramp: bool
    mid_fuel: bool
    passes: int = 1


EXCHANGES = {
    "paper": Exchange(False, False),
    "predicted": Exchange(True, True),
    "corrected": Exchange(True, True, passes=2),
    "predicted speed": Exchange(True, False),
    "predicted fuel": Exchange(False, True),
}
"""What ``simulate_joint(exchange=...)`` takes; the last two tell two parts of the error apart."""

_GRID_TOL = 1e-9  # s; instants closer than this are one


@dataclass(frozen=True)
class Noise:
    """Uncertainty added to a run; everything zero by default.

    Parameters
    ----------
    N : standard deviation of the state noise added to rotor speed at each exchange step, rad/s.
    w1, w2 : standard deviations, V, of the voltage noise in (5) and (6), drawn for each exchange
        step and held over it.
    gas : standard deviation of the measurement noise by output name, SI (``{"T3": 1.0}``);
        a measured copy ``T3_meas`` appears for each.
    terminal : measurement noise of (10) on phase currents, voltages and field voltage; adds
        ``v_a_meas`` and so on to the waveforms.
    """

    N: float = 0.0
    w1: float = 0.0
    w2: float = 0.0
    gas: Mapping[str, float] = field(default_factory=dict)
    terminal: MeasurementNoise | None = None

    def __post_init__(self) -> None:
        """Check that every standard deviation is a finite number >= 0 of a known signal."""
        for name in self.gas:
            if name not in GasGenerator.Y:
                raise SignalError(f"Noise.gas: unknown {name!r} {nearest(name, GasGenerator.Y.names)}")
        for name, s in {"N": self.N, "w1": self.w1, "w2": self.w2, **self.gas}.items():
            if not (math.isfinite(s) and s >= 0):
                raise SignalError(f"Noise.{name} must be a standard deviation >= 0, got {s!r}")


def exchange_grid(duration: float, dt: float, events: Sequence[Event]) -> np.ndarray:
    """Instants, s, of the exchange: multiples of dt, every event, and the end."""
    if not (math.isfinite(duration) and duration > 0):
        raise ScenarioError(f"duration must be > 0 s, got {duration!r}")
    if not (math.isfinite(dt) and 0 < dt <= 1.0):
        raise ScenarioError(f"exchange step dt must lie in (0, 1] s, got {dt!r}")
    regular = np.arange(0, math.floor(duration / dt + 1e-9) + 1) * dt
    t = np.unique(np.concatenate([regular, [e.t for e in events], [duration]]))
    keep = np.concatenate([[True], np.diff(t) > _GRID_TOL])
    grid = t[keep]
    grid[-1] = duration
    return np.asarray(grid)


@lru_cache(maxsize=64)
def ramped(ss: StateSpace) -> StateSpace:
    """Return a generator variant whose speed w_r is a state and its slope w_r_dot the input."""
    X = Signals([*ss.x, dataclasses.replace(ss.u["w_r"], name="w_r", default=None)])
    slope = Signal("w_r_dot", "rad/s^2", "slope of the electrical speed", nominal=1e3)
    U = Signals([slope if s.name == "w_r" else s for s in ss.u])
    at = ss.u.index("w_r")
    x, z, u, theta = (
        ca.SX.sym(label, len(s))
        for label, s in (("x", X), ("z", ss.z), ("u", U), ("theta", ss.theta))
    )
    x_sg, rate = x[: len(ss.x)], u[at]
    u_sg = ca.vertcat(u[:at], x[len(ss.x)], u[at + 1 :])
    ode, alg = ss.residual(x_sg, z, u_sg, theta)
    name, args = f"{ss.name}_ramped", [x, u, theta]
    return StateSpace(
        name=name, x=X, z=ss.z, u=U, theta=ss.theta, y=ss.y,
        residual=ca.Function(f"{name}_residual", [x, z, u, theta], [ca.vertcat(ode, rate), alg]),
        f=ca.Function(f"{name}_f", args, [ca.vertcat(ss.f(x_sg, u_sg, theta), rate)]),
        g=ca.Function(f"{name}_g", args, [ss.g(x_sg, u_sg, theta)]),
        z_of=ca.Function(f"{name}_z", args, [ss.z_of(x_sg, u_sg, theta)]),
    )  # fmt: skip


def simulate_joint(
    apu: Apu,
    *,
    duration: float,
    load: Load,
    ambient: Ambient | None = None,
    health: Mapping[str, float] | None = None,
    fault: Ttsc | None = None,
    events: Sequence[Event] = (),
    dt: float = 0.02,
    exchange: str = "paper",
    waveform_dt: float | None = 50e-6,
    noise: Noise | None = None,
    seed: int | None = None,
    hook: Callable[[int, np.ndarray], np.ndarray] | None = None,
    solver: str = "cvodes",
    rtol: float = 1e-8,
    atol: float = 1e-10,
    progress: Callable[[float, float], None] | None = None,
    attrs: Mapping[str, Any] | None = None,
) -> xr.Dataset:
    """Simulate gas generator, two generators and governor together.

    The run starts in steady state, so nothing moves before the first event.  A fault or an
    unbalanced load given for the start acts from t = 0 on the steady healthy, balanced unit.

    Parameters
    ----------
    apu : the unit.
    duration : s.
    load : of each generator, from t = 0.
    ambient : altitude, Mach, ISA deviation, humidity; the paper's ISA + 5 K by default.
    health : factors by name that hold from the start (trimmed with them).
    fault : stator fault from the start, None: healthy.
    events : :class:`LoadChange`, :class:`HealthChange`, :class:`FaultChange`.
    dt : exchange step, s.
    exchange : ``"paper"``: eqs. (1)-(2) as printed, speed and fuel from the beginning of the step;
        ``"predicted"``: the speed as a ramp with the slope of the last step, the fuel of mid-step,
        second order.  The step after an event is then computed twice, since no slope is known
        there.  ``"corrected"``: every step twice.  (``"predicted speed"`` and ``"predicted fuel"``
        do half of it, to tell the two errors apart.)  Energy is handed over exactly in each.
    waveform_dt : sampling of the stored waveforms, s; None stores none.
    noise, seed : uncertainty and the seed of its random numbers.
    hook : processes the rotor speed between state update and output (Algorithm 2).
    solver, rtol, atol : integrator of the generators and its tolerances.
    progress : called with (done, total) seconds after every exchange step.
    attrs : more attributes for the dataset.

    Returns
    -------
    xarray.Dataset on ``time`` (exchange grid) and ``time_w`` (waveforms); see
    :mod:`apu_casadi.results`.

    Raises
    ------
    ScenarioError : impossible times or events.
    OperatingPointError : no steady start.
    SimulationError : an integration or a cycle solution failed; says when and why.
    """
    if exchange not in EXCHANGES:
        raise ScenarioError(f"exchange {exchange!r} {nearest(exchange, EXCHANGES)}")
    way = EXCHANGES[exchange]
    gg, gen = apu.gas_generator, apu.generator
    ambient = Ambient() if ambient is None else ambient
    noise = Noise() if noise is None else noise
    rng = np.random.default_rng(seed)
    events = in_order(events, duration)
    if waveform_dt is not None and not 1e-7 <= waveform_dt <= dt:
        raise ScenarioError(
            f"waveform_dt = {waveform_dt!r} s must lie between 1e-7 s and the exchange step {dt:g} s"
        )
    grid = exchange_grid(duration, dt, events)
    factors = {**dict.fromkeys(gg.THETA.names, 1.0), **health_factors(health or {})}

    # steady start
    start_load = _balanced_part(load)
    point = apu.steady_state(start_load, ambient=ambient, health=factors)
    V_ref = point.generator.V_ref
    w_r = apu.w_r(apu.N_ref)
    ss, x_sg = point.generator.ss, point.generator.x
    u_sg = gen.inputs(start_load, w_r=w_r, V_ref=V_ref)
    th_sg = gen.fault_vector(start_load, None)
    x, z, u, theta = point.gas.x, point.gas.z, point.gas.u.copy(), point.gas.theta
    y, z = gg.output(x, u, theta, z0=z)
    Wf_I = float(point.gas["Wf"])

    K = grid.size - 1
    Y = np.empty((len(gg.Y), K + 1))
    Y[:, 0] = y
    slow = {k: np.empty(K + 1) for k in (*MEANS, *RMS, "mu", "k_rf", "kappa", *gg.THETA.names)}
    waves: dict[str, list[np.ndarray]] = {k: [] for k in WAVEFORMS}
    t_waves: list[np.ndarray] = []
    pending = list(events)
    now_load, now_fault = start_load, None
    steps_sg = 0

    def switch(new_load: Load, new_fault: Ttsc | None) -> None:
        nonlocal ss, x_sg, u_sg, th_sg, now_load, now_fault
        target = gen.variant(new_load, new_fault)
        u_new = gen.inputs(new_load, w_r=w_r, V_ref=V_ref)
        x_sg = gen.transfer(x_sg, ss, target, u=u_sg, theta=th_sg, u_target=u_new)
        ss, u_sg, th_sg = target, u_new, gen.fault_vector(new_load, new_fault)
        now_load, now_fault = new_load, new_fault

    def record(k: int, means: Mapping[str, float]) -> None:
        for name in MEANS:
            slow[name][k] = means[name]
        for name, square in RMS.items():
            slow[name][k] = math.sqrt(means[square])
        for name in gg.THETA.names:
            slow[name][k] = factors[name]
        f = now_fault
        slow["mu"][k] = 0.0 if f is None else f.mu
        slow["k_rf"][k] = math.nan if f is None else f.k_rf
        slow["kappa"][k] = math.nan if f is None else f.kappa

    y0 = point.generator.y
    V, I = y0["V_t"], math.hypot(*(y0[f"i_{p}"] for p in "abc")) / math.sqrt(3.0)
    record(0, {**{n: y0[n] for n in MEANS}, **dict.fromkeys(("v_a^2", "v_b^2", "v_c^2"), V**2),
               **dict.fromkeys(("i_a^2", "i_b^2", "i_c^2"), I**2)})  # fmt: skip
    if waveform_dt is not None:
        t_waves.append(np.zeros(1))
        for name in WAVEFORMS:
            waves[name].append(np.array([y0[name]]))
    slope: float | None = 0.0  # of the speed over the last step, rad/s2; None: not known
    if load != start_load or fault is not None:
        switch(load, fault)
        slope = None

    for k in range(1, K + 1):
        t0, h = float(grid[k - 1]), float(grid[k] - grid[k - 1])
        while pending and pending[0].t <= t0 + _GRID_TOL:
            event, slope = pending.pop(0), None
            if isinstance(event, HealthChange):
                factors.update(event.factors)
                theta = gg.THETA.pack(factors)
            elif isinstance(event, LoadChange):
                switch(event.load, now_fault)
            elif isinstance(event, FaultChange):
                switch(now_load, event.fault)
        more = {}
        if noise.w1 or noise.w2:
            w1, w2 = noise.w1 * rng.standard_normal(3), noise.w2 * rng.standard_normal(3)
            more = dict(zip(("w1_q", "w1_d", "w1_0", "w2_fd", "w2_kd", "w2_kq"),
                            [*w1, *w2], strict=True))  # fmt: skip
        n_out = 1 if waveform_dt is None else max(1, round(h / waveform_dt))
        model, at_w_r = (ramped(ss) if way.ramp else ss), np.array(ss.u.names) == "w_r"
        quad = (*MEANS, *RMS.values())
        step = stepper(model, n_out, quad=quad, solver=solver, rtol=rtol, atol=atol)
        N, u = float(x[0]), u.copy()
        w_r = apu.w_r(N)
        passes = 2 if slope is None and way != EXCHANGES["paper"] else way.passes
        slope = slope or 0.0
        for _ in range(passes):
            N_mid = N + h / 2 * slope
            # generators over [t0, t0 + h]: at constant speed (eq. 2), or along the predicted ramp
            u_sg = gen.inputs(now_load, w_r=w_r, V_ref=V_ref, **more)
            if way.ramp:
                ramp = np.where(at_w_r, apu.w_r(slope), u_sg)
                r = step(np.append(x_sg, w_r), ramp, th_sg, h, t0=t0)
            else:
                r = step(x_sg, u_sg, th_sg, h, t0=t0)
            steps_sg += int(r.stats.get("nsteps", 0))
            # fuel held over the step, shaft power by eq. (1), then the gas generator's step
            fuel = governor(N=N, N_ref=apu.N_ref, Wf_I=Wf_I, par=apu.governor)
            if way.mid_fuel:
                Wf_I_mid = Wf_I + h / 2 * float(fuel.Wf_I_dot)
                fuel = governor(N=N_mid, N_ref=apu.N_ref, Wf_I=Wf_I_mid, par=apu.governor)
            u[0], u[1] = float(fuel.Wf), apu.PW(r.mean["P_total"])
            try:
                x_new, z_new = gg.state_update(x, u, theta, z0=z, dt=h)
            except SimulationError as error:
                raise SimulationError(f"at t = {grid[k]:.6g} s: {error}") from None
            slope = (float(x_new[0]) - N) / h
        x_sg = r.x_end[: len(ss.x)].copy()
        j = ss.x.index("theta_e")
        x_sg[j] = math.remainder(x_sg[j], 2 * math.pi)
        Wf_I = Wf_I + h * float(fuel.Wf_I_dot)
        x, z = x_new, z_new
        try:
            if noise.N:
                x = x + noise.N * rng.standard_normal(1)
            if hook is not None:
                x = np.asarray(hook(k, x), float).reshape(1)
            y, z = gg.output(x, u, theta, z0=z)
        except SimulationError as error:
            raise SimulationError(f"at t = {grid[k]:.6g} s: {error}") from None
        Y[:, k] = y
        record(k, r.mean)
        if waveform_dt is not None:
            t_waves.append(r.t)
            for name in WAVEFORMS:
                waves[name].append(r.y[ss.y.index(name)].copy())
        if progress is not None:
            progress(float(grid[k]), duration)

    return _collect(apu, grid, Y, slow, t_waves, waves, noise, rng, attrs, {
        "solver": solver, "rtol": rtol, "atol": atol, "dt": dt, "nsteps_generator": steps_sg,
        "residual_max": float(Y[gg.Y.index("residual")].max()), "seed": seed, "V_ref": V_ref,
    })  # fmt: skip


def _balanced_part(load: Load) -> Load:
    """Return the load itself when balanced, else the balanced load of equal mean admittance."""
    if not isinstance(load, SeriesLoad) or load.balanced:
        return load
    w = 2 * math.pi * 400.0
    Y = sum(1 / complex(R, w * L) for R, L in zip(load.R, load.L, strict=True)) / 3
    Z = 1 / Y
    return SeriesLoad(R=(Z.real,) * 3, L=(max(Z.imag, 0.0) / w,) * 3)


def _collect(
    apu: Apu,
    grid: np.ndarray,
    Y: np.ndarray,
    slow: Mapping[str, np.ndarray],
    t_waves: list[np.ndarray],
    waves: Mapping[str, list[np.ndarray]],
    noise: Noise,
    rng: np.random.Generator,
    attrs: Mapping[str, Any] | None,
    status: Mapping[str, Any],
) -> xr.Dataset:
    """Put the run into a labelled dataset."""
    gg = apu.gas_generator
    gas = dict(zip(gg.Y.names, Y, strict=True))
    measured = {f"{n}_meas": gas[n] + s * rng.standard_normal(grid.size) for n, s in noise.gas.items()}
    signals = list(gg.Y)
    signals += [
        dataclasses.replace(gg.Y[n], name=f"{n}_meas", doc=f"measured: {gg.Y[n].doc}")
        for n in noise.gas
    ]
    times = {"time": grid}
    values: dict[str, dict[str, Any]] = {"time": {**gas, **slow, **measured}}
    if t_waves:
        times["time_w"] = np.concatenate(t_waves)
        w = {n: np.concatenate(v) for n, v in waves.items()}
        w["P_inst"] = w.pop("P_total")
        if noise.terminal is not None:
            y_sg = apu.generator.state_space().y
            for n, a in noise.terminal.measure(w, rng).items():
                w[f"{n}_meas"] = a
                signals.append(
                    dataclasses.replace(y_sg[n], name=f"{n}_meas", doc=f"measured: {y_sg[n].doc}")
                )
        values["time_w"] = w
    try:
        installed = version("apu-casadi")
    except PackageNotFoundError:  # running from a plain checkout
        installed = "unknown"
    return dataset(
        times,
        values,
        signals=signals,
        attrs={
            "parameters": json.dumps(apu.parameters()),
            "solver": json.dumps(dict(status)),
            "apu_casadi_version": installed,
            **(attrs or {}),
        },
    )
