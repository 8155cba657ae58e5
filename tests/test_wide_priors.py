"""Priors from 1e-6 to 1e12 times the noise, against rational arithmetic, which has no rounding.

A double holds 16 digits, so a covariance holds a standard deviation of 1 beside one of 1e8 and no
more; the filters go on with roots, which hold twice as much.  What is left at 1e12: the elements of
a root are rounded to 1e-16 of 1e12, 1e-4 of the narrow direction, which adds up in squares to 1e-8.
"""

import pickle
from fractions import Fraction
from functools import lru_cache

import numpy as np
import pytest
from estimation_models import linear

from apu_casadi.core.errors import EstimationError, SignalError
from estimators.batch.mhe import moving_horizon
from estimators.batch.relinearised import relinearised_filter
from estimators.batch.smoother import rts_smoother
from estimators.filters.algebra import graded_lower
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.filters.imm import interacting_multiple_models
from estimators.filters.ukf import ukf_step, unscented_kalman_filter
from estimators.models.recording import Recording

RATIOS = (1e-6, 1e4, 1e8, 1e12)
NOISE = 1e-6
#: A, C, walk over the noise: a level, a place and its speed, a sum of two, two nearly equal
#: sensors of two, a rotation that mixes three.
CASES = {
    "level": ([[1.0]], [[1.0]], [1.0]),
    "constant": ([[1.0]], [[1.0]], [0.0]),
    "speed": ([[1, 0.1], [0, 1]], [[1.0, 0]], [1e-2, 1e-1]),
    "sum": ([[1.0, 0], [0, 1]], [[1.0, 1.0]], [0.1, 0.1]),
    "near": ([[1.0, 0], [0, 1]], [[1.0, 1.0], [1.0, 1.001]], [0.1, 0.1]),
    "mixed": ([[0.8, 0.6, 0], [-0.6, 0.8, 0], [0, 0.1, 0.9]], [[1.0, 0, 1]], [0.1, 0.1, 0.1]),
}
#: Largest error of a variance, relative.  Reflections, by which the unscented filter predicts, mix
#: wide and narrow columns: 1e-16 of 1e12 in the narrow one itself, not in squares.
TOL = {"ekf": 1e-7, "iekf": 1e-7, "ukf": 5e-5}


@lru_cache
def case(name):
    A, C, walk = CASES[name]
    n, ny = len(A), len(C)
    walk = [w * NOISE for w in walk]
    model = linear(A, np.zeros((n, 1)), np.zeros((n, 1)), C, np.zeros((ny, 1)), walk)
    y = np.random.default_rng(1).standard_normal((ny, 5)) * NOISE
    y[:, 0] = np.nan  # at first nothing is measured: the prior's width goes through the prediction
    data = Recording(np.arange(5.0), np.zeros((1, 5)), y, np.full_like(y, NOISE**2), np.zeros(0))
    return model, data


def prior_of(model, ratio, correlation):
    n = len(model.x)
    sigma = NOISE * ratio * np.array([1.0, 0.5, 2.0])[:n]
    corr = (1 - correlation) * np.eye(n) + correlation * np.ones((n, n))
    return Belief(model.x, np.zeros(n), corr * np.outer(sigma, sigma))


def rational(a):
    return np.array([[Fraction(float(v)) for v in row] for row in np.atleast_2d(a)], dtype=object)


def inverse(A):
    """Gauss-Jordan with fractions."""
    n = len(A)
    W = np.hstack([A, rational(np.eye(n))])
    for i in range(n):
        p = next(r for r in range(i, n) if W[r, i] != 0)
        W[[i, p]] = W[[p, i]]
        W[i] = W[i] / W[i, i]
        for r in range(n):
            if r != i:
                W[r] = W[r] - W[r, i] * W[i]
    return W[:, n:]


@lru_cache
def exact(name, ratio, correlation):
    """(means, variances) filtered and smoothed, each of shape (n, K)."""
    A, C, _ = (rational(M) for M in CASES[name])
    model, data = case(name)
    prior = prior_of(model, ratio, correlation)
    m, P = rational(prior.mean).T, rational(prior.cov)
    Q = np.diag([Fraction(float(w)) ** 2 for w in model.walk])
    filtered, predicted = [], []
    for k in range(data.size):
        predicted.append((m, P))
        for c, y, R in zip(C, data.y[:, k], data.variance[:, k], strict=True):
            if not np.isnan(y):
                K = (P @ c) / (c @ P @ c + Fraction(float(R)))
                m = m + (K * (Fraction(float(y)) - (c @ m)[0]))[:, None]
                P = P - np.outer(K, c @ P)
        filtered.append((m, P))
        m, P = A @ m, A @ P @ A.T + Q * Fraction(float(data.dt[k]))
    smoothed = [filtered[-1]]
    for (m, P), (mp, Pp) in zip(filtered[-2::-1], predicted[:0:-1], strict=True):
        J = P @ A.T @ inverse(Pp)
        ms, Ps = smoothed[0]
        smoothed.insert(0, (m + J @ (ms - mp), P + J @ (Ps - Pp) @ J.T))
    return [
        tuple(np.array([f(*b) for b in beliefs], float).T
              for f in (lambda m, P: m[:, 0], lambda m, P: np.diag(P)))
        for beliefs in (filtered, smoothed)
    ]  # fmt: skip


FILTERS = {
    "ekf": lambda *a, **k: extended_kalman_filter(*a, backend="vm", **k),
    "iekf": lambda *a, **k: extended_kalman_filter(*a, iterations=2, backend="vm", **k),
    "ukf": lambda *a, **k: unscented_kalman_filter(*a, backend="vm", **k),
}


def check(result, expected, tol):
    mean, variance = expected
    np.testing.assert_allclose(result.variance, variance, rtol=tol)
    # the mean has the digits of the numbers it is made of
    assert (np.abs(result.mean - mean) < np.sqrt(variance) * max(tol, 1e-4)).all()


@pytest.mark.long
@pytest.mark.parametrize(
    ("which", "name", "correlation"),
    [
        *((f, name, 0.0) for f in ("ekf", "ukf") for name in CASES),
        *((f, name, 0.999) for f in ("ekf", "ukf") for name in ("sum", "speed")),
        ("iekf", "speed", 0.0),
    ],
)
def test_filter_and_smoother(which, name, correlation):
    """Filtered and smoothed, wide and narrow, also where states are known only together."""
    model, data = case(name)
    for ratio in RATIOS:
        prior = prior_of(model, ratio, correlation)
        filtered, smoothed = exact(name, ratio, correlation)
        result = FILTERS[which](model, prior, data, full=True)
        check(result, filtered, TOL[which])
        if ratio == RATIOS[-1]:
            check(FILTERS[which](model, prior, data), filtered, TOL[which])
        check(rts_smoother(result), smoothed, TOL[which])


@pytest.mark.long
@pytest.mark.parametrize("name", ["speed", "sum", "mixed"])
def test_other_filters(name):
    """Two like modes, with roots mixed; a second pass; a horizon, where IPOPT can solve it."""
    model, data = case(name)
    for ratio in (1.0, 1e6, 1e12):
        prior = prior_of(model, ratio, 0.0)
        filtered, _ = exact(name, ratio, 0.0)
        switch = [[0.9, 0.1], [0.2, 0.8]]
        for modes, tol in (({"a": model, "b": model}, 1e-7),
                           ({"a": ukf_step(model), "b": model}, TOL["ukf"])):  # fmt: skip
            r = interacting_multiple_models(modes, prior, data, transition=switch, backend="vm")
            check(r, filtered, tol)
        check(relinearised_filter(model, prior, data, backend="vm"), filtered, 1e-7)
        try:
            r = moving_horizon(model, prior, data, horizon=3, backend="vm")
        except EstimationError as e:
            assert ratio > 1e9 and "no estimate found" in str(e)
        else:
            check(r, filtered, 1e-7)


def test_what_is_well_known_keeps_the_covariance_filter():
    """The usual filter where nothing is lost: bit by bit, and back to it after a wide start."""
    model, data = case("speed")
    long = Recording(
        np.arange(300.0), np.zeros((1, 300)), np.zeros((1, 300)), np.full((1, 300), NOISE**2),
        np.zeros(0),
    )  # fmt: skip
    wide = extended_kalman_filter(model, prior_of(model, 1e9, 0.0), long, backend="vm")
    narrow = extended_kalman_filter(model, prior_of(model, 1.0, 0.0), long, backend="vm")
    np.testing.assert_allclose(wide.variance[:, -1], narrow.variance[:, -1], rtol=1e-12)
    assert wide.final.root is None
    short = extended_kalman_filter(model, prior_of(model, 1e9, 0.0), data, backend="vm")
    assert short.final.root is not None  # to go on from without loss
    np.testing.assert_allclose(
        short.final.root @ short.final.root.T, short.final.cov, rtol=1e-12, atol=1e-30
    )


def test_a_result_is_pickled_without_its_filter():
    """Smoothed as before where nothing is lost, refused where the roots are needed."""
    model, data = case("level")
    for ratio in (1.0, 1e9):
        result = extended_kalman_filter(model, prior_of(model, ratio, 0.0), data, full=True,
                                        backend="vm")  # fmt: skip
        copy = pickle.loads(pickle.dumps(result))
        if ratio == 1.0:
            np.testing.assert_array_equal(rts_smoother(copy).mean, rts_smoother(result).mean)
        else:
            with pytest.raises(EstimationError, match="of which no digit is left: take a prior"):
                rts_smoother(copy)


def test_a_root_must_be_of_its_covariance():
    """As a belief with another covariance would keep it."""
    model, _ = case("sum")
    with pytest.raises(SignalError, match="the root is none of the covariance"):
        Belief(model.x, np.zeros(2), np.eye(2), 2 * np.eye(2))


def test_graded_columns_keep_their_digits():
    """A column of 1 beside one of 1e12, against fractions; a row of zeros; rank lost."""
    import casadi as ca

    A = np.array([[1e12, 0.3, 0.1], [-1e12, 0.7, 0.2], [0, 0, 0], [1e12, 0.3, 0.1]])
    S = ca.SX.sym("A", 4, 3)
    L = np.array(ca.Function("f", [S], [ca.densify(graded_lower(S))])(A))
    # of the sum of the first two rows the wide column cancels: (0.3 + 0.7)^2 + (0.1 + 0.2)^2
    P = rational(L[:2]) @ rational(L[:2]).T
    assert float(P.sum()) == pytest.approx(1.09, rel=1e-3)
    assert (L[2] == 0).all()
    np.testing.assert_allclose(L[3], [L[0, 0], 0, 0, 0], atol=1e-3)
