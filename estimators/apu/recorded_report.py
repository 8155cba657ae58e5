"""What an estimate from a recording says: over time, in numbers and in words."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.results import dataset
from apu_casadi.core.signals import Signal
from apu_casadi.gaspath.health import HEALTH, HEALTH_FACTORS
from apu_casadi.machine.park import PHASES
from estimators.apu.electrical.sequences import Sequences
from estimators.apu.gaspath import HEALTH_SIGMA, GasPathFilter
from estimators.apu.healthjumps import JumpTest, Tracked
from estimators.apu.joint import ElectricalSide
from estimators.apu.trust import GAS, in_words

if TYPE_CHECKING:
    import xarray as xr

__all__ = [
    "SURE",
    "Z95",
    "balance_report",
    "compared_words",
    "gas_dataset",
    "gas_report",
    "machine_report",
    "sequence_report",
    "side_dataset",
    "words",
]

Z95 = 1.96
SURE = 3.0  # sigmas from which a factor is said to have changed
TOLD = 0.7  # share of the prior's sigma above which the data say little of a factor


def gas_dataset(filt: GasPathFilter, tracked: Tracked) -> xr.Dataset:
    """Return speed and health with their sigmas over time; alarms and onsets as attributes."""
    r = tracked.result
    names = [
        n for n in ("N", *HEALTH, "PW", *(f"gain_{g}" for g in filt.gains)) if n in filt.model.x
    ]
    values: dict[str, Any] = {"nis": r.nis}
    signals = [Signal("nis", "1", "normalised innovation squared")]
    for n in names:
        x = filt.model.x[n]
        values[n], values[f"{n}_sigma"] = r[n]
        signals += [Signal(n, x.unit, x.doc)]
        signals += [Signal(f"{n}_sigma", x.unit, f"standard deviation of {n}")]
    e = dataset({"time": r.t}, {"time": values}, signals=signals)
    e.attrs["alarms"] = json.dumps([float(r.t[k]) for k in tracked.alarms])
    e.attrs["onsets"] = json.dumps([float(r.t[k]) for k in tracked.onsets])
    return e


def side_dataset(side: ElectricalSide) -> xr.Dataset:
    """Return severities and power of a machine over time; resets as an attribute."""
    values: dict[str, Any] = {"faulty_phase": side.phase, "ttsc_probability": side.probability}
    signals = [
        Signal("faulty_phase", "1", "phase found faulty: 0 none, 1 to 3: a to c"),
        Signal("ttsc_probability", "1", "probability that the machine has a short circuit"),
    ]
    rows = {f"h_{p}": side.severities[:, i] for i, p in enumerate(PHASES)}
    power = side.P, np.sqrt(side.variance)
    rows["P_total"] = np.array([np.append(np.nan, v) for v in power])
    for n, pair in rows.items():
        unit = "W" if n == "P_total" else "1"
        doc = f"severity of a short circuit in phase {n[2:]}"
        doc = "mechanical power of two such machines, mean" if n == "P_total" else doc
        values[n], values[f"{n}_sigma"] = pair
        signals += [Signal(n, unit, doc), Signal(f"{n}_sigma", unit, f"standard deviation of {n}")]
    e = dataset({"time": side.t}, {"time": values}, signals=signals)
    e.attrs["resets"] = json.dumps([float(v) for v in side.resets])
    return e


def _last(e: xr.Dataset, name: str) -> dict[str, float]:
    x, s = (float(e[f"{name}{end}"].values[-1]) for end in ("", "_sigma"))
    return {"estimate": x, "half_width": Z95 * s}


def gas_report(e: xr.Dataset, *, joint: bool) -> dict[str, Any]:
    """Return estimates at the end, alarms and what is told, ready for JSON."""
    values = {str(n): _last(e, str(n)) for n in e.data_vars if f"{n}_sigma" in e}
    off = [
        n for n in HEALTH if abs(values[n]["estimate"] - 1) > SURE / Z95 * values[n]["half_width"]
    ]
    little = [n for n in HEALTH if values[n]["half_width"] > TOLD * Z95 * HEALTH_SIGMA]
    t = e["time"].values
    out: dict[str, Any] = {
        "joint": joint,
        "samples": int(t.size),
        "from": float(t[0]),
        "to": float(t[-1]),
    }
    out |= {"values": values, "changed": off, "hardly_told": little}
    out |= {"alarms": json.loads(e.attrs["alarms"]), "onsets": json.loads(e.attrs["onsets"])}
    return out | {"false_alarms_per_hour": JumpTest().rate}


def balance_report(e: xr.Dataset) -> dict[str, Any]:
    """Return loss and severity at the end, and what came about, ready for JSON."""
    t = e["time"].values
    out: dict[str, Any] = {"from": float(t[0]), "to": float(t[-1])}
    out["values"] = {n: _last(e, n) for n in ("loss", "h")}
    return out | {n: json.loads(e.attrs[n]) for n in ("alarms", "onsets")}


def machine_report(e: xr.Dataset) -> dict[str, Any]:
    """Return the same of a generator."""
    t, phase = e["time"].values, e["faulty_phase"].values.astype(int)
    rising = [k for k in range(1, t.size) if phase[k] and phase[k] != phase[k - 1]]
    alarms = [{"t": float(t[k]), "phase": PHASES[phase[k] - 1]} for k in rising]
    now = PHASES[phase[-1] - 1] if phase[-1] else None
    values = {n: _last(e, n) for n in (*(f"h_{p}" for p in PHASES), "P_total")}
    out = {"from": float(t[0]), "to": float(t[-1]), "values": values}
    return out | {"faulty_phase": now, "alarms": alarms, "resets": json.loads(e.attrs["resets"])}


def sequence_report(s: Sequences) -> dict[str, Any]:
    """Return the same of symmetrical components."""
    size = np.abs(s.unbalance)
    out: dict[str, Any] = {"windows": int(s.t.size), "frequency": float(np.median(s.frequency))}
    out |= {"positive": float(np.median(np.abs(s.components[0])))}
    out |= {"first": float(size[0]), "last": float(size[-1]), "sigma": float(np.median(s.sigma))}
    return out | {"reference_windows": s.reference, "alarms": list(s.alarms)}


def _at(t: float) -> str:
    """An instant in words, s: to a millisecond in the hours of a day, too."""
    return f"{t:.8g}"


def _span(part: Mapping[str, Any]) -> str:
    return f"{_at(part['from'])} to {_at(part['to'])} s"


def _likely(probability: Mapping[str, float]) -> str:
    likely = sorted(probability.items(), key=lambda x: -x[1])[:3]
    return ", ".join(f"{what} {100 * p:.0f} %" for what, p in likely if p > 0.005)


def compared_words(r: Mapping[str, Any] | None) -> Iterator[str]:
    """Yield what a comparison of the machines says."""
    r = r or {"machines": {}}
    until = f" until {_at(r['to'])} s" if "to" in r else ""
    for k, of in r["machines"].items():
        yield (
            f"compared with the others{until}, generator {k} has a short circuit with a "
            f"probability of {of['probability']:.3f}, likeliest in phase {of['likeliest_phase']}"
        )


def _balance_words(b: Mapping[str, Any] | None) -> Iterator[str]:
    """Yield what shaft power and electrical output say together."""
    if b is None:
        return
    (loss, dl), (h, dh) = (
        (b["values"][n]["estimate"], b["values"][n]["half_width"]) for n in ("loss", "h")
    )
    yield f"shaft power over electrical output, {_span(b)}; at the end, 95 %"
    yield f"  {'new loss [kW]':<22} {1e-3 * loss:.2f} +- {1e-3 * dl:.2f}"
    yield f"  {'as a severity [1e-3]':<22} {1e3 * h:.3f} +- {1e3 * dh:.3f}"
    for t, onset in zip(b["alarms"], b["onsets"], strict=True):
        yield f"  it changed after {_at(onset)} s, reported at {_at(t)} s"


def words(r: Mapping[str, Any]) -> Iterator[str]:
    """Yield a report's lines."""
    if "gaspath" in r:
        g = r["gaspath"]
        how = "gas path with the power of the waveforms" if g["joint"] else "gas path"
        yield f"{how}, {_span(g)}, {g['samples']} samples; at the end, 95 %"
        for n in HEALTH:
            v, f = g["values"][n], HEALTH_FACTORS[n]
            mark = "changed" if n in g["changed"] else ""
            mark = "these data hardly tell it" if n in g["hardly_told"] else mark
            text = f"  {f'{f.component} {f.quantity}':<22} {n:<8} {v['estimate']:.4f} +- "
            yield f"{text}{v['half_width']:.4f}  {mark}".rstrip()
        v = g["values"]["N"]
        yield f"  {'speed [rad/s]':<22} {'N':<8} {v['estimate']:.1f} +- {v['half_width']:.1f}"
        for t, onset in zip(g["alarms"], g["onsets"], strict=True):
            yield f"  change of health after {_at(onset)} s, reported at {_at(t)} s"
        if not g["alarms"]:
            yield "  no sudden change of health"
        yield f"  (at most {g['false_alarms_per_hour']:g} false report an hour if the model holds)"
    yield from _balance_words(r.get("balance"))
    for k, e in r["machines"].items():
        yield f"generator {k}, {_span(e)}; at the end, 95 %"
        for n, v in e["values"].items():
            scale, form = (1e-3, ".2f") if n == "P_total" else (1e3, ".3f")
            label = "power of both [kW]" if n == "P_total" else f"severity {n} [1e-3]"
            x, half = (f"{scale * v[key]:{form}}" for key in ("estimate", "half_width"))
            yield f"  {label:<22} {x} +- {half}"
        for a in e["alarms"]:
            yield f"  short circuit in phase {a['phase']}, reported at {_at(a['t'])} s"
        if not e["alarms"]:
            yield "  no short circuit reported; one within the bands above may be there"
    yield from compared_words(r.get("compared"))
    for n, s in r["sequences"].items():
        yield (
            f"{n}: {s['frequency']:.2f} Hz, positive sequence {s['positive']:.4g}, negative over "
            f"positive {100 * s['first']:.3f} % at first, {100 * s['last']:.3f} % at last (+- "
            f"{100 * Z95 * s['sigma']:.3f})"
        )
        for t in s["alarms"]:
            yield f"  it changed before {t:.2f} s; a load, a fault or a sensor does that"
        if not s["alarms"]:
            few = f"{s['windows']} windows are too few to look for a change"
            yield "  no change of it" if s["reference_windows"] else f"  {few}"
    for n, told in r["causes"].items():
        for c in told:
            yield f"{n}: the change at {_at(c['t'])} s is: {_likely(c['probability'])}"
    for d in r["changes"]:
        how = "of it" if GAS in [*d["probability"]][:1] else "it failed by"
        yield f"at {_at(d['t'])} s: {_likely(d['probability'])}" + (
            f"; {how} {_likely(d['failure'])}" if d["failure"] else ""
        )
    yield from (f"not estimated: {n}: {why}" for n, why in r["lacking"].items())
    yield from (f"read: {n}" for n in r["notes"])
    yield from (f"doubt: {d}" for d in r["doubts"])
    if not r["believable"]:
        yield f"NOT TO BE BELIEVED as it stands, for the doubts above{in_words(r['belief'])}"
