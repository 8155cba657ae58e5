"""Design point, off-design line and an altitude point against pyCycle, as ratios.

pyCycle solves the same cycle with its own code: NASA-9 gas in chemical equilibrium, its own map
reader, Newton's method of OpenMDAO.  Both use the maps AXI5 and LPT2269 with the same design
locations and none of the package's calibration numbers, and the package's gas data are set to
``nasa9`` here.  What then differs has three causes:

* *dissociation*: at T4 = 1200 K the equilibrium gas binds 0.04 % of cp T in NO, 0.08 % of the
  fuel's heat; it is given back on the way through the turbine.  Checked against Cantera below.
* *interpolation*: pyCycle reads maps linearly by default, up to 0.3 % away from a smooth curve
  halfway between the lines of the table; with its Akima splines a tenth of that remains.
* *gas data*: the package's default, ``nasa7``, adds 0.03 % to T3 and 0.05 % to the fuel.

pyCycle's fuel enters at an enthalpy that is free, zero by default: 4 % too little fuel.  The
script sets the one that makes the heating value.

pyCycle needs NumPy below 2.3, hence a Python of its own, named by the variable
``APU_PYCYCLE_PYTHON`` or by ``apu validate --pycycle-python``.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from typing import Any

from apu_casadi.gaspath.designdata import RPM
from apu_casadi.gaspath.gas import T_REF
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.maps.scaledmaps import MapCalibration
from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from scenarios.validation.comparison import Row, SkippedError, compared, relative, section, timing
from scenarios.validation.peers.process import end_all, run_script

VARIABLE = "APU_PYCYCLE_PYTHON"
COMPARED = {"T3": "K", "P3": "Pa", "T4": "K", "T5": "K", "W2": "kg/s", "Wf": "kg/s", "SFC": "kg/J"}
SEA_LEVEL = {"altitude": 0.0, "Mach": 0.0, "dT_isa": 5.0}
HIGH = {"altitude": 8000.0, "Mach": 0.7, "dT_isa": 5.0}  # Table 5
PW_DESIGN, PW_HIGH = 500e3, 221821.5  # W
LINE = tuple((f"{100 * f:.0f} %", f * PW_DESIGN, SEA_LEVEL) for f in (1.0, 0.8, 0.6, 0.4))
POINTS = (*LINE, ("8000 m", PW_HIGH, HIGH))
SMOOTH, LINEAR = "akima", "slinear"  # pyCycle's names; the second is its default

_GIVEN = (1e-7, "given to both")
_DISSOCIATION = "equilibrium gas binds 0.04 % of cp T at T4 in NO: 0.08 % of the fuel's heat"
DESIGN_TOLERANCE: dict[str, tuple[float, str]] = {
    "T3": (5e-5, "same data, no reaction in the compressor; printed digits"),
    "P3": (1e-5, "given to both; digits of pyCycle's table of the atmosphere"),
    "T4": (1e-6, "given to both; solver tolerance"),
    "T5": (6e-4, "heat of dissociation given back by 750 K"),
    "W2": _GIVEN,
    "Wf": (1e-3, _DISSOCIATION),
    "SFC": (4e-4, "as Wf, less what the given-back heat adds to the power"),
}
_SPLINES = "splines of two kinds through one table: 2e-4 of eta halfway between lines"
LINE_TOLERANCE = (6e-4, f"{_SPLINES}; dissociation")
LINEAR_TOLERANCE = (3e-3, "linear against smooth between table lines: 0.12 % of eta_t at 80 %")


def interpreter() -> str:
    """Return the Python that has pyCycle.

    Raises:
        SkippedError: none is named, or what is named does not exist.
    """
    named = os.environ.get(VARIABLE, "")
    if not named:
        raise SkippedError(
            f"no Python with pyCycle is named: set {VARIABLE} or give --pycycle-python; "
            "scenarios/validation/peers/pycycle-requirements.txt says what to install"
        )
    found = shutil.which(named)
    if found is None:
        raise SkippedError(f"{VARIABLE} = {named!r} is not a program that can be run")
    return os.path.abspath(found)


def engine(gas_data: str = "nasa9") -> GasGenerator:
    """Return the gas generator with uncalibrated maps."""
    gg = GasGenerator()
    plain = {
        name: dataclasses.replace(getattr(gg, name), calibration=MapCalibration())
        for name in ("compressor_map", "turbine_map")
    }
    parameters = dataclasses.replace(gg.parameters, gas_data=gas_data)
    return dataclasses.replace(gg, parameters=parameters, **plain)


def pycycle_case(gg: GasGenerator, interpolation: str) -> dict[str, Any]:
    """Return what the script needs: design data, map locations, points, first guesses."""
    p, d = gg.parameters, gg.design.values
    beta, table = gg.turbine_map.beta_des, gg.turbine_map.table
    low, high = float(table.PR.min()), float(table.PR.max())
    air = ("altitude", "Mach", "dT_isa", "dp_inlet", "dp_burner", "dp_exhaust")
    cycle = ("W2", "PR_c", "eta_c", "eta_t", "T4", "NPR", "x_HC", "LHV")
    design = {n: getattr(p, n) for n in (*air, *cycle)}
    design |= {
        "N_rpm": p.N / RPM,
        "bleed_overboard": p.bleed_overboard,
        "bleed_vane": p.cool_ngv,
        "bleed_rotor": p.cool_rotor,
    }
    return {
        "design": design,
        "turbine_PRmap": low + beta * (high - low),  # the table's beta is linear in PR
        "interpolation": interpolation,
        "points": [{**ambient, "P_shaft": PW + p.P_acc} for _, PW, ambient in POINTS],
        "guess": {"FAR": d["Wf"] / d["W31"], "T2": d["T2"], "PR_t": gg.design.PR_t},
    }


def run_pycycle(gg: GasGenerator, *interpolations: str) -> list[dict[str, Any]]:
    """Run the script once for each map interpolation, side by side."""
    python = interpreter()
    cases = [pycycle_case(gg, i) for i in interpolations]
    with ThreadPoolExecutor(len(cases)) as pool:
        try:
            return list(pool.map(lambda c: run_script(python, "pycycle_run.py", c), cases))
        except BaseException:
            end_all()  # or leaving the block would wait for them
            raise


def trimmed(gg: GasGenerator) -> list[OperatingPoint]:
    """Return the package's points of :data:`POINTS`, at design speed."""
    N = gg.parameters.N
    return [
        trim_gas_generator(
            gg, {"N": N, "PW": PW}, altitude=a["altitude"], Mach=a["Mach"], dT_isa=a["dT_isa"]
        )
        for _, PW, a in POINTS
    ]


def design_values(gg: GasGenerator) -> dict[str, float]:
    """Return the package's design point; SFC over the shaft power, accessories included."""
    d = dict(gg.design.values)
    d["P_shaft"] = d["P_turb"] - d["P_cpr"]
    return d | {"SFC": d["Wf"] / d["P_shaft"]}


def explained(gg: GasGenerator, peer: dict[str, float]) -> list[Row]:
    """Account for the differences at the design point, where no map takes part.

    The equilibrium gas needs dh more enthalpy at T4, hence W4 dh / (LHV - h4) more fuel, to first
    order in the fuel.  The heat of that fuel must reappear as power and as exhaust temperature.
    """
    d, gas = design_values(gg), gg.gas
    rows = []
    more = peer["Wf"] - d["Wf"]
    h4 = float(gas.h(d["T4"], d["FAR4"]))
    if find_spec("cantera") is not None:
        from scenarios.validation.peers.gas import PRODUCTS, mixture, solution

        c = solution(PRODUCTS)
        c.TPX = T_REF, d["P4"], mixture(d["FAR4"], 0.0, gas.x_HC)
        c.TP = d["T4"], d["P4"]
        frozen = c.h
        c.equilibrate("TP")
        predicted = d["W4"] * (c.h - frozen) / (gg.parameters.LHV - h4)
        what, why = (
            "design: more fuel in pyCycle, by Cantera's equilibrium",
            "first order in the fuel",
        )
        why += "; NASA-7 in Cantera"
        rows.append(compared(what, "kg/s", more, predicted, 0.05, why, "check"))
    FAR5 = d["Wf"] / (0.99 * gg.parameters.W2)
    cp5, h5 = float(gas.cp(d["T5"], FAR5)), float(gas.h(d["T5"], FAR5))
    heat = more * (gg.parameters.LHV - h5)
    used = peer["P_shaft"] - d["P_shaft"] + d["W5"] * cp5 * (peer["T5"] - d["T5"])
    what = "design: heat of that fuel, in power and exhaust"
    why = "first order in the differences: nothing else differs"
    return [*rows, compared(what, "W", heat, used, 0.05, why, "check")]


@section(
    "pycycle",
    "Gas generator against pyCycle: design, off-design line, altitude, as ratios",
    order=60,
)
def pycycle() -> list[Row]:
    """Compare T3, P3, T4, T5, W2, Wf and SFC; ``error`` is the ratio less one.

    Raises:
        SkippedError: no Python with pyCycle is named.
    """
    gg = engine()
    smooth, linear = run_pycycle(gg, SMOOTH, LINEAR)
    rows = []
    for label, data, extra in (("design", "nasa9", 0.0), ("design, nasa7", "nasa7", 5e-4)):
        values = design_values(engine(data))
        peer = smooth["design"] | {"SFC": smooth["design"]["Wf"] / smooth["design"]["P_shaft"]}
        for k, (tolerance, reason) in DESIGN_TOLERANCE.items():
            if extra and reason.startswith("given"):  # nothing new to see
                continue
            why = f"{reason}; data of 1993, not of 2002" if extra else reason
            pair = (peer[k], values[k])
            tol = tolerance + extra
            rows.append(compared(f"{label}: {k}", COMPARED[k], *pair, tol, why, "check"))
    rows += explained(gg, smooth["design"])
    points = trimmed(gg)
    for (label, PW, _), mine, peer in zip(POINTS, points, smooth["points"], strict=True):
        theirs = peer | {"SFC": peer["Wf"] / (PW + gg.parameters.P_acc)}
        rows += [
            compared(f"{label}: {k}", unit, theirs[k], mine[k], *LINE_TOLERANCE, "check")
            for k, unit in COMPARED.items()
        ]
    for (label, _, _), mine, peer in zip(POINTS, points, linear["points"], strict=True):
        same = [k for k in COMPARED if k in peer]  # SFC goes with Wf
        k = max(same, key=lambda k: abs(relative(mine[k], peer[k])))
        what = f"{label}, linear maps, the worst: {k}"
        rows.append(compared(what, COMPARED[k], peer[k], mine[k], *LINEAR_TOLERANCE, "check"))
    s = smooth["seconds"]
    what = f"pyCycle {smooth['versions']['om-pycycle']}, wall time"
    for k, label in (("first", "design and first point"), ("all", "all points")):
        rows.append(timing(f"{what}, {label}", "s", s[k]))
    return rows
