"""Scenarios, studies and the command line."""

from __future__ import annotations

import _signal
import os
import sys


def answer(signum: int, frame: object) -> None:
    """End at an interrupt that comes before the guard of the command stands."""
    os.write(2, b"apu: interrupted; nothing was written; run the same command again\n")
    os._exit(128 + signum)


def _is_command() -> bool:
    """Whether this process is the command ``apu``, and not a program that imports the package."""
    name = os.path.basename(sys.argv[0]) if sys.argv else ""
    if "--multiprocessing-fork" in sys.orig_argv:  # a worker, which has its parent's sys.argv
        return False
    return name in ("apu", "apu.exe") or (name == "-m" and "scenarios.cli" in sys.orig_argv)


# here, since the first lines of the package run at once; what follows may take long to import
if _is_command():
    # small matrices: threads of the linear algebra only wait for each other
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
        _signal.signal(_signal.SIGINT, answer)
