"""The paper's Figures 15 to 25 and the figure of the exchange error, drawn from datasets.

Figures are made with the object-oriented interface of matplotlib: no window, no global state, so
that they work in threads, on servers and in notebooks alike.
"""

from __future__ import annotations

import json
import os
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import DataError
from apu_casadi.core.results import RPM, phases
from apu_casadi.gaspath.health import HEALTH_FACTORS
from scenarios.figures.figstyle import drawing, new_figure
from scenarios.figures.runwords import fault_phase, made_with

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 160
_WIDTH = 10.0  # in, 1600 px
_INK, _MUTED, _GRID = "#1f2933", "#5f6b7a", "#e4e7eb"
# Okabe and Ito: told apart in every common kind of colour blindness
_ABC = {"a": "#d55e00", "b": "#0072b2", "c": "#009e73"}
_NESTED = {"a": 3.4, "b": 2.2, "c": 1.0}  # line widths: curves that coincide all stay visible
_CYCLES = 5e-3  # s, two cycles at 400 Hz: a bin of the envelope is never shorter
_BANDS = ("#eef2f7", "#e3ebf5", "#fdf1dd", "#fbe3e0")
_PHASE_INK = ("#33536f", "#1f4e79", "#8a5a00", "#9c2a1c")
_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.edgecolor": _MUTED,
    "axes.labelcolor": _INK,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": _GRID,
    "grid.linewidth": 0.7,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "text.color": _INK,
    "axes.unicode_minus": True,
    "axes.formatter.useoffset": False,
}

FIGURES = {
    "fig20_phases": "Phases of the run: load, gas-path health and stator fault",
    "fig21_speed_power": "Shaft speed and shaft power of the gas generator",
    "fig22_compressor_outlet": "Compressor outlet total temperature and total pressure",
    "fig23_T4_surge_margin": "Combustor outlet total temperature and compressor surge margin",
    "fig24_currents": "Three-phase currents of the starter/generator",
    "fig25_voltages": "Three-phase voltages of the starter/generator",
}
"""File names (without ``.png``) and titles, in the paper's order."""


def _need(ds: xr.Dataset, names: Sequence[str]) -> None:
    missing = [n for n in names if n not in ds]
    if missing:
        raise DataError(f"the dataset lacks {', '.join(missing)}")


def _scenario(ds: xr.Dataset) -> dict[str, Any]:
    try:
        found = json.loads(ds.attrs["scenario"])
    except (KeyError, TypeError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _severity_note(ds: xr.Dataset) -> str:
    """Tell the severity of the last stator fault: always mu, k_rf and kappa together."""
    if not all(n in ds for n in ("mu", "k_rf", "kappa")):
        return ""
    mu = ds["mu"].values
    hit = np.flatnonzero(mu > 0)
    if hit.size == 0:
        return ""
    k = hit[-1]
    m, r, c = (float(ds[n].values[k]) for n in ("mu", "k_rf", "kappa"))
    kappa = f"κ = µ = {c:g}" if abs(c - m) < 1e-12 else f"κ = {c:g}"
    where = fault_phase(ds, float(ds["time"].values[k]))
    return f"TTSC{where}: µ = {100 * m:g} %, $k_{{rf}}$ = {r:g}, {kappa}."


def _caption(fig: Figure, ds: xr.Dataset, key: str, more: str = "") -> None:
    number = key[3:5]
    name = _scenario(ds).get("name", "")
    words = [f"Figure {number}. {FIGURES[key]}."]
    if name:
        words.append(f"Scenario “{name}”.")
    if key != "fig20_phases":
        words.append(_severity_note(ds))
    words += [more, made_with(ds)]
    text = textwrap.fill(" ".join(w for w in words if w), 160)
    fig.text(0.012, 0.10 / fig.get_figheight(), text, fontsize=8.2, color=_MUTED, va="bottom")


def _margins(fig: Figure, *, top: float = 0.18, bottom: float = 0.98) -> dict[str, float]:
    """Return margins given in inches as fractions of the figure."""
    h = fig.get_figheight()
    return {"top": 1.0 - top / h, "bottom": bottom / h}


def _colour(k: int) -> tuple[str, str]:
    return _BANDS[k % len(_BANDS)], _PHASE_INK[k % len(_PHASE_INK)]


def _fit(text: str, letters: int, lines: int = 2) -> str:
    """Break a text into a few short lines at its spaces; cut it where that is not enough."""
    broken = textwrap.wrap(text, max(letters, 1), break_long_words=False, break_on_hyphens=False)
    if len(broken) <= lines and all(len(line) <= letters for line in broken):
        return "\n".join(broken)
    return text if len(text) <= letters else text[: max(letters - 1, 0)].rstrip() + "…"


def _bands(ax: Axes, rows: Sequence[dict[str, Any]], *, names: bool) -> None:
    """Shade the phases, mark their boundaries, and name them above the axes."""
    lo, hi = rows[0]["start"], rows[-1]["end"]
    width = ax.get_position().width * _WIDTH
    for k, p in enumerate(rows):
        band, ink = _colour(k)
        ax.axvspan(p["start"], p["end"], color=band, lw=0, zorder=0)
        if k:
            ax.axvline(p["start"], color=ink, lw=1.0, ls=(0, (4, 2)), zorder=1.5)
        if names:
            inches = width * (p["end"] - p["start"]) / (hi - lo)
            letters = max(int(inches / 0.088), 1)
            ax.annotate(
                _fit(p["name"], letters),
                ((p["start"] + p["end"]) / 2, 1.0),
                xycoords=("data", "axes fraction"),
                xytext=(0, 5),
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=8.8,
                color=ink,
                fontweight="bold",
            )
    ax.set_xlim(lo, hi)


def _roomy(ax: Axes, y: np.ndarray, margin: float) -> None:
    """Leave room around a curve; a constant is not blown up to its rounding errors."""
    lo, hi = float(np.nanmin(y)), float(np.nanmax(y))
    least = 1e-4 * max(abs(lo), abs(hi), 1e-12)
    room = margin * (hi - lo) + max(0.0, (least - (hi - lo)) / 2)
    ax.set_ylim(lo - room, hi + room)


def _quietest(rows: Sequence[dict[str, Any]], t: np.ndarray, y: np.ndarray) -> int | None:
    """Return the phase whose beginning moves ``y`` least, but visibly: it wants an enlargement."""
    best, least = None, np.inf
    whole = float(np.ptp(y))
    for k, p in enumerate(rows[1:], 1):
        inside = y[(t >= p["start"] - 0.1) & (t <= min(p["end"], p["start"] + 2.5))]
        move = float(np.ptp(inside)) if inside.size else 0.0
        if max(1e-3 * whole, 1e-5 * float(np.abs(y).max())) < move < least:
            best, least = k, move
    return best


def _trend(
    ds: xr.Dataset, key: str, curves: Sequence[tuple[str, str, float, float, str]]
) -> Figure:
    """Draw quantities (name, label, scale, offset, colour) over time, each with an enlargement."""

    _need(ds, [c[0] for c in curves])
    rows = phases(ds)
    t = ds["time"].values
    with drawing(_STYLE):
        fig = new_figure(6.3)
        data = [ds[name].values * scale + offset for name, _, scale, offset, _ in curves]
        enlarged = [_quietest(rows, t, y) for y in data]
        two = any(k is not None for k in enlarged)
        grid = fig.add_gridspec(
            len(curves),
            2 if two else 1,
            width_ratios=[3.1, 1.0] if two else None,
            left=0.085, right=0.985, hspace=0.27, wspace=0.2, **_margins(fig, top=0.55, bottom=0.9),
        )  # fmt: skip
        for r, (y, k, (_, label, _, _, colour)) in enumerate(
            zip(data, enlarged, curves, strict=True)
        ):
            last = r == len(curves) - 1
            ax = fig.add_subplot(grid[r, 0])
            _bands(ax, rows, names=r == 0)
            ax.plot(t, y, color=colour, lw=1.7, solid_joinstyle="round")
            ax.set_ylabel(label)
            _roomy(ax, y, 0.08)
            ax.tick_params(labelbottom=last)
            if last:
                ax.set_xlabel("Time [s]")
            if k is None:
                continue
            side = fig.add_subplot(grid[r, 1])
            p = rows[k]
            lo, hi = p["start"] - 0.25, min(p["end"], p["start"] + 2.5)
            inside = (t >= lo) & (t <= hi)
            side.axvspan(lo, p["start"], color=_colour(k - 1)[0], lw=0, zorder=0)
            side.axvspan(p["start"], hi, color=_colour(k)[0], lw=0, zorder=0)
            side.axvline(p["start"], color=_colour(k)[1], lw=1.0, ls=(0, (4, 2)), zorder=1.5)
            side.plot(t[inside], y[inside], color=colour, lw=1.7)
            side.set_xlim(lo, hi)
            _roomy(side, y[inside], 0.1)
            side.annotate(
                _fit(f"enlarged: {p['name']}", 30),
                (0.5, 1.0), xycoords="axes fraction", xytext=(0, 5), textcoords="offset points",
                ha="center", va="bottom", fontsize=8.2, color=_colour(k)[1],
            )  # fmt: skip
            if last:
                side.set_xlabel("Time [s]")
        _caption(fig, ds, key)
    return fig


def figure_21(ds: xr.Dataset) -> Figure:
    """Draw shaft speed [r/min] and shaft power [kW]; DataError if a variable is missing."""
    return _trend(
        ds,
        "fig21_speed_power",
        [
            ("N", "Shaft speed [r/min]", RPM, 0.0, "#0b5394"),
            ("PW", "Shaft power [kW]", 1e-3, 0.0, "#b45309"),
        ],
    )


def figure_22(ds: xr.Dataset) -> Figure:
    """Draw T3 [K] and P3 [kPa]; DataError if a variable is missing."""
    return _trend(
        ds,
        "fig22_compressor_outlet",
        [
            ("T3", "$T_3$ [K]", 1.0, 0.0, "#b91c1c"),
            ("P3", "$P_3$ [kPa]", 1e-3, 0.0, "#0b5394"),
        ],
    )


def figure_23(ds: xr.Dataset) -> Figure:
    """Draw T4 [K] and the surge margin [%]; DataError if a variable is missing."""
    return _trend(
        ds,
        "fig23_T4_surge_margin",
        [
            ("T4", "$T_4$ [K]", 1.0, 0.0, "#b91c1c"),
            ("SM", "Surge margin [%]", 100.0, 0.0, "#0f766e"),
        ],
    )


def _segments(
    t: np.ndarray, table: np.ndarray, rows: Sequence[dict[str, Any]]
) -> list[tuple[float, float, int]]:
    """Return (start, end, index) of the stretches over which the rows of ``table`` are constant.

    A change one sample off the beginning of a phase is drawn there.
    """
    same = np.all((table[1:] == table[:-1]) | (np.isnan(table[1:]) & np.isnan(table[:-1])), axis=1)
    cuts = [0, *(np.flatnonzero(~same) + 1).tolist()]
    ends = [*cuts[1:], t.size - 1]
    starts = np.array([p["start"] for p in rows])
    slack = 1.5 * float(np.median(np.diff(t)))

    def instant(i: int) -> float:
        near = starts[int(np.argmin(np.abs(starts - t[i])))]
        return float(near if abs(near - t[i]) <= slack else t[i])

    return [(instant(a), instant(b), a) for a, b in zip(cuts, ends, strict=True) if b > a]


def _load_lane(ds: xr.Dataset, rows: Sequence[dict[str, Any]]) -> list[tuple[float, float, str]]:
    """Return (start, end, words) of the loads, from the scenario or else from the mean power."""
    table = _scenario(ds)
    steps = [(p.get("start"), p.get("load")) for p in table.get("phase", ())]
    steps += [(e.get("time"), e.get("load")) for e in table.get("event", ())]
    loads = sorted(((float(s), x) for s, x in steps if isinstance(x, dict)), key=lambda s: s[0])
    t_end = rows[-1]["end"]
    loads = [x for x in loads if x[0] < t_end]
    if loads:
        ends = [s for s, _ in loads[1:]] + [t_end]
        return [(s, e, _load_words(x)) for (s, x), e in zip(loads, ends, strict=True)]
    t, P = ds["time"].values, ds["P_e"].values
    lane = []
    for p in rows:
        tail = (t > p["end"] - 0.25 * (p["end"] - p["start"])) & (t <= p["end"])
        lane.append((p["start"], p["end"], f"{np.mean(P[tail]) / 1e3:.0f} kW electric"))
    return lane


def _load_words(x: dict[str, Any]) -> str:
    kind = x.get("kind", "")
    words = {
        "R": "resistive",
        "RL": f"R-L, pf {x.get('power_factor', 0.85):g}",
        "series": "series R-L",
        "constant_power": "constant power",
        "open": "open circuit",
    }.get(kind, str(kind))
    if x.get("unbalance") and len(set(x["unbalance"])) > 1:
        words += ", unbalanced"
    return f"2\u00a0×\u00a0{x['power_kW']:g}\u00a0kW\n{words}" if "power_kW" in x else words


def figure_20(ds: xr.Dataset) -> Figure:
    """Draw the phases of the run: load, health of the gas path and state of the stator over time.

    Raises:
        DataError: a variable is missing.
    """

    factors = {n: f.symbol for n, f in HEALTH_FACTORS.items()}
    _need(ds, [*factors, "mu", "k_rf", "kappa", "P_e"])
    rows = phases(ds)
    t = ds["time"].values
    healthy, hurt = ("#d8efe3", "#14532d"), ("#f8cfc8", "#7f1d1d")
    lanes: list[tuple[str, list[tuple[float, float, str, tuple[str, str]]]]] = []
    loads = _load_lane(ds, rows)
    tints = (("#bfd7ee", "#0b3c66"), ("#dbe8f5", "#0b3c66"))
    lanes.append(
        ("Electrical load", [(a, b, w, tints[i % 2]) for i, (a, b, w) in enumerate(loads)])
    )
    gas = np.column_stack([ds[f].values for f in factors])
    cells = []
    for a, b, i in _segments(t, gas, rows):
        off = [
            f"{s} {100 * (v - 1):+.3g} %".replace(" -", " −").replace(" ", "\u00a0")
            for s, v in zip(factors.values(), gas[i], strict=True)
            if v != 1.0
        ]
        words = "healthy" if not off else ", ".join(off[:2]) + "\n" + ", ".join(off[2:])
        cells.append((a, b, words.strip(), hurt if off else healthy))
    lanes.append(("Gas path", cells))
    stator = np.column_stack([ds[f].values for f in ("mu", "k_rf", "kappa")])
    cells = []
    for a, b, i in _segments(t, stator, rows):
        m, r, c = stator[i]
        kappa = "κ = µ" if abs(c - m) < 1e-12 else f"κ = {c:g}"
        words = "healthy"
        if m > 0:
            parts = f"µ = {100 * m:g} %", f"$k_{{rf}}$ = {r:g}", kappa
            first, second, third = (x.replace(" ", "\u00a0") for x in parts)
            words = f"TTSC {first}\n{second}, {third}"
        cells.append((a, b, words, hurt if m > 0 else healthy))
    lanes.append(("Stator", cells))
    with drawing(_STYLE):
        fig = new_figure(3.7)
        ax = fig.add_axes((0.125, 0.0, 0.86, 1.0))
        m = _margins(fig, top=0.45, bottom=0.8)
        ax.set_position((0.125, m["bottom"], 0.86, m["top"] - m["bottom"]))
        _bands(ax, rows, names=True)
        span = rows[-1]["end"] - rows[0]["start"]
        per_letter = 0.075 * span / (0.86 * _WIDTH)
        for y, (_, items) in enumerate(lanes):
            for a, b, words, (fill, ink) in items:
                ax.barh(
                    y, b - a, left=a, height=0.7, color=fill, edgecolor="white", lw=1.6, zorder=2
                )
                letters = max(int((b - a) / per_letter) - 1, 1)
                text = "\n".join(
                    line
                    for part in words.split("\n")
                    for line in textwrap.wrap(part, letters + 2 * part.count("$"))
                )
                lines = text.split("\n")
                longest = max(len(line) - 5 * (line.count("$") // 2) for line in lines)
                size = 8.8 if len(lines) < 4 and longest <= letters else 7.0
                if longest <= 1.3 * letters and len(lines) < 6:
                    ax.text((a + b) / 2, y, text, ha="center", va="center", color=ink,
                            fontsize=size, linespacing=1.25)  # fmt: skip
        ax.set_yticks(range(len(lanes)), [n for n, _ in lanes], fontsize=9.5)
        ax.set_ylim(len(lanes) - 0.5, -0.5)
        ax.grid(False)
        ax.tick_params(axis="y", length=0)
        ax.spines["left"].set_visible(False)
        ax.set_xlabel("Time [s]")
        _caption(fig, ds, "fig20_phases", "Load of each of the two generators at rated voltage.")
    return fig


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
        ax.plot(
            (tw[a:b] - origin) * 1e3, ds[name].values[a:b], color=_ABC[name[-1]], lw=1.15, zorder=3
        )
    ax.set_xlim((lo - origin) * 1e3, (hi - origin) * 1e3)


def _three_phase(ds: xr.Dataset, key: str, symbol: str, label: str, short: str) -> Figure:

    names = [f"{symbol}_{p}" for p in "abc"]
    rms = [f"{symbol.upper()}_{p}_rms" for p in "abc"]
    waves = "time_w" in ds.coords
    _need(ds, names + rms if waves else rms)
    rows = phases(ds)
    t = ds["time"].values
    shown = rows[:4]
    events = rows[1:4]
    n_rows = 1 + (2 if waves else 0) + (1 if events else 0) - (1 if waves and not events else 0)
    heights = [2.5] + [1.75] * (n_rows - 1)
    with drawing(_STYLE):
        top, bottom, gap = 0.45, 0.95, 0.72
        fig = new_figure(sum(heights) + gap * (n_rows - 1) + top + bottom)
        mean = sum(heights) / n_rows
        outer = fig.add_gridspec(
            n_rows, 1, left=0.08, right=0.985, hspace=gap / mean, height_ratios=heights,
            **_margins(fig, top=top, bottom=bottom),
        )  # fmt: skip
        ax = fig.add_subplot(outer[0])
        _bands(ax, rows, names=True)
        if waves:
            tw = ds["time_w"].values
            bins = int(min(1400, max((tw[-1] - tw[0]) / _CYCLES, 1)))
            for name, p in zip(names, "abc", strict=True):
                x, lo, hi = envelope(tw, ds[name].values, bins)
                ax.fill_between(x, lo, hi, color=_MUTED, alpha=0.09, lw=0)
                for edge in (lo, hi):
                    ax.plot(x, edge, color=_ABC[p], lw=_NESTED[p], solid_capstyle="butt")
            ax.set_ylabel(label.replace(" [", " envelope ["))
        else:
            for name, p in zip(rms, "abc", strict=True):
                ax.plot(t, ds[name].values, color=_ABC[p], lw=_NESTED[p])
            ax.set_ylabel(f"{label}, rms")
        ax.margins(y=0.06)
        ax.set_xlabel("Time [s]", labelpad=2)
        _legend(ax, "center right" if waves else "best")
        row = 1
        if waves:
            _steady_row(fig, outer[row], ds, names, shown, short)
            row += 1
            if events:
                _event_row(fig, outer[row], ds, names, events, rows, short)
                row += 1
        if events:
            _rms_row(fig, outer[row], ds, rms, events, rows, short)
        more = (
            "Envelope: extremes of all samples. Enlarged rms: of each exchange step. "
            if waves
            else ""
        )
        more += "" if len(rows) <= 4 else "First four phases enlarged."
        _caption(fig, ds, key, more.strip())
    return fig


def _legend(ax: Axes, where: str) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=_ABC[p], lw=2.2, label=f"phase {p}") for p in "abc"]
    ax.legend(
        handles=handles, loc=where, ncols=3, fontsize=8.5,
        frameon=True, framealpha=0.9, edgecolor="none", handlelength=1.4, columnspacing=1.1,
        borderpad=0.3,
    )  # fmt: skip


def _title(ax: Axes, text: str, ink: str) -> None:
    ax.annotate(
        text, (0.5, 1.0), xycoords="axes fraction", xytext=(0, 4), textcoords="offset points",
        ha="center", va="bottom", fontsize=8.4, color=ink,
    )  # fmt: skip


def _steady_row(
    fig: Figure, spec: Any, ds: xr.Dataset, names: Sequence[str], shown: Any, short: str
) -> None:
    """Draw three cycles at the end of every phase, on one scale."""
    grid = spec.subgridspec(1, len(shown), wspace=0.09)
    first = None
    for k, p in enumerate(shown):
        ax = fig.add_subplot(grid[k], sharey=first)
        first = first or ax
        ax.set_facecolor(_colour(k)[0])
        hi = p["end"] - 0.0125
        lo = max(hi - 0.0075, p["start"])
        _waves(ax, ds, names, lo, hi, lo)
        _title(ax, f"{_fit(p['name'], 84 // len(shown) - 1, 1)}, from {lo:.3f} s", _colour(k)[1])
        ax.tick_params(labelleft=k == 0)
        ax.set_xlabel("ms", labelpad=1)
        if k == 0:
            ax.set_ylabel(short)


def _event_row(
    fig: Figure, spec: Any, ds: xr.Dataset, names: Sequence[str], events: Any, rows: Any, short: str
) -> None:
    """Draw the waveforms around the beginning of every later phase."""
    from matplotlib.ticker import MultipleLocator

    grid = spec.subgridspec(1, len(events), wspace=0.23)
    for k, p in enumerate(events):
        ax = fig.add_subplot(grid[k])
        ink = _colour(k + 1)[1]
        ax.axvspan(-100, 0, color=_colour(k)[0], lw=0, zorder=0)
        ax.axvspan(0, 100, color=_colour(k + 1)[0], lw=0, zorder=0)
        ax.axvline(0, color=ink, lw=1.0, ls=(0, (4, 2)), zorder=1.5)
        _waves(ax, ds, names, p["start"] - 0.004, p["start"] + 0.008, p["start"])
        ax.margins(y=0.06)
        _title(
            ax, f"{_fit(p['name'], 84 // len(events) - 6, 1)}: waveforms at {p['start']:g} s", ink
        )
        ax.xaxis.set_major_locator(MultipleLocator(2))
        ax.set_xlabel("ms after the change", labelpad=1)
        if k == 0:
            ax.set_ylabel(short)


def _rms_row(
    fig: Figure, spec: Any, ds: xr.Dataset, rms: Sequence[str], events: Any, rows: Any, short: str
) -> None:
    """Draw the rms values around the beginning of every later phase, each on its own scale."""
    grid = spec.subgridspec(1, len(events), wspace=0.23)
    t = ds["time"].values
    for k, p in enumerate(events):
        ax = fig.add_subplot(grid[k])
        ink = _colour(k + 1)[1]
        lo, hi = max(p["start"] - 0.2, t[0]), min(p["start"] + 1.6, p["end"])
        inside = (t >= lo - 1e-9) & (t <= hi + 1e-9)
        ax.axvspan(lo, p["start"], color=_colour(k)[0], lw=0, zorder=0)
        ax.axvspan(p["start"], hi, color=_colour(k + 1)[0], lw=0, zorder=0)
        ax.axvline(p["start"], color=ink, lw=1.0, ls=(0, (4, 2)), zorder=1.5)
        drawn = []
        for name in rms:
            x, y = t[inside], ds[name].values[inside]
            ax.plot(x, y, color=_ABC[name[2]], lw=_NESTED[name[2]], zorder=3)
            drawn.append(y)
        ax.set_xlim(lo, hi)
        _roomy(ax, np.concatenate(drawn), 0.1)
        _title(ax, f"{_fit(p['name'], 84 // len(events), 1)}: rms, enlarged", ink)
        ax.set_xlabel("Time [s]", labelpad=1)
        if k == 0:
            unit = ds[rms[0]].attrs.get("units", "")
            ax.set_ylabel(f"rms [{unit}]")


def figure_24(ds: xr.Dataset) -> Figure:
    """Draw the phase currents [A]: envelope, steady cycles, events.  Without waveforms: rms only.

    Raises:
        DataError: a variable is missing.
    """
    return _three_phase(ds, "fig24_currents", "i", "Current [A]", "Current [A]")


def figure_25(ds: xr.Dataset) -> Figure:
    """Draw the phase voltages [V] as :func:`figure_24` draws the currents."""
    return _three_phase(ds, "fig25_voltages", "v", "Voltage [V]", "Voltage [V]")


_DRAW = {
    "fig20_phases": figure_20,
    "fig21_speed_power": figure_21,
    "fig22_compressor_outlet": figure_22,
    "fig23_T4_surge_margin": figure_23,
    "fig24_currents": figure_24,
    "fig25_voltages": figure_25,
}


def save_figures(ds: xr.Dataset, folder: str | os.PathLike[str]) -> list[Path]:
    """Write Figures 20 to 25 as PNG, 1600 px wide, into an existing folder; return the paths.

    Raises:
        DataError: a variable is missing, or a file cannot be written.
    """
    made = []
    for key, draw in _DRAW.items():
        path = Path(folder) / f"{key}.png"
        made.append(files.save_figure(draw(ds), path, dpi=DPI))
    return made


_CASE_INK = ("#0b5394", "#b45309", "#0f766e", "#7a3e9d")
_MARKS = ("o", "s", "^", "D")


def figure_exchange_error(
    curves: Mapping[tuple[str, str], tuple[np.ndarray, Mapping[str, np.ndarray]]],
    quantities: Mapping[str, str],
    *,
    mark: float = 0.020,
) -> Figure:
    """Draw errors over the exchange step, one logarithmic panel for each quantity.

    Args:
        curves: by (case, exchange), steps [s] and errors by quantity, arrays of one shape (n,).
        quantities: panels, by name with their title; four at most.
        mark: step [s] that is marked: the paper's.
    """
    from matplotlib.lines import Line2D
    from matplotlib.ticker import FixedLocator, NullLocator

    cases = list(dict.fromkeys(case for case, _ in curves))
    exchanges = list(dict.fromkeys(ex for _, ex in curves))
    dash = dict(zip(exchanges, ("-", (0, (4, 2)), (0, (1, 1.5))), strict=False))
    steps = np.unique(np.concatenate([dt for dt, _ in curves.values()]))
    with drawing(_STYLE):
        fig = new_figure(7.4)
        grid = fig.add_gridspec(
            2, 2, left=0.085, right=0.985, hspace=0.3, wspace=0.2,
            **_margins(fig, top=0.65, bottom=0.85),
        )  # fmt: skip
        for k, (q, title) in enumerate(quantities.items()):
            ax = fig.add_subplot(grid[k // 2, k % 2])
            for (case, ex), (dt, errors) in curves.items():
                c = cases.index(case)
                ax.loglog(
                    1e3 * dt, errors[q], color=_CASE_INK[c], ls=dash[ex], marker=_MARKS[c], ms=4.5,
                    mfc=_CASE_INK[c] if ex == exchanges[0] else "white", lw=1.5,
                )  # fmt: skip
            every = np.concatenate([errors[q] for _, errors in curves.values()])
            _slopes(ax, steps, every)
            ax.axvline(1e3 * mark, color=_MUTED, lw=0.9, zorder=0.5)
            ax.xaxis.set_major_locator(FixedLocator(list(1e3 * steps)))
            ax.xaxis.set_minor_locator(NullLocator())
            ax.set_xticklabels([f"{1e3 * s:g}" for s in steps])
            ax.set_xlim(1e3 * steps[0] / 1.25, 1e3 * steps[-1] * 1.25)
            ax.set_ylim(every.min() / 2, every.max() * 2)
            _title(ax, title[0].upper() + title[1:], _INK)
            if k % 2 == 0:
                ax.set_ylabel("Largest relative error")
            if k >= len(quantities) - 2:
                ax.set_xlabel("Exchange step [ms]")
        handles = [
            Line2D([], [], color=_CASE_INK[k], marker=_MARKS[k], ms=4.5, lw=1.5, label=case)
            for k, case in enumerate(cases)
        ] + [
            Line2D([], [], color=_INK, ls=dash[ex], marker="o", ms=4.5, lw=1.5,
                   mfc=_INK if ex == exchanges[0] else "white", label=f"exchange “{ex}”")
            for ex in exchanges
        ]  # fmt: skip
        fig.legend(
            handles=handles, loc="upper center", ncols=len(handles), frameon=False, fontsize=8.8,
            bbox_to_anchor=(0.53, 1.0), columnspacing=1.2, handlelength=2.4,
        )  # fmt: skip
        text = (
            "Error of the multi-rate exchange against the unit as one model with one solver. "
            "Grey: slopes 1 and 2. Vertical line: the paper's 20 ms."
        )
        fig.text(0.012, 0.10 / fig.get_figheight(), textwrap.fill(text, 160), fontsize=8.2,
                 color=_MUTED, va="bottom")  # fmt: skip
    return fig


def _slopes(ax: Axes, steps: np.ndarray, errors: np.ndarray) -> None:
    """Draw guides of first and second order through the upper right corner's reach."""
    x = np.array([steps[0], steps[-1]])
    top = float(errors.max())
    for order, factor in ((1, 1.7), (2, 0.12)):
        ax.plot(
            1e3 * x, factor * top * (x / x[-1]) ** order, color="#b8c0cc", lw=3.2, zorder=0.8,
            solid_capstyle="butt",
        )  # fmt: skip


# ------------------------------------------------------------------ module by module: 15 to 19

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
    text = textwrap.fill(f"Figure {key[3:5]}. {MODULE_FIGURES[key]}. {more}", 160)
    fig.text(0.012, 0.10 / fig.get_figheight(), text, fontsize=8.2, color=_MUTED, va="bottom")


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
    from matplotlib.lines import Line2D

    panels = _GAS_PANELS[key]
    for ds in (*runs, *checks):
        _need(ds, [p[0] for p in panels])
    inks = ("#0b5394", "#b45309")
    t_end = float(runs[0]["time"][-1])
    rows = [
        {"name": "degraded gas path, 230 kW", "start": 0.0, "end": t_step},
        {"name": "fuel flow +10 %, load proportional to speed cubed", "start": t_step,
         "end": t_end},
    ]  # fmt: skip
    with drawing(_STYLE):
        fig = new_figure(6.3)
        grid = fig.add_gridspec(
            len(panels), 1, left=0.085, right=0.985, hspace=0.14,
            **_margins(fig, top=0.45, bottom=1.0),
        )  # fmt: skip
        for r, (name, label, scale) in enumerate(panels):
            ax = fig.add_subplot(grid[r])
            _bands(ax, rows, names=r == 0)
            every = []
            for ds, check, ink in zip(runs, checks, inks, strict=False):
                t, y = ds["time"].values, ds[name].values * scale
                ax.plot(t, y, color=ink, lw=1.7, solid_joinstyle="round")
                some = slice(None, None, max(t.size // 40, 1))
                ax.plot(check["time"].values[some], check[name].values[some] * scale, "o", ms=3.6,
                        mfc="white", mec=ink, mew=1.0)  # fmt: skip
                every.append(y)
            _roomy(ax, np.concatenate(every), 0.1)
            ax.set_ylabel(label)
            ax.tick_params(labelbottom=r == len(panels) - 1)
            if r == 0:
                handles = [
                    Line2D([], [], color=ink, lw=1.7,
                           label=f"turbine flow factor {float(ds.attrs['f_W_t']):g}")
                    for ds, ink in zip(runs, inks, strict=False)
                ]  # fmt: skip
                handles.append(Line2D([], [], color=_INK, marker="o", ls="", ms=3.6, mfc="white",
                                      label="continuous model, CVODES"))  # fmt: skip
                ax.legend(handles=handles, loc="lower right", fontsize=8.5, frameon=True,
                          framealpha=0.9, edgecolor="none")  # fmt: skip
        ax.set_xlabel("Time [s]")
        _note(
            fig,
            key,
            "Efficiency of compressor −1 %, of turbine −2 %, compressor flow −3 %; the paper's "
            "“4 % turbine flow degradation” with either sign. Lines: 20 ms step of (12).",
        )
    return fig


def _ms(ax: Axes, ds: xr.Dataset, origin: float, lo: float, hi: float, *, xlabel: bool) -> None:
    ax.axvspan(lo, 0, color=_BANDS[0], lw=0, zorder=0)
    ax.axvspan(0, hi, color=_BANDS[1], lw=0, zorder=0)
    ax.axvline(0, color=_PHASE_INK[1], lw=1.0, ls=(0, (4, 2)), zorder=1.5)
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
        _need(data, names)
    t = (ds["time"].values - origin) * 1e3
    tc = (check["time"].values - origin) * 1e3
    apart = max(
        float(np.abs(ds[n].values - np.interp(t, tc, check[n].values))[np.abs(t) > 0.5].max()
              / np.abs(ds[n].values).max()) for n in names
    )  # fmt: skip
    with drawing(_STYLE):
        fig = new_figure(6.6)
        grid = fig.add_gridspec(
            2, 2, width_ratios=[1.7, 1.0], left=0.08, right=0.985, hspace=0.26, wspace=0.2,
            **_margins(fig, top=0.5, bottom=0.95),
        )  # fmt: skip
        for r, (q, label) in enumerate(quantities.items()):
            left, right = fig.add_subplot(grid[r, 0]), fig.add_subplot(grid[r, 1])
            _ms(left, ds, origin, -4, 10, xlabel=r == 1)
            _ms(right, ds, origin, -10, float(t[-1]), xlabel=r == 1)
            for p in "abc":
                y = ds[f"{q}_{p}"].values
                left.plot(t, y, color=_ABC[p], lw=1.2)
                some = np.flatnonzero((tc >= -4) & (tc <= 10))[::8]
                left.plot(tc[some], check[f"{q}_{p}"].values[some], "o", ms=2.6, mfc="white",
                          mec=_ABC[p], mew=0.8)  # fmt: skip
                x, rms = cycle_rms(t, y)
                right.plot(x, rms, color=_ABC[p], lw=_NESTED[p])
            left.set_ylabel(label)
            right.set_ylabel(label.replace(" [", " rms ["))
            if r == 0:
                _title(left, "waveforms; dots: second solver", _PHASE_INK[1])
                _title(right, "rms over each cycle", _PHASE_INK[1])
                _legend(left, "upper left")
                low, high = left.get_ylim()
                left.set_ylim(low, high + 0.22 * (high - low))
        _note(fig, "fig18_healthy_transient",
              f"From 100 kW to 225 kW. CVODES and IDAS differ by at most {apart:.0e} of the peak, "
              "from 0.5 ms after the step.")  # fmt: skip
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
        _need(ds, ["i_a", "i_b", "i_c", "i_fault"])
    with drawing(_STYLE):
        fig = new_figure(7.8)
        grid = fig.add_gridspec(
            3, len(runs), height_ratios=[1.5, 1, 1], left=0.08, right=0.985, hspace=0.32,
            wspace=0.17, **_margins(fig, top=0.5, bottom=0.95),
        )  # fmt: skip
        for c, (name, ds) in enumerate(runs.items()):
            t = (ds["time"].values - origin) * 1e3
            waves, rms, branch = (fig.add_subplot(grid[r, c]) for r in range(3))
            _ms(waves, ds, origin, -4, 10, xlabel=False)
            _ms(rms, ds, origin, -10, float(t[-1]), xlabel=False)
            _ms(branch, ds, origin, -4, 10, xlabel=True)
            inside = (t >= -4) & (t <= 10)
            for p in "abc":
                y = ds[f"i_{p}"].values
                waves.plot(t[inside], y[inside], color=_ABC[p], lw=1.3)
                x, value = cycle_rms(t, y)
                rms.plot(x, value, color=_ABC[p], lw=1.8)
            branch.plot(t[inside], ds["i_fault"].values[inside] * 1e-3, color="#7a3e9d", lw=1.4)
            _title(waves, notes.get(name, name), _PHASE_INK[1])
            if c == 0:
                waves.set_ylabel("Phase currents [A]")
                rms.set_ylabel("rms, each cycle [A]")
                branch.set_ylabel("Fault branch [kA]")
                _legend(waves, "upper left")
            low, high = waves.get_ylim()
            waves.set_ylim(low, high + 0.2 * (high - low))
        _note(fig, "fig19_ttsc_currents",
              "Phase a, full coupling (κ = µ); the paper does not state $k_{rf}$. Current of the "
              "branch that bridges the shorted turns below.")  # fmt: skip
    return fig
