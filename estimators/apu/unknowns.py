"""What is not known of a unit: parameters that are estimated, considered or known, by name.

    estimate_joint(ds, 1, unknowns=UNKNOWNS | {"machine.L_md": Knowledge("considered", 0.05)})

========================= ========================================================================
``machine.eta_sg``        the efficiency, iron loss included: a share of the power, the same in all
                          windows, and the gas-path filter's ``gain_PW``
``machine.r_s``           the severity h = mu/(k_rf + 1 - mu) shows as h/r_s alone: the same share
                          of h is added to its standard deviation; power is not concerned
``machine.r_fd``          the ratio of measured field voltage and current is taken for it
other machine parameters  a state of the filter with the severities, by its exact derivatives
``delay_i``               by which currents are read later than voltages, s: such a state
``J``                     the rotor's inertia, of the gas-path filter
========================= ========================================================================

By default efficiency, the temperatures of both windings, the delay and the inertia are considered;
where no gain errors are taken into account, windings and delay are known.  An inertia that is
estimated is learnt from noise: that of measured power and fuel moves no rotor, as if it were very
heavy, and in nine steady seconds the inertia went to 1.8 times itself.  Where it is considered, one
that is half as large again is told by the innovations of the first step of load.

A short circuit that may be there has a prior as well:
:class:`estimators.apu.electrical.hypotheses.SeverityPrior`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.machine.machinedata import MACHINE
from estimators.apu.electrical.terminalsignals import DELAY
from estimators.apu.electrical.tuning import DELAY_SIGMA
from estimators.models.filtermodel import Unknown

__all__ = [
    "COPPER",
    "EFFICIENCY",
    "ETA_SIGMA",
    "INERTIA",
    "UNKNOWNS",
    "Knowledge",
    "filter_unknowns",
    "known_parameters",
    "of_parameter",
    "usual",
]

COPPER = 0.00393  # 1/K; temperature coefficient of copper's resistance at 20 C, IEC 60028
WAYS = ("estimated", "considered", "known")
INERTIA = "J"
EFFICIENCY = "machine.eta_sg"
#: Relative; efficiency of the generators, assumed: IEC 60034-1 lets 10 % of 1 - eta be missing
#: above 150 kW, 1 % here; and eta is one number where iron loss hardly changes with the load.
ETA_SIGMA = 0.02
APART = ("machine.r_s", "machine.r_fd", EFFICIENCY, INERTIA)  # no states of the electrical filter


@dataclass(frozen=True)
class Knowledge:
    """What is known of a parameter.

    Args:
        how: ``"estimated"``, ``"considered"`` (uncertain, not estimated) or ``"known"``.
        sigma: standard deviation of the prior over the value (of ``delay_i``: s); 0 if it is known.

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
    def of(cls, sigma: float, how: str = "considered") -> Knowledge:
        """Return what a standard deviation says, 0 included."""
        return cls(how, sigma) if sigma else cls("known")

    @classmethod
    def temperature(cls, kelvin: float, how: str = "considered") -> Knowledge:
        """Return what a winding's temperature, uncertain by so many kelvin, leaves of copper."""
        return cls(how, COPPER * kelvin)


#: K; standard deviation of a stator winding's temperature of which nothing is measured: anywhere
#: from 20 C, for which resistances are stated (IEC 60028), to the limit of thermal class 180 (H) of
#: IEC 60085, which insulation of such machines has at least.  With 20 K, as of the field, whose
#: voltage and current are measured, 76 K more made h wrong by 4 claimed deviations.
STATOR_KELVIN = (180.0 - 20.0) / math.sqrt(12.0)
UNKNOWNS: dict[str, Knowledge] = {
    "machine.r_s": Knowledge.temperature(STATOR_KELVIN),
    "machine.r_fd": Knowledge.temperature(20.0),
    EFFICIENCY: Knowledge("considered", ETA_SIGMA),
    DELAY.name: Knowledge("considered", DELAY_SIGMA),
    INERTIA: Knowledge("considered", 0.1),
}


def usual(unknowns: Mapping[str, Knowledge] | None, gain_errors: bool) -> Mapping[str, Knowledge]:
    """Return the unknowns, or those of the default."""
    if unknowns is not None:
        return unknowns
    return UNKNOWNS if gain_errors else {n: UNKNOWNS[n] for n in (EFFICIENCY, INERTIA)}


def of_parameter(unknowns: Mapping[str, Knowledge], name: str) -> Knowledge:
    """Return what is known of a parameter; of one that is not named, its value."""
    return unknowns.get(name, Knowledge("known"))


def known_parameters() -> tuple[str, ...]:
    """Return the names of which something may be said."""
    own = (n for n in MACHINE.names if n.partition(".")[2][:2] in ("r_", "L_"))
    return (*own, EFFICIENCY, DELAY.name, INERTIA)


def filter_unknowns(unknowns: Mapping[str, Knowledge]) -> dict[str, tuple[Unknown, float]]:
    """Return the parameters that are states of the electrical filter, with their sigmas.

    Raises:
        ParameterError: unknown name; an efficiency or a stator resistance that is to be estimated.
    """
    valid = known_parameters()
    for n in unknowns:
        if n not in valid:
            raise ParameterError(f"unknown parameter {n!r} {nearest(n, valid)}")
    for n, why in {
        "machine.r_s": "the terminals tell h/r_s alone",
        EFFICIENCY: "the terminals do not tell it",
    }.items():
        if of_parameter(unknowns, n).how == "estimated":
            raise ParameterError(f"{n} cannot be estimated: {why}; consider it")
    out = {}
    for n, k in unknowns.items():
        if k.how != "known" and n not in APART:
            out[n] = Unknown(consider=k.how == "considered"), k.sigma
    return out
