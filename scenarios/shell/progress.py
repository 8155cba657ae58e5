"""A word on what a command is at, for who waits at a terminal."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


def tell(text: str, *, quiet: bool = False) -> None:
    """Print ``text ...`` on stderr if that is a terminal.

    Args:
        text: what is being done; with a number where that tells how long it may take.
        quiet: print nothing (``--quiet``, ``--json``).
    """
    if not quiet and sys.stderr.isatty():
        print(f"{text} ...", file=sys.stderr, flush=True)


Progress = Callable[[float, float], None]
_SECONDS = "{desc}: {percentage:3.0f}%|{bar}| {n:.2f}/{total:g} s simulated [{elapsed}<{remaining}]"


@contextmanager
def moving(name: str, total: float, *, show: bool, **how: Any) -> Iterator[Any]:
    """Yield a bar of tqdm on stderr, not wider than 100 columns; None if it is not to be shown."""
    if not show:
        yield None
        return
    from tqdm import tqdm

    columns = min(shutil.get_terminal_size((80, 24)).columns, 100)
    with tqdm(total=total, desc=name, ncols=columns, nrows=24, file=sys.stderr, **how) as bar:
        yield bar


@contextmanager
def bar(name: str, total: float, *, show: bool, **how: Any) -> Iterator[Progress]:
    """Yield a callback that moves a progress bar on stderr, or does nothing.

    Args:
        name: what stands before it.
        total: end of the bar; seconds that are simulated, unless ``unit`` is given.
        how: arguments of tqdm instead.
    """
    with moving(name, total, show=show, **(how or {"bar_format": _SECONDS})) as moved:

        def progress(done: float, _: float) -> None:
            if moved is not None:
                moved.update(min(done, total) - moved.n)

        yield progress
