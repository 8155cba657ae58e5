"""Small words of the reports: shares, intervals, seeds, tables; and numbers that several need."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from scenarios.shell.markdown import markdown_table

__all__ = [
    "HEALTH",
    "SHARE",
    "between",
    "percent",
    "seeds_of",
    "series",
    "table",
]

HEALTH = ("f_eta_c", "f_W_c", "f_eta_t", "f_W_t")
SHARE = 0.9  # of the checkpoints that should lie in their band


def percent(x: float | None, digits: int = 1) -> str:
    """A share as per cent."""
    return "-" if x is None else f"{100 * x:.{digits}f} %"


def between(pair: Sequence[float], form: str = ".3f", scale: float = 1.0, unit: str = "") -> str:
    """An interval."""
    return f"{scale * pair[0]:{form}} to {scale * pair[1]:{form}}{unit}"


def seeds_of(pair: Sequence[int]) -> str:
    """First and last seed."""
    return f"{pair[0]} to {pair[1]}"


def series(x: Sequence[float | None]) -> np.ndarray:
    """Numbers as JSON holds them, None for NaN, as an array."""
    return np.array([np.nan if v is None else v for v in x], float)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table whose first column holds words and the others numbers."""
    return markdown_table(head, rows, right=range(1, len(head)))
