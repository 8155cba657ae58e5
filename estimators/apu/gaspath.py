"""The gas-path filter at 20 ms: rotor speed and four health factors from N, P3, T3, T5 and Wf.

The states are speed and health factors, the errors of the sensors where they are kept (gains, and
``gain_PW`` for the generators' uncertain efficiency), and the shaft power where it is not measured.
Fuel flow and shaft power are *measured inputs*: their errors enter output and transition of the
same sample, each with the standard deviation that comes with that sample, as an input of its own
(``sigma_Wf``, ``sigma_PW``).  So the electrical filter's power may be good in one window and poor
in the next, and nothing need be assumed of how a load moves.  Without shaft power there is no way
around an assumption: PW is then a random walk.

A health factor walks slowly.  A fault is a jump, which no slow walk follows: the input ``jump``
(standard deviation of a sudden change of all four factors in that step; 0 as a rule) opens the
belief for it, and :func:`track_jumps` finds where that is needed, from the innovations alone.  So
may the error of the shaft power (``jump_PW``), where the electrical side says that it has.

How the model is made cheap: the cycle is solved once for each evaluation, and its derivatives are
those of the implicit function theorem at the solution (:attr:`Cycle.sensitivities`), not of the
iteration.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from scipy.stats import chi2

from apu_casadi.core.errors import DataError, EstimationError, ParameterError, nearest
from apu_casadi.core.sharing import Parametric, derived, kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.conditions import AMBIENT, DEFAULT_DAY
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.unit.control import Governor, GovernorParameters
from estimators.apu.sensors import GAS_PATH, SensorSet
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.filtering import FilterResult
from estimators.models.filtermodel import FilterModel
from estimators.models.recording import Recording, record

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "DT",
    "HEALTH",
    "GasPathFilter",
    "JumpTest",
    "Tracked",
    "engine_function",
    "gas_path_filter",
    "gas_path_model",
    "null_direction",
    "track_jumps",
]

DT = 0.02  # s; step of the gas-path filter (paper, section 3.3)
HEALTH = GasGenerator.THETA.names
OUTPUTS = ("N", "P3", "T3", "T5")
GAINED = ("P3", "T3", "T5", "Wf")
POWER = ("measured", "unknown")
GOVERNOR = GovernorParameters()

# Tuned on the seeds TUNED of gaspath_study.
HEALTH_SIGMA = 0.02  # prior of each health factor: new to worn engine
HEALTH_WALK = 2e-4  # 1/sqrt(s); 0.1 % in 25 s: slow against a flight, so wear is followed
N_SIGMA = 20.0  # rad/s; prior of speed, 0.5 %
N_WALK = 1.0  # rad/s/sqrt(s); what discretisation and sampling leave after a load drop
PW_PRIOR = (3e5, 2e5)  # W; mean and standard deviation of an unknown shaft power
PW_WALK = 1e6  # W/sqrt(s); a load may drop by 280 kW at once, and no less freedom helps the health
MODEL_ERROR = 0.003  # relative; other maps and gas data shift P3 and P5 by 0.1 % from load to load
J_SIGMA = 0.1  # relative; the paper gives no inertia
# Gauss-Newton iterations of an update, and what moves in them.  One is not enough: fuel enters with
# the very error of its reading, so derivatives and innovations of the plain filter are correlated,
# the same way at each sample.  Mean error over sigma at 14 s, known to 0.03 (seeds TUNED_LONG of
# gaspath_study): plain, gain_T5 +0.66, f_W_c +0.29, f_eta_t +0.26; two iterations of state and
# error, gain_T5 -0.07, f_W_c -0.22, f_W_t -0.27, since health is then linearised where its own
# sample took it; two of the error alone, none of these beyond 0.09.  Mean NEES at 14 s beyond that
# of an exact filter: 0.45, 0.13, 0.08 of 4; unscented filters, 0.4.  gain_J keeps +0.3 sigma: the
# error of the power shows in no output of its own sample.
ITERATIONS = 2
ITERATED = "noise"
JUMP = 0.03  # standard deviation that a jump of the health factors is met with


# ------------------------------------------------------------------------------ the model


@kept
def engine_function(gg: GasGenerator) -> ca.Function:
    """The cycle as Function (N, u, theta) -> (xdot, y, check, z) with exact, cheap derivatives.

    ``y`` are P3, T3, T5.  The Jacobian is handed the solved z, so it costs no second solution.
    """
    c = gg.cycle
    rows = gg.Y.indices(OUTPUTS[1:])
    x, _, u, theta = c.symbols()
    z = c.solve(c.similar(x, u), x, u, theta)
    ode, alg, y = c.equations(x, z, u, theta)
    made = {"xdot": ode, "y": y[rows], "check": ca.norm_1(alg), "z": z}
    given = {"x": x, "u": u, "theta": theta}
    nominal = {f"out_{k}": ca.MX.sym(k, *v.shape) for k, v in made.items()}
    _, _, xdot_w, y_w, z_w = c.sensitivities(x, nominal["out_z"], u, theta)
    width = [len(gg.X), len(gg.U), len(gg.THETA)]
    ends = np.cumsum([0, *width]).tolist()
    whole = [xdot_w, y_w[rows, :], ca.MX(1, ends[-1]), z_w]
    blocks = [d[:, i:j] for d in whole for i, j in pairwise(ends)]
    jac = ca.Function(
        "jac_gas_path", [*given.values(), *nominal.values()], blocks, [*given, *nominal],
        [f"jac_{o}_{i}" for o in made for i in given],
    )  # fmt: skip
    # forward and reverse derivatives are made from the Jacobian above
    options = {
        "custom_jacobian": jac, "jac_penalty": 0,
        "enable_forward": False, "enable_reverse": False, "enable_fd": False,
    }  # fmt: skip
    return ca.Function("gas_path", [*given.values()], [*made.values()], [*given], [*made], options)


def _relative(name: str, doc: str, default: float | None = 0.0) -> Signal:
    return Signal(name, "1", doc, default=default, nominal=0.01)


_GAIN_DOCS = {
    "PW": "relative error of the shaft power that the generators' efficiency gives",
    "J": "relative error of the rotor's inertia",
}


@kept
def gas_path_model(
    gg: GasGenerator,
    *,
    power: str = "measured",
    gains: tuple[str, ...] = GAINED,
    consider: tuple[str, ...] = (),
    walks: tuple[tuple[str, float], ...] = (),
    governed: Governor | None = None,
    power_jumps: bool = False,
) -> FilterModel:
    """Make the filter's model; :func:`gas_path_filter` is the convenient form.

    The speed goes on by the explicit midpoint rule; the health factors stay, but for walk and
    jump.  Inputs are held over the step, except that fuel may follow the law of its governor from
    one reading to the next: held, it would be half a step late, 16 kW after a load drop.

    Args:
        gg: the gas generator as the filter knows it.
        power: ``"measured"``: PW is an input; ``"unknown"``: a state with a random walk.
        gains: sensors whose relative gain error is a state: of P3, T3, T5, Wf, PW; and J, the
            inertia, of which a relative error is a state in the same way.
        consider: which states are considered, not estimated.
        walks: pairs of state name and random walk, unit of the state per sqrt(s).
        governed: law that the fuel follows within a step (limits left out); None: it is held.
        power_jumps: add the input ``jump_PW``: standard deviation of a sudden change of
            ``gain_PW``.

    Raises:
        ParameterError: unknown ``power`` or gain, the gain of a power that is not measured, or
            jumps of a gain that is not estimated.
    """
    if power not in POWER:
        raise ParameterError(f"power {power!r} {nearest(power, POWER)}")
    known = power == "measured"
    if power_jumps and ("PW" not in gains or "gain_PW" in consider):
        raise ParameterError("power_jumps: gain_PW must be among the estimated states")
    possible = (*GAINED, "PW", "J") if known else GAINED
    for n in gains:
        if n not in possible:
            raise ParameterError(f"gain of {n!r} {nearest(n, possible)} with power {power!r}")
    X = Signals([
        *gg.X, *gg.THETA, *(() if known else (dataclasses.replace(gg.U["PW"], default=None),)),
        *(_relative(f"gain_{n}", _GAIN_DOCS.get(n, f"relative gain error of the sensor of {n}"))
          for n in gains),
    ])  # fmt: skip
    spread = [
        Signal(f"sigma_{n}", gg.U[n].unit, f"standard deviation of the measured {n}",
               default=0.0, nominal=0.01 * gg.U[n].nominal)
        for n in (("Wf", "PW") if known else ("Wf",))
    ]  # fmt: skip
    U = Signals([
        *(s for s in gg.U if known or s.name != "PW"), *spread,
        _relative("jump", "standard deviation of a sudden change of health in this step"),
        *([_relative("jump_PW", "the same of gain_PW")] if power_jumps else []),
    ])  # fmt: skip
    W = Signals([
        *(Signal(f"w_{s.name[6:]}", "1", f"error of the measured {s.name[6:]} over its sigma")
          for s in spread),
        *([Signal("w_gain_PW", "1", "sudden change of gain_PW over jump_PW")]
          if power_jumps else []),
        *(Signal(f"w_{n}", "1", f"sudden change of {n} over jump") for n in HEALTH),
    ])  # fmt: skip
    x, u, w = (ca.MX.sym(n, len(s)) for n, s in (("x", X), ("u", U), ("w", W)))
    p, dt = ca.MX.sym("p", 0), ca.MX.sym("dt")
    at = dict(zip(X.names, ca.vertsplit(x), strict=True))
    given = dict(zip(U.names, ca.vertsplit(u), strict=True))
    noise = dict(zip(W.names, ca.vertsplit(w), strict=True))

    def true(name: str) -> Any:
        # reading = (1 + gain) true + sigma w
        return (given[name] - given[f"sigma_{name}"] * noise[f"w_{name}"]) / (
            1 + at.get(f"gain_{name}", 0.0)
        )

    engine, N = engine_function(gg), at["N"]
    inputs = {n: given[n] for n in AMBIENT} | {"Wf": true("Wf")}
    # the outputs do not depend on the shaft power
    before = ca.vertcat(*(at[n] for n in HEALTH))
    _, y, check_out, _ = engine(N, gg.U.stack(inputs | {"PW": ca.MX(0)}), before)
    # a jump happens at the beginning of the step, after the sample
    at |= {n: at[n] + given["jump"] * noise[f"w_{n}"] for n in HEALTH}
    if power_jumps:
        at["gain_PW"] += given["jump_PW"] * noise["w_gain_PW"]
    inputs["PW"] = true("PW") if known else at["PW"]
    u_gg, health = gg.U.stack(inputs), ca.vertcat(*(at[n] for n in HEALTH))
    k1, _, check, _ = engine(N, u_gg, health)
    k1 = k1 / (1 + at.get("gain_J", 0.0))
    if governed is not None:
        slope = governed.slope(N, k1, gg.parameters.N)
        u_gg = gg.U.stack(inputs | {"Wf": inputs["Wf"] + dt / 2 * slope})
    k2, _, check_mid, _ = engine(N + dt / 2 * k1, u_gg, health)
    x1 = at | {"N": N + dt * k2 / (1 + at.get("gain_J", 0.0))}
    readings = [N] + [y[i] * (1 + at.get(f"gain_{n}", 0.0)) for i, n in enumerate(OUTPUTS[1:])]
    Yf = Signals([gg.Y[n] for n in OUTPUTS])
    name = f"gas_path_{power}"
    free = np.full(len(X), np.inf)
    model = FilterModel(
        name, X, U, Signals(), W, Yf,
        transition=ca.Function(
            f"{name}_f", [x, u, p, w, dt], [ca.vertcat(*x1.values()), check + check_mid],
            ["x", "u", "p", "w", "dt"], ["x1", "check"],
        ),
        output=ca.Function(
            f"{name}_g", [x, u, p, w], [ca.vertcat(*readings), check_out],
            ["x", "u", "p", "w"], ["y", "check"],
        ),
        walk=np.zeros(len(X)), lower=-free, upper=free, consider=consider,
    )  # fmt: skip
    return model.with_walk(dict(walks))


# ------------------------------------------------------------------------------ the filter


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
        return "PW" in self.model.u

    @derived
    def gains(self) -> tuple[str, ...]:
        """Sensors whose gain error is a state."""
        return tuple(n[5:] for n in self.model.x.names if n.startswith("gain_"))

    def prior(self, **mean: float) -> Belief:
        """Return the belief before the first sample: healthy, at governed speed.

        Args:
            mean: other means, by state name.
        """
        means = {"N": self.gg.parameters.N} | dict.fromkeys(HEALTH, 1.0)
        means |= {f"gain_{n}": 0.0 for n in self.gains}
        if not self.known_power:
            means["PW"] = PW_PRIOR[0]
        return Belief.of(self.model.x, means | mean, self.sigma)

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
        t, rows = samples(ds)
        truth = {n: ds[n].values[rows] for n in (*OUTPUTS, "Wf")}
        truth["PW"] = window_means(ds["time"].values, ds["PW"].values, t)
        return self.measured(
            t, truth, seed, gains=gains, power=power, ambient=ambient, jumps=jumps,
            power_jumps=power_jumps,
        )  # fmt: skip

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
        """Measure true samples: as :meth:`recording`, from arrays N, P3, T3, T5, Wf, PW at t."""
        rng = np.random.default_rng(seed) if isinstance(seed, int) else seed
        gains = dict(gains or {})
        for n in gains:
            self.sensors[n]
        reading, sigma = {}, {}
        for n in (*OUTPUTS, "Wf", "PW"):
            # every sensor draws, so that the noise of one does not hang on what else is used
            clean = (1 + gains.get(n, 0.0)) * np.asarray(truth[n], float)
            sensor = self.sensors[n]
            s = sensor.noise * np.abs(clean) if sensor.relative else np.full(t.shape, sensor.noise)
            e = rng.standard_normal(t.size) if rng is not None else np.zeros(t.size)
            reading[n] = clean + s * e
            # what a filter can know: the reading's own standard deviation
            sigma[n] = sensor.noise * np.abs(reading[n]) if sensor.relative else s
        if power is not None:
            reading["PW"], sigma["PW"] = (_windows(v, t.size) for v in power)
        inputs: dict[str, Any] = {"jump": (t, _jumps_at(t, dict.fromkeys(jumps, JUMP)))}
        if power_jumps:
            inputs["jump_PW"] = (t, _jumps_at(t, power_jumps))
        inputs |= {"Wf": (t, reading["Wf"]), "sigma_Wf": (t, sigma["Wf"])}
        if self.known_power:
            inputs |= {"PW": (t, reading["PW"]), "sigma_PW": (t, sigma["PW"])}
        given = {**DEFAULT_DAY, **(ambient or {})}
        return record(
            self.model,
            outputs={n: (t, reading[n]) for n in OUTPUTS},
            sigma={n: sigma[n] for n in OUTPUTS},
            inputs=inputs | given,
        )

    def run(
        self, data: Recording, *, prior: Belief | None = None, iterations: int = ITERATIONS,
        iterated: str = ITERATED, full: bool = True, backend: str | None = None,
    ) -> FilterResult:  # fmt: skip
        """Filter a recording by the iterated filter.

        See :func:`estimators.filters.ekf.extended_kalman_filter`.
        """
        return extended_kalman_filter(
            self.model, self.prior() if prior is None else prior, data,
            iterations=iterations, iterated=iterated, full=full, backend=backend,
        )  # fmt: skip


def gas_path_filter(
    gg: GasGenerator | None = None,
    sensors: SensorSet = GAS_PATH,
    *,
    power: str = "measured",
    gains: Sequence[str] | bool = True,
    model_error: float = MODEL_ERROR,
    inertia: float | None = J_SIGMA,
    eta: float | None = None,
    consider_eta: bool = True,
    health_sigma: float = HEALTH_SIGMA,
    walk: Mapping[str, float] | None = None,
    governed: Governor | None = GOVERNOR,
    power_jumps: bool = False,
) -> GasPathFilter:
    """Make a gas-path filter.

    Args:
        gg: the gas generator as the filter knows it; the paper's by default.
        sensors: what is measured how well.
        power: ``"measured"`` or ``"unknown"`` shaft power.
        gains: sensors whose constant gain error is estimated with the sensor set's standard
            deviation as prior; True: all of P3, T3, T5 and Wf; False: none, they are believed.
        model_error: relative standard deviation of what maps and gas data are off; added to the
            gain errors, of which it cannot be told.
        inertia: relative standard deviation of the inertia, estimated from transients; None: known.
            Without measured power there is nothing to estimate it from.
        eta: relative standard deviation of the generators' efficiency, as the state ``gain_PW``: PW
            as measured is 1 + gain_PW times PW; None: the efficiency is known.
        consider_eta: the efficiency is considered, not estimated.
        health_sigma: prior standard deviation of each health factor.
        walk: random walks by state name, unit of the state per sqrt(s), instead of the usual ones.
        governed: law of the fuel within a step; None: it is held from one reading to the next.
        power_jumps: the error of the shaft power may jump where a recording says so; ``eta`` must
            be estimated then.

    Raises:
        ParameterError: unknown ``power``, gain, or an efficiency where no power is measured.
    """
    gg = GasGenerator() if gg is None else gg
    named = (GAINED if gains else ()) if isinstance(gains, bool) else tuple(gains)
    sigma = {"N": N_SIGMA} | dict.fromkeys(HEALTH, health_sigma)
    walks = {"N": N_WALK} | dict.fromkeys(HEALTH, HEALTH_WALK)
    if power == "unknown":
        sigma["PW"] = PW_PRIOR[1]
        walks["PW"] = PW_WALK
    sigma |= {f"gain_{n}": math.hypot(sensors[n].gain, model_error) for n in named}
    if inertia is not None and power == "measured":
        named = (*named, "J")
        sigma["gain_J"] = inertia
    consider: tuple[str, ...] = ()
    if eta is not None:
        named, consider = (*named, "PW"), ("gain_PW",) if consider_eta else ()
        sigma["gain_PW"] = eta
    model = gas_path_model(
        gg, power=power, gains=tuple(named), consider=consider,
        walks=tuple((walks | dict(walk or {})).items()), governed=governed,
        power_jumps=power_jumps,
    )  # fmt: skip
    return GasPathFilter(gg, sensors, model, sigma)


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


def window_means(time: np.ndarray, held: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Means over [t(k), t(k+1)] of a quantity that is held over each step before ``time``, (K,).

    The last window has no end; it repeats the one before.
    """
    energy = np.concatenate([[0.0], np.cumsum(held[1:] * np.diff(time))])
    mean = np.diff(np.interp(t, time, energy)) / np.diff(t)
    return np.append(mean, mean[-1])


def _jumps_at(t: np.ndarray, sizes: Mapping[float, float]) -> np.ndarray:
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
    gg = filt.gg
    v = gg.U.pack({"PW": 0.0, **u})
    theta = gg.THETA.pack({n: x.get(n, 1.0) for n in HEALTH})
    N = np.array([x["N"]])
    z = engine_function(gg)(N, v, theta)[3]
    y_w = np.asarray(gg.cycle.sensitivities(N, z, v, theta)[3])[gg.Y.indices(OUTPUTS[1:])]
    seen = y_w[:, 1 + len(gg.U) :] / np.array([filt.gg.Y[n].nominal for n in OUTPUTS[1:]])[:, None]
    n = np.linalg.svd(seen)[2][-1]
    return n * np.sign(n[int(np.abs(n).argmax())])


# ------------------------------------------------------------------------------ jumps


@dataclass(frozen=True)
class JumpTest:
    """When the innovations say that the health has jumped.

    Whitened innovations are summed over windows of several lengths; the squared norm of each sum
    over its length is chi-squared as long as the model holds, and grows with the window's length
    under a lasting shift.

    Args:
        windows: lengths in samples.
        rate: accepted false alarms in an hour; the threshold follows by Bonferroni's bound over all
            samples and windows, so that the true rate is lower.
        margin: factor on the threshold for what the model does not hold.
        hold: samples after a jump, or after the start, in which no new alarm is raised.
    """

    windows: tuple[int, ...] = (1, 3, 10, 30)
    rate: float = 1.0
    margin: float = 1.25
    hold: int = 25

    def threshold(self, ny: int, dt: float = DT) -> float:
        """Threshold of the statistic for ``ny`` outputs."""
        tests = 3600.0 / dt * len(self.windows)
        return float(self.margin * chi2.isf(self.rate / tests, ny))

    def first(self, result: FilterResult, start: int) -> tuple[int, int] | None:
        """Return the first alarm at or after sample ``start``: (alarm, onset), or None."""
        e = whitened(result)
        total = np.concatenate([np.zeros((1, e.shape[1])), np.cumsum(e, axis=0)])
        K = e.shape[0]
        best = np.zeros(K)
        for n in self.windows:
            at = np.arange(max(start, 0) + n - 1, K)
            stat = np.sum((total[at + 1] - total[at + 1 - n]) ** 2, axis=1) / n
            best[at] = np.maximum(best[at], stat)
        over = np.flatnonzero(best > self.threshold(e.shape[1]))
        if not over.size:
            return None
        k = int(over[0])
        # the onset: the start of the best window of any length that ends at the alarm
        lengths = np.arange(1, min(max(self.windows), k + 1 - max(start, 0)) + 1)
        stat = np.sum((total[k + 1] - total[k + 1 - lengths]) ** 2, axis=1) / lengths
        return k, k + 1 - int(lengths[int(stat.argmax())])


def whitened(result: FilterResult) -> np.ndarray:
    """Innovations made uncorrelated and of unit variance, shape (K, ny); 0 where not measured.

    Raises:
        EstimationError: the filter did not keep the innovations' covariances.
    """
    if result.innovation_cov is None:
        raise EstimationError("whitened innovations need a filter run with full=True")
    nu = np.nan_to_num(result.innovation.T)
    L = np.linalg.cholesky(result.innovation_cov)
    return np.asarray(np.linalg.solve(L, nu[..., None])[..., 0])


@dataclass(frozen=True, eq=False)
class Tracked:
    """A filter's result with jumps found on the way.

    Args:
        result: every sample's belief is what was known then: before an alarm from the run without
            that jump.
        alarms, onsets: samples of the alarms, and the last samples before the jumps they report.
    """

    result: FilterResult
    alarms: tuple[int, ...]
    onsets: tuple[int, ...]


def track_jumps(
    filt: GasPathFilter,
    data: Recording,
    *,
    test: JumpTest | None = None,
    prior: Belief | None = None,
    backend: str | None = None,
    most: int = 8,
) -> Tracked:
    """Filter a recording; where the innovations demand it, go back and let the health jump.

    Causal: an alarm at sample k changes beliefs from k on only, although the filter is run again
    from the onset, as it could be at the time.

    Args:
        filt, data: filter and recording.
        test: the test; :class:`JumpTest`'s defaults.
        prior, backend: as for :meth:`GasPathFilter.run`.
        most: largest number of jumps; further alarms are not acted on.
    """
    test = JumpTest() if test is None else test
    result = filt.run(data, prior=prior, backend=backend)
    alarms: list[int] = []
    onsets: list[int] = []
    row = filt.model.u.index("jump")
    start = test.hold
    while len(alarms) < most:
        found = test.first(result, start)
        if found is None:
            break
        k, onset = found
        alarms.append(k)
        onsets.append(onset - 1)
        u = data.u.copy()
        u[row, onset - 1] = JUMP  # acts in the step that ends at the onset
        data = Recording(data.t, u, data.y, data.variance, data.p)
        result = _spliced(result, filt.run(data, prior=prior, backend=backend), k)
        start = k + test.hold
    return Tracked(result, tuple(alarms), tuple(onsets))


def _spliced(before: FilterResult, after: FilterResult, k: int) -> FilterResult:
    """Take ``before`` up to sample k, ``after`` from there on."""

    def joined(a: Any, b: Any, axis: int) -> Any:
        return np.concatenate([np.split(a, [k], axis)[0], np.split(b, [k], axis)[1]], axis)

    columns = ("mean", "variance", "innovation", "innovation_variance", "nis", "measured",
               "mean_pred")  # fmt: skip
    rows = ("cov", "cov_pred", "cross", "innovation_cov")
    parts = {n: joined(getattr(before, n), getattr(after, n), -1) for n in columns}
    parts |= {n: joined(getattr(before, n), getattr(after, n), 0) for n in rows}
    return dataclasses.replace(after, **parts)
