"""Linear models, where everything is exact: every estimator against a Kalman filter by hand.

A random stable system with noise that output and transition share, irregular instants and missing
samples is drawn for each seed.  Reference are the Kalman filter for correlated noise in covariance
form (Anderson and Moore 1979, Optimal Filtering, section 5.5) and one weighted least-squares
problem of all states and noises; both are written out here and share no code with the estimators.
filterpy, which knows neither shared noise nor a sample with some sensors missing, gets systems
without them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import casadi as ca
import numpy as np
import scipy.linalg

from apu_casadi.core.errors import EstimationError
from apu_casadi.core.sharing import once
from apu_casadi.core.signals import Signal, Signals
from estimators.batch.mhe import HorizonEstimator
from estimators.batch.smoother import rts_smoother
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step, extended_kalman_filter
from estimators.filters.filterpy_adapter import filterpy_ekf, filterpy_ukf, run_filterpy
from estimators.filters.ukf import ukf_step, unscented_kalman_filter
from estimators.models.filtermodel import FilterModel
from estimators.models.recording import Recording
from scenarios.studies.registration import Claim, Results, Study, Tell

__all__ = ["STUDY", "correctness", "linear_model"]

NX, NU, NW, NY = 3, 1, 2, 3
SAMPLES = 40
MISSING = 0.3  # share of the samples
HORIZON = 8  # of the moving-horizon estimator
FEW = 10  # one seed in so many also runs what is slow: moving horizon and filterpy
WALK = (0.1, 0.2, 0.3)  # 1/sqrt(s)
GOAL = 1e-9


def _filters() -> list[ca.Function]:
    return [f(linear_model()).function for f in (ekf_step, ukf_step)]


STUDY = Study(
    "correctness",
    order=10,
    title="Correctness on linear models",
    goal="On linear models EKF, UKF, moving horizon and smoother equal the Kalman filter and "
    "batch least squares to 1e-9; agreement with filterpy.",
    filters=_filters,
    text="""
@intro
On linear models everything is exact. Random stable systems of three states with noise that output
and transition share, irregular instants and 30 % of the samples missing go through every estimator,
and through a Kalman filter and a least-squares problem of all states and noises that are written
out beside them.

@largest
1 | {what} | <= {goal:.0e} | {largest:.0e} | largest difference | {seeds:d} |

@ours
EKF, iterated EKF, UKF, moving horizon and smoother against Kalman filter and batch least squares

@peers
EKF and UKF against filterpy's

@table
compared | systems | largest difference
---
{name} | {seeds} | {largest:.1e}

@before
Largest difference of any mean or covariance over 1 + its size:

@after
The tests say more: `tests/test_ekf.py`, `test_ukf.py`, `test_mhe.py`, `test_smoother.py`,
`test_filterpy_adapter.py` compare predictions, likelihoods and innovations as well, with silent
sensors, irregular instants, singular priors and considered states.
""",
)


@STUDY.part("linear", start=5, each=0.03)
def linear(n: int, seed0: int, tell: Tell) -> dict[str, Any]:
    """Compare all estimators on n random systems."""
    return correctness(n, seed0, progress=tell)


@STUDY.claims
def claims(r: Results) -> list[Claim]:
    """Claim the largest differences, of our own estimators and of filterpy's."""
    if "linear" not in r:
        return []
    c, out = r["linear"], []
    for kind in ("ours", "peers"):
        rows = [x for x in c["rows"] if ("filterpy" in x["name"]) == (kind == "peers")]
        if rows:
            worst = max(x["largest"] for x in rows)
            values = {"goal": GOAL, "largest": worst, "seeds": c["seeds"]}
            what = STUDY.template.text(kind)
            out.append(STUDY.claim("largest", worst <= GOAL, what=what, **values))
    return out


@STUDY.section
def section(r: Results) -> list[str]:
    """Show all comparisons."""
    if "linear" not in r:
        return []
    t = STUDY.template
    return [t.text("before"), t.table("table", r["linear"]["rows"]), t.text("after")]


@once
def linear_model(*, shared: bool = True) -> FilterModel:
    """x1 = A x + B u + G w, y = C x + D w; the matrices are parameters, so it is built once.

    ``shared`` False: without D w.
    """

    def named(letter: str, n: int) -> Signals:
        return Signals([Signal(f"{letter}{i}", "1", f"{letter} {i} of a test") for i in range(n)])

    shapes = ((NX, NX), (NX, NU), (NX, NW), (NY, NX), (NY, NW))
    P = named("p", sum(a * b for a, b in shapes))
    x, u, p, w = (ca.SX.sym(n, k) for n, k in (("x", NX), ("u", NU), ("p", len(P)), ("w", NW)))
    dt, parts, at = ca.SX.sym("dt"), [], 0
    for a, b in shapes:
        parts.append(ca.reshape(p[at : at + a * b], a, b))
        at += a * b
    A, B, G, C, D = parts
    free = np.full(NX, np.inf)
    return FilterModel(
        "linear_shared" if shared else "linear_plain",
        *(named("x", NX), named("u", NU), P, named("w", NW), named("y", NY)),
        transition=ca.Function("f", [x, u, p, w, dt], [A @ x + B @ u + G @ w, ca.SX(0)]),
        output=ca.Function("g", [x, u, p, w], [C @ x + (D @ w if shared else 0), ca.SX(0)]),
        walk=np.array(WALK),
        lower=-free,
        upper=free,
    )


Parts = tuple[np.ndarray, ...]


def _drawn(seed: int, *, plain: bool) -> tuple[Parts, Belief, Recording]:
    """Draw a system, a prior and a recording; ``plain``: no shared noise, nothing missing."""
    rng = np.random.default_rng([seed, int(plain)])
    A = rng.standard_normal((NX, NX))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    B, G = rng.standard_normal((NX, NU)), 0.3 * rng.standard_normal((NX, NW))
    C, D = rng.standard_normal((NY, NX)), 0.5 * rng.standard_normal((NY, NW))
    y = rng.standard_normal((NY, SAMPLES))
    if plain:
        D = 0 * D
    else:
        y[rng.random(y.shape) < MISSING] = np.nan
    M = rng.standard_normal((NX, NX))
    prior = Belief(linear_model().x, rng.standard_normal(NX), M @ M.T + 0.3 * np.eye(NX))
    t, u = np.cumsum(rng.uniform(0.02, 0.5, SAMPLES)), rng.standard_normal((NU, SAMPLES))
    p = np.concatenate([m.ravel("F") for m in (A, B, G, C, D)])
    data = Recording(t, u, y, rng.uniform(0.05, 0.5, y.shape), p)
    return (A, B, G, C, D), prior, data


def _kalman(parts: Parts, prior: Belief, data: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Filtered means (NX, K) and covariances (K, NX, NX) by the covariance form.

    State and noise together; Joseph's update, since the short form P - P C' S^-1 C P loses digits
    where a system that is nearly unobserved has grown (2e-9 on one of 500 systems).
    """
    A, B, G, C, D = parts
    m, P, Q = prior.mean, prior.cov, np.diag(np.square(WALK))
    mean, cov = np.empty((NX, data.size)), np.empty((data.size, NX, NX))
    nw = G.shape[1]
    F = np.hstack([A, G])
    for k in range(data.size):
        i = np.flatnonzero(~np.isnan(data.y[:, k]))
        H, R = np.hstack([C[i], D[i]]), np.diag(data.variance[i, k])
        both = scipy.linalg.block_diag(P, np.eye(nw))
        gain = np.linalg.solve(H @ both @ H.T + R, H @ both).T
        at = np.append(m, np.zeros(nw)) + gain @ (data.y[i, k] - C[i] @ m)
        rest = np.eye(NX + nw) - gain @ H
        both = rest @ both @ rest.T + gain @ R @ gain.T
        mean[:, k], cov[k] = at[:NX], both[:NX, :NX]
        m, P = F @ at + B @ data.u[:, k], F @ both @ F.T + Q * data.dt[k]
    return mean, cov


def _batch(parts: Parts, prior: Belief, data: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Means and covariances of all states given all samples: one whitened least-squares problem."""
    A, B, G, C, D = parts
    K = data.size
    each = NW + NX
    size = NX + K * each
    T, b = np.zeros((K, NX, size)), np.zeros((K, NX))  # x(k) = T(k) z + b(k)
    T[0, :, :NX] = np.eye(NX)
    white = np.linalg.inv(np.linalg.cholesky(prior.cov))
    rows = [np.eye(size)]
    rows[0][:NX, :NX] = white
    right = [np.concatenate([white @ prior.mean, np.zeros(size - NX)])]
    for k in range(K):
        at = NX + k * each
        i = np.flatnonzero(~np.isnan(data.y[:, k]))
        row = C[i] @ T[k]
        row[:, at : at + NW] += D[i]
        s = np.sqrt(data.variance[i, k])
        rows.append(row / s[:, None])
        right.append((data.y[i, k] - C[i] @ b[k]) / s)
        if k + 1 < K:
            T[k + 1] = A @ T[k]
            T[k + 1][:, at : at + NW] += G
            T[k + 1][:, at + NW : at + each] += np.diag(WALK) * np.sqrt(data.dt[k])
            b[k + 1] = A @ b[k] + B @ data.u[:, k]
    q, r = np.linalg.qr(np.vstack(rows))
    z = np.linalg.solve(r, q.T @ np.concatenate(right))
    half = T @ np.linalg.inv(r)
    return (T @ z + b).T, half @ half.transpose(0, 2, 1)


def _apart(a: Any, b: Any) -> float:
    """Largest difference of means or covariances, over 1 + their size."""
    return max(float((np.abs(x - y) / (1 + np.abs(y))).max()) for x, y in zip(a, b, strict=True))


def correctness(
    n_seeds: int = 500,
    seed0: int = 1000,
    *,
    backend: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Return the largest differences between each estimator and the reference, over random systems.

    Args:
        n_seeds, seed0: seeds seed0 ... seed0 + n_seeds - 1; every tenth, and at least one, also
            goes through the moving-horizon estimator and filterpy.
        backend: see :func:`apu_casadi.core.backend.compiled`.
        progress: called with (done, total) after each seed.

    Returns:
        ``rows``: for each comparison its ``name``, ``seeds`` and ``largest``, the largest
        difference of any mean or covariance over 1 + its size; ``filterpy``: whether it is
        installed.

    Raises:
        EstimationError: no seed.
    """
    if n_seeds < 1:
        raise EstimationError(f"n_seeds must be >= 1, got {n_seeds}")
    model, began = linear_model(), time.perf_counter()
    horizon = HorizonEstimator(model, HORIZON, backend=backend)
    peer = find_spec("filterpy") is not None
    largest: dict[str, float] = {}
    count: dict[str, int] = {}

    def seen(name: str, a: Any, b: Any) -> None:
        largest[name] = max(largest.get(name, 0.0), _apart(a, b))
        count[name] = count.get(name, 0) + 1

    for k, seed in enumerate(range(seed0, seed0 + n_seeds)):
        parts, prior, data = _drawn(seed, plain=False)
        kalman, batch = _kalman(parts, prior, data), _batch(parts, prior, data)
        last = (kalman[0][:, -1], kalman[1][-1])
        end = (batch[0][:, -1], batch[1][-1])
        seen("Kalman filter and batch least squares, last instant", last, end)
        options: dict[str, Any] = {"full": True, "backend": backend}
        r = extended_kalman_filter(model, prior, data, **options)
        seen("EKF and Kalman filter", (r.mean, r.cov), kalman)
        s = rts_smoother(r)
        seen("smoother and batch least squares", (s.mean, s.cov), batch)
        r = extended_kalman_filter(model, prior, data, iterations=2, **options)
        seen("iterated EKF and Kalman filter", (r.mean, r.cov), kalman)
        for points in ("cubature", "scaled"):
            r = unscented_kalman_filter(model, prior, data, points=points, **options)
            seen(f"UKF, {points} points, and Kalman filter", (r.mean, r.cov), kalman)
        if k % FEW == 0:
            r = horizon.run(prior, data, full=True)
            seen(f"moving horizon of {HORIZON} and Kalman filter", (r.mean, r.cov), kalman)
            if peer:
                _, prior, data = _drawn(seed, plain=True)
                _peer(linear_model(shared=False), prior, data, options, seen)
        if progress is not None:
            progress(k + 1, n_seeds)
    rows = [{"name": n, "seeds": count[n], "largest": v} for n, v in largest.items()]
    about = {"seeds": [seed0, seed0 + n_seeds - 1], "n_seeds": n_seeds, "filterpy": peer}
    return {**about, "rows": rows, "seconds": time.perf_counter() - began}


def _peer(
    model: FilterModel,
    prior: Belief,
    data: Recording,
    options: dict[str, Any],
    seen: Callable[[str, Any, Any], None],
) -> None:
    """Compare EKF and UKF with filterpy's."""
    p = dict(zip(model.p.names, data.p, strict=True))
    sigma = dict.fromkeys(model.y.names, 1.0)  # the recording's variances are used
    r = extended_kalman_filter(model, prior, data, **options)
    theirs = run_filterpy(filterpy_ekf(model, prior, sigma, p=p), data)
    seen("EKF and filterpy's", (r.mean, r.cov), theirs)
    for points in ("cubature", "scaled"):
        r = unscented_kalman_filter(model, prior, data, points=points, **options)
        kf = filterpy_ukf(model, prior, sigma, p=p, points=points)
        seen(f"UKF, {points} points, and filterpy's", (r.mean, r.cov), run_filterpy(kf, data))
