"""Time of one step of the electrical EKF and UKF in generated C."""

from __future__ import annotations

import math
import time
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.backend import Caller, compiled
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.ukf import ukf_step
from scenarios.studies.electrical.protocol import FULL
from scenarios.studies.electrical.truth import generator_truth, samples_of

__all__ = ["speed"]


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
    args = [prior.mean, P, data.u[:, n], np.repeat(data.p[:, None], steps, 1), data.y[:, n],
            data.variance[:, n], data.dt[None, n]]  # fmt: skip
    for view, a in zip(call.inputs, args, strict=True):
        view[...] = a
    best = math.inf
    for _ in range(repeat):
        begun = time.perf_counter()
        for _ in range(10):
            call.evaluate()
        best = min(best, (time.perf_counter() - begun) / (10 * steps))
    return 1e6 * best
