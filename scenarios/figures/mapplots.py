"""Compressor and turbine maps with operating lines, surge line and the trajectory of a run.

The maps are drawn as the engine uses them: scaled to its design point and calibrated, at Reynolds
number index 1.  What is drawn on them are an operating point's own flow and pressure ratio, so a
flow factor below 1 or a Reynolds number other than the design's shows as a distance from the speed
line.

The surge line is where the speed lines reach zero stability margin.  Beside it is the published
map's own, scaled only: the two numbers that set the margin were fitted at corrected speeds of 1 and
1.05, and how far the lines lie apart elsewhere shows what is made of them there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import DataError, MapError, OperatingPointError, SignalError
from apu_casadi.gaspath.maps.scaledmaps import map_function
from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.unit.runsummary import phases
from scenarios.figures import figstyle as fs
from scenarios.figures.runwords import scenario_of

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from apu_casadi.gaspath.maps.scaledmaps import ScaledMap

T_STD, P_STD = 288.15, 101325.0  # K, Pa: standard day
SURGE_INK = "#9c2a1c"
_SHADE = ("#f4f8fb", "#e6f0f7", "#d3e4f0", "#bcd6e8", "#a3c6de")
_PHASES = ("#111827", "#0f766e", "#7a3e9d", "#c2185b", "#6b7f00", "#0891b2")
_OUTSIDE = 0.5  # table spans beyond the table in which the surge line is looked for
Lines = Mapping[str, Sequence[OperatingPoint]]
Curve = tuple[np.ndarray, np.ndarray]
_SHAFT = "Operating lines: governed speed, no shaft power (lower end) to design T4."


def operating_line(
    gg: GasGenerator,
    PW: Sequence[float] | np.ndarray | None = None,
    *,
    N: float | None = None,
    health: Mapping[str, float] | None = None,
    **ambient: float,
) -> list[OperatingPoint]:
    """Return steady points at governed speed over shaft power, as far as they exist.

    Args:
        PW: shaft powers, W, rising; by default eleven from none to that which design T4 allows.
        N: rotor speed, rad/s; design speed by default.
        health, ambient: as for :func:`apu_casadi.gaspath.steady.trimming.trim_gas_generator`.

    Raises:
        OperatingPointError: not one of the points exists.
        SignalError: no shaft power.
    """
    N = gg.parameters.N if N is None else N
    if PW is None:
        top = trim_gas_generator(gg, {"N": N, "T4": gg.parameters.T4}, theta=health, **ambient)
        PW = np.linspace(0.0, top["PW"], 11)
    if len(PW) == 0:
        raise SignalError("an operating line needs at least one shaft power, got none")
    points = []
    for P in PW:
        try:
            points.append(trim_gas_generator(gg, {"N": N, "PW": float(P)}, theta=health, **ambient))
        except OperatingPointError as e:
            failure = e
    if not points:
        raise failure
    return points


def default_lines(gg: GasGenerator) -> dict[str, list[OperatingPoint]]:
    """Return the operating lines of the design's ambient and of 8000 m, Mach 0.7 (Table 5)."""
    p = gg.parameters
    where = f"{p.altitude:g} m, Mach {p.Mach:g}, ISA {p.dT_isa:+g} K"
    return {
        where: operating_line(gg, altitude=p.altitude, Mach=p.Mach, dT_isa=p.dT_isa, war=p.war),
        "8000 m, Mach 0.7, ISA +5 K": operating_line(gg, altitude=8000.0, Mach=0.7, dT_isa=5.0),
    }


def published_surge_line(cmap: ScaledMap) -> tuple[np.ndarray, np.ndarray]:
    """Return flow and pressure ratio of the table's surge line, scaled but not calibrated."""
    t = cmap.table
    if t.surge_W is None or t.surge_PR is None:
        raise MapError(f"map {t.name!r} is of a {t.kind}: it has no surge line")
    W, PR, _ = (float(o) for o in map_function(t)(cmap.N_map_des, cmap.beta_des))
    return (t.surge_W * cmap.W_des / W, 1 + (t.surge_PR - 1) * (cmap.PR_des - 1) / (PR - 1))


def surge_line(cmap: ScaledMap, samples: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Return flow and pressure ratio where the speed lines reach zero stability margin.

    Looked for up to half a table span beyond the table's edge; speeds without such a point are
    left out.
    """
    t = cmap.table
    n = np.linspace(t.N[0], t.N[-1], samples) / cmap.N_map_des
    reach = _OUTSIDE * np.ptp(t.beta)
    beta = np.linspace(t.beta[0] - reach, t.beta[-1] + reach, 400)
    m = cmap.lookup(*np.meshgrid(n, beta, indexing="ij"), 1.0)
    W, PR = [], []
    for i in range(samples):
        cross = np.flatnonzero(np.diff(np.sign(m.SM[i])))
        if cross.size == 0:
            continue
        # the crossing nearest to the table's middle is the one that speed line meets first
        j = cross[np.argmin(np.abs(beta[cross] - t.beta.mean()))]
        w = m.SM[i, j] / (m.SM[i, j] - m.SM[i, j + 1])
        W.append((1 - w) * m.W[i, j] + w * m.W[i, j + 1])
        PR.append((1 - w) * m.PR[i, j] + w * m.PR[i, j + 1])
    return np.array(W), np.array(PR)


def plot_compressor_map(
    gg: GasGenerator,
    *,
    lines: Lines | None = None,
    trajectory: xr.Dataset | None = None,
    note: str = "",
) -> Figure:
    """Draw the compressor map: pressure ratio over corrected flow, standard day.

    Args:
        gg: the engine.
        lines: operating lines by label; :func:`default_lines` by default, ``{}`` for none.
        trajectory: joint run with W2, T2, P2 and PR_c.

    Raises:
        DataError: the run lacks a variable.
    """
    cmap, d = gg.maps[0], gg.design.values
    to_standard = np.sqrt(d["T2"] / T_STD) / (d["P2"] / P_STD)  # of flow at the design inlet state

    def place(v: Any) -> tuple[Any, Any]:
        return v["W2"] * np.sqrt(v["T2"] / T_STD) / (v["P2"] / P_STD), v["PR_c"]

    surge, published = surge_line(cmap), published_surge_line(cmap)
    return _draw(
        gg,
        cmap,
        place,
        lambda n, W, PR: (W * to_standard, PR),
        needed=("W2", "T2", "P2", "PR_c"),
        design=place(d),
        lines=lines,
        trajectory=trajectory,
        note=note,
        surge=(surge[0] * to_standard, surge[1]),
        published=(published[0] * to_standard, published[1]),
        labels=(
            "Corrected flow $W_2\\sqrt{\\theta_2}/\\delta_2$ [kg/s], standard day",
            "Pressure ratio $P_3/P_2$ [-]",
        ),
        what="Compressor map",
        symbol="n_c",
    )


def plot_turbine_map(
    gg: GasGenerator,
    *,
    lines: Lines | None = None,
    trajectory: xr.Dataset | None = None,
    note: str = "",
) -> Figure:
    """Draw the turbine map: pressure ratio over corrected flow times corrected speed.

    The product spreads the speed lines, which nearly coincide over the flow alone; both factors
    are relative to the design point.  Arguments as for :func:`plot_compressor_map`; the run needs
    W41, T41, P4, n_t and PR_t.
    """
    tmap, d = gg.maps[1], gg.design

    def place(v: Any) -> tuple[Any, Any]:
        return v["W41"] * np.sqrt(v["T41"]) / v["P4"] / d.W_t * v["n_t"], v["PR_t"]

    return _draw(
        gg,
        tmap,
        place,
        lambda n, W, PR: (W / d.W_t * n, PR),
        needed=("W41", "T41", "P4", "n_t", "PR_t"),
        design=place({**d.values, "n_t": 1.0}),
        lines=lines,
        trajectory=trajectory,
        note=note,
        surge=None,
        published=None,
        labels=(
            "Corrected flow × corrected speed, relative to the design point [-]",
            "Pressure ratio $P_4/P_5$ [-]",
        ),
        what="Turbine map",
        symbol="n_t",
    )


def _draw(
    gg: GasGenerator,
    m: ScaledMap,
    place: Callable[[Any], tuple[Any, Any]],
    axes_of: Callable[[Any, Any, Any], tuple[Any, Any]],
    *,
    needed: Sequence[str],
    design: tuple[float, float],
    lines: Lines | None,
    trajectory: xr.Dataset | None,
    note: str,
    surge: Curve | None,
    published: Curve | None,
    labels: tuple[str, str],
    what: str,
    symbol: str,
) -> Figure:

    lines = default_lines(gg) if lines is None else lines
    run = None if trajectory is None else _trajectory(trajectory, needed, place)
    drawn = [place(_columns(points)) for points in lines.values()]
    with fs.drawing():
        fig = fs.new_figure(6.4)
        place_ = {"left": 0.062, "right": 0.985, "wspace": 0.17, "top": 0.93, "bottom": 0.255}
        grid = fig.add_gridspec(1, 2, width_ratios=[1.35, 1.0], **place_)
        whole, near = (fig.add_subplot(grid[k]) for k in range(2))
        x_all = np.concatenate([np.atleast_1d(design[0]), *(np.ravel(x) for x, _ in drawn)])
        y_all = np.concatenate([np.atleast_1d(design[1]), *(np.ravel(y) for _, y in drawn)])
        if run is not None:
            x_all, y_all = np.append(x_all, run[0]), np.append(y_all, run[1])
        box = _box(x_all, y_all)
        x_table = axes_of(*_edges(m))[0]
        room = 0.04 * float(np.ptp(x_table))
        whole.set_xlim(x_table.min() - room, max(x_table.max(), box[0][1]) + room)
        for ax, zoomed in ((whole, False), (near, True)):
            if zoomed:
                ax.set_xlim(*box[0])
                ax.set_ylim(*box[1])
            _map(ax, m, axes_of, symbol, zoomed=zoomed)
            if surge is not None and published is not None:
                _surge(ax, surge, published)
            for k, (label, (x, y)) in enumerate(zip(lines, drawn, strict=True)):
                look = {"color": fs.look(k)[0], "lw": 2.0, "ms": 3.2, "zorder": 5}
                ax.plot(x, y, marker="o", label=f"operating line, {label}", **look)
            if run is not None and trajectory is not None:
                _draw_run(ax, *run, trajectory)
            star = {"ms": 13, "mfc": "white", "mec": fs.INK, "mew": 1.2, "zorder": 8}
            ax.plot(*design, "*", label="design point", **star)
            ax.set_xlabel(labels[0] if not zoomed else labels[0].split(",")[0])
        whole.set_ylabel(labels[1])
        how = "scaled" if m.cal == type(m.cal)() else "scaled and calibrated"
        fs.title(whole, f"{what}: {m.table.name}, {how}")
        fs.title(near, "Enlarged")
        (x0, x1), (y0, y1) = box
        frame = [x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0]
        whole.plot(*frame, color=fs.MUTED, lw=0.9, ls="--", zorder=6)
        space = {"ncols": 4, "columnspacing": 1.6, "handlelength": 2.2}
        where = {"loc": "lower left", "bbox_to_anchor": (0.05, 0.075), "frameon": False}
        fig.legend(*whole.get_legend_handles_labels(), fontsize=7.8, **where, **space)
        words = [f"{what} at Reynolds number index 1. Grey: lines of relative corrected speed"]
        words.append(f"${symbol}$; shading: isentropic efficiency inside the table. {_SHAFT}")
        if surge is not None:
            words.append("Surge line: zero stability margin.")
        if run is not None:
            words.append(f"Trajectory{_name(trajectory)}: circle start, square end.")
        fs.caption(fig, " ".join([*words, *([note] if note else [])]))
        return fig


def _surge(ax: Axes, surge: Curve, published: Curve) -> None:
    ax.plot(*surge, color=SURGE_INK, lw=2.2, label="surge line", zorder=4)
    look = {"color": SURGE_INK, "lw": 1.1, "ls": fs.DASHED, "zorder": 4}
    ax.plot(*published, label="surge line as published, scaled", **look)


def _columns(points: Sequence[OperatingPoint]) -> dict[str, np.ndarray]:
    names = points[0].values if points else {}
    return {n: np.array([p[n] for p in points]) for n in names}


def _box(x: np.ndarray, y: np.ndarray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits around what is drawn, with room; never a vanishing box."""
    out = []
    for v in (x, y):
        lo, hi = float(np.min(v)), float(np.max(v))
        room = max(0.18 * (hi - lo), 0.02 * abs(hi))
        out.append((lo - room, hi + room))
    return out[0], out[1]


def _map(
    ax: Axes, m: ScaledMap, axes_of: Callable[..., tuple[Any, Any]], symbol: str, *, zoomed: bool
) -> None:
    """Draw speed lines and efficiency over the table."""
    t = m.table
    N = np.linspace(t.N[0], t.N[-1], 90) / m.N_map_des
    beta = np.linspace(t.beta[0], t.beta[-1], 90)
    n, b = np.meshgrid(N, beta, indexing="ij")
    p = m.lookup(n, b, 1.0)
    x, y = axes_of(n, p.W, p.PR)
    best = float(p.eta.max())
    levels = np.array([0.70, 0.76, 0.80, 0.83, 0.85, 0.86, 0.87, 0.88, 0.89, 0.90, 0.91, 0.92])
    levels = levels[levels < best]
    if zoomed:
        inside = _within(ax, x, y)
        if inside.any():
            lo, hi = float(p.eta[inside].min()), float(p.eta[inside].max())
            fine = np.arange(np.ceil(lo * 200) / 200, hi, 0.005)
            levels = fine if fine.size <= 9 else fine[:: int(np.ceil(fine.size / 9))]
    if levels.size > 1:
        from matplotlib.colors import LinearSegmentedColormap

        palette = LinearSegmentedColormap.from_list("eta", _SHADE)
        ax.contourf(
            x, y, p.eta, levels=[*levels, best + 1e-6], cmap=palette, extend="min", zorder=0.5
        )
        shade = ax.contour(x, y, p.eta, levels=levels, colors="#7da7c4", linewidths=0.7, zorder=1)
        ax.clabel(
            shade, fmt="%.3f" if zoomed else "%.2f", fontsize=6.8, colors="#41708f", inline=True
        )
    for v in np.asarray(t.N) / m.N_map_des:
        line = m.lookup(np.full(beta.shape, v), beta, 1.0)
        lx, ly = axes_of(v, line.W, line.PR)
        ax.plot(lx, ly, color=fs.MUTED, lw=1.0, zorder=2)
        seen = np.full(lx.shape, True)
        if zoomed:  # room for the label at the right
            x0, x1 = ax.get_xlim()
            seen = _within(ax, lx, ly) & (lx < x1 - 0.13 * (x1 - x0))
        if seen.any():
            k = int(np.flatnonzero(seen)[np.argmax(ly[seen])])
            text = f"${symbol}$ = {v:.3g}" if zoomed else f"{v:.3g}"
            shift, va = ((3, -2), "top") if zoomed else ((3, 3), "bottom")
            look = {"fontsize": 7.4, "ha": "left", "va": va, "zorder": 7, "clip_on": True}
            fs.remark(ax, text, (lx[k], ly[k]), shift, **look)


def _edges(m: ScaledMap) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return n, W and PR at the table's points."""
    n, beta = np.meshgrid(m.table.N / m.N_map_des, m.table.beta, indexing="ij")
    p = m.lookup(n, beta, 1.0)
    return n, p.W, p.PR


def _within(ax: Axes, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    return np.asarray((x >= x0) & (x <= x1) & (y >= y0) & (y <= y1))


def _trajectory(
    ds: xr.Dataset, needed: Iterable[str], place: Callable[[Any], tuple[Any, Any]]
) -> tuple[np.ndarray, np.ndarray]:
    phases(ds)  # that it is a run over time at all
    missing = [n for n in needed if n not in ds]
    if missing:
        raise DataError(f"the trajectory lacks {', '.join(missing)}")
    wrong = [n for n in needed if ds[n].dims != ("time",) or ds[n].dtype.kind not in "fiu"]
    if wrong:
        raise DataError(f"the trajectory has other than numbers over time in {', '.join(wrong)}")
    x, y = place({n: ds[n].values for n in needed})
    return np.asarray(x), np.asarray(y)


def _draw_run(ax: Axes, x: np.ndarray, y: np.ndarray, ds: xr.Dataset) -> None:
    """Draw a run phase by phase, each in its own colour, with start and end."""
    t = ds["time"].values
    for k, p in enumerate(phases(ds)):
        inside = (t >= p["start"] - 1e-9) & (t <= p["end"] + 1e-9)
        ink = _PHASES[k % len(_PHASES)]
        path, look = (x[inside], y[inside]), {"solid_capstyle": "round"}
        ax.plot(*path, color="white", lw=3.4, zorder=5.5, **look)
        ax.plot(*path, color=ink, lw=1.7, zorder=6, label=f"run: {p['name']}", **look)
    for i, mark in ((0, "o"), (-1, "s")):
        ax.plot(
            x[i], y[i], marker=mark, ms=6, mfc="white", mec=fs.INK, mew=1.3, ls="none", zorder=9
        )


def _name(ds: xr.Dataset | None) -> str:
    name = "" if ds is None else scenario_of(ds).get("name", "")
    return f" of scenario “{name}”" if name else ""
