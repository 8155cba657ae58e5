"""What the electrical filters of one machine hand to the gas path: power, and what is uncertain.

* The filter with the three severities considers the gain errors, the delay of the currents and
  what else is not known (:mod:`estimators.apu.unknowns`): what it claims of severities and power
  holds them, however long it runs.  By its joint beliefs at the ends of the windows power is the
  mean over a healthy machine and a short circuit in each phase (:mod:`.hypotheses`).
* Where a phase is found faulty, a filter with that phase's h alone runs again from the beginning,
  or from the last reset: severities of half a per cent and more are far from linear.

Errors of the power are of three kinds: noise, new in each window; errors of gains, delay and the
like, a constant share; and the loss of a short circuit that may be there or whose severity is not
known better, the same power in all windows.  The gas-path filter has a state for each of the latter
two.  The efficiency is of the second kind, and on top: nothing here tells it.  When a phase is
found, what was handed over before is known better as well: a :class:`View` is the whole course as
known from one window on.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from apu_casadi.core.errors import DataError
from apu_casadi.machine.machinedata import MachineParameters
from apu_casadi.machine.park import PHASES
from apu_casadi.unit.apu import Apu
from estimators.apu.electrical.electricalfilter import ElectricalFilter, electrical_filter
from estimators.apu.electrical.hypotheses import Hypotheses, SeverityPrior, loose_in_common
from estimators.apu.electrical.smallchanges import Beliefs, following
from estimators.apu.electrical.terminalsignals import DELAY, PHASES_I, PHASES_V
from estimators.apu.electrical.tracking import track, window_power
from estimators.apu.electrical.tuning import (
    FAULT_LEVEL,
    H_BALANCED_CONSIDERED,
    H_SIGMA,
    H_WALK_CONSIDERED,
    RELEASE_LEVEL,
)
from estimators.apu.gaspathmodel import DT
from estimators.apu.sensors import SensorSet
from estimators.apu.unknowns import EFFICIENCY, Knowledge, filter_unknowns, of_parameter, usual
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import FilterResult, StepMaker, run
from estimators.models.recording import Recording

__all__ = [
    "GAIN_SHARE",
    "SETTLED",
    "Beliefs",
    "ElectricalSide",
    "View",
    "electrical_side",
    "loosened",
    "with_field",
]

PEAK = {"v": 325.0, "i": 461.0, "V_fd": 40.0, "i_fd": 590.0}  # at rated load, V and A
FIELD = 0.04  # s, over which field voltage and current give the field resistance
SETTLED = 5  # windows after which the filters have settled
# gain errors of 0.5 % of three voltages and three currents in the power of three phases
GAIN_SHARE = 0.005 * math.sqrt(2 / 3)


@dataclass(frozen=True, eq=False)
class View:
    """The course of power as known from one window on.

    Args:
        start: window from which on it is known.
        P, variance: mean mechanical power of both generators over each window, W, and its variance
            but for the efficiency, W^2, (K - 1,).
        noise, loss: variances of what is new in each window, and of what a short circuit takes more
            or less in all of them, W^2, (K - 1,).
    """

    start: int
    P: np.ndarray
    variance: np.ndarray
    noise: np.ndarray
    loss: np.ndarray

    @classmethod
    def of(
        cls, start: int, P: np.ndarray, variance: np.ndarray, noise: np.ndarray, share: float
    ) -> View:
        """Take for loss what neither noise nor a share of the power explains."""
        return cls(start, P, variance, noise, (variance - noise - (share * P) ** 2).clip(0.0))


@dataclass(frozen=True, eq=False)
class ElectricalSide:
    """What the electrical filters of one machine say at K instants, 20 ms apart.

    Args:
        t: the instants, s.
        views: courses of the power, each known from its ``start`` on; the first from 0.
        share: relative standard deviation of the power by errors of gains and delay.
        eta: the same by the efficiency.
        severities: h and its standard deviation by phase, (2, 3, K).
        probability: that the machine has a short circuit, (K,).
        phase: found faulty, 0 for none, (K,).
        misfit: by which several phases at once, or something else, show, (K,); see
            :class:`.hypotheses.Hypotheses`.
        resets: instants, s, at which the machine changed.
        result: of the filter with the three h, at every sample; without them, of the healthy
            machine's; see ``judged`` of :func:`electrical_side`.
        beliefs: of the filter with the three h at the ends of the windows; None without it.
    """

    t: np.ndarray
    views: tuple[View, ...]
    share: float
    eta: float
    severities: np.ndarray
    probability: np.ndarray
    phase: np.ndarray
    misfit: np.ndarray
    resets: tuple[float, ...]
    result: FilterResult
    beliefs: Beliefs | None = None

    def _causal(self, name: str) -> np.ndarray:
        out = np.array(getattr(self.views[0], name))
        for view in self.views[1:]:
            out[view.start :] = getattr(view, name)[view.start :]
        return out

    @property
    def P(self) -> np.ndarray:
        """Mean mechanical power of both generators over each window, W, as known at its end."""
        return self._causal("P")

    @property
    def variance(self) -> np.ndarray:
        """Variance of P, W^2: noise, short circuit, gain errors and the like, efficiency."""
        return self.given_efficiency + (self.eta * self.P) ** 2

    @property
    def given_efficiency(self) -> np.ndarray:
        """The same if the efficiency is known."""
        return self._causal("variance")


def loosened(sensors: SensorSet) -> SensorSet:
    """Return the sensors with their gain errors at rated load taken for noise.

    A filter that estimates the gains from 10 kHz samples learns them within a second to better than
    its model is; one that takes them for noise learns nothing false.
    """
    noise = {}
    for s in sensors.sensors:
        size = PEAK.get(s.name, PEAK.get(s.name[0])) if s.name != "w_r" else 0.0
        gain = s.unsure("gain") * float(size or 0.0) / math.sqrt(2)
        noise[s.name] = math.hypot(s.noise, gain, s.unsure("bias"))
    return sensors.change(**noise)


class _Windows(NamedTuple):
    """Ends of windows: beliefs of severities, mean power and considered errors there."""

    mean: np.ndarray
    cov: np.ndarray
    result: FilterResult
    resets: list[float]
    names: tuple[str, ...]

    @property
    def beliefs(self) -> Beliefs:
        return Beliefs(self.names, self.mean, self.cov)


@dataclass(frozen=True, eq=False)
class _Filters:
    """The filters of one machine and its samples.

    Args:
        machine: as the filters know it.
        sensors, measured, t, unknowns, gain_errors, step, backend: as for :func:`electrical_side`.
    """

    machine: MachineParameters
    sensors: SensorSet
    measured: Mapping[str, np.ndarray]
    t: np.ndarray
    unknowns: Mapping[str, Knowledge]
    gain_errors: bool
    step: StepMaker
    backend: str | None

    def of(self, phases: tuple[str, ...], *, plain: bool = False) -> ElectricalFilter:
        """The filter with the severities of some phases; the healthy machine's without.

        A ``plain`` one takes gain errors for noise, as the healthy machine's does, and leaves the
        power out: it is for innovations, which that does not change.
        """
        healthy = self.gain_errors and (plain or not phases)
        three = phases == PHASES and self.gain_errors and not plain
        free = {n: how for n, (how, _) in filter_unknowns(self.unknowns).items()}
        if plain:  # a model without gains has no delay
            free.pop(DELAY.name, None)
        return electrical_filter(
            self.machine,
            sensors=loosened(self.sensors) if healthy else self.sensors,
            h_walk=H_WALK_CONSIDERED if three else None,
            gains="consider" if self.gain_errors and not healthy else "none",
            power=not plain,
            phases=phases,
            free=free if phases else None,
        )

    def spread(self) -> dict[str, float]:
        """Standard deviations of the parameters that are states, at the start."""
        value = self.machine.held("machine")
        of = filter_unknowns(self.unknowns).items()
        return {n: s * abs(value.get(n, 1.0)) for n, (_, s) in of}

    def checked(self, ends: np.ndarray, begin: float, end: float = math.inf) -> None:
        """Refuse waveforms that do not cover the windows."""
        t = self.t[self.t <= end + 1e-9]
        if not np.allclose(ends, t[t > begin + 1e-9][: ends.size]) or ends[-1] < t[-1] - 1e-6:
            raise DataError(
                f"{t.size - 1} windows of shaft power expected, the waveforms give {ends.size}"
            )

    def recording(self, of: ElectricalFilter, base: Recording) -> Recording:
        """The recording of a filter that takes gain errors for noise, from that of the others."""
        names = self.of(PHASES).model.u.names
        rows = [names.index(n) for n in of.model.u.names]
        variance = np.array([[of.sensors.sigma(n, 0.0) ** 2] for n in of.model.y.names])
        spread = np.broadcast_to(variance, base.y.shape)
        return Recording(base.t, base.u[rows], base.y, spread, of.model.p.pack({}))

    def plain(self, base: Recording) -> FilterResult:
        """Innovations of the three severities' filter that takes gain errors for noise."""
        of = self.of(PHASES, plain=True)
        sigma = {n: s for n, s in self.spread().items() if n in of.model.x.names}
        data, prior = self.recording(of, base), of.prior(self.measured, sigma=sigma)
        how: dict[str, Any] = {"step": self.step, "backend": self.backend}
        return track(of, prior, data, own_level=True, common=H_BALANCED_CONSIDERED, **how)[0]

    def healthy(self, base: Recording) -> tuple[FilterResult, Any, Any]:
        """Power of a healthy machine, and its variance."""
        of = self.of(())
        data = self.recording(of, base)
        r = run(self.step(of.model), of.prior(self.measured), data, backend=self.backend)
        ends, P, var = window_power(of, r, data)
        self.checked(ends, float(self.t[0]))
        return r, P, var

    def split(self, may: Hypotheses) -> tuple[float, np.ndarray]:
        """Share of a healthy machine's power that errors in all windows make, and what is noise.

        Noise is that of the sensors, and what more a step of load leaves in its window.
        """
        P, variance = may.healthy
        if not self.gain_errors:
            return 0.0, variance
        n = DT / float(np.median(np.diff(self.measured["t"])))
        pairs = zip(PHASES_V, PHASES_I, strict=True)
        of = [PEAK[v[0]] * self.sensors.sigma(i, 0.0) for v, i in pairs]
        of += [PEAK["i"] * self.sensors.sigma(v, 0.0) for v in PHASES_V]
        white = 2 * sum(s**2 for s in of) / n / self.machine.eta_sg**2
        k = min(SETTLED, P.size - 1)
        least = 0.02 * self.machine.P_rated  # of a machine without a load a share says nothing
        share = math.sqrt(max(float(variance[k]) - white, 0.0)) / max(abs(float(P[k])), least)
        return share, white + (variance - white - (share * P) ** 2).clip(0.0)

    def windows(
        self, phases: tuple[str, ...], base: Recording, begin: float, end: float = math.inf
    ) -> _Windows:
        """Beliefs of a filter with severities, from an instant on, up to one."""
        of = self.of(phases)
        own = {n: v[self.measured["t"] >= begin - 1e-9] for n, v in self.measured.items()}
        i, j = np.searchsorted(base.t, [begin - 1e-9, end + 1e-9]).tolist()
        data = base.part(i, j, of.model.p.pack({}))
        u = data.u
        u[of.model.u.index("dt_last"), 0] = 0.0
        starts = np.flatnonzero(u[of.model.u.index("keep")] == 0.0)
        r, resets = track(
            of,
            of.prior(own, sigma=self.spread() if phases else None),
            data,
            step=self.step,
            backend=self.backend,
            own_level=self.gain_errors or None,
            cov_at=starts[1:],
            common=H_BALANCED_CONSIDERED,
        )
        self.checked(data.t[starts[1:]], begin, end)
        names = (*(f"h_{k}" for k in phases), "energy", *of.model.consider)
        rows = [r.x.index(n) for n in names]
        # the energy of a window is that of the first instant of the next
        length = np.diff(data.t[starts])[:, None]
        scale = np.ones((length.size, len(rows)))
        scale[:, [len(phases)]] = 1 / length
        assert r.some_cov is not None
        cov = r.some_cov[:, rows][:, :, rows] * scale[:, :, None] * scale[:, None, :]
        told = tuple("P" if n == "energy" else n for n in names)
        return _Windows(r.mean[rows][:, starts[1:]].T * scale, cov, r, resets, told)


def electrical_side(
    apu: Apu,
    sensors: SensorSet,
    measured: Mapping[str, np.ndarray],
    t: np.ndarray,
    *,
    ttsc: bool = True,
    gain_errors: bool = True,
    unknowns: Mapping[str, Knowledge] | None = None,
    prior: SeverityPrior | None = None,
    efficiency_error: float = 0.0,
    judged: bool = False,
    step: StepMaker = ekf_step,
    backend: str | None = None,
) -> ElectricalSide:
    """Run the electrical filters and put together what is known causally.

    Args:
        apu: the unit as the filters know it.
        sensors: 1-sigma table.
        measured: samples as :meth:`ElectricalFilter.recording` takes them.
        t: ends of the windows of the mean power, among the instants of the samples.
        unknowns: parameters that are estimated or considered, by name, see
            :mod:`estimators.apu.unknowns`.
        prior: of a short circuit that may be there.
        efficiency_error: actual relative error of the efficiency, of a run that is measured.
        judged: whether the innovations are to be judged: ``result`` is then that of a filter with
            the three h which takes gain errors for noise, and so leaves their offsets alone.
        ttsc, gain_errors, step, backend: as for :func:`estimators.apu.joint.estimate_joint`.

    Raises:
        DataError, EstimationError: as the filter; windows that the waveforms do not cover.
    """
    machine, unknowns = apu.generator.machine, usual(unknowns, gain_errors)
    machine = dataclasses.replace(machine, eta_sg=machine.eta_sg / (1 + efficiency_error))
    if of_parameter(unknowns, "machine.r_fd").how != "known":
        machine = with_field(machine, measured, float(t[0]))
    filters = _Filters(machine, sensors, measured, t, unknowns, gain_errors, step, backend)
    three, begin, K = filters.of(PHASES), float(t[0]), t.size
    eta = of_parameter(unknowns, EFFICIENCY).sigma
    # the inputs are the same for all: made once
    base = three.recording(measured, window=DT, start=begin)
    if not ttsc:
        share = GAIN_SHARE if gain_errors else 0.0
        healthy, P, noise = filters.healthy(base)
        views = (View(0, P, noise + (share * P) ** 2, noise, np.zeros_like(P)),)
        none = np.zeros((2, 3, K)), np.zeros(K), np.zeros(K, dtype=int), np.zeros(K)
        return ElectricalSide(t, views, share, eta, *none, (), healthy)
    w = filters.windows(PHASES, base, begin)
    may = Hypotheses.of(w.mean, loose_in_common(w.cov) if gain_errors else w.cov, prior)
    share, noise = filters.split(may)
    courses = [View.of(0, *may.power(), noise, share)]
    start = np.array([np.zeros((3, 1)), np.full((3, 1), H_SIGMA)])
    severities = np.concatenate([start, may.severities()], axis=2)
    probability = np.append(may.probability[:, 0] @ [0, 1, 1, 1], may.probability[1:].sum(0))
    phase = np.append(0, _found(may))
    # the window in which a fault is found is the first with the power of a faulty machine
    for k in [k for k in range(1, K) if phase[k] and phase[k] != phase[k - 1]]:
        begin = max([v for v in w.resets if v <= t[k] + 1e-9] + [float(t[0])])
        # whole windows: from the beginning of the one in which the machine changed
        first = min(int(np.floor((begin - t[0]) / DT + 1e-6)), k - 1)
        i, last = phase[k] - 1, k
        while last + 1 < K and phase[last + 1] == phase[k]:
            last += 1
        one = filters.windows((PHASES[i],), base, float(t[first]), float(t[last]))
        known = slice(first, last)
        P, variance = courses[-1].P.copy(), courses[-1].variance.copy()
        P[known], variance[known] = one.mean[:, 1], one.cov[:, 1, 1]
        courses.append(View.of(k - 1, P, variance, noise, share))
        said = slice(k - 1 - first, last - first)
        severities[0, i, k : last + 1] = one.mean[said, 0]
        severities[1, i, k : last + 1] = np.sqrt(one.cov[said, 0, 0])
    _widen(severities, w.beliefs, phase, of_parameter(unknowns, "machine.r_s").sigma)
    # severities far from zero are not linear by a share of a few per cent
    misfit = np.append(0.0, may.misfit / (1 + 1e-3 * may.statistic.max(0)))
    result = filters.plain(base) if judged and gain_errors else w.result
    told = severities, probability, phase, misfit, tuple(w.resets), result, w.beliefs
    return ElectricalSide(t, tuple(courses), share, eta, *told)


def _widen(severities: np.ndarray, beliefs: Beliefs, phase: np.ndarray, r_s: float) -> None:
    """Let sigmas hold what the filter is behind a change, and the stator's resistance."""
    # a phase that is found has a filter of its own, which began with the change
    late = following(beliefs, severities[0]) * (phase != np.arange(1, 4)[:, None])
    severities[1] = np.hypot(severities[1], late)
    severities[1] = np.hypot(severities[1], r_s * severities[0])


def with_field(
    machine: MachineParameters, measured: Mapping[str, np.ndarray], begin: float
) -> MachineParameters:
    """Return the machine with the field resistance that its voltage and current show.

    A hot winding would look like a short circuit: 20 % more, taken for nothing, was one in all of
    eight runs.  The ratio is that of the means over the first ``FIELD`` seconds, long against the
    field's time constant of 4 ms, and off by the gain errors of both sensors.
    """
    first = (measured["t"] >= begin - 1e-9) & (measured["t"] < begin + FIELD)
    V, i = (measured[n][first] for n in ("V_fd", "i_fd"))
    both = np.isfinite(V) & np.isfinite(i)
    ratio = V[both].mean() / i[both].mean() if both.any() and i[both].mean() > 0 else math.nan
    if not 0.5 < ratio / machine.r_fd < 2.0:
        return machine
    return dataclasses.replace(machine, r_fd=float(ratio))


def _found(may: Hypotheses) -> np.ndarray:
    """The phase found faulty at the end of each window, 1 to 3; 0 for none.

    One that was found stays so down to ``RELEASE_LEVEL``.
    """
    best = may.odds.argmax(0)
    out, now = np.zeros(best.size, dtype=int), 0
    for k, i in enumerate(best):
        if may.statistic[i, k] > FAULT_LEVEL:
            now = 1 + int(i)
        elif now and may.statistic[now - 1, k] < RELEASE_LEVEL:
            now = 0
        out[k] = now
    return out
