"""Recompute the paper's tables and the numerical checks, and print them row by row.

Exit status 1 when a row falls short of its tolerance.
"""

from __future__ import annotations

import argparse
import json
import math
import sys

NAME = "validate"
HELP = "recompute published tables and numerical checks"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--only", metavar="A,B", help="sections to run, comma separated")
    parser.add_argument("--list", action="store_true", help="list the sections and stop")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the sections; return 1 if a row falls short."""
    from scenarios import validation

    known = validation.sections()
    if args.list:
        for name, (title, _) in known.items():
            print(f"{name:<14} {title}")
        return 0
    names = [n.strip() for n in args.only.split(",") if n.strip()] if args.only else list(known)
    report = {}
    failed = 0
    for name in names:
        if name in known and sys.stderr.isatty():
            print(f"running {name} ...", file=sys.stderr)
        rows = validation.run(name)
        failed += sum(not r.passed for r in rows)
        report[name] = rows
        if not args.json:
            print(f"\n{name}: {known[name][0]}")
            print(table(rows))
    total = sum(len(r) for r in report.values())
    if args.json:
        out = {
            name: [
                {
                    **{k: _plain(v) for k, v in vars(r).items()},
                    "passed": r.passed,
                }
                for r in rows
            ]
            for name, rows in report.items()
        }
        print(json.dumps({"sections": out, "rows": total, "failed": failed}, indent=2))
    else:
        print(f"\n{total} rows, {failed} short of their tolerance")
    return 1 if failed else 0


def table(rows: list) -> str:  # type: ignore[type-arg]
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


def _plain(v: object) -> object:
    return None if isinstance(v, float) and not math.isfinite(v) else v
