"""Many filters of one model, their steps in vector lanes: Monte Carlo, banks, hypotheses.

Each result is what :func:`estimators.filters.filtering.run` gives, bit for bit: a filter fails, or
goes on in square-root form, by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from apu_casadi.core.errors import DataError
from apu_casadi.core.lanes.together import CHUNK, ensemble
from estimators.filters.belief import Belief
from estimators.filters.filtering import FilterResult, FilterStep, course
from estimators.models.recording import Recording

__all__ = ["run_many"]


def run_many(
    step: FilterStep | Sequence[FilterStep],
    prior: Belief | Sequence[Belief],
    data: Recording | Sequence[Recording],
    *,
    full: bool = False,
    chunk: int = CHUNK,
    n_threads: int | None = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[FilterResult]:
    """Run a filter over many recordings, or many filters over one.

    Args:
        step, prior, data: one for all, or one for each filter.  Steps of one family share their
            lanes.
        full: as of :func:`estimators.filters.filtering.run`.
        chunk, n_threads: filters under way at once, and threads that evaluate blocks.
        progress: called with the number of filters done and of all.

    Raises:
        DataError: sequences of different lengths.
        EstimationError: of the first filter that fails, with its number as a note.
    """
    given = (step, prior, data)
    lengths = {len(a) for a in given if isinstance(a, Sequence)}
    if len(lengths) > 1:
        raise DataError(f"steps, priors and recordings are {sorted(lengths)} in number")
    n = lengths.pop() if lengths else 1
    steps, priors, all_data = ([*a] if isinstance(a, Sequence) else [a] * n for a in given)
    results: list[FilterResult | None] = [None] * n
    courses = (course(*one, full=full) for one in zip(steps, priors, all_data, strict=True))
    done = 0
    for k, made in ensemble(courses, chunk=chunk, n_threads=n_threads):
        if isinstance(made, Exception):
            made.add_note(f"filter {k} of the ensemble")
            raise made
        results[k], done = made, done + 1
        if progress is not None:
            progress(done, n)
    return [r for r in results if r is not None]
