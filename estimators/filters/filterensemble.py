"""Many filters of one model, their steps in vector lanes: Monte Carlo, banks, hypotheses.

Each result is what :func:`estimators.filters.filtering.run` gives, bit for bit: a filter fails, or
goes on in square-root form, by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from apu_casadi.core.errors import DataError
from apu_casadi.core.lanes.lanelibrary import lanes_in_use
from apu_casadi.core.lanes.together import CHUNK, ensemble
from estimators.filters.belief import Belief
from estimators.filters.filtering import FilterResult, FilterStep, course
from estimators.filters.stackedrun import One, run_stacked, stackable
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
    filters = [*zip(steps, priors, all_data, strict=True)]
    done = 0
    for group in [] if full else _groups(filters, chunk):
        together, solved = run_stacked([filters[k] for k in group], n_threads)
        for k, one in zip(group, together, strict=True):
            results[k] = one
        done += solved
        if progress is not None and solved:
            progress(done, n)
    left = [k for k in range(n) if results[k] is None]
    courses = (course(*filters[k], full=full) for k in left)
    for at, made in ensemble(courses, chunk=chunk, n_threads=n_threads):
        k = left[at]
        if isinstance(made, Exception):
            made.add_note(f"filter {k} of the ensemble")
            raise made
        results[k], done = made, done + 1
        if progress is not None:
            progress(done, n)
    return [r for r in results if r is not None]


def _groups(filters: Sequence[One], chunk: int) -> list[list[int]]:
    """Return which filters run as arrays together, some multiples of the lanes each."""
    lanes, together = lanes_in_use(), dict[tuple[int, int], list[int]]()
    if lanes == 1:
        return []
    for k, (step, prior, data) in enumerate(filters):
        if stackable(step, prior, data):
            together.setdefault((id(step.shared), data.size), []).append(k)
    most = max(1, chunk // lanes) * lanes
    groups = [g for g in together.values() if len(g) > 1]
    return [g[i : i + most] for g in groups for i in range(0, len(g), most)]
