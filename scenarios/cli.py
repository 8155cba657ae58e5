"""The console command ``apu``.

Exit status: 0 done; 1 a simulation or an estimate failed; 2 wrong usage, scenario, parameter or
file; 130 interrupted by Ctrl-C.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from apu_casadi.errors import ApuError, EstimationError, OperatingPointError, SimulationError
from scenarios import commands, notices


class _Version(argparse.Action):
    """Print the installed version; looked up only then."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"apu-casadi {version('apu-casadi')}")
        parser.exit()


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command with all its subcommands."""
    p = argparse.ArgumentParser(
        prog="apu",
        description="Joint simulation of an all-electric APU: gas path and stator faults.",
        epilog="Try: apu run joint",
    )
    p.add_argument("--version", action=_Version, nargs=0, help="print the version")
    commands.register(p.add_subparsers(metavar="COMMAND", required=True))
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with ``argv`` (the process's own if None); return the exit status."""
    try:
        args = parser().parse_args(argv)
    except SystemExit as e:  # argparse has printed the message
        return e.code if isinstance(e.code, int) else 2
    try:
        with notices.as_lines():
            status: int = args.run(args)
        sys.stdout.flush()
        return status
    except ApuError as e:
        print(f"apu: error: {' '.join(str(e).split())}", file=sys.stderr)
        failed = isinstance(e, EstimationError | OperatingPointError | SimulationError)
        return 1 if failed else 2
    except KeyboardInterrupt:
        print("apu: interrupted; nothing further was written", file=sys.stderr)
        return 130
    except BrokenPipeError:  # the reader (head, less) has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


if __name__ == "__main__":
    sys.exit(main())
