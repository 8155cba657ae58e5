"""The information limit: Bayes' rule in the linear problem, where no classifier is better."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np
from scipy import special

from apu_casadi.core.sharing import kept
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.steady.steadypoint import Limits
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from estimators.apu.isolation.evidence import class_evidence
from estimators.apu.isolation.problem import CLASSES, DEFAULT, DT, FAULTS, OUTPUTS, Protocol
from estimators.apu.isolation.scores import scores
from estimators.apu.isolation.windowmodel import JUMPS, directions_of, model_of, prior_of
from estimators.detection.signatures import LinearFilter, linear_filter
from estimators.models.filtermodel import FilterModel, inlined

__all__ = ["information_limit", "linear_problem", "white_signatures"]


def linear_problem(
    PW: float, dT_isa: float, protocol: Protocol = DEFAULT, gg: GasGenerator | None = None
) -> LinearFilter:
    """The classifier's filter at a steady point, with exact derivatives: linear and Gaussian."""
    gg = GasGenerator() if gg is None else gg
    model = model_of(gg, protocol.N_walk)
    point = trim_gas_generator(
        gg, {"N": gg.parameters.N, "PW": PW}, limits=Limits(T4_max=math.inf), dT_isa=dT_isa
    )
    pr, s = protocol, protocol.sensors
    inputs = dict(zip(gg.U.names, point.u, strict=True)) | directions_of(["loss"])
    inputs |= {f"sigma_{n}": pr.noise * s.sigma(n, point[n]) for n in ("Wf", "PW")}
    prior = prior_of(model, pr, gg.parameters.N)
    F, Fw, H, Hw = (
        np.asarray(M, float) for M in _jacobians(model)(prior.mean, model.u.pack(inputs), DT)
    )
    sigma = [pr.noise * (pr.h_noise if n == "h" else s.sigma(n, point[n])) for n in OUTPUTS]
    y = np.zeros((pr.size, len(OUTPUTS)))
    if not pr.electrical:
        y[:, OUTPUTS.index("h")] = np.nan
    state = np.zeros((len(model.x), len(JUMPS)))
    for c, j in enumerate(JUMPS):
        state[model.x.index(j.name), c] = 1.0
    Q, R = Fw @ Fw.T + DT * np.diag(model.walk**2), np.diag(np.square(sigma)) + Hw @ Hw.T
    noise = {"Q": Q, "R": R, "P0": prior.cov, "cross": Fw @ Hw.T}
    return linear_filter(y, A=F, H=H, **noise, names=FAULTS, state=state)


@kept
def _jacobians(model: FilterModel) -> ca.Function:
    x, u, p, w, dt = model.symbols()
    x1, y = inlined(model.transition, x, u, p, w, dt)[0], inlined(model.output, x, u, p, w)[0]
    J = [ca.jacobian(e, v) for e in (x1, y) for v in (x, w)]
    f = ca.Function("J", [x, u, p, w, dt], J)
    xs, us, ts = ca.MX.sym("x", len(model.x)), ca.MX.sym("u", len(model.u)), ca.MX.sym("dt")
    none = ca.MX(0, 1), ca.MX(len(model.w), 1)
    return ca.Function("jacobians", [xs, us, ts], f.call([xs, us, none[0], none[1], ts]))


def white_signatures(f: LinearFilter, onsets: np.ndarray) -> np.ndarray:
    """Return what unit jumps add to whitened innovations, (onsets, K ny, q); 0 before the onset."""
    K, ny = f.innovation.shape
    L = np.linalg.inv(np.linalg.cholesky(f.S))
    out = np.zeros((onsets.size, K, ny, len(f.names)))
    for i, k in enumerate(onsets):
        out[i, k:] = L[k:] @ f.signature(int(k))
    return out.reshape(onsets.size, K * ny, len(f.names))


def information_limit(
    draws: int = 200,
    seed: int = 0,
    protocol: Protocol = DEFAULT,
    gg: GasGenerator | None = None,
    *,
    points: int = 8,
    onset_known: bool = False,
) -> dict[str, Any]:
    """Classify by Bayes' rule where that is exact: linear, Gaussian, all priors known.

    No classifier has a higher expected share of right answers in that problem.  What the real one
    loses against it is due to method, not to information.

    Args:
        draws: windows of each class at each operating point.
        seed: of the draws.
        protocol, gg: as in the study.
        points: operating points, drawn like those of the study.
        onset_known: tell the classifier the onset.

    Returns:
        As :func:`scores`.
    """
    rng = np.random.default_rng([7, seed])
    n = len(CLASSES)
    confusion = np.zeros((n, n), int)
    # half of the points of the study carry a load step as well; it is measured, so it adds nothing
    for _ in range(points):
        f = linear_problem(rng.uniform(200e3, 420e3), rng.uniform(-15, 15), protocol, gg)
        G = white_signatures(f, protocol.onsets)
        C = np.einsum("okp,okq->opq", G, G)
        for label, c in enumerate(CLASSES):
            s = np.zeros((draws, len(FAULTS)))
            for i in range(draws):
                for name, size in c.draw(rng).items():
                    s[i, FAULTS.index(name)] = size
            at = rng.integers(G.shape[0], size=draws)
            white = np.einsum("nkq,nq->nk", G[at], s) + rng.standard_normal((draws, G.shape[1]))
            if onset_known:
                b = np.einsum("nkq,nk->nq", G[at], white)
                each = class_evidence(b, C[at])
            else:
                b = np.einsum("okq,nk->noq", G, white)
                each = special.logsumexp(
                    class_evidence(b, np.broadcast_to(C, (draws, *C.shape))), axis=2
                )
            confusion[label] += np.bincount(np.argmax(each, axis=0), minlength=n)
    return scores(confusion)
