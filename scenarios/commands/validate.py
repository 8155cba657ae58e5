"""Recompute the paper's tables and the numerical checks, and print them row by row.

Exit status 1 when a row falls short of its tolerance, or a section that ``--only`` names cannot
run; without ``--only``, sections whose peer is not installed are skipped with the reason.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from typing import TYPE_CHECKING

from scenarios.commands import given
from scenarios.shell import jsontext, terminal

if TYPE_CHECKING:
    from scenarios.validation.comparison import Row

NAME = "validate"
HELP = "recompute published tables and numerical checks"
OPTIONS = f"""
--only A,B              | sections to run, comma separated
--list                  | list the sections and stop
--json                  | print JSON
--pycycle-python PYTHON | a Python that has pyCycle, for section pycycle
--write FILE            | also write the page, VALIDATION.md
--figures DIR           | draw Figures 15 to 25 of the paper there, and stop
{given.LOOK}
"""


def run(args: argparse.Namespace) -> int:
    """Run the sections; return 1 if a row falls short."""
    from scenarios.validation import comparison

    if args.pycycle_python:
        os.environ["APU_PYCYCLE_PYTHON"] = args.pycycle_python
    known = comparison.sections()
    if args.list:
        for name, (title, _) in known.items():
            _say(f"{name:<14} ", title)
        return 0
    if args.figures:
        from scenarios.validation import paper_figures

        print(*paper_figures.write_figures(args.figures, how=given.look(args)), sep="\n")
        return 0
    names = given.names(args.only) if args.only else list(known)
    report = {}
    skipped = {}
    failed = 0
    for name in names:
        if name in known and sys.stderr.isatty():
            print(f"running {name} ...", file=sys.stderr)
        try:
            rows = comparison.run(name)
        except comparison.SkippedError as reason:
            skipped[name] = str(reason)
            if not args.json:
                _say(f"\n{name}: ", known[name][0])
                _say("  skipped: ", str(reason))
            continue
        failed += sum(not r.passed for r in rows)
        report[name] = rows
        if not args.json:
            _say(f"\n{name}: ", known[name][0])
            print(table(rows, terminal.columns() if terminal.folds() else None), flush=True)
    total = sum(len(r) for r in report.values())
    if args.json:
        out = {
            name: [{**vars(r), "passed": r.passed} for r in rows] for name, rows in report.items()
        }
        summary = {"rows": total, "failed": failed, "skipped": skipped}
        jsontext.show({"sections": out, **summary})
    else:
        left_out = f"; skipped: {', '.join(skipped)}" if skipped else ""
        print(f"\n{total} rows, {failed} short of their tolerance{left_out}")
    if args.write:
        from scenarios.pages import validation_page
        from scenarios.shell import markdown

        markdown.write_text(args.write, validation_page.page(report, skipped))
    return 1 if failed or (args.only and skipped) else 0


def _say(label: str, text: str) -> None:
    """Print a text behind its label, on a terminal broken to its width below itself."""
    left = len(label.lstrip("\n"))
    width = terminal.columns() - left if terminal.folds() else len(text) + 1
    print(label, terminal.filled(text, width).replace("\n", "\n" + " " * left), sep="")


_HEAD = "quantity|unit|reference|ours|error|tolerance|kind||why this tolerance"
HEAD = _HEAD.split("|")


def table(rows: list[Row], width: int | None = None) -> str:
    """Return the rows as a text table; numbers stand to the right.

    Args:
        rows: what was compared.
        width: letters a line; the last column is broken to it, and the first where the others leave
            too little. None breaks nothing.
    """
    body = [HEAD, *(_cells(r) for r in rows)]
    n = len(HEAD) - 1
    widths = [max(len(row[k]) for row in body) for k in range(n)]
    if width is not None and sum(widths) + 2 * n > width:  # tolerance and kind go below, too
        body = [[*r[:5], r[7], f"{r[6]}, tolerance {r[5]}: {r[8]}"] for r in body]
        body[0][-1] = "kind, tolerance: why this tolerance"
        n, widths = 6, [*widths[:5], widths[7]]
        widths[0] = max(16, min(widths[0], width - sum(widths[1:]) - 2 * n))
    right = [">" if 2 <= k <= min(n - 2, 5) else "<" for k in range(n)]
    made = []
    for *cells, why in body:
        *above, cells[0] = terminal.filled(cells[0], widths[0]).split("\n")
        made += [f"  {part}" for part in above]
        line = "  " + "  ".join(map("{:{}{}}".format, cells, right, widths)) + "  "
        room = None if width is None else width - len(line)
        if room is not None and room < len(why) and room < _ROOM:  # below, where there is room
            made += [line.rstrip(), terminal.filled(why, width or 0, first=_BELOW, then=_BELOW)]
        elif room is not None and why:
            made.append(terminal.filled(why, width or 0, first=line, then=" " * len(line)))
        else:
            made.append((line + why).rstrip())
    return "\n".join(made)


_BELOW = " " * 6
_ROOM = 40
"""Letters that the reason of a tolerance needs beside its row."""


def _cells(r: Row) -> list[str]:
    tolerance = "-" if math.isinf(r.tolerance) else f"{r.tolerance:.0e}"
    numbers = [f"{r.reference:.7g}", f"{r.ours:.7g}", f"{r.error:+.1e}", tolerance]
    return [r.quantity, r.unit, *numbers, r.kind, "ok" if r.passed else "SHORT", r.reason]
