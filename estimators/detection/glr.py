"""The generalised likelihood ratio of jumps, whose size and onset are estimated.

Willsky and Jones (1976), IEEE Trans. Automatic Control 21, 108-112, on the signatures of
:mod:`estimators.detection.signatures`.  The threshold keeps the stated rate of false alarms by
simulation with a fitted tail (:func:`glr_threshold`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize, signal

from apu_casadi.core.errors import ParameterError, SignalError
from estimators.detection.alarms import Alarms, allowed_per_sample, rising
from estimators.detection.signatures import LinearFilter, columns_of

__all__ = ["Glr", "glr", "glr_stationary", "glr_statistic", "glr_test", "glr_threshold"]


@dataclass(frozen=True, eq=False)
class Glr:
    """Evidence for jumps at several onsets, as it stands at the end of the samples.

    The log-likelihood gained by jumps of sizes s is b's - s'Cs/2.

    Args:
        names: of the q jumps.
        onsets: samples, (m,).
        b: (m, q). C : information, (m, q, q).
    """

    names: tuple[str, ...]
    onsets: np.ndarray
    b: np.ndarray
    C: np.ndarray

    def part(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return b and C of some jumps.

        Raises:
            SignalError: unknown name.
        """
        i = columns_of(names, self.names)
        return self.b[:, i], self.C[:, i][:, :, i]

    def size(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return the most likely sizes (m, n) and their covariances (m, n, n), at each onset."""
        b, C = self.part(names)
        P = np.linalg.inv(C)
        return np.einsum("kij,kj->ki", P, b), P

    def statistic(self, names: Sequence[str]) -> np.ndarray:
        """Return the logarithm of the likelihood ratio with the most likely sizes, (m,)."""
        b, C = self.part(names)
        return np.asarray(np.einsum("ki,ki->k", b, np.linalg.solve(C, b[:, :, None])[:, :, 0]) / 2)

    def log_marginal(self, names: Sequence[str], mean: Any, cov: Any) -> np.ndarray:
        """Return the logarithm of the ratio of marginal likelihoods, sizes normal, (m,).

        Args:
            mean, cov: prior of the sizes, (n,) and (n, n): the penalty that a maximum lacks.
        """
        b, C = self.part(names)
        mean, cov = np.asarray(mean, float), np.asarray(cov, float)
        # about the prior mean: b's - s'Cs/2 with s = mean + d
        at = C @ mean
        gain = b @ mean - 0.5 * at @ mean
        b = b - at
        n = len(names)
        M = np.eye(n) + cov @ C
        post = np.linalg.solve(M, (cov @ b[:, :, None]))[:, :, 0]
        return np.asarray(
            gain + 0.5 * np.einsum("ki,ki->k", b, post) - 0.5 * np.linalg.slogdet(M)[1]
        )


def glr(filter: LinearFilter, onsets: Sequence[int] | np.ndarray, stop: int | None = None) -> Glr:
    """Gather the evidence for jumps at each of several onsets, up to ``stop``.

    Args:
        filter: innovations, and where jumps enter.
        onsets: samples at which a jump may have happened.
        stop: samples k < stop are used; all by default.

    Raises:
        ParameterError: no onsets, or one outside the samples.
    """
    at = np.asarray(onsets, int)
    end = filter.size if stop is None else stop
    if at.ndim != 1 or at.size == 0 or at.min() < 0 or at.max() >= end:
        raise ParameterError(f"onsets must lie within the samples 0 to {end - 1}, got {at!r:.80}")
    nx, q = filter.state.shape
    b, C = np.zeros((at.size, q)), np.zeros((at.size, q, q))
    e = np.zeros((at.size, nx, q))
    f = filter
    for k in range(int(at.min()), end):
        e[at == k] = f.state
        on = at <= k
        g = f.H[k] @ e[on] + f.output[k]
        weighted = np.linalg.solve(f.S[k], g)
        b[on] += np.einsum("miq,i->mq", weighted, f.innovation[k])
        C[on] += weighted.transpose(0, 2, 1) @ g
        e[on] = f.A[k] @ e[on] - f.L[k] @ g + f.drift[k]
    return Glr(f.names, at, b, (C + C.transpose(0, 2, 1)) / 2)


def glr_statistic(
    filter: LinearFilter, name: str, window: int, every: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Return the likelihood ratio's logarithm for one jump, at each sample over recent onsets.

    Args:
        filter: innovations, and where jumps enter.
        name: of the jump.
        window: samples; onsets further back are forgotten.
        every: samples between the onsets that are tried.

    Returns:
        (largest b^2/(2 C), its onset) at each sample, shapes (K,).

    Raises:
        SignalError: unknown jump. ParameterError : window or spacing < 1.
    """
    (c,) = filter.columns([name])
    if window < 1 or every < 1:
        raise ParameterError(f"window and every must be >= 1, got {window!r} and {every!r}")
    f = filter
    slots = -(-window // every)
    nx = f.state.shape[0]
    b, C, e = np.zeros(slots), np.zeros(slots), np.zeros((slots, nx, 1))
    onset = np.full(slots, -1)
    best, where = np.zeros(f.size), np.zeros(f.size, int)
    state = f.state[:, [c]]
    for k in range(f.size):
        if k % every == 0:
            i = (k // every) % slots  # the oldest onset gives way
            b[i], C[i], e[i], onset[i] = 0.0, 0.0, state, k
        g = f.H[k] @ e + f.output[k][:, [c]]
        weighted = np.linalg.solve(f.S[k], g)
        b += weighted[:, :, 0] @ f.innovation[k]
        C += (weighted * g)[:, :, 0].sum(1)
        e = f.A[k] @ e - f.L[k] @ g + f.drift[k][:, [c]]
        on = (onset >= 0) & (C > 0)
        ratio = np.where(on, b**2 / (2 * np.where(on, C, 1.0)), 0.0)
        i = int(np.argmax(ratio))
        best[k], where[k] = ratio[i], max(onset[i], 0)
    return best, where


def glr_test(
    filter: LinearFilter,
    name: str,
    *,
    window: int,
    false_alarms_per_hour: float,
    rate: float,
    every: int = 1,
    start: float = 0.0,
    threshold: float | None = None,
    samples: int = 500_000,
) -> Alarms:
    """Watch a filter's innovations for one jump of unknown size, sign and onset.

    Args:
        filter: innovations, and where jumps enter.
        name: of the jump.
        window, every: see :func:`glr_statistic`.
        false_alarms_per_hour: stated rate, kept by a filter that has settled.
        rate: samples per second.
        start: time of the first sample, s.
        threshold: if it is known already; otherwise from :func:`glr_threshold` with the signature
            at the end of the samples.
        samples: of that simulation.

    Raises:
        SignalError, ParameterError: see :func:`glr_statistic` and :func:`glr_threshold`; fewer
            samples than the window.
    """
    (c,) = filter.columns([name])
    if threshold is None:
        first = filter.size - window
        if first < 0:
            raise ParameterError(
                f"a signature of {window} samples cannot be had from {filter.size}; give threshold"
            )
        L = np.linalg.inv(np.linalg.cholesky(filter.S[first:]))
        white = (L @ filter.signature(first))[:, :, c]
        lengths = range(every, window + 1, every)
        threshold = glr_threshold(white, lengths, false_alarms_per_hour, rate, samples=samples)[
            "threshold"
        ]
    best, _ = glr_statistic(filter, name, window, every)
    return Alarms(
        f"GLR of {name}",
        best,
        threshold,
        rising(best > threshold),
        rate,
        false_alarms_per_hour,
        start,
    )


def glr_stationary(
    white: np.ndarray, signature: np.ndarray, lengths: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the statistic of :func:`glr_statistic` for a filter that has settled; fast.

    The signature is then the same for every onset, and the evidence for an onset n samples back is
    a matched filter of length n: ten million samples take seconds.

    Args:
        white: innovations multiplied by S^(-1/2), (K, ny): white, of unit variance.
        signature: what a unit jump adds to them, in the same units, (M, ny), from its onset on.
        lengths: ages of the onset that are tried, samples, at most M.

    Returns:
        (largest b^2/(2 C) over the ages, the age) at each sample, shapes (K,).  An age is not tried
        before as many samples have come.

    Raises:
        ParameterError: a length outside 1 to M. SignalError : shapes that do not fit.
    """
    white, signature = np.asarray(white, float), np.asarray(signature, float)
    if white.ndim != 2 or signature.ndim != 2 or white.shape[1] != signature.shape[1]:
        raise SignalError(f"(K, ny) and (M, ny) expected, got {white.shape}, {signature.shape}")
    K, M = white.shape[0], signature.shape[0]
    if not lengths or min(lengths) < 1 or max(lengths) > M:
        raise ParameterError(f"lengths must lie from 1 to {M}, got {list(lengths)!r:.80}")
    best, age = np.zeros(K), np.zeros(K, int)
    for n in lengths:
        if n > K:
            continue
        g = signature[:n]
        C = float(np.sum(g**2))
        if C == 0:
            continue
        b = sum(signal.oaconvolve(white[:, i], g[::-1, i])[n - 1 : K] for i in range(g.shape[1]))
        ratio = np.asarray(b) ** 2 / (2 * C)
        better = ratio > best[n - 1 :]
        best[n - 1 :] = np.where(better, ratio, best[n - 1 :])
        age[n - 1 :][better] = n
    return best, age


def glr_threshold(
    signature: np.ndarray,
    lengths: Sequence[int],
    false_alarms_per_hour: float,
    rate: float,
    *,
    samples: int = 2_000_000,
    seed: int = 0,
) -> dict[str, float]:
    """Return the threshold of :func:`glr_stationary` for a stated false-alarm rate.

    White noise is simulated, and the rate of up-crossings fitted as A c^B exp(-c), the form of the
    tail of a maximum over correlated chi-squared values; the threshold lies on the fitted tail,
    mostly beyond what was simulated.

    Args:
        signature, lengths: see :func:`glr_stationary`.
        false_alarms_per_hour: up-crossings in an hour without a change.
        rate: samples per second.
        samples, seed: of the simulation.

    Returns:
        ``threshold``; ``sigma``, its standard deviation from the simulation's eight parts; ``A``
        and ``B`` of the tail (for each sample); ``largest``, the level up to which the tail was
        seen.

    Raises:
        ParameterError: rates, too few samples (< 1e5), or lengths outside the signature.
    """
    allowed = allowed_per_sample(false_alarms_per_hour, rate)
    if samples < 100_000:
        raise ParameterError(f"at least 1e5 samples are needed for a tail, got {samples!r}")
    rng = np.random.default_rng(seed)
    parts = 8
    n = samples // parts
    ny = np.shape(signature)[1]
    peaks = []
    for _ in range(parts):
        ratio, _ = glr_stationary(rng.standard_normal((n, ny)), signature, lengths)
        peaks.append(ratio[max(lengths) :])
    levels = np.arange(2.0, 40.0, 0.25)
    crossings = np.array([[np.sum((r[1:] > c) & (r[:-1] <= c)) for c in levels] for r in peaks])

    def fit(count: np.ndarray, size: float) -> tuple[float, float, float, float]:
        """(threshold, log A, B, largest level): weighted by the counts, from where crossings
        are rare enough to be clumps."""
        use = (count >= 20) & (count < 0.005 * size)
        if use.sum() < 4:
            raise ParameterError(f"{samples} samples show too little of the tail; take more")
        c, w = levels[use], np.sqrt(count[use])
        target = np.log(count[use] / size) + c
        B, a = np.polyfit(np.log(c), target, 1, w=w)
        low, top = 1.0, 10.0

        def gap(v: float) -> float:
            return float(a + B * math.log(v) - v - math.log(allowed))

        low = max(low, float(B))  # beyond its maximum the tail falls
        while gap(top) > 0:
            top *= 1.5
        if gap(low) <= 0:
            raise ParameterError(
                f"{false_alarms_per_hour:g} false alarms an hour are more than there are crossings"
            )
        return float(optimize.brentq(gap, low, top)), float(a), float(B), float(c[-1])

    size = float(sum(r.size - 1 for r in peaks))
    threshold, a, B, largest = fit(crossings.sum(0), size)
    # leave one part out in turn: the jackknife
    left = [
        fit(crossings.sum(0) - crossings[i], size * (parts - 1) / parts)[0] for i in range(parts)
    ]
    sigma = math.sqrt((parts - 1) / parts * float(np.sum((np.array(left) - np.mean(left)) ** 2)))
    return {"threshold": threshold, "sigma": sigma, "A": math.exp(a), "B": B, "largest": largest}
