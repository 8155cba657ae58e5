"""A word on what a command is at, for who waits at a terminal."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


def tell(text: str, *, quiet: bool = False) -> None:
    """Print ``text ...`` on stderr if that is a terminal.

    Args:
        text: what is being done; with a number where that tells how long it may take.
        quiet: print nothing (``--quiet``, ``--json``).
    """
    if not quiet and sys.stderr.isatty():
        print(f"{text} ...", file=sys.stderr, flush=True)


Progress = Callable[[float, float], None]


@contextmanager
def bar(name: str, total: float, *, show: bool) -> Iterator[Progress]:
    """Yield a callback that moves a progress bar on stderr, or does nothing."""
    if not show:
        yield lambda done, total: None
        return
    from tqdm import tqdm

    form = "{desc}: {percentage:3.0f}%|{bar}| {n:.2f}/{total:g} s simulated [{elapsed}<{remaining}]"
    columns = min(shutil.get_terminal_size((80, 24)).columns, 100)
    with tqdm(
        total=total, desc=name, bar_format=form, ncols=columns, nrows=24, file=sys.stderr
    ) as moved:

        def progress(done: float, _: float) -> None:
            moved.update(min(done, total) - moved.n)

        yield progress
