"""Machines of one shaft compared: which one has a short circuit, and what is wrong with all alike.

Errors that the machines share, of the speed that their filters take, of sensors that were
calibrated together, of the efficiency, make every filter err the same way: each alone finds a short
circuit.  What one machine shows and the others do not is no common error.

Each machine's filter believes in three severities, error e of covariance P, and its considered
errors g move the estimates by S g, where S = -cov(h, g)/var(g) stands in that belief.  Of all
machines the estimates, one below the other, are

    h_hat = h + U c + e,   c ~ N(0, I),   e ~ N(0, blockdiag(P)),

c being the common errors: of the considered ones those that ``COMMON`` names, so many times what a
single machine's may be,
and one that looks like a severity in all three phases at once, which is what wrong speeds,
frequencies and hot fields do.  A hypothesis says which machines, at most
``TOGETHER`` of them, have a short circuit in which phase; such a severity is half-normal.  With its
columns A and R = U U' + blockdiag(P), the likelihood of a hypothesis is

    N(h_hat; 0, R + tau^2 A A') 2^f P(s > 0),

P(s > 0) being the probability that all f severities are positive where only the estimates speak.
That several have the same short circuit is not told from a common error but by the prior.

    compared = compare([side.beliefs for side in sides])
    compared.faulty       # probability of a short circuit, by machine and window
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from apu_casadi.core.errors import DataError
from apu_casadi.machine.park import PHASES
from estimators.apu.electrical.electricalside import Beliefs, ElectricalSide
from estimators.apu.electrical.hypotheses import FAULTY, H_SCALE
from estimators.apu.machinepowers import on_common_windows
from estimators.apu.trust import Doubt, machine, severity
from estimators.information.posterior import posterior

__all__ = ["BALANCED", "COMMON", "Compared", "compare", "compared_sides"]

COMMON = {"gain_": 10.0, "delay_": 4.0, "machine.": 1.0}
"""Standard deviation of what all machines share of a considered error, over that of one machine's
own, by the beginning of its name:

* gains, 5 %: sensors of one type, calibrated together or read with the same wrong ratio;
* delays, 20 us: one acquisition unit with one kind of filter, whose lag nobody declared;
* inductances and the like of the machine: one design, of which the same is not known; what differs
  between specimens is each one's own.

Winding temperatures are no errors in common: each machine has its own, and so has its efficiency,
which moves no severity.
"""
BALANCED = 1e-3
"""The same of a common severity in all three phases: half a per cent of the speed looks so."""
TOGETHER = 2  # machines that have a short circuit at once, at most
NONLINEAR = 0.03  # of the largest severity, which the filter's linearity leaves in the others
H = tuple(f"h_{k}" for k in PHASES)


@dataclass(frozen=True, eq=False)
class Compared:
    """What the comparison of m machines says at the ends of n windows.

    Args:
        probability: of no short circuit, and of one in each phase, by machine, (m, 4, n).
        several: that more than one machine has one, (n,).
        severities: mean and standard deviation by machine and phase, (2, m, 3, n).
        alike: what all machines show alike, by phase: the severity beyond the mean of the other two
            phases that common errors make, and its standard deviation, (2, 3, n).
    """

    probability: np.ndarray
    several: np.ndarray
    severities: np.ndarray
    alike: np.ndarray

    @property
    def faulty(self) -> np.ndarray:
        """Probability of a short circuit by machine, (m, n)."""
        out: np.ndarray = 1.0 - self.probability[:, 0]
        return out

    @property
    def phase(self) -> np.ndarray:
        """Likeliest phase of each machine, 1 to 3; 0: none, (m, n)."""
        out: np.ndarray = self.probability.argmax(1)
        return out

    def report(self, numbers: Sequence[int]) -> dict[str, Any]:
        """Return what is said at the end, ready for JSON; ``numbers`` are the machines'."""
        out: dict[str, Any] = {"machines": {}, "alike": {}, "several": float(self.several[-1])}
        for k, number in enumerate(numbers):
            phase = int(self.probability[k, 1:, -1].argmax())
            said = {"probability": float(self.faulty[k, -1]), "likeliest_phase": PHASES[phase]}
            h, sigma = (float(v) for v in self.severities[:, k, phase, -1])
            out["machines"][str(number)] = said | {"severity": h, "sigma": sigma}
        for i, name in enumerate(PHASES):
            mean, spread = (float(v) for v in self.alike[:, i, -1])
            out["alike"][name] = {"severity": mean, "sigma": spread}
        return out


def compared_sides(
    sides: Mapping[int, ElectricalSide],
) -> tuple[Compared | None, dict[str, Any], list[str]]:
    """Compare the electrical sides of machines by number.

    Returns:
        The comparison, None where there are not two of the same time; its report; and doubts, of
        what a machine's own filter takes for a short circuit while all show the same.
    """
    both = on_common_windows([*sides.values()]) if len(sides) > 1 else None
    beliefs = [s.beliefs for s in both or () if s.beliefs is not None]
    if len(beliefs) < 2 or len(beliefs) < len(sides):
        return None, {}, []
    end = {"to": float(both[0].t[-1])} if both else {}
    found, doubts = compare(beliefs), list[str]()
    for k, (number, side) in enumerate(sides.items()):
        own = int(side.phase[-1])
        if not own or found.faulty[k, -1] > 0.5:
            continue
        mean, sigma = found.alike[:, own - 1, -1]
        if mean > 3 * sigma:
            text = (
                f"{machine(number)}: all machines show the same severity in phase "
                f"{PHASES[own - 1]}, {mean:.1e} beyond the other phases: an error that they share, "
                "of sensors or speed, or the same short circuit in all of them; compared with the "
                f"others it has one with a probability of {found.faulty[k, -1]:.2f}"
            )
            part = f"{machine(number)}: {severity(PHASES[own - 1])}"
            doubts.append(Doubt("machine", text, part))
    return found, end | found.report([*sides]), doubts


def compare(
    beliefs: Sequence[Beliefs],
    *,
    common: Mapping[str, float] = COMMON,
    balanced: float = BALANCED,
    faulty: float = FAULTY,
    scale: float = H_SCALE,
) -> Compared:
    """Compare the machines of one shaft.

    Args:
        beliefs: of each machine, of the same windows.
        common: standard deviation of a common error over that of a machine's own, by the beginning
            of its name; what is not named is not common.
        balanced: that of a common severity in all phases.
        faulty: probability that a machine has a short circuit.
        scale: of its severity.

    Raises:
        DataError: one machine only, other windows, or a belief without the three severities.
    """
    n = len(beliefs)
    if n < 2:
        raise DataError("a comparison takes two machines at least")
    if any(b.names[:3] != H for b in beliefs):
        raise DataError(f"a comparison takes beliefs of {', '.join(H)}, in this order")
    if len({b.mean.shape[0] for b in beliefs}) > 1:
        raise DataError("a comparison takes beliefs of the same windows")
    U = _common(beliefs, common, balanced)
    h, R = np.concatenate([b.mean[:, :3] for b in beliefs], axis=1), U @ _t(U)
    for k, b in enumerate(beliefs):
        at, own = slice(3 * k, 3 * k + 3), b.mean[:, :3]
        worst = NONLINEAR * np.abs(own - np.median(own, axis=1)[:, None]).max(1)
        R[:, at, at] += b.cov[:, :3, :3] + worst[:, None, None] ** 2 * np.eye(3)
    each = [_Hypothesis(f, n, faulty, scale, h, R) for f in _sets(n)]
    share = posterior(np.array([x.log for x in each]))
    probability, several = np.zeros((n, 4, h.shape[0])), np.zeros(h.shape[0])
    for x, w in zip(each, share, strict=True):
        found = dict(x.faults)
        for k in range(n):
            probability[k, 1 + found.get(k, -1)] += w
        several += w * (len(found) > 1)
    # a phase against the two others, in the mean of the machines
    contrast = np.tile(1.5 * np.eye(3) - 0.5, n) / n
    severities = _mixture(share, [(x.severity, x.variance) for x in each])
    alike = _mixture(share, [x.common(U, contrast) for x in each])
    by_machine = [np.moveaxis(v, 0, -1).reshape(n, 3, -1) for v in severities]
    return Compared(
        probability,
        several,
        np.array([by_machine[0], np.sqrt(by_machine[1])]),
        np.array([alike[0].T, np.sqrt(alike[1].T)]),
    )


def _common(beliefs: Sequence[Beliefs], common: Mapping[str, float], balanced: float) -> np.ndarray:
    """Return what common errors of unit variance do to all severities, (K, 3 n, c)."""
    n, K = len(beliefs), beliefs[0].mean.shape[0]
    factor = {x: v for x in beliefs[0].names for n, v in common.items() if x.startswith(n)}
    of = [x for x in factor if all(x in b.names for b in beliefs)]
    U = np.zeros((K, 3 * n, len(of) + 1))
    U[:, :, -1] = balanced
    for j, x in enumerate(of):
        at = [b.names.index(x) for b in beliefs]
        own = [b.cov[:, i, i] for i, b in zip(at, beliefs, strict=True)]
        size = factor[x] * np.sqrt(np.max(own, axis=0))
        for k, (i, b) in enumerate(zip(at, beliefs, strict=True)):
            slope = -b.cov[:, :3, i] / own[k].clip(1e-300)[:, None]
            U[:, 3 * k : 3 * k + 3, j] = slope * size[:, None]
    return U


def _sets(n: int) -> list[tuple[tuple[int, int], ...]]:
    """Return which machines have a short circuit in which phase, none first."""
    out: list[tuple[tuple[int, int], ...]] = [()]
    for f in range(1, TOGETHER + 1):
        for machines in itertools.combinations(range(n), f):
            phases = itertools.product(range(3), repeat=f)
            out += [tuple(zip(machines, p, strict=True)) for p in phases]
    return out


class _Hypothesis:
    """Short circuits of some machines, each in a phase.

    ``log`` is the logarithm of prior and likelihood, (K,); ``severity`` and ``variance`` are those
    of all machines' phases, (K, 3 n).
    """

    def __init__(
        self,
        faults: tuple[tuple[int, int], ...],
        n: int,
        faulty: float,
        scale: float,
        h: np.ndarray,
        R: np.ndarray,
    ) -> None:
        self.faults, self.h, f = faults, h, len(faults)
        at = [3 * m + p for m, p in faults]
        M = R.copy()
        M[:, at, at] += scale**2
        self.inverse = np.linalg.inv(M)
        weighed = np.einsum("nij,nj->ni", self.inverse, h)
        self.weighed = weighed
        m = scale**2 * weighed[:, at]
        v = scale**2 - scale**4 * self.inverse[:, at, at]
        self.severity, self.variance = np.zeros_like(h), np.zeros_like(h)
        ratio, z = _mills(m / np.sqrt(v))
        # half of a normal: the mean is shifted to what is positive
        self.severity[:, at] = m + np.sqrt(v) * ratio
        self.variance[:, at] = v * (1 - ratio * (ratio + m / np.sqrt(v)))
        prior = f * math.log(faulty / 3) + (n - f) * math.log(1 - faulty)
        fits = np.linalg.slogdet(M)[1] + np.einsum("ni,ni->n", h, weighed)
        if f == 2:
            a, b = at
            rho = -(scale**4) * self.inverse[:, a, b] / np.sqrt(v[:, 0] * v[:, 1])
            x, y = (m / np.sqrt(v)).T
            z = _log_both(x, y, rho, z.sum(1))[:, None]
        self.log = prior + f * math.log(2) - 0.5 * fits + z.sum(1)

    def common(self, U: np.ndarray, of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return sums of what common errors of columns U make, and their variances, (K, r).

        Args:
            U: (K, 3 n, c).
            of: factors of the sums, (r, 3 n).
        """
        G = of @ U
        back = G @ _t(U)  # covariances of the sums with the estimates
        mean = np.einsum("nri,ni->nr", back, self.weighed)
        var = (G**2).sum(2) - np.einsum("nri,nij,nrj->nr", back, self.inverse, back)
        return mean, var.clip(0.0)


def _mills(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return phi(x)/Phi(x) and log Phi(x)."""
    from scipy.special import log_ndtr

    log = log_ndtr(x)
    return np.exp(-0.5 * x**2 - 0.5 * math.log(2 * math.pi) - log), log


def _log_both(x: np.ndarray, y: np.ndarray, rho: np.ndarray, apart: np.ndarray) -> np.ndarray:
    """Return the logarithm of P(X < x, Y < y) of standard normal variables of a correlation.

    By Owen's function (Owen 1956, Ann. Math. Stat. 27, 1075); where it is too small for that,
    ``apart``: as if they were independent.
    """
    from scipy.special import ndtr, owens_t

    x, y = (np.where(v == 0, 1e-300, v) for v in (x, y))
    root = np.sqrt(1 - rho**2)
    p = 0.5 * (ndtr(x) + ndtr(y)) - 0.5 * (x * y < 0)
    p -= owens_t(x, (y / x - rho) / root) + owens_t(y, (x / y - rho) / root)
    return np.where(p > 1e-12, np.log(p.clip(1e-300)), apart)


def _mixture(
    share: np.ndarray, parts: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance over hypotheses of shares (j, n), each of means and variances (n, i)."""
    means, variances = (np.array(v) for v in zip(*parts, strict=True))
    mean = np.einsum("jn,jni->ni", share, means)
    variance = np.einsum("jn,jni->ni", share, variances + (means - mean) ** 2)
    return mean, variance


def _t(a: np.ndarray) -> np.ndarray:
    return a.transpose(0, 2, 1)
