"""Make labelled data sets of many units, and baselines of predictions about them.

  apu dataset make --units 1000 --out data
  apu dataset make my.toml --out data --cluster tcp://host:8786
  apu dataset baseline thresholds --dataset data --out predictions.csv
  apu score predictions.csv --dataset data

A recipe says how many units and runs, classes, sizes, spreads and splits; apu dataset recipe prints
the reference one.  A folder that was interrupted is gone on with by the same command.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable

from scenarios.shell import jsontext, usage
from scenarios.shell.progress import bar

NAME = "dataset"
HELP = "make labelled data sets (make), print the recipe, predict by baselines"
_MAKE = """
recipe FILE ?              | a recipe; default: the reference one
--units int N              | number of units, instead of the recipe's
--seed int N               | of all random numbers, instead of the recipe's
--out DIR =results/dataset | folder of the data set (default %(default)s)
--workers int N            | processes (default: all cores)
--cluster ADDRESS          | Dask scheduler whose workers make the units
--json                     | print JSON
--quiet                    | no progress bar
"""
_BASELINE = """
name {chance,thresholds,forest,estimators} | forest needs scikit-learn
--dataset DIR =results/dataset | the data set (default %(default)s)
--out FILE =predictions.csv    | one row a run (default %(default)s)
--seed int N =1                | of the random numbers
--quiet                        | no progress bar
"""
_PAGE = """
--dataset DIR =results/dataset  | the data set (default %(default)s)
--page FILE =results/DATASET.md | the page, with figures in images/ beside it (default %(default)s)
--seed int N =1                 | of the random numbers of the baselines
--quiet                         | no progress bar
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the actions."""
    rows = (("make", _make, _MAKE), ("recipe", _recipe, ""), ("baseline", _base, _BASELINE))
    usage.actions(parser, (*rows, ("page", _page, _PAGE)))


run: Callable[[argparse.Namespace], int] = usage.act


def resume(args: argparse.Namespace) -> str:
    """Tell what an interruption leaves."""
    return "finished units are kept; the same command goes on with them"


def _make(args: argparse.Namespace) -> int:
    """Make a data set, or go on with one that was interrupted."""
    from scenarios.datasets.making import make_dataset
    from scenarios.datasets.recipe import read_recipe

    usage.count("--workers", args.workers, most=1024)
    usage.count("--units", args.units)
    r = read_recipe(args.recipe)
    own = {"units": args.units, "seed": args.seed}
    r = dataclasses.replace(r, **{k: v for k, v in own.items() if v is not None})
    t = time.perf_counter()
    show = not args.quiet and sys.stderr.isatty()
    with bar(NAME, r.units, show=show, unit="unit") as progress:
        how = {"workers": args.workers, "cluster": args.cluster, "progress": progress}
        status = make_dataset(r, args.out, **how)
    seconds = time.perf_counter() - t
    if args.json:
        jsontext.show({"out": args.out, "runs": status, "seconds": seconds})
        return 0
    print(
        f"{r.units} units in {seconds:.0f} s: " + ", ".join(f"{v} {k}" for k, v in status.items())
    )
    print(f"{args.out}: CARD.md tells what is in it")
    return 0


def _recipe(args: argparse.Namespace) -> int:
    """Print the reference recipe, to be changed."""
    from scenarios.datasets.recipe import reference

    print(reference(), end="")
    return 0


def _base(args: argparse.Namespace) -> int:
    """Predict the classes of a data set by a simple method."""
    from scenarios.datasets.baselines import predict, write_predictions

    with bar(args.name, 1, show=not args.quiet and sys.stderr.isatty()) as progress:
        made = predict(args.name, args.dataset, seed=args.seed, progress=progress)
    print(f"written: {write_predictions(made, args.out)}")
    return 0


def _page(args: argparse.Namespace) -> int:
    """Score all baselines and write docs/DATASET.md, or another page; forest needs scikit-learn."""
    from scenarios.datasets.baselines import METHODS
    from scenarios.datasets.page import write_page

    show = not args.quiet and sys.stderr.isatty()
    with bar("page", len(METHODS), show=show) as progress:
        told = lambda name, share: progress(METHODS.index(name) + share, len(METHODS))  # noqa: E731
        made = write_page(args.dataset, args.page, seed=args.seed, progress=told)
    print(*(f"written: {p}" for p in made), sep="\n")
    return 0
