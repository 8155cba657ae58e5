"""What the terminals tell of a turn-to-turn short circuit: its severity, mu and k_rf.

From the current of the faulty phase at given voltages, through the equivalent shunt of
:mod:`apu_casadi.machine.faults.ttsc`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError
from apu_casadi.core.profiles.profile import fixed
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.series import SeriesLoad
from estimators.apu.sensors import ELECTRICAL
from estimators.information.identifiability import identify
from estimators.information.sensitivities import Sensitivities

__all__ = ["SEVERITIES", "Severity", "severity", "severity_study", "shunt_current"]


@dataclass(frozen=True)
class Severity:
    """What one fault's severity looks like from the terminals.

    Args:
        fault: the short circuit.
        h: its severity h.
        periods: electrical periods that were averaged.
        sigma_mu, sigma_k_rf: bounds on the standard deviations of log mu and log k_rf, both
            unknown; inf on the ridge.
        sigma_h: bound on that of log h.
        correlation: of the estimates of log mu and log k_rf; NaN on the ridge.
        rank, rank_with_kappa: combinations of (mu, k_rf), and of (mu, k_rf, kappa), that show.
        ratio: reactance over resistance of the equivalent shunt, w L/R: what tells mu from k_rf.
    """

    fault: Ttsc
    h: float
    periods: int
    sigma_mu: float
    sigma_k_rf: float
    sigma_h: float
    correlation: float
    rank: int
    rank_with_kappa: int
    ratio: float


@kept
def shunt_current(machine: Generator) -> ca.Function:
    """Function (log mu, log k_rf, kappa, V, w, t) -> current of the shunt, A, steady state.

    Terminal voltage sqrt(2) V cos(w t); current out of the terminal counts positive.
    """
    p = machine.machine
    log_mu, log_k, kappa, V, w, t = (ca.SX.sym(n) for n in ("m", "k", "kappa", "V", "w", "t"))
    mu, k_rf = ca.exp(log_mu), ca.exp(log_k)
    R = p.r_s * (k_rf + 1 - mu) / mu
    X = w * (kappa - mu) * p.L_ls / mu
    i = -math.sqrt(2.0) * V * (R * ca.cos(w * t) + X * ca.sin(w * t)) / (R**2 + X**2)
    args = [log_mu, log_k, kappa, V, w, t]
    names = ["log_mu", "log_k_rf", "kappa", "V", "w", "t"]
    along = ca.jacobian(i, ca.vertcat(log_mu, log_k, kappa))
    return ca.Function("shunt", args, [i, along, X / R], names, ["i", "i_theta", "ratio"])


def severity(
    fault: Ttsc,
    *,
    periods: int = 8,
    gain_error: bool = True,
    kappa_known: bool = True,
    generator: Generator | None = None,
    load: float | None = None,
) -> tuple[Sensitivities, float]:
    """Return the sensitivities of the faulty phase's current to the severity, and w L/R.

    The generator is the healthy machine with a shunt from terminal to neutral, R = r_s/h,
    L = (kappa - mu) L_ls/mu; at given voltages the healthy part does not depend on the fault.
    Voltages are balanced, sinusoidal and taken as known, so that the bounds are optimistic:
    voltage noise comes on top.  If kappa = mu it is tied to mu, the paper's own model.

    Args:
        fault: the short circuit.
        periods: electrical periods, sampled at 10 kHz.
        gain_error: consider the gain error of the current's sensor.
        kappa_known: otherwise kappa is unknown as well, without a prior.
        generator, load: the machine, and its load, W, balanced and resistive; by default its rated
            power at rated voltage.

    Raises:
        ParameterError: periods not positive, or k_rf = 0, which has no logarithm.
        ScenarioError: a fault that changes in time.
    """
    fault = fixed(fault, "fault", "what is known of its severity")
    if periods < 1 or not fault.k_rf > 0:
        raise ParameterError(f"periods >= 1 and k_rf > 0 expected, got {periods!r}, {fault!r}")
    gen = Generator() if generator is None else generator
    m = gen.machine
    load = m.P_rated if load is None else load
    at = gen.steady_state(SeriesLoad.from_power(load, V_rms=m.V_rated_rms, f=m.f_rated))
    w, V = float(at.u[0]), at.V_t
    n = round(periods * 2 * math.pi / w / 1e-4)
    t = 1e-4 * np.arange(n)
    tied = fault.kappa == fault.mu
    args = (math.log(fault.mu), math.log(fault.k_rf), fault._kappa, V, w, t[None, :])
    i, along, ratio = (a.full() for a in shunt_current(gen)(*args))
    J = along.reshape(3, n, order="F").T if along.shape[0] == 3 else along.reshape(n, 3)
    if tied:  # kappa = mu moves with mu
        J = np.column_stack([J[:, 0] + fault.mu * J[:, 2], J[:, 1]])
    current = math.sqrt(2.0) * load / 3 / V * np.cos(w * t) + i[0]
    signals = [
        Signal("log_mu", "1", "logarithm of the shorted fraction of turns"),
        Signal("log_k_rf", "1", "logarithm of fault over shorted-turn resistance"),
    ]
    if not tied and not kappa_known:
        signals.append(Signal("kappa", "1", "leakage partition"))
    faults = [s.name for s in signals]
    J = J[:, : len(signals)]
    prior = {}
    sensor = ELECTRICAL["i_a"]
    if gain_error:
        signals.append(Signal("gain_i_a", "1", "gain error of the current sensor"))
        J = np.column_stack([J, current])
        prior["gain_i_a"] = sensor.gain
    of, noise, size = Signals(signals), np.full(n, sensor.noise), dict.fromkeys(faults, 0.1)
    g = Sensitivities.of(of, ["i_a"] * n, J, noise, faults=faults, prior=prior, size=size)
    return g, float(ratio.ravel()[0])


#: Severities of the study: (mu, k_rf).
SEVERITIES = ((0.05, 1.0), (0.02, 1.0), (0.01, 1.0), (0.01, 10.0), (0.002, 20.0))


def severity_study(
    severities: Sequence[tuple[float, float]] = SEVERITIES,
    kappas: Sequence[float | None] = (None, 0.5, 1.0),
    *,
    periods: int = 8,
    gain_error: bool = True,
    generator: Generator | None = None,
) -> list[Severity]:
    """Return what is known of log mu and log k_rf, for every severity and kappa (None: mu).

    Raises:
        ParameterError: see :func:`severity`.
    """
    out = []
    for mu, k_rf in severities:
        for kappa in kappas:
            fault = Ttsc(mu, k_rf, kappa)
            options: dict[str, Any] = {"periods": periods, "gain_error": gain_error}
            options["generator"] = generator
            g, ratio = severity(fault, **options)
            found = identify(g)
            three = identify(severity(fault, kappa_known=False, **options)[0])
            # log h = log mu - log(k_rf + 1 - mu)
            a = np.array([1 + mu / (k_rf + 1 - mu), -k_rf / (k_rf + 1 - mu)])
            out.append(
                Severity(
                    fault=fault,
                    h=fault.h,
                    periods=periods,
                    sigma_mu=float(found.sigma_flat[0]),
                    sigma_k_rf=float(found.sigma_flat[1]),
                    sigma_h=_along(g, a),
                    correlation=float(found.correlation[0, 1]) if found.rank == 2 else math.nan,
                    rank=found.rank,
                    rank_with_kappa=three.rank,
                    ratio=ratio,
                )
            )
    return out


def _along(g: Sensitivities, a: np.ndarray) -> float:
    """Return the bound on the standard deviation of a' theta without priors; inf if unseen."""
    M = g.signatures()
    _, s, Vt = np.linalg.svd(M, full_matrices=False)
    seen = s > 1e-8 * s[0]
    c = Vt @ a
    if np.abs(a - Vt[seen].T @ c[seen]).max() > 1e-6 * np.abs(a).max():
        return math.inf
    return float(np.linalg.norm(c[seen] / s[seen]))
