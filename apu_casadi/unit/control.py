"""Speed governors: the law that holds the rotor's speed by fuel flow; the PI law of the unit.

The paper calls its controller "a simple PI controller that uses speed feedback to control fuel"
and gives no numbers; those here are assumed, with the reason beside them.  It holds speed and
limits fuel; no temperature is limited, and a run that gets too hot says so
(:mod:`apu_casadi.unit.validity`).

Another law is another subclass of :class:`Governor`, with numbers, states, ``demand`` and
``rates``; ``Apu(governor=...)`` takes it, and runs, linear models and filters follow it.  Entered
in ``GOVERNORS`` it has a word, which ``Apu.change`` and scenarios take as ``governor.kind``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError
from apu_casadi.core.parameters import Parameters, par
from apu_casadi.core.register import Register
from apu_casadi.core.signals import Signal, Signals


class Governed(NamedTuple):
    """Fuel flow, kg/s, and the rates of the governor's states."""

    Wf: Any
    rates: tuple[Any, ...]


class Governor(Parameters):
    """A governor: numbers made by :func:`~apu_casadi.core.parameters.par`, states ``X``, a law.

    With the relative error e = (N_ref - N)/N_ref and the states x,

        Wf = limit(demand(e, x)),    dx/dt = rates(e, x, Wf - demand).

    ``demand`` and ``rates`` are pure functions of their arguments and of the numbers of ``self``,
    all of which are floats, arrays or symbols.  Two of the numbers are the limits ``Wf_min`` and
    ``Wf_max``, kg/s.
    """

    X: ClassVar[Signals]
    Wf_min: float
    Wf_max: float

    def __post_init__(self) -> None:
        """Check the ranges, and that the limits are in order."""
        super().__post_init__()
        if not self.Wf_min < self.Wf_max:
            raise ParameterError(
                f"{type(self).__name__}: Wf_min = {self.Wf_min:g} must be below "
                f"Wf_max = {self.Wf_max:g} kg/s"
            )

    def demand(self, e: Any, x: Sequence[Any]) -> Any:
        """Return the fuel flow asked for before its limits, kg/s."""
        raise NotImplementedError

    def rates(self, e: Any, x: Sequence[Any], cut: Any) -> tuple[Any, ...]:
        """Return dx/dt; ``cut`` is the fuel that the limits take off (negative) or add, kg/s."""
        raise NotImplementedError

    def start(self, Wf: float) -> tuple[float, ...]:
        """Return the states at rest at the governed speed; the first one is the integrator."""
        return (Wf, *(0.0 for _ in self.X.names[1:]))

    def law(self, N: Any, N_ref: Any, x: Sequence[Any]) -> Governed:
        """Return fuel and rates at the speed N, rad/s."""
        e = (N_ref - N) / N_ref
        demand = self.demand(e, x)
        Wf = _limited(demand, self.Wf_min, self.Wf_max)
        return Governed(Wf, tuple(self.rates(e, x, Wf - demand)))

    def slope(self, N: Any, N_dot: Any, N_ref: Any, x: Sequence[Any] | None = None) -> Any:
        """Return the rate of the fuel within its limits, kg/s2, while the speed has a slope.

        The rate of a PI law does not depend on its state.  For a law where it does, ``x`` are the
        states; without them they are taken to be those of :meth:`start`, without fuel.
        """
        e = (N_ref - N) / N_ref
        x = self.start(0.0) if x is None else x
        es, xs = ca.SX.sym("e"), ca.SX.sym("x", len(self.X))
        gradient = ca.gradient(self.demand(es, ca.vertsplit(xs)), ca.vertcat(es, xs))
        of = ca.Function("gradient", [es, xs], [gradient])(e, ca.vertcat(*x))
        moves = (-N_dot / N_ref, *self.rates(e, x, 0.0))
        return sum(of[i] * move for i, move in enumerate(moves))

    @property
    def numbers(self) -> dict[str, float]:
        """Its numbers by name."""
        fields = dataclasses.fields(self)
        return {f.name: getattr(self, f.name) for f in fields if "unit" in f.metadata}


def _limited(value: Any, low: Any, high: Any) -> Any:
    if isinstance(value, float):
        return max(low, min(high, value))
    if isinstance(value, np.ndarray):
        return np.clip(value, low, high)
    return ca.fmax(low, ca.fmin(high, value))


GOVERNORS: Register[type[Governor]] = Register("governor")


@GOVERNORS.add("PI")
@dataclass(frozen=True)
class GovernorParameters(Governor):
    """The PI law, with limits and back-calculation.

    demand = Kp e + Wf_I,    dWf_I/dt = Ki e + (Wf - demand)/T_aw
    """

    X: ClassVar[Signals] = Signals(
        [Signal("Wf_I", "kg/s", "integrator of the governor", nominal=0.05)]
    )

    Kp: float = par(
        0.38,
        unit="kg/s",
        source="assumed: crossover at 8 rad/s with J = 0.05 kg m2, far below the 20 ms sampling",
        doc="fuel flow per relative speed error",
        lo=0.0,
    )
    Ki: float = par(
        0.76,
        unit="kg/s^2",
        source="assumed: Kp times a quarter of the crossover",
        doc="fuel flow rate per relative speed error",
        lo=0.0,
    )
    Wf_min: float = par(
        0.010,
        unit="kg/s",
        source="assumed: a fifth of design fuel, against flame-out",
        doc="lower fuel limit",
        lo=1e-5,
    )
    Wf_max: float = par(
        0.060,
        unit="kg/s",
        source="assumed: 1.24 x design fuel; steady T4 there 1345 K at governed speed on the "
        "default day, more on a hot day, at altitude, with a fault or at a lower speed",
        doc="upper fuel limit; it limits the fuel, not T4",
        lo=1e-5,
    )
    T_aw: float = par(
        0.1,
        unit="s",
        source="assumed: a quarter of Kp/Ki",
        doc="anti-windup tracking time",
        lo=1e-4,
    )

    def demand(self, e: Any, x: Sequence[Any]) -> Any:
        """Proportional and integral part."""
        return self.Kp * e + x[0]

    def rates(self, e: Any, x: Sequence[Any], cut: Any) -> tuple[Any, ...]:
        """Rate of the integrator, which tracks the limits."""
        return (self.Ki * e + cut / self.T_aw,)


def word_of(governor: Governor) -> str:
    """Return the word of a governor in ``GOVERNORS``; its class's name if it has none."""
    kinds = (word for word, kind in GOVERNORS.items() if kind is type(governor))
    return next(kinds, type(governor).__name__)


class GovernorOut(NamedTuple):
    """Fuel flow, kg/s, and the rate of the integrator, kg/s2."""

    Wf: Any
    Wf_I_dot: Any


def governor(*, N: Any, N_ref: Any, Wf_I: Any, par: GovernorParameters) -> GovernorOut:
    """Return fuel and rate of the PI law."""
    Wf, rates = par.law(N, N_ref, (Wf_I,))
    return GovernorOut(Wf, *rates)
