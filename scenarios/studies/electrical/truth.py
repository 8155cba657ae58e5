"""Noise-free courses of the generator, what is added to them by chance, and what sensors read."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg

from apu_casadi.core.sharing import last, once
from apu_casadi.machine.generator import Generator
from apu_casadi.machine.loads.load import Load
from apu_casadi.machine.park import PHASES, Abc, Qd0, abc_to_qd0, qd0_to_abc
from apu_casadi.machine.terminals import FLUXES
from apu_casadi.machine.wrsg import Windings, currents, flux_rates
from estimators.apu.electrical.electricalfilter import ElectricalFilter
from estimators.apu.electrical.machinemodel import held
from estimators.apu.electrical.terminalsignals import GAIN_SENSORS, MEASURED, VOLTAGES
from estimators.apu.sensors import ELECTRICAL, SensorSet
from scenarios.studies.electrical.protocol import ATOL, DT, FULL, RTOL, UNIT_STEP

__all__ = ["Truth", "chances", "drawn_gains", "generator_truth", "samples_of", "unit_truth"]

_SAMPLED = ("w_r", *VOLTAGES, *MEASURED)


@dataclass(frozen=True, eq=False)
class Truth:
    """A noise-free course of the generator at the samples.

    Args:
        t: instants, s, shape (K,).
        values: by name: w_r, voltages, currents, and where known fluxes, theta_e, i_fault, P_total.
    """

    t: np.ndarray
    values: dict[str, np.ndarray]

    def part(self, start: int, stop: int | None = None) -> Truth:
        """Return the instants start <= k < stop."""
        return Truth(self.t[start:stop], {n: v[start:stop] for n, v in self.values.items()})

    def change(self, **values: np.ndarray) -> Truth:
        """Return the truth with other values."""
        return Truth(self.t, self.values | values)

    def state(self, filt: ElectricalFilter, **known: Any) -> np.ndarray:
        """Return the true states of a filter, shape (nx, K); ``known`` for others than values."""
        rows = []
        for name in filt.model.x.names:
            value = known.get(name, self.values.get(name, 0.0))
            rows.append(np.broadcast_to(value, self.t.shape))
        return np.array(rows)

    def carried(self, filt: ElectricalFilter, samples: Mapping[str, np.ndarray]) -> np.ndarray:
        """Return what a filter without gains carries: s(k) = x(k) + G e(k), shape (nx, K).

        The fluxes as if the last voltages read were true; that is what its covariance is of.
        """
        s = self.state(filt)
        e = {n: samples[n] - self.values[n] for n in VOLTAGES}
        e_qd0 = abc_to_qd0(self.values["theta_e"], Abc(*(e[n] for n in VOLTAGES[:3])))
        dt_last = np.append(0.0, np.diff(self.t))  # the first voltages have moved no flux yet
        more = held(filt.machine, w_r=self.values["w_r"], dt=dt_last, v=e_qd0, V_fd=e["V_fd"])
        for n, d in zip(FLUXES.names, more, strict=True):
            s[filt.model.x.index(n)] += np.ravel(d)
        return s


@last(16)
def generator_truth(
    load: Load,
    duration: float,
    switches: tuple[tuple[float, Any], ...] = (),
    *,
    start: float = 0.0,
    generator: Generator | None = None,
) -> Truth:
    """Simulate one generator at rated speed with CVODES, sampled at 10 kHz.

    Args:
        load: balanced load at the start.
        duration: length of what is returned, s.
        switches: (instant in s counted from the beginning of what is returned, load, fault or
            None); an instant need not be a sample.
        start: seconds simulated before; switches may lie there, at negative instants.
        generator: default the paper's.
    """
    gen = Generator() if generator is None else generator
    total = start + duration
    data = gen.simulate(
        load,
        total,
        switches=[(t + start, what) for t, what in switches],
        dt_out=DT,
        rtol=RTOL,
        atol=ATOL,
    )
    t = data["time"].values
    grid = start + np.arange(round(duration / DT) + 1) * DT
    k = np.searchsorted(t, grid - 1e-9)
    values = {str(n): data[n].values[k] for n in data.data_vars}
    values["w_r"] = np.full(grid.size, gen.machine.w_rated)
    return Truth(grid - start, values)


@last(8)
def unit_truth(duration: float, events: tuple[Any, ...], *, load: Load = FULL) -> Truth:
    """Simulate the whole unit (speed moves, a ramp in each ``UNIT_STEP``) and sample a generator.

    Args:
        duration: s.
        events: LoadChange, HealthChange and FaultChange of :mod:`apu_casadi.unit.events`.
        load: at the start.
    """
    from apu_casadi.unit.apu import Apu
    from apu_casadi.unit.multirate import simulate_joint

    apu = Apu()
    ds = simulate_joint(
        apu,
        duration=duration,
        load=load,
        events=events,
        dt=UNIT_STEP,
        exchange="corrected",
        waveform_dt=DT,
        solver="cvodes",
        rtol=RTOL,
        atol=ATOL,
    )
    t = ds["time_w"].values
    grid = np.arange(round(duration / DT) + 1) * DT
    k = np.minimum(np.searchsorted(t, grid - 1e-9), t.size - 1)
    values = {n: ds[n].values[k] for n in ELECTRICAL.names if n in ds}
    values["P_total"] = ds["P_inst"].values[k]
    values["w_r"] = np.interp(grid, ds["time"].values, apu.w_r(ds["N"].values))
    return Truth(grid, values)


def samples_of(
    truth: Truth,
    rng: np.random.Generator | None,
    *,
    sensors: SensorSet = ELECTRICAL,
    gains: Mapping[str, float] | None = None,
) -> dict[str, np.ndarray]:
    """Return what the sensors read.

    Args:
        truth: noise-free course.
        rng: draws the white noise; None for none.
        sensors: 1-sigma table.
        gains: relative gain error by sensor.
    """
    true = {n: truth.values[n] for n in _SAMPLED}
    return {"t": truth.t} | sensors.measure(true, rng, gains=gains)


def drawn_gains(rng: np.random.Generator, sensors: SensorSet = ELECTRICAL) -> dict[str, float]:
    """Draw the constant gain errors of all sensors, Gaussian, from their table."""
    return sensors.draw_gains(rng, GAIN_SENSORS)


def chances(
    truth: Truth,
    rng: np.random.Generator,
    *,
    h: np.ndarray | None = None,
    flux_sigma: Mapping[str, float] | None = None,
    flux_walk: float = 0.0,
) -> Truth:
    """Return a healthy truth with severities and with random fluxes added, by superposition.

    Terminal voltages stay; fluxes obey (5)-(7) with them, which are linear on the rotor's axes at
    constant speed, so that an initial deviation and noise add a response of their own, computed
    with the matrix exponential.  h_k draws h_k v_k / r_s more from the windings of phase k.

    Args:
        truth: a healthy course at constant speed, with fluxes and theta_e.
        rng: random numbers.
        h: severities, shape (3, K) or (3, 1).
        flux_sigma: standard deviations of the initial fluxes, Wb, by name.
        flux_walk: random walk of each flux, Wb/sqrt(s).
    """
    p = Generator().machine
    K = truth.t.size
    values = dict(truth.values)
    if flux_sigma or flux_walk:
        A = _flux_matrix(float(truth.values["w_r"][0]))
        Phi = scipy.linalg.expm(A * DT)
        sigma = np.array([(flux_sigma or {}).get(n, 0.0) for n in FLUXES.names])
        d = np.empty((6, K))
        d[:, 0] = sigma * rng.standard_normal(6)
        noise = flux_walk * math.sqrt(DT) * rng.standard_normal((6, K))
        for k in range(K - 1):
            d[:, k + 1] = Phi @ d[:, k] + noise[:, k]
        i = currents(p, Windings(*d))
        stator = qd0_to_abc(truth.values["theta_e"], Qd0(i.sq, i.sd, i.s0))
        for n, row in zip(FLUXES.names, d, strict=True):
            values[n] = values[n] + row
        for phase, di in zip(PHASES, stator, strict=True):
            values[f"i_{phase}"] = values[f"i_{phase}"] + di
        values["i_fd"] = values["i_fd"] + i.fd
    if h is not None:
        for phase, hk in zip(PHASES, np.broadcast_to(h, (3, K)), strict=True):
            values[f"i_{phase}"] = values[f"i_{phase}"] - hk * values[f"v_{phase}"] / p.r_s
            values[f"h_{phase}"] = hk
    return Truth(truth.t, values)


@once
def _flux_matrix(w_r: float) -> np.ndarray:
    """d(d lambda/dt)/d lambda on the rotor's axes at a speed, 1/s, shape (6, 6)."""
    p = Generator().machine
    columns = []
    none = Qd0(0.0, 0.0, 0.0)
    for e in np.eye(6):
        lam = Windings(*e)
        still: dict[str, Any] = {"v": none, "V_fd": 0.0, "w1": none, "w2": (0.0, 0.0, 0.0)}
        r = flux_rates(p, lam=lam, i=currents(p, lam), w_r=w_r, **still)
        columns.append([float(x) for x in r])
    return np.array(columns).T
