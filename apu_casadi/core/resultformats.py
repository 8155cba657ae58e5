"""Results in the formats of other tools: compressed netCDF 4, CSV, Parquet, MAT.

netCDF 3, exact and without further packages, is that of :func:`apu_casadi.core.results.save`.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core import cf, files
from apu_casadi.core.errors import DataError, ParameterError, nearest
from apu_casadi.core.results import GENERATOR, generators_of, of_generator, save

if TYPE_CHECKING:
    import xarray as xr

WAVEFORMS = "time_w"
PRECISION = "waveforms in single precision (relative 6e-8), all else in double precision"


def frames(ds: xr.Dataset) -> dict[str, Any]:
    """Return a dataset as one pandas.DataFrame for each of its times, units in names: ``T4 [K]``.

    What each generator has of its own ends in its number: ``v_a_2 [V]``.
    """
    tables = {}
    for dim in (d for d in ds.dims if d != GENERATOR):
        part = ds.drop_dims([d for d in ds.dims if d not in (dim, GENERATOR)])
        columns = {f"{dim} [{ds[dim].attrs.get('units', '1')}]": ds[dim].values}
        for name, variable in part.data_vars.items():
            unit = variable.attrs.get("units", "1")
            if GENERATOR not in variable.dims:
                columns[f"{name} [{unit}]"] = variable.values
                continue
            for k in generators_of(ds):
                columns[f"{name}_{k} [{unit}]"] = of_generator(ds, k)[name].values
        tables[str(dim)] = import_module("pandas").DataFrame(columns)
    return tables


def save_frame(frame: Any, path: Path) -> Path:
    """Write a pandas.DataFrame as CSV or Parquet, by the ending.

    Raises:
        DataError: the file cannot be written, or Parquet without a package for it.
    """
    if path.suffix == ".csv":
        return files.write_text(path, frame.to_csv(index=False, float_format="%.12g"))
    with files.whole(path) as part:
        try:
            frame.to_parquet(part, index=False)
        except ImportError as e:
            raise DataError(f"{path}: Parquet needs pyarrow: {e}") from None
    return path


def _tables(ds: xr.Dataset, path: Path, ending: str) -> list[Path]:
    return [
        save_frame(frame, path.with_name(path.name + ("" if dim == "time" else f"_{dim}") + ending))
        for dim, frame in frames(ds).items()
    ]


def _netcdf4(ds: xr.Dataset, path: Path) -> list[Path]:
    target, packed = path.with_name(path.name + ".nc4"), {"zlib": True, "complevel": 4}
    encoding: dict[Any, dict[str, Any]] = {
        n: packed | ({"dtype": "float32"} if WAVEFORMS in v.dims else {}) for n, v in ds.items()
    }
    told = cf.described(ds)
    if WAVEFORMS in ds.dims:
        told.attrs["precision"] = PRECISION
    try:
        h5netcdf: Any = import_module("h5netcdf")
    except ImportError as e:
        raise DataError(
            f"{target}: netCDF 4 needs: pip install 'apu-casadi[netcdf4]' ({e})"
        ) from None
    from xarray.backends import H5NetCDFStore

    # in memory first: HDF5 ends the process where a disk gets full
    buffer = io.BytesIO()
    with h5netcdf.File(buffer, "w") as f:
        told.dump_to_store(H5NetCDFStore(f), encoding=encoding)
    with files.whole(target) as part:
        part.write_bytes(buffer.getbuffer())
    return [target]


def _mat(ds: xr.Dataset, path: Path) -> list[Path]:
    from scipy.io import savemat

    target = path.with_name(path.name + ".mat")
    ds = cf.described(ds)
    values: dict[str, Any] = {str(n): np.asarray(v.values) for n, v in ds.variables.items()}
    values["units"] = {str(n): v.attrs.get("units", "1") for n, v in ds.variables.items()}
    values["about"] = {str(k): v for k, v in ds.attrs.items()}
    with files.whole(target) as part, part.open("wb") as f:
        savemat(f, values, do_compression=True, long_field_names=True)
    return [target]


FORMATS: Mapping[str, tuple[Callable[[Any, Path], list[Path]], str]] = {
    "nc": (lambda ds, p: [save(ds, p.with_name(p.name + ".nc"))], "netCDF 3, exact"),
    "nc4": (_netcdf4, "netCDF 4, compressed; waveforms in single precision"),
    "csv": (lambda ds, p: _tables(ds, p, ".csv"), "a table for each time step, 12 digits"),
    "parquet": (lambda ds, p: _tables(ds, p, ".parquet"), "the same tables, exact"),
    "mat": (_mat, "MATLAB's, with struct arrays units and about"),
}
"""What a result can be written as: how, and what it is."""


def save_as(ds: xr.Dataset, path: str | Path, form: str) -> list[Path]:
    """Write a dataset in a format and return the paths.

    Args:
        ds: a result.
        path: of the file without its ending; tables of other times add their name.
        form: one of ``FORMATS``.

    Raises:
        ParameterError: an unknown format.
        DataError: the file cannot be written, or the format needs a package that is not there.
    """
    if form not in FORMATS:
        raise ParameterError(f"unknown format {form!r} {nearest(form, FORMATS)}")
    return FORMATS[form][0](ds, Path(path))
