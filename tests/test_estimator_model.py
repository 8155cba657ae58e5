"""Filter models: discretised, measured, augmented; Jacobians against finite differences."""

import dataclasses
import math

import casadi as ca
import numpy as np
import pytest
from estimation_models import (
    constant_velocity,
    cv_parts,
    oscillator,
    signals,
    state_space,
    with_root_finder,
)
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from apu_casadi.core.errors import ParameterError, SignalError
from apu_casadi.core.signals import Signals
from apu_casadi.core.statespace import StateSpace
from estimators.models.filtermodel import (
    FilterModel,
    Unknown,
    augment,
    discretise,
    measure,
    measured_inputs,
    noisy_inputs,
)
from estimators.models.sensorerrors import biases, gains


def value(fun, *args):
    out, check = fun(*args)
    return np.array(out).ravel(), float(check)


@pytest.mark.parametrize(
    ("method", "order"), [("midpoint", 2), ("rk4", 4), ("implicit midpoint", 2)]
)
def test_discretisation_has_its_order(method, order):
    """Halving the step divides the error of one step by 2^(order + 1); SciPy's DOP853 to 1e-13."""
    model = discretise(oscillator(), method=method)
    x, u, p = np.array([0.7, -0.4]), [0.3], [4.0, 0.2]
    errors = []
    for dt in (0.1, 0.05):
        exact = solve_ivp(lambda t, s: [s[1], 0.3 - 4 * np.sin(s[0]) - 0.2 * s[1]], (0, dt), x,
                          method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]  # fmt: skip
        errors.append(np.linalg.norm(value(model.transition, x, u, p, [], dt)[0] - exact))
    assert math.log2(errors[0] / errors[1]) == pytest.approx(order + 1, abs=0.35)
    assert_allclose(value(model.transition, x, u, p, [], 0.0)[0], x, atol=1e-15)


def test_output_is_the_models():
    """Outputs as they are, no noise, parameters theta as p."""
    model = discretise(oscillator(), walk={"r": 0.5})
    assert model.p.names == ("k", "d") and model.sizes == (2, 1, 2, 0, 2)
    y, check = value(model.output, [0.5, 1], [0.3], [4, 0.2], [])
    assert_allclose(y, [np.sin(0.5) + 0.5, 0.3 - 4 * np.sin(0.5) - 0.2])
    assert check == 0
    assert_allclose(model.walk, [0, 0.5])


def test_rk4_by_hand_is_near_the_exponential():
    """The matrices that other tests compare with: RK4's error at dt = 0.1 is below 1e-7."""
    A = cv_parts(0.1)[0]
    M = np.array([[0, 1, 0], [0, -0.3, 1], [0, 0, 0]])
    assert_allclose(A, expm(0.1 * M), atol=1e-7)


def _dae(offset):
    """x' = -z with z + z^3 = x, solved by Newton to `offset` of the truth."""
    x, z, u, t = ca.MX.sym("x"), ca.MX.sym("z"), ca.MX.sym("u", 0), ca.MX.sym("t", 0)
    alg = z + z**3 - x
    s, a = ca.SX.sym("s"), ca.SX.sym("a")
    root = ca.rootfinder("r", "fast_newton", ca.Function("r", [s, a], [s + s**3 - a]))
    z_of = ca.Function("z_of", [x, u, t], [root(0.5, x) + offset])
    f = ca.Function("f", [x, u, t], [-z_of(x, u, t)])
    return StateSpace(
        "dae", signals("a"), signals("z"), Signals(), Signals(), signals("y"),
        residual=ca.Function("res", [x, z, u, t], [-z, alg]),
        f=f, g=ca.Function("g", [x, u, t], [2 * z_of(x, u, t)]), z_of=z_of,
    )  # fmt: skip


def test_eliminated_unknowns_are_checked():
    """check is the residual of what was solved for, in every stage of the step and the output."""
    good, bad = discretise(_dae(0.0)), discretise(_dae(1e-3))
    z = 0.6823278038280193  # root of z + z^3 = 1
    y, check = value(good.output, [1.0], [], [], [])
    assert_allclose(y, 2 * z, rtol=1e-10)
    assert check < 1e-9
    x1, check = value(good.transition, [1.0], [], [], [], 1e-3)
    assert_allclose(x1, 1 - 1e-3 * z, rtol=1e-6)
    assert check < 1e-9
    slope = 1e-3 * (1 + 3 * z**2)
    assert value(bad.output, [1.0], [], [], [])[1] == pytest.approx(slope, rel=1e-2)
    for method, stages in (("midpoint", 2), ("rk4", 4), ("implicit midpoint", 1)):
        check = value(discretise(_dae(1e-3), method=method).transition, [1.0], [], [], [], 1e-6)[1]
        assert check == pytest.approx(stages * slope, rel=1e-2)
    assert value(bad.transition, [1.0], [], [], [], 1e-6)[1] > 1e-9


def whole():
    """Everything at once: noisy input, gain, bias, parameters as states."""
    m = noisy_inputs(discretise(oscillator()), {"tau": 0.3})
    m = biases(gains(m, ["accel", "angle"]), ["angle"])
    return augment(m, {"d": Unknown(walk=0.1, lower=0), "gain_angle": Unknown(consider=True)})


def test_everything_by_name():
    """Orders, walks, bounds, considered states and units of what was added."""
    m = whole()
    assert m.x.names == ("q", "r", "d", "gain_angle")
    assert m.p.names == ("k", "gain_accel", "bias_angle") and m.w.names == ("w_tau",)
    assert_allclose(m.walk, [0, 0, 0.1, 0])
    assert_allclose(m.lower, [-np.inf, -np.inf, 0, -np.inf])
    assert m.consider == ("gain_angle",)
    assert m.p["gain_accel"].unit == "1" and m.p["gain_accel"].default == 0
    assert "bias of the sensor of angle" in m.p["bias_angle"].doc


def test_values_of_everything():
    """Sensor errors and the error of the input, written out."""
    m = whole()
    x, u, p, w = [0.5, 1, 0.2, 0.01], [0.4], [4, 0.02, -0.1], [0.7]
    tau = 0.4 - 0.3 * 0.7
    accel = tau - 4 * np.sin(0.5) - 0.2
    y, _ = value(m.output, x, u, p, w)
    assert_allclose(y, [(np.sin(0.5) + 0.5) * 1.01 - 0.1, accel * 1.02], rtol=1e-14)
    half = np.array([0.5 + 0.05, 1 + 0.05 * accel])
    rate = [half[1], tau - 4 * np.sin(half[0]) - 0.2 * half[1]]
    x1, _ = value(m.transition, x, u, p, w, 0.1)
    assert_allclose(x1, [0.5 + 0.1 * rate[0], 1 + 0.1 * rate[1], 0.2, 0.01], rtol=1e-14)


@pytest.mark.parametrize("which", ["transition", "output"])
def test_jacobians_against_finite_differences(which):
    """Central differences of 1e-6: errors of 1e-9 and less, in x and w."""
    m = whole()
    s = ca.MX.sym("s", 5)
    _, u, p, _, dt = m.symbols()
    args = [s[:4], u, p, s[4:]] + ([dt] if which == "transition" else [])
    v = getattr(m, which)(*args)[0]
    J = ca.Function("J", [s, u, p, dt], [ca.jacobian(v, s), v])
    at, rest = np.array([0.5, 1, 0.2, 0.01, 0.7]), ([0.4], [4, 0.02, -0.1], 0.1)
    num = [(np.array(J(at + h, *rest)[1]) - np.array(J(at - h, *rest)[1])).ravel() / 2e-6
           for h in 1e-6 * np.eye(5)]  # fmt: skip
    assert_allclose(np.array(J(at, *rest)[0]), np.array(num).T, atol=1e-8)


def test_measure_selects_and_orders():
    """Outputs in the order asked for."""
    m = measure(discretise(constant_velocity()), ["push", "place"])
    y, _ = value(m.output, [1, 2], [3], [0.5], [])
    assert m.y.names == ("push", "place")
    assert_allclose(y, [3 - 0.6 + 0.5, 1])


def test_walks_by_name_leave_the_original():
    """with_walk returns another model."""
    m = discretise(oscillator(), walk={"q": 1})
    assert_allclose(m.with_walk({"r": 2}).walk, [1, 2])
    assert_allclose(m.walk, [1, 0])


def test_expanded_writes_out_only_what_it_can():
    """Same values; a root finder stays a call."""
    m = discretise(oscillator())
    e = m.expanded()
    assert e.transition.is_a("SXFunction") and e.output.is_a("SXFunction")
    args = [0.5, 1], [0.4], [4, 0.2], []
    assert_allclose(value(e.output, *args)[0], value(m.output, *args)[0], rtol=1e-15)
    mixed = with_root_finder(m).expanded()
    assert mixed.transition.is_a("SXFunction") and mixed.output.is_a("MXFunction")


MODEL = discretise(oscillator())


@pytest.mark.parametrize(
    ("make", "error", "words"),
    [
        (lambda: discretise(oscillator(), method="rk5"), ParameterError, "did you mean 'rk4'"),
        (lambda: discretise(oscillator(), walk={"z": 1}), SignalError, "unknown signal 'z'"),
        (lambda: discretise(oscillator(), walk={"q": -1}), SignalError, "walk of q must be finite"),
        (lambda: measure(MODEL, ["angel"]), SignalError, "did you mean 'angle'"),
        (lambda: measure(MODEL, []), SignalError, "at least one output"),
        (lambda: noisy_inputs(MODEL, {"tauu": 1}), SignalError, "did you mean 'tau'"),
        (lambda: noisy_inputs(MODEL, {"tau": -1}), ParameterError, "sigma of tau must be finite"),
        (lambda: noisy_inputs(noisy_inputs(MODEL, {"tau": 1}), {"tau": 1}), SignalError, "already"),
        (lambda: gains(MODEL, ["tau"]), SignalError, "unknown signal 'tau'"),
        (lambda: gains(gains(MODEL, ["angle"]), ["angle"]), SignalError, "gain_angle"),
        (lambda: biases(MODEL, ["x"]), SignalError, "unknown signal 'x'"),
        (lambda: augment(MODEL, {"c": Unknown()}), SignalError, "unknown signal 'c'"),
        (lambda: Unknown(walk=-1), ParameterError, "walk must be finite and >= 0, got -1"),
        (lambda: Unknown(walk=math.inf), ParameterError, "got inf"),
        (lambda: Unknown(lower=1, upper=1), ParameterError, "lower = 1 must be below upper = 1"),
        (lambda: Unknown(lower=math.nan), ParameterError, "must be below"),
        (lambda: Unknown(walk=1, consider=True), ParameterError, "walk must be 0"),
        (lambda: changed(walk=np.zeros(3)), SignalError, r"walk: shape \(2,\) expected"),
        (lambda: changed(walk=np.array([0, np.nan])), SignalError, "walk of r must be finite"),
        (lambda: changed(lower=np.array([np.inf, 0])), SignalError, "bounds of q: .*inf.* below"),
        (lambda: changed(consider=("z",)), SignalError, "unknown signal 'z'"),
        (lambda: changed(consider=("q",), walk=np.ones(2)), SignalError, "q is considered, its"),
        (lambda: changed(y=signals("one")), SignalError, r"output: expected .* -> \[1, 1\]"),
        (lambda: changed(u=signals("a b")), SignalError, "pendulum.transition: expected sizes"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(make, error, words):
    """Every message names the thing, and the nearest that exists."""
    with pytest.raises(error, match=words):
        make()


def changed(**fields):
    return dataclasses.replace(MODEL, **fields)


def test_any_state_space_will_do():
    """A model of one state and nothing else."""
    ss = state_space("one", ("a", "", "", "y"), lambda x, u, p: (-x[0],), lambda x, u, p: (x[0],))
    m = discretise(ss)
    assert isinstance(m, FilterModel) and m.sizes == (1, 0, 0, 0, 1)
    assert_allclose(value(m.transition, [1], [], [], [], 0.1)[0], 1 - 0.1 + 0.005)


def test_noise_whose_size_comes_with_the_data():
    """measured_inputs with sigma as an input is noisy_inputs with that sigma; both once only."""
    a = noisy_inputs(MODEL, {"tau": 0.3})
    b = measured_inputs(MODEL, ["tau"])
    assert b.u.names == ("tau", "sigma_tau") and b.w.names == a.w.names
    x, p, w = [0.5, 1], [4, 0.2], [0.7]
    for which, dt in (("transition", [0.1]), ("output", [])):
        expected = value(getattr(a, which), x, [0.4], p, w, *dt)[0]
        assert_allclose(value(getattr(b, which), x, [0.4, 0.3], p, w, *dt)[0], expected)
    for twice in (a, b):
        with pytest.raises(SignalError, match="tau is noisy already"):
            measured_inputs(twice, ["tau"])
    with pytest.raises(SignalError, match="did you mean 'tau'"):
        measured_inputs(MODEL, ["tauu"])
