"""Pages that are made from the code: Markdown tables, and files written whole or not at all."""

from __future__ import annotations

import os
import textwrap
import threading
from collections.abc import Sequence
from pathlib import Path

from apu_casadi.errors import DataError


def write_text(path: str | os.PathLike[str], text: str) -> Path:
    """Write a text file under a temporary name, then rename it; return the path.

    Raises
    ------
    DataError : the file cannot be written there.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}.part")
    try:
        partial.write_text(text, encoding="utf-8", newline="\n")
        os.replace(partial, path)
    except OSError as e:
        raise DataError(f"{path}: cannot be written: {e.strerror or e}") from None
    finally:
        partial.unlink(missing_ok=True)
    return path


def markdown_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], *, right: Sequence[int] = ()
) -> str:
    """Return a Markdown table; the columns in ``right`` are aligned to the right."""
    rule = ("---:" if k in right else "---" for k in range(len(head)))
    lines = [" | ".join(cells) for cells in (head, list(rule), *rows)]
    return "\n".join(f"| {line} |" for line in lines)


def fill(text: str, width: int = 100) -> str:
    """Break the paragraphs of a text anew; a paragraph of one line (a heading) stays as it is."""
    parts = text.strip("\n").split("\n\n")
    filled = [
        textwrap.fill(p, width, break_long_words=False, break_on_hyphens=False) if "\n" in p else p
        for p in parts
    ]
    return "\n\n".join(filled) + "\n"
