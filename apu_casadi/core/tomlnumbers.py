"""Numbers in TOML files: alone, in SI units, or with their unit and source.

::

    W2 = 3.49
    N = { value = 41730, unit = "r/min", source = "type certificate" }
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from apu_casadi.core import files
from apu_casadi.core.errors import DataError, ParameterError, nearest
from apu_casadi.core.parameters import Parameters
from apu_casadi.core.units import ALL_UNITS, convert

_KEYS = ("value", "unit", "source")
DIFFERENCES = ("dT_isa",)
"""Temperatures that are differences: in another unit they have no offset."""


def read_toml(path: str | Path, what: str) -> dict[str, Any]:
    """Return the tables of a TOML file.

    Raises:
        DataError: the file is missing or no TOML, with line and column.
    """
    text = files.read_text(path, what)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as e:  # also a number of more digits than Python reads
        raise DataError(f"{path}: no TOML file: {e}") from None


def known(where: str, given: Iterable[str], names: Iterable[str]) -> None:
    """Raise ParameterError for the first name that is not among ``names``; the nearest is named."""
    for n in given:
        if n not in tuple(names):
            raise ParameterError(f"{where}: unknown {n!r} {nearest(n, names)}")


def table(where: str, data: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return a table of a file, {} if it is absent; ParameterError if it is something else."""
    found = data.get(name, {})
    if not isinstance(found, dict):
        raise ParameterError(f"{where}: {name} must be a table, [{name}], got {found!r}")
    return found


@dataclass
class Numbers:
    """Values in SI, and the sources that the file gives, by name."""

    values: dict[str, Any] = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)


def read_numbers(where: str, given: Mapping[str, Any], units: Mapping[str, str]) -> Numbers:
    """Read the numbers among the entries of a table; others are left to the caller.

    Args:
        where: file and table, for messages.
        given: the table.
        units: SI unit of each number by name.

    Raises:
        ParameterError: an unknown or wrong unit, an unknown key, a source that is no text.
    """
    found = Numbers()
    for name, entry in given.items():
        if name not in units:
            continue
        if isinstance(entry, Mapping):
            found.values[name] = _value(f"{where}: {name}", name, entry, units[name])
            if "source" in entry:
                found.sources[name] = entry["source"]
        else:
            found.values[name] = entry
    return found


def _value(where: str, name: str, entry: Mapping[str, Any], si: str) -> Any:
    known(where, entry, _KEYS)
    if "value" not in entry:
        raise ParameterError(f"{where}: give value = ..., besides unit and source")
    for k in _KEYS[1:]:
        if k in entry and not isinstance(entry[k], str):
            raise ParameterError(f"{where}: {k} must be a text, got {entry[k]!r}")
    value, unit = entry["value"], entry.get("unit", si)
    if unit == si or isinstance(value, bool) or not isinstance(value, int | float):
        return value
    try:
        how: dict[str, Any] = {"difference": name in DIFFERENCES, "known": ALL_UNITS}
        return float(convert(np.array(float(value)), unit, si, f"{where}.unit", **how))
    except DataError as e:
        raise ParameterError(str(e)) from None


def units_of(p: Parameters) -> dict[str, str]:
    """Return the SI unit of each number of a parameter set."""
    return {name: unit for name, _, unit, _, _ in p.table()}


def rows(numbers: Iterable[tuple[str, Any, str, str, str]]) -> list[str]:
    """Return lines of TOML for rows (name, value, unit, meaning, source)."""
    return [_row(*r) for r in numbers]


def _row(name: str, value: Any, unit: str, doc: str, source: str) -> str:
    value = value if type(value) is int else float(value)
    unit_ = f", unit = {text(unit)}" if unit != "1" else ""
    entry = f"{{ value = {value!r}{unit_}, source = {text(source)} }}" if source else repr(value)
    return f"{name} = {entry}  # {doc} [{unit}]"


def text(value: str) -> str:
    """Return a TOML string on one line."""
    return json.dumps(value, ensure_ascii=False)
