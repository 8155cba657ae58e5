"""The unit as one model, and the exchanges of the multi-rate scheme measured against it.

Section 3.3 of the paper claims that the held speed does no harm; the tests pin what it does, and
that the predicted and the corrected exchange are of second order.
"""

import math

import numpy as np
import pytest

from apu_casadi.core.errors import ScenarioError
from apu_casadi.core.simulation import stepper
from apu_casadi.machine.faults.ttsc import Ttsc
from apu_casadi.machine.loads.constantpower import ConstantPowerLoad
from apu_casadi.machine.loads.series import SeriesLoad
from apu_casadi.unit.apu import Apu
from apu_casadi.unit.events import FaultChange, HealthChange, LoadChange
from apu_casadi.unit.exchange import EXCHANGES
from apu_casadi.unit.integrators import ramped
from apu_casadi.unit.monolithic import joint_state_space, simulate_monolithic
from apu_casadi.unit.multirate import simulate_joint
from apu_casadi.unit.noise import Noise

APU = Apu()
KW225, KW100 = SeriesLoad.from_power(225e3), SeriesLoad.from_power(100e3)
T_EVENT, END = 0.04, 0.24


def start():
    """Return joint model, its steady state at 225 kW, inputs and parameters."""
    point = APU.steady_state(KW225)
    ss = joint_state_space(APU)
    x = np.concatenate([point.gas.x, [point.gas["Wf"]], point.generator.x])
    u = np.concatenate([point.gas.u[2:], point.generator.u[1:]])
    return ss, x, u, np.ones(4)


def load_step(simulate, **options):
    return simulate(APU, duration=END, load=KW225, events=[LoadChange(T_EVENT, KW100)], **options)


@pytest.fixture(scope="module")
def truth():
    return load_step(simulate_monolithic)


def errors(ds, truth):
    """Largest errors of speed (of its excursion) and of mean power, every 40 ms."""
    k, k_true = round(0.04 / ds.attrs["dt_test"]), 2
    N, N_true = ds.N.to_numpy()[::k], truth.N.to_numpy()[::k_true]
    P = ds.P_total.to_numpy()[1:].reshape(-1, k).mean(axis=1)
    P_true = truth.P_total.to_numpy()[1:].reshape(-1, k_true).mean(axis=1)
    excursion = np.abs(N_true - N_true[0]).max()
    return np.abs(N - N_true).max() / excursion, np.abs(P / P_true - 1).max()


def joint(exchange, dt, **options):
    ds = load_step(
        simulate_joint, exchange=exchange, dt=dt, waveform_dt=None, warn_exchange=False, **options
    )
    ds.attrs["dt_test"] = dt
    return ds


def test_steady_states_of_the_parts_are_steady_for_the_whole():
    """The joint trim couples what the one model couples: no rate above 1e-9 of nominal per s."""
    ss, x, u, theta = start()
    rate = ss.f(x, u, theta).full().ravel() / ss.x.nominals
    rate[ss.x.index("theta_e")] = 0.0
    worst = int(np.argmax(np.abs(rate)))
    assert abs(rate[worst]) < 1e-9, f"{ss.x.names[worst]} moves by {rate[worst]:.1e} 1/s"


def test_both_forms_are_one_model():
    """z_of solves the residual's algebraic equations, and the rates then agree."""
    ss, x, u, theta = start()
    x = x * 1.001
    z = ss.z_of(x, u, theta)
    ode, alg = ss.residual(x, z, u, theta)
    assert float(np.abs(alg.full()).max()) < 1e-10
    f = ss.f(x, u, theta).full().ravel()
    assert np.abs(ode.full().ravel() - f).max() <= 1e-9 * np.abs(f).max()


def test_two_solvers_agree_on_it():
    """IDAS carries the gas path as unknowns, CVODES solves it in every evaluation: 1e-6."""
    ss, x, u, theta = start()
    u = u.copy()
    u[ss.u.index("R_a") : ss.u.index("R_c") + 1] = KW100.R
    a, b = (stepper(ss, 1, solver=s)(x, u, theta, 0.01) for s in ("idas", "cvodes"))
    apart = np.abs(a.x_end - b.x_end) / ss.x.nominals
    worst = int(np.argmax(apart))
    assert apart[worst] < 1e-6, f"{ss.x.names[worst]}: {apart[worst]:.1e} of nominal"
    assert a.x_end[0] > x[0] + 5, "a load drop must speed the rotor up within 10 ms"


def test_means_agree_with_integrals_of_the_generator_alone(truth):
    """Before the event nothing moves, and the means carried as states are the steady values."""
    point = APU.steady_state(KW225)
    assert truth.P_total.to_numpy()[2] == pytest.approx(point.generator.y["P_total"], rel=1e-7)
    assert truth.V_b_rms.to_numpy()[2] == pytest.approx(point.generator.y["V_t"], rel=1e-4)
    assert abs(truth.N.to_numpy()[2] / truth.N.to_numpy()[0] - 1) < 1e-9


def test_every_kind_of_event_is_met():
    """Health, load and fault change in one run; the fault's loss and the fuel's rise show."""
    events = [
        HealthChange(0.02, {"f_eta_t": 0.98}),
        LoadChange(0.03, KW100),
        FaultChange(0.04, Ttsc(0.05, 20.0)),
    ]
    ds = simulate_monolithic(APU, duration=0.06, load=KW225, events=events)
    assert list(ds.time.to_numpy()) == pytest.approx([0, 0.02, 0.03, 0.04, 0.06])
    loss = ds.P_loss_fault.to_numpy()
    assert np.all(loss[:4] == 0.0) and 2e4 < loss[4] < 4e4, f"fault loss {loss} W"
    assert float(ds.residual.max()) < 1e-9


@pytest.mark.parametrize(
    ("exchange", "order", "at_20_ms"),
    # at 20 ms the bound is twice the measured error; the order is measured between 40 and 10 ms
    [
        ("paper", (0.9, 1.4), 0.12),
        ("predicted", (1.7, 2.6), 0.016),
        ("corrected", (1.7, 2.6), 0.006),
    ],
)
def test_order_of_convergence_of_the_speed(truth, exchange, order, at_20_ms):
    """The paper's exchange is of first order, the other two of second."""
    e = {dt: errors(joint(exchange, dt), truth)[0] for dt in (0.01, 0.02, 0.04)}
    slope = math.log(e[0.04] / e[0.01]) / math.log(4)
    assert order[0] < slope < order[1], f"{exchange}: order {slope:.2f}, errors {e}"
    assert e[0.02] < at_20_ms, f"{exchange}: speed wrong by {e[0.02]:.1%} of its excursion"


def test_the_scheme_converges_to_the_one_model(truth):
    """Step 2.5 ms, corrected: speed within 2e-4 of its excursion, mean power within 2e-6."""
    N, P = errors(joint("corrected", 0.0025), truth)
    assert N < 2e-4 and P < 2e-6, f"speed {N:.1e}, power {P:.1e}"


def test_two_different_machines_rest_where_their_steady_states_are():
    """Nothing moves; each machine has its own power, and the shaft their sum."""
    unit = APU.change({"generator2.machine.r_s": 0.006, "generator2.coupling.gear": 3.05})
    loads = [KW100, ConstantPowerLoad(80e3)]
    ds, at = simulate_monolithic(unit, duration=0.02, load=loads), unit.steady_state(loads)
    assert abs(np.ptp(ds.N.values)) < 1e-5
    for k in (1, 2):
        assert ds.P_e.values[k - 1] == pytest.approx(at.of(k).y["P_e"], rel=1e-7)
        assert ds.V_1_angle.values[k - 1, 1] == pytest.approx(ds.V_1_angle.values[k - 1, 0])
    assert ds.P_total.values == pytest.approx(ds.P_e.values.sum(0) / 0.9, rel=1e-9)
    assert ds.PW.values[1] == pytest.approx(at.gas["PW"], rel=1e-6)


@pytest.mark.ci  # IDAS in the virtual machine
def test_two_different_machines_are_what_the_exchange_converges_to():
    """Own parameters, gear, kind of load and fault of each; order two of the speed."""
    unit = APU.change({"generator2.machine.r_s": 0.006, "generator2.coupling.gear": 3.05})
    how = dict(duration=0.12, load=[KW100, SeriesLoad.from_power(80e3, 0.85)])
    how["events"] = [
        FaultChange(0.04, Ttsc(0.05, 20.0), generator=2),
        LoadChange(0.06, KW225, generator=1),
    ]
    one = simulate_monolithic(unit, **how)
    off = {}
    for dt in (0.02, 0.005):
        ds = simulate_joint(unit, dt=dt, exchange="corrected", waveform_dt=None, **how)
        N = ds.N.values[:: round(0.02 / dt)]
        off[dt] = np.abs(N - one.N.values).max() / np.abs(one.N - one.N[0]).values.max()
    assert off[0.005] < 4e-4 and off[0.005] < off[0.02] / 6, off
    assert one.P_e.dims == ("generator", "time") and one.generator.values.tolist() == [1, 2]
    assert one.P_loss_fault.values[0].max() == 0.0 < one.P_loss_fault.values[1, -1]


def test_equal_machines_given_one_by_one_are_one():
    """A list of two equal loads, a fault of both: the bits of the run of one group."""
    how = dict(duration=0.04, events=[FaultChange(0.02, Ttsc(0.05, 20.0))])
    a = simulate_monolithic(APU, load=KW100, **how)
    b = simulate_monolithic(APU, load=[KW100, KW100], **how)
    assert a.drop_attrs().identical(b.drop_attrs()) and "generator" not in a.dims


@pytest.mark.parametrize("exchange", EXCHANGES)
def test_energy_is_handed_over_exactly(exchange):
    """Eq. (1) in every exchange, repeated steps included: 1e-10 of the energy."""
    ds = joint(exchange, 0.02)
    h = np.diff(ds.time.to_numpy())
    given = float(np.sum(ds.P_total.to_numpy()[1:] * h))
    taken = float(np.sum(ds.PW.to_numpy()[1:] * h)) * APU.coupling.eta_gtSg
    assert given == pytest.approx(taken, rel=1e-10)


def test_the_default_is_the_paper_s_exchange():
    """Section 3.3 as printed unless asked otherwise; a fault at the start takes the same path."""
    kw = {"duration": 0.06, "load": KW100, "fault": Ttsc(0.05, 20.0), "waveform_dt": None}
    a, b = simulate_joint(APU, **kw), simulate_joint(APU, exchange="paper", **kw)
    assert np.array_equal(a.N, b.N) and np.array_equal(a.P_total, b.P_total)
    c = simulate_joint(APU, exchange="predicted", **kw)
    assert 0 < float(np.abs(c.N - a.N).max()) < 5, "rad/s; the slope is not yet known at t = 0"


def test_noise_is_drawn_once_for_a_step_computed_twice():
    """A correction repeats the step with the same voltages, and leaves the random numbers alone."""
    kw = {"noise": Noise(N=1e-9, w1=1e-9), "seed": 3}
    a, b = joint("corrected", 0.02), joint("corrected", 0.02, **kw)
    assert float(np.abs(a.N - b.N).max()) < 1e-5


def test_a_ramp_of_slope_zero_is_a_held_speed():
    """The model with the speed as a state: same outputs, and a slope turns the rotor angle."""
    point = APU.steady_state(KW225)
    ss, u = point.generator.ss, point.generator.u
    slow = ramped(ss)
    k = ss.u.index("w_r")
    held = stepper(ss, 1)(point.generator.x, u, [], 0.01)
    v = u.copy()
    v[k] = 0.0
    x = np.append(point.generator.x, u[k])
    same = stepper(slow, 1)(x, v, [], 0.01)
    assert np.abs(same.x_end[:-1] - held.x_end).max() < 1e-6
    v[k] = 1000.0  # rad/s2
    turned = stepper(slow, 1)(x, v, [], 0.01)
    j = ss.x.index("theta_e")
    assert turned.x_end[j] - held.x_end[j] == pytest.approx(0.5 * 1000 * 0.01**2, rel=1e-6)


def test_an_unknown_exchange_is_refused_with_the_nearest():
    """A typo is answered with the exchange meant."""
    with pytest.raises(ScenarioError, match="predicted"):
        simulate_joint(APU, duration=0.1, load=KW225, exchange="predictd")
