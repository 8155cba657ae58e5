"""Summaries of joint runs, phase by phase."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import DataError
from apu_casadi.core.results import GENERATOR, generators_of, of_generator, source_of
from apu_casadi.core.units import RPM
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.park import PHASES

if TYPE_CHECKING:
    import xarray as xr

SUMMARY_WINDOW = 0.5
"""Length [s] of the window at the end of a phase over which :func:`phase_summary` averages."""


def phases(ds: xr.Dataset) -> list[dict[str, Any]]:
    """Return the phases of a run as dictionaries with name, start [s] and end [s].

    Without a ``phases`` attribute the whole run is one phase.

    Raises:
        DataError: no ``time`` coordinate, or an attribute that holds something else.
    """
    if "time" not in ds.coords or ds.sizes.get("time", 0) < 2:
        raise DataError(
            f"{source_of(ds)}the dataset lacks a 'time' coordinate of at least two samples"
        )
    t = ds["time"].values
    if (
        t.ndim != 1
        or t.dtype.kind not in "fiu"
        or not (np.isfinite(t).all() and np.all(t[1:] > t[:-1]))
    ):
        raise DataError(f"{source_of(ds)}'time' does not increase from sample to sample")
    text = ds.attrs.get("phases")
    if text is None:
        return [{"name": "run", "start": float(t[0]), "end": float(t[-1])}]
    try:
        rows = json.loads(text)
        rows = [
            {"name": str(r["name"]), "start": float(r["start"]), "end": float(r["end"])}
            for r in rows
        ]
    except (TypeError, ValueError, KeyError) as e:
        raise DataError(
            f"{source_of(ds)}attribute 'phases' is not a list of name, start and end: {e!r}"
        ) from e
    if not rows:
        raise DataError(f"{source_of(ds)}attribute 'phases' is an empty list")
    for r in rows:
        if not r["end"] > r["start"]:
            raise DataError(
                f"{source_of(ds)}phase {r['name']!r} ends at {r['end']:g} s, before it starts"
            )
    return rows


def severity_h(mu: np.ndarray, k_rf: np.ndarray) -> np.ndarray:
    """Return h = mu/(k_rf + 1 - mu) of arrays; 0 without a fault, where k_rf is NaN."""
    return np.where(mu > 0, mu / (np.nan_to_num(k_rf) + 1.0 - mu), 0.0)


def severity(mu: float, k_rf: float, kappa: float) -> dict[str, float | None]:
    """Return mu, k_rf, kappa and h = mu/(k_rf + 1 - mu) together; None where there is no fault."""
    if not mu > 0:
        return {"mu": 0.0, "k_rf": None, "kappa": None, "h": 0.0}
    return {"mu": mu, "k_rf": k_rf, "kappa": kappa, "h": mu / (k_rf + 1.0 - mu)}


_MEANS = (
    ("N_rpm", "N", RPM),
    ("PW_kW", "PW", 1e-3),
    ("Wf", "Wf", 1.0),
    ("SFC", "SFC", 1.0),
    ("T3", "T3", 1.0),
    ("P3_kPa", "P3", 1e-3),
    ("T4", "T4", 1.0),
    ("T5", "T5", 1.0),
    ("SM_percent", "SM", 100.0),
)
_MEANS_OF_EACH = (*(f"{q}_{p}_rms" for q in "VI" for p in PHASES), "P_e", "P_loss_fault")
_SEVERITY = tuple(s.name for s in Ttsc.severities)
_HEALTHY_NAN = tuple(s.name for s in Ttsc.severities if s.default != 0.0)


class _Columns:
    """Values of a dataset by name; those in a file are read anew each time, not all are held."""

    def __init__(self, ds: xr.Dataset) -> None:
        self.ds = ds

    def __getitem__(self, name: str) -> np.ndarray:
        v = self.ds.variables[name]  # without its coordinates, which cost ten times as much
        if v.dims != ("time",) or v.dtype.kind not in "fiu":
            where = ", ".join(map(str, v.dims)) or "no dimension"
            raise DataError(
                f"{source_of(self.ds)}{name}: numbers on time are expected, "
                f"{v.dtype} on {where} found"
            )
        values: np.ndarray = v.values
        if name not in _HEALTHY_NAN and not np.isfinite(values).all():
            k = int(np.flatnonzero(~np.isfinite(values))[0])
            raise DataError(
                f"{source_of(self.ds)}{name} = {values[k]:g} at t = "
                f"{self.ds['time'].values[k]:g} s is no finite number"
            )
        return values


def _holding(ds: xr.Dataset, attribute: str, key: str, end: float, number: int) -> str | None:
    """Return what the run's attribute says of a generator just before ``end`` [s]."""
    try:
        rows = [r for r in json.loads(ds.attrs[attribute]) if r.get(GENERATOR, number) == number]
        held = [r for r in rows if float(r["t"]) < end - 1e-9]
        return None if held[-1][key] is None else str(held[-1][key])
    except (KeyError, TypeError, ValueError, IndexError):
        return None


def phase_summary(ds: xr.Dataset) -> list[dict[str, Any]]:
    """Summarise a joint run phase by phase.

    Each row holds name, start, end [s] and window [s]; the means over the last 0.5 s of the phase
    (over all of a shorter one) of N_rpm, PW_kW, Wf [kg/s], SFC [kg/(W s)], T3, T4, T5 [K], P3_kPa,
    SM_percent, V_a_rms ... [V], I_a_rms ... [A], and P_e and P_loss_fault [W] of one generator,
    and V_2_over_V_1 and I_2_over_I_1 where the dataset has them; the
    extremes over the phase N_rpm_min, N_rpm_max, T4_max [K], SM_percent_min; the health factors at
    its end; and the severity of the stator fault at its end, always as mu, k_rf, kappa together
    (and h, which follows from them; k_rf and kappa are None when healthy), with ``fault_phase``;
    the same of the ``worst`` fault in it, None without one;
    and the ``load`` at its end in words.  The last two are None where the dataset does not tell.
    Where generators differ, all that is of a generator is in ``generators`` instead: a list with
    one table for each, which has its number as ``generator``.

    Raises:
        DataError: a variable is missing, is not finite or no number, or a phase holds no sample.
    """
    needed = [v for _, v, _ in _MEANS] + [*_MEANS_OF_EACH, *_SEVERITY, *HEALTH]
    missing = [v for v in needed if v not in ds]
    if missing:
        raise DataError(f"{source_of(ds)}the dataset lacks {', '.join(missing)}")
    spans = phases(ds)
    t = ds["time"].values
    tol = 1e-9
    col, numbers = _Columns(ds), generators_of(ds)
    each = {k: _Columns(of_generator(ds, k)) for k in numbers}
    rows = []
    for k, p in enumerate(spans):
        # a sample is the end of a step: the one at a boundary belongs to the earlier phase
        before_end = t <= p["end"] + tol
        whole = ((t > p["start"] + tol) | ((k == 0) & (t >= p["start"] - tol))) & before_end
        window = min(SUMMARY_WINDOW, p["end"] - p["start"])
        tail = (t > p["end"] - window + tol) & before_end
        if not tail.any():
            raise DataError(
                f"{source_of(ds)}phase {p['name']!r} [{p['start']:g}, {p['end']:g}] s holds no "
                f"sample; time runs from {t[0]:g} to {t[-1]:g} s"
            )
        row: dict[str, Any] = {**p, "window": window}
        for key, v, scale in _MEANS:
            row[key] = float(np.mean(col[v][tail]) * scale)
        inside = {v: col[v][whole] for v in ("N", "T4", "SM")}
        row["N_rpm_min"] = float(inside["N"].min() * RPM)
        row["N_rpm_max"] = float(inside["N"].max() * RPM)
        row["T4_max"] = float(inside["T4"].max())
        row["SM_percent_min"] = float(inside["SM"].min() * 100.0)
        end = int(np.flatnonzero(tail)[-1])
        row.update({v: float(col[v][end]) for v in HEALTH})
        of_each = [
            _of_one(each[k], tail, end)
            | _held(ds, each[k], end, p["end"], k)
            | _worst(ds, each[k], whole, p["end"], k)
            for k in numbers
        ]
        if GENERATOR in ds.coords:
            row["generators"] = [
                {GENERATOR: k, **own} for k, own in zip(numbers, of_each, strict=True)
            ]
        else:
            row |= of_each[0]
        rows.append(row)
    return rows


_UNBALANCE = ("V_2_over_V_1", "I_2_over_I_1")


def _of_one(col: _Columns, tail: np.ndarray, end: int) -> dict[str, Any]:
    """Return means over the end of a phase of one generator, and the severity of its fault."""
    more = [v for v in _UNBALANCE if v in col.ds]  # files of before lack them
    means = {v: float(np.mean(col[v][tail])) for v in (*_MEANS_OF_EACH, *more)}
    return means | severity(*(float(col[v][end]) for v in _SEVERITY))


def _worst(
    ds: xr.Dataset, col: _Columns, whole: np.ndarray, t: float, number: int
) -> dict[str, Any]:
    """Return the severity of a generator's worst fault in a phase, which may be over at its end."""
    rows = np.flatnonzero(whole & (col["mu"] > 0))
    if not rows.size:
        return {"worst": None}
    h = severity_h(*(np.asarray(col[v])[rows] for v in ("mu", "k_rf")))
    k = int(rows[int(np.argmax(h))])
    phase = _holding(ds, "faults", "phase", t, number)
    return {"worst": severity(*(float(col[v][k]) for v in _SEVERITY)) | {"fault_phase": phase}}


def _held(ds: xr.Dataset, col: _Columns, end: int, t: float, number: int) -> dict[str, Any]:
    """Return phase of the fault and load of a generator at the end of a phase."""
    faulty = col["mu"][end]
    return {
        "fault_phase": _holding(ds, "faults", "phase", t, number) if faulty else None,
        "load": _holding(ds, "loads", "load", t, number),
    }
