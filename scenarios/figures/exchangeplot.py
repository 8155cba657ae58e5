"""Errors of the multi-rate exchange over its step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from scenarios.figures import figstyle as fs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def figure_exchange_error(
    curves: Mapping[tuple[str, str], tuple[np.ndarray, Mapping[str, np.ndarray]]],
    quantities: Mapping[str, str],
    *,
    marked: float = 0.020,
) -> Figure:
    """Draw errors over the exchange step, one logarithmic panel for each quantity.

    Args:
        curves: by (case, exchange), steps [s] and errors by quantity, arrays of one shape (n,).
        quantities: panels, by name with their title; four at most.
        marked: step [s] that is marked: the paper's.
    """
    from matplotlib.lines import Line2D
    from matplotlib.ticker import FixedLocator, NullLocator

    cases = list(dict.fromkeys(case for case, _ in curves))
    exchanges = list(dict.fromkeys(ex for _, ex in curves))
    dash = dict(zip(exchanges, ("-", fs.DASHED, (0, (1, 1.5))), strict=False))
    steps = np.unique(np.concatenate([dt for dt, _ in curves.values()]))
    with fs.drawing():
        fig = fs.new_figure(7.4)
        place = {"left": 0.085, "right": 0.985, "hspace": 0.3, "wspace": 0.2}
        grid = fig.add_gridspec(
            2, 2, **place, **fs.margins(fig, top=0.65 if len(cases) < 4 else 0.8, bottom=0.85)
        )
        for k, (q, head) in enumerate(quantities.items()):
            ax = fig.add_subplot(grid[k // 2, k % 2])
            for (case, ex), (dt, errors) in curves.items():
                ink, mark = fs.look(cases.index(case))
                look = {"color": ink, "marker": mark, "mfc": ink if ex == exchanges[0] else "white"}
                ax.loglog(1e3 * dt, errors[q], ls=dash[ex], ms=4.5, lw=1.5, **look)
            every = np.concatenate([errors[q] for _, errors in curves.values()])
            _slopes(ax, steps, every)
            ax.axvline(1e3 * marked, color=fs.MUTED, lw=0.9, zorder=0.5)
            ax.xaxis.set_major_locator(FixedLocator(list(1e3 * steps)))
            ax.xaxis.set_minor_locator(NullLocator())
            ax.set_xticklabels([f"{1e3 * s:g}" for s in steps])
            ax.set_xlim(1e3 * steps[0] / 1.25, 1e3 * steps[-1] * 1.25)
            ax.set_ylim(every.min() / 2, every.max() * 2)
            fs.above(ax, head[0].upper() + head[1:], fs.INK)
            if k % 2 == 0:
                ax.set_ylabel("Largest relative error")
            if k >= len(quantities) - 2:
                ax.set_xlabel("Exchange step [ms]")
        handles = []
        for c, case in enumerate(cases):
            ink, mark = fs.look(c)
            look = {"color": ink, "marker": mark, "label": case}
            handles.append(Line2D([], [], ms=4.5, lw=1.5, **look))
        for ex in exchanges:
            inside = fs.INK if ex == exchanges[0] else "white"
            look = {"color": fs.INK, "marker": "o", "mfc": inside, "label": f"exchange “{ex}”"}
            handles.append(Line2D([], [], ms=4.5, lw=1.5, ls=dash[ex], **look))
        space = {"columnspacing": 1.2, "handlelength": 2.4, "frameon": False, "fontsize": 8.8}
        n = len(cases)
        rows = [handles] if len(handles) <= 6 else [handles[:n], handles[n:]]
        for k, row in enumerate(rows):
            where = (0.53, 1.0 - 0.03 * k)
            fig.legend(
                handles=row, ncols=len(row), loc="upper center", bbox_to_anchor=where, **space
            )
        text = (
            "Error of the multi-rate exchange against the unit as one model with one solver. "
            "Grey: slopes 1 and 2. Vertical line: the paper's 20 ms."
        )
        fs.caption(fig, text)
    return fig


def _slopes(ax: Axes, steps: np.ndarray, errors: np.ndarray) -> None:
    """Draw guides of first and second order through the upper right corner's reach."""
    x = np.array([steps[0], steps[-1]])
    top = float(errors.max())
    for order, factor in ((1, 1.7), (2, 0.12)):
        y = factor * top * (x / x[-1]) ** order
        ax.plot(1e3 * x, y, color="#b8c0cc", lw=3.2, zorder=0.8, solid_capstyle="butt")
