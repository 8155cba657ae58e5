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
from typing import TYPE_CHECKING, Any

from apu_casadi.core.version import installed
from apu_casadi.gaspath.conditions import DEFAULT_DAY, day_words
from scenarios.commands import given
from scenarios.shell import jsontext, progress, usage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from estimators.apu.identify import Severity, Trials
    from estimators.information.identifiability import Identifiability, SensorComparison

NAME = "identify"
SWEPT = (0.005, 0.01, 0.02, 0.05, 0.1)  # priors of the printed sweep
HELP = "tell what can be known of the faults from given sensors"
OPTIONS = f"""
--point A,B =design  | design, offdesign, partload, idle; several: read at each (default
                     | %(default)s)
--sensors A,B        | that are there (default N,P3,T3,T5,Wf)
{given.UNIT}
--prior float PCT =2.0 | 1 sigma of each health factor before, %% (default 2)
--samples int N =50  | samples of 20 ms that are averaged (default 50)
--eta-bias float PCT =2.0 | 1 sigma of the generators' efficiency, %% (default 2)
--gain-errors        | consider the sensors' gain errors
--transient          | also a load ramp of 5 s; takes some seconds
--trials int N =0    | also estimate from N random snapshots, 12 ms each, to confirm the bounds
--json               | print JSON
--figure FILE        | draw what shaft power is worth
"""


def run(args: argparse.Namespace) -> int:
    """Compute, print and draw."""
    from apu_casadi.core import files
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
    sensors = study.BASE if args.sensors is None else given.names(args.sensors)
    sets, added = _sets(args, sensors)
    f = _found(args)
    if args.figure is not None:
        files.save_figure(_figure(f.point, args.samples), args.figure)
    if args.json:
        jsontext.show(_report(args, sensors, sets, added, f))
        return 0
    these = sets["these"]
    lines = [*_heading(args, sensors), *_known(these), *_confounded(these)]
    lines += [*_sensors(sets, added), *_power(f), *_swept(f.sweep), *_trials(f.trials)]
    lines += [*(_ramp(f.ramp) if f.ramp else []), *_electrical(f.electrical)]
    print("\n".join(lines))
    if args.figure is not None:
        print(f"\n{args.figure}")
    return 0


def _sets(
    args: argparse.Namespace, sensors: Sequence[str]
) -> tuple[SensorComparison, list[dict[str, Any]]]:
    """Compare the sensors with sets that have one more, and rank what to add."""
    from estimators.apu import identify as study
    from estimators.information.identifiability import compare_sensors, which_to_add

    how: dict[str, Any] = {"prior": args.prior / 100, "samples": args.samples}
    how |= {"eta_bias": args.eta_bias / 100, "gain_errors": args.gain_errors}
    if args.engine is not None:
        how["gas_generator"] = given.engine(args)
    g = study.gas_path(args.point, **how)
    more = [s for s in g.sensors if s not in sensors]
    sets = {"these": list(sensors), **{f"+ {s}": [*sensors, s] for s in more}}
    return compare_sensors(g, sets), which_to_add(g, sensors, more)


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


def _found(args: argparse.Namespace) -> Found:
    from estimators.apu import identify as study
    from estimators.information.identifiability import identify

    first, prior = given.names(args.point)[0], args.prior / 100
    options = {"prior": prior, "samples": args.samples}
    variants, seeds = study.VARIANTS, range(10_000, 10_000 + args.trials)
    snapshot, needed = study.shaft_power_snapshot, study.needed_samples
    power = {n: snapshot(first, **{**options, **v}) for n, v in variants.items()}
    at = {"swept": {"samples": args.samples}}
    aims = {n: needed(a, first, prior=prior, **variants[n]) for n, a in study.AIMS.items()}
    trials = {}
    if args.trials:
        progress.tell(f"estimating from {args.trials} snapshots, several times", quiet=args.json)
        for n in study.AIMS:
            trials[n] = study.snapshot_trials(first, seeds=seeds, **options, **variants[n])
    ramp = None
    if args.transient:
        powers = {"without PW": False, "with PW": True}
        transient = study.gas_path_transient
        ramp = {n: identify(transient(power=p, prior=prior)) for n, p in powers.items()}
    return Found(
        first,
        power,
        study.snapshot_sweep(first, priors=SWEPT, variants=at),
        study.limiting_gains(first, eta_bias=study.ETA_BIAS, **options),
        study.limiting_noises(first, prior=prior),
        aims,
        study.severity_study(),
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
        "gain_errors": args.gain_errors,
        "sensors": list(sensors),
        "points": {n: _condition(n) for n in given.names(args.point)},
        "trial_seeds": [10_000, 10_000 + args.trials] if args.trials else None,
        "apu_casadi_version": installed(),
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


_PAIR = ["first", "second", "angle", "correlation", "size", "confounded"]


def _wrap(text: str, first: str = "- ") -> list[str]:
    import textwrap

    return textwrap.wrap(text, 98, initial_indent=first, subsequent_indent=" " * len(first))


def _pct(value: float) -> str:
    return f"{100 * value:8.2f}" if math.isfinite(value) else f"{'-':>8}"


def _heading(args: argparse.Namespace, sensors: Sequence[str]) -> list[str]:
    gains = "considered" if args.gain_errors else "none"
    return [
        f"Gas path at {args.point}, from {', '.join(sensors)}",
        f"{args.samples} samples of 20 ms averaged, prior {args.prior:g} % on each health factor; "
        f"gain errors: {gains};",
        f"true speed and fuel flow unknown; efficiency behind PW known to {args.eta_bias:g} %; "
        "noise: estimators.apu.sensors.",
        *(f"{n}: {_condition_words(n)}; healthy engine" for n in given.names(args.point)),
        given.program() + (f"; trials with seeds from 10000, {args.trials}" if args.trials else ""),
    ]


def _condition_words(point: str) -> str:
    c = _condition(point)
    return f"shaft power {c['PW'] / 1e3:g} kW, {day_words(c['ambient'])}"


def _condition(point: str) -> dict[str, Any]:
    """Shaft power and all ambient conditions of a named point."""
    from estimators.apu.identify import POINTS

    at = POINTS[point]
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
        if not p.confounded or frozenset((p.first, p.second)) in done:
            continue
        done.add(frozenset((p.first, p.second)))
        told = (
            f"told apart, if one alone is there, from {p.first} {100 * p.size:.2f} %"
            if math.isfinite(p.size)
            else "not told apart at any size"
        )
        lines += _wrap(
            f"{p.first} and {p.second}: signatures {p.angle:.0f} degrees apart, estimates "
            f"correlated {p.correlation:+.3f}; {told}."
        )
    for m in r.mimics:
        size = r.given.size[r.given.theta.index(m.fault)]
        by = " and ".join(f"{n} {100 * a:+.2f} %" for n, a in m.by)
        how = "exactly" if m.share < 1e-6 else f"but for {100 * m.share:.0f} % of its signature"
        lines += _wrap(f"{m.fault} {100 * size:+.2f} % is imitated by {by}, {how}.")
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
        if row["add"] is None:
            text = f"{row['fault']}: no sensor of these helps by 1 % or more"
        else:
            text = (
                f"{row['fault']}: add {row['add']}; visible from {100 * row['after']:.2f} % "
                f"instead of {100 * row['before']:.2f} %"
            )
            others = [
                f"{n} {100 * v:.2f} %" for n, v in row["ranking"][1:] if v < 0.99 * row["before"]
            ]
            text += f" (then {', '.join(others)})" if others else ""
        lines += _wrap(f"{text}.")
    return lines


def _power(f: Found) -> list[str]:
    from estimators.apu.identify import AIMS, ETA_BIAS, PRIOR

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
    lines += _wrap(
        f"1 % power noise, not averaged; bias: efficiency known to {100 * ETA_BIAS:g} %, "
        f"considered. Null direction, unit length: {null}."
    )
    for label, n in f.needed.items():
        text = f"{label}: a reduction of {100 * AIMS[label]:.0f} % "
        text += (
            f"needs {n} averaged samples of 20 ms or more" if n else "is not reached by averaging"
        )
        lines += _wrap(f"{text}.")
    for label in AIMS:
        if aimed and f.power[label]["reduction"] < AIMS[label]:
            lines += _wrap(f"{label}: the aim is MISSED with these samples; see below.")
    parts = ", ".join(f"{n} {100 * v:.0f} %" for n, v in f.why.items())
    lines += _wrap(
        "With gain errors every gain opens a direction of its own, in which shaft power says "
        f"little: one alone leaves a reduction of {parts}. A healthy baseline removes them."
    )
    parts = ", ".join(f"{n} {100 * v:.0f} %" for n, v in f.noise.items())
    lines += _wrap(
        "With one sample the noise leaves all directions wide, and shaft power narrows only one: "
        f"without the noise of one sensor the reduction is {parts}. Averaging is the remedy."
    )
    return lines


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
        low, high = t.interval
        lines += _wrap(
            f"{label}, {t.seeds} random snapshots of the nonlinear engine: rms error "
            f"{100 * t.rms_before:.2f} -> {100 * t.rms_after:.2f} % (bounds "
            f"{100 * t.bound_before:.2f} -> {100 * t.bound_after:.2f} %), reduction "
            f"{100 * t.reduction:.1f} % (95 %: {100 * low:.1f} to {100 * high:.1f} %); NEES/4 "
            f"{t.nees:.3f}, 95 % band {t.nees_band[0]:.3f} to {t.nees_band[1]:.3f}."
        )
    return lines


def _ramp(ramp: dict[str, Identifiability]) -> list[str]:
    lines = [
        "",
        "Load ramp of 5 s, 222 to 500 kW on the ground: bound on 1 sigma, % (without prior)",
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
    row = {k: getattr(s.fault, k) for k in ("mu", "k_rf", "kappa")}
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
    lines += _wrap(
        "kappa = mu: mu and k_rf move the current along one and the same direction; only h = "
        "mu/(k_rf + 1 - mu) can be known, and (mu, k_rf) is a ridge of constant h."
    )
    lines += _wrap(
        "kappa > mu, and known: the shunt's reactance tells mu from k_rf. With wL/R far below one "
        "the ridge comes back; far above one mu is known, k_rf hardly."
    )
    lines += _wrap(
        "kappa unknown: (mu, k_rf, kappa) again has a ridge, for the terminals show two numbers, "
        "R = r_s/h and L = (kappa - mu) L_ls/mu."
    )
    lines += _wrap(
        "Bounds, and optimistic ones: voltages, speed and the healthy machine are taken as known, "
        "the current's gain to 0.5 %."
    )
    return lines


def _figure(point: str, samples: int) -> Any:
    from estimators.apu import identify as study
    from scenarios.figures.estimationplot import plot_gain_of_a_sensor

    noise = study.GAS_PATH["PW"].noise
    priors = list(study.PRIORS)
    curves = {}
    for label, variant in study.VARIANTS.items():
        rows = study.snapshot_sweep(
            point, power_noises=[noise], variants={label: {"samples": samples, **variant}}
        )
        curves[label] = {
            k: [r[k] for r in rows] for k in ("reduction", "null_before", "null_after")
        }
    return plot_gain_of_a_sensor(
        priors,
        curves,
        aims={label: (study.PRIOR, aim) for label, aim in study.AIMS.items()},
        note=(
            f"Bound on the four health factors at {point} from N, P3, T3, T5 and Wf, without and "
            f"with shaft power of {100 * noise:g} % noise; {samples} samples of 20 ms averaged "
            f"unless said otherwise. Efficiency bias {100 * study.ETA_BIAS:g} %, considered; gain "
            "errors as in the sensor table. Error: rms of the four standard deviations."
        ),
    )
