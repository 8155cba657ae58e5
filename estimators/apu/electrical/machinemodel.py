"""The discrete model of the electrical filter.

How the errors of the measured voltages enter.  With v(k) and v(k+1) measured, the fluxes at k+1
hold about dt/2 of the error e(k+1), and the step to k+2 holds the rest.  The filter's state is
s(k) = x(k) + G e(k), the state as if the last voltage were true; then

    x(k) = s(k) - G e(k),        s(k+1) = step(x(k), vm(k) - e(k), vm(k+1)),

and e(k) enters the output at k and the transition from k to k+1, once each: exactly the shared
noise of :class:`~estimators.models.filtermodel.FilterModel`.  0.5 V over 100 us is 1.4 A in the
subtransient inductance, as much as the noise of the current sensors.  G is that of the step with
its resistances (:func:`held`): without them, above all without the half per cent that they bring
into the d damper, the variance claimed of one combination of field, damper and h would be 6 %
short.

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
all currents are nearly linear, and told as mu and k_rf at the end
(:func:`~estimators.apu.electrical.faults.leaky_fault`).  Its current decays within 80 us to
2 ms, so it has an exact step of its own.

A voltage that jumps between two samples (a load switched) leaves its instant and its overshoot
unknown.  The voltage in the step's middle is then uncertain by the size of the jump; fluxes are
found again within a few samples, and h keeps what it knew.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import casadi as ca

from apu_casadi.core.parameters import of_symbols
from apu_casadi.core.sharing import last, remade
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.machine.generatormodel import ANGLE
from apu_casadi.machine.machinedata import MACHINE, MachineParameters
from apu_casadi.machine.park import PHASE_ANGLE, PHASES, Abc, Qd0, abc_to_qd0, qd0_to_abc
from apu_casadi.machine.terminals import (
    FLUXES,
    INPUTS,
    OUTPUTS,
    SHUNTS,
    Terminals,
    advance,
    middle_weight,
    shunt_currents,
    terminal_equations,
    voltage_weight,
)
from apu_casadi.machine.wrsg import Windings, currents, flux_rates
from estimators.apu.electrical.terminalsignals import (
    ADMITTANCE,
    DELAY,
    DT_LAST,
    ENERGY,
    GAIN_SENSORS,
    I_SHUNT,
    JUMP_SIZES,
    KEEP,
    LATER,
    MEASURED,
    PHASES_V,
    PREDICTED,
    VOLTAGES,
)
from estimators.apu.electrical.tuning import JUMP_SHARE
from estimators.apu.sensors import SensorSet
from estimators.models.filtermodel import FilterModel

__all__ = ["electrical_model", "held", "leaky_pair"]


def held(p: MachineParameters, *, w_r: Any, dt: Any, v: Qd0, V_fd: Any) -> Windings:
    """Return what the fluxes at the end of a step hold of the voltages there, Wb: G of the module.

    The derivative of :func:`~apu_casadi.machine.terminals.advance`: the voltages over about dt/2,
    less what the resistances take back of it (a third of the step later on average), which also
    brings some of it into the dampers.  Terms of the third order in dt are left out: 1e-3 of it.

    Args:
        p: machine parameters.
        w_r: electrical speed, rad/s.
        dt: the step before, s.
        v, V_fd: voltages at its end on the rotor's axes there, field voltage, V.
    """
    weight = voltage_weight(w_r, dt)
    first = Windings(weight * v.q, weight * v.d, weight * v.zero, dt / 2 * V_fd, 0.0, 0.0)
    none = Qd0(0.0, 0.0, 0.0)
    back = flux_rates(
        p, lam=first, i=currents(p, first), v=none, V_fd=0.0, w_r=0.0, w1=none, w2=(0.0, 0.0, 0.0)
    )
    return Windings(*(a + dt / 3 * b for a, b in zip(first, back, strict=True)))


def leaky_pair(p: MachineParameters, kappa: float, g: Any, b: Any) -> tuple[Any, Any]:
    """Return mu and k_rf whose branch has the admittance (g - j b)/r_s at rated frequency.

    :func:`~apu_casadi.machine.terminals.shunt_parameters` with R = r_s g/(g^2 + b^2) and
    w L = r_s b/(g^2 + b^2), without its checks: for symbols and for complex steps.

    Args:
        p: machine parameters.
        kappa: leakage partition.
        g, b: conductance and inductive susceptance of the branch, times r_s.
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


def _signals(
    power: bool, leaky: bool, with_gains: bool
) -> tuple[Signals, Signals, Signals, Signals]:
    """States, inputs, parameters and noises of the model."""
    X = [*FLUXES, ANGLE, *([I_SHUNT] if leaky else []), *([ENERGY] if power else [])]
    U = [*INPUTS, *LATER, *JUMP_SIZES, DT_LAST, *([KEEP] if power else [])]
    what = "relative gain error of the sensor of {}"
    gain = [Signal(f"gain_{n}", "1", what.format(n), 0.0, 0.01) for n in GAIN_SENSORS if with_gains]
    what = "error of the measured {} over its standard deviation"
    W = [Signal(f"w_{n}", "1", what.format(n)) for n in (*VOLTAGES, "w_r")]
    what = "unknown course of a jump of the voltage, {} axis"
    W += [Signal(f"w_jump_{n}", "1", what.format(n)) for n in "qd0"]
    par = [*(ADMITTANCE if leaky else SHUNTS), *gain, *([DELAY] if with_gains else [])]
    return (Signals(X), Signals([*U, *(PREDICTED if with_gains else ())]), Signals(par), Signals(W))


class _Readings(NamedTuple):
    """Voltages and speed as the readings tell them.

    Args:
        start, middle, end: what the terminals see in a step.
        predicted: voltages that the state holds at the sample.
        added, added_qd0: what is added to the state for the reading at this sample: minus its
            error, and, where the state holds a prediction in its place, what the reading is more
            than that; on the rotor's axes by the reference angle.
        reference: the angle of which the errors know nothing.
        factor: true over reading, by sensor; with gains only.
    """

    start: Terminals
    middle: Terminals
    end: Terminals
    predicted: Terminals
    added: dict[str, Any]
    added_qd0: Qd0
    reference: Any
    factor: dict[str, Any]


def _readings(
    sensors: SensorSet,
    theta_e: Any,
    u: Mapping[str, Any],
    par: Mapping[str, Any],
    w: Mapping[str, Any],
    dt: Any,
    with_gains: bool,
) -> _Readings:
    """Measured -> true: reading = (1 + gain) v + error; the next sample's error is that state's."""
    rate_noise = sensors["w_r"].noise * (u["w_r"] if sensors["w_r"].relative else 1.0)
    w_r = u["w_r"] - rate_noise * w["w_w_r"]
    error = {n: sensors.sigma(n, 0.0) * w[f"w_{n}"] for n in VOLTAGES}
    added = {n: -error[n] for n in VOLTAGES}
    factor = {}
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
        reference = theta_e
    added_qd0 = abc_to_qd0(reference, Abc(*(added[n] for n in PHASES_V)))
    for n, a in zip(PHASES_V, qd0_to_abc(theta_e, added_qd0), strict=True):
        added[n] = a if with_gains else added[n]

    def seen(v: Mapping[str, Any], share: Mapping[str, Any]) -> Terminals:
        phases = Abc(*(v[n] + share[n] * added[n] for n in PHASES_V))
        return Terminals(w_r, phases, v["V_fd"] + share["V_fd"] * added["V_fd"])

    amid = dict.fromkeys(VOLTAGES, middle_weight(u["w_r"], dt)) | {"V_fd": 0.5}
    start, end = seen(now, dict.fromkeys(VOLTAGES, 1.0)), seen(then, dict.fromkeys(VOLTAGES, 0.0))
    predicted = Terminals(w_r, Abc(*(now[n] for n in PHASES_V)), now["V_fd"])
    middle = seen(mid, amid)
    # in the middle, so that currents and rotor follow it; 2/3 of the middle counts in the integral
    sizes = zip("qd0", (u["jump_qd"], u["jump_qd"], u["jump_0"]), strict=True)
    jump = Qd0(*(1.5 * JUMP_SHARE * size * w[f"w_jump_{n}"] for n, size in sizes))
    jump_abc = qd0_to_abc(theta_e, jump)
    middle = middle._replace(v=Abc(*(a + b for a, b in zip(middle.v, jump_abc, strict=True))))
    return _Readings(start, middle, end, predicted, added, added_qd0, reference, factor)


class _Branch:
    """The branch of a leaky fault, L di/dt = -v - R i, with an exact step of its own."""

    def __init__(
        self, p: MachineParameters, kappa: float, phase: str, par: Mapping[str, Any]
    ) -> None:
        g, b = par["g_shunt"], par["b_shunt"]
        self.mu, k_rf = leaky_pair(p, kappa, g, b)
        angle = PHASE_ANGLE[phase]
        self.fault = {"mu": self.mu, "k_rf": k_rf, "kappa": kappa, "phase_angle": angle}
        self.phase = phase
        self.decay_rate = p.w_rated * g / b  # R/L
        self.per_volt = p.w_rated * (g**2 + b**2) / b / p.r_s  # 1/L

    def corrected(self, i: Any, u: Mapping[str, Any], added: Mapping[str, Any]) -> Any:
        """Its current with what the reading at this sample adds."""
        _, _, mid, last = _exponential(-self.decay_rate * u["dt_last"])
        last += mid * middle_weight(u["w_r"], u["dt_last"])
        return i - u["dt_last"] * self.per_volt * last * added[f"v_{self.phase}"]

    def step(self, i: Any, seen: _Readings, dt: Any) -> Any:
        """Its current at the next sample."""
        decay, *weights = _exponential(-self.decay_rate * dt)
        k = PHASES.index(self.phase)
        course = seen.start, seen.middle, seen.end
        driven = sum(c * there.v[k] for c, there in zip(weights, course, strict=True))
        return decay * i - dt * self.per_volt * driven


def _slopes(p: MachineParameters, x: Mapping[str, Any], at: Terminals, h: Mapping[str, Any]) -> Abc:
    """Rates of the terminal currents, A/s, of sinusoids that turn with the rotor."""

    def turned(v: Qd0) -> Abc:
        return qd0_to_abc(x["theta_e"], Qd0(v.d, -v.q, 0.0))

    i = turned(currents(p, Windings(*(x[n] for n in FLUXES.names))).stator)
    v = turned(abc_to_qd0(x["theta_e"], at.v))
    own = shunt_currents(p, ibar=i, v=v, h=Abc(*(h[n] for n in SHUNTS.names)))
    return Abc(*(at.w_r * k for k in own))


@remade
def electrical_model(
    p: MachineParameters,
    sensors: SensorSet,
    power: bool,
    kappa: float | None,
    phase: str | None,
    with_gains: bool,
) -> FilterModel:
    """Make the discrete model; h or the admittance, and the gains, are parameters of it.

    It is one of a family, of which the machine's parameters are known parameters as well.

    Args:
        p: machine parameters.
        sensors: 1-sigma table; of it the noise of voltages, field voltage and speed.
        power: whether the energy since a window's start is a state.
        kappa, phase: leakage partition and faulty phase of a leaky fault, or None and None.
        with_gains: whether the model has gain errors, and predictions of the readings as inputs.
    """
    return _family(sensors, power, kappa, phase, with_gains).member(p.held("machine"))


@last(32)
def _family(
    sensors: SensorSet, power: bool, kappa: float | None, phase: str | None, with_gains: bool
) -> FilterModel:
    """Write the model of all machines."""
    X, U, PAR, W = _signals(power, kappa is not None, with_gains)
    (xv, x), (uv, u), (pv, par), (wv, w) = X.sx(), U.sx(), PAR.sx(), W.sx()
    dt, numbers = ca.SX.sym("dt"), ca.SX.sym("machine", len(MACHINE))
    p, pv = of_symbols(MachineParameters, numbers), ca.vertcat(pv, numbers)
    seen = _readings(sensors, x["theta_e"], u, par, w, dt, with_gains)
    # x(k) = s(k) + G (reading - error - what s(k) holds of it)
    added = seen.added
    more = held(p, w_r=u["w_r"], dt=u["dt_last"], v=seen.added_qd0, V_fd=added["V_fd"])
    at = dict(x)
    for n, e in zip(FLUXES.names, more, strict=True):
        at[n] = x[n] + e
    branch = None if kappa is None else _Branch(p, kappa, str(phase), par)
    if branch is not None:
        at["i_shunt"] = branch.corrected(x["i_shunt"], u, added)
    fault = {n: par[n] for n in SHUNTS.names} if branch is None else branch.fault

    def equations(s: Any, there: Terminals) -> tuple[dict[str, Any], dict[str, Any]]:
        d = X.unpack(s)
        lam = Windings(*(d[n] for n in FLUXES.names))
        i_fault = None if branch is None else d["i_shunt"] / branch.mu
        return terminal_equations(
            p, lam=lam, theta_e=d["theta_e"], at=there, fault=fault, i_fault=i_fault
        )

    def rate(s: Any, there: Terminals) -> Any:
        # a leaky fault's current follows the voltages alone, and has a step of its own
        rates = dict.fromkeys(X.names, 0.0) | equations(s, there)[0]
        return X.stack({n: rates[n] for n in X.names})

    s0 = X.stack(at)
    x1 = advance(rate, s0, seen.start, seen.middle, seen.end, dt)
    if branch is not None:
        x1[X.index("i_shunt")] = branch.step(at["i_shunt"], seen, dt)
    y = equations(s0, seen.start)[1]
    read = [y[n] for n in MEASURED]
    if with_gains:
        # what the state predicts, and apart from it what the reading adds, by the reference angle
        first = equations(xv, seen.predicted)[1]
        i_more = currents(p, more)
        extra = [*qd0_to_abc(seen.reference, i_more.stator), i_more.fd]
        slope = _slopes(p, X.unpack(xv), seen.predicted, fault)
        late = [*(par["delay_i"] * s for s in slope), 0.0]
        read = [
            first[n] + e + (1.0 - seen.factor[n]) * u[f"{n}_smooth"] - back
            for n, e, back in zip(MEASURED, extra, late, strict=True)
        ]
    if power:
        # by the trapezoidal rule: with a fault power swings by all of its loss in half a cycle, and
        # a window of another speed than the rated one holds no whole number of cycles
        mean = (y["P_total"] + equations(x1, seen.end)[1]["P_total"]) / 2
        x1[X.index("energy")] = u["keep"] * x["energy"] + dt * mean
    name = f"electrical_{'shunts' if branch is None else 'leaky'}"
    name += ("_power" if power else "") + ("_gains" if with_gains else "")
    signals = X, U, PAR + MACHINE, W, Signals([OUTPUTS[k] for k in MEASURED])
    step, output = (x1, ca.SX(0)), (ca.vertcat(*read), ca.SX(0))
    return FilterModel.of(name, signals, (xv, uv, pv, wv, dt), step, output, cse=True)
