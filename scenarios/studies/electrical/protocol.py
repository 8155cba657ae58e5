"""Every number that the studies of the electrical filter depend on, fixed before they are run."""

from __future__ import annotations

import casadi as ca

from apu_casadi.machine.loads.series import SeriesLoad
from estimators.apu.electrical import electricalfilter
from estimators.filters.ekf import ekf_step

DT = 1e-4  # s, 10 kHz
PERIOD = 2.5e-3  # s, 400 Hz
N_SEEDS = 500
SEED0 = 10_000  # seeds below were used for tuning
RTOL, ATOL = 1e-9, 1e-11  # of the truths
UNBALANCE = (1.05, 1.0, 0.95)
FULL = SeriesLoad.from_power(225e3)
PART = SeriesLoad.from_power(100e3)
FULL_UNBALANCED = SeriesLoad.from_power(225e3, unbalance=UNBALANCE)
PART_UNBALANCED = SeriesLoad.from_power(100e3, unbalance=UNBALANCE)
H_PRIOR = 1e-4  # standard deviation of the three severities in the study of efficiency
EFFICIENCY = {"duration": 0.3, "every": 0.01}  # s; checkpoints
#: Walks of the filter in the case ``constant``: none of h, and of the fluxes what is negligible.
CONSTANT = {"h_walk": 0.0, "flux_walk": 1e-5}
TWICE = "gains, two passes"
#: Limits of the goals.
RATIO_MATCHED, RATIO_MISMATCHED, SHARE_IN_BAND = 1.2, 1.5, 0.9
#: h and the electrical periods within which it is to be found.
DETECT = {"matched": (1e-4, 20), "mismatched": (3e-4, 50), "considered": (3e-4, 50)}
WAIT = 0.1  # s of healthy samples before a fault
#: Exchange step of the whole unit's truth, s, each computed twice.  The speed that is recorded is
#: then within 0.02 rad/s that of the machine (4e-4 rms); with 20 ms, computed once, it is up to
#: 2.7 rad/s off (0.4 rms): no noise, but a sensor that is late, which no real pick-up is.
UNIT_STEP = 2e-3
#: Statistics of a run above this, standard deviations, serve to continue their tail.
TAIL_FROM = 2.5
LEAKY = ((0.002, 1.0), (0.01, 1.0), (0.05, 1.0), (0.01, 10.0))  # (mu, k_rf)
KAPPAS = (1.0, 0.5, 0.2)


def filters() -> list[ca.Function]:
    """Return the functions of the filters that the studies try."""
    kinds = (electricalfilter.electrical_filter(gains=g) for g in electricalfilter.GAINS)
    return [ekf_step(filt.model).function for filt in kinds]
