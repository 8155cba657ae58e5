"""Integrate any :class:`~apu_casadi.core.statespace.StateSpace` with CVODES or IDAS.

CVODES takes the explicit right-hand side ``f``, IDAS the semi-explicit DAE ``residual``: one set
of expressions, two routes.  Time runs over [0, 1] inside the integrator and the step's length is
a parameter, so that one integrator serves every step length; states are divided by their nominal
values, so that one absolute tolerance means the same for all.  Inputs and parameters are constant
over a step, and a step ends at every switching instant: nothing is stepped over.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.calling import Buffers
from apu_casadi.core.checked import array
from apu_casadi.core.errors import SignalError, SimulationError, nearest
from apu_casadi.core.interrupts import watched
from apu_casadi.core.means import Term
from apu_casadi.core.runloop import run
from apu_casadi.core.sharing import PerThread, Rebuilt, building, keep, twin
from apu_casadi.core.statespace import StateSpace

SOLVERS = ("cvodes", "idas")
RTOL = 1e-8
ATOL = 1e-10

#: How far the exact algebraic start is moved off, nominal units, before IDAS makes it consistent.
#: From a residual of zero its line search can but fail; which start it dislikes is chance, so that
#: there are several.
_MOVES = (1e-6, -1e-5, 1e-4, 0.0)

_CAUSES = {
    "TOO_MUCH_WORK": "the step limit was reached: a solution that grows without bound, or a very "
    "stiff or rapidly switching model; look at the last finite values or loosen rtol",
    "ERR_FAILURE": "the error test failed at the smallest step: a discontinuity inside the step "
    "(put it on the grid), or tolerances below rounding",
    "CONV_FAIL": "the implicit equations did not converge: a discontinuity, or a singular model",
    "RHSFUNC": "the right-hand side is not finite: a state has left the model's domain",
    "RES_FAIL": "the residual is not finite: a state has left the model's domain",
    "REP_RES_ERR": "the residual is not finite: a state has left the model's domain",
    "LINESEARCH": "no consistent start was found for the algebraic unknowns",
    "NO_RECOVERY": "no consistent start was found for the algebraic unknowns",
    "BAD_EWT": "a state is not finite",
}


@dataclass(frozen=True)
class StepResult:
    """What one step gave.

    Args:
        t: output instants, s, shape (n,); the step's start is not among them.
        x: states at the output instants, shape (nx, n).
        y: outputs at the output instants, shape (ny, n).
        mean: mean over the step of each quantity asked for, by name; its integral is ``mean[name] *
            dt``.
        stats: solver statistics (``nsteps`` and so on).
    """

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    mean: dict[str, float]
    stats: dict[str, Any]

    @property
    def x_end(self) -> np.ndarray:
        """State at the end of the step, shape (nx,)."""
        return self.x[:, -1]


class Stepper(Rebuilt):
    """Integrates one model over steps of any length with outputs at fixed fractions of the step.

    Make it with :func:`stepper`, which keeps the ones already built.  Threads may share it: each
    has solver memory of its own.

    Args:
        ss: the model.
        grid: increasing output instants as fractions of the step, the last one 1, shape (n,).
        quad: outputs whose mean over the step is wanted; ``"v_a^2"`` means the square of ``v_a``,
            :mod:`apu_casadi.core.means` describes the rest.  They are integrated with the states
            and kept under error control.
        solver: ``"cvodes"`` (explicit ODE) or ``"idas"`` (DAE).
        rtol, atol: tolerances; the absolute one is in units of the signals' nominal values.
        max_steps: solver steps allowed between two outputs.
    """

    grid: np.ndarray
    quad: tuple[str, ...]
    rtol: float
    atol: float

    @building
    def __init__(
        self,
        ss: StateSpace,
        grid: np.ndarray,
        *,
        quad: Sequence[str] = (),
        solver: str = "cvodes",
        rtol: float = RTOL,
        atol: float = ATOL,
        max_steps: int = 1_000_000,
    ) -> None:
        """Build the integrator; see the class for the arguments."""
        if solver not in SOLVERS:
            raise SimulationError(f"unknown solver {solver!r} {nearest(solver, SOLVERS)}")
        self.ss = ss
        self.grid = np.asarray(grid, dtype=float)
        if (
            self.grid.ndim != 1
            or self.grid.size == 0
            or self.grid[0] <= 0
            or np.any(np.diff(self.grid) <= 0)
            or self.grid[-1] != 1.0
        ):
            raise SimulationError(
                f"output grid must increase within (0, 1] and end at 1, got {self.grid}"
            )
        self.quad = tuple(quad)
        self.solver, self.rtol, self.atol, self._max_steps = solver, rtol, atol, max_steps
        # units that differ in numbers alone share what takes time to build
        key = (self.grid.tobytes(), self.quad, solver, rtol, atol, max_steps)
        self._F, self._g = keep(ss.shared, Stepper._functions, key, self._functions)

    def _functions(self) -> tuple[_Buffered, _Buffered]:
        ss, n = self.ss.shared, self.grid.size
        sym = _symbols(ss)
        args = [sym.sym(label, len(s)) for label, s in (("x", ss.x), ("u", ss.u), ("t", ss.theta))]
        g = ca.Function(f"{ss.name}_dense_g", args, [ca.densify(ss.g(*args))])
        return self._integrator(ss), _Buffered(g.map(f"{ss.name}_g{n}", "serial", n, [1, 2], []))

    def _integrator(self, ss: StateSpace) -> _Buffered:
        sym = _symbols(ss)
        nx, nz, nu, nt = (len(s) for s in (ss.x, ss.z, ss.u, ss.theta))
        p, time = sym.sym("p", nu + nt + 1), sym.sym("time")
        u, theta, dt = p[:nu], p[nu : nu + nt], p[nu + nt]
        xs = sym.sym("xs", nx)
        x = xs * ss.x.nominals
        dae = {"x": xs, "p": p}
        options: dict[str, Any] = {
            "abstol": self.atol,
            "reltol": self.rtol,
            "max_num_steps": self._max_steps,
            "quad_err_con": bool(self.quad),
            "disable_internal_warnings": True,
            "show_eval_warnings": False,
        }
        if self.solver == "cvodes":
            dae["ode"] = dt * ss.f(x, u, theta) / ss.x.nominals
        else:
            zs = sym.sym("zs", nz)
            ode, alg = ss.residual(x, zs * ss.z.nominals, u, theta)
            dae |= {"z": zs, "ode": dt * ode / ss.x.nominals, "alg": alg / ss.z.nominals}
            # With the algebraic unknowns in the error test IDAS stalls where they are rounding
            # times a large resistance (a fault with an open generator).  Outside it they are as
            # good as the states: see OpenLoad.
            options |= {"suppress_algebraic": True, "calc_ic": True, "first_time": 1e-3}
        if self.quad:
            y, asked = ss.g(x, u, theta), [Term.of(name) for name in self.quad]
            terms = [q.expression(ss, x, y, time) / q.nominal(ss) for q in asked]
            # harmonics are those of one angle, which each term would take anew
            dae |= {"t": time, "quad": ca.cse(ca.vertcat(*terms))}
        name = f"{ss.name}_{self.solver}"
        F = ca.integrator(name, self.solver, dae, 0.0, list(self.grid), options)
        return _Buffered(F, ("x0", "p", "z0"), ("xf", "qf"))

    def _solve(
        self,
        x0: np.ndarray,
        u: Any,
        theta: Any,
        dt: float,
    ) -> tuple[np.ndarray, ...]:
        """Return states at the outputs, shape (nx, n), and the means asked for, scaled."""
        full = self.ss.full(theta)
        scaled, p = x0 / self.ss.x.nominals, np.concatenate([u, full, [dt]])
        if self.solver != "idas":
            xf, qf = self._F(scaled, p, np.zeros(0))
            return xf * self.ss.x.nominals[:, None], qf
        z0 = self.ss.z_of(x0, u, theta).full().ravel() / self.ss.shared.z.nominals
        for last, move in enumerate(_MOVES, 1 - len(_MOVES)):
            try:
                xf, qf = self._F(scaled, p, z0 * (1.0 + move) + move)
            except RuntimeError as error:
                if last == 0 or "IDACalcIC" not in str(error):
                    raise
            else:
                break
        return xf * self.ss.x.nominals[:, None], qf

    def __call__(
        self,
        x0: Any,
        u: Any,
        theta: Any = (),
        dt: float = 0.02,
        *,
        t0: float = 0.0,
    ) -> StepResult:
        """Integrate from ``t0`` to ``t0 + dt``.

        Args:
            x0, u, theta: state at the start, inputs and parameters over the step, made by
                ``ss.x.pack`` and its like; shapes (nx,), (nu,), (nt,).
            dt: length of the step, s, > 0.
            t0: time of the start, s; for the output instants and messages only.

        Raises:
            SignalError: a vector of the wrong length or with values that are not finite.
            SimulationError: the integration failed; the message says when and why.
        """
        ss = self.ss
        x0, u, theta = (
            _vector(ss.name, label, v, len(s))
            for label, v, s in (("x0", x0, ss.x), ("u", u, ss.u), ("theta", theta, ss.theta))
        )
        if not dt > 0:
            raise SimulationError(f"{ss.name}: step length must be > 0, got {dt!r} s")
        try:
            with watched():
                x, means = self._solve(x0, u, theta, dt)
        except RuntimeError as error:
            raise self._failure(error, x0, u, theta, dt, t0) from None
        if not np.all(np.isfinite(x)):
            raise self._failure(RuntimeError("states are not finite"), x0, u, theta, dt, t0)
        mean: dict[str, float] = {}
        if self.quad:
            for name, value in zip(self.quad, means[:, -1], strict=True):
                mean[name] = float(value) * Term.of(name).nominal(ss)
        (y,) = self._g(x, u, ss.full(theta))
        return StepResult(t0 + dt * self.grid, x, y, mean, self._F.stats())

    def _failure(
        self, error: RuntimeError, x0: Any, u: Any, theta: Any, dt: float, t0: float
    ) -> SimulationError:
        """Find by bisection how far the integration gets, and say it with the likely cause."""
        found = re.search(r'returned "(\w+)"', str(error))
        code = found.group(1) if found else str(error).strip().splitlines()[-1][:200]
        cause = next((c for key, c in _CAUSES.items() if key in code), "see the solver's code")
        short = Stepper(
            self.ss,
            np.ones(1),
            solver=self.solver,
            rtol=self.rtol,
            atol=self.atol,
            max_steps=20_000,
        )
        good, bad, last = 0.0, 1.0, x0
        for _ in range(10):
            middle = 0.5 * (good + bad)
            try:
                with watched():
                    x = short._solve(x0, u, theta, middle * dt)[0].ravel()
            except RuntimeError:
                bad = middle
            else:
                good, last = middle, x
        worst = int(np.argmax(np.abs(last / self.ss.x.nominals)))
        name = self.ss.x.names[worst]
        return SimulationError(
            f"{self.ss.name}: {self.solver} failed with {code} between t = {t0:.6g} and "
            f"{t0 + dt:.6g} s; it gets at least as far as t = {t0 + good * dt:.6g} s, where the "
            f"largest state is {name} = {last[worst]:.4g} {self.ss.x[name].unit} "
            f"({last[worst] / self.ss.x[name].nominal:.3g} of nominal). Likely cause: {cause}"
        )


class _Buffered:
    """A function called through flat NumPy buffers; the conversions to DM cost more than CVODES.

    Each thread has buffers and solver memory of its own.
    """

    def __init__(
        self, fun: ca.Function, arguments: Sequence[str] = (), results: Sequence[str] = ()
    ) -> None:
        index_in = tuple(fun.index_in(n) for n in arguments) or tuple(range(fun.n_in()))
        index_out = tuple(fun.index_out(n) for n in results) or tuple(range(fun.n_out()))
        self._shapes = [fun.size_out(i) for i in index_out]
        self._here: PerThread[Buffers] = PerThread(Buffers, fun, index_in, index_out)

    def __call__(self, *values: np.ndarray) -> list[np.ndarray]:
        own = self._here.own
        for a, v in zip(own.inputs, values, strict=True):
            a[:] = v.ravel(order="F")
        own.evaluate()
        pairs = zip(own.outputs, self._shapes, strict=True)
        return [a.copy().reshape(shape, order="F") for a, shape in pairs]

    def stats(self) -> dict[str, Any]:
        return self._here.own.stats()


def _symbols(ss: StateSpace) -> Any:
    return ca.SX if ss.f.is_a("SXFunction") and ss.residual.is_a("SXFunction") else ca.MX


def _vector(model: str, label: str, values: Any, n: int) -> np.ndarray:
    a = array(f"{model}: {label}", values)
    if a.shape != (n,):
        raise SignalError(f"{model}: {label} must have shape ({n},), got {a.shape}")
    if not np.all(np.isfinite(a)):
        raise SignalError(f"{model}: {label} holds values that are not finite: {a}")
    return a


def stepper(
    ss: StateSpace,
    n_out: int | np.ndarray = 1,
    *,
    quad: Sequence[str] = (),
    solver: str = "cvodes",
    rtol: float = RTOL,
    atol: float = ATOL,
) -> Stepper:
    """Return a :class:`Stepper`, built once for each set of arguments; they are its own.

    Args:
        n_out: number of equally spaced outputs in a step, or the outputs as fractions of it.
    """
    if isinstance(n_out, np.ndarray):
        grid = n_out
    elif n_out >= 1:
        grid = np.arange(1, n_out + 1) / n_out
    else:
        raise SimulationError(f"{ss.name}: at least one output per step is needed, got {n_out}")
    key = (grid.tobytes(), tuple(quad), solver, rtol, atol)
    how = {"quad": quad, "solver": solver, "rtol": rtol, "atol": atol}
    return keep(ss, Stepper, key, lambda: Stepper(twin(ss), grid, **how))


@dataclass(frozen=True, eq=False)
class Switch:
    """A change at an instant, which the integration meets exactly.

    Args:
        t: instant, s.
        u, theta: inputs and parameters from then on.
        ss: model from then on; None keeps the one before.
        transfer: makes the new model's state from the old one's end state; None keeps it.
    """

    t: float
    u: Any
    theta: Any = ()
    ss: StateSpace | None = None
    transfer: Callable[[np.ndarray], np.ndarray] | None = None


def simulate(
    ss: StateSpace,
    x0: Any,
    t_grid: Any,
    u: Any,
    theta: Any = (),
    *,
    switches: Sequence[Switch] = (),
    solver: str = "auto",
    rtol: float = RTOL,
    atol: float = ATOL,
) -> Any:
    """Simulate piecewise between switching instants and return everything by name.

    Args:
        ss, x0: model and its state at ``t_grid[0]``, shape (nx,).
        t_grid: increasing output instants, s, shape (n,).  Switching instants are added to it.
        u, theta: inputs and parameters.  An array of shape (nu, n - 1) holds one column over each
            interval of ``t_grid`` (sampled noise); the integration restarts at each of them.
        switches: changes, in any order, within (t_grid[0], t_grid[-1]) or at its start.
        solver, rtol, atol: as for :class:`Stepper`; ``"auto"`` is CVODES.

    Returns:
        xarray.Dataset: a variable for each output and state, with ``units`` and ``long_name``, over
        ``time``.  At a switching instant the values are those just after it.  A state that a model
        does not have is NaN while that model runs.

    Raises:
        SimulationError: the integration failed, or a switch lies outside the grid.
    """
    t = array("t_grid", t_grid, error=SimulationError)
    if t.ndim != 1 or t.size < 2 or not np.all(np.isfinite(t)) or np.any(np.diff(t) <= 0):
        raise SimulationError("t_grid must be a 1-D array of at least two increasing instants")
    plan = sorted(switches, key=lambda s: s.t)
    for s in plan:
        if not t[0] <= s.t < t[-1]:
            raise SimulationError(
                f"switch at t = {s.t:g} s is outside the simulated [{t[0]:g}, {t[-1]:g}) s"
            )
    solver = "cvodes" if solver == "auto" else solver
    edges = np.unique([t[0], *(s.t for s in plan), t[-1]])
    over = partial(_over, solver=solver, rtol=rtol, atol=atol)
    system = _Piecewise(ss, _vector(ss.name, "x0", x0, len(ss.x)), t, edges, u, theta, over)
    pieces = list[_Piece]()
    run(system, edges, plan, record=lambda _k, _n, made: pieces.extend(made))
    how = {"solver": solver, "rtol": rtol, "atol": atol, "nsteps": system.nsteps}
    return _dataset(pieces, how)


class _Piece(NamedTuple):
    """A model's states and outputs at some instants."""

    ss: StateSpace
    t: np.ndarray
    x: np.ndarray
    y: np.ndarray


@dataclass
class _Piecewise:
    """One model after the other, with output instants ``t``, from edge to edge."""

    ss: StateSpace
    x: np.ndarray
    t: np.ndarray
    edges: np.ndarray
    u: Any
    theta: Any
    over: Callable[..., StepResult]
    nsteps: int = 0

    def switch(self, events: Sequence[Switch], t: float) -> None:
        """Go over to another model, other inputs and parameters."""
        for event in events:
            if event.transfer is not None:
                self.x = np.asarray(event.transfer(self.x), dtype=float)
            self.ss = event.ss or self.ss
            self.x = _vector(self.ss.name, "x after the switch", self.x, len(self.ss.x))
            self.u, self.theta = event.u, event.theta

    def advance(self, k: int, until: float) -> tuple[int, list[_Piece]]:
        """Integrate up to the next switch or the end."""
        ss, t, start = self.ss, self.t, float(self.edges[k])
        inside = t[(t > start) & (t < until)]
        # an output instant that differs from a switching instant by rounding is that instant
        apart = np.minimum(inside - start, until - inside)
        instants = np.concatenate([[start], inside[apart > 1e-12 * max(1.0, abs(until))], [until]])
        y0 = ss.g(self.x, _column(ss, self.u, t, start), self.theta).full()
        pieces = [_Piece(ss, instants[:1], self.x[:, None], y0)]
        for a, b in _intervals(instants, self.u):
            u = _column(ss, self.u, t, instants[a])
            made = self.over(ss, self.x, instants[a : b + 1], u, self.theta)
            self.nsteps += int(made.stats["nsteps"])
            self.x = made.x_end
            # at a switch the values are those just after it
            last = b == instants.size - 1 and until < t[-1]
            at = slice(-1) if last else slice(None)
            pieces.append(_Piece(ss, instants[a + 1 : b + 1][at], made.x[:, at], made.y[:, at]))
        return int(np.searchsorted(self.edges, until)) - k, pieces


#: Outputs in one call of an integrator at most; bounds its memory.
_CHUNK = 20_000


def _column(ss: StateSpace, u: Any, t: np.ndarray, at: float) -> np.ndarray:
    a = np.asarray(u, dtype=float)
    if a.ndim == 2:
        if a.shape[1] != t.size - 1:
            raise SignalError(
                f"{ss.name}: u must have one column for each of the {t.size - 1} intervals of "
                f"t_grid, got shape {a.shape}"
            )
        a = a[:, min(int(np.searchsorted(t, at + 1e-12, side="right")) - 1, t.size - 2)]
    return _vector(ss.name, "u", a, len(ss.u))


def _intervals(instants: np.ndarray, u: Any) -> list[tuple[int, int]]:
    """Return index pairs of ``instants`` between which the inputs are constant."""
    n = instants.size - 1
    step = 1 if np.ndim(u) == 2 else _CHUNK
    return [(a, min(a + step, n)) for a in range(0, n, step)]


def _over(
    ss: StateSpace,
    x: np.ndarray,
    instants: np.ndarray,
    u: np.ndarray,
    theta: Any,
    solver: str,
    rtol: float,
    atol: float,
) -> StepResult:
    dt = float(instants[-1] - instants[0])
    n = instants.size - 1
    fractions = (instants[1:] - instants[0]) / dt
    fractions[-1] = 1.0
    uniform = np.arange(1, n + 1) / n
    if np.max(np.abs(fractions - uniform)) < 1e-9:
        fractions = uniform
    step = stepper(ss, fractions, solver=solver, rtol=rtol, atol=atol)
    return step(x, u, theta, dt, t0=float(instants[0]))


def _dataset(pieces: Sequence[_Piece], attrs: dict[str, Any]) -> Any:
    import xarray as xr  # slow to import, and the multi-rate loop does not need it

    time = np.concatenate([p.t for p in pieces])
    columns: dict[str, tuple[np.ndarray, dict[str, str]]] = {}
    at = 0
    for ss, t, x, y in pieces:
        for signals, values in ((ss.x, x), (ss.y, y)):  # an output overrides its namesake state
            for signal, row in zip(signals, values, strict=True):
                if signal.name not in columns:
                    meta = {"units": signal.unit, "long_name": signal.doc}
                    columns[signal.name] = (np.full(time.size, np.nan), meta)
                columns[signal.name][0][at : at + t.size] = row
        at += t.size
    variables = {name: ("time", data, meta) for name, (data, meta) in columns.items()}
    coords = {"time": ("time", time, {"units": "s", "long_name": "time"})}
    attrs["models"] = ", ".join(dict.fromkeys(p.ss.name for p in pieces))
    return xr.Dataset(variables, coords, attrs)
