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
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import SimulationError, ValidityWarning
from apu_casadi.core.means import RMS, Term, as_dict, settled, wanted
from apu_casadi.core.results import dataset
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.simulation import stepper
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.unit import runrecord, validity
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.control import governor
from apu_casadi.unit.events import (
    Ambient,
    Event,
    FaultChange,
    HealthChange,
    LoadChange,
    health_factors,
    in_order,
)
from apu_casadi.unit.machinestep import MEANS
from apu_casadi.unit.multirate import exchange_grid

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load

_GRID_TOL = 1e-9  # s; instants closer than this are one


@kept
def joint_state_space(
    apu: Apu,
    load: Load | str = "resistive",
    fault: Fault | str | None = None,
    integrals: tuple[str, ...] = (),
) -> StateSpace:
    """Return the unit as one :class:`StateSpace`.

    States are the rotor speed N, the governor's integrator Wf_I and those of the generator
    variant; algebraic unknowns those of the gas path (the generator's are eliminated, being
    linear); inputs the ambient conditions and those of the generator but its speed; parameters
    the health factors and those of the stator fault; outputs those of both models.

    Args:
        apu: the unit.
        load, fault: variant of the generator, see :meth:`Generator.state_space`.
        integrals: what of the generator is to be averaged, see :mod:`apu_casadi.core.means`: the
            time integrals are carried as further states ``int_P_total``, ``int_v_a^2``, and with
            them the time ``t_step`` since the step's start; the step's length ``h_step`` is then an
            input.  As states they cost IDAS nothing; as quadratures every step would solve the gas
            path once more.
    """
    gg, gen = apu.gas_generator, apu.generator.state_space(load, fault)
    own_u = Signals([s for s in gen.u if s.name != "w_r"])
    clock_signal = Signal("t_step", "s", "time since the step's start", nominal=0.02)
    X = Signals([
        *gg.X, Signal("Wf_I", "kg/s", "integrator of the governor", nominal=0.05), *gen.x,
        *([clock_signal] if integrals else []),
        *(_integral(gen, name) for name in integrals),
    ])  # fmt: skip
    length = [Signal("h_step", "s", "length of the step", nominal=0.02)] if integrals else []
    U = Signals([*(gg.U[n] for n in AMBIENT), *own_u, *length])
    TH, Y = Signals([*gg.THETA, *gen.theta]), Signals([*gg.Y, *gen.y])

    x, z = ca.MX.sym("x", len(X)), ca.MX.sym("z", len(gg.z))
    u, theta = ca.MX.sym("u", len(U)), ca.MX.sym("theta", len(TH))
    N, Wf_I, x_sg = x[0], x[1], x[2 : 2 + len(gen.x)]
    n_health = len(gg.THETA)
    health, severity = theta[:n_health], theta[n_health:]
    own = u[len(AMBIENT) : len(AMBIENT) + len(own_u)]
    inputs = dict(zip(own_u.names, ca.vertsplit(own), strict=True))
    u_sg = ca.vertcat(*(apu.w_r(N) if n == "w_r" else inputs[n] for n in gen.u.names))
    y_sg = gen.g(x_sg, u_sg, severity)
    fuel = governor(N=N, N_ref=apu.N_ref, Wf_I=Wf_I, par=apu.governor)
    PW = apu.PW(y_sg[gen.y.index("P_total")])
    u_gg = ca.vertcat(fuel.Wf, PW, u[: len(AMBIENT)])

    clock = [ca.MX(1.0)] if integrals else []
    share = x[X.index("t_step")] / u[U.index("h_step")] if integrals else ca.MX(0)

    def model(z: Any) -> tuple[Any, Any, Any]:
        N_dot, alg, y_gg = gg.equations(N, z, u_gg, health)
        rates = [Term.of(name).expression(gen, x_sg, y_sg, share) for name in integrals]
        ode = ca.vertcat(N_dot, fuel.Wf_I_dot, gen.f(x_sg, u_sg, severity), *clock, *rates)
        return ode, alg, ca.vertcat(y_gg, y_sg)

    z_sol = gg.solve(gg.similar(N, u_gg), N, u_gg, health)
    ode, alg, _ = model(z)
    f, _, y = model(z_sol)
    signals, symbols = (X, gg.z, U, TH, Y), (x, z, u, theta)
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
    gg, gen = apu.gas_generator, apu.generator
    ambient = Ambient() if ambient is None else ambient
    factors = {**dict.fromkeys(gg.THETA.names, 1.0), **health_factors(health or {})}
    events, first_load = in_order(events, duration), load
    pending = list(events)
    grid = exchange_grid(duration, dt, pending)
    point = apu.steady_state(load, ambient=ambient, health=factors)
    V_ref, w_r = point.generator.V_ref, apu.w_r(apu.N_ref)
    amb = dataclasses.astuple(ambient)
    fault: Fault | None = None

    def symmetric() -> bool:
        return fault is None and load.balanced

    def asked() -> tuple[str, ...]:
        """Return the means that this load and fault need."""
        return (*MEANS, *wanted(phasors=False, short=True, symmetric=symmetric()))

    def variant() -> tuple[StateSpace, GeneratorModel, np.ndarray, np.ndarray]:
        """Return joint model, generator model, inputs and parameters of load and fault now."""
        ss = joint_state_space(apu, load.kind, gen.fault_kind(load, fault), asked())
        u_sg = gen.inputs(load, w_r=w_r, V_ref=V_ref)
        rest = np.delete(u_sg, gen.variant(load, fault).u.index("w_r"))
        theta = np.concatenate([gg.THETA.pack(factors), gen.fault_vector(load, fault)])
        return ss, gen.variant(load, fault), np.concatenate([amb, rest, [dt]]), theta

    (ss, sg, u, theta), quad = variant(), asked()
    x = np.concatenate([point.gas.x, [point.gas["Wf"]], point.generator.x, np.zeros(1 + len(quad))])
    K = grid.size - 1
    Y = np.empty((len(gg.Y), K + 1))
    averages = {name: np.empty(K + 1) for name in (*MEANS, *RMS)}
    Y[:, 0] = point.gas.y
    y0 = point.generator.y
    I = math.sqrt(sum(y0[f"i_{p}"] ** 2 for p in "abc") / 3)
    for name in averages:
        averages[name][0] = y0.get(name, y0["V_t"] if name[0] == "V" else I)
    worst, nsteps = 0.0, 0
    for k in range(1, K + 1):
        t0, h = float(grid[k - 1]), float(grid[k] - grid[k - 1])
        n_sg = len(sg.x)
        old_load, old_fault, old, changed = load, fault, sg, False
        while pending and pending[0].t <= t0 + _GRID_TOL:
            event, changed = pending.pop(0), True
            if isinstance(event, HealthChange):
                factors.update(event.factors)
            elif isinstance(event, LoadChange):
                load = event.load
            elif isinstance(event, FaultChange):
                fault = event.fault
        if changed:  # all that comes at one instant is one switch
            w_r = apu.w_r(float(x[0]))
            (ss, sg, u, theta), quad = variant(), asked()
            x_sg = gen.transfer(
                x[2 : 2 + n_sg], old, sg,
                u=gen.inputs(old_load, w_r=w_r, V_ref=V_ref),
                theta=gen.fault_vector(old_load, old_fault),
                u_target=gen.inputs(load, w_r=w_r, V_ref=V_ref),
                theta_target=gen.fault_vector(load, fault),
            )  # fmt: skip
            x, n_sg = np.concatenate([x[:2], x_sg, np.zeros(1 + len(quad))]), len(sg.x)
        x[2 + n_sg :], u[-1] = 0.0, h
        angle = float(x[ss.x.index("theta_e")])
        fine = load.fineness
        run = stepper(ss, 1, solver=solver, rtol=fine * rtol, atol=fine * atol)
        try:
            r = run(x, u, theta, h, t0=t0)
        except SimulationError as error:
            raise _explained(apu, error, x, Y[:, :k], ambient, factors, grid[: k + 1]) from None
        x = r.x_end.copy()
        j = ss.x.index("theta_e")
        turn = (x[j] - angle) / (2 * math.pi)
        x[j] = math.remainder(x[j], 2 * math.pi)
        nsteps += int(r.stats["nsteps"])
        Y[:, k] = r.y[: len(gg.Y), -1]
        means = as_dict(quad, x[3 + n_sg :, None] / h)
        rms = settled(means, turn=turn, symmetric=symmetric(), phasors=False)
        for name, value in zip(averages, (*(means[n] for n in MEANS), *rms), strict=True):
            averages[name][k] = value.item()
        worst = max(worst, float(Y[gg.Y.index("residual"), k]))
        if not worst <= RESIDUAL_TOL:
            failed = SimulationError(f"{ss.name}: cycle residual {worst:.1e} > {RESIDUAL_TOL:.0e}")
            raise _explained(apu, failed, x, Y[:, :k], ambient, factors, grid[: k + 1])
        if progress is not None:
            progress(float(grid[k]), duration)
    values = dict(zip(gg.Y.names, Y, strict=True))
    values |= averages
    told = runrecord.asked(load=first_load, fault=None, ambient=ambient, events=events)
    ds = dataset(
        {"time": grid},
        {"time": values},
        signals=gg.Y,
        attrs={"solver": solver, "rtol": rtol, "atol": atol, "nsteps": nsteps, **told},
    )
    starved = validity.fuel_limited(apu, grid, values["N"], values["Wf"])
    unserved = validity.unserved(first_load, events, grid, values["P_e"])
    notes = [ValidityWarning(words) for words in (starved, unserved) if words]
    return validity.conclude(ds, validity.departures(gg, grid, values), notes)


def _explained(
    apu: Apu,
    error: SimulationError,
    x: np.ndarray,
    Y: np.ndarray,
    ambient: Ambient,
    health: Mapping[str, float],
    t: np.ndarray,
) -> SimulationError:
    """Return the error at t[-1] with the overload where that is the reason; Y is before it."""
    N = float(x[0])
    fuel = governor(N=N, N_ref=apu.N_ref, Wf_I=float(x[1]), par=apu.governor)
    PW = float(Y[apu.gas_generator.Y.index("PW"), -1])
    more = validity.overload(
        apu, N=N, Wf=fuel.Wf, PW=PW, ambient=dataclasses.asdict(ambient), health=health
    )
    last = validity.before(apu.gas_generator, t[-2], Y[:, -1])
    return SimulationError(f"at t = {t[-1]:.6g} s: {more or f'{error}; {last}'}")
