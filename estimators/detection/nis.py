"""The normalised innovation squared (NIS), summed over a window: any change of the model shows.

The threshold keeps the stated rate of false alarms by the exact rate of up-crossings of a moving
sum (:func:`upcrossing_rate`).
"""

from __future__ import annotations

import math

import numpy as np
from scipy import optimize

from apu_casadi.core.errors import ParameterError, SignalError
from apu_casadi.core.sharing import once
from estimators.detection.alarms import HOUR, Alarms, allowed_per_sample, rising
from estimators.information import consistency
from estimators.models.recording import plain_numbers

__all__ = ["nis_test", "nis_threshold", "upcrossing_rate", "windowed_nis"]


def windowed_nis(
    nis: np.ndarray, measured: np.ndarray, window: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return sums over the last ``window`` samples of the NIS and of the numbers measured.

    Args:
        nis, measured: shape (K,), as in a :class:`~estimators.filters.filtering.FilterResult`.
        window: samples; the first ``window - 1`` sums are over fewer, since there are no more.

    Returns:
        (sum, degrees of freedom), each of shape (K,).

    Raises:
        SignalError: shapes that differ, values not finite. ParameterError : window < 1.
    """
    nis, measured = plain_numbers(nis, "nis"), plain_numbers(measured, "measured")
    if nis.ndim != 1 or nis.shape != measured.shape:
        shapes = f"{nis.shape} and {measured.shape}"
        raise SignalError(f"nis and measured of one length expected, got {shapes}")
    if not np.isfinite(nis).all():
        raise SignalError(f"nis: {int((~np.isfinite(nis)).sum())} values are not finite")
    if not (isinstance(window, int | np.integer) and window >= 1):
        raise ParameterError(f"window must be a whole number of samples >= 1, got {window!r}")
    out = []
    for a in (nis, measured):
        c = np.concatenate([[0.0], np.cumsum(a)])
        k = np.arange(1, a.size + 1)
        out.append(c[k] - c[np.maximum(k - window, 0)])
    return out[0], np.round(out[1])


@once
def _gauss() -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of Gauss and Legendre on (-1, 1); to find them costs an eigenproblem."""
    return np.polynomial.legendre.leggauss(400)


def upcrossing_rate(threshold: float, dof: int, window: int) -> float:
    """Return how often, for each sample, a moving sum of chi-squared values rises past a threshold.

    The sums before and after a sample share window - 1 terms, A; the rate of "not above, then
    above" is E[F(c - A) (1 - F(c - A))] with F the distribution of one term: exact, whatever the
    correlation of the sums, and the expected number of alarms for each sample if an alarm is such
    a crossing.

    Args:
        threshold: c > 0.
        dof: degrees of freedom of one term.
        window: terms in the sum.
    """
    if window == 1:
        return float(consistency.below(threshold, dof) * consistency.above(threshold, dof))
    # a = c - t^2: smooth at the edge also for one degree of freedom; beyond 40 sd nothing is left
    reach = math.sqrt(min(threshold, dof + 40 * math.sqrt(2 * dof) + 80))
    t, w = _gauss()
    t, w = reach / 2 * (t + 1), reach / 2 * w
    shared = consistency.density(threshold - t**2, dof * (window - 1))
    one = consistency.below(t**2, dof) * consistency.above(t**2, dof)
    return float(np.sum(w * 2 * t * shared * one))


def nis_threshold(
    dof: int, window: int, false_alarms_per_hour: float, rate: float
) -> tuple[float, float]:
    """Return the threshold of the windowed NIS, and the share of samples above it.

    Args:
        dof: outputs measured at each sample.
        window: samples.
        false_alarms_per_hour: up-crossings of the threshold in an hour without a change.
        rate: samples per second.

    Returns:
        (threshold, probability that a window's sum is above it).

    Raises:
        ParameterError: rates not positive, or so high that no threshold gives them.
    """
    allowed = allowed_per_sample(false_alarms_per_hour, rate)
    if not (dof >= 1 and window >= 1):
        raise ParameterError(f"dof and window must be >= 1, got {dof!r} and {window!r}")
    mean = float(consistency.quantile(0.5, dof * window))
    if upcrossing_rate(mean, dof, window) <= allowed:
        raise ParameterError(
            f"a window of {window} samples crosses its own median only "
            f"{upcrossing_rate(mean, dof, window) * HOUR * rate:.3g} times an hour, so that "
            f"{false_alarms_per_hour:g} false alarms an hour mean no threshold: shorten the window"
        )
    top = mean + 10
    while upcrossing_rate(top, dof, window) > allowed:
        top = mean + 2 * (top - mean)
    c = optimize.brentq(
        lambda v: math.log(max(upcrossing_rate(v, dof, window), 1e-300)) - math.log(allowed),
        mean,
        top,
        xtol=1e-10,
    )
    return float(c), float(consistency.above(c, dof * window))


def nis_test(
    nis: np.ndarray,
    measured: np.ndarray,
    *,
    window: int,
    false_alarms_per_hour: float,
    rate: float,
    start: float = 0.0,
) -> Alarms:
    """Test whether innovations are larger than the filter believes: any change shows.

    Args:
        nis, measured: of a :class:`~estimators.filters.filtering.FilterResult`, shape (K,).
        window: samples; longer windows find smaller changes, later.
        false_alarms_per_hour: stated rate; with all outputs measured at each sample it is exact.
            With gaps, each window is held to the same probability at its own degrees of freedom.
        rate: samples per second.
        start: time of the first sample, s.

    Raises:
        SignalError, ParameterError: see :func:`windowed_nis` and :func:`nis_threshold`.
    """
    total, dof = windowed_nis(nis, measured, window)
    most = int(np.max(measured, initial=0))
    if most < 1:
        raise SignalError("nothing was measured")
    _, p = nis_threshold(most, window, false_alarms_per_hour, rate)
    kinds, back = np.unique(dof, return_inverse=True)
    limit = np.where(kinds > 0, consistency.exceeded(p, np.maximum(kinds, 1)), np.inf)[back]
    return Alarms(
        f"NIS over {window} samples",
        total,
        limit,
        rising(total > limit),
        rate,
        false_alarms_per_hour,
        start,
    )
