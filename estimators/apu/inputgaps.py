"""Gaps of the measured inputs of the gas-path filter: fuel flow and shaft power.

A filter cannot go on without its inputs, but it can be told how little is known of them: in a gap
an input goes from its last reading to its next one, with an error of ``UNKNOWN`` that may stand all
the time.  As white noise of n steps that is sqrt(n) times as much.  No output is used there, and
after it the speed is found again from its own reading.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from estimators.apu.gaspathmodel import DT
from estimators.apu.sensorchain import spread
from estimators.apu.sensors import SensorSet

__all__ = ["bridged", "input_gaps"]

GAP = 5.0  # steps of a measured input, from which nobody knows what it was meanwhile
LONG = 0.2  # s, a step that is no gap
UNKNOWN = 0.1  # of the input, that it may be off in a gap
MOST = 3  # gaps that are told of

Gaps = Sequence[tuple[float, float]]
Streams = dict[str, tuple[np.ndarray, np.ndarray]]


def input_gaps(t: np.ndarray) -> list[tuple[float, float]]:
    """Return the gaps of an input with readings at t, s, (K,): last instant before, first after."""
    step = np.diff(t)
    long = np.flatnonzero(step > max(GAP * float(np.median(step)), LONG))
    return [(float(t[k]), float(t[k + 1])) for k in long]


def bridged(
    gaps: Mapping[str, Gaps], readings: Streams, sensors: SensorSet, notes: list[str]
) -> tuple[Streams, Streams]:
    """Return readings that go over the gaps of inputs.

    Args:
        gaps: by input, some of each.
        readings: instants and values by sensor, those of the inputs among them.
        sensors: of them.
        notes: are told.

    Returns:
        The readings, inputs at more instants and outputs without those in a gap; and the standard
        deviations of the inputs with gaps, ``sigma_Wf``, at their instants.
    """
    out, unsure = dict(readings), Streams()
    spans = sorted({gap for of in gaps.values() for gap in of})
    for n in (n for n in out if spans and n in sensors.outputs):
        t, v = out[n]
        used = ~_within(t, spans)
        out[n] = t[used], v[used]
    for n, of in gaps.items():
        t, v = out[n]
        every = np.sort(np.concatenate([t, *(np.arange(a + DT, b - DT / 2, DT) for a, b in of)]))
        values = np.interp(every, t, v)
        sigma = np.array(spread(sensors[n], every, values))
        for a, b in of:
            wide = _within(every, [(a, b)])
            scale = np.abs(np.interp([a, b], t, v)).max() * math.sqrt(wide.sum())
            sigma[wide] = UNKNOWN * scale
        out[n], unsure[f"sigma_{n}"] = (every, values), (every, sigma)
    for a, b in spans[:MOST]:
        names = ", ".join(n for n, of in gaps.items() if (a, b) in of)
        notes.append(
            f"{names}: no reading from {a:.9g} to {b:.9g} s: no output is used there, the speed is "
            "found again after it, and a change within it is reported at its end"
        )
    if len(spans) > MOST:
        notes.append(f"{len(spans) - MOST} more such gaps")
    return out, unsure


def _within(t: np.ndarray, spans: Gaps) -> np.ndarray:
    return np.asarray(np.any([(t > a + 1e-9) & (t < b - 1e-9) for a, b in spans], axis=0))
