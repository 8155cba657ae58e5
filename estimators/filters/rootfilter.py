"""The extended Kalman filter in square-root form: for beliefs that are wide and narrow at once.

A covariance in double precision holds a standard deviation of 1 beside one of 1e8 and nothing more:
the sum of two states known to 1, with each of them known to 1e9, is lost when the matrix is stored.
Its root holds twice as many digits.  So the filter here carries a lower triangular root; the update
is Carlson's, the prediction a Gram-Schmidt orthogonalisation, neither of which mixes the wide with
the narrow.  It costs two to three times the covariance filter's time, and is used where that one's
digits run out, see :func:`estimators.filters.filtering.run`.

For the smoother the filter gives, with the next root L1, the roots Y and Z of

    cov(x(k), x(k+1)) = Y L1',   cov(x(k) | x(k+1)) = Z Z'

from one orthogonalisation of next and present state together; Z Z' is never a difference.
"""

from __future__ import annotations

import math
from typing import Any

import casadi as ca

from apu_casadi.core.sharing import kept, of_family, once
from estimators.filters.algebra import graded_lower, root_update, without_gain
from estimators.filters.filtering import ROOT_OUT, STEP_IN, STEP_OUT, FilterStep
from estimators.filters.stepparts import (
    iterated_update,
    kind_of,
    linearisation,
    projected,
    step_symbols,
    suffix,
)
from estimators.models.filtermodel import FilterModel

__all__ = ["ekf_root_step", "root_functions"]


@once
def _update(nx: int, nw: int, ny: int, fixed: tuple[int, ...]) -> ca.Function:
    """SX Function (L, H, nu, R) -> (d, La, S, nis, loglik, measured); ``fixed`` have no gain."""
    n = nx + nw
    L, H = ca.SX.sym("L", ca.Sparsity.lower(nx)), ca.SX.sym("H", ny, n)
    nu, R = ca.SX.sym("nu", ny), ca.SX.sym("R", ny)
    there = R >= 0
    La = ca.diagcat(L, ca.SX.eye(nw))
    per = ca.if_else(there, 1 / ca.sqrt(ca.if_else(there, R, 1)), 0)
    # what is not measured: no innovation, no sensitivity, unit noise
    D = ca.diag(ca.if_else(there, 1, 0)) @ (H @ La)
    done = root_update(La, ca.sparsify(ca.diag(per) @ D), per * nu)
    gain, L1 = without_gain(done.gain, done.L, fixed)
    S = D @ D.T + ca.diag(ca.if_else(there, R, 1))
    nis, measured = ca.dot(done.e, done.e), ca.sum1(there)
    logdet = done.logdet + ca.sum1(ca.log(ca.if_else(there, R, 1)))
    loglik = -0.5 * (nis + logdet + measured * math.log(2 * math.pi))
    out = [gain @ done.e, ca.project(L1, ca.Sparsity.lower(n)), S, nis, loglik, measured]
    return ca.Function("root_update", [L, H, nu, R], [ca.densify(o) for o in ca.cse(out)])


@once
def _predict(nx: int, nw: int, walk: tuple[float, ...]) -> ca.Function:
    """SX Function (La, F, dt) -> (L1, C, Y, Z)."""
    n = nx + nw
    La, F = ca.SX.sym("La", ca.Sparsity.lower(n)), ca.SX.sym("F", nx, n)
    dt = ca.SX.sym("dt")
    noise = ca.sparsify(ca.diag(ca.SX(ca.DM(list(walk))))) * ca.sqrt(dt)
    D, own = F @ La, La[:nx, :]
    both = ca.vertcat(ca.horzcat(D, noise), ca.horzcat(own, ca.SX(nx, nx)))
    G = graded_lower(ca.sparsify(both))
    out = [G[:nx, :nx], own @ D.T, G[nx:, :nx], G[nx:, nx:]]
    return ca.Function("root_predict", [La, F, dt], [ca.densify(o) for o in ca.cse(out)])


def root_functions(model: FilterModel, fixed: tuple[int, ...]) -> tuple[ca.Function, ca.Function]:
    """Return update and prediction for a model; see :func:`_update` and :func:`_predict`."""
    nx, _, _, nw, ny = model.sizes
    walk: Any = tuple(float(v) for v in model.walk)
    return _update(nx, nw, ny, fixed), _predict(nx, nw, walk)


@kept
@of_family
def ekf_root_step(model: FilterModel, iterations: int = 1, iterated: str = "all") -> FilterStep:
    """Build the extended filter's step with roots; arguments of :func:`~.ekf.ekf_step`.

    Its function gives ``STEP_OUT`` and, for the smoother, Y and Z as the module has them and the
    root of the filtered covariance.
    """
    model = model.expanded()
    kind = kind_of(model)
    nx, _, _, nw, _ = model.sizes
    fixed = tuple(model.x.indices(model.consider))
    update, predict = root_functions(model, fixed)
    m, L, u, p, y, R, dt = step_symbols(model, kind)
    low = ca.tril(L)
    prior = ca.vertcat(m, kind.zeros(nw))

    outputs, forecast = linearisation(model, kind, u, p, dt)
    moved, check, nu, first, (_, La, *_) = iterated_update(
        model, outputs, lambda H, e: update(low, H, e, R), prior, (u, p, y), iterations, iterated
    )
    own = La[:nx, :nx]
    P_f = ca.mtimes(own, own.T)
    at = projected(moved, ca.mtimes(La, La[:nx, :].T), model.lower, model.upper, fixed)
    x1, F, c = forecast(at, u, p, dt)
    L1, C, Y, Z = predict(La, F, dt)
    _, _, S, nis, loglik, measured = first
    stats = ca.vertcat(check + c, nis, loglik, measured)
    out = [x1, L1, at[:nx], P_f, C, ca.if_else(R >= 0, nu, 0), S, stats, Y, Z, own]
    out = [ca.densify(o) for o in (ca.cse(out) if kind is ca.SX else out)]
    name = f"ekf{suffix(iterations, iterated)}_root_{model.name}"
    function = ca.Function(name, [m, L, u, p, y, R, dt], out, STEP_IN, STEP_OUT + ROOT_OUT)
    return FilterStep(model, function, root=True)
