"""The generators of a joint run, each group of equal ones computed once.

Generators of equal model, gear, load, fault and state are one group.  A switch of one of them alone
parts its group for good: from then on both have their own states.  Groups go on by blocks of
exchange steps where all can, else by single steps, each with the integrator that can take it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.runloop import SAME_INSTANT
from apu_casadi.unit.apu import Apu, JointPoint, groups
from apu_casadi.unit.departures import Departure
from apu_casadi.unit.events import (
    Event,
    FaultChange,
    HealthChange,
    Holding,
    LoadChange,
    who,
)
from apu_casadi.unit.integrators import WAVEFORMS, Settings
from apu_casadi.unit.jointstep import BLOCK, BlockResult, JointBlock, UnitState
from apu_casadi.unit.machinestep import MachineMade, MachineStep
from apu_casadi.unit.stepmeans import RawMeans, StepMeans

if TYPE_CHECKING:
    from collections.abc import Callable

    from apu_casadi.machine.faults.fault import Fault


class Of(NamedTuple):
    """What one or more steps gave of a group of generators.

    Args:
        numbers: which they are.
        means: as they were averaged, or as they are kept.
        fault: of each; or severities by name, one for each step.
        w: waveforms, shape (``WAVEFORMS``, samples).
    """

    numbers: tuple[int, ...]
    means: RawMeans | np.ndarray
    fault: Fault | Mapping[str, np.ndarray] | None
    w: np.ndarray


class Inputs(NamedTuple):
    """What the unit takes beside its generators in each of some steps.

    Args:
        u, theta: inputs and full theta of the gas generator, a column for each step.
        N_ref: governed speed, rad/s, (steps,).
    """

    u: np.ndarray
    theta: np.ndarray
    N_ref: np.ndarray


def kinds(apu: Apu, start: Holding, events: Sequence[Event] = ()) -> list[tuple[int, ...]]:
    """Return the generators that stay equal through a run, by their numbers."""
    course, t = [start], -1.0
    for e in events:
        if not isinstance(e, HealthChange):
            now = course[-1].after([e])
            course[len(course) - (e.t - t <= SAME_INSTANT) :] = [now]  # what is left of an instant
            t = e.t
    fates = zip(*((*now.loads, *now.faults) for now in course), strict=True)
    n, of_each = len(apu.machines), [list(f) for f in fates]
    return [*groups([(m, of_each[k], of_each[n + k]) for k, m in enumerate(apu.machines)])]


class Machines:
    """The generators from their steady start on.

    Args:
        apu, point: the unit, and where it starts.
        start: what holds then.
        settings: how they are integrated.
        phasors: whether phasors are wanted too.
        settled: whether loads and faults have been there for long, and ``point`` is of them.
        end: of the run, s.
        changes: of loads and faults in it; a course of tables goes no further.
    """

    apu: Apu
    settings: Settings
    means: StepMeans
    groups: list[MachineStep]

    def __init__(
        self,
        apu: Apu,
        point: JointPoint,
        start: Holding,
        settings: Settings,
        phasors: bool,
        *,
        settled: bool = False,
        end: float = 0.0,
        changes: Sequence[LoadChange | FaultChange] = (),
    ) -> None:
        self.apu, self.settings, self._end, self._changes = apu, settings, end, changes
        self.means = StepMeans(apu.generator, phasors)
        self.groups = []
        for numbers in kinds(apu, start):
            at = numbers[0] - 1
            load, fault = start.loads[at], start.faults[at]
            if not settled:
                load, fault = load.balanced_part, None
            own, how = point.of(numbers[0]), (settings, self.means)
            self.groups.append(MachineStep(apu, numbers, own, load, fault, *how))
        self._forget()

    def _forget(self) -> None:
        self._block: JointBlock | None = None
        self._no_block = ""
        self._wide: dict[tuple[int, tuple[int, ...]], tuple[list[Any], JointBlock]] = {}
        self._one: tuple[list[Any], JointBlock] | None = None

    def samples(self, grid: np.ndarray) -> int:
        """Waveform samples of a whole run, the start included; 0 where none are stored."""
        if self.settings.waveform_dt is None:
            return 0
        return 1 + sum(self.settings.n_out(float(h)) for h in np.diff(grid))

    def at_rest(self, point: JointPoint) -> list[Of]:
        """What a step would give in the steady state."""
        found = []
        for group in self.groups:
            at = point.of(group.numbers[0])
            w = np.array([[at.y[n]] for n in WAVEFORMS])
            found.append(Of(group.numbers, self.means.at_rest(at), group.phase.fault, w))
        return found

    def switch(self, now: Holding, here: Holding, t: float, *, switched: bool = True) -> bool:
        """Change loads and faults at the instant t, s, where they differ.

        Args:
            now, here: what holds, and its numbers.
            switched: whether this is a switch, or goes on smoothly.

        Returns:
            Whether any generator was switched, or is no longer one of its group.
        """
        changed, after = False, list[MachineStep]()
        for group in self.groups:
            members = group.numbers
            (_, fate), *others = groups(
                [(now.loads[k - 1], now.faults[k - 1]) for k in members]
            ).items()
            parts = [(group.part(tuple(members[i - 1] for i in at)), own) for at, own in others]
            for step, own in [(group, fate), *parts]:
                k = step.numbers[0] - 1
                of_it = (e.t for e in self._changes if e.generator in (None, *step.numbers))
                later = (s for s in of_it if s > t + SAME_INSTANT)
                step.follow(*own, t, min(later, default=self._end))
                changed |= step.switch(here.loads[k], here.faults[k], t, smooth=not switched)
                after.append(step)
            changed |= bool(parts)
        self.groups = sorted(after, key=lambda g: g.numbers)
        if changed:
            self._forget()
        return changed

    def disturb(self, draw: Callable[[int], np.ndarray], w1: float, w2: float) -> None:
        """Draw the process noise of (5) and (6), V, for the next step; each group has its own."""
        for group in self.groups:
            group.disturb(w1 * draw(3), w2 * draw(3))

    def step(self, N: float, slope: float, h: float, t0: float) -> tuple[float, list[MachineMade]]:
        """Advance over [t0, t0 + h]; see :meth:`MachineStep.step`.

        Returns:
            Mean shaft power (1), W, and what each group made.
        """
        PW, made = 0.0, []
        for group in self.groups:
            one = group.step(N, slope, h, t0)
            if len(self.groups) > 1:  # another group may use the same buffers
                one = one._replace(t=one.t.copy(), w=one.w.copy())
            PW += group.link.PW(float(one.means.values[0, 0]))
            made.append(one)
        return PW, made

    def accept(self, made: Sequence[MachineMade], h: float) -> None:
        """Go on from the end of a step of length h."""
        for group, one in zip(self.groups, made, strict=True):
            group.accept(one, h)

    def block(
        self, state: UnitState, u: np.ndarray, theta: np.ndarray, N_ref: float, grid: np.ndarray
    ) -> tuple[BlockResult, list[MachineMade]]:
        """Advance the whole unit over the exchange steps of blocks, as far as they go.

        Args:
            N_ref: governed speed, rad/s, which need not be the unit's.

        Raises:
            NotApplicable: that is not possible here.
        """
        if self._no_block:
            raise NotApplicable(self._no_block)
        self._check_block(grid)
        if self._block is None:
            try:
                fast = [g.for_blocks() for g in self.groups]
                self._block = JointBlock(self.apu, fast, [g.link for g in self.groups])
            except NotApplicable as error:
                self._no_block = str(error)
                raise
        states, inputs = [g.x for g in self.groups], [g.u for g in self.groups]
        blocks = (grid.size - 1) // BLOCK
        done = self._block(state, u, theta, states, inputs, N_ref, blocks)
        grid = grid[: done.y.shape[1] + 1]
        pairs = zip(self.groups, done.machines, strict=True)
        return done, [g.went_on(one, grid) for g, one in pairs]

    def one_by_one(
        self, state: UnitState, u: np.ndarray, theta: np.ndarray, N_ref: float, grid: np.ndarray
    ) -> tuple[BlockResult, list[MachineMade]]:
        """Advance the whole unit over steps of one length, each a call of its own.

        Args:
            N_ref: governed speed, rad/s, which need not be the unit's.

        Raises:
            NotApplicable: that is not possible here.
        """
        h = float(grid[1] - grid[0])
        fast = [g.for_one(h) for g in self.groups]
        layouts = [one.layout for one in fast]
        if self._one is None or self._one[0] != layouts:
            links = [g.link for g in self.groups]
            self._one = layouts, JointBlock(self.apu, fast, links, steps=1)
        block = self._one[1]
        block.machines = fast  # of the same layouts, for this length
        states, inputs = [g.x for g in self.groups], [g.u for g in self.groups]
        done = block(state, u, theta, states, inputs, N_ref, grid.size - 1)
        grid = grid[: done.y.shape[1] + 1]
        each = zip(self.groups, fast, done.machines, strict=True)
        return done, [g.went_by_one(one, made, grid) for g, one, made in each]

    def _check_block(self, grid: np.ndarray) -> None:
        if not all(g.settled for g in self.groups):
            raise NotApplicable("the windings have not settled")
        if np.abs(np.diff(grid) - self.settings.dt).max() > SAME_INSTANT:
            raise NotApplicable("the steps of a block are whole exchange steps")

    def follow(
        self, state: UnitState, unit: Inputs, grid: np.ndarray, before: float, steps: int
    ) -> tuple[BlockResult, list[MachineMade]]:
        """Advance the whole unit over blocks whose inputs have a column for each step.

        Args:
            before: the middle of the step before the block, s.
            steps: in each block.

        Raises:
            NotApplicable: that is not possible here.
        """
        self._check_block(grid)
        middles = (grid[1:] + grid[:-1]) / 2
        fast, numbers = zip(*(g.numbers_over(middles, before) for g in self.groups), strict=True)
        blocks = min(middles.size, *(now.basis.shape[1] for now in numbers)) // steps
        if not blocks:
            raise NotApplicable("numbers of fewer steps than a block has go together")
        sizes = tuple(now.terms.shape[1] for now in numbers)
        wide, n = self._wide_block(fast, steps, sizes), blocks * steps
        links = [np.repeat(g.link.numbers[:, None], n, axis=1) for g in self.groups]
        terms = [wide.terms(k, now.terms) for k, now in enumerate(numbers)]

        def held() -> Iterator[list[Any]]:
            for at in (slice(k, k + steps) for k in range(0, n, steps)):
                given: list[Any] = [unit.u[:, at], unit.theta[:, at]]
                for one, now, link, own in zip(fast, numbers, links, terms, strict=True):
                    link[0, at] = unit.N_ref[at]
                    columns = [a[:, at] for a in (now.u, now.theta, link)]
                    given += [*columns, own, now.basis[:, at], one.dt]
                yield given

        try:
            done = wide.followed(state, [g.x for g in self.groups], held())
        except NotApplicable:
            if wide.at_fault is None or not self.groups[wide.at_fault].refine():
                raise
            return self.follow(state, unit, grid, before, steps)
        n = done.y.shape[1]
        each = zip(self.groups, done.machines, numbers, strict=True)
        return done, [g.went_on(one, grid[: n + 1], now.severity[:, :n]) for g, one, now in each]

    def _wide_block(self, fast: Sequence[Any], steps: int, terms: tuple[int, ...]) -> JointBlock:
        """Return the block of so many steps, and terms, for what propagates the groups."""
        layouts = [one.layout for one in fast]
        key = steps, terms
        if key not in self._wide or self._wide[key][0] != layouts:
            how: dict[str, Any] = {"steps": steps, "terms": terms}
            links = [g.link for g in self.groups]
            self._wide[key] = layouts, JointBlock(self.apu, fast, links, **how)
        block = self._wide[key][1]
        block.machines = fast  # of the same layouts, with what is expected of them now
        return block

    def rows(self, made: Sequence[MachineMade]) -> list[Of]:
        """What is to be recorded of what the groups made."""
        pairs = zip(self.groups, made, strict=True)
        return [Of(g.numbers, m.means, m.severity or g.phase.fault, m.w) for g, m in pairs]

    @property
    def V_ref(self) -> float | list[float]:
        """Voltage reference, per unit; of each generator where they differ."""
        each = {k: g.V_ref for g in self.groups for k in g.numbers}
        alike = len(set(each.values())) == 1
        return each[1] if alike else [each[k] for k in sorted(each)]

    @property
    def nsteps(self) -> int:
        """Steps of the solvers so far."""
        return sum(g.nsteps for g in self.groups)

    @property
    def propagated(self) -> int:
        """Exchange steps of generators that were propagated exactly, each group counted."""
        return sum(g.propagated for g in self.groups)

    @property
    def spikes(self) -> list[Departure]:
        """What must be known of the switches so far."""
        return [
            Departure(s.name, "V", s.limit, s.V, s.t, s.t, 0.0, "spike", k, s.words)
            for g in self.groups
            for s, k in g.spikes
        ]


def means_of(apu: Apu, numbers: tuple[int, ...], phasors: bool) -> StepMeans:
    """Return what settles the means of equal generators."""
    n, gen = len(apu.machines), apu.machines[numbers[0] - 1].generator
    words = {1: "the generator", 2: "the two generators"}.get(n, f"the {n} generators")
    of = words if len(numbers) == n else who(numbers)
    return StepMeans(gen, phasors, of, len(numbers) / 2)
