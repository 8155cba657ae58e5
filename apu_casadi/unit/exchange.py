"""What the models pass to each other: speed, shaft power and fuel (paper, eqs. 1-3).

The generators turn with the rotor, (2), and their mechanical power loads it, (1); the governor
makes the fuel of speed.  Written once, for numbers and for symbols: the joint run calls it with
floats, the block of steps, the one model of the whole unit, its averaged form and the truths of
estimation build their expressions from it.

In one exchange step the machine is computed over [t, t + h] first; its mean power and the fuel then
drive the gas generator's discrete step, (3), and the governor's states go on by their rates.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.signals import Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.unit.control import Governed, Governor


class Exchange(NamedTuple):
    """How speed and fuel pass between the models over a step.

    Args:
        ramp: the machine's speed goes on with the step's predicted slope, instead of being held.
        mid_fuel: the fuel is that of the predicted mid-step, instead of that of the beginning.
        passes: times that each step is computed, the slope of the one before serving the next.
    """

    ramp: bool
    mid_fuel: bool
    passes: int = 1


EXCHANGES = {
    "paper": Exchange(False, False),
    "predicted": Exchange(True, True),
    "corrected": Exchange(True, True, passes=2),
    "predicted speed": Exchange(True, False),
    "predicted fuel": Exchange(False, True),
}
"""What ``simulate_joint(exchange=...)`` takes; the last two tell two parts of the error apart."""

PAPER = EXCHANGES["paper"]
OFFERED = tuple(EXCHANGES)[:3]
"""Those that scenarios and commands offer."""


@dataclass(frozen=True)
class Link:
    """Gearbox and governor between the models; numbers or symbols.

    Args:
        governor: the law that makes fuel of speed.
        N_ref: governed rotor speed, rad/s.
        gear, eta_gtSg, n_pp: speed ratio and power transfer of the gearbox, pole pairs of the
            generators; by default nothing lies between.
        pairs: number of generators over two, since the model's P_total is the power of two.
    """

    governor: Governor
    N_ref: Any
    gear: Any = 1.0
    eta_gtSg: Any = 1.0
    n_pp: Any = 1
    pairs: Any = 1.0

    def w_r(self, N: Any) -> Any:
        """Electrical speed of the generators, rad/s, at rotor speed N (eq. 2)."""
        return self.n_pp * N / self.gear

    def PW(self, P_total: Any) -> Any:
        """Shaft power, W, that the mean power P_total of each two generators asks for (eq. 1)."""
        return self.pairs * P_total / self.eta_gtSg

    def fuel(self, N: Any, x: Sequence[Any]) -> Governed:
        """Fuel of the instant, and the rates of the governor's states."""
        return self.governor.law(N, self.N_ref, x)

    def held_fuel(self, N: Any, x: Sequence[Any], slope: Any, h: Any, *, mid: bool) -> Governed:
        """Fuel and rates held over a step of length h: those of its start, or of its middle."""
        now = self.fuel(N, x)
        if not mid:
            return now
        return self.fuel(N + h / 2 * slope, moved(x, h / 2, now.rates))

    @property
    def structure(self) -> tuple[Any, ...]:
        """What expressions of it depend on besides its numbers."""
        gov, fields = self.governor, dataclasses.fields(self.governor)
        return type(gov), tuple(getattr(gov, f.name) for f in fields if "unit" not in f.metadata)

    @property
    def numbers(self) -> np.ndarray:
        """Its numbers in the order that :meth:`with_numbers` takes."""
        own = [self.N_ref, self.gear, self.eta_gtSg, self.n_pp, self.pairs]
        return np.array([*own, *self.governor.numbers.values()], dtype=float)

    def with_numbers(self, values: Sequence[Any]) -> Link:
        """Return the same link with other numbers, or symbols."""
        names = self.governor.numbers
        law = self.governor.symbolic(**dict(zip(names, values[5:], strict=True)))
        return Link(law, *values[:5])


def moved(x: Sequence[Any], h: Any, rates: Sequence[Any]) -> tuple[Any, ...]:
    """States of a governor after a time h, s, with rates that are held."""
    return tuple(a + h * b for a, b in zip(x, rates, strict=True))


class GovernedStep(NamedTuple):
    """One exchange step: what machine and engine gave, the governor's states, the speed's slope."""

    machine: Any
    engine: Any
    governor: tuple[Any, ...]
    slope: Any


def governed_step(
    link: Link,
    way: Exchange,
    machine: Callable[[Any, Any], tuple[Any, Any]],
    engine: Callable[[Any, Any], tuple[Any, Any]],
    *,
    N: Any,
    x: Sequence[Any],
    h: Any,
    slope: Any = 0.0,
    passes: int = 1,
) -> GovernedStep:
    """Take one exchange step from the speed N, rad/s, and the governor's states x.

    Args:
        link, way: what couples the models, and how.
        machine: (N, slope) -> mean power P_total of the step, W, and what else it gave.
        engine: (Wf, PW) -> speed at the end of the step, rad/s, and what else it gave.
        h: length of the step, s.
        slope: the speed's, predicted for this step, rad/s2.
        passes: times that the step is computed, each time with the slope of the one before.
    """
    for _ in range(passes):
        P_total, made = machine(N, slope)
        Wf, rates = link.held_fuel(N, x, slope, h, mid=way.mid_fuel)
        N_end, given = engine(Wf, link.PW(P_total))
        slope = (N_end - N) / h
    return GovernedStep(made, given, moved(x, h, rates), slope)


class Machine(NamedTuple):
    """A generator's model as :func:`coupled` needs it: names, and f and g of (x, u, theta)."""

    u: Signals
    y: Signals
    f: Callable[[Any, Any, Any], Any]
    g: Callable[[Any, Any, Any], Any]


class Driven(NamedTuple):
    """Equal generators on the shaft, computed once.

    Args:
        link: their gear and number.
        model: of one of them.
        x, theta: its states and parameters.
        inputs: by name, but the speed.
    """

    link: Link
    model: StateSpace | Machine
    x: Any
    theta: Any
    inputs: Mapping[str, Any]


class Coupled(NamedTuple):
    """The continuous unit at an instant, without the gas generator's own equations.

    Args:
        u_gg: inputs of the gas generator: fuel, shaft power and ambient conditions.
        rates: of the states of the governor and of the generators, one below the other.
        y: outputs of the generators.
    """

    u_gg: Any
    rates: Any
    y: list[Any]


def coupled(
    shaft: Link, machines: Sequence[Driven], *, N: Any, x: Any, day: Mapping[str, Any]
) -> Coupled:
    """Couple generators and governor to a gas generator, with the values of the very instant.

    Args:
        shaft: the governor.
        N, x: rotor speed, and states of the governor.
        day: ambient conditions by name; more does not matter.
    """
    Y, power, moves = [], [], []
    for link, model, x_gen, theta, inputs in machines:
        u = ca.vertcat(*(link.w_r(N) if n == "w_r" else inputs[n] for n in model.u.names))
        y = model.g(x_gen, u, theta)
        Y.append(y)
        power.append(link.PW(y[model.y.index("P_total")]))
        moves.append(model.f(x_gen, u, theta))
    Wf, rates = shaft.fuel(N, ca.vertsplit(x))
    u_gg = ca.vertcat(Wf, sum(power[1:], power[0]), *(day[n] for n in AMBIENT))
    return Coupled(u_gg, ca.vertcat(*rates, *moves), Y)
