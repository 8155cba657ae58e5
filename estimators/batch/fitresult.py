"""What a fit returns: estimates, their uncertainty, and the profile of a likelihood."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from apu_casadi.core.errors import ParameterError, nearest
from estimators.information.consistency import above, sigmas

__all__ = ["FitResult", "FittedRecording", "Profile"]


@dataclass(frozen=True, eq=False)
class FittedRecording:
    """What the fit says of one recording of K samples.

    Args:
        t: instants, s, shape (K,).
        x, w: most likely states and noises, shapes (nx, K), (nw, K).
        y: outputs of the fitted model, shape (ny, K).
        residual: (measured - y)/sigma, NaN where nothing was measured, shape (ny, K).
    """

    t: np.ndarray
    x: np.ndarray
    w: np.ndarray
    y: np.ndarray
    residual: np.ndarray


@dataclass(frozen=True, eq=False)
class FitResult:
    """Estimated parameters and what is known of their errors.

    Args:
        names: the n estimated parameters; own ones of recording r are ``name[r]``.
        estimate: their values, shape (n,).
        covariance: shape (n, n), with the considered parameters' part.  Infinite variance and NaN
            covariances where the data leave a direction open.
        noise_covariance: without the considered parameters' part.
        sensitivity: of the estimate to each considered parameter, shape (n, number considered).
        considered: names of the considered parameters.
        undetermined, weak: directions that the data do not, or hardly, determine, in words.
        at_bound: parameters that ended at a bound; intervals do not hold for them.
        loglik: log-likelihood at the estimate, states and noises at their most likely values.
        chi2, freedom: sum of squared normalised residuals, noises and prior errors, and the number
            of degrees of freedom that it should have.
        recordings: fit of each recording.
        iterations: of the optimiser.
        run: what a profile needs to go on.
    """

    names: tuple[str, ...]
    estimate: np.ndarray
    covariance: np.ndarray
    noise_covariance: np.ndarray
    sensitivity: np.ndarray
    considered: tuple[str, ...]
    undetermined: tuple[str, ...]
    weak: tuple[str, ...]
    at_bound: tuple[str, ...]
    loglik: float
    chi2: float
    freedom: int
    recordings: tuple[FittedRecording, ...]
    iterations: int
    run: Any = field(repr=False)

    def index(self, name: str) -> int:
        """Return the position of a parameter."""
        if name not in self.names:
            raise ParameterError(f"no estimate of {name!r} {nearest(name, self.names)}")
        return self.names.index(name)

    def __getitem__(self, name: str) -> tuple[float, float]:
        """Return (estimate, standard error) of one parameter."""
        i = self.index(name)
        return float(self.estimate[i]), float(self.sigma[i])

    @property
    def values(self) -> dict[str, float]:
        """Estimates by name."""
        return dict(zip(self.names, self.estimate.tolist(), strict=True))

    @property
    def sigma(self) -> np.ndarray:
        """Standard errors, shape (n,); infinite where undetermined."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> np.ndarray:
        """Correlations of the estimates, shape (n, n); NaN where undetermined."""
        s = np.where(np.isfinite(self.sigma), self.sigma, np.nan)
        return np.asarray(self.covariance / np.outer(s, s))

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Return the confidence interval of one parameter, from its standard error."""
        m, s = self[name]
        z = sigmas(level)
        return m - z * s, m + z * s

    @cached_property
    def p_value(self) -> float:
        """Probability of a chi2 at least this large if model and sigmas are right."""
        return float(above(self.chi2, self.freedom)) if self.freedom > 0 else math.nan


@dataclass(frozen=True, eq=False)
class Profile:
    """Profile likelihood of one parameter: everything else re-fitted at each value.

    Args:
        name: the parameter.
        values: where it was held, increasing, shape (m,).
        drop: twice the loss of log-likelihood there, shape (m,).
        level: of the interval.
        lower, upper: its ends; a bound where the threshold is not reached within it, infinite where
            the likelihood never falls so far.
    """

    name: str
    values: np.ndarray
    drop: np.ndarray
    level: float
    lower: float
    upper: float
