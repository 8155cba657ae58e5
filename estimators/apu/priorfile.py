"""Files of what is known of the gas path before a recording begins.

    [f_eta_c]
    mean = 0.985           # of the last overhaul's report
    sigma = 0.005
    [gain_T5]
    sigma = 0.001          # calibrated: the mean stays

What is not named is the filter's own prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from apu_casadi.core.errors import DataError, nearest
from apu_casadi.core.signals import Signals
from apu_casadi.core.tomlnumbers import read_toml

__all__ = ["Prior", "read_prior"]

KEYS = ("mean", "sigma")


@dataclass(frozen=True)
class Prior:
    """Means and standard deviations by state of the gas-path filter.

    Args:
        mean, sigma: what differs from the filter's own.
        source: file that says so.
    """

    mean: Mapping[str, float] = field(default_factory=dict)
    sigma: Mapping[str, float] = field(default_factory=dict)
    source: str = "prior"

    def check(self, states: Signals) -> None:
        """Refuse states that the filter does not have.

        Raises:
            DataError: with the nearest name.
        """
        for n in {**self.mean, **self.sigma}:
            if n.startswith("h_"):
                raise DataError(
                    f"{self.source}: {n} is a severity: the electrical filter has a prior of its "
                    "own, wide enough for any"
                )
            if n not in states.names:
                hint = nearest(n, states.names)
                raise DataError(f"{self.source}: no state {n!r} of the gas-path filter {hint}")


def read_prior(path: str | Path) -> Prior:
    """Read a file of priors.

    Raises:
        DataError: no such file, no TOML, an unknown key, no number; it says where.
    """
    data = read_toml(path, "")
    found: dict[str, dict[str, float]] = {k: {} for k in KEYS}
    for name, row in data.items():
        if not isinstance(row, dict) or not row:
            raise DataError(f"{path}: a table [{name}] with mean or sigma is expected, got {row!r}")
        for key, v in row.items():
            if key not in KEYS:
                raise DataError(f"{path}, {name}: unknown key {key!r} {nearest(key, KEYS)}")
            number = isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)
            if not number or (key == "sigma" and not v > 0):
                least = " > 0" if key == "sigma" else ""
                raise DataError(f"{path}, {name}: {key} must be a number{least}, got {v!r:.40}")
            found[key][name] = float(v)
    return Prior(found["mean"], found["sigma"], str(path))
