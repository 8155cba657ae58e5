"""Outputs that are angles: read modulo a turn."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError
from apu_casadi.core.sharing import of_family, remade
from estimators.models.filtermodel import FilterModel

__all__ = ["PERIODS", "angular"]

#: A full turn in the units of angles.
PERIODS = {"rad": 2 * math.pi, "deg": 360.0, "degree": 360.0}


@remade
@of_family
def angular(model: FilterModel, outputs: Sequence[str] | Mapping[str, float | None]) -> FilterModel:
    """Return the model whose named outputs are angles, read modulo a period.

    A resolver gives 3.1 and then -3.1 rad: an innovation of +0.08, not of -6.2.  What the model
    gives may count turns or be wrapped itself (``atan2``).  An angle is a number to a filter, with
    a Gaussian error: it must be known to a small part of a turn before each sample, by prior and
    rate of samples; a sample that is half a turn off may mean either way.

    Args:
        outputs: names, whose units give the periods (rad: 2 pi, deg: 360), or periods by name in
            the output's unit, None for the unit's own.

    Raises:
        SignalError: unknown output.
        ParameterError: a unit without a known period, a period that is not finite and > 0.
    """
    given = outputs if isinstance(outputs, Mapping) else dict.fromkeys(outputs)
    angles = dict(model.angles)
    for name, period in given.items():
        unit = model.y[model.y.index(name)].unit
        if period is None and unit not in PERIODS:
            raise ParameterError(
                f"{model.name}: {name} in {unit!r}: give the period of a turn; known are those "
                f"of {', '.join(PERIODS)}"
            )
        T = PERIODS[unit] if period is None else number(f"period of {name}", period)
        if not 0 < T < math.inf:
            raise ParameterError(f"period of {name} must be finite and > 0, got {period!r}")
        angles[name] = T
    return dataclasses.replace(model, angles=tuple(angles.items()))
