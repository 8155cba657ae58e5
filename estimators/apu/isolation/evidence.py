"""Evidence of a fault whose sizes are uniform in boxes, against none."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import special

from apu_casadi.core.errors import ParameterError
from estimators.apu.isolation.problem import CLASSES, FAULTS, Hypothesis

__all__ = ["class_evidence", "log_box"]


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

    Args:
        b: (..., n), C : (..., n, n), positive definite; n = 1 or 2.
        boxes: lower and upper corners.

    Raises:
        ParameterError: more than two sizes.
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


def class_evidence(
    b: np.ndarray, C: np.ndarray, classes: Sequence[Hypothesis] = CLASSES
) -> np.ndarray:
    """Return the evidence of each class against the first, (classes, ...).

    Args:
        b, C: of jumps in all of ``FAULTS``, (..., 8) and (..., 8, 8); see :func:`log_box`.
        classes: the healthy one first.
    """
    out = []
    for c in classes:
        if not c.faults:
            out.append(np.zeros(b.shape[:-1]))
            continue
        i = [FAULTS.index(f) for f in c.faults]
        out.append(log_box(b[..., i], C[..., i, :][..., :, i], c.boxes))
    return np.array(out)
