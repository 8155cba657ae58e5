"""The numbers of one gas generator as a vector c: what it is given, and what follows from it.

The compiled functions of an engine take c as an argument, so that engines which differ in numbers
share them.  ``GIVEN`` are the parameters by dotted name (``gas_generator.eta_c``,
``compressor_map.a_W``); ``DERIVED`` is what the design point and the fuel make of them: computed
once for an engine, and by :func:`derivation` as a differentiable function.  Structure, which is
compiled in, are gas data and map tables.
"""

from __future__ import annotations

from typing import NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.design import DesignPoint, design_equations, number_signals, of_symbols
from apu_casadi.gaspath.designdata import GasGeneratorParameters
from apu_casadi.gaspath.gas import Gas, fuel_burning, used
from apu_casadi.gaspath.maps.maptable import MapTable
from apu_casadi.gaspath.maps.scaledmaps import MapCalibration, ScaledMap, table_logs
from apu_casadi.gaspath.stations import TEMPERATURES

MAPS = ("compressor_map", "turbine_map")
_PLACE = (
    ("N_map_des", "table speed of the design point"),
    ("beta_des", "table beta of the design point"),
)


def _map_signals(name: str) -> Signals:
    place = [Signal(f"{name}.{n}", "1", doc) for n, doc in _PLACE]
    return Signals(place) + number_signals(MapCalibration, name)


_N_CALIBRATION = len(number_signals(MapCalibration, "map"))
OWN = number_signals(GasGeneratorParameters, "gas_generator")
GIVEN = OWN + _map_signals("compressor_map") + _map_signals("turbine_map")
"""The parameters: design data, then each map's place of the design point and calibration."""

_VALUES = ("T2", "P2", "P4", "W5", "P5", "Wf", "PW")  # of the design point, beside z
_LOGS = ("ln_W", "ln_PR_1", "ln_eta")
_LETTERS = ["a1", "a2", "a3", "a4", "a5", "a6", "a7", "b1", "b2"]
_RANGES = tuple(f"{r}_{a}" for r in ("low", "high") for a in _LETTERS)
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
    ]
)
"""What follows from them."""

NUMBERS = GIVEN + DERIVED


class UnitParts(NamedTuple):
    """Parameters, gas, design point and maps of an engine whose numbers are symbols."""

    p: GasGeneratorParameters
    gas: Gas
    design: DesignPoint
    cmap: ScaledMap
    tmap: ScaledMap


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
        scaled.append(made)
    return UnitParts(p, gas, design, *scaled)


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
    return np.array([*given, *first, *z, *values, *logs, *coefficients.ravel(), R], float)


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
    derived = ca.vertcat(first, *(rest[n] for n in _VALUES), *logs, burnt)
    names = ["given"], ["derived", "residual"]
    residual = ca.norm_inf(eq.residual(w, own))
    return ca.Function("derivation", [given], [derived, residual], *names)
