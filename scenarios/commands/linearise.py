"""Linearise gas generator, generator or the whole unit at a steady point; print its eigenvalues.

The point is given by the electrical load of each generator and the ambient conditions.  The
generator is on its rotor's axes, averaged over an electrical period; the unit is continuous in
time, with its governor.  The eigenvalues are printed slowest first, and drawn in the complex plane;
--save keeps the matrices for other tools.
"""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from apu_casadi.core.version import installed
from apu_casadi.gaspath.conditions import day_words
from scenarios.commands import given
from scenarios.shell import jsontext

if TYPE_CHECKING:
    from apu_casadi.machine.loads.load import Load
    from apu_casadi.unit.apu import Apu
    from apu_casadi.unit.events import Ambient
    from apu_casadi.unit.linearmodel import LinearModel

NAME = "linearise"
HELP = "print and draw the eigenvalues at a steady point"
OPTIONS = f"""
--model {{gas,generator,joint}} =joint | default %(default)s
--power float KW     | load of each generator at rated voltage (default: its rated power, 225)
--power-factor float PF =1.0 | default 1
--constant-power     | a load that holds its power
--load TABLE part    | another load, by the keys of a scenario:
                     | 'kind = "series", R_ohm = 1, L_mH = 1'
{given.ambient_options()}
{given.WHOLE}
--json               | print JSON, with all matrices
--out DIR =results/linearise | default %(default)s
--no-figures         | draw no figure
--save FILE          | write the matrices with names and units, .nc or .mat
"""


def run(args: argparse.Namespace) -> int:
    """Trim, linearise, print and draw."""
    from apu_casadi.unit.events import Ambient

    unit = given.unit(args)
    if args.power is None:
        args.power = unit.generator.machine.P_rated / 1e3
    load = _load(args, unit)
    model = linear_model(args.model, unit, load, Ambient(**given.ambient_of(args)))
    path = None
    if not args.no_figures:
        from apu_casadi.core import files
        from scenarios import registry
        from scenarios.figures.eigenplot import plot_eigenvalues

        label = f"{_words(args, load, unit)} each, {day_words(given.ambient_of(args))}"
        path = registry.prepare(args.out) / "eigenvalues.png"
        note = f"Load {label}; healthy; {given.program(args)}."
        files.save_figure(plot_eigenvalues({label: model}, note), path)
    if args.save is not None:
        from scenarios.export import linear

        words = {"load": _words(args, load, unit), "program": given.program(args)}
        linear.save(model, args.save, words | given.ambient_of(args))
    if args.json:
        told = {
            "ambient": given.ambient_of(args),
            "assumed": given.ambient_assumed(args),
            "load": args.load or _asked(args),
            "apu_casadi_version": installed(),
            **given.own(args),
            **given.assumed(args),
        }
        jsontext.show(report(model) | told)
        return 0
    print(table(model))
    if args.model != "generator":
        print(f"\n{given.ambient_line(given.ambient_given(args))}")
    print(f"load of each generator: {_words(args, load, unit)}; healthy; {given.program(args)}")
    if made := [str(p) for p in (args.save, path) if p is not None]:
        print("", *made, sep="\n")
    return 0


def _asked(args: argparse.Namespace) -> dict[str, Any]:
    keys = {"power_factor": args.power_factor, "constant_power": args.constant_power}
    return {"power": 1e3 * args.power, **keys}


def _load(args: argparse.Namespace, unit: Apu) -> Load:
    from apu_casadi.machine.loads.constantpower import ConstantPowerLoad

    if args.load is not None:
        return given.load(args)
    if args.constant_power:
        return ConstantPowerLoad(1e3 * args.power)
    return given.power_load(unit, 1e3 * args.power, args.power_factor)


def _words(args: argparse.Namespace, load: Load, unit: Apu) -> str:
    if args.load is not None:
        return given.load_words(load)
    kind = "constant power" if args.constant_power else f"power factor {args.power_factor:g}"
    return f"{args.power:g} kW at {unit.generator.machine.V_rated_rms:g} V, {kind}"


def linear_model(model: str, apu: Apu, load: Load, ambient: Ambient) -> LinearModel:
    """Return the linear model ``gas``, ``generator`` or ``joint`` at a steady point.

    Raises:
        OperatingPointError: there is no such point.
    """
    from apu_casadi.unit import linearisation

    if model == "generator":
        at = apu.generator.steady_state(load, w_r=apu.w_r(apu.N_ref))
        return linearisation.linearise_generator(apu.generator, at)
    point = apu.steady_state(load, ambient=ambient)
    if model == "gas":
        return linearisation.linearise_gas_generator(apu.gas_generator, point.gas)
    return linearisation.linearise_joint(apu, point)


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
