"""Means over a step: what may be asked for, and how rms values and phasors follow from it.

A mean is asked for by a text: an output (``"P_e"``), its square (``"v_a^2"``), either times a
harmonic of the rotor angle (``"v_a*cos1"``, ``"i_b^2*sin2"``), a harmonic alone (``"1*cos4"``).
``~`` in front weights it by :func:`window`; without it every instant counts the same.

**Rms values.**  A mean of v^2 over a step that holds no whole number of periods ripples with the
rotor angle, differently in each phase: a false unbalance.  The mean here is the constant A of

    v^2 = A + B cos 2 theta + C sin 2 theta

fitted by least squares with the weight of the window.  It is exact for a sinusoid of the machine's
frequency at any speed, and for what a fault adds (v^2 has 4 theta then, 6 theta, ...) but for the
side lobes of the window, below 1e-4 of that ripple in a step of 8 periods.  The window vanishes at
both ends with its slope: neither a voltage spike of nanoseconds after a switch nor what settles
within microseconds is in the value, which is that of the settled waveform.

* A step shorter than one electrical period holds no rms value; there it is that of the fundamental
  fitted to the waveform, v = c cos theta + s sin theta.
* A machine without a fault under a balanced load, both free of noise, differs in its phases by
  rotation only.  Its three values are one, from the mean of the three squares, which does not
  ripple at all; so also while voltages change, and in steps of any length.

Phasors are the fundamental by least squares with the same weight; in a symmetric machine they are
those of the means on the rotor's axes, which do not ripple.

**Symmetrical components** (Fortescue 1918) follow from the phasors of every step,

    V_1 = (V_a + a V_b + a^2 V_c)/3,  V_2 = (V_a + a^2 V_b + a V_c)/3,  V_0 = (V_a + V_b + V_c)/3,

with a = exp(j 2 pi/3); angles are those ahead of the rotor angle's cosine.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from apu_casadi.core.errors import SignalError
from apu_casadi.core.statespace import StateSpace

PHASES = ("a", "b", "c")
#: Rms values by name, and the weighted mean squares that they are made of.
RMS = {f"{q}_{p}_rms": f"~{q.lower()}_{p}^2" for q in "VI" for p in PHASES}
#: Fundamental phasors by name, and the waveforms that they are of.
PHASORS = {f"{q.upper()}_{p}": f"{q}_{p}" for q in "vi" for p in PHASES}
PARTS = tuple(f"{name}_{part}" for name in PHASORS for part in ("re", "im"))
HARMONICS = ("~1*cos2", "~1*sin2", "~1*cos4", "~1*sin4")
SQUARES = (*RMS.values(), *(f"{q}*{f}2" for q in RMS.values() for f in ("cos", "sin")))
MOMENTS = tuple(f"~{q}*{f}1" for q in PHASORS.values() for f in ("cos", "sin"))
#: What a symmetric machine has instead of ``SQUARES``; it does not ripple.  The last is the mean of
#: the weight itself: what an integrator makes of that cancels.
COMMON = ("~v^2", "~i^2", "~1")
#: And instead of ``MOMENTS``: what is on the rotor's axes.
AXES = ("~v_q", "~v_d", "~i_q", "~i_d")
#: Symmetrical components by name: rms of positive, negative and zero sequence, ...
COMPONENTS = tuple(f"{q}_{k}" for q in "VI" for k in (1, 2, 0))
#: ... their angles, and the ratios of the negative one to the positive one.
UNBALANCE = ("V_2_over_V_1", "I_2_over_I_1")
SEQUENCES = (*COMPONENTS, *(f"{n}_angle" for n in COMPONENTS), *UNBALANCE)
#: Least turn of the rotor, electrical periods, in a step whose squares give an rms value.
LEAST = 1.0


class Term(NamedTuple):
    """What is to be averaged: ``base`` to a power, times cos or sin of k theta_e, weighted or not.

    Args:
        base: name of an output, or ``"1"``; ``"v"`` or ``"i"``, squared: the mean over the phases;
            ``"v_q"``, ``"v_d"``, ``"i_q"``, ``"i_d"``: on the rotor's axes.
        power: 1 or 2.
        trig, k: ``"cos"`` or ``"sin"`` and the harmonic; ``""`` and 0 without one.
        weighted: whether :func:`window` weights it.
    """

    base: str
    power: int
    trig: str
    k: int
    weighted: bool

    @classmethod
    def of(cls, text: str) -> Term:
        """Read a text as this module describes it.

        Raises:
            SignalError: it says something else.
        """
        found = re.fullmatch(r"(~?)(\w+)(?:\^(2))?(?:\*(cos|sin)([1-4]))?", text)
        if found is None:
            raise SignalError(
                f"mean of {text!r}: only a name or name^2 is understood, both with ~ before them "
                "or *cos1 ... *sin4 after"
            )
        weight, base, square, trig, k = found.groups()
        return cls(base, 2 if square else 1, trig or "", int(k or 0), bool(weight))

    def value(self, ss: StateSpace, x: Any, y: Any) -> Any:
        """The output to its power, without harmonic and weight, from states and outputs."""
        if self.base in ("v", "i"):
            return sum(y[ss.y.index(f"{self.base}_{p}")] ** 2 for p in PHASES) / 3.0
        if f"~{self.base}" in AXES:
            a, b, c = (y[ss.y.index(f"{self.base[0]}_{p}")] for p in PHASES)
            # by the addition theorem: of one cosine and one sine, which the outputs have as well
            even, odd = (2.0 * a - b - c) / 3.0, (b - c) / math.sqrt(3.0)
            cos, sin = (f(x[ss.x.index("theta_e")]) for f in (ca.cos, ca.sin))
            return cos * even + sin * odd if self.base[2] == "q" else sin * even - cos * odd
        return 1.0 if self.base == "1" else y[ss.y.index(self.base)] ** self.power

    def nominal(self, ss: StateSpace) -> float:
        """Size by which an integrator divides it.

        Ten times that of the value where it is weighted, a hundred times where it ripples: the
        integral is then near zero for long, and a relative tolerance of it would double the
        integrator's work.
        """
        axes = self.base in ("v", "i") or f"~{self.base}" in AXES
        base = f"{self.base[0]}_a" if axes else self.base
        size = 1.0 if base == "1" else ss.y[base].nominal ** self.power
        return size * (100.0 if self.trig else 10.0 if self.weighted else 1.0)

    def expression(self, ss: StateSpace, x: Any, y: Any, tau: Any) -> Any:
        """What the mean is of; ``tau`` is the share of the step that has passed."""
        value = self.value(ss, x, y)
        if self.trig:
            value = value * harmonic(self.k, x[ss.x.index("theta_e")])[self.trig == "sin"]
        return value * window(tau) if self.weighted else value


def harmonic(k: int, angle: Any) -> tuple[Any, Any]:
    """Return cos and sin of k times an angle, by the addition theorems from those of the angle."""
    if k == 1:
        return ca.cos(angle), ca.sin(angle)
    (c, s), (d, t) = harmonic(k // 2, angle), harmonic(k - k // 2, angle)
    return c * d - s * t, s * d + c * t


def window(tau: Any) -> Any:
    """Weight of an instant in a mean, at the share tau of the step: 30 tau^2 (1 - tau)^2.

    Its own mean is one; value and slope vanish at both ends, so that side lobes fall with the cube
    of the number of periods.
    """
    rest = 1.0 - tau
    return 30.0 * (tau * tau) * (rest * rest)


def wanted(*, phasors: bool, short: bool, symmetric: bool) -> tuple[str, ...]:
    """Return the means that rms values, and phasors if asked for, are made of.

    Args:
        phasors, symmetric: as for :func:`settled`.
        short: whether a step may be shorter than an electrical period.
    """
    if symmetric:
        return (*COMMON, *(AXES if phasors else ()))
    return (*SQUARES, *HARMONICS, *(MOMENTS if phasors or short else ()))


def settled(
    means: Mapping[str, np.ndarray], *, turn: Any, symmetric: bool, phasors: bool
) -> np.ndarray:
    """Return rms values in the order of ``RMS``, and phasors in that of ``PARTS``, from means.

    Args:
        means: by name, as :func:`wanted` lists them, each of shape (steps,).
        turn: electrical periods in each step, shape () or (steps,).
        symmetric: whether the machine has no fault and a balanced load, both free of noise.
        phasors: whether they are wanted.

    Returns:
        Shape (6 or 18, steps).
    """
    if symmetric:
        rms = np.sqrt(_symmetric_squares(means))
        return np.concatenate([rms, _positive(means)]) if phasors else rms
    c2, s2, c4, s4 = (np.asarray(means[n], dtype=float) for n in HARMONICS)
    A = _squares(means, c2, s2, c4, s4)
    short = np.broadcast_to(np.asarray(turn) < LEAST, c2.shape)
    parts = _fundamental(means, c2, s2) if phasors or short.any() else np.zeros((12, *c2.shape))
    A = np.where(short, parts[0::2] ** 2 + parts[1::2] ** 2, A)
    rms = np.sqrt(np.maximum(A, 0.0))
    return np.concatenate([rms, parts]) if phasors else rms


def _symmetric_squares(means: Mapping[str, np.ndarray]) -> np.ndarray:
    squares = np.array([means[n] for n in COMMON[:2]], dtype=float) / means["~1"]
    return np.repeat(squares, 3, axis=0)


def _squares(
    means: Mapping[str, np.ndarray], c2: np.ndarray, s2: np.ndarray, c4: np.ndarray, s4: np.ndarray
) -> np.ndarray:
    """The constant of the fit of squares, shape (6, steps): Schur's complement of the harmonic."""
    cc, cs, ss = (1 + c4) / 2, s4 / 2, (1 - c4) / 2
    determinant = cc * ss - cs * cs
    gain_c, gain_s = (ss * c2 - cs * s2) / determinant, (cc * s2 - cs * c2) / determinant
    own = 1 - gain_c * c2 - gain_s * s2

    def constant(n: str) -> np.ndarray:
        made: np.ndarray = (
            means[n] - gain_c * means[f"{n}*cos2"] - gain_s * means[f"{n}*sin2"]
        ) / own
        return made

    return np.array([constant(n) for n in RMS.values()])


def _fundamental(means: Mapping[str, np.ndarray], c2: np.ndarray, s2: np.ndarray) -> np.ndarray:
    """Phasors, rms: v = sqrt(2) Re(V exp(j theta_e)); real and imaginary parts in turn."""
    cc, cs, ss = (1 + c2) / 2, s2 / 2, (1 - c2) / 2
    determinant = math.sqrt(2.0) * (cc * ss - cs * cs)
    rows = []
    for name in PHASORS.values():
        c, s = means[f"~{name}*cos1"], means[f"~{name}*sin1"]
        rows += [(ss * c - cs * s) / determinant, -(cc * s - cs * c) / determinant]
    return np.array(rows)


def _positive(means: Mapping[str, np.ndarray]) -> np.ndarray:
    """Phasors of the positive sequence, which is all that a symmetric machine has."""
    rows = []
    for q in "vi":
        one = (means[f"~{q}_q"] - 1j * means[f"~{q}_d"]) / (math.sqrt(2.0) * means["~1"])
        for back in np.exp(-2j * math.pi / 3 * np.arange(3)):
            rows += [(one * back).real, (one * back).imag]
    return np.array(rows)


def fortescue(q: np.ndarray | Sequence[Any]) -> list[Any]:
    """Return positive, negative and zero sequence of the phasors of phases a, b, c (Fortescue)."""
    a = np.exp(2j * math.pi / 3)
    rows = [(1, a, a.conjugate()), (1, a.conjugate(), a), (1, 1, 1)]
    # no matrix products: their last bits depend on the shape
    return [sum((c * p for c, p in zip(row, q, strict=True)), 0.0 * q[0]) / 3.0 for row in rows]


def sequences(parts: np.ndarray, *, symmetric: bool = False) -> np.ndarray:
    """Return symmetrical components in the order of ``SEQUENCES`` from phasors.

    Args:
        parts: phasors in the order of ``PARTS``, shape (12, ...).
        symmetric: whether there is a positive sequence only; the others are then zero, and have
            the angle zero.  A ratio is NaN where there is no positive sequence.
    """
    phasors, found = np.asarray(parts)[0::2] + 1j * np.asarray(parts)[1::2], []
    for q in (phasors[:3], phasors[3:]):
        for k, total in enumerate(fortescue(q)):
            found.append(np.zeros_like(total) if symmetric and k else total)
    size = np.sqrt([f.real**2 + f.imag**2 for f in found])
    angle = np.arctan2([f.imag for f in found], [f.real for f in found])
    positive = size[0::3]
    none = np.full(positive.shape, np.nan)
    ratio = np.divide(size[1::3], positive, out=none, where=positive > 0)
    return np.concatenate([size, angle, ratio])


def of_samples(t: Any, theta_e: Any, waves: Mapping[str, Any]) -> dict[str, float]:
    """Return rms values, phasors and symmetrical components of sampled waveforms, by name.

    As over a step, with the same weight, by the trapezoidal rule: for the waveforms of a generator
    that was simulated alone, ``of_samples(ds["time"], ds["theta_e"], ds)``, or for part of them.

    Args:
        t, theta_e: instants, s, and rotor angle, rad, shape (n,).
        waves: v_a ... i_c by name, each of shape (n,).

    Raises:
        SignalError: a waveform is absent, or fewer than 20 samples or less than a period are given.
    """
    t, angle = np.asarray(t, dtype=float), np.unwrap(np.asarray(theta_e, dtype=float))
    missing = [n for n in PHASORS.values() if n not in waves]
    turn = abs(float(angle[-1] - angle[0])) / (2 * math.pi) if angle.size else 0.0
    if missing or t.size < 20 or turn < LEAST:
        raise SignalError(
            f"waveforms over a period or more are needed, 20 samples at least; {t.size} over "
            f"{turn:.3g} periods given" + (f", without {', '.join(missing)}" if missing else "")
        )
    tau = (t - t[0]) / (t[-1] - t[0])
    means = {}
    for name in wanted(phasors=True, short=False, symmetric=False):
        q = Term.of(name)
        value = 1.0 if q.base == "1" else np.asarray(waves[q.base], dtype=float) ** q.power
        wave = window(tau) * value * (getattr(np, q.trig)(q.k * angle) if q.trig else 1.0)
        means[name] = np.array([np.sum((wave[1:] + wave[:-1]) / 2.0 * np.diff(tau))])
    found = settled(means, turn=turn, symmetric=False, phasors=True)
    rows = np.concatenate([found, sequences(found[len(RMS) :])])[:, 0]
    return dict(zip((*RMS, *PARTS, *SEQUENCES), rows.tolist(), strict=True))


def as_dict(names: Sequence[str], means: np.ndarray) -> dict[str, np.ndarray]:
    """Return means of shape (names, steps) or (names,) by name."""
    return dict(zip(names, means, strict=True))
