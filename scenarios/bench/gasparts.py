"""Gas generator and linear models: trims, decks, derivatives, linearisation."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from statistics import median
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from apu_casadi.core.backend import compiled
from apu_casadi.core.calling import Caller, available_threads
from apu_casadi.core.rootfinding import Newton
from apu_casadi.gaspath.conditions import DEFAULT_DAY
from apu_casadi.gaspath.steady.steadypoint import Status
from apu_casadi.gaspath.steady.trimbatch import performance_deck, trim_batch
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.averaged import joint_vectors
from apu_casadi.unit.linearisation import linearise_joint
from scenarios.bench.measuring import Row, Size, apu, part, timed
from scenarios.studies import trim_study

if TYPE_CHECKING:
    from apu_casadi.gaspath.gasgenerator import GasGenerator

DIFFERENCES = "central differences, relative to the largest entry of the row in nominal units"
CENTRAL = DIFFERENCES.replace("differences,", "differences of the plain equations,")


@part("trim", order=10)
def trim(size: Size) -> list[Row]:
    """Single trims one by one, cold, and a batch on one core."""

    gg = apu().gas_generator
    asked = trim_study.sample(gg, max(size.batch, size.trims), seed=2)
    fixed, theta = asked.pop("fixed"), asked.pop("theta")
    trim_study.run(400, gg=gg, n_threads=1)  # compile, load
    together = partial(trim_batch, gg, fixed, theta=theta, n_threads=1, **asked)
    wall, batch = timed(together, min(size.repeats, 3))
    solved = np.flatnonzero(batch.status == Status.SOLVED)
    residual = float(trim_study.recheck(gg, batch)[solved].max())
    times, differences, newton = [], [], []
    root = _plain_newton(gg)
    for k, i in enumerate(solved[: size.trims]):
        ambient = {n: float(v[i]) for n, v in asked.items()}
        health = {n: float(v[i]) for n, v in theta.items()}
        N, PW = float(fixed["N"]), float(fixed["PW"][i])
        t = time.perf_counter()
        point = trim_gas_generator(gg, {"N": N, "PW": PW}, theta=health, **ambient)
        times.append(time.perf_counter() - t)
        if k % 10 == 0:  # the slow one only for a tenth
            t = time.perf_counter()
            z, Wf, ok = root(N, PW, ambient, health)
            if ok:
                newton.append(time.perf_counter() - t)
                differences.append(
                    max(float(np.abs(z / point.z - 1).max()), abs(Wf / point["Wf"] - 1))
                )
    one = median(times)
    peer: dict[str, Any] = {"peer": "that Newton method", "ratio": median(newton) / one}
    text = f"relative, against a plain Newton method in Python ({len(differences)} points)"
    what, us = f"trim, batch of {size.batch} points, a point", 1e6 * wall / len(batch)
    plain = "largest residual of the plain equations"
    error = max(differences)
    return [
        Row("trim, one call from Python, cold", 1e3 * one, "ms", 1.0, error, 1e-8, text, **peer),
        Row(what, us, "us", 50.0, residual, 1e-9, plain),
    ]


def _plain_newton(gg: GasGenerator) -> Callable[..., tuple[np.ndarray, float, bool]]:
    """Newton's method in Python around the plain equations with CasADi's own derivatives."""

    n = len(gg.z)
    scale = np.append(gg.z.nominals, gg.design.values["Wf"])
    q, p = ca.MX.sym("q", n + 1), ca.MX.sym("p", 10)
    x, PW = p[0], p[1]
    z, Wf = q[:n], q[n]
    _, alg, y = gg.equations(x, z, ca.vertcat(Wf, PW, p[2:6]), p[6:])
    balance = y[gg.Y.index("P_acceleration")] / 5e5
    F = ca.Function("plain", [q, p], [ca.vertcat(alg, balance)])
    newton = Newton(F, scale=scale, lower=1e-3 * np.minimum(scale, 1.0), tol=1e-10)
    names = tuple(DEFAULT_DAY)

    def solve(
        N: float, PW: float, ambient: Mapping[str, float], health: Mapping[str, float]
    ) -> tuple[np.ndarray, float, bool]:
        air = [ambient.get(k, DEFAULT_DAY[k]) for k in names]
        given = np.array([N, PW, *air, *(health[k] for k in gg.THETA.names)])
        guess = gg.design.values["Wf"] * max(0.2, PW / 5e5)
        z0 = np.asarray(gg.similar(N, [guess, PW, *air])).ravel()
        r = newton(np.append(z0, guess), given)
        return r.x[:n], float(r.x[n]), r.success

    return solve


def deck_axes(size: Size) -> dict[str, Any]:
    """Return the axes of the deck: altitude, m, Mach, ISA deviation, K, and power, W."""
    ends = ((0.0, 12e3), (0.0, 0.8), (-30.0, 35.0), (0.0, 5e5))
    names = ("altitude", "Mach", "dT_isa", "PW")
    return {n: np.linspace(*e, k) for n, e, k in zip(names, ends, size.deck, strict=True)}


@part("deck", order=11)
def deck(size: Size) -> list[Row]:
    """A performance deck on all cores, two at most."""

    gg = apu().gas_generator
    threads = min(2, available_threads())
    axes = deck_axes(size)
    performance_deck(gg, altitude=[0.0], PW=np.linspace(0, 1e9, 400), n_threads=threads)
    wall, made = timed(lambda: performance_deck(gg, **axes, n_threads=threads), 1)
    points = math.prod(size.deck)
    rng = np.random.default_rng(0)
    at = tuple(rng.integers(0, k, min(2000, points)) for k in size.deck)
    given: dict[str, Any] = {n: a[i] for (n, a), i in zip(axes.items(), at, strict=True)}
    PW = given.pop("PW")
    again = trim_batch(gg, {"N": gg.parameters.N, "PW": PW}, n_threads=threads, **given)
    ok = again.status == Status.SOLVED
    same = np.array_equal(ok, made["status"].values[at] == Status.SOLVED)
    off = float(np.abs(made["T4"].values[at][ok] / again["T4"][ok] - 1).max(initial=0.0))
    residual = float(trim_study.recheck(gg, again)[ok].max(initial=0.0))
    unexplained = int((made["status"].values == Status.UNEXPLAINED).sum())
    share = 100 * float((made["status"].values == Status.SOLVED).mean())
    error = max(residual, off) if same and not unexplained else math.inf
    what = f"performance deck of {points} points ({share:.0f} % exist) on {threads} cores"
    text = f"residual of the plain equations at {at[0].size} of them; none unexplained"
    return [Row(what, wall, "s", 10.0, error, 1e-9, text)]


@part("derivatives", order=12)
def derivatives(size: Size) -> list[Row]:
    """F and g of the gas generator with Jacobians by state, inputs and health, compiled."""

    gg = apu().gas_generator
    cycle = gg.cycle
    x, z0, u, theta = cycle.symbols()
    z = cycle.solve(z0, x, u, theta)
    outs = cycle.sensitivities(x, z, u, theta)
    dense = [ca.densify(o) for o in (*outs, z)]
    F = ca.Function("f_g_jacobians", [x, z0, u, theta], dense)
    call = Caller(compiled(F), copy=False)
    point = trim_gas_generator(gg, {"N": gg.parameters.N, "PW": 4e5})
    rng = np.random.default_rng(0)
    w0 = np.concatenate([point.x, point.u, point.theta])
    spread = 1e-3 * np.concatenate([gg.X.nominals, gg.U.nominals, gg.THETA.nominals])
    spread[len(point.x) + 2] = 50.0  # m of altitude
    W = w0 + spread * np.abs(rng.standard_normal((200, w0.size)))
    W[:, len(point.x) + 5] = 0.0  # dry air
    nx, nu = len(point.x), len(point.u)
    parts = [(w[:nx], w[nx : nx + nu], w[nx + nu :]) for w in W]
    for a, b, c in parts[:20]:
        call(a, point.z, b, c)
    times = []
    for k in range(size.calls):
        a, b, c = parts[k % len(parts)]
        t = time.perf_counter()
        call(a, point.z, b, c)
        times.append(time.perf_counter() - t)
    error = 0.0
    smooth = [i for i, n in enumerate(gg.Y.names) if n not in ("off_c", "off_t", "residual")]
    for a, b, c in parts[:3]:
        xdot, _, xdot_w, y_w, _, _ = (np.array(v) for v in call(a, point.z, b, c))
        J = np.vstack([xdot_w.reshape(1, -1), y_w[smooth]])
        fd = _central(gg, np.concatenate([a, b, c]), point.z, smooth)
        scale = np.abs(J * spread).max(axis=1, keepdims=True) + 1e-300
        error = max(error, float((np.abs(J - fd) * spread / scale).max()))
        del xdot
    what = "f and g with Jacobians by state, inputs, health"
    return [Row(what, 1e6 * median(times), "us", 30.0, error, 1e-6, f"against {CENTRAL}")]


def _central(gg: GasGenerator, w: np.ndarray, z0: np.ndarray, rows: Sequence[int]) -> np.ndarray:
    """Jacobian of (xdot, y) by (x, u, theta) by central differences of order four."""
    h = 2e-4 * np.concatenate([gg.X.nominals, gg.U.nominals, gg.THETA.nominals])
    nx, nu = len(gg.X), len(gg.U)
    # the standard atmosphere, at sea level, has no kink within these steps
    h[nx + 2], h[nx + 3], h[nx + 4], h[nx + 5] = 2.0, 1e-3, 0.05, 1e-4

    def value(v: np.ndarray) -> np.ndarray:
        a, b, c = v[:nx], v[nx : nx + nu], v[nx + nu :]
        z = gg.solve(z0, a, b, c)
        ode, _, y = gg.equations(a, z, b, c)
        return np.concatenate([np.asarray(ode).ravel(), np.asarray(y).ravel()[list(rows)]])

    J = np.empty((1 + len(rows), w.size))
    for k in range(w.size):
        e = np.zeros(w.size)
        e[k] = h[k]
        near, far = value(w + e) - value(w - e), value(w + 2 * e) - value(w - 2 * e)
        J[:, k] = (8 * near - far) / (12 * h[k])
    return J


@part("linearisation", order=13)
def linearisation(size: Size) -> list[Row]:
    """The joint model's linearisation at a trim."""

    unit = apu()
    point = unit.steady_state(SeriesLoad.from_power(100e3))
    linearise_joint(unit, point)
    wall, model = timed(lambda: linearise_joint(unit, point), max(3, size.calls // 30))
    ss, x, u, theta = joint_vectors(unit, point)
    nominal = ss.x.nominals
    A = np.empty_like(model.A)
    for k in range(x.size):
        h = np.zeros(x.size)
        h[k] = 1e-4 * nominal[k]
        d = [np.asarray(ss.f(x + s * h, u, theta)).ravel() for s in (1, -1, 2, -2)]
        A[:, k] = (8 * (d[0] - d[1]) - (d[2] - d[3])) / (12 * h[k])
    scale = np.abs(model.A * nominal).max(axis=1, keepdims=True)
    error = float((np.abs(A - model.A) * nominal / scale).max())
    what, text = "linearisation of the joint model at a trim", f"state matrix against {DIFFERENCES}"
    return [Row(what, 1e3 * wall, "ms", 2.0, error, 1e-6, text)]
