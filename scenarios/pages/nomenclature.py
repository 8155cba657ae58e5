"""The page of names, ``docs/NOMENCLATURE.md``, made from the code.

Write it again with ``python -m scenarios.pages.nomenclature > docs/NOMENCLATURE.md``; a test
compares.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import combinations, product
from typing import Any

from apu_casadi.core.errors import ParameterError
from apu_casadi.core.parameters import Parameters
from apu_casadi.core.results import CHANNELS
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.machine.faults.fault import FAULTS
from apu_casadi.machine.generator import NEUTRALS, Generator
from apu_casadi.machine.loads.load import LOADS
from apu_casadi.unit.apu import Apu

STATIONS = (
    ("0", "ambient air, static"),
    ("1", "intake entrance"),
    ("2", "compressor inlet"),
    ("3", "compressor outlet"),
    ("31", "combustor inlet, after the bleeds"),
    ("4", "combustor outlet"),
    ("41", "turbine rotor inlet, vane cooling mixed in: the turbine's work starts here"),
    ("50", "turbine rotor exit, before the rotor cooling mixes in"),
    ("5", "turbine outlet"),
    ("8", "exhaust exit"),
)

LETTERS = (
    ("T, P, W", "total temperature, total pressure, mass flow, with the station's number"),
    ("Ts, Ps", "static temperature and pressure"),
    ("PR, NPR", "pressure ratio, above one also in the turbine; of the exhaust to ambient"),
    ("FAR, war", "burnt fuel and water per dry air, by mass"),
    ("n, N", "corrected speed over its design value; speed"),
    ("eta, f_...", "efficiency; health factor, one when healthy"),
    ("lam_, i_, v_, V_", "flux linkage, current, voltage (v at an instant, V otherwise)"),
    ("_s, _fd, _kd, _kq", "stator, field winding, d damper, q damper"),
    ("_q, _d, _0; _a, _b, _c", "axes after Park's transform, q first; phases"),
    ("w_r, theta_e", "electrical rotor speed and angle"),
    ("mu, k_rf, kappa, h", "severity of a turn-to-turn short circuit; h = mu/(k_rf + 1 - mu)"),
)

CLASHES = (
    ("r_fd", "field resistance; the paper's R_f in Table 1"),
    ("r_fault", "resistance of the fault branch; the paper's R_f in (9)"),
    ("i_fault", "current of the fault branch; the paper's i_f, which is also the field current"),
    ("n_pp", "pole pairs; P is pressure or power"),
    (
        "PW, P_...",
        "power is PW at the shaft and P with a word elsewhere; P with a number is pressure",
    ),
    ("N", "gas generator speed, rad/s; the paper's XNHPC in r/min"),
    ("SM", "stability margin as a fraction; the paper's HPCSM in percent"),
)

_WORDS = {"inductive": "R-L", "capacitive": "R-C", "constant_power": "constant-power"}
_LOADS = {kind: _WORDS.get(kind, kind) for c in LOADS.classes for kind in c.examples()}
_FAULTS: dict[str | None, str] = {None: "no"}
_FAULTS |= {kind: kind for c in FAULTS.classes for kind in c.examples()}
_NEUTRALS = {kind: kind for kind in NEUTRALS}


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; bars and stars inside a cell are escaped."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(map(_escaped, r)) + " |" for r in lines)


def _escaped(cell: str) -> str:
    return cell.replace("|", "\\|").replace("*", "\\*")


def _signals(signals: Iterable[Signal]) -> str:
    rows = []
    for s in signals:
        default = "" if s.default is None else f"{s.default:g}"
        rows.append((f"`{s.name}`", s.unit, s.doc, default))
    if any(r[3] for r in rows):
        return table(("name", "unit", "meaning", "default"), rows)
    return table(("name", "unit", "meaning"), (r[:3] for r in rows))


Variant = tuple[str, str | None, str]
"""Load kind, fault kind, neutral."""


def _variants(generator: Generator) -> dict[Variant, Any]:
    made = {}
    for neutral, load, fault in product(_NEUTRALS, _LOADS, _FAULTS):
        g = dataclasses.replace(generator, neutral=neutral)
        with suppress(ParameterError):  # not every fault is possible with an isolated neutral
            made[load, fault, neutral] = g.state_space(load, fault)
    return made


def _condition(where: set[Variant], every: set[Variant]) -> str:
    """Say in as few words as possible in which variants something appears; "" for all."""
    words = []
    axes: tuple[tuple[Mapping[Any, str], str], ...] = (
        (_LOADS, "load"),
        (_FAULTS, "fault"),
        (_NEUTRALS, "neutral"),
    )
    for k, (names, noun) in enumerate(axes):
        values = {v[k] for v in where}
        said = [text for key, text in names.items() if key in values]
        words.append((k, values, f"{' or '.join(said)} {noun}"))
    for n in range(len(words) + 1):
        for some in combinations(words, n):
            if {v for v in every if all(v[k] in values for k, values, _ in some)} == where:
                return ", ".join(text for _, _, text in some)
    return "; ".join(sorted("/".join(str(x) for x in v) for v in where))


def _vectors(models: Mapping[Variant, Any], vector: str) -> str:
    """Return the union of one vector over the variants, each name with its condition."""
    union: dict[str, Signal] = {}
    where: dict[str, set[Variant]] = {}
    for variant, ss in models.items():
        signals: Signals = getattr(ss, vector)
        for s in signals:
            union.setdefault(s.name, s)
            where.setdefault(s.name, set()).add(variant)
    every = set(models)
    rows = [
        (f"`{n}`", s.unit, s.doc, _condition(where[n], every)) for n, s in union.items()
    ]  # fmt: skip
    return table(("name", "unit", "meaning", "only with"), rows)


def _value(x: float) -> str:
    return f"{x:.6g}"


def _parameters(p: Parameters) -> str:
    """Return a parameter set; a value that differs from the class's default was calibrated."""
    defaults = {f.name: f.default for f in dataclasses.fields(p)}
    rows = []
    for name, value, unit, doc, source in p.table():
        origin = source if value == defaults[name] else "calibrated to the paper's Tables 4 and 5"
        rows.append((f"`{name}`", _value(value), unit, doc, origin))
    return table(("name", "value", "unit", "meaning", "source"), rows)


def _choices(apu: Apu) -> str:
    rows = [(f"`{k}`", f'"{v}"') for k, v in apu.parameters().items() if isinstance(v, str)]
    return table(("name", "value"), rows)


def page() -> str:
    """Return the whole page as Markdown."""
    apu = Apu()
    models = _variants(apu.generator)
    known = {s.name for s in GasGenerator.Y}
    channels = [
        (f"`{n}`", unit, doc) for n, (unit, doc) in CHANNELS.items() if n not in known
    ]  # fmt: skip
    sets = {
        "gas_generator": ("Gas generator, design data", apu.gas_generator.parameters),
        "compressor_map": ("Compressor map", apu.gas_generator.compressor_map.calibration),
        "turbine_map": ("Turbine map", apu.gas_generator.turbine_map.calibration),
        "machine": ("Starter/generator", apu.generator.machine),
        "exciter": ("Exciter", apu.generator.exciter),
        "governor": ("Governor", apu.governor),
        "coupling": ("Gearbox", apu.coupling),
    }
    parts = [
        "# Names",
        "This page is made from the code by `python -m scenarios.pages.nomenclature >"
        " docs/NOMENCLATURE.md`. Change a name, unit or source there, where it is declared, and"
        " write the page again.",
        "Units are SI without prefix; `1` marks fractions and ratios. A quantity in another unit"
        " carries the unit in its name (`N_rpm`, `P3_kPa`) and appears only in files, tables and"
        " plots. Symbols follow ARP 755 for stations and the paper (Mao and Guo) elsewhere. Numbers"
        " in parentheses are the paper's equations.",
        "## Stations",
        table(("number", "place"), STATIONS),
        "## Letters",
        table(("symbol", "meaning"), ((f"`{a}`", b) for a, b in LETTERS)),
        "## Clashes settled",
        table(("name", "meaning"), ((f"`{a}`", b) for a, b in CLASHES)),
        "## Gas generator",
        "### States `GasGenerator.X`",
        _signals(GasGenerator.X),
        "### Inputs `GasGenerator.U`",
        _signals(GasGenerator.U),
        "### Health factors `GasGenerator.THETA`",
        _signals(GasGenerator.THETA),
        "### Algebraic unknowns `GasGenerator.z`",
        _signals(apu.gas_generator.z),
        "### Outputs `GasGenerator.Y`",
        _signals(GasGenerator.Y),
        "## Starter/generator",
        "The vectors depend on the load, the fault and the neutral;"
        " `Generator.state_space(load_kind, faulted)` returns the variant. An empty last column"
        " means: always.",
        "### States `x`",
        _vectors(models, "x"),
        "### Algebraic unknowns `z`",
        _vectors(models, "z"),
        "### Inputs `u`",
        _vectors(models, "u"),
        "### Fault parameters `theta`",
        _vectors(models, "theta"),
        "### Outputs `y`",
        _vectors(models, "y"),
        "## Results of a joint run",
        "The dataset holds the outputs of the gas generator on `time`, and some of the following."
        " Measured copies carry `_meas`. Names of one generator are those of each of the two.",
        table(("name", "unit", "meaning"), channels),
        "## Parameters",
        "The full name of a parameter is that of its set, a dot and its own: `machine.r_s`. A"
        " scenario's `[parameters]` table and `Apu.change` take these names.",
    ]
    for key, (title, p) in sets.items():
        parts += [f"### {title}: `{key}`", _parameters(p)]
    parts += ["### Choices", _choices(apu)]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # type: ignore[union-attr]
    sys.stdout.write(page())
