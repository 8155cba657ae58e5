"""Functions that are registered once, by a decorator, and found by walking their package."""

from __future__ import annotations

from importlib import import_module
from pkgutil import walk_packages
from typing import Generic, TypeVar

from apu_casadi.core.errors import ScenarioError

__all__ = ["Registry"]

T = TypeVar("T")


class Registry(Generic[T]):
    """What the modules of a package have registered, by name and in order.

    Args:
        package: dotted name; all its modules are imported when the names are asked for.
        what: one of them, in words, for messages.
        scripts: modules that are no part of the package, but run by others.
    """

    package: str
    what: str
    scripts: tuple[str, ...]

    def __init__(self, package: str, what: str, scripts: tuple[str, ...] = ()) -> None:
        self.package, self.what, self.scripts = package, what, scripts
        self._found: dict[str, tuple[float, T]] = {}

    def add(self, name: str, order: float, thing: T) -> T:
        """Register under a name; ``order`` is its place among all, ascending.

        Raises:
            ScenarioError: another thing has this name.
        """
        old = self._found.get(name)
        if old is not None and _origin(old[1]) != _origin(thing):
            raise ScenarioError(f"{self.what} {name!r} is registered twice")
        self._found[name] = order, thing
        return thing

    def all(self) -> dict[str, T]:
        """Return everything by name, in order."""
        for m in walk_packages(import_module(self.package).__path__, f"{self.package}."):
            if m.name.rsplit(".", 1)[-1] not in self.scripts:
                import_module(m.name)
        ordered = sorted(self._found.items(), key=lambda item: item[1][0])
        return {name: thing for name, (_, thing) in ordered}


def _origin(thing: object) -> object:
    """Return where a function was written: a module that is read again registers it again."""
    call = thing[-1] if isinstance(thing, tuple) else thing
    return getattr(call, "__qualname__", call), getattr(call, "__module__", None)
