"""Many exchange steps of the whole unit as one compiled function.

The loop of :mod:`apu_casadi.unit.multirate` written as an expression: exact propagation of the
generators, governor, and the gas generator's discrete step, over a block of exchange steps.  For
phases in which nothing is switched: with waveforms (:mod:`apu_casadi.machine.propagation`) where
the machine's coefficients do not depend on the rotor angle, without them
(:mod:`apu_casadi.machine.meanstep`) always.  What Python does between the steps of the ordinary
loop costs as much as the models themselves.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.backend import Caller, backend_in_use, compiled
from apu_casadi.core.sharing import Rebuilt, keep
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL
from apu_casadi.machine.meanstep import MeanStep
from apu_casadi.machine.propagation import Propagator
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.control import governor

BLOCK = 10  # exchange steps in one call


class BlockResult(NamedTuple):
    """What a block of exchange steps gave.

    Args:
        N, z, Wf_I, x_sg: states at the end: rotor speed (1,), cycle unknowns, governor, generator.
        y: gas generator's outputs after each step, shape (ny, BLOCK).
        means: means over each step, shape (quantities, BLOCK).
        waves: samples, shape (outputs, BLOCK * n_out).

    ``y``, ``means`` and ``waves`` are overwritten by the thread's next block.
    """

    N: np.ndarray
    z: np.ndarray
    Wf_I: float
    x_sg: np.ndarray
    y: np.ndarray
    means: np.ndarray
    waves: np.ndarray


def _function(apu: Apu, machine: Propagator | MeanStep) -> ca.Function:
    """Build the block: (carry, u, theta, u_sg, theta_sg, series, dt) -> (last, y, means, ...).

    ``carry`` holds N, z, Wf_I and the generator's state; the waveforms and, for each step, what is
    to be checked come last: errors of the machine's step, residual of the cycle, speed.
    """
    gg, ss, gov = apu.gas_generator, machine.ss, apu.governor
    n_out = machine.n_out
    sizes = [len(gg.X), len(gg.z), 1, len(ss.x)]
    ends = np.cumsum([0, *sizes]).tolist()
    carry, u = ca.MX.sym("carry", ends[-1]), ca.MX.sym("u", len(gg.U))
    theta, u_sg = ca.MX.sym("theta", len(gg.THETA)), ca.MX.sym("u_sg", len(ss.u))
    series, dt = ca.MX.sym("series", machine.parameters.size), ca.MX.sym("dt")
    theta_sg = ca.MX.sym("theta_sg", machine.theta.size)
    held = [u, theta, u_sg, theta_sg, series, dt]

    N, z, Wf_I, x_sg = (carry[i:j] for i, j in pairwise(ends))
    u_now = ca.MX(u_sg)
    u_now[ss.u.index("w_r")] = w_r = apu.w_r(N)
    x1, *Y, means, miss = machine.advance(x_sg, series, u_now, theta_sg, dt)
    at = ss.x.index("theta_e")
    x1[at] -= 2 * math.pi * ca.floor(x1[at] / (2 * math.pi) + 0.5)
    fuel = governor(N=N, N_ref=apu.N_ref, Wf_I=Wf_I, par=gov)
    u1 = ca.vertcat(fuel.Wf, apu.PW(means[0]), u[2:])
    N1, y, z1, r = gg.step(N, u1, theta, dt, z)
    after = ca.vertcat(N1, z1, Wf_I + dt * fuel.Wf_I_dot, x1)
    # w_r goes with the checks: the series holds in a range of speeds
    outs = [after, y, means, ca.vertcat(miss, r, w_r), *Y]
    step = ca.Function("joint_step", [carry, *held], outs)

    now, rows = carry, []
    for _ in range(BLOCK):
        now, *row = step(now, *held)
        rows.append(row)
    return ca.Function(
        f"joint_block_{ss.name}_{n_out}",
        [carry, *held],
        [now, *(ca.horzcat(*column) for column in zip(*rows, strict=True))],
        ["carry", "u", "theta", "u_sg", "theta_sg", "series", "dt"],
        ["last", "y", "means", "checks", *(["waves"] if Y else [])],
    )


class JointBlock(Rebuilt):
    """Blocks of exchange steps with one load and fault."""

    def __init__(self, apu: Apu, machine: Propagator | MeanStep) -> None:
        """Build or fetch the compiled block; a ``Propagator`` must have constant coefficients."""
        self.apu, self.machine = apu, machine
        self._call = _caller(apu, machine)

    def __call__(
        self,
        N: np.ndarray,
        z: np.ndarray,
        Wf_I: float,
        x_sg: np.ndarray,
        u: np.ndarray,
        theta: np.ndarray,
        u_sg: np.ndarray,
    ) -> BlockResult | None:
        """Advance ``BLOCK`` steps; None where a check fails and the ordinary loop must decide."""
        m = self.machine
        carry = np.concatenate([N, z, [Wf_I], x_sg])
        last, y, means, checks, *waves = self._call(
            carry, u, theta, u_sg, m.theta, m.parameters, m.dt
        )
        *miss, residual, w_r = checks
        good = (
            np.all(m.limits >= np.array(miss).T)
            and np.all(residual <= RESIDUAL_TOL)
            and np.isfinite(last).all()
            and np.isfinite(means).all()
            and m.valid(float(w_r.min()))
            and m.valid(float(w_r.max()))
        )
        if not good:
            return None
        n_x, n_z = N.size, z.size
        last = last.copy()  # the state stays when a later block is refused
        return BlockResult(
            last[:n_x],
            last[n_x : n_x + n_z],
            float(last[n_x + n_z]),
            last[n_x + n_z + 1 :],
            y,
            means,
            waves[0] if waves else np.empty((0, 0)),
        )


def _caller(apu: Apu, machine: Propagator | MeanStep) -> Caller:
    """One compiled block for each unit and layout."""
    key = (*machine.layout, backend_in_use())
    return keep(
        apu, JointBlock, key,
        lambda: Caller(compiled(_function(apu, machine), level=3), copy=False),
    )  # fmt: skip
