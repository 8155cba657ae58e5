"""Means over the steps of a joint run: what is averaged, and what is kept of it.

A step gives plain means of powers and torque, and what rms values and phasors are made of
(:mod:`apu_casadi.core.means`).  Many steps are settled at once, since one costs as much as a
hundred.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from apu_casadi.core.means import (
    COMPONENTS,
    PARTS,
    PHASES,
    PHASORS,
    RMS,
    SEQUENCES,
    UNBALANCE,
    as_dict,
    sequences,
    settled,
    wanted,
)
from apu_casadi.core.signals import Signal
from apu_casadi.machine.generator import Generator, GeneratorPoint

MEANS = ("P_total", "P_e", "P_loss_fault")
#: Power of the torques over that of eq. (8), shares of the rated power, that is warned of.
EXCESS = 0.01


class Excess(NamedTuple):
    """A step in which the torque takes more of the shaft than eq. (8) gives it.

    Args:
        words: what is told of it.
        t: its end, s.
        P: power of the torque, W.
        limit: what it might take, W.
    """

    words: str
    t: float
    P: float
    limit: float


class RawMeans(NamedTuple):
    """Means of one or more steps as they were averaged; :meth:`StepMeans.settle` goes on.

    Args:
        quad, symmetric: names of the means, and whether the phases differ by rotation only.
        values: shape (means, steps); ``MEANS`` come first.
        turn, w_r: electrical periods in each step, and electrical speed, rad/s; one or (steps,).
        t: end of each step, s; one instant or (steps,).
    """

    quad: tuple[str, ...]
    symmetric: bool
    values: np.ndarray
    turn: Any
    w_r: Any
    t: Any

    @classmethod
    def of(
        cls, quad: tuple[str, ...], sym: bool, means: np.ndarray, h: float, w_r: Any, t: Any
    ) -> RawMeans:
        """Copy the means of steps of length h that end at t, s."""
        values = means.reshape(len(quad), -1).copy()
        return cls(quad, sym, values, h * w_r / (2 * math.pi), w_r, t)


class StepMeans:
    """What is averaged over the steps of equal generators, and kept.

    Args:
        gen: the generator.
        phasors: whether phasors are kept too.
        of: which generators, in words.
        pairs: number of them over two.
    """

    gen: Generator
    phasors: bool
    kept: tuple[str, ...]

    def __init__(
        self, gen: Generator, phasors: bool, of: str = "the two generators", pairs: float = 1.0
    ) -> None:
        self.gen, self.phasors, self._of, self._pairs = gen, phasors, of, pairs
        self.kept = (*MEANS, *RMS, *SEQUENCES, *(PARTS if phasors else ()))
        # largest power of the torques over eq. (8), both, and the instant
        self.excess: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    def quad(self, *, short: bool, symmetric: bool) -> tuple[str, ...]:
        """What is averaged; ``short``: a step may be shorter than an electrical period."""
        means = wanted(phasors=True, short=short, symmetric=symmetric)
        return (*MEANS, *means, "T_e")

    def at_rest(self, point: GeneratorPoint) -> np.ndarray:
        """What a step's means would be in the steady state."""
        parts = phasors_at_rest(point)
        means = [*(point.mean(n) for n in MEANS), *rms_at_rest(point).values()]
        means += [*sequences(parts, symmetric=point.balanced), *(parts if self.phasors else ())]
        return np.array(means)

    def settle(self, raw: Sequence[RawMeans]) -> np.ndarray:
        """Return what is kept of the means of steps, as ``kept``, shape (kept, steps).

        All have the same ``quad`` and ``symmetric``.  Notes where the torque takes more than
        eq. (8) says.
        """
        values = np.concatenate([r.values for r in raw], axis=1)
        each = [np.broadcast_to(x, r.values.shape[1]) for r in raw for x in (r.turn, r.w_r, r.t)]
        turn, w_r, t = (np.concatenate(each[i::3]) for i in range(3))
        by_name = as_dict(raw[0].quad, values)
        more = settled(by_name, turn=turn, symmetric=raw[0].symmetric, phasors=True)
        rms, parts = more[: len(RMS)], more[len(RMS) :]
        torque = 2.0 * by_name["T_e"] * w_r / self.gen.machine.n_pp
        excess = torque - by_name["P_total"]
        k = int(np.argmax(excess))
        if excess[k] > self.excess[0]:
            at = (excess[k], torque[k], by_name["P_total"][k], t[k])
            self.excess = tuple(map(float, at))
        of_symmetry = sequences(parts, symmetric=raw[0].symmetric)
        kept = (values[: len(MEANS)], rms, of_symmetry, *((parts,) if self.phasors else ()))
        return np.concatenate(kept)

    def too_little(self, raw: RawMeans) -> Excess | None:
        """Return what is told of the first of steps in which (8) gives too little."""
        by_name = as_dict(raw.quad, raw.values)
        torque = 2.0 * by_name["T_e"] * raw.w_r / self.gen.machine.n_pp
        excess = torque - by_name["P_total"]
        out = np.flatnonzero(excess > EXCESS * 2.0 * self.gen.machine.P_rated)
        if not out.size:
            return None
        k, t = out[0], np.broadcast_to(np.atleast_1d(raw.t), excess.shape)
        return self._told(excess[k], torque[k], by_name["P_total"][k], float(t[k]))

    @property
    def warnings(self) -> list[Excess]:
        """What must be known of the steps settled so far."""
        if self.excess[0] <= EXCESS * 2.0 * self.gen.machine.P_rated:
            return []
        return [self._told(*self.excess)]

    def _told(self, *powers_and_t: float) -> Excess:
        *powers, t = powers_and_t
        more, torque, power = (self._pairs * P for P in powers)
        allowed = power + self._pairs * EXCESS * 2.0 * self.gen.machine.P_rated
        words = (
            f"eq. (8) gives too little: in the step that ends at t = {t:.6g} s the torque of "
            f"{self._of} takes {torque / 1e3:.4g} kW of the shaft, eq. (8), with which "
            f"the gas generator is loaded, {power / 1e3:.4g} kW; {more / 1e3:.3g} kW are more "
            f"than {100 * EXCESS:g} % of the rated power. Eq. (8) holds output and extra loss "
            "of the fault only: near a short circuit the machine's own loss is missing"
        )
        return Excess(words, t, torque, allowed)


def rms_at_rest(point: GeneratorPoint) -> dict[str, float]:
    """Rms values in the steady state, by name."""
    if not point.balanced:
        return {name: point.turn.rms(name.removesuffix("_rms").lower()) for name in RMS}
    I = math.sqrt(sum(point.y[f"i_{p}"] ** 2 for p in PHASES) / 3)
    return {name: point.y["V_t"] if name[0] == "V" else I for name in RMS}


def phasors_at_rest(point: GeneratorPoint) -> np.ndarray:
    """Phasors in the steady state, in the order of ``PARTS``."""
    if not point.balanced:
        each = [point.turn.phasor(name) for name in PHASORS.values()]
        return np.array([part for V in each for part in (V.real, V.imag)])
    means = []
    for q in "vi":
        for p, ahead, behind in ("acb", "bac", "cba"):
            # at rotor angle zero, where a steady state starts: v_a = a cos + b sin, and
            # the other phases are a third of a turn before and behind it
            b = (point.y[f"{q}_{ahead}"] - point.y[f"{q}_{behind}"]) / math.sqrt(3.0)
            means += [point.y[f"{q}_{p}"] / math.sqrt(2.0), -b / math.sqrt(2.0)]
    return np.array(means)


def phasor_signals() -> list[Signal]:
    """Name, unit and meaning of the phasors and the symmetrical components of a step."""
    kinds = {"V": ("V", "voltage"), "I": ("A", "current")}
    parts = {"re": "along the rotor angle's cosine", "im": "ahead of it by a quarter turn"}
    order = dict(zip("120", ("positive", "negative", "zero"), strict=True))
    made = [
        Signal(f"{name}_{part}", unit, f"phase {name[2]} {what}, fundamental, rms, {where}")
        for name in PHASORS
        for unit, what in (kinds[name[0]],)
        for part, where in parts.items()
    ]
    for name in COMPONENTS:
        (unit, what), sequence = kinds[name[0]], f"{order[name[2]]} sequence of the"
        made += [
            Signal(name, unit, f"{sequence} {what}, fundamental, rms"),
            Signal(f"{name}_angle", "rad", f"{sequence} {what}, angle ahead of the rotor's"),
        ]
    for name, (_, what) in zip(UNBALANCE, kinds.values(), strict=True):
        made.append(Signal(name, "1", f"negative over positive sequence of the {what}"))
    return made
