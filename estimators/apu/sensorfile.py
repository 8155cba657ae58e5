"""Files of sensors: a set of sensors is a file, a sensor an entry of it.

    [T5]
    noise = 0.004          # 1 sigma, of the reading, where the table's is
    gain = 0.0
    rate = 10              # Hz
    lag = 1.0              # s
    [T41]                  # a known sensor that is not in the table
    [i_a]
    noise = 2.0            # A
    jitter = 5e-6          # s
    [EGT]                  # one of its own
    quantity = "T5"
    unit = "degC"          # of noise, bias, drift, quantum, range, plausible, and of the readings
    noise = 2.0
    lag = 0.5
    [f_gen]
    quantity = "N"         # rad/s
    unit = "Hz"
    factor = 0.1061        # Hz per rad/s
    noise = 0.05

    [i_a_2]                # of the second generator alone
    noise = 4.0

What an entry does not say is the table's, of ``i_a_2`` that of ``i_a``; ``complete = true`` above
all entries leaves out the sensors that have none.  :func:`sensor_schema` is the JSON schema of such
a file, for editors.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from apu_casadi.core.errors import DataError, ParameterError, nearest
from apu_casadi.core.register import Key
from apu_casadi.core.tomlnumbers import read_toml
from apu_casadi.core.units import UNITS
from apu_casadi.gaspath.gasgenerator import GasGenerator
from estimators.apu.sensors import (
    ELECTRICAL,
    KNOWN,
    NUMBERS,
    WAYS,
    Sensor,
    SensorSet,
    gas_path_table,
    known,
    plain,
)

__all__ = ["KEYS", "SensorFile", "read_sensors", "sensor_schema", "to_toml"]

#: Numbers and choices of an entry.
KEYS = (
    Key("noise", "", "standard deviation of the white noise", 0, 1e12),
    Key("gain", "1", "standard deviation of the constant relative gain error", 0, 1),
    Key("gain_mean", "1", "expected gain error, of which readings are corrected", -0.9, 1e3),
    Key("gain_as", "", "the gain error in filters", choices=WAYS),
    Key("bias", "", "standard deviation of the constant offset", 0, 1e12),
    Key("bias_mean", "", "expected offset, of which readings are corrected", -1e12, 1e12),
    Key("bias_as", "", "the offset in filters", choices=WAYS),
    Key("drift", "", "random walk of the offset, per sqrt(s)", 0, 1e12),
    Key("lag", "s", "time constant of a first-order lag", 0, 1e4),
    Key("delay", "s", "by which a reading is older than its stamp", 0, 1e4),
    Key("jitter", "s", "standard deviation of the instant of each sample", 0, 1e4),
    Key("quantum", "", "step of the digits", 0, 1e12),
    Key("turn", "", "period of an angle, which is read modulo it", 0, 1e12),
    Key("rate", "Hz", "of the readings; default: every instant that is sampled", 0, 1e12, True),
    Key("factor", "", "reading over quantity, in their units", -1e12, 1e12),
)
#: Gas-path sensors that need no ``quantity``: those of the tables.
TABLED = tuple(KNOWN)
_BY_NAME = {k.name: k for k in KEYS}
_SPANS = {"range": "what it can show; there it saturates", "plausible": "of a running engine"}
_FLAGS = {"relative": "noise is a share of the reading", "fails": "whether it can fail"}
_TEXTS = {"quantity": "what it reads", "unit": "of its numbers", "source": "of its numbers"}
_TEXTS |= {"clock": "what samples it: sensors of one clock share their jitter"}
_ALL = (*_BY_NAME, *_SPANS, *_FLAGS, *_TEXTS)
_OWN = {"lag": "tau", "range": "limits"}  # names of Sensor, where they differ
_SI = {si for si, _, _ in UNITS.values()}
_SCALED = ("bias", "bias_mean", "drift", "quantum", "turn")


@dataclass(frozen=True)
class SensorFile:
    """What is measured how well, and how often.

    Args:
        gas_path, electrical: tables.
        complete: whether there are no others.
    """

    gas_path: SensorSet = field(default_factory=gas_path_table)
    electrical: SensorSet = ELECTRICAL
    complete: bool = False

    @property
    def rates(self) -> dict[str, float]:
        """Rates of the sensors that have one of their own, Hz."""
        both = (*self.gas_path.sensors, *self.electrical.sensors)
        return {s.name: s.rate for s in both if s.rate}


def read_sensors(path: str | Path | None) -> SensorFile:
    """Read a file of sensors; None gives the tables as they are.

    Raises:
        DataError: no such file, no TOML, an unknown sensor or key, a wrong value; it says where.
    """
    if path is None:
        return SensorFile()
    data = read_toml(path, "")
    complete = data.pop("complete", False)
    if not isinstance(complete, bool):
        raise DataError(f"{path}: complete must be true or false, got {complete!r:.40}")
    sets = {False: gas_path_table(), True: ELECTRICAL}
    for name, row in sorted(data.items(), key=lambda x: plain(x[0]) != x[0]):
        if not isinstance(row, dict):
            raise DataError(f"{path}: a table [{name}] is expected, got {row!r:.40}")
        try:
            new = _sensor(name, row, str(path), sets[True])
        except (DataError, ParameterError) as e:
            raise DataError(f"{path}, {e}") from None
        waves = plain(name) in ELECTRICAL
        table = sets[waves]
        there = (new if s.name == name else s for s in table.sensors)
        changed = tuple(there) if name in table else (*table.sensors, new)
        sets[waves] = SensorSet(changed)
    if complete:
        sets = {k: s.only([n for n in s.names if n in data]) for k, s in sets.items()}
    return SensorFile(sets[False], sets[True], complete)


def _sensor(name: str, row: Mapping[str, Any], source: str, waves: SensorSet) -> Sensor:
    """Return the sensor of an entry; ``waves``: the generators' so far."""
    for key in row:
        if key not in _ALL:
            raise DataError(f"{name}: unknown key {key!r} {nearest(key, _ALL)}")
    given = {k: _value(name, k, v) for k, v in row.items()}
    valid = (*KNOWN, *ELECTRICAL.names)
    quantity = given.pop("quantity", None)
    if quantity is None and plain(name) not in valid:
        hint = "a sensor of its own says its quantity"
        raise DataError(f"unknown sensor {name!r} {nearest(name, valid)}; {hint}")
    electrical = plain(name) in ELECTRICAL
    base = dataclasses.replace(waves[plain(name)], name=name) if electrical else KNOWN.get(name)
    if quantity is not None:
        base = _reading(name, quantity, base)
    assert base is not None
    changes = {"source": source} | _in_si(name, given, base)
    new = dataclasses.replace(base, **changes)
    return new if electrical or base is KNOWN.get(name) else known(new)


def _value(name: str, key: str, v: Any) -> Any:
    """Return a checked value of an entry."""
    if key in _TEXTS or key in _FLAGS:
        kind, what = (str, "a text") if key in _TEXTS else (bool, "true or false")
        if not isinstance(v, kind) or v == "":
            raise DataError(f"{name}: {key} must be {what}, got {v!r:.40}")
        return v
    number = isinstance(v, int | float) and not isinstance(v, bool)
    if key in _SPANS:
        pair = isinstance(v, list) and len(v) == 2
        if not pair or not all(isinstance(x, int | float) for x in v) or not v[0] < v[1]:
            raise DataError(f"{name}: {key} must be [LOW, HIGH], got {v!r:.40}")
        return float(v[0]), float(v[1])
    k = _BY_NAME[key]
    if k.choices:
        if v not in k.choices:
            raise DataError(f"{name}: {key} {v!r:.40} {nearest(str(v), k.choices)}")
        return v
    inside = number and k.lo <= v <= k.hi and not (k.open_lo and v <= k.lo)
    if not inside or (key == "factor" and not v):
        least = "not 0" if key == "factor" else f"{'>' if k.open_lo else '>='} {k.lo:g}"
        least += f" and <= {k.hi:g}" if k.hi < 1e12 else ""
        raise DataError(f"{name}: {key} must be a number {least}, got {v!r:.40}")
    return float(v)


def _reading(name: str, quantity: str, base: Sensor | None) -> Sensor:
    """Return a sensor of an output: the table's own of that output under another name."""
    outputs = GasGenerator.Y.names
    if plain(name) in ELECTRICAL or (base is not None and base.reads != (quantity,)):
        raise DataError(f"{name}: it reads {name} in all files: take another name for {quantity}")
    if base is not None and base.name in gas_path_table().names:
        return base
    if quantity not in outputs:
        raise DataError(f"{name}: unknown quantity {quantity!r} {nearest(quantity, outputs)}")
    like = KNOWN.get(quantity)
    if like is None or like.reads != (quantity,):
        unit = GasGenerator.Y[quantity].unit
        like = Sensor(quantity, 0.0, False, 0.0, unit, "", reads=(quantity,))
    return dataclasses.replace(like, name=name, reads=(quantity,))


def _in_si(name: str, given: dict[str, Any], base: Sensor) -> dict[str, Any]:
    """Return the values as :class:`Sensor` has them."""
    own = "unit" in given
    unit, factor = given.pop("unit", base.unit), given.pop("factor", None)
    if unit not in UNITS and unit not in _SI:
        raise DataError(f"{name}: unknown unit {unit!r} {nearest(unit, UNITS)}")
    si, scale, offset = UNITS.get(unit, (unit, 1.0, 0.0))
    if si != base.unit and factor is None:
        raise DataError(
            f"{name}: {unit} is no unit of {', '.join(base.reads)} ({base.unit}); where the "
            "reading is another quantity, give factor"
        )
    new: dict[str, Any] = {_OWN.get(k, k): v for k, v in given.items()}
    new |= {k: scale * v for k, v in new.items() if k in _SCALED}
    for k in ("limits", "plausible"):
        if k in new:
            new[k] = tuple(scale * v + offset for v in new[k])
    if "noise" in new:
        # with a unit it is in that unit, unless it says otherwise
        new.setdefault("relative", base.relative and not own)
        new["noise"] *= 1.0 if new["relative"] else scale
        if new["relative"] and new["noise"] > 1:
            raise DataError(f"{name}: noise of {new['noise']:g} times the reading: give its unit")
    elif new.get("relative", base.relative) != base.relative:
        raise DataError(f"{name}: relative without noise")
    if half := new.get("turn", base.turn) / 2:
        new.setdefault("plausible", (-half, half))
    if factor is not None:
        new |= {"factor": factor * scale, "unit": si}
        if si != base.unit:
            span = base.plausible and sorted(new["factor"] * v for v in base.plausible)
            new.setdefault("plausible", span and tuple(span))
            if "noise" not in new and not base.relative:
                raise DataError(f"{name}: its noise is needed, {si}")
    if "noise" not in given and not (base.noise or new.get("quantum", base.quantum)):
        raise DataError(f"{name}: its noise is needed")
    return new


# ------------------------------------------------------------------------------ for editors


def sensor_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 7) of a file of sensors."""
    texts = {"type": "string", "minLength": 1}
    pair = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}
    entry: dict[str, Any] = {k.name: _number(k) for k in KEYS}
    entry |= {k: pair | {"description": doc} for k, doc in _SPANS.items()}
    entry |= {k: {"type": "boolean", "description": doc} for k, doc in _FLAGS.items()}
    entry |= {k: texts | {"description": doc} for k, doc in _TEXTS.items()}
    entry["quantity"] = {"enum": [*GasGenerator.Y.names], "description": _TEXTS["quantity"]}
    entry["unit"] = {"enum": [*UNITS], "description": _TEXTS["unit"]}
    table = {"type": "object", "properties": entry, "additionalProperties": False}
    of = {"$ref": "#/definitions/sensor"}
    named: dict[str, Any] = dict.fromkeys((*KNOWN, *ELECTRICAL.names), of)
    doc = "leave out the sensors that have no entry"
    named["complete"] = {"type": "boolean", "description": doc}
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": "apu-casadi sensors"}
    own = {"allOf": [of, {"required": ["quantity"]}], "description": "a sensor of its own"}
    numbered = {f"^({'|'.join(ELECTRICAL.names)})_[{''.join(NUMBERS)}]$": of}
    made = {"type": "object", "properties": named, "additionalProperties": own}
    made["patternProperties"] = numbered
    return head | made | {"definitions": {"sensor": table}}


def _number(k: Key) -> dict[str, Any]:
    if k.choices:
        return {"enum": list(k.choices), "description": k.doc}
    words = f"{k.doc} [{k.unit}]" if k.unit not in ("", "1") else k.doc
    low = "exclusiveMinimum" if k.open_lo else "minimum"
    return {"type": "number", low: k.lo, "maximum": k.hi, "description": words}


def to_toml(sensors: SensorFile) -> str:
    """Return the file of a set, complete: a start for one's own."""
    return "\n".join(["complete = true", *_lines(sensors)]) + "\n"


def _lines(sensors: SensorFile) -> Iterator[str]:
    usual = {f.name: f.default for f in dataclasses.fields(Sensor)}
    names = {_OWN.get(n, n): n for n in (*_BY_NAME, "range", "fails", "clock")}
    for s in (*sensors.gas_path.sensors, *sensors.electrical.sensors):
        yield f"\n[{s.name}]".ljust(24) + f"# {s.unit}; {s.source}"
        own = s.name not in TABLED and plain(s.name) not in ELECTRICAL
        if s.reads != (s.name,) and s.value is None and own:
            yield f'quantity = "{s.reads[0]}"\nunit = "{s.unit}"'
        relative = str(s.relative).lower()
        yield f"noise = {s.noise!r}\nrelative = {relative}\ngain = {s.gain!r}"
        for n in (n for n in names if n not in ("noise", "gain")):
            v = getattr(s, n)
            if v != usual[n]:
                v = list(v) if isinstance(v, tuple) else v
                text = str(v).lower() if isinstance(v, bool) else repr(v).replace("'", '"')
                yield f"{names[n]} = {text}"
