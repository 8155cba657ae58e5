"""Recordings as estimators take them: measured quantities by name, in SI, each with its instants.

>>> import numpy as np
>>> t = np.arange(4) * 1e-3
>>> data = read_recording({"t [s]": t, "i_a [A]": np.sin(t), "T5 [degC]": 500 + t})
>>> data.electrical, data.gaspath
(('i_a',), ('T5',))
>>> float(data["T5"].values[0])
773.15

Files and data of several kinds may be mixed, gas path at 50 Hz and waveforms at 10 kHz, with gaps.
What was understood is in ``notes``; what is open is refused with what decides it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import DataError, nearest
from apu_casadi.core.results import load
from apu_casadi.core.tables.binaryfiles import time_dims
from apu_casadi.core.tables.timestamps import Start, is_time_name
from estimators.apu.recordings.layout import Reading, merged, parse_mapping, read_layout
from estimators.apu.recordings.plausible import PLAUSIBLE, WAVES, plain, si_of
from estimators.apu.recordings.recorded import Table, read_data, read_table
from estimators.apu.sensors import ELECTRICAL

if TYPE_CHECKING:
    import xarray as xr

SLOW = 0.01  # s, a step with which no waveform is sampled
EPOCH = 1e9  # s, from which numbers count from 1970, not from the beginning of a recording
__all__ = ["Channel", "Measurements", "read_recording"]


@dataclass(frozen=True, eq=False)
class Channel:
    """One measured quantity.

    Args:
        name, unit: of the model, SI.
        t, values: instants, s, and readings, NaN where there is a gap, shape (K,).
        source: file or data, and column.
    """

    name: str
    unit: str
    t: np.ndarray
    values: np.ndarray
    source: str

    @property
    def rate(self) -> float:
        """Samples in a second, by the median step."""
        return float(1.0 / np.median(np.diff(self.t))) if self.t.size > 1 else float("nan")


@dataclass(frozen=True, eq=False)
class Measurements(Mapping[str, Channel]):
    """What was measured, by name.

    Args:
        channels: by name.
        notes: what was understood, one sentence each.
        unused: columns that no quantity of the model is.
        start: date of t = 0 where the files have dates, else None.
    """

    channels: Mapping[str, Channel]
    notes: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    start: np.datetime64 | None = None

    def __getitem__(self, name: str) -> Channel:
        if name not in self.channels:
            raise DataError(f"{name} was not measured {nearest(name, self.channels)}")
        return self.channels[name]

    def __contains__(self, name: object) -> bool:
        return name in self.channels

    def __iter__(self) -> Iterator[str]:
        return iter(self.channels)

    def __len__(self) -> int:
        return len(self.channels)

    @property
    def electrical(self) -> tuple[str, ...]:
        """Names of what was measured at the generators."""
        return tuple(n for n in self.channels if plain(n) in ELECTRICAL)

    @property
    def gaspath(self) -> tuple[str, ...]:
        """Names of all else: of the gas path, and the ambient conditions."""
        return tuple(n for n in self.channels if plain(n) not in ELECTRICAL)

    def machine(self, number: int) -> Measurements:
        """Return one generator's quantities by their plain names: ``v_a`` for ``v_a_2``."""
        ending = f"_{number}"
        mine = {n: n.removesuffix(ending) for n in self.electrical if n.endswith(ending)}
        mine = mine or {n: n for n in self.electrical if n == plain(n)}
        channels = {p: dataclasses.replace(self[n], name=p) for n, p in mine.items()}
        return dataclasses.replace(self, channels=channels)

    def lacking(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return those of the names that were not measured."""
        return tuple(n for n in names if n not in self.channels)

    def streams(self, *names: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return ``{name: (t, values)}`` without gaps, for estimators.models.recording.record."""
        out = {}
        for n in names or tuple(self.channels):
            c = self[n]
            there = np.isfinite(c.values)
            out[n] = c.t[there], c.values[there]
        return out

    def samples(self, *names: str) -> dict[str, np.ndarray]:
        """Return arrays on all their instants, ``t`` among them, NaN where there is no sample."""
        picked = [self[n] for n in names or tuple(self.channels)]
        if not picked:
            raise DataError("no quantity was measured")
        first = picked[0].t
        t = (
            first
            if all(c.t is first for c in picked)
            else np.unique(np.concatenate([c.t for c in picked]))
        )
        out = {"t": t}
        for c in picked:
            out[c.name] = np.full(t.size, np.nan)
            out[c.name][np.searchsorted(t, c.t)] = c.values
        return out

    def dataset(self) -> xr.Dataset:
        """Return an xarray.Dataset, a time coordinate for each set of instants."""
        import xarray as xr

        grids: list[np.ndarray] = []
        for c in self.channels.values():
            if not any(g is c.t for g in grids):
                grids.append(c.t)
        grids.sort(key=len)
        dims = ["time", "time_w", *(f"time_{k}" for k in range(2, len(grids)))]
        made = xr.Dataset(attrs={} if self.start is None else {"start": str(self.start)})
        for c in self.channels.values():
            dim = dims[next(k for k, g in enumerate(grids) if g is c.t)]
            made = made.assign_coords({dim: (dim, c.t, {"units": "s"})})
            made[c.name] = (dim, c.values, {"units": c.unit, "source": c.source})
        return made


def read_recording(
    *sources: Any,
    columns: str | Path | Mapping[str, str] | None = None,
    reading: Reading | None = None,
    **how: Any,
) -> Measurements:
    """Read what was measured, from files and from memory.

    Args:
        sources: CSV, Parquet and netCDF files by name; arrays by name, DataFrames, Datasets.
        columns: a TOML file (:func:`~estimators.apu.recordings.layout.read_layout`), or names of
            the model with the columns they have here, ``{"T5": "EGT_in:degC"}``.
        reading: how questions are decided, or single fields of it by name: ``rate=1000``,
            ``names=("i_a", "i_b", "i_c")``, ``units=("A", "A", "A")``, ``time_zone="UTC"``.

    Raises:
        DataError: as :func:`~estimators.apu.recordings.recorded.read_table`; no time; a quantity
            that is in two of the sources; times of which some are dates and some not.
    """
    base = Reading()
    mapping: dict[str, tuple[str, str | None]] = {}
    if isinstance(columns, str | Path):
        base, mapping = read_layout(columns)
    elif columns is not None:
        mapping = parse_mapping([f"{n}={c}" for n, c in columns.items()])
    given: dict[str, Any] = dict(how)
    given |= {k: tuple(v) for k, v in how.items() if k in ("names", "units", "missing")}
    unknown = next((k for k in given if k not in Reading.__dataclass_fields__), None)
    if unknown is not None:
        raise DataError(
            f"unknown option {unknown!r} {nearest(unknown, Reading.__dataclass_fields__)}"
        )
    base = merged(base, Reading() if reading is None else reading)
    base = dataclasses.replace(base, **given)
    for name in mapping:
        if si_of(name) is None and name != "time":
            raise DataError(f"columns: unknown quantity {nearest(name, PLAUSIBLE)}")
    notes: list[str] = []
    tables = [t for s in sources for t in _tables(s, mapping, base, notes)]
    if not tables:
        raise DataError("no recording is given")
    return _joined(tables, notes, len(sources) > 1)


def _tables(
    source: Any, mapping: Mapping[str, Any], reading: Reading, notes: list[str]
) -> list[Table]:
    """Tables of a source: one, or one for each dimension of a dataset."""
    how: dict[str, Any] = {"reading": reading, "notes": notes}
    if isinstance(source, str | Path):
        path = Path(source)
        if path.suffix.lower() not in (".nc", ".nc4", ".cdf", ".mat") or not path.is_file():
            return [read_table(path, mapping, **how)]
        data, name = load(path), path.name
    elif hasattr(source, "data_vars"):
        data, name = source, "Dataset"
    else:
        kind = "arrays" if isinstance(source, Mapping) else type(source).__name__
        return [read_data(source, mapping, source=kind, **how)]
    dims = time_dims(data)
    if len(dims) < 2:
        return [read_data(data, mapping, source=name, **how)]
    made = [read_data(data, source=name, dim=d, **how) for d in dims]
    return [
        dataclasses.replace(t, mapping={n: c for n, c in mapping.items() if c[0] in t.columns})
        for t in made
    ]


def _joined(tables: list[Table], notes: list[str], several: bool) -> Measurements:
    """Take the quantities of all tables, on a common time."""
    starts: list[Start | None] = []
    times: list[np.ndarray] = []
    for table in tables:
        start: list[Start] = []
        t = table.time(start=start)
        if t is None:
            hint = table.steady_hint()
            guess = f"; {hint} rises like one" if hint else ""
            raise DataError(
                f"{table.source}: no column is the time{guess}: give --time COLUMN or --rate HZ; "
                "apu fit takes steady points"
            )
        if not start and t.size and t[0] > EPOCH:
            t, begin = _since_first(t)
            start.append(begin)
            notes.append(
                f"{table.source}: {begin[0].astype(float) / 1e9:.9g} s is taken as seconds since "
                f"1970: {begin[0].astype('datetime64[s]')} UTC"
            )
        times.append(t)
        starts.append(start[0] if start else None)
    dated = [s for s in starts if s is not None]
    if dated and len(dated) < len(tables):
        a, b = (tables[k].source for k in (_first(starts, True), _first(starts, False)))
        raise DataError(
            f"{a} has dates and {b} has none: they have no common time; give both dates, or the "
            "seconds of both from one instant"
        )
    if len({zoned for _, zoned in dated}) > 1:
        raise DataError("some files have dates with a zone and some without: give --time-zone ZONE")
    zero = min((d for d, _ in dated), default=None)
    if several and zero is None:
        notes.append("all files are taken to count their seconds from the same instant")
    channels: dict[str, Channel] = {}
    unused: list[str] = []
    for table, t, s in zip(tables, times, starts, strict=True):
        shift = 0.0 if s is None or zero is None else float((s[0] - zero) / np.timedelta64(1, "s"))
        for name, c in _channels(table, t + shift if shift else t).items():
            if name in channels:
                raise DataError(
                    f"{name} is in {channels[name].source} and in {c.source}: give one of them, or "
                    "another name to one"
                )
            _check_rate(c, table)
            channels[name] = c
        taken = {c.source.partition(", column ")[2] for c in channels.values()}
        unused += [n for n in table.columns if n not in taken and not is_time_name(n)]
    unused += [
        f"{n} ({why})"
        for n, why in {n: why for table in tables for n, why in table.others.items()}.items()
        if not any(n in table.columns for table in tables)
    ]
    if not channels:
        raise DataError(
            f"{tables[0].source}: none of the columns {', '.join(tables[0].columns)} is a quantity "
            "of the model: give --column NAME=COLUMN for each, or a file of them by --columns"
        )
    notes += [f for table in tables for f in table.flags()]
    return Measurements(channels, tuple(notes), tuple(unused), zero)


def _since_first(t: np.ndarray) -> tuple[np.ndarray, Start]:
    """Return seconds from the first instant on, and the date of that, in UTC."""
    return t - t[0], (np.datetime64(round(float(t[0]) * 1e9), "ns"), True)


def _check_rate(c: Channel, table: Table) -> None:
    """Refuse waveforms of a few samples a period, and tell of steps that may be in another unit."""
    step = 1.0 / c.rate
    if plain(c.name) in WAVES and step > SLOW:
        raise DataError(
            f"{c.source}: steps of {step:g} s are no sampling of a waveform: unit of the time "
            "missing? give --column time=COLUMN:ms, or --rate HZ"
        )
    if step >= 10 and table.notes is not None:
        note = f"{table.source}: steps of {step:g} s; if they are ms, give the time's unit"
        table.notes.extend([note] * (note not in table.notes))


def _first(starts: list[Start | None], dated: bool) -> int:
    return next(k for k, s in enumerate(starts) if (s is not None) == dated)


def _channels(table: Table, t: np.ndarray) -> dict[str, Channel]:
    out = {}
    for name in dict.fromkeys([*table.mapping, *table.columns]):
        si = si_of(name)
        if si is None or (name not in table.mapping and name in table.mapped):
            continue
        values = table.get(name, si, difference=name == "dT_isa")
        column = table.mapping[name][0] if name in table.mapping else name
        out[name] = Channel(name, si, t, values, f"{table.source}, column {column}")
    return out
