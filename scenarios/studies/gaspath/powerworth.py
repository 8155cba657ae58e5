"""Gas-path filters with and without shaft power: covariances, and errors over many seeds."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.health import HEALTH
from estimators.apu.gaspath import (
    HEALTH_SIGMA,
    MODEL_ERROR,
    GasPathFilter,
    gas_path_filter,
    null_direction,
)
from estimators.apu.gaspathmodel import DT
from estimators.apu.sensors import GAS_PATH
from estimators.filters.filtering import FilterResult
from scenarios.studies.gaspath.course import (
    FAULT,
    FINE,
    LOAD_DROP,
    Case,
    draw,
    generators,
    power_profile,
)
from scenarios.studies.gaspath.enginetruth import EngineTruth, MatchedTruth

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


def _reduced(P: np.ndarray, P0: np.ndarray, null: np.ndarray) -> dict[str, Any]:
    """Compare a covariance with shaft power, P, with that without."""
    return {
        "with": math.sqrt(np.trace(P)),
        "without": math.sqrt(np.trace(P0)),
        "reduction": 1 - math.sqrt(np.trace(P) / np.trace(P0)),
        "null_with": math.sqrt(null @ P @ null),
        "null_without": math.sqrt(null @ P0 @ null),
        "factors": (1 - np.sqrt(np.diag(P) / np.diag(P0))).tolist(),
    }


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
                    choice = {"gains": gains, "prior": prior, "eta": eta or 0.0, "noise": noise}
                    when = {
                        w: _reduced(_health_cov(known, r, k), base[w], null)
                        for w, k in points.items()
                    }
                    table.append({**choice, **when})
    return {"null_direction": null.tolist(), "table": table}


def shaft_power_seeds(seeds: Sequence[int], *, gains: bool, eta: float | None) -> dict[str, Any]:
    """Monte Carlo of one choice of :func:`shaft_power`: actual errors with and without the power.

    Returns:
        Reduction at both instants with its 95 % interval (bootstrap over seeds), RMSE of each
        factor, and along the null direction actual and claimed errors of both filters.
    """
    noise = 0.01  # of the power
    pair = _pair(gains, eta, HEALTH_SIGMA, noise)
    power = power_profile()[: round(TRANSIENT / DT) * FINE]
    source = MatchedTruth(pair[0].gg)
    fuel = source.gg.design.values["Wf"]
    null = null_direction(pair[0], {"N": source.gg.parameters.N}, {"Wf": fuel})
    points = {"snapshot": round(SNAPSHOT / DT), "transient": round(TRANSIENT / DT)}
    error: list[list[list[np.ndarray]]] = []
    claimed: list[list[list[float]]] = []
    for seed in seeds:
        rng_case, rng_process, rng_noise = generators(seed)
        case = dataclasses.replace(draw(rng_case, pair[0], matched=True), jump=np.zeros(4))
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
    out: dict[str, Any] = {"gains": gains, "eta": eta, "prior": HEALTH_SIGMA}
    out |= {"noise": noise, "seeds": len(E)}
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
