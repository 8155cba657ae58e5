"""The health factors of the gas path: names, what each multiplies and its range, in one table.

A factor is 1 when the component is as new.  It multiplies what the component's map says: the
compressor's or the turbine's isentropic efficiency or flow.  Whatever takes or shows health factors
reads them here.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class HealthFactor(NamedTuple):
    """One health factor.

    Args:
        component: ``"compressor"`` or ``"turbine"``.
        quantity: what of its map is multiplied, ``"efficiency"`` or ``"flow"``.
        symbol: for plots.
    """

    component: str
    quantity: str
    symbol: str

    @property
    def doc(self) -> str:
        """Its meaning in words."""
        return f"{self.component} {self.quantity} factor"


HEALTH_FACTORS: Mapping[str, HealthFactor] = MappingProxyType(
    {
        "f_eta_c": HealthFactor("compressor", "efficiency", "$η_c$"),
        "f_W_c": HealthFactor("compressor", "flow", "$W_c$"),
        "f_eta_t": HealthFactor("turbine", "efficiency", "$η_t$"),
        "f_W_t": HealthFactor("turbine", "flow", "$W_t$"),
    }
)
"""The health factors by name, in the order of the engine's theta."""

HEALTH = tuple(HEALTH_FACTORS)
"""Their names."""

HEALTH_RANGE = (0.3, 2.0)
"""Lowest and highest value for which steady points are solved."""

RUN_RANGE = (0.5, 1.5)
"""Values of a run lie in this interval, its lower end excluded."""
