"""The page ``VALIDATION.md``, made by ``apu validate --write VALIDATION.md``.

Timings stay out of it, so that two runs of one version write the same page.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from scenarios.shell.template import Template
from scenarios.validation.comparison import Row, sections

TEXT = Template.of("validation.md")
KIND_WORDS = dict(row.split(" | ") for row in TEXT.raw("kinds").splitlines())


def cells(r: Row) -> dict[str, Any]:
    """Return the values of a row of the page."""
    return vars(r) | {
        "quantity": r.quantity.replace("|", "\\|"),
        "reference": "" if math.isnan(r.reference) else f"{r.reference:.7g}",
        "ours": f"{r.ours:.7g}" if r.kind != "check" or r.unit != "1" else _error(r.ours),
        "error": _error(r.error, "+"),
        "passed": "ok" if r.passed else "**SHORT**",
    }


def _error(x: float, sign: str = "") -> str:
    """Show an error; below 1e-10 it is rounding, and another number on every processor."""
    return "0" if x == 0 else "< 1e-10" if abs(x) < 1e-10 else f"{x:{sign}.1e}"


def _tested(rows: Sequence[Row]) -> list[Row]:
    return [r for r in rows if math.isfinite(r.tolerance)]


def page(report: Mapping[str, Sequence[Row]], skipped: Mapping[str, str] | None = None) -> str:
    """Return the page.

    Args:
        report: rows by section.
        skipped: sections that could not run here, with the reason.
    """
    titles = {name: title for name, (title, _) in sections().items()}
    tested = {name: _tested(rows) for name, rows in report.items()}
    summary = []
    for name, rows in tested.items():
        kinds = {k: [abs(r.error) for r in rows if r.kind == k] for k in KIND_WORDS}
        counts = {k: f"{len(v)}" if v else "" for k, v in kinds.items()}
        largest = f"{max(kinds['predicted']):.1e}" if kinds["predicted"] else ""
        about = {"name": name, "title": titles[name], "largest": largest}
        summary.append({**about, **counts, "short": sum(not r.passed for r in rows)})
    total = [r for rows in tested.values() for r in rows]
    parts = [
        TEXT.raw("top"),
        "## Summary",
        TEXT.text("total", rows=len(total), short=sum(not r.passed for r in total)),
        TEXT.table("summary", summary, right=range(2, 8)),
        "Rows are of four kinds:",
        "\n".join(f"- **{k}**: {words}." for k, words in KIND_WORDS.items()),
        TEXT.raw("how"),
    ]
    if skipped:
        reasons = "; ".join(f"{n} ({why})" for n, why in skipped.items())
        parts.append(TEXT.text("skipped", skipped=reasons))
    for name, rows in tested.items():
        table = TEXT.table("rows", map(cells, rows), right=(2, 3, 4, 5))
        parts += [f"## {name}", titles[name], table]
    return "\n\n".join(parts) + "\n"
