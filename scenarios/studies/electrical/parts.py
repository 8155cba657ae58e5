"""All studies of the electrical filter by name."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from apu_casadi.core.errors import EstimationError, ParameterError, nearest
from scenarios.studies.electrical.detection import detection
from scenarios.studies.electrical.efficiency import efficiency
from scenarios.studies.electrical.false_alarms import false_alarms, quiet
from scenarios.studies.electrical.leaky import leaky
from scenarios.studies.electrical.protocol import N_SEEDS, SEED0
from scenarios.studies.electrical.speed import speed

__all__ = ["STUDIES", "run"]

STUDIES: dict[str, Callable[..., dict[str, Any]]] = {
    "efficiency": efficiency,
    "detection": detection,
    "quiet": quiet,
    "false_alarms": false_alarms,
    "leaky": leaky,
    "speed": speed,
}


def run(
    n_seeds: int = N_SEEDS,
    seed0: int = SEED0,
    *,
    hours: float = 1.0,
    studies: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Run the studies, or some of them, and return what JSON can hold.

    Args:
        n_seeds, seed0: seeds seed0 ... seed0 + n_seeds - 1; load steps and leaky faults take a
            tenth.
        hours: of healthy operation in the study of false alarms.
        studies: names of :data:`STUDIES`.

    Raises:
        ParameterError: unknown study. EstimationError : fewer than two seeds.
    """
    if n_seeds < 2:
        raise EstimationError(f"a study of {n_seeds} seeds says nothing: 2 at least")
    out: dict[str, Any] = {}
    few = max(2, n_seeds // 10)
    for name in STUDIES if studies is None else studies:
        if name not in STUDIES:
            raise ParameterError(f"study {name!r} {nearest(name, STUDIES)}")
        begun = time.perf_counter()
        if name in ("efficiency", "detection"):
            out[name] = STUDIES[name](n_seeds, seed0)
        elif name in ("quiet", "leaky"):
            out[name] = STUDIES[name](few, seed0)
        elif name == "false_alarms":
            out[name] = false_alarms(hours, seed0)
        else:
            out[name] = STUDIES[name]()
        out[name]["total_seconds"] = time.perf_counter() - begun
    return out
