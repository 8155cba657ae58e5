"""The subcommands of ``apu``, one module each.

A module has ``NAME``, ``HELP`` and ``OPTIONS`` (texts, the last as
:func:`scenarios.shell.usage.declare` reads it) and ``run(args) -> int``, the exit status.  Where it
has subcommands of its own, ``add_arguments(parser)`` stands for the options; where an interruption
leaves more than finished files, ``resume(args) -> str`` tells what is kept and how to go on.  It
imports anything heavy inside ``run``, so that the other commands start quickly.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from scenarios.shell import usage

_NAMES = """
bench calibrate campaign dataset linearise compile completion deck errata estimate export fit
identify list maps measure multirate run score study trim tune validate
"""
MODULES = tuple(f"scenarios.commands.{name}" for name in _NAMES.split())
"""The modules of the subcommands, in the order of the help text; add new ones here."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command with all its subcommands."""
    p = usage.Parser(
        prog="apu",
        description="Joint simulation of an all-electric APU: gas path and stator faults.",
        epilog="Try: apu run joint",
    )
    p.add_argument("--version", action=usage.ShowVersion, nargs=0, help="print the version")
    register(p.add_subparsers(metavar="COMMAND", required=True))
    return p


def register(
    subparsers: argparse._SubParsersAction[Any],
    modules: Sequence[str] = MODULES,
) -> None:
    """Add the subcommands of ``modules`` to a parser."""
    for name in modules:
        command = import_module(name)
        told = {"help": command.HELP, "description": command.__doc__}
        parser = subparsers.add_parser(command.NAME, formatter_class=usage.Help, **told)
        if hasattr(command, "OPTIONS"):
            usage.declare(parser, command.OPTIONS)
        else:
            command.add_arguments(parser)
        parser.set_defaults(run=command.run, resume=getattr(command, "resume", None))
