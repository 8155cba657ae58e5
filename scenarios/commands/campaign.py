"""Run many joint scenarios with random faults over all cores, and collect their summaries.

Health factors, severity (mu, k_rf, kappa), phase and time of the short circuit are drawn at random.
Each finished run is kept in DIR/runs.jsonl at once: after an interruption the same command goes on.
The result is DIR/campaign.nc, with the reason of every run that was refused.  While another
campaign works in DIR this one waits, and takes over what that one has done.

  apu campaign --runs 1000 --seed 1 --out results/campaign
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from scenarios.shell import guard, jsontext, usage

NAME = "campaign"
HELP = "run many joint scenarios with random faults"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--runs", type=int, default=1000, help="number of runs (default 1000)")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default 0)")
    parser.add_argument(
        "--base", default="joint", metavar="SCENARIO", help="scenario that is varied (joint)"
    )
    parser.add_argument("--workers", type=int, help="processes (default: all cores)")
    parser.add_argument(
        "--out", default="results/campaign", metavar="DIR", help="folder (results/campaign)"
    )
    parser.add_argument("--fresh", action="store_true", help="do not take up what DIR already has")
    parser.add_argument(
        "--waveforms", action="store_true", help="keep the full dataset of each run (large)"
    )
    parser.add_argument(
        "--no-wait", action="store_true", help="refuse when another campaign works in DIR"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")


def resume(args: argparse.Namespace) -> str:
    """Tell what an interruption leaves."""
    return f"finished runs are kept in {args.out}; the same command, without --fresh, goes on"


def run(args: argparse.Namespace) -> int:
    """Run the campaign; status 0 even if runs were refused, which the result tells."""
    from pathlib import Path

    from apu_casadi.gaspath.conditions import day_words
    from scenarios import campaigns, registry
    from scenarios.shell import notices

    usage.count("--runs", args.runs)
    usage.count("--workers", args.workers, most=1024)
    runs = campaigns.random_faults(args.runs, args.seed, base=registry.get(args.base))
    t = time.perf_counter()
    kept = 0

    def progress(done: int, total: int) -> None:
        nonlocal kept
        kept = done
        move(done, total)

    def say(sentence: str) -> None:
        print(f"apu: {sentence}", file=sys.stderr, flush=True)

    try:
        with _bar(args.runs, show=not args.quiet and sys.stderr.isatty()) as move:
            ds = campaigns.run_campaign(
                runs, workers=args.workers, out=args.out, summary_only=not args.waveforms,
                progress=progress, resume=not args.fresh, wait=not args.no_wait, say=say,
            )  # fmt: skip
    except KeyboardInterrupt:
        again = "the same command without --fresh" if args.fresh else "the same command"
        guard.note(f"{kept} of {args.runs} runs are kept in {args.out}; {again} goes on with them")
        raise
    t = time.perf_counter() - t
    n = campaigns.counts(ds)
    reasons = {
        str(name): str(why)
        for name, why, s in zip(*(ds[k].values for k in ("run", "reason", "status")), strict=True)
        if s
    }
    warned = {
        str(name): str(words)
        for name, words in zip(ds["run"].values, ds["warnings"].values, strict=True)
        if words != "-"
    }
    base = registry.get(args.base)
    made = {
        "base": base.name, "ambient": dataclasses.asdict(base.ambient),
        "solver": ds.attrs["solver"], "exchange": base.exchange,
        "apu_casadi_version": ds.attrs["apu_casadi_version"],
    }  # fmt: skip
    path = Path(args.out) / campaigns.DATASET
    if args.json:
        report = {"runs": args.runs, "seed": args.seed, "seconds": t, "counts": n}
        report |= {**made, "reasons": reasons, "warnings": warned, "file": str(path)}
        jsontext.show(report)
        return 0
    print(f"{args.runs} runs in {t:.1f} s: " + ", ".join(f"{v} {k}" for k, v in n.items() if v))
    for name, why in list(reasons.items())[:10]:
        print(f"  {name}: {why}")
    if len(reasons) > 10:
        print(f"  ... and {len(reasons) - 10} more, in the file")
    for name, words in list(warned.items())[:10]:
        notices.tell([f"{name}: {words}"])
    if warned:
        print(f"{len(warned)} runs come with warnings, in the file")
    print(
        f"base {base.name}, seed {args.seed}, {day_words(made['ambient'])}, solver "
        f"{made['solver']}, exchange {base.exchange}, apu-casadi {made['apu_casadi_version']}"
    )
    print(f"written: {path}")
    return 0


@contextmanager
def _bar(total: int, *, show: bool) -> Iterator[Callable[[int, int], None]]:
    """Yield a callback that moves a progress bar on stderr, or does nothing."""
    if not show:
        yield lambda done, total: None
        return
    from tqdm import tqdm

    columns = min(shutil.get_terminal_size((80, 24)).columns, 100)
    with tqdm(total=total, desc=NAME, unit="run", ncols=columns, file=sys.stderr) as bar:

        def progress(done: int, _: int) -> None:
            bar.update(done - bar.n)

        yield progress
