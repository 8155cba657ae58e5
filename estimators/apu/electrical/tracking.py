"""Runs in which faults come and go, and the mean power of windows as measurements of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from apu_casadi.core.errors import EstimationError
from apu_casadi.machine.terminals import SHUNTS
from estimators.apu.electrical.electricalfilter import ElectricalFilter, considering
from estimators.apu.electrical.hypotheses import COMMON
from estimators.apu.electrical.terminalsignals import MEASURED
from estimators.apu.electrical.tuning import (
    H_BALANCED,
    ONSET_LEVEL,
    RESET_LEVEL,
    RESET_SIGMA,
    RESET_WINDOW,
)
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import (
    FilterResult,
    FilterStep,
    StepMaker,
    result_of,
    run,
    sweep_of,
)
from estimators.filters.sweeping import Sweep
from estimators.models.recording import Recording

__all__ = ["LostError", "track", "window_power"]

CHUNK = 80 * RESET_WINDOW  # samples that are filtered before they are judged


class LostError(EstimationError):
    """The model does not fit the data; ``resets``: where the filter began anew, s."""

    resets: tuple[float, ...]

    def __init__(self, resets: Sequence[float], text: str) -> None:
        super().__init__(text)
        self.resets = tuple(resets)


def track(
    filt: ElectricalFilter,
    prior: Belief,
    data: Recording,
    *,
    step: StepMaker = ekf_step,
    backend: str | None = None,
    max_resets: int = 20,
    own_level: bool | None = None,
    cov_at: np.ndarray | None = None,
    common: float = H_BALANCED,
) -> tuple[FilterResult, list[float]]:
    """Filter a recording in which faults come and go: h follows steps at once.

    The random walk of h is for slow changes; a step of 1e-3 would take it 0.2 s.  So the
    innovations are watched: where their normalised square, averaged over ``RESET_WINDOW`` samples,
    exceeds ``RESET_LEVEL``, h and fluxes become uncertain again at the window's start
    (``RESET_SIGMA``).  The first two windows of a piece are not judged: a start needs them.

    Where gains are estimated, they are considered from the first reset on, with what is known then:
    during the transient of a fault they are learnt falsely, by 18 to 48 claimed deviations, and h
    with them by 6 to 10, at severities of 2.4e-3 to 1e-2 and NIS 4 to 5.

    Args:
        filt, prior, data, step, backend: as of the filter; ``step`` makes its step.
        max_resets: more than these, and the model is refused.
        own_level: whether a window is compared with those before it (the first four are not judged)
            instead of with white innovations: where gain errors are considered (the default there),
            or taken as noise, each unit has a level of its own.
        cov_at: samples whose covariances are kept, see :func:`estimators.filters.filtering.run`.
        common: what all three h may have in common after a reset, as ``H_BALANCED``.

    Returns:
        Result as from one filter, and the resets, s; where gains are unknown, variances of the
        three severities, and the final belief, hold what these have in common beside the claim.

    Raises:
        EstimationError: more than ``max_resets`` resets: the model does not fit the data at all.
    """
    own = filt.gains == "consider" if own_level is None else own_level
    made, model = step(filt.model), filt.model
    pieces: list[FilterResult] = []
    sweep = _sweep(made, prior, data, cov_at, backend)
    resets: list[float] = []
    share = np.zeros(0)  # mean NIS of the windows since the last reset
    at = 0
    while at < data.size:
        stop = min(at + CHUNK, data.size)
        r, ahead = _filtered(made, sweep, prior, data, at, stop, cov_at, backend)
        judged, share = share.size, np.append(share, _window_means(r.nis))
        bad = _unusual(share, judged, own=own)
        if not bad.size:
            pieces.append(r)
            prior, at = ahead, stop
            continue
        if len(resets) == max_resets:
            raise LostError(
                resets,
                f"{model.name}: {max_resets} resets up to t = {resets[-1]:.6g} s and still "
                f"the innovations are {share[bad[0]]:.3g} times what they should be: the model "
                "does not fit these data: a fault branch with leakage of its own, which "
                "electrical_filter(kappa=..., phase=...) knows; other parameters; or sensor faults",
            )
        cut = at + _onset(r.nis, (int(bad[0]) - judged) * RESET_WINDOW)
        if cut > at:
            r, prior = _filtered(made, sweep, prior, data, at, cut, cov_at, backend)
            pieces.append(r)
        prior = Belief(model.x, prior.mean, prior.cov + _opened(filt, common))
        resets.append(float(data.t[cut]))
        if filt.gains == "estimate":
            filt = considering(filt)
            made, model = step(filt.model), filt.model
            sweep = _sweep(made, prior, data, cov_at, backend)
            own = own_level is None or own_level
        share, at = np.zeros(0), cut
    return _loosened(filt, _joined(pieces, sweep)), resets


def _loosened(filt: ElectricalFilter, r: FilterResult) -> FilterResult:
    """Give each of three severities what they have in common, ``COMMON``, where gains are unknown.

    The filter learns of that from noise in its derivatives: a healthy machine at 50 kW is at -5e-4
    in all three after 1.2 s, seven claimed deviations, with innovations that are white.  What one
    phase has beyond the others is right, and with it all that takes but one for faulty.
    """
    if filt.gains == "none" or not set(SHUNTS.names) <= set(r.x.names):
        return r
    rows = r.x.indices(SHUNTS.names)
    variance, cov = r.variance, r.final.cov
    variance[rows] += COMMON**2  # the result is nobody else's
    along = cov[:, rows].sum(1)
    along = along / along[rows].mean()
    final = Belief(r.x, r.final.mean, cov + COMMON**2 * np.outer(along, along))
    return dataclasses.replace(r, variance=variance, final=final)


def _onset(nis: np.ndarray, start: int) -> int:
    """The first sample from the window before ``start`` on that no noise makes; else ``start``.

    What is before it says that nothing has changed, and would hold the belief back.
    """
    first = max(start - RESET_WINDOW, 0)
    wild = np.flatnonzero(nis[first : start + RESET_WINDOW] > ONSET_LEVEL)
    return first + int(wild[0]) if wild.size else start


def _opened(filt: ElectricalFilter, common: float) -> np.ndarray:
    """What a reset adds to the covariance; where gains are uncertain, h in common stays small."""
    x = filt.model.x
    out = np.diag([RESET_SIGMA.get(n, 0.0) ** 2 for n in x.names])
    if set(SHUNTS.names) <= set(x.names) and filt.gains != "none":
        rows = np.ix_(*[x.indices(SHUNTS.names)] * 2)
        out[rows] -= (RESET_SIGMA[SHUNTS.names[0]] ** 2 - common**2) / 3
    return out


def _sweep(
    made: FilterStep,
    prior: Belief,
    data: Recording,
    cov_at: np.ndarray | None,
    backend: str | None,
) -> Sweep | None:
    """Return the filter over parts of the recording, each of which begins where one has ended."""
    m = made.model
    free = not (np.isfinite(m.lower).any() or np.isfinite(m.upper).any())
    return sweep_of(made, prior, data, cov_at, backend, remember=True) if free else None


def _filtered(
    made: FilterStep,
    sweep: Sweep | None,
    prior: Belief,
    data: Recording,
    start: int,
    stop: int,
    cov_at: np.ndarray | None,
    backend: str | None,
) -> tuple[FilterResult, Belief]:
    """Filter samples from start up to stop, and return the belief at stop before its sample."""
    piece = None if sweep is None else sweep.piece(start, stop, prior)
    if piece is not None:
        r = result_of(made.model, data, start, piece, cov_at is not None)
        return r, piece.ahead or r.final
    more = stop < data.size
    part = data.part(start, stop + more)
    y = part.y.copy()
    if more:
        y[:, -1] = np.nan
    here = None if cov_at is None else cov_at[(cov_at >= start) & (cov_at < stop)] - start
    r = run(made, prior, dataclasses.replace(part, y=y), cov_at=here, backend=backend)
    return _piece(r, stop - start), r.final


def _window_means(nis: np.ndarray) -> np.ndarray:
    """Mean NIS of whole windows."""
    full = nis.size // RESET_WINDOW
    of_windows: np.ndarray = nis[: full * RESET_WINDOW].reshape(full, RESET_WINDOW).mean(1)
    return of_windows


def _unusual(share: np.ndarray, first: int, *, own: bool) -> np.ndarray:
    """Return windows from ``first`` on whose NIS no noise makes; a start needs two to settle."""
    white = np.full(share.size - first, float(len(MEASURED)))
    usual = _usual(share, first) if own else white
    over = share[first:] > usual + RESET_LEVEL - len(MEASURED)
    over[: max(2 - first, 0)] = False
    return first + np.flatnonzero(over)


def _usual(share: np.ndarray, first: int) -> np.ndarray:
    """Return what the NIS of windows from ``first`` on is compared with where gains are considered.

    Their offsets stay in the innovations, so a unit has its own level: the median of up to 20
    windows before, four at least.
    """
    out = np.full(share.size, math.inf)
    for k in range(max(first, 4), min(share.size, 21)):
        out[k] = np.median(share[1:k])
    begin = max(first, 21)
    if share.size > begin:
        out[begin:] = np.median(sliding_window_view(share[begin - 20 : -1], 20), axis=1)
    made: np.ndarray = np.fmax(out[first:], len(MEASURED))
    return made


_COURSES = ("t", "mean", "variance", "innovation", "innovation_variance", "nis", "measured")


def _piece(r: FilterResult, n: int) -> FilterResult:
    """Return the first n instants."""
    return dataclasses.replace(r, **{name: getattr(r, name)[..., :n] for name in _COURSES})


def _joined(pieces: list[FilterResult], sweep: Sweep | None) -> FilterResult:
    """Join pieces, which are views of one memory where a single sweep made them all."""
    joined: dict[str, Any]
    if sweep is not None and all(p.mean.base is sweep.courses[0] for p in pieces):
        stats = sweep.courses[-1]
        whole = sweep.data.t, *sweep.courses[:-1], stats[1], stats[3]
        joined = dict(zip(_COURSES, whole, strict=True))
    else:
        joined = {n: np.concatenate([getattr(p, n) for p in pieces], axis=-1) for n in _COURSES}
    joined["loglik"] = sum(p.loglik for p in pieces)
    if pieces[-1].some_cov is not None:
        joined["some_cov"] = np.concatenate([p.some_cov for p in pieces])
    return dataclasses.replace(pieces[-1], **joined)


def window_power(
    filt: ElectricalFilter, result: FilterResult, data: Recording
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean mechanical power of both generators, (8), over each window, and its variance.

    The filter carries the energy since the window's start as a state, so the variance at the
    window's end holds the correlation of all samples in it, and of h, fluxes and (where they are
    states) gain errors with them: a window is one measurement for whoever takes it.  Without gains
    among the states their share is missing; see ``gain_share`` in the studies.

    Returns:
        t: ends of the windows, s, shape (n,). P : mean power, W. var : its variance, W^2.

    Raises:
        EstimationError: a filter without ``power``, or no complete window.
    """
    if not filt.power:
        raise EstimationError("window_power needs a filter made with power=True")
    keep = data.u[filt.model.u.index("keep")]
    starts = np.flatnonzero(keep == 0.0)
    if starts.size < 2:
        raise EstimationError(f"the recording of {data.t[-1] - data.t[0]:.4g} s holds no window")
    length = np.diff(data.t[starts])
    i = result.x.index("energy")
    # at the first instant of the next window the energy is still that of the window before
    P = result.mean[i, starts[1:]] / length
    var = result.variance[i, starts[1:]] / length**2
    return data.t[starts[1:]], P, var
