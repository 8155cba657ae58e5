"""Weights of means over equal intervals, and polynomials through equally spaced samples."""

from __future__ import annotations

import numpy as np


def through(first: int, count: int) -> np.ndarray:
    """Polynomials that are one at one of ``count`` integers from ``first``, zero at the others.

    Row i has the coefficients of 1, x, x^2, ... of the i-th; shape (count, count).
    """
    x = np.arange(first, first + count, dtype=float)
    return np.asarray(np.linalg.inv(np.vander(x, increasing=True)).T)


def end_weights(count: int) -> np.ndarray:
    """Weights of the first samples in an integral that goes on evenly; one afterwards.

    Each interval is integrated by the polynomial through the ``count`` samples around it, the
    first few by that through the first ``count`` samples.
    """
    k, near = np.arange(count), count // 2
    polynomials = through(1 - near, count)
    middle = polynomials @ (1 / (k + 1))
    weights = -polynomials @ ((1.0 - near) ** (k + 1) / (k + 1))
    for i in range(count):
        weights[i:] += middle[: count - i]
    return np.asarray(weights)


def gregory(n: int) -> np.ndarray:
    """Weights, shape (n + 1,), of a mean over n equal intervals: trapezoids, ends corrected.

    The ends are of order ten, or six where there are fewer than 19 intervals.  For what ripples
    periodically the trapezoidal rule inside is spectrally accurate, which Simpson's is not.
    """
    w = np.ones(n + 1)
    if n >= 19:
        ends = end_weights(10)
    else:
        ends = np.array([95 / 288, 317 / 240, 23 / 30, 793 / 720, 157 / 160])
    w[: ends.size], w[-ends.size :] = ends, ends[::-1]
    return w / n
