"""Solve a steady operating point from any two quantities, and print it.

The gas generator at governed speed against a shaft power, through 8 km at Mach 0.7:

  apu trim --altitude 8000 --mach 0.7 --disa 5 --power 222e3

Two others instead, by the names of the outputs (SI units):

  apu trim --fix N_rpm=36050 --fix T4=1200
  apu trim --fix Wf=0.045 --fix PW=cube

The whole unit under an electrical load of each generator, or one generator at a terminal voltage:

  apu trim --load 225e3
  apu trim --load 225e3 --voltage 230
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping
from typing import Any

from apu_casadi.core.errors import OperatingPointError, SignalError, nearest
from scenarios.commands.given import (
    ambient_arguments,
    ambient_given,
    ambient_line,
    ambient_of,
    program,
)
from scenarios.shell import jsontext

NAME = "trim"
HELP = "solve a steady operating point"

SHOWN = (
    "N", "PW", "Wf", "SFC", "T0", "P0", "T1", "P1", "W2", "T3", "P3", "T4", "T41", "T5", "P5",
    "W5", "SM", "n_c", "PR_c", "eta_c", "n_t", "PR_t", "eta_t", "Mach8", "SNOx", "off_c", "off_t",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    number = float
    ambient_arguments(parser)
    parser.add_argument("--power", type=number, metavar="W", help="shaft power, W")
    parser.add_argument("--speed", type=number, metavar="RPM", help="r/min (default: governed)")
    parser.add_argument("--load", type=number, metavar="W", help="electrical load per generator, W")
    parser.add_argument(
        "--power-factor", type=number, default=1.0, metavar="PF", help="of --load (default 1)"
    )
    parser.add_argument(
        "--voltage", type=number, metavar="V", help="with --load: one generator alone, V rms"
    )
    parser.add_argument(
        "--fix", action="append", default=[], metavar="NAME=VALUE",
        help="fix an output, twice; PW=cube is a load like speed cubed through the design point",
    )  # fmt: skip
    parser.add_argument(
        "--max-power", metavar="T4=K", help="highest shaft power at a temperature (T4 or T5)"
    )
    parser.add_argument(
        "--health", action="append", default=[], metavar="NAME=VALUE",
        help="health factor, 1 is healthy: f_eta_c, f_W_c, f_eta_t, f_W_t",
    )  # fmt: skip
    parser.add_argument(
        "--limit", action="append", default=[], metavar="NAME=VALUE",
        help="off_map (table spans), SM_min, T4_max, T5_max (K)",
    )  # fmt: skip
    parser.add_argument("--all", action="store_true", help="print every output")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Solve and print; an OperatingPointError gives the reason of a refusal."""
    modes = [
        name
        for name, given in (
            ("--power", args.power is not None), ("--load", args.load is not None),
            ("--fix", bool(args.fix)), ("--max-power", args.max_power is not None),
        )
        if given
    ]  # fmt: skip
    if len(modes) != 1:
        raise SignalError(
            f"give one of --power, --load, --fix and --max-power, got {', '.join(modes) or 'none'}"
        )
    if args.voltage is not None and args.load is None:
        raise SignalError("--voltage is that of a generator and needs --load")
    for option, value in (("--voltage", args.voltage), ("--speed", args.speed)):
        if value is not None and not value > 0:
            raise SignalError(f"{option} must be > 0, got {value:g}")
    if args.speed is not None and modes[0] == "--fix":
        raise SignalError("with --fix, fix the speed by --fix N_rpm=...")
    return _generator(args) if args.voltage is not None else _gas(args, modes[0])


def _pairs(option: str, texts: list[str]) -> dict[str, str]:
    out: dict[str, str] = {}
    for part in (p for text in texts for p in text.split(",")):
        name, eq, value = part.partition("=")
        if not eq or not name.strip():
            raise SignalError(f"{option}: NAME=VALUE is expected, got {part!r}")
        if name.strip() in out:
            raise SignalError(f"{option}: {name.strip()} given twice")
        out[name.strip()] = value.strip()
    return out


def _numbers(option: str, texts: list[str]) -> dict[str, float]:
    out = {}
    for name, value in _pairs(option, texts).items():
        try:
            out[name] = float(value)
        except ValueError:
            raise SignalError(f"{option} {name}: a number is expected, got {value!r}") from None
    return out


def _limits(texts: list[str]) -> Any:
    import dataclasses

    from apu_casadi.gaspath.steady.steadypoint import Limits

    known = [f.name for f in dataclasses.fields(Limits)]
    given = _numbers("--limit", texts)
    for name in given:
        if name not in known:
            raise SignalError(f"--limit: unknown {name!r} {nearest(name, known)}")
    return dataclasses.replace(Limits(), **given)


def _fixed(texts: list[str], PW_design: float, N_design: float) -> dict[str, Any]:
    from apu_casadi.gaspath.steady.steadypoint import LoadLaw

    out: dict[str, Any] = {}
    for name, value in _pairs("--fix", texts).items():
        if name == "PW" and value == "cube":
            out["PW"] = LoadLaw(PW_design, N_design)
            continue
        try:
            number = float(value)
        except ValueError:
            raise SignalError(f"--fix {name}: a number is expected, got {value!r}") from None
        if name == "N_rpm":
            name, number = "N", number * math.pi / 30.0
        out[name] = number
    return out


def _gas(args: argparse.Namespace, mode: str) -> int:
    from apu_casadi.gaspath.stations import Y
    from apu_casadi.gaspath.steady.trimming import maximum_power, trim_gas_generator

    ambient = ambient_of(args)
    health, limits = _numbers("--health", args.health), _limits(args.limit)
    extra: dict[str, float] = {}
    if mode == "--load":
        from apu_casadi.machine.loads.series import SeriesLoad
        from apu_casadi.unit.apu import Apu
        from apu_casadi.unit.events import Ambient

        if args.speed is not None:
            raise SignalError("--load is solved at governed speed; leave --speed out")
        joint = Apu().steady_state(
            SeriesLoad.from_power(args.load, args.power_factor),
            ambient=Ambient(**ambient),
            health=health,
            limits=limits,
        )
        point, g = joint.gas, joint.generator
        extra = {"V_t": g.V_t, "V_ref": g.V_ref, **_scalars(g.y)}
    else:
        from apu_casadi.gaspath.gasgenerator import GasGenerator

        gg = GasGenerator()
        N = gg.parameters.N if args.speed is None else args.speed * math.pi / 30.0
        if mode == "--max-power":
            given = _numbers("--max-power", [args.max_power])
            wrong = [n for n in given if n not in ("T4", "T5")]
            if wrong:
                raise SignalError(f"--max-power: T4 or T5 is expected, got {wrong[0]!r}")
            temperatures = {f"{n}_max": v for n, v in given.items()}
            point = maximum_power(
                gg, N=N, theta=health, limits=limits, **temperatures, **ambient
            )  # fmt: skip
        else:
            d = gg.design.values
            PW = d["P_turb"] - d["P_cpr"] / gg.parameters.eta_cpr - gg.parameters.P_acc
            fixed = (
                {"N": N, "PW": args.power}
                if mode == "--power"
                else _fixed(args.fix, PW, gg.parameters.N)
            )
            point = trim_gas_generator(gg, fixed, theta=health, limits=limits, **ambient)
    values = {"N_rpm": point["N"] * 30.0 / math.pi, **point.values}
    if args.json:
        report = {
            "outputs": values, "generator": extra, "residual": point.residual,
            "iterations": point.iterations, "inputs": {**ambient, "health": health},
            "assumed": [n for n, v in ambient_given(args).items() if v is None],
            "load": _load(args), "limits": _plain(limits),
            "apu_casadi_version": program().split()[1],
        }  # fmt: skip
        if point.second is not None:
            report["second"] = point.second.values
        jsontext.show(report)
        return 0
    print(_table(values, list(values) if args.all else ["N_rpm", *SHOWN]))
    if extra:
        print("\neach generator\n" + _table(extra, list(extra)))
    print(f"\nresidual {point.residual:.1e}, {point.iterations} Newton steps")
    if point.second is not None:
        other = {k: point.second[k] for k in ("N", "PW", "Wf", "T4", "SM")}
        print(
            "there is a second steady point with the same fixed quantities: "
            + ", ".join(f"{k} = {v:.6g} {Y[k].unit}" for k, v in other.items())
            + "; the one above is on the design point's side of the extreme value between them, "
            "unless that side is beyond a limit"
        )
    print(ambient_line(ambient_given(args)))
    ill = ", ".join(f"{n} = {v:g}" for n, v in health.items())
    print(f"health: {ill or 'healthy'}; {_load_words(args)}{program()}")
    return 0


def _generator(args: argparse.Namespace) -> int:
    from apu_casadi.machine.generator import Generator
    from apu_casadi.machine.loads.series import SeriesLoad

    gen = Generator()
    p = gen.machine
    load = SeriesLoad.from_power(args.load, args.power_factor)
    speed = None if args.speed is None else args.speed / (36050.0 / 12000.0)
    w_r = None if speed is None else p.n_pp * speed * math.pi / 30.0
    point = gen.steady_state(load, w_r=w_r, V_t=args.voltage)
    values = {"V_t": point.V_t, "V_ref": point.V_ref, **_scalars(point.y)}
    if args.json:
        report = {"generator": values, "residual": point.residual, "load": _load(args),
                  "apu_casadi_version": program().split()[1]}  # fmt: skip
        jsontext.show(report)
        return 0
    print(_table(values, list(values)))
    print(f"\nresidual {point.residual:.1e} 1/s")
    print(f"{_load_words(args)}{program()}")
    return 0


def _load(args: argparse.Namespace) -> dict[str, float] | None:
    """The electrical load of each generator; None for the gas generator alone."""
    if args.load is None:
        return None
    return {"power": args.load, "power_factor": args.power_factor}


def _load_words(args: argparse.Namespace) -> str:
    if args.load is None:
        return ""
    return (
        f"load of each generator: {args.load / 1e3:g} kW at 230 V, power factor "
        f"{args.power_factor:g}; "
    )


def _plain(limits: Any) -> dict[str, float | None]:
    """The limits as they were applied; None where there is none."""
    import dataclasses

    return {
        n: float(v) if v is not None and math.isfinite(v) else None
        for n, v in dataclasses.asdict(limits).items()
    }


def _scalars(y: Mapping[str, Any]) -> dict[str, float]:
    return {k: float(v) for k, v in y.items()}


def _table(values: Mapping[str, float], names: list[str]) -> str:
    from apu_casadi.gaspath.stations import Y

    rows = []
    for n in names:
        if n not in values:
            raise OperatingPointError(f"no output {n!r} {nearest(n, values)}")
        unit, doc = (Y[n].unit, Y[n].doc) if n in Y else ("", "")
        if n == "N_rpm":
            unit, doc = "r/min", "rotor speed"
        rows.append(f"{n:<8} {values[n]:>14.6g}  {unit:<8} {doc}".rstrip())
    return "\n".join(rows)
