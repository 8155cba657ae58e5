"""Recompute the paper's tables and the numerical checks, and print them row by row.

Exit status 1 when a row falls short of its tolerance, or a section that ``--only`` names cannot
run; without ``--only``, sections whose peer is not installed are skipped with the reason.
"""

from __future__ import annotations

import argparse
import math
import os
import sys

from scenarios.shell import jsontext

NAME = "validate"
HELP = "recompute published tables and numerical checks"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--only", metavar="A,B", help="sections to run, comma separated")
    parser.add_argument("--list", action="store_true", help="list the sections and stop")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument(
        "--pycycle-python", metavar="PYTHON", help="a Python that has pyCycle, for section pycycle"
    )
    parser.add_argument("--write", metavar="FILE", help="also write the page, VALIDATION.md")
    parser.add_argument(
        "--figures", metavar="DIR", help="draw Figures 15 to 25 of the paper there, and stop"
    )


def run(args: argparse.Namespace) -> int:
    """Run the sections; return 1 if a row falls short."""
    from scenarios.validation import comparison

    if args.pycycle_python:
        os.environ["APU_PYCYCLE_PYTHON"] = args.pycycle_python
    known = comparison.sections()
    if args.list:
        for name, (title, _) in known.items():
            print(f"{name:<14} {title}")
        return 0
    if args.figures:
        from scenarios.validation import paper_figures

        print(*paper_figures.write_figures(args.figures), sep="\n")
        return 0
    names = [n.strip() for n in args.only.split(",") if n.strip()] if args.only else list(known)
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
                print(f"\n{name}: {known[name][0]}\n  skipped: {reason}")
            continue
        failed += sum(not r.passed for r in rows)
        report[name] = rows
        if not args.json:
            print(f"\n{name}: {known[name][0]}")
            print(table(rows), flush=True)
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


def table(rows: list) -> str:
    """Return the rows as a text table."""
    head = (
        "quantity",
        "unit",
        "reference",
        "ours",
        "error",
        "tolerance",
        "kind",
        "",
        "why this tolerance",
    )
    body = [
        (
            r.quantity,
            r.unit,
            f"{r.reference:.7g}",
            f"{r.ours:.7g}",
            f"{r.error:+.1e}",
            "-" if math.isinf(r.tolerance) else f"{r.tolerance:.0e}",
            r.kind,
            "ok" if r.passed else "SHORT",
            r.reason,
        )
        for r in rows
    ]
    widths = [max(len(row[k]) for row in (head, *body)) for k in range(len(head))]
    right = {2, 3, 4, 5}
    return "\n".join(
        "  " + "  ".join(
            c.rjust(w) if k in right else c.ljust(w)
            for k, (c, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in (head, *body)
    )  # fmt: skip
