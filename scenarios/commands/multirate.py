"""Measure what the multi-rate exchange loses against one model with one solver, and what it saves.

Runs a load step and both faults with exchange steps of 2 to 80 ms, as the paper exchanges and with
the predicted exchange; takes some minutes.  With --events one or all the events are those of one
machine of two, or these too.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from apu_casadi.core.errors import ScenarioError
from scenarios.commands import given
from scenarios.shell import jsontext

NAME = "multirate"
HELP = "measure the error of the multi-rate exchange (takes minutes)"
OPTIONS = f"""
--out DIR     | folder for figure and numbers (default results/multirate)
--json        | print JSON only
--steps MS,MS | exchange steps in ms, divisors of 80 (default: six)
--events {{both,one,all}} | of both machines (default), of one alone, or all of these
{given.DRAWN}
--page FILE   | also write the page, with its figure in images/ beside it
--quiet       | no progress bar
"""


def run(args: argparse.Namespace) -> int:
    """Run the study and write its results."""
    from scenarios import registry
    from scenarios.shell import markdown
    from scenarios.shell.progress import bar
    from scenarios.studies import multirate_study as study

    how = given.formatted(args)
    steps = study.STEPS if args.steps is None else _steps(args.steps, study.COMMON)
    folder = registry.prepare(args.out or "results/multirate")
    show = not args.quiet and sys.stderr.isatty()
    if args.page and study.PAPER_STEP not in steps:
        raise ScenarioError("--page needs the paper's 20 ms among --steps")
    cases = study.CHOSEN[args.events or "both"]
    if args.page and not set(study.CASES) <= set(cases):
        raise ScenarioError("--page needs the events of both machines: --events both, or all")
    with bar(NAME, study.simulated(steps, cases=len(cases)), show=show) as progress:
        rows = study.measure(steps=steps, cases=cases, progress=progress)
    report = study.report(rows)
    text = jsontext.dumps(report)
    made = [markdown.write_text(folder / "multirate.json", text + "\n")]  # before all that may fail
    made += how.save(study.figure(rows), folder / "multirate_error")
    if args.page:
        page = Path(args.page)
        registry.prepare(page.parent / "images")
        made.append(
            study.write_figure(rows, page.parent / "images" / "multirate_error.png", dpi=120)
        )
        made.append(markdown.write_text(page, study.page(rows)))
    if args.json:
        print(text)
        return 0
    print(study.table(rows))
    given.written(made)
    return 0


def _steps(text: str, common: float) -> tuple[float, ...]:
    """Read exchange steps in ms."""
    try:
        steps = tuple(sorted({round(float(s) * 1e-3, 9) for s in text.split(",")}))
    except ValueError:
        raise ScenarioError(f"--steps: numbers in ms are expected, got {text!r}") from None
    for s in steps:
        if not (s > 0 and abs(common / s - round(common / s)) < 1e-9):
            raise ScenarioError(
                f"--steps: {1e3 * s:g} ms does not divide {1e3 * common:g} ms, where all runs meet"
            )
    return steps
