"""Engines of one structure share their functions, and derivatives by every parameter are exact."""

import dataclasses
import gc
import os
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from odd_engine import changed, odd_engine

from apu_casadi.core.errors import OperatingPointError, ParameterError
from apu_casadi.gaspath.design import solve_design
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.trimbatch import trim_batch
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.gaspath.steady.trimsolver import solver_of
from apu_casadi.gaspath.unitnumbers import GIVEN, NUMBERS
from estimators.batch.fit import fit
from estimators.models.filtermodel import measure, noisy_inputs
from estimators.models.lifting import lift
from estimators.models.recording import record

POINT = {"altitude": 3000.0, "Mach": 0.3, "dT_isa": 12.0, "war": 0.005}
SMOOTH = [i for i, n in enumerate(GasGenerator.Y.names) if n not in ("off_c", "off_t", "residual")]


def flat(a):
    """Return what a function of CasADi gave as a vector."""
    return np.asarray(a).ravel()


@pytest.fixture(scope="module")
def gg():
    """An engine none of whose numbers is at an end of its range or hidden by a zero."""
    return odd_engine()


@pytest.fixture(scope="module")
def state(gg):
    p = trim_gas_generator(gg, {"N": 0.99 * gg.parameters.N, "PW": 2.6e5}, **POINT)
    u = p.u.copy()
    u[0] *= 1.03  # not steady
    return p.x, u, np.array([0.98, 0.99, 0.985, 1.01]), p.z


@pytest.mark.long
def test_derivatives_by_every_parameter_are_those_of_replaced_units(gg, state):
    """f and g of units with one number moved, against the Jacobian that solves the design point.

    Central differences of order four; 2e-7 of each row's largest entry in nominal units.
    """
    x, u, theta, _ = state
    ss = gg.by_parameters.state_space
    assert ss.theta.names == (*gg.THETA.names, *GIVEN.names)
    given = gg.numbers[: len(GIVEN)]
    t = ca.MX.sym("t", len(ss.theta))
    both = ca.vertcat(ss.f(x, u, t), ss.g(x, u, t)[SMOOTH])
    values, J = (
        np.asarray(v) for v in ca.Function("J", [t], [both, ca.jacobian(both, t)])(
            np.concatenate([theta, given])
        )
    )  # fmt: skip
    J = J[:, len(theta) :]

    def unit(name, value):
        s = changed(gg, name, value)
        full = s.full(theta)
        family = s.family.state_space
        return np.concatenate([flat(family.f(x, u, full)), flat(family.g(x, u, full))[SMOOTH]])

    np.testing.assert_allclose(values.ravel(), unit("gas_generator.J", given[23]), rtol=1e-11)
    assert GIVEN.names[23] == "gas_generator.J"
    nominal = np.maximum(np.abs(given), 0.1)
    size = np.abs(J * nominal).max(axis=1)
    size[size == 0] = 1.0  # N, and what the ambient alone gives
    for k, name in enumerate(GIVEN.names):
        h = 2e-4 * nominal[k]
        if name == "gas_generator.altitude":
            h = 5.0
        near, far = (unit(name, given[k] + m * h) - unit(name, given[k] - m * h) for m in (1, 2))
        slope = (8 * near - far) / (12 * h)
        off = np.abs(slope - J[:, k]) * nominal[k] / size
        worst = ("xdot", *np.array(gg.Y.names)[SMOOTH])[int(off.argmax())]
        assert off.max() < 2e-7, f"d {worst}/d {name} is off by {off.max():.1e}"


def test_discrete_step_by_parameters_is_that_of_the_unit(gg, state):
    """The three forms of the step agree, and the derivative by eta_c is the unit's difference."""
    x, u, theta, z = state
    want = [flat(v) for v in gg.step(x, u, theta, 0.02, z)]
    for form, th in (
        (gg.family, gg.full(theta)),
        (gg.by_parameters, np.concatenate([theta, gg.numbers[: len(GIVEN)]])),
    ):
        for a, b in zip(form.step(x, u, th, 0.02, z), want, strict=True):
            np.testing.assert_allclose(flat(a), b, rtol=1e-10, atol=1e-9)
    t = ca.MX.sym("t", len(gg.THETA) + len(GIVEN))
    x1, *_ = gg.by_parameters.step(x, u, t, 0.02, z)
    k = len(theta) + GIVEN.index("gas_generator.eta_c")
    slope = float(ca.Function("J", [t], [ca.jacobian(x1, t)])(th)[k])
    h = 1e-4
    ends = [changed(gg, "gas_generator.eta_c", 0.85 + s * h) for s in (1, -1)]
    a, b = (float(e.family.step(x, u, e.full(theta), 0.02, z)[0]) for e in ends)
    assert slope == pytest.approx((a - b) / (2 * h), rel=1e-6)


def test_derived_numbers_by_function_are_those_of_the_unit(gg):
    """The design point as a differentiable function against the reported one, to rounding."""
    derived, residual = gg.family.cycle.derivation(gg.numbers[: len(GIVEN)])
    assert float(residual) < 1e-12
    want = gg.numbers[len(GIVEN) :]
    np.testing.assert_allclose(flat(derived), want, rtol=1e-11, atol=1e-12)
    assert len(NUMBERS) == gg.numbers.size


@pytest.mark.parametrize(("T4", "PR_c"), [(620.0, 40.0), (850.0, 26.0)])
def test_a_design_point_that_does_not_exist_is_told_by_the_residual(gg, state, T4, PR_c):
    """T4 below T3 leaves no solution but one of negative fuel flow: it must not be called one."""
    x, u, theta, z = state
    with pytest.raises(OperatingPointError, match="design point not solved"):
        solve_design(gg.parameters.change(T4=T4, PR_c=PR_c, eta_c=0.7))
    given = gg.numbers[: len(GIVEN)].copy()
    given[GIVEN.index("gas_generator.T4")] = T4
    given[GIVEN.index("gas_generator.PR_c")] = PR_c
    given[GIVEN.index("gas_generator.eta_c")] = 0.7
    assert not float(gg.by_parameters.cycle.derivation(given)[1]) <= 1e-9
    y, _ = gg.by_parameters.g(x, u, np.concatenate([theta, given]), z)
    assert not float(y[gg.Y.index("residual")]) <= 1e-9


@pytest.mark.long
def test_a_new_engine_builds_and_compiles_nothing(asked):
    """Another set of numbers runs, trims and batches on what the first engine made."""

    def use(g):
        p = trim_gas_generator(g, {"N": g.parameters.N, "PW": 2e5})
        g.advance(p.x, p.u, p.theta, p.z, 0.02, step=g.stepper)
        return trim_batch(g, {"N": g.parameters.N, "PW": np.linspace(1e5, 3e5, 400)})

    gg = GasGenerator()
    use(gg)
    before = set(asked)
    other = dataclasses.replace(
        gg, parameters=gg.parameters.change(eta_c=0.83, W2=3.3, x_HC=2.0, T4=1190.0)
    )
    assert use(other).ok.all()
    assert before and asked == before
    assert other.family.step is gg.family.step
    assert solver_of(other, ("N", "PW")).code is solver_of(gg, ("N", "PW")).code


def test_a_state_space_takes_its_numbers_from_the_unit(gg, state):
    """The family of the continuous model, with the full theta, is the model."""
    x, u, theta, _ = state
    ss = gg.state_space
    full = ss.full(theta)
    np.testing.assert_array_equal(full, gg.full(theta))
    assert ss.shared.theta.names == (*gg.THETA.names, *NUMBERS.names)
    np.testing.assert_allclose(flat(ss.shared.f(x, u, full)), flat(ss.f(x, u, theta)), rtol=1e-12)


@pytest.mark.long
def test_parameters_are_unknowns_of_a_fit_like_health_factors():
    """Burner efficiency and a map number of a replaced unit are found from its steady points.

    1e-6: points without noise; IPOPT stops at 1e-10, trims at residuals of 1e-9.
    """
    gg = GasGenerator()
    truth = {"gas_generator.eta_burner": 0.975, "compressor_map.a_W": 0.06, "f_eta_t": 0.985}
    unit = changed(gg, "gas_generator.eta_burner", truth["gas_generator.eta_burner"])
    unit = changed(unit, "compressor_map.a_W", truth["compressor_map.a_W"])
    powers = (1e5, 2e5, 3e5, 4e5)
    points = [
        trim_gas_generator(unit, {"N": k * gg.parameters.N, "PW": P}, theta={"f_eta_t": 0.985})
        for k, P in zip((0.97, 1.0, 0.98, 1.01), powers, strict=True)
    ]
    names = ["N", "P3", "T3", "T5"]
    free = gg.with_free("gas_generator.eta_burner", "compressor_map.a_W")
    lifted = lift(
        free.state_space,
        lambda m: noisy_inputs(measure(m, names), {"Wf": 3e-4, "PW": 2e3}),
        equations=free.equations,
        steady=True,
    )
    t = np.arange(4.0)
    readings = {n: (t, np.array([p[n] for p in points])) for n in (*names, "Wf", "PW")}
    rec = record(
        lifted.model,
        outputs={n: readings[n] for n in names},
        sigma={"N": 5.0, "P3": 2e3, "T3": 2.0, "T5": 2.0},
        inputs={n: readings[n] for n in ("Wf", "PW")},
    )
    got = fit(lifted, rec, list(truth), backend="vm")
    np.testing.assert_allclose(got.estimate, list(truth.values()), atol=1e-6)
    assert got.chi2 < 1e-8
    with pytest.raises(ParameterError, match=r"'gas_generator.eta_burn' .*eta_burner"):
        gg.with_free("gas_generator.eta_burn")


@pytest.mark.long
def test_many_units_leave_the_memory_flat():
    """400 engines, used and dropped: less than 2 MB more, 5 kB each."""
    gg = GasGenerator()

    def use(count, seed):
        rng = np.random.default_rng(seed)
        for _ in range(count):
            par = gg.parameters.change(eta_c=0.85 - 0.02 * rng.uniform(), W2=3 + rng.uniform())
            g = dataclasses.replace(gg, parameters=par)
            p = trim_gas_generator(g, {"N": par.N, "PW": 2e5})
            g.output(p.x, p.u, p.theta, z0=p.z)
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    if not Path("/proc/self/statm").exists():
        pytest.skip("memory of the process is read from /proc")
    before = use(100, 0)
    assert use(400, 1) - before < 2e6
