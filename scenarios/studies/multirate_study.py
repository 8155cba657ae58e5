"""What the multi-rate exchange costs in accuracy and saves in time.

The paper's section 3 argues that its exchange of speed and power every 20 ms loses nothing.  Here
it is measured: the unit as one model with one solver (:mod:`apu_casadi.unit.monolithic`) is the
truth for a load step and for both faults, and the multi-rate scheme runs with several exchange
steps.

Each case is 1.76 s long with its event at 0.16 s: the speed has then passed its extreme and comes
back.  All exchange steps share the instants k x 80 ms, and there they are compared:

* speed: largest error over the largest excursion of the true speed;
* power, voltage: largest relative error of the mean P_total, and of the rms voltage of the three
  phases, over 80 ms.  The latter is the root of the mean output into the load, which is resistive
  in every case: stored rms values are weighted within their steps, and those of steps of other
  lengths are other averages of a transient;
* energy: largest error of the energy taken since the event, over that energy.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import ScenarioError
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import Event, FaultChange, HealthChange, LoadChange
from apu_casadi.unit.exchange import OFFERED
from apu_casadi.unit.monolithic import simulate_monolithic
from apu_casadi.unit.multirate import simulate_joint
from scenarios.shell.markdown import fill
from scenarios.shell.template import Template

if TYPE_CHECKING:
    import xarray as xr

TEXT = Template.of("multirate.md")
STEPS = (0.002, 0.005, 0.010, 0.020, 0.040, 0.080)
"""Exchange steps, s; the paper's is 20 ms."""
PAPER_STEP = 0.020  # s
COMMON = 0.080  # s, where all of them meet
T_EVENT, DURATION = 2 * COMMON, 22 * COMMON
COMPARED = OFFERED
"""Exchanges of ``simulate_joint`` that are measured with every step."""
QUANTITIES = {"N": "speed, of its excursion", "P": "power", "V": "voltage", "E": "energy"}
"""Short names and titles of the four errors."""
_RTOL = 1e-8
_HEALTH = {"f_eta_c": 0.99, "f_eta_t": 0.98, "f_W_c": 0.97, "f_W_t": 1.04}


@dataclass(frozen=True)
class Case:
    """One event: load and health before it, and the event."""

    load: SeriesLoad | Sequence[SeriesLoad]
    event: Event
    health: dict[str, float] = dataclasses.field(default_factory=dict)

    def run(
        self, simulate: Callable[..., xr.Dataset], apu: Apu, *, duration: float, **options: Any
    ) -> xr.Dataset:
        """Simulate with either model."""
        start: dict[str, Any] = {"load": self.load, "health": self.health, "events": [self.event]}
        return simulate(apu, duration=duration, **start, **options)


KW225, KW100 = SeriesLoad.from_power(225e3), SeriesLoad.from_power(100e3)
CASES = {
    "load step": Case(KW225, LoadChange(T_EVENT, KW100)),
    "gas-path fault": Case(KW100, HealthChange(T_EVENT, _HEALTH)),
    "TTSC fault": Case(KW100, FaultChange(T_EVENT, Ttsc(0.05, 20.0)), _HEALTH),
}
"""The three events of the paper's joint run (section 6.3), each from the steady state before it."""
OF_ONE = {
    "load step of one": Case((KW225, KW100), LoadChange(T_EVENT, KW100, generator=1)),
    "TTSC fault of one": Case(KW100, FaultChange(T_EVENT, Ttsc(0.05, 20.0), generator=2), _HEALTH),
}
"""Events of one generator alone, which are measured where they are asked for."""
CHOSEN = {"both": (*CASES,), "one": (*OF_ONE,), "all": (*CASES, *OF_ONE)}
"""Names of cases by what the command calls them."""


@dataclass(frozen=True)
class Measured:
    """One run against the truth.

    Args:
        case: name in :data:`CASES` or :data:`OF_ONE`.
        exchange: of ``simulate_joint``; ``"one model"`` is the truth's model at the tolerance of
            the multi-rate runs, so that its errors are what the tolerance alone makes.
        dt: exchange step, s; NaN for the one model.
        N, P, V, E: errors, see the module's text.
        cpu: processor time of the run, s.
        estimate: the run's own estimate of N (:func:`apu_casadi.unit.validity.exchange_error`); NaN
            for the one model.
    """

    case: str
    exchange: str
    dt: float
    N: float
    P: float
    V: float
    E: float
    cpu: float
    estimate: float = math.nan


def _blocks(ds: xr.Dataset, name: str) -> np.ndarray:
    """Means over each 80 ms of what is stored as means over the exchange steps."""
    t = ds["time"].to_numpy()
    at = np.arange(round(DURATION / COMMON) + 1) * COMMON
    made = []
    for row in np.atleast_2d(ds[name].to_numpy()):  # of each generator, where they differ
        total = np.concatenate([[0.0], np.cumsum(row[1:] * np.diff(t))])
        made.append(np.diff(np.interp(at, t, total)) / COMMON)
    return np.squeeze(np.array(made))


def errors(ds: xr.Dataset, truth: xr.Dataset) -> dict[str, float]:
    """Return the errors N, P, V and E of a run; see the module's text."""
    at = np.arange(round(DURATION / COMMON) + 1) * COMMON
    # every instant of ``at`` is on both grids: this picks, it does not interpolate
    N, N_true = (np.interp(at, d["time"].to_numpy(), d["N"].to_numpy()) for d in (ds, truth))
    excursion = float(np.abs(truth["N"] - truth["N"][0]).max())
    P, P_true = _blocks(ds, "P_total"), _blocks(truth, "P_total")
    V = float(np.abs(np.sqrt(_blocks(ds, "P_e") / _blocks(truth, "P_e")) - 1).max())
    first = round(T_EVENT / COMMON)
    E, E_true = np.cumsum(P[first:]), np.cumsum(P_true[first:])
    return {
        "N": float(np.abs(N - N_true).max()) / excursion,
        "P": float(np.abs(P / P_true - 1).max()),
        "V": V,
        "E": float(np.abs(E / E_true - 1).max()),
    }


SPLIT = ("predicted speed", "predicted fuel")


def simulated(steps: Sequence[float] = STEPS, *, cases: int = len(CASES)) -> float:
    """Return the simulated time, s, of all runs of :func:`measure`."""
    runs = len(COMPARED) * len(steps) + len(SPLIT) + 2  # two: the truth, and the one model
    return cases * runs * DURATION


def measure(
    *,
    steps: Sequence[float] = STEPS,
    cases: Sequence[str] = tuple(CASES),
    progress: Callable[[float, float], None] | None = None,
) -> list[Measured]:
    """Run the study: exchanges at all steps, speed and fuel predicted one without the other.

    The latter at the paper's step, so that the two parts of its error stand apart.

    Args:
        steps: exchange steps, s; divisors of 80 ms.
        cases: names in :data:`CASES` or :data:`OF_ONE`.
        progress: called with (done, total), both in simulated seconds over all runs.

    Returns:
        Every run, case by case; the first of each case is the one model at the same tolerance.
    """
    apu = Apu()
    plan = [(ex, dt) for ex in COMPARED for dt in steps] + [(ex, PAPER_STEP) for ex in SPLIT]
    total, done = len(cases) * (len(plan) + 2) * DURATION, 0.0  # two: truth and one model

    def tick(t: float, _: float) -> None:
        if progress is not None:
            progress(done + t, total)

    result = []
    for name in cases:
        case = {**CASES, **OF_ONE}[name]
        truth = case.run(
            simulate_monolithic, apu, duration=DURATION, rtol=_RTOL / 10, progress=tick
        )
        done += DURATION
        for ex, dt in [("one model", math.nan), *plan]:
            simulate: Callable[..., xr.Dataset] = simulate_monolithic
            options: dict[str, Any] = {"rtol": _RTOL, "progress": tick}
            if ex != "one model":
                simulate = simulate_joint
                options |= {"dt": dt, "exchange": ex, "waveform_dt": None, "solver": "cvodes"}
                options["warn_exchange"] = False
            # build the integrators first: that is paid once, and is no part of the comparison
            case.run(simulate, apu, duration=T_EVENT + COMMON, **{**options, "progress": None})
            start = time.process_time()
            ds = case.run(simulate, apu, duration=DURATION, **options)
            cpu = time.process_time() - start
            own = float(ds.attrs.get("exchange_error", math.nan))
            result.append(Measured(name, ex, dt, **errors(ds, truth), cpu=cpu, estimate=own))
            done += DURATION
    return result


def order(rows: Sequence[Measured], quantity: str) -> float:
    """Order of convergence: least-squares slope of log error over log step, over all steps."""
    points = [(r.dt, getattr(r, quantity)) for r in rows if not math.isnan(r.dt)]
    if len(points) < 2:
        return math.nan
    x, y = np.log(np.array(points)).T
    return float(np.polyfit(x, y, 1)[0])


def select(rows: Sequence[Measured], case: str, exchange: str) -> list[Measured]:
    """Return the runs of one case and exchange, by step."""
    return sorted((r for r in rows if (r.case, r.exchange) == (case, exchange)), key=lambda r: r.dt)


def report(rows: Sequence[Measured]) -> dict[str, Any]:
    """Return runs, orders and time saved, ready for JSON."""
    groups = list(dict.fromkeys((r.case, r.exchange) for r in rows))
    orders = []
    for case, ex in groups:
        of = {q: order(select(rows, case, ex), q) for q in QUANTITIES}
        if not math.isnan(of["N"]):
            orders.append({"case": case, "exchange": ex, **of})
    runs = [{**dataclasses.asdict(r), "times_faster": _faster(rows, r)} for r in rows]
    for r in runs:
        r |= {k: None if math.isnan(r[k]) else r[k] for k in ("dt", "estimate")}
    return {"runs": runs, "orders": orders}


def _faster(rows: Sequence[Measured], r: Measured) -> float:
    one = select(rows, r.case, "one model")[0]
    return one.cpu / r.cpu


def _cells(rows: Sequence[Measured], case: str) -> list[dict[str, str]]:
    """Return rows of the table of one case, its orders included."""
    cells: list[dict[str, str]] = []
    for ex in dict.fromkeys(r.exchange for r in rows if r.case == case):
        group = select(rows, case, ex)
        for r in group:
            step = "-" if math.isnan(r.dt) else f"{1e3 * r.dt:g}"
            own = "-" if math.isnan(r.estimate) else f"{r.estimate:.1e}"
            about = {"exchange": ex, "step": step, "estimate": own, "cpu": f"{r.cpu:.1f}"}
            numbers = {q: f"{getattr(r, q):.1e}" for q in QUANTITIES}
            cells.append({**about, **numbers, "faster": f"{_faster(rows, r):.1f}"})
        if not math.isnan(order(group, "N")):
            numbers = {q: f"{order(group, q):.2f}" for q in QUANTITIES}
            nothing = dict.fromkeys(("step", "estimate", "cpu", "faster"), "")
            cells.append({"exchange": f"{ex}: order", **nothing, **numbers})
    return cells


def table(rows: Sequence[Measured]) -> str:
    """Return the study as text."""
    lines = []
    for case in dict.fromkeys(r.case for r in rows):
        body = TEXT.rows("case", _cells(rows, case))
        widths = [max(len(c[k]) for c in body) for k in range(len(body[0]))]
        lines.append(f"\n{case}")
        for first, *others in body:
            padded = (c.rjust(w) for c, w in zip(others, widths[1:], strict=True))
            lines.append("  " + "  ".join([first.ljust(widths[0]), *padded]).rstrip())
    return "\n".join(lines)


def figure(rows: Sequence[Measured]) -> Any:
    """Draw errors over exchange step, a panel for each quantity; return a matplotlib Figure."""
    from scenarios.figures.exchangeplot import figure_exchange_error

    curves = {
        (case, ex): (
            np.array([r.dt for r in group]),
            {q: np.array([getattr(r, q) for r in group]) for q in QUANTITIES},
        )
        for case in dict.fromkeys(r.case for r in rows)
        for ex in COMPARED
        if len(group := select(rows, case, ex)) > 1
    }
    if not curves:
        raise ScenarioError("nothing to draw: at least two exchange steps are needed")
    return figure_exchange_error(curves, QUANTITIES, marked=PAPER_STEP)


def write_figure(rows: Sequence[Measured], path: Path, dpi: float | None = None) -> Path:
    """Save :func:`figure` as PNG, 10 in wide (1600 px with its own dpi), and return the path.

    Raises:
        DataError: the file cannot be written there.
    """
    fig = figure(rows)
    options = {"dpi": dpi or fig.get_dpi(), "pil_kwargs": {"optimize": True}}
    return files.save_figure(fig, path, **options)


class Mode(NamedTuple):
    """Frequency, Hz, and damping ratio of an oscillation."""

    frequency: float
    damping: float


def regulator_mode(generator: Generator | None = None) -> Mode:
    """Return the least damped oscillation of the generator with its exciter at 100 kW."""
    point = (generator or Generator()).steady_state(KW100)
    ss = point.ss
    x = ca.SX.sym("x", len(ss.x))
    A = ca.Function("A", [x], [ca.jacobian(ss.f(x, point.u, []), x)])(point.x).full()
    # under a balanced load nothing depends on the rotor angle
    keep = [k for k, name in enumerate(ss.x.names) if name != "theta_e"]
    s = np.linalg.eigvals(A[np.ix_(keep, keep)])
    s = s[s.imag > 0]
    s = s[np.argmin(-s.real / np.abs(s))]
    return Mode(float(abs(s.imag)) / (2 * math.pi), float(-s.real / abs(s)))


def fault_words() -> str:
    """Tell the severity of the study's stator fault in words."""
    event = CASES["TTSC fault"].event
    assert isinstance(event, FaultChange) and isinstance(event.fault, Ttsc)
    f = event.fault
    return TEXT.text("fault", percent=100 * f.mu, k_rf=f.k_rf, kappa=f.kappa)


def _span(values: Sequence[float], form: str = ".1e") -> str:
    lo, hi = format(min(values), form), format(max(values), form)
    return lo if lo == hi else f"{lo} to {hi}"


def page(rows: Sequence[Measured]) -> str:
    """Return docs/MULTIRATE.md: one paragraph with the measured numbers, the figure, the tables."""
    cases = list(dict.fromkeys(r.case for r in rows))
    values: dict[str, Any] = {"faster": {}}
    told = [r for r in rows if r.case in CASES]  # in the text
    for ex in (*COMPARED, *SPLIT):
        of = [r for r in told if r.exchange == ex and abs(r.dt - PAPER_STEP) < 1e-9]
        percent = {q: _span([100 * getattr(r, q) for r in of], ".2g") + " %" for q in QUANTITIES}
        values[ex.replace(" ", "_")] = percent
        values["faster"][ex] = _span([_faster(rows, r) for r in of], ".0f")
    for ex in ("paper", "predicted"):
        slopes = [order(select(rows, c, ex), "N") for c in CASES if c != "TTSC fault"]
        values[f"order_{ex}"] = _span(slopes, ".1f")
    mode = regulator_mode()
    values |= {**mode._asdict(), "period": 1e3 / mode.frequency, "rtol": _RTOL}
    values |= {"event": T_EVENT, "duration": DURATION, "common": 1e3 * COMMON}
    values["one"] = max(max(r.N, r.P, r.V, r.E) for r in told if r.exchange == "one model")
    values["events"] = " --events all" if set(cases) & set(OF_ONE) else ""
    text = fill(TEXT.filled("page", fault=fault_words(), **values))
    for case in cases:
        text += f"\n## {case[0].upper()}{case[1:]}\n\n{TEXT.table('case', _cells(rows, case))}\n"
    return text
