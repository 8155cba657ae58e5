"""Export models for other tools: functions as C99, or an FMU of a model.

  apu export c step ekf --out c_code --check
  apu export c generator.f --load 'kind = "RL", power_kW = 90' --fault 'mu = 0.05, k_rf = 20'
  apu export fmu apu --load 225e3 --out apu.fmu

An FMU has health factors and each fault's parameters as tunable parameters, loads and the day as
inputs.  A fault whose first parameter is zero is none: so it starts where no --fault is given.  By
co-simulation the whole unit exchanges power and speed every 20 ms, as the paper does; by model
exchange it is one continuous model.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenarios.commands import given
from scenarios.shell import jsontext, progress, usage

if TYPE_CHECKING:
    from scenarios.export.cfunctions import Asked

NAME = "export"
HELP = "export functions as C99 (c) or a model as an FMU (fmu)"
_ASKED = f"""
--load W part ...      | load of each generator, W, or by the keys of a scenario (default rated);
                       | given more than once, that of generators 1, 2, ...
--fault TABLE part ... | fault of each generator, by the keys of a scenario: 'mu = 0.05, k_rf = 20';
                       | with 'generator = 2' of that one
{given.ambient_options()}
{given.WHOLE}
"""
_C = f"""
names NAME +            | gas_generator.step (short: step), .f, .g, .residual, .rates;
                        | generator.step, .f, .g, .z, .residual; ekf, ukf: steps of the
                        | gas-path filter
{_ASKED.strip()}
--out DIR =results/c    | folder (default %(default)s)
--check                 | compile and run the examples: every digit as Python's
--json                  | print JSON
"""
_FMU = f"""
model {{gas_generator,generator,apu}} | one engine, one generator, or the whole unit with its
                        | governor and the exchange of 20 ms inside
{_ASKED.strip()}
--fmi int =3            | version of the standard, 3 or 2 (default %(default)s)
--out FILE              | default results/MODEL.fmu
--no-library            | sources alone, nothing is compiled
--json                  | print JSON
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the actions."""
    usage.actions(parser, (("c", _c, _C), ("fmu", _fmu, _FMU)))


run: Callable[[argparse.Namespace], int] = usage.act


def _asked(args: argparse.Namespace) -> Asked:
    from apu_casadi.unit.events import Ambient
    from scenarios.export.cfunctions import Asked

    unit = given.unit(args)
    args.load = args.load or [unit.generator.machine.P_rated]
    use = "what is exported"
    load, faults = given.loads(args, unit, use), given.faults(args, unit, use)
    return Asked(unit, load, faults, Ambient(**given.ambient_of(args)))


def _c(args: argparse.Namespace) -> int:
    """Write functions as C99 that needs math.h alone, with names, numbers and an example."""
    from apu_casadi.core import files
    from scenarios.export import ccode, cfunctions

    folder, asked = files.folder(Path(args.out)), _asked(args)
    report: dict[str, dict[str, Any]] = {}
    for name in dict.fromkeys(args.names):
        progress.tell(f"exporting {name}", quiet=args.json)
        made = cfunctions.exported(name, asked)
        paths = ccode.write(made, folder)
        checked = ccode.check(made, folder) if args.check else None
        report[made.name] = {"files": [str(p) for p in paths], "steps_equal": checked}
        if not args.json:
            print(f"{made.name}: {made.doc}")
            if checked:
                print(f"  compiled without a warning; {checked} steps equal to the last digit")
    if args.json:
        jsontext.show({**report, **given.own(args), **given.assumed(args)})
    else:
        print(f"{given.ambient_line(given.ambient_given(args))}; {given.program(args)}")
        given.written(p for r in report.values() for p in r["files"])
    return 0


def _fmu(args: argparse.Namespace) -> int:
    """Write an FMU for model exchange and co-simulation, with its sources."""
    from scenarios.export import fmu, fmumodel

    path = Path(args.out or f"results/{args.model}.fmu")
    progress.tell(f"exporting {args.model}", quiet=args.json)
    asked = _asked(args)
    model = fmumodel.fmu_model(args.model, asked)
    fmu.build(model, path, fmi=args.fmi, library=not args.no_library)
    roles = ("input", "parameter", "state", "output")
    names = {r: [v.signal.name for v in model.of(r)] for r in roles}
    if args.json:
        told = {"file": str(path), "fmi": args.fmi, "model": model.name, **names}
        jsontext.show(told | given.own(args) | given.assumed(args))
        return 0
    print(f"{model.doc} FMI {args.fmi}.0, model exchange and co-simulation")
    for role, found in names.items():
        print(f"  {len(found):3d} {role}s: {', '.join(found)}")
    print(f"{given.ambient_line(given.ambient_given(args))}; {given.program(args)}")
    given.written([path])
    return 0
