"""What of an estimate is to be believed: part by part, each with its reasons.

=================== ============================================================================
``gas path``        speed and health
``machine 1``       powers and severities of that generator
``machine 1: h_a``  one severity of it
=================== ============================================================================

A doubt is about a part and all that belongs to it; one about nothing in particular is about all.  A
part is believed if no doubt is about it or about what belongs to it, and the gas path that has its
shaft power from the machines only if they are; the whole is believed if all parts are.  What was
lost on the way, the filter of a machine that its model does not fit, is a part that is not
believed, although there is no estimate of it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

from apu_casadi.machine.park import PHASES
from estimators.apu.recordings.plausible import plain

__all__ = [
    "GAS",
    "GENERATORS",
    "MACHINE",
    "Doubt",
    "about",
    "believed",
    "in_words",
    "is_lost",
    "machine",
    "part_of",
    "severity",
    "verdict",
]

GAS = "gas path"
MACHINE = "machine"  # all machines
GENERATORS = "generators"  # any of them, as the place of a change


class Doubt(str):
    """One sentence that speaks against an estimate.

    Its ``kind`` is one of :data:`estimators.apu.believable.KINDS`; ``part``: of what it is, see the
    module; "": of all.
    """

    kind: str
    part: str

    def __new__(cls, kind: str, text: str, part: str = "") -> Doubt:
        """Make a sentence of a kind about a part."""
        made = super().__new__(cls, text)
        made.kind, made.part = kind, part
        return made

    def of(self, what: str) -> Doubt:
        """Return the same of a part: ``"machine 1, ..."``."""
        part = f"{what}: {self.part}" if self.part else what
        return Doubt(self.kind, f"{what}, {self}", part)

    def __getnewargs__(self) -> tuple[str, str, str]:  # type: ignore[override]
        return self.kind, str(self), self.part


def machine(number: int) -> str:
    """Return the part's name of a generator."""
    return f"{MACHINE} {number}"


def severity(phase: str) -> str:
    """Return the name of a severity, without its machine's."""
    return f"h_{phase}"


def part_of(channel: str, electrical: Collection[str]) -> str:
    """Return the part that rests on a channel: ``i_a_2`` of machine 2, ``i_a`` of all."""
    if channel not in electrical:
        return GAS
    ending = channel.removeprefix(plain(channel))
    return machine(int(ending[1:])) if ending else MACHINE


def about(doubts: Iterable[str], part: str) -> list[str]:
    """Return doubts which say of nothing in particular that they are of a part."""
    return [Doubt(d.kind, str(d), d.part or part) if isinstance(d, Doubt) else d for d in doubts]


def believed(
    doubts: Collection[str], *, gas: bool, machines: Iterable[int], power_of: Collection[int] = ()
) -> dict[str, tuple[str, ...]]:
    """Return why each part is not to be believed; a part that is has no reason.

    Args:
        doubts: all of them; those that are no :class:`Doubt` are about everything.
        gas: whether there is a gas path.
        machines: that were estimated or lost, by number.
        power_of: the machines of which the gas path has its power.
    """
    out: dict[str, tuple[str, ...]] = {}
    for k in machines:
        name = machine(k)
        out[name] = _reasons(doubts, name)
        out |= {f"{name}: {h}": _reasons(doubts, f"{name}: {h}") for h in map(severity, PHASES)}
    if gas:
        unsure = [k for k in power_of if _reasons(doubts, machine(k))]
        told = (f"its shaft power is that of {machine(k)}, which is doubted" for k in unsure)
        out = {GAS: (*_reasons(doubts, GAS), *told)} | out
    return out


def _reasons(doubts: Iterable[str], part: str) -> tuple[str, ...]:
    """Doubts about a part, about what it belongs to, or about what belongs to it."""
    return tuple(str(d) for d in doubts if _concerns(getattr(d, "part", ""), part))


def _concerns(of: str, part: str) -> bool:
    return part.startswith(of) or of.startswith(f"{part}:")


def is_lost(doubts: Iterable[str], number: int) -> bool:
    """Whether the filter of a machine does not fit it, so that there is no estimate."""
    of = (d for d in doubts if getattr(d, "kind", "") == "lost")
    return any(getattr(d, "part", "") == machine(number) for d in of)


def verdict(belief: Mapping[str, Collection[str]]) -> dict[str, dict[str, Any]]:
    """Return the parts, ready for JSON."""
    return {n: {"believable": not why, "reasons": list(why)} for n, why in belief.items()}


def in_words(parts: Mapping[str, Mapping[str, Any]]) -> str:
    """Say which parts are doubted and which are not; of a machine that is wholly so its name.

    Args:
        parts: of :func:`verdict`.
    """
    split = [[n for n, b in parts.items() if b["believable"] is well] for well in (False, True)]
    mixed = set.intersection(*({n.partition(":")[0] for n in names} for names in split))
    out = ""
    for word, names in zip(("doubted", "believed"), split, strict=True):
        shown = [n for n in names if ":" not in n or n.partition(":")[0] in mixed]
        out += f"; {word}: {', '.join(shown)}" if shown else ""
    return out
