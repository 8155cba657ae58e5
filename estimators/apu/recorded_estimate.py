"""Estimates from what was measured, by whatever filter the channels suffice for.

    m = read_recording("run.csv")
    r = estimate(m, engine="my_engine.toml")
    print(r.summary())

The gas-path filter takes the fuel flow as an input and any outputs that are there; shaft power is
measured, comes from the waveforms, or is unknown.  The electrical filter takes the waveforms of a
machine with its field and speed.  Where both are there they are fused as in
:mod:`estimators.apu.joint`.  Of fewer channels come symmetrical components and their change.  What
is not estimated has its reason in ``lacking``; ``doubts`` says why an estimate is not to be
believed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import DataError, EstimationError, ParameterError, nearest
from apu_casadi.gaspath.conditions import CONDITIONS, assumed_words
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.park import PHASES
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.enginefile import read_unit
from estimators.apu.electrical.electricalfilter import window_starts
from estimators.apu.electrical.gaps import evened, usable
from estimators.apu.electrical.sequences import Sequences, sequences
from estimators.apu.electrical.terminalsignals import MEASURED, PHASES_I, PHASES_V, VOLTAGES
from estimators.apu.gaspath import N_SIGMA, GasPathFilter, gas_path_filter
from estimators.apu.gaspathmodel import DT
from estimators.apu.healthjumps import Tracked, track_jumps
from estimators.apu.joint import (
    ETA_SIGMA,
    ElectricalSide,
    electrical_side,
    fused,
    unit_of,
)
from estimators.apu.recorded_report import (
    SURE,
    Z95,
    gas_dataset,
    gas_report,
    machine_report,
    sequence_report,
    side_dataset,
    words,
)
from estimators.apu.recordings.measured import Measurements
from estimators.apu.recordings.plausible import WAVES, clipped, plain
from estimators.apu.sensors import ELECTRICAL, SensorSet, gas_path_table
from estimators.filters.filtering import FilterResult
from estimators.information.consistency import exceeded

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["PARTS", "RecordedEstimate", "estimate"]

PARTS = ("gaspath", "electrical")
Streams = dict[str, tuple[np.ndarray, np.ndarray]]
NEEDED = ("w_r", *VOLTAGES, *MEASURED)
PER_PERIOD = 8  # samples of a period that the electrical filter needs
SLOW = 0.1  # s, a step of the fuel flow with which transients are not seen
GAP = 5.0  # steps of a measured input, from which nobody knows what it was meanwhile
STEP = 1.5 * DT  # longest of the gas-path filter
RESTLESS = 0.1  # s, in which the electrical filter begins anew three times only if it is wrong
STILL = 25  # equal readings in a row that noise does not give
FEWEST = 20  # innovations that a verdict takes
SEVERAL = 100.0  # chi-squared of two degrees of freedom that one faulty phase leaves unexplained
STEEP = 0.1  # change of a factor beyond which no filter was tried


@dataclass(frozen=True, eq=False)
class RecordedEstimate:
    """What a recording says.

    Args:
        gaspath: estimates of speed and health with their sigmas; None: not estimated.
        machines: by number, severities and mechanical power with their sigmas.
        sequences: symmetrical components by what they are of, ``"i of machine 1"``.
        joint: whether the gas-path filter had its shaft power from the waveforms.
        lacking: what was not estimated, and why.
        notes: how the recording was understood, and what was assumed.
        doubts: why the estimates are not to be believed.
        result: of the gas-path filter; None: not estimated.
    """

    gaspath: xr.Dataset | None
    machines: Mapping[int, xr.Dataset]
    sequences: Mapping[str, Sequences]
    joint: bool
    lacking: Mapping[str, str]
    notes: tuple[str, ...]
    doubts: tuple[str, ...]
    result: FilterResult | None = field(default=None, repr=False)

    @property
    def believable(self) -> bool:
        """Whether nothing speaks against the estimates."""
        return not self.doubts

    def datasets(self) -> dict[str, xr.Dataset]:
        """Return the estimates over time by what they are of."""
        out = {} if self.gaspath is None else {"gaspath": self.gaspath}
        return out | {f"electrical_{k}": e for k, e in self.machines.items()}

    def report(self) -> dict[str, Any]:
        """Return the estimates at the end, alarms and verdicts, ready for JSON."""
        out: dict[str, Any] = {"believable": self.believable, "doubts": list(self.doubts)}
        if self.gaspath is not None:
            out["gaspath"] = gas_report(self.gaspath, joint=self.joint)
        out["machines"] = {str(k): machine_report(e) for k, e in self.machines.items()}
        out["sequences"] = {n: sequence_report(s) for n, s in self.sequences.items()}
        return out | {"lacking": dict(self.lacking), "notes": list(self.notes)}

    def summary(self) -> str:
        """Return the report in words."""
        return "\n".join(words(self.report()))


def estimate(
    m: Measurements,
    engine: Apu | str | Path | None = None,
    *,
    only: str | None = None,
    sensors: SensorSet | None = None,
    electrical_sensors: SensorSet = ELECTRICAL,
    ambient: Mapping[str, float] | None = None,
    backend: str | None = None,
) -> RecordedEstimate:
    """Estimate what the channels of a recording suffice for.

    Args:
        m: of :func:`estimators.apu.recordings.measured.read_recording`.
        engine: the unit as the filters know it, or its file or name; the paper's by default.
        only: ``"gaspath"`` or ``"electrical"``; both by default.
        sensors: 1-sigma table of the gas path; default: :func:`gas_path_table` and whatever known
            sensor was measured besides.
        electrical_sensors: the same of the generators.
        ambient: altitude, Mach, dT_isa, war; they go before columns, and these before the default
            day.
        backend: see :func:`apu_casadi.core.backend.compiled`.

    Raises:
        ParameterError: unknown ``only`` or ambient condition.
        DataError: nothing can be estimated; a rate below twice the frequency, a gap in the fuel
            flow, an ambient condition out of range.
    """
    if only is not None and only not in PARTS:
        raise ParameterError(f"only {only!r} {nearest(only, PARTS)}")
    apu = engine if isinstance(engine, Apu) else Apu() if engine is None else read_unit(engine).unit
    table = gas_path_table().including(*m.gaspath) if sensors is None else sensors
    lacking: dict[str, str] = {}
    notes, doubts = list(m.notes), list(_odd_channels(m, table))
    sides: dict[int, ElectricalSide] = {}
    found: dict[str, Sequences] = {}
    reason = None if only == "electrical" else _no_gas_path(m, table)
    gas = reason is None and only != "electrical"
    if only != "electrical" and reason is not None and (m.gaspath or only):
        lacking["gas path"] = reason
    begin = float(m.streams("Wf")["Wf"][0][0]) if gas else -math.inf
    if only != "gaspath" and m.electrical:
        for k in _machines(m):
            waves = _Waves(m.machine(k), k, unit_of(apu, k), electrical_sensors, backend)
            found |= waves.sequences(lacking)
            side = waves.side(begin, lacking, doubts)
            if side is not None:
                sides[k] = side
    elif only == "electrical":
        lacking["generators"] = "nothing of them was measured"
    tracked: Tracked | None = None
    e = None
    fusable = _fusable(m, apu, sides, notes) if gas else {}
    if gas:
        path = _GasPath(m, apu, table, ambient or {}, notes, doubts, backend)
        filt, tracked = path.run(fusable, electrical_sensors)
        e = gas_dataset(filt, tracked)
        _judge_gas(filt, tracked, list(sides.values()), doubts)
        if int(tracked.result.measured.sum()) < FEWEST * len(filt.model.y):
            notes.append("so few readings hardly show whether the model holds")
    if e is None and not sides and not found:
        why = "; ".join(f"{n}: {w}" for n, w in lacking.items()) or "nothing was measured"
        raise DataError(f"nothing can be estimated: {why}")
    if apu.alike and 0 < len(sides) < len(apu.machines):
        notes.append(
            f"only machine {', '.join(map(str, sides))} is estimated; power is that of "
            f"{len(apu.machines)} equal ones"
        )
    machines = {k: side_dataset(s) for k, s in sides.items()}
    result = None if tracked is None else tracked.result
    texts = tuple(dict.fromkeys(notes)), tuple(dict.fromkeys(doubts))
    return RecordedEstimate(e, machines, found, bool(fusable), lacking, *texts, result)


def _fusable(
    m: Measurements, apu: Apu, sides: Mapping[int, ElectricalSide], notes: list[str]
) -> dict[int, ElectricalSide]:
    """Return the machines whose powers make the shaft power."""
    if not sides:
        return {}
    if not apu.alike:
        notes.append("the generators differ: the gas path has no shaft power from the waveforms")
        return {}
    t, fuel = next(iter(sides.values())).t, m.streams("Wf")["Wf"][0]
    if min(t[-1], fuel[-1]) - max(t[0], fuel[0]) < 0.5 * (fuel[-1] - fuel[0]):
        notes.append(
            f"the waveforms, {t[0]:g} to {t[-1]:g} s, cover less than half of the gas path's time: "
            "the two are estimated apart; give that part of the gas path alone to have both"
        )
        return {}
    alike = {k: s for k, s in sides.items() if s.t.shape == t.shape}
    alike = {k: s for k, s in alike.items() if np.abs(s.t - t).max() <= 1e-9}
    if len(alike) < len(sides):
        notes.append("the generators were sampled at other instants: power is that of the first")
    return alike


def _no_gas_path(m: Measurements, table: SensorSet) -> str | None:
    """Say why there is no gas-path estimate; None if there is one."""
    if "Wf" not in m or not np.isfinite(m["Wf"].values).any():
        return "the filter takes the fuel flow Wf as an input, which was not measured"
    if not [n for n in table.outputs if n in m and n != "N"]:
        return f"none of {', '.join(n for n in table.outputs if n != 'N')} was measured"
    return None


def _odd_channels(m: Measurements, table: SensorSet) -> Iterator[str]:
    """Say which sensors stand still while most others move, or are clipped."""
    used = (*table.names, *m.electrical)
    sensors = {n: c for n, c in m.items() if n in used and np.isfinite(c.values).any()}
    for n, c in sensors.items():
        others = [o.values for o in sensors.values() if o is not c and o.t is c.t]
        rows = _still(c.values, others)
        if rows is not None:
            yield f"{c.source}: {n} stands still from {c.t[rows[0]]:g} to {c.t[rows[1]]:g} s"
        count = clipped(c.values) if plain(n) in WAVES else 0
        if count:
            yield f"{c.source}: {count} samples of {n} are clipped"


def _still(values: np.ndarray, others: Sequence[np.ndarray]) -> tuple[int, int] | None:
    """First and last row of the longest run of one reading, if most others change in it."""
    change = np.flatnonzero(np.append(True, values[1:] != values[:-1]))
    length = np.diff(np.append(change, values.size))
    k = int(length.argmax())
    if length[k] < STILL:
        return None
    part = slice(change[k], change[k] + length[k])
    there = [o[part][np.isfinite(o[part])] for o in others]
    moving = [np.ptp(o) > 0 for o in there if o.size]
    return (int(change[k]), int(part.stop) - 1) if moving and np.mean(moving) > 0.5 else None


def _machines(m: Measurements) -> list[int]:
    """Numbers of the machines that were measured; 1 where the names have none."""
    ends = {n.rpartition("_")[2] for n in m.electrical} & set("1234")
    return sorted(map(int, ends)) or [1]


# ------------------------------------------------------------------------------ generators


@dataclass(frozen=True, eq=False)
class _Waves:
    """One machine's waveforms and what they suffice for."""

    m: Measurements
    number: int
    apu: Apu
    sensors: SensorSet
    backend: str | None

    def sequences(self, lacking: dict[str, str]) -> dict[str, Sequences]:
        """Symmetrical components of currents and voltages."""
        out = {}
        for kind, names in (("i", PHASES_I), ("v", PHASES_V)):
            there = [n for n in names if n in self.m]
            what = f"{kind} of machine {self.number}"
            for n in there:
                self._check_rate(n)
            if 0 < len(there) < 3:
                no = ", ".join(self.m.lacking(names))
                lacking[f"symmetrical components, {what}"] = f"{no} was not measured"
            elif there:
                a = self.m.samples(*names)
                try:
                    out[what] = sequences(a["t"], np.array([a[n] for n in names]))
                except DataError as e:
                    lacking[f"symmetrical components, {what}"] = str(e)
        return out

    def _check_rate(self, name: str) -> None:
        rate, f = self.m[name].rate, self.apu.generator.machine.f_rated
        if rate < 2 * f * (1 - 1e-6):
            raise DataError(
                f"{self.m[name].source}: {rate:g} samples a second show nothing of {f:g} Hz: "
                f"{2 * f:g} are needed at least, {PER_PERIOD * f:g} for the electrical filter; "
                "give the engine if the machine has another frequency"
            )

    def side(
        self, begin: float, lacking: dict[str, str], doubts: list[str]
    ) -> ElectricalSide | None:
        """Run the electrical filter from an instant on; None where it cannot."""
        what = f"severity, machine {self.number}"
        no = self.m.lacking(NEEDED)
        if no:
            lacking[what] = f"the electrical filter needs {', '.join(no)} too"
            return None
        rate, f = self.m["v_a"].rate, self.apu.generator.machine.f_rated
        if rate < PER_PERIOD * f * (1 - 1e-6):
            lacking[what] = (
                f"{rate:g} samples a second; the electrical filter needs {PER_PERIOD * f:g}, "
                f"{PER_PERIOD} a period"
            )
            return None
        waves = self.m.samples(*NEEDED[1:])
        w = self.m.streams("w_r")["w_r"]
        if self.m["w_r"].t is not self.m["v_a"].t:
            inside = (waves["t"] >= w[0][0]) & (waves["t"] <= w[0][-1])
            waves["w_r"] = np.where(inside, np.interp(waves["t"], *w), np.nan)
        else:
            waves |= self.m.samples("w_r")
        try:
            a = usable({n: waves[n] for n in ("t", *NEEDED)}, ("w_r", *VOLTAGES))
            a = {n: v[a["t"] >= begin - 1e-9] for n, v in a.items()}
            if a["t"].size < 2 or a["t"][-1] - a["t"][0] < DT:
                raise DataError(f"the waveforms hold no window of {DT * 1e3:g} ms")
            even = evened(a)["t"]
            t = even[window_starts(even, DT, None)]
            side = electrical_side(self.apu, self.sensors, a, t, backend=self.backend)
        except (DataError, EstimationError) as e:
            lacking[what] = str(e)
            return None
        # gain errors are taken for noise, so that they are there as offsets
        found = [(v - DT, v + DT) for v in (side.t[0], *side.resets)]
        odd = _unexplained(side.result, found, offset=3.0)
        doubts += (f"machine {self.number}, {text}" for text in (*odd, *_restless(side)))
        return side


# ------------------------------------------------------------------------------ gas path


@dataclass(frozen=True, eq=False)
class _GasPath:
    """The gas-path channels made ready for the filter."""

    m: Measurements
    apu: Apu
    table: SensorSet
    ambient: Mapping[str, float]
    notes: list[str]
    doubts: list[str]
    backend: str | None

    def run(
        self, of: Mapping[int, ElectricalSide], electrical: SensorSet
    ) -> tuple[GasPathFilter, Tracked]:
        """Filter, with the power of the electrical side where there is one."""
        sides = list(of.values())
        power = bool(sides) or "PW" in self.m
        # speed and the measured inputs stay in the table
        absent = [n for n in self.table.outputs if n not in self.m and n != "N"]
        sensors = self.table.only([n for n in self.table.names if n not in absent])
        inputs = self._inputs()
        span = (sides[0].t[0], sides[0].t[-1]) if sides else (-math.inf, math.inf)
        readings = self._readings(sensors, inputs, span, known_power=power and not sides)
        gg = self.apu.gas_generator
        if not power:
            self.notes.append("no shaft power was measured: it is a random walk")
        if sides:
            own = self.m.machine(next(iter(of))).streams("w_r")["w_r"]
            inside = (own[0] >= span[0] - 1e-9) & (own[0] <= span[1] + 1e-9)
            own = own[0][inside], own[1][inside]
            return fused(
                self.apu,
                sides,
                readings,
                sensors,
                speed=own,
                speed_sigma=electrical.sigma("w_r", float(np.median(own[1]))),
                prior=self._start(readings, sensors),
                inputs=inputs,
                backend=self.backend,
                max_dt=STEP,
            )
        filt = gas_path_filter(
            gg,
            sensors,
            power="measured" if power else "unknown",
            eta=ETA_SIGMA if power else None,
            consider_eta=False,
        )
        data = filt.of_readings(readings, inputs=inputs, max_dt=STEP)
        start = filt.prior(**self._start(readings, sensors))
        return filt, track_jumps(filt, data, prior=start, backend=self.backend)

    def _inputs(self) -> dict[str, Any]:
        """Ambient conditions: as given, else of columns."""
        for n, v in self.ambient.items():
            if n not in CONDITIONS:
                raise ParameterError(f"unknown ambient condition {n!r} {nearest(n, CONDITIONS)}")
            c = CONDITIONS[n]
            if not c.lo <= v <= c.hi:
                raise DataError(f"{n} = {v:g} {c.unit} is outside [{c.lo:g}, {c.hi:g}]")
        measured = {n: self.m.streams(n)[n] for n in CONDITIONS if n in self.m}
        out = measured | dict(self.ambient)
        if left := assumed_words(out):
            self.notes.append(f"ambient conditions assumed, which nobody gave: {left}")
        return out

    def _readings(
        self,
        sensors: SensorSet,
        inputs: Mapping[str, Any],
        span: tuple[float, float],
        *,
        known_power: bool,
    ) -> Streams:
        """Readings from the instant that has all inputs to the last one."""
        streams = self.m.streams(*(n for n in sensors.names if n in self.m))
        for n in [n for n, (t, _) in streams.items() if not t.size]:
            del streams[n]
        held = ["Wf", "PW"] if known_power else ["Wf"]
        for n in held:
            if n not in streams:
                raise DataError(f"{n} has no reading")
            self._check_gaps(n, streams[n][0])
        stamps = [v[0] for v in inputs.values() if isinstance(v, tuple)]
        begin = max(span[0], *(streams[n][0][0] for n in held), *(t[0] for t in stamps))
        last = {n: streams[n][0] for n in held}
        end = min(span[1], *(t[-1] + float(np.median(np.diff(t))) for t in last.values()))
        out = {}
        for n, (t, v) in streams.items():
            inside = (t <= end + 1e-9) & ((t >= begin - 1e-9) | (n in held))
            if n not in held and not inside.all():
                self.notes.append(
                    f"{n}: {int((~inside).sum())} readings are not used, outside {begin:g} to "
                    f"{end:g} s, where all inputs are known"
                )
            if inside.any():
                out[n] = t[inside], v[inside]
        if not [n for n in out if n in sensors.outputs]:
            raise DataError(f"no output was measured between {begin:g} and {end:g} s")
        return out

    def _check_gaps(self, name: str, t: np.ndarray) -> None:
        if t.size < 2:
            raise DataError(f"{name}: one reading is no recording; apu fit takes steady points")
        step = np.diff(t)
        usual = float(np.median(step))
        k = int(step.argmax())
        if step[k] > max(GAP * usual, 0.2):
            raise DataError(
                f"{name}: no reading from {t[k]:g} to {t[k + 1]:g} s; the filter takes it as an "
                "input and cannot go over that: give the parts before and after as files of "
                "their own"
            )
        if usual > SLOW:
            self.doubts.append(
                f"{name} is known every {usual:g} s only: what happens in between is taken for a "
                "change of health"
            )

    def _start(self, readings: Streams, sensors: SensorSet) -> dict[str, float]:
        """Means of the start from the first readings, where the usual ones are far off."""
        out = {s.name: float(readings[s.name][1][0]) for s in sensors.sensors if s.tau}
        if "N" in readings:
            t, v = readings["N"]
            N, governed = float(v[t < t[0] + 0.2].mean()), self.apu.gas_generator.parameters.N
            if abs(N - governed) > 2 * N_SIGMA:
                out["N"] = N
                self.notes.append(f"the start is at {N:.1f} rad/s, not at the governed speed")
        return out


# ------------------------------------------------------------------------------ judging


def _unexplained(
    r: FilterResult, explained: Sequence[tuple[float, float]], *, offset: float = 0.0
) -> Iterator[str]:
    """Say which sensors the model and the stated noise do not explain, by their innovations.

    Args:
        r: of the filter.
        explained: intervals that a report explains, s.
        offset: constant offsets of the sensors that must be allowed for, sigmas.
    """
    quiet = np.ones(r.t.size, bool)
    for begin, end in explained:
        quiet &= (r.t <= begin + 1e-9) | (r.t > end + 1e-9)
    for name, e, s in zip(r.y.names, r.innovation, r.innovation_variance, strict=True):
        z = (e / np.sqrt(s))[quiet & np.isfinite(e)]
        if z.size < FEWEST:
            continue
        if (z @ z) > (1.25 + offset**2) * exceeded(1e-4, z.size):
            yield (
                f"{name}: its innovations are {math.sqrt(z @ z / z.size):.2f} times what model "
                "and stated noise explain"
            )
        # white, if the filter is right
        elif abs(z.mean()) > offset + 6 / math.sqrt(z.size):
            yield f"{name}: its innovations have a mean of {z.mean():+.2f} sigma"


def _restless(side: ElectricalSide) -> Iterator[str]:
    """Say where the electrical filter starts again and again, or finds several phases faulty."""
    often = [v for k, v in enumerate(side.resets[2:]) if v - side.resets[k] <= RESTLESS]
    if often:
        yield (
            f"its filter began anew {len(side.resets)} times up to {side.resets[-1]:g} s, as after "
            "a step of load or a fault: no model of one step fits, and reports around are doubtful"
        )
    several = np.flatnonzero((side.phase > 0) & (side.misfit > SEVERAL))
    if several.size:
        yield (
            f"at {side.t[several[0]]:g} s several phases look faulty at once, which is no short "
            "circuit of one phase"
        )


def _judge_gas(
    filt: GasPathFilter, tracked: Tracked, sides: list[ElectricalSide], doubts: list[str]
) -> None:
    """Say why the gas-path estimate is not to be believed."""
    r = tracked.result
    each = zip(tracked.onsets, tracked.alarms, strict=True)
    doubts += _unexplained(r, [(float(r.t[i]), float(r.t[k]) + 0.1) for i, k in each])
    if len(tracked.alarms) >= 8:
        doubts.append("8 changes of health were reported, and further ones were not looked for")
    x, s = (np.array([r[n][k][-1] for n in HEALTH]) for k in (0, 1))
    for n, v in zip(HEALTH, x, strict=True):
        if abs(v - 1) > STEEP:
            doubts.append(f"{n} = {v:.3f} is farther from 1 than any that the filter was tried on")
    changed = bool(tracked.alarms) or bool((np.abs(x - 1) > SURE * s).any())
    for side in sides:
        h, h_sigma = side.severities[:, :, -1]
        i = int((h / h_sigma).argmax())
        if changed and not side.phase[-1] and h[i] > 2 * h_sigma[i]:
            doubts.append(
                f"a short circuit of h_{PHASES[i]} = {h[i]:.1e} +- {Z95 * h_sigma[i]:.1e} may be "
                "there, too small to be told from gain errors; the change of health may be its loss"
            )
