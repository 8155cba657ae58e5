"""The console command ``apu``.

Exit status: 0 done; 1 a simulation or an estimate failed; 2 wrong usage, scenario, parameter or
file; 130 interrupted by Ctrl-C, 143 by SIGTERM, 129 by a closed terminal.
"""

from __future__ import annotations

import gc
import os
import sys

from scenarios.shell import guard

# anything else is imported when the guard stands
TYPE_CHECKING = False
if TYPE_CHECKING:
    from argparse import ArgumentParser
    from collections.abc import Sequence


def parser() -> ArgumentParser:
    """Return the parser of the command with all its subcommands."""
    from scenarios import commands

    return commands.parser()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command with ``argv``; return the exit status.

    Without ``argv`` the process is the command's own: it takes the process's arguments, a signal
    may end the process, and an unforeseen error becomes a sentence.  With ``argv``, from Python,
    the signal handlers come back afterwards, and an unforeseen error is raised.
    """
    with guard.Guard(own=argv is None) as g:
        from apu_casadi.core import files
        from scenarios.shell import streams

        files.account(True)
        if g.own:  # what models are made of stays: to look through it again and again takes 3 %
            gc.set_threshold(100_000)
        try:
            with streams.tolerant():
                return streams.finish(_guarded(argv, g), own=g.own)
        finally:
            files.account(False)
            if g.own:  # what is left goes with the process
                gc.freeze()


def _guarded(argv: Sequence[str] | None, g: guard.Guard) -> int:
    from apu_casadi.core import interrupts
    from scenarios.shell import streams

    try:
        status = _run(argv, g)
        if not interrupts.recorded():
            return status
    except KeyboardInterrupt:
        pass
    except BrokenPipeError:  # the reader (head, less) has had enough
        return 0
    except Exception as e:
        # what fails after an interrupt fails because of it
        if not interrupts.recorded():
            told = streams.explain(e, program=g.own)
            if told is None:
                raise
            guard.say(f"apu: error: {told[0]}")
            return told[1]
    signum = interrupts.recorded() or 2
    g.ignore()
    guard.tell(signum)
    return 128 + signum


def _run(argv: Sequence[str] | None, g: guard.Guard) -> int:
    from apu_casadi.core.errors import ScenarioError
    from scenarios.shell import notices

    try:
        args = parser().parse_args(argv)
    except SystemExit as e:  # argparse has printed the message
        return e.code if isinstance(e.code, int) else 2
    if g.own and "MPLBACKEND" in os.environ:
        os.environ["MPLBACKEND"] = "agg"  # figures go to files, whatever screens there are
    resume = getattr(args, "resume", None)
    if resume is not None:
        guard.note(resume(args))
    g.raising = True
    try:
        with notices.as_lines():
            status: int = args.run(args)
    except SystemExit as e:  # of code that a scenario brought along
        raise ScenarioError(f"the program was told to end with status {e.code!r}") from None
    finally:
        g.raising = not g.own  # what is left to do must not be cut short by an exception
    return status


if __name__ == "__main__":
    sys.exit(main())
