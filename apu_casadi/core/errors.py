"""The errors of the package.

Every message says what is wrong, where, by how much where that is a number, and what to do.
All derive from :class:`ApuError`, so that a campaign can catch the family.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from typing import Any

from apu_casadi.core import interrupts


class ApuError(Exception):
    """Base of every error that the package raises on purpose.

    None is made of an interrupt: while one is recorded, KeyboardInterrupt is raised instead, since
    what failed then failed because of it (:mod:`apu_casadi.core.interrupts`).
    """

    def __init__(self, *args: object) -> None:
        """Keep the message, or raise KeyboardInterrupt."""
        interrupts.check()
        super().__init__(*args)


class SignalError(ApuError, ValueError):
    """A vector was packed with unknown or missing names, a wrong shape or a non-finite value."""


class ParameterError(ApuError, ValueError):
    """A parameter has an unknown name, or a value outside its physical range."""


class MapError(ApuError, ValueError):
    """A component map is malformed, or cannot be scaled to the design point asked for."""


class OperatingPointError(ApuError, RuntimeError):
    """No operating point satisfies the equations: beyond surge, off the map, no power balance."""


class SimulationError(ApuError, RuntimeError):
    """An integration or an implicit step failed, or its re-evaluated residual is too large."""


class NotApplicable(SimulationError):  # noqa: N818 - not a failure
    """An integrator cannot take a step, or is not made for it; says why.  Another one may."""


class ValidityError(SimulationError):
    """A run that was to be strict left the range in which the model holds; ``t`` says when, s."""

    words: str
    t: float

    def __init__(self, words: str, t: float = math.nan) -> None:
        super().__init__(words if math.isnan(t) else f"at t = {t:.6g} s: {words}")
        self.words, self.t = words, t

    def __reduce__(self) -> tuple[type[ValidityError], tuple[str, float]]:
        return type(self), (self.words, self.t)


class ScenarioError(ApuError, ValueError):
    """A scenario description has an unknown key or an impossible value."""


class BackendError(ApuError, RuntimeError):
    """Compiled code was demanded and cannot be had, or a compiled function was called wrongly."""


class EstimationError(ApuError, RuntimeError):
    """A filter or a fit lost its belief, did not converge, or cannot be told from its data."""


class DataError(ApuError, ValueError):
    """A file is missing, damaged, or lacks a column."""


class ApuWarning(UserWarning):
    """A result is given, but something about it must be known.

    ``data`` is what it tells in numbers, where somebody gave them.
    """

    data: Any = None


class ValidityWarning(ApuWarning):
    """A run left the range in which the model holds."""


class ExchangeWarning(ApuWarning):
    """The exchange of speed and fuel errs by more than 1 % of the speed's excursion."""


def nearest(name: str, valid: Iterable[str]) -> str:
    """Return ``"(did you mean X?)"`` for the valid name nearest to ``name``, or the list of all.

    Case is ignored, because ``WF`` for ``Wf`` is the commonest slip.
    """
    names = list(valid)
    by_lower: dict[str, str] = {}
    for n in names:
        by_lower.setdefault(n.lower(), n)
    close = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=0.55)
    if close:
        return f"(did you mean {by_lower[close[0]]!r}?)"
    return f"(valid: {', '.join(names)})"
