"""The smoother of interacting models: modes and states given all samples.

What comes after a sample is, to the belief before it, a likelihood.  In each mode i at k+1 it is
taken for a Gaussian one, found by division: the smoothed belief over the mixed prediction that the
filter entered the sample with.  It is then a sample of unit noise itself, z = H x + v, and weighs
and corrects the prediction of each mode j at k, before mixing:

    P(j at k, i at k+1 | all) = P(i at k+1 | all) P(j at k | i, all),
    P(j at k | i, all) ~ P(j at k | samples to k) T(j, i) N(z; H m1(j), H P1(j) H' + 1).

From the corrected prediction each pair goes back to k by the gain of Rauch, Tung and Striebel, and
the pairs of one j are merged.  Helmick, Blair and Hoffman (1995), IEEE Trans. Information Theory
41, 1845, and Nadarajah, Tharmarasa, McDonald and Kirubarajan (2012), IEEE Trans. Aerospace and
Electronic Systems 48, 1113, take the future for a Gaussian likelihood of each mode as well.  Taking
the smoothed belief at k+1 as it is for each j, as Kim (1994) does, errs by up to four times as much
where the modes' predictions differ.

Exact with one mode, with modes that never change, and with modes that differ in nothing; in between
as good as merging is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from apu_casadi.core.errors import EstimationError
from estimators.batch.smoother import smoothing_gain
from estimators.filters.imm import ImmResult, ModeBeliefs, log_normalised

__all__ = ["imm_smoother"]

SILENT = 1e-12  # share of a variance that what comes later takes away; below: nothing
Gaussian = tuple[np.ndarray, np.ndarray]


def imm_smoother(filtered: ImmResult) -> ImmResult:
    """Return modes and states given all samples: probabilities, mean, variance, mode_mean.

    Args:
        filtered: of :func:`~estimators.filters.imm.interacting_multiple_models` with ``full=True``.

    Raises:
        EstimationError: the filters did not keep what is needed; a mode's covariance has lost the
            digits that smoothing takes.
    """
    r = filtered
    if r.modes is None or r.log_transition is None:
        raise EstimationError("the smoother needs interacting models run with full=True")
    K, M = r.t.size, len(r.names)
    logs = r.log_probability.copy()
    means = [b.mean.copy() for b in r.modes]
    covs = [b.cov.copy() for b in r.modes]
    for k in range(K - 2, -1, -1):
        gains = [_gain(r, j, k) for j in range(M)]
        pair = r.log_probability[:, k, None] + r.log_transition[k + 1]
        pairs: list[list[Gaussian]] = [[] for _ in range(M)]
        for i, to in enumerate(r.modes):
            carried = [_carried(b, to, k) for b in r.modes]
            weights = np.exp(log_normalised(pair[:, i]))
            H, z = _future(_merged(weights, carried), (means[i][:, k + 1], covs[i][k + 1]))
            for j, b in enumerate(r.modes):
                corrected, evidence = _corrected(carried[j], H, z)
                pair[j, i] += evidence
                pairs[j].append(_back(b, to, k, gains[j], corrected))
        pair = log_normalised(pair) + logs[:, k + 1]
        logs[:, k] = np.logaddexp.reduce(pair, axis=1)
        for j in range(M):
            share = np.exp(pair[j] - logs[j, k])
            means[j][:, k], covs[j][k] = _merged(share, pairs[j])
    mean, variance = _mixture(r, np.exp(logs), means, covs)
    modes = tuple(
        dataclasses.replace(b, mean=m, cov=P) for b, m, P in zip(r.modes, means, covs, strict=True)
    )
    return dataclasses.replace(
        r,
        log_probability=logs,
        mean=mean,
        variance=variance,
        mode_mean=tuple(means),
        modes=modes,
    )


def _gain(r: ImmResult, j: int, k: int) -> np.ndarray:
    """Gain from a mode's prediction of k+1 back to k."""
    assert r.modes is not None
    gain, narrow = smoothing_gain(r.modes[j].cov_next[k], r.modes[j].cross[k])
    if narrow:
        raise EstimationError(
            f"mode {r.names[j]!r} at t = {r.t[k]:.9g} s (sample {k}): some combination of states "
            "is known so much better than each of them that the smoother has no digits left; take "
            "a prior that is less wide"
        )
    return gain


def _shared(a: ModeBeliefs, b: ModeBeliefs) -> tuple[list[int], list[int]]:
    """Places in a and in b of the states that both have."""
    names = [n for n in a.x.names if n in b.x.names]
    return a.x.indices(names), b.x.indices(names)


def _carried(b: ModeBeliefs, to: ModeBeliefs, k: int) -> Gaussian:
    """A mode's prediction of k+1 in the states of another; what it lacks is that one's own."""
    if b.x.names == to.x.names:
        return b.mean_next[:, k], b.cov_next[k]
    mine, theirs = _shared(b, to)
    m, P = to.mean_next[:, k].copy(), to.cov_next[k].copy()
    m[theirs] = b.mean_next[mine, k]
    P[theirs, :] = np.where(np.isin(np.arange(m.size), theirs), P[theirs, :], 0.0)
    P[:, theirs] = P[theirs, :].T
    P[np.ix_(theirs, theirs)] = b.cov_next[k][np.ix_(mine, mine)]
    return m, P


def _merged(weights: np.ndarray, parts: Sequence[Gaussian]) -> Gaussian:
    """Mean and covariance of a mixture."""
    m, P = (np.array(a) for a in zip(*parts, strict=True))
    mean = weights @ m
    d = m - mean
    return mean, np.einsum("i,ijk->jk", weights, P + d[:, :, None] * d[:, None, :])


def _future(before: Gaussian, after: Gaussian) -> tuple[np.ndarray, np.ndarray]:
    """What turned one belief into another, as a sample (H, z) of unit noise.

    In coordinates in which ``before`` is standard and ``after`` diagonal, of variances v: a sample
    of precision 1/v - 1.  Where v is 1 or more, nothing was learnt.
    """
    m, P = before
    size = np.sqrt(np.maximum(np.diag(P), 0.0))
    per = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
    value, vector = np.linalg.eigh(P * per[:, None] * per)
    there = value > 1e-14 * max(float(value.max(initial=0.0)), 1e-300)
    W = (vector[:, there] / np.sqrt(value[there])).T * per
    v, turn = np.linalg.eigh(W @ after[1] @ W.T)
    W, d = turn.T @ W, turn.T @ (W @ (after[0] - m))
    v = np.maximum(v, 1e-14)
    on = 1 - v > SILENT
    v, d, W = v[on], d[on], W[on]
    H = np.sqrt((1 - v) / v)[:, None] * W
    return H, H @ m + d / np.sqrt(v * (1 - v))


def _corrected(belief: Gaussian, H: np.ndarray, z: np.ndarray) -> tuple[Gaussian, float]:
    """A belief after a sample of unit noise, and the logarithm of the sample's density."""
    m, P = belief
    PH = P @ H.T
    S = H @ PH + np.eye(z.size)
    gain, e = np.linalg.solve(S, PH.T).T, z - H @ m
    A = np.eye(m.size) - gain @ H
    density = -0.5 * (e @ np.linalg.solve(S, e) + np.linalg.slogdet(S)[1])
    return (m + gain @ e, A @ P @ A.T + gain @ gain.T), float(density)


def _back(b: ModeBeliefs, to: ModeBeliefs, k: int, gain: np.ndarray, ahead: Gaussian) -> Gaussian:
    """A mode's belief at k, from what is known at k+1 of the states that it shares with another."""
    m1, P1 = b.mean_next[:, k], b.cov_next[k]
    m, P = ahead
    if b.x.names != to.x.names:
        mine, theirs = _shared(b, to)
        m, P, m1, P1 = m[theirs], P[np.ix_(theirs, theirs)], m1[mine], P1[np.ix_(mine, mine)]
        gain = smoothing_gain(P1, b.cross[k][:, mine])[0]
    cov = b.cov[k] + gain @ (P - P1) @ gain.T
    return b.mean[:, k] + gain @ (m - m1), (cov + cov.T) / 2


def _mixture(
    r: ImmResult, weights: np.ndarray, means: Sequence[np.ndarray], covs: Sequence[np.ndarray]
) -> Gaussian:
    """Mean and variance of the states that all modes have, (nx, K)."""
    assert r.modes is not None
    rows = [b.x.indices(r.x.names) for b in r.modes]
    m = np.array([a[i] for a, i in zip(means, rows, strict=True)])
    own = [np.diagonal(P, axis1=1, axis2=2).T[i] for P, i in zip(covs, rows, strict=True)]
    mean = np.einsum("jk,jik->ik", weights, m)
    return mean, np.einsum("jk,jik->ik", weights, np.array(own) + (m - mean) ** 2)
