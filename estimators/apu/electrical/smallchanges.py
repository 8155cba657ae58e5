"""Severities and offsets that change by less than what constant errors hide.

Gain errors of half a per cent leave a severity uncertain by 5e-5 however long it is seen.  But they
are constant: of two windows i, j of a filter that considers them, c, its beliefs are

    h_i = h + S_i c + n_i,   cov n_i = N_i,   S = cov(h, c) cov(c)^-1,   N = cov(h) - S cov(c) S',

so that h_i - h_j has the covariance N_i + N_j + (S_i - S_j) cov(c) (S_i - S_j)': 1e-5 at a steady
load, and more by what a step of load turns the sensitivities.  That the n are correlated makes it
less.  One phase is tested with no change of the other two, beside what all three have in common.

A current's sensor whose offset changes shows in the mean over whole periods; a machine gives a
direct current for some milliseconds after a step of its load, and none that lasts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from estimators.apu.electrical.electricalside import SETTLED, Beliefs, ElectricalSide
from estimators.apu.electrical.hypotheses import COMMON
from estimators.apu.electrical.terminalsignals import PHASES_I, PHASES_V
from estimators.apu.electrical.tuning import FAULT_LEVEL
from estimators.apu.sensors import SensorSet

__all__ = ["OffsetStep", "change_statistic", "offset_steps", "severity_changes"]

LAGS = (1, 2, 5, 10, 20)  # windows between the two that are compared
PERIODS = 10  # electrical periods over which an offset is averaged
OFFSET = 8.0  # standard deviations of its change
LASTING = 3  # windows in which it is there


def change_statistic(of: Beliefs, lag: int) -> np.ndarray:
    """Return what each severity rose by in ``lag`` windows over its standard deviation, (3, n).

    0 where there is no window so long before.
    """
    n = len(of.mean)
    out = np.zeros((3, n))
    known = of.cov[:, 4:, 4:]
    if not known.shape[1] or n <= lag + SETTLED:
        return out
    S = of.cov[:, :3, 4:] @ np.linalg.pinv(known, hermitian=True)
    N = of.cov[:, :3, :3] - S @ of.cov[:, 4:, :3]
    i, j = slice(SETTLED + lag, n), slice(SETTLED, n - lag)
    turned = S[i] - S[j]
    D = N[i] + N[j] + turned @ known[i] @ turned.transpose(0, 2, 1) + COMMON**2 / 3
    info = np.linalg.inv(D)
    d = of.mean[i, :3] - of.mean[j, :3]
    score = np.einsum("nkl,nl->kn", info, d)
    out[:, i] = score / np.sqrt(np.diagonal(info, axis1=1, axis2=2).T)
    return out


def severity_changes(side: ElectricalSide) -> list[tuple[int, int, int]]:
    """Return the rises of a severity that errors of gains do not explain, the first of each.

    Returns:
        Instants of the estimate, (by which it is sure, after which it came), and the phase, from 0.
    """
    if side.beliefs is None:
        return []
    out: list[tuple[int, int, int]] = []
    n, begin = len(side.beliefs.mean), 0
    z = np.array([change_statistic(side.beliefs, lag) for lag in LAGS])  # (lags, 3, n)
    # where one falls, the other two rise by half against what all have in common
    z[np.broadcast_to((z.max(1) < -z.min(1))[:, None], z.shape)] = 0.0
    while True:
        now = z.copy()
        for row, lag in zip(now, LAGS, strict=True):
            row[:, : min(begin + lag, n)] = 0.0
        over = np.flatnonzero(now.max((0, 1)) > math.sqrt(FAULT_LEVEL))
        if not over.size:
            return out
        k = int(over[0])
        at, phase = divmod(int(now[:, :, k].argmax()), now.shape[1])
        out.append((k + 1, k + 1 - LAGS[at], phase))
        begin = k


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
        y = samples[n][: W * per].reshape(W, per)
        if np.isfinite(y).all():
            found += _stepped(n, t, y, basis, sensors.sigma(n, 0.0) / math.sqrt(per))
    return found if len(found) == 1 and found[0].name in PHASES_I else []


def _stepped(
    name: str, t: np.ndarray, y: np.ndarray, basis: np.ndarray, sigma: float
) -> list[OffsetStep]:
    """The largest lasting change of the mean of windows, (W, per), beside the fundamental."""
    turned = basis.transpose(0, 2, 1)
    fit = np.linalg.solve(turned @ basis, turned @ y[:, :, None])
    c, (W, per) = fit[:, 0, 0], y.shape
    inside = range(LASTING, W - LASTING)
    size = [np.median(c[k + 1 : k + 1 + LASTING]) - np.median(c[k - LASTING : k]) for k in inside]
    most = int(np.argmax(np.abs(size)))
    k, by = inside[most], float(size[most])
    if abs(by) < OFFSET * max(sigma, float(np.median(np.abs(np.diff(c))))):
        return []
    # within the windows about it: where the sum of what is left turns
    some = slice((k - 2) * per, (k + 3) * per)
    left = (y - (basis[:, :, 1:] @ fit[:, 1:])[:, :, 0]).ravel()[some]
    turn = np.cumsum(left - np.median(c[k - LASTING : k]) - by / 2) * math.copysign(1.0, by)
    at = min(int(turn.argmin()) + 1, left.size - 1)
    return [OffsetStep(name, float(t[some][at]), by)]
