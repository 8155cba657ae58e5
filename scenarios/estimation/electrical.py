"""The electrical filter: fluxes, rotor angle and turn-to-turn short circuit from 10 kHz samples.

Measured are the phase voltages and currents, field voltage and current, and the speed.  Voltages
and speed are inputs of the terminal model, currents are its outputs, so that neither load nor
exciter is modelled.  For kappa = mu (the default) a fault is h, one number for each phase: all
three are estimated, linearly and without bounds, and the faulty phase is found from them
(:func:`faulty_phase`).  mu and k_rf are then a ridge, mu = h (1 + k_rf)/(1 + h), and are reported
as such (:func:`ridge`).

How the errors of the measured voltages enter.  With v(k) and v(k+1) measured, the fluxes at k+1
hold about dt/2 of the error e(k+1), and the step to k+2 holds the rest.  The filter's state is
s(k) = x(k) + G e(k), the state as if the last voltage were true; then

    x(k) = s(k) - G e(k),        s(k+1) = step(x(k), vm(k) - e(k), vm(k+1)),

and e(k) enters the output at k and the transition from k to k+1, once each: exactly the shared
noise of :class:`~estimators.model.FilterModel`.  0.5 V over 100 us is 1.4 A in the subtransient
inductance, as much as the noise of the current sensors.  G is that of the step with its resistances
(:func:`held`): without them, above all without the half per cent that they bring into the d damper,
the variance claimed of one combination of field, damper and h would be 6 % short.

Gain errors multiply readings, and the readings hold the very errors that the innovations hold.  An
extended Kalman filter whose derivatives (to gains, h, and the rotor angle) contain readings
correlates the two: a bias of 1e-6 in what is seen well, but one that grows with each sample where
gains and h are seen together only, to three times the claimed standard deviation after 0.3 s.  With
gains among the unknowns everything is therefore written about what the two periods *before* a
sample predict of it: gains, h and the angle multiply predictions, and the rest of the reading,
which holds its error, enters linearly, turned by a reference angle from the same predictions.
Where a prediction is off by more than noise, as after a switch, the reading itself takes its place.
What is left is the angle's own error, which turns the derivatives and is in the innovations: with
the gains estimated, h drifts by half of its standard deviation in 0.3 s.

A leaky fault (kappa > mu) is estimated as the admittance of its branch at rated frequency, of which
all currents are nearly linear, and told as mu and k_rf at the end (:func:`leaky_fault`).  Its
current decays within 80 us to 2 ms, so it has an exact step of its own.

A voltage that jumps between two samples (a load switched) leaves its instant and its overshoot
unknown.  The voltage in the step's middle is then uncertain by the size of the jump; fluxes are
found again within a few samples, and h keeps what it knew.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.errors import DataError, EstimationError, ParameterError, nearest
from apu_casadi.machine.parameters import MachineParameters
from apu_casadi.machine.park import PHASE_ANGLE, Abc, Qd0, abc_to_qd0, qd0_to_abc
from apu_casadi.machine.wrsg import Windings, currents, flux_rates
from apu_casadi.signals import Signal, Signals
from apu_casadi.terminalmodel import (
    ANGLE,
    FLUXES,
    INPUTS,
    LEAKY,
    OUTPUTS,
    SHUNTS,
    Terminals,
    advance,
    balanced_state,
    before,
    jumps,
    middle_weight,
    midpoints,
    shunt_parameters,
    terminal_equations,
    voltage_weight,
)
from estimators.belief import Belief
from estimators.ekf import extended_kalman_filter
from estimators.filtering import FilterResult
from estimators.model import FilterModel, Unknown, augment
from estimators.recording import SAME_TIME, Recording
from scenarios.estimation.sensors import ELECTRICAL, SensorSet

__all__ = [
    "ANGLE_WALK_CONSIDERED",
    "FLUX_WALK",
    "GAIN_SENSORS",
    "H_WALK",
    "H_WALK_GAINS",
    "JUMP",
    "PHASES",
    "ElectricalFilter",
    "Verdict",
    "describe",
    "electrical_filter",
    "faulty_phase",
    "held",
    "leaky_fault",
    "ridge",
    "shunt_of",
    "track",
    "window_power",
]

PHASES = ("a", "b", "c")
PHASES_V = ("v_a", "v_b", "v_c")
PHASES_I = ("i_a", "i_b", "i_c")
VOLTAGES = (*PHASES_V, "V_fd")
MEASURED = (*PHASES_I, "i_fd")
GAIN_SENSORS = (*VOLTAGES, *MEASURED)
GAINS = ("none", "estimate", "consider")

#: Random walk of each h, 1/sqrt(s).  A sample tells h to some 3e-5 (225 kW), so the filter averages
#: over about 25 ms and claims 3e-6.
H_WALK = 2e-5
#: The same with gain errors: they leave h uncertain by 4e-5 in any case, so h may as well move
#: fast; with the slow walk a fault would be taken for a change of the gains found before it.
H_WALK_GAINS = 2e-4
#: Random walk of both parts of a leaky fault's admittance, 1/sqrt(s): slower than h, since what
#: tells mu from k_rf is a small share of it; the filter averages over 60 ms.
LEAKY_WALK = 5e-6
#: Random walk of the flux linkages, Wb/sqrt(s): 1e-6 Wb in a step of 100 us, 0.03 A; stands for
#: what the interpolation of the voltages leaves.
FLUX_WALK = 1e-4
#: Random walk of the rotor angle where gains are considered, rad/sqrt(s): as much as a speed that
#: is 1 rad/s off for 10 ms.  A turned angle looks like gain errors, which that filter leaves alone,
#: so it hardly corrects the angle: a speed 1 rad/s off (its noise is 1.25) for a tenth of a second
#: after a load step turned it by 0.06 rad and moved all h by 7e-4, their statistics by three
#: standard deviations; with the walk it is 3e-5 and 0.2.  The price is nil: one h with the others
#: zero is known to 4.0e-5 at 225 kW and 2.4e-5 at 100 kW, as without it.
ANGLE_WALK_CONSIDERED = 0.1
#: Start of a leaky fault: mean of both parts of its admittance, and what its current (A, standard
#: deviation) has beside that of the admittance.
LEAKY_START = 3e-3
START_SIGMA_SHUNT = 5.0
#: Least susceptance of a leaky fault: without one it has no current of its own.
LEAST_SUSCEPTANCE = 1e-6
#: Electrical periods over which the harmonics of the voltages are averaged: their noise lasts as
#: long in the middles of the steps, and over two periods it is 0.5 % of what the filter expects.
HARMONIC_PERIODS = 10.0
#: Jumps of the voltage within a step up to this, V, are taken for noise: five standard deviations.
JUMP = 5.0
#: Unknown mean voltage of a step with a jump, over the jump's size; the jump's instant alone gives
#: 0.3, the overshoot of a resistive load that is dropped gives the rest.
JUMP_SHARE = 1.0
#: Standard deviations of the start: stator and rotor fluxes (Wb), angle (rad), of a healthy
#: machine; what an h adds to them goes with h.  With 0.03 rad the linearisation shows in the NEES.
START_SIGMA = {
    "lam_sq": 1.5e-3,
    "lam_sd": 1.5e-3,
    "lam_s0": 5e-4,
    "lam_fd": 1.5e-3,
    "lam_kd": 1.5e-3,
    "lam_kq": 1.5e-3,
    "theta_e": 0.01,
}
#: Standard deviation of each h at the start.
H_SIGMA = 1e-2
#: A step of h is looked for in windows of this many samples (5 ms) ...
RESET_WINDOW = 50
#: ... whose mean NIS exceeds this; 4 is expected, 8 is ten standard deviations more.
RESET_LEVEL = 8.0
#: What is added to the standard deviations at a reset.
RESET_SIGMA = {
    **dict.fromkeys(SHUNTS.names, 1e-2),
    **dict.fromkeys(FLUXES.names, 1e-3),
    **dict.fromkeys(("g_shunt", "b_shunt"), 1e-2),
    "i_shunt": 50.0,
}
#: Statistic (h/sigma)^2 of one phase above which a fault is reported: five standard deviations.
#: The rule: by the tail of the tuning runs, continued as a Gaussian's, less than one false alarm an
#: hour, and less than 1e-4 in a run of two load steps.  Noise passes it less than once in ten hours
#: (Rice's formula through the counts at lower levels), constant gain errors in one steady unit of a
#: million.  Load steps and gas faults, with and without gain errors, pass it in 1e-5 to 3e-5 of the
#: runs (200 tuning seeds of each kind, largest statistic 4.1 standard deviations).
FAULT_LEVEL = 25.0

_LATER = Signals(
    [dataclasses.replace(INPUTS[n], name=f"{n}_{when}", doc=f"{n} {text}")
     for when, text in (("mid", "midway to the next sample"), ("next", "at the next sample"))
     for n in VOLTAGES]
)  # fmt: skip
_JUMPS = Signals(
    [Signal(f"jump_{n}", "V", f"by how much the voltage jumps before the next sample, {what}",
            default=0.0) for n, what in (("qd", "space vector"), ("0", "zero sequence"))]
)  # fmt: skip
_SMOOTH = Signals(
    [Signal(f"{n}_smooth", s.unit, f"{n} as samples before predict it", nominal=s.nominal)
     for n, s in ((n, INPUTS[n] if n in INPUTS else OUTPUTS[n]) for n in GAIN_SENSORS)]
    + [Signal(f"{n}_{when}_smooth", "V", f"the same, {text}", nominal=300.0)
       for when, text in (("mid", "midway to the next sample"), ("next", "of the next sample"))
       for n in VOLTAGES]
    + [Signal("theta_smooth", "rad", "rotor angle of a machine at rest with those phasors")]
)  # fmt: skip
#: A leaky fault as the terminals see it, R and L in series from the phase to the neutral: what of
#: their currents goes with it is nearly linear in the admittance, and far from it in mu and k_rf.
ADMITTANCE = Signals(
    [Signal(f"{n}_shunt", "1", f"{text} of the fault's branch at rated frequency, times r_s",
            default=0.0, nominal=1e-3)
     for n, text in (("g", "conductance"), ("b", "susceptance, inductive"))]
)  # fmt: skip
I_SHUNT = Signal("i_shunt", "A", "current of the fault's branch, mu i_fault", nominal=10.0)
#: A reading further from its prediction than this many standard deviations is taken itself.
SMOOTH_LIMIT = 6.0
_DT_LAST = Signal("dt_last", "s", "step before this sample; 0 at the first", nominal=1e-4)
_KEEP = Signal("keep", "1", "0 at the start of a window of the mean power, else 1", default=1.0)
_ENERGY = Signal("energy", "J", "both generators' mechanical energy since the window's start",
                 nominal=1e4)  # fmt: skip


@dataclass(frozen=True, eq=False)
class ElectricalFilter:
    """The filter's model with what makes priors and recordings for it.

    Parameters
    ----------
    model : for :func:`estimators.ekf.extended_kalman_filter` and all others.
    machine : its parameters.
    sensors : 1-sigma table; noise of voltages, field voltage and speed is inside the model.
    gains : ``"none"``, ``"estimate"`` or ``"consider"``: constant gain errors of the sensors.
    kappa : None for full coupling, else the leakage partition that the model assumes.
    phase : the faulty phase that the model assumes; None where it is found.
    power : whether the mean power is a state.
    """

    model: FilterModel
    machine: MachineParameters
    sensors: SensorSet
    gains: str
    kappa: float | None
    phase: str | None
    power: bool

    def recording(
        self, samples: Mapping[str, Any], *, window: float | None = None, start: float | None = None
    ) -> Recording:
        """Make the filter's recording from samples by name.

        Parameters
        ----------
        samples : ``t`` (s) and w_r, v_a, v_b, v_c, V_fd, i_a, i_b, i_c, i_fd, each of shape (K,).
            NaN is a missing sample: a missing current is not used; an instant without all voltages
            and speed is left out, and the step goes over it.
        window : length of the windows of the mean power, s, with ``power``; default 0.02.
        start : beginning of the first window, s; default the first instant.

        Raises
        ------
        DataError : missing names, shapes, no usable instant.
        """
        names = ("t", "w_r", *VOLTAGES, *MEASURED)
        missing = [n for n in names if n not in samples]
        if missing:
            raise DataError(f"samples lack {', '.join(missing)}")
        a = {n: np.asarray(samples[n], dtype=float) for n in names}
        K = a["t"].size
        wrong = [f"{n} {v.shape}" for n, v in a.items() if v.shape != (K,)]
        if wrong:
            raise DataError(f"samples of shape ({K},) expected, as t; got {', '.join(wrong)}")
        there = np.all([np.isfinite(a[n]) for n in ("t", "w_r", *VOLTAGES)], axis=0)
        if not there.any():
            raise DataError("no instant has all of w_r, v_a, v_b, v_c, V_fd")
        a = {n: v[there] for n, v in a.items()}
        t = a["t"]
        given = {n: a[n] for n in INPUTS.names}
        v = np.array([a[n] for n in PHASES_V])
        given |= dict(zip(_JUMPS.names, jumps(t, v, a["w_r"], floor=JUMP), strict=True))
        mid = _middles(t, v, a["w_r"], np.any([given[n] > 0 for n in _JUMPS.names], axis=0))
        given |= {f"{n}_mid": m for n, m in zip(VOLTAGES, mid, strict=False)}
        given["V_fd_mid"] = (a["V_fd"] + np.append(a["V_fd"][1:], a["V_fd"][-1])) / 2
        given |= {f"{n}_next": np.append(a[n][1:], a[n][-1]) for n in VOLTAGES}
        given["dt_last"] = np.append(0.0, np.diff(t))
        if self.gains != "none":
            given |= self._smooth(a, given)
        if self.power:
            given["keep"] = np.ones(t.size)
            given["keep"][_window_starts(t, 0.02 if window is None else window, start)] = 0.0
        u = self.model.u.pack(given)
        y = np.array([a[n] for n in MEASURED])
        sigma = np.array([[self.sensors.sigma(n, 0.0)] for n in MEASURED])
        variance = np.broadcast_to(sigma**2, y.shape).copy()
        return Recording(t, u, y, variance, self.model.p.pack({}))

    def _smooth(
        self, a: Mapping[str, np.ndarray], given: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Return the predictions of readings about which a model with gains is written."""
        t, w = a["t"], a["w_r"]
        out = {}
        share = middle_weight(w, np.append(np.diff(t), 0.0))
        for names, harmonics in (((*PHASES_V, *PHASES_I), (1, 3)), (("V_fd", "i_fd"), (0, 2))):
            # a missing current is predicted as well; in the mean it counts as zero
            x = np.array([np.nan_to_num(a[n]) for n in names])
            for n, p in zip(names, before(t, x, w, harmonics=harmonics), strict=True):
                off = np.abs(a[n] - p) > SMOOTH_LIMIT * self.sensors.sigma(n, 0.0)
                out[f"{n}_smooth"] = p = np.where(off, a[n], p)
                if n in VOLTAGES:
                    rest = a[n] - p
                    rest = (rest + np.append(rest[1:], 0.0)) * (share if n in PHASES_V else 0.5)
                    # what the ends are short of their readings, the middle is, too: it cancels
                    out[f"{n}_mid_smooth"] = given[f"{n}_mid"] - rest
                    out[f"{n}_next_smooth"] = np.append(p[1:], a[n][-1])
        turn = np.exp(1j * np.array(list(PHASE_ANGLE.values())))
        v, i = (
            2 / 3 * (turn @ before(t, np.array([a[n] for n in names]), w, space=True))
            for names in (PHASES_V, PHASES_I)
        )
        p = self.machine
        out["theta_smooth"] = np.angle(v + (p.r_s + 1j * w * (p.L_mq + p.L_ls)) * i)
        return out

    def prior(
        self,
        samples: Mapping[str, Any],
        *,
        period: float | None = None,
        sigma: Mapping[str, float] | None = None,
    ) -> Belief:
        """Start from the first electrical period: a balanced machine at rest with its phasors.

        The positive sequence of voltages and currents gives the angle and the fluxes, the mean
        field current the field.  A severity h_k takes h_k v/(3 r_s) of the positive sequence from
        the machine, and gain errors are in the readings: the start moves with both, and the prior
        holds the correlations (h by ``H_SIGMA``).  A leaky fault has been there for long: its
        current is that of the phase's voltage phasor.  Unbalance and transients are what
        ``START_SIGMA`` stands for.  The period's samples are used again by the filter; beside their
        information that of the start is nothing.

        Parameters
        ----------
        samples : as for :meth:`recording`.
        period : length of the piece looked at, s; default one electrical period.
        sigma : other standard deviations, by state.

        Raises
        ------
        DataError : fewer than eight samples in the period, or no voltage.
        """
        a = {n: np.asarray(samples[n], dtype=float) for n in ("t", "w_r", *VOLTAGES, *MEASURED)}
        good = np.all([np.isfinite(v) for v in a.values()], axis=0)
        a = {n: v[good] for n, v in a.items()}
        if not a["t"].size:
            raise DataError("no complete sample to start from")
        w = float(np.median(a["w_r"][: max(1, a["t"].size // 50)]))
        T = 2 * math.pi / abs(w) if period is None else period
        first = a["t"] < a["t"][0] + T * (1 - 1e-6)
        if first.sum() < 8:
            raise DataError(f"the first {T:.3g} s hold {int(first.sum())} samples; 8 are needed")
        a = {n: v[first] for n, v in a.items()}
        tau = a["t"] - a["t"][0]
        basis = np.column_stack([np.cos(w * tau), -np.sin(w * tau), np.ones_like(tau)])
        turn = np.exp(1j * np.array(list(PHASE_ANGLE.values())))

        def phasors(names: Sequence[str]) -> np.ndarray:
            c = np.linalg.lstsq(basis, np.column_stack([a[n] for n in names]), rcond=None)[0]
            return np.asarray(c[0] + 1j * c[1])

        v_abc, i_abc = phasors(PHASES_V), phasors(PHASES_I)
        v = complex(v_abc @ turn) / 3
        if abs(v) < 0.05 * self.machine.V_rated_rms:
            raise DataError(f"no voltage to start from: positive sequence {abs(v):.3g} V")
        p, i_fd, e = self.machine, float(a["i_fd"].mean()), 1e-6

        Y_0 = complex(LEAKY_START, -LEAKY_START)

        def start(share: Mapping[str, float], h: float = 0.0, Y: complex = Y_0) -> dict[str, float]:
            """Return the start with some readings taken for more by a share of them, a fault."""
            by = [1 + share.get(n, 0.0) for n in (*PHASES_V, *PHASES_I, "i_fd")]
            v, i = (complex(x * k @ turn) / 3 for x, k in ((v_abc, by[:3]), (i_abc, by[3:6])))
            i_0 = float((i_abc * by[3:6]).sum().real) / 3
            i += h * v / (3 * p.r_s)
            if self.kappa is None:
                return balanced_state(p, v=v, i=i, w_r=w, i_fd=i_fd * by[6], i_0=i_0)
            k = PHASES.index(str(self.phase))
            i_shunt = -Y / p.r_s * v_abc[k] * by[k]
            i -= i_shunt * turn[k] / 3
            i_0 -= i_shunt.real / 3
            there = balanced_state(p, v=v, i=i, w_r=w, i_fd=i_fd * by[6], i_0=i_0)
            return there | {"i_shunt": float(i_shunt.real)}

        at = start({})
        means = dict.fromkeys(self.model.x.names, 0.0) | at
        means |= {n: LEAKY_START for n in ADMITTANCE.names if n in means}
        spread = dict.fromkeys((*SHUNTS.names, *ADMITTANCE.names), H_SIGMA) | START_SIGMA
        spread |= {"energy": 0.0, "i_shunt": START_SIGMA_SHUNT}
        spread |= {f"gain_{n}": self.sensors[n].gain for n in GAIN_SENSORS}
        spread = {n: spread[n] for n in means}
        for n, size in (sigma or {}).items():
            self.model.x.index(n)
            spread[n] = size
        prior = Belief.of(self.model.x, means, spread)
        moved = {n: start({}, e) for n in SHUNTS.names}
        moved |= {"g_shunt": start({}, Y=Y_0 + e), "b_shunt": start({}, Y=Y_0 - 1j * e)}
        moved |= {f"gain_{n}": start({n: -e}) for n in GAIN_SENSORS}
        turned = np.eye(len(self.model.x))
        for name, there in moved.items():
            if name in self.model.x:
                for n in at:
                    change = there[n] - at[n]
                    slope = (math.remainder(change, 2 * math.pi) if n == "theta_e" else change) / e
                    turned[self.model.x.index(n), self.model.x.index(name)] += slope
        return Belief(self.model.x, prior.mean, turned @ prior.cov @ turned.T)


def _middles(t: np.ndarray, v: np.ndarray, w_r: np.ndarray, jumped: np.ndarray) -> np.ndarray:
    """Return the voltages midway to the next samples, shape (3, K).

    After a jump the load is another, and so are the harmonics: their average begins anew.
    """
    out = midpoints(t, v, w_r, periods=0)
    ends = np.append(np.flatnonzero(jumped[:-1]), t.size - 1) + 1
    for begin, end in zip(np.append(0, ends[:-1]), ends, strict=True):
        part = slice(begin, end)
        # the step over the jump itself is left as it is
        piece = midpoints(t[part], v[:, part], w_r[part], periods=HARMONIC_PERIODS)
        out[:, begin : end - 1] = piece[:, :-1]
    return out


def _window_starts(t: np.ndarray, window: float, start: float | None) -> np.ndarray:
    """Return the indices of the first instants of the windows."""
    if not window > 0:
        raise DataError(f"window = {window!r} s must be > 0")
    k = np.floor((t - (t[0] if start is None else start) + SAME_TIME) / window)
    return np.flatnonzero(np.diff(k, prepend=-np.inf))


@lru_cache(maxsize=32)
def electrical_filter(
    machine: MachineParameters | None = None,
    *,
    sensors: SensorSet = ELECTRICAL,
    h_walk: float | None = None,
    flux_walk: float = FLUX_WALK,
    gains: str = "none",
    power: bool = False,
    phases: tuple[str, ...] = PHASES,
    kappa: float | None = None,
    phase: str | None = None,
) -> ElectricalFilter:
    """Make the electrical filter.

    Parameters
    ----------
    machine : parameters; default Table 1.
    sensors : 1-sigma table.
    h_walk, flux_walk : random walks of h (1/sqrt(s); default ``H_WALK``, with gains
        ``H_WALK_GAINS``; of a leaky fault's admittance ``LEAKY_WALK``) and of the fluxes
        (Wb/sqrt(s)).
    gains : ``"estimate"`` or ``"consider"`` the eight constant gain errors, or ``"none"``.
        Estimated, they make h drift by a standard deviation in a second (the angle's error is in
        the derivatives and in the innovations alike) and suit recordings of that length; a second
        pass, :func:`estimators.relinearised.relinearised_filter`, halves that, and errors are then
        what is claimed.
        Considered, nothing drifts, and the NIS, which then holds constant offsets, is no test; the
        angle then walks by ``ANGLE_WALK_CONSIDERED``.
    power : add the state ``energy``, for :func:`window_power`.
    phases : phases with an h; none of them makes the healthy machine's filter.
    kappa : leakage partition; None is full coupling (kappa = mu).  With a number the states are
        i_shunt, g_shunt and b_shunt of one ``phase`` instead of three h; :func:`leaky_fault` gives
        mu and k_rf.
    phase : the faulty phase, with ``kappa`` only.

    Raises
    ------
    ParameterError : unknown choice, kappa without phase or the other way round.
    """
    machine = MachineParameters() if machine is None else machine
    if gains not in GAINS:
        raise ParameterError(f"gains {gains!r} {nearest(str(gains), GAINS)}")
    wrong = [k for k in (*phases, *([] if phase is None else [phase])) if k not in PHASES]
    if wrong:
        raise ParameterError(f"phase {wrong[0]!r} {nearest(str(wrong[0]), PHASES)}")
    if (kappa is None) != (phase is None):
        raise ParameterError(
            "kappa and phase come together: with full coupling (kappa=None) the phase is found"
        )
    if kappa is not None and gains != "none":
        raise ParameterError("gains are estimated with full coupling (kappa=None) only")
    if kappa is not None and not 0 < kappa <= 1:
        raise ParameterError(f"kappa = {kappa!r} must lie in (0, 1]")
    model = _build(machine, sensors, power, kappa, phase, gains != "none")
    walks = dict.fromkeys((n for n in FLUXES.names), flux_walk)
    if h_walk is None:
        h_walk = LEAKY_WALK if kappa is not None else H_WALK
        h_walk = h_walk if gains == "none" else H_WALK_GAINS
    if kappa is None:
        unknown = {f"h_{k}": Unknown(walk=h_walk) for k in phases}
    else:
        unknown = {
            n: Unknown(walk=h_walk, lower=low)
            for n, low in zip(ADMITTANCE.names, (-math.inf, LEAST_SUSCEPTANCE), strict=True)
        }
        walks["i_shunt"] = 0.0
    if gains == "consider":
        walks["theta_e"] = ANGLE_WALK_CONSIDERED
    if gains != "none":
        unknown |= {f"gain_{n}": Unknown(consider=gains == "consider") for n in GAIN_SENSORS}
    model = augment(model, unknown).with_walk(walks).expanded()
    return ElectricalFilter(model, machine, sensors, gains, kappa, phase, power)


def held(p: MachineParameters, *, w_r: Any, dt: Any, v: Qd0, V_fd: Any) -> Windings:
    """Return what the fluxes at the end of a step hold of the voltages there, Wb: G of the module.

    The derivative of :func:`~apu_casadi.terminalmodel.advance`: the voltages over about dt/2, less
    what the resistances take back of it (a third of the step later on average), which also brings
    some of it into the dampers.  Terms of the third order in dt are left out: 1e-3 of it.

    Parameters
    ----------
    p : machine parameters.
    w_r : electrical speed, rad/s.
    dt : the step before, s.
    v, V_fd : voltages at its end on the rotor's axes there, field voltage, V.
    """
    weight = voltage_weight(w_r, dt)
    first = Windings(weight * v.q, weight * v.d, weight * v.zero, dt / 2 * V_fd, 0.0, 0.0)
    none = Qd0(0.0, 0.0, 0.0)
    back = flux_rates(
        p, lam=first, i=currents(p, first), v=none, V_fd=0.0, w_r=0.0, w1=none, w2=(0.0, 0.0, 0.0)
    )
    return Windings(*(a + dt / 3 * b for a, b in zip(first, back, strict=True)))


def _pair(p: MachineParameters, kappa: float, g: Any, b: Any) -> tuple[Any, Any]:
    """Return mu and k_rf whose branch has the admittance (g - j b)/r_s at rated frequency.

    :func:`~apu_casadi.terminalmodel.shunt_parameters` with R = r_s g/(g^2 + b^2) and
    w L = r_s b/(g^2 + b^2), without its checks: for symbols and for complex steps.
    """
    size = g**2 + b**2
    x = p.r_s / (p.w_rated * p.L_ls)  # of the leakage reactance, over r_s
    mu = kappa * size / (size + x * b)
    return mu, mu * g / size - 1.0 + mu


def _exponential(z: Any) -> tuple[Any, Any, Any, Any]:
    """Return exp(z) and weights, over dt, of v at 0, dt/2 and dt in dx/dt = (z/dt) x + v.

    The integral of exp(z (1 - s)) with the parabola through the three values: exact however fast
    the decay is, where a Runge-Kutta step needs |z| well below 1.  With z = 0 it is Simpson's rule.
    Hochbruck and Ostermann (2010), Acta Numerica 19, 209, section 2.
    """
    small = ca.fabs(z) < 0.5
    far = ca.if_else(small, 1.0, z)
    series = sum(z**j / math.factorial(j + 3) for j in range(11))
    phi3 = ca.if_else(small, series, (ca.exp(far) - 1.0 - far - far**2 / 2) / far**3)
    phi2 = 0.5 + z * phi3
    phi1 = 1.0 + z * phi2
    weights = phi1 - 3.0 * phi2 + 4.0 * phi3, 4.0 * phi2 - 8.0 * phi3, 4.0 * phi3 - phi2
    return (ca.exp(z), *weights)


def _build(
    p: MachineParameters,
    sensors: SensorSet,
    power: bool,
    kappa: float | None,
    phase: str | None,
    with_gains: bool,
) -> FilterModel:
    """Write the discrete model; h or (mu, k_rf), and the gains, are parameters of it."""
    leaky = kappa is not None
    X = FLUXES + Signals([ANGLE]) + Signals([I_SHUNT] if leaky else [])
    X = X + Signals([_ENERGY] if power else [])
    U = INPUTS + _LATER + _JUMPS + Signals([_DT_LAST]) + Signals([_KEEP] if power else [])
    U = U + (_SMOOTH if with_gains else Signals())
    gain = Signals(
        [Signal(f"gain_{n}", "1", f"relative gain error of the sensor of {n}", default=0.0,
                nominal=0.01) for n in GAIN_SENSORS if with_gains]
    )  # fmt: skip
    PAR = (ADMITTANCE if leaky else SHUNTS) + gain
    W = Signals(
        [Signal(f"w_{n}", "1", f"error of the measured {n} over its standard deviation")
         for n in (*VOLTAGES, "w_r")]
        + [Signal(f"w_jump_{n}", "1", f"unknown course of a jump of the voltage, {n} axis")
           for n in "qd0"]
    )  # fmt: skip
    (xv, x), (uv, u), (pv, par), (wv, w) = X.sx(), U.sx(), PAR.sx(), W.sx()
    dt = ca.SX.sym("dt")

    # measured -> true: reading = (1 + gain) v + error; the next sample's error is that state's
    rate_noise = sensors["w_r"].noise * (u["w_r"] if sensors["w_r"].relative else 1.0)
    w_r = u["w_r"] - rate_noise * w["w_w_r"]
    error = {n: sensors.sigma(n, 0.0) * w[f"w_{n}"] for n in VOLTAGES}
    share = dict.fromkeys(VOLTAGES, middle_weight(u["w_r"], dt)) | {"V_fd": 0.5}
    # what is added to the state for the reading at this sample: minus its error, and, where the
    # state holds a prediction in its place, what the reading is more than that
    added = {n: -error[n] for n in VOLTAGES}
    if with_gains:
        factor = {n: 1.0 / (1.0 + par[f"gain_{n}"]) for n in GAIN_SENSORS}
        added = {n: u[n] - u[f"{n}_smooth"] - error[n] for n in VOLTAGES}
        now, mid, then = (
            {n: factor[n] * u[f"{n}{when}_smooth"] for n in VOLTAGES}
            for when in ("", "_mid", "_next")
        )
        reference = u["theta_smooth"]
    else:
        now, mid, then = ({n: u[f"{n}{when}"] for n in VOLTAGES} for when in ("", "_mid", "_next"))
        reference = x["theta_e"]
    added_qd0 = abc_to_qd0(reference, Abc(*(added[n] for n in PHASES_V)))
    for n, a in zip(PHASES_V, qd0_to_abc(x["theta_e"], added_qd0), strict=True):
        added[n] = a if with_gains else added[n]
    start, middle, end = (
        Terminals(w_r, Abc(*(v[n] + c[n] * added[n] for n in PHASES_V)),
                  v["V_fd"] + c["V_fd"] * added["V_fd"])
        for v, c in ((now, dict.fromkeys(VOLTAGES, 1.0)), (mid, share),
                     (then, dict.fromkeys(VOLTAGES, 0.0)))
    )  # fmt: skip

    # in the middle, so that currents and rotor follow it; 2/3 of the middle counts in the integral
    sizes = zip("qd0", (u["jump_qd"], u["jump_qd"], u["jump_0"]), strict=True)
    jump = Qd0(*(1.5 * JUMP_SHARE * size * w[f"w_jump_{n}"] for n, size in sizes))
    jump_abc = qd0_to_abc(x["theta_e"], jump)
    middle = middle._replace(v=Abc(*(a + b for a, b in zip(middle.v, jump_abc, strict=True))))

    # x(k) = s(k) + G (reading - error - what s(k) holds of it)
    more = held(p, w_r=u["w_r"], dt=u["dt_last"], v=added_qd0, V_fd=added["V_fd"])
    at = dict(x)
    for n, e in zip(FLUXES.names, more, strict=True):
        at[n] = x[n] + e
    if leaky:
        assert kappa is not None
        mu, k_rf = _pair(p, kappa, par["g_shunt"], par["b_shunt"])
        fault = {"mu": mu, "k_rf": k_rf, "kappa": kappa, "phase_angle": PHASE_ANGLE[str(phase)]}
        # L di/dt = -v - R i, with R/L and 1/L
        decay_rate = p.w_rated * par["g_shunt"] / par["b_shunt"]
        per_volt = p.w_rated * (par["g_shunt"] ** 2 + par["b_shunt"] ** 2) / par["b_shunt"] / p.r_s
        _, _, mid, last = _exponential(-decay_rate * u["dt_last"])
        last += mid * middle_weight(u["w_r"], u["dt_last"])
        at["i_shunt"] = x["i_shunt"] - u["dt_last"] * per_volt * last * added[f"v_{phase}"]
    else:
        fault = {n: par[n] for n in SHUNTS.names}

    def equations(s: Any, there: Terminals) -> tuple[dict[str, Any], dict[str, Any]]:
        d = X.unpack(s)
        lam = Windings(*(d[n] for n in FLUXES.names))
        return terminal_equations(
            p, lam=lam, theta_e=d["theta_e"], at=there, fault=fault,
            i_fault=d["i_shunt"] / mu if leaky else None,
        )  # fmt: skip

    def rate(s: Any, there: Terminals) -> Any:
        # a leaky fault's current follows the voltages alone, and has a step of its own
        rates = dict.fromkeys(X.names, 0.0) | equations(s, there)[0]
        return X.stack({n: rates[n] for n in X.names})

    s0 = X.stack(at)
    x1 = advance(rate, s0, start, middle, end, dt)
    if leaky:
        decay, *weights = _exponential(-decay_rate * dt)
        k = PHASES.index(str(phase))
        driven = sum(c * there.v[k] for c, there in zip(weights, (start, middle, end), strict=True))
        x1[X.index("i_shunt")] = decay * at["i_shunt"] - dt * per_volt * driven
    y = equations(s0, start)[1]
    read = [y[n] for n in MEASURED]
    if with_gains:
        # what the state predicts, and apart from it what the reading adds, by the reference angle
        first = equations(xv, Terminals(w_r, Abc(*(now[n] for n in PHASES_V)), now["V_fd"]))[1]
        i_more = currents(p, more)
        extra = [*qd0_to_abc(reference, i_more.stator), i_more.fd]
        read = [
            first[n] + e + (1.0 - factor[n]) * u[f"{n}_smooth"]
            for n, e in zip(MEASURED, extra, strict=True)
        ]
    if power:
        x1[X.index("energy")] = u["keep"] * x["energy"] + dt * y["P_total"]
    name = f"electrical_{'leaky' if leaky else 'shunts'}"
    name += ("_power" if power else "") + ("_gains" if with_gains else "")
    nx, none = len(X), ca.SX(0)
    return FilterModel(
        name,
        X,
        U,
        PAR,
        W,
        Signals([OUTPUTS[k] for k in MEASURED]),
        transition=ca.Function(
            f"{name}_f", [xv, uv, pv, wv, dt], [x1, none], ["x", "u", "p", "w", "dt"],
            ["x1", "check"], {"cse": True},
        ),
        output=ca.Function(
            f"{name}_g", [xv, uv, pv, wv], [ca.vertcat(*read), none], ["x", "u", "p", "w"],
            ["y", "check"], {"cse": True},
        ),
        walk=np.zeros(nx),
        lower=np.full(nx, -np.inf),
        upper=np.full(nx, np.inf),
    )  # fmt: skip


# ---------------------------------------------------------------------------------- tracking


def track(
    filt: ElectricalFilter,
    prior: Belief,
    data: Recording,
    *,
    backend: str | None = None,
    max_resets: int = 20,
    own_level: bool | None = None,
) -> tuple[FilterResult, list[float]]:
    """Filter a recording in which faults come and go: h follows steps at once.

    The random walk of h is for slow changes; a step of 1e-3 would take it 0.2 s.  So the
    innovations are watched: where their normalised square, averaged over ``RESET_WINDOW`` samples,
    exceeds ``RESET_LEVEL``, h and fluxes become uncertain again at the window's start
    (``RESET_SIGMA``), and the filter goes on from there.  The first two windows of a piece are not
    judged, since a start needs them to settle.

    Parameters
    ----------
    filt, prior, data, backend : as of the filter.
    max_resets : more than these, and the model is refused.
    own_level : whether a window is compared with those before it (the first four are not judged)
        instead of with what white innovations give: where gain errors are considered (the
        default there), or taken as noise, each unit has a level of its own.

    Returns
    -------
    result : as from one filter.
    resets : instants, s.

    Raises
    ------
    EstimationError : more than ``max_resets`` resets: the model does not fit the data at all.
    """
    own_level = filt.gains == "consider" if own_level is None else own_level
    begin = 0
    pieces: list[FilterResult] = []
    resets: list[float] = []
    rest = data
    mean_of = np.ones(RESET_WINDOW) / RESET_WINDOW
    while True:
        r = extended_kalman_filter(filt.model, prior, rest, backend=backend)
        # judged window by window; the first two after a start are not
        full = r.nis.size // RESET_WINDOW
        share = r.nis[: full * RESET_WINDOW].reshape(full, RESET_WINDOW) @ mean_of
        usual = _usual(share) if own_level else np.full(full, float(len(MEASURED)))
        share[:2] = 0.0
        bad = np.flatnonzero(share > usual + RESET_LEVEL - len(MEASURED))
        if not bad.size:
            pieces.append(_piece(r, r.nis.size))
            return _joined(pieces), resets
        if len(resets) == max_resets:
            raise EstimationError(
                f"{filt.model.name}: {max_resets} resets up to t = {resets[-1]:.6g} s and still "
                f"the innovations are {share[bad[0]]:.3g} times what they should be: the model "
                "does not fit these data (another kappa, other parameters, sensor faults)"
            )
        cut = int(bad[0]) * RESET_WINDOW
        # once more up to the cut, whose sample is left to the next piece: a belief of s(cut)
        upto = rest.part(0, cut + 1)
        y = upto.y.copy()
        y[:, -1] = np.nan
        r = extended_kalman_filter(
            filt.model, prior, dataclasses.replace(upto, y=y), backend=backend
        )
        pieces.append(_piece(r, cut))
        wide = np.zeros(len(filt.model.x))
        for name, s in RESET_SIGMA.items():
            if name in filt.model.x:
                wide[filt.model.x.index(name)] = s**2
        prior = Belief(filt.model.x, r.final.mean, r.final.cov + np.diag(wide))
        begin += cut
        resets.append(float(data.t[begin]))
        rest = data.part(begin, data.size)


def _usual(share: np.ndarray) -> np.ndarray:
    """Return what each window's mean NIS is compared with where gains are considered.

    Their offsets stay in the innovations, so a unit has its own level: the median of up to 20
    windows before, four at least.
    """
    out = np.full(share.size, math.inf)
    for k in range(4, share.size):
        out[k] = max(float(len(MEASURED)), float(np.median(share[max(k - 20, 1) : k])))
    return out


def _piece(r: FilterResult, n: int) -> FilterResult:
    """Return the first n instants."""
    return dataclasses.replace(
        r, t=r.t[:n], mean=r.mean[:, :n], variance=r.variance[:, :n],
        innovation=r.innovation[:, :n], innovation_variance=r.innovation_variance[:, :n],
        nis=r.nis[:n], measured=r.measured[:n],
    )  # fmt: skip


def _joined(pieces: list[FilterResult]) -> FilterResult:
    names = ("t", "mean", "variance", "innovation", "innovation_variance", "nis", "measured")
    joined: dict[str, Any] = {
        n: np.concatenate([getattr(p, n) for p in pieces], axis=-1) for n in names
    }
    joined["loglik"] = sum(p.loglik for p in pieces)
    return dataclasses.replace(pieces[-1], **joined)


# ---------------------------------------------------------------------------------- what it says


@dataclass(frozen=True)
class Verdict:
    """Which phase is faulty, and how much.

    Parameters
    ----------
    phase : "a", "b", "c", or None where no phase's h exceeds its noise by ``level``.
    h, sigma : severity of that (or of the likeliest) phase with the other two healthy, and its
        standard deviation.
    statistic : (h/sigma)^2 of each phase alone, chi-squared with one degree of freedom where there
        is no fault; zero for h < 0.
    probability : of each phase to be the one, given that one is faulty and all severities were
        equally likely before.
    """

    phase: str | None
    h: float
    sigma: float
    statistic: dict[str, float]
    probability: dict[str, float]


def faulty_phase(belief: Belief | FilterResult, *, level: float = FAULT_LEVEL) -> Verdict:
    """Find the faulty phase from the three severities and their covariance.

    For each phase k the best h_k with the other two zero is c = (P^-1 h)_k / (P^-1)_kk, and its
    likelihood ratio against a healthy machine c^2 (P^-1)_kk.

    Parameters
    ----------
    belief : of a filter with the three h, or a result (its last instant).
    level : statistic above which a fault is reported.

    Raises
    ------
    EstimationError : the belief has not the three severities.
    """
    b = belief.final if isinstance(belief, FilterResult) else belief
    names = [f"h_{k}" for k in PHASES]
    if any(n not in b.x for n in names):
        raise EstimationError(
            f"faulty_phase needs {', '.join(names)}; the belief has {', '.join(b.x.names)}"
        )
    m = b.marginal(names)
    info = np.linalg.inv(m.cov)
    c = (info @ m.mean) / np.diag(info)
    stat = np.where(c > 0, c**2 * np.diag(info), 0.0)
    best = int(np.argmax(stat))
    # marginal likelihood over h > 0 with a flat prior: exp(stat/2) / sqrt(info)
    score = stat / 2 - 0.5 * np.log(np.diag(info))
    prob = np.exp(score - score.max())
    prob /= prob.sum()
    return Verdict(
        PHASES[best] if stat[best] > level else None,
        float(c[best]),
        float(1 / math.sqrt(info[best, best])),
        dict(zip(PHASES, map(float, stat), strict=True)),
        dict(zip(PHASES, map(float, prob), strict=True)),
    )


def ridge(h: float, k_rf: Sequence[float] = (0.0, 1.0, 10.0, 100.0)) -> list[dict[str, float]]:
    """Return pairs (mu, k_rf) that the terminals cannot tell apart for kappa = mu.

    mu = h (1 + k_rf) / (1 + h); pairs with mu >= 1 are left out.
    """
    rows = [{"k_rf": float(k), "mu": h * (1 + k) / (1 + h)} for k in k_rf]
    return [r for r in rows if 0 < r["mu"] < 1]


def leaky_fault(filt: ElectricalFilter, belief: Belief | FilterResult) -> Belief:
    """Return mu and k_rf of a leaky fault for the kappa that the filter assumes.

    By linearisation about the estimated admittance: right where its parts are known to a small
    share of themselves.

    Parameters
    ----------
    filt : made with a kappa.
    belief : of it, or a result (its last instant).

    Raises
    ------
    EstimationError : the filter was not made with a kappa; or the susceptance is not above three of
        its standard deviations: the branch then shows no inductance, and only h is told.
    """
    if filt.kappa is None:
        raise EstimationError("with full coupling there is one number h, and no mu and k_rf")
    b = belief.final if isinstance(belief, FilterResult) else belief
    m = b.marginal(ADMITTANCE.names)
    least = LEAST_SUSCEPTANCE + 3.0 * m.sigma[1]
    if not m.mean[1] > least:
        raise EstimationError(
            f"the fault's branch shows no inductance: b_shunt = {m.mean[1]:.2e} is not above three "
            f"of its standard deviations, {least:.1e}, so that mu and k_rf cannot be told apart; "
            f"use full coupling (kappa=None), whose h is {m.mean[0]:.2e} here"
        )
    e = 1e-20  # a complex step: the derivative without differences
    g, s = m.mean
    steps = [_pair(filt.machine, filt.kappa, *at) for at in ((g + e * 1j, s), (g, s + e * 1j))]
    J = np.array(steps).imag.T / e
    pair = np.array(_pair(filt.machine, filt.kappa, g, s), dtype=float)
    return Belief(Signals([LEAKY["mu"], LEAKY["k_rf"]]), pair, J @ m.cov @ J.T)


def describe(filt: ElectricalFilter, belief: Belief | FilterResult) -> str:
    """Say in words what is known of the fault.

    Raises
    ------
    EstimationError : as :func:`faulty_phase`.
    """
    b = belief.final if isinstance(belief, FilterResult) else belief
    if filt.kappa is not None:
        try:
            found = leaky_fault(filt, b)
        except EstimationError as e:
            return str(e)
        (mu, s_mu), (k, s_k) = found["mu"], found["k_rf"]
        text = (
            f"phase {filt.phase}, kappa = {filt.kappa:g} assumed: mu = {mu:.3g} +- "
            f"{1.96 * s_mu:.1g}, k_rf = {k:.3g} +- {1.96 * s_k:.1g} (95 %)"
        )
        if s_k > 0.3 * (1 + abs(k)):
            text += "; k_rf is not determined by these data"
        return text + "; another kappa would give another pair"
    v = faulty_phase(b)
    if v.phase is None:
        return f"no fault: h < {max(v.h, 0) + 1.645 * v.sigma:.1e} in every phase (95 %)"
    pairs = ", ".join(f"({r['mu']:.3g}, {r['k_rf']:g})" for r in ridge(v.h))
    return (
        f"phase {v.phase} (probability {v.probability[v.phase]:.3f}): h = {v.h:.3e} +- "
        f"{1.96 * v.sigma:.0e} (95 %); with full coupling mu and k_rf are not told apart, any pair "
        f"with mu = h (1 + k_rf)/(1 + h) fits, for example (mu, k_rf) = {pairs}"
    )


def shunt_of(
    filt: ElectricalFilter, belief: Belief | FilterResult, kappa: float
) -> dict[str, float]:
    """Return the (mu, k_rf) that another kappa gives for the same estimated shunt R, L.

    Raises
    ------
    EstimationError : the filter was not made with a kappa, and as :func:`leaky_fault`.
    """
    if filt.kappa is None:
        raise EstimationError("with full coupling there is one number h, and no shunt inductance")
    mu, k = (float(x) for x in leaky_fault(filt, belief).mean)
    p = filt.machine
    R = p.r_s * (k + 1 - mu) / mu
    L = (filt.kappa - mu) * p.L_ls / mu
    return shunt_parameters(p, R=R, L=L, kappa=kappa)


def window_power(
    filt: ElectricalFilter, result: FilterResult, data: Recording
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean mechanical power of both generators, (8), over each window, and its variance.

    The filter carries the energy since the window's start as a state, so the variance at the
    window's end holds the correlation of all samples in it, and of h, fluxes and (where they are
    states) gain errors with them: a window is one measurement for whoever takes it.  Without gains
    among the states their share is missing; see ``gain_share`` in the studies.

    Returns
    -------
    t : ends of the windows, s, shape (n,).
    P : mean power, W. var : its variance, W^2.

    Raises
    ------
    EstimationError : a filter without ``power``, or no complete window.
    """
    if not filt.power:
        raise EstimationError("window_power needs a filter made with power=True")
    keep = data.u[filt.model.u.index("keep")]
    starts = np.flatnonzero(keep == 0.0)
    if starts.size < 2:
        raise EstimationError(f"the recording of {data.t[-1] - data.t[0]:.4g} s holds no window")
    length = np.diff(data.t[starts])
    i = result.x.index("energy")
    # at the first instant of the next window the energy is still that of the window before
    P = result.mean[i, starts[1:]] / length
    var = result.variance[i, starts[1:]] / length**2
    return data.t[starts[1:]], P, var
