"""The integrators on models with known solutions, and what they say when they fail."""

import dataclasses

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose

from apu_casadi.core import simulation
from apu_casadi.core.errors import SignalError, SimulationError
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.simulation import Switch, simulate, stepper
from apu_casadi.core.statespace import StateSpace


def model(ode, *, name="model", mx=False):
    """A model dx/dt = ode(z, theta) with z = u x, so that both routes have something to do."""
    sym = ca.MX if mx else ca.SX
    x, z, u, theta = sym.sym("x"), sym.sym("z"), sym.sym("u"), sym.sym("theta")
    rate = ode(z, theta)
    free = ca.substitute(rate, z, u * x)
    args = [x, u, theta]
    return StateSpace(
        name=name,
        x=Signals([Signal("x", "V", "the state", nominal=100.0)]),
        z=Signals([Signal("z", "V", "input times state", nominal=50.0)]),
        u=Signals([Signal("u", "1", "factor")]),
        theta=Signals([Signal("theta", "1/s", "rate")]),
        y=Signals([Signal("y", "V", "twice the state", nominal=10.0)]),
        residual=ca.Function("r", [x, z, u, theta], [rate, z - u * x]),
        f=ca.Function("f", args, [free]),
        g=ca.Function("g", args, [2 * x]),
        z_of=ca.Function("z", args, [u * x]),
    )


LINEAR = model(lambda z, theta: -theta * z)


@pytest.mark.parametrize("solver", ["cvodes", "idas"])
@pytest.mark.parametrize("mx", [False, True])
def test_decay_and_its_means_are_exact(solver, mx):
    """x = x0 exp(-theta u t), its mean and mean square in closed form; 1e-6 for rtol 1e-8."""
    ss = model(lambda z, theta: -theta * z, mx=mx)
    run = stepper(ss, 4, quad=("y", "y^2"), solver=solver)
    for dt in (0.5, 2.0):  # one integrator, any length
        res = run([3.0], [2.0], [0.7], dt, t0=1.0)
        t = np.array([0.25, 0.5, 0.75, 1.0]) * dt
        a = 1.4
        assert_allclose(res.t, 1.0 + t, rtol=1e-15)
        assert_allclose(res.x[0], 3 * np.exp(-a * t), rtol=1e-6)
        assert_allclose(res.y[0], 6 * np.exp(-a * t), rtol=1e-6)
        assert res.mean["y"] == pytest.approx(6 * -np.expm1(-a * dt) / (a * dt), rel=1e-6)
        mean_square = 36 * -np.expm1(-2 * a * dt) / (2 * a * dt)
        assert res.mean["y^2"] == pytest.approx(mean_square, rel=1e-6)


def test_idas_starts_where_its_own_scale_says(monkeypatch):
    """A unit's magnitudes may differ from its family's, by which the integrator is scaled."""
    z = Signals([Signal("z", "V", "input times state", nominal=5e-3)])
    unit = dataclasses.replace(StateSpace.member("unit", LINEAR, Signals([]), [0.7]), z=z)
    run, starts = stepper(unit, solver="idas"), []
    call = type(run._F).__call__

    def noting(solver, *given):
        starts.append(given[-1])
        return call(solver, *given)

    monkeypatch.setattr(type(run._F), "__call__", noting)
    made = run([3.0], [2.0], [], 0.5)
    assert made.x_end[0] == pytest.approx(3 * np.exp(-0.7), rel=1e-6)
    assert_allclose(starts[0] * LINEAR.z.nominals, 6.0, rtol=1e-4)


def test_steppers_are_built_once():
    assert stepper(LINEAR, 4) is stepper(LINEAR, 4)
    assert stepper(LINEAR, 4) is not stepper(LINEAR, 5)
    assert stepper(LINEAR, 4) is not stepper(model(lambda z, theta: -z), 4)


@pytest.mark.parametrize("solver", ["cvodes", "idas"])
def test_switching_instants_are_met_exactly(solver):
    """Off the output grid, and shorter than it: the product of exponentials, 1e-6 for rtol 1e-8."""
    switches = [
        Switch(0.35, [1.0], [50.0]),  # a pulse shorter than the output interval
        Switch(0.36, [1.0], [1.0], transfer=lambda x: x + 1.0),
    ]
    ds = simulate(LINEAR, [3.0], np.arange(11) / 10, [1.0], [1.0], switches=switches, solver=solver)
    before = 3 * np.exp(-0.35)
    after = before * np.exp(-0.5) + 1.0
    assert_allclose(ds.time, sorted([*(np.arange(11) / 10), 0.35, 0.36]), atol=1e-15)
    assert float(ds.x.sel(time=0.35)) == pytest.approx(before, rel=1e-6)
    assert float(ds.x.sel(time=0.36)) == pytest.approx(after, rel=1e-6)  # value after the switch
    assert float(ds.x[-1]) == pytest.approx(after * np.exp(-0.64), rel=1e-6)
    assert ds.x.attrs == {"units": "V", "long_name": "the state"}
    assert ds.y.attrs["units"] == "V"
    assert ds.attrs["solver"] == solver


def test_a_switch_on_an_output_instant_or_at_the_start_adds_none():
    """0.1 + 0.2 differs from 0.3 by rounding; the instant must still be one."""
    at = [Switch(0.0, [1.0], [2.0]), Switch(0.1 + 0.2, [1.0], [1.0])]
    ds = simulate(LINEAR, [3.0], np.arange(11) / 10, [1.0], [5.0], switches=at)
    assert ds.sizes["time"] == 11
    assert float(ds.x[-1]) == pytest.approx(3 * np.exp(-0.6 - 0.7), rel=1e-6)


def test_inputs_may_be_sampled():
    """One column of u for each interval: the exponent is the sum; 1e-6 for rtol 1e-8."""
    u = np.array([[1.0, 3.0, 0.5, 2.0]])
    ds = simulate(LINEAR, [3.0], np.linspace(0, 1, 5), u, [1.0])
    exponent = np.concatenate([[0.0], np.cumsum(u[0] / 4)])
    assert_allclose(ds.x, 3 * np.exp(-exponent), rtol=1e-6)


def test_models_may_change_at_a_switch():
    """Another model takes over from the transferred state; 1e-6 for rtol 1e-8."""
    other = model(lambda z, theta: -theta * z**2, name="quadratic")
    switch = Switch(0.5, [1.0], [1.0], ss=other, transfer=lambda x: 2 * x)
    ds = simulate(LINEAR, [3.0], np.linspace(0, 1, 5), [1.0], [1.0], switches=[switch])
    start = 6 * np.exp(-0.5)
    assert float(ds.x[-1]) == pytest.approx(start / (1 + start * 0.5), rel=1e-6)
    assert ds.attrs["models"] == "model, quadratic"


@pytest.mark.parametrize("solver", ["cvodes", "idas"])
def test_failure_says_when_and_why(solver, capfd):
    """dx/dt = x^2 from 10 blows up at t = 0.1: the message must find that to a thousandth."""
    ss = model(lambda z, theta: theta * z**2, name="explosive")
    run = stepper(ss, 2, solver=solver)
    with pytest.raises(SimulationError, match=r"explosive: .* failed with") as caught:
        run([10.0], [1.0], [1.0], 0.5, t0=2.0)
    text = str(caught.value)
    reached = float(text.split("as far as t = ")[1].split()[0])
    assert reached == pytest.approx(2.1, abs=1e-3)
    assert "Likely cause" in text
    assert "x = " in text
    assert run([10.0], [1.0], [-1.0], 0.5).x_end[0] == pytest.approx(10 / 6, rel=1e-6)  # still fit


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: stepper(LINEAR, 2)([1.0, 2.0], [1.0], [1.0]), SignalError, r"x0 must have shape"),
        (lambda: stepper(LINEAR, 2)([1.0], [np.nan], [1.0]), SignalError, r"u holds values"),
        (lambda: stepper(LINEAR, 2)([1.0], [1.0]), SignalError, r"theta must have shape \(1,\)"),
        (
            lambda: stepper(LINEAR, 2)([1.0], [1.0], [1.0], 0.0),
            SimulationError,
            r"length must be >",
        ),
        (lambda: stepper(LINEAR, 0), SimulationError, r"at least one output"),
        (lambda: stepper(LINEAR, np.array([0.5])), SimulationError, r"end at 1"),
        (lambda: stepper(LINEAR, solver="cvode"), SimulationError, r"did you mean 'cvodes'"),
        (lambda: stepper(LINEAR, quad=("Y",)), SignalError, r"did you mean 'y'"),
        (lambda: stepper(LINEAR, quad=("y^3",)), SignalError, r"name or name\^2"),
        (
            lambda: simulate(LINEAR, [1.0], [0, 1], [1.0], [1.0], switches=[Switch(1.0, [1.0])]),
            SimulationError,
            r"switch at t = 1 s is outside",
        ),
        (lambda: simulate(LINEAR, [1.0], [0, 0], [1.0], [1.0]), SimulationError, r"increasing"),
        (
            lambda: simulate(LINEAR, [1.0], [0, 1], np.ones((1, 2)), [1.0]),
            SignalError,
            r"one column for each of the 1 intervals",
        ),
    ],
)
def test_misuse_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()


def test_solvers_are_those_documented():
    assert simulation.SOLVERS == ("cvodes", "idas")
