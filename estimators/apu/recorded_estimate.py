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

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import DataError, EstimationError, ParameterError, nearest
from apu_casadi.gaspath.conditions import CONDITIONS, assumed_words
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.enginefile import read_unit
from apu_casadi.unit.events import who
from estimators.apu.believable import (
    channels_still,
    gas_causes,
    gas_doubts,
    lost,
    still_causes,
    without_still,
)
from estimators.apu.creeping import creep
from estimators.apu.declared import as_declared, tables
from estimators.apu.diagnosis import Diagnosis, diagnoses
from estimators.apu.electrical.causes import Causes
from estimators.apu.electrical.electricalfilter import ElectricalFilter
from estimators.apu.electrical.sequences import Sequences
from estimators.apu.gaspath import (
    ITERATED,
    ITERATIONS,
    N_SIGMA,
    GasPathFilter,
    gas_path_filter,
)
from estimators.apu.gaspathmodel import DT, lag_of
from estimators.apu.healthjumps import JumpTest, Tracked, track_jumps
from estimators.apu.inputgaps import bridged, input_gaps
from estimators.apu.joint import ElectricalSide, Pickup, fused, unit_of
from estimators.apu.machinepowers import fusable
from estimators.apu.peers import compared_sides
from estimators.apu.powerbalance import OUTPUT, balance
from estimators.apu.priorfile import Prior, read_prior
from estimators.apu.recorded_report import (
    balance_report,
    gas_dataset,
    gas_report,
    machine_report,
    sequence_report,
    side_dataset,
    words,
)
from estimators.apu.recordedwaves import Waves, machines_in, told
from estimators.apu.recordings.measured import Measurements
from estimators.apu.sensorfile import SensorFile
from estimators.apu.sensors import ELECTRICAL, SensorSet
from estimators.apu.trust import GAS, GENERATORS, Doubt, about, believed, is_lost, verdict
from estimators.apu.unknowns import EFFICIENCY
from estimators.filters.belief import Belief
from estimators.filters.filtering import FilterResult
from estimators.filters.robust import limit_of, robust_ekf_step
from estimators.models.recording import Recording

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["PARTS", "RecordedEstimate", "electrical_data", "estimate", "gas_path_data"]

PARTS = ("gaspath", "electrical")
Streams = dict[str, tuple[np.ndarray, np.ndarray]]
SLOW = 0.1  # s, a step of the fuel flow with which transients are not seen
STEP = 1.5 * DT  # longest of the gas-path filter
MOST_TOLD = 12  # columns that are not used, by name
FEWEST = 20  # innovations that a verdict takes
#: The gas path's filter step, and its test of jumps, that single wild readings do not reach.
ROBUST = partial(robust_ekf_step, iterations=ITERATIONS, iterated=ITERATED)
JUMPS = JumpTest(limit=limit_of())


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
        path: the gas-path filter and its result with the jumps that it found.
        sides: what the electrical filters say, by machine.
        causes: what each change is, with probabilities, by ``"gas path"`` or ``"machine 1"``.
        compared: what a comparison of the machines says (:mod:`estimators.apu.peers`).
        belief: why each part is not to be believed, by name (:mod:`estimators.apu.trust`).
        balance: loss of the generators by shaft power and output (:mod:`.powerbalance`), where
            both were measured.
    """

    gaspath: xr.Dataset | None
    machines: Mapping[int, xr.Dataset]
    sequences: Mapping[str, Sequences]
    joint: bool
    lacking: Mapping[str, str]
    notes: tuple[str, ...]
    doubts: tuple[str, ...]
    result: FilterResult | None = field(default=None, repr=False)
    path: tuple[GasPathFilter, Tracked] | None = field(default=None, repr=False)
    sides: Mapping[int, ElectricalSide] = field(default_factory=dict, repr=False)
    causes: Mapping[str, tuple[Causes, ...]] = field(default_factory=dict, repr=False)
    compared: Mapping[str, Any] = field(default_factory=dict, repr=False)
    belief: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    balance: xr.Dataset | None = None

    @property
    def believable(self) -> bool:
        """Whether nothing speaks against any part of what is estimated."""
        return not any(self.belief.values()) if self.belief else not self.doubts

    @property
    def diagnoses(self) -> list[Diagnosis]:
        """One answer for each change, by all that saw it."""
        return diagnoses(self.causes)

    def datasets(self) -> dict[str, xr.Dataset]:
        """Return the estimates over time by what they are of."""
        out = {} if self.gaspath is None else {"gaspath": self.gaspath}
        out |= {} if self.balance is None else {"balance": self.balance}
        return out | {f"electrical_{k}": e for k, e in self.machines.items()}

    def report(self) -> dict[str, Any]:
        """Return the estimates at the end, alarms and verdicts, ready for JSON."""
        out: dict[str, Any] = {"believable": self.believable, "doubts": list(self.doubts)}
        out["belief"] = verdict(self.belief)
        if self.gaspath is not None:
            out["gaspath"] = gas_report(self.gaspath, joint=self.joint)
        if self.balance is not None:
            out["balance"] = balance_report(self.balance)
        out["machines"] = {str(k): machine_report(e) for k, e in self.machines.items()}
        if self.compared:
            out["compared"] = dict(self.compared)
        out["sequences"] = {n: sequence_report(s) for n, s in self.sequences.items()}
        out["causes"] = {n: [asdict(c) for c in told] for n, told in self.causes.items() if told}
        out["changes"] = [asdict(d) for d in self.diagnoses]
        return out | {"lacking": dict(self.lacking), "notes": list(self.notes)}

    def summary(self) -> str:
        """Return the report in words."""
        return "\n".join(words(self.report()))


def estimate(
    m: Measurements,
    engine: Apu | str | Path | None = None,
    *,
    only: str | None = None,
    sensors: SensorSet | SensorFile | str | Path | None = None,
    electrical_sensors: SensorSet = ELECTRICAL,
    ambient: Mapping[str, float] | None = None,
    prior: Prior | str | Path | None = None,
    efficiency_error: float = 0.0,
    backend: str | None = None,
) -> RecordedEstimate:
    """Estimate what the channels of a recording suffice for.

    Args:
        m: of :func:`estimators.apu.recordings.measured.read_recording`.
        engine: the unit as the filters know it, or its file or name; the paper's by default.
        only: ``"gaspath"`` or ``"electrical"``; both by default.
        sensors: of the gas path, or of all, or their file; default: :func:`gas_path_table` and
            whatever known sensor was measured besides.
        electrical_sensors: those of the generators, where ``sensors`` are the gas path's alone.
        ambient: altitude, Mach, dT_isa, war; they go before columns, and these before the default
            day.
        prior: means and standard deviations of states of the gas-path filter, of parameters of
            the generators and of a short circuit, or their file.
        efficiency_error: actual relative error of the generators' efficiency, where the shaft power
            comes from the waveforms.
        backend: see :func:`apu_casadi.core.backend.compiled`.

    Raises:
        ParameterError: unknown ``only`` or ambient condition.
        DataError: nothing can be estimated; a rate below twice the frequency, a gap in the fuel
            flow, an ambient condition out of range.
    """
    if only is not None and only not in PARTS:
        raise ParameterError(f"only {only!r} {nearest(only, PARTS)}")
    apu, start = _known(engine, prior)
    how = {"unknowns": start.unknowns(), "prior": start.severity(), "backend": backend}
    how |= {"efficiency_error": efficiency_error}
    ready = as_declared(m, *tables(m, sensors, electrical_sensors))
    m, table, electrical_sensors = ready.m, ready.gas_path, ready.electrical
    notes = [*m.notes, *ready.notes, *_unused(m)]
    still = channels_still(m, table, ready.coarse)
    m = without_still(m, still, table)
    doubts = list[str]([*ready.doubts, *(s.doubt for s in still)])
    causes: dict[str, tuple[Causes, ...]] = {}
    gas, lacking = _beforehand(m, table, only)
    begin = float(m.streams("Wf")["Wf"][0][0]) if gas else -math.inf
    sides: dict[int, ElectricalSide] = {}
    found: dict[str, Sequences] = {}
    for k in machines_in(m) if only != "gaspath" and m.electrical else ():
        own = electrical_sensors.machine(k)
        waves = Waves(m.machine(k), k, unit_of(apu, k), own, how)
        found |= waves.sequences(lacking)
        if (side := waves.side(begin, lacking, doubts, notes, causes)) is not None:
            sides[k] = side
    found_by = None
    fused_by = fusable(apu, sides, m.streams("Wf")["Wf"][0], notes) if gas else {}
    if gas:
        path = _GasPath(m, apu, table, ambient or {}, notes, doubts, backend, start)
        found_by, odd = _followed(path, fused_by, electrical_sensors, sides, lacking)
        causes[GAS] = (*still_causes(still), *odd)
    e = None if found_by is None else gas_dataset(*found_by)
    balanced = None if only == "electrical" else _balanced(m, apu, table, start, doubts, causes)
    compared, alike = compared_sides(sides)[1:]
    doubts += alike
    if e is None and balanced is None and not sides and not found:
        raise DataError("\n".join([f"nothing can be estimated: {_why(lacking)}", *notes, *doubts]))
    if apu.alike and 0 < len(sides) < len(apu.machines):
        notes.append(_some_of(tuple(sides), len(apu.machines)))
    texts = tuple(dict.fromkeys(notes)), tuple(dict.fromkeys(doubts))
    told_of = [k for k in machines_in(m) if k in sides or is_lost(texts[1], k)]
    belief = believed(texts[1], gas=gas, machines=told_of, power_of=[*fused_by])
    end: Any = found_by and found_by[1].result, found_by, sides, causes, compared, belief, balanced
    machines = {k: side_dataset(s) for k, s in sides.items()}
    return RecordedEstimate(e, machines, found, bool(fused_by), lacking, *texts, *end)


def _followed(
    path: _GasPath,
    fused_by: Mapping[int, ElectricalSide],
    electrical_sensors: SensorSet,
    sides: Mapping[int, ElectricalSide],
    lacking: dict[str, str],
) -> tuple[tuple[GasPathFilter, Tracked] | None, tuple[Causes, ...]]:
    """Return the gas path's estimate, what creeps in its band, and the causes of its changes.

    What is doubtful is appended to the path's doubts, why there is none to ``lacking``.
    """
    try:
        filt, tracked = path.run(fused_by, electrical_sensors)
    except EstimationError as error:
        lacking[GAS] = f"{error}"
        path.doubts.append(lost(error).of(GAS))
        return None, ()
    drifts = creep(filt, tracked, step=ROBUST, backend=path.backend)
    causes, odd = _causes_of(filt, tracked)
    doubts = [*gas_doubts(filt, tracked, [*sides.values()], drifts), *odd]
    path.doubts.extend(about(doubts, GAS))
    if drifts is not None:
        wide = drifts.widened(tracked.result, drifts=not fused_by)
        tracked = dataclasses.replace(tracked, result=wide)
    if int(tracked.result.measured.sum()) < FEWEST * len(filt.model.y):
        path.notes.append("so few readings hardly show whether the model holds")
    return (filt, tracked), causes


def _causes_of(filt: GasPathFilter, tracked: Tracked) -> tuple[tuple[Causes, ...], list[Doubt]]:
    """Return what the changes are, and what that makes doubtful; of data too odd for it, that."""
    try:
        return told(gas_causes(filt, tracked))
    except EstimationError as error:
        return (), [Doubt("innovations", f"no cause of the changes fits these data: {error}", GAS)]


def _balanced(
    m: Measurements,
    apu: Apu,
    table: SensorSet,
    start: Prior,
    doubts: list[str],
    causes: dict[str, tuple[Causes, ...]],
) -> xr.Dataset | None:
    """Compare shaft power and electrical output, where both were measured."""
    if not ("PW" in m and OUTPUT in m and "PW" in table):
        return None
    power, output = m.streams("PW")["PW"], m.streams(OUTPUT)[OUTPUT]
    if min(power[0].size, output[0].size) < FEWEST:
        return None
    of = balance(apu, table["PW"], power, output, start.unknowns())
    tracked = of.tracked()
    causes[GENERATORS], odd = told(of.causes(tracked))
    doubts += about([*of.doubts(tracked), *odd], GAS)
    return of.dataset(tracked)


def _beforehand(m: Measurements, table: SensorSet, only: str | None) -> tuple[bool, dict[str, str]]:
    """Say whether there is a gas-path estimate, and what is lacking for what was asked for."""
    if only == "electrical":
        return False, {} if m.electrical else {"generators": "nothing of them was measured"}
    reason = _no_gas_path(m, table)
    return reason is None, {"gas path": reason} if reason and (m.gaspath or only) else {}


def _unused(m: Measurements) -> list[str]:
    """Tell of columns that no quantity of the model is."""
    if not m.unused:
        return []
    more = f" and {len(m.unused) - MOST_TOLD} more" if len(m.unused) > MOST_TOLD else ""
    return [
        f"columns of no quantity of the model, not used: {', '.join(m.unused[:MOST_TOLD])}{more}"
    ]


def _why(lacking: Mapping[str, str]) -> str:
    """Say why each part is not estimated."""
    return "; ".join(f"{n}: {w}" for n, w in lacking.items()) or "nothing was measured"


def _some_of(numbers: tuple[int, ...], n: int) -> str:
    """Say which of n equal machines are estimated, and what is taken for the others."""
    some, rest = (
        who(ks).replace("generator", "machine")
        for ks in (numbers, [k for k in range(1, n + 1) if k not in numbers])
    )
    return (
        f"only {some} {'is' if len(numbers) == 1 else 'are'} estimated, not {rest}; power is "
        f"that of {n} equal ones"
    )


def gas_path_data(
    m: Measurements,
    engine: Apu | str | Path | None = None,
    *,
    sensors: SensorSet | SensorFile | str | Path | None = None,
    ambient: Mapping[str, float] | None = None,
    prior: Prior | str | Path | None = None,
) -> tuple[GasPathFilter, Recording, Belief, tuple[str, ...]]:
    """Return the gas-path filter that a recording suffices for, its data, its prior, and notes.

    Args:
        m, engine, sensors, ambient, prior: as of :func:`estimate`.

    Raises:
        ParameterError, DataError: as of :func:`estimate`; the recording has no gas path.
    """
    apu, start = _known(engine, prior)
    ready = as_declared(m, *tables(m, sensors, ELECTRICAL))
    if reason := _no_gas_path(ready.m, ready.gas_path):
        raise DataError(f"no gas path: {reason}")
    notes = [*m.notes, *ready.notes, *ready.doubts]
    given = ambient or {}, notes, notes, None, start
    path = _GasPath(ready.m, apu, ready.gas_path, *given)
    filt, data, begin = path.alone()
    return filt, data, begin, tuple(dict.fromkeys(notes))


def electrical_data(
    m: Measurements,
    engine: Apu | str | Path | None = None,
    *,
    machine: int | None = None,
    sensors: SensorSet | SensorFile | str | Path | None = None,
) -> tuple[ElectricalFilter, Recording, Belief, tuple[str, ...]]:
    """Return one generator's filter for a recording, its data, its prior, and notes.

    Args:
        m, engine, sensors: as of :func:`estimate`.
        machine: number of the generator; None: the first that was measured.

    Raises:
        DataError: as of :func:`estimate`; the recording has not what the filter needs.
    """
    apu, _ = _known(engine, None)
    ready = as_declared(m, *tables(m, sensors, ELECTRICAL))
    there = machines_in(ready.m)
    k = there[0] if machine is None else machine
    if k not in there:
        raise DataError(f"generator {k} was not measured, but {', '.join(map(str, there))}")
    notes = [*m.notes, *ready.notes, *ready.doubts, f"generator {k}"]
    waves = Waves(ready.m.machine(k), k, unit_of(apu, k), ready.electrical.machine(k), {})
    return *waves.filtered(notes), tuple(dict.fromkeys(notes))


def _known(engine: Apu | str | Path | None, prior: Prior | str | Path | None) -> tuple[Apu, Prior]:
    """Return the unit and the prior, from their files where they are named."""
    apu = engine if isinstance(engine, Apu) else Apu() if engine is None else read_unit(engine).unit
    start = read_prior(prior) if isinstance(prior, str | Path) else prior or Prior()
    values = start.values()
    return apu.change(values) if values else apu, start


def _no_gas_path(m: Measurements, table: SensorSet) -> str | None:
    """Say why there is no gas-path estimate; None if there is one."""
    if "Wf" not in m or not np.isfinite(m["Wf"].values).any():
        return "the filter takes the fuel flow Wf as an input, which was not measured"
    if "Wf" not in table:
        return "the filter takes the fuel flow Wf as an input, which the file of sensors lacks"
    if not [n for n in table.outputs if n in m and n != "N"]:
        return f"none of {', '.join(n for n in table.outputs if n != 'N')} was measured"
    return None


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
    prior: Prior

    def run(
        self, of: Mapping[int, ElectricalSide], electrical: SensorSet
    ) -> tuple[GasPathFilter, Tracked]:
        """Filter, with the power of the electrical side where there is one."""
        sides = list(of.values())
        power = bool(sides) or self._power_measured
        sensors, inputs = self._there(), self._inputs()
        span = (sides[0].t[0], sides[0].t[-1]) if sides else (-math.inf, math.inf)
        readings = self._readings(sensors, inputs, span, known_power=power and not sides)
        if sides:
            first = next(iter(of))
            electrical = electrical.machine(first)
            own = self.m.machine(first).streams("w_r")["w_r"]
            inside = (own[0] >= span[0] - 1e-9) & (own[0] <= span[1] + 1e-9)
            # as the first machine's would be
            ratio = self.apu.w_r(1.0) / unit_of(self.apu, first).w_r(1.0)
            w_r = ratio * own[1][inside]
            sigma = electrical.sigma("w_r", float(np.median(w_r)))
            if "PW" in sensors:  # of which the sensor is not used
                plain = dataclasses.replace(sensors["PW"], tau=0.0)
                sensors = SensorSet(tuple(plain if s.name == "PW" else s for s in sensors.sensors))
            return fused(
                self.apu,
                sides,
                readings,
                sensors,
                speed=Pickup(own[0][inside], w_r, sigma),
                prior=self._start(readings, sensors) | dict(self.prior.of_gas_path().mean),
                spread=self.prior.of_gas_path(),
                unknowns=self.prior.unknowns(),
                inputs=inputs,
                step=ROBUST,
                test=JUMPS,
                backend=self.backend,
                max_dt=STEP,
            )
        filt, data, start = self._ready(sensors, readings, inputs, power)
        how: dict[str, Any] = {"step": ROBUST, "test": JUMPS, "backend": self.backend}
        return filt, track_jumps(filt, data, prior=start, **how)

    def alone(self) -> tuple[GasPathFilter, Recording, Belief]:
        """Return the filter without an electrical side, its recording, and its prior."""
        sensors, power, inputs = self._there(), self._power_measured, self._inputs()
        span = (-math.inf, math.inf)
        readings = self._readings(sensors, inputs, span, known_power=power)
        return self._ready(sensors, readings, inputs, power)

    @property
    def _power_measured(self) -> bool:
        return "PW" in self.m and "PW" in self.table

    def _there(self) -> SensorSet:
        """The sensors that were measured; speed and the measured inputs stay in the table."""
        absent = [n for n in self.table.outputs if n not in self.m and n != "N"]
        return self.table.only([n for n in self.table.names if n not in absent])

    def _ready(
        self, sensors: SensorSet, readings: Streams, inputs: Mapping[str, Any], power: bool
    ) -> tuple[GasPathFilter, Recording, Belief]:
        if not power:
            self.notes.append("no shaft power was measured: it is a random walk")
        unknowns, known = self.prior.unknowns(), self.prior.of_gas_path()
        filt = gas_path_filter(
            self.apu.gas_generator,
            sensors,
            power="measured" if power else "unknown",
            inertia=unknowns["J"].sigma or None,
            consider_inertia=unknowns["J"].how == "considered",
            eta=unknowns[EFFICIENCY].sigma or None if power else None,
            consider_eta=False,
        )
        data = filt.of_readings(readings, inputs=inputs, max_dt=STEP)
        self.prior.check(filt.model.x, generators=bool(self.m.electrical))
        means = self._start(readings, sensors) | dict(known.mean)
        return filt, data, filt.prior(known.sigma, **means)

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
        inputs: dict[str, Any],
        span: tuple[float, float],
        *,
        known_power: bool,
    ) -> Streams:
        """Readings from the instant that has all inputs to the last one.

        Where an input is not known, ``inputs`` is told its standard deviation.
        """
        streams = self.m.streams(*(n for n in sensors.names if n in self.m))
        for n in [n for n, (t, _) in streams.items() if not t.size]:
            del streams[n]
        self._note_unused(sensors, streams)
        inputs_of = ["Wf", "PW"] if known_power else ["Wf"]
        for n in inputs_of:
            if n not in streams:
                raise DataError(f"{n} has no reading")
        held = [n for n in inputs_of if not sensors[n].tau]
        for n in held:
            self._check_rate(n, streams[n][0])
        gaps = {n: g for n in held if (g := input_gaps(streams[n][0]))}
        stamps = [v[0] for v in inputs.values() if isinstance(v, tuple)]
        firsts = [*(streams[n][0][0] for n in held), *(t[0] for t in stamps)]
        begin = max([span[0], *firsts])
        lasts = (streams[n][0] for n in held)
        end = min([span[1], *(t[-1] + float(np.median(np.diff(t))) for t in lasts)])
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
        out, unsure = bridged(gaps, out, sensors, self.notes)
        inputs |= unsure
        if not [n for n in out if n in sensors.outputs]:
            raise DataError(f"no output was measured between {begin:g} and {end:g} s")
        return out

    def _note_unused(self, sensors: SensorSet, streams: Streams) -> None:
        """Tell of sensors without a reading, and of quantities that no sensor reads."""
        empty = [n for n in sensors.names if n in self.m and n not in streams]
        if empty:
            self.notes.append(f"{', '.join(empty)}: no reading in the whole recording")
        known = {OUTPUT, "P0", *CONDITIONS, *self.table.names}
        left = [n for n in self.m.gaspath if n not in known]
        if left:
            self.notes.append(f"no sensor of the filter reads {', '.join(left)}: not used")

    def _check_rate(self, name: str, t: np.ndarray) -> None:
        """Refuse one reading of an input, and doubt what comes of slow ones."""
        if t.size < 2:
            raise DataError(f"{name}: one reading is no recording; apu fit takes steady points")
        usual = float(np.median(np.diff(t)))
        if usual > SLOW:
            text = f"{name} is known every {usual:g} s only: what happens in between is taken for"
            self.doubts.append(Doubt("time", f"{text} a change of health", GAS))

    def _start(self, readings: Streams, sensors: SensorSet) -> dict[str, float]:
        """Means of the start from the first readings, where the usual ones are far off."""
        slow = [s for s in sensors.sensors if s.tau and s.name in readings]
        out = {n: float(readings[s.name][1][0]) for s in slow for n in {s.name, lag_of(s)}}
        if "N" in readings:
            t, v = readings["N"]
            N, governed = float(v[t < t[0] + 0.2].mean()), self.apu.gas_generator.parameters.N
            if abs(N - governed) > 2 * N_SIGMA:
                out["N"] = N
                self.notes.append(f"the start is at {N:.1f} rad/s, not at the governed speed")
        return out
