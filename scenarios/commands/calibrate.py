"""Fit map numbers to steady points and print them with their standard deviations.

Without FILE the calibration of the default unit is made again: from maps without any calibration,
and the rows W2, T3, P3, T5 and HPCSM of the paper's Table 5 and HPCSM of Table 4.

FILE is a CSV with one quantity on each line and SI units; role is ambient (altitude, Mach, dT_isa,
war), health (f_eta_c, ...), fixed (two for each point) or measured:

    point,role,name,value,sigma
    bench 1,ambient,dT_isa,5,
    bench 1,fixed,N,3775.1,
    bench 1,fixed,PW,400e3,
    bench 1,measured,W2,3.143,0.01
    bench 1,measured,T3,567.9,0.5
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from apu_casadi.core.errors import ParameterError
from scenarios.commands import given
from scenarios.shell import jsontext, progress

if TYPE_CHECKING:
    from apu_casadi.gaspath.calibration import CalibrationPoint, CalibrationResult
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from apu_casadi.unit.enginefile import Engine

NAME = "calibrate"
HELP = "fit map numbers to table or test-bench points"
OPTIONS = f"""
file FILE ?        | CSV of points (see above)
--free A,B         | numbers to fit (default: the six of the code)
--write-points CSV | write the points, as a template
--write-engine TOML | write the unit with the fitted numbers, each with FILE as its source
{given.UNIT}
--json             | print JSON
"""

FREE = tuple(
    [f"compressor_map.{n}" for n in ["a_W", "n_Re", "k_SM", "a_SM"]]
    + [f"turbine_map.{n}" for n in ["a_W", "c_PR"]]
)
"""The numbers that the defaults set."""

CLOSURE = 1e-4
"""Relative standard deviation of a published row: how far the cycle, with no map in it, misses the
rows of Table 4.  The digits printed are finer."""


def published_points() -> list[CalibrationPoint]:
    """Return the points that the defaults were fitted to, from Tables 4 and 5."""
    from apu_casadi.gaspath.calibration import CalibrationPoint
    from apu_casadi.gaspath.designdata import GasGeneratorParameters
    from scenarios.validation.comparison import reference

    p = GasGeneratorParameters()
    table4, table5 = (
        {r["parameter"]: float(r["GasTurb"]) for r in reference(t)} for t in ("table4", "table5")
    )

    def measured(value: float) -> tuple[float, float]:
        return value, CLOSURE * abs(value)

    return [
        CalibrationPoint(
            name="Table 4",
            ambient={"altitude": p.altitude, "Mach": p.Mach, "dT_isa": p.dT_isa, "war": p.war},
            fixed={"N": p.N, "T4": p.T4},
            measured={"SM": measured(table4["HPCSM"] / 100)},
        ),
        CalibrationPoint(
            name="Table 5",
            ambient={"altitude": 8000.0, "Mach": 0.7, "dT_isa": 5.0},
            fixed={"N": p.N, "PW": 1e3 * table5["PWSD"]},
            measured={
                "W2": measured(table5["W2"]),
                "T3": measured(table5["T3"]),
                "P3": measured(1e3 * table5["P3"]),
                "T5": measured(table5["T5"]),
                "SM": measured(table5["HPCSM"] / 100),
            },
        ),
    ]


def uncalibrated(gg: GasGenerator) -> GasGenerator:
    """Return an engine with the maps' shapes as published."""
    import dataclasses

    from apu_casadi.gaspath.maps.scaledmaps import MapCalibration

    plain = MapCalibration()
    return dataclasses.replace(
        gg,
        compressor_map=dataclasses.replace(gg.compressor_map, calibration=plain),
        turbine_map=dataclasses.replace(gg.turbine_map, calibration=plain),
    )


def run(args: argparse.Namespace) -> int:
    """Fit, and print the result."""
    from apu_casadi.gaspath.calibration import calibrate, read_points, write_points

    if args.engine and not args.file:
        raise ParameterError(
            "--engine needs FILE: the published points are those of the default unit"
        )
    points = read_points(args.file) if args.file else published_points()
    gg = given.engine(args)
    if args.file:
        _plausible(args.file, points, gg)
    if args.write_points:
        write_points(points, args.write_points)
    free = given.names(args.free) if args.free else list(FREE)
    progress.tell(f"fitting {len(free)} numbers to {len(points)} points", quiet=args.json)
    result = calibrate(gg if args.file else uncalibrated(gg), points, free)
    now = in_use(gg, result.names)
    if args.write_engine:
        engine = given.engine_file(args, given.TABLES)
        _write_engine(args.write_engine, engine, result, args.file or "Tables 4 and 5")
    if args.json:
        jsontext.show(report(result, now) | given.own(args) | given.assumed(args))
    else:
        print(text(result, now, "in the file" if args.engine else "in the code"))
    return 0


def _write_engine(path: str, engine: Engine, result: CalibrationResult, points: str) -> None:
    """Write the unit with the fitted numbers."""
    import dataclasses

    from apu_casadi.unit.enginefile import write_unit

    sources = dict.fromkeys(result.names, f"fitted to {points} (apu calibrate)")
    unit = engine.unit.change(result.values)
    engine = dataclasses.replace(engine, unit=unit, sources={**engine.sources, **sources})
    write_unit(engine, path)


def _plausible(path: str, points: Sequence[CalibrationPoint], gg: GasGenerator) -> None:
    """Refuse numbers that their quantity cannot have: a slip, or another unit than SI.

    Raises:
        DataError: with file, point, name and value.
    """
    from apu_casadi.core.errors import DataError
    from estimators.apu.recordings.plausible import plausible_for

    units, plausible = {s.name: s.unit for s in (*gg.Y, *gg.U)}, plausible_for(gg)
    for p in points:
        values = {**p.fixed, **p.ambient, **{n: v for n, (v, _) in p.measured.items()}}
        for name, value in values.items():
            low, high = plausible.get(name, (value, value))
            if not low <= value <= high:
                raise DataError(
                    f"{path}: point {p.name!r}: {name} = {value:.6g} {units.get(name, '')} is not "
                    f"plausible ({low:g} to {high:g}); SI units are expected"
                )


def report(result: CalibrationResult, now: Mapping[str, float]) -> dict[str, Any]:
    """Return the result as plain numbers, with the values of the engine before beside them."""
    return {
        "numbers": [
            {"name": n, "value": result.values[n], "std": result.std[n], "in_code": now[n]}
            for n in result.names
        ],
        "covariance": result.covariance.tolist(),
        "residuals": [{**vars(r), "error": r.error} for r in result.residuals],
        "chi2": result.chi2,
        "degrees_of_freedom": result.freedom,
        "condition": result.condition,
        "weak": list(result.weak),
        "at_bound": list(result.at_bound),
        "engines_built": result.evaluations,
    }


def in_use(gg: GasGenerator, names: Sequence[str]) -> dict[str, float]:
    """Return the calibrated numbers that an engine has, by name."""
    parts = (n.partition(".") for n in names)
    return {f"{s}.{f}": getattr(getattr(gg, s).calibration, f) for s, _, f in parts}


def text(result: CalibrationResult, now: Mapping[str, float], where: str = "in the code") -> str:
    """Return the result as text, with the values of the engine before beside them."""
    std = result.std
    width = max(len(n) for n in result.names)
    lines = [f"{'number':<{width}}  {'value':>12}  {'std. dev.':>10}  {where:>12}"]
    lines += [
        f"{n:<{width}}  {result.values[n]:12.8f}  {std[n]:10.2e}  {now[n]:12.8f}"
        for n in result.names
    ]
    spread = [std[n] for n in result.names]
    lines += ["", "correlations"]
    for i, n in enumerate(result.names):
        row = " ".join(
            f"{result.covariance[i, j] / (spread[i] * spread[j]):+6.2f}" for j in range(i + 1)
        )
        lines.append(f"{n:<{width}}  {row}")
    lines += [
        "",
        f"{'point':<12} {'':>6} {'measured':>14} {'model':>14} {'sigma':>10} {'error/sigma':>12}",
    ]
    lines += [
        f"{r.point:<12} {r.name:>6} {r.measured:14.7g} {r.model:14.7g} {r.sigma:10.2e} "
        f"{r.error:12.4f}"
        for r in result.residuals
    ]
    lines += [
        "",
        f"chi2 {result.chi2:.3g} with {result.freedom} degrees of freedom, condition "
        f"{result.condition:.1f}, {result.evaluations} engines built",
    ]
    lines += [f"weakly determined: {w}" for w in result.weak]
    lines += [f"at the edge of its range: {n}" for n in result.at_bound]
    return "\n".join(lines)
