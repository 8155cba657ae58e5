"""The classifiers' model: the gas path with two jumps of any direction, and the severity h."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.health import HEALTH
from estimators.apu.gaspathmodel import gas_path_model
from estimators.apu.isolation.problem import (
    FAULTS,
    GAINS,
    P_RATED,
    Protocol,
    severity_of_loss,
)
from estimators.detection.signatures import Jump
from estimators.filters.belief import Belief
from estimators.models.filtermodel import FilterModel

__all__ = ["JUMPS", "directions_of", "jump_model", "model_of", "prior_of"]

_JUMP = ("first", "second")
JUMPS = (*(Jump("state", n) for n in FAULTS[:-1]), Jump("state", "size_1"))
"""One for each of ``FAULTS``; direction 1 is the loss."""


@kept
def jump_model(gg: GasGenerator) -> FilterModel:
    """The gas-path filter's model with two jumps of any direction, and the severity as an output.

    States beside those of :func:`~estimators.apu.gaspathmodel.gas_path_model`: ``size_1``,
    ``size_2``, and the offset ``h_0``.  Inputs beside its own: the directions ``first_<fault>`` and
    ``second_<fault>``, so that one compiled filter serves all hypotheses.
    """
    base = gas_path_model(gg, gains=GAINS)
    sizes = [
        Signal(f"size_{k}", "1", f"size of the {n} jump", default=0.0, nominal=0.01)
        for k, n in enumerate(_JUMP, 1)
    ]
    offset = Signal("h_0", "1", "offset of the measured severity", default=0.0, nominal=1e-4)
    directions = [
        Signal(f"{k}_{n}", "1", f"share of {n} in the {k} jump", default=0.0)
        for k in _JUMP
        for n in FAULTS
    ]
    h = Signal("h", "1", "TTSC severity, by the electrical filter", nominal=1e-4)
    X, U = base.x + Signals([*sizes, offset]), base.u + Signals(directions)
    nx, nu, q = len(base.x), len(base.u), len(FAULTS)
    x, u, w = ca.MX.sym("x", len(X)), ca.MX.sym("u", len(U)), ca.MX.sym("w", len(base.w))
    p, dt = ca.MX.sym("p", 0), ca.MX.sym("dt")
    jump = u[nu : nu + q] * x[nx] + u[nu + q :] * x[nx + 1]
    moved, given = ca.MX(x[:nx]), ca.MX(u[:nu])
    for i, name in enumerate(FAULTS[:-1]):
        moved[base.x.index(name)] += jump[i]
    # shaft power that is taken, but not measured
    given[base.u.index("PW")] += P_RATED * jump[q - 1]
    x1, check = base.transition(moved, given, p, w, dt)
    y, check_y = base.output(moved, given, p, w)
    N = base.x.index("N")
    after = ca.vertcat(*(x1[i] if i == N else x[i] for i in range(len(X))))
    reading = ca.vertcat(y, x[nx + 2] + severity_of_loss() * jump[q - 1])
    return FilterModel.of(
        "isolation",
        (X, U, base.p, base.w, base.y + Signals([h])),
        (x, u, p, w, dt),
        (after, check),
        (reading, check_y),
    )


@kept
def model_of(gg: GasGenerator, N_walk: float) -> FilterModel:
    """Return the model with process noise of the speed, rad/s/sqrt(s)."""
    return jump_model(gg).with_walk({"N": N_walk})


def prior_of(model: FilterModel, protocol: Protocol, N: float) -> Belief:
    """Return what the protocol says is known of a unit at a speed N, rad/s, before the window."""
    known = protocol.baseline
    sigma = {"N": 0.005 * N, "h_0": known * protocol.h_offset, "size_1": 0.0, "size_2": 0.0}
    sigma |= dict.fromkeys(HEALTH, known * protocol.wear)
    sigma |= {f"gain_{n}": known * protocol.sensors[n].gain for n in GAINS}
    return Belief.of(model.x, {"N": N} | dict.fromkeys(HEALTH, 1.0), sigma)


def directions_of(faults: Sequence[str]) -> dict[str, float]:
    """Return the inputs that let the first and second jump be these faults."""
    return {f"{_JUMP[k]}_{n}": 1.0 for k, n in enumerate(faults)}
