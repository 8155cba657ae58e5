"""Linear model of a generator about a periodic steady state: a fault, an unbalanced load.

On the rotor's axes the state x then is a function of the rotor angle theta, too,

    dx/dt = f(x, theta, u) - w_r dx/dtheta,

and at rest the periodic state (:mod:`apu_casadi.machine.periodic`).  Its harmonics are states as
its mean is (generalised averaging; Sanders et al., IEEE Trans. Power Electronics 6 (1991), 251).
Here they are those of the trigonometric polynomial through equally spaced angles; the model is
linearised at each of these, and the harmonics are eliminated as if they followed the mean at once.
What is left is of means over a turn: exact in steady derivatives at any severity, and for modes
that are slow against the ripple, of 400 and 800 Hz.

The mean of a ripple's square is in it, which the averaged generator
(:mod:`apu_casadi.unit.averaged`) leaves out: with the paper's fault, h = 2.4e-3, that is 60 % of
the fault's loss.
"""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.machine.generator import GeneratorPoint
from apu_casadi.machine.generatormodel import NOISE
from apu_casadi.machine.park import Abc, abc_to_qd0
from apu_casadi.unit.averaged import AXES, KEPT, current
from apu_casadi.unit.linearmodel import LinearModel

_NOISE = {s.name for s in NOISE}


def about_turn(point: GeneratorPoint) -> LinearModel:
    """Return the linear model about a steady state; also of a balanced one."""
    ss = point.ss
    X = Signals([s for s in ss.x if s.name != "theta_e"])
    U = Signals([s for s in ss.u if s.name not in _NOISE])
    Y = Signals([*(ss.y[n] for n in KEPT), *AXES])
    nx, nu, nt, ny = len(X), len(U), len(ss.theta), len(Y)
    states, slopes = _nodes(point, X)
    numbers = np.concatenate([point.theta, ss.numbers])
    made = _derivatives(ss.family, nt)
    found = [made(x, point.u, numbers) for x in states.T]
    rates, outputs = (np.array([v[i].full().ravel() for v in found]) for i in (0, 1))
    J = np.array([v[2].full() for v in found])  # (n, nx + ny, nx + nu + nt)
    J[:, :nx, nx + U.index("w_r")] -= slopes.T  # the angle turns faster
    w_r = point.u[ss.u.index("w_r")]
    M = _of_means(J[:, :, :nx], J[:, :, nx:], w_r, nx)
    y0 = np.append(outputs.mean(axis=0), 0.0)
    y0[-1] = float(current(*y0[[Y.index("i_q"), Y.index("i_d")]]))
    M = np.vstack([M, np.zeros(M.shape[1])])
    for n_axis in ("i_q", "i_d"):  # the magnitude of the mean current on the rotor's axes
        i = nx + Y.index(n_axis)
        M[-1] += M[i] * y0[Y.index(n_axis)] / (2.0 * y0[-1])
    assert M.shape == (nx + ny, nx + nu + nt)
    cut = (nx, nx + nu)
    (A, B_u, B_th), (C, D_u, D_th) = (np.split(m, cut, axis=1) for m in (M[:nx], M[nx:]))
    at = point.u[ss.u.indices(U.names)]
    x0 = states[ss.x.indices(X.names)].mean(axis=1)
    name, TH, there = f"periodic_{ss.name}", Signals(ss.theta), (x0, at, point.theta, y0)
    return LinearModel(name, X, U, TH, Y, A, B_u, B_th, C, D_u, D_th, *there, rates.mean(axis=0))


def _nodes(point: GeneratorPoint, X: Signals) -> tuple[np.ndarray, np.ndarray]:
    """Return states at an odd number of angles, and derivatives of those of X by the angle."""
    given, names = point.turn.x, point.ss.x
    rows, at, n = names.indices(X.names), names.index("theta_e"), given.shape[1] + 1
    F = np.fft.rfft(given[rows], axis=1) * (n / given.shape[1])
    states = np.zeros((len(names), n))
    states[rows] = np.fft.irfft(F, n, axis=1)
    states[at] = given[at, 0] + 2 * math.pi / n * np.arange(n)
    return states, states[rows] @ _derivative(n).T


def _derivative(n: int) -> np.ndarray:
    """Derivative by the angle of the trigonometric polynomial through n nodes, n odd."""
    k = np.arange(n // 2 + 1)[:, None]
    return np.asarray(np.fft.irfft(1j * k * np.fft.rfft(np.eye(n), axis=0), n, axis=0))


def _of_means(by_x: np.ndarray, by_rest: np.ndarray, w_r: float, nx: int) -> np.ndarray:
    """Return derivatives of mean rates and outputs by the mean state and by the rest.

    Args:
        by_x, by_rest: derivatives at n angles, shapes (n, nx + ny, nx) and (n, nx + ny, others).
    """
    n, rows, _ = by_x.shape
    # an orthonormal basis of functions of the angle, the constant one first
    Q = np.linalg.qr(np.column_stack([np.ones(n), np.eye(n)[:, 1:]]))[0]
    Q *= np.sign(Q[0, 0])
    all_x = np.einsum("ka,kij,kb->aibj", Q, by_x, Q, optimize=True)
    all_x[:, :nx] -= w_r * np.einsum("ab,ij->aibj", Q.T @ _derivative(n) @ Q, np.eye(nx))
    all_rest = np.einsum("ka,kij->aij", Q, by_rest) / math.sqrt(n)
    m = n - 1
    follow = all_x[1:, :nx, 1:].reshape(m * nx, m * nx)
    driven = np.concatenate([all_x[1:, :nx, 0], all_rest[1:, :nx]], axis=2)
    harmonics = -np.linalg.solve(follow, driven.reshape(m * nx, -1))
    direct = np.concatenate([all_x[0, :, 0], all_rest[0]], axis=1)
    made: np.ndarray = direct + all_x[0, :, 1:].reshape(rows, m * nx) @ harmonics
    return made


@kept
def _derivatives(family: StateSpace, n_theta: int) -> ca.Function:
    """(x, u, theta) -> rates, outputs and derivatives of both by x, u and n_theta of theta."""
    signals = zip("xut", (family.x, family.u, family.theta), strict=True)
    x, u, theta = (ca.SX.sym(n, len(s)) for n, s in signals)
    states = [i for i, n in enumerate(family.x.names) if n != "theta_e"]
    inputs = [i for i, n in enumerate(family.u.names) if n not in _NOISE]
    y, angle = family.y.unpack(family.g(x, u, theta)), x[family.x.index("theta_e")]
    axes: list[Any] = []
    for a in "vi":
        on = abc_to_qd0(angle, Abc(*(y[f"{a}_{k}"] for k in "abc")))
        axes += [on.q, on.d]
    f, g = family.f(x, u, theta)[states], ca.vertcat(*(y[n] for n in KEPT), *axes)
    by = ca.vertcat(x[states], u[inputs], theta[:n_theta])
    whole = ca.densify(ca.jacobian(ca.vertcat(f, g), by))
    return ca.Function("about_turn", [x, u, theta], [f, g, whole], {"cse": True})
