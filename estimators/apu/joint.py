"""Joint estimation: the electrical filter at 10 kHz and the gas-path filter at 20 ms, coupled.

What passes between them is what couples the models, eqs. (1) and (2):

* Electrical to gas path: the mean mechanical power of each 20 ms window with its variance.  Its 200
  samples are one measurement: the energy since the window's start is a state of the electrical
  filter, so the correlation of the samples, and of power with h, fluxes and gain errors, is in that
  variance.  What is common to all windows (efficiency, gain errors of the electrical sensors) does
  not average out; it is the state ``gain_PW`` of the gas-path filter as well.
* A short circuit is there or not.  Gain errors of 0.5 % look like an h of up to 3e-4, whose loss of
  3 % of the power is no loss at all.  So until a fault is found the power is that of a healthy
  machine's filter, which takes no h for real; afterwards that of a filter with the found phase's h,
  and as the error of h is new then, ``gain_PW`` is allowed to jump by what that filter claims.
* Speed, both ways: the generators' speed pick-ups are inputs of the electrical filter; by (2) they
  measure the rotor speed as well, better than its own sensor, and the gas-path filter takes a
  weighted mean of both.

The power that a short circuit costs is in the electrical filter's power, because h is; so the
gas-path filter need not explain it.  :func:`estimate_joint` can leave h out (``ttsc=False``), to
show what is mistaken then.
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
from apu_casadi.core.results import GENERATOR, dataset
from apu_casadi.core.signals import Signal
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.park import PHASES
from apu_casadi.unit.apu import Apu
from estimators.apu.electrical.electricalfilter import ElectricalFilter, electrical_filter
from estimators.apu.electrical.terminalsignals import GAIN_SENSORS
from estimators.apu.electrical.tracking import track, window_power
from estimators.apu.electrical.tuning import FAULT_LEVEL
from estimators.apu.gaspath import (
    GasPathFilter,
    gas_path_filter,
    jumps_at,
    samples,
    true_readings,
    window_means,
)
from estimators.apu.gaspathmodel import DT
from estimators.apu.healthjumps import JumpTest, Tracked, track_jumps
from estimators.apu.priorfile import Prior
from estimators.apu.sensors import ELECTRICAL, GAS_PATH, SensorSet
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import FilterResult, StepMaker, run
from estimators.models.recording import Recording

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "ETA_SIGMA",
    "ElectricalSide",
    "JointCase",
    "beside_truth",
    "better_speed",
    "cross_talk",
    "electrical_samples",
    "electrical_side",
    "estimate_joint",
    "fused",
    "joint_case",
    "speed_from_generators",
    "unit_of",
]

ETA_SIGMA = 0.02  # relative; efficiency of the generators
# gain errors of 0.5 % of three voltages and three currents in the power of three phases
GAIN_SHARE = 0.005 * math.sqrt(2 / 3)
# what gain errors of 0.5 % and an unbalanced load look like at most
H_FLOOR = 3e-4
# and as a rule; added to the standard deviation of h
H_GAIN = 1e-4
TEST = JumpTest()


def electrical_samples(
    ds: xr.Dataset,
    apu: Apu,
    rng: np.random.Generator | None,
    *,
    sensors: SensorSet = ELECTRICAL,
    gains: Mapping[str, float] | None = None,
) -> dict[str, np.ndarray]:
    """Measure the waveforms of a joint run: t, w_r, voltages and currents with noise.

    Speed between the exchange instants follows the ramp of the run's exchange.

    Args:
        ds: from :func:`apu_casadi.unit.multirate.simulate_joint`, waveforms kept.
        apu: the unit, for the gear.
        rng: of the noise; None adds none.
        sensors: the 1-sigma table.
        gains: actual relative gain errors by sensor.

    Raises:
        DataError: the run has no waveforms, or its generators differ.
    """
    if GENERATOR in ds.dims:
        raise DataError("the joint filter takes generators that are alike; those of the run differ")
    if "time_w" not in ds:
        raise DataError("the run has no waveforms; simulate with waveform_dt=1e-4")
    t = np.asarray(ds["time_w"].values, float)
    truth = {n: np.asarray(ds[n].values, float) for n in GAIN_SENSORS}
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


def loosened(sensors: SensorSet) -> SensorSet:
    """Return the sensors with their gain errors at rated load taken for noise.

    A filter that estimates the gains from 10 kHz samples learns them within a second to better than
    its model is; one that takes them for noise learns nothing false.
    """
    rated = {"v": 325.0, "i": 461.0, "V_fd": 40.0, "i_fd": 590.0}  # peak values, V and A
    noise = {}
    for s in sensors.sensors:
        size = rated.get(s.name, rated.get(s.name[0])) if s.name != "w_r" else 0.0
        gain = s.unsure("gain") * float(size or 0.0) / math.sqrt(2)
        noise[s.name] = math.hypot(s.noise, gain, s.unsure("bias"))
    return sensors.change(**noise)


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


@dataclass(frozen=True, eq=False)
class ElectricalSide:
    """What the electrical filters of one machine say at K instants, 20 ms apart.

    Args:
        t: the instants, s.
        P, variance: mechanical power of both generators over the K - 1 windows, and its variance.
        severities: h and its standard deviation by phase, (2, 3, K).
        phase: found faulty, 0 for none, (K,).
        found_at: windows from which on the power is that of a filter with a fault.
        resets: instants, s, at which the machine changed.
        result: of the filter with the three h, at every sample; without them, of the healthy
            machine's.
    """

    t: np.ndarray
    P: np.ndarray
    variance: np.ndarray
    severities: np.ndarray
    phase: np.ndarray
    found_at: tuple[int, ...]
    resets: tuple[float, ...]
    result: FilterResult


def electrical_side(
    apu: Apu,
    sensors: SensorSet,
    measured: Mapping[str, np.ndarray],
    t: np.ndarray,
    *,
    ttsc: bool = True,
    gain_errors: bool = True,
    step: StepMaker = ekf_step,
    backend: str | None = None,
) -> ElectricalSide:
    """Run the electrical filters and put together what is known causally.

    Args:
        apu: the unit as the filters know it.
        sensors: 1-sigma table.
        measured: samples as :meth:`ElectricalFilter.recording` takes them.
        t: ends of the windows of the mean power, among the instants of the samples.
        ttsc, gain_errors, step, backend: as for :func:`estimate_joint`.

    Raises:
        DataError, EstimationError: as the filter; windows that the waveforms do not cover.
    """
    known = loosened(sensors) if gain_errors else sensors

    def filt(phases: tuple[str, ...]) -> ElectricalFilter:
        return electrical_filter(apu.generator.machine, sensors=known, power=True, phases=phases)

    def windows(
        phases: tuple[str, ...], begin: float
    ) -> tuple[FilterResult, np.ndarray, np.ndarray, list[float]]:
        of = filt(phases)
        own = {n: v[measured["t"] >= begin - 1e-9] for n, v in measured.items()}
        part = base.part(int(np.searchsorted(base.t, begin - 1e-9)), base.size)
        u = part.u.copy()
        u[of.model.u.index("dt_last"), 0] = 0.0
        data = dataclasses.replace(part, u=u, p=of.model.p.pack({}))
        prior = of.prior(own)
        resets: list[float] = []
        if phases:
            level = gain_errors or None
            r, resets = track(of, prior, data, step=step, backend=backend, own_level=level)
        else:  # a healthy machine's filter has no step to look for
            r = run(step(of.model), prior, data, backend=backend)
        ends, P, var = window_power(of, r, data)
        if not np.allclose(ends, t[t > begin + 1e-9][: ends.size]) or ends[-1] < t[-1] - 1e-6:
            raise DataError(
                f"{t.size - 1} windows of shaft power expected, the waveforms give {ends.size}"
            )
        return r, P, var, resets

    K = t.size
    # the inputs are the same for all: made once
    base = filt(()).recording(measured, window=DT, start=float(t[0]))
    healthy, P, var, _ = windows((), float(t[0]))
    severities, phase = np.zeros((2, 3, K)), np.zeros(K, dtype=int)
    if not ttsc:
        return ElectricalSide(t, P, var, severities, phase, (), (), healthy)
    r, _, _, resets = windows(PHASES, float(t[0]))
    at = np.minimum(np.searchsorted(r.t, t - 1e-9), r.t.size - 1)
    for i, n in enumerate(PHASES):
        mean, sigma = r[f"h_{n}"]
        severities[:, i] = mean[at], np.hypot(sigma[at], H_GAIN if gain_errors else 0.0)
    phase = _found(severities, H_FLOOR if gain_errors else 0.0)
    # the window in which a fault is found is the first with the power of a faulty machine
    changes = [k for k in range(1, K) if phase[k] and phase[k] != phase[k - 1]]
    for k in changes:
        begin = max([v for v in resets if v <= t[k] + 1e-9] + [float(t[0])])
        # whole windows: from the beginning of the one in which the machine changed
        first = min(int(np.floor((begin - t[0]) / DT + 1e-6)), k - 1)
        _, P_k, var_k, _ = windows((PHASES[phase[k] - 1],), float(t[first]))
        last = k
        while last + 1 < K and phase[last + 1] == phase[k]:
            last += 1
        P[k - 1 : last], var[k - 1 : last] = (v[k - 1 - first : last - first] for v in (P_k, var_k))
    found_at = tuple(k - 1 for k in changes)
    return ElectricalSide(t, P, var, severities, phase, found_at, tuple(resets), r)


def _found(severities: np.ndarray, floor: float) -> np.ndarray:
    """The phase found faulty at each instant, 1 to 3; 0 for none."""
    h, s = severities
    sure = (h - floor > 0) & (((h - floor) / s) ** 2 > FAULT_LEVEL)
    sure[:, 0] = False  # nothing is known yet
    return np.where(sure.any(0), 1 + np.where(sure, h, 0).argmax(0), 0)


def _phase_of(ds: xr.Dataset) -> str:
    """Faulty phase of the run's scenario; "a" where it does not say."""
    if "scenario" in ds.attrs:
        for p in json.loads(ds.attrs["scenario"]).get("phase", []):
            if isinstance(p.get("fault"), dict):
                return str(p["fault"].get("phase", "a"))
    return "a"


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
    eta: float = ETA_SIGMA,
    gain_errors: bool = True,
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
            the relative error of efficiency.
        eta: relative standard deviation of the efficiency; gain errors of the electrical sensors
            are added to it.
        gain_errors: whether the filters take gain errors into account; False only where there are
            none.
        step: makes the step of the gas-path filter for its model; its own by default.
        electrical_step: the same of the electrical filters.
        backend: see :func:`apu_casadi.core.backend.compiled`.

    Returns:
        xarray.Dataset on ``time`` (20 ms): for N, the four factors, h_a, h_b, h_c and P_total the
        estimate under its name, ``<name>_sigma`` and ``<name>_true``; ``faulty_phase`` (0: none, 1
        to 3: a to c), ``nis`` of the gas-path filter.  P_total is the mean of the window that ends
        at the instant.  Attributes: ``resets`` of the electrical filter, ``alarms`` and ``onsets``
        of health jumps, s, as JSON.

    Raises:
        DataError, EstimationError: as the two filters.
    """
    apu = Apu() if apu is None else apu
    rng, noise = (None if seed is None else np.random.default_rng([seed, k]) for k in (1, 2))
    t, _ = samples(ds)
    measured = electrical_samples(ds, apu, rng, sensors=electrical_sensors, gains=electrical_gains)
    how: dict[str, Any] = {"gain_errors": gain_errors, "backend": backend}
    also: dict[str, Any] = {"ttsc": ttsc, "step": electrical_step}
    side = electrical_side(apu, electrical_sensors, measured, t, **also, **how)
    for n in gas_gains or {}:
        gas_sensors[n]
    truth = true_readings(gas_sensors, ds)[1]
    read = gas_sensors.measure(truth, noise, gains=gas_gains)
    how |= {"power": power, "eta": eta, "step": step}
    gas, tracked = fused(
        apu,
        [side],
        {n: (t, v) for n, v in read.items()},
        gas_sensors,
        speed=(measured["t"], measured["w_r"]) if speed else None,
        speed_sigma=electrical_sensors.sigma("w_r", float(np.median(measured["w_r"]))),
        efficiency_error=(gas_gains or {}).get("PW", 0.0),
        **how,
    )
    return beside_truth(ds, side, gas, tracked)


def fused(
    apu: Apu,
    sides: Sequence[ElectricalSide],
    readings: Mapping[str, tuple[np.ndarray, np.ndarray]],
    sensors: SensorSet = GAS_PATH,
    *,
    speed: tuple[np.ndarray, np.ndarray] | None = None,
    speed_sigma: float = math.nan,
    power: bool = True,
    efficiency_error: float = 0.0,
    prior: Mapping[str, float] | None = None,
    spread: Prior | None = None,
    inputs: Mapping[str, Any] | None = None,
    eta: float = ETA_SIGMA,
    gain_errors: bool = True,
    step: StepMaker | None = None,
    test: JumpTest = TEST,
    backend: str | None = None,
    max_dt: float = math.inf,
) -> tuple[GasPathFilter, Tracked]:
    """Run the gas-path filter with what the electrical filters say.

    Args:
        apu: the unit as the filters know it.
        sides: of one machine, which stands for both, or of the two, on the same instants.
        readings: ``{name: (t, values)}`` by gas-path sensor.
        sensors: 1-sigma table of the gas path.
        speed: instants and samples of a generator's speed pick-up.
        speed_sigma: standard deviation of each of them.
        power: whether the filter gets the shaft power.
        efficiency_error: actual relative error of the generators' efficiency.
        prior: means of the start by state.
        spread: of which the standard deviations are taken.
        inputs, max_dt: as for :meth:`GasPathFilter.of_readings`.
        test: of jumps of the health.
        eta, gain_errors, step, backend: as for :func:`estimate_joint`.
    """
    gas = _gas_filter(apu, sensors, power, gain_errors, eta)
    t, n = sides[0].t, len(sides)
    # one measurement of shaft power for each window, eq. (1)
    mean = apu.PW(sum(s.P for s in sides) / n) * (1 + efficiency_error)
    sigma = np.sqrt(sum(s.variance for s in sides)) / n / apu.coupling.eta_gtSg
    # the loss that belongs to the error of h, of both machines; the fault is a shunt r_s/h
    machine = apu.generator.machine
    ghost = 2 * machine.V_rated_rms**2 / machine.r_s / machine.eta_sg * H_GAIN
    found_at = {k for s in sides for k in s.found_at}
    new = {float(t[k]): float(np.hypot(sigma[k], ghost) / mean[k]) for k in found_at}
    inputs = dict(inputs or {})
    if "jump_PW" in gas.model.u.names and new:
        inputs["jump_PW"] = (t, jumps_at(t, new))
    mean, sigma = (np.append(v, v[-1]) for v in (mean, sigma))
    data = gas.of_readings(readings, power=(t, mean, sigma), inputs=inputs, max_dt=max_dt)
    if speed is not None:
        rows = np.isfinite(data.y).any(axis=0)
        N, N_sigma = np.zeros(data.size), np.full(data.size, np.inf)
        N[rows], N_sigma[rows] = speed_from_generators(*speed, speed_sigma, data.t[rows], apu)
        data = better_speed(gas, data, N, N_sigma)
    if spread is not None:
        spread.check(gas.model.x)
    start = gas.prior(None if spread is None else spread.sigma, **(prior or {}))
    return gas, track_jumps(gas, data, test=test, prior=start, step=step, backend=backend)


def _gas_filter(
    apu: Apu, sensors: SensorSet, power: bool, gain_errors: bool, eta: float
) -> GasPathFilter:
    common = math.hypot(eta, GAIN_SHARE if gain_errors else 0.0)
    return gas_path_filter(
        apu.gas_generator,
        sensors,
        power="measured" if power else "unknown",
        gains=gain_errors,
        eta=common if power and common else None,
        consider_eta=False,
        power_jumps=bool(power and common),
    )


def beside_truth(
    ds: xr.Dataset, side: ElectricalSide, gas: GasPathFilter, tracked: Tracked
) -> xr.Dataset:
    """Put estimates beside the truth of a run, as :func:`estimate_joint` returns them.

    Args:
        ds: the run.
        side: of one machine; its instants are those of the result.
        gas, tracked: filter and result of the gas path.
    """
    r, t = tracked.result, side.t
    rows, k = (np.searchsorted(v, t + 1e-7) - 1 for v in (ds["time"].values, r.t))
    values: dict[str, Any] = {}
    signals: list[Signal] = []

    def put(n: str, unit: str, doc: str, estimate: Any, s: Any, true: Any) -> None:
        of = {n: doc, f"{n}_sigma": f"standard deviation of {n}", f"{n}_true": f"true: {doc}"}
        signals.extend(Signal(name, unit, text) for name, text in of.items())
        values.update(zip(of, (estimate, s, true), strict=True))

    for name in ("N", *HEALTH):
        x = gas.model.x[name]
        mean, sigma = r[name]
        put(name, x.unit, x.doc, mean[k], sigma[k], ds[name].values[rows])
    true_phase = _phase_of(ds)
    h, h_sigma = side.severities
    for i, phase in enumerate(PHASES):
        m, k_rf = ds["mu"].values[rows], ds["k_rf"].values[rows]
        true = np.where(m > 0, m / (np.nan_to_num(k_rf) + 1 - m), 0.0) * (phase == true_phase)
        doc = f"severity mu/(k_rf + 1 - mu) of a short circuit in phase {phase}"
        put(f"h_{phase}", "1", doc, h[i], h_sigma[i], true)
    P_true = window_means(ds["time"].values, ds["P_total"].values, t)[:-1]
    P = (np.append(np.nan, v) for v in (side.P, np.sqrt(side.variance), P_true))
    put("P_total", "W", "mean mechanical power of both generators over the window before", *P)
    signals += [
        Signal("faulty_phase", "1", "phase found faulty: 0 none, 1 to 3: a to c"),
        Signal("nis", "1", "normalised innovation squared of the gas-path filter"),
    ]
    values |= {"faulty_phase": side.phase, "nis": r.nis[k]}
    at = {
        "resets": side.resets,
        "alarms": [float(r.t[i]) for i in tracked.alarms],
        "onsets": [float(r.t[i]) for i in tracked.onsets],
    }
    attrs = {n: json.dumps(v) for n, v in at.items()}
    return dataset({"time": t}, {"time": values}, signals=signals, attrs=attrs)


# ------------------------------------------------------------------------------ cross-talk


@dataclass(frozen=True)
class JointCase:
    """Errors of sensors and efficiency drawn for one seed."""

    gas_gains: dict[str, float]
    electrical_gains: dict[str, float]


def joint_case(seed: int, *, electrical: bool = True) -> JointCase:
    """Draw the gain errors of a seed from the sensor sets, and the error of efficiency."""
    rng = np.random.default_rng([seed, 0])
    gas = GAS_PATH.draw_gains(rng, GAS_PATH.uncertain)
    gas["PW"] = ETA_SIGMA * float(rng.standard_normal())
    gains = ELECTRICAL.draw_gains(rng, GAIN_SENSORS)
    return JointCase(gas, gains if electrical else {})


def cross_talk(
    ds: xr.Dataset, seeds: Sequence[int], *, fault: float = 10.0, gas_fault: float = 6.0
) -> dict[str, Any]:
    """How much of a short circuit is taken for a gas-path fault, and the other way round.

    Args:
        ds: a joint run with a gas-path fault and, later, a short circuit.
        seeds: of gain errors and noise.
        fault, gas_fault: instants of the two, s.

    Returns:
        By estimator (``coupled``; ``healthy machine``: no short circuit in the electrical filter;
        ``no power``): mean and RMS over the seeds of the change of each factor from 1 s before the
        short circuit to 3 s after it, and alarms within the 3 s; the same of h over the gas-path
        fault; RMSE of the factors, and RMS of error over claimed sigma, at the end of each phase.
    """
    variants: dict[str, dict[str, Any]] = {
        "coupled": {},
        "healthy machine": {"ttsc": False},
        "no power": {"power": False},
    }
    out: dict[str, Any] = {"seeds": len(seeds)}
    for name, options in variants.items():
        change, h_change, error, z, alarms, h_alarms = [], [], [], [], 0, 0
        for seed in seeds:
            case = joint_case(seed)
            e = estimate_joint(
                ds,
                seed,
                gas_gains=case.gas_gains,
                electrical_gains=case.electrical_gains,
                **options,
            )
            t = e["time"].values
            k0, k1 = (int(np.searchsorted(t, v - 1e-9)) for v in (fault, fault + 3.0))
            k = np.array([int(np.searchsorted(t, v - 1e-9)) for v in (2.0, gas_fault, fault)])
            k = np.append(k, t.size - 1)
            factors = np.array([e[n].values for n in HEALTH])
            true = np.array([e[f"{n}_true"].values for n in HEALTH])
            change.append(factors[:, k1] - factors[:, k0])
            error.append((factors - true)[:, k])
            sigma = np.array([e[f"{n}_sigma"].values for n in HEALTH])
            z.append(((factors - true) / sigma)[:, k])
            raised = np.array(json.loads(e.attrs["alarms"]))
            alarms += int(((raised > fault) & (raised <= fault + 3)).sum())
            before = e["faulty_phase"].values[: k0 + 1]
            h_alarms += int((before > 0).any())
            g0, g1 = (int(np.searchsorted(t, v - 1e-9)) for v in (gas_fault, gas_fault + 1.0))
            h = np.array([e[f"h_{p}"].values for p in PHASES])
            h_change.append(np.abs(h[:, g0 : g1 + 1] - h[:, [g0]]).max())
        c, E = np.array(change), np.array(error)
        out[name] = {
            "change_mean": dict(zip(HEALTH, c.mean(0).tolist(), strict=True)),
            "change_rms": dict(zip(HEALTH, np.sqrt((c**2).mean(0)).tolist(), strict=True)),
            "health_alarms_after_short_circuit": alarms,
            "short_circuits_reported_before": h_alarms,
            "h_change_at_gas_fault": float(np.max(h_change)),
            "rmse_at_ends": np.sqrt((E**2).mean(0)).tolist(),
            "z_rms_at_ends": np.sqrt((np.array(z) ** 2).mean(0)).tolist(),
        }
    return out
