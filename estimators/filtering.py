"""What all recursive filters share: running a step over a recording, and what comes out.

A filter is one CasADi function, a *step*: correct the belief with a sample, then carry it to the
next sample.  :func:`run` folds it over a recording, ``BLOCK`` samples in one call, in generated C
where there is a compiler; Python is not crossed for each sample.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from apu_casadi.backend import Caller, compiled
from apu_casadi.errors import EstimationError, SignalError
from apu_casadi.results import dataset
from apu_casadi.signals import Signal, Signals
from estimators.belief import Belief
from estimators.model import CHECK_TOL, FilterModel
from estimators.recording import Recording

if TYPE_CHECKING:
    import xarray as xr

__all__ = ["BLOCK", "STEP_IN", "STEP_OUT", "FilterResult", "FilterStep", "run"]

BLOCK = 100  # samples in one call
STEP_IN = ["m", "P", "u", "p", "y", "R", "dt"]
STEP_OUT = ["m1", "P1", "m_f", "P_f", "C", "nu", "S", "stats"]
"""Of a step: belief before the sample, inputs, parameters, sample, variances (< 0: not measured),
step to the next sample; then the predicted belief at the next sample, the filtered belief, the
cross-covariance of filtered state and next state, innovation, its covariance, and ``STATS``."""
STATS = ("check", "nis", "loglik", "measured")


@dataclass(frozen=True, eq=False)
class FilterStep:
    """A filter for a model: one function, and its compiled forms.

    Parameters
    ----------
    model : the model.
    function : Function ``STEP_IN`` -> ``STEP_OUT``.
    """

    model: FilterModel
    function: ca.Function


@dataclass(frozen=True, eq=False)
class FilterResult:
    """What a filter believed along a recording of K instants.

    Parameters
    ----------
    x, y : states and outputs.
    t : instants, s, shape (K,).
    mean, variance : filtered, shapes (nx, K).
    innovation, innovation_variance : measured minus predicted and its variance, shapes (ny, K);
        NaN where nothing was measured.
    nis : normalised innovation squared of each sample, shape (K,); chi-squared with ``measured``
        degrees of freedom if the filter is consistent.
    measured : number of outputs measured at each instant, shape (K,).
    loglik : log-likelihood of the recording.
    final : belief at the last instant, after its sample.
    predicted : belief at the last instant carried over ``dt`` = 0, for going on.
    cov : filtered covariances, shape (K, nx, nx); None unless kept.
    mean_pred, cov_pred : belief before each sample, shapes (nx, K), (K, nx, nx); None unless kept.
    cross : covariance of the filtered state at k and the predicted one at k+1, (K, nx, nx).
    """

    x: Signals
    y: Signals
    t: np.ndarray
    mean: np.ndarray
    variance: np.ndarray
    innovation: np.ndarray
    innovation_variance: np.ndarray
    nis: np.ndarray
    measured: np.ndarray
    loglik: float
    final: Belief
    cov: np.ndarray | None = None
    mean_pred: np.ndarray | None = None
    cov_pred: np.ndarray | None = None
    cross: np.ndarray | None = None

    def __getitem__(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return (mean, standard deviation) of one state, each of shape (K,)."""
        i = self.x.index(name)
        return self.mean[i], np.sqrt(self.variance[i])

    def to_dataset(self) -> xr.Dataset:
        """Return means, standard deviations (``<name>_sigma``), innovations and NIS, labelled."""
        signals, values = [], {}
        for i, s in enumerate(self.x):
            signals += [s, Signal(f"{s.name}_sigma", s.unit, f"standard deviation of {s.name}")]
            values[s.name] = self.mean[i]
            values[f"{s.name}_sigma"] = np.sqrt(self.variance[i])
        for i, s in enumerate(self.y):
            name = f"innovation_{s.name}"
            signals += [
                Signal(name, s.unit, f"measured minus predicted {s.name}"),
                Signal(f"{name}_sigma", s.unit, f"its standard deviation: {s.name}"),
            ]
            values[name] = self.innovation[i]
            values[f"{name}_sigma"] = np.sqrt(self.innovation_variance[i])
        signals += [
            Signal("nis", "1", "normalised innovation squared"),
            Signal("measured", "1", "number of outputs measured"),
        ]
        values |= {"nis": self.nis, "measured": self.measured}
        return dataset(
            {"time": self.t},
            {"time": values},
            signals=signals,
            attrs={"loglik": float(self.loglik)},
        )


@lru_cache(maxsize=64)
def _block(step: FilterStep, full: bool, backend: str | None) -> Caller:
    """``BLOCK`` steps in one function; without the matrices unless ``full``."""
    nx, nu, np_, _, ny = step.model.sizes
    s = [ca.MX.sym(n, *shape) for n, shape in zip(
        STEP_IN, [(nx, 1), (nx, nx), (nu, 1), (np_, 1), (ny, 1), (ny, 1), (1, 1)], strict=True
    )]  # fmt: skip
    out = dict(zip(STEP_OUT, step.function(*s), strict=True))
    kept = [out["m_f"], ca.diag(out["P_f"]), out["nu"], ca.diag(out["S"]), out["stats"]]
    if full:
        kept += [ca.vec(out["P_f"]), ca.vec(out["C"])]
    one = ca.Function(
        f"{step.function.name()}_kept", s, [out["m1"], out["P1"], *(ca.densify(k) for k in kept)]
    )
    many = one.mapaccum(f"{step.function.name()}_block{'_full' if full else ''}", BLOCK, 2)
    return Caller(compiled(many, backend=backend), copy=False)


def run(
    step: FilterStep,
    prior: Belief,
    data: Recording,
    *,
    full: bool = False,
    backend: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FilterResult:
    """Run a filter over a recording.

    Parameters
    ----------
    step : the filter.
    prior : belief at the first instant, before its sample.
    data : the recording.
    full : keep the covariances and what smoothers need; 3 nx^2 numbers for each instant.
    backend : see :func:`apu_casadi.backend.compiled`.
    progress : called with (done, total) instants after every block.

    Raises
    ------
    DataError : the recording does not fit the model.
    SignalError : the prior is of other states.
    EstimationError : the model could not be evaluated, or the belief is no longer finite; names
        the instant and the state.
    """
    model = step.model
    data.check(model)
    if prior.x.names != model.x.names:
        raise SignalError(
            f"prior of {', '.join(prior.x.names)}; {model.name} has {', '.join(model.x.names)}"
        )
    call = _block(step, full, backend)
    nx, _, _, _, ny = model.sizes
    K = data.size
    n_blocks = -(-K // BLOCK)
    pad = n_blocks * BLOCK - K
    missing = np.isnan(data.y)
    # a padded sample measures nothing and lasts no time: the belief stays
    y = np.pad(np.where(missing, 0.0, data.y), ((0, 0), (0, pad)))
    R = np.pad(np.where(missing, -1.0, data.variance), ((0, 0), (0, pad)), constant_values=-1.0)
    u = np.pad(data.u, ((0, 0), (0, pad)), mode="edge")
    dt = np.pad(data.dt, (0, pad))[None, :]
    p = np.repeat(data.p[:, None], BLOCK, axis=1)
    mean, var = np.empty((nx, K)), np.empty((nx, K))
    nu, S = np.empty((ny, K)), np.empty((ny, K))
    stats = np.empty((len(STATS), K))
    covs = [np.empty((K, nx, nx)) for _ in range(3)] if full else None
    mean_pred = np.empty((nx, K)) if full else None
    m, P = prior.mean.copy(), prior.cov.copy()
    for b in range(n_blocks):
        s = slice(b * BLOCK, (b + 1) * BLOCK)
        n = min(BLOCK, K - b * BLOCK)
        r = slice(b * BLOCK, b * BLOCK + n)
        out = call(m, P, u[:, s], p, y[:, s], R[:, s], dt[:, s])
        m1, P1 = out[0], out[1].reshape(nx, BLOCK, nx) if nx else out[1]
        for target, source in ((mean, out[2]), (var, out[3]), (nu, out[4]), (S, out[5])):
            target[:, r] = source[:, :n]
        stats[:, r] = out[6][:, :n]
        _believable(model, data, stats[:, r], mean[:, r], var[:, r], b * BLOCK)
        if covs is not None and mean_pred is not None:
            # columns are vec(P), column-major; P_f is symmetric, C is not
            covs[0][r] = out[7][:, :n].T.reshape(n, nx, nx)
            covs[2][r] = out[8][:, :n].T.reshape(n, nx, nx).transpose(0, 2, 1)
            mean_pred[:, r.start] = m
            covs[1][r.start] = P
            mean_pred[:, r.start + 1 : r.stop] = m1[:, : n - 1]
            covs[1][r.start + 1 : r.stop] = P1[:, : n - 1].transpose(1, 0, 2)
        m, P = m1[:, -1].copy(), P1[:, -1].copy()
        if progress is not None:
            progress(b * BLOCK + n, K)
    nu[missing], S[missing] = np.nan, np.nan
    return FilterResult(
        model.x, model.y, data.t, mean, var, nu, S, stats[1], stats[3], float(stats[2].sum()),
        Belief(model.x, m, (P + P.T) / 2),
        *((covs[0], mean_pred, covs[1], covs[2]) if covs is not None else ()),
    )  # fmt: skip


def _believable(
    model: FilterModel,
    data: Recording,
    stats: np.ndarray,
    mean: np.ndarray,
    var: np.ndarray,
    start: int,
) -> None:
    """Refuse a block in which a check failed or a number is lost."""
    failed = ~(stats[0] <= CHECK_TOL)
    # rounding may leave a tiny negative variance of what is known exactly
    floor = -1e-12 * (np.square(model.x.nominals) + np.square(mean).max(1, initial=0.0))
    lost = ~np.isfinite(mean) | ~(var >= floor[:, None])
    bad = failed | lost.any(0)
    if not bad.any():
        return
    k = int(np.argmax(bad))
    at = f"{model.name} at t = {data.t[start + k]:.9g} s (sample {start + k})"
    if lost[:, k].any():
        i = int(np.argmax(lost[:, k]))
        raise EstimationError(
            f"{at}: the belief of {model.x.names[i]} is lost (mean {mean[i, k]:.6g}, variance "
            f"{var[i, k]:.3g}, model check {stats[0, k]:.1e}); the sample does not fit the model, "
            "or noise and prior are far too small"
        )
    raise EstimationError(
        f"{at}: the model's check is {stats[0, k]:.1e} > {CHECK_TOL:.0e}; the belief left the "
        "region where the model can be solved: check prior, inputs and outliers"
    )
