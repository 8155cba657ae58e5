"""The electrical filter: its model with what makes recordings and starts for it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import DataError, ParameterError, nearest
from apu_casadi.core.sharing import Parametric, last, of_family, remade
from apu_casadi.machine.machinedata import MACHINE, MachineParameters, require_linear
from apu_casadi.machine.park import PHASE_ANGLE, PHASES, Abc, abc_to_qd0
from apu_casadi.machine.terminals import (
    FLUXES,
    INPUTS,
    SHUNTS,
    balanced_state,
    before,
    continued,
    jumps,
    middle_weight,
    midpoints,
)
from estimators.apu.electrical.gaps import evened, filled, usable
from estimators.apu.electrical.machinemodel import electrical_model
from estimators.apu.electrical.sequences import fitted
from estimators.apu.electrical.terminalsignals import (
    ADMITTANCE,
    DELAY,
    GAIN_SENSORS,
    JUMP_SIZES,
    MEASURED,
    PHASES_I,
    PHASES_V,
    VOLTAGES,
)
from estimators.apu.electrical.tuning import (
    ANGLE_WALK_CONSIDERED,
    DELAY_SIGMA,
    FLUX_WALK,
    FREE_SIGMA,
    H_BALANCED,
    H_BALANCED_CONSIDERED,
    H_COMMON_TIME,
    H_SIGMA,
    H_STRAIGHT,
    H_WALK,
    H_WALK_GAINS,
    HARMONIC_PERIODS,
    JUMP,
    LEAKY_START,
    LEAKY_WALK,
    LEAST_SUSCEPTANCE,
    SMOOTH_LIMIT,
    START_SIGMA,
    START_SIGMA_SHUNT,
)
from estimators.apu.sensorchain import spread
from estimators.apu.sensors import ELECTRICAL, SensorSet
from estimators.filters.belief import Belief
from estimators.models.filtermodel import FilterModel, Unknown, augment
from estimators.models.recording import SAME_TIME, Recording, plain_numbers

__all__ = [
    "GAINS",
    "ElectricalFilter",
    "considering",
    "electrical_filter",
    "jump_floor",
    "window_starts",
]

#: Harmonics that each channel consists of, for what is missing of it.
HARMONICS_OF: dict[str, tuple[int, ...]] = dict.fromkeys((*PHASES_V, *PHASES_I), (1, 3))
HARMONICS_OF |= dict.fromkeys(("V_fd", "i_fd"), (0, 2))
GAINS = ("none", "estimate", "consider")
#: Phases onto the positive sequence; and the start of a leaky fault's admittance.
TURN = np.exp(1j * np.array(list(PHASE_ANGLE.values())))
Y_START = complex(LEAKY_START, -LEAKY_START)


@dataclass(frozen=True, eq=False)
class ElectricalFilter(Parametric):
    """The filter's model with what makes priors and recordings for it.

    Args:
        model: for :func:`estimators.filters.ekf.extended_kalman_filter` and all others.
        machine: its parameters.
        sensors: 1-sigma table; noise of voltages, field voltage and speed is inside the model.
        gains: ``"none"``, ``"estimate"`` or ``"consider"``: constant gain errors of the sensors.
        kappa: None for full coupling, else the leakage partition that the model assumes.
        phase: the faulty phase that the model assumes; None where it is found.
        power: whether the mean power is a state.
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

        Args:
            samples: ``t`` (s) and w_r, v_a, v_b, v_c, V_fd, i_a, i_b, i_c, i_fd, each of shape
                (K,). NaN is a missing sample.  A missing current is not used, the others are.
                Voltages and speed that are missing are filled from the harmonics around
                (:mod:`.gaps`), and so are instants that were left out; before the first and after
                the last instant that has all of them nothing is used.
            window: length of the windows of the mean power, s, with ``power``; default 0.02.
            start: beginning of the first window, s; default the first instant.

        Raises:
            DataError: missing names, shapes, no usable instant, infinite samples, a gap with too
                little around it.
        """
        names = ("t", "w_r", *VOLTAGES, *MEASURED)
        missing = [n for n in names if n not in samples]
        if missing:
            raise DataError(f"samples lack {', '.join(missing)}")
        a = {n: plain_numbers(samples[n], n, gaps=True) for n in names}
        K = a["t"].size
        wrong = [f"{n} {v.shape}" for n, v in a.items() if v.shape != (K,)]
        if wrong:
            raise DataError(f"samples of shape ({K},) expected, as t; got {', '.join(wrong)}")
        a = evened(usable(a, ("w_r", *VOLTAGES)))
        off = self._filled(a)
        t = a["t"]
        given = {n: a[n] for n in INPUTS.names}
        v = np.array([a[n] for n in PHASES_V])
        floor = jump_floor(self.sensors)
        given |= dict(zip(JUMP_SIZES.names, jumps(t, v, a["w_r"], floor=floor), strict=True))
        jumped = np.any([given[n] > 0 for n in JUMP_SIZES.names], axis=0)
        mid = _middles(t, v, a["w_r"], jumped)
        given |= {n: np.maximum(given[n], off) for n in JUMP_SIZES.names}
        given |= {f"{n}_mid": m for n, m in zip(VOLTAGES, mid, strict=False)}
        given["V_fd_mid"] = (a["V_fd"] + np.append(a["V_fd"][1:], a["V_fd"][-1])) / 2
        given |= {f"{n}_next": np.append(a[n][1:], a[n][-1]) for n in VOLTAGES}
        given["dt_last"] = np.append(0.0, np.diff(t))
        if self.gains != "none":
            given |= self._smooth(a, given)
        if self.power:
            given["keep"] = np.ones(t.size)
            given["keep"][window_starts(t, 0.02 if window is None else window, start)] = 0.0
        u = self.model.u.pack(given)
        y = np.array([a[n] for n in MEASURED])
        sigma = np.array([spread(self.sensors[n], t, a[n], wave=True) for n in MEASURED])
        variance = sigma**2
        return Recording(t, u, y, variance, self.model.p.pack({}))

    def _filled(self, a: dict[str, np.ndarray]) -> np.ndarray:
        """Fill the inputs in place; return by how much a step's voltage may be off, V, (K,)."""
        t, w = a["t"], a["w_r"]
        there = np.isfinite(w)
        a["w_r"] = w = np.interp(t, t[there], w[there])
        off = np.zeros(t.size)
        for n in VOLTAGES:
            a[n], e = filled(t, a[n], w, HARMONICS_OF[n], n)
            if n in PHASES_V:
                # below that the sensor's noise, which is in the model, stands for it
                e = np.where(e > 3 * self.sensors.sigma(n, 0.0), e, 0.0)
                off = np.maximum(off, np.maximum(e, np.append(e[1:], 0.0)))
        return off

    def _smooth(
        self, a: Mapping[str, np.ndarray], given: Mapping[str, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Return the predictions of readings about which a model with gains is written."""
        t, w = a["t"], a["w_r"]
        out = {}
        full = {n: filled(t, a[n], w, HARMONICS_OF[n], n)[0] for n in GAIN_SENSORS}
        share = middle_weight(w, np.append(np.diff(t), 0.0))
        # a missing current is predicted as well
        phases, field = ([*PHASES_V, *PHASES_I], ["V_fd", "i_fd"])
        x, slow = (np.array([full[n] for n in names]) for names in (phases, field))
        turning = continued(t, x, w, 1)
        predicted = turning.real + continued(t, x, w, 3).real
        for n, p in zip(
            (*phases, *field), (*predicted, *before(t, slow, w, harmonics=(0, 2))), strict=True
        ):
            off = np.abs(a[n] - p) > SMOOTH_LIMIT * self.sensors.sigma(n, 0.0)
            out[f"{n}_smooth"] = p = np.where(off, a[n], p)
            if n in VOLTAGES:
                rest = a[n] - p
                rest = (rest + np.append(rest[1:], 0.0)) * (share if n in PHASES_V else 0.5)
                # what the ends are short of their readings, the middle is, too: it cancels
                out[f"{n}_mid_smooth"] = given[f"{n}_mid"] - rest
                out[f"{n}_next_smooth"] = np.append(p[1:], a[n][-1])
        v, i = (2 / 3 * (TURN @ of) for of in (turning[:3], turning[3:]))
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
        holds the correlations (h by ``H_SIGMA``), about a severity beyond ``H_STRAIGHT`` that the
        unbalance shows.  A leaky fault has been there for long: its
        current is that of the phase's voltage phasor.  Unbalance and transients are what
        ``START_SIGMA`` stands for.  The period's samples are used again by the filter; beside their
        information that of the start is nothing.

        Args:
            samples: as for :meth:`recording`.
            period: length of the piece looked at, s; default one electrical period.
            sigma: other standard deviations, by state.

        Raises:
            DataError: fewer than eight samples in the period, or no voltage.
        """
        first = _FirstPeriod.of(self.machine, samples, period)
        found = dict(zip(SHUNTS.names, first.severity(self.machine), strict=True))
        found = {n: v if n in self.model.x else 0.0 for n, v in found.items()}
        h = np.array([*found.values()])
        at = self._start(first, h=h)
        means = dict.fromkeys(self.model.x.names, 0.0) | at
        means |= {n: v for n, v in found.items() if n in means}
        means |= {n: LEAKY_START for n in ADMITTANCE.names if n in means}
        spread = dict.fromkeys((*SHUNTS.names, *ADMITTANCE.names), H_SIGMA) | START_SIGMA
        spread |= {"energy": 0.0, "i_shunt": START_SIGMA_SHUNT}
        spread |= {f"gain_{n}": self.sensors[n].gain for n in GAIN_SENSORS}
        spread[DELAY.name] = DELAY_SIGMA
        own = self.machine.held("machine")
        means |= {n: v for n, v in own.items() if n in means}
        spread |= {n: FREE_SIGMA * abs(v) for n, v in own.items()}
        spread = {n: spread[n] for n in means}
        for n, value in (sigma or {}).items():
            self.model.x.index(n)
            spread[n] = value
        prior = Belief.of(self.model.x, means, spread)
        if set(SHUNTS.names) <= set(means) and not set(SHUNTS.names) & set(sigma or {}):
            # that all three are faulty looks like another rotor angle
            rows = np.ix_(*[self.model.x.indices(SHUNTS.names)] * 2)
            common = H_BALANCED_CONSIDERED if self.gains == "consider" else H_BALANCED
            prior.cov[rows] -= (H_SIGMA**2 - common**2) / 3
        e = 1e-6
        # of a parameter the same share of it
        size = dict.fromkeys(means, 1.0) | {n: abs(v) for n, v in own.items() if n in means}
        moved = {
            n: self._start(first, h=h + e * one)
            for n, one in zip(SHUNTS.names, np.eye(3), strict=True)
        }
        moved |= {"g_shunt": self._start(first, Y=Y_START + e)}
        moved |= {"b_shunt": self._start(first, Y=Y_START - 1j * e)}
        moved |= {f"gain_{n}": self._start(first, {n: -e}, h=h) for n in GAIN_SENSORS}
        moved[DELAY.name] = self._start(first, h=h, delay=e * DELAY.nominal)
        size[DELAY.name] = DELAY.nominal
        for n in own.keys() & means.keys():
            more = self.machine.symbolic(**{n.partition(".")[2]: own[n] + e * size[n]})
            moved[n] = dataclasses.replace(self, machine=more)._start(first, h=h)
        turned = np.eye(len(self.model.x))
        for name, there in moved.items():
            if name in self.model.x.names:
                for n in at:
                    change = there[n] - at[n]
                    change = math.remainder(change, 2 * math.pi) if n == "theta_e" else change
                    slope = change / (e * size[name])
                    turned[self.model.x.index(n), self.model.x.index(name)] += slope
        return Belief(self.model.x, prior.mean, turned @ prior.cov @ turned.T)

    def _start(
        self,
        first: _FirstPeriod,
        share: Mapping[str, float] | None = None,
        *,
        h: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0),
        Y: complex = Y_START,
        delay: float = 0.0,
    ) -> dict[str, float]:
        """Return the start with some readings taken for more by a share, a fault, late currents."""
        p, turn = self.machine, TURN
        by = [1 + (share or {}).get(n, 0.0) for n in (*PHASES_V, *PHASES_I, "i_fd")]
        V, late = first.v * by[:3], first.i * by[3:6] * np.exp(1j * first.w * delay)
        v, i = (complex(x @ turn) / 3 for x in (V, late))
        i_0 = float((first.i * by[3:6]).sum().real) / 3
        i += sum(h) * v / (3 * p.r_s)
        i_shunt = 0.0
        if self.kappa is not None:
            k = PHASES.index(str(self.phase))
            drawn = -Y / p.r_s * first.v[k] * by[k]
            i_shunt = float(drawn.real)
            i -= drawn * turn[k] / 3
            i_0 -= i_shunt / 3
        at = balanced_state(p, v=v, i=i, w_r=first.w, i_fd=first.i_fd * by[6], i_0=i_0)
        # what turns backwards: d lambda/dt = v + r_s i of the windings
        back = (V + p.r_s * late + np.array(h) * V) @ turn.conj() / 3 / (1j * first.w) * turn
        more = abc_to_qd0(at["theta_e"], Abc(*back.real))
        at["lam_sq"] += float(more.q)
        at["lam_sd"] += float(more.d)
        return at if self.kappa is None else at | {"i_shunt": i_shunt}


@dataclass(frozen=True, eq=False)
class _FirstPeriod:
    """Phasors of the first electrical period: speed, voltages, currents, mean field current."""

    w: float
    v: np.ndarray
    i: np.ndarray
    i_fd: float

    @classmethod
    def of(
        cls, machine: MachineParameters, samples: Mapping[str, Any], period: float | None
    ) -> _FirstPeriod:
        names = ("t", "w_r", *VOLTAGES, *MEASURED)
        a = {n: plain_numbers(samples[n], n, gaps=True) for n in names}
        a = usable(a, ("w_r", *VOLTAGES))
        start_at = a["t"][0]  # where the recording starts, complete or not
        good = np.isfinite(a["w_r"])
        a = {n: v[good] for n, v in a.items()}
        w = float(np.median(a["w_r"][: max(1, a["t"].size // 50)]))
        T = 2 * math.pi / abs(w) if period is None else period
        first = a["t"] < start_at + T * (1 - 1e-6)
        a = {n: v[first] for n, v in a.items()}
        least = min(names, key=lambda n: np.isfinite(a[n]).sum())
        if (count := int(np.isfinite(a[least]).sum())) < 8:
            raise DataError(f"the first {T:.3g} s hold {count} samples of {least}; 8 are needed")
        tau = a["t"] - start_at
        basis = np.column_stack([np.cos(w * tau), -np.sin(w * tau), np.ones_like(tau)])

        def phasors(names: Sequence[str]) -> np.ndarray:
            c = fitted(basis, np.column_stack([a[n] for n in names]))
            return np.asarray(c[0] + 1j * c[1])

        v, i = phasors(PHASES_V), phasors(PHASES_I)
        size = abs(complex(v @ TURN) / 3)
        if size < 0.05 * machine.V_rated_rms:
            raise DataError(f"no voltage to start from: positive sequence {size:.3g} V")
        return cls(w, v, i, float(np.nanmean(a["i_fd"])))

    def severity(self, p: MachineParameters) -> tuple[float, float, float]:
        """Severity of the phase whose short circuit explains the unbalance best; 0 of a small one.

        A machine without one has i_0 = -v_0/(r_s + j w L_ls), and what turns backwards meets the
        mean of both subtransient inductances; a short circuit takes h v_k/r_s beside that.
        """
        subtransient = sum(
            p.L_ls + 1 / (1 / L_m + sum(1 / L for L in leak)) for L_m, leak in
            ((p.L_md, (p.L_lfd, p.L_lkd)), (p.L_mq, (p.L_lkq,)))
        ) / 2  # fmt: skip
        turns = np.array([np.ones(3), TURN.conj()]) / 3
        z = p.r_s + 1j * self.w * np.array([p.L_ls, subtransient])
        lost = -(turns @ self.i + turns @ self.v / z)
        drawn = turns * self.v / p.r_s  # of each phase by h = 1, (2, 3)
        h = (drawn.conj() * lost[:, None]).sum(0).real / (np.abs(drawn) ** 2).sum(0)
        left = (np.abs(lost[:, None] - h * drawn) ** 2).sum(0)
        k = int(left.argmin())
        out = np.zeros(3)
        out[k] = h[k] if h[k] > H_STRAIGHT else 0.0
        return float(out[0]), float(out[1]), float(out[2])


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


def jump_floor(sensors: SensorSet) -> float:
    """Return what may be noise of a jump of the voltage, V.

    ``JUMP`` is made for the sensors' noise; what is white beside it, jitter and digits, adds.
    """
    return max(JUMP, *(10 * sensors[n].rest for n in PHASES_V))


def window_starts(t: np.ndarray, window: float, start: float | None) -> np.ndarray:
    """Return the indices of the first instants of the windows."""
    if not window > 0:
        raise DataError(f"window = {window!r} s must be > 0")
    k = np.floor((t - (t[0] if start is None else start) + SAME_TIME) / window)
    return np.flatnonzero(np.diff(k, prepend=-np.inf))


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
    free: Mapping[str, Unknown] | None = None,
) -> ElectricalFilter:
    """Make the electrical filter.

    Args:
        machine: parameters; default Table 1.
        sensors: 1-sigma table.
        h_walk, flux_walk: random walks of h (1/sqrt(s); default ``H_WALK``, with gains
            ``H_WALK_GAINS``; of a leaky fault's admittance ``LEAKY_WALK``) and of the fluxes
            (Wb/sqrt(s)).
        gains: ``"estimate"`` or ``"consider"`` the eight constant gain errors, or ``"none"``.
            Estimated, they make h drift by a standard deviation in a second (the angle's error is
            in the derivatives and in the innovations alike) and suit recordings of that length; a
            second pass, :func:`estimators.batch.relinearised.relinearised_filter`, halves that, and
            errors are then what is claimed. From a reset on :func:`~.tracking.track` considers
            them. Considered, nothing drifts, and the NIS, which then holds constant offsets, is no
            test; the angle then walks by ``ANGLE_WALK_CONSIDERED``.
        power: add the state ``energy``, for :func:`~.tracking.window_power`.
        phases: phases with an h; none of them makes the healthy machine's filter.
        kappa: leakage partition; None is full coupling (kappa = mu).  With a number the states are
            i_shunt, g_shunt and b_shunt of one ``phase`` instead of three h;
            :func:`~.faults.leaky_fault` gives mu and k_rf.
        phase: the faulty phase, with ``kappa`` only.
        free: parameters of the machine that are states, by name (``machine.r_s``); their prior
            means are those of ``machine``, their standard deviations ``FREE_SIGMA`` of them. With
            gains also ``delay_i``, by which currents are read later than voltages
            (``DELAY_SIGMA``).

    Raises:
        ParameterError: unknown choice, kappa without phase or the other way round.
        SignalError: unknown parameter in ``free``.
    """
    machine = MachineParameters() if machine is None else machine
    require_linear(machine, "the electrical filter")
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
    unknowns = tuple((free or {}).items())
    return _filter(
        machine, sensors, h_walk, flux_walk, gains, power, phases, kappa, phase, unknowns
    )


def considering(filt: ElectricalFilter) -> ElectricalFilter:
    """Return a filter of the same states that considers the gains instead of estimating them."""
    m = filt.model
    free = {n: Unknown(consider=n in m.consider) for n in m.x.names if n in MACHINE.names}
    if DELAY.name in m.x.names:
        free[DELAY.name] = Unknown(consider=DELAY.name in m.consider)
    phases = tuple(k for k in PHASES if f"h_{k}" in m.x.names)
    how: dict[str, Any] = {"sensors": filt.sensors, "power": filt.power, "phases": phases}
    return electrical_filter(filt.machine, gains="consider", free=free, **how)


@remade
@of_family
def _estimating(
    model: FilterModel, unknown: Mapping[str, Unknown], walks: Mapping[str, float], alone: float
) -> FilterModel:
    """Return the model with what is estimated as states; ``alone``: see :func:`_one_phase`."""
    made = augment(model, unknown).with_walk(walks)
    return (_one_phase(made, alone) if alone else made).expanded()


def _one_phase(model: FilterModel, time: float) -> FilterModel:
    """Let what the three severities have in common go to that of one faulty phase, in ``time`` s.

    Of a short circuit in phase k the mean of the three is h_k/3, and h_k is more than the mean by
    twice that; of a healthy machine both are zero.
    """
    x, u, p, w, dt = model.symbols()
    x1, check = model.transition(x, u, p, w, dt)
    rows = model.x.indices(SHUNTS.names)
    h = [x[i] for i in rows]
    mean = sum(h) / 3
    lacking = (ca.fmax(ca.fmax(h[0], h[1]), h[2]) - mean) / 2 - mean
    x1[rows] += (1 - ca.exp(-dt / time)) * lacking
    signals, symbols = (model.x, model.u, model.p, model.w, model.y), (x, u, p, w, dt)
    out = model.output(x, u, p, w)
    return FilterModel.of(f"{model.name}_one", signals, symbols, (x1, check), out, like=model)


@last(32)
def _filter(
    machine: MachineParameters,
    sensors: SensorSet,
    h_walk: float | None,
    flux_walk: float,
    gains: str,
    power: bool,
    phases: tuple[str, ...],
    kappa: float | None,
    phase: str | None,
    free: tuple[tuple[str, Unknown], ...],
) -> ElectricalFilter:
    """Make the filter of checked choices."""
    model = electrical_model(machine, sensors, power, kappa, phase, gains != "none")
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
    alone = 0.0
    if gains == "consider":
        walks["theta_e"] = ANGLE_WALK_CONSIDERED
        alone = H_COMMON_TIME if phases == PHASES else 0.0
    if gains != "none":
        unknown |= {f"gain_{n}": Unknown(consider=gains == "consider") for n in GAIN_SENSORS}
    model = _estimating(model, unknown | dict(free), walks, alone)
    return ElectricalFilter(model, machine, sensors, gains, kappa, phase, power)
