"""Batch fit: parameters shared by recordings, by maximum likelihood or a posteriori.

:func:`fit` finds the most likely parameters together with the most likely states and noises of all
samples (:mod:`estimators.batch.transcription`: a lifted nonlinear program, IPOPT, exact Hessian).
Where the noises enter linearly this is the maximum of the likelihood itself; else it differs from
it by the curvature of the model over the noise's width, as every errors-in-variables fit does.

Uncertainty follows from the information that is left for the parameters when everything else is
re-optimised (the reduced Hessian): with H and J the Hessian and the constraints' Jacobian, split
into parameters a and all else b,

    [H_bb J_b'; J_b 0] [V; L] = -[H_ba; J_a],     I = H_aa + H_ab V + J_a' L,     cov = I^-1

(Bock 1987, and Nocedal and Wright 2006, section 16.2).  Directions in which I has nothing are
named, never inverted.  A *considered* parameter c is uncertain but not estimated: it moves the
estimate by S = -I_aa^-1 I_ac, so that S cov_c S' is added (Schmidt 1966; Bierman 1977, section
VIII.2).
:func:`profile` needs no quadratic approximation at all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from apu_casadi.core.errors import EstimationError, ParameterError, nearest
from apu_casadi.core.sharing import Rebuilt, building
from estimators.batch.fitresult import FitResult, FittedRecording, Profile
from estimators.batch.programs import full, program
from estimators.batch.transcription import Solution, Transcription
from estimators.batch.undetermined import invert
from estimators.filters.belief import Belief
from estimators.information.consistency import sigmas
from estimators.models.filtermodel import FilterModel
from estimators.models.lifting import Lifted, plain
from estimators.models.recording import Recording

__all__ = ["FitProblem", "fit", "profile"]

_AT_BOUND = 1e-6  # of the parameter's magnitude


@dataclass(frozen=True, eq=False)
class _Run:
    """What a profile needs to go on from a result."""

    problem: FitProblem
    solution: Solution
    lower: np.ndarray
    upper: np.ndarray
    tangent: np.ndarray  # of all unknowns along each estimated parameter, others re-fitted


class FitProblem(Rebuilt):
    """A fit built once, for any data of the same sizes.

    Args:
        model: a filter's model, or a lifted one (:func:`estimators.models.lifting.lift`), which is
            faster wherever the model solves equations inside.
        sizes: number of samples of each recording.
        estimate: parameters (``model.p``) that all recordings share.
        own: parameters that each recording has for itself, such as a bias.
        consider: parameters that are uncertain but not estimated.
        beliefs: whether the recordings come with beliefs of their first states.  Without, first
            states are free.
        backend, build: see :func:`apu_casadi.core.backend.compiled`; compiling takes seconds, and
            pays from some ten fits on.

    Raises:
        ParameterError: unknown or doubled names, nothing to estimate.
    """

    lifted: Lifted
    model: FilterModel
    estimate: tuple[str, ...]
    own: tuple[str, ...]
    consider: tuple[str, ...]
    program: Transcription
    free: list[int]
    held: list[int]
    names: tuple[str, ...]

    @building
    def __init__(
        self,
        model: FilterModel | Lifted,
        sizes: Sequence[int],
        estimate: Sequence[str],
        *,
        own: Sequence[str] = (),
        consider: Sequence[str] = (),
        beliefs: bool = False,
        backend: str | None = None,
        build: bool = False,
    ) -> None:
        """Check the names and lay out the program; see the class."""
        self.lifted = model if isinstance(model, Lifted) else plain(model)
        self.model = m = self.lifted.model
        names = [*estimate, *consider, *own]
        for n in names:
            if n not in m.p.names:
                state = " (it is a state of this model)" if n in m.x.names else ""
                raise ParameterError(f"{m.name}: no parameter {n!r}{state} {nearest(n, m.p.names)}")
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ParameterError(f"estimated, own or considered at once: {', '.join(twice)}")
        if not estimate and not own:
            raise ParameterError("nothing to estimate")
        if m.consider:
            raise ParameterError(
                f"considered states ({', '.join(m.consider)}) belong to filters; keep them as "
                "parameters and name them in consider"
            )
        self.estimate, self.own, self.consider = tuple(estimate), tuple(own), tuple(consider)
        self.program = program(
            self.lifted,
            sizes,
            (*estimate, *consider),
            own,
            prior=beliefs,
            backend=backend,
            build=build,
        )
        all_names = self.program.theta_names
        self.free = [i for i, n in enumerate(all_names) if n not in self.consider]
        self.held = [i for i, n in enumerate(all_names) if n in self.consider]
        self.names = tuple(all_names[i] for i in self.free)

    # ------------------------------------------------------------------ data in

    def _theta(self, given: Mapping[str, Any], empty: Any, what: str) -> list[Any]:
        """Sort values by name (own ones also by ``name[r]``) into the order of the parameters."""
        known = {*self.program.theta_names, *self.own}
        for n in given:
            if n not in known:
                raise ParameterError(f"{what} of {n!r}, which is not fitted {nearest(n, known)}")
        return [
            given.get(n, given.get(n.partition("[")[0], empty)) for n in self.program.theta_names
        ]

    def _start(self, recordings: Sequence[Recording], guess: Mapping[str, float]) -> np.ndarray:
        """First guess of the parameters; what is not given stands in the recordings."""
        values = self._theta(guess, None, "guess")
        col = self.model.p.indices([n.partition("[")[0] for n in self.program.theta_names])
        m = len(self.program.shared)
        for i, n in enumerate(self.program.theta_names):
            r = 0 if i < m else (i - m) // len(self.own)
            there = [d.p[col[i]] for d in recordings]
            if n in self.consider and np.ptp(there) > 0:
                raise ParameterError(
                    f"considered parameter {n} differs between recordings ({min(there):g} to "
                    f"{max(there):g}); it must be one number"
                )
            values[i] = there[r] if values[i] is None else float(values[i])
        return np.array(values, float)

    def _states(
        self, data: Recording, belief: Belief | None, given: Mapping[str, Any]
    ) -> np.ndarray:
        """Guess of the states: as given, else what was measured under the same name, else known."""
        model, out = self.model, np.empty((len(self.model.x), data.size))
        for n in given:
            if n not in model.x.names:
                raise ParameterError(f"guess of state {n!r} {nearest(n, model.x.names)}")
        for i, s in enumerate(model.x):
            row = data.y[model.y.index(s.name)] if s.name in model.y.names else np.full(1, np.nan)
            there = ~np.isnan(row)
            if s.name in given:
                out[i] = given[s.name]
            elif there.any():
                out[i] = np.interp(data.t, data.t[there], row[there])
            elif belief is not None:
                out[i] = belief[s.name][0]
            else:
                out[i] = s.nominal if s.default is None else s.default
            out[i] = np.clip(out[i], model.lower[i], model.upper[i])
        return out

    # ------------------------------------------------------------------ solve

    def solve(
        self,
        recordings: Sequence[Recording],
        *,
        guess: Mapping[str, float] | None = None,
        prior: Mapping[str, tuple[float, float]] | None = None,
        bounds: Mapping[str, tuple[float, float]] | None = None,
        consider: Mapping[str, float] | None = None,
        beliefs: Sequence[Belief] | None = None,
        states: Sequence[Mapping[str, Any]] | None = None,
        exact: bool = False,
        max_iterations: int = 200,
    ) -> FitResult:
        """Fit; see :func:`fit` for the arguments."""
        program, model = self.program, self.model
        got = tuple(r.size for r in recordings)
        if got != program.sizes:
            raise ParameterError(f"recordings of {program.sizes} samples expected, got {got}")
        for r in recordings:
            r.check(model)
        if program.prior != bool(beliefs) and not self.lifted.steady:
            raise ParameterError(
                "beliefs of the first states: built "
                f"{'with' if program.prior else 'without'}, called "
                f"{'with' if beliefs else 'without'} them"
            )
        for b in beliefs or ():
            if b.x.names != model.x.names:
                raise ParameterError(
                    f"belief of {', '.join(b.x.names)}; {model.name} has {', '.join(model.x.names)}"
                )
        if beliefs and len(beliefs) != len(recordings):
            raise ParameterError(f"{len(beliefs)} beliefs for {len(recordings)} recordings")
        theta = self._start(recordings, guess or {})
        mean, weight = theta.copy(), np.zeros(theta.size)
        for i, pair in enumerate(self._theta(prior or {}, None, "prior")):
            if pair is None:
                continue
            m, s = (float(v) for v in pair)
            if i in self.held or not (math.isfinite(m) and math.isfinite(s) and s > 0):
                raise ParameterError(
                    f"prior of {program.theta_names[i]}: an estimated parameter's (mean, "
                    f"sigma > 0) expected, got {pair!r}"
                )
            mean[i], weight[i] = m, 1 / s
            if program.theta_names[i].partition("[")[0] not in (guess or {}):
                theta[i] = m
        lower, upper = self._bounds(theta, bounds or {})
        theta = np.clip(theta, lower, upper)
        sigma_c = self._considered(consider or {})
        given = states if states is not None else [{} for _ in recordings]
        each = list(beliefs) if beliefs else [None] * len(recordings)
        x = [self._states(r, b, g) for r, b, g in zip(recordings, each, given, strict=True)]
        z_lower, z_upper = self._limits(lower, upper)
        told = full(self.lifted, recordings)
        data = program.data(told, mean=mean, weight=weight, beliefs=beliefs)
        z0 = program.guess(told, theta, x)
        found = program.solve(data, z0, z_lower, z_upper, max_iterations=max_iterations)
        return self._result(found, recordings, weight, sigma_c, z_lower, z_upper, exact)

    def _bounds(
        self, theta: np.ndarray, bounds: Mapping[str, tuple[float, float]]
    ) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = np.full(theta.size, -np.inf), np.full(theta.size, np.inf)
        for i, pair in enumerate(self._theta(bounds, (-math.inf, math.inf), "bounds")):
            lower[i], upper[i] = pair
            if not lower[i] < upper[i]:
                raise ParameterError(
                    f"bounds of {self.program.theta_names[i]}: {pair!r} is no interval"
                )
        for i in self.held:
            lower[i] = upper[i] = theta[i]
        return lower, upper

    def _considered(self, sigma: Mapping[str, float]) -> np.ndarray:
        if set(sigma) != set(self.consider):
            raise ParameterError(
                f"standard deviations of {', '.join(self.consider) or 'no parameter'} expected in "
                f"consider, got {', '.join(sigma) or 'none'}"
            )
        out = np.array([float(sigma[n]) for n in self.consider])
        if not (np.isfinite(out) & (out >= 0)).all():
            raise ParameterError(f"consider: standard deviations must be >= 0, got {dict(sigma)}")
        return out

    def _limits(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of all scaled unknowns."""
        p, m = self.program, self.model
        lo, hi = np.full(p.n_z, -np.inf), np.full(p.n_z, np.inf)
        nx = len(m.x)
        lo[p.index[:, :nx]], hi[p.index[:, :nx]] = m.lower, m.upper
        lo[: p.n_theta], hi[: p.n_theta] = lower, upper
        return lo / p.scale, hi / p.scale

    # ------------------------------------------------------------------ what is known

    def _result(
        self,
        s: Solution,
        recordings: Sequence[Recording],
        weight: np.ndarray,
        sigma_c: np.ndarray,
        lower: np.ndarray,
        upper: np.ndarray,
        exact: bool,
    ) -> FitResult:
        p, n = self.program, self.program.n_theta
        info, follow = self._information(s, lower, upper, exact)
        # back to own units
        d = p.theta_scale
        info = info / np.outer(d, d)
        theta = s.z[:n] * d
        a, c = self.free, self.held
        edge = np.minimum(np.abs(s.z[:n] - lower[:n]), np.abs(upper[:n] - s.z[:n])) <= _AT_BOUND
        stuck = [i for i in a if edge[i]]
        moving = [i for i in a if not edge[i]]
        names = p.theta_names
        cov, undetermined, weak = invert(info[np.ix_(moving, moving)], [names[i] for i in moving])
        where = [a.index(i) for i in moving]
        noise = np.zeros((len(a), len(a)))
        noise[np.ix_(where, where)] = cov
        S = np.zeros((len(a), len(c)))
        known = np.where(np.isfinite(cov), cov, 0.0)
        S[where] = -known @ info[np.ix_(moving, c)]
        total = noise + (S * sigma_c**2) @ S.T
        # a parameter at its bound does not move, and nothing is claimed of it
        for i in stuck:
            j = a.index(i)
            noise[j, :] = noise[:, j] = total[j, :] = total[:, j] = math.nan
        tangent = self._tangent(noise, follow)
        fitted = self._fitted(s, recordings)
        there = [~np.isnan(r.y) for r in recordings]
        logdet = sum(
            float(np.log(2 * math.pi * r.variance[k]).sum())
            for r, k in zip(recordings, there, strict=True)
        )
        _, _, nw, nq, _ = p.kernel.sizes
        n_e = sum(int(k.sum()) for k in there) + (nw + nq) * sum(p.sizes)
        n_e += int((weight > 0).sum()) + (len(p.sizes) * len(self.model.x) if p.prior else 0)
        return FitResult(
            names=self.names,
            estimate=theta[a],
            covariance=total,
            noise_covariance=noise,
            sensitivity=S,
            considered=self.consider,
            undetermined=undetermined,
            weak=weak,
            at_bound=tuple(names[i] for i in stuck),
            loglik=-s.cost - logdet / 2,
            chi2=2 * s.cost,
            freedom=n_e - (p.n_z - len(c) - p.n_g),
            recordings=fitted,
            iterations=s.iterations,
            run=_Run(self, s, lower, upper, tangent),
        )

    def _fitted(self, s: Solution, recordings: Sequence[Recording]) -> tuple[FittedRecording, ...]:
        return tuple(
            FittedRecording(
                r.t,
                l.x,
                l.w,
                l.y,
                self.model.innovation(r.y, l.y) / np.where(np.isnan(r.y), 1.0, np.sqrt(r.variance)),
            )
            for r, l in zip(recordings, self.program.locals_of(s), strict=True)
        )

    def _information(
        self, s: Solution, lower: np.ndarray, upper: np.ndarray, exact: bool
    ) -> tuple[np.ndarray, np.ndarray]:
        """Information on all parameters with everything else re-optimised, scaled units.

        Returns it, (n, n), and how the other unknowns follow the parameters, (n_z - n, n).
        """
        n = self.program.n_theta
        H, J = self.program.quadratic(s, exact)
        m = H.shape[0] - n
        # states at their bounds stay there
        stays = np.flatnonzero((s.z[n:] - lower[n:] <= 1e-9) | (upper[n:] - s.z[n:] <= 1e-9))
        moves = np.setdiff1d(np.arange(m), stays) + n
        Jb = J[:, moves]
        # constraints that only bound what stays would make the system singular
        rows = np.flatnonzero(np.diff(sp.csr_matrix(Jb).indptr) > 0)
        Jb, Ja = Jb[rows], J[rows][:, :n].toarray()
        Hb, Ha = H[moves][:, moves], H[moves][:, :n].toarray()
        k = rows.size
        K = sp.bmat([[Hb, Jb.T], [Jb, sp.csc_matrix((k, k))]], format="csc")
        rhs = -np.vstack([Ha, Ja])
        try:
            lu = splu(K)
            V = lu.solve(rhs)
            # one refinement, and its size as a verdict
            V += lu.solve(rhs - K @ V)
            good = np.isfinite(V).all() and np.abs(rhs - K @ V).max(initial=0.0) <= 1e-6 * (
                1 + np.abs(rhs).max(initial=0.0)
            )
        except RuntimeError:
            good = False
        if not good:
            raise EstimationError(
                f"{self.model.name}: the states are not determined by these data even with all "
                "parameters known; give beliefs of the first states, or measure more"
            )
        follow = np.zeros((m, n))
        follow[moves - n] = V[: moves.size]
        info = H[:n, :n].toarray() + Ha.T @ V[: moves.size] + Ja.T @ V[moves.size :]
        return (info + info.T) / 2, follow

    def _tangent(self, cov: np.ndarray, follow: np.ndarray) -> np.ndarray:
        """Direction of all scaled unknowns when one estimated parameter moves by one unit."""
        p, n = self.program, self.program.n_theta
        out = np.zeros((p.n_z, len(self.free)))
        for j, i in enumerate(self.free):
            step = np.zeros(n)
            if np.isfinite(cov[j, j]) and cov[j, j] > 0:
                column = np.where(np.isfinite(cov[:, j]), cov[:, j], 0.0)
                step[self.free] = column / cov[j, j]
            step[i] = 1.0
            step /= p.theta_scale
            out[:n, j], out[n:, j] = step, follow @ step
        return out


def fit(
    model: FilterModel | Lifted,
    recordings: Recording | Sequence[Recording],
    estimate: Sequence[str],
    *,
    own: Sequence[str] = (),
    guess: Mapping[str, float] | None = None,
    prior: Mapping[str, tuple[float, float]] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    consider: Mapping[str, float] | None = None,
    beliefs: Sequence[Belief] | None = None,
    states: Sequence[Mapping[str, Any]] | None = None,
    exact: bool = False,
    max_iterations: int = 200,
    backend: str | None = None,
    build: bool = False,
) -> FitResult:
    """Estimate parameters that recordings share.

    Args:
        model: a filter's model, or a lifted one; ``steady`` ones take every sample as an
            equilibrium.
        recordings: of the model, one or several.
        estimate: parameters (``model.p``) that all recordings share.
        own: parameters that each recording has for itself; their results are named ``name[r]``.
        guess: start by name; else the prior's mean, else the recordings' values.
        prior: Gaussian priors (mean, sigma) by name.
        bounds: (lowest, highest) by name.
        consider: standard deviations of parameters that are uncertain but not estimated.
        beliefs: of each recording's first state; free without.
        states: guesses of the states of each recording by name, numbers or arrays (K,); else what
            was measured under the same name, the belief's mean, or the magnitude.
        exact: covariance from the Lagrangian's exact Hessian (observed information) instead of
            Gauss and Newton's, which is never indefinite.
        max_iterations: of IPOPT.
        backend, build: see :class:`FitProblem`.

    Raises:
        ParameterError: names or numbers that do not fit the model.
        DataError: a recording does not fit the model.
        EstimationError: not converged, or states that nothing determines.
    """
    data = [recordings] if isinstance(recordings, Recording) else list(recordings)
    problem = FitProblem(
        model,
        [r.size for r in data],
        estimate,
        own=own,
        consider=tuple(consider or ()),
        beliefs=bool(beliefs),
        backend=backend,
        build=build,
    )
    return problem.solve(
        data,
        guess=guess,
        prior=prior,
        bounds=bounds,
        consider=consider,
        beliefs=beliefs,
        states=states,
        exact=exact,
        max_iterations=max_iterations,
    )


def profile(result: FitResult, name: str, *, level: float = 0.95, points: int = 12) -> Profile:
    """Return the profile likelihood of one parameter and the interval where it is high enough.

    The interval holds all values at which twice the loss of log-likelihood stays below the
    chi-squared quantile with one degree of freedom (Wilks 1938; Venzon and Moolgavkar 1988).  Each
    end is found by re-fitting along the direction in which the others follow.

    Args:
        result: from :func:`fit`.
        name: an estimated parameter.
        level: of the interval.
        points: re-fits at most for each end.

    Raises:
        ParameterError: unknown parameter. EstimationError : a re-fit did not converge.
    """
    j = result.index(name)
    run, i = result.run, result.run.problem.free[j]
    program = run.problem.program
    scale = program.theta_scale[i]
    best, target = run.solution, sigmas(level)
    at = best.z[i] * scale
    sigma = result.sigma[j] if np.isfinite(result.sigma[j]) and result.sigma[j] > 0 else None
    seen: dict[float, float] = {at: 0.0}

    def root_drop(value: float, near: Solution) -> tuple[float, Solution]:
        """Signed root of twice the loss, which is nearly linear in the parameter."""
        lower, upper = run.lower.copy(), run.upper.copy()
        lower[i] = upper[i] = value / scale
        z0 = near.z + run.tangent[:, j] * (value - near.z[i] * scale)
        z0 = np.clip(z0, lower, upper)
        s = program.solve(best.data, z0, lower, upper, start=near)
        seen[value] = max(2 * (s.cost - best.cost), 0.0)
        return math.sqrt(seen[value]), s

    def end(sign: float) -> float:
        bound = float((run.upper if sign > 0 else run.lower)[i] * scale)
        step = target * sigma if sigma is not None else 0.01 * scale
        a, ra, near = at, 0.0, best
        b: float = at + sign * step
        for _ in range(points):
            b = min(b, bound) if sign > 0 else max(b, bound)
            rb, near = root_drop(b, near)
            if abs(rb - target) <= 1e-3 * target:
                return b
            if rb < target:
                if b == bound:
                    return bound
                slope = (rb - ra) / abs(b - a) if b != a else 0.0
                a, ra = b, rb
                ahead = (target - rb) / slope if slope > 0 else math.inf
                b = a + sign * min(ahead * 1.02, 4 * max(abs(a - at), step))
                continue
            # bracketed by a and b: false position, damped towards the middle
            lo, hi, rl, rh = a, b, ra, rb
            for _ in range(points):
                x: float = lo + (target - rl) / (rh - rl) * (hi - lo)
                x = min(
                    max(x, min(lo, hi) + 0.05 * abs(hi - lo)), max(lo, hi) - 0.05 * abs(hi - lo)
                )
                r, near = root_drop(x, near)
                if abs(r - target) <= 1e-3 * target or abs(hi - lo) <= 1e-9 * scale:
                    return x
                lo, hi, rl, rh = (x, hi, r, rh) if r < target else (lo, x, rl, r)
            return float(lo + (target - rl) / (rh - rl) * (hi - lo))
        return sign * math.inf

    lower, upper = end(-1.0), end(1.0)
    values = np.array(sorted(seen))
    return Profile(name, values, np.array([seen[v] for v in values.tolist()]), level, lower, upper)
