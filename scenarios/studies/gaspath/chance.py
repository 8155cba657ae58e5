"""What chance alone gives on the seeds of a gas-path study."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from apu_casadi.core.errors import EstimationError
from apu_casadi.gaspath.health import HEALTH
from estimators.apu.gaspath import JUMP, GasPathFilter
from estimators.apu.gaspathmodel import OUTPUTS
from estimators.information import consistency
from estimators.information.bounds import linearisations, snapshot_bound
from estimators.models.recording import Recording
from scenarios.studies.gaspath.course import FAULT, Case, power_profile
from scenarios.studies.gaspath.enginetruth import MatchedTruth, Truth, true_states


@dataclass(eq=False)
class LinearReference:
    """The Kalman filter of the linearised model on a study's own draws: what chance alone gives.

    Linearised along one run of a healthy engine, the filter's model is linear and Gaussian, and its
    Kalman filter exact: the normalised error squared of four factors is chi-squared with 4 degrees
    of freedom.  Fed with the very numbers that were drawn for each seed of a matched study (prior
    errors, noises, jump), its errors follow those of the filter that is tried, within what is
    not linear (correlation 0.99): of the mean of 500 seeds, which is within 0.25 of 4 at 95 %, the
    *difference* is known to 0.04.

    Args:
        filt: the filter that is tried; it estimates all its states, the shaft power is measured.
    """

    filt: GasPathFilter
    _drawn: list[tuple[np.ndarray, ...]] = dataclasses.field(default_factory=list, init=False)

    def add(self, truth: Truth, case: Case, data: Recording) -> None:
        """Take what was drawn for a seed.

        Raises:
            EstimationError: a truth whose process noise is not known.
        """
        if truth.process is None:
            raise EstimationError("what chance gives is known for matched truths only")
        filt, K = self.filt, truth.t.size
        X, W = filt.model.x, filt.model.w
        x, w, q = np.zeros(len(X)), np.zeros((len(W), K)), np.zeros((len(X), K))
        named = {"N": truth.values["N"][0] - filt.gg.parameters.N}
        named |= dict(zip(HEALTH, case.health - 1, strict=True))
        named |= {f"gain_{n}": v for n, v in case.gains.items()}
        for n, v in named.items():
            x[X.index(n)] = v
        q[X.indices(("N", *HEALTH))] = truth.process
        jumps = np.flatnonzero(data.u[filt.model.u.index("jump")])
        hit = np.array(W.indices([f"w_{n}" for n in HEALTH]))
        w[hit[:, None], jumps] = case.jump[:, None] / JUMP

        def drawn(name: str, reading: np.ndarray) -> np.ndarray:
            clean = (1 + case.sensors.get(name, 0.0)) * truth.values[name]
            sensor = filt.sensors[name]
            return (reading - clean) / (sensor.noise * (np.abs(clean) if sensor.relative else 1.0))

        for n in ("Wf", "PW"):
            w[W.index(f"w_{n}")] = drawn(n, data.u[filt.model.u.index(n)])
        v = np.array([drawn(n, data.y[i]) for i, n in enumerate(OUTPUTS)])
        self._drawn.append((x, w, v, q))

    def errors(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return errors of the factors, (seeds, rows, 4), and their covariances, (rows, 4, 4)."""
        filt, x, w, v, q = self.filt, *(np.array(d) for d in zip(*self._drawn, strict=True))
        nominal = Case(np.ones(4), np.zeros(4), {})
        truth = MatchedTruth(filt.gg)(nominal, power_profile(), None)
        data = filt.measured(truth.t, truth.values, None, jumps=[FAULT])
        H, F = linearisations(filt.model, data, true_states(filt, truth, nominal))
        nx, nw, walk = len(filt.model.x), len(filt.model.w), filt.model.walk
        i = filt.model.x.index(HEALTH[0])
        health, place = slice(i, i + 4), {int(k): j for j, k in enumerate(rows)}
        e, P_e = np.empty((len(x), len(rows), 4)), np.empty((len(rows), 4, 4))
        P, error = filt.prior().cov, -x  # estimate minus truth
        for k in range(data.size):
            Pa = np.zeros((nx + nw, nx + nw))
            Pa[:nx, :nx], Pa[nx:, nx:] = P, np.eye(nw)
            joint = np.hstack([error, -w[:, :, k]])
            R = data.variance[:, k]
            S = H[k] @ Pa @ H[k].T + np.diag(R)
            K = np.linalg.solve(S, H[k] @ Pa).T
            joint += (v[:, :, k] * np.sqrt(R) - joint @ H[k].T) @ K.T
            Pa = snapshot_bound(H[k], R, Pa)
            if k in place:
                e[:, place[k]], P_e[place[k]] = joint[:, health], Pa[health, health]
            P = F[k] @ Pa @ F[k].T + np.diag(walk**2) * data.dt[k]
            error = joint @ F[k].T - q[:, :, k]
        return e, P_e

    def nees(self, rows: np.ndarray) -> np.ndarray:
        """Return the normalised error squared of the factors at some samples, (seeds, rows)."""
        return consistency.nees(*self.errors(rows))
