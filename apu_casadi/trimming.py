"""Steady operating points: fix any two quantities, get everything else, or the reason why not.

The cycle equations and the power balance leave two degrees of freedom; a trim fixes two outputs
by name (speed and shaft power, speed and T4, fuel flow and a load law, ...), for any altitude, Mach
number, ISA deviation, humidity and health.  Nobody guesses: Newton's method starts by similarity
with the design point; where that fails, everything is moved there from the design point in steps
(continuation).  What ends within the step limit is judged by the residual, evaluated again; what
lies beyond a limit, or does not exist, is refused with its reason and the best point reached.

Some pairs have two solutions: shaft power and fuel flow meet at two speeds where efficiency has a
maximum between them.  The one found is the one that Newton's method reaches from the design speed.

:func:`trim_gas_generator` solves one point, :func:`trim_batch` many in compiled code,
:func:`maximum_power` one at a temperature limit, :func:`performance_deck` a grid.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi import backend
from apu_casadi.errors import OperatingPointError, SignalError, nearest
from apu_casadi.gasgenerator import (
    RESIDUAL_TOL,
    GasGenerator,
    GasGeneratorState,
    MapChoice,
)
from apu_casadi.trimkernel import AMBIENT, LAW, N_FIRST, NZ, TrimKernel

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "Limits",
    "LoadLaw",
    "OperatingPoint",
    "Refusal",
    "Status",
    "TrimBatch",
    "hot_functions",
    "maximum_power",
    "performance_deck",
    "trim_batch",
    "trim_gas_generator",
]

COMPILE_FROM = 300  # points from which compiling pays; below, a library is used if there is one
FLOORS = (1e-3, 1e-5)  # smallest steps of a continuation; the second where the end is not clear
CHUNK = 16384  # points solved at once by a batch
GIVEN = ("T0", "P0", "T1", "P1", "T2", "P2", "off_c", "off_t", "residual", "P_acceleration")
"""Outputs that cannot be fixed: the ambient gives them, or the equations."""


# ------------------------------------------------------------------------------ what goes in


@dataclass(frozen=True)
class LoadLaw:
    """Shaft power as a power of speed: PW = PW_ref (N/N_ref)^exponent.

    Parameters
    ----------
    PW_ref : shaft power at N_ref, W.
    N_ref : speed, rad/s, > 0.
    exponent : 3 for a propeller or fan, 0 for constant power.
    """

    PW_ref: float
    N_ref: float
    exponent: float = 3.0

    def __post_init__(self) -> None:
        """Refuse values that are no law."""
        if not all(map(math.isfinite, (self.PW_ref, self.N_ref, self.exponent))) or self.N_ref <= 0:
            raise SignalError(f"load law needs finite numbers and N_ref > 0, got {self!r}")


@dataclass(frozen=True)
class Limits:
    """Beyond these a solved point is refused.

    Parameters
    ----------
    off_map : largest distance outside a component map, in table spans.  0 allows nothing outside;
        a quarter of a span (corrected speed 1.275 where the table ends at 1.1) is where the maps'
        straight continuation is thought to mean something; *assumed*.
    SM_min : smallest compressor stability margin; 0 is the surge line.
    T4_max : highest combustor outlet temperature, K; None is 1.1 times the design value, *assumed*
        (the paper gives none).
    T5_max : highest turbine outlet temperature, K; none by default.
    Mach8_max : the fixed exit is modelled subsonic only.
    Wf_min : smallest fuel flow, kg/s; None is 0.5 % of the design value, where no flame burns any
        more: such a point is driven, not fired; *assumed*.
    """

    off_map: float = 0.25
    SM_min: float = 0.0
    T4_max: float | None = None
    T5_max: float = math.inf
    Mach8_max: float = 1.0
    Wf_min: float | None = None

    @classmethod
    def none(cls) -> Limits:
        """No limits but the model's own: a subsonic exit and fuel to burn."""
        return cls(off_map=math.inf, SM_min=-math.inf, T4_max=math.inf, Wf_min=0.0)

    def rows(self, gg: GasGenerator) -> list[tuple[Status, str, float, float]]:
        """Return (status, output, sign, limit): refused where sign * (value - limit) > 0."""
        T4 = 1.1 * gg.parameters.T4 if self.T4_max is None else self.T4_max
        Wf = 5e-3 * gg.design.values["Wf"] if self.Wf_min is None else self.Wf_min
        return [
            (Status.CHOKED, "Mach8", 1.0, self.Mach8_max),
            (Status.OFF_MAP, "off_c", 1.0, self.off_map),
            (Status.OFF_MAP, "off_t", 1.0, self.off_map),
            (Status.SURGE, "SM", -1.0, self.SM_min),
            (Status.TEMPERATURE, "T4", 1.0, T4),
            (Status.TEMPERATURE, "T5", 1.0, self.T5_max),
            (Status.FUEL, "Wf", -1.0, Wf),
        ]


# ------------------------------------------------------------------------------ what comes out


class Status(IntEnum):
    """What became of a point."""

    SOLVED = 0
    OFF_MAP = 1
    SURGE = 2
    TEMPERATURE = 3
    CHOKED = 4
    FUEL = 5
    NO_BALANCE = 6
    UNEXPLAINED = 7
    INPUT = 8


MEANING = {
    Status.SOLVED: "solved",
    Status.OFF_MAP: "off a component map",
    Status.SURGE: "beyond surge",
    Status.TEMPERATURE: "temperature limit",
    Status.CHOKED: "exhaust exit choked",
    Status.FUEL: "needs no fuel",
    Status.NO_BALANCE: "no power balance",
    Status.UNEXPLAINED: "not converged",
    Status.INPUT: "input out of range",
}


@dataclass(frozen=True)
class OperatingPoint:
    """A solved steady point.

    Parameters
    ----------
    x, z, u, theta, y : packed vectors of the gas generator.
    values : outputs by name (SI).
    residual : re-evaluated max-norm of all equations, specifications included.
    iterations : Newton steps, over all continuation steps.
    """

    x: np.ndarray
    z: np.ndarray
    u: np.ndarray
    theta: np.ndarray
    y: np.ndarray
    values: dict[str, float]
    residual: float
    iterations: int

    def __getitem__(self, name: str) -> float:
        """Return an output by name."""
        return self.values[name]


class Refusal(OperatingPointError):  # noqa: N818 - reads as what it is
    """A steady point was refused.

    Attributes
    ----------
    status : the reason as a :class:`Status`.
    point : the refused point if it was solved, else the best point reached on the way; it solves
        the equations for other fixed values.  None if there is none.
    reached : share of the way from the design point, 1 if the point was solved.
    """

    status: Status = Status.UNEXPLAINED
    point: OperatingPoint | None = None
    reached: float = 0.0


@dataclass(frozen=True)
class TrimBatch:
    """Many points.

    Parameters
    ----------
    y : outputs, shape (len(names), n); NaN where no solution was found.
    names : outputs that were kept.
    w : cycle unknowns z, then N, Wf, PW, shape (14, n); NaN likewise.
    p : what was asked for: ambient, health, fixed values, shape (n_p, n).
    fixed : names of the fixed quantities.
    status : a :class:`Status` by point, shape (n,).  Points refused by a limit keep their values.
    residual : re-evaluated max-norm, shape (n,); inf where no solution was found.
    reached : share of the way from the design point that has solutions, shape (n,); 1 if solved.
    iterations : Newton steps, shape (n,), -1 where continuation was needed.
    shape : shape of the arrays that were given.
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
    _gg: GasGenerator = field(repr=False)
    _limits: Limits = field(repr=False)
    _stop: dict[int, tuple[np.ndarray, np.ndarray]] = field(repr=False)

    def __len__(self) -> int:
        """Return the number of points."""
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
            return _range_text(self._gg, self.p[:, i])
        y = _named(self._gg, *self._stop[i])
        if self.reached[i] >= 1.0:
            return _limit_text(self._gg, self._limits, y)
        return _stop_text(self._gg, self._limits, s, y, float(self.reached[i]))

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
        data["trim_residual"] = (dims, self.residual.reshape(shape), {"units": "1"})
        attrs = {"fixed": " ".join(self.fixed), "points": len(self)}
        return xr.Dataset(data, attrs=attrs)


# ------------------------------------------------------------------------------ solver objects


class _Solver:
    """The kernel of one engine and one pair of fixed quantities, in the backend in use."""

    def __init__(self, gg: GasGenerator, spec: tuple[str, str]) -> None:
        self.gg, self.kernel = gg, TrimKernel(gg.cycle, spec)
        self._digest = backend.recipe("trim", spec, gg.parameters, *_digest(gg))
        self._made: dict[tuple[str, str], Any] = {}
        self._callers: dict[Any, Any] = {}
        self.lock = threading.Lock()
        self.regular: bool | None = None

    def function(self, which: str, *, compile: bool) -> Any:
        mode = backend.backend_in_use()
        if mode == "vm":
            return getattr(self.kernel, which)
        if (which, "c") not in self._made:
            tried = (which, "load")
            if not compile and tried in self._made:
                return self._made[tried]
            f = backend.load_or_build(
                f"{self._digest} {which}", lambda: getattr(self.kernel, which),
                compile_missing=compile,
            )  # fmt: skip
            loaded = compile or f.is_a("External")
            self._made[(which, "c") if loaded else tried] = f
            return f
        return self._made[(which, "c")]

    def one(self, which: str, *args: np.ndarray) -> tuple[np.ndarray, ...]:
        """Evaluate for one point; safe to call from several threads."""
        with self.lock:
            f = self.function(which, compile=False)
            key = (which, f.__hash__())
            if key not in self._callers:
                self._callers[key] = backend.Caller(f)
            return self._callers[key](*args)

    def many(
        self, which: str, *args: np.ndarray, n_threads: int | None, compile: bool = True
    ) -> tuple[np.ndarray, ...]:
        """Evaluate for columns."""
        with self.lock:
            f = self.function(which, compile=compile)
            key = (which, f.__hash__(), n_threads)
            if key not in self._callers:
                self._callers[key] = backend.mapped(f, n_threads)
            return self._callers[key](*args)


@lru_cache(maxsize=64)
def _solver(gg: GasGenerator, spec: tuple[str, str]) -> _Solver:
    return _Solver(gg, spec)


def _digest(gg: GasGenerator) -> list[str]:
    """Tell the content of the maps, whose tables compare by identity."""

    def of(m: MapChoice) -> str:
        t = m.table
        h = hashlib.sha256(repr((m.N_map_des, m.beta_des, m.calibration, t.kind)).encode())
        for a in (t.N, t.beta, t.W, t.PR, t.eta, t.surge_W, t.surge_PR):
            h.update(b"-" if a is None else a.tobytes() + repr(a.shape).encode())
        return h.hexdigest()

    return [of(gg.compressor_map), of(gg.turbine_map)]


def _specify(
    gg: GasGenerator, fixed: Mapping[str, Any]
) -> tuple[tuple[str, str], list[Any], tuple[str, ...]]:
    """Check the fixed quantities; return the kernel's spec, its values, and the names."""
    names = tuple(sorted(fixed))
    if len(names) != 2:
        raise SignalError(f"a steady point needs two fixed quantities, got {len(names)}: {names}")
    spec, values = [], []
    for n in names:
        gg.Y.index(n)
        if n in GIVEN:
            raise SignalError(
                f"{n} cannot be fixed: the ambient or the equations give it; choose two of the "
                f"others, such as N, PW, Wf, T4, T5, P3"
            )
        v = fixed[n]
        if isinstance(v, LoadLaw):
            if n != "PW":
                raise SignalError(f"a load law fixes PW, not {n}")
            spec.append(LAW)
            values += [v.PW_ref, v.N_ref, v.exponent]
        else:
            spec.append(n)
            values.append(v)
    return (spec[0], spec[1]), values, names


# ------------------------------------------------------------------------------ one point


def trim_gas_generator(
    gg: GasGenerator,
    fixed: Mapping[str, float | LoadLaw],
    *,
    theta: Mapping[str, float] | None = None,
    limits: Any = None,  # Limits | None; callers spread dict[str, float] over ambient
    **ambient: float,
) -> OperatingPoint:
    """Solve a steady point of the gas generator.

    Parameters
    ----------
    fixed : two outputs by name with their values, SI: ``{"N": 3775, "PW": 5e5}``.  ``PW`` may be a
        :class:`LoadLaw`.
    theta : health factors by name, healthy by default.
    limits : beyond which a solved point is refused; :class:`Limits` by default.
    ambient : altitude (m), Mach, dT_isa (K), war (kg/kg).

    Raises
    ------
    SignalError : not two names, an unknown one, or two that do not determine a point together.
    Refusal : no such point, or beyond a limit; says what failed, by how much, and the best point
        reached.  It is an OperatingPointError.
    """
    limits = Limits() if limits is None else limits
    spec, values, names = _specify(gg, fixed)
    th = gg.THETA.pack(theta)
    u = gg.U.pack({"Wf": gg.design.values["Wf"], "PW": 0.0, **ambient})
    if u.ndim > 1 or th.ndim > 1:
        raise SignalError("one point takes numbers; for arrays use trim_batch")
    try:
        asked = np.array([float(v) for v in values])
    except (TypeError, ValueError):
        raise SignalError(f"fixed values must be numbers, got {dict(fixed)}") from None
    if not np.all(np.isfinite(asked)):
        raise SignalError(f"fixed values must be finite, got {dict(fixed)}")
    p = np.concatenate([u[2:], th, asked])
    problem = _range_text(gg, p)
    if problem:
        error = Refusal(problem)
        error.status = Status.INPUT
        raise error
    solver = _solver(gg, spec)
    w, y, r, _, count = solver.one("cold", p)
    residual, total, reached = _norm(r), round(float(count[0])), 1.0
    if residual > RESIDUAL_TOL:
        off = float(_off_speed(gg, spec, y))
        if off > limits.off_map:
            text = _speed_text(gg, y, off, limits)
            _refuse(gg, names, fixed, Status.OFF_MAP, text, None, 0.0)
        _require_regular(solver, names)
        w, y, r, s, reached, total = _continue(solver, limits, p)
        residual = _norm(r)
        if reached < 1.0:
            there = _named(gg, y, w)
            status = _stop_status(solver, limits, y[:, None], s[:, None], p, reached)
            text = _stop_text(gg, limits, status, there, reached)
            point = _point(gg, w, y, _mix(solver, p, reached), residual, total)
            _refuse(gg, names, fixed, status, text, point, reached)
    point = _point(gg, w, y, p, residual, total)
    text = _limit_text(gg, limits, _named(gg, y, w))
    if text:
        _refuse(gg, names, fixed, _limit_status(gg, limits, y[:, None])[0], text, point, 1.0)
    return point


def _named(gg: GasGenerator, y: np.ndarray, w: np.ndarray) -> dict[str, float]:
    """Outputs and map coordinates by name."""
    return gg.Y.unpack(y) | {"beta_c": float(w[NZ - 2]), "beta_t": float(w[NZ - 1])}


def _norm(r: np.ndarray) -> float:
    """Max-norm; infinite when anything is not a number."""
    v = float(np.abs(r).max())
    return v if math.isfinite(v) else math.inf


def _point(
    gg: GasGenerator, w: np.ndarray, y: np.ndarray, p: np.ndarray, residual: float, total: int
) -> OperatingPoint:
    u = np.concatenate([w[NZ + 1 :], p[: len(AMBIENT)]])
    theta = p[len(AMBIENT) : N_FIRST].copy()
    return OperatingPoint(
        w[NZ : NZ + 1], w[:NZ], u, theta, y, gg.Y.unpack(y), residual, total
    )  # fmt: skip


def _refuse(
    gg: GasGenerator,
    names: Sequence[str],
    fixed: Mapping[str, Any],
    status: Status,
    text: str,
    point: OperatingPoint | None,
    reached: float,
) -> None:
    asked = ", ".join(
        f"{n} = {v!r}" if isinstance(v := fixed[n], LoadLaw) else f"{n} = {v:.6g}" for n in names
    )
    best = ""
    if point is not None:
        label = "the point" if reached >= 1.0 else "best point"
        keys = ("N", "Wf", "PW", "T4", "SM", "n_c", "off_c")
        best = f"; {label} " + ", ".join(f"{k} = {point[k]:.6g}" for k in keys)
    error = Refusal(f"no steady point with {asked}: {text}{best}")
    error.status, error.point, error.reached = status, point, reached
    raise error


# ------------------------------------------------------------------------------ continuation


def _origin(solver: _Solver) -> tuple[np.ndarray, np.ndarray]:
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


@lru_cache(maxsize=16)
def _design_output(gg: GasGenerator) -> np.ndarray:
    k = TrimKernel(gg.cycle, ("N", "PW"))
    par, d = gg.parameters, gg.design
    z = [d.z.get(n, 0.0) for n in gg.z.names]
    z[-2:] = [gg.cycle.cmap.beta_des, gg.cycle.tmap.beta_des]
    u = [d.values["Wf"], k.PW_design, *(getattr(par, n) for n in AMBIENT)]
    return np.asarray(gg.equations(par.N, z, u, np.ones(len(gg.THETA)))[2]).ravel()


def _mix(solver: _Solver, p: np.ndarray, t: float) -> np.ndarray:
    origin, _ = _origin(solver)
    return origin + t * (p - origin)


def _continue(
    solver: _Solver, limits: Limits, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float, int]:
    """Move from the design point to p in adaptive steps; return w, y, r, s, share, iterations."""
    origin, s = _origin(solver)
    w, y, r, s, n = solver.one("warm", s, origin)
    total, t, dt = int(n[0]), 0.0, 0.25
    for floor in FLOORS:
        while t < 1.0 and dt >= floor:
            t_try = min(1.0, t + dt)
            trial = solver.one("warm", s, origin + t_try * (p - origin))
            total += round(float(trial[4][0]))
            if _norm(trial[2]) <= RESIDUAL_TOL:
                (w, y, r, s), t, dt = trial[:4], t_try, dt * 1.7
            else:
                dt /= 2
        if t >= 1.0 or _explained(solver.gg, limits, y[:, None])[0]:
            break
    return w, y, r, s, t, total


def _explained(gg: GasGenerator, limits: Limits, y: np.ndarray) -> np.ndarray:
    """Whether the outputs tell why the way ends there: a limit is broken, or a map left."""
    off = np.maximum(y[gg.Y.index("off_c")], y[gg.Y.index("off_t")]) > 0
    return off | (_limit_status(gg, limits, y) != Status.SOLVED)


def _continue_many(
    solver: _Solver, p: np.ndarray, *, floor: float, n_threads: int | None,
    state: tuple[np.ndarray, ...] | None = None,
) -> tuple[np.ndarray, ...]:  # fmt: skip
    """As :func:`_continue` for columns; returns w, y, r, s, t, dt."""
    origin, s0 = _origin(solver)
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
        good = _norms(trial[2]) <= RESIDUAL_TOL
        at = go[good]
        for mine, new in zip((w, y, r, s), trial, strict=False):
            mine[:, at] = new[:, good]
        t[at] = t_try[good]
        dt[at] *= 1.7
        dt[go[~good]] /= 2
    return w, y, r, s, t, dt


def _norms(r: np.ndarray) -> np.ndarray:
    v = np.abs(r).max(axis=0)
    return np.where(np.isfinite(v), v, np.inf)


def _fold(solver: _Solver, s: np.ndarray, p: np.ndarray) -> float:
    """Smallest singular value of the scaled Jacobian, relative to that at the design point."""
    origin, s0 = _origin(solver)
    return _sigma(solver, s, p) / max(_sigma(solver, s0, origin), 1e-300)


def _sigma(solver: _Solver, s: np.ndarray, p: np.ndarray) -> float:
    J = solver.kernel.jacobian(s, p).full()
    # rows to unit size: a row's scale says nothing about a fold
    J = J / np.maximum(np.abs(J).max(axis=1, keepdims=True), 1e-300)
    if not np.all(np.isfinite(J)):
        return 0.0
    return float(np.linalg.svd(J, compute_uv=False)[-1])


def _require_regular(solver: _Solver, names: Sequence[str]) -> None:
    """Refuse two quantities that say the same; asked only when a point was not found."""
    if solver.regular is None:
        origin, s0 = _origin(solver)
        solver.regular = _sigma(solver, s0, origin) > 1e-10
    if not solver.regular:
        raise SignalError(
            f"{' and '.join(names)} do not determine a point together: one follows from the other"
        )


# ------------------------------------------------------------------------------ reasons


def _limit_status(gg: GasGenerator, limits: Limits, y: np.ndarray) -> np.ndarray:
    """Return the first limit that each column of y breaks, SOLVED if none."""
    status = np.full(y.shape[1], Status.SOLVED, dtype=np.int8)
    for s, name, sign, limit in reversed(limits.rows(gg)):
        status[sign * (y[gg.Y.index(name)] - limit) > 0] = s
    return status


def _limit_text(gg: GasGenerator, limits: Limits, y: Mapping[str, float]) -> str:
    """Return the limits that a point breaks, with numbers."""
    out = []
    for s, name, sign, limit in limits.rows(gg):
        if name in y and sign * (y[name] - limit) > 0:
            out.append(_words(gg, s, name, y, limit))
    return "; ".join(out)


def _words(
    gg: GasGenerator, s: Status, name: str, y: Mapping[str, float], limit: float | None
) -> str:
    unit = gg.Y[name].unit
    unit = "" if unit == "1" else f" {unit}"
    bound = "" if limit is None else f", limit {limit:.5g}{unit}"
    if s == Status.OFF_MAP:
        which, n, beta = (
            ("compressor", "n_c", "beta_c") if name == "off_c" else ("turbine", "n_t", "beta_t")
        )
        choice = gg.compressor_map if name == "off_c" else gg.turbine_map
        speeds, betas = choice.table.N / choice.N_map_des, choice.table.beta
        return (
            f"off the {which} map by {y[name]:.3f} table spans{bound} "
            f"(relative corrected speed {y[n]:.4f}, table {speeds[0]:.3f} to {speeds[-1]:.3f}"
            + (
                f"; beta {y[beta]:.3f}, table {betas[0]:g} to {betas[-1]:g})"
                if math.isfinite(y.get(beta, math.nan))
                else ")"
            )
        )
    if s == Status.SURGE:
        return f"beyond surge: SM = {y[name]:.4f}{bound}"
    if s == Status.TEMPERATURE:
        return f"temperature limit: {name} = {y[name]:.1f}{unit}{bound}"
    if s == Status.CHOKED:
        return f"exhaust exit choked: Mach {y[name]:.3f} at station 8"
    return f"needs no fuel: Wf = {y[name]:.3g}{unit}{bound}"


def _off_speed(gg: GasGenerator, spec: tuple[str, str], y: np.ndarray) -> np.ndarray | float:
    """Distance of the corrected speed off the compressor table, in spans; it is known if N is."""
    if "N" not in spec:
        return 0.0 if y.ndim == 1 else np.zeros(y.shape[1])
    t = gg.compressor_map.table
    n = y[gg.Y.index("n_c")] * gg.compressor_map.N_map_des
    span = float(t.N[-1] - t.N[0])
    return np.maximum(0.0, np.maximum(n - t.N[-1], t.N[0] - n) / span)


def _speed_text(gg: GasGenerator, y: np.ndarray, off: float, limits: Limits) -> str:
    values = {**gg.Y.unpack(y), "off_c": off}
    return _words(gg, Status.OFF_MAP, "off_c", values, limits.off_map)


def _stop_status(
    solver: _Solver,
    limits: Limits,
    y: np.ndarray,
    s: np.ndarray,
    p: np.ndarray,
    reached: float,
) -> Status:
    """Say at what boundary the way from the design point ended."""
    gg = solver.gg
    broken = Status(int(_limit_status(gg, limits, y)[0]))
    if broken != Status.SOLVED:
        return broken
    v = y[:, 0]
    if max(v[gg.Y.index("off_c")], v[gg.Y.index("off_t")]) > 0:
        return Status.OFF_MAP
    if _fold(solver, s[:, 0], _mix(solver, p, reached)) < 0.2:
        return Status.NO_BALANCE
    return Status.UNEXPLAINED


def _stop_text(
    gg: GasGenerator, limits: Limits, s: Status, y: Mapping[str, float], reached: float
) -> str:
    """Return why the way from the design point ended where it did."""
    way = f"stopped at {100 * reached:.1f} % of the way from the design point"
    if s == Status.OFF_MAP and reached == 0.0:  # the given speed is off the table
        where = _words(gg, s, "off_c", y, limits.off_map)
        return f"{where}; no solution was found on the continued map"
    broken = _limit_text(gg, limits, y)
    if broken:
        return f"{broken}; {way}"
    if s == Status.OFF_MAP:
        name = "off_c" if y["off_c"] >= y["off_t"] else "off_t"
        return f"{_words(gg, s, name, y, None)}, where the continued map has no solution; {way}"
    if s == Status.NO_BALANCE:
        return (
            f"no power balance: the fixed quantities have an extreme value near the best point and "
            f"cannot be moved further; {way}"
        )
    return f"not converged, and no limit is near; {way}"


def _ranges(gg: GasGenerator) -> dict[str, tuple[float, float]]:
    return gg.input_ranges | {n: (0.3, 2.0) for n in gg.THETA.names}


def _range_text(gg: GasGenerator, p: np.ndarray) -> str:
    """Return which ambient input or health factor is out of range; "" if none."""
    names = (*AMBIENT, *gg.THETA.names)
    out = []
    for name, value in zip(names, p[:N_FIRST], strict=True):
        lo, hi = _ranges(gg)[name]
        if not lo <= value <= hi:
            unit = (gg.U if name in gg.U else gg.THETA)[name].unit
            out.append(f"{name} = {value:g} {unit} is outside [{lo:g}, {hi:g}]")
    if not out and not np.all(np.isfinite(p)):
        out.append("a fixed value is not finite")
    return "; ".join(out)


# ------------------------------------------------------------------------------ many points


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

    Parameters
    ----------
    fixed : two outputs by name: numbers or arrays.  ``PW`` may be a :class:`LoadLaw`.
    theta : health factors by name, numbers or arrays.
    limits : as in :func:`trim_gas_generator`.
    outputs : outputs to keep, all by default; fewer take less memory.
    n_threads : default all cores that the process may use.
    ambient : altitude (m), Mach, dT_isa (K), war (kg/kg), numbers or arrays.

    Arrays are broadcast against each other; results have their common shape.

    Raises
    ------
    SignalError : not two names, unknown names, names that do not determine a point together, or
        shapes that do not go together.
    """
    limits = Limits() if limits is None else limits
    spec, values, names = _specify(gg, fixed)
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
        arrays = [np.asarray(v, dtype=float) for v in (*given, *values)]
        shape = np.broadcast_shapes(*(a.shape for a in arrays))
    except (TypeError, ValueError) as e:
        raise SignalError(f"batch of {', '.join(names)}: {e}") from None
    M = math.prod(shape)
    p = np.empty((len(arrays), M))
    for k, a in enumerate(arrays):
        p[k] = np.broadcast_to(a, shape).reshape(-1)
    solver = _solver(gg, spec)
    out = _Arrays(len(keep), M)
    for k in range(0, M, CHUNK):
        _solve_chunk(solver, limits, p[:, k : k + CHUNK], rows, k, out, n_threads, M)
    return TrimBatch(
        out.y, keep, out.w, p, names, out.status, out.residual, out.reached, out.iterations, shape,
        gg, limits, out.stop,
    )  # fmt: skip


class _Arrays:
    """What a batch fills."""

    def __init__(self, n_y: int, M: int) -> None:
        self.y, self.w = np.full((n_y, M), np.nan), np.full((NZ + 3, M), np.nan)
        self.status = np.full(M, Status.INPUT, dtype=np.int8)
        self.residual, self.reached = np.full(M, np.inf), np.zeros(M)
        self.iterations = np.full(M, -1, dtype=np.int32)
        self.stop: dict[int, tuple[np.ndarray, np.ndarray]] = {}


def _solve_chunk(
    solver: _Solver, limits: Limits, p: np.ndarray, rows: list[int], first: int, out: _Arrays,
    n_threads: int | None, total: int,
) -> None:  # fmt: skip
    gg = solver.gg
    valid = np.all(np.isfinite(p), axis=0)
    for k, name in enumerate((*AMBIENT, *gg.THETA.names)):
        lo, hi = _ranges(gg)[name]
        valid &= (p[k] >= lo) & (p[k] <= hi)
    index = np.flatnonzero(valid)
    if not index.size:
        return
    p = p[:, index]
    compile = total >= COMPILE_FROM
    w, y, r, _s, count = solver.many("cold", p, n_threads=n_threads, compile=compile)
    residual, reached = _norms(r), np.ones(index.size)
    count = count[0].round().astype(np.int32)
    bad = residual > RESIDUAL_TOL
    # no continuation where the given speed is off the table: it finds next to nothing there
    beyond = np.asarray(_off_speed(gg, solver.kernel.spec, y))
    far = bad & (beyond > 0)
    status = np.full(index.size, Status.UNEXPLAINED, dtype=np.int8)
    status[far], reached[far] = Status.OFF_MAP, 0.0
    for j in np.flatnonzero(far):
        stop, nowhere = y[:, j].copy(), np.full(NZ + 3, np.nan)
        stop[gg.Y.index("off_c")] = beyond[j]
        out.stop[first + int(index[j])] = (stop, nowhere)
    lost = np.flatnonzero(bad & ~far)
    if lost.size:
        _require_regular(solver, solver.kernel.spec)
        q = p[:, lost]
        state = _continue_many(solver, q, floor=FLOORS[0], n_threads=n_threads)
        for floor in FLOORS[1:]:
            again = np.flatnonzero((state[4] < 1.0) & ~_explained(gg, limits, state[1]))
            if not again.size:
                break
            part = tuple(a[..., again] for a in state)
            finer = _continue_many(
                solver, q[:, again], floor=floor, n_threads=n_threads, state=part
            )
            for mine, new in zip(state, finer, strict=True):
                mine[..., again] = new
        w_l, y_l, r_l, s_l, t_l, _ = state
        for k, j in enumerate(lost):
            reached[j], count[j] = t_l[k], -1
            if t_l[k] >= 1.0:
                w[:, j], y[:, j], r[:, j] = w_l[:, k], y_l[:, k], r_l[:, k]
                residual[j] = _norm(r_l[:, k])
            else:
                one = slice(k, k + 1)
                status[j] = _stop_status(solver, limits, y_l[:, one], s_l[:, one], q[:, k], t_l[k])
                out.stop[first + int(index[j])] = (y_l[:, k].copy(), w_l[:, k].copy())
    solved = residual <= RESIDUAL_TOL
    status[solved] = _limit_status(gg, limits, y[:, solved])
    for j in np.flatnonzero(solved & (status != Status.SOLVED)):
        out.stop[first + int(index[j])] = (y[:, j].copy(), w[:, j].copy())
    at = first + index
    out.status[at], out.reached[at], out.iterations[at] = status, reached, count
    out.residual[at] = np.where(solved, residual, np.inf)
    out.y[:, at] = np.where(solved, y[rows], np.nan)
    out.w[:, at] = np.where(solved, w, np.nan)


# ------------------------------------------------------------------------------ maximum, deck


def maximum_power(
    gg: GasGenerator,
    *,
    N: float | None = None,
    T4_max: float | None = None,
    T5_max: float | None = None,
    theta: Mapping[str, float] | None = None,
    limits: Any = None,
    **ambient: float,
) -> OperatingPoint:
    """Return the point of highest shaft power at a speed within temperature limits.

    Parameters
    ----------
    N : speed, rad/s; design speed by default.
    T4_max, T5_max : temperatures, K, of which at least one is given; the lower power counts.
    theta, limits, ambient : as in :func:`trim_gas_generator`.

    Raises
    ------
    SignalError : no temperature given.
    Refusal : no such point, or the compressor would surge before.
    """
    N = gg.parameters.N if N is None else N
    given = {k: v for k, v in (("T4", T4_max), ("T5", T5_max)) if v is not None}
    if not given:
        raise SignalError("maximum power needs T4_max or T5_max, K")
    base = Limits() if limits is None else limits
    base = dataclasses.replace(base, T4_max=math.inf, T5_max=math.inf)
    points = [
        trim_gas_generator(gg, {"N": N, k: v}, theta=theta, limits=base, **ambient)
        for k, v in given.items()
    ]
    return min(points, key=lambda q: q["PW"])


def performance_deck(
    gg: GasGenerator,
    *,
    altitude: Sequence[float] | np.ndarray = (0.0,),
    Mach: Sequence[float] | np.ndarray = (0.0,),
    dT_isa: Sequence[float] | np.ndarray = (0.0,),
    PW: Sequence[float] | np.ndarray = (5e5,),
    N: float | None = None,
    theta: Mapping[str, float] | None = None,
    limits: Limits | None = None,
    outputs: Sequence[str] | None = None,
    n_threads: int | None = None,
) -> xr.Dataset:
    """Solve a grid of altitude, Mach number, ISA deviation and shaft power at one speed.

    Parameters
    ----------
    altitude (m), Mach, dT_isa (K), PW (W) : 1-D axes of the grid.
    N : speed, rad/s; design speed by default.
    theta, limits, outputs, n_threads : as in :func:`trim_batch`.

    Returns
    -------
    xarray dataset over the four axes: outputs (NaN where refused), ``status``, ``trim_residual``.
    """
    import xarray as xr

    axes = {"altitude": altitude, "Mach": Mach, "dT_isa": dT_isa, "PW": PW}
    grid = {k: np.atleast_1d(np.asarray(v, dtype=float)) for k, v in axes.items()}
    mesh = dict(zip(grid, np.meshgrid(*grid.values(), indexing="ij", sparse=True), strict=True))
    N = gg.parameters.N if N is None else N
    batch = trim_batch(
        gg, {"N": N, "PW": mesh.pop("PW")}, theta=theta, limits=limits, outputs=outputs,
        n_threads=n_threads, **mesh,
    )  # fmt: skip
    flat = batch.to_dataset()
    dims = tuple(grid)
    data = {
        name: (dims, v.values.reshape(batch.shape), v.attrs)
        for name, v in flat.data_vars.items()
        if name not in (*grid, *AMBIENT, *gg.THETA.names)
    }
    coords = {k: (k, v, {"units": (gg.U if k in gg.U else gg.Y)[k].unit}) for k, v in grid.items()}
    health = {n: float((theta or {}).get(n, 1.0)) for n in gg.THETA.names}
    return xr.Dataset(data, coords=coords, attrs={"N": N, **health})


HOT = (("N", "PW"), ("N", "Wf"), ("N", "T4"), ("N", "T5"), ("PW", "Wf"), (LAW, "Wf"))
"""Pairs worth compiling ahead of time, names sorted."""


def hot_functions(gg: GasGenerator | None = None) -> list[str]:
    """Compile the usual pairs of ``gg``, the default engine if None; return the names."""
    gg = GasGenerator() if gg is None else gg
    names = []
    for pair in HOT:
        solver = _solver(gg, pair)
        names += [solver.function(which, compile=True).name() for which in ("cold", "warm")]
    return names


def initialise(
    gg: GasGenerator,
    *,
    N: float,
    PW: float,
    theta: Mapping[str, float] | None = None,
    **ambient: float,
) -> GasGeneratorState:
    """Solve the steady start of Algorithm 2 (TransitionInitialize_I): which fuel holds N at PW?

    Raises
    ------
    OperatingPointError : no such steady point.
    """
    limits = Limits(T4_max=math.inf)  # hot is no reason not to start
    point = trim_gas_generator(gg, {"N": N, "PW": PW}, theta=theta, limits=limits, **ambient)
    return GasGeneratorState(point.x, point.z, point.u, point.theta)
