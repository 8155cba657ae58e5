"""What a sensor makes of the truth, in the order in which it does: lag, delay, jitter, digits.

    true value -> lag -> delay and jitter of the instant -> gain, offset, noise -> digits -> range

What is not random (lag, delay, expected errors, digits, range) always acts; the rest is drawn.
Gain errors and noise are :meth:`~estimators.apu.sensors.SensorSet.measure`'s.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping

import numpy as np

from estimators.apu.electrical.gaps import evened
from estimators.apu.sensors import Sensor, SensorSet

__all__ = [
    "Draws",
    "disturbed",
    "interpolated",
    "onto",
    "sampled",
    "sampled_wave",
    "slopes",
    "spread",
]

POINTS = 6  # of a local polynomial; of 25 samples a period it is right to 1e-5
FINER = 20  # parts of a step over which a lag shorter than it is integrated
WINDOW = 11  # samples over which a slope is fitted
_KINDS = ("jitter", "bias", "drift")


class Draws:
    """Random numbers of each sensor and error, which hang on nothing but seed and name.

    Args:
        seed: of all of them; None: nothing is drawn.
        machine: number of the generator, 0 for the gas path.
    """

    seed: int | None
    machine: int

    def __init__(self, seed: int | None, machine: int = 0) -> None:
        self.seed, self.machine = seed, machine

    def normal(self, name: str, kind: str, n: int) -> np.ndarray:
        """Return n standard normal numbers; zeros without a seed."""
        if self.seed is None:
            return np.zeros(n)
        key = [self.seed, 3, self.machine, _KINDS.index(kind), zlib.crc32(name.encode())]
        return np.random.default_rng(key).standard_normal(n)

    def jitter(self, s: Sensor, n: int) -> np.ndarray:
        """Return the errors of a sensor's instants, s; sensors of one clock have the same ones."""
        of, name = (Draws(self.seed), f"clock {s.clock}") if s.clock else (self, s.name)
        return s.jitter * of.normal(name, "jitter", n)


def sampled(s: Sensor, time: np.ndarray, v: np.ndarray, t: np.ndarray, of: Draws) -> np.ndarray:
    """Return what it shows at instants of a slow quantity, lag included in ``v``."""
    at = t - s.delay + of.jitter(s, t.size)
    return np.asarray(np.interp(at, time, v))


def sampled_wave(s: Sensor, t: np.ndarray, v: np.ndarray, of: Draws) -> np.ndarray:
    """Return what it shows at the instants of a waveform, evenly sampled, its lag included."""
    if s.tau:
        v = _followed(t, v, s.tau)
    if not (s.delay or s.jitter):
        return v
    at = t - s.delay + of.jitter(s, t.size)
    shown = interpolated(t, v, at)[0]
    shown[(at < 2 * t[0] - t[1]) | (at > 2 * t[-1] - t[-2])] = np.nan  # nothing was there yet
    return shown


def _followed(t: np.ndarray, v: np.ndarray, tau: float) -> np.ndarray:
    """Return the response of a lag at instants, the input between them by local polynomials.

    As :func:`~estimators.apu.sensors.respond` over ``FINER`` even parts of each step.
    """
    part = (t[-1] - t[0]) / (t.size - 1) / FINER
    keep = math.exp(-part / tau)
    late = tau / part * (1 - keep)  # what a ramp's value lacks at the end of a part
    fine, _ = interpolated(t, v, np.linspace(t[0], t[-1], (t.size - 1) * FINER + 1))
    given = (1 - late) * fine[1:] + (late - keep) * fine[:-1]
    driven = given.reshape(-1, FINER) @ keep ** np.arange(FINER)[::-1]
    x, whole = np.array(v, float), keep**FINER
    for k, more in enumerate(driven.tolist()):
        x[k + 1] = whole * x[k] + more
    return x


def disturbed(
    sensors: SensorSet, t: np.ndarray, read: Mapping[str, np.ndarray], of: Draws, *, errors: bool
) -> dict[str, np.ndarray]:
    """Return readings with offsets that drift, in digits, within what the sensors can show.

    Args:
        sensors: the set.
        t: instants, s.
        read: readings with gain errors and noise, by name.
        of: random numbers.
        errors: whether constant offsets are drawn.
    """
    out = {}
    for n, v in read.items():
        s = sensors[n]
        if s.bias or s.drift or s.bias_mean:
            offset = s.bias * float(of.normal(n, "bias", 1)[0]) * errors
            steps = np.sqrt(np.diff(t, prepend=t[0])) * of.normal(n, "drift", t.size)
            v = v + s.bias_mean + offset + s.drift * np.cumsum(steps)
        if s.quantum:
            v = s.quantum * np.round(v / s.quantum)
        v = v - s.turn * np.floor(v / s.turn + 0.5) if s.turn else v
        out[n] = v if s.limits is None else np.clip(v, *s.limits)
    return out


def interpolated(
    t: np.ndarray, v: np.ndarray, at: np.ndarray, *, more: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return v(at) + more dv/dt(at) by local polynomials, and by how much white noise grows.

    Lagrange's formula and its derivative over the ``POINTS`` samples around each instant; where one
    of them is missing there is no value.

    Args:
        t, v: instants, s, and samples, (K,).
        at: instants, s.
        more: s.
    """
    n = min(POINTS, t.size)
    first = np.clip(np.searchsorted(t, at) - n // 2, 0, t.size - n)
    near = first[:, None] + np.arange(n)
    node = t[near]
    weight = np.ones(node.shape)
    slope = np.zeros(node.shape)
    for j in range(n):
        for k in (k for k in range(n) if k != j):
            apart = node[:, j] - node[:, k]
            slope[:, j] = (slope[:, j] * (at - node[:, k]) + weight[:, j]) / apart
            weight[:, j] *= (at - node[:, k]) / apart
    weight += more * slope
    weight[np.abs(weight) < 1e-12] = 0.0
    used = np.where(weight == 0.0, 0.0, v[near])
    return (weight * used).sum(1), np.sqrt((weight**2).sum(1))


def onto(at: np.ndarray, t: np.ndarray, v: np.ndarray, w: float) -> np.ndarray:
    """Return a waveform at other instants; NaN beside gaps, before its first and after its last.

    Args:
        at, t: instants, s: those wanted, and those of its samples v, (K,).
        w: angular frequency, rad/s, by which a long step is a gap.
    """
    a = evened({"t": t, "v": v, "w_r": np.full(t.size, w)})
    shown = interpolated(a["t"], a["v"], at)[0]
    shown[(at < t[0]) | (at > t[-1])] = np.nan
    return shown


def slopes(t: np.ndarray, v: np.ndarray, *, wave: bool) -> np.ndarray:
    """Return how fast readings change, unit/s: of a line through those around, or of a wave's rms.

    Args:
        t, v: instants, s, and readings, NaN where there is none, (K,).
        wave: whether it is the rms over two dozen steps of a quantity that swings.
    """
    if t.size < 3:
        return np.zeros(t.size)
    there = np.isfinite(v)
    v = np.interp(t, t[there], v[there]) if there.any() else np.zeros(t.size)
    if wave:
        rate = (np.diff(v) / np.diff(t)) ** 2
        half = min(WINDOW + 1, (t.size - 1) // 2)
        padded = np.pad(np.append(rate, rate[-1]), half, mode="reflect")
        total = np.append(0.0, np.cumsum(padded))
        n = 2 * half + 1
        return np.asarray(np.sqrt((total[n:] - total[:-n]) / n))
    n = min(WINDOW, t.size)
    first = np.clip(np.arange(t.size) - n // 2, 0, t.size - n)
    near = first[:, None] + np.arange(n)
    x = t[near] - t[near].mean(1, keepdims=True)
    return np.asarray((x * v[near]).sum(1) / (x**2).sum(1))


def spread(s: Sensor, t: np.ndarray, v: np.ndarray, *, wave: bool = False) -> np.ndarray:
    """Return the standard deviation of all that is white in each reading, jitter included."""
    if not s.jitter:
        return np.broadcast_to(s.sigma(v), v.shape)
    constant = np.hypot(s.white(v), s.quantum / math.sqrt(12))
    return np.asarray(np.hypot(constant, s.jitter * slopes(t, v, wave=wave)))
