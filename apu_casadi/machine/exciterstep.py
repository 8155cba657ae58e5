"""The exciter between the samples of exact propagation.

Of the generator's states it has those that are neither windings nor the rotor angle.  It moves
slowly, and by the classical Runge-Kutta method.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from apu_casadi.core.instructions import applied, rewritten
from apu_casadi.core.sharing import kept
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.transition import EXTRA, split

_NEARBY = 0.02  # argument with which six terms of the exponential's series err by 1e-13


def _rates(ss: GeneratorModel, slow: Any, V_t: Any, V_ref: Any, th: Any) -> Any:
    """Rates of the exciter's states, in which no other state has a part."""
    x = ca.SX.zeros(len(ss.x))
    x[split(ss).slow] = slow
    return ss.exciter(x, V_t, V_ref, th)


@kept
def exciter_step(ss: GeneratorModel) -> tuple[ca.Function, ca.Function]:
    """The exciter's drive and its step, of the states that are neither windings nor angle.

    First: (slow, V_t, V_ref, theta) -> (E, E', E'', E''').  Second, by the classical Runge-Kutta
    method: (slow, V_t at start, middle and end, V_ref, theta, length in s) -> slow at the end.
    """
    at = split(ss).slow
    slow, V = ca.SX.sym("slow", len(at)), ca.SX.sym("V", 3)
    V_ref, H, th = ca.SX.sym("V_ref"), ca.SX.sym("H"), ca.SX.sym("t", len(ss.theta))
    k1 = _rates(ss, slow, V[0], V_ref, th)
    E = at.index(ss.x.index("E_fd"))
    derivatives = [slow[E]]
    for _ in range(EXTRA - 2):
        derivatives.append(ca.jtimes(derivatives[-1], slow, k1))
    drive = ca.Function("drive", [slow, V[0], V_ref, th], [ca.vertcat(*derivatives)])
    k2 = _rates(ss, slow + H / 2 * k1, V[1], V_ref, th)
    k3 = _rates(ss, slow + H / 2 * k2, V[1], V_ref, th)
    k4 = _rates(ss, slow + H * k3, V[2], V_ref, th)
    end = slow + H / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return drive, ca.Function("exciter", [slow, V, V_ref, th, H], [end])


@kept
def kick(ss: GeneratorModel) -> ca.Function:
    """By how much an impulse of the terminal voltage, 1 V s, moves the exciter's states.

    Function (slow, V_t, V_ref, theta) -> change of slow.
    """
    sizes = {"slow": len(split(ss).slow), "V": 1, "V_ref": 1, "t": len(ss.theta)}
    slow, V, V_ref, th = given = [ca.SX.sym(k, n) for k, n in sizes.items()]
    moves = ca.densify(ca.jacobian(_rates(ss, slow, V, V_ref, th), V))
    return ca.Function("kick", given, [moves])


def _given_exps(f: ca.Function) -> tuple[ca.Function, ca.Function]:
    """Write an SX function of (slow, V_t, ...) with the values of its exponentials as an input.

    Those of other inputs alone stay as they are.

    Returns:
        Function(*inputs, exponentials) -> outputs, and Function(*inputs, exponentials) -> their
        arguments.
    """
    inputs, exps, arguments = f.sx_in(), [ca.SX(0, 1)], [ca.SX(0, 1)]

    def operation(_: int, op: int, parts: list[Any], vary: list[bool]) -> Any:
        if op != ca.OP_EXP or not vary[0]:
            return applied(op, parts)
        exps.append(ca.SX.sym("e"))
        arguments.extend(parts)
        return exps[-1]

    results = rewritten(f, inputs, operation, varying=(0, 1))
    e = ca.vertcat(*exps)
    given = [*inputs, e]
    return ca.Function("given", given, results), ca.Function("of", given, [ca.vertcat(*arguments)])


class Exciter:
    """The exciter without an exponential in its chain of steps.

    Its saturation moves by little from one step to the next, so that a few terms of a series are
    as good, and do not keep the next step waiting.  Where an exponential is of something that is
    not linear in the states, or of the terminal voltage, all of them stay.

    Attributes:
        exps: exponentials that steps hand on.
        started: Function (states, V_t, V_ref, theta) -> rates, E with its derivatives, and
            exponentials.
        exponentials: Function (states, V_ref, theta) -> exponentials.
    """

    exps: int
    started: ca.Function
    exponentials: ca.Function

    def __init__(self, ss: GeneratorModel) -> None:
        at = split(ss)
        self._drive = at.slow.index(at.drive)
        slow, V, V_ref = ca.SX.sym("slow", len(at.slow)), ca.SX.sym("V"), ca.SX.sym("V_ref")
        th = ca.SX.sym("t", len(ss.theta))
        given = [slow, V, V_ref, th]
        both = [_rates(ss, *given), exciter_step(ss)[0](*given)]
        whole = ca.Function("both", given, both, {"cse": True})
        self._of, arguments = _given_exps(whole)
        e = ca.SX.sym("e", self._of.numel_in(len(given)))
        own = arguments(*given, e)
        slopes = ca.jacobian(own, slow)
        others = any(ca.which_depends(own, ca.vertcat(V, e), 1, True))
        if others or any(ca.which_depends(ca.vec(ca.densify(slopes)), slow, 1, True)):
            none = ca.SX.sym("e", 0)
            self._of = ca.Function("given", [*given, none], whole(*given))
            own, slopes = ca.SX(0, 1), ca.SX(0, slow.numel())
        self.exps = own.numel()
        self._slopes = ca.Function("slopes", [V_ref, th], [slopes])
        self.exponentials = ca.Function("exponentials", [slow, V_ref, th], [ca.exp(own)])
        made = [*self._of(*given, ca.exp(own)), ca.exp(own)]
        self.started = ca.Function("started", given, made, {"cse": True})

    def at(self, now: Sequence[Any], e: Any) -> tuple[Any, Any]:
        """Rates of the states, and E with its derivatives, at (states, V_t, V_ref, theta)."""
        made: tuple[Any, Any] = self._of(*now, e)
        return made

    def _near(self, moved: Any, e: Any, V_ref: Any, th: Any) -> tuple[Any, Any]:
        """Exponentials where the states have moved by so much, and whether that is near enough."""
        if not self.exps:
            return e, 1.0
        by = self._slopes(V_ref, th) @ moved
        square = by * by  # in this order few terms wait for others
        high = (0.5 + by * (1 / 6)) + square * (1 / 24 + by * (1 / 120))
        return e * ((1.0 + by) + square * high), ca.mmax(ca.fabs(by)) <= _NEARBY

    def step(
        self, states: tuple[Any, Any, Any], V: tuple[Any, Any], held: tuple[Any, Any], H: Any
    ) -> tuple[Any, Any, Any]:
        """Take one step of the classical Runge-Kutta method.

        Args:
            states: at the start, with their rates and exponentials there.
            V: terminal voltage in the middle and at the end.
            held: V_ref and theta.
            H: length, s.

        Returns:
            States and exponentials at the end, and zero, or more than any error that is allowed
            where they have moved too far for the series.
        """
        slow, k1, e = states
        rates = [k1]
        for share, V_now in ((0.5, V[0]), (0.5, V[0]), (1.0, V[1])):
            moved = (share * H) * rates[-1]
            now, _ = self._near(moved, e, *held)
            rates.append(self.at((slow + moved, V_now, *held), now)[0])
        _, k2, k3, k4 = rates
        moved = (H / 6) * (k1 + 2 * (k2 + k3)) + (H / 6) * k4
        after, near = self._near(moved, e, *held)
        return slow + moved, after, 1 - near

    def drive(self, slow: Any) -> Any:
        """Return E, one of the states."""
        return slow[self._drive]


@kept
def exciter_of(ss: GeneratorModel) -> Exciter:
    """Return the exciter of a model variant, made once."""
    return Exciter(ss)
