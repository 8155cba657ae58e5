"""Run the gas generator's cycle in pyCycle: JSON on standard input, JSON on standard output.

A script, not a module of the package: it runs under a Python that has om-pycycle 4.4.0, which
needs NumPy below 2.3, and imports nothing of the project.
:mod:`scenarios.validation.peers.pycycle` starts it.  Everything in and out is SI (K, Pa, kg/s, W,
J/kg, r/min).

The cycle: inlet, compressor, three bleeds at its exit, burner, vane cooling mixed at constant
pressure before the rotor, turbine with the rotor cooling mixed behind it, exhaust duct, nozzle,
shaft.  All elements are pyCycle's; it has none that mixes cooling air before a rotor, so that one
is composed of its public ThermoAdd and Thermo.
"""

from __future__ import annotations

import contextlib
import copy
import io
import json
import sys
import time
from importlib.metadata import version
from typing import Any

import numpy as np
import openmdao.api as om
import pycycle.api as pyc
from pycycle.element_base import Element
from pycycle.flow_in import FlowIn
from pycycle.passthrough import PassThrough
from pycycle.thermo.thermo import Thermo, ThermoAdd

BTU_LBM = 2326.0  # J/kg, International Table
FUEL = "CHx"
_STATION = {
    "W": {"units": "kg/s", "val": 3.0},
    "P": {"units": "Pa", "val": 1e5},
    "T": {"units": "K", "val": 700.0},
}


class MixCooling(Element):
    """Mixes a cooling flow into the main flow at the main flow's total pressure."""

    def pyc_setup_output_ports(self) -> None:
        """Hand the mixed composition down the chain."""
        self.add = ThermoAdd(
            method=self.options["thermo_method"],
            mix_mode="flow",
            mix_names="cool",
            thermo_kwargs={
                "spec": self.options["thermo_data"],
                "inflow_composition": self.Fl_I_data["Fl_I"],
                "mix_composition": self.Fl_I_data["cool"],
            },
        )
        self.copy_flow(self.add, "Fl_O")

    def setup(self) -> None:
        """Energy balance by ThermoAdd, state by Thermo."""
        for port in ("Fl_I", "cool"):
            self.add_subsystem(f"{port}_in", FlowIn(fl_name=port), promotes_inputs=[f"{port}:*"])
        self.add_subsystem(
            "add",
            self.add,
            promotes_inputs=[
                "Fl_I:stat:W",
                "Fl_I:tot:h",
                "Fl_I:tot:composition",
                ("cool:h", "cool:tot:h"),
                ("cool:W", "cool:stat:W"),
                ("cool:composition", "cool:tot:composition"),
            ],
            promotes_outputs=["Wout"],
        )
        state = Thermo(
            mode="total_hP",
            fl_name="Fl_O:tot",
            method=self.options["thermo_method"],
            thermo_kwargs={
                "composition": self.Fl_O_data["Fl_O"],
                "spec": self.options["thermo_data"],
            },
        )
        self.add_subsystem(
            "state", state, promotes_inputs=[("P", "Fl_I:tot:P")], promotes_outputs=["Fl_O:*"]
        )
        self.connect("add.mass_avg_h", "state.h")
        self.connect("add.composition_out", "state.composition")
        self.add_subsystem(
            "pass_W", PassThrough("Wout", "Fl_O:stat:W", 1.0, units="lbm/s"), promotes=["*"]
        )
        super().setup()


def corrected_flow() -> om.ExecComp:
    """Return a component that computes W sqrt(T) / P, kg/s sqrt(K) / Pa."""
    return om.ExecComp("flow = W * T**0.5 / P", flow={"val": 1e-4}, **_STATION)


def scaled_loss(at_design: float) -> om.ExecComp:
    """Return a relative pressure loss that grows with the square of the corrected flow."""
    equation = f"dPqP = {at_design!r} * (W / P / flow_des) ** 2 * T"
    return om.ExecComp(equation, flow_des={"val": 1e-4}, dPqP={"val": at_design}, **_STATION)


class Turboshaft(pyc.Cycle):
    """A single-shaft engine at a given speed."""

    def initialize(self) -> None:
        """Declare the maps."""
        super().initialize()
        self.options.declare("maps", types=dict, recordable=False)
        self.options.declare("losses", types=dict, recordable=False)
        self.options.declare("interpolation", types=str)

    def setup(self) -> None:
        """Elements from 0 to 8, and what balances what."""
        design, maps = self.options["design"], self.options["maps"]
        table = {"map_extrap": True, "map_interp_method": self.options["interpolation"]}
        bleeds = ["overboard", "vane", "rotor"]
        for name, element in {
            "fc": pyc.FlightConditions(),
            "inlet": pyc.Inlet(statics=False),
            "comp": pyc.Compressor(map_data=maps["compressor"], statics=False, **table),
            "bleed": pyc.BleedOut(statics=False, bleed_names=bleeds),
            "burner": pyc.Combustor(fuel_type=FUEL, statics=False),
            "mix": MixCooling(),
            "turb": pyc.Turbine(
                map_data=maps["turbine"], statics=False, bleed_names=["rotor"], **table
            ),
            "duct": pyc.Duct(statics=False),
            "nozz": pyc.Nozzle(nozzType="CV", lossCoef="Cv"),
            "shaft": pyc.Shaft(num_ports=2),
        }.items():
            on_shaft = name in ("comp", "turb", "shaft")
            self.add_subsystem(name, element, promotes_inputs=["Nmech"] if on_shaft else None)
        self.pyc_connect_flow("fc.Fl_O", "inlet.Fl_I", connect_w=False)
        for a, b in (
            ("inlet.Fl_O", "comp.Fl_I"),
            ("comp.Fl_O", "bleed.Fl_I"),
            ("bleed.Fl_O", "burner.Fl_I"),
            ("burner.Fl_O", "mix.Fl_I"),
            ("bleed.vane", "mix.cool"),
            ("mix.Fl_O", "turb.Fl_I"),
            ("bleed.rotor", "turb.rotor"),
            ("turb.Fl_O", "duct.Fl_I"),
            ("duct.Fl_O", "nozz.Fl_I"),
        ):
            self.pyc_connect_flow(a, b, connect_stat=False)
        for k, part in enumerate(("comp", "turb")):
            self.connect(f"{part}.trq", f"shaft.trq_{k}")
        self.connect("fc.Fl_O:stat:P", "nozz.Ps_exhaust")

        # losses: pyCycle keeps them constant off design, the package scales them
        for name, station in (("burner", "bleed.Fl_O"), ("duct", "turb.Fl_O")):
            at_design = self.options["losses"][name]
            block = corrected_flow() if design else scaled_loss(at_design)
            self.add_subsystem(f"{name}_loss", block)
            for port, quantity in (("W", "stat:W"), ("P", "tot:P"), ("T", "tot:T")):
                self.connect(f"{station}:{quantity}", f"{name}_loss.{port}")
            if design:
                self.set_input_defaults(f"{name}.dPqP", val=at_design)
            else:
                self.connect(f"{name}_loss.dPqP", f"{name}.dPqP")

        balance = self.add_subsystem("balance", om.BalanceComp())
        if design:
            self.set_input_defaults("inlet.Fl_I:stat:W", val=3.0, units="kg/s")
            balance.add_balance("FAR", eq_units="degK", lower=1e-4, val=0.018, rhs_name="T4_target")
            self.connect("balance.FAR", "burner.Fl_I:FAR")
            self.connect("burner.Fl_O:tot:T", "balance.lhs:FAR")
            balance.add_balance("PR", val=7.3, lower=1.5, upper=20.0, rhs_name="NPR_target")
            self.connect("balance.PR", "turb.PR")
            self.connect("nozz.PR", "balance.lhs:PR")
        else:
            balance.add_balance("FAR", eq_units="kW", lower=1e-4, val=0.018, rhs_val=0.0)
            self.connect("balance.FAR", "burner.Fl_I:FAR")
            self.connect("shaft.pwr_net", "balance.lhs:FAR")
            balance.add_balance("W", val=3.1, units="kg/s", lower=0.1, eq_units="inch**2")
            self.connect("balance.W", "inlet.Fl_I:stat:W")
            self.connect("nozz.Throat:stat:area", "balance.lhs:W")

        options = {"atol": 1e-9, "rtol": 1e-12, "maxiter": 60, "max_sub_solves": 100}
        options |= {"reraise_child_analysiserror": False, "err_on_non_converge": True}
        newton = self.nonlinear_solver = om.NewtonSolver(solve_subsystems=True, **options)
        newton.options["iprint"] = -1
        newton.linesearch = om.ArmijoGoldsteinLS(maxiter=3, rho=0.75, iprint=-1)
        self.linear_solver = om.DirectSolver()
        super().setup()


class Points(pyc.MPCycle):
    """Design point and one off-design point, which is moved from condition to condition."""

    def initialize(self) -> None:
        """Declare what both points share."""
        super().initialize()
        self.options.declare("cycle", types=dict, recordable=False)

    def setup(self) -> None:
        """Connect areas and map scales of the design point to the other."""
        kw = self.options["cycle"]
        self.pyc_add_pnt("DESIGN", Turboshaft(thermo_method="CEA", **kw))
        self.pyc_add_pnt("OD", Turboshaft(design=False, thermo_method="CEA", **kw))
        # the default connections also carry flow areas, which elements without statics lack
        for part, flow, speed in (("comp", "s_Wc", "s_Nc"), ("turb", "s_Wp", "s_Np")):
            for scale in (flow, speed, "s_PR", "s_eff"):
                self.pyc_connect_des_od(f"{part}.{scale}", f"{part}.{scale}")
        self.pyc_connect_des_od("nozz.Throat:stat:area", "balance.rhs:W")
        for name in ("burner", "duct"):
            self.pyc_connect_des_od(f"{name}_loss.flow", f"{name}_loss.flow_des")
        super().setup()


def one_slice(source: Any) -> Any:
    """Return a map with its alpha slice repeated: splines want five points on every axis."""
    table = copy.deepcopy(source)
    alpha = table.param_data[0]
    alpha["values"] = float(alpha["values"][0]) + np.arange(5.0)
    for quantity in table.output_data:
        quantity["values"] = np.repeat(quantity["values"][:1], 5, axis=0)
    return table


def fuel_enthalpy(x: float, LHV: float) -> float:
    """Return the fuel's enthalpy, J/kg, that gives the heating value LHV at 298.15 K.

    CHx + (1 + x/4) O2 -> CO2 + x/2 H2O, from pyCycle's own species.  Left at its default of zero,
    the fuel flow comes out 4.0 % low.
    """
    data = pyc.species_data.janaf
    species = pyc.species_data.Properties(data, init_elements={k: 1.0 for k in ("C", "H", "O")})
    T = 298.15
    h = dict(zip(species.products, species.H0(np.array([T])) * 8.31446 * T, strict=True))
    M = (data.element_wts["C"] + x * data.element_wts["H"]) * 1e-3
    return float(LHV + (h["CO2"] + x / 2 * h["H2O"] - (1 + x / 4) * h["O2"]) / M)


def read(prob: om.Problem, pt: str) -> dict[str, float]:
    """Return station values, SI."""

    def get(name: str, units: str | None = None) -> float:
        return float(np.ravel(prob.get_val(f"{pt}.{name}", units=units))[0])

    out, ports = {}, {"2": "inlet", "3": "comp", "4": "burner", "41": "mix", "5": "turb"}
    for station, port in (ports | {"8": "nozz"}).items():
        out[f"T{station}"] = get(f"{port}.Fl_O:tot:T", "K")
        out[f"P{station}"] = get(f"{port}.Fl_O:tot:P", "Pa")
    out["P0"] = get("fc.Fl_O:stat:P", "Pa")
    out["T0"] = get("fc.Fl_O:stat:T", "K")
    out["W2"] = get("inlet.Fl_O:stat:W", "kg/s")
    out["Wf"] = get("burner.Wfuel", "kg/s")
    out["P_turb"] = get("turb.power", "W")
    out["P_cpr"] = -get("comp.power", "W")
    out["P_shaft"] = out["P_turb"] - out["P_cpr"]
    out["PR_c"], out["PR_t"] = get("comp.PR"), get("turb.PR")
    out["eta_c"], out["eta_t"] = get("comp.eff"), get("turb.eff")
    if pt == "OD":
        out["beta_c"], out["PRmap_t"] = get("comp.map.RlineMap"), get("turb.map.PRmap")
        out["NcMap"], out["NpMap"] = get("comp.map.NcMap"), get("turb.map.NpMap")
    out["A8"] = get("nozz.Throat:stat:area", "m**2")
    return out


def main(case: dict[str, Any]) -> dict[str, Any]:
    """Solve the design point and every off-design point of the case."""
    start = time.perf_counter()
    d = case["design"]
    pyc.species_data.janaf.reactants[FUEL] = {"C": 1.0, "H": d["x_HC"]}
    maps = {"compressor": one_slice(pyc.AXI5), "turbine": one_slice(pyc.LPT2269)}
    maps["turbine"].defaults["PRmap"] = case["turbine_PRmap"]
    losses = {"burner": d["dp_burner"], "duct": d["dp_exhaust"]}
    prob = om.Problem(reports=False)
    prob.model = Points(
        cycle={"maps": maps, "losses": losses, "interpolation": case["interpolation"]}
    )
    prob.setup()
    prob.set_solver_print(level=-1)
    h_fuel = fuel_enthalpy(d["x_HC"], d["LHV"]) / BTU_LBM

    def put(pt: str, name: str, value: float, units: str | None = None) -> None:
        prob.set_val(f"{pt}.{name}", value, units=units)

    def ambient(pt: str, c: dict[str, float]) -> None:
        put(pt, "fc.alt", c["altitude"], "m")
        put(pt, "fc.MN", max(c["Mach"], 1e-6))  # its statics divide by the Mach number
        put(pt, "fc.dTs", 1.8 * c["dT_isa"], "degR")

    for pt in ("DESIGN", "OD"):
        ambient(pt, d)
        put(pt, "Nmech", d["N_rpm"], "rpm")
        put(pt, "inlet.ram_recovery", 1 - d["dp_inlet"])
        for k in ("overboard", "vane", "rotor"):
            put(pt, f"bleed.{k}:frac_W", d[f"bleed_{k}"])
        put(pt, "burner.mix_fuel.mix:h", h_fuel, "Btu/lbm")
        put(pt, "turb.rotor:frac_P", 0.0)  # mixes behind the rotor: no work
        put(pt, "nozz.Cv", 1.0)
    put("DESIGN", "inlet.Fl_I:stat:W", d["W2"], "kg/s")
    put("DESIGN", "comp.PR", d["PR_c"])
    put("DESIGN", "comp.eff", d["eta_c"])
    put("DESIGN", "turb.eff", d["eta_t"])
    put("DESIGN", "balance.T4_target", d["T4"], "degK")
    put("DESIGN", "balance.NPR_target", d["NPR"])
    for name in ("burner", "duct"):
        put("DESIGN", f"{name}.dPqP", losses[name])

    # first guesses; every solution is converged to the same residual whatever they are
    put("OD", "balance.W", d["W2"], "kg/s")
    for pt in ("DESIGN", "OD"):
        put(pt, "balance.FAR", case["guess"]["FAR"])
        put(pt, "fc.balance.Tt", case["guess"]["T2"], "degK")
    put("DESIGN", "balance.PR", case["guess"]["PR_t"])
    put("OD", "turb.map.PRmap", case["turbine_PRmap"])

    points = []
    for n, c in enumerate(case["points"]):
        ambient("OD", c)
        put("OD", "shaft.HPX", c["P_shaft"], "W")
        prob.run_model()
        points.append(read(prob, "OD"))
        if n == 0:
            cold = time.perf_counter() - start
    return {
        "design": read(prob, "DESIGN"),
        "points": points,
        "seconds": {"first": cold, "all": time.perf_counter() - start},
        "versions": {k: version(k) for k in ("om-pycycle", "openmdao", "numpy")},
    }


if __name__ == "__main__":
    with contextlib.redirect_stdout(io.StringIO()):  # standard output is for the JSON alone
        result = main(json.load(sys.stdin))
    json.dump(result, sys.stdout)
