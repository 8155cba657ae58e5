"""Many steps of a filter as one function, and recordings made ready for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import casadi as ca
import numpy as np

from apu_casadi.core.backend import READY, compiled, library
from apu_casadi.core.lanes.lanelibrary import lanes_in_use
from apu_casadi.core.lanes.pointlanes import points_in_lanes
from apu_casadi.core.reciprocals import by_reciprocals
from apu_casadi.core.sharing import kept, once
from estimators.filters.rowblock import Rows, row_block
from estimators.models.filtermodel import FilterModel
from estimators.models.recording import Recording

__all__ = ["BLOCK", "CHAIN", "NARROW", "PADDED", "ROOT_OUT", "ROWS", "WIDE"]
__all__ += ["block_function", "block_length", "block_of", "in_halves", "narrow", "packed_diagonal"]
__all__ += ["padded", "plain_block", "row_function", "unpacked"]

CHAIN = 10  # a block is this many chains of this many steps
BLOCK = CHAIN**2  # samples in one call
ROWS = 4 * BLOCK  # the same where a block's length costs nothing
STEP_IN = ["m", "P", "u", "p", "y", "R", "dt"]
STEP_OUT = ["m1", "P1", "m_f", "P_f", "C", "nu", "S", "stats"]
"""Of a step: belief before the sample, inputs, parameters, sample, variances (< 0: not measured),
step to the next sample; then the predicted belief at the next sample, the filtered belief, the
cross-covariance of filtered state and next state, innovation, its covariance, and ``STATS``."""
ROOT_OUT = ["Y", "Z", "Lf"]
"""What a step in square-root form may give beside: roots for the smoother, see
:mod:`estimators.filters.rootfilter`."""
WIDE = 1e7  # innovation over noise variance from which a covariance loses more than eight digits
NARROW = 1e-9  # share of a variance that is left when the other states are known; below: the same
PADDED = -2.0  # variance of what is not measured in a sample that fills a block up


class Step(Protocol):
    """What a block is made of; see :class:`estimators.filters.filtering.FilterStep`."""

    @property
    def model(self) -> FilterModel:
        """The model that is filtered."""

    @property
    def function(self) -> ca.Function:
        """The step as a function; its signature is the filter's."""

    @property
    def root(self) -> bool:
        """Whether the step carries roots of covariances."""

    @property
    def gives_roots(self) -> bool:
        """Whether the step hands roots of covariances on."""

    @property
    def rows(self) -> Callable[[], Rows | None] | None:
        """What takes the step apart for blocks whose lanes are rows."""


def block_length(model: FilterModel) -> int:
    """Return how many samples go in one call: fewer of a model that solves equations.

    A recording is filled up to a multiple of that, and such steps take long.
    """
    scalar = model.transition.is_a("SXFunction") and model.output.is_a("SXFunction")
    return BLOCK if scalar else CHAIN


def in_halves(step: Step) -> bool:
    """Whether blocks carry the lower half of a covariance: of scalar operations, without roots."""
    return step.function.is_a("SXFunction") and not step.root


def packed_diagonal(n: int) -> np.ndarray:
    """Return where the diagonal is in the lower half of a matrix, column by column."""
    return np.cumsum([0, *range(n, 1, -1)])


@once
def _upper(n: int) -> tuple[np.ndarray, np.ndarray]:
    i, j = np.triu_indices(n)
    return i, j


def unpacked(columns: np.ndarray, n: int) -> np.ndarray:
    """Return symmetric matrices, (K, n, n), of their lower halves, (n (n + 1)/2, K)."""
    i, j = _upper(n)
    out = np.empty((columns.shape[1], n, n))
    out[:, i, j] = out[:, j, i] = columns.T
    return out


def narrow(P: np.ndarray, *, root: bool = False) -> bool:
    """Whether some combination of states is known far better than each of them, or not a number."""
    if root:
        size = np.sqrt((P**2).sum(1))
        rows = size > 0
        return bool((np.abs(np.diag(P))[rows] < math.sqrt(NARROW) * size[rows]).any())
    d = P.diagonal()
    if not (d > 0).all():
        rows = np.flatnonzero(d > 0)
        P, d = P[np.ix_(rows, rows)], d[rows]
    s = 1 / np.sqrt(d)
    try:
        pivots = np.linalg.cholesky(P * s * s[:, None]).diagonal()
    except np.linalg.LinAlgError:
        return True
    return not bool((pivots**2 >= NARROW).all())


def narrow_ones(P: np.ndarray) -> np.ndarray:
    """Tell which of some covariances, (k, n, n), are narrow, as :func:`narrow` tells of one."""
    d = P.diagonal(axis1=1, axis2=2)
    there = d > 0
    s = np.where(there, 1 / np.sqrt(np.where(there, d, 1.0)), 0.0)
    Q = P * s[:, :, None] * s[:, None, :]
    k, i = np.nonzero(~there)
    Q[k, i, i] = 1.0  # what is known exactly does not count
    try:
        pivots = np.linalg.cholesky(Q).diagonal(axis1=1, axis2=2)
    except np.linalg.LinAlgError:
        return np.array([narrow(one) for one in P])
    return np.asarray(~(pivots**2 >= NARROW).all(1))


def _chained(f: ca.Function, n: int, name: str, carried: int, kept: int) -> ca.Function:
    """Call ``f`` n times, as one function.

    The first ``carried`` outputs go to the inputs of the same place in the next call; the last
    input is the same for all calls, the others stand side by side, as do the last ``kept`` outputs;
    of the others only the last are returned.

    The same as ``mapaccum``, which takes a hundred times as long to build in CasADi 3.8.
    """
    ins = [ca.MX.sym(f.name_in(i), f.size1_in(i), f.size2_in(i)) for i in range(f.n_in())]
    # a symbol without elements has no name to ask for
    wide = [
        ca.MX.sym(f.name_in(carried + i), s.shape[0], s.shape[1] * n)
        for i, s in enumerate(ins[carried:-1])
    ]
    split = [ca.horzsplit(w, s.shape[1]) for w, s in zip(wide, ins[carried:-1], strict=True)]
    now, results = ins[:carried], []
    for k in range(n):
        out = f(*now, *(s[k] for s in split), ins[-1])
        now = out[:carried]
        results.append(out)
    first = f.n_out() - kept
    out = [
        *results[-1][:first],
        *(ca.horzcat(*(r[i] for r in results)) for i in range(first, f.n_out())),
    ]
    return ca.Function(name, [*ins[:carried], *wide, ins[-1]], out)


def block_of(one: ca.Function, name: str, carried: int, *, short: bool = False) -> ca.Function:
    """Return ``BLOCK`` calls of a step as one function.

    Args:
        one: step; its first ``carried`` outputs are those inputs of the next call, its last input
            is the same in all calls.
        name: of the result, which takes the other inputs and gives the other outputs side by side.
        carried: number of inputs that are handed on; of these outputs the last is returned.
        short: ``CHAIN`` calls only, for steps that take long.
    """
    kept = one.n_out() - carried
    chain = _chained(one, CHAIN, f"{name}_chain", carried, kept)
    return chain if short else _chained(chain, CHAIN, f"{name}_block", carried, kept)


@kept
def block_function(
    step: Step, full: bool, short: bool, backend: str | None, _in_use: str
) -> tuple[ca.Function, ca.Function]:
    """A block of steps, compiled and as they are; ``_in_use`` keeps the backends' forms apart.

    See :func:`plain_block`.
    """
    block = plain_block(step, full, short)
    make = compiled if in_halves(step) else points_in_lanes
    return make(block, backend=backend), block


@kept
def plain_block(step: Step, full: bool, short: bool) -> ca.Function:
    """A block of steps, which nothing has compiled.

    (m, P, u, y, R, dt, p) -> (m1, P1, m_f, P_f, nu, diag S, stats) and, if ``full``, also m and P
    before each sample and C, S; matrices as columns.  Without ``full``, P_f of :func:`in_halves` is
    its lower half.

    If ``short``, (m, P, P_f, u, y, R, dt, p) -> (m1, P1, P_f, m_f, diag P_f, nu, diag S, stats),
    where the first P_f is that of the last sample which is not padded: a tenth of the numbers.
    """
    nx, nu, np_, _, ny = step.model.sizes
    kind = ca.SX if step.function.is_a("SXFunction") else ca.MX
    half = in_halves(step)
    pattern = ca.Sparsity.lower(nx) if half else ca.Sparsity.dense(nx, nx)
    sizes = [(nx, 1), pattern, (nu, 1), (np_, 1), (ny, 1), (ny, 1), (1, 1)]
    s = [
        kind.sym(n, *((size,) if size is pattern else size))
        for n, size in zip(STEP_IN, sizes, strict=True)
    ]
    m, P, u, p, y, R, dt = s
    whole = ca.tril2symm(P) if half else P
    o = dict(zip(STEP_OUT + ROOT_OUT, step.function(m, whole, *s[2:]), strict=False))
    P_f = ca.diag(o["P_f"]) if short else ca.vec(o["P_f"])
    if half and not (full or short):
        P_f = ca.vertcat(*ca.project(ca.densify(o["P_f"]), pattern).nonzeros())
    kept = [o["m_f"], P_f, o["nu"], ca.diag(o["S"]), o["stats"]]
    if full:
        kept += [m, ca.vec(whole), ca.vec(o["C"]), ca.vec(o["S"])]
    if step.gives_roots:
        kept += [ca.vec(o[n]) for n in (ROOT_OUT if full else ROOT_OUT[-1:])]
    name = f"{step.function.name()}{'_full' if full else '_short' if short else ''}"
    carried, now = [m, P], [o["m1"], ca.project(o["P1"], pattern)]
    if short:
        carried.append(kind.sym("P_last", pattern))
        last = ca.if_else(R[0] == PADDED, carried[-1], ca.project(o["P_f"], pattern))
        now.append(ca.project(last, pattern))
    out = [*now, *(ca.densify(k) for k in kept)]
    if not half:
        one = ca.Function(f"{name}_one", [*carried, u, y, R, dt, p], out)
        return block_of(one, name, len(carried), short=block_length(step.model) < BLOCK)
    # what hangs on the parameters alone is evaluated once in a block
    out, symbols, constant = ca.extract_parametric(ca.cse(out), p)
    c, of_p = ca.vertcat(*symbols), ca.Function(f"{name}_constants", [p], [ca.vertcat(*constant)])
    one = ca.Function(f"{name}_one", [*carried, u, y, R, dt, ca.vertcat(p, c)], out)
    one = by_reciprocals(one)
    of_halves = block_of(one, f"{name}_half", len(carried), short=block_length(step.model) < BLOCK)
    return _whole(of_halves, of_p, name, len(carried), pattern)


@kept
def row_function(step: Step, backend: str | None, _in_use: str) -> ca.Function | None:
    """Return ``ROWS`` steps compiled with rows as lanes; None where there is no such form.

    See :func:`estimators.filters.rowblock.row_block`.
    """
    lanes, parts = lanes_in_use(), None if step.rows is None else step.rows()
    if lanes == 1 or parts is None:
        return None
    code = row_block(f"{step.function.name()}_rows", parts, ROWS, lanes, padded=PADDED)
    wanted = None if backend == READY else backend
    return library(code, backend=wanted, build=backend != READY)


def _whole(
    half: ca.Function, of_p: ca.Function, name: str, carried: int, pattern: ca.Sparsity
) -> ca.Function:
    """Take and give whole covariances, and p, for a block of their halves and of constants too."""
    ins = [ca.MX.sym(half.name_in(i), *half.size_in(i)) for i in range(half.n_in() - 1)]
    p = ca.MX.sym("p", of_p.size1_in(0))
    given = [ins[0], *(ca.project(P, pattern) for P in ins[1:carried]), *ins[carried:]]
    out = half.call([*given, ca.vertcat(p, of_p(p))])
    out[1:carried] = [ca.densify(ca.tril2symm(P)) for P in out[1:carried]]
    return ca.Function(name, [*ins, p], out)


def padded(data: Recording, pad: int) -> tuple[np.ndarray, ...]:
    """Return (y, R, u, dt) as a step takes them, ``pad`` samples longer, one column a sample.

    A padded sample measures nothing and lasts no time; what comes out of it is dropped.
    """
    missing = np.isnan(data.y)
    K, n = data.size, data.size + pad
    y, R = np.zeros((data.y.shape[0], n)), np.full((data.y.shape[0], n), PADDED)
    y[:, :K], R[:, :K] = np.where(missing, 0.0, data.y), np.where(missing, -1.0, data.variance)
    u, dt = np.empty((data.u.shape[0], n)), np.zeros((1, n))
    u[:, :K], u[:, K:], dt[0, :K] = data.u, data.u[:, -1:], data.dt
    return y, R, u, dt
