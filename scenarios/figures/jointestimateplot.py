"""Truth, estimate and confidence band along a joint run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import SignalError
from apu_casadi.gaspath.health import HEALTH_FACTORS
from scenarios.figures import figstyle as fs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["NAMES", "plot_joint_estimate"]

SEVERITIES = ("h_a", "h_b", "h_c")
_PANELS: tuple[tuple[str, str, str, float], ...] = (
    *((n, f"{h.component} {h.quantity}", "change [%]", 100.0) for n, h in HEALTH_FACTORS.items()),
    ("N", "shaft speed", "r/min", 30 / np.pi),
    ("P_total", "mechanical power of both generators", "kW", 1e-3),
)
NAMES = (*(p[0] for p in _PANELS), *SEVERITIES)
"""Quantities that are drawn; of each the estimate, ``<name>_sigma`` and ``<name>_true``."""
Z95 = 1.96


def _curve(
    ax: Axes, t: np.ndarray, data: Mapping[str, np.ndarray], name: str, scale: float, ink: str
) -> np.ndarray:
    """Draw band, estimate and truth; return estimate and truth, for the axis."""
    offset = 1.0 if name.startswith("f_") else 0.0
    mean, sigma, true = (
        np.asarray(data[n], float) for n in (name, f"{name}_sigma", f"{name}_true")
    )
    value, true, band = scale * (mean - offset), scale * (true - offset), scale * Z95 * sigma
    ax.fill_between(t, value - band, value + band, color=ink, alpha=0.2, lw=0, zorder=1)
    ax.plot(t, value, color=ink, lw=1.2, zorder=2)
    ax.plot(t, true, color=fs.INK, lw=1.1, ls=fs.DASHED, zorder=3)
    # a band that is wide for an instant, after a fault, need not fit into the picture
    usual = np.nanquantile(band, 0.98)
    slim = band <= usual
    return np.concatenate([value[slim], true, (value - band)[slim], (value + band)[slim]])


def plot_joint_estimate(
    t: Any,
    data: Mapping[str, Any],
    *,
    phases: Sequence[tuple[str, float]] = (),
    alarms: Sequence[float] = (),
    note: str = "",
) -> Figure:
    """Draw health factors, speed, power and severities with their 95 % bands over time.

    Args:
        t: instants, s, shape (K,).
        data: arrays (K,) by name: for each of :data:`NAMES` the estimate, ``<name>_sigma`` and
            ``<name>_true``, SI.
        phases: (name, start in s) of the run's phases, marked by lines.
        alarms: instants, s, at which a change of health was reported, marked below.
        note: added to the caption.

    Raises:
        SignalError: a name is missing, or an array has another length.
    """

    t = np.asarray(t, float)
    needed = [f"{n}{end}" for n in NAMES for end in ("", "_sigma", "_true")]
    missing = [n for n in needed if n not in data]
    if missing:
        raise SignalError(f"to draw the estimate, {', '.join(missing)} are missing")
    wrong = [n for n in needed if np.shape(data[n]) != t.shape]
    if wrong:
        raise SignalError(f"{t.size} values expected of {', '.join(wrong)}")
    with fs.drawing():
        fig = fs.new_figure(8.9)
        grid = fig.add_gridspec(
            4, 2, left=0.07, right=0.985, top=0.955, bottom=0.12, hspace=0.36, wspace=0.15
        )
        axes: list[Axes] = []
        for k, (name, words, unit, scale) in enumerate(_PANELS):
            ax = fig.add_subplot(grid[k // 2, k % 2], sharex=axes[0] if axes else None)
            axes.append(ax)
            seen = _curve(ax, t, data, name, scale, fs.LINE_INK[0])
            _fit(ax, seen)
            ax.set_ylabel(unit)
            fs.title(ax, f"{words}, {name}")
        ax = fig.add_subplot(grid[3, :], sharex=axes[0])
        axes.append(ax)
        every = [
            _curve(ax, t, data, n, 1e3, ink)
            for n, ink in zip(SEVERITIES, fs.LINE_INK, strict=False)
        ]
        for n, ink in zip(SEVERITIES, fs.LINE_INK, strict=False):
            ax.plot([], [], color=ink, lw=3, label=n)
        ax.legend(frameon=False, fontsize=8.5, ncols=3, loc="lower right", bbox_to_anchor=(1, 0.98))
        _fit(ax, np.concatenate(every), roof=True)
        ax.set_ylabel("h [1e-3]")
        fs.title(ax, "severity of a turn-to-turn short circuit, by phase")
        ax.set_xlim(t[0], t[-1])
        for ax in axes:
            for _, start in phases[1:]:
                ax.axvline(start, color=fs.MUTED, lw=0.9, ls=":", zorder=0.9)
            for when in alarms:
                place = {"clip_on": False, "zorder": 5, "transform": ax.get_xaxis_transform()}
                ax.plot(when, 0.0, marker="^", ms=6, color=fs.LINE_INK[3], **place)
        for ax in axes[:4]:
            ax.tick_params(labelbottom=False)
        axes[-1].set_xlabel("time [s]")
        for name, start in phases:
            fs.remark(
                axes[-1], name, (start, 1.0), (3, -3), xycoords=fs.OF_AXES, va="top", color=fs.MUTED
            )
        text = "Dashed: truth. Line and shade: estimate and its 95 % band. Dotted: phases."
        if len(alarms):
            text += " Triangles: a change of health was reported."
        fs.caption(fig, f"{text} {note}".strip())
    return fig


def _fit(ax: Axes, seen: np.ndarray, roof: bool = False) -> None:
    """Set the vertical limits to what is shown, with some air; ``roof``: and room for words."""
    low, high = float(np.nanmin(seen)), float(np.nanmax(seen))
    air = 0.08 * (high - low) or 1.0
    ax.set_ylim(low - air, high + (1 + 2.5 * roof) * air)
