"""Calls of one function by the members of an ensemble, evaluated together in lanes.

A member asks: its call raises :class:`Question`, which travels up to whoever moves the members.
When all have asked or ended, :func:`answer` evaluates the questions of each function at once; each
member is then moved again from where its call was made, and finds the answer there.  So nothing
between call and mover need know of ensembles, if it changes nothing before the call.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from typing import Any, Protocol, TypeVar

import casadi as ca
import numpy as np

from apu_casadi.core.calling import Caller, available_threads
from apu_casadi.core.errors import BackendError, ScenarioError
from apu_casadi.core.lanes.lanelibrary import in_lanes

__all__ = [
    "CHUNK",
    "Course",
    "Member",
    "Question",
    "Together",
    "alone",
    "answer",
    "asking",
    "ensemble",
]

CHUNK = 128  # members that are under way at once
OFTEN = 40  # calls one by one before code in lanes is compiled; scalar code is after 50
T = TypeVar("T")


class Question(Exception):  # noqa: N818 - no error
    """What a member of an ensemble asks: a function, its arguments, copied, and how many calls."""

    function: Together
    given: tuple[np.ndarray, ...]
    calls: int

    def __init__(self, function: Together, given: tuple[np.ndarray, ...], calls: int) -> None:
        super().__init__(f"{function.fun.name()} is asked for by a member of an ensemble")
        self.function, self.given, self.calls = function, given, calls


#: What a member does: it yields questions, and returns its result.
Course = Generator[Question, None, T]

_here: ContextVar[Member | None] = ContextVar("apu_member", default=None)


class Member:
    """One member of an ensemble; a ``with`` block moves it.

    Attributes:
        asks: its question, until it is answered.
    """

    asks: Question | None = None

    def __init__(self) -> None:
        self._answer: tuple[Together, tuple[np.ndarray, ...]] | None = None

    def __enter__(self) -> Member:
        self._token = _here.set(self)
        return self

    def __exit__(self, *_: object) -> None:
        _here.reset(self._token)

    def take(self, results: tuple[np.ndarray, ...]) -> None:
        """Take the answer to the question."""
        assert self.asks is not None
        self._answer = self.asks.function, results
        self.asks = None

    def answered(self, function: Together) -> tuple[np.ndarray, ...] | None:
        """Return the answer once, if there is one.

        Raises:
            BackendError: the member asks for something else than before.
        """
        if self._answer is None:
            return None
        (of, results), self._answer = self._answer, None
        if hash(of.of) != hash(function.of):
            raise BackendError(f"asked for {of.fun.name()}, then for {function.fun.name()}")
        return results


def asking() -> bool:
    """Whether calls here are questions of a member of an ensemble."""
    return _here.get() is not None


@contextmanager
def by_itself() -> Iterator[None]:
    """Let what runs inside ask nobody: it evaluates its calls itself."""
    token = _here.set(None)
    try:
        yield
    finally:
        _here.reset(token)


class Single(Protocol):
    """What evaluates one call, compiled or not."""

    @property
    def inputs(self) -> list[np.ndarray]:
        """This thread's input buffers."""

    def __call__(self, *arrays: Any) -> tuple[np.ndarray, ...]:
        """Evaluate."""


class Together:
    """A function called as by :class:`~apu_casadi.core.calling.Caller`, in an ensemble together.

    Args:
        fun: as compiled for one call.
        of: what it was compiled from, with dense inputs and outputs.
        one: evaluates one call, compiled or not; a ``Caller`` of ``fun`` if not given.  With it,
            code in lanes is compiled after ``OFTEN`` calls only; a library that is there is loaded.
        small: calls of it that cost as much as one of others; so many times ``OFTEN``.
    """

    def __init__(
        self,
        fun: ca.Function,
        of: ca.Function,
        one: Single | None = None,
        *,
        small: float = 1,
    ) -> None:
        self.fun: ca.Function = fun
        self.of: ca.Function = of
        self._one = one  # a member's own is never made where all ask
        self._in_lanes: Caller | None = None
        self._left = self._often = 0 if one is None else max(1, round(small * OFTEN))
        self._outputs = [of.size_out(j) for j in range(of.n_out())]

    def __call__(self, *given: Any) -> tuple[np.ndarray, ...]:
        """Evaluate, or ask.

        Raises:
            Question: by a member of an ensemble whose answer is not there yet.
            BackendError: as of a ``Caller``.
        """
        made = self._asked(given, 0)
        return self._alone(*given) if made is None else made

    @property
    def inputs(self) -> list[np.ndarray]:
        """This thread's input buffers of a call, which are not copied if they are given."""
        return self._made().inputs

    def in_a_row(self, calls: int, *given: Any) -> tuple[np.ndarray, ...]:
        """Evaluate so many times, or ask; each call takes the last one's first output first.

        Returns:
            Each output of all calls, side by side.

        Raises:
            Question, BackendError: as of a call.
        """
        made = self._asked(given, calls)
        if made is None:
            arrays = tuple(np.array(a, dtype=float) for a in given)
            (made,) = self.evaluate([Question(self, arrays, calls)])
        return made

    def _asked(self, given: Sequence[Any], calls: int) -> tuple[np.ndarray, ...] | None:
        """Return the answer to a member's question, ask it, or None outside of ensembles."""
        member = _here.get()
        results = None if member is None else member.answered(self)
        if member is not None and results is None:
            arrays = tuple(np.array(a, dtype=float) for a in given)
            member.asks = Question(self, arrays, calls)
            raise member.asks
        return results

    def _alone(self, *given: Any) -> tuple[np.ndarray, ...]:
        return self._made()(*given)

    def _made(self) -> Single:
        if self._one is None:
            self._one = Caller(self.fun, copy=False)
        return self._one

    def evaluate(self, asked: Sequence[Question]) -> list[tuple[np.ndarray, ...]]:
        """Return the results for some members, as many as there are lanes at most."""
        calls = max(1, *(q.calls for q in asked)) if len(asked) > 1 else max(1, asked[0].calls)
        rows = self._one_by_one(asked[0], calls) if len(asked) == 1 else self._wide(asked, calls)
        results = []
        for k, q in enumerate(asked):
            own = []
            for row, (n, columns) in zip(rows, self._outputs, strict=True):
                if q.calls:
                    part = row[: q.calls, k].reshape(q.calls * columns, n).T
                else:
                    part = row[0, k].copy() if columns == 1 else row[0, k].reshape(columns, n).T
                own.append(part)
            results.append(tuple(own))
        return results

    def _room(self, calls: int, lanes: int) -> list[np.ndarray]:
        return [np.empty((calls, lanes, n * columns)) for n, columns in self._outputs]

    def _one_by_one(self, asked: Question, calls: int) -> list[np.ndarray]:
        """Return the outputs of a row of calls, each of shape (calls, 1, entries)."""
        rows, (first, *rest) = self._room(calls, 1), asked.given
        self._left -= calls
        for i in range(calls):
            made = self._alone(first, *rest)
            for row, out in zip(rows, made, strict=True):
                row[i, 0] = out.ravel(order="F")
            first = made[0].copy()
        return rows

    def _wide(self, asked: Sequence[Question], calls: int) -> list[np.ndarray]:
        """Return the outputs of rows of calls in lanes, each of shape (calls, lanes, entries)."""
        wide, lanes = self._call, self.lanes
        if len(asked) > lanes:
            raise BackendError(f"{self.fun.name()}: {len(asked)} members for {lanes} lanes")
        # views, one member a row
        given, made = (
            [a.ravel(order="K").reshape(lanes, -1) for a in arrays]
            for arrays in (wide.inputs, wide.outputs)
        )
        for i, flat in enumerate(given):
            for k in range(lanes):
                flat[k] = asked[min(k, len(asked) - 1)].given[i].ravel(order="F")
        rows = self._room(calls, lanes)
        for i in range(calls):
            if i:
                given[0][...] = made[0]
            wide.evaluate()
            for row, out in zip(rows, made, strict=True):
                row[i] = out
        return rows

    @property
    def lanes(self) -> int:
        """Members that are evaluated at once; one while nothing is compiled."""
        if not self._ready():
            return 1
        return int(self._call.fun.size2_out(0)) // int(self._outputs[0][1])

    def _ready(self) -> bool:
        """Whether lanes may be used: they are compiled, or the calls so far are worth it."""
        if self._in_lanes is None and self._left == self._often:
            made = in_lanes(self.of, build=False)
            if made.class_name() == "External":
                self._in_lanes = Caller(made, copy=False)
        return self._in_lanes is not None or self._left <= 0

    @property
    def _call(self) -> Caller:
        if self._in_lanes is None:
            self._in_lanes = Caller(in_lanes(self.of), copy=False)
        return self._in_lanes


def answer(
    members: Sequence[Member], pool: Executor | None = None, *, patient: bool = False
) -> None:
    """Answer the questions of members, those of each function together.

    Args:
        members: those that ask; the others are left alone.
        pool: threads that evaluate packs of lanes at the same time; None evaluates one by one.
        patient: answer those only that fill all lanes, or, where there are none, the most that ask
            for one function.
    """
    asking: dict[int, list[Question]] = {}  # by function: each member may have buffers of its own
    whose: dict[Question, Member] = {}
    for m in members:
        if m.asks is not None:
            whose[m.asks] = m
            asking.setdefault(hash(m.asks.function.of), []).append(m.asks)
    packs: list[list[Question]] = []
    full: list[list[Question]] = []
    for own in asking.values():
        own.sort(key=lambda q: -q.calls)  # rows of calls that are equally long go together
        n = own[0].function.lanes if len(own) > 1 else 1
        parts = [own[i : i + n] for i in range(0, len(own), n)]
        packs += parts
        full += [p for p in parts if len(p) == n and len(own) > 1]
    if patient and packs:
        packs = full or [max(packs, key=len)]

    def work(pack: list[Question]) -> list[tuple[np.ndarray, ...]]:
        return pack[0].function.evaluate(pack)

    done = map(work, packs) if pool is None else pool.map(work, packs)
    for own, results in zip(packs, done, strict=True):
        for q, r in zip(own, results, strict=True):
            whose[q].take(r)


def alone(course: Course[T]) -> T:
    """Return what a course returns that asks nobody, though it may be part of a member's."""
    try:
        with by_itself():
            raise next(course)
    except StopIteration as end:
        made: T = end.value
        return made


def ensemble(
    courses: Iterator[Course[T]], *, chunk: int = CHUNK, n_threads: int | None = 1
) -> Iterator[tuple[int, T | Exception]]:
    """Move courses, which pause at questions, and answer these together.

    Args:
        courses: generators that yield questions; taken when there is room.
        chunk: members that are under way at once; memory grows with it.
        n_threads: threads that answer questions; None takes all cores.

    Yields:
        Number of a member and what it returned or raised, in the order in which they end.
    """
    if chunk < 1:
        raise ScenarioError(f"chunk = {chunk!r}: at least one member must be under way")
    n = available_threads() if n_threads is None else n_threads
    waiting = enumerate(courses)
    with ThreadPoolExecutor(n) if n > 1 else nullcontext() as pool:
        under_way = deque[tuple[int, Course[T], Member]]()
        while True:
            while len(under_way) < chunk and (one := next(waiting, None)) is not None:
                under_way.append((*one, Member()))
            if not under_way:
                return
            yield from _moved(under_way, pool)


def _moved(
    under_way: deque[tuple[int, Course[T], Member]], pool: Executor | None
) -> Iterator[tuple[int, T | Exception]]:
    """Move each member to its next question, and answer; yields those that end."""
    for _ in range(len(under_way)):
        k, course, member = under_way.popleft()
        if member.asks is None:
            try:
                with member:
                    next(course)
            except StopIteration as end:
                yield k, end.value
                continue
            except Exception as error:
                yield k, error
                continue
        under_way.append((k, course, member))
    answer([m for _, _, m in under_way], pool, patient=True)
