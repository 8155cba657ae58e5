"""B-splines evaluated by de Boor's recurrence.

As ``scipy.interpolate.BSpline`` does it, operation by operation, so that numbers are the same; that
package takes a third of a second to import, longer than a short run takes.
"""

from __future__ import annotations

import numpy as np

__all__ = ["derivative", "spline"]


def _basis(knots: np.ndarray, x: np.ndarray, k: int, cell: np.ndarray, nu: int) -> np.ndarray:
    """Return the k + 1 B-splines that are not zero at x, or their nu-th derivatives, (k + 1, n).

    Args:
        cell: number of the knot to the left of each x, (n,).
    """
    h = np.zeros((k + 1, x.size))
    h[0] = 1.0
    for j in range(1, k + 1):
        before = h[:j].copy()
        h[: j + 1] = 0.0
        for n in range(1, j + 1):
            right, left = knots[cell + n], knots[cell + n - j]
            with np.errstate(divide="ignore", invalid="ignore"):
                if j <= k - nu:
                    w = before[n - 1] / (right - left)
                    low, high = h[n - 1] + w * (right - x), w * (x - left)
                else:
                    w = j * before[n - 1] / (right - left)
                    low, high = h[n - 1] - w, w
            empty = right == left
            h[n - 1], h[n] = np.where(empty, h[n - 1], low), np.where(empty, 0.0, high)
    return h


def spline(knots: np.ndarray, C: np.ndarray, k: int, x: np.ndarray, nu: int = 0) -> np.ndarray:
    """Evaluate a spline, or its nu-th derivative; end pieces go on.

    Args:
        knots: not falling, shape (n + k + 1,).
        C: coefficients, shape (n, ...).
        k: degree.
        x: where, shape (m,).

    Returns:
        Values, shape (m, ...).
    """
    n = knots.size - k - 1
    cell = np.clip(np.searchsorted(knots, x, side="right") - 1, k, n - 1)
    made = np.zeros((x.size, *C.shape[1:]))
    for a, value in enumerate(_basis(knots, x, k, cell, nu)):
        made += C[cell + a - k] * value.reshape(-1, *[1] * (C.ndim - 1))
    return made


def derivative(knots: np.ndarray, C: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the derivative of a spline as a spline: knots, coefficients, degree."""
    width = (knots[k + 1 : -1] - knots[1 : -k - 1]).reshape(-1, *[1] * (C.ndim - 1))
    return knots[1:-1], (C[1:] - C[:-1]) * k / width, k - 1
