"""Models whose algebraic unknowns are left to the optimiser instead of a root finder.

A fit that carries the unknowns z of a :class:`~apu_casadi.core.statespace.StateSpace` as
variables, with 0 = alg(x, z, u, theta) as constraints, never solves them at a guess that is thrown
away, and its derivatives are those of the plain equations; at the solution both are the same
model.  So also a state at rest: x is a variable and 0 = dx/dt a constraint.

:func:`lift` makes such a model from a state space and from the *same* chain of
:mod:`estimators.models.filtermodel` functions that makes the filter's model, so that noise, gains
and biases enter both alike.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError, SignalError
from apu_casadi.core.sharing import Parametric, building, of_family, remade
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.statespace import StateSpace
from estimators.models.filtermodel import FilterModel, discretise

__all__ = ["Lifted", "lift", "plain"]

_STAGE = ["x", "s", "u", "p", "w", "dt", "k"], ["y", "x1", "c", "check"]


@dataclass(frozen=True, eq=False)
class Lifted(Parametric):
    """A model as optimisers take it: one sample is a *stage*.

    Args:
        model: the same model with everything eliminated; for names, recordings and filters.
        s: unknowns of a stage that are not eliminated.
        stage: Function (x, s, u, p, w, dt, k) -> (y, x1, c, check): outputs, next state,
            constraints 0 = c, and the residual of whatever is still solved for inside.
        frozen: Function (x, s, u, p, w, dt) -> k, coefficients that change by jumps only (those of
            the cell of a table), between which the model is one smooth expression.
        start: Function (x, u, p) -> s, a guess.
        steady: every sample is an equilibrium of its own (a constraint in ``c``); no sample follows
            from the one before.
    """

    model: FilterModel
    s: Signals
    stage: ca.Function = field(repr=False)
    frozen: ca.Function = field(repr=False)
    start: ca.Function = field(repr=False)
    steady: bool = False

    def __post_init__(self) -> None:
        nx, nu, np_, nw, ny = self.model.sizes
        got = [self.stage.size1_in(i) for i in range(self.stage.n_in())]
        want = [nx, len(self.s), nu, np_, nw, 1, self.frozen.size1_out(0)]
        out = [self.stage.size1_out(i) for i in range(self.stage.n_out())]
        if got != want or len(out) != 4 or out[:2] != [ny, nx] or out[3] != 1:
            raise SignalError(
                f"{self.model.name}: stage of sizes {want} -> [{ny}, {nx}, constraints, 1] "
                f"expected, got {got} -> {out}"
            )

    @property
    def family(self) -> Lifted | None:
        """The same of the model's family, of which programs are made; None if it has none."""
        return self.__dict__.get("_family")

    @property
    def shared(self) -> Lifted:
        """The family's, or this one if it has none."""
        return self if self.family is None else self.family

    def unit(self, like: FilterModel) -> Lifted:
        """Return the lifted form of a model of this one's family."""
        x, u, p, w, dt = like.symbols()
        s, k = ca.MX.sym("s", len(self.s)), ca.MX.sym("k", self.frozen.size1_out(0))
        full, at = like.full(p), [x, s, u]
        stage = self.stage.call([*at, full, w, dt, k])
        made = Lifted(
            like,
            self.s,
            ca.Function(self.stage.name(), [*at, p, w, dt, k], stage, *_STAGE),
            ca.Function(self.frozen.name(), [*at, p, w, dt], [self.frozen(*at, full, w, dt)]),
            ca.Function(self.start.name(), [x, u, p], [self.start(x, u, full)]),
            self.steady,
        )
        made.__dict__["_family"] = self
        return made

    @property
    def n_c(self) -> int:
        """Number of constraints of a stage."""
        return int(self.stage.size1_out(2))


@remade
@of_family
def plain(model: FilterModel) -> Lifted:
    """Return a filter's model as it is, nothing lifted."""
    model = model.expanded()
    x, u, p, w, dt = model.symbols()
    s, k = ca.MX.sym("s", 0), ca.MX.sym("k", 0)
    y, c1 = model.output(x, u, p, w)
    x1, c2 = model.transition(x, u, p, w, dt)
    stage = ca.Function(
        f"{model.name}_stage", [x, s, u, p, w, dt, k], [y, x1, ca.MX(0, 1), c1 + c2], *_STAGE
    )
    frozen = ca.Function("frozen", [x, s, u, p, w, dt], [ca.MX(0, 1)])
    start = ca.Function(f"{model.name}_start", [x, u, p], [ca.MX(0, 1)])
    return Lifted(model, Signals(), _scalar(stage), frozen, start)


@building
def lift(
    ss: StateSpace,
    build: Callable[[FilterModel], FilterModel] | None = None,
    *,
    equations: ca.Function | None = None,
    steady: bool = False,
    walk: Mapping[str, float] | None = None,
) -> Lifted:
    """Make a lifted model from a continuous one.

    Args:
        ss: the model.
        build: turns ``discretise(ss)`` into the model wanted, by
            :func:`~estimators.models.filtermodel.measure`,
            :func:`~estimators.models.filtermodel.noisy_inputs`,
            :func:`~estimators.models.sensorerrors.gains`,
            :func:`~estimators.models.sensorerrors.biases`,
            :func:`~estimators.models.filtermodel.augment`; applied to the eliminated and to the
            lifted form.  It must not depend on anything but its argument.
        equations: Function (x, z, u, theta) -> (ode, alg, y): ``ss.residual`` with the outputs.
            Not needed where ss has no z.
        steady: each sample is an equilibrium.  Otherwise the explicit midpoint rule leads from
            sample to sample, as :func:`~estimators.models.filtermodel.discretise` does by default;
            the state amid the step and its z are unknowns too.
        walk: standard deviations of process noise, unit of x per sqrt(s), by state name.

    Raises:
        ParameterError: equations missing, or of other sizes; process noise or parameters as states
            in a steady model.
    """
    build = build or (lambda m: m)
    smooth, cells = _split(_equations(ss, equations))
    model = build(discretise(ss, walk=walk))
    if steady and (model.x.names != ss.x.names or model.walk.any()):
        raise ParameterError(
            f"{ss.name}: a steady model has no process noise and no parameters as states; samples "
            "do not follow from each other"
        )
    form = _Form(ss, build, smooth, cells, steady, walk or {})
    big = form.changed([*form.s, *form.k], form.held, form.constraints, form.output)
    jumps = form.changed(form.s, form.k, form.coefficients, form.nothing)
    x, u, p, w, dt = model.symbols()
    given = [x, ca.MX.sym("s", len(form.s)), u, p, w, dt]
    at_k = ca.MX.sym("k", len(form.k))
    known = {q.name: given[1][i] for i, q in enumerate(form.s)}
    known |= {q.name: at_k[i] for i, q in enumerate(form.k)}
    y, x1, c = _sorted(model, big, form.held, given, known)
    stage = ca.Function(f"{ss.name}_stage", [*given, at_k], [y, x1, c, ca.MX(0)], *_STAGE)
    _, _, now = _sorted(model, jumps, form.k, given, known)
    frozen = ca.Function(f"{ss.name}_frozen", given, [now])
    start = _start(ss, model, steady)
    return Lifted(model, Signals(form.s), _scalar(stage), frozen, start, steady)


class _Form:
    """The lifted form of a model's equations: unknowns ``s``, constraints ``held``, cells ``k``.

    Unknowns are those at the sample (a) and, unless ``steady``, amid the step (m).
    """

    def __init__(
        self,
        ss: StateSpace,
        build: Callable[[FilterModel], FilterModel],
        smooth: ca.Function,
        cells: ca.Function,
        steady: bool,
        walk: Mapping[str, float],
    ) -> None:
        self.ss, self.build, self.smooth, self.cells = ss, build, smooth, cells
        self.steady, self.walk = steady, walk
        s = [Signal(f"{q.name}_a", q.unit, q.doc, None, q.nominal) for q in ss.z]
        held = [Signal(f"alg_{q.name}_a", "1", f"equation of {q.name}") for q in ss.z]
        if steady:
            held += [Signal(f"rate_{q.name}", q.unit, f"rate of {q.name}") for q in ss.x]
        else:
            amid = (*ss.x, *ss.z)
            s += [Signal(f"{q.name}_m", q.unit, q.doc, None, q.nominal) for q in amid]
            held += [Signal(f"alg_{q.name}_m", "1", f"equation of {q.name}") for q in amid]
        self.n_k = cells.size1_out(0)
        n = self.n_k if steady else 2 * self.n_k
        self.s, self.held = s, held
        self.k = [Signal(f"k{i}", "1", "coefficient") for i in range(n)]

    def changed(
        self,
        parameters: Sequence[Signal],
        kept: Sequence[Signal],
        rows: Callable[[Any, Any, Any, Any], tuple[Any, list[Any]]],
        output: Callable[[Any, Any, Any], Any],
    ) -> FilterModel:
        """``build`` applied to a model with more parameters and more 'next states'.

        Constraints travel as the next values of states that nothing reads, unknowns and
        coefficients as parameters: so ``build`` does to them what it does to the model.
        """
        ss = self.ss
        x, u = ca.MX.sym("x", len(ss.x) + len(kept)), ca.MX.sym("u", len(ss.u))
        p, w = ca.MX.sym("p", len(ss.theta) + len(parameters)), ca.MX.sym("w", 0)
        dt = ca.MX.sym("dt")
        x1, more = rows(x, u, p, dt)
        signals = ss.x + Signals(kept), ss.u, ss.theta + Signals(parameters), Signals(), ss.y
        step, seen = (ca.vertcat(x1, *more), ca.MX(0)), (output(x, u, p), ca.MX(0))
        model = FilterModel.of(ss.name, signals, (x, u, p, w, dt), step, seen)
        return self.build(model.with_walk(self.walk))

    def _point(self, x: Any, p: Any) -> tuple[Any, ...]:
        """State and unknowns at the sample, and amid the step."""
        nx, nz, nt = (len(v) for v in (self.ss.x, self.ss.z, self.ss.theta))
        q = p[nt : nt + len(self.s)]
        return x[:nx], q[:nz], *((None, None) if self.steady else (q[nz : nz + nx], q[nz + nx :]))

    def _equations(self, x: Any, u: Any, p: Any) -> tuple[Any, Any, Any]:
        at, z, _, _ = self._point(x, p)
        nt, n = len(self.ss.theta), len(self.ss.theta) + len(self.s)
        out: tuple[Any, Any, Any] = self.smooth(at, z, u, p[:nt], p[n : n + self.n_k])
        return out

    def output(self, x: Any, u: Any, p: Any) -> Any:
        """Outputs at the sample."""
        return self._equations(x, u, p)[2]

    def nothing(self, x: Any, u: Any, p: Any) -> Any:
        """No outputs."""
        return ca.MX.zeros(len(self.ss.y))

    def constraints(self, x: Any, u: Any, p: Any, dt: Any) -> tuple[Any, list[Any]]:
        """Next state, and what must be zero."""
        ss, nt = self.ss, len(self.ss.theta)
        at, _, x_m, z_m = self._point(x, p)
        ode, alg, _ = self._equations(x, u, p)
        if self.steady:
            return at, [alg, ode / ss.x.nominals]
        k_m = p[nt + len(self.s) + self.n_k :]
        rate, alg_m, _ = self.smooth(x_m, z_m, u, p[:nt], k_m)
        return at + dt * rate, [alg, (x_m - at - dt / 2 * ode) / ss.x.nominals, alg_m]

    def coefficients(self, x: Any, u: Any, p: Any, _: Any) -> tuple[Any, list[Any]]:
        """State, and the cells of the tables."""
        theta = p[: len(self.ss.theta)]
        at, z, x_m, z_m = self._point(x, p)
        here = [self.cells(at, z, u, theta)]
        return at, here if self.steady else [*here, self.cells(x_m, z_m, u, theta)]


def _scalar(fun: ca.Function) -> ca.Function:
    """The function in scalar operations where it has only such."""
    try:
        return fun.expand()
    except RuntimeError:
        return fun


def _equations(ss: StateSpace, equations: ca.Function | None) -> ca.Function:
    nx, nz, nu, nt = len(ss.x), len(ss.z), len(ss.u), len(ss.theta)
    if equations is None:
        if nz:
            raise ParameterError(
                f"{ss.name} has the algebraic unknowns {', '.join(ss.z.names)}: give equations, "
                "the Function (x, z, u, theta) -> (ode, alg, y)"
            )
        x, z, u, theta = (ca.MX.sym(n, m) for n, m in zip("xzut", (nx, 0, nu, nt), strict=True))
        return ca.Function(
            "equations", [x, z, u, theta], [ss.f(x, u, theta), ca.MX(0, 1), ss.g(x, u, theta)]
        )
    got = [equations.size1_in(i) for i in range(equations.n_in())]
    out = [equations.size1_out(i) for i in range(equations.n_out())]
    want = [nx, nz, nu, nt], [nx, nz, len(ss.y)]
    if (got, out) != want:
        raise ParameterError(
            f"{ss.name}: equations of sizes {want[0]} -> {want[1]} expected, got {got} -> {out}"
        )
    return equations


def _split(equations: ca.Function) -> tuple[ca.Function, ca.Function]:
    """Split equations into (x, z, u, theta, k) -> (ode, alg, y) and (x, z, u, theta) -> k.

    k are the arguments of the inner function by which it is declared not to be differentiated.
    Equations that are not one such call have no k; they stay whole.  In scalar operations second
    derivatives cost a tenth.
    """
    args = [ca.MX.sym(equations.name_in(i), equations.size1_in(i)) for i in range(4)]
    sizes = [a.shape[0] for a in args]
    whole = (
        ca.Function("smooth", [*args, ca.MX.sym("k", 0)], equations.call(args)),
        ca.Function("cells", args, [ca.MX(0, 1)]),
    )
    if equations.is_a("SXFunction"):
        return whole
    out = equations.call(args, True, False)
    calls = [o.dep(0) if o.is_output() else o for o in out]
    call = calls[0]
    if not all(c.is_call() and c.__hash__() == call.__hash__() for c in calls):
        return whole
    inner = call.which_function()
    n = inner.n_in()
    smooth = [inner.is_diff_in(i) for i in range(n)]
    if (
        smooth != [True] * 4 + [False] * (n - 4)
        or not inner.is_a("SXFunction")
        or not all(ca.is_equal(call.dep(i), args[i]) for i in range(3))
        or not _only(call.dep(3), args[3])
        or not all(o.which_output() == i for i, o in enumerate(out) if o.is_output())
    ):
        return whole
    # numbers of the unit, and theta's parts, are no part of k
    deps = [call.dep(i) for i in range(3, n)]
    held = [_only(d, args[3]) for d in deps]
    found = [d for d, h in zip(deps, held, strict=True) if not h]
    k = ca.SX.sym("k", sum(d.size1() for d in found))
    given = [ca.SX.sym("q", m) for m in sizes]
    pieces = iter(ca.vertsplit(k, [0, *np.cumsum([d.size1() for d in found]).tolist()]))
    of_theta = ca.Function("theta", args[3:], [d for d, h in zip(deps, held, strict=True) if h])
    known = of_theta.expand().call(given[3:], True, False)
    parts = iter(known)
    rest = [next(parts) if h else next(pieces) for h in held]
    return (
        ca.Function("smooth", [*given, k], inner.call([*given[:3], *rest], True, False)),
        ca.Function("cells", args, [ca.vertcat(*found)]),
    )


def _only(expression: ca.MX, symbol: ca.MX) -> bool:
    """Whether an expression has no other symbol, be it differentiated by it or not."""
    return all(ca.is_equal(v, symbol) for v in ca.symvar(expression))


def _sorted(
    model: FilterModel,
    big: FilterModel,
    held: Sequence[Signal],
    given: Sequence[Any],
    known: Mapping[str, Any],
) -> tuple[Any, Any, Any]:
    """Outputs, next state and held rows of a changed model, called with a stage's arguments."""
    x, _, u, p, w, dt = given
    X = ca.vertcat(*(x[model.x.index(n)] if n in model.x.names else 0 for n in big.x.names))
    P = ca.vertcat(
        ca.MX(0, 1), *(known[n] if n in known else p[model.p.index(n)] for n in big.p.names)
    )
    X1, _ = big.transition(X, u, P, w, dt)
    rows = big.x.indices([q.name for q in held])
    picked = X1[rows] if rows else ca.MX(0, 1)
    return big.output(X, u, P, w)[0], X1[big.x.indices(model.x.names)], picked


def _start(ss: StateSpace, model: FilterModel, steady: bool) -> ca.Function:
    x, u, p, _, _ = model.symbols()
    own = model.x.names
    theta = [x[model.x.index(n)] if n in own else p[model.p.index(n)] for n in ss.theta.names]
    at = x[: len(ss.x)]
    z = ss.z_of(at, u[model.u.indices(ss.u.names)], ca.vertcat(ca.MX(0, 1), *theta))
    return ca.Function(f"{ss.name}_start", [x, u, p], [z if steady else ca.vertcat(z, at, z)])
