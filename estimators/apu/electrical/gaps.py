"""Missing samples of the terminals, filled so that the filter's steps stay short and even.

The filter takes voltages and speed as inputs of its model, and between two samples it makes one
Runge-Kutta step: over a gap of several it would be wrong without knowing it.  So instants that the
recording left out are put in again, and what is missing there is what the harmonics of the samples
around it say: a least-squares fit over a period on either side.  How far that may be off is told,
for the filter's noise.  Currents are outputs: what is missing of them stays missing, and the filled
values serve only where readings are predicted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from apu_casadi.core.errors import DataError

__all__ = ["evened", "filled", "usable"]

LONG = 0.5  # electrical periods from which both sides are fitted apart


def usable(a: Mapping[str, np.ndarray], inputs: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the samples from the first to the last instant that has all of the inputs.

    Raises:
        DataError: no such instant; an infinite sample, with name and instant.
    """
    for n, v in a.items():
        if np.isinf(v).any():
            k = int(np.argmax(np.isinf(v)))
            raise DataError(
                f"{n} is infinite at t = {a['t'][k]:.9g} s (sample {k}); what is missing is NaN"
            )
    a = {n: v[np.isfinite(a["t"])] for n, v in a.items()}
    there = np.flatnonzero(np.all([np.isfinite(a[n]) for n in inputs], axis=0))
    if not there.size:
        raise DataError(f"no instant has all of {', '.join(inputs)}")
    return {n: v[there[0] : there[-1] + 1] for n, v in a.items()}


def evened(a: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the samples with instants put in, all NaN, where the recording left some out.

    A step counts as a gap from 1.5 usual ones on, if the angle turns by 0.3 rad or more in it.
    """
    t = a["t"]
    if t.size < 3:
        return dict(a)
    step = np.diff(t)
    usual = float(np.median(step))
    w = float(np.nanmedian(np.abs(a["w_r"])))
    gaps = np.flatnonzero((step > 1.5 * usual) & (step * w > 0.3))
    if not gaps.size or usual <= 0:
        return dict(a)
    usual = max(usual, 0.02 / max(w, 1e-9))
    parts = [round(float(step[k]) / usual) for k in gaps]
    more = [t[k] + step[k] * np.arange(1, n) / n for k, n in zip(gaps, parts, strict=True)]
    at = np.concatenate([np.full(m.size, k + 1) for k, m in zip(gaps, more, strict=True)])
    out = {n: np.insert(v, at, np.nan) for n, v in a.items() if n != "t"}
    return {"t": np.insert(t, at, np.concatenate(more)), **out}


def filled(
    t: np.ndarray, x: np.ndarray, w_r: np.ndarray, harmonics: tuple[int, ...], name: str
) -> tuple[np.ndarray, np.ndarray]:
    """Fill one channel's missing samples.

    Args:
        t, x: instants, s, and samples, NaN where there is none, shape (K,).
        w_r: speed at each, rad/s, nothing missing.
        harmonics: of the speed, of which the channel consists; 0 is a constant.
        name: for messages.

    Returns:
        x filled, and by how much each filled sample may be off, 0 at the others; both of shape
        (K,).

    Raises:
        DataError: too few samples around a gap.
    """
    missing = ~np.isfinite(x)
    out, off = x.copy(), np.zeros(t.size)
    if not missing.any():
        return out, off
    angle = np.concatenate([[0.0], np.cumsum(w_r[:-1] * np.diff(t))])
    basis = np.column_stack(
        [f(m * angle) for m in harmonics for f in (np.cos, np.sin)[: 2 if m else 1]]
    )
    edges = np.flatnonzero(np.diff(np.concatenate([[False], missing, [False]]).astype(int)))
    near = 2 * math.pi + 1e-6  # the angle only rises
    firsts = np.searchsorted(angle, angle[edges[::2]] - near, side="right")
    lasts = np.searchsorted(angle, angle[edges[1::2] - 1] + near, side="left")
    for i, j, a, b in zip(edges[::2], edges[1::2], firsts, lasts, strict=True):
        gap, long_gap = slice(i, j), angle[j - 1] - angle[i] > LONG * 2 * math.pi
        before, after = a + np.flatnonzero(~missing[a:i]), j + np.flatnonzero(~missing[j:b])
        sides = (before, after) if long_gap else (np.append(before, after),)
        fits = [f for f in (_fit(basis, x, s) for s in sides) if f is not None]
        if not fits:
            raise DataError(
                f"{name}: too few samples within a period of the gap at t = {t[i]:.9g} s "
                f"({j - i} samples) to go over it: split the recording there"
            )
        (first, rest), (last, rest_2) = fits[0], fits[-1]
        share = (t[gap] - t[max(i - 1, 0)]) / (t[min(j, t.size - 1)] - t[max(i - 1, 0)])
        out[gap] = (1 - share) * (basis[gap] @ first) + share * (basis[gap] @ last)
        # a load may have changed anywhere in a long gap: as one error in all its samples
        change = float(np.linalg.norm(last - first)) * math.sqrt(j - i)
        off[gap] = max(rest, rest_2) + change
    return out, off


def _fit(basis: np.ndarray, x: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, float] | None:
    """Coefficients of the basis at samples, and the rms of what is left; None of too few."""
    n = basis.shape[1]
    if at.size < n + 2:
        return None
    c = np.linalg.lstsq(basis[at], x[at], rcond=None)[0]
    rest = x[at] - basis[at] @ c
    return c, float(np.sqrt(np.mean(rest**2) * at.size / (at.size - n)))
