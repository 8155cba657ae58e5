"""An engine as one file: design data and two maps with their calibration, in TOML.

::

    [gas_generator]              # design data, SI; what is left out is the paper's
    N = 5200.0
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

``trim = true`` and ``check = false`` in a map's table are those of
:func:`~apu_casadi.gaspath.maps.mapfiles.read_map`.  :func:`write_engine` writes all numbers with
their meaning and unit, and maps of the user beside the file.
"""

from __future__ import annotations

import dataclasses
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from apu_casadi.core import files
from apu_casadi.core.errors import ApuError, DataError, ParameterError, nearest
from apu_casadi.core.parameters import Parameters
from apu_casadi.gaspath.designdata import GasGeneratorParameters
from apu_casadi.gaspath.gas import DATA_SETS
from apu_casadi.gaspath.gasgenerator import GasGenerator, MapChoice
from apu_casadi.gaspath.maps.mapfiles import SHIPPED, read_map, shipped, write_map_csv
from apu_casadi.gaspath.maps.scaledmaps import MapCalibration
from apu_casadi.gaspath.unitnumbers import MAPS

_SOURCE = ("file", "shipped")
_PLACE = {"N_map_des": "N_ref", "beta_des": "beta_ref"}
_READING = ("trim", "check")
_KINDS = dict(zip(MAPS, ("compressor", "turbine"), strict=True))


def read_engine(path: str | Path) -> GasGenerator:
    """Read an engine from a TOML file as this module's text describes.

    Map files stand relative to the file.  The design point is solved and both maps are scaled to
    it, so that what cannot be an engine is told here.

    Raises:
        DataError: the file is missing or no TOML, or a map file cannot be read.
        ParameterError: an unknown or missing name, or a value that is no number in its range.
        MapError: a map file makes no map, or it cannot be scaled to the design point.
        OperatingPointError: the design data admit no solution.
    """
    path = Path(path)
    text = files.read_text(path, "engine file")
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as e:  # also a number of more digits than Python reads
        raise DataError(f"{path}: no TOML file: {e}") from None
    _known(f"{path}", data, ("gas_generator", *MAPS))
    for name, table in data.items():
        if not isinstance(table, dict):
            raise ParameterError(f"{path}: {name} must be a table, [{name}], got {table!r}")
    for name in MAPS:
        if name not in data:
            raise ParameterError(f"{path}: no table [{name}]; an engine needs its two maps")
    own = data.get("gas_generator", {})
    where = f"{path}, [gas_generator]"
    _known(where, own, _names(GasGeneratorParameters))
    if own.get("gas_data", DATA_SETS[0]) not in DATA_SETS:
        raise ParameterError(
            f"{where}: gas_data = {own['gas_data']!r} {nearest(str(own['gas_data']), DATA_SETS)}"
        )
    try:
        parameters = GasGeneratorParameters(**own)
    except ParameterError as e:
        raise ParameterError(f"{where}: {e}") from None
    compressor, turbine = (_read_choice(path, name, data[name]) for name in MAPS)
    gg = GasGenerator(parameters, compressor, turbine)
    try:
        _ = gg.maps
    except ApuError as e:
        raise type(e)(f"{path}: {e}") from None
    return gg


def _read_choice(path: Path, name: str, given: Mapping[str, Any]) -> MapChoice:
    where = f"{path}, [{name}]"
    calibration = _names(MapCalibration)
    _known(where, given, (*_SOURCE, *_PLACE, *_READING, *calibration))
    source = [k for k in _SOURCE if k in given]
    if len(source) != 1 or not isinstance(given[source[0]], str):
        raise ParameterError(f"{where}: give the map as file = '...' or shipped = '...', one text")
    how = {k: given[k] for k in _READING if k in given}
    for k, value in how.items():
        if not isinstance(value, bool):
            raise ParameterError(f"{where}: {k} must be true or false, got {value!r}")
    if source == ["file"]:
        table = read_map(path.parent / given["file"], **how)
    elif how:
        raise ParameterError(f"{where}: {next(iter(how))} goes with file, not with shipped")
    elif given["shipped"].lower() not in SHIPPED:
        near = nearest(given["shipped"], SHIPPED)
        raise ParameterError(f"{where}: shipped = {given['shipped']!r} {near}")
    else:
        table = shipped(given["shipped"])
    if table.kind != _KINDS[name]:
        raise ParameterError(f"{where}: {table.name!r} is the map of a {table.kind}")
    place = {k: given.get(k, getattr(table, ref)) for k, ref in _PLACE.items()}
    missing = [k for k, v in place.items() if v is None]
    if missing:
        raise ParameterError(
            f"{where}: give {' and '.join(missing)}: the map names no design point; its N goes "
            f"from {table.N[0]:g} to {table.N[-1]:g}, beta from {table.beta[0]:g} to "
            f"{table.beta[-1]:g}"
        )
    for k, axis in zip(_PLACE, (table.N, table.beta), strict=True):
        v = place[k]
        if isinstance(v, bool) or not isinstance(v, int | float) or not axis[0] <= v <= axis[-1]:
            raise ParameterError(
                f"{where}: {k} = {v!r} is no number within the table, {axis[0]:g} to {axis[-1]:g}"
            )
    try:
        numbers = MapCalibration(**{n: given[n] for n in calibration if n in given})
    except ParameterError as e:
        raise ParameterError(f"{where}: {e}") from None
    return MapChoice(table, float(place["N_map_des"]), float(place["beta_des"]), numbers)


def _names(cls: type[Parameters]) -> list[str]:
    return [f.name for f in dataclasses.fields(cls)]


def _known(where: str, given: Iterable[str], names: Iterable[str]) -> None:
    for n in given:
        if n not in tuple(names):
            raise ParameterError(f"{where}: unknown {n!r} {nearest(n, names)}")


def write_engine(gg: GasGenerator, path: str | Path) -> None:
    """Write an engine as :func:`read_engine` reads it, with its own maps in CSV files beside it.

    Raises:
        DataError: a file cannot be written.
    """
    path = Path(path)
    p = gg.parameters
    text = ["[gas_generator]", *_rows(p), f'gas_data = "{p.gas_data}"']
    for name, choice in zip(MAPS, (gg.compressor_map, gg.turbine_map), strict=True):
        table, text = choice.table, [*text, "", f"[{name}]"]
        known = next((n for n in SHIPPED if shipped(n) == table), None)
        if known is None:
            beside = path.with_name(f"{path.stem}-{_KINDS[name]}.csv")
            write_map_csv(table, beside)
            text.append(f'file = "{beside.name}"')
            text += [] if table.check else ["check = false"]
        else:
            text.append(f'shipped = "{known}"')
        text += [f"{n} = {float(getattr(choice, n))!r}" for n in _PLACE]
        text += _rows(choice.calibration)
    files.write_text(path, "\n".join(text) + "\n")


def _rows(p: Parameters) -> list[str]:
    return [f"{name} = {float(v)!r}  # {doc} [{unit}]" for name, v, unit, doc, _ in p.table()]
