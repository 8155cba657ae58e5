"""A short circuit that may be there: in no phase, or in one, with what each makes of the power.

Sensors with gain errors of half a per cent look like a severity of 2e-5 to 4e-5 in one phase, and
of more in all three at once.  At most one phase has a short circuit, so the three severities and
the energy of a window, jointly Gaussian in a filter that considers the gain errors, are conditioned
on the other two being zero.  With the estimate c of phase k and its standard deviation s, and a
severity that is half-normal of scale tau if the phase has one, the odds against a healthy machine
are those of the marginal likelihoods:

    2 s / sqrt(s^2 + tau^2) exp(m^2/(2 v)) Phi(m/sqrt(v)),
    v = s^2 tau^2/(s^2 + tau^2),   m = c v/s^2.

Nothing is decided here: power is the mean over the hypotheses, and its variance holds what they
differ by.  m and v are the severity, and its variance, where that phase is the faulty one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["FAULTY", "H_SCALE", "Hypotheses"]

FAULTY = 0.1  # probability that a machine has a short circuit when a recording begins
H_SCALE = 3e-3  # scale of the severity of one


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """What is known at the ends of n windows, by phase that may be the faulty one.

    Args:
        h, variance: severity of that phase if the others are healthy, (3, n).
        statistic: (h/sigma)^2 without the prior, zero for h < 0, (3, n).
        P, P_variance: mean power of the window if it is the faulty one, W and W^2, (3, n).
        odds: against a healthy machine, logarithms, (3, n).
        misfit: what none of these explains, (n,): chi-squared with two degrees of freedom if one
            of them is true, of the likeliest phase.
    """

    h: np.ndarray
    variance: np.ndarray
    statistic: np.ndarray
    P: np.ndarray
    P_variance: np.ndarray
    odds: np.ndarray
    misfit: np.ndarray

    @classmethod
    def of(cls, mean: np.ndarray, cov: np.ndarray) -> Hypotheses:
        """Condition the joint beliefs of three severities and the power on one faulty phase.

        Args:
            mean: h_a, h_b, h_c and P, (n, 4).
            cov: their covariances, (n, 4, 4).
        """
        n = mean.shape[0]
        c, s2, P, V, slope = (np.empty((3, n)) for _ in range(5))
        for k in range(3):
            zero, left = [i for i in range(3) if i != k], [k, 3]
            across = cov[:, left][:, :, zero]
            gain = np.linalg.solve(cov[:, zero][:, :, zero], across.transpose(0, 2, 1))
            gain = gain.transpose(0, 2, 1)
            m = mean[:, left] - np.einsum("nij,nj->ni", gain, mean[:, zero])
            C = cov[:, left][:, :, left] - gain @ across.transpose(0, 2, 1)
            c[k], s2[k], P[k], V[k] = m[:, 0], C[:, 0, 0], m[:, 1], C[:, 1, 1]
            slope[k] = C[:, 0, 1] / C[:, 0, 0]
        v = s2 * H_SCALE**2 / (s2 + H_SCALE**2)
        h = c * v / s2
        odds = np.log(FAULTY / 3 / (1 - FAULTY)) + np.log(2) + 0.5 * np.log(s2 / (s2 + H_SCALE**2))
        odds += h**2 / (2 * v) + _log_phi(h / np.sqrt(v))
        found = np.where(c > 0, c**2 / s2, 0.0)
        three = mean[:, :3], np.linalg.solve(cov[:, :3, :3], mean[:, :3, None])[..., 0]
        best = np.take_along_axis(found, odds.argmax(0)[None], 0)[0]
        left = np.einsum("ni,ni->n", *three) - best
        return cls(h, v, found, P + slope * (h - c), V + slope**2 * (v - s2), odds, left)

    @property
    def probability(self) -> np.ndarray:
        """Of no short circuit, and of one in each phase, (4, n)."""
        odds = np.vstack([np.zeros(self.odds.shape[1]), self.odds])
        share = np.exp(odds - odds.max(0))
        out: np.ndarray = share / share.sum(0)
        return out

    def severities(self) -> np.ndarray:
        """Severity of each phase and its standard deviation if one has a short circuit, (2, 3, n).

        The phase that is likelier not to be the faulty one keeps the standard deviation that it
        would have, so that a severity too small to be found is within the band.
        """
        share = np.exp(self.odds - self.odds.max(0))
        share /= share.sum(0)
        spread = share * (1 - share) * self.h**2
        return np.array([share * self.h, np.sqrt(self.variance + spread)])

    def power(self, P: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean power over the hypotheses, W, and its variance, W^2.

        Args:
            P, variance: of a healthy machine, (n,).
        """
        of, spread = np.vstack([P, self.P]), np.vstack([variance, self.P_variance])
        p = self.probability
        mean = (p * of).sum(0)
        return mean, (p * (spread + (of - mean) ** 2)).sum(0)


def _log_phi(x: np.ndarray) -> np.ndarray:
    """Logarithm of the standard normal distribution's function."""
    from scipy.special import log_ndtr

    out: np.ndarray = log_ndtr(x)
    return out
