"""Print what the paper leaves open or contradicts, what was chosen, and what the choice changes.

The effects are computed from the model; takes about a minute.
"""

from __future__ import annotations

import argparse

from scenarios.shell import jsontext, progress

NAME = "errata"
HELP = "what the paper leaves open, what was chosen, and what it changes"
OPTIONS = """
--write FILE | write the page, docs/ERRATA.md
--markdown   | print it as it would be written
--json       | print JSON
"""


def run(args: argparse.Namespace) -> int:
    """Compute the effects; print or write the page."""
    from pathlib import Path

    from apu_casadi.core import files
    from scenarios.pages import errata_page
    from scenarios.shell import markdown, terminal

    progress.tell("computing the effects, about a minute", quiet=args.json)
    if args.write is not None:
        files.folder(Path(args.write).parent)  # not after a minute of work
        path = markdown.write_text(args.write, errata_page.page())
    if args.json:
        jsontext.show(errata_page.report())
    elif args.write is not None:
        print(f"written: {path}")
    else:
        page = errata_page.page()
        print(page if args.markdown else terminal.plain(page, terminal.columns()), end="")
    return 0
