"""``modelDescription.xml`` of FMI 2.0 and 3.0, and units as powers of the base units."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterator
from xml.etree import ElementTree as Xml

from apu_casadi.core.errors import DataError
from apu_casadi.core.version import installed
from scenarios.export.fmumodel import STEP, FmuModel, Variable

BASE = ("kg", "m", "s", "A", "K", "rad")
_DERIVED = """
N kg1 m1 s-2 | J kg1 m2 s-2 | W kg1 m2 s-3 | Pa kg1 m-1 s-2 | V kg1 m2 s-3 A-1
ohm kg1 m2 s-3 A-2 | H kg1 m2 s-2 A-2 | F kg-1 m-2 s4 A2 | Wb kg1 m2 s-2 A-1 | Hz s-1 | 1
"""
_ROLES = {"input": ("input", "continuous"), "parameter": ("parameter", "tunable")}
_ROLES |= {"state": ("local", "continuous"), "output": ("output", "continuous")}


def _powers(text: str) -> dict[str, int]:
    found = (re.fullmatch(r"([A-Za-z]+)(-?\d+)", p) for p in text.split())
    return {p[1]: int(p[2]) for p in found if p}


KNOWN = {n: {n: 1} for n in BASE}
KNOWN |= {w.split()[0]: _powers(w.partition(" ")[2]) for w in re.split(r"[|\n]", _DERIVED) if w.split()}


def base_powers(unit: str) -> dict[str, int]:
    """Return the powers of the base units, as of ``J/(kg K)`` or ``kg/s^2``.

    Raises:
        DataError: a unit that is not known.
    """
    total: dict[str, int] = {}
    above, *below = re.sub(r"[()]", " ", unit).split("/")
    for sign, part in ((1, above), *((-1, b) for b in below)):
        for word in part.split():
            name, _, power = word.partition("^")
            if name not in KNOWN:
                raise DataError(f"unit {unit!r}: {name!r} is none that an FMU can be given")
            for base, n in KNOWN[name].items():
                total[base] = total.get(base, 0) + sign * n * int(power or 1)
    return {b: n for b, n in total.items() if n}


def rates(model: FmuModel) -> list[tuple[str, str, str]]:
    """Return name, unit and meaning of the rates of the states."""
    states = (v.signal for v in model.of("state"))
    return [(f"{s.name}_dot", f"{s.unit}/s", f"rate of {s.name}") for s in states]


def described(model: FmuModel, fmi: int, identifier: str) -> tuple[str, str]:
    """Return the description's text, and its token, a hash of all that it says."""
    without = _text(model, fmi, identifier, "")
    digest = hashlib.sha256(without.encode()).hexdigest()
    token = "{" + "-".join(digest[i:j] for i, j in ((0, 8), (8, 12), (12, 16), (16, 20), (20, 32))) + "}"
    return _text(model, fmi, identifier, token), token


def _text(model: FmuModel, fmi: int, identifier: str, token: str) -> str:
    key = "instantiationToken" if fmi == 3 else "guid"
    root = Xml.Element("fmiModelDescription", {
        "fmiVersion": "3.0" if fmi == 3 else "2.0", "modelName": model.name, key: token,
        "description": model.doc, "version": installed(), "license": "Apache-2.0",
        "generationTool": f"apu-casadi {installed()}", "variableNamingConvention": "flat",
    })  # fmt: skip
    if fmi == 2:
        root.set("numberOfEventIndicators", "0")
    state = "FMUState" if fmi == 3 else "FMUstate"
    for kind in ("ModelExchange", "CoSimulation"):
        part = Xml.SubElement(root, kind, {"modelIdentifier": identifier})
        part.set(f"canGetAndSet{state}", "true")
        part.set(f"canSerialize{state}", "true")
        if kind == "CoSimulation":
            part.set("canHandleVariableCommunicationStepSize", "true")
        if fmi == 2:
            files = Xml.SubElement(part, "SourceFiles")
            for name in source_names(model, fmi):
                Xml.SubElement(files, "File", {"name": name})
    _units(Xml.SubElement(root, "UnitDefinitions"), model)
    log = Xml.SubElement(root, "LogCategories")
    for name in ("logStatusError", "logStatusDiscard"):
        Xml.SubElement(log, "Category", {"name": name})
    Xml.SubElement(root, "DefaultExperiment", {"startTime": "0", "stopTime": "10", "stepSize": repr(STEP)})
    variables = Xml.SubElement(root, "ModelVariables")
    for element in (_variables3(model) if fmi == 3 else _variables2(model)):
        variables.append(element)
    _structure(Xml.SubElement(root, "ModelStructure"), model, fmi)
    Xml.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + Xml.tostring(root, "unicode") + "\n"


def source_names(model: FmuModel, fmi: int) -> list[str]:
    """Return the C files that are compiled."""
    own = (f"fmi{fmi}.c", "unit.c", "model.c", *model.sources)
    return [n for n in own if n.endswith(".c")]


def _units(parent: Xml.Element, model: FmuModel) -> None:
    names = dict.fromkeys(["s", *(v.signal.unit for v in model.variables)])
    names |= dict.fromkeys(unit for _, unit, _ in rates(model))
    for name in names:
        unit = Xml.SubElement(parent, "Unit", {"name": name})
        Xml.SubElement(unit, "BaseUnit", {b: str(n) for b, n in base_powers(name).items()})


def _numbers(v: Variable) -> dict[str, str]:
    """Attributes of a value: unit, range, magnitude, start."""
    told = {"unit": v.signal.unit}
    told |= {k: repr(x) for k, x in (("min", v.least), ("max", v.most)) if math.isfinite(x)}
    if v.role == "state":
        told["nominal"] = repr(float(v.signal.nominal))
    if v.role != "output":
        told["start"] = repr(v.start)
    return told


def _attributes(v: Variable, reference: int) -> dict[str, str]:
    causality, variability = _ROLES[v.role]
    told = {"name": v.signal.name, "valueReference": str(reference), "description": v.signal.doc}
    told |= {"causality": causality, "variability": variability}
    if v.role in ("parameter", "state"):
        told["initial"] = "exact"
    return told


def placed(model: FmuModel) -> Iterator[tuple[int, Variable | tuple[str, str, str], int]]:
    """Yield value reference, variable or rate, and for a rate the reference of its state."""
    reference, first = 1, 1 + sum(v.role in ("input", "parameter") for v in model.variables)
    for v in model.variables:
        if v.role == "output":
            break
        yield reference, v, 0
        reference += 1
    for k, rate in enumerate(rates(model)):
        yield reference, rate, first + k
        reference += 1
    for v in model.of("output"):
        yield reference, v, 0
        reference += 1


def _variables3(model: FmuModel) -> Iterator[Xml.Element]:
    yield Xml.Element("Float64", {"name": "time", "valueReference": "0", "description": "time",
                                  "causality": "independent", "variability": "continuous",
                                  "unit": "s"})  # fmt: skip
    for reference, v, state in placed(model):
        if isinstance(v, Variable):
            yield Xml.Element("Float64", _attributes(v, reference) | _numbers(v))
        else:
            told = {"name": v[0], "valueReference": str(reference), "description": v[2]}
            told |= {"causality": "local", "variability": "continuous", "unit": v[1]}
            yield Xml.Element("Float64", told | {"derivative": str(state)})


def _variables2(model: FmuModel) -> Iterator[Xml.Element]:
    # positions are those of the list, from 1: the references themselves
    for reference, v, state in placed(model):
        if isinstance(v, Variable):
            element = Xml.Element("ScalarVariable", _attributes(v, reference))
            Xml.SubElement(element, "Real", _numbers(v))
        else:
            told = {"name": v[0], "valueReference": str(reference), "description": v[2]}
            element = Xml.Element("ScalarVariable", told | {"causality": "local", "variability": "continuous"})
            Xml.SubElement(element, "Real", {"unit": v[1], "derivative": str(state)})
        yield element


def _structure(parent: Xml.Element, model: FmuModel, fmi: int) -> None:
    outputs = [r for r, v, _ in placed(model) if isinstance(v, Variable) and v.role == "output"]
    moving = [r for r, v, _ in placed(model) if not isinstance(v, Variable)]
    for tag, references in (("Output", outputs), ("ContinuousStateDerivative", moving),
                            ("InitialUnknown", sorted([*outputs, *moving]))):  # fmt: skip
        if fmi == 3:
            for r in references:
                Xml.SubElement(parent, tag, {"valueReference": str(r)})
        else:
            name = {"Output": "Outputs", "InitialUnknown": "InitialUnknowns"}.get(tag, "Derivatives")
            group = Xml.SubElement(parent, name)
            for r in references:
                Xml.SubElement(group, "Unknown", {"index": str(r)})
