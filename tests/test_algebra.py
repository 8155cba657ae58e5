"""Dense algebra written out symbolically, against NumPy.

Golub and Van Loan (2013), algorithms 4.2.1 (Cholesky), 5.2.1 (Householder); Carlson (1973).
Tolerances are rounding of systems of a few unknowns.
"""

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from estimators.filters.algebra import (
    append_column,
    backward,
    cholesky,
    cholesky_semidefinite,
    forward,
    qr_lower,
    root_of,
    root_update,
    symmetric,
)

EXACT = dict(rtol=1e-12, atol=1e-12)


def evaluate(fun, *arrays):
    """``fun`` of SX symbols of these patterns, with these numbers."""
    given = [a if isinstance(a, ca.DM) else ca.DM(np.asarray(a, float)) for a in arrays]
    s = [ca.SX.sym(f"a{i}", a.sparsity()) for i, a in enumerate(given)]
    made = fun(*s)
    single = not isinstance(made, tuple)
    out = ca.Function("f", s, [made] if single else list(made))(*given)
    return np.array(out) if single else [np.array(o) for o in out]


def spd(seed, n):
    M = np.random.default_rng(seed).standard_normal((n, n))
    return M @ M.T + 0.1 * np.eye(n)


def test_cholesky_and_substitution():
    """L L' = S, and both solves."""
    S, B = spd(0, 5), np.random.default_rng(1).standard_normal((5, 3))
    L = evaluate(cholesky, S)
    assert_allclose(L, np.linalg.cholesky(S), **EXACT)
    assert_allclose(evaluate(forward, L, B), np.linalg.solve(L, B), **EXACT)
    assert_allclose(evaluate(backward, L, B), np.linalg.solve(L.T, B), **EXACT)
    assert np.isnan(evaluate(cholesky, [[1.0, 2], [2, 1]])).any(), "not positive: no silence"


@pytest.mark.parametrize(
    "S",
    [spd(2, 4), np.zeros((2, 2)), np.diag([0, 2.0, 0]), np.ones((3, 3)), 1e-30 * np.ones((2, 2))],
)
def test_cholesky_of_semidefinite_matrices(S):
    """Zero columns where there is nothing, no NaN; the usual root otherwise."""
    L = evaluate(cholesky_semidefinite, S)
    assert_allclose(L @ L.T, S, atol=1e-14 * np.abs(S).max())
    assert (np.triu(L, 1) == 0).all()


@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (3, 3), (4, 9)])
def test_qr_lower(shape):
    """L L' = A A', lower, diagonal not negative, for every shape and sign."""
    for seed in range(5):
        A = np.random.default_rng(seed).standard_normal(shape)
        L = evaluate(qr_lower, A)
        assert_allclose(L @ L.T, A @ A.T, **EXACT)
        assert (np.triu(L, 1) == 0).all() and (np.diag(L) >= 0).all()


@pytest.mark.parametrize(
    "A",
    [
        np.zeros((3, 5)),
        [[0, 0, 0, 0], [1, 2, 3, 4], [2, 4, 6, 8]],
        [[-1, 0, 0], [2, 0, 0], [3, 0, 1]],
        [[1e-200, 0, 0], [0, 1e-200, 1e-200]],
        [[1e-300, 1e-300], [1, 1]],
    ],
)
def test_qr_lower_of_any_rank(A):
    """Zero rows, dependent rows, numbers whose squares vanish: no NaN, and L L' = A A'."""
    A = np.array(A, float)
    for given in (A, ca.sparsify(ca.DM(A))):
        L = evaluate(qr_lower, given)
        assert_allclose(L @ L.T, A @ A.T, atol=1e-12)
        assert (np.diag(L) >= 0).all()


def test_qr_lower_keeps_digits_that_squares_lose():
    """Läuchli's matrix: A A' is singular in double precision for e = 1e-9, L is right to 1e-7."""
    e = 1e-9
    L = evaluate(qr_lower, [[1, e, 0], [1, 0, e]])
    assert_allclose(L[1, 1], e * np.sqrt(2), rtol=1e-7)


def test_structural_zeros_cost_nothing():
    """A diagonal block beside a full one needs far fewer operations than a full matrix."""
    full = ca.SX.sym("A", 6, 12)
    half = ca.horzcat(ca.SX.sym("B", ca.Sparsity.lower(6)), ca.SX.sym("D", ca.Sparsity.diag(6)))
    n_full, n_half = (ca.Function("f", [ca.symvar(A) and ca.vertcat(*ca.symvar(A))], [qr_lower(A)])
                      .n_instructions() for A in (full, half))  # fmt: skip
    assert n_half < 0.75 * n_full


def test_append_column():
    """L1 L1' = L L' + v v', with zero entries and zero roots."""
    L = np.linalg.cholesky(spd(3, 4))
    v = np.array([0, 1.0, -2, 0.5])
    for given in (v, ca.sparsify(ca.DM(v))):
        L1 = evaluate(append_column, L, given)
        assert_allclose(L1 @ L1.T, L @ L.T + np.outer(v, v), **EXACT)
        assert (np.triu(L1, 1) == 0).all()
    Z = np.zeros((3, 3))
    w = np.array([1.0, 0, 2])
    L1 = evaluate(append_column, Z, w)
    assert_allclose(L1 @ L1.T, np.outer(w, w), **EXACT)
    assert (evaluate(append_column, Z, 0 * w) == 0).all()


def test_root_update_is_the_kalman_update():
    """Covariance, gain, innovations and determinant of a linear update with unit noise."""
    rng = np.random.default_rng(5)
    P, H, nu = spd(5, 4), rng.standard_normal((3, 4)), rng.standard_normal(3)
    H[1, 2:] = 0
    L = np.linalg.cholesky(P)
    L1, e, gain, logdet = evaluate(lambda *a: tuple(root_update(*a)), L, H @ L, nu)
    S = H @ P @ H.T + np.eye(3)
    K = P @ H.T @ np.linalg.inv(S)
    assert_allclose(L1 @ L1.T, P - K @ S @ K.T, **EXACT)
    assert (np.triu(L1, 1) == 0).all() and (np.diag(L1) > 0).all()
    assert_allclose(gain @ e, (K @ nu)[:, None], **EXACT)
    assert_allclose((e**2).sum(), nu @ np.linalg.solve(S, nu), **EXACT)
    assert_allclose(logdet, np.linalg.slogdet(S)[1], **EXACT)
    assert_allclose(P - L1 @ L1.T, gain @ gain.T, **EXACT)


@pytest.mark.parametrize(
    "cov",
    [
        spd(1, 4),
        np.diag([1.0, 0, 4]),
        np.zeros((2, 2)),
        np.array([[1.0, 1, 0], [1, 1, 0], [0, 0, 2]]),
        np.array([[1e12, 1e3], [1e3, 1e-6]]),
        np.ones((4, 4)),
    ],
)
def test_root_of(cov):
    """L L' = cov for singular ones too, in any units; diagonal not negative, zero rows stay."""
    L = root_of(cov)
    s = np.sqrt(np.diag(cov))
    assert_allclose(L @ L.T, cov, atol=1e-14 * np.outer(s, s).max())
    assert (np.triu(L, 1) == 0).all() and (np.diag(L) >= 0).all()
    assert (L[s == 0] == 0).all()


def test_symmetric():
    """The lower triangle rules."""
    P = np.arange(9.0).reshape(3, 3)
    Q = evaluate(symmetric, P)
    assert (Q == Q.T).all() and (np.tril(Q) == np.tril(P)).all()
