"""Blocks with rows as lanes say what scalar blocks say, to the last bit, on any number of lanes."""

import dataclasses

import numpy as np
import pytest
from estimation_models import gappy, pendulum, pendulum_data, random_belief, random_linear

from apu_casadi.core.backend import compiled, find_compiler, library
from apu_casadi.core.calling import Caller
from apu_casadi.core.lanes.lanelibrary import lanes_in_use
from estimators.filters.ekf import ekf_step
from estimators.filters.filterblock import BLOCK, PADDED, block_function, padded
from estimators.filters.filtering import run
from estimators.filters.rowblock import row_block


def many_states():
    """Nine states, of which two are considered."""
    model = random_linear(3, nx=9, nw=2, ny=2)[0]
    walk = np.where(np.isin(range(9), [4, 8]), 0.0, model.walk)
    return dataclasses.replace(model, consider=("x4", "x8"), walk=walk)


@pytest.mark.compiled
@pytest.mark.ci
@pytest.mark.parametrize(
    "make, lanes, short",
    [*((many_states, n, n == 4) for n in (2, 4, 8)), (pendulum, 8, True), (pendulum, 2, False)],
)
def test_rows_have_the_bits_of_the_scalar_block(make, lanes, short):
    """Samples that are missing and padded, in two blocks; the second goes on from the first."""
    if find_compiler() is None or lanes_in_use() < lanes:
        pytest.skip("no compiler, or no processor for so many lanes")
    model = make()
    step = ekf_step(model).shared
    scalar = block_function(step, False, short, "vm", "vm")[1]
    how = {"short": short, "padded": PADDED}
    code = row_block(step.rows(), scalar, BLOCK, lanes, **how)
    calls = [Caller(f, copy=False) for f in (library(code), compiled(scalar))]
    data = gappy(1, model, 2 * BLOCK - 30) if make is many_states else pendulum_data(model, 170)
    prior, first = random_belief(2, model), 3 if short else 2
    y, R, u, dt = padded(data, 2 * BLOCK - data.size)
    for call in calls:
        call.inputs[0][:], call.inputs[1][:] = prior.mean, prior.cov
        call.inputs[-1].ravel(order="K")[:] = np.ravel(ekf_step(model).full(data.p))
    for b in range(2):
        at = slice(b * BLOCK, (b + 1) * BLOCK)
        for call in calls:
            for given, own in zip(call.inputs[first:-1], (u, y, R, dt), strict=True):
                given[...] = own[:, at].reshape(given.shape)
            call.evaluate()
        for mine, theirs in zip(calls[0].outputs, calls[1].outputs, strict=True):
            assert np.array_equal(mine, theirs) and np.isfinite(mine).all()
        for call in calls:
            for given, made in zip(call.inputs[:first], call.outputs, strict=False):
                given[...] = made


@pytest.mark.compiled
@pytest.mark.ci
def test_a_run_takes_them_and_says_what_the_virtual_machine_says():
    if find_compiler() is None or lanes_in_use() == 1:
        pytest.skip("no compiler, or no lanes")
    model = many_states()
    step = ekf_step(model)
    made = block_function(step.shared, False, True, None, "c")[0]
    assert made.name().endswith("_rows")
    data, prior = gappy(4, model, 130), random_belief(5, model)
    mine, theirs = (run(step, prior, data, backend=b) for b in (None, "vm"))
    for name in ("mean", "variance", "innovation", "nis", "loglik"):
        assert np.array_equal(getattr(mine, name), getattr(theirs, name), equal_nan=True), name


def test_bounds_and_iterations_have_no_such_form():
    model = many_states()
    assert ekf_step(model, 2).rows is None
    upper = np.full(len(model.x), np.inf)
    upper[0] = 9.0
    assert ekf_step(dataclasses.replace(model, upper=upper)).rows() is None
