"""Run a scenario: print its summary phase by phase, and write netCDF, JSON and figures.

SCENARIO is a name of the library (see ``apu list``), a .toml file, or a .py file that defines
``scenario``; a Python file is executed, so run only what you trust.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from typing import Any

from scenarios.commands import given
from scenarios.shell import jsontext
from scenarios.shell.progress import bar

NAME = "run"
HELP = "run a scenario of the library or of a file"
OPTIONS = f"""
scenario SCENARIO      | a name, a .toml or a .py file
{given.WHOLE}
--out DIR              | folder for the files (default results/NAME)
--format NAMES =nc     | of the data, one or several with commas between: nc (netCDF 3), nc4
                       | (compressed; waveforms in single precision), csv, parquet, mat
--json                 | print the summary as JSON only
{given.FIGURES}
--no-waveforms         | keep no waveforms: a small file, rms figures
--phasors              | keep the fundamental phasors of voltages and currents of every exchange
                       | step
--solver NAME =auto    | auto (default): exact and fast where the load is linear, elsewhere CVODES;
                       | cvodes, idas, or propagator, another name of auto
--exchange NAME        | of speed and fuel between the parts: paper, predicted (errs less at the
                       | same price), or corrected; default: the scenario's
--start-from WORD      | balanced: a fault of the start acts from t = 0; settled: it has been there
                       | for long; default: the scenario's
--strict               | stop where the model no longer holds, with the reason and the time
--quiet                | no progress bar, no list of files
"""


def run(args: argparse.Namespace) -> int:
    """Run the scenario and write its results."""
    from scenarios import registry
    from scenarios.shell import notices

    s = given.scenario(args, args.scenario)
    if args.no_waveforms:
        s = s.change(waveform_dt=None)
    if args.exchange is not None:
        s = s.change(exchange=args.exchange)
    if args.start_from is not None:
        s = s.change(start_from=args.start_from)
    formats, drawn = given.formats(args.format), given.drawn(args)
    folder = registry.prepare(args.out or f"results/{s.name}")
    show = not args.quiet and sys.stderr.isatty()
    with bar(s.name, s.duration, show=show) as progress:
        how = {"solver": args.solver, "phasors": args.phasors, "strict": args.strict}
        ds = registry.run(s, progress=progress, **how)
    made = registry.write(ds, folder, figures=drawn or False, name=s.name, formats=formats)
    report = registry.summary(ds)
    notices.tell(report["warnings"])
    if args.json:
        jsontext.show(report)
        return 0
    print(f"{s.name}: {s.title}" if s.title else s.name)
    print(table(report["phases"]))
    print("", *made_with(report), sep="\n")
    if not args.quiet:
        given.written(made)
    return 0


def _faulty(r: dict[str, Any], name: str, form: str) -> str:
    """Return a number of a phase's stator fault: at its end, or of the worst that was before."""
    if not r["mu"] and r["worst"]:
        return f"{r['worst'][name]:{form}} at worst"
    return format(r[name], form) if r["mu"] else "-"


def _mu(r: dict[str, Any]) -> str:
    if not r["mu"]:
        worst = r["worst"]
        return f"0, {100 * worst['mu']:g} at worst" if worst else "healthy"
    return f"{100 * r['mu']:g}"


_ROWS: tuple[tuple[str, Callable[[dict[str, Any]], str]], ...] = (
    ("phase [s]", lambda r: f"{r['start']:g} to {r['end']:g}"),
    # what it follows is told below the table
    ("load of each", lambda r: (r["load"] or "-").partition(";")[0]),
    ("shaft speed [r/min]", lambda r: f"{r['N_rpm']:.1f}"),
    ("  lowest", lambda r: f"{r['N_rpm_min']:.1f}"),
    ("  highest", lambda r: f"{r['N_rpm_max']:.1f}"),
    ("shaft power [kW]", lambda r: f"{r['PW_kW']:.2f}"),
    ("fuel flow [kg/s]", lambda r: f"{r['Wf']:.5f}"),
    ("SFC [kg/(kW h)]", lambda r: f"{r['SFC'] * 3.6e6:.4f}"),
    ("T3 [K]", lambda r: f"{r['T3']:.2f}"),
    ("P3 [kPa]", lambda r: f"{r['P3_kPa']:.2f}"),
    ("T4 [K]", lambda r: f"{r['T4']:.2f}"),
    ("  highest", lambda r: f"{r['T4_max']:.2f}"),
    ("T5 [K]", lambda r: f"{r['T5']:.2f}"),
    ("surge margin [%]", lambda r: f"{r['SM_percent']:.2f}"),
    ("  lowest", lambda r: f"{r['SM_percent_min']:.2f}"),
    ("V rms a [V]", lambda r: f"{r['V_a_rms']:.2f}"),
    ("      b", lambda r: f"{r['V_b_rms']:.2f}"),
    ("      c", lambda r: f"{r['V_c_rms']:.2f}"),
    ("I rms a [A]", lambda r: f"{r['I_a_rms']:.2f}"),
    ("      b", lambda r: f"{r['I_b_rms']:.2f}"),
    ("      c", lambda r: f"{r['I_c_rms']:.2f}"),
    ("V2/V1, I2/I1 [%]", lambda r: _unbalance(r)),
    ("output of each [kW]", lambda r: f"{r['P_e'] / 1e3:.2f}"),
    ("fault loss of each [kW]", lambda r: f"{r['P_loss_fault'] / 1e3:.3f}"),
    ("f_eta_c, f_W_c", lambda r: f"{r['f_eta_c']:g}, {r['f_W_c']:g}"),
    ("f_eta_t, f_W_t", lambda r: f"{r['f_eta_t']:g}, {r['f_W_t']:g}"),
    ("TTSC mu [%]", lambda r: _mu(r)),
    ("  phase", lambda r: r["fault_phase"] or (r["worst"] or {}).get("fault_phase") or "-"),
    ("  k_rf", lambda r: _faulty(r, "k_rf", "g")),
    ("  kappa", lambda r: _faulty(r, "kappa", "g")),
    ("  h = mu/(k_rf + 1 - mu)", lambda r: _faulty(r, "h", ".5f")),
)


def _unbalance(r: dict[str, Any]) -> str:
    names = ("V_2_over_V_1", "I_2_over_I_1")
    return ", ".join(f"{100 * r[n]:.3g}" for n in names) if names[0] in r else "-"


_OF_EACH = {
    "V2/V1, I2/I1 [%]",
    *("load of each", "V rms a [V]", "I rms a [A]", "      b", "      c", "output of each [kW]"),
    *("fault loss of each [kW]", "TTSC mu [%]", "  phase", "  k_rf", "  kappa"),
    "  h = mu/(k_rf + 1 - mu)",
}
"""Rows of what a generator has of its own."""


def made_with(report: dict[str, Any]) -> list[str]:
    """Return the lines that tell what a run was made with, and whether the model holds."""
    from apu_casadi.gaspath.conditions import CONDITIONS, day_words
    from apu_casadi.unit.departures import of_generators
    from apu_casadi.unit.validity import exchange_words

    solver, error = report["solver"] or {}, report["exchange_error"]
    lines = []
    if report["ambient"]:
        followed = {re.split("[,:]", words)[0] for words in report.get("profiles", ())}
        late = "; at first" if followed & set(CONDITIONS) else ""
        lines.append(f"ambient: {day_words(report['ambient'])}{late}")
    lines += [f"profile of {words}" for words in report.get("profiles", ())]
    if solver:
        lines.append(
            f"solver {solver['solver']}, rtol {solver['rtol']:g}, atol {solver['atol']:g}; seed "
            f"{'none' if report['seed'] is None else report['seed']}; apu-casadi "
            f"{report['apu_casadi_version']}"
        )
    own = [f"{k} {report[k]}" for k in ("engine", "governor") if k in report]
    lines += ["; ".join(own)] if own else []
    if error is not None:
        lines.append(exchange_words(error, report["exchange"], report["dt"]))
    left = ", ".join(
        f"{d['quantity']}{of_generators(d.get('generators'))} for {d['duration']:.4g} s from t = "
        f"{d['first']:.6g} s in {p['name']!r}"
        for p in report["phases"]
        for d in p["beyond"]
    )
    lines.append(
        f"beyond the model's limits: {left}" if left else "within the model's limits throughout"
    )
    return lines


def table(rows: list[dict[str, Any]]) -> str:
    """Return the phases side by side; means over the end of each phase, then extremes over it.

    Where generators differ, what each has of its own follows for one after the other.
    """
    several = "generators" in rows[0]
    of_unit = [(name, show) for name, show in _ROWS if not (several and name in _OF_EACH)]
    heads = ["", *(name for name, _ in of_unit)]
    columns = [[r["name"], *(show(r) for _, show in of_unit)] for r in rows]
    own = [(name.replace(" of each", ""), show) for name, show in _ROWS if name in _OF_EACH]
    for k, first in enumerate(rows[0].get("generators", ())):
        heads += [f"generator {first['generator']}", *(f"  {name}" for name, _ in own)]
        for column, r in zip(columns, rows, strict=True):
            column += ["", *(show(r["generators"][k]) for _, show in own)]
    left = max(len(h) for h in heads)
    widths = [max(len(c) for c in column) for column in columns]
    lines = []
    for i, head in enumerate(heads):
        cells = (f"{column[i]:>{w}}" for column, w in zip(columns, widths, strict=True))
        lines.append(f"{head:<{left}}  " + "  ".join(cells))
    lines.insert(1, "-" * len(lines[0]))
    return "\n".join(line.rstrip() for line in lines)
