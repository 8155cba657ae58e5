"""The gas generator: a single-shaft turboshaft engine, stations 0-1-2-3-31-4-41-5-6-8.

Paper, section 5, Fig. 8 and Tables 2-5.  The equations are in :mod:`apu_casadi.gaspath.cycle`; the
design point fixes areas and map scales, off design everything follows from the residuals.

Rotor speed is the one state.  The improved method of the paper (IGDM, Algorithm 2, eq. 12) is
:func:`apu_casadi.gaspath.steady.trimming.initialise`, :meth:`GasGenerator.state_update` and
:meth:`~GasGenerator.output`, with a hook between the last two in :meth:`~GasGenerator.run`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Never

import casadi as ca
import numpy as np

from apu_casadi.core.backend import compiled
from apu_casadi.core.calling import Caller
from apu_casadi.core.errors import OperatingPointError, ParameterError, SimulationError, nearest
from apu_casadi.core.profiles.profile import Profile, held
from apu_casadi.core.runloop import run
from apu_casadi.core.sharing import Parametric, derived, kept
from apu_casadi.core.signals import Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath import stations, unitnumbers
from apu_casadi.gaspath.conditions import RANGES
from apu_casadi.gaspath.cycle import Cycle
from apu_casadi.gaspath.cyclefunctions import CycleFunctions
from apu_casadi.gaspath.design import DesignPoint, solve_design
from apu_casadi.gaspath.designdata import RPM, GasGeneratorParameters
from apu_casadi.gaspath.gas import Gas
from apu_casadi.gaspath.maps.mapfiles import shipped
from apu_casadi.gaspath.maps.maptable import MapTable
from apu_casadi.gaspath.maps.scaledmaps import MapCalibration, ScaledMap

__all__ = [
    "RPM",
    "DesignPoint",
    "GasGenerator",
    "GasGeneratorParameters",
    "GasGeneratorState",
    "MapChoice",
]

_MACH8, _RESIDUAL = stations.Y.indices(("Mach8", "residual"))
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


@kept
def caller(family: CycleFunctions, which: str, *, build: bool = False) -> Caller:
    """Return a function of a family for calls from Python, shared by all its engines.

    Args:
        which: ``"f"``, ``"g"`` or ``"step"``.
        build: compile it if no library is found.
    """
    return Caller(compiled(getattr(family, which), build=build))


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

    X: ClassVar[Signals] = stations.X
    U: ClassVar[Signals] = stations.U
    THETA: ClassVar[Signals] = stations.THETA
    Y: ClassVar[Signals] = stations.Y
    equation_names: ClassVar[tuple[str, ...]] = stations.EQUATIONS

    # ------------------------------------------------------------------ what follows

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
        return solve_design(self.parameters)

    @property
    def rated_power(self) -> float:
        """Shaft power at the design point in whole kilowatts, W."""
        return 1e3 * round(float(self.design.values["PW"]) / 1e3)

    @derived
    def maps(self) -> tuple[ScaledMap, ScaledMap]:
        """The compressor and turbine maps scaled to the design point."""
        p, d = self.parameters, self.design
        return (
            self.compressor_map.scaled(W=p.W2, PR=p.PR_c, eta=p.eta_c),
            self.turbine_map.scaled(W=d.W_t, PR=d.PR_t, eta=p.eta_t),
        )

    @derived
    def numbers(self) -> np.ndarray:
        """All numbers of this engine, by :data:`~apu_casadi.gaspath.unitnumbers.NUMBERS`."""
        return unitnumbers.vector(self.parameters, self.gas, self.design, self.maps)

    @property
    def held(self) -> dict[str, float]:
        """The same by name."""
        return dict(zip(unitnumbers.NUMBERS.names, self.numbers.tolist(), strict=True))

    def full(self, theta: Any) -> np.ndarray:
        """Return the family's theta: the health factors, shape (4,), and this engine's numbers."""
        full = self._healthy.copy()
        full[: len(self.THETA)] = theta
        return full

    @derived
    def _healthy(self) -> np.ndarray:
        return np.concatenate([np.ones(len(self.THETA)), self.numbers])

    # ------------------------------------------------------------------ equations

    def _equations(self, *, held: bool) -> Cycle:
        tables = self.compressor_map.table, self.turbine_map.table
        return Cycle(self.parameters.gas_data, *tables, held)

    @derived
    def cycle(self) -> CycleFunctions:
        """The cycle equations of this engine with their exact Jacobians."""
        return CycleFunctions(self._equations(held=True), tuple(self.numbers.tolist()))

    @derived
    def family(self) -> CycleFunctions:
        """The same functions for all engines of this structure: theta is :meth:`full`.

        Compiled once, they serve every engine; no derivatives by the numbers.
        """
        return CycleFunctions(self._equations(held=True))

    @derived
    def by_parameters(self) -> CycleFunctions:
        """The same functions with theta the health factors and all parameters by dotted name.

        Exact derivatives by every parameter, the shift of the design point included.
        """
        return CycleFunctions(self._equations(held=False))

    @kept
    def with_free(self, *names: str) -> CycleFunctions:
        """Return the functions of this engine with some parameters behind the health factors.

        The way to estimate a parameter: it is an entry of theta like a health factor, with this
        engine's value as default, and its effect on the design point is in all derivatives.

        Raises:
            ParameterError: an unknown name, or one given twice; the nearest is named.
        """
        for n in names:
            if n not in unitnumbers.GIVEN:
                raise ParameterError(f"no parameter {n!r} {nearest(n, unitnumbers.GIVEN.names)}")
        if len(set(names)) < len(names) or not names:
            raise ParameterError(f"free parameters: {', '.join(names) or 'none'}; each once")
        return CycleFunctions(self._equations(held=False), tuple(self.numbers.tolist()), names)

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
        """Function (z0, x, u, theta) -> z: see :attr:`.CycleFunctions.solve`."""
        return self.cycle.solve

    @property
    def similar(self) -> ca.Function:
        """Function (x, u) -> first guess of z: see :attr:`.CycleFunctions.similar`."""
        return self.cycle.similar

    @derived
    def state_space(self) -> StateSpace:
        """The continuous model as :class:`StateSpace`; its family is that of :attr:`family`."""
        own, family = self.cycle.state_space, self.family.state_space
        return replace(own, family=family, numbers=tuple(self.numbers.tolist()))

    @property
    def f(self) -> ca.Function:
        """State update of eq. (12): (x, u, theta, dt, z0) -> (x1, z, residual)."""
        return self.cycle.f

    @property
    def step(self) -> ca.Function:
        """State update and output in one: (x, u, theta, dt, z0) -> (x1, y, z, residual)."""
        return self.cycle.step

    @property
    def g(self) -> ca.Function:
        """Output of eq. (12): (x, u, theta, z0) -> (y, z); y holds the residual."""
        return self.cycle.g

    # ------------------------------------------------------------------ IGDM (Algorithm 2)

    # Callers belong to the family.  A single run is not worth seconds of compiling, but takes a
    # library that is there.
    @derived
    def _f_call(self) -> Caller:
        return caller(self.family, "f")

    @derived
    def _g_call(self) -> Caller:
        return caller(self.family, "g")

    @derived
    def _step_call(self) -> Caller:
        return caller(self.family, "step")

    @derived
    def stepper(self) -> Caller:
        """The family's step for hot loops: generated C where there is a compiler."""
        return caller(self.family, "step", build=True)

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
        x1, y, z, r = (step or self._step_call)(x, u, self.full(theta), dt, z0)
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
        th = self.full(theta)
        start = self._similar(x, u, th) if z0 is None else z0
        x1, z, r = self._f_call(x, u, th, self.dt if dt is None else dt, start)
        self._check(float(r[0]), x, u, theta, "state update")
        return x1, z

    def output(
        self, x: np.ndarray, u: np.ndarray, theta: np.ndarray, *, z0: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """y(k) = g(x(k), u(k), theta(k), Pe(k)) (TransitionOutput_I); returns (y, z).

        Raises:
            SimulationError: the cycle could not be solved, or the exhaust is choked.
        """
        th = self.full(theta)
        start = self._similar(x, u, th) if z0 is None else z0
        y, z = self._g_call(x, u, th, start)
        self._check(float(y[_RESIDUAL]), x, u, theta, "output")
        self._check_exit(y)
        return y, z

    def _similar(self, x: np.ndarray, u: np.ndarray, full: np.ndarray) -> np.ndarray:
        made: np.ndarray = self.family.similar(x, u, full).full().ravel()
        return made

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
        inputs: np.ndarray | Mapping[str, float | Profile],
        theta: np.ndarray | Mapping[str, float | Profile] | None = None,
        *,
        hook: Callable[[int, np.ndarray], np.ndarray] | None = None,
        output_noise: Callable[[int], np.ndarray] | None = None,
        dt: float | None = None,
        steps: int | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Run Algorithm 2: update the state, let ``hook`` process it, compute the output.

        Args:
            start: from :func:`apu_casadi.gaspath.steady.trimming.initialise`.
            inputs: u at t_1 ... t_K, shape (6, K), columns packed by ``U``; or numbers and profiles
                by name, held over each step at their value in its middle, also where a profile
                jumps inside; names that are not given keep what ``start`` has.
            theta: health factors, shape (4,) or (4, K), or numbers and profiles by name; those of
                ``start`` by default.
            hook: ``StateProcess``: (k, x(k)) -> x(k); state noise, Monte Carlo, an estimator.
            output_noise: k -> v(k), shape (ny,), added to y.
            dt: step, s.
            steps: K, where ``inputs`` are by name.

        Returns:
            x of shape (1, K+1) and y of shape (ny, K+1), the start included.

        Raises:
            SignalError: an unknown name.
            OperatingPointError: inputs by name that are out of range.
            SimulationError: a wrong shape, or a step that cannot be solved.
        """
        dt = self.dt if dt is None else dt
        if isinstance(inputs, Mapping):
            if steps is None or steps < 1:
                raise SimulationError(f"steps = {steps!r}: inputs by name need a number of steps")
            inputs = held(self.U, inputs, start.u, dt * (np.arange(steps) + 0.5))
            self.check_inputs(inputs)
        inputs = np.asarray(inputs, float)
        if inputs.ndim != 2 or inputs.shape[0] != len(self.U):
            raise SimulationError(f"inputs: shape ({len(self.U)}, K) expected, got {inputs.shape}")
        K = inputs.shape[1]
        if isinstance(theta, Mapping):
            theta = held(self.THETA, theta, start.theta, dt * (np.arange(K) + 0.5))
        th = start.theta if theta is None else np.asarray(theta, float)
        th = np.broadcast_to(th.reshape(len(self.THETA), -1), (len(self.THETA), K))
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
