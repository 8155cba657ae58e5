"""The gas-path filter at 20 ms: rotor speed and four health factors from N, P3, T3, T5 and Wf.

The sensors are those of a table (:mod:`estimators.apu.sensors`); with more in it, the filter takes
more.  The states are speed and health factors, the errors of the sensors where they are kept
(gains, and ``gain_PW`` for the generators' uncertain efficiency), the shaft power where it is not
measured, and the states of sensors that lag.
Fuel flow and shaft power are *measured inputs*: their errors enter output and transition of the
same sample, each with the standard deviation that comes with that sample, as an input of its own
(``sigma_Wf``, ``sigma_PW``).  So the electrical filter's power may be good in one window and poor
in the next, and nothing need be assumed of how a load moves.  Without shaft power there is no way
around an assumption: PW is then a random walk.

A health factor walks slowly.  A fault is a jump, which no slow walk follows: the input ``jump``
(standard deviation of a sudden change of all four factors in that step; 0 as a rule) opens the
belief for it, and :func:`~.healthjumps.track_jumps` finds where that is needed, from the
innovations alone.  So may the error of the shaft power (``jump_PW``), where the electrical side
says that it has.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.backend import READY
from apu_casadi.core.errors import DataError, ParameterError
from apu_casadi.core.sharing import Parametric, derived
from apu_casadi.gaspath.conditions import DEFAULT_DAY
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.unit.control import Governor
from estimators.apu.gaspathmodel import (
    DT,
    GOVERNOR,
    LAGGING,
    OUTPUTS,
    engine_function,
    gas_path_model,
    lag_of,
    model_sensors,
)
from estimators.apu.sensorchain import Draws, sampled, spread
from estimators.apu.sensors import GAS_PATH, Sensor, SensorSet
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.filterensemble import lanes_there, run_many
from estimators.filters.filtering import FilterResult, StepMaker, run
from estimators.filters.resuming import Runs
from estimators.models.filtermodel import FilterModel, Unknown
from estimators.models.recording import Recording, record

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "HEALTH_SIGMA",
    "HEALTH_WALK",
    "ITERATED",
    "ITERATIONS",
    "JUMP",
    "N_SIGMA",
    "N_WALK",
    "GasPathFilter",
    "gas_path_filter",
    "jumps_at",
    "null_direction",
    "samples",
    "true_readings",
    "window_means",
]

# Tuned on the seeds TUNED of scenarios.studies.gaspath.course.
HEALTH_SIGMA = 0.02  # prior of each health factor: new to worn engine
HEALTH_WALK = 2e-4  # 1/sqrt(s); 0.1 % in 25 s: slow against a flight, so wear is followed
N_SIGMA = 20.0  # rad/s; prior of speed, 0.5 %
N_WALK = 1.0  # rad/s/sqrt(s); what discretisation and sampling leave after a load drop
PW_PRIOR = (3e5, 2e5)  # W; mean and standard deviation of an unknown shaft power
LOSS_WALK = 500.0  # W/sqrt(s); a severity of 2e-5 in a second
#: Relative, 1/sqrt(s), of a fuel flow that is known through a lag: the governor's law is followed,
#: and what it lacks, limits and another governor, is 7 % in a step.
FUEL_WALK = 0.5
PW_WALK = 1e6  # W/sqrt(s); a load may drop by 280 kW at once, and no less freedom helps the health
MODEL_ERROR = 0.003  # relative; other maps and gas data shift P3 and P5 by 0.1 % from load to load
J_SIGMA = 0.1  # relative; the paper gives no inertia
# Gauss-Newton iterations of an update, and what moves in them.  One is not enough: fuel enters with
# the very error of its reading, so derivatives and innovations of the plain filter are correlated,
# the same way at each sample.  Mean error over sigma at 14 s, known to 0.03 (seeds TUNED_LONG):
# plain, gain_T5 +0.66, f_W_c +0.29, f_eta_t +0.26; two iterations of state and
# error, gain_T5 -0.07, f_W_c -0.22, f_W_t -0.27, since health is then linearised where its own
# sample took it; two of the error alone, none of these beyond 0.09.  Mean NEES at 14 s beyond that
# of an exact filter: 0.45, 0.13, 0.08 of 4; unscented filters, 0.4.  gain_J keeps +0.3 sigma: the
# error of the power shows in no output of its own sample.
ITERATIONS = 2
ITERATED = "noise"
FREE_SIGMA = 0.02  # of a parameter's magnitude
LAG_SIGMA = 0.3  # relative; start of a lagging sensor's state, which the first sample settles
JUMP = 0.03  # standard deviation that a jump of the health factors is met with


@dataclass(frozen=True, eq=False)
class GasPathFilter(Parametric):
    """A gas-path filter: model, sensors, prior; data are made ready by :meth:`recording`.

    Args:
        gg: the gas generator as the filter knows it.
        sensors: what is measured how well.
        model: the filter's model.
        sigma: prior standard deviations by state name.
    """

    gg: GasGenerator
    sensors: SensorSet
    model: FilterModel
    sigma: Mapping[str, float]

    @property
    def known_power(self) -> bool:
        """Whether the shaft power is measured."""
        return "PW" in self.model.u.names

    @derived
    def lagging(self) -> tuple[Sensor, ...]:
        """Sensors with a state of their own."""
        return tuple(s for s in self.sensors.sensors if lag_of(s) in self.model.x and s.tau)

    @derived
    def gains(self) -> tuple[str, ...]:
        """Sensors whose gain error is a state."""
        return tuple(n[5:] for n in self.model.x.names if n.startswith("gain_"))

    @property
    def deciding(self) -> GasPathFilter:
        """The filter by whose innovations is judged: it estimates all errors of sensors.

        One that is considered, a constant, stays in the innovations, which are then not white: an
        offset as large as was stated adds up to an alarm in two seconds, and to an error beyond
        what was stated.  Itself, where none of a sensor is considered; the inertia stays so.
        """
        left = tuple(n for n in self.model.consider if n[5:] not in self.sensors)
        if left == self.model.consider:
            return self
        return dataclasses.replace(self, model=self.model.considering(left))

    def prior(self, spread: Mapping[str, float] | None = None, /, **mean: float) -> Belief:
        """Return the belief before the first sample: healthy, at governed speed.

        Args:
            spread: other standard deviations, by state name.
            mean: other means, by state name.
        """
        means = {"N": self.gg.parameters.N} | dict.fromkeys(HEALTH, 1.0)
        means |= {n: 0.0 for n in self.model.x.names if n.startswith(("gain_", "bias_"))}
        means |= {lag_of(s): s.signal.nominal for s in self.lagging}
        if "Wf" in self.model.x:
            means["Wf"] = self.gg.design.values["Wf"]
        means |= {n: v for n, v in self.gg.held.items() if n in self.model.x}
        if not self.known_power:
            means["PW"] = PW_PRIOR[0]
        if "loss_PW" in self.model.x:
            means["loss_PW"] = 0.0
        return Belief.of(self.model.x, means | mean, {**self.sigma, **(spread or {})})

    def recording(
        self,
        ds: xr.Dataset,
        seed: int | np.random.Generator | None,
        *,
        gains: Mapping[str, float] | None = None,
        power: tuple[np.ndarray, np.ndarray] | None = None,
        ambient: Mapping[str, float] | None = None,
        jumps: Sequence[float] = (),
        power_jumps: Mapping[float, float] | None = None,
    ) -> Recording:
        """Measure a joint run: samples every 20 ms, noise and gain errors added.

        Shaft power of the window from a sample to the next belongs to that sample; it is known
        when the window ends, which is when the filter needs it.

        Args:
            ds: from :func:`apu_casadi.unit.multirate.simulate_joint`; its exchange step must divide
                20 ms.
            seed: of the noise; None adds none (the standard deviations stay as they are).
            gains: actual relative gain errors by sensor.
            power: measured mean shaft power, W, of each window and its standard deviation, shapes
                (K,) or (K - 1,), instead of the sensor set's.
            ambient: altitude, Mach, dT_isa, war; the default day where nothing is given.
            jumps: instants, s, at which the filter is told that the health may have jumped.
            power_jumps: instants, s, and relative standard deviations of a change of ``gain_PW``,
                where that is estimated.

        Raises:
            DataError: the run has no samples 20 ms apart, or lacks a signal; a wrong length.
        """
        t, truth = true_readings(self.sensors, ds)
        how: dict[str, Any] = {"power": power, "ambient": ambient, "jumps": jumps}
        return self._noisy(t, truth, seed, gains=gains, power_jumps=power_jumps, **how)

    def measured(
        self,
        t: np.ndarray,
        truth: Mapping[str, np.ndarray],
        seed: int | np.random.Generator | None,
        *,
        gains: Mapping[str, float] | None = None,
        power: tuple[np.ndarray, np.ndarray] | None = None,
        ambient: Mapping[str, float] | None = None,
        jumps: Sequence[float] = (),
        power_jumps: Mapping[float, float] | None = None,
    ) -> Recording:
        """Measure true samples: as :meth:`recording`, from arrays of what is read, at t.

        Args:
            truth: true values of the outputs that the sensors read, or of their readings under
                names that are no outputs'.
        """
        how: dict[str, Any] = {"power": power, "ambient": ambient, "jumps": jumps}
        shown = self.sensors.true(t, truth)
        return self._noisy(t, shown, seed, gains=gains, power_jumps=power_jumps, **how)

    def _noisy(
        self,
        t: np.ndarray,
        shown: Mapping[str, np.ndarray],
        seed: int | np.random.Generator | None,
        *,
        gains: Mapping[str, float] | None,
        power: tuple[np.ndarray, np.ndarray] | None,
        ambient: Mapping[str, float] | None,
        jumps: Sequence[float],
        power_jumps: Mapping[float, float] | None,
    ) -> Recording:
        """Make the recording of what the sensors would show without errors."""
        rng = np.random.default_rng(seed) if isinstance(seed, int) else seed
        for n in gains or {}:
            self.sensors[n]
        # every sensor draws, so that the noise of one does not hang on what else is used
        reading = self.sensors.measure(shown, rng, gains=gains)
        known = power and (t, _windows(power[0], t.size), _windows(power[1], t.size))
        inputs: dict[str, Any] = {"jump": (t, jumps_at(t, dict.fromkeys(jumps, JUMP)))}
        if power_jumps:
            inputs["jump_PW"] = (t, jumps_at(t, power_jumps))
        streams = {n: (t, v) for n, v in reading.items()}
        return self.of_readings(streams, power=known, inputs=inputs | dict(ambient or {}))

    def of_readings(
        self,
        readings: Mapping[str, tuple[np.ndarray, np.ndarray]],
        *,
        power: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
        inputs: Mapping[str, Any] | None = None,
        max_dt: float = math.inf,
    ) -> Recording:
        """Make the filter's recording from readings as they are, each with its own instants.

        Args:
            readings: ``{name: (t, values)}`` by sensor; what the filter does not take is left out.
            power: instants, shaft power and its standard deviation, instead of the sensor's.
            inputs: others by name, ambient conditions among them, as
                :func:`estimators.models.recording.record` takes them.
            max_dt: longest step of the filter, s.

        Raises:
            DataError: as :func:`estimators.models.recording.record`.
        """
        # what a filter can know: the reading's own standard deviation
        own = {n: tv for n, tv in readings.items() if n in self.sensors}
        sigma = {n: spread(self.sensors[n], *tv) for n, tv in own.items()}
        held: dict[str, Any] = {}
        for n in (n for n in LAGGING if n in self.model.u.names):
            t, v, s = power if n == "PW" and power is not None else (*readings[n], sigma[n])
            held |= {n: (t, v), f"sigma_{n}": (t, s)}
        outputs = {n: readings[n] for n in self.model.y.names if n in readings}
        return record(
            self.model,
            outputs=outputs,
            sigma={n: sigma[n] for n in outputs},
            inputs={**held, **DEFAULT_DAY, **(inputs or {})},
            max_dt=max_dt,
        )

    def run(
        self,
        data: Recording,
        *,
        prior: Belief | None = None,
        iterations: int = ITERATIONS,
        iterated: str = ITERATED,
        step: StepMaker | None = None,
        full: bool = True,
        backend: str | None = None,
    ) -> FilterResult:
        """Filter a recording by the iterated filter, or by another one.

        Args:
            data: the recording.
            prior: belief before the first sample; :meth:`prior` by default.
            iterations, iterated: of the update, see :func:`estimators.filters.ekf.ekf_step`.
            step: makes another filter's step for the model.
            full, backend: see :func:`estimators.filters.filtering.run`.
        """
        of = ekf_step(self.model, iterations, iterated) if step is None else step(self.model)
        return run(of, self.prior() if prior is None else prior, data, full=full, backend=backend)

    def run_each(
        self,
        priors: Sequence[Belief],
        data: Sequence[Recording],
        *,
        backend: str | None = None,
    ) -> list[FilterResult]:
        """Run the iterated filter from several beliefs over a recording each, in lanes if it pays.

        Of results only what a run without ``full`` gives is to be relied on.

        Args:
            priors, data: beliefs before the first samples, and recordings.
            backend: see :meth:`run`; ``"ready"`` takes lanes only if they were compiled before.
        """
        of = ekf_step(self.model, ITERATIONS, ITERATED)
        # the filter itself runs with ``full``: that form is there
        full = backend == READY and not lanes_there(of, len(data))
        return run_many(of, priors, data, full=full, backend=backend)

    def runs(
        self,
        *,
        prior: Belief | None = None,
        step: StepMaker | None = None,
        backend: str | None = None,
    ) -> Runs:
        """Return the filter for recordings that begin alike; arguments as of :meth:`run`."""
        of = ekf_step(self.model, ITERATIONS, ITERATED) if step is None else step(self.model)
        judge = self.deciding
        deciding = None if judge is self else judge.runs(prior=prior, step=step, backend=backend)
        return Runs(of, self.prior() if prior is None else prior, backend, deciding)


def gas_path_filter(
    gg: GasGenerator | None = None,
    sensors: SensorSet = GAS_PATH,
    *,
    power: str = "measured",
    gains: Sequence[str] | bool = True,
    model_error: float = MODEL_ERROR,
    inertia: float | None = J_SIGMA,
    consider_inertia: bool = True,
    eta: float | None = None,
    consider_eta: bool = True,
    health_sigma: float = HEALTH_SIGMA,
    walk: Mapping[str, float] | None = None,
    governed: Governor | None = GOVERNOR,
    power_jumps: bool = False,
    loss: bool = False,
    free: Mapping[str, Unknown] | None = None,
) -> GasPathFilter:
    """Make a gas-path filter.

    Args:
        gg: the gas generator as the filter knows it; the paper's by default.
        sensors: what is measured how well.
        power: ``"measured"`` or ``"unknown"`` shaft power.
        gains: sensors whose constant gain error is estimated with the sensor set's standard
            deviation as prior; True: all but N and PW; False: none, they are believed.
        model_error: relative standard deviation of what maps and gas data are off; added to the
            gain errors, of which it cannot be told.
        inertia: relative standard deviation of the inertia; None: known, as without measured power.
        consider_inertia: it is considered, not estimated: errors in measured power and fuel move
            no rotor, and an estimate takes them for inertia (a third of it in 40 steady seconds).
        eta: relative standard deviation of the generators' efficiency, as the state ``gain_PW``: PW
            as measured is 1 + gain_PW times PW; None: the efficiency is known.
        consider_eta: the efficiency is considered, not estimated.
        health_sigma: prior standard deviation of each health factor.
        walk: random walks by state name, unit of the state per sqrt(s), instead of the usual ones.
        governed: law of the fuel within a step; None: it is held from one reading to the next.
        power_jumps: the error of the shaft power may jump where a recording says so; ``eta`` must
            be estimated then.
        loss: the shaft power may lack the loss of a short circuit: the state ``loss_PW``, W, whose
            standard deviation at the start is 0, and which changes where a recording says so by
            ``jump_loss``.
        free: parameters of the gas generator that are states, by name (``gas_generator.eta_c``,
            ``compressor_map.a_W``); their prior means are those of ``gg``, their standard
            deviations ``FREE_SIGMA`` of the magnitude.

    Raises:
        ParameterError: unknown ``power``, gain, or an efficiency where no power is measured.
        SignalError: unknown parameter in ``free``.
    """
    gg = GasGenerator() if gg is None else gg
    held = _held(sensors, power)
    slow = tuple(sensors[n] for n in held if sensors[n].tau)
    named = (sensors.uncertain if gains else ()) if isinstance(gains, bool) else tuple(gains)
    unknown = [s.name for s in slow] + ["PW"] * (power == "unknown")
    sigma, walks = _spreads(health_sigma, unknown, loss=loss)
    sigma |= {f"gain_{n}": math.hypot(sensors[n].unsure("gain"), model_error) for n in named}
    biased, consider = _offsets(sensors, named, (*sensors.outputs, *held))
    sigma |= {f"bias_{s.name}": s.bias for s in biased}
    walks |= {f"bias_{s.name}": s.drift for s in biased if s.drift}
    factors = _factors(inertia if power == "measured" else None, eta)
    sigma |= {f"gain_{n}": v for n, v in factors.items()}
    asked = {"J": consider_inertia, "PW": consider_eta}
    named, consider = (*named, *factors), (*consider, *[f"gain_{n}" for n in factors if asked[n]])
    lags = [s for s in sensors.sensors if s.tau and (s in slow or s.name not in LAGGING)]
    sigma |= {lag_of(s): LAG_SIGMA * s.signal.nominal for s in lags}
    laws: dict[str, Any] = {"governed": governed, "power_jumps": power_jumps, "loss": loss}
    model = gas_path_model(
        gg,
        power=power,
        gains=named,
        biases=tuple(s.name for s in biased),
        consider=consider,
        walks=tuple((walks | dict(walk or {})).items()),
        sensors=model_sensors(gg, (*sensors.only(sensors.outputs).sensors, *slow)),
        free=tuple((free or {}).items()),
        **laws,
    )
    sigma |= {n: FREE_SIGMA * model.x[n].nominal for n in free or {}}
    return GasPathFilter(gg, sensors, model, sigma)


def _factors(J: float | None, PW: float | None) -> dict[str, float]:
    """Return the relative standard deviations of the factors that are not known."""
    return {n: v for n, v in {"J": J, "PW": PW}.items() if v is not None}


def _held(sensors: SensorSet, power: str) -> tuple[str, ...]:
    """Return the measured inputs of a filter, all of which have a sensor."""
    held = LAGGING if power == "measured" else ("Wf",)
    if missing := [n for n in held if n not in sensors]:
        raise ParameterError(f"a gas-path filter takes {missing[0]} as an input: no sensor of it")
    return held


def _spreads(
    health: float, unknown: Sequence[str], *, loss: bool
) -> tuple[dict[str, float], dict[str, float]]:
    """Return standard deviations at the start and random walks of the states without sensors."""
    sigma = {"N": N_SIGMA} | dict.fromkeys(HEALTH, health)
    walks = {"N": N_WALK} | dict.fromkeys(HEALTH, HEALTH_WALK)
    if "Wf" in unknown:
        sigma["Wf"], walks["Wf"] = (
            by * GasGenerator.U["Wf"].nominal for by in (LAG_SIGMA, FUEL_WALK)
        )
    if "PW" in unknown:
        sigma["PW"], walks["PW"] = PW_PRIOR[1], PW_WALK
    if loss:
        sigma["loss_PW"], walks["loss_PW"] = 0.0, LOSS_WALK
    return sigma, walks


def _offsets(
    sensors: SensorSet, gained: Sequence[str], used: Sequence[str]
) -> tuple[list[Sensor], tuple[str, ...]]:
    """Sensors whose offset is a state, and states that are considered: of gains and offsets."""
    biased = [s for s in sensors.sensors if s.biased and s.name in used]
    consider = [f"gain_{n}" for n in gained if sensors[n].gain_as == "considered"]
    consider += [f"bias_{s.name}" for s in biased if s.bias_as == "considered"]
    return biased, tuple(consider)


def samples(ds: xr.Dataset, dt: float = DT) -> tuple[np.ndarray, np.ndarray]:
    """Return the filter's instants in a run and their positions on its ``time``.

    Raises:
        DataError: the run has no value at a multiple of ``dt``.
    """
    time = np.asarray(ds["time"].values, float)
    t = np.arange(math.floor((time[-1] - time[0]) / dt + 1e-6) + 1) * dt + time[0]
    rows = np.clip(np.searchsorted(time, t - 1e-7), 0, time.size - 1)
    off = np.abs(time[rows] - t)
    if off.max() > 1e-6:
        raise DataError(
            f"the run has no value at t = {t[int(off.argmax())]:.6g} s; its exchange step must "
            f"divide {dt * 1e3:g} ms"
        )
    return t, rows


def true_readings(
    sensors: SensorSet, ds: xr.Dataset, seed: int | None = None
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return the filter's instants in a joint run, and what the sensors would read without errors.

    Each lags and is late as it declares.  The shaft power is the mean of the window from an instant
    to the next, but for one that lags.

    Args:
        sensors: the set.
        ds: the run.
        seed: of the jitter of their instants; None: none.

    Raises:
        DataError: the run has no samples 20 ms apart.
    """
    t, rows = samples(ds)
    time = np.asarray(ds["time"].values, float)
    there = {n: np.asarray(ds[n].values, float) for s in sensors.sensors for n in s.reads}
    of, late = Draws(seed), [s.name for s in sensors.sensors if s.delay or s.jitter]
    truth = {
        n: sampled(sensors[n], time, v, t, of) if n in late else v[rows]
        for n, v in sensors.true(time, there).items()
    }
    if "PW" in sensors and sensors["PW"].tau:
        return t, truth
    delay = sensors["PW"].delay if "PW" in sensors else 0.0
    return t, truth | {"PW": window_means(time, ds["PW"].values, t - delay)}


def window_means(time: np.ndarray, held: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Means over [t(k), t(k+1)] of a quantity that is held over each step before ``time``, (K,).

    The last window has no end; it repeats the one before.
    """
    energy = np.concatenate([[0.0], np.cumsum(held[1:] * np.diff(time))])
    mean = np.diff(np.interp(t, time, energy)) / np.diff(t)
    return np.append(mean, mean[-1])


def jumps_at(t: np.ndarray, sizes: Mapping[float, float]) -> np.ndarray:
    """Size of the jumps in the step from each instant to the next, shape (K,)."""
    jump = np.zeros(t.size)
    for when, size in sizes.items():
        k = int(np.searchsorted(t, when + 1e-9)) - 1  # the step in which it happens
        if not 0 <= k < t.size - 1:
            raise DataError(f"jump at {when:g} s outside [{t[0]:g}, {t[-1]:g}) s")
        jump[k] = size
    return jump


def _windows(values: Any, n: int) -> np.ndarray:
    v = np.asarray(values, float)
    if v.shape not in ((n,), (n - 1,)):
        raise DataError(f"power: {n} or {n - 1} windows expected, got shape {v.shape}")
    return v if v.size == n else np.append(v, v[-1])


def null_direction(filt: GasPathFilter, x: Mapping[str, float], u: Mapping[str, float]) -> Any:
    """Return the unit vector of health that P3, T3 and T5 do not see, at given N and Wf, (4,).

    The three temperatures and pressures give three equations for four factors; the fourth is the
    power balance, which the measured shaft power closes.

    Args:
        filt: the filter.
        x: N and health factors.
        u: Wf and ambient; the default day where nothing is given.
    """
    gg, rows = filt.gg, filt.gg.Y.indices(OUTPUTS[1:])
    v = gg.U.pack({"PW": 0.0, **u})
    theta = gg.THETA.pack({n: x.get(n, 1.0) for n in HEALTH})
    N = np.array([x["N"]])
    full = gg.full(theta)
    z = engine_function(gg.family)(N, v, full)[3]
    y_w = np.asarray(gg.family.sensitivities(N, z, v, full)[3])[rows]
    seen = y_w[:, 1 + len(gg.U) :] / gg.Y.nominals[rows][:, None]
    n = np.linalg.svd(seen)[2][-1]
    return n * np.sign(n[int(np.abs(n).argmax())])
