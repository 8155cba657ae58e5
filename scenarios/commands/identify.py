"""Tell what can be known of the faults from given sensors, before anything is estimated.

Gas path at steady points: what no reading shows, bounds, faults that are taken for each other, the
size at which each becomes visible, and the sensor that would help most:

  apu identify --sensors N,P3,T3,T5
  apu identify --point design,partload --gain-errors

Then what measured shaft power is worth, and what of a stator fault's severity can be known.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from apu_casadi.core.version import installed
from apu_casadi.gaspath.conditions import DEFAULT_DAY, day_words
from scenarios.commands import given
from scenarios.shell import jsontext, progress, usage
from scenarios.shell.template import Template

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from apu_casadi.machine.generator import Generator
    from estimators.apu.sensors import SensorSet
    from estimators.apu.severity import Severity
    from estimators.apu.trials import Trials
    from estimators.information.identifiability import Identifiability, SensorComparison

NAME = "identify"
_PARTS = (*given.TABLES, *given.MACHINE)
SWEPT = (0.005, 0.01, 0.02, 0.05, 0.1)  # priors of the printed sweep
HELP = "tell what can be known of the faults from given sensors"
OPTIONS = f"""
--point A,B =design  | design, offdesign, partload, idle; several: read at each (default
                     | %(default)s)
--sensors A,B        | that are there (default N,P3,T3,T5,Wf); or a file of sensors, .toml
{given.UNIT}
--prior float PCT =2.0 | 1 sigma of each health factor before, %% (default 2)
--samples int N =50  | samples of 20 ms that are averaged (default 50)
--eta-bias float PCT =2.0 | 1 sigma of the generators' efficiency, %% (default 2)
--shares A,B         | powers of the generators, in any unit: the efficiency of each then errs
                     | on its own (default: they err alike)
--generator int N =1 | generator whose short circuits are looked at (default %(default)s)
--gain-errors        | consider the sensors' gain errors
--transient          | also a load ramp of 5 s; takes some seconds
--trials int N =0    | also estimate from N random snapshots, 12 ms each, to confirm the bounds
--json               | print JSON
--figure FILE        | draw what shaft power is worth (.png, .pdf or .svg)
{given.LOOK}
"""


def run(args: argparse.Namespace) -> int:
    """Compute, print and draw."""
    from apu_casadi.core.errors import ParameterError
    from estimators.apu import identify as study

    usage.count("--trials", args.trials, least=0)
    usage.count("--samples", args.samples, most=1_000_000_000)
    if not (args.prior > 0 and args.eta_bias >= 0):
        raise ParameterError(
            "--prior > 0, --eta-bias >= 0, --samples >= 1 and --trials >= 0 expected, got "
            f"{args.prior:g}, {args.eta_bias:g}, {args.samples:g}, {args.trials:g}"
        )
    given.parts(args)
    look = given.look(args)
    alone = [given.number(x, "--shares", x) for x in given.names(args.shares or "1")]
    args.bias = study.independent_bias(args.eta_bias / 100, alone)
    args.aside = study.independent_bias(1.0, alone)
    machine = _machine(args)
    table, sensors = _named(args, study.BASE)
    sets, added = _sets(args, table, sensors)
    f = _found(args, machine)
    if args.figure is not None:
        figure = _figure(f.point, args.samples, _engine(args), given.program(args))
        look.save_as(figure, args.figure)
    if args.json:
        jsontext.show(_report(args, sensors, sets, added, f))
        return 0
    these = sets["these"]
    lines = [*_heading(args, sensors), *_known(these), *_confounded(these)]
    lines += [*_sensors(sets, added), *_power(f), *_swept(f.sweep), *_trials(f.trials)]
    lines += [*(_ramp(args, f.ramp) if f.ramp else []), *_electrical(f.electrical)]
    print("\n".join(lines))
    if args.figure is not None:
        print(f"\n{args.figure}")
    return 0


def _named(args: argparse.Namespace, base: Sequence[str]) -> tuple[SensorSet, Sequence[str]]:
    """Return all sensors in question, and the names of those that are there."""
    from estimators.apu.identify import CANDIDATES
    from estimators.apu.sensorfile import read_sensors
    from estimators.apu.sensors import SensorSet

    if args.sensors is None or not args.sensors.endswith(".toml"):
        names = base if args.sensors is None else given.names(args.sensors)
        return CANDIDATES.including(*names), names
    found = read_sensors(args.sensors)
    own, power = found.gas_path, ("PW",) if not found.complete else ()
    more = [s for s in CANDIDATES.sensors if s.name not in own]
    # shaft power is a question of its own unless the file is about all that there is
    return SensorSet((*own.sensors, *more)), [n for n in own.names if n not in power]


def _sets(
    args: argparse.Namespace, table: SensorSet, sensors: Sequence[str]
) -> tuple[SensorComparison, list[dict[str, Any]]]:
    """Compare the sensors with sets that have one more, and rank what to add."""
    from estimators.apu import identify as study
    from estimators.information.identifiability import compare_sensors, which_to_add

    how: dict[str, Any] = {"prior": args.prior / 100, "samples": args.samples}
    how["sensors"] = table
    how |= {"eta_bias": args.bias, "gain_errors": args.gain_errors, **_engine(args)}
    g = study.gas_path(args.point, **how)
    more = [s for s in g.sensors if s not in sensors]
    sets = {"these": list(sensors), **{f"+ {s}": [*sensors, s] for s in more}}
    return compare_sensors(g, sets), which_to_add(g, sensors, more)


def _engine(args: argparse.Namespace) -> dict[str, GasGenerator]:
    return {} if args.engine is None else {"gas_generator": given.engine(args, _PARTS)}


def _machine(args: argparse.Namespace) -> Generator | None:
    """Return the generator of ``--generator``; None for the default one.

    Raises:
        ParameterError: the unit has no such generator, or another number of shares is given.
    """
    from apu_casadi.core.errors import ParameterError

    if args.engine is None and args.generator == 1 and args.shares is None:
        return None
    shares: str | None = args.shares
    gens = given.engine_file(args, _PARTS).unit.generators
    if not 1 <= args.generator <= len(gens):
        has = f"the unit has generators 1 to {len(gens)}"
        raise ParameterError(f"--generator {args.generator}: {has}")
    if shares is not None and len(given.names(shares)) != len(gens):
        raise ParameterError(f"--shares {shares}: the unit has {len(gens)} generators")
    found: Generator = gens[args.generator - 1]
    return found


@dataclass(frozen=True)
class Found:
    """What shaft power and the electrical side tell, at the first point.

    Args:
        point: its name.
        power: what shaft power is worth, by variant.
        sweep: the same over priors and power noises.
        why, noise: its worth with one gain error, and without the noise of one sensor.
        needed: averaged samples that reach the aim, by variant.
        electrical: what of a stator fault's severity can be known.
        trials: estimates from random snapshots, by variant.
        ramp: the load ramp without and with power, if asked for.
    """

    point: str
    power: dict[str, dict[str, Any]]
    sweep: list[dict[str, Any]]
    why: dict[str, float]
    noise: dict[str, float]
    needed: dict[str, int | None]
    electrical: list[Severity]
    trials: dict[str, Trials]
    ramp: dict[str, Identifiability] | None


def _found(args: argparse.Namespace, machine: Generator | None) -> Found:
    from estimators.apu import identify as study
    from estimators.apu.severity import severity_study
    from estimators.apu.trials import snapshot_trials
    from estimators.information.identifiability import identify

    first, prior = given.names(args.point)[0], args.prior / 100
    engine = _engine(args)
    options: dict[str, Any] = {"prior": prior, "samples": args.samples, **engine}
    bias, seeds = study.ETA_BIAS * args.aside, range(10_000, 10_000 + args.trials)
    variants = {
        n: {k: bias if k == "eta_bias" else x for k, x in v.items()}
        for n, v in study.VARIANTS.items()
    }
    snapshot, needed = study.shaft_power_snapshot, study.needed_samples
    power = {n: snapshot(first, **{**options, **v}) for n, v in variants.items()}
    at = {"swept": {"samples": args.samples, **engine}}
    how: dict[str, Any] = {"prior": prior, **engine}
    aims = {n: needed(a, first, **how, **variants[n]) for n, a in study.AIMS.items()}
    trials = {}
    if args.trials:
        progress.tell(f"estimating from {args.trials} snapshots, several times", quiet=args.json)
        for n in study.AIMS:
            trials[n] = snapshot_trials(first, seeds=seeds, **options, **variants[n])
    ramp = None
    if args.transient:
        powers = {"without PW": False, "with PW": True}
        transient = study.gas_path_transient
        ramp = {n: identify(transient(power=p, **how)) for n, p in powers.items()}
    return Found(
        first,
        power,
        study.snapshot_sweep(first, priors=SWEPT, variants=at),
        study.limiting_gains(first, eta_bias=bias, **options),
        study.limiting_noises(first, **how),
        aims,
        severity_study(generator=machine),
        trials,
        ramp,
    )


def _report(
    args: argparse.Namespace,
    sensors: Sequence[str],
    sets: SensorComparison,
    added: list[dict[str, Any]],
    f: Found,
) -> dict[str, Any]:
    """Return everything ready for JSON."""
    these = sets["these"]
    return {
        "point": args.point,
        "prior": args.prior / 100,
        "samples": args.samples,
        "eta_bias": args.eta_bias / 100,
        **_asked(args),
        "gain_errors": args.gain_errors,
        "sensors": list(sensors),
        "points": {n: _condition(args, n) for n in given.names(args.point)},
        "trial_seeds": [10_000, 10_000 + args.trials] if args.trials else None,
        "apu_casadi_version": installed(),
        **given.own(args),
        **given.assumed(args),
        "sentences": these.sentences(),
        "rank": these.rank,
        "rank_in_noise": these.rank_in_noise,
        "singular": these.singular.tolist(),
        "pairs": [{k: getattr(p, k) for k in _PAIR} for p in these.pairs],
        "mimics": [{"fault": m.fault, "by": dict(m.by), "share": m.share} for m in these.mimics],
        "sets": sets.rows(),
        "add": added,
        "shaft_power": f.power,
        "shaft_power_swept": f.sweep,
        "shaft_power_with_one_gain_error": f.why,
        "shaft_power_without_one_noise": f.noise,
        "samples_needed": f.needed,
        "trials": {k: dataclasses.asdict(t) for k, t in f.trials.items()},
        "severity": [_severity_row(s) for s in f.electrical],
        "transient": None if f.ramp is None else {k: r.rows() for k, r in f.ramp.items()},
    }


def _asked(args: argparse.Namespace) -> dict[str, Any]:
    """Return which generator, and their shares with what is left of the bias, where given."""
    told = {} if args.generator == 1 else {"generator": args.generator}
    shares = {"shares": args.shares, "eta_bias_of_all": args.bias} if args.shares else {}
    return {**told, **shares}


_PAIR = ["first", "second", "angle", "correlation", "size", "confounded"]


def _wrap(text: str, first: str = "- ") -> list[str]:
    import textwrap

    return textwrap.wrap(text, 98, initial_indent=first, subsequent_indent=" " * len(first))


@cache
def _template() -> Template:
    return Template.of("identify.md")


def _say(block: str, **values: Any) -> list[str]:
    """Return the paragraphs of a block of the template, wrapped."""
    paragraphs = _template().text(block, **values).split("\n\n")
    return [line for p in paragraphs for line in _wrap(p)]


def _pct(value: float) -> str:
    return f"{100 * value:8.2f}" if math.isfinite(value) else f"{'-':>8}"


def _heading(args: argparse.Namespace, sensors: Sequence[str]) -> list[str]:
    gains = "considered" if args.gain_errors else "none"
    return [
        f"Gas path at {args.point}, from {', '.join(sensors)}",
        f"{args.samples} samples of 20 ms averaged, prior {args.prior:g} % on each health factor; "
        f"gain errors: {gains};",
        f"true speed and fuel flow unknown; efficiency behind PW known to {_bias(args)}; "
        "noise: estimators.apu.sensors.",
        *(f"{n}: {_condition_words(args, n)}; healthy engine" for n in given.names(args.point)),
        given.program(args)
        + (f"; short circuits of generator {args.generator}" if args.generator != 1 else "")
        + (f"; trials with seeds from 10000, {args.trials}" if args.trials else ""),
    ]


def _bias(args: argparse.Namespace) -> str:
    if args.shares is None:
        return f"{args.eta_bias:g} %"
    of = f"generators with shares {args.shares}, {args.eta_bias:g} % each on its own"
    return f"{100 * args.bias:.3g} % ({of})"


def _condition_words(args: argparse.Namespace, point: str) -> str:
    c = _condition(args, point)
    return f"shaft power {c['PW'] / 1e3:g} kW, {day_words(c['ambient'])}"


def _condition(args: argparse.Namespace, point: str) -> dict[str, Any]:
    """Shaft power and all ambient conditions of a named point."""
    from estimators.apu.identify import condition

    at = condition(point, given.engine(args, _PARTS))
    return {"PW": at["PW"], "ambient": {n: at.get(n, v) for n, v in DEFAULT_DAY.items()}}


def _known(r: Identifiability) -> list[str]:
    rank = f"rank {r.rank} of {len(r.given.faults)}, {r.rank_in_noise} above the noise"
    lines = ["", f"What can be known ({rank} for changes of 1 %)"]
    for sentence in r.sentences():
        lines += _wrap(sentence)
    lines += [
        "",
        f"  {'1 sigma, %':<12}{'before':>8}{'bound':>8}{'no prior':>10}   visible from, %: "
        f"{'alone':>6}{'among others':>14}",
    ]
    for row in r.rows():
        lines.append(
            f"  {row['fault']:<12}{_pct(row['prior'])}{_pct(row['sigma'])}"
            f"  {_pct(row['sigma_flat'])}{'':19}{_pct(row['visible_alone'])}"
            f"{'':6}{_pct(row['visible_among'])}  {row['doc']}"
        )
    lines.append(
        f"  visible: detected with probability {r.P_d:g} at a false-alarm probability of {r.P_fa:g}"
    )
    return lines


def _confounded(r: Identifiability) -> list[str]:
    lines = ["", "What is taken for what"]
    done: set[frozenset[str]] = set()
    for p in r.pairs:
        if p.confounded and frozenset((p.first, p.second)) not in done:
            done.add(frozenset((p.first, p.second)))
            lines += _say("pair" if math.isfinite(p.size) else "pair at no size", p=p)
    for m in r.mimics:
        size = r.given.size[r.given.theta.index(m.fault)]
        by = " and ".join(f"{n} {100 * a:+.2f} %" for n, a in m.by)
        how = "exactly" if m.share < 1e-6 else f"but for {100 * m.share:.0f} % of its signature"
        lines += _say("mimic", fault=m.fault, size=size, by=by, how=how)
    if len(lines) == 2:
        lines.append("- no fault is imitated by others")
    return lines


def _sensors(c: SensorComparison, added: list[dict[str, Any]]) -> list[str]:
    lines = ["", "Which sensor to add: size that becomes visible among the others (1 sigma), %"]
    lines.append(f"  {'':<10}{'rank':>5}" + "".join(f"{n:>18}" for n in c.faults))
    for label, r in c.sets.items():
        cells = "".join(
            f"{100 * a:9.2f} ({100 * s:5.2f})" + " " for a, s in zip(r.among, r.sigma, strict=True)
        )
        lines.append(f"  {label:<10}{r.rank:>5}  {cells}")
    for row in added:
        better = [(n, v) for n, v in row["ranking"][1:] if v < 0.99 * row["before"]]
        others = ", ".join(f"{n} {100 * v:.2f} %" for n, v in better)
        then = f" (then {others})" if others else ""
        lines += _say("add nothing" if row["add"] is None else "add", **row, then=then)
    return lines


def _shares(values: Mapping[str, float]) -> str:
    return ", ".join(f"{n} {100 * v:.0f} %" for n, v in values.items())


def _power(f: Found) -> list[str]:
    from estimators.apu.identify import AIMS, PRIOR

    one = next(iter(f.power.values()))
    null = ", ".join(f"{n} {v:+.3f}" for n, v in one["null"].items() if abs(v) > 1e-6)
    # the aims are stated for one prior
    aimed = one["prior"] == PRIOR
    aims = "aim" if aimed else ""
    lines = [
        "",
        f"What measured shaft power is worth at {f.point}: reduction of the 1 sigma, %",
        f"  {'':<18}{aims:>6}{'rms':>7}"
        + "".join(f"{n:>9}" for n in one["before"])
        + "   null direction, 1 sigma %",
    ]
    for label, r in f.power.items():
        aim = f"{100 * AIMS[label]:.0f}" if aimed and label in AIMS else ""
        cells = "".join(f"{100 * v:9.1f}" for v in r["reduction_of"].values())
        lines.append(
            f"  {label:<18}{aim:>6}{100 * r['reduction']:7.1f}{cells}"
            f"   {100 * r['null_before']:.2f} -> {100 * r['null_after']:.2f}"
        )
    lines += _say("bias", eta=f.power["efficiency bias"]["eta_bias"], null=null)
    for label, n in f.needed.items():
        lines += _say("needed" if n else "never reached", label=label, aim=AIMS[label], n=n)
    for label in AIMS:
        if aimed and f.power[label]["reduction"] < AIMS[label]:
            lines += _say("missed", label=label)
    return [*lines, *_say("limits", why=_shares(f.why), noise=_shares(f.noise))]


def _swept(sweep: list[dict[str, Any]]) -> list[str]:
    heads = "".join(f"{f'prior {100 * p:g} %':>16}" for p in SWEPT)
    lines = [
        "",
        "Its reduction of the rms, % (null direction's 1 sigma), exact efficiency",
        f"  {'power noise, %':<16}{heads}",
    ]
    for noise in dict.fromkeys(r["power_noise"] for r in sweep):
        rows = [r for r in sweep if r["power_noise"] == noise]
        lines.append(
            f"  {100 * noise:<16g}"
            + "".join(f"{100 * r['reduction']:8.1f} ({100 * r['null_after']:5.2f})" for r in rows)
        )
    return lines


def _trials(trials: dict[str, Trials]) -> list[str]:
    lines = []
    for label, t in trials.items():
        before, bound = 100 * t.rms_before, 100 * t.bound_before
        lines += _say("trials", label=label, t=t, before=before, bound=bound)
    return lines


def _ramp(args: argparse.Namespace, ramp: dict[str, Identifiability]) -> list[str]:
    ends = (f"{_condition(args, n)['PW'] / 1e3:g}" for n in ("partload", "design"))
    lines = [
        "",
        f"Load ramp of 5 s, {' to '.join(ends)} kW on the ground: bound on 1 sigma, % "
        "(without prior)",
        "(white noise only: PW 1 % from sample to sample, no efficiency bias, no gain errors)",
    ]
    for label, r in ramp.items():
        cells = ", ".join(
            f"{n} {100 * s:.2f} ({100 * f:.2f})"
            for n, s, f in zip(r.given.faults, r.sigma, r.sigma_flat, strict=True)
        )
        lines += _wrap(f"{label}: {cells}")
        lines += _wrap(r.sentences()[-1], "  ")
    return lines


def _severity_row(s: Severity) -> dict[str, Any]:
    row = {k: getattr(s.fault, k) for k in (x.name for x in s.fault.severities)}
    row |= {"h": s.h, "periods": s.periods, "sigma_log_mu": s.sigma_mu}
    row |= {"sigma_log_k_rf": s.sigma_k_rf, "sigma_log_h": s.sigma_h}
    row |= {"correlation": s.correlation, "rank": s.rank, "rank_with_kappa": s.rank_with_kappa}
    return row | {"reactance_over_resistance": s.ratio}


def _electrical(rows: list[Severity]) -> list[str]:
    def number(v: float) -> str:
        return f"{v:9.4f}" if math.isfinite(v) else f"{'ridge':>9}"

    periods = rows[0].periods
    lines = [
        "",
        f"Severity of a stator short circuit, {periods} electrical periods at 10 kHz, no prior",
        f"  {'mu':>6}{'k_rf':>6}{'kappa':>7}{'h':>10}  1 sigma of log mu{'log k_rf':>10}"
        f"{'log h':>9}   corr.   wL/R",
    ]
    for s in rows:
        corr = f"{s.correlation:+8.3f}" if math.isfinite(s.correlation) else f"{'-':>8}"
        lines.append(
            f"  {s.fault.mu:6g}{s.fault.k_rf:6g}{s.fault.kappa:7g}{s.h:10.2e}{'':10}"
            f"{number(s.sigma_mu)}{number(s.sigma_k_rf)}{number(s.sigma_h)}{corr}"
            f"{abs(s.ratio):7.2f}"
        )
    return [*lines, *_say("severity")]


def _figure(point: str, samples: int, engine: Mapping[str, Any], program: str) -> Any:
    from estimators.apu import identify as study
    from estimators.apu.sensors import GAS_PATH
    from scenarios.figures.estimationplot import plot_gain_of_a_sensor

    noise = GAS_PATH["PW"].noise
    priors = list(study.PRIORS)
    curves = {}
    keys = ("reduction", "null_before", "null_after")
    for label, variant in study.VARIANTS.items():
        variants = {label: {"samples": samples, **engine, **variant}}
        rows = study.snapshot_sweep(point, power_noises=[noise], variants=variants)
        curves[label] = {k: [r[k] for r in rows] for k in keys}
    aims = {label: (study.PRIOR, aim) for label, aim in study.AIMS.items()}
    told = {"point": point, "power": noise, "samples": samples, "eta": study.ETA_BIAS}
    note = f"{_template().text('figure', **told)} {program[0].upper()}{program[1:]}."
    return plot_gain_of_a_sensor(priors, curves, aims=aims, note=note)
