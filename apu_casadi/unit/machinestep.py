"""The generators between two exchange instants: state, load, fault, and what integrates them.

:mod:`apu_casadi.unit.multirate` asks for steps, one by one or in blocks; here it is decided how
they are made.  ``solver="propagator"`` uses exact propagation where it holds: linear load, speed
held, no step shortened by an event, and not right after a switch, when the windings settle within
microseconds.  CVODES does the others.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import SimulationError
from apu_casadi.core.means import PARTS, RMS, as_dict, settled, wanted
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.simulation import stepper
from apu_casadi.core.statespace import StateSpace
from apu_casadi.machine.generator import GeneratorPoint
from apu_casadi.machine.meanstep import MeanStep
from apu_casadi.machine.propagation import Propagator
from apu_casadi.machine.transition import SPEED_RANGE
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.jointstep import BLOCK, BlockResult, JointBlock

if TYPE_CHECKING:
    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load

WAVEFORMS = ("v_a", "v_b", "v_c", "i_a", "i_b", "i_c", "i_fault", "V_fd", "i_fd", "T_e", "P_total")
MEANS = ("P_total", "P_e", "P_loss_fault")


class Exchange(NamedTuple):
    """How speed and fuel pass between the models over a step.

    Args:
        ramp: the machine's speed goes on with the step's predicted slope, instead of being held.
        mid_fuel: the fuel is that of the predicted mid-step, instead of that of the beginning.
        passes: times that each step is computed, the slope of the one before serving the next.
    """

    ramp: bool
    mid_fuel: bool
    passes: int = 1


EXCHANGES = {
    "paper": Exchange(False, False),
    "predicted": Exchange(True, True),
    "corrected": Exchange(True, True, passes=2),
    "predicted speed": Exchange(True, False),
    "predicted fuel": Exchange(False, True),
}
"""What ``simulate_joint(exchange=...)`` takes; the last two tell two parts of the error apart."""

#: Samples in an exchange step of exact propagation when no waveforms are kept and a
#: :class:`MeanStep` does not hold, by "is healthy".
SUMMARY_SAMPLES = {True: 160, False: 200}
#: Power of the torques over that of eq. (8), shares of the rated power, that is warned of.
EXCESS = 0.01
FINE_SAMPLE = 50e-6  # s; what stored waveforms are computed with, at most
SETTLED = 5e-3  # s; so long after a switch CVODES goes on, in the middle of a step if need be
_LOG = logging.getLogger("apu_casadi")
GRID_TOL = 1e-9  # s; instants closer than this are one


@kept
def ramped(ss: StateSpace) -> StateSpace:
    """Return a generator variant whose speed w_r is a state and its slope w_r_dot the input."""
    X = Signals([*ss.x, dataclasses.replace(ss.u["w_r"], name="w_r", default=None)])
    slope = Signal("w_r_dot", "rad/s^2", "slope of the electrical speed", nominal=1e3)
    U = Signals([slope if s.name == "w_r" else s for s in ss.u])
    at = ss.u.index("w_r")
    x, z, u, theta = (
        ca.SX.sym(label, len(s))
        for label, s in (("x", X), ("z", ss.z), ("u", U), ("theta", ss.theta))
    )
    x_sg, rate = x[: len(ss.x)], u[at]
    u_sg = ca.vertcat(u[:at], x[len(ss.x)], u[at + 1 :])
    ode, alg = ss.residual(x_sg, z, u_sg, theta)
    return StateSpace.of(
        f"{ss.name}_ramped",
        (X, ss.z, U, ss.theta, ss.y),
        (x, z, u, theta),
        dae=(ca.vertcat(ode, rate), alg),
        f=ca.vertcat(ss.f(x_sg, u_sg, theta), rate),
        g=ss.g(x_sg, u_sg, theta),
        z=ss.z_of(x_sg, u_sg, theta),
    )


class RawMeans(NamedTuple):
    """Means of one or more steps as they were averaged; :meth:`MachineStep.settle` goes on.

    Args:
        quad, symmetric: names of the means, and whether the phases differ by rotation only.
        values: shape (means, steps); ``MEANS`` come first.
        turn, w_r: electrical periods in each step, and electrical speed, rad/s.
        t: end of each step, s; one instant or (steps,).
    """

    quad: tuple[str, ...]
    symmetric: bool
    values: np.ndarray
    turn: float
    w_r: float
    t: Any


class MachineStep:
    """One of the two equal generators.

    Args:
        apu, point: the unit and the steady state to start from.
        load: that of the steady state.
        way: how speed and fuel pass between the models.
        dt: length of a whole exchange step, s.
        waveform_dt: sampling of the waveforms, s; None: none are wanted.
        solver, rtol, atol: integrator and its tolerances.
        phasors: whether phasors are wanted too.
    """

    def __init__(
        self,
        apu: Apu,
        point: GeneratorPoint,
        load: Load,
        way: Exchange,
        dt: float,
        waveform_dt: float | None,
        solver: str,
        rtol: float,
        atol: float,
        phasors: bool = False,
    ) -> None:
        """Take over the steady state; see the class."""
        self.apu, self.gen, self.way = apu, apu.generator, way
        self.V_ref, self.w_r = point.V_ref, apu.w_r(apu.N_ref)
        self.ss, self.x = point.ss, np.asarray(point.x, float)
        self.u, self.theta = np.array(point.u, float), np.zeros(0)
        self.load: Load = load
        self.fault: Fault | None = None
        self.dt, self.waveform_dt = dt, waveform_dt
        self.solver, self.rtol, self.atol = solver, rtol, atol
        self.phasors = phasors
        self.kept = (*MEANS, *RMS, *(PARTS if phasors else ()))  # what a step's means are
        self._short = (1 - SPEED_RANGE) * self.gen.machine.w_rated * dt < 2 * math.pi
        self.nsteps = self.propagated = 0
        self.spikes: list[str] = []
        self.excess: tuple[float, ...] = (
            0.0,
            0.0,
            0.0,
            0.0,
        )  # largest of torque power over (8), both, instant
        self._fast: dict[str, Propagator | MeanStep | None] = {}
        self._kept = slice(None)
        self._block: JointBlock | None = None
        self._since = math.inf  # s since the last switch
        self._noisy = False
        self._index()

    @property
    def may_propagate(self) -> bool:
        """Whether exact propagation was asked for, and the speed is held in a step."""
        return self.solver == "propagator" and self.way == EXCHANGES["paper"]

    def _index(self) -> None:
        self._angle = self.ss.x.index("theta_e")
        self._w = self.ss.u.index("w_r")
        self._rows = self.ss.y.indices(WAVEFORMS)

    def n_out(self, h: float) -> int:
        """Samples stored in a step of length h."""
        return 1 if self.waveform_dt is None else max(1, round(h / self.waveform_dt))

    def samples(self, grid: np.ndarray) -> int:
        """Waveform samples of a whole run, the start included; 0 where none are stored."""
        if self.waveform_dt is None:
            return 0
        return 1 + sum(self.n_out(float(h)) for h in np.diff(grid))

    def means_at_rest(self, point: GeneratorPoint) -> np.ndarray:
        """What a step's means would be in the steady state of a balanced load."""
        y = point.y
        I = math.sqrt(sum(y[f"i_{p}"] ** 2 for p in "abc") / 3)
        means = [*(y[n] for n in MEANS), *[y["V_t"]] * 3, *[I] * 3]
        if self.phasors:
            for q in "vi":
                for p, ahead, behind in ("acb", "bac", "cba"):
                    # at rotor angle zero, where a steady state starts: v_a = a cos + b sin, and
                    # the other phases are a third of a turn before and behind it
                    b = (y[f"{q}_{ahead}"] - y[f"{q}_{behind}"]) / math.sqrt(3.0)
                    means += [y[f"{q}_{p}"] / math.sqrt(2.0), -b / math.sqrt(2.0)]
        return np.array(means)

    def _quad(self, *, short: bool) -> tuple[str, ...]:
        means = wanted(phasors=self.phasors, short=short, symmetric=self.symmetric)
        return (*MEANS, *means, "T_e")

    @property
    def quad(self) -> tuple[str, ...]:
        """What is averaged over a whole step."""
        return self._quad(short=self._short)

    def _raw(self, quad: tuple[str, ...], means: np.ndarray, h: float, t: Any) -> RawMeans:
        """Return a copy of the means of steps of length h that end at t, s."""
        values = means.reshape(len(quad), -1).copy()
        return RawMeans(quad, self.symmetric, values, h * self.w_r / (2 * math.pi), self.w_r, t)

    def settle(self, raw: Sequence[RawMeans]) -> np.ndarray:
        """Return what is kept of the means of steps, as ``kept``, shape (kept, steps).

        Many steps at once, since one costs as much as a hundred.  All have the same ``quad`` and
        ``symmetric``.  Notes where the torque takes more than eq. (8) says.
        """
        values = np.concatenate([r.values for r in raw], axis=1)
        steps = [r.values.shape[1] for r in raw]
        turn, w_r = (np.repeat(x, steps) for x in ([r.turn for r in raw], [r.w_r for r in raw]))
        t = np.concatenate([np.atleast_1d(r.t) for r in raw])
        by_name = as_dict(raw[0].quad, values)
        more = settled(by_name, turn=turn, symmetric=raw[0].symmetric, phasors=self.phasors)
        torque = 2.0 * by_name["T_e"] * w_r / self.gen.machine.n_pp
        excess = torque - by_name["P_total"]
        k = int(np.argmax(excess))
        if excess[k] > self.excess[0]:
            at = (excess[k], torque[k], by_name["P_total"][k], t[k])
            self.excess = tuple(map(float, at))
        return np.concatenate([values[: len(MEANS)], more])

    @property
    def warnings(self) -> list[str]:
        """What must be known of the steps so far."""
        told = list(self.spikes)
        more, torque, power, t = self.excess
        if more > EXCESS * 2.0 * self.gen.machine.P_rated:
            told.append(
                f"eq. (8) gives too little: in the step that ends at t = {t:.6g} s the torque of "
                f"the two generators takes {torque / 1e3:.4g} kW of the shaft, eq. (8), with which "
                f"the gas generator is loaded, {power / 1e3:.4g} kW; {more / 1e3:.3g} kW are more "
                f"than {100 * EXCESS:g} % of the rated power. Eq. (8) holds output and extra loss "
                "of the fault only: near a short circuit the machine's own loss is missing"
            )
        return told

    @property
    def symmetric(self) -> bool:
        """Whether the phases differ by rotation only."""
        return self.fault is None and self.load.balanced and not self._noisy

    def switch(self, load: Load, fault: Fault | None, t: float = 0.0) -> None:
        """Change load and fault at the instant t, s; the flux linkages stay."""
        target, theta = self.gen.variant(load, fault), self.gen.fault_vector(load, fault)
        u_new = self.gen.inputs(load, w_r=self.w_r, V_ref=self.V_ref)
        self.x = self.gen.transfer(
            self.x, self.ss, target, u=self.u, theta=self.theta, u_target=u_new,
            theta_target=theta,
        )  # fmt: skip
        self.ss, self.u, self.theta = target, u_new, theta
        text = self.gen.spike(target, self.x, u_new, theta, t=t, load=load)
        if text is not None:
            self.spikes.append(text)
        self.load, self.fault = load, fault
        self._fast, self._block = {}, None
        self._since = 0.0
        self._index()

    def disturb(self, w1: np.ndarray, w2: np.ndarray) -> None:
        """Set the process noise of (5) and (6), V, for the next step."""
        names = ("w1_q", "w1_d", "w1_0", "w2_fd", "w2_kd", "w2_kq")
        self.u[self.ss.u.indices(names)] = np.concatenate([w1, w2])
        self._noisy = True

    def step(
        self, N: float, slope: float, h: float, t0: float
    ) -> tuple[np.ndarray, RawMeans, np.ndarray, np.ndarray]:
        """Advance over [t0, t0 + h]: end state, means, sample times and waveforms.

        The own state is left as it was: the caller may repeat the step.
        """
        x, quad, means, t, w = self._step(N, slope, h, t0)
        return x, self._raw(quad, means, h, t0 + h), t, w

    def _step(
        self, N: float, slope: float, h: float, t0: float
    ) -> tuple[np.ndarray, tuple[str, ...], np.ndarray, np.ndarray, np.ndarray]:
        """Advance as :meth:`step`; with the raw means their names."""
        self.w_r = self.apu.w_r(N)
        self.u[self._w] = self.w_r
        full = abs(h - self.dt) < GRID_TOL
        if full and self._ready:
            done = self._propagate(t0)
            if done is not None:
                x, means, t, w = done
                return x, self.quad, means.ravel(), t, w
        if full and self._may_follow:
            done = self._follow(t0)
            if done is not None:
                self._since += h
                x, means, t, w = done
                return x, self.quad, means, t, w
        self._since += h
        quad = self._quad(short=h * self.w_r < 2 * math.pi)
        x, means, t, w, nsteps = self._integrate(slope, h, t0, quad)
        self.nsteps += nsteps
        return self._wrapped(x), quad, means, t, w

    def _integrate(
        self, slope: float, h: float, t0: float, quad: tuple[str, ...], share: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, int]:
        """Integrate over h: end state, means, sample times, waveforms, steps of the solver.

        h is the first ``share`` of the step.
        """
        model, fine = ramped(self.ss) if self.way.ramp else self.ss, self.load.fineness
        within = (0.0, share)
        run = stepper(
            model,
            self.n_out(h),
            quad=quad,
            solver="cvodes" if self.solver == "propagator" else self.solver,
            rtol=fine * self.rtol,
            atol=fine * self.atol,
        )
        if self.way.ramp:
            u = self.u.copy()
            u[self._w] = self.apu.w_r(slope)
            r = run(np.append(self.x, self.w_r), u, self.theta, h, t0=t0, within=within)
        else:
            r = run(self.x, self.u, self.theta, h, t0=t0, within=within)
        means = np.array([r.mean[k] for k in quad])
        return r.x_end[: len(self.ss.x)], means, r.t, r.y[self._rows], int(r.stats.get("nsteps", 0))

    def _follow(self, t0: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
        """Integrate until the windings have settled, and propagate over the rest of the step."""
        rest = self._means(self.dt - SETTLED)
        if rest is None or not rest.valid(self.w_r):
            return None
        share = SETTLED / self.dt
        x, first, t, w, nsteps = self._integrate(0.0, SETTLED, t0, self.quad, share)
        try:
            x, then = rest(x, self.u, t0=t0 + SETTLED)
        except SimulationError as error:
            _LOG.debug("exact propagation refused the rest of a step: %s", error)
            return None
        self.nsteps += nsteps
        return self._wrapped(x), share * first + (1 - share) * then.ravel(), t, w

    def block(
        self,
        x: np.ndarray,
        z: np.ndarray,
        Wf_I: float,
        u: np.ndarray,
        theta: np.ndarray,
        grid: np.ndarray,
    ) -> tuple[BlockResult, RawMeans] | None:
        """Advance the whole unit over several exchange steps at once; None where that is not on."""
        if not self._ready or grid.size != BLOCK + 1:
            return None
        fast = self._means() if self.waveform_dt is None else self._samples()
        if fast is None or (isinstance(fast, Propagator) and not fast.constant):
            return None
        if np.abs(np.diff(grid) - self.dt).max() > GRID_TOL:
            return None
        if self._block is None:
            self._block = JointBlock(self.apu, fast)
        N = x[0]
        done = self._block(x, z, Wf_I, self.x, u, theta, self.u)
        if done is None:
            return None
        self.x = done.x_sg
        self.propagated += BLOCK
        self.w_r = self.apu.w_r(float(N))
        if self.waveform_dt is not None:
            n = fast.n_out
            kept = np.arange(n)[self._kept]
            columns = (n * np.arange(BLOCK)[:, None] + kept).ravel()
            done = done._replace(waves=done.waves[:, columns] if kept.size < n else done.waves)
        return done, self._raw(self.quad, done.means, self.dt, grid[1:])

    def block_times(self, grid: np.ndarray) -> np.ndarray:
        """Instants of the samples of a block."""
        fast = None if self.waveform_dt is None else self._samples()
        if fast is None:
            return np.empty(0)
        return np.concatenate([fast.times(float(t))[self._kept] for t in grid[:-1]])

    @property
    def _ready(self) -> bool:
        return self.may_propagate and self._since >= SETTLED - GRID_TOL and not self._noisy

    @property
    def _may_follow(self) -> bool:
        """Whether a step right after a switch, without waveforms, can be made in two parts."""
        return (
            self.may_propagate
            and self.waveform_dt is None
            and not self._noisy
            and self._since < SETTLED - GRID_TOL
            and self.dt >= 2 * SETTLED
        )

    def _means(self, length: float | None = None) -> MeanStep | None:
        """Return what makes steps without waveforms, whole ones or of a length, or None."""
        key = "means" if length is None else "rest"
        if key not in self._fast:
            dt = self.dt if length is None else length
            try:
                first = 1 - dt / self.dt
                self._fast[key] = MeanStep(
                    self.gen, self.ss, self.u, self.theta, dt=dt, quad=self.quad,
                    within=(first, 1 - first),
                )  # fmt: skip
            except SimulationError as error:
                _LOG.info("samples are needed also for means: %s", error)
                self._fast[key] = None
        made = self._fast[key]
        assert not isinstance(made, Propagator)
        return made

    def _samples(self, fine: bool = False) -> Propagator | None:
        """Return the propagator of this load and fault, or None where there is none."""
        key = "fine" if fine else "samples"
        if key not in self._fast:
            # coarse waveforms are every k-th of samples fine enough for 1e-5 of peak
            least = SUMMARY_SAMPLES[self.fault is None]
            if self.waveform_dt is not None:
                least = max(least, round(self.dt / FINE_SAMPLE))
            every = 1 if self.waveform_dt is None else -(-least // self.n_out(self.dt))
            n = least if self.waveform_dt is None else every * self.n_out(self.dt)
            outputs = () if self.waveform_dt is None else WAVEFORMS
            self._kept = slice(every - 1, None, every)
            try:
                self._fast[key] = Propagator(
                    self.gen, self.ss, self.u, self.theta, n_out=n, dt=self.dt,
                    outputs=outputs, quad=self.quad, fine=fine,
                )  # fmt: skip
            except SimulationError as error:
                _LOG.info("exact propagation not used, CVODES instead: %s", error)
                self._fast[key] = None
        made = self._fast[key]
        assert not isinstance(made, MeanStep)
        return made

    def _propagate(self, t0: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
        """Advance by exact propagation; None where it does not hold."""
        for way in ("means", "samples", "fine"):
            if way == "means" and self.waveform_dt is not None:
                continue
            fast = self._means() if way == "means" else self._samples(way == "fine")
            if fast is None or not fast.valid(self.w_r):
                continue
            try:
                if isinstance(fast, MeanStep):
                    x, means = fast(self.x, self.u, t0=t0)
                    t, w = np.empty(0), np.empty((0, 0))
                else:
                    x, w, means = fast(self.x, self.u, t0=t0)
                    t, w = fast.times(t0)[self._kept], w[:, self._kept]
            except SimulationError as error:
                _LOG.debug("exact propagation refused a step: %s", error)
                continue
            self.propagated += 1
            return self._wrapped(x), means, t, w
        return None

    def _wrapped(self, x: np.ndarray) -> np.ndarray:
        """Keep the rotor angle small, so that its cosine stays accurate over hours."""
        x = x.copy()
        x[self._angle] = math.remainder(x[self._angle], 2 * math.pi)
        return x
