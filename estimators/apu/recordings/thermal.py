"""Temperatures against what the other readings say: a missing unit that no range can tell."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError
from apu_casadi.gaspath.atmosphere import isa
from apu_casadi.gaspath.conditions import DEFAULT_DAY
from apu_casadi.gaspath.gasgenerator import GasGenerator

__all__ = ["check_temperatures"]

_ICE = 273.15  # K
_EXPONENT = 0.28  # (gamma - 1) / gamma of air, a little low
_COLD = 1.2  # least temperature over the one read from which it cannot be right
_HOT = 1.35  # the same above it
_RAISED = 1.2  # least pressure of a running compressor over the air's
_CP = 1090.0  # J/(kg K), of the burnt gas


def check_temperatures(
    source: str,
    readings: Mapping[str, Any],
    ambient: Mapping[str, Any],
    gg: GasGenerator,
    believed: Collection[str] = (),
) -> None:
    """Refuse readings that contradict each other as a wrong or missing unit makes them.

    A compressor raises the pressure.  It is not colder than an isentropic one of its pressure
    ratio: over the envelope that is 0.86 to 0.94 of T3, and 1.7 to 2 times it if degC are taken for
    K.  The exhaust has the fuel's heat less the power: T5 = T1 + (Wf LHV - PW) / (W2 cp), which is
    between 0.78 and 1.16 of T5 with factors down to 0.9.

    Args:
        source: for messages.
        readings: by name, SI.
        ambient: conditions by name; those of the default day where there are none.
        gg: the engine.
        believed: quantities whose readings are not judged.

    Raises:
        DataError: medians that are far from that.
    """
    day = {n: _middle(ambient.get(n, v)) for n, v in DEFAULT_DAY.items()}
    T0, P0 = (float(v) for v in isa(day["altitude"], day["dT_isa"]))
    ram = 1 + 0.2 * day["Mach"] ** 2
    T1, P1 = T0 * ram, P0 * ram**3.5
    known = {n: _middle(v) for n, v in readings.items() if n not in believed}
    r = defaultdict(lambda: np.nan, known)  # comparisons with what was not read are false
    if r["P3"] < _RAISED * P1:
        raise DataError(
            f"{source}, column P3: wrong unit? {r['P3']:.4g} Pa in the middle is no compressor's "
            f"where the air has {P1:.4g} Pa: give --column P3=P3:UNIT, the altitude by --altitude, "
            "or --range P3=LOW:HIGH in Pa if it is right"
        )
    least = T1 * (r["P3"] / P1) ** _EXPONENT
    if _COLD * r["T3"] < least <= _COLD * (r["T3"] + _ICE):
        _refuse(source, "T3", r["T3"], f"a compressor with P3 = {r['P3']:.4g} Pa", least)
    p = gg.parameters
    W = p.W2 * (P1 / 101325.0) * np.sqrt(288.15 / T1) * r["N"] / p.N
    about = T1 + (r["Wf"] * p.LHV - r["PW"]) / (_CP * W)
    why = f"an engine with Wf = {r['Wf']:.4g} kg/s and PW = {r['PW']:.4g} W"
    if _COLD * r["T5"] < about <= _COLD * (r["T5"] + _ICE):
        _refuse(source, "T5", r["T5"], why, about)
    if r["T5"] > _HOT * about:
        raise DataError(
            f"{source}, columns Wf, PW and T5: {r['T5']:.4g} K in the middle is too hot for {why}, "
            f"which has about {about:.4g} K: one of the units is wrong (give --column "
            "NAME=COLUMN:UNIT), or the altitude (--altitude); --range T5=LOW:HIGH in K if it is "
            "right"
        )


def _middle(value: Any) -> float:
    v = np.atleast_1d(np.asarray(value, float))
    v = v[np.isfinite(v)]
    return float(np.median(v)) if v.size else float("nan")


def _refuse(source: str, name: str, value: float, why: str, about: float) -> None:
    raise DataError(
        f"{source}, column {name}: unit missing? {value:.4g} K in the middle is too cold for "
        f"{why}, which has about {about:.4g} K; as degC it would fit: write {name} [degC], or give "
        f"--column {name}={name}:degC; else check pressures and ambient conditions"
    )
