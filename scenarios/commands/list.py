"""List the scenarios of the library; run one with ``apu run NAME``."""

from __future__ import annotations

import argparse

from scenarios.commands import given
from scenarios.shell import jsontext

NAME = "list"
HELP = "list the scenarios of the library"
OPTIONS = f"""
--json   | print JSON
--schema | print the JSON schema of a scenario file, for editors
{given.PARTS}
"""


def run(args: argparse.Namespace) -> int:
    """Print name, duration and title of every scenario."""
    from scenarios.registry import list_scenarios

    if args.schema:
        from scenarios.fileschema import file_schema

        given.parts(args)
        jsontext.show(file_schema())
        return 0
    scenarios = list_scenarios()
    if args.json:
        rows = [{"name": s.name, "duration": s.duration, "title": s.title} for s in scenarios]
        jsontext.show(rows)
        return 0
    width = max(len(s.name) for s in scenarios)
    for s in scenarios:
        print(f"{s.name:<{width}}  {s.duration:4g} s  {s.title}")
    return 0
