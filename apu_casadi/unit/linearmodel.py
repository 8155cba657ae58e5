"""A linear model with its operating point: eigenvalues, step responses, other tools' forms.

    dx/dt ~ xdot0 + A (x - x0) + B_u (u - u0) + B_theta (theta - theta0)
    y     ~ y0    + C (x - x0) + D_u (u - u0) + D_theta (theta - theta0)

:mod:`apu_casadi.unit.linearisation` makes them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from apu_casadi.core.errors import ApuError, SignalError
from apu_casadi.core.signals import Signals

if TYPE_CHECKING:
    import xarray as xr

_SMALL = 0.05  # participations below this are not listed


@dataclass(frozen=True)
class Eigenvalue:
    """One eigenvalue, or one complex pair, of a linear model.

    Args:
        value: 1/s; of a pair the one with positive imaginary part.
        time_constant: -1/real part, s; negative: it grows, infinite: it stays.
        damping: -real part/abs(value); 1 for a real stable one.
        frequency: imaginary part/(2 pi), Hz.
        participation: share of each state in the mode, largest first, those below 5 % left out.  It
            is abs(w_k v_k) of left and right eigenvector, over its sum; units cancel in it.
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
