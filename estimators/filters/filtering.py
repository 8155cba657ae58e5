"""What all recursive filters share: running a step over a recording, and what comes out.

A filter is one CasADi function, a *step*: correct the belief with a sample, then carry it to the
next sample.  :func:`run` folds it over a recording, ``BLOCK`` samples in one call, in generated C
where there is a compiler; Python is not crossed for each sample.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from apu_casadi.core.backend import backend_in_use
from apu_casadi.core.errors import EstimationError, SignalError
from apu_casadi.core.lanes.together import Course, Question, Together, alone, asking
from apu_casadi.core.results import dataset
from apu_casadi.core.sharing import Parametric, derived
from apu_casadi.core.signals import Signal, Signals
from estimators.filters.algebra import cholesky_semidefinite, root_of
from estimators.filters.belief import Belief
from estimators.filters.filterblock import (
    BLOCK,
    CHAIN,
    ROOT_OUT,
    STEP_IN,
    STEP_OUT,
    WIDE,
    block_function,
    block_length,
    block_of,
    in_halves,
    narrow,
    packed_diagonal,
    padded,
    row_function,
    unpacked,
)
from estimators.filters.rowblock import Rows
from estimators.filters.sweeping import Piece, Sweep
from estimators.models.filtermodel import CHECK_TOL, FilterModel
from estimators.models.recording import Recording

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "BLOCK",
    "CHAIN",
    "ROOT_OUT",
    "STEP_IN",
    "STEP_OUT",
    "FilterResult",
    "FilterStep",
    "StepMaker",
    "block_of",
    "narrow",
    "padded",
    "result_of",
    "rooted",
    "run",
    "sweep_of",
]

STATS = ("check", "nis", "loglik", "measured")


@dataclass(frozen=True, eq=False)
class FilterStep(Parametric):
    """A filter for a model: one function, and its compiled forms.

    Args:
        model: the model.
        function: Function ``STEP_IN`` -> ``STEP_OUT``.
        root: the filter carries square roots: ``P`` and ``P1`` (and only these) are lower
            triangular factors L of the covariance L L'.
        wide: makes the same filter in square-root form, for beliefs whose covariance double
            precision does not hold; None where there is none.
        rows: takes the step apart, for blocks whose lanes are rows; None where there is no such
            form, or returns None.
    """

    model: FilterModel
    function: ca.Function
    root: bool = False
    wide: Callable[[], FilterStep] | None = None
    rows: Callable[[], Rows | None] | None = None

    def __post_init__(self) -> None:
        f, (nx, nu, np_, _, ny) = self.function, self.model.sizes
        want_in = (nx, 1), (nx, nx), (nu, 1), (np_, 1), (ny, 1), (ny, 1), (1, 1)
        want_out = (nx, 1), (nx, nx), (nx, 1), (nx, nx), (nx, nx), (ny, 1), (ny, ny), (4, 1)
        got_in = [f.size_in(i) for i in range(f.n_in())]
        got_out = [f.size_out(i) for i in range(f.n_out())][: len(STEP_OUT)]
        for what, names, got, want in (
            ("inputs", STEP_IN, got_in, want_in),
            ("outputs", STEP_OUT, got_out, want_out),
        ):
            if got != [*want]:
                shown = ", ".join(f"{n} {s}" for n, s in zip(names, want, strict=True))
                raise SignalError(
                    f"step {f.name()} of {self.model.name}: {what} {shown} expected, got {got}"
                )

    @property
    def family(self) -> FilterStep | None:
        """The step of the model's family, which :func:`run` runs with the numbers of the unit."""
        return self.__dict__.get("_family")

    @property
    def shared(self) -> FilterStep:
        """The family's step, or the step itself if it has none: what to make functions of."""
        return self if self.family is None else self.family

    def full(self, p: Any) -> Any:
        """Return the known parameters that :attr:`shared` takes, from the model's."""
        return p if self.family is None else self.model.full(p)

    def unit(self, like: FilterModel) -> FilterStep:
        """Return the step for a model of this one's family."""
        f = self.function
        m, P, u, _, y, R, dt = (ca.MX.sym(f.name_in(i), *f.size_in(i)) for i in range(f.n_in()))
        p = ca.MX.sym("p", len(like.p))
        out = f.call([m, P, u, like.full(p), y, R, dt])
        made = ca.Function(f.name(), [m, P, u, p, y, R, dt], out, f.name_in(), f.name_out())
        wide = None if self.wide is None else partial(_wide_unit, self.wide, like)
        step = FilterStep(like, made, self.root, wide)
        step.__dict__["_family"] = self
        return step

    @property
    def gives_roots(self) -> bool:
        """Whether the function gives ``ROOT_OUT`` too."""
        return bool(self.function.n_out() > len(STEP_OUT))

    @derived
    def plain(self) -> FilterStep:
        """The same filter with covariances in and out, for use inside other functions.

        A filter that carries square roots then takes one root more at each step.
        """
        if not self.root:
            return self
        s = [
            ca.MX.sym(
                self.function.name_in(i), self.function.size1_in(i), self.function.size2_in(i)
            )
            for i in range(len(STEP_IN))
        ]
        P = ca.SX.sym("P", s[1].shape[0], s[1].shape[0])
        root = ca.Function("root", [P], [ca.densify(cholesky_semidefinite(P))])
        out = list(self.function(s[0], root(s[1]), *s[2:]))[: len(STEP_OUT)]
        P1 = out[1] @ out[1].T
        out[1] = ca.densify(ca.tril(P1) + ca.tril(P1, False).T)
        name = f"{self.function.name()}_plain"
        return FilterStep(self.model, ca.Function(name, s, out, STEP_IN, STEP_OUT))


def _wide_unit(wide: Callable[[], FilterStep], like: FilterModel) -> FilterStep:
    return wide().unit(like)


@dataclass(frozen=True, eq=False)
class FilterResult:
    """What a filter believed along a recording of K instants.

    Args:
        x, y: states and outputs.
        t: instants, s, shape (K,).
        mean, variance: filtered, shapes (nx, K).
        innovation, innovation_variance: measured minus predicted and its variance, shapes (ny, K);
            NaN where nothing was measured.
        nis: normalised innovation squared of each sample, shape (K,); chi-squared with ``measured``
            degrees of freedom if the filter is consistent.
        measured: number of outputs measured at each instant, shape (K,).
        loglik: log-likelihood of the recording.
        final: belief at the last instant, after its sample.
        cov: filtered covariances, shape (K, nx, nx); None unless kept.
        mean_pred, cov_pred: belief before each sample, shapes (nx, K), (K, nx, nx); None unless
            kept.
        cross: covariance of the filtered state at k and the predicted one at k+1, (K, nx, nx).
        innovation_cov: covariances of the innovations, (K, ny, ny), 1 on the diagonal where nothing
            was measured; None unless kept.
        some_cov: filtered covariances of the samples asked for, (n, nx, nx); None unless kept.
        roots: roots of the predicted covariance before each sample, and Y, Z and the root of the
            filtered covariance, each (K, nx, nx); see :mod:`estimators.filters.rootfilter`.
        again: runs the same filter in square-root form and keeps the roots; None where it cannot.
    """

    x: Signals
    y: Signals
    t: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    innovation: np.ndarray
    innovation_variance: np.ndarray
    nis: np.ndarray
    measured: np.ndarray
    loglik: float
    final: Belief
    cov: np.ndarray | None = None
    mean_pred: np.ndarray | None = None
    cov_pred: np.ndarray | None = None
    cross: np.ndarray | None = None
    innovation_cov: np.ndarray | None = None
    some_cov: np.ndarray | None = None
    roots: tuple[np.ndarray, ...] | None = field(default=None, repr=False)
    again: Callable[[], FilterResult] | None = field(default=None, repr=False)

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled: numbers and names, not the filter behind ``again``."""
        return {**self.__dict__, "again": None}

    def __getitem__(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return (mean, standard deviation) of one state, each of shape (K,)."""
        i = self.x.index(name)
        return self.mean[i], np.sqrt(self.variance[i])

    def to_dataset(self) -> xr.Dataset:
        """Return means, standard deviations (``<name>_sigma``), innovations and NIS, labelled."""
        signals, values = [], {}
        for i, s in enumerate(self.x):
            signals += [s, Signal(f"{s.name}_sigma", s.unit, f"standard deviation of {s.name}")]
            values[s.name] = self.mean[i]
            values[f"{s.name}_sigma"] = np.sqrt(self.variance[i])
        for i, s in enumerate(self.y):
            name = f"innovation_{s.name}"
            signals += [
                Signal(name, s.unit, f"measured minus predicted {s.name}"),
                Signal(f"{name}_sigma", s.unit, f"its standard deviation: {s.name}"),
            ]
            values[name] = self.innovation[i]
            values[f"{name}_sigma"] = np.sqrt(self.innovation_variance[i])
        signals += [
            Signal("nis", "1", "normalised innovation squared"),
            Signal("measured", "1", "number of outputs measured"),
        ]
        values |= {"nis": self.nis, "measured": self.measured}
        return dataset(
            {"time": self.t},
            {"time": values},
            signals=signals,
            attrs={"loglik": float(self.loglik)},
        )


#: Makes a filter's step for a model: ``ekf_step``, ``ukf_step``, or a function of one's own.
StepMaker = Callable[[FilterModel], FilterStep]


def run(
    step: FilterStep,
    prior: Belief,
    data: Recording,
    *,
    full: bool = False,
    cov_at: np.ndarray | None = None,
    backend: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FilterResult:
    """Run a filter over a recording.

    Args:
        step: the filter.
        prior: belief at the first instant, before its sample.
        data: the recording.
        full: keep the covariances and what smoothers need; 3 nx^2 numbers for each instant.
        cov_at: samples, ascending, whose filtered covariances are kept in ``some_cov``.
        backend: see :func:`apu_casadi.core.backend.compiled`.
        progress: called with (done, total) instants after every block.

    Raises:
        DataError: the recording does not fit the model.
        SignalError: the prior is of other states.
        EstimationError: the model could not be evaluated, or the belief is no longer finite; names
            the instant and the state.
    """
    how: dict[str, Any] = {"full": full, "cov_at": cov_at, "backend": backend}
    return alone(course(step, prior, data, progress=progress, **how))


def course(
    step: FilterStep,
    prior: Belief,
    data: Recording,
    *,
    full: bool = False,
    cov_at: np.ndarray | None = None,
    backend: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Course[FilterResult]:
    """Do what :func:`run` does, and pause where many filters are evaluated together.

    See :mod:`estimators.filters.filterensemble`.
    """
    model = step.model
    data.check(model)
    if prior.x.names != model.x.names:
        raise SignalError(
            f"prior of {', '.join(prior.x.names)}; {model.name} has {', '.join(model.x.names)}"
        )
    if not (full or asking()):
        made = _swept(step, prior, data, cov_at, backend, progress)
        if made is not None:
            return made
    passes = _Passes(step, prior, full, backend, short=not full and cov_at is None)
    nx, _, _, _, ny = model.sizes
    K = data.size
    length = block_length(step.shared.model)
    n_blocks = -(-K // length)
    pad = n_blocks * length - K
    missing = np.isnan(data.y)
    y, R, u, dt = padded(data, pad)
    p = step.full(data.p)
    mean, var = np.empty((nx, K)), np.empty((nx, K))
    nu, S = np.empty((ny, K)), np.empty((ny, K))
    stats = np.empty((len(STATS), K))
    kept = _Kept.of(K, nx, ny, roots=step.gives_roots) if full else None
    wanted = np.zeros(0, dtype=int) if cov_at is None else np.asarray(cov_at, dtype=int)
    some = np.empty((wanted.size, nx, nx))
    for b in range(n_blocks):
        s = slice(b * length, (b + 1) * length)
        n = min(length, K - b * length)
        r = slice(b * length, b * length + n)
        out = yield from passes.block(u[:, s], y[:, s], R[:, s], dt[:, s], p)
        for target, source in (
            (mean, out[2]),
            (var, out[3] if passes.short else out[3][passes.diagonal]),
            (nu, out[4]),
            (S, out[5]),
            (stats, out[6]),
        ):
            target[:, r] = source[:, :n]
        _believable(model, data, stats[:, r], mean[:, r], var[:, r], r.start)
        here = (wanted >= r.start) & (wanted < r.stop)
        if here.any():
            some[here] = passes.whole(out[3][:, wanted[here] - r.start])
        if kept is not None:
            kept.put(r, [o[:, :n] for o in (out[3], *out[7:])], root=passes.rooted)
        if progress is not None:
            progress(r.stop, K)
    last = _tidy(passes.P_last if passes.short else passes.whole(out[3][:, [n - 1]])[0])
    root = None if not passes.now.gives_roots else out[-1][:, n - 1].reshape(nx, nx).T.copy()
    np.maximum(var, 0.0, out=var)  # rounding, judged above
    nu[missing], S[missing] = np.nan, np.nan
    final = Belief(model.x, mean[:, -1].copy(), last, root)
    told = stats[1], stats[3], float(stats[2].sum()), final
    more: dict[str, Any] = {} if kept is None else kept.fields()
    more["some_cov"] = None if cov_at is None else some
    if full and step.wide is not None:
        more["again"] = partial(rooted, step, prior, data, backend)
    return FilterResult(model.x, model.y, data.t, mean, var, nu, S, *told, **more)


def _tidy(P: np.ndarray) -> np.ndarray:
    """Return a covariance without what rounding leaves."""
    out: np.ndarray = (P + P.T) / 2
    np.fill_diagonal(out, np.maximum(np.diag(out), 0.0))
    return out


def _swept(
    step: FilterStep,
    prior: Belief,
    data: Recording,
    cov_at: np.ndarray | None,
    backend: str | None,
    progress: Callable[[int, int], None] | None,
) -> FilterResult | None:
    """Run a filter without Python between its blocks; None where more is needed."""
    sweep = sweep_of(step, prior, data, cov_at, backend)
    piece = None if sweep is None else sweep.piece(0, data.size, prior, progress)
    return None if piece is None else result_of(step.model, data, 0, piece, cov_at is not None)


def sweep_of(
    step: FilterStep,
    prior: Belief,
    data: Recording,
    cov_at: np.ndarray | None,
    backend: str | None,
    *,
    remember: bool = False,
) -> Sweep | None:
    """Return the filter over parts of a recording; None if it is not carried by covariances."""
    if not in_halves(step.shared) or prior.root is not None or not step.model.y.names:
        return None
    wide = step.wide is not None
    if wide and narrow(prior.cov):
        return None
    by_rows = row_function(step.shared, backend, backend_in_use())
    block = by_rows
    if block is None:
        block = block_function(step.shared, False, cov_at is None, backend, backend_in_use())[0]
    how: dict[str, Any] = {"wide": wide, "cov_at": cov_at, "remember": remember}
    return Sweep(step.model, block, data, step.full(data.p), rows=by_rows is not None, **how)


def result_of(
    model: FilterModel, data: Recording, start: int, piece: Piece, some: bool
) -> FilterResult:
    """Return what a sweep over a part of a recording says."""
    mean, var, nu, S, stats = piece[:5]
    part = slice(start, start + mean.shape[1])
    missing = np.isnan(data.y[:, part])
    nu[missing], S[missing] = np.nan, np.nan
    final = Belief.found(model.x, mean[:, -1].copy(), _tidy(piece.last))
    told = stats[1], stats[3], float(stats[2].sum()), final
    more: dict[str, Any] = {"some_cov": piece.some if some else None}
    return FilterResult(model.x, model.y, data.t[part], mean, var, nu, S, *told, **more)


def rooted(step: FilterStep, prior: Belief, data: Recording, backend: str | None) -> FilterResult:
    """Run a filter in square-root form from the beginning."""
    assert step.wide is not None
    return run(step.wide(), prior, data, full=True, backend=backend)


class _Passes:
    """A filter's blocks one after the other, in square-root form where a covariance loses digits.

    Args:
        step: the filter. prior, full, backend : as of :func:`run`.
        short: of the covariances only variances are asked for, and the last one.
    """

    def __init__(
        self, step: FilterStep, prior: Belief, full: bool, backend: str | None, *, short: bool
    ) -> None:
        self.step = self.now = step
        self.full, self.backend, self._short = full, backend, short
        self.P_last = np.zeros_like(prior.cov)
        self.m = prior.mean.copy()
        self.P = prior.cov.copy()
        # the buffers are this run's own: runs may be nested, or go on in several threads
        self.calls: dict[bool, Together] = {}
        self.done = 0
        root = prior.root
        if step.root or (step.wide is not None and (root is not None or narrow(prior.cov))):
            root = root_of(prior.cov) if root is None else root
            if step.root or narrow(root, root=True):
                self._root(root)

    @property
    def rooted(self) -> bool:
        """Whether roots are carried now."""
        return self.now.root

    @property
    def short(self) -> bool:
        """Whether blocks return variances instead of covariances: not those that give roots."""
        return self._short and not self.now.gives_roots and bool(self.now.model.y.names)

    @property
    def diagonal(self) -> Any:
        """Rows of the variances where blocks return covariances."""
        nx = self.m.size
        halves = not self.full and in_halves(self.now.shared)
        return packed_diagonal(nx) if halves else slice(None, None, nx + 1)

    def whole(self, columns: np.ndarray) -> np.ndarray:
        """Covariances of some samples, (n, nx, nx), of what blocks return."""
        nx = self.m.size
        if not self.full and in_halves(self.now.shared):
            return unpacked(columns, nx)
        made: np.ndarray = columns.T.reshape(-1, nx, nx)
        return made

    def _root(self, L: np.ndarray) -> None:
        self.P = L
        if not self.step.root:
            assert self.step.wide is not None
            self.now = self.step.wide()

    def _call(self, *args: np.ndarray) -> Course[tuple[np.ndarray, ...]]:
        if self.rooted not in self.calls:
            how = self.full, self.short, self.backend, backend_in_use()
            blocks = block_function(self.now.shared, *how)
            self.calls[self.rooted] = Together(*blocks)
        carried = (self.m, self.P, self.P_last) if self.short else (self.m, self.P)
        while True:
            try:
                out = self.calls[self.rooted](*carried, *args)
                break
            except Question as question:
                asked = question
            yield asked
        if self.short:
            self.P_last = out[2].reshape(self.P.shape).copy()
            out = (*out[:2], *out[3:])
        return out

    def block(
        self, u: np.ndarray, y: np.ndarray, R: np.ndarray, dt: np.ndarray, p: np.ndarray
    ) -> Course[tuple[np.ndarray, ...]]:
        """Return the outputs of one block, and go on to the next."""
        if self.rooted and not self.step.root and not narrow(self.P, root=True):
            # well enough known in all directions: on with the covariance
            self.P, self.now = self.P @ self.P.T, self.step
        out = yield from self._call(u, y, R, dt, p)
        nx = self.m.size
        self.done += 1
        ends = self.done % (4 * BLOCK // R.shape[1]) == 1
        if self.step.wide is not None and not self.rooted and lossy(out, R, nx, ends):
            self._root(root_of(self.P))
            out = yield from self._call(u, y, R, dt, p)
        self.m, self.P = out[0].ravel().copy(), out[1].reshape(nx, nx).copy()
        return out


def lossy(out: Sequence[np.ndarray], R: np.ndarray, nx: int, ends: bool) -> bool:
    """Whether a block of the covariance filter has lost digits; out as of :func:`_block`.

    A sample far better than the belief makes a narrow direction at once, and shows in S.  What
    makes one slowly shows at the ends of blocks.
    """
    # where nothing was measured S is 1 and R is -1
    if not (out[5].reshape(R.shape) <= WIDE * np.abs(R)).all():
        return True
    return ends and narrow(out[1].reshape(nx, nx))


@dataclass(frozen=True, eq=False)
class _Kept:
    """The matrices of a run with ``full``; see :class:`FilterResult`."""

    cov: np.ndarray
    mean_pred: np.ndarray
    cov_pred: np.ndarray
    cross: np.ndarray
    S: np.ndarray
    roots: tuple[np.ndarray, ...] | None

    @classmethod
    def of(cls, K: int, nx: int, ny: int, *, roots: bool) -> _Kept:
        cov, cov_pred, cross, S = (np.empty((K, n, n)) for n in (nx, nx, nx, ny))
        four = tuple(np.empty((K, nx, nx)) for _ in range(4)) if roots else None
        return cls(cov, np.empty((nx, K)), cov_pred, cross, S, four)

    def fields(self) -> dict[str, Any]:
        """The fields of a result that hold them."""
        return {
            "cov": self.cov,
            "mean_pred": self.mean_pred,
            "cov_pred": self.cov_pred,
            "cross": self.cross,
            "innovation_cov": self.S,
            "roots": self.roots,
        }

    def put(self, r: slice, columns: list[np.ndarray], *, root: bool) -> None:
        """Take P_f, m, P, C, S of some instants; matrices are columns in column-major order."""
        nx, ny = self.cov.shape[1], self.S.shape[1]
        P_f, m, P, C, S = columns[:5]
        n = m.shape[1]
        self.cov[r] = P_f.T.reshape(n, nx, nx)
        self.mean_pred[:, r] = m
        before = P.T.reshape(n, nx, nx).transpose(0, 2, 1)
        self.cov_pred[r] = before @ before.transpose(0, 2, 1) if root else before
        self.cross[r] = C.T.reshape(n, nx, nx).transpose(0, 2, 1)
        self.S[r] = S.T.reshape(n, ny, ny)
        if self.roots is not None:
            self.roots[0][r] = before
            for target, source in zip(self.roots[1:], columns[5:], strict=True):
                target[r] = source.T.reshape(n, nx, nx).transpose(0, 2, 1)


def _believable(
    model: FilterModel,
    data: Recording,
    stats: np.ndarray,
    mean: np.ndarray,
    var: np.ndarray,
    start: int,
) -> None:
    """Refuse a block in which a check failed or a number is lost."""
    if (stats[0] <= CHECK_TOL).all() and (var >= 0).all() and np.isfinite(mean).all():
        return
    failed = ~(stats[0] <= CHECK_TOL)
    # rounding may leave a tiny negative variance of what is known exactly
    size = np.where(np.isfinite(mean), mean, 0.0)
    floor = -1e-12 * (np.square(model.x.nominals) + np.square(size).max(1, initial=0.0))
    lost = ~np.isfinite(mean) | ~(var >= floor[:, None])
    bad = failed | lost.any(0)
    if not bad.any():
        return
    k = int(np.argmax(bad))
    at = f"{model.name} at t = {data.t[start + k]:.9g} s (sample {start + k})"
    if lost[:, k].any():
        i = int(np.argmax(lost[:, k]))
        raise EstimationError(
            f"{at}: the belief of {model.x.names[i]} is lost (mean {mean[i, k]:.6g}, variance "
            f"{var[i, k]:.3g}, model check {stats[0, k]:.1e}); the sample does not fit the model, "
            "or noise and prior are far too small"
        )
    raise EstimationError(
        f"{at}: the model's check is {stats[0, k]:.1e} > {CHECK_TOL:.0e}; the belief left the "
        "region where the model can be solved: check prior, inputs and outliers"
    )
