"""Small models for the tests of the estimators, and data for them."""

import dataclasses
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.optimize import least_squares

from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.statespace import StateSpace
from estimators.filters.belief import Belief
from estimators.models.filtermodel import (
    FilterModel,
    Unknown,
    augment,
    discretise,
    measure,
    noisy_inputs,
)
from estimators.models.recording import Recording, record


def signals(text, **more):
    """Signals of unit 1 from names; ``more`` gives defaults."""
    return Signals([Signal(n, "1", f"test signal {n}", default=more.get(n)) for n in text.split()])


def state_space(name, names, rates, outputs):
    """A StateSpace without algebraic unknowns; rates(x, u, theta) and outputs(x, u, theta)."""
    X, U, T, Y = (signals(n) for n in names)
    x, u, t = ca.SX.sym("x", len(X)), ca.SX.sym("u", len(U)), ca.SX.sym("t", len(T))
    z, none = ca.SX.sym("z", 0), Signals()
    ode = ca.vertcat(*rates(x, u, t))
    return StateSpace.of(
        name,
        (X, none, U, T, Y),
        (x, z, u, t),
        dae=(ode, ca.SX(0, 1)),
        f=ode,
        g=ca.vertcat(*outputs(x, u, t)),
        z=ca.SX(0, 1),
    )


def constant_velocity():
    """Position and velocity, driven by a measured acceleration; linear."""
    return state_space(
        "cv",
        ("s v", "a", "c", "place speed push"),
        lambda x, u, p: (x[1], u[0] - 0.3 * x[1] + p[0]),
        lambda x, u, p: (x[0], 0.5 * x[1] + 0.1 * x[0], u[0] - 0.3 * x[1] + p[0]),
    )


def oscillator():
    """A pendulum with friction and measured torque; angle and acceleration are measured."""
    return state_space(
        "pendulum",
        ("q r", "tau", "k d", "angle accel"),
        lambda x, u, p: (x[1], u[0] - p[0] * ca.sin(x[0]) - p[1] * x[1]),
        lambda x, u, p: (ca.sin(x[0]) + x[0], u[0] - p[0] * ca.sin(x[0]) - p[1] * x[1]),
    )


def linear(A, B, G, C, D, walk, *, name="linear"):
    """x1 = A x + B u + G w, y = C x + D w as a filter's model; dt only scales the walk."""
    A, B, G, C, D = (np.atleast_2d(np.asarray(M, float)) for M in (A, B, G, C, D))
    nx, nu, nw, ny = A.shape[0], B.shape[1], G.shape[1], C.shape[0]
    x, u, p, w = (ca.SX.sym(n, k) for n, k in (("x", nx), ("u", nu), ("p", 0), ("w", nw)))
    dt = ca.SX.sym("dt")
    f = ca.DM(A) @ x + ca.DM(B) @ u + ca.DM(G) @ w
    h = ca.DM(C) @ x + ca.DM(D) @ w
    return FilterModel(
        name,
        *(named(c, k) for c, k in (("x", nx), ("u", nu), ("p", 0), ("w", nw), ("y", ny))),
        transition=ca.Function(f"{name}_f", [x, u, p, w, dt], [f, ca.SX(0)]),
        output=ca.Function(f"{name}_g", [x, u, p, w], [h, ca.SX(0)]),
        walk=np.asarray(walk, float),
        lower=np.full(nx, -np.inf),
        upper=np.full(nx, np.inf),
    )


def named(prefix, n):
    """Signals of unit 1: x0, x1, ..."""
    return signals(" ".join(f"{prefix}{i}" for i in range(n)))


def model_of(f, g, p=(), *, nx=1, nu=0, nw=0, ny=1, walk=None, lower=None, upper=None):
    """A model from Python functions f(x, u, p, w, dt) and g(x, u, p, w); states x0, x1, ..."""
    theta = Signals([Signal(n, "1", "", 0.0) for n in p])
    x, u, q = ca.MX.sym("x", nx), ca.MX.sym("u", nu), ca.MX.sym("p", len(theta))
    w, dt = ca.MX.sym("w", nw), ca.MX.sym("dt")
    return FilterModel(
        "toy", named("x", nx), named("u", nu), theta, named("w", nw), named("y", ny),
        ca.Function("f", [x, u, q, w, dt], [f(x, u, q, w, dt), 0]),
        ca.Function("g", [x, u, q, w], [g(x, u, q, w), 0]),
        np.zeros(nx) if walk is None else np.array(walk, float),
        np.full(nx, -np.inf) if lower is None else np.array(lower, float),
        np.full(nx, np.inf) if upper is None else np.array(upper, float),
    )  # fmt: skip


def random_linear(seed, nx=3, nu=1, nw=2, ny=3):
    """A stable random linear model with noise w that output and transition share, and its parts."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((nx, nx))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    B, G = rng.standard_normal((nx, nu)), 0.3 * rng.standard_normal((nx, nw))
    C, D = rng.standard_normal((ny, nx)), 0.5 * rng.standard_normal((ny, nw))
    walk = rng.uniform(0.1, 0.4, nx)
    return linear(A, B, G, C, D, walk, name=f"linear{seed}"), (A, B, G, C, D)


def gappy(seed, model, K, *, missing=0.4, silent=(), p=()):
    """A recording of noise at irregular instants, with gaps, and sensors that never speak."""
    rng = np.random.default_rng(seed)
    _, nu, _, _, ny = model.sizes
    t = np.cumsum(rng.uniform(0.02, 0.5, K))
    y = rng.standard_normal((ny, K))
    y[rng.random((ny, K)) < missing] = np.nan
    y[list(silent)] = np.nan
    variance = rng.uniform(0.05, 0.5, (ny, K))
    return Recording(t, rng.standard_normal((nu, K)), y, variance, np.array(p, float))


def random_belief(seed, model):
    """A correlated prior."""
    rng = np.random.default_rng(seed)
    n = len(model.x)
    M = rng.standard_normal((n, n))
    return Belief(model.x, rng.standard_normal(n), M @ M.T + 0.3 * np.eye(n))


@dataclass
class ByHand:
    """What a Kalman filter written out knows: filtered and predicted beliefs, and likelihood."""

    mean: np.ndarray
    cov: np.ndarray
    mean_pred: np.ndarray
    cov_pred: np.ndarray
    nis: np.ndarray
    loglik: float


def kalman_by_hand(parts, walk, prior, data):
    """The Kalman filter for correlated process and measurement noise, covariance form.

    Anderson and Moore (1979), Optimal Filtering, section 5.5; Simon (2006), Optimal State
    Estimation, section 7.1.  ``parts`` are (A, B, G, C, D), or a function of dt that gives them.
    """
    K, n = data.size, prior.mean.size
    out = ByHand(np.empty((n, K)), np.empty((K, n, n)), np.empty((n, K)), np.empty((K, n, n)),
                 np.zeros(K), 0.0)  # fmt: skip
    m, P = prior.mean, prior.cov
    for k in range(K):
        A, B, G, C, D = parts(data.dt[k]) if callable(parts) else parts
        out.mean_pred[:, k], out.cov_pred[k] = m, P
        i = np.flatnonzero(~np.isnan(data.y[:, k]))
        C, D = C[i], D[i]
        S = C @ P @ C.T + D @ D.T + np.diag(data.variance[i, k])
        e = data.y[i, k] - C @ m
        SI = np.linalg.inv(S)
        out.mean[:, k], out.cov[k] = m + P @ C.T @ SI @ e, P - P @ C.T @ SI @ C @ P
        out.nis[k] = e @ SI @ e
        out.loglik -= 0.5 * (out.nis[k] + np.linalg.slogdet(2 * np.pi * S)[1])
        # the sample tells something of the noise that drives the state: covariance M
        M = A @ P @ C.T + G @ D.T
        m = A @ m + B @ data.u[:, k] + M @ SI @ e
        Q = G @ G.T + np.diag(walk**2) * data.dt[k]
        P = A @ P @ A.T + Q - M @ SI @ M.T
    return out


def batch_by_hand(parts, walk, prior, data):
    """Means (nx, K) and covariances of all states given all samples, by weighted least squares.

    Unknown are the first state and all noises; each has one row of the whitened system (prior or
    unit variance), each sample one more.
    """
    K, n = data.size, prior.mean.size
    nw = (parts(0.0) if callable(parts) else parts)[2].shape[1]
    size = n + K * (nw + n)
    # x(k) = offset + T z for the stacked unknowns z = (x0, w0, xi0, w1, ...)
    T, offset = np.zeros((K, n, size)), np.zeros((K, n))
    T[0, :, :n] = np.eye(n)
    rows, right = [], []
    L = np.linalg.inv(np.linalg.cholesky(prior.cov))
    rows.append(np.hstack([L, np.zeros((n, size - n))]))
    right.append(L @ prior.mean)
    rows.append(np.hstack([np.zeros((size - n, n)), np.eye(size - n)]))
    right.append(np.zeros(size - n))
    for k in range(K):
        A, B, G, C, D = parts(data.dt[k]) if callable(parts) else parts
        at = n + k * (nw + n)
        for i in np.flatnonzero(~np.isnan(data.y[:, k])):
            row = C[i] @ T[k]
            row[at : at + nw] += D[i]
            s = np.sqrt(data.variance[i, k])
            rows.append(row[None] / s)
            right.append([(data.y[i, k] - C[i] @ offset[k]) / s])
        if k + 1 < K:
            T[k + 1] = A @ T[k]
            T[k + 1][:, at : at + nw] += G
            T[k + 1][:, at + nw : at + nw + n] += np.diag(walk) * np.sqrt(data.dt[k])
            offset[k + 1] = A @ offset[k] + B @ data.u[:, k]
    Qr, Rr = np.linalg.qr(np.vstack(rows))
    z = np.linalg.solve(Rr, Qr.T @ np.concatenate(right))
    half = np.linalg.inv(Rr)
    mean = np.array([T[k] @ z + offset[k] for k in range(K)]).T
    cov = np.array([(T[k] @ half) @ (T[k] @ half).T for k in range(K)])
    return mean, cov


def cv_parts(dt):
    """(A, B, G, C, D) of discretise(constant_velocity(), method="rk4") with noisy a and state c.

    States s, v, c; RK4 of a linear model is the exponential's series up to the fourth power.
    """
    M = np.zeros((4, 4))  # s, v, c, a
    M[0, 1] = 1
    M[1] = [0, -0.3, 1, 1]
    E, term = np.eye(4), np.eye(4)
    for k in range(1, 5):
        term = term @ M * dt / k
        E = E + term
    C = np.array([[1, 0, 0], [0.1, 0.5, 0]])
    return E[:3, :3], E[:3, 3:], -CV_SIGMA * E[:3, 3:], C, np.zeros((2, 1))


CV_SIGMA = 0.2


def cv_model(walk=0.05):
    """The model of :func:`cv_parts`."""
    m = discretise(constant_velocity(), method="rk4", walk={"s": 0.01, "v": 0.1})
    m = measure(m, ["place", "speed"])
    return augment(noisy_inputs(m, {"a": CV_SIGMA}), {"c": Unknown(walk=walk)})


def pendulum(**options):
    """The oscillator with noisy torque (in output and transition), k estimated, as a model."""
    m = discretise(oscillator(), method="midpoint", walk={"q": 0.01, "r": 0.1})
    m = noisy_inputs(m, {"tau": 0.3})
    return augment(m, {"k": Unknown(walk=0.1)} | options)


def pendulum_data(model, K=60, seed=3, **p):
    """Samples of a swinging pendulum at irregular instants, the acceleration half as often."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.02, 0.08, K))
    q = np.cos(2.2 * t)
    return record(
        model,
        outputs={"angle": (t, np.sin(q) + q + 0.1 * rng.standard_normal(K)),
                 "accel": (t[::2], -5 * np.sin(q[::2]) + 0.5 * rng.standard_normal(t[::2].size))},
        sigma={"angle": 0.1, "accel": 0.5},
        inputs={"tau": (t, 0.3 * rng.standard_normal(K))},
        p={"d": 0.1} | p,
    )  # fmt: skip


def with_root_finder(model):
    """The same model with its first output found by a root finder: no scalar operations."""
    z, a = ca.SX.sym("z"), ca.SX.sym("a")
    root = ca.rootfinder("root", "fast_newton", ca.Function("r", [z, a], [z + z**3 - a - a**3]))
    s = model.symbols()
    y, check = model.output(*s[:4])
    y = ca.vertcat(root(y[0] + 0.1, y[0]), y[1:])
    return dataclasses.replace(model, output=ca.Function("g_root", [*s[:4]], [y, check]))


def stateless():
    """An output and nothing else."""
    x, u, p, w, dt = (ca.SX.sym(n, k) for n, k in zip("xupwd", (0, 0, 0, 0, 1), strict=True))
    none = Signals()
    return FilterModel(
        "empty",
        *(none, none, none, none, signals("y")),
        transition=ca.Function("f", [x, u, p, w, dt], [ca.SX(0, 1), 0]),
        output=ca.Function("g", [x, u, p, w], [ca.SX(1.0), 0]),
        walk=np.zeros(0),
        lower=np.zeros(0),
        upper=np.zeros(0),
    )


def most_probable_path(model, prior, data, **options):
    """States (nx, K) that SciPy's least_squares finds from all samples and noises at once.

    The unknowns are errors of the start and noises of every step, in standard deviations; the
    model's only noise w and the walks of its states.  ``options`` go to ``least_squares``.
    """
    nx, K = len(model.x), data.size
    n = nx + len(model.w)

    def path(z):
        x, xs = prior.mean + prior.sigma * z[:nx], []
        noises = z[nx:].reshape(K, n)
        for k in range(K):
            xs.append(x)
            x1 = model.transition(x, data.u[:, k], data.p, noises[k, nx:], data.dt[k])[0]
            x = np.array(x1).ravel() + np.sqrt(data.dt[k]) * model.walk * noises[k, :nx]
        return np.array(xs), noises

    def residual(z):
        xs, noises = path(z)
        r = [z]
        for k in range(K):
            y = np.array(model.output(xs[k], data.u[:, k], data.p, noises[k, nx:])[0]).ravel()
            e = (data.y[:, k] - y) / np.sqrt(data.variance[:, k])
            r.append(e[~np.isnan(data.y[:, k])])
        return np.concatenate(r)

    return path(least_squares(residual, np.zeros(nx + n * K), **options).x)[0].T
