"""The whole unit as one model with one solver: gas generator, machines, exciters and governor.

Nothing is exchanged here and nothing is held: the machines turn at the rotor's speed of that very
instant, their instantaneous power loads the shaft, and the governor is continuous.  Built from the
same expressions as the multi-rate scheme of :mod:`apu_casadi.unit.multirate`, it is the truth
against which that scheme's error is measured; it is slower, because the gas path is then evaluated
at every step that the 400 Hz of the machines ask for.

What follows a profile of time goes from its value at the beginning of an output interval to that
at its end along a straight line; where it jumps, an interval begins.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import SimulationError
from apu_casadi.core.means import Term
from apu_casadi.core.runloop import SAME_INSTANT, run
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.simulation import stepper
from apu_casadi.core.statespace import StateSpace
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.gaspath.steady.steadypoint import Limits
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.unit import runrecord, validity
from apu_casadi.unit.apu import Apu, JointPoint, groups
from apu_casadi.unit.departures import departures
from apu_casadi.unit.events import Event, Holding, Jump, SpeedChange, in_order, jumps
from apu_casadi.unit.exchange import coupled
from apu_casadi.unit.integrators import WAVEFORMS
from apu_casadi.unit.jointfamily import N_REF, Group, JointFamily, grouped
from apu_casadi.unit.machines import Of, kinds, means_of
from apu_casadi.unit.multirate import exchange_grid, load_notes, settled_start, start_of
from apu_casadi.unit.noise import Noise
from apu_casadi.unit.recorder import Recorder, Row, stored_severities
from apu_casadi.unit.stepmeans import RawMeans, StepMeans
from apu_casadi.unit.strictness import Strict

if TYPE_CHECKING:
    import xarray as xr

    from apu_casadi.core.profiles.profile import Profile, Varying
    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load
    from apu_casadi.unit.events import Ambient
    from apu_casadi.unit.multirate import AFault, ALoad

_NO_WAVES = np.empty((len(WAVEFORMS), 0))


@kept
def joint_state_space(
    apu: Apu,
    load: Load | str | tuple[Load | str, ...] = "resistive",
    fault: Fault | str | tuple[Fault | str | None, ...] | None = None,
    integrals: tuple[str, ...] | tuple[tuple[str, ...], ...] = (),
    free: tuple[str, ...] = (),
    of: tuple[tuple[int, ...], ...] | None = None,
    *,
    moving: bool = False,
) -> StateSpace:
    """Return the unit as one :class:`StateSpace`.

    States are the rotor speed N, those of the governor (Wf_I) and those of the generator variants;
    algebraic unknowns those of the gas path (the generators' are eliminated, being linear); inputs
    the ambient conditions and those of the generators but their speed; parameters the health
    factors and those of the stator faults; outputs those of all models.  Equal generators are
    computed once; where there are several groups, names are as in
    :func:`apu_casadi.unit.averaged.joint_averaged`: ``generator2.lam_fd``.

    Args:
        apu: the unit.
        load, fault: variant of the generators, see :meth:`Generator.state_space`; or one for each.
        integrals: what of the generators is to be averaged, see :mod:`apu_casadi.core.means`, or
            that of each group: the time integrals are carried as further states ``int_P_total``,
            ``int_v_a^2``, and with them the time ``t_step`` since the step's start; the step's
            length ``h_step`` is then an input.  As states they cost IDAS nothing; as quadratures
            every step would solve the gas path once more.
        free: parameters of the unit by name (``machine.r_s``) that theta has, too, at its end.
        of: numbers of the generators of each group; by default those of equal model, load, fault.
        moving: with integrals: the governed speed is an input ``N_ref``, and inputs and parameters
            go over the step to what further inputs ``..._end`` say.
    """
    loads, faults = apu.each("load", load), apu.each("fault", fault)
    if of is None:
        of = tuple(groups(zip(apu.machines, loads, faults, strict=True)))
    at = {k: (apu.generators[k[0] - 1], loads[k[0] - 1], faults[k[0] - 1]) for k in of}
    own = grouped(apu, of, {k: gen.state_space(*given) for k, (gen, *given) in at.items()})
    per = tuple((integrals,) * len(own) if not _each_group(integrals) else integrals)
    parts = JointFamily.of(apu, own, free)
    family = parts.keep((_all_units, per, moving), lambda: _all_units(parts, per, moving))
    return parts.member(apu, own, family, free)


def _each_group(integrals: Sequence[Any]) -> bool:
    return bool(integrals) and not isinstance(integrals[0], str)


def _all_units(parts: JointFamily, integrals: Sequence[Any], moving: bool) -> StateSpace:
    """The model of all units of a structure, theta with their numbers."""
    gg, own, engines = GasGenerator, parts.groups, parts.engines
    clock = [Signal("t_step", "s", "time since the step's start", nominal=0.02)]
    length = [Signal("h_step", "s", "length of the step", nominal=0.02)]
    if not any(integrals):
        clock, length = [], []
    sums = [
        s
        for g, names in zip(own, integrals, strict=True)
        for s in g.own(_integral(g.gen, name) for name in names)
    ]
    X = Signals(
        [*gg.X, *parts.governor.X, *(s for g in own for s in g.own(g.gen.x)), *clock, *sums]
    )
    fed = [s for g in own for s in g.own(s for s in g.gen.u if s.name != "w_r")]
    inputs = Signals([*(gg.U[n] for n in AMBIENT), *([N_REF] if moving else []), *fed])
    TH, Y = parts.theta, Signals([*gg.Y, *(s for g in own for s in g.own(g.gen.y))])
    ends = [_end(s) for s in (*inputs, *TH[: parts.own])] if moving else []
    U = Signals([*inputs, *length, *ends])

    x, z = ca.MX.sym("x", len(X)), ca.MX.sym("z", len(parts.z))
    u, theta = ca.MX.sym("u", len(U)), ca.MX.sym("theta", len(TH))
    share = x[X.index("t_step")] / u[U.index("h_step")] if clock else ca.MX(0)
    now, th = u[: len(inputs)], theta
    if moving:
        n, m = len(inputs), parts.own
        end = u[U.index(ends[0].name) :]
        now = now + share * (end[:n] - now)
        th = ca.vertcat(theta[:m] + share * (end[n:] - theta[:m]), theta[m:])
    sizes = [1, len(parts.governor.X), *(len(g.gen.x) for g in own)]
    N, x_gov, *x_gen = ca.vertsplit(x[: sum(sizes)], np.cumsum([0, *sizes]).tolist())
    values = dict(zip(inputs.names, ca.vertsplit(now), strict=True))
    shaft, of_engine = parts.shaft(th, values.get("N_ref")), parts.engine(th)
    machines = parts.driven(shaft, th, x_gen, values)
    u_gg, moves, y_gen = coupled(shaft, machines, N=N, x=x_gov, day=values)

    def model(z: Any) -> tuple[Any, Any, Any]:
        N_dot, alg, y_gg = engines.equations(N, z, u_gg, of_engine)
        rates = [
            Term.of(name).expression(g.gen, x_g, y_g, share)
            for g, names, x_g, y_g in zip(own, integrals, x_gen, y_gen, strict=True)
            for name in names
        ]
        ode = ca.vertcat(N_dot, moves, *(ca.MX(1.0) for _ in clock), *rates)
        return ode, alg, ca.vertcat(y_gg, *y_gen)

    z_sol = engines.solve(engines.start(N, u_gg, of_engine), N, u_gg, of_engine)
    ode, alg, _ = model(z)
    f, _, y = model(z_sol)
    signals, symbols = (X, parts.z, U, TH, Y), (x, z, u, theta)
    name = f"joint_{'_'.join(g.gen.name for g in own)}"
    return StateSpace.of(name, signals, symbols, dae=(ode, alg), f=f, g=y, z=z_sol)


def _end(s: Signal) -> Signal:
    return dataclasses.replace(s, name=f"{s.name}_end", doc=f"{s.doc}, at the step's end")


def _integral(gen: StateSpace, name: str) -> Signal:
    term = Term.of(name)
    output = term.base if term.base in gen.y or term.base == "1" else f"{term.base[0]}_a"
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
    load: ALoad | Sequence[ALoad],
    ambient: Ambient | Varying[Ambient] | None = None,
    health: Mapping[str, float | Profile] | None = None,
    fault: AFault | Sequence[AFault] | Mapping[int, AFault] = None,
    N_ref: float | Profile | None = None,
    events: Sequence[Event] = (),
    dt: float = 0.02,
    start_from: str = "balanced",
    strict: bool = False,
    limits: Limits | None = None,
    solver: str = "idas",
    rtol: float = 1e-8,
    atol: float = 1e-10,
    progress: Callable[[float, float], None] | None = None,
) -> xr.Dataset:
    """Simulate the unit as one model, from the steady state that :func:`simulate_joint` starts in.

    Args:
        apu, duration, load, ambient, health, fault, N_ref, events, start_from, strict, limits: as
            for :func:`apu_casadi.unit.multirate.simulate_joint`.
        dt: output interval, s; events and jumps of profiles are output instants too.  Means and rms
            values are over it, and profiles are straight within it.
        solver, rtol, atol: integrator and its tolerances; IDAS solves the gas path along with the
            states, CVODES through a root finder, which is slower.
        progress: called with (done, total) seconds after every output interval.

    Returns:
        xarray.Dataset on ``time`` with the names of a joint run, by ``generator`` where they do not
        stay equal, without waveforms.  Outputs of the gas generator are those of the instant, PW
        included.

    Raises:
        ScenarioError, OperatingPointError, SimulationError, ValidityError: as for
            ``simulate_joint``.

    Warns:
        ValidityWarning: as ``simulate_joint``.
    """
    events = in_order(events, duration, generators=len(apu.machines))
    start = start_of(apu, load, fault, health, ambient, N_ref)
    stops = sorted([*events, *jumps(start, events, duration)], key=lambda e: e.t)
    grid, rest = exchange_grid(duration, dt, stops), settled_start(start_from)
    of = kinds(apu, start, events)
    steered = start.N_ref is not None or any(isinstance(e, SpeedChange) for e in events)
    moving = steered or any(start.after(events[:k]).changing for k in range(len(events) + 1))
    how = {"solver": solver, "rtol": rtol, "atol": atol}
    system = _OneModel(apu, grid, of, start, how, settled=rest, moving=moving)
    means = {k: means_of(apu, k, phasors=False) for k in of}
    severities = stored_severities(events, *start.faults)
    record = Recorder(apu.gas_generator, grid, 0, means, severities=severities)
    system.means = means
    put = record.put
    if strict:
        put = Strict(system, grid, means, record.put, limits or Limits(), events)
    put(0, 1, system.at_start())
    run(system, grid, stops, record=put, progress=progress)
    rows = record.instants()
    told = runrecord.asked(start=start, events=events)
    attrs = {**system.how, "nsteps": system.nsteps, **told}
    more, signals = runrecord.followed(start, events, grid)
    rng = np.random.default_rng(0)  # of no noise
    ds = record.collect(apu, {**rows, **more}, Noise(), rng, attrs, signals)
    notes = [d.warning() for d in record.warnings]
    notes += load_notes(apu, record, start, events, rows)
    found = departures(apu.gas_generator, grid, rows, limits)
    return validity.conclude(ds, found, notes, strict=strict)


class _Variant(NamedTuple):
    """Equal generators while a load and a fault hold.

    Args:
        group, model: which they are, and the model of one.
        quad: what is averaged.
        symmetric: whether the phases differ by rotation only.
        u, theta: inputs and parameters.
    """

    group: Group
    model: GeneratorModel
    quad: tuple[str, ...]
    symmetric: bool
    u: np.ndarray
    theta: np.ndarray


class _OneModel:
    """The unit as one model on its way through a run.

    Args:
        of: numbers of the generators that stay equal.
        start: what holds from the start.
        how: solver, rtol and atol.
        settled: whether loads and faults have been there for long.
        moving: whether anything follows a profile, or the governed speed is given.
    """

    means: Mapping[tuple[int, ...], StepMeans]
    point: JointPoint

    def __init__(
        self,
        apu: Apu,
        grid: np.ndarray,
        of: Sequence[tuple[int, ...]],
        start: Holding,
        how: dict[str, Any],
        *,
        settled: bool,
        moving: bool,
    ) -> None:
        self.apu, self.grid, self.of, self.how = apu, grid, tuple(of), how
        self.now, self.moving, self.settled = start, moving, settled
        self.here = here = start.at(0.0)
        there: tuple[Any, ...] = (here.loads, here.faults)
        if not settled:
            there = [x.balanced_part for x in here.loads], (None,) * len(here.loads)
        more = {} if here.N_ref is None else {"N_ref": here.N_ref}
        self.point = apu.steady_state(*there, ambient=here.ambient, health=here.factors, **more)
        self.y, self.nsteps, self.worst = self.point.gas.y, 0, 0.0
        own = [self.point.of(k[0]).x for k in of]
        shaft = [*self.point.gas.x, *apu.governor.start(self.point.gas["Wf"])]
        self._first = len(shaft)  # of the generators' states
        self.x = np.concatenate([shaft, *own])  # without the integrals
        self._enter(here._replace(loads=tuple(there[0]), faults=tuple(there[1])))

    def _variants(self, here: Holding) -> list[_Variant]:
        """Return the generators of an instant, at the speed that they have."""
        loads, faults = here.loads, here.faults
        gens = [self.apu.generators[k[0] - 1] for k in self.of]
        models = {
            k: gen.variant(loads[k[0] - 1], faults[k[0] - 1])
            for gen, k in zip(gens, self.of, strict=True)
        }
        made = []
        for gen, group in zip(gens, grouped(self.apu, self.of, models), strict=True):
            at = group.numbers[0]
            load, fault = loads[at - 1], faults[at - 1]
            w_r = self.apu.link_of(group.numbers).w_r(float(self.x[0]))
            u = gen.inputs(load, w_r=w_r, V_ref=self.point.of(at).V_ref)
            symmetric = fault is None and load.balanced
            quad = StepMeans(gen, phasors=False).quad(short=True, symmetric=symmetric)
            theta, model = gen.fault_vector(load, fault), models[group.numbers]
            made.append(_Variant(group, model, quad, symmetric, u, theta))
        return made

    def _enter(self, here: Holding) -> None:
        """Choose the models of loads and faults, with their inputs and parameters."""
        self.here, self.parts = here, self._variants(here)
        args = here.loads, self._fault_kinds(here), tuple(p.quad for p in self.parts)
        kinds = tuple(x.kind for x in here.loads)
        self.ss = joint_state_space(self.apu, kinds, *args[1:], of=self.of, moving=self.moving)
        self.u, self.theta = self._vectors(here, self.parts)

    def _fault_kinds(self, here: Holding) -> tuple[Any, ...]:
        pairs = zip(self.apu.generators, here.loads, here.faults, strict=True)
        return tuple(gen.fault_kind(load, fault) for gen, load, fault in pairs)

    def _vectors(self, here: Holding, parts: Sequence[_Variant]) -> tuple[np.ndarray, np.ndarray]:
        """Return inputs, without lengths and ends, and parameters of an instant."""
        day = dataclasses.astuple(here.ambient)
        N_ref = [self.apu.N_ref if here.N_ref is None else here.N_ref] if self.moving else []
        fed = [np.delete(p.u, p.group.gen.u.index("w_r")) for p in parts]
        health = GasGenerator.THETA.pack(here.factors)
        return np.concatenate([day, N_ref, *fed]), np.concatenate(
            [health, *(p.theta for p in parts)]
        )

    def at_start(self) -> Row:
        """What is recorded of the first instant."""
        of = []
        for p in self.parts:
            numbers = p.group.numbers
            at = self.point.of(numbers[0])
            fault = self.here.faults[numbers[0] - 1]
            of.append(Of(numbers, self.means[numbers].at_rest(at), fault, _NO_WAVES))
        return Row(self.point.gas.y, of, self.here.factors, np.zeros(1))

    def switch(self, events: Sequence[Event | Jump], t: float) -> None:
        """Take the events of an instant, s, which are one switch."""
        self.now = self.now.after(events)
        self._go_on(self.now.at(t + 2 * SAME_INSTANT), switched=bool(events) or t == 0.0)

    def _go_on(self, here: Holding, *, switched: bool) -> None:
        """Let loads and faults be others from now on; the flux linkages stay."""
        before = self.parts
        was = self.here.loads, self.here.faults
        self._enter(here)
        x, states = self.x[self._first :], []
        sizes = np.cumsum([len(p.group.gen.x) for p in before])[:-1]
        for old, new, x_gen in zip(before, self.parts, np.split(x, sizes), strict=True):
            k = new.group.numbers[0] - 1
            changed = (was[0][k], was[1][k]) != (here.loads[k], here.faults[k])
            if old.model != new.model or (switched and changed):
                x_gen = self.apu.generators[k].transfer(
                    x_gen,
                    old.model,
                    new.model,
                    u=old.u,
                    theta=old.theta,
                    u_target=new.u,
                    theta_target=new.theta,
                )
            states.append(x_gen)
        self.x = np.concatenate([self.x[: self._first], *states])

    def _ends(self, t: float, h: float) -> np.ndarray:
        """Return what inputs and parameters go to over an interval, and let them begin there.

        Where load or fault have other equations at an end than in the middle, as where a fault
        begins, they stay what they are in the middle.
        """
        if not self.now.changing:
            return np.concatenate([self.u, self.theta])
        self._go_on(self.now.at(t + h / 2), switched=False)
        near = min(2 * SAME_INSTANT, h / 4)
        first, last = (self.now.at(t + s) for s in (near, h - near))
        kinds = [self._kinds(each) for each in (self.here, first, last)]
        for k, (middle, *others) in enumerate(zip(*kinds, strict=True)):
            if any(other != middle for other in others):
                first, last = (_as_in(each, self.here, k) for each in (first, last))
        self.u, self.theta = self._vectors(first, self._variants(first))
        return np.concatenate(self._vectors(last, self._variants(last)))

    def _kinds(self, here: Holding) -> list[Any]:
        """What the equations of each generator depend on."""
        pairs = zip(self.apu.generators, here.loads, here.faults, strict=True)
        return [(gen.variant(*given), given[0].balanced) for gen, *given in pairs]

    def advance(self, k: int, _until: float) -> tuple[int, Row]:
        """Integrate over one output interval."""
        t, h = float(self.grid[k]), float(self.grid[k + 1] - self.grid[k])
        ends = self._ends(t, h) if self.moving else np.empty(0)
        gg, fine = self.apu.gas_generator, min(x.fineness for x in self.here.loads)
        angles = [i for i, n in enumerate(self.ss.x.names) if n.endswith("theta_e")]
        how = self.how | {n: fine * self.how[n] for n in ("rtol", "atol")}
        x0 = np.concatenate([self.x, np.zeros(len(self.ss.x) - self.x.size)])
        try:
            r = stepper(self.ss, 1, **how)(
                x0, np.concatenate([self.u, [h], ends]), self.theta, h, t0=t
            )
        except SimulationError as error:
            raise self._explained(error, k) from None
        n = self.x.size
        self.x, y = r.x_end[:n].copy(), r.y[: len(gg.Y), -1]
        turns = (self.x[angles] - x0[angles]) / (2 * math.pi)
        self.x[angles] = [math.remainder(a, 2 * math.pi) for a in self.x[angles]]
        self.nsteps += int(r.stats["nsteps"])
        self.worst = max(self.worst, float(y[gg.Y.index("residual")]))
        if not self.worst <= RESIDUAL_TOL:
            words = f"{self.ss.name}: cycle residual {self.worst:.1e} > {RESIDUAL_TOL:.0e}"
            raise self._explained(SimulationError(words), k)
        self.y = y
        return 1, Row(
            y, self._made(r.x_end[n + 1 :] / h, turns, t + h, h), self.here.factors, np.zeros(0)
        )

    def _made(self, means: np.ndarray, turns: np.ndarray, t: float, h: float) -> list[Of]:
        """Return what is recorded of the generators in an interval that ended at t, s."""
        made, ends = [], np.cumsum([len(p.quad) for p in self.parts])[:-1]
        for p, own, turn in zip(self.parts, np.split(means, ends), turns.tolist(), strict=True):
            w_r = 2 * math.pi * turn / h
            raw = RawMeans(p.quad, p.symmetric, own[:, None], turn, w_r, t)
            k = p.group.numbers
            made.append(Of(k, raw, self.here.faults[k[0] - 1], _NO_WAVES))
        return made

    def _explained(self, error: SimulationError, k: int) -> SimulationError:
        """Return the error of the interval from k with the overload where that is the reason."""
        N, gg = float(self.x[0]), self.apu.gas_generator
        more = validity.overload(
            self.apu,
            N=N,
            Wf=self.apu.shaft.fuel(N, self.x[1 : self._first].tolist()).Wf,
            PW=float(self.y[gg.Y.index("PW")]),
            ambient=dataclasses.asdict(self.here.ambient),
            health=self.here.factors,
        )
        last = validity.before(gg, self.grid[k], self.y)
        return SimulationError(f"at t = {self.grid[k + 1]:.6g} s: {more or f'{error}; {last}'}")


def _as_in(here: Holding, middle: Holding, k: int) -> Holding:
    """Return what holds with load and fault of the k-th generator of another instant."""
    loads, faults = list(here.loads), list(here.faults)
    loads[k], faults[k] = middle.loads[k], middle.faults[k]
    return here._replace(loads=tuple(loads), faults=tuple(faults))
