"""The functions that ``apu export c`` offers, each with names, units and values to start with.

One function here is one entry of :data:`FUNCTIONS`: what it returns is written by
:mod:`scenarios.export.ccode`.  The numbers of a unit are an argument of each function, and the
unit's own ones a constant array beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.core.sharing import derived
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
from apu_casadi.machine.faults.fault import Fault
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.loads.load import Load
from apu_casadi.machine.meanstep import MeanStep
from apu_casadi.unit.apu import Apu, JointPoint
from apu_casadi.unit.events import Ambient
from apu_casadi.unit.stepmeans import MEANS
from estimators.apu.gaspath import ITERATED, ITERATIONS, GasPathFilter, gas_path_filter
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import STATS, STEP_IN, STEP_OUT, FilterStep
from estimators.filters.ukf import ukf_step
from estimators.models.filtermodel import FilterModel
from scenarios.export.ccode import Exported, Vector, scalar

_DT = scalar("dt", "s", "length of the step")
_RESIDUAL = scalar("residual", "1", "residuals of the cycle: above 1e-9 the rest is no result")
_EULER = 1e-6  # s; step of the example of a generator's rates


@dataclass(frozen=True, eq=False)
class Asked:
    """What a function or a model is exported for.

    Args:
        unit: the unit.
        load, fault: of each generator, or a list with one for each; their kinds choose the
            equations.
        ambient: the day of the point to start at.
    """

    unit: Apu
    load: Load | Sequence[Load]
    fault: Fault | Sequence[Fault | None] | None
    ambient: Ambient

    @property
    def loads(self) -> tuple[Load, ...]:
        """The load of each generator."""
        return self.unit.each("load", self.load)

    @property
    def faults(self) -> tuple[Fault | None, ...]:
        """The fault of each generator."""
        return self.unit.each("fault", self.fault)

    @derived
    def point(self) -> JointPoint:
        """The steady point to start at, healthy and under balanced loads."""
        balanced = [load.balanced_part for load in self.loads]
        return self.unit.steady_state(balanced, ambient=self.ambient)

    @property
    def gas(self) -> OperatingPoint:
        """The gas generator there."""
        return self.point.gas


FUNCTIONS: dict[str, Callable[[Asked], Exported]] = {}
"""By name, the model before the dot."""


def _function(name: str) -> Callable[[Callable[[Asked], Exported]], Callable[[Asked], Exported]]:
    def enter(make: Callable[[Asked], Exported]) -> Callable[[Asked], Exported]:
        FUNCTIONS[name] = make
        return make

    return enter


def exported(name: str, asked: Asked) -> Exported:
    """Return a function by its name; ``step`` is short for ``gas_generator.step``.

    Raises:
        ParameterError: an unknown name; the nearest is told.
    """
    full = name if name in FUNCTIONS or "." in name else f"gas_generator.{name}"
    if full not in FUNCTIONS:
        known = [*FUNCTIONS, *(n.partition(".")[2] for n in FUNCTIONS if n[:3] == "gas")]
        raise ParameterError(f"no function {name!r} to export {nearest(name, known)}")
    return FUNCTIONS[full](asked)


def _parted(name: str, f: ca.Function, sizes: tuple[int, int] | None = None) -> ca.Function:
    """Return a function under a name; with its argument theta, if asked, given in two parts."""
    inputs = [ca.MX.sym(f.name_in(i), *f.size_in(i)) for i in range(f.n_in())]
    given, passed = list(inputs), list(inputs)
    if sizes is not None:
        at, parts = f.name_in().index("theta"), [ca.MX.sym("part", n) for n in sizes]
        given[at : at + 1], passed[at] = parts, ca.vertcat(*parts)
    return ca.Function(name, given, [ca.densify(e) for e in f.call(passed)])


def _tuple(values: Any) -> tuple[float, ...]:
    return tuple(float(v) for v in np.asarray(values, dtype=float).ravel(order="F"))


# ------------------------------------------------------------------------------ gas generator


def _of_gas(
    asked: Asked, name: str, doc: str, f: ca.Function, outputs: list[Vector], **how: Any
) -> Exported:
    gg, gas = asked.unit.gas_generator, asked.gas
    n = len(gg.THETA), gg.numbers.size
    numbers = Signals(list(gg.family.theta)[n[0] :])
    known = {
        "x": Vector("x", gg.X, _tuple(gas.x)),
        "z": Vector("z", gg.z, _tuple(gas.z)),
        "z0": Vector("z0", gg.z, _tuple(gas.z)),
        "u": Vector("u", gg.U, _tuple(gas.u)),
        "dt": Vector("dt", _DT, (gg.dt,)),
    }
    given = [known[k] for k in f.name_in() if k != "theta"]
    at = f.name_in().index("theta")
    given[at:at] = [
        Vector("theta", gg.THETA, _tuple(gas.theta)),
        Vector("numbers", numbers, _tuple(gg.numbers), constant=True),
    ]
    whole = f"gas_generator_{name}"
    parted = _parted(whole, f, n)
    return Exported(whole, doc, parted, tuple(given), tuple(outputs), **how)


@_function("gas_generator.step")
def _step(asked: Asked) -> Exported:
    gg = asked.unit.gas_generator
    out = [Vector("x1", gg.X), Vector("y", gg.Y), Vector("z", gg.z), Vector("residual", _RESIDUAL)]
    doc = "one step of the discrete model (12), state update and output; z0 starts the search of z."
    hand = (("x1", "x"), ("z", "z0"))
    return _of_gas(asked, "step", doc, gg.family.step, out, hand=hand)


@_function("gas_generator.f")
def _f(asked: Asked) -> Exported:
    gg = asked.unit.gas_generator
    out = [Vector("x1", gg.X), Vector("z", gg.z), Vector("residual", _RESIDUAL)]
    doc = "state update of the discrete model (12); z0 starts the search of z."
    return _of_gas(asked, "f", doc, gg.family.f, out, hand=(("x1", "x"), ("z", "z0")))


@_function("gas_generator.g")
def _g(asked: Asked) -> Exported:
    gg = asked.unit.gas_generator
    out = [Vector("y", gg.Y), Vector("z", gg.z)]
    doc = "output of the discrete model (12); z0 starts the search of z."
    return _of_gas(asked, "g", doc, gg.family.g, out, hand=(("z", "z0"),))


@_function("gas_generator.residual")
def _residual(asked: Asked) -> Exported:
    gg = asked.unit.gas_generator
    alg = [Signal(n.replace(" ", "_"), "1", f"residual: {n}") for n in gg.equation_names]
    out = [Vector("ode", _rates(gg.X)), Vector("alg", Signals(alg))]
    doc = "the differential-algebraic equations: dx/dt = ode, 0 = alg."
    return _of_gas(asked, "residual", doc, gg.family.state_space.residual, out)


@_function("gas_generator.rates")
def _continuous(asked: Asked) -> Exported:
    gg = asked.unit.gas_generator
    out, h = [Vector("xdot", _rates(gg.X))], ("xdot", "x", gg.dt)
    doc = "right-hand side dx/dt with the algebraic unknowns solved for."
    return _of_gas(asked, "rates", doc, gg.family.state_space.f, out, rate=h)


def _rates(x: Signals) -> Signals:
    return Signals([Signal(f"{s.name}_dot", f"{s.unit}/s", f"rate of {s.name}") for s in x])


# ------------------------------------------------------------------------------ generator

Outputs = Callable[[StateSpace], list[Vector]]


class _AtStart(NamedTuple):
    """The first generator at the start: equations of load and fault, inputs, parameters, state."""

    ss: GeneratorModel
    u: np.ndarray
    theta: np.ndarray
    x: np.ndarray

    @property
    def words(self) -> str:
        """Its load and its fault."""
        load, fault = self.ss.load, self.ss.fault
        return f"Load: {load.kind if load else ''}, fault: {fault.kind if fault else 'none'}."


def _at_start(asked: Asked) -> _AtStart:
    gen, at = asked.unit.generator, asked.point.generator
    load, fault = asked.loads[0], asked.faults[0]
    ss, theta = gen.variant(load, fault), gen.fault_vector(load, fault)
    u = gen.inputs(load, w_r=float(at.u[at.ss.u.index("w_r")]), V_ref=at.V_ref)
    now: dict[str, Any] = {"u_target": u, "theta_target": theta}
    return _AtStart(ss, u, theta, gen.transfer(at.x, at.ss, ss, u=at.u, theta=(), **now))


def _of_generator(
    asked: Asked, name: str, doc: str, outputs: Outputs, which: str = "", **how: Any
) -> Exported:
    at = _at_start(asked)
    ss, u, theta, x = at
    whole = ss.family or ss
    f, numbers = getattr(whole, which or name), Signals(list(whole.theta)[len(ss.theta) :])
    known = {"x": (ss.x, x), "z": (ss.z, ss.z_of(x, u, theta)), "u": (ss.u, u)}
    given = [Vector(k, known[k][0], _tuple(known[k][1])) for k in f.name_in() if k != "theta"]
    given.append(Vector("theta", ss.theta, _tuple(theta)))
    given.append(Vector("numbers", numbers, _tuple(ss.numbers), constant=True))
    parted = _parted(f"generator_{name}", f, (len(ss.theta), len(ss.numbers)))
    doc = f"{doc}  {at.words}"
    return Exported(f"generator_{name}", doc, parted, tuple(given), tuple(outputs(ss)), **how)


@_function("generator.step")
def _gen_step(asked: Asked) -> Exported:
    ss, u, theta, x = at = _at_start(asked)
    dt = asked.unit.gas_generator.dt
    means = MeanStep(asked.unit.generator, ss, u, theta, dt=dt, quad=MEANS)
    table = [Signal(f"c{k}", "1", "of transition matrices") for k in range(means.parameters.size)]
    limits = ", ".join(f"{v:g}" for v in means.limits)
    miss = [Signal(f"miss{k}", "1", "error") for k in range(means.limits.size)]
    given = (
        Vector("x", ss.x, _tuple(x)),
        Vector("series", Signals(table), _tuple(means.parameters), constant=True),
        Vector("u", ss.u, _tuple(u)),
        Vector("theta", ss.shared.theta, _tuple(means.theta), constant=True),
        Vector("dt", _DT, (dt,)),
    )
    mean = Signals([ss.y[n] for n in MEANS])
    made = Vector("x1", ss.x), Vector("mean", mean), Vector("miss", Signals(miss))
    doc = "exact propagation over a step at constant speed, and means over it: right while miss is "
    doc += f"at most {limits}, for this load and fault.  {at.words}"
    function = _parted("generator_step", means.advance)
    return Exported("generator_step", doc, function, given, made, hand=(("x1", "x"),))


@_function("generator.f")
def _gen_f(asked: Asked) -> Exported:
    doc = "right-hand side dx/dt with the algebraic unknowns eliminated."
    rate = ("xdot", "x", _EULER * asked.loads[0].fineness)
    return _of_generator(asked, "f", doc, lambda ss: [Vector("xdot", _rates(ss.x))], rate=rate)


@_function("generator.g")
def _gen_g(asked: Asked) -> Exported:
    doc = "outputs with the algebraic unknowns eliminated."
    return _of_generator(asked, "g", doc, lambda ss: [Vector("y", ss.y)])


@_function("generator.z")
def _gen_z(asked: Asked) -> Exported:
    doc = "the algebraic unknowns."
    return _of_generator(asked, "z", doc, lambda ss: [Vector("z", ss.z)], "z_of")


@_function("generator.residual")
def _gen_residual(asked: Asked) -> Exported:
    doc = "the differential-algebraic equations: dx/dt = ode, 0 = alg."

    def outputs(ss: StateSpace) -> list[Vector]:
        alg = [Signal(f"for_{s.name}", "1", f"what must vanish for {s.name}") for s in ss.z]
        return [Vector("ode", _rates(ss.x)), Vector("alg", Signals(alg))]

    return _of_generator(asked, "residual", doc, outputs)


# ------------------------------------------------------------------------------ filter


@_function("ekf")
def _ekf(asked: Asked) -> Exported:
    return _of_filter(
        asked, "gas_path_ekf", partial(ekf_step, iterations=ITERATIONS, iterated=ITERATED)
    )


@_function("ukf")
def _ukf(asked: Asked) -> Exported:
    return _of_filter(asked, "gas_path_ukf", ukf_step)


def _of_filter(asked: Asked, name: str, make: Callable[[FilterModel], FilterStep]) -> Exported:
    gg, gas = asked.unit.gas_generator, asked.gas
    found = gas_path_filter(gg)
    model, prior = found.model, found.prior()
    step = make(model)
    cov = np.linalg.cholesky(prior.cov) if step.root else prior.cov
    what = "root L of the covariance L L', with" if step.root else "covariance with"
    numbers = step.full(np.zeros(0))
    x, y, u_gg = model.x, {n: gas[n] for n in model.y.names}, gg.U.unpack(gas.u)
    u = {n: v for n, v in u_gg.items() if n in model.u}
    u |= {f"sigma_{n}": _sigma(found, n, v) for n, v in u.items() if f"sigma_{n}" in model.u}
    P = Signals([Signal(s.name, "1", f"covariance with {s.name}") for s in x])
    carried = Signals([Signal(s.name, "1", f"{what} {s.name}") for s in x])
    R = Signals([Signal(s.name, "1", "variance; below zero: not measured") for s in model.y])
    known = {
        "m": Vector("m", x, _tuple(prior.mean)),
        "P": Vector("P", carried, _tuple(cov), square=True),
        "u": Vector("u", model.u, _tuple(model.u.pack(u))),
        "p": Vector("numbers", step.shared.model.p, _tuple(numbers), constant=True),
        "y": Vector("y", model.y, tuple(y.values())),
        "R": Vector("R", R, tuple(_sigma(found, n, v) ** 2 for n, v in y.items())),
        "dt": Vector("dt", _DT, (gg.dt,)),
    }
    made = {k: Vector(k, x) for k in ("m1", "m_f")}
    made |= {k: Vector(k, P, square=True) for k in ("P_f", "C")}
    made["P1"] = Vector("P1", carried, square=True)
    made |= {"nu": Vector("nu", model.y), "S": Vector("S", R, square=True)}
    made["stats"] = Vector("stats", Signals([Signal(k, "1", "of this sample") for k in STATS]))
    return Exported(
        name,
        "one step of the gas-path filter: correct the belief m, P, then predict m1, P1.",
        _parted(name, step.shared.function),
        tuple(known[k] for k in STEP_IN),
        tuple(made[k] for k in STEP_OUT),
        hand=(("m1", "m"), ("P1", "P")),
        shown=("m1", "m_f", "nu", "stats"),
    )


def _sigma(found: GasPathFilter, name: str, reading: float) -> float:
    return float(found.sensors.sigma(name, np.array(reading)))
