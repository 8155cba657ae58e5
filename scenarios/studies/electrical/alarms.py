"""Alarms where there is no short circuit: load steps, faults of the gas generator, long runs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from apu_casadi.machine.park import PHASES
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.apu.electrical.tracking import track
from estimators.apu.electrical.tuning import FAULT_LEVEL
from estimators.filters.belief import Belief
from estimators.filters.ekf import extended_kalman_filter
from estimators.information.consistency import count_limit
from scenarios.studies.electrical.protocol import (
    DT,
    FULL,
    FULL_UNBALANCED,
    PART,
    PART_UNBALANCED,
    PERIOD,
    SEED0,
    TAIL_FROM,
)
from scenarios.studies.electrical.scores import alarm_times, h_covariance, statistics_of
from scenarios.studies.electrical.truth import (
    Truth,
    drawn_gains,
    generator_truth,
    samples_of,
    unit_truth,
)

__all__ = ["false_alarms", "quiet"]


def quiet(n_seeds: int = 50, seed0: int = SEED0, *, level: float = FAULT_LEVEL) -> dict[str, Any]:
    """Count alarms where there is no electrical fault: load steps, faults of the gas generator.

    Load steps 225 -> 100 -> 225 kW (balanced and not, at a sample and between two), and a unit
    whose compressor and turbine lose efficiency in a step, whose speed then moves; with exact
    sensors and with gain errors (considered).  ``resets`` counts what
    :func:`~estimators.apu.electrical.tracking.track` takes for a step of h, ``tail`` tells
    how likely a run is to raise an alarm, few as they are.
    """
    from apu_casadi.unit.events import HealthChange, LoadChange

    between = 0.5 * DT * 0.6
    cases: dict[str, Callable[[], Truth]] = {
        "225 -> 100 -> 225 kW": lambda: generator_truth(FULL, 0.5, ((0.15, PART), (0.35, FULL))),
        "225 -> 100 -> 225 kW between samples": lambda: generator_truth(
            FULL, 0.5, ((0.15 + between, PART), (0.35 + between, FULL))
        ),
        "unbalanced 225 -> 100 -> 225 kW": lambda: generator_truth(
            FULL,
            0.5,
            ((-0.2, FULL_UNBALANCED), (0.15, PART_UNBALANCED), (0.35, FULL_UNBALANCED)),
            start=0.25,
        ),
        "gas fault": lambda: unit_truth(
            2.0, (HealthChange(0.2, {"f_eta_c": 0.97, "f_eta_t": 0.97, "f_W_c": 0.97}),)
        ),
        "unit, 225 -> 100 -> 225 kW": lambda: unit_truth(
            2.0, (LoadChange(0.2, PART), LoadChange(1.2, FULL))
        ),
    }
    out: dict[str, Any] = {}
    for name, make in cases.items():
        truth = make()
        row: dict[str, Any] = {"n_seeds": n_seeds, "seconds_of_data": float(truth.t[-1]) * n_seeds}
        row["seeds"] = [seed0, seed0 + n_seeds - 1]
        for kind in ("exact sensors", "gain errors"):
            filt = electrical_filter(gains="none" if kind == "exact sensors" else "consider")
            alarms, resets, tops, nis = 0, 0, [], []
            for s in range(seed0, seed0 + n_seeds):
                rng = np.random.default_rng(s)
                gains = drawn_gains(rng) if kind == "gain errors" else None
                samples = samples_of(truth, rng, gains=gains)
                data, prior = filt.recording(samples), filt.prior(samples)
                r = extended_kalman_filter(filt.model, prior, data, full=True)
                z = statistics_of(r.mean[r.x.indices([f"h_{k}" for k in PHASES])], h_covariance(r))
                z = z[:, 25:]
                alarms += alarm_times(z, level).size
                tops.append(float(z.max()))
                nis.append(float(r.nis[100:].mean()))
                if kind == "exact sensors":
                    resets += len(track(filt, prior, data)[1])
            row[kind] = {"alarms": alarms, "largest_h_over_sigma": max(tops)}
            row[kind]["mean_nis"] = float(np.mean(nis))
            row[kind]["tail"] = chance_of_alarm(np.array(tops), level)
            if kind == "exact sensors":
                row[kind]["resets"] = resets
        out[name] = row
    return out


def chance_of_alarm(tops: np.ndarray, level: float) -> dict[str, Any]:
    """Return how likely a run is to pass the level, by the tail of the largest statistics of runs.

    Beyond ``TAIL_FROM`` the share of runs is continued as exp(-z^2/2), which a Gaussian process has
    (Rice); ``shape``, the mean of (z^2 - TAIL_FROM^2)/2 there, tells whether it does: 1 is right, a
    larger one is a heavier tail, and its standard error comes with it.
    """
    beyond = tops[tops > TAIL_FROM]
    n = beyond.size
    rest = (level - TAIL_FROM**2) / 2
    return {
        "from": TAIL_FROM,
        "runs_beyond": int(n),
        "chance_per_run": n / tops.size * math.exp(-rest),
        "shape": float((beyond**2 - TAIL_FROM**2).mean() / 2) if n else None,
        "shape_error": 1 / math.sqrt(n) if n else None,
        "quantiles": np.quantile(tops, [0.5, 0.9, 0.99, 1.0]).tolist(),
    }


def false_alarms(
    hours: float = 1.0, seed0: int = SEED0, *, chunk: float = 10.0, level: float = FAULT_LEVEL
) -> dict[str, Any]:
    """Long healthy operation at 225 kW: how often the statistic rises past a level.

    The largest of the three one-phase statistics is looked at as a signed number z, standard normal
    at any instant.  Its up-crossings are counted at levels that occur often enough to be counted,
    and their rate is continued to the threshold by Rice's formula for Gaussian processes,
    rate(z) = rate_0 exp(-z^2/2), whose one constant is fitted; the counts tell whether it holds.

    Args:
        hours: simulated.
        chunk: length of one recording, s; each begins anew, its first 50 ms are left out.
    """
    filt = electrical_filter()
    one = generator_truth(FULL, 0.1)
    K = round(chunk / DT) + 1
    truth = _repeated(one, K)
    clean = samples_of(one, None)
    reference = extended_kalman_filter(
        filt.model, filt.prior(clean), filt.recording(clean), full=True
    )
    # the covariances are periodic by then and do not depend on the noise
    cov = h_covariance(reference)[-25:]
    i_h = reference.x.indices([f"h_{k}" for k in PHASES])
    skip, n_chunks = 500, max(1, round(hours * 3600.0 / chunk))
    levels = np.arange(2.5, 7.01, 0.25)
    counts = np.zeros(levels.size, dtype=int)
    moments, n, alarms, top, nis = np.zeros(2), 0, 0, 0.0, 0.0
    x0 = one.state(filt)[:, 0]
    prior = Belief(filt.model.x, x0, filt.prior(clean).cov)
    begun = time.perf_counter()
    cov_of = cov[np.arange(K) % 25 - (reference.t.size % 25)]
    for j in range(n_chunks):
        rng = np.random.default_rng(seed0 + j)
        samples = samples_of(truth, rng)
        r = extended_kalman_filter(filt.model, prior, filt.recording(samples))
        z = statistics_of(r.mean[i_h], cov_of)[:, skip:]
        most = z.max(axis=0)
        for q, level_z in enumerate(levels):
            above = most > level_z
            counts[q] += int((above[1:] & ~above[:-1]).sum())
        alarms += int(alarm_times(z, level).size)
        moments += [float(z.mean()), float((z**2).mean())]
        top = max(top, float(most.max()))
        nis += float(r.nis[skip:].mean())
        n += z.shape[1]
    seen = n * DT / 3600.0
    # one constant, from levels with between 30 and a tenth of the samples' counts, by likelihood
    use = (counts >= 30) & (levels >= 3.0)
    if not use.any():
        use = counts > 0
    shape = np.exp(-(levels**2) / 2)
    rate0 = float(counts[use].sum() / (shape[use].sum() * seen))
    expected = rate0 * shape * seen
    at = math.sqrt(level)
    slope = None
    if use.sum() >= 3:
        slope = float(np.polyfit(levels[use] ** 2 / 2, np.log(counts[use]), 1)[0])
    return {
        "hours": seen,
        "level": level,
        "alarms": alarms,
        "upper_95_per_hour_from_count": count_limit(alarms) / seen,
        "rate_per_hour": rate0 * math.exp(-level / 2),
        "level_for_one_per_hour": 2 * math.log(max(rate0, 1.0)),
        "z_of_level": at,
        "largest_z": top,
        "z_mean": float(moments[0] / n_chunks),
        "z_rms": math.sqrt(float(moments[1] / n_chunks)),
        "mean_nis": nis / n_chunks,
        "tail": {"z": levels.tolist(), "counts": counts.tolist(), "expected": expected.tolist()},
        "slope_of_log_rate": slope,  # -1 by Rice's formula
        "seconds": time.perf_counter() - begun,
    }


def _repeated(one: Truth, K: int) -> Truth:
    """Repeat the last electrical period of a steady truth over K samples."""
    n = round(PERIOD / DT)
    k = one.t.size - n + (np.arange(K) - (one.t.size - n)) % n
    values = {m: v[k] for m, v in one.values.items()}
    return Truth(np.arange(K) * DT, values)
