"""A filter that runs along, and takes samples out of sequence as if they had come in time.

A sensor with a delay gives a sample of then when others have given theirs of now.  The belief
before each recent instant is kept; a late sample enters at its own instant, and what followed is
filtered again.  That is what a filter of all samples in order gives, for any model, noise that
output and transition share included; corrections of the present belief alone (Bar-Shalom 2002, IEEE
Trans. Aerospace and Electronic Systems 38, 769) are that only where the model is linear and its
noises are independent.  It costs as many steps as the sample is late, a few microseconds each.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from apu_casadi.core.backend import compiled
from apu_casadi.core.calling import Caller
from apu_casadi.core.errors import DataError, EstimationError, SignalError, nearest
from estimators.filters.algebra import root_of
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import FilterStep, narrow
from estimators.models.filtermodel import CHECK_TOL, FilterModel
from estimators.models.recording import SAME_TIME

__all__ = ["RunningFilter"]


@dataclass
class _Instant:
    """One stamp: what was told there, and the belief before its sample."""

    t: float
    given: dict[int, float]  # inputs that change here
    y: np.ndarray
    R: np.ndarray
    u: np.ndarray = field(default_factory=lambda: np.zeros(0))
    m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    P: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    loglik: float = 0.0


class RunningFilter:
    """A filter to which samples are given one after the other, in any order.

    Args:
        model: the model (taken by an extended Kalman filter), or a filter.
        prior: belief at ``start``, before any sample.
        start: s; no sample may be older.
        inputs: at the start, by name; those that have defaults may be left out.
        p: known parameters by name, where the model gives no default.
        keep: s, how late a sample may come; what is older is settled and forgotten.
        backend: see :func:`apu_casadi.core.backend.compiled`.

    Raises:
        SignalError: prior, inputs or parameters do not fit the model.
        DataError: ``keep`` negative, or ``start`` not finite.
    """

    model: FilterModel
    keep: float
    belief: Belief

    def __init__(
        self,
        model: FilterModel | FilterStep,
        prior: Belief,
        *,
        start: float = 0.0,
        inputs: Mapping[str, float] | None = None,
        p: Mapping[str, float] | None = None,
        keep: float = math.inf,
        backend: str | None = None,
    ) -> None:
        step = model if isinstance(model, FilterStep) else ekf_step(model)
        self.model = step.model
        if prior.x.names != self.model.x.names:
            raise SignalError(
                f"prior of {', '.join(prior.x.names)}; {self.model.name} has "
                f"{', '.join(self.model.x.names)}"
            )
        if not (keep >= 0 and math.isfinite(start)):
            raise DataError(f"keep = {keep!r} s must be >= 0, start = {start!r} s finite")
        if not step.root and step.wide is not None and narrow(prior.cov):
            step = step.wide()
        self.keep, self._root = keep, step.root
        self._step = Caller(compiled(step.shared.function, backend=backend))
        self._p = step.full(self.model.p.pack(p or {}))
        P = prior.cov if not step.root else root_of(prior.cov) if prior.root is None else prior.root
        ny = len(self.model.y)
        u = self.model.u.pack(inputs or {})
        first = _Instant(start, {}, np.zeros(ny), -np.ones(ny), u, prior.mean.copy(), P.copy())
        self._line = [first]
        self._settled = 0.0
        self.belief = prior
        self._filter(0)

    @property
    def t(self) -> float:
        """Latest instant, s."""
        return self._line[-1].t

    @property
    def loglik(self) -> float:
        """Log-likelihood of all samples."""
        return self._settled + sum(i.loglik for i in self._line)

    def take(
        self,
        t: float,
        readings: Mapping[str, float] | None = None,
        sigma: Mapping[str, float] | None = None,
        *,
        inputs: Mapping[str, float] | None = None,
    ) -> Belief:
        """Take what was read at t, s, which may lie before the latest instant.

        Args:
            t: stamp of the readings and inputs.
            readings: measured outputs by name; none lets time go on to t.
            sigma: standard deviation of each.
            inputs: new values from t on, until the next stamp at which they were given.

        Returns:
            The belief at the latest instant, all samples so far included.

        Raises:
            DataError: an unknown name, a sigma that is missing or not positive, a value that is not
                finite, a sample that is older than what is kept, or the same twice.
            EstimationError: the model could not be evaluated; nothing was taken.
        """
        told, given = self._checked(readings or {}, sigma or {}), self._inputs(inputs or {})
        line = self._line
        if not t >= line[0].t - SAME_TIME or not math.isfinite(t):
            raise DataError(
                f"a sample of t = {t!r} s is {line[0].t - t:.6g} s older than what is kept, which "
                f"begins at {line[0].t:.9g} s (keep = {self.keep:g} s)"
            )
        k = bisect_right(line, t + SAME_TIME, key=lambda i: i.t) - 1
        before = line[:]
        if abs(line[k].t - t) <= SAME_TIME:
            line[k] = self._joined(line[k], told, given)
        else:
            k += 1
            ny = len(self.model.y)
            line.insert(k, self._joined(_Instant(t, {}, np.zeros(ny), -np.ones(ny)), told, given))
        try:
            self._filter(max(k - 1, 0))
        except EstimationError:
            self._line = before
            raise
        self._forget()
        return self.belief

    def _checked(
        self, readings: Mapping[str, float], sigma: Mapping[str, float]
    ) -> dict[int, tuple[float, float]]:
        """Readings and variances by their places."""
        told = {}
        for name, value in readings.items():
            if name not in self.model.y:
                raise DataError(f"unknown output {name!r} {nearest(name, self.model.y.names)}")
            s = sigma.get(name, math.nan)
            if not (math.isfinite(value) and 0 < s < math.inf):
                raise DataError(
                    f"{name}: a finite reading with a sigma > 0 expected, got {value!r} and "
                    f"{sigma.get(name)!r}"
                )
            told[self.model.y.index(name)] = (float(value), float(s) ** 2)
        return told

    def _inputs(self, inputs: Mapping[str, float]) -> dict[int, float]:
        for name, value in inputs.items():
            if name not in self.model.u:
                raise DataError(f"unknown input {name!r} {nearest(name, self.model.u.names)}")
            if not math.isfinite(value):
                raise DataError(f"input {name} must be finite, got {value!r}")
        return {self.model.u.index(n): float(v) for n, v in inputs.items()}

    def _joined(
        self, at: _Instant, told: Mapping[int, tuple[float, float]], given: Mapping[int, float]
    ) -> _Instant:
        """An instant with more that was told of it."""
        y, R = at.y.copy(), at.R.copy()
        for i, (value, variance) in told.items():
            if R[i] >= 0:
                raise DataError(f"{self.model.y[i].name} at t = {at.t:.9g} s was given already")
            y[i], R[i] = value, variance
        u = at.u.copy()
        if at is self._line[0]:
            u[list(given)] = [*given.values()]
        return _Instant(at.t, {**at.given, **given}, y, R, u, at.m, at.P)

    def _filter(self, first: int) -> None:
        """Filter from an instant on; beliefs of those after it are made anew."""
        line = self._line
        new = [line[first]]
        for k in range(first, len(line)):
            now = new[-1]
            after = line[k + 1] if k + 1 < len(line) else None
            dt = 0.0 if after is None else after.t - now.t
            out = self._step(now.m, now.P, now.u, self._p, now.y, now.R, dt)
            m1, P1, m_f, P_f, _, _, _, (check, _, loglik, _) = out[:8]
            n = m_f.size
            if not (check <= CHECK_TOL and np.isfinite(m_f).all() and np.isfinite(P_f).all()):
                raise EstimationError(
                    f"{self.model.name} at t = {now.t:.9g} s: the belief is lost (model check "
                    f"{check:.1e}); the sample does not fit the model"
                )
            new[-1] = _Instant(now.t, now.given, now.y, now.R, now.u, now.m, now.P, float(loglik))
            if after is not None:
                u = now.u.copy()
                u[list(after.given)] = [*after.given.values()]
                kept = after.t, after.given, after.y, after.R
                new.append(_Instant(*kept, u, m1, P1.reshape(n, n)))
        P_f = P_f.reshape(n, n)
        self.belief = Belief(self.model.x, m_f, (P_f + P_f.T) / 2)
        line[first:] = new

    def _forget(self) -> None:
        """Drop what no late sample may reach any more."""
        line = self._line
        while len(line) > 1 and line[1].t < self.t - self.keep - SAME_TIME:
            self._settled += line.pop(0).loglik
