"""The page ``VALIDATION.md``, made by ``apu validate --write VALIDATION.md``.

Timings stay out of it, so that two runs of one version write the same page.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from scenarios.shell.markdown import markdown_table
from scenarios.validation.comparison import Row, sections

HEAD = ("quantity", "unit", "reference", "ours", "error", "tolerance", "kind", "", "why")
KIND_WORDS = {
    "input": "given to the calculation, so that it shows nothing but the printed digits",
    "calibrated": "a number of ours was fitted to this very value",
    "predicted": "computed without knowing it",
    "check": "two routes of our own, or a conservation law; never somebody else's number",
}

_TOP = """# Validation

Made by `apu validate --write VALIDATION.md`; do not edit. The reference of Tables 4, 5, 7 and 8 is
the column of the paper's own reference program (GasTurb, MATLAB's synchronous machine). Of Tables
6, 9 and 10 the paper prints mean errors only, against curves that are not published: beside each of
its numbers stands what can be said without them, and a row of the kind "check" compares two routes
of our own. What the paper leaves open or contradicts, with what each choice changes, is in
[docs/ERRATA.md](docs/ERRATA.md); what its multi-rate exchange loses in
[docs/MULTIRATE.md](docs/MULTIRATE.md).
"""

_HOW = """## How to reproduce

    pip install .
    apu validate                         # every row; exit status 1 when one falls short
    apu validate --only table4,table5    # some of them; apu validate --list names all
    apu validate --json                  # the same for machines
    apu validate --figures figures       # Figures 15 to 25 of the paper as PNG
    apu validate --write VALIDATION.md   # this page
    apu errata --write docs/ERRATA.md
    apu multirate --page docs/MULTIRATE.md
"""


def cells(r: Row) -> tuple[str, ...]:
    """Return a row of the page."""
    return (
        r.quantity.replace("|", "\\|"),
        r.unit,
        "" if math.isnan(r.reference) else f"{r.reference:.7g}",
        f"{r.ours:.7g}" if r.kind != "check" or r.unit != "1" else _error(r.ours),
        _error(r.error, "+"),
        f"{r.tolerance:.0e}",
        r.kind,
        "ok" if r.passed else "**SHORT**",
        r.reason,
    )


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
    summary = []
    for name, rows in report.items():
        tested = _tested(rows)
        kinds = {k: [abs(r.error) for r in tested if r.kind == k] for k in KIND_WORDS}
        summary.append(
            (
                f"[{name}](#{name})",
                titles[name],
                *(f"{len(kinds[k])}" if kinds[k] else "" for k in KIND_WORDS),
                f"{max(kinds['predicted']):.1e}" if kinds["predicted"] else "",
                str(sum(not r.passed for r in tested)),
            )
        )
    head = ("section", "what", *KIND_WORDS, "largest predicted error", "short")
    total = [r for rows in report.values() for r in _tested(rows)]
    parts = [
        _TOP,
        "## Summary\n",
        f"{len(total)} rows, {sum(not r.passed for r in total)} short of their tolerance.\n",
        markdown_table(head, summary, right=range(2, 8)) + "\n",
        "Rows are of four kinds:\n",
        "\n".join(f"- **{k}**: {words}." for k, words in KIND_WORDS.items()) + "\n",
        _HOW,
    ]
    if skipped:
        parts.append("Not run when this page was made: "
                     + "; ".join(f"{n} ({why})" for n, why in skipped.items()) + ".\n")  # fmt: skip
    for name, rows in report.items():
        table = markdown_table(HEAD, [cells(r) for r in _tested(rows)], right=(2, 3, 4, 5))
        parts.append(f"## {name}\n\n{titles[name]}\n\n{table}\n")
    return "\n".join(parts)
