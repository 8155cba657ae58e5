"""The starter/generator seen from its terminals: voltages in, currents out, no load, no exciter.

With the terminal voltages, the field voltage and the speed as inputs, the machine's equations (5),
(6), (7) stand alone; no load or exciter model is needed.  What a turn-to-turn short circuit then
is depends on the leakage partition kappa (see :mod:`.machine.ttsc`):

* kappa = mu, the paper's model: in the effective current ibar = i - T(:,k) mu i_fault the flux
  equations do not hold the fault at all, and

      i_k = ibar_k(lambda) - h_k v_k / r_s,        h = mu / (k_rf + 1 - mu).

  The fault is a shunt conductance h/r_s from terminal k to the machine's neutral.  With one h for
  each phase, the model is linear in (fluxes, h) once the rotor angle is known, and the faulty phase
  is what the three numbers say.
* kappa > mu: i_fault is a state of the faulty phase; the shunt is R = r_s/h with
  L = (kappa - mu) L_ls/mu in series.

Between two samples of the voltages :func:`midpoints` gives the value in the middle, phase by phase:
exactly for sinusoids of the speed's frequency, and for the odd harmonics that saliency makes of an
unbalance.  At 25 samples a period, linear interpolation would err by 0.5 % of the voltage, three
times the noise of the sensors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.core.parameters import of_symbols
from apu_casadi.core.sharing import kept, once
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.core.statespace import StateSpace
from apu_casadi.machine import wrsg
from apu_casadi.machine.faults import ttsc
from apu_casadi.machine.generatormodel import ANGLE, DRIVES
from apu_casadi.machine.generatormodel import FLUXES as _ALL_FLUXES
from apu_casadi.machine.generatormodel import OUTPUTS as GENERATOR
from apu_casadi.machine.machinedata import MACHINE, MachineParameters, require_linear
from apu_casadi.machine.park import (
    PHASE_ANGLE,
    Abc,
    Qd0,
    abc_to_qd0,
    phase_selector,
    qd0_to_abc,
)
from apu_casadi.machine.wrsg import Windings

FAULTS = ("shunts", "leaky")
#: Of the voltages, beside the fundamental: what saliency and an unbalance make together.
HARMONICS = (3, 5)

#: Those of the generator; the zero sequence is small where the terminals are given.
FLUXES = Signals([replace(s, nominal=0.01) if s.name == "lam_s0" else s for s in _ALL_FLUXES])
I_FAULT = GENERATOR["i_fault"]
INPUTS = Signals([DRIVES[0], *(GENERATOR[n] for n in ("v_a", "v_b", "v_c", "V_fd"))])
#: Of the variant ``"shunts"``: one severity for each phase, zero where there is no fault.
SHUNTS = Signals(
    [
        Signal(
            f"h_{k}", "1", f"severity mu/(k_rf + 1 - mu) of phase {k}", default=0.0, nominal=1e-3
        )
        for k in "abc"
    ]
)
#: Of the variant ``"leaky"``, in the order of the generator's variant of that name.
LEAKY = Signals(ttsc.Ttsc.examples()["leaky"].own("leaky", "grounded").theta)
OUTPUTS = Signals(
    [
        GENERATOR[n]
        for n in [
            "i_a",
            "i_b",
            "i_c",
            "i_fd",
            "i_kd",
            "i_kq",
            "T_e",
            "P_e",
            "P_loss_fault",
            "P_total",
        ]
    ]
)


class Terminals(NamedTuple):
    """What drives the machine at an instant: speed (rad/s), phase and field voltages (V)."""

    w_r: Any
    v: Abc
    V_fd: Any


def shunt_currents(p: MachineParameters, *, ibar: Abc, v: Abc, h: Abc) -> Abc:
    """Return terminal currents, A, i_k = ibar_k - h_k v_k / r_s; exact for kappa = mu."""
    return Abc(*(i - hk * vk / p.r_s for i, vk, hk in zip(ibar, v, h, strict=True)))


def shunt_loss(p: MachineParameters, *, ibar: Abc, v: Abc, h: Abc) -> Any:
    """Return the extra loss of the faults in (8), W: all of it is h's, for kappa = mu.

    With i_fault = -h v_k / (mu r_s), (8) becomes h (1 - h) v_k^2 / r_s + 2 h v_k ibar_k.
    """
    terms = zip(ibar, v, h, strict=True)
    return sum(hk * (1.0 - hk) * vk**2 / p.r_s + 2.0 * hk * vk * i for i, vk, hk in terms)


def shunt_parameters(p: MachineParameters, *, R: float, L: float, kappa: float) -> dict[str, float]:
    """Return mu and k_rf of the fault whose outside is a shunt R (ohm) and L (H), for a kappa.

    L = (kappa - mu) L_ls/mu and R = r_s (k_rf + 1 - mu)/mu, solved.  For each kappa there is one
    pair: without kappa the terminals tell R and L, not mu and k_rf.

    Raises:
        ParameterError: L = 0, where mu = kappa fits any k_rf, or R, L negative.
    """
    if not (R > 0 and L > 0):
        raise ParameterError(
            f"a shunt with R = {R:g} ohm and L = {L:g} H has no mu and k_rf of its own; "
            "R > 0 and L > 0 are needed (L = 0 is full coupling, which tells h alone)"
        )
    mu = kappa * p.L_ls / (L + p.L_ls)
    return {"mu": mu, "k_rf": mu * R / p.r_s - 1.0 + mu}


def fault_rate(
    p: MachineParameters, *, mu: Any, k_rf: Any, kappa: Any, v_k: Any, i_fault: Any
) -> Any:
    """Return d(i_fault)/dt, A/s, of the faulty phase with winding voltage v_k; kappa > mu."""
    rest = ttsc.loop_residual(
        p, mu=mu, k_rf=k_rf, kappa=kappa, v_k=v_k, i_fault=i_fault, di_fault=0.0
    )
    return -rest / ((kappa - mu) * p.L_ls)


def terminal_rates(p: MachineParameters, lam: Windings, theta_e: Any, at: Terminals) -> Windings:
    """Return d lambda/dt, V, (5) and (6) with the terminals given; the fault is not in it."""
    none = Qd0(0.0, 0.0, 0.0)
    return wrsg.flux_rates(
        p,
        lam=lam,
        i=wrsg.currents(p, lam),
        v=abc_to_qd0(theta_e, at.v),
        V_fd=at.V_fd,
        w_r=at.w_r,
        w1=none,
        w2=(0.0, 0.0, 0.0),
    )


def advance(
    rate: Callable[[Any, Terminals], Any],
    x: Any,
    start: Terminals,
    middle: Terminals,
    end: Terminals,
    dt: Any,
) -> Any:
    """Return x after dt (s) by the classical Runge-Kutta method, between two samples.

    Args:
        rate: (x, terminals) -> dx/dt; the angle is in x.
        x: CasADi vector.
        start, middle, end: terminals at 0, dt/2 (see :func:`midpoints`) and dt.
    """
    k1 = rate(x, start)
    k2 = rate(x + dt / 2 * k1, middle)
    k3 = rate(x + dt / 2 * k2, middle)
    k4 = rate(x + dt * k3, end)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def middle_weight(w_r: Any, dt: Any) -> Any:
    """Return the weight of either neighbour in a voltage midway: exact for frequency w_r."""
    return 0.5 / (np.cos(w_r * dt / 2) if isinstance(w_r, np.ndarray) else ca.cos(w_r * dt / 2))


def jumps(
    t: np.ndarray, v: np.ndarray, w_r: np.ndarray, *, floor: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much the voltages jump within each step, V, as from the switching of a load.

    D(k) = v(k-1) - 2 cos(w_r dt) v(k) + v(k+1) vanishes for everything of frequency w_r, whatever
    its sequences; a jump between k and k+1 is in D(k) and in D(k+1).  The smaller of the two counts
    as a jump where it exceeds ``floor`` and twice its ninth decile over the period before, which is
    what harmonics make of it.

    Args:
        t: instants, s, shape (K,). v : phase voltages, shape (3, K). w_r : speed, rad/s, shape
            (K,).
        floor: what may be noise, V.

    Returns:
        Jumps of the space vector and of the zero sequence from each sample to the next, shapes
        (K,), 0 where there is none.
    """
    K = t.size
    if K < 4:
        return np.zeros(K), np.zeros(K)
    turn = np.exp(1j * np.array(list(PHASE_ANGLE.values())))
    a = w_r[1:-1] * np.diff(t)[1:]
    period = max(4, round(2 * math.pi / max(float(np.median(np.abs(a))), 0.05)))
    found = []
    for x in (2.0 / 3.0 * (turn @ v), v.mean(axis=0)):
        D = np.abs(x[:-2] - 2 * np.cos(a) * x[1:-1] + x[2:])
        size = np.concatenate([D[:1], np.minimum(D[:-1], D[1:]), D[-1:], [0.0]])
        k = np.flatnonzero(size > floor)
        early, late = k[k < period], k[k >= period]
        usual = np.zeros(K)
        for j in early:  # too few samples before: what there is, or the period after
            before = size[:j] if j >= 4 else size[j + 1 : j + 1 + period]
            usual[j] = np.quantile(before, 0.9)
        if late.size:
            windows = np.lib.stride_tricks.sliding_window_view(size, period)
            usual[late] = np.quantile(windows[late - period], 0.9, axis=1)
        found.append(np.where((size > floor) & (size > 2 * usual), size, 0.0))
    return found[0], found[1]


def midpoints(
    t: np.ndarray,
    v: np.ndarray,
    w_r: np.ndarray,
    *,
    jumped: np.ndarray | None = None,
    periods: float = 2.0,
) -> np.ndarray:
    """Return the voltages midway between each sample and the next.

    (v(0) + v(dt)) / (2 cos(w_r dt/2)) is exact for any sinusoid of frequency w_r, so for positive,
    negative and zero sequence.  What the ``HARMONICS`` lack is added, from

        D(k) = v(k-1) + v(k+2) + (1 - 2 cos(w_r dt)) (v(k) + v(k+1)),

    which vanishes for the frequency w_r: its components of their frequencies over the last
    ``periods``, not D itself, which would bring the errors of four samples into each step.

    Args:
        t: instants, s, shape (K,).
        v: phase voltages, shape (n, K).
        w_r: frequency, rad/s, shape (K,).
        jumped: whether the voltage jumps between a sample and the next, shape (K,); such steps and
            their neighbours do not count in the harmonic.
        periods: length of the average, electrical periods; 0 leaves the harmonic out.

    Returns:
        Shape (n, K); the last column repeats the last sample.
    """
    K = t.size
    out = v.astype(float)
    if K < 2:
        return out
    dt = np.diff(t)
    out[:, :-1] = middle_weight(w_r[:-1], dt) * (v[:, :-1] + v[:, 1:])
    if K < 4 or periods <= 0:
        return out
    a = w_r[1:-2] * dt[1:-1]
    good = (np.abs(dt[:-2] - dt[1:-1]) < 1e-3 * dt[1:-1]) & (
        np.abs(dt[2:] - dt[1:-1]) < 1e-3 * dt[1:-1]
    )
    good &= (np.abs(a) > 0.02) & (np.abs(a) < 0.6)  # the harmonics must be sampled well enough
    if jumped is not None:
        good &= ~(jumped[:-3] | jumped[1:-2] | jumped[2:-1])
    if not good.any():
        return out
    b = np.where(good, a, 0.25)
    D = v[:, :-3] + v[:, 3:] + (1 - 2 * np.cos(b)) * (v[:, 1:-2] + v[:, 2:-1])
    angle = np.concatenate([[0.0], np.cumsum(w_r[:-1] * dt)])[1:-2] + a / 2
    n = max(4, round(periods * 2 * math.pi / float(np.median(b))))
    for m in HARMONICS:
        lacking = 1 - np.cos(m * b / 2) / np.cos(b / 2)
        seen = 2 * np.cos(1.5 * m * b) + (1 - 2 * np.cos(b)) * 2 * np.cos(m * b / 2)
        turn = np.exp(1j * m * angle)
        part = _moving_mean(np.where(good, lacking / seen * D, 0.0) * turn.conj(), good, n)
        out[:, 1:-2] += np.where(good, 2 * (part * turn).real, 0.0)
    return out


def before(
    t: np.ndarray,
    x: np.ndarray,
    w_r: np.ndarray,
    *,
    harmonics: tuple[int, ...] = (1, 3),
    periods: float = 2.0,
    space: bool = False,
) -> np.ndarray:
    """Predict each sample from those before it.

    The ``harmonics`` of w_r (0: a constant) over ``periods`` are continued by two samples, so that
    neither the sample's own error nor that of the one before is in its prediction.

    Args:
        t: instants, s, shape (K,). x : values, shape (n, K). w_r : rad/s, shape (K,).
        space: return the complex amplitudes of the fundamental instead, turned to the instants: the
            value is their real part.

    Returns:
        Predictions, shape (n, K).
    """
    each = [continued(t, x, w_r, m, periods=periods) for m in ((1,) if space else harmonics)]
    out: np.ndarray = sum(each[1:], each[0])
    return out if space else out.real


def continued(
    t: np.ndarray, x: np.ndarray, w_r: np.ndarray, m: int, *, periods: float = 2.0
) -> np.ndarray:
    """Return one harmonic of :func:`before`, complex: its real part is the prediction, (n, K)."""
    K = t.size
    dt = np.append(np.diff(t), 0.0)
    angle = np.concatenate([[0.0], np.cumsum(w_r[:-1] * dt[:-1])])
    rate = float(np.median(np.abs((w_r * dt)[:-1]))) if K > 1 else 1.0
    n = min(K, max(4, round(periods * 2 * math.pi / max(rate, 1e-3))))
    turn = np.exp(1j * m * angle)
    part = _moving_mean(x * (turn.conj() * (2.0 if m else 1.0)), np.ones(K, bool), n)
    # the first use the first n, themselves among them
    out = np.empty_like(part)
    np.multiply(part[:, : max(K - 2, 0)], turn[2:], out=out[:, 2:])
    out[:, :2] = part[:, :1] * turn[:2]
    return out


def _moving_mean(x: np.ndarray, good: np.ndarray, n: int) -> np.ndarray:
    """Mean of the last n columns that count, of the first n where there are fewer before."""
    rows, K = x.shape
    m = min(n, K)
    total = np.zeros((rows, K + 1), x.dtype)
    np.cumsum(x, axis=1, out=total[:, 1:])
    count = np.concatenate([[0], np.cumsum(good)])
    # few good ones say little: what is missing counts as zero
    counted = np.maximum(np.maximum(count[m:] - count[:-m], 1), n // 2)
    out = np.empty_like(x)
    np.subtract(total[:, m:], total[:, :-m], out=out[:, m - 1 :])
    out[:, m - 1 :] /= counted
    out[:, : m - 1] = out[:, [m - 1]]
    return out


def voltage_weight(w_r: Any, dt: Any) -> Any:
    """Return how much of a voltage at the end of a step its fluxes hold at that end, s.

    By :func:`advance`, dt (1/6 + 2/3 m) in phase quantities with the weight m of
    :func:`middle_weight`, apart from what the resistances take back within the step
    (r_s dt / L'' = 1 % at 100 us).
    """
    return dt * (1.0 / 6.0 + 2.0 / 3.0 * middle_weight(w_r, dt))


@kept
def terminal_model(p: MachineParameters, fault: str = "shunts") -> StateSpace:
    """Return the continuous model of the machine with its terminals given.

    It is one of a family, which takes the machine's parameters too.

    Args:
        p: machine parameters; both neutrals are served, since v is measured to the machine's own.
        fault: ``"shunts"`` (kappa = mu, theta = h_a, h_b, h_c) or ``"leaky"`` (i_fault is a state,
            theta = mu, k_rf, kappa, phase_angle).

    Raises:
        ParameterError: unknown fault, or a machine that saturates.
    """
    if fault not in FAULTS:
        raise ParameterError(f"fault {fault!r} {nearest(str(fault), FAULTS)}")
    require_linear(p, "the terminal model")
    family = _family(fault)
    theta = LEAKY if fault == "leaky" else SHUNTS
    return StateSpace.member(family.name, family, theta, list(p.held("machine").values()))


@once
def _family(fault: str) -> StateSpace:
    """The model of all machines, theta with their parameters."""
    leaky = fault == "leaky"
    X = FLUXES + Signals([I_FAULT] if leaky else []) + Signals([ANGLE])
    TH = LEAKY if leaky else SHUNTS
    (xv, x), (uv, u), (tv, th) = X.sx(), INPUTS.sx(), TH.sx()
    pv = ca.SX.sym("p", len(MACHINE))
    p = of_symbols(MachineParameters, pv)
    at = Terminals(u["w_r"], Abc(u["v_a"], u["v_b"], u["v_c"]), u["V_fd"])
    lam = Windings(*(x[n] for n in FLUXES.names))
    machine = {"lam": lam, "theta_e": x["theta_e"], "at": at}
    ode, y = terminal_equations(p, **machine, fault=th, i_fault=x.get("i_fault"))
    z, none = Signals(), ca.SX(0, 1)
    ode_v, y_v = X.stack(ode), OUTPUTS.stack(y)
    return StateSpace.of(
        f"terminal_{fault}",
        (X, z, INPUTS, TH + MACHINE, OUTPUTS),
        (xv, none, uv, ca.vertcat(tv, pv)),
        dae=(ode_v, none),
        f=ode_v,
        g=y_v,
        z=none,
        cse=True,
    )


def terminal_equations(
    p: MachineParameters,
    *,
    lam: Windings,
    theta_e: Any,
    at: Terminals,
    fault: dict[str, Any],
    i_fault: Any = None,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return (rates of the states, outputs) by name; the one place where the model is written.

    Args:
        lam, theta_e, at: fluxes (Wb), rotor angle (rad) and terminals.
        fault: h_a, h_b, h_c; or, with ``i_fault`` (A), mu, k_rf, kappa, phase_angle.
    """
    i = wrsg.currents(p, lam)
    ibar = qd0_to_abc(theta_e, i.stator)
    rates = terminal_rates(p, lam, theta_e, at)
    ode = {f"lam_{n}": d for n, d in rates._asdict().items()} | {"theta_e": at.w_r}
    if i_fault is None:
        h = Abc(fault["h_a"], fault["h_b"], fault["h_c"])
        i_abc = shunt_currents(p, ibar=ibar, v=at.v, h=h)
        loss = shunt_loss(p, ibar=ibar, v=at.v, h=h)
    else:
        mu, k_rf = fault["mu"], fault["k_rf"]
        select = phase_selector(fault["phase_angle"])
        i_abc = Abc(*(ib + s * mu * i_fault for ib, s in zip(ibar, select, strict=True)))
        v_k = sum(s * vk for s, vk in zip(select, at.v, strict=True))
        i_k = sum(s * ik for s, ik in zip(select, i_abc, strict=True))
        loss = ttsc.fault_loss(p, mu=mu, k_rf=k_rf, i_k=i_k, i_fault=i_fault)
        ode["i_fault"] = fault_rate(
            p, mu=mu, k_rf=k_rf, kappa=fault["kappa"], v_k=v_k, i_fault=i_fault
        )
    P_e = sum(vk * ik for vk, ik in zip(at.v, i_abc, strict=True))
    y = {
        **{f"i_{k}": ik for k, ik in zip("abc", i_abc, strict=True)},
        "i_fd": i.fd,
        "i_kd": i.kd,
        "i_kq": i.kq,
        "T_e": wrsg.torque(p, lam=lam, i=i),
        "P_e": P_e,
        "P_loss_fault": loss,
        "P_total": 2.0 * (P_e + loss) / p.eta_sg,
    }
    return ode, y


def balanced_state(
    p: MachineParameters, *, v: complex, i: complex, w_r: float, i_fd: float, i_0: float = 0.0
) -> dict[str, float]:
    """Return fluxes and angle of a machine at rest from the phasors of its terminals.

    At rest without damper currents (5) reads, on the rotor's axes,
    v_q + r_s i_q = w_r (L_md i_fd - L_d i_d) and v_d + r_s i_d = w_r L_q i_q,
    so that V + (r_s + j w_r L_q) I lies along the q axis: that is the rotor angle.

    Args:
        v, i: positive sequence at the instant wanted, as complex amplitudes with v_a(t) = Re(v) at
            that instant and v_a = Re(v exp(j w_r t)) after it, V and A.
        w_r: electrical speed, rad/s, > 0.
        i_fd: field current, A.
        i_0: zero-sequence current at the instant, A.
    """
    E_q = v + (p.r_s + 1j * w_r * (p.L_mq + p.L_ls)) * i
    theta = math.atan2(E_q.imag, E_q.real)
    turned = i * complex(math.cos(theta), -math.sin(theta))
    # x_a = q cos(theta) + d sin(theta) is Re((q - j d) exp(j theta))
    currents = Windings(turned.real, -turned.imag, i_0, i_fd, 0.0, 0.0)
    lam = wrsg.flux_linkages(p, currents)
    return {f"lam_{n}": float(x) for n, x in lam._asdict().items()} | {"theta_e": theta}
