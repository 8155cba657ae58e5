"""Steady operating points: fix any two quantities, get everything else, or the reason why not.

The cycle equations and the power balance leave two degrees of freedom; a trim fixes two outputs
by name (speed and shaft power, speed and T4, fuel flow and a load law, ...), for any altitude, Mach
number, ISA deviation, humidity and health.  Nobody guesses: Newton's method starts by similarity
with the design point; where that fails, everything is moved there from the design point in steps
(continuation).  What ends within the step limit is judged by the residual, evaluated again; what
lies beyond a limit, or does not exist, is refused with its reason and the best point reached.

Some pairs have two solutions: shaft power and fuel flow meet at two speeds where efficiency has a
maximum between them.  The answer is the one on the design point's side of that maximum, and it
holds the other one as ``second`` (:mod:`apu_casadi.gaspath.steady.trimbranch`).

:func:`trim_gas_generator` solves one point, :func:`maximum_power` one at a temperature limit; for
many points see :mod:`apu_casadi.gaspath.steady.trimbatch`.  What is asked and answered, and the
solver, are in :mod:`apu_casadi.gaspath.steady.steadypoint` and
:mod:`apu_casadi.gaspath.steady.trimsolver`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from apu_casadi.core.checked import number
from apu_casadi.core.errors import SignalError
from apu_casadi.core.profiles.profile import fixed as still
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator, GasGeneratorState
from apu_casadi.gaspath.steady.steadypoint import (
    Limits,
    LoadLaw,
    OperatingPoint,
    Refusal,
    Status,
    limit_status,
    limit_text,
    named,
    off_speed,
    range_text,
    specify,
    speed_text,
    stop_text,
)
from apu_casadi.gaspath.steady.trimbranch import Roots, may_fold, settle
from apu_casadi.gaspath.steady.trimkernel import N_FIRST, NZ
from apu_casadi.gaspath.steady.trimsolver import (
    continue_one,
    norm,
    on_the_way,
    require_regular,
    solver_of,
    stop_status,
)

__all__ = ["initialise", "maximum_power", "trim_gas_generator"]


def trim_gas_generator(
    gg: GasGenerator,
    fixed: Mapping[str, float | LoadLaw],
    *,
    theta: Mapping[str, float] | None = None,
    limits: Any = None,  # Limits | None; callers spread dict[str, float] over ambient
    **ambient: float,
) -> OperatingPoint:
    """Solve a steady point of the gas generator.

    Args:
        fixed: two outputs by name with their values, SI: ``{"N": 3775, "PW": 5e5}``.  ``PW`` may be
            a :class:`LoadLaw`.
        theta: health factors by name, healthy by default.
        limits: beyond which a solved point is refused; :class:`Limits` by default.
        ambient: altitude (m), Mach, dT_isa (K), war (kg/kg); the default day where not given
            (:mod:`apu_casadi.gaspath.conditions`).

    Raises:
        SignalError: not two names, an unknown one, or two that do not determine a point together.
        ScenarioError: a value that changes in time.
        Refusal: no such point, or beyond a limit; says what failed, by how much, and the best point
            reached.  It is an OperatingPointError.
    """
    limits = Limits() if limits is None else limits
    for n, v in {**fixed, **(theta or {}), **ambient}.items():
        still(v, n, "a steady state")
    try:
        fixed = {
            n: v if isinstance(v, LoadLaw) else number(f"fixed {n}", v) for n, v in fixed.items()
        }
    except SignalError as e:
        raise SignalError(f"{e}; fixed values must be numbers") from None
    spec, values, names = specify(gg, fixed)
    th = gg.THETA.pack(theta)
    u = gg.U.pack({"Wf": gg.design.values["Wf"], "PW": 0.0, **ambient})
    if u.ndim > 1 or th.ndim > 1:
        raise SignalError("one point takes numbers; for arrays use trim_batch")
    asked = np.array([float(v) for v in values])
    if not np.all(np.isfinite(asked)):
        raise SignalError(f"fixed values must be finite, got {dict(fixed)}")
    p = np.concatenate([u[2:], th, asked])
    problem = range_text(gg, p)
    if problem:
        error = Refusal(problem)
        error.status = Status.INPUT
        raise error
    solver = solver_of(gg, spec)
    w, y, r, _, count = solver.one("cold", p)
    residual, total, reached = norm(r), round(float(count[0])), 1.0
    if residual > RESIDUAL_TOL:
        off = float(off_speed(gg, spec, y))
        if off > limits.off_map:
            text = speed_text(gg, y, off, limits)
            _refuse(gg, names, fixed, Status.OFF_MAP, text, None, 0.0)
        require_regular(solver, names)
        w, y, r, s, reached, total = continue_one(solver, limits, p)
        residual = norm(r)
        if reached < 1.0:
            there = named(gg, y, w)
            status = stop_status(solver, limits, y[:, None], s[:, None], p, reached)
            text = stop_text(gg, limits, status, there, reached)
            point = _point(gg, w, y, on_the_way(solver, p, reached), residual, total)
            _refuse(gg, names, fixed, status, text, point, reached)
    second = None
    if may_fold(spec):
        one = Roots(w[:, None], y[:, None], np.array([residual]))
        first, other = settle(solver, limits, one, p[:, None])
        w, y, residual = first.w[:, 0], first.y[:, 0], float(first.residual[0])
        if np.isfinite(other.residual[0]):
            second = _point(gg, other.w[:, 0], other.y[:, 0], p, float(other.residual[0]), 0)
    point = dataclasses.replace(_point(gg, w, y, p, residual, total), second=second)
    text = limit_text(gg, limits, named(gg, y, w))
    if text:
        _refuse(gg, names, fixed, limit_status(gg, limits, y[:, None])[0], text, point, 1.0)
    return point


def _point(
    gg: GasGenerator, w: np.ndarray, y: np.ndarray, p: np.ndarray, residual: float, total: int
) -> OperatingPoint:
    u = np.concatenate([w[NZ + 1 :], p[: len(AMBIENT)]])
    x, z, theta = w[NZ : NZ + 1], w[:NZ], p[len(AMBIENT) : N_FIRST].copy()
    return OperatingPoint(x, z, u, theta, y, gg.Y.unpack(y), residual, total)


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

    Args:
        N: speed, rad/s; design speed by default.
        T4_max, T5_max: temperatures, K, of which at least one is given; the lower power counts.
        theta, limits, ambient: as in :func:`trim_gas_generator`.

    Raises:
        SignalError: no temperature given.
        Refusal: no such point, or the compressor would surge before.
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


def initialise(
    gg: GasGenerator,
    *,
    N: float,
    PW: float,
    theta: Mapping[str, float] | None = None,
    **ambient: float,
) -> GasGeneratorState:
    """Solve the steady start of Algorithm 2 (TransitionInitialize_I): which fuel holds N at PW?

    Raises:
        OperatingPointError: no such steady point.
    """
    limits = Limits(T4_max=math.inf)  # hot is no reason not to start
    point = trim_gas_generator(gg, {"N": N, "PW": PW}, theta=theta, limits=limits, **ambient)
    return GasGeneratorState(point.x, point.z, point.u, point.theta)
