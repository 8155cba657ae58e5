"""Tables 4, 5, 7 and 8 of the paper, recomputed.

Table 5's row "P1" is the ambient static pressure, not the total pressure that its name says
(35.5998 kPa is 8000 m ISA): it is compared with station 0.
"""

from __future__ import annotations

import math

from apu_casadi.core.sharing import once
from apu_casadi.gaspath.designdata import RPM
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from scenarios.validation.comparison import Row, compared, mean_row, reference, section

#: paper's row name: (output of the model, factor from SI to the table's unit)
_ROWS = {
    "XNHPC": ("N", 1 / RPM),
    "PWSD": ("PW", 1e-3),
    "SFC": ("SFC", 3.6e6),
    "SNOx": ("SNOx", 1.0),
    "HPCSM": ("SM", 100.0),
    "P1": ("P0", 1e-3),
    **{f"T{n}": (f"T{n}", 1.0) for n in (1, 2, 3, 4, 41, 5, 8)},
    **{f"W{n}": (f"W{n}", 1.0) for n in (2, 3, 4, 41, 5, 8)},
    **{n: (n, 1e-3) for n in ("P2", "P3", "Ps3", "P4", "P5", "P8")},
}


def design_point(gg: GasGenerator | None = None) -> OperatingPoint:
    """Table 4: speed and T4 given, as the design calculation takes them."""
    gg = gg or _engine()
    p = gg.parameters
    return trim_gas_generator(
        gg, {"N": p.N, "T4": p.T4}, altitude=p.altitude, Mach=p.Mach, dT_isa=p.dT_isa, war=p.war
    )


def high_altitude_point(gg: GasGenerator | None = None) -> OperatingPoint:
    """Table 5: 8000 m (the paper prints 8000km), Mach 0.7, ISA + 5 K, speed and power given."""
    gg = gg or _engine()
    fixed = {"N": gg.parameters.N, "PW": 221821.5}
    return trim_gas_generator(gg, fixed, altitude=8000.0, Mach=0.7, dT_isa=5.0)


@once
def _engine() -> GasGenerator:
    return Apu().gas_generator


def _compare(
    table: str,
    point: OperatingPoint,
    inputs: set[str],
    calibrated: set[str],
    tolerance: float,
    reason: str,
) -> list[Row]:
    rows = []
    for r in reference(table):
        name = r["parameter"]
        output, factor = _ROWS[name]
        ours, ref = point[output] * factor, float(r["GasTurb"])
        kind = "input" if name in inputs else "calibrated" if name in calibrated else "predicted"
        tol = 1e-4 if kind != "predicted" else tolerance
        given = "given to the calculation; digits of the printed table"
        fitted = "a map number was fitted to this row"
        why = {"input": given, "calibrated": fitted}.get(kind, reason)
        rows.append(compared(name, r["unit"], ref, ours, tol, why, kind))
    return rows


@section("table4", "Table 4: design point, 0 km, Mach 0, 500 kW", order=10)
def table4() -> list[Row]:
    """Compute every row from the inputs; no map enters at the design point but for HPCSM."""
    rows = _compare(
        "table4",
        design_point(),
        inputs={"XNHPC", "T1", "P1", "W2", "W3", "T4", "T2"},
        calibrated={"HPCSM", "Ps3"},
        tolerance=1e-3,
        reason="half-ideal gas against GasTurb's own gas tables",
    )
    predicted = [r for r in rows if r.kind == "predicted"]
    return [*rows, mean_row(predicted, "predicted", 2e-4, "goal for a calculation without tuning")]


@section("table5", "Table 5: off-design point, 8000 m, Mach 0.7, 222 kW", order=11)
def table5() -> list[Row]:
    """Compute every row; W2, T3, P3, T5 and HPCSM were used to calibrate the maps."""
    rows = _compare(
        "table5",
        high_altitude_point(),
        inputs={"XNHPC", "PWSD", "P1"},
        calibrated={"W2", "W3", "T3", "P3", "T5", "T8", "HPCSM"},
        tolerance=3e-3,
        reason="closures of the design point carried to altitude by the calibrated maps",
    )
    predicted = [r for r in rows if r.kind == "predicted"]
    return [*rows, mean_row(predicted, "predicted", 5e-4, "goal for the rows not calibrated")]


def _terminal(table: str, P: float, kind: str, tolerance: float, reason: str) -> list[Row]:
    gen = Generator()
    point = gen.steady_state(SeriesLoad.from_power(P), V_ref=gen.V_ref_default)
    V = point.y["V_t"]
    I = math.sqrt(sum(point.y[f"i_{p}"] ** 2 for p in "abc") / 3)
    rows = []
    for r in reference(table):
        name, ref = r["parameter"], float(r["SM_MATLAB"])
        ours = I if "Current" in name else V * math.sqrt(3) if "Line" in name else V
        rows.append(compared(name, r["unit"], ref, ours, tolerance, reason, kind))
    return rows


@section("table7", "Table 7: starter/generator, 225 kW", order=12)
def table7() -> list[Row]:
    """Terminal voltage is where V_ref was set (calibrated); currents follow from the load."""
    reason = "the reference's own phases scatter by 3e-4 of their mean"
    return _terminal("table7", 225e3, "calibrated", 3e-4, reason)


@section("table8", "Table 8: starter/generator, 100 kW", order=13)
def table8() -> list[Row]:
    """Predict the terminal voltage at 100 kW with the voltage setting of Table 7."""
    reason = "regulator droop with K_A = 250, known only to lie between 215 and 264"
    return _terminal("table8", 100e3, "predicted", 3e-4, reason)
