"""List the scenarios of the library; run one with ``apu run NAME``."""

from __future__ import annotations

import argparse

from scenarios.shell import jsontext

NAME = "list"
HELP = "list the scenarios of the library"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Print name, duration and title of every scenario."""
    from scenarios.registry import list_scenarios

    scenarios = list_scenarios()
    if args.json:
        rows = [{"name": s.name, "duration": s.duration, "title": s.title} for s in scenarios]
        jsontext.show(rows)
        return 0
    width = max(len(s.name) for s in scenarios)
    for s in scenarios:
        print(f"{s.name:<{width}}  {s.duration:4g} s  {s.title}")
    return 0
