"""The numbers of one gas generator as a vector c: what it is given, and what follows from it.

The compiled functions of an engine take c as an argument, so that engines which differ in numbers
share them.  ``GIVEN`` are the parameters by dotted name (``gas_generator.eta_c``,
``compressor_map.a_W``); ``DERIVED`` is what the design point and the fuel make of them: computed
once for an engine, and by :func:`derivation` as a differentiable function.  Structure, which is
compiled in, are gas data and map tables.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.parameters import of_symbols
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.design import DesignPoint, design_equations
from apu_casadi.gaspath.designdata import GasGeneratorParameters
from apu_casadi.gaspath.gas import COEFFICIENTS, Gas, fuel_burning, used
from apu_casadi.gaspath.maps.maptable import MapTable
from apu_casadi.gaspath.maps.scaledmaps import (
    MapCalibration,
    ScaledMap,
    scale_factors,
    table_logs,
)
from apu_casadi.gaspath.stations import TEMPERATURES, viscosity

MAPS = ("compressor_map", "turbine_map")
_PLACE = (
    ("N_map_des", "table speed of the design point"),
    ("beta_des", "table beta of the design point"),
)


def _map_signals(name: str) -> Signals:
    place = [Signal(f"{name}.{n}", "1", doc) for n, doc in _PLACE]
    return Signals(place) + MapCalibration().signals(name, defaults=True)


_N_CALIBRATION = len(MapCalibration().signals("map", defaults=True))
OWN = GasGeneratorParameters().signals("gas_generator", defaults=True)
GIVEN = OWN + _map_signals("compressor_map") + _map_signals("turbine_map")
"""The parameters: design data, then each map's place of the design point and calibration."""

_VALUES = ("T2", "P2", "P4", "W5", "P5", "Wf", "PW")  # of the design point, beside z
_LOGS = ("ln_W", "ln_PR_1", "ln_eta")
_REFERENCES = tuple(
    f"per_{n}" for n in ("N", "T2", "T41", "P2", "Re_c", "Re_t", "flow_31", "flow_5")
)
_FACTORS = ("per_N_map", "per_W", "per_line")
_RANGES = tuple(f"{r}_{a}" for r in ("low", "high") for a in COEFFICIENTS)
DERIVED = Signals(
    [
        Signal("design.A3", "m^2", "flow area at 3"),
        Signal("design.A8", "m^2", "flow area at 8"),
        Signal("design.W_t", "kg/s sqrt(K)/Pa", "turbine flow W41 sqrt(T41)/P4 at design"),
        Signal("design.PR_t", "1", "turbine pressure ratio at design"),
        *(Signal(f"design.{n}", "K", f"{n} at design") for n in TEMPERATURES),
        *(Signal(f"design.{n}", "1", f"{n} at design, SI") for n in _VALUES),
        *(Signal(f"{m}.{n}", "1", "of the table at the design point") for m in MAPS for n in _LOGS),
        *(Signal(f"fuel.{n}", "1", "coefficient of burning 1 kg of fuel") for n in _RANGES),
        Signal("fuel.R", "J/(kg K)", "change of the gas constant by burning 1 kg of fuel"),
        *(Signal(f"reference.{n}", "1", "reciprocal of a design value, SI") for n in _REFERENCES),
        *(Signal(f"{m}.{n}", "1", "factor of the scaled map") for m in MAPS for n in _FACTORS),
    ]
)
"""What follows from them."""

NUMBERS = GIVEN + DERIVED


class UnitParts(NamedTuple):
    """Parameters, gas, design point and maps of an engine whose numbers are symbols.

    ``ref`` are the reciprocals of design values by name (``per_T2``): computed once an engine.
    """

    p: GasGeneratorParameters
    gas: Gas
    design: DesignPoint
    cmap: ScaledMap
    tmap: ScaledMap
    ref: dict[str, Any]


def references(p: GasGeneratorParameters, design: DesignPoint) -> list[Any]:
    """Return the reciprocals of design values, in the order of their names."""
    d = design.values
    per_Re = (viscosity(d[T]) / d[P] for T, P in (("T2", "P2"), ("T41", "P4")))
    flow_31 = p.W2 * ca.sqrt(d["T3"]) / (d["P2"] * p.PR_c)
    flow_5 = d["W5"] * ca.sqrt(d["T5"]) / d["P5"]
    return [1 / p.N, *(1 / d[n] for n in ("T2", "T41", "P2")), *per_Re, 1 / flow_31, 1 / flow_5]


def parts(c: ca.SX, data: str, compressor: MapTable, turbine: MapTable) -> UnitParts:
    """Return what the numbers ``c`` stand for, as symbols; nothing is checked."""
    p = of_symbols(GasGeneratorParameters, c[: len(OWN)], gas_data=data)
    v = {n.removeprefix("design."): e for n, e in NUMBERS.unpack(c).items()}
    z = {n: v[n] for n in TEMPERATURES}
    values = z | {n: v[n] for n in _VALUES} | {"T8": v["T5"]}
    design = DesignPoint(v["A3"], v["A8"], v["W_t"], v["PR_t"], z, values, 0.0)
    fuel = ca.SX(2, 9)
    for k, (i, j) in enumerate(np.ndindex(2, 9)):
        fuel[i, j] = v[f"fuel.{_RANGES[k]}"] if used(data)[i, j] else 0.0
    gas = Gas.of_symbols(p.x_HC, data, (fuel, v["fuel.R"]))
    scaled = []
    for name, table, W, PR, eta in (
        ("compressor_map", compressor, p.W2, p.PR_c, p.eta_c),
        ("turbine_map", turbine, design.W_t, design.PR_t, p.eta_t),
    ):
        k = GIVEN.index(f"{name}.a_W")
        made = object.__new__(ScaledMap)
        made.__dict__.update(table=table, W_des=W, PR_des=PR, eta_des=eta)
        made.__dict__.update({n: v[f"{name}.{n}"] for n, _ in _PLACE})
        made.__dict__["cal"] = of_symbols(MapCalibration, c[k : k + _N_CALIBRATION])
        made.__dict__["design_logs"] = tuple(v[f"{name}.{n}"] for n in _LOGS)
        made.__dict__["factors"] = tuple(v[f"{name}.{n}"] for n in _FACTORS)
        scaled.append(made)
    ref = {n: v[f"reference.{n}"] for n in _REFERENCES}
    cmap, tmap = scaled
    return UnitParts(p, gas, design, cmap, tmap, ref)


def vector(
    p: GasGeneratorParameters, gas: Gas, design: DesignPoint, maps: tuple[ScaledMap, ScaledMap]
) -> np.ndarray:
    """Return the numbers of an engine, in the order of ``NUMBERS``."""
    given = [row[1] for row in p.table()]
    for m in maps:
        given += [m.N_map_des, m.beta_des, *(row[1] for row in m.cal.table())]
    coefficients, R = gas.burning
    first = [design.A3, design.A8, design.W_t, design.PR_t]
    z = [design.z[n] for n in TEMPERATURES]
    values = [design.values[n] for n in _VALUES]
    logs = [e for m in maps for e in m.design_logs]
    last = [*references(p, design), *(e for m in maps for e in m.factors)]
    return np.array([*given, *first, *z, *values, *logs, *coefficients.ravel(), R, *last], float)


def derivation(data: str, compressor: MapTable, turbine: MapTable) -> ca.Function:
    """Return the differentiable Function given -> (derived, residual of the design point).

    It starts as :func:`~apu_casadi.gaspath.design.solve_design` does.  A search that fails is told
    by the residual alone, which every user has to look at.
    """
    eq = design_equations(data)
    given = ca.MX.sym("given", len(GIVEN))
    own, at = given[: len(OWN)], GIVEN.index
    options = {"abstol": 1e-13, "abstolStep": 1e-12, "max_iter": 40, "error_on_fail": False}
    root = ca.rootfinder("design_root", "fast_newton", eq.residual, options)
    w = root(eq.start(own), own)
    point = eq.point(w, own)
    rest = dict(zip(eq.values, ca.vertsplit(point[4 + len(TEMPERATURES) :]), strict=True))
    logs = []
    for name, table in zip(MAPS, (compressor, turbine), strict=True):
        place = (given[at(f"{name}.{n}")] for n, _ in _PLACE)
        logs.append(table_logs(table)(*place)[1])
    x = ca.SX.sym("x")
    coefficients, R = fuel_burning(x, data)
    fuel = ca.Function("fuel", [x], [ca.vertcat(ca.vec(coefficients.T), R)])
    burnt = fuel(own[OWN.index("gas_generator.x_HC")])
    first = point[: 4 + len(TEMPERATURES)]
    most = ca.vertcat(first, *(rest[n] for n in _VALUES), *logs, burnt)
    c = ca.SX.sym("c", len(NUMBERS))
    unit = parts(c, data, compressor, turbine)
    factors = (e for m in (unit.cmap, unit.tmap) for e in scale_factors(m))
    last = ca.vertcat(*references(unit.p, unit.design), *factors)
    more = ca.Function("references", [c], [last])
    derived = ca.vertcat(most, more(ca.vertcat(given, most, ca.DM.zeros(last.numel()))))
    names = ["given"], ["derived", "residual"]
    # a root below the bounds, such as one of negative fuel flow, is none
    bounds = ca.if_else(ca.mmin(w - ca.DM(eq.newton.lower)) > 0, 0.0, 1.0)
    residual = ca.norm_inf(eq.residual(w, own)) + bounds
    return ca.Function("derivation", [given], [derived, residual], *names)
