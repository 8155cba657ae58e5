"""Numbers of a Radau IIA method of any odd number of stages, as ``radau.c`` takes them."""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np


class Radau(NamedTuple):
    """Coefficients; eigenvalues of the inverse of Butcher's matrix, the real one first.

    Args:
        inverse: of Butcher's matrix, shape (s, s).
        values: eigenvalues, of a complex pair that with a positive imaginary part, shape (k,).
        of: what a stage gets of each, shape (s, k), doubled for the pairs.
        to: what each gets of a stage, shape (k, s).
        weights: of the stages in an integral, shape (s,).
        error: of the stages in the embedded formula's error, shape (s,); beside them the rate at
            the start counts 1/values[0] times the step.
    """

    inverse: np.ndarray
    values: np.ndarray
    of: np.ndarray
    to: np.ndarray
    weights: np.ndarray
    error: np.ndarray


def radau(stages: int) -> Radau:
    """Return the method.

    Hairer and Wanner, Solving ODEs II: nodes of section IV.5, transformation and error of IV.8; the
    embedded formula has the order ``stages``.
    """
    c, k = np.array(ca.collocation_points(stages, "radau")), np.arange(stages)
    powers = c[:, None] ** k
    A = (c[:, None] ** (k + 1) / (k + 1)) @ np.linalg.inv(powers)
    inverse = np.linalg.inv(A)
    values, T = np.linalg.eig(inverse)
    back = np.linalg.inv(T)
    real = [int(np.abs(values.imag).argmin())]
    order = [*real, *(i for i in np.argsort(values.imag) if values[i].imag > 1e-9)]
    of = T[:, order] * np.where(np.arange(len(order)) == 0, 1.0, 2.0)
    first = 1.0 / values[real[0]].real
    moments = 1.0 / (k + 1) - first * (k == 0)
    embedded = np.linalg.solve(powers.T, moments)
    error = embedded @ inverse - np.eye(stages)[-1]
    return Radau(inverse, values[order], of, back[order], A[-1], error)
