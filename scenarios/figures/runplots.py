"""Figures 20 to 23 of the paper: phases of a joint run, speed and power, T3 and P3, T4 and SM."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.results import generators_of, of_generator
from apu_casadi.core.units import RPM
from apu_casadi.gaspath.health import HEALTH_FACTORS
from apu_casadi.unit.runsummary import phases, severity_h
from scenarios.figures import figstyle as fs
from scenarios.figures.chosen import quietest
from scenarios.figures.runwords import SEVERITY, caption_of, fault_phase, scenario_of, severity_note

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HOT = "#b91c1c"
HEALTHY, HURT = ("#d8efe3", "#14532d"), ("#f8cfc8", "#7f1d1d")  # ground and ink
LOADS = (("#bfd7ee", "#0b3c66"), ("#dbe8f5", "#0b3c66"))
Lane = list[tuple[float, float, str, tuple[str, str]]]
"""Stretches of a lane: start, end, words, ground and ink."""


def _trend(ds: xr.Dataset, key: str, curves: Sequence[tuple[str, str, float, str]]) -> Figure:
    """Draw quantities (name, label, scale, colour) over time, each with an enlargement.

    What noisy sensors read of them stands behind as dots.
    """
    fs.need(ds, [c[0] for c in curves])
    rows = phases(ds)
    t = ds["time"].values
    with fs.drawing():
        fig = fs.new_figure(6.3)
        data = [ds[name].values * scale for name, _, scale, _ in curves]
        read = [ds[n].values * c[2] if (n := f"{c[0]}_meas") in ds else None for c in curves]
        enlarged = [quietest(ds, rows, y) for y in data]
        two = any(k is not None for k in enlarged)
        widths = [3.1, 1.0] if two else [1.0]
        place = {"left": 0.085, "right": 0.985, "hspace": 0.27, "wspace": 0.2}
        place |= fs.margins(fig, top=0.55, bottom=0.9)
        grid = fig.add_gridspec(len(curves), len(widths), width_ratios=widths, **place)
        for r, (y, m, k, (_, label, _, colour)) in enumerate(
            zip(data, read, enlarged, curves, strict=True)
        ):
            last = r == len(curves) - 1
            ax = fig.add_subplot(grid[r, 0])
            fs.bands(ax, rows, names=r == 0)
            fs.measured(ax, t, m)
            ax.plot(t, y, color=colour, lw=1.7, solid_joinstyle="round")
            ax.set_ylabel(label)
            fs.roomy(ax, y if m is None else np.concatenate([y, m]), 0.08)
            ax.tick_params(labelbottom=last)
            if last:
                ax.set_xlabel("Time [s]")
            if k is None:
                continue
            side = fig.add_subplot(grid[r, 1])
            p = rows[k]
            lo, hi = p["start"] - 0.25, min(p["end"], p["start"] + 2.5)
            inside = (t >= lo) & (t <= hi)
            fs.change(side, lo, p["start"], hi, k - 1)
            fs.few_ticks(side, hi, 4)
            fs.measured(side, t[inside], None if m is None else m[inside])
            side.plot(t[inside], y[inside], color=colour, lw=1.7)
            side.set_xlim(lo, hi)
            fs.roomy(side, y[inside], 0.1)
            fs.above(side, fs.fit(f"enlarged: {p['name']}", 30), fs.phase_colours(k)[1])
            if last:
                side.set_xlabel("Time [s]")
        fig.align_ylabels(fig.axes[:: len(widths)])
        caption_of(fig, ds, key, "" if all(m is None for m in read) else fs.MEASURED)
    return fig


def figure_21(ds: xr.Dataset) -> Figure:
    """Draw shaft speed [r/min] and shaft power [kW]; DataError if a variable is missing."""
    speed = ("N", "Shaft speed [r/min]", RPM, fs.LINE_INK[0])
    power = ("PW", "Shaft power [kW]", 1e-3, fs.LINE_INK[1])
    return _trend(ds, "fig21_speed_power", [speed, power])


def figure_22(ds: xr.Dataset) -> Figure:
    """Draw T3 [K] and P3 [kPa]; DataError if a variable is missing."""
    T3, P3 = ("T3", "$T_3$ [K]", 1.0, HOT), ("P3", "$P_3$ [kPa]", 1e-3, fs.LINE_INK[0])
    return _trend(ds, "fig22_compressor_outlet", [T3, P3])


def figure_23(ds: xr.Dataset) -> Figure:
    """Draw T4 [K] and the surge margin [%]; DataError if a variable is missing."""
    T4, SM = ("T4", "$T_4$ [K]", 1.0, HOT), ("SM", "Surge margin [%]", 100.0, fs.LINE_INK[2])
    return _trend(ds, "fig23_T4_surge_margin", [T4, SM])


_SHORTEST = 1 / 200  # of a run: shorter stretches are one in which something changes


def _segments(
    t: np.ndarray, table: np.ndarray, rows: Sequence[dict[str, Any]]
) -> list[tuple[float, float, int, int]]:
    """Return (start, end, first, last) of the stretches of ``table``, by its rows.

    Its rows are constant over a stretch, but for those in which they follow a profile.  A change
    one sample off the beginning of a phase is drawn there.
    """
    same = np.all((table[1:] == table[:-1]) | (np.isnan(table[1:]) & np.isnan(table[:-1])), axis=1)
    cuts = np.array([0, *(np.flatnonzero(~same) + 1)])
    starts = np.array([p["start"] for p in rows])
    slack = 1.5 * float(np.median(np.diff(t)))
    on_way = np.diff(t[cuts], append=t[-1]) < max(_SHORTEST * (t[-1] - t[0]), slack)
    on_way[-1] &= cuts.size > 1 and on_way[-2]
    inside = on_way[1:] & on_way[:-1]
    inside &= np.abs(t[cuts[1:], None] - starts).min(axis=1) > slack  # a phase begins anew
    cuts = cuts[np.concatenate([[True], ~inside])]
    ends = [*cuts[1:].tolist(), t.size - 1]

    def instant(i: int) -> float:
        near = starts[int(np.argmin(np.abs(starts - t[i])))]
        # what a sample tells holds since the one before
        there = t[i] if i in (0, t.size - 1) else t[i - 1]
        return float(near if abs(near - t[i]) <= slack else there)

    return [
        (instant(a), instant(b), a, max(b - 1, a) if b < t.size - 1 else b)
        for a, b in zip(cuts.tolist(), ends, strict=True)
        if b > a
    ]


def _load_lane(
    ds: xr.Dataset, rows: Sequence[dict[str, Any]], number: int | None = None
) -> list[tuple[float, float, str]]:
    """Return (start, end, words) of the loads, from the scenario or else from the mean power.

    Args:
        ds: the run, as generator ``number`` has it; None: all are alike.
    """
    table, of_these = scenario_of(ds), (None, number or 1)
    steps = [(p.get("start"), p.get("load")) for p in table.get("phase", ())]
    steps += [
        (e.get("time"), e.get("load"))
        for e in table.get("event", ())
        if e.get("generator") in of_these
    ]
    at = (number or 1) - 1
    steps = [(s, x[at] if isinstance(x, list) and at < len(x) else x) for s, x in steps]
    loads = sorted(((float(s), x) for s, x in steps if isinstance(x, dict)), key=lambda s: s[0])
    t_end = rows[-1]["end"]
    loads = [x for x in loads if x[0] < t_end]
    if loads:
        ends = [s for s, _ in loads[1:]] + [t_end]
        n = int(ds.attrs.get("generators", 2)) if number is None else 1
        return [(s, e, _load_words(x, n)) for (s, x), e in zip(loads, ends, strict=True)]
    t, P = ds["time"].values, ds["P_e"].values
    lane = []
    for p in rows:
        tail = (t > p["end"] - 0.25 * (p["end"] - p["start"])) & (t <= p["end"])
        lane.append((p["start"], p["end"], f"{np.mean(P[tail]) / 1e3:.0f} kW electric"))
    return lane


def _load_words(x: dict[str, Any], n: int) -> str:
    kind = x.get("kind", "")
    words = {
        "R": "resistive",
        "RL": f"R-L, pf {x.get('power_factor', 0.85)}",
        "series": "series R-L",
        "constant_power": "constant power",
        "open": "open circuit",
        "open_phase": f"phase {x.get('phase', 'a')} open",
    }.get(kind, str(kind))
    if x.get("unbalance") and len(set(x["unbalance"])) > 1:
        words += ", unbalanced"
    if any(isinstance(v, dict) for v in x.values()):
        words += ", changes"
    power, times = x.get("power_kW"), f"{n}\u00a0×\u00a0" if n > 1 else ""
    if isinstance(power, int | float):
        return f"{times}{power:g}\u00a0kW\n{words}"
    given = power if isinstance(power, dict) else {}
    ends = [given[k] for k in ("from", "to", "on", "off") if k in given] or given.get("values", [])
    if len(ends) < 2:
        return words
    return f"{times}{min(ends):g} to {max(ends):g}\u00a0kW\n{words}"


def _gas_lane(ds: xr.Dataset, rows: Sequence[dict[str, Any]]) -> Lane:
    """Return the stretches of gas-path health, with what it changes to where it does."""
    t, lane = ds["time"].values, []
    gas = np.column_stack([ds[f].values for f in HEALTH_FACTORS])
    for a, b, i, j in _segments(t, gas, rows):
        factors = zip(HEALTH_FACTORS.values(), gas[i], gas[j], strict=True)
        off = [f"{h.symbol} {_change(v, w)} %" for h, v, w in factors if (v, w) != (1.0, 1.0)]
        off = [x.replace(" -", " −").replace(" ", "\u00a0") for x in off]
        words = ", ".join(off[:2]) + "\n" + ", ".join(off[2:]) if off else "healthy"
        lane.append((a, b, words.strip(), HURT if off else HEALTHY))
    return lane


def _change(first: float, last: float) -> str:
    """Return a change of a factor in per cent, or two where it follows a profile."""
    ends = [f"{p:+.3g}" if abs(p) >= 5e-3 else "0" for p in (100 * (first - 1), 100 * (last - 1))]
    return ends[0] if first == last else " → ".join(ends)


def stator_lane(ds: xr.Dataset, rows: Sequence[dict[str, Any]], number: int) -> Lane:
    """Return the stretches of the stator fault of a generator."""
    t, lane = ds["time"].values, []
    stator = np.column_stack([ds[f].values for f in SEVERITY])
    for a, b, i, j in _segments(t, stator, rows):
        worst = i + int(np.argmax(severity_h(*stator[i : j + 1, :2].T)))
        m, r, c = stator[worst]
        kappa = "κ = µ" if abs(c - m) < 1e-12 else f"κ = {c:g}"
        words = "healthy"
        if m > 0:
            parts = f"µ = {100 * m:g} %", f"$k_{{rf}}$ = {r:g}", kappa
            first, second, third = (x.replace(" ", "\u00a0") for x in parts)
            of = fault_phase(ds, float(t[worst]), number).replace(" of", "")
            words = f"TTSC{of}\n{first}, {second}, {third}"
            if not np.array_equal(stator[i], stator[j], equal_nan=True) or j - i > 1 < worst - i:
                second = f"$k_{{rf}}$\u00a0=\u00a0{r:.4g}"
                words = f"TTSC{of} changes,\nat most {first}, {second}, {third}"
        lane.append((a, b, words, HURT if m > 0 else HEALTHY))
    return lane


def _write(ax: Axes, x: float, y: float, words: str, ink: str, letters: int) -> bool:
    """Write into a stretch of a lane, smaller or not at all for want of room; tell whether."""
    text = "\n".join(
        line
        for part in words.split("\n")
        for line in textwrap.wrap(part, letters + 2 * part.count("$"), break_long_words=False)
    )
    lines = text.split("\n")
    longest = max(len(line) - 5 * (line.count("$") // 2) for line in lines)
    size = 8.8 if len(lines) < 4 and longest <= letters else 7.0
    if longest <= 1.3 * letters and len(lines) < 5:
        look: dict[str, Any] = {"ha": "center", "va": "center", "linespacing": 1.25}
        ax.text(x, y, text, color=ink, fontsize=size, **look)
        return True
    return False


def figure_20(ds: xr.Dataset) -> Figure:
    """Draw the phases of the run: load, health of the gas path and state of the stator over time.

    Raises:
        DataError: a variable is missing.
    """
    fs.need(ds, [*HEALTH_FACTORS, *SEVERITY, "P_e"])
    rows = phases(ds)
    numbers = generators_of(ds)
    several = len(numbers) > 1
    loads, stators = {}, {}
    for k in numbers:
        own, of = of_generator(ds, k), f" {k}" if several else ""
        steps = enumerate(_load_lane(own, rows, k if several else None))
        loads[f"Load{of}" if several else "Electrical load"] = [
            (a, b, w, LOADS[i % 2]) for i, (a, b, w) in steps
        ]
        stators[f"Stator{of}"] = stator_lane(own, rows, k)
    lanes: dict[str, Lane] = {**loads, "Gas path": _gas_lane(ds, rows), **stators}
    n = int(ds.attrs.get("generators", 2))
    with fs.drawing():
        fig = fs.new_figure(3.7 + 0.8 * (len(lanes) - 3))
        m = fs.margins(fig, top=0.45, bottom=0.95)
        ax = fig.add_axes((0.125, m["bottom"], 0.86, m["top"] - m["bottom"]))
        fs.bands(ax, rows, names=True)
        span = rows[-1]["end"] - rows[0]["start"]
        per_letter = 0.075 * span / (0.86 * fs.WIDTH)
        untold = False  # a fault for whose words there is no room
        for y, items in enumerate(lanes.values()):
            for a, b, words, (ground, ink) in items:
                box: dict[str, Any] = {"height": 0.7, "edgecolor": "white", "lw": 1.6, "zorder": 2}
                ax.barh(y, b - a, left=a, color=ground, **box)
                letters = max(int((b - a) / per_letter) - 1, 1)
                there = _write(ax, (a + b) / 2, y, words, ink, letters)
                untold |= not there and words.startswith("TTSC")
        ax.set_yticks(range(len(lanes)), list(lanes), fontsize=9.5)
        ax.set_ylim(len(lanes) - 0.5, -0.5)
        ax.grid(False)
        ax.tick_params(axis="y", length=0)
        ax.spines["left"].set_visible(False)
        ax.set_xlabel("Time [s]")
        of = {1: "the generator", 2: "each of the two generators"}.get(n, f"each of {n} generators")
        more = f"{severity_note(ds)} " if untold else ""
        caption_of(fig, ds, "fig20_phases", f"{more}Load of {of} at rated voltage.")
    return fig
