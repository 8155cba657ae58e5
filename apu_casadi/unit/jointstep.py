"""Many exchange steps of the whole unit as one compiled function.

The paper's exchange of :mod:`apu_casadi.unit.exchange` written as an expression: exact propagation
of the generators, governor, and the gas generator's discrete step, over a block of exchange steps.
For phases in which nothing is switched: with waveforms (:mod:`apu_casadi.machine.propagation`)
where the machine's coefficients do not depend on the rotor angle, without them
(:mod:`apu_casadi.machine.meanstep`) always.  What Python does between the steps of the ordinary
loop costs as much as the models themselves.

Gains and limits of the governor, gearbox and governed speed are inputs of the function.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.backend import backend_in_use, compiled
from apu_casadi.core.calling import Caller
from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.sharing import Rebuilt, keep
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.cyclefunctions import CycleFunctions
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL
from apu_casadi.machine.meanstep import MeanStep
from apu_casadi.machine.propagation import Propagator
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.exchange import PAPER, Link, governed_step

BLOCK = 10  # exchange steps in one call


class BlockResult(NamedTuple):
    """What a block of exchange steps gave.

    Args:
        N, z, governor, x_sg: states at the end: rotor speed (1,), cycle unknowns, governor,
            generator.
        y: gas generator's outputs after each step, shape (ny, BLOCK).
        means: means over each step, shape (quantities, BLOCK).
        waves: samples, shape (outputs, BLOCK * n_out).

    ``y``, ``means`` and ``waves`` are overwritten by the thread's next block.
    """

    N: np.ndarray
    z: np.ndarray
    governor: tuple[float, ...]
    x_sg: np.ndarray
    y: np.ndarray
    means: np.ndarray
    waves: np.ndarray


def block_function(
    advance: ca.Function, ss: StateSpace, gas_step: ca.Function, link: Link, name: str
) -> ca.Function:
    """Build the block: (carry, u, theta, u_sg, theta_sg, numbers, series, dt) -> (last, y, ...).

    ``carry`` holds N, z, and the states of governor and generator; after outputs and means comes
    for each step what is to be checked: errors of the machine's step, residual of the cycle,
    speed; last, the waveforms if there are any.

    Args:
        advance: the machine's step, (x, series, u, theta, dt) -> (x, [samples], means, errors).
        ss: the machine's model; theta of the block are those of the families.
        gas_step: (N, u, theta, dt, z) -> (N, y, z, residual).
        link: gearbox and governor; its numbers are inputs.
        name: of the function.
    """
    law, (n_u, n_theta, n_z) = link.governor, (gas_step.numel_in(i) for i in (1, 2, 4))
    ends = np.cumsum([0, 1, n_z, len(law.X), len(ss.x)]).tolist()
    carry, u = ca.MX.sym("carry", ends[-1]), ca.MX.sym("u", n_u)
    theta, u_sg = ca.MX.sym("theta", n_theta), ca.MX.sym("u_sg", len(ss.u))
    theta_sg = ca.MX.sym("theta_sg", len(ss.shared.theta))
    numbers = ca.MX.sym("numbers", link.numbers.size)
    series, dt = ca.MX.sym("series", advance.numel_in(1)), ca.MX.sym("dt")
    held = [u, theta, u_sg, theta_sg, numbers, series, dt]

    N, z, x_gov, x_sg = (carry[i:j] for i, j in pairwise(ends))
    own, at = link.with_numbers(ca.vertsplit(numbers)), ss.x.index("theta_e")
    w_r = own.w_r(N)

    def machine(_N: ca.MX, _slope: ca.MX) -> tuple[ca.MX, list[ca.MX]]:
        u_now = ca.MX(u_sg)
        u_now[ss.u.index("w_r")] = w_r
        x1, *Y, means, miss = advance(x_sg, series, u_now, theta_sg, dt)
        x1[at] -= 2 * math.pi * ca.floor(x1[at] / (2 * math.pi) + 0.5)
        return means[0], [x1, means, miss, *Y]

    def engine(Wf: ca.MX, PW: ca.MX) -> tuple[ca.MX, list[ca.MX]]:
        N1, *rest = gas_step(N, ca.vertcat(Wf, PW, u[2:]), theta, dt, z)
        return N1, [N1, *rest]

    made = governed_step(own, PAPER, machine, engine, N=N, x=ca.vertsplit(x_gov), h=dt)
    (x1, means, miss, *Y), (N1, y, z1, r) = made.machine, made.engine
    after = ca.vertcat(N1, z1, *made.governor, x1)
    # w_r goes with the checks: the series holds in a range of speeds
    outs = [after, y, means, ca.vertcat(miss, r, w_r), *Y]
    step = ca.Function("joint_step", [carry, *held], outs)

    now, rows = carry, []
    for _ in range(BLOCK):
        now, *row = step(now, *held)
        rows.append(row)
    return ca.Function(
        name,
        [carry, *held],
        [now, *(ca.horzcat(*column) for column in zip(*rows, strict=True))],
        ["carry", "u", "theta", "u_sg", "theta_sg", "numbers", "series", "dt"],
        ["last", "y", "means", "checks"] + ["waves"] * len(Y),
    )


class JointBlock(Rebuilt):
    """Blocks of exchange steps with one load and fault."""

    apu: Apu
    machine: Propagator | MeanStep

    def __init__(self, apu: Apu, machine: Propagator | MeanStep) -> None:
        """Build or fetch the compiled block; a ``Propagator`` must have constant coefficients."""
        self.apu, self.machine = apu, machine
        self._numbers, self._n_gov = apu.link.numbers, len(apu.governor.X)
        self._call = _caller(apu.gas_generator.family, apu.link, machine)

    def __call__(
        self,
        N: np.ndarray,
        z: np.ndarray,
        governor: tuple[float, ...],
        x_sg: np.ndarray,
        u: np.ndarray,
        theta: np.ndarray,
        u_sg: np.ndarray,
    ) -> BlockResult:
        """Advance ``BLOCK`` steps.

        Raises:
            NotApplicable: a check fails; step by step it is decided which, and what to do.
        """
        m = self.machine
        carry = np.concatenate([N, z, governor, x_sg])
        full = self.apu.gas_generator.full(theta)
        last, y, means, checks, *waves = self._call(
            carry, u, full, u_sg, m.theta, self._numbers, m.parameters, m.dt
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
            raise NotApplicable(f"{m.ss.name}: a step of the block is not right")
        ends = np.cumsum([0, N.size, z.size, self._n_gov, x_sg.size]).tolist()
        # copied: the state stays when a later block is refused
        N, z, x_gov, x_sg = (last[i:j].copy() for i, j in pairwise(ends))
        wave = waves[0] if waves else np.empty((0, 0))
        return BlockResult(N, z, tuple(x_gov.tolist()), x_sg, y, means, wave)


def _caller(family: CycleFunctions, link: Link, machine: Propagator | MeanStep) -> Caller:
    """One compiled block for each structure of gas generator, link and machine, and layout."""

    def make() -> Caller:
        name = f"joint_block_{machine.ss.name}_{machine.n_out}"
        function = block_function(machine.advance, machine.ss, family.step, link, name)
        return Caller(compiled(function, level=3), copy=False)

    key = (link.structure, machine.layout, backend_in_use())
    return keep(family, JointBlock, key, make)
