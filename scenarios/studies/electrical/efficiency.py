"""Error of h against the posterior Cramer-Rao bound, NEES and NIS."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.park import PHASES
from apu_casadi.machine.terminals import FLUXES
from estimators.apu.electrical.electricalfilter import ElectricalFilter, electrical_filter
from estimators.apu.electrical.terminalsignals import MEASURED
from estimators.apu.electrical.tuning import FLUX_WALK, H_WALK, START_SIGMA
from estimators.batch.relinearised import relinearised_filter
from estimators.filters.belief import Belief
from estimators.information.bounds import posterior_bound
from estimators.information.consistency import in_band, nees, rms_interval
from scenarios.studies.electrical.protocol import (
    CONSTANT,
    DETECT,
    DT,
    EFFICIENCY,
    FULL,
    FULL_UNBALANCED,
    H_PRIOR,
    N_SEEDS,
    RATIO_MATCHED,
    RATIO_MISMATCHED,
    SEED0,
    SHARE_IN_BAND,
    TWICE,
)
from scenarios.studies.electrical.truth import (
    Truth,
    chances,
    drawn_gains,
    generator_truth,
    samples_of,
)

__all__ = ["efficiency"]

_KINDS = {"gains": "estimate", TWICE: "estimate", "gains considered": "consider"}


@dataclass(frozen=True)
class _Case:
    """A case of the study: its filter, its truths, where the filter starts, and the bound."""

    filt: ElectricalFilter
    truth: Callable[[np.random.Generator], tuple[Truth, dict[str, float] | None]]
    prior: Callable[[Truth, dict[str, np.ndarray], np.random.Generator], Belief]
    bound: np.ndarray
    goal: float
    full_nees: bool = False
    passes: int = 1


def _scored(case: _Case, n_seeds: int, seed0: int, checks: np.ndarray) -> dict[str, Any]:
    """Run the filter over all seeds and compare with the bound, NEES and NIS at checkpoints."""
    filt, bound, full_nees = case.filt, case.bound, case.full_nees
    i_h = filt.model.x.indices([f"h_{k}" for k in PHASES])
    nx, c = len(filt.model.x), checks.size
    err2, nees_h, nees_x, nis = np.zeros((3, c)), np.zeros(c), np.zeros(c), np.zeros(c)
    mean = np.zeros((3, c))
    of_seed: dict[str, list[float]] = {"nees_h": [], "nees": [], "nis": []}
    for s in range(seed0, seed0 + n_seeds):
        rng = np.random.default_rng(s)
        truth, gains = case.truth(rng)
        samples = samples_of(truth, rng, gains=gains, sensors=filt.sensors)
        prior, data = case.prior(truth, samples, rng), filt.recording(samples)
        r = relinearised_filter(filt.model, prior, data, passes=case.passes, full=True)
        assert r.cov is not None
        known = {f"gain_{n}": g for n, g in (gains or {}).items()}
        error = (r.mean - truth.state(filt, **known))[:, checks]
        err2 += error[i_h] ** 2
        mean += error[i_h]
        one = nees(error[i_h].T, r.cov[checks][:, i_h][:, :, i_h])
        nees_h += one
        of_seed["nees_h"].append(float(one.mean()))
        if full_nees:
            carried = (r.mean - truth.carried(filt, samples))[:, checks]
            one = nees(carried.T, r.cov[checks])
            nees_x += one
            of_seed["nees"].append(float(one.mean()))
        nis += r.nis[checks]
        of_seed["nis"].append(float(r.nis[checks].mean()))
    rmse = np.sqrt(err2 / n_seeds)
    sigma = np.sqrt(np.diagonal(bound[checks][:, i_h][:, :, i_h], axis1=1, axis2=2)).T
    ratio = rmse / sigma
    pooled = float(np.sqrt((ratio**2).mean(axis=0)).max())
    end = float(np.sqrt((ratio[:, -1] ** 2).mean()))
    out = {
        "n_seeds": n_seeds,
        "seeds": [seed0, seed0 + n_seeds - 1],
        "t": ((checks) * DT).tolist(),
        "rmse_h": {k: rmse[j].tolist() for j, k in enumerate(PHASES)},
        "bound_h": {k: sigma[j].tolist() for j, k in enumerate(PHASES)},
        "bias_h": {k: (mean[j] / n_seeds).tolist() for j, k in enumerate(PHASES)},
        "ratio_end": end,
        "ratio_end_interval": rms_interval(end, 3 * n_seeds),
        "ratio_worst": pooled,
        "nees_h": in_band(nees_h / n_seeds, n_seeds, 3),
        "nis": in_band(nis / n_seeds, n_seeds, len(MEASURED)),
    }
    if full_nees:
        out["nees"] = in_band(nees_x / n_seeds, n_seeds, nx)
    for name, values in of_seed.items():
        if name in out:
            # of the mean over all checkpoints, which are correlated: from seed to seed
            out[name]["mean_error"] = float(np.std(values, ddof=1)) / math.sqrt(n_seeds)
    return out


def _matched() -> _Case:
    """Fluxes and severities walk, and start, as the filter believes."""
    filt, base = electrical_filter(), generator_truth(FULL, EFFICIENCY["duration"])
    sigma = dict.fromkeys([f"h_{k}" for k in PHASES], H_PRIOR) | START_SIGMA
    K = round(EFFICIENCY["duration"] / DT) + 1

    def truth(rng: np.random.Generator) -> tuple[Truth, None]:
        walk = H_WALK * math.sqrt(DT) * rng.standard_normal((3, K))
        walk[:, 0] = H_PRIOR * rng.standard_normal(3)
        flux = {n: START_SIGMA[n] for n in FLUXES.names}
        h = np.cumsum(walk, axis=1)
        return chances(base, rng, h=h, flux_sigma=flux, flux_walk=FLUX_WALK), None

    def prior(truth: Truth, samples: dict[str, np.ndarray], rng: np.random.Generator) -> Belief:
        mean = dict(zip(filt.model.x.names, base.state(filt)[:, 0], strict=True))
        mean["theta_e"] += START_SIGMA["theta_e"] * float(rng.standard_normal())
        return Belief.of(filt.model.x, mean, sigma)

    start, clean = prior(base, {}, np.random.default_rng(0)), samples_of(base, None)
    bound = posterior_bound(filt.model, start, filt.recording(clean), base.state(filt))
    return _Case(filt, truth, prior, bound, RATIO_MATCHED, full_nees=True)


def _simulated(case: str) -> _Case:
    """A short circuit and an unbalanced load, simulated, from the first period on."""
    walks: dict[str, Any] = CONSTANT if case == "constant" else {}
    filt = electrical_filter(gains=_KINDS.get(case, "none"), **walks)
    fault = Ttsc(0.05, 0.05 / DETECT["mismatched"][0] - 0.95, phase="b")
    before = ((-0.25, FULL_UNBALANCED), (-0.25, fault))
    base = generator_truth(FULL, EFFICIENCY["duration"], before, start=0.3)
    base = base.change(h_b=np.full(base.t.size, fault.h))

    def truth(rng: np.random.Generator) -> tuple[Truth, dict[str, float] | None]:
        return base, None if case in ("fault", "constant") else drawn_gains(rng)

    def prior(truth: Truth, samples: dict[str, np.ndarray], rng: np.random.Generator) -> Belief:
        return filt.prior(samples)

    clean = samples_of(base, None)
    data = filt.recording(clean)
    bound = posterior_bound(filt.model, filt.prior(clean), data, base.state(filt))
    passes = 2 if case == TWICE else 1
    return _Case(filt, truth, prior, bound, RATIO_MISMATCHED, passes=passes)


def efficiency(
    n_seeds: int = N_SEEDS, seed0: int = SEED0, *, cases: Sequence[str] | None = None
) -> dict[str, Any]:
    """Error of h against the posterior Cramer-Rao bound, NEES and NIS, matched and mismatched.

    * ``matched``: balanced 225 kW; initial fluxes, their random walk and the three severities
      (drawn with ``H_PRIOR``, walking with ``H_WALK``) are as the filter believes.
    * ``fault``: h = 3e-4 in phase b and an unbalanced load, both simulated, start from the first
      period; gains exact.
    * ``gains``: the same with the gain errors of all eight sensors, estimated by the filter.
    * ``gains, two passes``: the same, linearised a second time about what was found
      (:mod:`estimators.batch.relinearised`).
    * ``gains considered``: the same, by a filter that considers them (its NIS is no test).
    * ``gains ignored``: the same recordings, and a filter that knows nothing of gains; against its
      own (too small) bound.

    * ``constant``: the recordings of ``fault``, and a filter that is told that the severity is a
      constant (``CONSTANT``).  Such a filter never forgets: started far off, it would stay wrong.

    A constant h is less than a filter expects whose h walks: in ``fault`` the NEES is below its
    band, on the safe side; ``constant`` shows what of that is the walk's.

    The bound of a case is that of the model its filter uses.
    """
    checks = np.arange(1, round(EFFICIENCY["duration"] / EFFICIENCY["every"]) + 1) * round(
        EFFICIENCY["every"] / DT
    )
    known = ("matched", "fault", "constant", *_KINDS, "gains ignored")
    out: dict[str, Any] = {}
    for case in known if cases is None else cases:
        if case not in known:
            raise ParameterError(f"case {case!r} {nearest(case, known)}")
        begun = time.perf_counter()
        made = _matched() if case == "matched" else _simulated(case)
        r = _scored(made, n_seeds, seed0, checks)
        r["goal"] = made.goal
        r["passed"] = bool(r["ratio_worst"] <= r["goal"])
        judged = ("nees_h",) if case == "gains considered" else ("nees_h", "nis")
        r["consistent"] = bool(min(r[k]["share"] for k in judged) >= SHARE_IN_BAND)
        r["seconds"] = time.perf_counter() - begun
        out[case] = r
    return out
