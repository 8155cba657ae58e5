"""Runs in which faults come and go, and the mean power of windows as measurements of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from apu_casadi.core.errors import EstimationError
from apu_casadi.core.signals import Signals
from apu_casadi.machine.terminals import SHUNTS
from estimators.apu.electrical.electricalfilter import ElectricalFilter, considering
from estimators.apu.electrical.growing import Moving, can_grow, growing, motion, opened, rested
from estimators.apu.electrical.hypotheses import COMMON
from estimators.apu.electrical.terminalsignals import MEASURED
from estimators.apu.electrical.tuning import (
    H_BALANCED,
    ONSET_LEVEL,
    RATE_SIGMAS,
    RESET_LEVEL,
    RESET_SIGMA,
    RESET_WINDOW,
    RESETS_WITHIN,
    STEEP,
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
    """Filter a recording in which faults come, grow and go: h follows steps and rises at once.

    The random walk of h is for slow changes; a step of 1e-3 would take it 0.2 s.  So the
    innovations are watched: where their normalised square, averaged over ``RESET_WINDOW`` samples,
    exceeds ``RESET_LEVEL``, h and fluxes become uncertain again at the window's start
    (``RESET_SIGMA``).  The first two windows of a piece are not judged: a start needs them.

    With exact sensors severities that move have their rates as states, see :mod:`.growing`.

    Where gains are estimated, they are considered from the first reset on, with what is known then:
    during the transient of a fault they are learnt falsely, by 18 to 48 claimed deviations, and h
    with them by 6 to 10, at severities of 2.4e-3 to 1e-2 and NIS 4 to 5.

    Args:
        filt, prior, data, step, backend: as of the filter; ``step`` makes its step.
        max_resets: more than these within ``RESETS_WITHIN``, and the model is refused.
        own_level: whether a window is compared with those before it (the first four are not judged)
            instead of with white innovations: where gain errors are considered (the default there),
            or taken as noise, each unit has a level of its own.
        cov_at: as of :func:`estimators.filters.filtering.run`: samples whose covariances are kept.
        common: what all three h may have in common after a reset, as ``H_BALANCED``.

    Returns:
        Result as from one filter, and the resets, s; where gains are unknown, variances of the
        three severities, and the final belief, hold what these have in common beside the claim.

    Raises:
        LostError: too many resets: the model does not fit the data at all.
    """
    own = filt.gains == "consider" if own_level is None else own_level
    pieces: list[FilterResult] = []
    base = now = _Stage.of(filt, step, prior, data, cov_at, backend)
    turns = _Turns(base, step)
    resets: list[float] = []
    share = np.zeros(0)  # mean NIS of the windows since the last reset
    at = 0
    while at < data.size:
        stop = min(at + CHUNK, data.size)
        r, ahead = now.filtered(prior, at, stop)
        judged, share = share.size, np.append(share, _window_means(r.nis))
        bad = _unusual(share, judged, own=own)
        cut = at + _onset(r.nis, (int(bad[0]) - judged) * RESET_WINDOW) if bad.size else None
        turn = turns.turn(now, r, prior, at, cut)
        if turn is not None:
            if turn.at > at:
                pieces.append(turns.widened(now, now.filtered(prior, at, turn.at)[0]))
            now, prior, at, share = turn.to, turn.prior, turn.at, np.zeros(0)
            continue
        if cut is None:
            pieces.append(turns.widened(now, r))
            prior, at = ahead, stop
            continue
        if sum(v > data.t[cut] - RESETS_WITHIN for v in resets) >= max_resets:
            raise LostError(resets, _lost(filt.model.name, resets, float(share[bad[0]])))
        if cut > at:
            r, prior = now.filtered(prior, at, cut)
            pieces.append(turns.widened(now, r))
        wider = prior.cov + _opened(now.filt, common)
        prior = Belief(prior.x, prior.mean, wider)
        resets.append(float(data.t[cut]))
        if filt.gains == "estimate":
            filt = considering(filt)
            now = _Stage.of(filt, step, prior, data, cov_at, backend)
            own = own_level is None or own_level
        share, at = np.zeros(0), cut
        turns.begin(at)
    pieces = [_narrowed(r, base.filt.model.x) for r in pieces]
    return _loosened(filt, _joined(pieces, now.sweep)), resets


def _lost(name: str, resets: Sequence[float], size: float) -> str:
    """Say that more resets are wanted than are likely."""
    return (
        f"{name}: {len(resets)} resets up to t = {resets[-1]:.6g} s and still the innovations are "
        f"{size:.3g} times what they should be: the model does not fit these data: a fault branch "
        "with leakage of its own, which electrical_filter(kappa=..., phase=...) knows; other "
        "parameters; or sensor faults"
    )


@dataclass(frozen=True, eq=False)
class _Stage:
    """A filter over parts of a recording, each of which begins where one has ended.

    Args:
        filt: the filter.
        made: its step.
        sweep: carries covariances over the recording; None where they are not.
        data, cov_at, backend: as of :func:`track`.
    """

    filt: ElectricalFilter
    made: FilterStep
    sweep: Sweep | None
    data: Recording
    cov_at: np.ndarray | None
    backend: str | None

    @classmethod
    def of(
        cls,
        filt: ElectricalFilter,
        step: StepMaker,
        prior: Belief,
        data: Recording,
        cov_at: np.ndarray | None,
        backend: str | None,
    ) -> _Stage:
        """Make it, with a sweep about a first belief."""
        made = step(filt.model)
        free = not (np.isfinite(filt.model.lower).any() or np.isfinite(filt.model.upper).any())
        sweep = sweep_of(made, prior, data, cov_at, backend, remember=True) if free else None
        return cls(filt, made, sweep, data, cov_at, backend)

    def filtered(self, prior: Belief, start: int, stop: int) -> tuple[FilterResult, Belief]:
        """Filter samples from start up to stop, and return the belief at stop before its sample."""
        data, cov_at = self.data, self.cov_at
        piece = None if self.sweep is None else self.sweep.piece(start, stop, prior)
        if piece is not None:
            r = result_of(self.made.model, data, start, piece, cov_at is not None)
            return r, piece.ahead or r.final
        more = stop < data.size
        part = data.part(start, stop + more)
        y = part.y.copy()
        if more:
            y[:, -1] = np.nan
        here = None if cov_at is None else cov_at[(cov_at >= start) & (cov_at < stop)] - start
        part = dataclasses.replace(part, y=y)
        r = run(self.made, prior, part, cov_at=here, backend=self.backend)
        return _piece(r, stop - start), r.final


class _Turn(NamedTuple):
    """From sample ``at`` on another filter, and the belief it begins with."""

    at: int
    to: _Stage
    prior: Belief


class _Turns:
    """When the filter of constant severities gives way to that of growing ones, and back.

    Where growth cannot be told, never.

    Args:
        base: the former.
        step: makes a filter's step.
    """

    def __init__(self, base: _Stage, step: StepMaker) -> None:
        self.base, self.step = base, step
        self.able = can_grow(base.filt)
        self.rows = base.filt.model.x.indices(SHUNTS.names) if self.able else []
        self.begin(0)

    def begin(self, at: int) -> None:
        """Begin anew, at a sample from which on nothing is known of what was before."""
        self.begun = at
        self.last: tuple[int, Belief, Moving] | None = None

    def widened(self, now: _Stage, r: FilterResult) -> FilterResult:
        """Return what the filter that runs said, with what it may be behind."""
        if not self.able or now is not self.base:
            return r
        variance = r.variance.copy()
        variance[self.rows] += self.behind[:, : r.t.size] ** 2
        return dataclasses.replace(r, variance=variance)

    def turn(
        self, now: _Stage, r: FilterResult, prior: Belief, at: int, cut: int | None
    ) -> _Turn | None:
        """Return whether, and where, the filter that runs gives way to the other one.

        Args:
            now: the filter that runs.
            r: what it said from sample ``at`` on.
            prior: its belief there.
            cut: where it is reset; just before that nothing else is done.
        """
        if not self.able:
            return None
        here = Moving(r.t, r.mean[self.rows], r.variance[self.rows])
        start, before, seen = self.last or (at, prior, here)
        seen = seen if self.last is None else seen.then(here)
        self.last = at, prior, here
        # of its beginning a filter learns for two windows
        first = max(at, self.begun + 2 * RESET_WINDOW) - start
        end = self.base.data.size if cut is None else cut
        if now is not self.base:
            return self._left(
                now, r, prior, at, start + rested(seen, max(self.begun - start, 0)), end
            )
        found = motion(seen, float(now.filt.model.walk[self.rows[0]]), first)
        self.behind = found.behind[:, at - start :]
        if found.at is None or start + found.at >= end:
            return None
        k, j = start + found.at, start + found.at - found.span
        if j > start:
            _, before = now.filtered(before, start, j)
        return self._entered(before, j, k, found.rate)

    def _entered(self, belief: Belief, start: int, at: int, rate: float) -> _Turn:
        """Return the turn to growing severities, of which a rate began to show at a start."""
        filt = growing(self.base.filt, rate)
        belief = opened(belief, filt.model.x)
        how = self.base.data, self.base.cov_at, self.base.backend
        stage = _Stage.of(filt, self.step, belief, *how)
        if at > start:
            _, belief = stage.filtered(belief, start, at)
        self.begin(at)
        return _Turn(at, stage, belief)

    def _left(
        self, now: _Stage, r: FilterResult, prior: Belief, at: int, rest: int, end: int
    ) -> _Turn | None:
        """Return the turn from growing severities, to constant ones or to steeper growth."""
        x = self.base.filt.model.x
        rates = r.mean[len(x) :]
        over = np.flatnonzero(np.abs(rates).max(0) > STEEP)
        slow = now.filt.model.x[-1].nominal == RATE_SIGMAS[0]
        steeper = at + int(over[0]) if over.size and slow else rest
        k = min(steeper, rest)
        if k >= end:
            return None
        ahead = now.filtered(prior, at, k)[1] if k > at else prior
        belief = ahead.marginal(x.names)
        if k < rest:
            return self._entered(belief, k, k, math.inf)
        self.begin(k)
        return _Turn(k, self.base, belief)


def _narrowed(r: FilterResult, x: Signals) -> FilterResult:
    """Return a result without states beyond those of x."""
    n = len(x)
    if len(r.x) == n:
        return r
    final = Belief.found(x, r.final.mean[:n], r.final.cov[:n, :n])
    some = None if r.some_cov is None else r.some_cov[:, :n, :n]
    mean, variance = r.mean[:n], r.variance[:n]
    return dataclasses.replace(r, x=x, mean=mean, variance=variance, final=final, some_cov=some)


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
    if sweep is not None and all(
        a.base is b
        for p in pieces
        for a, b in zip((p.mean, p.variance), sweep.courses, strict=False)
    ):
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
