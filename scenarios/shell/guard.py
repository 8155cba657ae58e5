"""What the process of the command does about signals, and about streams that fail.

A signal (Ctrl-C, kill, a closed terminal) ends the command within a second with status
128 + its number (130, 143, 129) and one line on stderr that says what is kept and how to go on:

- while modules are imported, and at a second signal, at once;
- otherwise by KeyboardInterrupt, so that everything is closed in order;
- where that is not done after :data:`GRACE` seconds, since compiled code does not return or
  something swallows the exception, by a thread that waits for the signal.  CasADi releases Python's
  lock while it works, so that this thread can run.

Files are written under temporary names (:mod:`apu_casadi.core.files`); the thread deletes those.

This module is imported first and imports nothing that takes time.
"""

from __future__ import annotations

import _signal
import _thread
import os
import sys
import time

from scenarios import answer

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from types import FrameType
    from typing import Any

GRACE = 0.6
"""Seconds between a signal and the end of the process at the latest."""

CHILDREN = 0.3
"""Seconds after which processes that were started are killed; a pool then ends in order."""

AGAIN = "run the same command again"

_WORDS = {2: "interrupted", 15: "terminated", 1: "hung up"}
_told = False
_lock = _thread.allocate_lock()
_note = ""


def note(text: str) -> None:
    """Set what an interruption leaves besides finished files, and how to go on."""
    global _note
    _note = text


def line(signum: int) -> str:
    """Return the line on the end of the command by a signal."""
    written = list(_of("files", "WRITTEN") or ())
    kept = ""
    if written:
        more = f" and {len(written) - 3} more" if len(written) > 3 else ""
        kept = f"written: {', '.join(written[:3])}{more}; "
    elif not _note:
        kept = "nothing was written; "
    return f"apu: {_WORDS.get(signum, f'ended by signal {signum}')}; {kept}{_note or AGAIN}"


def _of(module: str, name: str) -> Any:
    """Return a name of a module of apu_casadi; None while that is not wholly imported."""
    return getattr(sys.modules.get(f"apu_casadi.core.{module}"), name, None)


def _record(signum: int) -> None:
    record = _of("interrupts", "record")
    if record is not None:
        record(signum)


class Guard:
    """The context in which a command runs.

    Args:
        own: the process is the command's own: it may be ended, and also SIGTERM and SIGHUP count.
            Otherwise (a call of ``main`` with arguments, from Python) the former handler comes
            back.
    """

    raising: bool

    def __init__(self, own: bool) -> None:
        self.own = own
        self.raising = not own
        self._came = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> Guard:
        global _told, _note
        _told, _note = False, ""
        if self.own:
            _open_closed_streams()
            _wake_a_thread()
        signals = [_signal.SIGINT]
        if self.own:
            signals += [getattr(_signal, n) for n in ("SIGTERM", "SIGHUP") if hasattr(_signal, n)]
        for s in signals:
            before = _signal.getsignal(s)
            # ignored by who started us (nohup, a shell's background), or somebody else's: stays
            if before not in (_signal.SIG_DFL, _signal.default_int_handler, answer):
                continue
            try:
                _signal.signal(s, self._handler)
            except ValueError:  # not the main thread: signals go elsewhere
                break
            self._before[s] = before
        from apu_casadi.core import interrupts

        interrupts.clear()
        interrupts.own(bool(self._before))
        return self

    def __exit__(self, *_: object) -> None:
        """Let the interpreter end in peace, or put the former handlers back."""
        from apu_casadi.core import interrupts

        if self.own:
            self.ignore()
            return
        for s, before in self._before.items():
            _signal.signal(s, before)
        interrupts.own(False)
        interrupts.clear()

    def ignore(self) -> None:
        """Ignore further signals: what they ask for is under way."""
        if self.own:
            for s in self._before:
                _signal.signal(s, _signal.SIG_IGN)

    def _handler(self, signum: int, frame: FrameType | None) -> None:
        again, self._came = self._came, True
        _record(signum)
        if self.own:
            if again or not self.raising or _importing(frame):
                end(signum)
            _quiet()
        raise KeyboardInterrupt


def end(signum: int) -> None:
    """End the process now; temporary files and started processes are cleared away."""
    for path in list(_of("files", "PARTIAL") or ()):
        _try(os.unlink, path)
    _end_children()
    tell(signum)
    os._exit(128 + signum)


def tell(signum: int) -> None:
    """Write the line, once."""
    global _told
    if not _lock.acquire(timeout=0.2):
        return
    try:
        if not _told:
            _told = True
            say(line(signum))
    finally:
        _lock.release()


def say(text: str) -> None:
    """Write a line on stderr, whatever state that is in."""
    stream = sys.stderr
    try:
        if stream is None or isinstance(stream, _Nowhere):
            bar = "\n" if os.isatty(2) else ""  # a progress bar may stand there
            os.write(2, f"{bar}{text}\n".encode(errors="backslashreplace"))
        else:
            stream.write(f"{text}\n")
            stream.flush()
    except (OSError, ValueError):
        pass


class _Nowhere:
    """A stream that takes everything; what solvers say about an interrupt goes there."""

    encoding = "utf-8"

    def write(self, text: str) -> int:
        return len(text)

    def flush(self) -> None:
        pass

    def isatty(self) -> bool:
        return False


def _quiet() -> None:
    """Keep the words of solvers and of the interpreter about the interrupt from stderr."""
    sys.stderr = _Nowhere()
    sys.unraisablehook = lambda _: None
    threading = sys.modules.get("threading")
    if threading is not None:
        threading.__dict__["excepthook"] = lambda _: None


def _importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported; half imported, it may not pass the exception on."""
    while frame is not None:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        frame = frame.f_back
    return False


def _open_closed_streams() -> None:
    """Put the null device where stdin, stdout or stderr is closed; a file would get its number."""
    for fd in (0, 1, 2):
        try:
            os.fstat(fd)
        except OSError:
            try:
                os.open(os.devnull, os.O_RDWR)
            except OSError:
                return


def _wake_a_thread() -> None:
    """Start the thread that waits for a signal; without free file numbers there is none."""
    try:
        read, write = os.pipe()
        os.set_blocking(write, False)
        _signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    except (AttributeError, OSError, ValueError):  # AttributeError: not on Windows
        return
    if hasattr(os, "register_at_fork"):  # a signal to a child is not one to us
        os.register_at_fork(after_in_child=lambda: _signal.set_wakeup_fd(-1))
    _thread.start_new_thread(_watch, (read,))


def _watch(fd: int) -> None:
    signum = 0
    while signum not in _WORDS:
        came = os.read(fd, 1)
        signum = came[0] if came else 0
    _record(signum)  # also where the handler waits for compiled code to return
    _quiet()
    time.sleep(CHILDREN)
    _end_children()
    time.sleep(GRACE - CHILDREN)
    end(signum)


def _end_children() -> None:
    """Kill the processes that were started and are still there (Linux; pools anywhere)."""
    found: set[int] = set()
    try:
        for task in os.listdir("/proc/self/task"):
            with open(f"/proc/self/task/{task}/children", encoding="ascii") as f:
                found |= {int(pid) for pid in f.read().split()}
    except OSError:
        multiprocessing = sys.modules.get("multiprocessing")
        if multiprocessing is not None:
            found = {p.pid for p in multiprocessing.active_children() if p.pid}
    tracker = sys.modules.get("multiprocessing.resource_tracker")
    if tracker is not None:  # ends by itself, after it has cleared away what the pool shared
        found.discard(getattr(tracker._resource_tracker, "_pid", None) or 0)
    for pid in found:
        _try(os.kill, pid, 9)


def _try(call: Callable[..., object], *args: object) -> None:
    try:
        call(*args)
    except OSError:
        return
