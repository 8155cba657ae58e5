"""Eigenvalues of linear models in the complex plane."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import SignalError
from scenarios.figures import figstyle as fs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from apu_casadi.unit.linearmodel import LinearModel

_LINEAR = 0.3  # 1/s; between plus and minus this the axes are linear


def plot_eigenvalues(models: Mapping[str, LinearModel], note: str = "") -> Figure:
    """Draw the eigenvalues of one or more models, named by the state that takes most part.

    Both axes are logarithmic but near zero, since the machine's fastest mode decays 10 000 times
    as fast as the governor's; on such axes a line of constant damping ratio is not straight.

    Args:
        models: up to four linear models by label; the first one's modes are named.
        note: added to the caption: where the models hold.

    Raises:
        SignalError: no models, or more than four.
    """
    from matplotlib.ticker import FixedLocator, FuncFormatter

    if not 1 <= len(models) <= len(fs.MARKS):
        raise SignalError(f"one to {len(fs.MARKS)} models can be drawn, got {len(models)}")
    modes = {label: m.eigenvalues() for label, m in models.items()}
    values = np.array([e.value for es in modes.values() for e in es])
    with fs.drawing():
        fig = fs.new_figure(5.6)
        ax = fig.add_axes((0.075, 0.19, 0.91, 0.735))
        ax.set_xscale("symlog", linthresh=_LINEAR, linscale=0.6)
        ax.set_yscale("symlog", linthresh=_LINEAR, linscale=0.6)
        left = 2.0 * max(1.0, float(-values.real.min()))
        right = max(2 * _LINEAR, 3 * float(values.real.max()))
        high = 10 ** np.ceil(np.log10(max(10.0, float(np.abs(values.imag).max())) * 1.3))
        ax.set_xlim(-left, right)
        ax.set_ylim(-high, high)
        ax.axvspan(0, right, color="#fbe3e0", lw=0, zorder=0)
        ax.axvline(0, color=fs.INK, lw=1.0, zorder=1)
        ax.axhline(0, color=fs.MUTED, lw=0.8, zorder=1)
        decay = np.geomspace(1e-2, left, 300)
        for zeta in (0.1, 0.5, 0.9):
            w = decay * np.sqrt(1 / zeta**2 - 1)
            for sign in (1, -1):
                ax.plot(-decay, sign * w, color=fs.MUTED, lw=0.7, ls=(0, (3, 3)), zorder=1)
            k = int(np.argmin(np.abs(w - 2.0 * np.sqrt(high))))
            if decay[k] < 0.6 * left:
                small = {"color": fs.MUTED, "ha": "center", "va": "center", "bbox": fs.PATCH}
                at = (-decay[k], -w[k])
                fs.remark(ax, f"ζ = {zeta:g}", at, (0, 0), fontsize=7.4, zorder=3, **small)
        for k, (label, es) in enumerate(modes.items()):
            v = np.array([e.value for e in es])
            both = np.concatenate([v, v[v.imag > 0].conj()])
            ink = fs.LINE_INK[k % len(fs.LINE_INK)]
            look = {"ms": 6, "mfc": "none"} if k else {"ms": 7, "mfc": ink}
            mark = {"marker": fs.MARKS[k], "ls": "none", "mec": ink, "mew": 1.5}
            ax.plot(both.real, both.imag, label=label, zorder=5 + k, **look, **mark)
        _name_modes(ax, next(iter(modes.values())))
        ticks = [s * 10.0**e for e in range(0, 7) for s in (1, -1)]

        def words(v: float, _: Any = None) -> str:
            return f"{v:g}" if abs(v) < 1e4 else f"{v / 1e3:g}k"

        for axis in (ax.xaxis, ax.yaxis):
            lo, hi = sorted(axis.get_view_interval())
            axis.set_major_locator(FixedLocator([t for t in [0.0, *ticks] if lo <= t <= hi]))
            axis.set_minor_locator(FixedLocator([]))
            axis.set_major_formatter(FuncFormatter(words))
        ax.set_xlabel("Real part [1/s]")
        ax.set_ylabel("Imaginary part [rad/s]")
        which = dict.fromkeys(m.name.replace("_", " ") for m in models.values())
        fs.title(ax, f"Eigenvalues: {', '.join(which)}")
        if len(models) > 1:
            ax.legend(
                loc="lower left", fontsize=8.2, frameon=True, framealpha=0.92, edgecolor="none"
            )
        text = (
            "Named by the state that takes most part in the mode. Shaded: unstable. Dashed: "
            f"constant damping ratio. Both axes are logarithmic beyond ±{_LINEAR:g}."
        )
        fs.caption(fig, f"{text} {note}".strip())
        return fig


def _name_modes(ax: Any, modes: Any) -> None:
    """Name the modes; those on the real axis alternate between heights, so that all can be read."""
    heights = (14, 28, 42, -20, -34)
    real = 0
    for e in modes:
        first = next(iter(e.participation), "")
        if e.value.imag > 0:
            fs.remark(ax, first, (e.value.real, e.value.imag), (8, 4), fontsize=8.0, zorder=8)
            continue
        line = {"arrowstyle": "-", "color": fs.MUTED, "lw": 0.6, "shrinkB": 3}
        look = {"fontsize": 8.0, "ha": "center", "zorder": 8, "arrowprops": line}
        fs.remark(ax, first, (e.value.real, 0), (0, heights[real % len(heights)]), **look)
        real += 1
