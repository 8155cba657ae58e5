"""Print what joint runs cost beside others: ``python docs/run_cost.py [REPEATS]``.

Ratios of the processor's time of two runs in turn, the least of several, so that what else the
machine does counts little; the first runs, which compile, are not among them.
"""

import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

from apu_casadi.unit.multirate import simulate_joint
from scenarios.registry import get, unit_for

Case = tuple[str, dict[str, Any]]
BARE: dict[str, Any] = {"waveform_dt": None}
JOINT: Case = ("joint", BARE)
PAIRS: dict[str, tuple[Case, Case]] = {
    "two different generators over equal ones": (("joint_one_machine", BARE), JOINT),
    "the same with waveforms": (("joint_one_machine", {}), ("joint", {})),
    "with phasors over without": (("joint", {**BARE, "phasors": True}), JOINT),
    "with waveforms over without": (("joint", {}), JOINT),
}


def prepared(name: str, **more: Any) -> Callable[[], Any]:
    """Return the call that runs a scenario of the library."""
    s = get(name)
    unit, start, events = unit_for(s), s.start(), s.events()
    given = {"ambient": s.ambient, "waveform_dt": s.waveform_dt, "dt": s.dt, **more}
    return lambda: simulate_joint(unit, duration=s.duration, **start, events=events, **given)


def least(calls: list[Callable[[], Any]], repeats: int) -> list[float]:
    """Return the least processor's time of each of some calls, s, which take turns."""
    times = [list[float]() for _ in calls]
    for call in calls:
        call()
    for _ in range(repeats):
        for call, own in zip(calls, times, strict=True):
            began = time.process_time()
            call()
            own.append(time.process_time() - began)
    return [min(own) for own in times]


def main(repeats: int) -> None:
    """Print the pairs, and what a long run with profiles takes when its tables are known."""
    warnings.simplefilter("ignore")
    for what, pair in PAIRS.items():
        a, b = least([prepared(name, **more) for name, more in pair], repeats)
        print(f"{what}: {a / b:.2f} ({1e3 * a:.0f} ms over {1e3 * b:.0f} ms)", flush=True)
    (t,) = least([prepared("climb")], 1)
    print(f"climb: {t:.1f} s for {get('climb').duration / 60:.0f} min")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
