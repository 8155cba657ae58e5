"""Waveforms of a unit as netCDF-4: written in memory, with the same bits for the same numbers.

One dimension ``sample`` runs through all runs of the unit, the other is the generator; ``run`` and
``time`` say where a sample belongs.  Numbers are packed without loss.  The file has no time of
making: that of the set is in its metadata.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.core import cf, files
from apu_casadi.core.errors import DataError
from apu_casadi.core.results import GENERATOR
from apu_casadi.unit.runsignals import RUN
from estimators.apu.sensors import ELECTRICAL

MACHINES = (1, 2)
UNITS = {s.name: s.unit for s in ELECTRICAL.sensors}
"""Unit of what is measured at each generator."""
WAVES = {f"{n}_{k}": unit for k in MACHINES for n, unit in UNITS.items()}
"""Unit of each column, generator by generator."""
ENDING, FORMAT = ".nc", "application/x-netcdf"
_SAMPLE = "sample"
_IN_MEMORY: dict[str, Any] = {
    "driver": "core",
    "backing_store": False,
    "rdcc_nbytes": 0,
    "track_order": True,
}
"""Without a cache of chunks, which are written at the time of the garbage collection otherwise: in
another order where threads of others run."""
_PACKED = {"compression": "gzip", "compression_opts": 4, "shuffle": True}


def meaning(name: str) -> str:
    """Return what a reading is of."""
    return RUN[name].doc if name in RUN else "electrical speed of the rotor"


def _described(parts: Sequence[dict[str, np.ndarray]], title: str) -> Any:
    import xarray as xr

    of = {n: np.concatenate([p[n] for p in parts]) for n in ("run", "time", *WAVES)}
    ds = xr.Dataset(attrs={"title": title, "precision": "waveforms as measured, single precision"})
    for name, unit in UNITS.items():
        told = {"units": unit, "long_name": f"{meaning(name)}, as measured"}
        both = np.stack([of[f"{name}_{k}"] for k in MACHINES])
        ds[name] = ((GENERATOR, _SAMPLE), both, {**told, "coordinates": "run time"})
    ds[GENERATOR] = (GENERATOR, np.array(MACHINES, np.int32), {"units": "1"})
    ds["run"] = (_SAMPLE, of["run"], {"units": "1", "long_name": "number of the run"})
    told = {"units": "s", "long_name": "time since the start of the run"}
    ds["time"] = (_SAMPLE, of["time"], told)
    made = cf.described(ds.set_coords(["run", "time"]))
    for word in ("date_created", "time_coverage_duration"):  # time begins again with each run
        made.attrs.pop(word, None)
    return made


def packed(parts: Sequence[dict[str, np.ndarray]], title: str) -> bytes:
    """Return the file of a unit's runs.

    Args:
        parts: of each run ``run``, ``time`` and the columns ``WAVES``.
        title: of the data set.
    """
    ds = _described(parts, title)
    h5py, h5netcdf = import_module("h5py"), import_module("h5netcdf")
    with h5py.File(f"{id(ds)}", "w", **_IN_MEMORY) as image:
        with h5netcdf.File(image, "w") as f:
            f.dimensions = dict(ds.sizes)
            f.attrs.update(ds.attrs)
            for name, v in ds.variables.items():
                chunk = tuple(1 if d == GENERATOR else ds.sizes[d] for d in v.dims)
                how = {"chunks": chunk, **_PACKED} if _SAMPLE in v.dims else {}
                f.create_variable(name, v.dims, v.dtype, data=v.values, **how).attrs.update(v.attrs)
        image.flush()
        return bytes(image.id.get_file_image())


def frame(path: Path) -> Any:
    """Return the waveforms of a unit as a pandas.DataFrame: ``run``, ``time``, ``v_a_1``, ...

    Raises:
        DataError: a damaged file, or no package that reads it.
    """
    raw = io.BytesIO(files.read_bytes(path))
    try:
        with import_module("h5netcdf").File(raw, "r") as f:
            found = {n: f.variables[n][...] for n in ("run", "time", *UNITS)}
    except ImportError as e:
        raise DataError(f"{path} needs: pip install 'apu-casadi[netcdf4]' ({e})") from None
    except Exception as e:  # damaged files fail with any type
        raise DataError(f"{path}: damaged ({type(e).__name__}: {e})") from None
    columns = {n: found[n] for n in ("run", "time")}
    columns |= {f"{n}_{k}": found[n][i] for i, k in enumerate(MACHINES) for n in UNITS}
    return import_module("pandas").DataFrame(columns)
