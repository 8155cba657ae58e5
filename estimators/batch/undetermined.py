"""From information to covariance: what the data leave open is named, never inverted."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

__all__ = ["invert"]

#: Eigenvalue of the information, parameters scaled to unit information each, below which a
#: direction counts as undetermined; and below which it is reported as hardly determined.
RANK_TOL = 1e-10
WEAK_TOL = 1e-4


def invert(
    info: np.ndarray, names: Sequence[str]
) -> tuple[np.ndarray, tuple[str, ...], tuple[str, ...]]:
    """Return the covariance from an information, and in words what it does not or hardly determine.

    Directions without information are named, not inverted.
    """
    n = len(names)
    size = np.sqrt(np.maximum(np.diag(info), 0.0))
    # relative to nothing but the information itself: a parameter that does not show has none
    largest = size.max(initial=0.0)
    blind = size <= 1e-12 * largest if largest > 0 else np.ones(n, bool)
    words = [f"nothing measured depends on {names[int(i)]}" for i in np.flatnonzero(blind)]
    cov = np.full((n, n), math.nan)
    cov[np.diag_indices(n)] = math.inf
    seen = np.flatnonzero(~blind)
    if not seen.size:
        return cov, tuple(words), ()
    d = size[seen]
    value, vector = np.linalg.eigh(info[np.ix_(seen, seen)] / np.outer(d, d))
    open_ = value <= RANK_TOL * max(1.0, value.max())
    told = [names[int(i)] for i in seen]
    words += [_confounded(vector[:, k], told) for k in np.flatnonzero(open_)]
    weak = [
        _confounded(vector[:, k], told, value[k])
        for k in np.flatnonzero(~open_ & (value <= WEAK_TOL))
    ]
    # what takes no part in an open direction is determined all the same
    free = np.abs(vector[:, open_]).max(axis=1, initial=0.0) > 1e-5
    good = vector[:, ~open_]
    part = (good / value[~open_]) @ good.T / np.outer(d, d)
    part[free, :] = part[:, free] = math.nan
    part[free, free] = math.inf
    cov[np.ix_(seen, seen)] = part
    return cov, tuple(words), tuple(weak)


def _confounded(v: np.ndarray, names: Sequence[str], value: float | None = None) -> str:
    """Say which parameters cannot be told apart; weights in units of each one's own effect."""
    order = [int(i) for i in np.argsort(-np.abs(v)) if abs(v[i]) >= 0.05]
    parts = [names[i] for i in order]
    sign = np.sign(v[order[0]])
    mix = " ".join(f"{sign * v[i]:+.2f} {names[i]}" for i in order)
    listed = f"{', '.join(parts[:-1])} and {parts[-1]}" if len(parts) > 1 else parts[0]
    if value is None:
        return (
            f"{listed} cannot be told apart: the change {mix} (each in units of its own effect) "
            "shows in no measurement"
        )
    return (
        f"{listed} can hardly be told apart: the change {mix} (each in units of its own effect) "
        f"shows {math.sqrt(value):.1e} as strongly as each alone"
    )
