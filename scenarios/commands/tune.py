"""Find noise by maximum likelihood: Q and R of a filter from a recording, with bands.

FILE is read as apu estimate data reads it; several are one recording.  The filter is that of the
gas path, or with --only electrical that of a generator, in which the three severities and declared
gain errors are states.  --noise names outputs whose noise is found (R), --walk states whose random
walk is (Q), --inputs measured inputs; each start is what the table of sensors and the filter have.
A band is 95 %; what cannot be told from zero has an upper limit.  Whether the model explains the
recording at all is said below: noise cannot.

  apu tune run_gaspath.csv
  apu tune run_gaspath.csv --noise P3,T5 --walk N,f_eta_c --out results/tune
  apu tune waves.csv --only electrical --inputs v_a,v_b,v_c
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from scenarios.commands import given, readingoptions

if TYPE_CHECKING:
    from estimators.batch.noisefit import NoiseFit

SHORT = 10_000  # samples
NAME = "tune"
HELP = "find noise of sensors and model from a recording, by maximum likelihood"
OPTIONS = f"""
files FILE + | recorded data, CSV, Parquet or netCDF
--only {{gaspath,electrical}} | of which filter (default: of the gas path, if it was measured)
--machine int N | number of the generator (default: the first that was measured)
--noise A,B  | outputs whose noise is found (default: all that were measured)
--walk A,B   | states whose random walk is found (default: N of the gas path, else none)
--inputs A,B = | measured inputs whose noise is found: Wf, PW; v_a, v_b, v_c, V_fd, w_r
{given.UNIT}
{readingoptions.OPTIONS.strip()}
--sensors FILE | what the sensors are (TOML, as apu measure); default: apu estimate sensors
--prior FILE   | what is known of the gas path before (TOML): mean and sigma by state
{given.ambient_options("a column, what the run file says, else ")}
--out DIR      | keep JSON and figure there
{given.FIGURES}
--json         | print JSON only
--quiet        | no list of files
"""


def run(args: argparse.Namespace) -> int:
    """Read, fit, print; return 0."""
    from estimators.apu.gaspath import ITERATED, ITERATIONS
    from estimators.apu.recorded_estimate import electrical_data, gas_path_data
    from estimators.apu.sensorfile import read_sensors
    from estimators.batch.noisefit import fit_noise
    from scenarios.figures.noiseplot import plot_noise
    from scenarios.shell import progress

    given.drawn(args)  # refused before anything is computed
    apu = given.engine_file(args).unit
    m = readingoptions.recording(args, apu.gas_generator)
    sensors = read_sensors(args.sensors)
    waves = args.only == "electrical" or (args.only is None and not m.gaspath)
    how: dict[str, Any] = {}
    filt: Any
    if waves:
        filt, data, prior, notes = electrical_data(m, apu, machine=args.machine, sensors=sensors)
        measured = list(filt.model.y.names)
        # compiling takes longer than all iterations of a recording of a second
        how = {"backend": "vm"} if data.size <= SHORT else {}
    else:
        day = readingoptions.day(args, m)
        found_by = gas_path_data(m, apu, sensors=sensors, ambient=day, prior=args.prior)
        filt, data, prior, notes = found_by
        measured = [n for n in filt.model.y.names if n in m]
        how = {"iterations": ITERATIONS, "iterated": ITERATED}
    progress.tell(f"fitting noise to {', '.join(m)}", quiet=args.quiet or args.json)
    walk = "" if waves else "N"
    found = fit_noise(
        filt.model,
        prior,
        data,
        noise=measured if args.noise is None else given.names(args.noise),
        walk=given.names(walk if args.walk is None else args.walk),
        inputs=[f"w_{n}" for n in given.names(args.inputs)],
        **how,
    )
    report = report_of(found) | {"notes": list(notes)}
    return given.report(args, "tune", report, partial(text, report), partial(plot_noise, report))


def report_of(found: NoiseFit) -> dict[str, Any]:
    """Return a fit of noise, ready for JSON."""
    import numpy as np

    rows = []
    each = zip(found.names, found.kinds, found.units, found.start, found.estimate, strict=True)
    for i, (name, kind, unit, start, value) in enumerate(each):
        low, high = found.interval()[i].tolist()
        row: dict[str, Any] = {"name": name, "kind": kind, "label": found.labels[i], "unit": unit}
        row |= {"start": start, "estimate": value}
        row |= {"low": low, "high": high, "told_from_zero": bool(np.isnan(found.upper[i]))}
        rows.append(row | {"spread": float(found.spread[i])})
    correlation = {n: {"value": r, "white": s} for n, (r, s) in found.correlation.items()}
    return {
        "estimates": rows,
        "loglik": found.loglik,
        "loglik_start": found.loglik_start,
        "nis": found.nis,
        "correlation": correlation,
        "doubts": list(found.doubts),
        "iterations": found.iterations,
    }


def text(report: Mapping[str, Any]) -> str:
    """Return the report as text."""
    lines = [f"{'':<24}  {'start':>10}  {'estimate':>10}  {'95 % band':>22}  unit"]
    for r in report["estimates"]:
        band = f"{r['low']:.4g} to {r['high']:.4g}"
        if not r["told_from_zero"]:
            band = f"below {r['high']:.4g}"
        numbers = f"{r['start']:>10.4g}  {r['estimate']:>10.4g}  {band:>22}"
        unit = "of the stated" if r["kind"] == "input" else r["unit"]
        lines.append(f"{r['label']:<24}  {numbers}  {unit}")
    gain = report["loglik"] - report["loglik_start"]
    lines += [
        "",
        f"log-likelihood {report['loglik']:.2f}, {gain:.2f} above the start's; "
        f"mean NIS over readings {report['nis']:.3f} (1 is right)",
    ]
    limits = [r["label"] for r in report["estimates"] if not r["told_from_zero"]]
    lines += [f"cannot be told from zero: {', '.join(limits)}"] if limits else []
    lines += [f"doubt: {d}" for d in report["doubts"]]
    return "\n".join([*lines, *(f"note: {n}" for n in report["notes"])])
