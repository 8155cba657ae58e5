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
about the same price, and no staircase of speed excites the voltage regulator.  The step after an
event is computed twice, since no slope is known there.  ``"corrected"`` computes each step a second
time with the slope that the first gave; it errs less, at twice the machine's price.  ``"predicted
speed"`` and ``"predicted fuel"`` do half of it, to tell the two errors apart.  Energy is handed
over exactly in each.

Phasors ``V_a_re``, ``V_a_im``, ... are rms values with the rotor angle as reference,
v_a = sqrt(2) Re(V_a exp(j theta_e)), by least squares over the step.

Results are in memory; or, with a folder as ``storage``, in a temporary file in it that vanishes
with the dataset, whose values are read when they are asked for, each time anew; ``"auto"`` takes
memory up to :data:`~apu_casadi.core.runstorage.IN_MEMORY` bytes, beyond that a file in the
system's folder of temporary files where there is room.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ApuWarning, ScenarioError, ValidityWarning, nearest
from apu_casadi.core.lanes.together import Course, alone
from apu_casadi.core.means import RMS
from apu_casadi.core.profiles.profile import Profile, Varying
from apu_casadi.core.runloop import SAME_INSTANT, steps
from apu_casadi.gaspath.steady.steadypoint import Limits
from apu_casadi.unit import runrecord, validity
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.departures import Departure, departures
from apu_casadi.unit.events import (
    STARTS,
    Ambient,
    Event,
    Holding,
    Jump,
    SpeedChange,
    all_factors,
    in_order,
    jumps,
)
from apu_casadi.unit.exchange import EXCHANGES
from apu_casadi.unit.integrators import ATOL, RTOL, SOLVERS, WAVEFORMS, Settings, ramped
from apu_casadi.unit.jointrun import Asked, JointRun
from apu_casadi.unit.machines import kinds, means_of
from apu_casadi.unit.noise import Noise
from apu_casadi.unit.recorder import Recorder, stored_severities
from apu_casadi.unit.stepmeans import MEANS
from apu_casadi.unit.strictness import Strict

if TYPE_CHECKING:
    from typing import TypeAlias

    import xarray as xr

    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load

    ALoad: TypeAlias = Load | Varying[Load]
    AFault: TypeAlias = Fault | Varying[Fault | None] | None

__all__ = [
    "EXCHANGES",
    "MEANS",
    "RMS",
    "SOLVERS",
    "STARTS",
    "WAVEFORMS",
    "Noise",
    "exchange_grid",
    "ramped",
    "simulate_joint",
]


def exchange_grid(duration: float, dt: float, events: Sequence[Event | Jump]) -> np.ndarray:
    """Instants, s, of the exchange: multiples of dt, every event or jump, and the end."""
    if not (math.isfinite(duration) and duration > 0):
        raise ScenarioError(f"duration must be > 0 s, got {duration!r}")
    if not (math.isfinite(dt) and 0 < dt <= 1.0):
        raise ScenarioError(f"exchange step dt must lie in (0, 1] s, got {dt!r}")
    regular = np.arange(0, math.floor(duration / dt + 1e-9) + 1) * dt
    t = np.unique(np.concatenate([regular, [e.t for e in events], [duration]]))
    keep = np.concatenate([[True], np.diff(t) > SAME_INSTANT])
    grid = t[keep]
    grid[-1] = duration
    return np.asarray(grid)


def simulate_joint(
    apu: Apu,
    *,
    duration: float,
    load: ALoad | Sequence[ALoad],
    ambient: Ambient | Varying[Ambient] | None = None,
    health: Mapping[str, float | Profile] | None = None,
    fault: AFault | Sequence[AFault] | Mapping[int, AFault] = None,
    N_ref: float | Profile | None = None,
    events: Sequence[Event] = (),
    dt: float = 0.02,
    exchange: str = "paper",
    waveform_dt: float | None = 50e-6,
    phasors: bool = False,
    noise: Noise | None = None,
    seed: int | None = None,
    hook: Callable[[int, np.ndarray], np.ndarray] | None = None,
    solver: str = "auto",
    start_from: str = "balanced",
    strict: bool = False,
    limits: Limits | None = None,
    rtol: float = RTOL,
    atol: float = ATOL,
    progress: Callable[[float, float], None] | None = None,
    attrs: Mapping[str, Any] | None = None,
    storage: str | os.PathLike[str] = "auto",
    warn_exchange: bool = True,
) -> xr.Dataset:
    """Simulate gas generator, generators and governor together, from a steady start.

    Nothing moves before the first event.  Factors, speed, and the numbers of loads, faults and the
    day may be profiles (:func:`apu_casadi.core.profiles.profile.varying`), held over each step at
    their value in its middle; where one jumps, a step begins.  A fault or an unbalanced load from
    the start acts from t = 0 on the steady healthy, balanced unit; with ``start_from="settled"`` it
    has been there for long: the run starts in the periodic state of all generators.

    Args:
        apu, load, fault: the unit; load and fault from the start, of all generators, or a list with
            one for each; for the fault also a mapping by number of the generator, from 1.
        duration, dt: of the run, and exchange step, s.
        ambient, health: day (the default one if not given), and factors by name.
        N_ref: governed rotor speed, rad/s; default the unit's.
        events: changes of load, health, fault and speed (:mod:`apu_casadi.unit.events`).
        exchange: one of ``EXCHANGES``, see the module's text.
        waveform_dt, phasors: sampling of the stored waveforms, s (None stores none); store
            fundamental phasors of voltages and currents of each exchange step, too.
        noise, seed: uncertainty and the seed of its random numbers.
        hook: processes the rotor speed between state update and output (Algorithm 2).
        start_from: one of ``STARTS``, as above.
        strict: stop with an error where there would be a warning, at its instant where it shows.
        limits: of the steady points of the unit, which the run is judged by; default the trim's.
        solver, rtol, atol: one of ``SOLVERS``, see :mod:`apu_casadi.unit.integrators`.
        progress, attrs: called with (done, total) seconds; more attributes for the dataset.
        storage: ``"memory"``, a folder for a temporary file, or ``"auto"``; the module's text.
        warn_exchange: whether an exchange error beyond 1 % of the speed's excursion is warned of.

    Returns:
        xarray.Dataset on ``time`` (exchange grid) and ``time_w`` (waveforms), see
        :mod:`apu_casadi.core.results`; by ``generator`` where they do not stay equal.  Attributes:
        what was asked, ``exchange_error`` (NaN with state noise, a hook or another governed speed),
        ``validity`` and ``warnings``, which are raised too (:mod:`apu_casadi.unit.validity`).

    Raises:
        ScenarioError, DataError: impossible times or events; no room in the ``storage`` folder.
        OperatingPointError, SimulationError: no steady start; a step failed: when and why.
        ValidityError: a strict run left the model (:mod:`apu_casadi.unit.strictness`).
    """
    return alone(joint_course(**locals()))


def joint_course(apu: Apu, **how: Any) -> Course[xr.Dataset]:
    """Do what :func:`simulate_joint` does, whose arguments these are, and pause at questions.

    An ensemble answers them (:mod:`apu_casadi.unit.ensemble`); a single run asks none.
    """
    noise = Noise() if how["noise"] is None else how["noise"]
    duration = number("duration", how["duration"], error=ScenarioError)
    numbers = {n: how[n] for n in ("exchange", "dt", "waveform_dt", "solver", "rtol", "atol")}
    settings = _settings(**numbers, noise=noise)
    events = in_order(how["events"], duration, generators=len(apu.machines))
    start = start_of(apu, *(how[n] for n in ("load", "fault", "health", "ambient", "N_ref")))
    stops = sorted([*events, *jumps(start, events, duration)], key=lambda e: e.t)
    grid, settled = exchange_grid(duration, settings.dt, stops), settled_start(how["start_from"])
    seed, strict = how["seed"], how["strict"]
    given = how["phasors"], noise, seed, how["hook"], settled, strict, events
    asked = Asked(start, grid, *given)
    system = JointRun(apu, asked, settings, np.random.default_rng(seed))
    limits = how["limits"]
    judged = (limits or Limits()) if strict else None
    watched = how["exchange"] if how["warn_exchange"] and _estimated(asked, events) else None
    way = judged, watched, how["progress"]
    record = yield from _moved(system, events, stops, how["storage"], *way)
    told = {"warn_exchange": how["warn_exchange"], "strict": strict, "limits": limits}
    return _concluded(system, record, how["exchange"], events, **told, attrs=how["attrs"] or {})


def _estimated(asked: Asked, events: Sequence[Event]) -> bool:
    """Tell whether the error of a run's exchange can be estimated.

    State noise is drawn for each exchange step, and no other exchange has it; the estimate knows
    one governed speed.
    """
    steered = asked.start.N_ref is not None or any(isinstance(e, SpeedChange) for e in events)
    return asked.hook is None and not asked.noise.N and not steered


def start_of(
    apu: Apu,
    load: ALoad | Sequence[ALoad],
    fault: AFault | Sequence[AFault] | Mapping[int, AFault],
    health: Mapping[str, float | Profile] | None,
    ambient: Ambient | Varying[Ambient] | None,
    N_ref: float | Profile | None,
) -> Holding:
    """Return what holds from the start, for each generator, checked."""
    day = Ambient() if ambient is None else ambient
    speed = None if N_ref is None else SpeedChange(0.0, N_ref).N_ref
    return Holding(apu.each("load", load), apu.each_fault(fault), all_factors(health), day, speed)


def _moved(
    system: JointRun,
    events: Sequence[Event],
    stops: Sequence[Event | Jump],
    storage: str | os.PathLike[str],
    strict: Limits | None,
    watched: str | None,
    progress: Callable[[float, float], None] | None,
) -> Course[Recorder]:
    """Run the unit over its grid, strictly within limits if given; return what was recorded.

    ``watched`` is the exchange whose error a strict run watches.
    """
    apu, asked, grid = system.apu, system.asked, system.asked.grid
    means = {k: means_of(apu, k, asked.phasors) for k in kinds(apu, system.now, events)}
    severities = stored_severities(events, *asked.start.faults)
    samples = system.machines.samples(grid)
    record = Recorder(apu.gas_generator, grid, samples, means, storage, severities)
    put = record.put
    if strict is not None:
        way = None if watched is None else (watched, system.settings.dt, system.point.gas)
        spikes: Callable[[], list[Departure]] = lambda: system.machines.spikes  # noqa: E731
        put = Strict(system, grid, means, record.put, strict, events, spikes, way)
    put(0, 1, system.at_start())
    yield from steps(system, grid, stops, record=put, progress=progress)
    return record


def settled_start(start_from: str) -> bool:
    """Return whether a run starts from what has been there for long; see ``STARTS``."""
    if start_from not in STARTS:
        raise ScenarioError(f"start_from {start_from!r} {nearest(str(start_from), STARTS)}")
    return start_from == "settled"


def _settings(
    exchange: str,
    dt: float,
    waveform_dt: float | None,
    solver: str,
    rtol: float,
    atol: float,
    noise: Noise,
) -> Settings:
    """Check how a run is to be integrated."""
    for what, name, known in (("exchange", exchange, EXCHANGES), ("solver", solver, SOLVERS)):
        if name not in known:
            raise ScenarioError(f"{what} {name!r} {nearest(name, known)}")
    numbers = {"dt": dt, "rtol": rtol, "atol": atol, "waveform_dt": waveform_dt}
    given = {n: number(n, v, error=ScenarioError) for n, v in numbers.items() if v is not None}
    if waveform_dt is not None and not 1e-7 <= given["waveform_dt"] <= given["dt"]:
        raise ScenarioError(
            f"waveform_dt = {given['waveform_dt']!r} s must lie between 1e-7 s and the step, "
            f"{given['dt']:g} s"
        )
    noisy = bool(noise.w1 or noise.w2)
    return Settings(way=EXCHANGES[exchange], solver=solver, noisy=noisy, **given)


def _concluded(
    system: JointRun,
    record: Recorder,
    exchange: str,
    events: Sequence[Event],
    *,
    warn_exchange: bool,
    strict: bool,
    limits: Limits | None,
    attrs: Mapping[str, Any],
) -> xr.Dataset:
    """Make the dataset of a run, with what must be known of it in attributes and warnings."""
    apu, asked, settings, machines = system.apu, system.asked, system.settings, system.machines
    rows, grid = record.instants(), asked.grid
    N, Wf = (np.asarray(rows[n]) for n in ("N", "Wf"))
    lost = math.nan
    # state noise is drawn for each step: no other exchange has it; the estimate has one speed
    steered = asked.start.N_ref is not None or any(isinstance(e, SpeedChange) for e in events)
    if asked.hook is None and not asked.noise.N and not steered:
        lost = validity.exchange_error(apu, system.point.gas, grid, N, Wf).error
    status = {
        "solver": settings.solver,
        "rtol": settings.rtol,
        "atol": settings.atol,
        "dt": settings.dt,
        "exchange": exchange,
        "nsteps_generator": machines.nsteps,
        "steps_propagated": machines.propagated,
        "residual_max": record.residual_max(),
        "seed": asked.seed,
        "V_ref": machines.V_ref,
    }
    told = runrecord.asked(
        start=asked.start,
        events=events,
        seed=asked.seed,
    )
    told = {"solver": json.dumps(status), **told, "exchange_error": lost, **attrs}
    more, signals = runrecord.followed(asked.start, events, grid)
    ds = record.collect(apu, {**rows, **more}, asked.noise, system.rng, told, signals)
    notes = [d.warning() for d in (*machines.spikes, *record.warnings)]
    notes += validity.notes_of_exchange(lost, exchange, settings.dt) if warn_exchange else []
    notes += load_notes(apu, record, asked.start, events, rows, system.shaft.N_ref)
    found = departures(apu.gas_generator, grid, rows, limits)
    return validity.conclude(ds, found, notes, stacklevel=6, strict=strict)


def load_notes(
    apu: Apu,
    record: Recorder,
    start: Holding,
    events: Sequence[Event],
    rows: Mapping[str, Any],
    N_ref: float | None = None,
) -> list[ApuWarning]:
    """Return the warnings of a run that got less fuel or power than it asked for.

    Args:
        record, rows: of the run, and what its instants gave.
        start, events: what held.
        N_ref: governed rotor speed at the end, rad/s; None for the unit's own.
    """
    N, Wf = (np.asarray(rows[n]) for n in ("N", "Wf"))
    starved = validity.fuel_limited(apu, record.grid, N, Wf, N_ref)
    one = len(record.of) == 1
    unserved = [
        validity.unserved(start.loads[k[0] - 1], events, record.grid, P_e, k, of_all=one)
        for k, P_e in record.of_each("P_e", rows).items()
    ]
    return [d.warning(ValidityWarning) for d in (starved, *unserved) if d]
