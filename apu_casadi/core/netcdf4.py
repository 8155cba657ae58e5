"""netCDF 4 files, read by xarray where a package for them is installed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from apu_casadi.core.errors import DataError

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["MARK", "read"]

#: What such a file begins with.
MARK = b"\x89HDF"


def read(path: Path) -> xr.Dataset:
    """Read a netCDF 4 file, times as the file has them.

    Raises:
        DataError: no package that reads it, a damaged file, or variables in groups alone.
    """
    import xarray as xr

    try:
        with xr.open_dataset(path, decode_times=False) as ds:
            data = ds.load()
    except ValueError:
        raise DataError(
            f"{path}: a netCDF 4 file; reading it needs: pip install h5netcdf h5py"
        ) from None
    except Exception as e:  # damaged files fail with any type
        raise DataError(f"{path}: damaged netCDF file ({type(e).__name__}: {e})") from None
    if not data.variables:
        groups = _groups(path)
        if groups:
            raise DataError(
                f"{path}: the variables are in groups ({', '.join(groups)}), which are not read: "
                "save one of them as a file of its own, xarray.open_dataset(path, group=...)"
            )
    return data


def _groups(path: Path) -> list[str]:
    import xarray as xr

    try:
        return [g for g in xr.open_groups(path, decode_times=False) if g != "/"]
    except Exception:  # only for the message
        return []
