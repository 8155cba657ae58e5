"""How is measured: how much, what a row says, times, processes of their own; parts by name."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from typing import TYPE_CHECKING, Any

from apu_casadi.core.errors import SimulationError
from apu_casadi.core.sharing import once
from scenarios import registry
from scenarios.schema import Scenario
from scenarios.shell.registered import Registry

if TYPE_CHECKING:
    from apu_casadi.unit.apu import Apu


@dataclass(frozen=True)
class Size:
    """How much is measured; the default is what the targets ask for.

    Args:
        trims, batch: single trims, points of a batch.
        deck: points along altitude, Mach, ISA deviation, power.
        calls: calls of f and g with Jacobians, and of the linearisation a tenth of them.
        joint: the joint scenario that is timed.
        repeats: timings of each, of which the median counts.
        runs, checked: runs of the campaign, and how many of them CVODES runs again.
        hour: duration of the long run, s.
        durations, counts, rates: of the linearity plot: s, runs (each has faults of its own, which
            cost more or less; many even that out), samples per second.  Waveforms below 20 kHz are
            computed at 20 kHz and thinned, so lower rates cost what that costs.
    """

    trims: int = 300
    batch: int = 10_000
    deck: tuple[int, int, int, int] = (10, 10, 10, 100)
    calls: int = 3000
    joint: Scenario = dataclasses.field(default_factory=lambda: registry.get("joint"))
    repeats: int = 5
    runs: int = 1000
    checked: int = 2
    hour: float = 3600.0
    durations: tuple[float, ...] = (14.0, 28.0, 56.0, 84.0, 112.0)
    counts: tuple[int, ...] = (8, 16, 32, 64, 96)
    rates: tuple[float, ...] = (0.0, 20e3, 40e3, 60e3, 80e3)


@dataclass(frozen=True)
class Row:
    """One measured quantity.

    Args:
        what: in words.
        value, unit: the figure; a time, a multiple of real time, or a size.
        target: what it should be at most, or at least where ``more``; None without one.
        error, error_target: accuracy of the answers that were timed, and what it may be.
        measure: what the error is, in words.
        peer, ratio: what it was compared with, and how many times faster than that.
    """

    what: str
    value: float
    unit: str
    target: float | None
    error: float
    error_target: float
    measure: str
    more: bool = False
    peer: str = ""
    ratio: float | None = None

    @property
    def accurate(self) -> bool:
        """Whether the error is what it may be; NaN is not."""
        return self.error <= self.error_target

    @property
    def met(self) -> bool:
        """Whether figure and accuracy are both as they should be."""
        if self.target is None:
            return self.accurate
        fast = self.value >= self.target if self.more else self.value <= self.target
        return fast and self.accurate


def timed(call: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Return the median time of some calls, s, and the last result."""
    times = []
    result = None
    for _ in range(repeats):
        t = time.perf_counter()
        result = call()
        times.append(time.perf_counter() - t)
    return median(times), result


@once
def apu() -> Apu:
    """Return the paper's unit, one for all parts."""
    from apu_casadi.unit.apu import Apu

    return Apu()


Part = Callable[[Size], list[Row]]
PARTS: Registry[tuple[bool, Part]] = Registry("scenarios.bench", "part")
"""Parts by name, each with whether it measures another program."""


def part(name: str, order: float, *, peer: bool = False) -> Callable[[Part], Part]:
    """Register a part; ``peer``: it needs another program, and is asked for."""

    def register(function: Part) -> Part:
        PARTS.add(name, order, (peer, function))
        return function

    return register


def python(code: str, stdin: str | None = None, **env: str) -> str:
    """Run code in a new process; return what it prints.

    Raises:
        SimulationError: it failed.
    """
    how: dict[str, Any] = {"capture_output": True, "text": True, "check": False, "timeout": 1800}
    how["env"] = {**os.environ, **env}
    command = [sys.executable, "-c", code]
    done: subprocess.CompletedProcess[str] = subprocess.run(command, input=stdin, **how)
    if done.returncode:
        raise SimulationError(f"a process of the benchmark failed: {done.stderr.strip()[-500:]}")
    return done.stdout


def child(
    function: Callable[[dict[str, Any]], dict[str, Any]], case: dict[str, Any], **env: str
) -> dict[str, Any]:
    """Call a function of a module with ``case`` in a new process; return its answer."""
    module, name = function.__module__, function.__name__
    code = (
        f"import json, sys; from {module} import {name}\n"
        f"print(json.dumps({name}(json.load(sys.stdin))))"
    )
    answer: dict[str, Any] = json.loads(python(code, json.dumps(case), **env).splitlines()[-1])
    return answer
