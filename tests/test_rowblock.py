"""Blocks with rows as lanes say what scalar blocks say, to the last bit, on any number of lanes."""

import dataclasses

import casadi as ca
import numpy as np
import pytest
from estimation_models import gappy, pendulum, pendulum_data, random_belief, random_linear
from numpy.testing import assert_array_equal

from apu_casadi.core.backend import compiled, find_compiler, library
from apu_casadi.core.calling import Caller
from apu_casadi.core.lanes.lanelibrary import lanes_in_use
from apu_casadi.core.lanes.pointlanes import points_in_lanes
from estimators.filters.ekf import ekf_step
from estimators.filters.filterblock import BLOCK, PADDED, block_function, padded, row_function
from estimators.filters.filtering import run
from estimators.filters.rowblock import row_block
from estimators.filters.ukf import ukf_step


def many_states():
    """Nine states, of which two are considered."""
    model = random_linear(3, nx=9, nw=2, ny=2)[0]
    walk = np.where(np.isin(range(9), [4, 8]), 0.0, model.walk)
    return dataclasses.replace(model, consider=("x4", "x8"), walk=walk)


@pytest.mark.compiled
@pytest.mark.ci
@pytest.mark.parametrize("make, lanes", [*((many_states, n) for n in (2, 4, 8)), (pendulum, 8)])
def test_rows_have_the_bits_of_the_scalar_block(make, lanes):
    """Samples that are missing and padded, in two blocks; the second goes on from the first."""
    if find_compiler() is None or lanes_in_use() < lanes:
        pytest.skip("no compiler, or no processor for so many lanes")
    model = make()
    step, nx = ekf_step(model).shared, len(model.x)
    data = gappy(1, model, 2 * BLOCK - 30) if make is many_states else pendulum_data(model, 170)
    prior, kept = random_belief(2, model), [3, 60, 61]
    code = row_block("rows", step.rows(), BLOCK, lanes, padded=PADDED)
    blocks = [library(code), *(block_function(step, False, s, None, "c")[0] for s in (True, False))]
    rows, short, whole = calls = [Caller(f, copy=False) for f in blocks]
    y, R, u, dt = padded(data, 2 * BLOCK - data.size)
    for call in calls:
        call.inputs[0][:], call.inputs[1][:] = prior.mean, prior.cov
        call.inputs[-1].ravel(order="K")[:] = np.ravel(ekf_step(model).full(data.p))
    rows.inputs[7].ravel()[kept] = 1.0
    for b in range(2):
        at, n = slice(b * BLOCK, (b + 1) * BLOCK), BLOCK - 30 * b
        for call, first in zip(calls, (3, 3, 2), strict=True):
            for given, own in zip(call.inputs[first:], (u, y, R, dt), strict=False):
                given[...] = own[:, at].reshape(given.shape)
            call.evaluate()
        for k, (mine, theirs) in enumerate(zip(rows.outputs, short.outputs, strict=False)):
            columns = slice(n if k > 2 else None)
            assert np.isfinite(mine[:, columns] if k else mine).all()
            if b == 0 or k > 1:  # where it ends, scalar code goes on over what is padded
                assert np.array_equal(mine[..., columns], theirs[..., columns]), rows.fun.name_out(
                    k
                )
        assert np.array_equal(rows.outputs[8][:, :3], whole.outputs[3][:, kept])
        assert rows.outputs[8].shape[0] == nx * (nx + 1) // 2
        for call, first in zip(calls, (3, 3, 2), strict=True):
            for given, made in zip(call.inputs[:first], call.outputs, strict=False):
                given[...] = made


@pytest.mark.compiled
@pytest.mark.ci
def test_a_run_takes_them_and_says_what_the_virtual_machine_says():
    if find_compiler() is None or lanes_in_use() == 1:
        pytest.skip("no compiler, or no lanes")
    model = many_states()
    step = ekf_step(model)
    assert row_function(step.shared, None, "c").name().endswith("_rows")
    data, prior, at = gappy(4, model, 530), random_belief(5, model), np.arange(3, 530, 20)
    mine, theirs = (run(step, prior, data, cov_at=at, backend=b) for b in (None, "vm"))
    for name in ("mean", "variance", "innovation", "nis", "loglik", "some_cov"):
        assert np.array_equal(getattr(mine, name), getattr(theirs, name), equal_nan=True), name


def test_bounds_and_iterations_have_no_such_form():
    model = many_states()
    assert ekf_step(model, 2).rows is None
    upper = np.full(len(model.x), np.inf)
    upper[0] = 9.0
    assert ekf_step(dataclasses.replace(model, upper=upper)).rows() is None


@pytest.mark.compiled
@pytest.mark.ci
def test_sigma_points_in_lanes_have_the_bits_of_the_loop():
    """The block of a UKF, whose maps take their points together; its results are the loop's."""
    if find_compiler() is None or lanes_in_use() == 1:
        pytest.skip("no compiler, or no lanes")
    model = pendulum()
    step, data = ukf_step(model), pendulum_data(model, BLOCK)
    block = block_function(step.shared, False, True, "vm", "vm")[1]
    made = points_in_lanes(block)
    assert made.class_name() == "External"
    calls = [Caller(f, copy=False) for f in (made, compiled(block))]
    prior, (y, R, u, dt) = random_belief(2, model), padded(data, 0)
    for call in calls:
        given = prior.mean, np.linalg.cholesky(prior.cov), np.zeros_like(prior.cov)
        arguments = *given, u, y, R, dt, np.ravel(step.full(data.p))
        for own, value in zip(call.inputs, arguments, strict=True):
            own[...] = value.reshape(own.shape)
        call.evaluate()
    for mine, theirs in zip(*(call.outputs for call in calls), strict=True):
        assert np.array_equal(mine, theirs) and np.isfinite(mine).all()


@pytest.mark.compiled
def test_a_function_without_points_is_compiled_as_it_is():
    x = ca.SX.sym("x")
    f = ca.Function("f", [x], [x + 1])
    assert points_in_lanes(f) is compiled(f)
    assert points_in_lanes(f, backend="vm") is f


@pytest.mark.compiled
def test_products_of_matrices_and_limits_have_the_bits_of_the_loop():
    """Rows that fill lanes, and rows that do not; fmin and fmax with and without a number."""
    sizes = ((6, 11, 1), (8, 8, 3), (17, 5, 6), (1, 4, 2))
    x = ca.SX.sym("x")
    mapped = ca.Function("square", [x], [x * x]).map(9)
    given, made = [ca.MX.sym("a"), ca.MX.sym("b"), ca.MX.sym("v", 1, 9)], []
    for n, m, q in sizes:
        A, B, C = ca.MX.sym("A", n, m), ca.MX.sym("B", m, q), ca.MX.sym("C", n, q)
        given += [A, B, C]
        made.append(ca.mac(A, B, C))
    f = ca.Function(
        "products", given, [*made, mapped(given[2]), ca.fmin(*given[:2]), ca.fmax(*given[:2])]
    )
    rng = np.random.default_rng(3)
    usual, fast = Caller(compiled(f)), Caller(points_in_lanes(f))
    assert fast.fun.class_name() == "External" and fast.fun is not usual.fun
    for a, b in ((1.0, 2.0), (2.0, 1.0), (np.nan, 1.0), (1.0, np.nan), (-0.0, 0.0)):
        values = [a, b, *(rng.normal(size=f.size_in(i)) for i in range(2, f.n_in()))]
        for own, other in zip(usual(*values), fast(*values), strict=True):
            assert_array_equal(own, other)


@pytest.mark.compiled
def test_maps_of_one_name_keep_their_own_functions():
    """Two that differ are called in one function: of each the points are its own."""
    x = ca.SX.sym("x")
    twice, thrice = (
        ca.Function("times", [x], [k * x]).map("points", "serial", 9, [], []) for k in (2, 3)
    )
    a, b = ca.MX.sym("a", 1, 9), ca.MX.sym("b", 1, 9)
    inner = [ca.Function(n, [a], [f(a)]) for n, f in (("first", twice), ("second", thrice))]
    f = ca.Function("both", [a, b], [inner[0](a), inner[1](b)])
    given = np.arange(9.0)
    first, second = Caller(points_in_lanes(f))(given[None], given[None])
    assert_array_equal(first.ravel(), 2 * given)
    assert_array_equal(second.ravel(), 3 * given)
