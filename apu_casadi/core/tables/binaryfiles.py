"""Columns of recorded data out of Parquet and netCDF, by pandas and xarray."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError
from apu_casadi.core.results import GENERATOR, load
from apu_casadi.core.tables.columns import Column, Tell, cut, parsed
from apu_casadi.core.units import header, unit_of

__all__ = [
    "dataset_columns",
    "frame_columns",
    "netcdf_columns",
    "parquet_columns",
    "time_dims",
    "typed",
]


def typed(path: Path | str, name: str, unit: Any, raw: Any, tell: Tell) -> Column:
    """Make a column of an array, or of a pandas series, of any type.

    Raises:
        DataError: infinite values, or a word among numbers; names the row.
    """

    def place(k: int) -> str:
        return f"{path}, data row {k + 1}, column {name}"

    dtype = getattr(raw, "dtype", None)
    if type(dtype).__name__ == "CategoricalDtype":
        raw = raw.astype(
            raw.cat.categories.dtype if raw.cat.categories.dtype.kind in "ifuM" else object
        )
        dtype = raw.dtype
    utc = type(dtype).__name__ == "DatetimeTZDtype"
    if utc:
        raw = raw.dt.tz_convert("UTC").dt.tz_localize(None)
    if hasattr(raw, "to_numpy"):
        kind = getattr(dtype, "kind", "O")
        if kind in "iuf" and getattr(dtype, "na_value", None) is not None:  # nullable numbers
            raw = raw.to_numpy(dtype=float, na_value=np.nan) if raw.isna().any() else raw.to_numpy()
        else:
            raw = raw.to_numpy()
    a = (
        np.ma.filled(raw.astype(float), np.nan)
        if isinstance(raw, np.ma.MaskedArray)
        else (np.asarray(raw))
    )
    if a.dtype.kind in "iuf":
        values = a.astype(float)
        if np.isinf(values).any():
            k = int(np.argmax(np.isinf(values)))
            raise DataError(f"{place(k)}: infinite value")
        return Column(name, unit, values, a)
    nothing = np.full(a.shape[0], np.nan)
    if a.dtype.kind in "mM":
        problem = f"{place(0)}: {a[0] if a.size else ''} is no number"
        return Column(name, unit, nothing, a, problem, utc)
    if a.dtype.kind == "S":
        a = np.char.decode(a, "utf-8", "replace")
    cells = [c.decode("utf-8", "replace") if isinstance(c, bytes) else c for c in a.tolist()]
    if a.dtype.kind == "b":
        return Column(name, unit, nothing, a, f"{place(0)}: {cells[0]} is no number")
    if a.dtype.kind == "c":
        return Column(name, unit, nothing, a, f"{place(0)}: complex numbers")
    column = parsed(name, unit, cells, place, tell)
    texts = [c for c in cells if isinstance(c, str) and c.strip()]
    if column.problem is None and texts and np.isfinite(column.values).any():
        tell(f"{place(0)}: numbers written as text, such as {cut(texts[0])}, are read as numbers")
    return column


# ------------------------------------------------------------------------------ Parquet


def parquet_columns(path: Path, tell: Tell) -> list[Column]:
    """Read a Parquet file; what its index holds is a column like the others."""
    engines = ("pyarrow", "fastparquet")
    engine = next((e for e in engines if find_spec(e)), None)
    if engine is None or find_spec("pandas") is None:
        raise DataError(
            f"{path}: reading Parquet needs pandas and pyarrow: pip install pandas pyarrow; or "
            "export the data as CSV"
        )
    pd: Any = import_module("pandas")
    try:
        frame = pd.read_parquet(path, engine=engine)
    except Exception as e:  # damaged files fail with any type
        raise DataError(f"{path}: damaged Parquet file ({type(e).__name__}: {e})") from None
    return frame_columns(path, frame, tell)


def frame_columns(path: Path | str, frame: Any, tell: Tell) -> list[Column]:
    """Return the columns of a pandas.DataFrame, those of its index first."""
    columns = []
    for level in range(frame.index.nlevels):
        values = frame.index.get_level_values(level)
        name = frame.index.names[level]
        if type(frame.index).__name__ == "RangeIndex" and name is None:
            continue
        if name is None:
            name = (
                "time"
                if getattr(values.dtype, "kind", "") in "mM"
                or (type(values.dtype).__name__ == "DatetimeTZDtype")
                else f"index_{level}"
            )
        if name not in frame.columns:
            columns.append(typed(path, *header(str(name)), values.to_series(), tell))
    for i, label in enumerate(frame.columns):
        name, unit = _label(path, label)
        columns.append(typed(path, name, unit, frame.iloc[:, i], tell))
    return columns


def _label(path: Path | str, label: Any) -> tuple[str, Any]:
    """Name and unit of a column; of several levels the first is the name, the second the unit."""
    if not isinstance(label, tuple):
        return header(str(label))
    parts = [str(p).strip() for p in label if str(p).strip()]
    if len(parts) == 2:
        unit = parts[1].strip("[]()")
        if unit_of(unit) is not None:
            return parts[0], unit
    if len(parts) == 1:
        return header(parts[0])
    raise DataError(
        f"{path}: column {label!r} has {len(label)} levels; write one level, NAME [UNIT]: "
        "frame.columns = [...]"
    )


# ------------------------------------------------------------------------------ netCDF


def netcdf_columns(
    path: Path, tell: Tell, dim: str | None = None
) -> tuple[list[Column], dict[str, str]]:
    """Read a netCDF file; return its columns, and why other variables are none."""
    return dataset_columns(path, load(path), tell, dim)


def time_dims(data: Any) -> list[str]:
    """Dimensions along which a dataset has columns, the longest last."""
    data = _each_generator(data)
    found = [d for d in data.sizes if any(v.dims == (d,) for v in data.data_vars.values())]
    return sorted(map(str, found), key=lambda d: int(data.sizes[d]))


def _each_generator(data: Any) -> Any:
    """A dataset without the dimension of generators, whose numbers end the names instead."""
    if GENERATOR not in data.dims or data.sizes[GENERATOR] == 1:
        return data
    many = [n for n, v in data.data_vars.items() if GENERATOR in v.dims]
    numbers = 1 + np.arange(data.sizes[GENERATOR])
    numbers = data[GENERATOR].values if GENERATOR in data.coords else numbers
    out = data.drop_vars([*many, *(n for n, v in data.coords.items() if GENERATOR in v.dims)])
    for n in many:
        for k, number in enumerate(numbers):
            out[f"{n}_{number}"] = data[n].isel({GENERATOR: k}, drop=True)
    return out


def dataset_columns(
    path: Path | str, data: Any, tell: Tell, dim: str | None = None
) -> tuple[list[Column], dict[str, str]]:
    """Return the columns of an xarray.Dataset along one dimension, and why other ones are none.

    What each generator has of its own is a column for each, ``v_a_2``.
    """
    import xarray as xr

    data = _each_generator(data)
    sizes = {str(d): int(n) for d, n in data.sizes.items()}
    if not sizes:
        raise DataError(f"{path}: no data rows")
    if dim is None:
        dim = "time" if "time" in sizes else max(sizes, key=lambda d: sizes[d])
    out, others = [], {}
    for name in [*data.coords, *data.data_vars]:
        v = data[name].squeeze([d for d in data[name].dims if d != dim and sizes[d] == 1])
        if v.dims != (dim,):
            others[str(name)] = (
                f"has the dimensions ({', '.join(map(str, v.dims))}); one value for each {dim} is "
                "expected"
            )
            continue
        try:  # missing_value and _FillValue, scale_factor and add_offset, as xarray knows them
            v = xr.conventions.decode_cf_variable(
                str(name), v.variable, decode_times=False, decode_timedelta=False
            )
            values = v.values
        except Exception as e:  # attributes that are none, of any type
            raise DataError(f"{path}, variable {name}: {type(e).__name__}: {e}") from None
        unit = v.attrs.get("units")
        called = str(name)
        if unit is None:
            called, unit = header(called)  # "T3 [K]"
        out.append(typed(path, called, unit, values, tell))
    return out, others
