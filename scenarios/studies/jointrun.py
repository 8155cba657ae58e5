"""A scenario estimated: its truth, measurements and estimates, and what they say, in words.

The truth is simulated by CVODES with exchange steps of 5 ms, corrected; the filters step with the
terminal model's own integrator at 10 kHz and the midpoint rule at 20 ms.  Gain errors of all
sensors and the error of the generators' efficiency are drawn for the seed, then noise is added.
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import EstimationError, ScenarioError
from apu_casadi.core.sharing import last
from apu_casadi.gaspath.health import HEALTH, HEALTH_FACTORS
from apu_casadi.machine.machinedata import require_linear
from apu_casadi.machine.park import PHASES
from estimators.apu.electrical.faults import ridge
from estimators.apu.gaspathmodel import DT
from estimators.apu.joint import beside_truth
from estimators.apu.measuring import drawn_gains, measure_run, write_recording
from estimators.apu.recorded_estimate import estimate as recorded_estimate
from estimators.apu.recorded_report import compared_words
from estimators.apu.recordings.measured import read_recording
from estimators.apu.sensorfile import SensorFile, read_sensors
from estimators.apu.trust import in_words, verdict
from scenarios import registry
from scenarios.schema import Scenario
from scenarios.shell.template import Template
from scenarios.studies.registration import series

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "by_machine",
    "draw",
    "estimate",
    "machine_words",
    "of_all",
    "report",
    "saved",
    "shared_words",
    "table",
    "truth",
    "words",
]

TEXT = Template("""
@made
Ambient {day}; {loads}; truth by {solver}, exchange {exchange} every {ms:g}
ms; apu-casadi {version}.

@none
No short circuit happened and none was reported.

@none falsely
No short circuit happened, but {n} samples of 20 ms report one.

@short circuit
The short circuit in phase {true_phase} at {onset:g} s {when}; {before}

@at once
was reported {ms:.0f} ms later, at the next sample of 20 ms

@later
was reported {ms:.0f} ms later

@not found
was not found

@before
none was reported before it.

@before falsely
before it {n} samples report one that is not there.

@severity
Its severity is h = {h:.4e} +- {half_width:.1e} (true {h_true:.4e}). More the terminals do not tell:
with full coupling mu and k_rf act through h alone, so every pair on the ridge mu = h (1 + k_rf)/(1
+ h) fits equally well, such as (mu, k_rf) = {pairs}.

@change found
The change of gas-path health at {onset:g} s was reported {ms:.0f} ms later.

@change missed
The change of gas-path health at {onset:g} s was not reported.

@other
A change of health that is not there was reported at {times} s.

@no other
No other change of health was reported.

@unmoved
The short circuit moved no estimated health factor by more than 1 sigma within {seconds:.2g} s
({name} most, {change:+.2f} % where 1 sigma is {sigma:.2f} %): its loss is explained by h, not by
the gas path.

@moved
The short circuit moved the estimated {name} by {change:+.2f} % within {seconds:.2g} s, more than
its 1 sigma of {sigma:.2f} %.

@h moved
The change of health at {onset:g} s moved {name} by {of_n:+.1e} within {seconds:.2g} s (1 sigma is
{sigma_n:.1e}).

@doubt
NOT TO BE BELIEVED as it stands: {why}.

@parts
Part by part{parts}.

@caption
Scenario {scenario}, seed {seed}; gain errors drawn for all sensors.
""")
FINE = 0.005  # s; exchange step of the truth
WAVEFORM = 1e-4  # s; sampling of the electrical sensors
Z95 = 1.96
_ENDS = ("", "_sigma", "_true")
_TOLD = (
    "ambient",
    "loads",
    "faults",
    "apu_casadi_version",
    "exchange_error",
    "validity",
    "warnings",
)
"""What an estimate takes over from the truth, as it was recorded."""
HEALTH_WORDS = {n: f"{h.component} {h.quantity}" for n, h in HEALTH_FACTORS.items()}
SEVERITIES = ("h_a", "h_b", "h_c")
SHOWN = ("N", *HEALTH, *SEVERITIES, "P_total")
COMMON = ("N", *HEALTH, "P_total")


def truth(
    scenario: Scenario | str, *, progress: Callable[[float, float], None] | None = None
) -> xr.Dataset:
    """Simulate what is true; a scenario of the library is kept for the next call.

    Raises:
        ScenarioError: unknown scenario, ambient conditions other than the filters', or an exchange
            step that is no multiple of 5 ms.
        SimulationError: as the simulation.
    """
    if isinstance(scenario, str) and progress is None:
        return _kept(scenario)
    s = registry.get(scenario) if isinstance(scenario, str) else scenario
    return _simulated(s, progress)


@last(1)
def _kept(name: str) -> xr.Dataset:
    return _simulated(registry.get(name), None)


def _simulated(s: Scenario, progress: Callable[[float, float], None] | None) -> xr.Dataset:
    from apu_casadi.unit.events import Ambient
    from apu_casadi.unit.multirate import simulate_joint

    if s.ambient != Ambient():
        raise ScenarioError(
            f"{s.name}: the gas-path filter of the joint estimation knows the ambient conditions "
            f"{dataclasses.asdict(Ambient())} only, the scenario has "
            f"{dataclasses.asdict(s.ambient)}"
        )
    if s.duration < 3 * DT:
        raise ScenarioError(f"{s.name}: {s.duration:g} s are too short to estimate anything in")
    given: dict[str, Any] = {**s.start(), "ambient": s.ambient, "events": s.events()}
    fine: dict[str, Any] = {"dt": FINE, "exchange": "corrected", "waveform_dt": WAVEFORM}
    fine["solver"] = "cvodes"
    unit = registry.unit_for(s)
    unit.refuse_different("the joint estimation")
    require_linear(unit.generator.machine, "the joint estimation")
    if unit.generator.power != "paper":
        raise ScenarioError(
            f"{s.name}: the joint estimation passes on the shaft power of (8): generator.power "
            f"must be 'paper', the scenario has {unit.generator.power!r}"
        )
    ds = simulate_joint(unit, duration=s.duration, progress=progress, **given, **fine)
    ds.attrs["scenario"] = s.to_json()
    ds.attrs["phases"] = json.dumps(s.phase_table(), ensure_ascii=False)
    return ds


def estimate(
    ds: xr.Dataset,
    seed: int,
    *,
    sensors: SensorFile | str | Path | None = None,
    folder: Path | None = None,
) -> xr.Dataset:
    """Measure a truth with the errors of a seed, and estimate from that recording alone.

    The estimate is that of :func:`estimators.apu.recorded_estimate.estimate`; beside it stands the
    truth, as from :func:`~estimators.apu.joint.estimate_joint`.  It carries scenario, phases, seed,
    doubts and what is lacking as attributes.

    Args:
        ds: the truth.
        seed: of all errors.
        sensors: what is measured, or its file; the tables by default.
        folder: where the recording is written; nowhere by default.

    Raises:
        DataError, EstimationError: no estimate of gas path and generators; as the estimate.
    """
    s = json.loads(ds.attrs["scenario"])
    unit = registry.unit_for(Scenario.from_dict(s))
    of = sensors if isinstance(sensors, SensorFile) else read_sensors(sensors)
    made = measure_run(ds, unit, seed, of)
    recorded = made.values() if folder is None else write_recording(made, folder / "recording.nc")
    # the efficiency is no sensor's: its error is of the unit as the filters know it
    error = drawn_gains(of, seed).get("PW", 0.0)
    e = recorded_estimate(read_recording(*recorded), unit, sensors=of, efficiency_error=error)
    if e.path is None or not e.sides:
        raise EstimationError("; ".join(f"{n}: {why}" for n, why in e.lacking.items()))
    found = beside_truth(ds, e.sides, *e.path)
    told = {"doubts": list(e.doubts), "lacking": dict(e.lacking), "notes": list(e.notes)}
    told |= {"belief": verdict(e.belief)}
    found.attrs |= {n: json.dumps(v) for n, v in told.items()} | {"seed": seed}
    found.attrs |= {n: ds.attrs[n] for n in ("scenario", "phases")}
    found.attrs |= {n: ds.attrs[n] for n in (*_TOLD, "apu_casadi_version") if n in ds.attrs}
    if "solver" in ds.attrs:
        found.attrs["truth_solver"] = ds.attrs["solver"]
    return found


def joint_seconds(repeat: int = 3) -> dict[str, Any]:
    """Time the joint estimation of ``joint`` on one core; compiled before, fastest of some.

    Returns:
        ``seconds`` of measuring and estimating, and ``simulated`` seconds.
    """
    ds = truth("joint")
    best = math.inf
    estimate(ds, 1)  # compiles
    for _ in range(repeat):
        began = time.perf_counter()
        estimate(ds, 1)
        best = min(best, time.perf_counter() - began)
    return {"seconds": best, "simulated": float(ds["time"].values[-1])}


# ------------------------------------------------------------------------------ what it says


def _at(t: np.ndarray, when: float) -> int:
    """Last sample at or before an instant."""
    return int(np.searchsorted(t, when + 1e-9)) - 1


def by_machine(e: xr.Dataset) -> dict[int, xr.Dataset]:
    """Return the estimate with the severities of each generator alone, by its number.

    Where all carry the same and one stands for them there is one entry, of number 0.
    """
    if SEVERITIES[0] in e:
        return {0: e}
    first = f"{SEVERITIES[0]}_"
    names = [str(n) for n in e if str(n).startswith(first)]
    numbers = [int(n.removeprefix(first)) for n in names if n.removeprefix(first).isdigit()]
    found = {}
    for k in sorted(numbers):
        own = {f"{n}_{k}": n for n in ("faulty_phase", "ttsc_probability")}
        own |= {f"{n}_{k}{end}": f"{n}{end}" for n in SEVERITIES for end in _ENDS}
        found[k] = e.rename(own)
    return found


def of_all(reports: Mapping[int, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the report of all generators, from those of :func:`by_machine`, ready for JSON.

    Where they differ, what each has of its own is a list: ``generators``.
    """
    shared = dict(reports[min(reports)])
    if 0 in reports:
        return shared
    own = ("phases", "short_circuit", "cross_talk")
    each = [{"generator": k, **{n: r[n] for n in own}} for k, r in reports.items()]
    return {n: v for n, v in shared.items() if n not in own} | {"generators": each}


def report(e: xr.Dataset) -> dict[str, Any]:
    """Return what the estimate says, by phase, ready for JSON.

    ``phases``: at the end of each, for the factors and severities truth, estimate, half width of
    the 95 % band and whether it holds the truth.  ``short_circuit``: true phase, onset, when it was
    found and in which phase, reports before it, the severity as a ridge of (mu, k_rf).  ``health``:
    true changes with the delay of their report, and reports without one.  ``cross_talk``: what each
    fault changed in the estimates of the other kind.
    """
    t = e["time"].values
    phases = json.loads(e.attrs["phases"])
    scenario = json.loads(e.attrs["scenario"])
    rows = []
    for p in phases:
        k = _at(t, min(p["end"], t[-1]) - (0 if p is phases[-1] else 1e-6))
        values = {}
        for n in SHOWN:
            x, true = (float(e[f"{n}{end}"].values[k]) for end in ("", "_true"))
            s = float(e[f"{n}_sigma"].values[k])
            inside = bool(abs(x - true) <= Z95 * s)
            values[n] = {"true": true, "estimate": x, "half_width": Z95 * s, "inside": inside}
        found = int(e["faulty_phase"].values[k])
        place = {n: p[n] for n in ("name", "start", "end")}
        phase = PHASES[found - 1] if found else None
        rows.append({**place, "values": values, "faulty_phase": phase})
    about = {"scenario": scenario["name"], "title": scenario.get("title", "")}
    about |= {k: scenario[k] for k in ("engine", "governor") if k in scenario}
    found_out = {"short_circuit": _short_circuit(e), "health": _health(e)}
    doubts = json.loads(e.attrs.get("doubts", "[]"))
    belief = json.loads(e.attrs.get("belief", "{}"))
    about |= {"believable": not doubts, "doubts": doubts, "belief": belief}
    if compared := json.loads(e.attrs.get("compared", "{}")):
        about["compared"] = compared
    out = {**about, "seed": e.attrs["seed"], **made_with(e), "phases": rows, **found_out}
    return {**out, "cross_talk": _cross_talk(e)}


def made_with(e: xr.Dataset) -> dict[str, Any]:
    """Return what the truth was simulated with and what must be known of it, ready for JSON."""
    told = ("ambient", "loads", "validity", "warnings", "truth_solver")
    out: dict[str, Any] = {k: json.loads(e.attrs.get(k, "null")) for k in told}
    return out | {"apu_casadi_version": e.attrs.get("apu_casadi_version", "")}


def made_words(r: Mapping[str, Any]) -> str:
    """Return what the truth of a report was simulated with, in words; "" if it is not recorded."""
    from apu_casadi.gaspath.conditions import day_words

    if not (r.get("ambient") and r.get("loads")):
        return ""
    differ = any(x.get("generator") for x in r["loads"])
    each = [(f"generator {k}" if (k := x.get("generator")) else "each") for x in r["loads"]]
    told = [f"{x['load']} from {x['t']:g} s" for x in r["loads"]]
    if differ:
        told = [f"{of} {what}" for of, what in zip(each, told, strict=True)]
    loads = f"load of {'' if differ else 'each generator '}{', '.join(told)}"
    by = {"solver": None, "exchange": None, "dt": 0.0} | (r.get("truth_solver") or {})
    version = r["apu_casadi_version"]
    values = {"solver": str(by["solver"]), "exchange": str(by["exchange"]), "ms": 1e3 * by["dt"]}
    unit = f" Unit {Path(r['engine']).stem}." if "engine" in r else ""
    day = day_words(r["ambient"])
    return TEXT.text("made", day=day, loads=loads, version=version, **values) + unit


def _onsets(e: xr.Dataset, names: tuple[str, ...]) -> list[int]:
    """First samples at which some true value differs from the one before."""
    true = np.array([e[f"{n}_true"].values for n in names])
    return [int(k) + 1 for k in np.flatnonzero(np.abs(np.diff(true, axis=1)).max(0) > 1e-9)]


def _grouped(onsets: list[int]) -> list[int]:
    """The first of each run of neighbouring samples."""
    return [k for j, k in enumerate(onsets) if j == 0 or k > onsets[j - 1] + 1]


def _short_circuit(e: xr.Dataset) -> dict[str, Any] | None:
    t, said = e["time"].values, e["faulty_phase"].values.astype(int)
    true = np.array([e[f"h_{p}_true"].values for p in PHASES])
    out: dict[str, Any] = {"resets": json.loads(e.attrs["resets"])}
    if not true.any():
        return out | {"true_phase": None, "false_reports": int(np.count_nonzero(said))}
    i = int(true.max(1).argmax())
    first = int(np.flatnonzero(true[i] > 0)[0])
    # a change at an instant shows in the sample after it
    onset = float(t[max(first - 1, 0)]) if first else float(t[0])
    right = np.flatnonzero(said[first:] == i + 1)
    x, s = (float(e[f"h_{PHASES[i]}{end}"].values[-1]) for end in ("", "_sigma"))
    wrong = (said[first:] != i + 1) & (said[first:] > 0)
    out |= {"true_phase": PHASES[i], "onset": onset}
    out["found_after"] = float(t[first + right[0]] - onset) if right.size else None
    out["false_reports"] = int(np.count_nonzero(said[:first]))
    out["wrong_phase_samples"] = int(np.count_nonzero(wrong))
    severity = {"h": x, "half_width": Z95 * s, "h_true": float(true[i, -1])}
    return {**out, **severity, "ridge": ridge(x) if x > 0 else []}


def _health(e: xr.Dataset) -> dict[str, Any]:
    t = e["time"].values
    alarms = json.loads(e.attrs["alarms"])
    changes, matched = [], set()
    for k in _grouped(_onsets(e, HEALTH)):
        onset = float(t[k - 1])
        # within a second, or before the next change
        after = [a for a in alarms if onset < a <= onset + 1.0 and a not in matched]
        if after:
            matched.add(after[0])
        changes.append({"onset": onset, "found_after": after[0] - onset if after else None})
    return {"changes": changes, "other_alarms": [a for a in alarms if a not in matched]}


def _cross_talk(e: xr.Dataset) -> dict[str, Any]:
    """Change of the other kind's estimates over a fault, and their sigma.

    From the sample before the fault to 1 s after it, or to what happens next.
    """
    t = e["time"].values
    h_names = tuple(f"h_{p}" for p in PHASES)
    out: dict[str, Any] = {"short_circuit_on_health": [], "health_on_h": []}
    pairs = (("short_circuit_on_health", h_names, HEALTH), ("health_on_h", HEALTH, h_names))
    for key, cause, effect in pairs:
        own = set(_grouped(_onsets(e, effect)))
        every = sorted(own | set(_grouped(_onsets(e, cause))))
        for k in _grouped(_onsets(e, cause)):
            if k in own:  # both at once: nothing can be told apart
                continue
            later = [j - 1 for j in every if j > k]
            before, after = k - 1, min([_at(t, t[k] + 1.0), *later])
            row = {"onset": float(t[before]), "seconds": float(t[after] - t[before])}
            change = {n: float(e[n].values[after] - e[n].values[before]) for n in effect}
            sigma = {n: float(e[f"{n}_sigma"].values[after]) for n in effect}
            out[key].append({**row, "change": change, "sigma": sigma})
    return out


def table(r: Mapping[str, Any], names: tuple[str, ...] = SHOWN) -> str:
    """Return the phases side by side: truth, estimate with its 95 % half width."""
    forms: dict[str, tuple[str, float, str]] = {
        "N": ("shaft speed N [r/min]", 30 / math.pi, ".1f"),
        "P_total": ("mechanical power [kW]", 1e-3, ".2f"),
        **{n: (f"{HEALTH_WORDS[n]} {n}", 1.0, ".4f") for n in HEALTH},
        **{f"h_{p}": (f"severity h_{p} [1e-3]", 1e3, ".4f") for p in PHASES},
    }
    head = ["at the end of", *(p["name"] for p in r["phases"])]
    lines = [["  t [s]", *(f"{p['end']:g}" for p in r["phases"])]]
    for n in names:
        label, scale, form = forms[n]
        cells, true = [], []
        for p in r["phases"]:
            v = p["values"][n]
            mark = "" if v["inside"] else " *"
            cells.append(
                f"{scale * v['estimate']:{form}} +- {scale * v['half_width']:{form}}{mark}"
            )
            true.append(f"{scale * v['true']:{form}}")
        lines += [[label, *cells], ["  true", *true]]
    if SEVERITIES[0] in names:
        found = [p["faulty_phase"] or "-" for p in r["phases"]]
        lines.append(["short circuit found in phase", *found])
    width = [max(len(x[i]) for x in (head, *lines)) for i in range(len(head))]

    def row(cells: list[str]) -> str:
        rest = (f"{c:>{w}}" for c, w in zip(cells[1:], width[1:], strict=True))
        return f"{cells[0]:<{width[0]}}  " + "  ".join(rest)

    text = [row(head), "-" * len(row(head)), *(row(x) for x in lines)]
    if any(not p["values"][n]["inside"] for p in r["phases"] for n in names):
        text.append("* the truth lies outside the 95 % band (one in twenty should)")
    return "\n".join(x.rstrip() for x in text)


def words(r: Mapping[str, Any]) -> list[str]:
    """Return what was found, in sentences."""
    health, doubts = _health_words(r), _doubt_words(r)
    return [*_short_circuit_words(r["short_circuit"]), *health, *_cross_talk_words(r), *doubts]


def machine_words(r: Mapping[str, Any]) -> list[str]:
    """Return what :func:`words` says of the one generator of a report of :func:`by_machine`."""
    return [*_short_circuit_words(r["short_circuit"]), *_cross_talk_words(r)]


def shared_words(r: Mapping[str, Any]) -> list[str]:
    """Return what :func:`words` says of the gas path and of all generators together."""
    return [*_health_words(r), *_doubt_words(r)]


def _health_words(r: Mapping[str, Any]) -> list[str]:
    health, out = r["health"], []
    for c in health["changes"]:
        late = c["found_after"]
        block = "change missed" if late is None else "change found"
        out.append(TEXT.text(block, onset=c["onset"], ms=1e3 * (late or 0.0)))
    if health["other_alarms"]:
        out.append(TEXT.text("other", times=", ".join(f"{a:g}" for a in health["other_alarms"])))
    elif health["changes"]:
        out.append(TEXT.text("no other"))
    return out


def _cross_talk_words(r: Mapping[str, Any]) -> list[str]:
    talk, out = r["cross_talk"], []
    for c in talk["short_circuit_on_health"]:
        n = max(HEALTH, key=lambda n: abs(c["change"][n]) / c["sigma"][n])
        values = {"change": 100 * c["change"][n], "sigma": 100 * c["sigma"][n]}
        block = "unmoved" if abs(values["change"]) < values["sigma"] else "moved"
        out.append(TEXT.text(block, name=HEALTH_WORDS[n], seconds=c["seconds"], **values))
    for c in talk["health_on_h"]:
        n = max(c["change"], key=lambda n: abs(c["change"][n]))
        out.append(TEXT.text("h moved", name=n, of_n=c["change"][n], sigma_n=c["sigma"][n], **c))
    return out


def _doubt_words(r: Mapping[str, Any]) -> list[str]:
    out = [f"{s[:1].upper()}{s[1:]}." for s in compared_words(r.get("compared"))]
    out += [TEXT.text("doubt", why=d) for d in r.get("doubts", ())]
    parts = in_words(r.get("belief", {})) if r.get("doubts") else ""
    return [*out, TEXT.text("parts", parts=parts)] if parts else out


def _short_circuit_words(s: Mapping[str, Any]) -> list[str]:
    false = s["false_reports"]
    if s["true_phase"] is None:
        return [TEXT.text("none falsely" if false else "none", n=false)]
    late = s["found_after"]
    when = "not found" if late is None else "at once" if late <= DT + 1e-9 else "later"
    values = {"when": TEXT.text(when, ms=1e3 * (late or 0.0))}
    values["before"] = TEXT.text("before falsely" if false else "before", n=false)
    out = [TEXT.text("short circuit", **values, **s)]
    if s["ridge"]:
        pairs = ", ".join(f"({p['mu']:.3g}, {p['k_rf']:g})" for p in s["ridge"])
        out.append(TEXT.text("severity", pairs=pairs, **s))
    return out


def saved(e: xr.Dataset, every: int = 2) -> dict[str, Any]:
    """Return an estimate for JSON: the report, and every second sample for the figure."""
    keep, curves = slice(None, None, every), {}
    for n in SHOWN:
        curves[n], curves[f"{n}_sigma"] = e[n].values[keep], e[f"{n}_sigma"].values[keep]
        curves[f"{n}_true"] = e[f"{n}_true"].values[keep]
    t, alarms = e["time"].values[keep], json.loads(e.attrs["alarms"])
    return {"report": report(e), "t": t, "curves": curves, "alarms": alarms}


def draw(kept: Mapping[str, Any], path: Path, *, dpi: int | None = None) -> Path:
    """Draw truth, estimate and band of :func:`saved` numbers into a PNG file."""
    return files.save_figure(figure(kept), path, **({} if dpi is None else {"dpi": dpi}))


def figure(kept: Mapping[str, Any], number: int = 0) -> Any:
    """Return the matplotlib figure of :func:`saved` numbers: truth, estimate and band.

    Args:
        kept: the numbers.
        number: of the generator whose severities they are; 0 where one stands for all.
    """
    from scenarios.figures.jointestimateplot import plot_joint_estimate

    r = kept["report"]
    curves = {n: series(v) for n, v in kept["curves"].items()}
    phases = [(p["name"], p["start"]) for p in r["phases"]]
    of = f"Severities of generator {number}. " if number else ""
    note = of + TEXT.text("caption", **r) + " " + made_words(r)
    return plot_joint_estimate(kept["t"], curves, phases=phases, alarms=kept["alarms"], note=note)
