"""What the waveforms of one generator suffice for: components, severities, a filter of its own."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError, EstimationError
from apu_casadi.machine.machinedata import MachineParameters
from apu_casadi.unit.apu import Apu
from estimators.apu.believable import lost, machine_causes, machine_doubts
from estimators.apu.declared import FILLED
from estimators.apu.electrical.causes import Causes, causes_of_change
from estimators.apu.electrical.electricalfilter import (
    ElectricalFilter,
    electrical_filter,
    window_starts,
)
from estimators.apu.electrical.electricalside import with_field
from estimators.apu.electrical.gaps import evened, usable
from estimators.apu.electrical.sequences import Sequences, sequences
from estimators.apu.electrical.terminalsignals import (
    GAIN_SENSORS,
    MEASURED,
    PHASES_I,
    PHASES_V,
    VOLTAGES,
)
from estimators.apu.electrical.tracking import LostError
from estimators.apu.electrical.wild import wild_samples
from estimators.apu.electrical.wiring import miswired
from estimators.apu.gaspathmodel import DT
from estimators.apu.joint import ElectricalSide, electrical_side
from estimators.apu.recordings.measured import Measurements
from estimators.apu.sensorchain import onto
from estimators.apu.sensors import SensorSet
from estimators.apu.trust import Doubt, machine
from estimators.filters.belief import Belief
from estimators.models.recording import Recording

__all__ = ["Waves", "machines_in", "told"]

NEEDED = ("w_r", *VOLTAGES, *MEASURED)
PER_PERIOD = 8  # samples of a period that the electrical filter needs


def told(
    found: Iterable[tuple[Causes, Doubt | None]],
) -> tuple[tuple[Causes, ...], list[Doubt]]:
    """Part causes from the doubts that they raise."""
    both = list(found)
    return tuple(c for c, _ in both), [d for _, d in both if d is not None]


def machines_in(m: Measurements) -> list[int]:
    """Numbers of the machines that were measured; 1 where the names have none."""
    ends = {n.rpartition("_")[2] for n in m.electrical} & set("1234")
    return sorted(map(int, ends)) or [1]


@dataclass(frozen=True, eq=False)
class Waves:
    """One machine's waveforms and what they suffice for."""

    m: Measurements
    number: int
    apu: Apu
    sensors: SensorSet
    how: Mapping[str, Any]  # the electrical side's unknowns, prior, backend

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
        self,
        begin: float,
        lacking: dict[str, str],
        doubts: list[str],
        notes: list[str],
        causes: dict[str, tuple[Causes, ...]],
    ) -> ElectricalSide | None:
        """Run the electrical filter from an instant on; None where it cannot."""
        name = machine(self.number)
        what = f"severity, {name}"
        try:
            a = self.samples(notes, begin)
            even = evened(a)["t"]
            t = even[window_starts(even, DT, None)]
            side = electrical_side(self.apu, self.sensors, a, t, judged=True, **self.how)
        except LostError as e:
            given = self._machine(a, begin), self.sensors, a, e.resets[0]
            first = causes_of_change(*given)
            causes[name] = () if first is None else (first,)
            lacking[what] = str(e)
            doubts.append(lost(e, first).of(name))
            return None
        except EstimationError as e:
            lacking[what] = str(e)
            doubts.append(lost(e).of(name))
            return None
        except DataError as e:
            lacking[what] = str(e)
            return None
        causes[name], odd = told(machine_causes(side, self._machine(a, begin), self.sensors, a))
        how = side, self.apu.generator.machine, self.sensors, a, causes[name]
        doubts += (d.of(name) for d in (*machine_doubts(*how), *odd))
        return side

    def _machine(self, samples: Mapping[str, np.ndarray], begin: float) -> MachineParameters:
        """Return the machine with the field resistance that it shows before any change.

        Where both windings are hot, a short circuit would be taken for one of the field otherwise,
        whose hypothesis alone has its resistance free.
        """
        known = self.apu.generator.machine
        if self.how["unknowns"]["machine.r_fd"].how == "known":
            return known
        return with_field(known, samples, max(begin, float(samples["t"][0])))

    def samples(self, notes: list[str], begin: float = -math.inf) -> dict[str, np.ndarray]:
        """Return what the electrical filter takes, single wild samples left out.

        Raises:
            DataError: a channel or a window is missing, or the rate is too low.
        """
        if no := [n for n in NEEDED if n not in self.m or n not in self.sensors]:
            raise DataError(f"the electrical filter needs {', '.join(no)} too")
        rate, f = self.m["v_a"].rate, self.apu.generator.machine.f_rated
        if rate < PER_PERIOD * f * (1 - 1e-6):
            raise DataError(
                f"{rate:g} samples a second; the electrical filter needs {PER_PERIOD * f:g}, "
                f"{PER_PERIOD} a period"
            )
        waves = self._together(notes)
        w = self.m.streams("w_r")["w_r"]
        if waves["t"] is not self.m["w_r"].t:
            inside = (waves["t"] >= w[0][0]) & (waves["t"] <= w[0][-1])
            waves["w_r"] = np.where(inside, np.interp(waves["t"], *w), np.nan)
        else:
            waves |= self.m.samples("w_r")
        a = usable({n: waves[n] for n in ("t", *NEEDED)}, ("w_r", *VOLTAGES))
        a = {n: v[a["t"] >= begin - 1e-9] for n, v in a.items()}
        if a["t"].size < 2 or a["t"][-1] - a["t"][0] < DT:
            raise DataError(f"the waveforms hold no window of {DT * 1e3:g} ms")
        if why := miswired(a, self.apu.generator.machine):
            raise DataError(why)
        return self._tame(a, notes)

    def _together(self, notes: list[str]) -> dict[str, np.ndarray]:
        """Return the waveforms at common instants.

        Where the voltages were sampled at others than the currents, the instants are those of the
        currents and the rest is interpolated, to 1e-4 from a dozen samples a period on.
        """
        names = NEEDED[1:]
        t, f = self.m["i_a"].t, self.apu.generator.machine.f_rated
        waves = self.m.samples(*names)
        lost = max(1 - np.isin(waves["t"], self.m[n].t).mean() for n in VOLTAGES)
        apart = [n for n in names if not np.array_equal(self.m[n].t, t)]
        if not apart or lost < FILLED or self.m["i_a"].rate < PER_PERIOD * f * (1 - 1e-6):
            return waves
        notes.append(
            f"machine {self.number}: {', '.join(apart)} were sampled at other instants than i_a, "
            "and are interpolated to those"
        )
        moved = {n: onto(t, self.m[n].t, self.m[n].values, 2 * math.pi * f) for n in apart}
        return {"t": t} | {n: moved[n] if n in moved else self.m[n].values for n in names}

    def filtered(self, notes: list[str]) -> tuple[ElectricalFilter, Recording, Belief]:
        """Return a filter with the three severities, its recording and prior.

        Gain errors that the sensors declare are states.

        Raises:
            DataError: as :meth:`samples`.
        """
        a = self.samples(notes)
        unsure = any(self.sensors[n].unsure("gain") for n in GAIN_SENSORS)
        gains = "estimate" if unsure else "none"
        filt = electrical_filter(self.apu.generator.machine, sensors=self.sensors, gains=gains)
        return filt, filt.recording(a), filt.prior(a)

    def _tame(self, a: dict[str, np.ndarray], notes: list[str]) -> dict[str, np.ndarray]:
        """Take single wild samples of the waveforms for missing."""
        names = (*PHASES_V, *PHASES_I)
        sigma = {n: self.sensors.sigma(n, 0.0) for n in names}
        w = float(np.nanmedian(a["w_r"]))
        wild = wild_samples(a["t"], {n: a[n] for n in names}, w, sigma)
        told = ", ".join(f"{int(v.sum())} of {n}" for n, v in wild.items() if v.any())
        if told:
            notes.append(f"machine {self.number}: single wild samples are taken for gaps: {told}")
        return a | {n: np.where(v, np.nan, a[n]) for n, v in wild.items() if v.any()}
