"""Labelled results: datasets whose every variable has a unit and a meaning, kept as netCDF.

A joint run has two time coordinates: ``time`` [s], the exchange grid of gas generator and machine,
and ``time_w`` [s], the waveform samples (absent if no waveforms were asked for).  Where generators
differ during the run, what belongs to one of them (``I_a_rms``, ``P_e``, ``mu``, ``v_a``) has the
dimension ``generator`` before that of time, with their numbers from 1 as coordinate; where all stay
alike, as in the paper, it has not: then it is that of each.  ``P_total`` and ``P_inst`` are the
unit's.  :func:`of_generator` gives the second form of either.
"""

from __future__ import annotations

import json
import math
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

RPM = 30.0 / math.pi
"""Revolutions per minute in one rad/s."""

SUMMARY_WINDOW = 0.5
"""Length [s] of the window at the end of a phase over which :func:`phase_summary` averages."""


def _stations() -> dict[str, tuple[str, str]]:
    places = {
        "1": "ambient inlet",
        "2": "compressor inlet",
        "3": "compressor outlet",
        "4": "combustor outlet",
        "41": "turbine rotor inlet",
        "5": "turbine outlet",
        "8": "exhaust outlet",
    }
    table = {}
    for n, place in places.items():
        table[f"T{n}"] = ("K", f"{place} total temperature")
        if n != "41":
            table[f"P{n}"] = ("Pa", f"{place} total pressure")
        if n != "1":
            table[f"W{n}"] = ("kg/s", f"{place} mass flow")
    table["P41"] = ("Pa", "turbine rotor inlet total pressure")
    table["W31"] = ("kg/s", "combustor inlet mass flow")
    table["Ps3"] = ("Pa", "compressor outlet static pressure")
    return table


CHANNELS: Mapping[str, tuple[str, str]] = {
    "N": ("rad/s", "gas generator shaft speed"),
    "PW": ("W", "shaft power delivered (PWSD)"),
    "Wf": ("kg/s", "fuel flow"),
    "SFC": ("kg/(W s)", "fuel flow over shaft and accessory power"),
    "SNOx": ("1", "NOx severity index"),
    "SM": ("1", "compressor surge (stability) margin"),
    **_stations(),
    "residual": ("1", "largest scaled residual of the gas path equations"),
    "f_eta_c": ("1", "compressor efficiency factor"),
    "f_W_c": ("1", "compressor flow capacity factor"),
    "f_eta_t": ("1", "turbine efficiency factor"),
    "f_W_t": ("1", "turbine flow capacity factor"),
    "mu": ("1", "shorted fraction of the turns of a phase (0: healthy)"),
    "k_rf": ("1", "fault resistance over that of the shorted turns (nan: healthy)"),
    "kappa": ("1", "leakage partition of the shorted turns (nan: healthy)"),
    "P_total": ("W", "mean mechanical power of both generators over one exchange (eq 8)"),
    "P_e": ("W", "mean electrical output of one generator over one exchange"),
    "P_loss_fault": ("W", "mean extra loss of the fault in one generator over one exchange"),
    **{f"V_{p}_rms": ("V", f"phase {p} voltage, settled rms over one exchange") for p in "abc"},
    **{f"I_{p}_rms": ("A", f"phase {p} current, settled rms over one exchange") for p in "abc"},
    **{f"v_{p}": ("V", f"phase {p} terminal voltage") for p in "abc"},
    **{f"i_{p}": ("A", f"phase {p} current") for p in "abc"},
    "i_fault": ("A", "current of the fault branch"),
    "V_fd": ("V", "field voltage"),
    "i_fd": ("A", "field current"),
    "T_e": ("N m", "electromagnetic torque of one generator"),
    "P_inst": ("W", "instantaneous power of eq 8, both generators"),
}
"""Unit and meaning of every variable that a joint run may hold, by name."""

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
    signals: Iterable[Signal] = (),
    attrs: Mapping[str, str | int | float] | None = None,
    generators: int = 0,
) -> xr.Dataset:
    """Build a labelled dataset from arrays.

    Args:
        times: time coordinates [s] by name, each strictly increasing, shape (n,).
        values: per time coordinate, arrays of shape (n,) or (generators, n), also lazy ones of
            :mod:`apu_casadi.core.filearrays`, or scalars by variable name.
        signals: units and meanings; they come before those of :data:`CHANNELS`.
        attrs: attributes of the dataset; text or numbers.
        generators: their number, for what each has of its own.

    Returns:
        xarray.Dataset with ``units`` and ``long_name`` on every variable and coordinate.

    Raises:
        SignalError: a name of unknown unit, a name on two time coordinates, a wrong shape, or a
            time coordinate that is not increasing.

    Examples:
        >>> ds = dataset({"time": [0.0, 0.02]}, {"time": {"T4": [1273.0, 1272.0]}})
        >>> ds["T4"].attrs["units"]
        'K'
    """
    import xarray as xr

    known = {**CHANNELS, **{s.name: (s.unit, s.doc) for s in signals}}
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
            raise DataError(f"{_source(ds)}generator {number}: {generators_of(ds)} are there")
        return ds.sel({GENERATOR: number}, drop=True)
    if not 1 <= number <= int(ds.attrs.get("generators", 2)):
        raise DataError(f"{_source(ds)}generator {number}: there are {ds.attrs['generators']}")
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


def _source(ds: xr.Dataset) -> str:
    """Return the file that a dataset was read from, as the beginning of a message."""
    source = ds.encoding.get("source")
    return f"{source}: " if source else ""


def phases(ds: xr.Dataset) -> list[dict[str, Any]]:
    """Return the phases of a run as dictionaries with name, start [s] and end [s].

    Without a ``phases`` attribute the whole run is one phase.

    Raises:
        DataError: no ``time`` coordinate, or an attribute that holds something else.
    """
    if "time" not in ds.coords or ds.sizes.get("time", 0) < 2:
        raise DataError(
            f"{_source(ds)}the dataset lacks a 'time' coordinate of at least two samples"
        )
    t = ds["time"].values
    if (
        t.ndim != 1
        or t.dtype.kind not in "fiu"
        or not (np.isfinite(t).all() and np.all(t[1:] > t[:-1]))
    ):
        raise DataError(f"{_source(ds)}'time' does not increase from sample to sample")
    text = ds.attrs.get("phases")
    if text is None:
        return [{"name": "run", "start": float(t[0]), "end": float(t[-1])}]
    try:
        rows = json.loads(text)
        rows = [
            {"name": str(r["name"]), "start": float(r["start"]), "end": float(r["end"])}
            for r in rows
        ]
    except (TypeError, ValueError, KeyError) as e:
        raise DataError(
            f"{_source(ds)}attribute 'phases' is not a list of name, start and end: {e!r}"
        ) from e
    if not rows:
        raise DataError(f"{_source(ds)}attribute 'phases' is an empty list")
    for r in rows:
        if not r["end"] > r["start"]:
            raise DataError(
                f"{_source(ds)}phase {r['name']!r} ends at {r['end']:g} s, before it starts"
            )
    return rows


def severity_h(mu: np.ndarray, k_rf: np.ndarray) -> np.ndarray:
    """Return h = mu/(k_rf + 1 - mu) of arrays; 0 without a fault, where k_rf is NaN."""
    return np.where(mu > 0, mu / (np.nan_to_num(k_rf) + 1.0 - mu), 0.0)


def severity(mu: float, k_rf: float, kappa: float) -> dict[str, float | None]:
    """Return mu, k_rf, kappa and h = mu/(k_rf + 1 - mu) together; None where there is no fault."""
    if not mu > 0:
        return {"mu": 0.0, "k_rf": None, "kappa": None, "h": 0.0}
    return {"mu": mu, "k_rf": k_rf, "kappa": kappa, "h": mu / (k_rf + 1.0 - mu)}


_MEANS = (
    ("N_rpm", "N", RPM),
    ("PW_kW", "PW", 1e-3),
    ("Wf", "Wf", 1.0),
    ("SFC", "SFC", 1.0),
    ("T3", "T3", 1.0),
    ("P3_kPa", "P3", 1e-3),
    ("T4", "T4", 1.0),
    ("T5", "T5", 1.0),
    ("SM_percent", "SM", 100.0),
)
_MEANS_OF_EACH = (*(f"{q}_{p}_rms" for q in "VI" for p in "abc"), "P_e", "P_loss_fault")
_HEALTH = ("f_eta_c", "f_W_c", "f_eta_t", "f_W_t")
_SEVERITY = ("mu", "k_rf", "kappa")
_HEALTHY_NAN = ("k_rf", "kappa")


class _Columns:
    """Values of a dataset by name; those in a file are read anew each time, not all are held."""

    def __init__(self, ds: xr.Dataset) -> None:
        self.ds = ds

    def __getitem__(self, name: str) -> np.ndarray:
        v = self.ds[name]
        if v.dims != ("time",) or v.dtype.kind not in "fiu":
            where = ", ".join(map(str, v.dims)) or "no dimension"
            raise DataError(
                f"{_source(self.ds)}{name}: numbers on time are expected, "
                f"{v.dtype} on {where} found"
            )
        values: np.ndarray = v.values
        if name not in _HEALTHY_NAN and not np.isfinite(values).all():
            k = int(np.flatnonzero(~np.isfinite(values))[0])
            raise DataError(
                f"{_source(self.ds)}{name} = {values[k]:g} at t = {self.ds['time'].values[k]:g} s "
                "is no finite number"
            )
        return values


def _holding(ds: xr.Dataset, attribute: str, key: str, end: float, number: int) -> str | None:
    """Return what the run's attribute says of a generator just before ``end`` [s]."""
    try:
        rows = [r for r in json.loads(ds.attrs[attribute]) if r.get(GENERATOR, number) == number]
        held = [r for r in rows if float(r["t"]) < end - 1e-9]
        return None if held[-1][key] is None else str(held[-1][key])
    except (KeyError, TypeError, ValueError, IndexError):
        return None


def phase_summary(ds: xr.Dataset) -> list[dict[str, Any]]:
    """Summarise a joint run phase by phase.

    Each row holds name, start, end [s] and window [s]; the means over the last 0.5 s of the phase
    (over all of a shorter one) of N_rpm, PW_kW, Wf [kg/s], SFC [kg/(W s)], T3, T4, T5 [K], P3_kPa,
    SM_percent, V_a_rms ... [V], I_a_rms ... [A], and P_e and P_loss_fault [W] of one generator,
    and V_2_over_V_1 and I_2_over_I_1 where the dataset has them; the
    extremes over the phase N_rpm_min, N_rpm_max, T4_max [K], SM_percent_min; the health factors at
    its end; and the severity of the stator fault at its end, always as mu, k_rf, kappa together
    (and h, which follows from them; k_rf and kappa are None when healthy), with ``fault_phase``;
    the same of the ``worst`` fault in it, None without one;
    and the ``load`` at its end in words.  The last two are None where the dataset does not tell.
    Where generators differ, all that is of a generator is in ``generators`` instead: a list with
    one table for each, which has its number as ``generator``.

    Raises:
        DataError: a variable is missing, is not finite or no number, or a phase holds no sample.
    """
    needed = [v for _, v, _ in _MEANS] + [*_MEANS_OF_EACH, *_SEVERITY, *_HEALTH]
    missing = [v for v in needed if v not in ds]
    if missing:
        raise DataError(f"{_source(ds)}the dataset lacks {', '.join(missing)}")
    spans = phases(ds)
    t = ds["time"].values
    tol = 1e-9
    col, numbers = _Columns(ds), generators_of(ds)
    each = {k: _Columns(of_generator(ds, k)) for k in numbers}
    rows = []
    for k, p in enumerate(spans):
        # a sample is the end of a step: the one at a boundary belongs to the earlier phase
        before_end = t <= p["end"] + tol
        whole = ((t > p["start"] + tol) | ((k == 0) & (t >= p["start"] - tol))) & before_end
        window = min(SUMMARY_WINDOW, p["end"] - p["start"])
        tail = (t > p["end"] - window + tol) & before_end
        if not tail.any():
            raise DataError(
                f"{_source(ds)}phase {p['name']!r} [{p['start']:g}, {p['end']:g}] s holds no "
                f"sample; time runs from {t[0]:g} to {t[-1]:g} s"
            )
        row: dict[str, Any] = {**p, "window": window}
        for key, v, scale in _MEANS:
            row[key] = float(np.mean(col[v][tail]) * scale)
        inside = {v: col[v][whole] for v in ("N", "T4", "SM")}
        row["N_rpm_min"] = float(inside["N"].min() * RPM)
        row["N_rpm_max"] = float(inside["N"].max() * RPM)
        row["T4_max"] = float(inside["T4"].max())
        row["SM_percent_min"] = float(inside["SM"].min() * 100.0)
        end = int(np.flatnonzero(tail)[-1])
        row.update({v: float(col[v][end]) for v in _HEALTH})
        of_each = [
            _of_one(each[k], tail, end)
            | _held(ds, each[k], end, p["end"], k)
            | _worst(ds, each[k], whole, p["end"], k)
            for k in numbers
        ]
        if GENERATOR in ds.coords:
            row["generators"] = [
                {GENERATOR: k, **own} for k, own in zip(numbers, of_each, strict=True)
            ]
        else:
            row |= of_each[0]
        rows.append(row)
    return rows


_UNBALANCE = ("V_2_over_V_1", "I_2_over_I_1")


def _of_one(col: _Columns, tail: np.ndarray, end: int) -> dict[str, Any]:
    """Return means over the end of a phase of one generator, and the severity of its fault."""
    more = [v for v in _UNBALANCE if v in col.ds]  # files of before lack them
    means = {v: float(np.mean(col[v][tail])) for v in (*_MEANS_OF_EACH, *more)}
    return means | severity(*(float(col[v][end]) for v in _SEVERITY))


def _worst(
    ds: xr.Dataset, col: _Columns, whole: np.ndarray, t: float, number: int
) -> dict[str, Any]:
    """Return the severity of a generator's worst fault in a phase, which may be over at its end."""
    rows = np.flatnonzero(whole & (col["mu"] > 0))
    if not rows.size:
        return {"worst": None}
    h = severity_h(*(np.asarray(col[v])[rows] for v in ("mu", "k_rf")))
    k = int(rows[int(np.argmax(h))])
    phase = _holding(ds, "faults", "phase", t, number)
    return {"worst": severity(*(float(col[v][k]) for v in _SEVERITY)) | {"fault_phase": phase}}


def _held(ds: xr.Dataset, col: _Columns, end: int, t: float, number: int) -> dict[str, Any]:
    """Return phase of the fault and load of a generator at the end of a phase."""
    faulty = col["mu"][end]
    return {
        "fault_phase": _holding(ds, "faults", "phase", t, number) if faulty else None,
        "load": _holding(ds, "loads", "load", t, number),
    }
