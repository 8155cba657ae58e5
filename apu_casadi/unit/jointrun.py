"""The whole unit on its way through a joint run: gas generator, generators, governor, exchange.

A :class:`~apu_casadi.core.runloop.System`: it takes the events of an instant as one switch, and
goes on by a block of exchange steps where nothing comes in between, else by one step.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from apu_casadi.core.errors import NotApplicable, SimulationError
from apu_casadi.core.lanes.together import asking
from apu_casadi.core.profiles.profile import Profile, Varying
from apu_casadi.core.runloop import SAME_INSTANT, first_able
from apu_casadi.core.sharing import keep
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.unit import validity
from apu_casadi.unit.apu import Apu, JointPoint
from apu_casadi.unit.events import Event, FaultChange, Holding, Jump, LoadChange
from apu_casadi.unit.exchange import PAPER, Link, governed_step
from apu_casadi.unit.integrators import Settings
from apu_casadi.unit.jointstep import BLOCK, COURSE, ROW, BlockResult, UnitState
from apu_casadi.unit.machines import Inputs, Machines
from apu_casadi.unit.machinestep import MachineMade
from apu_casadi.unit.noise import Noise
from apu_casadi.unit.recorder import Row

_Way: TypeAlias = Callable[[int], tuple[int, Row]]  # from an instant on: steps, and what they gave
ROUGH = 20  # steps one by one after a block that could not be taken: what is rough stays so
STARTS = 16  # steady points of starts that are kept for a unit


@dataclass(frozen=True, eq=False)
class Asked:
    """What a run is asked for; see :func:`apu_casadi.unit.multirate.simulate_joint`.

    Args:
        start: what holds from the start, profiles included.
        grid: exchange instants, s.
        phasors, noise, seed, hook: as there.
        settled: whether loads and faults have been there for long.
        strict: whether each block is judged before the next one.
        events: in order.
    """

    start: Holding
    grid: np.ndarray
    phasors: bool
    noise: Noise
    seed: int | None
    hook: Callable[[int, np.ndarray], np.ndarray] | None
    settled: bool = False
    strict: bool = False
    events: Sequence[Event] = ()


class Columns:
    """Inputs of the unit in each of some steps, while the same profiles hold.

    Args:
        gg, now, here: gas generator, what holds, and its numbers at some instant.
        shaft: the governor, with the governed speed.
    """

    def __init__(self, gg: GasGenerator, now: Holding, here: Holding, shaft: Link) -> None:
        u = gg.U.pack(**{n: getattr(here.ambient, n) for n in AMBIENT}, Wf=0.0, PW=0.0)
        full = gg.full(gg.THETA.pack(here.factors))
        self._start = Inputs(u[:, None], full[:, None], np.full(1, shaft.N_ref))
        self._given = self._start
        day = now.ambient.profiles if isinstance(now.ambient, Varying) else {}
        self._day = [(gg.U.index(n), p) for n, p in day.items()]
        health = {n: v for n, v in now.factors.items() if isinstance(v, Profile)}
        self._health = [(gg.THETA.index(n), n, p) for n, p in health.items()]
        self._speed, self._factors = now.N_ref, dict(here.factors)

    def __call__(self, t: np.ndarray) -> tuple[Inputs, dict[str, Any]]:
        """Return inputs and health factors of steps with these middles, s.

        The next call overwrites the inputs.
        """
        if self._given.N_ref.size != t.size:
            self._given = Inputs(*(np.repeat(a, t.size, axis=-1) for a in self._start))
        given = self._given
        factors = dict(self._factors) if self._health else self._factors
        for i, profile in self._day:
            given.u[i] = profile(t)
        for i, name, profile in self._health:
            given.theta[i] = factors[name] = profile(t)
        if isinstance(self._speed, Profile):
            given.N_ref[:] = self._speed(t)
        return given, factors


def _start(apu: Apu, here: Holding, *, settled: bool) -> JointPoint:
    """Return the steady point of a start; that of runs that start alike is found once."""
    loads: tuple[Any, ...] = tuple(here.loads)
    faults = tuple(here.faults) if settled else None
    if not settled:
        loads = tuple(load.balanced_part for load in loads)
    more = {} if here.N_ref is None else {"N_ref": here.N_ref}
    key = (loads, faults, here.ambient, tuple(sorted(here.factors.items())), here.N_ref)

    def found() -> JointPoint:
        return apu.steady_state(loads, faults, ambient=here.ambient, health=here.factors, **more)

    return keep(apu, JointPoint, key, found, limit=STARTS, locked=False)


class JointRun:
    """The unit from its steady start on.

    Args:
        apu, asked, settings: the unit, what is to happen, and how it is integrated.
        rng: for the noise.
    """

    apu: Apu
    asked: Asked
    settings: Settings
    rng: np.random.Generator
    now: Holding
    here: Holding
    point: JointPoint
    machines: Machines
    shaft: Link
    x: np.ndarray
    u: np.ndarray
    theta: np.ndarray
    y: np.ndarray
    z: np.ndarray
    governor: tuple[float, ...]

    def __init__(
        self, apu: Apu, asked: Asked, settings: Settings, rng: np.random.Generator
    ) -> None:
        self.apu, self.asked, self.settings, self.rng = apu, asked, settings, rng
        self.now, self.here = asked.start, asked.start.at(0.0)  # as asked, and its numbers
        self.point = _start(apu, self.here, settled=asked.settled)
        own: dict[str, Any] = {"end": float(asked.grid[-1]), "settled": asked.settled}
        own["changes"] = [e for e in asked.events if isinstance(e, LoadChange | FaultChange)]
        self.machines = Machines(apu, self.point, self.here, settings, asked.phasors, **own)
        self.shaft = self._shaft()
        self._changing = self.now.changing
        self._middle = 0.0  # of the last step, s
        self._columns: Columns | None = None
        self._rough = 0  # steps to be taken one by one before blocks are tried again
        gas, gg = self.point.gas, apu.gas_generator
        self.x, self.u, self.theta = gas.x, gas.u.copy(), gas.theta
        self.y, self.z = gg.output(self.x, self.u, self.theta, z0=gas.z)
        self.governor = apu.governor.start(float(gas["Wf"]))
        self.slope: float | None = 0.0  # of the speed over the last step, rad/s2; None: not known
        self._gas_step = gg.stepper if settings.fast else None
        self._tried: tuple[int, set[int]] = -1, set()  # an instant, and what could not go on there
        self._by_blocks = settings.exact and asked.hook is None and not asked.noise.N
        off = np.abs(np.diff(asked.grid) - settings.dt) > SAME_INSTANT
        self._odd = np.append(np.flatnonzero(off), off.size)  # steps of other lengths, and the end

    def at_start(self) -> Row:
        """What is recorded of the first instant."""
        at_rest = self.machines.at_rest(self.point)
        return Row(self.y, at_rest, self.here.factors, np.zeros(1))

    def _shaft(self) -> Link:
        shaft, N_ref = self.apu.shaft, self.here.N_ref
        return shaft if N_ref is None else dataclasses.replace(shaft, N_ref=N_ref)

    def switch(self, events: Sequence[Event | Jump], t: float) -> None:
        """Take the events of an instant, s, which are one switch, whatever their order."""
        if self._changing and t > 0:
            self._hold(self._middle, t)  # what the last step saw, which a block leaves open
        self.now, self._columns = self.now.after(events), None
        self._changing = self.now.changing
        if self._hold(t + 2 * SAME_INSTANT, t, switched=True) or events:
            self.slope = None

    def _hold(self, instant: float, t: float, *, switched: bool = False) -> bool:
        """Hold the numbers of an instant, s, from t on; return whether a machine was switched."""
        before, self.here = self.here, self.now.at(instant) if self._changing else self.now
        here, gg = self.here, self.apu.gas_generator
        if here.factors is not before.factors:
            self.theta = gg.THETA.pack(here.factors)
        if here.ambient is not before.ambient:
            self.u[gg.U.indices(AMBIENT)] = [getattr(here.ambient, n) for n in AMBIENT]
        if before.N_ref != here.N_ref:
            self.shaft = self._shaft()
        return self.machines.switch(self.now, here, t, switched=switched)

    def advance(self, k: int, until: float) -> tuple[int, Row]:
        """Go on by blocks of exchange steps, by one block, or by one step."""
        grid, ways = self.asked.grid, [self._step]
        if self._by_blocks:
            free = int(np.searchsorted(grid, until + SAME_INSTANT, side="right")) - 1
            free = min(free, int(self._odd[np.searchsorted(self._odd, k)])) - k
            ways[:0] = [partial(self._once, i, way) for i, way in enumerate(self._tries(free))]
        return first_able(ways, k)

    def _tries(self, free: int) -> list[_Way]:
        """Return how to go on by blocks over free steps, most of them first.

        In an ensemble each is a question, which nothing may come before.
        """
        tries: list[_Way] = []
        waves, together, strict = self.settings.waveform_dt is not None, asking(), self.asked.strict
        if self._changing and not waves:
            most = COURSE if together or strict else ROW * COURSE
            whole = min(free, most) // COURSE * COURSE
            if whole and not self._rough:
                tries.append(partial(self._blocks, steps=whole, block=COURSE))
            few = 1 if together else min(max(1, free), self._rough or COURSE - 1)
            return [*tries, partial(self._blocks, steps=few, block=1)]
        first = min(free, BLOCK if waves or strict else ROW * BLOCK) // BLOCK * BLOCK
        sizes = [first] if together else dict.fromkeys((first, BLOCK))
        tries += [partial(self._blocks, steps=n, block=BLOCK) for n in sizes if 0 < n <= free]
        if not waves:
            tries.append(partial(self._one_by_one, steps=min(max(1, free), BLOCK - 1)))
        return tries

    def _once(self, way: int, call: _Way, k: int) -> tuple[int, Row]:
        """Try a way from instant k, but not again when the question of a later one is answered."""
        if self._tried[0] != k:
            self._tried = k, set()
        if way in self._tried[1]:
            raise NotApplicable("it has been tried")
        try:
            return call(k)
        except NotApplicable:
            self._tried[1].add(way)
            raise

    def _one_by_one(self, k: int, steps: int) -> tuple[int, Row]:
        """Go on by steps of one length, each a function of its own; by one right after a switch."""
        steps = steps if all(g.settled for g in self.machines.groups) else 1
        grid, state = self.asked.grid[k : k + steps + 1], UnitState(self.x, self.z, self.governor)
        given = self.u, self.theta, float(self.shaft.N_ref)
        done, made = self.machines.one_by_one(state, *given, grid)
        return self._went_by(done, made, self.here.factors)

    def _blocks(self, k: int, steps: int, block: int) -> tuple[int, Row]:
        grid, factors = self.asked.grid[k : k + steps + 1], self.here.factors
        state = UnitState(self.x, self.z, self.governor)
        if self._changing:
            if self._columns is None:
                self._columns = Columns(self.apu.gas_generator, self.now, self.here, self.shaft)
            middles = (grid[1:] + grid[:-1]) / 2
            unit, factors = self._columns(middles)
            self._rough = ROUGH if block > 1 else self._rough  # unless it goes well
            done, made = self.machines.follow(state, unit, grid, self._middle, block)
            steps = done.y.shape[1]
            self._rough = 0 if block > 1 else max(0, self._rough - steps)
            self._middle = float(middles[steps - 1])
            if steps < middles.size:
                factors = {n: v[:steps] if np.ndim(v) else v for n, v in factors.items()}
        else:
            given = self.u, self.theta, float(self.shaft.N_ref)
            done, made = self.machines.block(state, *given, grid)
        return self._went_by(done, made, factors)

    def _went_by(
        self, done: BlockResult, made: list[MachineMade], factors: Mapping[str, Any]
    ) -> tuple[int, Row]:
        """Go on from the end of blocks."""
        (self.x, self.z, self.governor), self.slope = done.state, 0.0
        self.y = done.y[:, -1].copy()
        return done.y.shape[1], self._row(done.y, made, factors)

    def _row(
        self, y: np.ndarray, made: list[MachineMade], factors: Mapping[str, Any] | None = None
    ) -> Row:
        t = made[0].t
        if self.settings.waveform_dt is not None:
            for other in made[1:]:  # equal but for rounding: no generator goes before another
                t = np.maximum(t, other.t)
        factors = self.here.factors if factors is None else factors
        return Row(y, self.machines.rows(made), factors, t)

    def _step(self, k: int) -> tuple[int, Row]:
        noise, way, gg = self.asked.noise, self.settings.way, self.apu.gas_generator
        if noise.w1 or noise.w2:
            self.machines.disturb(self.rng.standard_normal, noise.w1, noise.w2)
        t0, N = float(self.asked.grid[k]), float(self.x[0])
        h = float(self.asked.grid[k + 1] - self.asked.grid[k])
        if self._changing:
            self._middle = t0 + h / 2
            self._hold(self._middle, t0)
        u, theta = self.u, self.theta

        def machine(N: float, slope: float) -> tuple[float, list[MachineMade]]:
            return self.machines.step(N, slope, h, t0)

        def engine(Wf: float, PW: float) -> tuple[float, tuple[np.ndarray, ...]]:
            u[0], u[1] = Wf, PW
            made = gg.advance(self.x, u, theta, self.z, h, step=self._gas_step)
            return float(made[0][0]), made

        passes = 2 if self.slope is None and way != PAPER else way.passes
        slope = self.slope or 0.0
        try:
            done = governed_step(
                self.shaft,
                way,
                machine,
                engine,
                N=N,
                x=self.governor,
                h=h,
                slope=slope,
                passes=passes,
            )
            self.machines.accept(done.machine, h)
            row = self._went_on(k + 1, done.machine, *done.engine)
        except SimulationError as error:
            raise self._explained(error, k, N) from None
        self.governor, self.slope = done.governor, done.slope
        return 1, row

    def _went_on(
        self, k: int, made: list[MachineMade], x: np.ndarray, y: np.ndarray, z: np.ndarray
    ) -> Row:
        """Take over the gas generator's step, with state noise and hook before its output."""
        noise, hook = self.asked.noise.N, self.asked.hook
        if noise or hook is not None:
            x = x + noise * self.rng.standard_normal(1)
            if hook is not None:
                # it may simulate the same unit: views of buffers would change
                made = [m._replace(w=m.w.copy()) for m in made]
                x = np.asarray(hook(k, x), float).reshape(1)
            y, z = self.apu.gas_generator.output(x, self.u, self.theta, z0=z)
        self.x, self.y, self.z = x, y, z
        return self._row(y, made)

    def _explained(self, error: SimulationError, k: int, N: float) -> SimulationError:
        """Return the error of the step from instant k with its likely reason."""
        gg, (t, end) = self.apu.gas_generator, self.asked.grid[k : k + 2]
        Wf, PW = (float(v) for v in self.u[:2])
        asked: dict[str, Any] = {"ambient": dataclasses.asdict(self.here.ambient)}
        asked["PW"] = PW if math.isfinite(PW) else float(self.y[gg.Y.index("PW")])
        asked |= {"N_ref": self.shaft.N_ref, "health": self.here.factors}
        words = validity.overload(self.apu, N=N, Wf=Wf, **asked)
        words = words or f"{error}; {validity.before(gg, t, self.y)}"
        return SimulationError(f"at t = {end:.6g} s: {words}")
