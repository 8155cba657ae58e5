"""Periodic steady state at constant speed, under any load and fault.

    w_r dx/dtheta = f(x, theta),    x(theta + 2 pi) = x(theta),    theta the rotor angle.

Exciter and load belong to it: the regulator sees the ripple of the terminal voltage.  The unknowns
are the states at equally spaced angles, a derivative is that of the trigonometric polynomial
through them (Fourier collocation; Trefethen, "Spectral Methods in MATLAB", ch. 3), and Newton's
method has the exact derivatives of the model's own right-hand side.  Its error falls faster than
any power of the number of angles, and a branch that settles within nanoseconds costs nothing.  The
nodes are doubled until the equations hold halfway between them as well.

Where a limit of the regulator is met and left within the turn there is no such polynomial: the
fixed point of the map over the turn, or half of it, by CVODES is then solved for (shooting).

Half a turn reverses all phases.  Where the model has that symmetry (states of the rotor's axes
repeat, states of phases change their sign), half a turn is solved.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import OperatingPointError
from apu_casadi.core.sharing import kept
from apu_casadi.core.simulation import stepper
from apu_casadi.core.statespace import StateSpace

NODES = (16, 32, 64, 128)  # in half a turn, in turn
#: Largest defect between the nodes, nominal value per rad, at which nodes are enough, and that is
#: accepted with the most of them, where an open phase's voltage is rounding times resistance.
ENOUGH, ACCEPTED = 2e-9, 1e-7
_STEPS = 30  # of Newton's method
_AT_REST = 24  # nodes in the turn of a balanced machine


@dataclass(frozen=True, eq=False)
class Turn:
    """One turn of a generator at rest: states and outputs at equally spaced rotor angles.

    Args:
        ss: the model.
        angle: rotor angles, rad, from the start on, shape (n,).
        x, y: states (nx, n) and outputs (ny, n); ``theta_e`` among the states is ``angle``.
    """

    ss: StateSpace
    angle: np.ndarray
    x: np.ndarray
    y: np.ndarray

    @classmethod
    def of(cls, ss: StateSpace, x: np.ndarray, u: np.ndarray, theta: np.ndarray) -> Turn:
        """Make it of the states at equally spaced angles, or of one state of a balanced machine."""
        at = ss.x.index("theta_e")
        if x.ndim == 1:
            start, x = x[at], np.repeat(x[:, None], _AT_REST, axis=1)
            x[at] = start + 2 * math.pi / _AT_REST * np.arange(_AT_REST)
        n = x.shape[1]
        g = ss.shared.g.map(n)
        full = np.repeat(ss.full(theta).reshape(-1, 1), n, axis=1)
        y = np.asarray(g(x, np.repeat(np.reshape(u, (-1, 1)), n, axis=1), full).full())
        return cls(ss, x[at], x, y)

    def __getitem__(self, name: str) -> np.ndarray:
        """Return an output, or a state, at the angles, shape (n,)."""
        row: np.ndarray = self.y[self.ss.y.index(name)] if name in self.ss.y else self._state(name)
        return row

    def _state(self, name: str) -> np.ndarray:
        row: np.ndarray = self.x[self.ss.x.index(name)]
        return row

    def mean(self, name: str) -> float:
        """Return the mean over the turn."""
        return float(self[name].mean())

    def rms(self, name: str) -> float:
        """Return the rms value over the turn."""
        return math.sqrt(float((self[name] ** 2).mean()))

    def phasor(self, name: str, k: int = 1) -> complex:
        """Return V of the k-th harmonic sqrt(2) Re(V exp(j k theta)), k >= 1, rms."""
        waves = self[name] * np.exp(-1j * k * self.angle)
        return complex(math.sqrt(2.0) * waves.mean())


class Closing(NamedTuple):
    """What fixes the voltage.

    Args:
        held: whether the field voltage is constant; else the regulator acts on the reference.
        E_fd, V_ref: field voltage and reference, per unit: first guesses, ...
        exact: ... or whether that of the two which acts is given exactly.
        miss: (mean V_t in V, mean E_fd) -> what must vanish, per unit, and its derivatives by both.
        at_rest: of the same, states of the exciter by name and the reference, if nothing rippled.
    """

    held: bool
    E_fd: float
    V_ref: float
    exact: bool
    miss: Callable[[float, float], tuple[float, float, float]]
    at_rest: Callable[[float, float], tuple[dict[str, float], float]]


class Periodic(NamedTuple):
    """A solution: states at the angles of a whole turn (nx, n), what closes it, and the defect.

    The defect is the largest one of the equations halfway between the nodes, nominal value per s.
    """

    x: np.ndarray
    value: float
    defect: float


def solve_periodic(
    ss: StateSpace,
    x: np.ndarray,
    u: np.ndarray,
    theta: np.ndarray,
    closing: Closing,
    reversing: tuple[str, ...] = (),
) -> Periodic:
    """Solve for the periodic steady state.

    Args:
        ss: the model, with the rotor angle ``theta_e`` among its states.
        x: where to start from, shape (nx,); its angle is that of the first node.
        u, theta: inputs with the speed ``w_r``, and parameters.
        closing: what fixes the voltage.
        reversing: states that change their sign after half a turn, if the model is symmetric so.

    Raises:
        OperatingPointError: no solution, or one that is not good enough between the nodes.
    """
    signs, start = _signs(ss, u, theta, reversing), float(x[ss.x.index("theta_e")])
    X, value, half = x[:, None], closing.E_fd, NODES[0]
    if not closing.held:  # with a constant field of the voltage wanted first: it is nearly linear
        held = _Problem(ss, u, theta, closing._replace(held=True, exact=False), signs)
        X, E_fd, half, _ = _refined(held, X, value, start, half)
        states, value = closing.at_rest(held.voltage(X, E_fd), E_fd)
        for n, v in states.items():
            X[ss.x.index(n)] = v
        value = closing.V_ref if closing.exact else value
    problem = _Problem(ss, u, theta, closing, signs)
    X, value, half, (defect, worst) = _refined(problem, X, value, start, half)
    if not defect <= ACCEPTED:  # a limit met and left within the turn
        X, value, gap = problem.shot(X[:, 0], value)
        defect, worst = gap if gap[0] <= ACCEPTED else (defect, worst)
    w, X = problem.w, problem.whole(X)
    reason = f"with {half} angles in half a turn d{worst}/dt misses by {defect * w:.1e} of its "
    reason += f"nominal value per second, {ACCEPTED * w:.0e} allowed"
    if float(X[ss.x.index("E_fd")].mean()) <= 0:
        defect, reason = math.inf, "the field would have to be reversed"
    if not defect <= ACCEPTED:
        raise OperatingPointError(
            f"{ss.name}: no periodic steady state found at w_r = {w:.6g} rad/s: {reason}"
        )
    return Periodic(X, value, defect * w)


def _refined(
    problem: _Problem, X: np.ndarray, value: float, start: float, least: int
) -> tuple[np.ndarray, float, int, tuple[float, str]]:
    """Solve with more and more nodes; return them, what closes, how many, and the defect."""
    half, defect, before = least, (math.inf, ""), math.inf
    for half in (k for k in NODES if k >= least):
        n = problem.nodes(half)
        if X.shape[1] == 1:
            X = np.repeat(X, n, axis=1)
        X = _resampled(problem.whole(X), n * problem.parts)[:, :n]
        X, value = problem.newton(X, value, start)
        defect = problem.defect(X, value)
        if defect[0] <= ENOUGH or before / 10 < defect[0] <= ACCEPTED:  # or nothing but rounding
            break
        before = defect[0]
    return X, value, half, defect


def _signs(
    ss: StateSpace, u: np.ndarray, theta: np.ndarray, reversing: tuple[str, ...]
) -> np.ndarray | None:
    """Return 1 or -1 of each state after half a turn, shape (nx,); None without that symmetry."""
    signs = np.array([-1.0 if n in reversing else 1.0 for n in ss.x.names])
    x = ss.x.nominals * (1.0 + 0.3 * np.cos(3.0 * np.arange(len(ss.x))))  # any state
    turned = signs * x
    turned[ss.x.index("theta_e")] += math.pi
    here, there = (ss.f(state, u, theta).full().ravel() / ss.x.nominals for state in (x, turned))
    alike = np.abs(signs * there - here).max() <= 1e-9 * np.abs(here).max()
    return signs if alike else None


class _Problem:
    """The equations at the nodes."""

    def __init__(
        self,
        ss: StateSpace,
        u: np.ndarray,
        theta: np.ndarray,
        closing: Closing,
        signs: np.ndarray | None,
    ) -> None:
        self.ss, self.u, self.theta, self.closing = ss, np.array(u, float), theta, closing
        self.signs = np.ones(len(ss.x)) if signs is None else signs
        self.parts = 1 if signs is None else 2  # of a turn that are alike
        self.held = closing.held
        self.free = _free(ss, self.held)
        self.angle = ss.x.index("theta_e")
        self.w = float(self.u[ss.u.index("w_r")])
        self.nominal = ss.x.nominals[self.free]

    def nodes(self, half: int) -> int:
        """Nodes that are solved for, from those in half a turn."""
        return half if self.parts == 2 else 2 * half

    def whole(self, X: np.ndarray) -> np.ndarray:
        """Return the states of a whole turn."""
        if self.parts == 1:
            return X
        other = X * self.signs[:, None]
        other[self.angle] = X[self.angle] + math.pi
        return np.hstack([X, other])

    def _at(self, X: np.ndarray, value: float) -> tuple[np.ndarray, ...]:
        """Return rates (free, n), V_t (n,), and derivatives of both by free states and value."""
        n, u, X = X.shape[1], self.u.copy(), X.copy()
        if self.held:
            X[self.ss.x.index("E_fd")] = value
        else:
            u[self.ss.u.index("V_ref")] = value
        U = np.repeat(u[:, None], n, axis=1)
        TH = np.repeat(self.ss.full(self.theta).reshape(-1, 1), n, axis=1)
        made = _derivatives(self.ss.shared, self.held).map(n)(X, U, TH)
        f, V_t, J = (np.asarray(m.full()) for m in made)
        m = len(self.free)
        return f, V_t.ravel(), J.reshape(m + 1, n, m + 1).transpose(1, 0, 2)

    def voltage(self, X: np.ndarray, value: float) -> float:
        """Return the mean terminal voltage, V."""
        return float(self._at(X, value)[1].mean())

    def newton(self, X: np.ndarray, value: float, start: float) -> tuple[np.ndarray, float]:
        """Solve for the nodes; damped where the residual would grow."""
        n, m, nominal = X.shape[1], len(self.free), self.nominal
        X = X.copy()
        X[self.angle] = start + 2 * math.pi / (n * self.parts) * np.arange(n)
        D = [self.w * _derivative(n, self.parts, float(s)) for s in self.signs[self.free]]

        def residual(X: np.ndarray, value: float) -> tuple[np.ndarray, np.ndarray]:
            f, V_t, J = self._at(X, value)
            r = np.array([d @ row for d, row in zip(D, X[self.free], strict=True)]) - f
            miss, *slope = 0.0, 0.0, 0.0
            if not self.closing.exact:
                E = value if self.held else float(X[self.ss.x.index("E_fd")].mean())
                miss, *slope = self.closing.miss(float(V_t.mean()), E)
            r = np.append((r / (self.w * nominal[:, None])).ravel(), miss)
            return r, self._jacobian(D, J, slope)

        r, J = residual(X, value)
        for _ in range(_STEPS):
            size, share = np.abs(r).max(), 1.0
            try:
                step = np.linalg.solve(J, -r)
            except np.linalg.LinAlgError:  # at a limit of the regulator nothing acts
                break
            while True:
                new = X.copy()
                new[self.free] += share * step[:-1].reshape(m, n) * nominal[:, None]
                ahead, J_new = residual(new, value + share * float(step[-1]))
                if np.abs(ahead).max() < size or share < 1e-3 or size < 1e-12:
                    break
                share /= 2
            moved, better = np.abs(step).max(), np.abs(ahead).max() < size
            if better:
                X, value, r, J = new, value + share * float(step[-1]), ahead, J_new
            if moved < 1e-11 or not better:
                break
        return X, value

    def shot(self, x: np.ndarray, value: float) -> tuple[np.ndarray, float, tuple[float, str]]:
        """Solve for the fixed point of the map over the part of a turn, from a state near it.

        Returns:
            States at the nodes, what closes, and the largest gap, nominal value per rad, with whose
            it is.
        """
        ss, free, length = self.ss, self.free, 2 * math.pi / (self.w * self.parts)
        how: dict[str, Any] = {"rtol": 1e-11, "atol": 1e-13}
        over = stepper(ss, 1, quad=("V_t", "E_fd"), **how)

        def given(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            u, state = self.u.copy(), x.copy()
            state[free] = v[:-1] * self.nominal
            if self.held:
                state[ss.x.index("E_fd")] = v[-1]
            else:
                u[ss.u.index("V_ref")] = v[-1]
            return state, u

        def gap(v: np.ndarray) -> np.ndarray:
            state, u = given(v)
            made = over(state, u, self.theta, length)
            moved = (self.signs * made.x_end - state)[free] / self.nominal
            miss = 0.0
            if not self.closing.exact:
                miss = self.closing.miss(made.mean["V_t"], made.mean["E_fd"])[0]
            return np.append(moved, miss)

        v = np.append(x[free] / self.nominal, value)
        off, moves = gap(v), 1e-6 * np.eye(v.size)[: v.size - self.closing.exact]
        for _ in range(12):
            J = np.eye(v.size)
            J[:, : len(moves)] = np.array([(gap(v + d) - off) / 1e-6 for d in moves]).T
            new = v - np.linalg.solve(J, off)
            ahead = gap(new)
            if not np.abs(ahead).max() < np.abs(off).max():
                break
            v, off = new, ahead
        n = self.nodes(NODES[-1])
        state, u = given(v)
        made = stepper(ss, n, **how)(state, u, self.theta, length)
        X = np.column_stack([state, made.x[:, :-1]])
        worst = int(np.abs(off).argmax())
        name = [*(ss.x.names[i] for i in free), "V_t"][worst]
        return X, float(v[-1]), (float(abs(off[worst])) / (2 * math.pi) * self.parts, name)

    def _jacobian(self, D: list[np.ndarray], J: np.ndarray, slope: Any) -> np.ndarray:
        """Derivatives of the residual by scaled states, node by node, and by what closes."""
        n, m, nominal = J.shape[0], len(self.free), self.nominal
        scale = self.w * nominal
        A = np.zeros((m, n, m, n))
        k = np.arange(n)
        for i in range(m):
            A[i, :, i, :] += D[i] * nominal[i]
        A[:, k, :, k] -= J[:, :m, :m] * nominal  # axes moved to the front: (n, m, m)
        A /= scale[:, None, None, None]
        whole = np.zeros((m * n + 1, m * n + 1))
        whole[:-1, :-1] = A.reshape(m * n, m * n)
        if self.closing.exact:
            whole[-1, -1] = 1.0
            return whole
        by_V, by_E = slope
        whole[:-1, -1] = -(J[:, :m, m].T / scale[:, None]).ravel()
        row = by_V * J[:, m, :m].T * nominal[:, None] / n
        if self.held:
            whole[-1, -1] = by_V * J[:, m, m].mean() + by_E
        else:
            at = self.free.index(self.ss.x.index("E_fd"))
            row[at] += by_E * nominal[at] / n
            whole[-1, -1] = by_V * J[:, m, m].mean()
        whole[-1, :-1] = row.ravel()
        return whole

    def defect(self, X: np.ndarray, value: float) -> tuple[float, str]:
        """Return the largest defect halfway between the nodes, nominal per rad, and whose it is."""
        whole = self.whole(X)
        n, halfway = whole.shape[1], math.pi / whole.shape[1]
        free = whole[self.free]
        F, k = np.fft.rfft(free, axis=1), np.arange(n // 2 + 1)
        F *= np.exp(1j * k * halfway)
        between = whole.copy()
        between[self.free] = np.fft.irfft(F, n, axis=1)
        between[self.angle] = whole[self.angle] + halfway
        rate = self.w * np.fft.irfft(1j * k * F, n, axis=1)
        f = self._at(between, value)[0]
        off = np.abs(rate - f).max(axis=1) / (self.nominal * self.w)
        worst = int(off.argmax())
        return float(off[worst]), self.ss.x.names[self.free[worst]]


def _free(ss: StateSpace, held: bool) -> list[int]:
    """Positions of the states that are solved for; without the exciter's where it is held."""
    from apu_casadi.machine.exciter import ExciterState

    out = {"theta_e", *(ExciterState._fields if held else ())}
    return [i for i, n in enumerate(ss.x.names) if n not in out]


@kept
def _derivatives(ss: StateSpace, held: bool) -> ca.Function:
    """(x, u, theta) -> rates of the free states, V_t, and the derivatives of both.

    The last has a row for each of them, and columns for the free states and what closes.
    """
    x, u, th = ca.SX.sym("x", len(ss.x)), ca.SX.sym("u", len(ss.u)), ca.SX.sym("t", len(ss.theta))
    free = _free(ss, held)
    f, V_t = ss.f(x, u, th)[free], ss.g(x, u, th)[ss.y.index("V_t")]
    last = x[ss.x.index("E_fd")] if held else u[ss.u.index("V_ref")]
    J = ca.jacobian(ca.vertcat(f, V_t), ca.vertcat(x[free], last))
    return ca.Function("periodic", [x, u, th], [f, V_t, ca.densify(J)], {"cse": True})


def _derivative(n: int, parts: int, sign: float) -> np.ndarray:
    """Derivative by the angle of what repeats, or with sign -1 reverses, after a part of a turn.

    Args:
        n: nodes in the part.
        parts: parts of a turn, 1 or 2.
    """
    total = n * parts
    j = np.arange(1, total)
    row = np.zeros(total)
    row[1:] = -0.5 * (-1.0) ** j / np.tan(math.pi * j / total)
    D = np.array([np.roll(row, k) for k in range(n)])
    return D if parts == 1 else D[:, :n] + sign * D[:, n:]


def _resampled(x: np.ndarray, n: int) -> np.ndarray:
    """Return periodic rows at n equally spaced instants, no fewer than there are, by Fourier."""
    if x.shape[1] == n:
        return x
    F = np.fft.rfft(x, axis=1)
    made: np.ndarray = np.fft.irfft(F, n, axis=1) * (n / x.shape[1])
    return made
