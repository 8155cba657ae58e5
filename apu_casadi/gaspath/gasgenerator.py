"""The gas generator: a single-shaft turboshaft engine, stations 0-1-2-3-31-4-41-5-6-8.

Paper, section 5, Fig. 8 and Tables 2-5.  The equations are in :mod:`apu_casadi.gaspath.cycle`; the
design point fixes areas and map scales, off design everything follows from the residuals.

Rotor speed is the one state.  The improved method of the paper (IGDM, Algorithm 2, eq. 12) is
:func:`apu_casadi.gaspath.steady.trimming.initialise`, :meth:`GasGenerator.state_update` and
:meth:`~GasGenerator.output`, with a hook between the last two in :meth:`~GasGenerator.run`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Never

import casadi as ca
import numpy as np

from apu_casadi.core.backend import Caller, compiled
from apu_casadi.core.discretisation import linearly_implicit_midpoint
from apu_casadi.core.errors import OperatingPointError, SimulationError
from apu_casadi.core.runloop import run
from apu_casadi.core.sharing import Parametric, derived
from apu_casadi.core.signals import Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath import cycle
from apu_casadi.gaspath.conditions import RANGES
from apu_casadi.gaspath.cycle import RPM, Cycle, DesignPoint, GasGeneratorParameters, solve_design
from apu_casadi.gaspath.gas import Gas
from apu_casadi.gaspath.maps.mapfiles import MapTable, shipped
from apu_casadi.gaspath.maps.scaledmaps import MapCalibration, ScaledMap

__all__ = [
    "RPM",
    "DesignPoint",
    "GasGenerator",
    "GasGeneratorParameters",
    "GasGeneratorState",
    "MapChoice",
]

_MACH8 = cycle.Y.index("Mach8")
RESIDUAL_TOL = 1e-9  # largest residual (dimensionless) with which any result is used


@dataclass(frozen=True)
class MapChoice:
    """A map shape and where on it the design point lies.

    Args:
        table: the map (:func:`apu_casadi.gaspath.maps.mapfiles.read_map` reads CSV, GasTurb and GSP
            layouts).
        N_map_des, beta_des: speed and beta of the table at which the design point is put.
        calibration: the few calibrated numbers; identity by default.
    """

    table: MapTable
    N_map_des: float
    beta_des: float
    calibration: MapCalibration = field(default_factory=MapCalibration)

    def scaled(self, *, W: float, PR: float, eta: float) -> ScaledMap:
        """Return the map scaled so that its design location has these values."""
        return ScaledMap(
            table=self.table,
            N_map_des=self.N_map_des,
            beta_des=self.beta_des,
            W_des=W,
            PR_des=PR,
            eta_des=eta,
            cal=self.calibration,
        )


# CALIBRATED, not predicted: four numbers for the compressor, two for the turbine, fitted to the
# rows W2, T3, P3, T5 and HPCSM of Table 5 and HPCSM of Table 4; all other rows of Table 5 are left
# for checking.  The Reynolds exponent 0.18 lies in the range 0.1-0.2 known for small compressors.
COMPRESSOR_CALIBRATION = MapCalibration(
    a_W=0.03985831, n_Re=0.17623167, k_SM=1.02900428, a_SM=0.11723597
)
TURBINE_CALIBRATION = MapCalibration(a_W=0.07937522, c_PR=0.31182386)


def default_compressor() -> MapChoice:
    """AXI5 shape; calibrated to the paper's Tables 4 and 5 (see ``COMPRESSOR_CALIBRATION``)."""
    return MapChoice(shipped("axi5"), 1.0, 2.0, COMPRESSOR_CALIBRATION)


def default_turbine() -> MapChoice:
    """LPT2269 shape; calibrated to the paper's Table 5 (see ``TURBINE_CALIBRATION``).

    Its design point is put at the table's pressure ratio 5.5 rather than 6.0, so that Table 5,
    1.38 times the design pressure ratio, lies inside the table.
    """
    return MapChoice(shipped("lpt2269"), 100.0, 0.5, TURBINE_CALIBRATION)


@dataclass(frozen=True)
class GasGeneratorState:
    """State, algebraic unknowns, inputs and health at one instant, as packed vectors."""

    x: np.ndarray
    z: np.ndarray
    u: np.ndarray
    theta: np.ndarray


@dataclass(frozen=True)
class GasGenerator(Parametric):
    """A gas generator: parameters and two maps; everything else is derived.

    Args:
        parameters: design data.
        compressor_map, turbine_map: map shapes, scaled to the design point here.
        dt: default step of the discrete model, s (paper, section 3.3: 20 ms).
    """

    parameters: GasGeneratorParameters = field(default_factory=GasGeneratorParameters)
    compressor_map: MapChoice = field(default_factory=default_compressor)
    turbine_map: MapChoice = field(default_factory=default_turbine)
    dt: float = 0.02

    X: ClassVar[Signals] = cycle.X
    U: ClassVar[Signals] = cycle.U
    THETA: ClassVar[Signals] = cycle.THETA
    Y: ClassVar[Signals] = cycle.Y
    equation_names: ClassVar[tuple[str, ...]] = cycle.EQUATIONS

    # ------------------------------------------------------------------ equations

    @derived
    def gas(self) -> Gas:
        """The working gas."""
        return Gas(self.parameters.x_HC, self.parameters.gas_data)

    @derived
    def design(self) -> DesignPoint:
        """The design point, from the parameters alone.

        Raises:
            OperatingPointError: the design data admit no solution; names the worst equation.
        """
        return solve_design(self.parameters, self.gas)

    @derived
    def maps(self) -> tuple[ScaledMap, ScaledMap]:
        """The compressor and turbine maps scaled to the design point."""
        p, d = self.parameters, self.design
        return (
            self.compressor_map.scaled(W=p.W2, PR=p.PR_c, eta=p.eta_c),
            self.turbine_map.scaled(W=d.W_t, PR=d.PR_t, eta=p.eta_t),
        )

    @derived
    def cycle(self) -> Cycle:
        """The cycle equations with their exact Jacobians."""
        return Cycle(self.parameters, self.gas, self.design, *self.maps)

    @property
    def z(self) -> Signals:
        """The algebraic unknowns."""
        return self.cycle.z

    @property
    def equations(self) -> ca.Function:
        """Function (x, z, u, theta) -> (ode, alg, y): see :mod:`apu_casadi.gaspath.cycle`."""
        return self.cycle.equations

    @property
    def solve(self) -> ca.Function:
        """Function (z0, x, u, theta) -> z: see :class:`~apu_casadi.gaspath.cycle.Cycle`."""
        return self.cycle.solve

    @property
    def similar(self) -> ca.Function:
        """Function (x, u) -> first guess of z: see :class:`~apu_casadi.gaspath.cycle.Cycle`."""
        return self.cycle.similar

    @derived
    def state_space(self) -> StateSpace:
        """The continuous model as :class:`StateSpace`; z is started by similarity."""
        x, z, u, theta = self.cycle.symbols()
        ode, alg, _ = self.equations(x, z, u, theta)
        z_sol = self.solve(self.similar(x, u), x, u, theta)
        f, _, g = self.equations(x, z_sol, u, theta)
        return StateSpace.of(
            "gas_generator",
            (self.X, self.z, self.U, self.THETA, self.Y),
            (x, z, u, theta),
            dae=(ode, alg), f=f, g=g, z=z_sol,
        )  # fmt: skip

    # ------------------------------------------------------------------ discrete model (eq. 12)

    @derived
    def f(self) -> ca.Function:
        """State update of eq. (12): (x, u, theta, dt, z0) -> (x1, z, residual).

        ``x1 = f(x(k-1), u(k), theta(k), Pe(k))`` with Pe = ``u.PW``, by the linearly implicit
        midpoint rule.  ``z0`` starts the root finder; z and its re-evaluated residual come back.
        """
        x, z0, u, theta = self.cycle.symbols()
        dt = ca.MX.sym("dt")
        z = self.solve(z0, x, u, theta)
        ode, A, residual, _ = self.cycle.dfdx(x, z, u, theta)
        x1 = linearly_implicit_midpoint(x, ode, A, dt)
        return ca.Function(
            "gas_generator_f",
            [x, u, theta, dt, z0],
            [x1, z, residual],
            ["x", "u", "theta", "dt", "z0"],
            ["x1", "z", "residual"],
        )

    @derived
    def step(self) -> ca.Function:
        """State update and output in one: (x, u, theta, dt, z0) -> (x1, y, z, residual).

        Eq. (12) as a hot loop needs it; ``residual`` is the sum of update and output.
        """
        x, z0, u, theta = self.cycle.symbols()
        dt = ca.MX.sym("dt")
        z = self.solve(z0, x, u, theta)
        ode, A, r, z_x = self.cycle.dfdx(x, z, u, theta)
        x1 = linearly_implicit_midpoint(x, ode, A, dt)
        y, z1 = self.g(x1, u, theta, z + ca.mtimes(z_x, x1 - x))  # started along the tangent
        # a sum, not fmax, which would swallow NaN
        r = r + y[self.Y.index("residual")]
        names = ["x", "u", "theta", "dt", "z0"], ["x1", "y", "z", "residual"]
        return ca.Function("gas_generator_step", [x, u, theta, dt, z0], [x1, y, z1, r], *names)

    @derived
    def g(self) -> ca.Function:
        """Output of eq. (12): (x, u, theta, z0) -> (y, z); y holds the residual."""
        x, z0, u, theta = self.cycle.symbols()
        z = self.solve(z0, x, u, theta)
        _, _, y = self.equations(x, z, u, theta)
        return ca.Function(
            "gas_generator_g", [x, u, theta, z0], [y, z], ["x", "u", "theta", "z0"], ["y", "z"]
        )

    # ------------------------------------------------------------------ IGDM (Algorithm 2)

    @derived
    def _f_call(self) -> Caller:
        return Caller(compiled(self.f, build=False))

    @derived
    def _g_call(self) -> Caller:
        return Caller(compiled(self.g, build=False))

    @derived
    def stepper(self) -> Caller:
        """:attr:`step` for hot loops: generated C where there is a compiler, compiled once."""
        return Caller(compiled(self.step))

    @derived
    def _step_call(self) -> Caller:
        # a single run is not worth seconds of compiling, but takes a library that is there
        return Caller(compiled(self.step, build=False))

    def advance(
        self,
        x: np.ndarray,
        u: np.ndarray,
        theta: np.ndarray,
        z0: np.ndarray,
        dt: float,
        *,
        step: Caller | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """State update and output in one call: returns (x1, y, z).

        ``step`` is :attr:`stepper` in hot loops; by default nothing is compiled for this.

        Raises:
            SimulationError: the cycle could not be solved, or the exhaust is choked.
        """
        x1, y, z, r = (step or self._step_call)(x, u, theta, dt, z0)
        self._check(float(r[0]), x1 if np.isfinite(x1).all() else x, u, theta, "step")
        self._check_exit(y)
        return x1, y, z

    @derived
    def input_ranges(self) -> dict[str, tuple[float, float]]:
        """Inputs that the model is meant for, by name: lowest and highest value."""
        return {
            "Wf": (1e-6, self.gas.FAR_stoichiometric * 0.89 * self.parameters.W2 * 3),
            **RANGES,
        }

    def check_inputs(self, u: np.ndarray) -> None:
        """Refuse inputs outside what the model is meant for, naming each with its range.

        Raises:
            OperatingPointError: fuel flow not positive or beyond stoichiometric, altitude, Mach
                number, ISA deviation or humidity out of range.
        """
        v = self.U.unpack(np.asarray(u, float))
        ranges = self.input_ranges
        for name, (lo, hi) in ranges.items():
            if not np.all((v[name] >= lo) & (v[name] <= hi)):
                worst = np.ravel(v[name])[np.argmax(np.abs(np.ravel(v[name]) - (lo + hi) / 2))]
                raise OperatingPointError(
                    f"{name} = {worst:g} {self.U[name].unit} is outside [{lo:g}, {hi:g}]"
                )

    def state_update(
        self,
        x: np.ndarray,
        u: np.ndarray,
        theta: np.ndarray,
        *,
        z0: np.ndarray | None = None,
        dt: float | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """x(k) = f(x(k-1), u(k), theta(k), Pe(k)) (TransitionStateUpdate_I); returns (x, z).

        Raises:
            SimulationError: the cycle could not be solved; names the residual.
        """
        start = self.similar(x, u).full().ravel() if z0 is None else z0
        x1, z, r = self._f_call(x, u, theta, self.dt if dt is None else dt, start)
        self._check(float(r[0]), x, u, theta, "state update")
        return x1, z

    def output(
        self, x: np.ndarray, u: np.ndarray, theta: np.ndarray, *, z0: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """y(k) = g(x(k), u(k), theta(k), Pe(k)) (TransitionOutput_I); returns (y, z).

        Raises:
            SimulationError: the cycle could not be solved, or the exhaust is choked.
        """
        start = self.similar(x, u).full().ravel() if z0 is None else z0
        y, z = self._g_call(x, u, theta, start)
        self._check(float(y[self.Y.index("residual")]), x, u, theta, "output")
        self._check_exit(y)
        return y, z

    def _check_exit(self, y: np.ndarray) -> None:
        Mach8 = float(y[_MACH8])
        if Mach8 > 1.0:
            raise SimulationError(
                f"exhaust exit choked (Mach {Mach8:.3f}); the fixed exit is modelled subsonic only"
            )

    def _check(self, r: float, x: np.ndarray, u: np.ndarray, theta: np.ndarray, where: str) -> None:
        if r <= RESIDUAL_TOL:
            return
        at = ", ".join(
            f"{k} = {v:.6g}"
            for k, v in {**self.X.unpack(x), **self.U.unpack(u), **self.THETA.unpack(theta)}.items()
        )
        raise SimulationError(
            f"gas generator {where}: residual {r:.1e} > {RESIDUAL_TOL:.0e} at {at}; the point is "
            f"probably beyond surge or off the maps, or the step is too large"
        )

    def run(
        self,
        start: GasGeneratorState,
        inputs: np.ndarray,
        theta: np.ndarray | None = None,
        *,
        hook: Callable[[int, np.ndarray], np.ndarray] | None = None,
        output_noise: Callable[[int], np.ndarray] | None = None,
        dt: float | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Run Algorithm 2: update the state, let ``hook`` process it, compute the output.

        Args:
            start: from :func:`apu_casadi.gaspath.steady.trimming.initialise`.
            inputs: u at t_1 ... t_K, shape (6, K), columns packed by ``U``.
            theta: health factors, shape (4,) or (4, K); those of ``start`` by default.
            hook: ``StateProcess``: (k, x(k)) -> x(k); state noise, Monte Carlo, an estimator.
            output_noise: k -> v(k), shape (ny,), added to y.
            dt: step, s.

        Returns:
            x of shape (1, K+1) and y of shape (ny, K+1), the start included.
        """
        inputs = np.asarray(inputs, float)
        if inputs.ndim != 2 or inputs.shape[0] != len(self.U):
            raise SimulationError(f"inputs: shape ({len(self.U)}, K) expected, got {inputs.shape}")
        K = inputs.shape[1]
        th = start.theta if theta is None else np.asarray(theta, float)
        th = np.broadcast_to(th.reshape(len(self.THETA), -1), (len(self.THETA), K))
        dt = self.dt if dt is None else dt
        system = _Discrete(self, start, inputs, th, hook, dt)
        rows = [(system.x, system.y)]

        def record(k: int, _n: int, row: tuple[np.ndarray, np.ndarray]) -> None:
            x, y = row
            rows.append((x, y if output_noise is None else y + output_noise(k)))

        run(system, dt * np.arange(K + 1), record=record)
        X, Y = zip(*rows, strict=True)
        return np.array(X).T, np.array(Y).T


class _Discrete:
    """The discrete model on its way through a run: inputs and health of each step, and a hook."""

    def __init__(
        self,
        gg: GasGenerator,
        start: GasGeneratorState,
        inputs: np.ndarray,
        theta: np.ndarray,
        hook: Callable[[int, np.ndarray], np.ndarray] | None,
        dt: float,
    ) -> None:
        self.gg, self.inputs, self.theta, self.hook, self.dt = gg, inputs, theta, hook, dt
        self.x = start.x
        self.y, self.z = gg.output(start.x, start.u, start.theta, z0=start.z)

    def switch(self, events: Sequence[Never], t: float) -> None:
        """Nothing comes but inputs."""

    def advance(self, k: int, _until: float) -> tuple[int, tuple[np.ndarray, np.ndarray]]:
        """Update the state, process it, compute the output."""
        u, theta = self.inputs[:, k], self.theta[:, k]
        x, z = self.gg.state_update(self.x, u, theta, z0=self.z, dt=self.dt)
        if self.hook is not None:
            x = np.asarray(self.hook(k + 1, x), float).reshape(len(self.gg.X))
        self.x, (self.y, self.z) = x, self.gg.output(x, u, theta, z0=z)
        return 1, (self.x, self.y)
