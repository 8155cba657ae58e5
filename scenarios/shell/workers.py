"""Worker processes that end with their parent, however it ends, and stop when it is told to.

Each worker holds the reading end of a pipe whose writing end only the parent has.  A thread of the
worker waits for the end of that pipe, which comes when the parent closes it or is gone for whatever
reason, and ends the process.  On Linux the kernel is asked for the same in addition.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import Connection
from types import FrameType
from typing import Any, TypeVar

from apu_casadi.core import interrupts
from apu_casadi.core.errors import SimulationError

_LIBRARIES = "OMP OPENBLAS MKL NUMEXPR"
THREADS = (*(f"{n}_NUM_THREADS" for n in _LIBRARIES.split()), "VECLIB_MAXIMUM_THREADS")
_PR_SET_PDEATHSIG = 1
LOST = "the process ended without an answer (killed, out of memory?)"

T = TypeVar("T")
R = TypeVar("R")


@contextlib.contextmanager
def pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of fresh processes; an exception ends them at once, whatever they are doing.

    They use one thread each for linear algebra, and do not import the calling script.
    """
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe(duplex=False)
    with _plain_children():
        executor = ProcessPoolExecutor(
            workers, mp_context=spawn, initializer=begin, initargs=(ours, os.getpid())
        )
        try:
            yield executor
        except BaseException:
            theirs.close()  # ends the workers; the pool then counts as broken
            raise
        finally:
            executor.shutdown(wait=True, cancel_futures=True)
            theirs.close()
            ours.close()


def each_task(
    call: Callable[[T], R], tasks: Sequence[T], workers: int | None = None
) -> Generator[tuple[T, R | None]]:
    """Yield every task with what the call returns of it, in the order in which they end.

    Args:
        call: a function of a module; what it raises is raised.
        tasks: what it is called with, once each, but after a process has died.
        workers: processes, by default as many as there are cores; 1 calls in this one.

    Yields:
        Task and result; None where the task takes its process down (``LOST``).

    Raises:
        SimulationError: the processes end before they have begun.
    """
    from apu_casadi.core.calling import available_threads

    n = min(available_threads() if workers is None else workers, len(tasks))
    if n <= 1:
        yield from ((task, call(task)) for task in tasks)
        return
    suspects: list[T] = []
    yield from _pooled(call, list(tasks), n, suspects)
    # one of these took its process down: each gets a process of its own, which tells the culprit
    for task in suspects:
        again: list[T] = []
        yield from _pooled(call, [task], 1, again)
        if again:
            yield task, None


def _pooled(
    call: Callable[[T], R], tasks: list[T], workers: int, suspects: list[T]
) -> Iterator[tuple[T, R]]:
    """Yield what a pool returns; tasks under way when a process died go to suspects."""
    waiting = tasks[::-1]
    fruitless = 0
    while waiting:
        with pool(workers) as executor:
            under_way: dict[Future[R], T] = {}
            broken = False
            fruitless += 1
            if fruitless > 3:
                raise SimulationError("the processes end before they have run anything")
            while (waiting or under_way) and not broken:
                # few under way, so that an interrupt is answered within a task or two
                while waiting and len(under_way) < 2 * workers and not broken:
                    try:
                        with interrupts.kept_from_children():  # submitting starts processes
                            future = executor.submit(call, waiting[-1])
                        under_way[future] = waiting.pop()
                    except BrokenProcessPool:
                        broken = True
                for f in wait(under_way, return_when=FIRST_COMPLETED).done:
                    task = under_way.pop(f)
                    try:
                        result = f.result()
                    except BrokenProcessPool:
                        suspects.append(task)
                        broken = True
                    else:
                        fruitless = 0
                        yield task, result
            suspects.extend(under_way.values())


def begin(line: Connection, parent: int) -> None:
    """Prepare a worker: Ctrl-C is the parent's to answer, and its end is ours.

    Args:
        line: reading end of the pipe that the parent holds open.
        parent: its process id.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(line,), name="end with parent", daemon=True).start()
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:  # it ended before the kernel was asked
            os._exit(1)


def _end_with(line: Connection) -> None:
    with contextlib.suppress(EOFError, OSError):
        line.recv_bytes()
    os._exit(1)


@contextlib.contextmanager
def _plain_children() -> Iterator[None]:
    """Let processes started inside the block use one thread each, and not run our main script.

    The latter is what spawning does, for functions that the script may define; ours are here.
    """
    before = {k: os.environ.get(k) for k in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    main = sys.modules["__main__"]
    held: dict[str, Any] = {
        k: vars(main).pop(k) for k in ("__file__", "__spec__") if k in vars(main)
    }
    main.__spec__ = None
    try:
        yield
    finally:
        vars(main).update(held)
        for k, v in before.items():
            if v is None:
                os.environ.pop(k, None)
            else:
                os.environ[k] = v


@contextlib.contextmanager
def stoppable() -> Iterator[Callable[[], None]]:
    """Let SIGTERM end the block as Ctrl-C does, with KeyboardInterrupt.

    Yields a function that raises it if either has come: to be called where an integrator may have
    turned the first one into an error of its own.  A signal that is ignored stays so, a handler
    of the caller's own is called first, and outside the main thread nothing changes.
    """
    before: dict[int, Any] = {}
    outermost = not interrupts.owned()

    def handler(number: int, frame: FrameType | None) -> None:
        interrupts.record(number)
        if callable(before[number]):
            before[number](number, frame)
        raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            old = signal.getsignal(number)
            if callable(old) or old == signal.SIG_DFL:
                before[number] = old
                signal.signal(number, handler)
        if before:
            interrupts.own(True)
    try:
        yield interrupts.check
    finally:
        for n, handled in before.items():
            signal.signal(n, handled)
        if outermost and before:
            interrupts.own(False)
            interrupts.clear()
