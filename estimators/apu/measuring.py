"""Recordings made from runs: what the sensors of a set read, with all that they declare.

The gas path is sampled every 20 ms, the generators at the instants of the run's waveforms.  A file
of sensors changes the set (:mod:`estimators.apu.sensorfile`).

The draws are those of the joint estimation: gain errors of ``(seed, 0)``, noise of the generators'
sensors of ``(seed, 1)``, of the gas path's of ``(seed, 2)``; offsets, drifts and jitter of
``(seed, 3)`` and the sensor's name.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from apu_casadi.core.cf import described
from apu_casadi.core.errors import DataError, ParameterError, nearest
from apu_casadi.core.resultformats import frames, save_frame
from apu_casadi.core.results import save
from apu_casadi.gaspath.conditions import CONDITIONS
from apu_casadi.unit.apu import Apu
from estimators.apu.electrical.terminalsignals import GAIN_SENSORS
from estimators.apu.gaspath import true_readings
from estimators.apu.joint import electrical_samples, machines_of
from estimators.apu.sensorchain import Draws, disturbed, sampled_wave
from estimators.apu.sensorfile import SensorFile, read_sensors
from estimators.apu.sensors import SensorSet, plain

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["SensorFile", "drawn_gains", "measure_run", "read_sensors", "write_recording"]

FORMATS = (".csv", ".parquet", ".nc")


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
        seed: of all that is drawn; None: nothing.
        sensors: what is measured; the tables by default.
        gains: whether constant errors, gains and offsets, are drawn.

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
    t, truth = true_readings(s.gas_path, ds, seed)
    truth = {n: v for n, v in truth.items() if n in s.gas_path}
    read = s.gas_path.measure(truth, draws[2], gains=_drawn(s.gas_path, _gained(s), with_gains))
    made = {"gaspath": disturbed(s.gas_path, t, read, Draws(seed), errors=gains)}
    times = {"gaspath": t}
    if "time_w" in ds and s.electrical.sensors:
        made["electrical"] = {}
        for number, (ending, one, view) in enumerate(_machines(ds, apu, s.electrical), 1):
            table = s.electrical.machine(number)
            own, of = _drawn(table, GAIN_SENSORS, with_gains), Draws(seed, number)
            true = electrical_samples(view, one, None)
            times["electrical"] = t_w = true.pop("t")
            here = {n: sampled_wave(table[n], t_w, true[n], of) for n in true if n in table}
            read = table.measure(here, draws[1], gains=own)
            read = disturbed(table, t_w, read, of, errors=gains)
            made["electrical"] |= {f"{n}{ending}": v for n, v in read.items()}
    for n in s.rates:
        if not any(n in map(plain, read) or n in read for read in made.values()):
            raise DataError(f"rate of {n}: it is not measured in this run")
    units = {x.name: x.unit for x in (*s.gas_path.sensors, *s.electrical.sensors)}
    return {
        kind: _dataset(ds, kind, times[kind], read, units, s.rates) for kind, read in made.items()
    }


def _machines(ds: xr.Dataset, apu: Apu, sensors: SensorSet) -> list[tuple[str, Apu, xr.Dataset]]:
    """Generators as :func:`machines_of`; alike ones with sensors of their own one by one."""
    found, own = machines_of(ds, apu), sensors.numbered
    if own and own[-1] > len(apu.machines):
        raise DataError(f"sensors of generator {own[-1]}: the unit has {len(apu.machines)}")
    if own and len(found) < len(apu.machines):
        return [(f"_{k}", *found[0][1:]) for k in range(1, len(apu.machines) + 1)]
    return found


def drawn_gains(sensors: SensorFile, seed: int) -> dict[str, float]:
    """Return the gain errors of the gas path that :func:`measure_run` draws for a seed.

    That of ``PW`` is the error of the generators' efficiency.
    """
    return _drawn(sensors.gas_path, _gained(sensors), np.random.default_rng([seed, 0]))


def _gained(sensors: SensorFile) -> tuple[str, ...]:
    return (*sensors.gas_path.uncertain, "PW")


def _drawn(
    table: SensorSet, names: Sequence[str], rng: np.random.Generator | None
) -> dict[str, float]:
    """Return gain errors: the expected ones, and what is drawn of those named."""
    drawn = {} if rng is None else table.draw_gains(rng, [n for n in names if n in table])
    means = {s.name: s.gain_mean for s in table.sensors if s.gain_mean}
    return drawn | {n: m + drawn.get(n, 0.0) for n, m in means.items()}


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
        own = n if n in units else plain(n)
        out[n] = ("time", _thinned(own, t, v, rates), {"units": units[own]})
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
            made.append(save(described(ds, "readings of sensors"), target))
            continue
        made.append(save_frame(frames(ds)["time"], target))
    return made
