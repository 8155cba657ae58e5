"""Symmetrical components of measured waveforms, window by window, and whether they change.

What three currents (or voltages) tell without a model of the machine: in each window a sinusoid is
fitted to each phase, and with a = exp(2 pi i/3), by Fortescue (1918),

    X_1 = (X_a + a X_b + a^2 X_c)/3,  X_2 = (X_a + a^2 X_b + a X_c)/3,  X_0 = (X_a + X_b + X_c)/3.

X_2/X_1 does not depend on where a window begins.  A short circuit between turns changes it, and so
do an unbalanced load and a wrong gain: it is no severity.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from apu_casadi.core.errors import DataError
from apu_casadi.core.means import fortescue

__all__ = ["WINDOW", "Sequences", "fitted", "sequences"]

WINDOW = 0.1  # s, but PERIODS periods at least
PERIODS = 4
LEAST = 8  # windows of the reference
FEW = 8  # samples of a period below which those that a transducer clips are missed
POOR = 1.05  # error over that of as many even samples, from which they are
TOGETHER = 64  # windows that are fitted at once
MARGIN = 1.5  # on the threshold: the spread itself is estimated
TURN = np.exp(2j * math.pi / 3)


@dataclass(frozen=True, eq=False)
class Sequences:
    """Symmetrical components by window, amplitudes.

    Args:
        t: ends of the windows, s, (n,).
        frequency: of each window, Hz, (n,).
        components: positive, negative and zero sequence, complex, (3, n).
        sigma: standard deviation of either part of X_2/X_1 by what the sinusoids leave, (n,).
        reference: windows of the beginning that later ones are compared with; 0: too few for that.
        alarms: ends of the windows in which a change of X_2/X_1 is found, one for each change, s.
    """

    t: np.ndarray
    frequency: np.ndarray
    components: np.ndarray
    sigma: np.ndarray
    reference: int
    alarms: tuple[float, ...]

    @property
    def unbalance(self) -> np.ndarray:
        """X_2/X_1 by window, complex."""
        return np.asarray(self.components[1] / self.components[0])


def sequences(t: np.ndarray, phases: np.ndarray, *, rate: float = 1.0) -> Sequences:
    """Find the symmetrical components of three phases.

    Args:
        t: instants, s, (K,).
        phases: samples of phases a, b, c, NaN where there is none, (3, K); each phase's own
            samples are used.
        rate: false alarms an hour on a stationary machine, at most.

    Raises:
        DataError: too short, or no sinusoid in it.
    """
    there = np.isfinite(phases).any(axis=0)
    t, x = np.asarray(t, float)[there], np.asarray(phases, float)[:, there]
    if _fewest(x) < 16:
        raise DataError(f"{_fewest(x)} samples of one of the phases: 16 are needed at least")
    f = _frequency(t, x)
    length = max(WINDOW, PERIODS / f)
    n = int((t[-1] - t[0]) / length * (1 + 1e-9))
    if n < 1:
        raise DataError(f"{t[-1] - t[0]:.3g} s hold no window of {length:.3g} s")
    edges = np.searchsorted(t, t[0] + length * np.arange(n + 1) - 1e-9)
    rows = [(i, j) for i, j in pairwise(edges) if _fewest(x[:, i:j]) >= 16]
    if not rows:
        raise DataError("no window has 16 samples of all three phases")
    if f * float(np.median(np.diff(t))) * FEW > 1:
        rows = [(i, j) for i, j in rows if _even(t[i:j], x[:, i:j], f)]
    if not rows:
        raise DataError(
            f"of less than {FEW} samples a period so many are missing at the same angles, clipped "
            "for instance, that the rest tells no sinusoid"
        )
    freq, parts, sigma = _windows(t, x, rows, f)
    ends = np.array([t[j - 1] for _, j in rows])
    ratio = parts[:, 1] / parts[:, 0]
    reference, alarms = _changes(ratio, sigma, rate * length / 3600)
    return Sequences(ends, freq, parts.T, sigma, reference, tuple(float(ends[k]) for k in alarms))


def _frequency(t: np.ndarray, x: np.ndarray) -> float:
    """Frequency of the largest line of the space vector, Hz."""
    step = float(np.median(np.diff(t)))
    even = np.arange(t[0], t[-1], step)[: 1 << 16]
    own = [(t[np.isfinite(v)], v[np.isfinite(v)]) for v in x]
    space = sum(np.interp(even, *tv) * TURN**k for k, tv in enumerate(own))
    space = (space - space.mean()) * np.hanning(even.size)
    size = np.abs(np.fft.fft(space, 4 * even.size))
    f = float(abs(np.fft.fftfreq(size.size, step)[int(size.argmax())]))
    if not size.max() > 0 or f * (t[-1] - t[0]) < PERIODS:
        raise DataError(f"no alternating quantity: its largest line is at {f:.3g} Hz")
    return f


def _phasors(t: np.ndarray, x: np.ndarray, f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Symmetrical components of a sinusoid in each phase, and what it leaves, rms; by window."""
    w = 2 * math.pi * f[:, None] * (t - t[:, :1])
    basis = np.stack([np.cos(w), -np.sin(w), np.ones_like(w)], axis=2)
    turned, y = basis.transpose(0, 2, 1), x.transpose(0, 2, 1)
    if np.isfinite(x).all():  # well conditioned, and faster
        c = np.linalg.solve(turned @ basis, turned @ y)
    else:
        c = np.array([fitted(b, v) for b, v in zip(basis, y, strict=True)])
    parts = np.array(fortescue((c[:, 0] + 1j * c[:, 1]).T)).T
    return parts, np.asarray(np.sqrt(np.nanmean((y - basis @ c) ** 2, axis=(1, 2))))


def _share(t: np.ndarray, x: np.ndarray, f: float) -> float:
    """Standard deviation of either part of a sequence over that of a sample."""
    there = np.isfinite(x)
    if there.all():
        return math.sqrt(2 / x.size)
    basis = _sinusoid(t, f)
    each = [np.linalg.pinv(basis[r].T @ basis[r], hermitian=True) for r in there]
    return math.sqrt(sum(c[0, 0] + c[1, 1] for c in each) / 2) / 3


def _sinusoid(t: np.ndarray, f: float) -> np.ndarray:
    """Return the basis of a phasor and a constant at instants t, s, of frequency f, Hz: (K, 3)."""
    w = 2 * math.pi * f * (t - t[0])
    return np.column_stack([np.cos(w), -np.sin(w), np.ones_like(w)])


def _even(t: np.ndarray, x: np.ndarray, f: float) -> bool:
    """Whether the samples of a window are spread over the period as well as all would be.

    Of few samples a period, 400 Hz at 1 kHz, those that are clipped are always at the same angles;
    what is left beside them is chosen by its noise and may fit any sinusoid.
    """
    basis = _sinusoid(t, f)
    each = [basis[r] for r in np.isfinite(x)]
    if min(np.linalg.matrix_rank(b) for b in each) < basis.shape[1]:
        return False
    return _share(t, x, f) < POOR * math.sqrt(2 / np.isfinite(x).sum())


def fitted(basis: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the least-squares coefficients of each column, of the rows that it has."""
    there = np.isfinite(columns)
    if there.all():
        return np.asarray(np.linalg.lstsq(basis, columns, rcond=None)[0])
    each = [
        np.linalg.lstsq(basis[r], v[r], rcond=None)[0]
        for r, v in zip(there.T, columns.T, strict=True)
    ]
    return np.column_stack(each)


def _fewest(x: np.ndarray) -> int:
    return int(np.isfinite(x).sum(axis=1).min())


def _windows(
    t: np.ndarray, x: np.ndarray, rows: Sequence[tuple[int, int]], f: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Frequency, symmetrical components and noise of X_2/X_1 of all windows.

    Those of one length that lack nothing go together, each with a gap for itself.
    """
    freq, parts, sigma = np.empty(len(rows)), np.empty((len(rows), 3), complex), np.empty(len(rows))
    groups: dict[tuple[int, int], list[int]] = {}
    for k, (i, j) in enumerate(rows):
        alone = k // TOGETHER if np.isfinite(x[:, i:j]).all() else -1 - k
        groups.setdefault((j - i, alone), []).append(k)
    for (n, _), group in groups.items():
        at = np.array([rows[k][0] for k in group])[:, None] + np.arange(n)
        freq[group], parts[group], sigma[group] = _window(t[at], x[:, at].swapaxes(0, 1), f)
    return freq, parts, sigma


def _window(
    t: np.ndarray, x: np.ndarray, begin: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Do what :func:`_windows` does for some of one length, (W, K) and (W, 3, K)."""
    W, K = t.shape
    half, f, every = K // 2, np.full(W, begin), np.arange(W)
    span = t[:, half] - t[:, 0]
    for _ in range(2 if min(_fewest(v) for v in (*x[..., :half], *x[..., half:])) >= 4 else 0):
        first, second = (_phasors(t[:, s], x[..., s], f)[0] for s in (np.s_[:half], np.s_[half:]))
        k = np.abs(first[:, :2]).argmax(1)  # the order of the phases may be the other one
        turned = second[every, k] / first[every, k] * np.exp(-2j * math.pi * f * span)
        f = f + np.angle(turned) / (2 * math.pi * span)
    parts, rest = _phasors(t, x, f)
    other = np.abs(parts[:, 1]) > np.abs(parts[:, 0])
    parts[other] = parts[other][:, [1, 0, 2]]
    share = np.array([_share(*own) for own in zip(t, x, f, strict=True)])
    return f, parts, rest * share / np.maximum(np.abs(parts[:, 0]), 1e-300)


def _changes(ratio: np.ndarray, sigma: np.ndarray, allowed: float) -> tuple[int, list[int]]:
    """Windows of the reference, and the windows in which the ratio has left it, two in a row."""
    n, alarms, begin = max(LEAST, ratio.size // 4), list[int](), 0
    if ratio.size < n + 2:
        return 0, []
    # a complex Gaussian with s in either part exceeds c s with probability exp(-c^2/2)
    level = MARGIN * math.sqrt(2 * math.log(1 / allowed))
    while begin + n + 2 <= ratio.size:
        own = ratio[begin : begin + n]
        middle = complex(np.median(own.real), np.median(own.imag))
        off = np.concatenate([(own - middle).real, (own - middle).imag])
        spread = max(1.4826 * float(np.median(np.abs(off))), float(np.median(sigma)))
        out = np.abs(ratio[begin + n :] - middle) > level * max(spread, 1e-12)
        twice = np.flatnonzero(out[1:] & out[:-1])
        if not twice.size:
            break
        at = begin + n + int(twice[0]) + 1
        alarms.append(at)
        begin = at  # a new reference
    return n, alarms
