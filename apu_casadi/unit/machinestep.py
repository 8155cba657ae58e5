"""The generators between two exchange instants: state, load, fault, and what integrates them.

A :class:`Phase <apu_casadi.unit.integrators.Phase>` holds from one switch to the next, with the
integrators that can be asked in it (:mod:`apu_casadi.unit.integrators`) and, for blocks of exchange
steps, :class:`Blocks`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.runloop import SAME_INSTANT, first_able
from apu_casadi.machine.generator import GeneratorPoint
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.integrators import (
    SETTLED,
    WAVEFORMS,
    Integrator,
    Means,
    Phase,
    Samples,
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
        self._integrators: list[Integrator] = integrators(phase, self.settings, self.means)
        self._blocks = Blocks(self.apu, phase, self._integrators[0], self.settings)
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
        done, t, w = self._blocks(x, z, governor, self.x, u, theta, self.u, grid)
        self.propagated += BLOCK
        self.w_r, h = self.apu.w_r(float(x[0])), self.settings.dt
        quad, symmetric = self._blocks.quad, self.phase.symmetric
        means = RawMeans.of(quad, symmetric, done.means, h, self.w_r, grid[1:])
        made = MachineMade(done.x_sg, means, t, w)
        self.accept(made, 0.0)
        return done, made


class Blocks:
    """Blocks of exchange steps of a phase, made when first asked for."""

    def __init__(self, apu: Apu, phase: Phase, fast: Integrator, settings: Settings) -> None:
        self.apu, self.phase, self.settings = apu, phase, settings
        self.fast = fast if isinstance(fast, Means | Samples) else None
        self._made: JointBlock | None = None

    @property
    def quad(self) -> tuple[str, ...]:
        """What is averaged over each step."""
        return () if self.fast is None else self.fast.quad

    def _block(self) -> JointBlock:
        if self._made is None:
            if self.fast is None:
                raise NotApplicable("exact propagation does not hold, or is not asked for")
            fast = self.fast.fast()
            if isinstance(self.fast, Samples) and not fast.constant:
                raise NotApplicable(f"{fast.ss.name}: its coefficients depend on the rotor angle")
            self._made = JointBlock(self.apu, fast)
        return self._made

    def __call__(
        self,
        x: np.ndarray,
        z: np.ndarray,
        governor: tuple[float, ...],
        x_sg: np.ndarray,
        u: np.ndarray,
        theta: np.ndarray,
        u_sg: np.ndarray,
        grid: np.ndarray,
    ) -> tuple[BlockResult, np.ndarray, np.ndarray]:
        """Advance over the grid of a block; with the samples' instants and waveforms."""
        if grid.size != BLOCK + 1 or np.abs(np.diff(grid) - self.settings.dt).max() > SAME_INSTANT:
            raise NotApplicable("the steps of a block are whole exchange steps")
        done = self._block()(x, z, governor, x_sg, u, theta, u_sg)
        if self.settings.waveform_dt is None or not isinstance(self.fast, Samples):
            return done, np.empty(0), np.empty((len(WAVEFORMS), 0))
        fast, stored = self.fast.fast(), self.fast.stored
        t = np.concatenate([fast.times(float(at))[stored] for at in grid[:-1]])
        kept = np.arange(fast.n_out)[stored]
        w = done.waves
        if kept.size < fast.n_out:
            w = w[:, (fast.n_out * np.arange(BLOCK)[:, None] + kept).ravel()]
        return done, t, w
