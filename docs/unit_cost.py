"""Print what a unit of other numbers costs: ``python docs/unit_cost.py [UNITS] [WHAT ...]``.

WHAT are names of uses below, all by default; memory is watched over UNITS of other numbers.  Times
are of the processor, but for the first use of all, in which the compiler runs.
"""

import resource
import sys
import time
from collections.abc import Callable

import numpy as np

from apu_casadi import Apu, SeriesLoad, simulate_joint
from apu_casadi.core.simulation import stepper
from apu_casadi.unit.averaged import joint_vectors
from apu_casadi.unit.linearisation import (
    linearise_gas_generator,
    linearise_generator,
    linearise_joint,
)
from apu_casadi.unit.monolithic import simulate_monolithic
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.apu.gaspath import gas_path_filter
from estimators.apu.joint import electrical_samples, estimate_joint
from estimators.filters.ekf import extended_kalman_filter

CHANGES = {
    "machine.r_s": 0.005,
    "machine.L_md": 0.23e-3,
    "gas_generator.eta_c": 0.84,
    "gas_generator.J": 0.06,
    "compressor_map.n_Re": 0.17,
    "governor.Kp": 0.4,
}
LOAD = SeriesLoad.from_power(100e3)
# measured along a run of the default unit, whatever unit a filter takes it for
TRUTH = simulate_joint(Apu(), duration=0.2, load=LOAD, waveform_dt=1e-4)
TERMINALS = electrical_samples(TRUTH, Apu(), np.random.default_rng(1))


def joint_run(unit: Apu) -> None:
    """A joint run of 0.2 s without waveforms."""
    simulate_joint(unit, duration=0.2, load=LOAD, waveform_dt=None)


def ramped_speed(unit: Apu) -> None:
    """The same of 0.04 s with the predicted exchange: the machine's speed ramps."""
    simulate_joint(unit, duration=0.04, load=LOAD, waveform_dt=None, exchange="predicted")


def one_model(unit: Apu) -> None:
    """The monolithic model over 0.02 s."""
    simulate_monolithic(unit, duration=0.02, load=LOAD)


def gas_path(unit: Apu) -> None:
    """The gas-path filter over 0.2 s."""
    filt = gas_path_filter(unit.gas_generator)
    filt.run(filt.recording(TRUTH, 1))


def electrical(unit: Apu) -> None:
    """The electrical filter over 0.2 s."""
    filt = electrical_filter(unit.generator.machine)
    prior, data = filt.prior(TERMINALS), filt.recording(TERMINALS)
    extended_kalman_filter(filt.model, prior, data)


def joint_estimate(unit: Apu) -> None:
    """The coupled filters over 0.2 s."""
    estimate_joint(TRUTH, 1, apu=unit)


def linear(unit: Apu) -> None:
    """Three linear models: gas generator, generator, unit."""
    point = unit.steady_state(LOAD)
    linearise_gas_generator(unit.gas_generator, point.gas)
    linearise_generator(unit.generator, point.generator)
    linearise_joint(unit, point)


def averaged(unit: Apu) -> None:
    """The averaged unit over 0.02 s."""
    ss, x, u, theta = joint_vectors(unit, unit.steady_state(LOAD))
    stepper(ss, 2)(x, u, theta, 0.02)


WHAT: dict[str, Callable[[Apu], None]] = {
    f.__name__: f
    for f in (
        joint_run,
        ramped_speed,
        one_model,
        gas_path,
        electrical,
        joint_estimate,
        linear,
        averaged,
    )
}


def cost(use: Callable[[Apu], None], unit: Apu) -> float:
    """Return the processor's time that a use of a unit takes, ms."""
    t = time.process_time()
    use(unit)
    return 1e3 * (time.process_time() - t)


def main(units: int, names: list[str]) -> None:
    """Compile, then time first and repeated uses of changed units, then count memory."""
    for name in names:
        use = WHAT[name]
        began = time.perf_counter()
        use(Apu())
        print(f"{name}: compiling, or loading: {time.perf_counter() - began:.1f} s", flush=True)
        for key, value in CHANGES.items():
            unit = Apu().change({key: value})
            first, again = cost(use, unit), min(cost(use, unit) for _ in range(5))
            print(f"{name}, {key} = {value:g}: first {first:.0f} ms, repeated {again:.0f} ms")
    for k in range(units):
        numbers = {"machine.r_s": 0.004 + 1e-6 * k, "gas_generator.eta_c": 0.84 + 1e-5 * k}
        for name in names:
            WHAT[name](Apu().change(numbers))
        if k % max(1, units // 10) == 0 or k == units - 1:
            used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(f"{k + 1} units: {used:.0f} MiB at most", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 0, sys.argv[2:] or [*WHAT])
