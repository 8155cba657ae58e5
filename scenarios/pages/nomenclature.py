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
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.machine.faults.fault import FAULTS
from apu_casadi.machine.generator import NEUTRALS, Generator
from apu_casadi.machine.loads.load import LOADS
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.runsignals import RUN
from scenarios.shell.template import Template

TEXT = Template.of("nomenclature.md")
_WORDS = {"inductive": "R-L", "capacitive": "R-C", "constant_power": "constant-power"}


def _shipped(classes: Iterable[type]) -> list[Any]:
    """Return the classes of the package, by their files: others may be registered, in any order."""
    own = (c for c in classes if c.__module__.startswith("apu_casadi."))
    return sorted(own, key=lambda c: c.__module__)


_LOADS = {kind: _WORDS.get(kind, kind) for c in _shipped(LOADS.classes) for kind in c.examples()}
_FAULTS: dict[str | None, str] = {None: "no"}
_FAULTS |= {kind: kind for c in _shipped(FAULTS.classes) for kind in c.examples()}
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
    axes: list[tuple[Mapping[Any, str], str]] = [(_LOADS, "load"), (_FAULTS, "fault")]
    axes.append((_NEUTRALS, "neutral"))
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
    rows = [(f"`{n}`", s.unit, s.doc, _condition(where[n], every)) for n, s in union.items()]
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
    counted = {k: f'"{v}"' if isinstance(v, str) else f"{v}" for k, v in apu.parameters().items()}
    rows = [(f"`{k}`", v) for k, v in counted.items() if v[0] == '"' or k.startswith("generator.")]
    return table(("name", "value"), rows)


def _listed(block: str, head: str, form: str = "`{}`") -> str:
    """Return a block of two columns as a table."""
    rows = (row.split(" | ") for row in TEXT.raw(block).splitlines())
    meaning = "place" if block == "stations" else "meaning"
    return table((head, meaning), ((form.format(a), b) for a, b in rows))


def page() -> str:
    """Return the whole page as Markdown."""
    apu = Apu()
    models = _variants(apu.generator)
    known = {s.name for s in GasGenerator.Y}
    channels = [(f"`{s.name}`", s.unit, s.doc) for s in RUN if s.name not in known]
    sets = {
        "gas_generator": ("Gas generator, design data", apu.gas_generator.parameters),
        "compressor_map": ("Compressor map", apu.gas_generator.compressor_map.calibration),
        "turbine_map": ("Turbine map", apu.gas_generator.turbine_map.calibration),
        "machine": ("Starter/generator", apu.generator.machine),
        "exciter": ("Exciter", apu.generator.exciter),
        "governor": ("Governor", apu.governor),
        "coupling": ("Gearbox", apu.coupling),
    }
    parameters = [f"### {head}: `{key}`\n\n{_parameters(p)}" for key, (head, p) in sets.items()]
    vectors = {"X": GasGenerator.X, "U": GasGenerator.U, "THETA": GasGenerator.THETA}
    vectors |= {"z": apu.gas_generator.z, "Y": GasGenerator.Y}
    text = TEXT.text(
        "top",
        stations=_listed("stations", "number", "{}"),
        letters=_listed("letters", "symbol"),
        clashes=_listed("clashes", "name"),
        vectors={v: _vectors(models, v) for v in ("x", "z", "u", "theta", "y")},
        channels=table(("name", "unit", "meaning"), channels),
        parameters="\n\n".join(parameters),
        choices=_choices(apu),
        **{name: _signals(signals) for name, signals in vectors.items()},
    )
    return text + "\n"


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # type: ignore[union-attr]
    sys.stdout.write(page())
