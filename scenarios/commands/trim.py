"""Solve a steady operating point from any two quantities, and print it.

The gas generator at governed speed against a shaft power, through 8 km at Mach 0.7:

  apu trim --altitude 8000 --mach 0.7 --disa 5 --power 222e3

Two others instead, by the names of the outputs (SI units):

  apu trim --fix N_rpm=36050 --fix T4=1200
  apu trim --fix Wf=0.045 --fix PW=cube

The whole unit under an electrical load of each generator, or one generator at a terminal voltage:

  apu trim --load 225e3
  apu trim --load 225e3 --load 'kind = "RL", power_kW = 100, power_factor = 0.9'
  apu trim --load 225e3 --voltage 230

With a fault or an unbalanced load the state is periodic; means and rms values over a turn are told:

  apu trim --load 225e3 --fault 'generator = 2, mu = 0.05, k_rf = 20'
  apu trim --load 'kind = "open_phase", power_kW = 100, phase = "b"'
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from apu_casadi.core.errors import SignalError, nearest
from apu_casadi.core.version import installed
from apu_casadi.gaspath.health import HEALTH
from scenarios.commands import given
from scenarios.shell import jsontext

if TYPE_CHECKING:
    from apu_casadi.gaspath.gasgenerator import GasGenerator
    from apu_casadi.gaspath.steady.steadypoint import Limits, OperatingPoint
    from apu_casadi.machine.atrest import GeneratorPoint

NAME = "trim"
HELP = "solve a steady operating point"
OPTIONS = f"""
{given.ambient_options()}
--power float W      | shaft power, W
--speed float RPM    | r/min (default: governed)
--load W part ...    | electrical load per generator, W; or by the keys of a scenario:
                     | 'kind = "series", R_ohm = 1, L_mH = 1'; given more than once, that of
                     | generators 1, 2, ...
--power-factor float PF =1.0 | of --load (default 1)
--fault KEYS part ... | with --load: fault of each generator, by the keys of a scenario:
                     | 'mu = 0.05, k_rf = 20, phase = "b"'; of one with 'generator = 2, ...'
--voltage float V    | with --load: one generator alone, V rms
--field-voltage float V | with --load: one generator alone at a field voltage, V
--fix NAME=VALUE ... | fix an output, twice; PW=cube is a load like speed cubed through the design
                     | point
--max-power T4=K     | highest shaft power at a temperature (T4 or T5)
--health NAME=VALUE ... | health factor, 1 is healthy: {", ".join(HEALTH)}
--limit NAME=VALUE ...  | off_map (table spans), SM_min, T4_max, T5_max (K)
{given.WHOLE}
--all                | print every output
--json               | print JSON
"""

_SHOWN = """
N PW Wf SFC T0 P0 T1 P1 W2 T3 P3 T4 T41 T5 P5 W5 SM n_c PR_c eta_c n_t PR_t eta_t Mach8 SNOx off_c
off_t
"""
SHOWN = _SHOWN.split()
RPM = math.pi / 30.0  # rad/s


def run(args: argparse.Namespace) -> int:
    """Solve and print; an OperatingPointError gives the reason of a refusal."""
    mode = _mode(args)
    alone = args.voltage is not None or args.field_voltage is not None
    return _generator(args) if alone else _gas(args, mode)


def _mode(args: argparse.Namespace) -> str:
    """Return the one option that fixes the point."""
    options = {n: getattr(args, n) for n in ("power", "load", "fix", "max_power")}
    modes = [f"--{n.replace('_', '-')}" for n, v in options.items() if v not in (None, [])]
    if len(modes) != 1:
        raise SignalError(
            f"give one of --power, --load, --fix and --max-power, got {', '.join(modes) or 'none'}"
        )
    voltages = (("--voltage", args.voltage), ("--field-voltage", args.field_voltage))
    for option, value in (*voltages, ("--fault", args.fault)):
        if value not in (None, []) and not args.load:
            raise SignalError(f"{option} is that of a generator and needs --load")
    for option, value in (*voltages, ("--speed", args.speed)):
        if value is not None and not value > 0:
            raise SignalError(f"{option} must be > 0, got {value:g}")
    if args.speed is not None and modes[0] == "--fix":
        raise SignalError("with --fix, fix the speed by --fix N_rpm=...")
    return modes[0]


def _limits(args: argparse.Namespace, mode: str) -> Limits:
    """Return the engine's limits, changed by ``--limit``."""
    own = given.limits(args, None if mode == "--load" else given.LIMITED)
    known = [f.name for f in dataclasses.fields(own)]
    values = given.numbers(args.limit, "--limit")
    for name in values:
        if name not in known:
            raise SignalError(f"--limit: unknown {name!r} {nearest(name, known)}")
    return dataclasses.replace(own, **values)


def _fixed(texts: list[str], gg: GasGenerator) -> dict[str, Any]:
    """Return what ``--fix`` fixes; the cubic load goes through the design point."""
    from apu_casadi.gaspath.steady.steadypoint import LoadLaw

    out: dict[str, Any] = {}
    for p in given.pairs(texts, "--fix"):
        if (p.name, p.value) == ("PW", "cube"):
            d = gg.design.values
            PW = d["P_turb"] - d["P_cpr"] / gg.parameters.eta_cpr - gg.parameters.P_acc
            out["PW"] = LoadLaw(PW, gg.parameters.N)
            continue
        number = given.number(p.value, "--fix", p.item)
        out |= {"N": number * RPM} if p.name == "N_rpm" else {p.name: number}
    return out


def _joint(args: argparse.Namespace, **how: Any) -> tuple[OperatingPoint, list[dict[str, float]]]:
    """Solve the whole unit; return the gas generator's point, and values of the generators.

    Those of one where all are equal.
    """
    from apu_casadi.unit.events import Ambient

    if args.speed is not None:
        raise SignalError("--load is solved at governed speed; leave --speed out")
    ambient = Ambient(**given.ambient_of(args))
    unit = given.unit(args)
    load, fault = given.loads(args, unit), given.faults(args, unit)
    joint = unit.steady_state(load, fault, ambient=ambient, **how)
    each = (joint.generator, *joint.others)
    return joint.gas, [_values(g) for g in each]


def _alone(
    args: argparse.Namespace, mode: str, health: Mapping[str, float], limits: Limits
) -> OperatingPoint:
    """Solve the gas generator alone."""
    from apu_casadi.gaspath.steady.trimming import maximum_power, trim_gas_generator

    gg = given.engine(args, given.LIMITED)
    N = gg.parameters.N if args.speed is None else args.speed * RPM
    if args.speed is not None:
        lines, own = gg.compressor_map, gg.parameters.N / RPM
        lo, hi = (float(lines.table.N[k]) / lines.N_map_des * own for k in (0, -1))
        why = f"the speeds of the compressor map, design {own:.0f} r/min"
        given.usual(f"--speed = {args.speed:g} r/min", args.speed, lo, hi, why)
    if mode == "--power" and args.power:
        own = gg.design.values["P_turb"]
        given.usual(
            f"--power = {args.power:g} W", abs(args.power), 1e-3 * own, own, "the turbine's"
        )
    how: dict[str, Any] = {"theta": health, "limits": limits, **given.ambient_of(args)}
    if mode == "--max-power":
        values = given.numbers([args.max_power], "--max-power")
        wrong = [n for n in values if n not in ("T4", "T5")]
        if wrong:
            raise SignalError(f"--max-power: T4 or T5 is expected, got {wrong[0]!r}")
        how |= {f"{n}_max": v for n, v in values.items()}
        return maximum_power(gg, N=N, **how)
    fixed = {"N": N, "PW": args.power} if mode == "--power" else _fixed(args.fix, gg)
    return trim_gas_generator(gg, fixed, **how)


def _gas(args: argparse.Namespace, mode: str) -> int:
    health = given.numbers(args.health, "--health")
    limits = _limits(args, mode)
    extra: list[dict[str, float]] = []
    if mode == "--load":
        point, extra = _joint(args, health=health, limits=limits)
    else:
        point = _alone(args, mode, health, limits)
    values = {"N_rpm": point["N"] / RPM, **point.values}
    if args.json:
        report: dict[str, Any] = {"outputs": values, "generator": extra[0] if extra else {}}
        report |= {"generators": extra} if len(extra) > 1 else {}
        report["residual"] = point.residual
        report |= {
            "iterations": point.iterations,
            "inputs": {**given.ambient_of(args), "health": health},
            "assumed": given.ambient_assumed(args),
            "load": _asked(args),
            **_told(args),
            "limits": dataclasses.asdict(limits),
            "apu_casadi_version": installed(),
            **given.own(args),
            **given.assumed(args),
        }
        if point.second is not None:
            report["second"] = point.second.values
        jsontext.show(report)
        return 0
    print(_table(values, list(values) if args.all else ["N_rpm", *SHOWN]))
    for k, own in enumerate(extra, 1):
        head = "each generator" if len(extra) == 1 else f"generator {k}"
        print(f"\n{head}\n{_table(own, list(own), _electrical())}")
    print(f"\nresidual {point.residual:.1e}, {point.iterations} Newton steps")
    if point.second is not None:
        print(_second(point.second))
    print(given.ambient_line(given.ambient_given(args)))
    ill = ", ".join(f"{n} = {v:g}" for n, v in health.items())
    print(f"health: {ill or 'healthy'}; {_load_words(args)}{given.program(args)}")
    return 0


def _second(point: OperatingPoint) -> str:
    from apu_casadi.gaspath.stations import Y

    other = ", ".join(f"{k} = {point[k]:.6g} {Y[k].unit}" for k in ("N", "PW", "Wf", "T4", "SM"))
    return (
        f"there is a second steady point with the same fixed quantities: {other}; the one above is "
        "on the design point's side of the extreme value between them, unless that side is beyond "
        "a limit"
    )


def _generator(args: argparse.Namespace) -> int:
    unit = given.unit(args, given.MACHINE)
    w_r = None if args.speed is None else unit.w_r(args.speed * RPM)
    how = {"w_r": w_r, "V_t": args.voltage, "V_fd": args.field_voltage}
    if len(args.load) > 1 or any("generator" in f for f in args.fault if isinstance(f, dict)):
        raise SignalError(
            "--load, --fault: with --voltage or --field-voltage one generator is solved alone; "
            "give one load, and leave out generator"
        )
    load: Any = given.loads(args, unit)
    point = unit.generator.steady_state(load, given.faults(args, unit)[0], **how)
    values = _values(point)
    if args.json:
        report = {"generator": values, "residual": point.residual, "load": _asked(args)}
        report |= _told(args)
        report |= {"note": point.note} if point.note else {}
        report |= {"apu_casadi_version": installed(), **given.own(args), **given.assumed(args)}
        jsontext.show(report)
        return 0
    print(_table(values, list(values), _electrical()))
    print(f"\nresidual {point.residual:.1e} 1/s" + (f"; {point.note}" if point.note else ""))
    print(f"{_load_words(args)}{given.program(args)}")
    return 0


def _asked(args: argparse.Namespace) -> Any:
    """The electrical load of each generator, or of all; None for the gas generator alone."""
    factor = args.power_factor
    each = [
        x if isinstance(x, Mapping) else {"power": x, "power_factor": factor} for x in args.load
    ]
    return (each[0] if len(each) == 1 else each) if each else None


def _told(args: argparse.Namespace) -> dict[str, Any]:
    """Faults as they were asked for."""
    return {"fault": args.fault[0] if len(args.fault) == 1 else args.fault} if args.fault else {}


def _load_words(args: argparse.Namespace) -> str:
    if not args.load:
        return ""
    unit = given.unit(args)
    n, faults = len(unit.machines), given.faults(args, unit)
    fed = unit.each("--load", given.loads(args, unit))
    given_as = args.load * n if len(args.load) == 1 else args.load
    rated = [g.machine.V_rated_rms for g in unit.generators]

    def load(own: tuple[Any, Any, float]) -> str:
        asked, made, V = own
        if isinstance(asked, Mapping):
            return given.load_words(made)
        return f"{asked / 1e3:g} kW at {V:g} V, power factor {args.power_factor:g}"

    V = rated if len(args.load) > 1 else rated[:1] * n
    words = f"load of {given.of_each(list(zip(given_as, fed, V, strict=True)), load)}; "
    if any(faults):
        words += f"fault of {given.of_each(faults, lambda f: f.label, 'each')}; "
    return words


def _values(point: GeneratorPoint) -> dict[str, float]:
    """Outputs of a generator; where they ripple means and rms values over a turn."""
    return {"V_t": point.V_t, "V_ref": point.V_ref, **point.summary}


def _electrical() -> dict[str, tuple[str, str]]:
    """Unit and meaning of a generator's outputs by name."""
    from apu_casadi.machine.generator import Generator
    from apu_casadi.unit.stepmeans import phasor_signals

    model = Generator().state_space()
    told = {s.name: (s.unit, s.doc) for s in (*model.u, *model.y, *phasor_signals())}
    for q, what in (("v", "voltage"), ("i", "current")):
        rms = ((p, told[f"{q}_{p}"][0]) for p in "abc")
        told |= {f"{q.upper()}_{p}_rms": (u, f"phase {p} {what}, rms over a turn") for p, u in rms}
    return told | {"i_fault_rms": ("A", "current of the fault branch, rms over a turn")}


def _table(
    values: Mapping[str, float],
    names: list[str],
    electrical: Mapping[str, tuple[str, str]] | None = None,
) -> str:
    from apu_casadi.gaspath.stations import Y

    told = {"N_rpm": ("r/min", "rotor speed"), **{s.name: (s.unit, s.doc) for s in Y}}
    told = told if electrical is None else dict(electrical)
    width = max(8, *map(len, names))
    rows = []
    for n in (n for n in names if n in values):
        unit, doc = told.get(n, ("", ""))
        rows.append(f"{n:<{width}} {values[n]:>14.6g}  {unit:<8} {doc}".rstrip())
    return "\n".join(rows)
