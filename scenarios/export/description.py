"""``modelDescription.xml`` of FMI 2.0 and 3.0, and units as powers of the base units."""

from __future__ import annotations

import hashlib
import math
import re
from itertools import pairwise
from xml.etree import ElementTree as Xml

from apu_casadi.core.errors import DataError
from apu_casadi.core.version import installed
from scenarios.export.fmumodel import STEP, FmuModel, Variable

BASE = ("kg", "m", "s", "A", "K", "rad")
_DERIVED = """
N    kg m s^-2
J    kg m^2 s^-2
W    kg m^2 s^-3
Pa   kg m^-1 s^-2
V    kg m^2 s^-3 A^-1
ohm  kg m^2 s^-3 A^-2
H    kg m^2 s^-2 A^-2
F    kg^-1 m^-2 s^4 A^2
Wb   kg m^2 s^-2 A^-1
Hz   s^-1
1
"""
# causality, variability, initial
_ROLES = {
    "input": ("input", "continuous", ""),
    "parameter": ("parameter", "tunable", "exact"),
    "state": ("local", "continuous", "exact"),
    "rate": ("local", "continuous", ""),
    "output": ("output", "continuous", ""),
}


def _powers(words: list[str]) -> dict[str, int]:
    pairs = (w.partition("^") for w in words)
    return {name: int(power or 1) for name, _, power in pairs}


KNOWN = {n: {n: 1} for n in BASE}
KNOWN |= {w[0]: _powers(w[1:]) for w in map(str.split, _DERIVED.strip().splitlines())}


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


def described(model: FmuModel, fmi: int) -> tuple[str, str]:
    """Return the description's text, and its token, a hash of all that it says."""
    digest = hashlib.sha256(_text(model, fmi, "").encode()).hexdigest()
    cuts = (0, 8, 12, 16, 20, 32)
    token = "{" + "-".join(digest[i:j] for i, j in pairwise(cuts)) + "}"
    return _text(model, fmi, token), token


def _text(model: FmuModel, fmi: int, token: str) -> str:
    head = {"fmiVersion": f"{fmi}.0", "modelName": model.name, "description": model.doc}
    head |= {"instantiationToken" if fmi == 3 else "guid": token, "license": "Apache-2.0"}
    head |= {"version": installed(), "generationTool": f"apu-casadi {installed()}"}
    head |= {"variableNamingConvention": "flat"}
    root = Xml.Element("fmiModelDescription", head)
    for kind in ("ModelExchange", "CoSimulation"):
        state, able = "FMUState" if fmi == 3 else "FMUstate", {"modelIdentifier": model.name}
        able |= {f"canGetAndSet{state}": "true", f"canSerialize{state}": "true"}
        if kind == "CoSimulation":
            able["canHandleVariableCommunicationStepSize"] = "true"
        part = Xml.SubElement(root, kind, able)
        if fmi == 2:
            files = Xml.SubElement(part, "SourceFiles")
            for name in source_names(model, fmi):
                Xml.SubElement(files, "File", {"name": name})
    units = Xml.SubElement(root, "UnitDefinitions")
    for name in dict.fromkeys(["s", *(v.signal.unit for v in model.variables)]):
        powers = {b: str(n) for b, n in base_powers(name).items()}
        Xml.SubElement(Xml.SubElement(units, "Unit", {"name": name}), "BaseUnit", powers)
    log = Xml.SubElement(root, "LogCategories")
    for name in ("logStatusError", "logStatusDiscard"):
        Xml.SubElement(log, "Category", {"name": name})
    usual = {"startTime": "0", "stopTime": "10", "stepSize": repr(STEP)}
    Xml.SubElement(root, "DefaultExperiment", usual)
    variables = Xml.SubElement(root, "ModelVariables")
    if fmi == 3:
        time = {"name": "time", "valueReference": "0", "description": "time", "unit": "s"}
        time |= {"causality": "independent", "variability": "continuous"}
        Xml.SubElement(variables, "Float64", time)
    for reference, v in enumerate(model.variables, 1):
        attributes, numbers = _variable(v, reference, len(model.of("state")))
        if fmi == 3:
            Xml.SubElement(variables, "Float64", attributes | numbers)
        else:  # a place in the list, counted from 1, is the reference itself
            Xml.SubElement(Xml.SubElement(variables, "ScalarVariable", attributes), "Real", numbers)
    _structure(Xml.SubElement(root, "ModelStructure"), model, fmi)
    return text_of(root)


def text_of(root: Xml.Element) -> str:
    """Return a document."""
    Xml.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + Xml.tostring(root, "unicode") + "\n"


def source_names(model: FmuModel, fmi: int) -> list[str]:
    """Return the C files that are compiled."""
    own = (f"fmi{fmi}.c", "unit.c", "model.c", *model.sources)
    return [n for n in own if n.endswith(".c")]


def _variable(v: Variable, reference: int, states: int) -> tuple[dict[str, str], dict[str, str]]:
    """Return what a variable is, and the attributes of its value; a rate follows its state."""
    causality, variability, initial = _ROLES[v.role]
    told = {"name": v.signal.name, "valueReference": str(reference), "description": v.signal.doc}
    told |= {"causality": "output" if v.shown else causality, "variability": variability}
    told |= {"initial": initial} if initial else {}
    value = {"unit": v.signal.unit}
    value |= {k: repr(float(x)) for k, x in (("min", v.least), ("max", v.most)) if abs(x) < 1e300}
    value |= {"nominal": repr(float(v.signal.nominal))} if v.role == "state" else {}
    value |= {"start": repr(v.start)} if math.isfinite(v.start) else {}
    value |= {"derivative": str(reference - states)} if v.role == "rate" else {}
    return told, value


def _structure(parent: Xml.Element, model: FmuModel, fmi: int) -> None:
    every = list(enumerate(model.variables, 1))
    outputs = [r for r, v in every if v.role == "output" or v.shown]
    rates = [r for r, v in every if v.role == "rate"]
    unknown = [r for r, v in every if v.role in ("rate", "output")]
    for new, old, references in (
        ("Output", "Outputs", outputs),
        ("ContinuousStateDerivative", "Derivatives", rates),
        ("InitialUnknown", "InitialUnknowns", unknown),
    ):
        group = parent if fmi == 3 else Xml.SubElement(parent, old)
        for r in references:
            told = {"valueReference": str(r)} if fmi == 3 else {"index": str(r)}
            Xml.SubElement(group, new if fmi == 3 else "Unknown", told)
