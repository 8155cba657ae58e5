"""A run stays on its branch where one speed and fuel flow have two steady points."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.interpolate import CubicSpline

from apu_casadi.gaspath.gasgenerator import GasGenerator, GasGeneratorState, default_compressor
from apu_casadi.gaspath.maps.mapfiles import shipped
from apu_casadi.gaspath.maps.maptable import MapTable
from apu_casadi.gaspath.steady.steadypoint import Limits
from apu_casadi.gaspath.steady.trimming import initialise, trim_gas_generator
from apu_casadi.gaspath.steady.trimsolver import solver_of

AMBIENT = {"altitude": 6046.0, "Mach": 0.187, "dT_isa": -44.56, "war": 0.026}
FIXED = {"N": 3775.1472, "Wf": 0.0208}
HEALTH = dict(zip(GasGenerator.THETA.names, (0.875, 0.891, 1.009, 0.875), strict=True))


def crossing_map() -> MapTable:
    """AXI5 with further speed lines on which pressure ratio falls and rises again.

    They go on straight from the table's edge, each beta line by itself.
    """
    t, N = shipped("axi5"), np.array([1.14, 1.18, 1.22, 1.26])

    def more(z):
        c = CubicSpline(t.N, np.log(z), bc_type="natural")
        return np.vstack([z, np.exp(c(t.N[-1]) + c(t.N[-1], 1) * (N[:, None] - t.N[-1]))])

    return dataclasses.replace(
        t, N=np.r_[t.N, N], W=more(t.W), PR=1 + more(t.PR - 1), eta=more(t.eta), name="crossing"
    )


@pytest.fixture(scope="module")
def gg():
    return GasGenerator(
        compressor_map=dataclasses.replace(default_compressor(), table=crossing_map())
    )


@pytest.fixture(scope="module")
def states(gg):
    """The two steady points of one speed and fuel flow, by many starts around the first."""
    point = trim_gas_generator(gg, FIXED, theta=HEALTH, **AMBIENT)
    solver, rng, found = solver_of(gg, ("N", "Wf")), np.random.default_rng(0), {}
    w = np.concatenate([point.z, [point["N"], point["Wf"], point["PW"]]])
    p = np.concatenate([point.u[2:], point.theta, [FIXED["N"], FIXED["Wf"]]])
    for _ in range(60):
        s = solver.sought(w) + rng.normal(0, 0.3, len(solver.kernel.free))
        w1, _, r, _, _ = solver.one("warm", s, p)
        if np.abs(r).max() < 1e-9:
            u = np.r_[w1[-2:], point.u[2:]]
            state = GasGeneratorState(w1[-3:-2], w1[:-3], u, point.theta)
            found[round(float(w1[-5]), 2)] = state  # by beta_c
    assert len(found) == 2
    return list(found.values())


@pytest.mark.long
def test_both_points_are_steady_and_differ(gg, states):
    """The points of a published case, 980.9 and 973.3 K; neither run leaves its own."""
    T4 = gg.Y.index("T4")
    ends = []
    for start in states:
        _, y = gg.run(start, np.tile(start.u[:, None], (1, 50)))
        assert np.ptp(y[T4]) < 1e-6
        ends.append(y[T4, -1])
    assert_allclose(sorted(ends), [973.34, 980.94], atol=0.01)


@pytest.mark.parametrize("share", [0.02, 0.04, -0.06])
def test_a_run_through_the_region_follows_its_branch(gg, states, share):
    """A wave and steps of fuel: every step moves as far as a quarter of it four times.

    A jump to the other branch would be one of some 10 K in one step whatever its size.
    """
    T4 = gg.Y.index("T4")
    for start in states:
        runs = {}
        for dt in (0.02, 0.005):
            t = np.arange(dt, 1.0 + dt / 2, dt)
            inputs = np.tile(start.u[:, None], (1, t.size))
            inputs[0] *= 1 + share * np.sin(2 * np.pi * t)
            _, runs[dt] = gg.run(start, inputs, dt=dt)
        coarse, fine = runs[0.02][T4], runs[0.005][T4]
        largest = np.abs(np.diff(coarse)).max()
        assert largest < 4.2 * np.abs(np.diff(fine)).max()
        assert_allclose(coarse[1:], fine[4::4], atol=max(0.3 * largest, 0.3))


@pytest.mark.long
def test_the_shipped_map_has_one_point_there(gg):
    """The same question to the engine as shipped: one root from every start, and a run keeps it."""
    made = GasGenerator()
    point = trim_gas_generator(made, FIXED, theta=HEALTH, **AMBIENT)
    solver, rng = solver_of(made, ("N", "Wf")), np.random.default_rng(0)
    w = np.concatenate([point.z, [point["N"], point["Wf"], point["PW"]]])
    p = np.concatenate([point.u[2:], point.theta, [FIXED["N"], FIXED["Wf"]]])
    T4, found = made.Y.index("T4"), 0
    for _ in range(60):
        s = solver.sought(w) + rng.normal(0, 0.3, len(solver.kernel.free))
        _, y, r, _, _ = solver.one("warm", s, p)
        if np.abs(r).max() < 1e-9:
            assert y[T4] == pytest.approx(point["T4"], rel=1e-7)
            found += 1
    assert found > 10
    start = initialise(made, N=FIXED["N"], PW=point["PW"], theta=HEALTH, **AMBIENT)
    _, y = made.run(start, np.tile(start.u[:, None], (1, 50)))
    assert_allclose(y[T4], point["T4"], rtol=1e-7)
    assert 0 < point["off_c"] < Limits().off_map
