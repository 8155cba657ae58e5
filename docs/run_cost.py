"""Print what joint runs cost beside others: ``python docs/run_cost.py [REPEATS]``.

Ratios of the processor's time of two runs in turn, the least of several, so that what else the
machine does counts little; the first runs, which compile, are not among them.
"""

import cProfile
import pstats
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from apu_casadi.core.backend import OFTEN
from apu_casadi.core.profiles.profile import varying
from apu_casadi.core.profiles.shapes import Growth
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.multirate import simulate_joint
from scenarios.registry import get, unit_for

Case = tuple[str, dict[str, Any]]
BARE: dict[str, Any] = {"waveform_dt": None}
JOINT: Case = ("joint", BARE)
#: As ``JOINT``, with another number in one machine: all that is computed is computed twice.
APART = "joint, r_s of generator 2 changed"
#: As ``JOINT``, with four equal generators that carry half of the loads each.
FOUR = "joint, four equal generators"
PAIRS: dict[str, tuple[Case, Case]] = {
    "four equal generators over two": ((FOUR, BARE), JOINT),
    "they with waveforms": ((FOUR, {}), ("joint", {})),
    "two different generators over equal ones": (("joint_one_machine", BARE), JOINT),
    "the same with waveforms": (("joint_one_machine", {}), ("joint", {})),
    "two that differ throughout over equal ones": ((APART, BARE), JOINT),
    "two that differ throughout, with waveforms": ((APART, {}), ("joint", {})),
    "with phasors over without": (("joint", {**BARE, "phasors": True}), JOINT),
    "with waveforms over without": (("joint", {}), JOINT),
}

#: Runs before: each has a step or two right after a switch, which are compiled when asked often.
WARM = OFTEN // 2 + 1
HALF = [SeriesLoad.from_power(112.5e3), SeriesLoad.from_power(50e3)]


def prepared(name: str, **more: Any) -> Callable[[], Any]:
    """Return the call that runs a scenario of the library."""
    s = get("joint" if name in (APART, FOUR) else name)
    unit, start, events = unit_for(s), s.start(), s.events()
    if name == FOUR:
        unit, start = unit.change({"generator.count": 4}), {**start, "load": HALF[0]}
        changes = iter(HALF[1:])
        events = [replace(e, load=next(changes)) if hasattr(e, "load") else e for e in events]
    if name == APART:
        unit = unit.change({"generator2.machine.r_s": 1.05 * unit.generators[1].machine.r_s})
    given = {"ambient": s.ambient, "waveform_dt": s.waveform_dt, "dt": s.dt, **more}
    return lambda: simulate_joint(unit, duration=s.duration, **start, events=events, **given)


def least(calls: list[Callable[[], Any]], repeats: int) -> list[float]:
    """Return the least processor's time of each of some calls, s, which take turns."""
    times = [list[float]() for _ in calls]
    for call in calls:
        for _ in range(WARM):
            call()
    for _ in range(repeats):
        for call, own in zip(calls, times, strict=True):
            began = time.process_time()
            call()
            own.append(time.process_time() - began)
    return [min(own) for own in times]


def growing() -> Callable[[], Any]:
    """Return the call that runs the climb with a short circuit that grows from h = 1e-5."""
    s, fault = get("climb"), varying(Ttsc.of_h, 0.05, Growth(1e-5, 5e-3, over=1800.0))
    start, given = {**s.start(), "fault": fault}, {"ambient": s.ambient, "events": s.events()}
    unit = unit_for(s)
    return lambda: simulate_joint(unit, duration=s.duration, waveform_dt=None, **start, **given)


#: What long runs spend their time in: functions by file, each without the others of the list.
SHARES = {
    "compiled code": ("calling", "__call__"),
    "tables of transition matrices": ("transition", "transition_table"),
    "numbers along profiles": ("course", "at"),
    "CVODES": ("simulation", "__call__"),
}


def shares(call: Callable[[], Any]) -> str:
    """Return in words what a call spends its processor's time in."""
    profile = cProfile.Profile(time.process_time)
    profile.runcall(call)
    stats: Any = pstats.Stats(profile)
    found = {
        what: sum(row[3] for key, row in stats.stats.items() if (Path(key[0]).stem, key[2]) == of)
        for what, of in SHARES.items()
    }
    found["the rest of Python"] = stats.total_tt - sum(found.values())
    return ", ".join(f"{what} {100 * t / stats.total_tt:.0f} %" for what, t in found.items())


def main(repeats: int) -> None:
    """Print the pairs, and what long runs with profiles take when all is compiled."""
    warnings.simplefilter("ignore")
    for what, pair in PAIRS.items():
        a, b = least([prepared(name, **more) for name, more in pair], repeats)
        print(f"{what}: {a / b:.2f} ({1e3 * a:.0f} ms over {1e3 * b:.0f} ms)", flush=True)
    minutes = get("climb").duration / 60
    for what, call in {"climb": prepared("climb"), "with a growing fault": growing()}.items():
        known = shares(call)  # the first run, which makes the tables
        (t,) = least([call], 1)
        print(f"{what}: {t:.1f} s for {minutes:.0f} min; the first time: {known}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
