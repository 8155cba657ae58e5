"""True runs of the gas-path studies: by the filter's own model, and by another engine."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.backend import compiled
from apu_casadi.core.calling import Caller
from apu_casadi.core.errors import EstimationError
from apu_casadi.core.sharing import Parametric, derived
from apu_casadi.gaspath.conditions import DEFAULT_DAY
from apu_casadi.gaspath.gasgenerator import RESIDUAL_TOL, GasGenerator
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.gaspath.steady.steadypoint import Limits
from apu_casadi.gaspath.steady.trimming import trim_gas_generator
from apu_casadi.unit.control import GovernorParameters
from apu_casadi.unit.exchange import EXCHANGES, PAPER, Link, governed_step
from estimators.apu.gaspath import HEALTH_WALK, N_SIGMA, N_WALK, GasPathFilter
from estimators.apu.gaspathmodel import DT, OUTPUTS, gas_path_model
from estimators.models.filtermodel import CHECK_TOL, FilterModel
from scenarios.studies.gaspath.course import FAULT, FINE, Case

BLOCK = 100  # steps of a truth in one call


@dataclass(frozen=True, eq=False)
class Truth:
    """A true run at the filter's instants.

    Args:
        t: s, shape (K,).
        values: N, P3, T3, T5, Wf, PW (mean to the next instant), and the factors, by name.
        process: what was drawn for speed and factors in each step, in their units, shape (5, K);
            None if nothing was.
    """

    t: np.ndarray
    values: dict[str, np.ndarray]
    process: np.ndarray | None = None


def _day() -> dict[str, ca.MX]:
    return {n: ca.MX(v) for n, v in DEFAULT_DAY.items()}


def _folded(name: str, inputs: list[ca.MX], outputs: list[ca.MX]) -> Caller:
    step = ca.Function(name, inputs, outputs)
    return Caller(compiled(step.mapaccum(f"{name}s", BLOCK)))


def _run(call: Caller, carry: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """Fold a truth's step over its inputs (n, K): rows of carry and outputs, (n, K)."""
    K = inputs.shape[1]
    pad = -K % BLOCK
    inputs = np.pad(inputs, ((0, 0), (0, pad)), mode="edge")
    parts = []
    for k in range(0, K + pad, BLOCK):
        carried, out = call(carry, inputs[:, k : k + BLOCK])
        carry = carried[:, -1]
        parts.append(out)
    return np.hstack(parts)[:, :K]


@dataclass(frozen=True, eq=False)
class MatchedTruth(Parametric):
    """The filter's own model, with its own process noise, as truth."""

    gg: GasGenerator

    @derived
    def _model(self) -> FilterModel:
        walks = (("N", N_WALK), *((n, HEALTH_WALK) for n in HEALTH))
        return gas_path_model(self.gg, gains=("J",), walks=walks, governed=GovernorParameters())

    @derived
    def _call(self) -> Caller:
        model = self._model
        link, nx = Link(GovernorParameters(), self.gg.parameters.N), len(model.x)
        carry, given = ca.MX.sym("carry", nx + 1), ca.MX.sym("given", 5 + nx)  # gain_J is last
        x, Wf_I, PW, jump, xi = carry[:nx], carry[nx], given[0], given[1:5], given[5:]
        still = {"sigma_Wf": ca.MX(0), "sigma_PW": ca.MX(0), "jump": ca.MX(1)}
        w, p = ca.MX.zeros(len(model.w)), ca.MX(0, 1)
        w[len(model.w) - 4 :] = jump

        def engine(Wf: ca.MX, PW: ca.MX) -> tuple[ca.MX, tuple[ca.MX, ca.MX]]:
            u = model.u.stack(_day() | still | {"Wf": Wf, "PW": PW})
            y, check = model.output(x, u, p, w)
            x1, check1 = model.transition(x, u, p, w, DT)
            x1 += math.sqrt(DT) * ca.DM(model.walk) * xi
            return x1[0], (x1, ca.vertcat(y, Wf, PW, x[1:5], check + check1))

        made = governed_step(link, PAPER, lambda *_: (PW, None), engine, N=x[0], x=[Wf_I], h=DT)
        x1, seen = made.engine
        after = ca.vertcat(x1, *made.governor)
        return _folded("matched_truth", [carry, given], [after, seen])

    def __call__(self, case: Case, power: np.ndarray, rng: np.random.Generator | None) -> Truth:
        """Simulate a case; process noise from ``rng``, none if it is None."""
        PW = power.reshape(-1, FINE).mean(1)
        PW = np.append(PW, PW[-1])
        K = PW.size
        t = np.arange(K) * DT
        start = _trimmed(self.gg, case.health, PW[0])
        jump = np.zeros((4, K))
        jump[:, round(FAULT / DT)] = case.jump
        xi = np.zeros((6, K)) if rng is None else rng.standard_normal((6, K))
        given = np.vstack([PW, jump, xi])
        N0 = start["N"] + (0.0 if rng is None else N_SIGMA * rng.standard_normal())
        first = np.array([N0, *case.health, case.gains.get("J", 0.0), start["Wf"]])
        out = _run(self._call, first, given)
        _checked(out[-1], t)
        process = math.sqrt(DT) * self._model.walk[:5, None] * xi[:5]
        return Truth(t, dict(zip((*OUTPUTS, "Wf", "PW", *HEALTH), out, strict=False)), process)


@dataclass(frozen=True, eq=False)
class EngineTruth(Parametric):
    """An engine that is not the filter's, with governor, in steps of 5 ms."""

    gg: GasGenerator

    @derived
    def _call(self) -> Caller:
        gg, dt = self.gg, DT / FINE
        link = Link(GovernorParameters(), gg.parameters.N)
        nz = len(gg.z)
        carry, given = ca.MX.sym("carry", 3 + nz), ca.MX.sym("given", 5)
        N, Wf_I, N_dot, z = carry[0], carry[1], carry[2], carry[3:]
        PW = given[0]

        def engine(Wf: ca.MX, PW: ca.MX) -> tuple[ca.MX, list[ca.MX]]:
            N1, *more = gg.step(N, gg.U.stack(_day() | {"Wf": Wf, "PW": PW}), given[1:], dt, z)
            return N1, [N1, *more]

        # fuel of the middle of the step, with the last slope of speed
        way = EXCHANGES["predicted fuel"]
        made = governed_step(
            link, way, lambda *_: (PW, None), engine, N=N, x=[Wf_I], h=dt, slope=N_dot
        )
        N1, _, z1, residual = made.engine
        # a meter reads the fuel of the instant
        Wf, _ = link.fuel(N1, made.governor)
        u_end = gg.U.stack(_day() | {"Wf": Wf, "PW": PW})
        y_end, _ = gg.g(N1, u_end, given[1:], z1)
        after = ca.vertcat(N1, *made.governor, made.slope, z1)
        seen = ca.vertcat(y_end[gg.Y.indices(OUTPUTS)], Wf, given, residual)
        return _folded("engine_truth", [carry, given], [after, seen])

    def __call__(self, case: Case, power: np.ndarray, rng: np.random.Generator) -> Truth:
        """Simulate a case; nothing is drawn from ``rng``."""
        gg, K = self.gg, power.size
        start = _trimmed(gg, case.health, power[0])
        theta = np.repeat(case.health[:, None], K, axis=1)
        theta[:, round(FAULT / DT) * FINE :] += case.jump[:, None]
        carry = np.array([start["N"], start["Wf"], 0.0, *start.z])
        out = _run(self._call, carry, np.vstack([power, theta]))
        t = np.arange(K // FINE + 1) * DT
        _checked(out[-1], t)
        names = (*OUTPUTS, "Wf", "PW", *HEALTH)
        first = [start[n] for n in (*OUTPUTS, "Wf")]
        # instants: the start, then the end of every fourth step
        last = dict(zip(names, out[:, FINE - 1 :: FINE], strict=False))
        values = {n: np.append(first[i], last[n]) for i, n in enumerate(names[:5])}
        PW = power.reshape(-1, FINE).mean(1)
        values["PW"] = np.append(PW, PW[-1])
        values |= {n: np.append(theta[i, 0], last[n]) for i, n in enumerate(HEALTH)}
        return Truth(t, values)


def _trimmed(gg: GasGenerator, health: np.ndarray, PW: float) -> Any:
    # the prior has engines, one in some thousands, that run hotter than an operator would let them;
    # without them the truth would be drawn from a narrower prior than the filter's
    fixed, theta = {"N": gg.parameters.N, "PW": PW}, dict(zip(HEALTH, health.tolist(), strict=True))
    return trim_gas_generator(gg, fixed, theta=theta, limits=Limits(T4_max=math.inf))


def _checked(residual: np.ndarray, t: np.ndarray) -> None:
    tol = max(RESIDUAL_TOL, CHECK_TOL)
    if not (residual <= tol).all():
        k = int(np.argmax(~(residual <= tol)))
        raise EstimationError(f"truth: cycle not solved at sample {k}: {residual[k]:.1e}")


def true_states(filt: GasPathFilter, truth: Truth, case: Case) -> np.ndarray:
    """True values of the filter's states, shape (nx, K)."""
    values = truth.values | {f"gain_{n}": np.full(truth.t.size, v) for n, v in case.gains.items()}
    zero = np.zeros(truth.t.size)
    return np.array([values.get(n, zero) for n in filt.model.x.names])
