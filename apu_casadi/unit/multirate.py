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

import copy
import dataclasses
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.checked import number
from apu_casadi.core.errors import (
    ApuWarning,
    ScenarioError,
    SignalError,
    SimulationError,
    ValidityWarning,
    nearest,
)
from apu_casadi.core.filearrays import RowFile
from apu_casadi.core.means import PARTS, PHASORS, RMS
from apu_casadi.core.measuring import measure
from apu_casadi.core.results import dataset
from apu_casadi.core.runstorage import PIECE, place, row_file
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.measurement import MeasurementNoise
from apu_casadi.unit import runrecord, validity
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.control import governor
from apu_casadi.unit.events import (
    Ambient,
    Event,
    FaultChange,
    HealthChange,
    LoadChange,
    health_factors,
    in_order,
)
from apu_casadi.unit.jointstep import BLOCK
from apu_casadi.unit.machinestep import (
    EXCHANGES,
    GRID_TOL,
    MEANS,
    WAVEFORMS,
    MachineStep,
    RawMeans,
    ramped,
)

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load

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
_STORED = Signals(Ttsc.severities)  # severities that every run stores
_TOGETHER = 512  # entries of means whose rms values are made at once
_WAVE_ROWS = ("time_w", *(f"{n} waveform" for n in WAVEFORMS))  # P_total is a mean as well


@dataclass(frozen=True)
class Noise:
    """Uncertainty added to a run; everything zero by default.

    Args:
        N: standard deviation of the state noise added to rotor speed at each exchange step, rad/s.
        w1, w2: standard deviations, V, of the voltage noise in (5) and (6), drawn for each exchange
            step and held over it.
        gas: standard deviation of the measurement noise by output name, SI (``{"T3": 1.0}``); a
            measured copy ``T3_meas`` appears for each.
        terminal: measurement noise of (10) on phase currents, voltages and field voltage; adds
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
            if not 0 <= number(f"Noise.{name}", s) < math.inf:
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
    fault: Fault | None = None,
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
    storage: str | os.PathLike[str] = "auto",
    warn_exchange: bool = True,
) -> xr.Dataset:
    """Simulate gas generator, two generators and governor together.

    The run starts in steady state, so nothing moves before the first event.  A fault or an
    unbalanced load given for the start acts from t = 0 on the steady healthy, balanced unit.

    Args:
        apu: the unit.
        duration: s.
        load: of each generator, from t = 0.
        ambient: altitude, Mach, ISA deviation, humidity; the default day where nothing is given
            (:mod:`apu_casadi.gaspath.conditions`).
        health: factors by name that hold from the start (trimmed with them).
        fault: stator fault from the start, None: healthy.
        events: :class:`LoadChange`, :class:`HealthChange`, :class:`FaultChange`.
        dt: exchange step, s.
        exchange: ``"paper"``: eqs. (1)-(2) as printed, speed and fuel from the beginning of the
            step; ``"predicted"``: the speed as a ramp with the slope of the last step, the fuel of
            mid-step, second order.  The step after an event is then computed twice, since no slope
            is known there.  ``"corrected"``: every step twice.  (``"predicted speed"`` and
            ``"predicted fuel"`` do half of it, to tell the two errors apart.)  Energy is handed
            over exactly in each.
        waveform_dt: sampling of the stored waveforms, s; None stores none.
        phasors: whether to store, for each exchange step, the fundamental phasors of the phase
            voltages and currents: ``V_a_re``, ``V_a_im``, ..., rms values with the rotor angle as
            reference, v_a = sqrt(2) Re(V_a exp(j theta_e)); least squares over the step.
        noise, seed: uncertainty and the seed of its random numbers.
        hook: processes the rotor speed between state update and output (Algorithm 2).
        solver, rtol, atol: integrator of the generators and its tolerances: ``"cvodes"``,
            ``"idas"``, or ``"propagator"``, exact propagation where the load is linear (a hundred
            times faster than real time with a C compiler; CVODES takes over by itself where it does
            not hold).
        progress: called with (done, total) seconds after every exchange step.
        attrs: more attributes for the dataset.
        storage: where the results are: ``"memory"``; a folder, for a temporary file in it that
            vanishes with the dataset, whose values are then read when they are asked for, each time
            anew; ``"auto"``: in memory up to :data:`~apu_casadi.core.runstorage.IN_MEMORY` bytes,
            beyond that in a file of the system's folder of temporary files where there is room.
        warn_exchange: whether an estimated exchange error beyond 1 % of the speed's excursion is
            warned of; the paper's exchange with steps up to its own 20 ms is not, see
            :mod:`apu_casadi.unit.validity`.

    Returns:
        xarray.Dataset on ``time`` (exchange grid) and ``time_w`` (waveforms); see
        :mod:`apu_casadi.core.results`.  Attributes tell what was asked
        (:mod:`apu_casadi.unit.runrecord`), the estimated ``exchange_error`` (NaN with state noise
        or a hook), where the run left the limits of the trim (``validity``), and all ``warnings``.

    Warns:
        ValidityWarning: the run left the limits of the trim, or ended with too little fuel.
        ExchangeWarning: the estimated exchange error is beyond 1 % of the speed's excursion.

    Raises:
        ScenarioError: impossible times or events.
        DataError: ``storage`` is a folder without room for the file.
        OperatingPointError: no steady start.
        SimulationError: an integration or a cycle solution failed; says when and why.
    """
    if exchange not in EXCHANGES:
        raise ScenarioError(f"exchange {exchange!r} {nearest(exchange, EXCHANGES)}")
    way = EXCHANGES[exchange]
    duration, dt, rtol, atol = (
        number(n, v, error=ScenarioError)
        for n, v in (("duration", duration), ("dt", dt), ("rtol", rtol), ("atol", atol))
    )
    if waveform_dt is not None:
        waveform_dt = number("waveform_dt", waveform_dt, error=ScenarioError)
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

    start_load = load.balanced_part
    point = apu.steady_state(start_load, ambient=ambient, health=factors)
    machine = MachineStep(
        apu, point.generator, start_load, way, dt, waveform_dt, solver, rtol, atol, phasors
    )  # fmt: skip
    gg, theta = apu.gas_generator, point.gas.theta
    x, u = point.gas.x, point.gas.u.copy()
    y, z = gg.output(x, u, theta, z0=point.gas.z)
    Wf_I, N_ref = float(point.gas["Wf"]), apu.N_ref
    hot = gg.stepper if solver == "propagator" else None
    severities = _severities(events, fault)
    book = _Book(
        gg, grid, machine.samples(grid), len(machine.kept), storage, machine.settle, severities
    )
    book.put(0, y, machine.means_at_rest(point.generator), factors, None)
    book.wave(np.zeros(1), np.array([[point.generator.y[n]] for n in WAVEFORMS]))
    pending = list(events)
    slope: float | None = 0.0  # of the speed over the last step, rad/s2; None: not known
    load_now, fault_now = load, fault

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
                load_now = event.load
            elif isinstance(event, FaultChange):
                fault_now = event.fault
        # all that comes at one instant is one switch, whatever its order
        if load_now != machine.load or fault_now != machine.fault:
            machine.switch(load_now, fault_now, t0)
            slope = None
        until = pending[0].t if pending else duration
        if free and grid[min(k - 1 + BLOCK, grid.size - 1)] <= until + GRID_TOL:
            made = machine.block(x, z, Wf_I, u, theta, grid[k - 1 : k + BLOCK])
            if made is not None:
                done, raw = made
                x, z, Wf_I = done.N, done.z, done.Wf_I
                book.put_block(k, done.y, raw, factors, machine.fault)
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
                u[0], u[1] = fuel.Wf, apu.PW(means.values[0, 0])
                x_new, y, z_new = gg.advance(x, u, theta, z, h, step=hot)
                slope = (float(x_new[0]) - N) / h
            machine.x = x_sg
            Wf_I, x, z = Wf_I + h * fuel.Wf_I_dot, x_new, z_new
            if noise.N or hook is not None:
                x = x + noise.N * rng.standard_normal(1)
                if hook is not None:
                    w = w.copy()  # a hook may simulate the same unit: views of buffers would change
                    x = np.asarray(hook(k, x), float).reshape(1)
                y, z = gg.output(x, u, theta, z0=z)
        except SimulationError as error:
            seen = book.last()
            asked = float(u[1]) if math.isfinite(u[1]) else float(seen[gg.Y.index("PW")])
            words = validity.overload(
                apu, N=N, Wf=float(u[0]), PW=asked, ambient=dataclasses.asdict(ambient),
                health=factors,
            ) or f"{error}; {validity.before(gg, grid[k - 1], seen)}"  # fmt: skip
            raise SimulationError(f"at t = {grid[k]:.6g} s: {words}") from None
        book.put(k, y, means, factors, machine.fault)
        book.wave(t, w)
        if progress is not None:
            progress(float(grid[k]), duration)

    run = book.instants()
    N_run, Wf_run, P_e = (np.asarray(run[n]) for n in ("N", "Wf", "P_e"))
    lost = math.nan
    if hook is None and not noise.N:  # state noise is drawn for each step: no other exchange has it
        lost = validity.exchange_error(apu, point.gas, grid, N_run, Wf_run).error
    status = {
        "solver": solver, "rtol": rtol, "atol": atol, "dt": dt, "exchange": exchange,
        "nsteps_generator": machine.nsteps, "steps_propagated": machine.propagated,
        "residual_max": book.residual_max(), "seed": seed,
        "V_ref": machine.V_ref,
    }  # fmt: skip
    told = runrecord.asked(load=load, fault=fault, ambient=ambient, events=events, seed=seed)
    told |= {"exchange_error": lost, **(attrs or {})}
    ds = _collect(apu, book, run, noise, rng, told, status)
    notes = [ApuWarning(words) for words in machine.warnings]
    notes += validity.notes_of_exchange(lost, exchange, dt) if warn_exchange else []
    starved = validity.fuel_limited(apu, grid, N_run, Wf_run)
    unserved = validity.unserved(load, events, grid, P_e)
    notes += [ValidityWarning(words) for words in (starved, unserved) if words]
    return validity.conclude(ds, validity.departures(gg, grid, run), notes)


class _Book:
    """What a run keeps: outputs per exchange, means, health, severity, waveforms.

    The arrays hold the whole run, or the piece of it that has not gone to ``file`` yet.
    """

    def __init__(
        self,
        gg: GasGenerator,
        grid: np.ndarray,
        samples: int,
        means: int,
        storage: str | os.PathLike[str] = "memory",
        settle: Callable[[Sequence[RawMeans]], np.ndarray] | None = None,
        severities: Signals = _STORED,
    ) -> None:
        self._settle, self._raw, self._raw_at = settle, list[RawMeans](), 0
        self.gg, self.grid, self.severities = gg, grid, severities
        n_slow = len(gg.Y) + means + len(gg.THETA) + len(severities)
        size = 8 * (n_slow * grid.size + (1 + len(WAVEFORMS)) * samples)
        self._first = self._end = 0  # instants in the arrays
        self._first_w = self._n = 0  # samples before those in the arrays, and in them
        self._residual = 0.0
        self.file: RowFile | None = None
        where = place(size, storage)
        self._allocate(means, *((grid.size, samples) if where is None else (1, 1)))
        if where is None:
            return
        with np.errstate(all="ignore"):  # of the names alone
            self._names = [*gg.Y.names, *self.slow()]
        rows = dict.fromkeys(self._names, grid.size)
        waves = dict.fromkeys(_WAVE_ROWS if samples else (), samples)
        self.file = row_file({**rows, **waves}, where, needed=storage != "auto")
        piece = PIECE if self.file is not None else size
        self._allocate(means, min(grid.size, piece), min(samples, piece))

    def _allocate(self, means: int, steps: int, samples: int) -> None:
        self.Y = np.zeros((len(self.gg.Y), steps))
        self.means = np.zeros((means, steps))
        self.factors = np.empty((len(self.gg.THETA), steps))
        self.severity = np.empty((len(self.severities), steps))
        self.t_w = np.empty(samples)
        self.waves = np.empty((len(WAVEFORMS), samples))

    def put(
        self,
        k: int,
        y: np.ndarray,
        means: np.ndarray | RawMeans,
        factors: Mapping[str, float],
        fault: Fault | None,
    ) -> None:
        """Enter exchange instant k."""
        at = self._columns(k, 1).start
        self.Y[:, at] = y
        if isinstance(means, RawMeans):
            self._later(at, means)
        else:
            self.means[:, at] = means
        self.factors[:, at] = tuple(factors.values())
        self.severity[:, at] = _now(self.severities, fault)

    def put_block(
        self,
        k: int,
        y: np.ndarray,
        means: RawMeans,
        factors: Mapping[str, float],
        fault: Fault | None,
    ) -> None:
        """Enter a block of exchange instants, the first of which is k."""
        at = self._columns(k, BLOCK)
        self.Y[:, at] = y
        self._later(at.start, means)
        self.factors[:, at] = np.array(tuple(factors.values()))[:, None]
        self.severity[:, at] = np.array(_now(self.severities, fault))[:, None]

    def _later(self, at: int, means: RawMeans) -> None:
        """Take means whose rms values are made together with those of their neighbours."""
        if self._raw and (len(self._raw) >= _TOGETHER or self._raw[0][:2] != means[:2]):
            self._settle_means()
        if not self._raw:
            self._raw_at = at
        self._raw.append(means)

    def _settle_means(self) -> None:
        if self._raw:
            assert self._settle is not None
            made = self._settle(self._raw)
            self.means[:, self._raw_at : self._raw_at + made.shape[1]] = made
            self._raw = []

    def _columns(self, k: int, n: int) -> slice:
        """Return where instants k to k + n - 1 go, after making room for them."""
        if k + n - self._first > self.Y.shape[1]:
            self._flush()
            self._first = k
        self._end = k + n
        return slice(k - self._first, self._end - self._first)

    def wave(self, t: np.ndarray, w: np.ndarray) -> None:
        """Append waveform samples, where any are kept."""
        if self.t_w.size:
            n = t.size
            if self._n + n > self.t_w.size:
                self._flush_waves()
                if n > self.t_w.size:  # a long step
                    self.t_w, self.waves = np.empty(n), np.empty((len(WAVEFORMS), n))
            self.t_w[self._n : self._n + n] = t
            self.waves[:, self._n : self._n + n] = w
            self._n += n

    def _flush(self) -> None:
        """Write the instants in the arrays to the file."""
        assert self.file is not None
        self._settle_means()
        n = self._end - self._first
        part = copy.copy(self)
        part.Y, part.means = self.Y[:, :n], self.means[:, :n]
        part.factors, part.severity = self.factors[:, :n], self.severity[:, :n]
        for name, row in {**dict(zip(self.gg.Y.names, part.Y, strict=True)), **part.slow()}.items():
            self.file.write(name, self._first, row)
        self._residual = self.residual_max()

    def _flush_waves(self) -> None:
        assert self.file is not None
        for name, row in zip(_WAVE_ROWS, (self.t_w, *self.waves), strict=True):
            self.file.write(name, self._first_w, row[: self._n])
        self._first_w, self._n = self._first_w + self._n, 0

    def residual_max(self) -> float:
        """Largest scaled residual of the gas path equations so far."""
        now = self.Y[self.gg.Y.index("residual"), : self._end - self._first]
        return max(self._residual, float(now.max()))

    def keep(self, name: str, values: np.ndarray) -> Any:
        """Keep more values, where the others are."""
        return values if self.file is None else self.file.add(name, values)

    def last(self) -> np.ndarray:
        """Outputs of the gas generator at the last instant entered, shape (ny,)."""
        return self.Y[:, self._end - self._first - 1]

    def instants(self) -> dict[str, Any]:
        """All that is kept of the exchange instants, by name; the run is complete."""
        self._settle_means()
        if self.file is None:
            return {**dict(zip(self.gg.Y.names, self.Y, strict=True)), **self.slow()}
        self._flush()
        return {n: self.file.array(n) for n in self._names}

    def samples(self) -> tuple[np.ndarray, dict[str, Any]]:
        """Times of the waveform samples, and the waveforms by name; empty where none are kept."""
        if not self.t_w.size:
            return self.t_w, {}
        if self.file is None:
            return self.t_w, dict(zip(WAVEFORMS, self.waves, strict=True))
        self._flush_waves()
        t, *waves = (self.file.array(n) for n in _WAVE_ROWS)
        return np.asarray(t), dict(zip(WAVEFORMS, waves, strict=True))

    def slow(self) -> dict[str, np.ndarray]:
        """Means, rms values, phasors, health and severity by name."""
        d = dict(zip(MEANS, self.means, strict=False))
        n = len(MEANS) + len(RMS)
        d |= dict(zip(RMS, self.means[len(MEANS) : n], strict=True))
        if self.means.shape[0] > n:
            d |= dict(zip(PARTS, self.means[n:], strict=True))
        d |= dict(zip(self.gg.THETA.names, self.factors, strict=True))
        return d | dict(zip(self.severities.names, self.severity, strict=True))


def _severities(events: Iterable[Event], *others: Fault | None) -> Signals:
    """Return what a run stores of the severity of its faults, the TTSC's always."""
    faults = (*(e.fault for e in events if isinstance(e, FaultChange)), *others)
    stored = [*_STORED, *(s for f in faults if f is not None for s in f.severities)]
    return Signals(list({s.name: s for s in stored}.values()))


def _now(severities: Signals, fault: Fault | None) -> list[float]:
    """Return their values under a fault or without one."""
    values = {} if fault is None else fault.severity
    return [values.get(s.name, s.default or 0.0) for s in severities]


def _phasor_signals() -> list[Signal]:
    kinds = {"V": ("V", "voltage"), "I": ("A", "current")}
    parts = {"re": "along the rotor angle's cosine", "im": "ahead of it by a quarter turn"}
    return [
        Signal(f"{name}_{part}", unit, f"phase {name[2]} {what}, fundamental, rms, {where}")
        for name in PHASORS
        for unit, what in (kinds[name[0]],)
        for part, where in parts.items()
    ]


def _collect(
    apu: Apu,
    book: _Book,
    run: Mapping[str, Any],
    noise: Noise,
    rng: np.random.Generator,
    attrs: Mapping[str, Any] | None,
    status: Mapping[str, Any],
) -> xr.Dataset:
    """Put the run into a labelled dataset."""
    gg, grid = apu.gas_generator, book.grid
    measured = {
        f"{n}_meas": book.keep(f"{n}_meas", measure(run[n], s, rng)) for n, s in noise.gas.items()
    }
    signals = [*gg.Y, *_phasor_signals(), *book.severities]
    signals += [
        dataclasses.replace(gg.Y[n], name=f"{n}_meas", doc=f"measured: {gg.Y[n].doc}")
        for n in noise.gas
    ]
    times = {"time": grid}
    values: dict[str, dict[str, Any]] = {"time": {**run, **measured}}
    t_w, w = book.samples()
    if w:
        times["time_w"] = t_w
        w["P_inst"] = w.pop("P_total")
        if noise.terminal is not None:
            y_sg = apu.generator.state_space().y
            for n, a in noise.terminal.each(dict(w), rng):
                w[f"{n}_meas"] = book.keep(f"{n}_meas", a)
                signals.append(
                    dataclasses.replace(y_sg[n], name=f"{n}_meas", doc=f"measured: {y_sg[n].doc}")
                )
        values["time_w"] = w
    return dataset(
        times,
        values,
        signals=signals,
        attrs={
            "parameters": json.dumps(apu.parameters()),
            "solver": json.dumps(dict(status)),
            **(attrs or {}),
        },
    )
