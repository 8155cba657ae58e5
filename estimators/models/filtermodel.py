"""What a filter needs to know of a model: f, g, names, and where noise enters.

A :class:`FilterModel` is a discrete-time model with named vectors.  At a sample the output is
taken, then the state goes on to the next sample:

    y(k)   = g(x(k), u(k), p, w(k)) + v(k)
    x(k+1) = f(x(k), u(k), p, w(k), dt(k)) + sqrt(dt(k)) * walk * xi(k)

with w(k), xi(k) white and of unit variance, and v(k) of the variances that come with the data.  The
*same* w(k) enters output and transition: the error of a measured input does so too, and a filter
that forgets it claims a wrong variance.  An output that
:func:`~estimators.models.angles.angular` declares is read modulo its period: y - g is then taken
the short way round, by every estimator alike.

:func:`discretise` makes a model from any :class:`~apu_casadi.core.statespace.StateSpace`; the other
functions return changed models: :func:`measure` (which outputs there are), :func:`noisy_inputs`,
:func:`augment` (parameters become states that are estimated, or *considered*: uncertain, but not
estimated).  What sensors add, errors as parameters and lags, is in
:mod:`estimators.models.sensorerrors`.

The numbers of a unit are known parameters as well, of the *family* that its model belongs to (as in
:mod:`apu_casadi.core.statespace`).  What is compiled is made of the family, once for all units; the
functions of this module change a family with its member, and :func:`augment` makes any of the
numbers a state.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.checked import number
from apu_casadi.core.discretisation import linearly_implicit_midpoint
from apu_casadi.core.errors import ParameterError, SignalError, nearest
from apu_casadi.core.sharing import Parametric, derived, of_family, remade
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.statespace import StateSpace, moves

__all__ = [
    "CHECK_TOL",
    "FilterModel",
    "Unknown",
    "augment",
    "discretise",
    "inlined",
    "measure",
    "measured_inputs",
    "noisy_inputs",
]

#: Largest residual of eliminated unknowns with which a result of f or g is used.
CHECK_TOL = 1e-9
_ERROR = "error of the measured {} over its standard deviation"
METHODS = ("midpoint", "rk4", "implicit midpoint")
_TRANSITION = ["x", "u", "p", "w", "dt"], ["x1", "check"]
_OUTPUT = ["x", "u", "p", "w"], ["y", "check"]


@dataclass(frozen=True)
class Unknown:
    """A parameter that becomes a state.

    Args:
        walk: standard deviation of its random walk, own unit per sqrt(s); 0 for a constant.
        lower, upper: bounds that a mean may not leave.
        consider: uncertain but not estimated: its mean and variance never change (Schmidt's
            filter), its correlation with the rest is carried.
    """

    walk: float = 0.0
    lower: float = -math.inf
    upper: float = math.inf
    consider: bool = False

    def __post_init__(self) -> None:
        for name in ("walk", "lower", "upper"):
            number(f"Unknown.{name}", getattr(self, name), error=ParameterError)
        if not (math.isfinite(self.walk) and self.walk >= 0):
            raise ParameterError(f"Unknown.walk must be finite and >= 0, got {self.walk!r}")
        if not self.lower < self.upper:
            raise ParameterError(
                f"Unknown: lower = {self.lower!r} must be below upper = {self.upper!r}"
            )
        if self.consider and self.walk:
            raise ParameterError("Unknown: a considered parameter is a constant, walk must be 0")


@dataclass(frozen=True, eq=False)
class FilterModel(Parametric):
    """A discrete-time model with named vectors; see the module's text.

    Args:
        name: short identifier, used for functions and messages.
        x, u, p, w, y: states, inputs of a sample, known parameters, noises, outputs.
        transition: Function (x, u, p, w, dt) -> (x1, check).
        output: Function (x, u, p, w) -> (y, check).  ``check`` is the residual of whatever was
            solved for inside; results with ``check > CHECK_TOL`` are refused.
        walk: random-walk standard deviations, unit of x per sqrt(s), shape (nx,).
        lower, upper: bounds of x, shape (nx,).
        consider: states whose mean and variance the measurements do not touch.
        angles: outputs that are read modulo a period, (name, period in its unit).

    Raises:
        SignalError: a function's or vector's shape does not match the declared signals; a walk, a
            pair of bounds or a considered state is impossible; an angle is no output.
    """

    name: str
    x: Signals
    u: Signals
    p: Signals
    w: Signals
    y: Signals
    transition: ca.Function = field(repr=False)
    output: ca.Function = field(repr=False)
    walk: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    consider: tuple[str, ...] = ()
    angles: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        nx, nu, np_, nw, ny = (len(s) for s in (self.x, self.u, self.p, self.w, self.y))
        for label, fun, n_in, n_out in (
            ("transition", self.transition, [nx, nu, np_, nw, 1], [nx, 1]),
            ("output", self.output, [nx, nu, np_, nw], [ny, 1]),
        ):
            got_in = [fun.size1_in(i) for i in range(fun.n_in())]
            got_out = [fun.size1_out(i) for i in range(fun.n_out())]
            if got_in != n_in or got_out != n_out:
                raise SignalError(
                    f"{self.name}.{label}: expected sizes {n_in} -> {n_out}, "
                    f"got {got_in} -> {got_out}"
                )
        for label in ("walk", "lower", "upper"):
            shape = np.shape(getattr(self, label))
            if shape != (nx,):
                raise SignalError(f"{self.name}.{label}: shape ({nx},) expected, got {shape}")
        fixed = self.x.indices(self.consider)
        for i, s in enumerate(self.x):
            if not (math.isfinite(self.walk[i]) and self.walk[i] >= 0):
                raise SignalError(
                    f"{self.name}: walk of {s.name} must be finite and >= 0, got {self.walk[i]!r}"
                )
            if not self.lower[i] < self.upper[i]:
                raise SignalError(
                    f"{self.name}: bounds of {s.name}: {self.lower[i]!r} must be below "
                    f"{self.upper[i]!r}"
                )
            if i in fixed and self.walk[i]:
                raise SignalError(f"{self.name}: {s.name} is considered, its walk must be 0")
        self.y.indices([n for n, _ in self.angles])

    @classmethod
    def of(
        cls,
        name: str,
        signals: Sequence[Signals],
        symbols: Sequence[Any],
        transition: Sequence[Any],
        output: Sequence[Any],
        like: FilterModel | None = None,
        more: Mapping[str, Unknown] | None = None,
        consider: tuple[str, ...] = (),
        cse: bool = False,
    ) -> FilterModel:
        """Make a model from expressions in its symbols.

        Args:
            name: of the model.
            signals: x, u, p, w, y.
            symbols: (x, u, p, w, dt).
            transition: next state and check.
            output: outputs and check.
            like: the model whose walk, bounds and considered states the first states have, and
                whose angles the outputs of the same name are; without, none of them.
            more: the same of the last states, by name.
            consider: further considered states.
            cse: look for common parts of the expressions.
        """
        more = more or {}
        n = len(signals[0]) - len(more)
        free = np.zeros(n), np.full(n, -np.inf), np.full(n, np.inf)
        first = free if like is None else (like.walk, like.lower, like.upper)
        last = zip(*((k.walk, k.lower, k.upper) for k in more.values()), strict=True)
        held = () if like is None else like.consider
        all_of = [np.append(a, b) for a, b in zip(first, last, strict=True)] if more else first
        how = [{"cse": True}] if cse else []
        f = ca.Function(f"{name}_f", [*symbols], [*transition], *_TRANSITION, *how)
        g = ca.Function(f"{name}_g", [*symbols[:4]], [*output], *_OUTPUT, *how)
        held = (*held, *consider, *(n for n, k in more.items() if k.consider))
        x, u, p, w, y = signals
        walk, lower, upper = all_of
        angles = () if like is None else _among(like.angles, y)
        return cls(name, x, u, p, w, y, f, g, walk, lower, upper, held, angles)

    @property
    def family(self) -> FilterModel | None:
        """The model whose known parameters are the unit's numbers, too; None if it has none.

        Not a field: ``dataclasses.replace`` makes a model with functions of its own.
        """
        return self.__dict__.get("_family")

    @property
    def shared(self) -> FilterModel:
        """The family, or the model itself if it has none: what to make functions of."""
        return self if self.family is None else self.family

    @property
    def held(self) -> dict[str, float]:
        """Its numbers by name."""
        return dict(self.__dict__.get("_held", {}))

    @derived
    def _order(self) -> list[int]:
        """Places of the family's p among this one's and the numbers."""
        names = [*self.p.names, *self.held]
        return [names.index(n) for n in self.shared.p.names]

    def full(self, p: Any) -> Any:
        """Return p of :attr:`shared`: this model's, shape (np,) or symbols, and its numbers."""
        if isinstance(p, ca.SX | ca.MX):
            return ca.vertcat(p, ca.DM([*self.held.values()]))[self._order]
        return np.append(p, [*self.held.values()])[self._order]

    def unit(self, like: StateSpace | FilterModel) -> FilterModel:
        """Return the member of this family that has the numbers of ``like``."""
        return self.member(like.held)

    def member(self, numbers: Mapping[str, float]) -> FilterModel:
        """Return the model of one unit: this one's with its numbers, as far as p has them, held."""
        numbers = {n: v for n, v in numbers.items() if n in self.p}
        scalar = self.transition.is_a("SXFunction") and self.output.is_a("SXFunction")
        x, u, _, w, dt = self.symbols(ca.SX if scalar else ca.MX)
        own = Signals([s for s in self.p if s.name not in numbers])
        p = type(x).sym("p", len(own))
        names = [*own.names, *numbers]
        full = ca.vertcat(p, ca.DM([*numbers.values()]))[[names.index(n) for n in self.p.names]]
        signals = self.x, self.u, own, self.w, self.y
        step, seen = self.transition(x, u, full, w, dt), self.output(x, u, full, w)
        made = FilterModel.of(self.name, signals, (x, u, p, w, dt), step, seen, like=self)
        made.__dict__.update(_family=self, _held=numbers)
        return made

    @property
    def sizes(self) -> tuple[int, int, int, int, int]:
        """(nx, nu, np, nw, ny)."""
        return len(self.x), len(self.u), len(self.p), len(self.w), len(self.y)

    def innovation(self, y: Any, expected: Any) -> Any:
        """Return y - expected, (ny,) or (ny, K), of an angle the short way round; also of symbols.

        The period is taken off as often as the difference holds it, rounded: a difference of less
        than half a period stays as it is, to the last bit.
        """
        e = y - expected
        floor = np.floor if isinstance(e, np.ndarray) else ca.floor
        for name, period in self.angles:
            row: Any = self.y.index(name)
            row = row if getattr(e, "ndim", 2) == 1 else (row, slice(None))
            e[row] = e[row] - period * floor(e[row] / period + 0.5)
        return e

    def symbols(self, kind: Any = ca.MX) -> tuple[Any, Any, Any, Any, Any]:
        """Fresh symbols (x, u, p, w, dt) of CasADi type ``kind``."""
        nx, nu, np_, nw, _ = self.sizes
        names = zip("xupw", (nx, nu, np_, nw), strict=True)
        return (*(kind.sym(n, m) for n, m in names), kind.sym("dt"))

    @remade
    @of_family
    def with_walk(self, walks: Mapping[str, float]) -> FilterModel:
        """Return the model with other random-walk standard deviations, by state name.

        Raises:
            SignalError: unknown name, a walk that is negative or not finite, a considered state.
        """
        new = np.array(self.walk, dtype=float)
        for name, value in walks.items():
            new[self.x.index(name)] = value
        return dataclasses.replace(self, walk=new)

    @remade
    @of_family
    def considering(self, names: Sequence[str]) -> FilterModel:
        """Return the model that considers these states, and estimates all others.

        Raises:
            SignalError: unknown name, a state that walks.
        """
        return dataclasses.replace(self, consider=tuple(names))

    @remade
    @of_family
    def expanded(self) -> FilterModel:
        """Return the same model in scalar operations, faster, where that is possible.

        Functions that hold a root finder or a table cannot be expanded and stay as they are.
        """

        def scalar(fun: ca.Function) -> ca.Function:
            try:
                made = fun.expand()
            except RuntimeError:
                return fun
            # CasADi may wrap what it cannot write out in calls; those are better left to MX
            calls = any(made.instruction_id(k) == ca.OP_CALL for k in range(made.n_instructions()))
            return fun if calls else made

        return dataclasses.replace(
            self, transition=scalar(self.transition), output=scalar(self.output)
        )


def _among(angles: tuple[tuple[str, float], ...], y: Signals) -> tuple[tuple[str, float], ...]:
    return tuple((n, period) for n, period in angles if n in y)


def inlined(fun: ca.Function, *args: Any) -> list[Any]:
    """Return a function's results in the symbols ``args`` as its own expressions, not as a call.

    What is derived of them then shares what they have solved: the derivative of a call would solve
    once more.
    """
    results: list[Any] = fun.call([*args], fun.is_a("MXFunction"), False)
    return results


@remade
@of_family
def discretise(
    ss: StateSpace, *, method: str = "midpoint", walk: Mapping[str, float] | None = None
) -> FilterModel:
    """Make a filter's model from a continuous one, inputs held over each step.

    Args:
        ss: the model; its parameters theta become ``p``, its outputs stay as they are.
        method: ``"midpoint"`` (explicit, second order), ``"rk4"``, or ``"implicit midpoint"``
            (linearly implicit, second order, A-stable; its Jacobian holds second derivatives of
            ss).
        walk: standard deviations of process noise, unit of x per sqrt(s), by state name.

    Raises:
        ParameterError: unknown method.
        SignalError: unknown state in ``walk``.
    """
    if method not in METHODS:
        raise ParameterError(f"method {method!r} {nearest(method, METHODS)}")
    nx, nu, nt = len(ss.x), len(ss.u), len(ss.theta)
    x, u, p = ca.MX.sym("x", nx), ca.MX.sym("u", nu), ca.MX.sym("p", nt)
    w, dt = ca.MX.sym("w", 0), ca.MX.sym("dt")

    def rate(at: Any) -> tuple[Any, Any]:
        # one elimination of z serves the rate and its check
        xdot, alg = ss.residual(at, ss.z_of(at, u, p), u, p)
        return xdot, ca.norm_1(alg) if len(ss.z) else ca.MX(0)

    k1, check = rate(x)
    if method == "midpoint":
        k2, c2 = rate(x + dt / 2 * k1)
        x1, check = x + dt * k2, check + c2
    elif method == "rk4":
        k2, c2 = rate(x + dt / 2 * k1)
        k3, c3 = rate(x + dt / 2 * k2)
        k4, c4 = rate(x + dt * k3)
        x1, check = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), check + c2 + c3 + c4
    else:
        x1 = linearly_implicit_midpoint(x, k1, ca.jacobian(k1, x), dt)
    alg = ss.residual(x, ss.z_of(x, u, p), u, p)[1]
    at_output = ca.norm_1(alg) if len(ss.z) else ca.MX(0)
    signals = ss.x, ss.u, ss.theta, Signals(), ss.y
    output = ss.g(x, u, p), at_output
    return FilterModel.of(ss.name, signals, (x, u, p, w, dt), (x1, check), output).with_walk(
        walk or {}
    )


@remade
@of_family
def measure(model: FilterModel, names: Sequence[str]) -> FilterModel:
    """Return the model with only these outputs, in this order.

    Raises:
        SignalError: unknown name, or none at all.
    """
    rows = model.y.indices(names)
    if not rows:
        raise SignalError(f"{model.name}: at least one output is needed")
    s = model.symbols()
    y, check = model.output(*s[:4])
    output = ca.Function(f"{model.name}_g", [*s[:4]], [y[rows], check], *_OUTPUT)
    kept = Signals([model.y[i] for i in rows])
    return dataclasses.replace(model, y=kept, output=output, angles=_among(model.angles, kept))


@remade
@of_family
def noisy_inputs(model: FilterModel, sigma: Mapping[str, float]) -> FilterModel:
    """Return the model for inputs that are measured with white noise.

    The true input is u - sigma w; w is appended to the model's noises as ``w_<name>`` and acts on
    output and transition of the same sample.

    Args:
        sigma: standard deviations by input name, unit of the input.

    Raises:
        SignalError: unknown input. ParameterError : sigma not finite or negative.
    """
    cols = model.u.indices(list(sigma))
    for name, value in sigma.items():
        if (
            not 0
            <= number(f"noisy_inputs: sigma of {name}", value, error=ParameterError)
            < math.inf
        ):
            raise ParameterError(
                f"noisy_inputs: sigma of {name} must be finite and >= 0, got {value!r}"
            )
        if f"w_{name}" in model.w.names:
            raise SignalError(f"{model.name}: input {name} is noisy already")
    x, u, p, _, dt = model.symbols()
    n = len(model.w)
    w = ca.MX.sym("w", n + len(cols))
    spread = ca.DM(len(model.u), len(cols))
    for j, (i, s) in enumerate(zip(cols, sigma.values(), strict=True)):
        spread[i, j] = s
    true = u - ca.mtimes(spread, w[n:])
    noises = model.w + Signals([Signal(f"w_{n}", "1", _ERROR.format(n)) for n in sigma])
    return FilterModel.of(
        model.name,
        (model.x, model.u, model.p, noises, model.y),
        (x, u, p, w, dt),
        model.transition(x, true, p, w[:n], dt),
        model.output(x, true, p, w[:n]),
        like=model,
    )


@remade
@of_family
def augment(model: FilterModel, unknowns: Mapping[str, Unknown]) -> FilterModel:
    """Return the model in which these parameters are states, appended in the given order.

    Numbers of the unit (``machine.r_s``) may be among them.

    Raises:
        SignalError: unknown parameter.
        ParameterError: a number of the unit on which nothing depends, or whose derivatives are left
            out.
    """
    moved = model.p.indices(list(unknowns))
    for i, name in zip(moved, unknowns, strict=True):
        if "." in name and not any(moves(f, 2, i) for f in (model.transition, model.output)):
            raise ParameterError(
                f"{model.name}: no derivatives by {name}: nothing depends on it, or it is held; "
                "parameters of a gas generator are unknowns of a filter made with them free"
            )
    kept = [i for i in range(len(model.p)) if i not in moved]
    nx, n = len(model.x), len(moved)
    _, u, _, w, dt = model.symbols()
    x, p = ca.MX.sym("x", nx + n), ca.MX.sym("p", len(kept))
    place = {i: x[nx + j] for j, i in enumerate(moved)} | {i: p[j] for j, i in enumerate(kept)}
    all_p = ca.vertcat(*(place[i] for i in range(len(model.p)))) if place else ca.MX(0, 1)
    x1, check = model.transition(x[:nx], u, all_p, w, dt)
    x_of, p_of = ([model.p[i] for i in rows] for rows in (moved, kept))
    return FilterModel.of(
        model.name,
        (model.x + Signals(x_of), model.u, Signals(p_of), model.w, model.y),
        (x, u, p, w, dt),
        (ca.vertcat(x1, x[nx:]), check),
        model.output(x[:nx], u, all_p, w),
        like=model,
        more=unknowns,
    )


@remade
@of_family
def measured_inputs(model: FilterModel, names: Sequence[str]) -> FilterModel:
    """Return the model for inputs whose white noise comes with the data.

    As :func:`noisy_inputs`, but the standard deviations are inputs themselves, appended as
    ``sigma_<name>``: they may change from sample to sample.

    Raises:
        SignalError: unknown input, or one that is noisy already.
    """
    cols = model.u.indices(names)
    for name in names:
        if f"w_{name}" in model.w.names:
            raise SignalError(f"{model.name}: input {name} is noisy already")
    nu, nw = len(model.u), len(model.w)
    x, _, p, _, dt = model.symbols()
    u, w = ca.MX.sym("u", nu + len(cols)), ca.MX.sym("w", nw + len(cols))
    spread = ca.DM(nu, len(cols))
    for j, i in enumerate(cols):
        spread[i, j] = 1
    true = u[:nu] - ca.mtimes(spread, u[nu:] * w[nw:])
    sigmas = [
        Signal(f"sigma_{n}", s.unit, f"standard deviation of the measured {n}", None, s.nominal)
        for n, s in ((n, model.u[n]) for n in names)
    ]
    noises = [Signal(f"w_{n}", "1", _ERROR.format(n)) for n in names]
    return FilterModel.of(
        model.name,
        (model.x, model.u + Signals(sigmas), model.p, model.w + Signals(noises), model.y),
        (x, u, p, w, dt),
        model.transition(x, true, p, w[:nw], dt),
        model.output(x, true, p, w[:nw]),
        like=model,
    )
