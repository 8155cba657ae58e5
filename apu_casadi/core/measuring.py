"""What an instrument makes of a true value: a constant gain error, and white noise."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["measure"]


def measure(
    true: Any, sigma: Any, white: np.random.Generator | np.ndarray | None, *, gain: Any = 0.0
) -> np.ndarray:
    """Return readings (1 + gain) true + sigma e, of the shape of ``true``.

    Args:
        true: true values.
        sigma: standard deviation of the noise, in the unit of the values.
        white: what draws the standard normal e, or e itself; None for no noise.
        gain: relative gain error.
    """
    clean = (1.0 + gain) * np.asarray(true, float)
    if white is None:
        return np.asarray(clean)
    drawn = white.standard_normal(clean.shape) if isinstance(white, np.random.Generator) else white
    return np.asarray(clean + sigma * drawn)
