"""Readings made ready for the filters by what their sensors declare.

Expected gain error and offset are taken out; readings at the end of a sensor's range are not used,
nor are those beside them, of which the error would be chosen by that.  A delayed reading is put at
the instant that it is of, so that the filters take all in the order in which it happened, as one
that goes back over its buffer does; what they say of an instant is known when the slowest sensor
has come.  Lag and delay of a waveform are undone by local polynomials: true(t) = r(t + delay) + tau
dr/dt.  Of the gas path a lag is a state of the filter, where noise would grow too much.  Jitter
becomes noise by the slope of the signal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from apu_casadi.core.errors import DataError
from estimators.apu.electrical.terminalsignals import PHASES_V
from estimators.apu.recordings.measured import Channel, Measurements
from estimators.apu.recordings.plausible import WAVES, plain
from estimators.apu.sensorchain import interpolated, slopes
from estimators.apu.sensorfile import SensorFile, read_sensors
from estimators.apu.sensors import Sensor, SensorSet, gas_path_table

__all__ = ["Declared", "as_declared", "tables"]

BESIDE = {True: 1, False: 5}  # samples beside one at the end of the range, of waveforms or not


@dataclass(frozen=True, eq=False)
class Declared:
    """What filters take.

    Args:
        m: the readings to be used.
        gas_path, electrical: the sensors, with what jitter and undoing a lag add to their noise.
        notes: what was done, one sentence each.
        late: s, after which what is said of an instant is known.
        coarse: channels of which the digits are wider than the noise.
    """

    m: Measurements
    gas_path: SensorSet
    electrical: SensorSet
    notes: tuple[str, ...]
    late: float
    coarse: tuple[str, ...]


def tables(
    m: Measurements, sensors: SensorSet | SensorFile | str | Path | None, electrical: SensorSet
) -> tuple[SensorSet, SensorSet]:
    """Return the sensors of the gas path and of the generators.

    Args:
        m: readings; what was measured besides is known by its name, where a set may be added to.
        sensors: of the gas path, or of all, or their file; None: the tables.
        electrical: of the generators, where ``sensors`` are the gas path's alone.
    """
    sensors = read_sensors(sensors) if isinstance(sensors, str | Path) else sensors
    if isinstance(sensors, SensorSet):
        return sensors, electrical
    if sensors is not None:
        electrical = sensors.electrical
        if sensors.complete:  # speed is a state, measured or not
            return sensors.gas_path.including("N"), electrical
    table = gas_path_table() if sensors is None else sensors.gas_path
    return table.including(*m.gaspath), electrical


def as_declared(m: Measurements, gas_path: SensorSet, electrical: SensorSet) -> Declared:
    """Make readings ready for the filters.

    Args:
        m: as they were read.
        gas_path, electrical: the sensors; readings of others stay as they are.

    Raises:
        DataError: nothing is left of a channel.
    """
    notes: list[str] = []
    channels: dict[str, Channel] = dict(m.channels)
    waves = {n: electrical[plain(n)] for n in m.electrical if plain(n) in electrical}
    slow = {n: gas_path[n] for n in m.gaspath if n in gas_path}
    every = slow | waves
    for n, s in every.items():
        channels[n] = _kept(channels[n], s, notes, wave=plain(n) in WAVES)
    for n, s in slow.items():
        if s.delay:
            c = channels[n]
            channels[n] = dataclasses.replace(c, t=c.t - s.delay)
            notes.append(f"{n} is {s.delay:g} s late: its readings count for that earlier instant")
    grown = _undone(channels, waves, notes)
    changed = [_noisier(s, channels, waves, grown) for s in electrical.sensors]
    late = max((s.delay for s in every.values()), default=0.0)
    if late:
        notes.append(f"what is said of an instant is known {late:g} s later, by the sensors' delay")
    ready = dataclasses.replace(m, channels=channels)
    wide = {n: np.nanmedian(s.white(m[n].values)) for n, s in every.items() if s.quantum}
    coarse = tuple(n for n, v in wide.items() if every[n].quantum > v)
    return Declared(ready, gas_path, SensorSet(tuple(changed)), tuple(notes), late, coarse)


def _kept(c: Channel, s: Sensor, notes: list[str], *, wave: bool) -> Channel:
    """Return the channel without what is at the end of the range, and without expected errors."""
    v = c.values
    if s.limits is not None and np.isfinite(v).any():
        tiny = 1e-9 * (s.limits[1] - s.limits[0])
        low, high = v <= s.limits[0] + tiny, v >= s.limits[1] - tiny
        at = np.flatnonzero(low | high)
        if at.size:
            n = BESIDE[wave]
            near = np.convolve(low | high, np.ones(2 * n + 1), mode="same")[: v.size] > 0.5
            ends = " and ".join(
                f"{x:g}" for x, there in zip(s.limits, (low, high), strict=True) if there.any()
            )
            if np.isfinite(v[~near]).sum() < 2:
                raise DataError(f"{c.source}: {c.name} is at the end of its range, {ends} {c.unit}")
            notes.append(
                f"{c.name} is at the end of its range, {ends} {c.unit}, in {at.size} samples from "
                f"{c.t[at[0]]:g} to {c.t[at[-1]]:g} s: they and those beside them are not used"
            )
            v = np.where(near, np.nan, v)
    if s.bias_mean or s.gain_mean:
        v = (v - s.bias_mean) / (1.0 + s.gain_mean)
    return c if v is c.values else dataclasses.replace(c, values=v)


def _undone(
    channels: dict[str, Channel], waves: Mapping[str, Sensor], notes: list[str]
) -> dict[str, float]:
    """Undo delays and lags of waveforms in place; return by how much their noise grows."""
    grown: dict[str, float] = {}
    common = min((s.delay for s in waves.values()), default=0.0)
    moved: dict[int, np.ndarray] = {}
    for n, s in waves.items():
        c = channels[n]
        values, rest = c.values, s.delay - common
        if rest or s.tau:
            values, more = interpolated(c.t, c.values, c.t + rest, more=s.tau)
            values[c.t + rest > c.t[-1]] = np.nan
            grown[plain(n)] = float(np.median(more))
        if common:
            moved.setdefault(id(c.t), c.t - common)
        t = moved.get(id(c.t), c.t)
        if t is not c.t or values is not c.values:
            channels[n] = dataclasses.replace(c, t=t, values=values)
    late = sorted({plain(n) for n, s in waves.items() if s.delay or s.tau})
    if late:
        notes.append(f"{', '.join(late)}: delay and lag are undone as declared")
    return grown


def _noisier(
    s: Sensor, channels: Mapping[str, Channel], waves: Mapping[str, Sensor], grown: dict[str, float]
) -> Sensor:
    """Return a sensor of the generators with what is done to its readings as noise."""
    by = grown.get(s.name, 1.0)
    s = dataclasses.replace(s, noise=by * s.noise, quantum=by * s.quantum) if by != 1.0 else s
    if not s.jitter or s.name not in (*PHASES_V, "V_fd", "w_r"):
        return s  # of outputs each sample has its own noise
    each = [channels[n] for n in waves if plain(n) == s.name]
    fastest = max((float(slopes(c.t, c.values, wave=True).max()) for c in each), default=0.0)
    # two digits: the model of the filter is made for the number
    return dataclasses.replace(s, extra=float(f"{s.jitter * fastest:.2g}"))
