"""Moving-horizon estimation: the last N samples are fitted anew at every instant, within bounds.

Rao, Rawlings and Mayne (2003), IEEE Trans. Automatic Control 48, 246.  The window's unknowns are
all its states and noises (:mod:`estimators.batch.transcription`); what the samples before the
window say is the *arrival cost*, a Gaussian of the window's first state.

Which Gaussian decides whether samples are counted once.  Here it is the belief of the first state
*before its own sample*, p(x(s) | y(0..s-1)), which no sample of the window s..k has entered.  When
the window moves on, this belief is corrected with the sample y(s) that leaves, and carried to s+1
by the filter's own formulas, noise shared by output and transition included, linearised at the
window's estimate of x(s), w(s): the best point known, but only a point, so that later samples do
not enter twice.  On a linear model without active bounds the result is the Kalman filter's for any
N.  Bounds do not enter the arrival cost, nor the claimed covariance, which is so on the safe side.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.backend import compiled
from apu_casadi.core.calling import Caller
from apu_casadi.core.errors import EstimationError, ParameterError, SignalError
from apu_casadi.core.sharing import Rebuilt, building, kept
from estimators.batch.programs import program
from estimators.batch.transcription import Solution, Transcription
from estimators.filters.algebra import root_of
from estimators.filters.belief import Belief
from estimators.filters.filtering import FilterResult
from estimators.filters.rootfilter import root_functions
from estimators.filters.stepparts import kind_of, linearisation
from estimators.models.filtermodel import FilterModel
from estimators.models.lifting import Lifted, plain
from estimators.models.recording import Recording

__all__ = ["HorizonEstimator", "moving_horizon"]


class _Along(NamedTuple):
    """One step of the filter linearised at a given point; see :func:`_along`."""

    m1: Any
    L1: Any
    P_f: Any
    C: Any
    x1: Any
    nu: Any
    S: Any
    stats: Any


@kept
def _along(model: FilterModel) -> ca.Function:
    """Function (m, L, at, w, u, p, y, R, dt) -> :class:`_Along`.

    Corrects a belief (mean m, root L of the covariance) with a sample and carries it on to
    (m1, L1), the model linearised at (at, w), in the way of :mod:`estimators.filters.rootfilter`;
    x1 is where the model itself leads from there, ``stats`` are normalised innovation squared,
    log-likelihood and number measured.
    """
    model = model.expanded()
    kind = kind_of(model)
    nx, nu_, np_, nw, ny = model.sizes
    shapes = [(nx, 1), (nx, nx), (nx, 1), (nw, 1), (nu_, 1), (np_, 1), (ny, 1), (ny, 1), (1, 1)]
    names = ["m", "L", "at", "w", "u", "p", "y", "R", "dt"]
    args = [kind.sym(n, *s) for n, s in zip(names, shapes, strict=True)]
    m, L, at, w, u, p, y, R, dt = args
    update, predict = root_functions(model, ())
    point, mean = ca.vertcat(at, w), ca.vertcat(m, kind.zeros(nw))
    outputs, forecast = linearisation(model, kind, u, p, dt)
    (h0, H, _), (f0, F, _) = outputs(point, u, p), forecast(point, u, p, dt)
    nu = model.innovation(y, h0) + H @ (point - mean)
    d, La, S, nis, loglik, measured = update(ca.tril(L), H, nu, R)
    m1 = f0 + F @ (mean + d - point)
    L1, C, _, _ = predict(La, F, dt)
    own = La[:nx, :nx]
    stats = ca.vertcat(nis, loglik, measured)
    out = _Along(m1, L1, ca.mtimes(own, own.T), C, f0, ca.if_else(R >= 0, nu, 0), S, stats)
    dense = [ca.densify(o) for o in (ca.cse(list(out)) if kind is ca.SX else out)]
    return ca.Function(f"along_{model.name}", args, dense, names, list(_Along._fields))


class HorizonEstimator(Rebuilt):
    """A moving-horizon estimator, built once for a model and a length.

    Args:
        model: the model, or a lifted one, which is much faster wherever the model solves equations
            inside; bounds are its own, ``lower`` and ``upper``.
        horizon: samples in the window, N >= 1.
        backend, build: see :func:`apu_casadi.core.backend.compiled`.
        max_iterations: of IPOPT in one window.

    Raises:
        ParameterError: horizon below 1, or considered states, which an optimiser cannot but
            estimate.
    """

    model: FilterModel
    horizon: int
    max_iterations: int
    program: Transcription

    @building
    def __init__(
        self,
        model: FilterModel | Lifted,
        horizon: int,
        *,
        backend: str | None = None,
        build: bool = False,
        max_iterations: int = 100,
    ) -> None:
        """Build the window's program; see the class."""
        if not (isinstance(horizon, int) and not isinstance(horizon, bool) and horizon >= 1):
            raise ParameterError(f"horizon must be a whole number >= 1, got {horizon!r}")
        lifted = model if isinstance(model, Lifted) else plain(model)
        model = lifted.model
        if lifted.steady:
            raise ParameterError(f"{model.name}: steady points do not follow each other in time")
        if model.consider:
            raise ParameterError(
                f"{model.name}: considered states ({', '.join(model.consider)}) would be "
                "estimated by a moving horizon; leave them out, or estimate them with their prior"
            )
        self.model, self.horizon, self.max_iterations = model, horizon, max_iterations
        self.program = program(lifted, [horizon], prior=True, backend=backend, build=build)
        step = _along(self.program.model)
        self._step = Caller(compiled(step, backend=backend, build=build))
        window = step.mapaccum(f"{step.name()}_window", horizon, 2)
        self._window = Caller(compiled(window, backend=backend, build=build))

    def run(
        self,
        prior: Belief,
        data: Recording,
        *,
        full: bool = False,
        progress: Callable[[int, int], None] | None = None,
    ) -> FilterResult:
        """Estimate along a recording; see :func:`moving_horizon`."""
        model, N = self.model, self.horizon
        data.check(model)
        if prior.x.names != model.x.names:
            raise SignalError(
                f"prior of {', '.join(prior.x.names)}; {model.name} has {', '.join(model.x.names)}"
            )
        nx, _, _, nw, ny = model.sizes
        K = data.size
        missing = np.isnan(data.y)
        # a window that reaches beyond the recording holds its last instant, unmeasured
        index = np.minimum(np.arange(K + N), K - 1)
        inside = np.arange(K + N) < K
        y = np.where(missing, 0.0, data.y)[:, index]
        R = np.where(inside, np.where(missing, -1.0, data.variance)[:, index], -1.0)
        u, dt = data.u[:, index], np.where(inside, data.dt[index], 0.0)
        numbers = data.p if self.program.model is model else model.full(data.p)
        p = np.repeat(numbers[:, None], N, axis=1)
        mean, var, mean_pred = (np.empty((nx, K)) for _ in range(3))
        innovation, S = np.full((ny, K), np.nan), np.full((ny, K), np.nan)
        stats = np.empty((3, K))
        cov, cov_pred, cross = (np.empty((K, nx, nx)) for _ in range(3))
        # of the window's first state, before its sample: mean and root of the covariance
        m, L = prior.mean, root_of(prior.cov) if prior.root is None else prior.root
        mp, Lp = m, L  # of the state now, before its sample
        z0: np.ndarray | None = None
        for k in range(K):
            s = max(0, k - N + 1)
            i, at = k - s, slice(s, s + N)
            mean_pred[:, k], cov_pred[k] = mp, Lp @ Lp.T
            now = _Along(
                *self._step(mp, Lp, mp, np.zeros(nw), u[:, k], numbers, y[:, k], R[:, k], dt[k])
            )
            there = ~missing[:, k]
            innovation[there, k] = now.nu[there]
            S[there, k] = np.diag(now.S.reshape(ny, ny))[there]
            stats[:, k] = now.stats
            # samples after this instant are not known yet
            known = np.where(np.arange(N) <= i, R[:, at], -1.0)
            window = (u[:, at], p, y[:, at], known, dt[at])
            try:
                solution = self._solve(m, L, window, i, z0, mp)
            except EstimationError as e:
                raise EstimationError(f"t = {data.t[k]:.9g} s (sample {k}): {e}") from None
            local = self.program.locals_of(solution)[0]
            out = _Along(*self._window(m, L, local.x, local.w, *window))
            blocks = {
                n: a.reshape((nx, N * nx), order="F")[:, i * nx : (i + 1) * nx]
                for n, a in (("P_f", out.P_f), ("L1", out.L1), ("C", out.C))
            }
            # scaling back may round across a bound
            mean[:, k] = np.clip(local.x[:, i], model.lower, model.upper)
            cov[k], cross[k] = blocks["P_f"], blocks["C"]
            var[:, k] = np.diag(cov[k])
            # the model leads on from the estimate, bounds included
            mp, Lp = out.x1.reshape((nx, N), order="F")[:, i], blocks["L1"]
            if i == N - 1:
                m = out.m1.reshape((nx, N), order="F")[:, 0]
                L = out.L1.reshape((nx, N * nx), order="F")[:, :nx]
            z0 = self._shifted(solution, moved=i == N - 1)
            if progress is not None:
                progress(k + 1, K)
        final = Belief(model.x, mean[:, -1].copy(), cov[-1])
        told = innovation, S, stats[0], stats[2], float(stats[1].sum()), final
        more = (cov, mean_pred, cov_pred, cross) if full else ()
        return FilterResult(model.x, model.y, data.t, mean, var, *told, *more)

    def _solve(
        self,
        m: np.ndarray,
        L: np.ndarray,
        window: tuple[np.ndarray, ...],
        last: int,
        z0: np.ndarray | None,
        ahead: np.ndarray,
    ) -> Solution:
        """Solve one window whose samples 0..last are known."""
        program, model = self.program, self.model
        u, p, y, R, dt = window
        nx, nom = len(model.x), model.x.nominals
        weight = np.where(R >= 0, 1 / np.sqrt(np.where(R >= 0, R, 1.0)), 0.0)
        stages = np.vstack([u, p, y, weight, dt[None, :]])
        root = L / nom[:, None]
        data = np.concatenate([stages.ravel(order="F"), m / nom, root.ravel(order="F")])
        lower, upper = np.full(program.n_z, -np.inf), np.full(program.n_z, np.inf)
        # what lies ahead of the last sample is a forecast, on which a bound has no say
        rows = program.index[: last + 1, :nx]
        lower[rows], upper[rows] = model.lower / nom, model.upper / nom
        if z0 is None:
            z0 = np.zeros(program.n_z)
            self._place(z0, 0, m, window)
        else:
            self._place(z0, last, ahead, window)
        return program.solve(
            data, np.clip(z0, lower, upper), lower, upper, max_iterations=self.max_iterations
        )

    def _place(
        self, z0: np.ndarray, first: int, x: np.ndarray, window: tuple[np.ndarray, ...]
    ) -> None:
        """Put a state, and the unknowns that belong to it, into a start from sample ``first``."""
        program, lifted = self.program, self.program.lifted
        nx, ns = len(x), len(lifted.s)
        rows = program.index[first:]
        z0[rows[:, :nx]] = x / self.model.x.nominals
        if ns:
            u, p = window[0][:, first:], window[1][:, first:]
            s = np.array(lifted.start.map(u.shape[1])(np.repeat(x[:, None], u.shape[1], 1), u, p))
            z0[rows[:, nx : nx + ns]] = (s / lifted.s.nominals[:, None]).T

    def _shifted(self, s: Solution, *, moved: bool) -> np.ndarray:
        """A start for the next window: the solution, one sample on if the window moves."""
        z0 = s.z.copy()
        if moved:
            index = self.program.index
            z0[: index[0, 0]] = 0.0
            z0[index[:-1]] = s.z[index[1:]]
            z0[index[-1, len(self.model.x) :]] = 0.0
        return z0


def moving_horizon(
    model: FilterModel | Lifted,
    prior: Belief,
    data: Recording,
    *,
    horizon: int = 20,
    full: bool = False,
    backend: str | None = None,
    build: bool = False,
    max_iterations: int = 100,
    progress: Callable[[int, int], None] | None = None,
) -> FilterResult:
    """Estimate the state at every instant from the last ``horizon`` samples and what came before.

    Args:
        model: the model, or a lifted one; every estimate of the window keeps to its bounds
            ``lower``, ``upper``.
        prior: belief at the first instant, before its sample.
        data: the recording.
        horizon: samples in the window.
        full: keep the covariances.
        backend, build: see :func:`apu_casadi.core.backend.compiled`.
        max_iterations: of IPOPT in one window.
        progress: called with (done, total) instants after each.

    Returns:
        FilterResult: ``mean`` within the bounds; innovations are those of the forecast from the
        window before; variances do not know of the bounds.

    Raises:
        ParameterError: see :class:`HorizonEstimator`.
        DataError, SignalError: the recording or the prior does not fit the model.
        EstimationError: a window could not be solved; names the instant.
    """
    made = HorizonEstimator(
        model, horizon, backend=backend, build=build, max_iterations=max_iterations
    )
    return made.run(prior, data, full=full, progress=progress)
