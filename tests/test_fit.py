"""Batch fits.  Linear models: dense least squares written out here (Bjorck 1996, section 2.1).

Nonlinear ones: one-parameter problems whose likelihood is scanned directly, and the two forms of
one model, lifted and eliminated, against each other.
"""

import casadi as ca
import numpy as np
import pytest
from estimation_models import model_of, named
from numpy.testing import assert_allclose
from scipy.optimize import brentq, minimize_scalar

from apu_casadi.core.errors import DataError, EstimationError, ParameterError
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from estimators.batch.fit import FitProblem, fit, profile
from estimators.batch.transcription import Transcription, square_root
from estimators.filters.belief import Belief
from estimators.models.filtermodel import (
    Unknown,
    augment,
    discretise,
    measure,
    measured_inputs,
    noisy_inputs,
)
from estimators.models.lifting import lift, plain
from estimators.models.recording import Recording, record
from estimators.models.sensorerrors import biases, gains


def static(g, p, ny=1):
    """A model that is its output: no inputs, a state that does nothing."""
    return model_of(lambda x, u, q, w, dt: x, lambda x, u, q, w: g(x, q), p, ny=ny)


# ------------------------------------------------------------------------------ linear

A = np.array([[0.9, 0.2], [-0.3, 0.8]])
E = np.array([[0.5, 0.0, 0.0], [0.1, 0.4, 0.0]])  # how p enters the state
C = np.array([[1.0, 0.0], [0.5, 1.0], [0.0, 1.0]])
F = np.array([[0.0, 0.0, 1.0], [0.0, 0.3, 0.0], [0.2, 0.0, 0.0]])
G, D = np.array([[0.3], [0.6]]), np.array([[0.5], [0.0], [-0.2]])
WALK = np.array([0.2, 0.0])


@pytest.fixture(scope="module")
def linear():
    return model_of(
        lambda x, u, p, w, dt: A @ x + E @ p + G @ w + u,
        lambda x, u, p, w: C @ x + F @ p + D @ w,
        ("a", "b", "c"), nx=2, nu=1, nw=1, ny=3, walk=WALK,
    )  # fmt: skip


@pytest.fixture(scope="module")
def data():
    """Two recordings of different length, irregular, with gaps."""
    rng = np.random.default_rng(0)
    out = []
    for K in (12, 7):
        y = rng.standard_normal((3, K))
        y[rng.random((3, K)) < 0.25] = np.nan
        variance = rng.uniform(0.1, 0.5, (3, K))
        t = np.cumsum(rng.uniform(0.5, 2.0, K))
        out.append(
            Recording(t, rng.standard_normal((1, K)), y, variance, np.array([0.1, 0.2, 0.3]))
        )
    return out


def rows_of(data, x0, p_of):
    """Residuals of everything as a function of one long vector, hence its exact matrix."""

    def residuals(v):
        e, at = [], v.size - sum(2 + 2 * r.size for r in data)
        for i, r in enumerate(data):
            p, x = p_of(v, i), v[at : at + 2]
            if x0 is not None:
                e += list(x)
                x = x0.mean + square_root(x0.cov) @ x
            at += 2
            for k in range(r.size):
                w, xi = v[at], v[at + 1]
                at += 2
                y = C @ x + F @ p + D[:, 0] * w
                ok = ~np.isnan(r.y[:, k])
                e += [*((r.y[:, k] - y) / np.sqrt(r.variance[:, k]))[ok], w, xi]
                x = A @ x + E @ p + G[:, 0] * w + r.u[:, k] + np.sqrt(r.dt[k]) * WALK * xi
        return np.array(e)

    return residuals


def least_squares(residuals, n):
    b = residuals(np.zeros(n))
    M = np.column_stack([residuals(np.eye(n)[i]) - b for i in range(n)])
    v = np.linalg.lstsq(M, -b, rcond=None)[0]
    return v, np.linalg.inv(M.T @ M), float(np.sum((M @ v + b) ** 2)), M


SIZE = 2 * (2 + 2) + 2 * (12 + 7) - 4


def test_it_is_batch_least_squares_on_a_linear_model(linear, data):
    """Shared and own parameters, free first states, noise in output and transition alike."""
    n = 1 + 2 + 2 * 2 + 2 * 19  # a; b[0], b[1]; first states; noises

    def p_of(v, r):
        return np.array([v[0], v[1 + r], 0.3])

    v, cov, chi2, _ = least_squares(rows_of(data, None, p_of), n)
    got = fit(linear, data, ["a"], own=["b"], backend="vm")
    assert got.names == ("a", "b[0]", "b[1]")
    # goal: 1e-9
    assert_allclose(got.estimate, v[:3], atol=1e-9)
    assert_allclose(got.covariance, cov[:3, :3], atol=1e-9)
    assert got.chi2 == pytest.approx(chi2, abs=1e-9)
    measured = sum(int((~np.isnan(r.y)).sum()) for r in data)
    assert got.freedom == measured - 3 - 4  # parameters and first states
    assert_allclose(got.recordings[1].x[:, 0], v[3 + 2 + 24 : 3 + 2 + 24 + 2], atol=1e-9)
    assert_allclose(got.recordings[0].w[0], v[5 : 5 + 24 : 2], atol=1e-9)


def test_priors_and_beliefs_are_data(linear, data):
    """A prior is one more residual; the same by dense least squares."""
    belief = Belief(linear.x, np.array([0.3, -0.2]), np.array([[0.5, 0.2], [0.2, 0.4]]))
    n = 2 + 2 * 2 + 2 * 19

    def residuals(v):
        inner = rows_of(data, belief, lambda v, r: np.array([v[0], 0.2, v[1]]))(v)
        return np.append(inner, (v[0] - 0.7) / 0.3)

    v, cov, chi2, _ = least_squares(residuals, n)
    got = fit(linear, data, ["a", "c"], prior={"a": (0.7, 0.3)}, beliefs=[belief] * 2, backend="vm")
    assert_allclose(got.estimate, v[:2], atol=1e-9)
    assert_allclose(got.covariance, cov[:2, :2], atol=1e-9)
    assert got.chi2 == pytest.approx(chi2, abs=1e-9)
    assert got.freedom == sum(int((~np.isnan(r.y)).sum()) for r in data) + 1 - 2
    logs = sum(np.log(2 * np.pi * r.variance[~np.isnan(r.y)]).sum() for r in data)
    assert got.loglik == pytest.approx(-(chi2 + logs) / 2)


def test_considered_parameters_widen_the_intervals(linear, data):
    """Schmidt: the estimate is unchanged; its error gains what the wrong value would move it."""
    got = fit(linear, data, ["a"], consider={"b": 0.4, "c": 0.1}, backend="vm")
    plain_ = fit(linear, data, ["a"], backend="vm")
    assert got.estimate == pytest.approx(plain_.estimate, abs=1e-9)
    assert_allclose(got.noise_covariance, plain_.covariance, atol=1e-12)
    moved = []
    for i in (1, 2):  # the direct way: fit again with another value
        p = data[0].p + 0.01 * np.eye(3)[i]
        other = [Recording(r.t, r.u, r.y, r.variance, p) for r in data]
        moved.append((fit(linear, other, ["a"], backend="vm").estimate - got.estimate)[0] / 0.01)
    assert_allclose(got.sensitivity[0], moved, atol=1e-7)
    extra = (0.4 * moved[0]) ** 2 + (0.1 * moved[1]) ** 2
    assert got.covariance[0, 0] == pytest.approx(plain_.covariance[0, 0] + extra, rel=1e-6)


def test_the_profile_of_a_linear_model_is_the_interval(linear, data):
    """The likelihood is a parabola: profile and standard error say the same."""
    got = fit(linear, data, ["a", "c"], backend="vm")
    p = profile(got, "c")
    assert_allclose((p.lower, p.upper), got.interval("c"), rtol=0, atol=2e-3 * got["c"][1])
    m, s = got["c"]
    assert_allclose(p.drop, ((p.values - m) / s) ** 2, atol=1e-6)
    narrow = profile(got, "c", level=0.5)
    assert narrow.upper - narrow.lower < 0.5 * (p.upper - p.lower)


# ------------------------------------------------------------------------------ nonlinear


def decay_data(n=8, seed=1, k=0.8):
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 2.0, n)
    y = np.exp(-k * t) + 0.15 * rng.standard_normal(n)
    m = model_of(
        lambda x, u, p, w, dt: x * ca.exp(-p[0] * dt), lambda x, u, p, w: x, ("k", "scale"), nx=1
    )
    rec = record(m, outputs={"y0": (t, y)}, sigma={"y0": 0.15})
    return m, rec, Belief(m.x, np.array([1.0]), np.zeros((1, 1)))  # known first state


def test_a_nonlinear_profile_is_the_scanned_likelihood():
    """One parameter: chi2(k) is a formula, minimised and solved for its threshold by scipy."""
    m, rec, one = decay_data()

    def chi2(k):
        return float(np.sum((rec.y[0] - np.exp(-k * rec.t)) ** 2) / 0.15**2)

    best = minimize_scalar(chi2, bounds=(0.1, 3.0), method="bounded", options={"xatol": 1e-10})
    got = fit(m, rec, ["k"], guess={"k": 0.3}, beliefs=[one], backend="vm")
    assert got.estimate[0] == pytest.approx(best.x, abs=1e-6)
    assert got.chi2 == pytest.approx(best.fun, abs=1e-9)
    p = profile(got, "k")
    at = 3.8414588  # chi-squared with one degree of freedom, 95 %
    low = brentq(lambda k: chi2(k) - best.fun - at, 0.01, best.x)
    high = brentq(lambda k: chi2(k) - best.fun - at, best.x, 6.0)
    assert_allclose((p.lower, p.upper), (low, high), rtol=2e-3)
    # it is lopsided, which a standard error cannot be
    assert p.upper - best.x > 1.1 * (best.x - p.lower)
    # observed information, exact Hessian: second difference of the same formula
    h = 1e-4
    second = (chi2(best.x + h) - 2 * chi2(best.x) + chi2(best.x - h)) / h**2
    exact = fit(m, rec, ["k"], beliefs=[one], exact=True, backend="vm", guess={"k": 0.3})
    assert exact["k"][1] == pytest.approx(np.sqrt(2 / second), rel=1e-4)
    assert exact["k"][1] != pytest.approx(got["k"][1], rel=1e-3)


def test_a_profile_may_be_open():
    """y = exp(-k) with k large: no value is too large; the end is infinite, or the bound."""
    m = static(lambda x, p: ca.exp(-p[0]) + 0 * x, ("k",))
    rec = Recording(np.zeros(1), np.zeros((0, 1)), np.full((1, 1), 0.01), np.full((1, 1), 1e-4),
                    np.zeros(1))  # fmt: skip
    known = [Belief(m.x, np.zeros(1), np.zeros((1, 1)))]
    got = fit(m, rec, ["k"], guess={"k": 3.0}, beliefs=known, backend="vm")
    assert got.estimate[0] == pytest.approx(-np.log(0.01), abs=1e-6)
    assert profile(got, "k").upper == np.inf
    held = fit(m, rec, ["k"], guess={"k": 3.0}, bounds={"k": (0, 8)}, beliefs=known, backend="vm")
    assert profile(held, "k").upper == pytest.approx(8.0)


def test_exact_derivatives_of_the_program():
    """Gradient, Jacobian and Hessian against central differences, away from any solution."""
    m = model_of(
        lambda x, u, p, w, dt: ca.vertcat(x[1], -ca.sin(x[0] * (1 + p[0])) + p[1] * w),
        lambda x, u, p, w: ca.vertcat(x[0] * x[1] * (1 + p[1]), ca.exp(p[2] * w) * x[1]),
        ("a", "b", "c"), nx=2, nw=1, ny=2, walk=[0.0, 0.3],
    )  # fmt: skip
    rng = np.random.default_rng(4)
    recs = [
        Recording(np.arange(float(K)), np.zeros((0, K)), rng.standard_normal((2, K)),
                  np.full((2, K), 0.2), np.zeros(3))
        for K in (3, 2)
    ]  # fmt: skip
    T = Transcription(plain(m), (3, 2), ("a", "b"), ("c",), prior=True, backend="vm")
    b = Belief(m.x, np.ones(2), np.array([[1.0, 0.3], [0.3, 2.0]]))
    P = T.data(recs, mean=np.full(4, 0.2), weight=np.array([2.0, 0, 1, 3]), beliefs=[b, b])
    z, lam = rng.standard_normal(T.n_z), rng.standard_normal(T.n_g)
    F, h = T.functions, 1e-5
    assert T.n_g == 2 * (2 + 1) + 2 * 2

    def differences(fun):
        cols = [(fun(z + h * e) - fun(z - h * e)) / (2 * h) for e in np.eye(T.n_z)]
        return np.column_stack(cols)

    def value(k):
        return lambda z: np.array(F["nlp"](z, P)[k]).ravel()

    grad = np.array(F["grad_f"](z, P)[1]).ravel()
    assert_allclose(grad, differences(value(0))[0], atol=1e-7, rtol=1e-7)
    jac = F["jac_g"](z, P)[1].full()
    assert_allclose(jac, differences(value(1)), atol=1e-7)

    def lagrangian(z):
        J = F["jac_g"](z, P)[1].full()
        return 0.7 * np.array(F["grad_f"](z, P)[1]).ravel() + J.T @ lam

    U = F["hess_lag"](z, P, 0.7, lam).full()
    assert_allclose(U, np.triu(U))
    assert_allclose(U + np.triu(U, 1).T, differences(lagrangian), atol=1e-6)


@pytest.mark.long
def test_intervals_hold_the_truth():
    """120 fits of a decay with one program: 95 % intervals; chi2 has its degrees of freedom."""
    m, rec, one = decay_data(n=12)
    problem = FitProblem(m, [12], ["k"], beliefs=True, backend="vm")
    rng, hits, chi2, n = np.random.default_rng(7), 0, [], 120
    for _ in range(n):
        y = np.exp(-0.8 * rec.t) + 0.03 * rng.standard_normal(12)
        r = Recording(rec.t, rec.u, y[None, :], np.full((1, 12), 9e-4), rec.p)
        got = problem.solve([r], guess={"k": 0.5}, beliefs=[one])
        low, high = got.interval("k")
        hits += low <= 0.8 <= high
        chi2.append(got.chi2)
    # three binomial standard deviations of 120 fits are 6 %
    assert abs(hits / n - 0.95) < 0.06
    # freedom is 11; the mean of 120 has the standard deviation 0.43
    assert abs(np.mean(chi2) - got.freedom) < 4 * np.sqrt(2 * 11 / n)


# ------------------------------------------------------------------------------ what cannot be told


def test_directions_without_information_are_named():
    """a and b enter as a sum only, d not at all; c is determined all the same."""
    m = static(lambda x, p: ca.vertcat(p[0] + p[1], p[2]) + 0 * p[3] + 0 * x, ("a", "b", "c", "d"),
               ny=2)  # fmt: skip
    y = np.array([[1.0, 1.2], [3.0, 3.2]])
    rec = Recording(np.arange(2.0), np.zeros((0, 2)), y, np.full((2, 2), 0.02), np.zeros(4))
    got = fit(m, rec, ["a", "b", "c", "d"], beliefs=[Belief(m.x, np.zeros(1), np.eye(1))],
              backend="vm")  # fmt: skip
    assert got.undetermined[0] == "nothing measured depends on d"
    assert got.undetermined[1].startswith("b and a cannot be told apart: the change +0.71") or (
        got.undetermined[1].startswith("a and b cannot be told apart: the change +0.71")
    )
    assert np.isinf(got.sigma[[0, 1, 3]]).all() and np.isnan(got.covariance[0, 1])
    assert got["c"] == pytest.approx((3.1, 0.1))
    assert np.isnan(got.correlation[0, 2])
    p = profile(got, "a", points=4)
    assert (p.lower, p.upper) == (-np.inf, np.inf)
    # a prior on one of them tells them apart
    got = fit(m, rec, ["a", "b"], prior={"a": (0.2, 0.1)}, backend="vm",
              beliefs=[Belief(m.x, np.zeros(1), np.eye(1))])  # fmt: skip
    assert not got.undetermined and got["b"] == pytest.approx((0.9, np.sqrt(0.01 + 0.01)))


def test_weak_directions_are_named_too():
    """Nearly a sum: told, with its strength, and the numbers stand."""
    m = static(lambda x, p: ca.vertcat(p[0] + p[1], p[0] + 1.001 * p[1]) + 0 * x, ("a", "b"), ny=2)
    rec = Recording(np.zeros(1), np.zeros((0, 1)), np.ones((2, 1)), np.ones((2, 1)), np.zeros(2))
    got = fit(m, rec, ["a", "b"], beliefs=[Belief(m.x, np.zeros(1), np.eye(1))], backend="vm")
    assert not got.undetermined and np.isfinite(got.sigma).all()
    assert "can hardly be told apart" in got.weak[0]


def test_a_parameter_at_its_bound_gets_no_interval():
    """The mean of the data is 1.1; a may be at most 1."""
    m = static(lambda x, p: p[0] + 0 * x, ("a",))
    rec = Recording(np.arange(2.0), np.zeros((0, 2)), np.array([[1.0, 1.2]]), np.ones((1, 2)),
                    np.zeros(1))  # fmt: skip
    got = fit(m, rec, ["a"], bounds={"a": (0.0, 1.0)}, backend="vm",
              beliefs=[Belief(m.x, np.zeros(1), np.eye(1))])  # fmt: skip
    assert got.at_bound == ("a",) and got.estimate[0] == pytest.approx(1.0)
    assert np.isnan(got.sigma[0])


def test_states_that_nothing_determines():
    """A free first state that shows nowhere is not the parameter's fault; the message says so."""
    m = static(lambda x, p: p[0] + 0 * x, ("a",))
    rec = Recording(np.zeros(1), np.zeros((0, 1)), np.ones((1, 1)), np.ones((1, 1)), np.zeros(1))
    with pytest.raises(EstimationError, match="states are not determined by these data even with"):
        fit(m, rec, ["a"], backend="vm")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"estimate": ["kk"]}, "did you mean 'k'"),
        ({"estimate": ["x0"]}, "it is a state of this model"),
        ({"estimate": []}, "nothing to estimate"),
        ({"own": ["k"]}, "at once: k"),
        ({"guess": {"q": 1.0}}, "guess of 'q', which is not fitted"),
        ({"prior": {"k": (0.5, 0.0)}}, "sigma > 0"),
        ({"bounds": {"k": (1.0, 1.0)}}, "is no interval"),
        ({"consider": {"scale": -1.0}}, "must be >= 0"),
        ({"states": [{"z": 1.0}]}, "guess of state 'z'"),
    ],
)
def test_refusals(more, words):
    """Names and numbers that do not fit the model."""
    m, rec, one = decay_data()
    with pytest.raises(ParameterError, match=words):
        fit(m, rec, **({"estimate": ["k"], "beliefs": [one], "backend": "vm"} | more))


def test_more_refusals():
    """Built once for other sizes or without beliefs; considered values that differ; no solution."""
    m, rec, one = decay_data()
    problem = FitProblem(m, [8], ["k"], consider=["scale"], beliefs=True, backend="vm")
    with pytest.raises(ParameterError, match=r"recordings of \(8,\) samples expected, got \(3,\)"):
        problem.solve([rec.part(0, 3)], beliefs=[one], consider={"scale": 1.0})
    with pytest.raises(ParameterError, match="built with, called without"):
        problem.solve([rec], consider={"scale": 1.0})
    with pytest.raises(ParameterError, match="standard deviations of scale expected"):
        problem.solve([rec], beliefs=[one])
    other = Recording(rec.t, rec.u, rec.y, rec.variance, np.array([0.0, 1.0]))
    with pytest.raises(ParameterError, match="scale differs between recordings"):
        fit(m, [rec, other], ["k"], consider={"scale": 1.0}, beliefs=[one, one], backend="vm")
    with pytest.raises(DataError, match="toy has 0 inputs"):
        fit(m, Recording(rec.t, rec.y, rec.y, rec.variance, rec.p), ["k"], backend="vm")
    with pytest.raises(EstimationError, match=r"IPOPT ended with Maximum_Iterations_Exceeded"):
        fit(m, rec, ["k"], guess={"k": 0.1}, beliefs=[one], max_iterations=1, backend="vm")
    got = fit(m, rec, ["k"], guess={"k": 0.3}, beliefs=[one], backend="vm")
    with pytest.raises(ParameterError, match="no estimate of 'kk'"):
        got["kk"]
    with pytest.raises(ParameterError, match="level = 2"):
        got.interval("k", 2)
    states = augment(m, {"scale": Unknown(consider=True)})
    with pytest.raises(ParameterError, match=r"considered states \(scale\) belong to filters"):
        fit(states, rec, ["k"], backend="vm")


# ------------------------------------------------------------------------------ lifting


def reservoir():
    """dx/dt = u - z with z + b z^3 = a x: a toy whose z needs a root finder."""
    x, z, u, th = ca.MX.sym("x"), ca.MX.sym("z"), ca.MX.sym("u"), ca.MX.sym("th", 2)
    alg = z + th[1] * z**3 - th[0] * x
    fun = ca.Function("alg", [z, x, th], [alg])
    z0 = ca.rootfinder("z", "newton", fun, {"abstol": 1e-13})(th[0] * x, x, th)
    signals = (
        Signals([Signal("x", "1", "level", nominal=2.0)]),
        Signals([Signal("z", "1", "flow", nominal=0.5)]),
        Signals([Signal("u", "1", "inflow")]),
        Signals([Signal("a", "1", "", 1.0), Signal("b", "1", "", 0.1)]),
        Signals([Signal("x", "1", "level"), Signal("q", "1", "flow")]),
    )
    ss = StateSpace.of(
        "reservoir", signals, (x, z, u, th), dae=(u - z, alg),
        f=u - z0, g=ca.vertcat(x, z0**2), z=z0,
    )  # fmt: skip
    equations = ca.Function("equations", [x, z, u, th], [u - z, alg, ca.vertcat(x, z**2)])
    return ss, equations


def chain(m):
    return gains(biases(noisy_inputs(measure(m, ["q", "x"]), {"u": 0.05}), ["x"]), ["q"])


def flow_data(m, p=(1.3, 0.2), K=25, seed=3):
    rng = np.random.default_rng(seed)
    t, u = np.arange(K) * 0.2, 1 + 0.5 * np.sin(np.arange(K) * 0.7)
    x, rows = np.array([0.8]), []
    at = np.array([*p, 0.0, 0.0])
    for k in range(K):
        noise = rng.standard_normal(1)
        y, _ = m.output(x, u[k], at, noise)
        rows.append(np.array(y).ravel() + 0.02 * rng.standard_normal(2))
        x = np.array(m.transition(x, u[k], at, noise, 0.2)[0]).ravel()
    q, level = np.array(rows).T
    return record(m, outputs={"q": (t, q), "x": (t, level)}, sigma={"q": 0.02, "x": 0.02},
                  inputs={"u": (t, u)})  # fmt: skip


def test_lifted_and_eliminated_are_one_model():
    """The root finder inside the program, its exact Hessian included, and z as unknowns: 1e-8."""
    ss, equations = reservoir()
    L = lift(ss, chain, equations=equations)
    assert L.model.y.names == ("q", "x") and L.model.p.names == ("a", "b", "bias_x", "gain_q")
    assert L.s.names == ("z_a", "x_m", "z_m")
    rec = flow_data(L.model)
    # the bounds keep the root finder where it has one root
    how = {"prior": {"gain_q": (0, 0.02)}, "bounds": {"a": (0.5, 3), "b": (0, 1)}, "backend": "vm"}
    one, two = (fit(m, rec, ["a", "b", "gain_q"], **how) for m in (L, L.model))
    assert_allclose(one.estimate, two.estimate, atol=1e-8)
    assert_allclose(one.covariance, two.covariance, atol=1e-9)
    assert one.chi2 == pytest.approx(two.chi2, abs=1e-8) and one.freedom == two.freedom
    assert (np.abs(one.estimate - [1.3, 0.2, 0.0]) < 4 * one.sigma).all()


def test_steady_points_are_states_at_rest():
    """At rest z = u: q = u^2, and x = (u + b u^3)/a; the program must find the same."""
    ss, equations = reservoir()
    L = lift(ss, lambda m: measure(m, ["x"]), equations=equations, steady=True)
    u = np.array([0.5, 1.0, 1.5, 2.0])
    rng = np.random.default_rng(0)
    level = (u + 0.2 * u**3) / 1.3 + 0.01 * rng.standard_normal(4)
    t = np.arange(4.0)
    rec = record(L.model, outputs={"x": (t, level)}, sigma={"x": 0.01}, inputs={"u": (t, u)})
    got = fit(L, rec, ["a", "b"], backend="vm")
    # linear in (1/a, b/a): ordinary least squares, then back
    c, *_ = np.linalg.lstsq(np.column_stack([u, u**3]), level, rcond=None)
    assert_allclose(got.estimate, [1 / c[0], c[1] / c[0]], atol=1e-8)
    assert got.freedom == 2
    assert_allclose(got.recordings[0].y[0], np.column_stack([u, u**3]) @ c, atol=1e-9)
    with pytest.raises(ParameterError, match="a steady model has no process noise"):
        lift(ss, equations=equations, steady=True, walk={"x": 0.1})


def test_inputs_measured_with_noise_that_comes_with_the_data():
    """measured_inputs with a constant sigma is noisy_inputs."""
    ss, equations = reservoir()
    fixed = lift(ss, lambda m: noisy_inputs(measure(m, ["q", "x"]), {"u": 0.05}),
                 equations=equations)  # fmt: skip
    given = lift(ss, lambda m: measured_inputs(measure(m, ["q", "x"]), ["u"]), equations=equations)
    assert given.model.u.names == ("u", "sigma_u") and given.model.w.names == ("w_u",)
    rec = flow_data(lift(ss, chain, equations=equations).model)
    a = fit(fixed, Recording(rec.t, rec.u, rec.y, rec.variance, rec.p[:2]), ["a"], backend="vm")
    u = np.vstack([rec.u, np.full((1, rec.size), 0.05)])
    b = fit(given, Recording(rec.t, u, rec.y, rec.variance, rec.p[:2]), ["a"], backend="vm")
    assert_allclose(b.estimate, a.estimate, atol=1e-9)
    assert_allclose(b.sigma, a.sigma, atol=1e-9)


def test_lifting_tells_what_it_needs():
    """z without equations; equations of another model."""
    ss, _ = reservoir()
    with pytest.raises(ParameterError, match="reservoir has the algebraic unknowns z: give"):
        lift(ss)
    x = ca.MX.sym("x")
    wrong = ca.Function("equations", [x, ca.MX.sym("z")], [x])
    with pytest.raises(ParameterError, match="equations of sizes"):
        lift(ss, equations=wrong)


def test_the_gas_generator_lifted():
    """Stage against f and g with the root finder, away from equilibrium."""
    gg = GasGenerator()
    ss = gg.state_space

    def build(m):
        return noisy_inputs(gains(measure(m, ["T3", "P3"]), ["P3"]), {"Wf": 3e-4})

    L = lift(ss, build, equations=gg.equations)
    assert L.stage.is_a("SXFunction") and L.frozen.size1_out(0) == 2 * 110
    x = np.array([3700.0])
    u = ss.u.pack({"Wf": 0.04, "PW": 2e5, "dT_isa": 5.0})
    p, w, dt = np.array([0.98, 1.01, 0.99, 1.02, 0.01]), np.array([0.5]), 0.02
    y, _ = L.model.output(x, u, p, w)
    x1, _ = L.model.transition(x, u, p, w, dt)
    true = u - [0.5 * 3e-4, 0, 0, 0, 0, 0]
    z = np.array(ss.z_of(x, true, p[:4])).ravel()
    middle = x + dt / 2 * np.array(ss.f(x, true, p[:4])).ravel()
    s = np.concatenate([z, middle, np.array(ss.z_of(middle, true, p[:4])).ravel()])
    k = L.frozen(x, s, u, p, w, dt)
    got = [np.array(o).ravel() for o in L.stage(x, s, u, p, w, dt, k)]
    # the root finder stops at 1e-11
    assert_allclose(got[0], np.array(y).ravel(), rtol=1e-9)
    assert_allclose(got[1], np.array(x1).ravel(), rtol=1e-12)
    assert_allclose(got[2], 0.0, atol=1e-9)
    start = np.array(L.start(x, true, p)).ravel()
    assert_allclose(start, np.concatenate([z, x, z]), rtol=1e-9)


def test_health_factors_from_steady_points():
    """Four points without noise, by the trim solver: the factors come back."""
    gg = GasGenerator()
    truth = {"f_eta_c": 0.97, "f_W_c": 0.98, "f_eta_t": 0.99, "f_W_t": 1.02}
    points = [
        trim_gas_generator(gg, {"N": gg.parameters.N, "PW": P}, theta=truth)
        for P in (1e5, 2e5, 3e5, 4e5)
    ]
    names = ["N", "P3", "T3", "T5"]
    L = lift(gg.state_space, lambda m: noisy_inputs(measure(m, names), {"Wf": 3e-4, "PW": 2e3}),
             equations=gg.equations, steady=True)  # fmt: skip
    t = np.arange(4.0)
    rec = record(
        L.model,
        outputs={n: (t, np.array([p[n] for p in points])) for n in names},
        sigma={"N": 5.0, "P3": 2e3, "T3": 2.0, "T5": 2.0},
        inputs={n: (t, np.array([p[n] for p in points])) for n in ("Wf", "PW")},
    )
    got = fit(L, rec, list(truth), backend="vm")
    # trim residual 1e-9, IPOPT 1e-10
    assert_allclose(got.estimate, list(truth.values()), atol=1e-7)
    assert got.chi2 < 1e-9 and got.freedom == 4 * 4 - 4


@pytest.mark.slow
def test_a_transient_with_the_root_finder_inside():
    """The gas generator as discretise() makes it, and lifted: estimates agree to 1e-8."""
    gg = GasGenerator()
    names = ["N", "P3", "T3", "T5"]

    def build(m):
        return noisy_inputs(measure(m, names), {"Wf": 3e-4, "PW": 2e3})

    L = lift(gg.state_space, build, equations=gg.equations)
    pt = trim_gas_generator(gg, {"N": gg.parameters.N, "PW": 250e3})
    rng, t = np.random.default_rng(1), np.arange(15) * 0.02
    sigma = {"N": 2.0, "P3": 800.0, "T3": 1.0, "T5": 3.0}
    rec = record(
        L.model,
        outputs={n: (t, pt[n] + sigma[n] * rng.standard_normal(15)) for n in names},
        sigma=sigma, inputs=dict(zip(gg.U.names, pt.u, strict=True)),
    )  # fmt: skip
    health = gg.THETA.names
    a, b = (fit(m, rec, health, backend="vm") for m in (L, L.model))
    assert_allclose(a.estimate, b.estimate, atol=1e-8)
    assert_allclose(a.sigma, b.sigma, rtol=1e-6)


def test_a_plain_model_needs_no_lifting():
    """discretise() of a model without z, and lift() of it, are the same fit."""
    x, z, u, th = ca.SX.sym("x"), ca.SX.sym("z", 0), ca.SX.sym("u"), ca.SX.sym("th")
    signals = (named("x", 1), Signals(), named("u", 1), Signals([Signal("a", "1", "", 1.0)]),
               named("y", 1))  # fmt: skip
    ss = StateSpace.of("lag", signals, (x, z, u, th), dae=(th * (u - x), ca.SX(0, 1)),
                       f=th * (u - x), g=x, z=ca.SX(0, 1))  # fmt: skip
    m = discretise(ss)
    rng, t = np.random.default_rng(0), np.arange(20) * 0.2
    y = 1 - np.exp(-1.5 * t) + 0.02 * rng.standard_normal(20)
    rec = record(m, outputs={"y0": (t, y)}, sigma={"y0": 0.02}, inputs={"u0": 1.0})
    a, b = (fit(k, rec, ["a"], backend="vm") for k in (m, lift(ss)))
    assert_allclose(a.estimate, b.estimate, atol=1e-9)
    assert_allclose(a.sigma, b.sigma, rtol=1e-7)
    assert abs(a.estimate[0] - 1.5) < 4 * a.sigma[0]
