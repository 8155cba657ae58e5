"""Measure what the package promises to be fast at, with the accuracy of every measured answer.

Times are medians, each part's ratios taken in one run; compiling and loading happen before.  An
answer that is fast and wrong counts as missed: every row has the error of the very results that
were timed, against something slower that shares as little as possible with them.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from apu_casadi.core.errors import ScenarioError, nearest
from scenarios.bench.linearity import Curves, linear, linear_rows
from scenarios.bench.measuring import PARTS, Part, Row, Size
from scenarios.shell.computer import machine
from scenarios.shell.template import Template
from scenarios.validation.comparison import SkippedError

LINEAR = "linear"  # measures curves, not rows


def parts(*, peers: bool = False) -> dict[str, Part]:
    """Return the parts that measure this package, or those that measure other programs."""
    return {name: run for name, (peer, run) in PARTS.all().items() if peer == peers}


def known() -> list[str]:
    """Return the names of all parts."""
    return [*parts(), LINEAR, *parts(peers=True)]


@dataclass(frozen=True)
class Report:
    """Rows by part, the linearity curves, what was skipped and why, and where it ran."""

    rows: dict[str, list[Row]]
    curves: Curves
    skipped: dict[str, str]
    machine: dict[str, Any]
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Return the report for JSON."""
        table = {
            name: [
                {k: _plain(v) for k, v in dataclasses.asdict(r).items()} | {"met": r.met}
                for r in rows
            ]
            for name, rows in self.rows.items()
        }
        curves = {k: {"x": x.tolist(), "seconds": y.tolist()} for k, (x, y) in self.curves.items()}
        where = {"machine": self.machine, "seconds": self.seconds}
        return {"rows": table, "curves": curves, "skipped": self.skipped, **where}


def _plain(v: Any) -> Any:
    return None if isinstance(v, float) and not math.isfinite(v) else v


def run(
    names: Sequence[str] | None = None,
    *,
    size: Size | None = None,
    peers: bool = False,
    say: Callable[[str], None] | None = None,
) -> Report:
    """Measure parts, all of them by default; a peer that is not installed is skipped.

    Raises:
        ScenarioError: unknown name of a part.
    """
    size = Size() if size is None else size
    others = parts(peers=True)
    wanted = [*parts(), LINEAR, *(others if peers else ())] if names is None else list(names)
    for n in wanted:
        if n not in known():
            raise ScenarioError(f"unknown part {n!r} {nearest(n, known())}")
    start = time.perf_counter()
    where = machine()
    rows: dict[str, list[Row]] = {}
    curves: Curves = {}
    skipped = {}
    for n in wanted:
        if say is not None:
            say(n)
        try:
            if n == LINEAR:
                curves = linear(size)
                rows[n] = linear_rows(curves)
            else:
                rows[n] = {**parts(), **others}[n](size)
        except SkippedError as reason:
            skipped[n] = str(reason)
    return Report(rows, curves, skipped, where, time.perf_counter() - start)


TEXT = Template.of("benchmarks.md")


def cells(r: Row) -> dict[str, Any]:
    """Return the values of a row of the page."""
    sign, judged = ">=" if r.more else "<=", r.error_target != 0
    return vars(r) | {
        "target": "-" if r.target is None else f"{sign} {r.target:g} {r.unit}",
        "error": r.error if judged else None,
        "error_target": r.error_target if judged else None,
        "verdict": "met" if r.met else "inaccurate" if not r.accurate else "missed",
        "peer": r.peer or "-",
    }


def table(report: Report) -> str:
    """Return the report as a text table."""
    rows = [cells(r) for rows in report.rows.values() for r in rows]
    body = [row[:-1] for row in TEXT.rows("rows", rows)]  # what the error is, on the page only
    widths = [max(len(row[k]) for row in body) for k in range(len(body[0]))]
    padded = ([c.ljust(w) for c, w in zip(row, widths, strict=True)] for row in body)
    lines = ["  ".join(row).rstrip() for row in padded]
    return "\n".join([*lines, "", _where(report.machine), *_left_out(report)])


def _where(m: Mapping[str, Any]) -> str:
    versions = ", ".join(f"{k} {v}" for k, v in m["versions"].items())
    busy = f"; load before the start {m['load_before']}" if m["load_before"] > 0.3 else ""
    return f"{m['processor']}, {m['cores']} cores, {m['system']}; {versions}{busy}"


def _left_out(report: Report) -> list[str]:
    return [f"skipped: {n}: {why}" for n, why in report.skipped.items()]


def page(report: Report, image: str | None) -> str:
    """Return the page BENCHMARKS.md."""
    m = report.machine
    busy = " " + TEXT.text("busy", **m) if m["load_before"] > 0.3 else ""
    where = _where({**m, "load_before": 0.0})
    rows = [cells(r) for rows in report.rows.values() for r in rows]
    parts = [TEXT.text("top", seconds=report.seconds, where=where, backend=m["backend"], busy=busy)]
    parts.append(TEXT.table("rows", rows, right=(2, 3)))
    if image is not None:
        parts.append(TEXT.text("linear", image=image))
    if report.skipped:
        parts += ["## Skipped", "\n".join(f"- {n}: {why}" for n, why in report.skipped.items())]
    return "\n\n".join(parts) + "\n"
