"""Numbers from outside: what counts as one, in one place.

Text, booleans, complex numbers, dates and masked values are refused, alone and inside lists and
arrays; NumPy would turn ``"8000"`` and ``True`` into numbers without a word.  Python's and NumPy's
real numbers, arrays of them and whatever turns into such an array (DataArray, Series, casadi.DM)
are taken.
"""

from __future__ import annotations

import math
import numbers
from typing import Any

import numpy as np

from apu_casadi.core.errors import ApuError, ScenarioError, SignalError


def number(name: str, value: Any, *, error: type[ApuError] = SignalError) -> float:
    """Return ``value`` as a float; arrays of size one count as their element.

    It may be infinite or NaN: whether that makes sense, the caller knows.

    Raises:
        error: it is no real number, or several.
    """
    if type(value) is float:
        return value
    a = array(name, value, error=error)
    if a.size != 1:
        raise error(f"{name} must be one number, got {a.size} values of shape {a.shape}")
    return float(a.reshape(()))


def bounded(
    value: Any,
    what: str,
    *,
    lo: float = -math.inf,
    hi: float = math.inf,
    open_lo: bool = False,
    unit: str = "",
) -> float:
    """Return ``value`` as a float when it is a finite number in [lo, hi], or in (lo, hi].

    Raises:
        ScenarioError: not a number (booleans are none), not finite, or outside the interval.
    """
    u = f" {unit}" if unit else ""
    try:
        x = number(what, value, error=ScenarioError)
    except ScenarioError:
        raise ScenarioError(f"{what}: a number is expected, got {value!r}") from None
    if not math.isfinite(x):
        raise ScenarioError(f"{what}: must be finite, got {x!r}")
    if x < lo or x > hi or (open_lo and x <= lo):
        if math.isinf(hi):
            must = f"must be {'>' if open_lo else '>='} {lo:g}{u}"
        else:
            must = f"must lie in {'(' if open_lo else '['}{lo:g}, {hi:g}]{u}"
        raise ScenarioError(f"{what}: {must}, got {x:g}")
    return x


def array(
    name: str, value: Any, *, what: str = "a number", error: type[ApuError] = SignalError
) -> np.ndarray:
    """Return ``value`` as an array of floats, of any shape; ``what`` is expected, in messages.

    Raises:
        error: something in it is no real number; names it.
    """
    if type(value) is float:
        return np.asarray(value)
    if isinstance(value, np.ma.MaskedArray) and np.any(np.ma.getmaskarray(value)):
        raise error(
            f"{name}: {int(np.ma.getmaskarray(value).sum())} of {value.size} values are masked"
        )
    wrong = _no_number(value)
    if wrong is not None:
        raise error(f"{name} must be {what}, got {_shown(wrong)}")
    try:
        a = np.asarray(value)
        if a.dtype.kind == "O":
            bad = [e for e in a.ravel().tolist() if not _is_number(e)]
            if bad or a.size == 0:
                raise error(f"{name} must be {what}, got {_shown(bad[0] if bad else value)}")
        elif a.dtype.kind not in "iuf":
            raise error(f"{name} must be {what}, got {_shown(value)}")
        return a.astype(float)
    except (TypeError, ValueError, OverflowError) as e:
        if isinstance(e, ApuError):
            raise
        raise error(f"{name} must be {what}, got {_shown(value)}") from None


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool | np.bool_)


def _no_number(value: Any) -> Any:
    """Return what NumPy would turn into a number silently, in nested lists too; None if nothing."""
    if isinstance(value, bool | np.bool_ | str | bytes):
        return value
    if isinstance(value, list | tuple):
        return next((w for e in value if (w := _no_number(e)) is not None), None)
    return None


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
