"""Ctrl-C, wherever it arrives, comes out as KeyboardInterrupt and never as a verdict on a model.

CasADi runs Python's signal handlers inside its integrators and inside IPOPT, and swallows what a
handler raises there: CVODES then reports a right-hand side that failed, IPOPT a solution that was
not found, and either would be told as a fault of the model or of the data.  So the handler records
the signal first, and nothing is concluded while one is recorded: making an
:class:`~apu_casadi.core.errors.ApuError` raises KeyboardInterrupt instead.

The command line installs such a handler for its whole life (:mod:`scenarios.shell.guard`).  In
library calls :class:`watched` stands around the solvers that swallow exceptions.
"""

from __future__ import annotations

import _signal  # the functions of signal without conversion to enums; watched() runs once a step
import contextlib
from collections.abc import Iterator
from types import FrameType
from typing import Any

_recorded = 0  # number of the signal
_owned = False  # whether a handler that records is in force


def recorded() -> int:
    """Return the number of the signal that was recorded and not answered; 0 if there is none."""
    return _recorded


def record(signum: int) -> None:
    """Record a signal; a handler calls this before it raises."""
    global _recorded
    _recorded = signum


def clear() -> None:
    """Forget the recorded signal: it has been answered."""
    record(0)


def own(yes: bool) -> None:
    """Tell that a handler that records is in force for good, or no longer."""
    global _owned
    _owned = yes


def owned() -> bool:
    """Return whether a handler that records is in force for good."""
    return _owned


def check() -> None:
    """Raise KeyboardInterrupt if a signal is recorded."""
    if _recorded:
        raise KeyboardInterrupt


@contextlib.contextmanager
def kept_from_children() -> Iterator[None]:
    """Start processes inside the block; Ctrl-C of a terminal, which reaches them too, passes by.

    They inherit that SIGINT is blocked, from their first instruction on; a handler that a process
    installs itself comes too late for one that is still importing.  Here the signal waits for the
    end of the block, which should be short.
    """
    if not hasattr(_signal, "pthread_sigmask"):
        yield
        return
    before = _signal.pthread_sigmask(_signal.SIG_BLOCK, {_signal.SIGINT})
    try:
        yield
    finally:
        _signal.pthread_sigmask(_signal.SIG_SETMASK, before)


class watched:  # noqa: N801 - used like a function
    """A block in which an exception of the SIGINT handler may be swallowed; it leaves the block.

    Where a handler that records is in force already, and in threads, to which Python delivers no
    signal, the block only checks.
    """

    __slots__ = ("_before",)

    def __enter__(self) -> None:
        """Put a recording handler before the present one, if that is a Python function."""
        self._before: Any = None
        if _owned:
            return
        before = _signal.getsignal(_signal.SIGINT)
        if not callable(before):
            return

        def handler(signum: int, frame: FrameType | None) -> None:
            try:
                before(signum, frame)
            except BaseException:
                record(signum)
                raise

        try:
            _signal.signal(_signal.SIGINT, handler)
        except ValueError:  # no main thread
            return
        own(True)
        self._before = before

    def __exit__(self, *_: object) -> None:
        """Put the former handler back; raise KeyboardInterrupt if a signal came."""
        signum = _recorded
        if self._before is not None:
            _signal.signal(_signal.SIGINT, self._before)
            own(False)
            clear()
        if signum:
            raise KeyboardInterrupt
