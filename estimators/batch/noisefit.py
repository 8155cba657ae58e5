"""Noise by maximum likelihood: Q and R from a recording, with how well they are known.

The likelihood of a recording is the filter's own, sum of log N(nu; 0, S) over its innovations
(Schweppe 1965; Särkkä 2013, chapter 12).  It is maximised over the logarithms of standard
deviations: of random walks (Q), of measured outputs (R) and of the noises w.  Derivatives are
exact: the filter's step is differentiated, forwards along the recording.  So is the Fisher
information,

    I_ij = sum  dnu/di' S^-1 dnu/dj + 1/2 tr(S^-1 dS/di S^-1 dS/dj),

which steps (scoring) and gives the standard errors, I^-1 (Cavanaugh and Shumway 1996, Journal of
Applied Probability 33, 1004, with the expectation taken at the sample).

What it cannot say: whether the model is right.  Innovations that are not white are explained by
noise as far as noise can; ``correlation`` shows them, ``spread`` compares the scores' scatter with
the information (White 1982, Econometrica 50, 1): both belong to each estimate.  A standard
deviation may be zero; then it has an upper limit and no error: see ``NoiseFit.upper``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from apu_casadi.core.backend import backend_in_use, compiled
from apu_casadi.core.calling import Caller
from apu_casadi.core.errors import EstimationError, ParameterError, nearest
from apu_casadi.core.sharing import kept, of_family, once, remade
from apu_casadi.core.signals import Signal, Signals
from estimators.batch.undetermined import invert
from estimators.filters.algebra import backward, cholesky, forward
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import CHAIN, STEP_IN, FilterStep, block_of, narrow, padded
from estimators.information.consistency import sigmas
from estimators.models.filtermodel import CHECK_TOL, FilterModel
from estimators.models.recording import Recording

__all__ = ["KINDS", "NoiseFit", "fit_noise", "scaled_noise"]

KINDS = {"noise": "noise of output", "walk": "walk of state", "input": "noise of input"}
FLOOR = 1e-3  # of the start; a standard deviation at it counts as nothing
CEILING = 1e3
STEP = 1.5  # longest step of a logarithm
CONVERGED = 1e-4  # distance from the maximum, standard errors
NEARLY = 0.03  # the same of the others where a limit is sought: 1e-3 of twice the likelihood
INSTANT = 1e-200  # s, stands for a step of nothing, whose root has no derivative
MANY = 1000  # samples
VAGUE = 0.4  # standard error of a logarithm from which zero is tried as well
LIKELY = 2.706  # twice the loss of log-likelihood at a one-sided limit of 95 %


@remade
@of_family
def scaled_noise(
    model: FilterModel, walk: Sequence[str] = (), inputs: Sequence[str] = ()
) -> FilterModel:
    """Return the model whose random walks and noises w are multiplied by exp of parameters.

    The parameters are ``log_walk_<state>`` and ``log_<noise>``, 0 by default; the walks become
    noises w of the transition, which is the same model.

    Raises:
        SignalError: unknown state or noise. ParameterError : a state that does not walk.
    """
    rows, cols = model.x.indices(walk), model.w.indices(inputs)
    for i, name in zip(rows, walk, strict=True):
        if not model.walk[i] > 0:
            raise ParameterError(
                f"{model.name}: {name} does not walk; give it a walk to start from"
            )
    nw = len(model.w)
    names = [*(f"log_walk_{n}" for n in walk), *(f"log_{n}" for n in inputs)]
    more = Signals([Signal(n, "1", "logarithm of a factor of the noise", 0.0) for n in names])
    x, u, _, _, dt = model.symbols()
    p, w = ca.MX.sym("p", len(model.p) + len(more)), ca.MX.sym("w", nw + len(rows))
    factor = ca.vertsplit(ca.exp(p[len(model.p) :])) if more else []
    xi = ca.vertsplit(w) if nw + len(rows) else []
    own = xi[:nw]
    for j, i in enumerate(cols):
        own[i] = own[i] * factor[len(rows) + j]
    given = x, u, p[: len(model.p)], ca.vertcat(ca.MX(0, 1), *own)
    x1, check = model.transition(*given, dt)
    for j, i in enumerate(rows):
        x1[i] += ca.sqrt(dt) * model.walk[i] * factor[j] * xi[nw + j]
    noises = Signals([Signal(f"w_walk_{n}", "1", f"random walk of {n}") for n in walk])
    signals = model.x, model.u, model.p + more, model.w + noises, model.y
    seen = model.output(*given)
    made = FilterModel.of(model.name, signals, (x, u, p, w, dt), (x1, check), seen, like=model)
    return made.with_walk(dict.fromkeys(walk, 0.0))


@dataclass(frozen=True, eq=False)
class NoiseFit:
    """Standard deviations of noise by maximum likelihood.

    Args:
        names: of outputs, states or noises w.
        kinds: of each, a key of :data:`KINDS`.
        units: of each.
        start, estimate: factors are of ``start``; walks in unit of the state per sqrt(s).  Where an
            output's noise changes from sample to sample, ``start`` is its root mean square.
        log_cov: covariance of the logarithms of the estimates; NaN where nothing is claimed.
        upper: one-sided 95 % limits of those that cannot be told from zero; NaN of the others.
        at_bound: those that ended at the largest factor that was tried.
        undetermined: combinations that nothing shows.
        loglik, loglik_start: at the estimate and at the start.
        spread: standard error with the scores' own scatter over that of the information; 1 is
            right.
        nis: mean of the normalised innovation squared over the number of readings; 1 is right.
        correlation: of each output's innovation with the one before, by name, and its standard
            error for white ones.
        iterations: of the scoring.
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    units: tuple[str, ...]
    start: np.ndarray
    estimate: np.ndarray
    log_cov: np.ndarray
    upper: np.ndarray
    at_bound: tuple[str, ...]
    undetermined: tuple[str, ...]
    loglik: float
    loglik_start: float
    spread: np.ndarray
    nis: float
    correlation: Mapping[str, tuple[float, float]]
    iterations: int

    @property
    def log_sigma(self) -> np.ndarray:
        """Standard errors of the logarithms: relative errors, where small."""
        return np.sqrt(np.diag(self.log_cov))

    def interval(self, level: float = 0.95) -> np.ndarray:
        """Return (lowest, highest) of each, (n, 2): about the logarithm; (0, upper) by a limit."""
        half = sigmas(level) * self.log_sigma
        out = self.estimate[:, None] * np.exp(np.outer(half, [-1.0, 1.0]))
        vague = ~np.isnan(self.upper)
        out[vague, 0], out[vague, 1] = 0.0, self.upper[vague]
        return np.asarray(out)

    @property
    def labels(self) -> tuple[str, ...]:
        """Names with what they are of: a state and an output may share one."""
        return _labels(self.names, self.kinds)

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why the estimates may not be noise alone."""
        said = [
            f"{n}: innovations are correlated from sample to sample ({r:+.2f}, white ones "
            f"+-{s:.2f}): the model misses something that noise cannot be"
            for n, (r, s) in self.correlation.items()
            if abs(r) > 4 * s
        ]
        said += [
            f"{n}: the likelihood's slope scatters {v:.1f} times as much as Gaussian noise gives; "
            "its standard error is that much too small"
            for n, v in zip(self.labels, self.spread, strict=True)
            if v > 1.5
        ]
        said += [f"{n}: at the largest factor that was tried" for n in self.at_bound]
        return (*said, *self.undetermined)


@kept
def _block(
    step: FilterStep,
    logs: tuple[str, ...],
    rows: tuple[int, ...],
    backend: str | None,
    _in_use: str,
) -> ca.Function:
    """``CHAIN`` steps with derivatives by logarithms of factors.

    (m, P, dm, dP, u, y, R, dt, v) -> the first four for the next block, and for each sample the
    statistics with the score below, the information as a column, innovation and diagonal of S.
    The factors are those of the parameters ``logs``, then of the variances of outputs ``rows``; v
    is p with their logarithms below.
    """
    nx, nu, np_, _, ny = step.model.sizes
    n, a = len(logs) + len(rows), len(logs)
    sizes = [(nx, 1), (nx, nx), (nu, 1), (np_, 1), (ny, 1), (ny, 1), (1, 1)]
    m, P, u, p, y, R, dt = (ca.MX.sym(c, *z) for c, z in zip(STEP_IN, sizes, strict=True))
    theta, on_p, on_R = ca.MX.sym("theta", n), ca.DM(np_, n), ca.DM(ny, n)
    for j, i in enumerate(step.model.p.indices(logs)):
        on_p[i, j] = 1
    for j, i in enumerate(rows):
        on_R[i, a + j] = 1
    noise = ca.if_else(R >= 0, R * ca.exp(2 * ca.mtimes(on_R, theta)), R)
    out = step.function(m, P, u, p + ca.mtimes(on_p, theta), y, noise, dt)
    given = [m, P, theta, u, p, y, R, dt]
    value = ca.Function("value", given, [ca.densify(out[i]) for i in (0, 1, 5, 6, 7)])
    dm, dP = ca.MX.sym("dm", nx, n), ca.MX.sym("dP", nx, nx * n)
    found = value(*given)
    still = [ca.MX.zeros(g.shape[0], g.shape[1] * n) for g in given[3:]]
    rates = value.forward(n)(*given, *found, dm, dP, ca.MX.eye(n), *still)
    information = _fisher(ny, n)(found[3], rates[2], rates[3])
    told = [ca.vertcat(found[4], rates[4][2, :].T), ca.vec(information), found[2]]
    results = [found[0], found[1], rates[0], rates[1], *told, ca.diag(found[3])]
    inner = ca.Function("rates", [*given, dm, dP], [ca.densify(r) for r in results])
    v = ca.MX.sym("v", np_ + n)
    called = inner(m, P, v[np_:], u, v[:np_], y, R, dt, dm, dP)
    name = f"{step.function.name()}_likelihood"
    one = ca.Function(f"{name}_one", [m, P, dm, dP, u, y, R, dt, v], called)
    return compiled(block_of(one, name, 4, short=True), backend=backend)


@once
def _fisher(ny: int, n: int) -> ca.Function:
    """SX Function (S, dnu, dS) -> information of one sample, (n, n)."""
    S, dnu, dS = (ca.SX.sym(a, ny, k) for a, k in (("S", ny), ("dnu", n), ("dS", ny * n)))
    L = cholesky(S)
    white = forward(L, dnu)
    parts = [backward(L, forward(L, dS[:, i * ny : (i + 1) * ny])) for i in range(n)]
    out = white.T @ white
    for i in range(n):
        for j in range(n):
            out[i, j] += ca.sum1(ca.sum2(parts[i] * parts[j].T)) / 2
    return ca.Function("fisher", [S, dnu, dS], [ca.densify(o) for o in ca.cse([out])])


@dataclass(frozen=True, eq=False)
class _At:
    """The likelihood at some logarithms of factors, by instant where that is wanted."""

    theta: np.ndarray
    loglik: float
    score: np.ndarray
    information: np.ndarray
    scores: np.ndarray  # (instants, n)
    nis: float
    standard: np.ndarray  # innovations over their standard deviations, (ny, instants); NaN: none


class _Likelihood:
    """The likelihood of recordings as a function of logarithms of factors."""

    def __init__(
        self,
        step: FilterStep,
        logs: Sequence[str],
        rows: Sequence[int],
        prior: Sequence[Belief],
        recordings: Sequence[Recording],
        backend: str | None,
    ) -> None:
        self.step, self.prior, self.recordings = step, prior, recordings
        self.n = len(logs) + len(rows)
        block = _block(step.shared, tuple(logs), tuple(rows), backend, backend_in_use())
        self._call = Caller(block)
        self.names = step.model.x.names

    def __call__(self, theta: np.ndarray) -> _At | None:
        """Evaluate; None where the filter fails."""
        parts = [self._run(theta, b, r) for b, r in zip(self.prior, self.recordings, strict=True)]
        if any(part is None for part in parts):
            return None
        stats, info, nu, S = (np.hstack(a) for a in zip(*(x for x in parts if x), strict=True))
        measured = np.hstack([~np.isnan(r.y) for r in self.recordings])
        standard = np.where(measured, nu / np.sqrt(S), np.nan)
        total = info.sum(1).reshape(self.n, self.n)
        scores = stats[4:].T
        nis = float(stats[1].sum() / max(stats[3].sum(), 1))
        return _At(
            theta,
            float(stats[2].sum()),
            scores.sum(0),
            (total + total.T) / 2,
            scores,
            nis,
            standard,
        )

    def _run(
        self, theta: np.ndarray, prior: Belief, data: Recording
    ) -> tuple[np.ndarray, ...] | None:
        nx, K = len(prior.x), data.size
        y, R, u, dt = padded(data, -K % CHAIN)
        dt = np.maximum(dt, INSTANT)
        logs = np.zeros(len(self.step.model.p) - data.p.size)
        v = np.concatenate([self.step.full(np.concatenate([data.p, logs])), theta])
        carried: tuple[np.ndarray, ...]
        carried = prior.mean, prior.cov, np.zeros((nx, self.n)), np.zeros((nx, nx * self.n))
        kept: list[list[np.ndarray]] = [[], [], [], []]
        for start in range(0, K, CHAIN):
            s = slice(start, start + CHAIN)
            out = self._call(*carried, u[:, s], y[:, s], R[:, s], dt[:, s], v)
            shapes = ((nx,), (nx, nx), (nx, self.n), (nx, nx * self.n))
            carried = tuple(o.reshape(z) for o, z in zip(out, shapes, strict=False))
            if not all(np.isfinite(c).all() for c in carried) or (out[4][0] > CHECK_TOL).any():
                return None
            for target, o in zip(kept, out[4:], strict=True):
                target.append(o)
        return tuple(np.hstack(a)[:, :K] for a in kept)

    def climb(
        self,
        theta: np.ndarray,
        free: Sequence[int],
        iterations: int,
        tolerance: float = CONVERGED,
    ) -> tuple[_At, int]:
        """Return the maximum over some logarithms, by scoring with damping, within the bounds.

        Raises:
            EstimationError: the filter fails at the start, or the maximum was not reached.
        """
        at = self(theta)
        if at is None:
            raise EstimationError(
                f"{self.step.model.name}: the filter fails at the noise to start from"
            )
        damping = 1e-3
        for k in range(iterations):
            move, left = self._move(at, free, damping)
            if left <= tolerance:
                return at, k
            new = self(at.theta + move)
            if new is not None and new.loglik >= at.loglik - 1e-9 * abs(at.loglik):
                damping = max(damping / 10, 1e-9)
                at = new
            else:
                damping = max(10 * damping, 1e-3)
                if damping > 1e9:
                    break
        raise EstimationError(
            f"{self.step.model.name}: the likelihood's maximum was not reached in {iterations} "
            f"iterations, {left:.2g} standard errors are left; start nearer, or fit fewer of them"
        )

    def _move(self, at: _At, free: Sequence[int], damping: float) -> tuple[np.ndarray, float]:
        """A step of scoring, and the distance from the maximum in standard errors."""
        lowest, highest = math.log(FLOOR), math.log(CEILING)
        g, t = at.score, at.theta
        out = ((t <= lowest) & (g < 0)) | ((t >= highest) & (g > 0))
        on = [i for i in free if not out[i]]
        move = np.zeros(self.n)
        if not on:
            return move, 0.0
        I, g = at.information[np.ix_(on, on)], g[on]
        size = np.sqrt(np.maximum(np.diag(I), 1e-12 * max(1.0, float(np.diag(I).max()))))
        C = I / np.outer(size, size)
        left = g / size
        step = np.linalg.solve(C + damping * np.eye(len(on)), left)
        distance = math.sqrt(
            max(float(left @ np.linalg.solve(C + 1e-9 * np.eye(len(on)), left)), 0)
        )
        full = step / size
        full *= min(1.0, STEP / max(float(np.abs(full).max()), 1e-300))
        move[on] = np.clip(t[on] + full, lowest, highest) - t[on]
        return move, distance


def fit_noise(
    model: FilterModel,
    prior: Belief | Sequence[Belief],
    recordings: Recording | Sequence[Recording],
    *,
    noise: Sequence[str] = (),
    walk: Sequence[str] = (),
    inputs: Sequence[str] = (),
    iterations: int = 1,
    iterated: str = "all",
    max_iterations: int = 60,
    backend: str | None = None,
) -> NoiseFit:
    """Find the most likely standard deviations of noise, with their uncertainty.

    Args:
        model: the model, with walks to start from.
        prior: belief at the first instant; one, or one for each recording.
        recordings: of the model, with the standard deviations of the samples to start from.
        noise: outputs whose noise is found; all samples of one by one factor.
        walk: states whose random walk is found.
        inputs: noises w (``w_Wf``) whose standard deviation is found, by one factor.
        iterations, iterated: of the filter, see :func:`estimators.filters.ekf.ekf_step`.
        max_iterations: of the scoring.
        backend: see :func:`apu_casadi.core.backend.compiled`; where None, fewer than ``MANY``
            samples are not worth the compiler's time.

    Raises:
        ParameterError: nothing to find, unknown or doubled names, an output that is never measured.
        DataError: a recording does not fit the model.
        EstimationError: the filter fails, or the maximum was not reached.
    """
    data = [recordings] if isinstance(recordings, Recording) else list(recordings)
    beliefs = [prior] * len(data) if isinstance(prior, Belief) else list(prior)
    if backend is None and sum(r.size for r in data) < MANY:
        backend = "vm"
    _check(model, data, beliefs, noise=noise, walk=walk, inputs=inputs)
    names = (*walk, *inputs, *noise)
    kinds = ("walk",) * len(walk) + ("input",) * len(inputs) + ("noise",) * len(noise)
    wide = scaled_noise(model, tuple(walk), tuple(inputs))
    logs = [*(f"log_walk_{n}" for n in walk), *(f"log_{n}" for n in inputs)]
    rows = model.y.indices(noise)
    step = ekf_step(wide, iterations, iterated)
    likelihood = _Likelihood(step, logs, rows, beliefs, data, backend)
    every = range(len(names))
    begin = likelihood(np.zeros(len(names)))
    best, n = likelihood.climb(np.zeros(len(names)), every, max_iterations)
    walks = [model.walk[model.x.index(n)] for n in walk]
    start = np.array([*walks, *(1.0 for _ in inputs), *(_rms(data, i) for i in rows)])
    lowest, highest = math.log(FLOOR) + 1e-9, math.log(CEILING) - 1e-9
    moving = [i for i in every if lowest < best.theta[i] < highest]
    cov = np.full((len(names), len(names)), math.nan)
    at = np.ix_(moving, moving)
    labels = _labels(names, kinds)
    cov[at], none, _ = invert(best.information[at], [labels[i] for i in moving])
    upper = np.full(len(names), math.nan)
    for i in every:
        vague = not cov[i, i] <= VAGUE**2 and best.theta[i] < highest
        if vague and (limit := _limit(likelihood, best, i, max_iterations)) is not None:
            upper[i] = start[i] * math.exp(limit)
            cov[i, :] = cov[:, i] = math.nan
    assert begin is not None
    return NoiseFit(
        names,
        kinds,
        tuple(_unit(model, n, k) for n, k in zip(names, kinds, strict=True)),
        start,
        start * np.exp(best.theta),
        cov,
        upper,
        tuple(labels[i] for i in every if best.theta[i] >= highest),
        none,
        best.loglik,
        begin.loglik,
        _spread(best, cov),
        best.nis,
        {n: _correlation(best.standard[model.y.index(n)]) for n in model.y.names},
        n,
    )


def _check(
    model: FilterModel,
    data: Sequence[Recording],
    beliefs: Sequence[Belief],
    **named: Sequence[str],
) -> None:
    known = {"noise": model.y, "walk": model.x, "input": model.w}
    every = [n for names in named.values() for n in names]
    if not every:
        raise ParameterError("nothing to find: give outputs (noise), states (walk) or noises w")
    for kind, names in zip(("noise", "walk", "input"), named.values(), strict=True):
        for n in names:
            if n not in known[kind]:
                raise ParameterError(
                    f"{model.name}: {KINDS[kind]} {n!r} {nearest(n, known[kind].names)}"
                )
        if twice := sorted({n for n in names if list(names).count(n) > 1}):
            raise ParameterError(f"named twice: {', '.join(twice)}")
    if len(beliefs) != len(data):
        raise ParameterError(f"{len(beliefs)} priors for {len(data)} recordings")
    for b, r in zip(beliefs, data, strict=True):
        r.check(model)
        if b.x.names != model.x.names:
            raise ParameterError(
                f"prior of {', '.join(b.x.names)}; {model.name} has {', '.join(model.x.names)}"
            )
        if narrow(b.cov):
            raise ParameterError(
                "the prior holds states known far better together than alone: the likelihood's "
                "derivatives would have no digits; take one that is less wide"
            )
    for n in named["noise"]:
        if all(np.isnan(r.y[model.y.index(n)]).all() for r in data):
            raise ParameterError(f"{n} is measured in no recording: its noise cannot be found")


def _labels(names: Sequence[str], kinds: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{KINDS[k]} {n}" for n, k in zip(names, kinds, strict=True))


def _unit(model: FilterModel, name: str, kind: str) -> str:
    if kind == "walk":
        unit = model.x[name].unit
        return f"{'' if unit == '1' else unit}/sqrt(s)".lstrip("/") if unit != "1" else "1/sqrt(s)"
    return model.y[name].unit if kind == "noise" else "1"


def _rms(data: Sequence[Recording], row: int) -> float:
    """Root mean square of an output's stated standard deviations."""
    there = [r.variance[row][~np.isnan(r.y[row])] for r in data]
    return math.sqrt(float(np.concatenate(there).mean()))


def _limit(likelihood: _Likelihood, best: _At, i: int, iterations: int) -> float | None:
    """Logarithm of the factor at which one is unlikely, the others re-fitted; None: zero is.

    A standard deviation of nothing is the end of its range, where twice the loss of log-likelihood
    is chi-squared with one degree of freedom in half of all cases only (Self and Liang 1987).
    """
    others = [j for j in range(best.theta.size) if j != i]

    def loss(theta: float, near: _At) -> tuple[float, _At]:
        begin = near.theta.copy()
        begin[i] = theta
        at, _ = likelihood.climb(begin, others, iterations, NEARLY)
        return 2 * (best.loglik - at.loglik) - LIKELY, at

    low, _ = loss(math.log(FLOOR), best)
    if low > 0:
        return None
    a = b = float(best.theta[i])
    below, over, near = -LIKELY, -LIKELY, best
    while over < 0:
        if b >= math.log(CEILING):
            return math.inf
        a, below = b, over
        b = min(b + 1.0, math.log(CEILING))
        over, near = loss(b, near)
    while min(-below, over) > 0.01 and b - a > 1e-3:
        at = a + (b - a) * min(max(below / (below - over), 0.1), 0.9)
        value, near = loss(at, near)
        a, b, below, over = (at, b, value, over) if value < 0 else (a, at, below, value)
    return a if -below < over else b


def _spread(best: _At, cov: np.ndarray) -> np.ndarray:
    """Standard error by the scores' scatter over that by the information."""
    known = np.where(np.isfinite(cov), cov, 0.0)
    robust = np.diag(known @ (best.scores.T @ best.scores) @ known)
    plain = np.diag(known)
    return np.where(plain > 0, np.sqrt(robust / np.where(plain > 0, plain, 1.0)), math.nan)


def _correlation(z: np.ndarray) -> tuple[float, float]:
    """Correlation of an output's innovations with those before, and its error if white."""
    z = z[np.isfinite(z)]
    if z.size < 3 or not z.std() > 0:
        return 0.0, math.inf
    return float((z[1:] * z[:-1]).mean() / (z**2).mean()), 1 / math.sqrt(z.size)
