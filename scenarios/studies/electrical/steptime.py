"""Time of one step of the electrical EKF and UKF in generated C, and of filterpy's UKF."""

from __future__ import annotations

import dataclasses
import math
import time
from importlib.util import find_spec
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.backend import compiled
from apu_casadi.core.calling import Caller
from apu_casadi.core.signals import Signals
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.ukf import ukf_step
from estimators.models.filtermodel import FilterModel
from scenarios.studies.electrical.protocol import FULL
from scenarios.studies.electrical.truth import generator_truth, samples_of

__all__ = ["filterpy_step_us", "speed"]

_STEPS = 200  # of filterpy's filter


def speed(repeat: int = 7) -> dict[str, Any]:
    """Time of one step of this filter in generated C, EKF and UKF, microseconds (fastest of some).

    A hundred steps are in one call, so that what Python costs is shared; with and without the mean
    power, and with the gain errors.
    """
    truth = generator_truth(FULL, 0.1)
    samples = samples_of(truth, np.random.default_rng(0))
    rows = {}
    for name, filt in (
        ("fluxes and h (10 states)", electrical_filter()),
        ("with mean power (11 states)", electrical_filter(power=True)),
        ("with gains (18 states)", electrical_filter(gains="estimate")),
    ):
        row = {}
        data, prior = filt.recording(samples), filt.prior(samples)
        for kind, step in (("ekf", ekf_step(filt.model)), ("ukf", ukf_step(filt.model))):
            row[f"{kind}_us"] = _step_time(step.function, data, prior, step.root, repeat)
        rows[name] = row
    return {"goal_us": {"ekf": 5.0, "ukf": 20.0}, "rows": rows}


def _step_time(f: ca.Function, data: Any, prior: Belief, root: bool, repeat: int) -> float:
    """Fastest time of one step, microseconds, a thousand steps at a time."""
    from estimators.filters.algebra import root_of

    steps = 100
    many = compiled(f.mapaccum(f"{f.name()}_timed", steps, 2), backend="c")
    call = Caller(many, copy=False)
    n = slice(0, steps)
    P = root_of(prior.cov) if root else prior.cov
    p = np.repeat(data.p[:, None], steps, 1)
    args = [prior.mean, P, data.u[:, n], p, data.y[:, n], data.variance[:, n], data.dt[None, n]]
    for view, a in zip(call.inputs, args, strict=True):
        view[...] = a
    best = math.inf
    for _ in range(repeat):
        begun = time.perf_counter()
        for _ in range(10):
            call.evaluate()
        best = min(best, (time.perf_counter() - begun) / (10 * steps))
    return 1e6 * best


def filterpy_step_us(repeat: int = 3) -> float | None:
    """Time one step of filterpy's UKF with our electrical model in generated C, microseconds.

    The voltages' noise, which filterpy cannot share between output and transition, is left out; so
    the peer has less to do.  None if filterpy is not installed.
    """
    if find_spec("filterpy") is None:
        return None
    from estimators.filters.filterpy_adapter import filterpy_ukf

    samples = samples_of(generator_truth(FULL, 0.1), np.random.default_rng(0))
    filt = electrical_filter()
    data, prior = filt.recording(samples), filt.prior(samples)
    quiet = _without_noise(filt.model)
    p = dict(zip(quiet.p.names, data.p, strict=True))
    best = math.inf
    for _ in range(repeat):
        kf = filterpy_ukf(quiet, prior, dict.fromkeys(quiet.y.names, 1.0), p=p)
        began = time.perf_counter()
        for k in range(_STEPS):
            kf.update(data.y[:, k], R=np.diag(data.variance[:, k]), u=data.u[:, k])
            kf.predict(dt=data.dt[k], u=data.u[:, k])
        best = min(best, (time.perf_counter() - began) / _STEPS)
    return 1e6 * best


def _without_noise(model: FilterModel) -> FilterModel:
    """Return the model with its noises w at zero."""
    x, u, p, _, dt = model.symbols()
    w, none = ca.MX.zeros(len(model.w)), ca.MX.sym("w", 0)
    f = ca.Function("f", [x, u, p, none, dt], model.transition(x, u, p, w, dt))
    g = ca.Function("g", [x, u, p, none], model.output(x, u, p, w))
    name = f"{model.name}_plain"
    return dataclasses.replace(model, name=name, w=Signals(), transition=f, output=g)
