"""The linearly implicit midpoint step: order two, stable when stiff, exact where it must be.

Source: Hairer and Wanner, Solving Ordinary Differential Equations II, section IV.7; one stage,
gamma = 1/2, with the stability function R(z) = (1 + z/2)/(1 - z/2).
"""

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import expm

from apu_casadi.core.discretisation import linearly_implicit_midpoint


def step_function(rhs, n):
    """Make one step (x, dt) -> x1 of dx/dt = rhs(x)."""
    x, dt = ca.SX.sym("x", n), ca.SX.sym("dt")
    f = rhs(x)
    x1 = linearly_implicit_midpoint(x, f, ca.jacobian(f, x), dt)
    return ca.Function("step", [x, dt], [x1])


def march(step, x0, T, steps):
    x = np.asarray(x0, float)
    for _ in range(steps):
        x = step(x, T / steps).full().ravel()
    return x


def orders(step, x0, T, exact, counts=(40, 80, 160)):
    """Observed orders: log2 of the ratio of errors when the step is halved."""
    errors = [np.abs(march(step, x0, T, k) - exact).max() for k in counts]
    return np.log2(np.array(errors[:-1]) / errors[1:])


A = np.array([[-1.0, 2.0], [-3.0, -0.5]])


def test_second_order_on_a_linear_system():
    """dx/dt = A x against the matrix exponential; 0.02 is the next error term at these steps."""
    step = step_function(lambda x: ca.mtimes(A, x), 2)
    x0 = np.array([1.0, -1.0])
    assert orders(step, x0, 2.0, expm(2.0 * A) @ x0) == pytest.approx(2.0, abs=0.02)


def test_second_order_on_a_scalar_nonlinear_equation():
    """dx/dt = -x^3, x(0) = 1: x = (1 + 2 t)^-1/2.  A scalar has its own branch (no solve)."""
    step = step_function(lambda x: -(x**3), 1)
    assert orders(step, [1.0], 1.0, np.array([3**-0.5])) == pytest.approx(2.0, abs=0.05)


def test_exact_on_the_riccati_equation():
    """dx/dt = -x^2: the step is x/(1 + dt x), which is the solution; a hundred roundings."""
    step = step_function(lambda x: -(x**2), 1)
    assert march(step, [1.0], 9.0, 100)[0] == pytest.approx(0.1, rel=1e-13)


@pytest.mark.long
def test_second_order_on_a_nonlinear_system():
    """Lotka-Volterra, against the same method with 64 times smaller steps (error 4096 smaller)."""
    step = step_function(lambda x: ca.vertcat(x[0] * (1 - x[1]), x[1] * (x[0] - 1)), 2)
    fine = march(step, [1.5, 1.0], 2.0, 160 * 64)
    assert orders(step, [1.5, 1.0], 2.0, fine) == pytest.approx(2.0, abs=0.05)


@pytest.mark.parametrize("z", [-0.1, -2.0, -50.0, 0.3])
def test_stability_function(z):
    """R(z) = (1 + z/2)/(1 - z/2) for dx/dt = z x, dt = 1; rounding only."""
    step = step_function(lambda x: z * x, 1)
    assert float(step(1.0, 1.0)) == pytest.approx((1 + z / 2) / (1 - z / 2), rel=1e-14)


def test_a_stable_and_an_oscillating_system_stay_bounded():
    """A-stability: |R| <= 1 in the left half plane, and |R| = 1 on the imaginary axis."""
    stiff = step_function(lambda x: ca.vertcat(-1e6 * x[0], -x[1]), 2)
    assert np.abs(march(stiff, [1.0, 1.0], 10.0, 100)).max() <= 1.0
    swing = step_function(lambda x: ca.vertcat(x[1], -100 * x[0]), 2)
    x = march(swing, [1.0, 0.0], 10.0, 100)  # steps of 1 rad
    # energy is kept; 1e-12 is the rounding of a hundred steps
    assert x[0] ** 2 + (x[1] / 10) ** 2 == pytest.approx(1.0, rel=1e-12)


def test_an_equilibrium_stays_put():
    """Where f(x) = 0 the step is zero for every dt, to the last bit."""
    step = step_function(lambda x: ca.vertcat(x[0] * (1 - x[1]), x[1] * (x[0] - 1)), 2)
    for dt in (1e-6, 0.02, 5.0):
        assert step([1.0, 1.0], dt).full().ravel().tolist() == [1.0, 1.0]


def test_the_jacobian_of_the_step_is_that_of_the_method():
    """dx1/dx = (I - dt/2 A)^-1 (I + dt/2 A) for linear f: what an extended Kalman filter uses."""
    x, dt = ca.SX.sym("x", 2), 0.1
    x1 = linearly_implicit_midpoint(x, ca.mtimes(A, x), ca.DM(A), dt)
    J = ca.Function("J", [x], [ca.jacobian(x1, x)])([1.0, 2.0]).full()
    I = np.eye(2)
    exact = np.linalg.solve(I - dt / 2 * A, I + dt / 2 * A)
    assert pytest.approx(exact, rel=1e-12) == J  # a 2x2 solve, done twice
