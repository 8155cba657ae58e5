"""What can be known of the APU from its sensors, before anything is estimated.

Gas path, at steady points: unknown are the four health factors, the true rotor speed and the true
fuel flow; the shaft power follows from 0 = dN/dt.  Ambient conditions are taken as known.  White
noise is that of the sensor table, averaged over ``samples`` of 20 ms; the noise of the shaft power
is not averaged, since the electrical filter's errors last longer than a snapshot.  Efficiency of
the generators (reading of PW over its true value) and gain errors of the sensors are considered:
uncertain, not estimated.
The generator's side is in :mod:`estimators.apu.severity`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import EstimationError, ParameterError, nearest
from apu_casadi.core.sharing import last
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from estimators.apu.gaspathmodel import DT
from estimators.apu.sensors import GAS_PATH, SensorSet
from estimators.filters.belief import Belief
from estimators.information.identifiability import Identifiability, identify
from estimators.information.sensitivities import (
    Sensitivities,
    recording_sensitivities,
    steady_sensitivities,
    together,
)
from estimators.models import filtermodel
from estimators.models.filtermodel import Unknown, augment, discretise, noisy_inputs
from estimators.models.recording import Recording

__all__ = [
    "AIMS",
    "BASE",
    "CANDIDATES",
    "POINTS",
    "condition",
    "findings",
    "gas_path",
    "gas_path_transient",
    "independent_bias",
    "limiting_gains",
    "limiting_noises",
    "needed_samples",
    "shaft_power_snapshot",
    "snapshot_sweep",
    "steady_point",
]

#: Power of the default unit's design point, W, of which the powers of :data:`POINTS` are a share.
RATED = 500e3
#: Steady points by name: shaft power of the default unit, W, and ambient conditions, those of the
#: default day where none are named.  The first two are Tables 4 and 5.  Another engine has the
#: same share of its own power there, see :func:`condition`.
POINTS: dict[str, dict[str, float]] = {
    "design": {"PW": 500e3},
    "offdesign": {"PW": 222e3, "dT_isa": 5.0, "altitude": 8000.0, "Mach": 0.7},
    "partload": {"PW": 222e3},
    "idle": {"PW": 20e3},
}

#: What a gas-path filter has without the generators.
BASE = tuple(n for n in GAS_PATH.names if n != "PW")

#: The sensors of the gas-path table, and some that could be added.
CANDIDATES = GAS_PATH.add("W2", "P5", "T41")

SAMPLES = 50  # of 20 ms: a snapshot of 1 s
PRIOR = 0.02  # standard deviation of each health factor before the snapshot
ETA_BIAS = GAS_PATH["PW"].gain  # of the generators' efficiency: PW is read from the electrical side
#: Least reduction of the health factors' rms standard deviation by shaft power, with a 2 % prior
#: and 1 % power noise: without and with the efficiency bias.
AIMS = {"exact efficiency": 0.50, "efficiency bias": 0.30}
PRIORS = (0.005, 0.0075, 0.01, 0.015, 0.02, 0.03, 0.05, 0.075, 0.1)
POWER_NOISES = (0.0025, 0.005, 0.01, 0.02, 0.05)


# ---------------------------------------------------------------------- gas path


def condition(point: str, gg: GasGenerator) -> dict[str, float]:
    """Return shaft power, W, and ambient conditions of a point of :data:`POINTS` for an engine.

    Raises:
        ParameterError: an unknown point; the nearest is named.
    """
    if point not in POINTS:
        raise ParameterError(f"unknown point {point!r} {nearest(point, POINTS)}")
    at = POINTS[point]
    return {**at, "PW": at["PW"] * (gg.rated_power / RATED)}


@last(16)
def steady_point(point: str, gg: GasGenerator) -> OperatingPoint:
    """Return a point of :data:`POINTS`."""
    conditions: dict[str, Any] = condition(point, gg)
    return trim_gas_generator(gg, {"N": gg.parameters.N, "PW": conditions.pop("PW")}, **conditions)


@last(16)
def _derivatives(point: str, gg: GasGenerator) -> tuple[OperatingPoint, np.ndarray, np.ndarray]:
    """Return the point, dy/d unknown of every output and dPW/d unknown, own units."""
    at = steady_point(point, gg)
    _, y, xdot_w, y_w, _ = (a.full() for a in gg.cycle.sensitivities(at.x, at.z, at.u, at.theta))
    off = float(np.abs(y[:, 0] - [at[n] for n in gg.Y.names]).max())
    if not off < 1e-3:  # own units, mostly Pa and W: rounding of the root finder
        raise EstimationError(
            f"{point}: derivatives belong to another point, outputs {off:.1e} off"
        )
    w = gg.X + gg.U + gg.THETA
    H, follow = steady_sensitivities(
        xdot_w, y_w, w, unknown=["N", "Wf", *gg.THETA.names], solved=["PW"]
    )
    return at, H, follow


def independent_bias(eta_bias: float, shares: Sequence[float]) -> float:
    """Return the standard deviation of the efficiency behind the shaft power of several generators.

    Where the efficiency of each errs on its own, the error of their sum is smaller than where they
    err alike: sqrt(sum s^2)/sum s of it, 0.71 with two equal loads.

    Args:
        eta_bias: of one, relative.
        shares: of each in the power, in any unit.

    Raises:
        ParameterError: no shares, or some that are not positive.
    """
    s = np.asarray(shares, dtype=float)
    if not (s.ndim == 1 and s.size and np.all(np.isfinite(s)) and s.min() > 0):
        raise ParameterError(f"shares of the generators: numbers > 0 expected, got {[*shares]}")
    return float(eta_bias * np.sqrt(np.sum(s**2)) / np.sum(s))


_DEFAULT = GasGenerator()


def gas_path(
    point: str = "design",
    *,
    sensors: SensorSet = CANDIDATES,
    samples: int = SAMPLES,
    prior: float = PRIOR,
    power_noise: float | None = None,
    eta_bias: float = 0.0,
    gain_errors: bool = False,
    gas_generator: GasGenerator | None = None,
) -> Sensitivities:
    """Return the sensitivities of steady gas-path readings.

    Args:
        point: a name of :data:`POINTS`, or several, separated by commas, with the same faults.
        sensors: table of sensors; each must be an output of the gas generator.
        samples: of 20 ms that are averaged; white noise falls with its root, that of PW excepted.
        prior: standard deviation of each health factor before; inf for none.
        power_noise: standard deviation of PW's reading over its value; that of the table by
            default.
        eta_bias: standard deviation of the efficiency with which PW is computed, considered.
        gain_errors: consider the gain errors of the table's other sensors.
        gas_generator: the engine; the paper's by default.

    Raises:
        ParameterError: unknown point or sensor, numbers out of range.
        OperatingPointError: the point does not exist for this engine.
    """
    if not (samples >= 1 and eta_bias >= 0 and prior > 0):
        raise ParameterError(
            f"samples >= 1, prior > 0 and eta_bias >= 0 expected, got {samples!r}, {prior!r}, "
            f"{eta_bias!r}"
        )
    gg = _DEFAULT if gas_generator is None else gas_generator
    names = [p.strip() for p in point.split(",")]
    if len(set(names)) != len(names):
        raise ParameterError(f"a point is given twice: {point}")
    parts = {
        name: _gas_path(name, gg, sensors, samples, prior, power_noise, eta_bias, gain_errors)
        for name in names
    }
    if len(parts) == 1:
        return parts[names[0]]
    first = parts[names[0]]
    constant = [n for n in first.theta.names if n.startswith(("gain_", "bias_"))]
    return together(parts, shared=constant)


def _readings(
    gg: GasGenerator, sensors: SensorSet, at: OperatingPoint
) -> tuple[np.ndarray, np.ndarray]:
    """Readings of sensors at a steady point, where no lag shows, and their derivatives by Y."""
    for s in sensors.sensors:
        if not set(s.reads) <= set(gg.Y.names):
            raise ParameterError(f"sensor {s.name!r} measures no output of the gas generator")
    y = ca.SX.sym("y", len(gg.Y))
    seen = ca.vertcat(*(s.of(gg.Y.unpack(y)) for s in sensors.sensors))
    values = np.array([at[n] for n in gg.Y.names])
    read, along = ca.Function("readings", [y], [seen, ca.jacobian(seen, y)])(values)
    return read.full().ravel(), along.full()


def _gas_path(
    point: str,
    gg: GasGenerator,
    sensors: SensorSet,
    samples: int,
    prior: float,
    power_noise: float | None,
    eta_bias: float,
    gain_errors: bool,
) -> Sensitivities:
    at, H, _ = _derivatives(point, gg)
    y, along = _readings(gg, sensors, at)
    sigma = np.array([sensors.sigma(n, v) for n, v in zip(sensors.names, y, strict=True)])
    # of a slower sensor fewer are averaged
    share = [min(1.0, s.rate * DT) if s.rate else 1.0 for s in sensors.sensors]
    sigma /= np.sqrt(samples * np.array(share))
    if "PW" in sensors.names:
        i = sensors.names.index("PW")
        sigma[i] = sensors.sigma("PW", y[i]) if power_noise is None else power_noise * abs(y[i])
    signals = [
        Signal("N", "rad/s", "true rotor speed", nominal=at["N"]),
        Signal("Wf", "kg/s", "true fuel flow", nominal=at["Wf"]),
        *(Signal(s.name, s.unit, s.doc) for s in gg.THETA),
    ]
    priors = dict.fromkeys(gg.THETA.names, prior)
    columns = [along @ H]
    gains = {
        s.name: (eta_bias if s.name == "PW" else s.unsure("gain") if gain_errors else 0.0)
        for s in sensors.sensors
    }
    for i, (name, gain) in enumerate(gains.items()):
        if gain > 0:
            what = "efficiency of the generators" if name == "PW" else f"gain error of {name}"
            signals.append(Signal(f"gain_{name}", "1", what))
            priors[f"gain_{name}"] = gain
            columns.append(np.eye(len(y))[:, [i]] * y[i])
    for i, s in enumerate(sensors.sensors):
        if gain_errors and s.unsure("bias") > 0:
            signals.append(Signal(f"bias_{s.name}", s.unit, f"offset of {s.name}"))
            priors[f"bias_{s.name}"] = s.bias
            columns.append(np.eye(len(y))[:, [i]])
    return Sensitivities.of(
        Signals(signals),
        sensors.names,
        np.hstack(columns),
        sigma,
        faults=gg.THETA.names,
        prior=priors,
    )


#: Of the transient: s from the start of the ramp to its end, and proportional fuel control that
#: keeps the speed near its reference, kg/s per rad/s.
RAMP, FUEL_GAIN = 2.0, 2e-5
UNKNOWN_PW = 1e8  # W; standard deviation of a shaft power that nobody measures, at every sample


def gas_path_transient(
    *,
    power: bool,
    seconds: float = 5.0,
    from_power: float | None = None,
    to_power: float | None = None,
    power_noise: float = GAS_PATH["PW"].noise,
    prior: float = PRIOR,
    sensors: SensorSet = GAS_PATH,
    backend: str | None = None,
    gas_generator: GasGenerator | None = None,
) -> Sensitivities:
    """Return what a recording through a load ramp tells of the four health factors.

    The truth is healthy and on the ground; samples every 20 ms of N, P3, T3, T5 and Wf; readings of
    Wf and PW are inputs with white noise.  The rotor's acceleration is then a measurement of the
    power balance.

    Args:
        power: whether PW is measured; otherwise it is unknown at every sample.
        seconds, from_power, to_power: length, s; the shaft power ramps in :data:`RAMP` s, W; by
            default from the point ``partload`` to ``design``.
        power_noise: standard deviation of PW over its value, white from sample to sample.
        prior: standard deviation of each health factor before.
        sensors: the sensor table.
        backend: see :func:`apu_casadi.core.backend.compiled`.
        gas_generator: the engine; the paper's by default.

    Raises:
        OperatingPointError, EstimationError: the engine does not run, or is lost, on the way.
    """
    gg = gas_generator or _DEFAULT
    ss = gg.state_space
    dt, K = 0.02, round(seconds / 0.02)
    t = dt * np.arange(K)
    if from_power is None:
        from_power = condition("partload", gg)["PW"]
    if to_power is None:
        to_power = condition("design", gg)["PW"]
    PW = from_power + (to_power - from_power) * np.clip((t - 0.5) / RAMP, 0, 1)
    ends = [trim_gas_generator(gg, {"N": gg.parameters.N, "PW": P}) for P in (from_power, to_power)]
    Wf = np.interp(PW, [from_power, to_power], [e["Wf"] for e in ends])
    noise = {"Wf": sensors["Wf"].noise * ends[1]["Wf"]}
    noise["PW"] = power_noise * to_power if power else UNKNOWN_PW
    model = filtermodel.measure(discretise(ss), GAS_PATH.outputs)
    model = augment(noisy_inputs(model, noise), {n: Unknown() for n in gg.THETA.names})
    x = np.ones((len(model.x), K))
    x[0, 0] = ends[0]["N"]
    u = np.empty((len(model.u), K))
    at, z = ends[0].x, ends[0].z
    theta = np.ones(len(gg.THETA))
    for k in range(K):
        fuel = float(Wf[k]) + FUEL_GAIN * (gg.parameters.N - float(at[0]))
        u[:, k] = gg.U.pack({"Wf": fuel, "PW": float(PW[k])})
        x[0, k] = at[0]
        if k + 1 < K:
            at, _, z = gg.advance(at, u[:, k], theta, z, dt)
    names = model.y.names
    sigma = np.array([sensors.sigma(n, ends[1][n]) for n in names])
    data = Recording(
        t, u, np.zeros((len(names), K)), np.repeat(sigma[:, None] ** 2, K, axis=1), np.zeros(0)
    )
    start = Belief(model.x, x[:, 0], np.diag([100.0**2, 0, 0, 0, 0]))
    found = recording_sensitivities(model, gg.THETA.names, start, data, x, backend=backend)
    return found.with_prior(dict.fromkeys(gg.THETA.names, prior))


# ---------------------------------------------------------------------- shaft power


def shaft_power_snapshot(
    point: str = "design",
    *,
    prior: float = PRIOR,
    power_noise: float = GAS_PATH["PW"].noise,
    eta_bias: float = 0.0,
    samples: int = SAMPLES,
    gain_errors: bool = False,
    gas_generator: GasGenerator | None = None,
) -> dict[str, Any]:
    """Return how much measured shaft power reduces the health factors' standard deviations.

    Without PW the readings leave one combination of f_W_c, f_eta_t and f_W_t wholly to the prior,
    the *null direction*.

    Returns:
        dict: the arguments; ``before`` and ``after``, standard deviations of the four factors by
        name; ``reduction`` of their rms, ``reduction_of`` each; ``null`` the null direction by
        name, of length 1, and ``null_before``, ``null_after`` the standard deviations along it.

    Raises:
        ParameterError: numbers out of range.
    """
    how: dict[str, Any] = {"sensors": GAS_PATH, "samples": samples, "prior": prior}
    how["gas_generator"] = gas_generator
    errors: dict[str, Any] = {"power_noise": power_noise, "eta_bias": eta_bias}
    g = gas_path(point, **how, **errors, gain_errors=gain_errors)
    without = g.only(BASE)
    C0, C1 = without.covariance(), g.covariance()
    # with gain errors considered it is no longer exactly invisible: take it without them
    plain = gas_path(point, **how).only(BASE)
    v = np.linalg.svd(plain.signatures())[2][-1]
    v = v * np.sign(v[np.abs(v).argmax()])
    s0, s1 = np.sqrt(np.diag(C0)), np.sqrt(np.diag(C1))
    return {
        "point": point,
        "prior": prior,
        "power_noise": power_noise,
        "eta_bias": eta_bias,
        "samples": samples,
        "gain_errors": gain_errors,
        "before": dict(zip(g.faults, s0.tolist(), strict=True)),
        "after": dict(zip(g.faults, s1.tolist(), strict=True)),
        "rms_before": float(np.sqrt(np.mean(s0**2))),
        "rms_after": float(np.sqrt(np.mean(s1**2))),
        "reduction": float(1 - np.sqrt((s1**2).sum() / (s0**2).sum())),
        "reduction_of": dict(zip(g.faults, (1 - s1 / s0).tolist(), strict=True)),
        "null": dict(zip(g.faults, v.tolist(), strict=True)),
        "null_before": float(np.sqrt(v @ C0 @ v)),
        "null_after": float(np.sqrt(v @ C1 @ v)),
    }


#: Curves of the sweep: what is changed against 1 s, 1 % power noise, exact efficiency.
VARIANTS: dict[str, dict[str, Any]] = {
    "exact efficiency": {},
    "efficiency bias": {"eta_bias": ETA_BIAS},
    "gain errors too": {"eta_bias": ETA_BIAS, "gain_errors": True},
    "one 20 ms sample": {"samples": 1},
}


def snapshot_sweep(
    point: str = "design",
    *,
    priors: Sequence[float] = PRIORS,
    power_noises: Sequence[float] = POWER_NOISES,
    variants: Mapping[str, Mapping[str, Any]] | None = None,
) -> list[dict[str, Any]]:
    """Return :func:`shaft_power_snapshot` over priors, power noises and variants, with a label.

    Raises:
        ParameterError: numbers out of range.
    """
    chosen = VARIANTS if variants is None else variants
    return [
        {"variant": label, **shaft_power_snapshot(point, prior=prior, power_noise=noise, **options)}
        for label, options in chosen.items()
        for noise in power_noises
        for prior in priors
    ]


def limiting_gains(point: str = "design", **options: Any) -> dict[str, float]:
    """Return the reduction when one sensor alone has a gain error, by that sensor's name.

    ``options`` are those of :func:`shaft_power_snapshot`; the efficiency bias is as given there.
    """
    options = {"prior": PRIOR, "samples": SAMPLES, **options}
    out = {}
    for sensor in GAS_PATH.sensors:
        if sensor.name == "PW" or not sensor.gain > 0:
            continue
        one = SensorSet(
            tuple(
                s if s.name == sensor.name else dataclasses.replace(s, gain=0.0)
                for s in GAS_PATH.sensors
            )
        )
        g = gas_path(point, sensors=one, gain_errors=True, **options)
        before, after = np.trace(g.only(BASE).covariance()), np.trace(g.covariance())
        out[sensor.name] = float(1 - math.sqrt(after / before))
    return out


def limiting_noises(point: str = "design", **options: Any) -> dict[str, float]:
    """Return the reduction from one sample if one sensor had (almost) no noise, by its name.

    ``options`` are those of :func:`gas_path`.
    """
    out = {}
    for name in BASE:
        sensors = GAS_PATH.change(**{name: 1e-6})
        g = gas_path(point, sensors=sensors, samples=1, **options)
        before, after = np.trace(g.only(BASE).covariance()), np.trace(g.covariance())
        out[name] = float(1 - math.sqrt(after / before))
    return out


def needed_samples(aim: float, point: str = "design", **options: Any) -> int | None:
    """Return the least number of averaged samples with which the reduction reaches an aim.

    None if no averaging does: the limit is then not the white noise.  ``options`` are those of
    :func:`shaft_power_snapshot`.

    Raises:
        ParameterError: numbers out of range.
    """

    def reached(samples: int) -> bool:
        return bool(shaft_power_snapshot(point, samples=samples, **options)["reduction"] >= aim)

    low, high = 1, 1_000_000
    if not reached(high):
        return None
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if reached(middle) else (middle + 1, high)
    return low


def findings(point: str, sensors: Sequence[str], **options: Any) -> Identifiability:
    """Return what some sensors can know at a point; options are those of :func:`gas_path`.

    Raises:
        ParameterError: unknown point. SignalError : unknown sensor.
    """
    return identify(gas_path(point, **options), sensors)
