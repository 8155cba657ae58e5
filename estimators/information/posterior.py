"""Probabilities of hypotheses from the logarithms of their weights."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

__all__ = ["named_posterior", "posterior"]


def posterior(log: np.ndarray) -> np.ndarray:
    """Return weights over their sum along the first axis.

    Args:
        log: logarithms of prior times likelihood, up to a constant; -inf: impossible, but not all.
    """
    weight = np.exp(log - log.max(0))
    return np.asarray(weight / weight.sum(0))


def named_posterior(log: Mapping[str, float]) -> dict[str, float]:
    """Return the same by name of the hypothesis; what is not finite is impossible."""
    values = np.array([*log.values()], float)
    share = posterior(np.where(np.isfinite(values), values, -np.inf))
    return dict(zip(log, map(float, share), strict=True))
