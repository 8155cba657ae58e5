"""Units that come with the package: their files, found by name."""

from __future__ import annotations

import tomllib
from importlib import resources
from pathlib import Path

from apu_casadi.core.errors import DataError, nearest
from apu_casadi.core.sharing import once

DEFAULT = "aps5000"
"""Name of the default unit."""


@once
def shipped_units() -> dict[str, Path]:
    """Return the files of the units that come with the package, by name, the default one first."""
    folder = Path(str(resources.files("apu_casadi.unit") / "data"))
    found = {p.stem: p for p in folder.glob("*.toml")}
    return {n: found[n] for n in sorted(found, key=lambda n: (n != DEFAULT, n))}


def titles() -> dict[str, str]:
    """Return the titles of the units that come with the package, by name."""
    files = shipped_units().items()
    return {n: str(tomllib.loads(p.read_text(encoding="utf-8"))["title"]) for n, p in files}


def is_name(text: str | Path) -> bool:
    """Whether this is the name of a unit: a word without folder or ending that is no file here."""
    path = Path(text)
    return path.name == str(text) and not path.suffix and not path.exists()


def unit_path(name_or_path: str | Path) -> Path:
    """Return the file of a unit that is given as a file or by the name of a shipped one.

    Raises:
        DataError: an unknown name; the nearest is named.
    """
    if not is_name(name_or_path):
        return Path(name_or_path)
    name, known = str(name_or_path), shipped_units()
    if name not in known:
        raise DataError(
            f"engine {name!r}: no such file, and no unit of this name {nearest(name, known)}"
        )
    return known[name]
