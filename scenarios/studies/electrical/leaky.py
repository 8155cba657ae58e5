"""Leaky faults: what can be told of mu and k_rf, and what a wrong kappa does."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.park import PHASES
from apu_casadi.machine.terminals import shunt_parameters
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.apu.electrical.faults import leaky_fault, shunt_of
from estimators.filters.ekf import extended_kalman_filter
from scenarios.studies.electrical.protocol import FULL, KAPPAS, LEAKY, SEED0
from scenarios.studies.electrical.truth import generator_truth, samples_of

__all__ = ["leaky", "shunt_information"]


def shunt_information(
    mu: float, k_rf: float, kappa: float, sigma_h: float
) -> dict[str, float | None]:
    """Return what the terminals tell of mu and k_rf at 400 Hz, by the admittance alone.

    At one frequency the shunt is an admittance Y = 1/(R + j w L); with conductance and susceptance
    known to sigma_h/r_s each, the covariance of (mu, k_rf) is that of the 2 by 2 map.  An
    independent route to what the filter claims.
    """
    p = Generator().machine
    w = p.w_rated

    def admittance(m: float, k: float) -> np.ndarray:
        Y = 1.0 / complex(p.r_s * (k + 1 - m) / m, w * (kappa - m) * p.L_ls / m)
        return np.array([Y.real, Y.imag]) * p.r_s

    if kappa <= mu:
        return {"sigma_mu": None, "sigma_k_rf": None, "singular_ratio": 0.0}
    e = 1e-6
    by_mu = (admittance(mu * (1 + e), k_rf) - admittance(mu * (1 - e), k_rf)) / (2 * e * mu)
    by_k_rf = (admittance(mu, k_rf + e) - admittance(mu, k_rf - e)) / (2 * e)
    J = np.column_stack([by_mu, by_k_rf])
    C = sigma_h**2 * np.linalg.inv(J.T @ J)
    # in relative terms, so that the two parameters can be compared
    s = np.linalg.svd(J * np.array([mu, 1 + k_rf]), compute_uv=False)
    return {
        "sigma_mu": float(math.sqrt(C[0, 0])),
        "sigma_k_rf": float(math.sqrt(C[1, 1])),
        "singular_ratio": float(s[1] / s[0]),
    }


def leaky(n_seeds: int = 20, seed0: int = SEED0) -> dict[str, Any]:
    """Faults with kappa > mu: what can be told of (mu, k_rf), and what a wrong kappa does.

    For each fault and kappa: mean and scatter of (mu, k_rf) of a filter that knows kappa and phase,
    its claimed standard deviations, and those of :func:`shunt_information`; then a filter that
    takes kappa = 0.5 for 1, and the full-coupling filter.
    """
    rows = []
    for mu, k_rf in LEAKY:
        for kappa in KAPPAS:
            fault = Ttsc(mu, k_rf, kappa=kappa)
            truth = generator_truth(FULL, 0.3, ((-0.2, fault),), start=0.25)
            filt = electrical_filter(kappa=kappa, phase="a")
            est, nis = [], []
            r = None
            for s in range(seed0, seed0 + n_seeds):
                samples = samples_of(truth, np.random.default_rng(s))
                r = extended_kalman_filter(filt.model, filt.prior(samples), filt.recording(samples))
                found = leaky_fault(filt, r)
                est.append(found.mean)
                nis.append(float(r.nis[500:].mean()))
            assert r is not None
            e = np.array(est)
            claimed = found.sigma.tolist()
            row: dict[str, Any] = {"mu": mu, "k_rf": k_rf, "kappa": kappa, "h": fault.h}
            row["mean"] = e.mean(axis=0).tolist()
            row["rmse"] = np.sqrt(((e - [mu, k_rf]) ** 2).mean(axis=0)).tolist()
            row["claimed"] = claimed
            sigma_h = float(r["g_shunt"][1][-1])
            row["admittance"] = shunt_information(mu, k_rf, kappa, sigma_h)
            row["identified"] = bool(claimed[1] < 0.3 * (1 + k_rf))
            rows.append(row | {"nis": float(np.mean(nis))})
    wrong = []
    for mu, k_rf in LEAKY:
        truth = generator_truth(FULL, 0.3, ((-0.2, Ttsc(mu, k_rf, kappa=1.0)),), start=0.25)
        samples = samples_of(truth, np.random.default_rng(seed0))
        row = {"mu": mu, "k_rf": k_rf, "kappa": 1.0, "h": Ttsc(mu, k_rf, kappa=1.0).h}
        half = electrical_filter(kappa=0.5, phase="a")
        r = extended_kalman_filter(half.model, half.prior(samples), half.recording(samples))
        p = half.machine
        true = shunt_parameters(
            p, R=p.r_s * (k_rf + 1 - mu) / mu, L=(1 - mu) * p.L_ls / mu, kappa=0.5
        )
        row["kappa 0.5 assumed"] = {
            "estimate": leaky_fault(half, r).mean.tolist(),
            "expected": [true["mu"], true["k_rf"]],
            "put_right": list(shunt_of(half, r, 1.0).values()),
            "nis": float(r.nis[500:].mean()),
        }
        plain = electrical_filter()
        r = extended_kalman_filter(plain.model, plain.prior(samples), plain.recording(samples))
        row["full coupling assumed"] = {
            "h": [float(r[f"h_{k}"][0][-1]) for k in PHASES],
            "nis": float(r.nis[500:].mean()),
        }
        wrong.append(row)
    about = {"n_seeds": n_seeds, "seeds": [seed0, seed0 + n_seeds - 1]}
    return {**about, "known": rows, "wrong": wrong}
