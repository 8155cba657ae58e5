"""The paper's Figures 20 to 25 of a joint run: all of them by name, and their files."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from apu_casadi.core import files
from scenarios.figures.figstyle import DPI
from scenarios.figures.runplots import figure_20, figure_21, figure_22, figure_23
from scenarios.figures.runwords import FIGURES
from scenarios.figures.threephase import figure_24, figure_25

if TYPE_CHECKING:
    import xarray as xr
    from matplotlib.figure import Figure

__all__ = [
    "DRAW",
    "FIGURES",
    "figure_20",
    "figure_21",
    "figure_22",
    "figure_23",
    "figure_24",
    "figure_25",
    "save_figures",
]

_CALLS = (figure_20, figure_21, figure_22, figure_23, figure_24, figure_25)
DRAW: dict[str, Callable[[xr.Dataset], Figure]] = dict(zip(FIGURES, _CALLS, strict=True))
"""What draws each figure, by the name of its file."""


def save_figures(ds: xr.Dataset, folder: str | os.PathLike[str]) -> list[Path]:
    """Write Figures 20 to 25 as PNG, 1600 px wide, into an existing folder; return the paths.

    Raises:
        DataError: a variable is missing, or a file cannot be written.
    """
    made = []
    for key, draw in DRAW.items():
        path = Path(folder) / f"{key}.png"
        made.append(files.save_figure(draw(ds), path, dpi=DPI))
    return made
