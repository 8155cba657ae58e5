"""Small dense linear algebra written out symbolically, for generated code.

All functions take and return CasADi SX; loops run while the expression is built.  Structural zeros
cost nothing.
"""

from __future__ import annotations

import casadi as ca

__all__ = ["as_symbols_of", "backward", "cholesky", "forward", "qr_lower", "symmetric"]


def cholesky(S: ca.SX) -> ca.SX:
    """Return lower triangular L with L L' = S; NaN where S is not positive definite."""
    n = S.shape[0]
    L = ca.SX(n, n)
    for j in range(n):
        d = S[j, j]
        for k in range(j):
            d = d - L[j, k] ** 2
        L[j, j] = ca.sqrt(d)
        for i in range(j + 1, n):
            v = S[i, j]
            for k in range(j):
                v = v - L[i, k] * L[j, k]
            L[i, j] = v / L[j, j]
    return L


def forward(L: ca.SX, B: ca.SX) -> ca.SX:
    """Return L^-1 B for lower triangular L."""
    n, m = B.shape
    X = ca.SX(n, m)
    for c in range(m):
        for i in range(n):
            v = B[i, c]
            for k in range(i):
                v = v - L[i, k] * X[k, c]
            X[i, c] = v / L[i, i]
    return X


def backward(L: ca.SX, B: ca.SX) -> ca.SX:
    """Return L'^-1 B for lower triangular L."""
    n, m = B.shape
    X = ca.SX(n, m)
    for c in range(m):
        for i in reversed(range(n)):
            v = B[i, c]
            for k in range(i + 1, n):
                v = v - L[k, i] * X[k, c]
            X[i, c] = v / L[i, i]
    return X


def qr_lower(A: ca.SX) -> ca.SX:
    """Return lower triangular L with L L' = A A', by Givens-free Householder reflections.

    ``A`` is (n, m) with m >= n.  The diagonal of L is not negative.  Unlike a Cholesky factor of
    A A', this never loses half the digits.
    """
    n, m = A.shape
    rows = [[A[i, j] for j in range(m)] for i in range(n)]
    for i in range(n):
        # reflect row i onto its entry i; the rows below follow
        norm2 = sum((rows[i][j] ** 2 for j in range(i, m)), ca.SX(0))
        norm = ca.sqrt(norm2)
        head = rows[i][i]
        sign = ca.if_else(head >= 0, 1, -1)
        v0 = head + sign * norm
        # beta = 2 / v'v; zero rows are left alone
        vv = 2 * (norm2 + ca.fabs(head) * norm)
        beta = ca.if_else(vv > 0, 2 / vv, 0)
        v = [v0, *rows[i][i + 1 :]]
        for r in range(i + 1, n):
            dot = sum((a * b for a, b in zip(v, rows[r][i:], strict=True)), ca.SX(0)) * beta
            for j in range(i, m):
                rows[r][j] = rows[r][j] - dot * v[j - i]
        rows[i][i] = -sign * norm
        for j in range(i + 1, m):
            rows[i][j] = ca.SX(0)
    L = ca.SX(n, n)
    for i in range(n):
        for j in range(i + 1):
            # the sign of a column of L is free
            L[i, j] = (
                rows[i][j] * ca.if_else(rows[j][j] < 0, -1, 1) if i != j else ca.fabs(rows[i][i])
            )
    return L


def symmetric(P: ca.SX) -> ca.SX:
    """Return P with the upper triangle copied from the lower: half the work, exactly symmetric."""
    n = P.shape[0]
    out = ca.SX(n, n)
    for j in range(n):
        for i in range(j, n):
            out[i, j] = P[i, j]
            out[j, i] = P[i, j]
    return out


def as_symbols_of(kind: type, fun: ca.Function) -> ca.Function:
    """Return ``fun`` as it should be called from expressions of ``kind``.

    Called with SX it is written out and its structural zeros vanish; with MX it stays a call.
    """
    return fun if kind is ca.MX else fun.expand()
