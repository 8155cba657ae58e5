"""Fits of the gas generator to recorded or simulated data, and how honest their intervals are.

The fitted model is the gas generator with its thermodynamic unknowns lifted, health factors and
sensor gains as parameters, and fuel flow and shaft power as inputs that were *measured*, each
sample with its noise.  An input that was not measured is left open: its standard deviation is
``OPEN`` times its magnitude, which tells nothing.

:func:`coverage` counts how often 95 % intervals hold the truth (goal: 93 to 97 % of 500 fits).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError, EstimationError, ParameterError, nearest
from apu_casadi.core.sharing import keep, kept, once
from apu_casadi.core.simulation import stepper
from apu_casadi.gaspath.conditions import AMBIENT, DEFAULT_DAY
from apu_casadi.gaspath.cyclefunctions import CycleFunctions
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.unit.control import GovernorParameters
from apu_casadi.unit.exchange import moved
from estimators.apu.sensors import GAS_PATH, Sensor, SensorSet
from estimators.batch.fit import FitProblem
from estimators.batch.fitresult import FitResult
from estimators.information.consistency import coverage as shares_covered
from estimators.models.filtermodel import (
    FilterModel,
    measure,
    measured_inputs,
)
from estimators.models.lifting import Lifted, lift
from estimators.models.recording import Recording, plain_numbers, record
from estimators.models.sensorerrors import biases, gains, lagging

__all__ = [
    "AMBIENT",
    "HEALTH",
    "INPUTS",
    "EngineData",
    "EngineFit",
    "coverage",
    "engine_model",
    "fit_engine",
    "words",
]

OUTPUTS = GAS_PATH.outputs
INPUTS = tuple(n for n in GAS_PATH.names if n not in OUTPUTS)
OPEN = 10.0  # standard deviation of an input that is not measured, of its magnitude: tells nothing
SMOOTH = 0.4  # s; readings are averaged over this to find the noise that is relative to them
MAX_DT = 0.2  # s; the model takes one step from sample to sample


def words(name: str) -> str:
    """Return what a parameter is, in words."""
    base = name.partition("[")[0]
    if base in HEALTH:
        return GasGenerator.THETA[base].doc.removesuffix(" factor")
    kind, _, sensor = base.partition("_")
    return {"gain": f"gain of the {sensor} sensor", "bias": f"bias of the {sensor} sensor"}[kind]


@once
def _engine() -> GasGenerator:
    return GasGenerator()


@kept
def engine_model(
    gg: GasGenerator,
    outputs: tuple[str, ...],
    *,
    gain: tuple[str, ...] = (),
    bias: tuple[str, ...] = (),
    steady: bool = False,
    sensors: tuple[Sensor, ...] = (),
) -> Lifted:
    """Return the lifted model of an engine for fits.

    Args:
        outputs: measured outputs besides fuel flow and power.
        gain, bias: those whose sensors have an unknown gain error or bias.
        steady: every sample is an operating point, where no lag shows.
        sensors: those of the outputs that are no outputs of the engine themselves.
    """
    which = outputs, gain, bias, steady, sensors
    made = keep(gg.family, engine_model, which, lambda: _family_model(gg.family, *which))
    return made.unit(made.model.unit(gg.state_space))


def _family_model(
    family: CycleFunctions,
    outputs: tuple[str, ...],
    gain: tuple[str, ...],
    bias: tuple[str, ...],
    steady: bool,
    sensors: tuple[Sensor, ...],
) -> Lifted:
    """The lifted model of all engines of a family, its numbers among the parameters."""
    own = {s.name: s for s in sensors}
    units = {s.name: s.unit for s in GasGenerator.Y}

    def read(m: FilterModel) -> FilterModel:
        of = [own.get(n) or Sensor(n, 0.0, False, 0.0, units[n], "") for n in outputs]
        return lagging(m, [(s.signal, s.expression, s.reads, 0.0 if steady else s.tau) for s in of])

    def build(m: FilterModel) -> FilterModel:
        m = measured_inputs(read(m) if own else measure(m, outputs), INPUTS)
        m = gains(m, gain) if gain else m
        return biases(m, bias) if bias else m

    return lift(family.state_space, build, equations=family.equations, steady=steady)


# ------------------------------------------------------------------------------ data


@dataclass(frozen=True, eq=False)
class EngineData:
    """Readings of one run, SI; NaN where there is none.

    Args:
        name: for messages.
        t: instants, s; or the number of the point where points are steady.
        readings: measured outputs and inputs by name, each of shape (K,).
        ambient: altitude (m), Mach, dT_isa (K), war (kg/kg); numbers or arrays (K,).
    """

    name: str
    t: np.ndarray
    readings: Mapping[str, np.ndarray]
    ambient: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        """Take masked values as gaps; refuse dates, text and truth values.

        Raises:
            DataError: what is no number, with the name.
        """
        object.__setattr__(self, "t", plain_numbers(self.t, f"{self.name}: t"))
        clean = {
            n: plain_numbers(v, f"{self.name}: {n}", gaps=True) for n, v in self.readings.items()
        }
        object.__setattr__(self, "readings", clean)


def _level(t: np.ndarray, v: np.ndarray, steady: bool) -> np.ndarray:
    """Readings without most of their noise, gaps filled: weights must not follow the noise."""
    there = np.isfinite(v)
    full = np.interp(t, t[there], v[there])
    if steady or t.size < 3:
        return np.asarray(full)
    half = max(1, round(SMOOTH / 2 / float(np.median(np.diff(t)))))
    sums = np.concatenate([[0.0], np.cumsum(full)])
    k = np.arange(t.size)
    lo, hi = np.maximum(k - half, 0), np.minimum(k + half + 1, t.size)
    return np.asarray((sums[hi] - sums[lo]) / (hi - lo))


def to_recording(
    gg: GasGenerator,
    lifted: Lifted,
    data: EngineData,
    sensors: SensorSet = GAS_PATH,
    *,
    averaged: int = 1,
) -> Recording:
    """Turn readings into a recording of the fitted model.

    Args:
        averaged: each reading is the mean of that many, so that its noise is smaller by the root.

    Raises:
        DataError: nothing is measured, ambient conditions have gaps, or the rows of a transient are
            too far apart.
    """
    t, steady, root = data.t, lifted.steady, np.sqrt(averaged)
    gap = np.diff(t).max(initial=0.0)
    if not steady and gap > MAX_DT:
        k = int(np.argmax(np.diff(t)))
        raise DataError(
            f"{data.name}: {gap:.3g} s without a row after t = {t[k]:.6g} s; a transient needs "
            f"rows at most {MAX_DT:g} s apart: split it there into two files, or fit steady points"
        )

    def sigma(name: str, v: np.ndarray) -> np.ndarray:
        return np.asarray(sensors.sigma(name, _level(t, v, steady)) / root * np.ones(v.size))

    outputs, noise = {}, {}
    for name in lifted.model.y.names:
        v = data.readings.get(name)
        if v is not None and np.isfinite(v).any():
            outputs[name] = (t, v)
            noise[name] = sigma(name, v)
    if not outputs:
        raise DataError(
            f"{data.name}: none of {', '.join(lifted.model.y.names)} is measured: nothing to fit to"
        )
    inputs: dict[str, Any] = {}
    for name in INPUTS:
        v = data.readings.get(name, np.full(t.size, np.nan))
        there = np.isfinite(v)
        design = float(gg.U[name].nominal)
        wide = np.full(t.size, OPEN * design)
        if there.any():
            inputs[name] = (t, np.interp(t, t[there], v[there]))
            inputs[f"sigma_{name}"] = (
                t,
                np.where(there, np.maximum(sigma(name, v), 1e-9 * design), wide),
            )
        else:
            inputs[name], inputs[f"sigma_{name}"] = (t, np.full(t.size, design)), (t, wide)
    for name, value in data.ambient.items():
        a = np.asarray(value, float)
        if not np.isfinite(a).all():
            raise DataError(f"{data.name}: {name} has gaps; ambient conditions are needed always")
        inputs[name] = float(a) if a.ndim == 0 else (t, a)
    p = dict.fromkeys(lifted.model.p.names, 0.0) | dict.fromkeys(HEALTH, 1.0)
    return record(lifted.model, outputs=outputs, sigma=noise, inputs=inputs, p=p)


def _read(lifted: Lifted, r: Recording, name: str) -> np.ndarray:
    """Tell in which samples an input was measured, shape (K,)."""
    sigma = r.u[lifted.model.u.index(f"sigma_{name}")]
    return np.asarray(sigma < 0.999 * OPEN * GasGenerator.U[name].nominal)


# ------------------------------------------------------------------------------ one fit


@dataclass(frozen=True, eq=False)
class EngineFit:
    """A fit with what was put into it.

    Args:
        result: estimates and their uncertainty.
        lifted, recordings: the fitted model, and the data as it takes them.
        names: of the data sets.
    """

    result: FitResult
    lifted: Lifted
    recordings: tuple[Recording, ...]
    names: tuple[str, ...]

    def series(self, r: int) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Return {name: (measured, fitted, residual in sigmas)} of one data set, shapes (K,).

        Inputs that were left open have no measured values.
        """
        rec, fitted = self.recordings[r], self.result.recordings[r]
        model = self.lifted.model
        out = {n: (rec.y[i], fitted.y[i], fitted.residual[i]) for i, n in enumerate(model.y.names)}
        for name in INPUTS:
            v, s = rec.u[model.u.index(name)], rec.u[model.u.index(f"sigma_{name}")]
            w = fitted.w[model.w.index(f"w_{name}")]
            known = _read(self.lifted, rec, name)
            out[name] = (np.where(known, v, np.nan), v - s * w, np.where(known, w, np.nan))
        return out

    def misfit(self) -> dict[str, tuple[float, int]]:
        """Return the rms of the residuals in sigmas, and their number, by sensor."""
        rows: dict[str, list[np.ndarray]] = {}
        for r in range(len(self.recordings)):
            for name, (_, _, e) in self.series(r).items():
                rows.setdefault(name, []).append(e[np.isfinite(e)])
        joined = {n: np.concatenate(v) for n, v in rows.items()}
        return {
            n: (float(np.sqrt(np.mean(e**2))), int(e.size)) for n, e in joined.items() if e.size
        }


def split_names(names: Sequence[str], outputs: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the outputs whose gain, and whose bias, is among the parameters.

    Raises:
        ParameterError: a name that is neither a health factor nor gain or bias of a measured
            output.
    """
    valid = [*HEALTH, *(f"{k}_{n}" for k in ("gain", "bias") for n in outputs)]
    for n in names:
        if n not in valid:
            raise ParameterError(f"cannot fit {n!r} {nearest(n, valid)}")
    return tuple(
        [n.partition("_")[2] for n in names if n.startswith(f"{kind}_")]
        for kind in ("gain", "bias")
    )  # type: ignore[return-value]


def fit_engine(
    data: Sequence[EngineData],
    estimate: Sequence[str] = HEALTH,
    *,
    steady: bool = False,
    sensors: SensorSet = GAS_PATH,
    averaged: int = 1,
    own: Sequence[str] = (),
    fixed: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    consider: Mapping[str, float] | None = None,
    gg: GasGenerator | None = None,
) -> EngineFit:
    """Fit health factors, gains and biases of the gas generator to data.

    Args:
        data: one or several runs of one engine.
        estimate: health factors, ``gain_<output>``, ``bias_<output>``, common to all runs.
        own: gains or biases that each run has for itself.
        steady: each row is an operating point; else the rows follow each other in time.
        sensors: their noise. averaged : readings in each value.
        fixed: values of health factors that are not estimated; 1 without.
        prior, bounds, consider: see :func:`estimators.batch.fit.fit`.

    Raises:
        ParameterError, DataError, EstimationError: see :func:`estimators.batch.fit.fit`.
    """
    gg = gg or _engine()
    there = {n for d in data for n, v in d.readings.items() if np.isfinite(v).any()}
    outputs = tuple(n for n in sensors.names if n in there and n not in INPUTS)
    if not outputs:
        raise DataError(
            f"no measured output with a known sigma (sensors: {', '.join(sensors.names)})"
        )
    every = [*estimate, *own, *(consider or ())]
    gain, bias = split_names(every, outputs)
    own_model = tuple(s.model() for s in sensors.only(outputs).sensors if not s.direct)
    lifted = engine_model(
        gg, outputs, gain=tuple(gain), bias=tuple(bias), steady=steady, sensors=own_model
    )
    recordings = [to_recording(gg, lifted, d, sensors, averaged=averaged) for d in data]
    values = dict(fixed or {})
    split_names(list(values), ())
    clash = sorted(set(values) & set(every))
    if clash:
        raise ParameterError(f"both fixed and fitted: {', '.join(clash)}")
    i = lifted.model.p.indices(list(values))
    for k, r in enumerate(recordings):
        p = r.p.copy()
        p[i] = list(values.values())
        recordings[k] = dataclasses.replace(r, p=p)
    problem = FitProblem(
        lifted, [r.size for r in recordings], estimate, own=own, consider=tuple(consider or ())
    )
    result = problem.solve(recordings, prior=prior, bounds=bounds, consider=consider)
    # an input left open is an unknown without a reading
    unread = sum(int((~_read(lifted, r, n)).sum()) for r in recordings for n in INPUTS)
    result = dataclasses.replace(result, freedom=result.freedom - unread)
    return EngineFit(result, lifted, tuple(recordings), tuple(d.name for d in data))


# ------------------------------------------------------------------------------ coverage

POWERS = (100e3, 175e3, 250e3, 325e3, 400e3)  # W; the steady points of the study
READINGS = 25  # of each sensor at each steady point, half a second at 20 ms
STEP = (150e3, 350e3)  # W; before and after the load step of the transient
ENGINES = 10  # with different health; the fits share them evenly
SPREAD = 0.03  # health factors are uniform in 1 -+ this


def _healths(seed0: int) -> np.ndarray:
    rng = np.random.default_rng([seed0, 0])
    return rng.uniform(1 - SPREAD, 1 + SPREAD, (ENGINES, len(HEALTH)))


def steady_truth(gg: GasGenerator, theta: np.ndarray) -> EngineData:
    """Steady points of a true engine at rated speed, by the trim solver; no noise."""
    points = [
        trim_gas_generator(
            gg, {"N": gg.parameters.N, "PW": PW}, theta=dict(zip(HEALTH, theta, strict=True))
        )
        for PW in POWERS
    ]
    readings = {n: np.array([p[n] for p in points]) for n in (*OUTPUTS, *INPUTS)}
    return EngineData("steady", np.arange(len(points), dtype=float), readings, dict(DEFAULT_DAY))


def transient_truth(
    gg: GasGenerator, theta: np.ndarray, *, K: int = 100, dt: float = 0.02
) -> EngineData:
    """A governed load step of a true engine, integrated by CVODES; no noise.

    Fuel flow is the sampled governor's and is held over each step, as is power.
    """
    ss, par = gg.state_space, GovernorParameters()
    start = trim_gas_generator(
        gg, {"N": gg.parameters.N, "PW": STEP[0]}, theta=dict(zip(HEALTH, theta, strict=True))
    )
    run = stepper(ss, 1, rtol=1e-9, atol=1e-11)
    x, x_gov = start.x.copy(), par.start(float(start["Wf"]))
    t, rows = np.arange(K) * dt, []
    for k in range(K):
        PW = STEP[0] if t[k] < 0.3 else STEP[1]
        Wf, moves = par.law(float(x[0]), gg.parameters.N, x_gov)
        u = ss.u.pack({"Wf": Wf, "PW": PW})
        y = ss.y.unpack(np.array(ss.g(x, u, theta)).ravel())
        rows.append([y[n] for n in (*OUTPUTS, *INPUTS)])
        x = run(x, u, theta, dt).x_end
        x_gov = moved(x_gov, dt, moves)
    values = np.array(rows).T
    readings = dict(zip((*OUTPUTS, *INPUTS), values, strict=True))
    return EngineData("load step", t, readings, dict(DEFAULT_DAY))


def noisy(
    data: EngineData,
    rng: np.random.Generator,
    *,
    averaged: int = 1,
    gain: Mapping[str, float] | None = None,
    sensors: SensorSet = GAS_PATH,
) -> EngineData:
    """Return the data as sensors would read them; the noise is relative to the true reading."""
    true = data.readings
    read = sensors.measure(true, rng, gains=gain, averaged=averaged, noise_of="true")
    return dataclasses.replace(data, readings=read)


KINDS = ("steady", "transient", "steady, gains considered", "steady, gains ignored")


def coverage(
    n: int = 500,
    *,
    seed0: int = 20_000,
    kind: str = "steady",
    level: float = 0.95,
    build: bool | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Count how often intervals of the four health factors hold the truth.

    Args:
        n: fits, each with fresh noise; fit i has the generator ``[seed0, 1, i]``.
        kind: ``steady`` (five loads, rated speed, 25 readings each), ``transient`` (a governed load
            step, 2 s at 20 ms), or steady points read with random gain errors of the sensors'
            table, which the fit considers or ignores.
        build: compile the derivatives; by default for the transient, where it pays.
        progress: called with (done, total) after each fit.

    Returns:
        dict: ``rows``, one for each factor, with covered fraction and its 95 % binomial interval
        (Clopper and Pearson 1934), rms error over mean standard error, mean error over its standard
        error; ``failed`` fits; mean chi2 and degrees of freedom; seeds and seconds.

    Raises:
        ParameterError: unknown kind.
    """
    if kind not in KINDS:
        raise ParameterError(f"kind {kind!r} {nearest(kind, KINDS)}")
    began = time.perf_counter()
    gg = _engine()
    steady = kind != "transient"
    gained = OUTPUTS[1:] if "gains" in kind else ()
    lifted = engine_model(gg, OUTPUTS, gain=gained, steady=steady)
    considered = {f"gain_{g}": GAS_PATH[g].gain for g in gained} if "considered" in kind else {}
    healths = _healths(seed0)
    truth = [(steady_truth if steady else transient_truth)(gg, th) for th in healths]
    averaged = READINGS if steady else 1
    build, size = (not steady) if build is None else build, [truth[0].t.size]
    problem = FitProblem(lifted, size, HEALTH, consider=tuple(considered), build=build)
    error, sigma = np.full((n, 4), np.nan), np.full((n, 4), np.nan)
    chi2, freedom, failed = [], 0, 0
    for i in range(n):
        rng = np.random.default_rng([seed0, 1, i])
        who = i % ENGINES
        gain = GAS_PATH.draw_gains(rng, gained)
        data = noisy(truth[who], rng, averaged=averaged, gain=gain)
        rec = to_recording(gg, lifted, data, averaged=averaged)
        try:
            r = problem.solve([rec], consider=considered)
        except EstimationError:
            failed += 1
        else:
            error[i], sigma[i] = r.estimate - healths[who], r.sigma
            chi2.append(r.chi2)
            freedom = r.freedom
        if progress is not None:
            progress(i + 1, n)
    # a failed fit covers nothing
    rows = [
        {"name": name, **shares_covered(error[:, j], sigma[:, j], level)}
        for j, name in enumerate(HEALTH)
    ]
    return {
        "kind": kind,
        "n": n,
        "seed0": seed0,
        "level": level,
        "sensors": [*OUTPUTS, *INPUTS],
        "samples": int(truth[0].t.size),
        "engines": ENGINES,
        "rows": rows,
        "failed": failed,
        "mean_chi2": float(np.mean(chi2)) if chi2 else None,
        "freedom": freedom,
        "seconds": time.perf_counter() - began,
    }
