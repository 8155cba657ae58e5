"""Results in CSV, Parquet and MAT files as datasets again: what ``apu run --format`` wrote.

CSV as a spreadsheet saved it again is read, too (:mod:`apu_casadi.core.tables.numbertable`); what
instruments write needs more questions answered: :mod:`estimators.apu.recordings`.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import DataError
from apu_casadi.core.tables.numbertable import read_numbers
from apu_casadi.core.tables.sentinels import sentinel
from apu_casadi.core.units import header

if TYPE_CHECKING:
    import xarray as xr

WAVES = "time_w"
_TIMES = ("time", "t", WAVES)


def read(path: Path) -> xr.Dataset:
    """Read a file by its ending; the table of waveforms beside one of CSV or Parquet, too.

    Columns are named ``T4 [K]``; the first is the time.

    Raises:
        DataError: missing, damaged, no numbers, or a package that is missing.
    """
    ending = path.suffix.lower()
    if ending == ".mat":
        return _mat(path)
    ds = _table(path)
    beside = path.with_name(f"{path.stem}_{WAVES}{path.suffix}")
    return ds.merge(_table(beside)) if beside.is_file() else ds


ENDINGS = (".csv", ".parquet", ".pq", ".mat")


def _dataset(path: Path, columns: Mapping[str, Any], units: Mapping[str, str], dim: str) -> Any:
    import xarray as xr

    made = xr.Dataset()
    for name, values in columns.items():
        a = np.asarray(values)
        if a.dtype.kind not in "fiu":
            raise DataError(
                f"{path}, column {name}: no numbers; a recording is read by read_recording"
            )
        if a.dtype.kind == "f" and (code := sentinel(a, ordered=None)) is not None:
            raise DataError(
                f"{path}, column {name}, row {code + 1}: {a[code]:.9g} stands for no reading in "
                "many files; read_recording with missing = ... reads such files"
            )
        told = {"units": units[name]} if units.get(name) else {}
        made[name] = (dim, a.astype(float), told)
    return made.set_coords([dim])


def _table(path: Path) -> Any:
    pandas: Any = import_module("pandas")
    text = files.read_bytes(path)
    csv = path.suffix.lower() == ".csv"
    if csv and text and not re.match(rb"\w+ \[s\](,[^,;\n\"]+ \[[^,;\n]*\])*\r?\n", text):
        return _spreadsheet(path)
    raw = io.BytesIO(text)
    try:
        frame = pandas.read_csv(raw) if csv else pandas.read_parquet(raw)
    except ImportError as e:
        raise DataError(f"{path} needs: pip install 'apu-casadi[parquet]' ({e})") from None
    except Exception as e:  # damaged files fail with any type
        raise DataError(f"{path}: damaged ({type(e).__name__}: {e})") from None
    if frame.index.name is not None:
        frame = frame.reset_index()
    pairs = [header(str(c)) for c in frame]
    names = [n for n, _ in pairs]
    dim = _time_of(path, [] if frame.empty else names)
    columns = {n: frame.iloc[:, k].to_numpy() for k, n in enumerate(names)}
    return _dataset(path, columns, {n: u or "" for n, u in pairs}, dim)


def _time_of(path: Path, names: Sequence[str]) -> str:
    dim = next((n for n in names if n in _TIMES), None)
    if dim is None:
        raise DataError(
            f"{path}: no result of a run: a column 'time [s]' is expected; recordings of other "
            "forms are read by estimators.apu.recordings.measured.read_recording"
        )
    if len(set(names)) < len(names):
        raise DataError(f"{path}: two columns have one name")
    return dim


def _spreadsheet(path: Path) -> Any:
    """Read a CSV file that is not as it was written: semicolons, decimal commas, another coding."""
    table = read_numbers(path, _TIMES.__contains__, what="result")
    dim = _time_of(path, table.names if table.size else [])
    units = {c.name: c.unit for c in table.columns}
    units[dim] = "s"
    own = {n: "s" if n == dim else u or "" for n, u in units.items()}
    if words := [c for c in table.columns if c.problem and c.name != dim]:
        raise DataError(
            f"{path}, column {words[0].name}: no numbers; a recording is read by read_recording"
        )
    columns = {n: table.numbers(n, own[n], gaps=n != dim, codes=True) for n in table.names}
    return _dataset(path, columns, units, dim)


def _mat(path: Path) -> Any:
    import xarray as xr
    from scipy.io import loadmat

    raw = io.BytesIO(files.read_bytes(path))
    try:
        found = loadmat(raw, squeeze_me=False, simplify_cells=True)
    except NotImplementedError:
        raise DataError(f"{path}: a MAT file of version 7.3: save it with -v7") from None
    except Exception as e:  # damaged files fail with any type
        raise DataError(f"{path}: damaged MAT file ({type(e).__name__}: {e})") from None
    units, about = (found.pop(n, {}) for n in ("units", "about"))
    values = {n: np.squeeze(v) for n, v in found.items() if not n.startswith("__")}
    values = {n: v for n, v in values.items() if getattr(v, "dtype", np.dtype("O")).kind in "fiu"}
    dims = {n: np.atleast_1d(values[n]).size for n in ("time", WAVES, "generator") if n in values}
    if "time" not in dims:
        raise DataError(f"{path}: no result of a run: a variable 'time' is expected")
    made = xr.Dataset(attrs=about if isinstance(about, dict) else {})
    of_unit = units if isinstance(units, dict) else {}
    for n, v in values.items():
        shape = [next((d for d, k in dims.items() if k == size), None) for size in v.shape]
        own = n in dims
        if not own and (None in shape or not shape):
            continue
        place: Any = n if own else shape
        told = {"units": of_unit[n]} if n in of_unit else {}
        made[n] = (place, np.atleast_1d(v) if own else v, told)
    return made.set_coords(list(dims))
