"""The one loop of every run: events at their instants, steps in between, a record of each.

What runs is a :class:`System`: the whole unit with its exchange, one model with one integrator, a
discrete model.  It decides how many intervals of the grid it takes at once, and with which of its
integrators: :func:`first_able` asks one after the other.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Protocol, TypeVar

import numpy as np

from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.lanes.together import Question

E_contra = TypeVar("E_contra", contravariant=True)
R_co = TypeVar("R_co", covariant=True)
E = TypeVar("E")
R = TypeVar("R")

SAME_INSTANT = 1e-9  # s; instants closer than this are one
_LOG = logging.getLogger("apu_casadi")


class System(Protocol[E_contra, R_co]):
    """What :func:`run` moves through time."""

    def switch(self, events: Sequence[E_contra], t: float) -> None:
        """Take the events of the instant t, s, all of which are one switch; none at the start."""

    def advance(self, k: int, until: float) -> tuple[int, R_co]:
        """Go from instant k over one or more intervals, not beyond ``until``, s.

        Returns how many, and what is to be recorded of them.
        """


def run(
    system: System[E, R],
    grid: np.ndarray,
    events: Iterable[E] = (),
    *,
    record: Callable[[int, int, R], None],
    at: Callable[[E], float] = lambda e: e.t,  # type: ignore[attr-defined]
    progress: Callable[[float, float], None] | None = None,
) -> None:
    """Move a system from the first to the last instant of a grid.

    Args:
        grid: increasing instants, s; those of the events are among them.
        events: in order of time.
        record: called with (first instant, number of instants, what ``advance`` gave).
        at: instant of an event.
        progress: called with (done, total) seconds after each ``advance``.
    """
    for question in steps(system, grid, events, record=record, at=at, progress=progress):
        raise question  # nobody is there to answer


def steps(
    system: System[E, R],
    grid: np.ndarray,
    events: Iterable[E] = (),
    *,
    record: Callable[[int, int, R], None],
    at: Callable[[E], float] = lambda e: e.t,  # type: ignore[attr-defined]
    progress: Callable[[float, float], None] | None = None,
) -> Iterator[Question]:
    """Do what :func:`run` does, and pause wherever the system asks, until it is answered."""
    pending, k, last, total = deque(events), 0, grid.size - 1, float(grid[-1])
    while k < last:
        t, due = float(grid[k]), []
        while pending and at(pending[0]) <= t + SAME_INSTANT:
            due.append(pending.popleft())
        if due or k == 0:
            system.switch(due, t)
        done = None
        while done is None:
            try:
                done = system.advance(k, at(pending[0]) if pending else total)
            except Question as question:
                asked = question
            else:
                break
            yield asked
        n, made = done
        record(k + 1, n, made)
        k += n
        if progress is not None:
            progress(float(grid[k]), total)


def first_able(integrators: Sequence[Callable[..., R]], *given: Any) -> R:
    """Return what the first integrator gives that can take the step.

    Raises:
        NotApplicable: none can; the reasons of all.
    """
    reasons = []
    for integrator in integrators:
        try:
            return integrator(*given)
        except NotApplicable as reason:
            reasons.append(str(reason))
            _LOG.debug("another integrator is asked: %s", reason)
    raise NotApplicable("; ".join(reasons))
