"""Many joint runs through one loop: blocks of exchange steps of all members in vector lanes.

Each member is the run that :func:`~apu_casadi.unit.multirate.simulate_joint` would make, bit for
bit: it has its own events, loads, faults, health and noise, and stops, fails or warns by itself.
What is shared is the evaluation of compiled blocks, several members at once, and the time that it
takes, steps after a switch among them; what a member does between blocks (tables of a new fault,
its dataset) it does as a single run does.

Memory is that of a chunk of members, and of what is kept of each: let ``keep`` reduce the dataset
where there are thousands.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from apu_casadi.core.errors import ApuError, ScenarioError, nearest
from apu_casadi.core.lanes.together import CHUNK, Course, ensemble
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.multirate import joint_course, simulate_joint

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["course_of", "simulate_ensemble"]

_DEFAULTS = {n: p.default for n, p in inspect.signature(simulate_joint).parameters.items()}


def simulate_ensemble(
    members: Sequence[Mapping[str, Any]],
    *,
    keep: Callable[[int, xr.Dataset], Any] | None = None,
    chunk: int = CHUNK,
    n_threads: int | None = 1,
    refused: str = "raise",
    progress: Callable[[int, int], None] | None = None,
    **common: Any,
) -> list[Any]:
    """Simulate many units, loads, faults, health factors and noise seeds.

    Args:
        members: what each run is asked for: arguments of
            :func:`~apu_casadi.unit.multirate.simulate_joint` by name.
        common: arguments that all members have that do not say otherwise (``apu``, ``duration``,
            ...).
        keep: what is kept of a run, made of its number and dataset; the dataset itself if None.
        chunk: members that are under way at once; memory grows with it.
        n_threads: threads that evaluate blocks; None takes all cores.
        refused: ``"raise"`` stops at the first member that is refused or fails; ``"keep"`` returns
            its error in its place.
        progress: called with the number of members done and of all.

    Returns:
        What was kept of each member, in their order.

    Raises:
        ScenarioError: no members, an argument that is not known or missing, with its member.
        ApuError: what the first member that fails would raise.
    """
    if refused not in ("raise", "keep"):
        raise ScenarioError(f"refused = {refused!r}: 'raise' or 'keep' is expected")
    asked = [_asked(k, {**common, **m}) for k, m in enumerate(members)]
    if not asked:
        raise ScenarioError("an ensemble needs at least one member")
    courses = (joint_course(**how) for how in asked)
    results: list[Any] = [None] * len(asked)
    for done, (k, made) in enumerate(ensemble(courses, chunk=chunk, n_threads=n_threads), 1):
        if isinstance(made, Exception) and (refused == "raise" or not isinstance(made, ApuError)):
            made.add_note(f"member {k} of the ensemble")
            raise made
        failed = isinstance(made, Exception) or keep is None
        results[k] = made if failed or keep is None else keep(k, made)
        if progress is not None:
            progress(done, len(asked))
    return results


def course_of(given: Mapping[str, Any]) -> Course[xr.Dataset]:
    """Return the course of one run, for :func:`apu_casadi.core.lanes.together.ensemble`.

    Args:
        given: arguments of :func:`~apu_casadi.unit.multirate.simulate_joint` by name.

    Raises:
        ScenarioError: an argument that is not known or missing.
    """
    return joint_course(**_asked(0, given))


def _asked(k: int, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return all arguments of a member's run."""
    for name in given:
        if name not in _DEFAULTS:
            raise ScenarioError(f"member {k}: argument {name!r} {nearest(name, tuple(_DEFAULTS))}")
    how = {**_DEFAULTS, "apu": Apu(), **given}
    missing = [n for n, v in how.items() if v is inspect.Parameter.empty]
    if missing:
        raise ScenarioError(f"member {k}: {' and '.join(missing)} must be given")
    return how
