"""Figures of a data set: one run as it is stored, and how each method confuses the classes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.units import RPM
from scenarios.figures import figstyle as fs

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_READ = (("T5", "$T_5$ [K]", 1.0), ("N", "Shaft speed [r/min]", RPM), ("Wf", "Fuel [g/s]", 1e3))


def plot_example(gas: Any, waves: Any, labels: Mapping[str, Any]) -> Figure:
    """Draw a run with a short circuit: gas path measured and true, currents around the onset.

    Args:
        gas, waves: the run's rows of both tables, by column.
        labels: ``onset``, ``generator``, ``class``, ``run``, ``phase``, ``h`` of the run.
    """
    onset, k = float(labels["onset"]), int(labels["generator"])
    t, t_w = np.asarray(gas["time"]), np.asarray(waves["time"])
    with fs.drawing():
        fig = fs.new_figure(4.8)
        axes = fig.subplots(2, 2).ravel()
        fig.subplots_adjust(
            left=0.075, right=0.985, hspace=0.42, wspace=0.2, **fs.margins(fig, top=0.34)
        )
        for ax, (name, label, scale) in zip(axes, _READ, strict=False):
            fs.change(ax, float(t[0]), onset, float(t[-1]))
            fs.measured(ax, t, scale * np.asarray(gas[f"X_s.{name}"]))
            if f"X_v.{name}" in gas:
                ax.plot(t, scale * np.asarray(gas[f"X_v.{name}"]), color=fs.LINE_INK[0], lw=1.4)
            ax.set_xlim(t[0], t[-1])
            ax.set_ylabel(label)
        ax = axes[3]
        fs.change(ax, float(t_w[0]), onset, float(t_w[-1]))
        near = (t_w > onset - 0.006) & (t_w < onset + 0.012)
        for p in "abc":
            y = np.asarray(waves[f"i_{p}_{k}"])
            look = {"color": fs.ABC[p], "lw": 1.2, "label": f"phase {p}"}
            ax.plot(t_w[near], y[near], **look)
        ax.set_xlim(onset - 0.006, onset + 0.012)
        ax.set_ylabel(f"Currents, generator {k} [A]")
        fs.legend(ax, "upper right", ncols=3)
        for ax in axes:
            ax.set_xlabel("Time [s]")
        words = f"Run {labels['run']}, class {labels['class']}: short circuit in phase "
        words += f"{labels['phase']} of generator {k}, h = {labels['h']:.2g}, at {onset:.2f} s. "
        fs.caption(fig, words + "Dots: X_s, as measured; lines: X_v, true.")
    return fig


def _matrix(ax: Axes, head: str, counts: np.ndarray, classes: Sequence[str], named: bool) -> None:
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    ax.imshow(share, cmap="Blues", vmin=0, vmax=1.25, aspect="equal")
    ax.grid(False)
    for i, j in np.argwhere(counts):
        ink = "white" if share[i, j] > 0.6 else fs.INK
        look = {"ha": "center", "va": "center", "fontsize": 7.0}
        ax.text(j, i, str(counts[i, j]), color=ink, **look)
    ax.set_xticks(range(len(classes)), classes, rotation=60, ha="right", rotation_mode="anchor")
    ax.set_yticks(range(len(classes)), classes if named else [""] * len(classes))
    ax.tick_params(labelsize=7.2, length=0)
    fs.title(ax, head)


def plot_confusions(panels: Sequence[tuple[str, np.ndarray]], classes: Sequence[str]) -> Figure:
    """Draw how often each class, by row, was called what, by column; numbers are runs."""
    with fs.drawing():
        fig = fs.new_figure(3.9)
        axes = fig.subplots(1, len(panels), squeeze=False)[0]
        fig.subplots_adjust(left=0.085, right=0.985, top=0.91, bottom=0.27, wspace=0.08)
        for k, (ax, (head, counts)) in enumerate(zip(axes, panels, strict=True)):
            _matrix(ax, head, counts, classes, k == 0)
        axes[0].set_ylabel("true class")
        fs.caption(fig, "Runs of units outside training; columns: what was said.")
    return fig
