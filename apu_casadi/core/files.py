"""Files that are written whole or not at all, and what went wrong with one, as a sentence.

Everything that this package writes goes through :func:`whole`: under a temporary name beside the
file, flushed to the disk, then renamed.  A full disk, a kill or Ctrl-C leave the former file.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from apu_casadi.core.errors import DataError

PARTIAL: set[str] = set()
"""Temporary files that are being written now; who ends the process at once deletes them first."""

WRITTEN: dict[str, None] = {}
"""Files finished so far, in order, while :func:`account` is on: what an interruption leaves."""

_account = False
_count = itertools.count()

_ADVICE = {
    errno.ENOSPC: "free some space, or write elsewhere",
    errno.EDQUOT: "free some space, or write elsewhere",
    errno.EFBIG: "the limit on the size of a file is reached (ulimit -f); write elsewhere",
    errno.EACCES: "choose a place for which you have the right",
    errno.EPERM: "choose a place for which you have the right",
    errno.EROFS: "write elsewhere",
    errno.ENOENT: "check the path",
    errno.ENOTDIR: "a part of the path is a file; check the path",
    errno.EEXIST: "a file stands where a folder is needed; check the path",
    errno.EISDIR: "name a file in it",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ELOOP: "the links lead in a circle; check them",
    errno.EMFILE: "raise the number of open files (ulimit -n)",
    errno.ENFILE: "close other programs",
    errno.EIO: "check the disk",
}


def reason(e: OSError | ValueError) -> str:
    """Return what the system says, and what to do about it."""
    if not isinstance(e, OSError):  # a zero byte in a name, or one that has no code
        return f"no possible file name ({e})"
    said = e.strerror or str(e) or type(e).__name__
    advice = _ADVICE.get(e.errno or 0)
    return f"{said}; {advice}" if advice else said


def account(keep: bool) -> None:
    """Keep, or no longer keep, account of the files that are finished; begin with none."""
    global _account
    _account = keep
    WRITTEN.clear()


def folder(path: str | os.PathLike[str]) -> Path:
    """Make a folder for results and return it.

    Raises:
        DataError: that is impossible, or nothing may be written there.
    """
    place = Path(path)
    try:
        place.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as e:
        raise DataError(f"{place}: cannot make the folder for results: {reason(e)}") from None
    if not os.access(place, os.W_OK | os.X_OK):
        raise DataError(f"{place}: no permission to write results there")
    return place


def read_bytes(path: str | os.PathLike[str], what: str = "", limit: int = 1 << 40) -> bytes:
    """Return the bytes of a regular file; a device or a pipe might never end.

    Args:
        path: the file.
        what: what it should be, for the message.
        limit: largest size, bytes.

    Raises:
        DataError: it cannot be read; says which, why, and what to do.
    """
    with _opened(path, what, limit) as f:
        return f.read()


def beginning(path: str | os.PathLike[str], n: int) -> tuple[bytes, int]:
    """Return the first ``n`` bytes of a regular file, and its size in bytes.

    Raises:
        DataError: as :func:`read_bytes`.
    """
    with _opened(path, "", 1 << 62) as f:
        return f.read(n), os.fstat(f.fileno()).st_size


@contextlib.contextmanager
def _opened(path: str | os.PathLike[str], what: str, limit: int) -> Iterator[IO[bytes]]:
    """Open a regular file for reading; what goes wrong in the block is told as its own."""
    begin = f"{path}: {what} cannot be read" if what else f"{path}: cannot be read"
    try:
        with open(path, "rb", opener=_without_waiting) as f:
            status = os.fstat(f.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise DataError(f"{begin}: no regular file")
            if status.st_size > limit:
                raise DataError(f"{begin}: {status.st_size} bytes, {limit} at most")
            yield f
    except (OSError, ValueError) as e:
        if isinstance(e, DataError):
            raise
        raise DataError(f"{begin}: {reason(e)}") from None


def _without_waiting(path: str, flags: int) -> int:
    # opening a pipe would wait for its writer
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def read_text(path: str | os.PathLike[str], what: str = "", limit: int = 1 << 28) -> str:
    """Return the text of a UTF-8 file, without a byte-order mark; line ends become ``\\n``.

    Raises:
        DataError: as :func:`read_bytes`, or no UTF-8, with the place of the first wrong byte.
    """
    raw = read_bytes(path, what, limit)
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as e:
        line = raw[: e.start].count(b"\n") + 1
        raise DataError(
            f"{path}: {what + ' ' if what else ''}cannot be read: not UTF-8 text (byte "
            f"{raw[e.start]:#04x} in line {line}); save it as UTF-8"
        ) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


@contextlib.contextmanager
def whole(
    path: str | os.PathLike[str], *, make_folder: bool = True, refusal: str = "cannot be written"
) -> Iterator[Path]:
    """Yield the name under which to write; it becomes ``path`` when the block has ended well.

    What the block raises leaves the former file as it was.  A symbolic link stays and its target is
    replaced; a device or a pipe is written directly.

    Args:
        path: the file.
        make_folder: make the folders that are missing on the way.
        refusal: what cannot be done, for the message.

    Raises:
        DataError: the file cannot be written; says which, why, and what to do.
    """
    path = Path(path)
    try:
        real = Path(os.path.realpath(path))
        if make_folder:
            real.parent.mkdir(parents=True, exist_ok=True)
        mode = _mode(real)
    except (OSError, ValueError) as e:
        raise DataError(f"{path}: {refusal}: {reason(e)}") from None
    device = mode is not None and not stat.S_ISREG(mode)
    # short, because the name itself may be as long as names can be
    target = real if device else real.with_name(f".{os.getpid()}-{next(_count)}.part")
    if not device:
        PARTIAL.add(str(target))
    try:
        yield target
        if not device:
            with open(target, "rb+") as f:
                os.fsync(f.fileno())
            if mode is not None:
                os.chmod(target, stat.S_IMODE(mode))
            os.replace(target, real)
    except OSError as e:
        raise DataError(f"{path}: {refusal}: {reason(e)}{_amounts(e, target)}") from None
    finally:
        if not device:
            with contextlib.suppress(OSError):
                os.unlink(target)
            PARTIAL.discard(str(target))
    if _account:
        WRITTEN[str(path)] = None


def _amounts(e: OSError, target: Path) -> str:
    """Return how much was written and is free, where there was no room; "" elsewhere."""
    if e.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return ""
    try:
        written, free = target.stat().st_size, shutil.disk_usage(target.parent).free
    except OSError:
        return ""
    return f" ({written} bytes of it were written, {free} bytes are free there)"


def _mode(real: Path) -> int | None:
    """Return the mode of the file there, None if there is none; raise if it must not be written."""
    try:
        mode = os.stat(real).st_mode
    except FileNotFoundError:
        return None
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not os.access(real, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    return mode


def write_text(
    path: str | os.PathLike[str], text: str, *, refusal: str = "cannot be written",
    make_folder: bool = True,
) -> Path:  # fmt: skip
    """Write a text file in UTF-8, whole or not at all; return its path.

    Raises:
        DataError: as :func:`whole`.
    """
    with whole(path, refusal=refusal, make_folder=make_folder) as target:
        # a name from the system that is no UTF-8 stands in the text as \udc.., not as an error
        target.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")
    return Path(path)


@contextlib.contextmanager
def work_folder() -> Iterator[Path]:
    """Yield a folder of the system's for what is needed in between; it goes with the block.

    Raises:
        DataError: there is no room for it; says where it is.
    """
    try:
        with tempfile.TemporaryDirectory() as made:
            yield Path(made)
    except OSError as e:
        raise DataError(
            f"{tempfile.gettempdir()}: temporary files cannot be written: {reason(e)}; TMPDIR "
            "names another place for them"
        ) from None


def save_figure(figure: Any, path: str | os.PathLike[str], **options: Any) -> Path:
    """Write a Matplotlib figure, whole or not at all; the ending of ``path`` tells the format.

    Raises:
        DataError: as :func:`whole`, or a format that cannot be drawn.
    """
    path = Path(path)
    form = path.suffix[1:].lower() or "png"
    known = figure.canvas.get_supported_filetypes()
    if form not in known:
        raise DataError(
            f"{path}: cannot be drawn as .{form}; the ending must be one of "
            f"{', '.join('.' + k for k in sorted(known))}"
        )
    with whole(path) as target:
        figure.savefig(target, format=form, **options)
    return path
