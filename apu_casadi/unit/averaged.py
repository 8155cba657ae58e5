"""The averaged models: what generator and unit do from one electrical period to the next.

Under a balanced load nothing in the rotor's frame depends on the rotor angle, so the healthy
machine is the same model with the angle left out.  A turn-to-turn short circuit brings the angle
back: on the rotor's axes the shunt that it is seen as from outside (see
:mod:`apu_casadi.machine.faults.ttsc`) has a constant part and one that turns at twice the
electrical frequency, 800 Hz, and it drives the zero sequence at 400 Hz.  Here the generator's own
equations are averaged over one turn of the angle with the state held, which keeps the constant
part.

To first order in the severity h this is not an approximation: about a healthy steady state the
response to the two alternating parts alternates as well, and its mean over a period is zero.
So derivatives by h at h = 0 are exact for period means.  At finite h the mean of the alternating
part's square, of order h^2, is missing: simulate the generator itself then.

Beside it is the unit: gas generator, averaged generators and governor coupled by (1)-(3) at every
instant, for linearisation and for control design.  Between the 20 ms exchanges of
:mod:`apu_casadi.unit.multirate` and the full model of :mod:`apu_casadi.unit.monolithic` it is a
third, which has no 400 Hz in it: it alone has a constant steady state, and so eigenvalues, with
load and machine.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import SignalError
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.machine.generator import Generator, GeneratorPoint, load_of_kind
from apu_casadi.machine.generatormodel import DRIVES
from apu_casadi.machine.park import Abc, abc_to_qd0
from apu_casadi.unit.apu import Apu, JointPoint, groups
from apu_casadi.unit.exchange import coupled
from apu_casadi.unit.jointfamily import N_REF, Group, JointFamily, grouped

# The angle enters f and g, and their derivatives by h at h = 0, through its first and second
# harmonics only; six equally spaced angles average all but the multiples of the sixth to zero.
_ANGLES = 6

_H = "severity mu/(k_rf + 1 - mu) of a TTSC of one phase with kappa = mu"
_SEVERITY = Signals([Signal("h", "1", _H, default=0.0, nominal=0.01)])

KEPT = ["V_fd", "i_fd", "i_kd", "i_kq", "E_fd", "V_t", "T_e", "P_e", "P_loss_fault", "P_total"]
AXES = Signals(
    [
        Signal("v_q", "V", "terminal voltage, q axis", nominal=300.0),
        Signal("v_d", "V", "terminal voltage, d axis", nominal=300.0),
        Signal("i_q", "A", "terminal current, q axis", nominal=300.0),
        Signal("i_d", "A", "terminal current, d axis", nominal=300.0),
        Signal("I_t", "A", "terminal current: rms of the space vector", nominal=300.0),
    ]
)


def current(i_q: Any, i_d: Any) -> Any:
    """Return the terminal current ``I_t``, A, from those on the rotor's axes."""
    tiny = 1e-6  # A; keeps the square root smooth for an open generator
    return ca.sqrt((i_q**2 + i_d**2 + tiny**2) / 2)


def has_severity(gen: Generator, load_kind: str) -> bool:
    """Tell whether the averaged model has the parameter h.

    It has where the current of a fault with kappa = mu follows its voltage at once: grounded
    neutral, no inductance in the load.  Elsewhere that current is a state of its own, whose time
    constant vanishes with h, and there is no derivative by h at h = 0 at the instant of a step.
    """
    return gen.neutral == "grounded" and not load_of_kind(load_kind).inductive("a")


def _by_phase(load_kind: str) -> tuple[str, ...]:
    """Return the names of a load's inputs that have a value for each phase, without ``_a``."""
    names = [s.name for s in load_of_kind(load_kind).own.inputs]
    return tuple(n[:-2] for n in names if n.endswith("_a") and f"{n[:-2]}_c" in names)


def _balanced_inputs(load_kind: str) -> Signals:
    """Inputs of the averaged model: one value for all three phases."""
    kept: list[Signal] = list(DRIVES)
    for s in load_of_kind(load_kind).own.inputs:
        base, phase = s.name[:-2], s.name[-2:]
        if base not in _by_phase(load_kind):
            kept.append(s)
        elif phase == "_a":
            doc = s.doc.replace(", phase a", " of each phase")
            kept.append(dataclasses.replace(s, name=base, doc=doc))
    return Signals(kept)


@kept
def averaged_generator(gen: Generator, load_kind: str = "resistive") -> StateSpace:
    """Return one generator, averaged over an electrical period, under a balanced load.

    It is one of a family, whose theta has the parameters of machine and exciter behind it.

    States are the generator's without the rotor angle; inputs w_r, V_ref and the load's, one value
    for all phases; theta is the severity h where :func:`has_severity`, else empty; outputs
    are field, magnitudes, power, torque and the voltages and currents on the rotor's axes.

    Args:
        gen: the generator.
        load_kind: kind of a load of ``LOADS``, as ``"resistive"``.
    """
    full = gen.state_space(load_kind, "coupled" if has_severity(gen, load_kind) else None)
    assert full.family is not None
    family = _all_generators(full.family, load_kind, gen.neutral, len(full.theta))
    own = Signals(family.theta[: len(family.theta) - len(full.numbers)])
    return StateSpace.member(family.name, family, own, full.numbers)


@kept
def _all_generators(full: StateSpace, load_kind: str, neutral: str, n_fault: int) -> StateSpace:
    """The averaged model of all generators, theta with their numbers.

    Args:
        full: the generator's family.
        load_kind, neutral: its load and neutral.
        n_fault: number of its parameters that are those of a fault.
    """
    faulty, numbers = n_fault > 0, Signals(full.theta[n_fault:])
    X = Signals([s for s in full.x if s.name != "theta_e"])
    U, TH = _balanced_inputs(load_kind), _SEVERITY if faulty else Signals()
    Y = Signals([*(full.y[n] for n in KEPT), *AXES])
    (xv, x), (uv, u), (tv, th) = X.sx(), U.sx(), TH.sx()
    pv = ca.SX.sym("numbers", len(numbers))

    inputs = dict.fromkeys(full.u.names, ca.SX(0))
    inputs |= {n: u[n] for n in U.names if n in full.u}
    inputs |= {f"{n}_{k}": u[n] for n in _by_phase(load_kind) for k in "abc"}
    u_full = full.u.stack(inputs)
    fault = ca.SX(0, 1)
    if faulty:  # with k_rf = 0, h = mu/(1 - mu); only h matters if kappa = mu
        values = {"mu": th["h"] / (1 + th["h"]), "k_rf": ca.SX(0), "phase_angle": ca.SX(0)}
        fault = Signals(full.theta[:n_fault]).stack(values)
    theta = ca.vertcat(fault, pv)
    angles = 2 * math.pi * np.arange(_ANGLES) / _ANGLES if faulty else np.zeros(1)
    rate: Any = 0
    mean: dict[str, Any] = dict.fromkeys([*KEPT, "v_q", "v_d", "i_q", "i_d"], ca.SX(0))
    for angle in angles:
        x_full = full.x.stack({**x, "theta_e": ca.SX(float(angle))})
        rate += full.f(x_full, u_full, theta) / angles.size
        y = full.y.unpack(full.g(x_full, u_full, theta))
        for a in "vi":
            on_axes = abc_to_qd0(float(angle), Abc(*(y[f"{a}_{k}"] for k in "abc")))
            y |= {f"{a}_q": on_axes.q, f"{a}_d": on_axes.d}
        for n in mean:
            mean[n] += y[n] / angles.size
    mean["I_t"] = current(mean["i_q"], mean["i_d"])
    rates = full.x.unpack(rate)
    f, g = X.stack({n: rates[n] for n in X.names}), Y.stack(mean)

    name = f"averaged_generator_{load_kind}" + ("" if neutral == "grounded" else "_isolated")
    signals = X, Signals(), U, TH + numbers, Y
    symbols = xv, ca.SX.sym("z", 0), uv, ca.vertcat(tv, pv)
    none = ca.SX(0, 1)
    return StateSpace.of(name, signals, symbols, dae=(f, none), f=f, g=g, z=none, cse=True)


def load_kind(point: GeneratorPoint) -> str:
    """Return the kind of load of a steady point."""
    assert point.ss.load is not None
    return point.ss.load.kind


def generator_vectors(
    gen: Generator, point: GeneratorPoint
) -> tuple[StateSpace, np.ndarray, np.ndarray, np.ndarray]:
    """Return the averaged generator of a steady point, and x, u, theta (healthy) there.

    Raises:
        SignalError: the point's load is not balanced, or it has a fault.
    """
    u_full = point.ss.u.unpack(point.u)
    ss = averaged_generator(gen, load_kind(point))
    x_full = point.ss.x.unpack(point.x)
    values = {n: u_full[n] for n in ss.u.names if n in u_full}
    for n in _by_phase(load_kind(point)):
        phases = [u_full[f"{n}_{k}"] for k in "abc"]
        if not np.allclose(phases, phases[0], rtol=1e-9, atol=0):
            raise SignalError(
                f"the averaged generator needs a balanced load, got {n} = "
                f"{', '.join(f'{p:g}' for p in phases)} {ss.u[n].unit} in phases a, b, c"
            )
        values[n] = phases[0]
    if not point.balanced:
        raise SignalError("the averaged generator needs a healthy steady point, without a fault")
    x = ss.x.pack({n: x_full[n] for n in ss.x.names})
    return ss, x, ss.u.pack(values), np.zeros(len(ss.theta))


def _joint(parts: JointFamily, kinds: str) -> tuple[ca.Function, StateSpace]:
    """Return the equations (x, z, u, theta) -> (ode, alg, y) of all units, and their model."""
    gg, own, engines = GasGenerator, parts.groups, parts.engines
    X = Signals([*gg.X, *parts.governor.X, *(s for g in own for s in g.own(g.gen.x))])
    fed = [s for g in own for s in g.own(s for s in g.gen.u if s.name != "w_r")]
    U = Signals([*(gg.U[n] for n in AMBIENT), N_REF, *fed])
    TH, Y = parts.theta, Signals([*gg.Y, *(s for g in own for s in g.own(g.gen.y))])
    names = ["x", "z", "u", "theta"]
    x, z, u, theta = (ca.MX.sym(n, len(s)) for n, s in zip(names, (X, parts.z, U, TH), strict=True))
    sizes = [1, len(parts.governor.X), *(len(g.gen.x) for g in own)]
    N, x_gov, *x_gen = ca.vertsplit(x, np.cumsum([0, *sizes]).tolist())
    inputs = dict(zip(U.names, ca.vertsplit(u), strict=True))
    shaft = parts.shaft(theta, inputs["N_ref"])
    machines = parts.driven(shaft, theta, x_gen, inputs)
    u_gg, rates, y_gen = coupled(shaft, machines, N=N, x=x_gov, day=inputs)
    of_engine = parts.engine(theta)
    N_dot, alg, y_gg = engines.equations(N, z, u_gg, of_engine)
    name, out = f"joint_averaged_{kinds}", [ca.vertcat(N_dot, rates), alg]
    args, out = [x, z, u, theta], [*out, ca.vertcat(y_gg, *y_gen)]
    equations = ca.Function(f"{name}_equations", args, out, names, ["ode", "alg", "y"])
    start = engines.start(N, u_gg, of_engine)
    found = engines.solve(start, N, u_gg, of_engine)
    z_sol = ca.Function(f"{name}_z", [x, u, theta], [found])(x, u, theta)
    ode, alg, _ = equations(x, z, u, theta)
    f, _, y = equations(x, z_sol, u, theta)
    signals, symbols = (X, parts.z, U, TH, Y), (x, z, u, theta)
    return equations, StateSpace.of(name, signals, symbols, dae=(ode, alg), f=f, g=y, z=z_sol)


def _groups(
    apu: Apu, load_kind: str | tuple[str, ...], of: tuple[tuple[int, ...], ...] | None
) -> tuple[tuple[Group, ...], str]:
    """Return the groups of equal generators, each with its averaged model, and their loads."""
    kinds = apu.each("load_kind", load_kind)
    of = tuple(groups(zip(apu.machines, kinds, strict=True))) if of is None else of
    gens = {k: averaged_generator(apu.generators[k[0] - 1], kinds[k[0] - 1]) for k in of}
    return grouped(apu, of, gens), "_".join(kinds[k[0] - 1] for k in of)


class _Family(NamedTuple):
    """All units of a structure: their groups, parts, equations (:func:`_joint`), and model."""

    own: tuple[Group, ...]
    parts: JointFamily
    equations: ca.Function
    model: StateSpace


def _family(
    apu: Apu,
    load_kind: str | tuple[str, ...],
    free: tuple[str, ...],
    of: tuple[tuple[int, ...], ...] | None,
) -> _Family:
    own, name = _groups(apu, load_kind, of)
    parts = JointFamily.of(apu, own, free)
    return _Family(own, parts, *parts.keep((_joint, name), lambda: _joint(parts, name)))


@kept
def joint_equations(
    apu: Apu,
    load_kind: str | tuple[str, ...] = "resistive",
    free: tuple[str, ...] = (),
    of: tuple[tuple[int, ...], ...] | None = None,
) -> ca.Function:
    """Return the family of :func:`joint_averaged` as Function (x, z, u, theta) -> (ode, alg, y)."""
    _, parts, equations, _ = _family(apu, load_kind, free, of)
    if not free:
        return equations
    names = joint_averaged(apu, load_kind, free, of).shared.theta

    def reordered() -> ca.Function:
        x, z, u, theta = (ca.MX.sym(n, equations.size1_in(i)) for i, n in enumerate("xzut"))
        out = equations(x, z, u, theta[names.indices(parts.theta.names)])
        return ca.Function(equations.name(), [x, z, u, theta], out)

    return parts.keep((joint_equations, free), reordered)


@kept
def joint_averaged(
    apu: Apu,
    load_kind: str | tuple[str, ...] = "resistive",
    free: tuple[str, ...] = (),
    of: tuple[tuple[int, ...], ...] | None = None,
) -> StateSpace:
    """Return the whole unit with averaged generators, continuous in time.

    States are the rotor speed N, those of the governor (Wf_I) and those of the averaged
    generators; inputs the ambient conditions, N_ref, and V_ref and load of each generator; theta
    the health factors and h; outputs those of all models.  Shaft power is that of the very instant,
    (1), and the generators' speed too, (2): nothing is exchanged and nothing held.

    Generators of equal model, gear, load and severity are computed once.  Where all are equal they
    have one set of signals, ``V_ref``, ``h``: a change of it is one of each of them.  Else there is
    one for each group, behind the number of its first: ``generator2.V_ref``.

    Args:
        apu: the unit.
        load_kind: kind of a load of ``LOADS``, as ``"resistive"``; or one for each generator.
        free: parameters of the unit by name (``machine.r_s``, ``gas_generator.eta_c``) that theta
            has too, behind h.
        of: numbers of the generators of each group; by default those of equal model and kind.

    Raises:
        SignalError: unknown parameters, or some on which nothing depends.
    """
    own, parts, _, family = _family(apu, load_kind, free, of)
    return parts.member(apu, own, family, free)


def alike(apu: Apu, point: JointPoint, *, apart: bool = False) -> tuple[tuple[int, ...], ...]:
    """Return the numbers of the generators of each group: equal ones at one point.

    ``apart`` keeps equal ones apart, too.
    """
    each = enumerate(apu.machines, 1)
    return tuple(groups((m, k if apart else id(point.of(k))) for k, m in each))


class AveragedPoint(NamedTuple):
    """The averaged unit at a steady point.

    Args:
        ss, equations: model, and that of its family as a function of (x, z, u, theta).
        x, z, u, theta: there.
    """

    ss: StateSpace
    equations: ca.Function
    x: np.ndarray
    z: np.ndarray
    u: np.ndarray
    theta: np.ndarray


def averaged_point(
    apu: Apu, point: JointPoint, free: tuple[str, ...] = (), *, apart: bool = False
) -> AveragedPoint:
    """Return the averaged unit at a steady point (:meth:`Apu.steady_state`).

    Args:
        free: parameters that theta has too, see :func:`joint_averaged`.
        apart: whether generators that are equal have signals of their own all the same.

    Raises:
        SignalError: a load is not balanced, or a generator has a fault.
    """
    at, gas = [point.of(k + 1) for k in range(len(apu.machines))], point.gas
    how = tuple(load_kind(p) for p in at), free, alike(apu, point, apart=apart)
    ss, equations = joint_averaged(apu, *how), joint_equations(apu, *how)
    given = GasGenerator.U.unpack(gas.u)
    values = {**{n: given[n] for n in AMBIENT}, "N_ref": float(gas["N"])}
    own, healthy = [], []
    for group in _groups(apu, how[0], how[2])[0]:
        k = group.numbers[0] - 1
        gen, x_gen, u_gen, h = generator_vectors(apu.generators[k], at[k])
        values |= group.named({n: v for n, v in gen.u.unpack(u_gen).items() if n != "w_r"})
        own.append(x_gen)
        healthy.append(h)
    x = np.concatenate([gas.x, apu.governor.start(gas["Wf"]), *own])
    more = [s.default for s in ss.theta[ss.theta.index(free[0]) :]] if free else []
    theta = np.concatenate([gas.theta, *healthy, more])
    return AveragedPoint(ss, equations, x, gas.z, ss.u.pack(values), theta)


def joint_vectors(
    apu: Apu, point: JointPoint, free: tuple[str, ...] = (), *, apart: bool = False
) -> tuple[StateSpace, np.ndarray, np.ndarray, np.ndarray]:
    """Return the averaged unit of a steady point, and x, u, theta there.

    Arguments and errors as of :func:`averaged_point`.
    """
    at = averaged_point(apu, point, free, apart=apart)
    return at.ss, at.x, at.u, at.theta
