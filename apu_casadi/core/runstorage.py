"""Where a run keeps its results: in memory, or, when they are large, in a temporary file."""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

from apu_casadi.core.errors import DataError
from apu_casadi.core.filearrays import RowFile

IN_MEMORY = 256 * 2**20
"""Bytes of results that are kept in memory unless something else is asked for."""
PIECE = 1 << 15
"""Instants or samples that are gathered before they go to the file together."""
LARGE_FILES = "/var/tmp"
"""Where large temporary files belong by the Filesystem Hierarchy Standard; /tmp is often memory."""
_log = logging.getLogger("apu_casadi")


def place(size: int, storage: str | os.PathLike[str]) -> Path | None:
    """Return the folder for the temporary file of so many bytes; None: keep them in memory.

    Args:
        size: of the results.
        storage: ``"memory"``; a folder; or ``"auto"``: memory for what is small, else the folder
            that the environment names for temporary files (TMPDIR), or the system's.

    Raises:
        DataError: there is no such folder.
    """
    if storage == "memory" or (storage == "auto" and size <= IN_MEMORY):
        return None
    if storage == "auto":
        named = any(os.environ.get(k) for k in ("TMPDIR", "TEMP", "TMP"))
        if not named and os.access(LARGE_FILES, os.W_OK):
            return Path(LARGE_FILES)
        return Path(tempfile.gettempdir())
    folder = Path(storage)
    if not folder.is_dir():
        raise DataError(f"storage {str(folder)!r}: 'auto', 'memory' or a folder is expected")
    return folder


def row_file(lengths: Mapping[str, int], folder: Path, *, needed: bool) -> RowFile | None:
    """Return a temporary file for rows of these lengths in a folder; None: keep them in memory.

    Raises:
        DataError: there is no room for it, and it is ``needed``.
    """
    size = 8 * sum(lengths.values())
    try:
        if shutil.disk_usage(folder).free < size:
            raise DataError(f"{folder}: less than {size / 2**20:.0f} MiB free")
        return RowFile(lengths, folder)
    except (DataError, OSError) as e:
        if needed:
            raise DataError(f"results of {size / 2**20:.0f} MiB cannot be kept: {e}") from None
        _log.warning("%s; the results are kept in memory", e)
    return None
