"""Derivatives of readings by what is unknown: the fisher information of faults and nuisances.

Everything follows from the derivatives J of the readings, each over the standard deviation of its
noise, with respect to what is unknown: *faults*, which are asked for, and *nuisances*, which are
unknown as well (a true fuel flow, a gain error).  J comes from a steady model
(:func:`steady_sensitivities`) or from a recording (:func:`recording_sensitivities`); J' J is the
Fisher information of Gaussian readings (Kay 1993, Fundamentals of Statistical Signal Processing I,
section 3.9), its inverse the Cramer-Rao bound.

A nuisance is eliminated by projection: what remains of a fault's *signature* is what no value of
the nuisances can imitate.  Gaussian priors count as further readings, one for each unknown; a
nuisance with a prior that is not estimated (a *considered* one) is eliminated the same way, since
for one sample Schmidt's gain for the other unknowns is the optimal one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from apu_casadi.core.errors import EstimationError, SignalError, nearest
from apu_casadi.core.signals import Signal, Signals
from estimators.filters.belief import Belief
from estimators.information.bounds import linearisations
from estimators.models.filtermodel import FilterModel
from estimators.models.recording import Recording

__all__ = [
    "ENTRY",
    "EXACT",
    "RECORDING",
    "Sensitivities",
    "bound_of",
    "recording_sensitivities",
    "remainder",
    "steady_sensitivities",
    "together",
]

EXACT = 1e-8  # smaller singular values, over the largest signature, are rounding
ENTRY = 1e-6  # smaller entries of an invisible direction, over its largest, are rounding
RECORDING = "recording"  # the one sensor of what :func:`recording_sensitivities` returns


@dataclass(frozen=True, eq=False)
class Sensitivities:
    """Derivatives of readings with respect to unknowns, in standard deviations of the readings.

    Args:
        theta: the unknowns; ``doc`` gives the words, ``nominal`` what per cent refer to.
        J: d reading / d theta over the reading's standard deviation, shape (m, n), noise white.
        rows: the sensor of each reading, shape (m,); a sensor may have several readings.
        faults: names of the unknowns that are asked for; the others are nuisances.
        size: changes of theta that are of interest, own units, shape (n,); the rank is judged by
            them.
        prior: standard deviations before the readings, own units, shape (n,); inf where nothing is
            known.

    Raises:
        SignalError: shapes that do not fit, values not finite, unknown faults, none at all.
    """

    theta: Signals
    J: np.ndarray
    rows: tuple[str, ...]
    faults: tuple[str, ...]
    size: np.ndarray
    prior: np.ndarray

    def __post_init__(self) -> None:
        m, n = len(self.rows), len(self.theta)
        for label, shape in (("J", (m, n)), ("size", (n,)), ("prior", (n,))):
            got = np.shape(getattr(self, label))
            if got != shape:
                raise SignalError(f"{label}: shape {shape} expected, got {got}")
        self.theta.indices(self.faults)
        if not self.faults:
            raise SignalError("no fault is asked for")
        if not np.isfinite(self.J).all():
            i, j = np.argwhere(~np.isfinite(self.J))[0]
            raise SignalError(f"d {self.rows[i]} / d {self.theta.names[j]} is not finite")
        for label, ok in (("size", np.isfinite(self.size)), ("prior", ~np.isnan(self.prior))):
            value = getattr(self, label)
            bad = [
                n for n, v, k in zip(self.theta.names, value, ok, strict=True) if not (k and v > 0)
            ]
            if bad:
                raise SignalError(f"{label} must be > 0: {', '.join(bad)}")

    @classmethod
    def of(
        cls,
        theta: Signals,
        readings: Sequence[str],
        H: Any,
        sigma: Any,
        *,
        faults: Sequence[str],
        size: Mapping[str, float] | None = None,
        prior: Mapping[str, float] | None = None,
    ) -> Sensitivities:
        """Make them from derivatives H (m, n) in own units and noise sigma (m,).

        ``size`` is 1 % of the nominal value, ``prior`` infinite, where not given by name.

        Raises:
            SignalError: unknown names, shapes, a sigma that is not positive.
        """
        s = np.asarray(sigma, float)
        if s.shape != (len(readings),) or not (np.isfinite(s).all() and (s > 0).all()):
            raise SignalError(f"sigma: {len(readings)} positive numbers expected, got {s!r}")
        sizes, priors = 0.01 * theta.nominals, np.full(len(theta), np.inf)
        for target, given in ((sizes, size), (priors, prior)):
            for name, value in (given or {}).items():
                target[theta.index(name)] = value
        J = np.asarray(H, float) / s[:, None]
        return cls(theta, J, tuple(readings), tuple(faults), sizes, priors)

    @property
    def sensors(self) -> tuple[str, ...]:
        """The sensors in order, each once."""
        return tuple(dict.fromkeys(self.rows))

    def only(self, sensors: Sequence[str]) -> Sensitivities:
        """Return what these sensors read.

        Raises:
            SignalError: unknown sensor, or none.
        """
        unknown = [f"{n} {nearest(n, self.sensors)}" for n in sensors if n not in self.rows]
        if unknown or not sensors:
            raise SignalError(f"unknown sensor {'; '.join(unknown)}" if unknown else "no sensor")
        keep = [i for i, r in enumerate(self.rows) if r in sensors]
        return dataclasses.replace(self, J=self.J[keep], rows=tuple(self.rows[i] for i in keep))

    def with_prior(self, prior: Mapping[str, float]) -> Sensitivities:
        """Return them with other priors, by name; inf for none.

        Raises:
            SignalError: unknown name, or a prior that is not positive.
        """
        new = self.prior.copy()
        for name, value in prior.items():
            new[self.theta.index(name)] = value
        return dataclasses.replace(self, prior=new)

    def signatures(self) -> np.ndarray:
        """Return the faults' signatures, nuisances eliminated, shape (., n_faults), per own unit.

        Their scalar products are the faults' Fisher information, without their own priors.
        """
        f = self.theta.indices(self.faults)
        n = [i for i in range(len(self.theta)) if i not in f]
        known = [i for i in n if np.isfinite(self.prior[i])]
        A_f = np.vstack([self.J[:, f], np.zeros((len(known), len(f)))])
        P = np.zeros((len(known), len(n)))
        for row, i in enumerate(known):
            P[row, n.index(i)] = 1 / self.prior[i]
        return remainder(A_f, np.vstack([self.J[:, n], P]) * self.size[n])

    def information(self) -> np.ndarray:
        """Return the Fisher information of the faults, nuisances eliminated, (n_faults, n_faults).

        Without the faults' own priors; 1 over own units.
        """
        M = self.signatures()
        return np.asarray(M.T @ M)

    def covariance(self) -> np.ndarray:
        """Return the bound on the faults' covariance with their priors, (n_faults, n_faults).

        Own units; variances are infinite, and covariances NaN, where neither readings nor priors
        tell.
        """
        f = self.theta.indices(self.faults)
        return bound_of(self.signatures(), self.size[f], self.prior[f])


def remainder(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return the part of A's columns that is orthogonal to B's."""
    if not B.shape[1] or not B.size:
        return A
    scale = np.linalg.norm(B, axis=0)
    U, s, _ = np.linalg.svd(B / np.where(scale > 0, scale, 1.0), full_matrices=False)
    Q = U[:, s > EXACT * s[0]] if s.size and s[0] > 0 else U[:, :0]
    # twice is enough for orthogonality to rounding
    for _ in range(2):
        A = A - Q @ (Q.T @ A)
    return A


def bound_of(M: np.ndarray, size: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Return the bound on the covariance of faults with signatures M; inf and NaN where unseen."""
    n = size.size
    A = np.vstack([M * size, np.diag(np.where(np.isfinite(prior), size / prior, 0.0))])
    _, s, Vt = np.linalg.svd(A, full_matrices=True)
    seen = np.append(s > EXACT * max(s[0], np.finfo(float).tiny), np.zeros(n - s.size, bool))
    half = Vt[: s.size][seen[: s.size]].T / s[seen[: s.size]]
    C = half @ half.T * np.outer(size, size)
    lost = np.abs(Vt[~seen]).max(0, initial=0.0) > ENTRY
    C[lost, :] = C[:, lost] = np.nan
    C[lost, lost] = np.inf
    return np.asarray(C)


def steady_sensitivities(
    xdot_w: Any, y_w: Any, w: Signals, *, unknown: Sequence[str], solved: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return derivatives along steady states, on which 0 = xdot(w) holds exactly.

    Args:
        xdot_w, y_w: total derivatives of rates and outputs, shapes (nx, nw), (ny, nw).
        w: names of the columns: states, inputs, parameters.
        unknown: columns that may change freely.
        solved: as many columns as states, which follow from the others by 0 = xdot.  Columns in
            neither are known exactly.

    Returns:
        (ny, n_unknown) d y / d unknown, and (n_solved, n_unknown) d solved / d unknown.

    Raises:
        SignalError: unknown names, a column in both lists, a wrong number of them.
        EstimationError: the steady state does not determine ``solved``.
    """
    A, C = np.asarray(xdot_w, float), np.asarray(y_w, float)
    i, j = w.indices(unknown), w.indices(solved)
    both = set(unknown) & set(solved)
    if both or len(solved) != A.shape[0]:
        raise SignalError(
            f"{A.shape[0]} solved columns for {A.shape[0]} states expected, apart from the "
            f"unknown ones; got {', '.join(solved) or 'none'}"
            + (f", of which {', '.join(sorted(both))} is unknown too" if both else "")
        )
    block = A[:, j] * w.nominals[j]
    scale = np.abs(A * w.nominals).max(1, keepdims=True)
    if np.linalg.svd(block / np.where(scale > 0, scale, 1), compute_uv=False).min() < EXACT:
        raise EstimationError(
            f"the steady state does not determine {', '.join(solved)}: choose others to solve for"
        )
    follow = -np.linalg.solve(A[:, j], A[:, i])
    return C[:, i] + C[:, j] @ follow, follow


def together(parts: Mapping[str, Sensitivities], *, shared: Sequence[str] = ()) -> Sensitivities:
    """Return several experiments as one: the same faults, nuisances of each its own.

    Args:
        parts: experiments by name, which must be an identifier; their faults must be the same. A
            nuisance becomes ``<name>_<part>`` unless ``shared``.
        shared: nuisances that are one and the same in all, such as gain errors.

    Raises:
        SignalError: different faults, or nothing given.
    """
    if not parts:
        raise SignalError("no experiment given")
    first = next(iter(parts.values()))
    for label, part in parts.items():
        if part.faults != first.faults:
            raise SignalError(
                f"{label} asks for {', '.join(part.faults)}, not for {', '.join(first.faults)}"
            )
    common = {*first.faults, *shared}
    signals: dict[str, Signal] = {}
    size: dict[str, float] = {}
    prior: dict[str, float] = {}
    columns: list[list[str]] = []
    for label, part in parts.items():
        names = []
        for k, s in enumerate(part.theta):
            own = s.name in common
            name = s.name if own else f"{s.name}_{label}"
            doc = s.doc if own else f"{s.doc} at {label}"
            signals.setdefault(name, Signal(name, s.unit, doc, None, s.nominal))
            size.setdefault(name, float(part.size[k]))
            prior[name] = min(prior.get(name, math.inf), float(part.prior[k]))
            names.append(name)
        columns.append(names)
    theta = Signals(list(signals.values()))
    blocks = []
    for names, part in zip(columns, parts.values(), strict=True):
        block = np.zeros((len(part.rows), len(theta)))
        block[:, theta.indices(names)] = part.J
        blocks.append(block)
    return Sensitivities(
        theta,
        np.vstack(blocks),
        tuple(r for part in parts.values() for r in part.rows),
        first.faults,
        theta.pack(size),
        np.array([prior[n] for n in theta.names]),
    )


def recording_sensitivities(
    model: FilterModel,
    names: Sequence[str],
    prior: Belief,
    data: Recording,
    truth: Any,
    *,
    size: Mapping[str, float] | None = None,
    backend: str | None = None,
) -> Sensitivities:
    """Return what a recording tells of the initial values of some states, nothing known before.

    With these states off by a change, the filter that takes them as known makes innovations of
    mean T(k) times that change, with the covariance S(k) of the rest (Friedland 1969, IEEE Trans.
    Automatic Control 14, 359): the information is the sum of T' S^-1 T.  Process noise, unknown
    initial values of the other states and noise of the inputs are all in S.

    Args:
        model: the model; ``names`` are mostly parameters made states by ``augment``.
        names: the states asked for.
        prior: belief at the first instant; of ``names`` it is not used.
        data, truth, backend: as for :func:`estimators.information.bounds.posterior_bound`.
        size: changes of interest by name; 1 % of the nominal value by default.

    Returns:
        Sensitivities: with at most ``len(names)`` rows called ``recording``, and no prior.

    Raises:
        SignalError, EstimationError: see :func:`estimators.information.bounds.linearisations`.
    """
    asked = model.x.indices(names)
    H, F = linearisations(model, data, truth, backend=backend)
    nx, nw = len(model.x), len(model.w)
    P = prior.cov.copy()
    P[asked, :] = P[:, asked] = 0.0
    V = np.zeros((nx + nw, len(asked)))
    V[asked, range(len(asked))] = 1.0
    scale = np.array([model.x[i].nominal for i in asked])
    R = np.zeros((0, len(asked)))
    for k in range(data.size):
        there = ~np.isnan(data.y[:, k])
        Pa = np.zeros((nx + nw, nx + nw))
        Pa[:nx, :nx], Pa[nx:, nx:] = P, np.eye(nw)
        if there.any():
            h = H[k][there]
            T, PH = h @ V, Pa @ h.T
            S = h @ PH + np.diag(data.variance[there, k])
            L = np.linalg.cholesky((S + S.T) / 2)
            G = np.linalg.solve(L, PH.T)
            white = np.linalg.solve(L, T)
            # orthogonal triangularisation keeps the digits that squaring would lose
            R = np.asarray(np.linalg.qr(np.vstack([R, white * scale]), mode="r"))
            V = V - G.T @ white
            K = np.linalg.solve(L.T, G).T
            A = np.eye(nx + nw) - K @ h
            Pa = A @ Pa @ A.T + (K * data.variance[there, k]) @ K.T
        P = F[k] @ Pa @ F[k].T + np.diag(model.walk**2 * data.dt[k])
        P = (P + P.T) / 2
        V = np.vstack([F[k] @ V, np.zeros((nw, len(asked)))])
    theta = Signals([dataclasses.replace(model.x[i], default=None) for i in asked])
    rows = (RECORDING,) * R.shape[0]
    return Sensitivities.of(
        theta, rows, R / scale, np.ones(R.shape[0]), faults=tuple(names), size=size
    )
