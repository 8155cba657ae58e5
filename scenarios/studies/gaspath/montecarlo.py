"""Efficiency and consistency of the gas-path filter over many seeds."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from apu_casadi.core.sharing import kept
from apu_casadi.gaspath.health import HEALTH
from estimators.apu.gaspath import GasPathFilter, gas_path_filter, null_direction
from estimators.apu.gaspathmodel import DT, OUTPUTS
from estimators.apu.healthjumps import track_jumps
from estimators.filters.filtering import FilterResult
from estimators.information import consistency
from estimators.information.bounds import posterior_bound
from estimators.models.filtermodel import FilterModel
from scenarios.studies.gaspath.chance import LinearReference
from scenarios.studies.gaspath.course import (
    CHECKPOINTS,
    DURATION,
    ETA_SIGMA,
    FAULT,
    JUMP_TEST,
    SETTLED,
    VARIANTS,
    Case,
    draw,
    generators,
    power_profile,
    variant,
)
from scenarios.studies.gaspath.enginetruth import EngineTruth, MatchedTruth, Truth, true_states

BOUNDS_EVERY = 20  # trajectories between those whose bound is computed


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
        "nees": nees.tolist(),
        "nees_band": [low4, high4],
        "nees_inside": float(inside.mean()),
        "nees_above": float((nees > high4).mean()),
        "nis": nis_mean.tolist(),
        "nis_band": [low_y, high_y],
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
            "nees": nees_null.tolist(),
            "band": [low1, high1],
            "inside": float(((nees_null >= low1) & (nees_null <= high1)).mean()),
        },
    }


@dataclass
class Alarms:
    """Alarms of the mismatched filter, which has to find the jump itself."""

    false: int = 0
    missed: int = 0
    delays: list[int] = dataclasses.field(default_factory=list)

    def add(self, alarms: Sequence[int]) -> None:
        """Count the alarms of one seed."""
        at = round(FAULT / DT)
        good = [a for a in alarms if a > at]
        self.false += sum(a <= at for a in alarms) + max(len(good) - 1, 0)
        self.missed += not good
        self.delays += [good[0] - at] if good else []

    def measures(self, n: int) -> dict[str, Any]:
        """Return counts and delays of n seeds."""
        shares = {"median": 0.5, "95 %": 0.95, "worst": 1.0}
        delays = {
            q: float(np.quantile(self.delays, v)) if self.delays else math.nan
            for q, v in shares.items()
        }
        counts = {"false_alarms": self.false, "hours": n * DURATION / 3600, "missed": self.missed}
        return {**counts, "delay_samples": delays}


def efficiency(seeds: Sequence[int], *, matched: bool) -> dict[str, Any]:
    """Monte Carlo of the filter on a load drop at 2 s and a jump of health at 6 s.

    Matched: the bound's conditions, the jump told.  Mismatched: other engines, faults to be found.

    Returns:
        ``measures`` at :data:`CHECKPOINTS`; for the matched truth also the NEES that chance alone
        gives (:class:`LinearReference`) and the mean excess over it with its standard error, for
        the mismatched one alarms and delays.
    """
    filt = gas_path_filter(eta=ETA_SIGMA, consider_eta=False)
    power = power_profile()
    engines: dict[str, dict[str, Any]] = {"same engine": {}} if matched else VARIANTS
    kind: Any = MatchedTruth if matched else EngineTruth
    truths = [kind(variant(filt.gg, v)) for v in engines.values()]
    points = np.array([c for c in CHECKPOINTS if matched or not 0 <= c - FAULT < SETTLED])
    c = Collected(np.round(points / DT).astype(int))
    chance, alarms = LinearReference(filt), Alarms()
    told = [FAULT] if matched else []
    for i, seed in enumerate(seeds):
        rng_case, rng_process, rng_noise = generators(seed)
        case = draw(rng_case, filt, matched=matched)
        source = truths[i % len(truths)]
        if not matched:
            case.gains["J"] = source.gg.parameters.J / filt.gg.parameters.J - 1
        truth = source(case, power, rng_process)
        data = filt.measured(truth.t, truth.values, rng_noise, gains=case.sensors, jumps=told)
        if matched:
            r = filt.run(data)
            chance.add(truth, case, data)
        else:
            found = track_jumps(filt, data, test=JUMP_TEST)
            r = found.result
            alarms.add(found.alarms)
        bounded = i % BOUNDS_EVERY == 0
        bound = bound_of(filt, truth, case, jumps=[FAULT]) if bounded else None
        c.add(r, true_states(filt, truth, case), bound)
    null = null_direction(filt, {"N": filt.gg.parameters.N}, {"Wf": filt.gg.design.values["Wf"]})
    first = filt.model.x.index(HEALTH[0])
    out = measures(c, slice(first, first + 4), null, len(OUTPUTS))
    out |= {"checkpoints": points.tolist(), "matched": matched}
    e, P = (np.array(v)[:, :, first : first + 4] for v in (c.error, c.cov))
    every = consistency.nees(e, P[..., first : first + 4])
    out["nees_of"] = {
        name: every[i :: len(truths)].mean(0).tolist() for i, name in enumerate(engines)
    }
    if not matched:
        return out | alarms.measures(len(c.error))
    e_exact, P_exact = chance.errors(c.rows)
    exact = consistency.nees(e_exact, P_exact)
    excess = (every - exact).mean(1)
    along = (e_exact @ null) ** 2 / np.einsum("kij,i,j->k", P_exact, null, null)
    out["null"]["nees_exact"] = along.mean(0).tolist()
    return out | {
        "nees_exact": exact.mean(0).tolist(),
        "nees_excess": float(excess.mean()),
        "nees_excess_stderr": float(excess.std() / math.sqrt(len(excess))),
        # the mean over the run of numbers that are nearly one number
        "nees_independent": consistency.independent(every),
    }
