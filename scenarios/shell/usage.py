"""How the command line is read: options in full, and the nearest name where one is unknown."""

from __future__ import annotations

import argparse
import difflib
import inspect
import math
import re
import sys
import textwrap
import tomllib
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from apu_casadi.core.errors import ScenarioError, nearest


class Help(argparse.RawDescriptionHelpFormatter):
    """Help whose paragraphs are broken anew where the terminal is narrower than they are."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        """Leave examples, which are indented or have columns, as they are."""
        room, blocks = width + 2, inspect.cleandoc(text).split("\n\n")
        for k, block in enumerate(blocks):
            lines = block.split("\n")
            if max(map(len, lines)) > room and not re.search(r"^ |\S   +\S", block, re.MULTILINE):
                blocks[k] = textwrap.fill(block, room, break_on_hyphens=False)
        return super()._fill_text("\n\n".join(blocks), width, indent)


class Parser(argparse.ArgumentParser):
    """A parser, also for its subcommands, that takes no abbreviation and names what is near."""

    def __init__(self, *args: Any, **options: Any) -> None:
        """Take the arguments of :class:`argparse.ArgumentParser`."""
        # an abbreviation that works today may be another option's name tomorrow
        super().__init__(*args, **{**options, "allow_abbrev": False})
        self.register("type", float, finite)
        self.register("type", int, whole)

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse; end with status 2 at an unknown option, and at ``--option=--``."""
        for text in args or ():
            # argparse takes the two dashes away and then misses the value
            if re.fullmatch(r"--[^=]+=--", text):
                self.error(f"argument {text[:-3]}: a value is expected, got '--'")
        args = self._own_values(sys.argv[1:] if args is None else args)
        first = next(iter(args), "")
        if self._subparsers and first.startswith("--") and first not in self._option_string_actions:
            self._unknown([first])  # before a command is missed
        found, rest = super().parse_known_args(args, namespace)
        unknown = [text for text in rest if text.startswith("-") and text != "--"]
        if unknown:
            self._unknown(unknown)
        return found, rest

    def _own_values(self, args: Sequence[str]) -> list[str]:
        """Write ``--figures run.csv`` as ``--figures=png run.csv``: the file is none of its words.

        A word that is near one of them is taken as such, and refused later.
        """
        out = list(args)
        end = out.index("--") if "--" in out else len(out)
        for k in range(end - 1):
            action = self._option_string_actions.get(out[k])
            known = getattr(action, "words", ())
            given = out[k + 1].split(",")
            near = all(difflib.get_close_matches(w.strip().lower(), known) for w in given)
            if action is not None and known and not out[k + 1].startswith("-") and not near:
                out[k] = f"{out[k]}={action.const}"
        return out

    def _unknown(self, arguments: Sequence[str]) -> NoReturn:
        """End with status 2: options that there are not, and the nearest one there is."""
        known = [o[2:] for o in self._option_string_actions if o.startswith("--")]
        word = arguments[0].partition("=")[0].removeprefix("--").lower()  # dashes make all alike
        near = difflib.get_close_matches(word, known, n=1, cutoff=0.6)
        told = f" (did you mean '--{near[0]}'?)" if near else ""
        self.error(f"unrecognized arguments: {' '.join(arguments)}{told}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Refuse what is none of an argument's choices; the nearest one is named."""
        if action.choices is not None and value not in action.choices:
            known = [str(c) for c in action.choices]
            raise argparse.ArgumentError(action, f"unknown {value!r} {nearest(str(value), known)}")

    def error(self, message: str) -> NoReturn:
        """End with status 2 and one line: what is wrong, and where the rest is told."""
        self.exit(2, f"{self.prog}: error: {message}; see {self.prog} --help\n")

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


def whole(text: str) -> int:
    """Return a whole number; every option of type int is read so."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"a whole number is expected, got {text!r}") from None


def count(option: str, value: int | None, *, least: int = 1, most: int = 1_000_000) -> None:
    """Check a number of runs, points, seeds, threads.

    Raises:
        ScenarioError: outside the range; None, the default, is inside.
    """
    if value is not None and not least <= value <= most:
        raise ScenarioError(f"{option} must be {least} to {most}, got {value}")


def declare(parser: argparse.ArgumentParser, table: str) -> None:
    """Declare the options of a table, one a line: what it is, a bar, its help.

    Left of the bar stand, separated by blanks, the flags (or the name of an argument), and any of:
    a metavar; ``int`` or ``float``; ``{a,b}``, the choices; ``=VALUE``, the default; ``?`` or
    ``+``, how many; ``?a,b``, of an option: words of which its value is made, if it has one;
    ``...``, may be given again; ``>name``, the attribute.  An option without metavar and type is a
    switch, with ``=on`` one that ``--no-...`` turns off.  A line that begins with the bar continues
    the help above it.
    """
    rows: list[tuple[str, str]] = []
    for line in table.strip().splitlines():
        what, _, text = (part.strip() for part in f" {line.strip()}".partition(" | "))
        rows.append((what, text) if what else (rows[-1][0], f"{rows.pop()[1]} {text}"))
    for what, text in rows:
        flags, options = _option(what.split())
        words = options.pop("words", ())
        parser.add_argument(*flags, **options, help=text).words = words  # type: ignore[attr-defined]


def actions(
    parser: argparse.ArgumentParser,
    rows: Sequence[tuple[str, Callable[[argparse.Namespace], int], str]],
) -> None:
    """Declare the actions of a command: name, function, whose docstring is the help, options."""
    group = parser.add_subparsers(metavar="ACTION", required=True)
    for name, call, table in rows:
        p = group.add_parser(name, help=call.__doc__, description=call.__doc__)
        p.set_defaults(action=call)
        declare(p, table)


def act(args: argparse.Namespace) -> int:
    """Do the action that was asked for; return its status."""
    status: int = args.action(args)
    return status


def part(text: str) -> float | dict[str, Any]:
    """Return a finite number, or a table of ``key = value`` with commas between, as TOML has it."""
    if "=" not in text:
        return finite(text)
    keys = text.strip()
    keys = keys[1:-1] if keys.startswith("{") and keys.endswith("}") else keys
    try:
        table: dict[str, Any] = tomllib.loads(f"part = {{ {keys} }}")["part"]
    except tomllib.TOMLDecodeError as e:
        raise argparse.ArgumentTypeError(
            f"'key = value, ...' is expected, as TOML has it, words as in kind = \"RL\", got "
            f"{text!r} ({e})"
        ) from None
    return table


_TYPES: dict[str, Callable[[str], Any]] = {"int": int, "float": float, "part": part}


_ON = {"action": argparse.BooleanOptionalAction, "default": True}


def _option(words: list[str]) -> tuple[list[str], dict[str, Any]]:
    """Return flags and keywords of ``add_argument`` from the left side of a line."""
    flags, options = [words[0]], dict[str, Any]()
    for word in words[1:]:
        if word.startswith("-"):
            flags.append(word)
        elif word in _TYPES:
            options["type"] = _TYPES[word]
        elif word == "...":
            options |= {"action": "append", "default": []}
        elif word in ("?", "+"):
            options["nargs"] = word
        elif word[0] == "?":
            options |= {"nargs": "?", "words": tuple(word[1:].split(","))}
        elif word[0] == "=":
            options["default"] = word[1:]
        elif word[0] == ">":
            options["dest"] = word[1:]
        elif word[0] == "{" and word[-1] == "}":
            options["choices"] = tuple(word[1:-1].split(","))
        else:
            options["metavar"] = word
    if flags[0].startswith("-") and not {"metavar", "type", "choices"} & set(options):
        on = options.get("default") == "on"
        options |= _ON if on else {"action": "store_true"}
    if flags[0].startswith("-") and options.get("nargs") == "?":
        options["const"] = options.get("default")  # the flag alone
    if "type" in options and isinstance(options.get("default"), str):
        options["default"] = options["type"](options["default"])
    return flags, options


class ShowVersion(argparse.Action):
    """Print the installed version; looked up only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        """Print it and end the command."""
        from apu_casadi.core.version import installed

        print(f"apu-casadi {installed()}")
        parser.exit()
