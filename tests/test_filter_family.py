"""Units of other numbers share what is made for filters, and their numbers may be unknowns."""

import time

import casadi as ca
import numpy as np
import pytest
from numpy.testing import assert_allclose
from odd_engine import changed, odd_engine

from apu_casadi import Apu, SeriesLoad, simulate_joint
from apu_casadi.core.errors import ParameterError, SignalError
from apu_casadi.gaspath.gasgenerator import GasGenerator
from apu_casadi.gaspath.health import HEALTH
from apu_casadi.gaspath.unitnumbers import GIVEN
from apu_casadi.unit.control import GovernorParameters
from estimators.apu.gaspath import gas_path_filter
from estimators.apu.gaspathmodel import gas_path_model
from estimators.filters.ekf import ekf_step
from estimators.filters.filtering import FilterStep
from estimators.filters.ukf import ukf_step
from estimators.models.filtermodel import (
    FilterModel,
    Unknown,
    augment,
    biases,
    discretise,
    gains,
    measure,
    noisy_inputs,
)
from estimators.models.recording import record

# what none of the filter's outputs depends on: surge margins, and a pressure beside the gas path
IDLE = ["gas_generator.Ps3_P3", "compressor_map.k_SM", "compressor_map.a_SM"]
IDLE += ["turbine_map.k_SM", "turbine_map.a_SM"]
KW100 = SeriesLoad.from_power(100e3)


def flat(a):
    """Return what a function of CasADi gave as a vector."""
    return np.asarray(a).ravel()


def step_of(model: FilterModel, x, u, w, dt, p=None) -> np.ndarray:
    """Next state and outputs by the functions of a model's family."""
    full = model.full(np.zeros(0) if p is None else p)
    made = model.shared
    return np.concatenate(
        [flat(made.transition(x, u, full, w, dt)[0]), flat(made.output(x, u, full, w)[0])]
    )


def slopes(model: FilterModel, x, u, w, dt, first: int) -> np.ndarray:
    """Exact derivatives of next state and outputs by the states from ``first`` on."""
    s = ca.MX.sym("x", len(model.x))
    both = ca.vertcat(
        model.transition(s, u, np.zeros(0), w, dt)[0], model.output(s, u, np.zeros(0), w)[0]
    )
    return np.asarray(ca.Function("J", [s], [ca.jacobian(both, s)])(x))[:, first:]


# ------------------------------------------------------------------------------ gas path


def test_derivatives_of_the_gas_path_filter_by_every_parameter_are_exact():
    """Transition and output by all parameters of the engine, against units made with them.

    Central differences of order four; 1e-6 of each row's largest entry in nominal units.
    """
    gg = odd_engine()
    how = {"gains": (), "governed": GovernorParameters()}
    names = [n for n in GIVEN.names if n not in IDLE]
    free = gas_path_model(gg, free=tuple((n, Unknown()) for n in names), **how)
    assert free.x.names == ("N", *HEALTH, *names)
    given = np.array([gg.held[n] for n in names])
    x = np.array([0.99 * gg.parameters.N, 0.98, 0.99, 0.985, 1.01])
    u = free.u.pack({"Wf": 0.04, "PW": 2e5, "altitude": 500.0, "Mach": 0.2, "dT_isa": 5.0}, war=0.0)
    w = np.zeros(len(free.w))
    J = slopes(free, np.concatenate([x, given]), u, w, 0.02, 5)
    rows = [0, *range(len(free.x), J.shape[0])]  # of N, and of the outputs
    J = J[rows]
    nominal = np.maximum(np.abs(given), 0.1)
    size = np.abs(J * nominal).max(axis=1)
    size[size == 0] = 1.0  # the reading of N
    for k, name in enumerate(names):
        h = 5.0 if name == "gas_generator.altitude" else 2e-4 * nominal[k]

        def at(move: float, k: int = k, name: str = name) -> np.ndarray:
            unit = gas_path_model(changed(gg, name, given[k] + move), **how)
            return step_of(unit, x, u, w, 0.02)[[0, *range(5, 9)]]

        near, far = (at(m * h) - at(-m * h) for m in (1, 2))
        off = np.abs((8 * near - far) / (12 * h) - J[:, k]) * nominal[k] / size
        assert off.max() < 1e-6, f"by {name}: {off.max():.1e}"


@pytest.fixture(scope="module")
def truth():
    """A joint run of half a second without waveforms."""
    return simulate_joint(Apu(), duration=0.5, load=KW100, waveform_dt=None)


@pytest.mark.parametrize("step", [None, ukf_step])
def test_another_engine_builds_and_compiles_nothing(truth, step, asked, monkeypatch):
    """The block of the second engine's filter is the first one's; its beliefs are its own."""
    how = {"gains": False, "inertia": None}
    first = gas_path_filter(**how)
    data = first.recording(truth, 1)
    r = first.run(data, step=step)
    before = set(asked)
    monkeypatch.setattr(FilterModel, "expanded", None)  # what every new step begins with
    other = gas_path_filter(Apu().change({"gas_generator.eta_c": 0.84}).gas_generator, **how)
    assert other.model.shared is first.model.shared
    assert np.abs(other.run(data, step=step)["f_eta_c"][0] - r["f_eta_c"][0]).max() > 1e-3
    assert before and asked == before


def test_a_parameter_of_the_engine_is_a_state_of_the_filter():
    """The compressor's efficiency, as a random walk, is found in a unit that has another one."""
    name = "gas_generator.eta_c"
    unit = Apu().change({name: 0.835})
    ds = simulate_joint(unit, duration=1.0, load=KW100, waveform_dt=None)
    filt = gas_path_filter(
        Apu().gas_generator,
        gains=False,
        inertia=None,
        health_sigma=1e-6,
        walk=dict.fromkeys(HEALTH, 0.0),
        free={name: Unknown(walk=1e-5, lower=0.5, upper=1.0)},
    )
    assert filt.prior()[name][0] == 0.85
    found = filt.run(filt.recording(ds, seed=3), backend="vm")
    mean, sigma = (float(v[-1]) for v in found[name])
    assert sigma < 2e-3 and abs(mean - 0.835) < 4 * sigma


def test_what_cannot_be_free_is_told():
    """Unknown names with the nearest; numbers without derivatives where they would be zero."""
    with pytest.raises(SignalError, match=r"'gas_generator.eta_cc' .*eta_c"):
        gas_path_filter(free={"gas_generator.eta_cc": Unknown()})
    with pytest.raises(ParameterError, match=r"no derivatives by gas_generator.eta_c"):
        augment(gas_path_filter().model, {"gas_generator.eta_c": Unknown()})
    for name in IDLE:
        with pytest.raises(ParameterError, match=f"no derivatives by {name}"):
            gas_path_filter(free={name: Unknown()})


# ------------------------------------------------------------------------------ in general


def test_a_chain_of_changes_keeps_the_family_and_the_numbers():
    """Each change of a member is the member of its family's change, to rounding and by identity."""
    units = [Apu().gas_generator, Apu().change({"gas_generator.W2": 3.3}).gas_generator]
    made = []
    for gg in units:
        model = measure(discretise(gg.state_space), ["N", "P3", "T5"])
        model = biases(gains(noisy_inputs(model, {"Wf": 3e-4}), ["P3"]), ["T5"])
        made.append(augment(model, {"f_eta_c": Unknown(walk=1e-3), "gain_P3": Unknown()}))
    first, second = made
    assert first.shared is second.shared
    assert first.p.names == ("f_W_c", "f_eta_t", "f_W_t", "bias_T5")
    assert ekf_step(first).shared is ekf_step(second).shared
    u = first.u.pack(
        {"Wf": 0.04, "PW": 2e5, "altitude": 0.0, "Mach": 0.0, "dT_isa": 0.0, "war": 0.0}
    )
    p, w = np.array([0.99, 1.0, 1.01, 0.5]), np.array([0.3])
    ends = []
    for model in made:
        x = np.array([3700.0, 0.98, 0.01])
        ends.append(step_of(model, x, u, w, 0.02, p))
        by_own = [model.transition(x, u, p, w, 0.02)[0], model.output(x, u, p, w)[0]]
        assert_allclose(np.concatenate([flat(v) for v in by_own]), ends[-1], rtol=1e-13)
    assert np.abs(ends[0] / ends[1] - 1).max() > 1e-3


def test_a_step_of_a_member_takes_the_members_parameters():
    """The function of a step, called by its own, is the family's with the numbers put in."""
    gg = GasGenerator()
    model = measure(discretise(gg.state_space), ["N", "P3"])
    step = ekf_step(model)
    assert isinstance(step, FilterStep) and step.family is not None
    data = record(
        model,
        outputs={"N": (np.zeros(1), [3750.0]), "P3": (np.zeros(1), [8e5])},
        sigma={"N": 1.0, "P3": 1e3},
        inputs={"Wf": 0.04, "PW": 2e5, "altitude": 0.0, "Mach": 0.0, "dT_isa": 0.0, "war": 0.0},
    )
    rest = data.y[:, 0], data.variance[:, 0], 0.02
    args = np.array([3760.0]), np.eye(1), data.u[:, 0]
    own = step.function(*args, data.p, *rest)
    shared = step.shared.function(*args, step.full(data.p), *rest)
    for a, b in zip(own, shared, strict=True):
        assert_allclose(flat(a), flat(b), rtol=1e-13)


def test_first_run_of_an_engine_costs_little(truth):
    """30 ms of process time over a repeated one, the least of five engines."""
    how = {"gains": False, "inertia": None}
    data = gas_path_filter(**how).recording(truth, 1)

    def run(unit: Apu) -> float:
        t = time.process_time()
        gas_path_filter(unit.gas_generator, **how).run(data)
        return time.process_time() - t

    run(Apu())
    first, again = [], []
    for k in range(5):
        unit = Apu().change({"gas_generator.eta_c": 0.84 + 1e-3 * k})
        first.append(run(unit))
        again.append(run(unit))
    assert min(first) < min(again) + 0.03
