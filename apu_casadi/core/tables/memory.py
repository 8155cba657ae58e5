"""Columns of recorded data out of memory: arrays by name, pandas, xarray."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError
from apu_casadi.core.tables.binaryfiles import dataset_columns, frame_columns, typed
from apu_casadi.core.tables.columns import Column, Tell
from apu_casadi.core.units import header

__all__ = ["memory_columns"]


def memory_columns(
    source: str, data: Any, tell: Tell, dim: str | None = None
) -> tuple[list[Column], dict[str, str]]:
    """Return the columns of data in memory, and why others are none.

    Args:
        source, tell: for messages, and who is told.
        data: ``{"T3 [K]": array, ...}`` of one length, an array of columns, shape (K, n), a
            DataFrame or Series, a Dataset or DataArray.
        dim: dimension of a Dataset along which the columns are.

    Raises:
        DataError: of another kind, or arrays of several lengths.
    """
    kind = type(data).__name__
    if kind == "DataArray":
        data = data.to_dataset(name=data.name or "value")
    if hasattr(data, "data_vars"):
        return dataset_columns(source, data, tell, dim)
    if kind == "Series":
        data = data.to_frame()
    if hasattr(data, "iloc"):
        return frame_columns(source, data, tell), {}
    if isinstance(data, np.ndarray) and data.ndim == 2:
        data = {str(k): column for k, column in enumerate(data.T)}
    if not isinstance(data, Mapping):
        raise DataError(
            f"{source}: a file name, a table of arrays by name, a DataFrame or a Dataset is "
            f"expected, got {type(data).__name__}"
        )
    arrays = {
        str(n): v if isinstance(v, np.ma.MaskedArray) else np.asarray(v) for n, v in data.items()
    }
    arrays = {n: a.to_numpy() if hasattr(a, "to_numpy") else a for n, a in arrays.items()}
    shapes = {n: a.shape for n, a in arrays.items()}
    if len(set(shapes.values())) > 1 or any(len(s) != 1 for s in shapes.values()):
        said = ", ".join(f"{n} {s}" for n, s in shapes.items())
        raise DataError(f"{source}: arrays of one shape (K,) are expected, got {said}")
    return [typed(source, *header(n), a, tell) for n, a in arrays.items()], {}
