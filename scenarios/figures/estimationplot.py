"""Figures of the estimation studies, from plain arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import SignalError
from scenarios.figures import figstyle as fs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_alarms", "plot_gain_of_a_sensor"]


def plot_gain_of_a_sensor(
    prior: Any,
    curves: Mapping[str, Mapping[str, Any]],
    *,
    aims: Mapping[str, tuple[float, float]],
    note: str,
    sensor: str = "shaft power",
) -> Figure:
    """Draw how much one more sensor reduces the faults' error, and the null direction's with it.

    Args:
        prior: standard deviation of each fault before, fraction, shape (n,), increasing.
        curves: at most four by label; of each ``reduction`` of the rms standard deviation
            (fraction), ``null_before`` and ``null_after``, standard deviations along the null
            direction, (n,).
        aims: points (prior, reduction) to be reached, by the label of their curve.
        note: the caption.
        sensor: what was added, for the titles.

    Raises:
        SignalError: no curves, more than four, unknown labels, or arrays of other shapes.
    """

    prior = np.asarray(prior, float)
    if not 1 <= len(curves) <= len(fs.LINE_INK):
        raise SignalError(f"one to {len(fs.LINE_INK)} curves can be drawn, got {len(curves)}")
    for label, c in curves.items():
        shapes = [np.shape(c[k]) for k in ("reduction", "null_before", "null_after")]
        if any(s != prior.shape for s in shapes):
            raise SignalError(f"{label}: shapes {shapes}, {prior.shape} expected")
    if set(aims) - set(curves):
        raise SignalError(f"aims of unknown curves: {', '.join(sorted(set(aims) - set(curves)))}")
    with fs.drawing():
        fig = fs.new_figure(4.6)
        left, right = fig.subplots(1, 2)
        fig.subplots_adjust(left=0.065, right=0.985, top=0.90, bottom=0.255, wspace=0.2)
        ticks = [p for p in (0.5, 1, 2, 5, 10, 20) if 99 * prior[0] <= p <= 101 * prior[-1]]
        for ax in (left, right):
            ax.set_xscale("log")
            ax.set_xticks(ticks, [f"{t:g}" for t in ticks])
            ax.minorticks_off()
            ax.set_xlabel("prior of each factor, 1 sigma, %")
        percent = 100 * prior
        right.plot(percent, percent, color=fs.MUTED, lw=1.2, ls="--", label="before any reading")
        for (label, c), ink in zip(curves.items(), fs.LINE_INK, strict=False):
            for ax, key in ((left, "reduction"), (right, "null_after")):
                ax.plot(percent, 100 * np.asarray(c[key]), color=ink, lw=1.8, label=label)
            if label in aims:
                at, goal = aims[label]
                left.plot(100 * at, 100 * goal, marker="^", ms=9, mfc="white", mec=ink, mew=1.8)
                place, text = (100 * at, 100 * goal), f"aim {100 * goal:.0f} %"
                fs.remark(left, text, place, (-9, -3), ha="right", bbox=fs.PATCH)
        worst = max((c["null_before"] for c in curves.values()), key=lambda v: float(np.max(v)))
        without = f"without {sensor}"
        right.plot(percent, 100 * np.asarray(worst), "o", color=fs.INK, ms=3.5, label=without)
        left.set_ylim(0, 100)
        right.set_yscale("log")
        seen = [np.min(c["null_after"]) for c in curves.values()]
        low, high = 50 * min(seen), 101 * prior[-1]
        levels = [t for t in (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20) if low <= t <= high]
        right.set_yticks(levels, [f"{t:g}" for t in levels])
        right.minorticks_off()
        left.set_ylabel("reduction of the rms error, %")
        right.set_ylabel("1 sigma along the null direction, %")
        fs.title(left, f"What {sensor} takes off the error of the health factors")
        fs.title(right, "What remains along the null direction")
        left.legend(frameon=False, fontsize=8.5, loc="upper left")
        right.legend(frameon=False, fontsize=8.5, loc="upper left")
        fs.caption(fig, note)
    return fig


def plot_alarms(groups: Mapping[str, Sequence[Mapping[str, Any]]], note: str) -> Figure:
    """Draw the rate of true alarms, with its 95 % interval, over the latency, by fault and size.

    Args:
        groups: rows by axis label; of each ``kind``, ``value``, ``share``, ``low``, ``high`` and
            ``late`` (s, None where there was no alarm).
        note: the caption.
    """
    with fs.drawing():
        fig = fs.new_figure(5.4)
        axes = fig.subplots(2, len(groups), squeeze=False)
        place = fs.margins(fig, top=0.35, bottom=1.0)
        fig.subplots_adjust(left=0.07, right=0.985, hspace=0.12, wspace=0.22, **place)
        for (label, rows), (rate, late) in zip(groups.items(), axes.T, strict=True):
            kinds = list(dict.fromkeys(x["kind"] for x in rows))
            for k, kind in enumerate(kinds):
                own = [x for x in rows if x["kind"] == kind]
                ink, mark = fs.look(k)
                look = {"color": ink, "marker": mark, "ms": 5, "lw": 1.6}
                # side by side, so that those of one size are told apart
                at = np.array([x["value"] for x in own]) * (1 + 0.04 * (k - (len(kinds) - 1) / 2))
                share = np.array([100 * x["share"] for x in own])
                ends = np.array([[100 * x["low"], 100 * x["high"]] for x in own]).T
                rate.errorbar(
                    at, share, np.abs(ends - share), capsize=2, elinewidth=0.8, label=kind, **look
                )
                ms = [np.nan if x["late"] is None else 1e3 * x["late"] for x in own]
                late.plot(at, ms, **look)
            for ax in (rate, late):
                ax.set_xscale("log")
            values = sorted({x["value"] for x in rows})
            late.set_xlim(0.75 * values[0], 1.33 * values[-1])
            rate.set_xlim(late.get_xlim())
            rate.set_xticks(values, [""] * len(values))
            late.set_xticks(values, [f"{v:g}" for v in values])
            for ax in (rate, late):
                ax.minorticks_off()
            rate.set_ylim(-4, 104)
            late.set_ylim(0, max(100.0, late.get_ylim()[1]))
            late.set_xlabel(f"{label} [{_unit(rows)}]")
            fs.legend(rate, "lower right")
        fs.title(axes[0, 0], "True alarms [% of runs]")
        fs.title(axes[1, 0], "Latency, median [ms]")
        fs.caption(fig, note)
    return fig


def _unit(rows: Sequence[Mapping[str, Any]]) -> str:
    return "A" if any(x["value"] >= 1 for x in rows) else "-"
