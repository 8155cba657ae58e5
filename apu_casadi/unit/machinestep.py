"""The generators between two exchange instants: state, load, fault, and what integrates them.

A :class:`Phase <apu_casadi.unit.integrators.Phase>` holds from one switch to the next, with the
integrators that can be asked in it (:mod:`apu_casadi.unit.integrators`).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.runloop import SAME_INSTANT, first_able
from apu_casadi.machine.generator import Generator, GeneratorPoint
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.integrators import (
    SETTLED,
    Phase,
    Settings,
    Step,
    integrators,
)
from apu_casadi.unit.jointstep import BLOCK, BlockResult, JointBlock
from apu_casadi.unit.stepmeans import RawMeans, StepMeans

if TYPE_CHECKING:
    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load

NOISE = tuple(["w1_q", "w1_d", "w1_0", "w2_fd", "w2_kd", "w2_kq"])


class MachineMade(NamedTuple):
    """What one step of the generator, or a block of them, gave.

    Args:
        x: state at the end.
        means: over the step, or over each.
        t, w: instants of the samples, s, and waveforms, shape (``WAVEFORMS``, samples).
    """

    x: np.ndarray
    means: RawMeans
    t: np.ndarray
    w: np.ndarray


class MachineStep:
    """One of the two equal generators.

    Args:
        apu, point: the unit and the steady state to start from.
        load: that of the steady state.
        settings: how it is integrated.
        phasors: whether phasors are wanted too.
    """

    apu: Apu
    gen: Generator
    settings: Settings
    V_ref: float
    w_r: Any
    x: np.ndarray
    u: np.ndarray
    means: StepMeans
    nsteps: int
    propagated: int

    def __init__(
        self,
        apu: Apu,
        point: GeneratorPoint,
        load: Load,
        settings: Settings,
        phasors: bool = False,
    ) -> None:
        """Take over the steady state; see the class."""
        self.apu, self.gen, self.settings = apu, apu.generator, settings
        self.V_ref, self.w_r = point.V_ref, apu.w_r(apu.N_ref)
        self.x, self.u = np.asarray(point.x, float), np.array(point.u, float)
        self.means = StepMeans(self.gen, phasors)
        self.nsteps = self.propagated = 0
        self.spikes: list[str] = []
        self._since = math.inf  # s since the last switch
        symmetric = load.balanced and not settings.noisy
        self._enter(Phase(self.gen, load, None, point.ss, self.u, np.zeros(0), symmetric))

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._integrators = integrators(phase, self.settings, self.means)
        self._block: JointBlock | None = None
        self._no_block = ""
        self._at = phase.ss.u.index("w_r")

    def samples(self, grid: np.ndarray) -> int:
        """Waveform samples of a whole run, the start included; 0 where none are stored."""
        if self.settings.waveform_dt is None:
            return 0
        return 1 + sum(self.settings.n_out(float(h)) for h in np.diff(grid))

    @property
    def warnings(self) -> list[str]:
        """What must be known of the steps so far."""
        return [*self.spikes, *self.means.warnings]

    def switch(self, load: Load, fault: Fault | None, t: float) -> bool:
        """Change load and fault at the instant t, s, where they differ; the flux linkages stay."""
        old = self.phase
        if load == old.load and fault == old.fault:
            return False
        ss, theta = self.gen.variant(load, fault), self.gen.fault_vector(load, fault)
        u = self.gen.inputs(load, w_r=self.w_r, V_ref=self.V_ref)
        self.x = self.gen.transfer(
            self.x, old.ss, ss, u=self.u, theta=old.theta, u_target=u, theta_target=theta
        )
        text = self.gen.spike(ss, self.x, u, theta, t=t, load=load)
        if text is not None:
            self.spikes.append(text)
        symmetric = fault is None and load.balanced and not self.settings.noisy
        self.u, self._since = u, 0.0
        self._enter(Phase(self.gen, load, fault, ss, u, theta, symmetric))
        return True

    def disturb(self, w1: np.ndarray, w2: np.ndarray) -> None:
        """Set the process noise of (5) and (6), V, for the next step."""
        self.u[self.phase.ss.u.indices(NOISE)] = np.concatenate([w1, w2])

    def step(self, N: float, slope: float, h: float, t0: float) -> MachineMade:
        """Advance over [t0, t0 + h] at the rotor speed N, rad/s, or along its slope, rad/s2.

        The own state is left as it was: the caller may repeat the step, and then :meth:`accept` it.
        """
        self.w_r = self.u[self._at] = self.apu.w_r(N)
        step = Step(self.x, self.u, self.w_r, self.apu.w_r(slope), h, t0, self._since)
        made = first_able(self._integrators, step)
        self.nsteps += made.nsteps
        self.propagated += made.exact
        means = RawMeans.of(made.quad, self.phase.symmetric, made.means, h, self.w_r, t0 + h)
        return MachineMade(made.x, means, made.t, made.w)

    def accept(self, made: MachineMade, h: float) -> None:
        """Go on from the end of a step of length h."""
        self.x = made.x
        self._since += h

    def block(
        self,
        x: np.ndarray,
        z: np.ndarray,
        governor: tuple[float, ...],
        u: np.ndarray,
        theta: np.ndarray,
        grid: np.ndarray,
    ) -> tuple[BlockResult, MachineMade]:
        """Advance the whole unit over ``BLOCK`` exchange steps at once.

        Raises:
            NotApplicable: that is not possible here.
        """
        if self._since < SETTLED - SAME_INSTANT:
            raise NotApplicable("the windings have not settled")
        if self._no_block:
            raise NotApplicable(self._no_block)
        fast, h = self._integrators[0], self.settings.dt
        if self._block is None:
            try:
                self._block = JointBlock(self.apu, fast.for_blocks())
            except NotApplicable as error:
                self._no_block = str(error)
                raise
        if np.abs(np.diff(grid) - h).max() > SAME_INSTANT:
            raise NotApplicable("the steps of a block are whole exchange steps")
        done = self._block(x, z, governor, self.x, u, theta, self.u)
        t, w = fast.waves(done.waves, grid)
        self.propagated += BLOCK
        self.w_r = self.apu.w_r(float(x[0]))
        means = RawMeans.of(fast.quad, self.phase.symmetric, done.means, h, self.w_r, grid[1:])
        self.x = done.x_sg
        return done, MachineMade(done.x_sg, means, t, w)
