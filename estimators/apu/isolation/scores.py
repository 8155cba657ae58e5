"""Confusion matrices and Cohen's kappa."""

from __future__ import annotations

from typing import Any

import numpy as np

from apu_casadi.core.errors import ParameterError
from estimators.apu.isolation.problem import CLASSES
from estimators.information.consistency import share_interval

__all__ = ["cohen_kappa", "scores"]


def cohen_kappa(confusion: np.ndarray) -> tuple[float, float, float]:
    """Return Cohen's kappa with its 95 % interval.

    Cohen (1960), Educ. Psychol. Meas. 20, 37-46.  The interval is that of Clopper and Pearson for
    the share of right answers, chance agreement taken as found: it also holds where nearly all
    answers are right, where the usual standard error vanishes.

    Args:
        confusion: counts, true class by row, given class by column.
    """
    c = np.asarray(confusion, float)
    n = c.sum()
    if not n:
        raise ParameterError("an empty confusion matrix has no kappa")
    right = float(np.trace(c))
    chance = float((c.sum(0) * c.sum(1)).sum()) / n**2
    if chance >= 1:
        raise ParameterError("kappa is not defined where all answers are one and the same class")
    shares = (right / n, *share_interval(right, n))
    kappa, low, high = ((a - chance) / (1 - chance) for a in shares)
    return float(kappa), float(low), float(high)


def scores(confusion: np.ndarray) -> dict[str, Any]:
    """Return a confusion matrix with what follows from it, for JSON."""
    c = np.asarray(confusion, int)
    kappa, low, high = cohen_kappa(c)
    rows = c.sum(1)
    return {
        "classes": [h.name for h in CLASSES],
        "confusion": c.tolist(),
        "n": int(c.sum()),
        "kappa": kappa,
        "kappa_95": [low, high],
        "right": float(np.trace(c) / c.sum()),
        "recall": [float(c[i, i] / rows[i]) if rows[i] else None for i in range(len(rows))],
    }
