"""The paper's Figures 20 to 25 of a joint run: all of them by name, and their files."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from apu_casadi.core import files
from apu_casadi.core.results import generators_of
from scenarios.figures.figstyle import DPI
from scenarios.figures.profileplots import figure_profiles, given_profiles
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
DRAW: dict[str, Callable[..., Figure]] = dict(zip(FIGURES, _CALLS, strict=True))
"""What draws each figure, by the name of its file."""


def save_figures(ds: xr.Dataset, folder: str | os.PathLike[str]) -> list[Path]:
    """Write Figures 20 to 25 as PNG, 1600 px wide, into an existing folder; return the paths.

    And ``profiles.png``, where the run followed profiles.

    Where generators differ, 24 and 25 are drawn for each: ``fig24_currents_generator2.png``.

    Raises:
        DataError: a variable is missing, or a file cannot be written.
    """
    numbers = generators_of(ds)
    made = []
    for key, draw in DRAW.items():
        figures = {key: draw}
        if draw in (figure_24, figure_25) and len(numbers) > 1:
            figures = {f"{key}_generator{k}": partial(draw, generator=k) for k in numbers}
        for name, one in figures.items():
            path = Path(folder) / f"{name}.png"
            made.append(files.save_figure(one(ds), path, dpi=DPI))
    if given_profiles(ds):
        path = Path(folder) / "profiles.png"
        made.append(files.save_figure(figure_profiles(ds), path, dpi=DPI))
    return made
