"""The models that an FMU is made of: variables, functions and numbers of each.

Health factors and the fault's parameters are tunable parameters, loads and ambient conditions
inputs; a fault whose first parameter is zero is none.  Equations are those of the models
themselves; what is C beside them (``sources``) steps, integrates and exchanges.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.core.signals import Signal
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.gaspath.health import RUN_RANGE
from apu_casadi.machine.faults.fault import Fault
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generatormodel import NOISE, GeneratorModel
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.exchange import PAPER, Link, governed_step
from apu_casadi.unit.stepmeans import MEANS
from scenarios.export.cfunctions import Asked
from scenarios.export.collocation import radau

STEP = 0.02  # s; the discrete step of the gas generator, and the exchange (paper, section 3.3)
STAGES = 5  # of the collocation; its error estimate is then of order 5
TOLERANCE = 1e-7  # of a step, relative, of an estimate four orders below the method's own
NEWTON_TOL = 1e-3  # of the iterations, relative to it
FIRST = 2e-6  # s; first step after a switch
DEFAULT_FAULT = Ttsc(0.05, 20.0)
_ANY, _POSITIVE = (-math.inf, math.inf), (1e-9, 1e9)
_AXIS = "phase_angle"


class Variable(NamedTuple):
    """A variable of an FMU.

    Args:
        signal: name, unit, meaning, magnitude.
        role: one of :data:`ROLES`.
        start: value to start with; NaN of a rate or an output.
        least, most: range.
        shown: a state is an output as well.
    """

    signal: Signal
    role: str
    start: float = math.nan
    least: float = -math.inf
    most: float = math.inf
    shown: bool = False


@dataclass(frozen=True, eq=False)
class FmuModel:
    """What an FMU of one model is made of.

    Args:
        name, doc: of the model.
        given: inputs, parameters, states, outputs.
        functions: that the C code calls.
        sources: its files beside those that all have.
        sizes: constants by name, whole numbers.
        arrays: constants by name, numbers.
        machines: its generators.
    """

    name: str
    doc: str
    given: tuple[Variable, ...]
    functions: tuple[ca.Function, ...]
    sources: tuple[str, ...]
    sizes: dict[str, int]
    arrays: dict[str, Any]
    machines: tuple[Machine, ...] = ()

    def of(self, role: str) -> list[Variable]:
        """Return the variables of a role; a rate stands for each state."""
        if role != "rate":
            return [v for v in self.given if v.role == role]
        states = (v.signal for v in self.of("state"))
        told = (Signal(f"{s.name}_dot", f"{s.unit}/s", f"rate of {s.name}") for s in states)
        return [Variable(s, "rate") for s in told]

    @property
    def variables(self) -> list[Variable]:
        """All but the time, in the order of their value references, which begin with 1."""
        return [v for role in ROLES for v in self.of(role)]


ROLES = ("input", "parameter", "state", "rate", "output")
MODELS: dict[str, Callable[[Asked], FmuModel]] = {}


def fmu_model(name: str, asked: Asked) -> FmuModel:
    """Return the model ``gas_generator``, ``generator`` or ``apu``.

    Raises:
        ParameterError: an unknown name; the nearest is told.
    """
    if name not in MODELS:
        raise ParameterError(f"no model {name!r} to export {nearest(name, MODELS)}")
    return MODELS[name](asked)


def _model(make: Callable[[Asked], FmuModel]) -> Callable[[Asked], FmuModel]:
    MODELS[make.__name__] = make
    return make


Ranges = Mapping[str, tuple[float, float]]


def _variables(
    role: str, signals: Iterable[Signal], start: Iterable[float] = (), ranges: Ranges | None = None
) -> list[Variable]:
    values, known = list(start), ranges or {}
    made = []
    for i, s in enumerate(signals):
        lo, hi = known.get(s.name, _POSITIVE if s.unit == "ohm" else _ANY)
        made.append(Variable(s, role, float(values[i]) if values else math.nan, lo, hi))
    return made


def _finished(
    name: str,
    doc: str,
    given: Sequence[Variable],
    outputs: Iterable[Signal],
    functions: Iterable[ca.Function],
    sources: str,
    sizes: Mapping[str, int],
    arrays: Mapping[str, Any],
    machines: Sequence[Machine] = (),
    hidden: Iterable[str] = (),
) -> FmuModel:
    """Put a model together; what an input or a state tells, or is ``hidden``, is not told twice."""
    taken, signals = {*hidden, *(v.signal.name for v in given)}, list(outputs)
    kept = [i for i, s in enumerate(signals) if s.name not in taken]
    names = {s.name for s in signals}
    first = (v._replace(shown=v.role == "state" and v.signal.name in names) for v in given)
    whole = (*first, *_variables("output", (signals[i] for i in kept)))
    more, numbers = _of_machines(machines) if machines else ({}, {})
    return FmuModel(
        name,
        doc,
        whole,
        (*functions, *{f.name(): f for m in machines for f in m.functions}.values()),
        (*sources.split(), *(_MACHINE.split() if machines else ())),
        {**sizes, **more},
        {"Y_OF": _places(kept), **arrays, **numbers},
        tuple(machines),
    )


def _places(indices: Sequence[int]) -> np.ndarray:
    return np.array(indices, dtype=int)


# ------------------------------------------------------------------------------ gas generator


def _gas_functions(gg: GasGenerator) -> list[ca.Function]:
    family = gg.family
    x, _, u, theta = family.symbols()
    z0 = family.similar(x, u, theta)
    z = family.solve(z0, x, u, theta)
    ode, _, y = family.equations(x, z, u, theta)
    given = [x, u, theta]
    return [
        ca.Function("gas_similar", given, [z0]),
        ca.Function("gas_evaluate", given, [ode, y]),
        _renamed(family.step, "gas_step"),
    ]


def _renamed(f: ca.Function, name: str) -> ca.Function:
    inputs = [ca.MX.sym(f.name_in(i), *f.size_in(i)) for i in range(f.n_in())]
    return ca.Function(name, inputs, f.call(inputs))


def _gas_numbers(gg: GasGenerator) -> tuple[dict[str, int], dict[str, Any]]:
    sizes = {"G_HEALTH": len(gg.THETA), "N_ENGINE": gg.numbers.size, "N_Z": len(gg.z)}
    sizes |= {"G_THETA": len(gg.family.theta), "G_Y": len(gg.Y)}
    sizes |= {"G_MACH8": gg.Y.index("Mach8"), "G_RESIDUAL": gg.Y.index("residual")}
    return sizes, {"G_NUMBERS": gg.numbers}


def _health(gg: GasGenerator, theta: np.ndarray) -> list[Variable]:
    lo, hi = RUN_RANGE
    ranges = dict.fromkeys(gg.THETA.names, (lo + 1e-9, hi))
    return _variables("parameter", gg.THETA, theta, ranges)


@_model
def gas_generator(asked: Asked) -> FmuModel:
    """The gas generator: one state, fuel and shaft power as inputs."""
    gg, gas = asked.unit.gas_generator, asked.gas
    given = [
        *_variables("input", gg.U, gas.u, gg.input_ranges),
        *_health(gg, gas.theta),
        *_variables("state", gg.X, gas.x),
    ]
    doc = "Gas generator of an all-electric auxiliary power unit."
    made = _gas_functions(gg), "gas_generator.c gas.c gas.h", *_gas_numbers(gg)
    return _finished("gas_generator", doc, given, gg.Y, *made)


# ------------------------------------------------------------------------------ generator


@dataclass(frozen=True, eq=False)
class Machine:
    """A generator with one fault: its variables, equations, and their places among all.

    Args:
        structure: number of its equations, equal for generators of equal ones.
        like: number, from 0, of the first generator with the same equations and numbers.
        healthy, faulty: its two sets of equations.
        states, inputs, faults: variables; inputs without the speed.
        outputs: of the faulty equations.
        at: first of its inputs, parameters, states and outputs, by ``u``, ``p``, ``x``, ``y``.
    """

    structure: int
    like: int
    healthy: GeneratorModel
    faulty: GeneratorModel
    states: list[Variable]
    inputs: list[Variable]
    faults: list[Variable]
    outputs: list[Signal]
    at: dict[str, int]

    @property
    def functions(self) -> list[ca.Function]:
        """Those of both sets of equations."""
        both = (("healthy", self.healthy), ("faulty", self.faulty))
        return [f for name, ss in both for f in _parts(f"{name}{self.structure}", ss)]

    @property
    def new_states(self) -> list[int]:
        """Places of the states that the fault brings."""
        return [i for i, n in enumerate(self.faulty.x.names) if n not in self.healthy.x]

    @property
    def axis(self) -> int:
        """Place of the angle that turns the fault among its parameters; -1 without one."""
        names = self.faulty.theta.names
        return names.index(_AXIS) if _AXIS in names else -1


def _of_machines(machines: Sequence[Machine]) -> tuple[dict[str, int], dict[str, Any]]:
    """Sizes that hold every generator, and the integrator's numbers."""
    every = [ss for m in machines for ss in (m.healthy, m.faulty)]
    sizes = {"N_GENERATORS": len(machines), "N_MEANS": len(MEANS)}
    sizes |= {f"M_{k.upper()}": max(len(getattr(ss, k)) for ss in every) for k in "xuy"}
    sizes["M_TH"] = max(len(ss.shared.theta) for ss in every)
    sizes["M_GIVEN"] = max(len(ss.theta) + len(ss.numbers) for ss in every)
    sizes |= {"R_STAGES": STAGES, "R_PAIRS": STAGES // 2}
    m = radau(STAGES)
    arrays = {"R_INVERSE": m.inverse, "R_WEIGHTS": m.weights, "R_ERROR": m.error}
    arrays |= {"R_RE": m.values.real, "R_IM": m.values.imag, "R_FROM_RE": m.of.real}
    arrays |= {"R_FROM_IM": m.of.imag, "R_TO_RE": m.to.real, "R_TO_IM": m.to.imag}
    return sizes, arrays


def _machines(asked: Asked, count: int, before: Mapping[str, int], named: bool) -> list[Machine]:
    """Return the first generators of a unit; ``before``: variables that come before theirs."""
    made: list[Machine] = []
    at = dict(before)
    for k in range(count):
        m = _machine(asked, k, f"generator{k + 1}." if named else "", dict(at))
        equal = (e for e in made if _equations(e) == _equations(m))
        m = dataclasses.replace(m, structure=next((e.structure for e in equal), k))
        shaft, mine = asked.unit.machines, (_equations(m), asked.unit.machines[k])
        like = (i for i, e in enumerate(made) if (_equations(e), shaft[i]) == mine)
        made.append(dataclasses.replace(m, like=next(like, k)))
        for name, part in (("u", m.inputs), ("p", m.faults), ("x", m.states), ("y", m.outputs)):
            at[name] += len(part)
    return made


def _equations(m: Machine) -> tuple[GeneratorModel, GeneratorModel]:
    return m.healthy.shared, m.faulty.shared


def _machine(asked: Asked, k: int, prefix: str, at: dict[str, int]) -> Machine:
    gen, point, load = asked.unit.generators[k], asked.point.of(k + 1), asked.loads[k]
    fault = asked.faults[k] or DEFAULT_FAULT
    healthy, faulty = gen.variant(load), gen.variant(load, fault)
    theta = dict(zip(faulty.theta.names, gen.fault_vector(load, fault).tolist(), strict=True))
    severity = _severity(fault, faulty)
    if asked.faults[k] is None:
        theta[severity] = 0.0
    w_r = float(point.u[point.ss.u.index("w_r")])
    u = gen.inputs(load, w_r=w_r, V_ref=point.V_ref)
    now: dict[str, Any] = {"u_target": u, "theta_target": tuple(theta.values())}
    x = gen.transfer(point.x, point.ss, faulty, u=point.u, theta=(), **now)
    ranges = {key.name: (key.lo, key.hi) for key in fault.keys if key.name in theta}
    ranges[severity] = 0.0, ranges.get(severity, _ANY)[1]
    n = len(faulty.u) - len(NOISE)
    states = _variables("state", faulty.x, x)
    inputs = _variables("input", faulty.u[1:n], u[1:n])
    faults = _variables("parameter", faulty.theta, theta.values(), ranges)
    x_, u_, p_ = ([_named(v, prefix) for v in part] for part in (states, inputs, faults))
    outputs = [dataclasses.replace(s, name=prefix + s.name) for s in faulty.y]
    return Machine(k, k, healthy, faulty, x_, u_, p_, outputs, at)


def _named(v: Variable, prefix: str) -> Variable:
    return v._replace(signal=dataclasses.replace(v.signal, name=prefix + v.signal.name))


def _severity(fault: Fault, faulty: GeneratorModel) -> str:
    """Name of the parameter that is zero where the machine is healthy."""
    first = faulty.theta.names[0]
    if not fault.severities or fault.severities[0].name != first:
        raise ParameterError(
            f"a {type(fault).__name__} cannot be exported: its first parameter, {first}, must be "
            "the first of its severities, zero where the machine is healthy"
        )
    return first


def _parts(name: str, ss: GeneratorModel) -> list[ca.Function]:
    """Rates, outputs and Jacobian of a variant, and what they take of its parameters."""
    own = ss.shared
    x, u, th = (ca.SX.sym(k, len(s)) for k, s in (("x", own.x), ("u", own.u), ("th", own.theta)))
    given = ca.SX.sym("given", len(ss.theta) + len(ss.numbers))
    family = ss.family
    reduced = family.reduced if isinstance(family, GeneratorModel) else None
    follow = given if reduced is None else reduced[1](given)
    f, g = own.f(x, u, th), own.g(x, u, th)
    made = dict(zip(PARTS, (f, g, ca.densify(ca.jacobian(f, x)), follow), strict=True))
    return [
        ca.Function(f"{name}_{k}", [given] if k == "follow" else [x, u, th], [e], {"cse": True})
        for k, e in made.items()
    ]


PARTS = ("f", "g", "jacobian", "follow")
"""Functions of a set of equations: rates, outputs, Jacobian, and what follows from parameters."""
_MACHINE = "machine.c machine.h radau.c radau.h"


@_model
def generator(asked: Asked) -> FmuModel:
    """The first generator with exciter and load: speed, voltage reference and load as inputs."""
    (m,), at = _machines(asked, 1, {"u": 1, "p": 0, "x": 0, "y": 0}, False), asked.point.generator
    speed = _variables("input", [at.ss.u["w_r"]], [at.u[at.ss.u.index("w_r")]])
    given = [*speed, *m.inputs, *m.faults, *m.states]
    doc = "Starter/generator with exciter, load and stator fault."
    return _finished("generator", doc, given, m.outputs, (), "generator.c", {}, {}, [m])


# ------------------------------------------------------------------------------ the unit


def _link_functions(unit: Apu) -> list[ca.Function]:
    """Speed of the generators, fuel and power of the instant, and the exchange step of (1)-(3)."""
    gg, law, n = unit.gas_generator, unit.governor, len(unit.machines)
    links = [unit.link_of((k,)) for k in range(1, n + 1)]
    N, P, h, x = (ca.MX.sym(k, m) for k, m in (("N", 1), ("P", n), ("h", 1), ("x", len(law.X))))
    air, z = ca.MX.sym("air", len(AMBIENT)), ca.MX.sym("z", len(gg.z))
    theta, tuned = ca.MX.sym("theta", len(gg.family.theta)), ca.MX.sym("tuned", len(_tuned(unit)))
    N_ref, *values = ca.vertsplit(tuned)
    own = Link(law.symbolic(**dict(zip(law.numbers, values, strict=True))), N_ref)
    now = own.fuel(N, ca.vertsplit(x))
    PW = sum((a.PW(p) for a, p in zip(links, ca.vertsplit(P), strict=True)), ca.MX(0))

    def machine(_N: Any, _slope: Any) -> tuple[Any, Any]:
        return PW, None

    def engine(Wf: Any, PW: Any) -> tuple[Any, Any]:
        N1, *made = gg.family.step(N, ca.vertcat(Wf, PW, air), theta, h, z)
        return N1, [N1, *made]

    done = governed_step(own, PAPER, machine, engine, N=N, x=ca.vertsplit(x), h=h)
    N1, y, z1, residual = done.engine
    after = [N1, ca.vertcat(*done.governor), y, z1, residual]
    feed, rates = ca.vertcat(now.Wf, PW), ca.vertcat(*now.rates)
    return [
        ca.Function("link_speed", [N], [ca.vertcat(*(a.w_r(N) for a in links))]),
        ca.Function("link_now", [N, x, P, tuned], [feed, rates]),
        ca.Function("exchange", [N, x, P, air, theta, tuned, h, z], after),
    ]


def _tuned(unit: Apu) -> list[Variable]:
    """Governed speed and the governor's numbers."""
    N_ref = Signal("N_ref", "rad/s", "governed rotor speed", nominal=unit.N_ref)
    law, ranges = unit.governor, {"N_ref": _POSITIVE}
    signals, values = [N_ref, *law.signals("governor")], [unit.N_ref, *law.numbers.values()]
    return _variables("parameter", signals, values, ranges)


@_model
def apu(asked: Asked) -> FmuModel:
    """The whole unit: governor and the exchange of 20 ms inside, loads and the day as inputs."""
    unit, gas = asked.unit, asked.gas
    gg, law = unit.gas_generator, unit.governor
    air = [float(gas.u[gg.U.index(n)]) for n in AMBIENT]
    before = {"u": len(air), "p": len(gg.THETA), "x": len(gg.X) + len(law.X), "y": len(gg.Y) + 1}
    machines, tuned = _machines(asked, len(unit.machines), before, True), _tuned(unit)
    given = [
        *_variables("input", (gg.U[n] for n in AMBIENT), air, gg.input_ranges),
        *(v for m in machines for v in m.inputs),
        *_health(gg, gas.theta),
        *(v for m in machines for v in m.faults),
        *tuned,
        *_variables("state", gg.X, gas.x),
        *_variables("state", law.X, law.start(float(gas["Wf"]))),
        *(v for m in machines for v in m.states),
    ]
    total = Signal(MEANS[0], "W", "mechanical power of all generators (8)")
    outputs = [*gg.Y, _mean(total), *(_mean(s) for m in machines for s in m.outputs)]
    hidden = [s.name for s in outputs if s.name.endswith(f".{total.name}")]  # each of two alike
    sizes, arrays = _gas_numbers(gg)
    sizes |= {"N_GOVERNOR": len(law.X), "N_AMBIENT": len(air), "N_TUNED": len(tuned)}
    functions = [f for f in _gas_functions(gg) if f.name() != "gas_step"] + _link_functions(unit)
    doc = "All-electric auxiliary power unit: gas generator, governor and generators."
    made = functions, "apu.c gas.c gas.h", sizes | {"N_RAW": len(outputs)}, arrays, machines
    return _finished("apu", doc, given, outputs, *made, hidden)


def _mean(s: Signal) -> Signal:
    if s.name.rpartition(".")[2] not in MEANS:
        return s
    more = "; in co-simulation the mean over the exchange step"
    return dataclasses.replace(s, doc=s.doc + more)


CONSTANTS = {
    "STEP": STEP,
    "TOLERANCE": TOLERANCE,
    "NEWTON_TOL": NEWTON_TOL,
    "FIRST": FIRST,
    "RESIDUAL_TOL": RESIDUAL_TOL,
}
