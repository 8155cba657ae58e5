"""Numbers that loggers and programs write where they have no reading."""

from __future__ import annotations

import numpy as np

#: What is hardly ever a reading.
SENTINELS = (-999.0, -9999.0, -99999.0, -32768.0, -32767.0)
#: What may be one, where it goes with its neighbours.
_NINES = (999.0, 999.9, 999.99, 9999.0, 9999.9, 9999.99, 99999.0, 999999.0)
#: Fill values, such as 1e20, 1e30 and 9.969e36 of netCDF.
_FILL = 1e19


def sentinel(values: np.ndarray, *, ordered: bool | None = True) -> int | None:
    """Return the place of the first number that stands for no reading; None where none does.

    Args:
        values: shape (K,); NaN is none.
        ordered: 9999 and the like count as readings between a smaller and a larger neighbour;
            without an order they never do.  None: they always do.
    """
    out = np.isin(values, SENTINELS) | (np.abs(values) >= _FILL)
    for code in _NINES if ordered is not None else ():
        at = values == code
        if not at.any():
            continue
        rest = values[~at & np.isfinite(values)]
        before = np.cumsum(~at & np.isfinite(values))[at]  # neighbours that are others
        left = rest[np.clip(before - 1, 0, None)] if rest.size else np.full(before.shape, np.nan)
        right = rest[np.clip(before, None, rest.size - 1)] if rest.size else left
        inside = (before > 0) & (before < rest.size) & ((left < code) != (right < code))
        out[at] |= ~(inside & bool(ordered))
    found = np.flatnonzero(out)
    return int(found[0]) if found.size else None
