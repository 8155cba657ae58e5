"""What is not known of a unit: parameters that are estimated, considered or known, by name.

    estimate_joint(ds, 1, unknowns=UNKNOWNS | {"machine.L_md": Knowledge("considered", 0.05)})

========================= ========================================================================
``machine.r_s``           the severity h = mu/(k_rf + 1 - mu) shows as h/r_s alone: the same share
                          of h is added to its standard deviation; power is not concerned
``machine.r_fd``          the ratio of measured field voltage and current is taken for it
other machine parameters  a state of the filter with the severities, by its exact derivatives
``J``                     the rotor's inertia, of the gas-path filter
========================= ========================================================================

By default the temperatures of both windings are considered, and the inertia is estimated; where no
gain errors are taken into account, the windings are known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.machine.machinedata import MACHINE
from estimators.models.filtermodel import Unknown

__all__ = ["COPPER", "UNKNOWNS", "Knowledge", "filter_unknowns", "of_parameter", "usual"]

COPPER = 0.00393  # 1/K; temperature coefficient of copper's resistance at 20 C, IEC 60028
WAYS = ("estimated", "considered", "known")
INERTIA = "J"


@dataclass(frozen=True)
class Knowledge:
    """What is known of a parameter.

    Args:
        how: ``"estimated"``, ``"considered"`` (uncertain, not estimated) or ``"known"``.
        sigma: standard deviation of the prior over the value; 0 if it is known.

    Raises:
        ParameterError: another word, a standard deviation that is not positive, or one of what is
            known.
    """

    how: str
    sigma: float = 0.0

    def __post_init__(self) -> None:
        if self.how not in WAYS:
            raise ParameterError(f"how = {self.how!r} {nearest(str(self.how), WAYS)}")
        s = number("Knowledge.sigma", self.sigma, error=ParameterError)
        if not (math.isfinite(s) and s >= 0 and (s == 0) == (self.how == "known")):
            raise ParameterError(
                f"sigma = {s!r}: a share of the value > 0 for what is estimated or considered, 0 "
                "for what is known"
            )

    @classmethod
    def temperature(cls, kelvin: float, how: str = "considered") -> Knowledge:
        """Return what a winding's temperature, uncertain by so many kelvin, leaves of copper."""
        return cls(how, COPPER * kelvin)


UNKNOWNS: dict[str, Knowledge] = {
    "machine.r_s": Knowledge.temperature(20.0),
    "machine.r_fd": Knowledge.temperature(20.0),
    INERTIA: Knowledge("estimated", 0.1),
}


def usual(unknowns: Mapping[str, Knowledge] | None, gain_errors: bool) -> Mapping[str, Knowledge]:
    """Return the unknowns, or those of the default."""
    if unknowns is not None:
        return unknowns
    return UNKNOWNS if gain_errors else {INERTIA: UNKNOWNS[INERTIA]}


def of_parameter(unknowns: Mapping[str, Knowledge], name: str) -> Knowledge:
    """Return what is known of a parameter; of one that is not named, its value."""
    return unknowns.get(name, Knowledge("known"))


def filter_unknowns(unknowns: Mapping[str, Knowledge]) -> dict[str, tuple[Unknown, float]]:
    """Return the machine's parameters that are states of the filter, with their relative sigmas.

    Raises:
        ParameterError: unknown name; a stator resistance that is to be estimated.
    """
    valid = (*(n for n in MACHINE.names if n.partition(".")[2][:2] in ("r_", "L_")), INERTIA)
    for n in unknowns:
        if n not in valid:
            raise ParameterError(f"unknown parameter {n!r} {nearest(n, valid)}")
    if of_parameter(unknowns, "machine.r_s").how == "estimated":
        raise ParameterError(
            "machine.r_s cannot be estimated: the terminals tell h/r_s alone; consider it"
        )
    out = {}
    for n, k in unknowns.items():
        if k.how != "known" and n not in ("machine.r_s", "machine.r_fd", INERTIA):
            out[n] = Unknown(consider=k.how == "considered"), k.sigma
    return out
