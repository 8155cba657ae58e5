"""A linear model in a file: netCDF with labelled arrays, or MAT for MATLAB and its like."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core import files, results
from apu_casadi.core.cf import described
from apu_casadi.core.errors import DataError
from apu_casadi.core.signals import Signals

if TYPE_CHECKING:
    from apu_casadi.unit.linearmodel import LinearModel

KINDS = (".nc", ".mat")


def save(model: LinearModel, path: str | Path, told: Mapping[str, Any]) -> Path:
    """Write a linear model; the ending of the name tells the format.

    netCDF has the arrays of :meth:`.LinearModel.labelled`.  MAT has ``A``, ``B``, ``C``, ``D`` with
    u and theta, one after the other, as inputs, and names, units and operating point of ``x``,
    ``u`` (theta behind), ``y``: ``sys = ss(A, B, C, D, 'StateName', x_name, ...)``.

    Args:
        model: the linear model.
        path: of the file, ending in ``.nc`` or ``.mat``.
        told: text and numbers to go with it.

    Raises:
        DataError: another ending, or the file cannot be written.
    """
    path = Path(path)
    if path.suffix not in KINDS:
        raise DataError(f"{path}: a linear model is saved as {' or '.join(KINDS)}")
    title = f"linear model {model.name}"
    if path.suffix == ".nc":
        ds = model.labelled()
        if not len(model.theta):  # a dimension without entries is another thing in netCDF
            ds = ds.drop_dims("theta")
        return results.save(described(ds.assign_attrs(told), title), path)
    import xarray as xr
    from scipy.io import savemat

    A, B, C, D = model.matrices
    values: dict[str, Any] = {"A": A, "B": B, "C": C, "D": D, "model": model.name, **told}
    values["about"] = described(xr.Dataset(), title).attrs
    u, u0 = Signals([*model.u, *model.theta]), np.append(model.u0, model.theta0)
    for k, signals, at in (("x", model.x, model.x0), ("u", u, u0), ("y", model.y, model.y0)):
        for what in ("name", "unit"):
            texts = [getattr(s, what) for s in signals]
            values[f"{k}_{what}"] = np.array(texts, dtype=object)[:, None]
        values[f"{k}0"] = at[:, None]
    with files.whole(path) as new, new.open("wb") as f:
        savemat(f, values | {"xdot0": model.xdot0[:, None]})
    return path
