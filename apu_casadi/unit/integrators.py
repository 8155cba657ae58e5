"""What integrates a generator over an exchange step, from the fastest to what always can.

An integrator is made for one *phase*, a load and a fault, and asked for steps.  One that cannot
take a step raises :class:`~apu_casadi.core.errors.NotApplicable` with the reason, and the next
one is asked.  Exact propagation holds for a linear load, a speed that is held, a whole exchange
step, and not right after a switch, when the windings settle within microseconds: there steps are
taken stride by stride (:mod:`apu_casadi.machine.collocated`) where no waveforms are wanted; CVODES
and IDAS always can.  With a C compiler it is a hundred times faster than real time.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Generic, NamedTuple, TypeVar

import casadi as ca
import numpy as np

from apu_casadi.core.errors import NotApplicable, SimulationError
from apu_casadi.core.profiles.profile import Varying
from apu_casadi.core.runloop import SAME_INSTANT
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.simulation import stepper
from apu_casadi.core.statespace import StateSpace
from apu_casadi.machine.collocated import Collocated
from apu_casadi.machine.course import Course, Numbers
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.generatormodel import GeneratorModel
from apu_casadi.machine.meanstep import USUAL, MeanStep
from apu_casadi.machine.propagation import Propagator, parts
from apu_casadi.machine.transition import SPEED_RANGE
from apu_casadi.unit.exchange import PAPER, Exchange
from apu_casadi.unit.stepmeans import StepMeans

if TYPE_CHECKING:
    from apu_casadi.machine.faults.fault import Fault
    from apu_casadi.machine.loads.load import Load

SOLVERS = ("auto", "cvodes", "idas", "propagator")
"""``"auto"``, also called ``"propagator"``: exact propagation where it holds, else CVODES."""
#: Tolerances of CVODES and IDAS; with them waveforms err by 2e-7 of peak, with ten times as much by
#: more than the 1e-6 to which exact propagation agrees.
RTOL, ATOL = 1e-9, 1e-11
WAVEFORMS = tuple(
    ["v_a", "v_b", "v_c", "i_a", "i_b", "i_c", "i_fault", "V_fd", "i_fd", "T_e", "P_total"]
)

#: Samples in an exchange step of exact propagation when no waveforms are kept and a
#: :class:`MeanStep` does not hold, by "is healthy": with 200, means of a severe fault err by 4e-4.
SUMMARY_SAMPLES = {True: 160, False: 400}
FINE_SAMPLE = 50e-6  # s; what stored waveforms are computed with, at most
SETTLED = 5e-3  # s; so long after a switch no step is propagated by tables
NO_TIMES, NO_WAVES = np.empty(0), np.empty((0, 0))
_LOG = logging.getLogger("apu_casadi")


@dataclass(frozen=True)
class Settings:
    """How the generators of a run are integrated.

    Args:
        way: how speed and fuel pass between the models.
        dt: length of a whole exchange step, s.
        waveform_dt: sampling of the waveforms, s; None: none are wanted.
        solver, rtol, atol: one of ``SOLVERS``, and its tolerances.
        noisy: whether the voltages have process noise.
    """

    way: Exchange = PAPER
    dt: float = 0.02
    waveform_dt: float | None = None
    solver: str = "auto"
    rtol: float = RTOL
    atol: float = ATOL
    noisy: bool = False

    @property
    def fast(self) -> bool:
        """Whether what is fast may be used, and compiled for it."""
        return self.solver in ("auto", "propagator")

    @property
    def exact(self) -> bool:
        """Whether exact propagation may be used at all."""
        return self.fast and self.way == PAPER and not self.noisy

    def n_out(self, h: float) -> int:
        """Samples stored in a step of length h, s."""
        return 1 if self.waveform_dt is None else max(1, round(h / self.waveform_dt))


@dataclass(frozen=True, eq=False)
class Phase:
    """A load and a fault of a generator, with the model and its parameters.

    Args:
        u: inputs; the speed among them does not matter.
        symmetric: whether the phases differ by rotation only.
    """

    gen: Generator
    load: Load
    fault: Fault | None
    ss: GeneratorModel
    u: np.ndarray
    theta: np.ndarray
    symmetric: bool


class Way(NamedTuple):
    """Load and fault on their way between two instants, s; one at least is made of profiles."""

    load: Load | Varying[Load]
    fault: Fault | Varying[Fault | None] | None
    begin: float
    end: float


class Step(NamedTuple):
    """A step that is asked for.

    Args:
        x, u: state at the start, and inputs.
        w_r, slope: electrical speed, rad/s, and its slope, rad/s2.
        h, t0: length and start, s.
        since: time since the last switch, s.
    """

    x: np.ndarray
    u: np.ndarray
    w_r: float
    slope: float
    h: float
    t0: float
    since: float


class Integrated(NamedTuple):
    """What an integrator gave.

    Args:
        x: state at the end.
        quad, means: names of what was averaged over the step, and values.
        t, w: instants of the samples, s, and waveforms, shape (``WAVEFORMS``, samples).
        nsteps: steps of the solver.
        exact: whether all of it was propagated exactly.
    """

    x: np.ndarray
    quad: tuple[str, ...]
    means: np.ndarray
    t: np.ndarray = NO_TIMES
    w: np.ndarray = NO_WAVES
    nsteps: int = 0
    exact: bool = True


class Integrator:
    """Takes steps of one phase, or says why it cannot.

    ``phase`` may be replaced by one of other numbers.
    """

    phase: Phase
    quad: tuple[str, ...] = ()

    def __call__(self, step: Step) -> Integrated:
        """Advance over a step.

        Raises:
            NotApplicable: another integrator is to be asked.
        """
        raise NotImplementedError

    def for_blocks(self) -> MeanStep | Propagator:
        """Return what propagates, where many steps may be one function; else NotApplicable."""
        raise NotApplicable("exact propagation does not hold, or is not asked for")

    def numbers(self, t: np.ndarray, before: float) -> tuple[MeanStep | Propagator, Numbers]:
        """Return what propagates over the first of steps with these middles, and its numbers.

        Args:
            before: middle of the step before, s.
        """
        raise NotApplicable("exact propagation does not hold, or is not asked for")

    def refine(self) -> bool:
        """Take finer strides from now on, where a step was refused; whether there are any."""
        return False

    def waves(self, w: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return instants and waveforms of the steps of a block, of all its samples."""
        return NO_TIMES, NO_WAVES


def integrators(
    phase: Phase, settings: Settings, means: StepMeans, way: Way | None = None
) -> list[Integrator]:
    """Return the integrators of a phase, in the order in which they are to be asked.

    Args:
        way: load and fault of the phase where they change in it.
    """
    always = Stepwise(phase, settings, means)
    if not settings.exact:
        return [always]
    given = phase, settings, means, way
    sampled: list[Integrator] = [Samples(*given, fine=f) for f in (False, True)]
    if settings.waveform_dt is not None:
        return [*sampled, always]
    whole, by_strides = Means(*given), ByStrides(phase, settings, means)
    return [whole, *(sampled if way is None else ()), by_strides, always]


F = TypeVar("F", MeanStep, Propagator)


class _Exact(Integrator, Generic[F]):
    """Exact propagation, prepared when it is first asked for."""

    phase: Phase
    settings: Settings
    quad: tuple[str, ...]

    otherwise: ClassVar[str]
    usual: ClassVar[int] = 0  # harmonics of steps that belong to no long course

    def __init__(
        self, phase: Phase, settings: Settings, means: StepMeans, way: Way | None = None
    ) -> None:
        self.phase, self.settings, self._way = phase, settings, way
        self._course: Course[F] | None = None
        turn = (1 - SPEED_RANGE) * phase.gen.machine.w_rated * settings.dt
        self.quad = means.quad(short=turn < 2 * math.pi, symmetric=phase.symmetric)
        self._made: F | None = None
        self._refused = ""

    def _prepare(self, u: np.ndarray, theta: np.ndarray, harmonics: int = 0) -> F:
        raise NotImplementedError

    def _on_its_way(self) -> Course[F]:
        """Return load and fault where they change."""
        assert self._way is not None
        if self._course is None:
            p, (load, fault, begin, end) = self.phase, self._way
            self._course = Course(
                p.gen, p.ss, load, fault, self._prepare, end, begin, usual=self.usual
            )
        return self._course

    def numbers(self, t: np.ndarray, before: float) -> tuple[F, Numbers]:
        """Return what propagates over the first of steps with these middles, and its numbers."""
        if self._way is not None:
            return self._on_its_way().numbers(t, before)
        fast, p = self.for_blocks(), self.phase
        severity = () if p.fault is None else tuple(p.fault.severity.values())
        return fast, Numbers.alike(fast.vector, t.size, p.u, fast.theta, np.array(severity))

    def refine(self) -> bool:
        """Take finer strides along the way; see :meth:`Course.refine`."""
        return self._course is not None and self._course.refine()

    def fast(self) -> F:
        """Return what propagates.

        Raises:
            NotApplicable: there is nothing for this load, fault and step.
        """
        if self._refused:
            raise NotApplicable(self._refused)
        if self._made is None:
            try:
                self._made = self._prepare(self.phase.u, self.phase.theta)
            except SimulationError as error:
                _LOG.info("%s: %s", self.otherwise, error)
                self._refused = str(error)
                raise NotApplicable(self._refused) from None
        return self._made

    def for_blocks(self) -> F:
        """Return what propagates."""
        return self.fast()

    def ready(self, step: Step) -> F:
        """Return what propagates, for a step that it is made for."""
        if abs(step.h - self.settings.dt) >= SAME_INSTANT:
            raise NotApplicable(f"{step.h:g} s are not a whole exchange step")
        if step.since < SETTLED - SAME_INSTANT:
            raise NotApplicable(f"{step.since:g} s after a switch the windings have not settled")
        if self._way is None:
            return self.fast()
        middle = step.t0 + step.h / 2
        before = middle - min(step.since, step.h)
        fast, now = self._on_its_way().numbers(np.array([middle]), before)
        fast.put(now.vector, now.theta[:, 0])
        return fast


class Means(_Exact[MeanStep]):
    """Steps of which only means are wanted."""

    otherwise = "samples are needed also for means"
    usual = USUAL

    def _prepare(self, u: np.ndarray, theta: np.ndarray, harmonics: int = USUAL) -> MeanStep:
        p, own = self.phase, {"dt": self.settings.dt, "quad": self.quad}
        return MeanStep(p.gen, p.ss, u, theta, **own, harmonics=harmonics)  # type: ignore[arg-type]

    def __call__(self, step: Step) -> Integrated:
        """Advance over a whole exchange step."""
        x, means = self.ready(step)(step.x, step.u, t0=step.t0)
        return Integrated(_wrapped(self.phase.ss, x), self.quad, means.ravel())


class Samples(_Exact[Propagator]):
    """Steps with samples, for waveforms or where means alone are not enough.

    Coarse waveforms are every k-th of samples fine enough for 1e-5 of peak.
    """

    otherwise = "exact propagation not used, CVODES instead"

    def __init__(
        self,
        phase: Phase,
        settings: Settings,
        means: StepMeans,
        way: Way | None = None,
        *,
        fine: bool = False,
    ) -> None:
        super().__init__(phase, settings, means, way)
        self.fine, self._every = fine, 0

    @property
    def every(self) -> int:
        """Samples to one that is stored: few where nothing ripples much, nor changes fast."""
        if self._every:
            return self._every
        p, s = self.phase, self.settings
        least, wanted = SUMMARY_SAMPLES[p.fault is None], s.n_out(s.dt)
        if s.waveform_dt is not None:
            least = max(least, round(s.dt / FINE_SAMPLE))
        every = -(-least // wanted)
        h, moves = s.dt / (every * wanted), self._way is not None
        given = self._on_its_way().extremes() if moves else [(p.u, p.theta)]
        self._every = every * max((parts(p.gen, p.ss, g, h, moves) for g in given), default=1)
        return self._every

    @property
    def n(self) -> int:
        """Samples in a step."""
        return self.every * self.settings.n_out(self.settings.dt)

    @property
    def stored(self) -> slice:
        """Those that are stored."""
        return slice(self.every - 1, None, self.every)

    def _prepare(self, u: np.ndarray, theta: np.ndarray, harmonics: int = 0) -> Propagator:
        p, outputs = self.phase, () if self.settings.waveform_dt is None else WAVEFORMS
        return Propagator(
            p.gen,
            p.ss,
            u,
            theta,
            n_out=self.n,
            dt=self.settings.dt,
            outputs=outputs,
            quad=self.quad,
            fine=self.fine,
            harmonics=harmonics,
        )

    def __call__(self, step: Step) -> Integrated:
        """Advance over a whole exchange step."""
        fast = self.ready(step)
        x, w, means = fast(step.x, step.u, t0=step.t0)
        t = fast.times(step.t0)[self.stored]
        return Integrated(
            _wrapped(self.phase.ss, x), self.quad, means.ravel(), t, w[:, self.stored]
        )

    def for_blocks(self) -> Propagator:
        """Return what propagates, where the coefficients are constant."""
        return _constant(self.fast())

    def numbers(self, t: np.ndarray, before: float) -> tuple[Propagator, Numbers]:
        """Return what propagates over steps, where the coefficients are constant."""
        fast, now = super().numbers(t, before)
        return _constant(fast), now

    def waves(self, w: np.ndarray, grid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the stored samples of the steps of a block."""
        if self.settings.waveform_dt is None:
            return NO_TIMES, NO_WAVES
        fast = self.fast()
        t = np.concatenate([fast.times(float(at))[self.stored] for at in grid[:-1]])
        if self.every == 1:
            return t, w
        kept = np.arange(self.n)[self.stored]
        return t, w[:, (self.n * np.arange(grid.size - 1)[:, None] + kept).ravel()]


def _constant(fast: Propagator) -> Propagator:
    if not fast.constant:
        raise NotApplicable(f"{fast.ss.name}: its coefficients depend on the rotor angle")
    return fast


class Stepwise(Integrator):
    """CVODES or IDAS, over any step."""

    phase: Phase
    settings: Settings
    means: StepMeans
    model: StateSpace

    def __init__(self, phase: Phase, settings: Settings, means: StepMeans) -> None:
        self.phase, self.settings, self.means = phase, settings, means
        self.model = ramped(phase.ss) if settings.way.ramp else phase.ss
        self._rows = phase.ss.y.indices(WAVEFORMS)
        self._at = phase.ss.u.index("w_r")
        self._solver = "idas" if settings.solver == "idas" else "cvodes"

    def __call__(self, step: Step) -> Integrated:
        """Integrate over any step."""
        short = step.h * step.w_r < 2 * math.pi
        quad = self.means.quad(short=short, symmetric=self.phase.symmetric)
        s, fine = self.settings, self.phase.load.fineness
        run = stepper(
            self.model,
            s.n_out(step.h),
            quad=quad,
            solver=self._solver,
            rtol=fine * s.rtol,
            atol=fine * s.atol,
        )
        x, u = step.x, step.u
        if s.way.ramp:
            x, u = np.append(x, step.w_r), u.copy()
            u[self._at] = step.slope
        r = run(x, u, self.phase.theta, step.h, t0=step.t0)
        x_end, nsteps = r.x_end[: len(self.phase.ss.x)], int(r.stats.get("nsteps", 0))
        means = np.array([r.mean[k] for k in quad])
        x_end = _wrapped(self.phase.ss, x_end)
        return Integrated(x_end, quad, means, r.t, r.y[self._rows], nsteps, exact=False)


class ByStrides(Integrator):
    """Steps of any length, at any time, of which only means are wanted."""

    def __init__(self, phase: Phase, settings: Settings, means: StepMeans) -> None:
        self.phase, self.settings, self.means = phase, settings, means

    def over(self, h: float) -> Collocated:
        """Return what takes a step of length h, s."""
        p, symmetric = self.phase, self.phase.symmetric
        quad = self.means.quad(short=h * p.gen.machine.w_rated < 2 * math.pi, symmetric=symmetric)
        longest = self.settings.dt, p.gen.machine.w_rated
        own: dict[str, Any] = {"longest": longest, "quad": quad, "symmetric": symmetric}
        return Collocated(p.ss, p.theta, h, **own)

    def __call__(self, step: Step) -> Integrated:
        """Advance over any step."""
        one = self.over(step.h)
        x, means = one(step.x, step.u)
        x, n = _wrapped(self.phase.ss, x), one.strides
        return Integrated(x, one.quad, means.ravel(), nsteps=n, exact=False)


def _wrapped(ss: StateSpace, x: np.ndarray) -> np.ndarray:
    """Keep the rotor angle small, so that its cosine stays accurate over hours; a copy."""
    x, at = x.copy(), ss.x.index("theta_e")
    x[at] = math.remainder(x[at], 2 * math.pi)
    return x


@kept
def ramped(ss: GeneratorModel) -> GeneratorModel:
    """Return a generator variant whose speed w_r is a state and its slope w_r_dot the input.

    It is one of a family as the variant is: that of the ramped models of all machines.
    """
    X = Signals([*ss.x, dataclasses.replace(ss.u["w_r"], name="w_r", default=None)])
    slope = Signal("w_r_dot", "rad/s^2", "slope of the electrical speed", nominal=1e3)
    U = Signals([slope if s.name == "w_r" else s for s in ss.u])
    at = ss.u.index("w_r")
    kind = ca.SX if ss.f.is_a("SXFunction") else ca.MX
    sizes = (("x", X), ("z", ss.z), ("u", U), ("theta", ss.theta))
    x, z, u, theta = (kind.sym(label, len(s)) for label, s in sizes)
    x_sg, rate = x[: len(ss.x)], u[at]
    u_sg = ca.vertcat(u[:at], x[len(ss.x)], u[at + 1 :])
    ode, alg = ss.residual(x_sg, z, u_sg, theta)
    made = GeneratorModel.of(
        f"{ss.name}_ramped",
        (X, ss.z, U, ss.theta, ss.y),
        (x, z, u, theta),
        dae=(ca.vertcat(ode, rate), alg),
        f=ca.vertcat(ss.f(x_sg, u_sg, theta), rate),
        g=ss.g(x_sg, u_sg, theta),
        z=ss.z_of(x_sg, u_sg, theta),
    )
    if ss.reduced is not None:  # a family
        inner, follow = ss.reduced
        return dataclasses.replace(made, reduced=(ramped(inner), follow))
    if isinstance(ss.family, GeneratorModel):
        return dataclasses.replace(made, family=ramped(ss.family), numbers=ss.numbers)
    return made
