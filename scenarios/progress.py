"""A word on what a command is at, for who waits at a terminal."""

from __future__ import annotations

import sys


def tell(text: str, *, quiet: bool = False) -> None:
    """Print ``text ...`` on stderr if that is a terminal.

    Parameters
    ----------
    text : what is being done; with a number where that tells how long it may take.
    quiet : print nothing (``--quiet``, ``--json``).
    """
    if not quiet and sys.stderr.isatty():
        print(f"{text} ...", file=sys.stderr, flush=True)
