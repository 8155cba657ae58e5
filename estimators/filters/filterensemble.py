"""Many filters of one model, their steps in vector lanes: Monte Carlo, banks, hypotheses.

Each result is what :func:`estimators.filters.filtering.run` gives, bit for bit: a filter fails, or
goes on in square-root form, by itself.  Filters of a bank that differ in constants alone go
together as well (:mod:`estimators.filters.alike`); theirs may differ by roundings of quotients by a
number that is a constant in one and a parameter in the other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TypeVar

from apu_casadi.core.backend import READY
from apu_casadi.core.errors import ApuError, DataError
from apu_casadi.core.lanes.lanelibrary import lanes_in_use
from apu_casadi.core.lanes.together import CHUNK, Course, alone, ensemble
from estimators.filters.alike import of_one_form
from estimators.filters.belief import Belief
from estimators.filters.filtering import FilterResult, FilterStep, course
from estimators.filters.stackedrun import One, blocks_of, lanes_of, run_stacked, stackable
from estimators.models.recording import Recording

__all__ = ["lanes_there", "run_many"]

T = TypeVar("T")
FEWEST = 2  # filters that go together
MANY = 6  # the same of filters whose rows go in lanes when they run alone


def run_many(
    step: FilterStep | Sequence[FilterStep],
    prior: Belief | Sequence[Belief],
    data: Recording | Sequence[Recording],
    *,
    full: bool = False,
    backend: str | None = None,
    chunk: int = CHUNK,
    n_threads: int | None = 1,
    progress: Callable[[int, int], None] | None = None,
) -> list[FilterResult]:
    """Run a filter over many recordings, or many filters over one.

    Args:
        step, prior, data: one for all, or one for each filter.  Steps of one family, and those that
            differ in constants alone, share their lanes.
        full, backend: as of :func:`estimators.filters.filtering.run`; with a backend of their own
            filters that need more than lanes run one by one.
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
    steps, priors, all_data = _each(step, n), _each(prior, n), _each(data, n)
    results: list[FilterResult | None] = [None] * n
    filters = [*zip(steps, priors, all_data, strict=True)]
    done = 0
    together = lanes_in_use() > 1 and backend in (None, READY)
    alike = [*zip(of_one_form(steps), priors, all_data, strict=True)] if together else []
    for group in [] if full else _groups(alike, chunk):
        stacked, solved = run_stacked([alike[k] for k in group], n_threads, backend)
        for k, one in zip(group, stacked, strict=True):
            results[k] = one
        done += solved
        if progress is not None and solved:
            progress(done, n)
    left = [k for k in range(n) if results[k] is None]
    own = filters if backend is not None or len(left) < MANY else alike or filters
    courses = (course(*own[k], full=full, backend=backend) for k in left)
    made_of = (
        _alone(courses) if own is filters else ensemble(courses, chunk=chunk, n_threads=n_threads)
    )
    for at, made in made_of:
        k = left[at]
        if isinstance(made, Exception):
            made.add_note(f"filter {k} of the ensemble")
            raise made
        results[k], done = made, done + 1
        if progress is not None:
            progress(done, n)
    return [r for r in results if r is not None]


def lanes_there(step: FilterStep, n: int) -> bool:
    """Whether n filters of a step go in lanes with nothing to compile; asked once."""
    return lanes_in_use() > 1 and lanes_of(step.shared, n, build=False) is not None


def _each(given: T | Sequence[T], n: int) -> list[T]:
    return [*given] if isinstance(given, Sequence) else [given] * n


def _alone(
    courses: Iterable[Course[FilterResult]],
) -> Iterator[tuple[int, FilterResult | Exception]]:
    """Run filters one by one; as :func:`~apu_casadi.core.lanes.together.ensemble` tells of them."""
    for k, one in enumerate(courses):
        try:
            yield k, alone(one)
        except ApuError as error:
            yield k, error


def _groups(filters: Sequence[One], chunk: int) -> list[list[int]]:
    """Return which filters run as arrays together, some multiples of the lanes each."""
    lanes, together = lanes_in_use(), dict[tuple[int, int], list[int]]()
    for k, one in enumerate(filters):
        if stackable(*one):
            together.setdefault((id(one[0].shared), blocks_of(one)), []).append(k)
    most = max(1, chunk // lanes) * lanes
    rows = [g for g in together.values() if filters[g[0]][0].shared.rows is not None]
    groups = [g for g in together.values() if len(g) >= (MANY if g in rows else FEWEST)]
    return [g[i : i + most] for g in groups for i in range(0, len(g), most)]
