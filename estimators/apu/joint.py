"""Joint estimation: the electrical filter at 10 kHz and the gas-path filter at 20 ms, coupled.

What passes between them is what couples the models, eqs. (1) and (2):

* Electrical to gas path: the mean mechanical power of each 20 ms window with all that is uncertain
  in it (:mod:`estimators.apu.electrical.electricalside`).  Its 200 samples are one measurement: the
  energy since the window's start is a state of the electrical filter.  What is common to all
  windows does not average out and is a state of the gas-path filter as well: ``gain_PW`` for the
  efficiency and the errors of gains and delay of the electrical sensors, ``loss_PW`` for the loss
  of a short circuit that may be there, or of the error of its severity.
* Nothing is decided before that: until a short circuit is found, power is the mean over a healthy
  machine and a short circuit in each phase.  When one is found, the course of the power since it
  came is known better, and the gas-path filter goes over it again: what it is told from then on
  rests on the corrected course, while what it said before stays.
* Speed, both ways: the generators' speed pick-ups are inputs of the electrical filter; by (2) they
  measure the rotor speed as well, better than its own sensor, and the gas-path filter takes a
  weighted mean of both.

Of generators that differ in the run each has filters and gain errors of its own, and which one is
faulty is found; the gas path gets the sum of their powers.  :func:`estimate_joint` can leave h out
(``ttsc=False``), to show what is mistaken then.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import DataError
from apu_casadi.core.results import GENERATOR, dataset, generators_of, of_generator
from apu_casadi.core.signals import Signal
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.park import PHASES
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.runsummary import severity_h
from estimators.apu.electrical.electricalside import (
    GAIN_SHARE,
    ElectricalSide,
    View,
    electrical_side,
    loosened,
)
from estimators.apu.electrical.hypotheses import SeverityPrior
from estimators.apu.electrical.terminalsignals import GAIN_SENSORS, PHASES_I
from estimators.apu.gaspath import (
    GasPathFilter,
    gas_path_filter,
    samples,
    true_readings,
    window_means,
)
from estimators.apu.gaspathmodel import DT
from estimators.apu.healthjumps import JumpTest, Tracked, spliced, track_jumps
from estimators.apu.machinepowers import shaft_courses
from estimators.apu.peers import compared_sides
from estimators.apu.priorfile import Prior
from estimators.apu.sensorchain import interpolated
from estimators.apu.sensors import ELECTRICAL, GAS_PATH, SensorSet
from estimators.apu.unknowns import (
    EFFICIENCY,
    ETA_SIGMA,
    Knowledge,
    of_parameter,
    usual,
)
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import StepMaker
from estimators.models.recording import Recording

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "ETA_SIGMA",
    "GAIN_SHARE",
    "ElectricalSide",
    "Pickup",
    "View",
    "beside_truth",
    "better_speed",
    "electrical_samples",
    "electrical_side",
    "estimate_joint",
    "fused",
    "loosened",
    "machines_of",
    "speed_from_generators",
    "unit_of",
]

TEST = JumpTest()


def electrical_samples(
    ds: xr.Dataset,
    apu: Apu,
    rng: np.random.Generator | None,
    *,
    sensors: SensorSet = ELECTRICAL,
    gains: Mapping[str, float] | None = None,
    delay: float = 0.0,
) -> dict[str, np.ndarray]:
    """Measure the waveforms of a joint run: t, w_r, voltages and currents with noise.

    Speed between the exchange instants follows the ramp of the run's exchange.

    Args:
        ds: from :func:`apu_casadi.unit.multirate.simulate_joint`, waveforms kept.
        apu: the unit, for the gear.
        rng: of the noise; None adds none.
        sensors: the 1-sigma table.
        gains: actual relative gain errors by sensor.
        delay: actual delay of the phase currents, s.

    Raises:
        DataError: the run has no waveforms, or its generators differ.
    """
    if GENERATOR in ds.dims:
        raise DataError("samples are those of one generator; those of the run differ: machines_of")
    if "time_w" not in ds:
        raise DataError("the run has no waveforms; simulate with waveform_dt=1e-4")
    t = np.asarray(ds["time_w"].values, float)
    truth = {n: np.asarray(ds[n].values, float) for n in GAIN_SENSORS}
    if delay:
        truth |= {n: interpolated(t, truth[n], t - delay)[0] for n in PHASES_I}
    truth["w_r"] = np.asarray(apu.w_r(np.interp(t, ds["time"].values, ds["N"].values)))
    return {"t": t} | sensors.measure(truth, rng, gains=gains)


def unit_of(apu: Apu, number: int) -> Apu:
    """Return the unit with one of its generators, by number from 1, in place of all.

    Raises:
        DataError: there is no such generator.
    """
    if not 1 <= number <= len(apu.machines):
        raise DataError(f"generator {number}: the unit has {len(apu.machines)}")
    if apu.alike:
        return apu
    generator, coupling = apu.machines[number - 1]
    return dataclasses.replace(apu, generator=generator, coupling=coupling, others=None)


def speed_from_generators(
    t_w: np.ndarray, w_r: np.ndarray, sigma: float, t: np.ndarray, apu: Apu
) -> tuple[np.ndarray, np.ndarray]:
    """Rotor speed at the instants t, rad/s, from the pick-ups' samples of the window before each.

    A parabola through the window's samples, at its end: after a load drop a straight line would be
    0.3 rad/s off.  The error of the first instant, which has no window, is infinite.

    Returns:
        Speed and standard deviation, shapes (K,).
    """
    per = 1.0 / float(apu.w_r(1.0))
    N, s = np.zeros(t.size), np.full(t.size, np.inf)
    edges = np.searchsorted(t_w, t + 1e-9)
    for k in range(1, t.size):
        i, j = edges[k - 1], edges[k]
        tau = t_w[i:j] - t[k]
        if tau.size < 10:
            continue
        A = np.column_stack([np.ones_like(tau), tau / DT, (tau / DT) ** 2])
        inverse = np.linalg.inv(A.T @ A)
        N[k] = per * float(inverse[0] @ (A.T @ w_r[i:j]))
        s[k] = per * sigma * math.sqrt(inverse[0, 0])
    return N, s


@dataclass(frozen=True, eq=False)
class Pickup:
    """A generator's speed pick-up.

    Args:
        t, w_r: instants, s, and samples, electrical rad/s.
        sigma: standard deviation of each of them.
    """

    t: np.ndarray
    w_r: np.ndarray
    sigma: float

    def rotor(self, data: Recording, apu: Apu) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotor speed at each instant with a reading, and its standard deviation."""
        rows = np.isfinite(data.y).any(axis=0)
        N, sigma = np.zeros(data.size), np.full(data.size, np.inf)
        given = self.t, self.w_r, self.sigma, data.t[rows], apu
        N[rows], sigma[rows] = speed_from_generators(*given)
        return N, sigma


def better_speed(filt: GasPathFilter, data: Recording, N: np.ndarray, s: np.ndarray) -> Recording:
    """Replace the sensor's speed by its weighted mean with another measurement."""
    i = filt.model.y.index("N")
    y, variance = data.y.copy(), data.variance.copy()
    own, there = np.isfinite(y[i]), np.isfinite(s)
    own_weight = np.where(own, 1 / variance[i], 0.0)
    weight = own_weight + np.where(there, 1 / np.where(there, s, 1.0) ** 2, 0.0)
    total = np.where(own, y[i] / variance[i], 0.0)
    total = total + np.where(there, N / np.where(there, s, 1.0) ** 2, 0.0)
    known = weight > 0
    y[i] = np.where(known, total / np.where(known, weight, 1.0), np.nan)
    variance[i] = 1 / np.where(known, weight, 1.0)
    return Recording(data.t, data.u, y, variance, data.p)


def machines_of(ds: xr.Dataset, apu: Apu) -> list[tuple[str, Apu, xr.Dataset]]:
    """Return the run as each generator has it: ending of its names, unit with it in place of all.

    One without an ending where all are alike: it stands for all of them.

    Raises:
        DataError: the run and the unit have different numbers of generators.
    """
    numbers = generators_of(ds)
    if GENERATOR not in ds.dims:
        return [("", apu, ds)]
    if len(numbers) != len(apu.machines):
        raise DataError(f"the run has {len(numbers)} generators, the unit {len(apu.machines)}")
    return [(f"_{k}", unit_of(apu, k), of_generator(ds, k)) for k in numbers]


def own_gains(gains: Mapping[str, float] | None, ending: str) -> dict[str, float]:
    """Return the gain errors of one machine, ``v_a_2`` for the ending ``_2``, or ``v_a`` of all."""
    given = gains or {}
    own = {n: given.get(n + ending, given.get(n)) for n in GAIN_SENSORS}
    return {n: v for n, v in own.items() if v is not None}


def _true_phases(ds: xr.Dataset, ending: str, t: np.ndarray) -> np.ndarray:
    """Number of the phase that has a fault in the run, 1 to 3, at each instant; 0 for none."""
    out = np.zeros(t.size, dtype=int)
    for fault in json.loads(ds.attrs.get("faults", "[]")):
        if ending and str(fault.get("generator", ending[1:])) != ending[1:]:
            continue
        phase = fault.get("phase")
        number = 1 + PHASES.index(phase) if phase in PHASES else 0
        # a change at an instant shows in the sample after it
        out[t > fault["t"] + (1e-9 if fault["t"] > t[0] else -1e-9)] = number
    return out


def estimate_joint(
    ds: xr.Dataset,
    seed: int | None,
    *,
    apu: Apu | None = None,
    ttsc: bool = True,
    power: bool = True,
    speed: bool = True,
    gas_sensors: SensorSet = GAS_PATH,
    electrical_sensors: SensorSet = ELECTRICAL,
    gas_gains: Mapping[str, float] | None = None,
    electrical_gains: Mapping[str, float] | None = None,
    delay: float = 0.0,
    eta: float | None = None,
    gain_errors: bool = True,
    unknowns: Mapping[str, Knowledge] | None = None,
    severity: SeverityPrior | None = None,
    step: StepMaker | None = None,
    electrical_step: StepMaker = ekf_step,
    backend: str | None = None,
) -> xr.Dataset:
    """Measure a true joint run and estimate along it, causally.

    Args:
        ds: the truth, from :func:`apu_casadi.unit.multirate.simulate_joint` with
            ``waveform_dt=1e-4``.
        seed: of all measurement noise; None: none.
        apu: the unit as the filters know it.
        ttsc: whether the electrical filter knows short circuits; without, its power lacks their
            loss.
        power: whether the gas-path filter gets the shaft power.
        speed: whether it gets the generators' speed.
        gas_sensors, electrical_sensors: 1-sigma tables.
        gas_gains, electrical_gains: actual relative gain errors by sensor; ``PW`` of the former is
            the relative error of efficiency.  Of generators that differ, ``v_a_2``.
        delay: actual delay of the phase currents, s.
        eta: relative standard deviation of the efficiency, instead of that in ``unknowns``.
        gain_errors: whether the filters take gain errors into account; False only where there are
            none.
        unknowns: parameters of the unit that are estimated or considered, by name, see
            :mod:`estimators.apu.unknowns`.
        severity: prior of a short circuit that may be there.
        step: makes the step of the gas-path filter for its model; its own by default.
        electrical_step: the same of the electrical filters.
        backend: see :func:`apu_casadi.core.backend.compiled`.

    Returns:
        xarray.Dataset on ``time`` (20 ms): for N, the four factors, h_a, h_b, h_c and P_total the
        estimate under its name, ``<name>_sigma`` and ``<name>_true``; ``faulty_phase`` (0: none, 1
        to 3: a to c), ``nis`` of the gas-path filter.  P_total is the mean of the window that ends
        at the instant.  ``ttsc_probability`` is that of a short circuit, found or not.  Of
        generators that differ, names have endings, ``h_a_2``.  Attributes: ``resets`` of the
        electrical filters, ``alarms`` and ``onsets`` of health jumps, s, and what machines that
        differ say ``compared`` with each other (:mod:`estimators.apu.peers`), as JSON.

    Raises:
        DataError, EstimationError: as the two filters.
    """
    apu = Apu() if apu is None else apu
    rng, noise = (None if seed is None else np.random.default_rng([seed, k]) for k in (1, 2))
    t, _ = samples(ds)
    given = {} if eta is None else {EFFICIENCY: Knowledge.of(eta)}
    unknowns = {**usual(unknowns, gain_errors), **given}
    how: dict[str, Any] = {"gain_errors": gain_errors, "backend": backend, "unknowns": unknowns}
    also: dict[str, Any] = {"ttsc": ttsc, "step": electrical_step, "prior": severity}
    also |= {"efficiency_error": (gas_gains or {}).get("PW", 0.0), **how}
    waves = _measured(ds, apu, rng, electrical_sensors, electrical_gains, delay)
    sides = {
        number: electrical_side(one, electrical_sensors, measured, t, **also)
        for number, (one, measured) in enumerate(waves, 1)
    }
    first = waves[0][1]
    sigma = electrical_sensors.sigma("w_r", float(np.median(first["w_r"])))
    pickup = Pickup(first["t"], first["w_r"], sigma) if speed else None
    readings = _read_gas(ds, gas_sensors, gas_gains, noise)
    how |= {"power": power, "step": step, "speed": pickup}
    gas, tracked = fused(apu, [*sides.values()], readings, gas_sensors, **how)
    return beside_truth(ds, sides, gas, tracked)


def _read_gas(
    ds: xr.Dataset,
    sensors: SensorSet,
    gains: Mapping[str, float] | None,
    noise: np.random.Generator | None,
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Measure the gas path; return times and readings by sensor."""
    sensors.only([*(gains or ())])  # all of them are there
    t = samples(ds)[0]
    read = sensors.measure(true_readings(sensors, ds)[1], noise, gains=gains)
    return {n: (t, v) for n, v in read.items()}


def _measured(
    ds: xr.Dataset,
    apu: Apu,
    rng: np.random.Generator | None,
    sensors: SensorSet,
    gains: Mapping[str, float] | None,
    delay: float,
) -> list[tuple[Apu, dict[str, np.ndarray]]]:
    """Measure the waveforms of every machine that differs; return each as a unit, with them."""
    return [
        (
            one,
            electrical_samples(
                view, one, rng, sensors=sensors, gains=own_gains(gains, ending), delay=delay
            ),
        )
        for ending, one, view in machines_of(ds, apu)
    ]


def fused(
    apu: Apu,
    sides: Sequence[ElectricalSide],
    readings: Mapping[str, tuple[np.ndarray, np.ndarray]],
    sensors: SensorSet = GAS_PATH,
    *,
    speed: Pickup | None = None,
    power: bool = True,
    prior: Mapping[str, float] | None = None,
    spread: Prior | None = None,
    inputs: Mapping[str, Any] | None = None,
    gain_errors: bool = True,
    unknowns: Mapping[str, Knowledge] | None = None,
    step: StepMaker | None = None,
    test: JumpTest = TEST,
    backend: str | None = None,
    max_dt: float = math.inf,
) -> tuple[GasPathFilter, Tracked]:
    """Run the gas-path filter with what the electrical filters say.

    Args:
        apu: the unit as the filters know it.
        sides: of each machine in their order, or, of equal ones, of some, which stand for all; on
            the same instants.
        readings: ``{name: (t, values)}`` by gas-path sensor.
        sensors: 1-sigma table of the gas path.
        speed: a generator's speed pick-up.
        power: whether the filter gets the shaft power.
        prior: means of the start by state.
        spread: of which the standard deviations are taken.
        inputs, max_dt: as for :meth:`GasPathFilter.of_readings`.
        test: of jumps of the health.
        gain_errors, unknowns, step, backend: as for :func:`estimate_joint`.
    """
    J = of_parameter(usual(unknowns, gain_errors), "J")
    share = max(math.hypot(s.eta, s.share) for s in sides)
    gas = _gas_filter(apu, sensors, power, gain_errors, share, J)
    t = sides[0].t
    courses = shaft_courses(apu, sides)
    streams: dict[str, Any] = {"readings": readings, "max_dt": max_dt}
    tracked: Tracked | None = None
    told: tuple[np.ndarray, np.ndarray] | None = None
    if spread is not None:
        spread.check(gas.model.x)
    start = gas.prior(None if spread is None else spread.sigma, **(prior or {}))
    runs = gas.runs(prior=start, step=step, backend=backend)
    for first, mean, white, loss in courses:
        given = dict(inputs or {})
        if "jump_loss" in gas.model.u.names:
            given["jump_loss"] = (t, _opening(loss))
        else:
            white = np.hypot(white, loss)
        known = t, np.append(mean, mean[-1]), np.append(white, white[-1])
        data = gas.of_readings(**streams, power=known, inputs=given)
        if speed is not None:
            if told is None:  # the same on all courses
                told = speed.rotor(data, apu)
            data = better_speed(gas, data, *told)
        # from the window on in which more is known
        k = int(np.searchsorted(data.t, t[first] - 1e-9)) + 1 if first else 0
        now = track_jumps(gas, data, test=test, prior=start, runs=runs)
        tracked = now if tracked is None else spliced(tracked, now, k)
    assert tracked is not None
    return gas, tracked


def _opening(loss: np.ndarray) -> np.ndarray:
    """Standard deviations of changes that make a state of variance loss^2, which never falls."""
    return np.append(np.sqrt(np.diff(loss**2, prepend=0.0).clip(0.0)), 0.0)


def _gas_filter(
    apu: Apu, sensors: SensorSet, power: bool, gain_errors: bool, share: float, J: Knowledge
) -> GasPathFilter:
    return gas_path_filter(
        apu.gas_generator,
        sensors,
        power="measured" if power else "unknown",
        gains=gain_errors,
        inertia=J.sigma or None,
        consider_inertia=J.how == "considered",
        eta=share if power and share else None,
        consider_eta=False,
        loss=bool(power and share),
    )


def beside_truth(
    ds: xr.Dataset, sides: Mapping[int, ElectricalSide], gas: GasPathFilter, tracked: Tracked
) -> xr.Dataset:
    """Put estimates beside the truth of a run, as :func:`estimate_joint` returns them.

    Args:
        ds: the run.
        sides: of its machines by number; where the run has one for all, the first stands for them.
        gas, tracked: filter and result of the gas path.
    """
    differ = GENERATOR in ds.dims
    known = sides if differ else {1: sides[min(sides)]}
    r, t = tracked.result, known[min(known)].t
    rows, at = (np.searchsorted(v, t + 1e-7) - 1 for v in (ds["time"].values, r.t))
    values: dict[str, Any] = {"nis": r.nis[at]}
    signals = [Signal("nis", "1", "normalised innovation squared of the gas-path filter")]

    def put(n: str, unit: str, doc: str, estimate: Any, s: Any, true: Any) -> None:
        of = {n: doc, f"{n}_sigma": f"standard deviation of {n}", f"{n}_true": f"true: {doc}"}
        signals.extend(Signal(name, unit, text) for name, text in of.items())
        values.update(zip(of, (estimate, s, true), strict=True))

    for name in ("N", *HEALTH):
        x = gas.model.x[name]
        mean, sigma = r[name]
        put(name, x.unit, x.doc, mean[at], sigma[at], ds[name].values[rows])
    for number, side in known.items():
        end, view = (f"_{number}" if differ else ""), of_generator(ds, number)
        h_true = severity_h(view["mu"].values[rows], view["k_rf"].values[rows])
        true_phase, of = _true_phases(ds, end, t), f" of generator {number}" if differ else ""
        for i, phase in enumerate(PHASES):
            doc = f"severity mu/(k_rf + 1 - mu) of a short circuit in phase {phase}{of}"
            true = h_true * (true_phase == i + 1)
            h, h_sigma = side.severities[:, i]
            put(f"h_{phase}{end}", "1", doc, h, h_sigma, true)
        text = f"phase found faulty{of}: 0 none, 1 to 3: a to c"
        signals += [
            Signal(f"faulty_phase{end}", "1", text),
            Signal(f"ttsc_probability{end}", "1", f"probability of a short circuit{of}"),
        ]
        values |= {f"faulty_phase{end}": side.phase, f"ttsc_probability{end}": side.probability}
    P_true = window_means(ds["time"].values, ds["P_total"].values, t)[:-1]
    share = int(ds.attrs.get("generators", 2)) / 2 / len(known)
    P = share * np.sum([s.P for s in known.values()], axis=0)
    # the machines are of one kind: the efficiency errs in all of them alike
    own = np.sqrt(np.sum([s.given_efficiency for s in known.values()], axis=0))
    sigma = share * np.hypot(own, np.sum([s.eta * s.P for s in known.values()], axis=0))
    doc = "mean mechanical power of both generators over the window before"
    P, sigma, P_true = (np.append(np.nan, v) for v in (P, sigma, P_true))
    put("P_total", "W", doc, P, sigma, P_true)
    found = {
        "resets": sorted({v for s in known.values() for v in s.resets}),
        "alarms": [float(r.t[i]) for i in tracked.alarms],
        "onsets": [float(r.t[i]) for i in tracked.onsets],
        "compared": compared_sides(known)[1],
    }
    attrs = {n: json.dumps(v) for n, v in found.items()}
    return dataset({"time": t}, {"time": values}, signals=signals, attrs=attrs)
