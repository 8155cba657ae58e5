"""How the command line is read: options in full, and the nearest name where one is unknown."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Sequence
from typing import Any

from apu_casadi.core.errors import ScenarioError, nearest


class Parser(argparse.ArgumentParser):
    """A parser, also for its subcommands, that takes no abbreviation and names what is near."""

    def __init__(self, *args: Any, **options: Any) -> None:
        """Take the arguments of :class:`argparse.ArgumentParser`."""
        # an abbreviation that works today may be another option's name tomorrow
        super().__init__(*args, **{**options, "allow_abbrev": False})
        self.register("type", float, finite)

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse; end with status 2 at an unknown option, and at ``--option=--``."""
        for text in args or ():
            # argparse takes the two dashes away and then misses the value
            if re.fullmatch(r"--[^=]+=--", text):
                self.error(f"argument {text[:-3]}: a value is expected, got '--'")
        found, rest = super().parse_known_args(args, namespace)
        unknown = [text for text in rest if text.startswith("-") and text != "--"]
        if unknown:
            option = unknown[0].partition("=")[0]
            known = [o for o in self._option_string_actions if o.startswith("--")]
            self.error(f"unrecognized arguments: {' '.join(unknown)} {nearest(option, known)}")
        return found, rest

    def _print_message(self, message: str, file: Any = None) -> None:
        """Print help on stdout so that a full disk is noticed; argparse passes over it."""
        if message and file is not None and file is sys.stdout:
            file.write(message)
        else:
            super()._print_message(message, file)


def finite(text: str) -> float:
    """Return a finite number; every option of type float is read so."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"a finite number is expected, got {text!r}")
    return value


def count(option: str, value: int | None, *, least: int = 1, most: int = 1_000_000) -> None:
    """Check a number of runs, points, seeds, threads.

    Raises:
        ScenarioError: outside the range; None, the default, is inside.
    """
    if value is not None and not least <= value <= most:
        raise ScenarioError(f"{option} must be {least} to {most}, got {value}")


class ShowVersion(argparse.Action):
    """Print the installed version; looked up only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        """Print it and end the command."""
        from importlib.metadata import version

        print(f"apu-casadi {version('apu-casadi')}")
        parser.exit()
