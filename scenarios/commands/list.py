"""List the scenarios of the library, and the units that come with the package.

Run a scenario with ``apu run NAME``; ``--engine NAME`` of most commands takes a unit.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping

from scenarios.commands import given
from scenarios.shell import jsontext

NAME = "list"
HELP = "list the scenarios of the library and the shipped units"
OPTIONS = f"""
--json   | print JSON
--engines | list the units alone
--engine NAME | print the file of a unit, with the source of every number: a start for your own
--schema | print the JSON schema of a scenario file, for editors
--engine-schema | print the JSON schema of an engine's file
{given.PARTS}
"""


def run(args: argparse.Namespace) -> int:
    """Print name, duration and title of every scenario."""
    from apu_casadi.unit import shippedunits
    from scenarios.registry import list_scenarios

    if args.schema or args.engine_schema:
        from scenarios.fileschema import engine_schema, file_schema

        given.parts(args)
        jsontext.show(file_schema() if args.schema else engine_schema())
        return 0
    if args.engine is not None:
        print(shippedunits.unit_path(args.engine).read_text(encoding="utf-8"), end="")
        return 0
    units = shippedunits.titles()
    if args.engines:
        if args.json:
            jsontext.show([{"name": n, "title": title} for n, title in units.items()])
        else:
            print(*_lines(units), sep="\n")
        return 0
    scenarios = list_scenarios()
    if args.json:
        rows = [{"name": s.name, "duration": s.duration, "title": s.title} for s in scenarios]
        jsontext.show(rows)
        return 0
    width = max(len(s.name) for s in scenarios)
    for s in scenarios:
        print(f"{s.name:<{width}}  {s.duration:4g} s  {s.title}")
    print("\nunits, for --engine NAME:", *_lines(units), sep="\n")
    return 0


def _lines(units: Mapping[str, str]) -> list[str]:
    width = max(map(len, units))
    return [f"{name:<{width}}  {title}" for name, title in units.items()]
