"""Measured against fitted, sensor by sensor, with the residuals beside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import SignalError
from scenarios.figures import figstyle as fs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_SHOWN = {"rad/s": ("r/min", 30 / np.pi), "Pa": ("kPa", 1e-3), "W": ("kW", 1e-3)}
_SHOWN["kg/s"] = ("g/s", 1e3)
Series = tuple[np.ndarray, np.ndarray, np.ndarray]


def plot_fit(
    t: np.ndarray,
    series: Mapping[str, Series],
    units: Mapping[str, str],
    *,
    steady: bool,
    heading: str,
    note: str = "",
) -> Figure:
    """Draw one data set: a row for each sensor, residuals in standard deviations at the right.

    Args:
        t: instants (s), or numbers of the points, shape (K,).
        series: {name: (measured, fitted, residual in sigmas)}, each of shape (K,), NaN for gaps.
        units: SI unit by name; shown in r/min, kPa, kW, g/s where these are usual.
        steady: points instead of lines.
        heading, note: title and caption.

    Raises:
        SignalError: nothing to draw, or arrays of another length.
    """

    wrong = [n for n, s in series.items() if any(np.shape(a) != np.shape(t) for a in s)]
    if not series or wrong:
        raise SignalError(
            f"series of {np.size(t)} values expected; wrong: {', '.join(wrong) or 'none given'}"
        )
    n = len(series)
    dots: dict[str, Any] = {"ms": 2.6, "mfc": fs.MUTED, "mew": 0.0, "alpha": 0.6}
    line: dict[str, Any] = {"lw": 1.4}
    small = {"ms": 2.2, "alpha": 0.6}
    if steady:
        dots = {"ms": 5, "mfc": "none", "mew": 1.0, "alpha": 1.0}
        line, small = {"lw": 0, "marker": "x", "ms": 5, "mew": 1.5}, {"ms": 4, "alpha": 0.9}
    with fs.drawing():
        height = 1.25 * n + 1.3
        fig = fs.new_figure(height)
        place = {"left": 0.085, "right": 0.985, "hspace": 0.28, "wspace": 0.16}
        place |= fs.margins(fig, top=0.55, bottom=0.85)
        grid = fig.add_gridspec(n, 2, width_ratios=(1.9, 1), **place)
        fig.text(0.012, 1 - 0.22 / height, heading, fontsize=11, fontweight="bold", va="center")
        for i, (name, (measured, fitted, error)) in enumerate(series.items()):
            unit, scale = _SHOWN.get(units[name], (units[name], 1.0))
            ax = fig.add_subplot(grid[i, 0])
            ax.plot(t, scale * measured, "o", mec=fs.MUTED, label="measured", **dots)
            ax.plot(t, scale * fitted, color=fs.LINE_INK[0], label="fitted", **line)
            ax.set_ylabel(f"{name} [{unit}]")
            ax.margins(x=0.02, y=0.15)
            side = fig.add_subplot(grid[i, 1], sharex=ax)
            side.axhspan(-1.96, 1.96, color="#e8f0f7", lw=0, zorder=0)
            side.axhline(0, color=fs.INK, lw=0.8)
            side.plot(t, error, "o", color=fs.LINE_INK[1], mew=0, **small)
            largest = float(np.nanmax(np.abs(error))) if np.isfinite(error).any() else 0.0
            reach = max(3.2, 1.15 * largest)
            side.set_ylim(-reach, reach)
            if not np.isfinite(error).any():
                middle = {"transform": side.transAxes, "ha": "center", "va": "center"}
                side.text(0.5, 0.5, "not measured", color=fs.MUTED, fontsize=8.5, **middle)
            for a in (ax, side):
                a.tick_params(labelbottom=i == n - 1)
            if i == 0:
                ax.legend(loc="best", fontsize=8, frameon=True, framealpha=0.9, edgecolor="none")
                fs.title(side, "residual / standard deviation")
            if i == n - 1:
                for a in (ax, side):
                    a.set_xlabel("point" if steady else "time [s]")
                    if steady:
                        a.xaxis.get_major_locator().set_params(integer=True)
        fs.caption(fig, f"Shaded: 95 % of the residuals should lie here. {note}".strip())
        return fig


__all__: Sequence[str] = ["plot_fit"]
