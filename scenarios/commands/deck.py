"""Write a performance deck: steady points over altitude, Mach number, ISA deviation, shaft power.

An axis is FROM:TO:COUNT or a comma-separated list:

  apu deck --altitude 0:12000:13 --mach 0:0.8:9 --disa=-30:35:14 --power 0:5e5:60 --out deck.nc

Points that do not exist, or lie beyond a limit, are NaN; ``status`` says why.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

from apu_casadi.core.version import installed
from apu_casadi.gaspath.conditions import DEFAULT_DAY
from scenarios.commands import given
from scenarios.shell import jsontext, progress, usage

NAME = "deck"
HELP = "write a performance deck over altitude, Mach, ISA deviation and power"
OPTIONS = f"""
--altitude AXIS =0:12000:7 | m
--mach AXIS =0:0.8:5       | flight Mach number
--disa AXIS ={DEFAULT_DAY["dT_isa"]:g} | ISA deviation, K (default %(default)s)
--power AXIS               | shaft power, W (default: 11 values up to design power, 0:500e3:11)
--outputs A,B              | outputs to keep (default: all)
{given.UNIT}
--out FILE =deck.nc        | netCDF file
--threads int              | default: all cores
--json                     | print JSON
"""
LARGEST = 5_000_000  # points; outputs alone are then 1.8 GB


def run(args: argparse.Namespace) -> int:
    """Solve the grid and write it."""
    from apu_casadi.core import files, results
    from apu_casadi.core.cf import described
    from apu_casadi.core.errors import ScenarioError
    from apu_casadi.gaspath.steady.steadypoint import MEANING, Status
    from apu_casadi.gaspath.steady.trimbatch import performance_deck

    usage.count("--threads", args.threads, most=1024)
    options = {"altitude": "altitude", "Mach": "mach", "dT_isa": "disa", "PW": "power"}
    gg = given.engine(args, given.LIMITED)
    if args.power is None:
        args.power = f"0:{gg.rated_power:g}:11"
    axes: dict[str, Any] = {n: _axis(f"--{o}", getattr(args, o)) for n, o in options.items()}
    points = math.prod(len(v) for v in axes.values())
    if points > LARGEST:
        raise ScenarioError(
            f"{points} points asked for, {LARGEST} at most; take coarser axes, or several decks"
        )
    files.folder(Path(args.out).parent)
    keep = None if args.outputs is None else given.names(args.outputs)
    progress.tell(f"solving {points} points", quiet=args.json)
    t = time.perf_counter()
    how: dict[str, Any] = {"outputs": keep, "n_threads": args.threads, "limits": given.limits(args)}
    deck = performance_deck(gg, **axes, **how)
    t = time.perf_counter() - t
    deck.attrs |= {"apu_casadi_version": installed(), **given.own(args)}
    deck.attrs |= {k: json.dumps(v, ensure_ascii=False) for k, v in given.assumed(args).items()}
    results.save(described(deck, "performance deck"), args.out)
    status = deck["status"].values
    counts = {MEANING[s]: int((status == s).sum()) for s in Status if (status == s).any()}
    if args.json:
        report = {"points": points, "seconds": t, "counts": counts, "file": args.out}
        jsontext.show(report | {"axes": axes, "assumed": dict(deck.attrs)})
        return 0
    print(f"{points} points in {t:.2f} s ({1e6 * t / points:.0f} us each)")
    for name, n in counts.items():
        print(f"  {name:<24}{n:8d}")
    a = deck.attrs
    health = all(a[n] == 1.0 for n in gg.THETA.names)
    print(
        f"speed {a['N'] * 30 / math.pi:.1f} r/min, {'healthy' if health else 'faulty'} engine, "
        f"war = {a['war']:g}, ISA deviation "
        + ", ".join(f"{v:g}" for v in axes["dT_isa"])
        + f" K; {given.program(args)}"
    )
    print(f"written: {args.out}")
    return 0


def _axis(option: str, text: str) -> list[float]:
    """Read FROM:TO:COUNT or a list."""
    import numpy as np

    from apu_casadi.core.errors import ScenarioError

    wrong = ScenarioError(f"{option}: values must be finite and differ, got {text!r}")
    try:
        if ":" in text:
            start, end, number = text.split(":")
            first, last, count = float(start), float(end), int(number)
        else:
            values = np.array([float(v) for v in text.split(",")])
            first, last, count = values[0], values[-1], values.size
        if count < 1:
            raise ValueError
    except ValueError:
        raise ScenarioError(
            f"{option}: FROM:TO:COUNT or a list of numbers is expected, got {text!r}"
        ) from None
    if count > LARGEST:
        raise ScenarioError(f"{option}: {count} points asked for, {LARGEST} at most in a deck")
    if not (math.isfinite(first) and math.isfinite(last) and math.isfinite(last - first)):
        raise wrong
    if ":" in text:
        values = np.linspace(first, last, count)
    if not np.all(np.isfinite(values)) or np.unique(values).size != values.size:
        raise wrong
    return [float(v) for v in values]
