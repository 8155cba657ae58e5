"""What a run was made with, in words for the caption of a figure; read from its attributes.

:mod:`apu_casadi.unit.runrecord` writes them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.results import GENERATOR, generators_of, of_generator
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.unit.runsummary import severity_h
from scenarios.figures.figstyle import caption

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

SEVERITY = tuple(s.name for s in Ttsc.severities)
"""Of a stator fault, as a run records it."""
FIGURES = {
    "fig20_phases": "Phases of the run: load, gas-path health and stator fault",
    "fig21_speed_power": "Shaft speed and shaft power of the gas generator",
    "fig22_compressor_outlet": "Compressor outlet total temperature and total pressure",
    "fig23_T4_surge_margin": "Combustor outlet total temperature and compressor surge margin",
    "fig24_currents": "Three-phase currents of the starter/generator",
    "fig25_voltages": "Three-phase voltages of the starter/generator",
}
"""File names (without ``.png``) and titles, in the paper's order."""
PAPER = "joint"
"""The scenario whose figures the paper has; those of others have no number."""


def _rows(ds: xr.Dataset, name: str) -> list[dict[str, Any]]:
    """Return an attribute that is a JSON list of tables; [] where it is absent."""
    try:
        found = json.loads(ds.attrs[name])
    except (KeyError, TypeError, ValueError):
        return []
    return [r for r in found if isinstance(r, dict)] if isinstance(found, list) else []


def fault_phase(ds: xr.Dataset, t: float, number: int = 1) -> str:
    """Tell the phase of the stator fault that holds at ``t`` [s]; "" where it is not recorded."""
    rows = [r for r in _rows(ds, "faults") if r.get(GENERATOR, number) == number]
    held = [r.get("phase") for r in rows if float(r.get("t", 0.0)) < t - 1e-9]
    return f" of phase {held[-1]}" if held and held[-1] else ""


def _loads_of(ds: xr.Dataset, number: int) -> list[str]:
    """Return the loads of a generator in words, of many the first two."""
    rows = [r for r in _rows(ds, "loads") if r.get(GENERATOR, number) == number]
    # of one that follows a profile what it is at first
    loads = list(dict.fromkeys(str(r.get("load")).partition(";")[0] for r in rows))
    return [*loads[:2], f"{len(loads) - 2} more"] if len(loads) > 3 else loads


def made_with(ds: xr.Dataset) -> str:
    """Tell unit, loads, day, solver, exchange, seed and version of a run, if recorded."""
    words = []
    engine = scenario_of(ds).get("engine")
    words += [f"Unit {Path(str(engine)).stem}"] if engine else []
    numbers = generators_of(ds)
    by_number = {k: _loads_of(ds, k) for k in numbers}
    alike = all(loads == by_number[numbers[0]] for loads in by_number.values())
    for k, loads in list(by_number.items())[: 1 if alike else None]:
        of = f"of {'each generator' if alike else f'generator {k}'}"
        of = of if k > numbers[0] else f"Load {of}"
        words += [f"{of}: {', then '.join(loads)}"] if loads else []
    followed = {row.get("part") for row in _rows(ds, "profiles")}
    late = " at first" if "ambient" in followed else ""
    try:
        day, solver = json.loads(ds.attrs["ambient"]), json.loads(ds.attrs["solver"])
        words.append(
            f"{day['altitude']:g} m, Mach {day['Mach']:g}, ISA {day['dT_isa']:+g} K, "
            f"war {day['war']:g}{late}"
        )
        words.append(f"{solver['solver']}, exchange {solver['exchange']}, seed {ds.attrs['seed']}")
        words.append(f"apu-casadi {ds.attrs['apu_casadi_version']}")
    except (KeyError, TypeError, ValueError):
        pass
    return "; ".join(words) + "." if words else ""


def scenario_of(ds: xr.Dataset) -> dict[str, Any]:
    """Return the scenario of a run as a table; empty where it is not recorded."""
    try:
        found = json.loads(ds.attrs["scenario"])
    except (KeyError, TypeError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def severity_note(ds: xr.Dataset) -> str:
    """Tell the severity of the last stator fault: always mu, k_rf and kappa together."""
    if not all(n in ds for n in SEVERITY):
        return ""
    numbers = generators_of(ds)
    notes = [_note_of(of_generator(ds, k), k, of_all=len(numbers) == 1) for k in numbers]
    return " ".join(n for n in notes if n)


def _note_of(ds: xr.Dataset, number: int, *, of_all: bool) -> str:
    """Tell it of one generator, given the run as that has it."""
    mu = ds["mu"].values
    hit = np.flatnonzero(mu > 0)
    if hit.size == 0:
        return ""
    h = severity_h(mu[hit], ds["k_rf"].values[hit])
    grows = float(np.ptp(h)) > 1e-9 * float(h.max())
    k = hit[int(np.argmax(h))] if grows else hit[-1]
    m, r, c = (float(ds[n].values[k]) for n in SEVERITY)
    kappa = f"κ = µ = {c:g}" if abs(c - m) < 1e-12 else f"κ = {c:g}"
    where = fault_phase(ds, float(ds["time"].values[k]), number)
    where += "" if of_all else f" of generator {number}"
    where += ", at most" if grows else ""
    return f"TTSC{where}: µ = {100 * m:g} %, $k_{{rf}}$ = {r:.4g}, {kappa}."


def _count(ds: xr.Dataset) -> int:
    return int(ds.attrs.get("generators", 2))


def caption_of(
    fig: Figure, ds: xr.Dataset, key: str, more: str = "", number: int | None = None
) -> None:
    """Write title, scenario, severity and what the run was made with under a figure.

    Figures of the paper's scenario and unit have their number.

    Args:
        more: further words.
        number: of the generator that is drawn; None: the unit, or each.
    """
    name, engine = (scenario_of(ds).get(n, "") for n in ("name", "engine"))
    title = FIGURES[key] if number is None else f"{FIGURES[key]} {number}"
    number_of_it = f"Figure {key[3:5]}. " if name == PAPER and not engine else ""
    # one figure for several machines
    alike = number is None and title.endswith("starter/generator") and _count(ds) > 1
    title = title.replace("of the starter", "of each starter") if alike else title
    words = [f"{number_of_it}{title}.", f"Scenario “{name}”." if name else ""]
    words += [severity_note(ds) if key != "fig20_phases" else "", more, made_with(ds)]
    caption(fig, " ".join(w for w in words if w))
