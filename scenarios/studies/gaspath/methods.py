"""EKF, iterated EKF, UKF and smoother on the same data of the gas path."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from apu_casadi.core.errors import EstimationError
from apu_casadi.gaspath.health import HEALTH
from estimators.apu.gaspath import gas_path_filter
from estimators.apu.gaspathmodel import DT
from estimators.batch.smoother import rts_smoother
from estimators.filters.ukf import unscented_kalman_filter
from estimators.information import consistency
from scenarios.studies.gaspath.chance import LinearReference
from scenarios.studies.gaspath.course import (
    ETA_SIGMA,
    FAULT,
    FRESH,
    draw,
    generators,
    power_profile,
)
from scenarios.studies.gaspath.enginetruth import MatchedTruth, true_states
from scenarios.studies.gaspath.montecarlo import bound_of


def compare_filters(seeds: Sequence[int] = tuple(FRESH)[:50]) -> list[dict[str, Any]]:
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
        rng_case, rng_process, rng_noise = generators(seed)
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
    limit /= -(-len(seeds) // 5)
    exact = float(chance.nees(np.arange(start, size)).mean())
    rows = []
    for n in methods:
        runs = max(len(seeds) - lost[n], 1)
        row = {"filter": n, "seeds": len(seeds), "lost": lost[n]}
        row["rmse"] = np.sqrt(square[n] / runs).tolist()
        row["over_bound"] = float(np.sqrt((square[n] / runs).sum() / limit.sum()))
        row |= {"nees": nees[n] / runs, "nees_exact": exact}
        rows.append(row | {"us_per_sample": 1e6 * seconds[n] / size})
    return rows
