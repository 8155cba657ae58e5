"""Short circuits that grow: a filter with a rate of each severity, and when it is wanted.

A severity that walks slowly is known well while it is constant, and is far behind while it grows:
at 0.016 a second (2.4e-3 with a time constant of 0.15 s) by 35 claimed standard deviations.  So the
filter's order varies (Bar-Shalom and Birmiwal 1982, IEEE Trans. Aerospace and Electronic Systems
18, 621): constant severities until one is seen to move, then rates as states,

    dh/dt = r,    dr/dt = -r/T + noise    (Singer 1970, same Transactions 6, 473),

until nothing moves any more.  What a sample moves a severity by is white if the model holds, of the
variance that its belief loses there: with P of h after a sample, q its walk,

    v(k) = P(k-1) + q^2 dt - P(k).

Of a ramp since sample j it tells by its weight k - j, the slow filter's answer to one; the sum of
these is h(k) less the mean of h over the span, times its length.  The filter's gain is v/P, and so
the same sum tells by how much it is behind such a ramp; before that is certain, it widens what is
said of the severity.
Nothing told of an instant uses what is measured after it.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.sharing import of_family, remade
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.machine.terminals import SHUNTS
from estimators.apu.electrical.electricalfilter import ElectricalFilter
from estimators.apu.electrical.tuning import (
    GROWTH_LEVEL,
    GROWTH_SPANS,
    MOTION_SEEN,
    RATE_MEMORY,
    RATE_SIGMAS,
    REST_LEVEL,
    REST_SPAN,
    STEEP,
)
from estimators.filters.belief import Belief
from estimators.models.filtermodel import FilterModel, Unknown

__all__ = ["Motion", "Moving", "can_grow", "growing", "motion", "opened", "rested"]


def can_grow(filt: ElectricalFilter) -> bool:
    """Whether growth is looked for: of three severities, without gain errors among the states.

    Those leave a severity less well known than growth would show in.  A filter that takes gain
    errors for noise, by whose innovations an estimate is judged, follows a small short circuit so,
    which else would be in them for some windows.
    """
    return filt.gains == "none" and set(SHUNTS.names) <= set(filt.model.x.names)


def growing(filt: ElectricalFilter, rate: float) -> ElectricalFilter:
    """Return the filter with the rate of each severity, 1/s, as a state behind the others.

    Args:
        filt: of constant severities.
        rate: that one of them has, by which it is told how large they may be.
    """
    sigma = RATE_SIGMAS[abs(rate) > STEEP]
    return dataclasses.replace(filt, model=_with_rates(filt.model, RATE_MEMORY, sigma))


@remade
@of_family
def _with_rates(model: FilterModel, memory: float, sigma: float) -> FilterModel:
    """Return the model with rates that last for ``memory``, s, and spread by ``sigma``."""
    rates = [Signal(f"rate_{n}", "1/s", f"rate of {n}", 0.0, sigma) for n in SHUNTS.names]
    nx = len(model.x)
    kind = ca.SX if model.transition.is_a("SXFunction") else ca.MX
    _, u, p, w, dt = model.symbols(kind)
    x = kind.sym("x", nx + len(rates))
    x1, check = model.transition(x[:nx], u, p, w, dt)
    rows = model.x.indices(SHUNTS.names)
    x1[rows] += dt * x[nx:]
    return FilterModel.of(
        f"{model.name}_growing",
        (model.x + Signals(rates), model.u, model.p, model.w, model.y),
        (x, u, p, w, dt),
        (ca.vertcat(x1, ca.exp(-dt / memory) * x[nx:]), check),
        model.output(x[:nx], u, p, w),
        like=model,
        more={s.name: Unknown(walk=sigma * math.sqrt(2 / memory)) for s in rates},
    )


def opened(belief: Belief, x: Signals) -> Belief:
    """Return a belief of the states of :func:`growing`, of rates that are not known yet."""
    n, more = len(belief.x), len(x) - len(belief.x)
    cov = np.zeros((len(x), len(x)))
    cov[:n, :n] = belief.cov
    cov[n:, n:] = np.diag(x.nominals[n:] ** 2)
    return Belief.found(x, np.append(belief.mean, np.zeros(more)), cov)


@dataclasses.dataclass(frozen=True, eq=False)
class Moving:
    """Severities along a recording: instants, s, (K,); means and variances, (3, K)."""

    t: np.ndarray
    h: np.ndarray
    variance: np.ndarray

    def then(self, other: Moving) -> Moving:
        """Return both, one after the other."""
        each = zip(self._all, other._all, strict=True)
        return Moving(*(np.concatenate(pair, axis=-1) for pair in each))

    @property
    def _all(self) -> tuple[np.ndarray, ...]:
        return self.t, self.h, self.variance


class Motion(NamedTuple):
    """What severities of a filter that takes them for constant tell of their motion.

    Args:
        at: first sample by which one has moved for certain; None if none has.
        span: number of samples by which it is, until then.
        rate: of that motion, 1/s.
        behind: by how much they may be behind a motion that shows, (3, K); 0 where none does.
    """

    at: int | None
    span: int
    rate: float
    behind: np.ndarray


def motion(of: Moving, walk: float, first: int) -> Motion:
    """Return what severities tell of their motion.

    Args:
        of: severities of a filter that takes them for constant but for a walk.
        walk: of each of them, 1/sqrt(s).
        first: number of the first sample that is looked at.
    """
    step = np.diff(of.t, prepend=of.t[0])
    before = np.concatenate([of.variance[:, :1], of.variance[:, :-1]], axis=1)
    v = np.maximum(before + walk**2 * step - of.variance, 0.0)
    n = np.arange(of.t.size)
    sums = [np.cumsum(x, axis=1) for x in (of.h, v, n * v, n**2 * v)]
    behind, most = np.zeros_like(of.h), np.full(of.h.shape, MOTION_SEEN)
    spans = np.zeros(of.t.size, dtype=int)
    for span in GROWTH_SPANS:
        start = max(first, span)
        if start >= of.t.size:
            continue
        k, j = slice(start, None), slice(start - span, of.t.size - span)  # views, not copies
        # weights over the samples j < i <= k; the mean is that over j <= i < k
        h, s0, s1, s2 = (x[:, k] - x[:, j] for x in sums)
        rise = span * of.h[:, k] - (h + of.h[:, j] - of.h[:, k])
        spread = np.maximum(s2 - 2 * n[j] * s1 + n[j] ** 2 * s0, np.finfo(float).tiny)
        z2 = rise**2 / spread
        more = z2 > most[:, k]
        np.copyto(most[:, k], z2, where=more)
        np.copyto(behind[:, k], span * rise * of.variance[:, k] / spread, where=more)
        np.copyto(spans[k], span, where=(z2 > GROWTH_LEVEL).any(0) & (spans[k] == 0))
    sure = np.flatnonzero(spans)
    if not sure.size:
        return Motion(None, 0, 0.0, behind)
    at = int(sure[0])
    span = int(spans[at])
    rate = float(np.abs(behind[:, at]).max() / (of.t[at] - of.t[at - span]))
    return Motion(at, span, rate, behind)


def rested(of: Moving, first: int) -> int:
    """Return the first sample over whose ``REST_SPAN`` before nothing moved; K if there is none.

    Args:
        of: severities of :func:`growing`.
        first: number of the first sample of that filter.
    """
    k = np.arange(first + REST_SPAN, of.t.size)
    j = k - REST_SPAN
    by = (of.h[:, k] - of.h[:, j]) ** 2
    still = np.flatnonzero((by < REST_LEVEL * (of.variance[:, k] + of.variance[:, j])).all(0))
    return int(k[still[0]]) if still.size else of.t.size
