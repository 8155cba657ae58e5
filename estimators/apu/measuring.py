"""Recordings made from runs: what the sensors of a table read, with noise and gain errors.

The gas path is sampled every 20 ms, the generators at the instants of the run's waveforms.  A file
of sensors changes single numbers, or adds a sensor that is known:

    [T5]
    noise = 0.004          # of the reading, where the table's is
    gain = 0.0
    rate = 10              # Hz
    [T41]                  # another sensor
    [i_a]
    noise = 2.0            # A

The draws are those of the joint estimation: gain errors of ``(seed, 0)``, noise of the generators'
sensors of ``(seed, 1)``, of the gas path's of ``(seed, 2)``.
"""

from __future__ import annotations

import dataclasses
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import DataError, ParameterError, nearest
from apu_casadi.core.results import GENERATOR, generators_of, of_generator, save
from apu_casadi.gaspath.conditions import CONDITIONS
from apu_casadi.unit.apu import Apu
from estimators.apu.electrical.terminalsignals import GAIN_SENSORS
from estimators.apu.gaspath import true_readings
from estimators.apu.joint import electrical_samples, unit_of
from estimators.apu.sensors import ELECTRICAL, KNOWN, SensorSet, gas_path_table

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["SensorFile", "measure_run", "read_sensors", "write_recording"]

KEYS = ("noise", "gain", "rate")
FORMATS = (".csv", ".parquet", ".nc")


@dataclass(frozen=True)
class SensorFile:
    """What is measured how well, and how often.

    Args:
        gas_path, electrical: 1-sigma tables.
        rates: of sensors that are read less often than the others, Hz.
    """

    gas_path: SensorSet = field(default_factory=gas_path_table)
    electrical: SensorSet = ELECTRICAL
    rates: Mapping[str, float] = field(default_factory=dict)


def read_sensors(path: str | Path | None) -> SensorFile:
    """Read a file of sensors; None gives the tables as they are.

    Raises:
        DataError: no such file, no TOML, an unknown sensor or key, no number.
    """
    sets, rates = [gas_path_table(), ELECTRICAL], dict[str, float]()
    if path is None:
        return SensorFile(sets[0], sets[1])
    try:
        data = tomllib.loads(files.read_text(path))
    except tomllib.TOMLDecodeError as e:
        raise DataError(f"{path}: no TOML: {e}") from None
    valid = (*KNOWN, *ELECTRICAL.names)
    for name, row in data.items():
        if name not in valid:
            raise DataError(f"{path}: unknown sensor {name!r} {nearest(name, valid)}")
        if not isinstance(row, dict):
            raise DataError(f"{path}: a table [{name}] is expected, got {row!r:.40}")
        for key, v in row.items():
            if key not in KEYS:
                raise DataError(f"{path}, {name}: unknown key {key!r} {nearest(key, KEYS)}")
            least = "> 0" if key == "rate" else ">= 0"
            if isinstance(v, bool) or not isinstance(v, int | float) or not 0 <= v < 1e12:
                raise DataError(f"{path}, {name}: {key} must be a number {least}, got {v!r:.40}")
        k = int(name in ELECTRICAL)
        sets[k] = sets[k] if k else sets[k].including(name)
        numbers: dict[str, Any] = {n: float(v) for n, v in row.items() if n != "rate"}
        new = dataclasses.replace(sets[k][name], **numbers, source=str(path))
        sets[k] = SensorSet(tuple(new if s.name == name else s for s in sets[k].sensors))
        if "rate" in row:
            if not row["rate"] > 0:
                raise DataError(f"{path}, {name}: rate must be a number > 0, got {row['rate']}")
            rates[name] = float(row["rate"])
    return SensorFile(sets[0], sets[1], rates)


def measure_run(
    ds: xr.Dataset,
    apu: Apu,
    seed: int | None,
    sensors: SensorFile | None = None,
    *,
    gains: bool = True,
) -> dict[str, xr.Dataset]:
    """Measure a joint run.

    Args:
        ds: the run.
        apu: the unit, for the gears.
        seed: of gain errors and noise; None: neither.
        sensors: what is measured; the tables by default.
        gains: whether there are gain errors.

    Returns:
        ``gaspath`` and, where the run has waveforms, ``electrical``: readings on ``time``, gaps
        NaN, and the ambient conditions that the run says.  Shaft power is the mean until the next
        instant.

    Raises:
        DataError: a signal or an instant is not in the run, or a rate that does not divide its own.
    """
    s = SensorFile() if sensors is None else sensors
    draws = [None if seed is None else np.random.default_rng([seed, k]) for k in range(3)]
    missing = [n for x in s.gas_path.sensors for n in x.reads if n not in ds]
    if missing:
        raise DataError(f"the run has no {', '.join(missing)} to be measured")
    with_gains = draws[0] if gains else None
    gas_gains = _drawn(s.gas_path, (*s.gas_path.uncertain, "PW"), with_gains)
    t, truth = true_readings(s.gas_path, ds)
    made = {"gaspath": s.gas_path.measure(truth, draws[2], gains=gas_gains)}
    times = {"gaspath": t}
    if "time_w" in ds:
        made["electrical"] = {}
        for ending, one, view in _machines(ds, apu):
            own = _drawn(s.electrical, GAIN_SENSORS, with_gains)
            read = electrical_samples(view, one, draws[1], sensors=s.electrical, gains=own)
            times["electrical"] = read.pop("t")
            made["electrical"] |= {f"{n}{ending}": v for n, v in read.items()}
    for n in s.rates:
        if not any(n in read for read in made.values()):
            raise DataError(f"rate of {n}: it is not measured in this run")
    units = {x.name: x.unit for x in (*s.gas_path.sensors, *s.electrical.sensors)}
    return {
        kind: _dataset(ds, kind, times[kind], read, units, s.rates) for kind, read in made.items()
    }


def _drawn(
    table: SensorSet, names: tuple[str, ...], rng: np.random.Generator | None
) -> dict[str, float]:
    return {} if rng is None else table.draw_gains(rng, names)


def _machines(ds: xr.Dataset, apu: Apu) -> list[tuple[str, Apu, xr.Dataset]]:
    """Ending of the names, unit with that machine as the first, and the run as it sees it."""
    numbers = generators_of(ds)
    if GENERATOR not in ds.dims:
        return [("", apu, ds)]
    if len(numbers) != len(apu.machines):
        raise DataError(f"the run has {len(numbers)} generators, the unit {len(apu.machines)}")
    return [(f"_{k}", unit_of(apu, k), of_generator(ds, k)) for k in numbers]


def _dataset(
    ds: xr.Dataset,
    kind: str,
    t: np.ndarray,
    read: Mapping[str, np.ndarray],
    units: Mapping[str, str],
    rates: Mapping[str, float],
) -> xr.Dataset:
    import xarray as xr

    out = xr.Dataset(coords={"time": ("time", t, {"units": "s"})})
    for n, v in read.items():
        plain = n if n in units else n.rpartition("_")[0]
        out[n] = ("time", _thinned(plain, t, v, rates), {"units": units[plain]})
    if kind == "gaspath" and "ambient" in ds.attrs:
        for n, v in json.loads(ds.attrs["ambient"]).items():
            if n in CONDITIONS:
                out[n] = ("time", np.full(t.size, float(v)), {"units": CONDITIONS[n].unit})
    return out


def _thinned(name: str, t: np.ndarray, v: np.ndarray, rates: Mapping[str, float]) -> np.ndarray:
    """Readings at the sensor's own rate, NaN between."""
    if name not in rates:
        return v
    step = float(np.median(np.diff(t)))
    every = round(1 / (rates[name] * step))
    if every < 1 or abs(every * step * rates[name] - 1) > 1e-6:
        raise DataError(f"rate of {name}: {rates[name]:g} Hz is no part of {1 / step:g} Hz")
    return np.where(np.arange(t.size) % every == 0, v, np.nan)


def write_recording(readings: Mapping[str, xr.Dataset], path: str | Path) -> list[Path]:
    """Write measured data, CSV, Parquet or netCDF by the ending; one file for each kind.

    Args:
        readings: of :func:`measure_run`.
        path: of the file; with several kinds, ``_gaspath`` and ``_electrical`` stand before the
            ending.

    Raises:
        ParameterError: another ending.
        DataError: a file cannot be written.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in FORMATS:
        raise ParameterError(f"{path}: {', '.join(FORMATS)} is expected {nearest(ending, FORMATS)}")
    made = []
    for kind, ds in readings.items():
        target = path if len(readings) == 1 else path.with_stem(f"{path.stem}_{kind}")
        if ending == ".nc":
            made.append(save(ds, target))
            continue
        named: dict[Any, str] = {n: f"{n} [{ds[n].attrs['units']}]" for n in ("time", *ds)}
        frame = ds.to_dataframe().reset_index().rename(columns=named)
        if ending == ".csv":
            made.append(files.write_text(target, frame.to_csv(index=False, float_format="%.12g")))
            continue
        with files.whole(target) as part:
            try:
                frame.to_parquet(part, index=False)
            except ImportError as e:
                raise DataError(f"{target}: Parquet needs pyarrow: {e}") from None
        made.append(target)
    return made
