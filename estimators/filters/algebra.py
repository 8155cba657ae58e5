"""Small dense linear algebra written out symbolically, for generated code.

All functions take and return CasADi SX; loops run while the expression is built.  Structural zeros
cost nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

__all__ = [
    "RootUpdate",
    "append_column",
    "backward",
    "cholesky",
    "cholesky_semidefinite",
    "forward",
    "graded_lower",
    "qr_lower",
    "root_and_inverse",
    "root_of",
    "root_update",
    "symmetric",
    "without_gain",
]

TINY = 1e-290  # below it a square counts as zero: its reciprocal would overflow


def _rest(S: ca.SX, L: ca.SX, i: int, j: int) -> ca.SX:
    """Return S[i, j] less what the columns of L before j make of it."""
    rest = S[i, j]
    for k in range(j):
        rest = rest - L[i, k] * L[j, k]
    return rest


def cholesky(S: ca.SX) -> ca.SX:
    """Return lower triangular L with L L' = S; NaN where S is not positive definite."""
    n = S.shape[0]
    L = ca.SX(n, n)
    for j in range(n):
        L[j, j] = ca.sqrt(_rest(S, L, j, j))
        for i in range(j + 1, n):
            L[i, j] = _rest(S, L, i, j) / L[j, j]
    return L


def cholesky_semidefinite(S: ca.SX) -> ca.SX:
    """Return lower triangular L with L L' = S, also for a singular S: a zero column there.

    A pivot below 1e-14 of its diagonal entry is rounding and counts as zero; an S with a negative
    direction is not recognised, so check it elsewhere.
    """
    n = S.shape[0]
    L = ca.SX(n, n)
    for j in range(n):
        d = _rest(S, L, j, j)
        there = d > 1e-14 * S[j, j]
        L[j, j] = ca.if_else(there, ca.sqrt(d), 0)
        for i in range(j + 1, n):
            L[i, j] = ca.if_else(there, _rest(S, L, i, j) / L[j, j], 0)
    return L


def root_and_inverse(S: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return L of :func:`cholesky`, and the inverses of its diagonal; it divides by these alone."""
    n = S.shape[0]
    L, inverse = ca.SX(n, n), ca.SX(n, 1)
    for j in range(n):
        L[j, j] = ca.sqrt(_rest(S, L, j, j))
        inverse[j] = 1 / L[j, j]
        for i in range(j + 1, n):
            L[i, j] = _rest(S, L, i, j) * inverse[j]
    return L, inverse


def forward(L: ca.SX, B: ca.SX, inverse: ca.SX | None = None) -> ca.SX:
    """Return L^-1 B for lower triangular L; ``inverse`` of its diagonal, if it is there."""
    n, m = B.shape
    X = ca.SX(n, m)
    for c in range(m):
        for i in range(n):
            v = B[i, c]
            for k in range(i):
                v = v - L[i, k] * X[k, c]
            X[i, c] = v / L[i, i] if inverse is None else v * inverse[i]
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
    """Return lower triangular L with L L' = A A', by Householder reflections from the right.

    ``A`` is (n, m) with m >= n; it may have any rank, zero rows included.  The diagonal of L is
    not negative.  Unlike a Cholesky factor of A A', this never loses half the digits.  Golub and
    Van Loan (2013), Matrix Computations, algorithm 5.2.1, on the transpose.
    """
    n, m = A.shape
    rows = [[A[i, j] for j in range(m)] for i in range(n)]
    L = ca.SX(n, n)
    for i in range(n):
        # the reflection maps row i onto its entry i and takes the rows below along; entries that
        # are zero by structure stay out of it
        tail = [j for j in range(i + 1, m) if not rows[i][j].is_zero()]
        head = rows[i][i]
        if not tail:
            sign = ca.if_else(head < 0, -1, 1)
            for r in range(i, n):
                L[r, i] = rows[r][i] * sign
            continue
        tail2 = sum((rows[i][j] ** 2 for j in tail), ca.SX(0))
        norm = ca.sqrt(head**2 + tail2)
        # head + sign(head) norm: no cancellation; the column's sign is turned back below
        sign = ca.if_else(head < 0, -1, 1)
        v0 = head + sign * norm
        half = norm * ca.fabs(v0)  # v'v / 2
        beta = ca.if_else(half > TINY, 1 / half, 0)
        L[i, i] = norm
        for r in range(i + 1, n):
            row = rows[r]
            dot = row[i] * v0
            for j in tail:
                dot = dot + row[j] * rows[i][j]
            dot = dot * beta
            for j in tail:
                row[j] = row[j] - dot * rows[i][j]
            L[r, i] = (dot * v0 - row[i]) * sign
    return L


def graded_lower(A: ca.SX) -> ca.SX:
    """Return lower triangular L with L L' = A A', also where the columns of A differ widely.

    ``A`` is (n, m), of any rank.  Rows are made orthogonal one after the other (modified
    Gram-Schmidt): what is taken off an entry is a multiple of its own column, so that a column of
    1 beside one of 1e12 keeps its digits, which reflections would mix.  Thornton and Bierman
    (1980), Control and Dynamic Systems 16, 177; Björck (1996), section 4.4.
    """
    n, m = A.shape
    rows = [[A[i, j] for j in range(m)] for i in range(n)]
    L = ca.SX(n, n)
    for i in range(n):
        filled = [j for j in range(m) if not rows[i][j].is_zero()]
        if not filled:
            continue
        square = sum((rows[i][j] ** 2 for j in filled), ca.SX(0))
        there = square > TINY
        L[i, i] = ca.if_else(there, ca.sqrt(square), 0)
        per = ca.if_else(there, 1 / ca.sqrt(square), 0)
        unit = {j: rows[i][j] * per for j in filled}
        for r in range(i + 1, n):
            along = sum(
                (rows[r][j] * unit[j] for j in filled if not rows[r][j].is_zero()), ca.SX(0)
            )
            if along.is_zero():
                continue
            L[r, i] = along
            for j in filled:
                rows[r][j] = rows[r][j] - along * unit[j]
    return L


def append_column(L: ca.SX, v: ca.SX) -> ca.SX:
    """Return lower triangular L1 with L1 L1' = L L' + v v', by Givens rotations.

    Rows above the first entry of ``v`` that is not zero by structure stay as they are.
    """
    n = L.shape[0]
    L, v = ca.SX(L), ca.SX(v)
    for i in range(n):
        if v[i].is_zero():
            continue
        norm = ca.sqrt(L[i, i] ** 2 + v[i] ** 2)
        per = ca.if_else(norm > 0, 1 / norm, 0)
        c, s = ca.if_else(norm > 0, L[i, i] * per, 1), v[i] * per
        L[i, i] = norm
        for r in range(i + 1, n):
            a, b = L[r, i], v[r]
            L[r, i] = c * a + s * b
            v[r] = c * b - s * a
    return L


class RootUpdate(NamedTuple):
    """A square root after an update with samples of unit noise, in order.

    Args:
        L: lower triangular root of the covariance, (n, n).
        e: innovations made independent, of unit variance, (m,).
        gain: covariance of the state with each of ``e``, (n, m): the mean changes by gain e.
        logdet: logarithm of the determinant of the innovations' covariance.
    """

    L: ca.SX
    e: ca.SX
    gain: ca.SX
    logdet: Any


def root_update(L: ca.SX, D: ca.SX, nu: ca.SX) -> RootUpdate:
    """Update a square root with samples of unit noise; no covariance is ever formed.

    Args:
        L: lower triangular, covariance L L', (n, n).
        D: covariance of the samples with the root's coordinates, H L in a linear model, (m, n).
        nu: innovations, (m,); D and nu in units of the noise, which is white.

    One sample after the other; each multiplies L by the triangular root of I - f f'/(1 + f'f), as
    Carlson (1973), Fast triangular formulation of the square root filter, AIAA J. 11(9).
    """
    n, m = L.shape[0], D.shape[0]
    # the samples still to come are taken along as rows above the root's
    cols = [[[D[k, i] for k in range(m)], [L[r, i] for r in range(n)]] for i in range(n)]
    e, gain, logdet = ca.SX(m, 1), ca.SX(n, m), ca.SX(0)
    nu = ca.SX(nu)
    for j in range(m):
        a2, a = ca.SX(1), ca.SX(1)
        bd, bl = [ca.SX(0)] * m, [ca.SX(0)] * n
        for i in reversed(range(n)):
            d, col = cols[i]
            f = d[j]
            if f.is_zero():
                continue
            below = a
            a2 = a2 + f**2
            a = ca.sqrt(a2)
            c, s = below / a, f / (a * below)
            for k in range(j + 1, m):
                bd[k], d[k] = bd[k] + d[k] * f, c * d[k] - s * bd[k]
            for r in range(i, n):
                bl[r], col[r] = bl[r] + col[r] * f, c * col[r] - s * bl[r]
        e[j] = nu[j] / a
        for k in range(j + 1, m):
            nu[k] = nu[k] - bd[k] / a * e[j]
        for r in range(n):
            gain[r, j] = bl[r] / a
        logdet = logdet + ca.log(a2)
    L1 = ca.SX(n, n)
    for i in range(n):
        for r in range(i, n):
            L1[r, i] = cols[i][1][r]
    return RootUpdate(L1, e, gain, logdet)


def symmetric(P: ca.SX) -> ca.SX:
    """Return P with the upper triangle copied from the lower: half the work, exactly symmetric."""
    n = P.shape[0]
    out = ca.SX(n, n)
    for j in range(n):
        for i in range(j, n):
            out[i, j] = P[i, j]
            out[j, i] = P[i, j]
    return out


def root_of(cov: np.ndarray) -> np.ndarray:
    """Return lower triangular L with L L' = cov, diagonal not negative; cov may be singular.

    Numbers, not symbols.  What is known exactly (zero variance) has a zero row; a covariance that
    is singular otherwise is factored by its eigenvectors, rounding below zero taken as zero.
    """
    L = np.zeros_like(cov)
    rows = np.flatnonzero(np.diag(cov) > 0)
    if not rows.size:
        return L
    part = cov[np.ix_(rows, rows)]
    sigma = np.sqrt(np.diag(part))
    corr = part / np.outer(sigma, sigma)
    try:
        root = np.linalg.cholesky(corr)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh((corr + corr.T) / 2)
        root = np.linalg.qr((vectors * np.sqrt(np.maximum(values, 0.0))).T)[1].T
        root = root * np.where(np.diag(root) < 0, -1.0, 1.0)
    L[np.ix_(rows, rows)] = sigma[:, None] * np.tril(root)
    return L


def without_gain(gain: ca.SX, L: ca.SX, fixed: Sequence[int]) -> tuple[ca.SX, ca.SX]:
    """Return gain and root of an update in which some rows (considered states) have no gain.

    Each row of the optimal gain takes gain gain' off the variance; without gain it stays.
    """
    if not fixed:
        return gain, L
    kept = ca.SX(*gain.shape)
    for i in fixed:
        kept[i, :] = gain[i, :]
        gain[i, :] = 0
    for j in range(gain.shape[1]):
        L = append_column(L, ca.sparsify(kept[:, j]))
    return gain, L
