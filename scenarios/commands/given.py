"""The options of ambient conditions, alike in every command, and the line that tells them.

Their defaults are those of :mod:`apu_casadi.gaspath.conditions`; what a command assumed, it prints.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from apu_casadi.gaspath.conditions import CONDITIONS, DEFAULT_DAY, assumed_words, day_words

OPTIONS = {"altitude": "altitude", "Mach": "mach", "dT_isa": "disa", "war": "humidity"}
"""The option of each condition, without its dashes."""
_METAVAR = {"altitude": "M", "Mach": "MA", "dT_isa": "K", "war": "RATIO"}


def ambient_arguments(parser: argparse.ArgumentParser, *, otherwise: str = "") -> None:
    """Declare ``--altitude``, ``--mach``, ``--disa`` and ``--humidity`` (also ``--war``), numbers.

    Args:
        otherwise: what stands in for an option before the default day does, for the help.
    """
    for name, c in CONDITIONS.items():
        flags = [f"--{OPTIONS[name]}"] + (["--war"] if name == "war" else [])
        unit = "" if c.unit == "1" else f", {c.unit}"
        parser.add_argument(
            *flags, metavar=_METAVAR[name], type=float, dest=name,
            help=f"{c.doc}{unit} (default: {otherwise}{c.default:g})",
        )  # fmt: skip


def ambient_given(args: argparse.Namespace) -> dict[str, float | None]:
    """Return the conditions as given, None where an option was left out."""
    return {name: getattr(args, name) for name in CONDITIONS}


def ambient_of(args: argparse.Namespace) -> dict[str, float]:
    """Return all conditions: as given, else of the default day."""
    return {n: DEFAULT_DAY[n] if v is None else float(v) for n, v in ambient_given(args).items()}


def ambient_line(given: Mapping[str, Any]) -> str:
    """Return the conditions in words, and which of them nobody gave."""
    known = {n: v for n, v in given.items() if v is not None}
    left = assumed_words(given)
    return f"ambient: {day_words(known)}" + (f" (assumed: {left})" if left else "")


def program() -> str:
    """Return name and version of the program, for results."""
    from apu_casadi import __version__

    return f"apu-casadi {__version__}"
