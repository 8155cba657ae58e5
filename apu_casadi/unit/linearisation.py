"""Linear models: A, B, C, D of any :class:`~apu_casadi.core.statespace.StateSpace` at any point.

    dx/dt ~ xdot0 + A (x - x0) + B_u (u - u0) + B_theta (theta - theta0)
    y     ~ y0    + C (x - x0) + D_u (u - u0) + D_theta (theta - theta0)

All matrices are derivatives of the model's own expressions by algorithmic differentiation;
algebraic unknowns are eliminated by the implicit function theorem, at the solved point.

The machine is linearised on the rotor's axes and averaged over an electrical period (see
:mod:`apu_casadi.unit.averaged`), where its steady state is a constant.  The column of the fault
severity h is the derivative at the healthy machine for period means; what a fault adds to it, a
ripple of torque and power at twice the electrical frequency (800 Hz), is of first order too but
has no mean, and no place in a linear model with constant coefficients.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from apu_casadi.core.checked import array
from apu_casadi.core.errors import ApuError, OperatingPointError, SignalError
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import OperatingPoint
from apu_casadi.machine.generator import Generator, GeneratorPoint
from apu_casadi.unit.apu import Apu, JointPoint
from apu_casadi.unit.averaged import (
    generator_vectors,
    joint_equations,
    joint_vectors,
    load_kind,
)

if TYPE_CHECKING:
    import xarray as xr

RESIDUAL_TOL = 1e-6  # largest algebraic residual at which a linearisation is given
_SMALL = 0.05  # participations below this are not listed


@dataclass(frozen=True)
class Eigenvalue:
    """One eigenvalue, or one complex pair, of a linear model.

    Args:
        value: 1/s; of a pair the one with positive imaginary part.
        time_constant: -1/real part, s; negative: it grows, infinite: it stays.
        damping: -real part/|value|; 1 for a real stable one.
        frequency: imaginary part/(2 pi), Hz.
        participation: share of each state in the mode, largest first, those below 5 % left out.  It
            is |w_k v_k| of left and right eigenvector, over its sum; units cancel in it.
    """

    value: complex
    time_constant: float
    damping: float
    frequency: float
    participation: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class LinearModel:
    """A linear model with its operating point; rows and columns follow the named signals.

    Args:
        name: of the model that was linearised.
        x, u, theta, y: states, inputs, health and fault parameters, outputs: nx, nu, nt, ny of
            them.
        A, B_u, B_theta: shapes (nx, nx), (nx, nu), (nx, nt); SI units per SI unit and second.
        C, D_u, D_theta: shapes (ny, nx), (ny, nu), (ny, nt).
        x0, u0, theta0, y0: the operating point.
        xdot0: state rates there, shape (nx,); zero up to rounding at a steady point.
    """

    name: str
    x: Signals
    u: Signals
    theta: Signals
    y: Signals
    A: np.ndarray = field(repr=False)
    B_u: np.ndarray = field(repr=False)
    B_theta: np.ndarray = field(repr=False)
    C: np.ndarray = field(repr=False)
    D_u: np.ndarray = field(repr=False)
    D_theta: np.ndarray = field(repr=False)
    x0: np.ndarray = field(repr=False)
    u0: np.ndarray = field(repr=False)
    theta0: np.ndarray = field(repr=False)
    y0: np.ndarray = field(repr=False)
    xdot0: np.ndarray = field(repr=False)

    def derivative(self, of: str, by: str) -> float:
        """Return one entry by name: of an output or a state's rate by a state, input or parameter.

        ``of`` is an output, or a state with ``_dot`` behind it: ``derivative("N_dot", "Wf")``.
        Where a name is both a state and an output or input (N), the state counts in ``by``.

        Raises:
            SignalError: unknown name; the nearest is named.
        """
        state = of.removesuffix("_dot")
        rate = of.endswith("_dot") and state in self.x
        i = self.x.index(state) if rate else self.y.index(of)
        for signals, dyn, out in (
            (self.x, self.A, self.C),
            (self.u, self.B_u, self.D_u),
            (self.theta, self.B_theta, self.D_theta),
        ):
            if by in signals:
                return float((dyn if rate else out)[i, signals.index(by)])
        Signals([*self.x, *(s for s in (*self.u, *self.theta) if s.name not in self.x)]).index(by)
        raise AssertionError("unreachable")  # pragma: no cover

    def labelled(self) -> xr.Dataset:
        """Return the matrices and the operating point as labelled arrays.

        Dimensions are ``xdot`` (rows of A and B), ``x``, ``u``, ``theta`` and ``y``, with the names
        as coordinates and the units beside them (``x_unit`` and so on).
        """
        import xarray as xr

        dims = {"xdot": self.x, "x": self.x, "u": self.u, "theta": self.theta, "y": self.y}
        coords: dict[str, Any] = {}
        for d, signals in dims.items():
            text = "U1" if not len(signals) else None
            coords[d] = (d, np.array(signals.names, dtype=text))
            units = [f"{s.unit}/s" if d == "xdot" else s.unit for s in signals]
            coords[f"{d}_unit"] = (d, np.array(units, dtype=text))
        return xr.Dataset(
            {
                "A": (("xdot", "x"), self.A),
                "B_u": (("xdot", "u"), self.B_u),
                "B_theta": (("xdot", "theta"), self.B_theta),
                "C": (("y", "x"), self.C),
                "D_u": (("y", "u"), self.D_u),
                "D_theta": (("y", "theta"), self.D_theta),
                "x0": ("x", self.x0),
                "u0": ("u", self.u0),
                "theta0": ("theta", self.theta0),
                "y0": ("y", self.y0),
                "xdot0": ("xdot", self.xdot0),
            },
            coords=coords,
            attrs={"model": self.name},
        )

    def eigenvalues(self) -> tuple[Eigenvalue, ...]:
        """Return the eigenvalues of A, slowest first, a complex pair as one.

        Participation factors after Perez-Arriaga, Verghese and Schweppe, IEEE Trans. Power App.
        Syst. PAS-101 (1982), 3117.
        """
        # scaled states: the same eigenvalues, better conditioned vectors
        s = self.x.nominals
        values, V = np.linalg.eig(self.A * s / s[:, None])
        W = np.linalg.pinv(V)
        modes = []
        for k in np.argsort(-values.real, kind="stable"):
            v = complex(values[k])
            if v.imag < 0:
                continue
            p = np.abs(W[k] * V[:, k])
            p = p / p.sum()
            order = [i for i in np.argsort(-p) if p[i] >= _SMALL]
            size = abs(v)
            modes.append(
                Eigenvalue(
                    value=v,
                    time_constant=-1 / v.real if v.real else math.inf,
                    damping=-v.real / size if size else 0.0,
                    frequency=v.imag / (2 * math.pi),
                    participation={self.x.names[i]: float(p[i]) for i in order},
                )
            )
        return tuple(modes)

    def step_response(
        self,
        t: Sequence[float] | np.ndarray,
        *,
        u: Mapping[str, float] | None = None,
        theta: Mapping[str, float] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return what steps of inputs and parameters at t = 0 do, exactly in time.

        Args:
            t: instants >= 0, s, shape (n,).
            u, theta: sizes of the steps by name, SI; the others stay.

        Returns:
            x of shape (nx, n) and y of shape (ny, n): the predicted values, operating point
            included.
        """
        from scipy.linalg import expm

        times = np.asarray(t, dtype=float)
        if times.ndim != 1 or not np.all(np.isfinite(times)) or np.any(times < 0):
            raise SignalError(f"t: 1-D instants >= 0 s expected, got shape {times.shape}")
        du, dtheta = _step(self.u, u), _step(self.theta, theta)
        nx = len(self.x)
        s = self.x.nominals
        M = np.zeros((nx + 1, nx + 1))
        M[:nx, :nx] = self.A * s / s[:, None]
        M[:nx, nx] = (self.xdot0 + self.B_u @ du + self.B_theta @ dtheta) / s
        dx = np.array([s * expm(M * float(tk))[:nx, nx] for tk in times]).T.reshape(nx, times.size)
        dy = self.C @ dx + (self.D_u @ du + self.D_theta @ dtheta)[:, None]
        return self.x0[:, None] + dx, self.y0[:, None] + dy

    @property
    def matrices(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """A, B, C, D with u and theta one after the other as inputs."""
        B, D = np.hstack([self.B_u, self.B_theta]), np.hstack([self.D_u, self.D_theta])
        return self.A, B, self.C, D

    def to_scipy(self) -> Any:
        """Return ``scipy.signal.StateSpace``, in deviations from the operating point.

        Its inputs are u and theta, one after the other; names are those of the signals here.
        """
        from scipy.signal import StateSpace as Linear

        return Linear(*self.matrices)

    def to_control(self) -> Any:
        """Return ``control.StateSpace`` of python-control, in deviations from the operating point.

        Its inputs are u and theta, one after the other, all under their names.

        Raises:
            ApuError: python-control is not installed.
        """
        try:
            control = import_module("control")
        except ImportError as e:
            raise ApuError(
                "to_control() needs python-control, which is optional: install it with "
                "'python -m pip install control'"
            ) from e
        return control.ss(
            *self.matrices,
            states=list(self.x.names),
            inputs=[*self.u.names, *self.theta.names],
            outputs=list(self.y.names),
            name=self.name,
        )


def _step(signals: Signals, values: Mapping[str, float] | None) -> np.ndarray:
    d = np.zeros(len(signals))
    for name, value in (values or {}).items():
        d[signals.index(name)] = float(value)
    if not np.all(np.isfinite(d)):
        raise SignalError(f"steps must be finite, got {dict(values or {})}")
    return d


@kept
def _eliminated(ss: StateSpace, n: int) -> ca.Function:
    """(x, u, theta, c) -> xdot, y, alg, d(xdot, y)/d(x, u, theta), with one search for z in all.

    c are the parameters of ``ss`` from the n-th on: numbers of the unit.
    """
    sx = all(f.is_a("SXFunction") for f in (ss.f, ss.g, ss.z_of, ss.residual))
    sym = ca.SX if sx else ca.MX
    args: list[Any] = [
        sym.sym(label, m) for label, m in (("x", len(ss.x)), ("u", len(ss.u)), ("theta", n))
    ]
    c = sym.sym("c", len(ss.theta) - n)
    x, u, theta = args[0], args[1], ca.vertcat(args[2], c)
    # inlined, so that the search for z, which f, g and z_of each hold, is found to be the same
    xdot, y, z = (f.call([x, u, theta], True, False)[0] for f in (ss.f, ss.g, ss.z_of))
    alg = ss.residual.call([x, z, u, theta], True, False)[1]
    xdot, y, alg = ca.cse([xdot, y, alg])
    J = ca.densify(ca.jacobian(ca.vertcat(xdot, y), ca.vertcat(*args)))
    return ca.Function(f"{ss.name}_linear", [*args, c], [xdot, y, alg, J], {"cse": True})


@kept
def _explicit(equations: ca.Function, name: str, n: int) -> ca.Function:
    """(x, z, u, theta, c) -> xdot, y, alg, d(xdot, y, alg)/d(x, u, theta, z).

    c are the parameters of ``equations`` from the n-th on: numbers of the unit.
    """
    sizes = [equations.size1_in(i) for i in range(4)]
    x, z, u, theta = args = [
        ca.MX.sym(label, m)
        for label, m in zip(("x", "z", "u", "theta"), [*sizes[:3], n], strict=True)
    ]
    c = ca.MX.sym("c", sizes[3] - n)
    xdot, alg, y = equations(x, z, u, ca.vertcat(theta, c))
    J = ca.densify(ca.jacobian(ca.vertcat(xdot, y, alg), ca.vertcat(x, u, theta, z)))
    return ca.Function(f"{name}_linear_z", [*args, c], [xdot, y, alg, J])


def linearise(
    ss: StateSpace,
    x: Any,
    u: Any,
    theta: Any,
    *,
    equations: ca.Function | None = None,
    z: Any = None,
) -> LinearModel:
    """Linearise a model about a point, which need not be steady.

    The functions are built at the first call for a model, or another unit of its family, and kept.

    Args:
        ss: the model.
        x, u, theta: packed vectors, shapes (nx,), (nu,), (nt,), SI.
        equations, z: the same model, or its family, as Function (x, z, u, theta) -> (ode, alg, y),
            and its solved algebraic unknowns, shape (nz,); with both no search is made, which is
            faster.

    Raises:
        SignalError: a wrong shape, a value that is not finite, or one of equations and z alone.
        OperatingPointError: the algebraic equations are not solved there, or a derivative is not
            finite; names the equation or the entry.
    """
    if (equations is None) != (z is None):
        raise SignalError(f"{ss.name}: give equations and z together, or neither")
    x0, u0, theta0 = (
        _vector(ss, label, signals, value)
        for label, signals, value in (("x", ss.x, x), ("u", ss.u, u), ("theta", ss.theta, theta))
    )
    nt, numbers = len(ss.theta), np.array(ss.numbers)
    if equations is None:
        made = _eliminated(ss if ss.family is None else ss.family, nt)
        out = made(x0, u0, theta0, numbers)
    else:
        of_family = equations.size1_in(3) > nt
        made = _explicit(equations, ss.name, nt)
        z0 = _vector(ss, "z", ss.z, z)
        out = made(x0, z0, u0, theta0, numbers if of_family else np.zeros(0))
    xdot, y, alg = (o.full().reshape(-1) for o in out[:3])
    J = out[3].full()
    nx, nu, ny = len(ss.x), len(ss.u), len(ss.y)

    def at() -> str:
        given = {**ss.x.unpack(x0), **ss.u.unpack(u0), **ss.theta.unpack(theta0)}
        return ", ".join(f"{n} = {v:.6g}" for n, v in given.items())

    if alg.size and not np.abs(alg).max() <= RESIDUAL_TOL:
        worst = int(np.argmax(np.where(np.isfinite(alg), np.abs(alg), np.inf)))
        raise OperatingPointError(
            f"{ss.name}: algebraic equation {worst + 1} of {alg.size} left a residual of "
            f"{alg[worst]:.1e} (largest allowed {RESIDUAL_TOL:.0e}) at {at()}; linearise at a "
            "trimmed point, on the maps"
        )
    if equations is not None:  # 0 = alg gives dz = -alg_z^-1 alg_w dw
        n = nx + nu + nt
        try:
            dz = -np.linalg.solve(J[nx + ny :, n:], J[nx + ny :, :n])
        except np.linalg.LinAlgError:
            raise OperatingPointError(
                f"{ss.name}: the algebraic equations are singular at {at()}"
            ) from None
        J = J[: nx + ny, :n] + J[: nx + ny, n:] @ dz
    if not np.all(np.isfinite(J)):
        i, j = (int(k) for k in np.argwhere(~np.isfinite(J))[0])
        rows = [*(f"{n}_dot" for n in ss.x.names), *ss.y.names]
        columns = [*ss.x.names, *ss.u.names, *ss.theta.names]
        raise OperatingPointError(f"{ss.name}: d {rows[i]}/d {columns[j]} is not finite at {at()}")
    cut = (nx, nx + nu)
    (A, B_u, B_theta), (C, D_u, D_theta) = (
        np.split(part, cut, axis=1) for part in (J[:nx], J[nx:])
    )
    signals, point = (ss.x, ss.u, ss.theta, ss.y), (x0, u0, theta0, y, xdot)
    return LinearModel(ss.name, *signals, A, B_u, B_theta, C, D_u, D_theta, *point)


def _vector(ss: StateSpace, label: str, signals: Signals, value: Any) -> np.ndarray:
    a = array(f"{ss.name}: {label}", value).reshape(-1)
    if a.shape != (len(signals),):
        raise SignalError(
            f"{ss.name}: {label} must have shape ({len(signals)},) for {signals!r}, got "
            f"{np.shape(value)}"
        )
    if not np.all(np.isfinite(a)):
        bad = [n for n, v in zip(signals.names, a, strict=True) if not math.isfinite(v)]
        raise SignalError(f"{ss.name}: {label} is not finite in {', '.join(bad)}")
    return a


def linearise_gas_generator(gg: GasGenerator, point: OperatingPoint) -> LinearModel:
    """Linearise the gas generator at a trimmed point; theta holds the health factors.

    Without a governor: its one state is the rotor speed, its inputs fuel flow, shaft power and
    ambient conditions.
    """
    return linearise(
        gg.state_space, point.x, point.u, point.theta, equations=gg.family.equations, z=point.z
    )


def linearise_generator(gen: Generator, point: GeneratorPoint) -> LinearModel:
    """Linearise one generator with exciter and balanced load at a steady point.

    On the rotor's axes, averaged over an electrical period (:mod:`apu_casadi.unit.averaged`); theta
    holds h where the load has no inductance and the neutral is grounded.  The rotor angle, which
    nothing depends on there, is left out with its eigenvalue zero.
    """
    return linearise(*generator_vectors(gen, point))


def linearise_joint(apu: Apu, point: JointPoint, free: Sequence[str] = ()) -> LinearModel:
    """Linearise the whole governed unit at a steady point; theta holds health factors and h.

    Coupled by (1)-(3) with the power of every instant, not with the exchange of 20 ms.

    Args:
        apu, point: unit and point.
        free: parameters of the unit by name (``machine.r_s``, ``gas_generator.eta_c``) that theta
            holds as well.

    Raises:
        SignalError: unknown parameters, or some on which nothing depends.
        ParameterError, OperatingPointError: the generators differ, or their loads.
    """
    ss, x, u, theta = joint_vectors(apu, point, tuple(free))
    equations = joint_equations(apu, load_kind(point.generator), tuple(free))
    return linearise(ss, x, u, theta, equations=equations, z=point.gas.z)
