"""The look that all figures share: size, palette, fonts; and a figure without a window."""

from __future__ import annotations

import contextlib
import textwrap
import threading
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 160
WIDTH = 10.0
"""Width of a figure, in: 1600 px."""

INK, MUTED, GRID = "#1f2933", "#5f6b7a", "#e4e7eb"
PHASE_INK = ("#33536f", "#1f4e79", "#8a5a00", "#9c2a1c")
"""Colours of the phases of a run, in their order."""

LINE_INK = ("#0b5394", "#b45309", "#0f766e", "#7a3e9d")
"""Colours of curves that are compared."""

STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.7,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "text.color": INK,
    "axes.unicode_minus": True,
    "axes.formatter.useoffset": False,
}
"""Settings for ``matplotlib.rc_context``."""


#: Matplotlib keeps settings and fonts for the whole process: one thread draws at a time.
_drawing = threading.RLock()


@contextlib.contextmanager
def drawing(style: Mapping[str, Any] = STYLE) -> Iterator[None]:
    """Draw with these settings; other threads that draw or save wait."""
    import matplotlib as mpl

    with _drawing, mpl.rc_context(dict(style)):
        yield


def new_figure(height: float, width: float = WIDTH) -> Figure:
    """Return an empty figure of this size (in), drawn off screen by the Agg canvas."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class Shared(Figure):
        """A figure that is saved while no other thread draws."""

        def savefig(self, *args: Any, **more: Any) -> None:
            with _drawing:
                super().savefig(*args, **more)

    fig = Shared(figsize=(width, height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(fig)
    return fig


def caption(fig: Figure, text: str) -> None:
    """Write a caption along the lower edge."""
    fig.text(
        0.012, 0.10 / fig.get_figheight(), textwrap.fill(text, 165), fontsize=8.2, color=MUTED,
        va="bottom",
    )  # fmt: skip


def title(ax: Axes, text: str, ink: str = INK) -> None:
    """Write a small bold title over the left end of the axes."""
    ax.set_title(text, loc="left", fontsize=9.5, fontweight="bold", color=ink, pad=6)
