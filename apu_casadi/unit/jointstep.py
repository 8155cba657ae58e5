"""Many exchange steps of the whole unit as one compiled function.

The paper's exchange of :mod:`apu_casadi.unit.exchange` written as an expression: exact propagation
of the generators, governor, and the gas generator's discrete step, over a block of exchange steps.
For phases in which nothing is switched: with waveforms (:mod:`apu_casadi.machine.propagation`)
where the machine's coefficients do not depend on the rotor angle, without them
(:mod:`apu_casadi.machine.meanstep`) always.  What Python does between the steps of the ordinary
loop costs as much as the models themselves.  Generators that differ stand side by side in it.  One
step alone is such a function, too: between the last block and an event, of an odd length, or right
after a switch (:mod:`apu_casadi.machine.collocated`).

Gains and limits of the governor, gearbox and governed speed are inputs of the function.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise, repeat
from typing import Any, NamedTuple, TypeAlias

import casadi as ca
import numpy as np

from apu_casadi.core.backend import OFTEN, Gradual, backend_in_use
from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.lanes.pointlanes import points_in_lanes
from apu_casadi.core.lanes.together import Together, asking
from apu_casadi.core.sharing import Rebuilt, keep
from apu_casadi.gaspath.cyclefunctions import CycleFunctions
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL
from apu_casadi.machine.collocated import Collocated
from apu_casadi.machine.meanstep import MeanStep
from apu_casadi.machine.propagation import Propagator
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.exchange import PAPER, Link, governed_step

BLOCK = 10  # exchange steps in one call
COURSE = 50  # where loads, faults or inputs change from step to step
ROW = 20  # blocks in a row of calls at most, whose results are handed on together


Fast: TypeAlias = Propagator | MeanStep | Collocated


class MachineBlock(NamedTuple):
    """What blocks of exchange steps gave of equal generators.

    Args:
        x: state at the end.
        means: over each step, shape (quantities, steps).
        w_r: electrical speed in each step, rad/s, (steps,).
        waves: samples, shape (outputs, steps * n_out).

    Those of a single block are overwritten by the thread's next one.
    """

    x: np.ndarray
    means: np.ndarray
    w_r: np.ndarray
    waves: np.ndarray


class UnitState(NamedTuple):
    """States of the unit beside its generators' own.

    Args:
        N: rotor speed, rad/s, (1,).
        z: unknowns of the cycle, where its solution starts.
        governor: states of its law.
    """

    N: np.ndarray
    z: np.ndarray
    governor: tuple[float, ...]


class BlockResult(NamedTuple):
    """What blocks of exchange steps gave.

    Args:
        state: at the end.
        y: gas generator's outputs after each step, shape (ny, steps); that of a single block is
            overwritten by the thread's next one.
        machines: the generators, each group of equal ones once.
    """

    state: UnitState
    y: np.ndarray
    machines: list[MachineBlock]


class _Machine(NamedTuple):
    """Symbols of one group of generators, the same in all steps or of each."""

    u: ca.MX
    theta: ca.MX
    numbers: ca.MX
    series: ca.MX
    dt: ca.MX

    @classmethod
    def of(cls, k: int, fast: Fast, link: Link) -> _Machine:
        sizes = {"u_sg": len(fast.ss.u), "theta_sg": len(fast.ss.shared.theta)}
        sizes |= {"numbers": link.numbers.size, "series": fast.advance.numel_in(1), "dt": 1}
        return cls(*(ca.MX.sym(f"{name}_{k}", n) for name, n in sizes.items()))

    def wide(self, steps: int, count: int) -> tuple[list[ca.MX], list[list[ca.MX]]]:
        """Return symbols of many steps, polynomials for ``series``; and what each step takes.

        Args:
            count: terms of the polynomials.
        """
        each = [ca.MX.sym(s.name(), s.numel(), steps) for s in self[:3]]
        terms = ca.MX.sym(f"terms_{self.series.name()}", self.series.numel(), count)
        basis = ca.MX.sym(f"basis_{self.series.name()}", count, steps)
        columns = zip(*(ca.horzsplit(s) for s in (*each, basis)), strict=True)
        return [*each, terms, basis, self.dt], [
            [*own, ca.mtimes(terms, by), self.dt] for *own, by in columns
        ]


def block_function(
    machines: Sequence[Fast],
    gas_step: ca.Function,
    link: Link,
    name: str,
    *,
    steps: int = BLOCK,
    terms: Sequence[int] = (),
) -> ca.Function:
    """Build the block: (carry, u, theta, [u_sg, theta_sg, numbers, series, dt]) -> (last, y, ...).

    Where what is held changes, polynomials and their terms in each step stand for ``series``
    (:class:`apu_casadi.machine.course.Numbers`).

    ``carry`` holds N, z, and the states of governor and generators.  Outputs and the residual of
    the cycle in each step are followed for each group of equal generators by means, by what is to
    be checked, errors of its step and electrical speed, and by waveforms if there are any.

    Args:
        machines: what propagates each group; its ``advance`` is (x, series, u, theta, dt) ->
            (x, [samples], means, errors), and theta of the block are those of the families.
        gas_step: (N, u, theta, dt, z) -> (N, y, z, residual).
        link: gearbox and governor of any group; the numbers of each are inputs.
        name: of the function.
        steps: of the exchange in it.
        terms: of the polynomials of each group; none where all steps take the same.
    """
    law, (n_u, n_theta, n_z) = link.governor, (gas_step.numel_in(i) for i in (1, 2, 4))
    n_x = [len(m.ss.x) for m in machines]
    ends = np.cumsum([0, 1, n_z, len(law.X), *n_x]).tolist()
    carry, u, theta = (ca.MX.sym(*s) for s in (("carry", ends[-1]), ("u", n_u), ("theta", n_theta)))
    given = [_Machine.of(k, m, link) for k, m in enumerate(machines)]
    held = [u, theta, *(s for own in given for s in own)]

    N, z, x_gov, *x_sg = (carry[i:j] for i, j in pairwise(ends))
    own = [link.with_numbers(ca.vertsplit(g.numbers)) for g in given]
    shaft = Link(own[0].governor, own[0].N_ref)

    def machine(_N: ca.MX, _slope: ca.MX) -> tuple[ca.MX, list[Any]]:
        PW, made = 0.0, []
        for fast, its, g, x in zip(machines, own, given, x_sg, strict=True):
            w_r, u_now, at = its.w_r(N), ca.MX(g.u), fast.ss.x.index("theta_e")
            u_now[fast.ss.u.index("w_r")] = w_r
            x1, *Y, means, miss = fast.advance(x, g.series, u_now, g.theta, g.dt)
            x1[at] -= 2 * math.pi * ca.floor(x1[at] / (2 * math.pi) + 0.5)
            PW = PW + its.PW(means[0])
            # w_r goes with the checks: the series holds in a range of speeds
            made.append((x1, [means, ca.vertcat(miss, w_r), *Y]))
        return PW, made

    def engine(Wf: ca.MX, PW: ca.MX) -> tuple[ca.MX, list[ca.MX]]:
        dt = given[0].dt
        N1, *rest = gas_step(N, ca.vertcat(Wf, PW, u[2:]), theta, dt, z)
        return N1, [N1, *rest]

    h = given[0].dt
    made = governed_step(shaft, PAPER, machine, engine, N=N, x=ca.vertsplit(x_gov), h=h)
    N1, y, z1, r = made.engine
    after = ca.vertcat(N1, z1, *made.governor, *(x1 for x1, _ in made.machine))
    outs = [after, y, r, *(out for _, each in made.machine for out in each)]
    step = ca.Function("joint_step", [carry, *held], outs)

    given_to, each = held, [held] * steps
    if terms:
        own_of = [g.wide(steps, n) for g, n in zip(given, terms, strict=True)]
        unit = [ca.MX.sym(s.name(), s.numel(), steps) for s in (u, theta)]
        given_to = [*unit, *(s for symbols, _ in own_of for s in symbols)]
        columns = zip(*(ca.horzsplit(s) for s in unit), *(e for _, e in own_of), strict=True)
        each = [[*now[:2], *(s for own in now[2:] for s in own)] for now in columns]
    now, rows = carry, []
    for these in each:
        now, *row = step(now, *these)
        rows.append(row)
    last = [now, *(ca.horzcat(*column) for column in zip(*rows, strict=True))]
    return ca.Function(name, [carry, *given_to], last)


class JointBlock(Rebuilt):
    """Blocks of exchange steps, each group of equal generators with its load and fault.

    Args:
        apu: the unit.
        machines: what propagates each group; a ``Propagator`` must have constant coefficients.
        links: of each group.
        steps: of the exchange in a block.
        terms: of polynomials of each group, where what is held changes from step to step.
    """

    apu: Apu
    machines: Sequence[Fast]
    at_fault: int | None = None  # the group whose step was not right when a block was last refused
    _likely = ROW  # blocks in a row that may well be right

    def __init__(
        self,
        apu: Apu,
        machines: Sequence[Fast],
        links: Sequence[Link],
        *,
        steps: int = BLOCK,
        terms: Sequence[int] = (),
    ) -> None:
        """Build or fetch the compiled block."""
        self.apu, self.machines, self.steps = apu, tuple(machines), steps
        self._links = [link.numbers for link in links]
        n_x = [len(m.ss.x) for m in machines]
        self._n_gov, self._n_x = len(apu.governor.X), n_x
        self._n_z = apu.gas_generator.family.step.numel_in(4)
        self._sampled = [m.advance.n_out() == 4 for m in machines]
        self._call = _caller(apu.gas_generator.family, links[0], self.machines, steps, tuple(terms))

    def __call__(
        self,
        state: UnitState,
        u: np.ndarray,
        theta: np.ndarray,
        x_sg: Sequence[np.ndarray],
        u_sg: Sequence[np.ndarray],
        N_ref: float,
        blocks: int = 1,
    ) -> BlockResult:
        """Advance up to so many blocks with what :meth:`followed` takes, the same in each.

        Args:
            u_sg: inputs of each group.
            N_ref: governed speed, rad/s, which need not be the unit's.
        """
        full = self.apu.gas_generator.full(theta)
        links = [np.append(N_ref, link[1:]) for link in self._links]
        each = zip(u_sg, self.machines, links, strict=True)
        held = [a for u, m, link in each for a in (u, m.theta, link, m.parameters, m.dt)]
        if asking():
            carry = np.concatenate([*state, *x_sg])
            return self._row(min(blocks, self._likely), carry, [u, full, *held])
        return self.followed(state, x_sg, repeat([u, full, *held], blocks))

    def _row(self, blocks: int, carry: np.ndarray, held: Sequence[Any]) -> BlockResult:
        """Advance by a row of blocks, one question to the ensemble, up to the first not right."""
        last, *out = self._call.in_a_row(blocks, carry, *held)
        return self._right(last, out)

    def _right(self, last: np.ndarray, out: Sequence[np.ndarray]) -> BlockResult:
        """Return what blocks gave up to the first that is not right.

        Args:
            last: states at their ends, a column for each.
            out: outputs of all, side by side.

        Raises:
            NotApplicable: the first is not; step by step it is decided why, and what to do.
        """
        blocks = last.shape[1]

        def part(first: int, end: int) -> list[np.ndarray]:
            """Outputs of some blocks, which have one column a step, or one a sample."""
            widths = (a.shape[1] // blocks for a in out)
            return [a[:, first * n : end * n] for a, n in zip(out, widths, strict=True)]

        right, wrong = blocks, self._wrong(last, *out)
        if wrong:
            each = (self._wrong(last[:, i], *part(i, i + 1)) for i in range(blocks))
            right, wrong = next(((i, w) for i, w in enumerate(each) if w), (blocks, ""))
        # a row of which nothing can be taken costs as much as one that is right
        self._likely = 1 if wrong else 2 * self._likely
        if not right:
            raise NotApplicable(wrong)
        return self._parted(last[:, right - 1].copy(), part(0, right))

    def followed(
        self, state: UnitState, x_sg: Sequence[np.ndarray], held: Iterable[Sequence[Any]]
    ) -> BlockResult:
        """Advance a block for each of ``held``, as far as they may go, and are right.

        Args:
            state: at the start.
            x_sg: state of each group.
            held: all that :func:`block_function` takes beside the state.

        Raises:
            NotApplicable: the first is not; step by step it is decided why, and what to do.
        """
        carry, most = np.concatenate([*state, *x_sg]), self._likely
        lasts, made = list[np.ndarray](), list[tuple[np.ndarray, ...]]()
        for given in held:
            last, *out = self._call(carry, *given)
            carry = last.copy()
            lasts.append(carry)
            made.append(tuple([a.copy().reshape(a.shape[0], -1) for a in out]))
            if len(made) >= most or not self._seems_right(out):
                break
        out = [c[0] if len(c) == 1 else np.concatenate(c, axis=1) for c in zip(*made, strict=True)]
        return self._right(np.stack(lasts, axis=1), out)

    def terms(self, group: int, values: np.ndarray) -> np.ndarray:
        """Return the polynomials of a group where the calls of a wide block need not copy them."""
        if asking():
            return values
        room: np.ndarray = self._call.inputs[3 + (len(_Machine._fields) + 1) * group + 3]
        room[...] = values
        return room

    def _parted(self, carry: np.ndarray, out: Sequence[np.ndarray]) -> BlockResult:
        """Return the parts of the state at the end of blocks, and of their outputs."""
        y, _, *rest = out
        ends = np.cumsum([0, 1, self._n_z, self._n_gov, *self._n_x]).tolist()
        N, z, x_gov, *x1 = (carry[i:j] for i, j in pairwise(ends))
        groups = []
        for x, sampled in zip(x1, self._sampled, strict=True):
            means, (*_, w_r), *rest = rest
            waves = np.empty((0, 0))
            if sampled:
                waves, *rest = rest
            groups.append(MachineBlock(x, means, w_r, waves))
        return BlockResult(UnitState(N, z, tuple(x_gov.tolist())), y, groups)

    def _seems_right(self, out: Sequence[np.ndarray]) -> bool:
        """Look at the largest error of a block only: all is checked for a row of them at once."""
        at = 3
        for m, sampled in zip(self.machines, self._sampled, strict=True):
            if not out[at][:-1].max() <= m.limits.max():
                return False
            at += 2 + sampled
        return True

    def _wrong(
        self, last: np.ndarray, _y: np.ndarray, residual: np.ndarray, *rest: np.ndarray
    ) -> str:
        """Return why a block cannot be taken; "" if it can."""
        self.at_fault = None
        if not (residual.max() <= RESIDUAL_TOL and math.isfinite(last.sum())):
            return "a step of the block is not right: the cycle's residual"
        for k, (m, sampled) in enumerate(zip(self.machines, self._sampled, strict=True)):
            (means, checks), rest = rest[:2], rest[2 + sampled :]
            w_r = checks[-1]
            good = (
                (checks[:-1].max(axis=1) <= m.limits).all()
                and math.isfinite(means.sum())
                and m.valid(float(w_r.min()))
                and m.valid(float(w_r.max()))
            )
            if not good:
                self.at_fault = k
                return f"{m.ss.name}: a step of the block is not right"
        return ""


def _caller(
    family: CycleFunctions,
    link: Link,
    machines: Sequence[Fast],
    steps: int,
    terms: tuple[int, ...],
) -> Together:
    """One compiled block for each structure of gas generator, link and machines, and layout."""

    def make() -> Together:
        kind = "joint_course_" if terms else "joint_block_" if steps > 1 else "joint_one_"
        name = kind + "_".join(f"{m.ss.name}_{m.n_out}" for m in machines)
        function = block_function(machines, family.step, link, name, steps=steps, terms=terms)
        # single steps by tables are a tenth of a block
        small = 1 if any(isinstance(m, Collocated) for m in machines) else BLOCK / steps
        often = max(1, round(OFTEN * min(1, BLOCK / steps)))
        one = Gradual(function, level=3, copy=False, by=points_in_lanes, often=often)
        return Together(function, function, one, small=small)

    key = (link.structure, steps, terms, *(m.layout for m in machines), backend_in_use())
    return keep(family, JointBlock, key, make)
