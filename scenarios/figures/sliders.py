"""Sliders in a notebook where they can move, one picture where they cannot."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from typing import Any

__all__ = ["sliders"]

Range = tuple[float, float, float, float]


def sliders(show: Callable[..., Any], **ranges: Range) -> None:
    """Show something of numbers that sliders move: with a kernel and ``ipywidgets``, else once.

    >>> sliders(lambda mu: print(f"{mu:.0%} of the turns"), mu=(0.01, 0.2, 0.01, 0.05))
    5% of the turns

    Args:
        show: takes the numbers by name, and draws or prints.
        ranges: lowest, highest, step and first value of each.
    """

    def shown(**values: float) -> None:
        made = show(**values)
        if hasattr(made, "_repr_html_"):  # a table; a drawing shows itself
            import_module("IPython.display").display(made)

    if not _live():
        shown(**{n: first for n, (*_, first) in ranges.items()})
        return
    widgets: Any = import_module("ipywidgets")
    keys = ("min", "max", "step", "value")
    moved = {
        n: widgets.FloatSlider(**dict(zip(keys, r, strict=True)), continuous_update=False)
        for n, r in ranges.items()
    }
    widgets.interact(shown, **moved)


def _live() -> bool:
    if find_spec("ipywidgets") is None or "IPython" not in sys.modules:
        return False
    shell = import_module("IPython").get_ipython()
    return getattr(shell, "kernel", None) is not None
