"""The whole unit as one model with one solver: gas generator, machine, exciter and governor.

Nothing is exchanged here and nothing is held: the machine turns at the rotor's speed of that very
instant, its instantaneous power loads the shaft, and the governor is continuous.  Built from the
same expressions as the multi-rate scheme of :mod:`apu_casadi.unit.multirate`, it is the truth
against which that scheme's error is measured; it is slower, because the gas path is then evaluated
at every step that the 400 Hz of the machine ask for.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ScenarioError, SimulationError, ValidityWarning
from apu_casadi.core.means import RMS, Term, as_dict, settled, wanted
from apu_casadi.core.results import dataset
from apu_casadi.core.runloop import run
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.simulation import stepper
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.unit import runrecord, validity
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.departures import departures
from apu_casadi.unit.events import Ambient, Event, Holding, SpeedChange, all_factors, in_order
from apu_casadi.unit.exchange import coupled
from apu_casadi.unit.jointfamily import JointFamily
from apu_casadi.unit.multirate import exchange_grid
from apu_casadi.unit.stepmeans import MEANS, rms_at_rest

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load


@kept
def joint_state_space(
    apu: Apu,
    load: Load | str = "resistive",
    fault: Fault | str | None = None,
    integrals: tuple[str, ...] = (),
    free: tuple[str, ...] = (),
) -> StateSpace:
    """Return the unit as one :class:`StateSpace`.

    States are the rotor speed N, those of the governor (Wf_I) and those of the generator variant;
    algebraic unknowns those of the gas path (the generator's are eliminated, being linear); inputs
    the ambient conditions and those of the generator but its speed; parameters the health factors
    and those of the stator fault; outputs those of both models.

    Args:
        apu: the unit.
        load, fault: variant of the generator, see :meth:`Generator.state_space`.
        integrals: what of the generator is to be averaged, see :mod:`apu_casadi.core.means`: the
            time integrals are carried as further states ``int_P_total``, ``int_v_a^2``, and with
            them the time ``t_step`` since the step's start; the step's length ``h_step`` is then an
            input.  As states they cost IDAS nothing; as quadratures every step would solve the gas
            path once more.
        free: parameters of the unit by name (``machine.r_s``) that theta has, too, at its end.
    """
    gen = apu.generator.state_space(load, fault)
    parts = JointFamily.of(apu, gen, free)
    family = parts.keep((_all_units, integrals), lambda: _all_units(parts, integrals))
    return parts.member(apu, gen, family, free)


def _all_units(parts: JointFamily, integrals: tuple[str, ...]) -> StateSpace:
    """The model of all units of a structure, theta with their numbers."""
    gg, gen, engines = GasGenerator, parts.gen, parts.engines
    own_u = [s for s in gen.u if s.name != "w_r"]
    clock = [Signal("t_step", "s", "time since the step's start", nominal=0.02)]
    length = [Signal("h_step", "s", "length of the step", nominal=0.02)]
    if not integrals:
        clock, length = [], []
    sums = [_integral(gen, name) for name in integrals]
    X = Signals([*gg.X, *parts.governor.X, *gen.x, *clock, *sums])
    U = Signals([*(gg.U[n] for n in AMBIENT), *own_u, *length])
    TH, Y = parts.theta, Signals([*gg.Y, *gen.y])

    x, z = ca.MX.sym("x", len(X)), ca.MX.sym("z", len(parts.z))
    u, theta = ca.MX.sym("u", len(U)), ca.MX.sym("theta", len(TH))
    ends = np.cumsum([0, 1, len(parts.governor.X), len(gen.x)]).tolist()
    N, x_gov, x_sg = (x[i:j] for i, j in pairwise(ends))
    of_engine, of_gen, link = parts.parts(theta)
    inputs = dict(zip(U.names, ca.vertsplit(u), strict=True))
    state = {"N": N, "x": x_gov, "x_gen": x_sg}
    u_gg, moves, y_sg = coupled(link, parts.machine, **state, inputs=inputs, fault=of_gen)
    share = x[X.index("t_step")] / u[U.index("h_step")] if integrals else ca.MX(0)

    def model(z: Any) -> tuple[Any, Any, Any]:
        N_dot, alg, y_gg = engines.equations(N, z, u_gg, of_engine)
        rates = [Term.of(name).expression(gen, x_sg, y_sg, share) for name in integrals]
        ode = ca.vertcat(N_dot, moves, *(ca.MX(1.0) for _ in clock), *rates)
        return ode, alg, ca.vertcat(y_gg, y_sg)

    z_sol = engines.solve(engines.start(N, u_gg, of_engine), N, u_gg, of_engine)
    ode, alg, _ = model(z)
    f, _, y = model(z_sol)
    signals, symbols = (X, parts.z, U, TH, Y), (x, z, u, theta)
    return StateSpace.of(f"joint_{gen.name}", signals, symbols, dae=(ode, alg), f=f, g=y, z=z_sol)


def _integral(gen: StateSpace, name: str) -> Signal:
    term = Term.of(name)
    output = f"{term.base}_a" if term.base in ("v", "i") else term.base
    unit = "1" if output == "1" else gen.y[output].unit
    # over one output interval, some 20 ms, and not over the run: hence the factor
    return Signal(
        f"int_{re.sub(r'[~^*]', '_', name)}",
        f"{unit}^2 s" if term.power == 2 else f"{unit} s",
        f"time integral of {name}",
        nominal=0.02 * term.nominal(gen),
    )


def simulate_monolithic(
    apu: Apu,
    *,
    duration: float,
    load: Load,
    ambient: Ambient | None = None,
    health: Mapping[str, float] | None = None,
    events: Sequence[Event] = (),
    dt: float = 0.02,
    solver: str = "idas",
    rtol: float = 1e-8,
    atol: float = 1e-10,
    progress: Callable[[float, float], None] | None = None,
) -> xr.Dataset:
    """Simulate the unit as one model, from the steady state that :func:`simulate_joint` starts in.

    Args:
        apu, duration, load, ambient, health, events: as for
            :func:`apu_casadi.unit.multirate.simulate_joint`; the load balanced at the start.
        dt: output interval, s; events are output instants too.  Means and rms values are over it.
        solver, rtol, atol: integrator and its tolerances; IDAS solves the gas path along with the
            states, CVODES through a root finder, which is slower.
        progress: called with (done, total) seconds after every output interval.

    Returns:
        xarray.Dataset on ``time`` with the names of a joint run.  Outputs of the gas generator are
        those of the instant, PW included.

    Raises:
        ScenarioError, OperatingPointError, SimulationError: as for ``simulate_joint``.

    Warns:
        ValidityWarning: as ``simulate_joint``.
    """
    apu.refuse_different("the one model of the unit")
    n = len(apu.machines)
    if isinstance(load, list | tuple):
        raise ScenarioError(f"load: {len(load)} loads; the one model of the unit has one for all")
    events = in_order(events, duration, generators=n)
    for e in events:
        if getattr(e, "generator", None) is not None:
            raise ScenarioError(f"{e!r}: the generators of the one model have the same load")
    day, factors = Ambient() if ambient is None else ambient, all_factors(health)
    start = Holding((load,) * n, (None,) * n, factors, day)
    if any(start.after(events[:k]).changing for k in range(len(events) + 1)):
        raise ScenarioError("the one model of the unit follows no profiles: give events instead")
    if any(isinstance(e, SpeedChange) for e in events):
        raise ScenarioError("the one model of the unit has one governed speed, of its parameters")
    grid = exchange_grid(duration, dt, events)
    system = _OneModel(
        apu,
        grid,
        load=load,
        ambient=day,
        health=factors,
        how={"solver": solver, "rtol": rtol, "atol": atol},
    )
    rows = np.empty((system.at_start().size, grid.size))
    rows[:, 0] = system.at_start()

    def record(k: int, n: int, row: np.ndarray) -> None:
        rows[:, k] = row

    run(system, grid, events, record=record, progress=progress)
    gg = apu.gas_generator
    values = dict(zip((*gg.Y.names, *MEANS, *RMS), rows, strict=True))
    values["P_total"] *= n / 2  # the model's is the power of two
    told = runrecord.asked(start=start, events=events)
    attrs = {**system.how, "nsteps": system.nsteps, **told}
    ds = dataset({"time": grid}, {"time": values}, signals=gg.Y, attrs=attrs)
    starved = validity.fuel_limited(apu, grid, values["N"], values["Wf"])
    unserved = validity.unserved(load, events, grid, values["P_e"])
    notes = [d.warning(ValidityWarning) for d in (starved, unserved) if d]
    return validity.conclude(ds, departures(gg, grid, values), notes)


class _OneModel:
    """The unit as one model on its way through a run.

    Args:
        load, ambient, health: at the start.
        how: solver, rtol and atol.
    """

    def __init__(
        self,
        apu: Apu,
        grid: np.ndarray,
        *,
        load: Load,
        ambient: Ambient,
        health: dict[str, float],
        how: dict[str, Any],
    ) -> None:
        self.apu, self.grid, self.ambient, self.how = apu, grid, ambient, how
        self.now = Holding((load,), (None,), health)
        self.point = apu.steady_state(load, ambient=ambient, health=health)
        self.y, self.nsteps, self.worst = self.point.gas.y, 0, 0.0
        own = (*apu.governor.start(self.point.gas["Wf"]), *self.point.generator.x)
        self.x = np.array([*self.point.gas.x, *own])  # without the integrals
        self._first = 1 + len(apu.governor.X)  # of the generator's states
        self._prepare()

    @property
    def symmetric(self) -> bool:
        """Whether the phases differ by rotation only."""
        return self.now.faults[0] is None and self.now.loads[0].balanced

    def _prepare(self) -> None:
        """Choose the models of load and fault, with their inputs and parameters."""
        gen, gg = self.apu.generator, self.apu.gas_generator
        self.quad = (*MEANS, *wanted(phasors=False, short=True, symmetric=self.symmetric))
        kind = gen.fault_kind(self.now.loads[0], self.now.faults[0])
        self.ss = joint_state_space(self.apu, self.now.loads[0].kind, kind, self.quad)
        self.sg = gen.variant(self.now.loads[0], self.now.faults[0])
        rest = np.delete(self._u_sg(), self.sg.u.index("w_r"))
        self.u = np.concatenate([dataclasses.astuple(self.ambient), rest, [0.0]])
        fault = gen.fault_vector(self.now.loads[0], self.now.faults[0])
        self.theta = np.concatenate([gg.THETA.pack(self.now.factors), fault])

    def _u_sg(self) -> np.ndarray:
        w_r, V_ref = self.apu.w_r(float(self.x[0])), self.point.generator.V_ref
        return self.apu.generator.inputs(self.now.loads[0], w_r=w_r, V_ref=V_ref)

    def at_start(self) -> np.ndarray:
        """Outputs and means at the first instant."""
        point = self.point.generator
        means = [*(point.y[n] for n in MEANS), *rms_at_rest(point).values()]
        return np.concatenate([self.point.gas.y, means])

    def switch(self, events: Sequence[Event], t: float) -> None:
        """Take the events of an instant, s, which are one switch."""
        if not events:
            return
        gen, old, u_old = self.apu.generator, self.sg, self._u_sg()
        theta_old = gen.fault_vector(self.now.loads[0], self.now.faults[0])
        self.now = self.now.after(events)
        self._prepare()
        theta = gen.fault_vector(self.now.loads[0], self.now.faults[0])
        x_sg = gen.transfer(
            self.x[self._first :],
            old,
            self.sg,
            u=u_old,
            theta=theta_old,
            u_target=self._u_sg(),
            theta_target=theta,
        )
        self.x = np.concatenate([self.x[: self._first], x_sg])

    def advance(self, k: int, _until: float) -> tuple[int, np.ndarray]:
        """Integrate over one output interval."""
        t, h = float(self.grid[k]), float(self.grid[k + 1] - self.grid[k])
        gg, at, fine = (
            self.apu.gas_generator,
            self.ss.x.index("theta_e"),
            self.now.loads[0].fineness,
        )
        self.u[-1] = h
        how = self.how | {n: fine * self.how[n] for n in ("rtol", "atol")}
        x0 = np.concatenate([self.x, np.zeros(1 + len(self.quad))])
        try:
            r = stepper(self.ss, 1, **how)(x0, self.u, self.theta, h, t0=t)
        except SimulationError as error:
            raise self._explained(error, k) from None
        n = self.x.size
        self.x, y = r.x_end[:n].copy(), r.y[: len(gg.Y), -1]
        turn = (self.x[at] - x0[at]) / (2 * math.pi)
        self.x[at] = math.remainder(self.x[at], 2 * math.pi)
        self.nsteps += int(r.stats["nsteps"])
        means = as_dict(self.quad, r.x_end[n + 1 :, None] / h)
        rms = settled(means, turn=turn, symmetric=self.symmetric, phasors=False)
        self.worst = max(self.worst, float(y[gg.Y.index("residual")]))
        if not self.worst <= RESIDUAL_TOL:
            words = f"{self.ss.name}: cycle residual {self.worst:.1e} > {RESIDUAL_TOL:.0e}"
            raise self._explained(SimulationError(words), k)
        self.y = y
        return 1, np.concatenate([y, *(means[n] for n in MEANS), *rms])

    def _explained(self, error: SimulationError, k: int) -> SimulationError:
        """Return the error of the interval from k with the overload where that is the reason."""
        N, gg = float(self.x[0]), self.apu.gas_generator
        more = validity.overload(
            self.apu,
            N=N,
            Wf=self.apu.link.fuel(N, self.x[1 : self._first].tolist()).Wf,
            PW=float(self.y[gg.Y.index("PW")]),
            ambient=dataclasses.asdict(self.ambient),
            health=self.now.factors,
        )
        last = validity.before(gg, self.grid[k], self.y)
        return SimulationError(f"at t = {self.grid[k + 1]:.6g} s: {more or f'{error}; {last}'}")
