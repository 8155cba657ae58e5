"""A load given by its power, and a current that lags or leads the voltage."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.core.register import Key, read_table
from apu_casadi.machine.loads.capacitor import CapacitorLoad
from apu_casadi.machine.loads.load import LOADS, Branches, Load
from apu_casadi.machine.loads.series import FACTOR, POWER, UNBALANCE, SeriesLoad

CURRENTS = ("lagging", "leading")
_FACTOR = Key("power_factor", "1", FACTOR.doc, FACTOR.lo, FACTOR.hi, default=1.0)
_CURRENT = Key("current", "1", "lags or leads the voltage", default="lagging", choices=CURRENTS)


def load_by_power(
    P: float, power_factor: float = 1.0, current: str = "lagging", **how: Any
) -> SeriesLoad | CapacitorLoad:
    """Return the load that draws a power from a balanced rated voltage.

    Args:
        P: power of all three phases, W, > 0.
        power_factor: 0 < power_factor <= 1; 1 is a resistance.
        current: ``"lagging"`` (R-L) or ``"leading"`` (R-C) the voltage.
        how: ``V_rms``, ``f``, ``unbalance`` as of :meth:`SeriesLoad.from_power`.

    Raises:
        ParameterError: a value out of range, or another word.
    """
    if current not in CURRENTS:
        raise ParameterError(f"current {current!r} {nearest(str(current), CURRENTS)}")
    if current == "lagging" or power_factor == 1:
        return SeriesLoad.from_power(P, power_factor, **how)
    return CapacitorLoad.from_power(P, power_factor, **how)


@LOADS.add("power")
class ByPower(Branches):
    """The word of scenario files for :func:`load_by_power`; it makes a load of another class."""

    tables: ClassVar[Mapping[str, tuple[Key, ...]]] = MappingProxyType(
        {"power": (POWER, _FACTOR, _CURRENT, UNBALANCE)}
    )

    @classmethod
    def from_table(cls, table: Mapping[str, Any]) -> Load:
        """Make the load from power, power factor and the word for the current."""
        rest = {k: v for k, v in table.items() if k != "kind"}
        values = read_table("a 'power' load", cls.tables["power"], rest)
        shares, P = values["unbalance"] or (1.0, 1.0, 1.0), 1e3 * values["power_kW"]
        return load_by_power(P, values["power_factor"], values["current"], unbalance=shares)

    @classmethod
    def examples(cls) -> dict[str, Load]:
        """Return none: what it makes has the equations of others."""
        return {}
