"""The profiles that a run followed: day, health, speed, loads and faults as they were held."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.results import of_generator
from apu_casadi.core.units import RPM
from apu_casadi.unit.runsummary import phases, severity_h
from scenarios.figures import figstyle as fs
from scenarios.figures.runwords import scenario_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure


WORDS = {
    "altitude": "Altitude",
    "Mach": "Mach number",
    "power_kW": "power",
    "power_factor": "power factor",
    "mu": "$\\mu$",
    "k_rf": "$k_{rf}$",
    "kappa": "$\\kappa$",
}
"""What stands at the axes for names of profiles; other names stand themselves."""


def given_profiles(ds: xr.Dataset) -> list[dict[str, Any]]:
    """Return the profiles of a run, each place once, as the run records them; [] without any."""
    try:
        rows = json.loads(ds.attrs["profiles"])
        each = {(g["part"], g["name"], g.get("generator")): g for g in rows}
    except (KeyError, TypeError, ValueError):
        return []
    return list(each.values())


def _held(ds: xr.Dataset, row: dict[str, Any]) -> tuple[str, np.ndarray] | None:
    """Return label and values of what a profile gave; None where the run does not keep it."""
    part, name, number = row["part"], row["name"], row.get("generator")
    of = "" if number is None else f", generator {number}"
    if part == "speed":
        return "Speed reference [r/min]", ds["N_ref"].values * RPM
    if part == "fault":
        own = of_generator(ds, number or 1)
        if name == "h":
            mu = own["mu"].values
            h = severity_h(mu, own["k_rf"].values)
            return f"Fault $h${of}", np.where(mu > 0, h, np.nan)
        return (f"Fault {WORDS.get(name, name)}{of}", own[name].values) if name in own else None
    key = name if part != "load" else f"load_{name}" + ("" if number is None else f"_{number}")
    if key not in ds:
        return None
    unit = ds[key].attrs["units"]
    words = WORDS.get(name, name)
    words = f"Load {words}{of}" if part == "load" else words
    return words + ("" if unit in ("", "1") else f" [{unit}]"), ds[key].values


def figure_profiles(ds: xr.Dataset) -> Figure:
    """Draw every profile of a run over time, as it was held over the steps.

    Raises:
        DataError: a variable is missing.
    """
    curves = [c for row in given_profiles(ds) if (c := _held(ds, row)) is not None]
    rows, t = phases(ds), ds["time"].values
    with fs.drawing():
        fig = fs.new_figure(1.6 + 1.5 * len(curves))
        place = {"left": 0.11, "right": 0.985, "hspace": 0.25}
        grid = fig.add_gridspec(len(curves), 1, **place, **fs.margins(fig, top=0.55, bottom=0.9))
        for k, (label, values) in enumerate(curves):
            ax = fig.add_subplot(grid[k, 0])
            fs.bands(ax, rows, names=k == 0)
            ax.step(t, values, where="pre", color=fs.look(k)[0], lw=1.7)
            ax.set_ylabel(label, fontsize=8.5)
            fs.roomy(ax, values[np.isfinite(values)], 0.1)
            ax.tick_params(labelbottom=k == len(curves) - 1)
        ax.set_xlabel("Time [s]")
        fig.align_ylabels()
        name = scenario_of(ds).get("name", "")
        words = "Profiles that the run followed, held over each exchange step at mid-step."
        fs.caption(fig, words + (f" Scenario “{name}”." if name else ""))
    return fig
