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
    """

    signal: Signal
    role: str
    start: float = math.nan
    least: float = -math.inf
    most: float = math.inf


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
    """

    name: str
    doc: str
    given: tuple[Variable, ...]
    functions: tuple[ca.Function, ...]
    sources: tuple[str, ...]
    sizes: dict[str, int]
    arrays: dict[str, Any]

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
    parts: Iterable[tuple[Mapping[str, int], Mapping[str, Any]]],
) -> FmuModel:
    """Put a model together; what an input or a state tells already is no output."""
    taken, signals = {v.signal.name for v in given}, list(outputs)
    kept = [i for i, s in enumerate(signals) if s.name not in taken]
    shown = _variables("output", (signals[i] for i in kept))
    sizes: dict[str, int] = {}
    arrays: dict[str, Any] = {"Y_OF": _places(kept)}
    for more, numbers in parts:
        sizes |= more
        arrays |= numbers
    whole = (*given, *shown)
    return FmuModel(name, doc, whole, tuple(functions), tuple(sources.split()), sizes, arrays)


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
    made = _gas_functions(gg), "gas_generator.c gas.c gas.h", [_gas_numbers(gg)]
    return _finished("gas_generator", doc, given, gg.Y, *made)


# ------------------------------------------------------------------------------ generator


@dataclass(frozen=True, eq=False)
class _Machine:
    """A generator with one fault: its variables, and the numbers that the C code takes.

    Args:
        healthy, faulty: its two sets of equations.
        states, inputs, faults: variables; inputs without the speed.
    """

    healthy: GeneratorModel
    faulty: GeneratorModel
    states: list[Variable]
    inputs: list[Variable]
    faults: list[Variable]

    @property
    def functions(self) -> list[ca.Function]:
        """Those of both sets of equations."""
        return [*_parts("healthy", self.healthy), *_parts("faulty", self.faulty)]

    @property
    def numbers(self) -> tuple[dict[str, int], dict[str, Any]]:
        """Sizes, and arrays by name."""
        ss, own, method = self.faulty, self.healthy.x.names, radau(STAGES)
        stage = [i for i, n in enumerate(ss.x.names) if n not in own]
        n, names = len(ss.numbers), ss.theta.names
        theta = max(len(s.shared.theta) for s in (self.healthy, ss))
        sizes = {"M_X": len(ss.x), "M_XH": len(own), "M_U": len(ss.u), "M_Y": len(ss.y)}
        sizes |= {"M_TH": theta, "M_FAULT": len(names), "N_MACHINE": n, "M_GIVEN": len(names) + n}
        sizes |= {"M_AXIS": names.index(_AXIS) if _AXIS in names else -1, "N_RESET": len(stage)}
        sizes |= {"M_INPUTS": len(self.inputs), "M_ANGLE": ss.x.index("theta_e")}
        sizes |= {"N_MEANS": len(MEANS), "R_STAGES": STAGES, "R_PAIRS": STAGES // 2}
        arrays: dict[str, Any] = {"M_NUMBERS": ss.numbers, "M_NOMINAL": ss.x.nominals}
        arrays |= {"M_AT": _places(ss.x.indices(own)), "RESET": _places(stage)}
        arrays |= {"MEAN_OF": _places(ss.y.indices(MEANS))}
        arrays |= {"R_INVERSE": method.inverse, "R_WEIGHTS": method.weights}
        arrays |= {"R_ERROR": method.error, "R_RE": method.values.real, "R_IM": method.values.imag}
        arrays |= {"R_FROM_RE": method.of.real, "R_FROM_IM": method.of.imag}
        return sizes, arrays | {"R_TO_RE": method.to.real, "R_TO_IM": method.to.imag}


def _machine(asked: Asked) -> _Machine:
    gen, load, at = asked.unit.generator, asked.load, asked.point.generator
    fault = asked.fault or DEFAULT_FAULT
    healthy, faulty = gen.variant(load), gen.variant(load, fault)
    theta = dict(zip(faulty.theta.names, gen.fault_vector(load, fault).tolist(), strict=True))
    severity = _severity(fault, faulty)
    if asked.fault is None:
        theta[severity] = 0.0
    u = gen.inputs(load, w_r=float(at.u[at.ss.u.index("w_r")]), V_ref=at.V_ref)
    now: dict[str, Any] = {"u_target": u, "theta_target": tuple(theta.values())}
    x = gen.transfer(at.x, at.ss, faulty, u=at.u, theta=(), **now)
    ranges = {k.name: (k.lo, k.hi) for k in fault.keys if k.name in theta}
    ranges[severity] = 0.0, ranges.get(severity, _ANY)[1]
    n = len(faulty.u) - len(NOISE)
    return _Machine(
        healthy,
        faulty,
        _variables("state", faulty.x, x),
        _variables("input", faulty.u[1:n], u[1:n]),
        _variables("parameter", faulty.theta, theta.values(), ranges),
    )


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
    made = {"f": f, "g": g, "jac": ca.densify(ca.jacobian(f, x))}
    made = {k: ca.Function(f"{name}_{k}", [x, u, th], [e], {"cse": True}) for k, e in made.items()}
    return [*made.values(), ca.Function(f"{name}_follow", [given], [follow], {"cse": True})]


_MACHINE = "machine.c machine.h radau.c radau.h"


@_model
def generator(asked: Asked) -> FmuModel:
    """One generator with exciter and load: speed, voltage reference and load as inputs."""
    m, at = _machine(asked), asked.point.generator
    speed = _variables("input", [at.ss.u["w_r"]], [at.u[at.ss.u.index("w_r")]])
    given = [*speed, *m.inputs, *m.faults, *m.states]
    doc = "Starter/generator with exciter, load and stator fault."
    made = m.functions, f"generator.c {_MACHINE}", [m.numbers]
    return _finished("generator", doc, given, m.faulty.y, *made)


# ------------------------------------------------------------------------------ the unit


def _link_functions(link: Link, gg: GasGenerator) -> list[ca.Function]:
    """Speed of the generators, fuel and power of the instant, and the exchange step of (1)-(3)."""
    law, numbers = link.governor, link.numbers
    N, P, h = ca.MX.sym("N"), ca.MX.sym("P"), ca.MX.sym("h")
    x, tuned = ca.MX.sym("x", len(law.X)), ca.MX.sym("tuned", 1 + numbers.size - 4)
    air, z = ca.MX.sym("air", len(AMBIENT)), ca.MX.sym("z", len(gg.z))
    theta = ca.MX.sym("theta", len(gg.family.theta))
    first, *rest = ca.vertsplit(tuned)
    own = link.with_numbers([first, *numbers[1:4].tolist(), *rest])
    now = own.fuel(N, ca.vertsplit(x))
    feed = ca.vertcat(now.Wf, own.PW(P))

    def machine(_N: Any, _slope: Any) -> tuple[Any, Any]:
        return P, None

    def engine(Wf: Any, PW: Any) -> tuple[Any, Any]:
        N1, *made = gg.family.step(N, ca.vertcat(Wf, PW, air), theta, h, z)
        return N1, [N1, *made]

    done = governed_step(own, PAPER, machine, engine, N=N, x=ca.vertsplit(x), h=h)
    N1, y, z1, residual = done.engine
    after = [N1, ca.vertcat(*done.governor), y, z1, residual]
    return [
        ca.Function("link_speed", [N, tuned], [own.w_r(N)]),
        ca.Function("link_now", [N, x, P, tuned], [feed, ca.vertcat(*now.rates)]),
        ca.Function("exchange", [N, x, P, air, theta, tuned, h, z], after),
    ]


@_model
def apu(asked: Asked) -> FmuModel:
    """The whole unit: governor and the exchange of 20 ms inside, loads and the day as inputs."""
    unit, m, gas = asked.unit, _machine(asked), asked.gas
    gg, law = unit.gas_generator, unit.governor
    N_ref = Signal("N_ref", "rad/s", "governed rotor speed", nominal=unit.N_ref)
    air = [float(gas.u[gg.U.index(n)]) for n in AMBIENT]
    given = [
        *_variables("input", (gg.U[n] for n in AMBIENT), air, gg.input_ranges),
        *m.inputs,
        *_health(gg, gas.theta),
        *m.faults,
        *_variables("parameter", [N_ref], [unit.N_ref]),
        *_variables("parameter", law.signals("governor"), law.numbers.values()),
        *_variables("state", gg.X, gas.x),
        *_variables("state", law.X, law.start(float(gas["Wf"]))),
        *m.states,
    ]
    outputs = [*gg.Y, *(_mean(s) if s.name in MEANS else s for s in m.faulty.y)]
    own = {"N_GOVERNOR": len(law.X), "N_AMBIENT": len(air)}
    functions = [f for f in _gas_functions(gg) if f.name() != "gas_step"]
    functions += [*m.functions, *_link_functions(unit.link, gg)]
    doc = "All-electric auxiliary power unit: gas generator, governor and generators."
    made = functions, f"apu.c gas.c gas.h {_MACHINE}", [m.numbers, _gas_numbers(gg), (own, {})]
    return _finished("apu", doc, given, outputs, *made)


def _mean(s: Signal) -> Signal:
    more = "; in co-simulation the mean over the exchange step"
    return dataclasses.replace(s, doc=s.doc + more)


CONSTANTS = {
    "STEP": STEP,
    "TOLERANCE": TOLERANCE,
    "NEWTON_TOL": NEWTON_TOL,
    "FIRST": FIRST,
    "RESIDUAL_TOL": RESIDUAL_TOL,
}
