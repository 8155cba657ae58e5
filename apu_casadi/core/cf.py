"""What a file says of itself, after the CF and ACDD conventions: the one place for it.

Every netCDF or MAT file goes through :func:`described`.  A variable has a ``long_name``, and the
``standard_name`` of CF where there is one; the time of a run has none, because CF's ``time`` needs
a date to count from.  No institution, creator, licence or identifier is made up, and there is no
place on earth that a file would be of.  ``SOURCE_DATE_EPOCH`` [s] in the environment fixes
``date_created``, so that files can be made again byte by byte.

``compliance-checker -t cf:1.11`` asks for the ``standard_name`` of ``time`` nevertheless (with it,
for a date), and names two habits: ``v_c`` beside ``V_C`` of a generator, and the altitude of a deck
left of other axes.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from apu_casadi.core.version import installed

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["KEYWORDS", "STANDARD_NAMES", "described", "now", "origin"]

KEYWORDS = (
    "gas turbine",
    "auxiliary power unit",
    "synchronous generator",
    "fault diagnosis",
    "simulation",
)

STANDARD_NAMES: Mapping[str, str] = {
    "altitude": "altitude",
    "T_amb": "air_temperature",
    "P_amb": "air_pressure",
    "war": "humidity_mixing_ratio",
}
"""Names of CF's table, by ours; CF knows no speed, station or current of a machine."""

_VOCABULARY = "CF Standard Name Table v91"
_SUMMARY = (
    "Made by apu-casadi, a model of an all-electric auxiliary power unit: gas generator, "
    "starter/generators, their faults, and estimates of them. No engine was run."
)


def origin(done: str) -> dict[str, str]:
    """Return the attributes that name program and conventions.

    Args:
        done: what the program has done, a participle for the history.
    """
    program = f"apu-casadi {installed()}"
    return {
        "apu_casadi_version": installed(),
        "Conventions": "CF-1.11, ACDD-1.3",
        "source": f"{program}, model of an all-electric auxiliary power unit",
        "history": f"{done} by {program}",
    }


def now() -> str:
    """Return the time of making, UTC in ISO 8601: ``SOURCE_DATE_EPOCH`` where it is set."""
    at = os.environ.get("SOURCE_DATE_EPOCH", "")
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(int(at) if at.isdigit() else None))


def _of_time(ds: xr.Dataset) -> dict[str, str]:
    """Return what ACDD asks of a run's time, ISO 8601; it counts from the start of the run."""
    if "time" not in ds.coords or ds["time"].dtype.kind != "f" or ds["time"].size < 2:
        return {}
    t = ds["time"].values
    return {
        "time_coverage_duration": f"PT{t[-1] - t[0]:.6g}S",
        "time_coverage_resolution": f"PT{np.median(np.diff(t)):.6g}S",
        "comment": "time counts from the start of the run: it has no date, hence no standard_name",
    }


def described(ds: xr.Dataset, title: str = "") -> xr.Dataset:
    """Return a dataset with the attributes of CF and ACDD that it lacks; values are shared.

    Args:
        ds: any dataset of this package.
        title: of a dataset that has none.
    """
    made = ds.copy(deep=False)
    for name, v in made.variables.items():
        v.attrs.setdefault("long_name", str(name).replace("_", " "))
        if name in STANDARD_NAMES:
            v.attrs.setdefault("standard_name", STANDARD_NAMES[str(name)])
        if name == "altitude":
            v.attrs.setdefault("positive", "up")
        if "flag_values" in v.attrs:
            v.attrs["flag_values"] = np.asarray(v.attrs["flag_values"], v.dtype)
        axis = name in made.coords
        v.attrs.setdefault("coverage_content_type", "coordinate" if axis else "modelResult")
        if axis:
            v.encoding["_FillValue"] = None  # CF: none of a coordinate
    named = any("standard_name" in v.attrs for v in made.variables.values())
    told = {
        "title": title or "result of apu-casadi",
        "summary": _SUMMARY,
        "keywords": ", ".join(KEYWORDS),
        **({"standard_name_vocabulary": _VOCABULARY} if named else {}),
        **origin("written"),
        **_of_time(made),
        "project": "apu-casadi",
        "processing_level": "simulated",
        "date_created": now(),
    }
    made.attrs = {**made.attrs, **{k: v for k, v in told.items() if k not in made.attrs}}
    return made
