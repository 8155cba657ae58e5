"""The second steady point of two fixed quantities, and which of the two counts.

Shaft power at given fuel flow (or T4, T5, P3) has a maximum over speed where the efficiencies have
one, so two speeds give the same power: (PW, Wf), (PW, T4), a load law and fuel, and others without
N.  Along one speed line pressure ratio has a maximum near surge, so (N, P3) may have two points,
too.  Both solve the equations; where they meet is a fold, beyond which there is none.

**Rule.**  Of the points within the limits, the one on the design point's side of the fold counts:
the determinant of the Jacobian has the sign that it has at the design point, so that one comes
there from the design point without meeting a fold.  If only the other one lies within the limits,
that one is the answer.  Either way the answer tells of the second point.

The second point is sought by marching up and down from the first, in speed, or in T4 where speed
or P3 is fixed: with one of the two quantities fixed, until the other one has its asked value again.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.gaspath.stations import Z
from apu_casadi.gaspath.steady.steadypoint import Limits, Status, limit_status
from apu_casadi.gaspath.steady.trimkernel import DIRECT, LAW, N_FIRST, N_W, Output
from apu_casadi.gaspath.steady.trimsolver import Solver, norms, origin_of, solver_of

FIRST_STEP = 1e-3  # relative, of speed or T4; points closer than this count as one
STEP = 0.02  # later steps; a pair of further points closer than this is not found
SMALLEST_STEP = 3e-4  # where no solution is found at the next speed
MAX_STEPS = 100
SECANTS = 6  # steps of the search between two speeds
WITH_SPEED = ("Wf", "T4", "T5", "T41", "T50", "T8", "PW")
"""Quantities that rise along a speed line with fuel flow and so determine a point together with
speed, the preferred ones first.  Pressure ratio has a maximum near surge on many lines."""


class Roots(NamedTuple):
    """Steady points of a batch, by columns; NaN where there is none.

    w, y : as in :class:`~apu_casadi.gaspath.steady.trimkernel.Output`.
    residual : max-norm of the equations.
    """

    w: np.ndarray
    y: np.ndarray
    residual: np.ndarray

    def or_else(self, other: Roots, where: np.ndarray) -> Roots:
        """Return these points, and those of ``other`` where the mask says so."""
        return Roots(*(np.where(where, b, a) for a, b in zip(self, other, strict=True)))


def may_fold(spec: tuple[str, str]) -> bool:
    """Whether two quantities may have two steady points."""
    return "N" not in spec or not any(n in WITH_SPEED for n in spec)


def on_design_side(
    solver: Solver, w: np.ndarray, p: np.ndarray, *, compile: bool = False
) -> np.ndarray:
    """Whether the determinant of the Jacobian has its sign of the design point, by columns."""
    origin, s0 = origin_of(solver)
    design = float(solver.one("side", s0, origin)[0][0])
    s = solver.sought(w)
    made: np.ndarray = solver.many("side", s, p, n_threads=1, compile=compile)[0][0] * design > 0
    return made


def settle(
    solver: Solver, limits: Limits, solved: Roots, p: np.ndarray, *, compile: bool = False
) -> tuple[Roots, Roots]:
    """Return the points that count and the second points within the limits, by columns.

    Args:
        solved: M points.
        p: what was asked for, shape (n_p, M).
        compile: whether many points are worth compiling for.
    """
    found = second_points(solver, limits, solved.w, p, compile=compile)
    there = np.isfinite(found.residual)
    broken = limit_status(solver.gg, limits, solved.y) != Status.SOLVED
    swap = there & broken
    both = np.flatnonzero(there & ~broken)
    if both.size:
        swap[both] = ~on_design_side(solver, solved.w[:, both], p[:, both], compile=compile)
    first, other = solved.or_else(found, swap), found.or_else(solved, swap)
    out = swap & broken  # the first point did not count: the one that does may have a second one
    other = other.or_else(_none(solver.gg, p.shape[1]), out)
    again = np.flatnonzero(out)
    if again.size:
        inside = Roots(*(a[..., again] for a in first))
        pair = settle(solver, limits, inside, p[:, again], compile=compile)
        for mine, new in zip((first, other), pair, strict=True):
            for a, b in zip(mine, new, strict=True):
                a[..., again] = b
    return first, other


def _none(gg: GasGenerator, M: int) -> Roots:
    return Roots(np.full((N_W, M), np.nan), np.full((len(gg.Y), M), np.nan), np.full(M, np.nan))


def second_points(
    solver: Solver, limits: Limits, w: np.ndarray, p: np.ndarray, *, compile: bool = False
) -> Roots:
    """Return for each solved point another one within the limits; NaN where none was found."""
    out = _none(solver.gg, w.shape[1])
    for direction in (-1.0, 1.0):
        todo = np.flatnonzero(np.isnan(out.residual))
        if todo.size:
            found = _March(solver, limits, w[:, todo], p[:, todo], direction, compile).run()
            for mine, new in zip(out, found, strict=True):
                mine[..., todo] = new
    return out


_End = tuple[np.ndarray, np.ndarray, np.ndarray]


class _March:
    """Search in one direction of speed, or T4: where has the open quantity its value again?"""

    def __init__(
        self,
        solver: Solver,
        limits: Limits,
        w: np.ndarray,
        p: np.ndarray,
        direction: float,
        compile: bool,
    ) -> None:
        self.solver, self.limits, self.w0, self.p, self.compile = solver, limits, w, p, compile
        spec = solver.kernel.spec
        if "N" in spec:
            self.march, held = "T4", "N"
        elif "P3" in spec and "T4" not in spec:  # T4 and P3 give the flow, and so the map's point
            self.march, held = "T4", "P3"
        else:
            self.march = "N"
            held = next((n for n in WITH_SPEED if n in spec), next(n for n in spec if n != LAW))
        self.row = DIRECT["N"] if self.march == "N" else Z.index("T4")
        self.open = next(n for n in spec if n != held)
        self.aside = solver_of(solver.gg, tuple(sorted((self.march, held))))
        self.march_first = self.aside.kernel.spec[0] == self.march
        self.at: dict[str, slice] = {}
        k = N_FIRST
        for n in spec:
            self.at[n] = slice(k, k + (3 if n == LAW else 1))
            k = self.at[n].stop
        self.held = p[self.at[held]]
        self.direction = direction
        span = _speeds if self.march == "N" else _temperatures
        self.lo, self.hi, self.unit = span(solver.gg, limits, p)

    def _solve(self, i: np.ndarray, x: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return w, the gap of the open quantity, and whether solved, at speeds or T4 ``x``."""
        pair = [x[None], self.held[:, i]]
        q = np.vstack([self.p[:N_FIRST, i], *(pair if self.march_first else pair[::-1])])
        w = w.copy()
        w[self.row] = x
        s = self.aside.sought(w)
        out = Output(*self.aside.many("warm", s, q, n_threads=1, compile=self.compile))
        return out.w, self._gap(i, out.y), norms(out.r) <= RESIDUAL_TOL

    def _gap(self, i: np.ndarray, y: np.ndarray) -> np.ndarray:
        Y, asked = self.solver.gg.Y, self.p[self.at[self.open]][:, i]
        if self.open == LAW:
            ref, N_ref, k = asked
            made: np.ndarray = y[Y.index("PW")] / (ref * (y[Y.index("N")] / N_ref) ** k) - 1
            return made
        made = (y[Y.index(self.open)] - asked[0]) / Y[self.open].nominal
        return made

    def run(self) -> Roots:
        """March until the gap changes its sign, the range ends or there is no solution."""
        M, x0 = self.w0.shape[1], self.w0[self.row]
        out = _none(self.solver.gg, M)
        w, x, h = self.w0.copy(), x0.copy(), np.full(M, FIRST_STEP)
        gap = np.full(M, np.nan)  # at the last place; unknown at the first point itself
        going, stopped = np.ones(M, bool), np.zeros(M, bool)
        for _ in range(MAX_STEPS):
            i = np.flatnonzero(going)
            if not i.size:
                break
            x_new = x[i] + self.direction * h[i] * self.unit[i]
            w_new, g, good = self._solve(i, x_new, w[:, i])
            changed = good & (g * gap[i] < 0)
            if changed.any():
                k = i[changed]
                a, b = (x[k], gap[k], w[:, k]), (x_new[changed], g[changed], w_new[:, changed])
                for mine, new in zip(out, self._between(k, a, b), strict=True):
                    mine[..., k] = new
            at = i[good]
            w[:, at], x[at], gap[at] = w_new[:, good], x_new[good], g[good]
            h[at] = np.where(stopped[at], h[at], STEP)
            stopped[i[~good]] = True
            h[i[~good]] /= 2
            going[i] = ~changed & (h[i] >= SMALLEST_STEP)
            going[i] &= (x[i] > self.lo[i]) & (x[i] < self.hi[i])
        return out

    def _between(self, k: np.ndarray, a: _End, b: _End) -> Roots:
        """Return the points between two places where the gap is 0; NaN if beyond the limits.

        Each end is places, gaps and w of the points ``k``.
        """
        (xa, ga, wa), (xb, gb, wb) = a, b
        lost = np.zeros(k.size, bool)
        for _ in range(SECANTS):
            t = np.clip(ga / (ga - gb), 0.1, 0.9)
            x = xa + t * (xb - xa)
            w, g, good = self._solve(k, x, wa + t * (wb - wa))
            lost |= ~good
            low = g * ga > 0
            xa, xb = np.where(low, x, xa), np.where(low, xb, x)
            ga, gb = np.where(low, g, ga), np.where(low, gb, g)
            wa, wb = np.where(low, w, wa), np.where(low, wb, w)
        s = self.solver.sought(wa)
        out = Output(*self.solver.many("warm", s, self.p[:, k], n_threads=1, compile=self.compile))
        found, margin = out.w[self.row], 1e-6 * np.abs(xa)
        residual = norms(out.r)
        good = ~lost & (residual <= RESIDUAL_TOL)
        good &= (found >= np.minimum(xa, xb) - margin) & (found <= np.maximum(xa, xb) + margin)
        good &= limit_status(self.solver.gg, self.limits, out.y) == Status.SOLVED
        return _none(self.solver.gg, k.size).or_else(Roots(out.w, out.y, residual), good)


def _speeds(
    gg: GasGenerator, limits: Limits, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lowest and highest speeds that the limits allow, and the design's, rad/s.

    The design's is that of equal corrected speed.
    """
    choice = gg.compressor_map
    u = np.vstack([np.zeros((2, p.shape[1])), p[: len(gg.U) - 2]])
    T1 = np.asarray(gg.family.ambient.map(u.shape[1])(u))[2]
    unit = gg.parameters.N * np.sqrt(T1 / gg.design.values["T2"])
    n = choice.table.N / choice.N_map_des
    reach = min(limits.off_map, 1.0) * float(n[-1] - n[0])
    return max(n[0] - reach, 0.05) * unit, (n[-1] + reach) * unit, unit


def _temperatures(
    gg: GasGenerator, limits: Limits, p: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lowest and highest T4 that come into question, and the design value, K."""
    T4, one = gg.parameters.T4, np.ones(p.shape[1])
    top = next(value for _, name, _, value in limits.rows(gg) if name == "T4")
    return 0.25 * T4 * one, min(top, 1.5 * T4) * one, T4 * one
