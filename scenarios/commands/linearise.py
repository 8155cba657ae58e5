"""Linearise gas generator, generator or the whole unit at a steady point; print its eigenvalues.

The point is given by the electrical load of each generator, faults and the ambient conditions.  The
generator is on its rotor's axes, averaged over an electrical period, and with a fault or an
unbalanced load over a turn; the unit is continuous in time, with its governor.  Where generators
differ, each has its own states: generator2.lam_fd.  The eigenvalues are printed slowest first, and
drawn in the complex plane; --save keeps the matrices for other tools.
"""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any, NamedTuple

from apu_casadi.core.version import installed
from apu_casadi.gaspath.conditions import day_words
from scenarios.commands import given
from scenarios.shell import jsontext

if TYPE_CHECKING:
    from collections.abc import Sequence

    from apu_casadi.machine.faults.fault import Fault
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
--load W part ...    | another load, W or by the keys of a scenario:
                     | 'kind = "series", R_ohm = 1, L_mH = 1'; given more than once, that of
                     | generators 1, 2, ...
--fault KEYS part ... | fault of each generator, by the keys of a scenario: 'mu = 0.05, k_rf = 20';
                     | of one with 'generator = 2, ...'
--apart              | joint: generators that are equal have states and inputs of their own, too
--generator int =1   | generator: which one (default %(default)s)
{given.ambient_options()}
{given.WHOLE}
--json               | print JSON, with all matrices
--out DIR =results/linearise | default %(default)s
{given.FIGURES}
--save FILE          | write the matrices with names and units, .nc or .mat
"""


def run(args: argparse.Namespace) -> int:
    """Trim, linearise, print and draw."""
    unit = given.unit(args)
    point = _point(args, unit)
    model = linear_model(args.model, unit, *point, number=args.generator, apart=args.apart)
    words = _words(args, unit)
    made: list[Any] = []
    if (how := given.drawn(args)) is not None:
        from scenarios import registry
        from scenarios.figures.eigenplot import plot_eigenvalues

        label = f"{words.load}, {day_words(given.ambient_of(args))}"
        stem = registry.prepare(args.out) / "eigenvalues"
        note = f"Load of {label}; {words.fault}; {given.program(args)}."
        made = how.save(plot_eigenvalues({label: model}, note), stem)
    if args.save is not None:
        from scenarios.export import linear

        about = {"load": words.load, "program": given.program(args)}
        about |= {"fault": words.fault} if args.fault else {}
        linear.save(model, args.save, about | given.ambient_of(args))
    if args.json:
        told = {
            "ambient": given.ambient_of(args),
            "assumed": given.ambient_assumed(args),
            "load": _asked(args),
            **({"fault": args.fault} if args.fault else {}),
            "apu_casadi_version": installed(),
            **given.own(args),
            **given.assumed(args),
        }
        jsontext.show(report(model) | told)
        return 0
    print(table(model))
    if args.model != "generator":
        print(f"\n{given.ambient_line(given.ambient_given(args))}")
    print(f"load of {words.load}; {words.fault}; {given.program(args)}")
    if made := [str(p) for p in (args.save, *made) if p is not None]:
        print("", *made, sep="\n")
    return 0


def _asked(args: argparse.Namespace) -> Any:
    if args.load:
        return args.load[0] if len(args.load) == 1 else args.load
    keys = {"power_factor": args.power_factor, "constant_power": args.constant_power}
    return {"power": 1e3 * args.power, **keys}


def _point(args: argparse.Namespace, unit: Apu) -> tuple[Any, list[Fault | None], Ambient]:
    """Return loads, faults and the day of the options."""
    from apu_casadi.core.errors import SignalError
    from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
    from apu_casadi.unit.events import Ambient

    if args.generator != 1 and args.model != "generator":
        raise SignalError("--generator is that of --model generator")
    if args.apart and args.model != "joint":
        raise SignalError("--apart is about the generators of --model joint")
    if args.load and (args.power is not None or args.constant_power):
        raise SignalError("--load, or --power and --constant-power: not both")
    if args.power is None:
        args.power = unit.generator.machine.P_rated / 1e3
    if args.load:
        load: Any = given.loads(args, unit)
    elif args.constant_power:
        load = ConstantPowerLoad(1e3 * args.power)
    else:
        load = given.power_load(unit.generator.machine, 1e3 * args.power, args.power_factor)
    return load, given.faults(args, unit), Ambient(**given.ambient_of(args))


class _Told(NamedTuple):
    """Loads and faults in words."""

    load: str
    fault: str


def _words(args: argparse.Namespace, unit: Apu) -> _Told:
    faults = given.faults(args, unit)
    ill = given.of_each(faults, lambda f: f.label) if any(faults) else ""
    fault = f"fault of {ill}" if ill else "healthy"
    if args.load:
        loads = unit.each("--load", given.loads(args, unit))
        return _Told(given.of_each(loads, given.load_words), fault)
    kind = "constant power" if args.constant_power else f"power factor {args.power_factor:g}"
    rated = f"{args.power:g} kW at {unit.generator.machine.V_rated_rms:g} V, {kind}"
    return _Told(f"each generator: {rated}", fault)


def linear_model(
    model: str,
    apu: Apu,
    load: Any,
    faults: Sequence[Fault | None],
    ambient: Ambient,
    *,
    number: int = 1,
    apart: bool = False,
) -> LinearModel:
    """Return the linear model ``gas``, ``generator`` or ``joint`` at a steady point.

    Args:
        load: of all generators, or a list with one for each.
        number: of the generator.
        apart: whether equal generators have signals of their own.

    Raises:
        OperatingPointError: there is no such point.
        SignalError: there is no such generator.
    """
    from apu_casadi.core.errors import SignalError
    from apu_casadi.unit import linearisation

    if model == "generator":
        if not 1 <= number <= len(apu.machines):
            n = len(apu.machines)
            raise SignalError(f"--generator {number}: the unit has generators 1 to {n}")
        gen, own = apu.generators[number - 1], apu.each("load", load)[number - 1]
        w_r = apu.link_of((number,)).w_r(apu.N_ref)
        at = gen.steady_state(own, faults[number - 1], w_r=w_r)
        return linearisation.linearise_generator(gen, at)
    point = apu.steady_state(load, faults, ambient=ambient)
    if model == "gas":
        return linearisation.linearise_gas_generator(apu.gas_generator, point.gas)
    return linearisation.linearise_joint(apu, point, apart=apart)


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
