"""How well a state can be known at best: posterior Cramer-Rao bounds.

Of one true trajectory, :func:`posterior_bound` is the covariance recursion of the extended Kalman
filter with every Jacobian taken at the truth.  For additive Gaussian noise this is the recursion of
Tichavsky, Muravchik and Nehorai (1998), IEEE Trans. Signal Processing 46, 1386, eqs. 21 and 34-36,
written in covariances: no inverse of the process noise is needed, so that constants, noise w shared
by output and transition, and missing samples are handled exactly.  What is assumed:

* Gaussian prior and noises of the model's variances;
* one trajectory stands for all that are likely: the Jacobians do not vary much over them.  On a
  linear model nothing is assumed, and the bound is the Kalman filter's covariance.

:func:`expected_bound` takes the expectation over several trajectories.  It never lies above the
harmonic or the arithmetic mean of the single bounds: the Schur complement that eliminates a past
state is concave in the information, and the inverse convex.  An efficient filter's mean square
error, averaged over trajectories, therefore follows the *mean of the single bounds* more closely.

Considered states (Schmidt's filter) are left alone here too: the bound is then one for estimators
that do so.  For a bound on every estimator, make them ordinary unknowns.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.backend import compiled
from apu_casadi.core.calling import Caller
from apu_casadi.core.errors import EstimationError, SignalError
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signal, Signals
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.models.filtermodel import CHECK_TOL, FilterModel, inlined
from estimators.models.recording import Recording

__all__ = ["error_model", "expected_bound", "linearisations", "posterior_bound", "snapshot_bound"]

COMPILE_FROM = 1000  # samples from which compiling the Jacobians pays
#: Largest change, over the nominal values, that counts as none in a transition's Jacobian.
SAME_JACOBIAN = 1e-9


def snapshot_bound(H: Any, R: Any, prior_cov: Any = None) -> np.ndarray:
    """Return the covariance of theta after one sample y = H theta + v, shape (n, n).

    (H' R^-1 H + prior^-1)^-1, written as a Kalman update where there is a prior.  Exact for a
    linear sample; the Cramer-Rao bound of any sample with H = dy/dtheta at the truth.

    Args:
        H: (ny, n).
        R: covariance of v, (ny, ny), or its variances, (ny,); positive.
        prior_cov: (n, n), may be singular; None if nothing is known before.

    Raises:
        SignalError: shapes that do not fit, or R not positive definite.
        EstimationError: without a prior, some direction does not show in the sample.
    """
    H, R = np.atleast_2d(np.asarray(H, float)), np.asarray(R, float)
    ny, n = H.shape
    if R.shape not in ((ny,), (ny, ny)):
        raise SignalError(f"R: shape ({ny},) or ({ny}, {ny}) expected for {ny} outputs: {R.shape}")
    R = np.diag(R) if R.ndim == 1 else R
    try:
        L = np.linalg.cholesky(R)
    except np.linalg.LinAlgError:
        raise SignalError("R is not positive definite: every output needs a variance > 0") from None
    if prior_cov is None:
        scale = np.maximum(np.linalg.norm(H, axis=0), np.finfo(float).tiny)
        _, s, Vt = np.linalg.svd(np.linalg.solve(L, H / scale), full_matrices=True)
        rank = int((s > 1e-10 * s[0]).sum()) if s.size else 0
        if rank < n:
            raise EstimationError(
                f"{n - rank} of {n} directions do not show in these {ny} outputs: give a prior, or "
                "see estimators.information.identifiability for what they are"
            )
        half = (Vt.T / s) / scale[:, None]
        return np.asarray(half @ half.T)
    P = np.asarray(prior_cov, float)
    if P.shape != (n, n):
        raise SignalError(f"prior_cov: shape ({n}, {n}) expected, got {P.shape}")
    S = H @ P @ H.T + R
    K = np.linalg.solve(S, H @ P).T
    A = np.eye(n) - K @ H
    P = A @ P @ A.T + K @ R @ K.T
    return np.asarray((P + P.T) / 2)


def _truth_of(model: FilterModel, data: Recording, truth: Any) -> np.ndarray:
    data.check(model)
    x = np.asarray(truth, float)
    if x.shape != (len(model.x), data.size):
        raise SignalError(
            f"truth of {model.name}: shape ({len(model.x)}, {data.size}) expected, got {x.shape}"
        )
    if not np.isfinite(x).all():
        i, k = np.argwhere(~np.isfinite(x))[0]
        raise SignalError(f"truth of {model.name}: {model.x.names[i]} not finite at sample {k}")
    return x


@kept
def error_model(model: FilterModel) -> FilterModel:
    """Return the linear model of small errors whose Jacobians come as inputs.

    Its states are the errors of ``model``'s states, under their names; its inputs are the entries
    of H and of F, both over state and noise, column by column.  The extended Kalman filter is exact
    on it: with Jacobians taken at the truth its covariance is the bound.
    """
    nx, _, _, nw, ny = model.sizes
    n = nx + nw
    x, w, dt = ca.SX.sym("x", nx), ca.SX.sym("w", nw), ca.SX.sym("dt")
    u, p = ca.SX.sym("u", (ny + nx) * n), ca.SX.sym("p", 0)
    s = ca.vertcat(x, w)
    H, F = ca.reshape(u[: ny * n], ny, n), ca.reshape(u[ny * n :], nx, n)
    name = f"{model.name}_error"
    return dataclasses.replace(
        model,
        name=name,
        u=Signals([Signal(f"J{i}", "1", "entry of a Jacobian") for i in range(u.shape[0])]),
        p=Signals(),
        output=ca.Function(
            f"{name}_g", [x, u, p, w], [H @ s, 0], ["x", "u", "p", "w"], ["y", "check"]
        ),
        transition=ca.Function(
            f"{name}_f", [x, u, p, w, dt], [F @ s, 0], ["x", "u", "p", "w", "dt"], ["x1", "check"]
        ),
        lower=np.full(nx, -np.inf),
        upper=np.full(nx, np.inf),
    )


def posterior_bound(
    model: FilterModel, prior: Belief, data: Recording, truth: Any, *, backend: str | None = None
) -> np.ndarray:
    """Return the bound on the covariance of x(k) given the samples 0..k, shape (K, nx, nx).

    Args:
        model: the model; its noises, walks and considered states count.
        prior: belief at the first instant, before its sample; only its covariance matters.
        data: instants, *true* inputs, variances and known parameters; of ``y`` only which values
            are missing (NaN).  With true inputs, w = 0 is the truth, and is where derivatives are
            taken.
        truth: true states at the instants, shape (nx, K).
        backend: see :func:`apu_casadi.core.backend.compiled`.

    Raises:
        DataError, SignalError, EstimationError: shapes, names, or a truth at which the model cannot
            be evaluated; see :func:`estimators.filters.filtering.run`.
    """
    x = _truth_of(model, data, truth)
    if prior.x.names != model.x.names:
        raise SignalError(
            f"prior of {', '.join(prior.x.names)}; {model.name} has {', '.join(model.x.names)}"
        )
    error = error_model(model)
    H, F = linearisations(model, data, x, backend=backend)
    # column by column, as the model takes them
    u = np.concatenate([J.transpose(0, 2, 1).reshape(data.size, -1) for J in (H, F)], axis=1).T
    y = np.where(np.isnan(data.y), np.nan, 0.0)
    zero = Belief(error.x, np.zeros(len(error.x)), prior.cov)
    sample = Recording(data.t, u, y, data.variance, np.zeros(0))
    found = extended_kalman_filter(error, zero, sample, full=True, backend=backend)
    assert found.cov is not None
    return found.cov


@kept
def _jacobians(model: FilterModel) -> ca.Function:
    """Function (x, u, p, dt) -> (H, F, check), both over state and noise, at w = 0."""
    x, u, p, w, dt = model.symbols()
    y, c_y = inlined(model.output, x, u, p, w)
    x1, c_f = inlined(model.transition, x, u, p, w, dt)
    out = [
        ca.horzcat(ca.jacobian(y, x), ca.jacobian(y, w)),
        ca.horzcat(ca.jacobian(x1, x), ca.jacobian(x1, w)),
        c_y + c_f,
    ]
    out = ca.graph_substitute(out, [w], [ca.MX.zeros(len(model.w))])
    return ca.Function(f"{model.name}_jacobians", [x, u, p, dt], [ca.densify(o) for o in out])


@kept
def _jacobian_call(model: FilterModel, build: bool, backend: str | None) -> Caller:
    return Caller(compiled(_jacobians(model), backend=backend, build=build), copy=False)


def linearisations(
    model: FilterModel, data: Recording, truth: Any, *, backend: str | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobians of output and transition along a truth, at w = 0.

    ``backend`` as in :func:`apu_casadi.core.backend.compiled`.

    Returns:
        H: d output / d (x, w), shape (K, ny, nx + nw). F : d next state / d (x, w), shape (K, nx,
        nx + nw).

    Raises:
        DataError, SignalError: shapes that do not fit.
        EstimationError: the model cannot be evaluated at some instant, which is named.
    """
    x = _truth_of(model, data, truth)
    K, nx, ny = data.size, len(model.x), len(model.y)
    n, check = nx + len(model.w), np.empty(K)
    H, F = np.empty((K, ny, n)), np.empty((K, nx, n))
    call = _jacobian_call(model, K >= COMPILE_FROM, backend)
    for k, dt in enumerate(data.dt):
        h, f, c = call(x[:, k], data.u[:, k], data.p, dt)
        H[k], F[k], check[k] = h.reshape(ny, n), f.reshape(nx, n), c[0]
    finite = np.isfinite(H).all((1, 2)) & np.isfinite(F).all((1, 2))
    bad = ~finite | ~(check <= CHECK_TOL)
    if bad.any():
        k = int(np.argmax(bad))
        raise EstimationError(
            f"{model.name} cannot be linearised at t = {data.t[k]:.9g} s (sample {k}): its check "
            f"is {check[k]:.1e}, {CHECK_TOL:.0e} allowed; is the truth one of this model?"
        )
    return H, F


def expected_bound(
    model: FilterModel, prior: Belief, data: Sequence[Recording], truth: Sequence[Any]
) -> np.ndarray:
    """Return the bound with its information terms averaged over trajectories, (K, nx, nx).

    Tichavsky, Muravchik and Nehorai (1998), eqs. 34-36, the expectations taken over the given
    truths.  In covariances: with the mean Jacobian F and the process noise Q, the scatter of the
    Jacobians is information of its own, E[(F_m - F)' Q^-1 (F_m - F)], on the state before the
    step; then P goes on to F P F' + Q.

    Args:
        model, prior: as for :func:`posterior_bound`.
        data: one recording for each trajectory, with the same instants, measured outputs and
            variances; inputs may differ.
        truth: true states of each, shape (nx, K).

    Raises:
        EstimationError: the Jacobian of a state without process noise differs between trajectories;
            the terms are then infinite.  Average single bounds instead.
        SignalError: recordings that do not belong together, or shapes that do not fit.
    """
    if len(data) != len(truth) or not data:
        raise SignalError(f"{len(data)} recordings for {len(truth)} truths")
    if model.consider:
        raise EstimationError(
            f"{model.name} considers {', '.join(model.consider)}; make them ordinary unknowns"
        )
    first = data[0]
    for d in data[1:]:
        same = np.array_equal(d.t, first.t) and np.array_equal(np.isnan(d.y), np.isnan(first.y))
        if not (same and np.array_equal(d.variance, first.variance)):
            raise SignalError("the recordings must share instants, measured outputs and variances")
    parts = [linearisations(model, d, x) for d, x in zip(data, truth, strict=True)]
    H, F = (np.stack([part[i] for part in parts]) for i in (0, 1))
    M, K, nx, nw = H.shape[0], first.size, len(model.x), len(model.w)
    noise = np.append(model.x.nominals, np.ones(nw))
    mean = F.mean(0)
    scatter = F - mean
    P, out = prior.cov, np.empty((K, nx, nx))
    for k in range(K):
        there = ~np.isnan(first.y[:, k])
        Pa = np.block(
            [[P, np.zeros((nx, nw))], [np.zeros((nw, nx)), np.eye(nw)]]
        )  # state and noise
        # the mean of M informations: all M samples, each with M times the variance
        rows = H[:, k, there].reshape(-1, nx + nw)
        if len(rows):
            Pa = snapshot_bound(rows, np.tile(M * first.variance[there, k], M), Pa)
        out[k] = Pa[:nx, :nx]
        Q = model.walk**2 * first.dt[k]
        size = np.abs(scatter[:, k]).max(0) * noise / model.x.nominals[:, None]
        fixed = (Q == 0) & (size.max(1) > SAME_JACOBIAN)
        if fixed.any() and k + 1 < K:
            i = int(np.argmax(np.where(fixed, size.max(1), 0)))
            raise EstimationError(
                f"{model.name}: {model.x.names[i]} has no process noise, but its Jacobian differs "
                f"by up to {size[i].max():.1e} between trajectories at t = {first.t[k]:.9g} s; the "
                "expected information is infinite: average posterior_bound over them instead"
            )
        moving = np.flatnonzero(Q > 0)
        rows = scatter[:, k, moving].reshape(-1, nx + nw)
        if len(rows) and np.abs(rows).max() > 0:
            Pa = snapshot_bound(rows, np.tile(M * Q[moving], M), Pa)
        P = mean[k] @ Pa @ mean[k].T + np.diag(Q)
        P = (P + P.T) / 2
    return out
