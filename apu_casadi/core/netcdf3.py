"""Datasets as netCDF 3 files of any size: written in pieces, read in pieces or on demand.

xarray's own writer of this format builds the file in memory, at three times the size of the
dataset.  Here the header is made by it, from a dataset whose long variables are cut to one element,
and their values follow piece by piece.  The format is "64-bit offset" (CDF-2 of the Unidata
netCDF Users Guide, appendix B): a file of any size, variables of less than 4 GiB each.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

import numpy as np

from apu_casadi.core.errors import DataError
from apu_casadi.core.filearrays import File, lazy, pieces

if TYPE_CHECKING:
    import xarray as xr

LONG = 1 << 16
"""Numbers from which on a variable is written in pieces."""
LARGEST = 2**32 - 4
"""Bytes that a variable may have: its size is a number of 32 bits, padded to four bytes."""
_TYPES = {"f8": 6, "f4": 5}
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 4, 6: 8}  # bytes of nc_byte, char, short, int, float, double
_DTYPES = {1: ">i1", 2: "S1", 3: ">i2", 4: ">i4", 5: ">f4", 6: ">f8"}
_STREAMING = 2**32 - 1  # "number of records unknown"
_DIMENSION, _VARIABLE, _ATTRIBUTE = 10, 11, 12
#: What a dataset that was read remembers of its file, and what a variable may carry along.
_HARMLESS = {"source", "original_shape", "dtype", "_FillValue", "chunksizes", "preferred_chunks"}


class _Variable(NamedTuple):
    """A variable in a header: ``attributes`` as bytes, ``begin`` of its data in the file."""

    name: str
    dims: tuple[str, ...]
    attributes: bytes
    type: int
    begin: int


class _Header(NamedTuple):
    """What stands before the data."""

    dims: dict[str, int]
    attributes: bytes
    variables: list[_Variable]


# ------------------------------------------------------------------------------ writing


def write(ds: xr.Dataset, f: IO[bytes]) -> None:
    """Write a dataset to an open binary file, in pieces of a few MiB.

    Raises:
        DataError: a variable is too large for the format.
        OSError: of the file.
    """
    long_ = [n for n in ds.variables if _in_pieces(ds, n)]
    if not long_ or 0 in ds.sizes.values() or any(c not in ds.dims for c in ds.coords):
        f.write(_whole(ds))
        return
    for n in long_:
        size = ds.variables[n].size * ds.variables[n].dtype.itemsize
        if size > LARGEST or max(ds.variables[n].shape) >= 2**31:
            raise DataError(
                f"{n}: {size / 2**30:.2f} GiB; a variable of a netCDF 3 file has less than 4 GiB: "
                "sample more coarsely, or save parts of the run"
            )
    # the long ones, cut to one element, and the others as they are: what encodes them is the same
    cut = ds[long_].isel({d: slice(0, 1) for d in ds[long_].dims})
    heads = _whole(cut), _whole(ds.drop_vars(long_))
    (_, _, pieced), (dims, attributes, others) = (_parsed(h) for h in heads)
    dims = {**{str(d): n for d, n in ds.sizes.items()}, **dims}
    source = {v.name: v for v in [*pieced, *others]}
    order = [source[str(n)] for n in ds.variables]
    sizes = {v.name: _size(v, dims) for v in order}
    begin, placed = len(_header(_Header(dims, attributes, order), sizes)), []
    for v in order:
        placed.append(v._replace(begin=begin))
        begin += _padded(sizes[v.name])
    f.write(_header(_Header(dims, attributes, placed), sizes))
    for v in order:
        if v.name not in long_:
            f.write(heads[1][v.begin : v.begin + sizes[v.name]])
        else:
            for a in pieces(ds.variables[v.name]):
                f.write(memoryview(np.ascontiguousarray(a, dtype=_DTYPES[v.type])).cast("B"))
        f.write(bytes(-sizes[v.name] % 4))


def _whole(ds: xr.Dataset) -> bytes:
    return bytes(ds.to_netcdf(engine="scipy", format="NETCDF3_64BIT"))


def _in_pieces(ds: xr.Dataset, name: Any) -> bool:
    """Whether a variable is long, and its bytes are its values and nothing else."""
    v = ds.variables[name]
    e = v.encoding
    fill = e.get("_FillValue", np.nan)
    return (
        v.size >= LONG
        and v.dtype.str[1:] in _TYPES
        and set(e) <= _HARMLESS
        and np.dtype(e.get("dtype", v.dtype)).newbyteorder("=") == v.dtype.newbyteorder("=")
        and (fill is None or bool(np.isnan(fill)))
    )


def _padded(n: int) -> int:
    return n + -n % 4


def _size(v: _Variable, dims: dict[str, int]) -> int:
    n = _SIZES[v.type]
    for d in v.dims:
        n *= dims[d]
    return n


def _name(text: str) -> bytes:
    raw = text.encode("latin1")
    return struct.pack(">I", len(raw)) + raw + bytes(-len(raw) % 4)


def _list(tag: int, items: list[bytes]) -> bytes:
    if not items:
        return bytes(8)
    return struct.pack(">II", tag, len(items)) + b"".join(items)


def _header(h: _Header, sizes: dict[str, int]) -> bytes:
    ids = {d: k for k, d in enumerate(h.dims)}
    dims = [_name(d) + struct.pack(">I", n) for d, n in h.dims.items()]
    variables = [
        _name(v.name)
        + struct.pack(f">I{len(v.dims)}I", len(v.dims), *(ids[d] for d in v.dims))
        + v.attributes
        + struct.pack(">IIQ", v.type, _padded(sizes[v.name]), v.begin)
        for v in h.variables
    ]
    return b"".join(
        [b"CDF\x02", bytes(4), _list(_DIMENSION, dims), h.attributes, _list(_VARIABLE, variables)]
    )


# ------------------------------------------------------------------------------ the header read


class _Reader:
    """Numbers and names of a header, one after the other; struct.error where it ends too soon."""

    def __init__(self, raw: bytes) -> None:
        self.raw, self.at = raw, 4

    def take(self, n: int) -> bytes:
        """Return the next n bytes, and skip what fills them up to a multiple of four."""
        part = self.raw[self.at : self.at + n]
        if len(part) < n:
            raise struct.error("the header ends too soon")
        self.at += _padded(n)
        return part

    def number(self, form: str = ">I") -> int:
        (n,) = struct.unpack(form, self.take(struct.calcsize(form)))
        return int(n)

    def name(self) -> str:
        return self.take(self.number()).decode("latin1")

    def items(self, tag: int) -> Iterator[int]:
        found, n = self.number(), self.number()
        if found != tag and (found or n):
            raise ValueError(f"tag {tag} expected, {found} found")
        yield from range(n)

    def attributes(self) -> bytes:
        """Skip a list of attributes; return its bytes."""
        start = self.at
        for _ in self.items(_ATTRIBUTE):
            self.name()
            kind, n = self.number(), self.number()
            self.take(n * _SIZES[kind])
        return self.raw[start : self.at]


def _parsed(raw: bytes) -> _Header:
    """Return what stands in a header."""
    r = _Reader(raw)
    records = r.number()
    dims = {r.name(): r.number() for _ in r.items(_DIMENSION)}
    if records not in (0, _STREAMING) and 0 not in dims.values():
        raise ValueError(f"{records} records without a dimension that grows")
    order = list(dims)
    attributes, variables = r.attributes(), []
    for _ in r.items(_VARIABLE):
        name = r.name()
        at = tuple(order[r.number()] for _ in range(r.number()))
        own, kind = r.attributes(), r.number()
        r.number()
        begin = r.number(">Q" if raw[3] == 2 else ">I")
        variables.append(_Variable(name, at, own, kind, begin))
    return _Header(dims, attributes, variables)


def _decoded(attributes: bytes) -> dict[str, Any]:
    """Return attributes as xarray gives them: text, numbers, arrays of numbers."""
    r, found = _Reader(bytes(4) + attributes), {}
    for _ in r.items(_ATTRIBUTE):
        name, kind, n = r.name(), r.number(), r.number()
        raw = r.take(n * _SIZES[kind])
        value: Any
        if _DTYPES[kind] == "S1":
            value = raw.rstrip(b"\0")
            value = value if name == "_FillValue" else value.decode("utf-8", "replace")
        else:
            value = np.frombuffer(raw, _DTYPES[kind]).copy()
            value = value[0] if value.shape == (1,) else value
        found[name] = value
    return found


# ------------------------------------------------------------------------------ reading


def open_lazily(path: Path) -> xr.Dataset:
    """Return the dataset of a file whose variables are read on demand.

    The file stays open as long as the dataset is used.

    Raises:
        OSError: the file cannot be read.
        Exception: of any other kind where it is damaged; the caller knows what to say.
    """
    import xarray as xr

    file = File(path.open("rb", buffering=0), str(path))
    size = path.stat().st_size
    header = _read_header(file, size)
    if 0 in header.dims.values():  # a growing dimension, which we do not write
        with xr.open_dataset(BytesIO(path.read_bytes()), engine="scipy", decode_times=False) as ds:
            return ds.load()
    variables = {}
    for v in header.variables:
        end = v.begin + _size(v, header.dims)
        if end > size:
            raise ValueError(f"{v.name} goes to byte {end}, the file has {size}")
        shape = tuple(header.dims[d] for d in v.dims)
        array = lazy(file, v.begin, shape, _DTYPES[v.type])
        variables[v.name] = xr.Variable(v.dims, array, _decoded(v.attributes))
    ds = xr.Dataset(variables, attrs=_decoded(header.attributes))
    return xr.decode_cf(ds, decode_times=False)


def _read_header(file: File, size: int) -> _Header:
    """Return the header of a file of so many bytes, reading no more than is needed."""
    n = min(1 << 16, size)
    while True:
        raw = bytes(file.read(0, n))
        if raw[:3] != b"CDF" or raw[3] not in (1, 2):
            raise ValueError(f"version {raw[3:4]!r} of the format is not known")
        try:
            return _parsed(raw)
        except struct.error:
            if n == size:
                raise
        n = min(16 * n, size)
