"""Simulated windows: the governed engine's own equations, sensors with gain errors, noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from apu_casadi.core.backend import backend_in_use, compiled, mapped
from apu_casadi.core.errors import EstimationError
from apu_casadi.core.sharing import kept
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.gaspath.steady.trimming import Limits, trim_gas_generator
from apu_casadi.unit.control import Governor, GovernorParameters
from estimators.apu.isolation.problem import (
    CLASSES,
    DEFAULT,
    DT,
    GAINS,
    HEALTH,
    OUTPUTS,
    P_RATED,
    Protocol,
    severity_of_loss,
)

__all__ = ["Windows", "simulate_windows", "windows_of_engines"]

SUBSTEPS = 4  # of the truth, in one sample


@dataclass(frozen=True, eq=False)
class Windows:
    """Simulated windows, as they are measured.

    Args:
        truth: class of each, (n,).
        sizes: by fault name, for each.
        onset: sample of the onset, (n,).
        reading: N, P3, T3, T5, h, Wf, PW, (7, n, K).
        ambient: altitude, Mach, dT_isa, war, known, (4, n).
    """

    truth: np.ndarray
    sizes: list[dict[str, float]]
    onset: np.ndarray
    reading: np.ndarray
    ambient: np.ndarray


@kept
def _engine(gg: GasGenerator, _backend: str) -> Callable[..., tuple[np.ndarray, ...]]:
    """The engine for many windows at once: (z0, N, u, theta) -> (dN/dt, P3, T3, T5, z, check)."""
    c = gg.cycle
    x, z0, u, theta = c.symbols()
    z = c.solve(z0, x, u, theta)
    ode, alg, y = c.equations(x, z, u, theta)
    rows = gg.Y.indices(("P3", "T3", "T5"))
    fun = ca.Function("isolation_truth", [z0, x, u, theta], [ode, y[rows], z, ca.norm_1(alg)])
    return mapped(compiled(fun), 1, chunk=256)


def simulate_windows(
    labels: Sequence[int],
    seeds: Sequence[int],
    protocol: Protocol = DEFAULT,
    gg: GasGenerator | None = None,
    governor: Governor | None = None,
) -> Windows:
    """Simulate windows of the governed unit, one for each label and seed.

    The engine's own equations, by Heun's rule with steps of a quarter of a sample; the governor
    holds the true speed.  The classifiers go by whole samples, and know fuel flow, power and speed
    only as measured.

    Args:
        labels: positions in :data:`CLASSES`.
        seeds: one for each window; all that is random in it follows from its seed and label.
        protocol, gg, governor: see :class:`Protocol`; the paper's unit by default.

    Raises:
        EstimationError: an engine left the region where its equations can be solved.
    """
    gg = GasGenerator() if gg is None else gg
    gov = GovernorParameters() if governor is None else governor
    n, K, pr = len(labels), protocol.size, protocol
    N_ref = gg.parameters.N
    theta = np.ones((2, len(HEALTH), n))  # before and after the onset
    u0, x0, z0 = np.empty((len(gg.U), n)), np.full((1, n), N_ref), np.empty((len(gg.z), n))
    gains = np.zeros((2, len(GAINS), n))
    loss, h_0, onset = np.zeros(n), np.empty(n), np.empty(n, int)
    load, white = np.empty((n, K)), np.empty((7, n, K))
    sizes: list[dict[str, float]] = []
    for i, (label, seed) in enumerate(zip(labels, seeds, strict=True)):
        rng = np.random.default_rng([5, int(seed), int(label)])
        s = CLASSES[label].draw(rng)
        sizes.append(s)
        onset[i] = rng.integers(pr.first, pr.last + 1)
        theta[:, :, i] += pr.baseline * pr.wear * rng.standard_normal(len(HEALTH))
        gains[:, :, i] += [pr.baseline * pr.sensors[g].gain * rng.standard_normal() for g in GAINS]
        h_0[i] = pr.baseline * pr.h_offset * rng.standard_normal()
        for name, size in s.items():
            if name in HEALTH:
                theta[1, HEALTH.index(name), i] += size
            elif name == "loss":
                loss[i] = size
            else:
                gains[1, GAINS.index(name.removeprefix("gain_")), i] += size
        # demanded power: a level, a slow wander of 0.5 %, and a step of up to 5 % in half of them
        level, dT = rng.uniform(200e3, 420e3), rng.uniform(-15.0, 15.0)
        wander = np.empty(K)
        value, keep = 0.0, math.exp(-DT / 1.0)
        for k, xi in enumerate(rng.standard_normal(K)):
            value = keep * value + math.sqrt(1 - keep**2) * xi
            wander[k] = 0.005 * value
        step = rng.uniform(-0.05, 0.05) * (rng.random() < 0.5)
        at = rng.integers(0, K)
        load[i] = level * (1 + wander + step * (np.arange(K) >= at))
        white[:, i, :] = rng.standard_normal((7, K))
        point = trim_gas_generator(
            gg, {"N": N_ref, "PW": load[i, 0]},
            theta=dict(zip(HEALTH, theta[0, :, i], strict=True)),
            limits=Limits(T4_max=math.inf), dT_isa=dT,
        )  # fmt: skip
        u0[:, i], z0[:, i] = point.u, point.z
    engine = _engine(gg, backend_in_use())
    i_Wf, i_PW = gg.U.index("Wf"), gg.U.index("PW")
    N, z, u = x0.copy(), z0, u0.copy()
    I = np.array([np.broadcast_to(x, n) for x in gov.start(u0[i_Wf])])  # governor's states
    reading = np.empty((7, n, K))
    worst = 0.0

    def rates(N: np.ndarray, I: np.ndarray, th: np.ndarray) -> tuple[np.ndarray, ...]:
        nonlocal z, worst
        u[i_Wf], moves = gov.law(N[0], N_ref, [*I])
        ode, y, z, check = engine(z, N, u, th)
        worst = max(worst, float(np.nan_to_num(check, nan=np.inf).max()))
        return ode, np.array(moves), y

    h = DT / SUBSTEPS
    for k in range(K):
        faulty = k >= onset
        th = np.where(faulty, theta[1], theta[0])
        g = np.where(faulty, gains[1], gains[0])
        lost = np.where(faulty, loss, 0.0)
        u[i_PW] = load[:, k] + P_RATED * lost
        for m in range(SUBSTEPS):
            dN, dI, y = rates(N, I, th)
            if m == 0:
                exact = [N[0], *y, h_0 + severity_of_loss() * lost, u[i_Wf], load[:, k]]
                for r, (name, v) in enumerate(zip((*OUTPUTS, "Wf", "PW"), exact, strict=True)):
                    if name == "h":
                        reading[r, :, k] = v + pr.noise * pr.h_noise * white[r, :, k]
                        continue
                    sigma = pr.noise * pr.sensors[name].noise
                    gain = g[GAINS.index(name)] if name in GAINS else 0.0
                    reading[r, :, k] = v * (1 + gain + sigma * white[r, :, k])
            dN2, dI2, _ = rates(N + h * dN, I + h * dI, th)
            N, I = N + h / 2 * (dN + dN2), I + h / 2 * (dI + dI2)
    if not worst <= RESIDUAL_TOL:
        raise EstimationError(f"isolation study: the engine's residual is {worst:.1e}")
    if not pr.electrical:
        reading[OUTPUTS.index("h")] = np.nan
    ambient = u0[gg.U.indices(AMBIENT)]
    return Windows(np.asarray(labels, int), sizes, onset, reading, ambient)


def windows_of_engines(
    labels: np.ndarray, seeds: np.ndarray, protocol: Protocol, truth: Sequence[GasGenerator]
) -> Windows:
    """Simulate windows of several engines, by turns of the seeds; see :func:`simulate_windows`."""
    if len(truth) == 1:
        return simulate_windows(labels.tolist(), seeds.tolist(), protocol, truth[0])
    n = labels.size
    out = Windows(
        labels, [{}] * n, np.empty(n, int), np.empty((7, n, protocol.size)), np.empty((4, n))
    )
    for k, gg in enumerate(truth):
        i = np.flatnonzero(seeds % len(truth) == k)
        if i.size:
            part = simulate_windows(labels[i].tolist(), seeds[i].tolist(), protocol, gg)
            out.onset[i], out.reading[:, i], out.ambient[:, i] = (
                part.onset, part.reading, part.ambient
            )  # fmt: skip
            for j, sizes in zip(i, part.sizes, strict=True):
                out.sizes[j] = sizes
    return out
