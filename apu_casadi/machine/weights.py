"""Weights of means over equal intervals, and polynomials through equally spaced samples."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.polynomial import chebyshev, legendre

_TERMS = (
    17  # of polynomials over an interval, in which the fastest harmonic turns by 2.7 rad: 1e-15
)


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


def rippling(
    before: int, after: int, period: int, degrees: Mapping[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Integrals of what ripples, its harmonics changing slowly, by samples around an interval.

    Exact for polynomials times the harmonics of a period; of all weights that are so, the smallest.

    Args:
        before: samples to the left of the interval [0, 1], that at 0 included.
        after: samples to its right, that at 1 included.
        period: samples in a period.
        degrees: degree of the polynomial by harmonic.

    Returns:
        The integral from the first sample to 0, weight by weight; and from 0 to x in [0, 1], a row
        of coefficients of 1, (x - 1/2), (x - 1/2)^2, ... by weight.
    """
    at = np.arange(1.0 - before, after + 1.0)
    centre, half = at.mean(), at.size / 2

    def basis(t: np.ndarray) -> np.ndarray:
        turned = 2 * math.pi * (t - centre) / period
        rows = [
            ((t - centre) / half) ** p * trig(m * turned)
            for m, degree in degrees.items()
            for trig in ((np.cos, np.sin) if m else (np.cos,))
            for p in range(degree + 1)
        ]
        return np.array(rows)

    exact = np.linalg.pinv(basis(at))  # values of an integral of all the basis -> weights
    node, share = legendre.leggauss(40)

    def integral(start: float, end: float) -> np.ndarray:
        h = (end - start) / 2
        return np.asarray(exact @ (basis(start + h * (1 + node)) @ (share * h)))

    first = sum(integral(k, k + 1.0) for k in range(1 - before, 0))
    x = (1 + np.cos(math.pi * (np.arange(_TERMS) + 0.5) / _TERMS)) / 2
    values = np.array([integral(0.0, float(v)) for v in x])
    by_chebyshev = np.linalg.solve(chebyshev.chebvander(2 * x - 1, _TERMS - 1), values)
    to_powers = np.array([_padded(chebyshev.cheb2poly(row)) for row in np.eye(_TERMS)])
    rows = by_chebyshev.T @ to_powers * 2.0 ** np.arange(_TERMS)
    return np.asarray(first), np.asarray(rows)


def _padded(powers: np.ndarray) -> np.ndarray:
    return np.pad(powers, (0, _TERMS - powers.size))


def unresolved(weights: np.ndarray, slope: float = 0.0) -> tuple[float, float, float, float]:
    """What sums of samples leave of the integral of exp(-z t) from 0 on, samples 1 apart.

    Args:
        weights: of the first samples; those of the others are as the last two, in turn.
        slope: weight of the rate at the start; what it leaves goes on with z.

    Returns:
        n, a, b, c: it is -n z^3 / (1 + a z + b z^2 + c z^3), within 5e-3 for all z.
    """
    z = np.exp(np.linspace(np.log(0.3), np.log(12.0 if slope else 60.0), 200))
    count, q = weights.size - 2, np.exp(-z)
    sums = q[:, None] ** np.arange(count) @ weights[:-2] - slope * z
    sums += q**count * (weights[-2] + q * weights[-1]) / (1 - q * q)
    left = 1 / z - sums
    fit = np.stack([z**3, left * z, left * z**2, left * z**3], axis=1)
    n, a, b, c = np.append(np.linalg.lstsq(fit[:, : 3 if slope else 4], -left, rcond=None)[0], 0)[
        :4
    ]
    return float(n), float(a), float(b), float(c)


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
