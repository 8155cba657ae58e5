"""Measurement noise that is not known, or changes: R adapted from the innovations.

Each adapted output has a factor of its variance as a state, ``noise_<output>``, with a gamma belief
of its inverse that is forgotten over a memory: Särkkä and Nummenmaa (2009), IEEE Trans. Automatic
Control 54, 596, variational Bayes with forgetting.  What an update tells of the noise v is

    E v^2 = (R S^-1 nu)^2 + R - R S^-1 R    (diagonals),

the residual and what the state's own uncertainty leaves open, of any filter that gives its
innovation nu and its covariance S; unlike a mean of nu^2 less the predicted variance it is never
negative.

What it means.  The factor's standard deviation is that of a variance estimated from as many samples
as the memory holds, sqrt(2 / samples), no less; the bounds are the user's, and a factor at one says
that the noise lies beyond.  Only R is adapted: what the model misses (too small a walk, a fault)
goes into R as well, and widens beliefs where Q should.  Innovations tell the two apart by their
correlation, which needs a recording: :func:`estimators.batch.noisefit.fit_noise`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError, SignalError
from apu_casadi.core.sharing import kept, of_family, once, remade
from apu_casadi.core.signals import Signal, Signals
from estimators.filters.algebra import cholesky, forward
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import STEP_IN, STEP_OUT, FilterResult, FilterStep, StepMaker, run
from estimators.filters.stepparts import step_symbols
from estimators.models.filtermodel import FilterModel, Unknown
from estimators.models.recording import Recording

__all__ = ["PREFIX", "adaptive_filter", "adaptive_noise", "adaptive_step", "at_bounds"]

PREFIX = "noise_"  # of a factor's state


@remade
@of_family
def adaptive_noise(
    model: FilterModel, outputs: Sequence[str], bounds: tuple[float, float] = (0.1, 100.0)
) -> FilterModel:
    """Return the model with a factor of each output's variance as a state of its own.

    Args:
        outputs: whose noise is adapted.
        bounds: lowest and highest factor.

    Raises:
        SignalError: unknown output. ParameterError : bounds that do not hold 1.
    """
    model.y.indices(outputs)
    low, high = bounds
    if not 0 < low <= 1 <= high < math.inf or low == high:
        raise ParameterError(f"bounds of a factor: 0 < lowest <= 1 <= highest, got {bounds!r}")
    factors = [Signal(f"{PREFIX}{n}", "1", f"factor of the variance of {n}", 1.0) for n in outputs]
    nx = len(model.x)
    _, u, p, w, dt = model.symbols()
    x = ca.MX.sym("x", nx + len(factors))
    x1, check = model.transition(x[:nx], u, p, w, dt)
    return FilterModel.of(
        model.name,
        (model.x + Signals(factors), model.u, model.p, model.w, model.y),
        (x, u, p, w, dt),
        (ca.vertcat(x1, x[nx:]), check),
        model.output(x[:nx], u, p, w),
        like=model,
        more={s.name: Unknown(lower=low, upper=high) for s in factors},
    )


def _adapted(model: FilterModel) -> list[str]:
    """Outputs with a factor, which are the last states."""
    return [n[len(PREFIX) :] for n in model.x.names if n.startswith(PREFIX)]


def _without(model: FilterModel) -> FilterModel:
    """The model that :func:`adaptive_noise` was given."""
    n = len(model.x) - len(_adapted(model))
    _, u, p, w, dt = model.symbols()
    x = ca.MX.sym("x", n)
    full = ca.vertcat(x, ca.DM.ones(len(model.x) - n))
    x1, check = model.transition(full, u, p, w, dt)
    f = ca.Function(f"{model.name}_f", [x, u, p, w, dt], [x1[:n], check])
    g = ca.Function(f"{model.name}_g", [x, u, p, w], [*model.output(full, u, p, w)])
    return dataclasses.replace(
        model,
        x=Signals(model.x[:n]),
        transition=f,
        output=g,
        walk=model.walk[:n],
        lower=model.lower[:n],
        upper=model.upper[:n],
    )


@once
def _moments(ny: int) -> ca.Function:
    """SX Function (nu, S, R) -> mean square of the noise v after an update, (ny,)."""
    nu, S, R = ca.SX.sym("nu", ny), ca.SX.sym("S", ny, ny), ca.SX.sym("R", ny)
    L = cholesky(S)
    half = forward(L, ca.diag(R))  # its columns' squares are the diagonal of R S^-1 R
    v = half.T @ forward(L, nu)
    return ca.Function("moments", [nu, S, R], [v**2 + R - ca.sum1(half**2).T])


@kept
@of_family
def adaptive_step(
    model: FilterModel,
    memory: float,
    step: StepMaker = ekf_step,
) -> FilterStep:
    """Build a filter's step that adapts the variances of its samples.

    Args:
        model: of :func:`adaptive_noise`.
        memory: time over which the noise is taken for constant, s.
        step: makes the filter of the states, which is run with the adapted variances.

    Raises:
        ParameterError: a model without factors, memory not positive.
    """
    outputs = _adapted(model)
    if not outputs:
        raise ParameterError(f"{model.name} has no factors of noise; adaptive_noise() makes them")
    if not 0 < memory < math.inf:
        raise ParameterError(f"memory must be finite and > 0 s, got {memory!r}")
    base = step(_without(model)).plain.function
    n, q, ny = len(model.x) - len(outputs), len(outputs), len(model.y)
    rows = model.y.indices(outputs)
    low, high = (ca.DM(b[n:]) for b in (model.lower, model.upper))
    m, P, u, p, y, R, dt = step_symbols(model, ca.MX)
    # the inverse of a factor is gamma of shape a, the factor its scale over a
    before = m[n:]
    a = before**2 / ca.fmax(ca.diag(P)[n:], 1e-9 * before**2)
    there = R[rows] >= 0
    new_a, factor, first, out = a + there / 2, before, None, []
    for _ in range(2):  # states and factors in turn
        noise = ca.MX(R)
        noise[rows] = ca.if_else(there, R[rows] * factor, R[rows])
        out = base(m[:n], P[:n, :n], u, p, y, noise, dt)
        first = out if first is None else first
        square = _moments(ny)(out[5], out[6], ca.if_else(R >= 0, noise, 1))[rows]
        told = (a * before + there * square / ca.if_else(there, R[rows], 1) / 2) / new_a
        factor = ca.fmin(ca.fmax(told, low), high)
    assert first is not None
    spread = factor**2 / new_a
    forgotten = spread * ca.exp(dt / memory)
    wide = [ca.diagcat(out[i], ca.diag(s)) for i, s in ((1, forgotten), (3, spread), (4, spread))]
    means = ca.vertcat(out[0], factor), ca.vertcat(out[2], factor)
    results = [means[0], wide[0], means[1], *wide[1:], *first[5:]]
    name = f"{base.name()}_adaptive{q}"
    ends = [ca.densify(r) for r in results]
    made = ca.Function(name, [m, P, u, p, y, R, dt], ends, STEP_IN, STEP_OUT)
    return FilterStep(model, made)


def adaptive_filter(
    model: FilterModel,
    prior: Belief,
    data: Recording,
    outputs: Sequence[str] | None = None,
    *,
    memory: float,
    bounds: tuple[float, float] = (0.1, 100.0),
    sigma: float = 0.5,
    step: StepMaker = ekf_step,
    full: bool = False,
    backend: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FilterResult:
    """Filter a recording while the variances of its samples are adapted.

    Innovations, NIS and likelihood are those of the factors before each sample.

    Args:
        model, prior, data: as of :func:`~estimators.filters.ekf.extended_kalman_filter`; the
            recording's variances are those of factor 1.
        outputs: whose noise is adapted; all by default.
        memory, step: see :func:`adaptive_step`.
        bounds: of the factors of the variances.
        sigma: relative standard deviation of the factors before the first sample.
        full, backend, progress: see :func:`estimators.filters.filtering.run`.

    Returns:
        FilterResult: with states ``noise_<output>``, factors of the variance and how well they are
        known; :func:`at_bounds` says where they were held.

    Raises:
        ParameterError, SignalError: as :func:`adaptive_noise` and :func:`adaptive_step`; sigma not
            positive.
        DataError, EstimationError: see :func:`estimators.filters.filtering.run`.
    """
    if not 0 < sigma < math.inf:
        raise ParameterError(f"sigma of the factors must be finite and > 0, got {sigma!r}")
    names = model.y.names if outputs is None else tuple(outputs)
    wide = adaptive_noise(model, names, bounds)
    if prior.x.names != model.x.names:
        raise SignalError(
            f"prior of {', '.join(prior.x.names)}; {model.name} has {', '.join(model.x.names)}"
        )
    n, q = len(model.x), len(names)
    cov = np.zeros((n + q, n + q))
    cov[:n, :n] = prior.cov
    cov[n:, n:] = sigma**2 * np.eye(q)
    begin = Belief(wide.x, np.append(prior.mean, np.ones(q)), cov)
    of = adaptive_step(wide, memory, step)
    return run(of, begin, data, full=full, backend=backend, progress=progress)


def at_bounds(model: FilterModel, result: FilterResult) -> dict[str, float]:
    """Return the share of instants at which a factor was held at a bound, by output, if any.

    Args:
        model: of :func:`adaptive_noise`, with the same bounds.
        result: of its filter.
    """
    found = {}
    for n in _adapted(model):
        i, value = model.x.index(f"{PREFIX}{n}"), result[f"{PREFIX}{n}"][0]
        held = (value <= model.lower[i] * (1 + 1e-12)) | (value >= model.upper[i] * (1 - 1e-12))
        if held.any():
            found[n] = float(held.mean())
    return found
