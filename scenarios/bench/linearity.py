"""Cost against what is asked for: simulated time, runs one by one and together, output rate."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import numpy as np

from apu_casadi.core import files
from apu_casadi.unit.ensemble import simulate_ensemble
from scenarios.bench.laneparts import asked_of
from scenarios.bench.measuring import Row, Size, timed
from scenarios.bench.runparts import simulate
from scenarios.campaigns import random_faults, run_campaign
from scenarios.figures.benchplot import fit, plot_costs
from scenarios.schema import Scenario

Curves = dict[str, tuple[np.ndarray, np.ndarray]]


def linear(size: Size) -> Curves:
    """Cost against simulated time, number of runs, members and output rate: x and seconds."""
    s = size.joint
    repeats = min(3, size.repeats)
    made: Curves = {}

    def cost(scenario: Scenario) -> float:
        return timed(lambda: simulate(scenario, solver="propagator"), repeats)[0]

    quiet = s.change(waveform_dt=None)
    simulate(quiet, solver="propagator")
    t = np.array([max(d, s.duration) for d in size.durations])
    made["duration"] = t, np.array([cost(quiet.change(duration=float(d))) for d in t])
    run_campaign(random_faults(max(size.counts), seed=2, base=s), workers=1)
    seconds = []
    for n in size.counts:  # faults not met before: nothing of them is kept in memory
        runs = random_faults(n, seed=100 + n, base=s)
        seconds.append(timed(partial(run_campaign, runs, workers=1), 1)[0])
    made["runs"] = np.array(size.counts, float), np.array(seconds)
    seconds = []
    for n in size.counts:
        asked = [asked_of(r.change(waveform_dt=None)) for r in random_faults(n, seed=n, base=s)]
        ends = partial(simulate_ensemble, asked, keep=lambda _, ds: ds.sizes, refused="keep")
        seconds.append(timed(ends, 1)[0])
    made["members"] = np.array(size.counts, float), np.array(seconds)
    rates = np.array(size.rates)
    took = []
    for r in rates:
        case = s.change(waveform_dt=None if r == 0 else 1 / float(r))
        simulate(case, solver="propagator")
        took.append(cost(case))
    made["rate"] = rates / 1e3, np.array(took)
    return made


def linear_rows(curves: Curves) -> list[Row]:
    """Return how far from a straight line the costs are."""
    names = {"duration": "simulated time", "runs": "number of runs", "rate": "output rate"}
    names["members"] = "number of members of an ensemble"
    rows = []
    for key, (x, y) in curves.items():
        *_, off = fit(x, y)
        what = f"cost against {names[key]}: distance from a line"
        rows.append(Row(what, 100 * off, "%", 15.0, 0.0, 0.0, "a timing"))
    return rows


def write_plot(curves: Curves, size: Size, path: str | os.PathLike[str]) -> Path:
    """Draw the linearity plot and return its path."""
    labels = {
        "duration": ("Simulated time", "Simulated time [s]"),
        "runs": ("Number of runs", "Joint runs with random faults"),
        "members": ("Members of an ensemble", "Joint runs in one loop, in lanes"),
        "rate": ("Output rate", "Waveform samples per ms"),
    }
    panels = [(*labels[k], "Wall time [s]", *curve) for k, curve in curves.items()]
    fig = plot_costs(
        panels,
        f"Cost of joint runs on one core. Left: the {size.joint.name} scenario with its last phase "
        f"prolonged, no waveforms. Middle: {size.joint.duration:g} s each. Right: "
        f"{size.joint.duration:g} s; 0 stores no waveforms. Lines: least squares.",
    )
    return files.save_figure(fig, path, dpi=120)
