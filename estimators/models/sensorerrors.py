"""What sensors make of a model's outputs: gain errors, biases and lags.

As the functions of :mod:`estimators.models.filtermodel` these return changed models.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca

from apu_casadi.core.sharing import of_family, remade
from apu_casadi.core.signals import Signal, Signals
from estimators.models.filtermodel import FilterModel, Unknown

__all__ = ["biases", "gains", "lagging"]


def _sensor_errors(model: FilterModel, names: Sequence[str], kind: str) -> FilterModel:
    rows = model.y.indices(names)
    n = len(model.p)
    what = {"gain": "relative gain error", "bias": "bias"}[kind]
    extra = Signals(
        [
            Signal(f"{kind}_{y.name}", unit, f"{what} of the sensor of {y.name}", 0.0, 0.01 * size)
            for y in (model.y[i] for i in rows)
            for unit, size in [("1", 1.0) if kind == "gain" else (y.unit, y.nominal)]
        ]
    )
    x, u, _, w, dt = model.symbols()
    p = ca.MX.sym("p", n + len(extra))
    y, check = model.output(x, u, p[:n], w)
    spread = ca.DM(len(model.y), len(extra))
    for j, i in enumerate(rows):
        spread[i, j] = 1
    error = ca.mtimes(spread, p[n:])
    y = y * (1 + error) if kind == "gain" else y + error
    return FilterModel.of(
        model.name,
        (model.x, model.u, model.p + extra, model.w, model.y),
        (x, u, p, w, dt),
        model.transition(x, u, p[:n], w, dt),
        (y, check),
        like=model,
    )


@remade
@of_family
def gains(model: FilterModel, names: Sequence[str]) -> FilterModel:
    """Return the model with parameters ``gain_<name>``: that sensor reads (1 + gain) y.

    Raises:
        SignalError: unknown output.
    """
    return _sensor_errors(model, names, "gain")


@remade
@of_family
def biases(model: FilterModel, names: Sequence[str]) -> FilterModel:
    """Return the model with parameters ``bias_<name>``: that sensor reads y + bias.

    Raises:
        SignalError: unknown output.
    """
    return _sensor_errors(model, names, "bias")


@remade
@of_family
def lagging(
    model: FilterModel, outputs: Sequence[tuple[Signal, Callable[..., Any], Sequence[str], float]]
) -> FilterModel:
    """Return the model with readings as its outputs, of which some lag.

    Args:
        outputs: for each the signal, the expression of some outputs that it is, their names, and
            the time constant of a first-order lag, s; 0 without.  A lag's state has the name of its
            signal and is appended; its discretisation is exact for outputs that are held over the
            step, as inputs are.

    Raises:
        SignalError: unknown output.
    """
    lags = [(i, tau) for i, (_, _, _, tau) in enumerate(outputs) if tau]
    nx = len(model.x)
    _, u, p, w, dt = model.symbols()
    x = ca.MX.sym("x", nx + len(lags))
    y, check = model.output(x[:nx], u, p, w)
    read = [value(*(y[model.y.index(n)] for n in names)) for _, value, names, _ in outputs]
    x1, checked = model.transition(x[:nx], u, p, w, dt)
    for j, (i, tau) in enumerate(lags):
        x1 = ca.vertcat(x1, read[i] + ca.exp(-dt / tau) * (x[nx + j] - read[i]))
        read[i] = x[nx + j]
    states = [dataclasses.replace(outputs[i][0], default=None) for i, _ in lags]
    return FilterModel.of(
        model.name,
        (model.x + Signals(states), model.u, model.p, model.w, Signals([s for s, *_ in outputs])),
        (x, u, p, w, dt),
        (x1, checked + check if lags else checked),
        (ca.vertcat(*read), check),
        like=model,
        more={s.name: Unknown() for s in states},
    )
