"""Plausibility of a component map's numbers: smoothness and order, told cell by cell.

A map may hold any numbers that its ranges allow, yet one slipped decimal point bends the spline
surface over several cells and moves temperatures by tens of kelvin.  What neighbours say is known:

**Cell.**  Each value of ln W, ln PR and eta is predicted from the two or four nearest ones on its
speed line, and likewise along its beta line (cubic in the middle, straight or quadratic at an
edge).  It is implausible if both predictions miss it, in the same direction, by more than a
tolerance: sharp features of sound maps lie along one direction.  The tolerance is ``CELL``, or
``SCATTER`` times what nine of ten cells of the same table are off by, whatever is more: a noisy map
is judged by its own noise.

**Line.**  Swapped or shifted lines are smooth along themselves.  So the means over each speed line
and over each beta line are checked in the same way, and for their order: flow and pressure ratio
of a compressor rise with speed.

**Surge line.**  ln PR over ln W by its neighbours, and rising.

A strange map that is sound can be accepted knowingly: ``check=False`` in
:func:`apu_casadi.gaspath.maps.mapfiles.read_map` or
:class:`~apu_casadi.gaspath.maps.maptable.MapTable`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

CELL = {"W": 0.04, "PR": 0.04, "eta": 0.05}
"""Least deviation of a cell that is implausible: of the logarithm, of eta itself.

The largest in seventeen public maps (pyCycle 4.4.0, both alphas) are 0.006, 0.009 and 0.034, all of
them at edges."""

SPEED_LINE = {
    "W": 0.12,
    "PR": 0.12,
    "eta": 0.07,
}  # of a speed line's mean; found there: 0.05 inside
BETA_LINE = {"W": 0.03, "PR": 0.03, "eta": 0.03}  # of a beta line's mean
SURGE = 0.1  # of the surge line's ln PR
EDGE = 1.6  # a cell's tolerance is so many times larger at an edge, where predictions extrapolate
EDGE_LINE = 2.5  # likewise a line's
SCATTER = 6.0
ORDER = 0.01  # of ln W or ln PR: a fall over speed that is no fall


class Finding(NamedTuple):
    """One implausible number.

    Args:
        name: column, "W", "PR", "eta", "W_surge" or "PR_surge".
        i: place in the table by speed; -1 for a whole beta line; of the surge line its point.
        j: place by beta; -1 for a whole speed line; of the surge line 0.
        value: what is there; of a line its mean.
        expected: what the neighbours say.
        excess: deviation over tolerance.
    """

    name: str
    i: int
    j: int
    value: float
    expected: float
    excess: float


def along(x: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the deviation of each row of v from what its neighbours along x say, and at an edge.

    Args:
        x: sites, shape (n,), rising, n >= 4.
        v: values, shape (n, m).

    Returns:
        deviations, shape (n, m), and a mask of the rows at an edge, shape (n,).

    Prediction by the cubic through four neighbours, two on each side; by three where there are no
    more.  At the ends: the straight line or the parabola, whatever is nearer.  In the middle the
    straight line between two neighbours counts, too: beside another wrong value it is the better.
    """
    n = x.size
    out = np.empty_like(v)
    for i in range(n):
        near = [k for k in range(i - 2, i + 3) if 0 <= k < n and k != i]
        if i in (0, n - 1):
            sides = (1, 2, 3) if i == 0 else (-1, -2, -3)
            choices = [[i + k for k in sides[:2]], [i + k for k in sides]]
        else:
            choices = [near, [i - 1, i + 1]]
        d = np.stack([v[i] - _predict(x, v, i, c) for c in choices])
        out[i] = np.take_along_axis(d, np.abs(d).argmin(axis=0)[None], axis=0)[0]
    edge = np.zeros(n, bool)
    edge[[0, -1]] = True
    return out, edge


def either(x: np.ndarray, v: np.ndarray, *, logs: bool) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`along`; of logarithms the smaller of two deviations, of v itself and of exp(v).

    A quantity that is straight in x, as pressure ratio over beta in many turbine maps, has a
    strongly bent logarithm near 1, and the other way round for what rises exponentially.
    """
    d, edge = along(x, v)
    if not logs:
        return d, edge
    plain = np.exp(np.minimum(v, 300.0))
    expected = plain - along(x, plain)[0]
    other = v - np.log(np.maximum(expected, 1e-300))
    return np.where(np.abs(other) < np.abs(d), other, d), edge


def _predict(x: np.ndarray, v: np.ndarray, i: int, near: list[int]) -> np.ndarray:
    """Lagrange's polynomial through the rows ``near``, at x[i]."""
    weights = [np.prod([(x[i] - x[m]) / (x[k] - x[m]) for m in near if m != k]) for k in near]
    return np.asarray(np.tensordot(weights, v[near], axes=1))


class Deviations(NamedTuple):
    """Of each cell: the smaller of those along both axes, 0 where they disagree; that along the
    speed line; and the factor of its tolerance.
    """

    d: np.ndarray
    on_line: np.ndarray
    edge: np.ndarray


def deviations(N: np.ndarray, beta: np.ndarray, v: np.ndarray, *, logs: bool = True) -> Deviations:
    """Compare each cell with its neighbours along both axes."""
    (dN, edge_N), (db, edge_b) = either(N, v, logs=logs), either(beta, v.T, logs=logs)
    db = db.T
    d = np.where(np.abs(dN) < np.abs(db), dN, db)
    d[np.sign(dN) != np.sign(db)] = 0.0
    return Deviations(d, db, np.where(edge_N[:, None] | edge_b, EDGE, 1.0))


def scatter(d: np.ndarray) -> float:
    """What a table's own noise excuses: ``SCATTER`` times what nine of ten cells are off by."""
    return SCATTER * float(np.quantile(np.abs(d), 0.9))


def cells(name: str, N: np.ndarray, beta: np.ndarray, v: np.ndarray) -> list[Finding]:
    """Return the implausible cells of one quantity; v as it is compared, ln W, ln PR or eta."""
    d, on_line, edge = deviations(N, beta, v, logs=name != "eta")
    excess = np.abs(d) / (max(CELL[name], scatter(d)) * edge)
    return [
        Finding(name, int(i), int(j), v[i, j], v[i, j] - on_line[i, j], float(excess[i, j]))
        for i, j in zip(*np.nonzero(excess > 1), strict=True)
    ]


def lines(
    name: str, N: np.ndarray, beta: np.ndarray, v: np.ndarray, *, rising: bool
) -> list[Finding]:
    """Return the implausible speed and beta lines of one quantity; ``rising``: it must with speed.

    A table's noise is excused as in :func:`cells`, less by the root of the cells in a line.
    """
    logs = name != "eta"
    noise, found = scatter(deviations(N, beta, v, logs=logs).d), []
    for axis, x, least in ((1, N, SPEED_LINE[name]), (0, beta, BETA_LINE[name])):
        mean = v.mean(axis=axis)
        excuse = noise / v.shape[axis] ** 0.5
        d, edge = _line(x, mean, logs=logs)
        excess = np.abs(d) / ((least + excuse) * edge)
        if axis == 1 and rising:
            _falls(mean, d, excess, ORDER + excuse)
        for k in np.flatnonzero(excess > 1):
            i, j = (int(k), -1) if axis == 1 else (-1, int(k))
            found.append(Finding(name, i, j, mean[k], mean[k] - d[k], float(excess[k])))
    return found


def _line(x: np.ndarray, v: np.ndarray, *, logs: bool) -> tuple[np.ndarray, np.ndarray]:
    d, edge = either(x, v[:, None], logs=logs)
    return d[:, 0], np.where(edge, EDGE_LINE, 1.0)


def _falls(v: np.ndarray, d: np.ndarray, excess: np.ndarray, least: float) -> None:
    """Raise the excess of the one of two neighbours that is more off, where v falls."""
    for i in np.flatnonzero(np.diff(v) < -least):
        k = i if abs(d[i]) > abs(d[i + 1]) else i + 1
        excess[k] = max(excess[k], 1.0 + float(v[i] - v[i + 1]))


def surge_points(W: np.ndarray, PR: np.ndarray, noise: float) -> list[Finding]:
    """Return the implausible points of a surge line beside a table with this scatter of ln PR."""
    v = np.log(PR)
    d, edge = _line(np.log(W), v, logs=True)
    excess = np.abs(d) / ((SURGE + noise) * edge)
    _falls(v, d, excess, ORDER + noise)
    return [
        Finding("PR_surge", int(k), 0, v[k], v[k] - d[k], float(excess[k]))
        for k in np.flatnonzero(excess > 1)
    ]


def implausible(
    kind: str,
    N: np.ndarray,
    beta: np.ndarray,
    W: np.ndarray,
    PR: np.ndarray,
    eta: np.ndarray,
    surge: tuple[np.ndarray, np.ndarray] | None = None,
) -> list[Finding]:
    """Return what is implausible in a map, the worst first; lines only if no cell is."""
    up = kind == "compressor"
    tables = (("W", np.log(W), up), ("PR", np.log(PR), up), ("eta", eta, False))
    found = [f for name, v, _ in tables for f in cells(name, N, beta, v)]
    if surge is not None:
        found += surge_points(*surge, scatter(deviations(N, beta, np.log(PR)).d))
    if not found:
        found = [f for name, v, rising in tables for f in lines(name, N, beta, v, rising=rising)]
    found.sort(key=lambda f: -f.excess)
    return [f if f.name == "eta" else _from_log(f) for f in found]


def _from_log(f: Finding) -> Finding:
    with np.errstate(over="ignore"):  # beside a cell of 1e300 anything may be expected
        return f._replace(value=float(np.exp(f.value)), expected=float(np.exp(f.expected)))
