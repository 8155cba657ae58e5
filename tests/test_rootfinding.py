"""Newton's method: finds known roots, and never calls a bad point good."""

import casadi as ca
import numpy as np
import pytest

from apu_casadi.core.rootfinding import Newton, solve_bordered


def newton(residual, n=1, n_p=0, **options):
    """Build a Newton from a Python function of symbols; scale one unless given."""
    x, p = ca.MX.sym("x", n), ca.MX.sym("p", n_p)
    options.setdefault("scale", np.ones(n))
    return Newton(ca.Function("r", [x, p], [residual(x, p)]), **options)


NONE = np.zeros(0)


def test_a_linear_system_takes_one_step():
    """Newton's method is exact on linear equations; 1e-14 is rounding of a 2x2 solve."""
    A, b = np.array([[2.0, 1.0], [1.0, 3.0]]), np.array([1.0, 2.0])
    root = newton(lambda x, p: ca.mtimes(A, x) - b, n=2, max_step=10.0)([0.0, 0.0], NONE)
    assert root.success
    assert root.iterations == 1
    assert root.x == pytest.approx(np.linalg.solve(A, b), abs=1e-14)


def test_convergence_is_quadratic():
    """Kantorovich: near a simple root the error is squared.

    Heron's iteration from 2 to sqrt(2) leaves errors of 9e-2, 2e-3, 2e-6, 2e-12: four steps.
    """
    solve = newton(lambda x, p: x**2 - p, n_p=1, tol=1e-8, max_step=1.0)
    root = solve([2.0], np.array([2.0]))
    assert root.success
    assert root.iterations == 4
    assert root.x[0] == pytest.approx(np.sqrt(2.0), abs=2e-12)


def test_rosenbrock_stationary_point():
    """Moré, Garbow, Hillstrom (1981), problem 1: (-1.2, 1) -> (1, 1), the classical hard start."""

    def residual(x, p):
        return ca.vertcat(10 * (x[1] - x[0] ** 2), 1 - x[0])

    root = newton(residual, n=2, max_step=0.3, max_iterations=200)([-1.2, 1.0], NONE)
    assert root.success
    assert root.x == pytest.approx([1.0, 1.0], abs=1e-10)  # the tolerance of the residual


def test_damping_saves_a_step_that_overshoots():
    """atan from x = 3: plain Newton diverges beyond |x| = 1.39 (a textbook example)."""
    root = newton(lambda x, p: ca.atan(x), max_step=100.0)([3.0], NONE)
    assert root.success
    assert root.x[0] == pytest.approx(0.0, abs=1e-10)


def test_scales_make_units_irrelevant():
    """The same problem in K and in mK takes the same steps."""
    in_K = newton(lambda x, p: (x / 300) ** 3 - 2, scale=np.array([300.0]))
    in_mK = newton(lambda x, p: (x / 3e5) ** 3 - 2, scale=np.array([3e5]))
    a, b = in_K([300.0], NONE), in_mK([3e5], NONE)
    assert a.iterations == b.iterations
    assert b.x[0] / 1e3 == pytest.approx(a.x[0], rel=1e-12)  # the same arithmetic, scaled


def test_no_iterate_leaves_the_bounds():
    """log(x) is not a number for x < 0: with a bound the search never asks there."""
    bounded = newton(
        lambda x, p: ca.log(x) - 2, lower=np.array([1e-3]), upper=np.array([20.0]), max_step=50.0
    )
    for start in (-5.0, 1e-3, 19.0, 1e6):
        root = bounded([start], NONE)
        assert root.success, root.reason
        assert root.x[0] == pytest.approx(np.exp(2.0), rel=1e-10)


@pytest.mark.parametrize(
    ("residual", "start", "reason"),
    [
        (lambda x, p: x**2 + 1, 1.0, "no descent"),
        (lambda x, p: x**2 + 1, 0.0, "no descent"),
        (lambda x, p: ca.exp(-x), 0.0, "no convergence in 40 steps"),
        (lambda x, p: ca.log(x), -1.0, "residual not finite at the start"),
    ],
)
def test_failure_is_told_and_not_hidden(residual, start, reason):
    """No root, flat Jacobian, root at infinity, not a number: success is False and says why."""
    root = newton(residual)([start], NONE)
    assert not root.success
    assert root.reason == reason
    assert root.residual > 1e-10


def test_the_residual_is_that_of_the_returned_point():
    """The verdict is re-evaluated, also for the best point of a failed search."""
    f = lambda x: np.array([x[0] ** 2 + 1, x[1] - 5.0])  # noqa: E731
    solve = newton(lambda x, p: ca.vertcat(x[0] ** 2 + 1, x[1] - 5), n=2)
    root = solve([1.0, 0.0], NONE)
    assert not root.success
    assert root.residual == np.abs(f(root.x)).max()
    assert root.worst == int(np.argmax(np.abs(f(root.x))))


def test_a_rank_deficient_jacobian_is_survived():
    """Two equal equations: the least-squares step still leads onto the line of solutions."""
    residual = lambda x, p: ca.vertcat(x[0] + x[1] - 2, 2 * (x[0] + x[1] - 2))  # noqa: E731
    root = newton(residual, n=2, max_step=10.0)([0.0, 0.0], NONE)
    assert root.success
    assert root.x.sum() == pytest.approx(2.0, abs=1e-10)


def test_equations_and_unknowns_must_match_in_number():
    """A square system is the contract."""
    with pytest.raises(ValueError, match="2 equations for 1 unknowns"):
        newton(lambda x, p: ca.vertcat(x, x))


@pytest.mark.parametrize(("n", "k"), [(5, 3), (6, 0), (11, 9), (13, 9), (4, 4)])
def test_bordered_systems_are_solved_as_by_elimination(n, k):
    """NumPy's solution of random systems, the leading block lower triangular (rounding)."""
    rng = np.random.default_rng(n)
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, 3))
    A[:k, :k] = np.tril(A[:k, :k]) + 3 * np.eye(k)
    pattern = ca.DM(A)
    pattern[:k, :k] = ca.tril(pattern[:k, :k])
    a = ca.SX.sym("a", ca.sparsify(pattern).sparsity())
    b = ca.SX.sym("b", n, 3)
    X = ca.Function("X", [a, b], [solve_bordered(a, b, k)])(ca.sparsify(pattern), B)
    np.testing.assert_allclose(X.full(), np.linalg.solve(A, B), rtol=1e-10, atol=1e-12)
