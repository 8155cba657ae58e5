"""What is believed of a state: mean and covariance, by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from apu_casadi.core.errors import SignalError, nearest
from apu_casadi.core.signals import Signals

__all__ = ["Belief"]


def _not_negative(sigma: Mapping[str, float]) -> None:
    for name, value in sigma.items():
        if not value >= 0:
            raise SignalError(f"belief: standard deviation of {name} must be >= 0, got {value!r}")


@dataclass(frozen=True, eq=False)
class Belief:
    """A Gaussian belief of named states.

    Args:
        x: the states.
        mean: shape (nx,).
        cov: covariance, shape (nx, nx), symmetric, positive semidefinite.
        root: lower triangular L with L L' = cov, where a filter knows it: it holds twice as many
            digits, which count where some directions are far better known than others.

    Raises:
        SignalError: wrong shapes, values not finite, or not a covariance; names the state.
    """

    x: Signals
    mean: np.ndarray
    cov: np.ndarray
    root: np.ndarray | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """Check shapes, finiteness, symmetry and that no direction has negative variance."""
        n = len(self.x)
        for name in ("mean", "cov"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))
        if np.shape(self.mean) != (n,) or np.shape(self.cov) != (n, n):
            raise SignalError(
                f"belief of {n} states: mean ({n},) and cov ({n}, {n}) expected, got "
                f"{np.shape(self.mean)} and {np.shape(self.cov)}"
            )
        bad = [
            s
            for s, m, v in zip(self.x.names, self.mean, np.diag(self.cov), strict=True)
            if not (np.isfinite(m) and np.isfinite(v) and v >= 0)
        ]
        if bad:
            raise SignalError(
                f"belief: mean not finite, or variance negative or not finite, of {', '.join(bad)}"
            )
        if not np.isfinite(self.cov).all():
            i, j = (self.x.names[k] for k in np.argwhere(~np.isfinite(self.cov))[0])
            raise SignalError(f"belief: the covariance of {i} and {j} is not finite")
        # judged in correlations, so that units do not matter
        sigma = np.sqrt(np.diag(self.cov))
        scale = np.where(sigma > 0, sigma, 1.0)
        corr = self.cov / np.outer(scale, scale)
        if not np.allclose(corr, corr.T, atol=1e-9):
            raise SignalError("belief: the covariance is not symmetric")
        low = float(np.linalg.eigvalsh((corr + corr.T) / 2).min()) if n else 0.0
        if low < -1e-9:
            raise SignalError(
                f"belief: no covariance, its correlations have the eigenvalue {low:.1e} < 0"
            )
        if self.root is not None:
            L = np.asarray(self.root, dtype=float) / scale[:, None]
            if L.shape != (n, n) or not np.allclose(L @ L.T, corr, rtol=0, atol=1e-9):
                raise SignalError("belief: the root is none of the covariance; leave it out")

    @classmethod
    def of(cls, x: Signals, mean: Mapping[str, float], sigma: Mapping[str, float]) -> Belief:
        """Make an uncorrelated belief from means and standard deviations by name.

        Raises:
            SignalError: unknown or missing names, a negative standard deviation.
        """
        _not_negative(sigma)
        s = Signals(
            [type(q)(q.name, q.unit, q.doc, None, q.nominal) for q in x]
        )  # a standard deviation has no default
        return cls(x, x.pack(mean), np.diag(s.pack(sigma) ** 2))

    @classmethod
    def found(cls, x: Signals, mean: np.ndarray, cov: np.ndarray) -> Belief:
        """Return what a filter has found, which it judges itself: nothing is checked."""
        made = object.__new__(cls)
        made.__dict__.update(x=x, mean=mean, cov=cov, root=None)
        return made

    @property
    def sigma(self) -> np.ndarray:
        """Standard deviations, shape (nx,)."""
        return np.sqrt(np.diag(self.cov))

    def __getitem__(self, name: str) -> tuple[float, float]:
        """Return (mean, standard deviation) of one state."""
        i = self.x.index(name)
        return float(self.mean[i]), float(np.sqrt(self.cov[i, i]))

    def change(
        self, mean: Mapping[str, float] | None = None, sigma: Mapping[str, float] | None = None
    ) -> Belief:
        """Return the belief with some means, and some (then uncorrelated) standard deviations.

        Raises:
            SignalError: unknown name, a negative standard deviation.
        """
        _not_negative(sigma or {})
        m, P = self.mean.copy(), self.cov.copy()
        for name, value in (mean or {}).items():
            m[self.x.index(name)] = value
        for name, value in (sigma or {}).items():
            i = self.x.index(name)
            P[i, :] = P[:, i] = 0.0
            P[i, i] = value**2
        return Belief(self.x, m, P)

    def marginal(self, names: Any) -> Belief:
        """Return the belief of some states.

        Raises:
            SignalError: unknown name, with the nearest one.
        """
        unknown = [f"{n} {nearest(n, self.x.names)}" for n in names if n not in self.x]
        if unknown:
            raise SignalError(f"belief: unknown {'; '.join(unknown)}")
        i = self.x.indices(names)
        return Belief(Signals([self.x[k] for k in i]), self.mean[i], self.cov[np.ix_(i, i)])
