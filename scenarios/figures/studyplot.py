"""Figures of estimators on trial: errors over their bound, consistency, coverage, rare alarms."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import SignalError
from scenarios.figures import figstyle as fs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_consistency", "plot_coverage", "plot_null", "plot_rate"]

_BAND = "#e8f0f7"
_PATCH = {"fc": "white", "ec": "none", "pad": 0.6, "alpha": 0.85}


def _same_length(head: str, t: Any, curves: Mapping[str, Any]) -> np.ndarray:
    at = np.asarray(t, float)
    wrong = [n for n, v in curves.items() if np.shape(v) != at.shape]
    if not curves or wrong:
        raise SignalError(
            f"{head}: curves of {at.size} values expected; wrong: "
            f"{', '.join(wrong) or 'none given'}"
        )
    return at


def plot_consistency(
    panels: Sequence[
        tuple[
            str, Any, Mapping[str, Any], float | None, Mapping[str, tuple[Any, tuple[float, float]]]
        ]
    ],
    note: str,
    *,
    label: str = "RMSE / bound",
) -> Figure:
    """Draw errors over their bound, and under them NEES and NIS over what is expected.

    Args:
        panels: one to four of (title, instants in s (n,), curves of RMSE over bound by label, limit
            that is asked for or None, and by label (mean over its expectation (n,), 95 % band of
            it)).
        note: the caption.
        label: of the upper axis.

    Raises:
        SignalError: no panels or more than four, or curves of other lengths.
    """

    if not 1 <= len(panels) <= 4:
        raise SignalError(f"one to four panels can be drawn, got {len(panels)}")
    with fs.drawing():
        fig = fs.new_figure(5.2)
        grid = fig.subplots(2, len(panels), squeeze=False, sharex="col")
        heads = [textwrap.fill(head, 88 // len(panels)) for head, *_ in panels]
        roof = 0.88 if any("\n" in h for h in heads) else 0.925
        space = {"bottom": 0.185, "wspace": 0.2, "hspace": 0.12}
        fig.subplots_adjust(left=0.065, right=0.985, top=roof, **space)
        for k, (head, t, ratios, limit, checks) in enumerate(panels):
            at = _same_length(head, t, {**ratios, **{n: v for n, (v, _) in checks.items()}})
            top, low = grid[:, k]
            top.axhline(1, color=fs.INK, lw=0.8)
            if limit is not None:
                top.axhline(limit, color=fs.MUTED, lw=1.2, ls="--")
                look = {"color": fs.MUTED, "bbox": _PATCH, "ha": "right"}
                fs.remark(top, f"goal {limit:g}", (at[-1], limit), (0, 2), fontsize=8, **look)
            for j, (name, v) in enumerate(ratios.items()):
                ink, mark = fs.look(j)
                top.plot(at, v, mark, ls="-", color=ink, lw=1.2, ms=2.6, label=name)
            reach = max(float(np.max(v)) for v in ratios.values())
            if reach > 5:
                top.set_yscale("log")
            else:
                top.set_ylim(0, 1.25 * max(reach, limit or 1.0))
            fs.title(top, heads[k])
            for j, (name, (v, band)) in enumerate(checks.items()):
                ink, mark = fs.look(j)
                low.axhspan(*band, color=ink, alpha=0.07, lw=0)
                for edge in band:
                    low.axhline(edge, color=ink, lw=0.7, ls=":")
                low.plot(at, v, mark, ls="-", color=ink, lw=1.2, ms=2.6, label=name)
            low.axhline(1, color=fs.INK, lw=0.8)
            if any(float(np.max(v)) > 5 for v, _ in checks.values()):
                low.set_yscale("log")
            low.set_xlabel("time [s]")
            if k == 0:
                top.set_ylabel(label)
                low.set_ylabel("mean over expected")
                top.legend(frameon=False, fontsize=8, ncols=2, loc="lower left")
                if checks:
                    low.legend(frameon=True, edgecolor="none", fontsize=8, ncols=2, loc="best")
        fs.caption(fig, note)
    return fig


def plot_null(
    panels: Sequence[tuple[str, Any, Mapping[str, Any]]], note: str, *, ylabel: str
) -> Figure:
    """Draw what is claimed and what is right along one direction, by time.

    Args:
        panels: one to three of (title, instants in s (n,), up to four curves by label).
        note: the caption.
        ylabel: of the curves.

    Raises:
        SignalError: no panels or more than three, or curves of other lengths.
    """

    if not 1 <= len(panels) <= 3:
        raise SignalError(f"one to three panels can be drawn, got {len(panels)}")
    with fs.drawing():
        fig = fs.new_figure(3.9)
        axes = fig.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        fig.subplots_adjust(left=0.065, right=0.985, top=0.89, bottom=0.255, wspace=0.08)
        for ax, (head, t, curves) in zip(axes, panels, strict=True):
            at = _same_length(head, t, curves)
            for j, (name, v) in enumerate(curves.items()):
                ink, mark = fs.look(j)
                ax.plot(at, v, mark, ls="-", color=ink, lw=1.3, ms=3, label=name)
            ax.set_xlabel("time [s]")
            ax.set_ylim(bottom=0)
            fs.title(ax, head)
        axes[0].set_ylabel(ylabel)
        axes[0].legend(frameon=False, fontsize=8.5, loc="lower left")
        fs.caption(fig, note)
    return fig


def plot_coverage(
    groups: Mapping[str, Mapping[str, tuple[float, float, float]]],
    note: str,
    *,
    goal: tuple[float, float],
    level: float,
) -> Figure:
    """Draw how often intervals hold the truth, with the binomial interval of that share.

    Args:
        groups: by label of the group, then of the quantity: covered share, and its interval.
        note: the caption.
        goal: shares within which they should lie; level : what is claimed.

    Raises:
        SignalError: nothing to draw, or groups of different quantities.
    """

    names = [list(g) for g in groups.values()]
    if not names or not names[0] or any(n != names[0] for n in names):
        raise SignalError(f"groups of the same quantities expected, got {names}")
    with fs.drawing():
        fig = fs.new_figure(3.6)
        ax = fig.subplots()
        fig.subplots_adjust(left=0.085, right=0.985, top=0.89, bottom=0.235)
        ax.axhspan(100 * goal[0], 100 * goal[1], color=_BAND, lw=0)
        ax.axhline(100 * level, color=fs.INK, lw=0.8)
        width = len(names[0]) + 1
        for k, (head, group) in enumerate(groups.items()):
            for j, (name, (share, low, high)) in enumerate(group.items()):
                ends = [[100 * (share - low)], [100 * (high - share)]]
                ink, mark = fs.look(j)
                look = {"fmt": mark, "color": ink, "ms": 5, "capsize": 3}
                label = name if k == 0 else None
                ax.errorbar(k * width + j, 100 * share, ends, lw=1.2, label=label, **look)
            place = {"ha": "center", "va": "top", "xycoords": fs.OF_AXES}
            fs.remark(ax, head, (k * width + (width - 2) / 2, 0), (0, -14), fontsize=9, **place)
        ax.set_xticks([])
        ax.set_xlim(-0.8, width * len(groups) - 1.2)
        ax.set_ylabel(f"{100 * level:.0f} % intervals that\nhold the truth [%]")
        lowest = min(low for g in groups.values() for _, low, _ in g.values())
        floor = min(lowest, goal[0]) - 0.12 * (1 - min(lowest, goal[0]))
        ax.set_ylim(100 * floor - 2, 101.5)  # room for the legend
        ax.legend(frameon=False, fontsize=8.5, ncols=4, loc="lower left")
        fs.title(ax, "Coverage")
        fs.caption(fig, note)
    return fig


def plot_rate(
    z: Any, counts: Any, expected: Any, hours: float, threshold: float, goal: float, note: str
) -> Figure:
    """Draw how often a statistic of a healthy machine rises past a level, and its continuation.

    Args:
        z, counts, expected: levels, up-crossings counted, and by the fitted law, shapes (n,).
        hours: of observation.
        threshold: level of the alarm; goal : alarms per hour that are allowed.
        note: the caption.

    Raises:
        SignalError: arrays of other lengths, or no hours.
    """

    z = _same_length("rate", z, {"counts": counts, "expected": expected})
    c, e = np.asarray(counts, float), np.asarray(expected, float)
    if not hours > 0:
        raise SignalError(f"hours must be > 0, got {hours!r}")
    with fs.drawing():
        fig = fs.new_figure(3.7)
        ax = fig.subplots()
        fig.subplots_adjust(left=0.075, right=0.985, top=0.89, bottom=0.255)
        fitted = "Rice's formula, one constant fitted"
        ax.plot(z, e / hours, color=fs.LINE_INK[0], lw=1.6, label=fitted)
        seen = c > 0
        error = np.sqrt(c[seen])
        ends = [np.minimum(error, 0.999 * c[seen]) / hours, error / hours]
        look = {"fmt": "o", "color": fs.LINE_INK[1], "ms": 4.5, "capsize": 3, "lw": 1.2}
        ax.errorbar(z[seen], c[seen] / hours, ends, label="counted", **look)
        ax.axhline(goal, color=fs.MUTED, lw=1.2, ls="--")
        fs.remark(ax, f"goal: {goal:g} an hour", (z[0], goal), (2, 3), color=fs.MUTED)
        ax.axvline(threshold, color=fs.INK, lw=1.0)
        fs.remark(
            ax, "alarm", (threshold, 0.97), (4, 0), fontsize=8.5, va="top", xycoords=fs.OF_AXES
        )
        ax.set_yscale("log")
        ax.set_xlabel("level of the largest h over its standard deviation")
        ax.set_ylabel("rises past it, per hour")
        ax.legend(frameon=False, fontsize=8.5, loc="lower left")
        fs.title(ax, "False alarms of a healthy machine")
        fs.caption(fig, note)
    return fig
