"""Simulated windows: the governed engine's own equations, sensors with gain errors, noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from apu_casadi.core.backend import backend_in_use, compiled
from apu_casadi.core.calling import mapped
from apu_casadi.core.errors import EstimationError
from apu_casadi.core.measuring import measure
from apu_casadi.core.sharing import kept
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.gaspath.steady.steadypoint import Limits, OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.unit.control import Governor, GovernorParameters
from estimators.apu.isolation.problem import (
    CLASSES,
    DEFAULT,
    DT,
    GAINS,
    OUTPUTS,
    P_RATED,
    READ,
    Protocol,
    severity_of_loss,
)

__all__ = ["Windows", "simulate_windows", "windows_of_engines"]

SUBSTEPS = 4  # of the truth, in one sample
READINGS = (*OUTPUTS, "Wf", "PW")


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
    rows = gg.Y.indices(READ)
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
    drawn = [_draw(label, seed, protocol, gg) for label, seed in zip(labels, seeds, strict=True)]
    onset, load = (np.array([getattr(d, n) for d in drawn]) for n in ("onset", "load"))
    # last axis: windows
    theta, gains = (np.stack([getattr(d, n) for d in drawn], -1) for n in ("theta", "gains"))
    loss, h_0 = (np.array([getattr(d, n) for d in drawn]) for n in ("loss", "h_0"))
    u, z = (np.stack([getattr(d.start, n) for d in drawn], -1) for n in ("u", "z"))
    ambient = u[gg.U.indices(AMBIENT)]
    run = _Course(gg, GovernorParameters() if governor is None else governor, u, z)
    true = np.empty((len(READINGS), len(drawn), protocol.size))
    for k in range(protocol.size):
        faulty = k >= onset
        lost = np.where(faulty, loss, 0.0)
        h = h_0 + severity_of_loss() * lost
        seen = run.step(load[:, k] + P_RATED * lost, np.where(faulty, theta[1], theta[0]))
        true[:, :, k] = [*seen[:-1], h, seen[-1], load[:, k]]
    if not run.worst <= RESIDUAL_TOL:
        raise EstimationError(f"isolation study: the engine's residual is {run.worst:.1e}")
    later = np.arange(protocol.size) >= onset[:, None]
    reading = np.empty(true.shape)
    for r, (name, v) in enumerate(zip(READINGS, true, strict=True)):
        sigma = protocol.h_noise if name == "h" else protocol.sensors.sigma(name, v)
        g = gains[:, GAINS.index(name), :, None] if name in GAINS else np.zeros((2, 1, 1))
        white = np.array([d.white[r] for d in drawn])
        reading[r] = measure(v, protocol.noise * sigma, white, gain=np.where(later, g[1], g[0]))
    if not protocol.electrical:
        reading[READINGS.index("h")] = np.nan
    return Windows(np.asarray(labels, int), [d.sizes for d in drawn], onset, reading, ambient)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """What is random in one window.

    Args:
        sizes: of the faults, by name.
        onset: sample.
        theta, gains: health factors and gain errors before and after, (2, n).
        loss, h_0: loss by a short circuit, and offset of h.
        load: demanded power, W, (K,).
        white: normalised errors of the readings, (7, K).
        start: the steady point that the window begins with.
    """

    sizes: dict[str, float]
    onset: int
    theta: np.ndarray
    gains: np.ndarray
    loss: float
    h_0: float
    load: np.ndarray
    white: np.ndarray
    start: OperatingPoint


def _draw(label: int, seed: int, pr: Protocol, gg: GasGenerator) -> _Drawn:
    rng = np.random.default_rng([5, int(seed), int(label)])
    K, sizes = pr.size, CLASSES[label].draw(rng)
    onset = int(rng.integers(pr.first, pr.last + 1))
    theta = np.ones((2, len(HEALTH))) + pr.baseline * pr.wear * rng.standard_normal(len(HEALTH))
    gains = pr.baseline * np.array([list(pr.sensors.draw_gains(rng, GAINS).values())] * 2)
    h_0 = pr.baseline * pr.h_offset * rng.standard_normal()
    for name, size in sizes.items():
        if name in HEALTH:
            theta[1, HEALTH.index(name)] += size
        elif name != "loss":
            gains[1, GAINS.index(name.removeprefix("gain_"))] += size
    # demanded power: a level, a slow wander of 0.5 %, and a step of up to 5 % in half of them
    level, dT = rng.uniform(200e3, 420e3), rng.uniform(-15.0, 15.0)
    wander = np.empty(K)
    value, keep = 0.0, math.exp(-DT / 1.0)
    for k, xi in enumerate(rng.standard_normal(K)):
        value = keep * value + math.sqrt(1 - keep**2) * xi
        wander[k] = 0.005 * value
    step = rng.uniform(-0.05, 0.05) * (rng.random() < 0.5)
    load = level * (1 + wander + step * (np.arange(K) >= rng.integers(0, K)))
    white = rng.standard_normal((len(READINGS), K))
    start = trim_gas_generator(
        gg,
        {"N": gg.parameters.N, "PW": load[0]},
        theta=dict(zip(HEALTH, theta[0], strict=True)),
        limits=Limits(T4_max=math.inf),
        dT_isa=dT,
    )
    return _Drawn(sizes, onset, theta, gains, sizes.get("loss", 0.0), h_0, load, white, start)


class _Course:
    """The governed engines of all windows, by Heun's rule with ``SUBSTEPS`` steps in a sample.

    Args:
        gg, gov: engine and governor.
        u, z: inputs and unknowns at the start, one column for each window.
    """

    def __init__(self, gg: GasGenerator, gov: Governor, u: np.ndarray, z: np.ndarray) -> None:
        self.gg, self.gov = gg, gov
        self.engine = _engine(gg, backend_in_use())
        self.u, self.z = u, z
        self.i_Wf, self.i_PW = gg.U.index("Wf"), gg.U.index("PW")
        self.N = np.full((1, u.shape[1]), gg.parameters.N)
        start = gov.start(u[self.i_Wf])
        self.I = np.array([np.broadcast_to(x, u.shape[1]) for x in start])  # governor's states
        self.worst = 0.0  # residual

    def _rates(
        self, N: np.ndarray, I: np.ndarray, theta: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        self.u[self.i_Wf], moves = self.gov.law(N[0], self.gg.parameters.N, [*I])
        ode, y, self.z, check = self.engine(self.z, N, self.u, theta)
        self.worst = max(self.worst, float(np.nan_to_num(check, nan=np.inf).max()))
        return ode, np.array(moves), y

    def step(self, PW: np.ndarray, theta: np.ndarray) -> list[np.ndarray]:
        """Return N, P3, T3, T5 and Wf at a sample, and go on to the next."""
        self.u[self.i_PW] = PW
        h = DT / SUBSTEPS
        seen: list[np.ndarray] = []
        for _ in range(SUBSTEPS):
            dN, dI, y = self._rates(self.N, self.I, theta)
            seen = seen or [self.N[0], *y, self.u[self.i_Wf].copy()]
            dN2, dI2, _ = self._rates(self.N + h * dN, self.I + h * dI, theta)
            self.N, self.I = self.N + h / 2 * (dN + dN2), self.I + h / 2 * (dI + dI2)
        return seen


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
            out.onset[i], out.reading[:, i] = part.onset, part.reading
            out.ambient[:, i] = part.ambient
            for j, sizes in zip(i, part.sizes, strict=True):
                out.sizes[j] = sizes
    return out
