"""The course of the gas-path studies: seeds, instants, engines, and what is drawn for a seed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.sharing import once
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import LoadChange
from apu_casadi.unit.multirate import simulate_joint
from estimators.apu import gaspath
from estimators.apu.gaspath import HEALTH_SIGMA, JUMP, GasPathFilter, gas_path_filter
from estimators.apu.gaspathmodel import DT, GAINED
from estimators.apu.healthjumps import JumpTest
from estimators.filters.ekf import ekf_step

TUNED = range(1, 201)
TUNED_LONG = range(10001, 11001)  # what is iterated: biases of 0.1 sigma need many seeds
# 1001-1500, 2001-2500 and 3001-3500 were looked at while the iteration was chosen
FRESH = range(4001, 4501)
DURATION = 14.0  # s
LOAD_DROP, FAULT = 2.0, 6.0  # s; as in the paper's joint scenario
FINE = 4  # steps of the mismatched truth in one of the filter
ETA_SIGMA = 0.02  # efficiency of the generators, relative
CHECKPOINTS = tuple(np.arange(0.5, DURATION + 1e-9, 0.5).tolist())
SETTLED = 1.0  # s after a fault from which the errors of the mismatched filter count
JUMP_TEST = JumpTest()
BLOCK = 100  # steps of a truth in one call
BOUNDS_EVERY = 20  # trajectories between those whose bound is computed

VARIANTS: dict[str, dict[str, Any]] = {
    "same engine": {},
    "inertia + 10 %": {"parameters": {"J": 0.055}},
    "nasa9 gas data": {"parameters": {"gas_data": "nasa9"}},
    "other map calibration": {
        "compressor_map": {"n_Re": 0.15, "a_W": 0.035},
        "turbine_map": {"c_PR": 0.28, "a_W": 0.07},
    },
}
"""What the mismatched truth has instead of the filter's engine; its seeds take turns."""


def variant(gg: GasGenerator, change: Mapping[str, Mapping[str, Any]]) -> GasGenerator:
    """Return a gas generator with changed parameters or map calibrations."""
    new: dict[str, Any] = {}
    for part, values in change.items():
        old = getattr(gg, part)
        if part == "parameters":
            new[part] = old.change(**values)
        else:
            new[part] = dataclasses.replace(
                old, calibration=dataclasses.replace(old.calibration, **values)
            )
    return dataclasses.replace(gg, **new) if new else gg


modules: dict[str, tuple[str, ...]] = {
    "gaspath": ("estimators.apu.gaspath",),
    "gaspath_study": ("scenarios.studies.gaspath",),
}
"""Whose constants the studies depend on."""
fresh: dict[str, Any] = {
    "seeds": len(FRESH),
    "seed0": FRESH.start,
    "tuned": f"tuned on seeds {TUNED.start} to {TUNED.stop - 1}, the iteration on "
    f"{TUNED_LONG.start} to {TUNED_LONG.stop - 1}",
}
"""The seeds of the studies."""


def filters() -> list[ca.Function]:
    """Return the functions of the filters that the studies try."""
    both = (gas_path_filter(), gas_path_filter(eta=ETA_SIGMA, consider_eta=False))
    return [ekf_step(f.model, gaspath.ITERATIONS, gaspath.ITERATED).function for f in both]


@once
def power_profile() -> np.ndarray:
    """Shaft power, W, in steps of 5 ms: 2 x 225 kW, then 2 x 100 kW from LOAD_DROP on.

    Of a joint run with a healthy gas path, voltage regulator and all; held when it has settled.
    """
    load, less = (SeriesLoad.from_power(P) for P in (225e3, 100e3))
    fast: dict[str, Any] = {"dt": DT / FINE, "waveform_dt": None, "solver": "propagator"}
    events = [LoadChange(LOAD_DROP, less)]
    ds = simulate_joint(Apu(), duration=LOAD_DROP + 3.0, load=load, events=events, **fast)
    PW = np.asarray(ds["PW"].values[1:], float)
    n = round(DURATION / DT) * FINE
    return np.concatenate([PW, np.full(n - PW.size, PW[-1])])


@dataclass(frozen=True)
class Case:
    """What is drawn for one seed.

    Args:
        health: factors at the start, shape (4,).
        jump: change of the factors at :data:`FAULT`, shape (4,).
        gains: relative errors of the sensors P3, T3, T5, Wf, of PW and of J, by name.
    """

    health: np.ndarray
    jump: np.ndarray
    gains: dict[str, float]

    @property
    def sensors(self) -> dict[str, float]:
        """The gains that are of sensors."""
        return {n: g for n, g in self.gains.items() if n != "J"}


def draw(rng: np.random.Generator, filt: GasPathFilter, *, matched: bool) -> Case:
    """Draw a case: from the filter's prior if matched, else faults of 1-4 % in 1 to 4 factors."""
    health = 1 + HEALTH_SIGMA * rng.standard_normal(4)
    if matched:
        jump = JUMP * rng.standard_normal(4)
    else:
        hit = rng.permutation(4) < rng.integers(1, 5)
        jump = hit * rng.choice([-1.0, 1.0], 4) * rng.uniform(0.01, 0.04, 4)
    errors = {}
    for n in (*GAINED, "PW", "J"):
        e = float(rng.standard_normal())
        # the other engines have errors of model and inertia of their own
        s = filt.sensors[n].gain if not matched and n in GAINED else filt.sigma.get(f"gain_{n}", 0)
        if s and (matched or n != "J"):
            errors[n] = s * e
    return Case(health, jump, errors)


def generators(seed: int) -> tuple[np.random.Generator, ...]:
    """Generators of the case, the process noise and the measurement noise of a seed."""
    return tuple(np.random.default_rng([seed, k]) for k in range(3))
