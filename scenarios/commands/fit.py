"""Fit health factors of the gas generator to recorded data, with confidence intervals.

FILE is CSV, Parquet (.parquet) or netCDF (.nc); several files are fitted together, as runs of one
engine.  Columns are found by name (N, P3, T3, T5, Wf, PW; altitude, Mach, dT_isa, war; time), units
stand in the header or are SI:

    time [s],N [rpm],P3 [kPa],T3 [K],T5 [degC],Wf [kg/h],PW [kW]
    0.00,36049,801.2,567.9,475.1,173.5,499.8
    0.02,36051,,568.3,474.8,173.7,500.3

An empty cell is a gap.  With a time column the rows are a transient; without, or with --steady,
each row is a steady operating point.  Dates, decimal commas, a row of units and the like are read,
with a line on how; what may mean two things, and readings that cannot be, are refused with the
option that decides.

    apu fit engine.csv --column T5=EGT_in:degC --column N=NGG:rpm
    apu fit run.nc --estimate f_eta_c,f_W_c,gain_T5 --prior f_W_c=1:0.02 --figure fit.png
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apu_casadi.core.errors import DataError, ParameterError, nearest
from apu_casadi.gaspath.conditions import CONDITIONS, DEFAULT_DAY, day_words
from scenarios.commands.given import ambient_arguments, ambient_given, program
from scenarios.shell import jsontext

if TYPE_CHECKING:
    from estimators.apu.fitting import EngineData, EngineFit
    from estimators.apu.recordings.recorded import Reading, Table
    from estimators.apu.sensors import SensorSet
    from estimators.batch.fitresult import Profile

NAME = "fit"
HELP = "fit health factors to recorded data (CSV, Parquet, netCDF)"
RIDGE = 0.95  # correlation from which a pair is said to be confounded


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare arguments and options."""
    parser.add_argument("files", metavar="FILE", nargs="+", help="recorded data (see above)")
    parser.add_argument(
        "--estimate", metavar="A,B", default="f_eta_c,f_W_c,f_eta_t,f_W_t",
        help="health factors, gain_SENSOR, bias_SENSOR (default: the four health factors)",
    )  # fmt: skip
    parser.add_argument(
        "--own", metavar="A,B", default="", help="gains or biases that each file has for itself"
    )
    parser.add_argument(
        "--column", metavar="NAME=COLUMN[:UNIT]", action="append", default=[],
        help="column of another name, or its unit",
    )  # fmt: skip
    parser.add_argument(
        "--time", metavar="COLUMN", help="time column (default: time, t, Timestamp and the like)"
    )
    _add_reading(parser)
    parser.add_argument("--steady", action="store_true", help="each row is a steady point")
    parser.add_argument(
        "--sigma", metavar="NAME=VALUE", action="append", default=[],
        help="standard deviation of a sensor: 0.5%% of the reading, or a number with unit: 3K",
    )  # fmt: skip
    parser.add_argument(
        "--readings", metavar="N", type=int, default=1, help="each value is a mean of N readings"
    )
    parser.add_argument(
        "--prior", metavar="NAME=MEAN:SIGMA", action="append", default=[],
        help="what is known of a parameter beforehand",
    )  # fmt: skip
    parser.add_argument(
        "--consider", metavar="NAME=SIGMA", action="append", default=[],
        help="uncertain but not estimated; widens the intervals: gain_T5=0.005",
    )  # fmt: skip
    parser.add_argument(
        "--fix", metavar="NAME=VALUE", action="append", default=[], help="a known health factor"
    )
    ambient_arguments(parser, otherwise="a column, what the run file says, else ")
    parser.add_argument(
        "--profile", action="store_true", help="intervals from the profile likelihood too"
    )
    parser.add_argument("--figure", metavar="FILE", help="draw measured against fitted (.png)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--quiet", action="store_true", help="no word on progress")


def _add_reading(parser: argparse.ArgumentParser) -> None:
    """Declare how files are read that leave a question."""
    parser.add_argument("--encoding", metavar="NAME", help="of text files, such as utf-16")
    parser.add_argument("--decimal", choices=("point", "comma"), help="decimal point or comma")
    parser.add_argument(
        "--missing", metavar="A,B", default="",
        help="numbers that stand for a gap, as in the file: --missing=-999,9999",
    )  # fmt: skip
    parser.add_argument(
        "--exclude-implausible", action="store_true",
        help="leave out readings that cannot be, instead of refusing the file",
    )  # fmt: skip
    parser.add_argument(
        "--range", metavar="NAME=LOW:HIGH", action="append", default=[],
        help="another plausible range, in SI: T5=250:1300",
    )  # fmt: skip
    parser.add_argument(
        "--time-format", metavar="FORMAT", help="of dates, such as %%d.%%m.%%Y %%H:%%M:%%S"
    )
    parser.add_argument(
        "--time-zone", metavar="ZONE", help="of dates without one: UTC, Europe/Berlin"
    )


def _reading(args: argparse.Namespace) -> Reading:
    from estimators.apu.recordings.plausible import parse_limits
    from estimators.apu.recordings.recorded import Reading

    missing = [_number(n, "--missing", args.missing) for n in _names(args.missing)]
    return Reading(
        args.encoding, args.decimal, tuple(missing), args.exclude_implausible,
        parse_limits(args.range), args.time_format, args.time_zone,
    )  # fmt: skip


def run(args: argparse.Namespace) -> int:
    """Read, fit, print; return 0."""
    from estimators.apu import fitting
    from estimators.apu.recordings.recorded import parse_mapping, read_table
    from estimators.apu.recordings.runfiles import recorded_ambient
    from estimators.batch.fit import profile

    mapping = parse_mapping(args.column)
    _known_targets(mapping)
    reading = _reading(args)
    notes: list[str] = []
    tables = [read_table(f, mapping, reading=reading, notes=notes) for f in args.files]
    sensors = _sensors(args.sigma)
    times = [None if args.steady else t.time(args.time) for t in tables]
    if len({t is None for t in times}) > 1:
        raise DataError("some files have a time column and some not; --steady takes rows as points")
    steady = times[0] is None
    said = [recorded_ambient(f) for f in args.files]
    data = [
        _data(table, t, sensors, args, day)
        for table, t, day in zip(tables, times, said, strict=True)
    ]
    ignored = _ignored(tables, sensors, args.time)
    estimate = _names(args.estimate)
    if args.readings < 1:
        raise ParameterError(f"--readings must be >= 1, got {args.readings}")
    rows = sum(d.t.size for d in data)
    talk = not args.quiet and not args.json and sys.stderr.isatty()
    if talk and rows > 200:
        print(f"fitting {rows} samples ...", file=sys.stderr, flush=True)
    fit = fitting.fit_engine(
        data,
        estimate,
        steady=steady,
        sensors=sensors,
        averaged=args.readings,
        own=_names(args.own),
        fixed=_numbers(args.fix, "--fix"),
        prior=_pairs(args.prior),
        consider=_numbers(args.consider, "--consider"),
    )
    profiles = []
    if args.profile:
        for name in fit.result.names:
            if talk:
                print(f"profile of {name} ...", file=sys.stderr, flush=True)
            if name not in fit.result.at_bound:
                profiles.append(profile(fit.result, name))
    figures = _draw(fit, args.figure, steady, [d.ambient for d in data]) if args.figure else []
    found = report(fit, profiles, ignored, steady=steady)
    found["assumed_ambient"] = _assumed(data)
    found["read_as"] = [*notes, *_unheeded(tables, times, args)]
    found["recorded_ambient"] = {
        t.source: taken for t, day in zip(tables, said, strict=True)
        if (taken := _recorded(t, day, args))
    }  # fmt: skip
    found["apu_casadi_version"] = program().split()[1]
    if args.json:
        jsontext.show(found)
        return 0
    print(text(found))
    for path in figures:
        print(f"\nwritten: {path}")
    return 0


# ------------------------------------------------------------------------------ options


def _names(text: str) -> list[str]:
    return [n.strip() for n in text.split(",") if n.strip()]


def _number(text: str, option: str, item: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ParameterError(f"{option} {item!r}: {text!r} is no number")
    return value


def _split(item: str, option: str, form: str) -> tuple[str, str]:
    name, sep, value = item.partition("=")
    if not (sep and name.strip() and value.strip()):
        raise ParameterError(f"{option} {item!r}: {form} is expected")
    return name.strip(), value.strip()


def _numbers(items: Sequence[str], option: str) -> dict[str, float]:
    out = {}
    for item in items:
        name, value = _split(item, option, "NAME=VALUE")
        out[name] = _number(value, option, item)
    return out


def _pairs(items: Sequence[str]) -> dict[str, tuple[float, float]]:
    out = {}
    for item in items:
        name, value = _split(item, "--prior", "NAME=MEAN:SIGMA")
        mean, sep, sigma = value.partition(":")
        if not sep:
            raise ParameterError(f"--prior {item!r}: NAME=MEAN:SIGMA is expected")
        out[name] = _number(mean, "--prior", item), _number(sigma, "--prior", item)
    return out


def _sensors(items: Sequence[str]) -> SensorSet:
    """The table of sensors, changed and extended by ``--sigma``."""
    from dataclasses import replace

    import numpy as np

    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from estimators.apu.recordings.recorded import UNITS, convert
    from estimators.apu.sensors import KNOWN, Sensor, SensorSet, gas_path_table

    known = {s.name: s for s in gas_path_table().sensors}
    for item in items:
        name, value = _split(item, "--sigma", "NAME=VALUE")
        if name not in GasGenerator.Y and name not in KNOWN:
            raise ParameterError(
                f"--sigma {item!r}: unknown output {nearest(name, GasGenerator.Y.names)}"
            )
        unit = KNOWN[name].unit if name in KNOWN else GasGenerator.Y[name].unit
        # the longest ending that is a unit: 3K, 1.5 kPa, 0.5%, 3 K
        ending = next(
            (u for u in sorted(UNITS, key=len, reverse=True)
             if value.endswith(u) and not u[0].isdigit() and u != "-"), "",
        )  # fmt: skip
        number = _number(value.removesuffix(ending).strip(), "--sigma", item)
        relative = ending == "%" and unit != "1"
        if ending and not relative:
            number = float(
                convert(np.array(number), ending, unit, f"--sigma {item}", difference=True)
            )
        elif relative:
            number /= 100
        elif unit != "1":
            raise ParameterError(
                f"--sigma {item!r}: a unit is needed, % of the reading or one of {unit}"
            )
        if not number > 0:
            raise ParameterError(f"--sigma {item!r}: a standard deviation must be > 0")
        new = Sensor(name, number, relative, 0.0, unit, "given by the user")
        if name in known:
            old = replace(known[name], source="changed by the user")
            new = replace(old, noise=number, relative=relative)
        elif name in KNOWN:
            new = replace(KNOWN[name], noise=number, relative=relative, gain=0.0, source=new.source)
        known[name] = new
    return SensorSet(tuple(known.values()))


def _known_targets(mapping: Mapping[str, Any]) -> None:
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from estimators.apu.fitting import AMBIENT
    from estimators.apu.sensors import KNOWN

    valid = list(dict.fromkeys([*GasGenerator.Y.names, *KNOWN, *AMBIENT, "time"]))
    for name in mapping:
        if name not in valid:
            raise DataError(f"--column {name}=...: unknown quantity {nearest(name, valid)}")


def _data(
    table: Table, t: Any, sensors: SensorSet, args: argparse.Namespace, said: Mapping[str, float]
) -> EngineData:
    """Take from a table what the sensors measure, and the ambient conditions.

    An option goes before a column, and that before what a run file says of itself.
    """
    import numpy as np

    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from estimators.apu.fitting import AMBIENT, INPUTS, EngineData

    U = GasGenerator.U
    readings = {s.name: table.get(s.name, s.unit) for s in sensors.sensors if s.name in table}
    measured = [n for n in readings if n not in INPUTS]
    if not measured:
        raise DataError(
            f"{table.source}: none of the columns {', '.join(table.columns)} is a measured output "
            f"({', '.join(n for n in sensors.names if n not in INPUTS)}); name them with --column"
        )
    ambient: dict[str, Any] = {}
    given = ambient_given(args)
    for name in AMBIENT:
        if (option := given[name]) is not None:
            ambient[name] = option
        elif name in table:
            ambient[name] = table.get(name, U[name].unit, difference=name == "dT_isa")
        elif name in said:
            ambient[name] = said[name]
        if name in ambient:
            _in_range(table.source, name, ambient[name])
    rows = np.arange(table.size, dtype=float) if t is None else t - t[0]
    # rows in which nothing was read are no points
    there = np.any([np.isfinite(readings[n]) for n in measured], axis=0)
    if t is None and not there.all():
        readings = {n: v[there] for n, v in readings.items()}
        ambient = {n: v if np.ndim(v) == 0 else v[there] for n, v in ambient.items()}
        rows = rows[there]
    return EngineData(table.source, rows, readings, ambient)


def _in_range(source: str, name: str, value: Any) -> None:
    """Refuse ambient conditions that the engine is not meant for; gaps are refused later."""
    import numpy as np

    c, a = CONDITIONS[name], np.atleast_1d(np.asarray(value, float))
    wrong = np.flatnonzero((a < c.lo) | (a > c.hi))
    if wrong.size:
        k = int(wrong[0])
        where = f", data row {k + 1}" if np.ndim(value) else ""
        raise DataError(
            f"{source}{where}: {name} = {a[k]:g} {c.unit} is outside [{c.lo:g}, {c.hi:g}]"
            + (f" ({wrong.size} such rows)" if wrong.size > 1 else "")
        )


def _assumed(data: Sequence[EngineData]) -> dict[str, float]:
    """Ambient conditions that neither option nor column gave, at the values that were taken."""
    return {n: v for n, v in DEFAULT_DAY.items() if any(n not in d.ambient for d in data)}


def _recorded(
    table: Table, said: Mapping[str, float], args: argparse.Namespace
) -> dict[str, float]:
    """Ambient conditions that were taken from what a run file says of itself."""
    given = ambient_given(args)
    return {n: v for n, v in said.items() if given[n] is None and n not in table}


def _unheeded(tables: Sequence[Table], times: Sequence[Any], args: argparse.Namespace) -> list[str]:
    """Say it where a column rises like a time, or flags rows as bad, and is not used."""
    flags = [f for t in tables for f in t.flags()]
    if args.steady:
        return flags
    hints = [(t.source, t.steady_hint()) for t, at in zip(tables, times, strict=True) if at is None]
    return flags + [
        f"{source}: no time column, so each row is taken as a steady point; if {hint} is the time, "
        f"give --time {hint}"
        for source, hint in hints
        if hint is not None
    ]


def _ignored(tables: Sequence[Table], sensors: SensorSet, time: str | None) -> list[str]:
    """Columns that the fit does not use, with a guess of what they may be."""
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from estimators.apu.fitting import AMBIENT
    from estimators.apu.recordings.timestamps import is_time_name

    used = {*sensors.names, *AMBIENT, time}
    out: dict[str, None] = {}
    for table in tables:
        for name in table.columns:
            if name in used or name in table.mapped or is_time_name(name):
                continue
            hint = "no sigma known: give --sigma" if name in GasGenerator.Y else ""
            if not hint:
                guess = nearest(name, [*sensors.names, *AMBIENT])
                hint = guess[1:-1] if guess.startswith("(did") else ""
            out[f"{name} ({hint})" if hint else name] = None
    return list(out)


# ------------------------------------------------------------------------------ results


def report(
    fit: EngineFit, profiles: Sequence[Profile], ignored: Sequence[str], *, steady: bool
) -> dict[str, Any]:
    """Return the result as plain numbers; what is unbounded or unknown is None."""
    from estimators.apu.fitting import words

    r = fit.result

    def number(x: float) -> float | None:
        return float(x) if math.isfinite(x) else None

    by_profile = {p.name: p for p in profiles}
    parameters = []
    for name in r.names:
        value, sigma = r[name]
        low, high = r.interval(name)
        row = {
            "name": name,
            "meaning": words(name),
            # where the data leave it open, the number is arbitrary
            "estimate": value if math.isfinite(sigma) or name in r.at_bound else None,
            "standard_error": number(sigma),
            "low": number(low),
            "high": number(high),
        }
        if name in by_profile:
            p = by_profile[name]
            row |= {"profile_low": number(p.lower), "profile_high": number(p.upper)}
        parameters.append(row)
    corr = r.correlation
    ridges = [
        {"pair": [a, b], "correlation": float(corr[i, j])}
        for i, a in enumerate(r.names)
        for j, b in enumerate(r.names[:i])
        if abs(corr[i, j]) >= RIDGE
    ]
    return {
        "files": list(fit.names),
        "mode": "steady" if steady else "transient",
        "samples": [int(k.size) for k in fit.recordings],
        "parameters": parameters,
        "correlation": [[number(c) for c in row] for row in corr],
        "considered": dict(
            zip(r.considered, [[number(s) for s in c] for c in r.sensitivity.T], strict=True)
        ),
        "ridges": ridges,
        "undetermined": list(r.undetermined),
        "hardly_determined": list(r.weak),
        "at_bound": list(r.at_bound),
        "chi2": r.chi2,
        "degrees_of_freedom": r.freedom,
        "p_value": number(r.p_value),
        "verdict": verdict(r.chi2, r.freedom, r.p_value),
        "misfit": {n: {"rms": v, "readings": k} for n, (v, k) in fit.misfit().items()},
        "loglik": r.loglik,
        "iterations": r.iterations,
        "ignored_columns": list(ignored),
    }


def verdict(chi2: float, freedom: int, p: float) -> str:
    """Say what chi-squared means."""
    if freedom < 0:
        return "fewer readings than unknowns"
    if freedom == 0:
        return "as many unknowns as readings: the fit cannot be judged by its residuals"
    if p < 1e-3:
        return (
            "the model does not fit within the stated noise: sigmas too small, a sensor in error, "
            "rows that are not steady, or a fault that was not estimated; believe no interval"
        )
    if p > 0.999:
        return "residuals are smaller than the stated noise: the sigmas are too large"
    return "the model fits within the stated noise"


def text(found: Mapping[str, Any]) -> str:
    """Return the report as text."""
    from estimators.apu.fitting import INPUTS, words

    rows = found["parameters"]
    width = max(len(r["name"]) for r in rows)
    wide = max(len(r["meaning"]) for r in rows)
    profiled = any("profile_low" in r for r in rows)
    total = sum(found["samples"])
    what = "steady points" if found["mode"] == "steady" else "samples of a transient"
    head = (
        f"{'':<{width}}  {'':<{wide}}  {'estimate':>10}  {'std. error':>10}  {'95 % interval':>22}"
    )
    lines = [f"{', '.join(found['files'])}: {total} {what}", ""]
    lines.append(head + (f"  {'by profile':>22}" if profiled else ""))

    def span(a: float | None, b: float | None) -> str:
        shown = (f"{v:.5f}" if v is not None else "open" for v in (a, b))
        return f"{' to '.join(shown):>22}"

    for r in rows:
        value = "open" if r["estimate"] is None else f"{r['estimate']:.5f}"
        error = "open" if r["standard_error"] is None else f"{r['standard_error']:.5f}"
        line = (
            f"{r['name']:<{width}}  {r['meaning']:<{wide}}  {value:>10}  {error:>10}  "
            f"{span(r['low'], r['high'])}"
        )
        if profiled:
            line += f"  {span(r.get('profile_low'), r.get('profile_high'))}"
        lines.append(line)
    lines += ["", "correlations"]
    for i, r in enumerate(rows):
        cells = (f"{c:+6.2f}" if c is not None else "     -"
                 for c in found["correlation"][i][: i + 1])  # fmt: skip
        lines.append(f"{r['name']:<{width}}  {' '.join(cells)}")
    lines.append("")
    for ridge in found["ridges"]:
        a, b = (words(n) for n in ridge["pair"])
        sign = "the sum" if ridge["correlation"] < 0 else "the difference"
        lines.append(
            f"ridge: {a} and {b} are told apart poorly (correlation "
            f"{ridge['correlation']:+.3f}); {sign} of the two is known far better than either"
        )
    lines += [f"undetermined: {w}" for w in found["undetermined"]]
    lines += [f"hardly determined: {w}" for w in found["hardly_determined"]]
    lines += [f"at its bound, no interval: {n}" for n in found["at_bound"]]
    p = found["p_value"]
    lines.append(
        f"chi2 {found['chi2']:.1f} with {found['degrees_of_freedom']} degrees of freedom"
        + (f" (p = {p:.3g})" if p is not None else "")
        + f": {found['verdict']}"
    )
    misfit = ", ".join(f"{n} {m['rms']:.2f} ({m['readings']})" for n, m in found["misfit"].items())
    lines.append(f"rms residual in sigmas (readings): {misfit}")
    lines.append("(for Wf and PW below 1: their true values are fitted sample by sample)")
    open_ = [n for n in INPUTS if n not in found["misfit"]]
    if open_:
        lines.append(f"not measured, and left open: {', '.join(open_)}")
    if found["considered"]:
        lines.append(f"intervals include the uncertainty of {', '.join(found['considered'])}")
    if found.get("assumed_ambient"):
        taken = ", ".join(f"{n} = {v:g}" for n, v in found["assumed_ambient"].items())
        lines.append(
            f"assumed, since neither option nor column gives it: {taken}; a wrong ambient "
            "condition is taken for a change of health"
        )
    lines += [f"read: {n}" for n in found.get("read_as", ())]
    for file, values in found.get("recorded_ambient", {}).items():
        taken = ", ".join(f"{n} = {v:g}" for n, v in values.items())
        lines.append(f"ambient conditions as the run file says, {file}: {taken}")
    if "apu_casadi_version" in found:
        lines.append(f"apu-casadi {found['apu_casadi_version']}")
    if found["ignored_columns"]:
        lines.append(f"columns not used: {', '.join(found['ignored_columns'])}")
    return "\n".join(lines)


def _day(ambient: Mapping[str, Any]) -> str:
    """Ambient conditions in words; those that change from row to row by their name alone."""
    import numpy as np

    fixed = {n: float(v) for n, v in ambient.items() if np.ndim(v) == 0}
    moving = [n for n in ambient if n not in fixed]
    return day_words(fixed) + (f", but {' and '.join(moving)} as recorded" if moving else "")


def _draw(fit: EngineFit, path: str, steady: bool, days: Sequence[Mapping[str, Any]]) -> list[Path]:
    """Draw one figure for each file; a number is put before the ending when there are several."""
    from apu_casadi.core import files
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from scenarios.figures.fitplot import plot_fit

    first = Path(path)
    if first.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise ParameterError(f"--figure {path!r}: .png, .pdf or .svg is expected")
    units = {s.name: s.unit for s in GasGenerator.Y}
    r, made = fit.result, []
    note = "; ".join(f"{n} = {v:.4f} ± {1.96 * s:.4f}" for n, v, s in
                     zip(r.names, r.estimate, r.sigma, strict=True))  # fmt: skip
    for k, name in enumerate(fit.names):
        target = first if len(fit.names) == 1 else first.with_stem(f"{first.stem}_{k + 1}")
        t = fit.recordings[k].t
        fig = plot_fit(
            t + 1 if steady else t, fit.series(k), units, steady=steady,
            heading=f"{name}: measured and fitted",
            note=f"95 %: {note}. Ambient: {_day(days[k])}; {program()}.",
        )  # fmt: skip
        made.append(files.save_figure(fig, target))
    return made
