"""The page ``docs/ERRATA.md``: what the paper leaves open or contradicts, and what the choice does.

``apu errata --write docs/ERRATA.md`` makes it; every number of the column "effect" is computed
here from the model, so that none is typed by hand and none grows stale unseen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core import simulation
from apu_casadi.core.errors import OperatingPointError
from apu_casadi.core.results import RPM
from apu_casadi.core.sharing import once
from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.control import GovernorParameters
from apu_casadi.unit.events import LoadChange
from apu_casadi.unit.multirate import simulate_joint
from scenarios.shell.markdown import markdown_table
from scenarios.validation.comparison import Row, reference
from scenarios.validation.paper_figures import HEALTH
from scenarios.validation.paper_tables import design_point, high_altitude_point, table4, table5

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.gaspath.gasgenerator import GasGenerator

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
        effect: what the choice changes, computed; a text, or a function that returns one.
    """

    where: str
    what: str
    choice: str
    effect: str | Callable[[], str]

    def effect_text(self) -> str:
        """Return the effect, computing it if need be."""
        return self.effect if isinstance(self.effect, str) else self.effect()


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
    return (
        f"W2 of Table 4 corrected to the standard day is {table_4:.4f} kg/s; 2.383 kg/s would give "
        f"W2 = {W2:.4f} kg/s and {small['PW'] / 1e3:.1f} kW instead of {y['PW'] / 1e3:.1f} kW"
    )


def _mean(rows: list[Row], kinds: tuple[str, ...] = ("predicted",)) -> float:
    errors = [abs(r.error) for r in rows if r.kind in kinds]
    return sum(errors) / len(errors)


def _row(rows: list[Row], name: str) -> Row:
    return next(r for r in rows if r.quantity == name)


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
    P1 = float(next(r["GasTurb"] for r in reference("table5") if r["parameter"] == "P1"))
    return (
        f"printed {P1:g} kPa; ambient static pressure {y['P0'] / 1e3:.4f} kPa, total pressure "
        f"{y['P1'] / 1e3:.4f} kPa, of which the printed P2 is 99 %"
    )


def altitude_of_table_5() -> str:
    """Tell how well 8000 m fits."""
    return f"with 8000 m the printed T1, P1 and P2 follow within {_ambient_error():.0e}"


def _ambient_error() -> float:
    return max(abs(r.error) for r in table5() if r.quantity in ("T1", "P1", "P2"))


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
        text.append(
            f"f_W_t = {HEALTH[sign]['f_W_t']:g}: P3 {_percent(y['P3'], healthy['P3'])}, "
            f"T3 {y['T3'] - healthy['T3']:+.1f} K, surge margin "
            f"{100 * (y['SM'] - healthy['SM']):+.1f} points, T4 {y['T4'] - healthy['T4']:+.1f} K, "
            f"fuel {_percent(y['Wf'], healthy['Wf'])}"
        )
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
        text.append(
            f"{label}: compressor efficiency {a['eta_c']:.4f} and {b['eta_c']:.4f}, T3 "
            f"{b['T3'] - a['T3']:+.1f} K, fuel {_percent(b['Wf'], a['Wf'])}"
        )
    return (
        f"a droop exp(-c_N (n - 1)^2) with c_N = {c_N:.2f} puts the compressor's efficiency in "
        f"Table 5 on the same {target:.4f}; away from it, Reynolds term against droop: "
        + BREAK.join(["", *text])
    )


# --------------------------------------------------------------------------- generator


def line_voltage() -> str:
    """230 V as a line or a phase voltage."""
    I_phase, I_line = 225e3 / (3 * 230.0), 225e3 / (math.sqrt(3) * 230.0)
    I = float(
        next(r["SM_MATLAB"] for r in reference("table7") if r["parameter"] == "Phase A Current")
    )
    return (
        f"225 kW is {I_phase:.1f} A at 230 V per phase and {I_line:.1f} A at 230 V between lines; "
        f"Table 7 prints {I:.1f} A"
    )


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
    return (
        f"after a step from 225 to 100 kW the voltage differs by up to {100 * apart:.2g} % (from "
        f"0.5 ms on), by {100 * late:.1g} % 50 ms later, by nothing at rest"
    )


def field_loss() -> str:
    """Field loss if the printed field resistance is referred to the stator."""
    g = Generator()
    y = g.steady_state(KW225).y
    P = 1.5 * y["V_fd"] * y["i_fd"]
    P_em = y["T_e"] * g.machine.w_rated / g.machine.n_pp
    own = y["P_total"] / 2
    return (
        f"{P / 1e3:.1f} kW at 225 kW, {2 * P / g.machine.eta_sg / 1e3:.0f} kW of shaft power if it "
        f"counted in (8); (8) gives {own / 1e3:.1f} kW for each machine, the electromagnetic "
        f"torque {P_em / 1e3:.1f} kW"
    )


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
        V = [math.sqrt(s[f"v_{p}^2"]) for p in "abc"]
        text.append(
            f"{kind}: shaft power {_apu().PW(s['P_total'] - healthy['P_total']) / 1e3:+.1f} kW, "
            f"phase voltages {V[0]:.1f}, {V[1]:.1f}, {V[2]:.1f} V"
        )
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
        beyond = "" if _reachable(more + _PW_100()) else ", more than the gas generator can give"
        text.append(
            f"k_rf = {f.k_rf:g}, {kappa}: shaft power {more / 1e3:+.1f} kW{beyond}, loss "
            f"{s['P_loss_fault'] / 1e3:.2f} kW in each machine, fault branch "
            f"{s['I_fault'] / rated:.1f} times the rated current"
        )
    return BREAK.join(["at 2 x 100 kW, rated speed:", *text])


def efficiency_split() -> str:
    """Split 0.90 between machine and gearbox in another way."""
    other = _apu().change({"machine.eta_sg": 0.95, "coupling.eta_gtSg": 0.90 / 0.95})
    PW = [a.PW(a.generator.steady_state(KW225).y["P_total"]) for a in (_apu(), other)]
    return (
        f"0.95 and 0.947 instead of 0.90 and 1: shaft power {PW[0] / 1e3:.3f} and "
        f"{PW[1] / 1e3:.3f} kW; only the intermediate P_total moves, and with it nothing else"
    )


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
    return "overspeed after the step from 225 to 100 kW: " + ", ".join(peaks)


def gains() -> str:
    """Overspeed of the load step with other gains of the governor."""
    g = GovernorParameters()
    peaks = [
        f"{f:g} times: {_peak(governor__Kp=f * g.Kp, governor__Ki=f * g.Ki)}"
        for f in (0.5, 1.0, 2.0)
    ]
    return "overspeed of the same step with both gains " + ", ".join(peaks)


def droop() -> str:
    """Terminal voltage at 100 kW with other regulator gains."""
    text = []
    for K_A in (215.0, 250.0, 264.0):
        g = Generator(exciter=Generator().exciter.change(K_A=K_A))
        V = g.steady_state(KW100, V_ref=g.V_ref_default).V_t
        text.append(f"K_A = {K_A:g}: {V:.4f} V")
    V = float(
        next(r["SM_MATLAB"] for r in reference("table8") if r["parameter"] == "Phase A Voltage")
    )
    return f"Table 8 has {V:.4f} V at 100 kW with the voltage set in Table 7; " + ", ".join(text)


def sampling() -> str:
    """Point to the study of the exchange."""
    return "measured in [MULTIRATE.md](MULTIRATE.md)"


NONE = "none: naming"
REPORT = "none: a number about the paper's own comparison"

ITEMS: dict[str, tuple[Item, ...]] = {
    "Contradictions": (
        Item(
            "Table 3",
            "corrected flow 2.383 kg/s contradicts W2 of Table 4",
            "Table 4",
            corrected_flow,
        ),
        Item("Table 5, title", 'altitude "8000km"', "8000 m", altitude_of_table_5),
        Item(
            "Table 5",
            "row P1 is called inlet total pressure",
            "ambient static pressure",
            table_5_P1,
        ),
        Item("Table 1", '"line voltage 230 V"', "rms voltage of a phase", line_voltage),
        Item("Table 1", '"R_lkq, mH" is printed among the inductances', "L_lkq", NONE),
        Item(
            "(7)",
            "last entry of L printed L_md + L_lkq",
            "L_mq + L_lkq: the damper lies on the q axis",
            damper_inductance,
        ),
        Item(
            "Table 1, (9)",
            "R_f is the field resistance in one and the fault branch in the other",
            "r_fd and r_fault",
            NONE,
        ),
        Item(
            "above (4)",
            "the symbols of the shorted and the healthy part of the winding are "
            "permuted in the sentence",
            "as in (4) and Figure 6",
            NONE,
        ),
        Item(
            "Table 1, (8)",
            "the field resistance, taken as referred to the stator, means a field "
            "loss that cannot be inside the efficiency 0.90",
            "the value is kept, field loss stays out of (8) as printed",
            field_loss,
        ),
        Item(
            "6.1.1, 6.3",
            '"4 % turbine flow degradation" is called an increase of the capacity, '
            "and the run is said to raise P3, T3 and the surge margin together",
            "f_W_t = 1.04 (scenario joint); 0.96 in joint_capacity_loss; neither gives all three",
            turbine_flow_sign,
        ),
        Item(
            "6.1.1, Table 6",
            "average off-design error 1.3461e-5 in the text, 2.3461e-5 in the "
            "table; one of ten points is printed",
            "the printed point is compared",
            REPORT,
        ),
        Item(
            "Table 7",
            "average 6.2123e-5 and extremes in the text, 5.5705e-5 in the table",
            "the reference column is used",
            REPORT,
        ),
        Item(
            "6.2.2, Table 9",
            "healthy transients 8.4317e-5 in the text (the number of the gas "
            "generator), 5.2122e-4 in the table",
            "two solvers are compared instead",
            REPORT,
        ),
        Item(
            "3.3",
            'the error of the held speed "can be ignored"',
            'as printed by default; exchange="predicted" and "corrected" err less',
            sampling,
        ),
    ),
    "Left open": (
        Item(
            "(9)",
            "lambda_sa-f is not given: any partition kappa in [mu, 1] of the leakage fits",
            "kappa = mu: the model of the same authors' sibling paper",
            "with k_rf, next row",
        ),
        Item("6.2.2, 6.3", 'k_rf of the "5 %" fault', "20, assumed", severity),
        Item(
            "4", "whether the neutral is grounded", "grounded: four wires, as in aircraft", neutral
        ),
        Item(
            "Table 4",
            "the gas data",
            "NASA 7-coefficient data, which fit the tables; nasa9 is a parameter",
            gas_data,
        ),
        Item(
            "Table 5",
            "the component maps; what lowers the efficiencies at altitude",
            "published "
            "maps scaled to the design point, compressor loss with the Reynolds number; six "
            "calibrated numbers",
            efficiency_form,
        ),
        Item("5", "rotor inertia", "0.05 kg m2 with both generators, assumed", inertia),
        Item("3.2", "gains and limits of the governor", "crossover at 8 rad/s, assumed", gains),
        Item("4.2", "constants of the AC5A exciter", "a set that is stable at 400 Hz", droop),
        Item(
            "(1), (8)",
            "only the product 0.90 of both efficiencies follows from the tables",
            "eta_sg = 0.90, eta_gtSg = 1",
            efficiency_split,
        ),
    ),
}


def page() -> str:
    """Return the page as Markdown."""
    text = [
        "# What the paper leaves open or contradicts",
        "",
        "Made by `apu errata --write docs/ERRATA.md`; the effects are computed by the model as it "
        "is. The paper is Mao and Guo, on whose tables [VALIDATION.md](../VALIDATION.md) reports. "
        "Each row says what was chosen, and how much the choice changes.",
    ]
    for title, items in ITEMS.items():
        rows = [(i.where, i.what, i.choice, i.effect_text()) for i in items]
        table = markdown_table(("paper", "what", "chosen here", "effect"), rows)
        text += ["", f"## {title}", "", table]
    return "\n".join(text) + "\n"


def report() -> list[dict[str, Any]]:
    """Return the items with their effects, ready for JSON."""
    return [
        {
            "group": g,
            "where": i.where,
            "what": i.what,
            "choice": i.choice,
            "effect": i.effect_text(),
        }
        for g, items in ITEMS.items()
        for i in items
    ]
