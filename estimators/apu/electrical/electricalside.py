"""What the electrical filters of one machine hand to the gas path: power, and what is uncertain.

* The healthy machine's filter gives the mean power of each 20 ms without a short circuit.  Gain
  errors are noise in it, so that it learns nothing false; their share is added.
* The filter with the three severities considers the gain errors: what it claims of severities and
  power holds them, however long it runs.  By its joint beliefs at the ends of the windows power is
  the mean over a healthy machine and a short circuit in each phase (:mod:`.hypotheses`).
* Where a phase is found faulty, a filter with that phase's h alone runs again from the beginning,
  or from the last reset: severities of half a per cent and more are far from linear.

Errors of the power are of three kinds: noise, new in each window; gain errors, a constant share;
and the loss of a short circuit that may be there or whose severity is not known better, the same
power in all windows.  The gas-path filter has a state for each of the latter two.  When a phase is
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
from estimators.apu.electrical.hypotheses import Hypotheses
from estimators.apu.electrical.tracking import track, window_power
from estimators.apu.electrical.tuning import FAULT_LEVEL, H_SIGMA, RELEASE_LEVEL
from estimators.apu.gaspathmodel import DT
from estimators.apu.sensors import SensorSet
from estimators.apu.unknowns import Knowledge, filter_unknowns, of_parameter, usual
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import FilterResult, StepMaker, run
from estimators.models.recording import Recording

__all__ = ["GAIN_SHARE", "Beliefs", "ElectricalSide", "View", "electrical_side", "loosened"]

FIELD = 0.04  # s, over which field voltage and current give the field resistance
# gain errors of 0.5 % of three voltages and three currents in the power of three phases
GAIN_SHARE = 0.005 * math.sqrt(2 / 3)


@dataclass(frozen=True, eq=False)
class View:
    """The course of power as known from one window on.

    Args:
        start: window from which on it is known.
        P: mean mechanical power of both generators over each window, W, (K - 1,).
        noise, loss: variances of what is new in each window, and of what a short circuit takes more
            or less in all of them, W^2, (K - 1,).  The share of gain errors comes on top.
    """

    start: int
    P: np.ndarray
    noise: np.ndarray
    loss: np.ndarray


@dataclass(frozen=True, eq=False)
class ElectricalSide:
    """What the electrical filters of one machine say at K instants, 20 ms apart.

    Args:
        t: the instants, s.
        views: courses of the power, each known from its ``start`` on; the first from 0.
        share: relative standard deviation of the power by gain errors.
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
        """Variance of P, W^2: noise, short circuit, gain errors."""
        variance: np.ndarray = self._causal("noise") + self._causal("loss")
        return variance + (self.share * self.P) ** 2


def loosened(sensors: SensorSet) -> SensorSet:
    """Return the sensors with their gain errors at rated load taken for noise.

    A filter that estimates the gains from 10 kHz samples learns them within a second to better than
    its model is; one that takes them for noise learns nothing false.
    """
    rated = {"v": 325.0, "i": 461.0, "V_fd": 40.0, "i_fd": 590.0}  # peak values, V and A
    noise = {}
    for s in sensors.sensors:
        size = rated.get(s.name, rated.get(s.name[0])) if s.name != "w_r" else 0.0
        gain = s.unsure("gain") * float(size or 0.0) / math.sqrt(2)
        noise[s.name] = math.hypot(s.noise, gain, s.unsure("bias"))
    return sensors.change(**noise)


class Beliefs(NamedTuple):
    """Joint beliefs at the ends of n windows.

    Args:
        names: severities ``h_a``, mean power ``P``, W, and errors that the filter considers.
        mean, cov: of these, (n, m) and (n, m, m).
    """

    names: tuple[str, ...]
    mean: np.ndarray
    cov: np.ndarray


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

        A ``plain`` one takes gain errors for noise, as the healthy machine's does.
        """
        healthy = self.gain_errors and (plain or not phases)
        free = {n: how for n, (how, _) in filter_unknowns(self.unknowns).items()}
        return electrical_filter(
            self.machine,
            sensors=loosened(self.sensors) if healthy else self.sensors,
            gains="consider" if self.gain_errors and not healthy else "none",
            power=True,
            phases=phases,
            free=free if phases else None,
        )

    def spread(self) -> dict[str, float]:
        """Standard deviations of the parameters that are states, at the start."""
        value = self.machine.held("machine")
        return {n: s * abs(value[n]) for n, (_, s) in filter_unknowns(self.unknowns).items()}

    def checked(self, ends: np.ndarray, begin: float) -> None:
        """Refuse waveforms that do not cover the windows."""
        t = self.t
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
        data, prior = self.recording(of, base), of.prior(self.measured, sigma=self.spread())
        return track(of, prior, data, step=self.step, backend=self.backend, own_level=True)[0]

    def healthy(self, base: Recording) -> tuple[FilterResult, Any, Any]:
        """Power of a healthy machine, and its variance."""
        of = self.of(())
        data = self.recording(of, base)
        r = run(self.step(of.model), of.prior(self.measured), data, backend=self.backend)
        ends, P, var = window_power(of, r, data)
        self.checked(ends, float(self.t[0]))
        return r, P, var

    def windows(self, phases: tuple[str, ...], base: Recording, begin: float) -> _Windows:
        """Beliefs of a filter with severities, from an instant on."""
        of = self.of(phases)
        own = {n: v[self.measured["t"] >= begin - 1e-9] for n, v in self.measured.items()}
        part = base.part(int(np.searchsorted(base.t, begin - 1e-9)), base.size)
        u = part.u.copy()
        u[of.model.u.index("dt_last"), 0] = 0.0
        data = dataclasses.replace(part, u=u, p=of.model.p.pack({}))
        starts = np.flatnonzero(u[of.model.u.index("keep")] == 0.0)
        r, resets = track(
            of,
            of.prior(own, sigma=self.spread() if phases else None),
            data,
            step=self.step,
            backend=self.backend,
            own_level=self.gain_errors or None,
            cov_at=starts[1:],
        )
        self.checked(data.t[starts[1:]], begin)
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
        judged: whether the innovations are to be judged: ``result`` is then that of a filter with
            the three h which takes gain errors for noise, and so leaves their offsets alone.
        ttsc, gain_errors, step, backend: as for :func:`estimators.apu.joint.estimate_joint`.

    Raises:
        DataError, EstimationError: as the filter; windows that the waveforms do not cover.
    """
    machine, unknowns = apu.generator.machine, usual(unknowns, gain_errors)
    if of_parameter(unknowns, "machine.r_fd").how != "known":
        machine = _with_field(machine, measured, float(t[0]))
    filters = _Filters(machine, sensors, measured, t, unknowns, gain_errors, step, backend)
    three, begin, K = filters.of(PHASES), float(t[0]), t.size
    # the inputs are the same for all: made once
    base = three.recording(measured, window=DT, start=begin)
    healthy, P, noise = filters.healthy(base)
    share = GAIN_SHARE if gain_errors else 0.0
    if not ttsc:
        views = (View(0, P, noise, np.zeros_like(P)),)
        none = np.zeros((2, 3, K)), np.zeros(K), np.zeros(K, dtype=int), np.zeros(K)
        return ElectricalSide(t, views, share, *none, (), healthy)
    w = filters.windows(PHASES, base, begin)
    may = Hypotheses.of(w.mean, w.cov)
    mean, variance = may.power(P, noise + (share * P) ** 2)
    loss = np.maximum(variance - noise - (share * mean) ** 2, 0.0)
    courses = [View(0, mean, noise, loss)]
    start = np.array([np.zeros((3, 1)), np.full((3, 1), H_SIGMA)])
    severities = np.concatenate([start, may.severities()], axis=2)
    probability = np.append(may.probability[:, 0] @ [0, 1, 1, 1], may.probability[1:].sum(0))
    phase = np.append(0, _found(may))
    # the window in which a fault is found is the first with the power of a faulty machine
    for k in [k for k in range(1, K) if phase[k] and phase[k] != phase[k - 1]]:
        begin = max([v for v in w.resets if v <= t[k] + 1e-9] + [float(t[0])])
        # whole windows: from the beginning of the one in which the machine changed
        first = min(int(np.floor((begin - t[0]) / DT + 1e-6)), k - 1)
        i = phase[k] - 1
        one = filters.windows((PHASES[i],), base, float(t[first]))
        last = k
        while last + 1 < K and phase[last + 1] == phase[k]:
            last += 1
        known = slice(first, last)
        here = slice(0, last - first)
        course = [np.array(getattr(courses[-1], n)) for n in ("P", "noise", "loss")]
        course[0][known] = one.mean[here, 1]
        more = one.cov[here, 1, 1] - noise[known] - (share * one.mean[here, 1]) ** 2
        course[2][known] = np.maximum(more, 0.0)
        courses.append(View(k - 1, *course))
        severities[0, i, k : last + 1] = one.mean[k - 1 - first : last - first, 0]
        severities[1, i, k : last + 1] = np.sqrt(one.cov[k - 1 - first : last - first, 0, 0])
    severities[1] = np.hypot(
        severities[1], of_parameter(unknowns, "machine.r_s").sigma * severities[0]
    )
    # severities far from zero are not linear by a share of a few per cent
    misfit = np.append(0.0, may.misfit / (1 + 1e-3 * may.statistic.max(0)))
    result = filters.plain(base) if judged and gain_errors else w.result
    told = severities, probability, phase, misfit, tuple(w.resets), result, w.beliefs
    return ElectricalSide(t, tuple(courses), share, *told)


def _with_field(
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
