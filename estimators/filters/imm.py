"""Several models at once: which of them holds, and what is the state then?

:func:`interacting_multiple_models` follows a mode that may change from sample to sample as a
Markov chain (Blom and Bar-Shalom 1988, IEEE Trans. Automatic Control 33, 780-783):
mix the beliefs of all modes, let each mode's filter take the sample, weigh the modes anew.
:func:`multiple_models` is the static case: one mode holds throughout, and the log-likelihoods of
whole filters decide (Magill 1965, IEEE Trans. Automatic Control 10, 434-439).

Probabilities are kept as logarithms: a mode that a thousand samples have spoken against may come
back, and 1e-300 is a number like any other.

A mode r(k) governs the output at sample k and the transition from k to k+1, as in
:mod:`estimators.models.filtermodel`, where both share their noise; the chain moves between
samples.  (Blom and Bar-Shalom let the mode at k govern the transition *to* k; for modes that
differ in outputs, parameters or constants only, the two are the same.)
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from scipy.linalg import expm

from apu_casadi.core.backend import backend_in_use
from apu_casadi.core.calling import Caller
from apu_casadi.core.errors import EstimationError, ParameterError, SignalError, nearest
from apu_casadi.core.lanes.lanelibrary import lanes_in_use
from apu_casadi.core.lanes.pointlanes import points_in_lanes
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signals
from estimators.filters.algebra import root_of
from estimators.filters.alike import of_one_form
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.filterblock import BLOCK, NARROW, WIDE, block_of, narrow, padded
from estimators.filters.filterensemble import run_many
from estimators.filters.filtering import FilterResult, FilterStep
from estimators.filters.mixing import log_sum, plain_mixer, root_mixer, squared, stacks
from estimators.models.filtermodel import CHECK_TOL, FilterModel
from estimators.models.recording import Recording

__all__ = [
    "ImmResult",
    "ModeBeliefs",
    "ModelProbabilities",
    "interacting_multiple_models",
    "log_normalised",
    "multiple_models",
]

IMPOSSIBLE = -1e30  # stands for the logarithm of 0: finite, so that differences are defined


def log_normalised(logs: np.ndarray, axis: int = 0) -> np.ndarray:
    """Return logarithms of probabilities that sum to one along an axis.

    Raises:
        ParameterError: a NaN or +inf, or nothing possible at all.
    """
    a = np.asarray(logs, float)
    top = a.max(axis=axis, keepdims=True)
    if not np.isfinite(top).all():
        raise ParameterError(f"logarithms of probabilities expected, the largest is {top.max()!r}")
    return np.asarray(a - top - np.log(np.exp(a - top).sum(axis=axis, keepdims=True)))


# ------------------------------------------------------------------------------ static


@dataclass(frozen=True, eq=False)
class ModelProbabilities:
    """How well each of several models explains a whole recording.

    Args:
        names: of the models.
        loglik: log-likelihoods of the recording, (M,).
        log_probability: logarithms of the posterior probabilities, (M,).
        results: each filter's result.
    """

    names: tuple[str, ...]
    loglik: np.ndarray
    log_probability: np.ndarray
    results: tuple[FilterResult, ...]

    @property
    def best(self) -> str:
        """The most probable model."""
        return self.names[int(np.argmax(self.log_probability))]

    def to_dict(self) -> dict[str, Any]:
        """Return numbers that JSON can hold."""
        return {
            "best": self.best,
            "loglik": dict(zip(self.names, self.loglik.tolist(), strict=True)),
            "log_probability": dict(zip(self.names, self.log_probability.tolist(), strict=True)),
        }


def multiple_models(
    models: Mapping[str, FilterModel | FilterStep],
    prior: Belief | Mapping[str, Belief],
    data: Recording | Mapping[str, Recording],
    *,
    prior_probability: Mapping[str, float] | None = None,
    full: bool = False,
    backend: str | None = None,
) -> ModelProbabilities:
    """Run one filter for each model, and compare their likelihoods by Bayes' rule.

    Filters of one form are evaluated together (:mod:`estimators.filters.filterensemble`).

    A model with an unknown size is penalised for it by the spread of its own prior: the likelihood
    is that of the samples with the size integrated out.

    Args:
        models: models (taken by extended Kalman filters) or filters, by name.
        prior: belief at the first instant, one for all or one for each.
        data: recording, one for all or one for each (of the same measurements).
        prior_probability: of the models, equal by default.
        full, backend: see :func:`estimators.filters.filtering.run`.

    Raises:
        ParameterError: no models, unknown names, probabilities that are none.
    """
    steps = _steps(models)
    logp = _log_prior(tuple(steps), prior_probability)
    priors = [prior if isinstance(prior, Belief) else prior[n] for n in steps]
    all_data = [data if isinstance(data, Recording) else data[n] for n in steps]
    results = run_many([*steps.values()], priors, all_data, full=full, backend=backend)
    loglik = np.array([r.loglik for r in results])
    return ModelProbabilities(tuple(steps), loglik, log_normalised(loglik + logp), tuple(results))


def _steps(models: Mapping[str, FilterModel | FilterStep]) -> dict[str, FilterStep]:
    if not models:
        raise ParameterError("no models were given")
    return {n: m if isinstance(m, FilterStep) else ekf_step(m) for n, m in models.items()}


def _log_prior(names: tuple[str, ...], given: Mapping[str, float] | None) -> np.ndarray:
    if given is None:
        return np.full(len(names), -math.log(len(names)))
    for n in given:
        if n not in names:
            raise ParameterError(f"unknown mode {n!r} {nearest(n, names)}")
    p = np.array([given.get(n, math.nan) for n in names])
    if not (np.isfinite(p).all() and (p >= 0).all() and p.sum() > 0):
        raise ParameterError(
            f"prior probabilities >= 0 are needed for all of {', '.join(names)}; got {dict(given)}"
        )
    return _logs(p / p.sum())


def _logs(p: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return np.asarray(np.where(p > 0, np.log(p), IMPOSSIBLE))


# ------------------------------------------------------------------------------ interacting


@dataclass(frozen=True, eq=False)
class ModeBeliefs:
    """What one mode's filter knew along a recording of K instants, its n states.

    Args:
        x: its states.
        mean, cov: after each sample, (n, K) and (K, n, n).
        mean_next, cov_next: carried to the next sample by this mode, not mixed yet.
        cross: covariance of the state after the sample and the next one, (K, n, n).
    """

    x: Signals
    mean: np.ndarray
    cov: np.ndarray
    mean_next: np.ndarray
    cov_next: np.ndarray
    cross: np.ndarray


@dataclass(frozen=True, eq=False)
class ImmResult:
    """What interacting filters believed along a recording of K instants.

    Args:
        names: of the M modes.
        x: states that all modes have.
        t: instants, s, (K,).
        log_probability: logarithms of the modes' probabilities after each sample, (M, K).
        mean, variance: of the mixture after each sample, (nx, K).
        mode_mean: each mode's own filtered mean, all its states, (nx_j, K).
        loglik: log-likelihood of the recording.
        final: each mode's belief at the last instant, after its sample.
        modes: what each mode's filter knew; None unless kept.
        log_transition: logarithms of the transition probabilities into each sample, (K, M, M), from
            mode (row) to mode; None unless kept.
    """

    names: tuple[str, ...]
    x: Signals
    t: np.ndarray
    log_probability: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    mode_mean: tuple[np.ndarray, ...]
    loglik: float
    final: tuple[Belief, ...]
    modes: tuple[ModeBeliefs, ...] | None = field(default=None, repr=False)
    log_transition: np.ndarray | None = field(default=None, repr=False)

    @property
    def probability(self) -> np.ndarray:
        """Probabilities of the modes after each sample, (M, K)."""
        return np.asarray(np.exp(self.log_probability))

    @property
    def best(self) -> np.ndarray:
        """Index of the most probable mode after each sample, (K,)."""
        return np.asarray(np.argmax(self.log_probability, axis=0))

    def __getitem__(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return (mean, standard deviation) of one state of the mixture, each of shape (K,)."""
        i = self.x.index(name)
        return self.mean[i], np.sqrt(self.variance[i])

    def to_dict(self) -> dict[str, Any]:
        """Return numbers that JSON can hold: the modes at the end, and when the best changed."""
        change = np.flatnonzero(np.diff(self.best)) + 1
        return {
            "loglik": self.loglik,
            "log_probability": dict(
                zip(self.names, self.log_probability[:, -1].tolist(), strict=True)
            ),
            "path": [
                {"t": float(self.t[k]), "mode": self.names[int(self.best[k])]}
                for k in (0, *change.tolist())
            ],
        }


def _weigher(x: Sequence[Signals], common: Signals) -> ca.Function:
    """SX Function (logs, logliks, m_f, P_f) -> (logs, loglik, mean, variance) of the mixture."""
    M, n = len(x), [len(s) for s in x]
    logs, ll = ca.SX.sym("logs", M), ca.SX.sym("ll", M)
    m_in, P_in = ca.SX.sym("m", sum(n)), ca.SX.sym("P", sum(k * k for k in n))
    total = log_sum(logs + ll)
    new = logs + ll - total
    weights = ca.exp(new)
    ms = ca.vertsplit(m_in, [0, *np.cumsum(n).tolist()])
    Ps = ca.vertsplit(P_in, [0, *np.cumsum([k * k for k in n]).tolist()])
    rows = [x[i].indices(common.names) for i in range(M)]
    mean, var = ca.SX(len(common), 1), ca.SX(len(common), 1)
    for i in range(M):
        mean += weights[i] * ms[i][rows[i]]
    for i in range(M):
        own = ca.diag(ca.reshape(Ps[i], n[i], n[i]))[rows[i]]
        var += weights[i] * (own + (ms[i][rows[i]] - mean) ** 2)
    out = [new, total, ca.densify(mean), ca.densify(var)]
    return ca.Function("weigh", [logs, ll, m_in, P_in], out)


@kept
def _block(
    first: FilterStep,
    others: tuple[FilterStep, ...],
    common: Signals,
    roots: bool,
    full: bool,
    backend: str | None,
    _in_use: str,
) -> ca.Function:
    """``BLOCK`` cycles of mixing, filtering and weighing in one function.

    (logs, m, P, logT, u, y, R, dt, p) -> (logs, m, P) for the next block, and for each sample logs,
    the predicted m, P, the filtered m, P, mean and variance of the mixture, log-likelihood with
    checks, diagonals of S, and, if ``full``, the cross-covariances; m, P, p of all modes stacked.
    """
    steps = (first, *others)
    models = [s.model for s in steps]
    x = [m.x for m in models]
    n = [len(s) for s in x]
    at_p = np.cumsum([0, *(len(m.p) for m in models)]).tolist()
    _, nu, _, _, ny = models[0].sizes
    shapes = {"logs": len(n), "m": sum(n), "P": sum(k * k for k in n), "logT": len(n) ** 2}
    shapes |= {"u": nu, "y": ny, "R": ny, "dt": 1, "p": at_p[-1]}
    s = {k: ca.MX.sym(k, v) for k, v in shapes.items()}
    mixer = root_mixer if roots else plain_mixer
    logs, m, P = mixer(x)(s["logs"], s["m"], s["P"], s["logT"])
    ms = ca.vertsplit(m, [0, *np.cumsum(n).tolist()])
    Ps = ca.vertsplit(P, [0, *np.cumsum([k * k for k in n]).tolist()])
    ps = ca.vertsplit(s["p"], at_p)
    # covariances are mixed, so filters that carry square roots hand them over as such
    functions = [(step if roots else step.plain).function for step in steps]
    given = [(ms[i], ca.reshape(Ps[i], k, k), ps[i]) for i, k in enumerate(n)]
    outs = _filtered(functions, given, (s["u"], s["y"], s["R"], s["dt"]))
    m_f = ca.vertcat(*(o[2] for o in outs))
    P_f = ca.vertcat(*(ca.vec(o[3]) for o in outs))
    ll = ca.vertcat(*(o[7][2] for o in outs))
    check = ca.vertcat(*(o[7][0] for o in outs))
    new, total, mean, var = _weigher(x, common)(logs, ll, m_f, P_f)
    carried = [new, ca.vertcat(*(o[0] for o in outs)), ca.vertcat(*(ca.vec(o[1]) for o in outs))]
    S = ca.vertcat(*(ca.diag(o[6]) for o in outs))
    kept = [*carried, m_f, P_f, mean, var, ca.vertcat(total, check), S]
    kept += [ca.vertcat(*(ca.vec(o[4]) for o in outs))] if full else []
    name = f"imm{'_roots' if roots else ''}{'_full' if full else ''}"
    one = ca.Function(f"{name}_one", list(s.values()), [*carried, *kept])
    return points_in_lanes(block_of(one, name, len(carried)), backend=backend)


def _filtered(
    functions: Sequence[ca.Function], given: Sequence[Any], common: Sequence[Any]
) -> list[list[Any]]:
    """Call each mode's filter; those of one function as a map, whose points go in lanes.

    Args:
        functions: of the modes, as of :class:`~estimators.filters.filtering.FilterStep`.
        given: (m, P, p) of each mode.
        common: (u, y, R, dt).
    """
    outs: list[Any] = [None] * len(functions)
    u, y, R, dt = common
    alike: dict[ca.Function, list[int]] = {}
    for i, f in enumerate(functions):
        alike.setdefault(f, []).append(i)
    for f, modes in alike.items():
        M, all_of = len(modes), f
        if M > 1:
            all_of = f.map(f"{f.name()}_x{M}", "serial", M, [2, 4, 5, 6], [])
        m, P, p = (ca.horzcat(*(given[i][k] for i in modes)) for k in range(3))
        found = [ca.horzsplit_n(o, M) for o in all_of(m, P, u, p, y, R, dt)]
        for k, i in enumerate(modes):
            outs[i] = [parts[k] for parts in found]
    return outs


def _with_roots(step: FilterStep) -> FilterStep:
    """The step in square-root form."""
    return step if step.root or step.wide is None else step.wide()


def _needs_roots(
    n: list[int], P1: np.ndarray, P_f: np.ndarray, S: np.ndarray, R: np.ndarray
) -> bool:
    """Whether a block of covariances has lost digits, as in :mod:`estimators.filters.filtering`.

    P1 (sum of squares,) at the end, P_f (sum of squares, samples), S (modes x ny, samples).
    """
    R = np.tile(R, (S.shape[0] // R.shape[0], 1))
    if ((R > 0) & ~(S <= WIDE * R)).any():
        return True
    at = np.cumsum([0, *(k * k for k in n)])
    some = np.column_stack([P_f[:, ::10], P1])
    return any(
        _any_narrow(some[i:j].T.reshape(-1, k, k))
        for i, j, k in zip(at[:-1], at[1:], n, strict=True)
    )


def _any_narrow(P: np.ndarray) -> bool:
    """:func:`~estimators.filters.filtering.narrow` for any of several covariances, (K, n, n)."""
    d = np.diagonal(P, axis1=1, axis2=2)
    if not (d > 0).all():
        return any(narrow(one) for one in P)
    s = 1 / np.sqrt(d)
    try:
        L = np.linalg.cholesky(P * s[:, :, None] * s[:, None, :])
    except np.linalg.LinAlgError:
        return True
    return not bool((np.diagonal(L, axis1=1, axis2=2) ** 2 >= NARROW).all())


def _log_transitions(
    M: int, data: Recording, transition: Any, rates: Any, names: tuple[str, ...]
) -> np.ndarray:
    """Logarithms of the transition probabilities into each sample, (M*M, K), column-major."""
    if (transition is None) == (rates is None):
        raise ParameterError("give either transition (for each sample) or rates (per second)")
    T = np.asarray(transition if rates is None else rates, float)
    if T.shape != (M, M) or not np.isfinite(T).all():
        raise ParameterError(f"a finite matrix of {M} x {M} is needed for {', '.join(names)}")
    off = T - np.diag(np.diag(T))
    want = 1.0 if rates is None else 0.0
    bad = np.abs(T.sum(1) - want) > 1e-9 * max(1.0, float(np.abs(T).max()))
    bad |= (off < 0).any(1)
    if rates is None:
        bad |= np.diag(T) < 0
    if bad.any():
        i = int(np.argmax(bad))
        raise ParameterError(
            f"row {names[i]!r} of the transitions: entries >= 0 that sum to {want:g} expected "
            f"(rates: except the diagonal), got {T[i].tolist()}"
        )
    out = np.empty((M * M, data.size))
    out[:, 0] = _logs(np.eye(M)).ravel(order="F")  # the prior is of the first sample's mode
    if rates is None:
        out[:, 1:] = _logs(T).ravel(order="F")[:, None]
        return out
    # the same step returns again and again, up to rounding of the stamps
    steps, back = np.unique(np.round(data.dt[:-1], 12), return_inverse=True)
    logs = np.array([_logs(np.maximum(expm(T * d), 0.0)).ravel(order="F") for d in steps])
    out[:, 1:] = logs[back].T if steps.size else 0.0
    return out


def interacting_multiple_models(
    models: Mapping[str, FilterModel | FilterStep],
    prior: Belief | Mapping[str, Belief],
    data: Recording,
    *,
    transition: Any = None,
    rates: Any = None,
    prior_probability: Mapping[str, float] | None = None,
    full: bool = False,
    backend: str | None = None,
) -> ImmResult:
    """Filter a recording with a mode that may change.

    Args:
        models: models (taken by extended Kalman filters) or filters, by name; same inputs,
            parameters and outputs.  States may differ: beliefs are exchanged by name.
        prior: belief at the first instant, before its sample; one for all modes or one for each.
        data: the recording.
        transition: (M, M) probabilities of going from mode i (row) to j between two samples,
            whatever the time between them; the identity makes the modes static.
        rates: instead, (M, M) transition rates, 1/s, rows summing to zero: the matrix exponential
            over each step, so that samples may come at any instants.
        prior_probability: of the modes at the first sample, equal by default.
        full: keep what :func:`estimators.batch.immsmoother.imm_smoother` needs.
        backend: see :func:`apu_casadi.core.backend.compiled`.

    Raises:
        ParameterError: transitions that are none, unknown or missing modes.
        SignalError: models or priors that do not fit together.
        EstimationError: a mode's belief was lost; names the mode and the instant.
    """
    steps = _steps(models)
    names = tuple(steps)
    priors = [prior if isinstance(prior, Belief) else prior[n] for n in names]
    _check(steps, priors)
    first = next(iter(steps.values())).model
    data.check(first)
    common = Signals([s for s in first.x if all(s.name in b.x.names for b in priors)])
    logT = _log_transitions(len(names), data, transition, rates, names)
    n = [len(b.x) for b in priors]
    K = data.size
    pad = -K % BLOCK
    y, R, u, dt = padded(data, pad)
    # a padded sample changes no mode
    logT = np.concatenate([logT, np.repeat(logT[:, :1], pad, axis=1)], axis=1)
    logs = _log_prior(names, prior_probability)
    passes = _Passes([*steps.values()], priors, logs, common, data.p, full, backend)
    columns = (0, 3, 5, 6, 7, 1, 2, 4, 9) if full else (0, 3, 5, 6, 7)
    kept: list[list[np.ndarray]] = [[] for _ in columns]
    for start in range(0, K + pad, BLOCK):
        s = slice(start, start + BLOCK)
        out = passes.block(logT[:, s], u[:, s], y[:, s], R[:, s], dt[:, s], K - start)
        for target, i in zip(kept, columns, strict=True):
            root = i == 2 and passes.rooted
            target.append(squared(out[i], n) if root else out[i].copy())
        _believable(names, n, data, out[1], out[2], out[7], start)
        last = out[4][:, -1].copy()  # what is padded may be carried on
    logp, m_f, mean, var, stats, *more = (np.concatenate(k, axis=1) for k in kept)
    means = np.split(m_f, np.cumsum(n)[:-1])
    final = []
    for b, m, (cov,) in zip(priors, means, stacks(last[:, None], n), strict=True):
        final.append(Belief(b.x, m[:, -1].copy(), (cov + cov.T) / 2))
    loglik = float(stats[0].sum())
    result = ImmResult(names, common, data.t, logp, mean, var, tuple(means), loglik, tuple(final))
    if not full:
        return result
    log_T = logT[:, :K].T.reshape(K, len(n), len(n)).transpose(0, 2, 1)
    modes = _modes([b.x for b in priors], means, *more)
    return dataclasses.replace(result, modes=modes, log_transition=log_T)


def _modes(
    x: Sequence[Signals],
    means: Sequence[np.ndarray],
    m1: np.ndarray,
    P1: np.ndarray,
    P_f: np.ndarray,
    cross: np.ndarray,
) -> tuple[ModeBeliefs, ...]:
    """Part what was kept of all modes, matrices as columns one below the other."""
    n = [len(s) for s in x]
    nexts = np.split(m1, np.cumsum(n)[:-1])
    covs, cov_nexts, crosses = (stacks(a, n) for a in (P_f, P1, cross))
    each = zip(x, means, covs, nexts, cov_nexts, crosses, strict=True)
    return tuple(ModeBeliefs(*one) for one in each)


def _check(steps: Mapping[str, FilterStep], priors: Sequence[Belief]) -> None:
    """Refuse modes that differ in what they share, and priors of other states."""
    base, first = next(iter(steps.items()))
    for (name, step), b in zip(steps.items(), priors, strict=True):
        for kind in ("u", "p", "y"):
            mine, want = getattr(step.model, kind).names, getattr(first.model, kind).names
            if mine != want:
                raise SignalError(
                    f"modes {base!r} and {name!r} differ in {kind}: {', '.join(want)} and "
                    f"{', '.join(mine)}"
                )
        if b.x.names != step.model.x.names:
            raise SignalError(
                f"mode {name!r}: prior of {', '.join(b.x.names)}; its model has "
                f"{', '.join(step.model.x.names)}"
            )


class _Passes:
    """Blocks one after the other, in square-root form from where a covariance loses digits.

    Args:
        steps, priors: of the modes.
        logs: logarithms of the modes' probabilities at the first sample.
        p: known parameters of the models.
        common, full, backend: as of :func:`_block`.
    """

    def __init__(
        self,
        steps: list[FilterStep],
        priors: list[Belief],
        logs: np.ndarray,
        common: Signals,
        p: np.ndarray,
        full: bool,
        backend: str | None,
    ) -> None:
        self.steps, self._p = steps, p
        self.common, self.full, self.backend = common, full, backend
        self.n = [len(b.x) for b in priors]
        # what a filter without square-root form lacks, mixing cannot give back
        self.able = all(step.root or step.wide is not None for step in steps)
        self.rooted = self.able and any(narrow(b.cov) for b in priors)
        self.logs, self.m = logs, np.concatenate([b.mean for b in priors])
        roots = [root_of(b.cov) if b.root is None else b.root for b in priors]
        carried = roots if self.rooted else [b.cov for b in priors]
        self.P = np.concatenate([c.ravel(order="F") for c in carried])
        self._call = self._caller()

    def _caller(self) -> Caller:
        # the buffers are this run's own, as in estimators.filters.filtering
        # the modes' families: another unit's modes have other numbers in p, and the same functions
        steps = of_one_form([_with_roots(s) if self.rooted else s for s in self.steps])
        self.p = np.concatenate([step.full(self._p) for step in steps])
        first, *others = (step.shared for step in steps)
        in_use = f"{backend_in_use()} {lanes_in_use()}"
        how = self.rooted, self.full, self.backend, in_use
        return Caller(_block(first, tuple(others), self.common, *how), copy=False)

    def block(self, *given: Any) -> list[np.ndarray]:
        """Return what is kept of one block, its last argument the samples in it; go on."""
        *data, K = given
        out = self._call(self.logs, self.m, self.P, *data, self.p)
        if self.able and not self.rooted:
            R, P1 = data[3][:, :K], out[2].ravel()
            if _needs_roots(self.n, P1, out[7][:, :K], out[11][:, :K], R):
                roots = [root_of(P) for (P,) in stacks(self.P[:, None], self.n)]
                self.P = np.concatenate([L.ravel(order="F") for L in roots])
                self.rooted = True
                self._call = self._caller()
                out = self._call(self.logs, self.m, self.P, *data, self.p)
        self.logs, self.m, self.P = (o.ravel().copy() for o in out[:3])
        return [o[:, :K] for o in out[3:]]


def _believable(
    names: tuple[str, ...],
    n: list[int],
    data: Recording,
    m1: np.ndarray,
    P1: np.ndarray,
    stats: np.ndarray,
    start: int,
) -> None:
    """Refuse a block in which a mode's filter failed, whose NaN would reach all others."""
    ok = stats[1:] <= CHECK_TOL
    edges, squares = np.cumsum([0, *n]), np.cumsum([0, *(k * k for k in n)])
    for j in range(len(names)):
        ok[j] &= np.isfinite(m1[edges[j] : edges[j + 1]]).all(0)
        ok[j] &= np.isfinite(P1[squares[j] : squares[j + 1]]).all(0)
    if (ok.all(0) & np.isfinite(stats[0])).all():
        return
    k = int(np.argmin(ok.all(0) & np.isfinite(stats[0])))
    j = int(np.argmin(ok[:, k]))
    raise EstimationError(
        f"mode {names[j]!r} at t = {data.t[start + k]:.9g} s (sample {start + k}): its belief is "
        f"lost (model check {stats[1 + j, k]:.1e}); a mode must be solvable wherever the others "
        "may lead it"
    )
