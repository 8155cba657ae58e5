"""What is known of the fault: the phase, its severity, and what cannot be told apart."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from apu_casadi.core.errors import EstimationError
from apu_casadi.core.signals import Signals
from apu_casadi.machine.park import PHASES
from apu_casadi.machine.terminals import LEAKY, shunt_parameters
from estimators.apu.electrical.electricalfilter import ElectricalFilter
from estimators.apu.electrical.machinemodel import leaky_pair
from estimators.apu.electrical.terminalsignals import ADMITTANCE, PHASES_I
from estimators.apu.electrical.tuning import FAULT_LEVEL, H_SIGMA, LEAST_SUSCEPTANCE
from estimators.filters.belief import Belief
from estimators.filters.filtering import FilterResult
from estimators.information.posterior import posterior

__all__ = ["Verdict", "describe", "faulty_phase", "leaky_fault", "ridge", "shunt_of"]


@dataclass(frozen=True)
class Verdict:
    """Which phase is faulty, and how much.

    Args:
        phase: "a", "b", "c", or None where no phase's h exceeds its noise by ``level``.
        h, sigma: severity of that (or of the likeliest) phase with the other two healthy, and its
            standard deviation.
        statistic: (h/sigma)^2 of each phase alone, chi-squared with one degree of freedom where
            there is no fault; zero for h < 0.
        probability: of each phase to be the one, given that one is faulty and all severities were
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
    likelihood ratio against a healthy machine c^2 (P^-1)_kk.  Where gains are unknown, what all
    three have in common counts for nothing: the start and every reset hold it near zero, for the
    sake of the rotor angle, and of a fault in one phase that is a third.

    Args:
        belief: of a filter with the three h, or a result (its last instant).
        level: statistic above which a fault is reported.

    Raises:
        EstimationError: the belief has not the three severities.
    """
    b = belief.final if isinstance(belief, FilterResult) else belief
    names = [f"h_{k}" for k in PHASES]
    if any(n not in b.x.names for n in names):
        raise EstimationError(
            f"faulty_phase needs {', '.join(names)}; the belief has {', '.join(b.x.names)}"
        )
    m = b.marginal(names)
    cov = m.cov
    if f"gain_{PHASES_I[0]}" in b.x.names:
        along = cov.sum(1) / cov.sum(1).mean()
        cov = cov + H_SIGMA**2 * np.outer(along, along)
    info = np.linalg.inv(cov)
    c = (info @ m.mean) / np.diag(info)
    stat = np.where(c > 0, c**2 * np.diag(info), 0.0)
    best = int(np.argmax(stat))
    # marginal likelihood over h > 0 with a flat prior: exp(stat/2) / sqrt(info)
    score = stat / 2 - 0.5 * np.log(np.diag(info))
    prob = posterior(score)
    return Verdict(
        PHASES[best] if stat[best] > level else None,
        float(c[best]),
        1 / math.sqrt(info[best, best]),
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

    Args:
        filt: made with a kappa.
        belief: of it, or a result (its last instant).

    Raises:
        EstimationError: the filter was not made with a kappa; or the susceptance is not above three
            of its standard deviations: the branch then shows no inductance, and only h is told.
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
    steps = [leaky_pair(filt.machine, filt.kappa, *at) for at in ((g + e * 1j, s), (g, s + e * 1j))]
    J = np.array(steps).imag.T / e
    pair = np.array(leaky_pair(filt.machine, filt.kappa, g, s), dtype=float)
    return Belief(Signals([LEAKY["mu"], LEAKY["k_rf"]]), pair, J @ m.cov @ J.T)


def describe(filt: ElectricalFilter, belief: Belief | FilterResult) -> str:
    """Say in words what is known of the fault.

    Raises:
        EstimationError: as :func:`faulty_phase`.
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

    Raises:
        EstimationError: the filter was not made with a kappa, and as :func:`leaky_fault`.
    """
    if filt.kappa is None:
        raise EstimationError("with full coupling there is one number h, and no shunt inductance")
    mu, k = (float(x) for x in leaky_fault(filt, belief).mean)
    p = filt.machine
    R = p.r_s * (k + 1 - mu) / mu
    L = (filt.kappa - mu) * p.L_ls / mu
    return shunt_parameters(p, R=R, L=L, kappa=kappa)
