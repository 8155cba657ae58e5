"""Linearise gas generator, generator or the whole unit at a steady point; print its eigenvalues.

The point is given by the electrical load of each generator and the ambient conditions.  The
generator is on its rotor's axes, averaged over an electrical period; the unit is continuous in
time, with its governor.  The eigenvalues are printed slowest first, and drawn in the complex plane.
"""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from apu_casadi.gaspath.conditions import day_words
from scenarios.commands.given import (
    ambient_arguments,
    ambient_given,
    ambient_line,
    ambient_of,
    program,
)
from scenarios.shell import jsontext

if TYPE_CHECKING:
    from apu_casadi.unit.linearisation import LinearModel

NAME = "linearise"
HELP = "print and draw the eigenvalues at a steady point"
MODELS = ("gas", "generator", "joint")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--model", choices=MODELS, default="joint", help="default %(default)s")
    parser.add_argument("--power", metavar="KW", type=float, default=225.0,
                        help="load of each generator at 230 V (default %(default)s)")  # fmt: skip
    parser.add_argument("--power-factor", metavar="PF", type=float, default=1.0, help="default 1")
    parser.add_argument("--constant-power", action="store_true", help="a load that holds its power")
    ambient_arguments(parser)
    parser.add_argument("--json", action="store_true", help="print JSON, with all matrices")
    parser.add_argument(
        "--out", metavar="DIR", default="results/linearise", help="default %(default)s"
    )
    parser.add_argument("--no-figures", action="store_true", help="draw no figure")


def run(args: argparse.Namespace) -> int:
    """Trim, linearise, print and draw."""
    model = linear_model(args)
    path = None
    if not args.no_figures:
        from apu_casadi.core import files
        from scenarios import registry
        from scenarios.figures.eigenplot import plot_eigenvalues

        label = f"{_load(args)} each, {day_words(ambient_of(args))}"
        path = registry.prepare(args.out) / "eigenvalues.png"
        note = f"Load {label}; healthy; {program()}."
        files.save_figure(plot_eigenvalues({label: model}, note), path)
    if args.json:
        given = {
            "ambient": ambient_of(args),
            "assumed": [n for n, v in ambient_given(args).items() if v is None],
            "load": {
                "power": 1e3 * args.power, "power_factor": args.power_factor,
                "constant_power": args.constant_power,
            },
            "apu_casadi_version": program().split()[1],
        }  # fmt: skip
        jsontext.show(report(model) | given)
        return 0
    print(table(model))
    if args.model != "generator":
        print(f"\n{ambient_line(ambient_given(args))}")
    print(f"load of each generator: {_load(args)}; healthy; {program()}")
    if path is not None:
        print(f"\n{path}")
    return 0


def _load(args: argparse.Namespace) -> str:
    kind = "constant power" if args.constant_power else f"power factor {args.power_factor:g}"
    return f"{args.power:g} kW at 230 V, {kind}"


def linear_model(args: argparse.Namespace) -> LinearModel:
    """Return the linear model that the options describe."""
    from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
    from apu_casadi.machine.loads.load import Load
    from apu_casadi.machine.loads.series import SeriesLoad
    from apu_casadi.unit.apu import Apu
    from apu_casadi.unit.events import Ambient
    from apu_casadi.unit.linearisation import (
        linearise_gas_generator,
        linearise_generator,
        linearise_joint,
    )

    apu = Apu()
    load: Load
    if args.constant_power:
        load = ConstantPowerLoad(1e3 * args.power)
    else:
        load = SeriesLoad.from_power(1e3 * args.power, args.power_factor)
    if args.model == "generator":
        w_r = apu.w_r(apu.N_ref)
        return linearise_generator(apu.generator, apu.generator.steady_state(load, w_r=w_r))
    point = apu.steady_state(load, ambient=Ambient(**ambient_of(args)))
    if args.model == "gas":
        return linearise_gas_generator(apu.gas_generator, point.gas)
    return linearise_joint(apu, point)


def report(model: LinearModel) -> dict[str, Any]:
    """Return names, matrices, operating point and eigenvalues as plain numbers."""
    return {
        "model": model.name,
        "names": {k: list(getattr(model, k).names) for k in ("x", "u", "theta", "y")},
        "units": {k: [s.unit for s in getattr(model, k)] for k in ("x", "u", "theta", "y")},
        "matrices": {
            k: getattr(model, k).tolist() for k in ("A", "B_u", "B_theta", "C", "D_u", "D_theta")
        },
        "point": {k: getattr(model, k).tolist() for k in ("x0", "u0", "theta0", "y0", "xdot0")},
        "eigenvalues": [
            {
                "real": e.value.real,
                "imag": e.value.imag,
                "time_constant": e.time_constant if math.isfinite(e.time_constant) else None,
                "damping": e.damping,
                "frequency": e.frequency,
                "participation": dict(e.participation),
            }
            for e in model.eigenvalues()
        ],
    }


def table(model: LinearModel) -> str:
    """Return the eigenvalues as a text table."""
    lines = [
        f"{model.name}: {len(model.x)} state{'s' if len(model.x) > 1 else ''}",
        f"{'real [1/s]':>12} {'imag [rad/s]':>13} {'time const. [s]':>16} {'damping':>8} "
        f"{'freq. [Hz]':>11}  participating states",
    ]
    for e in model.eigenvalues():
        who = ", ".join(f"{n} {100 * p:.0f} %" for n, p in e.participation.items())
        imag = f"±{e.value.imag:.4f}" if e.value.imag else "0"
        lines.append(
            f"{e.value.real:12.4f} {imag:>13} {e.time_constant:16.4g} {e.damping:8.3f} "
            f"{e.frequency:11.4g}  {who}"
        )
    return "\n".join(lines)
