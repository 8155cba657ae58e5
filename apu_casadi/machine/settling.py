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

y is the stator's flux linkages; or, where a fault's current is a state beside an inductive load,
that current alone, with the stator among what is slow.
"""

from __future__ import annotations

from typing import Any

import casadi as ca

from apu_casadi.core.sharing import kept
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.transition import inverse

_STATOR = ("lam_sq", "lam_sd", "lam_s0")
_ROTOR = ("lam_fd", "lam_kd", "lam_kq")
#: By "coefficients are constant": elsewhere slow states ripple, and their second derivative does.
ORDER = {True: 2, False: 3}

#: Fastest mode, over 1/T, up to which it is done.  Beside an open phase (3e4) what the ripple of
#: the others leaves in the derivatives is not small, and a step that begins settled was 5e-6 off.
STIFF = 300.0


@kept
def settled(ss: GeneratorModel, constant: bool) -> ca.Function:
    """Function (x, u, theta, T) -> (x as it settles, area of what passes by).

    Both are the state itself and zero, to the last bit, where nothing is faster than T, s, or
    something by more than ``STIFF`` times.  The area is that of states over time, above what they
    settle to.

    Args:
        ss: model variant, linear in its windings.
        constant: whether the coefficients do not depend on the rotor angle.
    """
    nx, nu, nt = len(ss.x), len(ss.u), len(ss.theta)
    x, u, th, T = (ca.SX.sym(k, n) for k, n in zip("xuts", (nx, nu, nt, 1), strict=True))
    rotor, angle = ss.x.indices(_ROTOR), ss.x.index("theta_e")
    stator = ss.x.indices([n for n in _STATOR if n in ss.linear])
    fast = [ss.x.index("i_fault")] if "i_fault" in ss.linear else stator
    slow = [i for i in (*stator, *rotor) if i not in fast]
    n, f, rates = len(fast), ss.f(x, u, th), ca.SX(nx, 1)
    moving = [*ss.x.indices(ss.linear), angle]
    rates[moving] = f[moving]  # the exciter does not move within microseconds
    J, coupled = (ca.densify(ca.jacobian(f[rows], x)[:, fast]) for rows in (fast, slow))
    J_inv, d = inverse(n)(J), f[fast]
    for _ in range(ORDER[constant] - 1):
        d = ca.jtimes(d, x, rates)
    T_own = T if fast == stator else T / 2  # what is slower ripples in a loop's direction
    G2 = ca.mtimes(J_inv, J_inv) / T_own**2
    K = ca.mtimes(inverse(n)(ca.SX.eye(n) + ca.mtimes(G2, G2)), J_inv)
    for _ in range(ORDER[constant]):
        d = ca.mtimes(K, d)
    D = -ca.mtimes(K, d)
    fastest = ca.mmax(ca.fabs(ca.diag(J))) * T
    on = ca.logic_and(ca.gt(fastest, 1.0), ca.lt(fastest, STIFF))
    if fast != stator:
        rest = ca.diag(ca.jacobian(f[stator], x)[:, stator])
        on = ca.logic_and(on, ca.lt(ca.mmax(ca.fabs(rest)) * T, 1.0))
    change, area = ca.SX.zeros(nx), ca.SX.zeros(nx)
    change[fast], area[fast] = ca.if_else(on, -d, 0.0), ca.if_else(on, D, 0.0)
    # what passes by in the stator moves the rotor's flux linkages for good
    change[slow] = ca.if_else(on, ca.mtimes(coupled, D), 0.0)
    outputs: list[Any] = [change, area]
    if constant:
        outputs = ca.substitute(outputs, [x[angle]], [ca.SX(0)])
    return ca.Function("settled", [x, u, th, T], [x + outputs[0], outputs[1]], {"cse": True})
