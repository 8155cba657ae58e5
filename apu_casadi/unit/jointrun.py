"""The whole unit on its way through a joint run: gas generator, generators, governor, exchange.

A :class:`~apu_casadi.core.runloop.System`: it takes the events of an instant as one switch, and
goes on by a block of exchange steps where nothing comes in between, else by one step.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import SimulationError
from apu_casadi.core.runloop import SAME_INSTANT, first_able
from apu_casadi.unit import validity
from apu_casadi.unit.apu import Apu, JointPoint
from apu_casadi.unit.events import Ambient, Event, Holding
from apu_casadi.unit.exchange import PAPER, governed_step
from apu_casadi.unit.integrators import WAVEFORMS, Settings
from apu_casadi.unit.jointstep import BLOCK
from apu_casadi.unit.machinestep import MachineMade, MachineStep
from apu_casadi.unit.noise import Noise
from apu_casadi.unit.recorder import Row

if TYPE_CHECKING:
    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load


@dataclass(frozen=True, eq=False)
class Asked:
    """What a run is asked for; see :func:`apu_casadi.unit.multirate.simulate_joint`.

    Args:
        load, fault, ambient, health: from the start; all health factors by name.
        grid: exchange instants, s.
        phasors, noise, seed, hook: as there.
    """

    load: Load
    fault: Fault | None
    ambient: Ambient
    health: dict[str, float]
    grid: np.ndarray
    phasors: bool
    noise: Noise
    seed: int | None
    hook: Callable[[int, np.ndarray], np.ndarray] | None


class JointRun:
    """The unit from its steady start on.

    Args:
        apu, asked, settings: the unit, what is to happen, and how it is integrated.
        rng: for the noise.
    """

    apu: Apu
    asked: Asked
    settings: Settings
    now: Holding
    point: JointPoint
    machine: MachineStep
    x: np.ndarray
    u: np.ndarray
    theta: np.ndarray
    y: np.ndarray
    z: np.ndarray
    governor: tuple[float, ...]

    def __init__(
        self, apu: Apu, asked: Asked, settings: Settings, rng: np.random.Generator
    ) -> None:
        self.apu, self.asked, self.settings, self._rng = apu, asked, settings, rng
        start = asked.load.balanced_part
        self.now = Holding(asked.load, asked.fault, asked.health)
        self.point = apu.steady_state(start, ambient=asked.ambient, health=self.now.factors)
        self.machine = MachineStep(apu, self.point.generator, start, settings, asked.phasors)
        gas, gg = self.point.gas, apu.gas_generator
        self.x, self.u, self.theta = gas.x, gas.u.copy(), gas.theta
        self.y, self.z = gg.output(self.x, self.u, self.theta, z0=gas.z)
        self.governor = apu.governor.start(float(gas["Wf"]))
        self.slope: float | None = 0.0  # of the speed over the last step, rad/s2; None: not known
        self._gas_step = gg.stepper if settings.fast else None
        by_blocks = settings.exact and asked.hook is None and not asked.noise.N
        self._ways = (self._block, self._step) if by_blocks else (self._step,)

    def at_start(self) -> Row:
        """What is recorded of the first instant."""
        point = self.point.generator
        means = self.machine.means.at_rest(point)
        w = np.array([[point.y[n]] for n in WAVEFORMS])
        return Row(self.y, means, self.now.factors, None, np.zeros(1), w)

    def switch(self, events: Sequence[Event], t: float) -> None:
        """Take the events of an instant, s, which are one switch, whatever their order."""
        before, self.now = self.now, self.now.after(events)
        if self.now.factors is not before.factors:
            self.theta = self.apu.gas_generator.THETA.pack(self.now.factors)
        if self.machine.switch(self.now.load, self.now.fault, t) or events:
            self.slope = None

    def advance(self, k: int, until: float) -> tuple[int, Row]:
        """Go on by a block of exchange steps, or by one."""
        grid = self.asked.grid
        free = k + BLOCK < grid.size and grid[k + BLOCK] <= until + SAME_INSTANT
        return first_able(self._ways if free else self._ways[-1:], k)

    def _block(self, k: int) -> tuple[int, Row]:
        grid = self.asked.grid[k : k + BLOCK + 1]
        done, made = self.machine.block(self.x, self.z, self.governor, self.u, self.theta, grid)
        self.x, self.z, self.governor, self.slope = done.N, done.z, done.governor, 0.0
        self.y = done.y[:, -1].copy()
        return BLOCK, self._row(done.y, made)

    def _row(self, y: np.ndarray, made: MachineMade) -> Row:
        return Row(y, made.means, self.now.factors, self.machine.phase.fault, made.t, made.w)

    def _step(self, k: int) -> tuple[int, Row]:
        noise, way, gg = self.asked.noise, self.settings.way, self.apu.gas_generator
        if noise.w1 or noise.w2:
            draw = self._rng.standard_normal
            self.machine.disturb(noise.w1 * draw(3), noise.w2 * draw(3))
        t0, N = float(self.asked.grid[k]), float(self.x[0])
        h = float(self.asked.grid[k + 1] - self.asked.grid[k])
        u, theta = self.u, self.theta

        def machine(N: float, slope: float) -> tuple[float, MachineMade]:
            made = self.machine.step(N, slope, h, t0)
            return made.means.values[0, 0], made

        def engine(Wf: float, PW: float) -> tuple[float, tuple[np.ndarray, ...]]:
            u[0], u[1] = Wf, PW
            made = gg.advance(self.x, u, theta, self.z, h, step=self._gas_step)
            return float(made[0][0]), made

        passes = 2 if self.slope is None and way != PAPER else way.passes
        slope = self.slope or 0.0
        try:
            done = governed_step(
                self.apu.link,
                way,
                machine,
                engine,
                N=N,
                x=self.governor,
                h=h,
                slope=slope,
                passes=passes,
            )
            self.machine.accept(done.machine, h)
            row = self._went_on(k + 1, done.machine, *done.engine)
        except SimulationError as error:
            raise self._explained(error, k, N) from None
        self.governor, self.slope = done.governor, done.slope
        return 1, row

    def _went_on(
        self, k: int, made: MachineMade, x: np.ndarray, y: np.ndarray, z: np.ndarray
    ) -> Row:
        """Take over the gas generator's step, with state noise and hook before its output."""
        noise, hook = self.asked.noise.N, self.asked.hook
        if noise or hook is not None:
            x = x + noise * self._rng.standard_normal(1)
            if hook is not None:
                # it may simulate the same unit: views of buffers would change
                made = made._replace(w=made.w.copy())
                x = np.asarray(hook(k, x), float).reshape(1)
            y, z = self.apu.gas_generator.output(x, self.u, self.theta, z0=z)
        self.x, self.y, self.z = x, y, z
        return self._row(y, made)

    def _explained(self, error: SimulationError, k: int, N: float) -> SimulationError:
        """Return the error of the step from instant k with its likely reason."""
        gg, (t, end) = self.apu.gas_generator, self.asked.grid[k : k + 2]
        Wf, PW = (float(v) for v in self.u[:2])
        asked: dict[str, Any] = {"ambient": dataclasses.asdict(self.asked.ambient)}
        asked["PW"] = PW if math.isfinite(PW) else float(self.y[gg.Y.index("PW")])
        words = validity.overload(self.apu, N=N, Wf=Wf, health=self.now.factors, **asked)
        words = words or f"{error}; {validity.before(gg, t, self.y)}"
        return SimulationError(f"at t = {end:.6g} s: {words}")
