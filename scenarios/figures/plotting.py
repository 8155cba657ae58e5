"""The paper's Figures 20 to 25 of a joint run: all of them by name, and their files."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from apu_casadi.core.results import generators_of
from scenarios.figures.drawnas import DrawnAs
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


def save_figures(
    ds: xr.Dataset, folder: str | os.PathLike[str], drawn: DrawnAs | None = None
) -> list[Path]:
    """Write Figures 20 to 25 into an existing folder; return the paths.

    And ``profiles.png``, where the run followed profiles.

    Where generators differ, 24 and 25 are drawn for each: ``fig24_currents_generator2.png``.

    Args:
        ds: the run.
        folder: where they go.
        drawn: formats, resolution, style; by default PNG, 1600 px wide, in colour.

    Raises:
        DataError: a variable is missing, or a file cannot be written.
    """
    drawn = DrawnAs() if drawn is None else drawn
    numbers = generators_of(ds)
    made = []
    for key, draw in DRAW.items():
        figures = {key: draw}
        if draw in (figure_24, figure_25) and len(numbers) > 1:
            figures = {f"{key}_generator{k}": partial(draw, generator=k) for k in numbers}
        for name, one in figures.items():
            made += drawn.save(one(ds), Path(folder) / name)
    if given_profiles(ds):
        made += drawn.save(figure_profiles(ds), Path(folder) / "profiles")
    return made
