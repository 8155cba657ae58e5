"""Estimates from a recording: each with its band over time, alarms marked."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import SignalError
from scenarios.figures import figstyle as fs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_recorded"]

Z95 = 1.96
SHOWN = {"N": ("speed [r/min]", 30 / np.pi), "PW": ("shaft power [kW]", 1e-3)}
_EDGES = ((-1, 3), (1, 97))  # signs of a band's edges, and their percentiles that are to be seen
Curve = tuple[str, np.ndarray, np.ndarray, np.ndarray]  # label, t, value, half width of the band


def plot_recorded(found: Any, note: str = "") -> Figure:
    """Draw what a recording was estimated to say, a panel for each quantity.

    Args:
        found: with ``gaspath``, ``machines`` and ``sequences``, as
            ``estimators.apu.recorded_estimate.RecordedEstimate``.
        note: added to the caption.

    Raises:
        SignalError: nothing was estimated.
    """
    panels = _panels(found)
    if not panels:
        raise SignalError("nothing was estimated that could be drawn")
    rows = -(-len(panels) // 2)
    with fs.drawing():
        fig = fs.new_figure(1.9 * rows + 0.9)
        place = fs.margins(fig, top=0.3, bottom=0.85)
        grid = fig.add_gridspec(rows, 2, left=0.075, right=0.985, hspace=0.55, wspace=0.2, **place)
        for k, (name, curves, alarms) in enumerate(panels):
            ax = fig.add_subplot(grid[k // 2, k % 2])
            for j, (label, t, value, half) in enumerate(curves):
                ink = fs.look(j)[0]
                ax.fill_between(t, value - half, value + half, color=ink, alpha=0.2, lw=0)
                ax.plot(t, value, color=ink, lw=1.2, label=label)
            _fitted(ax, curves)
            if len(curves) > 1:
                ax.legend(frameon=False, fontsize=8, ncols=len(curves))
            for when in alarms:
                ax.axvline(when, color=fs.LINE_INK[3], lw=1, ls=":")
            fs.title(ax, name)
            if k >= len(panels) - 2:
                ax.set_xlabel("time [s]")
        doubt = "" if found.believable else "NOT TO BE BELIEVED, see the doubts. "
        text = f"{doubt}Shade: 95 % band. Dotted: reports of a change. {note}"
        fs.caption(fig, text.strip())
        return fig


def _fitted(ax: Axes, curves: Sequence[Curve]) -> None:
    """Show all values, and of their bands what does not last a moment, as the prior's."""
    seen = [np.nanpercentile(v + sign * half, q) for _, _, v, half in curves for sign, q in _EDGES]
    every = np.concatenate([*(v for _, _, v, _ in curves), seen])
    if np.isfinite(every).any():
        fs.roomy(ax, every, 0.06)


def _panels(found: Any) -> list[tuple[str, list[Curve], Sequence[float]]]:
    """Title, curves and alarms of each panel."""
    out: list[tuple[str, list[Curve], Sequence[float]]] = []
    if found.gaspath is not None:
        e, alarms = found.gaspath, json.loads(found.gaspath.attrs["alarms"])
        for n in [str(v) for v in e if str(v).startswith("f_") and f"{v}_sigma" in e]:
            out.append((f"change of {n} [%]", [_curve(e, n, 100.0, 1.0)], alarms))
        out += [(SHOWN[n][0], [_curve(e, n, SHOWN[n][1])], alarms) for n in SHOWN if n in e]
    for k, e in found.machines.items():
        h, resets = [_curve(e, f"h_{p}", 1e3) for p in "abc"], json.loads(e.attrs["resets"])
        out.append((f"severity h [1e-3], generator {k}", h, resets))
        out.append((f"power of both [kW], generator {k}", [_curve(e, "P_total", 1e-3)], resets))
    for n, s in found.sequences.items():
        band = 100 * Z95 * s.sigma
        curve = ("", s.t, 100 * np.abs(s.unbalance), band)
        out.append((f"negative over positive sequence [%], {n}", [curve], s.alarms))
    return out


def _curve(e: Any, name: str, scale: float, offset: float = 0.0) -> Curve:
    value, sigma = (np.asarray(e[f"{name}{end}"].values, float) for end in ("", "_sigma"))
    return name, e["time"].values, scale * (value - offset), scale * Z95 * sigma
