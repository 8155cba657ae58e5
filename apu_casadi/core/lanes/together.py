"""Calls of one function by the members of an ensemble, evaluated together in lanes.

A member asks: its call raises :class:`Question`, which travels up to whoever moves the members.
When all have asked or ended, :func:`answer` evaluates the questions of each function at once; each
member is then moved again from where its call was made, and finds the answer there.  So nothing
between call and mover need know of ensembles, if it changes nothing before the call.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from typing import Any, TypeVar

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

CHUNK = 64  # members that are under way at once
T = TypeVar("T")


class Question(Exception):  # noqa: N818 - no error
    """What a member of an ensemble asks: a function, and its arguments, copied."""

    function: Together
    given: tuple[np.ndarray, ...]

    def __init__(self, function: Together, given: tuple[np.ndarray, ...]) -> None:
        super().__init__(f"{function.fun.name()} is asked for by a member of an ensemble")
        self.function, self.given = function, given


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


class Together:
    """A function called as by :class:`~apu_casadi.core.calling.Caller`, in an ensemble together.

    Args:
        fun: as compiled for one call.
        of: what it was compiled from, with dense inputs and outputs.
        one: evaluates one call; a ``Caller`` of ``fun`` if not given.
    """

    def __init__(
        self,
        fun: ca.Function,
        of: ca.Function,
        one: Callable[..., tuple[np.ndarray, ...]] | None = None,
    ) -> None:
        self.fun, self.of = fun, of
        self._one = one  # a member's own is never made where all ask
        self._wide: Caller | None = None
        self._outputs = [of.size_out(j) for j in range(of.n_out())]

    def __call__(self, *given: Any) -> tuple[np.ndarray, ...]:
        """Evaluate, or ask.

        Raises:
            Question: by a member of an ensemble whose answer is not there yet.
            BackendError: as of a ``Caller``.
        """
        member = _here.get()
        if member is None:
            return self._alone(*given)
        results = member.answered(self)
        if results is None:
            member.asks = Question(self, tuple(np.array(a, dtype=float) for a in given))
            raise member.asks
        return results

    def _alone(self, *given: Any) -> tuple[np.ndarray, ...]:
        if self._one is None:
            self._one = Caller(self.fun, copy=False)
        return self._one(*given)

    def evaluate(self, asked: Sequence[tuple[np.ndarray, ...]]) -> list[tuple[np.ndarray, ...]]:
        """Return the results for some members, as many as there are lanes at most."""
        if len(asked) == 1:
            return [tuple(a.copy() for a in self._alone(*asked[0]))]
        wide, n = self._call, len(asked)
        lanes = wide.fun.size2_out(0) // self._outputs[0][1]
        if n > lanes:
            raise BackendError(f"{self.fun.name()}: {n} members for {lanes} lanes")
        for i, buffer in enumerate(wide.inputs):
            flat = buffer.ravel(order="K").reshape(lanes, -1)  # a view: one member a row
            for k in range(lanes):
                flat[k] = asked[min(k, n - 1)][i].ravel(order="F")
        wide.evaluate()
        results = []
        for k in range(n):
            own = []
            for buffer, (rows, columns) in zip(wide.outputs, self._outputs, strict=True):
                part = buffer.ravel(order="K").reshape(lanes, -1)[k].copy()
                own.append(part if columns == 1 else part.reshape((rows, columns), order="F"))
            results.append(tuple(own))
        return results

    @property
    def lanes(self) -> int:
        """Members that are evaluated at once."""
        return int(self._call.fun.size2_out(0)) // int(self._outputs[0][1])

    @property
    def _call(self) -> Caller:
        if self._wide is None:
            self._wide = Caller(in_lanes(self.of), copy=False)
        return self._wide


def answer(members: Sequence[Member], pool: Executor | None = None) -> None:
    """Answer the questions of members, those of each function together.

    Args:
        members: those that ask; the others are left alone.
        pool: threads that evaluate packs of lanes at the same time; None evaluates one by one.
    """
    asking: dict[int, list[Member]] = {}  # by function: each member may have buffers of its own
    functions: dict[int, Together] = {}
    for m in members:
        if m.asks is not None:
            key = hash(m.asks.function.of)
            asking.setdefault(key, []).append(m)
            functions.setdefault(key, m.asks.function)
    packs = []
    for key, own in asking.items():
        function = functions[key]
        n = function.lanes if len(own) > 1 else 1
        packs += [(function, own[i : i + n]) for i in range(0, len(own), n)]

    def work(pack: tuple[Together, list[Member]]) -> list[tuple[np.ndarray, ...]]:
        function, own = pack
        return function.evaluate([m.asks.given for m in own if m.asks is not None])

    done = map(work, packs) if pool is None else pool.map(work, packs)
    for (_, own), results in zip(packs, done, strict=True):
        for m, r in zip(own, results, strict=True):
            m.take(r)


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
        try:
            with member:
                next(course)
        except StopIteration as end:
            yield k, end.value
        except Exception as error:
            yield k, error
        else:
            under_way.append((k, course, member))
    answer([m for _, _, m in under_way], pool)
