"""The extended Kalman filter, plain and iterated, with exact Jacobians.

Schmidt (1966) and Jazwinski (1970), Stochastic Processes and Filtering Theory, chapter 8; the
update in Joseph's form, which is right for any gain and so also for considered parameters
(Schmidt-Kalman).  The iterated update is Gauss-Newton on the *prior* and the sample (Bell and
Cathey 1993): the prior is never replaced by the posterior, which would count the sample twice.

State and noise w are corrected together, since w acts on the output and on the transition that
follows; with w absent from the output this is the usual filter.

What to linearise anew.  The score of a sample is unbiased where its derivative H does not hang on
the error of the same sample.  A predicted state does not; the corrected one does, and iterating it
leaves out the derivative of log det S that would make up for it: small, but the same in each
sample, so that it adds up along a recording.  The error w of a *measured input* is the other way
round: the prediction is made at the reading, error and all, and the corrected w takes a part of it
out again.  Hence ``iterated="noise"``, which moves w alone; ``"all"`` is for states that are far
from known, where one sample moves them further than the model is straight.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.core.reciprocals import by_reciprocals
from apu_casadi.core.sharing import kept, of_family, once
from estimators.filters.algebra import backward, cholesky, forward, root_and_inverse, symmetric
from estimators.filters.belief import Belief
from estimators.filters.filtering import STEP_IN, STEP_OUT, FilterResult, FilterStep, run
from estimators.filters.rootfilter import ekf_root_step
from estimators.filters.rowblock import Rows
from estimators.filters.stepparts import (
    iterated_update,
    kind_of,
    linearisation,
    projected,
    step_symbols,
    suffix,
)
from estimators.models.filtermodel import FilterModel
from estimators.models.recording import Recording

__all__ = ["ITERATED", "Corrected", "correct", "ekf_step", "extended_kalman_filter"]

ITERATED = ("all", "noise")


class Corrected(NamedTuple):
    """A Gaussian after a linear update.

    Args:
        d: change of the mean, (n,).
        P: covariance, (n, n).
        S: covariance of the innovation; 1 on the diagonal where nothing was measured.
        nis, loglik: normalised innovation squared, log-likelihood.
        measured: number of outputs measured.
    """

    d: Any
    P: Any
    S: Any
    nis: Any
    loglik: Any
    measured: Any


@once
def _kernel(P_at: tuple[int, ...], H_at: tuple[int, ...], fixed: tuple[int, ...]) -> ca.Function:
    """The update as an SX Function (P, H, nu, R) -> Corrected; ``fixed`` rows have no gain.

    ``P_at``, ``H_at`` are the patterns of P and H, compressed: what is zero by structure is left
    out.
    """
    P, H = (ca.SX.sym(n, ca.Sparsity.compressed(list(at))) for n, at in (("P", P_at), ("H", H_at)))
    ny = H.shape[0]
    nu, R = ca.SX.sym("nu", ny), ca.SX.sym("R", ny)
    out = ca.cse(list(_corrected(P, H, nu, R, fixed)))
    return ca.Function("correct", [P, H, nu, R], [ca.densify(o) for o in out])


def _corrected(P: ca.SX, H: ca.SX, nu: ca.SX, R: ca.SX, fixed: tuple[int, ...]) -> Corrected:
    n, ny = P.shape[0], H.shape[0]
    there = R >= 0
    H = ca.diag(there) @ H
    nu = there * nu
    R = ca.if_else(there, R, 0)
    PH = P @ H.T
    S = symmetric(H @ PH + ca.diag(ca.if_else(there, R, 1)))
    L = cholesky(S)
    a = forward(L, nu)
    K = backward(L, forward(L, PH.T)).T
    if fixed:
        K, P1 = _partly(P, H, K, PH, R, fixed)
    else:
        A = ca.SX.eye(n) - K @ H
        P1 = symmetric(A @ P @ A.T + K @ ca.diag(R) @ K.T)
    nis = ca.dot(a, a)
    measured = ca.sum1(there)
    logdet = 2 * sum((ca.log(L[i, i]) for i in range(ny)), ca.SX(0))
    loglik = -0.5 * (nis + logdet + measured * math.log(2 * math.pi))
    return Corrected(K @ nu, P1, S, nis, loglik, measured)


def _partly(
    P: ca.SX, H: ca.SX, K: ca.SX, PH: ca.SX, R: ca.SX, fixed: tuple[int, ...]
) -> tuple[ca.SX, ca.SX]:
    """Gain and covariance where some rows stay: Joseph's form, products of n x ny matrices only.

    With considered states n is large and ny is not, and their own covariance does not change.
    """
    n = P.shape[0]
    free = [i for i in range(n) if i not in fixed]
    own = K[free, :]
    M = P[free, :] - own @ PH.T
    new = symmetric(M[:, free] - (M @ H.T) @ own.T + own @ ca.diag(R) @ own.T)
    gain, P1 = ca.SX(n, K.shape[1]), ca.SX(P)
    gain[free, :] = own
    P1[free, free] = new
    P1[free, list(fixed)] = M[:, list(fixed)]
    P1[list(fixed), free] = M[:, list(fixed)].T
    return gain, P1


def correct(P: Any, H: Any, nu: Any, R: Any, fixed: tuple[int, ...] = ()) -> Corrected:
    """Update a covariance P (n, n) with a sample, Joseph's form.

    Args:
        P: covariance before.
        H: output Jacobian, (ny, n).
        nu: innovation, (ny,).
        R: variances of the sample, (ny,); negative where nothing was measured.
        fixed: rows of considered states, whose mean and variance stay.
    """
    if isinstance(P, ca.SX):
        return _corrected(P, H, nu, R, fixed)
    P_at, H_at = (tuple(M.sparsity().compress()) for M in (P, H))
    return Corrected(*_kernel(P_at, H_at, fixed)(P, H, nu, R))


class _Factored(NamedTuple):
    """A Gaussian after a linear update as :class:`Corrected` has it, and what it lost: B'B."""

    d: Any
    P: Any
    S: Any
    nis: Any
    loglik: Any
    measured: Any
    B: Any


def _rooted(H: ca.SX, PH: ca.SX, nu: ca.SX, R: ca.SX, measured: ca.SX) -> tuple[Any, ...]:
    """S of an update and its root, inverses of the root's diagonal, L^-1 nu, NIS and likelihood."""
    S = symmetric(H @ PH + ca.diag(R))
    L, inverse = root_and_inverse(S)
    a = forward(L, nu, inverse)
    nis = ca.dot(a, a)
    logdet = 2 * sum((ca.log(L[i, i]) for i in range(H.shape[0])), ca.SX(0))
    loglik = -0.5 * (nis + logdet + measured * math.log(2 * math.pi))
    return S, L, inverse, a, nis, loglik


def _factored(P: ca.SX, H: ca.SX, nu: ca.SX, R: ca.SX, fixed: tuple[int, ...]) -> _Factored:
    """Update state and noise: with S = L L' and B = L^-1 H P, the covariance loses B'B.

    No Joseph form: of a sample far better than the belief, variances lose as many digits as it is
    better, see :data:`estimators.filters.filtering.WIDE`.  What is considered keeps its own.
    """
    nx, n = P.shape[0], H.shape[1]
    there = R >= 0
    H, measured = ca.diag(there) @ H, ca.sum1(there)
    PH = ca.vertcat(P @ H[:, :nx].T, H[:, nx:].T)
    S, L, inverse, a, nis, loglik = _rooted(H, PH, there * nu, ca.if_else(there, R, 1), measured)
    B = forward(L, PH.T, inverse)
    d = B.T @ a
    off = symmetric(B.T @ B)
    held = list(fixed)
    if held:
        d[held] = 0
        off[held, held] = 0
    Pa = ca.diagcat(P, ca.SX.eye(n - nx))
    return _Factored(d, Pa - off, S, nis, loglik, measured, B)


def _in_parts(model: FilterModel) -> Rows | None:
    """The plain filter's step in parts, for blocks whose lanes are rows; None with bounds."""
    if np.isfinite(model.lower).any() or np.isfinite(model.upper).any():
        return None
    nx, _, _, nw, ny = model.sizes
    fixed = tuple(model.x.indices(model.consider))
    m, _, u, p, y, R, dt = step_symbols(model, ca.SX)
    outputs, forecast = linearisation(model, ca.SX, u, p, dt)
    there = R >= 0
    h, H, check = outputs(ca.vertcat(m, ca.SX.zeros(nw)), u, p)
    e, H = model.innovation(y, h), ca.diag(there) @ H
    told = ca.densify(ca.if_else(there, e, 0))
    read = there * e, ca.vertcat(*H.nonzeros()), ca.if_else(there, R, 1), told, check
    at = ca.SX.sym("at", nx + nw)
    # what is considered stays as it is
    s = ca.vertcat(*(m[i] if i in fixed else at[i] for i in range(nx + nw)))
    ahead = forecast(s, u, p, dt)

    H, PH = ca.SX.sym("H", H.sparsity()), ca.SX.sym("PH", nx, ny)
    R1, nu, measured = ca.SX.sym("R", ny), ca.SX.sym("nu", ny), ca.SX.sym("measured")
    whole = ca.vertcat(PH, H[:, nx:].T)
    S, L, inverse, a, nis, loglik = _rooted(H, whole, nu, R1, measured)
    out = [ca.densify(L), inverse, a, ca.diag(S), ca.vertcat(nis, loglik, measured)]
    # a block divides by the diagonal of L once for each state
    gain = by_reciprocals(ca.Function("gain", [H, PH, R1, nu, measured], ca.cse(out)), least=1)
    parts = (m, at, u, p, y, R, dt), (*read, ca.sum1(there)), (*ahead,)
    return Rows(*parts, gain, fixed, tuple((model.walk**2).tolist()))


def _carried(P: ca.SX, F: ca.SX, B: ca.SX, fixed: tuple[int, ...]) -> tuple[ca.SX, ca.SX]:
    """Covariance of state and next state, and of the next state, of :func:`_factored`.

    With the columns f of F that have a gain, c of considered states, G = F_f B_f', D = F_c B_c':

        F P_f F' = F P F' - G (G + D)' - D G'.
    """
    nx, n = P.shape[0], F.shape[1]
    held = list(fixed)
    free = [i for i in range(n) if i not in fixed]
    G, D = F[:, free] @ B[:, free].T, F[:, held] @ B[:, held].T
    X = F[:, :nx] @ P
    P1 = X @ F[:, :nx].T + F[:, nx:] @ F[:, nx:].T - (G @ (G + D).T + D @ G.T)
    C = X.T - B[:, :nx].T @ (G + D).T
    if held:
        # of what is considered the covariance with itself stays
        C[held, :] = X[:, held].T - B[:, held].T @ G.T
    return C, P1


@kept
@of_family
def ekf_step(model: FilterModel, iterations: int = 1, iterated: str = "all") -> FilterStep:
    """Build the filter's step for a model.

    Args:
        model: the model.
        iterations: Gauss-Newton iterations of the update; 1 is the plain filter.
        iterated: what the output is linearised anew at: ``"all"``, state and noise w as corrected,
            or ``"noise"``, the corrected w and the predicted state; see the module's text.

    Raises:
        ParameterError: iterations not a whole number from 1 to 10; unknown ``iterated``; a model
            without states.
    """
    if iterated not in ITERATED:
        raise ParameterError(f"iterated {iterated!r} {nearest(iterated, ITERATED)}")
    if not (isinstance(iterations, int) and 1 <= iterations <= 10):
        raise ParameterError(f"iterations must be a whole number from 1 to 10, got {iterations!r}")
    if not len(model.x):
        raise ParameterError(f"{model.name} has no states to estimate")
    model = model.expanded()
    kind = kind_of(model)
    nx, _, _, nw, _ = model.sizes
    fixed = tuple(model.x.indices(model.consider))
    m, P, u, p, y, R, dt = step_symbols(model, kind)
    prior = ca.vertcat(m, kind.zeros(nw))
    Pa = ca.diagcat(P, kind.eye(nw)) if nw else P

    outputs, forecast = linearisation(model, kind, u, p, dt)

    scalar = kind is ca.SX and iterations == 1

    def update(H: Any, e: Any) -> Any:
        return _factored(P, H, e, R, fixed) if scalar else correct(Pa, H, e, R, fixed)

    found = iterated_update(model, outputs, update, prior, (u, p, y), iterations, iterated)
    moved, check, nu, first, done = found
    at = projected(moved, done.P, model.lower, model.upper, fixed)
    x1, F, c = forecast(at, u, p, dt)
    if scalar:
        C, P1 = _carried(P, F, done.B, fixed)
    else:
        C, P1 = done.P[:nx, :] @ F.T, ca.mtimes(F, done.P @ F.T)
    P1 = P1 + ca.diag(ca.DM(model.walk**2)) * dt
    P1 = ca.tril(P1) + ca.tril(P1, False).T  # half the work, exactly symmetric
    nu = ca.if_else(R >= 0, nu, 0)
    stats = ca.vertcat(check + c, first.nis, first.loglik, first.measured)
    out = [x1, P1, at[:nx], done.P[:nx, :nx], C, nu, first.S, stats]
    out = [ca.densify(o) for o in (ca.cse(out) if kind is ca.SX else out)]
    name = f"ekf{suffix(iterations, iterated)}_{model.name}"
    function = ca.Function(name, [m, P, u, p, y, R, dt], out, STEP_IN, STEP_OUT)
    wide = partial(ekf_root_step, model, iterations, iterated)
    rows = partial(_in_parts, model) if scalar else None
    return FilterStep(model, function, wide=wide, rows=rows)


def extended_kalman_filter(
    model: FilterModel,
    prior: Belief,
    data: Recording,
    *,
    iterations: int = 1,
    iterated: str = "all",
    full: bool = False,
    backend: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FilterResult:
    """Filter a recording: p(x(k) | y(0..k)) as Gaussians.

    Args:
        model: the model.
        prior: belief at the first instant, before its sample.
        data: the recording.
        iterations: Gauss-Newton iterations of each update; 1 is the plain filter.
        iterated: ``"all"`` or ``"noise"``; see :func:`ekf_step`.
        full, backend, progress: see :func:`estimators.filters.filtering.run`.

    Raises:
        DataError, SignalError, EstimationError: see :func:`estimators.filters.filtering.run`.
    """
    step = ekf_step(model, iterations, iterated)
    return run(step, prior, data, full=full, backend=backend, progress=progress)
