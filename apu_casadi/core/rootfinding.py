"""Roots of small nonlinear systems, with a verdict that can be believed.

``Newton`` is a damped Newton method around two compiled functions.  It knows nothing of turbines.
Its result always carries the residual *re-evaluated at the returned point*, because CasADi's own
root finders report success with residuals above the tolerance on hard points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np


@dataclass(frozen=True)
class Root:
    """Where the iteration ended.

    Args:
        x: last point, shape (n,), also when the search failed (the best point reached).
        residual: max-norm of the residual at x.
        worst: index of the largest residual.
        success: residual <= tolerance.
        iterations: Newton steps taken.
        reason: "" on success, otherwise what stopped the search.
    """

    x: np.ndarray
    residual: float
    worst: int
    success: bool
    iterations: int
    reason: str


class Newton:
    """Damped Newton method for 0 = r(x, p) with exact Jacobian.

    Args:
        residual: Function (x, p) -> r with as many rows in r as in x.
        scale: typical magnitudes of x, shape (n,); steps are limited to ``max_step`` times these.
        lower, upper: bounds that no iterate crosses (temperatures stay positive), shape (n,).
        tol: largest acceptable max-norm of r.
    """

    scale: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    tol: float
    max_iterations: int
    max_step: float

    def __init__(
        self,
        residual: ca.Function,
        *,
        scale: np.ndarray,
        lower: np.ndarray | None = None,
        upper: np.ndarray | None = None,
        tol: float = 1e-10,
        max_iterations: int = 40,
        max_step: float = 0.3,
    ) -> None:
        """Build residual and Jacobian as one function; see the class."""
        n = residual.size1_in(0)
        if residual.size1_out(0) != n:
            raise ValueError(f"{residual.size1_out(0)} equations for {n} unknowns")
        x, p = ca.MX.sym("x", n), ca.MX.sym("p", residual.size1_in(1))
        r = residual(x, p)
        self._rj = ca.Function("rj", [x, p], [r, ca.densify(ca.jacobian(r, x))])
        self._r = residual
        self.scale = np.asarray(scale, float)
        self.lower = np.full(n, -np.inf) if lower is None else np.asarray(lower, float)
        self.upper = np.full(n, np.inf) if upper is None else np.asarray(upper, float)
        self.tol, self.max_iterations, self.max_step = tol, max_iterations, max_step

    def __call__(self, start: Sequence[float] | np.ndarray, p: np.ndarray) -> Root:
        """Search from ``start``; never raises for a failed search, look at ``success``."""
        x = np.clip(np.asarray(start, float), self.lower, self.upper)
        reason = f"no convergence in {self.max_iterations} steps"
        r = np.asarray(self._r(x, p)).ravel()
        norm = _norm(r)
        k = 0
        for k in range(1, self.max_iterations + 1):
            if norm <= self.tol * 1e-2 or not np.isfinite(norm):
                k -= 1
                break
            _, J = self._rj(x, p)
            Js = np.asarray(J) * self.scale
            try:
                d = np.linalg.solve(Js, -r)
            except np.linalg.LinAlgError:
                d = np.linalg.lstsq(Js, -r, rcond=None)[0]
            if not np.all(np.isfinite(d)):
                reason = "singular Jacobian"
                break
            d *= min(1.0, self.max_step / max(np.abs(d).max(), 1e-300))
            for _ in range(12):
                x_try = np.clip(x + d * self.scale, self.lower, self.upper)
                r_try = np.asarray(self._r(x_try, p)).ravel()
                norm_try = _norm(r_try)
                if norm_try < norm:
                    break
                d *= 0.5
            else:
                reason = "no descent"
                break
            stalled = norm_try <= self.tol and norm_try > 0.5 * norm
            x, r, norm = x_try, r_try, norm_try
            if stalled:  # at rounding level
                break
        if not np.isfinite(norm):
            reason = "residual not finite at the start"
            return Root(x, float("inf"), int(np.argmax(~np.isfinite(r))), False, k, reason)
        ok = norm <= self.tol
        return Root(x, norm, int(np.argmax(np.abs(r))), ok, k, "" if ok else reason)


def _norm(r: np.ndarray) -> float:
    """Max-norm; infinite when anything is not a number."""
    return float(np.abs(r).max()) if np.all(np.isfinite(r)) else float("inf")


def solve_bordered(A: Any, B: Any, k: int) -> Any:
    """Solve A X = B for an A whose leading k by k block is lower triangular, as an expression.

    Args:
        A: sparse SX, shape (n, n); the diagonal of the leading block must not vanish.
        B: SX, shape (n, m).
        k: size of that block.

    Returns:
        X, shape (n, m).  Forward substitution leaves a system of the n - k others, solved by
        orthogonalisation, which needs no pivots: the code has no branches.
    """
    n = A.shape[0]
    lower, border, C, D = A[:k, :k], A[:k, k:], A[k:, :k], A[k:, k:]
    W = ca.solve(lower, ca.horzcat(border, B[:k, :]))
    W_border, W_B = W[:, : n - k], W[:, n - k :]
    last = ca.solve(D - ca.mtimes(C, W_border), B[k:, :] - ca.mtimes(C, W_B))
    return ca.vertcat(W_B - ca.mtimes(W_border, last), last)


def schur_sign(A: Any, k: int) -> Any:
    """Return the sign of det(A) over det of its triangular block, for A as in `solve_bordered`.

    That is the sign of the determinant of the Schur complement, an expression.
    """
    lower, border, C, D = A[:k, :k], A[:k, k:], A[k:, :k], A[k:, k:]
    return ca.sign(ca.det(ca.densify(D - ca.mtimes(C, ca.solve(lower, border)))))
