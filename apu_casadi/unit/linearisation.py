"""Linear models: A, B, C, D of any :class:`~apu_casadi.core.statespace.StateSpace` at any point.

    dx/dt ~ xdot0 + A (x - x0) + B_u (u - u0) + B_theta (theta - theta0)
    y     ~ y0    + C (x - x0) + D_u (u - u0) + D_theta (theta - theta0)

All matrices are derivatives of the model's own expressions by algorithmic differentiation;
algebraic unknowns are eliminated by the implicit function theorem, at the solved point.

The machine is linearised on the rotor's axes and averaged over an electrical period (see
:mod:`apu_casadi.unit.averaged`), where its steady state is a constant.  The column of the fault
severity h is the derivative at the healthy machine for period means; what a fault adds to it, a
ripple of torque and power at twice the electrical frequency (800 Hz), is of first order too but
has no mean, and no place in a linear model with constant coefficients.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.checked import array
from apu_casadi.core.errors import OperatingPointError, SignalError
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
from apu_casadi.machine.generator import Generator, GeneratorPoint
from apu_casadi.unit.apu import Apu, JointPoint
from apu_casadi.unit.assembled import assembled
from apu_casadi.unit.averaged import alike, averaged_point, generator_vectors
from apu_casadi.unit.events import who
from apu_casadi.unit.linearmodel import LinearModel
from apu_casadi.unit.periodiclinear import about_turn

RESIDUAL_TOL = 1e-6  # largest algebraic residual at which a linearisation is given


@kept
def _eliminated(ss: StateSpace, n: int) -> ca.Function:
    """(x, u, theta, c) -> xdot, y, alg, d(xdot, y)/d(x, u, theta), with one search for z in all.

    c are the parameters of ``ss`` from the n-th on: numbers of the unit.
    """
    sx = all(f.is_a("SXFunction") for f in (ss.f, ss.g, ss.z_of, ss.residual))
    sym = ca.SX if sx else ca.MX
    args: list[Any] = [
        sym.sym(label, m) for label, m in (("x", len(ss.x)), ("u", len(ss.u)), ("theta", n))
    ]
    c = sym.sym("c", len(ss.theta) - n)
    x, u, theta = args[0], args[1], ca.vertcat(args[2], c)
    # inlined, so that the search for z, which f, g and z_of each hold, is found to be the same
    xdot, y, z = (f.call([x, u, theta], True, False)[0] for f in (ss.f, ss.g, ss.z_of))
    alg = ss.residual.call([x, z, u, theta], True, False)[1]
    xdot, y, alg = ca.cse([xdot, y, alg])
    J = ca.densify(ca.jacobian(ca.vertcat(xdot, y), ca.vertcat(*args)))
    return ca.Function(f"{ss.name}_linear", [*args, c], [xdot, y, alg, J], {"cse": True})


@kept
def _explicit(equations: ca.Function, name: str, n: int) -> ca.Function:
    """(x, z, u, theta, c) -> xdot, y, alg, d(xdot, y, alg)/d(x, u, theta, z).

    c are the parameters of ``equations`` from the n-th on: numbers of the unit.
    """
    sizes = [equations.size1_in(i) for i in range(4)]
    x, z, u, theta = args = [
        ca.MX.sym(label, m)
        for label, m in zip(("x", "z", "u", "theta"), [*sizes[:3], n], strict=True)
    ]
    c = ca.MX.sym("c", sizes[3] - n)
    xdot, alg, y = equations(x, z, u, ca.vertcat(theta, c))
    J = ca.densify(ca.jacobian(ca.vertcat(xdot, y, alg), ca.vertcat(x, u, theta, z)))
    return ca.Function(f"{name}_linear_z", [*args, c], [xdot, y, alg, J])


def linearise(
    ss: StateSpace,
    x: Any,
    u: Any,
    theta: Any,
    *,
    equations: ca.Function | None = None,
    z: Any = None,
) -> LinearModel:
    """Linearise a model about a point, which need not be steady.

    The functions are built at the first call for a model, or another unit of its family, and kept.

    Args:
        ss: the model.
        x, u, theta: packed vectors, shapes (nx,), (nu,), (nt,), SI.
        equations, z: the same model, or its family, as Function (x, z, u, theta) -> (ode, alg, y),
            and its solved algebraic unknowns, shape (nz,); with both no search is made, which is
            faster.

    Raises:
        SignalError: a wrong shape, a value that is not finite, or one of equations and z alone.
        OperatingPointError: the algebraic equations are not solved there, or a derivative is not
            finite; names the equation or the entry.
    """
    if (equations is None) != (z is None):
        raise SignalError(f"{ss.name}: give equations and z together, or neither")
    x0, u0, theta0 = (
        _vector(ss, label, signals, value)
        for label, signals, value in (("x", ss.x, x), ("u", ss.u, u), ("theta", ss.theta, theta))
    )
    nt, numbers = len(ss.theta), np.array(ss.numbers)
    if equations is None:
        made = _eliminated(ss if ss.family is None else ss.family, nt)
        out = made(x0, u0, theta0, numbers)
    else:
        of_family = equations.size1_in(3) > nt
        made = _explicit(equations, ss.name, nt)
        z0 = _vector(ss, "z", ss.z, z)
        out = made(x0, z0, u0, theta0, numbers if of_family else np.zeros(0))
    xdot, y, alg = (o.full().reshape(-1) for o in out[:3])
    J = out[3].full()
    nx, nu, ny = len(ss.x), len(ss.u), len(ss.y)

    def at() -> str:
        given = {**ss.x.unpack(x0), **ss.u.unpack(u0), **ss.theta.unpack(theta0)}
        return ", ".join(f"{n} = {v:.6g}" for n, v in given.items())

    if alg.size and not np.abs(alg).max() <= RESIDUAL_TOL:
        worst = int(np.argmax(np.where(np.isfinite(alg), np.abs(alg), np.inf)))
        raise OperatingPointError(
            f"{ss.name}: algebraic equation {worst + 1} of {alg.size} left a residual of "
            f"{alg[worst]:.1e} (largest allowed {RESIDUAL_TOL:.0e}) at {at()}; linearise at a "
            "trimmed point, on the maps"
        )
    if equations is not None:  # 0 = alg gives dz = -alg_z^-1 alg_w dw
        n = nx + nu + nt
        try:
            dz = -np.linalg.solve(J[nx + ny :, n:], J[nx + ny :, :n])
        except np.linalg.LinAlgError:
            raise OperatingPointError(
                f"{ss.name}: the algebraic equations are singular at {at()}"
            ) from None
        J = J[: nx + ny, :n] + J[: nx + ny, n:] @ dz
    if not np.all(np.isfinite(J)):
        i, j = (int(k) for k in np.argwhere(~np.isfinite(J))[0])
        rows = [*(f"{n}_dot" for n in ss.x.names), *ss.y.names]
        columns = [*ss.x.names, *ss.u.names, *ss.theta.names]
        raise OperatingPointError(f"{ss.name}: d {rows[i]}/d {columns[j]} is not finite at {at()}")
    cut = (nx, nx + nu)
    (A, B_u, B_theta), (C, D_u, D_theta) = (
        np.split(part, cut, axis=1) for part in (J[:nx], J[nx:])
    )
    signals, point = (ss.x, ss.u, ss.theta, ss.y), (x0, u0, theta0, y, xdot)
    return LinearModel(ss.name, *signals, A, B_u, B_theta, C, D_u, D_theta, *point)


def _vector(ss: StateSpace, label: str, signals: Signals, value: Any) -> np.ndarray:
    a = array(f"{ss.name}: {label}", value).reshape(-1)
    if a.shape != (len(signals),):
        raise SignalError(
            f"{ss.name}: {label} must have shape ({len(signals)},) for {signals!r}, got "
            f"{np.shape(value)}"
        )
    if not np.all(np.isfinite(a)):
        bad = [n for n, v in zip(signals.names, a, strict=True) if not math.isfinite(v)]
        raise SignalError(f"{ss.name}: {label} is not finite in {', '.join(bad)}")
    return a


def linearise_gas_generator(gg: GasGenerator, point: OperatingPoint) -> LinearModel:
    """Linearise the gas generator at a trimmed point; theta holds the health factors.

    Without a governor: its one state is the rotor speed, its inputs fuel flow, shaft power and
    ambient conditions.
    """
    return linearise(
        gg.state_space, point.x, point.u, point.theta, equations=gg.family.equations, z=point.z
    )


def linearise_generator(gen: Generator, point: GeneratorPoint) -> LinearModel:
    """Linearise one generator with exciter and load at a steady point.

    On the rotor's axes.  Healthy under a balanced load it is averaged over an electrical period
    (:mod:`apu_casadi.unit.averaged`); theta holds h where the load has no inductance and the
    neutral is grounded.  With a fault or an unbalanced load it is that of means over a turn
    (:mod:`apu_casadi.unit.periodiclinear`); theta holds the numbers of the fault.  The rotor angle,
    which nothing depends on there, is left out with its eigenvalue zero.
    """
    if not point.balanced:
        return about_turn(point)
    return linearise(*generator_vectors(gen, point))


def linearise_joint(
    apu: Apu, point: JointPoint, free: Sequence[str] = (), *, apart: bool = False
) -> LinearModel:
    """Linearise the whole governed unit at a steady point; theta holds health factors and h.

    Coupled by (1)-(3) with the power of every instant, not with the exchange of 20 ms.  Generators
    that differ have signals of their own, ``generator2.V_ref``; equal ones are one.

    Where a generator has a fault or an unbalanced load, the unit is put together of the linear
    models of its parts (:func:`linearise_generator`); the shaft sees the mean of the power over a
    turn.

    Args:
        apu, point: unit and point.
        free: parameters of the unit by name (``machine.r_s``, ``gas_generator.eta_c``) that theta
            holds as well; not with a fault.
        apart: give equal generators signals of their own, too: what one of them does alone.

    Raises:
        SignalError: unknown parameters, or some on which nothing depends; some with a fault.
    """
    numbers = range(1, len(apu.machines) + 1)
    if all(point.of(k).balanced for k in numbers):
        at = averaged_point(apu, point, tuple(free), apart=apart)
        return linearise(at.ss, at.x, at.u, at.theta, equations=at.equations, z=at.z)
    if free:
        ill = who([k for k in numbers if not point.of(k).balanced])
        raise SignalError(
            f"derivatives by {', '.join(free)} are those of a balanced, healthy unit; {ill} has a "
            "fault or an unbalanced load: change the parameter and compare two models instead"
        )
    gens = {
        group: linearise_generator(apu.generators[group[0] - 1], point.of(group[0]))
        for group in alike(apu, point, apart=apart)
    }
    return assembled(apu, point, linearise_gas_generator(apu.gas_generator, point.gas), gens)
