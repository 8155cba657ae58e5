"""The gas generator of an engine's file: design data and two maps with their calibration, in TOML.

::

    [gas_generator]              # design data, SI or with a unit; what is left out is the paper's
    N = { value = 49600, unit = "r/min", source = "type certificate" }
    W2 = 1.2

    [compressor_map]
    file = "maps/radial.csv"     # beside this file; or shipped = "axi5"
    N_map_des = 1.0              # where the design point lies; by default where the map says
    beta_des = 2.0
    a_W = 0.04                   # calibration; identity where left out

    [turbine_map]
    shipped = "lpt2269"
    N_map_des = 100.0
    beta_des = 0.5

``trim`` and ``check = false`` in a map's table are those of
:func:`~apu_casadi.gaspath.maps.mapfiles.read_map`.  :func:`write_engine` writes all numbers with
their meaning, unit and source, and maps of the user beside the file.  The other tables of the file
are those of the whole unit, :mod:`apu_casadi.unit.enginefile`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from apu_casadi.core import files
from apu_casadi.core.errors import ApuError, ParameterError, nearest
from apu_casadi.core.parameters import Parameters
from apu_casadi.core.tomlnumbers import (
    Numbers,
    known,
    read_numbers,
    read_toml,
    rows,
    table,
    text,
    units_of,
)
from apu_casadi.gaspath.gas import DATA_SETS
from apu_casadi.gaspath.gasgenerator import GasGenerator, MapChoice
from apu_casadi.gaspath.maps.mapfiles import SHIPPED, read_map, shipped, write_map_csv
from apu_casadi.gaspath.maps.scaledmaps import MapCalibration
from apu_casadi.gaspath.unitnumbers import MAPS

TABLES = ("gas_generator", *MAPS)
HEAD = ("name", "title", "doc")
"""Texts at the top of the file."""
OTHERS = ("generator", "governor", "coupling", "limits")
"""Tables of the whole unit."""

P = TypeVar("P", bound=Parameters)
_SOURCE = ("file", "shipped")
_PLACE = {"N_map_des": "N_ref", "beta_des": "beta_ref"}
_READING = ("trim", "check")
_KINDS = dict(zip(MAPS, ("compressor", "turbine"), strict=True))


def read_engine(path: str | Path) -> GasGenerator:
    """Read the gas generator of a TOML file as this module's text describes.

    Map files stand relative to the file.  The design point is solved and both maps are scaled to
    it, so that what cannot be an engine is told here.

    Raises:
        DataError: the file is missing or no TOML, or a map file cannot be read.
        ParameterError: an unknown or missing name, or a value that is no number in its range.
        MapError: a map file makes no map, or it cannot be scaled to the design point.
        OperatingPointError: the design data admit no solution.
    """
    data = read_tables(path)
    for name in MAPS:
        if name not in data:
            raise ParameterError(f"{path}: no table [{name}]; an engine needs its two maps")
    return gas_generator_of(Path(path), data)[0]


def read_tables(path: str | Path) -> dict[str, Any]:
    """Return the tables of an engine's file; their names are checked.

    Raises:
        DataError, ParameterError: as :func:`read_engine`.
    """
    data = read_toml(path, "engine file")
    if not data:
        tables = ", ".join((*TABLES, *OTHERS))
        raise ParameterError(f"{path}: empty: an engine has at least one of the tables {tables}")
    known(f"{path}", data, (*TABLES, *OTHERS, *HEAD))
    return data


def gas_generator_of(path: Path, data: Mapping[str, Any]) -> tuple[GasGenerator, Numbers]:
    """Return the gas generator that the tables describe, and what they give by dotted name.

    A map whose table is absent is the default unit's, with its calibration.

    Raises:
        as :func:`read_engine`.
    """
    default, given = GasGenerator(), Numbers()
    own = table(f"{path}", data, "gas_generator")
    where, words = f"{path}, [gas_generator]", {"gas_data": DATA_SETS}
    parameters = read_set(where, own, default.parameters, given, "gas_generator", texts=words)
    choices = []
    for name in MAPS:
        if name in data:
            choices.append(_read_choice(path, name, table(f"{path}", data, name), given))
        else:
            choices.append(getattr(default, name))
    gg = GasGenerator(parameters, choices[0], choices[1])
    try:
        _ = gg.maps
    except ApuError as e:
        raise type(e)(f"{path}: {e}") from None
    return gg, given


def read_set(
    where: str,
    own: Mapping[str, Any],
    default: P,
    given: Numbers,
    prefix: str,
    *,
    texts: Mapping[str, Sequence[str]] | None = None,
    others: Sequence[str] = (),
) -> P:
    """Return a parameter set with the values of a table, other values as in ``default``.

    Args:
        where: file and table, for messages.
        own: the table.
        default: where left-out values come from.
        given: what the file gives is added here by dotted name, with its source.
        prefix: what stands before the dot.
        texts: fields that are words, with those that they may be.
        others: keys of the table that are none of the set's.

    Raises:
        ParameterError: an unknown name, or a value that is no number in its range.
    """
    texts = texts or {}
    units = units_of(default)
    known(where, own, (*units, *texts, *others))
    numbers = read_numbers(where, own, units)
    for name, words in texts.items():
        if name in own and own[name] not in words:
            hint = nearest(str(own[name]), words)
            raise ParameterError(f"{where}: {name} = {own[name]!r} {hint}")
    values = numbers.values | {n: own[n] for n in texts if n in own}
    given.values |= {f"{prefix}.{n}": v for n, v in values.items()}
    given.sources |= {f"{prefix}.{n}": v for n, v in numbers.sources.items()}
    try:
        return dataclasses.replace(default, **values)
    except ParameterError as e:
        raise ParameterError(f"{where}: {e}") from None


def _read_choice(path: Path, name: str, own: Mapping[str, Any], given: Numbers) -> MapChoice:
    where, calibration = f"{path}, [{name}]", units_of(MapCalibration())
    known(where, own, (*_SOURCE, *_PLACE, *_READING, *calibration))
    found = _table_of(where, path, name, own)
    numbers = read_numbers(where, own, dict.fromkeys(_PLACE, "1"))
    place = {k: numbers.values.get(k, getattr(found, ref)) for k, ref in _PLACE.items()}
    missing = [k for k, v in place.items() if v is None]
    if missing:
        raise ParameterError(
            f"{where}: give {' and '.join(missing)}: the map names no design point; its N goes "
            f"from {found.N[0]:g} to {found.N[-1]:g}, beta from {found.beta[0]:g} to "
            f"{found.beta[-1]:g}"
        )
    for k, axis in zip(_PLACE, (found.N, found.beta), strict=True):
        v = place[k]
        if isinstance(v, bool) or not isinstance(v, int | float) or not axis[0] <= v <= axis[-1]:
            raise ParameterError(
                f"{where}: {k} = {v!r} is no number within the table, {axis[0]:g} to {axis[-1]:g}"
            )
    given.sources |= {f"{name}.{n}": s for n, s in numbers.sources.items()}
    given.values |= {f"{name}.{k}": place[k] for k in _PLACE}
    others = (*_SOURCE, *_PLACE, *_READING)
    numbers_ = read_set(where, own, MapCalibration(), given, name, others=others)
    return MapChoice(found, float(place["N_map_des"]), float(place["beta_des"]), numbers_)


def _table_of(where: str, path: Path, name: str, own: Mapping[str, Any]) -> Any:
    """Return the map that a table names."""
    source = [k for k in _SOURCE if k in own]
    if len(source) != 1 or not isinstance(own[source[0]], str):
        raise ParameterError(f"{where}: give the map as file = '...' or shipped = '...', one text")
    how = {k: own[k] for k in _READING if k in own}
    for k, value in how.items():
        if not isinstance(value, bool):
            raise ParameterError(f"{where}: {k} must be true or false, got {value!r}")
    if source == ["file"]:
        found = read_map(path.parent / own["file"], **how)
    elif how:
        raise ParameterError(f"{where}: {next(iter(how))} goes with file, not with shipped")
    elif own["shipped"].lower() not in SHIPPED:
        near = nearest(own["shipped"], SHIPPED)
        raise ParameterError(f"{where}: shipped = {own['shipped']!r} {near}")
    else:
        found = shipped(own["shipped"])
    if found.kind != _KINDS[name]:
        raise ParameterError(f"{where}: {found.name!r} is the map of a {found.kind}")
    return found


def write_engine(gg: GasGenerator, path: str | Path) -> None:
    """Write an engine as :func:`read_engine` reads it, with its own maps in CSV files beside it.

    Raises:
        DataError: a file cannot be written.
    """
    files.write_text(path, "\n".join(gas_lines(gg, Path(path), {})) + "\n")


def gas_lines(gg: GasGenerator, path: Path, sources: Mapping[str, str]) -> list[str]:
    """Return the lines of a file for the gas generator, and write its own maps beside the file.

    Args:
        gg: the gas generator.
        path: the file.
        sources: of its numbers by dotted name; without one, a default number has its own.
    """
    p = gg.parameters
    lines = ["[gas_generator]", *set_lines(p, "gas_generator", sources)]
    lines.append(f"gas_data = {text(p.gas_data)}")
    for name, choice in zip(MAPS, (gg.compressor_map, gg.turbine_map), strict=True):
        found, lines = choice.table, [*lines, "", f"[{name}]"]
        own = next((n for n in SHIPPED if shipped(n) == found), None)
        if own is None:
            beside = path.with_name(f"{path.stem}-{_KINDS[name]}.csv")
            write_map_csv(found, beside)
            lines.append(f"file = {text(beside.name)}")
            lines += [] if found.check else ["check = false"]
        else:
            lines.append(f"shipped = {text(own)}")
        doc = "of the table at the design point"
        place = [(n, getattr(choice, n), "1", doc, sources.get(f"{name}.{n}", "")) for n in _PLACE]
        lines += [*rows(place), *set_lines(choice.calibration, name, sources)]
    return lines


def set_lines(p: Parameters, prefix: str, sources: Mapping[str, str]) -> list[str]:
    """Return the lines of a parameter set; a default number has its class's source by default."""
    default = {name: (value, source) for name, value, _, _, source in type(p)().table()}
    told = []
    for name, value, unit, doc, _ in p.table():
        known_value, source = default[name]
        source = sources.get(f"{prefix}.{name}", source if value == known_value else "")
        told.append((name, value, unit, doc, source))
    return rows(told)
