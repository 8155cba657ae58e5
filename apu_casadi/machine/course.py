"""What exact propagation needs of a load and a fault that change in time.

Their numbers enter the transition matrices of :mod:`apu_casadi.machine.transition`, and a table of
these costs as much as a hundred exchange steps.  But along a smooth course everything is a smooth
function of one number, the time, or the value of the profile where there is only one, given by
points: tables are computed at a few of its Chebyshev nodes and interpolated in between.  An
interval is halved until the polynomial of degree ``DEGREES`` agrees with tables between its nodes
to ``TOL``; it is never laid across a jump or a bend of a profile.

A run holds all numbers over an exchange step.  The windings see a small jump at its beginning, and
what follows it within microseconds falls between the samples of propagation; ``smooth`` of what
propagates bounds the jump; beyond it steps are left to an adaptive integrator, as after a switch.
``spike`` bounds what the terminal voltage shows for a moment and the regulator takes for true.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np

from apu_casadi.core.errors import ApuError, NotApplicable
from apu_casadi.core.profiles.profile import Profile, Varying
from apu_casadi.machine.faults.fault import Fault
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.loads.load import Load
from apu_casadi.machine.meanstep import MeanStep
from apu_casadi.machine.propagation import Propagator

DEGREES = (2, 4, 8, 16)  # of polynomials that are tried, each checked at nodes of the next
TOL = 1e-8  # largest error of transition matrices between nodes, nominal units; of others relative
DEEPEST = 16  # times that an interval may be halved
#: Products of numbers up to which BLAS does not start threads; with them, waiting takes longer.
_ONE_THREAD = 250_000
_NEAR = (2, 4)  # degrees of polynomials over a small part of an interval, the first enough ...
_EQUAL = 1e-12  # ... and their largest error, as of ``TOL``
_INSIDE = 1e-7  # share of an interval that nodes keep from its ends, where profiles may jump

F = TypeVar("F", MeanStep, Propagator)
#: Where the next block's vectors are to be written, (numbers, steps) column by column; None: apart.
Into: TypeAlias = Callable[[], np.ndarray | None]


class Numbers(NamedTuple):
    """What steps take, one column each.

    Args:
        vector: numbers of what propagates (:attr:`MeanStep.vector`), (numbers, steps).
        u: inputs, (nu, steps); speed, reference and noise among them do not count.
        theta: parameters as compiled functions take them, (ntheta, steps).
        severity: of the fault, in the order of its ``severities``, (severities, steps).
    """

    vector: np.ndarray
    u: np.ndarray
    theta: np.ndarray
    severity: np.ndarray


@dataclass(frozen=True, eq=False)
class Piece(Generic[F]):
    """Polynomials over an interval of the coordinate.

    Args:
        fast: propagates; its numbers are to be replaced.
        middle, half: of the interval.
        powers: coefficients of Chebyshev polynomials, (degree + 1, numbers).
        weights: of errors of the numbers, which make them nominal or relative.
        nodes, rates: values of the coordinate, and the largest rate of change of a transition
            matrix there, nominal units.
    """

    fast: F
    middle: float
    half: float
    powers: np.ndarray
    weights: np.ndarray
    nodes: np.ndarray
    rates: np.ndarray
    buffers: dict[tuple[int, int], np.ndarray] = field(default_factory=dict, repr=False)

    def at(self, s: np.ndarray) -> np.ndarray:
        """Return all numbers at values of the coordinate, (numbers, steps).

        The next call for as many steps overwrites them: new memory costs as much as the sums.
        """
        basis = self.basis(s)
        return self.summed(basis, self.room(s.size, self.powers.shape[1]).T).T

    def room(self, steps: int, numbers: int) -> np.ndarray:
        """Return memory that is used again, (numbers, steps), column by column."""
        key = steps, numbers
        if key not in self.buffers:
            self.buffers[key] = np.empty(key)
        return self.buffers[key].T

    def summed(self, basis: np.ndarray, made: np.ndarray) -> np.ndarray:
        """Sum the first numbers by polynomials at some values into ``made``, (steps, numbers)."""
        size = max(1, _ONE_THREAD // basis.size)
        for k in range(0, made.shape[1], size):
            part = made[:, k : k + size]
            np.matmul(basis, self.powers[:, k : k + part.shape[1]], out=part)
        return made

    def some(self, s: np.ndarray, columns: list[int]) -> np.ndarray:
        """Return some of the numbers at values of the coordinate, (steps, columns)."""
        made: np.ndarray = self.basis(s) @ self.powers[:, columns]
        return made

    def basis(self, s: np.ndarray) -> np.ndarray:
        """Chebyshev polynomials at values of the coordinate, (steps, degree + 1)."""
        x = np.clip((s - self.middle) / self.half, -1.0, 1.0)
        made: np.ndarray = np.cos(np.arccos(x)[:, None] * np.arange(self.powers.shape[0]))
        return made

    def near(self, low: float, high: float) -> Piece[F]:
        """Return polynomials of a low degree over a part of the interval, or itself.

        They take less sums, for many values that lie near each other, and must be equal to
        ``_EQUAL``.
        """
        middle, half = (low + high) / 2, (high - low) / 2
        if not half > 0:
            powers = self.at(np.array([middle])).T.copy()
            return replace(self, middle=middle, half=1.0, powers=powers, buffers={})
        between = np.array([-0.8, 0.3])
        for degree in _NEAR:
            if self.powers.shape[0] <= degree + 1:
                return self
            nodes = _lobatto(degree)
            values = self.at(middle + half * np.append(nodes, between)).T
            fit = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, degree))
            powers = fit @ values[: degree + 1]
            here = np.polynomial.chebyshev.chebvander(between, degree) @ powers
            if (np.abs(here - values[degree + 1 :]) * self.weights).max() <= _EQUAL:
                return replace(self, middle=middle, half=half, powers=powers, buffers={})
        return self


class Course(Generic[F]):
    """A load and a fault on their way through a run, beside one model variant.

    Args:
        gen, ss: generator and its variant for this load and this fault.
        load, fault: at least one of them changes in time.
        prepare: (u, theta, harmonics at least) -> what propagates with these numbers.
        end, begin: of what is asked for, s.
    """

    gen: Generator
    ss: GeneratorModel
    load: Load | Varying[Load]
    fault: Fault | Varying[Fault | None] | None

    def __init__(
        self,
        gen: Generator,
        ss: GeneratorModel,
        load: Load | Varying[Load],
        fault: Fault | Varying[Fault | None] | None,
        prepare: Callable[[np.ndarray, np.ndarray, int], F],
        end: float,
        begin: float = 0.0,
    ) -> None:
        self.gen, self.ss, self.load, self.fault = gen, ss, load, fault
        self._prepare: Callable[[np.ndarray, np.ndarray, int], F] = prepare
        parts: list[Varying[Any]] = [x for x in (load, fault) if isinstance(x, Varying)]
        profiles = [p for x in parts for p in x.profiles.values()]
        # the value of the only profile, where its course in time has many bends
        self._only: Profile | None = (
            profiles[0] if len(profiles) == 1 and profiles[0].by_value else None
        )
        if self._only is not None:
            low, high = self._only.bounds
            self._ends: list[float] = [low, high if high > low else low + max(abs(low), 1e-9)]
        else:
            bends: set[float] = {t for x in parts for t in x.corners(end)}
            self._ends = [begin, *sorted(t for t in bends if t > begin), end]
        self._pieces: dict[tuple[float, float], Piece[F] | str | None] = {}

    # -- the coordinate -------------------------------------------------------------------------

    def _coordinate(self, t: np.ndarray) -> np.ndarray:
        return t if self._only is None else self._only(t)

    def _made(self, part: Any, s: float) -> Any:
        if not isinstance(part, Varying):
            return part
        if self._only is None:
            return part.at(s)
        return part.with_values(dict.fromkeys(part.profiles, s))

    # -- numbers --------------------------------------------------------------------------------

    def numbers(self, t: np.ndarray, before: float | None = None) -> tuple[F, Numbers]:
        """Return what propagates over steps whose middles are ``t``, s, and its numbers.

        The next call overwrites the numbers.  Arguments and errors as of :meth:`blocks`.
        """
        fast, blocks = self.blocks(t, before, t.size, apart)
        return fast, next(blocks)

    def blocks(
        self, t: np.ndarray, before: float | None, width: int, into: Into
    ) -> tuple[F, Iterator[Numbers]]:
        """Return what propagates over steps, and its numbers in blocks.

        Args:
            t: middles of the steps, s.
            before: the middle of the step before them, if the first goes on from it.
            width: steps in a block, whose numbers the next one overwrites.
            into: see ``Into``.

        Raises:
            NotApplicable: the numbers change too fast from step to step, have no polynomial, or
                those of the steps differ in structure.
        """
        s = self._coordinate(np.asarray(t, dtype=float))
        pieces = [self._piece(float(v)) for v in (s.min(), s.max())]
        alone = pieces[0] is pieces[1]
        pieces = pieces[:1] if alone else [self._piece(float(v)) for v in s]
        fast, size = pieces[0].fast, pieces[0].powers.shape[1]
        # as many harmonics of the rotor angle, too, which a layout need not tell
        if any(p.fast.layout != fast.layout or p.powers.shape[1] != size for p in pieces[1:]):
            raise NotApplicable(f"{self.ss.name}: the structure changes on the way")
        first = s[0] if before is None else self._coordinate(np.array([before]))[0]
        jump = self._jump(pieces, s, float(first))
        if jump > fast.smooth:
            raise NotApplicable(
                f"{self.ss.name}: load or fault change by {jump:.1e} of the transition matrices "
                f"in a step, {fast.smooth:g} at most"
            )
        fast.expect(jump)
        spike = self._spike(pieces, s, float(first))
        if spike > fast.spike:
            raise NotApplicable(
                f"{self.ss.name}: the fault's resistance changes by a voltage of {spike:.1e} of "
                f"the phase's in a step, {fast.spike:g} at most"
            )
        if alone:
            one = pieces[0].near(float(s.min()), float(s.max())) if s.size > width else pieces[0]
            pieces = [one] * s.size
        return fast, self._blocks(pieces, s, width, into)

    def _blocks(
        self, pieces: list[Piece[F]], s: np.ndarray, width: int, into: Into
    ) -> Iterator[Numbers]:
        """Yield the numbers of steps, each of its piece."""
        fast, first = pieces[0].fast, pieces[0]
        a = fast.vector.size
        b, c = (n - a for n in (a + len(self.ss.u), a + len(self.ss.u) + fast.theta.size))
        alone = all(p is first for p in pieces)
        if alone:  # all but the long vectors at once
            basis = first.basis(s)
            rest = (basis @ first.powers[:, a:]).T
        for k in range(0, s.size, width):
            at = slice(k, k + width)
            if alone:
                room = into()
                vector = first.room(s[at].size, a) if room is None else room
                first.summed(basis[at], vector.T)
                more = rest[:, at]
            else:
                each = zip(pieces[at], s[at, None], strict=True)
                values = np.concatenate([p.at(v).copy() for p, v in each], axis=1)
                vector, more = values[:a], values[a:]
            yield Numbers(vector, more[:b], more[b:c], more[c:])

    def _jump(self, pieces: list[Piece[F]], s: np.ndarray, first: float) -> float:
        """Return a bound of the largest change of a transition matrix from step to step."""
        moved = s.copy()
        moved[0] -= first
        moved[1:] -= s[:-1]
        rates = (np.interp(s, p.nodes, p.rates) for p in (pieces[0], pieces[-1]))
        return float((np.maximum(*rates) * np.abs(moved)).max())

    def _spike(self, pieces: list[Piece[F]], s: np.ndarray, first: float) -> float:
        """Return the largest jump of a fault loop's voltage from step to step, of the phase's.

        Where the loop's current is a state of its own the terminal voltage shows it, until the
        current has followed: within L/R, which no sample of the exciter's input resolves.
        """
        if "i_fault" not in self.ss.x or not isinstance(self.fault, Varying):
            return 0.0
        names = list(self._made(self.fault, float(s[0])).severity)
        columns = [names.index(n) - len(names) for n in ("mu", "k_rf")]
        at = np.append(first, s)
        if len(pieces) == 1:
            rows = pieces[0].some(at, columns)
        else:
            each = pieces[:1] + pieces
            rows = np.array([p.some(v, columns)[0] for p, v in zip(each, at[:, None], strict=True)])
        mu, k_rf = rows.T
        R = k_rf + 1 - mu  # of r_s: the fault's, and that of the turns
        return float((mu[1:] * np.abs(np.diff(R)) / R[1:]).max())

    def _piece(self, s: float) -> Piece[F]:
        """Return the polynomials around a value of the coordinate, made when first asked for."""
        ends = self._ends
        k = min(max(bisect.bisect_right(ends, s), 1), len(ends) - 1)
        a, b = ends[k - 1], ends[k]
        for _ in range(DEEPEST):
            if (a, b) not in self._pieces:
                try:
                    self._pieces[a, b] = self._fitted(a, b)
                except ApuError as error:  # also of a load or fault that cannot be there
                    self._pieces[a, b] = str(error)
            found = self._pieces[a, b]
            if isinstance(found, Piece):
                return found
            if isinstance(found, str):
                raise NotApplicable(found)
            middle = (a + b) / 2
            a, b = (a, middle) if s < middle else (middle, b)
        raise NotApplicable(f"{self.ss.name}: no polynomial through its numbers converges")

    def _fitted(self, a: float, b: float) -> Piece[F] | None:
        """Return the polynomials of [a, b]; None where none of ``DEGREES`` is enough."""
        middle, half = (a + b) / 2, (b - a) / 2
        reach, made = half * (1 - _INSIDE), dict[float, tuple[F, np.ndarray]]()
        for degree in DEGREES:
            nodes: np.ndarray = _lobatto(degree)
            between: np.ndarray = _lobatto(2 * degree)[1::2]
            if degree >= 8:  # two of them tell enough: one has the largest error of its kind
                between = between[[0, degree // 2]]
            wanted = [float(x) for x in (*nodes, *between)]
            tables = [self._table(middle + reach * x, made, x) for x in wanted]
            harmonics = max(t[0].harmonics for t in tables)
            if any(t[0].harmonics != harmonics for t in tables):
                made.clear()
                tables = [
                    self._table(middle + reach * x, made, x, harmonics=harmonics) for x in wanted
                ]
            fast = tables[0][0]
            if any(t[0].layout != fast.layout for t in tables):
                raise NotApplicable(f"{self.ss.name}: its symmetry changes on the way")
            values = np.array([v for _, v in tables])
            fit = np.linalg.inv(np.polynomial.chebyshev.chebvander(nodes, degree))
            powers = fit @ values[: degree + 1]
            off = np.polynomial.chebyshev.chebvander(between, degree) @ powers
            n, units = fast.vector.size, fast.units
            weights = np.append(units, 1 / (np.abs(values[:, n:]).max(axis=0) + 1e-300))
            if (np.abs(off - values[degree + 1 :]) * weights).max() <= TOL:
                slope = np.polynomial.chebyshev.chebder(powers[:, :n]) * units / reach
                rates = np.abs(np.polynomial.chebyshev.chebvander(nodes, degree - 1) @ slope)
                at = middle + reach * nodes
                return Piece(fast, middle, reach, powers, weights, at, rates.max(axis=1))
        return None

    def _table(
        self, s: float, made: dict[float, tuple[F, np.ndarray]], x: float, *, harmonics: int = 0
    ) -> tuple[F, np.ndarray]:
        """Return what propagates at a value of the coordinate, and all of its numbers."""
        if x in made:
            return made[x]
        load, fault = self._made(self.load, s), self._made(self.fault, s)
        ss, theta = self.gen.variant(load, fault), self.gen.fault_vector(load, fault)
        if ss != self.ss:
            raise NotApplicable(f"{self.ss.name}: on the way it turns into {ss.name}")
        u = self.gen.inputs(load)
        fast = self._prepare(u, theta, harmonics)
        severity = [] if fault is None else list(fault.severity.values())
        severity = [0.0 if math.isnan(v) else v for v in severity]
        made[x] = fast, np.concatenate([fast.vector, u, fast.theta, severity])
        return made[x]


def apart() -> None:
    """Write the vectors of blocks to memory of their own; an ``Into``."""


def _lobatto(degree: int) -> np.ndarray:
    """Chebyshev-Lobatto nodes of [-1, 1], increasing; those of twice the degree hold them."""
    return np.asarray(-np.cos(np.pi * np.arange(degree + 1) / degree))
