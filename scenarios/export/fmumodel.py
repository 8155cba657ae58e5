"""The models that an FMU is made of: variables, functions and numbers of each.

Health factors and the fault's parameters are tunable parameters, loads and ambient conditions
inputs; a fault whose first parameter is zero is none.  Equations are those of the models
themselves; what is C beside them (``sources``) steps, integrates and exchanges.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.core.signals import Signal, Signals
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
_RANGE = (-math.inf, math.inf)
_AXIS = "phase_angle"


@dataclass(frozen=True)
class Variable:
    """A variable of an FMU.

    Args:
        signal: name, unit, meaning, magnitude.
        role: ``"input"``, ``"parameter"``, ``"state"`` or ``"output"``.
        start: value to start with; NaN of an output.
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
        variables: in the order inputs, parameters, states, outputs.
        functions: that the C code calls.
        sources: its files beside those that all have.
        sizes: constants by name, whole numbers.
        arrays: constants by name, numbers; two-dimensional ones row by row.
    """

    name: str
    doc: str
    variables: tuple[Variable, ...]
    functions: tuple[ca.Function, ...]
    sources: tuple[str, ...]
    sizes: dict[str, int]
    arrays: dict[str, Any]

    def of(self, role: str) -> list[Variable]:
        """Return the variables of a role."""
        return [v for v in self.variables if v.role == role]


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


def _variables(role: str, signals: Iterable[Signal], start: Iterable[float] = (), *,
               ranges: dict[str, tuple[float, float]] | None = None) -> list[Variable]:  # fmt: skip
    values, known = list(start), ranges or {}
    made = []
    for i, s in enumerate(signals):
        lo, hi = known.get(s.name, (1e-9, 1e9) if s.unit == "ohm" else _RANGE)
        made.append(Variable(s, role, float(values[i]) if values else math.nan, lo, hi))
    return made


def _outputs(signals: Sequence[Signal], others: Iterable[Variable]) -> tuple[list[Variable], list[int]]:
    """Outputs that no input or state tells already, and their places."""
    taken = {v.signal.name for v in others}
    kept = [i for i, s in enumerate(signals) if s.name not in taken]
    return _variables("output", [signals[i] for i in kept]), kept


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
    return _variables("parameter", gg.THETA, theta, ranges=ranges)


@_model
def gas_generator(asked: Asked) -> FmuModel:
    """The gas generator: one state, fuel and shaft power as inputs."""
    gg, gas = asked.unit.gas_generator, asked.gas
    first = [
        *_variables("input", gg.U, gas.u, ranges=gg.input_ranges),
        *_health(gg, gas.theta),
        *_variables("state", gg.X, gas.x),
    ]
    outputs, kept = _outputs(list(gg.Y), first)
    sizes, arrays = _gas_numbers(gg)
    doc = "Gas generator of an all-electric auxiliary power unit."
    return FmuModel("gas_generator", doc, (*first, *outputs), tuple(_gas_functions(gg)),
                    ("gas_generator.c", "gas.c", "gas.h"), sizes, {**arrays, "Y_OF": kept})  # fmt: skip


# ------------------------------------------------------------------------------ generator


@dataclass(frozen=True, eq=False)
class _Machine:
    """A generator's two sets of equations with one fault, and what its variables are.

    Args:
        states, inputs, faults: variables; inputs without the speed.
        outputs: signals of the generator.
        functions, sizes, arrays: as of a model.
    """

    states: list[Variable]
    inputs: list[Variable]
    faults: list[Variable]
    outputs: list[Signal]
    functions: list[ca.Function]
    sizes: dict[str, int]
    arrays: dict[str, Any]


def _machine(asked: Asked) -> _Machine:
    gen, load, at = asked.unit.generator, asked.load, asked.point.generator
    fault = asked.fault or DEFAULT_FAULT
    healthy, faulty = gen.variant(load), gen.variant(load, fault)
    theta = dict(zip(faulty.theta.names, gen.fault_vector(load, fault).tolist(), strict=True))
    severity = fault.severities[0].name if fault.severities else ""
    if severity != faulty.theta.names[0]:
        raise ParameterError(
            f"a {type(fault).__name__} cannot be exported: its first parameter, "
            f"{faulty.theta.names[0]}, must be the first of its severities, zero where healthy"
        )
    if asked.fault is None:
        theta[severity] = 0.0
    w_r = float(at.u[at.ss.u.index("w_r")])
    u = gen.inputs(load, w_r=w_r, V_ref=at.V_ref)
    x = gen.transfer(at.x, at.ss, faulty, u=at.u, theta=(), u_target=u,
                     theta_target=tuple(theta.values()))  # fmt: skip
    n = len(faulty.u) - len(NOISE)
    ranges = {k.name: (k.lo, k.hi) for k in fault.keys if k.name in theta}
    ranges[severity] = (0.0, ranges.get(severity, _RANGE)[1])
    stage = [i for i, s in enumerate(faulty.x) if s.name not in healthy.x]
    method, names = radau(STAGES), faulty.theta.names
    sizes = {
        "M_X": len(faulty.x), "M_XH": len(healthy.x), "M_U": len(faulty.u), "M_Y": len(faulty.y),
        "M_TH": max(len(ss.shared.theta) for ss in (healthy, faulty)), "M_INPUTS": n - 1,
        "M_FAULT": len(theta), "M_AXIS": names.index(_AXIS) if _AXIS in names else -1,
        "M_GIVEN": len(theta) + len(faulty.numbers), "N_MACHINE": len(faulty.numbers),
        "M_ANGLE": faulty.x.index("theta_e"), "N_RESET": len(stage), "N_MEANS": len(MEANS),
        "R_STAGES": STAGES, "R_PAIRS": STAGES // 2,
    }  # fmt: skip
    arrays = {
        "M_NUMBERS": faulty.numbers, "M_NOMINAL": faulty.x.nominals,
        "M_AT": faulty.x.indices(healthy.x.names), "RESET": stage,
        "MEAN_OF": faulty.y.indices(MEANS), "R_INVERSE": method.inverse,
        "R_RE": method.values.real, "R_IM": method.values.imag, "R_ERROR": method.error,
        "R_FROM_RE": method.of.real, "R_FROM_IM": method.of.imag, "R_WEIGHTS": method.weights,
        "R_TO_RE": method.to.real, "R_TO_IM": method.to.imag,
    }  # fmt: skip
    return _Machine(
        _variables("state", faulty.x, x),
        _variables("input", list(faulty.u)[1:n], u[1:n]),
        _variables("parameter", faulty.theta, theta.values(), ranges=ranges),
        list(faulty.y),
        [f for name, ss in (("healthy", healthy), ("faulty", faulty)) for f in _parts(name, ss)],
        sizes,
        arrays,
    )


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


_MACHINE = ("machine.c", "machine.h", "radau.c", "radau.h")


@_model
def generator(asked: Asked) -> FmuModel:
    """One generator with exciter and load: speed, voltage reference and load as inputs."""
    m, at = _machine(asked), asked.point.generator
    w_r = at.ss.u["w_r"]
    speed = _variables("input", [w_r], [float(at.u[at.ss.u.index("w_r")])])
    first = [*speed, *m.inputs, *m.faults, *m.states]
    outputs, kept = _outputs(m.outputs, first)
    doc = "Starter/generator with exciter, load and stator fault."
    return FmuModel("generator", doc, (*first, *outputs), tuple(m.functions),
                    ("generator.c", *_MACHINE), m.sizes, {**m.arrays, "Y_OF": kept})  # fmt: skip


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
        ca.Function(
            "link_now", [N, x, P, tuned], [ca.vertcat(now.Wf, own.PW(P)), ca.vertcat(*now.rates)]
        ),
        ca.Function("exchange", [N, x, P, air, theta, tuned, h, z], after),
    ]


@_model
def apu(asked: Asked) -> FmuModel:
    """The whole unit: governor and the exchange of 20 ms inside, loads and the day as inputs."""
    unit, m, gas = asked.unit, _machine(asked), asked.gas
    gg, law = unit.gas_generator, unit.governor
    air = [gg.U[n] for n in AMBIENT]
    N_ref = Signal("N_ref", "rad/s", "governed rotor speed", nominal=unit.N_ref)
    tuned = [N_ref, *law.signals("governor")]
    first = [
        *_variables("input", air, (gas.u[gg.U.index(n)] for n in AMBIENT), ranges=gg.input_ranges),
        *m.inputs,
        *_health(gg, gas.theta),
        *m.faults,
        *_variables("parameter", tuned, [unit.N_ref, *law.numbers.values()]),
        *_variables("state", gg.X, gas.x),
        *_variables("state", law.X, law.start(float(gas["Wf"]))),
        *m.states,
    ]
    means = [_mean(s) if s.name in MEANS else s for s in m.outputs]
    outputs, kept = _outputs([*gg.Y, *means], first)
    sizes, arrays = _gas_numbers(gg)
    sizes |= {**m.sizes, "N_GOVERNOR": len(law.X), "N_AMBIENT": len(air)}
    functions = [f for f in _gas_functions(gg) if f.name() != "gas_step"]
    doc = "All-electric auxiliary power unit: gas generator, governor and generators."
    return FmuModel("apu", doc, (*first, *outputs),
                    (*functions, *m.functions, *_link_functions(unit.link, gg)),
                    ("apu.c", "gas.c", "gas.h", *_MACHINE),
                    sizes, {**arrays, **m.arrays, "Y_OF": kept})  # fmt: skip


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
