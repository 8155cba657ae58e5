"""Labelled results: datasets whose every variable has a unit and a meaning, kept as netCDF.

A joint run (its signals: :mod:`apu_casadi.unit.runsignals`) has two time coordinates: ``time`` [s],
the exchange grid of gas generator and machine, and ``time_w`` [s], the waveform samples (absent if
no waveforms were asked for).  Where generators differ during the run, what belongs to one of them
(``I_a_rms``, ``P_e``, ``mu``, ``v_a``) has the dimension ``generator`` before that of time, with
their numbers from 1 as coordinate; where all stay alike, as in the paper, it has not: then it is
that of each.  ``P_total`` and ``P_inst`` are the unit's.  :func:`of_generator` gives the second
form of either.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core import cf, files, netcdf3, netcdf4, tablefiles
from apu_casadi.core.errors import DataError, SignalError, nearest
from apu_casadi.core.filearrays import is_lazy

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.core.signals import Signal

GENERATOR = "generator"
"""Dimension of what generators have of their own, where they differ; numbers from 1."""
_TOLD = ("units", "long_name")
_TIMES = {
    "time": ("s", "time on the exchange grid"),
    "time_w": ("s", "time of the waveform samples"),
}


def dataset(
    times: Mapping[str, Any],
    values: Mapping[str, Mapping[str, Any]],
    *,
    signals: Iterable[Signal],
    attrs: Mapping[str, str | int | float] | None = None,
    generators: int = 0,
) -> xr.Dataset:
    """Build a labelled dataset from arrays.

    Args:
        times: time coordinates [s] by name, each strictly increasing, shape (n,).
        values: per time coordinate, arrays of shape (n,) or (generators, n), also lazy ones of
            :mod:`apu_casadi.core.filearrays`, or scalars by variable name.
        signals: units and meanings of all of them; of two that have the same name the last counts.
        attrs: attributes of the dataset; text or numbers.
        generators: their number, for what each has of its own.

    Returns:
        xarray.Dataset with ``units`` and ``long_name`` on every variable and coordinate.

    Raises:
        SignalError: a name of unknown unit, a name on two time coordinates, a wrong shape, or a
            time coordinate that is not increasing.

    Examples:
        >>> T4 = Signal("T4", "K", "combustor outlet total temperature")
        >>> ds = dataset({"time": [0.0, 0.02]}, {"time": {"T4": [1273.0, 1272.0]}}, signals=[T4])
        >>> ds["T4"].attrs["units"]
        'K'
    """
    import xarray as xr

    known = {s.name: (s.unit, s.doc) for s in signals}
    coords = {}
    for dim, t in times.items():
        t = np.asarray(t, dtype=float)
        if t.ndim != 1 or t.size == 0 or not np.all(np.isfinite(t)) or np.any(np.diff(t) <= 0):
            raise SignalError(
                f"{dim}: a strictly increasing, finite 1-D array is expected, shape {t.shape} given"
            )
        unit, doc = _TIMES.get(dim, ("s", dim))
        coords[dim] = (dim, t, {"units": unit, "long_name": doc})
    variables: dict[str, Any] = {}
    for dim, group in values.items():
        if dim not in coords:
            raise SignalError(f"values on unknown coordinate {dim!r} {nearest(dim, coords)}")
        n = coords[dim][1].size
        for name, value in group.items():
            if name not in known:
                raise SignalError(f"unit of {name!r} unknown {nearest(name, known)}")
            if name in variables:
                raise SignalError(f"{name}: given on {variables[name][0]} and on {dim}")
            a = value if is_lazy(value) else np.asarray(value, dtype=float)
            if a.shape == (generators, n):
                coords.setdefault(GENERATOR, _numbers(generators))
                variables[name] = ((GENERATOR, dim), a, dict(zip(_TOLD, known[name], strict=True)))
                continue
            if a.shape not in ((), (n,)):
                raise SignalError(f"{name}: shape ({n},) as {dim} expected, got {a.shape}")
            unit, doc = known[name]
            a = np.full(n, float(a)) if a.ndim == 0 else a
            variables[name] = (dim, a, {"units": unit, "long_name": doc})
    return xr.Dataset(variables, coords=coords, attrs=dict(attrs or {}))


def _numbers(n: int) -> tuple[str, np.ndarray, dict[str, str]]:
    """Return the coordinate of n generators."""
    numbers = np.arange(1, n + 1, dtype=np.int32)
    return GENERATOR, numbers, {"units": "1", "long_name": "number of the generator"}


def generators_of(ds: xr.Dataset) -> tuple[int, ...]:
    """Return the numbers of a run's generators that differ; (1,) where all are alike."""
    return tuple(ds[GENERATOR].values.tolist()) if GENERATOR in ds.coords else (1,)


def of_generator(ds: xr.Dataset, number: int = 1) -> xr.Dataset:
    """Return a run as one of its generators has it, without the dimension ``generator``.

    Works for runs whose generators are alike, and for files from before there was a dimension.

    Raises:
        DataError: there is no such generator.
    """
    if GENERATOR in ds.coords:
        if number not in ds[GENERATOR].values:
            raise DataError(f"{source_of(ds)}generator {number}: {generators_of(ds)} are there")
        return ds.sel({GENERATOR: number}, drop=True)
    if not 1 <= number <= int(ds.attrs.get("generators", 2)):
        raise DataError(f"{source_of(ds)}generator {number}: there are {ds.attrs['generators']}")
    return ds


def save(ds: xr.Dataset, path: str | os.PathLike[str]) -> Path:
    """Write a dataset as netCDF 3 and return the path; attributes survive, those of CF join them.

    The file is written under a temporary name beside ``path`` and renamed when it is complete: an
    interrupted write never leaves a damaged file under the final name.  Long variables are written
    in pieces of a few MiB.

    Raises:
        DataError: the file cannot be written there, or a variable has 4 GiB or more.
    """
    path = Path(path)
    with files.whole(path) as target, target.open("wb") as f:
        netcdf3.write(cf.described(ds), f)
    return path


def load(path: str | os.PathLike[str], *, lazy: bool = False) -> xr.Dataset:
    """Read a dataset that :func:`save` wrote, or another one in netCDF 3 or 4.

    CSV, Parquet and MAT files of results are read by their ending, the table of waveforms beside
    that of a run with it; what each generator has of its own is then a variable for each.

    Args:
        path: of the file.
        lazy: read values when they are asked for, each time anew, so that a file larger than memory
            can be looked at; the file stays open with the dataset.  Otherwise all are read now.

    Raises:
        DataError: the file is missing, is no netCDF file, or is damaged; netCDF 4 without h5netcdf.
    """
    path = Path(path)
    if path.suffix.lower() in tablefiles.ENDINGS:
        return tablefiles.read(path)
    start, size = files.beginning(path, 8)
    if start.startswith(netcdf4.MARK):
        return netcdf4.read(path)
    if start[:3] != b"CDF":
        raise DataError(f"{path}: not a netCDF 3 file (it begins with {start!r})")
    try:
        ds = netcdf3.open_lazily(path)
        ds = ds if lazy else ds.load()
    except Exception as e:  # a damaged file fails anywhere inside the reader, with any type
        raise DataError(
            f"{path}: damaged netCDF file of {size} bytes ({type(e).__name__}: {e}); "
            "run the scenario again"
        ) from e
    # the number of records counts for nothing where no dimension can grow
    if start[4:8] != bytes(4) and not ds.encoding.get("unlimited_dims"):
        raise DataError(f"{path}: damaged netCDF file: its header tells of records that it lacks")
    ds.encoding["source"] = str(path)
    return ds


def source_of(ds: xr.Dataset) -> str:
    """Return the file that a dataset was read from, as the beginning of a message, or ``""``."""
    source = ds.encoding.get("source")
    return f"{source}: " if source else ""
