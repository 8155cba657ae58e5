"""One process at a time in a folder of results: a lock that ends with the process that holds it.

The lock is one of the operating system on an open file (``flock``, on Windows a locked byte), so a
process that crashed or was killed leaves nothing behind that must be cleared by hand.  The file
also says who holds it, for the message to the others; what it says is never taken for the lock.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO

from apu_casadi.core.errors import DataError

POLL = 0.2  # s between two attempts
_FAR = 1 << 30  # the byte that is locked on Windows; those before it stay readable
_BUSY = {errno.EACCES, errno.EAGAIN, errno.EDEADLK}
_log = logging.getLogger("apu_casadi")


@contextlib.contextmanager
def locked(
    folder: Path,
    name: str,
    *,
    wait: bool = True,
    say: Callable[[str], None] | None = None,
) -> Iterator[None]:
    """Hold the lock ``name`` of a folder; another process that holds it is waited for, or refused.

    Where the file system knows no locks (some network drives), a warning says so, and the work
    goes on without.

    Args:
        folder, name: the folder, which exists, and the file in it that is locked.
        wait: wait until the other process has ended; False raises at once.
        say: called once with a sentence that names the other process, before waiting; by default
            the sentence goes to the log ``apu_casadi`` as a warning.

    Raises:
        DataError: another process holds it and ``wait`` is False, or the file cannot be written.
    """
    path = folder / name
    told = False
    while True:
        f = _open(path)
        try:
            held = _try_lock(f, path)
            if held and _is(f, path):
                break
        except BaseException:
            f.close()
            raise
        owner = "" if held else _owner(f)
        f.close()
        if held:  # the process before removed the file between our opening and locking it
            continue
        text = f"{folder} is in use by {owner or 'another process'}"
        if not wait:
            raise DataError(f"{text}: let it end, or choose another folder")
        if not told:
            (say or _log.warning)(f"{text}; waiting until it ends")
            told = True
        time.sleep(POLL)
    try:
        _sign(f)
        yield
    finally:
        with contextlib.suppress(OSError):  # Windows removes no open file
            path.unlink(missing_ok=True)
        f.close()
        if os.name == "nt":
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


def _open(path: Path) -> IO[bytes]:
    try:
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0)
        return os.fdopen(os.open(path, flags, 0o666), "r+b", buffering=0)
    except OSError as e:
        raise DataError(f"{path}: cannot be written: {e.strerror or e}") from None


def _try_lock(f: IO[bytes], path: Path) -> bool:
    """Whether the lock is ours now, or there are no locks here."""
    try:
        if sys.platform == "win32":
            import msvcrt

            f.seek(_FAR)
            msvcrt.locking(f.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(f.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as e:
        if e.errno in _BUSY:
            return False
        why = "see to it that no other process works in this folder"
        _log.warning("%s: no locks on this file system (%s); %s", path, e.strerror or e, why)
    return True


def _is(f: IO[bytes], path: Path) -> bool:
    """Whether the open file is still the one of this name."""
    try:
        return os.path.samestat(os.fstat(f.fileno()), os.stat(path))
    except OSError:
        return False


def _sign(f: IO[bytes]) -> None:
    who = {"pid": os.getpid(), "host": socket.gethostname(), "since": time.strftime("%H:%M:%S")}
    with contextlib.suppress(OSError):  # a full disk: the lock holds without a name
        f.seek(0)
        f.truncate()
        f.write(json.dumps(who).encode())


def _owner(f: IO[bytes]) -> str:
    """Return "process 123 on HOST since 12:00:00", or "" where the file does not say."""
    try:
        f.seek(0)
        who = json.loads(f.read(4096))
        return f"process {int(who['pid'])} on {who['host']} since {who['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return ""
