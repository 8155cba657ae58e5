"""Units of other numbers share what is made for filters, and their numbers may be unknowns."""

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
from apu_casadi.machine.machinedata import MACHINE, MachineParameters
from apu_casadi.machine.terminals import terminal_model
from apu_casadi.unit.control import GovernorParameters
from estimators.apu.electrical.electricalfilter import electrical_filter
from estimators.apu.electrical.machinemodel import electrical_model
from estimators.apu.fitting import engine_model
from estimators.apu.gaspath import gas_path_filter
from estimators.apu.gaspathmodel import gas_path_model
from estimators.apu.joint import electrical_samples, unit_of
from estimators.apu.monolithic_filter import Monolithic, monolithic_filter
from estimators.apu.sensors import ELECTRICAL
from estimators.batch.fit import fit
from estimators.batch.mhe import moving_horizon
from estimators.detection.signatures import Jump, linearised
from estimators.filters.belief import Belief
from estimators.filters.ekf import ekf_step, extended_kalman_filter
from estimators.filters.filtering import FilterStep
from estimators.filters.imm import interacting_multiple_models
from estimators.filters.ukf import ukf_step
from estimators.models.filtermodel import (
    FilterModel,
    Unknown,
    augment,
    discretise,
    measure,
    noisy_inputs,
)
from estimators.models.recording import Recording, record
from estimators.models.sensorerrors import biases, gains

# what none of the filter's outputs depends on: surge margins, and a pressure beside the gas path
IDLE = ["gas_generator.Ps3_P3", "compressor_map.k_SM", "compressor_map.a_SM"]
IDLE += ["turbine_map.k_SM", "turbine_map.a_SM"]
# what the electrical filter does not depend on; the efficiency without power, the rated frequency
# without a leaky fault
NO_MATTER = [f"machine.{n}" for n in ("n_pp", "V_rated_rms", "P_rated", "eta_sg", "f_rated")]
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


@pytest.mark.long
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


@pytest.mark.long
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


@pytest.mark.long
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


# ------------------------------------------------------------------------------ electrical


def moved(p: MachineParameters, name: str, value: float) -> MachineParameters:
    """Return the machine with one number replaced, pole pairs and limits among them."""
    return p.symbolic(**{name.partition(".")[2]: value})


@pytest.mark.parametrize(
    "how", [{}, {"power": True, "gains": "estimate"}, {"kappa": 0.5, "phase": "b"}]
)
def test_derivatives_of_the_electrical_filter_by_every_parameter_are_exact(how):
    """Transition and output by all parameters of the machine, against machines made with them."""
    kappa, gained = how.get("kappa"), "gains" in how
    args = ELECTRICAL, "power" in how, kappa, how.get("phase"), gained
    machine = MachineParameters()
    model = electrical_model(machine, *args)
    idle = NO_MATTER[: 4 if kappa else 5]
    if "power" in how:
        idle.remove("machine.eta_sg")
    free = augment(model, {n: Unknown() for n in MACHINE.names if n not in idle})
    for name in idle:
        with pytest.raises(ParameterError, match=f"no derivatives by {name}: nothing"):
            augment(model, {name: Unknown()})
    rng = np.random.default_rng(5)
    x = model.x.nominals * rng.uniform(0.3, 0.9, len(model.x))
    u = model.u.nominals * rng.uniform(0.3, 0.9, len(model.u))
    u[[i for i, n in enumerate(model.u.names) if n.startswith("dt")]] = 1e-4
    p = np.full(len(model.p), 3e-3)
    w = rng.standard_normal(len(model.w))
    names = free.x.names[len(x) :]
    given = np.array([machine.held("machine")[n] for n in names])
    s = ca.SX.sym("x", len(free.x))
    both = [free.transition(s, u, p, w, 1e-4)[0][: len(x)], free.output(s, u, p, w)[0]]
    J = ca.Function("J", [s], [ca.jacobian(ca.vertcat(*both), s)])(np.append(x, given)).full()
    for k, name in enumerate(names):
        h = 1e-5 * given[k]
        ends = []
        for value in (given[k] + h, given[k] - h):
            unit = electrical_model(moved(machine, name, value), *args)
            ends.append(step_of(unit, x, u, w, 1e-4, p))
        off = (ends[0] - ends[1]) / (2 * h) - J[:, len(x) + k]
        rounding = 1e-10 * np.abs(ends[0]) / h
        assert (np.abs(off) <= 1e-6 * np.abs(J[:, len(x) + k]).max() + rounding).all(), name


@pytest.mark.parametrize("fault", ["shunts", "leaky"])
def test_derivatives_of_the_terminal_model_by_every_parameter_are_exact(fault):
    """Rates and outputs of the family by all parameters, against models of machines made so."""
    machine = MachineParameters()
    ss = terminal_model(machine, fault)
    rng = np.random.default_rng(6)
    x, u = (s.nominals * rng.uniform(0.3, 0.9, len(s)) for s in (ss.x, ss.u))
    theta = np.array([0.05, 1.0, 0.5, 0.3])[: len(ss.theta)]
    full, t = ss.full(theta), ca.SX.sym("t", len(ss.shared.theta))
    both = ca.vertcat(ss.shared.f(x, u, t), ss.shared.g(x, u, t))
    J = ca.Function("J", [t], [ca.jacobian(both, t)])(full).full()[:, len(theta) :]
    for k, (name, value) in enumerate(machine.held("machine").items()):
        h, ends = 1e-5 * value, []
        for v in (value + h, value - h):
            unit = terminal_model(moved(machine, name, v), fault)
            ends.append(np.concatenate([flat(unit.f(x, u, theta)), flat(unit.g(x, u, theta))]))
        off = (ends[0] - ends[1]) / (2 * h) - J[:, k]
        rounding = 1e-10 * np.abs(ends[0]) / h
        assert (np.abs(off) <= 1e-6 * np.abs(J[:, k]).max() + rounding).all(), name


@pytest.fixture(scope="module")
def terminals():
    """Terminals of a machine of stator resistance 0.005 ohm over 0.2 s, measured."""
    unit = Apu().change({"machine.r_s": 0.005})
    ds = simulate_joint(unit, duration=0.2, load=KW100, waveform_dt=1e-4)
    return electrical_samples(ds, unit, np.random.default_rng(3))


def test_another_machine_builds_and_compiles_nothing(terminals, asked):
    """The block of the second machine's filter is the first one's; its beliefs are its own."""
    first = electrical_filter(power=True)
    data, prior = first.recording(terminals), first.prior(terminals)
    r = extended_kalman_filter(first.model, prior, data)
    before = set(asked)
    other = electrical_filter(MachineParameters(r_s=0.005), power=True)
    again = extended_kalman_filter(other.model, other.prior(terminals), data)
    assert other.model.shared is first.model.shared
    assert np.abs(again["h_a"][0] - r["h_a"][0]).max() > 1e-5
    assert again.loglik > r.loglik
    assert before and asked == before


def test_a_parameter_of_the_machine_is_a_state_of_the_filter(terminals):
    """The stator resistance, as a random walk, is found in a machine that has another one."""
    filt = electrical_filter(
        phases=(), free={"machine.r_s": Unknown(walk=1e-5, lower=1e-4, upper=0.1)}
    )
    prior = filt.prior(terminals)
    assert prior["machine.r_s"] == pytest.approx((0.0044, 0.00044))
    found = extended_kalman_filter(filt.model, prior, filt.recording(terminals), backend="vm")
    mean, sigma = (float(v[-1]) for v in found["machine.r_s"])
    assert sigma < 4e-4 and abs(mean - 0.005) < 4 * sigma


def whole_unit(unit: Apu) -> Monolithic:
    """The filter of a whole unit, of one group of generators or of each on its own."""
    numbers = (1,) if unit.alike else (1, 2)
    own = tuple(electrical_filter(unit_of(unit, k).generator.machine, power=True) for k in numbers)
    gas = gas_path_filter(unit.gas_generator, gains=False, inertia=None)
    return monolithic_filter(unit, own, gas, None if len(own) > 1 else ((1, 2),))


def of_terminals(whole: Monolithic, measured) -> tuple[Belief, Recording]:
    """Prior and recording of a filter of a whole unit, over three samples."""
    n, start = len(whole.of), float(measured["t"][0])
    first = {k: v[:30] for k, v in measured.items()}
    fast = [f.recording(first, start=start).part(0, 3) for f in whole.electrical]
    fuel = {k: (np.array([start]), np.array([v])) for k, v in (("Wf", 0.031), ("PW", 2.2e5))}
    slow = whole.gas.of_readings(fuel | {"N": (fuel["Wf"][0], np.array([3775.0]))})
    speeds = [measured["w_r"][:3]] * n
    prior = whole.prior([f.prior(measured) for f in whole.electrical], whole.gas.prior())
    return prior, whole.recording(fast, slow, speeds, [1.0] * n)


@pytest.mark.long
@pytest.mark.parametrize("generator", ["", "generator2."])
def test_another_unit_as_one_model_builds_and_compiles_nothing(
    terminals, generator, asked, monkeypatch
):
    """The filter of the whole unit: machine, gear and engine of the second have other numbers."""
    base = {f"{generator}coupling.gear": 3.0} if generator else {}
    first = whole_unit(Apu().change(base))
    ends = [first.run(*of_terminals(first, terminals)).mean[:, -1]]
    before = set(asked)
    monkeypatch.setattr(FilterModel, "expanded", None)  # what every new step begins with
    for more in ({"gas_generator.eta_c": 0.8}, {f"{generator}machine.r_s": 0.005}):
        unit = Apu().change(base | more)
        other = whole_unit(unit)
        assert other.model.shared is first.model.shared
        assert other.model.held[f"{generator}machine.r_s"] == unit.machines[-1][0].machine.r_s
        ends.append(other.run(*of_terminals(other, terminals)).mean[:, -1])
        assert np.abs(ends[-1] / ends[0] - 1).max() > 1e-6
    assert before and asked == before


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


@pytest.mark.long
def test_a_filter_of_another_engine_compiles_nothing(truth, asked):
    """What the first engine's filter asks for serves five others."""
    how = {"gains": False, "inertia": None}
    data = gas_path_filter(**how).recording(truth, 1)
    gas_path_filter(Apu().gas_generator, **how).run(data)
    before = set(asked)
    for k in range(5):
        unit = Apu().change({"gas_generator.eta_c": 0.84 + 1e-3 * k})
        gas_path_filter(unit.gas_generator, **how).run(data)
    assert before and asked == before


@pytest.mark.long
def test_interacting_models_of_another_engine_compile_nothing(truth, asked):
    """Modes are members: the block is the families', the numbers of each mode are arguments."""
    probabilities = []
    before = set(asked)
    for eta in (0.85, 0.84):
        unit = Apu().change({"gas_generator.eta_c": eta}).gas_generator
        filts = [gas_path_filter(unit, gains=g, inertia=None) for g in (False, ("T5",))]
        models = {n: ekf_step(f.model) for n, f in zip(("exact", "biased"), filts, strict=True)}
        priors = {n: f.prior() for n, f in zip(models, filts, strict=True)}
        rates = np.array([[-0.1, 0.1], [0.1, -0.1]])
        data = filts[0].recording(truth, 1)
        r = interacting_multiple_models(models, priors, data, rates=rates)
        probabilities.append(r.probability)
        if not before:
            before = set(asked)
    assert before and asked == before
    assert np.abs(probabilities[0] - probabilities[1]).max() > 1e-6


@pytest.mark.long
def test_horizons_fits_and_signatures_of_another_engine_compile_nothing(truth, asked):
    """Moving horizon, batch fit and the Jacobians of jumps: made of the family, once."""
    before, found = set(asked), []
    for eta in (0.85, 0.84):
        unit = Apu().change({"gas_generator.eta_c": eta}).gas_generator
        names = ["N", "P3", "T3", "T5"]
        model = measure(discretise(unit.state_space, walk={"N": 1.0}), names)
        filt = gas_path_filter(unit, gains=False, inertia=None)
        few = filt.recording(truth, 1).part(0, 3)
        u = few.u[filt.model.u.indices(model.u.names)]
        data = Recording(few.t, u, few.y, few.variance, np.ones(4))
        prior = Belief.of(model.x, {"N": 3770.0}, {"N": 20.0})
        near = moving_horizon(model, prior, data, horizon=2)
        f = fit(model, data, ["f_eta_c"], prior={"f_eta_c": (1.0, 0.02)}, beliefs=[prior])
        path = extended_kalman_filter(model, prior, data, full=True)
        jumps = linearised(model, path, data, [Jump("parameter", "f_eta_c", 0.01)])
        found.append([near.mean[0, -1], f.estimate[0], jumps.output[0, 1, 0]])
        if not before:
            before = set(asked)
    assert before and asked == before
    assert (np.abs(np.subtract(*found)) > 1e-6).all()


@pytest.mark.long
def test_a_fit_of_another_engine_compiles_nothing(asked):
    """The lifted model and the program are the family's; the numbers are among the data."""
    before, found = set(asked), []
    t = np.arange(3) * 0.02
    read = {"N": 3775.0, "P3": 8.1e5, "T3": 552.0, "T5": 748.0}
    held = {"Wf": 0.0485, "PW": 4.95e5, "altitude": 0.0, "Mach": 0.0, "dT_isa": 5.0, "war": 0.0}
    for eta in (0.85, 0.84):
        unit = Apu().change({"gas_generator.eta_c": eta}).gas_generator
        lifted = engine_model(unit, ("N", "P3", "T3", "T5"))
        data = record(
            lifted.model,
            outputs={n: (t, np.full(3, v)) for n, v in read.items()},
            sigma={n: 2e-3 * v for n, v in read.items()},
            inputs=held | {"sigma_Wf": 3e-4, "sigma_PW": 2e3},
            p=dict.fromkeys(HEALTH, 1.0),
        )
        found.append(fit(lifted, data, ["f_eta_c"], prior={"f_eta_c": (1.0, 0.02)}).estimate[0])
        if not before:
            before = set(asked)
    assert before and asked == before
    assert abs(found[1] / found[0] - 0.85 / 0.84) < 3e-3
