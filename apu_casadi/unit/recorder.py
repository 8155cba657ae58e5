"""What a joint run keeps, and the dataset that is made of it."""

from __future__ import annotations

import copy
import dataclasses
import json
import os
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from apu_casadi.core.filearrays import RowFile
from apu_casadi.core.measuring import measure
from apu_casadi.core.results import dataset
from apu_casadi.core.runstorage import PIECE, place, row_file
from apu_casadi.core.signals import Signals
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import Event, FaultChange
from apu_casadi.unit.integrators import WAVEFORMS
from apu_casadi.unit.stepmeans import RawMeans, StepMeans, phasor_signals

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.unit.noise import Noise

_TOGETHER = 512  # entries of means whose rms values are made at once
_STORED = Signals(Ttsc.severities)  # severities that every run stores
_WAVE_ROWS = ("time_w", *(f"{n} waveform" for n in WAVEFORMS))  # P_total is a mean as well


class Row(NamedTuple):
    """What one or more exchange steps gave.

    Args:
        y: outputs of the gas generator, shape (ny,) or (ny, steps).
        means: as they were averaged, or as they are kept.
        factors, fault: health by name, and stator fault.
        t, w: instants of the waveform samples, s, and waveforms.
    """

    y: np.ndarray
    means: RawMeans | np.ndarray
    factors: Mapping[str, float]
    fault: Fault | None
    t: np.ndarray
    w: np.ndarray


class Recorder:
    """What a run keeps: outputs per exchange, means, health, severity, waveforms.

    The arrays hold the whole run, or the piece of it that has not gone to ``file`` yet.

    Args:
        gg, grid: gas generator, and exchange instants, s.
        samples: waveform samples in all, the start included.
        means: makes what is kept of the means.
        storage: see :func:`apu_casadi.unit.multirate.simulate_joint`.
        severities: what is kept of the severity of faults.
    """

    gg: GasGenerator
    grid: np.ndarray
    means: np.ndarray
    held: np.ndarray
    t_w: np.ndarray
    waves: np.ndarray

    def __init__(
        self,
        gg: GasGenerator,
        grid: np.ndarray,
        samples: int,
        means: StepMeans,
        storage: str | os.PathLike[str] = "memory",
        severities: Signals = _STORED,
    ) -> None:
        self.severities = severities
        self._raw, self._raw_at = list[RawMeans](), 0
        self.gg, self.grid, self._means = gg, grid, means
        n_slow = len(gg.Y) + len(means.kept) + len(gg.THETA) + len(severities)
        size = 8 * (n_slow * grid.size + (1 + len(WAVEFORMS)) * samples)
        self._first = self._end = 0  # instants in the arrays
        self._first_w = self._n = 0  # samples before those in the arrays, and in them
        self._residual = 0.0
        self._factors: Mapping[str, float] | None = None
        self._fault: Fault | None = None
        self.file: RowFile | None = None
        where = place(size, storage)
        if where is None:
            self._allocate(grid.size, samples)
            return
        self._allocate(1, 1)
        self._names = [*gg.Y.names, *self._slow()]
        rows = dict.fromkeys(self._names, grid.size)
        waves = dict.fromkeys(_WAVE_ROWS if samples else (), samples)
        self.file = row_file({**rows, **waves}, where, needed=storage != "auto")
        piece = PIECE if self.file is not None else size
        self._allocate(min(grid.size, piece), min(samples, piece))

    def _allocate(self, steps: int, samples: int) -> None:
        self.Y = np.zeros((len(self.gg.Y), steps))
        self.means = np.zeros((len(self._means.kept), steps))
        # health and severity
        self.held = np.empty((len(self.gg.THETA) + len(self.severities), steps))
        self.t_w = np.empty(samples)
        self.waves = np.empty((len(WAVEFORMS), samples))

    def put(self, k: int, n: int, row: Row) -> None:
        """Enter n exchange instants, the first of which is k."""
        at = self._columns(k, n)
        self.Y[:, at] = row.y.reshape(-1, n)
        if isinstance(row.means, RawMeans):
            self._later(at.start, row.means)
        else:
            self.means[:, at] = row.means.reshape(-1, n)
        if row.factors is not self._factors or row.fault is not self._fault:
            self._factors, self._fault = row.factors, row.fault
            now = (*row.factors.values(), *_now(self.severities, row.fault))
            self._column = np.array(now)[:, None]
        self.held[:, at] = self._column
        if self.t_w.size:
            self._put_waves(row.t, row.w)

    def _later(self, at: int, means: RawMeans) -> None:
        """Take means whose rms values are made together with those of their neighbours."""
        if self._raw and (len(self._raw) >= _TOGETHER or self._raw[0][:2] != means[:2]):
            self._settle()
        if not self._raw:
            self._raw_at = at
        self._raw.append(means)

    def _settle(self) -> None:
        if self._raw:
            made = self._means.settle(self._raw)
            self.means[:, self._raw_at : self._raw_at + made.shape[1]] = made
            self._raw = []

    def _columns(self, k: int, n: int) -> slice:
        """Return where instants k to k + n - 1 go, after making room for them."""
        if k + n - self._first > self.Y.shape[1]:
            self._flush()
            self._first = k
        self._end = k + n
        return slice(k - self._first, self._end - self._first)

    def _put_waves(self, t: np.ndarray, w: np.ndarray) -> None:
        n = t.size
        if self._n + n > self.t_w.size:
            self._flush_waves()
            if n > self.t_w.size:  # a long step
                self.t_w, self.waves = np.empty(n), np.empty((len(WAVEFORMS), n))
        self.t_w[self._n : self._n + n] = t
        self.waves[:, self._n : self._n + n] = w
        self._n += n

    def _flush(self) -> None:
        """Write the instants in the arrays to the file."""
        assert self.file is not None
        self._settle()
        n = self._end - self._first
        part = copy.copy(self)
        part.Y, part.means = self.Y[:, :n], self.means[:, :n]
        part.held = self.held[:, :n]
        for name, row in part._rows().items():
            self.file.write(name, self._first, row)
        self._residual = self.residual_max()

    def _flush_waves(self) -> None:
        assert self.file is not None
        for name, row in zip(_WAVE_ROWS, (self.t_w, *self.waves), strict=True):
            self.file.write(name, self._first_w, row[: self._n])
        self._first_w, self._n = self._first_w + self._n, 0

    def residual_max(self) -> float:
        """Largest scaled residual of the gas path equations so far."""
        now = self.Y[self.gg.Y.index("residual"), : self._end - self._first]
        return max(self._residual, float(now.max()))

    def keep(self, name: str, values: np.ndarray) -> Any:
        """Keep more values, where the others are."""
        return values if self.file is None else self.file.add(name, values)

    def last(self) -> np.ndarray:
        """Outputs of the gas generator at the last instant entered, shape (ny,)."""
        return self.Y[:, self._end - self._first - 1]

    def instants(self) -> dict[str, Any]:
        """All that is kept of the exchange instants, by name; the run is complete."""
        self._settle()
        if self.file is None:
            return self._rows()
        self._flush()
        return {n: self.file.array(n) for n in self._names}

    def samples(self) -> tuple[np.ndarray, dict[str, Any]]:
        """Times of the waveform samples, and the waveforms by name; empty where none are kept."""
        if not self.t_w.size:
            return self.t_w, {}
        if self.file is None:
            return self.t_w, dict(zip(WAVEFORMS, self.waves, strict=True))
        self._flush_waves()
        t, *waves = (self.file.array(n) for n in _WAVE_ROWS)
        return np.asarray(t), dict(zip(WAVEFORMS, waves, strict=True))

    def _rows(self) -> dict[str, np.ndarray]:
        return {**dict(zip(self.gg.Y.names, self.Y, strict=True)), **self._slow()}

    def _slow(self) -> dict[str, np.ndarray]:
        """Means, rms values, phasors, health and severity by name."""
        d = dict(zip(self._means.kept, self.means, strict=True))
        names = (*self.gg.THETA.names, *self.severities.names)
        return d | dict(zip(names, self.held, strict=True))

    def collect(
        self,
        apu: Apu,
        run: Mapping[str, Any],
        noise: Noise,
        rng: np.random.Generator,
        attrs: Mapping[str, Any],
    ) -> xr.Dataset:
        """Put the run into a labelled dataset, with what noisy sensors read of it."""
        gg, y_sg = self.gg, apu.generator.state_space().y
        signals = [*gg.Y, *phasor_signals(), *self.severities]

        def measured(signal: Any, values: np.ndarray) -> dict[str, Any]:
            name = f"{signal.name}_meas"
            signals.append(dataclasses.replace(signal, name=name, doc=f"measured: {signal.doc}"))
            return {name: self.keep(name, values)}

        values: dict[str, dict[str, Any]] = {"time": dict(run)}
        for n, s in noise.gas.items():
            values["time"] |= measured(gg.Y[n], measure(run[n], s, rng))
        times = {"time": self.grid}
        t_w, w = self.samples()
        if w:
            times["time_w"] = t_w
            w["P_inst"] = w.pop("P_total")
            if noise.terminal is not None:
                for n, a in noise.terminal.each(dict(w), rng):
                    w |= measured(y_sg[n], a)
            values["time_w"] = w
        told = {"parameters": json.dumps(apu.parameters()), **attrs}
        return dataset(times, values, signals=signals, attrs=told)


def stored_severities(events: Iterable[Event], *others: Fault | None) -> Signals:
    """Return what a run stores of the severity of its faults, the TTSC's always."""
    faults = (*(e.fault for e in events if isinstance(e, FaultChange)), *others)
    stored = [*_STORED, *(s for f in faults if f is not None for s in f.severities)]
    return Signals({s.name: s for s in stored}.values())


def _now(severities: Signals, fault: Fault | None) -> list[float]:
    """Return their values under a fault or without one."""
    values = {} if fault is None else fault.severity
    return [values.get(s.name, s.default or 0.0) for s in severities]
