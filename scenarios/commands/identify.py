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
from typing import TYPE_CHECKING, Any

from apu_casadi.gaspath.conditions import DEFAULT_DAY, day_words
from scenarios.commands.given import program
from scenarios.shell import jsontext, progress, usage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from estimators.apu.severity import Severity
    from estimators.apu.trials import Trials
    from estimators.information.identifiability import Identifiability, SensorComparison

NAME = "identify"
SWEPT = (0.005, 0.01, 0.02, 0.05, 0.1)  # priors of the printed sweep
HELP = "tell what can be known of the faults from given sensors"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--point", default="design", metavar="A,B",
        help="design, offdesign, partload, idle; several: read at each (default %(default)s)",
    )  # fmt: skip
    parser.add_argument("--sensors", metavar="A,B", help="that are there (default N,P3,T3,T5,Wf)")
    parser.add_argument("--prior", type=float, default=2.0, metavar="PCT",
                        help="1 sigma of each health factor before, %% (default 2)")  # fmt: skip
    parser.add_argument("--samples", type=int, default=50, metavar="N",
                        help="samples of 20 ms that are averaged (default 50)")  # fmt: skip
    parser.add_argument("--eta-bias", type=float, default=2.0, metavar="PCT",
                        help="1 sigma of the generators' efficiency, %% (default 2)")  # fmt: skip
    parser.add_argument(
        "--gain-errors", action="store_true", help="consider the sensors' gain errors"
    )
    parser.add_argument(
        "--transient", action="store_true", help="also a load ramp of 5 s; takes some seconds"
    )
    parser.add_argument(
        "--trials", type=int, default=0, metavar="N",
        help="also estimate from N random snapshots, 12 ms each, to confirm the bounds",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--figure", metavar="FILE", help="draw what shaft power is worth")


def run(args: argparse.Namespace) -> int:
    """Compute, print and draw."""
    from apu_casadi.core import files
    from apu_casadi.core.errors import ParameterError
    from estimators.apu import identify as study
    from estimators.apu.severity import severity_study
    from estimators.apu.trials import snapshot_trials
    from estimators.information.identifiability import compare_sensors, which_to_add

    usage.count("--trials", args.trials, least=0)
    usage.count("--samples", args.samples, most=1_000_000_000)
    given = args.prior, args.eta_bias, args.samples, args.trials
    if not (args.prior > 0 and args.eta_bias >= 0 and args.samples >= 1 and args.trials >= 0):
        raise ParameterError(
            "--prior > 0, --eta-bias >= 0, --samples >= 1 and --trials >= 0 expected, got "
            + ", ".join(f"{v:g}" for v in given)
        )
    sensors = study.BASE if args.sensors is None else _names(args.sensors)
    options = {"prior": args.prior / 100, "samples": args.samples}
    table = study.CANDIDATES.including(*sensors)
    biased = {"eta_bias": args.eta_bias / 100, "gain_errors": args.gain_errors}
    g = study.gas_path(args.point, sensors=table, **biased, **options)
    more = [s for s in g.sensors if s not in sensors]
    sets = {"these": list(sensors), **{f"+ {s}": [*sensors, s] for s in more}}
    comparison = compare_sensors(g, sets)
    added = which_to_add(g, sensors, more)
    first = _names(args.point)[0]
    power = {
        label: study.shaft_power_snapshot(first, **{**options, **variant})
        for label, variant in study.VARIANTS.items()
    }
    sweep = study.snapshot_sweep(first, priors=SWEPT, variants={"swept": {"samples": args.samples}})
    why = study.limiting_gains(first, eta_bias=study.ETA_BIAS, **options)
    noise = study.limiting_noises(first, prior=options["prior"])
    needed = {
        label: study.needed_samples(
            study.AIMS[label], first, prior=options["prior"], **study.VARIANTS[label]
        )
        for label in study.AIMS
    }
    electrical = severity_study()
    trials = {}
    if args.trials:
        progress.tell(f"estimating from {args.trials} snapshots, several times", quiet=args.json)
        for label in study.AIMS:
            trials[label] = snapshot_trials(
                first, seeds=range(10_000, 10_000 + args.trials), **options, **study.VARIANTS[label]
            )
    ramp = None
    if args.transient:
        from estimators.information.identifiability import identify

        ramp = {
            label: identify(study.gas_path_transient(power=p, prior=options["prior"]))
            for label, p in (("without PW", False), ("with PW", True))
        }
    if args.figure is not None:
        files.save_figure(_figure(first, options["samples"]), args.figure)
    if args.json:
        report = {
            "point": args.point,
            **options,
            "eta_bias": args.eta_bias / 100,
            "gain_errors": args.gain_errors,
            "sensors": list(sensors),
            "points": {n: _condition(n) for n in _names(args.point)},
            "trial_seeds": [10_000, 10_000 + args.trials] if args.trials else None,
            "apu_casadi_version": program().split()[1],
            "sentences": comparison["these"].sentences(),
            "rank": comparison["these"].rank,
            "rank_in_noise": comparison["these"].rank_in_noise,
            "singular": comparison["these"].singular.tolist(),
            "pairs": [
                {"first": p.first, "second": p.second, "angle": p.angle,
                 "correlation": p.correlation, "size": p.size, "confounded": p.confounded}
                for p in comparison["these"].pairs
            ],
            "mimics": [
                {"fault": m.fault, "by": dict(m.by), "share": m.share}
                for m in comparison["these"].mimics
            ],
            "sets": comparison.rows(),
            "add": added,
            "shaft_power": power,
            "shaft_power_swept": sweep,
            "shaft_power_with_one_gain_error": why,
            "shaft_power_without_one_noise": noise,
            "samples_needed": needed,
            "trials": {k: dataclasses.asdict(t) for k, t in trials.items()},
            "severity": [_severity_row(s) for s in electrical],
            "transient": None if ramp is None else {k: r.rows() for k, r in ramp.items()},
        }  # fmt: skip
        jsontext.show(report)
        return 0
    lines = [
        *_heading(args, sensors),
        *_known(comparison["these"]),
        *_confounded(comparison["these"]),
        *_sensors(comparison, added),
        *_power(power, why, noise, needed, first),
        *_swept(sweep),
        *_trials(trials),
        *(_ramp(ramp) if ramp else []),
        *_electrical(electrical),
    ]
    print("\n".join(lines))
    if args.figure is not None:
        print(f"\n{args.figure}")
    return 0


def _names(text: str) -> list[str]:
    return [n.strip() for n in text.split(",") if n.strip()]


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
        *(f"{n}: shaft power {c['PW'] / 1e3:g} kW, {day_words(c['ambient'])}; healthy engine"
          for n, c in ((n, _condition(n)) for n in _names(args.point))),
        f"{program()}" + (f"; trials with seeds from 10000, {args.trials}" if args.trials else ""),
    ]  # fmt: skip


def _condition(point: str) -> dict[str, Any]:
    """Shaft power and all ambient conditions of a named point."""
    from estimators.apu.identify import POINTS

    given = POINTS[point]
    return {"PW": given["PW"],
            "ambient": {n: given.get(n, v) for n, v in DEFAULT_DAY.items()}}  # fmt: skip


def _known(r: Identifiability) -> list[str]:
    lines = ["", f"What can be known (rank {r.rank} of {len(r.given.faults)}, "
             f"{r.rank_in_noise} above the noise for changes of 1 %)"]  # fmt: skip
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
    lines = ["", "Which sensor to add: size that becomes visible among the others (1 sigma), %",
             f"  {'':<10}{'rank':>5}" + "".join(f"{n:>18}" for n in c.faults)]  # fmt: skip
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
                f"{n} {100 * v:.2f} %" for n, v in row["ranking"][1:]
                if v < 0.99 * row["before"]
            ]  # fmt: skip
            text += f" (then {', '.join(others)})" if others else ""
        lines += _wrap(f"{text}.")
    return lines


def _power(
    power: dict[str, dict[str, Any]],
    why: dict[str, float],
    noise: dict[str, float],
    needed: dict[str, int | None],
    point: str,
) -> list[str]:
    from estimators.apu.identify import AIMS, ETA_BIAS, PRIOR

    one = next(iter(power.values()))
    null = ", ".join(f"{n} {v:+.3f}" for n, v in one["null"].items() if abs(v) > 1e-6)
    # the aims are stated for one prior
    aimed = one["prior"] == PRIOR
    aims = "aim" if aimed else ""
    lines = [
        "",
        f"What measured shaft power is worth at {point}: reduction of the 1 sigma, %",
        f"  {'':<18}{aims:>6}{'rms':>7}"
        + "".join(f"{n:>9}" for n in one["before"])
        + "   null direction, 1 sigma %",
    ]
    for label, r in power.items():
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
    for label, n in needed.items():
        text = f"{label}: a reduction of {100 * AIMS[label]:.0f} % "
        text += (
            f"needs {n} averaged samples of 20 ms or more" if n else "is not reached by averaging"
        )
        lines += _wrap(f"{text}.")
    for label in AIMS:
        if aimed and power[label]["reduction"] < AIMS[label]:
            lines += _wrap(f"{label}: the aim is MISSED with these samples; see below.")
    parts = ", ".join(f"{n} {100 * v:.0f} %" for n, v in why.items())
    lines += _wrap(
        "With gain errors every gain opens a direction of its own, in which shaft power says "
        f"little: one alone leaves a reduction of {parts}. A healthy baseline removes them."
    )
    parts = ", ".join(f"{n} {100 * v:.0f} %" for n, v in noise.items())
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
    return {
        "mu": s.fault.mu, "k_rf": s.fault.k_rf, "kappa": s.fault.kappa, "h": s.h,
        "periods": s.periods, "sigma_log_mu": s.sigma_mu, "sigma_log_k_rf": s.sigma_k_rf,
        "sigma_log_h": s.sigma_h, "correlation": s.correlation, "rank": s.rank,
        "rank_with_kappa": s.rank_with_kappa, "reactance_over_resistance": s.ratio,
    }  # fmt: skip


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
    from estimators.apu.sensors import GAS_PATH
    from scenarios.figures.estimationplot import plot_gain_of_a_sensor

    noise = GAS_PATH["PW"].noise
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
