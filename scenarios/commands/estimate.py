"""Estimate faults with confidence: from recordings, along a joint run, and in studies.

apu estimate data FILE...          what a recording's channels suffice for
apu estimate joint                 along the paper's joint scenario: summary, data, figure
apu estimate study NAME            one study (or all), kept part by part
apu estimate page                  ESTIMATION.md from the kept studies
apu estimate sensors               what is measured, how well, and where that is from
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from scenarios.commands import given, readingoptions
from scenarios.shell import jsontext, usage
from scenarios.shell.progress import bar, moving
from scenarios.studies.estimation import names

NAME = "estimate"
HELP = "estimate faults with confidence: recordings, joint run, studies, their page"
KEPT = "docs/estimation"


_OUT = f"--out DIR ={KEPT} | where results are kept (default %(default)s)"
_JOINT = f"""
--scenario NAME|FILE =joint | what is true: of the library, .toml or .py (default %(default)s)
--sensors FILE              | what measures it (TOML); default: apu estimate sensors
{given.WHOLE}
--seed int N =1             | of all errors (default 1)
--out DIR                   | folder (default results/estimate_NAME)
{given.FIGURES}
--json                      | print the summary as JSON only
--quiet                     | no progress bar, no list of files
"""
_DATA = f"""
files FILE + | recorded data, CSV, Parquet or netCDF: gas path, generators, or both
{given.UNIT}
{readingoptions.OPTIONS.strip()}
--only {{gaspath,electrical}} | one of the two
--sensors FILE | what the sensors are (TOML, as apu measure); default: apu estimate sensors
--prior FILE   | what is known before (TOML): mean, sigma by state, machine.r_s, delay_i, h
{given.ambient_options("a column, what the run file says, else ")}
--out DIR      | keep estimates, JSON and figure there
{given.FIGURES}
--json         | print JSON only
--quiet        | no list of files
"""
_STUDY = f"""
study NAME    | all, or one of {", ".join(names())}
--seeds int N | fresh seeds (default: the study's own)
--first-seed int N | the first of them (default: the study's own)
--only WORDS  | parts whose names contain one of these words, as realistic,large; default: all
{_OUT}
--again       | also run what is kept
--json        | print the claims as JSON
--quiet       | no progress bar
"""
_PAGE = f"""
{_OUT.replace("--out", "--from >source")}
--write FILE =ESTIMATION.md | the page, figures in docs/images beside it (default %(default)s)
--readme FILE | also put the short table between its marks
"""
_SENSORS = f"""
{given.PARTS}
--sensors FILE | those of a file (TOML) instead of the tables
--toml   | print a file of them: a start for your own
--schema | print the JSON schema of such a file, for editors
--json   | print JSON
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the actions."""
    rows = (
        ("data", _data, _DATA),
        ("joint", _joint, _JOINT),
        ("study", _study, _STUDY),
        ("page", _page, _PAGE),
        ("sensors", _sensors, _SENSORS),
    )
    usage.actions(parser, rows)


def resume(args: argparse.Namespace) -> str:
    """Tell what an interruption leaves."""
    if args.action is not _study:
        return ""
    return f"finished parts of the study are kept in {args.out}; the same command goes on"


run: Callable[[argparse.Namespace], int] = usage.act


# ------------------------------------------------------------------------------ data


def _data(args: argparse.Namespace) -> int:
    """Estimate from recorded data what its channels suffice for, with bands and verdicts."""
    from estimators.apu.recorded_estimate import estimate
    from estimators.apu.sensorfile import read_sensors
    from scenarios.figures.recordedplot import plot_recorded
    from scenarios.shell import progress

    given.drawn(args)  # refused before anything is computed
    apu = given.engine_file(args).unit
    m = readingoptions.recording(args, apu.gas_generator)
    sensors = read_sensors(args.sensors)
    progress.tell(f"estimating from {', '.join(m)}", quiet=args.quiet or args.json)
    e = estimate(
        m,
        apu,
        only=args.only,
        sensors=sensors,
        ambient=readingoptions.day(args, m),
        prior=args.prior,
    )
    data = {f"estimate_{n}": d for n, d in e.datasets().items()}
    drawn = partial(plot_recorded, e)
    return given.report(args, "estimate", e.report(), e.summary, drawn, data)


# ------------------------------------------------------------------------------ joint


def _joint(args: argparse.Namespace) -> int:
    """Simulate a scenario, measure it with noise, estimate along it, and compare."""
    from apu_casadi.core import results
    from apu_casadi.core.cf import described
    from apu_casadi.core.errors import ScenarioError
    from apu_casadi.core.files import write_text
    from estimators.apu.sensorfile import read_sensors
    from scenarios import registry
    from scenarios.shell import notices
    from scenarios.studies import jointrun

    if args.seed < 0:
        raise ScenarioError(f"--seed must be >= 0, got {args.seed}")
    s = given.scenario(args, args.scenario)
    sensors, drawn = read_sensors(args.sensors), given.drawn(args)
    folder = registry.prepare(args.out or f"results/estimate_{s.name}")
    show = not args.quiet and sys.stderr.isatty()
    with bar(f"{s.name}, truth", s.duration, show=show) as progress:
        truth = jointrun.truth(s, progress=progress)
    if show:
        print("estimating ...", file=sys.stderr)
    e = jointrun.estimate(truth, args.seed, sensors=sensors, folder=folder)
    views = jointrun.by_machine(e)
    reports = {k: jointrun.report(view) for k, view in views.items()}
    report = jointrun.of_all(reports) | given.assumed(args)
    notices.tell(report["warnings"] or [])
    named = described(e, f"estimate: {s.title or s.name}")
    made = [results.save(named, folder / f"estimate_{s.name}.nc")]
    text = jsontext.dumps(report)
    made.append(write_text(folder / "estimate.json", text + "\n"))
    if drawn is not None:
        for k, view in views.items():
            figure = jointrun.figure(jointrun.saved(view, every=1), k)
            of = f"_generator{k}" if k else ""
            made += drawn.save(figure, folder / f"estimate_{s.name}{of}")
    if args.json:
        print(text)
        return 0
    print(f"{s.name}, seed {args.seed}: estimate +- half width of the 95 % band\n")
    shared = reports[min(reports)]
    if 0 in reports:
        print(jointrun.table(shared), "", *jointrun.words(shared), sep="\n")
    else:
        said = jointrun.shared_words(shared)
        print(jointrun.table(shared, jointrun.COMMON), "", *said, sep="\n")
        for k, own in reports.items():
            text = jointrun.table(own, jointrun.SEVERITIES)
            print(f"\ngenerator {k}", text, *jointrun.machine_words(own), sep="\n")
    print(f"\n{jointrun.made_words(report)}")
    if not args.quiet:
        given.written(made)
    return 0


# ------------------------------------------------------------------------------ studies


def _study(args: argparse.Namespace) -> int:
    """Run a study over fresh random seeds; parts that are kept are not run again."""
    from apu_casadi.core.errors import ParameterError, nearest
    from scenarios import registry
    from scenarios.studies import catalogue
    from scenarios.studies.kept import understood

    known = [*catalogue.STUDIES, "all"]
    if args.study not in known:
        raise ParameterError(f"unknown study {args.study!r} {nearest(args.study, known)}")
    chosen = list(catalogue.STUDIES) if args.study == "all" else [args.study]
    if args.seeds is not None and args.seeds < 2:
        raise ParameterError(f"--seeds must be >= 2, got {args.seeds}")
    usage.count("--seeds", args.seeds, least=2)
    usage.count("--first-seed", args.first_seed, least=0, most=2**31)
    folder = registry.prepare(args.out)
    show = not args.quiet and sys.stderr.isatty()
    found: dict[str, list[Any]] = {}
    for name in chosen:
        study = catalogue.from_seed(catalogue.get(name), args.first_seed)
        n = args.seeds or study.seeds
        how = {"seed0": args.first_seed, "only": args.only, "again": args.again}
        todo = catalogue.parts_with(study, args.only)
        if not args.again:
            todo = [p for p in catalogue.pending(study, folder, n) if p in todo]
        if not args.json:
            print(f"{name}: {', '.join(todo) if todo else 'kept'}", flush=True)
        with _study_bar(name, show=show) as progress:
            record = catalogue.run(name, folder, n_seeds=n, progress=progress, **how)
        with understood(name):
            found[name] = study.report.claims(catalogue.results(record))
        if not args.json:
            remark = catalogue.other_code(study, record)
            if remark:
                print(f"  {remark}", flush=True)
            for c in found[name]:
                mark = "" if c.met is None else "  met   " if c.met else "  MISSED"
                print(f"{mark}  {c.what}: {c.achieved} ({c.target}; {c.interval})", flush=True)
    if args.json:
        import dataclasses

        table = {k: [dataclasses.asdict(c) for c in v] for k, v in found.items()}
        jsontext.show(table)
    else:
        print(f"kept in {folder}; apu estimate page makes the page")
    return 0


@contextmanager
def _study_bar(name: str, *, show: bool) -> Iterator[Callable[[str, float, float], None] | None]:
    """Yield a callback that moves a bar of expected seconds, or None."""
    form = "{desc}: {percentage:3.0f}%|{bar}| [{elapsed}<{remaining}]"
    with moving(name, 1.0, show=show, bar_format=form) as bar:

        def progress(part: str, done: float, total: float) -> None:
            bar.set_description_str(f"{name}, {part}", refresh=False)
            bar.total = max(total, 1e-9)
            bar.update(max(done - bar.n, 0.0))

        yield progress if show else None


# ------------------------------------------------------------------------------ page, sensors


def _page(args: argparse.Namespace) -> int:
    """Write the page and its figures from the kept studies."""
    from apu_casadi.core import files
    from apu_casadi.core.errors import DataError
    from apu_casadi.core.files import write_text
    from scenarios.pages import estimation_page
    from scenarios.studies import catalogue

    try:
        records = estimation_page.load(args.source)
        made = estimation_page.write(args.write, records)
        if args.readme:
            path = Path(args.readme)
            text = estimation_page.put_summary(path.read_text(encoding="utf-8"), records)
            made.append(write_text(path, text))
    except OSError as e:
        place = e.filename or args.readme or args.write
        raise DataError(f"{place}: cannot be read: {files.reason(e)}") from None
    except UnicodeDecodeError as e:
        raise DataError(f"{args.readme}: not UTF-8 text ({e})") from None
    print("written:", *(f"  {p}" for p in made), sep="\n")
    # not on the page, which is what the kept numbers say, whatever the code has become
    for name, record in records.items():
        remark = catalogue.other_code(catalogue.get(name), record)
        if remark:
            print(f"{name}: {remark}")
    return 0


def _sensors(args: argparse.Namespace) -> int:
    """Print what is measured and how well, with sources; or a file of it, or its schema."""
    given.parts(args)
    from estimators.apu.sensorfile import read_sensors, sensor_schema, to_toml

    if args.schema:
        jsontext.show(sensor_schema())
        return 0
    found = read_sensors(args.sensors)
    if args.toml:
        print(to_toml(found), end="")
        return 0
    sets = {"gas path, every 20 ms": found.gas_path, "electrical, at 10 kHz": found.electrical}
    if args.json:
        jsontext.show({k: v.table() for k, v in sets.items()})
        return 0
    for head, table in sets.items():
        print(head)
        for s in table.sensors:
            noise = f"{100 * s.noise:g} %" if s.relative else f"{s.noise:g} {s.unit}"
            gain = f"{100 * s.gain:g} %" if s.gain else "-"
            more = "".join(f"{n} {v}, " for n, v in s.more().items())
            print(f"  {s.name:<5} noise {noise:<8} gain {gain:<6} {more}{s.source}")
        print()
    print("1 sigma; noise in per cent is of the reading, a gain error is constant")
    return 0
