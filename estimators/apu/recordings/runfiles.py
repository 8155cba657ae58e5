"""What a run file tells of itself besides its columns: ambient conditions, and the unit.

A netCDF file that ``apu run`` or :func:`apu_casadi.core.results.save` wrote carries them in its
attributes; a fit takes them from there rather than from the default day.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from apu_casadi.core.errors import DataError
from apu_casadi.gaspath.conditions import CONDITIONS

__all__ = ["recorded_ambient", "recorded_engine"]


def recorded_ambient(path: str | Path) -> dict[str, float]:
    """Return the ambient conditions in the attributes of a netCDF 3 file; {} where it has none.

    ``ambient`` of a run, or the ``ambient`` table of its ``scenario`` (files of older versions).

    Raises:
        DataError: the attribute is there and is no table of numbers within the model's ranges.
    """
    attrs = _attributes(Path(path))
    for name, inner in (("ambient", None), ("scenario", "ambient")):
        if name not in attrs:
            continue
        try:
            found = json.loads(attrs[name])
            found = found if inner is None else found[inner]
        except (TypeError, ValueError, KeyError):
            continue
        return _checked(str(path), name, found)
    return {}


def recorded_engine(path: str | Path) -> str | None:
    """Return the unit that a run file names in its scenario; None where it names none."""
    try:
        found = json.loads(_attributes(Path(path))["scenario"]).get("engine")
    except (TypeError, ValueError, KeyError, AttributeError):
        return None
    return found if isinstance(found, str) else None


def _checked(source: str, attribute: str, found: Any) -> dict[str, float]:
    if not isinstance(found, Mapping):
        raise DataError(f"{source}, attribute {attribute!r}: a table is expected, got {found!r}")
    out = {}
    for name, c in CONDITIONS.items():
        value = found.get(name)
        if value is None:
            continue
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and c.lo <= value <= c.hi):
            raise DataError(
                f"{source}, attribute {attribute!r}: {name} = {value!r} is no number in "
                f"[{c.lo:g}, {c.hi:g}] {c.unit}"
            )
        out[name] = float(value)
    return out


def _attributes(path: Path) -> dict[str, str]:
    """Texts among the global attributes of a netCDF 3 file; nothing else of it is read."""
    from scipy.io import netcdf_file

    try:
        with path.open("rb") as f:
            if f.read(3) != b"CDF":
                return {}
        with netcdf_file(path, mmap=True) as f:
            raw = dict(f._attributes)
    except (OSError, ValueError, TypeError, IndexError, KeyError):  # damaged: the reader tells
        return {}
    return {k: v.decode("utf-8", "replace") for k, v in raw.items() if isinstance(v, bytes)}
