"""A unit as one file: engine, maps, generators, exciters, governor, gear, limits, with sources.

::

    name = "my_unit"
    title = "What it is"

    [gas_generator]              # and the maps: see apu_casadi.gaspath.engines
    W2 = { value = 3.49, source = "data sheet" }

    [generator]                  # all of them alike, 1 to 4; or one table [[generator]] for each
    count = 2
    neutral = "isolated"         # also excitation, and power = "torque"
    [generator.machine]          # apu_casadi.machine.machinedata; with S_10 or S_12 it saturates
    r_s = { value = 5.1, unit = "mohm", source = "measured" }
    [generator.exciter]
    K_A = 200.0

    [governor]                   # kind = "PI" or another one of GOVERNORS
    Kp = 0.3
    Wf_max = { value = 240, unit = "kg/h", source = "data sheet" }

    [coupling]                   # the gear; of one generator, [generator.coupling]
    gear = 3.4775

    [limits]                     # beyond which a steady point is refused
    T4_max = 1400.0

A number is given alone, in SI units, or with its unit and source.  What is left out is the default
unit's; :attr:`Engine.assumed` lists it.  Units that come with the package are asked for by name.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from apu_casadi.core import files
from apu_casadi.core.errors import ApuError, ApuWarning, ParameterError, nearest
from apu_casadi.core.tomlnumbers import Numbers, known, read_numbers, rows, table, text
from apu_casadi.gaspath.engines import (
    HEAD,
    TABLES,
    gas_generator_of,
    gas_lines,
    read_set,
    read_tables,
    set_lines,
)
from apu_casadi.gaspath.steady.steadypoint import LIMIT_UNITS, Limits
from apu_casadi.gaspath.unitnumbers import MAPS
from apu_casadi.machine.generator import CHOICES, Generator
from apu_casadi.machine.machinedata import MachineParameters, SaturatedMachine, magnetics
from apu_casadi.unit.apu import Apu, OnShaft
from apu_casadi.unit.control import GOVERNORS, Governor, word_of
from apu_casadi.unit.events import MOST
from apu_casadi.unit.shippedunits import unit_path
from apu_casadi.unit.usual import unusual

_INNER = ("machine", "exciter", "coupling")
SATURATION = ("S_10", "S_12")
"""Of a machine that saturates; S_10 = 0 is one that does not, after one that does."""
GAS = (*TABLES, "limits")
"""Parts of a unit that a gas generator alone is made of."""


class Assumed(NamedTuple):
    """A number that a file does not give: dotted name, value, unit, and where it is from."""

    name: str
    value: float | str
    unit: str
    source: str


@dataclass(frozen=True)
class Engine:
    """A unit from a file.

    Args:
        name, title, doc: what it is.
        unit: the unit.
        limits: of steady points.
        sources: where the numbers are from that the file gives, by dotted name.
        assumed: what the file does not give; it is the default unit's.
    """

    name: str = ""
    title: str = ""
    doc: str = ""
    unit: Apu = field(default_factory=Apu)
    limits: Limits = field(default_factory=Limits)
    sources: Mapping[str, str] = field(default_factory=dict, hash=False)
    assumed: tuple[Assumed, ...] = ()

    def assumed_for(self, parts: Iterable[str] | None = None) -> list[Assumed]:
        """Return what is assumed of some parts, such as ``GAS``; of all by default."""
        wanted = None if parts is None else set(parts)
        return [a for a in self.assumed if wanted is None or a.name.split(".")[0] in wanted]


# ------------------------------------------------------------------------------ reading


def read_unit(name_or_path: str | Path) -> Engine:
    """Read a unit from a TOML file, or one that comes with the package by its name.

    Raises:
        DataError: no such file or name, no TOML, or a map file cannot be read.
        ParameterError: an unknown or missing name or unit, or a value that is no number in its
            range; with file, table and the nearest name.
        MapError, OperatingPointError: as :func:`~apu_casadi.gaspath.engines.read_engine`.
    """
    path = unit_path(name_or_path)
    return _read(path, read_tables(path))


def _read(path: Path, data: Mapping[str, Any]) -> Engine:
    default = Apu()
    for k in HEAD:
        if not isinstance(data.get(k, ""), str):
            raise ParameterError(f"{path}: {k} must be a text, got {data[k]!r}")
    gg, given = gas_generator_of(path, data)
    where = f"{path}, [coupling]"
    gear = read_set(where, table(f"{path}", data, "coupling"), default.coupling, given, "coupling")
    first, *others = _machines(path, data, gear, given)
    governor = _governor(path, data, given)
    limits = _limits(path, data, given)
    unit = Apu(gg, first.generator, governor, first.coupling, tuple(others))
    head = {k: data.get(k, "") for k in HEAD}
    head["name"] = head["name"] or path.stem
    for name, words in unusual(unit, given.values, limits):
        part = name.rpartition(".")[0]
        warnings.warn(ApuWarning(f"{path}, [{part}]: {words}"), stacklevel=4)
    assumed = tuple(_assumed(unit, limits, given, data))
    return Engine(**head, unit=unit, limits=limits, sources=given.sources, assumed=assumed)


def _machines(path: Path, data: Mapping[str, Any], gear: Any, given: Numbers) -> list[OnShaft]:
    """Return the generators with their gears; what a further table leaves out is the first's."""
    tables = data.get("generator", {})
    several = tables if isinstance(tables, list) else [tables]
    made: list[OnShaft] = []
    for i, own in enumerate(several, 1):
        where = f"{path}, [generator]" if own is tables else f"{path}, [[generator]] {i}"
        if not isinstance(own, dict):
            raise ParameterError(f"{where}: a table is expected, got {own!r}")
        known(where, own, (*_INNER, *CHOICES, "count"))
        first = made[0] if made else OnShaft(Generator(), gear)
        if "count" in own or own is not tables:
            given.values["generator.count"] = True
        count = own.get("count", len(Apu().machines) if own is tables else 1)
        if type(count) is not int or not 1 <= count <= MOST - len(made):
            raise ParameterError(f"{where}: count = {count!r}; a unit has 1 to {MOST} generators")
        made += [_machine(where, own, first, given, len(made) + 1)] * count
    if not made:
        raise ParameterError(f"{path}: no [[generator]]; a unit has 1 to {MOST}")
    return made


def _machine(
    where: str, own: Mapping[str, Any], first: OnShaft, given: Numbers, number: int
) -> OnShaft:
    prefix = "" if number == 1 else f"generator{number}."
    tables = {name: table(where, own, name) for name in _INNER}
    tables["machine"], base = _magnetics(tables["machine"], first.generator.machine, given, prefix)
    parts: dict[str, Any] = {}
    for name, p in zip(_INNER, (base, first.generator.exciter, first.coupling), strict=True):
        place = where.replace("generator]", f"generator.{name}]")
        parts[name] = read_set(place, tables[name], p, given, f"{prefix}{name}")
    words: dict[str, Any] = {}
    for name, choices in CHOICES.items():
        words[name] = value = own.get(name, getattr(first.generator, name))
        if value not in choices:
            raise ParameterError(f"{where}: {name} = {value!r} {nearest(str(value), choices)}")
        if name in own:
            given.values[f"{prefix or 'generator.'}{name}"] = value
    return OnShaft(Generator(parts["machine"], parts["exciter"], **words), parts["coupling"])


def _magnetics(
    own: dict[str, Any], p: MachineParameters, given: Numbers, prefix: str
) -> tuple[dict[str, Any], MachineParameters]:
    """Return the table of a machine and what it leaves out, with saturation if it tells of it."""
    S_10 = own.get("S_10")
    value = S_10.get("value") if isinstance(S_10, dict) else S_10
    if type(value) in (int, float) and value == 0:
        given.values[f"{prefix}machine.S_10"] = 0.0
        return {n: v for n, v in own.items() if n not in SATURATION}, magnetics(p, 0.0, None)
    if own.keys() & set(SATURATION) and not isinstance(p, SaturatedMachine):
        return own, magnetics(p, SaturatedMachine().S_10, None)
    return own, p


def _governor(path: Path, data: Mapping[str, Any], given: Numbers) -> Governor:
    where, own = f"{path}, [governor]", table(f"{path}", data, "governor")
    kind = own.get("kind", word_of(Apu().governor))
    if kind not in GOVERNORS:
        raise ParameterError(f"{where}: unknown kind {kind!r} {nearest(str(kind), GOVERNORS)}")
    if "kind" in own:
        given.values["governor.kind"] = kind
    return read_set(where, own, GOVERNORS[kind](), given, "governor", others=("kind",))


def _limits(path: Path, data: Mapping[str, Any], given: Numbers) -> Limits:
    where, own = f"{path}, [limits]", table(f"{path}", data, "limits")
    known(where, own, LIMIT_UNITS)
    numbers = read_numbers(where, own, LIMIT_UNITS)
    given.values |= {f"limits.{n}": v for n, v in numbers.values.items()}
    given.sources |= {f"limits.{n}": s for n, s in numbers.sources.items()}
    try:
        return Limits(**numbers.values)
    except ApuError as e:
        raise ParameterError(f"{where}: {e}") from None


def _assumed(
    unit: Apu, limits: Limits, given: Numbers, data: Mapping[str, Any]
) -> Iterable[Assumed]:
    """Yield what the file does not give, in the order of the unit's parts."""
    for part, p in unit.parameter_sets().items():
        if part in MAPS:
            if part in data:
                left = [n for n, *_ in p.table() if f"{part}.{n}" not in given.values]
                if len(left) == len(p.table()):
                    yield Assumed(f"{part}.calibration", "none", "1", "the map as it is scaled")
                continue
            choice = getattr(unit.gas_generator, part)
            at = f"{choice.table.name} at N = {choice.N_map_des:g}, beta = {choice.beta_des:g}"
            yield Assumed(f"{part}.map", at, "1", "default unit")
        for name, value, si, _, source in p.table():
            if f"{part}.{name}" not in given.values:
                yield Assumed(f"{part}.{name}", value, si, f"default unit: {source}")
        if part == "gas_generator" and "gas_generator.gas_data" not in given.values:
            data_set = unit.gas_generator.parameters.gas_data
            yield Assumed("gas_generator.gas_data", data_set, "1", "default unit")
    words: dict[str, str | float] = {
        **{f"generator.{n}": getattr(unit.generator, n) for n in CHOICES},
        "generator.count": len(unit.machines),
        "governor.kind": word_of(unit.governor),
    }
    for name, word in words.items():
        if name not in given.values:
            yield Assumed(name, word, "1", "default unit")
    for f in dataclasses.fields(limits):
        value = getattr(limits, f.name)
        if f"limits.{f.name}" not in given.values and value is not None and math.isfinite(value):
            yield Assumed(f"limits.{f.name}", value, LIMIT_UNITS[f.name], "default limit")


def files_of(path: Path) -> list[Path]:
    """Return the file of a unit and the map files that it names, as far as it can be read."""
    try:
        data = read_tables(path)
    except ApuError:
        return [path]
    maps = [data[m].get("file") for m in MAPS if isinstance(data.get(m), dict)]
    return [path, *(path.parent / f for f in maps if isinstance(f, str))]


# ------------------------------------------------------------------------------ writing


def write_unit(engine: Engine | Apu, path: str | Path) -> None:
    """Write a unit as :func:`read_unit` reads it, with its own maps in CSV files beside it.

    Every number stands there with meaning, unit and source: the file's own, or, for a number of
    the default unit, that of the default unit.

    Raises:
        DataError: a file cannot be written.
    """
    path = Path(path)
    e = Engine(unit=engine) if isinstance(engine, Apu) else engine
    lines = [f"{k} = {text(getattr(e, k))}" for k in HEAD if getattr(e, k)]
    lines += ["", *gas_lines(e.unit.gas_generator, path, e.sources)]
    lines += _machine_lines(e)
    lines += ["", "[governor]", f"kind = {text(word_of(e.unit.governor))}"]
    lines += set_lines(e.unit.governor, "governor", e.sources)
    lines += ["", "[limits]"]
    for f in dataclasses.fields(e.limits):
        value, source = getattr(e.limits, f.name), e.sources.get(f"limits.{f.name}", "")
        if value is not None:
            told = (f.name, value, LIMIT_UNITS[f.name], "limit of a steady point", source)
            lines += rows([told])
    files.write_text(path, "\n".join(lines).lstrip("\n") + "\n")


def _machine_lines(e: Engine) -> list[str]:
    """Return the lines of the generators: one table for equal ones, else one for each."""
    machines, lines = e.unit.machines, []
    head = ["[generator]", f"count = {len(machines)}"] if e.unit.alike else ["[[generator]]"]
    saturates = isinstance(machines[0].generator.machine, SaturatedMachine)
    for k, (gen, gear) in enumerate(machines[:1] if e.unit.alike else machines, 1):
        prefix = "" if k == 1 else f"generator{k}."
        lines += ["", *head, *(f"{n} = {text(getattr(gen, n))}" for n in CHOICES)]
        for name, p in zip(_INNER, (gen.machine, gen.exciter, gear), strict=True):
            lines += [f"[generator.{name}]", *set_lines(p, f"{prefix}{name}", e.sources)]
            if name == "machine" and saturates and not isinstance(p, SaturatedMachine):
                lines.append("S_10 = 0.0")
    return lines
