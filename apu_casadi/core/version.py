"""The version of the program, as the installation records it; every result carries it."""

from __future__ import annotations

from functools import cache
from importlib.metadata import PackageNotFoundError, version


@cache
def installed() -> str:
    """Return the installed version; "unknown" in a checkout that is not installed."""
    try:
        return version("apu-casadi")
    except PackageNotFoundError:
        return "unknown"
