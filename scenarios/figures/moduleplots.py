"""Figures 15 to 19 of the paper: gas generator and starter/generator, each alone."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.units import RPM
from scenarios.figures import figstyle as fs
from scenarios.figures.threephase import cycle_rms

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MODULE_FIGURES = {
    "fig15_speed_T3": "Shaft speed and compressor outlet total temperature",
    "fig16_P3_T4": "Compressor outlet total pressure and combustor outlet total temperature",
    "fig17_T5_surge_margin": "Turbine outlet total temperature and compressor surge margin",
    "fig18_healthy_transient": "Generator, load step to the design point: currents and voltages",
    "fig19_ttsc_currents": "Generator at the design point, 5 % short circuit: currents",
}
"""File names (without ``.png``) and titles of Figures 15 to 19."""

_GAS_PANELS = {
    "fig15_speed_T3": (("N", "Shaft speed [r/min]", RPM), ("T3", "$T_3$ [K]", 1.0)),
    "fig16_P3_T4": (("P3", "$P_3$ [kPa]", 1e-3), ("T4", "$T_4$ [K]", 1.0)),
    "fig17_T5_surge_margin": (("T5", "$T_5$ [K]", 1.0), ("SM", "Surge margin [%]", 100.0)),
}


def _note(fig: Figure, key: str, more: str) -> None:
    fs.caption(fig, f"Figure {key[3:5]}. {MODULE_FIGURES[key]}. {more}")


def figure_gas_generator(
    key: str, runs: Sequence[xr.Dataset], checks: Sequence[xr.Dataset], t_step: float
) -> Figure:
    """Draw one of Figures 15 to 17: the gas generator alone, fuel step at ``t_step`` [s].

    Args:
        key: of :data:`MODULE_FIGURES`.
        runs, checks: the same runs by two routes, the latter drawn as dots; attribute ``f_W_t``.

    Raises:
        DataError: a variable is missing.
    """
    panels = _GAS_PANELS[key]
    for ds in (*runs, *checks):
        fs.need(ds, [p[0] for p in panels])
    t_end = float(runs[0]["time"][-1])
    after = "fuel flow +10 %, load proportional to speed cubed"
    rows = [
        {"name": "degraded gas path, 230 kW", "start": 0.0, "end": t_step},
        {"name": after, "start": t_step, "end": t_end},
    ]
    with fs.drawing():
        fig = fs.new_figure(6.3)
        place = {"left": 0.085, "right": 0.985, "hspace": 0.14}
        grid = fig.add_gridspec(len(panels), 1, **place, **fs.margins(fig, top=0.45, bottom=1.0))
        for r, (name, label, scale) in enumerate(panels):
            ax = fig.add_subplot(grid[r])
            fs.bands(ax, rows, names=r == 0)
            every = []
            for ds, check, ink in zip(runs, checks, itertools.cycle(fs.LINE_INK), strict=False):
                t, y = ds["time"].values, ds[name].values * scale
                ax.plot(t, y, color=ink, lw=1.7, solid_joinstyle="round")
                some = slice(None, None, max(t.size // 40, 1))
                x, dots = check["time"].values[some], check[name].values[some] * scale
                ax.plot(x, dots, "o", ms=3.6, mfc="white", mec=ink, mew=1.0)
                every.append(y)
            fs.roomy(ax, np.concatenate(every), 0.1)
            ax.set_ylabel(label)
            ax.tick_params(labelbottom=r == len(panels) - 1)
            if r == 0:
                fs.legend(ax, "lower right", _routes(runs))
        ax.set_xlabel("Time [s]")
        _note(
            fig,
            key,
            "Efficiency of compressor −1 %, of turbine −2 %, compressor flow −3 %; the paper's "
            "“4 % turbine flow degradation” with either sign. Lines: 20 ms step of (12).",
        )
    return fig


def _routes(runs: Sequence[xr.Dataset]) -> list[Any]:
    """Return the entries of the legend: lines by turbine flow, dots of the second route."""
    from matplotlib.lines import Line2D

    flows = [f"turbine flow factor {float(ds.attrs['f_W_t']):g}" for ds in runs]
    lines = [
        Line2D([], [], color=ink, lw=1.7, label=flow)
        for flow, ink in zip(flows, itertools.cycle(fs.LINE_INK), strict=False)
    ]
    dots = {"color": fs.INK, "marker": "o", "ls": "", "ms": 3.6, "mfc": "white"}
    return [*lines, Line2D([], [], label="continuous model, CVODES", **dots)]


def _ms(ax: Axes, lo: float, hi: float, *, xlabel: bool) -> None:
    """Shade before and after a change at 0 ms."""
    fs.change(ax, lo, 0, hi)
    ax.set_xlim(lo, hi)
    if xlabel:
        ax.set_xlabel("ms after the change", labelpad=1)


def figure_18(ds: xr.Dataset, check: xr.Dataset, origin: float) -> Figure:
    """Draw currents and voltages of the healthy generator around a load step at ``origin`` [s].

    ``check`` is the same run by another solver, drawn as dots.

    Raises:
        DataError: a variable is missing.
    """

    quantities = {"i": "Current [A]", "v": "Voltage [V]"}
    names = [f"{q}_{p}" for q in quantities for p in "abc"]
    for data in (ds, check):
        fs.need(data, names)
    t = (ds["time"].values - origin) * 1e3
    tc = (check["time"].values - origin) * 1e3
    late, apart = np.abs(t) > 0.5, 0.0
    for n in names:
        y, other = ds[n].values, np.interp(t, tc, check[n].values)
        apart = max(apart, float(np.abs(y - other)[late].max() / np.abs(y).max()))
    with fs.drawing():
        fig = fs.new_figure(6.6)
        place = {"left": 0.08, "right": 0.985, "hspace": 0.26, "wspace": 0.2}
        place |= fs.margins(fig, top=0.5, bottom=0.95)
        grid = fig.add_gridspec(2, 2, width_ratios=[1.7, 1.0], **place)
        for r, (q, label) in enumerate(quantities.items()):
            left, right = fig.add_subplot(grid[r, 0]), fig.add_subplot(grid[r, 1])
            _ms(left, -4, 10, xlabel=r == 1)
            _ms(right, -10, float(t[-1]), xlabel=r == 1)
            for p in "abc":
                y = ds[f"{q}_{p}"].values
                left.plot(t, y, color=fs.ABC[p], lw=1.2)
                some = np.flatnonzero((tc >= -4) & (tc <= 10))[::8]
                dots = check[f"{q}_{p}"].values[some]
                left.plot(tc[some], dots, "o", ms=2.6, mfc="white", mec=fs.ABC[p], mew=0.8)
                x, rms = cycle_rms(t, y)
                right.plot(x, rms, color=fs.ABC[p], lw=fs.NESTED[p])
            left.set_ylabel(label)
            right.set_ylabel(label.replace(" [", " rms ["))
            if r == 0:
                fs.above(left, "waveforms; dots: second solver", fs.PHASE_INK[1])
                fs.above(right, "rms over each cycle", fs.PHASE_INK[1])
                fs.abc_legend(left, "upper left")
                low, high = left.get_ylim()
                left.set_ylim(low, high + 0.22 * (high - low))
        said = f"From 100 kW to 225 kW. CVODES and IDAS differ by at most {apart:.0e} of the peak"
        _note(fig, "fig18_healthy_transient", f"{said}, from 0.5 ms after the step.")
    return fig


def figure_19(runs: Mapping[str, xr.Dataset], origin: float, notes: Mapping[str, str]) -> Figure:
    """Draw phase currents, their rms and the fault branch's current after a short circuit.

    Args:
        runs: by name, one column each.
        origin: instant of the fault, s.
        notes: severity of each run in words.

    Raises:
        DataError: a variable is missing.
    """

    for ds in runs.values():
        fs.need(ds, ["i_a", "i_b", "i_c", "i_fault"])
    with fs.drawing():
        fig = fs.new_figure(7.8)
        place = {"left": 0.08, "right": 0.985, "hspace": 0.32, "wspace": 0.17}
        place |= fs.margins(fig, top=0.5, bottom=0.95)
        grid = fig.add_gridspec(3, len(runs), height_ratios=[1.5, 1, 1], **place)
        for c, (name, ds) in enumerate(runs.items()):
            t = (ds["time"].values - origin) * 1e3
            waves, rms, branch = (fig.add_subplot(grid[r, c]) for r in range(3))
            _ms(waves, -4, 10, xlabel=False)
            _ms(rms, -10, float(t[-1]), xlabel=False)
            _ms(branch, -4, 10, xlabel=True)
            inside = (t >= -4) & (t <= 10)
            for p in "abc":
                y = ds[f"i_{p}"].values
                waves.plot(t[inside], y[inside], color=fs.ABC[p], lw=1.3)
                x, value = cycle_rms(t, y)
                rms.plot(x, value, color=fs.ABC[p], lw=1.8)
            branch.plot(t[inside], ds["i_fault"].values[inside] * 1e-3, color="#7a3e9d", lw=1.4)
            fs.above(waves, notes.get(name, name), fs.PHASE_INK[1])
            if c == 0:
                waves.set_ylabel("Phase currents [A]")
                rms.set_ylabel("rms, each cycle [A]")
                branch.set_ylabel("Fault branch [kA]")
                fs.abc_legend(waves, "upper left")
            low, high = waves.get_ylim()
            waves.set_ylim(low, high + 0.2 * (high - low))
        said = "Phase a, full coupling (κ = µ); the paper does not state $k_{rf}$. Current of the "
        _note(fig, "fig19_ttsc_currents", said + "branch that bridges the shorted turns below.")
    return fig
