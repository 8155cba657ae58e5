"""Programs of families: what is built for one unit serves all others of its structure."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

from apu_casadi.core.backend import backend_in_use
from apu_casadi.core.sharing import keep
from estimators.batch.transcription import Transcription
from estimators.models.lifting import Lifted
from estimators.models.recording import Recording

__all__ = ["full", "program"]

PROGRAMS = 8  # of a family that are kept: each holds a solver


def program(
    lifted: Lifted,
    sizes: Sequence[int],
    shared: Sequence[str] = (),
    own: Sequence[str] = (),
    *,
    prior: bool = False,
    backend: str | None = None,
    build: bool = False,
) -> Transcription:
    """Return the program of a model's family, made once; it takes recordings of :func:`full`.

    Args:
        lifted: a unit's model, or one without family, whose program is its own.
        sizes, shared, own, prior, backend, build: see :class:`Transcription`.
    """
    how: dict[str, Any] = {"prior": prior, "backend": backend, "build": build}
    what, made = (tuple(sizes), tuple(shared), tuple(own)), lifted.shared
    if made is lifted:
        return Transcription(lifted, *what, **how)
    key = what, *how.values(), backend_in_use()
    return keep(made, program, key, lambda: Transcription(made, *what, **how), limit=PROGRAMS)


def full(lifted: Lifted, recordings: Sequence[Recording]) -> list[Recording]:
    """Return recordings with the numbers of the unit among their parameters."""
    if lifted.family is None:
        return list(recordings)
    return [dataclasses.replace(r, p=lifted.model.full(r.p)) for r in recordings]
