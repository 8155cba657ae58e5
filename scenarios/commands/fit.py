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
import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apu_casadi.core.errors import DataError, ParameterError, nearest
from apu_casadi.core.version import installed
from apu_casadi.gaspath.conditions import AMBIENT, CONDITIONS, DEFAULT_DAY, day_words
from apu_casadi.gaspath.health import HEALTH
from scenarios.commands import given, readingoptions
from scenarios.shell import jsontext, progress

if TYPE_CHECKING:
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from estimators.apu.fitting import EngineData, EngineFit
    from estimators.apu.recordings.recorded import Table
    from estimators.apu.sensors import SensorSet
    from estimators.batch.fitresult import Profile
    from scenarios.figures.drawnas import DrawnAs

NAME = "fit"
HELP = "fit health factors to recorded data (CSV, Parquet, netCDF)"
OPTIONS = f"""
files FILE +           | recorded data (see above)
--estimate A,B ={",".join(HEALTH)} | health factors, gain_SENSOR, bias_SENSOR (default: the
                       | four health factors)
{given.UNIT}
--own A,B =            | gains or biases that each file has for itself
{readingoptions.OPTIONS.strip()}
--steady               | each row is a steady point
--sigma NAME=VALUE ... | standard deviation of a sensor: 0.5%% of the reading, or a number with
                       | unit: 3K
--readings int N =1    | each value is a mean of N readings
--prior NAME=MEAN:SIGMA ... | what is known of a parameter beforehand
--consider NAME=SIGMA ... | uncertain but not estimated; widens the intervals: gain_T5=0.005
--fix NAME=VALUE ...   | a known health factor
{given.ambient_options("a column, what the run file says, else ")}
--profile              | intervals from the profile likelihood too
--figure FILE          | draw measured against fitted (.png, .pdf or .svg)
{given.LOOK}
--json                 | print JSON
--quiet                | no word on progress
"""
MANY = 20  # rows without time from which it is said that they are taken as steady points
RIDGE = 0.95  # correlation from which a pair is said to be confounded


def run(args: argparse.Namespace) -> int:
    """Read, fit, print; return 0."""
    from estimators.apu import fitting
    from estimators.apu.recordings.recorded import read_table
    from estimators.apu.recordings.runfiles import recorded_ambient

    gg = given.engine(args)
    reading, mapping = readingoptions.reading(args, gg)
    _known_targets(mapping, gg)
    notes: list[str] = []
    tables = [read_table(f, mapping, reading=reading, notes=notes) for f in args.files]
    sensors = _sensors(args.sigma, gg)
    times = [None if args.steady else t.time(args.time) for t in tables]
    if len({t is None for t in times}) > 1:
        raise DataError("some files have a time column and some not; --steady takes rows as points")
    steady = times[0] is None
    said = [recorded_ambient(f) for f in args.files]
    each = zip(tables, times, said, strict=True)
    data = [_data(table, t, sensors, gg, args, day) for table, t, day in each]
    ignored = _ignored(tables, sensors, gg, args.time)
    if args.readings < 1:
        raise ParameterError(f"--readings must be >= 1, got {args.readings}")
    rows = sum(d.t.size for d in data)
    if rows > 200:
        _tell(args, f"fitting {rows} samples")
    look = given.look(args)
    how: dict[str, Any] = {"steady": steady, "sensors": sensors, "averaged": args.readings}
    how |= {"own": given.names(args.own), "fixed": given.numbers(args.fix, "--fix")}
    how |= {"prior": _priors(args.prior), "consider": given.numbers(args.consider, "--consider")}
    fit = fitting.fit_engine(data, given.names(args.estimate), gg=gg, **how)
    profiles = _profiles(fit, args) if args.profile else []
    figures = []
    if args.figure:
        ambients = [d.ambient for d in data]
        figures = _draw(fit, args.figure, steady, ambients, given.program(args), look)
    found = report(fit, profiles, ignored, steady=steady)
    found["assumed_ambient"] = _assumed(data)
    found["read_as"] = [*notes, *_unheeded(tables, times, args), *_other_unit(args)]
    days = {t.source: _recorded(t, day, args) for t, day in zip(tables, said, strict=True)}
    found["recorded_ambient"] = {source: taken for source, taken in days.items() if taken}
    found |= {"apu_casadi_version": installed(), **given.own(args)}
    found |= given.assumed(args)
    if args.json:
        jsontext.show(found)
        return 0
    print(text(found))
    for path in figures:
        print(f"\nwritten: {path}")
    return 0


def _tell(args: argparse.Namespace, what: str) -> None:
    progress.tell(what, quiet=args.quiet or args.json)


def _profiles(fit: EngineFit, args: argparse.Namespace) -> list[Profile]:
    from estimators.batch.fit import profile

    profiles = []
    for name in fit.result.names:
        _tell(args, f"profile of {name}")
        if name not in fit.result.at_bound:
            profiles.append(profile(fit.result, name))
    return profiles


# ------------------------------------------------------------------------------ options


def _priors(items: Sequence[str]) -> dict[str, tuple[float, float]]:
    out, form = {}, "NAME=MEAN:SIGMA"
    for p in given.pairs(items, "--prior", form):
        mean, sep, sigma = p.value.partition(":")
        if not sep:
            raise ParameterError(f"--prior {p.item!r}: {form} is expected")
        mean_sigma = (given.number(part, "--prior", p.item) for part in (mean, sigma))
        out[p.name] = (next(mean_sigma), next(mean_sigma))
    return out


def _sensors(items: Sequence[str], gg: GasGenerator) -> SensorSet:
    """The table of sensors, changed and extended by ``--sigma``."""
    from estimators.apu.sensors import KNOWN, Sensor, SensorSet, gas_path_table

    known = {s.name: s for s in gas_path_table().sensors}
    for p in given.pairs(items, "--sigma"):
        if p.name not in gg.Y and p.name not in KNOWN:
            raise ParameterError(
                f"--sigma {p.item!r}: unknown output {nearest(p.name, gg.Y.names)}"
            )
        unit = KNOWN[p.name].unit if p.name in KNOWN else gg.Y[p.name].unit
        noise, relative = _deviation(p, unit)
        new = Sensor(p.name, noise, relative, 0.0, unit, "given by the user")
        if p.name in known:
            new = dataclasses.replace(known[p.name], source="changed by the user")
        elif p.name in KNOWN:
            new = dataclasses.replace(KNOWN[p.name], gain=0.0, source=new.source)
        known[p.name] = dataclasses.replace(new, noise=noise, relative=relative)
    return SensorSet(tuple(known.values()))


def _deviation(p: given.Pair, unit: str) -> tuple[float, bool]:
    """Return a standard deviation in SI, and whether it is relative to the reading."""
    import numpy as np

    from apu_casadi.core.units import UNITS, convert

    # the longest ending that is a unit: 3K, 1.5 kPa, 0.5%, 3 K
    endings = [u for u in UNITS if p.value.endswith(u) and not u[0].isdigit() and u != "-"]
    ending = max(endings, key=len, default="")
    number = given.number(p.value.removesuffix(ending).strip(), "--sigma", p.item)
    relative = ending == "%" and unit != "1"
    if relative:
        number /= 100
    elif ending:
        value = convert(np.array(number), ending, unit, f"--sigma {p.item}", difference=True)
        number = float(value)
    elif unit != "1":
        raise ParameterError(
            f"--sigma {p.item!r}: a unit is needed, % of the reading or one of {unit}"
        )
    if not number > 0:
        raise ParameterError(f"--sigma {p.item!r}: a standard deviation must be > 0")
    return number, relative


def _known_targets(mapping: Mapping[str, Any], gg: GasGenerator) -> None:
    from estimators.apu.sensors import KNOWN

    valid = list(dict.fromkeys([*gg.Y.names, *KNOWN, *AMBIENT, "time"]))
    for name in mapping:
        if name not in valid:
            raise DataError(f"--column {name}=...: unknown quantity {nearest(name, valid)}")


def _data(
    table: Table,
    t: Any,
    sensors: SensorSet,
    gg: GasGenerator,
    args: argparse.Namespace,
    said: Mapping[str, float],
) -> EngineData:
    """Take from a table what the sensors measure, and the ambient conditions.

    An option goes before a column, and that before what a run file says of itself.
    """
    import numpy as np

    from estimators.apu.fitting import INPUTS, EngineData
    from estimators.apu.recordings.thermal import check_temperatures

    readings = {s.name: table.get(s.name, s.unit) for s in sensors.sensors if s.name in table}
    measured = [n for n in readings if n not in INPUTS]
    if not measured:
        raise DataError(
            f"{table.source}: none of the columns {', '.join(table.columns)} is a measured output "
            f"({', '.join(n for n in sensors.names if n not in INPUTS)}); name them with --column"
        )
    ambient: dict[str, Any] = {}
    for name, option in given.ambient_given(args).items():
        if option is not None:
            ambient[name] = option
        elif name in table:
            ambient[name] = table.get(name, gg.U[name].unit, difference=name == "dT_isa")
        elif name in said:
            ambient[name] = said[name]
        if name in ambient:
            _in_range(table.source, name, ambient[name])
    check_temperatures(table.source, readings, ambient, gg, table.reading.ranges)
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
    left = given.ambient_assumed(args)
    return {n: v for n, v in said.items() if n in left and n not in table}


def _unheeded(tables: Sequence[Table], times: Sequence[Any], args: argparse.Namespace) -> list[str]:
    """Say it where a column rises like a time, or flags rows as bad, and is not used."""
    flags = [f for t in tables for f in t.flags()]
    for table, at in zip(tables, times, strict=True):
        hint = table.steady_hint()
        if args.steady or at is not None or (hint is None and table.size < MANY):
            continue
        remedy = f"--time {hint}" if hint else "--rate HZ"
        flags.append(
            f"{table.source}: no time column, so each row is taken as a steady point; if "
            f"{f'{hint} is the time' if hint else 'they are samples of a transient'}, give {remedy}"
        )
    return flags


def _other_unit(args: argparse.Namespace) -> list[str]:
    """Say it where a run is of another unit than the one that is fitted."""
    from estimators.apu.recordings.runfiles import recorded_engine

    runs = [] if args.engine else [(f, recorded_engine(f)) for f in args.files]
    return [f"{f} is a run of {unit}: give --engine {unit}" for f, unit in runs if unit]


def _ignored(
    tables: Sequence[Table], sensors: SensorSet, gg: GasGenerator, time: str | None
) -> list[str]:
    """Columns that the fit does not use, with a guess of what they may be."""
    from apu_casadi.core.tables.timestamps import is_time_name

    out: dict[str, None] = {}
    for table in tables:
        used = {*sensors.names, *AMBIENT, *str(time or table.reading.time).split(" + ")}
        for name in table.columns:
            if name in used or name in table.mapped or is_time_name(name):
                continue
            hint = "no sigma known: give --sigma" if name in gg.Y else ""
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
    from estimators.apu.believable import fit_doubts
    from estimators.apu.fitting import words

    r, doubts = fit.result, list(fit_doubts(fit))

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
        "believable": not doubts,
        "doubts": doubts,
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
        row = found["correlation"][i][: i + 1]
        cells = (f"{c:+6.2f}" if c is not None else "     -" for c in row)
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
    lines += [f"doubt: {d}" for d in found["doubts"]]
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
        engine = f"engine {found['engine']}; " if "engine" in found else ""
        lines.append(f"{engine}apu-casadi {found['apu_casadi_version']}")
    if found["ignored_columns"]:
        lines.append(f"columns not used: {', '.join(found['ignored_columns'])}")
    return "\n".join(lines)


def _day(ambient: Mapping[str, Any]) -> str:
    """Ambient conditions in words; those that change from row to row by their name alone."""
    import numpy as np

    fixed = {n: float(v) for n, v in ambient.items() if np.ndim(v) == 0}
    moving = [n for n in ambient if n not in fixed]
    return day_words(fixed) + (f", but {' and '.join(moving)} as recorded" if moving else "")


def _draw(
    fit: EngineFit,
    path: str,
    steady: bool,
    days: Sequence[Mapping[str, Any]],
    program: str,
    look: DrawnAs,
) -> list[Path]:
    """Draw one figure for each file; a number is put before the ending when there are several."""
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from scenarios.figures.fitplot import plot_fit

    first = Path(path)
    if first.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise ParameterError(f"--figure {path!r}: .png, .pdf or .svg is expected")
    units = {s.name: s.unit for s in GasGenerator.Y}
    r, made = fit.result, []
    each = zip(r.names, r.estimate, r.sigma, strict=True)
    note = "; ".join(f"{n} = {v:.4f} ± {1.96 * s:.4f}" for n, v, s in each)
    how: dict[str, Any] = {"steady": steady}
    for k, name in enumerate(fit.names):
        target = first if len(fit.names) == 1 else first.with_stem(f"{first.stem}_{k + 1}")
        t = fit.recordings[k].t + (1 if steady else 0)
        how["heading"] = f"{name}: measured and fitted"
        how["note"] = f"95 %: {note}. Ambient: {_day(days[k])}; {program}."
        fig = plot_fit(t, fit.series(k), units, **how)
        made.append(look.save_as(fig, target))
    return made
