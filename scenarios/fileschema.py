"""JSON schemas of scenario and engine files, made of what reads them; editors complete by them.

``apu list --schema > scenario.schema.json`` writes that of a scenario file, with the parts of
``--with`` too, ``apu list --engine-schema > engine.schema.json`` that of an engine's file.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from apu_casadi.core.profiles.points import FILE_KEYS as FILE_KEYS_OF_POINTS
from apu_casadi.core.profiles.points import OfPoints
from apu_casadi.core.profiles.profile import PROFILES
from apu_casadi.core.register import Key
from apu_casadi.core.tables.tablelayout import DECIMALS
from apu_casadi.core.units import ALL_UNITS
from apu_casadi.gaspath.conditions import CONDITIONS
from apu_casadi.gaspath.health import HEALTH_FACTORS
from apu_casadi.machine.faults.fault import FAULTS, Fault
from apu_casadi.machine.generator import CHOICES
from apu_casadi.machine.loads.load import LOADS
from apu_casadi.unit.control import GOVERNORS
from apu_casadi.unit.events import HEALTH_HI, HEALTH_LO, MOST, STARTS
from scenarios.phases import CHANGES, Change, Phase
from scenarios.reading import DEFAULT_FAULT, names_of
from scenarios.schema import EXCHANGES, FILE_KEYS, Scenario

if TYPE_CHECKING:
    from apu_casadi.core.parameters import Parameters

Table = dict[str, Any]
_GENERATOR = {"$ref": "#/definitions/generator"}
_HEALED = ("kind", "generator")
_NONE = {"const": "none", "description": "healthy again"}


def file_schema() -> Table:
    """Return the schema (JSON Schema, draft 7) of a scenario file."""
    number = {"type": "integer", "minimum": 1, "maximum": MOST, "description": "of a generator"}
    one_load = _load()
    several = {"type": "array", "items": one_load, "minItems": 1, "maxItems": MOST}
    definitions = {
        "load": {"anyOf": [one_load, several | {"description": "one for each generator"}]},
        "fault": _fault(),
        "generator": number,
        "health": _health(),
        "profile": _profile(),
        "N_ref_rpm": _varies(_number(0.0, open_lo=True, unit="r/min")),
    }
    table = _object(_scenario(), ("name", "duration", "phase"))
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": "apu-casadi scenario"}
    return head | table | {"definitions": definitions}


def engine_schema() -> Table:
    """Return the schema (JSON Schema, draft 7) of an engine's file."""
    from apu_casadi.gaspath.engines import HEAD
    from apu_casadi.gaspath.gas import DATA_SETS
    from apu_casadi.gaspath.steady.steadypoint import LIMIT_RANGES, LIMIT_UNITS
    from apu_casadi.machine.machinedata import SaturatedMachine
    from apu_casadi.unit.apu import Apu

    sets = Apu().parameter_sets()
    limits = {n: _given(_number(*LIMIT_RANGES[n], unit=u), u) for n, u in LIMIT_UNITS.items()}
    gas = _object(_set(sets["gas_generator"]) | {"gas_data": {"enum": list(DATA_SETS)}})
    inner = {n: _object(_set(sets[n])) for n in ("exciter", "coupling")}
    inner["machine"] = _object(_set(SaturatedMachine()) | {"S_10": _given(_number(0.0), "1")})
    of_one = inner | {n: {"enum": list(words)} for n, words in CHOICES.items()}
    of_one["count"] = {"type": "integer", "minimum": 1, "maximum": MOST}
    several = {"type": "array", "items": _object(of_one), "minItems": 1, "maxItems": MOST}
    laws = [
        _object({"kind": {"const": kind}, **_set(law())}, () if kind == "PI" else ("kind",))
        for kind, law in ((kind, GOVERNORS[kind]) for kind in GOVERNORS)
    ]
    table: Table = {n: {"type": "string"} for n in HEAD} | {
        "gas_generator": gas,
        "limits": _object(limits),
    }
    table |= {n: _map(sets[n]) for n in ("compressor_map", "turbine_map")}
    table |= {"generator": {"anyOf": [_object(of_one), several]}, "governor": {"anyOf": laws}}
    table |= {"coupling": inner["coupling"]}
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": "apu-casadi engine"}
    return head | _object(table, minProperties=1)


def _set(p: Parameters) -> Table:
    """Return the numbers of a parameter set as an engine's file gives them."""
    fields = {f.name: f.metadata for f in dataclasses.fields(p) if "unit" in f.metadata}
    return {
        n: _given(_number(m["lo"], m["hi"], unit=m["unit"], doc=m["doc"]), m["unit"])
        for n, m in fields.items()
    }


def _given(number: Table, si: str) -> Table:
    """Return a number alone, in SI units, or a table with value, unit and source."""
    same = {u for u, (base, *_) in ALL_UNITS.items() if base == si or {base, si} == {"1", "kg/kg"}}
    text: Table = {"type": "string"}
    full: Table = {"value": {"type": "number"}, "unit": text, "source": text}
    other = _object(full | {"unit": {"enum": sorted(same | {si})}}, ("value", "unit"))
    alone = _object({"value": number, "source": text}, ("value",))
    words = {k: number[k] for k in ("description",) if k in number}
    return {"anyOf": [number, alone, other]} | words


def _map(calibration: Parameters) -> Table:
    from apu_casadi.gaspath.maps.mapfiles import SHIPPED

    text: Table = {"type": "string", "minLength": 1}
    flag = {"type": "boolean"}
    place = {n: _given(_number(), "1") for n in ("N_map_des", "beta_des")}
    own = {**place, **_set(calibration)}
    of_file = _object({"file": text, "trim": flag, "check": flag, **own}, ("file",))
    return {"anyOf": [of_file, _object({"shipped": {"enum": list(SHIPPED)}, **own}, ("shipped",))]}


def docs_of(cls: type) -> dict[str, str]:
    """Return what the section ``Args:`` of a docstring says of each name, in one line."""
    text = inspect.cleandoc(cls.__doc__ or "").partition("Args:\n")[2].partition("\n\n")[0]
    found = re.findall(r"(?m)^    (\w[\w, ]*): (.*(?:\n {8}.*)*)", text)
    return {
        n.strip(): " ".join(doc.split()).rstrip(".")
        for names, doc in found
        for n in names.split(",")
    }


def _object(properties: Table, required: Sequence[str] = (), **more: Any) -> Table:
    table: Table = {"type": "object", "properties": properties, "additionalProperties": False}
    return table | ({"required": list(required)} if required else {}) | more


def _number(
    lo: float = -float("inf"),
    hi: float = float("inf"),
    *,
    open_lo: bool = False,
    unit: str = "",
    doc: str = "",
) -> Table:
    table: Table = {"type": "number"}
    if lo > -float("inf"):
        table["exclusiveMinimum" if open_lo else "minimum"] = lo
    if hi < float("inf"):
        table["maximum"] = hi
    words = f"{doc} [{unit}]" if unit not in ("", "1") else doc
    return table | ({"description": words} if words else {})


def _varies(number: Table) -> Table:
    """Return a number, or a profile in its place."""
    made: Table = {"anyOf": [number, {"$ref": "#/definitions/profile"}]}
    return made | {k: number[k] for k in ("description",) if k in number}


def _key(key: Key) -> Table:
    if key.choices:
        return {"enum": list(key.choices), "description": key.doc}
    one = _number(key.lo, key.hi, open_lo=key.open_lo, unit=key.unit, doc=key.doc)
    if not key.phases:
        return one
    three = {"type": "array", "items": one, "minItems": 3, "maxItems": 3}
    return {"anyOf": [one, three], "description": f"{key.doc}: one for all phases, or a, b, c"}


def _part(kind: str, keys: Sequence[Key], cls: type, *, optional: bool = False) -> Table:
    needed = [k.name for k in keys if k.default is ...]
    required = needed if optional else ["kind", *needed]
    own = {k.name: _key(k) if k.choices else _varies(_key(k)) for k in keys}
    table = {"kind": {"const": kind}, **own}
    return _object(table, required, description=(cls.__doc__ or kind).split("\n")[0])


def _profile() -> Table:
    """Return the kinds of profiles; what has all keys of a kind need not name it."""
    numbers = {"type": "array", "items": {"type": "number"}, "minItems": 1}
    text = {"type": "string", "minLength": 1}
    each = []
    for kind, cls in PROFILES.items():
        ways = [{k.name: _key(k) for k in cls.keys}]
        if issubclass(cls, OfPoints):
            ways = [{"times": numbers, "values": numbers}, _of_files(text)]
        told = cls.told_by(dict.fromkeys((*ways[0], "file")))
        for own in ways:
            needed = [k.name for k in cls.keys if k.default is ... and k.name in own]
            needed = needed or ["file"]
            required = needed if told else ["kind", *needed]
            words = (cls.__doc__ or kind).split("\n")[0]
            each.append(_object({"kind": {"const": kind}, **own}, required, description=words))
    return {"anyOf": each}


def _of_files(text: Table) -> Table:
    cell = {"type": ["number", "string"]}
    own = {"decimal": {"enum": list(DECIMALS)}, "missing": {"type": "array", "items": cell}}
    return dict.fromkeys(FILE_KEYS_OF_POINTS, text) | own


def _load() -> Table:
    each = ((kind, LOADS[kind]) for kind in LOADS)
    return {"oneOf": [_part(kind, cls.tables[kind], cls) for kind, cls in each]}


def _fault() -> Table:
    kinds, of_one = [], [_object({"kind": {"const": "none"}, "generator": _GENERATOR}, _HEALED)]
    for kind, cls in ((kind, FAULTS[kind]) for kind in FAULTS):
        other = [tuple(new if k.name == n else k for k in cls.keys) for n, new in _instead(cls)]
        for keys in (cls.keys, *other):
            made = _part(kind, keys, cls, optional=kind == DEFAULT_FAULT)
            kinds.append(made)
            own = {**made["properties"], "generator": _GENERATOR}
            required = [*made.get("required", ()), "generator"]
            of_one.append(made | {"properties": own, "required": required})
    several = {"type": "array", "items": {"anyOf": of_one}, "minItems": 1, "maxItems": MOST}
    return {"anyOf": [*kinds, *of_one, several, _NONE]}


def _instead(cls: type[Fault]) -> Sequence[tuple[str, Key]]:
    """Return keys that may be replaced, each with what replaces it, which is then needed."""
    return [(n, dataclasses.replace(k, default=...)) for n, k in cls.instead.items()]


def _health() -> Table:
    limits: Table = {"lo": HEALTH_LO, "hi": HEALTH_HI, "open_lo": True}
    factors = {n: _varies(_number(**limits, doc=f.doc)) for n, f in HEALTH_FACTORS.items()}
    return {"oneOf": [_object(factors), _NONE]}


def _numbers(cls: type) -> Table:
    """Return the fields of a class that are numbers in a range."""
    docs = docs_of(cls)
    made = {}
    for f in dataclasses.fields(cls):
        if "unit" in f.metadata:
            made[f.name] = _number(**f.metadata, doc=docs.get(f.name, ""))
    return made


def _row(cls: type) -> Table:
    """Return phases or events."""
    own = [f.name for f in dataclasses.fields(cls) if not f.kw_only]
    text = {n: {"type": "string", "minLength": 1} for n in own if n == "name"}
    names = [n for n in names_of(cls) if n in (*CHANGES, "generator")]
    changes = {n: {"$ref": f"#/definitions/{n}"} for n in names}
    item = _object(text | _numbers(cls) | changes, own)
    return {"type": "array", "items": item, "description": (cls.__doc__ or "").split("\n")[0]}


def _noise() -> Table:
    from apu_casadi.machine.measurement import MeasurementNoise
    from apu_casadi.unit.noise import Noise

    def deviations(cls: type, names: Sequence[str]) -> Table:
        docs = docs_of(cls)
        return {n: _number(0.0, doc=docs.get(n, "")) for n in names}

    plain = [n for n in names_of(Noise) if n not in ("gas", "terminal")]
    table = deviations(Noise, plain)
    table["gas"] = {"type": "object", "additionalProperties": _number(0.0)}
    table["terminal"] = _object(deviations(MeasurementNoise, names_of(MeasurementNoise)))
    return _object(table)


def _parameters() -> Table:
    """Return the parameters, as dotted names and as nested tables."""
    from apu_casadi.unit.apu import Apu

    table: Table = {}
    for name, value in Apu().parameters().items():
        one = {"type": "string" if isinstance(value, str) else "number", "default": value}
        part, _, last = name.partition(".")
        table[name] = one
        table.setdefault(part, _object({}))["properties"][last] = one
    own = {n: table[n] for n in ("machine", "exciter", "coupling")}
    dotted = [f"{s}\\.{n}" for s in own for n in own[s]["properties"]]
    words = {n: v for n, v in table["generator"]["properties"].items() if n != "count"}
    patterns = {
        f"^generator[1-{MOST}]$": _object(own | words),
        rf"^generator[1-{MOST}]\.({'|'.join([*dotted, *words])})$": {"type": ["number", "string"]},
    }
    return _object(table, patternProperties=patterns)


def _scenario() -> Table:
    docs = docs_of(Scenario)
    texts = {"type": "array", "items": {"type": "string"}}
    ambient = {
        n: _varies(_number(c.lo, c.hi, unit=c.unit, doc=c.doc)) for n, c in CONDITIONS.items()
    }
    table = _numbers(Scenario) | {
        "name": {"type": "string", "pattern": "^[A-Za-z0-9][A-Za-z0-9_-]*$", "maxLength": 100},
        "title": {"type": "string"},
        "doc": {"type": "string"},
        "ambient": _object(ambient),
        "phase": _row(Phase) | {"minItems": 1},
        "event": _row(Change),
        "exchange": {"enum": list(EXCHANGES)},
        "start_from": {"enum": list(STARTS)},
        "noise": _noise(),
        "seed": {"type": "integer", "minimum": 0},
        "parameters": _parameters(),
        "engine": {"type": "string"},
        "governor": {"enum": list(GOVERNORS)},
        "extensions": texts,
    }
    step = table["waveform_dt"]
    table["waveform_dt"] = {"anyOf": [step, {"const": 0}], "description": docs["waveform_dt"]}
    return {k: {"description": docs.get(k, "")} | table[k] for k in FILE_KEYS}
