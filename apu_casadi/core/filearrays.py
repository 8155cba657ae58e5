"""Arrays that stay in a file: read where and when they are asked for, as xarray's lazy arrays.

:class:`RowFile` is a temporary file of named rows of numbers, for results that are too large for
memory; :func:`lazy` makes of a part of any file what a variable of a dataset can hold.  Values are
read anew each time that they are asked for, so that looking at all of them, one after the other,
needs the memory of one.
"""

from __future__ import annotations

import math
import os
import tempfile
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import DataError

if TYPE_CHECKING:
    import xarray as xr

CHUNK = 1 << 19
"""Numbers that are read, converted or written at once: 4 MiB of doubles."""


class File:
    """An open file that several arrays read from; closed when the last of them is gone."""

    def __init__(self, f: IO[bytes], name: str) -> None:
        """Take over an open binary file; ``name`` is for messages."""
        self._f = f
        self.name: str = name
        self._lock = threading.Lock()

    def read(self, offset: int, size: int) -> bytearray:
        """Return ``size`` bytes from ``offset``.

        Raises:
            DataError: the file ends before, or cannot be read.
        """
        data = bytearray(size)
        view, done = memoryview(data), 0
        try:
            while done < size:
                n = self._read_at(offset + done, view[done:])
                if not n:
                    break
                done += n
        except OSError as e:
            raise DataError(f"{self.name}: cannot be read: {e.strerror or e}") from e
        if done < size:
            raise DataError(
                f"{self.name}: damaged: it ends at byte {offset + done}, {offset + size} expected"
            )
        return data

    def write(self, offset: int, data: bytes | memoryview) -> None:
        """Write at ``offset``; :class:`DataError` where that is impossible."""
        try:
            view = memoryview(data)
            while len(view):
                n = self._write_at(offset, view)
                offset, view = offset + n, view[n:]
        except OSError as e:
            raise DataError(f"{self.name}: cannot be written: {e.strerror or e}") from e

    # a place of its own for each call: threads and forked processes share that of the file

    def _read_at(self, offset: int, view: memoryview) -> int:
        if hasattr(os, "preadv"):
            return os.preadv(self._f.fileno(), [view], offset)
        with self._lock:
            self._f.seek(offset)
            return int(self._f.readinto(view))  # type: ignore[attr-defined]

    def _write_at(self, offset: int, view: memoryview) -> int:
        if hasattr(os, "pwrite"):
            return os.pwrite(self._f.fileno(), view, offset)
        with self._lock:
            self._f.seek(offset)
            return self._f.write(view)

    def __del__(self) -> None:
        self._f.close()


def read(
    file: File, offset: int, shape: tuple[int, ...], dtype: np.dtype[Any], key: tuple[Any, ...]
) -> np.ndarray:
    """Return a part of an array in C order that begins at ``offset``, in native byte order.

    Args:
        key: an integer or a slice for each dimension; of the first one only what is asked for (and
            what lies between) is read, in pieces.
    """
    native = dtype.newbyteorder("=")
    if not shape:
        scalar = np.frombuffer(file.read(offset, dtype.itemsize), dtype)
        return np.asarray(scalar.astype(native)[0])
    first, *rest = key
    n, row = shape[0], int(np.prod(shape[1:], dtype=np.int64))
    one = not isinstance(first, slice)
    wanted = range((at := range(n)[first]), at + 1) if one else range(n)[first]
    if not wanted:
        return np.empty((0, *shape[1:]), native)[(slice(None), *rest)]
    lo, hi = min(wanted[0], wanted[-1]), max(wanted[0], wanted[-1]) + 1
    out = np.empty((hi - lo, *shape[1:]), native)
    flat = out.reshape(-1)
    for k in range(0, flat.size, CHUNK):
        part = flat[k : k + CHUNK]
        begin = offset + (lo * row + k) * dtype.itemsize
        part[:] = np.frombuffer(file.read(begin, part.size * dtype.itemsize), dtype)
    # backwards, the first of the wanted ones is the last that was read
    out = out[wanted[0] - lo :: wanted.step][: len(wanted)]
    return out[(0 if one else slice(None), *rest)]


def lazy(file: File, offset: int, shape: tuple[int, ...], dtype: Any) -> Any:
    """Return what a variable of a dataset can hold, and ``numpy.asarray`` reads.

    Args:
        file: where the numbers are.
        offset: of the first byte.
        shape, dtype: of the array; its byte order is that of the file.
    """
    from xarray.core import indexing

    array = _backend_array()(file, offset, shape, np.dtype(dtype))
    return indexing.CopyOnWriteArray(indexing.LazilyIndexedArray(array))


_CLASS: list[Any] = []


def _backend_array() -> Any:
    """Return the class of the arrays; it derives from one of xarray, which is imported late."""
    if _CLASS:
        return _CLASS[0]
    from xarray.backends import BackendArray
    from xarray.core import indexing

    class FileArray(BackendArray):
        """An array in a file; pickled by its values, since the file may be a temporary one."""

        def __init__(
            self, file: File, offset: int, shape: tuple[int, ...], dtype: np.dtype[Any]
        ) -> None:
            self.file, self.offset, self.stored = file, offset, dtype
            self.shape, self.dtype = shape, dtype.newbyteorder("=")

        def __getitem__(self, key: Any) -> Any:
            """Return the part that an xarray indexer asks for."""
            return indexing.explicit_indexing_adapter(
                key,
                self.shape,
                indexing.IndexingSupport.BASIC,
                lambda k: read(self.file, self.offset, self.shape, self.stored, k),
            )

        def __deepcopy__(self, memo: object) -> Any:
            """Return itself: nothing changes the file."""
            return self

        def __reduce__(self) -> Any:
            key = (slice(None),) * len(self.shape)
            return _in_memory, (read(self.file, self.offset, self.shape, self.stored, key),)

    _CLASS.append(FileArray)
    return FileArray


def _in_memory(values: np.ndarray) -> Any:
    from xarray.core import indexing

    return indexing.NumpyIndexingAdapter(np.asarray(values))


class RowFile:
    """A temporary file of named rows of doubles, which vanishes with the last array that is in it.

    Args:
        lengths: of the rows, by name.
        folder: where the file is made; the system's folder of temporary files by default.

    Raises:
        DataError: no file can be made there, or there is no room for it.
    """

    def __init__(
        self, lengths: Mapping[str, int], folder: str | os.PathLike[str] | None = None
    ) -> None:
        """Make the file, with all the room that it needs where the system can say so."""
        place = Path(tempfile.gettempdir() if folder is None else folder)
        self.size: int = 8 * sum(lengths.values())
        try:
            f = tempfile.TemporaryFile(dir=place, prefix="apu-casadi-", buffering=0)  # noqa: SIM115
            if hasattr(os, "posix_fallocate") and self.size:
                os.posix_fallocate(f.fileno(), 0, self.size)
        except OSError as e:
            raise DataError(
                f"{place}: no temporary file of {self.size / 2**20:.0f} MiB can be made there: "
                f"{e.strerror or e}"
            ) from e
        self.file: File = File(f, f"temporary file in {place}")
        ends = np.cumsum([0, *lengths.values()])
        self._rows: dict[str, tuple[int, tuple[int, ...]]] = {
            name: (int(8 * at), (n,)) for (name, n), at in zip(lengths.items(), ends, strict=False)
        }

    def write(self, name: str, start: int, values: np.ndarray) -> None:
        """Write values into a row from its element ``start``."""
        at, shape = self._rows[name]
        a, n = np.ascontiguousarray(values, dtype=float), math.prod(shape)
        if start < 0 or start + a.size > n:
            raise DataError(f"row {name}: elements {start} to {start + a.size} of {n}")
        self.file.write(at + 8 * start, memoryview(a.reshape(-1)).cast("B") if a.size else b"")

    def add(self, name: str, values: np.ndarray) -> Any:
        """Write one more row or array at the end of the file; return it as a lazy array."""
        self._rows[name] = (self.size, values.shape)
        self.size += 8 * values.size
        self.write(name, 0, values)
        return self.array(name)

    def array(self, *names: str) -> Any:
        """Return a row as a lazy array; several of one length that follow each other as 2-D."""
        at, shape = self._rows[names[0]]
        if len(names) > 1:
            shape = (len(names), *shape)
        return lazy(self.file, at, shape, np.dtype(float))


def pieces(variable: xr.Variable) -> Iterator[np.ndarray]:
    """Yield the values of a variable in C order, in pieces of about :data:`CHUNK` numbers."""
    if variable.ndim == 0:
        yield variable.values.reshape(1)
        return
    row = max(1, int(np.prod(variable.shape[1:], dtype=np.int64)))
    step = max(1, CHUNK // row)
    for k in range(0, variable.shape[0], step):
        yield variable[k : k + step].values.reshape(-1)


def is_lazy(a: object) -> bool:
    """Whether an array is one of :func:`lazy`."""
    from xarray.core import indexing

    return isinstance(a, indexing.CopyOnWriteArray)
