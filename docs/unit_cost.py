"""Print what a unit of other numbers costs: ``python docs/unit_cost.py [UNITS]``."""

import resource
import sys
import time

from apu_casadi import Apu, SeriesLoad, simulate_joint

CHANGES = {
    "machine.r_s": 0.005,
    "machine.L_md": 0.23e-3,
    "gas_generator.eta_c": 0.84,
    "gas_generator.J": 0.06,
    "compressor_map.n_Re": 0.17,
    "governor.Kp": 0.4,
}


def run(unit: Apu) -> float:
    """Return the time of a joint run of 0.2 s without waveforms, ms."""
    t = time.perf_counter()
    simulate_joint(unit, duration=0.2, load=SeriesLoad.from_power(100e3), waveform_dt=None)
    return 1e3 * (time.perf_counter() - t)


def main(units: int) -> None:
    """Compile, then time first and repeated runs of changed units, then count memory."""
    print(f"compiling, or loading: {run(Apu()) / 1e3:.1f} s")
    for name, value in CHANGES.items():
        unit = Apu().change({name: value})
        first, again = run(unit), min(run(unit) for _ in range(5))
        print(f"{name} = {value:g}: first run {first:.0f} ms, repeated {again:.0f} ms")
    for k in range(units):
        run(Apu().change({"machine.r_s": 0.004 + 1e-6 * k, "gas_generator.eta_c": 0.84 + 1e-5 * k}))
        if k % max(1, units // 10) == 0:
            used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            print(f"{k} units: {used:.0f} MiB at most", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 0)
