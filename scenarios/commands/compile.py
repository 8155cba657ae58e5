"""Compile the hot functions ahead of time, so that nothing is compiled at first use.

The libraries go to the folder that $APU_CACHE_DIR names, by default ~/.cache/apu_casadi.
"""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

from scenarios.commands import given
from scenarios.shell import jsontext

NAME = "compile"
HELP = "compile the hot functions to C libraries ahead of time"
OPTIONS = """
--clear    | delete the libraries and stop
--only A,B | groups to compile, comma separated
--json     | print JSON
"""

HOT: tuple[tuple[str, str], ...] = (
    ("gas_generator", "scenarios.commands.compile:gas_generator_functions"),
    ("trim", "apu_casadi.gaspath.steady.trimsolver:hot_functions"),
    ("joint", "scenarios.commands.compile:joint_functions"),
)
"""(name, "module:callable"); the callable compiles its functions and returns their names."""


def resume(args: argparse.Namespace) -> str:
    """Tell what an interruption leaves."""
    return "what was compiled is kept; the same command goes on"


def run(args: argparse.Namespace) -> int:
    """Compile every group; return 1 if there is no compiler."""
    from importlib import import_module

    from apu_casadi.core import backend, cachefolder
    from apu_casadi.core.errors import BackendError, nearest

    if args.clear:
        n = cachefolder.clear_cache()
        if args.json:
            jsontext.show({"deleted": n})
        else:
            print(f"{n} libraries deleted")
        return 0
    groups = dict(HOT)
    only = given.names(args.only) if args.only else list(groups)
    for name in only:
        if name not in groups:
            raise BackendError(f"--only: unknown group {name!r} {nearest(name, groups)}")
    folder, compiler = backend.cache_folder(), backend.find_compiler()
    if backend.backend_in_use() == "vm" or folder is None:
        print(
            "apu: no C compiler found, or APU_BACKEND=vm, or no folder to write to: everything "
            "runs in CasADi's virtual machine",
            file=sys.stderr,
        )
        return 1
    rows = []
    for group in only:
        module, _, function = groups[group].partition(":")
        t = time.perf_counter()
        names = getattr(import_module(module), function)()
        rows.append({"group": group, "functions": names, "seconds": time.perf_counter() - t})
        if not args.json:
            print(f"{group:<12} {len(names):3d} functions  {rows[-1]['seconds']:6.1f} s")
    if args.json:
        out = {"folder": str(folder), "compiler": compiler, "groups": rows}
        jsontext.show(out)
    else:
        print(f"in {folder}")
    return 0


def gas_generator_functions() -> list[str]:
    """Compile state update, output and their combination for engines of the default structure."""
    from apu_casadi.core.backend import compiled
    from apu_casadi.gaspath.gasgenerator import GasGenerator

    family = GasGenerator().family
    return [str(compiled(f).name()) for f in (family.f, family.g, family.step)]


def joint_functions() -> list[str]:
    """Compile what joint runs by exact propagation use, with healthy and faulted machines."""
    from apu_casadi.core.backend import loaded_functions
    from apu_casadi.machine.faults.ttsc import Ttsc
    from apu_casadi.machine.loads.series import SeriesLoad
    from apu_casadi.unit.apu import Apu
    from apu_casadi.unit.events import FaultChange
    from apu_casadi.unit.multirate import simulate_joint

    apu, load = Apu(), SeriesLoad.from_power(100e3)
    for waveform_dt in (50e-6, None):
        faults = Ttsc(0.05, 20.0), Ttsc(0.05, 1.0, 1.0)
        for fault, number in (*((f, None) for f in faults), (faults[0], 2)):
            events = [FaultChange(0.1 if number else 0.3, fault, number)]
            how: dict[str, Any] = {"solver": "propagator", "waveform_dt": waveform_dt}
            simulate_joint(apu, duration=0.4, load=load, events=events, **how)
    return loaded_functions()
