"""Whether an estimator gets what the bounds of shaft-power snapshots promise: random snapshots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from apu_casadi.core.errors import EstimationError
from apu_casadi.core.measuring import measure
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
from estimators.apu.identify import (
    BASE,
    PRIOR,
    SAMPLES,
    gas_path,
    shaft_power_snapshot,
    steady_point,
)
from estimators.apu.sensors import GAS_PATH
from estimators.information import consistency
from estimators.information.sensitivities import steady_sensitivities

__all__ = ["Trials", "snapshot_trials"]


@dataclass(frozen=True)
class Trials:
    """Maximum a posteriori estimates from random snapshots, without and with shaft power.

    Args:
        seeds: number of snapshots.
        rms_before, rms_after: rms error of the four health factors, without and with PW.
        bound_before, bound_after: what the bound says of them.
        reduction: of the rms error by PW.
        interval: 95 % interval of the reduction over the seeds (bootstrap of 2000).
        nees: mean normalised estimation error squared of the four factors over 4, with PW; 1
            ideally.
        nees_band: its 95 % band if the claimed covariances are right.
        null_before, null_after: rms error along the null direction.
    """

    seeds: int
    rms_before: float
    rms_after: float
    bound_before: float
    bound_after: float
    reduction: float
    interval: tuple[float, float]
    nees: float
    nees_band: tuple[float, float]
    null_before: float
    null_after: float


@dataclass(frozen=True, eq=False)
class _Reader:
    """The nonlinear steady readings of (N, Wf, health) about a point, with exact derivatives."""

    gg: GasGenerator
    at: OperatingPoint

    def __call__(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return all outputs (ny,) and their derivatives (ny, 6) along steady states."""
        gg, U = self.gg, self.gg.U
        x, u, theta = v[:1], self.at.u.copy(), v[2:]
        u[U.index("Wf")] = v[1]
        z = gg.solve(self.at.z, x, u, theta)
        # cycle equations do not contain PW: the balance gives it from the rate at any other
        ode, alg, _ = gg.equations(x, z, u, theta)
        u[U.index("PW")] += float(ode) * gg.parameters.J * float(v[0])
        worst = float(ca.norm_inf(alg))
        if not worst < RESIDUAL_TOL:
            raise EstimationError(
                f"no steady readings at health {np.round(theta, 4)}: cycle residual {worst:.1e}, "
                f"{RESIDUAL_TOL:.0e} allowed; the draw left the maps"
            )
        _, y, xdot_w, y_w, _ = (a.full() for a in gg.cycle.sensitivities(x, z, u, theta))
        w = gg.X + gg.U + gg.THETA
        H, _ = steady_sensitivities(
            xdot_w, y_w, w, unknown=["N", "Wf", *gg.THETA.names], solved=["PW"]
        )
        return y[:, 0], H


def snapshot_trials(
    point: str = "design",
    *,
    seeds: Sequence[int] = range(10_000, 10_500),
    prior: float = PRIOR,
    power_noise: float = GAS_PATH["PW"].noise,
    eta_bias: float = 0.0,
    samples: int = SAMPLES,
    gas_generator: GasGenerator | None = None,
) -> Trials:
    """Estimate the health factors from random snapshots of the nonlinear engine.

    Health drawn from the prior, noise and efficiency bias from their distributions; the estimate is
    the most probable one (Gauss-Newton on the exact equations).  It shows whether the bounds of
    :func:`shaft_power_snapshot`, which are first order, are what an estimator gets.

    Raises:
        EstimationError: a draw has no steady readings, or the iteration does not converge.
    """
    gg = GasGenerator() if gas_generator is None else gas_generator
    at, names = steady_point(point, gg), GAS_PATH.names
    read, rows = _Reader(gg, at), gg.Y.indices(names)
    nominal = np.array([at[n] for n in names])
    sigma = np.array([GAS_PATH.sigma(n, v) for n, v in zip(names, nominal, strict=True)])
    sigma /= math.sqrt(samples)
    power = names.index("PW")
    # considered: in the variance of the reading, where Schmidt's gain is the optimal one
    bias = eta_bias * nominal[power]
    sigma[power] = power_noise * nominal[power]
    claimed = sigma.copy()
    claimed[power] = math.hypot(sigma[power], bias)
    start = np.array([at["N"], at["Wf"], 1.0, 1.0, 1.0, 1.0])
    without = [i for i in range(len(rows)) if i != power]
    before: list[np.ndarray] = []
    after: list[np.ndarray] = []
    covs: list[np.ndarray] = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        true = start.copy()
        true[2:] += prior * rng.standard_normal(4)
        y = measure(read(true)[0][rows], sigma, rng)
        y[power] += bias * rng.standard_normal()
        for errors, use in ((before, without), (after, list(range(len(rows))))):
            of = [rows[i] for i in use]
            found, cov = _most_probable(read, start, y[use], of, claimed[use], prior)
            errors.append((found - true)[2:])
        covs.append(cov[2:, 2:])
    nees = float(np.mean(consistency.nees(np.array(after), np.array(covs)) / 4))
    low, high = consistency.band(len(covs), 4)
    g = gas_path(
        point,
        sensors=GAS_PATH,
        samples=samples,
        prior=prior,
        power_noise=power_noise,
        eta_bias=eta_bias,
        gas_generator=gg,
    )
    least, best = (float(np.sqrt(np.trace(b.covariance()) / 4)) for b in (g.only(BASE), g))
    null = shaft_power_snapshot(point, samples=samples, prior=prior, gas_generator=gg)["null"]
    along = np.array(list(null.values()))
    e0, e1 = np.array(before), np.array(after)
    of_null = _rms(e0 @ along), _rms(e1 @ along)
    rms = _rms(e0), _rms(e1)
    reduced = 1 - rms[1] / rms[0], _interval(e0, e1)
    band = low / 4, high / 4
    return Trials(len(e0), *rms, least, best, *reduced, nees, band, *of_null)


def _rms(e: np.ndarray) -> float:
    return float(np.sqrt(np.mean(e**2)))


def _interval(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """95 % interval of the reduction of the rms error over the seeds, by the bootstrap."""
    n = len(before)
    pick = np.random.default_rng(0).integers(0, n, (2000, n))
    square = np.array([(e**2).sum(1) for e in (before, after)])
    drawn = 1 - np.sqrt(square[1][pick].sum(1) / square[0][pick].sum(1))
    low, high = (float(q) for q in np.quantile(drawn, [0.025, 0.975]))
    return low, high


def _most_probable(
    read: _Reader,
    start: np.ndarray,
    y: np.ndarray,
    rows: Sequence[int],
    sigma: np.ndarray,
    prior: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the most probable (N, Wf, health) and its covariance, by Gauss-Newton."""
    v = start.copy()
    weights = np.array([0.0, 0.0, *[1 / prior] * 4])
    for _ in range(20):
        h, H = read(v)
        A = np.vstack([H[rows] / sigma[:, None], np.diag(weights)]) * start
        r = np.concatenate([(y - h[rows]) / sigma, weights * (start - v)])
        step = start * np.linalg.lstsq(A, r, rcond=None)[0]
        v = v + step
        if np.abs(step / start).max() < 1e-8:
            return v, np.asarray(np.linalg.inv(A.T @ A) * np.outer(start, start))
    raise EstimationError(
        f"the most probable health was not found in 20 steps; last step "
        f"{np.abs(step / start).max():.1e} of the nominal values"
    )
