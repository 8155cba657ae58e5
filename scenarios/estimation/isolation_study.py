"""Which fault is it?  Eleven classes, told apart from a few seconds around the onset.

Healthy; a loss of compressor efficiency, compressor flow, turbine efficiency, or a change of
turbine flow, each alone; both compressor factors, both turbine factors; a turn-to-turn short
circuit (TTSC); a gain error of the P3, T3 or T5 sensor.  Each of 1 to 4 %, uniformly, on a unit
that its governor holds at speed, at any load and day, with

* the sensors of :data:`scenarios.estimation.sensors.GAS_PATH` at 50 Hz, whose constant gain errors
  are unknown, like the wear of the engine before the fault: both are nuisances with a stated prior;
* a load that wanders, and in half of the windows makes a step, in any class;
* the electrical filter's severity h, with an unknown constant offset from sensor gains and load
  unbalance.  A TTSC takes shaft power that the measured electrical power does not show.

Two classifiers, and what no classifier can surpass:

* ``glr``: one filter of the healthy engine; each hypothesis is judged by what its jump would have
  left in the innovations (:func:`estimators.detection.glr`), size and onset integrated out;
* ``bank``: one filter for each hypothesis, with the size as a state, from the onset that ``glr``
  found: linearised about the faulty engine instead of the healthy one;
* ``limit``: Bayes' rule in the linear problem with Gaussian noise, by Monte Carlo: there the first
  classifier is exact and none is better.

All integrate the sizes out over the very range that they are drawn from, so a pair does not win
against its members by having more freedom.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy import special, stats

from apu_casadi.apu import Apu
from apu_casadi.backend import backend_in_use, compiled, mapped
from apu_casadi.control import GovernorParameters
from apu_casadi.errors import EstimationError, ParameterError, nearest
from apu_casadi.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.signals import Signal, Signals
from apu_casadi.trimming import Limits, trim_gas_generator
from estimators.belief import Belief
from estimators.detection import Jump, LinearFilter, glr, linear_filter, linearised
from estimators.ekf import ekf_step
from estimators.filtering import FilterResult
from estimators.filtering import run as run_filter
from estimators.model import FilterModel
from estimators.recording import Recording
from scenarios.estimation.gaspath import gas_path_model
from scenarios.estimation.gaspath_study import VARIANTS, variant
from scenarios.estimation.sensors import GAS_PATH, SensorSet

__all__ = [
    "CLASSES",
    "DEFAULT",
    "FAULTS",
    "METHODS",
    "SNAPSHOT",
    "Hypothesis",
    "Protocol",
    "cohen_kappa",
    "figures",
    "information_limit",
    "isolate",
    "isolation_study",
    "linear_problem",
    "log_box",
    "run",
    "simulate_windows",
    "sweep",
]

DT = 0.02  # s
HEALTH = GasGenerator.THETA.names
GAINS = ("P3", "T3", "T5", "Wf", "PW")
OUTPUTS = ("N", "P3", "T3", "T5", "h")
FAULTS = (*HEALTH, "gain_P3", "gain_T3", "gain_T5", "loss")
"""Directions in which something may jump; ``loss`` is shaft power lost in the generators, over the
design power."""
METHODS = ("glr", "bank")

P_RATED = 500e3  # W; shaft power to which a TTSC's loss is referred
SUBSTEPS = 4  # of the truth, in one sample
_JUMP = ("first", "second")

LOSS, EITHER = (-0.04, -0.01), ((-0.04, -0.01), (0.01, 0.04))
GAIN = (0.01, 0.04)


# ------------------------------------------------------------------------------ hypotheses


@dataclass(frozen=True)
class Hypothesis:
    """One class.

    Parameters
    ----------
    name : in words.
    faults : what jumps, of :data:`FAULTS`; none for the healthy class.
    ranges : for each of them the intervals over which its size is uniform.
    """

    name: str
    faults: tuple[str, ...] = ()
    ranges: tuple[tuple[tuple[float, float], ...], ...] = ()

    @property
    def boxes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Lower and upper corners of all combinations of intervals."""
        boxes: list[tuple[tuple[float, ...], tuple[float, ...]]] = [((), ())]
        for intervals in self.ranges:
            boxes = [((*lo, a), (*hi, b)) for lo, hi in boxes for a, b in intervals]
        return [(np.array(lo), np.array(hi)) for lo, hi in boxes]

    def normal(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean and variance of a normal distribution of sizes that covers the ranges."""
        mean = [float(np.mean(r)) for r in self.ranges]
        # sqrt(3) wider than the uniform one: the filter's start, divided out again afterwards
        var = [3 * float(np.mean([(a * a + a * b + b * b) / 3 for a, b in r])) - 3 * m * m
               for r, m in zip(self.ranges, mean, strict=True)]  # fmt: skip
        return np.array(mean), np.array(var)

    def draw(self, rng: np.random.Generator) -> dict[str, float]:
        """Draw sizes by fault name; each interval is equally likely."""
        sizes = {}
        for name, intervals in zip(self.faults, self.ranges, strict=True):
            a, b = intervals[int(rng.integers(len(intervals)))]
            sizes[name] = float(rng.uniform(a, b))
        return sizes


CLASSES = (
    Hypothesis("healthy"),
    Hypothesis("compressor efficiency", ("f_eta_c",), ((LOSS,),)),
    Hypothesis("compressor flow", ("f_W_c",), ((LOSS,),)),
    Hypothesis("turbine efficiency", ("f_eta_t",), ((LOSS,),)),
    Hypothesis("turbine flow", ("f_W_t",), (EITHER,)),
    Hypothesis("compressor pair", ("f_eta_c", "f_W_c"), ((LOSS,), (LOSS,))),
    Hypothesis("turbine pair", ("f_eta_t", "f_W_t"), ((LOSS,), EITHER)),
    Hypothesis("TTSC", ("loss",), ((GAIN,),)),
    Hypothesis("P3 sensor", ("gain_P3",), (EITHER,)),
    Hypothesis("T3 sensor", ("gain_T3",), (EITHER,)),
    Hypothesis("T5 sensor", ("gain_T5",), (EITHER,)),
)
"""The classes, equally likely a priori.  Efficiencies and compressor flow fall; turbine flow moves
either way (fouling, erosion); a sensor errs either way."""


@dataclass(frozen=True)
class Protocol:
    """What a window holds, and what is known beforehand.

    Parameters
    ----------
    before : time before the earliest onset, s: from it the healthy unit is learnt.  0 (then with
        ``spread`` 0): the fault is there from the beginning.
    after : time after the latest onset, s.
    spread : what a detector leaves open of the onset, s; uniform.
    every : samples between the onsets that are tried.
    sensors : noise and gain errors.
    noise : all white noise is multiplied by this.
    wear : standard deviation of each health factor before the fault.
    baseline : factor on what is uncertain of the healthy unit: wear, gain errors, offset of h.
        Matters most without a time before the fault: it is then all that is known of the unit.
    h_noise, h_offset : standard deviations of the severity's white error in 20 ms, and of its
        constant offset from sensor gains and load unbalance.
    electrical : whether the severity is measured at all.
    N_walk : process noise of the speed in the classifiers, rad/s/sqrt(s).
    """

    before: float = 4.0
    after: float = 4.0
    spread: float = 1.0
    every: int = 5
    sensors: SensorSet = GAS_PATH
    noise: float = 1.0
    wear: float = 0.01
    baseline: float = 1.0
    h_noise: float = 1e-5
    h_offset: float = 3e-4
    electrical: bool = True
    N_walk: float = 1.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        for name in ("after", "noise", "baseline", "h_noise"):
            if not getattr(self, name) > 0:
                raise ParameterError(f"Protocol.{name} must be > 0, got {getattr(self, name)!r}")
        for name in ("before", "spread"):
            if not getattr(self, name) >= 0:
                raise ParameterError(f"Protocol.{name} must be >= 0, got {getattr(self, name)!r}")
        if self.every < 1:
            raise ParameterError(f"Protocol.every must be >= 1 sample, got {self.every!r}")

    @property
    def first(self) -> int:
        """Earliest sample of an onset."""
        return round(self.before / DT)

    @property
    def last(self) -> int:
        """Latest sample of an onset."""
        return self.first + round(self.spread / DT)

    @property
    def size(self) -> int:
        """Samples in a window."""
        return self.last + round(self.after / DT)

    @property
    def onsets(self) -> np.ndarray:
        """Samples at which the classifiers suppose an onset."""
        return np.arange(self.first, self.last + 1, self.every)

    def describe(self) -> dict[str, Any]:
        """Return the numbers, for JSON."""
        return {
            f.name: getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "sensors"
        } | {"noise_table": {s.name: s.noise * self.noise for s in self.sensors.sensors}}


DEFAULT = Protocol()
"""A fault that begins while the unit is watched.  Chosen on seeds 1 to 99, before any result on
later ones was seen."""

SNAPSHOT = Protocol(before=0.0, spread=0.0)
"""A fault that is there from the beginning: a unit of which no history is known."""


@lru_cache(maxsize=1)
def severity_of_loss() -> float:
    """Severity h of a TTSC whose loss, in both generators over their efficiency, is ``P_RATED``.

    The fault is a shunt r_s/h from terminal to neutral (kappa = mu), so it takes h V^2/r_s; eq. (8)
    counts it twice, over the efficiency.
    """
    apu = Apu()
    machine = apu.generator.machine
    eta = machine.eta_sg * apu.coupling.eta_gtSg
    return float(P_RATED * eta / (2 * machine.V_rated_rms**2 / machine.r_s))


# ------------------------------------------------------------------------------ the filter's model


@lru_cache(maxsize=4)
def jump_model(gg: GasGenerator) -> FilterModel:
    """The gas-path filter's model with two jumps of any direction, and the severity as an output.

    States beside those of :func:`~scenarios.estimation.gaspath.gas_path_model`: ``size_1``,
    ``size_2``, and the offset ``h_0``.  Inputs beside its own: the directions ``first_<fault>`` and
    ``second_<fault>``, so that one compiled filter serves all hypotheses.
    """
    base = gas_path_model(gg, gains=GAINS)
    extra = Signals([
        Signal("size_1", "1", "size of the first jump", default=0.0, nominal=0.01),
        Signal("size_2", "1", "size of the second jump", default=0.0, nominal=0.01),
        Signal("h_0", "1", "offset of the measured severity", default=0.0, nominal=1e-4),
    ])  # fmt: skip
    directions = Signals([
        Signal(f"{_JUMP[k]}_{n}", "1", f"share of {n} in the {_JUMP[k]} jump", default=0.0)
        for k in (0, 1) for n in FAULTS
    ])  # fmt: skip
    X, U = base.x + extra, base.u + directions
    Yf = base.y + Signals([Signal("h", "1", "TTSC severity, by the electrical filter",
                                  nominal=1e-4)])  # fmt: skip
    nx, nu, q = len(base.x), len(base.u), len(FAULTS)
    x, u, w = ca.MX.sym("x", len(X)), ca.MX.sym("u", len(U)), ca.MX.sym("w", len(base.w))
    p, dt = ca.MX.sym("p", 0), ca.MX.sym("dt")
    jump = u[nu : nu + q] * x[nx] + u[nu + q :] * x[nx + 1]
    moved, given = ca.MX(x[:nx]), ca.MX(u[:nu])
    for i, name in enumerate(FAULTS[:-1]):
        moved[base.x.index(name)] += jump[i]
    # shaft power that is taken, but not measured
    given[base.u.index("PW")] += P_RATED * jump[q - 1]
    x1, check = base.transition(moved, given, p, w, dt)
    y, check_y = base.output(moved, given, p, w)
    N = base.x.index("N")
    after = ca.vertcat(*(x1[i] if i == N else x[i] for i in range(len(X))))
    reading = ca.vertcat(y, x[nx + 2] + severity_of_loss() * jump[q - 1])
    free = np.full(len(X), np.inf)
    return FilterModel(
        "isolation", X, U, base.p, base.w, Yf,
        transition=ca.Function("isolation_f", [x, u, p, w, dt], [after, check],
                               ["x", "u", "p", "w", "dt"], ["x1", "check"]),
        output=ca.Function("isolation_g", [x, u, p, w], [reading, check_y],
                           ["x", "u", "p", "w"], ["y", "check"]),
        walk=np.zeros(len(X)), lower=-free, upper=free,
    )  # fmt: skip


@lru_cache(maxsize=8)
def _model(gg: GasGenerator, N_walk: float) -> FilterModel:
    return jump_model(gg).with_walk({"N": N_walk})


def _prior(model: FilterModel, protocol: Protocol, N: float) -> Belief:
    known = protocol.baseline
    sigma = {"N": 0.005 * N, "h_0": known * protocol.h_offset, "size_1": 0.0, "size_2": 0.0}
    sigma |= dict.fromkeys(HEALTH, known * protocol.wear)
    sigma |= {f"gain_{n}": known * protocol.sensors[n].gain for n in GAINS}
    return Belief.of(model.x, {"N": N} | dict.fromkeys(HEALTH, 1.0), sigma)


def _directions(faults: Sequence[str]) -> dict[str, float]:
    return {f"{_JUMP[k]}_{n}": 1.0 for k, n in enumerate(faults)}


# ------------------------------------------------------------------------------ truth


@dataclass(frozen=True, eq=False)
class Windows:
    """Simulated windows, as they are measured.

    Parameters
    ----------
    truth : class of each, (n,).
    sizes : by fault name, for each.
    onset : sample of the onset, (n,).
    reading : N, P3, T3, T5, h, Wf, PW, (7, n, K).
    ambient : altitude, Mach, dT_isa, war, known, (4, n).
    """

    truth: np.ndarray
    sizes: list[dict[str, float]]
    onset: np.ndarray
    reading: np.ndarray
    ambient: np.ndarray


@lru_cache(maxsize=4)
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
    governor: GovernorParameters | None = None,
) -> Windows:
    """Simulate windows of the governed unit, one for each label and seed.

    The engine's own equations, by Heun's rule with steps of a quarter of a sample; the governor
    holds the true speed.  The classifiers go by whole samples, and know fuel flow, power and speed
    only as measured.

    Parameters
    ----------
    labels : positions in :data:`CLASSES`.
    seeds : one for each window; all that is random in it follows from its seed and label.
    protocol, gg, governor : see :class:`Protocol`; the paper's unit by default.

    Raises
    ------
    EstimationError : an engine left the region where its equations can be solved.
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
    N, I, z, u = x0.copy(), u0[i_Wf].copy(), z0, u0.copy()
    reading = np.empty((7, n, K))
    worst = 0.0

    def rates(N: np.ndarray, I: np.ndarray, th: np.ndarray) -> tuple[np.ndarray, ...]:
        nonlocal z, worst
        e = (N_ref - N[0]) / N_ref
        u[i_Wf] = np.clip(gov.Kp * e + I, gov.Wf_min, gov.Wf_max)
        ode, y, z, check = engine(z, N, u, th)
        worst = max(worst, float(np.nan_to_num(check, nan=np.inf).max()))
        return ode, gov.Ki * e + (u[i_Wf] - gov.Kp * e - I) / gov.T_aw, y

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
    ambient = u0[gg.U.indices(("altitude", "Mach", "dT_isa", "war"))]
    return Windows(np.asarray(labels, int), sizes, onset, reading, ambient)


# ------------------------------------------------------------------------------ evidence


def _log_interval(lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Logarithm of the normal probability of lo to hi, for any tail."""
    flip = lo > 0
    a, b = np.where(flip, -hi, lo), np.where(flip, -lo, hi)
    upper, lower = special.log_ndtr(b), special.log_ndtr(a)
    with np.errstate(divide="ignore"):
        return np.asarray(upper + np.log(-np.expm1(np.minimum(lower - upper, -1e-300))))


def _log_line(b: np.ndarray, C: np.ndarray, lo: float, hi: float) -> np.ndarray:
    """Logarithm of the integral of exp(b s - C s^2/2) from lo to hi; C > 0."""
    root = np.sqrt(C)
    mean = b / C
    inside = _log_interval((lo - mean) * root, (hi - mean) * root)
    return np.asarray(b * mean / 2 + 0.5 * np.log(2 * np.pi / C) + inside)


def _peak(b: np.ndarray, C: np.ndarray, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """Where b's - s'Cs/2 is largest in a box of two sizes, (..., 2): inside, or on an edge."""
    inside = np.linalg.solve(C, b[..., None])[..., 0]
    inside = np.where(((inside >= lo) & (inside <= hi)).all(-1, keepdims=True), inside, np.nan)
    candidates = [inside]
    for i in (0, 1):
        for edge in (lo[i], hi[i]):
            s = np.empty_like(b)
            s[..., i] = edge
            rest = (b[..., 1 - i] - C[..., 0, 1] * edge) / C[..., 1 - i, 1 - i]
            s[..., 1 - i] = np.clip(rest, lo[1 - i], hi[1 - i])
            candidates.append(s)
    at = np.array(candidates)
    value = (
        np.einsum("...i,k...i->k...", b, at) - np.einsum("k...i,...ij,k...j->k...", at, C, at) / 2
    )
    best = np.nanargmax(value, axis=0)
    return np.asarray(np.take_along_axis(at, best[None, ..., None], axis=0)[0])


def _nodes(
    b: np.ndarray, C: np.ndarray, lo: np.ndarray, hi: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and log weights over the first size, dense about the peak however sharp it is.

    Panels of Gauss-Legendre nodes, each twice as wide as the one before it, from a fraction of the
    peak's width outwards.
    """
    s = _peak(b, C, lo, hi)
    slope = np.abs(b[..., 0] - np.einsum("...i,...i->...", C[..., 0, :], s))
    width = 0.5 / (np.sqrt(C[..., 0, 0]) + slope)
    # as many panels as the sharpest of the peaks needs
    n = max(2, math.ceil(math.log2(float(np.max((hi[0] - lo[0]) / width)) + 1)) + 1)
    steps = np.concatenate([[0.0], 2.0 ** np.arange(n) - 0.5])
    steps = np.concatenate([-steps[:0:-1], steps])
    edges = np.clip(s[..., :1] + width[..., None] * steps, lo[0], hi[0])
    t, w = np.polynomial.legendre.leggauss(8)
    half = (edges[..., 1:] - edges[..., :-1]) / 2
    middle = (edges[..., 1:] + edges[..., :-1]) / 2
    nodes = middle[..., None] + half[..., None] * t
    with np.errstate(divide="ignore"):
        weights = np.log(half[..., None] * w)
    flat = (*b.shape[:-1], -1)
    return nodes.reshape(flat), np.broadcast_to(weights, nodes.shape).reshape(flat)


def log_box(
    b: np.ndarray, C: np.ndarray, boxes: Sequence[tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """Return the logarithm of the mean of exp(b's - s'Cs/2) over boxes of sizes s.

    The evidence for a fault whose sizes are uniform in the boxes (each equally likely), against
    none: analytic in one size, by quadrature in the other.

    Parameters
    ----------
    b : (..., n), C : (..., n, n), positive definite; n = 1 or 2.
    boxes : lower and upper corners.

    Raises
    ------
    ParameterError : more than two sizes.
    """
    n = b.shape[-1]
    if n not in (1, 2):
        raise ParameterError(f"evidence of one or two sizes can be had, not of {n}")
    parts = []
    for lo, hi in boxes:
        volume = float(np.log(hi - lo).sum())
        if n == 1:
            parts.append(_log_line(b[..., 0], C[..., 0, 0], lo[0], hi[0]) - volume)
            continue
        s, log_w = _nodes(b, C, lo, hi)
        outer = b[..., :1] * s - C[..., 0, :1] * s**2 / 2
        inner = _log_line(b[..., 1:] - C[..., 0, 1:] * s, C[..., 1, 1:], lo[1], hi[1])
        parts.append(special.logsumexp(outer + inner + log_w, axis=-1) - volume)
    return np.asarray(special.logsumexp(parts, axis=0) - math.log(len(boxes)))


def _evidence(b: np.ndarray, C: np.ndarray, classes: Sequence[Hypothesis] = CLASSES) -> np.ndarray:
    """Evidence of each class against the first, (classes, ...), from b (..., 8), C (..., 8, 8)."""
    out = []
    for c in classes:
        if not c.faults:
            out.append(np.zeros(b.shape[:-1]))
            continue
        i = [FAULTS.index(f) for f in c.faults]
        out.append(log_box(b[..., i], C[..., i, :][..., :, i], c.boxes))
    return np.array(out)


# ------------------------------------------------------------------------------ classifiers


def _jumps() -> tuple[Jump, ...]:
    return (*(Jump("state", n) for n in FAULTS[:-1]), Jump("state", "size_1"))


def _recording(model: FilterModel, w: Windows, i: int, protocol: Protocol) -> Recording:
    """One window as the classifiers take it; direction 1 is the loss."""
    K = protocol.size
    t = DT * np.arange(K)
    y = w.reading[: len(OUTPUTS), i]
    Wf, PW = w.reading[len(OUTPUTS) :, i]
    sensors = protocol.sensors
    # noise in proportion to the reading; the mean, since a noisy sigma would favour low readings
    sigma = np.array([
        protocol.noise * (protocol.h_noise if n == "h" else sensors.sigma(n, float(np.mean(v))))
        for n, v in zip(OUTPUTS, np.nan_to_num(y), strict=True)
    ])  # fmt: skip
    inputs = dict(zip(("altitude", "Mach", "dT_isa", "war"), w.ambient[:, i], strict=True))
    inputs |= {
        "sigma_Wf": protocol.noise * sensors.sigma("Wf", float(np.mean(Wf))),
        "sigma_PW": protocol.noise * sensors.sigma("PW", float(np.mean(PW))),
    } | _directions(["loss"])
    u = model.u.pack({**dict.fromkeys(("Wf", "PW"), 0.0), **inputs})
    u = np.repeat(u[:, None], K, axis=1)
    u[model.u.index("Wf")], u[model.u.index("PW")] = Wf, PW
    return Recording(t, u, y, np.repeat(sigma[:, None] ** 2, K, axis=1), np.zeros(0))


@dataclass(frozen=True)
class Verdict:
    """What the classifiers say of one window.

    Parameters
    ----------
    log_probability : by method, of each class, (classes,).
    onset : most probable one, sample.
    nis : mean normalised innovation squared of the healthy filter before any onset, over its
        expectation.
    sizes : most probable sizes under the bank's best class, by fault name.
    """

    log_probability: dict[str, np.ndarray]
    onset: int
    nis: float
    sizes: dict[str, float] = field(default_factory=dict)


def isolate(
    data: Recording,
    protocol: Protocol = DEFAULT,
    gg: GasGenerator | None = None,
    *,
    methods: Sequence[str] = METHODS,
    backend: str | None = None,
) -> Verdict:
    """Say which class a window belongs to.

    Parameters
    ----------
    data : the window; see :func:`simulate_windows`.
    protocol : its layout, and the priors.
    gg : the engine as the classifiers know it.
    methods : ``"glr"``, and ``"bank"`` beside it.
    backend : see :func:`apu_casadi.backend.compiled`.

    Raises
    ------
    ParameterError : unknown method. EstimationError : a filter failed.
    """
    for m in methods:
        if m not in METHODS:
            raise ParameterError(f"unknown method {m!r} {nearest(m, METHODS)}")
    gg = GasGenerator() if gg is None else gg
    model = _model(gg, protocol.N_walk)
    step = ekf_step(model)
    healthy = run_filter(
        step, _prior(model, protocol, gg.parameters.N), data, full=True, backend=backend
    )
    along = linearised(model, healthy, data, _jumps(), backend=backend)
    evidence = glr(along, protocol.onsets)
    each = _evidence(evidence.b, evidence.C)  # (classes, onsets)
    whole = special.logsumexp(each, axis=1) - math.log(each.shape[1])
    out = {"glr": whole - special.logsumexp(whole)}
    best = int(np.argmax(special.logsumexp(each[1:], axis=0)))
    sizes: dict[str, float] = {}
    if "bank" in methods:
        k = int(protocol.onsets[best])
        at_onset, found = _bank(step, healthy, data, k, backend)
        # the onset is integrated out as in the linear problem
        total = at_onset + whole - each[:, best]
        total[0] = 0.0
        out["bank"] = total - special.logsumexp(total)
        sizes = found[int(np.argmax(total))]
    # without a time before the fault this is the healthy filter's misfit, not its consistency
    before = slice(0, protocol.first or protocol.size)
    nis = float(healthy.nis[before].sum() / healthy.measured[before].sum())
    return Verdict(out, int(protocol.onsets[best]), nis, sizes)


def _bank(
    step: Any, healthy: FilterResult, data: Recording, k: int, backend: str | None
) -> tuple[np.ndarray, list[dict[str, float]]]:
    """Evidence of each class against the healthy one, by its own filter from sample k on."""
    model = step.model
    assert healthy.mean_pred is not None and healthy.cov_pred is not None
    mean, cov = healthy.mean_pred[:, k], healthy.cov_pred[k]
    rest = data.part(k, data.size)
    rows = model.x.indices(("size_1", "size_2"))
    first = model.u.index(f"{_JUMP[0]}_{FAULTS[0]}")
    reference = 0.0
    out: list[float] = []
    found: list[dict[str, float]] = []
    for c in CLASSES:
        n = len(c.faults)
        mu, var = c.normal()
        m, P = mean.copy(), (cov + cov.T) / 2
        m[rows[:n]] = mu
        P[rows[:n], rows[:n]] = var
        u = rest.u.copy()
        u[first:] = 0.0
        for name in _directions(c.faults):
            u[model.u.index(name)] = 1.0
        r = run_filter(step, Belief(model.x, m, P), dataclasses.replace(rest, u=u), backend=backend)
        if not n:
            reference = r.loglik
            out.append(0.0)
            found.append({})
            continue
        post = r.final.marginal(("size_1", "size_2")[:n])
        # the likelihood of the sizes is the posterior with its normal prior divided out
        W = np.diag(1 / var)
        V = np.linalg.inv(post.cov)
        C, b = V - W, V @ post.mean - W @ mu
        C = (C + C.T) / 2
        at = C @ mu
        M = np.eye(n) + np.diag(var) @ C
        normal = b @ mu - 0.5 * at @ mu - 0.5 * np.linalg.slogdet(M)[1]
        normal += 0.5 * (b - at) @ np.linalg.solve(M, np.diag(var) @ (b - at))
        out.append(r.loglik - normal + float(log_box(b, C, c.boxes)))
        found.append(dict(zip(c.faults, post.mean.tolist(), strict=True)))
    return np.array(out) - np.r_[0.0, np.full(len(out) - 1, reference)], found


# ------------------------------------------------------------------------------ the limit


def linear_problem(
    PW: float, dT_isa: float, protocol: Protocol = DEFAULT, gg: GasGenerator | None = None
) -> LinearFilter:
    """The classifier's filter at a steady point, with exact derivatives: linear and Gaussian."""
    gg = GasGenerator() if gg is None else gg
    model = _model(gg, protocol.N_walk)
    point = trim_gas_generator(
        gg, {"N": gg.parameters.N, "PW": PW}, limits=Limits(T4_max=math.inf), dT_isa=dT_isa
    )
    pr, s = protocol, protocol.sensors
    inputs = dict(zip(gg.U.names, point.u, strict=True)) | _directions(["loss"])
    inputs |= {f"sigma_{n}": pr.noise * s.sigma(n, point[n]) for n in ("Wf", "PW")}
    prior = _prior(model, pr, gg.parameters.N)
    F, Fw, H, Hw = (
        np.asarray(M, float) for M in _jacobians(model)(prior.mean, model.u.pack(inputs), DT)
    )
    sigma = [pr.noise * (pr.h_noise if n == "h" else s.sigma(n, point[n])) for n in OUTPUTS]
    y = np.zeros((pr.size, len(OUTPUTS)))
    if not pr.electrical:
        y[:, OUTPUTS.index("h")] = np.nan
    jumps = _jumps()
    state = np.zeros((len(model.x), len(jumps)))
    for c, j in enumerate(jumps):
        state[model.x.index(j.name), c] = 1.0
    return linear_filter(
        y, A=F, H=H, Q=Fw @ Fw.T + DT * np.diag(model.walk**2),
        R=np.diag(np.square(sigma)) + Hw @ Hw.T, P0=prior.cov, cross=Fw @ Hw.T,
        names=FAULTS, state=state,
    )  # fmt: skip


@lru_cache(maxsize=4)
def _jacobians(model: FilterModel) -> ca.Function:
    x, u, p, w, dt = model.symbols()
    x1, y = model.transition(x, u, p, w, dt)[0], model.output(x, u, p, w)[0]
    J = [ca.jacobian(e, v) for e in (x1, y) for v in (x, w)]
    f = ca.Function("J", [x, u, p, w, dt], J)
    xs, us, ts = ca.MX.sym("x", len(model.x)), ca.MX.sym("u", len(model.u)), ca.MX.sym("dt")
    none = ca.MX(0, 1), ca.MX(len(model.w), 1)
    return ca.Function("jacobians", [xs, us, ts], f.call([xs, us, none[0], none[1], ts]))


def _white_signatures(f: LinearFilter, onsets: np.ndarray) -> np.ndarray:
    """What unit jumps add to the whitened innovations, (onsets, K ny, q); 0 before the onset."""
    K, ny = f.innovation.shape
    L = np.linalg.inv(np.linalg.cholesky(f.S))
    out = np.zeros((onsets.size, K, ny, len(f.names)))
    for i, k in enumerate(onsets):
        out[i, k:] = L[k:] @ f.signature(int(k))
    return out.reshape(onsets.size, K * ny, len(f.names))


def information_limit(
    draws: int = 200,
    seed: int = 0,
    protocol: Protocol = DEFAULT,
    gg: GasGenerator | None = None,
    *,
    points: int = 8,
    onset_known: bool = False,
) -> dict[str, Any]:
    """Classify by Bayes' rule where that is exact: linear, Gaussian, all priors known.

    No classifier has a higher expected share of right answers in that problem.  What the real one
    loses against it is due to method, not to information.

    Parameters
    ----------
    draws : windows of each class at each operating point.
    seed : of the draws.
    protocol, gg : as in the study.
    points : operating points, drawn like those of the study.
    onset_known : tell the classifier the onset.

    Returns
    -------
    As :func:`scores`.
    """
    rng = np.random.default_rng([7, seed])
    n = len(CLASSES)
    confusion = np.zeros((n, n), int)
    # half of the points of the study carry a load step as well; it is measured, so it adds nothing
    for _ in range(points):
        f = linear_problem(rng.uniform(200e3, 420e3), rng.uniform(-15, 15), protocol, gg)
        G = _white_signatures(f, protocol.onsets)
        C = np.einsum("okp,okq->opq", G, G)
        for label, c in enumerate(CLASSES):
            s = np.zeros((draws, len(FAULTS)))
            for i in range(draws):
                for name, size in c.draw(rng).items():
                    s[i, FAULTS.index(name)] = size
            at = rng.integers(G.shape[0], size=draws)
            white = np.einsum("nkq,nq->nk", G[at], s) + rng.standard_normal((draws, G.shape[1]))
            if onset_known:
                b = np.einsum("nkq,nk->nq", G[at], white)
                each = _evidence(b, C[at])
            else:
                b = np.einsum("okq,nk->noq", G, white)
                each = special.logsumexp(
                    _evidence(b, np.broadcast_to(C, (draws, *C.shape))), axis=2
                )
            confusion[label] += np.bincount(np.argmax(each, axis=0), minlength=n)
    return scores(confusion)


# ------------------------------------------------------------------------------ scores


def cohen_kappa(confusion: np.ndarray) -> tuple[float, float, float]:
    """Return Cohen's kappa with its 95 % interval.

    Cohen (1960), Educ. Psychol. Meas. 20, 37-46.  The interval is that of Clopper and Pearson for
    the share of right answers, chance agreement taken as found: it also holds where nearly all
    answers are right, where the usual standard error vanishes.

    Parameters
    ----------
    confusion : counts, true class by row, given class by column.
    """
    c = np.asarray(confusion, float)
    n = c.sum()
    if not n:
        raise ParameterError("an empty confusion matrix has no kappa")
    right = float(np.trace(c))
    chance = float((c.sum(0) * c.sum(1)).sum()) / n**2
    if chance >= 1:
        raise ParameterError("kappa is not defined where all answers are one and the same class")
    low = stats.beta.ppf(0.025, right, n - right + 1) if right else 0.0
    high = stats.beta.ppf(0.975, right + 1, n - right) if right < n else 1.0
    kappa, low, high = ((a - chance) / (1 - chance) for a in (right / n, low, high))
    return float(kappa), float(low), float(high)


def scores(confusion: np.ndarray) -> dict[str, Any]:
    """Return a confusion matrix with what follows from it, for JSON."""
    c = np.asarray(confusion, int)
    kappa, low, high = cohen_kappa(c)
    rows = c.sum(1)
    return {
        "classes": [h.name for h in CLASSES],
        "confusion": c.tolist(),
        "n": int(c.sum()),
        "kappa": kappa,
        "kappa_95": [low, high],
        "right": float(np.trace(c) / c.sum()),
        "recall": [float(c[i, i] / rows[i]) if rows[i] else None for i in range(len(rows))],
    }


def _simulate(
    labels: np.ndarray, seeds: np.ndarray, protocol: Protocol, truth: Sequence[GasGenerator]
) -> Windows:
    """Windows of several engines, by turns of the seeds."""
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


def isolation_study(
    n: int = 50,
    seed0: int = 1000,
    protocol: Protocol = DEFAULT,
    *,
    methods: Sequence[str] = METHODS,
    limit_draws: int = 200,
    limit_points: int = 8,
    gg: GasGenerator | None = None,
    truth: Sequence[GasGenerator] = (),
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Classify n fresh windows of each class; the information limit beside it.

    Parameters
    ----------
    n : windows of each class, with seeds ``seed0`` to ``seed0 + n - 1``.
    seed0 : first seed; seeds below 100 were used for tuning.
    protocol, gg : what is measured, and of what.
    truth : engines that are simulated instead of ``gg``, by turns of the seeds: the classifiers'
        model is then wrong.
    methods : see :func:`isolate`.
    limit_draws, limit_points : of :func:`information_limit`.
    progress : called with (done, total) windows.

    Returns
    -------
    Numbers that JSON can hold: ``protocol``; by method, and for ``limit`` and
    ``limit_onset_known``, confusion matrix, kappa with interval, share right, recall; ``nis`` (mean
    over its expectation, before any onset); ``onset_rms`` in s and relative ``size_rms`` of right
    answers; ``wrong``: every wrong answer of the last method with its sizes.
    """
    gg = GasGenerator() if gg is None else gg
    labels = np.repeat(np.arange(len(CLASSES)), n)
    seeds = seed0 + np.tile(np.arange(n), len(CLASSES))
    windows = _simulate(labels, seeds, protocol, truth or [gg])
    model = _model(gg, protocol.N_walk)
    confusion = {m: np.zeros((len(CLASSES), len(CLASSES)), int) for m in methods}
    nis, onset_error, size_error, wrong = [], [], [], []
    last = methods[-1]
    for i in range(labels.size):
        v = isolate(_recording(model, windows, i, protocol), protocol, gg, methods=methods)
        for m in methods:
            confusion[m][labels[i], int(np.argmax(v.log_probability[m]))] += 1
        nis.append(v.nis)
        given = int(np.argmax(v.log_probability[last]))
        if given != labels[i]:
            wrong.append({
                "seed": int(seeds[i]), "true": CLASSES[labels[i]].name,
                "given": CLASSES[given].name, "sizes": windows.sizes[i],
                "log_odds": float(v.log_probability[last][given]
                                  - v.log_probability[last][labels[i]]),
            })  # fmt: skip
        elif labels[i]:
            onset_error.append(DT * (v.onset - int(windows.onset[i])))
            size_error += [v.sizes[f] - s for f, s in windows.sizes[i].items() if f in v.sizes]
        if progress is not None:
            progress(i + 1, labels.size)
    out: dict[str, Any] = {"protocol": protocol.describe(), "seeds": [seed0, seed0 + n - 1]}
    out |= {m: scores(c) for m, c in confusion.items()}
    out["limit"] = information_limit(limit_draws, seed0, protocol, gg, points=limit_points)
    out["limit_onset_known"] = information_limit(
        limit_draws, seed0, protocol, gg, points=limit_points, onset_known=True
    )

    def rms(v: list[float]) -> float | None:
        return float(np.sqrt(np.mean(np.square(v)))) if v else None

    out["nis"] = float(np.mean(nis))
    out |= {"onset_rms": rms(onset_error), "size_rms": rms(size_error), "wrong": wrong}
    return out


def sweep(
    changes: Mapping[str, Sequence[Any]],
    draws: int = 100,
    seed: int = 0,
    protocol: Protocol = DEFAULT,
    gg: GasGenerator | None = None,
    *,
    points: int = 4,
) -> list[dict[str, Any]]:
    """Return the information limit as one thing of the protocol is changed at a time.

    Parameters
    ----------
    changes : values by field of :class:`Protocol`, such as ``{"after": [0.5, 1, 2, 4]}``.
    draws, seed, points, gg : see :func:`information_limit`.
    """
    rows = []
    for name, values in changes.items():
        for value in values:
            p = dataclasses.replace(protocol, **{name: value})
            r = information_limit(draws, seed, p, gg, points=points)
            rows.append({"change": name, "value": value, "kappa": r["kappa"],
                         "kappa_95": r["kappa_95"], "n": r["n"]})  # fmt: skip
    return rows


STUDIES: dict[str, tuple[Protocol, bool]] = {
    "watched": (DEFAULT, False),
    "watched, another engine": (DEFAULT, True),
    "no history": (SNAPSHOT, False),
    "no history, baseline known to 0.3": (dataclasses.replace(SNAPSHOT, baseline=0.3), False),
}
"""By name: the protocol, and whether the simulated engines differ from the classifiers'."""
SWEEPS: tuple[tuple[str, Protocol, dict[str, Sequence[Any]]], ...] = (
    (
        "watched",
        DEFAULT,
        {
            "after": [0.1, 0.2, 0.5, 1.0, 2.0, 4.0],
            "before": [0.2, 0.5, 1.0, 2.0, 4.0],
            "noise": [1.0, 2.0, 4.0, 8.0, 16.0],
            "electrical": [True, False],
        },
    ),
    (
        "no history",
        SNAPSHOT,
        {
            "baseline": [0.05, 0.1, 0.2, 0.3, 0.5, 1.0],
            "after": [0.5, 2.0, 8.0],
            "electrical": [True, False],
        },
    ),
)
"""What the information limit is computed over."""


def run(
    n: int = 50,
    seed0: int = 1000,
    *,
    studies: Sequence[str] = tuple(STUDIES),
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, Any]:
    """Run the studies, and how the information limit depends on what is measured.

    Parameters
    ----------
    n, seed0 : see :func:`isolation_study`.
    studies : of :data:`STUDIES`.
    progress : called with (done, total) windows of each study.

    Returns
    -------
    ``studies`` and ``sweeps``, by name.

    Raises
    ------
    ParameterError : unknown study.
    """
    gg = GasGenerator()
    others = [variant(gg, change) for change in VARIANTS.values() if change]
    done: dict[str, Any] = {}
    for name in studies:
        if name not in STUDIES:
            raise ParameterError(f"unknown study {name!r} {nearest(name, STUDIES)}")
        protocol, other = STUDIES[name]
        done[name] = isolation_study(
            n, seed0, protocol, gg=gg, truth=others if other else (), progress=progress
        )
    swept = {
        name: sweep(changes, seed=seed0, protocol=protocol, gg=gg)
        for name, protocol, changes in SWEEPS
    }
    return {"studies": done, "sweeps": swept}


def figures(result: Mapping[str, Any]) -> dict[str, Any]:
    """Draw what :func:`run` returned: confusion matrices, and kappa over what is measured.

    Returns
    -------
    Figures by name: ``isolation_confusion``, ``isolation_limit``.
    """
    from apu_casadi.isolationplot import plot_confusion, plot_kappa

    studies, sweeps = result["studies"], result["sweeps"]
    best, hard = studies["watched"], studies["no history, baseline known to 0.3"]
    panels = [
        ("fault begins under watch: bank", best["bank"]),
        ("no history, baseline to 0.3: bank", hard["bank"]),
        ("the same: information limit", hard["limit"]),
    ]
    n = best["bank"]["n"]
    note = (
        f"True class by row, given class by column, per cent of the true class; κ with 95 % "
        f"interval, {n} fresh windows for each classifier. The information limit is Bayes' rule "
        "where it is exact: linear, Gaussian, all priors known."
    )
    labels = {
        ("watched", "after"): ("after the latest onset", "s"),
        ("watched", "before"): ("before the earliest onset", "s"),
        ("watched", "noise"): ("sensor noise", "factor on the table"),
        ("no history", "baseline"): ("no history: baseline", "factor on wear and gain errors"),
    }
    curves = [
        (head, unit, [r for r in sweeps[study] if r["change"] == change])
        for (study, change), (head, unit) in labels.items()
    ]
    return {
        "isolation_confusion": plot_confusion(panels, note),
        "isolation_limit": plot_kappa(
            curves,
            "Information limit of eleven classes: kappa of Bayes' rule in the linear problem with "
            "95 % interval; all else as in the protocol. Dashed: 0.8.",
        ),
    }


def main() -> None:
    """Run the studies from the shell; results as JSON, figures beside them."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--n", type=int, default=50, help="windows of each class (50)")
    parser.add_argument("--seed0", type=int, default=1000, help="first seed (1000)")
    parser.add_argument("--study", action="append", choices=list(STUDIES), help="only this one")
    parser.add_argument("--out", type=Path, help="write the results here, as JSON")
    args = parser.parse_args()

    def tell(done: int, total: int) -> None:
        if done % 50 == 0 or done == total:
            print(f"{done} of {total} windows", file=sys.stderr, flush=True)

    result = run(args.n, args.seed0, studies=args.study or tuple(STUDIES), progress=tell)
    for name, r in result["studies"].items():
        kappas = ", ".join(f"{m} {r[m]['kappa']:.3f}" for m in (*METHODS, "limit"))
        print(f"{name}: kappa {kappas}")
    if args.out is not None:
        args.out.write_text(json.dumps(result, indent=1), encoding="utf-8")
        if not args.study:
            for name, fig in figures(result).items():
                fig.savefig(args.out.with_name(f"{name}.png"))


if __name__ == "__main__":
    main()
