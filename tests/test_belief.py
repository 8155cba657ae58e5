"""Beliefs: made, read and changed by name; what is no covariance is refused."""

import numpy as np
import pytest
from estimation_models import signals
from numpy.testing import assert_allclose

from apu_casadi.core.errors import SignalError
from estimators.filters.belief import Belief

X = signals("a b c")
MEAN, SIGMA = {"a": 1, "b": 2, "c": 3}, {"a": 0.1, "b": 0.2, "c": 0}


def test_by_name():
    """Means, standard deviations, variances squared; order of the signals."""
    b = Belief.of(X, MEAN, SIGMA)
    assert b["b"] == (2.0, 0.2)
    assert_allclose(b.mean, [1, 2, 3])
    assert_allclose(b.sigma, [0.1, 0.2, 0])
    assert_allclose(b.cov, np.diag([0.01, 0.04, 0]))


def test_defaults_of_means_do_not_become_standard_deviations():
    """A signal may have a default value; its uncertainty never has."""
    x = signals("a b", a=7.0)
    b = Belief.of(x, {"b": 1}, {"a": 1, "b": 1})
    assert b["a"] == (7.0, 1.0)
    with pytest.raises(SignalError, match="missing a"):
        Belief.of(x, {"b": 1}, {"b": 1})


def test_change_and_marginal():
    """A changed deviation is uncorrelated; the marginal keeps correlations; the original stays."""
    cov = np.array([[4, 1, 0.5], [1, 9, 2], [0.5, 2, 1]])
    b = Belief(X, np.arange(3), cov)
    c = b.change({"a": 10}, {"b": 2})
    assert c["a"] == (10.0, 2.0) and c["b"] == (1.0, 2.0)
    assert_allclose(c.cov, [[4, 0, 0.5], [0, 4, 0], [0.5, 0, 1]])
    assert_allclose(b.cov, cov)
    m = b.marginal(["c", "a"])
    assert m.x.names == ("c", "a")
    assert_allclose(m.cov, [[1, 0.5], [0.5, 4]])


def test_singular_covariances_are_beliefs():
    """Known exactly, or only as a sum; and in any units."""
    Belief(X, np.zeros(3), np.ones((3, 3)))
    Belief(X, np.zeros(3), np.zeros((3, 3)))
    s = np.array([1e9, 1, 1e-9])
    Belief(X, np.zeros(3), np.outer(s, s))
    assert Belief(signals(""), np.zeros(0), np.zeros((0, 0))).sigma.size == 0


@pytest.mark.parametrize(
    ("mean", "cov", "words"),
    [
        (np.zeros(2), np.eye(3), r"mean \(3,\) and cov \(3, 3\) expected, got \(2,\)"),
        (np.zeros(3), np.eye(2), r"got \(3,\) and \(2, 2\)"),
        ([0, np.nan, 0], np.eye(3), "not finite, of b"),
        (np.zeros(3), np.diag([1, 1, -1e-3]), "variance negative or not finite, of c"),
        (np.zeros(3), [[1, np.nan, 0], [0, 1, 0], [0, 0, 1]], "covariance of a and b is not fin"),
        (np.zeros(3), [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]], "not symmetric"),
        (np.zeros(3), [[1, 2, 0], [2, 1, 0], [0, 0, 1]], "eigenvalue -1.0e"),
        (np.zeros(3), 1e-12 * np.array([[1, 2, 0], [2, 1, 0], [0, 0, 1]]), "eigenvalue -1.0e"),
    ],
)
def test_what_is_no_belief_is_refused(mean, cov, words):
    """The message names the state, or says by how much."""
    with pytest.raises(SignalError, match=words):
        Belief(X, mean, cov)


def test_wrong_names_and_signs_are_refused():
    """With the nearest name; a negative deviation would be squared away."""
    with pytest.raises(SignalError, match="unknown A "):
        Belief.of(X, MEAN | {"A": 1}, SIGMA)
    with pytest.raises(SignalError, match=r"deviation of b must be >= 0, got -0\.2"):
        Belief.of(X, MEAN, SIGMA | {"b": -0.2})
    b = Belief.of(X, MEAN, SIGMA)
    with pytest.raises(SignalError, match="standard deviation of a must be >= 0, got nan"):
        b.change(sigma={"a": float("nan")})
    with pytest.raises(SignalError, match="unknown signal 'aa'"):
        b.change({"aa": 1})
    with pytest.raises(SignalError, match="unknown d "):
        b.marginal(["a", "d"])
    with pytest.raises(SignalError, match="unknown signal"):
        b["e"]
