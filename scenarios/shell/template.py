"""Text with named values: what a page says stands in a template, Python computes its numbers.

A template has blocks; a line ``@name`` begins one.  Values stand in braces, with their format:

* ``{hours:.2f}`` as in Python; ``{row[mean]:.1e}`` an entry;
* ``{share:.1%}`` per cent, with the space before the sign; ``None`` is shown as ``-``;
* an interval of two numbers is shown as ``1.2 to 3.4``.

A block is read as paragraphs (:meth:`Template.text`), as a Markdown table (:meth:`Template.table`:
heads, a line ``---``, cells, with ``|`` between them), or as lines of cells
(:meth:`Template.cells`).
"""

from __future__ import annotations

import re
import string
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from typing import Any

from apu_casadi.core.errors import DataError, nearest
from scenarios.shell.markdown import markdown_table

__all__ = ["Template"]


class _Values(string.Formatter):
    """Formats of a template: as Python's, and those of the module's text."""

    def format_field(self, value: Any, spec: str) -> str:
        if value is None:
            return "-"
        if isinstance(value, list | tuple):
            low, high = (self.format_field(v, spec) for v in value)
            return f"{low.removesuffix(' %')} to {high}"
        if spec.endswith("%"):
            return f"{format(value, spec)[:-1]} %"
        return format(value, spec)


_FORMAT = _Values()


class Template:
    """Blocks of text by name.

    Args:
        source: the text of all blocks.
    """

    blocks: dict[str, str]

    def __init__(self, source: str) -> None:
        parts = re.split(r"^@(.+)\n", source, flags=re.MULTILINE)
        self.blocks = {n: b.strip("\n") for n, b in zip(parts[1::2], parts[2::2], strict=True)}

    @classmethod
    def of(cls, name: str) -> Template:
        """Return a template of ``scenarios/pages/templates``."""
        path = resources.files("scenarios").joinpath("pages", "templates", name)
        return cls(path.read_text(encoding="utf-8"))

    def __contains__(self, name: str) -> bool:
        return name in self.blocks

    def raw(self, name: str) -> str:
        """Return a block as it stands.

        Raises:
            DataError: there is none of this name.
        """
        if name not in self.blocks:
            raise DataError(f"template: block {name!r} {nearest(name, self.blocks)}")
        return self.blocks[name]

    def filled(self, name: str, /, **values: Any) -> str:
        """Return a block with its values, its lines kept."""
        return _FORMAT.vformat(self.raw(name), (), values)

    def text(self, name: str, /, **values: Any) -> str:
        """Return a block with its values, each paragraph on one line."""
        joined = re.sub(r"(?<!\n)\n(?!\n)", " ", self.raw(name))
        return _FORMAT.vformat(joined, (), values)

    def cells(self, name: str, /, **values: Any) -> list[str]:
        """Return the cells of a block of one row; values may hold bars."""
        return [_FORMAT.vformat(c, (), values) for c in _row(self.raw(name))]

    def table(
        self, name: str, rows: Iterable[Mapping[str, Any]], *, right: Sequence[int] | None = None
    ) -> str:
        """Return a block as a Markdown table.

        Args:
            name: of the block.
            rows: values of each row.
            right: columns that are aligned to the right; all but the first by default.
        """
        head, *body = self.rows(name, rows)
        return markdown_table(head, body, right=range(1, len(head)) if right is None else right)

    def rows(self, name: str, rows: Iterable[Mapping[str, Any]]) -> list[list[str]]:
        """Return the heads of a block's table, and the cells of each row."""
        head, row = (_row(part) for part in self.raw(name).split("\n---\n"))
        return [head, *([_FORMAT.vformat(c, (), r) for c in row] for r in rows)]


def _row(text: str) -> list[str]:
    """Return the cells of one row, which may stand on several lines."""
    return [c.strip() for c in re.split(r"\s\|(?=\s|$)", re.sub(r"\s*\n\s*", " ", text))]
