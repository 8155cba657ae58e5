"""The unit that a scenario or a command is about: an engine's file, a governor, parameters."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apu_casadi.core.errors import ApuError
from apu_casadi.core.sharing import last
from scenarios.extensions import digest
from scenarios.reading import STEADY, PlacedError

if TYPE_CHECKING:
    from apu_casadi.unit.apu import Apu
    from apu_casadi.unit.enginefile import Engine

_DESIGN = ("gas_generator", "compressor_map", "turbine_map")
"""Parts whose numbers move the design point."""


def engine_file(name: str | os.PathLike[str] | None) -> Engine:
    """Return the unit of a file, or of the package by its name; None is the default one.

    Raises:
        DataError: the file cannot be read; ParameterError, MapError : what it says cannot be.
    """
    if name is None:
        return _engine_file(None)
    return _engine_file(str(name), engine_digest(name))


@last(4)
def _engine_file(name: str | None, content: str = "") -> Engine:
    from apu_casadi.unit.enginefile import Engine, read_unit

    return Engine() if name is None else read_unit(name)


def engine_digest(name: str | os.PathLike[str]) -> str:
    """Return a digest of an engine's file and of the map files that it names.

    Raises:
        ScenarioError: one of them cannot be read; DataError : no unit of this name.
    """
    from apu_casadi.unit.enginefile import files_of
    from apu_casadi.unit.shippedunits import unit_path

    return "".join(digest(p, "engine file") for p in files_of(unit_path(Path(name))))


@last(4)
def unit_of(parameters: str = "{}", engine: str | None = None, content: str = "") -> Apu:
    """Return the unit with some parameters changed, and another engine if one is given.

    The last few are kept, since building takes longer.

    Args:
        parameters: values by dotted name, a JSON table.
        engine: file of the unit, or the name of a shipped one.
        content: its digest, so that a file that has changed is read again.

    Raises:
        ParameterError: an unknown name or a value out of range.
    """
    return engine_file(engine).unit.change(json.loads(parameters))


def of_scenario(engine: str | None, governor: str | None, parameters: Mapping[str, Any]) -> Apu:
    """Return the unit of a scenario's keys; errors as :func:`unit_of`."""
    law = {} if governor is None else {"governor.kind": governor}
    text = json.dumps({**parameters, **law}, sort_keys=True)
    return unit_of(text, *([engine, engine_digest(engine)] if engine else []))


def checked(engine: str | None, governor: str | None, parameters: Mapping[str, Any]) -> Apu:
    """Return the unit of a scenario's keys; a wrong one is told with its place.

    What moves the design point is solved with it.

    Raises:
        ScenarioError: the engine cannot be read, or a parameter is unknown or out of its range.
    """
    try:
        base = engine_file(engine).unit
    except ApuError as error:
        raise PlacedError("engine", str(error)) from None
    try:
        unit = of_scenario(engine, governor, parameters)
        if any(name.startswith(_DESIGN) for name in parameters):
            _ = unit.gas_generator.maps
    except ApuError as error:
        law = {} if governor is None else {"governor.kind": governor}
        raise _placed(error, base, {**law, **parameters}) from None
    return unit


def _placed(error: ApuError, base: Apu, parameters: Mapping[str, Any]) -> PlacedError:
    """Return the error with the place of the first parameter that alone is wrong, if one is."""
    shape = {n: v for n, v in parameters.items() if n in ("generator.count", "governor.kind")}
    for name, value in [*shape.items(), *parameters.items()]:
        try:
            base.change({**({} if name in shape else shape), name: value})
        except ApuError as own:
            whole = next((n for n in base.parameters() if name.startswith(f"{n}.")), None)
            if whole is not None:
                keys = [n.removeprefix(f"{whole}.") for n in parameters if n.startswith(whole)]
                return PlacedError(f"parameters.{whole}", STEADY.format(", ".join(keys)))
            return PlacedError(f"parameters.{name}", str(own).removeprefix(f"{name!r}: "))
    return PlacedError("parameters", str(error))
