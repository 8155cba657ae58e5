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
``SPIKE`` bounds what the terminal voltage shows for a moment, which counts by its area.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, NamedTuple, TypeVar

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
#: Largest jump of a fault loop's voltage, of the phase's: means move by a hundredth of it.
SPIKE = 1e-4
#: s, from which on mild faults take longer strides, and a growing fault is parted where it becomes
#: severe: their tables take as long as a minute of steps gains.
LONG = 100.0
TERMS = 4  # of polynomials that steps are given, each for as many steps as it fits ...
_EQUAL = 1e-11  # ... to this error, as of ``TOL``; where these are fewer than ``FEWEST`` ...
FEWEST = 20
MOST_TERMS = DEGREES[-1] + 1  # ... those of the whole piece, which take longer
_INSIDE = 1e-7  # share of an interval that nodes keep from its ends, where profiles may jump
#: Products of numbers up to which BLAS does not start threads; with them, waiting takes longer.
_ONE_THREAD = 250_000

F = TypeVar("F", MeanStep, Propagator)


class Numbers(NamedTuple):
    """What steps take, one column each but for the first.

    Args:
        terms: numbers of what propagates (:attr:`MeanStep.vector`) as polynomials of ``TERMS`` or
            of ``MOST_TERMS``, (numbers, terms).
        basis: the terms in each step, (terms, steps).
        u: inputs, (nu, steps); speed, reference and noise among them do not count.
        theta: parameters as compiled functions take them, (ntheta, steps).
        severity: of the fault, in the order of its ``severities``, (severities, steps).
    """

    terms: np.ndarray
    basis: np.ndarray
    u: np.ndarray
    theta: np.ndarray
    severity: np.ndarray

    @property
    def vector(self) -> np.ndarray:
        """Numbers of what propagates in the first step."""
        return np.asarray(self.terms @ self.basis[:, 0])

    @classmethod
    def alike(cls, vector: np.ndarray, steps: int, *each: np.ndarray) -> Numbers:
        """Return those of steps that are all alike: u, theta and severity are given."""
        columns = (np.repeat(a[:, None], steps, axis=1) for a in each)
        return cls(*_constant(vector, steps), *columns)


def _constant(vector: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ``terms`` and ``basis`` of numbers that do not change."""
    terms, basis = np.zeros((vector.size, TERMS), order="F"), np.zeros((TERMS, steps))
    terms[:, 0], basis[0] = vector, 1.0
    return terms, basis


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

    def __contains__(self, s: float) -> bool:
        return abs(s - self.middle) <= self.half * (1 + 2 * _INSIDE)

    def at(self, s: np.ndarray, columns: slice | list[int]) -> np.ndarray:
        """Return some of the numbers at values of the coordinate, (steps, columns)."""
        basis, powers = self.basis(s), self.powers[:, columns]
        made, size = np.empty((s.size, powers.shape[1])), max(1, _ONE_THREAD // basis.size)
        for k in range(0, made.shape[1], size):
            np.matmul(basis, powers[:, k : k + size], out=made[:, k : k + size])
        return made

    def basis(self, s: np.ndarray) -> np.ndarray:
        """Chebyshev polynomials at values of the coordinate, (steps, degree + 1)."""
        x = np.clip((s - self.middle) / self.half, -1.0, 1.0)
        made: np.ndarray = np.cos(np.arccos(x)[:, None] * np.arange(self.powers.shape[0]))
        return made

    def near(self, s: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the first numbers at values of the coordinate by polynomials of a low degree.

        Returns:
            ``terms`` and ``basis`` of :class:`Numbers`; None where these are not equal to
            ``_EQUAL``.
        """
        low, high = float(s.min()), float(s.max())
        middle, half = (low + high) / 2, (high - low) / 2
        numbers = slice(0, count)
        if not half > 0:
            return _constant(self.at(s[:1], numbers)[0], s.size)
        values = self.at(middle + half * _NEAR, numbers)
        terms = _FIT @ values[:TERMS]
        off = np.abs(_CHECK @ terms - values[TERMS:]) * self.weights[numbers]
        if off.max() > _EQUAL:
            return None
        basis = np.polynomial.chebyshev.chebvander((s - middle) / half, TERMS - 1)
        return terms.T, basis.T

    def whole(self, s: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the same by the polynomials of the piece, filled up with zeros."""
        terms, basis = np.zeros((MOST_TERMS, count)), np.zeros((s.size, MOST_TERMS))
        degrees = self.powers.shape[0]
        terms[:degrees], basis[:, :degrees] = self.powers[:, :count], self.basis(s)
        return terms.T, basis.T


class Course(Generic[F]):
    """A load and a fault on their way through a run, beside one model variant.

    Args:
        gen, ss: generator and its variant for this load and this fault.
        load, fault: at least one of them changes in time.
        prepare: (u, theta, harmonics at least) -> what propagates with these numbers.
        end, begin: of what is asked for, s.
        usual: harmonics where the course is over soon.
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
        usual: int = 0,
    ) -> None:
        self.gen, self.ss, self.load, self.fault = gen, ss, load, fault
        self._prepare: Callable[[np.ndarray, np.ndarray, int], F] = prepare
        parts: list[Varying[Any]] = [x for x in (load, fault) if isinstance(x, Varying)]
        self._profiles = profiles = [p for x in parts for p in x.profiles.values()]
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
        # harmonics of the rotor angle, which decide on strides
        self._least = 0 if end - begin > LONG else usual
        self._likely = 1 << 20  # steps that one polynomial may well fit

    # -- the coordinate -------------------------------------------------------------------------

    def _coordinate(self, t: np.ndarray) -> np.ndarray:
        return t if self._only is None else self._only(t)

    def _made(self, part: Any, s: float) -> Any:
        if not isinstance(part, Varying):
            return part
        if self._only is None:
            return part.at(s)
        return part.with_values(dict.fromkeys(part.profiles, s))

    def extremes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return u and theta where a profile is least or largest, of the same model variant."""
        at, found = np.array(self._ends), []
        if self._only is None:
            courses = [p(at) for p in self._profiles]
            at = np.unique([at[k] for v in courses for k in (v.argmin(), v.argmax())])
        for s in at.tolist():
            try:
                load, fault = self._made(self.load, s), self._made(self.fault, s)
            except ApuError:  # it cannot be there, and will be refused there
                continue
            if self.gen.variant(load, fault) == self.ss:
                found.append((self.gen.inputs(load), self.gen.fault_vector(load, fault)))
        return found

    # -- numbers --------------------------------------------------------------------------------

    def numbers(self, t: np.ndarray, before: float | None = None) -> tuple[F, Numbers]:
        """Return what propagates over the first of some steps, as many as go together.

        Args:
            t: middles of the steps, s.
            before: the middle of the step before them, if the first goes on from it.

        Returns:
            What propagates, and its numbers in as many steps as its polynomials fit: the first at
            least.

        Raises:
            NotApplicable: the numbers change too fast from step to step, or have no polynomial.
        """
        s = self._coordinate(np.asarray(t, dtype=float))
        piece = self._piece(float(s[0]))
        if not (float(s.min()) in piece and float(s.max()) in piece):
            s = s[: next(k for k, v in enumerate(s) if k and float(v) not in piece)]
        a, fast = piece.fast.vector.size, piece.fast
        count = most = min(s.size, self._likely)
        while (near := piece.near(s[:count], a)) is None and count > FEWEST:
            count = max(FEWEST, (count + 1) // 2)
        if near is None:
            count, near = s.size, piece.whole(s, a)
        else:
            self._likely = max(2 * count, self._likely if count == most else 0)
        first = s[0] if before is None else float(self._coordinate(np.array([before]))[0])
        s = s[: self._smooth(piece, s[:count], first)]
        rest = piece.at(s, slice(a, None)).T
        b, c = len(self.ss.u), len(self.ss.u) + fast.theta.size
        terms, basis = near[0], near[1][:, : s.size]
        return fast, Numbers(terms, basis, rest[:b], rest[b:c], rest[c:])

    def refine(self) -> bool:
        """Take finer strides from now on, where a step was refused; return whether there are any.

        Under a light load what follows a jump of the fault falls between the coarsest.
        """
        found = [p.fast.finer for p in self._pieces.values() if isinstance(p, Piece)]
        if max(found, default=0) <= self._least:
            return False
        self._least = max(found)
        self._pieces.clear()
        return True

    def _smooth(self, piece: Piece[F], s: np.ndarray, first: float) -> int:
        """Return how many steps change smoothly enough, of which ``first`` is before.

        Raises:
            NotApplicable: not even the first.
        """
        fast, own = piece.fast, piece
        if first not in piece:
            try:
                own = self._piece(first)
            except NotApplicable:  # a model of its own, or none
                own = piece
        jumps, spikes = self._jumps(own, piece, s, first), self._spikes(own, piece, s, first)
        rough = np.flatnonzero((jumps > fast.smooth) | (spikes > SPIKE))
        count = int(rough[0]) if rough.size else s.size
        if not count and jumps[0] > fast.smooth:
            raise NotApplicable(
                f"{self.ss.name}: load or fault change by {jumps[0]:.1e} of the transition "
                f"matrices in a step, {fast.smooth:g} at most"
            )
        if not count:
            raise NotApplicable(
                f"{self.ss.name}: the fault's resistance changes by a voltage of {spikes[0]:.1e} "
                f"of the phase's in a step, {SPIKE:g} at most"
            )
        fast.expect(float(jumps[:count].max()))
        return count

    @staticmethod
    def _jumps(before: Piece[F], piece: Piece[F], s: np.ndarray, first: float) -> np.ndarray:
        """Return bounds of the largest change of a transition matrix in each step."""
        moved = np.abs(np.diff(s, prepend=first))
        rates = np.interp(s, piece.nodes, piece.rates)
        rates[0] = max(rates[0], np.interp(first, before.nodes, before.rates))
        return np.asarray(rates * moved)

    def _spikes(self, before: Piece[F], piece: Piece[F], s: np.ndarray, first: float) -> np.ndarray:
        """Return the jump of a fault loop's voltage in each step, of the phase's.

        Where the loop's current is a state of its own the terminal voltage shows it, until the
        current has followed: within L/R, which no sample of the exciter's input resolves.
        """
        if "i_fault" not in self.ss.x or not isinstance(self.fault, Varying):
            return np.zeros(s.size)
        names = list(self._made(self.fault, float(s[0])).severity)
        columns = [names.index(n) - len(names) for n in ("mu", "k_rf")]
        rows = [before.at(np.array([first]), columns), piece.at(s, columns)]
        mu, k_rf = np.concatenate(rows).T
        R = k_rf + 1 - mu  # of r_s: the fault's, and that of the turns
        return np.asarray(mu[1:] * np.abs(np.diff(R)) / R[1:])

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
        """Return the polynomials of [a, b]; None where none of ``DEGREES`` is enough.

        Or where tables differ in the harmonics that they need, and the interval is long.
        """
        middle, half = (a + b) / 2, (b - a) / 2
        reach, made = half * (1 - _INSIDE), dict[float, tuple[F, np.ndarray]]()
        least = self._least
        for degree in DEGREES:
            nodes: np.ndarray = _lobatto(degree)
            between: np.ndarray = _lobatto(2 * degree)[1::2]
            if degree >= 8:  # two of them tell enough: one has the largest error of its kind
                between = between[[0, degree // 2]]
            wanted = [float(x) for x in (*nodes, *between)]
            ends = (wanted[0], wanted[degree])  # which tell most of what the others need
            for some in (ends, wanted):
                tables = [self._table(middle + reach * x, made, x, least) for x in some]
                needed = max(t[0].harmonics for t in tables)
                if any(t[0].harmonics != needed for t in tables):
                    if self._only is None and b - a > 2 * LONG:
                        return None
                    made.clear()
                    least = needed
                    tables = [self._table(middle + reach * x, made, x, least) for x in some]
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
        self, s: float, made: dict[float, tuple[F, np.ndarray]], x: float, harmonics: int
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


def _lobatto(degree: int) -> np.ndarray:
    """Chebyshev-Lobatto nodes of [-1, 1], increasing; those of twice the degree hold them."""
    return np.asarray(-np.cos(np.pi * np.arange(degree + 1) / degree))


#: Places in [-1, 1] of values that a polynomial of ``TERMS`` terms goes through, and some between.
_NODES, _BETWEEN = _lobatto(TERMS - 1), np.array([-0.8, 0.3])
_NEAR = np.append(_NODES, _BETWEEN)
_FIT = np.linalg.inv(np.polynomial.chebyshev.chebvander(_NODES, TERMS - 1))
_CHECK = np.polynomial.chebyshev.chebvander(_BETWEEN, TERMS - 1)
