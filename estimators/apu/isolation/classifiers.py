"""The two classifiers: one filter whose innovations are judged, and a bank of filters."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy import special

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import GasGenerator
from estimators.apu.isolation.evidence import class_evidence, log_box
from estimators.apu.isolation.problem import CLASSES, DEFAULT, DT, FAULTS, OUTPUTS, Protocol
from estimators.apu.isolation.truth import Windows
from estimators.apu.isolation.windowmodel import JUMPS, directions_of, model_of, prior_of
from estimators.detection.glr import glr
from estimators.detection.signatures import linearised
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import FilterResult
from estimators.filters.filtering import run as run_filter
from estimators.models.filtermodel import FilterModel
from estimators.models.recording import Recording

__all__ = ["METHODS", "Verdict", "isolate", "recording_of"]

METHODS = ("glr", "bank")


def recording_of(model: FilterModel, w: Windows, i: int, protocol: Protocol) -> Recording:
    """Return one window as the classifiers take it; direction 1 is the loss."""
    K = protocol.size
    t = DT * np.arange(K)
    y = w.reading[: len(OUTPUTS), i]
    Wf, PW = w.reading[len(OUTPUTS) :, i]
    sensors = protocol.sensors
    # noise in proportion to the reading; the mean, since a noisy sigma would favour low readings
    sigma = np.array(
        [
            protocol.noise * (protocol.h_noise if n == "h" else sensors.sigma(n, float(np.mean(v))))
            for n, v in zip(OUTPUTS, np.nan_to_num(y), strict=True)
        ]
    )
    inputs = dict(zip(AMBIENT, w.ambient[:, i], strict=True))
    inputs |= {
        "sigma_Wf": protocol.noise * sensors.sigma("Wf", float(np.mean(Wf))),
        "sigma_PW": protocol.noise * sensors.sigma("PW", float(np.mean(PW))),
    } | directions_of(["loss"])
    u = model.u.pack({**dict.fromkeys(("Wf", "PW"), 0.0), **inputs})
    u = np.repeat(u[:, None], K, axis=1)
    u[model.u.index("Wf")], u[model.u.index("PW")] = Wf, PW
    return Recording(t, u, y, np.repeat(sigma[:, None] ** 2, K, axis=1), np.zeros(0))


@dataclass(frozen=True)
class Verdict:
    """What the classifiers say of one window.

    Args:
        log_probability: by method, of each class, (classes,).
        onset: most probable one, sample.
        nis: mean normalised innovation squared of the healthy filter before any onset, over its
            expectation.
        sizes: most probable sizes under the bank's best class, by fault name.
    """

    log_probability: dict[str, np.ndarray]
    onset: int
    nis: float
    sizes: dict[str, float] = field(default_factory=dict)


def isolate(
    data: Recording,
    protocol: Protocol = DEFAULT,
    gg: GasGenerator | None = None,
    *,
    methods: Sequence[str] = METHODS,
    backend: str | None = None,
) -> Verdict:
    """Say which class a window belongs to.

    Args:
        data: the window; see :func:`simulate_windows`.
        protocol: its layout, and the priors.
        gg: the engine as the classifiers know it.
        methods: ``"glr"``, and ``"bank"`` beside it.
        backend: see :func:`apu_casadi.core.backend.compiled`.

    Raises:
        ParameterError: unknown method. EstimationError : a filter failed.
    """
    for m in methods:
        if m not in METHODS:
            raise ParameterError(f"unknown method {m!r} {nearest(m, METHODS)}")
    gg = GasGenerator() if gg is None else gg
    model = model_of(gg, protocol.N_walk)
    step = ekf_step(model)
    healthy = run_filter(
        step, prior_of(model, protocol, gg.parameters.N), data, full=True, backend=backend
    )
    along = linearised(model, healthy, data, JUMPS, backend=backend)
    evidence = glr(along, protocol.onsets)
    each = class_evidence(evidence.b, evidence.C)  # (classes, onsets)
    whole = special.logsumexp(each, axis=1) - math.log(each.shape[1])
    out = {"glr": whole - special.logsumexp(whole)}
    best = int(np.argmax(special.logsumexp(each[1:], axis=0)))
    sizes: dict[str, float] = {}
    if "bank" in methods:
        k = int(protocol.onsets[best])
        at_onset, found = _bank(step, healthy, data, k, backend)
        # the onset is integrated out as in the linear problem
        total = at_onset + whole - each[:, best]
        total[0] = 0.0
        out["bank"] = total - special.logsumexp(total)
        sizes = found[int(np.argmax(total))]
    # without a time before the fault this is the healthy filter's misfit, not its consistency
    before = slice(0, protocol.first or protocol.size)
    nis = float(healthy.nis[before].sum() / healthy.measured[before].sum())
    return Verdict(out, int(protocol.onsets[best]), nis, sizes)


def _bank(
    step: Any, healthy: FilterResult, data: Recording, k: int, backend: str | None
) -> tuple[np.ndarray, list[dict[str, float]]]:
    """Evidence of each class against the healthy one, by its own filter from sample k on."""
    model = step.model
    assert healthy.mean_pred is not None and healthy.cov_pred is not None
    mean, cov = healthy.mean_pred[:, k], healthy.cov_pred[k]
    rest = data.part(k, data.size)
    rows = model.x.indices(("size_1", "size_2"))
    (first_direction,) = directions_of(FAULTS[:1])
    first = model.u.index(first_direction)
    reference = 0.0
    out: list[float] = []
    found: list[dict[str, float]] = []
    for c in CLASSES:
        n = len(c.faults)
        mu, var = c.normal()
        m, P = mean.copy(), (cov + cov.T) / 2
        m[rows[:n]] = mu
        P[rows[:n], rows[:n]] = var
        u = rest.u.copy()
        u[first:] = 0.0
        for name in directions_of(c.faults):
            u[model.u.index(name)] = 1.0
        r = run_filter(step, Belief(model.x, m, P), dataclasses.replace(rest, u=u), backend=backend)
        if not n:
            reference = r.loglik
            out.append(0.0)
            found.append({})
            continue
        post = r.final.marginal(("size_1", "size_2")[:n])
        # the likelihood of the sizes is the posterior with its normal prior divided out
        W = np.diag(1 / var)
        V = np.linalg.inv(post.cov)
        C, b = V - W, V @ post.mean - W @ mu
        C = (C + C.T) / 2
        at = C @ mu
        M = np.eye(n) + np.diag(var) @ C
        normal = b @ mu - 0.5 * at @ mu - 0.5 * np.linalg.slogdet(M)[1]
        normal += 0.5 * (b - at) @ np.linalg.solve(M, np.diag(var) @ (b - at))
        out.append(r.loglik - normal + float(log_box(b, C, c.boxes)))
        found.append(dict(zip(c.faults, post.mean.tolist(), strict=True)))
    return np.array(out) - np.r_[0.0, np.full(len(out) - 1, reference)], found
