"""What jumps in states, parameters and sensors leave in a filter's innovations: their *signature*.

Willsky and Jones (1976), IEEE Trans. Automatic Control 21, 108-112: a jump is carried through the
filter, which is linear, or linearised about its own estimates.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.backend import backend_in_use, compiled
from apu_casadi.core.calling import mapped
from apu_casadi.core.errors import EstimationError, ParameterError, SignalError, nearest
from apu_casadi.core.sharing import keep
from estimators.filters.filtering import FilterResult
from estimators.models.filtermodel import FilterModel, inlined
from estimators.models.recording import Recording, plain_numbers

__all__ = ["Jump", "LinearFilter", "columns_of", "linear_filter", "linearised", "project"]


@dataclass(frozen=True)
class Jump:
    """A change that begins at some sample and stays.

    Args:
        kind: ``"state"`` (the state is displaced once), ``"parameter"`` (a known parameter has
            another value from then on), ``"sensor"`` (bias of an output from then on), or
            ``"gain"`` (an output is multiplied by 1 + size).
        name: of the state, parameter or output.
        scale: size of a unit jump, own unit.
    """

    kind: str
    name: str
    scale: float = 1.0

    def __post_init__(self) -> None:
        kinds = ("state", "parameter", "sensor", "gain")
        if self.kind not in kinds:
            raise ParameterError(f"kind of jump {self.kind!r} {nearest(self.kind, kinds)}")


def columns_of(names: Sequence[str], known: Sequence[str]) -> list[int]:
    """Return the positions of jumps among those that are known.

    Raises:
        SignalError: unknown name; the nearest is named.
    """
    for n in names:
        if n not in known:
            raise SignalError(f"unknown jump {n!r} {nearest(n, known)}")
    return [known.index(n) for n in names]


@dataclass(frozen=True, eq=False)
class LinearFilter:
    """A filter along a recording, linear about its own estimates, and where jumps enter it.

    The prediction error e and innovation nu, without noise, go as nu = H e + output,
    e(k+1) = A e - L nu + drift; a jump begins with e = state.

    Args:
        names: of the q jumps.
        A, L, H: (K, nx, nx), (K, nx, ny), (K, ny, nx); L is the gain to the next prediction.
        S: covariance of the innovations, (K, ny, ny).
        innovation: (K, ny), 0 where nothing was measured, and so are the rows of H and ``output``.
        state: (nx, q). drift : (K, nx, q). output : (K, ny, q).
    """

    names: tuple[str, ...]
    A: np.ndarray
    L: np.ndarray
    H: np.ndarray
    S: np.ndarray
    innovation: np.ndarray
    state: np.ndarray
    drift: np.ndarray
    output: np.ndarray

    @property
    def size(self) -> int:
        """Number of samples K."""
        return int(self.A.shape[0])

    def columns(self, names: Sequence[str]) -> list[int]:
        """Return the positions of jumps.

        Raises:
            SignalError: unknown name.
        """
        return columns_of(names, self.names)

    def ramps(self, t: np.ndarray) -> LinearFilter:
        """Return the same where each jump comes little by little: all of it by the last sample.

        Args:
            t: instants of the samples, (K,).
        """
        share = (t - t[0]) / (t[-1] - t[0])
        step = np.append(np.diff(share), 0.0)[:, None, None]
        drift = share[:, None, None] * self.drift + step * self.state
        return dataclasses.replace(
            self,
            state=np.zeros_like(self.state),
            drift=drift,
            output=share[:, None, None] * self.output,
        )

    def evidence(
        self, there: np.ndarray | None = None, signature: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return each jump alone, there from the first sample on: its most likely size and sigma.

        Args:
            there: samples that count, (K,); all by default.
            signature: of other errors, (K, ny, q); that of the jumps by default.
        """
        g = self.signature(0) if signature is None else signature
        if there is not None:
            g = g * there[:, None, None]
        weighted = np.linalg.solve(self.S, g)
        b = np.einsum("kiq,ki->q", weighted, self.innovation)
        C = np.einsum("kiq,kiq->q", weighted, g)
        known = C > 0
        C = np.where(known, C, 1.0)
        return np.where(known, b / C, 0.0), np.where(known, 1 / np.sqrt(C), np.inf)

    def signature(self, onset: int, stop: int | None = None) -> np.ndarray:
        """Return what unit jumps at a sample add to the innovations, shape (K - onset, ny, q)."""
        return np.array([g for g, _ in self._course(onset, stop)])

    def errors(self, onset: int = 0) -> np.ndarray:
        """Return what they add to the prediction errors of the states, (K - onset, nx, q)."""
        return np.array([e for _, e in self._course(onset, None)])

    def _course(self, onset: int, stop: int | None) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        e = self.state.copy()
        for k in range(onset, self.size if stop is None else stop):
            g = self.H[k] @ e + self.output[k]
            yield g, e
            e = self.A[k] @ e - self.L[k] @ g + self.drift[k]


def linear_filter(
    y: np.ndarray,
    *,
    A: np.ndarray,
    H: np.ndarray,
    Q: np.ndarray,
    R: np.ndarray,
    P0: np.ndarray,
    m0: np.ndarray | None = None,
    names: Sequence[str] = (),
    state: np.ndarray | None = None,
    drift: np.ndarray | None = None,
    output: np.ndarray | None = None,
    cross: np.ndarray | None = None,
) -> LinearFilter:
    """Run the Kalman filter of a linear, time-invariant model and tell where jumps enter.

    y = H x + v, x(k+1) = A x + w with covariances R, Q and E[w v'] = ``cross``.

    Args:
        y: (K, ny); NaN where nothing was measured.
        A, H, Q, R, P0, m0: the model and the belief before the first sample; m0 = 0 by default.
        names, state, drift, output: jumps, (nx, q), (nx, q), (ny, q); 0 by default.
        cross: (nx, ny), 0 by default.

    Raises:
        SignalError: shapes that do not fit.
    """
    y = plain_numbers(y, "y", gaps=True)
    nx, q = A.shape[0], len(names)
    ny = H.shape[0]
    if y.ndim != 2 or y.shape[1] != ny or H.shape != (ny, nx) or R.shape != (ny, ny):
        raise SignalError(f"shapes do not fit: y {y.shape}, A {A.shape}, H {H.shape}, R {R.shape}")
    K = y.shape[0]
    M = np.zeros((nx, ny)) if cross is None else cross
    m, P = np.zeros(nx) if m0 is None else m0, P0
    Ls: list[np.ndarray] = []
    Hs: list[np.ndarray] = []
    Ss: list[np.ndarray] = []
    nus: list[np.ndarray] = []
    for yk in y:
        there = ~np.isnan(yk)
        Hk = H * there[:, None]
        S = np.where(np.outer(there, there), Hk @ P @ Hk.T + R, 0.0)
        S[~there, ~there] = 1.0
        nu = np.where(there, yk - H @ m, 0.0)
        Mk = M * there
        L = np.linalg.solve(S, (A @ P @ Hk.T + Mk).T).T
        m = A @ m + L @ nu
        P = A @ P @ A.T + Q - L @ S @ L.T
        P = (P + P.T) / 2
        for kept, v in zip((Ls, Hs, Ss, nus), (L, Hk, S, nu), strict=True):
            kept.append(v)
    there = ~np.isnan(y)
    out = np.zeros((ny, q)) if output is None else output
    return LinearFilter(
        tuple(names),
        np.broadcast_to(A, (K, nx, nx)),
        np.array(Ls),
        np.array(Hs),
        np.array(Ss),
        np.array(nus),
        np.zeros((nx, q)) if state is None else state,
        np.broadcast_to(np.zeros((nx, q)) if drift is None else drift, (K, nx, q)),
        there[:, :, None] * out,
    )


def linearised(
    model: FilterModel,
    result: FilterResult,
    data: Recording,
    jumps: Sequence[Jump] = (),
    *,
    backend: str | None = None,
) -> LinearFilter:
    """Linearise a filter about its own estimates, with exact derivatives.

    For an extended Kalman filter these are the very matrices that it used; for an unscented one an
    approximation of the same order as its own.

    Args:
        model, data: what the filter was run with.
        result: of a run with ``full=True``.
        jumps: what may change; their names must differ.
        backend: see :func:`apu_casadi.core.backend.compiled`.

    Raises:
        EstimationError: the filter did not keep what is needed.
        SignalError: a jump of an unknown state, parameter or output.
    """
    r = result
    if r.mean_pred is None or r.cov_pred is None:
        raise EstimationError("linearising a filter needs its run with full=True")
    nx, _, np_, nw, ny = model.sizes
    q, K = len(jumps), data.size
    where = {"state": model.x, "parameter": model.p, "sensor": model.y, "gain": model.y}
    place = [where[j.kind].index(j.name) for j in jumps]
    rates, outs = _jacobians(model, backend)
    missing = np.isnan(data.y)
    p = model.full(data.p)[:, None]
    h, Hx, Hw, Hp = _stacks(
        outs(r.mean_pred, data.u, p, np.zeros((nw, 1))), [(ny, 1), (ny, nx), (ny, nw), (ny, np_)], K
    )
    here = (~missing.T)[:, :, None]
    Hx, Hw, Hp = Hx * here, Hw * here, Hp * here
    R = np.where(missing, 1.0, data.variance).T
    S = Hx @ r.cov_pred @ Hx.transpose(0, 2, 1) + Hw @ Hw.transpose(0, 2, 1)
    S[:, range(ny), range(ny)] += R
    PH = np.concatenate([r.cov_pred @ Hx.transpose(0, 2, 1), Hw.transpose(0, 2, 1)], axis=1)
    gain = np.linalg.solve(S, PH.transpose(0, 2, 1)).transpose(0, 2, 1)
    gain[:, model.x.indices(model.consider), :] = 0.0
    nu = np.where(missing, 0.0, r.innovation).T
    w = np.einsum("kij,kj->ik", gain[:, nx:], nu) if nw else np.zeros((0, 1))
    Fx, Fw, Fp = _stacks(
        rates(r.mean, data.u, p, w, data.dt[None, :]), [(nx, nx), (nx, nw), (nx, np_)], K
    )
    L = Fx @ gain[:, :nx] + Fw @ gain[:, nx:]
    state, drift, output = np.zeros((nx, q)), np.zeros((K, nx, q)), np.zeros((K, ny, q))
    for c, (j, i) in enumerate(zip(jumps, place, strict=True)):
        if j.kind == "state":
            state[i, c] = j.scale
        elif j.kind == "parameter":
            drift[:, :, c], output[:, :, c] = j.scale * Fp[:, :, i], j.scale * Hp[:, :, i]
        else:
            size = j.scale * (h[:, i, 0] if j.kind == "gain" else 1.0)
            output[:, i, c] = size * ~missing[i]
    names = tuple(
        j.name if j.kind in ("state", "parameter") else f"{j.kind} {j.name}" for j in jumps
    )
    if len(set(names)) < q:
        raise SignalError(f"jumps are not distinct: {', '.join(names)}")
    return LinearFilter(names, Fx, L, Hx, S, nu, state, drift, output)


def _jacobians(model: FilterModel, backend: str | None) -> tuple[Any, Any]:
    """Batch forms of the Jacobians of transition and output; kept with the family's functions."""
    made, names = model.shared, model.p.names
    key = made.output, names, backend, backend_in_use()
    return keep(made.transition, _jacobians, key, lambda: _build_jacobians(made, names, backend))


def _build_jacobians(
    model: FilterModel, names: Sequence[str], backend: str | None
) -> tuple[Any, Any]:
    """Derivatives by states, noises and the parameters ``names``, whatever else p has."""
    x, u, p, w, dt = model.symbols()
    # a move of some of the parameters, by which alone is differentiated
    d, spread = ca.MX.sym("d", len(names)), ca.DM(len(model.p), len(names))
    for j, i in enumerate(model.p.indices(names)):
        spread[i, j] = 1
    moved = p + ca.mtimes(spread, d)
    x1, _ = inlined(model.transition, x, u, moved, w, dt)
    y, _ = inlined(model.output, x, u, moved, w)

    def made(name: str, args: list[Any], of: list[Any]) -> Any:
        columns = [ca.vec(ca.densify(e)) for e in of]
        still = ca.Function(f"{name}_moved", [*args, d], columns)(*args, ca.DM.zeros(len(names)))
        columns = [*still] if isinstance(still, tuple | list) else [still]
        return mapped(compiled(ca.Function(name, args, columns), backend=backend), 1)

    rates = made(f"{model.name}_df", [x, u, p, w, dt], [ca.jacobian(x1, v) for v in (x, w, d)])
    outs = made(f"{model.name}_dg", [x, u, p, w], [y, *(ca.jacobian(y, v) for v in (x, w, d))])
    return rates, outs


def _stacks(
    columns: Sequence[np.ndarray], shapes: Sequence[tuple[int, int]], K: int
) -> list[np.ndarray]:
    """Columns of vec(matrix) to stacks of matrices."""
    return [
        np.broadcast_to(c, (c.shape[0], K)).T.reshape(K, m, n).transpose(0, 2, 1).copy()
        for c, (n, m) in zip(columns, shapes, strict=True)
    ]


def project(innovation: np.ndarray, S: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return the component of innovations along a direction, of unit variance.

    z = d' S^-1 nu / sqrt(d' S^-1 d): white and normal if the filter is consistent; a change that
    adds s d to the innovations shifts it by s sqrt(d' S^-1 d).

    Args:
        innovation: (K, ny); NaN where nothing was measured.
        S: (K, ny, ny) or (ny, ny), diagonal where nothing was measured, as in a filter's result.
        direction: (K, ny) or (ny,).

    Returns:
        z, shape (K,); NaN where nothing along the direction was measured.

    Raises:
        SignalError: a direction that is zero though all was measured.
    """
    nu = plain_numbers(innovation, "innovation", gaps=True)
    there = ~np.isnan(nu)
    d = np.where(there, np.broadcast_to(direction, nu.shape), 0.0)
    nu = np.where(there, nu, 0.0)
    weight = np.linalg.solve(np.broadcast_to(S, (*nu.shape, nu.shape[1])), d[:, :, None])[:, :, 0]
    scale = np.einsum("ki,ki->k", weight, d)
    nothing = ~(scale > 0)
    if (nothing & there.all(1)).any():
        k = int(np.argmax(nothing & there.all(1)))
        raise SignalError(f"the direction is zero at sample {k}")
    along = np.einsum("ki,ki->k", weight, nu) / np.sqrt(np.where(nothing, 1.0, scale))
    return np.asarray(np.where(nothing, np.nan, along))
