"""Noise that was found from a recording: its bands, and whether innovations are white."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from scenarios.figures import figstyle as fs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_noise"]


def plot_noise(report: Mapping[str, Any], note: str = "") -> Figure:
    """Draw estimates over their starts with bands, and correlations of the innovations.

    Args:
        report: as ``apu tune --json`` prints it.
        note: added to the caption.
    """
    rows, white = report["estimates"], report["correlation"]
    with fs.drawing():
        fig = fs.new_figure(1.7 + 0.34 * max(len(rows), len(white)))
        place = fs.margins(fig, top=0.3, bottom=0.85)
        grid = fig.add_gridspec(1, 2, left=0.26, right=0.985, wspace=0.22, **place)
        left, right = (fig.add_subplot(grid[0, k]) for k in (0, 1))
        labels = []
        for k, r in enumerate(rows):
            start, ink = r["start"], fs.LINE_INK[0]
            if r["told_from_zero"]:
                left.plot([r["low"] / start, r["high"] / start], [k, k], color=ink, lw=2)
                left.plot(r["estimate"] / start, k, "o", color=ink, ms=5)
            else:
                left.plot(r["high"] / start, k, "<", color=ink, ms=6)
            unit = "stated" if r["kind"] == "input" else r["unit"]
            labels.append(f"{r['label']}: {r['estimate']:.3g} {unit}")
        left.axvline(1.0, color=fs.MUTED, lw=1, ls="--")
        left.set_xscale("log")
        left.set_yticks(range(len(rows)), labels)
        left.set_ylim(len(rows) - 0.5, -0.5)
        left.set_xlabel("standard deviation over its start [-]")
        fs.title(left, "Noise and its 95 % band")
        for k, c in enumerate(white.values()):
            right.plot([-2 * c["white"], 2 * c["white"]], [k, k], color=fs.GRID, lw=8)
            right.plot(c["value"], k, "o", color=fs.LINE_INK[1], ms=5)
        right.axvline(0.0, color=fs.MUTED, lw=1)
        right.set_yticks(range(len(white)), list(white))
        right.set_ylim(len(white) - 0.5, -0.5)
        right.set_xlim(-1, 1)
        right.set_xlabel("correlation with the innovation before [-]")
        fs.title(right, "Are the innovations white?")
        words = "Triangle: upper limit of what cannot be told from zero. Grey: 95 % if white."
        fs.caption(fig, f"{words} {note}".strip())
    return fig
