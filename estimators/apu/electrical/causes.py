"""What a change in the waveforms of a generator is: a short circuit, a sensor, a winding, a load.

Each hypothesis is a filter, run over a short piece of recording around the change from the same
start.  Its likelihood is that of all readings, unknowns and their priors included, so that
likelihoods compare, and with prior odds give probabilities.

=================== ============================================================================
healthy             nothing that the filter does not know
short circuit a     one phase has a severity, which comes with the change (b, c)
hot winding         field and stator have other resistances
field winding       turns of the field are shorted from the change on
sensor i_a          that current says nothing from the change on, stuck, biased or noisy (i_b, ...)
sensor i_fd         the same, or reads a share more or less
sensor w_r          the same of the speed, in place of which the voltages' angle stands
sensor V_fd         the same of the field's voltage, whose error acts as unknown steps
voltage sensors     the same of the phases' voltages
harmonics           the currents have harmonics that the voltages have not
=================== ============================================================================

What a failed current sensor reads is taken for noise about the prediction of the other sensors,
with the variance that is found, or for its own noise about an offset, and harmonics have the
amplitudes that are found; half the logarithm of the number of readings is taken off for each
(Schwarz 1978, Annals of Statistics 6, 461).

Shorted turns of the field (:mod:`apu_casadi.machine.faults.fieldshort`) leave its flux, referred to
all turns, where it is, and raise what is read of its current, the voltage and the resistance, both
so referred, by 1/(1 - mu_f).  A current sensor that reads as much more does not: in a machine at
rest both are alike to half a unit of log-likelihood, and the prior weights decide.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from apu_casadi.core.backend import rarely
from apu_casadi.core.errors import ApuError
from apu_casadi.machine.machinedata import MachineParameters
from apu_casadi.machine.park import PHASE_ANGLE, PHASES
from estimators.apu.electrical.electricalfilter import ElectricalFilter, electrical_filter
from estimators.apu.electrical.terminalsignals import JUMP_SIZES, MEASURED, PHASES_V
from estimators.apu.electrical.tuning import RESET_SIGMA
from estimators.apu.sensorfailures import failure
from estimators.apu.sensors import SensorSet
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import FilterResult, run
from estimators.information.posterior import named_posterior
from estimators.models.filtermodel import Unknown
from estimators.models.recording import Recording

__all__ = ["BEFORE", "PRIOR", "Causes", "causes_of_change", "kind_of", "onset_of", "probabilities"]

BEFORE, AFTER = 0.01, 0.03  # s of the piece around the change
UNKNOWN = 1e4  # A; standard deviation of a reading that says nothing
VOLTAGE_ERRORS = (10.0, 100.0)  # V
FIELD_ERRORS = (3.0, 30.0)  # V
ORDERS = (5, 7, 11)
SPEED_MISSES = 4.0  # deviations of the speed readings, from which their sensor may have failed
#: Prior weights of the hypotheses' kinds; a kind with several members shares its own.
PRIOR = {
    "healthy": 1.0,
    "short circuit": 1.0,
    "hot winding": 0.3,
    "field winding": 0.3,
    "sensor": 0.3,
    "voltage sensors": 0.3,
    "harmonics": 0.3,
}
FEWEST = 100  # samples that a verdict takes
COARSE, FINEST = 0.01, 0.00125  # s; between the instants that are tried for an onset
TURNS = (
    0.1  # scale of the share of the field's turns that are shorted, and of an error of its current
)
LOOSE = 0.01  # what the errors of both readings of the field have beside, relative
FIELD_MEAN = 0.0025  # s before and after the change, over which the field's current is averaged


@dataclass(frozen=True)
class Causes:
    """What a change is.

    Args:
        t: its instant, s.
        probability: of each hypothesis.
        failure: of sensors by hypothesis, how they failed, with probabilities
            (:mod:`estimators.apu.sensorfailures`); of the gas path, which factor changed.
    """

    t: float
    probability: Mapping[str, float]
    failure: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def best(self) -> str:
        """The most probable hypothesis."""
        return max(self.probability, key=lambda n: self.probability[n])


def kind_of(name: str, kinds: Iterable[str]) -> str:
    """Return which of some kinds a hypothesis ``"KIND"`` or ``"KIND member"`` is of."""
    return next(k for k in kinds if name == k or name.startswith(f"{k} "))


def probabilities(
    loglik: Mapping[str, float], prior: Mapping[str, float] = PRIOR
) -> dict[str, float]:
    """Return posterior probabilities of hypotheses ``"KIND"`` or ``"KIND member"``.

    Args:
        loglik: logarithm of each one's likelihood; NaN and -inf: impossible.
        prior: weights by kind.
    """
    members = [kind_of(n, prior) for n in loglik]
    weight = [math.log(prior[k] / members.count(k)) for k in members]
    score = zip(loglik.items(), weight, strict=True)
    return named_posterior({n: v + w for (n, v), w in score})


@dataclass(frozen=True, eq=False)
class _Piece:
    """The samples around a change, and filters run on them."""

    machine: MachineParameters
    sensors: SensorSet
    samples: dict[str, np.ndarray]
    change: float
    backend: str | None
    failed: dict[str, dict[str, float]] = field(default_factory=dict)
    # of these sensors and samples: another piece has its own
    _made: dict[str, tuple[ElectricalFilter, Recording, Belief]] = field(
        default_factory=dict, init=False
    )

    def filter(self, **how: Any) -> tuple[ElectricalFilter, Recording, Belief]:
        """Return a filter, its recording and its prior: made once for all that it is run for."""
        key = repr(sorted(how.items()))
        if key not in self._made:
            filt = electrical_filter(self.machine, sensors=self.sensors, gains="estimate", **how)
            self._made[key] = filt, filt.recording(self.samples), filt.prior(self.samples)
        return self._made[key]

    def run(
        self, change: Callable[[Recording, ElectricalFilter], Recording] | None = None, **how: Any
    ) -> tuple[FilterResult, Recording]:
        """Run a filter with a changed recording."""
        filt, data, prior = self.filter(**how)
        data = data if change is None else change(data, filt)
        return run(ekf_step(filt.model), prior, data, backend=self.backend), data

    def changed(
        self,
        filt: ElectricalFilter,
        data: Recording,
        prior: Belief,
        cov: np.ndarray,
        shift: Mapping[str, float] | None = None,
    ) -> float:
        """Log-likelihood where the belief moves and opens at the change; from it on, if at once."""
        step, x = ekf_step(filt.model), filt.model.x
        moved = np.array([(shift or {}).get(n, 0.0) for n in x.names])
        cut = int(np.searchsorted(data.t, self.change - 1e-9))
        if cut < 1:
            return float(run(step, prior, data, backend=self.backend).loglik)
        upto = data.part(0, cut + 1)
        y = upto.y.copy()
        y[:, -1] = np.nan  # the sample of the change is of what follows
        first = run(step, prior, replace(upto, y=y), backend=self.backend)
        then = Belief(x, first.final.mean + moved, first.final.cov + cov)
        rest = run(step, then, data.part(cut, data.size), backend=self.backend)
        return float(first.loglik + rest.loglik)

    def shorted(self, phase: str) -> float:
        """Log-likelihood of a short circuit that comes with the change, or was there before."""
        made = self.filter(phases=(phase,))
        wide = [RESET_SIGMA.get(n, 0.0) ** 2 for n in made[0].model.x.names]
        return self.changed(*made, np.diag(wide))

    def field(self, *, turns: bool) -> float:
        """Log-likelihood of shorted turns of the field, or of its current sensor that is off.

        The belief begins at the share that the current shows, and the prior weighs that.
        """
        t, i = self.samples["t"], self.samples["i_fd"]
        before = (t < self.change - 1e-9) & (t >= self.change - FIELD_MEAN)
        after = self.late_at(t) & (t < self.change + FIELD_MEAN)
        ratio = float(np.nanmean(i[after]) / np.nanmean(i[before])) if before.any() else math.nan
        if not (1.0 if turns else 0.0) < ratio < 2.0:
            return -math.inf
        r_fd = self.machine.r_fd
        shift = {"gain_i_fd": ratio - 1}
        shift |= {"gain_V_fd": 1 / ratio - 1, "machine.r_fd": r_fd * (ratio - 1)} if turns else {}
        made = self.filter(phases=(), free={"machine.r_fd": Unknown()})
        names = made[0].model.x.names
        along = np.array([shift.get(n, 0.0) for n in names]) / (ratio - 1) * TURNS
        own = [LOOSE**2 * (n in shift and n.startswith("gain_")) for n in names]
        found = self.changed(*made, np.outer(along, along) + np.diag(own), shift)
        likely = math.log(2.0) if turns else 0.0  # turns only raise the current
        return found + likely - 0.5 * ((ratio - 1) / TURNS) ** 2

    def late_at(self, t: np.ndarray) -> np.ndarray:
        """Which instants are after the change."""
        return np.asarray(t >= self.change - 1e-9)

    def late(self, data: Recording) -> np.ndarray:
        """Samples after the change."""
        return self.late_at(data.t)

    @cached_property
    def healthy(self) -> FilterResult:
        """What the healthy machine's filter says."""
        return self.run(phases=())[0]

    def without(self, row: int) -> float:
        """Log-likelihood where one current says nothing after the change."""

        def blind(data: Recording, _: ElectricalFilter) -> Recording:
            variance = data.variance.copy()
            variance[row, self.late(data)] = UNKNOWN**2
            return replace(data, variance=variance)

        r, data = self.run(blind, phases=())
        shown = np.where(np.isfinite(data.y[row]), r.innovation[row], np.nan)
        late = self.late(data)
        name = MEASURED[row]
        with np.errstate(invalid="ignore"):
            spread = np.sqrt(np.maximum(r.innovation_variance[row] - UNKNOWN**2, 0.0))
        spread = np.hypot(spread, self.sensors.sigma(name, 0.0))
        spread = spread[late]
        told = data.t[late], data.y[row, late], shown[late], spread
        self.failed[f"sensor {name}"] = failure(*told)
        at = late & np.isfinite(r.innovation[row])
        nu, S = r.innovation[row, at], r.innovation_variance[row, at]
        found = max(float(np.mean(nu**2)), float(np.min(S)) * 1e-9)
        own = -0.5 * (nu**2 / S + np.log(2 * math.pi * S)).sum()
        noisy = -0.5 * nu.size * (1 + math.log(2 * math.pi * found))
        s = spread[at[late]]  # its own noise, about what it is off
        z, one = nu / s, 1 / s
        off = z - one * float(one @ z) / max(float(one @ one), 1e-300)
        biased = -0.5 * float(off @ off + np.log(2 * math.pi * s**2).sum())
        instead = float(np.logaddexp(noisy, biased)) - math.log(2.0)
        return float(r.loglik - own + instead) - 0.5 * math.log(max(nu.size, 2))

    def voltages_off(self) -> float:
        """Log-likelihood where the voltages have errors of the best of a few sizes."""

        def off(size: float) -> Callable[[Recording, ElectricalFilter], Recording]:
            def change(data: Recording, filt: ElectricalFilter) -> Recording:
                u, late = data.u.copy(), self.late(data)
                for n in JUMP_SIZES.names:
                    i = filt.model.u.index(n)
                    u[i] = np.where(late, np.maximum(u[i], size), u[i])
                return replace(data, u=u)

            return change

        best = max(float(self.run(off(s), phases=())[0].loglik) for s in VOLTAGE_ERRORS)
        return best - math.log(len(VOLTAGE_ERRORS))

    def field_off(self) -> float:
        """Log-likelihood where the field's voltage has errors of the best of a few sizes."""
        runs = (
            replace(self, sensors=self.sensors.change(V_fd=s)).run(phases=())[0]
            for s in FIELD_ERRORS
        )
        return max(float(r.loglik) for r in runs) - math.log(len(FIELD_ERRORS))

    def speed_off(self) -> float:
        """Log-likelihood where the speed after the change is what the voltages' angle says."""
        a, t = self.samples, self.samples["t"]
        turn = np.exp(1j * np.array(list(PHASE_ANGLE.values())))
        v = turn @ np.array([a[n] for n in PHASES_V])
        late = (t >= self.change - 1e-9) & np.isfinite(v)
        fit = np.polynomial.Polynomial.fit(t[late], np.unwrap(np.angle(v[late])), 2)
        said = np.where(t >= self.change - 1e-9, fit.deriv()(t), a["w_r"])
        late, sigma = t >= self.change - 1e-9, self.sensors.sigma("w_r", said)
        off = a["w_r"] - said
        self.failed["sensor w_r"] = failure(t[late], a["w_r"][late], off[late], sigma[late])
        z = (off / sigma)[late & np.isfinite(off)]
        # the angle is less noisy than any speed: it fits better where the sensor is right, too
        n = max(z.size, 1)
        misses = max((z @ z / n - 1) * math.sqrt(n / 2), abs(z.sum()) / math.sqrt(n))
        if misses < SPEED_MISSES:
            return -math.inf
        known = replace(self, samples=a | {"w_r": said})
        # slope and curvature were found
        return float(known.run(phases=())[0].loglik) - math.log(max(int(late.sum()), 2))

    def harmonics(self, r: FilterResult) -> float:
        """Log-likelihood of a healthy machine whose currents have harmonics of their own."""
        w = self.samples["w_r"]
        angle = float(np.nanmedian(w)) * (r.t - r.t[0])
        b = np.column_stack([f(m * angle) for m in ORDERS for f in (np.cos, np.sin)])
        gain = 0.0
        for row in range(3):
            there = np.isfinite(r.innovation[row])
            s = np.sqrt(r.innovation_variance[row, there])
            z, B = r.innovation[row, there] / s, b[there] / s[:, None]
            c = np.linalg.lstsq(B, z, rcond=None)[0]
            gain += 0.5 * (z @ z - np.sum((z - B @ c) ** 2)) - 0.5 * b.shape[1] * math.log(z.size)
        return float(r.loglik + gain)


def onset_of(
    machine: MachineParameters,
    sensors: SensorSet,
    samples: Mapping[str, np.ndarray],
    phase: str,
    within: tuple[float, float],
    *,
    backend: str | None = None,
) -> float:
    """Return the likeliest instant at which a short circuit of a phase came, to ``FINEST``, s.

    Args:
        machine, sensors, samples, backend: as of :func:`causes_of_change`.
        phase: of it.
        within: between which it is looked for, s.
    """
    t, (first, last) = samples["t"], within
    at = (t >= first - BEFORE - 1e-9) & (t <= last + AFTER + 1e-9)
    backend = backend or rarely("onset of a change")
    piece = _Piece(machine, sensors, {n: v[at] for n, v in samples.items()}, first, backend)
    tried: dict[float, float] = {}

    def likely(change: float) -> float:
        if change not in tried:
            try:
                tried[change] = replace(piece, change=change).shorted(phase)
            except ApuError:
                tried[change] = -math.inf
        return tried[change]

    step = COARSE
    best = max((float(v) for v in np.arange(first, last + step / 2, step)), key=likely)
    while step > FINEST:
        step /= 2
        best = max((v for v in (best, best - step, best + step) if first <= v <= last), key=likely)
    return best


def causes_of_change(
    machine: MachineParameters,
    sensors: SensorSet,
    samples: Mapping[str, np.ndarray],
    change: float,
    *,
    backend: str | None = None,
) -> Causes | None:
    """Tell what a change of the waveforms is; None where there are too few samples around it.

    Args:
        machine, sensors: as the filter knows them; sensors with gain errors taken for noise.
        samples: as :meth:`ElectricalFilter.recording` takes them.
        change: its instant, s; that of the first sample where it was there from the start.
        backend: see :func:`apu_casadi.core.backend.compiled`; by default as for what is done
            :func:`~apu_casadi.core.backend.rarely`.
    """
    t = samples["t"]
    at = (t >= change - BEFORE - 1e-9) & (t <= change + AFTER + 1e-9)
    if at.sum() < FEWEST or (t[at] >= change).sum() < FEWEST // 4:
        return None
    backend = backend or rarely("causes of a change")
    piece = _Piece(machine, sensors, {n: v[at] for n, v in samples.items()}, change, backend)
    found: dict[str, float] = {}

    def judge(name: str, of: Callable[[], float]) -> None:
        try:
            found[name] = of()
        except ApuError:  # a filter that loses itself explains nothing
            found[name] = -math.inf

    judge("healthy", lambda: piece.healthy.loglik)
    for p in PHASES:
        judge(f"short circuit {p}", lambda p=p: piece.shorted(p))  # type: ignore[misc]
    warm = {f"machine.{n}": Unknown() for n in ("r_fd", "r_s")}
    judge("hot winding", lambda: piece.run(phases=(), free=warm)[0].loglik)
    judge("field winding", lambda: piece.field(turns=True))
    for k, n in enumerate(MEASURED):
        judge(f"sensor {n}", lambda k=k: piece.without(k))  # type: ignore[misc]
    noisy = found["sensor i_fd"]
    judge("sensor i_fd", lambda: piece.field(turns=False))
    found["sensor i_fd"] = max(noisy, found["sensor i_fd"]) - math.log(2.0)
    judge("sensor w_r", piece.speed_off)
    judge("sensor V_fd", piece.field_off)
    judge("voltage sensors", piece.voltages_off)
    judge("harmonics", lambda: piece.harmonics(piece.healthy))
    if not any(math.isfinite(v) for v in found.values()):
        return None
    failed = {n: f for n, f in piece.failed.items() if f}
    return Causes(change, probabilities(found), failed)
