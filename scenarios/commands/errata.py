"""Print what the paper leaves open or contradicts, what was chosen, and what the choice changes.

The effects are computed from the model; takes about a minute.
"""

from __future__ import annotations

import argparse

from scenarios import jsontext

NAME = "errata"
HELP = "what the paper leaves open, what was chosen, and what it changes"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--write", metavar="FILE", help="write the page, docs/ERRATA.md")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Compute the effects; print or write the page."""
    from scenarios import errata, pages

    if args.json:
        jsontext.show(errata.report())
        return 0
    page = errata.page()
    if args.write:
        print(f"written: {pages.write_text(args.write, page)}")
    else:
        print(page, end="")
    return 0
