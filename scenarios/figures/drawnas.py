"""As what figures are written: file formats, resolution, colours or a style for grey print."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apu_casadi.core import files
from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError, nearest
from scenarios.figures import figstyle as fs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["DRAWN", "FORMATS", "STYLES", "DrawnAs", "grey"]

FORMATS = ("png", "svg", "pdf")
STYLES = ("colour", "grey")

_WRITING: dict[str, Any] = {"pdf.fonttype": 42, "svg.hashsalt": "apu-casadi"}
"""Letters that editors can change; the same figure gives the same bytes."""
_UNDATED: dict[str, dict[str, Any]] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}

_SOLID, _LONG, _DOT, _BOTH = "-", (0, (5, 1.6)), (0, (1.2, 1.2)), (0, (6, 1.5, 1.2, 1.5))
_GREYS = ("0", _SOLID), ("0.3", _LONG), ("0.5", _DOT), ("0.2", _BOTH)
_LINES: dict[str, tuple[str, Any]] = {
    **dict(zip(fs.ABC.values(), _GREYS, strict=False)),
    **dict(zip(fs.LINE_INK, _GREYS, strict=True)),
}
"""Grey and line style of a curve, by its colour."""


@dataclass(frozen=True)
class DrawnAs:
    """How figures are written.

    Args:
        formats: one or several of :data:`FORMATS`.
        dpi: dots per inch of PNG, 20 to 1200; figures are 10 in wide.
        style: of :data:`STYLES`; grey tells curves apart by line styles.

    Raises:
        ParameterError: an unknown format or style, or a resolution out of range.
    """

    formats: tuple[str, ...] = ("png",)
    dpi: float = fs.DPI
    style: str = "colour"

    def __post_init__(self) -> None:
        """Check all three."""
        for what, given, known in (
            *(("format of figures", f, FORMATS) for f in self.formats),
            ("style of figures", self.style, STYLES),
        ):
            if given not in known:
                raise ParameterError(f"unknown {what} {given!r} {nearest(given, known)}")
        if not self.formats:
            raise ParameterError(f"no format of figures; known: {', '.join(FORMATS)}")
        if not 20 <= number("dpi", self.dpi) <= 1200:
            raise ParameterError(f"dpi must be 20 to 1200, got {self.dpi:g}")

    def save(self, fig: Figure, stem: str | os.PathLike[str]) -> list[Path]:
        """Write a figure in all formats; return the files.

        Args:
            fig: the figure; its colours are changed where the style is grey.
            stem: path without ending.

        Raises:
            DataError: a file cannot be written.
        """
        return [self.save_as(fig, f"{os.fspath(stem)}.{form}") for form in self.formats]

    def save_as(self, fig: Figure, path: str | os.PathLike[str]) -> Path:
        """Write a figure into a file whose ending tells the format; otherwise as :meth:`save`."""
        if self.style == "grey":
            grey(fig)  # grey stays grey
        form = Path(path).suffix[1:].lower()
        with fs.drawing(_WRITING):
            return files.save_figure(fig, path, dpi=self.dpi, metadata=_UNDATED.get(form))


DRAWN = DrawnAs()
"""As figures are drawn where nothing is said."""


def grey(fig: Figure) -> Figure:
    """Turn all colours of a figure into greys, and tell curves apart by line styles; return it.

    Colours of curves that are compared get the greys and line styles of a table; all others
    become as light as they look. A curve that is alone in its axes stays solid, and what is drawn
    with a line style of its own keeps it.
    """
    from matplotlib.collections import Collection
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
    from matplotlib.text import Text

    alone = {id(line) for ax in fig.axes for line in _alone(ax)}
    for a in fig.findobj():
        if isinstance(a, Line2D):
            shade, style = _LINES.get(_hex(a.get_color()), (None, None))
            if shade is not None and a.get_linestyle() == "-" and id(a) not in alone:
                a.set_linestyle(style)
            a.set_markeredgecolor(_light(a.get_markeredgecolor()))
            a.set_markerfacecolor(_light(a.get_markerfacecolor()))
            a.set_color(shade or _light(a.get_color()))
        elif isinstance(a, Text):
            a.set_color(_light(a.get_color()))
        elif isinstance(a, Collection):
            if a.get_array() is not None:
                a.set_cmap("Greys")
            a.set_facecolor([_light(c) for c in a.get_facecolor()])
            a.set_edgecolor([_light(c) for c in a.get_edgecolor()])
        elif isinstance(a, Patch):
            face, edge = _light(a.get_facecolor()), _light(a.get_edgecolor())
            a.set_facecolor(face)
            a.set_edgecolor(edge)
    return fig


def _alone(ax: Any) -> list[Any]:
    """Return the curves of axes in which all curves that are compared have one colour."""
    curves = [line for line in ax.lines if _hex(line.get_color()) in _LINES]
    return curves if len({_hex(line.get_color()) for line in curves}) == 1 else []


def _hex(colour: Any) -> str:
    from matplotlib.colors import to_hex

    return str(to_hex(colour)) if _is_colour(colour) else ""


def _light(colour: Any) -> Any:
    """Return the grey of equal luma (Rec. 601), as transparent as the colour."""
    from matplotlib.colors import to_rgba

    if not _is_colour(colour):
        return colour
    r, g, b, alpha = to_rgba(colour)
    luma = 0.299 * r + 0.587 * g + 0.114 * b
    return (luma, luma, luma, alpha) if alpha else "none"


def _is_colour(colour: Any) -> bool:
    from matplotlib.colors import is_color_like

    return bool(is_color_like(colour))
