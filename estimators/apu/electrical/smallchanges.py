"""Severities and offsets that change by less than what constant errors hide.

Gain errors of half a per cent leave a severity uncertain by 5e-5 however long it is seen.  But they
are constant: of two windows i, j of a filter that considers them, c, its beliefs are

    h_i = h + S_i c + n_i,   cov n_i = N_i,   S = cov(h, c) cov(c)^-1,   N = cov(h) - S cov(c) S',

so that h_i - h_j has the covariance N_i + N_j + (S_i - S_j) cov(c) (S_i - S_j)': 1e-5 at a steady
load, and more by what a step of load turns the sensitivities.  Means of windows are compared, as if
their n were independent; these allow for severities that walk, and at 10 to 225 kW, with a step of
load or without, the statistic's root mean square is 0.5 to 0.8 in healthy runs (12 of each load,
seeds 20 to 25).  One phase is tested with no change of the other two, beside what all three have in
common.

A current's sensor whose offset changes shows in the mean over whole periods; a machine gives a
direct current for some milliseconds after a step of its load, and none that lasts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from estimators.apu.electrical.hypotheses import COMMON
from estimators.apu.electrical.terminalsignals import PHASES_I, PHASES_V
from estimators.apu.electrical.tuning import FAULT_LEVEL
from estimators.apu.sensors import SensorSet

__all__ = [
    "Beliefs",
    "OffsetStep",
    "change_statistic",
    "following",
    "offset_steps",
    "severity_changes",
]

BEFORE, FEWEST = 10, 3  # the earlier windows: at most, and at least
#: Windows between what is compared, number of the later ones whose mean is, and most of the earlier
#: ones: more of them tell more of a slow rise, and less for as long after a step of load.
PAIRS = (
    *((1, 1, BEFORE), (2, 1, BEFORE), (3, 2, BEFORE), (5, 2, BEFORE)),
    *((6, 3, 2 * BEFORE), (10, 5, BEFORE), (20, 10, BEFORE)),
)
START = 5  # windows after which the filters have settled
#: Statistic of a change that is followed, and of what it moves a severity by in a window, how many
#: times that may still be missing: the filter that considers gains follows within some windows.
SEEN, BEHIND = 3.0, 4.0
PERIODS = 10  # electrical periods over which an offset is averaged
OFFSET = 8.0  # standard deviations of its change
LASTING = 3  # windows in which it is there
GAPS = 0.02  # share of missing samples, each of which adds some hundredths of an ampere


class Beliefs(NamedTuple):
    """Joint beliefs at the ends of n windows.

    Args:
        names: severities ``h_a``, mean power ``P``, W, and errors that the filter considers.
        mean, cov: of these, (n, m) and (n, m, m).
    """

    names: tuple[str, ...]
    mean: np.ndarray
    cov: np.ndarray


def change_statistic(
    of: Beliefs, lag: int, width: int, before: int = BEFORE, first: int = START
) -> np.ndarray:
    """Return what each severity rose by over the standard deviation of that, (3, n).

    The mean of ``width`` windows is compared with that of up to ``before``, ``FEWEST`` at least,
    of which the last is ``lag`` before the last of the others.  0 where there are not so many.

    Args:
        of: beliefs at the ends of n windows.
        lag, width, before: numbers of windows.
        first: window from which on they are looked at.
    """
    n = len(of.mean)
    out = np.zeros((3, n))
    known = of.cov[:, 4:, 4:]
    k = np.arange(max(first, 0) + lag + max(width - lag, FEWEST) - 1, n)
    if not known.shape[1] or not k.size:
        return out
    S = of.cov[:, :3, 4:] @ np.linalg.pinv(known, hermitian=True)
    N = of.cov[:, :3, :3] - S @ of.cov[:, 4:, :3]
    ends = (k - width, k), (np.maximum(k - lag - before, first - 1), k - lag)

    def changed(x: np.ndarray) -> np.ndarray:
        late, early = (_mean(x, a, b) for a, b in ends)
        return np.asarray(late - early)

    turned = changed(S)
    spread = sum(_mean(N, a, b) / (b - a + np.zeros_like(k))[:, None, None] for a, b in ends)
    D = spread + turned @ known[k] @ turned.transpose(0, 2, 1) + COMMON**2 / 3
    info = np.linalg.inv(D)
    score = np.einsum("nkl,nl->kn", info, changed(of.mean[:, :3]))
    out[:, k] = score / np.sqrt(np.diagonal(info, axis1=1, axis2=2).T)
    return out


def _mean(x: np.ndarray, after: np.ndarray, upto: np.ndarray) -> np.ndarray:
    """Means of x over after < k <= upto, along its first axis."""
    total = np.concatenate([np.zeros((1, *x.shape[1:])), np.cumsum(x, axis=0)])
    n = (upto - after).reshape(-1, *[1] * (x.ndim - 1))
    return np.asarray((total[upto + 1] - total[after + 1]) / n)


def severity_changes(of: Beliefs | None) -> list[tuple[int, int, int]]:
    """Return the rises of a severity that errors of gains do not explain, the first of each.

    Args:
        of: beliefs at the ends of the windows; None: of a filter without severities.

    Returns:
        Instants of the estimate, (by which it is sure, after which it came), and the phase, from 0.
    """
    out: list[tuple[int, int, int]] = []
    begin = START
    while of is not None:
        z = np.array([change_statistic(of, *pair, begin) for pair in PAIRS])
        # where one falls, the other two rise by half against what all have in common
        z[np.broadcast_to((z.max(1) < -z.min(1))[:, None], z.shape)] = 0.0
        over = np.flatnonzero(z.max((0, 1)) > math.sqrt(FAULT_LEVEL))
        if not over.size:
            break
        begin = int(over[0])
        at, i = divmod(int(z[:, :, begin].argmax()), z.shape[1])
        after = begin - PAIRS[at][0]
        # one that goes on is one; what all have in common creeps
        own = of.mean[:, i] - of.mean[:, :3].mean(1)
        if not (out and out[-1][2] == i and 2 * own[after] > own[out[-1][0] - 1]):
            out.append((begin + 1, after + 1, i))
    return out


def following(of: Beliefs, h: np.ndarray) -> np.ndarray:
    """Return by how much severities may be behind a change that is seen, (3, K).

    Args:
        of: beliefs at the ends of K - 1 windows.
        h: severities at K instants, (3, K).
    """
    z = np.abs(change_statistic(of, 1, 1))
    out = np.zeros_like(h)
    out[:, 1:] = BEHIND * np.abs(np.diff(h, axis=1)) * (z > SEEN)
    return out


class OffsetStep(NamedTuple):
    """A current's sensor whose offset changed: its name, when, s, and by how much, A."""

    name: str
    t: float
    size: float


def offset_steps(samples: Mapping[str, np.ndarray], sensors: SensorSet) -> list[OffsetStep]:
    """Return the phase current whose offset changed most, and for good; none that is small.

    Nor where that of another one, or of a voltage, did as well: that is no sensor's error.

    Args:
        samples: evenly, as the electrical filter takes them.
        sensors: with their own noise.
    """
    t, w = samples["t"], np.nan_to_num(samples["w_r"], nan=float(np.nanmedian(samples["w_r"])))
    step = float(np.median(np.diff(t)))
    per = round(PERIODS * 2 * math.pi / float(np.median(w)) / step)
    W = t.size // per
    if W < 2 * LASTING + 1:
        return []
    angle = np.concatenate([[0.0], np.cumsum(w[:-1] * np.diff(t))])[: W * per].reshape(W, per)
    basis = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)], axis=2)
    found = []
    for n in (*PHASES_I, *PHASES_V):
        y, there = samples[n][: W * per], np.isfinite(samples[n][: W * per])
        if (~there).mean() > GAPS:
            continue
        y = np.interp(t[: W * per], t[: W * per][there], y[there]).reshape(W, per)
        found += _stepped(n, t, y, basis, sensors.sigma(n, 0.0) / math.sqrt(per))
    return found if len(found) == 1 and found[0].name in PHASES_I else []


def _stepped(
    name: str, t: np.ndarray, y: np.ndarray, basis: np.ndarray, sigma: float
) -> list[OffsetStep]:
    """The largest lasting change of the mean of windows, (W, per), beside the fundamental."""
    turned = basis.transpose(0, 2, 1)
    fit = np.linalg.solve(turned @ basis, turned @ y[:, :, None])
    c, per = fit[:, 0, 0], y.shape[1]
    level = np.median(sliding_window_view(c, LASTING), axis=1)  # from each window on
    size = level[LASTING + 1 :] - level[: -LASTING - 1]  # after and before the windows between
    most = int(np.argmax(np.abs(size)))
    k, by = most + LASTING, float(size[most])
    if abs(by) < OFFSET * max(sigma, float(np.median(np.abs(np.diff(c))))):
        return []
    # within the windows about it: where the sum of what is left turns
    some = slice((k - 2) * per, (k + 3) * per)
    left = (y - (basis[:, :, 1:] @ fit[:, 1:])[:, :, 0]).ravel()[some]
    turn = np.cumsum(left - np.median(c[k - LASTING : k]) - by / 2) * math.copysign(1.0, by)
    at = min(int(turn.argmin()) + 1, left.size - 1)
    return [OffsetStep(name, float(t[some][at]), by)]
