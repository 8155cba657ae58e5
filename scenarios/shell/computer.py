"""What a time depends on besides the code: processor, cores, load, versions."""

from __future__ import annotations

import math
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

__all__ = ["machine"]

PACKAGES = ("apu-casadi", "casadi", "numpy", "scipy", "xarray")


def machine() -> dict[str, Any]:
    """Return cores, processor, versions, backend, and how busy the machine is."""
    from apu_casadi.core.backend import backend_in_use
    from apu_casadi.core.calling import available_threads

    model = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                model = " ".join(line.split(":", 1)[1].split())
                break
    except OSError:
        pass
    versions = {"Python": platform.python_version()}
    for p in PACKAGES:
        try:
            versions[p] = version(p)
        except PackageNotFoundError:
            versions[p] = "from its folder"
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
    made = {"processor": model, "cores": available_threads(), "system": platform.system()}
    return made | {"backend": backend_in_use(), "load_before": round(load, 2), "versions": versions}
