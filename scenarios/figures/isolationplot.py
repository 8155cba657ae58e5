"""Confusion matrices of fault isolation, and how the share of right answers depends on the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import SignalError
from scenarios.figures.figstyle import INK, LINE_INK, MUTED, caption, drawing, new_figure, title

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TARGET = 0.8  # of kappa, drawn as a line


def _matrix(ax: Axes, head: str, scores: Mapping[str, Any], labelled: bool) -> None:
    """One confusion matrix: per cent of the true class, by row."""
    c = np.asarray(scores["confusion"], float)
    n = len(scores["classes"])
    rows = c.sum(1, keepdims=True)
    if c.shape != (n, n) or not (rows > 0).all():
        raise SignalError(f"{head}: {n} x {n} counts with no empty row expected, got {c.shape}")
    share = c / rows
    # half transparent shades of one ink, so that print without colour still tells
    ax.imshow(share, cmap="Blues", vmin=0, vmax=1.25, aspect="equal")
    ax.grid(False)
    for i in range(n):
        for j in range(n):
            if share[i, j] >= 0.005:
                ink = "white" if share[i, j] > 0.6 else INK
                place = {"ha": "center", "va": "center", "fontsize": 6.8}
                ax.text(j, i, f"{100 * share[i, j]:.0f}", color=ink, **place)
    ax.set_xticks(range(n), scores["classes"], rotation=60, ha="right", rotation_mode="anchor")
    ax.set_yticks(range(n), scores["classes"] if labelled else [""] * n)
    ax.tick_params(labelsize=7.2, length=0)
    low, high = scores["kappa_95"]
    title(ax, f"{head}\nκ = {scores['kappa']:.3f} ({low:.3f} to {high:.3f})")


def plot_confusion(panels: Sequence[tuple[str, Mapping[str, Any]]], note: str) -> Figure:
    """Draw confusion matrices side by side, true class by row, in per cent of it.

    Args:
        panels: (title, scores) with ``classes``, ``confusion``, ``kappa``, ``kappa_95``; one to
            three.
        note: the caption.

    Raises:
        SignalError: no panels or more than three, or a matrix that does not fit its classes.
    """

    if not 1 <= len(panels) <= 3:
        raise SignalError(f"one to three confusion matrices can be drawn, got {len(panels)}")
    with drawing():
        fig = new_figure(5.3)
        axes = fig.subplots(1, len(panels), squeeze=False)[0]
        fig.subplots_adjust(left=0.155, right=0.985, top=0.88, bottom=0.30, wspace=0.08)
        for k, (ax, (head, scores)) in enumerate(zip(axes, panels, strict=True)):
            _matrix(ax, head, scores, k == 0)
        axes[0].set_ylabel("true class")
        caption(fig, note)
    return fig


def plot_kappa(
    panels: Sequence[tuple[str, str, Sequence[Mapping[str, Any]]]],
    note: str,
) -> Figure:
    """Draw Cohen's kappa against what was changed, with 95 % intervals.

    Args:
        panels: (title, label of x, rows with ``value``, ``kappa``, ``kappa_95``), one to four;
            values must be positive, their axis is logarithmic.
        note: the caption.

    Raises:
        SignalError: no panels or more than four, fewer than two rows, a value <= 0.
    """

    if not 1 <= len(panels) <= 4:
        raise SignalError(f"one to four panels can be drawn, got {len(panels)}")
    with drawing():
        fig = new_figure(3.9)
        axes = fig.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        fig.subplots_adjust(left=0.06, right=0.985, top=0.88, bottom=0.26, wspace=0.08)
        for ax, (head, label, rows) in zip(axes, panels, strict=True):
            x = np.array([r["value"] for r in rows], float)
            if x.size < 2 or not (x > 0).all():
                raise SignalError(f"{head}: two or more positive values expected, got {x}")
            k = np.array([r["kappa"] for r in rows])
            low, high = np.array([r["kappa_95"] for r in rows]).T
            ax.axhline(TARGET, color=MUTED, lw=1.0, ls="--", zorder=1)
            ax.fill_between(x, low, high, color=LINE_INK[0], alpha=0.18, lw=0)
            ax.plot(x, k, "o-", color=LINE_INK[0], ms=4, lw=1.4)
            ax.set_xscale("log")
            ax.set_xticks(x, [f"{v:g}" for v in x])
            ax.minorticks_off()
            ax.set_xlabel(label)
            title(ax, head)
        axes[0].set_ylim(min(0.0, axes[0].get_ylim()[0]), 1.04)
        axes[0].set_ylabel("Cohen's κ")
        caption(fig, note)
    return fig
