"""Measure times against their targets, with the accuracy of every answer beside them.

Takes some minutes, the campaign of 1000 runs most of them; ``--only`` and ``--runs`` do less.
``--peers`` adds dpsim (machine) and pyCycle (trim) where they are installed.

  apu bench --only trim,joint
  apu bench --page BENCHMARKS.md

The page has its plot in docs/images beside it.  Exit status 1 when an answer is inaccurate; a
missed time is no failure, since it depends on the machine.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from pathlib import Path

from scenarios.commands import given
from scenarios.shell import jsontext, usage

NAME = "bench"
HELP = "measure times and their accuracy (takes minutes)"
OPTIONS = """
--only A,B              | parts to measure, comma separated
--list                  | list the parts and stop
--peers                 | also measure dpsim and pyCycle
--pycycle-python PYTHON | a Python that has pyCycle, for --peers
--runs int              | joint runs of the campaign (default 1000)
--json                  | print JSON only
--page FILE             | also write the page, BENCHMARKS.md
--quiet                 | do not say what is being measured
"""


def run(args: argparse.Namespace) -> int:
    """Measure, print, write."""
    from scenarios import registry
    from scenarios.bench import benchmarks
    from scenarios.bench.linearity import write_plot
    from scenarios.bench.measuring import Size
    from scenarios.shell import markdown

    if args.list:
        print("\n".join(benchmarks.known()))
        return 0
    usage.count("--runs", args.runs)
    if args.pycycle_python:
        os.environ["APU_PYCYCLE_PYTHON"] = args.pycycle_python
    size = Size()
    if args.runs is not None:
        size = dataclasses.replace(size, runs=args.runs)
    names = None
    if args.only is not None:
        names = given.names(args.only)
        names += [n for n in benchmarks.parts(peers=True) if args.peers and n not in names]
    if args.page:
        registry.prepare(Path(args.page).parent)
    show = not args.quiet and not args.json and sys.stderr.isatty()

    def say(name: str) -> None:
        print(f"measuring {name} ...", file=sys.stderr)

    report = benchmarks.run(names, size=size, peers=args.peers, say=say if show else None)
    made = []
    if args.page:
        page, image = Path(args.page), None
        if report.curves:
            image = "docs/images/bench_linear.png"
            made.append(write_plot(report.curves, size, page.parent / image))
        made.append(markdown.write_text(page, benchmarks.page(report, image)))
    if args.json:
        jsontext.show(report.to_dict())
    else:
        print(benchmarks.table(report))
        if made:
            given.written(made)
    return 0 if all(r.accurate for rows in report.rows.values() for r in rows) else 1
