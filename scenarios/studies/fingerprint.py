"""What a study's numbers depend on: the constants of modules, and the equations of its filters.

The equations are taken of the functions themselves, as CasADi writes them down: comments, names of
Python and the place of code do not change their digest; an operation, a constant or a default of
the filters does.  What a study draws, and how it scores, is outside.  Digests of two versions of
CasADi cannot be compared.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Callable, Sequence
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

import casadi as ca

from apu_casadi.core.sharing import once

__all__ = ["constants", "digest", "digest_of"]

TESTS = ("JUMP_TEST", "TEST", "DEFAULT", "SNAPSHOT")
"""Constants that are dataclasses: what a test of jumps, or a protocol, is made of."""
OF_EXTRAS = ("estimators.apu.isolation.sklearnbank",)  # no study has them


def digest(functions: Sequence[ca.Function]) -> str:
    """Return the digest of functions, twelve characters: that of all they are made of."""
    h = hashlib.sha256()
    for f in functions:
        h.update(f.serialize().encode())
    return h.hexdigest()[:12]


@once
def digest_of(filters: Callable[[], list[ca.Function]]) -> str:
    """Return the digest of the functions that ``filters`` makes; a second or two."""
    return digest(filters())


def constants(*modules: str) -> dict[str, Any]:
    """Return the constants in capitals that JSON can hold, of modules and of packages' modules."""
    names: list[str] = []
    for module in modules:
        inner = iter_modules(getattr(import_module(module), "__path__", []), f"{module}.")
        names += [module, *(m.name for m in inner)]
    found: dict[str, Any] = {}
    for space in (vars(import_module(name)) for name in names if name not in OF_EXTRAS):
        for name, value in space.items():
            if re.fullmatch(r"[A-Z][A-Z0-9_]*", name):
                try:
                    json.dumps(value, allow_nan=False)
                except (TypeError, ValueError):
                    continue
                found[name] = value
        for name in TESTS:
            value = space.get(name)
            if dataclasses.is_dataclass(value) and not isinstance(value, type):
                fields = ((f.name, getattr(value, f.name)) for f in dataclasses.fields(value))
                found[name] = {k: v for k, v in fields if isinstance(v, (int, float, str, tuple))}
    return found
