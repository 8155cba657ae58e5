"""Run a numerical study; ``apu study trim`` trims random points of the flight envelope.

Exit status 1 when a point is wrong or refused without a reason.
"""

from __future__ import annotations

import argparse

from scenarios.shell import jsontext, progress

NAME = "study"
HELP = "run a numerical study (trim)"
OPTIONS = """
study {trim}        | which study
--points int =10000 | random points (default 10000)
--seed int =1       | of the random points (default 1)
--threads int       | default: all cores
--json              | print JSON
"""


def run(args: argparse.Namespace) -> int:
    """Run the study and print its table."""
    from scenarios.shell import usage
    from scenarios.studies import trim_study

    usage.count("--points", args.points, most=10_000_000)
    usage.count("--threads", args.threads, most=1024)
    usage.count("--seed", args.seed, least=0, most=(1 << 63) - 1)
    progress.tell(f"trimming {args.points} points", quiet=args.json)
    report = trim_study.run(args.points, args.seed, n_threads=args.threads)
    if args.json:
        jsontext.show(report)
    else:
        print(trim_study.table(report))
    return 1 if report.wrong or report.unexplained else 0
