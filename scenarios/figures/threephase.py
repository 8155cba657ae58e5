"""Figures 24 and 25 of the paper: three-phase currents and voltages of a joint run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.results import generators_of, of_generator
from apu_casadi.unit.runsummary import phases
from scenarios.figures import figstyle as fs
from scenarios.figures.chosen import largest
from scenarios.figures.runwords import caption_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SLOW = 0.2  # of a phase's change: where its beginning shows less, all of it is drawn
_CYCLES = 5e-3  # s, two cycles at 400 Hz: a bin of the envelope is never shorter


def envelope(t: np.ndarray, y: np.ndarray, bins: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return bin centres [as t], minima and maxima of ``y`` in ``bins`` equal parts of ``t``.

    Every sample is in a bin, so that no peak is lost; all three have shape (bins',), bins' <= bins.
    """
    bins = max(min(bins, t.size), 1)
    cuts = np.unique(np.linspace(0, t.size, bins + 1).astype(int)[:-1])
    ends = np.append(cuts[1:], t.size) - 1
    return (t[cuts] + t[ends]) / 2, np.minimum.reduceat(y, cuts), np.maximum.reduceat(y, cuts)


def cycle_rms(t: np.ndarray, y: np.ndarray, cycles: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return middle [s] and rms value of every run of full ``cycles`` of ``y``, at any frequency.

    A cycle runs from one rising zero crossing to the next, so that the values do not ripple where
    the exchange step holds no whole number of cycles.  Both have the same shape (n,), n maybe 0.
    """
    k = np.flatnonzero((y[:-1] < 0.0) & (y[1:] >= 0.0))
    if k.size < cycles + 1:
        return np.empty(0), np.empty(0)
    part = -y[k] / (y[k + 1] - y[k])
    zero = t[k] + part * (t[k + 1] - t[k])
    square = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] ** 2 + y[:-1] ** 2) * np.diff(t))])
    until = square[k] + 0.5 * y[k] ** 2 * part * (t[k + 1] - t[k])
    span = zero[cycles:] - zero[:-cycles]
    return zero[:-cycles] + span / 2, np.sqrt((until[cycles:] - until[:-cycles]) / span)


def _waves(
    ax: Axes, ds: xr.Dataset, names: Sequence[str], lo: float, hi: float, origin: float
) -> None:
    """Plot waveforms between two instants [s], in ms from ``origin``."""
    tw = ds["time_w"].values
    a, b = np.searchsorted(tw, (lo - 1e-9, hi + 1e-9))
    for name in names:
        if f"{name}_meas" in ds:
            x, y = (tw[a:b] - origin) * 1e3, ds[f"{name}_meas"].values[a:b]
            ax.plot(x, y, ".", color=fs.ABC[name[-1]], ms=2.6, mew=0, alpha=0.5, zorder=2.5)
        ax.plot(
            (tw[a:b] - origin) * 1e3,
            ds[name].values[a:b],
            color=fs.ABC[name[-1]],
            lw=1.15,
            zorder=3,
        )
    ax.set_xlim((lo - origin) * 1e3, (hi - origin) * 1e3)


def _envelopes(ax: Axes, ds: xr.Dataset, names: Sequence[str]) -> None:
    """Draw the extremes of waveforms over the whole run."""
    tw = ds["time_w"].values
    bins = int(min(1400, max((tw[-1] - tw[0]) / _CYCLES, 1)))
    for name in names:
        p = name[-1]
        x, lo, hi = envelope(tw, ds[name].values, bins)
        ax.fill_between(x, lo, hi, color=fs.MUTED, alpha=0.09, lw=0)
        for edge in (lo, hi):
            ax.plot(x, edge, color=fs.ABC[p], lw=fs.NESTED[p], solid_capstyle="butt")


def _three_phase(
    run: xr.Dataset, key: str, symbol: str, label: str, number: int | None = None
) -> Figure:
    if number is None and len(generators_of(run)) > 1:
        number = 1
    ds = run if number is None else of_generator(run, number)
    names = [f"{symbol}_{p}" for p in "abc"]
    rms = [f"{symbol.upper()}_{p}_rms" for p in "abc"]
    waves = "time_w" in ds.coords
    fs.need(ds, names + rms if waves else rms)
    rows = phases(ds)
    events = largest(ds, rows, rms, 3)
    shown = [0, *events]
    drawn: list[Callable[[Figure, Any], None]] = []
    if waves:
        drawn.append(partial(_steady_row, ds=ds, names=names, rows=rows, shown=shown, label=label))
    if waves and events:
        drawn.append(partial(_event_row, ds=ds, names=names, rows=rows, events=events, label=label))
    if events:
        drawn.append(partial(_rms_row, ds=ds, rms=rms, rows=rows, events=events))
    heights = [2.5] + [1.75] * len(drawn)
    with fs.drawing():
        top, bottom, gap = 0.45, 0.95, 0.72
        fig = fs.new_figure(sum(heights) + gap * len(drawn) + top + bottom)
        place = {"left": 0.088, "right": 0.985, "hspace": gap * len(heights) / sum(heights)}
        place |= fs.margins(fig, top=top, bottom=bottom)
        outer = fig.add_gridspec(len(heights), 1, height_ratios=heights, **place)
        ax = fig.add_subplot(outer[0])
        fs.bands(ax, rows, names=True)
        if waves:
            _envelopes(ax, ds, names)
            ax.set_ylabel(label.replace(" [", " envelope ["))
        else:
            for name, p in zip(rms, "abc", strict=True):
                ax.plot(ds["time"].values, ds[name].values, color=fs.ABC[p], lw=fs.NESTED[p])
            ax.set_ylabel(f"{label}, rms")
        if waves:
            ax.margins(y=0.06)
        else:
            fs.roomy(ax, np.concatenate([ds[name].values for name in rms]), 0.06)
        ax.set_xlabel("Time [s]", labelpad=2)
        fs.abc_legend(ax, "below")
        for row, draw in enumerate(drawn, 1):
            draw(fig, outer[row])
        told = "Envelope: extremes of all samples. Enlarged rms: of each exchange step."
        names_of = ", ".join(f"“{rows[k]['name']}”" for k in events)
        few = f"Enlarged of {len(rows)} phases: {names_of}." if len(rows) > 4 else ""
        dots = fs.MEASURED if f"{names[0]}_meas" in ds else ""
        more = [told, few, dots] if waves else [few]
        caption_of(fig, run, key, " ".join(w for w in more if w), number)
    return fig


def _steady_row(
    fig: Figure,
    spec: Any,
    *,
    ds: xr.Dataset,
    names: Sequence[str],
    rows: Sequence[dict[str, Any]],
    shown: Sequence[int],
    label: str,
) -> None:
    """Draw three cycles at the end of some phases, on one scale."""
    grid = spec.subgridspec(1, len(shown), wspace=0.09)
    first = None
    for i, k in enumerate(shown):
        p = rows[k]
        ax = fig.add_subplot(grid[i], sharey=first)
        first = first or ax
        ax.set_facecolor(fs.phase_colours(k)[0])
        hi = p["end"] - 0.0125
        lo = max(hi - 0.0075, p["start"])
        _waves(ax, ds, names, lo, hi, lo)
        fs.above(
            ax,
            f"{fs.fit(p['name'], 84 // len(shown) - 1, 1)}, from {lo:.3f} s",
            fs.phase_colours(k)[1],
        )
        ax.tick_params(labelleft=i == 0)
        ax.set_xlabel("ms", labelpad=1)
        if i == 0:
            ax.set_ylabel(label)


def _event_row(
    fig: Figure,
    spec: Any,
    *,
    ds: xr.Dataset,
    names: Sequence[str],
    rows: Sequence[dict[str, Any]],
    events: Sequence[int],
    label: str,
) -> None:
    """Draw the waveforms around the beginning of some later phases."""
    from matplotlib.ticker import MultipleLocator

    grid = spec.subgridspec(1, len(events), wspace=0.3)
    for i, k in enumerate(events):
        p = rows[k]
        ax = fig.add_subplot(grid[i])
        ink = fs.phase_colours(k)[1]
        fs.change(ax, -100, 0, 100, k - 1)
        _waves(ax, ds, names, p["start"] - 0.004, p["start"] + 0.008, p["start"])
        ax.margins(y=0.06)
        fs.above(
            ax, f"{fs.fit(p['name'], 84 // len(events) - 6, 1)}: waveforms at {p['start']:g} s", ink
        )
        ax.xaxis.set_major_locator(MultipleLocator(2))
        ax.set_xlabel("ms after the change", labelpad=1)
        if i == 0:
            ax.set_ylabel(label)


def _rms_row(
    fig: Figure,
    spec: Any,
    *,
    ds: xr.Dataset,
    rms: Sequence[str],
    rows: Sequence[dict[str, Any]],
    events: Sequence[int],
) -> None:
    """Draw the rms values around the beginning of some later phases, each on its own scale."""
    grid = spec.subgridspec(1, len(events), wspace=0.3)
    t = ds["time"].values
    for i, k in enumerate(events):
        p = rows[k]
        ax = fig.add_subplot(grid[i])
        ink = fs.phase_colours(k)[1]
        lo, hi = max(p["start"] - 0.2, t[0]), min(p["start"] + 1.6, p["end"])
        moved = [_moved(ds, rms, p["start"], end) for end in (hi, p["end"])]
        hi = p["end"] if moved[0] < _SLOW * moved[1] else hi
        inside = (t >= lo - 1e-9) & (t <= hi + 1e-9)
        fs.change(ax, lo, p["start"], hi, k - 1)
        fs.few_ticks(ax, hi)
        drawn = []
        for name in rms:
            x, y = t[inside], ds[name].values[inside]
            ax.plot(x, y, color=fs.ABC[name[2]], lw=fs.NESTED[name[2]], zorder=3)
            drawn.append(y)
        ax.set_xlim(lo, hi)
        fs.roomy(ax, np.concatenate(drawn), 0.1)
        fs.above(ax, f"{fs.fit(p['name'], 84 // len(events), 1)}: rms, enlarged", ink)
        ax.set_xlabel("Time [s]", labelpad=1)
        if i == 0:
            unit = ds[rms[0]].attrs.get("units", "")
            ax.set_ylabel(f"rms [{unit}]")


def _moved(ds: xr.Dataset, names: Sequence[str], start: float, end: float) -> float:
    """Return the largest change of some quantities between two instants, s."""
    t = ds["time"].values
    inside = (t >= start - 1e-9) & (t <= end + 1e-9)
    return max(float(np.ptp(ds[n].values[inside])) for n in names) if inside.any() else 0.0


def figure_24(ds: xr.Dataset, generator: int | None = None) -> Figure:
    """Draw the phase currents [A]: envelope, steady cycles, events.  Without waveforms: rms only.

    Args:
        ds: the run.
        generator: which of those that differ; default the first.

    Raises:
        DataError: a variable is missing.
    """
    return _three_phase(ds, "fig24_currents", "i", "Current [A]", generator)


def figure_25(ds: xr.Dataset, generator: int | None = None) -> Figure:
    """Draw the phase voltages [V] as :func:`figure_24` draws the currents."""
    return _three_phase(ds, "fig25_voltages", "v", "Voltage [V]", generator)
