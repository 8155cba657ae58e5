"""A short circuit that may be there: in no phase, or in one, with what each makes of the power.

Sensors with gain errors of half a per cent look like a severity of 2e-5 to 4e-5 in one phase, and
of more in all three at once.  At most one phase has a short circuit, so the three severities and
the energy of a window, jointly Gaussian in a filter that considers the gain errors, are conditioned
on the others being zero: on two of them, or, in a healthy machine, on all three.  With the estimate
c of phase k and its standard deviation s, and a severity that is normal of mean m0 and scale tau,
and positive, if the phase has one, the odds against a healthy machine are those of the marginal
likelihoods:

    N(c; m0, s^2 + tau^2) / N(c; 0, s^2) Phi(m/sqrt(v)) / Phi(m0/tau),
    v = s^2 tau^2/(s^2 + tau^2),   m = (c tau^2 + m0 s^2)/(s^2 + tau^2).

Nothing is decided here: power is the mean over the hypotheses, and its variance holds what they
differ by.  m and v are the severity, and its variance, where that phase is the faulty one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from apu_casadi.core.checked import number
from apu_casadi.core.errors import ParameterError
from estimators.information.posterior import posterior

__all__ = ["COMMON", "FAULTY", "H_SCALE", "Hypotheses", "SeverityPrior", "loose_in_common"]

FAULTY = 0.1  # probability that a machine has a short circuit when a recording begins
H_SCALE = 3e-3  # scale of the severity of one
#: Standard deviation of what all three severities have in common, beside what the filter claims: it
#: takes that for the third of one severity (``H_COMMON_TIME``), which a sensor's error is not.
COMMON = 3e-4


@dataclass(frozen=True)
class SeverityPrior:
    """What is known of a short circuit before a recording begins.

    Args:
        probability: that the machine has one.
        mean, scale: of the severity of each phase, if it is the faulty one: normal and positive,
            so that of mean 0 it is half-normal.

    Raises:
        ParameterError: a probability that is not between 0 and 1, a mean below 0, a scale that is
            not positive.
    """

    probability: float = FAULTY
    mean: tuple[float, float, float] = (0.0,) * 3
    scale: tuple[float, float, float] = (H_SCALE,) * 3

    def __post_init__(self) -> None:
        values = [("probability", self.probability)]
        values += [(n, v) for n in ("mean", "scale") for v in getattr(self, n)]
        for n, v in values:
            x = number(f"SeverityPrior.{n}", v, error=ParameterError)
            good = x >= 0 if n == "mean" else 0 < x < (1 if n == "probability" else math.inf)
            if not (good and math.isfinite(x)):
                raise ParameterError(
                    f"prior of a short circuit: {n} = {x!r}; a probability in (0, 1), means >= 0 "
                    "and scales > 0 are expected"
                )


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """What is known at the ends of n windows, by phase that may be the faulty one.

    Args:
        h, variance: severity of that phase if the others are healthy, (3, n).
        statistic: (h/sigma)^2 without the prior, zero for h < 0, (3, n).
        P, P_variance: mean power of the window if it is the faulty one, W and W^2, (3, n).
        healthy: mean power of a healthy machine and its variance, (2, n).
        odds: against a healthy machine, logarithms, (3, n).
        misfit: what none of these explains, (n,): chi-squared with two degrees of freedom if one
            of them is true, of the likeliest phase.
    """

    h: np.ndarray
    variance: np.ndarray
    statistic: np.ndarray
    P: np.ndarray
    P_variance: np.ndarray
    healthy: np.ndarray
    odds: np.ndarray
    misfit: np.ndarray

    @classmethod
    def of(
        cls, mean: np.ndarray, cov: np.ndarray, prior: SeverityPrior | None = None
    ) -> Hypotheses:
        """Condition the joint beliefs of three severities and the power on one faulty phase.

        Args:
            mean: h_a, h_b, h_c and P, (n, 4).
            cov: their covariances, (n, 4, 4).
            prior: what is known beforehand.
        """
        n, prior = mean.shape[0], SeverityPrior() if prior is None else prior
        c, s2, P, V, slope = (np.empty((3, n)) for _ in range(5))
        for k in range(3):
            m, C = _without(mean, cov, [i for i in range(3) if i != k])
            c[k], s2[k], P[k], V[k] = m[:, 0], C[:, 0, 0], m[:, 1], C[:, 1, 1]
            slope[k] = C[:, 0, 1] / C[:, 0, 0]
        m, C = _without(mean, cov, [0, 1, 2])
        m0, tau2 = np.array(prior.mean)[:, None], np.array(prior.scale)[:, None] ** 2
        v = s2 * tau2 / (s2 + tau2)
        h = (c * tau2 + m0 * s2) / (s2 + tau2)
        odds = math.log(prior.probability / 3 / (1 - prior.probability))
        odds = odds - _log_phi(m0 / np.sqrt(tau2)) + 0.5 * np.log(s2 / (s2 + tau2))
        odds = odds + (c**2 / s2 - (c - m0) ** 2 / (s2 + tau2)) / 2 + _log_phi(h / np.sqrt(v))
        found = np.where(c > 0, c**2 / s2, 0.0)
        three = mean[:, :3], np.linalg.solve(cov[:, :3, :3], mean[:, :3, None])[..., 0]
        best = np.take_along_axis(found, odds.argmax(0)[None], 0)[0]
        left = np.einsum("ni,ni->n", *three) - best
        healthy = np.array([m[:, 0], C[:, 0, 0]])
        return cls(h, v, found, P + slope * (h - c), V + slope**2 * (v - s2), healthy, odds, left)

    @property
    def probability(self) -> np.ndarray:
        """Of no short circuit, and of one in each phase, (4, n)."""
        odds = np.vstack([np.zeros(self.odds.shape[1]), self.odds])
        return posterior(odds)

    def severities(self) -> np.ndarray:
        """Severity of each phase and its standard deviation if one has a short circuit, (2, 3, n).

        The phase that is likelier not to be the faulty one keeps the standard deviation that it
        would have, so that a severity too small to be found is within the band.
        """
        share = posterior(self.odds)
        spread = share * (1 - share) * self.h**2
        return np.array([share * self.h, np.sqrt(self.variance + spread)])

    def power(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean power over the hypotheses, W, and its variance, W^2."""
        of = np.vstack([self.healthy[:1], self.P])
        spread = np.vstack([self.healthy[1:], self.P_variance])
        p = self.probability
        mean = (p * of).sum(0)
        return mean, (p * (spread + (of - mean) ** 2)).sum(0)


def _without(mean: np.ndarray, cov: np.ndarray, zero: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Means and covariances of the others if these severities are zero."""
    left = [i for i in range(4) if i not in zero]
    across = cov[:, left][:, :, zero]
    gain = np.linalg.solve(cov[:, zero][:, :, zero], across.transpose(0, 2, 1)).transpose(0, 2, 1)
    m = mean[:, left] - np.einsum("nij,nj->ni", gain, mean[:, zero])
    return m, cov[:, left][:, :, left] - gain @ across.transpose(0, 2, 1)


def loose_in_common(cov: np.ndarray) -> np.ndarray:
    """Return covariances of three severities, power and more, (n, m, m), with ``COMMON`` added.

    The others go with it as they do in the filter.
    """
    e = np.repeat([1 / 3, 0.0], [3, cov.shape[1] - 3])
    g = cov @ e / np.einsum("i,nij,j->n", e, cov, e)[:, None]
    out: np.ndarray = cov + COMMON**2 * g[:, :, None] * g[:, None, :]
    return out


def _log_phi(x: np.ndarray) -> np.ndarray:
    """Logarithm of the standard normal distribution's function."""
    from scipy.special import log_ndtr

    out: np.ndarray = log_ndtr(x)
    return out
