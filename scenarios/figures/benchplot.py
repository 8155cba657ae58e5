"""Cost against what was asked for: time over simulated time, number of runs, output rate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from apu_casadi.core.errors import SignalError
from scenarios.figures.figstyle import INK, LINE_INK, MUTED, caption, drawing, new_figure, title

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def fit(x: np.ndarray, y: np.ndarray) -> tuple[float, float, float]:
    """Return offset, slope, and the largest distance of y from the line over the largest y.

    Raises:
        SignalError: fewer than two points, or arrays of different shapes.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    if x.ndim != 1 or x.shape != y.shape or x.size < 2:
        raise SignalError(f"a line needs two points or more, got {x.shape} and {y.shape}")
    slope, offset = np.polyfit(x, y, 1)
    return float(offset), float(slope), float(np.abs(offset + slope * x - y).max() / y.max())


def plot_costs(panels: Sequence[tuple[str, str, str, np.ndarray, np.ndarray]], note: str) -> Figure:
    """Draw measured costs with the straight line through them, one panel for each.

    Args:
        panels: (title, label of x, label of y, x, y), up to four; axes are linear and start at 0.
        note: the caption.

    Raises:
        SignalError: no panels, more than four, or a panel with fewer than two points.
    """

    if not 1 <= len(panels) <= 4:
        raise SignalError(f"one to four panels can be drawn, got {len(panels)}")
    with drawing():
        fig = new_figure(3.9)
        axes = fig.subplots(1, len(panels), squeeze=False)[0]
        fig.subplots_adjust(left=0.06, right=0.985, top=0.88, bottom=0.26, wspace=0.24)
        for ax, (head, xlabel, ylabel, x, y) in zip(axes, panels, strict=True):
            offset, slope, off = fit(x, y)
            ends = np.array([0.0, 1.05 * float(np.max(x))])
            ax.plot(ends, offset + slope * ends, color=MUTED, lw=1.2, zorder=1)
            ax.plot(x, y, "o", color=LINE_INK[0], ms=5, zorder=2)
            ax.set_xlim(0, ends[1])
            ax.set_ylim(0, 1.12 * float(np.max(y)))
            ax.set_xlabel(xlabel)
            ax.set_ylabel(ylabel)
            title(ax, head)
            line = f"{offset:.2g} s + {slope:.2g} s per unit"
            text = f"{line}\noff the line by {100 * off:.0f} % at most"
            ax.text(0.04, 0.93, text, transform=ax.transAxes, va="top", fontsize=8.2, color=INK)
        caption(fig, note)
    return fig
