"""Run many joint scenarios with random faults over all cores, and collect their summaries.

Health factors, severity (mu, k_rf, kappa), phase and time of the short circuit are drawn at random;
with --growing a share of the faults grows instead of stepping.
Each finished run is kept in DIR/runs.jsonl at once: after an interruption the same command goes on.
The result is DIR/campaign.nc, with the reason of every run that was refused.  While another
campaign works in DIR this one waits, and takes over what that one has done.

  apu campaign --runs 1000 --seed 1 --out results/campaign
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenarios.commands import given
from scenarios.shell import guard, jsontext, usage
from scenarios.shell.progress import bar

if TYPE_CHECKING:
    import xarray as xr

NAME = "campaign"
HELP = "run many joint scenarios with random faults"
OPTIONS = f"""
--runs int =1000       | number of runs (default 1000)
--seed int =0          | of the random numbers (default 0)
--base SCENARIO =joint | scenario that is varied (joint)
--growing float SHARE =0.0 | share of the faults that grow, 0 to 1; the others are steps (default 0)
{given.WHOLE}
--workers int          | processes (default: all cores)
--out DIR =results/campaign | folder (results/campaign)
--fresh                | do not take up what DIR already has
--waveforms            | keep the full dataset of each run (large)
--no-wait              | refuse when another campaign works in DIR
--json                 | print JSON
--quiet                | no progress bar
"""


def resume(args: argparse.Namespace) -> str:
    """Tell what an interruption leaves."""
    return f"finished runs are kept in {args.out}; the same command, without --fresh, goes on"


def run(args: argparse.Namespace) -> int:
    """Run the campaign; status 0 even if runs were refused, which the result tells."""
    from scenarios import campaigns

    usage.count("--runs", args.runs)
    usage.count("--workers", args.workers, most=1024)
    base = given.scenario(args, args.base)
    runs = campaigns.random_faults(args.runs, args.seed, base=base, growing=args.growing)
    t = time.perf_counter()
    kept = 0

    def progress(done: int, total: int) -> None:
        nonlocal kept
        kept = done
        move(done, total)

    def say(sentence: str) -> None:
        print(f"apu: {sentence}", file=sys.stderr, flush=True)

    how: dict[str, Any] = {"workers": args.workers, "out": args.out, "progress": progress}
    how |= {"summary_only": not args.waveforms, "resume": not args.fresh, "wait": not args.no_wait}
    show = not args.quiet and sys.stderr.isatty()
    try:
        with bar(NAME, args.runs, show=show, unit="run") as move:
            ds = campaigns.run_campaign(runs, say=say, **how)
    except KeyboardInterrupt:
        again = "the same command without --fresh" if args.fresh else "the same command"
        guard.note(f"{kept} of {args.runs} runs are kept in {args.out}; {again} goes on with them")
        raise
    t = time.perf_counter() - t
    report = {"runs": args.runs, "seed": args.seed, "seconds": t, "counts": campaigns.counts(ds)}
    report |= {k: v for k, v in (("engine", base.engine), ("governor", base.governor)) if v}
    report |= {"growing": args.growing} if args.growing else {}
    report |= {"base": base.name, "ambient": dataclasses.asdict(base.ambient)}
    report |= {"solver": ds.attrs["solver"], "exchange": base.exchange}
    report |= {"apu_casadi_version": ds.attrs["apu_casadi_version"], "reasons": _told(ds, "reason")}
    report |= {"warnings": _told(ds, "warnings"), "file": str(Path(args.out) / campaigns.DATASET)}
    if args.json:
        jsontext.show(report | given.assumed(args))
    else:
        _print(report)
    return 0


def _told(ds: xr.Dataset, name: str) -> dict[str, str]:
    """Return the texts of a variable by run, without those that have nothing to tell."""
    texts = zip(ds["run"].values, ds[name].values, strict=True)
    return {str(run): str(text) for run, text in texts if text != "-"}


def _print(r: dict[str, Any]) -> None:
    from apu_casadi.gaspath.conditions import day_words
    from scenarios.shell import notices

    counted = ", ".join(f"{v} {k}" for k, v in r["counts"].items() if v)
    print(f"{r['runs']} runs in {r['seconds']:.1f} s: {counted}")
    for name, why in list(r["reasons"].items())[:10]:
        print(f"  {name}: {why}")
    if len(r["reasons"]) > 10:
        print(f"  ... and {len(r['reasons']) - 10} more, in the file")
    notices.tell(f"{name}: {words}" for name, words in list(r["warnings"].items())[:10])
    if r["warnings"]:
        print(f"{len(r['warnings'])} runs come with warnings, in the file")
    unit = f"unit {r['engine']}, " if "engine" in r else ""
    grown = f"{100 * r['growing']:g} % of the faults grow, " if "growing" in r else ""
    print(
        f"{unit}base {r['base']}, seed {r['seed']}, {grown}{day_words(r['ambient'])}, "
        f"solver {r['solver']}, exchange {r['exchange']}, apu-casadi {r['apu_casadi_version']}"
    )
    print(f"written: {r['file']}")
