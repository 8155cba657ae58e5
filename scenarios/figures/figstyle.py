"""The look that all figures share: size, palette, fonts; figures without a window; their axes.

Figures are made with the object-oriented interface of matplotlib: no window, no global state, so
that they work in threads, on servers and in notebooks alike.
"""

from __future__ import annotations

import contextlib
import textwrap
import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import DataError

if TYPE_CHECKING:
    import xarray as xr
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
MARKS = ("o", "s", "^", "D")
"""Marks of their points, of as many."""
BANDS = ("#eef2f7", "#e3ebf5", "#fdf1dd", "#fbe3e0")
"""Backgrounds of the phases of a run, in their order."""
ABC = {"a": "#d55e00", "b": "#0072b2", "c": "#009e73"}
"""Colours of the three phases; Okabe and Ito: told apart in every kind of colour blindness."""
NESTED = {"a": 3.4, "b": 2.2, "c": 1.0}
"""Line widths of the three phases: curves that coincide all stay visible."""
DASHED = (0, (4, 2))
PATCH: dict[str, str | float] = {"fc": "white", "ec": "none", "pad": 0.8}
"""Ground of words that stand on curves."""
OF_AXES = ("data", "axes fraction")
"""Coordinates ``xycoords`` of a point whose height is a fraction of the axes."""

MEASURED = "Dots: what noisy sensors read."
"""Of a caption, where :func:`measured` draws something."""

STYLE: dict[str, Any] = {
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


def look(k: int) -> tuple[str, str]:
    """Return colour and mark of curve k; beyond the last colour they pair anew, 16 in all."""
    n = len(LINE_INK)
    return LINE_INK[k % n], MARKS[(k + k // n) % n]


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


# ------------------------------------------------------------------------------ on a figure


def caption(fig: Figure, text: str) -> None:
    """Write a caption along the lower edge; one of many lines in small letters."""
    lines, size, y = textwrap.fill(text, 156), 8.2, 0.10 / fig.get_figheight()
    if lines.count("\n") > 1:
        lines, size = textwrap.fill(text, 190), 6.6
    fig.text(0.012, y, lines, fontsize=size, color=MUTED, va="bottom")


def margins(fig: Figure, *, top: float = 0.18, bottom: float = 0.98) -> dict[str, float]:
    """Return margins given in inches as fractions of the figure."""
    h = fig.get_figheight()
    return {"top": 1.0 - top / h, "bottom": bottom / h}


# ------------------------------------------------------------------------------ on axes


def title(ax: Axes, text: str) -> None:
    """Write a small bold title over the left end of the axes."""
    ax.set_title(text, loc="left", fontsize=9.5, fontweight="bold", color=INK, pad=6)


def remark(ax: Axes, text: str, at: Any, shift: tuple[float, float], **more: Any) -> None:
    """Write beside a point of the data, shifted by points; see :data:`OF_AXES`."""
    look = {"fontsize": 8.2, "color": INK, "textcoords": "offset points", **more}
    ax.annotate(text, at, xytext=shift, **look)


def above(ax: Axes, text: str, ink: str, x: float = 0.5, **more: Any) -> None:
    """Write centred over the axes, at a fraction of their width."""
    look = {"fontsize": 8.4, "color": ink, "ha": "center", "va": "bottom", **more}
    place: dict[str, Any] = {"xycoords": "axes fraction"} | {"textcoords": "offset points"}
    ax.annotate(text, (x, 1.0), xytext=(0, 4), **place | look)


def fit(text: str, letters: int, lines: int = 2) -> str:
    """Break a text into a few short lines at its spaces; cut it where that is not enough."""
    broken = textwrap.wrap(text, max(letters, 1), break_long_words=False, break_on_hyphens=False)
    if len(broken) <= lines and all(len(line) <= letters for line in broken):
        return "\n".join(broken)
    return text if len(text) <= letters else text[: max(letters - 1, 0)].rstrip() + "…"


def phase_colours(k: int) -> tuple[str, str]:
    """Return background and ink of the k-th phase of a run."""
    return BANDS[k % len(BANDS)], PHASE_INK[k % len(PHASE_INK)]


def bands(ax: Axes, rows: Sequence[dict[str, Any]], *, names: bool) -> None:
    """Shade the phases of a run, mark their boundaries, and name them above the axes."""
    lo, hi = rows[0]["start"], rows[-1]["end"]
    width = ax.get_position().width * WIDTH
    for k, p in enumerate(rows):
        band, ink = phase_colours(k)
        ax.axvspan(p["start"], p["end"], color=band, lw=0, zorder=0)
        if k:
            ax.axvline(p["start"], color=ink, lw=1.0, ls=DASHED, zorder=1.5)
        if names:
            share = (p["end"] - p["start"]) / (hi - lo)
            middle = ((p["start"] + p["end"]) / 2 - lo) / (hi - lo)
            text = fit(p["name"], max(int(width * share / 0.088), 1))
            above(ax, text, ink, middle, fontsize=8.8, fontweight="bold")
    ax.set_xlim(lo, hi)


def change(ax: Axes, lo: float, at: float, hi: float, k: int = 0) -> None:
    """Shade what is before and after a change, the beginning of phase k + 1."""
    (before, _), (after, ink) = phase_colours(k), phase_colours(k + 1)
    ax.axvspan(lo, at, color=before, lw=0, zorder=0)
    ax.axvspan(at, hi, color=after, lw=0, zorder=0)
    ax.axvline(at, color=ink, lw=1.0, ls=DASHED, zorder=1.5)


def roomy(ax: Axes, y: np.ndarray, margin: float) -> None:
    """Leave room around a curve; a constant is not blown up to its rounding errors."""
    lo, hi = float(np.nanmin(y)), float(np.nanmax(y))
    least = 1e-4 * max(abs(lo), abs(hi), 1e-12)
    room = margin * (hi - lo) + max(0.0, (least - (hi - lo)) / 2)
    ax.set_ylim(lo - room, hi + room)


def measured(ax: Axes, t: np.ndarray, y: np.ndarray | None) -> None:
    """Draw readings as dots behind the curves; None draws nothing."""
    if y is not None:
        look = {"ms": 3.0, "mew": 0, "alpha": 0.6, "zorder": 1.8, "rasterized": t.size > 5000}
        ax.plot(t, y, ".", color=MUTED, **look)


def legend(ax: Axes, where: str, handles: Sequence[Any] | None = None, **more: Any) -> None:
    """Draw a legend on a white ground."""
    look: dict[str, Any] = {"fontsize": 8.5, "framealpha": 0.9, "edgecolor": "none", **more}
    given = {} if handles is None else {"handles": handles}
    ax.legend(loc=where, frameon=True, **given, **look)


def few_ticks(ax: Axes, last: float, most: int = 6) -> None:
    """Have so few ticks along the time that their numbers, up to ``last`` s, do not touch."""
    from matplotlib.ticker import MaxNLocator

    bins = min(most, 6 if last < 100 else 4)
    ax.xaxis.set_major_locator(MaxNLocator(bins, steps=[1, 2, 5, 10]))


def abc_legend(ax: Axes, where: str) -> None:
    """Draw the legend of the three phases; ``"below"`` puts it right of the label of the axis."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=ABC[p], lw=2.2, label=f"phase {p}") for p in "abc"]
    tight: dict[str, Any] = {"handlelength": 1.4, "columnspacing": 1.1, "borderpad": 0.3}
    if where == "below":
        where, tight = "upper right", {**tight, "bbox_to_anchor": (1.005, -0.075), "borderpad": 0.0}
    legend(ax, where, handles, ncols=3, **tight)


def need(ds: xr.Dataset, names: Sequence[str]) -> None:
    """Raise DataError where a dataset lacks variables."""
    missing = [n for n in names if n not in ds]
    if missing:
        raise DataError(f"the dataset lacks {', '.join(missing)}")
