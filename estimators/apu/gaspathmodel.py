"""The model of the gas-path filter: rotor speed, health factors, sensor errors, lagging sensors.

The cycle is solved once for each evaluation, and its derivatives are those of the implicit function
theorem at the solution (:attr:`Cycle.sensitivities`), not of the iteration.

A sensor with a lag tau has a state of its own: tau dx/dt = v - x with the value v of the middle of
the step, by which the speed goes on as well, held over the step:

    x(k+1) = v + exp(-dt/tau) (x(k) - v).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.unit.control import Governor, GovernorParameters
from estimators.apu.sensors import GAS_PATH, Sensor
from estimators.models.filtermodel import FilterModel

__all__ = [
    "DT",
    "GAINED",
    "GOVERNOR",
    "OUTPUTS",
    "engine_function",
    "gas_path_model",
    "model_sensors",
]

DT = 0.02  # s; step of the gas-path filter (paper, section 3.3)
OUTPUTS = GAS_PATH.outputs
GAINED = GAS_PATH.uncertain
POWER = ("measured", "unknown")
GOVERNOR = GovernorParameters()


@kept
def engine_function(gg: GasGenerator, outputs: tuple[str, ...] = OUTPUTS[1:]) -> ca.Function:
    """The cycle as Function (N, u, theta) -> (xdot, y, check, z) with exact, cheap derivatives.

    ``y`` are the outputs.  The Jacobian is handed the solved z, so it costs no second solution.
    """
    c = gg.cycle
    rows = gg.Y.indices(outputs)
    x, _, u, theta = c.symbols()
    z = c.solve(c.similar(x, u), x, u, theta)
    ode, alg, y = c.equations(x, z, u, theta)
    made = {"xdot": ode, "y": y[rows], "check": ca.norm_1(alg), "z": z}
    given = {"x": x, "u": u, "theta": theta}
    nominal = {f"out_{k}": ca.MX.sym(k, *v.shape) for k, v in made.items()}
    _, _, xdot_w, y_w, z_w = c.sensitivities(x, nominal["out_z"], u, theta)
    width = [len(gg.X), len(gg.U), len(gg.THETA)]
    ends = np.cumsum([0, *width]).tolist()
    whole = [xdot_w, y_w[rows, :], ca.MX(1, ends[-1]), z_w]
    blocks = [d[:, i:j] for d in whole for i, j in pairwise(ends)]
    names = [*given, *nominal], [f"jac_{o}_{i}" for o in made for i in given]
    jac = ca.Function("jac_gas_path", [*given.values(), *nominal.values()], blocks, *names)
    # forward and reverse derivatives are made from the Jacobian above
    options = {"custom_jacobian": jac, "jac_penalty": 0}
    options |= dict.fromkeys(("enable_forward", "enable_reverse", "enable_fd"), False)
    return ca.Function("gas_path", [*given.values()], [*made.values()], [*given], [*made], options)


_GAIN_DOCS = {
    "PW": "relative error of the shaft power that the generators' efficiency gives",
    "J": "relative error of the rotor's inertia",
}


def model_sensors(gg: GasGenerator, sensors: Sequence[Sensor]) -> tuple[Sensor, ...]:
    """Return what the model takes of output sensors.

    Raises:
        ParameterError: a sensor of an output that is not there, or that depends on shaft power,
            which is not known at the sample.
    """
    of_inputs = gg.equations.jac_sparsity(2, 2)  # dy/du
    for s in sensors:
        for n in s.reads:
            if n not in gg.Y.names:
                raise ParameterError(f"sensor {s.name}: no output {n!r} {nearest(n, gg.Y.names)}")
            if of_inputs.has_nz(gg.Y.index(n), gg.U.index("PW")):
                raise ParameterError(
                    f"sensor {s.name} reads {n}, which depends on the shaft power of the step that "
                    "begins at the sample: a gas-path filter cannot take it as an output"
                )
    return tuple(s.model() for s in sensors)


def _relative(name: str, doc: str, default: float | None = 0.0) -> Signal:
    return Signal(name, "1", doc, default=default, nominal=0.01)


def _states(
    gg: GasGenerator, known: bool, gains: Sequence[str], sensors: Sequence[Sensor]
) -> Signals:
    power = () if known else (dataclasses.replace(gg.U["PW"], default=None),)
    docs = {n: _GAIN_DOCS.get(n, f"relative gain error of the sensor of {n}") for n in gains}
    errors = [_relative(f"gain_{n}", doc) for n, doc in docs.items()]
    lags = [dataclasses.replace(s.signal, default=None) for s in sensors if s.tau]
    return Signals([*gg.X, *gg.THETA, *power, *errors, *lags])


def _inputs(gg: GasGenerator, known: bool, power_jumps: bool) -> tuple[Signals, Signals]:
    """Inputs and noises."""
    measured = ("Wf", "PW") if known else ("Wf",)
    spread = [
        Signal(
            f"sigma_{n}",
            gg.U[n].unit,
            f"standard deviation of the measured {n}",
            default=0.0,
            nominal=0.01 * gg.U[n].nominal,
        )
        for n in measured
    ]
    U = [s for s in gg.U if known or s.name != "PW"] + spread
    U += [_relative("jump", "standard deviation of a sudden change of health in this step")]
    W = [Signal(f"w_{n}", "1", f"error of the measured {n} over its sigma") for n in measured]
    if power_jumps:
        U += [_relative("jump_PW", "the same of gain_PW")]
        W += [Signal("w_gain_PW", "1", "sudden change of gain_PW over jump_PW")]
    W += [Signal(f"w_{n}", "1", f"sudden change of {n} over jump") for n in HEALTH]
    return Signals(U), Signals(W)


def _check_gains(
    power: str, gains: Sequence[str], consider: Sequence[str], power_jumps: bool, names: set[str]
) -> None:
    if power not in POWER:
        raise ParameterError(f"power {power!r} {nearest(power, POWER)}")
    if power_jumps and ("PW" not in gains or "gain_PW" in consider):
        raise ParameterError("power_jumps: gain_PW must be among the estimated states")
    measured = (*GAINED, *sorted(names - {*OUTPUTS, *GAINED}))
    possible = (*measured, "PW", "J") if power == "measured" else measured
    for n in gains:
        if n not in possible:
            raise ParameterError(f"gain of {n!r} {nearest(n, possible)} with power {power!r}")


def _lagged(
    sensors: Sequence[Sensor], y: dict[str, Any], at: dict[str, Any], dt: Any
) -> dict[str, Any]:
    """States of lagging sensors at the end of a step, of the outputs amid it."""
    lag = {s.name: (s.of(y), s.tau) for s in sensors if s.tau}
    return {n: v + ca.exp(-dt / tau) * (at[n] - v) for n, (v, tau) in lag.items()}


@kept
def gas_path_model(
    gg: GasGenerator,
    *,
    power: str = "measured",
    gains: tuple[str, ...] = GAINED,
    consider: tuple[str, ...] = (),
    walks: tuple[tuple[str, float], ...] = (),
    governed: Governor | None = None,
    power_jumps: bool = False,
    sensors: tuple[Sensor, ...] | None = None,
) -> FilterModel:
    """Make the filter's model; :func:`~.gaspath.gas_path_filter` is the convenient form.

    The speed goes on by the explicit midpoint rule; the health factors stay, but for walk and
    jump.  Inputs are held over the step, except that fuel may follow the law of its governor from
    one reading to the next: held, it would be half a step late, 16 kW after a load drop.

    Args:
        gg: the gas generator as the filter knows it.
        power: ``"measured"``: PW is an input; ``"unknown"``: a state with a random walk.
        gains: sensors whose relative gain error is a state: of outputs (N excepted), Wf, PW; and J,
            the inertia, of which a relative error is a state in the same way.
        consider: which states are considered, not estimated.
        walks: pairs of state name and random walk, unit of the state per sqrt(s).
        governed: law that the fuel follows within a step (limits left out); None: it is held.
        power_jumps: add the input ``jump_PW``: standard deviation of a sudden change of
            ``gain_PW``.
        sensors: of the outputs, as :func:`model_sensors` gives them; those of the table by default.

    Raises:
        ParameterError: unknown ``power`` or gain, the gain of a power that is not measured, or
            jumps of a gain that is not estimated.
    """
    if sensors is None:
        sensors = model_sensors(gg, GAS_PATH.only(OUTPUTS).sensors)
    known = power == "measured"
    _check_gains(power, gains, consider, power_jumps, {s.name for s in sensors})
    X, (U, W) = _states(gg, known, gains, sensors), _inputs(gg, known, power_jumps)
    x, u, w = (ca.MX.sym(n, len(s)) for n, s in (("x", X), ("u", U), ("w", W)))
    p, dt = ca.MX.sym("p", 0), ca.MX.sym("dt")
    at, given, noise = (
        dict(zip(s.names, ca.vertsplit(v), strict=True)) for s, v in ((X, x), (U, u), (W, w))
    )

    def true(name: str) -> Any:  # reading = (1 + gain) true + sigma w
        error = given[f"sigma_{name}"] * noise[f"w_{name}"]
        return (given[name] - error) / (1 + at.get(f"gain_{name}", 0.0))

    reads = dict.fromkeys(n for s in sensors for n in s.reads if n not in gg.X.names)
    engine, N = engine_function(gg, tuple(reads)), at["N"]
    inputs = {n: given[n] for n in AMBIENT} | {"Wf": true("Wf")}
    # the outputs do not depend on the shaft power
    before = ca.vertcat(*(at[n] for n in HEALTH))
    _, y, check_out, _ = engine(N, gg.U.stack(inputs | {"PW": ca.MX(0)}), before)
    seen = {"N": N} | {n: y[i] for i, n in enumerate(reads)}
    own = {s: at[s.name] if s.tau else s.of(seen) for s in sensors}
    readings = [v * (1 + at.get(f"gain_{s.name}", 0.0)) for s, v in own.items()]
    # a jump happens at the beginning of the step, after the sample
    at |= {n: at[n] + given["jump"] * noise[f"w_{n}"] for n in HEALTH}
    if power_jumps:
        at["gain_PW"] += given["jump_PW"] * noise["w_gain_PW"]
    inputs["PW"] = true("PW") if known else at["PW"]
    u_gg, health = gg.U.stack(inputs), ca.vertcat(*(at[n] for n in HEALTH))
    k1, _, check, _ = engine(N, u_gg, health)
    k1 = k1 / (1 + at.get("gain_J", 0.0))
    if governed is not None:
        slope = governed.slope(N, k1, gg.parameters.N)
        u_gg = gg.U.stack(inputs | {"Wf": inputs["Wf"] + dt / 2 * slope})
    k2, y_mid, check_mid, _ = engine(N + dt / 2 * k1, u_gg, health)
    x1 = at | {"N": N + dt * k2 / (1 + at.get("gain_J", 0.0))}
    amid = {"N": N + dt / 2 * k1} | {n: y_mid[i] for i, n in enumerate(reads)}
    x1 |= _lagged(sensors, amid, at, dt)
    signals = X, U, Signals(), W, Signals([s.signal for s in sensors])
    step = ca.vertcat(*x1.values()), check + check_mid
    output, name = (ca.vertcat(*readings), check_out), f"gas_path_{power}"
    made = FilterModel.of(name, signals, (x, u, p, w, dt), step, output, consider=consider)
    return made.with_walk(dict(walks))
