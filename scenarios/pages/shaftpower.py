"""Shaft power of one machine by eq. (8), and by its torque, at loads and faults of all kinds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.bypower import load_by_power
from apu_casadi.machine.loads.open import OpenLoad
from apu_casadi.machine.loads.openphase import OpenPhase
from apu_casadi.machine.loads.series import SeriesLoad

if TYPE_CHECKING:
    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load

LOADS: dict[str, Load] = {
    "open": OpenLoad(R=1e3),
    "25 kW": load_by_power(25e3),
    "100 kW": load_by_power(100e3),
    "225 kW": load_by_power(225e3),
    "225 kW, 0.85 lagging": load_by_power(225e3, 0.85),
    "100 kW, 0.95 leading": load_by_power(100e3, 0.95, "leading"),
    "100 kW, unbalanced 1.3 : 1 : 0.7": load_by_power(100e3, unbalance=(1.3, 1.0, 0.7)),
    "100 kW, phase b open": OpenPhase(SeriesLoad.from_power(100e3), "b"),
}
#: Near a short circuit at the terminals, at the field voltage of 225 kW.
SHORTS: dict[str, Load] = {
    f"short, {R} mohm a phase": SeriesLoad(R=(R / 1e3,) * 3) for R in (50, 10, 1)
}
FAULTS: dict[str, Fault | None] = {
    "healthy": None,
    "moderate": Ttsc(0.05, 20.0),
    "severe": Ttsc(0.05, 1.0),
    "worst": Ttsc(0.2, 1.0),
}


def rows() -> list[dict[str, Any]]:
    """Return a table of kW for each load: by (8) and by the torque for each fault."""
    gen = Generator()
    V_fd = gen.steady_state(LOADS["225 kW"]).y["V_fd"]
    made = []
    for name, load in (LOADS | SHORTS).items():
        how = {"V_fd": V_fd} if name in SHORTS else {}
        row: dict[str, Any] = {"load": name}
        for key, fault in FAULTS.items():
            point = gen.steady_state(load, fault, **how)
            torque = point.mean("T_e") * gen.machine.w_rated / gen.machine.n_pp
            row[key] = {
                "paper": point.mean("P_total") / 2e3,
                "torque": (torque + gen.P_fixed) / 1e3,
            }
        made.append(row)
    return made


def fixed_loss() -> float:
    """Return the fixed loss, kW, that goes with the torque."""
    return Generator().P_fixed / 1e3
