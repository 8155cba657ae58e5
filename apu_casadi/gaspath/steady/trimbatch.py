"""Many steady points in compiled code: batches over arrays, performance decks over grids.

Points are those of :func:`apu_casadi.gaspath.steady.trimming.trim_gas_generator`; nothing is
raised for a point, its status tells what became of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.checked import array
from apu_casadi.core.errors import SignalError, nearest
from apu_casadi.gaspath.conditions import AMBIENT, DEFAULT_DAY
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.gaspath.steady.steadypoint import (
    MEANING,
    Limits,
    Status,
    input_ranges,
    limit_status,
    limit_text,
    named,
    off_speed,
    range_text,
    specify,
    stop_text,
)
from apu_casadi.gaspath.steady.trimbranch import Roots, may_fold, settle
from apu_casadi.gaspath.steady.trimkernel import DIRECT, NZ
from apu_casadi.gaspath.steady.trimsolver import (
    COMPILE_FROM,
    FLOORS,
    Solver,
    continue_many,
    explained,
    norm,
    norms,
    require_regular,
    solver_of,
    stop_status,
)

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["TrimBatch", "performance_deck", "trim_batch"]


CHUNK = 4096  # points solved at once by a batch: their results stay in the cache


@dataclass(frozen=True)
class TrimBatch:
    """Many points.

    Args:
        y: outputs, shape (len(names), n); NaN where no solution was found.
        names: outputs that were kept.
        w: cycle unknowns z, then N, Wf, PW, shape (14, n); NaN likewise.
        p: what was asked for: ambient, health, fixed values, shape (n_p, n).
        fixed: names of the fixed quantities.
        status: a :class:`Status` by point, shape (n,).  Points refused by a limit keep their
            values.
        residual: re-evaluated max-norm, shape (n,); inf where no solution was found.
        reached: share of the way from the design point that has solutions, shape (n,); 1 if solved.
        iterations: Newton steps, shape (n,), -1 where continuation was needed.
        shape: shape of the arrays that were given.
        N_second: speed of another point within the limits with the same two quantities, rad/s,
            shape (n,); NaN where none was found, as for all pairs with N
            (:mod:`apu_casadi.gaspath.steady.trimbranch`).
    """

    y: np.ndarray
    names: tuple[str, ...]
    w: np.ndarray
    p: np.ndarray
    fixed: tuple[str, ...]
    status: np.ndarray
    residual: np.ndarray
    reached: np.ndarray
    iterations: np.ndarray
    shape: tuple[int, ...]
    N_second: np.ndarray
    _gg: GasGenerator = field(repr=False)
    _limits: Limits = field(repr=False)
    _stop: dict[int, tuple[np.ndarray, np.ndarray]] = field(repr=False)

    def __len__(self) -> int:
        return int(self.status.size)

    def __getitem__(self, name: str) -> np.ndarray:
        """Return an output by name with the shape of the arrays given; NaN where refused."""
        if name not in self.names:
            raise SignalError(f"output {name!r} was not kept {nearest(name, self.names)}")
        v = np.where(self.status == Status.SOLVED, self.y[self.names.index(name)], np.nan)
        return v.reshape(self.shape)

    @property
    def ok(self) -> np.ndarray:
        """Where a point was solved within all limits, with the shape of the arrays given."""
        return np.asarray(self.status == Status.SOLVED).reshape(self.shape)

    def counts(self) -> dict[str, int]:
        """Return the number of points by what became of them."""
        return {MEANING[s]: int((self.status == s).sum()) for s in Status}

    def reason(self, i: int) -> str:
        """Return why point ``i`` (flat index) was refused, with numbers; "" if it was solved."""
        s = Status(int(self.status[i]))
        if s == Status.SOLVED:
            return ""
        if s == Status.INPUT:
            return range_text(self._gg, self.p[:, i])
        y = named(self._gg, *self._stop[i])
        if self.reached[i] >= 1.0:
            return limit_text(self._gg, self._limits, y)
        return stop_text(self._gg, self._limits, s, y, float(self.reached[i]))

    def to_dataset(self) -> xr.Dataset:
        """Return an xarray dataset over ``point``; over d0, d1, ... for arrays of two and more."""
        import xarray as xr

        dims = ("point",) if len(self.shape) < 2 else tuple(f"d{k}" for k in range(len(self.shape)))
        shape = self.shape or (1,)
        data: dict[str, Any] = {}
        for n in self.names:
            s = self._gg.Y[n]
            data[n] = (dims, self[n].reshape(shape), {"units": s.unit, "long_name": s.doc})
        inputs = (*AMBIENT, *self._gg.THETA.names)
        for k, n in enumerate(inputs):
            s = (self._gg.U if n in self._gg.U else self._gg.THETA)[n]
            data[n] = (dims, self.p[k].reshape(shape), {"units": s.unit, "long_name": s.doc})
        data["status"] = (
            dims,
            self.status.reshape(shape),
            {
                "long_name": "what became of the point",
                "flag_values": [int(s) for s in Status],
                "flag_meanings": " ".join(MEANING[s].replace(" ", "_") for s in Status),
            },
        )
        if "N" not in self.fixed:
            data["N_second"] = (
                dims,
                self.N_second.reshape(shape),
                {
                    "units": "rad/s",
                    "long_name": "rotor speed of a second steady point, NaN if none",
                },
            )
        data["trim_residual"] = (dims, self.residual.reshape(shape), {"units": "1"})
        attrs = {"fixed": " ".join(self.fixed), "points": len(self)}
        return xr.Dataset(data, attrs=attrs)


def trim_batch(
    gg: GasGenerator,
    fixed: Mapping[str, Any],
    *,
    theta: Mapping[str, Any] | None = None,
    limits: Limits | None = None,
    outputs: Sequence[str] | None = None,
    n_threads: int | None = None,
    **ambient: Any,
) -> TrimBatch:
    """Solve many steady points in compiled code; nothing is raised for a point.

    Points are the same as those of :func:`trim_gas_generator`, with one difference: where the given
    speed lies off the compressor's table and no solution is found cold, none is sought further.

    Args:
        fixed: two outputs by name: numbers or arrays.  ``PW`` may be a :class:`LoadLaw`.
        theta: health factors by name, numbers or arrays.
        limits: as in :func:`trim_gas_generator`.
        outputs: outputs to keep, all by default; fewer take less memory.
        n_threads: default all cores that the process may use.
        ambient: altitude (m), Mach, dT_isa (K), war (kg/kg), numbers or arrays; the default day
            where not given.

    Arrays are broadcast against each other; results have their common shape.

    Raises:
        SignalError: not two names, unknown names, names that do not determine a point together, or
            shapes that do not go together.
    """
    limits = Limits() if limits is None else limits
    spec, values, names = specify(gg, fixed)
    keep = gg.Y.names if outputs is None else tuple(outputs)
    rows = gg.Y.indices(keep)
    health = dict(theta or {})
    given = [ambient.get(n, gg.U[n].default) for n in AMBIENT]
    given += [health.get(n, 1.0) for n in gg.THETA.names]
    wrong = [f"unknown {n} {nearest(n, AMBIENT)}" for n in ambient if n not in AMBIENT]
    wrong += [f"unknown {n} {nearest(n, gg.THETA.names)}" for n in health if n not in gg.THETA]
    if wrong:
        raise SignalError("; ".join(wrong))
    try:
        labels = (*AMBIENT, *gg.THETA.names, *[", ".join(names)] * len(values))
        arrays = [array(n, v) for n, v in zip(labels, (*given, *values), strict=True)]
        shape = np.broadcast_shapes(*(a.shape for a in arrays))
    except (TypeError, ValueError) as e:
        raise SignalError(f"batch of {', '.join(names)}: {e}") from None
    M = math.prod(shape)
    p = np.empty((len(arrays), M))
    for k, a in enumerate(arrays):
        p[k] = np.broadcast_to(a, shape).reshape(-1)
    solver = solver_of(gg, spec)
    out = _Arrays(rows, M)
    for k in range(0, M, CHUNK):
        _solve_chunk(out, k, solver, limits, p[:, k : k + CHUNK], n_threads)
    solved = {k: getattr(out, k) for k in _SOLVED}
    asked: dict[str, Any] = {"names": keep, "p": p, "fixed": names, "shape": shape}
    return TrimBatch(**solved, **asked, _gg=gg, _limits=limits, _stop=out.stop)


_SOLVED = ["y", "w", "status", "residual", "reached", "iterations", "N_second"]


class _Arrays:
    """What a batch of M points fills; ``rows`` are the outputs that are kept."""

    def __init__(self, rows: list[int], M: int) -> None:
        self.rows, self.size = rows, M
        self.y, self.w = np.full((len(rows), M), np.nan), np.full((NZ + 3, M), np.nan)
        self.status = np.full(M, Status.INPUT, dtype=np.int8)
        self.residual, self.reached = np.full(M, np.inf), np.zeros(M)
        self.iterations = np.full(M, -1, dtype=np.int32)
        self.N_second = np.full(M, np.nan)
        self.stop: dict[int, tuple[np.ndarray, np.ndarray]] = {}


def _solve_chunk(
    out: _Arrays, first: int, solver: Solver, limits: Limits, p: np.ndarray, n_threads: int | None
) -> None:
    """Solve the points ``p``, which begin at ``first``."""
    gg = solver.gg
    valid = np.all(np.isfinite(p), axis=0)
    for k, name in enumerate((*AMBIENT, *gg.THETA.names)):
        lo, hi = input_ranges(gg)[name]
        valid &= (p[k] >= lo) & (p[k] <= hi)
    index = np.flatnonzero(valid)
    if not index.size:
        return
    p = p if index.size == valid.size else p[:, index]
    compile = out.size >= COMPILE_FROM
    w, y, r, _s, count = solver.many("cold", p, n_threads=n_threads, compile=compile)
    residual, reached = norms(r), np.ones(index.size)
    count = count[0].round().astype(np.int32)
    bad = residual > RESIDUAL_TOL
    # no continuation where the given speed is off the table: it finds next to nothing there
    beyond = np.asarray(off_speed(gg, solver.kernel.spec, y))
    far = bad & (beyond > 0)
    status = np.full(index.size, Status.UNEXPLAINED, dtype=np.int8)
    status[far], reached[far] = Status.OFF_MAP, 0.0
    for j in np.flatnonzero(far):
        stop, nowhere = y[:, j].copy(), np.full(NZ + 3, np.nan)
        stop[gg.Y.index("off_c")] = beyond[j]
        out.stop[first + int(index[j])] = (stop, nowhere)
    lost = np.flatnonzero(bad & ~far)
    if lost.size:
        require_regular(solver, solver.kernel.spec)
        q = p[:, lost]
        state = continue_many(solver, q, floor=FLOORS[0], n_threads=n_threads)
        for floor in FLOORS[1:]:
            again = np.flatnonzero((state[4] < 1.0) & ~explained(gg, limits, state[1]))
            if not again.size:
                break
            part = tuple(a[..., again] for a in state)
            finer = continue_many(solver, q[:, again], floor=floor, n_threads=n_threads, state=part)
            for mine, new in zip(state, finer, strict=True):
                mine[..., again] = new
        w_l, y_l, r_l, s_l, t_l, _ = state
        for k, j in enumerate(lost):
            reached[j], count[j] = t_l[k], -1
            if t_l[k] >= 1.0:
                w[:, j], y[:, j], r[:, j] = w_l[:, k], y_l[:, k], r_l[:, k]
                residual[j] = norm(r_l[:, k])
            else:
                one = slice(k, k + 1)
                status[j] = stop_status(solver, limits, y_l[:, one], s_l[:, one], q[:, k], t_l[k])
                out.stop[first + int(index[j])] = (y_l[:, k].copy(), w_l[:, k].copy())
    solved = residual <= RESIDUAL_TOL
    if may_fold(solver.kernel.spec) and solved.any():
        found = Roots(w[:, solved], y[:, solved], residual[solved])
        a, b = settle(solver, limits, found, p[:, solved], compile=compile)
        w[:, solved], y[:, solved], residual[solved] = a
        out.N_second[first + index[solved]] = b.w[DIRECT["N"]]
    every = bool(solved.all())
    status[solved] = limit_status(gg, limits, y if every else y[:, solved])
    broken = np.flatnonzero(solved & (status != Status.SOLVED))
    stops = zip(y.T[broken], w.T[broken], strict=True)
    out.stop.update(zip((first + index[broken]).tolist(), stops, strict=True))
    whole = slice(first, first + valid.size)
    at = whole if index.size == valid.size else first + index
    out.status[at], out.reached[at], out.iterations[at] = status, reached, count
    out.residual[at] = residual if every else np.where(solved, residual, np.inf)
    # rows one by one: nothing of this size is made twice
    for target, source, rows in ((out.y, y, out.rows), (out.w, w, range(NZ + 3))):
        for k, row in enumerate(rows):
            target[k, at] = source[row] if every else np.where(solved, source[row], np.nan)


def performance_deck(
    gg: GasGenerator,
    *,
    altitude: Sequence[float] | np.ndarray = (DEFAULT_DAY["altitude"],),
    Mach: Sequence[float] | np.ndarray = (DEFAULT_DAY["Mach"],),
    dT_isa: Sequence[float] | np.ndarray = (DEFAULT_DAY["dT_isa"],),
    PW: Sequence[float] | np.ndarray = (5e5,),
    N: float | None = None,
    theta: Mapping[str, float] | None = None,
    limits: Limits | None = None,
    outputs: Sequence[str] | None = None,
    n_threads: int | None = None,
) -> xr.Dataset:
    """Solve a grid of altitude, Mach number, ISA deviation and shaft power at one speed.

    Args:
        altitude (m), Mach, dT_isa (K), PW (W): 1-D axes of the grid; air is dry, and a condition
            that is not given is that of the default day.
        N: speed, rad/s; design speed by default.
        theta, limits, outputs, n_threads: as in :func:`trim_batch`.

    Returns:
        xarray dataset over the four axes: outputs (NaN where refused), ``status``,
        ``trim_residual``.
    """
    import xarray as xr

    axes = {"altitude": altitude, "Mach": Mach, "dT_isa": dT_isa, "PW": PW}
    grid = {k: np.atleast_1d(array(k, v)) for k, v in axes.items()}
    mesh = dict(zip(grid, np.meshgrid(*grid.values(), indexing="ij", sparse=True), strict=True))
    N = gg.parameters.N if N is None else N
    fixed = {"N": N, "PW": mesh.pop("PW")}
    how: dict[str, Any] = {"limits": limits, "outputs": outputs, "n_threads": n_threads}
    batch = trim_batch(gg, fixed, theta=theta, **how, **mesh)
    flat = batch.to_dataset()
    dims = tuple(grid)
    data = {
        name: (dims, v.values.reshape(batch.shape), v.attrs)
        for name, v in flat.data_vars.items()
        if name not in (*grid, *AMBIENT, *gg.THETA.names)
    }
    coords = {k: (k, v, {"units": (gg.U if k in gg.U else gg.Y)[k].unit}) for k, v in grid.items()}
    health = {n: float((theta or {}).get(n, 1.0)) for n in gg.THETA.names}
    return xr.Dataset(data, coords=coords, attrs={"N": N, "war": DEFAULT_DAY["war"], **health})
