"""Solving steady points: compiled kernels by engine and pair of fixed quantities, continuation.

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
from apu_casadi.core.sharing import BUILDING, Rebuilt, building, keep, kept
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator, MapChoice
from apu_casadi.gaspath.steady.steadypoint import Limits, Status, limit_status
from apu_casadi.gaspath.steady.trimkernel import AMBIENT, LAW, TrimKernel

COMPILE_FROM = 300  # points from which compiling pays; below, a library is used if there is one
FLOORS = (1e-3, 1e-5)  # smallest steps of a continuation; the second where the end is not clear
HOT = (("N", "PW"), ("N", "Wf"), ("N", "T4"), ("N", "T5"), ("PW", "Wf"), (LAW, "Wf"))
"""Pairs worth compiling ahead of time, names sorted."""


class Solver(Rebuilt):
    """The kernel of one engine and one pair of fixed quantities, in the backend in use."""

    @building
    def __init__(self, gg: GasGenerator, spec: tuple[str, str]) -> None:
        """Compile nothing yet; functions are made or loaded when first called."""
        self.gg, self.kernel = gg, TrimKernel(gg.cycle, spec)
        self._digest = backend.recipe("trim", spec, gg.parameters, *map_digest(gg))
        self._made: dict[tuple[str, str], Any] = {}
        self.regular: bool | None = None

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
                f"{self._digest} {which}", lambda: getattr(self.kernel, which),
                compile_missing=compile,
            )  # fmt: skip
            loaded = compile or f.class_name() == "External"
            self._made[(which, "c") if loaded else tried] = f
            return f

    def one(self, which: str, *args: np.ndarray) -> tuple[np.ndarray, ...]:
        """Evaluate for one point; safe to call from several threads."""
        f = self.function(which, compile=False)
        return keep(self, "one", (which, f), lambda: backend.Caller(f))(*args)

    def many(
        self, which: str, *args: np.ndarray, n_threads: int | None, compile: bool = True
    ) -> tuple[np.ndarray, ...]:
        """Evaluate for columns; safe to call from several threads."""
        f = self.function(which, compile=compile)
        return keep(self, "many", (which, f, n_threads), lambda: backend.mapped(f, n_threads))(
            *args
        )


@kept
def solver_of(gg: GasGenerator, spec: tuple[str, str]) -> Solver:
    """Return the solver of an engine and a pair of fixed quantities, made once."""
    return Solver(gg, spec)


def map_digest(gg: GasGenerator) -> list[str]:
    """Tell the content of the maps, whose tables compare by identity."""

    def of(m: MapChoice) -> str:
        t = m.table
        h = hashlib.sha256(repr((m.N_map_des, m.beta_des, m.calibration, t.kind)).encode())
        for a in (t.N, t.beta, t.W, t.PR, t.eta, t.surge_W, t.surge_PR):
            h.update(b"-" if a is None else a.tobytes() + repr(a.shape).encode())
        return h.hexdigest()

    return [of(gg.compressor_map), of(gg.turbine_map)]


def hot_functions(gg: GasGenerator | None = None) -> list[str]:
    """Compile the usual pairs of ``gg``, the default engine if None; return the names."""
    gg = GasGenerator() if gg is None else gg
    names = []
    for pair in HOT:
        solver = solver_of(gg, pair)
        names += [solver.function(which, compile=True).name() for which in ("cold", "warm")]
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
    par = gg.parameters
    ambient = [getattr(par, n) for n in AMBIENT]
    values: list[float] = []
    for n in k.spec:
        if n == LAW:
            values += [k.PW_design, par.N, 3.0]
        else:
            values.append(_design_output(gg)[gg.Y.index(n)])
    p = np.array([*ambient, *np.ones(len(gg.THETA)), *values])
    return p, k.design_start()


@kept
def _design_output(gg: GasGenerator) -> np.ndarray:
    k = TrimKernel(gg.cycle, ("N", "PW"))
    par, d = gg.parameters, gg.design
    z = [d.z.get(n, 0.0) for n in gg.z.names]
    z[-2:] = [gg.cycle.cmap.beta_des, gg.cycle.tmap.beta_des]
    u = [d.values["Wf"], k.PW_design, *(getattr(par, n) for n in AMBIENT)]
    return np.asarray(gg.equations(par.N, z, u, np.ones(len(gg.THETA)))[2]).ravel()


def on_the_way(solver: Solver, p: np.ndarray, t: float) -> np.ndarray:
    """Return the parameters at share ``t`` of the way from the design point to ``p``."""
    origin, _ = origin_of(solver)
    return origin + t * (p - origin)


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
    return off | (limit_status(gg, limits, y) != Status.SOLVED)


def continue_many(
    solver: Solver, p: np.ndarray, *, floor: float, n_threads: int | None,
    state: tuple[np.ndarray, ...] | None = None,
) -> tuple[np.ndarray, ...]:  # fmt: skip
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
    there = solver.kernel.equations(s, on_the_way(solver, p, reached))[1].full()
    then = solver.kernel.equations(s_before, before)[1].full()
    if norm(r) > RESIDUAL_TOL or not (np.isfinite(there).all() and np.isfinite(then).all()):
        return math.inf
    return float(np.exp(np.linalg.slogdet(there)[1] - np.linalg.slogdet(then)[1]))


def _sigma(solver: Solver, s: np.ndarray, p: np.ndarray) -> float:
    J = solver.kernel.equations(s, p)[1].full()
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
