"""Least-squares estimation over whole recordings as a sparse nonlinear program, built once.

The unknowns are all there is: shared parameters, own parameters of each recording, and for every
sample its state, lifted unknowns and noises (direct multiple shooting with one step an interval;
Bock and Plitt 1984).  With e all of unit variance::

    minimise   1/2 e'e,       e = ((y - g)/sigma, w, xi, xi0, (theta - mean)/sigma)
    so that    x(k+1) = f(x(k), u(k), p, w(k), dt(k)) + sqrt(dt(k)) walk xi(k)
               x(0)   = m0 + L0 xi0          where a recording has a prior of its first state
               0      = c(x(k), s(k), ...)   what the model leaves to the optimiser

Values and exact derivatives of *one* stage are three CasADi functions, mapped over all samples of
all recordings; constant sparse matrices put the parts in their places.  So the same (compiled)
functions serve every length of recording, and data are parameters of the program.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
import scipy.sparse as sp

from apu_casadi.core.backend import compiled
from apu_casadi.core.errors import EstimationError
from apu_casadi.core.interrupts import watched
from apu_casadi.core.sharing import Rebuilt, building, derived, keep
from estimators.batch.stagekernel import Kernel, kernel
from estimators.filters.belief import Belief
from estimators.models.filtermodel import CHECK_TOL, FilterModel
from estimators.models.lifting import Lifted
from estimators.models.recording import Recording

__all__ = ["CONSTRAINT_TOL", "Local", "Solution", "Transcription", "square_root"]

#: Largest residual of a scaled constraint with which a solution is used.
CONSTRAINT_TOL = 1e-8


def square_root(cov: np.ndarray) -> np.ndarray:
    """Return L with L L' = cov, for a covariance that may be singular.

    By eigenvalues of the correlations, so that units do not matter.
    """
    sigma = np.sqrt(np.maximum(np.diag(cov), 0.0))
    d = np.where(sigma > 0, sigma, 1.0)
    value, vector = np.linalg.eigh(cov / np.outer(d, d))
    return np.asarray(sigma[:, None] * vector * np.sqrt(np.maximum(value, 0.0)))


class Local(NamedTuple):
    """A solution of one recording in its own units, columns are samples."""

    x: np.ndarray
    s: np.ndarray
    w: np.ndarray
    xi: np.ndarray
    y: np.ndarray


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the optimiser ended; used only after :meth:`Transcription.verify`.

    Args:
        z: scaled unknowns.
        data: parameters of the program.
        cost: 1/2 e'e.
        lam_g: multipliers of the constraints.
        lam_z: multipliers of the bounds.
        status: the solver's word.
        iterations: how many it took.
    """

    z: np.ndarray
    data: np.ndarray
    cost: float
    lam_g: np.ndarray
    lam_z: np.ndarray
    status: str
    iterations: int


#: MUMPS, with which IPOPT solves its linear systems, keeps data of its own outside of any solver:
#: solutions in several threads wait for each other.
_ipopt = [threading.RLock()]


def _after_fork() -> None:
    _ipopt[0] = threading.RLock()  # another thread may have held it, and is not here


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


class Transcription(Rebuilt):
    """The program for given numbers of samples.

    Args:
        lifted: the model.
        sizes: samples of each recording.
        shared, own: parameters that all recordings have in common, and that each has for itself.
        prior: whether the recordings come with beliefs of their first states.
        backend, build: see :func:`apu_casadi.core.backend.compiled`.
    """

    lifted: Lifted
    model: FilterModel
    sizes: tuple[int, ...]
    shared: tuple[str, ...]
    own: tuple[str, ...]
    prior: bool
    kernel: Kernel
    n_theta: int
    n_local: int
    n_z: int
    n_g: int
    starts: np.ndarray
    recording_of: np.ndarray
    index: np.ndarray
    linked: np.ndarray

    @building
    def __init__(
        self,
        lifted: Lifted,
        sizes: Sequence[int],
        shared: Sequence[str] = (),
        own: Sequence[str] = (),
        *,
        prior: bool = False,
        backend: str | None = None,
        build: bool = False,
    ) -> None:
        self.lifted, self.model = lifted, lifted.model
        self.sizes, self.shared, self.own = tuple(sizes), tuple(shared), tuple(own)
        self.prior = prior and not lifted.steady
        self.kernel = kernel(lifted, (*self.shared, *self.own))
        self._compile: Callable[[ca.Function], ca.Function] = lambda f: compiled(
            f, backend=backend, build=build
        )
        nx, ns, nw, nq, nt = self.kernel.sizes
        R, K = len(self.sizes), sum(self.sizes)
        self.n_theta = len(self.shared) + R * len(self.own)
        self.n_local = nx + ns + nw + nq
        self.starts = np.concatenate([[0], np.cumsum(self.sizes)]).astype(int)
        # global positions: theta, own of each recording, xi0 of each recording, stages
        self._xi0 = self.n_theta
        first = self.n_theta + (R * nx if self.prior else 0)
        self.n_z = first + K * self.n_local
        stage = first + np.arange(K)[:, None] * self.n_local + np.arange(self.n_local)
        self.recording_of = np.repeat(np.arange(R), self.sizes)
        theta = np.empty((K, nt), int)
        theta[:, : len(self.shared)] = np.arange(len(self.shared))
        for j in range(len(self.own)):
            theta[:, len(self.shared) + j] = (
                len(self.shared) + self.recording_of * len(self.own) + j
            )
        self.index = np.concatenate([stage, theta], axis=1)
        """Position of each stage's q in z, shape (K, n)."""
        last = np.zeros(K, bool)
        last[self.starts[1:] - 1] = True
        #: samples that another follows
        self.linked = np.zeros(0, int) if lifted.steady else np.flatnonzero(~last)
        self.n_g = K * lifted.n_c + self.linked.size * nx + (R * nx if self.prior else 0)
        self._theta_scale = self.kernel.scale[-nt:] if nt else np.zeros(0)

    # ------------------------------------------------------------------ names and scales

    @property
    def theta_names(self) -> tuple[str, ...]:
        """Names of the parameters: shared ones, then own ones as ``name[r]``."""
        R = len(self.sizes)
        return (*self.shared, *(f"{n}[{r}]" for r in range(R) for n in self.own))

    @derived
    def theta_scale(self) -> np.ndarray:
        """Magnitudes of the parameters, shape (n_theta,)."""
        m = len(self.shared)
        return np.concatenate(
            [self._theta_scale[:m], np.tile(self._theta_scale[m:], len(self.sizes))]
        )

    @derived
    def scale(self) -> np.ndarray:
        """Magnitudes of all unknowns, shape (n_z,)."""
        out = np.ones(self.n_z)
        out[self.index] = self.kernel.scale
        out[: self.n_theta] = self.theta_scale
        return out

    # ------------------------------------------------------------------ data

    def data(
        self,
        recordings: Sequence[Recording],
        *,
        mean: np.ndarray | None = None,
        weight: np.ndarray | None = None,
        beliefs: Sequence[Belief] | None = None,
    ) -> np.ndarray:
        """Pack data into the program's parameter vector.

        Args:
            mean, weight: prior means of the parameters and 1/sigma, own units; 0 for no prior.
            beliefs: of the first states, one for each recording.
        """
        blocks = []
        for r in recordings:
            there = ~np.isnan(r.y)
            weights = np.where(there, 1 / np.sqrt(np.where(there, r.variance, 1.0)), 0.0)
            p = np.repeat(r.p[:, None], r.size, axis=1)
            blocks.append(np.vstack([r.u, p, np.where(there, r.y, 0.0), weights, r.dt[None, :]]))
        zero = np.zeros(self.n_theta)
        m = zero if mean is None else mean / self.theta_scale
        wt = zero if weight is None else weight * self.theta_scale
        parts = [np.hstack(blocks).ravel(order="F"), m, wt]
        if self.prior:
            nom = self.model.x.nominals
            for b in beliefs or ():
                L = square_root(b.cov) / nom[:, None]
                parts += [b.mean / nom, L.ravel(order="F")]
        return np.concatenate(parts)

    def _split(self, P: Any) -> tuple[Any, Any, Any, Any, Any]:
        """Stages' data (nd, K), prior mean and weight, means and roots of the first states."""
        nx, nu, np_, _, ny = self.model.sizes
        nd, K, R = nu + np_ + 2 * ny + 1, sum(self.sizes), len(self.sizes)
        at = [0, nd * K, nd * K + self.n_theta, nd * K + 2 * self.n_theta]
        D, mean, weight = (P[i:j] for i, j in pairwise(at))
        m0, L0, pos = [], [], at[-1]
        for _ in range(R if self.prior else 0):
            m0.append(P[pos : pos + nx])
            L0.append(P[pos + nx : pos + nx + nx * nx])
            pos += nx + nx * nx
        if isinstance(P, np.ndarray):
            return D.reshape(K, nd).T, mean, weight, m0, L0
        return ca.reshape(D, nd, K), mean, weight, m0, L0

    # ------------------------------------------------------------------ the program

    @derived
    def _places(self) -> dict[str, Any]:
        """Triplets of Jacobian and Hessian, as constant matrices from parts to nonzeros."""
        k, nx, K, R = self.kernel, self.kernel.sizes[0], sum(self.sizes), len(self.sizes)
        n_c = self.lifted.n_c
        # rows of g: constraints of every stage, then links, then first states
        link = np.full(K, -1)
        link[self.linked] = np.arange(self.linked.size)
        r_link = K * n_c + np.arange(self.linked.size)[:, None] * nx + np.arange(nx)
        r_first = K * n_c + self.linked.size * nx + np.arange(R * nx)
        jr, jc = (np.array(a, int) for a in k.J_c.get_triplet())
        row = np.where(
            jr[None, :] < nx,
            np.where(link[:, None] >= 0, K * n_c + link[:, None] * nx + jr[None, :], -1),
            np.arange(K)[:, None] * n_c + jr[None, :] - nx,
        )
        sign = np.where(jr < nx, -1.0, 1.0) * np.ones((K, 1))  # link: x(k+1) - f
        col = self.index[:, jc]
        rows, cols, vals = [row.ravel()], [col.ravel()], [sign.ravel()]
        ones_r, ones_c = [r_link.ravel()], [self.index[self.linked + 1, :nx].ravel()]
        if self.prior:
            ones_r.append(r_first)
            ones_c.append(self.index[self.starts[:-1], :nx].ravel())
        n_one = sum(a.size for a in ones_r)
        rows += ones_r
        cols += ones_c
        vals.append(np.ones(n_one))
        if self.prior:  # -L0, column-major
            block = np.arange(R)[:, None] * nx
            i, j = np.tile(np.arange(nx), nx), np.repeat(np.arange(nx), nx)
            rows.append((r_first[0] + block + i).ravel())
            cols.append((self._xi0 + block + j).ravel())
            vals.append(-np.ones(R * nx * nx))
        jac = _placed(rows, cols, vals, (self.n_g, self.n_z))
        hr, hc = (np.array(a, int) for a in k.H.get_triplet())
        I, J = self.index[:, hr].ravel(), self.index[:, hc].ravel()
        fixed = np.arange(self.n_theta + (R * nx if self.prior else 0))
        hess = _placed(
            [np.minimum(I, J), fixed],
            [np.maximum(I, J), fixed],
            [np.ones(I.size), np.ones(fixed.size)],
            (self.n_z, self.n_z),
        )
        spread = sp.csc_matrix(
            (np.ones(self.index.size), (self.index.ravel(), np.arange(self.index.size))),
            shape=(self.n_z, self.index.size),
        )
        return {"jac": jac, "hess": hess, "spread": spread, "link": link, "n_one": n_one}

    @derived
    def _mapped(self) -> tuple[ca.Function, ca.Function, ca.Function]:
        """Value, first and second derivatives of all stages at once."""
        k, K = self.kernel, sum(self.sizes)
        first, second = (self._compile(f).map(K) for f in (k.first, k.second))
        return self._compile(k.value).map(K), first, second

    @derived
    def functions(self) -> dict[str, ca.Function]:
        """The program's functions: f, g and their exact derivatives, in z and its parameters."""
        k, K, R = self.kernel, sum(self.sizes), len(self.sizes)
        nx, n_c, place = k.sizes[0], self.lifted.n_c, self._places
        z = ca.MX.sym("z", self.n_z)
        n_p = self._n_data
        P = ca.MX.sym("p", n_p)
        D, mean, weight, m0, L0 = self._split(P)
        n = self.index.shape[1]
        q = ca.reshape(z[self.index.ravel().tolist()], n, K)
        bias = (z[: self.n_theta] - mean) * weight
        xi0 = z[self._xi0 : self._xi0 + R * nx] if self.prior else ca.MX(0, 1)

        def cost(e: Any) -> Any:
            return ca.sumsqr(e) / 2 + ca.sumsqr(bias) / 2 + ca.sumsqr(xi0) / 2

        def constraints(c: Any) -> Any:
            parts = [ca.vec(c[nx:, :])] if n_c else []
            if self.linked.size:
                x = q[:nx, :]
                nxt = (self.linked + 1).tolist()
                parts.append(ca.vec(x[:, nxt] - c[:nx, self.linked.tolist()]))
            for r in range(R if self.prior else 0):
                x0 = q[:nx, int(self.starts[r])]
                own = xi0[r * nx : (r + 1) * nx]
                parts.append(x0 - m0[r] - ca.mtimes(ca.reshape(L0[r], nx, nx), own))
            return ca.vertcat(ca.MX(0, 1), *parts)

        value, first, second = self._mapped
        e, c = value(q, D)
        f, g = cost(e), constraints(c)
        e1, c1, _, J_c, slope = first(q, D)
        grad = ca.mtimes(_dm(place["spread"]), ca.vec(slope))
        fixed = ca.vertcat(bias * weight, xi0)
        grad = grad + ca.vertcat(fixed, ca.MX.zeros(self.n_z - fixed.shape[0]))
        pieces = [ca.vec(J_c), ca.DM.ones(place["n_one"])]
        if self.prior:
            pieces.append(ca.vertcat(*L0))
        jac = _sparse(place["jac"], ca.vertcat(*pieces))
        lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", self.n_g)
        # multipliers of a stage's (x1, c)
        lam_x = ca.MX.zeros(nx, K)
        if self.linked.size:
            lam_x[:, self.linked.tolist()] = -ca.reshape(
                lam_g[K * n_c : K * n_c + self.linked.size * nx], nx, self.linked.size
            )
        lam_c = ca.vertcat(lam_x, ca.reshape(lam_g[: K * n_c], n_c, K))
        curved = second(q, D, ca.repmat(lam_f, 1, K), lam_c)
        flat = ca.vertcat(ca.vec(curved), lam_f * ca.vertcat(weight**2, ca.DM.ones(xi0.shape[0])))
        hess = _sparse(place["hess"], flat)
        return {
            "nlp": ca.Function("nlp", [z, P], [f, g], ["x", "p"], ["f", "g"]),
            "grad_f": ca.Function("grad_f", [z, P], [cost(e1), grad], ["x", "p"], ["f", "grad"]),
            "jac_g": ca.Function("jac_g", [z, P], [constraints(c1), jac], ["x", "p"], ["g", "jac"]),
            "hess_lag": ca.Function(
                "hess_lag", [z, P, lam_f, lam_g], [hess], ["x", "p", "lam_f", "lam_g"], ["hess"]
            ),
        }

    @derived
    def _n_data(self) -> int:
        nx, nu, np_, _, ny = self.model.sizes
        n: int = (nu + np_ + 2 * ny + 1) * sum(self.sizes) + 2 * self.n_theta
        return n + (len(self.sizes) * (nx + nx * nx) if self.prior else 0)

    def solver(self, warm: bool = False, max_iterations: int = 200) -> ca.Function:
        """IPOPT with exact derivatives; ``warm`` for a start that is nearly the solution."""
        key = warm, max_iterations
        return keep(self, "solver", key, lambda: self._solver(warm, max_iterations))

    def _solver(self, warm: bool, max_iterations: int) -> ca.Function:
        F = self.functions
        x, p = ca.MX.sym("x", self.n_z), ca.MX.sym("p", self._n_data)
        f, g = F["nlp"](x, p)
        options: dict[str, Any] = {
            "grad_f": F["grad_f"],
            "jac_g": F["jac_g"],
            "hess_lag": F["hess_lag"],
            "print_time": False,
            "error_on_fail": False,
            "calc_lam_p": False,
            "no_nlp_grad": True,
            "show_eval_warnings": False,
            "ipopt.print_level": 0,
            "ipopt.sb": "yes",
            "ipopt.linear_solver": "mumps",
            "ipopt.tol": 1e-10,
            "ipopt.constr_viol_tol": 1e-10,
            "ipopt.acceptable_tol": 1e-8,
            "ipopt.max_iter": max_iterations,
            # bounds are physical: the solution may not lie a hair outside
            "ipopt.bound_relax_factor": 0.0,
            "ipopt.honor_original_bounds": "yes",
        }
        if warm:
            options |= {
                "ipopt.warm_start_init_point": "yes",
                "ipopt.mu_init": 1e-6,
                "ipopt.warm_start_bound_push": 1e-8,
                "ipopt.warm_start_mult_bound_push": 1e-8,
            }
        return ca.nlpsol("estimate", "ipopt", {"x": x, "p": p, "f": f, "g": g}, options)

    def solve(
        self,
        data: np.ndarray,
        z0: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        *,
        start: Solution | None = None,
        max_iterations: int = 200,
    ) -> Solution:
        """Solve from ``z0``, or from another solution, and verify the result.

        Raises:
            EstimationError: not converged; the worst constraint is named.
        """
        solver = self.solver(start is not None, max_iterations)
        given = {"x0": z0, "p": data, "lbx": lower, "ubx": upper, "lbg": 0.0, "ubg": 0.0}
        if start is not None:
            given |= {"lam_g0": start.lam_g, "lam_x0": start.lam_z}
        with _ipopt[0]:
            with watched():  # IPOPT would report an interrupt as a solution that was not found
                out = solver(**given)
            stats = solver.stats()
        s = Solution(
            z=np.array(out["x"]).ravel(),
            data=data,
            cost=float(out["f"]),
            lam_g=np.array(out["lam_g"]).ravel(),
            lam_z=np.array(out["lam_x"]).ravel(),
            status=str(stats["return_status"]),
            iterations=int(stats.get("iter_count", -1)),
        )
        self.verify(s, bool(stats["success"]))
        return s

    def verify(self, s: Solution, success: bool) -> None:
        """Refuse a solution that did not converge, or whose constraints do not hold.

        Raises:
            EstimationError: says what failed, where and by how much.
        """
        g = np.array(self.functions["nlp"](s.z, s.data)[1]).ravel()
        size = np.abs(g) if np.isfinite(g).all() else np.where(np.isfinite(g), 0.0, np.inf)
        worst = float(size.max(initial=0.0))
        where = f"; largest constraint residual {worst:.1e}"
        if worst > CONSTRAINT_TOL:
            where += f" ({self._row(int(np.argmax(size)))})"
        if not success or not worst <= CONSTRAINT_TOL or not np.isfinite(s.cost):
            raise EstimationError(
                f"{self.model.name}: no estimate found, IPOPT ended with {s.status} after "
                f"{s.iterations} iterations{where}; start from a better guess, widen the bounds, "
                "or add a prior where the data leave a direction open"
            )
        D = self._split(s.data)[0]
        check, _ = self._check(s.z[self.index].T, D)
        bad = float(np.max(np.array(check), initial=0.0))
        if not bad <= CHECK_TOL:
            k = int(np.argmax(np.array(check)))
            raise EstimationError(
                f"{self.model.name}: the model's check is {bad:.1e} > {CHECK_TOL:.0e} at sample "
                f"{k - self.starts[self.recording_of[k]]} of recording {self.recording_of[k]}"
            )

    @derived
    def _check(self) -> ca.Function:
        return self.kernel.check.map(sum(self.sizes))

    def _row(self, i: int) -> str:
        """What a row of g says."""
        nx, n_c, K = self.kernel.sizes[0], self.lifted.n_c, sum(self.sizes)
        if i < K * n_c:
            k, what = i // n_c, f"equation {i % n_c} of the model"
        elif i < K * n_c + self.linked.size * nx:
            i -= K * n_c
            k, what = int(self.linked[i // nx]), f"step of {self.model.x.names[i % nx]}"
        else:
            i -= K * n_c + self.linked.size * nx
            k, what = int(self.starts[i // nx]), f"first {self.model.x.names[i % nx]}"
        r = int(self.recording_of[k])
        return f"{what}, recording {r}, sample {k - self.starts[r]}"

    # ------------------------------------------------------------------ in and out

    def guess(
        self, recordings: Sequence[Recording], theta: np.ndarray, states: Sequence[np.ndarray]
    ) -> np.ndarray:
        """Return scaled unknowns from parameters and states (nx, K) of each recording.

        The lifted unknowns are solved for, noises are 0.

        Raises:
            EstimationError: the model cannot be solved at the guess.
        """
        nx, ns, _, _, nt = self.kernel.sizes
        z = np.zeros(self.n_z)
        z[: self.n_theta] = theta / self.theta_scale
        cols = self.model.p.indices((*self.shared, *self.own))
        stage = np.zeros((sum(self.sizes), self.index.shape[1]))
        for r, (data, x) in enumerate(zip(recordings, states, strict=True)):
            at = slice(self.starts[r], self.starts[r + 1])
            p = data.p.copy()
            p[cols] = theta[self.index[self.starts[r], -nt:]] if nt else []
            stage[at, :nx] = x.T
            if ns:
                s = np.array(self.lifted.start.map(data.size)(x, data.u, p))
                if not np.isfinite(s).all():
                    k = int(np.argmax(~np.isfinite(s).all(0)))
                    raise EstimationError(
                        f"{self.model.name}: the model cannot be solved at the guess, recording "
                        f"{r}, sample {k}: give a better guess of the states or parameters"
                    )
                stage[at, nx : nx + ns] = s.T
        stage /= self.kernel.scale
        local = self.index[:, : self.n_local]
        z[local] = stage[:, : self.n_local]
        return z

    def locals_of(self, s: Solution) -> list[Local]:
        """Return states, unknowns, noises and outputs of each recording, own units."""
        nx, ns, nw, _, _ = self.kernel.sizes
        q = s.z[self.index] * self.kernel.scale
        _, y = self._check(s.z[self.index].T, self._split(s.data)[0])
        parts = np.split(q[:, : self.n_local].T, np.cumsum([nx, ns, nw]), axis=0)
        out = []
        for r in range(len(self.sizes)):
            at = slice(self.starts[r], self.starts[r + 1])
            x, s_, w, xi = (a[:, at] for a in parts)
            out.append(Local(x, s_, w, xi, np.array(y)[:, at]))
        return out

    def quadratic(self, s: Solution, exact: bool = False) -> tuple[sp.csc_matrix, sp.csc_matrix]:
        """Return (H, J): Hessian in the scaled unknowns, and Jacobian of the constraints.

        H is Gauss and Newton's, or of the whole Lagrangian if ``exact``.
        """
        F = self.functions
        J = F["jac_g"](s.z, s.data)[1].sparse()
        if exact:
            U = F["hess_lag"](s.z, s.data, 1.0, s.lam_g).sparse()
            return sp.csc_matrix(U + sp.triu(U, 1).T), sp.csc_matrix(J)
        K = sum(self.sizes)
        D, _, weight, _, _ = self._split(s.data)
        nz = np.array(self._mapped[1](s.z[self.index].T, D)[2])
        er, ec = (np.array(a, int) for a in self.kernel.J_e.get_triplet())
        n_e = self.kernel.J_e.shape[0]
        rows = (np.arange(K)[:, None] * n_e + er).ravel()
        A = sp.csc_matrix(
            (nz.T.ravel(), (rows, self.index[:, ec].ravel())), shape=(K * n_e, self.n_z)
        )
        extra = np.zeros(self.n_z)
        extra[: self.n_theta] = weight**2
        if self.prior:
            extra[self._xi0 : self._xi0 + len(self.sizes) * self.kernel.sizes[0]] = 1.0
        return sp.csc_matrix(A.T @ A + sp.diags(extra)), sp.csc_matrix(J)


def _placed(
    rows: Sequence[Any], cols: Sequence[Any], vals: Sequence[Any], shape: tuple[int, int]
) -> tuple[ca.Sparsity, ca.DM]:
    """Sparsity of a matrix given by triplets, and the matrix that maps parts to its nonzeros.

    Entries with a negative row belong nowhere; doubled entries add up.
    """
    r, c, v = (np.concatenate([np.ravel(a) for a in group]) for group in (rows, cols, vals))
    keep = np.flatnonzero(r >= 0)
    key = c[keep].astype(np.int64) * shape[0] + r[keep]
    unique, inverse = np.unique(key, return_inverse=True)  # column-major order, as CasADi has it
    pattern = ca.Sparsity.triplet(
        shape[0], shape[1], (unique % shape[0]).tolist(), (unique // shape[0]).tolist()
    )
    M = sp.csc_matrix((v[keep], (inverse, keep)), shape=(unique.size, r.size))
    return pattern, _dm(M)


def _dm(M: Any) -> ca.DM:
    m = sp.csc_matrix(M)
    m.sort_indices()
    pattern = ca.Sparsity(m.shape[0], m.shape[1], m.indptr.tolist(), m.indices.tolist())
    return ca.DM(pattern, m.data)


def _sparse(placed: tuple[ca.Sparsity, ca.DM], parts: Any) -> Any:
    pattern, M = placed
    return ca.sparsity_cast(ca.densify(ca.mtimes(M, parts)), pattern)
