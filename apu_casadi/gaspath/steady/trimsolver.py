"""Solving steady points: compiled kernels by pair of fixed quantities, continuation.

:mod:`apu_casadi.gaspath.steady.trimkernel` writes the equations; here they are compiled or loaded,
called for one point or for many, and helped along from the design point where Newton's method
alone fails.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from apu_casadi.core import backend
from apu_casadi.core.errors import SignalError
from apu_casadi.core.lanes import lanelibrary
from apu_casadi.core.sharing import BUILDING, Rebuilt, building, keep, kept
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.cycle import Cycle
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.gaspath.maps.maptable import MapTable
from apu_casadi.gaspath.steady.steadypoint import Limits, Status, limit_status
from apu_casadi.gaspath.steady.trimkernel import LAW, TrimKernel

COMPILE_FROM = 300  # points from which compiling pays; below, a library is used if there is one
FLOORS = (1e-3, 1e-5)  # smallest steps of a continuation; the second where the end is not clear
STARTED = ("warm", "side", "equations")  # functions that take s before the rest
HOT = (("N", "PW"), ("N", "Wf"), ("N", "T4"), ("N", "T5"), ("PW", "Wf"), (LAW, "Wf"))
"""Pairs worth compiling ahead of time, names sorted."""


class TrimCode(Rebuilt):
    """The kernel of a structure and a pair of fixed quantities, in the backend in use."""

    kernel: TrimKernel

    @building
    def __init__(self, cycle: Cycle, spec: tuple[str, str]) -> None:
        """Compile nothing yet; functions are made or loaded when first called."""
        self.kernel = TrimKernel(cycle, spec)
        tables = map(table_digest, (cycle.compressor, cycle.turbine))
        self._digest = backend.recipe("trim", spec, cycle.gas_data, *tables)
        self._made: dict[tuple[str, str], Any] = {}

    def function(self, which: str, *, compile: bool) -> Any:
        """Return the kernel's function ``which``; ``compile=False`` only loads what there is."""
        mode = backend.backend_in_use()
        if mode == "vm":
            return getattr(self.kernel, which)
        made = self._made.get((which, "c"))
        if made is not None:
            return made
        with BUILDING:
            if (which, "c") in self._made:
                return self._made[which, "c"]
            tried = (which, "load")
            if not compile and tried in self._made:
                return self._made[tried]
            f = backend.load_or_build(
                f"{self._digest} {which}",
                lambda: getattr(self.kernel, which),
                compile_missing=compile,
            )
            loaded = compile or f.class_name() == "External"
            self._made[(which, "c") if loaded else tried] = f
            return f

    def wide(self, which: str, *, compile: bool) -> Any:
        """Return the function for several points at once, as :meth:`function`; None: there is none.

        The numbers of the engine, its last argument, are common to them.
        """
        if (lanes := lanelibrary.lanes_in_use()) == 1:
            return None
        made = self._made.get((which, f"{lanes} lanes"))
        tried = (which, f"load {lanes} lanes")
        if made is not None or (not compile and tried in self._made):
            return made
        with BUILDING:
            made = lanelibrary.recalled(
                f"{self._digest} {which}",
                lambda: getattr(self.kernel, which),
                common=(2 if which in STARTED else 1,),
                compile_missing=compile,
            )
            self._made[tried if made is None else (which, f"{lanes} lanes")] = made
        return made

    def one(self, which: str, *args: np.ndarray) -> tuple[np.ndarray, ...]:
        """Evaluate for one point; safe to call from several threads."""
        f = self.function(which, compile=False)
        return keep(self, "one", (which, f), lambda: backend.Caller(f))(*args)

    def many(
        self, which: str, *args: np.ndarray, n_threads: int | None, compile: bool = True
    ) -> tuple[np.ndarray, ...]:
        """Evaluate for columns, in lanes where there are any; safe to call from several threads.

        The last argument, the numbers of the engine, is common to them.
        """
        wide = self.wide(which, compile=compile)
        f = self.function(which, compile=compile) if wide is None else wide

        def made() -> backend.Mapped:
            if wide is None:
                return backend.mapped(f, n_threads)
            lanes, last = wide.size2_out(0), wide.n_in() - 1
            return backend.Mapped(wide, n_threads, width=lanes, common=(last,))

        return keep(self, "many", (which, f, n_threads), made)(*args)


@kept
def code_of(cycle: Cycle, spec: tuple[str, str]) -> TrimCode:
    """Return the code of a structure and a pair of fixed quantities, made once."""
    return TrimCode(cycle, spec)


class Solver(Rebuilt):
    """The steady points of one engine with one pair of fixed quantities."""

    gg: GasGenerator
    code: TrimCode
    kernel: TrimKernel
    nominal: np.ndarray

    def __init__(self, gg: GasGenerator, spec: tuple[str, str]) -> None:
        """Take the code that all engines of this structure share."""
        self.gg, self.code = gg, code_of(gg.family.cycle, spec)
        self.kernel, self.nominal = self.code.kernel, self.code.kernel.nominal(gg.numbers)
        self.regular: bool | None = None

    def one(self, which: str, *args: np.ndarray) -> tuple[np.ndarray, ...]:
        """Evaluate a function of the kernel for one point."""
        return self.code.one(which, *args, self.gg.numbers)

    def many(
        self, which: str, *args: np.ndarray, n_threads: int | None, compile: bool = True
    ) -> tuple[np.ndarray, ...]:
        """Evaluate a function of the kernel for columns."""
        c = self.gg.numbers
        return self.code.many(which, *args, c, n_threads=n_threads, compile=compile)

    def sought(self, w: np.ndarray) -> np.ndarray:
        """Return the unknowns as sought from w = (z, N, Wf, PW), by columns."""
        return self.kernel.sought(w, self.nominal)

    def jacobian(self, s: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Return the Jacobian of the equations by the unknowns as sought."""
        return np.asarray(self.kernel.equations(s, p, self.gg.numbers)[1].full())


@kept
def solver_of(gg: GasGenerator, spec: tuple[str, str]) -> Solver:
    """Return the solver of an engine and a pair of fixed quantities, made once."""
    return Solver(gg, spec)


def table_digest(t: MapTable) -> str:
    """Tell the content of a map table."""
    h = hashlib.sha256(t.kind.encode())
    for a in (t.N, t.beta, t.W, t.PR, t.eta, t.surge_W, t.surge_PR):
        h.update(b"-" if a is None else a.tobytes() + repr(a.shape).encode())
    return h.hexdigest()


def hot_functions(gg: GasGenerator | None = None) -> list[str]:
    """Compile the usual pairs for engines of ``gg``'s structure, the default's if None."""
    gg = GasGenerator() if gg is None else gg
    names = []
    for pair in HOT:
        code = code_of(gg.family.cycle, pair)
        names += [code.function(which, compile=True).name() for which in ("cold", "warm")]
        wide = [code.wide(which, compile=True) for which in ("cold", "warm")]
        names += [f.name() for f in wide if f is not None]
    return names


def norm(r: np.ndarray) -> float:
    """Max-norm; infinite when anything is not a number."""
    v = float(np.abs(r).max())
    return v if math.isfinite(v) else math.inf


def norms(r: np.ndarray) -> np.ndarray:
    """Max-norm by columns, shape (n,); infinite likewise."""
    v = np.abs(r).max(axis=0)
    return np.where(np.isfinite(v), v, np.inf)


# ------------------------------------------------------------------------------ continuation


def origin_of(solver: Solver) -> tuple[np.ndarray, np.ndarray]:
    """Return parameters and unknowns of the design point."""
    gg, k = solver.gg, solver.kernel
    par, d = gg.parameters, gg.design.values
    values: list[float] = []
    for n in k.spec:
        values += [d["PW"], par.N, 3.0] if n == LAW else [_design_output(gg)[gg.Y.index(n)]]
    ambient = [getattr(par, n) for n in AMBIENT]
    p = np.array([*ambient, *np.ones(len(gg.THETA)), *values])
    return p, k.design_start(gg.numbers)


@kept
def _design_output(gg: GasGenerator) -> np.ndarray:
    par, d = gg.parameters, gg.design
    z = [*d.z.values(), *(m.beta_des for m in gg.maps)]
    u = [d.values["Wf"], d.values["PW"], *(getattr(par, n) for n in AMBIENT)]
    theta = gg.full(np.ones(len(gg.THETA)))
    return np.asarray(gg.family.equations(par.N, z, u, theta)[2]).ravel()


def on_the_way(solver: Solver, p: np.ndarray, t: float) -> np.ndarray:
    """Return the parameters at share ``t`` of the way from the design point to ``p``."""
    origin, _ = origin_of(solver)
    made: np.ndarray = origin + t * (p - origin)
    return made


def continue_one(
    solver: Solver, limits: Limits, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float, int]:
    """Move from the design point to p in adaptive steps; return w, y, r, s, share, iterations."""
    origin, s = origin_of(solver)
    w, y, r, s, n = solver.one("warm", s, origin)
    total, t, dt = int(n[0]), 0.0, 0.25
    for floor in FLOORS:
        while t < 1.0 and dt >= floor:
            t_try = min(1.0, t + dt)
            trial = solver.one("warm", s, origin + t_try * (p - origin))
            total += round(float(trial[4][0]))
            if norm(trial[2]) <= RESIDUAL_TOL:
                (w, y, r, s), t, dt = trial[:4], t_try, dt * 1.7
            else:
                dt /= 2
        if t >= 1.0 or explained(solver.gg, limits, y[:, None])[0]:
            break
    return w, y, r, s, t, total


def explained(gg: GasGenerator, limits: Limits, y: np.ndarray) -> np.ndarray:
    """Whether the outputs tell why the way ends there: a limit is broken, or a map left."""
    off = np.maximum(y[gg.Y.index("off_c")], y[gg.Y.index("off_t")]) > 0
    made: np.ndarray = off | (limit_status(gg, limits, y) != Status.SOLVED)
    return made


def continue_many(
    solver: Solver,
    p: np.ndarray,
    *,
    floor: float,
    n_threads: int | None,
    state: tuple[np.ndarray, ...] | None = None,
) -> tuple[np.ndarray, ...]:
    """As :func:`continue_one` for columns; returns w, y, r, s, t, dt."""
    origin, s0 = origin_of(solver)
    M, o = p.shape[1], origin[:, None]
    if state is None:
        start = solver.one("warm", s0, origin)
        w, y, r, s = (np.repeat(a[:, None], M, axis=1) for a in start[:4])
        t, dt = np.zeros(M), np.full(M, 0.25)
    else:
        w, y, r, s, t, dt = (a.copy() for a in state)
    compile = M >= COMPILE_FROM // 10
    while (go := np.flatnonzero((t < 1.0) & (dt >= floor))).size:
        t_try = np.minimum(1.0, t[go] + dt[go])
        trial = solver.many(
            "warm", s[:, go], o + t_try * (p[:, go] - o), n_threads=n_threads, compile=compile
        )
        good = norms(trial[2]) <= RESIDUAL_TOL
        at = go[good]
        for mine, new in zip((w, y, r, s), trial, strict=False):
            mine[:, at] = new[:, good]
        t[at] = t_try[good]
        dt[at] *= 1.7
        dt[go[~good]] /= 2
    return w, y, r, s, t, dt


# ------------------------------------------------------------------------------ where it ends


def _fold(solver: Solver, s: np.ndarray, p: np.ndarray) -> float:
    """Smallest singular value of the scaled Jacobian, relative to that at the design point."""
    origin, s0 = origin_of(solver)
    return _sigma(solver, s, p) / max(_sigma(solver, s0, origin), 1e-300)


def _determinant_left(solver: Solver, s: np.ndarray, p: np.ndarray, reached: float) -> float:
    """Determinant of the Jacobian over that a little before on the way; 0 at a fold.

    It falls like the root of the distance to the fold.  The smallest singular value tells less for
    pairs such as (N, P3), whose equations are ill-conditioned at the design point already.
    """
    before = on_the_way(solver, p, max(reached - 0.02, 0.0))
    _, _, r, s_before, _ = solver.one("warm", s, before)
    there = solver.jacobian(s, on_the_way(solver, p, reached))
    then = solver.jacobian(s_before, before)
    if norm(r) > RESIDUAL_TOL or not (np.isfinite(there).all() and np.isfinite(then).all()):
        return math.inf
    return float(np.exp(np.linalg.slogdet(there)[1] - np.linalg.slogdet(then)[1]))


def _sigma(solver: Solver, s: np.ndarray, p: np.ndarray) -> float:
    J = solver.jacobian(s, p)
    # rows to unit size: a row's scale says nothing about a fold
    J = J / np.maximum(np.abs(J).max(axis=1, keepdims=True), 1e-300)
    if not np.all(np.isfinite(J)):
        return 0.0
    return float(np.linalg.svd(J, compute_uv=False)[-1])


def require_regular(solver: Solver, names: Sequence[str]) -> None:
    """Refuse two quantities that say the same; asked only when a point was not found."""
    if solver.regular is None:
        origin, s0 = origin_of(solver)
        solver.regular = _sigma(solver, s0, origin) > 1e-10
    if not solver.regular:
        raise SignalError(
            f"{' and '.join(names)} do not determine a point together: one follows from the other"
        )


def stop_status(
    solver: Solver,
    limits: Limits,
    y: np.ndarray,
    s: np.ndarray,
    p: np.ndarray,
    reached: float,
) -> Status:
    """Say at what boundary the way from the design point ended."""
    gg = solver.gg
    broken = Status(int(limit_status(gg, limits, y)[0]))
    if broken != Status.SOLVED:
        return broken
    v = y[:, 0]
    if max(v[gg.Y.index("off_c")], v[gg.Y.index("off_t")]) > 0:
        return Status.OFF_MAP
    if _fold(solver, s[:, 0], on_the_way(solver, p, reached)) < 0.2:
        return Status.NO_BALANCE
    if _determinant_left(solver, s[:, 0], p, reached) < 0.2:
        return Status.NO_BALANCE
    return Status.UNEXPLAINED
