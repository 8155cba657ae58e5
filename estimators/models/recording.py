"""Measured data as filters take them: a stream of time-stamped samples, of any rate, with gaps.

Nothing needs to come together: a sensor may have its own instants, miss samples, or appear once.
Inputs hold their value until the next stamp.  What is missing is NaN in ``y``, and counts as not
measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError, nearest
from apu_casadi.core.signals import Signals
from estimators.models.filtermodel import FilterModel

__all__ = ["SAME_TIME", "Recording", "plain_numbers", "record"]


def plain_numbers(data: Any, what: str, *, gaps: bool = False) -> np.ndarray:
    """Return an array of floats from numbers; what is masked is a gap, NaN.

    Args:
        data: array, list, masked array, pandas series.
        what: name, for messages.
        gaps: whether NaN and masked values are allowed.

    Raises:
        DataError: dates and spans of time, whose ticks are no seconds; truth values and text, which
            NumPy would turn into numbers; a masked value where none may be.
    """
    mask = np.ma.getmaskarray(data) if isinstance(data, np.ma.MaskedArray) else None
    try:
        a = np.asarray(data)
    except ValueError:
        raise DataError(f"{what}: an array of numbers expected, got {data!r:.60}") from None
    wrong: Any = a.flat[0] if a.size else None
    kind: str = a.dtype.kind
    if kind == "O":
        others = [x for x in a.ravel() if not _is_number(x)]
        kind = "f" if not others else _KINDS.get(type(others[0]).__name__, "O")
        wrong = others[0] if others else None
        if not others:
            a = np.array([_float(x) for x in a.ravel()]).reshape(a.shape)
    if kind in "mM":
        how = "t / np.timedelta64(1, 's')" if kind == "m" else "(t - t[0]) / np.timedelta64(1, 's')"
        raise DataError(f"{what}: {str(wrong)!r} is a time of NumPy, not a number: give {how}")
    if kind not in "fiu" and a.size:
        raise DataError(
            f"{what}: numbers expected, got {wrong!r:.60} of type {type(wrong).__name__}"
        )
    out = a.astype(float)
    if mask is not None and mask.any():
        if not gaps:
            raise DataError(f"{what}: {int(mask.sum())} of {mask.size} values are masked")
        out[mask] = np.nan
    return out


_NUMBERS = (int, float, np.integer, np.floating, Decimal, Fraction)
_KINDS = {"timedelta": "m", "Timedelta": "m", "datetime": "M", "Timestamp": "M"}


def _is_number(x: Any) -> bool:
    """Tell whether an object is a number or a gap (None, pandas.NA)."""
    gap = x is None or type(x).__name__ == "NAType"
    return gap or (isinstance(x, _NUMBERS) and not isinstance(x, bool))


def _float(x: Any) -> float:
    return float(x) if isinstance(x, _NUMBERS) else math.nan


SAME_TIME = 1e-9  # s; stamps closer than this are one instant


@dataclass(frozen=True, eq=False)
class Recording:
    """Inputs and outputs on a common grid of K instants.

    Args:
        t: instants, s, strictly increasing, shape (K,).
        u: inputs from each instant to the next, shape (nu, K).
        y: measured outputs, NaN where there is none, shape (ny, K).
        variance: of the measurement noise v, unit of y squared, shape (ny, K).
        p: known parameters, shape (np,).

    Raises:
        DataError: shapes that do not fit, times that do not increase, inputs or parameters not
            finite, measured values infinite, a variance that is not positive where something was
            measured.
    """

    t: np.ndarray
    u: np.ndarray
    y: np.ndarray
    variance: np.ndarray
    p: np.ndarray

    def __post_init__(self) -> None:
        """Check everything once, so that the filters need not."""
        for name in ("t", "u", "y", "variance", "p"):
            value = plain_numbers(getattr(self, name), name, gaps=name in ("y", "variance"))
            object.__setattr__(self, name, value)
        K = np.size(self.t)
        if np.shape(self.t) != (K,) or K == 0:
            raise DataError(f"t: shape (K,) with K > 0 expected, got {np.shape(self.t)}")
        if not np.isfinite(self.t).all():
            k = int(np.argmin(np.isfinite(self.t)))
            raise DataError(f"t must be finite; t = {self.t[k]} at sample {k}")
        step = np.diff(self.t)
        if not (step > 0).all():
            k = int(np.argmax(~(step > 0)))
            raise DataError(f"t must increase; it does not after t = {self.t[k]:.9g} (sample {k})")
        for name in ("u", "y", "variance"):
            shape = np.shape(getattr(self, name))
            if len(shape) != 2 or shape[1] != K:
                raise DataError(f"{name}: {K} columns expected, got shape {shape}")
        if np.shape(self.variance) != np.shape(self.y):
            raise DataError(
                f"variance: shape {np.shape(self.y)} expected, got {np.shape(self.variance)}"
            )
        if self.p.ndim != 1:
            raise DataError(f"p: shape (np,) expected, got {self.p.shape}")
        if not (np.isfinite(self.u).all() and np.isfinite(self.p).all()):
            raise DataError("inputs u and parameters p must be finite")
        if np.isinf(self.y).any():
            raise DataError("measured values must be finite, or NaN where missing")
        there = ~np.isnan(self.y)
        v = self.variance[there]
        if not (np.isfinite(v).all() and (v > 0).all()):
            raise DataError("variances must be positive and finite where something was measured")

    @property
    def dt(self) -> np.ndarray:
        """Steps to the next instant, s, shape (K,); the last is 0."""
        return np.append(np.diff(self.t), 0.0)

    @property
    def size(self) -> int:
        """Number of instants K."""
        return int(self.t.size)

    def check(self, model: FilterModel) -> None:
        """Refuse a recording that does not fit the model.

        Raises:
            DataError: numbers of inputs, outputs or parameters differ.
        """
        got = self.u.shape[0], self.p.size, self.y.shape[0]
        want = len(model.u), len(model.p), len(model.y)
        if got != want:
            raise DataError(
                f"{model.name} has {want[0]} inputs, {want[1]} parameters and {want[2]} outputs; "
                f"the recording has {got[0]}, {got[1]} and {got[2]}"
            )

    def part(self, start: int, stop: int, p: np.ndarray | None = None) -> Recording:
        """Return the instants start <= k < stop; with other known parameters, if they are given."""
        made, s = object.__new__(type(self)), slice(start, stop)
        p = self.p if p is None else p
        if not 0 <= start < stop <= self.size or not np.isfinite(p).all():  # told as always
            return Recording(self.t[s], self.u[:, s], self.y[:, s], self.variance[:, s], p)
        # checked already
        made.__dict__.update(
            {n: getattr(self, n)[..., s].copy() for n in ("t", "u", "y", "variance")}
        )
        made.__dict__["p"] = p.copy()
        return made


def _stamped(name: str, data: Any) -> tuple[np.ndarray, np.ndarray]:
    try:
        times, values = data
    except (TypeError, ValueError):
        raise DataError(f"{name}: (times, values) expected, got {data!r:.80}") from None
    t = plain_numbers(times, f"{name}: (times, values) expected; times")
    v = plain_numbers(values, f"{name}: (times, values) expected; values", gaps=True)
    if t.ndim != 1 or t.shape != v.shape or t.size == 0:
        raise DataError(
            f"{name}: times and values of one length expected, got {t.shape}, {v.shape}"
        )
    if not np.isfinite(t).all():
        k = int(np.argmin(np.isfinite(t)))
        raise DataError(f"{name}: times must be finite; t = {t[k]!r} (sample {k}) is not")
    if (np.diff(t) <= SAME_TIME).any():
        k = int(np.argmax(np.diff(t) <= SAME_TIME))
        raise DataError(
            f"{name}: times must increase; after t = {t[k]:.9g} s (sample {k}) they do not: sort "
            "the stream, or drop one of two samples of the same stamp"
        )
    return t, v


def _variance(name: str, sigma: Any, values: np.ndarray) -> np.ndarray:
    """Variance of each sample; refuses infinite samples and impossible standard deviations."""
    if np.isinf(values).any():
        k = int(np.argmax(np.isinf(values)))
        raise DataError(f"{name}: sample {k} is infinite; a gap is NaN")
    s = plain_numbers(sigma, f"sigma of {name}", gaps=True)
    if s.shape not in ((), values.shape):
        raise DataError(
            f"sigma of {name}: a number or shape {values.shape} expected, got {s.shape}"
        )
    s = np.broadcast_to(s, values.shape)
    wrong = ~(np.isfinite(s) & (s > 0)) & ~np.isnan(values)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise DataError(f"sigma of {name} must be finite and > 0, got {s[k]!r} at sample {k}")
    # where there is no sample, any number does
    return np.where(np.isfinite(s) & (s > 0), s, 1.0) ** 2


def record(
    model: FilterModel,
    *,
    outputs: Mapping[str, tuple[Any, Any]],
    sigma: Mapping[str, Any],
    inputs: Mapping[str, Any] | None = None,
    p: Mapping[str, float] | None = None,
    max_dt: float = math.inf,
) -> Recording:
    """Merge streams of time-stamped samples into one recording.

    Args:
        model: gives names, units and defaults.
        outputs: ``{name: (times [s], values)}``, each sensor with its own stamps; NaN is a gap.
            Outputs of the model that are not given are never measured.
        sigma: standard deviation of each given output's noise; a number, or one per sample.
        inputs: ``{name: number}`` for a constant, or ``{name: (times, values)}``, held until the
            next stamp.  A stamp must not lie after the first measurement.
        p: known parameters by name, where the model gives no default.
        max_dt: longest step, s; longer gaps are divided.

    Raises:
        DataError: unknown name, stamps that do not increase, infinite samples, a sigma that is
            missing or not positive, an input that begins after the first measurement.
        SignalError: a missing input or parameter, or one that is not finite.
    """
    for what, names, known in (
        ("output", outputs, model.y),
        ("sigma of output", sigma, model.y),
        ("input", inputs or {}, model.u),
    ):
        for name in names:
            if name not in known.names:
                raise DataError(f"unknown {what} {name!r} {nearest(name, known.names)}")
    if not outputs:
        raise DataError("no output is measured")
    missing = [n for n in outputs if n not in sigma]
    if missing:
        raise DataError(f"sigma missing for {', '.join(missing)}")
    streams = {n: _stamped(n, d) for n, d in outputs.items()}
    held: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    constant: dict[str, float] = {}
    for name, value in (inputs or {}).items():
        if np.ndim(value) == 0 and not isinstance(value, tuple):
            constant[name] = float(plain_numbers(value, f"input {name}"))
        else:
            held[name] = _stamped(name, value)
    first = min(float(t[0]) for t, _ in streams.values())
    last = max(float(t[-1]) for t, _ in streams.values())
    for name, (t, v) in held.items():
        if t[0] > first + SAME_TIME:
            raise DataError(
                f"input {name} begins at {t[0]:.9g} s, after the first measurement at {first:.9g} s"
            )
        if not np.isfinite(v).all():
            raise DataError(f"input {name}: {int((~np.isfinite(v)).sum())} values not finite")
    stamps = [t for t, _ in streams.values()]
    stamps += [t[(t > first) & (t < last)] for t, _ in held.values()]
    grid = _merged(stamps, max_dt)
    u = np.empty((len(model.u), grid.size))
    given: dict[str, Any] = dict(constant)
    for name, (t, v) in held.items():
        k = np.searchsorted(t, grid + SAME_TIME, side="right") - 1
        given[name] = v[k]
    u[:] = _columns(model.u, given, grid.size)
    y = np.full((len(model.y), grid.size), np.nan)
    variance = np.ones_like(y)
    for name, (t, v) in streams.items():
        i = model.y.index(name)
        k = np.searchsorted(grid, t + SAME_TIME, side="right") - 1
        if np.unique(k).size < k.size:
            raise DataError(
                f"{name}: samples closer than {2 * SAME_TIME:.0e} s cannot be told apart"
            )
        y[i, k] = v
        variance[i, k] = _variance(name, sigma[name], v)
    return Recording(grid, u, y, variance, model.p.pack(p or {}))


def _columns(signals: Signals, given: Mapping[str, Any], n: int) -> np.ndarray:
    packed = signals.pack(given)
    return packed if packed.ndim == 2 else np.repeat(packed[:, None], n, axis=1)


def _merged(stamps: list[np.ndarray], max_dt: float) -> np.ndarray:
    """All stamps in order, near-equal ones once, gaps longer than max_dt divided evenly."""
    if not max_dt > 0:
        raise DataError(f"max_dt = {max_dt!r} s must be > 0")
    t = np.unique(np.concatenate(stamps))
    t = t[np.append(True, np.diff(t) > SAME_TIME)]
    if math.isfinite(max_dt) and t.size > 1:
        parts = np.maximum(np.ceil(np.diff(t) / max_dt * (1 - 1e-9)), 1).astype(int)
        t = np.concatenate(
            [a + (b - a) * np.arange(n) / n for a, b, n in zip(t[:-1], t[1:], parts, strict=True)]
            + [t[-1:]]
        )
    return t
