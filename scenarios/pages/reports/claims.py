"""What a report is made of: claims with numbers, text, figures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from scenarios.studies.catalogue import Results

__all__ = ["JOINT", "Claim", "Pictures", "Report", "no_figures"]

Pictures = dict[str, tuple[str, Callable[[], Any]]]
"""By caption: name of the file, and what makes the figure."""
JOINT = "joint"
"""In place of a goal's number: what is asked of the joint run beyond the numbered goals."""


@dataclass(frozen=True)
class Claim:
    """One line of the table of goals.

    Args:
        goal: number of the goal, or "joint".
        what, target, achieved, interval, seeds: texts.
        met: None where nothing was asked.
        why: the reason, where it was missed.
    """

    goal: int | str
    what: str
    target: str
    achieved: str
    interval: str
    seeds: str
    met: bool | None
    why: str = ""


@dataclass(frozen=True)
class Report:
    """How the results of one study are shown.

    Args:
        intro: what was done, in plain words.
        claims, section: from the results by part.
        figures: results -> :data:`Pictures`.
    """

    intro: str
    claims: Callable[[Results], list[Claim]]
    section: Callable[[Results], list[str]]
    figures: Callable[[Results], Pictures]


def no_figures(r: Results) -> Pictures:
    """Return no figures."""
    return {}
