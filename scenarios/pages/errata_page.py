"""The page ``docs/ERRATA.md``: what the paper leaves open or contradicts, and what the choice does.

``apu errata --write docs/ERRATA.md`` makes it; its rows and sentences stand in
``templates/errata.md``, every number of the column "effect" is computed here from the model, so
that none is typed by hand and none grows stale unseen.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core import simulation
from apu_casadi.core.errors import OperatingPointError
from apu_casadi.core.sharing import once
from apu_casadi.core.units import RPM
from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.control import GovernorParameters
from apu_casadi.unit.events import LoadChange
from apu_casadi.unit.multirate import simulate_joint
from apu_casadi.unit.runsummary import phase_summary
from scenarios import registry
from scenarios.pages import shaftpower
from scenarios.shell.template import Template
from scenarios.validation.comparison import reference
from scenarios.validation.paper_figures import HEALTH
from scenarios.validation.paper_tables import design_point, high_altitude_point, table4, table5

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.gaspath.gasgenerator import GasGenerator

TEXT = Template.of("errata.md")
KW225, KW100 = SeriesLoad.from_power(225e3), SeriesLoad.from_power(100e3)
BREAK = "<br>"
SETTLE = 1.5  # s; the slowest mode of generator and exciter decays with 8 1/s


@dataclass(frozen=True)
class Item:
    """One entry of the page.

    Args:
        where: place in the paper.
        what: what is open or contradictory.
        choice: what the package does.
        effect: what the choice changes; in braces, the function of this module that computes it.
    """

    where: str
    what: str
    choice: str
    effect: str

    def effect_text(self) -> str:
        """Return the effect, computing it if need be."""
        if not self.effect.startswith("{"):
            return self.effect
        computed: str = globals()[self.effect.strip("{}")]()
        return computed


# --------------------------------------------------------------------------- gas generator


@once
def _apu() -> Apu:
    return Apu()


def _percent(new: float, old: float) -> str:
    return f"{100 * (new / old - 1):+.2g} %"


def corrected_flow() -> str:
    """Table 3 prints the corrected flow 2.383 kg/s."""
    y = design_point()
    table_4 = y["W2"] * math.sqrt(y["T2"] / 288.15) / (y["P2"] / 101325.0)
    W2 = y["W2"] * 2.383 / table_4
    small = design_point(_apu().change({"gas_generator.W2": W2}).gas_generator)
    power = {"small": small["PW"] / 1e3, "full": y["PW"] / 1e3}
    return TEXT.text("corrected_flow", table_4=table_4, W2=W2, **power)


def gas_data() -> str:
    """Compare Table 4 with either generation of gas data."""
    text = []
    for data in ("nasa7", "nasa9"):
        y = design_point(_apu().change({"gas_generator.gas_data": data}).gas_generator)
        errors = []
        for r in table4():
            if r.kind != "predicted" or r.quantity not in ("T3", "SNOx", "T41", "T5", "PWSD"):
                continue
            name, factor = ("PW", 1e-3) if r.quantity == "PWSD" else (r.quantity, 1.0)
            errors.append(f"{r.quantity} {y[name] * factor / r.reference - 1:+.1e}")
        text.append(f"{data}: {', '.join(errors)}")
    return BREAK.join(["error against Table 4:", *text])


def table_5_P1() -> str:
    """Table 5's P1."""
    y = high_altitude_point()
    P1 = _printed("table5", "P1", "GasTurb")
    return TEXT.text("table_5_P1", P1=P1, static=y["P0"] / 1e3, total=y["P1"] / 1e3)


def altitude_of_table_5() -> str:
    """Tell how well 8000 m fits."""
    error = max(abs(r.error) for r in table5() if r.quantity in ("T1", "P1", "P2"))
    return TEXT.text("altitude_of_table_5", error=error)


def _printed(table: str, name: str, column: str) -> float:
    """Return a number of a published table."""
    return float(next(r[column] for r in reference(table) if r["parameter"] == name))


@once
def _fault_point(sign: str | None) -> OperatingPoint:
    """Steady point of the joint run before (None) or after the gas-path fault, at 100 kW each."""
    gg = _apu().gas_generator
    health = None if sign is None else HEALTH[sign]
    return trim_gas_generator(gg, {"N": gg.parameters.N, "PW": _PW_100()}, theta=health)


def turbine_flow_sign() -> str:
    """Compare the two signs with what section 6.3 says: P3, T3 and margin rise."""
    healthy = _fault_point(None)
    text = []
    for sign in HEALTH:
        y = _fault_point(sign)
        change = {n: y[n] - healthy[n] for n in ("T3", "T4")} | {
            "SM": 100 * (y["SM"] - healthy["SM"])
        }
        ratio = {"P3": _percent(y["P3"], healthy["P3"]), "fuel": _percent(y["Wf"], healthy["Wf"])}
        f_W_t = HEALTH[sign]["f_W_t"]
        text.append(TEXT.text("turbine_flow_sign", f_W_t=f_W_t, **change, **ratio))
    return BREAK.join(["at 2 x 100 kW and constant speed:", *text])


def efficiency_form() -> str:
    """Replace the compressor's Reynolds term by a droop with speed, fitted to the same Table 5."""
    import scipy.optimize

    apu = _apu()
    target = high_altitude_point()["eta_c"]

    def engine(c_N: float) -> GasGenerator:
        return apu.change({"compressor_map.n_Re": 0.0, "compressor_map.c_N": c_N}).gas_generator

    def excess(c_N: float) -> float:
        return high_altitude_point(engine(c_N))["eta_c"] - target

    c_N = float(scipy.optimize.brentq(excess, 0.0, 60.0, xtol=1e-4))
    other = engine(c_N)
    at = {"N": other.parameters.N, "PW": 222e3}
    points: dict[str, tuple[dict[str, float], dict[str, Any]]] = {
        "6000 m, Mach 0.5, 222 kW": (at, {"altitude": 6000.0, "Mach": 0.5, "dT_isa": 5.0}),
        "ground, ISA - 30 K, 222 kW": (at, {"dT_isa": -30.0}),
    }
    text = []
    for label, (fixed, ambient) in points.items():
        a = trim_gas_generator(apu.gas_generator, fixed, **ambient)
        b = trim_gas_generator(other, fixed, **ambient)
        values = {"reynolds": a["eta_c"], "droop": b["eta_c"], "T3": b["T3"] - a["T3"]}
        fuel = _percent(b["Wf"], a["Wf"])
        text.append(TEXT.text("efficiency_form point", label=label, fuel=fuel, **values))
    said = TEXT.text("efficiency_form", c_N=c_N, target=target)
    return f"{said} " + BREAK.join(["", *text])


# --------------------------------------------------------------------------- generator


def line_voltage() -> str:
    """230 V as a line or a phase voltage."""
    I_phase, I_line = 225e3 / (3 * 230.0), 225e3 / (math.sqrt(3) * 230.0)
    printed = _printed("table7", "Phase A Current", "SM_MATLAB")
    return TEXT.text("line_voltage", phase=I_phase, line=I_line, printed=printed)


def damper_inductance() -> str:
    """L(6,6) as printed is the correct matrix of a machine with another q damper leakage."""
    good = Generator()
    m = good.machine
    L = m.L_lkq + m.L_md - m.L_mq  # L_mq + this = L_md + L_lkq
    printed = Generator(machine=m.change(L_lkq=L), exciter=good.exciter)
    runs = [g.simulate(KW225, 0.06, switches=[(0.01, KW100)]) for g in (good, printed)]
    t = runs[0].time.to_numpy()
    keep = t > 0.0105
    V = [r.V_t.to_numpy()[keep] for r in runs]
    apart = float(np.abs(V[1] / V[0] - 1).max())
    late = float(abs(V[1][-1] / V[0][-1] - 1))
    return TEXT.text("damper_inductance", apart=100 * apart, late=100 * late)


def field_loss() -> str:
    """Field loss if the printed field resistance is referred to the stator."""
    g = Generator()
    y = g.steady_state(KW225).y
    P = 1.5 * y["V_fd"] * y["i_fd"]
    P_em = y["T_e"] * g.machine.w_rated / g.machine.n_pp
    own = y["P_total"] / 2
    shaft = 2 * P / g.machine.eta_sg / 1e3
    kW = {"field": P / 1e3, "shaft": shaft, "own": own / 1e3, "torque": P_em / 1e3}
    return TEXT.text("field_loss", **kW)


@once
def _settled(load: SeriesLoad, fault: Ttsc | None, kind: str = "grounded") -> dict[str, float]:
    """Means over 8 periods, and the rms fault current, at rated speed and V_ref of Table 7."""
    g = Generator(neutral=kind)
    point = g.steady_state(load, V_ref=g.V_ref_default)
    if fault is None:
        return {**point.y, "I_fault": 0.0, "I": point.y["V_t"] / load.R[0]}
    ss, u, theta = g.variant(load, fault), g.inputs(load), g.fault_vector(load, fault)
    x = g.transfer(point.x, point.ss, ss, u=point.u, theta=[], u_target=u)
    x = simulation.stepper(ss, 1, rtol=1e-7)(x, u, theta, SETTLE).x_end
    quad = ("P_total", "P_loss_fault", "i_fault^2", "v_a^2", "v_b^2", "v_c^2")
    r = simulation.stepper(ss, 1, quad=quad)(x, u, theta, 0.02)
    return {**r.mean, "I_fault": math.sqrt(r.mean["i_fault^2"])}


@once
def _PW_100() -> float:
    return float(_apu().PW(Generator().steady_state(KW100).y["P_total"]))


def _reachable(PW: float) -> bool:
    """Whether the healthy gas generator can give a shaft power, W, with the governor's fuel."""
    apu = _apu()
    gg = apu.gas_generator
    try:
        point = trim_gas_generator(gg, {"N": gg.parameters.N, "PW": PW})
    except OperatingPointError:
        return False
    return point["Wf"] <= apu.governor.Wf_max


def neutral() -> str:
    """Compare the faulted machine with both neutrals."""
    text = []
    for kind in ("grounded", "isolated"):
        healthy, s = _settled(KW100, None), _settled(KW100, Ttsc(0.05, 20.0), kind)
        V = {p: math.sqrt(s[f"v_{p}^2"]) for p in "abc"}
        power = _apu().PW(s["P_total"] - healthy["P_total"]) / 1e3
        text.append(TEXT.text("neutral", kind=kind, power=power, **V))
    return BREAK.join(["with the short circuit of the joint run at 2 x 100 kW:", *text])


def severity() -> str:
    """Tell what k_rf and kappa do to the 5 % short circuit at 100 kW."""
    healthy = _settled(KW100, None)
    rated = 225e3 / (3 * 230.0)
    faults = [Ttsc(0.05, k) for k in (1.0, 20.0, 50.0, 100.0)] + [Ttsc(0.05, 1.0, 1.0)]
    text = []
    for f in faults:
        s = _settled(KW100, f)
        more = _apu().PW(s["P_total"] - healthy["P_total"])
        kappa = "kappa = mu" if f.kappa == f.mu else f"kappa = {f.kappa:g}"
        beyond = "" if _reachable(more + _PW_100()) else TEXT.text("beyond")
        kW = {"power": more / 1e3, "loss": s["P_loss_fault"] / 1e3}
        about = {"k_rf": f.k_rf, "kappa": kappa, "beyond": beyond}
        text.append(TEXT.text("severity", current=s["I_fault"] / rated, **about, **kW))
    return BREAK.join(["at 2 x 100 kW, rated speed:", *text])


def one_machine() -> str:
    """Compare the joint run with the fault in both machines and in one."""
    text = []
    for name, where in (("joint", "both machines"), ("joint_one_machine", "generator 2 only")):
        ds = registry.run(name, waveform_dt=None)
        before, then = phase_summary(ds)[-2:]
        moved = {k: then[k] - before[k] for k in ("PW_kW", "T4", "SM_percent")}
        I = [(row["generators"][0] if "generators" in row else row) for row in (before, then)]
        steps = (I[1][f"I_{p}_rms"] - I[0][f"I_{p}_rms"] for p in "abc")
        currents = ", ".join(f"{round(step, 2) + 0.0:+.2f}" for step in steps)
        text.append(
            TEXT.text(
                "one_machine fault",
                where=where,
                power=moved["PW_kW"],
                speed=then["N_rpm_min"] - before["N_rpm"],
                T4=moved["T4"],
                SM=moved["SM_percent"],
                currents=f"{currents} A",
            )
        )
    return BREAK.join([TEXT.text("one_machine"), *text])


def efficiency_split() -> str:
    """Split 0.90 between machine and gearbox in another way."""
    other = _apu().change({"machine.eta_sg": 0.95, "coupling.eta_gtSg": 0.90 / 0.95})
    PW = [a.PW(a.generator.steady_state(KW225).y["P_total"]) for a in (_apu(), other)]
    return TEXT.text("efficiency_split", ours=PW[0] / 1e3, other=PW[1] / 1e3)


# --------------------------------------------------------------------------- joint


def _load_step(**change: float) -> xr.Dataset:
    apu = _apu().change({k.replace("__", "."): v for k, v in change.items()})
    step = [LoadChange(0.1, KW100)]
    return simulate_joint(
        apu, duration=1.5, load=KW225, events=step, waveform_dt=None, solver="cvodes"
    )


def _peak(**change: float) -> str:
    N = _load_step(**change).N.to_numpy() * RPM
    return f"{N.max() - N[0]:.0f} r/min"


def inertia() -> str:
    """Overspeed of the load step with other inertias."""
    J = _apu().gas_generator.parameters.J
    peaks = [f"{f:g} J: {_peak(gas_generator__J=f * J)}" for f in (0.5, 1.0, 2.0)]
    return TEXT.text("inertia", peaks=", ".join(peaks))


def gains() -> str:
    """Overspeed of the load step with other gains of the governor."""
    g = GovernorParameters()
    peaks = [
        f"{f:g} times: {_peak(governor__Kp=f * g.Kp, governor__Ki=f * g.Ki)}"
        for f in (0.5, 1.0, 2.0)
    ]
    return TEXT.text("gains", peaks=", ".join(peaks))


def droop() -> str:
    """Terminal voltage at 100 kW with other regulator gains."""
    text = []
    for K_A in (215.0, 250.0, 264.0):
        g = Generator(exciter=Generator().exciter.change(K_A=K_A))
        V = g.steady_state(KW100, V_ref=g.V_ref_default).V_t
        text.append(f"K_A = {K_A:g}: {V:.4f} V")
    printed = _printed("table8", "Phase A Voltage", "SM_MATLAB")
    return TEXT.text("droop", V=printed, voltages=", ".join(text))


def sampling() -> str:
    """Point to the study of the exchange."""
    return TEXT.text("sampling")


def _items(group: str) -> tuple[Item, ...]:
    """Return the rows of a group of the template; an effect in braces is the function's."""
    rows = (re.split(r"\s\|\s", row) for row in TEXT.raw(group).split("\n\n"))
    joined = ([" ".join(cell.split()) for cell in cells] for cells in rows)
    return tuple(Item(*cells) for cells in joined)


ITEMS: dict[str, tuple[Item, ...]] = {g: _items(g) for g in ("Contradictions", "Left open")}


def page() -> str:
    """Return the page as Markdown."""
    text = [TEXT.text("top")]
    for title, items in ITEMS.items():
        rows = [vars(i) | {"effect": i.effect_text()} for i in items]
        text += [f"## {title}", TEXT.table("table", rows, right=())]
    text.append(TEXT.text("shaft_power", fixed=shaftpower.fixed_loss()))
    text.append(TEXT.table("shaft_power table", shaftpower.rows(), right=()))
    text.append(TEXT.text("shaft_power end"))
    return "\n\n".join(text) + "\n"


def report() -> list[dict[str, Any]]:
    """Return the items with their effects, ready for JSON."""
    return [
        {"group": g, **vars(i), "effect": i.effect_text()}
        for g, items in ITEMS.items()
        for i in items
    ]
