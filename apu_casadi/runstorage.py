"""Where a run keeps its results: in memory, or, when they are large, in a temporary file."""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
from pathlib import Path

from apu_casadi.errors import DataError
from apu_casadi.filearrays import RowFile

__all__ = ["IN_MEMORY", "PIECE", "RowFile", "place"]

IN_MEMORY = 256 * 2**20
"""Bytes of results that are kept in memory unless something else is asked for."""
PIECE = 1 << 15
"""Instants or samples that are gathered before they go to the file together."""
_log = logging.getLogger("apu_casadi")


def place(size: int, storage: str | os.PathLike[str]) -> Path | None:
    """Return the folder for the temporary file of so many bytes; None: keep them in memory.

    Parameters
    ----------
    size : of the results.
    storage : ``"memory"``, ``"auto"`` or a folder.

    Raises
    ------
    DataError : there is no such folder.
    """
    if storage == "memory":
        return None
    if storage != "auto":
        folder = Path(storage)
        if not folder.is_dir():
            raise DataError(f"storage {str(folder)!r}: 'auto', 'memory' or a folder is expected")
        return folder
    if size <= IN_MEMORY:
        return None
    folder = Path(tempfile.gettempdir())
    try:
        free = shutil.disk_usage(folder).free
    except OSError:
        free = 0
    if free < 1.1 * size:
        _log.warning(
            "%s has no room for a temporary file of %.0f MiB: the results are kept in memory",
            folder, size / 2**20,
        )  # fmt: skip
        return None
    return folder
