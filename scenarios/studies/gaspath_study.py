"""What the gas-path filter is worth: efficiency, consistency, and what the shaft power adds.

``python -m scenarios.studies.gaspath_study`` prints the results of :func:`efficiency` and
:func:`shaft_power` as JSON.  Everything that was tuned, was tuned on the seeds ``TUNED``; what is
shown comes from ``FRESH``; the iteration was chosen on ``TUNED_LONG``.

Matched truth is made by the filter's own model (:class:`MatchedTruth`): health factors walk, speed
has its process noise, the factors jump at 6 s by the law that the filter assumes, and it is told
when.  Mismatched truth (:class:`EngineTruth`) has another integrator (linearly implicit, warm
start), steps of 5 ms, a governor that acts in between, another engine (:data:`VARIANTS`: inertia,
gas data, map calibration), faults of 1-4 % in one to four factors, sensor gains and generator
efficiency off; the filter must find the jump itself.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.backend import Caller, compiled
from apu_casadi.core.errors import EstimationError
from apu_casadi.core.sharing import Parametric, derived, kept, once
from apu_casadi.gaspath.conditions import DEFAULT_DAY
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.gaspath.steady.steadypoint import Limits
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.control import GovernorParameters, governor
from apu_casadi.unit.events import LoadChange
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu.gaspath import (
    HEALTH_SIGMA,
    HEALTH_WALK,
    JUMP,
    MODEL_ERROR,
    N_SIGMA,
    N_WALK,
    GasPathFilter,
    gas_path_filter,
    null_direction,
)
from estimators.apu.gaspathmodel import DT, GAINED, HEALTH, OUTPUTS, gas_path_model
from estimators.apu.healthjumps import JumpTest, track_jumps
from estimators.apu.sensors import GAS_PATH
from estimators.batch.smoother import rts_smoother
from estimators.filters.filtering import FilterResult
from estimators.filters.ukf import unscented_kalman_filter
from estimators.information import consistency
from estimators.information.bounds import linearisations, posterior_bound, snapshot_bound
from estimators.models.filtermodel import CHECK_TOL, FilterModel
from estimators.models.recording import Recording

TUNED = range(1, 201)
TUNED_LONG = range(10001, 11001)  # what is iterated: biases of 0.1 sigma need many seeds
# 1001-1500, 2001-2500 and 3001-3500 were looked at while the iteration was chosen
FRESH = range(4001, 4501)
DURATION = 14.0  # s
LOAD_DROP, FAULT = 2.0, 6.0  # s; as in the paper's joint scenario
FINE = 4  # steps of the mismatched truth in one of the filter
ETA_SIGMA = 0.02  # efficiency of the generators, relative
CHECKPOINTS = tuple(np.arange(0.5, DURATION + 1e-9, 0.5).tolist())
SETTLED = 1.0  # s after a fault from which the errors of the mismatched filter count
JUMP_TEST = JumpTest()
BLOCK = 100  # steps of a truth in one call
BOUNDS_EVERY = 20  # trajectories between those whose bound is computed

VARIANTS: dict[str, dict[str, Any]] = {
    "same engine": {},
    "inertia + 10 %": {"parameters": {"J": 0.055}},
    "nasa9 gas data": {"parameters": {"gas_data": "nasa9"}},
    "other map calibration": {
        "compressor_map": {"n_Re": 0.15, "a_W": 0.035},
        "turbine_map": {"c_PR": 0.28, "a_W": 0.07},
    },
}
"""What the mismatched truth has instead of the filter's engine; its seeds take turns."""


def variant(gg: GasGenerator, change: Mapping[str, Mapping[str, Any]]) -> GasGenerator:
    """Return a gas generator with changed parameters or map calibrations."""
    new: dict[str, Any] = {}
    for part, values in change.items():
        old = getattr(gg, part)
        if part == "parameters":
            new[part] = old.change(**values)
        else:
            new[part] = dataclasses.replace(
                old, calibration=dataclasses.replace(old.calibration, **values)
            )
    return dataclasses.replace(gg, **new) if new else gg


# ------------------------------------------------------------------------------ truth


@once
def power_profile(drop: float = LOAD_DROP) -> np.ndarray:
    """Shaft power, W, in steps of 5 ms: 2 x 225 kW, then 2 x 100 kW from ``drop`` on.

    Of a joint run with a healthy gas path, voltage regulator and all; held when it has settled.
    """
    load, less = (SeriesLoad.from_power(P) for P in (225e3, 100e3))
    ds = simulate_joint(
        Apu(), duration=drop + 3.0, load=load, events=[LoadChange(drop, less)], dt=DT / FINE,
        waveform_dt=None, solver="propagator",
    )  # fmt: skip
    PW = np.asarray(ds["PW"].values[1:], float)
    n = round(DURATION / DT) * FINE
    return np.concatenate([PW, np.full(n - PW.size, PW[-1])])


@dataclass(frozen=True)
class Case:
    """What is drawn for one seed.

    Args:
        health: factors at the start, shape (4,).
        jump: change of the factors at :data:`FAULT`, shape (4,).
        gains: relative errors of the sensors P3, T3, T5, Wf, of PW and of J, by name.
    """

    health: np.ndarray
    jump: np.ndarray
    gains: dict[str, float]

    @property
    def sensors(self) -> dict[str, float]:
        """The gains that are of sensors."""
        return {n: g for n, g in self.gains.items() if n != "J"}


def draw(rng: np.random.Generator, filt: GasPathFilter, *, matched: bool) -> Case:
    """Draw a case: from the filter's prior if matched, else faults of 1-4 % in 1 to 4 factors."""
    health = 1 + HEALTH_SIGMA * rng.standard_normal(4)
    if matched:
        jump = JUMP * rng.standard_normal(4)
    else:
        hit = rng.permutation(4) < rng.integers(1, 5)
        jump = hit * rng.choice([-1.0, 1.0], 4) * rng.uniform(0.01, 0.04, 4)
    errors = {}
    for n in (*GAINED, "PW", "J"):
        e = float(rng.standard_normal())
        # the other engines have errors of model and inertia of their own
        s = filt.sensors[n].gain if not matched and n in GAINED else filt.sigma.get(f"gain_{n}", 0)
        if s and (matched or n != "J"):
            errors[n] = s * e
    return Case(health, jump, errors)


@dataclass(frozen=True, eq=False)
class Truth:
    """A true run at the filter's instants.

    Args:
        t: s, shape (K,).
        values: N, P3, T3, T5, Wf, PW (mean to the next instant), and the factors, by name.
        process: what was drawn for speed and factors in each step, in their units, shape (5, K);
            None if nothing was.
    """

    t: np.ndarray
    values: dict[str, np.ndarray]
    process: np.ndarray | None = None


def _folded(name: str, step: ca.Function) -> Caller:
    return Caller(compiled(step.mapaccum(name, BLOCK)))


def _run(call: Caller, carry: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Fold a truth's step over its inputs (n, K): rows of carry and outputs, (n, K)."""
    K = inputs.shape[1]
    pad = -K % BLOCK
    inputs = np.pad(inputs, ((0, 0), (0, pad)), mode="edge")
    parts = []
    for k in range(0, K + pad, BLOCK):
        carried, out = call(carry, inputs[:, k : k + BLOCK])
        carry = carried[:, -1]
        parts.append(out)
    return np.hstack(parts)[:, :K]


@dataclass(frozen=True, eq=False)
class MatchedTruth(Parametric):
    """The filter's own model, with its own process noise, as truth."""

    gg: GasGenerator

    @derived
    def _model(self) -> FilterModel:
        return gas_path_model(
            self.gg, gains=("J",), walks=(("N", N_WALK), *((n, HEALTH_WALK) for n in HEALTH)),
            governed=GovernorParameters(),
        )  # fmt: skip

    @derived
    def _call(self) -> Caller:
        model = self._model
        gov, N_ref, nx = GovernorParameters(), self.gg.parameters.N, len(model.x)
        carry, given = ca.MX.sym("carry", nx + 1), ca.MX.sym("given", 5 + nx)  # gain_J is last
        x, Wf_I, PW, jump, xi = carry[:nx], carry[nx], given[0], given[1:5], given[5:]
        fuel = governor(N=x[0], N_ref=N_ref, Wf_I=Wf_I, par=gov)
        u = model.u.stack(
            {n: ca.MX(v) for n, v in DEFAULT_DAY.items()}
            | {"Wf": fuel.Wf, "PW": PW, "sigma_Wf": ca.MX(0),
               "sigma_PW": ca.MX(0), "jump": ca.MX(1)}
        )  # fmt: skip
        w, p = ca.MX.zeros(len(model.w)), ca.MX(0, 1)
        w[len(model.w) - 4 :] = jump
        y, check = model.output(x, u, p, w)
        x1, check1 = model.transition(x, u, p, w, DT)
        x1 += math.sqrt(DT) * ca.DM(model.walk) * xi
        step = ca.Function(
            "matched_truth", [carry, given],
            [ca.vertcat(x1, Wf_I + DT * fuel.Wf_I_dot),
             ca.vertcat(y, fuel.Wf, PW, x[1:5], check + check1)],
        )  # fmt: skip
        return _folded("matched_truths", step)

    def __call__(self, case: Case, power: np.ndarray, rng: np.random.Generator | None) -> Truth:
        """Simulate a case; process noise from ``rng``, none if it is None."""
        PW = power.reshape(-1, FINE).mean(1)
        PW = np.append(PW, PW[-1])
        K = PW.size
        t = np.arange(K) * DT
        start = _trimmed(self.gg, case.health, PW[0])
        jump = np.zeros((4, K))
        jump[:, round(FAULT / DT)] = case.jump
        xi = np.zeros((6, K)) if rng is None else rng.standard_normal((6, K))
        given = np.vstack([PW, jump, xi])
        N0 = start["N"] + (0.0 if rng is None else N_SIGMA * rng.standard_normal())
        first = np.array([N0, *case.health, case.gains.get("J", 0.0), start["Wf"]])
        out = _run(self._call, first, given)
        _checked(out[-1], t)
        process = math.sqrt(DT) * self._model.walk[:5, None] * xi[:5]
        return Truth(t, dict(zip((*OUTPUTS, "Wf", "PW", *HEALTH), out, strict=False)), process)


@dataclass(frozen=True, eq=False)
class EngineTruth(Parametric):
    """An engine that is not the filter's, with governor, in steps of 5 ms."""

    gg: GasGenerator

    @derived
    def _call(self) -> Caller:
        gg, gov, dt = self.gg, GovernorParameters(), DT / FINE
        nz = len(gg.z)
        carry, given = ca.MX.sym("carry", 3 + nz), ca.MX.sym("given", 5)
        N, Wf_I, N_dot, z = carry[0], carry[1], carry[2], carry[3:]
        # fuel of the middle of the step, with the last slope of speed
        now = governor(N=N, N_ref=gg.parameters.N, Wf_I=Wf_I, par=gov)
        mid = governor(
            N=N + dt / 2 * N_dot, N_ref=gg.parameters.N, Wf_I=Wf_I + dt / 2 * now.Wf_I_dot, par=gov
        )
        u = gg.U.stack(
            {n: ca.MX(v) for n, v in DEFAULT_DAY.items()} | {"Wf": mid.Wf, "PW": given[0]}
        )
        N1, _, z1, residual = gg.step(N, u, given[1:], dt, z)
        Wf_I1 = Wf_I + dt * mid.Wf_I_dot
        # a meter reads the fuel of the instant
        end = governor(N=N1, N_ref=gg.parameters.N, Wf_I=Wf_I1, par=gov)
        y_end, _ = gg.g(N1, gg.U.stack(
            {n: ca.MX(v) for n, v in DEFAULT_DAY.items()} | {"Wf": end.Wf, "PW": given[0]}
        ), given[1:], z1)  # fmt: skip
        step = ca.Function(
            "engine_truth", [carry, given],
            [ca.vertcat(N1, Wf_I1, (N1 - N) / dt, z1),
             ca.vertcat(y_end[gg.Y.indices(OUTPUTS)], end.Wf, given, residual)],
        )  # fmt: skip
        return _folded("engine_truths", step)

    def __call__(self, case: Case, power: np.ndarray, rng: np.random.Generator) -> Truth:
        """Simulate a case; nothing is drawn from ``rng``."""
        gg, K = self.gg, power.size
        start = _trimmed(gg, case.health, power[0])
        theta = np.repeat(case.health[:, None], K, axis=1)
        theta[:, round(FAULT / DT) * FINE :] += case.jump[:, None]
        carry = np.array([start["N"], start["Wf"], 0.0, *start.z])
        out = _run(self._call, carry, np.vstack([power, theta]))
        t = np.arange(K // FINE + 1) * DT
        _checked(out[-1], t)
        names = (*OUTPUTS, "Wf", "PW", *HEALTH)
        first = [start[n] for n in (*OUTPUTS, "Wf")]
        # instants: the start, then the end of every fourth step
        rows = dict(zip(names, out, strict=False))
        values = {
            n: np.append(first[i], rows[n][FINE - 1 :: FINE]) for i, n in enumerate(names[:5])
        }
        PW = power.reshape(-1, FINE).mean(1)
        values["PW"] = np.append(PW, PW[-1])
        values |= {n: np.append(theta[i, 0], rows[n][FINE - 1 :: FINE])
                   for i, n in enumerate(HEALTH)}  # fmt: skip
        return Truth(t, values)


def _trimmed(gg: GasGenerator, health: np.ndarray, PW: float) -> Any:
    # the prior has engines, one in some thousands, that run hotter than an operator would let them;
    # without them the truth would be drawn from a narrower prior than the filter's
    return trim_gas_generator(
        gg, {"N": gg.parameters.N, "PW": PW}, theta=dict(zip(HEALTH, health.tolist(), strict=True)),
        limits=Limits(T4_max=math.inf),
    )  # fmt: skip


def _checked(residual: np.ndarray, t: np.ndarray) -> None:
    tol = max(RESIDUAL_TOL, CHECK_TOL)
    if not (residual <= tol).all():
        k = int(np.argmax(~(residual <= tol)))
        raise EstimationError(f"truth: cycle not solved at sample {k}: {residual[k]:.1e}")


# ------------------------------------------------------------------------------ chance


@dataclass(eq=False)
class LinearReference:
    """The Kalman filter of the linearised model on a study's own draws: what chance alone gives.

    Linearised along one run of a healthy engine, the filter's model is linear and Gaussian, and its
    Kalman filter exact: the normalised error squared of four factors is chi-squared with 4 degrees
    of freedom.  Fed with the very numbers that were drawn for each seed of a matched study (prior
    errors, noises, jump), it has the same luck as the filter that is tried, within what is not
    linear (correlation 0.99): of the mean of 500 seeds, which is within 0.25 of 4 at 95 %, the
    *difference* is known to 0.04.

    Args:
        filt: the filter that is tried; it estimates all its states, the shaft power is measured.
    """

    filt: GasPathFilter
    _drawn: list[tuple[np.ndarray, ...]] = dataclasses.field(default_factory=list, init=False)

    def add(self, truth: Truth, case: Case, data: Recording) -> None:
        """Take what was drawn for a seed.

        Raises:
            EstimationError: a truth whose process noise is not known.
        """
        if truth.process is None:
            raise EstimationError("what chance gives is known for matched truths only")
        filt, K = self.filt, truth.t.size
        X, W = filt.model.x, filt.model.w
        x, w, q = np.zeros(len(X)), np.zeros((len(W), K)), np.zeros((len(X), K))
        named = {"N": truth.values["N"][0] - filt.gg.parameters.N}
        named |= dict(zip(HEALTH, case.health - 1, strict=True))
        named |= {f"gain_{n}": v for n, v in case.gains.items()}
        for n, v in named.items():
            x[X.index(n)] = v
        q[X.indices(("N", *HEALTH))] = truth.process
        jumps = np.flatnonzero(data.u[filt.model.u.index("jump")])
        hit = np.array(W.indices([f"w_{n}" for n in HEALTH]))
        w[hit[:, None], jumps] = case.jump[:, None] / JUMP

        def drawn(name: str, reading: np.ndarray) -> np.ndarray:
            clean = (1 + case.sensors.get(name, 0.0)) * truth.values[name]
            sensor = filt.sensors[name]
            return (reading - clean) / (sensor.noise * (np.abs(clean) if sensor.relative else 1.0))

        for n in ("Wf", "PW"):
            w[W.index(f"w_{n}")] = drawn(n, data.u[filt.model.u.index(n)])
        v = np.array([drawn(n, data.y[i]) for i, n in enumerate(OUTPUTS)])
        self._drawn.append((x, w, v, q))

    def errors(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return errors of the factors, (seeds, rows, 4), and their covariances, (rows, 4, 4)."""
        filt, x, w, v, q = self.filt, *(np.array(d) for d in zip(*self._drawn, strict=True))
        nominal = Case(np.ones(4), np.zeros(4), {})
        truth = MatchedTruth(filt.gg)(nominal, power_profile(), None)
        data = filt.measured(truth.t, truth.values, None, jumps=[FAULT])
        H, F = linearisations(filt.model, data, true_states(filt, truth, nominal))
        nx, nw, walk = len(filt.model.x), len(filt.model.w), filt.model.walk
        i = filt.model.x.index(HEALTH[0])
        health, place = slice(i, i + 4), {int(k): j for j, k in enumerate(rows)}
        e, P_e = np.empty((len(x), len(rows), 4)), np.empty((len(rows), 4, 4))
        P, error = filt.prior().cov, -x  # estimate minus truth
        for k in range(data.size):
            Pa = np.zeros((nx + nw, nx + nw))
            Pa[:nx, :nx], Pa[nx:, nx:] = P, np.eye(nw)
            joint = np.hstack([error, -w[:, :, k]])
            R = data.variance[:, k]
            S = H[k] @ Pa @ H[k].T + np.diag(R)
            K = np.linalg.solve(S, H[k] @ Pa).T
            joint += (v[:, :, k] * np.sqrt(R) - joint @ H[k].T) @ K.T
            Pa = snapshot_bound(H[k], R, Pa)
            if k in place:
                e[:, place[k]], P_e[place[k]] = joint[:, health], Pa[health, health]
            P = F[k] @ Pa @ F[k].T + np.diag(walk**2) * data.dt[k]
            error = joint @ F[k].T - q[:, :, k]
        return e, P_e

    def nees(self, rows: np.ndarray) -> np.ndarray:
        """Return the normalised error squared of the factors at some samples, (seeds, rows)."""
        return consistency.nees(*self.errors(rows))


# ------------------------------------------------------------------------------ measures


def true_states(filt: GasPathFilter, truth: Truth, case: Case) -> np.ndarray:
    """True values of the filter's states, shape (nx, K)."""
    values = truth.values | {f"gain_{n}": np.full(truth.t.size, v) for n, v in case.gains.items()}
    zero = np.zeros(truth.t.size)
    return np.array([values.get(n, zero) for n in filt.model.x.names])


@kept
def _all_estimated(model: FilterModel) -> FilterModel:
    # one model for all trajectories: what is built from it is kept with it
    return dataclasses.replace(model, consider=()) if model.consider else model


def bound_of(filt: GasPathFilter, truth: Truth, case: Case, *, jumps: Sequence[float]) -> Any:
    """Posterior Cramer-Rao bound along a truth, for estimators that estimate all: (K, nx, nx)."""
    model = _all_estimated(filt.model)
    exact = filt.measured(truth.t, truth.values, None, gains=case.sensors, jumps=jumps)
    x = true_states(filt, truth, case)
    return posterior_bound(model, filt.prior(), exact, x)


@dataclass(eq=False)
class Collected:
    """Errors, covariances and innovations at the checkpoints, of many seeds."""

    rows: np.ndarray
    error: list[np.ndarray] = dataclasses.field(default_factory=list)
    cov: list[np.ndarray] = dataclasses.field(default_factory=list)
    nis: list[np.ndarray] = dataclasses.field(default_factory=list)
    bound: list[np.ndarray] = dataclasses.field(default_factory=list)
    paired: list[np.ndarray] = dataclasses.field(default_factory=list)

    def add(self, r: FilterResult, x: np.ndarray, bound: np.ndarray | None) -> None:
        """Add one seed; ``bound`` where it was computed."""
        assert r.cov is not None
        self.error.append((r.mean - x)[:, self.rows].T)
        self.cov.append(r.cov[self.rows])
        self.nis.append(r.nis[self.rows])
        if bound is not None:
            self.bound.append(bound[self.rows])
            self.paired.append(r.cov[self.rows])


def measures(c: Collected, health: slice, null: np.ndarray, ny: int) -> dict[str, Any]:
    """Condense collected runs: RMSE over bound, NEES, NIS, the null direction; by checkpoint."""
    e, P, nis = np.array(c.error)[:, :, health], np.array(c.cov)[:, :, health, health], c.nis
    n = e.shape[0]
    B = np.array(c.bound)[:, :, health, health]
    claimed = np.array(c.paired)[:, :, health, health]
    rmse = np.sqrt((e**2).mean(0))
    limit = np.sqrt(np.diagonal(B, axis1=2, axis2=3).mean(0))
    nees = consistency.nees(e, P).mean(0)
    along = np.einsum("ski,i->sk", e, null)
    var = np.einsum("skij,i,j->sk", P, null, null)
    least = np.einsum("skij,i,j->sk", B, null, null)
    var_paired = np.einsum("skij,i,j->sk", claimed, null, null)
    nees_null = (along**2 / var).mean(0)
    low4, high4 = consistency.band(n, 4)
    low1, high1 = consistency.band(n, 1)
    low_y, high_y = consistency.band(n, ny)
    nis_mean = np.array(nis).mean(0)
    inside = (nees >= low4) & (nees <= high4)
    return {
        "seeds": n,
        "rmse": dict(zip(HEALTH, rmse.T.tolist(), strict=True)),
        "bound": dict(zip(HEALTH, limit.T.tolist(), strict=True)),
        "ratio": dict(zip(HEALTH, (rmse / limit).T.tolist(), strict=True)),
        "ratio_max": float((rmse / limit).max()),
        "ratio_median": float(np.median(rmse / limit)),
        # standard error of an RMSE of n independent numbers, relative
        "ratio_stderr": 1 / math.sqrt(2 * n),
        "nees": nees.tolist(), "nees_band": [low4, high4], "nees_inside": float(inside.mean()),
        "nees_above": float((nees > high4).mean()),
        "nis": nis_mean.tolist(), "nis_band": [low_y, high_y],
        "nis_inside": float(((nis_mean >= low_y) & (nis_mean <= high_y)).mean()),
        "null": {
            "direction": null.tolist(),
            "rmse": np.sqrt((along**2).mean(0)).tolist(),
            "claimed": np.sqrt(var.mean(0)).tolist(),
            "limit": np.sqrt(least.mean(0)).tolist(),
            "least_claimed_over_limit": float((var_paired / least).min()),
            # the filter linearises at its estimate, the bound at the truth: run by run the ratio
            # scatters about 1; the mean over the runs is what the bound speaks of
            "claimed_over_limit": {
                "mean": float((var_paired / least).mean()),
                "sd": float((var_paired / least).std()),
                "most": float((var_paired / least).max()),
                "of_means": (var_paired.mean(0) / least.mean(0)).tolist(),
            },
            "nees": nees_null.tolist(), "band": [low1, high1],
            "inside": float(((nees_null >= low1) & (nees_null <= high1)).mean()),
        },
    }  # fmt: skip


# ------------------------------------------------------------------------------ the studies


def _generators(seed: int) -> tuple[np.random.Generator, ...]:
    """Generators of the case, the process noise and the measurement noise of a seed."""
    return tuple(np.random.default_rng([seed, k]) for k in range(3))


def efficiency(
    seeds: Sequence[int] = FRESH,
    *,
    matched: bool,
    filt: GasPathFilter | None = None,
    progress: bool = False,
) -> dict[str, Any]:
    """Monte Carlo of the filter on a load drop at 2 s and a jump of health at 6 s.

    Matched: the bound's conditions, the jump told.  Mismatched: other engines, faults to be found.

    Returns:
        ``measures`` at :data:`CHECKPOINTS`; for the matched truth also the NEES that chance alone
        gives (:class:`LinearReference`) and the mean excess over it with its standard error, for
        the mismatched one alarms and delays.
    """
    filt = gas_path_filter(eta=ETA_SIGMA, consider_eta=False) if filt is None else filt
    power = power_profile()
    engines: dict[str, dict[str, Any]] = {"same engine": {}} if matched else VARIANTS
    truths: list[Any] = [
        (MatchedTruth if matched else EngineTruth)(variant(filt.gg, v)) for v in engines.values()
    ]
    points = np.array([c for c in CHECKPOINTS if matched or not 0 <= c - FAULT < SETTLED])
    c = Collected(np.round(points / DT).astype(int))
    chance = LinearReference(filt)
    false, missed, delays = 0, 0, []
    started = time.perf_counter()
    for i, seed in enumerate(seeds):
        rng_case, rng_process, rng_noise = _generators(seed)
        case = draw(rng_case, filt, matched=matched)
        source = truths[i % len(truths)]
        if not matched:
            case.gains["J"] = source.gg.parameters.J / filt.gg.parameters.J - 1
        truth = source(case, power, rng_process)
        data = filt.measured(
            truth.t, truth.values, rng_noise, gains=case.sensors, jumps=[FAULT] if matched else []
        )
        if matched:
            r = filt.run(data)
            chance.add(truth, case, data)
        else:
            found = track_jumps(filt, data, test=JUMP_TEST)
            r, at = found.result, round(FAULT / DT)
            good = [a for a in found.alarms if a > at]
            false += sum(a <= at for a in found.alarms) + max(len(good) - 1, 0)
            missed += not good
            delays += [good[0] - at] if good else []
        bound = None
        if i % BOUNDS_EVERY == 0:
            bound = bound_of(filt, truth, case, jumps=[FAULT])
        c.add(r, true_states(filt, truth, case), bound)
        if progress and i % 50 == 49:
            print(f"{i + 1} seeds, {time.perf_counter() - started:.0f} s", flush=True)
    null = null_direction(filt, {"N": filt.gg.parameters.N}, {"Wf": filt.gg.design.values["Wf"]})
    first = filt.model.x.index(HEALTH[0])
    out = measures(c, slice(first, first + 4), null, len(OUTPUTS))
    out |= {"checkpoints": points.tolist(), "matched": matched}
    e, P = (np.array(v)[:, :, first : first + 4] for v in (c.error, c.cov))
    every = consistency.nees(e, P[..., first : first + 4])
    out["nees_of"] = {
        name: every[i :: len(truths)].mean(0).tolist() for i, name in enumerate(engines)
    }
    if matched:
        e_exact, P_exact = chance.errors(c.rows)
        exact = consistency.nees(e_exact, P_exact)
        excess = (every - exact).mean(1)
        along = (e_exact @ null) ** 2 / np.einsum("kij,i,j->k", P_exact, null, null)
        out["null"]["nees_exact"] = along.mean(0).tolist()
        out |= {
            "nees_exact": exact.mean(0).tolist(), "nees_excess": float(excess.mean()),
            "nees_excess_stderr": float(excess.std() / math.sqrt(len(excess))),
            # the mean over the run of numbers that are nearly one number
            "nees_independent": consistency.independent(every),
        }  # fmt: skip
    else:
        hours = len(c.error) * DURATION / 3600
        out |= {
            "false_alarms": false, "hours": hours, "missed": missed,
            "delay_samples": {q: float(np.quantile(delays, v)) if delays else math.nan
                              for q, v in (("median", 0.5), ("95 %", 0.95), ("worst", 1.0))},
        }  # fmt: skip
    return out


PRIORS = (0.005, 0.01, 0.02, 0.04)
POWER_NOISE = (0.002, 0.005, 0.01, 0.02, 0.05)
ETAS = (None, 0.01, 0.02)
SNAPSHOT, TRANSIENT = LOAD_DROP, FAULT  # s; before the load drops, and after it has settled


def _pair(
    gains: bool, eta: float | None, prior: float, noise: float
) -> tuple[GasPathFilter, GasPathFilter]:
    """Make the filters with and without shaft power."""
    sensors = GAS_PATH.change(PW=noise)
    model_error = MODEL_ERROR if gains else 0.0
    with_power = gas_path_filter(
        sensors=sensors, gains=gains, model_error=model_error, eta=eta, health_sigma=prior
    )
    without = gas_path_filter(
        sensors=sensors, gains=gains, model_error=model_error, power="unknown", health_sigma=prior
    )
    return with_power, without


def _health_cov(filt: GasPathFilter, r: FilterResult, k: int) -> np.ndarray:
    assert r.cov is not None
    i = filt.model.x.index(HEALTH[0])
    return np.asarray(r.cov[k, i : i + 4, i : i + 4])


def shaft_power() -> dict[str, Any]:
    """What the shaft power adds, in covariances: priors, power noise and efficiency swept.

    The covariances are the filter's on data without noise, with a healthy engine that is its own,
    so they are the information limit (with the efficiency as a considered parameter where it has a
    standard deviation).  Error of a set of factors is the root of the sum of their variances.

    Returns:
        ``table``: one row for each choice, with errors at :data:`SNAPSHOT` (steady before the load
        drop) and :data:`TRANSIENT` (after it); ``null`` there is along the null direction.
    """
    power = power_profile()[: round(TRANSIENT / DT) * FINE]
    case = Case(np.ones(4), np.zeros(4), {})
    gg = GasGenerator()
    truth = EngineTruth(gg)(case, power, np.random.default_rng(0))
    null = null_direction(gas_path_filter(), {"N": gg.parameters.N}, {"Wf": gg.design.values["Wf"]})
    points = {"snapshot": round(SNAPSHOT / DT), "transient": round(TRANSIENT / DT)}
    table = []
    for gains in (False, True):
        for prior in PRIORS:
            base: dict[str, np.ndarray] = {}
            for eta in ETAS:
                for noise in POWER_NOISE:
                    known, unknown = _pair(gains, eta, prior, noise)
                    if not base:  # what PW says of nothing does not depend on its noise
                        r = unknown.run(unknown.measured(truth.t, truth.values, None))
                        base = {w: _health_cov(unknown, r, k) for w, k in points.items()}
                    r = known.run(known.measured(truth.t, truth.values, None))
                    row: dict[str, Any] = {
                        "gains": gains, "prior": prior, "eta": eta or 0.0, "noise": noise
                    }  # fmt: skip
                    for w, k in points.items():
                        P, P0 = _health_cov(known, r, k), base[w]
                        row[w] = {
                            "with": math.sqrt(np.trace(P)), "without": math.sqrt(np.trace(P0)),
                            "reduction": 1 - math.sqrt(np.trace(P) / np.trace(P0)),
                            "null_with": math.sqrt(null @ P @ null),
                            "null_without": math.sqrt(null @ P0 @ null),
                            "factors": (1 - np.sqrt(np.diag(P) / np.diag(P0))).tolist(),
                        }  # fmt: skip
                    table.append(row)
    return {"null_direction": null.tolist(), "table": table}


def shaft_power_seeds(
    seeds: Sequence[int] = FRESH,
    *,
    gains: bool,
    eta: float | None,
    prior: float = HEALTH_SIGMA,
    noise: float = 0.01,
) -> dict[str, Any]:
    """Monte Carlo of one choice of :func:`shaft_power`: actual errors with and without the power.

    Returns:
        Reduction at both instants with its 95 % interval (bootstrap over seeds), RMSE of each
        factor, and along the null direction actual and claimed errors of both filters.
    """
    pair = _pair(gains, eta, prior, noise)
    power = power_profile()[: round(TRANSIENT / DT) * FINE]
    source = MatchedTruth(pair[0].gg)
    null = null_direction(pair[0], {"N": source.gg.parameters.N},
                          {"Wf": source.gg.design.values["Wf"]})  # fmt: skip
    points = {"snapshot": round(SNAPSHOT / DT), "transient": round(TRANSIENT / DT)}
    error: list[list[list[np.ndarray]]] = []
    claimed: list[list[list[float]]] = []
    for seed in seeds:
        rng_case, rng_process, rng_noise = _generators(seed)
        case = draw(rng_case, pair[0], matched=True)
        case = dataclasses.replace(
            case, health=1 + (case.health - 1) * prior / HEALTH_SIGMA, jump=np.zeros(4)
        )
        truth = source(case, power, rng_process)
        noise_seed = int(rng_noise.integers(2**31))
        e, c = [], []
        for filt in pair:
            r = filt.run(filt.measured(truth.t, truth.values, noise_seed, gains=case.sensors))
            x = np.array([truth.values[n] for n in HEALTH])
            i = filt.model.x.index(HEALTH[0])
            e.append([(r.mean[i : i + 4] - x)[:, k] for k in points.values()])
            c.append([float(null @ _health_cov(filt, r, k) @ null) for k in points.values()])
        error.append(e)
        claimed.append(c)
    E, C = np.array(error), np.array(claimed)  # (seeds, with/without, instant, factor)
    square = (E**2).sum(3)
    rng = np.random.default_rng(0)
    pick = rng.integers(0, len(E), (2000, len(E)))
    out: dict[str, Any] = {
        "gains": gains, "eta": eta, "prior": prior, "noise": noise, "seeds": len(E)
    }  # fmt: skip
    for j, when in enumerate(points):
        ratio = square[pick, 0, j].mean(1) / square[pick, 1, j].mean(1)
        out[when] = {
            "reduction": float(1 - np.sqrt(square[:, 0, j].mean() / square[:, 1, j].mean())),
            "interval": (1 - np.sqrt(np.quantile(ratio, [0.975, 0.025]))).tolist(),
            "rmse_with": np.sqrt((E[:, 0, j] ** 2).mean(0)).tolist(),
            "rmse_without": np.sqrt((E[:, 1, j] ** 2).mean(0)).tolist(),
            "null_rmse": np.sqrt(((E[:, :, j] @ null) ** 2).mean(0)).tolist(),
            "null_claimed": np.sqrt(C[:, :, j].mean(0)).tolist(),
        }
    return out


def compare_filters(
    seeds: Sequence[int] = tuple(FRESH)[:50], *, progress: bool = False
) -> list[dict[str, Any]]:
    """EKF, iterated EKF, UKF (cubature and scaled points) and smoother on the same matched data.

    Returns:
        One row each: RMSE of the factors over all instants after 0.5 s, over that of the bound (for
        filters; the smoother may be below 1), NEES, microseconds for a sample; and ``nees_exact``,
        the NEES that chance alone gives a filter on these draws, the same in all rows.
    """
    filt = gas_path_filter(eta=ETA_SIGMA, consider_eta=False)
    source, power = MatchedTruth(filt.gg), power_profile()
    i = filt.model.x.index(HEALTH[0])
    health, start = slice(i, i + 4), round(0.5 / DT)
    methods: dict[str, Any] = {
        "EKF": lambda d: filt.run(d, iterations=1),
        "EKF, input errors iterated, 2": lambda d: filt.run(d),
        "iterated EKF, 2": lambda d: filt.run(d, iterated="all"),
        "iterated EKF, 3": lambda d: filt.run(d, iterations=3, iterated="all"),
        "UKF, cubature": lambda d: unscented_kalman_filter(filt.model, filt.prior(), d, full=True),
        "UKF, scaled": lambda d: unscented_kalman_filter(
            filt.model, filt.prior(), d, points="scaled", full=True
        ),
        "EKF, input errors iterated, 2, and smoother": lambda d: rts_smoother(filt.run(d)),
    }
    chance = LinearReference(filt)
    square = {n: np.zeros(4) for n in methods}
    nees, seconds = dict.fromkeys(methods, 0.0), dict.fromkeys(methods, math.inf)
    limit = np.zeros(4)
    size, lost = 0, dict.fromkeys(methods, 0)
    for j, seed in enumerate(seeds):
        rng_case, rng_process, rng_noise = _generators(seed)
        case = draw(rng_case, filt, matched=True)
        truth = source(case, power, rng_process)
        data = filt.measured(truth.t, truth.values, rng_noise, gains=case.sensors, jumps=[FAULT])
        x = true_states(filt, truth, case)[health]
        chance.add(truth, case, data)
        size = data.size
        for n, method in methods.items():
            try:
                began = time.perf_counter()
                r = method(data)
                seconds[n] = min(seconds[n], time.perf_counter() - began)
            except EstimationError:
                lost[n] += 1
                continue
            e = (r.mean[health] - x)[:, start:].T
            square[n] += (e**2).mean(0)
            P = r.cov[start:, health, health]
            nees[n] += float(consistency.nees(e, P).mean())
        if j % 5 == 0:
            B = bound_of(filt, truth, case, jumps=[FAULT])[start:, health, health]
            limit += np.diagonal(B, axis1=1, axis2=2).mean(0)
        if progress:
            print(f"{j + 1} of {len(seeds)}", flush=True)
    limit /= -(-len(seeds) // 5)
    exact = float(chance.nees(np.arange(start, size)).mean())
    rows = []
    for n in methods:
        runs = max(len(seeds) - lost[n], 1)
        rows.append({
            "filter": n, "seeds": len(seeds), "lost": lost[n],
            "rmse": np.sqrt(square[n] / runs).tolist(),
            "over_bound": float(np.sqrt((square[n] / runs).sum() / limit.sum())),
            "nees": nees[n] / runs, "nees_exact": exact,
            "us_per_sample": 1e6 * seconds[n] / size,
        })  # fmt: skip
    return rows


def main(argv: Sequence[str] | None = None) -> int:
    """Run the studies on fresh seeds and print or write JSON."""
    parser = argparse.ArgumentParser(description="studies of the gas-path filter")
    parser.add_argument("--seeds", type=int, default=len(FRESH), help="number of fresh seeds")
    parser.add_argument("--out", help="file for the JSON; standard output by default")
    args = parser.parse_args(argv)
    seeds = range(FRESH.start, FRESH.start + args.seeds)
    result = {
        "matched": efficiency(seeds, matched=True),
        "mismatched": efficiency(seeds, matched=False),
        "shaft_power": shaft_power(),
        "shaft_power_seeds": [
            shaft_power_seeds(seeds, gains=g, eta=e)
            for g in (False, True) for e in (None, ETA_SIGMA)
        ],
        "filters": compare_filters(seeds[:50]),
    }  # fmt: skip
    text = json.dumps(result, indent=1)
    if args.out:
        with open(args.out, "w", encoding="utf-8") as f:
            f.write(text)
    else:
        print(text)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
