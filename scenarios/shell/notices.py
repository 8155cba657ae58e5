"""Warnings of the package as lines of a command: ``warning: ...`` on stderr, each text once."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from apu_casadi.core.errors import ApuWarning

_TOLD: set[str] = set()


def tell(texts: Iterable[str]) -> None:
    """Print each text as one line, unless this command has printed it before."""
    for text in texts:
        line = " ".join(text.split())
        if line not in _TOLD:
            _TOLD.add(line)
            print(f"warning: {line}", file=sys.stderr)


@contextmanager
def as_lines() -> Iterator[None]:
    """Print the package's warnings by :func:`tell` inside the block; leave others as they are."""
    _TOLD.clear()
    with warnings.catch_warnings():
        warnings.simplefilter("always", ApuWarning)
        before: Any = warnings.showwarning

        def show(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if issubclass(category, ApuWarning):
                tell([str(message)])
            else:
                before(message, category, filename, lineno, file, line)

        warnings.showwarning = show
        yield
