"""Page's cumulative sum of a scalar: a shift of stated size, both signs.

The threshold keeps the stated rate of false alarms by the exact average run length
(:func:`cusum_arl`); :func:`cusum_arl_markov` and :func:`cusum_arl_siegmund` are two other routes to
the same number.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import linalg, optimize, special

from apu_casadi.core.checked import number
from apu_casadi.core.errors import EstimationError, ParameterError, SignalError
from estimators.detection.alarms import Alarms, allowed_per_sample
from estimators.models.recording import plain_numbers

__all__ = [
    "cusum",
    "cusum_arl",
    "cusum_arl_markov",
    "cusum_arl_siegmund",
    "cusum_test",
    "cusum_threshold",
]


def _check_cusum(drift: float, threshold: float) -> None:
    drift = number("drift", drift, error=ParameterError)
    threshold = number("threshold", threshold, error=ParameterError)
    if not (math.isfinite(drift) and drift >= 0):
        raise ParameterError(f"drift must be finite and >= 0, got {drift!r}")
    if not (math.isfinite(threshold) and threshold > 0):
        raise ParameterError(f"threshold must be finite and > 0, got {threshold!r}")


def _two_sided(upper: float, lower: float) -> float:
    """Run length of both sides together (van Dobben de Bruyn 1968)."""
    return 1 / (1 / upper + 1 / lower)


def cusum_arl_siegmund(
    drift: float, threshold: float, shift: float = 0.0, *, two_sided: bool = True
) -> float:
    """Return the average run length by Siegmund's approximation, samples.

    Siegmund (1985), Sequential Analysis, section II.6: a Brownian motion whose threshold is raised
    by the mean overshoot, twice 0.583.
    """
    _check_cusum(drift, threshold)
    b = threshold + 1.166

    def one(mean: float) -> float:
        d = mean - drift
        if abs(d) * b < 1e-6:
            return b * b
        return math.inf if -2 * d * b > 700 else (math.expm1(-2 * d * b) + 2 * d * b) / (2 * d * d)

    return _two_sided(one(shift), one(-shift)) if two_sided else one(shift)


def cusum_arl_markov(
    drift: float, threshold: float, shift: float = 0.0, *, two_sided: bool = True, states: int = 400
) -> float:
    """Return the average run length from a Markov chain over cells of the sum, samples.

    Brook and Evans (1972), Biometrika 59, 539-549.  The error falls with the square of ``states``.
    """
    _check_cusum(drift, threshold)
    w = 2 * threshold / (2 * states - 1)

    def one(mean: float) -> float:
        i, j = np.arange(states)[:, None], np.arange(states)[None, :]
        centre = (j - i) * w + drift - mean
        Q = special.ndtr(centre + w / 2) - special.ndtr(centre - w / 2)
        Q[:, 0] = special.ndtr(centre[:, 0] + w / 2)
        return float(linalg.solve(np.eye(states) - Q, np.ones(states))[0])

    return _two_sided(one(shift), one(-shift)) if two_sided else one(shift)


def cusum_arl(
    drift: float,
    threshold: float,
    shift: float = 0.0,
    *,
    two_sided: bool = True,
    nodes: int | None = None,
) -> float:
    """Return the average run length of Page's cumulative sum, samples, to rounding.

    Page (1954), Biometrika 41, 100-115: the run length L(s) from a sum s satisfies
    L(s) = 1 + L(0) F(k - s) + integral of L(x) f(x + k - s) over 0 < x < h, with F, f of the
    standard normal distribution about ``shift``; solved at Gauss-Legendre nodes.  Both sides
    together as 1/L = 1/L+ + 1/L-.

    Args:
        drift, threshold: k and h, in standard deviations of the sequence.
        shift: mean of the sequence, standard deviations; 0 gives the mean time between false
            alarms, a change's size the mean delay of its detection.
        two_sided: watch both signs.
        nodes: of the quadrature; by default enough for eight digits or more.
    """
    _check_cusum(drift, threshold)
    n = nodes or int(40 + 8 * threshold)
    x, w = np.polynomial.legendre.leggauss(n)
    x, w = threshold / 2 * (x + 1), threshold / 2 * w
    at = np.append(0.0, x)  # L at 0, then at the nodes

    def one(mean: float) -> float:
        k = drift - mean
        A = np.zeros((n + 1, n + 1))
        A[:, 0] = special.ndtr(k - at)
        A[:, 1:] = w * np.exp(-((x[None, :] + k - at[:, None]) ** 2) / 2) / math.sqrt(2 * math.pi)
        with np.errstate(all="ignore"):
            run = float(np.linalg.solve(np.eye(n + 1) - A, np.ones(n + 1))[0])
        # beyond 1e13 the equations are singular to rounding
        if not 1 <= run < 1e13:
            raise EstimationError(
                f"CUSUM with drift {drift:g} and threshold {threshold:g}: its run length is too "
                "long to be resolved (> 1e13 samples)"
            )
        return run

    def side(mean: float) -> float:
        try:
            return one(mean)
        except EstimationError:
            # the side against which a large shift moves never alarms
            if two_sided and mean < 0:
                return math.inf
            raise

    return _two_sided(side(shift), side(-shift)) if two_sided else one(shift)


def cusum_threshold(
    drift: float, false_alarms_per_hour: float, rate: float, *, two_sided: bool = True
) -> float:
    """Return the threshold of Page's cumulative sum for a stated false-alarm rate.

    Args:
        drift: k, standard deviations; half of the shift that is to be found soonest.
        false_alarms_per_hour: 3600 rate / (average run length without a shift).
        rate: samples per second.
        two_sided: watch both signs.

    Raises:
        ParameterError: rates not positive, or so high that they are no test.
        EstimationError: run length too long to be computed.

    Examples:
        >>> round(cusum_threshold(0.5, 3600 / 335.37, 1.0, two_sided=False), 3)
        4.0
    """
    target = 1 / allowed_per_sample(false_alarms_per_hour, rate)

    def gap(h: float) -> float:
        return math.log(cusum_arl(drift, h, two_sided=two_sided)) - math.log(target)

    def roughly(h: float) -> float:
        return math.log(cusum_arl_siegmund(drift, h, two_sided=two_sided)) - math.log(target)

    low, top = 1e-3, 2.0
    if gap(low) >= 0:
        raise ParameterError(
            f"drift {drift:g}: even without a sum there are fewer false alarms than "
            f"{false_alarms_per_hour:g} an hour; take a smaller drift"
        )
    # the exact run length is dear where thresholds are high: begin near
    if roughly(low) < 0:
        while roughly(top) < 0:
            top *= 1.5
        near = optimize.brentq(roughly, low, top)
        low, top = max(low, 0.98 * near - 0.1), 1.02 * near + 0.1
    while gap(top) < 0:
        top *= 1.2
    while gap(low) > 0:
        low = max(1e-3, low / 1.2)
    return float(optimize.brentq(gap, low, top, xtol=1e-10, rtol=1e-12))


def cusum(z: np.ndarray, drift: float, start: float = 0.0) -> np.ndarray:
    """Return Page's sum S(k) = max(0, S(k-1) + z(k) - drift), without restarts.

    Args:
        z: shape (..., K).
        drift: k.
        start: S before the first sample.
    """
    c = np.cumsum(np.asarray(z, float) - drift, axis=-1)
    return np.asarray(c - np.minimum(np.minimum.accumulate(c, axis=-1), -start))


def _cusum_alarms(z: np.ndarray, drift: float, threshold: float) -> tuple[np.ndarray, np.ndarray]:
    """Sum that begins anew after each alarm, and its alarms."""
    S, found = np.empty_like(z), []
    at, carry, size = 0, 0.0, 65536
    while at < z.size:
        part = cusum(z[at : at + size], drift, carry)
        above = part > threshold
        k = int(np.argmax(above)) if above.any() else -1
        if k < 0:
            S[at : at + part.size] = part
            at, carry, size = at + part.size, float(part[-1]), min(2 * size, 65536)
        else:
            S[at : at + k + 1] = part[: k + 1]
            found.append(at + k)
            # where alarms are frequent, short pieces save work
            at, carry, size = at + k + 1, 0.0, 256
    return S, np.array(found, dtype=int)


def cusum_test(
    z: np.ndarray,
    *,
    drift: float,
    false_alarms_per_hour: float,
    rate: float,
    two_sided: bool = True,
    start: float = 0.0,
    threshold: float | None = None,
) -> Alarms:
    """Watch a white, unit-variance sequence for a shift of its mean; begins anew after an alarm.

    Args:
        z: shape (K,); such as from :func:`~estimators.detection.signatures.project`.  NaN (nothing
            measured) counts as no evidence.
        drift, false_alarms_per_hour, rate, two_sided: see :func:`cusum_threshold`.
        start: time of the first sample, s.
        threshold: if it is known already.

    Returns:
        Alarms whose statistic is the larger of the two sums.

    Raises:
        SignalError: not one sequence, or infinite. ParameterError : see :func:`cusum_threshold`.
    """
    z = plain_numbers(z, "z", gaps=True)
    if z.ndim != 1 or np.isinf(z).any():
        raise SignalError(f"z: one finite sequence expected, got shape {z.shape}")
    if threshold is None:
        threshold = cusum_threshold(drift, false_alarms_per_hour, rate, two_sided=two_sided)
    _check_cusum(drift, threshold)
    S, index = _cusum_alarms(np.where(np.isnan(z), drift, z), drift, threshold)
    if two_sided:
        S2, index2 = _cusum_alarms(np.where(np.isnan(z), drift, -z), drift, threshold)
        S, index = np.maximum(S, S2), np.union1d(index, index2)
    return Alarms("CUSUM", S, threshold, index, rate, false_alarms_per_hour, start)
