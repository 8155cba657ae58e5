"""Detection of changes from innovations, each test with a false-alarm rate that it keeps.

Three tests on the innovations of a filter, which are white and of known covariance as long as the
filter's model holds:

* :func:`nis_test`: the normalised innovation squared (NIS), summed over a window: any change;
* :func:`cusum_test`: Page's cumulative sum of a scalar: a shift of stated size, both signs;
* :func:`glr` and :func:`glr_test`: the generalised likelihood ratio of Willsky and Jones
  (1976), IEEE Trans. Automatic Control 21, 108-112: jumps in states, parameters and sensors, whose
  *signature* in the innovations is carried through the filter; size and onset are estimated.

A threshold is found from the false alarms per hour that are allowed, never the other way round:
of the windowed NIS by the exact rate of up-crossings, of the cumulative sum by its exact average
run length (:func:`cusum_arl`; :func:`cusum_arl_markov` and :func:`cusum_arl_siegmund` are two other
routes to the same number), of the likelihood ratio by simulation with a fitted tail.

All of them stand on white, normalised innovations.  A filter that is not consistent, or whose model
is wrong, raises more alarms than stated: judge that first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from scipy import linalg, optimize, signal, special, stats

from apu_casadi.backend import compiled, mapped
from apu_casadi.errors import EstimationError, ParameterError, SignalError, nearest
from estimators.filtering import FilterResult
from estimators.model import FilterModel
from estimators.recording import Recording

__all__ = [
    "Alarms",
    "Glr",
    "Jump",
    "LinearFilter",
    "cusum",
    "cusum_arl",
    "cusum_arl_markov",
    "cusum_arl_siegmund",
    "cusum_test",
    "cusum_threshold",
    "glr",
    "glr_stationary",
    "glr_statistic",
    "glr_test",
    "glr_threshold",
    "linear_filter",
    "linearised",
    "nis_test",
    "nis_threshold",
    "project",
    "upcrossing_rate",
    "windowed_nis",
]

HOUR = 3600.0  # s


# ------------------------------------------------------------------------------ what comes out


@dataclass(frozen=True, eq=False)
class Alarms:
    """What a test said along a sequence of K samples.

    Parameters
    ----------
    test : its name.
    statistic : shape (K,); NaN where it could not be formed.
    threshold : an alarm is raised where the statistic passes it; a number, or one per sample.
    index : samples at which an alarm was raised, increasing.
    rate : samples per second.
    false_alarms_per_hour : the stated rate, with which the threshold was found.
    start : time of the first sample, s.
    """

    test: str
    statistic: np.ndarray
    threshold: Any
    index: np.ndarray
    rate: float
    false_alarms_per_hour: float
    start: float = 0.0

    @property
    def times(self) -> np.ndarray:
        """Times of the alarms, s."""
        return self.start + self.index / self.rate

    def delay(self, onset: float) -> float:
        """Return the time from an onset (s) to the first alarm at or after it, s; inf if none."""
        late = self.times[self.times >= onset - 0.5 / self.rate]
        return float(max(late[0] - onset, 0.0)) if late.size else math.inf

    def before(self, onset: float) -> int:
        """Return the number of alarms before an onset: false ones."""
        return int((self.times < onset - 0.5 / self.rate).sum())

    def to_dict(self, limit: int = 1000) -> dict[str, Any]:
        """Return numbers that JSON can hold: what was asked, number and first ``limit`` alarms."""
        peak = float(np.nanmax(self.statistic)) if np.isfinite(self.statistic).any() else None
        threshold = np.asarray(self.threshold, float)
        finite = threshold[np.isfinite(threshold)]
        return {
            "test": self.test,
            "samples": int(self.statistic.size),
            "rate_Hz": self.rate,
            "false_alarms_per_hour": self.false_alarms_per_hour,
            "threshold": float(np.median(finite)) if finite.size else None,
            "peak": peak,
            "alarms": int(self.index.size),
            "times_s": self.times[:limit].tolist(),
        }


def _rising(above: np.ndarray) -> np.ndarray:
    """Indices at which a condition begins to hold."""
    return np.flatnonzero(above & ~np.concatenate([[False], above[:-1]]))


def _allowed(false_alarms_per_hour: float, rate: float) -> float:
    """Return the false alarms for each sample that are allowed."""
    for name, value in (("false_alarms_per_hour", false_alarms_per_hour), ("rate", rate)):
        if not (math.isfinite(value) and value > 0):
            raise ParameterError(f"{name} must be finite and > 0, got {value!r}")
    per_sample = false_alarms_per_hour / (HOUR * rate)
    if per_sample >= 0.1:
        raise ParameterError(
            f"{false_alarms_per_hour:g} false alarms an hour at {rate:g} samples a second are "
            f"{per_sample:.2g} for each sample: that is no test; ask for fewer than 0.1"
        )
    return per_sample


# ------------------------------------------------------------------------------ windowed NIS


def windowed_nis(
    nis: np.ndarray, measured: np.ndarray, window: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return sums over the last ``window`` samples of the NIS and of the numbers measured.

    Parameters
    ----------
    nis, measured : shape (K,), as in a :class:`~estimators.filtering.FilterResult`.
    window : samples; the first ``window - 1`` sums are over fewer, since there are no more.

    Returns
    -------
    (sum, degrees of freedom), each of shape (K,).

    Raises
    ------
    SignalError : shapes that differ, values not finite. ParameterError : window < 1.
    """
    nis, measured = np.asarray(nis, float), np.asarray(measured, float)
    if nis.ndim != 1 or nis.shape != measured.shape:
        raise SignalError(f"nis and measured of one length expected, got {nis.shape} and "
                          f"{measured.shape}")  # fmt: skip
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


def upcrossing_rate(threshold: float, dof: int, window: int) -> float:
    """Return how often, for each sample, a moving sum of chi-squared values rises past a threshold.

    The sums before and after a sample share window - 1 terms, A; the rate of "not above, then
    above" is E[F(c - A) (1 - F(c - A))] with F the distribution of one term: exact, whatever the
    correlation of the sums, and the expected number of alarms for each sample if an alarm is such
    a crossing.

    Parameters
    ----------
    threshold : c > 0.
    dof : degrees of freedom of one term.
    window : terms in the sum.
    """
    if window == 1:
        return float(stats.chi2.cdf(threshold, dof) * stats.chi2.sf(threshold, dof))
    # a = c - t^2: smooth at the edge also for one degree of freedom; beyond 40 sd nothing is left
    reach = math.sqrt(min(threshold, dof + 40 * math.sqrt(2 * dof) + 80))
    t, w = np.polynomial.legendre.leggauss(400)
    t, w = reach / 2 * (t + 1), reach / 2 * w
    shared = stats.chi2.pdf(threshold - t**2, dof * (window - 1))
    one = stats.chi2.cdf(t**2, dof) * stats.chi2.sf(t**2, dof)
    return float(np.sum(w * 2 * t * shared * one))


def nis_threshold(
    dof: int, window: int, false_alarms_per_hour: float, rate: float
) -> tuple[float, float]:
    """Return the threshold of the windowed NIS, and the share of samples above it.

    Parameters
    ----------
    dof : outputs measured at each sample.
    window : samples.
    false_alarms_per_hour : up-crossings of the threshold in an hour without a change.
    rate : samples per second.

    Returns
    -------
    (threshold, probability that a window's sum is above it).

    Raises
    ------
    ParameterError : rates not positive, or so high that no threshold gives them.
    """
    allowed = _allowed(false_alarms_per_hour, rate)
    if not (dof >= 1 and window >= 1):
        raise ParameterError(f"dof and window must be >= 1, got {dof!r} and {window!r}")
    mean = float(stats.chi2.median(dof * window))
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
    return float(c), float(stats.chi2.sf(c, dof * window))


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

    Parameters
    ----------
    nis, measured : of a :class:`~estimators.filtering.FilterResult`, shape (K,).
    window : samples; longer windows find smaller changes, later.
    false_alarms_per_hour : stated rate; with all outputs measured at each sample it is exact.  With
        gaps, each window is held to the same probability at its own degrees of freedom.
    rate : samples per second.
    start : time of the first sample, s.

    Raises
    ------
    SignalError, ParameterError : see :func:`windowed_nis` and :func:`nis_threshold`.
    """
    total, dof = windowed_nis(nis, measured, window)
    most = int(np.max(measured, initial=0))
    if most < 1:
        raise SignalError("nothing was measured")
    _, p = nis_threshold(most, window, false_alarms_per_hour, rate)
    kinds, back = np.unique(dof, return_inverse=True)
    limit = np.where(kinds > 0, stats.chi2.isf(p, np.maximum(kinds, 1)), np.inf)[back]
    return Alarms(
        f"NIS over {window} samples",
        total,
        limit,
        _rising(total > limit),
        rate,
        false_alarms_per_hour,
        start,
    )


# ------------------------------------------------------------------------------ cumulative sum


def _check_cusum(drift: float, threshold: float) -> None:
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
    drift: float,
    threshold: float,
    shift: float = 0.0,
    *,
    two_sided: bool = True,
    states: int = 400,
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

    Parameters
    ----------
    drift, threshold : k and h, in standard deviations of the sequence.
    shift : mean of the sequence, standard deviations; 0 gives the mean time between false alarms,
        a change's size the mean delay of its detection.
    two_sided : watch both signs.
    nodes : of the quadrature; by default enough for eight digits or more.
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

    Parameters
    ----------
    drift : k, standard deviations; half of the shift that is to be found soonest.
    false_alarms_per_hour : 3600 rate / (average run length without a shift).
    rate : samples per second.
    two_sided : watch both signs.

    Raises
    ------
    ParameterError : rates not positive, or so high that they are no test.
    EstimationError : run length too long to be computed.

    Examples
    --------
    >>> round(cusum_threshold(0.5, 3600 / 335.37, 1.0, two_sided=False), 3)
    4.0
    """
    target = 1 / _allowed(false_alarms_per_hour, rate)

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

    Parameters
    ----------
    z : shape (..., K).
    drift : k.
    start : S before the first sample.
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

    Parameters
    ----------
    z : shape (K,); such as from :func:`project`.  NaN (nothing measured) counts as no evidence.
    drift, false_alarms_per_hour, rate, two_sided : see :func:`cusum_threshold`.
    start : time of the first sample, s.
    threshold : if it is known already.

    Returns
    -------
    Alarms whose statistic is the larger of the two sums.

    Raises
    ------
    SignalError : not one sequence, or infinite. ParameterError : see :func:`cusum_threshold`.
    """
    z = np.asarray(z, float)
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


# ------------------------------------------------------------------------------ signatures


@dataclass(frozen=True)
class Jump:
    """A change that begins at some sample and stays.

    Parameters
    ----------
    kind : ``"state"`` (the state is displaced once), ``"parameter"`` (a known parameter has another
        value from then on), ``"sensor"`` (bias of an output from then on), or ``"gain"`` (an output
        is multiplied by 1 + size).
    name : of the state, parameter or output.
    scale : size of a unit jump, own unit.
    """

    kind: str
    name: str
    scale: float = 1.0

    def __post_init__(self) -> None:
        """Check the kind."""
        kinds = ("state", "parameter", "sensor", "gain")
        if self.kind not in kinds:
            raise ParameterError(f"kind of jump {self.kind!r} {nearest(self.kind, kinds)}")


@dataclass(frozen=True, eq=False)
class LinearFilter:
    """A filter along a recording, linear about its own estimates, and where jumps enter it.

    The prediction error e and innovation nu, without noise, go as nu = H e + output,
    e(k+1) = A e - L nu + drift; a jump begins with e = state.

    Parameters
    ----------
    names : of the q jumps.
    A, L, H : (K, nx, nx), (K, nx, ny), (K, ny, nx); L is the gain to the next prediction.
    S : covariance of the innovations, (K, ny, ny).
    innovation : (K, ny), 0 where nothing was measured, and so are the rows of H and ``output``.
    state : (nx, q). drift : (K, nx, q). output : (K, ny, q).
    """

    names: tuple[str, ...]
    A: np.ndarray
    L: np.ndarray
    H: np.ndarray
    S: np.ndarray
    innovation: np.ndarray
    state: np.ndarray
    drift: np.ndarray
    output: np.ndarray

    @property
    def size(self) -> int:
        """Number of samples K."""
        return int(self.A.shape[0])

    def columns(self, names: Sequence[str]) -> list[int]:
        """Return the positions of jumps.

        Raises
        ------
        SignalError : unknown name.
        """
        for n in names:
            if n not in self.names:
                raise SignalError(f"unknown jump {n!r} {nearest(n, self.names)}")
        return [self.names.index(n) for n in names]

    def signature(self, onset: int, stop: int | None = None) -> np.ndarray:
        """Return what unit jumps at a sample add to the innovations, shape (K - onset, ny, q)."""
        e, out = self.state.copy(), []
        for k in range(onset, self.size if stop is None else stop):
            g = self.H[k] @ e + self.output[k]
            out.append(g)
            e = self.A[k] @ e - self.L[k] @ g + self.drift[k]
        return np.array(out)


def linear_filter(
    y: np.ndarray,
    *,
    A: np.ndarray,
    H: np.ndarray,
    Q: np.ndarray,
    R: np.ndarray,
    P0: np.ndarray,
    m0: np.ndarray | None = None,
    names: Sequence[str] = (),
    state: np.ndarray | None = None,
    drift: np.ndarray | None = None,
    output: np.ndarray | None = None,
    cross: np.ndarray | None = None,
) -> LinearFilter:
    """Run the Kalman filter of a linear, time-invariant model and tell where jumps enter.

    y = H x + v, x(k+1) = A x + w with covariances R, Q and E[w v'] = ``cross``.

    Parameters
    ----------
    y : (K, ny); NaN where nothing was measured.
    A, H, Q, R, P0, m0 : the model and the belief before the first sample; m0 = 0 by default.
    names, state, drift, output : jumps, (nx, q), (nx, q), (ny, q); 0 by default.
    cross : (nx, ny), 0 by default.

    Raises
    ------
    SignalError : shapes that do not fit.
    """
    y = np.asarray(y, float)
    nx, q = A.shape[0], len(names)
    ny = H.shape[0]
    if y.ndim != 2 or y.shape[1] != ny or H.shape != (ny, nx) or R.shape != (ny, ny):
        raise SignalError(f"shapes do not fit: y {y.shape}, A {A.shape}, H {H.shape}, R {R.shape}")
    K = y.shape[0]
    M = np.zeros((nx, ny)) if cross is None else cross
    m, P = np.zeros(nx) if m0 is None else m0, P0
    Ls: list[np.ndarray] = []
    Hs: list[np.ndarray] = []
    Ss: list[np.ndarray] = []
    nus: list[np.ndarray] = []
    for yk in y:
        there = ~np.isnan(yk)
        Hk = H * there[:, None]
        S = np.where(np.outer(there, there), Hk @ P @ Hk.T + R, 0.0)
        S[~there, ~there] = 1.0
        nu = np.where(there, yk - H @ m, 0.0)
        Mk = M * there
        L = np.linalg.solve(S, (A @ P @ Hk.T + Mk).T).T
        m = A @ m + L @ nu
        P = A @ P @ A.T + Q - L @ S @ L.T
        P = (P + P.T) / 2
        for kept, v in zip((Ls, Hs, Ss, nus), (L, Hk, S, nu), strict=True):
            kept.append(v)
    there = ~np.isnan(y)
    out = np.zeros((ny, q)) if output is None else output
    return LinearFilter(
        tuple(names),
        np.broadcast_to(A, (K, nx, nx)),
        np.array(Ls),
        np.array(Hs),
        np.array(Ss),
        np.array(nus),
        np.zeros((nx, q)) if state is None else state,
        np.broadcast_to(np.zeros((nx, q)) if drift is None else drift, (K, nx, q)),
        there[:, :, None] * out,
    )


def linearised(
    model: FilterModel,
    result: FilterResult,
    data: Recording,
    jumps: Sequence[Jump] = (),
    *,
    backend: str | None = None,
) -> LinearFilter:
    """Linearise a filter about its own estimates, with exact derivatives.

    For an extended Kalman filter these are the very matrices that it used; for an unscented one an
    approximation of the same order as its own.

    Parameters
    ----------
    model, data : what the filter was run with.
    result : of a run with ``full=True``.
    jumps : what may change; their names must differ.
    backend : see :func:`apu_casadi.backend.compiled`.

    Raises
    ------
    EstimationError : the filter did not keep what is needed.
    SignalError : a jump of an unknown state, parameter or output.
    """
    r = result
    if r.mean_pred is None or r.cov_pred is None:
        raise EstimationError("linearising a filter needs its run with full=True")
    nx, _, np_, nw, ny = model.sizes
    q, K = len(jumps), data.size
    where = {"state": model.x, "parameter": model.p, "sensor": model.y, "gain": model.y}
    place = [where[j.kind].index(j.name) for j in jumps]
    rates, outs = _jacobians(model, backend)
    missing = np.isnan(data.y)
    p = data.p[:, None]
    h, Hx, Hw, Hp = _stacks(
        outs(r.mean_pred, data.u, p, np.zeros((nw, 1))), [(ny, 1), (ny, nx), (ny, nw), (ny, np_)], K
    )
    here = (~missing.T)[:, :, None]
    Hx, Hw, Hp = Hx * here, Hw * here, Hp * here
    R = np.where(missing, 1.0, data.variance).T
    S = Hx @ r.cov_pred @ Hx.transpose(0, 2, 1) + Hw @ Hw.transpose(0, 2, 1)
    S[:, range(ny), range(ny)] += R
    PH = np.concatenate([r.cov_pred @ Hx.transpose(0, 2, 1), Hw.transpose(0, 2, 1)], axis=1)
    gain = np.linalg.solve(S, PH.transpose(0, 2, 1)).transpose(0, 2, 1)
    gain[:, model.x.indices(model.consider), :] = 0.0
    nu = np.where(missing, 0.0, r.innovation).T
    w = np.einsum("kij,kj->ik", gain[:, nx:], nu) if nw else np.zeros((0, 1))
    Fx, Fw, Fp = _stacks(
        rates(r.mean, data.u, p, w, data.dt[None, :]), [(nx, nx), (nx, nw), (nx, np_)], K
    )
    L = Fx @ gain[:, :nx] + Fw @ gain[:, nx:]
    state, drift, output = np.zeros((nx, q)), np.zeros((K, nx, q)), np.zeros((K, ny, q))
    for c, (j, i) in enumerate(zip(jumps, place, strict=True)):
        if j.kind == "state":
            state[i, c] = j.scale
        elif j.kind == "parameter":
            drift[:, :, c], output[:, :, c] = j.scale * Fp[:, :, i], j.scale * Hp[:, :, i]
        else:
            size = j.scale * (h[:, i, 0] if j.kind == "gain" else 1.0)
            output[:, i, c] = size * ~missing[i]
    names = tuple(j.name if j.kind in ("state", "parameter") else f"{j.kind} {j.name}"
                  for j in jumps)  # fmt: skip
    if len(set(names)) < q:
        raise SignalError(f"jumps are not distinct: {', '.join(names)}")
    return LinearFilter(names, Fx, L, Hx, S, nu, state, drift, output)


_JACOBIANS: dict[tuple[int, int, str | None], tuple[Any, Any, Any]] = {}


def _jacobians(model: FilterModel, backend: str | None) -> tuple[Any, Any]:
    """Batch forms of the Jacobians of transition and output; kept for a model's functions."""
    key = (hash(model.transition), hash(model.output), backend)
    if key not in _JACOBIANS:
        x, u, p, w, dt = model.symbols()
        x1, _ = model.transition(x, u, p, w, dt)
        y, _ = model.output(x, u, p, w)

        def made(name: str, args: list[Any], of: list[Any]) -> Any:
            columns = [ca.vec(ca.densify(e)) for e in of]
            return mapped(compiled(ca.Function(name, args, columns), backend=backend), 1)

        rates = made(f"{model.name}_df", [x, u, p, w, dt], [ca.jacobian(x1, v) for v in (x, w, p)])
        outs = made(f"{model.name}_dg", [x, u, p, w], [y, *(ca.jacobian(y, v) for v in (x, w, p))])
        # the model is kept too, so that a hash is never that of another, later function
        _JACOBIANS[key] = (rates, outs, model)
    return _JACOBIANS[key][:2]


def _stacks(
    columns: Sequence[np.ndarray], shapes: Sequence[tuple[int, int]], K: int
) -> list[np.ndarray]:
    """Columns of vec(matrix) to stacks of matrices."""
    return [
        np.broadcast_to(c, (c.shape[0], K)).T.reshape(K, m, n).transpose(0, 2, 1).copy()
        for c, (n, m) in zip(columns, shapes, strict=True)
    ]


def project(innovation: np.ndarray, S: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the component of innovations along a direction, of unit variance.

    z = d' S^-1 nu / sqrt(d' S^-1 d): white and normal if the filter is consistent; a change that
    adds s d to the innovations shifts it by s sqrt(d' S^-1 d).

    Parameters
    ----------
    innovation : (K, ny); NaN where nothing was measured.
    S : (K, ny, ny) or (ny, ny), diagonal where nothing was measured, as in a filter's result.
    direction : (K, ny) or (ny,).

    Returns
    -------
    z, shape (K,); NaN where nothing along the direction was measured.

    Raises
    ------
    SignalError : a direction that is zero though all was measured.
    """
    nu = np.asarray(innovation, float)
    there = ~np.isnan(nu)
    d = np.where(there, np.broadcast_to(direction, nu.shape), 0.0)
    nu = np.where(there, nu, 0.0)
    weight = np.linalg.solve(np.broadcast_to(S, (*nu.shape, nu.shape[1])), d[:, :, None])[:, :, 0]
    scale = np.einsum("ki,ki->k", weight, d)
    nothing = ~(scale > 0)
    if (nothing & there.all(1)).any():
        k = int(np.argmax(nothing & there.all(1)))
        raise SignalError(f"the direction is zero at sample {k}")
    along = np.einsum("ki,ki->k", weight, nu) / np.sqrt(np.where(nothing, 1.0, scale))
    return np.asarray(np.where(nothing, np.nan, along))


# ------------------------------------------------------------------------------ likelihood ratio


@dataclass(frozen=True, eq=False)
class Glr:
    """Evidence for jumps at several onsets, as it stands at the end of the samples.

    The log-likelihood gained by jumps of sizes s is b's - s'Cs/2.

    Parameters
    ----------
    names : of the q jumps.
    onsets : samples, (m,).
    b : (m, q). C : information, (m, q, q).
    """

    names: tuple[str, ...]
    onsets: np.ndarray
    b: np.ndarray
    C: np.ndarray

    def part(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return b and C of some jumps.

        Raises
        ------
        SignalError : unknown name.
        """
        for n in names:
            if n not in self.names:
                raise SignalError(f"unknown jump {n!r} {nearest(n, self.names)}")
        i = [self.names.index(n) for n in names]
        return self.b[:, i], self.C[:, i][:, :, i]

    def size(self, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return the most likely sizes (m, n) and their covariances (m, n, n), at each onset."""
        b, C = self.part(names)
        P = np.linalg.inv(C)
        return np.einsum("kij,kj->ki", P, b), P

    def statistic(self, names: Sequence[str]) -> np.ndarray:
        """Return the logarithm of the likelihood ratio with the most likely sizes, (m,)."""
        b, C = self.part(names)
        return np.asarray(np.einsum("ki,ki->k", b, np.linalg.solve(C, b[:, :, None])[:, :, 0]) / 2)

    def log_marginal(self, names: Sequence[str], mean: Any, cov: Any) -> np.ndarray:
        """Return the logarithm of the ratio of marginal likelihoods, sizes normal, (m,).

        Parameters
        ----------
        mean, cov : prior of the sizes, (n,) and (n, n): the penalty that a maximum lacks.
        """
        b, C = self.part(names)
        mean, cov = np.asarray(mean, float), np.asarray(cov, float)
        # about the prior mean: b's - s'Cs/2 with s = mean + d
        at = C @ mean
        gain = b @ mean - 0.5 * at @ mean
        b = b - at
        n = len(names)
        M = np.eye(n) + cov @ C
        post = np.linalg.solve(M, (cov @ b[:, :, None]))[:, :, 0]
        return np.asarray(
            gain + 0.5 * np.einsum("ki,ki->k", b, post) - 0.5 * np.linalg.slogdet(M)[1]
        )


def glr(filter: LinearFilter, onsets: Sequence[int] | np.ndarray, stop: int | None = None) -> Glr:
    """Gather the evidence for jumps at each of several onsets, up to ``stop``.

    Parameters
    ----------
    filter : innovations, and where jumps enter.
    onsets : samples at which a jump may have happened.
    stop : samples k < stop are used; all by default.

    Raises
    ------
    ParameterError : no onsets, or one outside the samples.
    """
    at = np.asarray(onsets, int)
    end = filter.size if stop is None else stop
    if at.ndim != 1 or at.size == 0 or at.min() < 0 or at.max() >= end:
        raise ParameterError(f"onsets must lie within the samples 0 to {end - 1}, got {at!r:.80}")
    nx, q = filter.state.shape
    b, C = np.zeros((at.size, q)), np.zeros((at.size, q, q))
    e = np.zeros((at.size, nx, q))
    f = filter
    for k in range(int(at.min()), end):
        e[at == k] = f.state
        on = at <= k
        g = f.H[k] @ e[on] + f.output[k]
        weighted = np.linalg.solve(f.S[k], g)
        b[on] += np.einsum("miq,i->mq", weighted, f.innovation[k])
        C[on] += weighted.transpose(0, 2, 1) @ g
        e[on] = f.A[k] @ e[on] - f.L[k] @ g + f.drift[k]
    return Glr(f.names, at, b, (C + C.transpose(0, 2, 1)) / 2)


def glr_statistic(
    filter: LinearFilter, name: str, window: int, every: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Return the likelihood ratio's logarithm for one jump, at each sample over recent onsets.

    Parameters
    ----------
    filter : innovations, and where jumps enter.
    name : of the jump.
    window : samples; onsets further back are forgotten.
    every : samples between the onsets that are tried.

    Returns
    -------
    (largest b^2/(2 C), its onset) at each sample, shapes (K,).

    Raises
    ------
    SignalError : unknown jump. ParameterError : window or spacing < 1.
    """
    (c,) = filter.columns([name])
    if window < 1 or every < 1:
        raise ParameterError(f"window and every must be >= 1, got {window!r} and {every!r}")
    f = filter
    slots = -(-window // every)
    nx = f.state.shape[0]
    b, C, e = np.zeros(slots), np.zeros(slots), np.zeros((slots, nx, 1))
    onset = np.full(slots, -1)
    best, where = np.zeros(f.size), np.zeros(f.size, int)
    state = f.state[:, [c]]
    for k in range(f.size):
        if k % every == 0:
            i = (k // every) % slots  # the oldest onset gives way
            b[i], C[i], e[i], onset[i] = 0.0, 0.0, state, k
        g = f.H[k] @ e + f.output[k][:, [c]]
        weighted = np.linalg.solve(f.S[k], g)
        b += weighted[:, :, 0] @ f.innovation[k]
        C += (weighted * g)[:, :, 0].sum(1)
        e = f.A[k] @ e - f.L[k] @ g + f.drift[k][:, [c]]
        on = (onset >= 0) & (C > 0)
        ratio = np.where(on, b**2 / (2 * np.where(on, C, 1.0)), 0.0)
        i = int(np.argmax(ratio))
        best[k], where[k] = ratio[i], max(onset[i], 0)
    return best, where


def glr_test(
    filter: LinearFilter,
    name: str,
    *,
    window: int,
    false_alarms_per_hour: float,
    rate: float,
    every: int = 1,
    start: float = 0.0,
    threshold: float | None = None,
    samples: int = 500_000,
) -> Alarms:
    """Watch a filter's innovations for one jump of unknown size, sign and onset.

    Parameters
    ----------
    filter : innovations, and where jumps enter.
    name : of the jump.
    window, every : see :func:`glr_statistic`.
    false_alarms_per_hour : stated rate, kept by a filter that has settled.
    rate : samples per second.
    start : time of the first sample, s.
    threshold : if it is known already; otherwise from :func:`glr_threshold` with the signature at
        the end of the samples.
    samples : of that simulation.

    Raises
    ------
    SignalError, ParameterError : see :func:`glr_statistic` and :func:`glr_threshold`; fewer samples
        than the window.
    """
    (c,) = filter.columns([name])
    if threshold is None:
        first = filter.size - window
        if first < 0:
            raise ParameterError(
                f"a signature of {window} samples cannot be had from {filter.size}; give threshold"
            )
        L = np.linalg.inv(np.linalg.cholesky(filter.S[first:]))
        white = (L @ filter.signature(first))[:, :, c]
        lengths = range(every, window + 1, every)
        threshold = glr_threshold(white, lengths, false_alarms_per_hour, rate, samples=samples)[
            "threshold"
        ]
    best, _ = glr_statistic(filter, name, window, every)
    return Alarms(
        f"GLR of {name}",
        best,
        threshold,
        _rising(best > threshold),
        rate,
        false_alarms_per_hour,
        start,
    )


def glr_stationary(
    white: np.ndarray, signature: np.ndarray, lengths: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the statistic of :func:`glr_statistic` for a filter that has settled; fast.

    The signature is then the same for every onset, and the evidence for an onset n samples back is
    a matched filter of length n: ten million samples take seconds.

    Parameters
    ----------
    white : innovations multiplied by S^(-1/2), (K, ny): white, of unit variance.
    signature : what a unit jump adds to them, in the same units, (M, ny), from its onset on.
    lengths : ages of the onset that are tried, samples, at most M.

    Returns
    -------
    (largest b^2/(2 C) over the ages, the age) at each sample, shapes (K,).  An age is not tried
    before as many samples have come.

    Raises
    ------
    ParameterError : a length outside 1 to M. SignalError : shapes that do not fit.
    """
    white, signature = np.asarray(white, float), np.asarray(signature, float)
    if white.ndim != 2 or signature.ndim != 2 or white.shape[1] != signature.shape[1]:
        raise SignalError(f"(K, ny) and (M, ny) expected, got {white.shape}, {signature.shape}")
    K, M = white.shape[0], signature.shape[0]
    if not lengths or min(lengths) < 1 or max(lengths) > M:
        raise ParameterError(f"lengths must lie from 1 to {M}, got {list(lengths)!r:.80}")
    best, age = np.zeros(K), np.zeros(K, int)
    for n in lengths:
        if n > K:
            continue
        g = signature[:n]
        C = float(np.sum(g**2))
        if C == 0:
            continue
        b = sum(signal.oaconvolve(white[:, i], g[::-1, i])[n - 1 : K] for i in range(g.shape[1]))
        ratio = np.asarray(b) ** 2 / (2 * C)
        better = ratio > best[n - 1 :]
        best[n - 1 :] = np.where(better, ratio, best[n - 1 :])
        age[n - 1 :][better] = n
    return best, age


def glr_threshold(
    signature: np.ndarray,
    lengths: Sequence[int],
    false_alarms_per_hour: float,
    rate: float,
    *,
    samples: int = 2_000_000,
    seed: int = 0,
) -> dict[str, float]:
    """Return the threshold of :func:`glr_stationary` for a stated false-alarm rate.

    White noise is simulated, and the rate of up-crossings fitted as A c^B exp(-c), the form of the
    tail of a maximum over correlated chi-squared values; the threshold lies on the fitted tail,
    mostly beyond what was simulated.

    Parameters
    ----------
    signature, lengths : see :func:`glr_stationary`.
    false_alarms_per_hour : up-crossings in an hour without a change.
    rate : samples per second.
    samples, seed : of the simulation.

    Returns
    -------
    ``threshold``; ``sigma``, its standard deviation from the simulation's eight parts; ``A`` and
    ``B`` of the tail (for each sample); ``largest``, the level up to which the tail was seen.

    Raises
    ------
    ParameterError : rates, too few samples (< 1e5), or lengths outside the signature.
    """
    allowed = _allowed(false_alarms_per_hour, rate)
    if samples < 100_000:
        raise ParameterError(f"at least 1e5 samples are needed for a tail, got {samples!r}")
    rng = np.random.default_rng(seed)
    parts = 8
    n = samples // parts
    ny = np.shape(signature)[1]
    peaks = []
    for _ in range(parts):
        ratio, _ = glr_stationary(rng.standard_normal((n, ny)), signature, lengths)
        peaks.append(ratio[max(lengths) :])
    levels = np.arange(2.0, 40.0, 0.25)
    crossings = np.array([[np.sum((r[1:] > c) & (r[:-1] <= c)) for c in levels] for r in peaks])

    def fit(count: np.ndarray, size: float) -> tuple[float, float, float, float]:
        """(threshold, log A, B, largest level): weighted by the counts, from where crossings
        are rare enough to be clumps."""
        use = (count >= 20) & (count < 0.005 * size)
        if use.sum() < 4:
            raise ParameterError(f"{samples} samples show too little of the tail; take more")
        c, w = levels[use], np.sqrt(count[use])
        target = np.log(count[use] / size) + c
        B, a = np.polyfit(np.log(c), target, 1, w=w)
        low, top = 1.0, 10.0

        def gap(v: float) -> float:
            return float(a + B * math.log(v) - v - math.log(allowed))

        low = max(low, float(B))  # beyond its maximum the tail falls
        while gap(top) > 0:
            top *= 1.5
        if gap(low) <= 0:
            raise ParameterError(
                f"{false_alarms_per_hour:g} false alarms an hour are more than there are crossings"
            )
        return float(optimize.brentq(gap, low, top)), float(a), float(B), float(c[-1])

    size = float(sum(r.size - 1 for r in peaks))
    threshold, a, B, largest = fit(crossings.sum(0), size)
    # leave one part out in turn: the jackknife
    left = [fit(crossings.sum(0) - crossings[i], size * (parts - 1) / parts)[0]
            for i in range(parts)]  # fmt: skip
    sigma = math.sqrt((parts - 1) / parts * float(np.sum((np.array(left) - np.mean(left)) ** 2)))
    return {
        "threshold": threshold,
        "sigma": sigma,
        "A": math.exp(a),
        "B": B,
        "largest": largest,
    }
