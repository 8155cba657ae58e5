"""What a joint run keeps, and the dataset that is made of it."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from apu_casadi.core.filearrays import RowFile
from apu_casadi.core.measuring import measure
from apu_casadi.core.profiles.profile import Varying
from apu_casadi.core.results import dataset
from apu_casadi.core.runstorage import PIECE, place, row_file
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.departures import Departure, excess_of
from apu_casadi.unit.events import Event, FaultChange
from apu_casadi.unit.integrators import WAVEFORMS
from apu_casadi.unit.runsignals import RUN
from apu_casadi.unit.stepmeans import RawMeans, StepMeans, phasor_signals

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.unit.machines import Of
    from apu_casadi.unit.noise import Noise

_TOGETHER = 5000  # steps whose rms values are made at once
_STORED = Signals(Ttsc.severities)  # severities that every run stores
_P_WAVE = f"{WAVEFORMS[-1]} waveform"  # P_total is a mean as well


class Row(NamedTuple):
    """What one or more exchange steps gave.

    Args:
        y: outputs of the gas generator, shape (ny,) or (ny, steps).
        of: what each group of generators gave.
        factors: health by name; numbers, or one for each step.
        t: instants of the waveform samples, s.
    """

    y: np.ndarray
    of: Sequence[Of]
    factors: Mapping[str, Any]
    t: np.ndarray


class _Kept:
    """What is kept of generators that stay equal through the run.

    Args:
        numbers, means: which they are, and what makes what is kept of their means.
        severities: what is kept of the severity of faults.
    """

    numbers: tuple[int, ...]
    means: np.ndarray
    severe: np.ndarray
    waves: np.ndarray

    def __init__(self, numbers: tuple[int, ...], means: StepMeans, severities: Signals) -> None:
        self.numbers, self.of_step, self.severities = numbers, means, severities
        self._raw, self._raw_at = list[RawMeans](), 0
        self._fault: Fault | Mapping[str, np.ndarray] | None = None
        self._column = self._now(None)

    def allocate(self, steps: int, samples: int) -> None:
        self.means = np.zeros((len(self.of_step.kept), steps))
        self.severe = np.empty((len(self.severities), steps))
        self.waves = np.empty((len(WAVEFORMS), samples))

    def put(self, at: slice, row: Of) -> None:
        if isinstance(row.means, RawMeans):
            self._later(at.start, row.means)
        else:
            self.means[:, at] = row.means.reshape(-1, at.stop - at.start)
        if row.fault is not self._fault:
            self._fault, self._column = row.fault, self._now(row.fault)
        self.severe[:, at] = self._column

    def _now(self, fault: Fault | Mapping[str, np.ndarray] | None) -> np.ndarray:
        """Return the severities under a fault or without one, as a column, or one for each step."""
        given = fault if fault is None or isinstance(fault, Mapping) else fault.severity
        values = given or {}
        rows = [values.get(s.name, s.default or 0.0) for s in self.severities]
        return _columns(rows)

    def _later(self, at: int, means: RawMeans) -> None:
        """Take means whose rms values are made together with those of their neighbours."""
        if self._raw and (at - self._raw_at >= _TOGETHER or self._raw[0][:2] != means[:2]):
            self.settle()
        if not self._raw:
            self._raw_at = at
        self._raw.append(means)

    def settle(self) -> None:
        if self._raw:
            made = self.of_step.settle(self._raw)
            self.means[:, self._raw_at : self._raw_at + made.shape[1]] = made
            self._raw = []

    def power(self, row: np.ndarray) -> np.ndarray:
        """Power of all of them, W, from a row of that of two (8)."""
        pairs = len(self.numbers) / 2
        return row if pairs == 1.0 else pairs * row


class Recorder:
    """What a run keeps: outputs per exchange, means, health, severity, waveforms.

    The arrays hold the whole run, or the piece of it that has not gone to ``file`` yet.  Of
    generators that stay equal through the run one is kept.

    Args:
        gg, grid: gas generator, and exchange instants, s.
        samples: waveform samples in all, the start included.
        means: makes what is kept of the means, by the numbers of equal generators.
        storage: see :func:`apu_casadi.unit.multirate.simulate_joint`.
        severities: what is kept of the severity of faults.
    """

    gg: GasGenerator
    grid: np.ndarray
    of: list[_Kept]
    held: np.ndarray
    t_w: np.ndarray

    def __init__(
        self,
        gg: GasGenerator,
        grid: np.ndarray,
        samples: int,
        means: Mapping[tuple[int, ...], StepMeans],
        storage: str | os.PathLike[str] = "memory",
        severities: Signals = _STORED,
    ) -> None:
        self.severities = severities
        self.of = [_Kept(k, m, severities) for k, m in means.items()]
        kept = {g: k for k in self.of for g in k.numbers}
        self._by_number = {g: kept[g] for g in sorted(kept)}
        self.gg, self.grid, self._means = gg, grid, self.of[0].of_step
        self._own = (*self._means.kept[1:], *severities.names)
        alike = len(self.of) == 1
        #: rows of what each generator has of its own, by quantity
        self._numbered = {
            n: [n] if alike else [f"{n} {g}" for g in self._by_number]
            for n in (*self._own, *WAVEFORMS[:-1])
        }
        n_own = len(self._own) * len(self._numbered["P_e"])
        n_slow = len(gg.Y) + 1 + len(gg.THETA) + n_own
        n_waves = 2 + len(WAVEFORMS[:-1]) * len(self._numbered["P_e"])
        size = 8 * (n_slow * grid.size + n_waves * samples)
        self._first = self._end = 0  # instants in the arrays
        self._first_w = self._n = 0  # samples before those in the arrays, and in them
        self._residual = 0.0
        self._factors: Mapping[str, Any] | None = None
        self.file: RowFile | None = None
        where = place(size, storage)
        if where is None:
            self._allocate(grid.size, samples)
            return
        self._allocate(1, 1)
        self._names = [*self._rows()]
        rows = dict.fromkeys(self._names, grid.size)
        waves = dict.fromkeys(self._wave_rows(0) if samples else (), samples)
        self.file = row_file({**rows, **waves}, where, needed=storage != "auto")
        piece = PIECE if self.file is not None else size
        self._allocate(min(grid.size, piece), min(samples, piece))

    def _allocate(self, steps: int, samples: int) -> None:
        self.Y = np.zeros((len(self.gg.Y), steps))
        self.held = np.empty((len(self.gg.THETA), steps))
        self.t_w = np.empty(samples)
        for kept in self.of:
            kept.allocate(steps, samples)

    def put(self, k: int, n: int, row: Row) -> None:
        """Enter n exchange instants, the first of which is k."""
        at = self._columns(k, n)
        self.Y[:, at] = row.y.reshape(-1, n)
        if row.factors is not self._factors:
            self._factors = row.factors
            self._column = _columns([*row.factors.values()])
        self.held[:, at] = self._column
        parts = [next(of for of in row.of if kept.numbers[0] in of.numbers) for kept in self.of]
        for kept, of in zip(self.of, parts, strict=True):
            kept.put(at, of)
        if self.t_w.size:
            self._put_waves(row.t, [of.w for of in parts])

    def _settle(self) -> None:
        for kept in self.of:
            kept.settle()

    def _columns(self, k: int, n: int) -> slice:
        """Return where instants k to k + n - 1 go, after making room for them."""
        if k + n - self._first > self.Y.shape[1]:
            self._flush()
            self._first = k
        self._end = k + n
        return slice(k - self._first, self._end - self._first)

    def _put_waves(self, t: np.ndarray, waves: Sequence[np.ndarray]) -> None:
        n = t.size
        longer = self._n + n > self.t_w.size
        if longer:
            self._flush_waves()
            longer = n > self.t_w.size  # a long step
        if longer:
            self.t_w = np.empty(n)
        self.t_w[self._n : self._n + n] = t
        for kept, w in zip(self.of, waves, strict=True):
            if longer:
                kept.waves = np.empty((len(WAVEFORMS), n))
            kept.waves[:, self._n : self._n + n] = w
        self._n += n

    def _flush(self) -> None:
        """Write the instants in the arrays to the file."""
        assert self.file is not None
        self._settle()
        n = self._end - self._first
        for name, row in self._rows().items():
            self.file.write(name, self._first, row[:n])
        self._residual = self.residual_max()

    def _flush_waves(self) -> None:
        assert self.file is not None
        for name, row in self._wave_rows(self._n).items():
            self.file.write(name, self._first_w, row)
        self._first_w, self._n = self._first_w + self._n, 0

    def _wave_rows(self, n: int) -> dict[str, np.ndarray]:
        """Instants and waveforms of n samples by the names of their rows."""
        table = {"time_w": self.t_w[:n]}
        for i, name in enumerate(WAVEFORMS[:-1]):
            rows = zip(self._numbered[name], self._by_number.values(), strict=False)
            table |= {f"{row} waveform": kept.waves[i, :n] for row, kept in rows}
        total = [kept.power(kept.waves[-1, :n]) for kept in self.of]
        return table | {_P_WAVE: sum(total[1:], total[0])}

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
        """All that is kept of the exchange instants, by name; the run is complete.

        Quantities of a generator have the shape (generators, instants) where these differ.
        """
        self._settle()
        if self.file is None:
            return self._joined(self._rows())
        self._flush()
        return self._joined({n: self.file.array(n) for n in self._names})

    def samples(self) -> tuple[np.ndarray, dict[str, Any]]:
        """Times of the waveform samples, and the waveforms by name; empty where none are kept."""
        if not self.t_w.size:
            return self.t_w, {}
        table: dict[str, Any] = self._wave_rows(self.t_w.size)
        if self.file is not None:
            self._flush_waves()
            table = {n: self.file.array(n) for n in table}
        t = np.asarray(table.pop("time_w"))
        joined = self._joined(table, " waveform")
        return t, {n.removesuffix(" waveform"): w for n, w in joined.items()}

    def _joined(self, table: Mapping[str, Any], suffix: str = "") -> dict[str, Any]:
        """Put the rows of each quantity of the generators together."""
        joined, first = {}, {rows[0]: n for n, rows in self._numbered.items()}
        rest = {row for rows in self._numbered.values() for row in rows[1:]}
        for row, values in table.items():
            plain = row.removesuffix(suffix)
            if plain in first and first[plain] != plain:
                name = first[plain]
                rows = [f"{r}{suffix}" for r in self._numbered[name]]
                both = self.file.array(*rows) if self.file else np.array([table[r] for r in rows])
                joined[name + suffix] = both
            elif plain not in rest:
                joined[row] = values
        return joined

    def _rows(self) -> dict[str, np.ndarray]:
        """Outputs, means, rms values, phasors, health and severity by the names of their rows."""
        table = dict(zip(self.gg.Y.names, self.Y, strict=True))
        total = [kept.power(kept.means[0]) for kept in self.of]
        table["P_total"] = sum(total[1:], total[0])
        n = len(self._means.kept) - 1
        table |= self._of_each(self._own[:n], [k.means[1:] for k in self._by_number.values()])
        table |= dict(zip(self.gg.THETA.names, self.held, strict=True))
        return table | self._of_each(self._own[n:], [k.severe for k in self._by_number.values()])

    def _of_each(self, names: Sequence[str], arrays: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Return the rows of arrays, one for each generator, by the names of the rows."""
        return {
            row: a[i]
            for i, name in enumerate(names)
            for row, a in zip(self._numbered[name], arrays, strict=False)
        }

    def of_each(self, name: str, rows: Mapping[str, Any]) -> dict[tuple[int, ...], np.ndarray]:
        """A quantity of generators over the run, by the numbers of those that are equal.

        Args:
            rows: what :meth:`instants` gave.
        """
        values = np.asarray(rows[name])
        each = {k.numbers: k.numbers[0] - 1 for k in self.of}
        return {k: values if values.ndim == 1 else values[i] for k, i in each.items()}

    @property
    def warnings(self) -> list[Departure]:
        """What must be known of the means."""
        return [
            excess_of(e, None if len(self.of) == 1 else kept.numbers)
            for kept in self.of
            for e in kept.of_step.warnings
        ]

    def collect(
        self,
        apu: Apu,
        run: Mapping[str, Any],
        noise: Noise,
        rng: np.random.Generator,
        attrs: Mapping[str, Any],
        more: Sequence[Signal] = (),
    ) -> xr.Dataset:
        """Put the run into a labelled dataset, with what noisy sensors read of it.

        Args:
            more: signals of what stands in the run beside the own ones.
        """
        gg, y_sg, size = self.gg, apu.generator.state_space().y, len(self._by_number)
        signals = [*RUN, *phasor_signals(), *self.severities, *_powers(size), *more]

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
        return dataset(times, values, signals=signals, attrs=told, generators=size)


def _columns(rows: Sequence[Any]) -> np.ndarray:
    """Return numbers, or arrays with one for each step, as rows of a matrix."""
    size = max(np.size(row) for row in rows)
    made = np.empty((len(rows), size))
    for i, row in enumerate(rows):
        made[i] = row
    return made


def stored_severities(events: Iterable[Event], *others: Any) -> Signals:
    """Return what a run stores of the severity of its faults, the TTSC's always."""
    given = (*(e.fault for e in events if isinstance(e, FaultChange)), *others)
    faults = (f.example() if isinstance(f, Varying) else f for f in given)
    stored = [*_STORED, *(s for f in faults if f is not None for s in f.severities)]
    return Signals({s.name: s for s in stored}.values())


def _powers(n: int) -> list[Signal]:
    """Return the powers of a unit that has not the paper's two generators."""
    if n == 2:
        return []
    of = f"{n} generators" if n > 1 else "the generator"
    return [
        Signal("P_total", "W", f"mean mechanical power of {of} over one exchange (eq 8)"),
        Signal("P_inst", "W", f"instantaneous power of eq 8, {of}"),
    ]
