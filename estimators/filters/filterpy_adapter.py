"""Our models in filterpy's filters, for people who know filterpy, and as an independent check.

filterpy is not needed otherwise; it is imported when a function here is called.

What to know of filterpy (2.0.0):

- ``update`` of its unscented filter uses the points that the last ``predict`` drew.  Called first,
  it sees points that are all zero; called twice in a row, it takes the prior's points for the
  posterior.  The filter returned here draws them again before each ``update``.
- ``Q`` is one matrix for all steps, whatever ``dt`` is.  Here it is set at each ``predict``.
- Its noises of transition and output are independent.  A noise w that enters both (an input that
  is measured with noise and drives both) cannot be said, and is refused here.
- It has no missing values: ``update(None)`` leaves a whole sample out, NaN spoils everything.  NaN
  in a sample is refused here.
- ``rts_smoother`` of the unscented filter ignores its argument ``Qs``: it takes the last ``Q`` for
  all steps.  Use :func:`estimators.batch.smoother.rts_smoother`.
- ``FixedLagSmoother`` begins its gains with the covariance after the sample instead of before it,
  and takes the present gain for all lags: on a random system of three states it is off by standard
  deviations.  Use :func:`estimators.batch.smoother.fixed_lag_smoother`.
- ``MMAEFilterBank`` takes single components of the mean for the mean when it forms the covariance;
  ``IMMEstimator`` calls ``update(z)``, which extended filters do not have.  The extended filter
  here does.
- Each step goes through Python once for each point, which takes tens of times longer than
  :func:`estimators.filters.ukf.unscented_kalman_filter`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.backend import compiled
from apu_casadi.core.calling import Caller
from apu_casadi.core.errors import DataError, EstimationError, SignalError
from apu_casadi.core.sharing import Rebuilt, building
from estimators.filters.belief import Belief
from estimators.filters.ukf import PointSet
from estimators.models.filtermodel import CHECK_TOL, FilterModel
from estimators.models.recording import Recording

__all__ = ["filterpy_ekf", "filterpy_ukf", "run_filterpy"]


class _Evaluated(Rebuilt):
    """f and g of a model with numbers: values, Jacobians and process noise, checked."""

    @building
    def __init__(
        self, model: FilterModel, p: Mapping[str, float] | None, backend: str | None
    ) -> None:
        """Refuse what filterpy cannot express, compile the rest."""
        if model.output.sparsity_jac(3, 0).nnz():
            J = ca.DM(model.output.sparsity_jac(3, 0), 1)
            names = [s.name for i, s in enumerate(model.w) if J[:, i].nnz()]
            raise EstimationError(
                f"{model.name}: the noises {', '.join(names)} enter the output, and filterpy knows "
                "no noise that output and transition share; use estimators.filters.ekf "
                "or estimators.filters.ukf, or leave noisy_inputs() out"
            )
        if model.consider:
            raise EstimationError(
                f"{model.name}: filterpy knows no considered states ({', '.join(model.consider)})"
            )
        bound = np.isfinite(model.lower) | np.isfinite(model.upper)
        if bound.any():
            names = [n for n, b in zip(model.x.names, bound, strict=True) if b]
            raise EstimationError(f"{model.name}: filterpy knows no bounds ({', '.join(names)})")
        self.model, self.p = model, model.p.pack(p or {})
        model = model.expanded()
        x, u, q, w, dt = model.symbols()
        nw = w.shape[0]
        x1, check = model.transition(x, u, q, w, dt)
        G = ca.jacobian(x1, w)
        Q = ca.diag(ca.DM(model.walk**2)) * dt + (G @ G.T if nw else 0)
        F = ca.jacobian(x1, x)
        y, check_y = model.output(x, u, q, w)
        H = ca.jacobian(y, x)
        zero = ca.DM.zeros(nw)

        def caller(name: str, args: list[Any], out: list[Any]) -> Caller:
            if nw:
                out = ca.substitute(out, [w], [ca.MX(zero)])
            fun = ca.Function(f"{model.name}_{name}", args, [ca.densify(o) for o in out])
            return Caller(compiled(fun, backend=backend))

        self._f = caller("f", [x, u, q, dt], [x1, check])
        self._fd = caller("fd", [x, u, q, dt], [F, Q, check])
        self._g = caller("g", [x, u, q], [y, check_y])
        self._gd = caller("gd", [x, u, q], [H, check_y])

    def inputs(self, u: Any) -> np.ndarray:
        """u by name, or as a vector."""
        if isinstance(u, Mapping) or u is None:
            return self.model.u.pack(u or {})
        u = np.asarray(u, dtype=float)
        if u.shape != (len(self.model.u),):
            raise SignalError(
                f"{self.model.name}: inputs of shape ({len(self.model.u)},) or by name expected "
                f"({', '.join(self.model.u.names)}), got shape {u.shape}"
            )
        return np.asarray(u)

    def _checked(self, out: tuple[np.ndarray, ...], what: str) -> tuple[np.ndarray, ...]:
        check = float(out[-1][0])
        if not (check <= CHECK_TOL and all(np.isfinite(o).all() for o in out)):
            raise EstimationError(
                f"{self.model.name}: {what} cannot be evaluated there (check {check:.1e})"
            )
        return out[:-1]

    def transition(self, x: np.ndarray, u: Any, dt: float) -> np.ndarray:
        """x1."""
        return self._checked(self._f(x, self.inputs(u), self.p, dt), "the transition")[0]

    def transition_jacobian(
        self, x: np.ndarray, u: Any, dt: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """(F, Q)."""
        F, Q = self._checked(self._fd(x, self.inputs(u), self.p, dt), "the transition's Jacobian")
        return F.reshape(x.size, x.size), Q.reshape(x.size, x.size)

    def output(self, x: np.ndarray, u: Any) -> np.ndarray:
        """y, shape (ny,)."""
        return self._checked(self._g(x, self.inputs(u), self.p), "the output")[0].reshape(-1)

    def output_jacobian(self, x: np.ndarray, u: Any) -> np.ndarray:
        """H, shape (ny, nx)."""
        out = self._checked(self._gd(x, self.inputs(u), self.p), "the output's Jacobian")[0]
        return out.reshape(len(self.model.y), x.size)

    def sample(self, z: Any) -> np.ndarray:
        """Refuse what filterpy would take for a number."""
        z = np.asarray(z, dtype=float).reshape(-1)
        missing = [n for n, v in zip(self.model.y.names, z, strict=True) if not np.isfinite(v)]
        if missing:
            raise DataError(
                f"{self.model.name}: {', '.join(missing)} not measured; filterpy takes a sample "
                "whole or not at all (z = None): leave the others out by measure(), or use "
                "estimators.filters.ekf or estimators.filters.ukf, where NaN is the normal case"
            )
        return np.asarray(z)

    def noise(self, sigma: Mapping[str, float]) -> np.ndarray:
        """R from standard deviations by name."""
        names = self.model.y.names
        unknown = [n for n in sigma if n not in names]
        missing = [n for n in names if n not in sigma]
        if unknown or missing:
            raise SignalError(
                f"sigma: one for each of {', '.join(names)} expected; "
                f"unknown: {', '.join(unknown) or '-'}; missing: {', '.join(missing) or '-'}"
            )
        return np.diag([float(sigma[n]) ** 2 for n in names])


def _check_prior(model: FilterModel, prior: Belief) -> None:
    if prior.x.names != model.x.names:
        raise SignalError(
            f"prior of {', '.join(prior.x.names)}; {model.name} has {', '.join(model.x.names)}"
        )


def _mean(model: FilterModel) -> Any:
    """Mean of outputs at weighted points, angles about the first; None: filterpy's own."""
    if not model.angles:
        return None
    return lambda z, weights: z[0] + weights @ model.innovation(z.T, z[:1].T).T


def filterpy_ukf(
    model: FilterModel,
    prior: Belief,
    sigma: Mapping[str, float],
    *,
    p: Mapping[str, float] | None = None,
    points: str = "cubature",
    alpha: float = 1.0,
    beta: float = 2.0,
    kappa: float = 0.0,
    backend: str | None = None,
) -> Any:
    """Return a ``filterpy.kalman.UnscentedKalmanFilter`` of a model.

    Use ``kf.predict(dt=..., u=...)`` and ``kf.update(z, u=...)``, inputs by name or as a vector;
    the first call may be either.  Noise w of the transition enters ``Q`` by its Jacobian at the
    mean.

    Args:
        model: the model; no noise in its output, no bounds, no considered states.
        prior: where the filter starts.
        sigma: standard deviations of the measurement noise by output name.
        p: known parameters by name, where the model gives no default.
        points, alpha, beta, kappa: as :func:`estimators.filters.ukf.ukf_step`; the scaled points
            are filterpy's ``MerweScaledSigmaPoints``, and the cubature points its special case.
        backend: see :func:`apu_casadi.core.backend.compiled`.

    Raises:
        EstimationError: the model has what filterpy cannot express.
        SignalError: prior, sigma, p or inputs do not fit the model.
        ParameterError: impossible points.
        DataError: by ``update``, if a value of the sample is missing.
    """
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    _check_prior(model, prior)
    nx, ny = len(model.x), len(model.y)
    PointSet.of(nx, points, alpha, beta, kappa)
    ours = _Evaluated(model, p, backend)
    if points == "cubature":
        alpha, beta, kappa = 1.0, 0.0, 0.0

    class Adapted(UnscentedKalmanFilter):
        """filterpy's filter, with Q of each step and points of the present belief."""

        def predict(self, dt: Any = None, UT: Any = None, fx: Any = None, **fx_args: Any) -> None:
            """Carry the belief over ``dt`` s; ``u`` are the inputs."""
            step = self._dt if dt is None else dt
            self.Q = ours.transition_jacobian(self.x, fx_args.get("u"), step)[1]
            super().predict(dt, UT, fx, **fx_args)

        def update(
            self, z: Any, R: Any = None, UT: Any = None, hx: Any = None, **hx_args: Any
        ) -> None:
            """Take a sample; None for none, NaN is refused."""
            if z is not None:
                z = ours.sample(z)
                self.sigmas_f = self.points_fn.sigma_points(self.x, self.P)
            super().update(z, R, UT, hx, **hx_args)

    kf = Adapted(
        nx,
        ny,
        0.0,
        lambda x, u=None: ours.output(x, u),
        lambda x, dt, u=None: ours.transition(x, u, dt),
        MerweScaledSigmaPoints(nx, alpha, beta, kappa),
        z_mean_fn=_mean(model),
        residual_z=model.innovation if model.angles else None,
    )
    kf.x, kf.P, kf.R = prior.mean.copy(), prior.cov.copy(), ours.noise(sigma)
    return kf


def filterpy_ekf(
    model: FilterModel,
    prior: Belief,
    sigma: Mapping[str, float],
    *,
    p: Mapping[str, float] | None = None,
    backend: str | None = None,
) -> Any:
    """Return a ``filterpy.kalman.ExtendedKalmanFilter`` of a model, with exact Jacobians.

    Use ``kf.predict(dt=..., u=...)`` and ``kf.update(z, u=...)``; the functions that filterpy asks
    for at each call are ours.

    Parameters and errors : as :func:`filterpy_ukf`.
    """
    from filterpy.kalman import ExtendedKalmanFilter

    _check_prior(model, prior)
    ours = _Evaluated(model, p, backend)

    class Adapted(ExtendedKalmanFilter):
        """filterpy's filter with f, g and their Jacobians built in."""

        x: Any

        def predict_x(self, u: Any = 0) -> None:
            """Carry the mean with the model itself, as filterpy's documentation asks for."""
            inputs, dt = u
            self.F, self.Q = ours.transition_jacobian(self.x, inputs, dt)
            self.x = ours.transition(self.x, inputs, dt)

        def predict(self, u: Any = None, dt: float = 0.0) -> None:
            """Carry the belief over ``dt`` s; ``u`` are the inputs."""
            super().predict((u, dt))

        def update(self, z: Any, u: Any = None, R: Any = None, **more: Any) -> None:
            """Take a sample; None for none, NaN is refused."""
            if z is not None:
                z = ours.sample(z)
            super().update(
                z,
                more.pop("HJacobian", lambda x: ours.output_jacobian(x, u)),
                more.pop("Hx", lambda x: ours.output(x, u)),
                R,
                residual=more.pop("residual", model.innovation if model.angles else np.subtract),
                **more,
            )

    kf = Adapted(len(model.x), len(model.y))
    kf.x, kf.P, kf.R = prior.mean.copy(), prior.cov.copy(), ours.noise(sigma)
    return kf


def run_filterpy(kf: Any, data: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Run a filter of :func:`filterpy_ukf` or :func:`filterpy_ekf` over a recording.

    Returns:
        Filtered means (nx, K) and covariances (K, nx, nx).  Instants at which nothing was measured
        are passed over by ``predict`` alone; variances are those of the recording.

    Raises:
        DataError: some sensors, but not all, are missing at an instant.
    """
    nx = kf.x.size
    means, covs = np.empty((nx, data.size)), np.empty((data.size, nx, nx))
    for k, dt in enumerate(data.dt):
        y = data.y[:, k]
        if not np.isnan(y).all():
            kf.update(y, R=np.diag(data.variance[:, k]), u=data.u[:, k])
        means[:, k], covs[k] = kf.x, kf.P
        if k + 1 < data.size:
            kf.predict(dt=dt, u=data.u[:, k])
    return means, covs
