"""Where compiled libraries are kept, and whom that folder must be safe from.

A library that is loaded runs.  So its folder must be one that nobody else can put files into: owned
by this user (or root), writable by no other, and reached through folders in which no other can
rename or replace it.  A folder that is not is refused with one warning, and a private one for
temporary files serves instead.
"""

from __future__ import annotations

import getpass
import logging
import os
import stat
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

__all__ = ["SUFFIX", "cache_folder", "clear_cache", "unsafe", "unsafe_file"]

log: logging.Logger = logging.getLogger("apu_casadi")
SUFFIX: str = {"darwin": ".dylib", "win32": ".dll"}.get(sys.platform, ".so")  # of a library
OTHERS = stat.S_IWGRP | stat.S_IWOTH
_LINKS = 40  # symbolic links followed at most, as the kernel does
_said: set[str] = set()


def say(level: int, text: str) -> None:
    """Log a line once per process."""
    if text not in _said:
        _said.add(text)
        log.log(level, text)


def cache_folder() -> Path | None:
    """Return the folder of the compiled libraries, made if absent; None if there is none.

    ``$APU_CACHE_DIR``, else ``$XDG_CACHE_HOME/apu_casadi`` or ``~/.cache/apu_casadi``; where that
    cannot be written or others can write to it, a private folder for temporary files.  Asked again
    whenever it is used: a folder that is opened to others later is refused from then on.
    """
    first = _first(
        os.environ.get("APU_CACHE_DIR", ""),
        os.environ.get("XDG_CACHE_HOME", ""),
        os.environ.get("HOME", ""),
    )
    try:
        user = str(os.getuid()) if hasattr(os, "getuid") else getpass.getuser()
    except (KeyError, OSError):
        user = "user"
    second = Path(tempfile.gettempdir()) / f"apu_casadi-{user}"
    level, why = logging.INFO, f"cache folder {first} cannot be written"
    if _writable(first):
        reason = unsafe(first)
        if reason is None:
            return first
        level, why = logging.WARNING, f"cache folder {first} is refused, {reason}"
    if _writable(second):
        reason = unsafe(second)
        if reason is None:
            todo = "; chmod go-w, or set APU_CACHE_DIR" if level == logging.WARNING else ""
            say(level, f"{why}; libraries go to {second}{todo}")
            return second
        say(logging.WARNING, f"{why}, and so is {second}, {reason}; using the virtual machine")
        return None
    say(level, f"{why}, nor can {second} be written; using the virtual machine")
    return None


def _first(own: str, xdg: str, home: str) -> Path:
    if own:
        return Path(own)
    if xdg:
        return Path(xdg) / "apu_casadi"
    return Path(home or "~").expanduser() / ".cache" / "apu_casadi"


def _writable(folder: Path) -> bool:
    """Make the folder, private as are its new parents, and try to write there."""
    try:
        folder = folder.absolute()
        if not folder.exists():
            for each in (*reversed(folder.parents), folder):
                if not each.exists():
                    each.mkdir(exist_ok=True, mode=0o700)
        s = folder.stat()
    except (OSError, ValueError):
        return False
    return _tried(str(folder), (s.st_dev, s.st_ino, s.st_uid, s.st_mode))


@lru_cache(maxsize=32)
def _tried(folder: str, _state: tuple[int, ...]) -> bool:
    """Whether a file can be made; asked once for a folder of this identity, owner and mode."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def unsafe(folder: Path) -> str | None:
    """Return who else could put a file into ``folder``, as a text, or None.

    Every folder on the way counts, and both ends of every symbolic link.
    """
    if not hasattr(os, "getuid"):
        return None
    try:
        return _walk(folder, lambda s: s.st_uid in (os.getuid(), 0))
    except (OSError, ValueError) as error:
        return f"it cannot be examined ({error})"


def _walk(folder: Path, mine: Callable[[os.stat_result], bool]) -> str | None:
    at, todo, links = Path("/"), list(reversed(folder.absolute().parts[1:])), 0
    while True:
        s = at.lstat()
        if not mine(s):
            return f"{at} belongs to another user ({s.st_uid})"
        if not todo:
            open_to_others = f"others can write to it (mode {s.st_mode & 0o7777:04o})"
            return open_to_others if s.st_mode & OTHERS else None
        # in a sticky folder nobody moves what is another's
        if s.st_mode & OTHERS and not s.st_mode & stat.S_ISVTX:
            return f"others can rename what is in {at} (mode {s.st_mode & 0o7777:04o})"
        name = todo.pop()
        if name == "..":
            at = at.parent
            continue
        s = (at / name).lstat()
        if not stat.S_ISLNK(s.st_mode):
            at = at / name
            continue
        links += 1
        if links > _LINKS:
            return f"{folder} is a loop of links"
        if not mine(s):
            return f"the link {at / name} belongs to another user ({s.st_uid})"
        target = Path(os.readlink(at / name))
        todo += reversed([p for p in target.parts if p != target.anchor])
        if target.is_absolute():
            at = Path("/")


def unsafe_file(path: Path) -> str | None:
    """Return who else could have written a file of the folder, as a text, or None.

    Raises:
        FileNotFoundError: there is none.
    """
    s = path.lstat()
    if not stat.S_ISREG(s.st_mode):
        return "it is not a regular file"
    if not hasattr(os, "getuid"):
        return None
    if s.st_uid not in (os.getuid(), 0):
        return f"it belongs to another user ({s.st_uid})"
    return f"others can write to it (mode {s.st_mode & 0o7777:04o})" if s.st_mode & OTHERS else None


def clear_cache() -> int:
    """Delete the libraries of the cache folder; return how many there were.

    Libraries that a process has loaded stay usable in it.
    """
    folder = cache_folder()
    n = 0
    for path in folder.glob("apu-*") if folder else ():
        n += path.suffix == SUFFIX
        with suppress(OSError):
            path.unlink()
    return n
