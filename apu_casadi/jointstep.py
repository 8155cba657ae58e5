"""Many exchange steps of the whole unit as one compiled function.

The loop of :mod:`apu_casadi.multirate` written as an expression: exact propagation of the
generators (:mod:`apu_casadi.propagation`), governor, and the gas generator's discrete step, folded
over a block of exchange steps.  For phases in which nothing is switched and the machine's
coefficients do not depend on the rotor angle (healthy, balanced load); what Python does between
the steps of the ordinary loop costs as much there as the models themselves.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.apu import Apu
from apu_casadi.backend import Caller, compiled
from apu_casadi.control import governor
from apu_casadi.gasgenerator import RESIDUAL_TOL
from apu_casadi.propagation import Propagator

BLOCK = 10  # exchange steps in one call


class BlockResult(NamedTuple):
    """What a block of exchange steps gave.

    Parameters
    ----------
    N, z, Wf_I, x_sg : states at the end: rotor speed (1,), cycle unknowns, governor, generator.
    y : gas generator's outputs after each step, shape (ny, BLOCK).
    means : means over each step, shape (quantities, BLOCK).
    waves : samples, shape (outputs, BLOCK * n_out).
    """

    N: np.ndarray
    z: np.ndarray
    Wf_I: float
    x_sg: np.ndarray
    y: np.ndarray
    means: np.ndarray
    waves: np.ndarray


def _function(apu: Apu, propagator: Propagator) -> ca.Function:
    """Build the block for one propagator layout: carry -> (last, y, means, waves, checks)."""
    advance, table = propagator.function, propagator.table
    gg, ss, gov = apu.gas_generator, propagator.ss, apu.governor
    n_x, n_z, n_u, n_sg = len(gg.X), len(gg.z), len(gg.U), len(ss.x)
    n_series = int(table.series.size)
    sizes = [n_x, n_z, 1, n_sg, n_u, len(gg.THETA), len(ss.u), n_series, 4]
    carry = ca.MX.sym("carry", sum(sizes))
    ends = np.cumsum([0, *sizes]).tolist()
    N, z, Wf_I, x_sg, u, theta, u_sg, series, c = (carry[i:j] for i, j in pairwise(ends))
    dt, centre, half = c[0], c[1], c[2]
    w_r = apu.w_r(N)
    s = (w_r - centre) / half
    at_w = ca.DM(len(ss.u), 1)
    at_w[ss.u.index("w_r")] = 1
    u_now = u_sg * (1 - at_w) + at_w * w_r
    P = ca.mtimes(ca.reshape(series, n_series // 4, 4), ca.vertcat(1, s, s**2, s**3))
    x1, Y, means, miss = advance(x_sg, P, u_now, ca.DM(0, 1), dt / propagator.n_out)
    angle = np.zeros((n_sg, 1))
    angle[ss.x.index("theta_e")] = 2 * math.pi
    x1 = x1 - angle * ca.floor(x1[ss.x.index("theta_e")] / (2 * math.pi) + 0.5)
    fuel = governor(N=N, N_ref=apu.N_ref, Wf_I=Wf_I, par=gov)
    u1 = ca.vertcat(fuel.Wf, apu.PW(means[0]), u[2:])
    N1, y, z1, r = gg.step(N, u1, theta, dt, z)
    out = ca.vertcat(N1, z1, Wf_I + dt * fuel.Wf_I_dot, x1, u1, theta, u_sg, series, c)
    # w_r goes with the checks: the series holds in a range of speeds
    step = ca.Function("joint_step", [carry], [out, y, means, ca.vec(Y), ca.vertcat(miss, r, w_r)])
    run = step.mapaccum("joint_block", BLOCK, 1)
    last, ys, ms, Ys, checks = run(carry)
    return ca.Function(
        f"joint_block_{ss.name}_{propagator.n_out}",
        [carry],
        [last[: ends[4], BLOCK - 1], ys, ms, Ys, checks],
        ["carry"],
        ["last", "y", "means", "waves", "checks"],
    )


class JointBlock:
    """Blocks of exchange steps with one healthy, balanced load."""

    def __init__(self, apu: Apu, propagator: Propagator) -> None:
        """Build or fetch the compiled block; ``propagator.constant`` must hold."""
        self.apu, self.propagator = apu, propagator
        self._call = _caller(apu, propagator)

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
        p, table = self.propagator, self.propagator.table
        carry = np.concatenate(
            [N, z, [Wf_I], x_sg, u, theta, u_sg, table.series.ravel(),
             [p.dt, table.centre, table.half, 0.0]]
        )  # fmt: skip
        last, y, means, waves, checks = self._call(carry)
        miss, residual, w_r = checks
        good = (
            np.all(miss <= p.tol)
            and np.all(residual <= RESIDUAL_TOL)
            and np.isfinite(last).all()
            and p.valid(float(w_r.min()))
            and p.valid(float(w_r.max()))
        )
        if not good:
            return None
        n_x, n_z = N.size, z.size
        # column-major samples of each step, one step after the other
        k = len(p.outputs)
        w = waves.T.reshape(BLOCK * p.n_out, k).T if k else np.empty((0, BLOCK * p.n_out))
        return BlockResult(
            last[:n_x].copy(),
            last[n_x : n_x + n_z].copy(),
            float(last[n_x + n_z]),
            last[n_x + n_z + 1 :].copy(),
            y,
            means,
            w,
        )


_CALLERS: dict[tuple[object, ...], Caller] = {}


def _caller(apu: Apu, propagator: Propagator) -> Caller:
    """One compiled block for each unit and layout."""
    key = (apu, *propagator.layout)
    if key not in _CALLERS:
        _CALLERS[key] = Caller(compiled(_function(apu, propagator)))
    return _CALLERS[key]
