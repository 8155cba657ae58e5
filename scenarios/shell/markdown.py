"""Pages that are made from the code: Markdown tables and filled paragraphs."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from apu_casadi.core.files import write_text

__all__ = ["fill", "markdown_table", "write_text"]


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
