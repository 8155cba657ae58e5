"""Equal generators between two exchange instants: state, load, fault, and what integrates them.

A :class:`Phase <apu_casadi.unit.integrators.Phase>` holds from one switch to the next, with the
integrators that can be asked in it (:mod:`apu_casadi.unit.integrators`).
"""

from __future__ import annotations

import copy
import dataclasses
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.profiles.profile import Varying
from apu_casadi.core.runloop import SAME_INSTANT, first_able
from apu_casadi.machine.collocated import Collocated
from apu_casadi.machine.course import Numbers
from apu_casadi.machine.generator import Generator, GeneratorPoint, Spike
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import who
from apu_casadi.unit.exchange import Link
from apu_casadi.unit.integrators import (
    NO_TIMES,
    NO_WAVES,
    SETTLED,
    ByStrides,
    Phase,
    Settings,
    Step,
    Way,
    integrators,
)
from apu_casadi.unit.jointstep import MachineBlock
from apu_casadi.unit.stepmeans import RawMeans, StepMeans

if TYPE_CHECKING:
    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load
    from apu_casadi.machine.meanstep import MeanStep
    from apu_casadi.machine.propagation import Propagator

NOISE = tuple(["w1_q", "w1_d", "w1_0", "w2_fd", "w2_kd", "w2_kq"])


class MachineMade(NamedTuple):
    """What one step of the generator, or a block of them, gave.

    Args:
        x: state at the end.
        means: over the step, or over each.
        t, w: instants of the samples, s, and waveforms, shape (``WAVEFORMS``, samples).
        severity: of a fault that changes over a block, by name.
    """

    x: np.ndarray
    means: RawMeans
    t: np.ndarray
    w: np.ndarray
    severity: dict[str, np.ndarray] | None = None


class MachineStep:
    """Generators that are equal in model, gear, load, fault and state, computed once.

    Args:
        apu, numbers: the unit, and which of its generators they are, from 1.
        point, load, fault: the steady state to start from, and what holds in it.
        settings: how it is integrated.
        means: what is averaged.
    """

    numbers: tuple[int, ...]
    gen: Generator
    link: Link
    settings: Settings
    V_ref: float
    w_r: Any
    phase: Phase
    x: np.ndarray
    u: np.ndarray
    means: StepMeans
    nsteps: int
    propagated: int

    def __init__(
        self,
        apu: Apu,
        numbers: tuple[int, ...],
        point: GeneratorPoint,
        load: Load,
        fault: Fault | None,
        settings: Settings,
        means: StepMeans,
    ) -> None:
        """Take over the steady state; see the class."""
        self.numbers, self.settings, self.means = numbers, settings, means
        self.gen, self.link = apu.machines[numbers[0] - 1].generator, apu.link_of(numbers)
        self._of_all = len(numbers) == len(apu.machines)
        self.V_ref, self.w_r = point.V_ref, self.link.w_r(apu.N_ref)
        self.x, self.u = np.asarray(point.x, float), np.array(point.u, float)
        self.nsteps = self.propagated = 0
        self.spikes: list[tuple[Spike, tuple[int, ...] | None]] = []
        self._since = math.inf  # s since the last switch
        self._way: Way | None = None
        self._asked: tuple[Any, Any, float] = (load, fault, math.inf)
        symmetric = point.balanced and not settings.noisy
        self._enter(Phase(self.gen, load, fault, point.ss, self.u, point.theta, symmetric))

    def part(self, numbers: tuple[int, ...]) -> MachineStep:
        """Let some of the generators go their own way from now on; returns them."""
        other = copy.copy(self)
        other.x, other.u = self.x.copy(), self.u.copy()
        other.nsteps = other.propagated = 0
        other.spikes = []
        rest = tuple(k for k in self.numbers if k not in numbers)
        for part, its in ((self, rest), (other, numbers)):
            part.numbers, part._of_all = its, False
            part.link = dataclasses.replace(self.link, pairs=len(its) / 2)
        return other

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._integrators = integrators(phase, self.settings, self.means, self._way)
        self._at, self._V_ref_at = phase.ss.u.indices(["w_r", "V_ref"])
        self._same: tuple[MeanStep | Propagator, Numbers] | None = None

    def follow(self, load: Any, fault: Any, begin: float, end: float) -> None:
        """Take what load and fault are made of, from now until others come, s."""
        if (load, fault, end) == self._asked:
            return
        self._asked = (load, fault, end)
        changing = any(isinstance(x, Varying) for x in (load, fault))
        self._way = Way(load, fault, begin, end) if changing else None
        self._enter(self.phase)

    def switch(self, load: Load, fault: Fault | None, t: float, *, smooth: bool = False) -> bool:
        """Change load and fault at the instant t, s, where they differ; the flux linkages stay.

        Args:
            smooth: they go on along their profiles, which is no switch unless the model changes.

        Returns:
            Whether there was a switch.
        """
        old = self.phase
        if load == old.load and fault == old.fault:
            return False
        ss, theta = self.gen.variant(load, fault), self.gen.fault_vector(load, fault)
        u = self.gen.inputs(load, w_r=self.w_r, V_ref=self.V_ref)
        if smooth and ss == old.ss:
            self.u = u
            self.phase = dataclasses.replace(old, load=load, fault=fault, u=u, theta=theta)
            for each in self._integrators:
                each.phase = self.phase
            return False
        self.x = self.gen.transfer(
            self.x, old.ss, ss, u=self.u, theta=old.theta, u_target=u, theta_target=theta
        )
        spike = self.gen.spike(ss, self.x, u, theta, t=t, load=load)
        if spike is not None and not self._of_all:
            spike = spike._replace(words=f"{who(self.numbers)}: {spike.words}")
        if spike is not None:
            self.spikes.append((spike, None if self._of_all else self.numbers))
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
        self.w_r = self.u[self._at] = self.link.w_r(N)
        step = Step(self.x, self.u, self.w_r, self.link.w_r(slope), h, t0, self._since)
        made = first_able(self._integrators, step)
        self.nsteps += made.nsteps
        self.propagated += made.exact
        means = RawMeans.of(made.quad, self.phase.symmetric, made.means, h, self.w_r, t0 + h)
        return MachineMade(made.x, means, made.t, made.w)

    def accept(self, made: MachineMade, h: float) -> None:
        """Go on from the end of a step of length h."""
        self.x = made.x
        self._since += h

    @property
    def settled(self) -> bool:
        """Whether the windings have settled after the last switch."""
        return self._since >= SETTLED - SAME_INSTANT

    def for_blocks(self) -> MeanStep | Propagator:
        """Return what propagates over many steps at once; else NotApplicable."""
        return self._integrators[0].for_blocks()

    def for_one(self, h: float) -> MeanStep | Propagator | Collocated:
        """Return what takes a step of length h, s, whatever was before; else NotApplicable."""
        if self.settled and abs(h - self.settings.dt) <= SAME_INSTANT:
            return self.for_blocks()
        by_strides = (i for i in self._integrators if isinstance(i, ByStrides))
        found = next(by_strides, None)
        if found is None:
            raise NotApplicable("waveforms, or an integrator that was asked for")
        return found.over(h)

    def numbers_over(self, t: np.ndarray, before: float) -> tuple[MeanStep | Propagator, Numbers]:
        """Return what propagates over the first of some steps, as many as go together.

        Args:
            t, before: middles of the steps and of the one before, s.

        Raises:
            NotApplicable: exact propagation does not hold, or numbers change too fast.
        """
        if self._same is not None and self._same[1].basis.shape[1] >= t.size:
            return self._same
        fast, now = self._integrators[0].numbers(t, before)
        now.u[self._V_ref_at] = self.V_ref
        if self._way is None:
            self._same = fast, now
        return fast, now

    def refine(self) -> bool:
        """Take finer strides from now on, where a step was refused; whether there are any."""
        return self._integrators[0].refine()

    def went_by_one(
        self, fast: MeanStep | Propagator | Collocated, done: MachineBlock, grid: np.ndarray
    ) -> MachineMade:
        """Go on from the end of steps of one length over a grid, s, each a block of its own."""
        if isinstance(fast, Collocated):
            self.nsteps += (grid.size - 1) * fast.strides
        else:
            self.propagated += grid.size - 1
        self.w_r = self.u[self._at] = float(done.w_r[-1])
        self.x, h = done.x, fast.dt
        self._since += float(grid[-1] - grid[0])
        means = RawMeans.of(fast.quad, self.phase.symmetric, done.means, h, done.w_r, grid[1:])
        return MachineMade(done.x, means, NO_TIMES, NO_WAVES)

    def went_on(self, done: MachineBlock, grid: np.ndarray, severity: Any = ()) -> MachineMade:
        """Go on from the end of blocks over a grid, s.

        Args:
            severity: of the fault in each step, in the order of its names, where it changes.
        """
        fast = self._integrators[0]
        t, w = fast.waves(done.waves, grid)
        self.propagated += grid.size - 1
        self.w_r = self.u[self._at] = float(done.w_r[-1])
        h, symmetric = self.settings.dt, self.phase.symmetric
        means = RawMeans.of(fast.quad, symmetric, done.means, h, done.w_r, grid[1:])
        self.x = done.x
        own: dict[str, np.ndarray] | None = None
        if self._way is not None and self.phase.fault is not None and len(severity):
            names = [s.name for s in self.phase.fault.severities]
            own = dict(zip(names, severity, strict=True))
        return MachineMade(done.x, means, t, w, own)
