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
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.apu import Apu
from apu_casadi.control import governor
from apu_casadi.errors import ApuWarning, ScenarioError, SignalError, SimulationError, nearest
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
from apu_casadi.jointstep import BLOCK, BlockResult
from apu_casadi.machine.load import SeriesLoad
from apu_casadi.machinestep import (
    EXCHANGES,
    GRID_TOL,
    MEANS,
    WAVEFORMS,
    MachineStep,
    ramped,
)
from apu_casadi.means import PARTS, PHASORS, RMS
from apu_casadi.results import dataset
from apu_casadi.signals import Signal

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.machine.load import Load
    from apu_casadi.machine.ttsc import Ttsc

__all__ = [
    "EXCHANGES",
    "MEANS",
    "RMS",
    "SOLVERS",
    "WAVEFORMS",
    "Noise",
    "exchange_grid",
    "ramped",
    "simulate_joint",
]

SOLVERS = ("cvodes", "idas", "propagator")
_HEALTHY = (0.0, math.nan, math.nan)


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
                raise SignalError(
                    f"Noise.gas: unknown {name!r} {nearest(name, GasGenerator.Y.names)}"
                )
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
    keep = np.concatenate([[True], np.diff(t) > GRID_TOL])
    grid = t[keep]
    grid[-1] = duration
    return np.asarray(grid)


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
    phasors: bool = False,
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
    phasors : whether to store, for each exchange step, the fundamental phasors of the phase
        voltages and currents: ``V_a_re``, ``V_a_im``, ..., rms values with the rotor angle as
        reference, v_a = sqrt(2) Re(V_a exp(j theta_e)); least squares over the step.
    noise, seed : uncertainty and the seed of its random numbers.
    hook : processes the rotor speed between state update and output (Algorithm 2).
    solver, rtol, atol : integrator of the generators and its tolerances: ``"cvodes"``, ``"idas"``,
        or ``"propagator"``, exact propagation where the load is linear (a hundred times faster
        than real time with a C compiler; CVODES takes over by itself where it does not hold).
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
    if solver not in SOLVERS:
        raise ScenarioError(f"solver {solver!r} {nearest(solver, SOLVERS)}")
    ambient = Ambient() if ambient is None else ambient
    noise = Noise() if noise is None else noise
    rng = np.random.default_rng(seed)
    events = in_order(events, duration)
    if waveform_dt is not None and not 1e-7 <= waveform_dt <= dt:
        raise ScenarioError(
            f"waveform_dt = {waveform_dt!r} s must lie between 1e-7 s and the step, {dt:g} s"
        )
    grid = exchange_grid(duration, dt, events)
    factors = {**dict.fromkeys(GasGenerator.THETA.names, 1.0), **health_factors(health or {})}

    start_load = _balanced_part(load)
    point = apu.steady_state(start_load, ambient=ambient, health=factors)
    machine = MachineStep(
        apu, point.generator, start_load, way, dt, waveform_dt, solver, rtol, atol, phasors
    )  # fmt: skip
    gg, theta = apu.gas_generator, point.gas.theta
    x, u = point.gas.x, point.gas.u.copy()
    y, z = gg.output(x, u, theta, z0=point.gas.z)
    Wf_I, N_ref = float(point.gas["Wf"]), apu.N_ref
    hot = gg.stepper if solver == "propagator" else None
    book = _Book(gg, grid, machine.samples(grid), len(machine.kept))
    book.put(0, y, machine.means_at_rest(point.generator), factors, None)
    book.wave(np.zeros(1), np.array([[point.generator.y[n]] for n in WAVEFORMS]))
    pending = list(events)
    slope: float | None = 0.0  # of the speed over the last step, rad/s2; None: not known

    free = hook is None and not (noise.N or noise.w1 or noise.w2)
    k = 0
    while k < grid.size - 1:
        k += 1
        t0, h = float(grid[k - 1]), float(grid[k] - grid[k - 1])
        while pending and pending[0].t <= t0 + GRID_TOL:
            event, slope = pending.pop(0), None
            if isinstance(event, HealthChange):
                factors.update(event.factors)
                theta = gg.THETA.pack(factors)
            elif isinstance(event, LoadChange):
                load = event.load
            elif isinstance(event, FaultChange):
                fault = event.fault
        # all that comes at one instant is one switch, whatever its order
        if load != machine.load or fault != machine.fault:
            machine.switch(load, fault, t0)
            slope = None
        until = pending[0].t if pending else duration
        if free and grid[min(k - 1 + BLOCK, grid.size - 1)] <= until + GRID_TOL:
            done = machine.block(x, z, Wf_I, u, theta, grid[k - 1 : k + BLOCK])
            if done is not None:
                x, z, Wf_I = done.N, done.z, done.Wf_I
                book.put_block(k, done, factors, machine.fault)
                book.wave(machine.block_times(grid[k - 1 : k + BLOCK]), done.waves)
                k += BLOCK - 1
                slope = None if way != EXCHANGES["paper"] else 0.0
                if progress is not None:
                    progress(float(grid[k]), duration)
                continue
        if noise.w1 or noise.w2:
            machine.disturb(noise.w1 * rng.standard_normal(3), noise.w2 * rng.standard_normal(3))
        N = float(x[0])
        passes = 2 if slope is None and way != EXCHANGES["paper"] else way.passes
        slope = slope or 0.0
        try:
            for _ in range(passes):
                # generators over [t0, t0 + h]: at constant speed (eq. 2), or along the ramp
                x_sg, means, t, w = machine.step(N, slope, h, t0)
                # fuel held over the step, shaft power by eq. (1), then the gas generator's step
                fuel = governor(N=N, N_ref=N_ref, Wf_I=Wf_I, par=apu.governor)
                if way.mid_fuel:
                    N_mid, Wf_I_mid = N + h / 2 * slope, Wf_I + h / 2 * fuel.Wf_I_dot
                    fuel = governor(N=N_mid, N_ref=N_ref, Wf_I=Wf_I_mid, par=apu.governor)
                u[0], u[1] = fuel.Wf, apu.PW(means[0])
                x_new, y, z_new = gg.advance(x, u, theta, z, h, step=hot)
                slope = (float(x_new[0]) - N) / h
            machine.x = x_sg
            Wf_I, x, z = Wf_I + h * fuel.Wf_I_dot, x_new, z_new
            if noise.N or hook is not None:
                x = x + noise.N * rng.standard_normal(1)
                if hook is not None:
                    x = np.asarray(hook(k, x), float).reshape(1)
                y, z = gg.output(x, u, theta, z0=z)
        except SimulationError as error:
            raise SimulationError(f"at t = {grid[k]:.6g} s: {error}") from None
        book.put(k, y, means, factors, machine.fault)
        book.wave(t, w)
        if progress is not None:
            progress(float(grid[k]), duration)

    status = {
        "solver": solver, "rtol": rtol, "atol": atol, "dt": dt, "exchange": exchange,
        "nsteps_generator": machine.nsteps, "steps_propagated": machine.propagated,
        "residual_max": float(book.Y[gg.Y.index("residual")].max()), "seed": seed,
        "V_ref": machine.V_ref,
    }  # fmt: skip
    told = machine.warnings
    for text in told:
        warnings.warn(text, ApuWarning, stacklevel=2)
    return _collect(apu, book, noise, rng, {"warnings": json.dumps(told), **(attrs or {})}, status)


class _Book:
    """What a run keeps: outputs per exchange, means, health, severity, waveforms."""

    def __init__(self, gg: GasGenerator, grid: np.ndarray, samples: int, means: int) -> None:
        self.gg, self.grid = gg, grid
        K = grid.size
        self.Y = np.empty((len(gg.Y), K))
        self.means = np.empty((means, K))
        self.factors = np.empty((len(gg.THETA), K))
        self.severity = np.empty((3, K))
        self.t_w = np.empty(samples)
        self.waves = np.empty((len(WAVEFORMS), samples))
        self._n = 0

    def put(
        self,
        k: int,
        y: np.ndarray,
        means: np.ndarray,
        factors: Mapping[str, float],
        fault: Ttsc | None,
    ) -> None:
        """Enter exchange instant k."""
        self.Y[:, k] = y
        self.means[:, k] = means
        self.factors[:, k] = tuple(factors.values())
        self.severity[:, k] = _severity(fault)

    def put_block(
        self, k: int, done: BlockResult, factors: Mapping[str, float], fault: Ttsc | None
    ) -> None:
        """Enter a block of exchange instants, the first of which is k."""
        at = slice(k, k + BLOCK)
        self.Y[:, at] = done.y
        self.means[:, at] = done.means
        self.factors[:, at] = np.array(tuple(factors.values()))[:, None]
        self.severity[:, at] = np.array(_severity(fault))[:, None]

    def wave(self, t: np.ndarray, w: np.ndarray) -> None:
        """Append waveform samples, where any are kept."""
        if self.t_w.size:
            n = t.size
            self.t_w[self._n : self._n + n] = t
            self.waves[:, self._n : self._n + n] = w
            self._n += n

    def slow(self) -> dict[str, np.ndarray]:
        """Means, rms values, phasors, health and severity by name."""
        d = dict(zip(MEANS, self.means, strict=False))
        n = len(MEANS) + len(RMS)
        d |= dict(zip(RMS, self.means[len(MEANS) : n], strict=True))
        if self.means.shape[0] > n:
            d |= dict(zip(PARTS, self.means[n:], strict=True))
        d |= dict(zip(self.gg.THETA.names, self.factors, strict=True))
        return d | dict(zip(("mu", "k_rf", "kappa"), self.severity, strict=True))


def _severity(fault: Ttsc | None) -> tuple[float, float, float]:
    if fault is None:
        return _HEALTHY
    return fault.mu, fault.k_rf, math.nan if fault.kappa is None else fault.kappa


def _phasor_signals() -> list[Signal]:
    kinds = {"V": ("V", "voltage"), "I": ("A", "current")}
    parts = {"re": "along the rotor angle's cosine", "im": "ahead of it by a quarter turn"}
    return [
        Signal(f"{name}_{part}", unit, f"phase {name[2]} {what}, fundamental, rms, {where}")
        for name in PHASORS
        for unit, what in (kinds[name[0]],)
        for part, where in parts.items()
    ]


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
    book: _Book,
    noise: Noise,
    rng: np.random.Generator,
    attrs: Mapping[str, Any] | None,
    status: Mapping[str, Any],
) -> xr.Dataset:
    """Put the run into a labelled dataset."""
    gg, grid = apu.gas_generator, book.grid
    gas = dict(zip(gg.Y.names, book.Y, strict=True))
    measured = {
        f"{n}_meas": gas[n] + s * rng.standard_normal(grid.size) for n, s in noise.gas.items()
    }
    signals = [*gg.Y, *_phasor_signals()]
    signals += [
        dataclasses.replace(gg.Y[n], name=f"{n}_meas", doc=f"measured: {gg.Y[n].doc}")
        for n in noise.gas
    ]
    times = {"time": grid}
    values: dict[str, dict[str, Any]] = {"time": {**gas, **book.slow(), **measured}}
    if book.t_w.size:
        times["time_w"] = book.t_w
        w = dict(zip(WAVEFORMS, book.waves, strict=True))
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
