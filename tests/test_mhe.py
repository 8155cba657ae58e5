"""Moving-horizon estimation: Rao, Rawlings and Mayne (2003), IEEE TAC 48, 246.

The oracle on linear models is the extended Kalman filter of :mod:`estimators.filters.ekf`, itself
tested against a Kalman filter written out by hand; with bounds, a quadratic program solved
densely.
"""

import casadi as ca
import numpy as np
import pytest
from estimation_models import model_of, named
from numpy.testing import assert_allclose
from scipy.optimize import minimize

from apu_casadi.core.errors import DataError, EstimationError, ParameterError, SignalError
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.statespace import StateSpace
from estimators.batch.fit import fit
from estimators.batch.mhe import HorizonEstimator, moving_horizon
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.models.filtermodel import FilterModel, Unknown, augment
from estimators.models.lifting import lift
from estimators.models.recording import Recording, record

A = np.array([[0.9, 0.1, 0.0], [-0.2, 0.8, 0.3], [0.0, 0.0, 1.0]])
B = np.array([[0.4], [-0.3], [0.0]])
G = np.array([[0.5], [0.2], [0.0]])
C = np.array([[1.0, 0.0, 0.5], [0.2, 1.0, 0.0]])
D = np.array([[0.7], [-0.4]])


def linear(**more):
    """Noise w enters output and transition; one state is a constant; one walks."""
    return model_of(
        lambda x, u, p, w, dt: A @ x + B @ u + G @ w,
        lambda x, u, p, w: C @ x + D @ w,
        nx=3, nu=1, nw=1, ny=2, walk=[0.1, 0.0, 0.0], **more,
    )  # fmt: skip


def recorded(K=30, seed=0):
    """Irregular instants, a third of the samples missing."""
    rng = np.random.default_rng(seed)
    y = rng.standard_normal((2, K))
    y[rng.random((2, K)) < 0.3] = np.nan
    return Recording(
        np.cumsum(rng.uniform(0.5, 1.5, K)), rng.standard_normal((1, K)), y,
        np.full((2, K), 0.3), np.zeros(0),
    )  # fmt: skip


def prior_of(m):
    return Belief(m.x, np.ones(len(m.x)), np.diag([1.0, 2.0, 0.5]))


@pytest.mark.parametrize("horizon", [1, 2, 6, 50])
def test_on_a_linear_model_it_is_the_kalman_filter(horizon):
    """For every horizon, shorter or longer than the recording: nothing is counted twice."""
    m, data = linear(), recorded()
    kf = extended_kalman_filter(m, prior_of(m), data, full=True, backend="vm")
    got = moving_horizon(m, prior_of(m), data, horizon=horizon, full=True, backend="vm")
    for name in ("mean", "variance", "innovation", "innovation_variance", "nis", "measured"):
        # goal: 1e-9
        assert_allclose(getattr(got, name), getattr(kf, name), atol=1e-9, rtol=0, err_msg=name)
    assert_allclose(got.cov, kf.cov, atol=1e-9)
    assert_allclose(got.cov_pred, kf.cov_pred, atol=1e-9)
    assert_allclose(got.cross, kf.cross, atol=1e-9)
    assert got.loglik == pytest.approx(kf.loglik, abs=1e-9)
    assert_allclose(got.final.mean, kf.final.mean, atol=1e-9)


def test_a_state_known_exactly_stays_known():
    """A singular prior is no inverse of anything: variance 0 remains, the mean does not move."""
    m = linear()
    prior = Belief(m.x, np.ones(3), np.diag([1.0, 2.0, 0.0]))
    kf = extended_kalman_filter(m, prior, recorded(), backend="vm")
    got = moving_horizon(m, prior, recorded(), horizon=4, backend="vm")
    assert_allclose(got.mean, kf.mean, atol=1e-9)
    assert_allclose(got.mean[2], 1.0, atol=1e-12)
    assert_allclose(got.variance[2], 0.0, atol=1e-15)


def test_one_bounded_window_is_the_quadratic_program():
    """Four samples in one window, dense QP by SLSQP as the other route; two bounds are active."""
    m = linear(lower=[0.3, -np.inf, -np.inf], upper=[np.inf, np.inf, 0.6])
    data, prior = recorded(4, seed=3), prior_of(m)
    got = moving_horizon(m, prior, data, horizon=4, backend="vm")
    L = np.linalg.cholesky(prior.cov)

    def states(v):
        x, rows = prior.mean + L @ v[:3], []
        for k in range(4):
            w, xi = v[3 + 2 * k : 5 + 2 * k]
            rows.append((x, w))
            x = A @ x + B @ data.u[:, k] + G[:, 0] * w
            x = x + np.sqrt(data.dt[k]) * np.array([0.1, 0.0, 0.0]) * xi
        return rows

    def cost(v):
        total = v @ v / 2
        for k, (x, w) in enumerate(states(v)):
            e = (data.y[:, k] - C @ x - D[:, 0] * w) / np.sqrt(0.3)
            total += np.nansum(e**2) / 2
        return total

    limits = [
        {"type": "ineq", "fun": lambda v: np.array([x[0] - 0.3 for x, _ in states(v)])},
        {"type": "ineq", "fun": lambda v: np.array([0.6 - x[2] for x, _ in states(v)])},
    ]
    best = minimize(cost, np.zeros(11), constraints=limits, method="SLSQP",
                    options={"ftol": 1e-14, "maxiter": 500})  # fmt: skip
    assert best.success
    expected = states(best.x)[-1][0]
    free = moving_horizon(linear(), prior, data, horizon=4, backend="vm")
    assert abs(free.mean[:, -1] - expected).max() > 0.05  # else the bounds would test nothing
    assert_allclose(got.mean[:, -1], expected, atol=1e-5)  # SLSQP's own accuracy


def test_estimates_keep_to_their_bounds():
    """A concentration near zero: negative at times without bounds, never with them."""

    def decay(**bounds):
        return model_of(
            lambda x, u, p, w, dt: 0.9 * x, lambda x, u, p, w: x, nx=1, walk=[0.05], **bounds
        )

    rng = np.random.default_rng(1)
    K = 40
    data = Recording(np.arange(K) * 1.0, np.zeros((0, K)), 0.3 * rng.standard_normal((1, K)),
                     np.full((1, K), 0.09), np.zeros(0))  # fmt: skip
    m = decay(lower=[0.0])
    prior = Belief(m.x, np.array([0.2]), np.array([[0.04]]))
    free = moving_horizon(decay(), prior, data, horizon=8, backend="vm")
    held = moving_horizon(m, prior, data, horizon=8, backend="vm")
    assert free.mean.min() < -0.01
    assert held.mean.min() >= 0.0
    # truth decays towards 0 here; the bound is information
    truth = 0.2 * 0.9 ** np.arange(K)
    assert np.square(held.mean - truth).mean() < np.square(free.mean - truth).mean()
    # the claimed variance knows nothing of the bound
    assert_allclose(held.variance, free.variance, rtol=1e-6)


def pendulum():
    """A damped pendulum of unknown frequency, measured by the sine of its angle."""

    def f(x, u, p, w, dt):
        def rate(s):
            return ca.vertcat(s[1], -((1 + p[0]) ** 2) * ca.sin(s[0]) - 0.1 * s[1])

        k = rate(x)
        return x + dt * rate(x + dt / 2 * k)

    m = model_of(f, lambda x, u, p, w: ca.sin(x[0]), nx=2, walk=[0.0, 0.02], p=("detune",))
    return augment(m, {"detune": Unknown(lower=-0.5, upper=0.5)})


def swing(m, K=60, seed=2):
    rng = np.random.default_rng(seed)
    t, x, y = np.arange(K) * 0.1, np.array([1.2, 0.0, 0.2]), []
    for _ in range(K):
        y.append(np.sin(x[0]) + 0.05 * rng.standard_normal())
        x = np.array(m.transition(x, [], [], [], 0.1)[0]).ravel()
        x[1] += np.sqrt(0.1) * 0.02 * rng.standard_normal()
    return record(m, outputs={"y0": (t, y)}, sigma={"y0": 0.05}), x


def test_a_window_over_everything_is_the_batch_estimate():
    """Nonlinear: the last window holds all samples, and so is the batch fit with the same prior."""
    m = pendulum()
    data, _ = swing(m)
    prior = Belief.of(m.x, {"x0": 1.0, "x1": 0.0, "detune": 0.0},
                      {"x0": 0.4, "x1": 0.3, "detune": 0.2})  # fmt: skip
    got = moving_horizon(m, prior, data, horizon=60, backend="vm")
    # the fit wants a parameter: one that does nothing, held by its prior
    idle = FilterModel(
        m.name, m.x, m.u, Signals([Signal("idle", "1", "", 0.0)]), m.w, m.y,
        *_with_parameter(m), m.walk, m.lower, m.upper,
    )  # fmt: skip
    batch = fit(
        idle, Recording(data.t, data.u, data.y, data.variance, np.zeros(1)), ["idle"],
        prior={"idle": (0.0, 1.0)}, beliefs=[Belief(idle.x, prior.mean, prior.cov)], backend="vm",
    )  # fmt: skip
    assert_allclose(got.mean[:, -1], batch.recordings[0].x[:, -1], atol=1e-7)


def _with_parameter(m):
    x, u, _, w, dt = m.symbols()
    p = ca.MX.sym("p", 1)
    none = ca.MX(0, 1)
    return (
        ca.Function("f", [x, u, p, w, dt], m.transition(x, u, none, w, dt)),
        ca.Function("g", [x, u, p, w], m.output(x, u, none, w)),
    )


@pytest.mark.long
def test_a_short_horizon_loses_little():
    """The arrival cost stands for what left: 10 samples of 60 come near the batch estimate."""
    m = pendulum()
    data, truth = swing(m)
    prior = Belief.of(m.x, {"x0": 1.0, "x1": 0.0, "detune": 0.0},
                      {"x0": 0.4, "x1": 0.3, "detune": 0.2})  # fmt: skip
    long, short = (moving_horizon(m, prior, data, horizon=n, backend="vm") for n in (60, 10))
    sigma = np.sqrt(long.variance[:, -1])
    assert (np.abs(short.mean[:, -1] - long.mean[:, -1]) < 0.3 * sigma).all()
    assert_allclose(np.sqrt(short.variance[:, -1]), sigma, rtol=0.1)
    assert (np.abs(long.mean[:, -1] - truth) < 4 * sigma).all()


def test_a_lifted_model_gives_the_same():
    """dx/dt = u - z, z + b z^3 = a x, b a state: root finder inside, and z left to the window."""
    x, z, u, th = ca.MX.sym("x"), ca.MX.sym("z"), ca.MX.sym("u"), ca.MX.sym("th", 2)
    alg = z + th[1] * z**3 - th[0] * x
    root = ca.rootfinder(
        "z", "newton", ca.Function("alg", [z, x, th], [alg]), {"abstol": 1e-13}
    )(th[0] * x, x, th)  # fmt: skip
    signals = (
        Signals([Signal("x", "1", "level")]), Signals([Signal("z", "1", "flow")]),
        Signals([Signal("u", "1", "inflow")]),
        Signals([Signal("a", "1", "", 1.0), Signal("b", "1", "", 0.1)]),
        Signals([Signal("q", "1", "flow")]),
    )  # fmt: skip
    ss = StateSpace.of("reservoir", signals, (x, z, u, th), dae=(u - z, alg), f=u - root, g=root,
                       z=root)  # fmt: skip
    equations = ca.Function("equations", [x, z, u, th], [u - z, alg, z])

    def build(m):
        return augment(m, {"b": Unknown(lower=0.0, upper=1.0)})

    L = lift(ss, build, equations=equations, walk={"x": 0.02})
    rng, t = np.random.default_rng(0), np.arange(8) * 0.2
    data = record(L.model, outputs={"q": (t, 0.7 + 0.02 * rng.standard_normal(8))},
                  sigma={"q": 0.02}, inputs={"u": (t, 1 + 0.3 * np.sin(t))})  # fmt: skip
    prior = Belief.of(L.model.x, {"x": 0.8, "b": 0.2}, {"x": 0.1, "b": 0.1})
    one, two = (moving_horizon(m, prior, data, horizon=4, backend="vm") for m in (L, L.model))
    assert_allclose(one.mean, two.mean, atol=1e-8)
    assert_allclose(one.variance, two.variance, rtol=1e-7)
    with pytest.raises(ParameterError, match="steady points do not follow each other"):
        HorizonEstimator(lift(ss, equations=equations, steady=True), 3)


def test_it_tells_what_it_cannot_do():
    """Considered states, a horizon of nothing, strangers, a window that cannot be solved."""
    m = linear()
    with pytest.raises(ParameterError, match="horizon must be a whole number >= 1, got 0"):
        HorizonEstimator(m, 0)
    considered = augment(
        model_of(lambda x, u, p, w, dt: x, lambda x, u, p, w: x + p, nx=1, p=("bias",)),
        {"bias": Unknown(consider=True)},
    )
    with pytest.raises(ParameterError, match=r"considered states \(bias\)"):
        HorizonEstimator(considered, 3)
    made = HorizonEstimator(m, 3, backend="vm", max_iterations=1)
    other = Belief(named("z", 3), np.zeros(3), np.eye(3))
    with pytest.raises(SignalError, match="prior of z0, z1, z2; toy has x0, x1, x2"):
        made.run(other, recorded())
    short = Recording(np.arange(2.0), np.zeros((0, 2)), np.zeros((1, 2)), np.ones((1, 2)),
                      np.zeros(0))  # fmt: skip
    with pytest.raises(DataError, match="toy has 1 inputs"):
        made.run(prior_of(m), short)
    root = model_of(lambda x, u, p, w, dt: x, lambda x, u, p, w: ca.sqrt(x), nx=1)
    data = Recording(np.arange(2.0), np.zeros((0, 2)), np.ones((1, 2)), np.ones((1, 2)),
                     np.zeros(0))  # fmt: skip
    with pytest.raises(EstimationError, match=r"t = 0 s \(sample 0\): toy: no estimate found"):
        moving_horizon(root, Belief(root.x, np.array([-1.0]), np.eye(1)), data, backend="vm")


def test_progress_is_told():
    """Called after every instant."""
    m, seen = linear(), []
    moving_horizon(m, prior_of(m), recorded(5), horizon=2, backend="vm",
                   progress=lambda a, b: seen.append((a, b)))  # fmt: skip
    assert seen == [(k, 5) for k in range(1, 6)]
