"""Transition matrices of the windings over a sample, for all rotor angles and nearby speeds.

At constant speed the windings, and the load's own states, obey

    dx/dt = A(theta) x + b(theta) E_fd + c(theta),    theta = theta_0 + w_r t,

in the qd0 frame.  Their transition matrix over a sample h,

    x(t + h) = P(theta(t)) [x; E; E'; E''; E'''; 1],     E(t + s) = E + s E' + ... + s^3/6 E''',

is an analytic function of the rotor angle: its Fourier series is cut where it has converged to
``TAIL``, and interpolated in speed.  A, b and c are derivatives of the model's own right-hand side:
no equation is written again.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.backend import backend_in_use, compiled
from apu_casadi.core.calling import Caller, Mapped
from apu_casadi.core.errors import NotApplicable
from apu_casadi.core.lanes.lanelibrary import batch
from apu_casadi.core.sharing import keep, kept, once
from apu_casadi.machine.generatormodel import GeneratorModel

TAIL = 1e-9  # Fourier coefficients below this share of the largest are left out
STAGES = 8  # of the Radau method that P is made by; even where stiff its error falls as steps^-8
FEW = (
    4  # stages where more than two steps are needed, for a stiff branch's sake: as good, and cheap
)
IN_A_ROW = 4  # steps of few stages that are one function; their number is a multiple of it
STEP_TOL = 5e-7  # largest change of P, nominal units, when its steps are halved; then used: 2e-9
#: With many stages it is a 256th of the change: so much is left of it at most where it is stiff,
#: elsewhere some 1e-5.
LEFT = 1 / 256
HARMONICS = (16, 32, 64)  # harmonics resolved, in turn; a series that still goes on is refused
EXTRA = 5  # columns of P beside the windings': E, its first three derivatives, and what is constant
SPEED_RANGE = 0.06  # half width, relative to rated, over which P is interpolated in speed
#: Chebyshev nodes in speed.  Errors of the leaps of a step add up: with four of them the means
#: beside a load of power factor 0.9 erred by 1e-6, with five by 1e-8.
NODES = 5
COMPILE_FROM = 2000  # transition matrices; of so many there may be many more
FEWEST = 8  # of them at once: trials are of few angles
TABLES = (
    256  # kept for a model; a load or a fault that changes in time takes some ten in an interval
)


@dataclass(frozen=True)
class Split:
    """Positions of the parts of a generator's state."""

    linear: list[int]
    slow: list[int]
    angle: int
    drive: int  # E_fd among all states


def split(ss: GeneratorModel) -> Split:
    """Return where windings, exciter and angle stand in the state."""
    linear = ss.x.indices(ss.linear)
    angle, drive = ss.x.index("theta_e"), ss.x.index("E_fd")
    slow = [i for i in range(len(ss.x)) if i not in (*linear, angle)]
    return Split(linear, slow, angle, drive)


@kept
def coefficients(ss: GeneratorModel) -> ca.Function:
    """Function (theta_e, u, theta) -> augmented matrix M of d/dt [x; E; E'; E''; E'''; 1].

    Checks that the model is linear in x and E where it is taken to be.
    """
    s = split(ss)
    x, u, th = ca.SX.sym("x", len(ss.x)), ca.SX.sym("u", len(ss.u)), ca.SX.sym("t", len(ss.theta))
    rate = ss.f(x, u, th)[s.linear]
    own = ca.vertcat(x[s.linear], x[s.drive])
    J = ca.jacobian(rate, own)
    if any(ca.which_depends(ca.vec(ca.densify(J)), own, 1, True)):
        raise NotApplicable(f"{ss.name} is not linear in its windings: use another integrator")
    n = len(s.linear)
    rest = ca.substitute(rate, own, ca.SX.zeros(n + 1))
    M = ca.SX.zeros(n + EXTRA, n + EXTRA)
    M[:n, : n + 1] = J
    M[:n, -1] = rest
    for k in range(n, n + EXTRA - 2):
        M[k, k + 1] = 1
    return ca.Function("M", [x[s.angle], u, th], [ca.densify(M)], {"cse": True})


@once
def radau(stages: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes in (0, 1], the last one 1, and Butcher matrix of a Radau IIA method."""
    c = np.array(ca.collocation_points(stages, "radau"))
    k = np.arange(stages)
    return c, (c[:, None] ** (k + 1) / (k + 1)) @ np.linalg.inv(c[:, None] ** k)


class _Leaps:
    """Steps of the Radau method for many rotor angles at once, of one model structure.

    They are evaluated as they are until that has taken about as long as a compiler would.
    """

    def __init__(self, ss: GeneratorModel, stages: int) -> None:
        self.steps = IN_A_ROW if stages == FEW else 1
        self._function = _radau_function(ss, stages)
        if self.steps > 1:
            self._function = _in_a_row(self._function, self.steps)
        self._asked, self._compiled = 0, False
        self._calls = self._batches(build=False)

    def __call__(self, *columns: np.ndarray) -> np.ndarray:
        """Return the matrices after ``steps``, one in each column; see :func:`_radau_function`."""
        size = columns[0].shape[1]
        self._asked += size * self.steps
        if not self._compiled and self._asked > COMPILE_FROM:
            self._calls, self._compiled = self._batches(build=True), True
        made: np.ndarray = self._calls[size > FEWEST](*columns)[0]
        return made

    def _batches(self, *, build: bool) -> list[Mapped]:
        how: dict[str, Any] = {"common": (5, 6), "build": build}
        return [batch(self._function, 1, chunk=c, **how) for c in (FEWEST, 8 * FEWEST)]


@kept
def _leaps(ss: GeneratorModel, stages: int, _in_use: str) -> _Leaps:
    return _Leaps(ss, stages)


@kept
def _radau_function(ss: GeneratorModel, stages: int) -> ca.Function:
    """Function (theta_0, w_r, h, t, X, u, theta) -> X after a step of h that begins at t.

    X is a transition matrix from theta_0 and t = 0 on, in nominal units, column by column.  The
    stages X_i = X + h sum_j a_ij (M_j X_j + F_j) are eliminated one after the other, by blocks of
    the windings' size; the last one is the result.
    """
    n, (c, a), iw = len(ss.linear), radau(stages), ss.u.index("w_r")
    sizes = {"theta_0": 1, "w": 1, "t": 1, "u": len(ss.u), "theta": len(ss.theta)}
    angle, w, t, u, th = given = [ca.SX.sym(k, size) for k, size in sizes.items()]
    u_now = ca.SX(u)
    u_now[iw] = w
    M = coefficients(ss)(angle + w * t, u_now, th) * _scale(ss)
    drive = ca.SX.zeros(EXTRA, EXTRA)  # E from its derivatives; and one
    drive[0, :-1] = ca.horzcat(*(t**i / math.factorial(i) for i in range(EXTRA - 1)))
    drive[-1, -1] = 1
    parts = [ca.densify(M[:n, :n]), ca.densify(M[:n, n:] @ drive)]
    node = ca.Function("node", given, parts, {"cse": True})
    inverted = inverse(n)

    sizes = {"theta_0": 1, "w": 1, "h": 1, "t": 1, "X": n * (n + EXTRA)}
    sizes |= {"u": len(ss.u), "theta": len(ss.theta)}
    angle, w, h, t, X, u, th = given = [ca.MX.sym(k, size) for k, size in sizes.items()]
    each = [node(angle, w, t + h * float(at), u, th) for at in c]
    M, F = ca.horzcat(*(M for M, _ in each)) * h, ca.horzcat(*(ca.vec(F) for _, F in each))
    forced = ca.mtimes(F, ca.DM(a.T)) * h
    before = ca.reshape(X, n, n + EXTRA)
    rows = []
    for i in range(stages):
        weights, one = np.tile(np.repeat(a[i], n), (n, 1)), np.eye(n, stages * n, i * n)
        driven = before[:, n:] + ca.reshape(forced[:, i], n, EXTRA)
        rows.append(ca.horzcat(ca.DM(one) - ca.DM(weights) * M, before[:, :n], driven))
    row = rows[0]
    for k in range(stages):
        row = ca.mtimes(inverted(rows[k][:, :n]), rows[k][:, n:])
        for i in range(k + 1, stages):
            rows[i] = rows[i][:, n:] - ca.mtimes(rows[i][:, :n], row)
    return ca.Function(f"radau_{stages}_{ss.name}", given, [ca.vec(row)])


def _in_a_row(step: ca.Function, steps: int) -> ca.Function:
    """Return steps of :func:`_radau_function` as one function."""
    angle, w, h, t, X, *fixed = given = step.mx_in()
    for k in range(steps):
        X = step(angle, w, h, t + k * h, X, *fixed)
    return ca.Function(f"{step.name()}_x{steps}", given, [X])


@once
def inverse(n: int) -> ca.Function:
    """Inverse of a matrix with a dominant diagonal; its rows may be of any magnitude."""
    A = ca.SX.sym("A", n, n)
    d = ca.diag(A)
    by_rows = ca.solve(A / ca.repmat(d, 1, n), ca.SX.eye(n)) / ca.repmat(d.T, n, 1)
    return ca.Function("inverse", [A], [ca.densify(by_rows)], {"cse": True})


def _transition(
    ss: GeneratorModel,
    given: tuple[np.ndarray, np.ndarray],
    theta0: np.ndarray,
    w: np.ndarray,
    h: np.ndarray,
    steps: int,
    leaps: int = 1,
    stages: int = STAGES,
) -> list[np.ndarray]:
    """Transition matrices over h, 2 h, ... from angles theta0 at speeds w, by Radau collocation.

    The last three arrays have the shape (angles,); ``given`` are u and theta.  There are ``steps``
    of the method in h, of order 2 stages - 1 (Hairer, Wanner, Solving ODEs II, section IV.5).  It
    is L-stable: a fault branch that settles within nanoseconds, or an open generator, needs no
    smaller steps.

    Returns:
        One array for each leap, shape (angles, n, n + EXTRA): the rows of the windings.
    """
    u, theta = given
    n, hs, out = len(ss.linear), h / steps, []
    step, full = _leaps(ss.shared, stages, backend_in_use()), ss.full(theta)
    X = np.repeat(np.eye(n, n + EXTRA).ravel(order="F")[:, None], theta0.size, axis=1)
    for k in range(0, leaps * steps, step.steps):
        X = step(theta0[None], w[None], hs[None], (k * hs)[None], X, u, full)
        if (k + step.steps) % steps == 0:
            out.append(X.T.reshape(-1, n + EXTRA, n).transpose(0, 2, 1))
    return out


def _radau_step(M: np.ndarray, t: np.ndarray, hs: np.ndarray) -> np.ndarray:
    """Return transition matrices over the first step of the Radau method.

    Args:
        M: coefficients at the nodes, shape (angles, stages, n + EXTRA, n + EXTRA).
        t, hs: instants of the nodes, (angles, stages), and length of the step, (angles,), s.
    """
    N, stages, n = hs.size, M.shape[1], M.shape[2] - EXTRA
    _, a = radau(stages)
    M = M[:, :, :n]
    drive = np.zeros((*t.shape, EXTRA, EXTRA))  # E at the nodes from its derivatives; and one
    drive[..., 0, :-1] = np.stack([t**i / math.factorial(i) for i in range(EXTRA - 1)], axis=2)
    drive[..., -1, -1] = 1.0
    X = np.broadcast_to(np.eye(n, n + EXTRA), (N, n, n + EXTRA))
    by_h = hs[:, None, None]
    G = -a[None, :, None, :, None] * M[:, None, :, :, :n].transpose(0, 1, 3, 2, 4)
    G = by_h * G.reshape(N, stages * n, stages * n) + np.eye(stages * n)
    rhs = np.repeat(X[:, None], stages, axis=1)
    forced = by_h * (a @ (M[..., n:] @ drive).reshape(N, stages, -1))
    rhs[..., n:] += forced.reshape(*t.shape, n, EXTRA)
    return np.linalg.solve(G, rhs.reshape(N, stages * n, n + EXTRA))[:, -n:]


def _constant_transition(M: np.ndarray, h: np.ndarray, steps: int, leaps: int = 1) -> np.ndarray:
    """Do what :func:`_transition` does where M, of one angle for each speed, does not depend on it.

    All steps are then the same: a power of one, with E and its derivatives among the states.

    Returns:
        Shape (leaps, angles, n, n + EXTRA).
    """
    c, _ = radau(STAGES)
    hs, n = h / steps, M.shape[1] - EXTRA
    one = np.zeros(M.shape)
    for i in range(EXTRA - 1):
        for j in range(i, EXTRA - 1):
            one[:, n + i, n + j] = hs ** (j - i) / math.factorial(j - i)
    one[:, -1, -1] = 1.0
    one[:, :n] = _radau_step(np.repeat(M[:, None], STAGES, axis=1), hs[:, None] * c, hs)
    leap = np.linalg.matrix_power(one, steps)
    powers = [leap]
    for _ in range(leaps - 1):
        powers.append(powers[-1] @ leap)
    return np.stack(powers)[:, :, :n]


@kept
def _coefficients_at(ss: GeneratorModel, count: int) -> Caller:
    """:func:`coefficients` at ``count`` angles at once."""
    return Caller(compiled(coefficients(ss).map(count), build=False))


class Parity(NamedTuple):
    """Which entries of a transition matrix repeat after half a turn, and which change their sign.

    Half a turn reverses all phases.  The windings in the rotor's frame do not see that; the zero
    sequence and the fault current, which belong to phases, change their sign.  So entries between
    the two kinds have odd harmonics of the rotor angle only, all others even ones.

    Args:
        sign: 1 or -1 for each linear state, E and its derivatives, 1; shape (n + EXTRA,).
        even, odd: positions of the entries, column by column, one leap after the other.
    """

    sign: np.ndarray
    even: np.ndarray
    odd: np.ndarray


def parity(ss: GeneratorModel, leaps: int) -> Parity:
    """Return the parity of the entries of ``leaps`` transition matrices (:class:`Strides`)."""
    names = ss.linear
    sign = np.array([-1.0 if k in ss.reversing else 1.0 for k in names] + [1.0] * EXTRA)
    one = np.outer(sign, sign[: len(names)]).ravel()  # column by column
    entries = np.tile(one, leaps)
    return Parity(sign, np.flatnonzero(entries > 0), np.flatnonzero(entries < 0))


_PROBE = np.array([0.1, 0.9, 2.3])  # rotor angles, rad, without any symmetry


def _scale(ss: GeneratorModel) -> np.ndarray:
    """Factors that make coefficients of all states comparable, shape (n + EXTRA, n + EXTRA)."""
    nominal = np.append(ss.x.nominals[split(ss).linear], np.ones(EXTRA))
    return np.asarray(nominal / nominal[:, None])


def _scaled(ss: GeneratorModel, u: np.ndarray, theta: np.ndarray) -> Any:
    """Function (angles, speeds) -> matrices M of :func:`coefficients` in nominal units."""
    n, iw, scale = len(ss.linear), ss.u.index("w_r"), _scale(ss)
    full = ss.full(theta).reshape(-1, 1)

    def M_of(angle: np.ndarray, w: np.ndarray) -> np.ndarray:
        U = np.repeat(u[:, None], angle.size, axis=1)
        U[iw] = w
        TH = np.repeat(full, angle.size, axis=1)
        out = _coefficients_at(ss.shared, angle.size)(angle.reshape(1, -1), U, TH)[0]
        made: np.ndarray = (
            np.asarray(out.reshape(-1, angle.size, n + EXTRA).transpose(1, 0, 2)) * scale
        )
        return made

    return M_of


def symmetry(ss: GeneratorModel, u: np.ndarray, theta: np.ndarray, w_rated: float) -> bool:
    """Return whether the coefficients are constant; check that half a turn reverses the phases.

    Raises:
        NotApplicable: it does not, and :class:`Parity` would not hold.
    """
    M = _scaled(ss, u, theta)(np.append(_PROBE, _PROBE + np.pi), np.full(6, w_rated))
    sign = parity(ss, 1).sign
    turned = M[3:] * np.outer(sign, sign) - M[:3]
    largest = np.abs(M).max()
    if np.abs(turned).max() > 1e-9 * largest:
        raise NotApplicable(
            f"{ss.name}: half a turn does not reverse the phases; process noise in the zero "
            "sequence? Use another integrator"
        )
    return bool(np.abs(M - M[0]).max() <= 1e-12 * largest)


def fastest(ss: GeneratorModel, u: np.ndarray, theta: np.ndarray, w_rated: float) -> float:
    """Return the largest rate, 1/s, at which a winding's state acts on itself."""
    M = _scaled(ss, u, theta)(_PROBE, np.full(_PROBE.size, w_rated))
    return float(np.abs(M.diagonal(axis1=1, axis2=2)).max())


@dataclass(frozen=True)
class Table:
    """Transition matrices of one load, fault and sample, as Fourier series in the rotor angle.

    Args:
        centre, half: middle and half width of the speed range, rad/s.
        even, odd: coefficients, for entries of either :class:`Parity`, of cos k theta and sin k
            theta in turn, k = 0, 2, 4, ... and 1, 3, 5, ...; each a polynomial in the relative
            speed (w - centre)/half.  Shape (powers, terms, entries).
        harmonics: number of the highest one; 0 where the angle does not matter, and ``odd`` is
            empty.
        error: largest change, in nominal units, when the steps were halved that it is made by; of
            many stages a share (``LEFT``).
    """

    centre: float
    half: float
    even: np.ndarray
    odd: np.ndarray
    harmonics: int
    error: float

    def at(self, w: float) -> tuple[np.ndarray, np.ndarray]:
        """Coefficients at speed w, rad/s: even and odd, shape (terms, entries)."""
        powers = ((w - self.centre) / self.half) ** np.arange(NODES)
        even, odd = (
            (powers @ part.reshape(NODES, -1)).reshape(part.shape[1:])
            for part in (self.even, self.odd)
        )
        return even, odd

    def filled(self, harmonics: int) -> Table:
        """Return the same with zeros up to a number of harmonics."""
        if harmonics == self.harmonics or not self.harmonics:
            return self
        whole = []
        for part, pairs in ((self.even, harmonics // 2 + 1), (self.odd, (harmonics + 1) // 2)):
            full = np.zeros((NODES, 2 * pairs, part.shape[2]))
            full[:, : part.shape[1]] = part
            whole.append(full)
        return replace(self, even=whole[0], odd=whole[1], harmonics=harmonics)


def nominal_entries(ss: GeneratorModel, leaps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return factors that turn the even and the odd entries of a table to nominal units."""
    kinds = parity(ss, leaps)
    scale = np.tile(_scale(ss)[: len(ss.linear)].T.ravel(), leaps)
    return scale[kinds.even], scale[kinds.odd]


def ripple(ss: GeneratorModel, table: Table, lowest: int) -> float:
    """Return the harmonics of the first transition matrix from one on, nominal units.

    At rated speed.  Without those of a current of the fault that is a state of its own: beside an
    inductive load it ripples by far more than what it acts on.
    """
    total, n, kinds = 0.0, len(ss.linear), parity(ss, 1)
    own = np.array([name != "i_fault" for name in ss.linear] + [True] * EXTRA)
    each = zip(
        (table.even, table.odd), (kinds.even, kinds.odd), nominal_entries(ss, 1), strict=True
    )
    for odd, (part, at, units) in enumerate(each):
        pairs = part[0].reshape(-1, 2, part.shape[2])[(lowest + 1 - odd) // 2 :, :, : at.size]
        size = np.hypot(pairs[:, 0], pairs[:, 1]) * units * (own[at % n] & own[at // n])
        total += float(size.max(axis=1, initial=0.0).sum())
    return total


def transition_table(
    ss: GeneratorModel,
    u: np.ndarray,
    theta: np.ndarray,
    w_rated: float,
    *,
    h: float | None = None,
    angle: float | None = None,
    leaps: int = 1,
) -> Table:
    """Compute the transition matrices for all rotor angles and nearby speeds.

    Args:
        ss, u, theta: model, inputs and fault parameters; ``w_r`` among the inputs does not matter.
        w_rated: speed in the middle of the table, rad/s.
        h, angle: length of a leap, in s or, at any speed, in rad of the rotor's turn.
        leaps: the matrices are those over one leap, two leaps, and so on, one below the other.

    Raises:
        NotApplicable: the Fourier series or the steps do not converge, or a noise in the zero
            sequence does not change its sign with the phases.
    """
    n = len(ss.linear)
    centre, half = w_rated, SPEED_RANGE * w_rated
    nodes = centre + half * np.cos(np.pi * (2 * np.arange(NODES) + 1) / (2 * NODES))
    to_powers = np.linalg.inv(np.vander((nodes - centre) / half, NODES, increasing=True))
    M_of = _scaled(ss, u, theta)
    constant, kinds = symmetry(ss, u, theta, w_rated), parity(ss, leaps)

    def length(w: np.ndarray) -> np.ndarray:
        return angle / w if angle is not None else np.full(w.shape, h)

    if constant:
        M = M_of(np.zeros(NODES), nodes)

    def trial(steps: int, stages: int) -> np.ndarray:
        """Transition matrices that tell whether the steps suffice."""
        if constant:
            slow = [int(nodes.argmin())]
            return np.asarray(_constant_transition(M[slow], length(nodes)[slow], steps)[0])
        slowest = np.full(_PROBE.size, nodes.min())
        made = _transition(ss, (u, theta), _PROBE, slowest, length(slowest), steps, stages=stages)
        return made[0]

    what = f"{ss.name}: transition matrices over {length(nodes).max():.3g} s"
    steps, stages, error = _enough(trial, what)

    def sampled(angles: np.ndarray) -> np.ndarray:
        """Entries in nominal units, column by column, leap after leap: (nodes, angles, entries)."""
        a, w = np.tile(angles, NODES), np.repeat(nodes, angles.size)
        if constant:
            P = _constant_transition(M, length(nodes), steps, leaps).swapaxes(0, 1)
        else:
            P = np.stack(_transition(ss, (u, theta), a, w, length(w), steps, leaps, stages), axis=1)
        return P.transpose(0, 1, 3, 2).reshape(NODES, angles.size, -1)

    units = np.tile((1 / _scale(ss)[:n]).T.ravel(), leaps)

    def powers(series: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Polynomials in speed from values at the nodes, shape (nodes, terms, entries); in SI."""
        made: np.ndarray = np.tensordot(to_powers, series, 1) * units[which]
        return made

    if constant:
        P = sampled(np.zeros(1))
        none = np.zeros((NODES, 0, kinds.odd.size))
        return Table(centre, half, powers(P[:, :, kinds.even], kinds.even), none, 0, error)
    F, highest = _fourier(sampled, kinds, what)

    def series(first: int, which: np.ndarray) -> np.ndarray:
        part = F[:, first : highest + 1 : 2, which]
        pairs = np.stack([2 * part.real, -2 * part.imag], axis=2)
        if first == 0:
            pairs[:, 0] /= 2
        # an isolated neutral without a fault has no odd entries: no shape follows from their number
        return powers(pairs.reshape(NODES, 2 * pairs.shape[1], which.size), which)

    even, odd = series(0, kinds.even), series(1, kinds.odd)
    return Table(centre, half, even, odd, highest, error)


def _enough(trial: Callable[[int, int], np.ndarray], what: str) -> tuple[int, int, float]:
    """Return how many steps of how many stages suffice, doubled until trials agree, and the change.

    ``trial`` takes them; two steps of all stages at most, else of few.
    """
    steps, stages, error, last = 1, STAGES, math.inf, trial(1, STAGES)
    while error > STEP_TOL:
        if steps >= 64:
            raise NotApplicable(f"{what} do not converge (error {error:.1e} with {steps} steps)")
        if steps == 2:
            steps, stages = 4, FEW
            last = trial(steps, stages)
        steps *= 2
        new = trial(steps, stages)
        left = LEFT if stages > FEW else 1.0
        error, last = left * float(np.abs(new - last).max()), new
    return steps, stages, error


def _fourier(
    sampled: Callable[[np.ndarray], np.ndarray], kinds: Parity, what: str
) -> tuple[np.ndarray, int]:
    """Return Fourier coefficients of entries sampled over half a turn, and the highest that counts.

    The other half follows from the parity.
    """
    turn = np.ones(kinds.even.size + kinds.odd.size)
    turn[kinds.odd] = -1.0
    highest, P = 0, np.empty((0, 0, 0))
    for resolved in HARMONICS:
        if not P.size:
            P = sampled(np.pi * np.arange(resolved) / resolved)
        else:  # those in between the angles that are there
            new = sampled(np.pi * np.arange(1, resolved, 2) / resolved)
            P = np.stack([P, new], axis=2).reshape(P.shape[0], resolved, -1)
        F = np.fft.rfft(np.concatenate([P, P * turn], axis=1), axis=1) / (2 * resolved)
        size = np.abs(F).max(axis=(0, 2))
        highest = int(np.nonzero(size > TAIL * size.max())[0][-1])
        if highest < resolved - 1:
            return F, highest
    raise NotApplicable(
        f"{what} has over {highest} harmonics of the rotor angle above {TAIL:g}: the load is too "
        "light for this step"
    )


def cached_table(
    ss: GeneratorModel,
    u: np.ndarray,
    theta: np.ndarray,
    w_rated: float,
    *,
    h: float | None = None,
    angle: float | None = None,
    leaps: int = 1,
) -> Table:
    """Return a table of :func:`transition_table`, kept by all that it depends on."""
    key_u = np.array(u, dtype=float)
    key_u[ss.u.indices(["w_r", "V_ref"])] = 0.0
    length = (None if h is None else round(h, 15), angle)
    key = (key_u.tobytes(), theta.tobytes(), *length, w_rated, leaps)

    def make() -> Table:
        return transition_table(ss, key_u, theta, w_rated, h=h, angle=angle, leaps=leaps)

    return keep(ss, Table, key, make, limit=TABLES, locked=False)
