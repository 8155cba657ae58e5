"""Detection of a short circuit: its delay, and whether the phase is right."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.park import PHASES
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.apu.electrical.tuning import FAULT_LEVEL
from estimators.filters.ekf import extended_kalman_filter
from estimators.information.consistency import share_interval
from scenarios.studies.electrical.protocol import (
    DETECT,
    DT,
    FULL,
    FULL_UNBALANCED,
    N_SEEDS,
    PERIOD,
    SEED0,
    WAIT,
)
from scenarios.studies.electrical.scores import alarm_times, h_covariance, statistics_of
from scenarios.studies.electrical.truth import chances, drawn_gains, generator_truth, samples_of

__all__ = ["detection"]


def detection(
    n_seeds: int = N_SEEDS,
    seed0: int = SEED0,
    *,
    cases: Sequence[str] | None = None,
    level: float = FAULT_LEVEL,
) -> dict[str, Any]:
    """Delay of the detection of h, and whether the phase is right.

    An alarm is a one-phase statistic (h_k/sigma)^2 above ``FAULT_LEVEL`` (h_k > 0), the test that
    ``faulty_phase`` applies.  ``matched``: h = 1e-4, balanced load, exact sensors.
    ``mismatched``: h = 3e-4, unbalanced load, gain errors in all eight sensors, of which the filter
    knows the standard deviation only and which it estimates; ``considered``: or considers.
    Onset and phase are random; a false alarm is one before it.
    """
    out: dict[str, Any] = {}
    for case in DETECT if cases is None else cases:
        if case not in DETECT:
            raise ParameterError(f"case {case!r} {nearest(case, DETECT)}")
        begun = time.perf_counter()
        h, periods = DETECT[case]
        after = 1.2 * periods * PERIOD
        matched = case == "matched"
        kinds = {"matched": "none", "mismatched": "estimate", "considered": "consider"}
        filt = electrical_filter(gains=kinds[case])
        delays, right, before = [], 0, 0
        cov: np.ndarray | None = None
        n_after = round(after / DT)
        for s in range(seed0, seed0 + n_seeds):
            rng = np.random.default_rng(s)
            phase = PHASES[int(rng.integers(3))]
            if matched:
                onset = round(WAIT / DT) + int(rng.integers(25))
                base = generator_truth(FULL, WAIT + after + 0.01)
                step = np.zeros((3, base.t.size))
                step[PHASES.index(phase), onset:] = h
                truth, gains = chances(base, rng, h=step), None
            else:
                onset = round(WAIT / DT)
                fault = Ttsc(0.05, 0.05 / h - 0.95, phase=phase)
                truth = generator_truth(
                    FULL, WAIT + after + 0.01, ((-0.2, FULL_UNBALANCED), (WAIT, fault)), start=0.25
                )
                gains = drawn_gains(rng)
            samples = samples_of(truth, rng, gains=gains)
            prior = filt.prior(samples)
            r = extended_kalman_filter(filt.model, prior, filt.recording(samples), full=True)
            z = statistics_of(r.mean[r.x.indices([f"h_{k}" for k in PHASES])], h_covariance(r))
            cov = h_covariance(r)
            before += alarm_times(z[:, :onset], level).size
            late = np.flatnonzero(z[:, onset : onset + n_after].max(axis=0) > math.sqrt(level))
            if late.size:
                delays.append((late[0] + 1) * DT / PERIOD)
                at = min(onset + round(periods * PERIOD / DT), z.shape[1] - 1)
                right += int(PHASES[int(np.argmax(z[:, at]))] == phase)
            else:
                delays.append(math.inf)
        d = np.array(delays)
        found = int((d <= periods).sum())
        assert cov is not None
        out[case] = {
            "h": h,
            "within_periods": periods,
            "level": level,
            "n_seeds": n_seeds,
            "seeds": [seed0, seed0 + n_seeds - 1],
            "found": found / n_seeds,
            "found_interval": list(share_interval(found, n_seeds)),
            "delay_periods": {
                "median": float(np.median(d)),
                "p95": _finite(np.quantile(d, 0.95, method="higher")),
                "max": _finite(d.max()),
            },
            "right_phase": right / n_seeds,
            "right_phase_interval": list(share_interval(right, n_seeds)),
            "false_alarms_before": before,
            "sigma_h": float(1 / math.sqrt(np.linalg.inv(cov[-1])[0, 0])),
            "seconds": time.perf_counter() - begun,
        }
    return out


def _finite(x: float) -> float | None:
    """Return a number that JSON can hold: None for infinity."""
    return float(x) if math.isfinite(x) else None
