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
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from apu_casadi.core.errors import DataError
from estimators.apu.electrical.terminalsignals import VOLTAGES
from estimators.apu.recordings.measured import Channel, Measurements
from estimators.apu.recordings.plausible import WAVES, clipped, plain
from estimators.apu.sensorchain import interpolated, slopes
from estimators.apu.sensorfile import SensorFile, read_sensors
from estimators.apu.sensors import Sensor, SensorSet, gas_path_table
from estimators.apu.trust import Doubt, part_of

__all__ = ["Declared", "as_declared", "tables"]

FILLED = 0.01  # share of a voltage, an input of the electrical filter, that may be filled
BESIDE = {True: 1, False: 5}  # samples beside one at the end of the range, of waveforms or not


@dataclass(frozen=True, eq=False)
class Declared:
    """What filters take.

    Args:
        m: the readings to be used.
        gas_path, electrical: the sensors, with what jitter and undoing a lag add to their noise.
        notes: what was done, one sentence each.
        doubts: what looks wrong.
        late: s, after which what is said of an instant is known.
        coarse: channels of which the digits are wider than the noise.
    """

    m: Measurements
    gas_path: SensorSet
    electrical: SensorSet
    notes: tuple[str, ...]
    doubts: tuple[Doubt, ...]
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
    notes, doubts = list[str](), list[Doubt]()
    channels: dict[str, Channel] = dict(m.channels)
    waves = {n: s for n in m.electrical if (s := electrical.of_channel(n)) is not None}
    slow = {n: gas_path[n] for n in m.gaspath if n in gas_path}
    every = slow | waves
    for n, s in every.items():
        part = part_of(n, m.electrical)
        if plain(n) in WAVES and (c := channels[n]).t.size > 1 and _constant(c.values):
            text = f"{c.source}: {n} shows {np.nanmin(c.values):g} {c.unit} all the time"
            doubts.append(Doubt("sensor", f"{text}, and is not used", part))
            del channels[n]
            continue
        channels[n] = _kept(channels[n], s, notes, doubts, part, wave=plain(n) in WAVES)
        lost = 1 - np.isfinite(channels[n].values).sum() / max(np.isfinite(m[n].values).sum(), 1)
        if plain(n) in VOLTAGES and lost > FILLED:
            notes.append(f"{n}: {100 * lost:.0f} % are too many to be filled, none is used")
            del channels[n]
    waves = {n: s for n, s in waves.items() if n in channels}
    every = slow | waves
    for n, s in slow.items():
        if s.delay:
            c = channels[n]
            channels[n] = dataclasses.replace(c, t=c.t - s.delay)
            notes.append(f"{n} is {s.delay:g} s late: its readings count for that earlier instant")
    grown = _undone(channels, waves, notes)
    changed = [_noisier(s, channels, waves, grown) for s in electrical.sensors]
    gas_path = SensorSet(tuple(_clocked(s, slow) for s in gas_path.sensors))
    late = max((s.delay for s in every.values()), default=0.0)
    if late:
        notes.append(f"what is said of an instant is known {late:g} s later, by the sensors' delay")
    ready = dataclasses.replace(m, channels=channels)
    wide = {n: np.nanmedian(s.white(m[n].values)) for n, s in every.items() if s.quantum}
    coarse = tuple(n for n, v in wide.items() if every[n].quantum > v)
    return Declared(
        ready, gas_path, SensorSet(tuple(changed)), tuple(notes), tuple(doubts), late, coarse
    )


def _constant(v: np.ndarray) -> bool:
    """Whether a channel has readings, and all are the same."""
    return bool(np.isfinite(v).any() and np.nanmin(v) == np.nanmax(v))


def _end(name: str) -> str:
    return name.removeprefix(plain(name))


def _clocked(s: Sensor, beside: Mapping[str, Sensor]) -> Sensor:
    """Return a sensor whose jitter stands for that of a clock which samples others beside it.

    The clock's error acts on n channels by their slopes a, and n diag(a^2) >= a a': as independent
    errors of n times the variance they are never taken for smaller than they are, in any
    combination of the channels.
    """
    n = sum(of.clock == s.clock and of.jitter > 0 for of in beside.values()) if s.clock else 1
    return dataclasses.replace(s, jitter=math.sqrt(n) * s.jitter) if n > 1 else s


def _kept(
    c: Channel, s: Sensor, notes: list[str], doubts: list[Doubt], part: str, *, wave: bool
) -> Channel:
    """Return the channel without what is at the end of the range, and without expected errors."""
    limits = s.limits
    if limits is None and wave and np.isfinite(c.values).any() and (count := clipped(c.values)):
        limits = float(np.nanmin(c.values)), float(np.nanmax(c.values))
        text = f"{c.source}: {count} samples of {c.name} are clipped"
        how = "declare its range in a file of sensors if that is what it can show"
        doubts.append(Doubt("sensor", f"{text}; {how}", part))
    v = c.values if limits is None else _inside(c, limits, notes, BESIDE[wave])
    if s.bias_mean or s.gain_mean:
        v = (v - s.bias_mean) / (1.0 + s.gain_mean)
    return c if v is c.values else dataclasses.replace(c, values=v)


def _inside(c: Channel, limits: tuple[float, float], notes: list[str], beside: int) -> np.ndarray:
    """Return the readings that are not at the end of the range, nor beside one that is."""
    v = c.values
    tiny = 1e-9 * (limits[1] - limits[0])
    ends = v <= limits[0] + tiny, v >= limits[1] - tiny
    at = np.flatnonzero(ends[0] | ends[1])
    if not at.size:
        return v
    near = np.convolve(ends[0] | ends[1], np.ones(2 * beside + 1), mode="full") > 0.5
    left = np.where(near[beside : beside + v.size], np.nan, v)
    where = " and ".join(f"{x:g}" for x, e in zip(limits, ends, strict=True) if e.any())
    if np.isfinite(left).sum() < 2:
        raise DataError(f"{c.source}: {c.name} is at the end of its range, {where} {c.unit}")
    notes.append(
        f"{c.name} is at the end of its range, {where} {c.unit}, in {at.size} samples from "
        f"{c.t[at[0]]:g} to {c.t[at[-1]]:g} s: they and those beside them are not used"
    )
    return left


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
            # between samples it is less, but no longer white: at the signal's frequency the same
            grown[s.name] = max(1.0, float(np.median(more)))
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
    if not s.jitter:
        return s
    mine = [n for n, of in waves.items() if of.name == s.name]
    if mine:
        beside = {
            k: of for k, of in waves.items() if plain(k) in WAVES and _end(k) == _end(mine[0])
        }
        s = _clocked(s, beside)
    each = [channels[n] for n in mine]
    fastest = max((float(slopes(c.t, c.values, wave=True).max()) for c in each), default=0.0)
    # two digits: the model of the filter is made for the number
    return dataclasses.replace(s, extra=float(f"{s.jitter * fastest:.2g}"))
