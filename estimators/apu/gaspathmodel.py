"""The model of the gas-path filter: rotor speed, health factors, sensor errors, lagging sensors.

The cycle is solved once for each evaluation, and its derivatives are those of the implicit function
theorem at the solution (:attr:`Cycle.sensitivities`), not of the iteration.

The model is one of a family: the numbers of the engine are known parameters of what is compiled.
In the usual family they are held, without derivatives by them.  Where some are *free*, states of
the filter, the family is that of ``GasGenerator.by_parameters``, which solves the design point in
every step: its derivatives by every parameter are exact.

A sensor with a lag tau has a state of its own: tau dx/dt = v - x with the value v of the middle of
the step, by which the speed goes on as well, held over the step:

    x(k+1) = v + exp(-dt/tau) (x(k) - v).

So has the sensor of an input that lags, ``Wf_lag``; the input itself is then a state that walks,
``Wf``, which follows the governor's law, and the reading an output.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from apu_casadi.core.errors import ParameterError, nearest
from apu_casadi.core.sharing import kept
from apu_casadi.core.signals import Signal, Signals
from apu_casadi.gaspath.conditions import AMBIENT
from apu_casadi.gaspath.cyclefunctions import CycleFunctions
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.gaspath.stations import THETA, U, X, Y
from apu_casadi.unit.control import Governor, GovernorParameters
from estimators.apu.sensors import GAS_PATH, Sensor
from estimators.models.angles import angular
from estimators.models.filtermodel import FilterModel, Unknown, augment

__all__ = [
    "DT",
    "GAINED",
    "GOVERNOR",
    "LAGGING",
    "OUTPUTS",
    "engine_function",
    "gas_path_model",
    "lag_of",
    "model_sensors",
]

DT = 0.02  # s; step of the gas-path filter (paper, section 3.3)
OUTPUTS = GAS_PATH.outputs
GAINED = GAS_PATH.uncertain
POWER = ("measured", "unknown")
LAGGING = ("Wf", "PW")  # measured inputs, of which the sensors may lag
GOVERNOR = GovernorParameters()


@kept
def engine_function(c: CycleFunctions, outputs: tuple[str, ...] = OUTPUTS[1:]) -> ca.Function:
    """The cycle as Function (N, u, theta) -> (xdot, y, check, z) with exact, cheap derivatives.

    ``y`` are the outputs.  The Jacobian is handed the solved z, so it costs no second solution.

    Args:
        c: the cycle of one engine, or of a family of them.
        outputs: names.
    """
    rows = Y.indices(outputs)
    x, _, u, theta = c.symbols()
    z = c.solve(c.start(x, u, theta), x, u, theta)
    ode, _, y = c.equations(x, z, u, theta)
    made = {"xdot": ode, "y": y[rows], "check": y[Y.index("residual")], "z": z}
    given = {"x": x, "u": u, "theta": theta}
    nominal = {f"out_{k}": ca.MX.sym(k, *v.shape) for k, v in made.items()}
    _, _, xdot_w, y_w, z_w = c.sensitivities(x, nominal["out_z"], u, theta)
    ends = np.cumsum([0, *(len(v) for v in (X, U, c.theta))]).tolist()
    whole = [xdot_w, y_w[rows, :], ca.MX(1, 0), z_w]
    # none by numbers that are held
    whole = [ca.horzcat(d, ca.MX(d.shape[0], ends[-1] - d.shape[1])) for d in whole]
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
_LOSS = "shaft power beyond the measured one, the loss of a short circuit that is not known"


def model_sensors(gg: GasGenerator, sensors: Sequence[Sensor]) -> tuple[Sensor, ...]:
    """Return what the model takes of output sensors.

    Raises:
        ParameterError: a sensor of an output that is not there, or that depends on shaft power,
            which is not known at the sample.
    """
    of_inputs = gg.family.equations.jac_sparsity(2, 2)  # dy/du
    for s in (s for s in sensors if s.name not in LAGGING):
        for n in s.reads:
            if n not in Y.names:
                raise ParameterError(f"sensor {s.name}: no output {n!r} {nearest(n, Y.names)}")
            if of_inputs.has_nz(Y.index(n), U.index("PW")):
                raise ParameterError(
                    f"sensor {s.name} reads {n}, which depends on the shaft power of the step that "
                    "begins at the sample: a gas-path filter cannot take it as an output"
                )
    return tuple(s.model() for s in sensors)


def _relative(name: str, doc: str, default: float | None = 0.0) -> Signal:
    return Signal(name, "1", doc, default=default, nominal=0.01)


def lag_of(s: Sensor) -> str:
    """Return the state of a sensor that lags: its name is the input's where it reads one."""
    return f"{s.name}_lag" if s.name in LAGGING else s.name


def _states(
    held: Sequence[str],
    gains: Sequence[str],
    biases: Sequence[str],
    sensors: Sequence[Sensor],
    loss: bool,
) -> Signals:
    inputs = [dataclasses.replace(U[n], default=None) for n in reversed(LAGGING) if n not in held]
    docs = {n: _GAIN_DOCS.get(n, f"relative gain error of the sensor of {n}") for n in gains}
    errors = [_relative(f"gain_{n}", doc) for n, doc in docs.items()]
    signals = {s.name: s for s in (*U, *(s.signal for s in sensors))}
    errors += [
        Signal(f"bias_{n}", s.unit, f"offset of the sensor of {n}", 0.0, 0.01 * s.nominal)
        for n, s in ((n, signals[n]) for n in biases)
    ]
    lags = [dataclasses.replace(s.signal, name=lag_of(s), default=None) for s in sensors if s.tau]
    losses = [Signal("loss_PW", "W", _LOSS, default=0.0, nominal=1e4)] if loss else []
    return Signals([*X, *THETA, *inputs, *errors, *lags, *losses])


def _inputs(measured: Sequence[str], power_jumps: bool, loss: bool) -> tuple[Signals, Signals]:
    """Inputs and noises."""
    spread = [
        Signal(
            f"sigma_{n}",
            U[n].unit,
            f"standard deviation of the measured {n}",
            default=0.0,
            nominal=0.01 * U[n].nominal,
        )
        for n in measured
    ]
    given = [s for s in U if s.name in measured or s.name not in LAGGING] + spread
    given += [_relative("jump", "standard deviation of a sudden change of health in this step")]
    W = [Signal(f"w_{n}", "1", f"error of the measured {n} over its sigma") for n in measured]
    if power_jumps:
        given += [_relative("jump_PW", "the same of gain_PW")]
        W += [Signal("w_gain_PW", "1", "sudden change of gain_PW over jump_PW")]
    if loss:
        text = "standard deviation of a sudden change of loss_PW in this step"
        given += [Signal("jump_loss", "W", text, default=0.0, nominal=1e4)]
        W += [Signal("w_loss_PW", "1", "sudden change of loss_PW over jump_loss")]
    W += [Signal(f"w_{n}", "1", f"sudden change of {n} over jump") for n in HEALTH]
    return Signals(given), Signals(W)


def _check_gains(
    power: str,
    gains: Sequence[str],
    consider: Sequence[str],
    power_jumps: bool,
    loss: bool,
    names: set[str],
) -> None:
    if power not in POWER:
        raise ParameterError(f"power {power!r} {nearest(power, POWER)}")
    if loss and (power != "measured" or "PW" in names):
        raise ParameterError("loss: the shaft power must be measured, without a lag")
    if power_jumps and ("PW" not in gains or "gain_PW" in consider):
        raise ParameterError("power_jumps: gain_PW must be among the estimated states")
    measured = (*GAINED, *sorted(names - {*OUTPUTS, *GAINED, "PW"}))
    possible = (*measured, "PW", "J") if power == "measured" else measured
    for n in gains:
        if n not in possible:
            raise ParameterError(f"gain of {n!r} {nearest(n, possible)} with power {power!r}")


def _lagged(
    sensors: Sequence[Sensor], y: dict[str, Any], at: dict[str, Any], dt: Any
) -> dict[str, Any]:
    """States of lagging sensors at the end of a step, of the outputs amid it."""
    lag = {lag_of(s): (s.of(y), s.tau) for s in sensors if s.tau}
    return {n: v + ca.exp(-dt / tau) * (at[n] - v) for n, (v, tau) in lag.items()}


@kept
def gas_path_model(
    gg: GasGenerator,
    *,
    power: str = "measured",
    gains: tuple[str, ...] = GAINED,
    biases: tuple[str, ...] = (),
    consider: tuple[str, ...] = (),
    walks: tuple[tuple[str, float], ...] = (),
    governed: Governor | None = None,
    power_jumps: bool = False,
    loss: bool = False,
    sensors: tuple[Sensor, ...] | None = None,
    free: tuple[tuple[str, Unknown], ...] = (),
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
        biases: sensors whose offset is a state.
        consider: which states are considered, not estimated.
        walks: pairs of state name and random walk, unit of the state per sqrt(s).
        governed: law that the fuel follows within a step (limits left out); None: it is held.
        power_jumps: add the input ``jump_PW``: standard deviation of a sudden change of
            ``gain_PW``.
        loss: whether the shaft power may lack the loss of a short circuit, as the state ``loss_PW``
            with the input ``jump_loss``.
        sensors: of the outputs, as :func:`model_sensors` gives them; those of the table by default.
        free: pairs of a parameter's name, as ``"gas_generator.eta_c"``, and how it is estimated:
            states behind all others.

    Raises:
        ParameterError: unknown ``power`` or gain, the gain of a power that is not measured, or
            jumps of a gain that is not estimated.
        SignalError: unknown parameter in ``free``.
    """
    if sensors is None:
        sensors = model_sensors(gg, GAS_PATH.only(OUTPUTS).sensors)
    _check_gains(power, gains, consider, power_jumps, loss, {s.name for s in sensors})
    engines = gg.by_parameters if free else gg.family
    how: dict[str, Any] = {"power": power, "gains": gains, "consider": consider, "walks": walks}
    how |= {"biases": biases, "governed": governed, "power_jumps": power_jumps, "sensors": sensors}
    how["loss"] = loss
    made = _family(engines, **how).member(gg.held)
    if angles := {s.name: s.turn for s in sensors if s.turn}:
        made = angular(made, angles)
    return augment(made, dict(free)) if free else made


@kept
def _family(
    engines: CycleFunctions,
    *,
    power: str,
    gains: tuple[str, ...],
    biases: tuple[str, ...],
    consider: tuple[str, ...],
    walks: tuple[tuple[str, float], ...],
    governed: Governor | None,
    power_jumps: bool,
    loss: bool,
    sensors: tuple[Sensor, ...],
) -> FilterModel:
    """The model of all engines of a structure, with their numbers as known parameters."""
    numbers, slow = Signals(engines.theta[len(THETA) :]), [s.name for s in sensors]
    held = [n for n in LAGGING if n not in slow and (n == "Wf" or power == "measured")]
    states = _states(held, gains, biases, sensors, loss)
    inputs_of, noises = _inputs(held, power_jumps, loss)
    signals = states, inputs_of, numbers, noises, Signals([s.signal for s in sensors])
    x, u, p, w = (ca.MX.sym(n, len(s)) for n, s in zip("xupw", signals, strict=False))
    dt = ca.MX.sym("dt")
    at, given, noise = (
        dict(zip(s.names, ca.vertsplit(v), strict=True))
        for s, v in ((states, x), (inputs_of, u), (noises, w))
    )

    def true(name: str) -> Any:  # reading = (1 + gain) true + bias + sigma w
        if name not in held:
            return at[name]
        error = given[f"sigma_{name}"] * noise[f"w_{name}"]
        if name in biases:
            error += at[f"bias_{name}"]
        return (given[name] - error) / (1 + at.get(f"gain_{name}", 0.0))

    reads = dict.fromkeys(n for s in sensors for n in s.reads if n not in (*X.names, *LAGGING))
    function, N = engine_function(engines, tuple(reads)), at["N"]

    def engine(N: Any, inputs: Mapping[str, Any]) -> Any:
        return function(N, U.stack(inputs), ca.vertcat(*(at[n] for n in HEALTH), p))

    inputs = {n: given[n] for n in AMBIENT} | {"Wf": true("Wf")}
    # the outputs do not depend on the shaft power
    _, y, check_out, _ = engine(N, inputs | {"PW": ca.MX(0)})
    seen = {"N": N} | {n: y[i] for i, n in enumerate(reads)}
    own = {s: at[lag_of(s)] if s.tau else s.of(seen) for s in sensors}
    readings = [v * (1 + at.get(f"gain_{s.name}", 0.0)) for s, v in own.items()]
    readings = [
        v + at[f"bias_{s.name}"] if s.name in biases else v
        for s, v in zip(own, readings, strict=True)
    ]
    # a jump happens at the beginning of the step, after the sample
    at |= {n: at[n] + given["jump"] * noise[f"w_{n}"] for n in HEALTH}
    if power_jumps:
        at["gain_PW"] += given["jump_PW"] * noise["w_gain_PW"]
    inputs["PW"] = true("PW")
    if loss:
        at["loss_PW"] += given["jump_loss"] * noise["w_loss_PW"]
        inputs["PW"] += at["loss_PW"]
    k1, _, check, _ = engine(N, inputs)
    k1 = k1 / (1 + at.get("gain_J", 0.0))
    if governed is not None:
        slope = governed.slope(N, k1, p[numbers.index("gas_generator.N")])
        inputs["Wf"] += dt / 2 * slope
    k2, y_mid, check_mid, _ = engine(N + dt / 2 * k1, inputs)
    x1 = at | {"N": N + dt * k2 / (1 + at.get("gain_J", 0.0))}
    if "Wf" not in held and governed is not None:
        x1["Wf"] = at["Wf"] + dt * slope
    amid = {"N": N + dt / 2 * k1} | {n: y_mid[i] for i, n in enumerate(reads)}
    amid |= {n: inputs[n] for n in LAGGING}
    x1 |= _lagged(sensors, amid, at, dt)
    step = ca.vertcat(*x1.values()), check + check_mid
    output, name = (ca.vertcat(*readings), check_out), f"gas_path_{power}"
    made = FilterModel.of(name, signals, (x, u, p, w, dt), step, output, consider=consider)
    return made.with_walk(dict(walks))
