"""Standard streams that cannot take a text, and errors as one sentence with an exit status."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path

from apu_casadi.core import files
from apu_casadi.core.errors import ApuError, EstimationError, OperatingPointError, SimulationError
from scenarios.shell import guard

LONGEST = 1200
"""Characters of a message; what a damaged file holds may be of any length."""

ROOT = Path(__file__).resolve().parents[2]


@contextlib.contextmanager
def tolerant() -> Iterator[None]:
    """Let stdout and stderr print what their encoding lacks as an escape, and nothing if closed."""
    changed, closed = [], [name for name in ("stdout", "stderr") if getattr(sys, name) is None]
    for name in closed:
        with contextlib.suppress(OSError):
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if getattr(stream, "errors", None) == "strict" and hasattr(stream, "reconfigure"):
            with contextlib.suppress(OSError, ValueError):
                stream.reconfigure(errors="backslashreplace")
                changed.append(stream)
    try:
        yield
    finally:
        for stream in changed:
            with contextlib.suppress(OSError, ValueError):
                stream.reconfigure(errors="strict")
        for name in closed:
            stream = getattr(sys, name)
            setattr(sys, name, None)
            if stream is not None:
                stream.close()


def finish(status: int, *, own: bool) -> int:
    """Flush what was printed; return the exit status, 2 if stdout could not take it."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        _to_nowhere(own)
    except (OSError, ValueError) as e:
        if status == 0:
            guard.say(f"apu: error: standard output: cannot be written: {files.reason(e)}")
            status = 2
        _to_nowhere(own)
    return status


def _to_nowhere(own: bool) -> None:
    """Let what stdout still holds go nowhere, lest the interpreter fail on it at its end."""
    with contextlib.suppress(OSError, ValueError, AttributeError):
        if own or sys.stdout is sys.__stdout__:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def explain(e: Exception, *, program: bool) -> tuple[str, int] | None:
    """Return an error as one line, and the exit status; None for a fault of the program.

    Args:
        e: the error.
        program: say that of a fault of the program too, with its place.
    """
    if isinstance(e, ApuError):
        failed = isinstance(e, EstimationError | OperatingPointError | SimulationError)
        return one_line(e), 1 if failed else 2
    if isinstance(e, OSError):
        return _system(e), 2
    if isinstance(e, MemoryError):
        what = "not enough memory; ask for fewer points, runs or waveforms, or a shorter time"
        return what, 1
    if not program or os.environ.get("APU_TRACEBACK"):
        return None
    frames = traceback.extract_tb(e.__traceback__)
    ours = [f for f in frames if Path(f.filename).is_relative_to(ROOT)] or frames
    at = f"{Path(ours[-1].filename).name}, line {ours[-1].lineno}"
    ask = "a fault of this program; please report it, with what APU_TRACEBACK=1 shows"
    return f"{type(e).__name__}: {one_line(e)} ({at}): {ask}", 1


def _system(e: OSError) -> str:
    name = e.filename if isinstance(e.filename, str | bytes | os.PathLike) else None
    if name is not None:
        return one_line(f"{os.fsdecode(name)}: cannot be read or written: {files.reason(e)}")
    if e.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EBADF):
        return f"standard output: cannot be written: {files.reason(e)}"  # files have their names
    return one_line(f"the system refuses: {files.reason(e)}")


def one_line(text: object) -> str:
    """Return a text without line breaks; of a very long one, beginning and end."""
    line = " ".join(str(text).split())
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 400]} ... {line[-300:]}"
