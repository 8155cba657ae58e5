"""Text for a terminal: pages of Markdown as plain text, and cells broken to the width there is."""

from __future__ import annotations

import re
import shutil
import sys
import textwrap
from collections.abc import Sequence
from typing import Any

__all__ = ["columns", "filled", "plain"]

WIDEST = 110
"""Letters a line, however wide the terminal is: longer ones are hard to read."""


def columns() -> int:
    """Return how many letters a line has: of the terminal, else of COLUMNS, else 100."""
    return max(40, min(shutil.get_terminal_size((100, 24)).columns, WIDEST))


def folds() -> bool:
    """Whether lines are read on a terminal, which breaks those that are too long."""
    return sys.stdout.isatty()


def filled(text: str, width: int, *, first: str = "", then: str = "") -> str:
    """Break a text to a width, with what its first and its other lines begin with."""
    how: dict[str, Any] = {"break_long_words": False, "break_on_hyphens": False}
    made = textwrap.fill(text, width, initial_indent=first, subsequent_indent=then, **how)
    return made or first.rstrip()


def plain(page: str, width: int) -> str:
    """Return a page of Markdown as plain text: headings, paragraphs, lists and tables.

    A table whose rows are too wide is written row by row, each cell after the name of its column.
    """
    made = []
    for block in re.split(r"\n{2,}", page.strip("\n")):
        lines = block.split("\n")
        if lines[0].startswith("#"):
            head = _words(lines[0].lstrip("# "))
            made.append(f"{head}\n{('=' if lines[0].startswith('# ') else '-') * len(head)}")
        elif all(line.startswith("|") for line in lines) and len(lines) > 2:
            made.append(_table([_cells(line) for line in (lines[0], *lines[2:])], width))
        elif lines[0].startswith("- "):
            points = re.split(r"\n(?=- )", block)
            made += [filled(_words(p[2:]), width, first="- ", then="  ") for p in points]
        else:
            made.append(filled(_words(block), width))
    return "\n\n".join(made) + "\n"


def _words(text: str) -> str:
    """Return a text without the signs of Markdown; of a link, its words."""
    text = re.sub(r"!?\[([^]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"\*\*([^*]+)\*\*|`([^`]+)`", lambda m: m[1] or m[2], text)
    return " ".join(text.split())


def _cells(line: str) -> list[str]:
    cells = re.split(r"(?<!\\)\|", line.strip().strip("|"))
    return ["\n".join(_words(part) for part in c.replace("\\|", "|").split("<br>")) for c in cells]


def _table(rows: Sequence[Sequence[str]], width: int) -> str:
    """Return rows, the first with the names, side by side or one after the other."""
    widths = [max(len(c) for c in column) for column in zip(*rows, strict=True)]
    if sum(widths) + 2 * len(widths) <= width and not any("\n" in c for r in rows for c in r):
        lines = ["  ".join(map("{:<{}}".format, r, widths)).rstrip() for r in rows]
        return "\n".join([lines[0], "-" * len(lines[0]), *lines[1:]])
    head, *body = rows
    left = max(len(name) for name in head[1:]) + 2
    made = []
    for first, *others in body:
        lines = [first]
        for name, cell in zip(head[1:], others, strict=True):
            parts = [p for p in cell.split("\n") if p]
            starts = [f"{f'{name}:':<{left}}", *[" " * left] * (len(parts) - 1)]
            both = zip(starts, parts, strict=True)
            lines += [filled(p, width, first=f"  {s}", then=" " * (left + 4)) for s, p in both]
        made.append("\n".join(lines))
    return "\n\n".join(made)
