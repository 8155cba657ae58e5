"""What a new speed leaves behind within microseconds, where the load is light.

At the start of a step the speed jumps, and with it the stator's speed voltage.  Flux linkages go
on; behind the resistance of the load the currents, and with them the terminal voltage, follow
within L/R: 6 us at 10 kW, far less than a sample.  A fault's branch beside an inductive load does
the same.  What is sampled, and what the regulator takes for the voltage of a whole sample, must be
what they settle to.

For all linear states but the rotor's, dy/dt = J y + g(t); where J is large,

    y = y_s + exp(J t) d,    d = J^-m (d/dt)^m y + ...,    m = ``ORDER``,

with a smooth y_s, of which the derivative leaves the less the higher it is.  d passes by and leaves
its area behind: the integral of exp(J t) d is D = -J^-1 d.  What is not fast, in its directions of
y, is left as it is: by (1 + G^4)^-1 with G = (J T)^-1, of modes whose L/R is longer than T.

y is the stator's flux linkages; where a fault's current is a state, that current with them, or,
beside an inductive load, that current alone, with the stator among what is slow.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from apu_casadi.core.sharing import kept
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.weights import end_weights, unresolved

_STATOR = ("lam_sq", "lam_sd", "lam_s0")
_ROTOR = ("lam_fd", "lam_kd", "lam_kq")
#: By "coefficients are constant": elsewhere slow states ripple, and their second derivative does.
ORDER = {True: 3, False: 3}

#: Fastest of several modes, over 1/T, up to which it is done: beyond, the slow ones have no digits
#: left in third derivatives.  Beside an open phase it is 3e4.
STIFF = 100.0
#: The same for what samples miss, over the rate of samples: of the stator, as single samples take
#: slopes, in which the little that is left is seen long; and of a fault's loop.  Beside a loop of
#: 1000, that of h = 7e-6 at 10 kW, means erred by 3e-3.
SEEN, SEEN_LOOP = 400.0, 30.0
#: Longest time, in strides, in which something passes by of which strides miss a part: a third as
#: long, they integrate it to 1e-4.
SLOWEST = 1.2


@kept
def settled(ss: GeneratorModel, constant: bool) -> ca.Function:
    """Function (x, u, theta, T) -> (x as it settles, area of what passes by).

    Both are the state itself and zero, to the last bit, where nothing is faster than T, s, or
    something beside the loop of a fault by more than ``STIFF`` times.  The area is that of states
    over time, above what they settle to.

    Args:
        ss: model variant, linear in its windings.
        constant: whether the coefficients do not depend on the rotor angle.
    """
    T = ca.SX.sym("T")
    of_model, (x, u, th) = _Fast.of(ss, constant)
    f, stator = of_model.f, ss.x.indices([n for n in _STATOR if n in ss.linear])
    fastest = of_model.fastest(stator) * T
    light = ca.logic_and(ca.gt(fastest, 1.0), ca.lt(fastest, STIFF))
    if "i_fault" not in ss.linear:
        outputs = [ca.if_else(light, part, 0.0) for part in of_model.passing(stator, T)]
    else:
        loop = ss.x.index("i_fault")
        fast = ca.fabs(ca.jacobian(f[loop], x)[loop]) * T
        on = ca.logic_and(ca.gt(fast, 1.0), ca.lt(fastest, 1.0))  # alone it has all its digits
        light = ca.logic_and(light, ca.lt(fast, STIFF))
        # what is slower ripples in a loop's direction
        alone, both = of_model.passing([loop], T / 2), of_model.passing([*stator, loop], T)
        outputs = [
            ca.if_else(light, b, ca.if_else(on, a, 0.0)) for a, b in zip(alone, both, strict=True)
        ]
    if constant:
        outputs = ca.substitute(outputs, [x[ss.x.index("theta_e")]], [ca.SX(0)])
    return ca.Function("settled", [x, u, th, T], [x + outputs[0], outputs[1]], {"cse": True})


@kept
def missed(ss: GeneratorModel, constant: bool, left: Sequence[float]) -> ca.Function:
    """Function (x, x as it settles, u, theta, h) -> area that sums of samples h, s, apart miss.

    What takes as long as a stride is too slow for :func:`settled`, and too fast for samples: of
    exp(-t/T) they leave an area that depends on h/T alone.  Here it is that of states over time.
    A ripple leaves some of it too, the same after half a turn.

    Args:
        ss, constant: as for :func:`settled`.
        left: n, a, b and c of :func:`apu_casadi.machine.weights.unresolved`.
    """
    of_model, (x, u, th) = _Fast.of(ss, constant)
    after, h, (n, *below) = ca.SX.sym("after", x.numel()), ca.SX.sym("h"), left
    fast = ss.x.indices([k for k in (*_STATOR, "i_fault") if k in ss.linear])
    units, eye = ss.x.nominals[fast], ca.SX.eye(len(fast))
    passes = of_model.unsettled(fast, SLOWEST * h)[0] + (after - x)[fast] / units
    Z = -h * of_model.jacobian(fast)
    Z2 = ca.mtimes(Z, Z)
    Z3 = ca.mtimes(Z2, Z)
    divisor = eye + sum(k * power for k, power in zip(below, (Z, Z2, Z3), strict=True))
    area = ca.SX.zeros(x.numel())
    resolved = -n * h * units * ca.solve(divisor, ca.mtimes(Z3, passes))
    seen = ca.lt(of_model.fastest(fast) * h, SEEN)
    if "i_fault" in ss.linear:
        seen = ca.logic_and(seen, ca.lt(of_model.fastest([ss.x.index("i_fault")]) * h, SEEN_LOOP))
    area[fast] = ca.if_else(seen, resolved, 0.0)
    if constant:
        area = ca.substitute(area, x[ss.x.index("theta_e")], ca.SX(0))
    return ca.Function("missed", [x, after, u, th, h], [area], {"cse": True})


#: What the exciter's steps leave of a voltage that passes by: pairs of samples take it by Simpson's
#: rule, single ones as a cubic, by values and rates at both ends.
SIMPSON = unresolved(np.array([1.0, 4.0, 2.0, 4.0]) / 3.0)
_HERMITE = unresolved(np.array([0.5, 1.0, 1.0]), 1 / 12)
UNEVEN = np.append(end_weights(10), [1.0, 1.0])  # of the first samples in means


_Start: TypeAlias = tuple[Any, tuple[Any, Any]]


class Begun(NamedTuple):
    """What is taken for the first sample of a step by samples.

    Behind the resistance of a light load, or of a fault beside an inductive one, what a new speed
    or a new severity leaves settles within microseconds: it counts by its area, divided by the
    weight of the sample.  So does what the samples miss of a ripple, until they end.

    Args:
        ss, constant: as for :func:`settled`.
        single: whether the exciter takes single samples, or pairs.
    """

    ss: GeneratorModel
    constant: bool
    single: bool

    @property
    def share(self) -> int:
        """What part of a sample's length the exciter takes for the weight of the first."""
        return 2 if self.single else 3

    def _late(self, x: Any, after: Any, held: tuple[Any, Any], h: Any) -> list[Any]:
        """Return areas that the means' samples, and the exciter's, miss."""
        leaves = unresolved(UNEVEN), _HERMITE if self.single else SIMPSON
        return [missed(self.ss, self.constant, k)(x, after, *held, h) for k in leaves]

    def start(self, V_of: ca.Function, x: Any, held: tuple[Any, Any], h: Any) -> _Start:
        """Return a state for the means, and terminal voltage with its rate for the exciter.

        Args:
            x, held, h: state, inputs and theta, length of a sample.
        """
        settles, area = settled(self.ss, self.constant)(x, *held, h / 4)
        late = self._late(x, settles, held, h)
        of_means = settles + (area + late[0]) / (float(UNEVEN[0]) * h)
        V_seen = V_of(settles + (area + late[1]) * (self.share / h), *held)[0]
        return of_means, (V_seen, V_of(settles, *held)[1])

    def end(self, V_of: ca.Function, x: Any, held: tuple[Any, Any], h: Any) -> tuple[Any, Any]:
        """Return a state that means take beyond the last one, and an impulse of the voltage, V s.

        What the first sample has been given for a ripple is given back.
        """
        late = self._late(x, x, held, h)  # nothing is so fast as to settle
        beyond = V_of(x + late[1] * (self.share / h), *held)[0] - V_of(x, *held)[0]
        return x + late[0] / (float(UNEVEN[0]) * h), -h / self.share * beyond


class _Fast(NamedTuple):
    """A model's rates: f all of them, ``rates`` those of what moves within microseconds."""

    ss: GeneratorModel
    x: Any
    f: Any
    rates: Any
    order: int

    @classmethod
    def of(cls, ss: GeneratorModel, constant: bool) -> tuple[_Fast, tuple[Any, Any, Any]]:
        """Return it with its symbols: state, inputs and theta."""
        x, u, th = (
            ca.SX.sym(k, len(s)) for k, s in zip("xut", (ss.x, ss.u, ss.theta), strict=True)
        )
        f, rates = ss.f(x, u, th), ca.SX(len(ss.x), 1)
        moving = [*ss.x.indices(ss.linear), ss.x.index("theta_e")]
        rates[moving] = f[moving]  # the exciter does not move within microseconds
        return cls(ss, x, f, rates, ORDER[constant]), (x, u, th)

    def jacobian(self, of: list[int]) -> Any:
        """Return the rates' derivatives by some of the states themselves, nominal units, 1/s."""
        units = self.ss.x.nominals[of]
        return ca.densify(ca.jacobian(self.f[of], self.x)[:, of]) * (units / units[:, None])

    def fastest(self, of: list[int]) -> Any:
        """Return the rate of the fastest of some states, 1/s."""
        return ca.mmax(ca.fabs(ca.diag(self.jacobian(of))))

    def unsettled(self, fast: list[int], T: Any) -> tuple[Any, Any]:
        """Return what of some entries of the state passes by within T, and its area.

        Both are in nominal units.
        """
        n, d, J = len(fast), self.f[fast], self.jacobian(fast)
        for _ in range(self.order - 1):
            d = ca.jtimes(d, self.x, self.rates)
        d = d / self.ss.x.nominals[fast]
        # (1 + G^4)^-1 J^-1 by two quadratic factors, in nominal units: with fast and slow modes at
        # once, the fourth power itself has too few digits for one of them
        Y, eye = J * T, ca.SX.eye(n)
        Y2, around = ca.mtimes(Y, Y), math.sqrt(2) * Y
        K = T * ca.solve(Y2 + around + eye, ca.solve(Y2 - around + eye, ca.mtimes(Y2, Y)))
        for _ in range(self.order):
            d = ca.mtimes(K, d)
        return d, -ca.solve(J, d)

    def passing(self, fast: list[int], T: Any) -> list[Any]:
        """Return the change of the state until some of its entries have settled, and the area."""
        x, f = self.x, self.f
        all_slow = self.ss.x.indices([n for n in (*_STATOR, *_ROTOR) if n in self.ss.linear])
        slow = [i for i in all_slow if i not in fast]
        coupled, units = ca.densify(ca.jacobian(f[slow], x)[:, fast]), self.ss.x.nominals[fast]
        d, D = (units * part for part in self.unsettled(fast, T))
        change, area = ca.SX.zeros(x.numel()), ca.SX.zeros(x.numel())
        change[fast], area[fast] = -d, D
        # what passes by in the stator moves the rotor's flux linkages for good
        change[slow] = ca.mtimes(coupled, D)
        return [change, area]
