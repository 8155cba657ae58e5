"""One answer for a change that several filters saw: sensor, gas path, machine or phase.

Each filter weighs what its own readings say (:mod:`.gascauses`, :mod:`.electrical.causes`).  What
happened is one thing, as a rule, and each hypothesis says what the others see of it: a short
circuit costs shaft power, which the gas path may notice; a current that fails does so as well; a
change of health shows in no current; a speed pick-up is an input of one filter and an output of the
other.  Likelihoods, which are posterior over prior weights, multiply; two things at once count
``COINCIDENCE``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from estimators.apu import gascauses
from estimators.apu.electrical import causes
from estimators.apu.electrical.causes import Causes, kind_of
from estimators.apu.trust import GAS, GENERATORS
from estimators.information.posterior import named_posterior

__all__ = ["COINCIDENCE", "Diagnosis", "diagnoses"]

TOGETHER = 0.2  # s; the gas path sees a change later than the waveforms do
COINCIDENCE = 1e-3
LEAST = 1e-9  # probability that is no less
NOTHING = {True: "none", False: "healthy"}  # of the gas path, of a machine
SHORT = "short circuit"


@dataclass(frozen=True)
class Diagnosis:
    """What a change is, by all that saw it.

    Args:
        t: its first instant, s.
        probability: by hypothesis, ``"gas path"``, ``"sensor T5"``, ``"machine 1: sensor i_a"``,
            ``"machine 2: short circuit b"``, ``"two at once"``.
        failure: how the most probable sensor failed, or which factor of the gas path changed,
            with probabilities; empty for others.
    """

    t: float
    probability: Mapping[str, float]
    failure: Mapping[str, float] = field(default_factory=dict)

    @property
    def best(self) -> str:
        """The most probable hypothesis."""
        return max(self.probability, key=lambda n: self.probability[n])


def diagnoses(found: Mapping[str, Sequence[Causes]]) -> list[Diagnosis]:
    """Return one answer for each change.

    Args:
        found: what the filters say of their changes, by ``"gas path"`` or ``"machine 1"``.
    """
    every = sorted(((c.t, place, c) for place, told in found.items() for c in told), key=_when)
    out: list[Diagnosis] = []
    while every:
        t = every[0][0]
        first: dict[str, Causes] = {}
        for when, place, c in every:
            if when <= t + TOGETHER:
                first.setdefault(place, c)
        every = [e for e in every if e[0] > t + TOGETHER]
        out.append(_one(t, first))
    return out


def _when(x: tuple[float, str, Causes]) -> tuple[float, str]:
    return x[0], x[1]


def _one(t: float, seen: Mapping[str, Causes]) -> Diagnosis:
    score: dict[str, float] = {}
    for place, c in seen.items():
        for what in c.probability:
            name = what if place == GAS else f"{place}: {what}"
            if what == NOTHING[place == GAS]:
                continue
            others = (_sees(seen[p], p, place, what) for p in seen if p != place)
            score[name] = _log(c.probability[what]) + sum(others)
    score["nothing"] = sum(_log(c.probability[NOTHING[p == GAS]]) for p, c in seen.items())
    if len(seen) > 1:
        each = (max(c.probability.values()) for c in seen.values())
        score["two at once"] = math.log(COINCIDENCE) + sum(map(math.log, each))
    shares = dict(sorted(named_posterior(score).items(), key=lambda x: -x[1]))
    best = next(iter(shares))
    place, _, what = best.rpartition(": ")
    own = seen.get(place or GAS)
    failed = own.failure.get(what, {}) if own is not None else {}
    return Diagnosis(t, shares, failed)


def _log(p: float) -> float:
    return math.log(max(p, LEAST))


def _sees(c: Causes, here: str, place: str, what: str) -> float:
    """Log-likelihood of what one filter saw if a hypothesis of another one holds."""
    prior = gascauses.PRIOR if here == GAS else causes.PRIOR
    likely = {n: _log(p) - math.log(prior[kind_of(n, prior)]) for n, p in c.probability.items()}
    return max(likely[n] for n in _expected(here, place, what, likely))


def _expected(here: str, place: str, what: str, known: Mapping[str, float]) -> Iterator[str]:
    """What a filter may take the hypothesis of another one for."""
    yield NOTHING[here == GAS]
    if here == GAS:
        yield from (n for n in ("shaft power",) if n in known)
        if what == "sensor w_r":
            yield from (n for n in ("sensor N",) if n in known)
    elif what.startswith(SHORT) and GENERATORS in (here, place):
        yield from (n for n in known if n.startswith(SHORT))  # of which the power says no phase
