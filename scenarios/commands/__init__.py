"""The subcommands of ``apu``, one module each.

A module has ``NAME`` and ``HELP`` (texts), ``add_arguments(parser)`` and ``run(args) -> int``, the
exit status; and, where an interruption leaves more than finished files, ``resume(args) -> str``,
the words on what is kept and how to go on.  It imports anything heavy inside ``run``, so that the
other commands start quickly.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module
from typing import Any, Protocol, cast

MODULES: tuple[str, ...] = (
    "scenarios.commands.bench",
    "scenarios.commands.calibrate",
    "scenarios.commands.campaign",
    "scenarios.commands.linearise",
    "scenarios.commands.compile",
    "scenarios.commands.deck",
    "scenarios.commands.errata",
    "scenarios.commands.estimate",
    "scenarios.commands.fit",
    "scenarios.commands.identify",
    "scenarios.commands.list",
    "scenarios.commands.maps",
    "scenarios.commands.multirate",
    "scenarios.commands.run",
    "scenarios.commands.study",
    "scenarios.commands.trim",
    "scenarios.commands.validate",
)
"""The modules of the subcommands, in the order of the help text; add new ones here."""


class Command(Protocol):
    """What a module of this package provides."""

    NAME: str
    HELP: str

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare options and arguments."""

    def run(self, args: argparse.Namespace) -> int:
        """Do the work; return the exit status, or raise an ApuError."""


def register(
    subparsers: argparse._SubParsersAction[Any],
    modules: Sequence[str] = MODULES,
) -> None:
    """Add the subcommands of ``modules`` to a parser."""
    for name in modules:
        command = cast(Command, import_module(name))
        parser = subparsers.add_parser(
            command.NAME, help=command.HELP, description=command.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )  # fmt: skip
        command.add_arguments(parser)
        parser.set_defaults(run=command.run, resume=getattr(command, "resume", None))
