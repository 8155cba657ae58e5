"""Mixing of the beliefs of interacting models, with covariances and with roots."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from apu_casadi.core.signals import Signals
from estimators.filters.algebra import graded_lower

__all__ = ["log_sum", "plain_mixer", "root_mixer", "squared", "stacks"]


def log_sum(v: ca.SX) -> ca.SX:
    """Return log sum exp(v), without overflow."""
    top = v[0]
    for i in range(1, v.numel()):
        top = ca.fmax(top, v[i])
    return top + ca.log(ca.sum1(ca.exp(v - top)))


def plain_mixer(x: Sequence[Signals]) -> ca.Function:
    """Mixing as an SX Function (logs, m, P, logT) -> (logs, m, P); m, P of all modes stacked.

    What a mode lacks it takes no part in: into mode j it carries j's own belief of that state,
    uncorrelated with the rest (Yuan et al. 2012, unbiased mixing).
    """
    M, n = len(x), [len(s) for s in x]
    logs, logT = ca.SX.sym("logs", M), ca.SX.sym("logT", M * M)
    ms = [ca.SX.sym(f"m{i}", k) for i, k in enumerate(n)]
    Ps = [ca.SX.sym(f"P{i}", k, k) for i, k in enumerate(n)]
    T = ca.reshape(logT, M, M)  # column-major: T[i, j] from i to j
    predicted, m_out, P_out = [], [], []
    for j in range(M):
        c = log_sum(logs + T[:, j])
        predicted.append(c)
        weights = ca.exp(logs + T[:, j] - c)
        carried = []
        for i in range(M):
            if x[i].names == x[j].names:
                carried.append((ms[i], Ps[i]))
                continue
            m, P = ca.SX(ms[j]), ca.SX(Ps[j])
            here = [b for b, s in enumerate(x[j].names) if s in x[i].names]
            there = [x[i].index(x[j].names[b]) for b in here]
            rest = [b for b in range(n[j]) if b not in here]
            m[here] = ms[i][there]
            P[here, here] = Ps[i][there, there]
            P[here, rest] = 0
            P[rest, here] = 0
            carried.append((m, P))
        mean, cov = ca.SX(n[j], 1), ca.SX(n[j], n[j])
        for i, (m, _) in enumerate(carried):
            mean += weights[i] * m
        for i, (m, P) in enumerate(carried):
            cov += weights[i] * (P + (m - mean) @ (m - mean).T)
        m_out.append(mean)
        P_out.append(ca.vec(cov))
    m_in, P_in = ca.vertcat(*ms), ca.vertcat(*(ca.vec(P) for P in Ps))
    out = [ca.vertcat(*predicted), ca.vertcat(*m_out), ca.vertcat(*P_out)]
    return ca.Function("mix", [logs, m_in, P_in, logT], [ca.densify(o) for o in ca.cse(out)])


def root_mixer(x: Sequence[Signals]) -> ca.Function:
    """The same as :func:`plain_mixer` with lower triangular roots in place of P.

    A root of the mixture is that of [sqrt(w_i) L_i, sqrt(w_i) (m_i - mean)], side by side.
    """
    M, n = len(x), [len(s) for s in x]
    logs, logT = ca.SX.sym("logs", M), ca.SX.sym("logT", M * M)
    ms = [ca.SX.sym(f"m{i}", k) for i, k in enumerate(n)]
    dense = [ca.SX.sym(f"L{i}", k, k) for i, k in enumerate(n)]
    Ls = [ca.tril(L) for L in dense]
    T = ca.reshape(logT, M, M)
    predicted, m_out, L_out = [], [], []
    for j in range(M):
        c = log_sum(logs + T[:, j])
        predicted.append(c)
        share = ca.exp((logs + T[:, j] - c) / 2)  # roots of the weights
        carried = []
        for i in range(M):
            m, L = ca.SX(ms[j]), ca.SX(n[j], n[i])
            here = [b for b, s in enumerate(x[j].names) if s in x[i].names]
            there = [x[i].index(x[j].names[b]) for b in here]
            rest = [b for b in range(n[j]) if b not in here]
            m[here] = ms[i][there]
            L[here, :] = Ls[i][there, :]
            if rest:
                own = ca.SX(n[j], n[j])
                own[rest, :] = Ls[j][rest, :]
                L = ca.horzcat(L, own)
            carried.append((m, L))
        mean = ca.SX(n[j], 1)
        for i, (m, _) in enumerate(carried):
            mean += share[i] ** 2 * m
        wide = [share[i] * ca.horzcat(L, m - mean) for i, (m, L) in enumerate(carried)]
        m_out.append(mean)
        L_out.append(ca.vec(ca.densify(graded_lower(ca.sparsify(ca.horzcat(*wide))))))
    m_in, L_in = ca.vertcat(*ms), ca.vertcat(*(ca.vec(L) for L in dense))
    out = [ca.vertcat(*predicted), ca.vertcat(*m_out), ca.vertcat(*L_out)]
    return ca.Function("root_mix", [logs, m_in, L_in, logT], [ca.densify(o) for o in ca.cse(out)])


def stacks(columns: np.ndarray, n: Sequence[int]) -> list[np.ndarray]:
    """Return matrices (K, n, n) of each mode, from K columns of all modes, each column-major."""
    parts = np.split(columns, np.cumsum([k * k for k in n])[:-1])
    return [c.T.reshape(-1, k, k).transpose(0, 2, 1) for c, k in zip(parts, n, strict=True)]


def squared(columns: np.ndarray, n: Sequence[int]) -> np.ndarray:
    """Return L L' of lower triangular roots, columns as in :func:`stacks`."""
    squares = [L @ L.transpose(0, 2, 1) for L in stacks(columns, n)]
    return np.concatenate([P.reshape(P.shape[0], -1).T for P in squares])
