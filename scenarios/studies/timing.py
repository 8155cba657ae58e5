"""Times of the estimation: the joint run, and filterpy's UKF as the peer of our own step."""

from __future__ import annotations

import dataclasses
import math
import time
from importlib.util import find_spec
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.signals import Signals
from estimators.models.filtermodel import FilterModel

__all__ = ["filterpy_step_us", "joint_seconds"]

STEPS = 200  # of filterpy's filter


def joint_seconds(scenario: str = "joint", repeat: int = 3, seed: int = 1) -> dict[str, Any]:
    """Time the joint estimation of a scenario on one core; compiled before, fastest of some.

    Returns:
        ``seconds`` of measuring and estimating, and ``simulated`` seconds.
    """
    from scenarios.studies.jointrun import estimate, truth

    ds = truth(scenario)
    best = math.inf
    estimate(ds, seed)  # compiles
    for _ in range(repeat):
        began = time.perf_counter()
        estimate(ds, seed)
        best = min(best, time.perf_counter() - began)
    return {"seconds": best, "simulated": float(ds["time"].values[-1])}


def filterpy_step_us(repeat: int = 3) -> float | None:
    """Time one step of filterpy's UKF with our electrical model in generated C, microseconds.

    The voltages' noise, which filterpy cannot share between output and transition, is left out; so
    the peer has less to do.  None if filterpy is not installed.
    """
    if find_spec("filterpy") is None:
        return None
    from estimators.apu.electrical.electricalfilter import electrical_filter
    from estimators.filters.filterpy_adapter import filterpy_ukf
    from scenarios.studies.electrical.protocol import FULL
    from scenarios.studies.electrical.truth import generator_truth, samples_of

    samples = samples_of(generator_truth(FULL, 0.1), np.random.default_rng(0))
    filt = electrical_filter()
    data, prior = filt.recording(samples), filt.prior(samples)
    quiet = _without_noise(filt.model)
    p = dict(zip(quiet.p.names, data.p, strict=True))
    best = math.inf
    for _ in range(repeat):
        kf = filterpy_ukf(quiet, prior, dict.fromkeys(quiet.y.names, 1.0), p=p)
        began = time.perf_counter()
        for k in range(STEPS):
            kf.update(data.y[:, k], R=np.diag(data.variance[:, k]), u=data.u[:, k])
            kf.predict(dt=data.dt[k], u=data.u[:, k])
        best = min(best, (time.perf_counter() - began) / STEPS)
    return 1e6 * best


def _without_noise(model: FilterModel) -> FilterModel:
    """Return the model with its noises w at zero."""
    x, u, p, _, dt = model.symbols()
    w, none = ca.MX.zeros(len(model.w)), ca.MX.sym("w", 0)
    return dataclasses.replace(
        model, name=f"{model.name}_plain", w=Signals(),
        transition=ca.Function("f", [x, u, p, none, dt], model.transition(x, u, p, w, dt)),
        output=ca.Function("g", [x, u, p, none], model.output(x, u, p, w)),
    )  # fmt: skip
