"""The estimation studies, one file each; ``registration`` tells what a file has."""

from __future__ import annotations

from pkgutil import iter_modules

__all__ = ["files", "names"]


def files() -> list[str]:
    """Return the names of the files of this folder, nothing imported."""
    return [m.name for m in iter_modules(__path__)]


def names() -> tuple[str, ...]:
    """Return the names of the studies, by the alphabet, nothing imported."""
    return tuple(n.replace("_", "-") for n in files())
